"""Berries of a bunch, computed from (count, seed), for sensors and ground truth. The physics has no berries.

Eighteen prototypes with berries of unit radius are packed once by position-based relaxation: a berry's pedicel pulls
the berry to its foot on the rachis, and neighbouring berries push it out of overlaps. A bunch is a scaled copy of the
prototype that its seed selects, so ten thousand bunches need only eighteen relaxations.
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib

import numpy as np

from vinesim.core import disk_cache, frames, portable_math
from vinesim.core.frames import normalize
from vinesim.scene import plant_parameters


@dataclasses.dataclass(frozen=True, slots=True)
class Variety:
    """Colours and size of the berries of one variety (sources in ``data/plants/varieties.toml``)."""

    name: str
    colour: tuple[float, float, float]
    """Linear RGB reflectance."""
    radius: float
    """Half of the berry's thickness across its axis [m]."""
    elongation: float
    """Ratio of length to thickness."""

    @property
    def volume_radius(self) -> float:
        """Radius of the sphere of the same volume [m]."""
        return self.radius * self.elongation ** (1.0 / 3.0)

    @property
    def mass(self) -> float:
        """Mass of one berry [kg]."""
        return DENSITY * 4.0 / 3.0 * np.pi * self.volume_radius**3


DENSITY = 1080.0
"""Density of a ripe berry [kg/m^3]. GUESSED from 18 % sugar."""

VARIETIES = tuple(
    Variety(b.name, b.colour.value, b.radius.value, b.elongation.value) for b in plant_parameters.load_varieties()
)
"""Varieties, indexed by ``Model.bunch_variety``."""

PROTOTYPE_BERRIES = (50, 64, 80, 97, 116, 140)
"""Numbers of berries of the prototypes. A bunch uses the next larger prototype without the last berries at its tip."""
MIN_BERRIES = 40
MAX_BERRIES = PROTOTYPE_BERRIES[-1]
_SHAPES = ((0.75, 0), (0.45, 1), (0.22, 2))
"""Taper and number of wings of the three prototypes (packed model bunches) of each count of berries: conical,
shouldered, cylindrical with two wings.
"""
_ITERATIONS = 400
_SPREAD = 0.07
"""Standard deviation of a berry's radius, as a fraction of the radius."""


@dataclasses.dataclass(frozen=True, slots=True)
class BerryLayout:
    """Berries in the bunch's body frame: origin at the end of the peduncle, +x down the rachis."""

    position: np.ndarray
    """[n, 3] m, centre of each berry."""
    radius: np.ndarray
    """[n] m, half of the thickness across the axis; half of the length is ``radius * elongation``."""
    axis: np.ndarray
    """[n, 3] unit vector from the pedicel to the stylar scar (the far end of the berry)."""
    foot: np.ndarray
    """[n, 3] m, point of the rachis at which the pedicel begins."""
    rachis: np.ndarray
    """[line, point, 3] m, main axis and wings."""
    neighbours: np.ndarray
    """[n, 8] int32, indices of neighbouring berries, nearest first; -1 fills the rest."""


def lay_out_berries(length: float, radius: float, count: int, variety: int, seed: int) -> BerryLayout:
    """Returns the berries of one bunch of ``Model``, scaled to a hull of ``length`` [m] and ``radius`` [m]."""
    return _scaled(int(_prototype(count, seed)), int(count), float(length), float(radius), int(variety))


