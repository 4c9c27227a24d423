"""The picking job: reach for a bunch, hold it, cut its stalk, carry it to a box and lay it in.

    pick = PickBunch(physics, robot, task)
    while not pick.done:
        pick.control(time)
        robot.control(time)
        physics.step()
    assert pick.picked, pick.reason

The hand is led through Jacobians (:mod:`vinesim.robot.control.cartesian_controller`); where bunch, box and base are is asked every tick, and no
joint angle is written down. The fingers hold by friction with a force that is asked for; the blade is the cutter's.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from vinesim import frames
from vinesim.physics.rigid.static_world import CRATE_WALL
from vinesim.physics.step import Physics
from vinesim.robot.control.cartesian_controller import CartesianController, axes_of_pose
from vinesim.robot.control.waypoint_follower import WaypointFollower
from vinesim.robot.drives.commands import CommandError
from vinesim.robot.drives.robot import Robot
from vinesim.robot.tasks.task import Task, TaskFailed

STALK_LENGTH = 0.012
"""So much of the stalk stays on the bunch [m]."""
OPENING_MARGIN = 0.015
"""On either side the fingers open wider than the bunch by this [m]."""
APPROACH_DISTANCE = 0.20
"""From so far the hand comes straight to the bunch, and so far it goes back with it [m]."""
GRASP_FORCE = 25.0
"""Force of each finger [N]: a bunch of 1 kg needs 6 N at a friction of 0.8, the rest is for the way."""
MIN_GRASP_FORCE = 8.0
"""Fingers that feel as much hold something [N]."""
POSITION_TOLERANCE = 0.01
"""A hand so near is there [m]."""
ORIENTATION_TOLERANCE = 0.12
"""A hand turned so exactly is turned [rad]."""
CARRY_POSITION = np.array([0.45, 0.12, 1.20])
"""Where the left hand is while the base drives, in the base's axes [m]; the right one's is mirrored."""
CLEARANCE_ABOVE_RIM = 0.50
"""From so far above its rim the hand goes down into a box [m]."""
RELEASE_HEIGHT = 0.19
"""Height of the hand above the bottom of the box when it lets go [m]: vinebot's arm reaches no deeper beside its base,
and the lower end of a bunch hangs some 0.12 m below the hand.
"""
CARRY_SPEED = 0.20
"""Speed of a hand that carries [m/s]."""
RELEASE_OPENING = 0.05
"""The fingers let go by opening this much further [m]; more would touch the walls."""
MAX_SLIP = 0.12
"""A bunch farther from the hand than this [m] has been lost."""


@dataclasses.dataclass(frozen=True)
class PickPlan:
    """What to pick, with which arm, and where to take it."""

    bunch: int
    side: str
    """``"left"`` or ``"right"``."""
    base_pose: np.ndarray
    """[7] base from which the bunch is picked: it hangs ahead of the arm's shoulder."""
    box: int
    path: np.ndarray
    """[n, 2] m, from the stand to where the box is beside the base, on the arm's side."""
    final_heading: float
    """[rad] of the base at the end of the way."""


