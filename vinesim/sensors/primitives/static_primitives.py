"""Posts, wires, trunks, arms, grass and fallen leaves as primitives. Of these, only wires under tension move."""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.kernels.shading import materials
from vinesim.scene import leaves
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.scene.palette import DEFAULT, GroundColours
from vinesim.scene.terrain import Terrain, ground_height
from vinesim.sensors.primitives import textures
from vinesim.sensors.primitives.clutter import redrawn_posts, with_old_bark
from vinesim.sensors.primitives.primitive_batches import Batch, make_batch, stack_columns
from vinesim.sensors.raster.primitive_arrays import CONE, LEAF
from vinesim.wires.wire_segments import WireSegments, cut

_CELL_SIZE = 2.5
"""Width [m] of the squares of ground by which primitives that never move are grouped in clusters."""
_MAX_SEGMENT = 0.5
"""Largest length [m] of a primitive that never moves; longer pieces are cut."""
_BARK_TINTS = {Organ.TRUNK: (0.20, 0.15, 0.10), Organ.ARM: (0.20, 0.14, 0.09)}
"""Mean colours of bark; kernels take bark's colours from the palette."""


def _ground_cells(position: np.ndarray, first: int) -> np.ndarray:
    """Returns the group [n] of each position [n, 3] m: one number, from ``first`` on, for each square of the ground."""
    cell = np.floor(position[:, :2] / _CELL_SIZE).astype(np.int64)
    cell -= cell.min(0, initial=0)
    return (first + cell[:, 1] * (cell[:, 0].max(initial=0) + 1) + cell[:, 0]).astype(np.int32)


def trellis_batches(model: Model, static_carrier: int) -> list[Batch]:
    """Returns the primitives of trellis and wood that never move; :func:`wire_batch` makes those of wires under
    tension."""
    still = np.flatnonzero((model.fixed_tension <= 0.0) & ~redrawn_posts(model))
    if not len(still):
        return []
    # long pieces are cut: the bounding box of a whole one would contain half of the vineyard
    length = np.linalg.norm(model.fixed_end - model.fixed_start, axis=1)[still]
    whole, begin, stop = cut(length, _MAX_SEGMENT)
    values = _cones(model, still[whole], begin, stop)
    middle = 0.5 * (values["a"] + values["b"])
    return [make_batch(CONE, carrier=static_carrier, group=_ground_cells(middle, 0), **values)]


def wire_batch(model: Model, segments: WireSegments, first_carrier: int, first_group: int) -> Batch | None:
    """Returns the primitives of the segments of wires under tension; None without such wires.

    Each segment has its own carrier, numbered from ``first_carrier`` on; the segments of one wire form a group,
    numbered from ``first_group`` on.
    """
    if not len(segments):
        return None
    values = _cones(model, segments.piece, segments.start, segments.end)
    for end in "ab":
        values[end][:, :3] -= segments.rest_q[:, :3]
    carrier = first_carrier + np.arange(len(segments))
    return make_batch(CONE, carrier=carrier, group=first_group + segments.piece, **values)


