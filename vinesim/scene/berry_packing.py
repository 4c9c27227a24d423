"""Packing of berries into model bunches (prototypes) by position-based relaxation.

A berry's pedicel pulls the berry to its foot on the rachis, and neighbouring berries push it out of overlaps. In
compact bunches berries press on each other: they may overlap by a few percent, and where two spheroids overlap, a
picture shows the flat contact of two deformed berries.
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from typing import Literal

import numpy as np

from vinesim.core import disk_cache, frames, portable_math
from vinesim.core.frames import normalize

Style = Literal["table", "loose", "medium", "dense"]
"""Style of bunches: those of table grapes, or those of wine grapes by their compactness."""


@dataclasses.dataclass(frozen=True, slots=True)
class _Packing:
    """How bunches of wine grapes of one style are packed. All numbers are guesses, tuned by eye."""

    fill: float
    """Share of the bunch's hull that berries fill."""
    touch: float
    """Distance of two berries that touch, as a fraction of the sum of their radii."""
    rest: float
    """Distance from a berry's centre to its foot to which its pedicel pulls, in radii."""
    ragged: float
    """Relative variation of the lengths and loads of the side branches."""


@dataclasses.dataclass(frozen=True, slots=True)
class _Shape:
    """Shape of a bunch of wine grapes."""

    taper: float
    wings: tuple[float, ...]
    """Share of the berries on each wing: a side branch like a small bunch of its own."""
    slender: tuple[float, float]
    """Range of length divided by largest diameter, without wings."""


PROTOTYPE_BERRIES = (50, 64, 80, 97, 116, 140)
"""Numbers of berries of the prototypes of table grapes. A bunch uses the next larger prototype without the last berries
at its tip."""
_WINE_BERRIES = (55, 75, 100, 130, 165, 200)
"""Numbers of berries of the prototypes of wine grapes. A bunch uses the next larger one without the last berries, which
are mostly those near its tip."""
_SHAPES = ((0.75, 0), (0.45, 1), (0.22, 2))
"""Taper and number of wings of the three prototypes (packed model bunches) of each count of berries of table grapes:
conical, shouldered, cylindrical with two wings.
"""
_WINE_SHAPES = (
    _Shape(0.85, (), (1.6, 2.0)),
    _Shape(0.60, (0.10, 0.08), (1.7, 2.2)),
    _Shape(0.25, (0.17,), (2.1, 2.6)),
    _Shape(0.45, (0.12,), (2.5, 3.1)),
)
"""Shapes of the prototypes of each count of berries of wine grapes: conical, shouldered, cylindrical with a wing, long.
"""
_PACKINGS: dict[Style, _Packing] = {
    "loose": _Packing(fill=0.44, touch=0.985, rest=1.70, ragged=0.45),
    "medium": _Packing(fill=0.62, touch=0.95, rest=1.45, ragged=0.28),
    "dense": _Packing(fill=0.82, touch=0.92, rest=1.25, ragged=0.14),
}
MAX_OVERLAP = 0.09
"""[1] Largest overlap of two berries of a bunch of wine grapes, as a fraction of the sum of their radii."""
_ITERATIONS = 400
_WINE_ITERATIONS = 240
_SPREAD = 0.07
_WINE_SPREAD = 0.10
"""Standard deviations of a berry's radius, as a fraction of the radius, of table grapes (``_SPREAD``) and of wine
grapes. The latter is guessed."""
_AXIS_LINES = 3
"""Number of lines into which the rachis' main axis is divided in bunches of wine grapes."""


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


def counts_of(style: Style) -> tuple[int, ...]:
    """Returns the numbers of berries of the prototypes of a style, in rising order."""
    return PROTOTYPE_BERRIES if style == "table" else _WINE_BERRIES


def shapes_of(style: Style) -> int:
    """Returns the number of prototypes of a style for each number of berries."""
    return len(_SHAPES) if style == "table" else len(_WINE_SHAPES)


