"""Plans of the tasks of a robot client: paths, picks, box exchanges, meetings."""

from __future__ import annotations

import dataclasses
import heapq
import math
from collections.abc import Iterator

import numpy as np

from vinesim.client.tasks.start_poses import PlacementError, bunch_centres, ground_clearance
from vinesim.core import frames
from vinesim.robot.tasks.meet_person import MeetPlan
from vinesim.robot.tasks.pick import PickPlan
from vinesim.robot.tasks.swap_boxes import SwapPlan
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.terrain import above_ground, on_ground
from vinesim.world import Physics

# Paths of a base on the ground around posts, trunks, wires and boxes: A* on a grid, then straightened.


GRID_SIZE = 0.1
"""[m] Cell size of the grid on which paths are searched."""
MARGIN = 3.0
"""[m] Distance by which the grid extends beyond start and goal."""

Cell = tuple[int, int]


def find_path(model: Model, start: np.ndarray, goal: np.ndarray, clearance: float) -> np.ndarray | None:
    """Returns waypoints [n, 2] m of a short path with ``clearance`` [m] on either side, ends included; None if there is
    none.

    Waypoints of the grid that a straight line can replace are dropped.
    """
    low = np.minimum(start, goal) - MARGIN
    shape = tuple((np.ceil((np.maximum(start, goal) + MARGIN - low) / GRID_SIZE)).astype(int))
    at = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 2)
    free = (ground_clearance(model, low + GRID_SIZE * at) > clearance).reshape(shape)
    first, last = (_cell(np.round((p - low) / GRID_SIZE)) for p in (start, goal))
    if not free[last] or float(ground_clearance(model, np.array([start]))[0]) < clearance:
        return None
    cells = search_grid(free, first, last)
    if cells is None:
        return None
    points = [start, *(low + GRID_SIZE * np.array(cell) for cell in cells[1:-1]), goal]
    kept = [points[0]]
    i = 0
    while i < len(points) - 1:
        i = next(
            j
            for j in range(len(points) - 1, i, -1)
            if j == i + 1 or _is_line_free(model, points[i], points[j], clearance)
        )
        kept.append(points[i])
    return np.array(kept)


