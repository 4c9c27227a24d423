"""A robot's ROS 2 node: publishes in threads of its own, so that the simulation never waits.

The simulation passes values and goes on; the node's threads build and publish the messages. Small messages of every
step wait in short queues, of a picture only the newest waits. What finds no place is dropped and counted: a slow
network or subscriber costs messages, not steps. Messages without subscribers are not built, and
:meth:`Node.has_subscribers` lets sensors skip their rendering as well.
"""

from __future__ import annotations

import collections
import logging
import threading
import time as wall
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Self, TypeVar

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.exceptions import NameValidationException
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_namespace import validate_namespace
from rclpy.validate_node_name import validate_node_name
from rclpy.validate_topic_name import validate_topic_name

from vinesim.ros import middleware
from vinesim.ros.commands.subscriptions import CommandSubscriptions
from vinesim.ros.commands.types import Command
from vinesim.ros.messages import convert, message_packages
from vinesim.ros.publishers.camera import CameraPublisher
from vinesim.ros.publishers.clock import ClockPublisher
from vinesim.ros.publishers.ground_truth import GroundTruthPublisher
from vinesim.ros.publishers.lidar import LidarPublisher
from vinesim.ros.publishers.robot import RobotPublisher
from vinesim.ros.topic import RELIABLE, Build, PendingMessage, Topic
from vinesim.scene.values import CameraFrame, CameraOutput, LidarScan, RobotSample

log = logging.getLogger(__name__)

SensorPublisher = TypeVar("SensorPublisher", CameraPublisher, LidarPublisher)

SUBSCRIPTION_COUNT_PERIOD = 0.1
"""Wall time between two counts of subscribers [s]: a new one waits at most that long for its first picture."""

MAX_QUEUED = 50
"""Messages of one topic of every step that may wait, half a second's worth; of a picture only the newest waits."""

PendingMessages = dict[Topic, collections.deque[Build]]
"""Messages that wait to be built and sent, by topic; the topic that comes next is the first."""

TRAJECTORY_CONTROLLERS = ("arm_left_controller", "arm_right_controller", "torso_controller", "head_controller")
"""Names of the controllers that take joint trajectories, as vinebot has them."""


