"""The ROS 2 node of a whole world: publishes clock, robots and true poses of all other objects, and takes no
commands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from vinesim.ros.messages import convert, message_packages
from vinesim.ros.messages.convert import SerializedTransforms
from vinesim.ros.names import ros_name
from vinesim.ros.node import Node
from vinesim.ros.publishers.clock import ClockPublisher
from vinesim.ros.publishers.robot import MAP_FRAME, GroundTruthPublisher
from vinesim.ros.topic import RELIABLE, TRANSIENT_LOCAL, Advertise, PendingMessage
from vinesim.scene.values import RobotSample


class WorldNode(Node):
    """Publishes ``/clock``, ``/tf_environment``, and joint states, frames and description of every robot under the
    robot's name. The thread that calls a ``publish_`` method builds and sends its messages."""

    def __init__(self, name: str) -> None:
        message_packages.ensure_importable(["tf2_msgs"])
        self._robots: dict[str, _ShownRobot] = {}
        super().__init__(name, "", [])

    def _open(self) -> None:
        from tf2_msgs.msg import TFMessage

        self._tf_message = TFMessage
        self._clock = ClockPublisher(self._node, self._advertise, self._withdraw)
        self._ground_truth = GroundTruthPublisher(self._advertise, TFMessage)

    def _look_around(self) -> None:
        self._clock.update()

    def publish_clock(self, time: float) -> None:
        """Publish /clock at ``time`` [s], unless another node publishes this topic."""
        self._send(self._clock.pending(time))

    def publish_robot(
        self, name: str, urdf: str, base: str, static: Sequence[tuple[str, str, np.ndarray]], sample: RobotSample
    ) -> None:
        """Publish a robot's joint states and frames. The first call also publishes the data that never change.

        ``base``: root link, whose parent frame is the map. ``static``: (parent, child, pose [7]) of every fixed joint.
        """
        if name not in self._robots:
            self._robots[name] = _ShownRobot(self._advertise, self._tf_message, ros_name(name), urdf, base, static)
        self._send(self._robots[name].pending(sample))

    def publish_environment(self, time: float, names: tuple[str, ...], poses: np.ndarray) -> None:
        """Publish the true poses [name, 7] m, 1 of moving objects in the map."""
        self._send(self._ground_truth.pending(time, names, poses))

    def publish_environment_static(self, names: tuple[str, ...], poses: np.ndarray) -> None:
        """Publish the true poses [name, 7] m, 1 of static objects in the map, once. Subscribers that join late
        receive them, too."""
        for topic, build in self._ground_truth.pending_static(names, poses):
            topic.build_and_send(build)

    def _send(self, messages: Iterator[PendingMessage]) -> None:
        for topic, build in messages:
            if topic.subscription_count:
                topic.build_and_send(build)


class _ShownRobot:
    """The published topics of one robot, all under its namespace."""

    def __init__(
        self,
        advertise: Advertise,
        tf_message: type,
        namespace: str,
        urdf: str,
        base: str,
        static: Sequence[tuple[str, str, np.ndarray]],
    ) -> None:
        self._base = base
        self._joints = advertise(JointState, f"{namespace}/joint_states", RELIABLE)
        self._tf = advertise(tf_message, f"{namespace}/tf", RELIABLE)
        self._transforms: SerializedTransforms | None = None
        advertise(String, f"{namespace}/robot_description", TRANSIENT_LOCAL).send(String(data=urdf))
        fixed = SerializedTransforms([(parent, child) for parent, child, _ in static])
        poses = np.array([pose for _, _, pose in static]).reshape(-1, 7)
        advertise(tf_message, f"{namespace}/tf_static", TRANSIENT_LOCAL).send(fixed.message(0.0, poses))

    def pending(self, sample: RobotSample) -> Iterator[PendingMessage]:
        yield self._joints, partial(convert.joint_state, sample.joints)
        yield self._tf, partial(self._frames, sample)

    def _frames(self, sample: RobotSample) -> bytes:
        if self._transforms is None:
            self._transforms = SerializedTransforms([(MAP_FRAME, self._base), *sample.transforms])
        poses = np.concatenate([sample.base_q[None], np.reshape(sample.transform_q, (-1, 7))])
        return self._transforms.message(sample.joints.time, poses)