def _cones(model: Model, piece: np.ndarray, begin: np.ndarray, stop: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the properties of cones for parts [part] of fixed pieces (posts, wires, wood), as for :func:`make_batch`.

    ``piece``: [part] index of the fixed piece; ``begin``, ``stop``: [part] start and end as shares of the piece's
    length.
    """
    way = model.fixed_end - model.fixed_start
    length = np.linalg.norm(way, axis=1)[piece]
    start, end = (model.fixed_start[piece] + share[:, None] * way[piece] for share in (begin, stop))
    radius = model.fixed_radius[piece]
    thick, thin = (radius[:, 0] * (1.0 - share) + radius[:, 1] * share for share in (begin, stop))
    organ = model.fixed_organ[piece]
    index = model.fixed_index[piece]
    table = {o: _look(model, Organ(int(o))) for o in np.unique(organ)}
    material, tint = (np.array([table[o][k] for o in organ]) for k in (0, 1))
    material, tint = with_old_bark(model, material, tint)
    rng = np.random.default_rng(3)
    seed = rng.uniform(size=int(model.fixed_index.max()) + 1)[index] * 7.0
    # texture is continuous from part to part: distances count from the foot of a post, or along a wire
    upright = np.abs(end - start)[:, 2] > 0.5 * np.linalg.norm(end - start, axis=1)
    return {
        "a": stack_columns(start, thick),
        "b": stack_columns(end, thin),
        "c": stack_columns(np.where(upright, start[:, 2], length * begin + _before(model)[piece]), seed, 0.0, 0.0),
        "material": material,
        "tint": tint,
        "organ": organ,
        "label": organ * label(Organ(1), 0) + index,
    }


def _before(model: Model) -> np.ndarray:
    """Returns the distance [fixed] m from the start of an old arm to each of its pieces; 0 for all other pieces."""
    if model.look.clutter.old_wood == 0.0:
        return np.zeros(len(model.fixed_start))
    elastic = model.arm_is_elastic()
    length = np.where(elastic, np.linalg.norm(model.fixed_end - model.fixed_start, axis=1), 0.0)
    before = np.cumsum(length) - length
    _, first, arm = np.unique(np.where(elastic, model.fixed_index, -1), return_index=True, return_inverse=True)
    return np.where(elastic, before - before[first][arm], 0.0)


def _look(model: Model, organ: Organ) -> tuple[int, tuple[float, float, float]]:
    """Returns material and colour (linear RGB) of a part of the trellis or of old wood."""
    wood = model.look.palette.wood
    if organ == Organ.POLE:
        return int(materials.POST), wood.post
    if organ == Organ.WIRE:
        return int(materials.WIRE), wood.wire
    return int(materials.BARK), _BARK_TINTS[organ]


def row_layout(model: Model) -> tuple[float, float]:
    """Returns the y coordinate [m] of the first row of vines, and the spacing [m] of the rows along y."""
    y = np.unique(np.round(model.fixed_start[model.fixed_organ == int(Organ.TRUNK), 1], 1))
    if len(y) == 0:
        return 0.0, 2.5
    return float(y[0]), float(np.median(np.diff(y))) if len(y) > 1 else 2.5


def _row_greenness(rows: tuple[float, float], y: np.ndarray) -> np.ndarray:
    """Returns by how much the rows of vines change the share of the ground that is covered with sod at ``y`` [n] m:
    negative under vines and in wheel tracks [n]. Equal to :func:`vinesim.kernels.shading.materials.row_greenness`."""
    lane = (y - rows[0]) / rows[1]
    away = np.abs(lane - np.round(lane)) * rows[1]
    track = np.abs(away - 0.5 * rows[1] + 0.7)
    return 0.16 - 0.26 * textures.smoothstep(0.65, 0.25, away) - 0.14 * textures.smoothstep(0.22, 0.08, track)


def litter_batch(
    low: np.ndarray,
    high: np.ndarray,
    age: float,
    static_carrier: int,
    terrain: Terrain | None = None,
    colours: GroundColours = DEFAULT.ground,
) -> Batch | None:
    """Returns the primitives of fallen leaves on the ground between the corners ``low`` and ``high`` [2] m.

    Their number grows with ``age``, the mean of :attr:`Model.leaf_age`, and with ``colours.litter``; None without
    fallen leaves.
    """
    low = low - 1.0
    high = high + 1.0
    n = int(min(colours.litter * (1.0 + 12.0 * age) * np.prod(high - low), 30_000))
    if n == 0:
        return None
    rng = np.random.default_rng(29)
    position = low + (high - low) * rng.uniform(size=(n, 2))
    turn = rng.uniform(0.0, 2.0 * np.pi, n)
    tilt = rng.normal(0.0, 0.15, n)
    rib = np.stack([np.cos(turn), np.sin(turn), tilt], 1) / np.hypot(1.0, tilt)[:, None]
    up = np.cross(rib, np.stack([np.sin(turn), -np.cos(turn), rng.normal(0.0, 0.15, n)], 1))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    if terrain is not None:
        rib, up = _lying(terrain, position, rib, up)
    dry = rng.uniform(size=(n, 1))
    tint = (1.0 - dry) * np.array(colours.litter_pale) + dry * np.array(colours.litter_brown)
    bend = stack_columns(
        rng.normal(0.0, 0.25, n), rng.normal(0.0, 0.25, n), rng.uniform(-0.2, 0.4, n), rng.uniform(0.8, 1.0, n)
    )
    return make_batch(
        LEAF,
        stack_columns(position, 0.012 + ground_height(terrain, *position.T), rng.uniform(0.04, 0.085, n)),
        b=stack_columns(rib, leaves.blade_shape(np.arange(n))),
        c=stack_columns(up, rng.uniform(size=n)),
        d=bend,
        material=int(materials.FOLIAGE),
        tint=tint,
        organ=int(Organ.GROUND),
        label=label(Organ.GROUND, 0),
        carrier=static_carrier,
        group=_ground_cells(position, 0),
    )


def grass_batch(
    rows: tuple[float, float],
    low: np.ndarray,
    high: np.ndarray,
    density: float,
    static_carrier: int,
    terrain: Terrain | None = None,
    colours: GroundColours = DEFAULT.ground,
) -> Batch | None:
    """Returns the primitives of grass tufts and herbs, with the ground's label, on the green parts of the ground.

    ``rows``: y of the first row and spacing of rows [m]; ``low``, ``high``: corners [2] m; ``density``: tufts [1/m^2].
    """
    low = low - 3.0
    high = high + 3.0
    count = int(min(density * np.prod(high - low), 60_000))
    if count == 0:
        return None
    rng = np.random.default_rng(23)
    position = low + (high - low) * rng.uniform(size=(count, 2))
    noise = textures.sample_noise(position[:, 0] * 0.21, position[:, 1] * 0.21)
    # the same greenness as in the ground's colour
    green = noise[:, 0] * 0.55 + 0.2 * noise[:, 2] + 0.125 + colours.strip * _row_greenness(rows, position[:, 1])
    green = green + colours.cover
    position = position[green > 0.40 + 0.24 * rng.uniform(size=count)]
    n = len(position)
    herb = rng.uniform(size=n) < 0.12
    size = np.where(herb, rng.uniform(0.03, 0.06, n), 0.06 + 0.17 * rng.uniform(size=n) ** 1.5)
    yaw = rng.uniform(0.0, 2.0 * np.pi, n)
    lean = np.where(herb, rng.uniform(0.5, 1.1, n), rng.normal(0.0, 0.2, n))
    out = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(n)], 1)
    rib = np.sin(lean)[:, None] * out + np.cos(lean)[:, None] * np.array([0.0, 0.0, 1.0])
    up = np.cos(lean)[:, None] * out - np.sin(lean)[:, None] * np.array([0.0, 0.0, 1.0])
    root = stack_columns(position, ground_height(terrain, *position.T)) + 0.74 * size[:, None] * rib
    tint = np.array(colours.grass) * rng.uniform(0.6, 1.35, (n, 1))
    tint = tint + np.array(colours.weathered) * (rng.uniform(size=(n, 1)) < 0.3) * rng.uniform(size=(n, 1))
    fate = np.random.default_rng(37).uniform(size=(2, n, 1))  # apart: the other tufts do not depend on the palette
    tint = np.where(fate[0] < colours.dry_share, np.array(colours.dry) * (0.6 + 0.75 * fate[1]), tint)
    bend = stack_columns(rng.normal(0.0, 0.3, n), np.zeros(n), np.zeros(n), np.zeros(n))
    return make_batch(
        LEAF,
        stack_columns(root, size),
        b=stack_columns(rib, np.where(herb, textures.HERB_OUTLINE, textures.GRASS_OUTLINE)),
        c=stack_columns(up, rng.uniform(size=n)),
        d=bend,
        material=int(materials.GRASS),
        tint=tint,
        organ=int(Organ.GROUND),
        label=label(Organ.GROUND, 0),
        carrier=static_carrier,
        group=_ground_cells(position, 0),
    )


def _lying(terrain: Terrain, position: np.ndarray, *directions: np.ndarray) -> tuple[np.ndarray, ...]:
    """Returns unit vectors ``directions`` [n, 3] turned with the slope of the ground at ``position`` [n, 2] m."""
    axes = frames.from_matrix(_upright_axes(terrain.normal(*position.T)))
    return tuple(frames.rotate(axes, one) for one in directions)


def _upright_axes(normal: np.ndarray) -> np.ndarray:
    """Returns rotation matrices [n, 3, 3] that turn z to ``normal`` [n, 3] and keep x in its vertical plane."""
    x = frames.normalize(np.stack([normal[:, 2], np.zeros(len(normal)), -normal[:, 0]], -1))
    return np.stack([x, frames.cross(normal, x), normal], -1)
