"""The task of picking several bunches into one crate: in an order, with retries, until the crate is full.

:class:`Harvest` does the work; a subclass chooses the bunches. :class:`HarvestByTruth` takes them from the model and
from poses of the simulation, :class:`~vinesim.client.tasks.seen_harvest.HarvestBySight` from the robot's own camera.
"""

from __future__ import annotations

import abc
import collections
import dataclasses
import enum
import math
from collections.abc import Generator, Iterator
from typing import Any

import numpy as np

from vinesim.client.tasks import planning
from vinesim.client.tasks.planning import BoxApproach
from vinesim.client.tasks.start_poses import PlacementError
from vinesim.client.vine_events import fruit_report
from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.robot.control.waypoint_follower import WaypointFollower
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.pick import PickBunch, PickPlan
from vinesim.robot.tasks.task import Task, TaskFailed
from vinesim.scene.model import Model
from vinesim.world import Physics

PLACES = tuple((x, y, z) for z in (0.0, 0.10) for x in (0.0, 0.17, -0.17) for y in (0.075, -0.075))
"""[m] Places of bunches in a crate of 60 x 40 cm, in the order of filling (:attr:`PickPlan.place`): two layers of six.
A bunch that is alone goes into the middle. GUESSED"""
SECONDS_PER_BUNCH = 90.0
"""[s] Time after which the harvest ends, for each bunch that is asked for and each retry."""


BOX_PHASES = frozenset({"over", "turn", "lower", "let go", "rise", "rest"})
"""Phases of a pick in which the base stands beside the crate."""


NO_BOX = f"no box of this scene has {planning.BASE_CLEARANCE} m of room beside it for a robot; place one in an alley"


class PickOrder(enum.StrEnum):
    """Which bunch is picked next."""

    FREEST = "freest"
    """The one with most room for the hand; a metre of way counts as much as a centimetre of room."""
    NEAREST = "nearest"
    """The one whose place for the base is nearest to the robot."""


@dataclasses.dataclass(frozen=True)
class HarvestOptions:
    """What is to be harvested."""

    bunches: int = 1
    """Number of bunches to pick; 0: until the crate is full or no bunch is left that the robot can try."""
    order: PickOrder = PickOrder.FREEST
    tries: int = 2
    """Number of times that a bunch is tried."""

    @classmethod
    def named(cls, bunches: int, order: str) -> HarvestOptions:
        """Returns the options with an order by its name. Raises :class:`UsageError` if there is no such order."""
        if order not in set(PickOrder):
            raise UsageError(f"no order {order!r}; give {' or '.join(PickOrder)}")
        if bunches < 0:
            raise UsageError(f"bunches is {bunches}; give the number to pick, or 0 for all")
        return cls(bunches, PickOrder(order))

    @property
    def most(self) -> int:
        """Largest number of bunches that go into the crate."""
        return min(self.bunches or len(PLACES), len(PLACES))

    @property
    def timeout(self) -> float:
        """Time after which the task fails [s]."""
        return SECONDS_PER_BUNCH * (self.most + self.tries - 1)


@dataclasses.dataclass
class Attempt:
    """Result of one attempt to pick a bunch."""

    bunch: int
    """Number of the bunch in the model; with cameras the number that the robot gave it."""
    picked: bool
    seconds: float
    """Duration, drive to the bunch included [s]."""
    reason: str
    """Why it failed; empty if it succeeded."""
    berries_burst: float = 0.0
    """Expected number of berries, of any bunch, whose skins burst in the attempt."""
    berries_lost: float = 0.0
    """Expected number of berries, of any bunch, that fell off in the attempt."""
    damage: float | None = None
    """Share of the berries of the bunch that was cut which burst or fell off; None if no bunch was cut."""


