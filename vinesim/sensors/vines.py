"""Vines as primitives: canes and peduncles, leaves, and bunches berry by berry."""

from __future__ import annotations

import numpy as np

from vinesim import frames
from vinesim.kernels import materials
from vinesim.sensors import textures
from vinesim.sensors.batches import CONE, LEAF, SPHEROID, Batch, batch, columns
from vinesim.world import leaves
from vinesim.world.berries import VARIETIES, berries, piece_of
from vinesim.world.ids import Organ, label
from vinesim.world.model import Model

_BROWN = (0.30, 0.17, 0.08)
_STEM = (0.19, 0.22, 0.075)


def pieces_of(model: Model, bunch: int) -> np.ndarray:
    """Bodies that carry one bunch's berries [piece]: its own, then its clusters."""
    first, count = int(model.bunch_cluster[bunch]), int(model.bunch_clusters[bunch])
    return np.append(model.bunch_body[bunch], np.arange(first, first + count))


def canes(model: Model, still: int) -> Batch:
    """One round cone for each piece of cane and peduncle."""
    bodies = np.flatnonzero((model.body_organ != int(Organ.BUNCH)) & (model.body_length > 0.0))
    rng = np.random.default_rng(5)
    seed = rng.uniform(size=len(model.tree_first))
    organ, tree = model.body_organ[bodies], model.body_tree[bodies]
    index = tree.copy()
    bunch_of = model.bunch_of()[bodies]
    index = np.where(bunch_of >= 0, bunch_of, index)
    # shoots ripen from the base: green towards the tip, brown where the wood is thick
    green = np.clip(1.6 - model.body_radius[bodies].mean(1) / 0.0022, 0.0, 1.0) * (seed[tree] < 0.6)
    green = np.where(organ == int(Organ.PEDUNCLE), 1.0, green)[:, None]
    tint = (1.0 - green) * np.array(_BROWN) * (0.7 + 0.6 * seed[tree, None]) + green * np.array(_STEM)
    material = np.where(green[:, 0] > 0.5, int(materials.STEM), int(materials.CANE))
    length = model.body_length[bodies]
    zero = np.zeros(len(bodies))
    return batch(
        CONE,
        columns(zero, zero, zero, model.body_radius[bodies, 0]),
        b=columns(length, zero, zero, model.body_radius[bodies, 1]),
        c=columns(zero, seed[tree] * 7.0, zero, zero),
        material=material,
        tint=tint,
        organ=organ,
        label=organ * label(Organ(1), 0) + index,
        carrier=bodies,
        group=tree,
    )