class PickBunch(Task):
    """One bunch from its vine into a box; ``done``, ``picked`` and ``reason`` say how it went."""

    key_phases = frozenset({"cut", "back"})

    def __init__(self, physics: Physics, robot: Robot, plan: PickPlan, *, timeout: float = 90.0) -> None:
        """``robot`` has been fitted with its cutters (:meth:`Robot.fit_cutters`)."""
        super().__init__(robot, timeout=timeout)
        self.physics, self.plan = physics, plan
        self.arm = CartesianController(robot, plan.side)
        cutter = next((c for c in robot.description.cutters if c.group == self.arm.gripper), None)
        if cutter is None:
            raise CommandError(f"{robot.name} has no gripper with a cutter on its {plan.side} arm; give one that has")
        self._cutter = cutter.frame
        model, bunch = physics.model, plan.bunch
        self._body = int(model.bunch_body[bunch])
        self._length, self._radius = float(model.bunch_length[bunch]), float(model.bunch_radius[bunch])
        self._fingers = robot.description.joint_indices(self.arm.gripper)
        above = np.linalg.norm(robot.frame_pose(self._cutter)[:3] - robot.frame_pose(self.arm.tool)[:3])
        self._grasp_depth = min(float(above) - STALK_LENGTH, 0.6 * self._length)
        """How far below its upper end the bunch is held [m]."""
        self._tool_z = np.array([0.0, 0.0, 1.0])

    @property
    def picked(self) -> bool:
        """Whether the bunch came to lie in the box."""
        return self.succeeded

    def report(self) -> dict[str, Any]:
        """See :class:`Task`."""
        where = {"bunch": self.plan.bunch, "side": self.plan.side, "box": self.plan.box}
        return {"picked": self.picked, **where, "bunch_kg": round(self.mass, 4), **super().report()}

    def focus(self) -> np.ndarray:
        """See :class:`Task`."""
        return self._grasp_point()

    @property
    def mass(self) -> float:
        """Of the bunch [kg]."""
        return float(self.physics.model.body_mass[self._body])

    @property
    def bunch_pose(self) -> np.ndarray:
        """Where the bunch is [7]: its upper end, x along its axis."""
        if self.physics.state.bunch_attached[self.plan.bunch]:
            return self.physics.state.body_q[self._body].astype(float)
        return self.physics.rigid.bunch_pose(self.plan.bunch)

    @property
    def box_pose(self) -> np.ndarray:
        """Where the box is [7]: the middle of its underside."""
        rigid = self.physics.rigid
        return rigid.visual_q()[[link.name for link in rigid.visuals()].index(f"box/{self.plan.box}")]

    @property
    def in_box(self) -> bool:
        """Whether the bunch's middle is between the walls of the box."""
        middle = frames.compose(self.bunch_pose, frames.pose([0.5 * self._length, 0.0, 0.0]))
        local = frames.compose(frames.inverse(self.box_pose), middle)[:3]
        size = self.physics.model.box_size[self.plan.box].astype(float)
        return bool((np.abs(local[:2]) < 0.5 * size[:2]).all() and 0.0 < local[2] < size[2])

    # ------------------------------------------------------------------ the job

    def run(self) -> Iterator[str]:
        """See :class:`Task`."""
        ahead = frames.rotate(self._base_pose()[3:], np.array([1.0, 0.0, 0.0]))
        self.arm.reset()
        self._open_gripper(2.0 * (self._radius + OPENING_MARGIN))
        yield from self._move_hand(
            "reach", lambda: self._grasp_point() - APPROACH_DISTANCE * ahead, ahead, patience=12.0
        )
        yield from self._move_hand("advance", self._grasp_point, ahead, speed=0.10, patience=8.0, near=0.003)
        yield from self._close_gripper(ahead)
        yield from self._cut()
        back = self.arm.tip_position - APPROACH_DISTANCE * ahead + [0.0, 0.0, -0.03]
        yield from self._move_hand("back", lambda: back, ahead, speed=0.15, patience=6.0)
        yield from self._move_hand(
            "tuck", lambda: self._base_to_world(CARRY_POSITION), ahead, speed=CARRY_SPEED, patience=10.0, near=0.03
        )
        yield from self._drive()
        yield from self._place_in_box()
        yield from self.wait(1.0, "rest")
        if not self.in_box:
            raise TaskFailed(self._describe_bunch())

    def _close_gripper(self, ahead: np.ndarray) -> Iterator[str]:
        """Close the fingers with a force that is no more than :data:`GRIP`."""
        rigid, name = self.robot.rigid, self.robot.name
        stiffness = np.array([self.robot.description.drives[i].stiffness for i in self._fingers])
        end, firm = self.time + 4.0, 0
        while firm < 30:
            position, _, _, contact = rigid.joint_measurements(name)
            here, felt = position[self._fingers], np.abs(contact[self._fingers])
            firm = firm + 1 if (felt > MIN_GRASP_FORCE).all() else 0
            if self.time > end:
                raise TaskFailed(
                    f"the fingers feel {felt.min():.0f} N, at {here.sum():.3f} m between them: nothing to hold"
                )
            self.robot.command_position(here - GRASP_FORCE / stiffness, self._fingers)
            yield "close"

    def _cut(self) -> Iterator[str]:
        """Close the blade, again if it caught nothing."""
        for _ in range(5):
            self.robot.command_cutter(self.arm.gripper)
            yield "cut"
            if not self.physics.state.bunch_attached[self.plan.bunch]:
                return
            yield from self.wait(0.2, "cut")
        raise TaskFailed(f"the blade closed beside the stalk: {self._describe_stalk()}")

    def _drive(self) -> Iterator[str]:
        """Take the bunch to where the box is in reach."""
        way = WaypointFollower(self.robot, self.plan.path, self.plan.final_heading, turn_rate=0.3)
        while not way.is_done:
            self.arm.hold_position()
            way.control(self.time)
            if way.is_stuck:
                raise TaskFailed("something keeps the base from going on")
            self._check_grasp()
            yield "drive"

    def _place_in_box(self) -> Iterator[str]:
        """Over the box, down into it with the fingers first, so that the bunch lies; let go, and up again."""
        base, down = self._base_pose(), np.array([0.0, 0.0, -1.0])
        along = frames.rotate(base[3:], np.array([1.0, 0.0, 0.0]))
        rim = float(self.physics.model.box_size[self.plan.box, 2])
        # turned down, the bunch points back to where the base looks from
        middle = self.box_pose[:3] + (0.5 * self._length - self._grasp_depth) * along
        over, low = middle - (rim + CLEARANCE_ABOVE_RIM) * down, middle - (CRATE_WALL + RELEASE_HEIGHT) * down
        yield from self._move_hand("over", lambda: over, along, speed=CARRY_SPEED, patience=12.0)
        self._tool_z = along
        yield from self._move_hand("turn", lambda: over, down, patience=6.0)
        yield from self._move_hand("lower", lambda: low, down, speed=0.15, patience=8.0, near=0.03)
        opening = self.robot.rigid.joint_measurements(self.robot.name)[0][self._fingers].sum()
        self._open_gripper(float(opening) + RELEASE_OPENING)
        yield from self.wait(0.8, "let go")
        yield from self._move_hand("rise", lambda: over, down, speed=0.2, patience=8.0, near=0.05)

    # ------------------------------------------------------------------ what the steps are made of

    def _move_hand(
        self, phase: str, goal: Callable[[], np.ndarray], ahead: np.ndarray, *, speed: float = 0.35, patience: float,
        near: float = POSITION_TOLERANCE,
    ) -> Iterator[str]:  # fmt: skip
        """Lead the hand to ``goal`` [3] in the world, pointing ``ahead`` [3]; :class:`TaskFailed` if it does not come."""
        end = self.time + patience
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
            self.arm.move_towards(there, ahead, self._tool_z, speed=speed, shoulder_height=float(there[2]))
            yield phase

    def _check_grasp(self) -> None:
        """:class:`TaskFailed` if the bunch has left its vine and not come along."""
        if not self.physics.state.bunch_attached[self.plan.bunch]:
            off = float(np.linalg.norm(self._grasp_point() - self.arm.tip_position))
            if off > MAX_SLIP:
                raise TaskFailed(f"the bunch slipped out of the fingers, it is {off:.2f} m from them")

    def _grasp_point(self) -> np.ndarray:
        """Where the bunch is to be held [3] m."""
        return frames.compose(self.bunch_pose, frames.pose([self._grasp_depth, 0.0, 0.0]))[:3]

    def _open_gripper(self, opening: float) -> None:
        widest = float(self.robot.upper_limit[self._fingers].sum())
        self.robot.command_gripper(self.arm.gripper, min(opening, widest))

    def _base_pose(self) -> np.ndarray:
        return self.robot.rigid.base_state(self.robot.name)[0]

    def _base_to_world(self, point: np.ndarray) -> np.ndarray:
        """A point [3] given for the left arm in the base's axes, in the world."""
        mirror = np.array([1.0, 1.0 if self.plan.side == "left" else -1.0, 1.0])
        return frames.compose(self._base_pose(), frames.pose(mirror * point))[:3]

    def _describe_stalk(self) -> str:
        """Where the stalk is in the cutter's axes, in words."""
        cutter = self.robot.frame_pose(self._cutter)
        stalk = frames.compose(frames.inverse(cutter), self.bunch_pose)[:3]
        return "its lower end is at ({:.3f}, {:.3f}, {:.3f}) m in the mouth".format(*stalk)

    def _describe_bunch(self) -> str:
        """Where the bunch lies, in words."""
        local = frames.compose(frames.inverse(self.box_pose), self.bunch_pose)[:3]
        return "the bunch lies at ({:.2f}, {:.2f}, {:.2f}) m beside the middle of the box".format(*local)
