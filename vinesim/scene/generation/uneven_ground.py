"""Uneven ground of a scene: the sum of an inclined plane, an image of heights, ruts in the alleys, and smooth noise;
and how trellis and plants stand on it.

The ground has the same bits on every machine, because only sums and products of numbers are computed.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from vinesim.scene.generation.fixed_structure import FixedStructure
from vinesim.scene.generation.plant_bodies import Bodies
from vinesim.scene.generation.shoots import Shoots
from vinesim.scene.ids import Organ
from vinesim.scene.spec import Layout, Roughness, Ruts, Scene, load_heights
from vinesim.scene.terrain import Terrain

RUT_FADE = 1.0
"""[m] Length over which ruts end in the headland, half a vine spacing and as much beyond the first and the last vine.
GUESSED"""
SPLINE_DEVIATION = 151.0 / 315.0
"""[1] Standard deviation, averaged over the ground, of a sum of cubic B-splines with independent standard normal
coefficients. DERIVED: the integral of the sum of the squared weights, which is the variance along each axis."""


def build_terrain(scene: Scene) -> Terrain | None:
    """Returns the terrain of a scene; None if the scene has none and its ground is the plane z = 0.

    Raises :class:`~vinesim.scene.spec.SceneError` if the image of heights cannot be read.
    """
    table = scene.terrain
    if table is None:
        return None
    low, high = extent(scene.layout, table.margin)
    cell = table.cell
    if table.image is None:
        origin = low
    else:
        # nodes are at the image's pixels, so that no height is interpolated twice
        image = load_heights(table)
        corner = table.corner if table.corner is not None else _centred(low, high, image, cell)
        origin = corner + cell * np.floor((low - corner) / cell)
    columns, rows = (int(n) for n in np.ceil((high - origin) / cell - 1e-9) + 1)
    x = origin[0] + cell * np.arange(columns)
    y = origin[1] + cell * np.arange(rows)
    residual = np.zeros((rows, columns))
    if table.image is not None:
        i = np.clip(np.round((x - corner[0]) / cell), 0, image.shape[1] - 1).astype(int)
        j = np.clip(np.round((y - corner[1]) / cell), 0, image.shape[0] - 1).astype(int)
        residual += image[np.ix_(j, i)]
    if table.ruts is not None:
        residual -= _rut_depths(table.ruts, scene.layout, x, y)
    if table.roughness is not None:
        residual += _smooth_noise(table.roughness, scene.seed, low, high, x, y)
    gradient = table.slope * math.cos(table.direction), table.slope * math.sin(table.direction)
    return Terrain((float(origin[0]), float(origin[1])), cell, gradient, residual.astype(np.float32))


def extent(layout: Layout, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lower and the upper corner [2] m of the vineyard with a ``margin`` [m] of headland around it."""
    spacing = np.array([layout.vine_spacing, layout.row_spacing])
    size = np.array([layout.vines - 1, layout.rows - 1]) * spacing
    return -0.5 * spacing - margin, size + 0.5 * spacing + margin


def _centred(low: np.ndarray, high: np.ndarray, image: np.ndarray, cell: float) -> np.ndarray:
    """Returns the position [2] m of the lower left pixel of an image whose middle is the middle of the vineyard."""
    return 0.5 * (low + high) - 0.5 * cell * (np.array(image.shape[::-1]) - 1)