@functools.cache
def prototypes(style: Style = "table") -> tuple[BerryLayout, ...]:
    """Returns the packed prototypes of a style, by number of berries and then by shape: berries of unit volume radius.

    Berries of table grapes are sorted from the top of the bunch to its tip, those of wine grapes roughly so.
    """
    digest = disk_cache.source_digest(pathlib.Path(__file__), pathlib.Path(frames.__file__))
    names = [field.name for field in dataclasses.fields(BerryLayout)]

    def make() -> disk_cache.Arrays:
        return {f"{i} {name}": getattr(one, name) for i, one in enumerate(_pack(style)) for name in names}

    arrays = disk_cache.load_or_make(f"berry-packings-{style}", digest, make)
    count = len(counts_of(style)) * shapes_of(style)
    return tuple(BerryLayout(**{name: arrays[f"{i} {name}"] for name in names}) for i in range(count))


def _pack(style: Style) -> list[BerryLayout]:
    drafts = [
        _draft(count, *_SHAPES[j], i * len(_SHAPES) + j)
        if style == "table"
        else _draft_branched(count, _WINE_SHAPES[j], _PACKINGS[style], i * len(_WINE_SHAPES) + j)
        for i, count in enumerate(counts_of(style))
        for j in range(shapes_of(style))
    ]
    position, foot, radius = (np.concatenate([d[k] for d in drafts]) for k in (0, 1, 2))
    sizes = [len(d[0]) for d in drafts]
    if style == "table":
        position = _relax(position, foot, radius, sizes)
    else:
        packing = _PACKINGS[style]
        position = _relax(position, foot, radius, sizes, packing.rest, packing.touch, _WINE_ITERATIONS)
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
        along = p[:, 0]
        if style != "table":  # bunches with fewer berries are thinned towards the tip, not cut off
            along = along * (1.0 + 0.25 * np.random.default_rng([len(p), 5]).random(len(p)))
        order = np.argsort(along, kind="stable")
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


def _draft_branched(count: int, shape: _Shape, packing: _Packing, seed: int) -> tuple[np.ndarray, ...]:
    """Returns what :func:`_draft` returns, for a bunch of wine grapes: berries sit around side branches, which leave
    the main axis in a spiral and are longest at the shoulders. Wings are side branches with branches of their own."""
    g = np.random.default_rng([seed, count, 2])
    radius = np.clip(g.normal(1.0, _WINE_SPREAD, count), 0.72, 1.22)
    radius = radius / np.cbrt((radius**3).mean())
    on_wings = [round(share * count) for share in shape.wings]
    wide, length = _size(count - sum(on_wings), shape.taper, g.uniform(*shape.slender), packing.fill)
    turn = g.uniform(0.0, 2.0 * np.pi)
    down = np.array([1.0, 0.0, 0.0])
    parts = [(np.zeros(3), down, count - sum(on_wings), wide, length)]
    for k, number in enumerate(on_wings):
        around = turn + np.pi * k + g.normal(0.0, 0.3)
        out = np.array([0.0, np.cos(around), np.sin(around)])
        wing = _size(number, shape.taper, 1.3, packing.fill)
        start = down * (0.5 + k) + out * (0.75 * wide)
        parts.append((start, normalize(down + out * g.uniform(0.25, 0.9)), number, *wing))
    feet = []
    lines = []
    for start, along, number, broad, long in parts:
        foot, branches = _branches(start, along, number, broad, long, shape.taper, packing, g)
        feet.append(foot)
        knots = start + along * np.linspace(0.0, 0.9 * long, 2 * _AXIS_LINES + 1)[:, None]
        if np.any(start):  # the stalk of a wing leaves the main axis at its top
            knots = np.concatenate([down * 0.3 + (start - down * 0.3) * np.array([[0.0], [0.5]]), knots[::3]])
        lines += [knots[i : i + 3] for i in range(0, len(knots) - 2, 2)]
        if packing.ragged > 0.2:  # in a dense bunch no branch is visible
            lines += branches
    foot = np.concatenate(feet)
    around = g.uniform(0.0, 2.0 * np.pi, count)
    out = normalize(np.stack([g.uniform(-0.5, 0.8, count), np.cos(around), np.sin(around)], 1))
    rachis = np.stack(lines)
    bend = g.normal(0.0, 0.05, 2) / length
    for points in (foot, rachis):
        points[..., 1:] += bend * points[..., :1] * np.abs(points[..., :1])
    return foot + out * packing.rest * radius[:, None], foot, radius, rachis