class Node:
    """One robot's topics, under ``namespace``; several may live in one process, each with its own ROS context.

    ``static_transforms`` are (parent, child, pose [7]) of every fixed joint, ``cameras`` and ``lidars`` the names under
    which they publish, ``controllers`` those that take trajectories. All topics but /clock stand under the namespace,
    tf too (as Nav2 does with several robots); a second node in the process should be made with ``clock=False``.

    Raises :class:`middleware.RosUnavailableError`, :class:`message_packages.InterfacesError`, or :class:`ValueError`
    for a name that ROS does not allow; each with one line of text.
    """

    def __init__(
        self,
        name: str,
        urdf: str,
        *,
        namespace: str = "",
        static_transforms: Sequence[tuple[str, str, np.ndarray]] = (),
        cameras: Sequence[str] = (),
        lidars: Sequence[str] = (),
        controllers: Sequence[str] = TRAJECTORY_CONTROLLERS,
        base: str = "base_footprint",
        clock: bool = True,
    ) -> None:
        try:
            validate_node_name(name)
            validate_namespace(f"/{namespace}" if namespace else "/")
            for topic in (*cameras, *lidars, *controllers):
                validate_topic_name(topic)
        except NameValidationException as error:
            # rclpy points at the wrong letter in a second line.
            raise ValueError(" ".join(str(error).replace("^", "").split())) from error
        middleware.configure()
        message_packages.ensure_importable(["tf2_msgs"])
        from tf2_msgs.msg import TFMessage

        self._topics: dict[str, Topic] = {}
        # The messages of every step have a thread of their own, so that no picture delays the clock.
        self._high_priority: PendingMessages = {}
        self._low_priority: PendingMessages = {}
        self._changed = threading.Condition()
        self._closing = False

        self._context = Context()
        # No signal handlers: the client handles SIGINT. No arguments: sys.argv is vinesim's own.
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        try:
            self._node = rclpy.create_node(name, context=self._context, namespace=namespace or None)
            self._clock = ClockPublisher(self._advertise) if clock else None
            self._robot = RobotPublisher(self._advertise, TFMessage, urdf, static_transforms, base)
            self._ground_truth = GroundTruthPublisher(self._advertise, TFMessage)
            self._diagnostics = self._advertise(DiagnosticArray, "diagnostics", RELIABLE)
            self._cameras = {camera: CameraPublisher(self._advertise, camera) for camera in cameras}
            self._lidars = {lidar: LidarPublisher(self._advertise, lidar) for lidar in lidars}
            self._commands = CommandSubscriptions(self._node, controllers)
        except BaseException:
            self._context.shutdown()
            raise
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._threads = [
            threading.Thread(target=self._receive, name=f"ros receive {name}", daemon=True),
            threading.Thread(target=self._send, args=(self._high_priority,), name=f"ros send {name}", daemon=True),
            threading.Thread(target=self._send, args=(self._low_priority,), name=f"ros send large {name}", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    # The simulation calls these; none of them blocks or builds a message.

    def publish_robot_state(self, time: float, sample: RobotSample) -> None:
        """Publish joint states, transforms, odometry, contacts and the clock at ``time`` [s]; for every step."""
        offers = list(self._robot.pending(sample))
        if self._clock is not None:
            offers[:0] = self._clock.pending(time)
        self._enqueue(offers)

    def publish_camera(self, frame: CameraFrame) -> None:
        """Publish one picture of one of ``cameras``; :class:`ValueError` if there is no such camera."""
        self._enqueue(self._publisher(self._cameras, "camera", frame.name).pending(frame))

    def publish_lidar(self, scan: LidarScan) -> None:
        """Publish one revolution of one of ``lidars``; :class:`ValueError` if there is no such lidar."""
        self._enqueue(self._publisher(self._lidars, "lidar", scan.name).pending(scan))

    def publish_environment(self, time: float, names: tuple[str, ...], poses: np.ndarray) -> None:
        """Publish true poses [name, 7] m, 1 in the map of what moves; 10 to 30 Hz will do.

        Pass the same tuple object as long as the names stay: the serialised message is then patched, not built.
        """
        self._enqueue(self._ground_truth.pending(time, names, poses))

    def publish_environment_static(self, names: tuple[str, ...], poses: np.ndarray) -> None:
        """Publish true poses [name, 7] m, 1 in the map of poles, once; late subscribers receive them, too."""
        self._enqueue(self._ground_truth.pending_static(names, poses), always=True)

    def publish_diagnostics(self, time: float, values: Mapping[str, object], *, healthy: bool = True) -> None:
        """Publish statistics of the client; the node adds the messages that it dropped. 1 Hz will do."""
        own = {"ros_dropped": sum(self.dropped.values()), "ros_refused_commands": self._commands.rejected}
        build = partial(convert.diagnostics, time, self._node.get_fully_qualified_name(), {**values, **own}, healthy)
        self._enqueue([(self._diagnostics, build)])

    def commands(self) -> list[Command]:
        """Commands that arrived since the last call, in order."""
        return self._commands.drain()

    def has_subscribers(self, family: str) -> bool:
        """Whether a topic, or one below it, has subscribers: ``"head_front_camera/depth"``, ``"lidar"``, ``"tf"``.

        As counted at most :data:`SUBSCRIPTION_COUNT_PERIOD` ago; :class:`ValueError` if there is no such topic.
        """
        below = family.rstrip("/") + "/"
        topics = [topic for name, topic in self._topics.items() if (name + "/").startswith(below)]
        if not topics:
            raise ValueError(f"no topic {family!r}; there are: {', '.join(sorted(self._topics))}")
        return any(topic.subscription_count for topic in topics)

    def camera_outputs_wanted(self, camera: str) -> CameraOutput:
        """What subscribers need of the frames of one of ``cameras``; :class:`ValueError` if there is no such camera."""
        return self._publisher(self._cameras, "camera", camera).wanted()

    @property
    def sent(self) -> dict[str, int]:
        """Messages sent so far, by topic."""
        return {name: topic.sent for name, topic in self._topics.items()}

    @property
    def dropped(self) -> dict[str, int]:
        """Messages with subscribers that found no place in the queue of their topic, by topic."""
        return {name: topic.dropped for name, topic in self._topics.items()}

    @property
    def has_pending(self) -> bool:
        """Whether any message waits to be sent."""
        return bool(self._high_priority or self._low_priority)

    def close(self) -> None:
        """Leave the ROS graph; returns when the threads have ended. A second call does nothing."""
        with self._changed:
            if self._closing:
                return
            self._closing = True
            self._changed.notify_all()
        self._executor.wake()
        for thread in self._threads:
            thread.join()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _advertise(self, message: type, name: str, qos: QoSProfile = RELIABLE, *, high_priority: bool = False) -> Topic:
        topic = Topic(name, self._node.create_publisher(message, name, qos), high_priority)
        self._topics[name] = topic
        return topic

    def _publisher(self, kinds: Mapping[str, SensorPublisher], kind: str, name: str) -> SensorPublisher:
        if name not in kinds:
            raise ValueError(f"no {kind} {name!r} in this node; it was made with: {', '.join(kinds) or 'none'}")
        return kinds[name]

    def _enqueue(self, offers: Iterable[PendingMessage], *, always: bool = False) -> None:
        with self._changed:
            for topic, build in offers:
                if not topic.subscription_count and not always:
                    continue
                waiting = self._high_priority if topic.high_priority else self._low_priority
                queue = waiting.setdefault(topic, collections.deque())
                queue.append(build)
                if len(queue) > (MAX_QUEUED if topic.high_priority else 1):
                    queue.popleft()
                    topic.dropped += 1
            self._changed.notify_all()

    def _send(self, waiting: PendingMessages) -> None:
        """A publishing thread: builds and sends pending messages, of each topic the oldest, topic after topic."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: waiting or self._closing)
                if self._closing:
                    return
                topic = next(iter(waiting))
                queue = waiting.pop(topic)
                build = queue.popleft()
                if queue:
                    waiting[topic] = queue
            try:
                topic.send(build())
            except Exception:
                topic.dropped += 1
                if topic.dropped == 1:
                    log.exception("could not publish %s; further failures are only counted", topic.name)

    def _receive(self) -> None:
        """The receiving thread: commands, the services that every node has, and counts of subscribers."""
        next_count = 0.0
        while not self._closing and self._context.ok():
            try:
                self._executor.spin_once(timeout_sec=SUBSCRIPTION_COUNT_PERIOD)
            except Exception:
                log.exception("a ROS callback failed; the node goes on")
            if wall.monotonic() >= next_count:
                for topic in self._topics.values():
                    topic.update_subscription_count()
                next_count = wall.monotonic() + SUBSCRIPTION_COUNT_PERIOD
