"""Topics of a robot's state: description, joints, frames, odometry."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from vinesim.core import frames
from vinesim.ros.messages.serialized import joint_state_writer, odometry_writer
from vinesim.ros.messages.transforms import SerializedTransforms
from vinesim.ros.topic import EVERY_STEP, TRANSIENT_LOCAL, Advertise, PendingMessage
from vinesim.scene.values import JointSample, RobotSample

MAP_FRAME = "map"
ODOM_FRAME = "odom"
ODOMETRY = "mobile_base_controller/odom"
"""Topic."""
EXACT_VARIANCE = 1e-6
"""[m2, rad2, m2/s2, rad2/s2] Of exact odometry, as of tracks that do not slip: filters invert covariances."""


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
        self.publishes_map_to_odom = True
        """Whether ``tf`` holds the true pose of ``odom`` in the map, which else a localisation publishes."""
        self.odom_frame = ODOM_FRAME
        """Frame in which odometry measures, on ``tf`` too."""
        self.has_exact_odometry = False
        """Whether odometry measures the motion of the base from now on, without the slip of its tracks."""
        self._odom_q: np.ndarray | None = None
        """Pose [7] of ``odom`` in the map while odometry is exact: that when it became so."""
        self._pairs: tuple[bool, str, tuple[tuple[str, str], ...]] | None = None
        self._transforms = SerializedTransforms([])
        self._names: tuple[str, ...] | None = None
        """Joints of the writers of messages."""
        self._write_joints: Callable[[JointSample], bytes]
        self._write_odometry: Callable[[RobotSample], bytes]
        self._odometry_frame = ""
        """That of :attr:`_write_odometry`."""

        self._joints = advertise(JointState, "joint_states", EVERY_STEP)
        self._tf = advertise(tf_message, "tf", EVERY_STEP)
        self._odometry = advertise(Odometry, ODOMETRY, EVERY_STEP)

        advertise(String, "robot_description", TRANSIENT_LOCAL).send(String(data=urdf))
        static = SerializedTransforms([(parent, child) for parent, child, _ in static_transforms])
        poses = np.array([pose for _, _, pose in static_transforms]).reshape(-1, 7)
        advertise(tf_message, "tf_static", TRANSIENT_LOCAL).send(static.message(0.0, poses))

    def pending(self, sample: RobotSample) -> Iterator[PendingMessage]:
        """All messages of one step."""
        sample = self._with_odometry(sample)
        if sample.joints.names is not self._names:  # the same tuple every step
            self._names = sample.joints.names
            self._write_joints = joint_state_writer(sample.joints)
            self._odometry_frame = ""
        if self._odometry_frame != self.odom_frame:
            self._odometry_frame = self.odom_frame
            self._write_odometry = odometry_writer(sample, self._base, self.odom_frame)
        yield self._joints, partial(self._write_joints, sample.joints)
        yield self._tf, partial(self._frames, sample)
        yield self._odometry, partial(self._write_odometry, sample)

    def _with_odometry(self, sample: RobotSample) -> RobotSample:
        """The sample with the odometry to be published: as it was measured, or exact."""
        if not self.has_exact_odometry:
            self._odom_q = None
            return sample
        base_q = np.asarray(sample.base_q, float)
        base_qd = np.asarray(sample.base_qd, float)
        if self._odom_q is None:
            self._odom_q = frames.compose(base_q, frames.inverse(np.asarray(sample.odom_q, float)))
        to_base = frames.conjugate(base_q[3:])
        return dataclasses.replace(
            sample,
            odom_q=frames.compose(frames.inverse(self._odom_q), base_q),
            odom_qd=np.concatenate([frames.rotate(to_base, base_qd[:3]), frames.rotate(to_base, base_qd[3:])]),
            odom_covariance=np.tile(EXACT_VARIANCE * np.eye(3), (2, 1, 1)),
        )

    def _frames(self, sample: RobotSample) -> bytes:
        has_map = self.publishes_map_to_odom
        names = has_map, self.odom_frame
        if self._pairs is None or self._pairs[:2] != names or self._pairs[2] is not sample.transforms:
            above = [(MAP_FRAME, self.odom_frame)] * has_map
            self._transforms = SerializedTransforms([*above, (self.odom_frame, self._base), *sample.transforms])
            self._pairs = *names, sample.transforms
        base = np.asarray(sample.base_q, float)
        odom = np.asarray(sample.odom_q, float)
        above = [frames.compose(base, frames.inverse(odom))] * has_map
        poses = np.concatenate([[*above, odom], np.reshape(sample.transform_q, (-1, 7))])
        return self._transforms.message(sample.joints.time, poses)
