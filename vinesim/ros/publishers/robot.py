"""Topics of a robot's state: description, joints, transforms, odometry, IMUs, wrenches and controllers; and true
poses of other objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String

from vinesim.core import frames
from vinesim.ros.messages import convert
from vinesim.ros.messages.convert import (
    SerializedTransforms,
    imu_writer,
    joint_state_writer,
    odometry_writer,
    wrench_writer,
)
from vinesim.ros.topic import EVERY_STEP, RELIABLE, TRANSIENT_LOCAL, Advertise, PendingMessage
from vinesim.scene.values import ControllerKind, ControllerSpec, JointSample, RobotSample

MAP_FRAME = "map"
ODOM_FRAME = "odom"
ODOMETRY = "mobile_base_controller/odom"
"""Topic of odometry, relative to the node's namespace."""
EXACT_VARIANCE = 1e-6
"""[m2, rad2, m2/s2, rad2/s2] Variances of exact odometry, as of tracks without slip. They are not 0 because filters
invert covariances."""


class RobotPublisher:
    """Publishes robot_description and tf_static once, and joint_states, tf and odometry after every step."""

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
        """Whether ``tf`` contains the true pose of ``odom`` in the map. If not, a localisation node is to publish
        this transform."""
        self.odom_frame = ODOM_FRAME
        """Frame id of odometry, also on ``tf``."""
        self.has_exact_odometry = False
        """Whether odometry measures the true motion of the base, without the slip of its tracks, from the moment
        this is set."""
        self._odom_q: np.ndarray | None = None
        """Pose [7] of ``odom`` in the map when odometry became exact; None while odometry is not exact."""
        self._pairs: tuple[bool, str, tuple[tuple[str, str], ...]] | None = None
        self._transforms = SerializedTransforms([])
        self._names: tuple[str, ...] | None = None
        """Joint names for which :attr:`_write_joints` was made."""
        self._write_joints: Callable[[JointSample], bytes]
        self._write_odometry: Callable[[RobotSample], bytes]
        self._odometry_frame = ""
        """Frame id for which :attr:`_write_odometry` was made."""

        self._joints = advertise(JointState, "joint_states", EVERY_STEP)
        self._tf = advertise(tf_message, "tf", EVERY_STEP)
        self._odometry = advertise(Odometry, ODOMETRY, EVERY_STEP)

        advertise(String, "robot_description", TRANSIENT_LOCAL).send(String(data=urdf))
        static = SerializedTransforms([(parent, child) for parent, child, _ in static_transforms])
        poses = np.array([pose for _, _, pose in static_transforms]).reshape(-1, 7)
        advertise(tf_message, "tf_static", TRANSIENT_LOCAL).send(static.message(0.0, poses))

    def pending(self, sample: RobotSample) -> Iterator[PendingMessage]:
        """Yield the messages of one step."""
        sample = self._with_odometry(sample)
        if sample.joints.names is not self._names:  # samples of one robot share this tuple
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
        """Returns the sample with the odometry to publish: as measured, or exact."""
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
        """Returns the serialised ``tf`` message of one step."""
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


# Topics with true poses of objects other than the robot.


class GroundTruthPublisher:
    """Publishes true poses in the map: ``tf_environment`` for moving objects and ``tf_environment_static`` for
    poles."""

    def __init__(self, advertise: Advertise, tf_message: type) -> None:
        self._moving = advertise(tf_message, "tf_environment", RELIABLE)
        self._static = advertise(tf_message, "tf_environment_static", TRANSIENT_LOCAL)
        self._poles: tuple[Sequence[str], np.ndarray] = (), np.zeros((0, 7))
        self._names: Sequence[str] | None = None
        self._transforms = SerializedTransforms([])
        self._is_muted = False

    def pending(self, time: float, names: tuple[str, ...], poses: np.ndarray) -> Iterator[PendingMessage]:
        """Yield the message with true poses [name, 7] m, 1 of moving objects. Pass the same tuple object as long as
        the names stay the same: then only the numbers in the serialised message are replaced."""
        yield self._moving, partial(self._message, time, names, poses)

    def pending_static(self, names: tuple[str, ...], poses: np.ndarray) -> Iterator[PendingMessage]:
        """Yield the message with true poses [name, 7] m, 1 of static objects."""
        self._poles = names, poses
        yield self._static, self._static_message

    def mute(self, is_muted: bool) -> None:
        """Stop sending if ``is_muted``, otherwise resume. While muted, subscribers that join late receive an empty
        message on ``tf_environment_static``."""
        self._is_muted = is_muted
        self._moving.mute(is_muted)
        self._static.send(self._static_message())

    def _static_message(self) -> bytes:
        names, poses = ((), np.zeros((0, 7))) if self._is_muted else self._poles
        return SerializedTransforms([(MAP_FRAME, name) for name in names]).message(0.0, poses)

    def _message(self, time: float, names: tuple[str, ...], poses: np.ndarray) -> bytes:
        if names is not self._names:
            self._transforms = SerializedTransforms([(MAP_FRAME, name) for name in names])
            self._names = names
        return self._transforms.message(time, poses)


