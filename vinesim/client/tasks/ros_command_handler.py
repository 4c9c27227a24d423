"""Commands from ROS, applied to a robot of this client."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable

from vinesim.robot.control.trajectory_controller import Trajectory, TrajectoryController
from vinesim.robot.drives.commands import CommandError
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.ros.commands.types import BaseVelocity, Command, JointPositions

log = logging.getLogger(__name__)


class RosCommandHandler:
    """Applies commands from ROS to a robot: base velocity, joint positions, trajectories (linear between points)."""

    def __init__(self, robot: Robot, commands: Callable[[], Iterable[Command]]) -> None:
        """``commands`` returns the commands that have arrived since the last call."""
        self.robot = robot
        self.rejected_count = 0
        """Commands that this robot cannot take."""
        self._commands = commands
        self._controllers: dict[str, TrajectoryController] = {}

    def __call__(self, time: float) -> None:
        """Apply the new commands in the step that starts at ``time`` [s], and advance the trajectories."""
        for command in self._commands():
            try:
                self._apply(command, time)
            except CommandError as error:
                self.rejected_count += 1
                if self.rejected_count == 1:
                    log.warning("refused a command, further ones are only counted: %s", error)
        for controller in self._controllers.values():
            controller(time)

    def _apply(self, command: Command, time: float) -> None:
        robot = self.robot
        if isinstance(command, BaseVelocity):
            robot.command_base(float(command.linear[0]), float(command.angular[2]), time)
        elif isinstance(command, JointPositions):
            for controller in self._controllers.values():
                controller.cancel()
            robot.command_position(command.positions)
        else:
            if command.controller not in self._controllers:
                self._controllers[command.controller] = TrajectoryController(robot, robot.description.joints)
            controller = self._controllers[command.controller]
            if len(command.times):
                trajectory = Trajectory(command.joints, command.times, command.positions, start_time=command.time)
                controller.start(trajectory, time)
            else:
                controller.cancel()
