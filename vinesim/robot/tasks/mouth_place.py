"""From where the mouth of a cutter closes around a cane, so that it catches no other wood and touches none that stays.

A real shear is turned and takes a cane with its tip where the wood is dense. So three numbers are chosen for each cut:
the level direction of the hand, how deep the cane is in the mouth, and how far it is to one side.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.model import Model
from vinesim.scene.state import State

TURNS = np.deg2rad(np.arange(-45.0, 46.0, 15.0))
"""[rad] Directions of the hand that are tried, against the direction across the row. GUESSED"""
DEPTHS = np.array([-0.019, -0.010, 0.0, 0.010, 0.019])
"""[m] Distances of the cane ahead of the middle of the mouth that are tried; the mouth of 50 mm ends at 25 mm."""
SIDES = np.linspace(-0.015, 0.015, 11)
"""[m] Distances of the cane from the middle of the mouth to the side that are tried."""
SLIDES = np.array([0.0, -0.006, 0.006])
"""[m] Distances from the wanted place along the cane that are tried; others than 0 only where there is no room."""
ENOUGH = 8.0
"""[1] Cost from which on the other :data:`SLIDES` are tried. GUESSED"""
TRIED = 0.25
"""[rad] Directions that are nearer than this to one that was in vain are in vain, too. GUESSED"""
IN_VAIN_COST = 100.0
"""[1] Cost of such a direction. GUESSED"""
ROOM = 0.008
"""[m] Distance from the hand within which wood may be touched: canes move, and the hand is some millimetres off.
GUESSED"""
TIGHT = 0.003
"""[m] Distance from the hand within which wood will be touched, as far as the hand is off its way. GUESSED"""
NEARNESS = 0.2
"""[1] Cost of a point within :data:`ROOM` as a share of that of a point that is touched. GUESSED"""
SPACING = 0.008
"""[m] Distance between the points along wood that are looked at."""
NEIGHBOURHOOD = 0.32
"""[m] Distance from the cut within which wood is looked at."""
BUD_ROOM = 0.011
"""[m] Distance from a node along the cane within which its bud is: 3 mm around a bud of 8 mm."""
KINDS = ("bud", "stays", "rigid", "wire", "goes", "loose")
"""Kinds of wood: the buds that stay, what else of a cane stays, old wood, wires, canes that are to go, and pieces that
are cut off but still hang."""
TOUCH_COST = np.array([60.0, 6.0, 6.0, 1.0, 1.0, 1.0])
"""[kind] Cost of a point that the hand touches. Loose pieces hang in ties and between wires, and hold the hand as well.
GUESSED"""
CATCH_COST = np.array([300.0, 300.0, 100.0, 100.0, 20.0, 5.0])
"""[kind] Cost of a point within the mouth. Old wood and wires block the blades. GUESSED"""
CATCH_ROOM = np.array([0.006, 0.005, 0.006])
"""[m] Distance from the mouth within which wood counts as in it: ahead, to the side, across the blades. GUESSED"""


@dataclasses.dataclass(frozen=True, eq=False)
class Wood:
    """Points along the wood around a cut."""

    point: np.ndarray
    """[point, 3] m, seen from the place of the cut, in the axes of the world."""
    radius: np.ndarray
    """[point] m"""
    kind: np.ndarray
    """[point] Index into :data:`KINDS`."""
    is_own: np.ndarray
    """[point] Whether the point is on the cane that is cut."""
    axis: np.ndarray
    """[3] Direction of this cane to its tip."""


@dataclasses.dataclass(frozen=True, eq=False)
class HandShape:
    """Boxes around the parts of a hand, in the frame of its cutter's mouth: x ahead, y from blade to blade."""

    middle: np.ndarray
    """[box, 3] m"""
    half: np.ndarray
    """[box, 3] m, half edges."""
    mouth: np.ndarray
    """[3] m, half edges of the mouth."""


@dataclasses.dataclass(frozen=True, eq=False)
class MouthPlace:
    """How the mouth takes a cane."""

    ahead: np.ndarray
    """[3] Direction of the hand, level."""
    depth: float
    """[m] Distance of the cane ahead of the middle of the mouth."""
    side: float
    """[m] Distance of the cane from the middle of the mouth along the mouth's y axis, which points to the right of a
    hand with its blades down."""
    slide: float
    """[m] Distance of the mouth from the wanted place along the cane, to its tip."""
    catches: bool
    """Whether a cane that is to be cut off, too, is in the mouth."""
    cost: float
    """[1] Sum of the costs of the points that are touched or caught; 0 for a place with room all around."""