class Harvest(Task, abc.ABC):
    """Picks bunches, one after the other, and puts them into one crate."""

    key_phases = PickBunch.key_phases

    def __init__(self, physics: Physics, robot: Robot, options: HarvestOptions) -> None:
        """``robot``: must have its cutters (:meth:`Robot.fit_cutters`)."""
        super().__init__(robot, timeout=options.timeout)
        self.physics = physics
        self.options = options
        self.pick: PickBunch | None = None
        """The present attempt, or the last one."""
        self.attempts: list[Attempt] = []
        self._cut = 0
        """Number of bunches that the robot has cut."""
        self._hanging = int(physics.state.bunch_attached.sum())

    @property
    def picked(self) -> int:
        """Number of bunches that the robot has put into the crate."""
        return sum(one.picked for one in self.attempts)

    def focus(self) -> np.ndarray:
        """Returns the point [3] m in the world at which the head camera is to look."""
        if self.pick is not None:
            return self.pick.focus()
        return frames.compose(self._base(), frames.pose([1.5, 0.0, 1.7]))[:3]

    def report(self) -> dict[str, Any]:
        """Returns the result as plain values for JSON: number of bunches picked and tried, seconds, and each attempt.

        ``others_off`` counts bunches that left their vines without being cut as the bunch of an attempt.
        ``berries_burst`` and ``berries_lost`` are expected numbers of berries of all bunches.
        """
        reasons = collections.Counter(one.reason.split(":")[0] for one in self.attempts if one.reason)
        tried = len({one.bunch for one in self.attempts})
        off = self._hanging - int(self.physics.state.bunch_attached.sum())
        return {
            "picked": self.picked,
            "tried": tried,
            "attempts": len(self.attempts),
            "seconds": round(sum(one.seconds for one in self.attempts), 2),
            "full": self.picked == len(PLACES),
            "order": str(self.options.order),
            "failed_in_phase": dict(reasons),
            "others_off": off - self._cut,
            "berries_burst": round(sum(one.berries_burst for one in self.attempts), 2),
            "berries_lost": round(sum(one.berries_lost for one in self.attempts), 2),
            "bunches": [_rounded(one) for one in self.attempts],
            "last": None if self.pick is None else self.pick.report(),
            **super().report(),
        }

    # ------------------------------------------------------------------ the task

    def run(self) -> Iterator[str]:
        """The task. It fails if no bunch is in the crate at the end."""
        tries: collections.Counter[int] = collections.Counter()
        while self.picked < self.options.most:
            start = self.time
            burst, lost = self._berries()
            plan = yield from self.choose({bunch for bunch, count in tries.items() if count >= self.options.tries})
            if plan is None:
                break
            tries[plan.bunch] += 1
            yield from self._go_to(plan.base_pose)
            self.pick = pick = self.new_pick(plan)
            cut: list[int] = []
            while not pick.is_done:
                pick.control(self.time)
                yield pick.phase
                now = self._bunches_cut()
                self._cut += bool(now) and not cut
                cut += now
            self.attempts.append(result := Attempt(plan.bunch, pick.picked, self.time - start, pick.reason))
            if pick.is_cut:  # otherwise a bunch that failed hangs on its vine and is tried again
                tries[plan.bunch] = self.options.tries
            if pick.phase in BOX_PHASES:
                yield from self._leave_box(pick)
            else:
                yield from self._nested(pick, pick.withdraw())
            result.seconds = self.time - start
            after = self._berries()
            result.berries_burst = after[0] - burst
            result.berries_lost = after[1] - lost
            result.damage = self.physics.fruit_monitor.history(cut[0]).damage if cut else None
        if not self.picked:
            raise TaskFailed(self._why_empty())

    @abc.abstractmethod
    def choose(self, given_up: set[int]) -> Generator[str, None, PickPlan | None]:
        """Choose the next bunch; ``given_up`` has the numbers of those that are not tried again. Yields the name of
        the phase while the robot looks for one. Returns None if there is none."""

    def new_pick(self, plan: PickPlan) -> PickBunch:
        """Returns the task of one attempt."""
        return PickBunch(self.physics, self.robot, plan)

    def _bunches_cut(self) -> list[int]:
        """Returns the bunches that the robot's blades cut off in the last step."""
        mine = [one for one in self.physics.detachments if one.cause == "blade" and one.actor == self.robot.name]
        return [one.bunch for one in mine if one.bunch >= 0]

    def _berries(self) -> tuple[float, float]:
        """Returns the expected numbers of berries of all bunches that burst and that fell off so far."""
        fruit = fruit_report(self.physics)
        return fruit["berries_burst"], fruit["berries_lost"]

    def _why_empty(self) -> str:
        """Returns why no bunch is in the crate."""
        if not self.attempts:
            return "no bunch hangs where the robot can stand before it, reach it and drive to the crate"
        return f"{len(self.attempts)} attempts failed; the last one: {self.attempts[-1].reason}"

    def _go_to(self, place: np.ndarray) -> Iterator[str]:
        """Drive to a pose [7] of the base, unless it is there."""
        here = self._base()
        heading = frames.to_yaw(place[3:])
        turn = math.remainder(frames.to_yaw(here[3:]) - heading, 2.0 * math.pi)
        if np.linalg.norm(here[:2] - place[:2]) < 0.02 and abs(turn) < 0.02:
            return
        points = planning.find_path(self.physics.model, here[:2], place[:2], planning.BASE_CLEARANCE)
        if points is None:
            points = np.array([here[:2], place[:2]])
        yield from self._follow(WaypointFollower(self.robot, points[1:], heading))

    def _leave_box(self, pick: PickBunch) -> Iterator[str]:
        """Draw the hand in and drive back from the crate to where the base can turn. A bunch that is still in the hand
        is let go there."""
        yield from self._nested(pick, pick.fold())
        yield from self._follow(WaypointFollower(self.robot, pick.plan.path[-2:-1], reverse=True))

    def _follow(self, follower: WaypointFollower) -> Iterator[str]:
        fingers = {f"gripper_{side}": 0.08 for side in ("left", "right")}
        for gripper, opening in fingers.items():
            if gripper in self.robot.description.groups:
                self.robot.command_gripper(gripper, opening)
        while not follower.is_done:
            follower.control(self.time)
            if follower.is_stuck:
                raise TaskFailed("the base is stuck")
            yield "go"

    def _nested(self, pick: PickBunch, steps: Iterator[str]) -> Iterator[str]:
        """Do ``steps`` of a pick that has ended. A hand that does not come free ends the task."""
        while True:
            pick.time = self.time
            phase = next(steps, None)
            if phase is None:
                return
            yield phase

    def _base(self) -> np.ndarray:
        """Returns the pose [7] of the base in the world."""
        return self.robot.rigid.base_state(self.robot.name)[0]


