"""Bunches that hang close together, between shoots and old wood, without a hull inside another hull or inside wood.

The hull of a bunch is the spheroid that collides. A bunch hangs at the first of several places around its node at which
its hull keeps the gap of the plant file: first straight down, then further out on longer slants of its stalk.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene.builder import GRAVITY
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
_LOWER_SLANT = 0.6
"""Slant of the lower half of a stalk, as a share of that of the upper half: GUESSED."""
MAX_STALK_BEND = 0.7
"""[rad] Largest angle by which its bunch may bend a stalk, sum over its two joints. Stalks that lead a heavy bunch far
out have no stable shape."""
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
    least ``Bunch.gap``, if it would hang beyond its vine's plot, if it would bend its stalk too far
    (:data:`MAX_STALK_BEND`), or if its upright shoot would buckle.

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
    hard = 1.0 - (0.0 if parameters.bunch.press is None else parameters.bunch.press.value)
    low, high = scene.fruit.bunches
    per_vine = len(burden) * MAX_BUNCHES // len(structure.foot)
    fixed = with_old_wood(scene, structure, canes.points[:, 0]).fixed
    half = 0.5 * np.array([scene.layout.vine_spacing, scene.layout.row_spacing])
    slants = parameters.peduncle.slant.at(np.linspace(0.0, 1.0, _SLANTS))
    chosen = np.zeros(burden.size, bool)
    line, out = peduncle.reshape(-1, PEDUNCLE_SEGMENTS + 1, 3).copy(), up.reshape(-1, 3).copy()
    load = burden.ravel()
    mass, length, radius, thick = (fruit[name].ravel() for name in ("mass", "length", "radius", "thick"))
    hulls = _Hulls(line[:, -1], axis.reshape(-1, 3), length, radius)  # a view: hulls move with the ends of the stalks
    for vine, g in enumerate(structure.rngs):
        foot = structure.foot[vine, :2]
        wanted = int(g.integers(low, high + 1))
        # the first bunch of a shoot is more likely to be kept than the second
        order = np.argsort(g.random(per_vine) + 0.45 * (np.arange(per_vine) % MAX_BUNCHES), kind="stable")
        old, thin = _wood_of(vine, structure, fixed, canes, half)
        kept: list[int] = []
        carried = np.zeros(per_vine // MAX_BUNCHES)
        for number in order.tolist():
            one = vine * per_vine + number
            shoot = number // MAX_BUNCHES
            if len(kept) == wanted:
                break
            if carried[shoot] + load[one] >= MAX_BUCKLING_LOAD:
                continue
            lines, levels = _places(line[one], out[one], slants)
            stiff = parameters.peduncle.modulus.value * np.pi / 4.0 * float(thick[one]) ** 4
            free = _stalk_bend(lines, float(mass[one]) / stiff) < MAX_STALK_BEND
            free &= (np.abs(lines[:, -1, :2] - foot) + radius[one] + gap < half).all(-1)
            for place in np.flatnonzero(free & hulls.apart(one, lines[:, -1], kept, gap)):
                stalk = _points_along(lines[place], float(thick[one]))
                hull = hulls.at(one, lines[place, -1])
                if (
                    _outside(hull, old, gap)
                    and _outside(hull, thin, gap, hard)
                    and all(_outside(hulls.at(k, line[k, -1]), stalk, gap, hard) for k in kept)
                ):
                    line[one], out[one] = lines[place], levels[place]
                    chosen[one] = True
                    kept.append(one)
                    carried[shoot] += load[one]
                    thin = np.concatenate([thin[0], stalk[0]]), np.concatenate([thin[1], stalk[1]])
                    break
    return chosen.reshape(burden.shape), line.reshape(peduncle.shape), out.reshape(up.shape)


def _places(line: np.ndarray, up: np.ndarray, slants: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns places at which a bunch may hang, as stalks [place, PEDUNCLE_SEGMENTS + 1, 3] m and the horizontal
    directions [place, 3] to which they tilt: all directions on the smallest slant, then on the next.

    ``line`` [PEDUNCLE_SEGMENTS + 1, 3] m: the stalk whose start and lengths are used; ``up`` [3]: the first direction.
    """
    turn = np.tile(2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS, _SLANTS)
    level = np.cos(turn)[:, None] * up + np.sin(turn)[:, None] * frames.cross(np.array([0.0, 0.0, 1.0]), up)
    tilt = np.repeat(slants, _DIRECTIONS)[:, None] * level
    upper, lower = np.linalg.norm(np.diff(line, axis=0), axis=-1)
    middle = line[0] + upper * frames.normalize(tilt - [0.0, 0.0, 1.0])
    end = middle + lower * frames.normalize(_LOWER_SLANT * tilt - [0.0, 0.0, 1.0])
    return np.stack([np.broadcast_to(line[0], end.shape), middle, end], 1), level


