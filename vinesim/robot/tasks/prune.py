"""The pruning task: drive along a row, and cut dormant canes at given places.

The hand points to the row with its blades below it, so that it is above the cut and touches only wood that falls. Poses
of canes are read from the physics in every step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.interaction.detachment import Blade
from vinesim.robot.control.cartesian_controller import CartesianController, axes_of_pose
from vinesim.robot.control.waypoint_follower import WaypointFollower
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.robot.tasks.task import Task, TaskFailed
from vinesim.scene.values import Detachment
from vinesim.world import Physics

APPROACH = 0.18
"""[m] Length of the straight motion towards the cane, and back. GUESSED"""
OPENING = 0.15
"""[m] Opening of the fingers, which pass beside the cane."""
REACHED = 0.004
"""[m] Distance from its place at which the mouth closes."""
NEAR_ENOUGH = 0.012
"""[m] Distance from its place at which a mouth that is held up closes nevertheless."""
TURNED = 0.25
"""[rad] Error of the hand's orientation at which the mouth may close."""
MAX_SHIFT = 0.012
"""[m] Largest distance of a cane from the middle of the mouth, which is 40 mm wide."""
MOUTH = 0.040
"""[m] Width of the mouth."""
BAR = 0.023
"""[m] Distance of the bars beside the mouth from its middle."""
BAR_ROOM = 0.013
"""[m] Distance between the axes of a bar and of a cane within which they may touch."""
REACH_OF_BLADES = 0.035
"""[m] Distance ahead of and behind the middle of the mouth within which wood may be caught."""
LENGTH_OF_BARS = 0.10
"""[m] Distance behind the middle of the mouth up to which its bars reach."""
MAX_CLOSURES = 3
"""Number of times that the blades close for one cut."""
DOWN = np.array([0.0, 0.0, -1.0])


@dataclasses.dataclass(frozen=True, eq=False)
class WoodCut:
    """A cut that is wanted."""

    cane: int
    body: int
    along: float
    """Place of the cut on the x axis of ``body`` [m]."""
    is_kept: bool
    """Whether the cane is shortened; otherwise it is removed."""
    ahead: np.ndarray
    """[3] Direction of the hand, level."""


def mouth_shift(off: np.ndarray, is_kept: np.ndarray, ahead: np.ndarray) -> float:
    """Returns how far to the left of a cane the middle of the mouth is to be [m], so that no other cane is in the mouth
    and canes that stay do not touch its bars.

    ``off`` [n, 3] m: other canes at the height of the cut, seen from the cane. ``is_kept`` [n]: whether they stay.
    ``ahead`` [3]: direction of the hand.
    """
    left = frames.cross(np.array([0.0, 0.0, 1.0]), ahead)
    shifts = np.linspace(-MAX_SHIFT, MAX_SHIFT, 13)
    beside = np.abs((off @ left)[:, None] - shifts)
    along = (off @ ahead)[:, None]
    caught = (beside < 0.5 * MOUTH + REACHED) & (np.abs(along) < REACH_OF_BLADES)
    press = np.clip(1.0 - np.abs(beside - BAR) / BAR_ROOM, 0.0, None)
    press = np.where((along > -LENGTH_OF_BARS) & (along < REACH_OF_BLADES), press, 0.0)
    weight = np.where(is_kept, 1.0, 0.01)[:, None]
    cost = (weight * (100.0 * caught + 10.0 * press)).sum(0) + np.abs(shifts)
    return float(shifts[int(np.argmin(cost))])


@dataclasses.dataclass(frozen=True, eq=False)
class PruneStop:
    """A place of the base, and the cuts that are made there."""

    base_pose: np.ndarray
    """[7] Pose of the base, the row to its left."""
    cuts: tuple[WoodCut, ...]


@dataclasses.dataclass
class CutResult:
    """What became of a cut."""

    cane: int
    is_kept: bool
    done: bool
    off: float
    """Distance of the cut from the wanted place, along the cane [m]; NaN if there is none."""
    seconds: float
    reason: str
    """Why it was not done; empty if it was."""


