"""Subscriptions to the robot's command topics; commands are queued as plain values until the client takes them."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import rclpy.node
from geometry_msgs.msg import TwistStamped
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMessage

from vinesim.ros.commands.types import Command, JointTrajectory
from vinesim.ros.messages import convert
from vinesim.ros.topic import RELIABLE

log = logging.getLogger(__name__)

MAX_QUEUED = 64
"""Largest number of queued commands; a client that takes them after every step never loses the oldest."""


class CommandSubscriptions:
    """The queue of commands: a set-point replaces an older one of its kind, trajectories are all kept."""

    def __init__(self, node: rclpy.node.Node, trajectory_controllers: Sequence[str]) -> None:
        self._lock = threading.Lock()
        self._queue: deque[Command] = deque(maxlen=MAX_QUEUED)
        self.rejected = 0
        """Messages that contradicted themselves."""
        self._subscribe(node, TwistStamped, "mobile_base_controller/cmd_vel", convert.base_velocity)
        forward = "forward_position_controller"
        take = partial(convert.joint_positions, controller=forward)
        self._subscribe(node, Float64MultiArray, f"{forward}/commands", take)
        for name in trajectory_controllers:
            take = partial(convert.joint_trajectory, controller=name)
            self._subscribe(node, JointTrajectoryMessage, f"{name}/joint_trajectory", take)

    def drain(self) -> list[Command]:
        """Take all commands that arrived since the last call, in order of arrival."""
        with self._lock:
            commands = list(self._queue)
            self._queue.clear()
        return commands

    def _subscribe(self, node: rclpy.node.Node, message: type, topic: str, take: Callable[[Any], Command]) -> None:
        node.create_subscription(message, topic, partial(self._receive, take), RELIABLE)

    def _receive(self, take: Callable[[Any], Command], message: Any) -> None:
        try:
            command = take(message)
        except convert.CommandError as error:
            self.rejected += 1
            log.warning("refused a command: %s", error)
            return
        with self._lock:
            if not isinstance(command, JointTrajectory):
                for older in [c for c in self._queue if type(c) is type(command)]:
                    self._queue.remove(older)
            self._queue.append(command)