def _stalk_bend(lines: np.ndarray, load: float) -> np.ndarray:
    """Returns the angles [place] rad by which a bunch bends its stalk, whose shapes are ``lines`` [place, 3, 3] m.
    ``load``: mass over EI [kg/(N m^2)]."""
    upper, lower = np.linalg.norm(lines[0, 1] - lines[0, 0]), np.linalg.norm(lines[0, 2] - lines[0, 1])
    lever = np.linalg.norm((lines[:, 2:] - lines[:, :2])[..., :2], axis=-1)
    return load * -GRAVITY[2] * (lever[:, 0] * 0.5 * upper + lever[:, 1] * 0.5 * (upper + lower))


@dataclasses.dataclass(frozen=True, eq=False)
class _Hulls:
    """Spheroids around all bunches."""

    top: np.ndarray
    """[bunch, 3] m, where the stalk ends."""
    axis: np.ndarray
    """[bunch, 3] direction from there to the tip."""
    length: np.ndarray
    radius: np.ndarray
    """[bunch] m"""

    def at(self, one: int, top: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Returns middle [3] m, direction [3], half length and radius m of a bunch that hangs at ``top`` [3] m."""
        half = 0.5 * float(self.length[one])
        return top + half * self.axis[one], self.axis[one], half, float(self.radius[one])

    def apart(self, one: int, tops: np.ndarray, others: list[int], gap: float) -> np.ndarray:
        """Returns for each place ``tops`` [place, 3] m of a bunch whether its hull keeps the gap [m] from those of
        ``others``. Compared are level cuts through the hulls."""
        if not others:
            return np.ones(len(tops), bool)
        cut = tops + (self.length[one] * _LEVELS)[:, None, None] * self.axis[one]
        own = self.radius[one] * np.sqrt(1.0 - (2.0 * _LEVELS - 1.0) ** 2)[:, None]
        free = np.ones(len(tops), bool)
        for k in others:
            middle, axis, half, radius = self.at(k, self.top[k])
            down = (cut[..., 2] - middle[2]) / axis[2]
            centre = middle + down[..., None] * axis
            between = np.linalg.norm((cut - centre)[..., :2], axis=-1)
            there = radius * np.sqrt(np.maximum(1.0 - (down / half) ** 2, 0.0))
            free &= ((between > own + there + gap) | (np.abs(down) > half + gap)).all(0)
        return free


def _outside(
    hull: tuple[np.ndarray, np.ndarray, float, float],
    wood: tuple[np.ndarray, np.ndarray],
    gap: float,
    hard: float = 1.0,
) -> bool:
    """Returns whether all balls of ``wood``, centres [n, 3] m and radii [n] m, keep the gap [m] from a hull. The hull
    wider by ball and gap is taken as the spheroid whose half axes are longer by them. ``hard``: share of the hull's
    half axes that counts."""
    middle, axis, half, radius = hull
    way = wood[0] - middle
    along = way @ axis
    across = way - along[:, None] * axis
    wide = wood[1] + gap
    nearness = (along / (hard * half + wide)) ** 2 + (across**2).sum(-1) / (hard * radius + wide) ** 2
    return bool((nearness > 1.0).all())


def _wood_of(
    vine: int, structure: FixedStructure, fixed: dict[str, np.ndarray], canes: Canes, half: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Returns points [n, 3] m in the wood on the plot of a vine and the radii [n] m there: first for old wood and
    poles, then for shoots and wires. ``half`` [2] m: half the size of a plot."""
    arms = structure.arms.shape[1]
    organ = fixed["fixed_organ"]
    index = fixed["fixed_index"]
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


def _points_along(line: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns points [n, 3] m on a polyline [point, 3] m of wood and their radii [n] m."""
    return _points_in(line[:-1], line[1:], np.full((len(line) - 1, 2), radius))
