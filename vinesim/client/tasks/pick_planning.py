"""Planning of picks: which bunch, from which base pose, into which box, and along which path.

All of it is geometry of the model at rest: clearances of bunches, room for the base, paths on the ground.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from vinesim.client.tasks.path_planning import find_path
from vinesim.client.tasks.start_poses import PlacementError, bunch_centres, ground_clearance
from vinesim.core import frames
from vinesim.robot.tasks.pick import PickPlan
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model

BUNCH_AHEAD = 0.88
BUNCH_ASIDE = 0.28
"""[m] Position of the bunch in the base's frame at the pick: ahead, and to the arm's side."""
HAND_LOWER = np.array([-0.45, -0.11, -0.05])
HAND_UPPER = np.array([0.06, 0.11, 0.09])
"""[m] Corners of the box that an open hand sweeps about the grasp; x along the hand, z up."""
GRASP_HEIGHT = (1.3, 1.75)
"""[m] Heights of the grasp that arm and lift reach with the hand level."""
MAX_BUNCH_RADIUS = 0.060
"""[m] Largest radius of a bunch that fits between the fingers."""
GRASP_DEPTH = 0.06
"""[m] Approximate distance of the grasp below the upper end of a bunch."""
MIN_HAND_CLEARANCE = 0.005
"""[m] Smallest gap between the moving hand and anything but its bunch. GUESSED"""
FULL_CLEARANCE = 0.03
"""[m] Wider gaps score no better. GUESSED"""
BASE_CLEARANCE = 0.68
"""[m] A base with its arms tucked needs this distance around its centre."""
BOX_AHEAD = 0.10
BASE_HALF_WIDTH = 0.35
BOX_GAP = 0.06
"""[m] Distance of a box ahead of the base's centre, half of the base's width, and the gap between both."""
APPROACH_LENGTHS = (1.1, 0.8)
"""[m] Lengths of the straight approach along a box; the first for which there is room is taken."""
LANE_HALF_WIDTH = 0.36
"""[m] A base that drives straight needs this on either side of its centre."""
OBSTACLE_RADIUS = 0.8
"""[m] Obstacles farther from a bunch than this cannot meet the hand."""
OBSTACLE_SPACING = 0.04
"""[m] Greatest distance of the spheres that stand for trellis and old wood."""
MAX_CANDIDATES = 200
"""Number of the nearest bunches that are tried."""


def plan_picks(model: Model, near: np.ndarray) -> Iterator[PickPlan]:
    """Feasible plans, best first: bunches with most clearance, and among those nearer to ``near`` [2] m.

    Raises :class:`PlacementError` if no box can be approached or no bunch can be picked.
    """
    approaches = list(box_approaches(model))
    if not approaches:
        raise PlacementError(
            f"no box of this scene has {BASE_CLEARANCE} m of room beside it for a robot; place one in an alley"
        )
    found = False
    for bunch, side, base, _ in _base_poses(model, near, MIN_HAND_CLEARANCE):
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
    """The bunches within ``distance`` [m] of ``near`` [2] m that a hand reaches, however narrow it is about them.

    Of each bunch its number, the side, the pose [7] of the base where the hand has most room, and that room [m]:
    negative where the open hand would overlap wood or fruit, and no more than :data:`FULL_CLEARANCE`.
    """
    seen: set[int] = set()
    middles = bunch_centres(model)
    for bunch, side, base, clearance in _base_poses(model, near, -np.inf):
        if bunch not in seen and np.linalg.norm(middles[bunch, :2] - near) < distance:
            seen.add(bunch)
            yield bunch, side, base, clearance


def _base_poses(model: Model, near: np.ndarray, min_clearance: float) -> Iterator[tuple[int, str, np.ndarray, float]]:
    """Bunch, side, pose [7] of the base and clearance of the hand [m] for all reachable grasps, best first."""
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
    points = points[region]
    radius = radius[region]
    owner = owner[region]
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
            for k in np.flatnonzero(roomy[i, j]).tolist() if clear >= min_clearance else ():
                score = clear - 0.01 * float(np.linalg.norm(base[i, j, k] - near))
                pose = frames.pose(np.append(base[i, j, k], 0.0), turn[j])
                found.append((-score, bunch, ("left", "right")[k], pose, clear))
    for _, bunch, side, pose, clear in sorted(found, key=lambda entry: entry[:3]):
        yield bunch, side, pose, clear


def _obstacles(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spheres that fill wood, trellis and bunches at rest: centres [n, 3] m, radii [n] m, and the bunch of each [n] or
    -1."""
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
    """Spheres along everything that stands still: centres [n, 3] m and radii [n] m."""
    along = (model.fixed_end - model.fixed_start).astype(float)
    count = np.ceil(np.linalg.norm(along, axis=1) / OBSTACLE_SPACING).astype(int) + 1
    piece = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count)
    share = number / np.maximum(count - 1, 1)[piece]
    return model.fixed_start[piece] + share[:, None] * along[piece], model.fixed_radius[piece].max(1).astype(float)


@dataclasses.dataclass(frozen=True)
class BoxApproach:
    """A place of the base with a box beside it, and the start of the straight approach to it."""

    box: int
    side: str
    place: np.ndarray
    """[2] m"""
    start: np.ndarray
    """[2] m"""
    heading: float
    """[rad]"""


def box_approaches(model: Model) -> Iterator[BoxApproach]:
    """All places along the long sides of boxes with room for a base and its approach."""
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
