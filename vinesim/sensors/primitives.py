"""Everything a camera or lidar can see, as one structure of analytic primitives that ride on bodies and links.

:class:`Primitives` is built once from a :class:`~vinesim.world.model.Model` and follows the world through
:meth:`Primitives.update`: one Warp launch moves the clusters of the trees and links that moved, and nothing else.
"""

from __future__ import annotations

import dataclasses
import logging
import pathlib

import numpy as np
import warp as wp

from vinesim import frames
from vinesim.kernels import shade, shapes
from vinesim.sensors import textures
from vinesim.world import leaves
from vinesim.world.berries import VARIETIES, berries, piece_of
from vinesim.world.ids import Organ, label
from vinesim.world.model import Model
from vinesim.world.state import State
from vinesim.world.values import Link, Shape, View

log = logging.getLogger(__name__)

CONE, SPHEROID, LEAF, BOX, ELLIPSOID, CYLINDER, TRIANGLE = (
    int(k)
    for k in (
        shapes.CONE,
        shapes.SPHEROID,
        shapes.LEAF,
        shapes.BOX,
        shapes.ELLIPSOID,
        shapes.CYLINDER,
        shapes.TRIANGLE,
    )
)
KINDS = {
    "cone": CONE,
    "spheroid": SPHEROID,
    "leaf": LEAF,
    "box": BOX,
    "ellipsoid": ELLIPSOID,
    "cylinder": CYLINDER,
    "triangle": TRIANGLE,
}

_CLUSTER = 24
"""Most primitives of one cluster."""
_CELL = 2.5
"""Side of the squares in which things that stand still are clustered [m]."""
_PIECE = 0.5
"""Longest piece of a post or wire [m]."""
_MESH_FACES = 4000
"""Most triangles of one mesh; finer ones are simplified."""

_STEM = (0.19, 0.22, 0.075)
_WOOD = {
    Organ.POLE: (int(shade.POST), (0.36, 0.33, 0.29)),
    Organ.WIRE: (int(shade.WIRE), (0.33, 0.34, 0.35)),
    Organ.TRUNK: (int(shade.BARK), (0.20, 0.15, 0.10)),
    Organ.ARM: (int(shade.BARK), (0.20, 0.14, 0.09)),
    Organ.CANE: (int(shade.CANE), (0.30, 0.17, 0.08)),
    Organ.PEDUNCLE: (int(shade.STEM), _STEM),
}
_RIGID = {Organ.BOX: int(shade.PLASTIC), Organ.HUMAN: int(shade.CLOTH)}


@dataclasses.dataclass
class _Batch:
    """Primitives of one kind in the frames of their carriers; ``group`` never mixes in one cluster."""

    kind: int
    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    material: np.ndarray
    tint: np.ndarray
    organ: np.ndarray
    label: np.ndarray
    carrier: np.ndarray
    group: np.ndarray
    bunch: int = -1

    def __len__(self) -> int:
        return len(self.a)


def _batch(kind: int, a, *, b=0.0, c=0.0, d=0.0, material, tint, organ, label, carrier, group, bunch=-1) -> _Batch:
    """A batch with scalars and rows broadcast to the count of ``a`` [n, 4]."""
    a = np.atleast_2d(np.asarray(a, np.float32))
    n = len(a)
    wide = [np.broadcast_to(np.asarray(v, np.float32), (n, 4)) for v in (b, c, d)]
    flat = [np.broadcast_to(np.asarray(v, np.int32), n) for v in (organ, label, carrier, group)]
    tint = np.broadcast_to(np.clip(np.asarray(tint, np.float32), 0.004, 1.0), (n, 3))
    return _Batch(kind, a, *wide, np.broadcast_to(np.asarray(material, np.int32), n), tint, *flat, bunch)


