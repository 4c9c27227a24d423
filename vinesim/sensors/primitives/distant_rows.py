"""Rows of vines beyond those of the scene, grass below them, and trees behind them, with correct depth and labels.

A road, ``clutter.headland`` wide, separates them from the scene's own vines, so robots do not drive through rows that
they cannot touch. A vine is a trunk, two arms, and leaves: up to :data:`DETAILED` away single leaves, shoots, spur
heads and wires, farther away *clumps*: leaf blades with the outline of a dozen leaves, larger and fewer with the
distance. Open sides have a meadow of tall grass. Labels have the index :data:`~vinesim.scene.ids.NO_OBJECT`, those of
grass are the ground's. Distant vines carry no fruit.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.kernels.shading import materials
from vinesim.scene import leaves
from vinesim.scene.ids import NO_OBJECT, Organ, label
from vinesim.scene.model import Model
from vinesim.scene.terrain import ground_height
from vinesim.sensors.primitives import textures
from vinesim.sensors.primitives.primitive_batches import Batch, make_batch, stack_columns
from vinesim.sensors.raster.primitive_arrays import CONE, LEAF

REACH = 60.0
"""[m] Largest distance of distant vines from the scene's outermost vines."""
DETAILED = 8.0
"""[m] Distance up to which distant vines have single leaves."""
MAX_DETAILED = 500
MAX_LEAVES = 28_000
MAX_CLUMPS = 20_000
MAX_VINES = 4_000
MAX_TUFTS = 14_000
"""Largest numbers of vines with single leaves (about), of single leaves, clumps, vines and tufts of grass; larger
vineyards have sparser ones."""
WOOD_OF_VINE = 5
WOOD_OF_NEAR_VINE = 60
"""Largest numbers of pieces of wood of a distant vine, and of the additional ones of a vine with single leaves."""
_LEAF_AREA = 3.6
"""[1] Leaf area of a hedge divided by the area of its face: GUESSED; 2 to 4 layers of leaves on either side."""
_LEAF_SIZES = (0.045, 0.085)
"""[m] Least and greatest ``leaf_size`` of distant vines: GUESSED, blades of 50 to 170 cm2."""
_SHOOTS = (7, 13)
"""Least and greatest number of shoots of a vine."""
_BARE = (-0.04, 0.30)
"""[m] Least and greatest height above the arms at which the foliage of a row begins: GUESSED from photographs."""
_GRASS_REACH = 18.0
"""[m] Largest distance of tufts of grass from the scene's outermost vines; the scene has its own up to
:data:`_SCENE_GRASS`."""
_SCENE_GRASS = 2.5
_MEADOW = (2.5, 7.0)
"""[m] Least and greatest distance at which a meadow on an open side begins."""
_MEADOW_HEIGHT = (0.3, 1.3)
"""[m] Least and greatest mean height of the grass of a meadow: GUESSED, sown grass to reeds."""
_TREES = (14.0, 60.0)
"""[m] Least and greatest distance of trees on sides without rows, from the scene's outermost vines."""
_TREE_CLUMPS = 100
_MAX_TREES = 110
_CELL = 4.0
"""Width [m] of the squares of ground by which primitives are grouped in clusters."""
TREE_TINT = (0.026, 0.050, 0.013)
BARK_TINT = (0.15, 0.115, 0.085)
"""Colours [linear RGB reflectance] that no palette has: GUESSED by eye."""


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
    """Returns the primitives of distant rows, grass and trees; none for a model without them."""
    clutter = model.look.clutter
    if clutter.distant_rows == 0.0 or (yard := _vineyard(model)) is None:
        return []
    rng = np.random.default_rng(np.random.SeedSequence(model.look.seed, spawn_key=(0, 0, 4, 0)))
    sides = rng.permutation(4)  # low x, high x, low y, high y
    is_open = np.zeros(4, bool)
    is_open[sides[: round(4.0 * (1.0 - clutter.distant_rows))]] = True
    place = _vines(yard, is_open, clutter.headland)
    if len(place) > MAX_VINES:
        kept = np.argsort(_away(yard, place), kind="stable")[:MAX_VINES]
        place = place[np.sort(kept)]
    away = _away(yard, place)
    is_near = away <= DETAILED
    if is_near.sum() > MAX_DETAILED:
        is_near &= away <= np.sort(away)[MAX_DETAILED - 1]
    bare = rng.uniform(*_BARE)
    parts = [_wood(model, yard, rng, place, static_carrier)]
    parts += _near_wood(model, yard, rng, place[is_near], static_carrier)
    if not len(model.nodes.body):  # dormant vines have no leaves
        parts += _near_leaves(model, yard, rng, place[is_near], bare, static_carrier)
        parts += _clumps(model, yard, rng, place[~is_near], bare, static_carrier)
    parts += _grass(model, yard, rng, is_open, static_carrier)
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


