"""Bunches that hang close together, between shoots and old wood, without a hull inside another hull or inside wood.

The hull of a bunch is the spheroid that collides. A bunch hangs at the first of several places around its node at which
its hull keeps the gap of the plant file: first straight down, then further out on longer slants of its stalk.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene.generation.fixed_structure import FixedStructure
from vinesim.scene.generation.fruit import MAX_BUCKLING_LOAD
from vinesim.scene.generation.old_wood import with_old_wood
from vinesim.scene.generation.shoot_slots import MAX_BUNCHES, PEDUNCLE_SEGMENTS
from vinesim.scene.ids import Organ
from vinesim.scene.plant_parameters import VineParameters
from vinesim.scene.spec import Scene

_DIRECTIONS = 12
"""Number of directions around its node in which a bunch is tried."""
_SLANTS = 5
"""Number of slants of the stalk that are tried in each direction."""
_STEP = 0.01
"""[m] Distance of the points at which wood is tested."""
_LEVELS = (np.arange(25) + 0.5) / 25.0
"""Places along a bunch's axis, as shares of its length, at which its hull is tested against those of other bunches."""


@dataclasses.dataclass(frozen=True, eq=False)
class Canes:
    """The thin wood of all shoots. The first axis of each array is the shoot."""

    points: np.ndarray
    """[shoot, point, 3] m, along the main axes."""
    base: np.ndarray
    """[shoot] m, radius at the base of the main axis; no part is thicker."""
    lateral_points: np.ndarray
    """[shoot, point, 3] m, along the laterals."""
    lateral_radius: float
    has_lateral: np.ndarray
    """[shoot] bool"""


