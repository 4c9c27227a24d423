"""Rows of vines beyond those of the scene, and trees behind them, as coarse primitives with correct depth and labels.

A road of :data:`HEADLAND` separates them from the scene's own vines, so robots do not drive through rows that they
cannot touch. A vine is a trunk, two arms and *clumps*: leaf blades with the outline of a dozen leaves, larger and fewer
with the distance. Their labels have the index :data:`~vinesim.scene.ids.NO_OBJECT`. They carry no fruit.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.kernels.shading import materials
from vinesim.scene.ids import NO_OBJECT, Organ, label
from vinesim.scene.model import Model
from vinesim.scene.terrain import ground_height
from vinesim.sensors.primitives import textures
from vinesim.sensors.primitives.primitive_batches import Batch, make_batch, stack_columns
from vinesim.sensors.raster.primitive_arrays import CONE, LEAF

HEADLAND = 5.0
"""[m] Least distance of distant vines from the scene's outermost vines."""
REACH = 60.0
"""[m] Largest distance of distant vines from the scene's outermost vines."""
MAX_CLUMPS = 24_000
MAX_VINES = 4_000
"""Largest numbers of clumps and of vines; larger vineyards have sparser ones."""
_TREES = (32.0, 75.0)
"""[m] Least and greatest distance of trees on sides without rows, from the scene's outermost vines."""
_TREE_CLUMPS = 40
_MAX_TREES = 60
_CELL = 4.0
"""Width [m] of the squares of ground by which primitives are grouped in clusters."""
CLUMP_TINT = (0.042, 0.098, 0.017)
TREE_TINT = (0.026, 0.050, 0.013)
BARK_TINT = (0.15, 0.115, 0.085)
POST_TINT = (0.36, 0.33, 0.29)
"""Colours [linear RGB reflectance]: GUESSED by eye."""


@dataclasses.dataclass(frozen=True)
class _Vineyard:
    """Sizes of the scene's vineyard that its distant rows share."""

    low: np.ndarray
    high: np.ndarray
    """[2] m, corners of the area with the scene's own vines."""
    row_spacing: float
    vine_spacing: float
    wire: float
    """[m] Height of the arms."""
    top: float
    """[m] Height of the upper edge of the canopy."""
    trunk: float
    arm: float
    """[m] Radii."""

    @property
    def is_overhead(self) -> bool:
        """Whether the canopy is a roof of leaves instead of a hedge."""
        return self.top - self.wire < 0.5


