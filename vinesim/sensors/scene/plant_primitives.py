"""Vines as primitives: canes and peduncles, leaves, and bunches berry by berry."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim import frames
from vinesim.kernels.shading import materials
from vinesim.scene import leaves
from vinesim.scene.berries import VARIETIES, lay_out_berries, segment_of
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.sensors.scene import textures
from vinesim.sensors.scene.primitive_batches import CONE, LEAF, SPHEROID, Batch, make_batch, stack_columns

_BROWN = (0.30, 0.17, 0.08)
_STEM = (0.19, 0.22, 0.075)


def bunch_bodies(model: Model, bunch: int) -> np.ndarray:
    """Bodies that carry one bunch's berries [piece]: its own, then its clusters."""
    first, count = int(model.bunch_cluster[bunch]), int(model.bunch_clusters[bunch])
    return np.append(model.bunch_body[bunch], np.arange(first, first + count))


def cane_batch(model: Model, still: int) -> Batch:
    """One round cone for each piece of cane and peduncle."""
    bodies = np.flatnonzero((model.body_organ != int(Organ.BUNCH)) & (model.body_length > 0.0))
    rng = np.random.default_rng(5)
    seed = rng.uniform(size=len(model.tree_first))
    organ, tree = model.body_organ[bodies], model.body_tree[bodies]
    index = tree.copy()
    bunch_of = model.bunch_of_body()[bodies]
    index = np.where(bunch_of >= 0, bunch_of, index)
    # shoots ripen from the base: green towards the tip, brown where the wood is thick
    green = np.clip(1.6 - model.body_radius[bodies].mean(1) / 0.0022, 0.0, 1.0) * (seed[tree] < 0.6)
    green = np.where(organ == int(Organ.PEDUNCLE), 1.0, green)[:, None]
    tint = (1.0 - green) * np.array(_BROWN) * (0.7 + 0.6 * seed[tree, None]) + green * np.array(_STEM)
    material = np.where(green[:, 0] > 0.5, int(materials.STEM), int(materials.CANE))
    length = model.body_length[bodies]
    zero = np.zeros(len(bodies))
    return make_batch(
        CONE,
        stack_columns(zero, zero, zero, model.body_radius[bodies, 0]),
        b=stack_columns(length, zero, zero, model.body_radius[bodies, 1]),
        c=stack_columns(zero, seed[tree] * 7.0, zero, zero),
        material=material,
        tint=tint,
        organ=organ,
        label=organ * label(Organ(1), 0) + index,
        carrier=bodies,
        group=tree,
    )