def search_grid(free: np.ndarray, first: Cell, last: Cell) -> list[Cell] | None:
    """Returns the shortest path over the cells that are ``free`` [n, m] bool, both ends included; None if there is
    none.

    A* with eight neighbours and Euclidean costs (Hart, Nilsson and Raphael 1968).
    """
    moves = [(i, j, float(np.hypot(i, j))) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    previous: dict[Cell, Cell] = {first: first}
    cost = {first: 0.0}
    queue = [(0.0, first)]
    while queue:
        _, here = heapq.heappop(queue)
        if here == last:
            break
        for i, j, length in moves:
            there = (here[0] + i, here[1] + j)
            if not (0 <= there[0] < free.shape[0] and 0 <= there[1] < free.shape[1] and free[there]):
                continue
            price = cost[here] + length
            if price < cost.get(there, np.inf):
                cost[there] = price
                previous[there] = here
                ahead = float(np.hypot(there[0] - last[0], there[1] - last[1]))
                heapq.heappush(queue, (price + ahead, there))
    if last not in previous:
        return None
    cells = [last]
    while cells[-1] != first:
        cells.append(previous[cells[-1]])
    return cells[::-1]


def _cell(index: np.ndarray) -> Cell:
    """Returns the integer indices of the cell at ``index`` [2]."""
    return int(index[0]), int(index[1])


def _is_line_free(model: Model, start: np.ndarray, end: np.ndarray, clearance: float) -> bool:
    """Returns whether the straight line from ``start`` to ``end`` [2] m has ``clearance`` [m] on either side."""
    count = max(int(np.linalg.norm(end - start) / (0.5 * GRID_SIZE)), 2)
    line = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
    return bool((ground_clearance(model, line) > clearance - 0.5 * GRID_SIZE).all())


# Planning of picks: chooses bunch, base pose, box and path.
#
# It uses only the geometry of the model at rest: clearances of bunches, room for the base, paths on the ground.


BUNCH_AHEAD = 0.88
"""[m] Distance of the bunch ahead of the base at the pick."""
BUNCH_ASIDE = 0.28
"""[m] Distance of the bunch to the arm's side of the base at the pick."""
HAND_LOWER = np.array([-0.45, -0.11, -0.05])
"""[m] Lower corner of the box that an open hand sweeps around the grasp; x along the hand, z up."""
HAND_UPPER = np.array([0.06, 0.11, 0.09])
"""Upper corner of the box that an open hand sweeps around the grasp [m]; x along the hand, z up."""
GRASP_HEIGHT = (1.3, 1.75)
"""[m] Range of heights of the grasp that arm and lift reach easily with a level hand; :data:`REACHED_HEIGHT` is all
that they reach."""
REACHED_HEIGHT = (1.2, 1.85)
"""[m] Range of heights of the grasp that arm and lift reach with a level hand."""
MAX_BUNCH_RADIUS = 0.060
"""[m] Largest radius of a bunch that fits easily between the fingers; :data:`GRASPED_RADIUS` is the largest at all."""
GRASPED_RADIUS = 0.068
"""[m] Largest radius of a bunch that fits between the fingers, 7 mm less than half of their opening."""
GRASP_DEPTH = 0.06
"""[m] Approximate distance of the grasp below the upper end of a bunch."""
MIN_HAND_CLEARANCE = 0.005
"""[m] Smallest gap between the moving hand and anything but its bunch. GUESSED"""
FULL_CLEARANCE = 0.03
"""Largest gap between hand and obstacles that counts in the rating of a grasp [m]; wider gaps count as this. GUESSED"""
BASE_CLEARANCE = 0.68
"""Free distance that a base with folded arms needs around its centre [m]."""
BOX_AHEAD = 0.10
BASE_HALF_WIDTH = 0.35
BOX_GAP = 0.06
"""Gap between a box and the side of the base [m]. ``BOX_AHEAD`` is the distance of the box ahead of the base's centre,
and ``BASE_HALF_WIDTH`` half of the base's width."""
APPROACH_LENGTHS = (1.1, 0.8)
"""[m] Lengths of the straight approach along a box; the first one with room is used."""
LANE_HALF_WIDTH = 0.36
"""[m] Free distance that a base driving straight needs on either side of its centre."""
OBSTACLE_RADIUS = 0.8
"""[m] Distance from a bunch beyond which obstacles cannot touch the hand."""
OBSTACLE_SPACING = 0.04
"""[m] Largest distance between the spheres that represent trellis and old wood."""
MAX_CANDIDATES = 200
"""Number of nearest bunches that are tried."""


def plan_picks(model: Model, near: np.ndarray) -> Iterator[PickPlan]:
    """Yields feasible plans, best first: bunches with the most clearance, with a preference for bunches near ``near``
    [2] m.

    Raises :class:`PlacementError` if no box can be approached or no bunch can be picked.
    """
    approaches = list(box_approaches(model))
    if not approaches:
        raise PlacementError(
            f"no box of this scene has {BASE_CLEARANCE} m of room beside it for a robot; place one in an alley"
        )
    found = False
    for bunch, side, base, _ in base_poses(model, near, MIN_HAND_CLEARANCE):
        beside = [approach for approach in approaches if approach.side == side]
        for approach in sorted(beside, key=lambda approach: float(np.linalg.norm(approach.start - base[:2]))):
            points = find_path(model, base[:2], approach.start, BASE_CLEARANCE)
            if points is not None:
                found = True
                path = np.concatenate([points[1:], [approach.place]])
                yield PickPlan(bunch, side, base, approach.box, path, approach.heading)
                break
    if not found:
        raise PlacementError(
            "no bunch hangs free enough for a hand and a path for a robot to a box; choose another seed"
        )


def freest_bases(model: Model, near: np.ndarray, distance: float) -> Iterator[tuple[int, str, np.ndarray, float]]:
    """Yields the bunches within ``distance`` [m] of ``near`` [2] m that a hand reaches, even without room for the hand.

    Each item has the bunch's number, the side of the arm, the pose [7] of the base where the hand has the most room,
    and the clearance [m] of the hand, at most :data:`FULL_CLEARANCE`. The clearance is negative if the open hand would
    overlap wood or fruit.
    """
    seen: set[int] = set()
    middles = bunch_centres(model)
    for bunch, side, base, clearance in base_poses(model, near, -np.inf, all_reached=True):
        if bunch not in seen and np.linalg.norm(middles[bunch, :2] - near) < distance:
            seen.add(bunch)
            yield bunch, side, base, clearance


def base_poses(
    model: Model, near: np.ndarray, min_clearance: float, *, all_reached: bool = False
) -> Iterator[tuple[int, str, np.ndarray, float]]:
    """Yields bunch, side, pose [7] of the base and clearance of the hand [m] for grasps with at least
    ``min_clearance`` [m], best first.

    ``all_reached``: also of bunches that are reached with effort (:data:`REACHED_HEIGHT`, :data:`GRASPED_RADIUS`).
    """
    body_q = model.forward_kinematics(model.joint_settled)[model.bunch_body]
    axis = frames.rotate(body_q[:, 3:], np.array([1.0, 0.0, 0.0]))
    hold = body_q[:, :3] + GRASP_DEPTH * axis
    height = above_ground(model.terrain, hold)
    low, high = REACHED_HEIGHT if all_reached else GRASP_HEIGHT
    thickest = GRASPED_RADIUS if all_reached else MAX_BUNCH_RADIUS
    fits = (height > low) & (height < high) & (model.bunch_radius <= thickest) & (axis[:, 2] < -0.95)
    nearest = np.flatnonzero(fits)
    away = np.linalg.norm(hold[nearest, :2] - near, axis=1)
    bunches = np.sort(nearest[np.argsort(away, kind="stable")][:MAX_CANDIDATES])
    points, radius, owner = _obstacles(model)
    return grasp_poses(
        model, near, bunches, hold[bunches], model.bunch_length[bunches], (points, radius, owner), min_clearance
    )


def grasp_poses(
    model: Model,
    near: np.ndarray,
    numbers: np.ndarray,
    hold: np.ndarray,
    length: np.ndarray,
    obstacles: tuple[np.ndarray, np.ndarray, np.ndarray],
    min_clearance: float,
) -> Iterator[tuple[int, str, np.ndarray, float]]:
    """Yields number of the bunch, side, pose [7] of the base and clearance of the hand [m] for grasps, best first.

    ``model``: only its ground and fixed pieces are used. ``numbers`` [n] of bunches with their grasps ``hold`` [n, 3] m
    and lengths ``length`` [n] m. ``obstacles``: spheres around the hand: centres [k, 3] m, radii [k] m, and the number
    [k] of the bunch that each belongs to, -1 for none.
    """
    points, radius, owner = obstacles
    middle = hold.mean(0) if len(hold) else np.zeros(3)
    reached = np.linalg.norm(hold - middle, axis=1).max(initial=0.0) + OBSTACLE_RADIUS
    region = np.linalg.norm(points - middle, axis=1) < reached
    points = points[region]
    radius = radius[region]
    owner = owner[region]
    heading = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    turn = frames.from_yaw(heading)
    sides = np.stack(
        [frames.rotate(turn, np.array([BUNCH_AHEAD, y, 0.0]))[:, :2] for y in (BUNCH_ASIDE, -BUNCH_ASIDE)], 1
    )
    base = hold[:, None, None, :2] - sides  # [bunch, heading, side, 2]
    roomy = (ground_clearance(model, base.reshape(-1, 2)) > BASE_CLEARANCE).reshape(base.shape[:3])
    found = []
    for i, bunch in enumerate(numbers.tolist()):
        here = (np.linalg.norm(points - hold[i], axis=1) < OBSTACLE_RADIUS) & (owner != bunch)
        low = HAND_LOWER - [0.0, 0.0, max(float(length[i]) - GRASP_DEPTH - 0.05, 0.0)]
        looking = np.flatnonzero(roomy[i].any(1))
        local = frames.rotate(frames.conjugate(turn[looking])[:, None], points[here] - hold[i])
        beyond = np.maximum(low - local, local - HAND_UPPER)
        apart = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(-1), 0.0)
        for j, clear in zip(
            looking.tolist(), (apart - radius[here]).min(-1, initial=FULL_CLEARANCE).tolist(), strict=True
        ):
            for k in np.flatnonzero(roomy[i, j]).tolist() if clear >= min_clearance else ():
                score = clear - 0.01 * float(np.linalg.norm(base[i, j, k] - near))
                pose = on_ground(model.terrain, frames.pose(np.append(base[i, j, k], 0.0), turn[j]))
                found.append((-score, bunch, ("left", "right")[k], pose, clear))
    for _, bunch, side, pose, clear in sorted(found, key=lambda entry: entry[:3]):
        yield bunch, side, pose, clear