def hand_shape(rigid: RigidWorld, robot: str, links: Sequence[str], mouth: np.ndarray, half: np.ndarray) -> HandShape:
    """Returns the shape of a hand: the boxes around the collision geoms of ``links``, whose axes are nearly those of
    the mouth.

    ``mouth``: [7] pose of the mouth in the world; ``half``: [3] m, half edges of the mouth.
    """
    model = rigid.mj_model
    data = rigid.mj_data
    bodies = [model.body(f"{robot}/{link}").id for link in links]
    geoms = [g for g in np.flatnonzero(np.isin(model.geom_bodyid, bodies)).tolist() if model.geom_contype[g]]
    middle = np.zeros((len(geoms), 3))
    size = np.zeros((len(geoms), 3))
    back = frames.conjugate(mouth[3:])
    turn = frames.to_matrix(back)
    for row, geom in enumerate(geoms):
        axes = turn @ data.geom_xmat[geom].reshape(3, 3)
        box = model.geom_aabb[geom]
        middle[row] = frames.rotate(back, data.geom_xpos[geom] - mouth[:3]) + axes @ box[:3]
        size[row] = np.abs(axes) @ box[3:]
    return HandShape(middle, size, np.asarray(half, float))


def mouth_place(
    wood: Wood, hand: HandShape, ahead: np.ndarray, approach: float, tried: Sequence[np.ndarray] = ()
) -> MouthPlace:
    """Returns the place with the least cost.

    ``ahead``: [3] usual direction of the hand, level; ``approach``: [m] length of the straight way to the cane;
    ``tried``: directions [3] that have been in vain.
    """
    best = _place_on(wood, hand, ahead, approach, tried, 0.0)
    if best[0] > ENOUGH:
        others = [_place_on(wood, hand, ahead, approach, tried, float(slide)) for slide in SLIDES[1:]]
        best = min([best, *others], key=lambda one: one[0])
    return best[1]