def _vines(yard: _Vineyard, is_open: np.ndarray, headland: float) -> np.ndarray:
    """Returns the places [vine, 2] m of distant vines, which continue the scene's grid; sides that are open [4] have
    none, nor has the ground up to ``headland`` m."""
    axes = []
    for k, spacing in enumerate((yard.vine_spacing, yard.row_spacing)):
        first = -int(REACH / spacing)
        last = int((yard.high[k] - yard.low[k] + REACH) / spacing)
        axes.append(yard.low[k] + spacing * np.arange(first, last + 1))
    y, x = np.meshgrid(axes[1], axes[0], indexing="ij")
    place = np.stack([x.ravel(), y.ravel()], 1)
    away = _away(yard, place)
    kept = (away >= headland) & (away <= REACH)
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
    bark = 0.5 * (np.array(model.look.palette.wood.bark_dark) + np.array(model.look.palette.wood.bark_light))
    tint = bark * rng.uniform(0.55, 1.1, (count, 1))
    tints = [tint] * 4
    with_post = np.round((place[:, 0] - yard.low[0]) / yard.vine_spacing).astype(int) % 3 == 0
    post = foot[with_post] - beside
    a.append(post)
    b.append(post + np.array([0.0, 0.0, yard.top]))
    radius = np.full(len(post), 0.04)
    ra.append(radius)
    rb.append(radius)
    organ.append(Organ.POLE)
    tints.append(np.array(model.look.palette.wood.post) * rng.uniform(0.8, 1.1, (len(post), 1)))
    organs = np.repeat([int(one) for one in organ], [len(part) for part in a])
    start = np.concatenate(a)
    end = np.concatenate(b)
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


