"""Bark, cut wood, tendrils, dead leaves, straw, prunings, drip hoses, ties and posts as primitives.

None of this can be touched: it is thin, or lies on what can be touched (:mod:`vinesim.scene.generation.old_wood`).
Tendrils, dead leaves and ties move with the shoots and wires that carry them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from vinesim.core import frames
from vinesim.kernels.shading import materials
from vinesim.scene import leaves
from vinesim.scene.generation.gnarl import post_kinds
from vinesim.scene.ids import NO_OBJECT, Organ, label
from vinesim.scene.model import Model
from vinesim.scene.spec import Clutter
from vinesim.scene.state import State
from vinesim.scene.terrain import ground_height
from vinesim.sensors.primitives import textures
from vinesim.sensors.primitives.primitive_batches import Batch, make_batch, stack_columns
from vinesim.sensors.raster.primitive_arrays import BOX, CONE, CYLINDER, LEAF
from vinesim.wires.wire_segments import WireSegments, cut

# Colours [linear RGB reflectance]: all GUESSED by eye, beside photographs of vineyards.
OLD_BARK_TINT = (0.136, 0.116, 0.098)
BARK_STRIP_TINTS = ((0.15, 0.115, 0.085), (0.23, 0.19, 0.15), (0.09, 0.065, 0.05))
CUT_TINTS = ((0.27, 0.21, 0.15), (0.19, 0.17, 0.15), (0.11, 0.09, 0.07))
TENDRIL_TINTS = ((0.17, 0.23, 0.07), (0.24, 0.13, 0.06))
"""Fresh and old tendrils."""
DEAD_LEAF_TINTS = ((0.20, 0.115, 0.05), (0.13, 0.078, 0.042), (0.29, 0.20, 0.10))
STRAW_TINTS = ((0.55, 0.45, 0.28), (0.40, 0.31, 0.18), (0.32, 0.30, 0.14))
PRUNING_TINTS = ((0.20, 0.13, 0.08), (0.27, 0.24, 0.20))
HOSE_TINT = (0.022, 0.022, 0.024)
TIE_TINTS = ((0.10, 0.30, 0.12), (0.60, 0.60, 0.56), (0.06, 0.14, 0.32), (0.03, 0.03, 0.03), (0.42, 0.34, 0.20))
WOODEN_POST_TINTS = ((0.27, 0.20, 0.135), (0.30, 0.275, 0.24), (0.17, 0.135, 0.09))
CONCRETE_TINT = (0.42, 0.40, 0.365)
STEEL_TINTS = ((0.37, 0.385, 0.40), (0.145, 0.092, 0.066))
"""Galvanised, and rusty."""

MAX_STRIPS = 30_000
MAX_TENDRILS = 2_000
MAX_DEAD_LEAVES = 4_000
MAX_STRAW = 26_000
MAX_PRUNINGS = 6_000
MAX_TIES = 3_000
"""Largest numbers of things of each kind; larger vineyards have fewer for each vine."""
_STRAW_DENSITY = 70.0
"""Clumps of straw on a square metre."""
_HOSE_RADIUS = 0.008
_CELL = 1.0
"""Width [m] of the squares of ground by which primitives are grouped in clusters."""


def clutter_batches(
    model: Model, segments: WireSegments, static_carrier: int, low: np.ndarray, high: np.ndarray
) -> list[Batch]:
    """Returns the primitives of all clutter of a model except distant rows; none for a model without clutter.

    ``segments``: the wires; ``static_carrier``: carrier of static primitives, which follows the carriers of the wires;
    ``low``, ``high``: [2] m corners of the area with vines.
    """
    clutter = model.look.clutter
    first_wire = static_carrier - len(segments)
    parts: list[Batch | None] = []
    if clutter.old_wood > 0.0:
        parts += [bark_batch(model, clutter.old_wood, static_carrier), cut_batch(model, static_carrier)]
    if clutter.tendrils > 0.0:
        parts += [
            tendril_batch(model, clutter.tendrils),
            wire_tendril_batch(model, clutter.tendrils, segments, first_wire),
        ]
    if clutter.dead_leaves > 0.0:
        parts += [
            dead_leaf_batch(model, clutter.dead_leaves),
            wire_leaf_batch(model, clutter.dead_leaves, segments, first_wire),
        ]
    if clutter.straw > 0.0:
        parts.append(straw_batch(model, clutter.straw, low, high, static_carrier))
    if clutter.prunings > 0.0:
        parts.append(pruning_batch(model, clutter.prunings, low, high, static_carrier))
    if clutter.hose > 0.0:
        parts.append(hose_batch(model, clutter.hose, static_carrier))
    if clutter.ties > 0.0:
        parts += [arm_tie_batch(model, clutter.ties, static_carrier), shoot_tie_batch(model, clutter.ties)]
    parts += post_batches(model, clutter, static_carrier)
    return [part for part in parts if part is not None and len(part)]


def redrawn_posts(model: Model) -> np.ndarray:
    """Returns whether each fixed piece is a post that :func:`post_batches` draws [fixed] bool."""
    if model.look.clutter.posts == "plain":
        return np.zeros(len(model.fixed_start), bool)
    return model.fixed_organ == int(Organ.POLE)


def with_old_bark(model: Model, material: np.ndarray, tint: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns material [n] and colour [n, 3] of fixed pieces, with bark replaced by old bark if the wood is old."""
    if model.look.clutter.old_wood == 0.0:
        return material, tint
    bark = material == int(materials.BARK)
    return np.where(bark, int(materials.OLD_BARK), material), np.where(bark[:, None], OLD_BARK_TINT, tint)


