"""What a picking robot had better do: which bunch, from where, into which box, and along which way.

All of it is geometry of the model at rest: what hangs free, where a base has room, and what lies between.
"""

from __future__ import annotations

import dataclasses
import heapq
from collections.abc import Iterator

import numpy as np

from vinesim import frames
from vinesim.client.tasks.start_poses import PlacementError, bunch_centres, ground_clearance
from vinesim.robot.tasks.pick import PickPlan
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model

BUNCH_AHEAD, BUNCH_ASIDE = 0.88, 0.28
"""Where a bunch hangs that an arm picks, in the base's axes [m]: ahead, and on the arm's side."""
HAND_LOWER, HAND_UPPER = np.array([-0.45, -0.11, -0.05]), np.array([0.06, 0.11, 0.09])
"""What an open hand sweeps about the place where it holds a bunch [m]; x along the hand, z up."""
GRASP_HEIGHT = (1.3, 1.75)
"""[m] Where a bunch is held that arm and lift reach with the hand level."""
MAX_BUNCH_RADIUS = 0.060
"""Largest radius of a bunch that fits between the fingers [m]."""
GRASP_DEPTH = 0.06
"""A bunch is held about so far below its upper end [m]."""
MIN_HAND_CLEARANCE = 0.005
"""Least gap between the hand on its way and what does not belong to its bunch [m]."""
FULL_CLEARANCE = 0.03
"""A wider gap than this is no better [m]."""
BASE_CLEARANCE = 0.68
"""A base with an arm tucked in needs this much around its middle [m]."""
BOX_AHEAD, BASE_HALF_WIDTH, BOX_GAP = 0.10, 0.35, 0.06
"""How far before the base's middle a box stands beside it, half of the base's width, and between both [m]."""
APPROACH_LENGTHS = (1.1, 0.8)
"""The base comes straight along a box from so far [m]; the first that has room."""
LANE_HALF_WIDTH = 0.36
"""What a base that goes straight needs on either side of its middle [m]."""
OBSTACLE_RADIUS = 0.8
"""What hangs nearer than this to a bunch may be in the hand's way [m]."""
MAX_CANDIDATES = 200
"""So many of the nearest bunches are tried."""
GRID_SIZE = 0.1
"""[m] between the points of which a way is made."""


def plan_picks(model: Model, near: np.ndarray) -> Iterator[PickPlan]:
    """Tasks that look feasible, the best first: bunches that hang freest, a little better if ``near`` [2] m."""
    beside_boxes = list(box_approaches(model))
    if not beside_boxes:
        raise PlacementError(
            f"no box of this scene has {BASE_CLEARANCE} m of room beside it for a robot; place one in an alley"
        )
    found = False
    for bunch, side, stand in _base_poses(model, near):
        beside = [park for park in beside_boxes if park.side == side]
        for park in sorted(beside, key=lambda park: float(np.linalg.norm(park.start - stand[:2]))):
            points = find_path(model, stand[:2], park.start)
            if points is not None:
                found = True
                yield PickPlan(bunch, side, stand, park.box, np.concatenate([points[1:], [park.place]]), park.heading)
                break
    if not found:
        raise PlacementError(
            "no bunch hangs free enough for a hand with a way for a robot to a box; choose another seed"
        )


def _base_poses(model: Model, near: np.ndarray) -> Iterator[tuple[int, str, np.ndarray]]:
    """Bunch, side and pose [7] of the base, those with most clearance first."""
    points, radius, owner = _obstacles(model)
    body_q = model.forward_kinematics(model.joint_settled)[model.bunch_body]
    axis = frames.rotate(body_q[:, 3:], np.array([1.0, 0.0, 0.0]))
    hold = body_q[:, :3] + GRASP_DEPTH * axis
    fits = (
        (hold[:, 2] > GRASP_HEIGHT[0])
        & (hold[:, 2] < GRASP_HEIGHT[1])
        & (model.bunch_radius <= MAX_BUNCH_RADIUS)
        & (axis[:, 2] < -0.95)
    )
    bunches = np.flatnonzero(fits)
    away = np.linalg.norm(hold[bunches, :2] - near, axis=1)
    bunches = np.sort(bunches[np.argsort(away, kind="stable")][:MAX_CANDIDATES])
    middle = hold[bunches].mean(0) if len(bunches) else np.zeros(3)
    reached = np.linalg.norm(hold[bunches] - middle, axis=1).max(initial=0.0) + OBSTACLE_RADIUS
    region = np.linalg.norm(points - middle, axis=1) < reached
    points, radius, owner = points[region], radius[region], owner[region]
    heading = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    turn = frames.from_yaw(heading)
    sides = np.stack(
        [frames.rotate(turn, np.array([BUNCH_AHEAD, y, 0.0]))[:, :2] for y in (BUNCH_ASIDE, -BUNCH_ASIDE)], 1
    )
    base = hold[bunches, None, None, :2] - sides  # [bunch, heading, side, 2]
    roomy = (ground_clearance(model, base.reshape(-1, 2)) > BASE_CLEARANCE).reshape(base.shape[:3])
    found = []
    for i, bunch in enumerate(bunches.tolist()):
        here = (np.linalg.norm(points - hold[bunch], axis=1) < OBSTACLE_RADIUS) & (owner != bunch)
        low = HAND_LOWER - [0.0, 0.0, max(float(model.bunch_length[bunch]) - GRASP_DEPTH - 0.05, 0.0)]
        looking = np.flatnonzero(roomy[i].any(1))
        local = frames.rotate(frames.conjugate(turn[looking])[:, None], points[here] - hold[bunch])
        beyond = np.maximum(low - local, local - HAND_UPPER)
        apart = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(-1), 0.0)
        for j, clear in zip(
            looking.tolist(), (apart - radius[here]).min(-1, initial=FULL_CLEARANCE).tolist(), strict=True
        ):
            for k in np.flatnonzero(roomy[i, j]).tolist() if clear >= MIN_HAND_CLEARANCE else ():
                score = clear - 0.01 * float(np.linalg.norm(base[i, j, k] - near))
                pose = frames.pose(np.append(base[i, j, k], 0.0), turn[j])
                found.append((-score, bunch, ("left", "right")[k], pose))
    for _, bunch, side, pose in sorted(found, key=lambda entry: entry[:3]):
        yield bunch, side, pose