def leaf_batches(model: Model) -> list[Batch]:
    """Blades, their petioles, and the nodes from which they grow."""
    count = len(model.leaf_body)
    if not count:
        return []
    rng = np.random.default_rng(11)
    shape = leaves.blade_shape(np.arange(count))
    q = model.leaf_pose[:, 3:]
    rib, up = (frames.rotate(q, np.broadcast_to(np.eye(3)[k], (count, 3))) for k in (0, 2))
    base, petiole_end, size = model.leaf_base, model.leaf_pose[:, :3], model.leaf_size * textures.leaf_scale(shape)
    young = rng.uniform(size=(count, 1))
    tint = np.array([0.042, 0.115, 0.016]) * (0.75 + 0.6 * young) * (1.0 + 0.10 * rng.normal(size=(count, 1)))
    tint = tint + np.array([0.030, 0.035, 0.0]) * np.clip(0.7 * rng.normal(size=(count, 1)), 0.0, 2.0)
    bend = np.stack([rng.normal(-0.10, 0.16, count), rng.normal(-0.16, 0.14, count), rng.uniform(0.0, 0.45, count)], 1)
    body, tree = model.leaf_body, model.body_tree[model.leaf_body]
    names = label(Organ.LEAF, 0) + tree
    blade = make_batch(
        LEAF,
        stack_columns(petiole_end, size),
        b=stack_columns(rib, shape),
        c=stack_columns(up, rng.uniform(size=count)),
        d=stack_columns(bend, model.leaf_age),
        material=int(materials.FOLIAGE),
        tint=tint,
        organ=int(Organ.LEAF),
        label=names,
        carrier=body,
        group=tree,
    )
    petiole = make_batch(
        CONE,
        stack_columns(base, 0.0017),
        b=stack_columns(petiole_end, 0.0012),
        material=int(materials.STEM),
        tint=(0.21, 0.13, 0.06),
        organ=int(Organ.LEAF),
        label=names,
        carrier=body,
        group=tree,
    )
    # a node is 1.45 times as thick as the cane between nodes
    along = np.clip(base[:, 0] / np.maximum(model.body_length[body], 1e-6), 0.0, 1.0)
    r = model.body_radius[body, 0] * (1.0 - along) + model.body_radius[body, 1] * along
    reach = np.array([1.0, 0.0, 0.0]) * r[:, None]
    axis = base * np.array([1.0, 0.0, 0.0])
    node = make_batch(
        CONE,
        stack_columns(axis - 0.7 * reach, 1.25 * r),
        b=stack_columns(axis + 0.4 * reach, 1.45 * r),
        material=int(materials.CANE),
        tint=(0.24, 0.15, 0.07),
        organ=int(Organ.CANE),
        label=label(Organ.CANE, 0) + tree,
        carrier=body,
        group=tree,
    )
    return [blade, petiole, node]


_UNRIPE = {"green": np.array([0.085, 0.150, 0.022]), "shot": 0.45}
"""Colour of a hard green berry (linear RGB reflectance, GUESSED by eye), and the size of a berry without seeds."""
_RIPENESS_SPREAD = 0.10
"""Standard deviation of ripeness within a bunch: berries soften and colour one by one. GUESSED."""
_SHOT_BERRY_SHARE = 0.06
"""Share of the berries of a quite unripe bunch that have stayed small and green ("shot berries"). GUESSED."""


@dataclasses.dataclass(frozen=True, eq=False)
class Ripeness:
    """How ripe fruit is: 0 green and hard, 1 as the variety is harvested."""

    bunch: np.ndarray
    """[bunch] mean of its berries."""
    seed: int = 0
    """Of the differences between berries."""

    @classmethod
    def random(cls, count: int, seed: int) -> Ripeness:
        """Of a vineyard before harvest: most bunches ripe, some turning, few green."""
        rng = np.random.default_rng([seed, 3])
        return cls(np.round(rng.beta(2.2, 0.7, count), 3), seed)


def bunch_batches(
    model: Model,
    which: np.ndarray,
    place: list[np.ndarray] | None,
    carrier: list[np.ndarray],
    group: np.ndarray,
    ripeness: Ripeness | None = None,
) -> list[Batch]:
    """Berries and rachises of some bunches [k], each in its pieces: head, first cluster, ... on ``carrier`` [k][piece].

    ``place`` [k][piece, 7] are the poses of the pieces on what carries them, their own frames unless given. A bunch
    without clusters is one piece. ``group`` [k]; without ``ripeness`` all are ripe.
    """
    found: list[Batch] = []
    for first in range(0, len(which), _BATCH_SIZE):
        part = slice(first, first + _BATCH_SIZE)
        found += _bunch_group_batches(model, which[part], place and place[part], carrier[part], group[part], ripeness)
    return found


_BATCH_SIZE = 256
"""Bunches that are laid out together: numpy then works on rows, and temporary arrays stay small."""


