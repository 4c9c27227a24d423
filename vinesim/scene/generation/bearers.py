"""Two-year wood, on which the shoots of a scene with a date stand: spurs on cordons, or fruiting canes and renewal
spurs.

Spur pruning leaves two buds of last year's canes: each *spur* bears two shoots. Cane pruning lays a whole cane of last
year down on the wire on either side of the trunk, where it bears a shoot at every node, and leaves a *renewal spur*
near the trunk, on which the canes of the next year grow.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene.generation.fixed_structure import FixedStructure, cone_chains
from vinesim.scene.generation.gnarl import vine_generators
from vinesim.scene.generation.old_wood import seat_on_spurs
from vinesim.scene.ids import Organ
from vinesim.scene.season import Dormant, load_season
from vinesim.scene.spec import Scene

SHOOTS_ON_SPUR = 2
_STAGE = 4
"""Stage of the random generators of :func:`~vinesim.scene.generation.gnarl.vine_generators`; 0 to 3 are old wood."""
_HEAD_REACH = 0.03
"""[m] Level distance of the base of a renewal spur from the middle of the trunk."""


@dataclasses.dataclass(frozen=True, eq=False)
class Bearer:
    """One piece of two-year wood: a spur, or a fruiting cane."""

    vine: int
    piece: int
    """Index of the piece of an arm on which it stands, counted over all arms."""
    is_spur: bool
    points: np.ndarray
    """[point, 3] m, from its base to its end. Nodes are at all points but the first."""
    radius: np.ndarray
    """[point] m"""
    shoots: tuple[int, ...]
    """Indices of the shoots that it bears."""
    at: tuple[int, ...]
    """Index of the point at which each of these shoots stands."""


@dataclasses.dataclass(frozen=True, eq=False)
class Seats:
    """Where the shoots of a scene with a date stand; shoots are numbered arm by arm."""

    bearers: tuple[Bearer, ...]
    share: np.ndarray
    """[shoot] Position along the arm, 0 to 1."""
    start: np.ndarray
    """[shoot, 3] m, base of the shoot, on the surface of its bearer."""
    aside: np.ndarray
    """[shoot, 3] Vector that is added to the direction in which the shoot grows."""


def grow_bearers(scene: Scene, structure: FixedStructure, each: int) -> Seats:
    """Returns the two-year wood of all vines, with ``each`` shoots on every arm."""
    dormant = load_season().dormant
    vines, count, points = structure.arms.shape[:3]
    old = seat_on_spurs(scene, structure, each) if scene.clutter.old_wood > 0.0 and scene.pruning == "spur" else None
    bearers: list[Bearer] = []
    total = vines * count * each
    share = np.zeros(total)
    start = np.zeros((total, 3))
    aside = np.zeros((total, 3))
    rngs = vine_generators(scene, structure.row, structure.place, _STAGE)
    for vine in range(vines):
        g = rngs[vine]
        for arm in range(count):
            first = (vine * count + arm) * each
            axis = structure.arms[vine, arm]
            if scene.pruning == "cane":
                mine = _fruiting_cane(g, dormant, vine, axis, structure.trunk[vine, -1], first, each)
            else:
                base = None
                if old is not None:
                    base = old.share[first : first + each], old.offset[first : first + each]
                thick = structure.arm_radius[vine, arm]
                mine = _spurs(g, dormant, scene.training == "vsp", vine, axis, thick, first, each, base)
            arm_first = (vine * count + arm) * (points - 1)
            for bearer, place in mine:
                piece = arm_first + min(int(place * (points - 1)), points - 2)
                bearers.append(dataclasses.replace(bearer, piece=piece))
                for number, (shoot, at) in enumerate(zip(bearer.shoots, bearer.at, strict=True)):
                    share[shoot] = place
                    start[shoot], aside[shoot] = _seat(g, bearer, at, number, axis)
    return Seats(tuple(bearers), share, start, aside)


def _seat(
    g: np.random.Generator, bearer: Bearer, at: int, number: int, arm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the base [3] m of a shoot at point ``at`` of its bearer, and the vector [3] that turns it away from the
    bearer. ``number``: how many shoots stand before it on the bearer; ``arm``: [point, 3] m, axis of the arm."""
    along = frames.normalize((arm[-1] - arm[0]) * [1.0, 1.0, 0.0])
    if bearer.is_spur:  # the canes of a spur spread along the arm, the upper one follows the spur
        side = along * (1.0 if number % 2 else -1.0)
        out = side * (0.45 if number == 0 else 0.15) * (0.4 + 1.2 * g.random())
    else:
        side = np.array([0.0, 0.0, 1.0])
        out = along * 0.2 * g.normal()
    return bearer.points[at] + side * 0.8 * bearer.radius[at], out