# Topics of a robot's inertial measurement units and force-torque sensors.


class ProprioceptionPublisher:
    """Publishes ``<imu>`` and ``<sensor>/wrench`` after every step, for the IMUs and force-torque sensors that are
    listed."""

    def __init__(self, advertise: Advertise, imus: Sequence[str], wrenches: Sequence[str]) -> None:
        self._imus = {name: advertise(Imu, name, EVERY_STEP) for name in imus}
        self._wrenches = {name: advertise(WrenchStamped, f"{name}/wrench", EVERY_STEP) for name in wrenches}
        self._writers: dict[str, Callable[[Any], bytes]] = {}
        """Function that serialises the readings of a sensor, by name; made at the sensor's first reading."""

    def pending(self, sample: RobotSample) -> Iterator[PendingMessage]:
        """Yield the messages of one step."""
        for imu in sample.imus:
            if imu.name in self._imus:
                yield self._imus[imu.name], partial(self._write, imu_writer, imu)
        for wrench in sample.wrenches:
            if wrench.name in self._wrenches:
                yield self._wrenches[wrench.name], partial(self._write, wrench_writer, wrench)

    def _write(self, writer: Callable[[Any], Callable[[Any], bytes]], reading: Any) -> bytes:
        """Returns the serialised message of a reading. ``writer`` makes the function that serialises the readings of
        this sensor."""
        if reading.name not in self._writers:
            self._writers[reading.name] = writer(reading)
        return self._writers[reading.name](reading)


# Topics of a robot's controllers: their states, and the series elastic elements of joints (CANOPIES D6.4, 3.1).


STATE_PERIOD = 2
"""Number of steps between two state messages of a trajectory controller: 50 Hz, the default of
joint_trajectory_controller."""


class ControlPublisher:
    """Publishes ``<controller>/controller_state`` in every second step, and in every step ``see/<joint>/state`` and the
    joint states for other controller managers."""

    def __init__(self, advertise: Advertise, controllers: Sequence[ControllerSpec]) -> None:
        from control_msgs.msg import JointTrajectoryControllerState

        self._state_type = JointTrajectoryControllerState
        self._states = [
            (spec.joints, advertise(JointTrajectoryControllerState, f"{spec.name}/controller_state", EVERY_STEP))
            for spec in controllers
            if spec.kind is ControllerKind.JOINT_TRAJECTORY
        ]
        self._elements = [
            (joint, advertise(JointState, f"{spec.name}/{joint}/state", EVERY_STEP))
            for spec in controllers
            if spec.kind is ControllerKind.SERIES_ELASTIC
            for joint in spec.joints
        ]
        self._hardware = [
            (spec.joints, advertise(JointState, spec.hardware.states, EVERY_STEP))
            for spec in controllers
            if spec.hardware is not None
        ]
        self._names: tuple[str, ...] | None = None
        self._places: dict[str, int] = {}
        """Index of each joint in the arrays of the samples, by name."""
        self._selections: list[tuple[np.ndarray, Callable[[JointSample], bytes]]] = []
        """Indices of the joints of each topic of :attr:`_hardware`, and the function that serialises their state."""
        self._steps = 0

    def pending(self, sample: RobotSample) -> Iterator[PendingMessage]:
        """Yield the messages of one step."""
        if sample.joints.names is not self._names:  # samples of one robot share this tuple
            self._names = sample.joints.names
            self._places = {name: i for i, name in enumerate(self._names)}
            places = [np.array([self._places[joint] for joint in joints]) for joints, _ in self._hardware]
            self._selections = [(one, joint_state_writer(_selected(sample.joints, one))) for one in places]
        self._steps += 1
        if sample.reference is not None and self._steps % STATE_PERIOD == 0:
            for joints, topic in self._states:
                yield topic, partial(self._state, sample, joints, np.array([self._places[joint] for joint in joints]))
        if sample.elements is not None:
            for joint, topic in self._elements:
                yield topic, partial(convert.elastic_state, sample.elements, self._places[joint])
        for (_, topic), (places, write) in zip(self._hardware, self._selections, strict=True):
            yield topic, lambda write=write, places=places: write(_selected(sample.joints, places))

    def _state(self, sample: RobotSample, joints: tuple[str, ...], places: np.ndarray) -> Any:
        points = convert.reference_points(sample, places)
        return self._state_type(
            header=convert.header(sample.joints.time, ""),
            joint_names=list(joints),
            reference=points["desired"],
            feedback=points["actual"],
            error=points["error"],
        )


def _selected(sample: JointSample, places: np.ndarray) -> JointSample:
    """Returns the states of the joints at ``places`` (indices) of a sample."""
    return JointSample(
        sample.time,
        tuple(sample.names[place] for place in places),
        sample.position[places],
        sample.velocity[places],
        sample.effort[places],
        sample.contact[places],
    )
