"""Controllers for the kinds of grippers: they execute goals of ``control_msgs/GripperCommand`` and report the results.

The kinds are declared in :mod:`vinesim.robot.description.grippers`; :data:`CONTROLLERS` has one controller class for
each.
"""

from __future__ import annotations

import abc

import numpy as np

from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.values import GripperState

GOAL_TOLERANCE = 2e-3
"""[m or rad] Distance from its goal within which a gripper has reached the goal, once it has settled there."""
STALL_SPEED = 1e-3
"""[m/s or rad/s] Speed of the fingers up to which they stand still: ``stall_velocity_threshold`` of
``gripper_action_controller`` in ros2_controllers, its default."""
STALL_DURATION = 1.0
"""[s] Time for which fingers must stand still away from their goal to be stalled: ``stall_timeout`` of
``gripper_action_controller``, its default."""
SETTLE_DURATION = 0.3
"""[s] Time at its goal after which a gripper has settled even if its fingers tremble. GUESSED: a tenth of the time that
it takes to close."""


class GripperController(abc.ABC):
    """Base class for the controller of all grippers of one kind in one joint group. It executes one goal at a time."""

    def __init__(self, robot: Robot, group: str) -> None:
        """Raises :class:`CommandError` if the robot has no gripper of this kind in ``group``."""
        self.robot = robot
        self.group = group

    @abc.abstractmethod
    def start(self, position: float, effort: float | None, time: float) -> None:
        """Start a goal at ``time`` [s]. ``effort``: largest effort; None: the gripper's own limit. Raises
        :class:`CommandError` if the goal is invalid."""

    @abc.abstractmethod
    def state(self, time: float) -> GripperState:
        """Returns the state of the present goal at ``time`` [s]. It is called in every step until the goal ends."""

    @abc.abstractmethod
    def cancel(self, time: float) -> None:
        """Stop the gripper at ``time`` [s], when a goal is cancelled."""


class FingersController(GripperController):
    """Moves fingers to an opening. They keep pressing after the goal has ended, so that they hold an object.

    Goal: the opening [m or rad], and the largest effort of each finger [N or N m]; see :meth:`Robot.command_gripper`.
    Result: the opening, and the largest effort of a finger. The goal is reached when the fingers stand still at it, not
    while they pass it. The result is ``stalled`` if an object is between the fingers.
    """

    def __init__(self, robot: Robot, group: str) -> None:
        super().__init__(robot, group)
        self._fingers = robot.description.joint_indices(group)
        self._goal = robot.gripper_opening(group)
        self._moved = self._came = 0.0
        """Last times [s] at which the fingers moved, and at which they were away from their goal."""

    def start(self, position: float, effort: float | None, time: float) -> None:
        """Start to move the fingers to the opening ``position`` at ``time`` [s], with at most ``effort`` [N or N m]
        each; None: the drives' own limit."""
        self.robot.command_gripper(self.group, position, effort)
        self._goal = position
        self._moved = self._came = time

    def state(self, time: float) -> GripperState:
        """Returns opening and largest effort of the fingers at ``time`` [s], and whether they have reached their
        goal or are stalled."""
        robot = self.robot
        _, velocity, effort, _ = robot.rigid.joint_measurements(robot.name)
        opening = robot.gripper_opening(self.group)
        strongest = float(np.abs(effort[self._fingers]).max())
        is_moving = np.abs(velocity[self._fingers]).max() > STALL_SPEED
        if is_moving:
            self._moved = time
        if abs(opening - self._goal) <= GOAL_TOLERANCE:
            has_settled = not is_moving or time - self._came >= SETTLE_DURATION
            return GripperState(opening, strongest, reached_goal=has_settled)
        self._came = time
        return GripperState(opening, strongest, stalled=time - self._moved >= STALL_DURATION)

    def cancel(self, time: float) -> None:
        """Hold the fingers at their present positions."""
        self.start(self.robot.gripper_opening(self.group), None, time)


class CutterController(GripperController):
    """Closes a cutter once, whatever position the goal has.

    Goal: the largest force of the blades [N]; see :meth:`Robot.command_cutter`. Result: how far the blades are open,
    from 1 to 0, and the largest force [N] that they exerted, 0 if nothing was between them. The result is ``stalled``
    if they did not meet, so that nothing was cut off.
    """

    def __init__(self, robot: Robot, group: str) -> None:
        super().__init__(robot, group)
        self._closures = tuple(blade.closures for blade in robot.cutter_blades(group))

    def start(self, position: float, effort: float | None, time: float) -> None:
        """Close the cutter from ``time`` [s] on with at most ``effort`` [N]; None: the cutter's own limit. ``position``
        is ignored."""
        self.robot.command_cutter(self.group, effort)
        self._closures = tuple(blade.closures for blade in self.robot.cutter_blades(self.group))

    def state(self, time: float) -> GripperState:
        """Returns how far the blades are open, and the largest force [N] that they exerted."""
        blades = self.robot.cutter_blades(self.group)
        opening = max(blade.gap / blade.opening if blade.closing or blade.closures else 1.0 for blade in blades)
        effort = max(blade.peak for blade in blades)
        if any(blade.closures == before for blade, before in zip(blades, self._closures, strict=True)):
            return GripperState(opening, effort)
        stalled = any(blade.stalled for blade in blades)
        return GripperState(opening, effort, stalled=stalled, reached_goal=not stalled)

    def cancel(self, time: float) -> None:
        """Open the blades. The wood stays as deep as it is cut."""
        for blade in self.robot.cutter_blades(self.group):
            blade.open()


CONTROLLERS: dict[str, type[GripperController]] = {"fingers": FingersController, "cutter": CutterController}
"""Classes of controllers, by kind of gripper."""