def _size(count: int, taper: float, slender: float, fill: float) -> tuple[float, float]:
    """Returns the largest radius and the length of the hull of ``count`` berries, in berry radii."""
    share = np.linspace(0.0, 1.0, 101)
    volume = count * 4.0 / 3.0 * np.pi / fill
    wide = (volume / (2.0 * np.pi * slender * (_profile(share, taper) ** 2).mean())) ** (1.0 / 3.0)
    return wide, 2.0 * slender * wide


def _profile(share: np.ndarray, taper: float) -> np.ndarray:
    """Returns the radius of a bunch's hull over its largest radius, by position along the axis, 0 to 1."""
    top = np.sqrt(np.clip((share + 0.08) / 0.25, 0.0, 1.0))
    return top * portable_math.power(np.maximum(1.0 - share, 0.03), taper)


def _branches(
    start: np.ndarray,
    along: np.ndarray,
    count: int,
    wide: float,
    length: float,
    taper: float,
    packing: _Packing,
    g: np.random.Generator,
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Returns the feet [count, 3] of berries on the side branches of an axis, and the branches as lines [3, 3].

    ``start``, ``along``: beginning and direction of the axis; ``wide``, ``length``: size of the hull around it.
    """
    number = max(3, round(length / 0.95))
    share = (np.arange(number) + g.uniform(0.2, 0.8, number)) / number
    broad = wide * _profile(share, taper)
    ragged = np.clip(1.0 + packing.ragged * g.normal(size=number), 0.4, 1.8)
    reach = np.maximum(broad * ragged - 0.8 * packing.rest, 0.15)
    one = normalize(np.cross(along, [0.3, 1.0, 0.2]))
    other = np.cross(along, one)
    around = 2.4 * np.arange(number) + g.normal(0.0, 0.3, number)
    out = one * np.cos(around)[:, None] + other * np.sin(around)[:, None]
    out = normalize(out + along * g.uniform(0.0, 0.5, number)[:, None])
    root = start + along * (share * length * 0.95)[:, None]
    load = broad * broad * ragged
    which = np.searchsorted(np.cumsum(load) / load.sum(), (np.arange(count) + g.uniform(0.0, 1.0, count)) / count)
    which = np.minimum(which, number - 1)
    foot = root[which] + out[which] * (reach[which] * np.sqrt(g.uniform(0.05, 1.0, count)))[:, None]
    lines = [np.stack([r, r + 0.5 * o, r + o]) for r, o in zip(root, out * reach[:, None], strict=True)]
    return foot, lines


def _relax(
    position: np.ndarray,
    foot: np.ndarray,
    radius: np.ndarray,
    sizes: list[int],
    rest: float = 1.25,
    touch: float = 0.985,
    iterations: int = _ITERATIONS,
) -> np.ndarray:
    """Pack several bunches at once. Pedicels pull in the first 3/4 of the iterations, neighbours push in all
    iterations.

    Args:
        position: [n, 3] centres of all berries, bunch by bunch.
        foot: [n, 3] feet of their pedicels.
        radius: [n] radii.
        sizes: number of berries of each bunch.
        rest: distance to its foot, in radii, from which on a pedicel pulls.
        touch: distance at which two berries touch, as a fraction of the sum of their radii.
        iterations: number of iterations.

    Returns:
        The positions.
    """
    p = position.copy()
    total = len(position)
    first = np.zeros(0, np.int64)
    second = np.zeros(0, np.int64)
    for iteration in range(iterations):
        if iteration % 8 == 0:
            first, second = _near(p, sizes, 2.9)
        if iteration < 0.75 * iterations:
            pedicel = p - foot
            long = np.linalg.norm(pedicel, axis=1, keepdims=True) + 1e-9
            p = p - pedicel / long * np.maximum(long - rest * radius[:, None], 0.0) * 0.035
            p[:, 0] += 0.005
        for _ in range(2):
            apart = p[first] - p[second]
            distance = np.sqrt((apart * apart).sum(1)) + 1e-9
            overlap = np.maximum(touch * (radius[first] + radius[second]) - distance, 0.0)
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