def _near_wood(
    model: Model, yard: _Vineyard, rng: np.random.Generator, place: np.ndarray, static_carrier: int
) -> list[Batch]:
    """Returns shoots and spur heads of the vines at ``place`` [vine, 2] m, and the wires of their rows."""
    count = len(place)
    if not count or yard.is_overhead:
        return []
    wood = model.look.palette.wood
    # shoots: from the arms to the upper edge of the canopy
    vine = np.repeat(np.arange(count), rng.integers(*_SHOOTS, count))
    n = len(vine)
    along = rng.uniform(-0.47, 0.47, n) * yard.vine_spacing
    foot = stack_columns(place[vine] + stack_columns(along, rng.normal(0.0, 0.02, n)), yard.wire)
    foot[:, 2] += ground_height(model.terrain, *foot[:, :2].T)
    high = (yard.top - yard.wire) * rng.uniform(0.55, 1.1, n)
    lean = rng.normal(0.0, 0.22, (n, 3)) * [1.0, 0.5, 0.0]
    knee = foot + 0.35 * high[:, None] * (lean + rng.normal(0.0, 0.12, (n, 3)) + [0.0, 0.0, 1.0])
    tip = knee + 0.65 * high[:, None] * (0.4 * lean + rng.normal(0.0, 0.10, (n, 3)) + [0.0, 0.0, 1.0])
    thick = rng.uniform(0.0028, 0.0055, n)
    tone = rng.uniform(0.6, 1.25, (n, 1))
    green = rng.uniform(0.0, 0.5, (n, 1))
    tint = tone * ((1.0 - green) * np.array(wood.cane) + green * np.array(wood.stem))
    # spur heads: short thick stubs where shoots leave the arm
    head = foot - stack_columns(0.0, 0.0, rng.uniform(0.01, 0.05, n))
    neck = foot + (knee - foot) * rng.uniform(0.08, 0.2, (n, 1))
    bark = 0.5 * (np.array(wood.bark_dark) + np.array(wood.bark_light)) * rng.uniform(0.4, 0.9, (n, 1))
    a = np.concatenate([foot, knee, head])
    b = np.concatenate([knee, tip, neck])
    ra = np.concatenate([thick, 0.8 * thick, rng.uniform(0.013, 0.030, n)])
    rb = np.concatenate([0.8 * thick, 0.4 * thick, rng.uniform(0.008, 0.02, n)])
    organ = np.repeat([int(Organ.CANE), int(Organ.CANE), int(Organ.ARM)], n)
    shoots = make_batch(
        CONE,
        stack_columns(a, ra),
        b=stack_columns(b, rb),
        c=stack_columns(0.0 * ra, rng.uniform(0.0, 7.0, len(ra)), 0.0, 0.0),
        material=np.where(organ == int(Organ.CANE), int(materials.CANE), int(materials.BARK)),
        tint=np.concatenate([tint, tint, bark]),
        organ=organ,
        label=organ * label(Organ(1), 0) + NO_OBJECT,
        carrier=static_carrier,
        group=_cells(a),
    )
    return [shoots, _wires(model, yard, rng, place, static_carrier)]


def _wires(model: Model, yard: _Vineyard, rng: np.random.Generator, place: np.ndarray, static_carrier: int) -> Batch:
    """Returns wires, and the drip hoses that the scene's rows have, along the rows at ``place`` [vine, 2] m."""
    rows, row = np.unique(np.round(place[:, 1], 2), return_inverse=True)
    has_hose = rng.uniform(size=len(rows)) < model.look.clutter.hose
    heights = [yard.wire + 0.01, yard.wire + 0.38 * (yard.top - yard.wire), yard.wire + 0.75 * (yard.top - yard.wire)]
    lines = [(height, 0.0015, materials.WIRE, np.ones(len(place), bool)) for height in heights]
    lines.append((rng.uniform(0.32, 0.48), 0.008, materials.RUBBER, has_hose[row]))
    half = 0.5 * yard.vine_spacing
    start = []
    end = []
    radius = []
    material = []
    for height, thick, kind, shown in lines:
        ends = []
        for side in (-half, half):
            at = place[shown] + [side, 0.03]
            ends.append(stack_columns(at, height + ground_height(model.terrain, *at.T)))
        start.append(ends[0])
        end.append(ends[1])
        radius.append(np.full(len(ends[0]), thick))
        material.append(np.full(len(ends[0]), int(kind)))
    thick = np.concatenate(radius)
    kinds = np.concatenate(material)
    is_wire = kinds[:, None] == int(materials.WIRE)
    return make_batch(
        CONE,
        stack_columns(np.concatenate(start), thick),
        b=stack_columns(np.concatenate(end), thick),
        material=kinds,
        tint=np.where(is_wire, np.array(model.look.palette.wood.wire), 0.022),
        organ=int(Organ.WIRE),
        label=label(Organ.WIRE, NO_OBJECT),
        carrier=static_carrier,
        group=_cells(np.concatenate(start)),
    )