def _generator(model: Model, kind: int) -> np.random.Generator:
    """Returns the random generator of one kind of clutter."""
    return np.random.default_rng(np.random.SeedSequence(model.look.seed, spawn_key=(0, 0, 3, kind)))


def _cells(position: np.ndarray) -> np.ndarray:
    """Returns the group [n] of each position [n, 3] m: one number for each square of the ground."""
    cell = np.floor(position[:, :2] / _CELL).astype(np.int64)
    cell -= cell.min(0, initial=0)
    return (cell[:, 1] * (cell[:, 0].max(initial=0) + 1) + cell[:, 0]).astype(np.int32)


def _tints(rng: np.random.Generator, tints: tuple[tuple[float, float, float], ...], count: int) -> np.ndarray:
    """Returns colours [count, 3] between the given ones, each a little brighter or darker."""
    weight = rng.dirichlet(np.full(len(tints), 0.6), count)
    return weight @ np.array(tints) * rng.uniform(0.75, 1.2, (count, 1))


def _chains(
    points: np.ndarray,
    radius: np.ndarray,
    *,
    material: int | np.ndarray,
    tint: np.ndarray | tuple[float, float, float],
    organ: int | np.ndarray,
    labels: int | np.ndarray,
    carrier: int | np.ndarray,
    group: np.ndarray | None = None,
) -> Batch:
    """Returns round cones along polylines ``points`` [n, point, 3] m with ``radius`` [n, point] m; all other properties
    are [n] or for all. Without ``group`` cones are grouped by squares of ground."""
    count, pieces = len(points), points.shape[1] - 1
    a = points[:, :-1].reshape(-1, 3)
    b = points[:, 1:].reshape(-1, 3)
    step = np.linalg.norm(points[:, 1:] - points[:, :-1], axis=2)

    def each(values: int | np.ndarray) -> np.ndarray:
        return np.repeat(np.broadcast_to(values, count), pieces)

    tint = np.broadcast_to(tint, (count, 3))
    along = (np.cumsum(step, 1) - step).ravel()
    seed = np.repeat(np.arange(count) * 0.618 % 7.0, pieces)
    return make_batch(
        CONE,
        stack_columns(a, radius[:, :-1].ravel()),
        b=stack_columns(b, radius[:, 1:].ravel()),
        c=stack_columns(along, seed, 0.0, 0.0),
        material=each(material),
        tint=np.repeat(tint, pieces, 0),
        organ=each(organ),
        label=each(labels),
        carrier=each(carrier),
        group=_cells(0.5 * (a + b)) if group is None else np.repeat(group, pieces),
    )


