"""The ROS 2 node of a robot: state, transforms, ground truth, diagnostics, commands. Its cameras and lidars have
another node.

The thread that calls a ``publish_`` method builds and sends its messages, in order.
"""

from __future__ import annotations

import logging
import pathlib
import time as wall
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any
from xml.etree import ElementTree

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import String

from vinesim.ros import middleware
from vinesim.ros.commands.actions import ControllerActions
from vinesim.ros.commands.subscriptions import BASE_COMMAND, CommandQueue, CommandSubscriptions
from vinesim.ros.commands.types import Command, GoalResult
from vinesim.ros.messages import convert, message_packages
from vinesim.ros.node import Node
from vinesim.ros.publishers.clock import CLOCK, ClockPublisher
from vinesim.ros.publishers.contacts import ContactPublisher
from vinesim.ros.publishers.lights import LightsPublisher
from vinesim.ros.publishers.robot import (
    ODOM_FRAME,
    ODOMETRY,
    ControlPublisher,
    GroundTruthPublisher,
    ProprioceptionPublisher,
    RobotPublisher,
)
from vinesim.ros.publishers.sound import SoundPublisher
from vinesim.ros.topic import EVERY_STEP, RELIABLE, TRANSIENT_LOCAL, FlowControl, PendingMessage, Topic
from vinesim.scene.values import ComponentStatus, ControllerSpec, HandGestures, Intention, RobotSample
from vinesim.scene.values.signals import Color

log = logging.getLogger(__name__)

FEEDBACK_PERIOD = 5
"""Number of steps between two feedback messages of an action: 20 Hz, as in joint_trajectory_controller."""
MAP_TO_ODOM = "publish_map_to_odom"
"""Name of the parameter that switches the transform from map to odom on ``tf`` on and off."""
TRUTH = "publish_truth"
"""Name of the parameter that switches the topics with ground truth on and off."""
ENVIRONMENT_RATE = "environment_rate"
"""Name of the parameter with the rate of ``tf_environment`` [Hz]."""
EXACT_ODOMETRY = "exact_odometry"
"""Name of the parameter that makes odometry exact."""
ODOM_FRAME_ID = "odom_frame_id"
"""Name of the parameter with the frame id of odometry."""
LOOK_PERIOD = 1.0
"""Wall time between two checks for another robot with the same topics, and for commands with a wrong message type
[s]."""
STAMPED_REMEDY = " (teleop_twist_keyboard: -p stamped:=true; Nav2: enable_stamped_cmd_vel: true)"
"""Hint that is added to the warning about a base command of the wrong message type."""
UNKNOWN = "_NODE_NAME_UNKNOWN_"
"""Name that rmw reports for a node that it has not discovered completely yet."""
OWN_MESSAGES = ("tf2_msgs", "control_msgs", "audio_common_msgs")
"""Message packages that a robot's node needs and that no wheel contains."""