class PruneCanes(Task):
    """Makes the cuts of several stops, one after the other. A cut that fails is left out. ``results`` has them all."""

    key_phases = frozenset({"cut"})

    def __init__(
        self, physics: Physics, robot: Robot, stops: Sequence[PruneStop], *, side: str = "left", timeout: float = 2000.0
    ) -> None:
        """``robot``: must have its cutters (:meth:`Robot.fit_cutters`).

        Raises :class:`CommandError` if its arm has no gripper with a cutter.
        """
        super().__init__(robot, timeout=timeout)
        self.physics = physics
        self.stops = tuple(stops)
        self.results: list[CutResult] = []
        self.arm = CartesianController(robot, side)
        cutter = next((c for c in robot.description.cutters if c.group == self.arm.gripper), None)
        if cutter is None:
            raise CommandError(f"{robot.name} has no gripper with a cutter on its {side} arm; give another robot")
        tool = robot.frame_pose(self.arm.tool)
        mouth = frames.compose(robot.frame_pose(cutter.frame), frames.pose(cutter.origin))
        self._mouth = frames.compose(frames.inverse(tool), mouth)[:3]
        """[3] m, middle of the mouth in the frame of the tool."""
        self._shift = 0.0
        """Distance of the middle of the mouth from the present cane, to the left of the hand [m]."""
        self._kept = {cut.cane for stop in self.stops for cut in stop.cuts if cut.is_kept}
        self._focus = frames.compose(robot.rigid.base_state(robot.name)[0], frames.pose([1.0, 1.0, 1.0]))[:3]

    def focus(self) -> np.ndarray:
        """Returns the point [3] m in the world at which the head camera is to look: the present cut."""
        return self._focus

    def report(self) -> dict[str, Any]:
        """Returns the result as plain values for JSON: cuts wanted and made, their errors, and each of them."""
        done = [one for one in self.results if one.done]
        return {
            "cuts_wanted": sum(len(stop.cuts) for stop in self.stops),
            "cuts_made": len(done),
            "largest_error_m": round(max((one.off for one in done), default=float("nan")), 4),
            "cuts": [dataclasses.asdict(one) for one in self.results],
            **super().report(),
        }

    def run(self) -> Iterator[str]:
        """The task. It fails if a cut was not made."""
        for stop in self.stops:
            yield from self._go_to(stop.base_pose)
            for cut in stop.cuts:
                start = self.time
                off, reason = float("nan"), ""
                try:
                    yield from self._make(cut)
                    off = self._error(cut)
                except TaskFailed as failure:
                    reason = f"{self.phase}: {failure}"
                yield from self._withdraw(cut)
                self.results.append(
                    CutResult(cut.cane, cut.is_kept, not reason, off, round(self.time - start, 2), reason)
                )
        missed = [one for one in self.results if not one.done]
        if missed:
            raise TaskFailed(f"{len(missed)} of {len(self.results)} cuts were not made; the first: {missed[0].reason}")

    def _go_to(self, place: np.ndarray) -> Iterator[str]:
        """Drive along the row to a pose [7] of the base."""
        here = self.robot.rigid.base_state(self.robot.name)[0]
        if np.linalg.norm(here[:2] - place[:2]) < 0.02:
            return
        follower = WaypointFollower(self.robot, place[None, :2], frames.to_yaw(place[3:]), speed=0.3)
        while not follower.is_done:
            self.arm.hold_position()
            follower.control(self.time)
            if follower.is_stuck:
                raise TaskFailed("the base is stuck")
            yield "go"

    def _make(self, cut: WoodCut) -> Iterator[str]:
        """Bring the mouth around the cane and close it."""
        self.robot.command_gripper(self.arm.gripper, OPENING)
        self._focus = self._place(cut)
        self._shift = mouth_shift(*self._neighbours(cut), cut.ahead)
        yield from self._move(
            "reach", lambda: self._tip(cut) - APPROACH * cut.ahead, cut, speed=0.35, timeout=10.0, near=0.02
        )
        try:
            yield from self._move("advance", lambda: self._tip(cut), cut, speed=0.10, timeout=4.0, near=REACHED)
        except TaskFailed:
            if self.arm.distance_to(self._tip(cut)) > NEAR_ENOUGH:
                raise
        blades = self.robot.cutter_blades(self.arm.gripper)
        for _ in range(MAX_CLOSURES):
            closed = [blade.closures for blade in blades]
            self.robot.command_cutter(self.arm.gripper)
            while any(blade.closures == before for blade, before in zip(blades, closed, strict=True)):
                self.arm.hold_position()
                yield "cut"
            self.arm.hold_position()
            yield "cut"
            if self._is_cut(cut):
                return
        strongest = max(blade.resistance for blade in blades)
        raise TaskFailed(
            f"the blades did not cut the cane: its wood needs {strongest:.0f} N, 0: it is not in the mouth"
        )

    def _withdraw(self, cut: WoodCut) -> Iterator[str]:
        """Draw the hand back the way it came; a hand that is held stays where it is."""
        back = self.arm.tip_position - APPROACH * cut.ahead
        try:
            yield from self._move("back", lambda: back, cut, speed=0.25, timeout=4.0, near=0.04)
        except TaskFailed:
            return

    def _move(
        self, phase: str, goal: Callable[[], np.ndarray], cut: WoodCut, *, speed: float, timeout: float, near: float
    ) -> Iterator[str]:
        """Move the hand to ``goal`` [3] m in the world with its blades down."""
        end = self.time + timeout
        self.arm.reset()
        while True:
            there = goal()
            axes = axes_of_pose(self.robot.frame_pose(self.arm.tool))
            off = float(np.arccos(np.clip((axes[0] @ cut.ahead + axes[2] @ DOWN) / 2.0, -1.0, 1.0)))
            if self.arm.distance_to(there) < near and (off < TURNED or phase != "advance"):
                return
            if self.time > end:
                raise TaskFailed(
                    f"the hand is {self.arm.distance_to(there):.3f} m and {off:.2f} rad off: out of reach, or held"
                )
            self.arm.move_towards(there, cut.ahead, DOWN, speed=speed, working_height=float(there[2]))
            yield phase

    def _tip(self, cut: WoodCut) -> np.ndarray:
        """Returns the place [3] m of the tool at which the cut is in the mouth."""
        left = frames.cross(np.array([0.0, 0.0, 1.0]), cut.ahead)
        # with the blades down the hand's y axis points to the right
        mouth = self._mouth[0] * cut.ahead - self._mouth[1] * left - self._mouth[2] * np.array([0.0, 0.0, 1.0])
        return self._place(cut) + self._shift * left - mouth

    def _place(self, cut: WoodCut) -> np.ndarray:
        """Returns where the cut is wanted [3] m in the world."""
        self.physics.update_kinematics()
        pose = self.physics.state.body_q[self._carrier(cut)].astype(float)
        return frames.compose(pose, frames.pose([cut.along, 0.0, 0.0]))[:3]

    def _neighbours(self, cut: WoodCut) -> tuple[np.ndarray, np.ndarray]:
        """Returns where other canes are at the height of a cut, seen from it [n, 3] m, and whether each stays [n]."""
        here = self._place(cut)
        nodes = self.physics.model.nodes
        state = self.physics.state
        places = nodes.positions(state.body_q, nodes.carriers(state.stump_of, state.stump_end))
        near = (np.linalg.norm((places - here)[:, :2], axis=1) < 0.3) & (np.abs(places[:, 2] - here[2]) < 0.2)
        near &= self.physics.model.canes.year[nodes.cane] == 1
        off: list[list[float]] = []
        kept: list[bool] = []
        for cane in np.unique(nodes.cane[near]).tolist():
            mine = places[near & (nodes.cane == cane)]
            mine = mine[np.argsort(mine[:, 2])]
            # a stub has its lowest node above the height of a cut near its base
            if cane != cut.cane and mine[0, 2] - 0.05 < here[2] < mine[-1, 2] + 0.02:
                off.append([float(np.interp(here[2], mine[:, 2], mine[:, axis])) for axis in (0, 1)] + [float(here[2])])
                kept.append(cane in self._kept)
        return np.array(off).reshape(-1, 3) - here, np.array(kept, bool)

    def _carrier(self, cut: WoodCut) -> int:
        """Returns the body that has the wanted place: the cane's, or the stump of an earlier cut beyond it."""
        state = self.physics.state
        stumps = np.flatnonzero((state.stump_of == cut.body) & (state.stump_end >= cut.along))
        return int(stumps[np.argmin(state.stump_end[stumps])]) if len(stumps) else cut.body

    def _is_cut(self, cut: WoodCut) -> bool:
        return any(self._parted(cut, blade.detachments) is not None for blade in self._blades())

    def _blades(self) -> tuple[Blade, ...]:
        return self.robot.cutter_blades(self.arm.gripper)

    def _parted(self, cut: WoodCut, detachments: Sequence[Detachment]) -> float | None:
        """Returns the distance [m] along the cane from the wanted place to where a blade has parted it; None if no
        detachment is of this cane."""
        model = self.physics.model
        state = self.physics.state
        first = int(model.canes.body[cut.cane])
        end = first + int(model.canes.size[cut.cane])
        wanted = float(model.body_length[first : cut.body].sum()) + cut.along
        for one in detachments:
            body = one.segment if one.segment >= 0 else one.body
            body = int(state.stump_of[body]) if state.stump_of[body] >= 0 else body
            if first <= body < end:
                at = one.at if one.segment >= 0 else 0.0
                return abs(float(model.body_length[first:body].sum()) + at - wanted)
        return None

    def _error(self, cut: WoodCut) -> float:
        found = [self._parted(cut, blade.detachments) for blade in self._blades()]
        return min(one for one in found if one is not None)