def _bunch_group_batches(
    model: Model,
    which: np.ndarray,
    place: list[np.ndarray] | None,
    carrier: list[np.ndarray],
    group: np.ndarray,
    ripeness: Ripeness | None,
) -> list[Batch]:
    ones = [
        lay_out_berries(
            float(model.bunch_length[b]),
            float(model.bunch_radius[b]),
            int(model.bunch_berries[b]),
            int(model.bunch_variety[b]),
            int(model.bunch_seed[b]),
        )
        for b in which
    ]
    pieces = np.array([len(c) for c in carrier])
    first_piece = np.cumsum(pieces) - pieces
    on = np.concatenate(carrier)
    poses = None if place is None else np.concatenate(place)
    whole = model.bunch_length[which].astype(float)

    def piece_at(position: np.ndarray, owner: np.ndarray) -> np.ndarray:
        inner = segment_of(position, whole[owner], pieces[owner])
        return first_piece[owner] + inner

    def placed(points: np.ndarray, piece: np.ndarray, owner: np.ndarray) -> np.ndarray:
        """Points [k, 3] of the bunches' frames, as drawn, on their carriers."""
        along = (whole / pieces)[owner] * (piece - first_piece[owner])
        own = points - along[:, None] * np.array([1.0, 0.0, 0.0])
        return own if poses is None else poses[piece, :3] + frames.rotate(poses[piece, 3:], own)

    def turned(vectors: np.ndarray, piece: np.ndarray) -> np.ndarray:
        return vectors if poses is None else frames.rotate(poses[piece, 3:], vectors)

    count = np.array([len(one.radius) for one in ones])
    owner = np.repeat(np.arange(len(ones)), count)
    position, radius, axis, foot = (
        np.concatenate([getattr(one, name) for one in ones]) for name in ("position", "radius", "axis", "foot")
    )
    varieties = [VARIETIES[v] for v in model.bunch_variety[which]]
    elongation = np.array([v.elongation for v in varieties])[owner]
    ripe = np.array([v.colour for v in varieties])[owner]
    draws = [np.random.default_rng(int(model.bunch_seed[b])) for b in which]
    tone, blush = (np.concatenate([rng.normal(size=n) for rng, n in zip(draws, count, strict=True)]) for _ in (0, 1))
    speck = np.concatenate([rng.uniform(size=n) for rng, n in zip(draws, count, strict=True)])
    colour = ripe * (1.0 + 0.10 * tone[:, None])
    reddish = (colour[:, :1] > 2.0 * colour[:, 1:2]) * np.clip(0.5 * blush[:, None], 0.0, 1.0)
    colour = colour + np.array([0.055, 0.014, 0.010]) * reddish
    if ripeness is not None:
        colour, radius = _apply_ripeness(colour, radius, ripeness, which, count)
    away = np.hypot(*position[:, 1:].T)
    edge = np.array([_quantile_80(a) for a in np.split(away, np.cumsum(count)[:-1])])[owner]
    depth = np.clip(0.35 + 0.65 * away / np.maximum(edge, 1e-6), 0.0, 1.0)
    start_row = (np.cumsum(count) - count)[owner][:, None]
    near = np.concatenate([_padded_neighbours(one.neighbours) for one in ones])
    crowding = _neighbour_occlusion(position, radius, np.where(near >= 0, near + start_row, -1))
    names = label(Organ.BUNCH, 0) + which
    on_berry = piece_at(position, owner)

    def common(piece: np.ndarray, owner: np.ndarray) -> dict:
        return {
            "organ": int(Organ.BUNCH), "label": names[owner], "group": group[owner], "bunch": which[owner],
            "carrier": on[piece],
        }  # fmt: skip

    fruit = make_batch(
        SPHEROID,
        stack_columns(placed(position, on_berry, owner), radius),
        b=stack_columns(turned(axis, on_berry), elongation),
        c=stack_columns(speck, depth, 0.0, 0.0),
        d=stack_columns(turned(crowding[:, :3], on_berry), crowding[:, 3]),
        material=int(materials.BERRY),
        tint=colour,
        **common(on_berry, owner),
    )
    lines = [one.rachis for one in ones]
    start, end = (np.concatenate([r[:, k : k - 1 or None].reshape(-1, 3) for r in lines]) for k in (0, 1))
    taper = np.concatenate([np.tile(np.linspace(0.0028, 0.0013, r.shape[1] - 1), len(r)) for r in lines])
    line_owner = np.repeat(np.arange(len(ones)), [len(r) * (r.shape[1] - 1) for r in lines])
    middle = piece_at(0.5 * (start + end), line_owner)
    rachis = make_batch(
        CONE,
        stack_columns(placed(start, middle, line_owner), taper),
        b=stack_columns(placed(end, middle, line_owner), 0.9 * taper),
        material=int(materials.STEM),
        tint=_STEM,
        **common(middle, line_owner),
    )
    berry_end = position - axis * (radius * elongation * 0.95)[:, None]
    loose = np.linalg.norm(berry_end - foot, axis=1) > 0.002
    loose_piece, loose_owner = on_berry[loose], owner[loose]
    pedicel = make_batch(
        CONE,
        stack_columns(placed(foot[loose], loose_piece, loose_owner), 0.0010),
        b=stack_columns(placed(berry_end[loose], loose_piece, loose_owner), 0.0014),
        material=int(materials.STEM),
        tint=_STEM,
        **common(loose_piece, loose_owner),
    )
    return [b for b in (fruit, rachis, pedicel) if len(b)]


