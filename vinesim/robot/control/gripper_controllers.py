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
"""[m or rad] Distance from its goal within which a gripper has reached the goal."""
STALL_SPEED = 1e-3
"""[m/s or rad/s] Speed below which a gripper counts as stalled: the default of ``gripper_action_controller``."""
STALL_DURATION = 0.3
"""[s] Time for which a gripper must be slower than :data:`STALL_SPEED` to be stalled. GUESSED: a tenth of the time that
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
    Result: the opening, and the largest effort of a finger. The result is ``stalled`` if an object is between the
    fingers.
    """

    def __init__(self, robot: Robot, group: str) -> None:
        super().__init__(robot, group)
        self._fingers = robot.description.joint_indices(group)
        self._goal = robot.gripper_opening(group)
        self._slow_since: float | None = None

    def start(self, position: float, effort: float | None, time: float) -> None:
        """Start to move the fingers to the opening ``position`` at ``time`` [s], with at most ``effort`` [N or N m]
        each; None: the drives' own limit."""
        self.robot.command_gripper(self.group, position, effort)
        self._goal = position
        self._slow_since = None

    def state(self, time: float) -> GripperState:
        """Returns opening and largest effort of the fingers at ``time`` [s], and whether they have reached their
        goal or are stalled."""
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

    def cancel(self, time: float) -> None:
        """Hold the fingers at their present positions."""
        self.start(self.robot.gripper_opening(self.group), None, time)


class CutterController(GripperController):
    """Closes a cutter once, whatever position the goal has.

    Goal: the largest force of the blades [N]; see :meth:`Robot.command_cutter`. Result: position 0 once closed, and the
    force [N] that the blades had to overcome, 0 if nothing was between them. The result is ``stalled`` if this force
    exceeds the largest force, so that nothing was cut.
    """

    def __init__(self, robot: Robot, group: str) -> None:
        super().__init__(robot, group)
        self._closures = tuple(blade.closures for blade in robot.cutter_blades(group))

    def start(self, position: float, effort: float | None, time: float) -> None:
        """Close the cutter at ``time`` [s] with at most ``effort`` [N]; None: the cutter's own limit. ``position``
        is ignored."""
        self.robot.command_cutter(self.group, effort)
        self._closures = tuple(blade.closures for blade in self.robot.cutter_blades(self.group))

    def state(self, time: float) -> GripperState:
        """Returns whether the blades have closed, and the force [N] that they had to overcome."""
        blades = self.robot.cutter_blades(self.group)
        if any(blade.closures == before for blade, before in zip(blades, self._closures, strict=True)):
            return GripperState(1.0, 0.0)
        effort = max(min(blade.resistance, blade.force) for blade in blades)
        too_weak = any(blade.resistance > blade.force for blade in blades)
        return GripperState(0.0, effort, stalled=too_weak, reached_goal=not too_weak)

    def cancel(self, time: float) -> None:
        """Do nothing, because the blades close within one step."""


CONTROLLERS: dict[str, type[GripperController]] = {"fingers": FingersController, "cutter": CutterController}
"""Classes of controllers, by kind of gripper."""
