"""Subscriptions to a robot's command topics. Commands wait in a queue as plain values until the client takes them."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Container, Sequence
from functools import partial
from typing import Any

import rclpy.node
from geometry_msgs.msg import TwistStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, ColorRGBA, Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMessage

from vinesim.ros.commands import convert
from vinesim.ros.commands.types import (
    BaseVelocity,
    Command,
    ElasticCommand,
    ForwardCommand,
    HardwareCommand,
    ImpedanceCommand,
    LightsColor,
    LightsPattern,
    LightsSound,
    PlantWork,
)
from vinesim.ros.topic import RELIABLE
from vinesim.scene.values import FORWARD_KINDS, ControllerKind, ControllerSpec

log = logging.getLogger(__name__)

BASE_COMMAND = "mobile_base_controller/cmd_vel"
"""Topic of velocity commands for the base, relative to the node's namespace."""
MAX_QUEUED = 256
"""Largest number of queued commands. A client that takes commands after every step loses none."""

MAX_LOGGED = 32
"""Largest number of refusal reasons that are logged. It is limited because some reasons contain values and differ
for each message."""


class CommandQueue:
    """Commands that wait for the client. A newer set-point replaces an older one for the same target; trajectories
    and goals are all kept."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._queue: deque[Command] = deque(maxlen=MAX_QUEUED)
        self._logged: set[str] = set()
        """Refusal reasons that were logged already."""
        self.rejected = 0
        """Number of messages and goals that were invalid, or that were dropped unread because the queue was full."""

    def drain(self) -> list[Command]:
        """Take all commands that arrived since the last call, in order of arrival."""
        with self._lock:
            commands = list(self._queue)
            self._queue.clear()
        return commands

    def put(self, command: Command) -> None:
        """Add a command. If it is a set-point, it replaces an older set-point for its target."""
        key = _setpoint_key(command)
        with self._lock:
            if key is not None:
                for older in [c for c in self._queue if _setpoint_key(c) == key]:
                    self._queue.remove(older)
            self.rejected += len(self._queue) == MAX_QUEUED
            self._queue.append(command)

    def refuse(self, error: convert.CommandError) -> None:
        """Count an invalid command. Each reason is logged once."""
        with self._lock:
            self.rejected += 1
        if (reason := str(error)) not in self._logged and len(self._logged) < MAX_LOGGED:
            self._logged.add(reason)
            log.warning("refused a command; further commands refused for this reason are only counted: %s", reason)


def _setpoint_key(command: Command) -> tuple[str, ...] | None:
    """Returns a key that identifies the target of a set-point command. In the queue, a newer command replaces an older
    one with an equal key. None for trajectories and goals, which are all kept."""
    match command:
        case BaseVelocity():
            return ("base",)
        case LightsPattern() | LightsColor() | LightsSound():
            return (type(command).__name__,)
        case ForwardCommand():
            return (command.controller,)
        case ImpedanceCommand():
            return (command.controller, command.what)
        case HardwareCommand():
            return (command.controller, *command.joints)
        case ElasticCommand():
            return (command.controller, command.joint)
    return None


class CommandSubscriptions:
    """Subscriptions to the command topics of the base, lights, loudspeaker and ``controllers`` of a robot.
    ``audio_data``: message type of sound. ``mimics``: names of joints that follow others."""

    def __init__(
        self,
        node: rclpy.node.Node,
        controllers: Sequence[ControllerSpec],
        queue: CommandQueue,
        audio_data: type,
        mimics: Container[str] = (),
    ) -> None:
        self._node = node
        self._mimics = mimics
        self._queue = queue
        self.types: dict[str, str] = {}
        """Accepted message type (``package/msg/Name``) by full name of the topic."""
        self._subscribe(TwistStamped, BASE_COMMAND, convert.base_velocity)
        self._subscribe(String, "plant_work/command", lambda message: PlantWork(message.data.strip()))
        self._subscribe(String, "indicator_lights/command", convert.lights_pattern)
        self._subscribe(ColorRGBA, "indicator_lights/color", convert.lights_color)
        self._subscribe(Bool, "indicator_lights/sound", lambda message: LightsSound(message.data))
        self._subscribe(audio_data, "speaker/audio", convert.loudspeaker_sound)
        for spec in controllers:
            if spec.hardware is None:
                self._subscribe_controller(spec)
            else:
                take = partial(
                    convert.hardware_command,
                    controller=spec.name,
                    joints=spec.joints,
                    mimics=self._mimics,
                    renamed=spec.renamed,
                )
                self._subscribe(JointState, spec.hardware.commands, take)

    def _subscribe_controller(self, spec: ControllerSpec) -> None:
        name = spec.name
        kind = spec.kind
        joints = spec.joints
        if kind is ControllerKind.JOINT_TRAJECTORY:
            take = partial(convert.joint_trajectory, controller=name, known=joints, renamed=spec.renamed)
            self._subscribe(JointTrajectoryMessage, f"{name}/joint_trajectory", take)
        elif kind in FORWARD_KINDS:
            take = partial(convert.forward_command, controller=name, joints=joints)
            self._subscribe(Float64MultiArray, f"{name}/commands", take)
        elif kind is ControllerKind.IMPEDANCE:
            for what in ("stiffness", "damping", "equilibrium"):
                take = partial(convert.impedance_command, controller=name, joints=joints, what=what)
                self._subscribe(Float64MultiArray, f"{name}/{what}", take)
        elif kind is ControllerKind.SERIES_ELASTIC:
            for joint in joints:
                take = partial(convert.elastic_command, controller=name, joint=joint)
                self._subscribe(JointState, f"{name}/{joint}/command", take)

    def _subscribe(self, message: type, topic: str, take: Callable[[Any], Command]) -> None:
        self._node.create_subscription(message, topic, partial(self._receive, take), RELIABLE)
        package = message.__module__.partition(".")[0]
        name = message.__name__
        self.types[self._node.resolve_topic_name(topic)] = f"{package}/msg/{name}"

    def foreign_types(self) -> dict[str, list[str]]:
        """Returns the command topics that other nodes publish with a wrong message type, and these types
        (``package/msg/Name``) by topic.

        DDS does not deliver such messages, and reports no error.
        """
        known = self._node.get_topic_names_and_types()
        return {
            topic: others
            for topic, types in known
            if topic in self.types and (others := sorted(set(types) - {self.types[topic]}))
        }

    def _receive(self, take: Callable[[Any], Command], message: Any) -> None:
        try:
            self._queue.put(take(message))
        except convert.CommandError as error:
            self._queue.refuse(error)