def _obstacles(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fill wood, trellis and bunches at rest with spheres.

    Returns centres [n, 3] m, radii [n] m, and the bunch of each sphere [n], -1 if it is not part of a bunch.
    """
    body_q = model.forward_kinematics(model.joint_settled).astype(float)
    owner = model.bunch_of_body()
    wood = np.flatnonzero(np.isin(model.body_organ, (Organ.CANE, Organ.PEDUNCLE)))
    share = np.linspace(0.0, 1.0, 4)
    along = share[None] * model.body_length[wood, None]
    axis = frames.rotate(body_q[:, 3:], np.array([1.0, 0.0, 0.0]))
    points = body_q[wood, None, :3] + along[..., None] * axis[wood, None]
    radius = np.full(points.shape[:2], 0.006)
    middles = bunch_centres(model)[:, None]
    depth = np.linspace(-0.8, 0.8, 5)
    bunch_axis = axis[model.bunch_body]
    fruit = middles + (0.5 * model.bunch_length[:, None] * depth)[..., None] * bunch_axis[:, None]
    plump = model.bunch_radius[:, None] * np.sqrt(1.0 - depth**2)
    still, thick = _fixed_spheres(model)
    owners = np.repeat(owner[wood], len(share)), np.repeat(np.arange(len(model.bunch_body)), len(depth))
    return (
        np.concatenate([points.reshape(-1, 3), fruit.reshape(-1, 3), still]),
        np.concatenate([radius.ravel(), plump.ravel(), thick]),
        np.concatenate([*owners, np.full(len(still), -1)]),
    )


def _fixed_spheres(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Returns spheres along all fixed pieces: centres [n, 3] m and radii [n] m."""
    along = (model.fixed_end - model.fixed_start).astype(float)
    count = np.ceil(np.linalg.norm(along, axis=1) / OBSTACLE_SPACING).astype(int) + 1
    piece = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count)
    share = number / np.maximum(count - 1, 1)[piece]
    return model.fixed_start[piece] + share[:, None] * along[piece], model.fixed_radius[piece].max(1).astype(float)


