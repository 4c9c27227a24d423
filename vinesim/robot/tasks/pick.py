"""The picking task: reach for a bunch, grasp it, cut its stalk, carry it to a box and put it in.

    pick = PickBunch(physics, robot, plan)
    while not pick.is_done:
        pick.control(time)
        robot.control(time)
        physics.step()
    assert pick.picked, pick.reason

:mod:`vinesim.robot.control.cartesian_controller` moves the hand. The poses of bunch, box and base are read from the
physics in every step; no joint position is prescribed. The fingers hold the bunch by friction, with a commanded force.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.rigid.static_world import CRATE_WALL
from vinesim.robot.control.cartesian_controller import CartesianController, axes_of_pose
from vinesim.robot.control.waypoint_follower import WaypointFollower
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.robot.tasks.task import Task, TaskFailed
from vinesim.world import Physics

STALK_LENGTH = 0.012
"""[m] Least length of the stalk that stays on the bunch; see :func:`stalk_length`."""
SHOULDER = -0.032, 0.916, -0.106
"""[m, 1, 1] Height of a bunch's shoulders above its upper end, 20 mm beside the stalk, where the bars of the cutter
pass: a constant, and shares of its radius and of its length. DERIVED: least squares over the collision shapes of the
199 bunches of ``demo`` (seed 0) and ``harvest`` (seed 7), right within 2.7 mm."""
SHOULDER_ROOM = 0.009
"""[m] Distance of the cutter's plane above the shoulders: half a bar (3 mm), the error of :data:`SHOULDER`, and the
error of the hand (3 mm)."""
STALK_FORCE = 150.0
"""[N] Largest force of the blades at a stalk. Peduncles of 3 to 5.6 mm take 34 to 118 N
(:data:`vinesim.interaction.cutting_force.PEDUNCLE_STRENGTH`). Blades with this force stall in canes of 3.8 mm and
more."""
OPENING_MARGIN = 0.015
"""[m] Gap between the open fingers and the bunch, on each side. GUESSED"""
APPROACH_DISTANCE = 0.20
"""[m] Length of the straight motion towards the bunch before the grasp, and of the straight motion back after it.
GUESSED"""
GRASP_FORCE = 15.0
"""[N] Force of each finger. A bunch of 1 kg needs 6 N at a friction coefficient of 0.8; the rest is for accelerations.
More would burst berries: on one cell of a bunch, the weakest of a table grape burst from 16 N on
(:data:`vinesim.interaction.fruit_damage.SKIN_TENSION`)."""
MIN_GRASP_FORCE = 8.0
"""[N] Contact force on each finger from which on the fingers have grasped something. GUESSED"""
GRASP_TIME = 0.3
"""[s] Time for which all fingers must feel :data:`MIN_GRASP_FORCE`. GUESSED"""
CLOSE_TIMEOUT = 4.0
"""[s] Time in which the closing fingers must grasp the bunch. GUESSED"""
MAX_CUTS = 5
"""Number of times that the cutter closes before the task fails."""
POSITION_TOLERANCE = 0.01
"""[m] Distance within which the hand has reached its goal. GUESSED"""
THICK = 0.060
"""[m] Radius of a bunch from which the hand has to be exactly before it: little room is left between the fingers."""
THICK_TOLERANCE = 0.003
"""[m] As :data:`POSITION_TOLERANCE`, before thick bunches. GUESSED"""
ORIENTATION_TOLERANCE = 0.12
"""[rad] Angle within which the hand has reached the orientation of its goal. GUESSED"""
CARRY_POSITION = np.array([0.45, 0.12, 1.20])
"""[m] Position of the left hand while the base drives, in the frame of the base. For the right hand it is mirrored."""
CLEARANCE_ABOVE_RIM = 0.50
"""[m] Height of the hand above the rim of the box before it descends into the box. GUESSED"""
RELEASE_HEIGHT = 0.19
"""[m] Height of the hand above the bottom of the box at release. vinebot's arm reaches no deeper next to its base,
and the lower end of a bunch is about 0.12 m below the hand."""
CARRY_SPEED = 0.20
"""[m/s] Speed of the hand with a bunch. GUESSED"""
RELEASE_OPENING = 0.05
"""[m] Distance by which the fingers open for release. With a larger one they would touch the walls of the box."""
MAX_MISS = 0.06
"""[m] Horizontal distance from its place in the box within which a hand that came no lower lets a bunch go. GUESSED"""
MAX_SLIP = 0.12
"""[m] Distance between bunch and hand above which the bunch has slipped out of the fingers. GUESSED"""


def stalk_length(radius: float, length: float) -> float:
    """Returns the length [m] of the stalk to leave on a bunch of this ``radius`` and ``length`` [m]: the bars of the
    cutter pass above its shoulders."""
    constant, of_radius, of_length = SHOULDER
    return max(STALK_LENGTH, constant + of_radius * radius + of_length * length + SHOULDER_ROOM)


@dataclasses.dataclass(frozen=True)
class PickPlan:
    """Plan of the task: which bunch to pick, with which arm, from where, and into which box."""

    bunch: int
    side: str
    """Arm: ``"left"`` or ``"right"``."""
    base_pose: np.ndarray
    """[7] Pose of the base during the pick, in which the bunch is ahead of the arm's shoulder."""
    box: int
    path: np.ndarray
    """[n, 2] m, path of the base from ``base_pose`` to where the box is next to it, on the arm's side."""
    final_heading: float
    """[rad] Heading of the base at the end of ``path``."""
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[m] Where in the box the bunch is put, from the middle: along the final heading (the end of ``path`` is ahead by
    as much), across it to the left, and up."""


class PickBunch(Task):
    """Moves one bunch from its vine into a box. ``picked`` and ``reason`` hold the result."""

    key_phases = frozenset({"cut", "back"})
    grasp_force = GRASP_FORCE
    """[N] Force of each finger."""

    def __init__(self, physics: Physics, robot: Robot, plan: PickPlan, *, timeout: float = 90.0) -> None:
        """``robot``: must have its cutters (:meth:`Robot.fit_cutters`). ``timeout`` [s]: time after which the task
        fails.

        Raises :class:`CommandError` if the arm of ``plan`` has no gripper with a cutter.
        """
        super().__init__(robot, timeout=timeout)
        self.physics = physics
        self.plan = plan
        self.arm = CartesianController(robot, plan.side)
        cutter = next((c for c in robot.description.cutters if c.group == self.arm.gripper), None)
        if cutter is None:
            raise CommandError(f"{robot.name} has no gripper with a cutter on its {plan.side} arm; give another robot")
        self._cutter = cutter.frame
        self._above = float(np.linalg.norm(robot.frame_pose(self._cutter)[:3] - robot.frame_pose(self.arm.tool)[:3]))
        """[m] Distance of the cutter above the point between the fingers."""
        self._measure()
        self._is_empty = False
        """Whether the hand is to hold no bunch any more, after a failure."""
        self._fingers = robot.description.joint_indices(self.arm.gripper)
        self._tool_z = np.array([0.0, 0.0, 1.0])

    @property
    def picked(self) -> bool:
        """Whether the bunch has come to rest in the box."""
        return self.succeeded

    def report(self) -> dict[str, Any]:
        """Returns the result of the task as plain values for JSON: picked or not, bunch, arm, box, and durations of
        the phases."""
        where = {"bunch": self.plan.bunch, "side": self.plan.side, "box": self.plan.box}
        return {"picked": self.picked, **where, "bunch_kg": round(self.mass, 4), **super().report()}

    def focus(self) -> np.ndarray:
        """Returns the point [3] m in the world at which the bunch is to be grasped, and at which the head camera is
        to look."""
        return self._grasp_point()

    def _size(self) -> tuple[float, float]:
        """Returns length and radius of the bunch [m]."""
        model = self.physics.model
        return float(model.bunch_length[self.plan.bunch]), float(model.bunch_radius[self.plan.bunch])

    def _measure(self) -> None:
        """Set the size of the bunch, and where it is grasped."""
        self._length, self._radius = self._size()
        stalk = stalk_length(self._radius, self._length)
        self._grasp_depth = min(self._above - stalk, 0.6 * self._length)
        """[m] Distance from the upper end of the bunch down to the point where it is grasped."""

    @property
    def mass(self) -> float:
        """Mass of the bunch [kg]."""
        return float(self.physics.model.body_mass[self.physics.model.bunch_body[self.plan.bunch]])

    @property
    def is_cut(self) -> bool:
        """Whether the bunch has left its vine."""
        return not self.physics.state.bunch_attached[self.plan.bunch]

    @property
    def bunch_pose(self) -> np.ndarray:
        """Pose [7] of the bunch: the origin is its upper end, and x points along its axis."""
        if self.physics.state.bunch_attached[self.plan.bunch]:
            return self.physics.state.body_q[self.physics.model.bunch_body[self.plan.bunch]].astype(float)
        return self.physics.rigid.bunch_pose(self.plan.bunch)

    @property
    def box_pose(self) -> np.ndarray:
        """Pose [7] of the box, whose origin is the middle of its underside."""
        rigid = self.physics.rigid
        return rigid.visual_q()[[link.name for link in rigid.visuals()].index(f"box/{self.plan.box}")]

    @property
    def in_box(self) -> bool:
        """Whether the middle of the bunch is between the walls of the box."""
        middle = frames.compose(self.bunch_pose, frames.pose([0.5 * self._length, 0.0, 0.0]))
        local = frames.compose(frames.inverse(self.box_pose), middle)[:3]
        size = self.physics.model.box_size[self.plan.box].astype(float)
        return bool((np.abs(local[:2]) < 0.5 * size[:2]).all() and 0.0 < local[2] < size[2])

    # ------------------------------------------------------------------ the task

    def run(self) -> Iterator[str]:
        """The task: reach for the bunch, grasp it, cut it, drive to the box and put it in. Yields the name of the
        phase, once per step."""
        ahead = frames.rotate(self._base_pose()[3:], np.array([1.0, 0.0, 0.0]))
        self.arm.reset()
        yield from self._reach_and_cut(ahead)
        yield from self._draw_back(ahead)
        yield from self._carry()

    def _reach_and_cut(self, ahead: np.ndarray) -> Iterator[str]:
        """Open the hand, bring it before the bunch, and grasp and cut the bunch."""
        self.robot.command_gripper(self.arm.gripper, 2.0 * (self._radius + OPENING_MARGIN))
        near = POSITION_TOLERANCE if self._radius <= THICK else THICK_TOLERANCE
        before = lambda: self._grasp_point() - APPROACH_DISTANCE * ahead  # noqa: E731
        yield from self._move_hand("reach", before, ahead, timeout=12.0, near=near)
        yield from self._advance_and_cut(ahead)

    def _advance_and_cut(self, ahead: np.ndarray) -> Iterator[str]:
        """Advance around the bunch, close the fingers and cut the stalk."""
        yield from self._move_hand("advance", self._grasp_point, ahead, speed=0.10, timeout=8.0, near=0.003)
        yield from self._close_gripper(ahead)
        yield from self._cut()

    def _draw_back(self, ahead: np.ndarray) -> Iterator[str]:
        """Draw the bunch back from the plant and to the body."""
        back = self.arm.tip_position - APPROACH_DISTANCE * ahead + [0.0, 0.0, -0.03]
        yield from self._move_hand("back", lambda: back, ahead, speed=0.15, timeout=6.0)
        yield from self._move_hand(
            "tuck", lambda: self._base_to_world(CARRY_POSITION), ahead, speed=CARRY_SPEED, timeout=10.0, near=0.03
        )

    def _carry(self) -> Iterator[str]:
        """Drive to the box, put the bunch into it, and check that it is there."""
        yield from self._drive()
        yield from self._place_in_box()
        yield from self.wait(1.0, "rest")
        if not self.in_box:
            raise TaskFailed(self._describe_bunch())

    def _close_gripper(self, ahead: np.ndarray) -> Iterator[str]:
        """Close the fingers with :attr:`grasp_force` until all of them feel the bunch."""
        rigid = self.robot.rigid
        name = self.robot.name
        stiffness = np.array([self.robot.description.drives[i].stiffness for i in self._fingers])
        end = self.time + CLOSE_TIMEOUT
        steps = 0
        while steps < round(GRASP_TIME / rigid.dt):
            position, _, _, contact = rigid.joint_measurements(name)
            here = position[self._fingers]
            felt = np.abs(contact[self._fingers])
            steps = steps + 1 if (felt > MIN_GRASP_FORCE).all() else 0
            if self.time > end:
                raise TaskFailed(
                    f"the fingers feel {felt.min():.0f} N at an opening of {here.sum():.3f} m: nothing to hold"
                )
            self.robot.command_position(here - self.grasp_force / stiffness, self._fingers)
            yield "close"

    def _cut(self) -> Iterator[str]:
        """Close the cutter, repeatedly until the bunch is cut off."""
        for _ in range(MAX_CUTS):
            self.robot.command_cutter(self.arm.gripper, STALK_FORCE)
            yield "cut"
            while any(blade.closing for blade in self.robot.cutter_blades(self.arm.gripper)):
                yield "cut"
            if self.is_cut:
                return
            yield from self.wait(0.2, "cut")
        raise TaskFailed(f"the blades missed the stalk: {self._describe_stalk()}")

    def _drive(self) -> Iterator[str]:
        """Drive to the place where the box is within reach."""
        follower = WaypointFollower(self.robot, self.plan.path, self.plan.final_heading, turn_rate=0.3)
        while not follower.is_done:
            self.arm.hold_position()
            follower.control(self.time)
            if follower.is_stuck:
                raise TaskFailed("the base is stuck")
            self._check_grasp()
            yield "drive"

    def _place_in_box(self) -> Iterator[str]:
        """Move the hand over the box, turn the fingers down, descend, release and retreat."""
        base = self._base_pose()
        down = np.array([0.0, 0.0, -1.0])
        along = frames.rotate(base[3:], np.array([1.0, 0.0, 0.0]))
        rim = float(self.physics.model.box_size[self.plan.box, 2])
        # with the fingers down, the bunch points backwards
        across = frames.cross(np.array([0.0, 0.0, 1.0]), along)
        place = self.plan.place[0] * along + self.plan.place[1] * across - self.plan.place[2] * down
        middle = self.box_pose[:3] + place + (0.5 * self._length - self._grasp_depth) * along
        over = middle - (rim + CLEARANCE_ABOVE_RIM) * down
        low = middle - (CRATE_WALL + RELEASE_HEIGHT) * down
        yield from self._move_hand("over", lambda: over, along, speed=CARRY_SPEED, timeout=12.0)
        self._tool_z = along
        yield from self._move_hand("turn", lambda: over, down, timeout=6.0)
        try:
            yield from self._move_hand("lower", lambda: low, down, speed=0.15, timeout=8.0, near=0.03)
        except TaskFailed:  # another bunch or a wall is in the way, or the arm is too short: let go above the place
            if float(np.linalg.norm((self.arm.tip_position - low)[:2])) > MAX_MISS:
                raise
        opening = self.robot.gripper_opening(self.arm.gripper)
        self.robot.command_gripper(self.arm.gripper, opening + RELEASE_OPENING)
        yield from self.wait(0.8, "let go")
        yield from self._move_hand("rise", lambda: over, down, speed=0.2, timeout=8.0, near=0.05)

    def withdraw(self) -> Iterator[str]:
        """After a failure: open the hand, draw it back from the plant and to the body. Yields the phase ``"withdraw"``,
        once per step.

        Raises :class:`TaskFailed` if the hand does not come free.
        """
        self._is_empty = True
        self._tool_z = np.array([0.0, 0.0, 1.0])
        ahead = frames.rotate(self._base_pose()[3:], np.array([1.0, 0.0, 0.0]))
        self.robot.command_gripper(self.arm.gripper, 2.0 * (self._radius + OPENING_MARGIN))
        for _ in self.wait(0.5, "withdraw"):
            self.arm.hold_position()
            yield "withdraw"
        if self.phase in ("advance", "open", "close", "cut", "back"):
            back = self.arm.tip_position - APPROACH_DISTANCE * ahead
            yield from self._move_hand("withdraw", lambda: back, ahead, speed=CARRY_SPEED, timeout=8.0, near=0.05)
        carry = lambda: self._base_to_world(CARRY_POSITION)  # noqa: E731
        yield from self._move_hand("withdraw", carry, ahead, speed=CARRY_SPEED, timeout=10.0, near=0.06)

    def fold(self) -> Iterator[str]:
        """After the release: draw the hand to the body, so that the base can turn. Yields the phase ``"fold"``."""
        self._is_empty = True
        self._tool_z = np.array([0.0, 0.0, 1.0])
        ahead = frames.rotate(self._base_pose()[3:], np.array([1.0, 0.0, 0.0]))
        carry = lambda: self._base_to_world(CARRY_POSITION)  # noqa: E731
        yield from self._move_hand("fold", carry, ahead, speed=0.35, timeout=12.0, near=0.05)

    # ------------------------------------------------------------------ motions

    def _move_hand(
        self,
        phase: str,
        goal: Callable[[], np.ndarray],
        ahead: np.ndarray,
        *,
        speed: float = 0.35,
        timeout: float,
        near: float = POSITION_TOLERANCE,
    ) -> Iterator[str]:
        """Move the hand to ``goal`` [3] m in the world, with its x axis along ``ahead`` [3], within ``timeout`` [s].

        ``near`` [m]: tolerance. Raises :class:`TaskFailed` if the hand does not arrive or loses the bunch.
        """
        end = self.time + timeout
        self.arm.reset()
        while True:
            there = goal()
            axes = axes_of_pose(self.robot.frame_pose(self.arm.tool))
            off = np.arccos(np.clip((axes[0] @ ahead + axes[2] @ self._tool_z) / 2.0, -1.0, 1.0))
            if self.arm.distance_to(there) < near and off < ORIENTATION_TOLERANCE:
                return
            if self.time > end:
                raise TaskFailed(
                    f"the hand is {self.arm.distance_to(there):.2f} m and {off:.2f} rad off: out of reach, or held"
                )
            if phase not in ("rise",):
                self._check_grasp()
            self.arm.move_towards(there, ahead, self._tool_z, speed=speed, working_height=float(there[2]))
            yield phase

    def _check_grasp(self) -> None:
        """Raise :class:`TaskFailed` if the bunch has left its vine and is not in the hand."""
        if self.is_cut and not self._is_empty:
            off = float(np.linalg.norm(self._grasp_point() - self.arm.tip_position))
            if off > MAX_SLIP:
                raise TaskFailed(f"the bunch slipped out of the fingers, it is {off:.2f} m from them")

    def _grasp_point(self) -> np.ndarray:
        """Returns the point [3] m in the world at which the bunch is to be grasped."""
        return frames.compose(self.bunch_pose, frames.pose([self._grasp_depth, 0.0, 0.0]))[:3]

    def _base_pose(self) -> np.ndarray:
        """Returns the pose [7] of the base in the world."""
        return self.robot.rigid.base_state(self.robot.name)[0]

    def _base_to_world(self, point: np.ndarray) -> np.ndarray:
        """Convert a point [3] m from the frame of the base to the world. The point is given for the left arm, and
        mirrored for the right one."""
        mirror = np.array([1.0, 1.0 if self.plan.side == "left" else -1.0, 1.0])
        return frames.compose(self._base_pose(), frames.pose(mirror * point))[:3]

    def _describe_stalk(self) -> str:
        """Returns a text with the position of the stalk in the cutter's frame."""
        cutter = self.robot.frame_pose(self._cutter)
        stalk = frames.compose(frames.inverse(cutter), self.bunch_pose)[:3]
        return "its lower end is at ({:.3f}, {:.3f}, {:.3f}) m in the mouth".format(*stalk)

    def _describe_bunch(self) -> str:
        """Returns a text with the position of the bunch relative to the box."""
        local = frames.compose(frames.inverse(self.box_pose), self.bunch_pose)[:3]
        return "the bunch lies at ({:.2f}, {:.2f}, {:.2f}) m beside the middle of the box".format(*local)
