"""Topics of a robot's state: description, joints, frames, odometry."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from vinesim import frames
from vinesim.ros.messages import convert
from vinesim.ros.messages.transforms import SerializedTransforms
from vinesim.ros.topic import RELIABLE, TRANSIENT_LOCAL, Advertise, PendingMessage
from vinesim.scene.values import RobotSample

MAP_FRAME, ODOM_FRAME = "map", "odom"


class RobotPublisher:
    """robot_description and tf_static once; joint_states, tf and odometry after every step."""

    def __init__(
        self,
        advertise: Advertise,
        tf_message: type,
        urdf: str,
        static_transforms: Sequence[tuple[str, str, np.ndarray]],
        base: str,
    ) -> None:
        self._base = base
        self._pairs: tuple[tuple[str, str], ...] | None = None
        self._transforms = SerializedTransforms([])

        self._joints = advertise(JointState, "joint_states", RELIABLE)
        self._tf = advertise(tf_message, "tf", RELIABLE)
        self._odometry = advertise(Odometry, "mobile_base_controller/odom", RELIABLE)

        advertise(String, "robot_description", TRANSIENT_LOCAL).send(String(data=urdf))
        static = SerializedTransforms([(parent, child) for parent, child, _ in static_transforms])
        poses = np.array([pose for _, _, pose in static_transforms]).reshape(-1, 7)
        advertise(tf_message, "tf_static", TRANSIENT_LOCAL).send(static.message(0.0, poses))

    def pending(self, sample: RobotSample) -> Iterator[PendingMessage]:
        """All messages of one step."""
        yield self._joints, partial(convert.joint_state, sample.joints)
        yield self._tf, partial(self._frames, sample)
        yield self._odometry, partial(convert.odometry, sample, self._base)

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