def _columns(*parts) -> np.ndarray:
    """Vectors [n, k] and scalars, one or [n], side by side."""
    columns = [np.asarray(p, float).reshape(-1, 1) if np.ndim(p) < 2 else np.asarray(p, float) for p in parts]
    n = max(len(c) for c in columns)
    return np.concatenate([np.broadcast_to(c, (n, c.shape[1])) for c in columns], 1)


# ---- plants ----------------------------------------------------------------------------------------------------------


def _canes(model: Model, still: int) -> _Batch:
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
    tint = (1.0 - green) * np.array(_WOOD[Organ.CANE][1]) * (0.7 + 0.6 * seed[tree, None]) + green * np.array(_STEM)
    material = np.where(green[:, 0] > 0.5, int(shade.STEM), int(shade.CANE))
    length = model.body_length[bodies]
    zero = np.zeros(len(bodies))
    return _batch(
        CONE,
        _columns(zero, zero, zero, model.body_radius[bodies, 0]),
        b=_columns(length, zero, zero, model.body_radius[bodies, 1]),
        c=_columns(zero, seed[tree] * 7.0, zero, zero),
        material=material,
        tint=tint,
        organ=organ,
        label=organ * label(Organ(1), 0) + index,
        carrier=bodies,
        group=tree,
    )