def hang_bunches(
    scene: Scene,
    parameters: VineParameters,
    structure: FixedStructure,
    canes: Canes,
    peduncle: np.ndarray,
    axis: np.ndarray,
    up: np.ndarray,
    burden: np.ndarray,
    fruit: dict[str, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Choose the bunches that each vine keeps, and where they hang: at most a random number within
    ``Scene.fruit.bunches``, in random order.

    A bunch is not kept if at no place the gap of its hull to wood, wires, stalks and kept bunches of its vine is at
    least ``Bunch.gap``, if it would hang beyond its vine's plot, or if its upright shoot would buckle.

    Args:
        scene: scene with the layout and the limits of the number of bunches.
        parameters: gap, and slants of stalks.
        structure: vines with their random number generators, and all fixed parts but spur heads.
        canes: thin wood of all shoots, the same number for each vine.
        peduncle: [shoot, MAX_BUNCHES, PEDUNCLE_SEGMENTS + 1, 3] m, points along each stalk; the first point and the
            length are used.
        axis: [shoot, MAX_BUNCHES, 3] direction of each bunch.
        up: [shoot, MAX_BUNCHES, 3] horizontal direction of the first place that is tried.
        burden: [shoot, MAX_BUNCHES] m g a^2 / EI of each bunch, see :data:`MAX_BUCKLING_LOAD`.
        fruit: properties of the bunches by name, from :func:`~vinesim.scene.generation.fruit.sample_fruit`.

    Returns:
        Whether each bunch is kept [shoot, MAX_BUNCHES] bool, and new arrays ``peduncle`` and ``up``.
    """
    assert parameters.bunch.gap is not None
    gap = parameters.bunch.gap.value
    hard = 1.0 - parameters.bunch.press.value
    low, high = scene.fruit.bunches
    vines = len(structure.foot)
    slots = len(burden) * MAX_BUNCHES // vines
    fixed = with_old_wood(scene, structure, canes.points[:, 0]).fixed
    half = 0.5 * np.array([scene.layout.vine_spacing, scene.layout.row_spacing])
    piece = np.linalg.norm(np.diff(peduncle, axis=2), axis=-1).reshape(-1, PEDUNCLE_SEGMENTS)
    peduncle = peduncle.copy()
    up = up.copy()
    chosen = np.zeros(burden.shape, bool)
    flat_peduncle = peduncle.reshape(-1, PEDUNCLE_SEGMENTS + 1, 3)
    flat_up, flat_axis = up.reshape(-1, 3), axis.reshape(-1, 3)
    flat_chosen, load = chosen.reshape(-1), burden.reshape(-1)
    length, radius, stalk = (fruit[name].reshape(-1) for name in ("length", "radius", "thick"))
    slant = parameters.peduncle.slant.at(np.linspace(0.0, 1.0, _SLANTS))
    turn = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    for vine, g in enumerate(structure.rngs):
        foot = structure.foot[vine, :2]
        wanted = int(g.integers(low, high + 1))
        # the first bunch of a shoot is more likely to be kept than the second
        order = np.argsort(g.random(slots) + 0.45 * (np.arange(slots) % MAX_BUNCHES), kind="stable")
        wood, thin = _wood_of(vine, structure, fixed, canes, half)
        kept: list[int] = []
        carried = np.zeros(slots // MAX_BUNCHES)
        for number in order:
            i = vine * slots + int(number)
            shoot = number // MAX_BUNCHES
            if len(kept) == wanted:
                break
            if carried[shoot] + load[i] >= MAX_BUCKLING_LOAD:
                continue
            # places: all directions on the smallest slant, then on the next
            level = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], -1)
            level = flat_up[i, 0] * level + flat_up[i, 1] * level[:, [1, 0, 2]] * [-1.0, 1.0, 0.0]
            way = np.repeat(slant, _DIRECTIONS)[:, None] * np.tile(level, (_SLANTS, 1)) - [0.0, 0.0, 1.0]
            middle = flat_peduncle[i, 0] + frames.normalize(way) * piece[i, 0]
            way = 0.6 * (way + [0.0, 0.0, 1.0]) - [0.0, 0.0, 1.0]
            top = middle + frames.normalize(way) * piece[i, 1]
            free = (np.abs(top[:, :2] - foot) + radius[i] + gap < half).all(-1)
            if kept:
                free &= _clear_of_bunches(top, flat_axis[i], length[i], radius[i], gap, kept, flat_peduncle[:, -1],
                                          flat_axis, length, radius)
            for place in np.flatnonzero(free):
                stalk_points = _along(np.stack([flat_peduncle[i, 0], middle[place], top[place]]))
                hull = top[place], flat_axis[i], length[i], radius[i]
                if (
                    _outside(*wood, *hull, gap)
                    and _outside(*thin, *hull, gap, hard)
                    and all(
                        _outside(stalk_points, stalk[i], flat_peduncle[k, -1], flat_axis[k], length[k], radius[k], gap, hard)
                        for k in kept
                    )
                ):
                    flat_peduncle[i, 1:] = middle[place], top[place]
                    flat_up[i] = np.tile(level, (_SLANTS, 1))[place]
                    flat_chosen[i] = True
                    kept.append(i)
                    carried[shoot] += load[i]
                    new = stalk_points, np.full(len(stalk_points), stalk[i])
                    thin = np.concatenate([thin[0], new[0]]), np.concatenate([thin[1], new[1]])
                    break
    return chosen, peduncle, up


def _wood_of(
    vine: int, structure: FixedStructure, fixed: dict[str, np.ndarray], canes: Canes, half: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Returns points [n, 3] m in the wood on the plot of a vine and the radii [n] m there: first for old wood and
    poles, then for shoots and wires. ``half`` [2] m: half the size of a plot."""
    arms = structure.arms.shape[1]
    organ, index = fixed["fixed_organ"], fixed["fixed_index"]
    foot = structure.foot[vine]
    middle = 0.5 * (fixed["fixed_start"] + fixed["fixed_end"])
    mine = (organ == int(Organ.TRUNK)) & (index == vine)
    mine |= (organ == int(Organ.ARM)) & (index // arms == vine)
    mine |= (organ == int(Organ.POLE)) & (np.abs(middle - foot)[:, :2] < half).all(-1)
    wire = organ == int(Organ.WIRE)
    each = len(canes.points) // len(structure.foot)
    shoots = slice(vine * each, (vine + 1) * each)
    side = canes.lateral_points[shoots][canes.has_lateral[shoots]]
    main = canes.points[shoots]
    thin = [
        (fixed["fixed_start"][wire], fixed["fixed_end"][wire], fixed["fixed_radius"][wire].max(-1)),
        (main[:, :-1], main[:, 1:], np.repeat(canes.base[shoots], main.shape[1] - 1)),
        (side[:, :-1], side[:, 1:], np.full(side[:, 1:].size // 3, canes.lateral_radius)),
    ]
    start, end = (np.concatenate([one[k].reshape(-1, 3) for one in thin]) for k in (0, 1))
    width = np.concatenate([one[2] for one in thin])
    old = _points_in(fixed["fixed_start"][mine], fixed["fixed_end"][mine], fixed["fixed_radius"][mine])
    new = _points_in(start, end, np.stack([width, width], -1))
    return tuple(
        (points[near], radius[near])
        for points, radius in (old, new)
        for near in [(np.abs(points - foot)[:, :2] < half + 0.1).all(-1)]
    )


def _points_in(start: np.ndarray, end: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns points [n, 3] m on the axes of round cones and the radii [n] m there. ``radius`` [cone, 2] m: at their
    ends."""
    many = np.ceil(np.linalg.norm(end - start, axis=-1) / _STEP).astype(int) + 1
    owner = np.repeat(np.arange(len(many)), many)
    share = (np.arange(len(owner)) - np.repeat(np.cumsum(many) - many, many)) / np.maximum(many - 1, 1)[owner]
    points = start[owner] + share[:, None] * (end - start)[owner]
    return points, radius[owner, 0] + share * (radius[:, 1] - radius[:, 0])[owner]


def _along(line: np.ndarray) -> np.ndarray:
    """Returns points [n, 3] m along a polyline [k, 3] m of short pieces."""
    share = np.linspace(0.0, 1.0, 6)[:, None]
    return np.concatenate([a + share * (b - a) for a, b in zip(line[:-1], line[1:], strict=True)])


def _outside(
    point: np.ndarray,
    thick: np.ndarray | float,
    top: np.ndarray,
    axis: np.ndarray,
    length: float,
    radius: float,
    gap: float,
    hard: float = 1.0,
) -> bool:
    """Returns whether all balls about ``point`` [n, 3] m with radius ``thick`` [n] m keep the gap from the hull of a
    bunch. The hull wider by ball and gap is taken as the spheroid whose two half axes are longer by them. ``hard``: share of the bunch's
    half axes that counts."""
    way = point - top
    along = way @ axis
    across = way - along[:, None] * axis
    wide = thick + gap
    half = 0.5 * length
    long, broad = hard * half + wide, hard * radius + wide
    return bool(((((along - half) / long) ** 2 + (across**2).sum(-1) / broad**2) > 1.0).all())


def _clear_of_bunches(
    top: np.ndarray,
    axis: np.ndarray,
    length: float,
    radius: float,
    gap: float,
    kept: list[int],
    tops: np.ndarray,
    axes: np.ndarray,
    lengths: np.ndarray,
    radii: np.ndarray,
) -> np.ndarray:
    """Returns for each place ``top`` [place, 3] m of a bunch whether its hull keeps the gap from those of the bunches
    ``kept``, whose properties are at these indices of the arrays. Compared are level cuts through the hulls."""
    cut = top[:, None] + (length * _LEVELS)[:, None] * axis
    own = radius * np.sqrt(1.0 - (2.0 * _LEVELS - 1.0) ** 2)
    other = np.array(kept)
    down = (tops[other][:, None, None, 2] - cut[..., 2]) / -axes[other, 2][:, None, None]
    share = 2.0 * down / lengths[other][:, None, None] - 1.0
    there = radii[other][:, None, None] * np.sqrt(np.maximum(1.0 - share**2, 0.0))
    centre = tops[other][:, None, None] + down[..., None] * axes[other][:, None, None]
    apart = np.linalg.norm((cut - centre)[..., :2], axis=-1)
    margin = 1.0 + gap / (0.5 * lengths[other])[:, None, None]  # above and below a bunch its gap is kept, too
    return ((apart > own + there + gap) | (np.abs(share) > margin)).all((0, 2))