def _obstacles(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Balls that fill wood and bunches at rest: points [n, 3] m, radii [n] m, and whose bunch each belongs to [n]."""
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
    owners = np.repeat(owner[wood], len(share)), np.repeat(np.arange(len(model.bunch_body)), len(depth))
    return (
        np.concatenate([points.reshape(-1, 3), fruit.reshape(-1, 3)]),
        np.concatenate([radius.ravel(), plump.ravel()]),
        np.concatenate(owners),
    )


@dataclasses.dataclass(frozen=True)
class BoxApproach:
    """Where a base stands with a box beside it, and from where it comes there straight."""

    box: int
    side: str
    place: np.ndarray
    """[2] m"""
    start: np.ndarray
    """[2] m"""
    heading: float
    """[rad]"""


def box_approaches(model: Model) -> Iterator[BoxApproach]:
    """All places along the long sides of boxes that have room for a base and its way there."""
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


def find_path(model: Model, start: np.ndarray, goal: np.ndarray, room: float = BASE_CLEARANCE) -> np.ndarray | None:
    """Points [n, 2] m of a short way with ``room`` [m] on either side, ends included; None if there is none.

    A* on a grid (Hart, Nilsson and Raphael 1968), then every point is left out that a straight line makes needless.
    """
    low = np.minimum(start, goal) - 3.0
    shape = tuple((np.ceil((np.maximum(start, goal) + 3.0 - low) / GRID_SIZE)).astype(int))
    at = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 2)
    free = (ground_clearance(model, low + GRID_SIZE * at) > room).reshape(shape)
    first, last = (tuple(np.round((p - low) / GRID_SIZE).astype(int)) for p in (start, goal))
    if not free[last] or float(ground_clearance(model, np.array([start]))[0]) < room:
        return None
    steps = [(i, j, float(np.hypot(i, j))) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]
    came: dict[tuple[int, int], tuple[int, int]] = {first: first}
    cost = {first: 0.0}
    queue = [(0.0, first)]
    while queue:
        _, here = heapq.heappop(queue)
        if here == last:
            break
        for i, j, length in steps:
            there = (here[0] + i, here[1] + j)
            if not (0 <= there[0] < shape[0] and 0 <= there[1] < shape[1] and free[there]):
                continue
            price = cost[here] + length
            if price < cost.get(there, np.inf):
                cost[there], came[there] = price, here
                ahead = float(np.hypot(there[0] - last[0], there[1] - last[1]))
                heapq.heappush(queue, (price + ahead, there))
    if last not in came:
        return None
    cells = [last]
    while cells[-1] != first:
        cells.append(came[cells[-1]])
    points = [start, *(low + GRID_SIZE * np.array(cell) for cell in cells[-2:0:-1]), goal]
    kept, i = [points[0]], 0
    while i < len(points) - 1:
        i = next(
            j for j in range(len(points) - 1, i, -1) if j == i + 1 or _is_line_free(model, points[i], points[j], room)
        )
        kept.append(points[i])
    return np.array(kept)


def _is_line_free(model: Model, start: np.ndarray, end: np.ndarray, room: float) -> bool:
    """Whether the straight line has room on either side."""
    count = max(int(np.linalg.norm(end - start) / (0.5 * GRID_SIZE)), 2)
    line = start + np.linspace(0.0, 1.0, count)[:, None] * (end - start)
    return bool((ground_clearance(model, line) > room - 0.5 * GRID_SIZE).all())