def _leaf_places(
    model: Model,
    yard: _Vineyard,
    rng: np.random.Generator,
    place: np.ndarray,
    vine: np.ndarray,
    bare: float,
    size: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns position [n, 3] m, outward normal [n, 3], and depth below the hedge's surface [n], 0 to 1, of leaves of
    ``vine`` [n] at ``place`` [vine, 2] m with ``size`` [n] m."""
    n = len(vine)
    along = rng.uniform(-0.5, 0.5, n) * yard.vine_spacing
    if yard.is_overhead:
        across = rng.uniform(-0.5, 0.5, n) * yard.row_spacing
        height = yard.wire + rng.uniform(-0.25, 0.3, n)
        outward = np.stack([rng.normal(0.0, 0.5, n), rng.normal(0.0, 0.5, n), np.ones(n)], 1)
        inner = np.zeros(n)
    else:
        # shoots make the hedge uneven: bulges along the row, gaps below, tips that stand out above
        wave = textures.sample_noise((place[vine, 0] + along) * 0.31, place[vine, 1] * 0.17)
        low = yard.wire + bare + 0.5 * (wave[:, 1] - 0.5)
        high = yard.top + 0.12 + 0.9 * (wave[:, 2] - 0.5) + 0.08 * rng.normal(size=n)
        rise = rng.beta(1.15, 1.25, n)
        height = low + rise * np.maximum(high - low, 0.2)
        side = np.where(rng.uniform(size=n) < 0.5, 1.0, -1.0)
        inner = rng.uniform(size=n) ** 1.6
        half = 0.24 + 0.35 * (wave[:, 0] - 0.5) + 0.10 * np.sin(np.pi * rise)
        across = side * np.maximum(half, 0.10) * (1.0 - inner) * (1.0 - 0.35 * rise) + rng.normal(0.0, 0.05, n)
        outward = np.stack([rng.normal(0.0, 0.5, n), side, rng.normal(0.45, 0.45, n)], 1)
    spot = place[vine] + np.stack([along, across], 1)
    ground = ground_height(model.terrain, *spot.T)
    where = stack_columns(spot, np.maximum(height + ground, ground + 0.03 + 1.3 * size))
    return where, frames.normalize(outward), inner


def _foliage_tints(model: Model, rng: np.random.Generator, count: int) -> np.ndarray:
    """Returns reflectances [count, 3] of leaves."""
    colours = model.look.palette.leaf
    youth = rng.uniform(size=(count, 1)) ** 4
    tint = np.array(colours.grown) + youth * (np.array(colours.young) - np.array(colours.grown))
    tint = tint * rng.uniform(0.6, 1.35, (count, 1)) * (1.0 + colours.value_spread * rng.normal(size=(count, 1)))
    return tint + np.array(colours.pale) * np.clip(0.8 * rng.normal(size=(count, 1)), 0.0, 2.0)


def _near_leaves(
    model: Model, yard: _Vineyard, rng: np.random.Generator, place: np.ndarray, bare: float, static_carrier: int
) -> list[Batch]:
    """Returns the single leaves of the vines at ``place`` [vine, 2] m, larger and fewer with the distance."""
    larger = 1.0 + 0.09 * np.maximum(_away(yard, place) - 2.5, 0.0)
    face = yard.vine_spacing * (yard.row_spacing if yard.is_overhead else max(yard.top - yard.wire - bare + 0.2, 0.3))
    mean_size = 0.5 * sum(_LEAF_SIZES)
    wanted = _LEAF_AREA * rng.uniform(0.7, 1.2, len(place)) * face / (leaves.BLADE_AREA * (mean_size * larger) ** 2)
    wanted *= min(1.0, MAX_LEAVES / max(wanted.sum(), 1.0))
    vine = np.repeat(np.arange(len(place)), wanted.astype(int))
    n = len(vine)
    if not n:
        return []
    size = rng.uniform(*_LEAF_SIZES, n) * larger[vine]
    where, up, inner = _leaf_places(model, yard, rng, place, vine, bare, size)
    hanging = 0.55 * rng.normal(size=(n, 3)) + 0.5 * up - [0.0, 0.0, 0.9]
    rib = frames.normalize(hanging - up * (hanging * up).sum(1, keepdims=True))
    shape = leaves.blade_shape(rng.integers(1 << 16, size=n))
    tint = _foliage_tints(model, rng, n) * (1.0 - 0.75 * inner[:, None])
    blade = make_batch(
        LEAF,
        stack_columns(where, size * textures.leaf_scale(shape)),
        b=stack_columns(rib, shape),
        c=stack_columns(up, rng.uniform(size=n)),
        d=stack_columns(
            rng.normal(-0.10, 0.18, n), rng.normal(-0.16, 0.16, n), rng.uniform(0.0, 0.5, n), rng.uniform(0.1, 0.42, n)
        ),
        material=int(materials.FOLIAGE),
        tint=tint,
        organ=int(Organ.LEAF),
        label=label(Organ.LEAF, NO_OBJECT),
        carrier=static_carrier,
        group=_cells(where),
    )
    return [blade]


def _clumps(
    model: Model, yard: _Vineyard, rng: np.random.Generator, place: np.ndarray, bare: float, static_carrier: int
) -> list[Batch]:
    """Returns the clumps of leaves of the vines at ``place`` [vine, 2] m."""
    away = _away(yard, place)
    size = np.clip(0.16 + 0.0125 * away, 0.25, 0.75)
    deep = yard.row_spacing if yard.is_overhead else 0.45
    face = yard.vine_spacing * (deep if yard.is_overhead else yard.top - yard.wire - bare + 0.25)
    vigour = rng.uniform(0.6, 1.15, len(place))
    wanted = 3.4 * vigour * face / (1.6 * size**2)
    wanted *= min(1.0, MAX_CLUMPS / max(wanted.sum(), 1.0))
    vine = np.repeat(np.arange(len(place)), np.floor(wanted + rng.uniform(size=len(place))).astype(int))
    if len(vine) > MAX_CLUMPS:
        vine = np.sort(rng.choice(vine, MAX_CLUMPS, replace=False))
    n = len(vine)
    if not n:
        return []
    wide = size[vine] * rng.uniform(0.6, 1.25, n)
    where, up, inner = _leaf_places(model, yard, rng, place, vine, bare, 0.6 * wide)
    rib = frames.normalize(np.array([0.0, 0.0, 1.0]) + 0.6 * rng.normal(size=(n, 3)))
    if yard.is_overhead:
        rib = rng.normal(size=(n, 3))
    rib = frames.normalize(rib - up * (rib * up).sum(1, keepdims=True))
    low = ground_height(model.terrain, *where[:, :2].T) + 1.3 * wide
    where[:, 2] = np.maximum(where[:, 2] - 0.25 * wide * rib[:, 2], low)
    tint = _foliage_tints(model, rng, n) * (1.0 - 0.75 * inner[:, None])
    return [_blades(where, wide, rib, up, tint, rng, static_carrier)]


def _grass(
    model: Model, yard: _Vineyard, rng: np.random.Generator, is_open: np.ndarray, static_carrier: int
) -> list[Batch]:
    """Returns tufts of grass and weeds of uneven height between and below the distant rows, and the tall grass of
    meadows on sides that are open [4]; they have the ground's label."""
    colours = model.look.palette.ground
    low = yard.low - _GRASS_REACH
    high = yard.high + _GRASS_REACH
    spot = low + (high - low) * rng.uniform(size=(4 * MAX_TUFTS, 2))
    away = _away(yard, spot)
    outside = np.stack([yard.low - spot, spot - yard.high], 2).reshape(-1, 4)  # as the order of sides
    meadow = (outside * is_open).max(1) > rng.uniform(*_MEADOW)
    noise = textures.sample_noise(spot[:, 0] * 0.11, spot[:, 1] * 0.11)
    lane = (spot[:, 1] - yard.low[1]) / yard.row_spacing
    below = np.abs(lane - np.round(lane)) * yard.row_spacing < 0.35  # weeds that no mower reaches
    share = np.clip(0.25 + 2.6 * (noise[:, 1] - 0.5) + 0.5 * colours.cover + 0.2 * below, 0.03, 1.0)
    share = np.where(meadow, 1.0, share) * np.clip(5.0 / np.maximum(away, 1.0), 0.15, 1.0)
    kept = (away > _SCENE_GRASS) & (away < _GRASS_REACH) & (rng.uniform(size=len(spot)) < share)
    kept = np.flatnonzero(kept)[:MAX_TUFTS]
    spot = spot[kept]
    away = away[kept]
    meadow = meadow[kept]
    below = below[kept]
    noise = noise[kept]
    n = len(spot)
    if not n:
        return []
    tall = 0.035 + 0.10 * rng.uniform(size=n) ** 3 + 0.005 * away + 0.16 * below * rng.uniform(size=n) ** 3
    tall = np.minimum(tall, 0.30)
    reeds = rng.uniform(*_MEADOW_HEIGHT) / 1.5  # a tuft of size 1 is 1.5 high
    tall = np.where(meadow, reeds * rng.uniform(0.7, 1.3, n) * (0.7 + 0.6 * noise[:, 2]), tall)
    yaw = rng.uniform(0.0, 2.0 * np.pi, n)
    lean = rng.normal(0.0, 0.25, n)
    out = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(n)], 1)
    upward = np.array([0.0, 0.0, 1.0])
    rib = np.sin(lean)[:, None] * out + np.cos(lean)[:, None] * upward
    up = np.cos(lean)[:, None] * out - np.sin(lean)[:, None] * upward
    root = stack_columns(spot, ground_height(model.terrain, *spot.T)) + 0.74 * tall[:, None] * rib
    tint = np.array(colours.grass) * rng.uniform(0.55, 1.35, (n, 1))
    tint = tint + np.array(colours.weathered) * rng.uniform(size=(n, 1)) ** 2
    dry = rng.uniform(size=(n, 1)) < np.clip(colours.dry_share + 0.6 * (noise[:, :1] - 0.5), 0.05, 0.97)
    tint = np.where(dry, np.array(colours.dry) * rng.uniform(0.5, 1.25, (n, 1)), tint)
    tufts = make_batch(
        LEAF,
        stack_columns(root, tall),
        b=stack_columns(rib, textures.GRASS_OUTLINE),
        c=stack_columns(up, rng.uniform(size=n)),
        d=stack_columns(rng.normal(0.0, 0.3, n), np.zeros(n), np.zeros(n), np.zeros(n)),
        material=int(materials.GRASS),
        tint=tint,
        organ=int(Organ.GROUND),
        label=label(Organ.GROUND, 0),
        carrier=static_carrier,
        group=_cells(root),
    )
    return [tufts]


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
    off = near + np.maximum(_TREES[1] - near, 8.0) * rng.uniform(size=count) ** 1.5
    along = rng.uniform(-1.0, 1.0, count)
    middle = 0.5 * (yard.low + yard.high)
    half = 0.5 * (yard.high - yard.low)
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
    reach = rng.uniform(0.25, 1.0, (n, 1)) ** 0.5
    wide = (0.34 * tall * rng.uniform(0.8, 1.3, count))[tree]
    crown = foot + stack_columns(0.0, 0.0, 0.62 * tall)
    where = crown[tree] + direction * reach * np.stack([wide, wide, 0.38 * tall[tree]], 1)
    size = 0.10 * tall[tree] * rng.uniform(0.6, 1.3, n)
    ground = ground_height(model.terrain, *where[:, :2].T)
    where[:, 2] = np.maximum(where[:, 2], ground + 0.05 + 1.2 * size)
    up = frames.normalize(direction + 0.4 * rng.normal(size=(n, 3)))
    rib = frames.normalize(np.array([0.0, 0.0, 1.0]) + 0.5 * rng.normal(size=(n, 3)))
    rib = frames.normalize(rib - up * (rib * up).sum(1, keepdims=True))
    shade = 0.55 + 0.55 * np.clip((where[:, 2] - foot[tree, 2]) / tall[tree], 0.0, 1.0)
    tone = rng.uniform(0.75, 1.3, (count, 1))[tree] * shade[:, None] * rng.uniform(0.8, 1.2, (n, 1))
    return [trunk, _blades(where, size, rib, up, np.array(TREE_TINT) * tone, rng, static_carrier)]
