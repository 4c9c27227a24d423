"""Pruning by sight: the robot looks for canes with its own camera, plans the cuts by the rule, and cuts.

Where its blades felt no wood part, it looks again and corrects the place. A cane that is cut still hangs in its ties, a
centimetre above its stump. The detector follows it across such gaps, so that only the blades tell whether it is cut.

It knows its base and joints, the forces of its blades, the trellis, and where the vines are planted. It knows nothing
else of the simulation. What it does not see, the rule counts as wanted: the lengths of canes, and their distance from
the trunk's head.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from vinesim.client.tasks.pruning import ABOVE_BUD, CANE_AHEAD, REMOVED_AT, PruningRule, rating
from vinesim.client.tasks.start_poses import PlacementError, ground_clearance
from vinesim.core import frames
from vinesim.robot.control.waypoint_follower import WaypointFollower
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.mouth_place import KINDS, NEIGHBOURHOOD, SPACING, MouthPlace, Wood
from vinesim.robot.tasks.pick_seen import look
from vinesim.robot.tasks.prune import DOWN, MAX_TRIES, CutResult, PruneCanes, PruneStop, WoodCut
from vinesim.robot.tasks.sight import CaneEyes, RowMap, SeenCane
from vinesim.robot.tasks.task import TaskFailed
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.nodes import DormantCanes
from vinesim.scene.terrain import above_ground, on_ground
from vinesim.world import Physics

LOOK_SPACING = 0.3
"""[m] Distance along the row between the places from which the robot looks."""
ROW_DISTANCE = 0.80
"""[m] Distance of the base's centre from the row. The numbers of the detector are fitted to pictures from here."""
GAZE_AHEAD = 0.25
"""[m] Distance along the row, ahead of the base, of the place at which it looks."""
GAZE_ABOVE = 0.17
"""[m] Height of that place above the fruiting wire."""
TRIES = 2
"""Number of times that a cut is tried."""
LIFT_MARGIN = 0.02
"""[m] Distance of the lift from its lower end while the robot looks: from there canes are seen from the side."""
SAME_CANE = 0.014
"""[m] Mean distance between the axes of two sights of one cane."""
COMPARED = (0.05, 0.13)
"""[m] Part of a cane, from its base, that is compared."""
FEWEST_SIGHTS = 2
"""Number of pictures in which a cane must be seen."""
SPUR_ROOM = 0.055
"""[m] Distance between the bases of canes on one spur: an internode of a spur is up to 32 mm long."""
STOWED = (0.32, 0.36, 0.62)
"""[m] Place of the hand in the frame of the base while the robot looks at what it has cut: below the line of sight."""
STOW_TIME = 4.0
"""[s] Longest time in which the hand goes there."""
VINE_MARGIN = 0.1
"""[m] Way before and beyond the stretch of a vine from which the robot looks."""
ROW_ROOM = 0.42
"""[m] Free distance around the centre of a base that drives along a row."""


@dataclasses.dataclass(frozen=True, eq=False)
class VineStretch:
    """The part of a row that belongs to one vine, as a robot's map has it."""

    row: RowMap
    along: np.ndarray
    """[2] Direction of the row, in which the robot drives; the row is to its left."""
    foot: np.ndarray
    """[3] m, where the vine is planted."""
    half: float
    """[m] Half of the distance between vines."""

    @property
    def across(self) -> np.ndarray:
        """[2] Direction from the robot to the row."""
        return np.array([-self.along[1], self.along[0]])

    def lane(self, along: float) -> np.ndarray:
        """Returns the place [2] m of a base beside the row, ``along`` [m] from the vine's foot."""
        wire = self.row.wire[0, :2]
        beside = float((wire - self.foot[:2]) @ self.across)
        return self.foot[:2] + along * self.along + (beside - ROW_DISTANCE) * self.across

    def start(self, model: Model) -> np.ndarray:
        """Returns the pose [7] of a base from which the robot begins to look along the vine."""
        heading = math.atan2(self.along[1], self.along[0])
        place = self.lane(-self.half - VINE_MARGIN - GAZE_AHEAD)
        return on_ground(model.terrain, frames.pose(np.append(place, 0.0), frames.from_yaw(heading)))


