"""What peers ask of the robot: subscriptions whose messages wait as plain values until the client drains them."""

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

WAITING = 64
"""Commands that wait at most; a client that drains once per tick never sees the oldest fall out."""


class Commands:
    """Set points replace each other (only the newest counts), trajectories queue up."""

    def __init__(self, node: rclpy.node.Node, trajectory_controllers: Sequence[str]) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[Command] = deque(maxlen=WAITING)
        self.refused = 0
        """Commands that contradicted themselves."""
        self._listen(node, TwistStamped, "mobile_base_controller/cmd_vel", convert.base_velocity)
        forward = "forward_position_controller"
        take = partial(convert.joint_positions, controller=forward)
        self._listen(node, Float64MultiArray, f"{forward}/commands", take)
        for name in trajectory_controllers:
            take = partial(convert.joint_trajectory, controller=name)
            self._listen(node, JointTrajectoryMessage, f"{name}/joint_trajectory", take)

    def drain(self) -> list[Command]:
        """All that came since the last call, in order of arrival."""
        with self._lock:
            commands = list(self._waiting)
            self._waiting.clear()
        return commands

    def _listen(self, node: rclpy.node.Node, message: type, topic: str, take: Callable[[Any], Command]) -> None:
        node.create_subscription(message, topic, partial(self._receive, take), RELIABLE)

    def _receive(self, take: Callable[[Any], Command], message: Any) -> None:
        try:
            command = take(message)
        except convert.CommandError as error:
            self.refused += 1
            log.warning("refused a command: %s", error)
            return
        with self._lock:
            if not isinstance(command, JointTrajectory):
                for older in [c for c in self._waiting if type(c) is type(command)]:
                    self._waiting.remove(older)
            self._waiting.append(command)