def hull_size(count: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Returns length and radius of the hulls of bunches [..., 2], in units of the berry's volume radius."""
    which = _prototype(count, seed)
    count = np.asarray(count)
    return np.stack([_tables()[0][which, count], _tables()[1][which]], -1)


def segment_of(position: np.ndarray, length: float | np.ndarray, pieces: int | np.ndarray) -> np.ndarray:
    """Returns the index of the piece to which each point [..., 3] belongs if a rachis of ``length`` is cut into equal
    pieces. Piece 0 is at the peduncle."""
    return np.clip((position[..., 0] * (pieces / length)).astype(int), 0, pieces - 1)


def mass_by_segment(
    count: np.ndarray, seed: np.ndarray, pieces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the mass of the berries on ``pieces`` [n] equal pieces of the rachis, for bunches [n] of unit mass and
    length.

    Returns:
        Share of the mass [n, most], centre of mass [n, most, 3] and moments of inertia about it [n, most, 3] in the
        axes of the bunch's body; zero after a bunch's last piece. ``most`` is the largest of ``pieces``.
    """
    which = _prototype(count, seed)
    position, radius = _packed()
    number = np.arange(MAX_BERRIES)
    most = int(np.max(pieces, initial=1))
    count = np.asarray(count)
    pieces = np.asarray(pieces)
    length = _tables()[0][which, count]
    position = position[which] / length[:, None, None]
    radius = radius[which] / length[:, None]
    weight = np.where(number < count[:, None], portable_math.power(radius, 3), 0.0)
    weight = weight / weight.sum(1, keepdims=True)
    piece = np.clip((position[..., 0] * pieces[:, None]).astype(int), 0, pieces[:, None] - 1)
    flat = (np.arange(len(count))[:, None] * most + piece).ravel()

    def gathered(value: np.ndarray) -> np.ndarray:
        return np.bincount(flat, value.ravel(), len(count) * most).reshape(len(count), most)

    share = gathered(weight)
    some = np.where(share > 0.0, share, 1.0)[..., None]
    centre = np.stack([gathered(weight * position[..., axis]) for axis in range(3)], -1) / some
    square = np.stack([gathered(weight * position[..., axis] ** 2) for axis in range(3)], -1)
    square = square - share[..., None] * centre * centre
    own = gathered(0.4 * weight * radius * radius)[..., None]  # a ball's 2/5 m r^2
    return share, centre, square.sum(-1, keepdims=True) - square + own


@functools.cache
def _packed() -> tuple[np.ndarray, np.ndarray]:
    """Returns the positions [prototype, MAX_BERRIES, 3] and radii [prototype, MAX_BERRIES], rounded as in
    :func:`_tables`."""
    position = np.zeros((len(prototypes()), MAX_BERRIES, 3))
    radius = np.zeros((len(prototypes()), MAX_BERRIES))
    for i, bunch in enumerate(prototypes()):
        position[i, : len(bunch.radius)] = bunch.position
        radius[i, : len(bunch.radius)] = bunch.radius
    return position.round(3), radius.round(3)


def _prototype(count: np.ndarray | int, seed: np.ndarray | int) -> np.ndarray:
    """Returns the index of the prototype (packed model bunch) of a bunch: the prototype with the next larger count of
    berries, in the shape that the seed selects.
    """
    if np.min(count) < 1 or np.max(count) > MAX_BERRIES:
        raise ValueError(f"a bunch has 1 to {MAX_BERRIES} berries, not {np.min(count)} to {np.max(count)}")
    return np.searchsorted(PROTOTYPE_BERRIES, count) * len(_SHAPES) + np.asarray(seed, np.int64) % len(_SHAPES)


@functools.cache
def _tables() -> tuple[np.ndarray, np.ndarray]:
    """Returns hull lengths by prototype and count, and hull radii by prototype, rounded so that all machines have the
    same bits."""
    lengths = np.zeros((len(prototypes()), MAX_BERRIES + 1))
    for i, bunch in enumerate(prototypes()):
        reach = np.maximum.accumulate(bunch.position[:, 0] + bunch.radius)
        lengths[i, 1 : len(reach) + 1] = reach
    across = [np.quantile(np.hypot(*b.position[:, 1:].T) + b.radius, 0.9) for b in prototypes()]
    return lengths.round(3), np.array(across).round(3)


@functools.lru_cache(maxsize=512)
def _scaled(which: int, count: int, length: float, radius: float, variety: int) -> BerryLayout:
    unit = prototypes()[which]
    lengths, across = _tables()
    scale = min(length / lengths[which, count], radius / across[which])
    thin = VARIETIES[variety].elongation ** (-1.0 / 3.0)
    near = np.where(unit.neighbours[:count] < count, unit.neighbours[:count], -1)
    order = np.argsort(near < 0, axis=1, kind="stable")
    return BerryLayout(
        position=unit.position[:count] * scale,
        radius=unit.radius[:count] * (scale * thin),
        axis=unit.axis[:count],
        foot=unit.foot[:count] * scale,
        rachis=unit.rachis * scale,
        neighbours=np.take_along_axis(near, order, 1),
    )


@functools.cache
def prototypes() -> tuple[BerryLayout, ...]:
    """Returns the packed prototypes: berries of unit volume radius, sorted from the top of the bunch to its tip."""
    digest = disk_cache.source_digest(pathlib.Path(__file__), pathlib.Path(frames.__file__))
    names = [field.name for field in dataclasses.fields(BerryLayout)]

    def make() -> disk_cache.Arrays:
        return {f"{i} {name}": getattr(one, name) for i, one in enumerate(_pack()) for name in names}

    arrays = disk_cache.load_or_make("berry-packings", digest, make)
    count = len(PROTOTYPE_BERRIES) * len(_SHAPES)
    return tuple(BerryLayout(**{name: arrays[f"{i} {name}"] for name in names}) for i in range(count))


def _pack() -> list[BerryLayout]:
    drafts = [
        _draft(count, *shape, i * len(_SHAPES) + j)
        for i, count in enumerate(PROTOTYPE_BERRIES)
        for j, shape in enumerate(_SHAPES)
    ]
    position, foot, radius = (np.concatenate([d[k] for d in drafts]) for k in (0, 1, 2))
    position = _relax(position, foot, radius, [len(d[0]) for d in drafts])
    library = []
    first = 0
    for _, foot, radius, rachis in drafts:
        p = position[first : first + len(foot)]
        first += len(foot)
        down = (p[:, 0] - radius).min()  # the topmost berry just reaches the peduncle's end
        p = p - [down, 0, 0]
        foot = foot - [down, 0, 0]
        rachis = rachis - [down, 0, 0]
        rachis[0, 0] = 0.0
        order = np.argsort(p[:, 0], kind="stable")
        p = p[order]
        foot = foot[order]
        radius = radius[order]
        distance = np.linalg.norm(p[:, None] - p[None], axis=2) + np.diag(np.full(len(p), np.inf))
        near = np.argsort(distance, axis=1, kind="stable")[:, :8].astype(np.int32)
        axis = normalize(normalize(p - foot) + np.array([0.35, 0.0, 0.0]))
        library.append(BerryLayout(p, radius, axis, foot, rachis, near))
    return library


def _draft(count: int, taper: float, wings: int, seed: int) -> tuple[np.ndarray, ...]:
    """Returns position, foot and radius of the berries before packing, and the rachis, in units of the mean berry
    radius."""
    g = np.random.default_rng([seed, count])
    radius = np.clip(g.normal(1.0, _SPREAD, count), 0.8, 1.15)
    length = g.uniform(11.5, 13.5) * (count / 90.0) ** (1.0 / 3.0)
    wide = np.sqrt(count * 6.4 * (2.0 * taper + 1.0) / (np.pi * length) / (1.0 + 0.12 * wings))
    lines = [(np.zeros(3), np.array([length, *g.normal(0.0, 0.05 * length, 2)]), wide)]
    turn = g.uniform(0.0, 2.0 * np.pi)
    for wing in range(wings):
        angle = turn + np.pi * wing + g.normal(0.0, 0.3)
        tip = np.array([0.34 * length, 1.35 * wide * np.cos(angle), 1.35 * wide * np.sin(angle)])
        lines.append((np.array([1.0 + wing, 0.0, 0.0]), tip, 0.55 * wide))
    which = g.choice(len(lines), count, p=np.array([1.0] + [0.2] * wings) / (1.0 + 0.2 * wings))
    start, end, spread = (np.array([line[k] for line in lines])[which] for k in range(3))
    along = 0.03 + 0.97 * (1.0 - portable_math.power(1.0 - g.uniform(0.0, 0.985, count), 1.0 / (2.0 * taper + 1.0)))
    foot = start + (end - start) * along[:, None]
    around = g.uniform(0.0, 2.0 * np.pi, count)
    out = normalize(np.stack([g.uniform(-0.25, 0.7, count), np.cos(around), np.sin(around)], 1))
    narrowed = spread * portable_math.power(1.0 - along, taper)
    pedicel = 0.9 * narrowed * np.sqrt(g.uniform(0.15, 1.0, count)) + 0.6 * radius
    share = np.linspace(0.0, 0.8, 5)[:, None]
    rachis = np.stack([a + (b - a) * share for a, b, _ in lines])
    return foot + out * pedicel[:, None], foot, radius, rachis


def _relax(position: np.ndarray, foot: np.ndarray, radius: np.ndarray, sizes: list[int]) -> np.ndarray:
    """Pack several bunches at once. Pedicels pull in the first 3/4 of the iterations, neighbours push in all
    iterations. ``sizes``: number of berries of each bunch. Returns the positions."""
    p = position.copy()
    total = len(position)
    first = np.zeros(0, np.int64)
    second = np.zeros(0, np.int64)
    for iteration in range(_ITERATIONS):
        if iteration % 8 == 0:
            first, second = _near(p, sizes, 2.9)
        if iteration < 0.75 * _ITERATIONS:
            pedicel = p - foot
            long = np.linalg.norm(pedicel, axis=1, keepdims=True) + 1e-9
            p = p - pedicel / long * np.maximum(long - 1.25 * radius[:, None], 0.0) * 0.035
            p[:, 0] += 0.005
        for _ in range(2):
            apart = p[first] - p[second]
            distance = np.sqrt((apart * apart).sum(1)) + 1e-9
            overlap = np.maximum(0.985 * (radius[first] + radius[second]) - distance, 0.0)
            push = apart * (0.275 * overlap / distance)[:, None]
            for axis in range(3):
                p[:, axis] += np.bincount(first, push[:, axis], total) - np.bincount(second, push[:, axis], total)
    return p


def _near(p: np.ndarray, sizes: list[int], reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pairs of berries of the same bunch that are closer than ``reach``."""
    firsts = []
    seconds = []
    start = 0
    for size in sizes:
        own = p[start : start + size]
        square = (own * own).sum(1)
        distance = square[:, None] + square[None] - 2.0 * own @ own.T
        a, b = np.nonzero(np.triu(distance < reach * reach, 1))
        firsts.append(a + start)
        seconds.append(b + start)
        start += size
    return np.concatenate(firsts), np.concatenate(seconds)
