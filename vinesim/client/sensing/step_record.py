"""A robot's state after one step as a record of fixed size, for the queue to its ROS process."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinesim.scene.values import Contact, JointSample, RobotSample

if TYPE_CHECKING:
    from vinesim.robot.description.description import RobotDescription

MAX_CONTACTS = 32
"""Contacts of one robot that a record holds; further ones of the same step are left out and counted."""

_CONTACT = np.dtype([("link", "i4"), ("body", "i4"), ("position", "f8", 3), ("force", "f8", 3), ("distance", "f8")])


class StepRecords:
    """The layout of the records of one robot; constant, small, and the same in both processes."""

    def __init__(self, actor: str, description: RobotDescription) -> None:
        self.actor = actor
        self.joints = description.joints
        self.transforms = tuple(description.moving_joints.frames)
        self.links = tuple(f"{actor}/{link}" for link in description.link_anchors)
        self._link_index = {link: i for i, link in enumerate(self.links)}
        joints, transforms = len(self.joints), len(self.transforms)
        self.dtype = np.dtype(
            [
                ("time", "f8"), ("has_state", "?"), ("contact_count", "i4"),
                *((name, "f8", (joints,)) for name in ("position", "velocity", "effort", "contact")),
                ("base_q", "f8", (7,)), ("base_qd", "f8", (6,)), ("odom_q", "f8", (7,)),
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
        record["transform_q"] = sample.transform_q
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
        return RobotSample(
            self.actor, joints, record["base_q"], record["base_qd"], record["odom_q"], self.transforms,
            record["transform_q"], contacts,
        )  # fmt: skip