class HarvestByTruth(Harvest):
    """A harvest that knows all bunches, wood and trellis from the model."""

    def __init__(self, physics: Physics, robot: Robot, options: HarvestOptions, candidates: Candidates) -> None:
        super().__init__(physics, robot, options)
        self._candidates = candidates

    def choose(self, given_up: set[int]) -> Generator[str, None, PickPlan | None]:
        """Return the next plan at once."""
        gone = set(np.flatnonzero(~self.physics.state.bunch_attached).tolist())
        yield from ()
        return self._candidates.next_plan(self._base()[:2], gone | given_up, self.options, self.picked)


def _rounded(attempt: Attempt) -> dict[str, Any]:
    """Returns an attempt as plain values for JSON, to three digits."""
    values = dataclasses.asdict(attempt)
    return {name: round(value, 3) if isinstance(value, float) else value for name, value in values.items()}


Grasp = tuple[int, str, np.ndarray, float]
"""Number of a bunch, side of the arm, pose [7] of the base, clearance of the hand [m]."""


class Candidates:
    """The grasps of a vineyard, from which plans are made in an order; all bunches go into the same box."""

    def __init__(self, model: Model, near: np.ndarray, grasps: list[Grasp], box: int | None = None) -> None:
        """``near`` [2] m: the start. ``grasps``: best first. ``box``: by default the box nearest to ``near`` that a
        base can approach.

        Raises :class:`PlacementError` if there is no such box.
        """
        self.model = model
        self.grasps = grasps
        self._approaches = list(planning.box_approaches(model))
        if box is not None:
            self._approaches = [one for one in self._approaches if one.box == box]
        if not self._approaches:
            raise PlacementError(NO_BOX)
        if box is None:
            box = min(self._approaches, key=lambda one: float(np.linalg.norm(one.place - near))).box
        self.box = box
        self._approaches = [one for one in self._approaches if one.box == box]

    @classmethod
    def of_model(cls, model: Model, near: np.ndarray) -> Candidates:
        """Returns the grasps of all bunches of a model: those that a hand reaches easily and has room at, best first,
        and then the others."""
        easy = list(planning.base_poses(model, near, planning.MIN_HAND_CLEARANCE))
        known = {(bunch, side, tuple(base)) for bunch, side, base, _ in easy}
        rest = planning.base_poses(model, near, -np.inf, all_reached=True)
        grasps = easy + [one for one in rest if (one[0], one[1], tuple(one[2])) not in known]
        box = next(planning.plan_picks(model, near)).box
        return cls(model, near, grasps, box)

    def next_plan(self, here: np.ndarray, without: set[int], options: HarvestOptions, placed: int) -> PickPlan | None:
        """Returns the plan of the next bunch, not one of ``without``, for a base at ``here`` [2] m; None if there is
        none. ``placed``: number of bunches in the box."""
        grasps = [one for one in self.grasps if one[0] not in without]
        if options.order is PickOrder.NEAREST:
            roomy = [one for one in grasps if one[3] >= planning.MIN_HAND_CLEARANCE]
            grasps = sorted(roomy, key=lambda one: float(np.linalg.norm(one[2][:2] - here))) + [
                one for one in grasps if one[3] < planning.MIN_HAND_CLEARANCE
            ]
        for bunch, side, base, _ in grasps:
            if not np.allclose(base[:2], here, atol=0.02) and self._path(here, base[:2]) is None:
                continue
            beside = [one for one in self._approaches if one.side == side]
            for approach in sorted(beside, key=lambda one: float(np.linalg.norm(one.start - base[:2]))):
                points = self._path(base[:2], approach.start)
                if points is not None:
                    return self._plan(bunch, side, base, approach, points, PLACES[placed] if options.most > 1 else None)
        return None

    def _path(self, start: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        return planning.find_path(self.model, start, goal, planning.BASE_CLEARANCE)

    def _plan(
        self,
        bunch: int,
        side: str,
        base: np.ndarray,
        approach: BoxApproach,
        points: np.ndarray,
        place: tuple[float, float, float] | None,
    ) -> PickPlan:
        place = place or (0.0, 0.0, 0.0)
        ahead = np.array([math.cos(approach.heading), math.sin(approach.heading)])
        path = np.concatenate([points[1:], [approach.place + place[0] * ahead]])
        return PickPlan(bunch, side, base, self.box, path, approach.heading, place)
