"""A harvest by sight: the robot looks for bunches with its own camera, chooses, picks, and checks by the camera.

It knows its base and joints, the trellis and the crates (as a map), and nothing else of the simulation. A survey visits
places around the start; every bunch that was seen there is remembered once.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Generator, Iterator

import numpy as np

from vinesim.client.tasks import planning
from vinesim.client.tasks.harvesting import Candidates, Grasp, Harvest, HarvestOptions
from vinesim.client.tasks.start_poses import ground_clearance
from vinesim.core import frames
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.pick import PickPlan
from vinesim.robot.tasks.pick_seen import PickSeenBunch, look
from vinesim.robot.tasks.sight import Eyes, SeenBunch, Sight
from vinesim.scene.model import Model
from vinesim.world import Physics

SURVEY_REACH = 3.0
"""[m] Distance from the start within which the robot looks for bunches and picks."""
SURVEY_MARGIN = 0.9
"""[m] Further distance up to which it looks from: bunches at the edge are seen from beyond, too."""
SURVEY_SPACING = 1.1
"""[m] Distance between the places from which it looks."""
GAZES = (-1.2, -0.4, 0.4, 1.2)
"""[rad] Directions of the head in which it looks at each place, to either side of the base."""
GAZE_HEIGHT = 1.72
"""[m] Height of the point at which it looks."""
GAZE_DISTANCE = 1.2
"""[m] Distance of this point."""
SURVEY_TIME = 600.0
"""[s] Further time for looking around, in addition to that of :class:`HarvestOptions`."""
MERGED = 0.09
"""[m] Horizontal distance below which two sights are of the same bunch: less than the width of one."""
WOOD_RADIUS = 0.008
"""[m] Radius of the sphere around a point of wood. GUESSED"""
STALK_ROOM = 0.03
"""[m] Horizontal distance from the axis of a bunch within which wood above it is its own stalk. GUESSED"""
WOOD_GRID = 0.02
"""[m] Edge of the cells of which each keeps one point of wood."""
FARTHEST_SIGHT = 1.6
"""[m] Distance up to which a sight is remembered."""


@dataclasses.dataclass
class RememberedBunch:
    """A bunch that was seen, perhaps several times."""

    number: int
    best: SeenBunch
    """The sight that is used: the nearest whole one."""
    sights: int = 1


class Memory:
    """What a robot remembers of the canopy: bunches, each once, and wood."""

    def __init__(self) -> None:
        self.bunches: list[RememberedBunch] = []
        self._wood: dict[tuple[int, int, int], np.ndarray] = {}

    def add(self, sight: Sight) -> None:
        """Remember what a picture shows."""
        for point in sight.wood:
            self._wood.setdefault(tuple(np.floor(point / WOOD_GRID).astype(int).tolist()), point)
        for seen in sight.bunches:
            if seen.distance > FARTHEST_SIGHT:
                continue
            same = [one for one in self.bunches if _is_same(one.best, seen)]
            if not same:
                self.bunches.append(RememberedBunch(len(self.bunches), seen))
                continue
            one = min(same, key=lambda one: float(np.linalg.norm((one.best.top - seen.top)[:2])))
            one.sights += 1
            if (seen.is_cut_off, seen.distance) < (one.best.is_cut_off, one.best.distance):
                one.best = seen

    def grasps(self, model: Model, near: np.ndarray) -> list[Grasp]:
        """Returns the grasps of the remembered bunches, best first: those in which the hand has room, then the others.

        ``model``: its trellis and crates are the robot's map.
        """
        bunches = [one for one in self.bunches if planning.REACHED_HEIGHT[0] < _hold(one.best)[2]]
        bunches = [one for one in bunches if _hold(one.best)[2] < planning.REACHED_HEIGHT[1]]
        if not bunches:
            return []
        numbers = np.array([one.number for one in bunches])
        hold = np.array([_hold(one.best) for one in bunches])
        length = np.array([one.best.length for one in bunches])
        return list(planning.grasp_poses(model, near, numbers, hold, length, self._obstacles(), -np.inf))

    def _obstacles(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns spheres around what a hand may not touch: centres [n, 3] m, radii [n] m, and the bunch of each [n],
        -1 for none."""
        share = np.linspace(-0.8, 0.8, 5)
        fruit = [one.best.centre + 0.5 * one.best.length * share[:, None] * [0.0, 0.0, 1.0] for one in self.bunches]
        plump = [one.best.radius * np.sqrt(1.0 - share**2) for one in self.bunches]
        owner = [np.full(len(share), one.number) for one in self.bunches]
        wood = np.array(list(self._wood.values())).reshape(-1, 3)
        of_wood = np.full(len(wood), -1)
        for one in self.bunches:
            off = wood - one.best.top
            beside = np.linalg.norm(off[:, :2], axis=1)
            stalk = (beside < STALK_ROOM) & (off[:, 2] > -0.02) & (off[:, 2] < 0.1)
            skin = (beside < one.best.radius + 0.02) & (off[:, 2] <= 0.0) & (off[:, 2] > -one.best.length)
            of_wood[stalk | skin] = one.number
        return (
            np.concatenate([wood, *fruit]),
            np.concatenate([np.full(len(wood), WOOD_RADIUS), *plump]),
            np.concatenate([of_wood, *owner]),
        )


