"""A robot's state after one step as a record of fixed size, for the queue to its ROS process."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from vinesim.scene.values import Contact, ElasticSample, Imu, JointReference, JointSample, RobotSample, Wrench

if TYPE_CHECKING:
    from vinesim.robot.description.description import RobotDescription

MAX_CONTACTS = 32
"""Largest number of contacts in a record. Further contacts of the same step are left out and counted."""

_CONTACT = np.dtype([("link", "i4"), ("body", "i4"), ("position", "f8", 3), ("force", "f8", 3), ("distance", "f8")])


class StepRecords:
    """Layout of the records of one robot. It does not change, so client and process each have a copy."""

    def __init__(self, actor: str, description: RobotDescription, series_stiffness: np.ndarray) -> None:
        """``actor``: name of the robot. ``series_stiffness``: [joint] stiffness of the series elastic elements [N m/rad
        or N/m]."""
        self.actor = actor
        self.joints = description.joints
        self.transforms = tuple(description.moving_joints.frames)
        self.links = tuple(f"{actor}/{link}" for link in description.link_anchors)
        self._link_index = {link: i for i, link in enumerate(self.links)}
        self.series_stiffness = series_stiffness
        self._imus = tuple((mount.name, mount.frame) for mount in description.imus)
        self._wrenches = tuple((mount.name, mount.frame) for mount in description.wrenches)
        self._moving = description.moving_joints
        self._is_free = description.base_limits.kind == "free"
        joints = len(self.joints)
        imus = len(self._imus)
        wrenches = len(self._wrenches)
        shapes = (
            *(((joints,),) * 6),
            (7,),
            (6,),
            (7,),
            (6,),
            (2, 3, 3),
            *(((10,),) * imus),
            *(((6,),) * wrenches),
        )
        ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()
        self._parts = tuple((slice(e - math.prod(shape), e), shape) for e, shape in zip(ends, shapes, strict=True))
        """Slice of ``state`` and shape of each part of the state, in the order in which :meth:`write` stores them."""
        self._body_sensors_start = ends[10]
        self.dtype = np.dtype(
            [
                ("time", "f8"),
                ("has_state", "?"),
                ("has_body_sensors", "?"),
                ("contact_count", "i4"),
                ("state", "f8", (ends[-1],)),
                ("contacts", _CONTACT, (MAX_CONTACTS,)),
            ]
        )

    def write(self, record: Any, time: float, sample: RobotSample | None) -> int:
        """Fill a record with the ``time`` [s] and, unless ``sample`` is None, the state. Returns the number of contacts
        left out.

        Transforms and elastic elements are not stored: :meth:`read` computes them from the joints.
        """
        record["time"], record["has_state"] = time, sample is not None
        if sample is None:
            return 0
        joints = sample.joints
        desired: JointSample | JointReference = joints if sample.reference is None else sample.reference
        parts = [
            joints.position,
            joints.velocity,
            joints.effort,
            joints.contact,
            desired.position,
            desired.velocity,
            sample.base_q,
            sample.base_qd,
            sample.odom_q,
            sample.odom_qd,
            sample.odom_covariance.ravel(),
        ]
        has_body_sensors = bool(sample.imus or sample.wrenches)  # measured only while they have subscribers
        if has_body_sensors:
            for imu in sample.imus:
                parts += imu.orientation, imu.angular_velocity, imu.linear_acceleration
            for wrench in sample.wrenches:
                parts += wrench.force, wrench.torque
        state = record["state"]
        np.concatenate(parts, out=state if has_body_sensors else state[: self._body_sensors_start])
        record["has_body_sensors"] = has_body_sensors
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
        """Returns the state in a record. The record must have a state."""
        now = float(record["time"])
        state = record["state"]
        parts = [state[place].reshape(shape) for place, shape in self._parts]
        position, velocity, effort, contact, desired, desired_velocity = parts[:6]
        base_q, base_qd, odom_q, odom_qd, covariance = parts[6:11]
        joints = JointSample(now, self.joints, position, velocity, effort, contact)
        rows = record["contacts"][: int(record["contact_count"])]
        contacts = tuple(
            Contact(
                self.actor,
                self.links[row["link"]] if row["link"] >= 0 else "",
                int(row["body"]),
                row["position"],
                row["force"],
                float(row["distance"]),
            )
            for row in rows
        )
        first_wrench = 11 + len(self._imus)
        imus = parts[11:first_wrench]
        wrenches = parts[first_wrench:]
        read = slice(None if record["has_body_sensors"] else 0)
        deflection = effort / self.series_stiffness
        return RobotSample(
            self.actor,
            joints,
            base_q,
            base_qd,
            odom_q,
            odom_qd,
            covariance,
            self.transforms,
            self._moving.poses(position),
            contacts,
            elements=ElasticSample(now, self.joints, self.series_stiffness, position + deflection, deflection, effort),
            wrenches=tuple(
                Wrench(now, name, frame, row[:3], row[3:])
                for (name, frame), row in zip(self._wrenches[read], wrenches[read], strict=True)
            ),
            imus=tuple(
                Imu(now, name, frame, row[:4], row[4:7], row[7:])
                for (name, frame), row in zip(self._imus[read], imus[read], strict=True)
            ),
            reference=JointReference(desired, desired_velocity),
            odom_is_spatial=self._is_free,
        )