def _beside(direction: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Returns unit vectors [n, 3] across the unit vectors ``direction`` [n, 3], turned by ``angle`` [n] rad about
    them."""
    other = np.where(np.abs(direction[:, 2:]) < 0.8, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    one = frames.normalize(frames.cross(direction, other))
    two = frames.cross(direction, one)
    return one * np.cos(angle)[:, None] + two * np.sin(angle)[:, None]


# -- old wood


class _Wood:
    """Trunks and arms as chains of pieces."""

    def __init__(self, model: Model) -> None:
        wood = np.isin(model.fixed_organ, (int(Organ.TRUNK), int(Organ.ARM)))
        after = np.append((model.fixed_end[:-1] == model.fixed_start[1:]).all(1), False)
        same = np.append((model.fixed_index[:-1] == model.fixed_index[1:]), False)
        same &= np.append(model.fixed_organ[:-1] == model.fixed_organ[1:], False)
        follows = wood & after & same
        self._start = model.fixed_start.astype(float)
        self._end = model.fixed_end.astype(float)
        self._radius = model.fixed_radius.astype(float)
        self.length = np.linalg.norm(self._end - self._start, axis=1)
        # pieces of spur heads and burls follow no other piece
        self.pieces = np.flatnonzero(wood & (follows | np.append(False, follows[:-1])))
        stop = np.flatnonzero(~follows)
        self._last = stop[np.searchsorted(stop, np.arange(len(wood)))]

    def at(self, piece: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns position [n, 3] m, unit direction [n, 3] and radius [n] m of the axis at ``along`` [n] m from the
        start of ``piece`` [n], at most at the end of its chain."""
        piece = piece.copy()
        along = along.copy()
        for _ in range(8):
            over = (along > self.length[piece]) & (piece < self._last[piece])
            along = np.where(over, along - self.length[piece], along)
            piece = np.where(over, piece + 1, piece)
        share = np.clip(along / self.length[piece], 0.0, 1.0)[:, None]
        place = self._start[piece] * (1.0 - share) + self._end[piece] * share
        radius = self._radius[piece]
        way = (self._end - self._start)[piece] / self.length[piece, None]
        return place, way, radius[:, 0] * (1.0 - share[:, 0]) + radius[:, 1] * share[:, 0]

    def sample(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns ``count`` random places on the bark: piece [n] and distance from its start [n] m."""
        area = self.length[self.pieces] * self._radius[self.pieces].mean(1)
        piece = np.sort(rng.choice(self.pieces, count, p=area / area.sum()))
        return piece, rng.uniform(size=count) * self.length[piece]


def bark_batch(model: Model, share: float, static_carrier: int) -> Batch | None:
    """Returns strips of bark along trunks and arms; some have come off at one end and hang."""
    wood = _Wood(model)
    if not len(wood.pieces):
        return None
    rng = _generator(model, 0)
    count = int(min(share * 7.0 * len(wood.pieces), MAX_STRIPS))
    piece, begin = wood.sample(rng, count)
    length = rng.uniform(0.04, 0.16, count)
    turn = rng.uniform(0.0, 2.0 * np.pi, count)
    thick = rng.uniform(0.0014, 0.0040, count)
    peels = rng.uniform(size=count) < 0.16
    lift = np.where(peels, rng.uniform(0.004, 0.028, count), rng.uniform(-0.0005, 0.0018, count))
    twist = rng.normal(0.0, 0.35, count)
    points = []
    steps = np.array([0.0, 0.5, 1.0])
    for step in steps:
        place, way, radius = wood.at(piece, begin + step * length)
        side = _beside(way, turn + twist * step)
        off = radius - 0.35 * thick + lift * step**2
        sag = np.where(peels, 0.45 * lift * step**2, 0.0)
        points.append(place + side * off[:, None] - sag[:, None] * [0.0, 0.0, 1.0])
    taper = np.array([0.6, 1.0, 0.4])
    organ = model.fixed_organ[piece]
    points = _above_ground(model, np.stack(points, 1), thick)
    return _chains(
        points,
        thick[:, None] * taper,
        material=np.where(peels | (rng.uniform(size=count) < 0.45), int(materials.POST), int(materials.OLD_BARK)),
        tint=_tints(rng, BARK_STRIP_TINTS, count),
        organ=organ,
        labels=organ * label(Organ(1), 0) + model.fixed_index[piece],
        carrier=static_carrier,
    )


def cut_batch(model: Model, static_carrier: int) -> Batch | None:
    """Returns the flat grey cuts at the ends of stubs, which are the pieces of wood of constant radius."""
    wood = np.isin(model.fixed_organ, (int(Organ.TRUNK), int(Organ.ARM)))
    stub = np.flatnonzero(
        wood & (model.fixed_radius[:, 0] == model.fixed_radius[:, 1]) & (model.fixed_shear_modulus == 0.0)
    )
    if not len(stub):
        return None
    rng = _generator(model, 1)
    end = model.fixed_end[stub].astype(float)
    way = frames.normalize(end - model.fixed_start[stub])
    r = model.fixed_radius[stub, :1].astype(float)
    organ = model.fixed_organ[stub]
    return make_batch(
        CYLINDER,
        stack_columns(end + 0.35 * r * way, 1.03 * r),
        b=stack_columns(end + 1.01 * r * way, 0.0),
        c=stack_columns(0.0, rng.uniform(0.0, 7.0, len(stub)), 0.0, 0.0),
        material=int(materials.POST),
        tint=_tints(rng, CUT_TINTS, len(stub)),
        organ=organ,
        label=organ * label(Organ(1), 0) + model.fixed_index[stub],
        carrier=static_carrier,
        group=_cells(end),
    )


# -- shoots and wires


def _coil(
    rng: np.random.Generator, count: int, steps: int, length: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns coordinates [n, step] m, along and across (two), of tendrils: a bow that ends in a coil."""
    t = np.linspace(0.0, 1.0, steps)
    coiled = np.maximum(t - 0.5, 0.0) / 0.5
    turns = rng.uniform(1.0, 3.0, (count, 1))
    wide = length[:, None] * rng.uniform(0.04, 0.10, (count, 1))
    phase = 2.0 * np.pi * turns * coiled
    along = length[:, None] * (np.minimum(t, 0.5) + 0.25 * coiled) + wide * np.sin(phase)
    bow = length[:, None] * rng.normal(0.0, 0.25, (count, 1)) * t**2
    return along, bow + wide * (1.0 - np.cos(phase)), 0.3 * wide * np.sin(phase + 1.0) * coiled


def tendril_batch(model: Model, share: float) -> Batch | None:
    """Returns tendrils at nodes of shoots, with the label of their shoot."""
    rng = _generator(model, 2)
    count = int(min(share * len(model.leaf_body) / 8.0, MAX_TENDRILS))
    if not count:
        return None
    leaf = np.sort(rng.choice(len(model.leaf_body), count, replace=False))
    body = model.leaf_body[leaf]
    base = model.leaf_base[leaf].astype(float)
    # a tendril stands opposite to its leaf
    out = frames.normalize(base * [0.0, 1.0, 1.0] - (model.leaf_pose[leaf, :3] - base))
    out = frames.normalize(out + 0.45 * rng.normal(size=(count, 3)) + [0.4, 0.0, 0.0])
    one = _beside(out, rng.uniform(0.0, 2.0 * np.pi, count))
    two = frames.cross(out, one)
    along, across, beside = _coil(rng, count, 12, rng.uniform(0.07, 0.26, count))
    points = base[:, None] + sum(
        (c[:, :, None] * v[:, None] for c, v in ((along, out), (across, one), (beside, two))), np.zeros(1)
    )
    points -= (base * [0.0, 1.0, 1.0])[:, None]
    tree = model.body_tree[body]
    old = rng.uniform(size=(count, 1)) ** 1.5
    return _chains(
        points,
        np.broadcast_to(np.linspace(0.0013, 0.0006, 12), (count, 12)),
        material=int(materials.STEM),
        tint=(1.0 - old) * TENDRIL_TINTS[0] + old * TENDRIL_TINTS[1],
        organ=int(Organ.CANE),
        labels=label(Organ.CANE, 0) + tree,
        carrier=body,
        group=tree,
    )


def wire_tendril_batch(model: Model, share: float, segments: WireSegments, first_carrier: int) -> Batch | None:
    """Returns dry tendrils that are wound around wires, with the label of no tree."""
    count = int(min(share * len(model.leaf_body) / 60.0, 0.25 * MAX_TENDRILS)) if len(segments) else 0
    if not count:
        return None
    rng = _generator(model, 3)
    steps = 18
    chosen, place, way, radius = _on_wires(model, rng, segments, count)
    t = np.linspace(0.0, 1.0, steps)
    loose = np.maximum(t - 0.75, 0.0) / 0.25
    angle = 2.0 * np.pi * rng.uniform(2.0, 4.5, (count, 1)) * t + rng.uniform(0.0, 6.0, (count, 1))
    wide = radius[:, None] + 0.0007 + loose**2 * rng.uniform(0.01, 0.05, (count, 1))
    along = rng.uniform(0.008, 0.03, (count, 1)) * t
    one = _beside(way, np.zeros(count))
    two = frames.cross(way, one)
    points = place[:, None] + along[..., None] * way[:, None]
    points += (wide * np.cos(angle))[..., None] * one[:, None] + (wide * np.sin(angle))[..., None] * two[:, None]
    return _chains(
        points - segments.rest_q[chosen, None, :3],
        np.broadcast_to(np.linspace(0.0009, 0.0006, steps), (count, steps)),
        material=int(materials.STEM),
        tint=np.array(TENDRIL_TINTS[1]) * rng.uniform(0.5, 1.1, (count, 1)),
        organ=int(Organ.CANE),
        labels=label(Organ.CANE, NO_OBJECT),
        carrier=first_carrier + chosen,
        group=len(model.tree_first) + segments.piece[chosen],
    )


def _on_wires(
    model: Model, rng: np.random.Generator, segments: WireSegments, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Returns random places on wires: segment [n], position [n, 3] m, unit direction [n, 3], radius of the wire [n]
    m."""
    chosen = np.sort(rng.integers(len(segments), size=count))
    piece = segments.piece[chosen]
    share = (segments.start + (segments.end - segments.start) * rng.uniform(0.1, 0.9, len(segments)))[chosen]
    way = (model.fixed_end - model.fixed_start)[piece].astype(float)
    return (
        chosen,
        model.fixed_start[piece] + share[:, None] * way,
        frames.normalize(way),
        model.fixed_radius[piece, 0].astype(float),
    )


def _curled(rng: np.random.Generator, count: int) -> np.ndarray:
    """Returns the curvatures of dead leaves [n, 4]: rolled in from both sides, the tip bent."""
    sign = np.where(rng.uniform(size=count) < 0.7, 1.0, -1.0)
    return np.stack(
        [
            sign * rng.uniform(0.35, 1.1, count),
            rng.normal(0.0, 0.55, count),
            sign * rng.uniform(0.2, 0.9, count),
            np.zeros(count),
        ],
        1,
    )


def _dead_leaves(
    rng: np.random.Generator,
    place: np.ndarray,
    down: np.ndarray,
    size: np.ndarray,
    labels: int | np.ndarray,
    carrier: np.ndarray,
    group: np.ndarray,
) -> Batch:
    """Returns dead leaves that hang from ``place`` [n, 3] m; ``down``: [n, 3] direction of gravity in the carriers'
    frames."""
    count = len(place)
    rib = frames.normalize(down + 0.35 * rng.normal(size=(count, 3)))
    up = _beside(rib, rng.uniform(0.0, 2.0 * np.pi, count))
    shape = leaves.blade_shape(rng.integers(1 << 20, size=count))
    return make_batch(
        LEAF,
        stack_columns(place, size),
        b=stack_columns(rib, shape),
        c=stack_columns(up, rng.uniform(size=count)),
        d=_curled(rng, count),
        material=int(materials.FOLIAGE),
        tint=_tints(rng, DEAD_LEAF_TINTS, count),
        organ=int(Organ.LEAF),
        label=labels,
        carrier=carrier,
        group=group,
    )


def dead_leaf_batch(model: Model, share: float) -> Batch | None:
    """Returns dead leaves that hang in the canopy, with the label of their shoot."""
    rng = _generator(model, 4)
    count = int(min(share * len(model.leaf_body) / 12.0, MAX_DEAD_LEAVES))
    if not count:
        return None
    leaf = np.sort(rng.choice(len(model.leaf_body), count, replace=False))
    body = model.leaf_body[leaf]
    turn = frames.conjugate(State.at_rest(model).body_q[body, 3:].astype(float))
    down = frames.rotate(turn, np.broadcast_to([0.0, 0.0, -1.0], (count, 3)))
    share_out = rng.uniform(0.1, 0.7, (count, 1))
    place = model.leaf_base[leaf] * (1.0 - share_out) + model.leaf_pose[leaf, :3] * share_out
    size = np.sqrt(np.median(model.leaf_size) * model.leaf_size[leaf]) * rng.uniform(0.4, 0.85, count)
    tree = model.body_tree[body]
    return _dead_leaves(rng, place + 0.01 * down, down, size, label(Organ.LEAF, 0) + tree, body, tree)


def wire_leaf_batch(model: Model, share: float, segments: WireSegments, first_carrier: int) -> Batch | None:
    """Returns dead leaves that hang on wires, with the label of no tree."""
    rng = _generator(model, 5)
    count = int(min(share * len(model.leaf_body) / 120.0, 0.2 * MAX_DEAD_LEAVES)) if len(segments) else 0
    if not count:
        return None
    chosen, place, _, radius = _on_wires(model, rng, segments, count)
    return _dead_leaves(
        rng,
        place - segments.rest_q[chosen, :3] - radius[:, None] * [0.0, 0.0, 1.0],
        np.broadcast_to([0.0, 0.0, -1.0], (count, 3)),
        np.median(model.leaf_size) * rng.uniform(0.35, 0.8, count),
        label(Organ.LEAF, NO_OBJECT),
        first_carrier + chosen,
        len(model.tree_first) + segments.piece[chosen],
    )


# -- ground


def _ground(model: Model, points: np.ndarray) -> np.ndarray:
    """Returns the height [...] m of the ground at ``points`` [..., 2 or more] m."""
    flat = points.reshape(-1, points.shape[-1])
    height = ground_height(model.terrain, flat[:, 0], flat[:, 1]) + np.zeros(len(flat))
    return height.reshape(points.shape[:-1])


def _above_ground(model: Model, points: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Returns ``points`` [n, point, 3] m, raised to ``radius`` [n] m above the ground where they are lower."""
    points = points.copy()
    points[..., 2] = np.maximum(points[..., 2], _ground(model, points) + radius[:, None])
    return points


def straw_batch(model: Model, share: float, low: np.ndarray, high: np.ndarray, static_carrier: int) -> Batch | None:
    """Returns clumps of dry grass that lie on the ground, with the ground's label; each is a flat tuft of blades."""
    low = low - 4.0
    high = high + 4.0
    count = int(min(share * _STRAW_DENSITY * np.prod(high - low), MAX_STRAW))
    if not count:
        return None
    rng = _generator(model, 6)
    position = low + (high - low) * rng.uniform(size=(count, 2))
    noise = textures.sample_noise(position[:, 0] * 0.13, position[:, 1] * 0.13)
    position = position[noise[:, 1] > 0.05 + 0.30 * rng.uniform(size=count)]
    count = len(position)
    size = rng.uniform(0.09, 0.22, count)
    yaw = rng.uniform(0.0, 2.0 * np.pi, count)
    tilt = rng.uniform(0.0, 0.22, count)
    rib = np.stack([np.cos(tilt) * np.cos(yaw), np.cos(tilt) * np.sin(yaw), np.sin(tilt)], 1)
    side = np.stack([-np.sin(yaw), np.cos(yaw), rng.normal(0.0, 0.10, count)], 1)
    up = frames.normalize(frames.cross(rib, side))
    # the lowest corner of the tuft touches the ground
    height = 0.004 + size * (0.76 * np.sin(tilt) + np.abs(frames.cross(rib, up)[:, 2]))
    return make_batch(
        LEAF,
        stack_columns(position, height + ground_height(model.terrain, *position.T), size),
        b=stack_columns(rib, textures.GRASS_OUTLINE),
        c=stack_columns(up, rng.uniform(size=count)),
        d=stack_columns(rng.uniform(0.0, 0.15, count), rng.uniform(0.0, 0.12, count), 0.0, 0.0),
        material=int(materials.GRASS),
        tint=_tints(rng, STRAW_TINTS, count),
        organ=int(Organ.GROUND),
        label=label(Organ.GROUND, 0),
        carrier=static_carrier,
        group=_cells(position),
    )


def pruning_batch(model: Model, share: float, low: np.ndarray, high: np.ndarray, static_carrier: int) -> Batch | None:
    """Returns cut canes that lie on the ground, with the ground's label."""
    low = low - 1.0
    high = high + 1.0
    count = int(min(share * 4.0 * np.prod(high - low), MAX_PRUNINGS))
    if not count:
        return None
    rng = _generator(model, 7)
    middle = low + (high - low) * rng.uniform(size=(count, 2))
    yaw = rng.uniform(0.0, 2.0 * np.pi, count)
    way = np.stack([np.cos(yaw), np.sin(yaw)], 1)
    t = np.linspace(-0.5, 0.5, 4)
    length = rng.uniform(0.12, 0.7, (count, 1))
    bow = rng.normal(0.0, 0.07, (count, 1)) * length * 4.0 * t**2
    level = middle[:, None] + (length * t)[..., None] * way[:, None]
    level += bow[..., None] * np.stack([-way[:, 1], way[:, 0]], 1)[:, None]
    radius = rng.uniform(0.0025, 0.0052, count)
    height = radius[:, None] + rng.uniform(0.0, 0.02, (count, 1)) * (t + 0.5)
    height = height + np.abs(rng.normal(0.0, 0.002, (count, 4)))
    points = np.concatenate([level, (height + _ground(model, level))[..., None]], 2)
    return _chains(
        points,
        radius[:, None] * np.array([1.0, 0.93, 0.87, 0.8]),
        material=int(materials.CANE),
        tint=_tints(rng, PRUNING_TINTS, count),
        organ=int(Organ.GROUND),
        labels=label(Organ.GROUND, 0),
        carrier=static_carrier,
    )


# -- trellis


def _poles(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Returns the fixed pieces that are posts [post], and the row of each [post]."""
    pole = np.flatnonzero(model.fixed_organ == int(Organ.POLE))
    _, row = np.unique(np.round(model.fixed_start[pole, 1], 2), return_inverse=True)
    return pole, row


def hose_batch(model: Model, share: float, static_carrier: int) -> Batch | None:
    """Returns drip hoses along a share of the rows, with emitters and clips at the posts.

    Their labels are those of wires, numbered after the last one, row by row.
    """
    rng = _generator(model, 8)
    pole, row = _poles(model)
    if not len(pole):
        return None
    first = int(model.fixed_index[model.fixed_organ == int(Organ.WIRE)].max(initial=-1)) + 1
    parts = []
    for number in range(int(row.max()) + 1):
        present = rng.uniform() < share
        at = model.fixed_start[pole[row == number]].astype(float)
        line, is_support = _hose_line(model, rng, at, float(model.fixed_radius[pole].mean()))
        if not present:
            continue
        drip = line[(np.arange(len(line)) % 4) == 1]
        half = np.array([0.014, 0.0, 0.0])
        clip = line[is_support]
        above, beside = np.array([0.0, 0.0, 0.014]), np.array([0.0, -0.03, 0.014])
        for points, radius in (
            (line[None], _HOSE_RADIUS),
            (np.stack([drip - half, drip + half], 1), 0.0105),
            (np.stack([clip + above, clip + beside], 1), 0.004),
        ):
            parts.append(
                _chains(
                    points,
                    np.full(points.shape[:2], radius),
                    material=int(materials.RUBBER),
                    tint=HOSE_TINT,
                    organ=int(Organ.WIRE),
                    labels=label(Organ.WIRE, first + number),
                    carrier=static_carrier,
                )
            )
    return _joined(parts) if parts else None


def _hose_line(
    model: Model, rng: np.random.Generator, poles: np.ndarray, thick: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns points [n, 3] m of a hose that hangs in bows beside ``poles`` [post, 3] m of radius ``thick`` m, and
    whether a post holds each of them [n] bool."""
    poles = poles[np.argsort(poles[:, 0])]
    apart = float(np.median(np.diff(poles[:, 0]))) if len(poles) > 1 else 2.0
    supports = np.concatenate([[poles[0, 0] - 0.5 * apart], poles[:, 0], [poles[-1, 0] + 0.5 * apart]])
    height = rng.uniform(0.32, 0.48)
    sags = rng.uniform(0.0, 0.05, len(supports))
    wave = rng.uniform(0.0, 6.0)
    x = np.unique(np.concatenate([supports, np.arange(supports[0], supports[-1], 0.125)]))
    span = np.clip(np.searchsorted(supports, x, "right") - 1, 0, len(supports) - 2)
    t = (x - supports[span]) / (supports[span + 1] - supports[span])
    y = poles[0, 1] + 0.5 * thick + 0.045 + 0.006 * np.sin(2.3 * x + wave)
    ground = _ground(model, np.stack([supports, np.full(len(supports), poles[0, 1])], 1))
    z = height + ground[span] * (1.0 - t) + ground[span + 1] * t
    z = z - sags[span] * 4.0 * t * (1.0 - t) + 0.004 * np.sin(7.0 * x + wave)
    return np.stack([x, y, z], 1), np.isin(x, poles[:, 0])


def _joined(parts: list[Batch]) -> Batch:
    """Returns batches of cones as one; their groups are squares of ground."""
    names = [field.name for field in dataclasses.fields(Batch) if field.name != "kind"]
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    columns["group"] = _cells(0.5 * (columns["a"] + columns["b"])[:, :3])
    return Batch(kind=parts[0].kind, **columns)


def _rings(centre: np.ndarray, axis: np.ndarray, radius: np.ndarray, wide: float, steps: int) -> np.ndarray:
    """Returns closed polylines [n, step + 1, 3] m around ``axis`` [n, 3] at ``centre`` [n, 3] m with ``radius`` [n] m
    and a loose end of ``wide`` m."""
    angle = np.linspace(0.0, 2.0 * np.pi, steps + 1)
    one = _beside(axis, np.zeros(len(axis)))
    two = frames.cross(axis, one)
    reach = radius[:, None] + np.r_[np.zeros(steps), wide]
    return centre[:, None] + reach[..., None] * (
        np.cos(angle)[None, :, None] * one[:, None] + np.sin(angle)[None, :, None] * two[:, None]
    )


def arm_tie_batch(model: Model, share: float, static_carrier: int) -> Batch | None:
    """Returns plastic bands around arms, with the label of no wire."""
    wood = _Wood(model)
    arms = wood.pieces[model.fixed_organ[wood.pieces] == int(Organ.ARM)]
    number = len(np.unique(model.fixed_index[arms]))
    count = int(min(share * 6 * number, MAX_TIES))
    if not count:
        return None
    rng = _generator(model, 9)
    piece = np.sort(rng.choice(arms, count))
    place, way, radius = wood.at(piece, rng.uniform(size=count) * wood.length[piece])
    points = _rings(place, way, radius + 0.0012, 0.02, 9)
    return _chains(
        points,
        np.full(points.shape[:2], 0.0017),
        material=int(materials.PLASTIC),
        tint=np.array(TIE_TINTS)[rng.integers(len(TIE_TINTS), size=count)],
        organ=int(Organ.WIRE),
        labels=label(Organ.WIRE, NO_OBJECT),
        carrier=static_carrier,
    )


def shoot_tie_batch(model: Model, share: float) -> Batch | None:
    """Returns plastic bands around shoots at the wires that they are tied to, with the label of no wire."""
    count = int(min(share * 0.25 * len(model.tie_body), MAX_TIES))
    if not count:
        return None
    rng = _generator(model, 10)
    tie = np.sort(rng.choice(len(model.tie_body), count, replace=False))
    body = model.tie_body[tie]
    centre = model.tie_point[tie] * [1.0, 0.0, 0.0]
    axis = np.broadcast_to([1.0, 0.0, 0.0], (count, 3))
    points = _rings(centre, axis, model.body_radius[body].max(1) + 0.0025, 0.012, 7)
    return _chains(
        points,
        np.full(points.shape[:2], 0.0012),
        material=int(materials.PLASTIC),
        tint=np.array(TIE_TINTS)[rng.integers(len(TIE_TINTS), size=count)],
        organ=int(Organ.WIRE),
        labels=label(Organ.WIRE, NO_OBJECT),
        carrier=body,
        group=model.body_tree[body],
    )


def post_batches(model: Model, clutter: Clutter, static_carrier: int) -> list[Batch]:
    """Returns the posts of those kinds that are not plain, with the labels of the posts that they replace.

    The faces of a concrete post are 3 mm inside its round contact shape, its edges 13 mm outside.
    """
    pole, row = _poles(model)
    if clutter.posts == "plain" or not len(pole):
        return []
    kind = post_kinds(clutter, model.look.seed, row)
    rng = _generator(model, 11)
    tone = rng.uniform(0.8, 1.15, (len(pole), 1))
    shade = rng.integers(1 << 16, size=int(row.max()) + 1)[row]
    drawers: dict[str, Callable[..., list[Batch]]] = {
        "wood": _wooden_posts,
        "concrete": _concrete_posts,
        "steel": _steel_posts,
    }
    parts = []
    for name, draw in drawers.items():
        mine = kind == name
        if mine.any():
            parts += draw(model, pole[mine], tone[mine], shade[mine], static_carrier)
    return parts


def _post_pieces(model: Model, pole: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns parts of posts that are at most 0.5 m long: index into ``pole`` [part], and both ends [part, 3] m."""
    way = (model.fixed_end - model.fixed_start)[pole].astype(float)
    whole, begin, stop = cut(np.linalg.norm(way, axis=1), 0.5)
    start = model.fixed_start[pole].astype(float)[whole]
    return whole, start + begin[:, None] * way[whole], start + stop[:, None] * way[whole]


def _wooden_posts(
    model: Model, pole: np.ndarray, tone: np.ndarray, shade: np.ndarray, static_carrier: int
) -> list[Batch]:
    whole, a, b = _post_pieces(model, pole)
    radius = model.fixed_radius[pole, 0][whole]
    tint = (np.array(WOODEN_POST_TINTS)[shade % len(WOODEN_POST_TINTS)] * tone)[whole]
    return [
        make_batch(
            CONE,
            stack_columns(a, radius),
            b=stack_columns(b, radius),
            c=stack_columns(a[:, 2], 7.0 * tone[whole], 0.0, 0.0),
            material=int(materials.POST),
            tint=tint,
            organ=int(Organ.POLE),
            label=label(Organ.POLE, 0) + model.fixed_index[pole][whole],
            carrier=static_carrier,
            group=_cells(a),
        )
    ]


def _box_posts(
    model: Model,
    pole: np.ndarray,
    half: tuple[float, float],
    middle: tuple[float, float],
    tint: np.ndarray,
    static_carrier: int,
) -> Batch:
    """Returns upright boxes with half widths ``half`` m whose middle is ``middle`` m beside the axes of posts."""
    start, end = model.fixed_start[pole].astype(float), model.fixed_end[pole].astype(float)
    centre = 0.5 * (start + end) + [*middle, 0.0]
    return make_batch(
        BOX,
        stack_columns(centre, half[0]),
        b=(0.0, 0.0, 0.0, 1.0),
        c=stack_columns(half[1], 0.5 * (end - start)[:, 2], tint[:, 0] * 17.0 % 7.0, 0.0),
        material=int(materials.POST),
        tint=tint,
        organ=int(Organ.POLE),
        label=label(Organ.POLE, 0) + model.fixed_index[pole],
        carrier=static_carrier,
        group=_cells(centre),
    )


def _concrete_posts(
    model: Model, pole: np.ndarray, tone: np.ndarray, shade: np.ndarray, static_carrier: int
) -> list[Batch]:
    half = float(model.fixed_radius[pole].mean()) - 0.003
    tint = np.array(CONCRETE_TINT) * tone
    return [_box_posts(model, pole, (half, half), (0.0, 0.0), tint, static_carrier)]


def _steel_posts(
    model: Model, pole: np.ndarray, tone: np.ndarray, shade: np.ndarray, static_carrier: int
) -> list[Batch]:
    rusty = shade % 3 == 0
    tint = np.where(rusty[:, None], STEEL_TINTS[1], STEEL_TINTS[0]) * tone
    wide = float(model.fixed_radius[pole].mean())
    # a web with two flanges, open to the side
    boxes = [
        ((wide, 0.0015), (0.0, -0.6 * wide)),
        ((0.0015, 0.6 * wide), (-wide, 0.0)),
        ((0.0015, 0.6 * wide), (wide, 0.0)),
    ]
    return [_box_posts(model, pole, *box, tint, static_carrier) for box in boxes]
