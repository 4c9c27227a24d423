"""Topics of a robot's state: description, joints, frames, odometry, contacts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from vinesim import frames
from vinesim.ros.messages import convert
from vinesim.ros.messages.transforms import SerializedTransforms
from vinesim.ros.topic import RELIABLE, TRANSFORMS, TRANSIENT_LOCAL, Advertise, PendingMessage
from vinesim.scene.values import Contact, RobotSample

MAP_FRAME, ODOM_FRAME = "map", "odom"

FrameTree = dict[str, tuple[str, np.ndarray]]
"""Parent and pose [7] in the parent, by child frame."""


class RobotPublisher:
    """robot_description and tf_static once; joint_states, tf, odometry and contacts after every step."""

    def __init__(
        self,
        advertise: Advertise,
        tf_message: type,
        urdf: str,
        static_transforms: Sequence[tuple[str, str, np.ndarray]],
        base: str,
    ) -> None:
        self._base = base
        self._fixed: FrameTree = {child: (parent, np.asarray(pose, float)) for parent, child, pose in static_transforms}
        self._pairs: tuple[tuple[str, str], ...] | None = None
        self._transforms = SerializedTransforms([])

        self._joints = advertise(JointState, "joint_states", RELIABLE)
        self._tf = advertise(tf_message, "tf", TRANSFORMS)
        self._odometry = advertise(Odometry, "mobile_base_controller/odom", RELIABLE)
        self._contacts = advertise(WrenchStamped, "vine/contacts", RELIABLE)

        advertise(String, "robot_description", TRANSIENT_LOCAL).send(String(data=urdf))
        static = SerializedTransforms([(parent, child) for child, (parent, _) in self._fixed.items()])
        poses = np.array([pose for _, pose in self._fixed.values()]).reshape(-1, 7)
        advertise(tf_message, "tf_static", TRANSIENT_LOCAL).send(static.message(0.0, poses))

    def pending(self, sample: RobotSample) -> Iterator[PendingMessage]:
        """All messages of one step."""
        yield self._joints, partial(convert.joint_state, sample.joints)
        yield self._tf, partial(self._frames, sample)
        yield self._odometry, partial(convert.odometry, sample, self._base)
        if sample.contacts:
            yield self._contacts, partial(self._wrenches, sample)

    def _frames(self, sample: RobotSample) -> bytes:
        if sample.transforms is not self._pairs:
            self._transforms = SerializedTransforms(
                [(MAP_FRAME, ODOM_FRAME), (ODOM_FRAME, self._base), *sample.transforms]
            )
            self._pairs = sample.transforms
        base, odom = np.asarray(sample.base_q, float), np.asarray(sample.odom_q, float)
        drift = frames.compose(base, frames.inverse(odom))
        poses = np.concatenate([[drift, odom], np.reshape(sample.transform_q, (-1, 7))])
        return self._transforms.message(sample.joints.time, poses)

    def _wrenches(self, sample: RobotSample) -> list[WrenchStamped]:
        moving = zip(sample.transforms, sample.transform_q, strict=True)
        joints = self._fixed | {child: (parent, pose) for (parent, child), pose in moving}
        return [self._wrench(sample, contact, joints) for contact in sample.contacts]

    def _wrench(self, sample: RobotSample, contact: Contact, joints: FrameTree) -> WrenchStamped:
        """One contact in the frame of the touching link, or in the map if no frame has the link's name."""
        link = contact.link.removeprefix(f"{sample.actor}/")
        in_base = pose_in_base(link, joints, self._base)
        if in_base is None:
            return convert.wrench(contact, sample.joints.time, MAP_FRAME, frames.pose(np.zeros(3)))
        return convert.wrench(
            contact, sample.joints.time, link, frames.compose(np.asarray(sample.base_q, float), in_base)
        )


def pose_in_base(link: str, joints: FrameTree, base: str) -> np.ndarray | None:
    """Pose [7] m, 1 of a link in the base, by the chain of joints; None if the chain does not end at the base."""
    pose = frames.pose(np.zeros(3))
    for _ in range(len(joints) + 1):
        if link == base:
            return pose
        if link not in joints:
            return None
        link, joint_q = joints[link]
        pose = frames.compose(np.asarray(joint_q, float), pose)
    return None