def foliage(model: Model) -> list[Batch]:
    """Blades, their petioles, and the nodes from which they grow."""
    count = len(model.leaf_body)
    if not count:
        return []
    rng = np.random.default_rng(11)
    shape = leaves.shape_of(np.arange(count))
    q = model.leaf_pose[:, 3:]
    rib, up = (frames.rotate(q, np.broadcast_to(np.eye(3)[k], (count, 3))) for k in (0, 2))
    base, petiole_end, size = model.leaf_base, model.leaf_pose[:, :3], model.leaf_size * textures.leaf_scale(shape)
    young = rng.uniform(size=(count, 1))
    tint = np.array([0.042, 0.115, 0.016]) * (0.75 + 0.6 * young) * (1.0 + 0.10 * rng.normal(size=(count, 1)))
    tint = tint + np.array([0.030, 0.035, 0.0]) * np.clip(0.7 * rng.normal(size=(count, 1)), 0.0, 2.0)
    bend = np.stack([rng.normal(-0.10, 0.16, count), rng.normal(-0.16, 0.14, count), rng.uniform(0.0, 0.45, count)], 1)
    body, tree = model.leaf_body, model.body_tree[model.leaf_body]
    names = label(Organ.LEAF, 0) + tree
    blade = batch(
        LEAF,
        columns(petiole_end, size),
        b=columns(rib, shape),
        c=columns(up, rng.uniform(size=count)),
        d=columns(bend, model.leaf_age),
        material=int(materials.FOLIAGE),
        tint=tint,
        organ=int(Organ.LEAF),
        label=names,
        carrier=body,
        group=tree,
    )
    petiole = batch(
        CONE,
        columns(base, 0.0017),
        b=columns(petiole_end, 0.0012),
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
    node = batch(
        CONE,
        columns(axis - 0.7 * reach, 1.25 * r),
        b=columns(axis + 0.4 * reach, 1.45 * r),
        material=int(materials.CANE),
        tint=(0.24, 0.15, 0.07),
        organ=int(Organ.CANE),
        label=label(Organ.CANE, 0) + tree,
        carrier=body,
        group=tree,
    )
    return [blade, petiole, node]


def bunch_parts(model: Model, bunch: int, place: np.ndarray, carrier: np.ndarray, group: int) -> list[Batch]:
    """Berries and rachis of one bunch, each in its piece: head, first cluster, ... of poses ``place`` [piece, 7] on
    ``carrier`` [piece]. A bunch without clusters is one piece.
    """
    number = int(model.bunch_variety[bunch])
    variety = VARIETIES[number]
    one = berries(
        float(model.bunch_length[bunch]),
        float(model.bunch_radius[bunch]),
        int(model.bunch_berries[bunch]),
        number,
        int(model.bunch_seed[bunch]),
    )
    rng = np.random.default_rng(int(model.bunch_seed[bunch]))
    n = len(one.radius)
    colour = np.array(variety.colour) * (1.0 + 0.10 * rng.normal(size=(n, 1)))
    colour = colour + np.array([0.055, 0.014, 0.010]) * (colour[:, :1] > 2.0 * colour[:, 1:2]) * np.clip(
        0.5 * rng.normal(size=(n, 1)), 0.0, 1.0
    )
    pieces = len(carrier)
    length = float(model.bunch_length[bunch]) / pieces
    on_berry = piece_of(one.position, float(model.bunch_length[bunch]), pieces)

    def placed(points: np.ndarray, piece: np.ndarray) -> np.ndarray:
        """Points [k, 3] of the bunch's frame, as drawn, on their carriers."""
        along = (length * piece)[:, None] * np.array([1.0, 0.0, 0.0])
        return place[piece, :3] + frames.rotate(place[piece, 3:], points - along)

    away = np.hypot(*one.position[:, 1:].T)
    depth = np.clip(0.35 + 0.65 * away / max(np.quantile(away, 0.8), 1e-6), 0.0, 1.0)
    name = label(Organ.BUNCH, bunch)
    common = {"organ": int(Organ.BUNCH), "label": name, "group": group, "bunch": bunch}
    turn = place[on_berry, 3:]
    crowding = _crowding(one.position, one.radius, one.neighbours)
    fruit = batch(
        SPHEROID,
        columns(placed(one.position, on_berry), one.radius),
        b=columns(frames.rotate(turn, one.axis), variety.elongation),
        c=columns(rng.uniform(size=n), depth, 0.0, 0.0),
        d=columns(frames.rotate(turn, crowding[:, :3]), crowding[:, 3]),
        material=int(materials.BERRY),
        tint=colour,
        carrier=carrier[on_berry],
        **common,
    )
    start, end = one.rachis[:, :-1].reshape(-1, 3), one.rachis[:, 1:].reshape(-1, 3)
    steps = one.rachis.shape[1] - 1
    taper = np.tile(np.linspace(0.0028, 0.0013, steps), len(one.rachis))
    middle = piece_of(0.5 * (start + end), float(model.bunch_length[bunch]), pieces)
    rachis = batch(
        CONE,
        columns(placed(start, middle), taper),
        b=columns(placed(end, middle), 0.9 * taper),
        material=int(materials.STEM),
        tint=_STEM,
        carrier=carrier[middle],
        **common,
    )
    berry_end = one.position - one.axis * (one.radius * variety.elongation * 0.95)[:, None]
    loose = np.linalg.norm(berry_end - one.foot, axis=1) > 0.002
    pedicel = batch(
        CONE,
        columns(placed(one.foot, on_berry), 0.0010)[loose],
        b=columns(placed(berry_end, on_berry), 0.0014)[loose],
        material=int(materials.STEM),
        tint=_STEM,
        carrier=carrier[on_berry][loose],
        **common,
    )
    return [b for b in (fruit, rachis, pedicel) if len(b)]


def _crowding(position: np.ndarray, radius: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
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