@dataclasses.dataclass(frozen=True)
class BoxApproach:
    """A position of the base next to a box, and the start of the straight approach to it."""

    box: int
    side: str
    place: np.ndarray
    """Position of the base next to the box [2] m."""
    start: np.ndarray
    """Start of the approach [2] m."""
    heading: float
    """Heading of the base [rad]."""


def box_approaches(model: Model) -> Iterator[BoxApproach]:
    """Yields all positions along the long sides of boxes with room for a base and its approach."""
    for box, (pose, size) in enumerate(zip(model.box_pose.astype(float), model.box_size.astype(float), strict=True)):
        long = frames.rotate(pose[3:], np.array([1.0, 0.0, 0.0]) if size[0] >= size[1] else np.array([0.0, 1.0, 0.0]))
        apart = BASE_HALF_WIDTH + BOX_GAP + 0.5 * float(size[:2].min())
        for along in (1.0, -1.0):
            ahead = along * long[:2]
            for side, hand in (("left", 1.0), ("right", -1.0)):
                place = pose[:2] - BOX_AHEAD * ahead - hand * apart * np.array([-ahead[1], ahead[0]])
                for run in APPROACH_LENGTHS:
                    start = place - run * ahead
                    line = start + np.linspace(0.0, run + 0.1, 16)[:, None] * ahead
                    room = float(ground_clearance(model, line, without=box).min())
                    if room > LANE_HALF_WIDTH and float(ground_clearance(model, start[None])[0]) > BASE_CLEARANCE:
                        yield BoxApproach(box, side, place, start, float(np.arctan2(ahead[1], ahead[0])))
                        break


# Planning of box exchanges: paths between the boxes, and filling of a box for the start.


