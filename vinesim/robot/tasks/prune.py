"""The pruning task: drive along a row, and cut dormant canes at given places.

The hand points to the row with its blades below it, so that it is above the cut and touches only wood that falls. Poses
of canes are read from the physics in every step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any

import numpy as np

from vinesim.contact.bud_forces import bud_forces
from vinesim.core import frames
from vinesim.interaction.detachment import Blade
from vinesim.robot.control.cartesian_controller import CartesianController, axes_of_pose
from vinesim.robot.control.waypoint_follower import WaypointFollower
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.robot.tasks.mouth_place import ENOUGH, MouthPlace, Wood, WoodAround, hand_shape, mouth_place
from vinesim.robot.tasks.task import Task, TaskFailed
from vinesim.scene.values import Detachment
from vinesim.world import Physics

APPROACH = 0.18
"""[m] Length of the straight motion towards the cane, and back. GUESSED"""
OPENING = 0.15
"""[m] Opening of the fingers, which pass beside the cane."""
REACHED = 0.003
"""[m] Distance from its place at which the mouth closes."""
NEAR_ENOUGH = 0.006
"""[m] Distance across the blades within which a mouth that is held up closes nevertheless."""
MOUTH_MARGIN = 0.002
"""[m] Distance from the edge of the mouth that the wood must have then."""
TURNED = 0.25
"""[rad] Error of the hand's orientation at which it makes the last part of the way."""
SLOW = 0.03
"""[m/s] Speed of the hand on the :data:`LAST_WAY` where there is little room beside the mouth. GUESSED: 0.3 mm in
a step."""
LAST_WAY = 0.05
"""[m] Length of the last part of the way, which begins when the hand has turned: the bars are beside the cane then."""
TOUCH = 1.0
"""[N] Rise of its force on a bud that stays at which the hand stops. Forces of other canes do not count: canes press
each other by more where they cross, and these forces never rest."""
IN_LINE = 0.008
"""[m] Distance from its start at which the straight motion towards the cane begins."""
MAX_CLOSURES = 3
"""Number of times that the blades close for one cut."""
MAX_TRIES = 2
"""Number of directions from which one cut is tried at one stop."""
FOLDING_TIME = 4.0
"""[s] Longest time for that. GUESSED"""
MAX_FAILURES = 4
"""Number of failures after which a cut is tried a last time. GUESSED"""
FOLDING = 0.8
"""Share of the largest joint velocities with which the arm returns to a known posture. GUESSED"""
NEAR_STOP = 0.4
"""[m] Distance from a stop up to which its cuts are made from another one. GUESSED"""
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


@dataclasses.dataclass(frozen=True, eq=False)
class PruneStop:
    """A place of the base, and the cuts that are made there."""

    base_pose: np.ndarray
    """[7] Pose of the base, the row to its left."""
    cuts: tuple[WoodCut, ...]


def _apart(one: PruneStop, other: PruneStop) -> float:
    """Returns the distance of two stops [m]."""
    return float(np.linalg.norm((one.base_pose - other.base_pose)[:2]))


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


