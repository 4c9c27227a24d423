"""Applies commands from ROS to a robot of this client."""

from __future__ import annotations

import dataclasses
import logging
import re
from collections.abc import Callable, Iterable

from vinesim.client.world_time import WorldTime
from vinesim.robot.control import controller_manager
from vinesim.robot.control.controller_manager import ControllerManager
from vinesim.robot.control.trajectory_controller import Outcome, Tolerance, Trajectory
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.ros.commands.types import (
    BaseVelocity,
    CancelGoal,
    Command,
    ElasticCommand,
    ForwardCommand,
    GoalResult,
    GoalStatus,
    GripperGoal,
    HardwareCommand,
    ImpedanceCommand,
    JointTolerances,
    JointTrajectory,
    LightsColor,
    LightsPattern,
    LightsSound,
    LoudspeakerSound,
    PlantWork,
)

log = logging.getLogger(__name__)

MAX_LOGGED = 32
"""Largest number of kinds of refusals in the log. It is limited because some reasons contain text from the sender."""

_NUMBER = r"(?<![\w.])[-+]?(?:\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|nan|inf)(?!\w)"
_NUMBERS = re.compile(rf"{_NUMBER}(?:,? {_NUMBER})*")
"""Numbers in a reason, except those in joint names; they are values that differ with each command."""

_STATUS = {Outcome.SUCCESSFUL: GoalStatus.SUCCEEDED, Outcome.CANCELED: GoalStatus.CANCELED}


class RosCommandHandler:
    """Applies commands from ROS to a robot through the robot's controllers."""

    def __init__(
        self,
        robot: Robot,
        commands: Callable[[], Iterable[Command]],
        finish: Callable[[GoalResult], None] = lambda _: None,
        world_time: WorldTime | None = None,
        play: Callable[[bytes], None] = lambda _: None,
    ) -> None:
        """``commands`` returns the commands that have arrived since the last call; ``finish`` is called with each ended
        goal.

        ``world_time``: the time in which commands are stamped; by default simulated time. ``play``: is called with
        PCM16 for the loudspeaker.
        """
        self.robot = robot
        self.controllers = ControllerManager(robot)
        self.rejected_count = 0
        """Number of commands that this robot cannot execute."""
        self._logged: set[tuple[str, str]] = set()
        """Kinds of refusals that have been logged."""
        self._lights_color: tuple[float, float, float] | None = None
        """Colour of the indicator lights; None: the colour of the pattern."""
        self._commands = commands
        self._finish = finish
        self._world_time = world_time
        self._play = play

    def __call__(self, time: float) -> None:
        """Apply the new commands in the step that starts at ``time`` [s], and advance the controllers."""
        for command in self._commands():
            try:
                self._apply(command, time)
            except CommandError as error:
                self._refuse(command, error)
        self.controllers(time)
        for result in self.controllers.take_results():
            self._finish(_goal_result(result))

    def _refuse(self, command: Command, error: CommandError) -> None:
        """Count a command that this robot cannot execute, and log each kind of refusal once.

        A kind is the controller (or the command's type if it has no controller) with the reason without its numbers.
        """
        self.rejected_count += 1
        sender = getattr(command, "controller", type(command).__name__)
        kind = sender, _NUMBERS.sub("#", str(error))
        if kind not in self._logged and len(self._logged) < MAX_LOGGED:
            self._logged.add(kind)
            log.warning("refused a command of %s, further ones of this kind are only counted: %s", sender, error)

    def cancel_all(self, time: float) -> None:
        """Cancel all goals because the process that serves them has ended."""
        self.controllers.cancel_all(time)
        self.controllers.take_results()

    def begin_anew(self, robot: Robot) -> None:
        """Abort all goals. From this call on, command ``robot``, which has replaced the former robot after a reset."""
        self.controllers.abort_all("the simulation was reset")
        for result in self.controllers.take_results():
            self._finish(_goal_result(result))
        self.robot = robot
        self.controllers = ControllerManager(robot)

    def _apply(self, command: Command, time: float) -> None:
        controllers = self.controllers
        match command:
            case BaseVelocity():
                self.robot.command_base(float(command.linear[0]), float(command.angular[2]), time)
            case ForwardCommand():
                controllers.forward(command.controller, command.values)
            case HardwareCommand():
                values = command.position, command.velocity, command.effort
                controllers.command_hardware(command.controller, command.joints, *values, time)
            case ImpedanceCommand():
                controllers.command_impedance(command.controller, command.what, command.values)
            case ElasticCommand():
                controllers.command_motor(command.controller, command.joint, command.position)
            case GripperGoal():
                controllers.start_gripper(command.controller, command.position, command.max_effort, time, command.goal)
            case PlantWork():
                log.info("%s %s", self.robot.name, self.robot.work_on_plant(command.what))
            case CancelGoal():
                controllers.cancel(command.goal, time)
            case LightsSound():
                self.robot.lights = dataclasses.replace(self.robot.lights, has_sound=command.is_on)
            case LoudspeakerSound():
                self._play(command.pcm)
            case LightsPattern():
                self.robot.command_lights(command.pattern, self._lights_color)
            case LightsColor():
                self._lights_color = command.color
                self.robot.command_lights(self.robot.lights.pattern, command.color)
            case JointTrajectory() if len(command.times) == 0:
                controllers.stop_trajectory(command.controller)
            case JointTrajectory():
                offset = 0.0 if self._world_time is None else self._world_time.offset
                trajectory = _trajectory(command, offset)
                controllers.start_trajectory(command.controller, trajectory, time, command.goal)


def _trajectory(command: JointTrajectory, offset: float) -> Trajectory:
    """Returns a trajectory whose start is in simulated time; ``offset`` [s]: world time minus simulated time."""

    def tolerance(given: JointTolerances | None) -> Tolerance | None:
        return None if given is None else Tolerance(given.position, given.velocity)

    return Trajectory(
        command.joints,
        command.times,
        command.positions,
        command.velocities,
        start_time=max(command.time - offset, 1e-9) if command.time > 0.0 else 0.0,
        path_tolerance=tolerance(command.path_tolerance),
        goal_tolerance=tolerance(command.goal_tolerance),
        goal_time_tolerance=command.goal_time_tolerance,
    )


def _goal_result(result: controller_manager.GoalResult) -> GoalResult:
    """Convert a controller's result to ROS terms. A goal that another goal replaced is aborted with the code of
    ros2_controllers."""
    outcome = result.outcome
    code = {Outcome.PREEMPTED: Outcome.INVALID_GOAL, Outcome.CANCELED: Outcome.SUCCESSFUL}.get(outcome, outcome)
    return GoalResult(result.goal, _STATUS.get(outcome, GoalStatus.ABORTED), int(code), result.text, result.gripper)