TURNING_RADIUS = 0.92
"""Free distance around its centre that a carrier (a robot with a box at either end) needs to turn [m]."""
TURNING_DISTANCES = (1.20, 1.35, 1.50)
"""[m] Distances from the centre of a box at which a carrier may turn; the first one with room is used."""
CARRYING_HALF_WIDTH = 0.40
"""[m] Free distance on either side of its centre that a carrier needs to drive straight."""
BUNCHES_PER_LAYER = 6
"""Number of bunches in one layer of a filled box."""


def plan_swap(model: Model, start: np.ndarray, full: int = 0, empty: int = 1) -> SwapPlan:
    """Plan the exchange of two boxes, from a base at ``start`` [7]. Raises :class:`PlacementError` if there is no room.

    ``full``, ``empty``: numbers of the boxes that are full and empty at the start.
    """
    if max(full, empty) >= len(model.box_pose):
        raise PlacementError(f"no box {max(full, empty)}: this scene has {len(model.box_pose)}; name more in its file")
    here = start[:2]
    legs = []
    for box in (empty, full):
        ways = [find_path(model, here, place, TURNING_RADIUS) for place in turning_places(model, box)]
        ways = [points for points in ways if points is not None]
        if not ways:
            raise PlacementError(
                f"no way for a carrier to turn before box {box}: it needs {TURNING_RADIUS} m around it; move the box"
            )
        shortest = min(ways, key=lambda points: float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()))
        legs.append(shortest[1:])
        here = shortest[-1]
    return SwapPlan(start, full, empty, *legs)


def turning_places(model: Model, box: int) -> list[np.ndarray]:
    """Returns positions [2] m in front of the long sides of a box, with room for a carrier to turn and to drive
    straight to the box."""
    pose = model.box_pose[box].astype(float)
    size = model.box_size[box].astype(float)
    across = np.array([0.0, 1.0, 0.0]) if size[0] >= size[1] else np.array([1.0, 0.0, 0.0])
    normal = frames.rotate(pose[3:], across)[:2]
    places = []
    for side in (1.0, -1.0):
        for far in TURNING_DISTANCES:
            place = pose[:2] + far * side * normal
            lane = pose[:2] + np.linspace(0.1, far, 12)[:, None] * side * normal
            if (
                ground_clearance(model, place[None])[0] > TURNING_RADIUS
                and ground_clearance(model, lane, without=box).min() > CARRYING_HALF_WIDTH
            ):
                places.append(place)
                break
    return places


def fill_box(physics: Physics, box: int, count: int = 6) -> None:
    """Detach ``count`` bunches and put them into a box in layers, as the start of an exchange.

    Call it between steps. It takes the bunches farthest from the box, so that the bunches around the box stay.
    """
    model = physics.model
    pose = model.box_pose[box].astype(float)
    size = model.box_size[box].astype(float)
    apart = np.linalg.norm(physics.state.body_q[model.bunch_body, :2] - pose[:2], axis=1)
    attached = np.flatnonzero(physics.state.bunch_attached)
    chosen = attached[np.argsort(-apart[attached], kind="stable")][:count]
    columns = BUNCHES_PER_LAYER // 2
    for i, bunch in enumerate(chosen.tolist()):
        layer, place = divmod(i, BUNCHES_PER_LAYER)
        column = place % columns
        row = place // columns
        x = (column - 0.5 * (columns - 1)) * (size[0] - 0.04) / columns
        y = (row - 0.5) * 0.5 * (size[1] - 0.04)
        # along y, centred at (x, y)
        start = np.array([x, y - 0.5 * float(model.bunch_length[bunch]), 0.10 + 0.14 * layer])
        physics.pick(bunch)
        turned = frames.pose(start, frames.from_yaw(0.5 * np.pi))
        physics.rigid.place_bunch(bunch, frames.compose(pose, turned), np.zeros(6))


# Planning of a meeting: the bunch that a person picks, and the place where a carrier with a box waits.