def _spurs(
    g: np.random.Generator,
    dormant: Dormant,
    upright: bool,
    vine: int,
    axis: np.ndarray,
    radius: np.ndarray,
    first: int,
    each: int,
    old: tuple[np.ndarray, np.ndarray] | None,
) -> list[tuple[Bearer, float]]:
    """Returns the spurs of an arm with points ``axis`` and ``radius``, each with its position along the arm.

    ``first``: index of the arm's first shoot; ``old``: positions [each] and offsets [each, 3] m of shoots on old spur
    heads, on which the spurs then stand.
    """
    along = frames.normalize((axis[-1] - axis[0]) * [1.0, 1.0, 0.0])
    across = frames.cross(np.array([0.0, 0.0, 1.0]), along)
    up = np.array([0.0, 0.0, 1.0])
    heads = (each + SHOOTS_ON_SPUR - 1) // SHOOTS_ON_SPUR
    found = []
    for head in range(heads):
        shoots = tuple(range(first + head * SHOOTS_ON_SPUR, first + min((head + 1) * SHOOTS_ON_SPUR, each)))
        place = 0.15 + 0.83 * (head + 0.25 + 0.5 * g.random()) / heads
        lean = 0.22 * g.normal() * along + (0.12 * g.normal() if upright else (-1.0) ** head * 1.3) * across
        foot, thick = _on_axis(axis, radius, place)
        base = foot + 0.6 * thick * up
        if old is not None:
            mine = slice(head * SHOOTS_ON_SPUR, head * SHOOTS_ON_SPUR + len(shoots))
            place = float(old[0][mine][0])
            base = _on_axis(axis, radius, place)[0] + old[1][mine].mean(0)
        points = _zigzag(g, dormant, base, frames.normalize(up + lean), along, len(shoots), 0.0 if old else 0.4 * thick)
        thick = 0.5 * dormant.two_year_diameter.value * (0.9 + 0.2 * g.random())
        wood = thick * np.linspace(1.05, 0.88, len(points))
        found.append((Bearer(vine, 0, True, points, wood, shoots, tuple(range(1, len(points)))), place))
    return found


def _fruiting_cane(
    g: np.random.Generator,
    dormant: Dormant,
    vine: int,
    axis: np.ndarray,
    head: np.ndarray,
    first: int,
    each: int,
) -> list[tuple[Bearer, float]]:
    """Returns the renewal spur and the fruiting cane of a cane-pruned arm with points ``axis``, with their positions
    along the arm. ``head``: [3] m, upper end of the trunk."""
    along = frames.normalize((axis[-1] - axis[0]) * [1.0, 1.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    on_spur = min(SHOOTS_ON_SPUR, each)
    foot = head + along * _HEAD_REACH
    way = frames.normalize(along * (0.8 + 0.2 * g.random()) + up * 0.75 + 0.1 * g.normal(size=3) * [0.0, 1.0, 0.0])
    level = float((way * along).sum())
    neck = (dormant.renewal_spur.value * (0.8 + 0.4 * g.random()) - _HEAD_REACH) / level
    neck = max(neck - float(dormant.spur_internodes.at(0.5)), 0.01)
    points = _zigzag(g, dormant, foot, way, along, on_spur, neck)
    wood = 0.5 * dormant.two_year_diameter.value * np.linspace(1.1, 0.9, len(points))
    shoots = tuple(range(first, first + on_spur))
    spur = Bearer(vine, 0, True, points, wood, shoots, tuple(range(1, len(points))))
    rest = each - on_spur
    if not rest:
        return [(spur, 0.05)]
    places = 0.22 + 0.75 * (np.arange(rest) + 0.5 + 0.24 * (g.random(rest) - 0.5)) / rest
    blind = np.array([0.07, 0.14])
    shares = np.concatenate([[0.0], blind, places, [0.985]])
    radius = 0.5 * dormant.fruiting_cane_diameter.at(shares)
    points = np.stack([_on_axis(axis, np.zeros(len(axis)), float(share))[0] for share in shares])
    points[0] = head + along * 0.01
    at = tuple(range(1 + len(blind), 1 + len(blind) + rest))
    cane = Bearer(vine, 0, False, points, radius, tuple(range(first + on_spur, first + each)), at)
    return [(spur, 0.05), (cane, 0.3)]


def _zigzag(
    g: np.random.Generator,
    dormant: Dormant,
    base: np.ndarray,
    way: np.ndarray,
    along: np.ndarray,
    nodes: int,
    neck: float,
) -> np.ndarray:
    """Returns the points [node + 1, 3] m of a spur from ``base``: its nodes alternate to both sides. ``neck``: [m] its
    length below the first internode."""
    points = [base]
    step = dormant.spur_internodes.at(g.random(nodes))
    step[0] += neck
    for node in range(nodes):
        turn = along * (0.18 if node % 2 else -0.18)
        points.append(points[-1] + frames.normalize(way + turn) * step[node])
    return np.array(points)


def _on_axis(axis: np.ndarray, radius: np.ndarray, share: float) -> tuple[np.ndarray, float]:
    """Returns the point [3] m and the radius [m] at a share of a polyline's pieces."""
    where = share * (len(axis) - 1)
    piece = min(int(where), len(axis) - 2)
    rest = where - piece
    point = axis[piece] + (axis[piece + 1] - axis[piece]) * rest
    return point, float(radius[piece] + (radius[piece + 1] - radius[piece]) * rest)


def with_bearers(structure: FixedStructure, bearers: tuple[Bearer, ...], pruning: str) -> FixedStructure:
    """Returns the structure with two-year wood as fixed pieces, for the time of year in which it bears green shoots.
    The fruiting canes of cane-pruned vines are arms of the structure already."""
    added = [
        cone_chains(one.points[None], one.radius, Organ.ARM, np.array([_arm_of(structure, one.piece)]))
        for one in bearers
        if one.is_spur or pruning == "spur"
    ]
    if not added:
        return structure
    fixed = {name: np.concatenate([value, *(one[name] for one in added)]) for name, value in structure.fixed.items()}
    return dataclasses.replace(structure, fixed=fixed)


def without_arms(structure: FixedStructure) -> FixedStructure:
    """Returns the structure without arms: the fruiting canes of a dormant, cane-pruned vine are bodies."""
    keep = structure.fixed["fixed_organ"] != int(Organ.ARM)
    return dataclasses.replace(structure, fixed={name: value[keep] for name, value in structure.fixed.items()})


def _arm_of(structure: FixedStructure, piece: int) -> int:
    return piece // (structure.arms.shape[2] - 1)