def _place_on(
    wood: Wood, hand: HandShape, ahead: np.ndarray, approach: float, tried: Sequence[np.ndarray], slide: float
) -> tuple[float, MouthPlace]:
    """Returns the place with the least cost at ``slide`` [m] from the wanted place, and its whole cost."""
    up = np.array([0.0, 0.0, 1.0])
    turns, depths, sides = (grid.ravel() for grid in np.meshgrid(TURNS, DEPTHS, SIDES, indexing="ij"))
    cost = 5.0 * np.abs(turns) / TURNS[-1] + np.abs(depths) / DEPTHS[-1] + 4.0 * (sides / SIDES[-1]) ** 2
    cost += 4.0 * abs(slide) / SLIDES[-1]
    low = hand.middle - hand.half
    high = hand.middle + hand.half
    low[:, 0] -= approach  # all that the hand sweeps on its way
    least = low.min(0) - ROOM - [0.0, SIDES[-1], 0.0]
    most = high.max(0) + ROOM + [0.0, SIDES[-1], 0.0]
    points = wood.point - slide * wood.axis
    near = (wood.radius - points[:, 2] > least[2]) & (-points[:, 2] - wood.radius < most[2])
    points = points[near]
    kind = wood.kind[near]
    radius = wood.radius[near]
    own = wood.is_own[near]
    touch_cost = TOUCH_COST[kind]
    catch_cost = np.where(own, 0.0, CATCH_COST[kind])
    goes = (kind == KINDS.index("goes")) & ~own
    directions = frames.rotate(frames.from_yaw(TURNS), ahead)
    added = np.zeros(len(cost))
    catches = np.zeros(len(cost), bool)
    each = len(DEPTHS) * len(SIDES)
    for number, direction in enumerate(directions):
        right = frames.cross(direction, up)
        seen = np.stack([points @ direction, points @ right, -points[:, 2]], 1)
        near = (seen[:, 0] - radius < most[0] - DEPTHS[0]) & (seen[:, 0] + radius > least[0])
        near &= (seen[:, 1] + radius > least[1]) & (seen[:, 1] - radius < most[1])
        rows = slice(number * each, (number + 1) * each)
        moved = np.stack([depths[rows], sides[rows], np.zeros(each)], 1)
        at = seen[near] + moved[:, None]  # [place, point, 3]
        outside = np.maximum(np.maximum(low - at[:, :, None], at[:, :, None] - high), 0.0)
        gap = np.sqrt((outside**2).sum(-1)).min(-1, initial=np.inf) - radius[near]
        inside = (np.abs(at) < hand.mouth + CATCH_ROOM).all(-1)
        touched = NEARNESS * np.clip(1.0 - gap / ROOM, 0.0, 1.0) + np.clip(1.0 - gap / TIGHT, 0.0, 1.0)
        in_vain = any(direction @ other > np.cos(TRIED) for other in tried)
        added[rows] = touched @ touch_cost[near] + inside @ catch_cost[near] + IN_VAIN_COST * in_vain
        catches[rows] = (inside & goes[near]).any(-1)
    best = int(np.argmin(cost + added))
    place = MouthPlace(
        directions[best // each],
        float(depths[best]),
        float(sides[best]),
        slide,
        bool(catches[best]),
        float(added[best]),
    )
    return float(cost[best] + added[best]), place


class WoodAround:
    """Finds the wood around cuts: dormant canes as they are now, with their stumps, old wood and wires."""

    def __init__(self, model: Model) -> None:
        self._model = model
        canes = model.canes
        self._cane = canes.of_bodies(len(model.body_mass))
        self._from_base = np.zeros(len(model.body_mass))
        """[body] m, way along the cane from its base to the body's origin."""
        for first, size in zip(canes.body.tolist(), canes.size.tolist(), strict=True):
            length = model.body_length[first : first + size].astype(float)
            self._from_base[first : first + size] = np.cumsum(length) - length
        nodes = model.nodes
        self._node_cane = nodes.cane
        self._node_way = self._from_base[nodes.body] + nodes.along
        """[node] m, way along the cane from its base to the node."""
        start = model.fixed_start.astype(float)
        way = model.fixed_end.astype(float) - start
        count = np.maximum(np.ceil(np.linalg.norm(way, axis=1) / SPACING).astype(int), 1)
        piece = np.repeat(np.arange(len(count)), count)
        share = (np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[piece]
        self._fixed = start[piece] + share[:, None] * way[piece]
        self._fixed_kind = np.where(model.fixed_tension > 0.0, KINDS.index("wire"), KINDS.index("rigid"))[piece]
        radius = model.fixed_radius.astype(float)
        self._fixed_radius = radius[piece, 0] + share * (radius[piece, 1] - radius[piece, 0])

    def around(self, state: State, pose: np.ndarray, cane: int, kept: dict[int, float]) -> Wood:
        """Returns the wood near the place at which ``cane`` is to be cut.

        ``pose``: [7] the place, its x axis along the cane; ``kept``: for each cane that is to be shortened, the way [m]
        along it that stays.
        """
        place = pose[:3]
        axis = frames.rotate(pose[3:], np.array([1.0, 0.0, 0.0]))
        model = self._model
        here = np.flatnonzero(self._cane >= 0)
        stumps = np.flatnonzero(state.stump_of >= 0)
        stumps = stumps[np.argsort(state.stump_end[stumps], kind="stable")]
        begin = np.zeros(len(model.body_mass))
        for stump in stumps.tolist():
            begin[stump] = begin[state.stump_of[stump]]
            begin[state.stump_of[stump]] = state.stump_end[stump]
        body = np.concatenate([here, stumps])
        of = np.concatenate([here, state.stump_of[stumps]])
        first = begin[body]
        last = np.concatenate([model.body_length[here], state.stump_end[stumps]]).astype(float)
        near = np.linalg.norm(state.body_q[body, :3] - place, axis=1) < NEIGHBOURHOOD + 0.2
        body, of, first, last = body[near], of[near], first[near], last[near]
        count = np.maximum(np.ceil((last - first) / SPACING).astype(int), 1)
        row = np.repeat(np.arange(len(body)), count)
        share = (np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[row]
        along = first[row] + share * (last - first)[row]
        carrier = state.body_q[body].astype(float)[row]
        point = carrier[:, :3] + frames.rotate(carrier[:, 3:], along[:, None] * np.array([1.0, 0.0, 0.0]))
        taper = model.body_radius[of[row]].astype(float)
        radius = taper[:, 0] + (taper[:, 1] - taper[:, 0]) * along / model.body_length[of[row]]
        owner = self._cane[of[row]]
        way = self._from_base[of[row]] + along
        end = np.full(len(model.canes.body), -1.0)
        end[list(kept)] = list(kept.values())
        stays = way <= end[owner]
        kind = np.where(stays, KINDS.index("stays"), KINDS.index("goes"))
        for one in np.unique(owner[stays]).tolist():
            nodes = self._node_way[self._node_cane == one]
            mine = stays & (owner == one)
            kind[mine & (np.abs(way[:, None] - nodes).min(1) < BUD_ROOM)] = KINDS.index("bud")
        kind[model.canes.year[owner] == 2] = KINDS.index("rigid")
        kind[self._is_loose(state)[body[row]]] = KINDS.index("loose")
        own = owner == cane
        kind[own & ~stays] = KINDS.index("loose")
        by = np.linalg.norm(self._fixed - place, axis=1) < NEIGHBOURHOOD
        points = np.concatenate([point, self._fixed[by]]) - place
        found = np.linalg.norm(points, axis=1) < NEIGHBOURHOOD
        return Wood(
            points[found],
            np.concatenate([radius, self._fixed_radius[by]])[found],
            np.concatenate([kind, self._fixed_kind[by]])[found],
            np.concatenate([own, np.zeros(int(by.sum()), bool)])[found],
            axis,
        )

    def _is_loose(self, state: State) -> np.ndarray:
        """Returns whether each body is part of a piece that has been cut off [body]."""
        loose = state.body_cut.copy()
        canes = self._model.canes
        for first, size in zip(canes.body.tolist(), canes.size.tolist(), strict=True):
            if loose[first : first + size].any():
                loose[first : first + size] = np.logical_or.accumulate(loose[first : first + size])
        return loose