REACH = 0.55
"""[m] Horizontal distance of a standing person from the bunch or box that it reaches for. GUESSED"""
CLAMPED_BOX_DISTANCE = 0.75
"""[m] Approximate distance of a clamped box from the centre of the carrier."""
PERSON_CLEARANCE = 0.30
"""[m] Free distance that a person needs around it to stand and walk. GUESSED"""
BUNCH_HEIGHT = (1.1, 1.75)
"""[m] Range of heights of a bunch's centre that a hand reaches easily. GUESSED"""
MAX_PULL = 75.0
"""[N] Largest pull that a chosen bunch may need to come off its vine; a hand pulls with 100 N."""
MIN_BEND = 0.3
"""[N m] Least bending strength of a chosen bunch's peduncle. A weaker one breaks when a hand reaches for its bunch."""
KEPT_AWAY = 2.2
"""Distance of the carrier from the place where the person picks [m]: half the carrier's length, the box, and some steps
back. GUESSED"""
MAX_PATHS = 3
"""Number of waiting places that are tried for each place of a person; a search takes a second."""
DISTANCES = (1.2, 1.5, 1.8, 2.2)
"""Distances from the place where the person picks to the place where the person puts the bunch into the box [m]; the
first one with room is used."""


def plan_meeting(model: Model, near: np.ndarray, box: int = 0) -> MeetPlan:
    """Plan a meeting of a person with a carrier that starts at ``near`` [7] and fetches ``box``.

    The place is the bunch nearest to the box that has room for person and carrier. Raises :class:`PlacementError` if
    there is none.
    """
    if box >= len(model.box_pose):
        raise PlacementError(f"no box {box}: this scene has {len(model.box_pose)}; name more in its file")
    ways = [find_path(model, near[:2], place, TURNING_RADIUS) for place in turning_places(model, box)]
    ways = [points for points in ways if points is not None]
    if not ways:
        raise PlacementError(f"no way for a carrier to box {box}: it needs {TURNING_RADIUS} m around it; move the box")
    to_box = min(ways, key=lambda points: float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()))
    centres = bunch_centres(model)
    height = above_ground(model.terrain, centres)
    fits = (height > BUNCH_HEIGHT[0]) & (height < BUNCH_HEIGHT[1]) & (model.bunch_pull < MAX_PULL)
    fits &= model.bunch_bend > MIN_BEND
    order = np.argsort(np.linalg.norm(centres[:, :2] - to_box[-1], axis=1), kind="stable")
    for bunch in order[fits[order]].tolist():
        for stand in _standing_places(model, centres[bunch, :2]):
            if not _keeps_away(to_box, stand):
                continue
            for heading, base in _waiting_places(model, stand)[:MAX_PATHS]:
                path = find_path(model, to_box[-1], base, TURNING_RADIUS)
                if path is not None and _keeps_away(path, stand):
                    return MeetPlan(bunch, stand, box, to_box[1:], path[1:], heading)
    raise PlacementError("no bunch hangs where a person and a carrier have room beside each other; choose another seed")


def _keeps_away(path: np.ndarray, stand: np.ndarray) -> bool:
    """Returns whether a carrier on its ``path`` [n, 2] m keeps the distance :data:`KEPT_AWAY` from a person at
    ``stand`` [2] m."""
    start = path[:-1]
    way = np.diff(path, axis=0)
    share = np.clip(((stand - start) * way).sum(1) / np.maximum((way * way).sum(1), 1e-12), 0.0, 1.0)
    return bool(np.linalg.norm(start + share[:, None] * way - stand, axis=1).min() > KEPT_AWAY)


def _standing_places(model: Model, bunch: np.ndarray) -> np.ndarray:
    """Returns places [k, 2] m around a bunch [2] m with room for a person, most room first."""
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    places = bunch + REACH * np.stack([np.cos(angles), np.sin(angles)], 1)
    room = ground_clearance(model, places)
    return places[np.argsort(-room, kind="stable")][: int((room > PERSON_CLEARANCE).sum())]


def _waiting_places(model: Model, stand: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Returns headings [rad] and places [2] m of a carrier whose box a person can reach straight from ``stand`` [2]
    m."""
    found = []
    for far in DISTANCES:
        for angle in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False).tolist():
            ahead = np.array([math.cos(angle), math.sin(angle)])
            gives = stand + far * ahead
            base = gives + (REACH + CLAMPED_BOX_DISTANCE) * ahead
            way = stand + np.linspace(0.0, far, 12)[:, None] * ahead
            if (
                ground_clearance(model, way).min() > PERSON_CLEARANCE
                and ground_clearance(model, base[None])[0] > TURNING_RADIUS
            ):
                found.append((math.atan2(-ahead[1], -ahead[0]), base))
    return found