def _foliage(model: Model) -> list[_Batch]:
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
    blade = _batch(
        LEAF,
        _columns(petiole_end, size),
        b=_columns(rib, shape),
        c=_columns(up, rng.uniform(size=count)),
        d=_columns(bend, model.leaf_age),
        material=int(shade.FOLIAGE),
        tint=tint,
        organ=int(Organ.LEAF),
        label=names,
        carrier=body,
        group=tree,
    )
    petiole = _batch(
        CONE,
        _columns(base, 0.0017),
        b=_columns(petiole_end, 0.0012),
        material=int(shade.STEM),
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
    node = _batch(
        CONE,
        _columns(axis - 0.7 * reach, 1.25 * r),
        b=_columns(axis + 0.4 * reach, 1.45 * r),
        material=int(shade.CANE),
        tint=(0.24, 0.15, 0.07),
        organ=int(Organ.CANE),
        label=label(Organ.CANE, 0) + tree,
        carrier=body,
        group=tree,
    )
    return [blade, petiole, node]


def _bunch(model: Model, bunch: int, place: np.ndarray, carrier: np.ndarray, group: int) -> list[_Batch]:
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
    colour = colour + np.array([0.10, 0.05, 0.01]) * (colour[:, :1] > 2.0 * colour[:, 1:2]) * np.clip(
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
    fruit = _batch(
        SPHEROID,
        _columns(placed(one.position, on_berry), one.radius),
        b=_columns(frames.rotate(turn, one.axis), variety.elongation),
        c=_columns(rng.uniform(size=n), depth, 0.0, 0.0),
        d=_columns(frames.rotate(turn, crowding[:, :3]), crowding[:, 3]),
        material=int(shade.BERRY),
        tint=colour,
        carrier=carrier[on_berry],
        **common,
    )
    start, end = one.rachis[:, :-1].reshape(-1, 3), one.rachis[:, 1:].reshape(-1, 3)
    steps = one.rachis.shape[1] - 1
    taper = np.tile(np.linspace(0.0028, 0.0013, steps), len(one.rachis))
    middle = piece_of(0.5 * (start + end), float(model.bunch_length[bunch]), pieces)
    rachis = _batch(
        CONE,
        _columns(placed(start, middle), taper),
        b=_columns(placed(end, middle), 0.9 * taper),
        material=int(shade.STEM),
        tint=_STEM,
        carrier=carrier[middle],
        **common,
    )
    berry_end = one.position - one.axis * (one.radius * variety.elongation * 0.95)[:, None]
    loose = np.linalg.norm(berry_end - one.foot, axis=1) > 0.002
    pedicel = _batch(
        CONE,
        _columns(placed(one.foot, on_berry), 0.0010)[loose],
        b=_columns(placed(berry_end, on_berry), 0.0014)[loose],
        material=int(shade.STEM),
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


# ---- what stands still -----------------------------------------------------------------------------------------------


def _cell_of(position: np.ndarray, first: int) -> np.ndarray:
    """A group number for each square of the ground [n]."""
    cell = np.floor(position[:, :2] / _CELL).astype(np.int64)
    cell -= cell.min(0, initial=0)
    return (first + cell[:, 1] * (cell[:, 0].max(initial=0) + 1) + cell[:, 0]).astype(np.int32)


def _fixed(model: Model, still: int) -> _Batch | None:
    if not len(model.fixed_organ):
        return None
    # long wires in pieces: a box around a whole one holds half of the vineyard
    length = np.linalg.norm(model.fixed_end - model.fixed_start, axis=1)
    pieces = np.maximum(np.ceil(length / _PIECE), 1).astype(int)
    whole = np.repeat(np.arange(len(pieces)), pieces)
    share = np.arange(len(whole)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    ends = [(share + k)[:, None] / pieces[whole][:, None] for k in (0, 1)]
    start, end = (model.fixed_start[whole] * (1.0 - s) + model.fixed_end[whole] * s for s in ends)
    thick, thin = (model.fixed_radius[whole, :1] * (1.0 - s) + model.fixed_radius[whole, 1:] * s for s in ends)
    organ, index = model.fixed_organ[whole], model.fixed_index[whole]
    table = {o: _WOOD[Organ(int(o))] for o in np.unique(organ)}
    material, tint = (np.array([table[o][k] for o in organ]) for k in (0, 1))
    rng = np.random.default_rng(3)
    seed = rng.uniform(size=int(index.max()) + 1)[index] * 7.0
    # bark runs through from piece to piece: distances count from the foot of a post, along a wire
    along = np.where(
        np.abs(end - start)[:, 2] > 0.5 * np.linalg.norm(end - start, axis=1),
        start[:, 2],
        length[whole] * ends[0][:, 0],
    )
    return _batch(
        CONE,
        _columns(start, thick),
        b=_columns(end, thin),
        c=_columns(along, seed, 0.0, 0.0),
        material=material,
        tint=tint,
        organ=organ,
        label=organ * label(Organ(1), 0) + index,
        carrier=still,
        group=_cell_of((start + end) * 0.5, 0),
    )


def _meadow(low: np.ndarray, high: np.ndarray, density: float, still: int) -> _Batch | None:
    """Tufts of grass and herbs where the ground is green; they carry the ground's label."""
    low, high = low - 3.0, high + 3.0
    count = int(min(density * np.prod(high - low), 60_000))
    if count == 0:
        return None
    rng = np.random.default_rng(23)
    spot = low + (high - low) * rng.uniform(size=(count, 2))
    noise = textures.sample(spot[:, 0] * 0.21, spot[:, 1] * 0.21)
    green = noise[:, 0] * 0.55 + 0.2 * noise[:, 2] + 0.125  # as the ground is coloured
    spot = spot[green > 0.44 + 0.20 * rng.uniform(size=count)]
    n = len(spot)
    herb = rng.uniform(size=n) < 0.12
    size = np.where(herb, rng.uniform(0.03, 0.06, n), 0.05 + 0.13 * rng.uniform(size=n) ** 1.5)
    yaw = rng.uniform(0.0, 2.0 * np.pi, n)
    lean = np.where(herb, rng.uniform(0.5, 1.1, n), rng.normal(0.0, 0.2, n))
    out = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(n)], 1)
    rib = np.sin(lean)[:, None] * out + np.cos(lean)[:, None] * np.array([0.0, 0.0, 1.0])
    up = np.cos(lean)[:, None] * out - np.sin(lean)[:, None] * np.array([0.0, 0.0, 1.0])
    root = _columns(spot, np.zeros(n)) + 0.74 * size[:, None] * rib
    tint = np.array([0.075, 0.12, 0.022]) * rng.uniform(0.6, 1.35, (n, 1))
    tint = tint + np.array([0.10, 0.07, 0.02]) * (rng.uniform(size=(n, 1)) < 0.3) * rng.uniform(size=(n, 1))
    bend = _columns(rng.normal(0.0, 0.3, n), np.zeros(n), np.zeros(n), np.zeros(n))
    return _batch(
        LEAF,
        _columns(root, size),
        b=_columns(rib, np.where(herb, textures.HERB, textures.GRASS)),
        c=_columns(up, rng.uniform(size=n)),
        d=bend,
        material=int(shade.GRASS),
        tint=tint,
        organ=int(Organ.GROUND),
        label=label(Organ.GROUND, 0),
        carrier=still,
        group=_cell_of(spot, 0),
    )


def _nothing(still: int) -> _Batch:
    """A stand-in for a world without plants, far below the ground: no array is ever empty."""
    return _batch(
        CONE,
        [[0.0, 0.0, float(shapes.HIDDEN), 1e-6]],
        b=[[1e-3, 0.0, float(shapes.HIDDEN), 1e-6]],
        material=0,
        tint=0.0,
        organ=0,
        label=0,
        carrier=still,
        group=0,
    )


# ---- robots, boxes, people -------------------------------------------------------------------------------------------


def _pieces(model: Model, bunch: int) -> np.ndarray:
    """Bodies that carry one bunch's berries [piece]: its own, then its clusters."""
    first, count = int(model.bunch_cluster[bunch]), int(model.bunch_clusters[bunch])
    return np.append(model.bunch_body[bunch], np.arange(first, first + count))


def _rigid(
    model: Model, links: tuple[Link, ...], first: int, groups: int, shape: dict[int, np.ndarray]
) -> list[_Batch]:
    """Shapes of all links; carriers and groups count on from the given numbers.

    ``shape`` has the poses [piece, 7] of each picked bunch's pieces in its frame.
    """
    batches: list[_Batch] = []
    for k, link in enumerate(links):
        if link.organ == Organ.BUNCH:  # a picked bunch that has become a rigid body
            place = shape[link.index]
            mine = _bunch(model, link.index, place, np.full(len(place), first + k), groups + k)
            batches += [dataclasses.replace(b, bunch=-1) for b in mine]
            continue
        material = _RIGID.get(link.organ, int(shade.PAINT))
        name = label(link.organ, link.index)
        for piece in link.shapes:
            common = {
                "material": material,
                "tint": np.asarray(piece.rgba[:3]) ** 2.2,
                "organ": int(link.organ),
                "label": name,
                "carrier": first + k,
                "group": groups + k,
            }
            batches.append(_rigid_shape(piece, common))
    return batches


def _rigid_shape(shape: Shape, common: dict) -> _Batch:
    """One primitive, or the triangles of a mesh, in the frame of its link."""
    size, pose = shape.size, np.asarray(shape.pose, float)
    centre, turn = pose[:3], pose[3:]
    if shape.kind in ("capsule", "cylinder"):
        half = frames.rotate(turn, np.array([0.0, 0.0, size[1]]))
        kind = CONE if shape.kind == "capsule" else CYLINDER
        return _batch(kind, [[*(centre - half), size[0]]], b=[[*(centre + half), size[0]]], **common)
    if shape.kind == "sphere":
        return _batch(ELLIPSOID, [[*centre, size[0]]], b=[turn], c=[[size[0], size[0], 0, 0]], **common)
    if shape.kind in ("ellipsoid", "box"):
        kind = ELLIPSOID if shape.kind == "ellipsoid" else BOX
        return _batch(kind, [[*centre, size[0]]], b=[turn], c=[[size[1], size[2], 0, 0]], **common)
    if shape.kind == "mesh":
        corners = _triangles(shape.file, tuple(size) if len(size) == 3 else (size[0],) * 3)
        corners = centre + frames.rotate(turn, corners)
        a, b, c = (np.concatenate([corners[:, k], np.zeros((len(corners), 1))], 1) for k in range(3))
        return _batch(TRIANGLE, a, b=b, c=c, **common)
    raise ValueError(
        f"shape kind {shape.kind!r} of a link is unknown; use capsule, sphere, ellipsoid, box, cylinder or mesh"
    )


_meshes: dict[tuple[str, tuple[float, ...]], np.ndarray] = {}


def _triangles(file: str, scale: tuple[float, ...]) -> np.ndarray:
    """Corners [face, 3, 3] m of a mesh file, simplified by merging near vertices until it has few enough faces."""
    key = (file, scale)
    if key not in _meshes:
        import trimesh

        if not pathlib.Path(file).is_file():
            raise ValueError(f"mesh file {file!r} of a link does not exist; give an absolute path")
        mesh = trimesh.load(file, force="mesh", process=True)
        vertices, faces = np.asarray(mesh.vertices) * scale, np.asarray(mesh.faces)
        if np.prod(scale) < 0.0:
            faces = faces[:, ::-1]
        extent = float(np.ptp(vertices, axis=0).max(initial=1e-6))
        cells = 256
        while len(faces) > _MESH_FACES and cells > 8:
            spot = np.floor(vertices / extent * cells).astype(np.int64)
            _, member = np.unique(spot, axis=0, return_inverse=True)
            member = member.reshape(-1)
            count = np.bincount(member)
            merged = np.stack([np.bincount(member, vertices[:, k]) / count for k in range(3)], 1)
            linked = member[faces]
            whole = (linked[:, 0] != linked[:, 1]) & (linked[:, 1] != linked[:, 2]) & (linked[:, 0] != linked[:, 2])
            vertices, faces, cells = merged, linked[whole], int(cells * 0.75)
        _meshes[key] = vertices[faces].astype(np.float32)
    return _meshes[key]


# ---- all of it -------------------------------------------------------------------------------------------------------


class Primitives:
    """All primitives of a vineyard and its actors, posed in the world (see :mod:`vinesim.kernels.shapes`)."""

    def __init__(self, model: Model, *, grass: float = 14.0, device: str = "cpu") -> None:
        """``grass``: tufts per square metre around the vines, 0 for bare ground."""
        self.model, self.device = model, device
        bodies = len(model.body_mass)
        self._still = bodies
        """Carrier of what stands still; links follow it."""
        spots = np.concatenate([model.tree_pose[:, :2], model.fixed_start[:, :2], model.fixed_end[:, :2]])
        low, high = (spots.min(0), spots.max(0)) if len(spots) else (np.zeros(2), np.zeros(2))
        trees = len(model.tree_first)
        batches = [_canes(model, bodies), *_foliage(model)]
        for bunch, body in enumerate(model.bunch_body):
            pieces = _pieces(model, bunch)
            own = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(pieces), 1))
            batches += _bunch(model, bunch, own, pieces, int(model.body_tree[body]))
        self._tree_batches = len(batches)
        batches += [b for b in (_fixed(model, bodies), _meadow(low, high, grass, bodies)) if b is not None]
        self._plants = [b for b in batches if len(b)] or [_nothing(bodies)]
        self._groups = trees
        self._links: tuple[Link, ...] = ()
        self._attached = np.ones(len(model.bunch_body), bool)
        self._picked: dict[int, np.ndarray] = {}
        self._moved = np.zeros(0, np.int64)
        outline, hull = textures.outlines()
        self._outline, self._hull = wp.array(outline, device=device), wp.array(hull, dtype=wp.vec2, device=device)
        self._rest = self._body_q = State.at_rest(model).body_q
        self.version = 0
        """Counts changes of any pose."""
        self.built = 0
        """Counts changes of the set of primitives."""
        self._poses = np.zeros((0, 7), np.float32)
        self._build(())
        self._bake(low, high)
        self._pose(np.arange(len(self.cluster_first)))

    # -- reading

    @property
    def count(self) -> int:
        """How many primitives there are."""
        return len(self.label)

    def counts(self) -> dict[str, int]:
        """How many there are of each kind."""
        kinds = self.shapes.kind.numpy()
        return {name: int((kinds == kind).sum()) for name, kind in KINDS.items()}

    def shown(self) -> np.ndarray:
        """Whether each cluster is there at all [cluster]: what has been picked is not."""
        return self.ball.numpy()[:, 3] > 0.0

    def carriers(self, primitive: np.ndarray) -> np.ndarray:
        """Poses [..., 7] m, 1 of what carries some primitives [...]: a plant's body, a link, or the world."""
        return self._poses[self._carrier.numpy()[primitive]].astype(float)

    # -- building

    def _build(self, links: tuple[Link, ...]) -> None:
        """Lay all primitives out in clusters: plants, what stands still, then links."""
        rigid = _rigid(self.model, links, self._still + 1, 0, self._shapes_of_picked(links))
        batches = self._plants + rigid
        first_rigid = len(self._plants)
        pieces: dict[str, list[np.ndarray]] = {
            name: [] for name in ("a", "b", "c", "d", "material", "tint", "organ", "label", "carrier")
        }
        kinds, firsts, sizes, owners, bunches, rigids = [], [], [], [], [], []
        total = 0
        for number, batch in enumerate(batches):
            order = np.argsort(batch.group, kind="stable")
            group = batch.group[order]
            starts = np.flatnonzero(np.r_[True, group[1:] != group[:-1]])
            runs = np.diff(np.r_[starts, len(group)])
            parts = (runs + _CLUSTER - 1) // _CLUSTER
            inner = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
            first = np.repeat(starts, parts) + inner * _CLUSTER
            size = np.minimum(_CLUSTER, np.repeat(runs, parts) - inner * _CLUSTER)
            still = number < first_rigid and bool((batch.carrier == self._still).all())
            firsts.append(total + first)
            sizes.append(size)
            kinds.append(np.full(len(first), batch.kind))
            owners.append(np.full(len(first), -1) if still or number >= first_rigid else group[first])
            bunches.append(np.full(len(first), batch.bunch))
            rigids.append(np.full(len(first), number >= first_rigid))
            for name, pile in pieces.items():
                pile.append(getattr(batch, name)[order])
            total += len(batch)
        whole = {name: np.concatenate(pile) for name, pile in pieces.items()}
        if self.built:
            whole["c"][: len(self._baked_c)] = self._baked_c
        self.label, self.organ = whole["label"].astype(np.int32), whole["organ"].astype(np.int32)
        self.cluster_first, self.cluster_size, self.cluster_kind, self._owner, self._cluster_bunch = (
            np.concatenate(x).astype(np.int32) for x in (firsts, sizes, kinds, owners, bunches)
        )
        self.rigid_clusters = np.flatnonzero(np.concatenate(rigids))
        self.cluster_version = np.zeros(len(self.cluster_first), np.int64)
        """:attr:`version` at which each cluster moved last."""
        order = np.argsort(self._owner, kind="stable")
        self._by_owner = order
        self._owner_start = np.searchsorted(self._owner[order], np.arange(self._groups + 1))
        shown = (
            (self._cluster_bunch < 0) | self._attached[self._cluster_bunch]
            if len(self._attached)
            else np.ones(len(order), bool)
        )

        def array(values: np.ndarray, kind: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=kind, device=self.device)

        self._local, self.shapes, self.clusters, self.looks = (
            shapes.Shapes(),
            shapes.Shapes(),
            shapes.Clusters(),
            shade.Looks(),
        )
        primitive_kind = np.repeat(self.cluster_kind, self.cluster_size)
        for name in "abcd":
            setattr(self._local, name, array(whole[name], wp.vec4))
            setattr(self.shapes, name, wp.empty(total, dtype=wp.vec4, device=self.device))
        for table in (self._local, self.shapes):
            table.kind = array(primitive_kind, wp.int32)
            table.outline, table.hull = self._outline, self._hull
        self.clusters.first, self.clusters.size, self.clusters.kind, self.clusters.shown = (
            array(v.astype(np.int32), wp.int32)
            for v in (self.cluster_first, self.cluster_size, self.cluster_kind, shown)
        )
        self._carrier, self.labels = array(whole["carrier"].astype(np.int32), wp.int32), array(self.label, wp.int32)
        self.organs = array(self.organ, wp.int32)
        self.lower, self.upper = (wp.empty(total, dtype=wp.vec3, device=self.device) for _ in range(2))
        self.ball = wp.empty(len(self.cluster_first), dtype=wp.vec4, device=self.device)
        self.looks.material, self.looks.tint = (
            array(whole["material"].astype(np.int32), wp.int32),
            array(whole["tint"], wp.vec3),
        )
        sky = np.full(total, 0.7, np.float32)
        if self.built:
            known = self._sky[: min(len(self._sky), total)]
            sky[: len(known)] = known
            for name in ("blade", "noise", "soil", "ground_sky", "ground_x", "ground_y", "ground_cell"):
                setattr(self.looks, name, getattr(self._baked, name))
        self.looks.sky = array(sky, float)
        poses = np.zeros((self._still + 1 + len(links), 7), np.float32)
        poses[:, 6] = 1.0
        poses[: self._still] = self._poses[: self._still] if len(self._poses) else self._rest
        self._poses = poses
        self._pose_array = wp.array(poses, dtype=wp.transform, device=self.device)
        self._links = links
        self.plant_count = total - sum(len(b) for b in rigid)
        self.built += 1

    def _shapes_of_picked(self, links: tuple[Link, ...]) -> dict[int, np.ndarray]:
        """Poses [piece, 7] of the pieces of picked bunches in their frames: as they were when first seen loose."""
        picked = {}
        for bunch in (link.index for link in links if link.organ == Organ.BUNCH):
            q = np.asarray(self._body_q[_pieces(self.model, bunch)], float)
            picked[bunch] = self._picked.get(bunch, frames.compose(frames.inverse(q[0]), q))
        self._picked = picked
        return picked

    def _bake(self, low: np.ndarray, high: np.ndarray) -> None:
        """Share of the sky that every primitive and the ground see through the leaves, in the shape at rest."""
        self._pose(np.arange(len(self.cluster_first)))
        low, high = low - 3.0, high + 3.0
        cell = max(0.15, float((high - low).max()) / 600.0)
        size = np.maximum(((high - low) / cell).astype(int) + 1, 1)
        corner = np.array([low[0], low[1], 0.0])
        density = np.zeros((*size, int(3.0 / cell) + 1), np.float32)
        foliage = (self.organ == int(Organ.LEAF)) & (self.shapes.kind.numpy() == LEAF)
        posed = self.shapes.a.numpy()
        at = ((posed[foliage, :3] - corner) / cell).astype(int)
        inside = ((at >= 0) & (at < density.shape)).all(1)
        np.add.at(density, tuple(at[inside].T), 1.1 * posed[foliage, 3][inside] ** 2 / cell**3)
        grid = wp.array(density, dtype=float, device=self.device)

        def seen(points: np.ndarray) -> np.ndarray:
            out = wp.zeros(len(points), dtype=float, device=self.device)
            at = wp.array(np.ascontiguousarray(points, np.float32), dtype=wp.vec3, device=self.device)
            wp.launch(
                shade.see_sky,
                len(points),
                inputs=[grid, wp.vec3(*map(float, corner)), float(cell), at],
                outputs=[out],
                device=self.device,
            )
            return out.numpy()

        # light runs on from one piece of wood to the next: cones know the sky at their far end too
        wood = np.flatnonzero(self.shapes.kind.numpy() == CONE)
        wood_c = self._local.c.numpy()
        wood_c[wood, 2:] = np.stack([seen(self.shapes.b.numpy()[wood, :3]), np.ones(len(wood))], 1)
        self._local.c.assign(wood_c)
        self._baked_c = wood_c.copy()
        self._sky = seen(posed[:, :3]) if len(posed) else np.zeros(0, np.float32)
        self.looks.sky = wp.array(self._sky, dtype=float, device=self.device)
        step = max(0.2, float((high - low).max()) / 500.0)
        x, y = np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step))
        ground = seen(np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.05)], 1)).reshape(x.shape)
        looks = self.looks
        looks.ground_sky = wp.array(ground, dtype=float, device=self.device)
        looks.ground_x, looks.ground_y, looks.ground_cell = float(low[0]), float(low[1]), float(step)
        looks.blade, looks.noise, looks.soil = (
            wp.array(t, dtype=wp.vec4, device=self.device)
            for t in (textures.blades(), textures.noise(), textures.soil())
        )
        self._baked = looks

    # -- following the world

    def update(self, view: View, moved: np.ndarray | None = None) -> np.ndarray:
        """Take over the poses of ``view``; returns the clusters that moved.

        ``moved`` are the trees that may have moved since the last call (default: those of the view and of the view
        before). Whoever skips views must gather it from all of them.
        """
        if view.links is not self._links:
            self._body_q = view.body_q
            self._build(view.links)
            everything = True
        else:
            everything = False
        attached = np.asarray(view.bunch_attached, bool)
        changed = np.flatnonzero(attached != self._attached)
        if len(changed):
            self._attached = attached.copy()
            shown = self.clusters.shown.numpy()
            shown[:] = (self._cluster_bunch < 0) | self._attached[self._cluster_bunch]
            if self.device != "cpu":
                self.clusters.shown.assign(shown)
        trees = np.union1d(view.moved if moved is None else moved, self._moved).astype(np.int64)
        self._moved = np.asarray(view.moved, np.int64)
        if everything:
            dirty = np.arange(len(self.cluster_first))
        else:
            dirty = self._clusters_of(trees)
            if len(changed):
                dirty = np.union1d(dirty, np.flatnonzero(np.isin(self._cluster_bunch, changed)))
            link_q = np.asarray(view.link_q, np.float32).reshape(-1, 7)
            if len(self.rigid_clusters) and not np.array_equal(self._poses[self._still + 1 :], link_q):
                dirty = np.concatenate([dirty, self.rigid_clusters])
        if len(dirty):
            self._poses[: self._still] = view.body_q
            self._poses[self._still + 1 :] = np.asarray(view.link_q, np.float32).reshape(-1, 7)
            self._pose(dirty)
        return dirty

    def _clusters_of(self, trees: np.ndarray) -> np.ndarray:
        """Clusters that ride on the given trees, without a loop over trees."""
        start, size = self._owner_start[trees], self._owner_start[trees + 1] - self._owner_start[trees]
        inner = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
        return self._by_owner[np.repeat(start, size) + inner]

    def _pose(self, dirty: np.ndarray) -> None:
        self._pose_array.assign(self._poses)
        wp.launch(
            shapes.pose_clusters,
            len(dirty),
            inputs=[
                self._local,
                self.clusters,
                self._carrier,
                wp.array(dirty.astype(np.int32), device=self.device),
                self._pose_array,
            ],
            outputs=[self.shapes.a, self.shapes.b, self.shapes.c, self.shapes.d, self.lower, self.upper, self.ball],
            device=self.device,
        )
        self.version += 1
        self.cluster_version[dirty] = self.version


def still_view(model: Model, links: tuple[Link, ...] = (), link_q: np.ndarray | None = None) -> View:
    """A view of the vineyard at rest, for pictures and tests without physics."""
    return View(
        time=0.0,
        tick=0,
        body_q=State.at_rest(model).body_q,
        bunch_attached=np.ones(len(model.bunch_body), bool),
        links=links,
        link_q=np.zeros((0, 7)) if link_q is None else np.asarray(link_q, float),
        moved=np.zeros(0, np.int64),
    )
