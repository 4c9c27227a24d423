"""Base class for tasks of a robot with a clamp at either end: take a box, carry it, list the bunches in it.

The poses of base, clamps and boxes are read from the physics. Boxes are held by friction only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from vinesim.core import frames
from vinesim.robot.control.waypoint_follower import WaypointFollower
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.robot.tasks.task import Task, TaskFailed
from vinesim.world import Physics

LIFT_HEIGHT = 0.15
"""[m] Position of a lift's joint while the robot carries a box with it: about the height of the box's underside above
the ground. GUESSED
"""
MIN_CLAMP_FORCE = 100.0
"""[N] Contact force on each paddle from which on the paddles have clamped something. GUESSED"""
CLAMP_TIME = 1.5
"""[s] Time in which the paddles close or open. GUESSED"""
LIFT_TIMEOUT = 6.0
"""[s] Time in which a lift must reach its height. GUESSED"""
LIFT_TOLERANCE = 0.003
"""[m] Distance from its height within which a lift has reached the height. GUESSED"""
APPROACH_SPEED = 0.2
"""[m/s] Speed of the base near a box. GUESSED"""


class BoxHandling(Task):
    """Base class of tasks in which a robot moves boxes with its clamps."""

    GROUPS: tuple[str, ...] = ("lift_front", "clamp_front")
    """Joint groups that the robot must have."""

    def __init__(self, physics: Physics, robot: Robot, *, timeout: float) -> None:
        """``timeout`` [s]: time after which the task fails. Raises :class:`CommandError` if the robot lacks one of
        :attr:`GROUPS`."""
        super().__init__(robot, timeout=timeout)
        self.physics = physics
        for group in self.GROUPS:
            if group not in robot.description.groups:
                raise CommandError(f"{robot.name} has no group {group!r}; give a robot with a clamp at either end")

    def box_pose(self, box: int) -> np.ndarray:
        """Returns the pose [7] of a box, whose origin is the middle of its underside."""
        rigid = self.physics.rigid
        return rigid.visual_q()[[link.name for link in rigid.visuals()].index(f"box/{box}")]

    # ------------------------------------------------------------------ motions

    def _take(self, phase: str, end: str, box: int) -> Iterator[str]:
        """Approach a box with the clamp at ``end`` of the robot, clamp and lift the box, and drive back to where the
        base can turn. Yields ``phase`` once per step."""
        group = f"clamp_{end}"
        here = self._base_pose()[:2].copy()
        fingers = self.robot.description.joint_indices(group)
        self.robot.command_position(self.robot.upper_limit[fingers], fingers)
        yield from self._move_lift(phase, end, 0.0)
        yield from self._align_clamp(phase, end, self.box_pose(box))
        self.robot.command_position(np.zeros(len(fingers)), fingers)
        yield from self.wait(CLAMP_TIME, phase)
        felt = np.abs(self.robot.rigid.joint_measurements(self.robot.name)[3][fingers])
        if (felt < MIN_CLAMP_FORCE).any():
            raise TaskFailed(f"the {end} paddles feel {felt.min():.0f} N: nothing between them")
        low = float(self.box_pose(box)[2])
        yield from self._move_lift(phase, end, LIFT_HEIGHT)
        risen = float(self.box_pose(box)[2]) - low
        if risen < 0.8 * LIFT_HEIGHT:
            raise TaskFailed(f"the box has slipped: lifted by {LIFT_HEIGHT} m it has risen by {risen:.2f} m")
        yield from self._drive_straight(phase, here, backwards=end == "front")

    def _follow_path(self, phase: str, points: np.ndarray, heading: float) -> Iterator[str]:
        """Drive along ``points`` [n, 2] m in the world, and turn to ``heading`` [rad]."""
        yield from self._follow(phase, WaypointFollower(self.robot, points, heading, speed=0.5, turn_rate=0.3))

    def _drive_straight(self, phase: str, place: np.ndarray, *, backwards: bool) -> Iterator[str]:
        """Drive slowly to ``place`` [2] m in the world, without turning."""
        yield from self._follow(
            phase, WaypointFollower(self.robot, place, None, speed=APPROACH_SPEED, reverse=backwards)
        )

    def _align_clamp(self, phase: str, end: str, box: np.ndarray) -> Iterator[str]:
        """Drive straight until the clamp at ``end`` is at a box. ``box`` [7]: pose of the box."""
        clamp = self.robot.frame_pose(f"clamp_{end}_link")[:2]
        base = self._base_pose()[:2]
        reach = float(np.linalg.norm(clamp - base))
        ahead = (clamp - base) / reach
        # Only along the base, because its heading was aligned before.
        place = base + ahead * (float((box[:2] - base) @ ahead) - reach)
        yield from self._drive_straight(phase, place, backwards=end == "rear")

    def _follow(self, phase: str, follower: WaypointFollower) -> Iterator[str]:
        """Drive until ``follower`` has reached its last waypoint. Raises :class:`TaskFailed` if the base is stuck."""
        while not follower.is_done:
            follower.control(self.time)
            if follower.is_stuck:
                raise TaskFailed("the base is stuck")
            yield phase

    def _move_lift(self, phase: str, end: str, height: float) -> Iterator[str]:
        """Move the lift at ``end`` to ``height`` [m], a position of its joint."""
        index = self.robot.description.joint_indices(f"lift_{end}")
        self.robot.command_position([height], index)
        until = self.time + LIFT_TIMEOUT
        while abs(self.robot.rigid.joint_measurements(self.robot.name)[0][index[0]] - height) > LIFT_TOLERANCE:
            if self.time > until:
                raise TaskFailed(f"the {end} lift does not reach {height:.2f} m")
            yield phase

    def _lift_index(self, end: str) -> int:
        """Returns the index of the lift at ``end`` in joint arrays."""
        return int(self.robot.description.joint_indices(f"lift_{end}")[0])

    def _base_pose(self) -> np.ndarray:
        """Returns the pose [7] of the base in the world."""
        return self.robot.rigid.base_state(self.robot.name)[0]

    def _away_from(self, box: int, place: np.ndarray, pose: np.ndarray | None = None) -> float:
        """Returns the heading [rad] of a base at ``place`` [2] m that points away from a box, or from ``pose`` [7]
        if given."""
        pose = self.box_pose(box) if pose is None else pose
        return math.atan2(place[1] - pose[1], place[0] - pose[0])

    def _bunches_in(self, box: int) -> tuple[int, ...]:
        """Returns the indices of the free bunches in a box."""
        rigid = self.physics.rigid
        size = self.physics.model.box_size[box].astype(float)
        back = frames.inverse(self.box_pose(box))
        found = []
        for bunch in rigid.free_bunches:
            middle = frames.pose([0.5 * float(self.physics.model.bunch_length[bunch]), 0.0, 0.0])
            at = frames.compose(back, frames.compose(rigid.bunch_pose(bunch), middle))[:3]
            if (np.abs(at[:2]) < 0.5 * size[:2]).all() and 0.0 < at[2] < 2.0 * size[2]:
                found.append(bunch)
        return tuple(found)
