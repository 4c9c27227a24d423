"""Moves a gripper to an opening, or closes a cutter, and says how it ended: as ``control_msgs/GripperCommand`` does."""

from __future__ import annotations

import numpy as np

from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.values import GripperState

GOAL_TOLERANCE = 2e-3
"""[m or rad] A gripper this near to its goal has reached it."""
STALL_SPEED = 1e-3
"""[m/s or rad/s] A gripper that moves slower is stalled; the default of ``gripper_action_controller``."""
STALL_DURATION = 0.3
"""[s] for which it must be so slow. GUESSED: a tenth of the time that it takes to close."""


class GripperController:
    """One goal at a time; to hold what it holds, it keeps pressing when the goal has ended."""

    def __init__(self, robot: Robot, group: str) -> None:
        self.robot = robot
        self.group = group
        self._fingers = robot.description.joint_indices(group)
        self._goal = robot.gripper_opening(group)
        self._slow_since: float | None = None

    def start(self, opening: float, effort: float | None, time: float) -> None:
        """Go to an ``opening`` [m or rad] with at most ``effort`` [N or N m] a finger; see
        :meth:`Robot.command_gripper`."""
        self.robot.command_gripper(self.group, opening, effort)
        self._goal = opening
        self._slow_since = None

    def state(self, time: float) -> GripperState:
        """How far it is at ``time`` [s]; call it in every step of a goal."""
        robot = self.robot
        _, velocity, effort, _ = robot.rigid.joint_measurements(robot.name)
        opening = robot.gripper_opening(self.group)
        strongest = float(np.abs(effort[self._fingers]).max())
        if abs(opening - self._goal) <= GOAL_TOLERANCE:
            return GripperState(opening, strongest, reached_goal=True)
        if np.abs(velocity[self._fingers]).max() > STALL_SPEED:
            self._slow_since = None
        elif self._slow_since is None:
            self._slow_since = time
        stalled = self._slow_since is not None and time - self._slow_since >= STALL_DURATION
        return GripperState(opening, strongest, stalled=stalled)


class CutterController:
    """Closes the cutter of a gripper once. Its state: position 0 once closed; stalled if it was too weak for anything
    in its mouth; no effort if there was nothing."""

    def __init__(self, robot: Robot, group: str) -> None:
        self.robot = robot
        self.group = group
        self._closures: tuple[int, ...] = ()

    def start(self, force: float | None) -> None:
        """Close with at most ``force`` [N]; see :meth:`Robot.command_cutter`."""
        self.robot.command_cutter(self.group, force)
        self._closures = tuple(blade.closures for blade in self.robot.cutter_blades(self.group))

    def state(self) -> GripperState:
        """Whether it has closed, and what it met."""
        blades = self.robot.cutter_blades(self.group)
        if any(blade.closures == before for blade, before in zip(blades, self._closures, strict=True)):
            return GripperState(1.0, 0.0)
        effort = max(min(blade.resistance, blade.force) for blade in blades)
        too_weak = any(blade.resistance > blade.force for blade in blades)
        return GripperState(0.0, effort, stalled=too_weak, reached_goal=not too_weak)