def shaded_extent(model: Model, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the corners [2] m of the ground that vines shade, with the distant ones; ``low``, ``high``: [2] m corners
    of the area with the scene's own vines."""
    margin = REACH + 2.0 if model.look.clutter.distant_rows > 0.0 else 3.0
    return low - margin, high + margin


def distant_batches(model: Model, static_carrier: int) -> list[Batch]:
    """Returns the primitives of distant rows and trees; none for a model without them."""
    if model.look.clutter.distant_rows == 0.0 or (yard := _vineyard(model)) is None:
        return []
    rng = np.random.default_rng(np.random.SeedSequence(model.look.seed, spawn_key=(0, 0, 4, 0)))
    sides = rng.permutation(4)  # low x, high x, low y, high y
    is_open = np.zeros(4, bool)
    is_open[sides[: round(4.0 * (1.0 - model.look.clutter.distant_rows))]] = True
    place = _vines(yard, is_open)
    if len(place) > MAX_VINES:
        place = place[np.sort(rng.choice(len(place), MAX_VINES, replace=False))]
    parts = [_wood(model, yard, rng, place, static_carrier)]
    if not len(model.nodes.body):  # dormant vines have no leaves
        parts += _clumps(model, yard, rng, place, static_carrier)
    parts += _trees(model, yard, rng, is_open, static_carrier)
    return [part for part in parts if len(part)]


def _vineyard(model: Model) -> _Vineyard | None:
    """Returns the sizes of a model's vineyard; None without posts or arms."""
    pole = model.fixed_organ == int(Organ.POLE)
    arm = (model.fixed_organ == int(Organ.ARM)) & (model.fixed_shear_modulus > 0.0)
    if not pole.any() or not arm.any():
        return None
    at = model.fixed_start[pole].astype(float)
    ground = ground_height(model.terrain, at[:, 0], at[:, 1])
    x, y = (np.unique(np.round(at[:, k], 2)) for k in (0, 1))
    middle = 0.5 * (model.fixed_start[arm] + model.fixed_end[arm]).astype(float)
    return _Vineyard(
        low=at[:, :2].min(0),
        high=at[:, :2].max(0),
        row_spacing=float(np.median(np.diff(y))) if len(y) > 1 else 2.5,
        vine_spacing=float(np.median(np.diff(x))) if len(x) > 1 else 2.0,
        wire=float(np.median(middle[:, 2] - ground_height(model.terrain, middle[:, 0], middle[:, 1]))),
        top=float(np.median(model.fixed_end[pole, 2] - ground)),
        trunk=float(np.median(model.fixed_radius[model.fixed_organ == int(Organ.TRUNK)]))
        if (model.fixed_organ == int(Organ.TRUNK)).any()
        else 0.04,
        arm=float(np.median(model.fixed_radius[arm])),
    )


def _away(yard: _Vineyard, place: np.ndarray) -> np.ndarray:
    """Returns the distance [n] m of places [n, 2] m from the area with the scene's own vines."""
    return np.linalg.norm(np.maximum(np.maximum(yard.low - place, place - yard.high), 0.0), axis=1)


def _vines(yard: _Vineyard, is_open: np.ndarray) -> np.ndarray:
    """Returns the places [vine, 2] m of distant vines, which continue the scene's grid; sides that are open [4] have
    none."""
    axes = []
    for k, spacing in enumerate((yard.vine_spacing, yard.row_spacing)):
        first = -int(REACH / spacing)
        last = int((yard.high[k] - yard.low[k] + REACH) / spacing)
        axes.append(yard.low[k] + spacing * np.arange(first, last + 1))
    y, x = np.meshgrid(axes[1], axes[0], indexing="ij")
    place = np.stack([x.ravel(), y.ravel()], 1)
    away = _away(yard, place)
    kept = (away >= HEADLAND) & (away <= REACH)
    outside = np.stack([place < yard.low - 1e-6, place > yard.high + 1e-6], 2).reshape(-1, 4)  # as the order of sides
    return place[kept & ~(outside & is_open).any(1)]


def _cells(position: np.ndarray) -> np.ndarray:
    """Returns the group [n] of each position [n, 3] m: one number for each square of the ground."""
    cell = np.floor(position[:, :2] / _CELL).astype(np.int64)
    cell -= cell.min(0, initial=0)
    return (cell[:, 1] * (cell[:, 0].max(initial=0) + 1) + cell[:, 0]).astype(np.int32)


def _wood(model: Model, yard: _Vineyard, rng: np.random.Generator, place: np.ndarray, static_carrier: int) -> Batch:
    """Returns trunks, arms, and at every third vine a post."""
    count = len(place)
    foot = stack_columns(place, ground_height(model.terrain, *place.T))
    beside = np.array([0.15, 0.0, 0.0])
    foot = foot + beside
    bend = rng.normal(0.0, 0.06, (count, 3)) * [1.0, 1.0, 0.8]
    knee = foot + bend + np.array([0.0, 0.0, 0.55 * yard.wire])
    head = foot + 0.5 * bend + np.array([0.0, 0.0, yard.wire - 0.06]) - [0.08, 0.0, 0.0]
    reach = 0.46 * yard.vine_spacing
    ends = [head + np.array([side * reach, 0.0, 0.06]) + rng.normal(0.0, 0.02, (count, 3)) for side in (-1.0, 1.0)]
    thick = yard.trunk * rng.uniform(0.75, 1.15, count)
    a = [foot, knee, head, head]
    b = [knee, head, *ends]
    ra = [1.15 * thick, thick, 1.3 * yard.arm + 0.0 * thick, 1.3 * yard.arm + 0.0 * thick]
    rb = [thick, 0.9 * thick, yard.arm + 0.0 * thick, yard.arm + 0.0 * thick]
    organ = [Organ.TRUNK, Organ.TRUNK, Organ.ARM, Organ.ARM]
    tint = np.array(BARK_TINT) * rng.uniform(0.7, 1.2, (count, 1))
    tints = [tint] * 4
    with_post = np.round((place[:, 0] - yard.low[0]) / yard.vine_spacing).astype(int) % 3 == 0
    post = foot[with_post] - beside
    a.append(post)
    b.append(post + np.array([0.0, 0.0, yard.top]))
    radius = np.full(len(post), 0.04)
    ra.append(radius)
    rb.append(radius)
    organ.append(Organ.POLE)
    tints.append(np.array(POST_TINT) * rng.uniform(0.8, 1.1, (len(post), 1)))
    organs = np.repeat([int(one) for one in organ], [len(part) for part in a])
    start, end = np.concatenate(a), np.concatenate(b)
    return make_batch(
        CONE,
        stack_columns(start, np.concatenate(ra)),
        b=stack_columns(end, np.concatenate(rb)),
        c=stack_columns(0.0 * start[:, 2], rng.uniform(0.0, 7.0, len(start)), 0.0, 0.0),
        material=np.where(organs == int(Organ.POLE), int(materials.POST), int(materials.BARK)),
        tint=np.concatenate(tints),
        organ=organs,
        label=organs * label(Organ(1), 0) + NO_OBJECT,
        carrier=static_carrier,
        group=_cells(start),
    )


def _clumps(
    model: Model, yard: _Vineyard, rng: np.random.Generator, place: np.ndarray, static_carrier: int
) -> list[Batch]:
    """Returns the clumps of leaves of the vines at ``place`` [vine, 2] m."""
    away = _away(yard, place)
    size = np.clip(0.20 + 0.0125 * away, 0.25, 0.75)
    deep = yard.row_spacing if yard.is_overhead else 0.45
    face = yard.vine_spacing * (deep if yard.is_overhead else yard.top - yard.wire + 0.25)
    vigour = rng.uniform(0.6, 1.15, len(place))
    wanted = 3.4 * vigour * face / (1.6 * size**2)
    wanted *= min(1.0, MAX_CLUMPS / max(wanted.sum(), 1.0))
    vine = np.repeat(np.arange(len(place)), np.floor(wanted + rng.uniform(size=len(place))).astype(int))
    if len(vine) > MAX_CLUMPS:
        vine = np.sort(rng.choice(vine, MAX_CLUMPS, replace=False))
    n = len(vine)
    if not n:
        return []
    if yard.is_overhead:
        across = rng.uniform(-0.5, 0.5, n) * deep
        height = yard.wire + rng.uniform(-0.25, 0.3, n)
        outward = np.stack([rng.normal(0.0, 0.5, n), rng.normal(0.0, 0.5, n), np.ones(n)], 1)
    else:
        rise = rng.beta(1.3, 1.15, n)
        high = yard.top - yard.wire + 0.20 * rng.normal(size=len(place))[vine]
        height = yard.wire - 0.02 + rise * high
        side = np.where(rng.uniform(size=n) < 0.5, 1.0, -1.0)
        across = side * np.abs(rng.normal(0.0, 0.4 * deep, n)) * (1.0 - 0.45 * rise)
        outward = np.stack([rng.normal(0.0, 0.45, n), side, rng.normal(0.25, 0.35, n)], 1)
    along = rng.uniform(-0.5, 0.5, n) * yard.vine_spacing
    spot = place[vine] + np.stack([along, across], 1)
    up = frames.normalize(outward)
    rib = frames.normalize(np.array([0.0, 0.0, 1.0]) + 0.45 * rng.normal(size=(n, 3)))
    if yard.is_overhead:
        rib = rng.normal(size=(n, 3))
    rib = frames.normalize(rib - up * (rib * up).sum(1, keepdims=True))
    wide = size[vine] * rng.uniform(0.7, 1.25, n)
    tint = np.array(CLUMP_TINT) * (rng.uniform(0.65, 1.25, (n, 1)) * rng.uniform(0.85, 1.15, (len(place), 1))[vine])
    tint = tint + np.array([0.035, 0.040, 0.0]) * (rng.uniform(size=(n, 1)) ** 3)
    ground = ground_height(model.terrain, *spot.T)
    low = ground + 0.02 + wide
    where = stack_columns(spot, np.maximum(height + ground - 0.25 * wide * rib[:, 2], low))
    return [_blades(where, wide, rib, up, tint, rng, static_carrier)]


def _blades(
    where: np.ndarray,
    size: np.ndarray,
    rib: np.ndarray,
    up: np.ndarray,
    tint: np.ndarray,
    rng: np.random.Generator,
    static_carrier: int,
) -> Batch:
    """Returns clumps at ``where`` [n, 3] m with the label of no tree."""
    n = len(where)
    return make_batch(
        LEAF,
        stack_columns(where, size),
        b=stack_columns(rib, textures.CLUMP_OUTLINE),
        c=stack_columns(up, rng.uniform(size=n)),
        d=stack_columns(rng.normal(0.0, 0.25, n), rng.normal(0.0, 0.2, n), rng.normal(0.0, 0.25, n), 0.0),
        material=int(materials.GRASS),
        tint=tint,
        organ=int(Organ.LEAF),
        label=label(Organ.LEAF, NO_OBJECT),
        carrier=static_carrier,
        group=_cells(where),
    )


def _trees(
    model: Model, yard: _Vineyard, rng: np.random.Generator, is_open: np.ndarray, static_carrier: int
) -> list[Batch]:
    """Returns trees and bushes on the open sides, and behind the rows of the others."""
    count = _MAX_TREES
    side = rng.integers(4, size=count)
    near = np.where(is_open[side], _TREES[0], REACH + 4.0)
    off = near + (_TREES[1] - near) * rng.uniform(size=count)
    along = rng.uniform(-1.0, 1.0, count)
    middle, half = 0.5 * (yard.low + yard.high), 0.5 * (yard.high - yard.low)
    axis = side // 2
    sign = np.where(side % 2, 1.0, -1.0)
    place = np.empty((count, 2))
    rows = np.arange(count)
    place[rows, axis] = middle[axis] + sign * (half[axis] + off)
    place[rows, 1 - axis] = middle[1 - axis] + along * (half[1 - axis] + 0.9 * off)
    tall = rng.uniform(2.5, 9.0, count)
    foot = stack_columns(place, ground_height(model.terrain, *place.T))
    trunk = make_batch(
        CONE,
        stack_columns(foot, 0.025 * tall),
        b=stack_columns(foot + stack_columns(0.0, 0.0, 0.55 * tall), 0.012 * tall),
        c=stack_columns(0.0 * tall, rng.uniform(0.0, 7.0, count), 0.0, 0.0),
        material=int(materials.BARK),
        tint=BARK_TINT,
        organ=int(Organ.TRUNK),
        label=label(Organ.TRUNK, NO_OBJECT),
        carrier=static_carrier,
        group=_cells(foot),
    )
    tree = np.repeat(rows, _TREE_CLUMPS)
    n = len(tree)
    direction = frames.normalize(rng.normal(size=(n, 3)))
    reach = rng.uniform(0.35, 1.0, (n, 1)) ** 0.5
    wide = (0.34 * tall * rng.uniform(0.8, 1.3, count))[tree]
    crown = foot + stack_columns(0.0, 0.0, 0.62 * tall)
    where = crown[tree] + direction * reach * np.stack([wide, wide, 0.38 * tall[tree]], 1)
    size = 0.17 * tall[tree] * rng.uniform(0.7, 1.2, n)
    ground = ground_height(model.terrain, *where[:, :2].T)
    where[:, 2] = np.maximum(where[:, 2], ground + 0.05 + size)
    up = frames.normalize(direction + 0.4 * rng.normal(size=(n, 3)))
    rib = frames.normalize(np.array([0.0, 0.0, 1.0]) + 0.5 * rng.normal(size=(n, 3)))
    rib = frames.normalize(rib - up * (rib * up).sum(1, keepdims=True))
    shade = 0.55 + 0.55 * np.clip((where[:, 2] - foot[tree, 2]) / tall[tree], 0.0, 1.0)
    tone = rng.uniform(0.75, 1.3, (count, 1))[tree] * shade[:, None] * rng.uniform(0.8, 1.2, (n, 1))
    return [trunk, _blades(where, size, rib, up, np.array(TREE_TINT) * tone, rng, static_carrier)]