def _is_same(one: SeenBunch, other: SeenBunch) -> bool:
    off = one.centre - other.centre
    return bool(np.linalg.norm(off[:2]) < MERGED and abs(off[2]) < 0.5 * max(one.length, other.length))


def _hold(seen: SeenBunch) -> np.ndarray:
    """Returns the grasp [3] m of a bunch."""
    return seen.top - np.array([0.0, 0.0, planning.GRASP_DEPTH])


def survey_places(model: Model, near: np.ndarray) -> list[np.ndarray]:
    """Returns places [2] m around the start ``near`` [2] m from which the robot looks for bunches, in the order of a
    short tour."""
    reach = SURVEY_REACH + SURVEY_MARGIN
    steps = SURVEY_SPACING * np.arange(-np.floor(reach / SURVEY_SPACING), np.floor(reach / SURVEY_SPACING) + 1.0)
    places = near + np.stack(np.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2)
    places = places[np.linalg.norm(places - near, axis=1) < reach]
    left = list(places[ground_clearance(model, places) > planning.BASE_CLEARANCE])
    tour: list[np.ndarray] = []
    here = near
    while left:
        here = left.pop(int(np.argmin([np.linalg.norm(place - here) for place in left])))
        tour.append(here)
    return tour


def gaze_points(place: np.ndarray, heading: float) -> Iterator[np.ndarray]:
    """Yields the points [3] m at which the robot looks from ``place`` [2] m with its base at ``heading`` [rad]."""
    for turn in GAZES:
        ahead = np.array([math.cos(heading + turn), math.sin(heading + turn)])
        yield np.append(place + GAZE_DISTANCE * ahead, GAZE_HEIGHT)


class HarvestBySight(Harvest):
    """A harvest in which all that concerns plants comes from the robot's camera."""

    def __init__(self, physics: Physics, robot: Robot, options: HarvestOptions, near: np.ndarray, eyes: Eyes) -> None:
        """``near`` [2] m: the start. ``eyes``: takes and analyses a picture."""
        super().__init__(physics, robot, options)
        self.timeout += SURVEY_TIME
        self.memory = Memory()
        self._near = near
        self._eyes = eyes
        self._places = survey_places(physics.model, near)
        self._gaze: np.ndarray | None = None
        self._gone: set[int] = set()
        """Numbers of bunches that are picked or were not found again."""

    def focus(self) -> np.ndarray:
        """Returns the point [3] m in the world at which the head camera is to look."""
        return self._gaze if self._gaze is not None else super().focus()

    def new_pick(self, plan: PickPlan) -> PickSeenBunch:
        """Returns the task of one attempt."""
        self._gaze = None
        return PickSeenBunch(self.physics, self.robot, plan, self.memory.bunches[plan.bunch].best, self._eyes)

    def choose(self, given_up: set[int]) -> Generator[str, None, PickPlan | None]:
        """Plan the best bunch among those that were seen; look from further places while there is none."""
        self._gone |= {one.bunch for one in self.attempts if one.picked}
        while True:
            plan = self._best(given_up | self._gone)
            if plan is not None:
                return plan
            if not self._places:
                return None
            yield from self._survey(self._places.pop(0))

    def _best(self, without: set[int]) -> PickPlan | None:
        """Returns the plan of the best remembered bunch; None if there is none."""
        grasps = self.memory.grasps(self.physics.model, self._near)
        candidates = Candidates(self.physics.model, self._near, grasps)
        return candidates.next_plan(self._base()[:2], without, self.options, self.picked)

    def _survey(self, place: np.ndarray) -> Iterator[str]:
        """Drive to a place and look around."""
        here = self._base()
        heading = frames.to_yaw(here[3:])
        if planning.find_path(self.physics.model, here[:2], place, planning.BASE_CLEARANCE) is None:
            return
        for turn in (0.0, math.pi):
            yield from self._go_to(frames.pose(np.append(place, 0.0), frames.from_yaw(heading + turn)))
            for point in gaze_points(place, heading + turn):
                self._gaze = point
                yield from look(self)
                self.memory.add(self._eyes())
        self._gaze = None