def vine_stretch(model: Model, near: np.ndarray) -> VineStretch:
    """Returns the vine that is planted nearest to ``near`` [2] m and has room for a robot beside its row.

    ``model``: its trellis and the feet of its trunks are the robot's map. Raises :class:`PlacementError` if there is
    no wire or no vine, or no room.
    """
    wires = np.flatnonzero(model.fixed_organ == int(Organ.WIRE))
    feet = _feet(model)
    if not len(wires) or not len(feet):
        raise PlacementError("a robot prunes by sight along a wire, and this scene has none; give another scene")
    start = model.fixed_start[wires].astype(float)
    end = model.fixed_end[wires].astype(float)
    for foot in feet[np.argsort(np.linalg.norm(feet[:, :2] - near, axis=1), kind="stable")]:
        middle = 0.5 * (start + end)
        mine = np.flatnonzero(np.linalg.norm(middle[:, :2] - foot[:2], axis=1) < 3.0)
        if not len(mine):
            continue
        ahead = frames.normalize((end - start)[mine[0]] * [1.0, 1.0, 0.0])[:2]
        side = np.array([-ahead[1], ahead[0]])
        mine = mine[np.abs((middle[mine, :2] - foot[:2]) @ side) < 0.3]
        if not len(mine):
            continue
        lowest = mine[np.argmin(middle[mine, 2])]
        if (near - foot[:2]) @ side > 0.0:
            ahead = -ahead
        posts = model.fixed_start[model.fixed_organ == int(Organ.POLE)].astype(float)[:, :2]
        radius = model.fixed_radius[model.fixed_organ == int(Organ.POLE)]
        posts = posts[np.abs((posts - start[lowest, :2]) @ side) < 0.3]
        row = RowMap(np.stack([start[lowest], end[lowest]]), posts, float(radius.max(initial=0.0)))
        ways = np.abs((feet[:, :2] - foot[:2]) @ ahead)
        beside = np.abs((feet[:, :2] - foot[:2]) @ side) < 0.5
        apart = float(ways[beside & (ways > 0.2)].min(initial=2.0))
        stretch = VineStretch(row, ahead, foot, 0.5 * apart)
        lane = np.array([stretch.lane(at) for at in (-0.5 * apart, 0.0, 0.5 * apart)])
        if float(ground_clearance(model, lane).min()) > ROW_ROOM:
            return stretch
    raise PlacementError(f"no vine has {ROW_ROOM} m of room for a robot that drives along its row")


def _feet(model: Model) -> np.ndarray:
    """Returns where vines are planted [n, 3] m."""
    trunks = np.flatnonzero(model.fixed_organ == int(Organ.TRUNK))
    if not len(trunks):
        return np.zeros((0, 3))
    start = model.fixed_start[trunks].astype(float)
    low = start[above_ground(model.terrain, start) < 0.02]
    return np.unique(low.round(4), axis=0)