@dataclasses.dataclass(eq=False)
class _Waiting:
    """A cut that is not made yet."""

    stop: PruneStop
    cut: WoodCut
    tried: list[np.ndarray] = dataclasses.field(default_factory=list)
    """Directions [3] that were in vain from the present stop."""
    failures: int = 0
    seconds: float = 0.0
    """Time that was spent on it [s]."""


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
        self._mouth_pose = cutter.frame, frames.pose(cutter.origin)
        self._half = np.array(cutter.half)
        fingers = robot.description.groups[self.arm.gripper].joints
        moving = robot.description.moving_joints
        links = [moving.frames[moving.names.index(joint)][1] for joint in fingers]
        base = moving.frames[moving.names.index(fingers[0])][0]
        self._hand_links = tuple(dict.fromkeys([*links, base, cutter.frame]))
        self._at = MouthPlace(np.array([1.0, 0.0, 0.0]), 0.0, 0.0, 0.0, catches=False, cost=0.0)
        """How the mouth takes the present cane."""
        self._wood = WoodAround(physics.model)
        self._kept = {cut.cane: self._from_base(cut) for stop in self.stops for cut in stop.cuts if cut.is_kept}
        """[m] For each cane that is to be shortened: the way along it that stays."""
        self._kept_buds = self._buds_that_stay()
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
        """The task. At each stop the cut with the most room comes first. A cut that fails is tried again from another
        direction when the other cuts of the stop are made, then from the next stop if that is near enough. The task
        fails if a cut was not made."""
        waiting: list[_Waiting] = []
        for number, stop in enumerate(self.stops):
            yield from self._go_to(stop.base_pose)
            waiting += [_Waiting(stop, cut) for cut in stop.cuts]
            after = self.stops[number + 1] if number + 1 < len(self.stops) else None
            waiting = yield from self._prune_from_here(waiting, after)
        missed = [one for one in self.results if not one.done]
        if missed:
            raise TaskFailed(f"{len(missed)} of {len(self.results)} cuts were not made; the first: {missed[0].reason}")

    def _prune_from_here(
        self, waiting: list[_Waiting], after: PruneStop | None
    ) -> Generator[str, None, list[_Waiting]]:
        """Make cuts from the present place of the base. Returns those that wait for the stop ``after``: a cane that is
        to be cut off would be in the mouth, too, or the cut has failed."""
        left: list[_Waiting] = []
        here = list(waiting)
        for one in here:
            one.tried.clear()
        while here:
            places = [self._plan(one.cut, one.tried) for one in here]
            easiest = min(range(len(here)), key=lambda row: (len(here[row].tried), places[row].cost))
            one = here.pop(easiest)
            place = places[easiest]
            can_wait = after is not None and _apart(one.stop, after) < NEAR_STOP and one.failures < MAX_FAILURES
            if can_wait and (place.catches or len(one.tried) >= MAX_TRIES):
                left.append(one)
                continue
            start = self.time
            reason = ""
            try:
                yield from self._try(one.cut, place)
            except TaskFailed as failure:
                reason = f"{self.phase}: {failure}"
            yield from self._withdraw()
            if reason:
                yield from self._fold()
            one.seconds += self.time - start
            if reason and one.failures < MAX_FAILURES:
                one.failures += 1
                one.tried.append(place.ahead)
                here.append(one)
                continue
            cut = one.cut
            off = float("nan") if reason else self._error(cut)
            self.results.append(CutResult(cut.cane, cut.is_kept, not reason, off, round(one.seconds, 2), reason))
        return left

    def _go_to(self, place: np.ndarray) -> Iterator[str]:
        """Drive along the row to a pose [7] of the base."""
        here = self.robot.rigid.base_state(self.robot.name)[0]
        if np.linalg.norm(here[:2] - place[:2]) < 0.02:
            return
        follower = WaypointFollower(self.robot, place[None, :2], frames.to_yaw(place[3:]), speed=0.3)
        while not follower.is_done:
            self.arm.move_home(FOLDING)
            follower.control(self.time)
            if follower.is_stuck:
                raise TaskFailed("the base is stuck")
            yield "go"

    def _try(self, cut: WoodCut, place: MouthPlace) -> Iterator[str]:
        """Bring the mouth around the cane and close it."""
        self.robot.command_gripper(self.arm.gripper, OPENING)
        self._at = place
        self._focus = self._place(cut)
        try:
            yield from self._reach(cut)
        except TaskFailed:
            yield from self._fold()
            yield from self._reach(cut)
        try:
            yield from self._move(
                "advance",
                lambda: self._tip(cut) - LAST_WAY * place.ahead,
                speed=0.08 if place.cost > ENOUGH else 0.20,
                timeout=5.0,
                near=IN_LINE,
            )
            yield from self._move("advance", lambda: self._tip(cut), speed=self._speed(), timeout=4.0, near=REACHED)
        except TaskFailed:
            if not self._is_in_mouth(cut):
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

    def _reach(self, cut: WoodCut) -> Iterator[str]:
        """Bring the hand, turned, to the start of the straight motion towards the cane."""
        yield from self._move(
            "reach", lambda: self._tip(cut) - APPROACH * self._at.ahead, speed=0.35, timeout=4.0, near=IN_LINE
        )

    def _plan(self, cut: WoodCut, tried: Sequence[np.ndarray] = ()) -> MouthPlace:
        """Returns how the mouth takes a cane, among the wood around it as it is now."""
        wood = self._wood.around(self.physics.state, self._pose(cut), cut.cane, self._kept)
        return self._place_of_mouth(cut, wood, tried)

    def _place_of_mouth(self, cut: WoodCut, wood: Wood, tried: Sequence[np.ndarray]) -> MouthPlace:
        """Returns how the mouth takes a cane among other ``wood``."""
        link, offset = self._mouth_pose
        mouth = frames.compose(self.robot.frame_pose(link), offset)
        hand = hand_shape(self.robot.rigid, self.robot.name, self._hand_links, mouth, self._half)
        return mouth_place(wood, hand, cut.ahead, APPROACH, tried)

    def _withdraw(self) -> Iterator[str]:
        """Draw the hand back the way it came; a hand that is held stays where it is."""
        start = self.arm.tip_position
        try:
            out = start - LAST_WAY * self._at.ahead
            yield from self._move("back", lambda: out, speed=self._speed(), timeout=4.0, near=IN_LINE)
            back = start - APPROACH * self._at.ahead
            yield from self._move("back", lambda: back, speed=0.25, timeout=4.0, near=0.04)
        except TaskFailed:
            return

    def _speed(self) -> float:
        """Returns the speed of the hand [m/s] while its bars are beside the cane."""
        return SLOW if self._at.cost > ENOUGH else 0.10

    def _fold(self) -> Iterator[str]:
        """Bring the arm to its home posture, from which it reaches all cuts: an arm that has run into its joint limits
        with its elbow on the wrong side would stay there."""
        end = self.time + FOLDING_TIME
        while self.time < end and not self.arm.move_home(FOLDING):
            yield "fold"

    def _move(
        self, phase: str, goal: Callable[[], np.ndarray], *, speed: float, timeout: float, near: float
    ) -> Iterator[str]:
        """Move the hand to ``goal`` [3] m in the world with its blades down."""
        end = self.time + timeout
        self.arm.reset()
        at_rest = self._bud_forces()  # a hand that is held may press a bud already
        while True:
            there = goal()
            axes = axes_of_pose(self.robot.frame_pose(self.arm.tool))
            off = float(np.arccos(np.clip((axes[0] @ self._at.ahead + axes[2] @ DOWN) / 2.0, -1.0, 1.0)))
            if self.arm.distance_to(there) < near and (off < TURNED or phase == "back"):
                return
            if phase == "advance" and (self._bud_forces() > at_rest + TOUCH).any():
                raise TaskFailed("a bud that stays is touched")
            if self.time > end:
                raise TaskFailed(
                    f"the hand is {self.arm.distance_to(there):.3f} m and {off:.2f} rad off: out of reach, or held"
                )
            self.arm.move_towards(there, self._at.ahead, DOWN, speed=speed, working_height=float(there[2]))
            yield phase

    def _is_in_mouth(self, cut: WoodCut) -> bool:
        """Returns whether the wanted place is between the blades."""
        link, offset = self._mouth_pose
        mouth = frames.compose(self.robot.frame_pose(link), offset)
        at = frames.rotate(frames.conjugate(mouth[3:]), self._place(cut) - mouth[:3])
        room = np.array([-MOUTH_MARGIN, -MOUTH_MARGIN, NEAR_ENOUGH])
        return bool((np.abs(at) < self._half + room).all())

    def _buds_that_stay(self) -> np.ndarray:
        """Returns the ids of the buds below the cuts of canes that are shortened [k]."""
        nodes = self.physics.model.nodes
        found = [np.zeros(0, int)]
        for cut in (cut for stop in self.stops for cut in stop.cuts if cut.is_kept):
            before = (nodes.body < cut.body) | ((nodes.body == cut.body) & (nodes.along < cut.along))
            found.append(nodes.bud[(nodes.cane == cut.cane) & (nodes.bud >= 0) & before])
        return np.concatenate(found)

    def _bud_forces(self) -> np.ndarray:
        """Returns the force [k] N of the robot on each bud that stays, in the last step."""
        physics = self.physics
        touching = [one for one in physics.contacts if one.actor == self.robot.name]
        if not touching or not len(self._kept_buds):
            return np.zeros(len(self._kept_buds))
        return bud_forces(physics.model, physics.state, touching)[self._kept_buds]

    def _tip(self, cut: WoodCut) -> np.ndarray:
        """Returns the place [3] m of the tool at which the cut is in the mouth."""
        ahead = self._at.ahead
        right = frames.cross(ahead, -DOWN)
        mouth = frames.rotate(self.robot.frame_pose(self.arm.tool)[3:], self._mouth)  # as the hand is turned now
        return self._place(cut) - self._at.depth * ahead - self._at.side * right - mouth

    def _place(self, cut: WoodCut) -> np.ndarray:
        """Returns where the cut is made [3] m in the world."""
        return frames.compose(self._pose(cut), frames.pose([self._at.slide, 0.0, 0.0]))[:3]

    def _pose(self, cut: WoodCut) -> np.ndarray:
        """Returns where the cut is wanted [7] in the world, the x axis along the cane."""
        self.physics.update_kinematics()
        pose = self.physics.state.body_q[self._carrier(cut)].astype(float)
        return frames.compose(pose, frames.pose([cut.along, 0.0, 0.0]))

    def _from_base(self, cut: WoodCut) -> float:
        """Returns the way [m] along the cane from its base to the wanted place."""
        model = self.physics.model
        return float(model.body_length[int(model.canes.body[cut.cane]) : cut.body].sum()) + cut.along

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
        wanted = self._from_base(cut)
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