def _apply_ripeness(
    colour: np.ndarray, radius: np.ndarray, ripeness: Ripeness, which: np.ndarray, count: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Colours and radii of berries that are not all ripe: each on its way from green, and some that never set out."""
    owner = np.repeat(np.arange(len(which)), count)
    draws = zip(which, count, strict=True)
    draw = np.concatenate([np.random.default_rng([ripeness.seed, 4, int(b)]).uniform(size=(n, 2)) for b, n in draws])
    mean = ripeness.bunch[which][owner]
    own = mean + _RIPENESS_SPREAD * np.sqrt(12.0) * (draw[:, 0] - 0.5) * np.minimum(4.0 * (1.0 - mean), 1.0)
    shot = draw[:, 1] < _SHOT_BERRY_SHARE * (1.0 - mean)
    own = np.where(shot, 0.0, np.clip(own, 0.0, 1.0))
    share = (own * own * (3.0 - 2.0 * own))[:, None]
    size = np.where(shot, _UNRIPE["shot"], 0.9 + 0.1 * own)
    return _UNRIPE["green"] * (1.0 - share) + colour * share, radius * size


def _quantile_80(away: np.ndarray) -> float:
    """The 80 % quantile, without the ceremony of np.quantile."""
    at = 0.8 * (len(away) - 1)
    low = int(at)
    ends = np.partition(away, [low, min(low + 1, len(away) - 1)])
    return float(ends[low] + (at - low) * (ends[min(low + 1, len(away) - 1)] - ends[low]))


def _padded_neighbours(neighbours: np.ndarray) -> np.ndarray:
    """Eight neighbours of each berry [n, 8], -1 where there are fewer."""
    missing = 8 - neighbours.shape[1]
    return np.pad(neighbours, ((0, 0), (0, missing)), constant_values=-1) if missing else neighbours


def _neighbour_occlusion(position: np.ndarray, radius: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Light that the nearest neighbours take from each berry: share(n) = w + v . n as (v, w) [n, 4].

    A touching sphere of equal size takes (1/4 + 0.85 cos) r^2 / l^2 as seen from the berry's surface.
    """
    there = neighbours >= 0
    apart = position[np.maximum(neighbours, 0)] - position[:, None]
    distance = np.linalg.norm(apart, axis=2)
    direction = apart / np.maximum(distance, 1e-9)[..., None]
    gap = np.maximum(distance - 0.55 * radius[:, None], 0.3 * radius[:, None])
    weight = np.where(there, np.minimum(radius[np.maximum(neighbours, 0)] ** 2 / gap**2, 1.0), 0.0)
    return np.concatenate([0.42 * (weight[..., None] * direction).sum(1), 0.07 * weight.sum(1, keepdims=True)], 1)