class RobotNode(Node):
    """The node of one robot, with all its topics except those of its cameras and lidars
    (:mod:`vinesim.ros.sensor_node`). All topics but /clock and /diagnostics are in the namespace, tf too (as in Nav2
    with several robots).

    ``static_transforms``: (parent, child, pose [7]) of every fixed joint. ``imus``, ``wrenches``: names of the IMUs and
    of the force-torque sensors. ``bunch_of_body`` [body]: index of the bunch that each plant body belongs to, -1 for
    none. ``interest_radius`` [m]: radius of the area of interest around the robot; None without a server. ``base``:
    root link. ``clock``: whether this node may publish /clock; of all nodes in a ROS domain, one does. ``params_file``,
    ``parameters``: see :class:`Node`.
    """

    def __init__(
        self,
        name: str,
        urdf: str,
        *,
        namespace: str = "",
        static_transforms: Sequence[tuple[str, str, np.ndarray]] = (),
        controllers: Sequence[ControllerSpec] = (),
        imus: Sequence[str] = (),
        wrenches: Sequence[str] = (),
        bunch_of_body: np.ndarray | None = None,
        interest_radius: float | None = None,
        base: str = "base_footprint",
        clock: bool = True,
        params_file: pathlib.Path | None = None,
        parameters: Mapping[str, Any] | None = None,
    ) -> None:
        message_packages.ensure_importable(OWN_MESSAGES)
        self._urdf = urdf
        self._static_transforms = static_transforms
        self._base = base
        self._has_clock = clock
        self._controllers = controllers
        self._imus = imus
        self._wrenches = wrenches
        self._bunch_of_body = np.zeros(0, np.int32) if bunch_of_body is None else bunch_of_body
        self._interest_radius = interest_radius
        self._commands = CommandQueue()
        self._steps = 0
        self._next_look = 0.0
        self._shares_topics = False
        self._foreign_types: dict[str, list[str]] = {}
        self._warned_topics: set[str] = set()
        names = [spec.name for spec in controllers]
        names += [
            topic for spec in controllers if spec.hardware for topic in (spec.hardware.commands, spec.hardware.states)
        ]
        self._flow_control: FlowControl | None = None
        super().__init__(name, namespace, [*names, *imus, *wrenches], params_file, parameters)

    def _open(self) -> None:
        from audio_common_msgs.msg import AudioData
        from tf2_msgs.msg import TFMessage

        self._clock = ClockPublisher(self._node, self._advertise, self._withdraw) if self._has_clock else None
        self._robot = RobotPublisher(self._advertise, TFMessage, self._urdf, self._static_transforms, self._base)
        self._ground_truth = GroundTruthPublisher(self._advertise, TFMessage)
        self._sound = SoundPublisher(self._advertise)
        self._send(self._sound.pending_info(), always=True)
        self._intentions = self._advertise(String, "human_intention", TRANSIENT_LOCAL)
        self._gestures = self._advertise(String, "human_gesture", TRANSIENT_LOCAL)
        self._events = self._advertise(String, "vine/events", EVERY_STEP)
        self._lights = LightsPublisher(self._advertise, self._urdf)
        self._diagnostics = self._advertise(DiagnosticArray, "/diagnostics", RELIABLE)
        self._proprioception = ProprioceptionPublisher(self._advertise, self._imus, self._wrenches)
        self._control = ControlPublisher(self._advertise, self._controllers)
        links = ElementTree.fromstring(self._urdf).iterfind("link")
        numbers = {link.get("name", ""): number for number, link in enumerate(links)}
        self._contacts = ContactPublisher(self._advertise, self._bunch_of_body, numbers, self._interest_radius)
        self._actions = ControllerActions(self._node, self._controllers, self._commands)
        self._subscriptions = CommandSubscriptions(
            self._node, self._controllers, self._commands, AudioData, _mimics(self._urdf)
        )

        if middleware.asks_for_acknowledgements():
            self._flow_control = FlowControl()
        self._declare_parameters()

    def _declare_parameters(self) -> None:
        """Declare the parameters that can be set while the node runs."""
        declare = self._parameters.declare
        declare(
            MAP_TO_ODOM,
            True,
            "Publish the true pose of odom in the map on /tf; false if your own localisation publishes it.",
            changed=self._apply_parameters,
        )
        declare(
            TRUTH,
            True,
            "Publish ground truth: tf_environment, vine/contacts, vine/events, vine/markers.",
            changed=self._apply_parameters,
        )
        declare(
            EXACT_ODOMETRY,
            False,
            "From now on, odometry measures the true motion of the base, without the slip of its tracks.",
            changed=self._apply_parameters,
        )
        declare(
            ODOM_FRAME_ID,
            ODOM_FRAME,
            "Frame id of odometry, also on /tf.",
            changed=self._apply_parameters,
        )
        declare(ENVIRONMENT_RATE, 10.0, "Messages a second of tf_environment [Hz].", (0.1, 50.0))

    def _apply_parameters(self) -> None:
        """Pass the values of the parameters to the publishers."""
        self._robot.publishes_map_to_odom = self._parameters[MAP_TO_ODOM]
        self._robot.has_exact_odometry = self._parameters[EXACT_ODOMETRY]
        self._robot.odom_frame = self._parameters[ODOM_FRAME_ID]
        for publisher in (self._ground_truth, self._contacts, self._events):
            publisher.mute(not self._parameters[TRUTH])

    @property
    def environment_rate(self) -> float:
        """Rate at which :meth:`publish_environment` is to be called [Hz]."""
        return self._parameters[ENVIRONMENT_RATE]

    def has_subscribers(self, family: str) -> bool:
        return self.has_clock_subscribers if family == CLOCK else super().has_subscribers(family)

    @property
    def has_clock_subscribers(self) -> bool:
        """Whether this node publishes /clock, and the topic has subscribers."""
        return self._clock is not None and self._clock.has_subscribers

    def _look_around(self) -> None:
        if self._clock is not None:
            self._clock.update()
        if wall.monotonic() >= self._next_look:
            self._next_look = wall.monotonic() + LOOK_PERIOD
            self._locate_subscribers()
            if not self._shares_topics:
                self._warn_if_shared()
            self._warn_of_types()

    def _locate_subscribers(self) -> None:
        """Find out, for each topic that is published in every step, whether all its subscribers are on this machine.

        The first four bytes of a Fast DDS identifier are the vendor and the machine, two bytes each.
        """
        for topic in self._topics_of_every_step():
            name = self._node.resolve_topic_name(topic.name)
            own, others = (
                {tuple(one.endpoint_gid[:4]) for one in found}
                for found in (
                    self._node.get_publishers_info_by_topic(name),
                    self._node.get_subscriptions_info_by_topic(name),
                )
            )
            topic.is_local = others <= own

    def _topics_of_every_step(self) -> list[Topic]:
        return [topic for topic in list(self._topics.values()) if topic.is_of_every_step]

    def _warn_if_shared(self) -> None:
        """Warn once if another node publishes the same odometry topic, so that two robots share their names."""
        own = self._node.get_fully_qualified_name()
        topic = self._node.resolve_topic_name(ODOMETRY)
        publishers = self._node.get_publishers_info_by_topic(topic)
        nodes = {f"{one.node_namespace.rstrip('/')}/{one.node_name}" for one in publishers if one.node_name != UNKNOWN}
        if others := nodes - {own}:
            self._shares_topics = True
            log.warning(
                "%s and %s publish %s: frames, joints and commands of two robots mix; give each client its own "
                "--namespace",
                own,
                ", ".join(sorted(others)),
                topic,
            )

    def _warn_of_types(self) -> None:
        """Warn once for each command topic that another node publishes with a message type that this robot does not
        receive."""
        self._foreign_types = self._subscriptions.foreign_types()
        for topic, types in self._foreign_types.items():
            if topic not in self._warned_topics:
                self._warned_topics.add(topic)
                is_base = topic.endswith(BASE_COMMAND)
                log.warning(
                    "%s is published as %s, which this robot cannot receive; publish %s%s",
                    topic,
                    ", ".join(types),
                    self._subscriptions.types[topic],
                    STAMPED_REMEDY if is_base else "",
                )

    def must_wait(self, now: float) -> bool:
        """Returns whether publishing must wait at ``now`` [s] because subscribers have not caught up; see
        :class:`FlowControl`. Returns False if the middleware does not report acknowledgements often enough."""
        return self._flow_control is not None and self._flow_control.must_wait(self._topics_of_every_step(), now)

    def publish_clock(self, time: float) -> None:
        """Publish /clock at ``time`` [s], if this node is the one that publishes it. Call this in every step."""
        if self._clock is not None:
            self._send(self._clock.pending(time))

    def publish_robot_state(self, sample: RobotSample) -> None:
        """Publish joint states, transforms, odometry, IMUs, wrenches, controller states and contacts. Call this in
        every step."""
        self._send(self._robot.pending(sample))
        self._send(self._proprioception.pending(sample))
        self._send(self._control.pending(sample))
        self._send(self._contacts.pending(sample))
        self._steps += 1
        if self._steps % FEEDBACK_PERIOD == 0 and sample.reference is not None:
            self._actions.publish_feedback(sample)

    def publish_environment(self, time: float, names: tuple[str, ...], poses: np.ndarray) -> None:
        """Publish the true poses [name, 7] m, 1 of moving objects in the map. Call this at :attr:`environment_rate`.

        Pass the same tuple object as long as the names stay the same: then only the numbers in the serialised message
        are replaced.
        """
        self._send(self._ground_truth.pending(time, names, poses))

    def publish_environment_static(self, names: tuple[str, ...], poses: np.ndarray) -> None:
        """Publish the true poses [name, 7] m, 1 of poles in the map, once. Subscribers that join late receive them,
        too."""
        self._send(self._ground_truth.pending_static(names, poses), always=True)

    def publish_intentions(self, intentions: Sequence[Intention]) -> None:
        """Publish the intentions of people; call this when they change. Subscribers that join late receive the last
        message."""
        self._send([(self._intentions, lambda: convert.intentions(intentions))], always=True)

    def publish_gestures(self, time: float, gestures: Sequence[HandGestures]) -> None:
        """Publish the gestures that the hands of people show since ``time`` of the world [s]. Subscribers that join
        late receive the last message."""
        self._send([(self._gestures, lambda: convert.gestures(time, gestures))], always=True)

    def publish_events(self, time: float, events: Sequence[Mapping[str, Any]]) -> None:
        """Publish what happened to plants and fruit in a step that ended at ``time`` of the world [s], one message for
        each event."""
        self._send([(self._events, partial(convert.event, time, event)) for event in events])

    def publish_lights(self, color: Color | None) -> None:
        """Publish the colour of the indicator lights; call this when it changes. ``color`` is UNLIT between flashes,
        and None when the lights are off."""
        self._send(self._lights.pending(color), always=True)

    def publish_sound(self, time: float, pcm: bytes) -> None:
        """Publish sound of the microphone that begins at ``time`` of the world [s]. ``pcm``: PCM16 of 16 kHz, mono."""
        self._send(self._sound.pending(time, pcm))

    def publish_diagnostics(self, time: float, components: Sequence[ComponentStatus]) -> None:
        """Publish the states of the client's ``components`` and of this node. Call this about once a second."""
        own = {"refused_commands": self.refused_commands}
        prefix = self._node.get_fully_qualified_name()
        trouble = [f"{topic} is published as {', '.join(types)}" for topic, types in self._foreign_types.items()]
        level = "warning" if trouble else "ok"
        statuses = [*components, ComponentStatus("ros", level, "; ".join(trouble) or "well", own)]
        self._send([(self._diagnostics, lambda: convert.diagnostics(time, prefix, statuses))])

    def commands(self) -> list[Command]:
        """Returns the commands that arrived since the last call, in order of arrival."""
        return self._commands.drain()

    @property
    def refused_commands(self) -> int:
        """Number of messages and goals that were invalid, or that were dropped unread because the queue was full."""
        return self._commands.rejected

    @property
    def has_goals(self) -> bool:
        """Whether goals of actions are being executed. Their clients expect feedback."""
        return bool(self._actions.goals)

    def finish_goal(self, result: GoalResult) -> None:
        """Send the result of a goal to its action client."""
        self._actions.finish(result)

    def _send(self, messages: Iterable[PendingMessage], *, always: bool = False) -> None:
        for topic, build in messages:
            if topic.subscription_count or always:
                topic.build_and_send(build)


def _mimics(urdf: str) -> frozenset[str]:
    """Returns the names of the joints of a URDF that follow other joints."""
    joints = ElementTree.fromstring(urdf).iterfind("joint")
    return frozenset(joint.get("name", "") for joint in joints if joint.find("mimic") is not None)