def _rut_depths(ruts: Ruts, layout: Layout, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the depth [row, column] m of ruts at ``y`` [row] m and ``x`` [column] m: two in every alley, left by
    wheels that are ``gauge`` apart."""
    alley = layout.row_spacing * (np.arange(layout.rows + 1) - 0.5)
    middle = np.concatenate([alley - 0.5 * ruts.gauge, alley + 0.5 * ruts.gauge])
    off = np.abs(y[:, None] - middle).min(1) / (0.5 * ruts.width)
    profile = np.maximum(1.0 - off * off, 0.0)
    (first, _), (last, _) = extent(layout, RUT_FADE)
    share = np.clip(np.minimum(x - first, last - x) / RUT_FADE, 0.0, 1.0)
    return ruts.depth * (profile * profile)[:, None] * (share * share * (3.0 - 2.0 * share))


def _smooth_noise(
    roughness: Roughness, seed: int, low: np.ndarray, high: np.ndarray, x: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """Returns smooth noise [row, column] m at ``y`` [row] m and ``x`` [column] m: cubic B-splines, half a wavelength
    apart, with random coefficients. ``low``, ``high`` [2] m: corners of the region."""
    step = 0.5 * roughness.wavelength
    wide, deep = (int(n) for n in np.ceil((high - low) / step) + 4)
    # spawn keys of vines have length 2, those of imported plants 3
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0, 0, 0, 0)))
    coefficients = rng.standard_normal((deep, wide)) / SPLINE_DEVIATION
    across = _spline((x - low[0]) / step, wide)
    along = _spline((y - low[1]) / step, deep)
    rows = np.zeros((len(y), wide))
    for index, weight in along:
        rows += weight[:, None] * coefficients[index]
    noise = np.zeros((len(y), len(x)))
    for index, weight in across:
        noise += weight * rows[:, index]
    return roughness.deviation * noise


def _spline(at: np.ndarray, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns the four cubic B-splines at positions ``at`` [n] that are not 0: index [n] of the coefficient and
    weight [n] of each."""
    start = np.floor(at)
    t = at - start
    weights = (
        (1.0 - t) * (1.0 - t) * (1.0 - t) / 6.0,
        (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
        (-3.0 * t * t * t + 3.0 * t * t + 3.0 * t + 1.0) / 6.0,
        t * t * t / 6.0,
    )
    return [(np.clip(start + k, 0, count - 1).astype(int), weight) for k, weight in enumerate(weights)]


# The trellis and the plants are generated on level ground; then every point rises by the height of the trellis there.


class TrellisRise:
    """By how much the trellis is higher than on level ground: the height of the ground at the poles, and bilinear
    between them, as wires are straight from pole to pole."""

    def __init__(self, terrain: Terrain, layout: Layout) -> None:
        half = 0.5 * np.array([layout.vine_spacing, layout.row_spacing])
        lines = []
        for k, (count, spacing) in enumerate(((layout.vines, layout.vine_spacing), (layout.rows, layout.row_spacing))):
            at = spacing * np.arange(count)
            lines.append(np.concatenate([[-half[k]], at, [at[-1] + half[k]]]))
        self._lines = lines
        self._height = terrain.height(lines[0], lines[1][:, None])

    def at(self, points: np.ndarray) -> np.ndarray:
        """Returns the rise [...] m at ``points`` [..., 2 or more] m."""
        place = []
        for k, line in enumerate(self._lines):
            cell = np.clip(np.searchsorted(line, points[..., k], "right") - 1, 0, len(line) - 2)
            place.append((cell, (points[..., k] - line[cell]) / (line[cell + 1] - line[cell])))
        (i, u), (j, v) = place
        h = self._height
        low = h[j, i] + u * (h[j, i + 1] - h[j, i])
        return low + v * (h[j + 1, i] + u * (h[j + 1, i + 1] - h[j + 1, i]) - low)

    def raised(self, points: np.ndarray) -> np.ndarray:
        """Returns ``points`` [..., 3] m, raised."""
        return _lifted(points, self.at(points))


def raise_structure(structure: FixedStructure, terrain: Terrain, rise: TrellisRise) -> FixedStructure:
    """Returns the structure on the terrain. Poles and trunks start on the ground; trunks end below the raised wires."""
    fixed = dict(structure.fixed)
    for name in ("fixed_start", "fixed_end"):
        fixed[name] = rise.raised(fixed[name])
    trunk = _raise_trunks(structure.trunk, terrain, rise)
    mine = fixed["fixed_organ"] == int(Organ.TRUNK)
    fixed["fixed_start"][mine] = trunk[:, :-1].reshape(-1, 3)
    fixed["fixed_end"][mine] = trunk[:, 1:].reshape(-1, 3)
    foot = _lifted(structure.foot, terrain.height(structure.foot[:, 0], structure.foot[:, 1]))
    return dataclasses.replace(structure, foot=foot, arms=rise.raised(structure.arms), trunk=trunk, fixed=fixed)


def _raise_trunks(trunk: np.ndarray, terrain: Terrain, rise: TrellisRise) -> np.ndarray:
    """Returns the points [vine, point, 3] m of trunks that start on the ground and end below the raised wires."""
    up = np.linspace(0.0, 1.0, trunk.shape[1])
    foot = terrain.height(trunk[:, 0, 0], trunk[:, 0, 1])
    return _lifted(trunk, foot[:, None] * (1.0 - up) + rise.at(trunk) * up)


def raise_shoots(shoots: Shoots, rise: TrellisRise) -> Shoots:
    """Returns the shoots on the raised trellis; each peduncle with its bunch rises as a whole and hangs as before."""
    start = rise.at(shoots.peduncle[..., 0, :])
    return dataclasses.replace(
        shoots,
        points=rise.raised(shoots.points),
        lateral_points=rise.raised(shoots.lateral_points),
        peduncle=_lifted(shoots.peduncle, start[..., None]),
        bearers=tuple(dataclasses.replace(one, points=rise.raised(one.points)) for one in shoots.bearers),
    )


def raise_ties(ties: dict[str, np.ndarray], shoots: Shoots, level: Bodies, bodies: Bodies) -> dict[str, np.ndarray]:
    """Returns the ties of the raised shoots, at the same fractions of their segments as on level ground.

    ``level``, ``bodies``: bodies of the shoots on level ground, and raised; ``shoots``: raised.
    """
    at = ties["shoot"], ties["slot"]
    share = ties["point"][:, :1] / level.length[at][:, None]
    start = shoots.points[at]
    end = shoots.points[at[0], at[1] + 1]
    point = share * bodies.length[at][:, None] * [1.0, 0.0, 0.0]
    return ties | {"point": point, "anchor": start + share * (end - start)}


def _lifted(points: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Returns ``points`` [..., 3] m, higher by ``by`` [...] m."""
    return points + by[..., None] * [0.0, 0.0, 1.0]
