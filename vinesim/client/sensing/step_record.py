"""A robot's state after one step as a record of fixed size, for the queue to its ROS process."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinesim.scene.values import Contact, ElasticSample, Imu, JointReference, JointSample, RobotSample, Wrench

if TYPE_CHECKING:
    from vinesim.robot.description.description import RobotDescription

MAX_CONTACTS = 32
"""Contacts of one robot that a record holds; further ones of the same step are left out and counted."""

_JOINT_ROWS = ("position", "velocity", "effort", "contact")
_CONTACT = np.dtype([("link", "i4"), ("body", "i4"), ("position", "f8", 3), ("force", "f8", 3), ("distance", "f8")])


class StepRecords:
    """The layout of the records of one robot; constant, small, and the same in both processes."""

    def __init__(self, actor: str, description: RobotDescription, series_stiffness: np.ndarray) -> None:
        """``series_stiffness``: [joint] N m/rad or N/m of the series elastic elements."""
        self.actor = actor
        self.joints = description.joints
        self.transforms = tuple(description.moving_joints.frames)
        self.links = tuple(f"{actor}/{link}" for link in description.link_anchors)
        self._link_index = {link: i for i, link in enumerate(self.links)}
        self.series_stiffness = series_stiffness
        self._imus = tuple((mount.name, mount.frame) for mount in description.imus)
        self._wrenches = tuple((mount.name, mount.frame) for mount in description.wrenches)
        joints, transforms = len(self.joints), len(self.transforms)
        self.dtype = np.dtype(
            [
                ("time", "f8"), ("has_state", "?"), ("has_body_sensors", "?"), ("contact_count", "i4"),
                *((name, "f8", (joints,)) for name in (*_JOINT_ROWS, "desired", "desired_velocity")),
                ("imu", "f8", (len(self._imus), 10)), ("wrench", "f8", (len(self._wrenches), 6)),
                ("base_q", "f8", (7,)), ("base_qd", "f8", (6,)), ("odom_q", "f8", (7,)),
                ("odom_qd", "f8", (6,)), ("odom_covariance", "f8", (2, 3, 3)),
                ("transform_q", "f8", (transforms, 7)), ("contacts", _CONTACT, (MAX_CONTACTS,)),
            ]
        )  # fmt: skip

    def write(self, record: Any, time: float, sample: RobotSample | None) -> int:
        """Fill a record: the time [s], and the state unless None. Returns the number of contacts left out."""
        record["time"], record["has_state"] = time, sample is not None
        if sample is None:
            return 0
        joints = sample.joints
        record["position"], record["velocity"] = joints.position, joints.velocity
        record["effort"], record["contact"] = joints.effort, joints.contact
        record["base_q"], record["base_qd"], record["odom_q"] = sample.base_q, sample.base_qd, sample.odom_q
        record["odom_qd"], record["odom_covariance"] = sample.odom_qd, sample.odom_covariance
        record["transform_q"] = sample.transform_q
        if (reference := sample.reference) is not None:
            record["desired"], record["desired_velocity"] = reference.position, reference.velocity
        else:
            record["desired"], record["desired_velocity"] = joints.position, joints.velocity
        record["has_body_sensors"] = bool(sample.imus or sample.wrenches)  # they are read when they have subscribers
        for row, imu in zip(record["imu"], sample.imus, strict=False):
            row[:4], row[4:7], row[7:] = imu.orientation, imu.angular_velocity, imu.linear_acceleration
        for row, wrench in zip(record["wrench"], sample.wrenches, strict=False):
            row[:3], row[3:] = wrench.force, wrench.torque
        count = min(len(sample.contacts), MAX_CONTACTS)
        record["contact_count"] = count
        if count:
            rows = record["contacts"]
            for row, one in zip(rows, sample.contacts, strict=False):
                link = self._link_index.get(one.link, -1)
                row["link"], row["body"], row["distance"] = link, one.body, one.distance
                row["position"], row["force"] = one.position, one.force
        return len(sample.contacts) - count

    def read(self, record: Any) -> RobotSample:
        """The state in a record that has one."""
        joints = JointSample(
            float(record["time"]), self.joints, record["position"], record["velocity"], record["effort"],
            record["contact"],
        )  # fmt: skip
        rows = record["contacts"][: int(record["contact_count"])]
        contacts = tuple(
            Contact(self.actor, self.links[row["link"]] if row["link"] >= 0 else "", int(row["body"]), row["position"],
                    row["force"], float(row["distance"]))
            for row in rows
        )  # fmt: skip
        read = slice(None if record["has_body_sensors"] else 0)
        now, deflection = joints.time, joints.effort / self.series_stiffness
        return RobotSample(
            self.actor, joints, record["base_q"], record["base_qd"], record["odom_q"], record["odom_qd"],
            record["odom_covariance"], self.transforms, record["transform_q"], contacts,
            elements=ElasticSample(
                now, self.joints, self.series_stiffness, joints.position + deflection, deflection, joints.effort
            ),
            wrenches=tuple(
                Wrench(now, name, frame, row[:3], row[3:])
                for (name, frame), row in zip(self._wrenches[read], record["wrench"][read], strict=True)
            ),
            imus=tuple(
                Imu(now, name, frame, row[:4], row[4:7], row[7:])
                for (name, frame), row in zip(self._imus[read], record["imu"][read], strict=True)
            ),
            reference=JointReference(record["desired"], record["desired_velocity"]),
        )  # fmt: skip