@dataclasses.dataclass
class RememberedCane:
    """A cane that was seen, perhaps several times."""

    number: int
    sights: list[SeenCane]

    @property
    def seen(self) -> SeenCane:
        """The sight in the middle of all, by the height of the second node."""
        heights = [float(one.at(one.nodes[1])[2]) for one in self.sights]
        return self.sights[int(np.argsort(heights, kind="stable")[len(heights) // 2])]


class CaneMemory:
    """What a robot remembers of a row: canes, each once."""

    def __init__(self) -> None:
        self.canes: list[RememberedCane] = []

    def add(self, canes: tuple[SeenCane, ...]) -> None:
        """Remember what a picture shows; a cane that is seen twice in it counts once."""
        new: dict[int, SeenCane] = {}
        for seen in canes:
            if seen.is_cut_off or len(seen.nodes) < 2:
                continue
            apart = [min(axis_distance(seen, other.points) for other in one.sights) for one in self.canes]
            if apart and min(apart) < SAME_CANE:
                new.setdefault(int(np.argmin(apart)), seen)
            else:
                new[len(self.canes)] = seen
                self.canes.append(RememberedCane(len(self.canes), [seen]))
                continue
        for number, seen in new.items():
            if seen not in self.canes[number].sights:
                self.canes[number].sights.append(seen)

    def sure(self) -> list[RememberedCane]:
        """Returns the canes that were seen in :data:`FEWEST_SIGHTS` pictures or more. Of canes at one place, which is
        one cane seen differently, the one with most sights counts."""
        found: list[RememberedCane] = []
        for one in sorted(self.canes, key=lambda one: -len(one.sights)):
            if len(one.sights) < FEWEST_SIGHTS:
                break
            if all(axis_distance(one.seen, other.seen.points) > SAME_CANE for other in found):
                found.append(one)
        return sorted(found, key=lambda one: one.number)


def axis_distance(seen: SeenCane, axis: np.ndarray) -> float:
    """Returns the mean distance [m] of the lower part of a cane from an ``axis`` [n, 3] m."""
    mine = np.array([seen.at(along) for along in np.arange(*COMPARED, 0.01)])
    return float(np.linalg.norm(mine[:, None] - axis[None], axis=2).min(1).mean())


@dataclasses.dataclass(frozen=True, eq=False)
class SeenCut:
    """A cut that was planned from what was seen."""

    cane: int
    place: np.ndarray
    """[3] m in the world."""
    is_kept: bool


def spurs(canes: list[RememberedCane]) -> list[list[RememberedCane]]:
    """Returns the canes on each spur: those whose bases are near each other."""
    groups: list[list[RememberedCane]] = []
    for one in canes:
        near = [
            group
            for group in groups
            if any(np.linalg.norm(one.seen.base - other.seen.base) < SPUR_ROOM for other in group)
        ]
        groups = [group for group in groups if group not in near]
        groups.append([one, *(other for group in near for other in group)])
    return groups


def cut_along(seen: SeenCane, rule: PruningRule, is_kept: bool) -> float:
    """Returns the way [m] from the base of a cane to where the rule cuts it."""
    return float(seen.nodes[rule.buds - 1]) + ABOVE_BUD if is_kept else REMOVED_AT * float(seen.nodes[0])


def plan_cuts(canes: list[RememberedCane], rule: PruningRule, ground: float) -> list[list[SeenCut]]:
    """Returns the cuts of ``rule`` for each spur: first those that shorten kept canes. ``ground`` [m]: height of the
    vine's foot. The rule chooses by what is seen: thickness and height."""
    found = []
    for group in spurs(canes):
        table = DormantCanes.allocate(cane=len(group))
        table.year[:] = 1
        table.diameter[:] = [np.clip(one.seen.diameter, rule.thinnest, rule.thickest) for one in group]
        table.height[:] = [one.seen.base[2] - ground for one in group]
        table.length[:] = rule.length
        table.from_trunk[:] = rule.from_trunk
        order = np.argsort(rating(table, rule), kind="stable").tolist()
        cuts = []
        for rank, index in enumerate(order):
            seen = group[index].seen
            is_kept = rank < rule.keep
            if is_kept and len(seen.nodes) < rule.buds:
                continue
            cuts.append(SeenCut(group[index].number, seen.at(cut_along(seen, rule, is_kept)), is_kept))
        found.append(cuts)
    return found


class PruneBySight(PruneCanes):
    """Prunes one vine; all that concerns plants comes from the robot's camera."""

    def __init__(
        self,
        physics: Physics,
        robot: Robot,
        stretch: VineStretch,
        rule: PruningRule,
        eyes: CaneEyes,
        *,
        spurs: int | None = None,
        timeout: float = 2000.0,
    ) -> None:
        """``eyes``: takes and analyses a picture of a row. ``spurs``: largest number of spurs that are pruned; all
        unless given."""
        super().__init__(physics, robot, (), timeout=timeout)
        self.stretch = stretch
        self.rule = rule
        self.memory = CaneMemory()
        self.plan: dict[int, SeenCut] = {}
        """The cut of each remembered cane, by its number."""
        self._eyes = eyes
        self._spurs = spurs
        self._staying: set[int] = set()
        """Numbers of the canes that are shortened."""
        self._off: set[int] = set()
        """Numbers of canes that are cut off."""

    def report(self) -> dict[str, Any]:
        """As :meth:`PruneCanes.report`; the robot does not know the errors of its cuts."""
        return super().report() | {"canes_seen": len(self.memory.sure()), "largest_error_m": None}

    def run(self) -> Iterator[str]:
        """The task: look along the vine, plan and cut. It fails if a cut was not made."""
        yield from self._survey()
        self.stops = self._stops()
        if not self.stops:
            raise TaskFailed("the camera shows no cane that the robot can prune; give a scene with a date in winter")
        self._staying = {cut.cane for stop in self.stops for cut in stop.cuts if cut.is_kept}
        for stop in self.stops:
            yield from self._prune_at(stop)
        missed = [one for one in self.results if not one.done]
        if missed:
            raise TaskFailed(f"{len(missed)} of {len(self.results)} cuts were not made; the first: {missed[0].reason}")

    def _prune_at(self, stop: PruneStop) -> Iterator[str]:
        """Make the cuts of a stop. Where the blades felt no wood part, look again and try once more."""
        yield from self._go_to(stop.base_pose)
        cuts = stop.cuts
        results: dict[int, CutResult] = {}
        for _ in range(TRIES):
            for cut in cuts:
                start = self.time
                reason = ""
                try:
                    yield from self._make(cut, self._plan(cut))
                except TaskFailed as failure:
                    reason = f"{self.phase}: {failure}"
                yield from self._withdraw()
                spent = results[cut.cane].seconds if cut.cane in results else 0.0
                seconds = round(spent + self.time - start, 2)
                results[cut.cane] = CutResult(cut.cane, cut.is_kept, not reason, math.nan, seconds, reason)
            cuts = tuple(cut for cut in cuts if not results[cut.cane].done)
            if not cuts:
                break
            yield from self._stow()
            yield from self._look_at(
                CANE_AHEAD + float((stop.base_pose[:3] - self.stretch.foot)[:2] @ self.stretch.along)
            )
            self._correct(cuts, self._eyes.canes(self.stretch.row).canes)
        self.results += results.values()

    def _make(self, cut: WoodCut, place: MouthPlace) -> Iterator[str]:
        """Make a cut from ``place``, from another direction if that is in vain."""
        tried: list[np.ndarray] = []
        while True:
            try:
                yield from self._try(cut, place)
            except TaskFailed:
                tried.append(place.ahead)
                if len(tried) >= MAX_TRIES:
                    raise
                yield from self._withdraw()
                place = self._plan(cut, tried)
            else:
                return

    def _correct(self, cuts: tuple[WoodCut, ...], canes: tuple[SeenCane, ...]) -> None:
        """Correct the places of cuts by what the robot sees now; where a cane is not seen again, its place remains."""
        for cut in cuts:
            known = self.memory.canes[cut.cane].seen
            near = [one for one in canes if len(one.nodes) >= self.rule.buds]
            apart = [axis_distance(one, known.points) for one in near]
            if apart and min(apart) < SAME_CANE:
                seen = near[int(np.argmin(apart))]
                place = seen.at(cut_along(seen, self.rule, cut.is_kept))
                self.plan[cut.cane] = dataclasses.replace(self.plan[cut.cane], place=place)

    def _stow(self) -> Iterator[str]:
        """Bring the hand below the line of sight."""
        self.arm.reset()
        end = self.time + STOW_TIME
        across = np.append(self.stretch.across, 0.0)
        while self.time < end:
            place = frames.compose(self.robot.rigid.base_state(self.robot.name)[0], frames.pose(STOWED))[:3]
            if self.arm.distance_to(place) < 0.05:
                return
            self.arm.move_towards(place, across, DOWN, speed=0.35, working_height=float(place[2]))
            yield "stow"

    def _survey(self) -> Iterator[str]:
        """Drive along the vine and look at it from several places; drive back to the start."""
        reach = self.stretch.half + VINE_MARGIN
        places = np.arange(-reach - GAZE_AHEAD, reach - GAZE_AHEAD + 0.5 * LOOK_SPACING, LOOK_SPACING)
        heading = math.atan2(self.stretch.along[1], self.stretch.along[0])
        for along in places.tolist():
            place = frames.pose(np.append(self.stretch.lane(along), 0.0), frames.from_yaw(heading))
            yield from self._go_to(place)
            yield from self._look_at(along + GAZE_AHEAD)
            self.memory.add(self._eyes.canes(self.stretch.row).canes)
        follower = WaypointFollower(
            self.robot, self.stretch.lane(float(places[0]))[None], heading, speed=0.3, reverse=True
        )
        while not follower.is_done:
            self.arm.hold_position()
            follower.control(self.time)
            if follower.is_stuck:
                raise TaskFailed("the base is stuck")
            yield "go"

    def _look_at(self, along: float) -> Iterator[str]:
        """Lower the lift and turn the head to the row, ``along`` [m] from the vine's foot."""
        beside = self.stretch.lane(along) + ROW_DISTANCE * self.stretch.across
        self._focus = np.append(beside, float(self.stretch.row.wire[:, 2].mean()) + GAZE_ABOVE)
        lifts = self.robot.joint_indices(self.robot.description.groups["torso"].joints)
        self.robot.command_position(self.robot.lower_limit[lifts] + LIFT_MARGIN, lifts)
        yield from look(self, use_lift=False)

    def _stops(self) -> tuple[PruneStop, ...]:
        """Returns the stops along the vine: one for each spur."""
        along3 = np.append(self.stretch.along, 0.0)
        across3 = np.append(self.stretch.across, 0.0)
        inside = [
            one
            for one in self.memory.sure()
            if abs(float((one.seen.base - self.stretch.foot) @ along3)) < self.stretch.half
        ]
        found = []
        for cuts in plan_cuts(inside, self.rule, float(self.stretch.foot[2])):
            if not cuts:
                continue
            way = float(np.mean([(cut.place - self.stretch.foot) @ along3 for cut in cuts]))
            base = self.stretch.lane(way - CANE_AHEAD)
            heading = math.atan2(self.stretch.along[1], self.stretch.along[0])
            pose = on_ground(self.physics.model.terrain, frames.pose(np.append(base, 0.0), frames.from_yaw(heading)))
            self.plan |= {cut.cane: cut for cut in cuts}
            found.append(
                (way, PruneStop(pose, tuple(WoodCut(cut.cane, -1, 0.0, cut.is_kept, across3) for cut in cuts)))
            )
        found.sort(key=lambda one: one[0])
        return tuple(stop for _, stop in found[: self._spurs])

    def _pose(self, cut: WoodCut) -> np.ndarray:
        """Returns where the cut is planned [7] in the world, the x axis along the cane."""
        place = self.plan[cut.cane].place
        points = self.memory.canes[cut.cane].seen.points
        nearest = int(np.clip(np.linalg.norm(points - place, axis=1).argmin(), 1, len(points) - 2))
        return frames.pose(place, frames.from_x_axis(points[nearest + 1] - points[nearest - 1]))

    def _plan(self, cut: WoodCut, tried: Sequence[np.ndarray] = ()) -> MouthPlace:
        """Returns how the mouth takes a cane, among the canes that the robot remembers."""
        pose = self._pose(cut)
        return self._place_of_mouth(cut, self._remembered_wood(cut, pose), tried)

    def _remembered_wood(self, cut: WoodCut, pose: np.ndarray) -> Wood:
        """Returns the remembered canes near the place ``pose`` [7] of a cut. Of a cane that stays all counts as wood
        that stays: the robot knows its buds too badly."""
        points = []
        radius = []
        kind = []
        own = []
        for one in self.memory.sure():
            seen = one.seen
            length = float(np.linalg.norm(np.diff(seen.points, axis=0), axis=1).sum())
            along = np.arange(0.0, length, SPACING)
            at = np.stack([seen.at(float(way)) for way in along]) - pose[:3]
            near = np.linalg.norm(at, axis=1) < NEIGHBOURHOOD
            stays = one.number in self._staying
            mine = one.number == cut.cane
            loose = one.number in self._off or (mine and not stays)
            name = "loose" if loose else "stays" if stays else "goes"
            points.append(at[near])
            radius.append(np.full(int(near.sum()), 0.5 * seen.diameter))
            kind.append(np.full(int(near.sum()), KINDS.index(name)))
            own.append(np.full(int(near.sum()), mine))
        return Wood(
            np.concatenate(points),
            np.concatenate(radius),
            np.concatenate(kind),
            np.concatenate(own),
            frames.rotate(pose[3:], np.array([1.0, 0.0, 0.0])),
        )

    def _is_cut(self, cut: WoodCut) -> bool:
        """Returns whether the blades felt wood and met."""
        done = any(0.0 < blade.resistance <= blade.force for blade in self._blades())
        if done and not cut.is_kept:
            self._off.add(cut.cane)
        return done

    def _error(self, cut: WoodCut) -> float:
        """Returns NaN: the robot does not know it."""
        return float("nan")
