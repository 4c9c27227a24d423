"""Builds models of imported plants. Thick wood is fixed; every thinner part that grows on it is a tree of bodies."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from vinesim.core import frames
from vinesim.scene import berries, builder
from vinesim.scene.builder import RodMaterial, TreeBuilder
from vinesim.scene.ids import Organ
from vinesim.scene.leaves import BLADE_AREA, LATERAL_AREA, LeafNodes, add_point_masses, grow_leaves
from vinesim.scene.model import Model
from vinesim.scene.plant_import.imported_plant import ImportedPlant, Wood
from vinesim.scene.plant_parameters import Cane, Leaf, VineParameters
from vinesim.scene.spec import Scene

_SHORT = 0.3
"""Length of wood between two forks below which the wood is dropped and the forks are merged [piece lengths]."""
_PEDUNCLE_SEGMENTS = 2
_OFFSETS = {
    "tree_first": "body",
    "tree_piece": "fixed",
    "body_tree": "tree",
    "body_parent": "body",
    "bunch_body": "body",
    "bunch_cluster": "body",
    "tie_body": "body",
    "leaf_body": "body",
}
"""Fields of :class:`Model` that contain indices, each with the name of the axis into which it indexes. A negative index
means none.
"""


@dataclasses.dataclass(frozen=True, slots=True)
class _Points:
    """Ends of the rigid bodies of one plant, in the plant's frame; the first is the base."""

    position: np.ndarray
    parent: np.ndarray
    radius: np.ndarray
    bunch: np.ndarray
    way: np.ndarray
    """[node] m, length of the wood from the base."""


def build_model(
    plant: ImportedPlant,
    pose: np.ndarray,
    vine: int,
    parameters: VineParameters,
    variety: int,
    leaves: tuple[Scene, np.random.Generator] | None = None,
) -> Model:
    """Returns the model of a plant at a ``pose`` [7]: its trees, and the old wood on which they grow.

    ``parameters``: properties of its peduncles and bunches. ``variety``: variety of its bunches. ``leaves``: the scene,
    whose season and training determine the leaves, and a random generator; None for a plant without leaves.
    """
    points = _cut(plant)
    old = _old_wood(points, plant.wood)
    place = frames.pose(pose[:3] + frames.rotate(pose[3:], points.position))[:, :3]
    trees = []
    for root in np.flatnonzero((points.parent >= 0) & ~old & _on(old, points.parent)):
        trees.append(_tree(plant.wood, points, place, int(root), vine, parameters, variety, leaves))
    wood = np.flatnonzero(old & (points.parent >= 0))
    trunk = _main_axis(points, old)
    model = builder.assemble(
        trees,
        fixed_start=place[points.parent[wood]],
        fixed_end=place[wood],
        fixed_radius=np.stack([points.radius[points.parent[wood]], points.radius[wood]], -1),
        fixed_organ=np.where(trunk[wood], int(Organ.TRUNK), int(Organ.ARM)),
        fixed_index=np.where(trunk[wood], 0, np.cumsum(~trunk[wood])),
    )
    return builder.solve_rest_pose(model).check() if plant.shape == "drawn" and trees else model


def join_models(first: Model, second: Model) -> Model:
    """Join two models; trees, bodies and bunches of ``second`` are numbered after those of ``first``.

    The ties of ``second`` are bound to wires of ``first``.
    """
    counts = first.counts()
    joined = {}
    for name in Model.array_fields():
        a = getattr(first, name)
        b = getattr(second, name)
        if name in _OFFSETS:
            b = np.where(b >= 0, b + counts[_OFFSETS[name]], b).astype(b.dtype)
        elif name == "fixed_index":
            b = b.copy()
            for organ in np.unique(second.fixed_organ):
                here = first.fixed_organ == organ
                b[second.fixed_organ == organ] += 1 + int(a[here].max(initial=-1))
        joined[name] = np.concatenate([a, b])
    return Model(terrain=first.terrain, look=first.look, nodes=first.nodes, canes=first.canes, **joined).check()


def _on(old: np.ndarray, parent: np.ndarray) -> np.ndarray:
    """Returns whether each node grows on old wood or on the base [node] bool."""
    return old[parent] | (parent == 0)


def _old_wood(points: _Points, wood: Wood) -> np.ndarray:
    """Returns whether each node is fixed [node] bool: the wood of the node and all wood between it and the base are
    thick."""
    old = 2.0 * points.radius > wood.old_wood.value
    for node in range(1, len(old)):
        old[node] &= old[points.parent[node]]
    return old


def _main_axis(points: _Points, members: np.ndarray) -> np.ndarray:
    """Returns the nodes on the path to the node that is furthest from the base, among the connected nodes ``members``
    [node] bool."""
    on = np.zeros(len(members), bool)
    node = int(np.argmax(np.where(members, points.way, -1.0)))
    while node >= 0 and members[node]:
        on[node] = True
        node = int(points.parent[node])
    return on


def _cut(plant: ImportedPlant) -> _Points:
    """Returns the skeleton with nodes about one piece length apart. Wood between forks is cut evenly, very short wood
    is dropped."""
    skeleton = plant.skeleton()
    parent = skeleton.parent
    position = skeleton.position
    children = np.bincount(parent[1:], minlength=len(parent))
    fork = (children != 1) | (skeleton.bunch > 0.0)
    fork[0] = True
    new: dict[int, int] = {0: 0}
    rows = [(position[0], -1, 0.5 * skeleton.diameter[0], float(skeleton.bunch[0]))]
    for end in np.flatnonzero(fork)[1:]:
        run = [int(end)]
        while not fork[run[-1]] or len(run) == 1:
            run.append(int(parent[run[-1]]))
        run.reverse()
        path = position[run]
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
        below = new[run[0]]
        if along[-1] < _SHORT * plant.piece:
            new[int(end)] = below
            held = rows[below]
            rows[below] = (*held[:3], held[3] + float(skeleton.bunch[end]))
            continue
        for share in np.arange(1, (count := max(1, round(along[-1] / plant.piece))) + 1) / count:
            at = share * along[-1]
            point = np.array([np.interp(at, along, axis) for axis in path.T])
            # the first node belongs to the parent of the run, and has the parent's diameter
            known = np.interp(at, along[1:], 0.5 * skeleton.diameter[run[1:]])
            rows.append((point, below, float(known), 0.0))
            below = len(rows) - 1
        rows[below] = (*rows[below][:3], float(skeleton.bunch[end]))
        new[int(end)] = below
    position, parent, radius, bunch = (np.array(column) for column in zip(*rows, strict=True))
    way = np.zeros(len(parent))
    for node in range(1, len(way)):
        way[node] = way[parent[node]] + np.linalg.norm(position[node] - position[parent[node]])
    return _Points(position, parent, radius, bunch, way)


def _tree(
    wood: Wood,
    points: _Points,
    place: np.ndarray,
    root: int,
    vine: int,
    parameters: VineParameters,
    variety: int,
    leaves: tuple[Scene, np.random.Generator] | None,
) -> TreeBuilder:
    """Returns the tree that begins with the piece that ends at the node ``root``."""
    below = int(points.parent[root])
    turns = {below: frames.from_x_axis(place[root] - place[below])}
    tree = TreeBuilder(frames.pose(place[below], turns[below]), vine)
    inside = np.zeros(len(points.parent), bool)
    inside[root] = True
    for node in range(root + 1, len(inside)):
        inside[node] = points.parent[node] >= root and inside[points.parent[node]]
    main = _main_axis(points, inside)
    way = points.way
    longest = way[inside].max() - way[below]
    bodies = {below: -1}
    for node in np.flatnonzero(inside).tolist():
        before = int(points.parent[node])
        along = place[node] - place[before]
        turn = _turned(turns[before], along)
        share = (0.5 * (way[node] + way[before]) - way[below]) / longest
        green = np.clip((share - wood.woody_share.value) / 0.2 + 0.5, 0.0, 1.0) if main[node] else 1.0
        modulus = float(wood.woody_modulus.value ** (1.0 - green) * wood.green_modulus.value**green)
        # at its base a side shoot has the radius of the end of its first piece
        grown = main[before] == main[node] and before != below
        radius = (float(points.radius[before] if grown else points.radius[node]), float(points.radius[node]))
        turns[node] = turn
        bodies[node] = body = tree.add_rod(
            bodies[before],
            float(np.linalg.norm(along)),
            radius,
            RodMaterial(modulus, wood.density.value, wood.damping.value),
            1,
            rest=frames.multiply(frames.conjugate(turns[before]), turn),
        )[0]
        tree.bodies[body]["drag"] = wood.drag.value * sum(radius) * float(np.linalg.norm(along))
        if points.bunch[node] > 0.0:
            _hang(tree, body, turn, float(points.bunch[node]), parameters, variety)
    if leaves is not None:
        nodes = find_nodes(points.parent, points.radius, way, inside, parameters.cane)
        body = np.array([bodies[piece] for piece in nodes.piece.tolist()], int)
        turn = np.array([turns[piece] for piece in nodes.piece.tolist()], float).reshape(-1, 4)
        start = place[points.parent[nodes.piece]]
        end = place[nodes.piece]
        reach = np.linalg.norm(start + nodes.share[:, None] * (end - start) - place[below], axis=1)
        add_leaves(tree, nodes, body, turn, reach, leaves[0], parameters.leaf, leaves[1])
    return tree


def _turned(turn: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Returns the orientation [4] of a piece in the direction ``along`` [3]: the orientation ``turn`` of the previous
    piece, rotated by the smallest angle."""
    along = along / np.linalg.norm(along)
    x = frames.rotate(turn, np.array([1.0, 0.0, 0.0]))
    axis = np.cross(x, along)
    size = float(np.linalg.norm(axis))
    if size < 1e-9:
        return turn if x @ along > 0.0 else frames.from_x_axis(along)
    return frames.multiply(frames.exp(axis / size * math.atan2(size, x @ along)), turn)


def _hang(
    tree: TreeBuilder, body: int, turn: np.ndarray, mass: float, parameters: VineParameters, variety: int
) -> None:
    """Add a bunch below a piece of wood, on a peduncle of mean size."""
    stalk = parameters.peduncle
    thick = 0.5 * float(stalk.diameter.at(0.5))
    down = frames.multiply(frames.conjugate(turn), frames.from_x_axis(np.array([0.0, 0.0, -1.0])))
    material = RodMaterial(stalk.modulus.value, stalk.density.value, stalk.damping.value)
    last = tree.add_rod(
        body, float(stalk.length.at(0.5)), (thick, thick), material, _PEDUNCLE_SEGMENTS, organ=Organ.PEDUNCLE, rest=down
    )[-1]
    fruit = mass * (1.0 - parameters.bunch.stem_share.value) / berries.VARIETIES[variety].mass
    count = int(np.clip(round(fruit), 1, berries.most_berries(variety)))
    tree.add_bunch(
        last,
        mass,
        count=count,
        variety=variety,
        parameters=parameters,
        pull=float(stalk.pull.at(0.5)),
        bend=float(stalk.bend_strength.value * np.pi / 4.0 * thick**3),
    )


# Leaves on imported shoots: at nodes spaced as on a cane, alternately left and right.


@dataclasses.dataclass(frozen=True, slots=True)
class Nodes:
    """Nodes of the shoots of one tree."""

    piece: np.ndarray
    """[k] piece of wood that carries the leaf, named by the point at its end."""
    share: np.ndarray
    """[k] position of the node as a fraction of the piece's length."""
    axis_share: np.ndarray
    """[k] position of the node as a fraction of its axis' length."""
    rank: np.ndarray
    """[k] number of the node along its axis."""
    lateral: np.ndarray
    """[k] bool, whether the node is on a side shoot."""


def find_nodes(parent: np.ndarray, radius: np.ndarray, way: np.ndarray, members: np.ndarray, cane: Cane) -> Nodes:
    """Returns the nodes on the pieces ``members`` [point] bool that are as thin as a cane. Thicker wood is older and
    has no leaves.

    At a fork the longest branch continues the axis. The other branches are side shoots if their parent is thin.

    Args:
        parent: [point] index of the point below; parents come first.
        radius: [point] m, radius at the end of the piece.
        way: [point] m, length of the wood from the base.
        members: [point] bool, the pieces of one tree.
        cane: parameters of canes.
    """
    apart = sum(cane.length.value) / sum(cane.nodes.value)
    thin = members & (2.0 * radius <= cane.base_diameter.value[1])
    reach = way.copy()
    heir = np.full(len(parent), -1)
    for point in np.flatnonzero(members)[::-1]:
        below = parent[point]
        if heir[below] < 0 or reach[point] >= reach[heir[below]]:
            heir[below] = point
        reach[below] = max(reach[below], reach[point])
    rows = []
    for first in np.flatnonzero(thin):
        bearer = parent[first]
        if thin[bearer] and heir[bearer] == first:
            continue  # the piece continues an axis
        axis = [int(first)]
        while heir[axis[-1]] >= 0 and thin[heir[axis[-1]]]:
            axis.append(int(heir[axis[-1]]))
        ends = way[axis] - way[bearer]
        count = round(ends[-1] / apart)
        for rank in range(count):
            at = (rank + 0.7) / count
            k = int(np.searchsorted(ends, at * ends[-1]))
            begin = ends[k - 1] if k else 0.0
            rows.append((axis[k], (at * ends[-1] - begin) / (ends[k] - begin), at, rank, thin[bearer]))
    rows.sort()  # the model lists leaves in the order of their bodies
    piece, share, axis_share, rank, lateral = np.array(rows, float).reshape(-1, 5).T
    return Nodes(piece.astype(int), share, axis_share, rank.astype(int), lateral > 0.0)


def add_leaves(
    tree: TreeBuilder,
    nodes: Nodes,
    body: np.ndarray,
    turn: np.ndarray,
    reach: np.ndarray,
    scene: Scene,
    leaf: Leaf,
    rng: np.random.Generator,
) -> None:
    """Grow leaves of a scene's season at the nodes of a tree, with their mass and drag on its bodies.

    Args:
        tree: the tree, which has no leaves yet.
        nodes: nodes at which leaves grow.
        body: [k] body of each node's piece.
        turn: [k, 4] orientation of that body in the world.
        reach: [k] m, distance of each node from the base of the tree.
        scene: its season and training are used.
        leaf: parameters of leaves.
        rng: random numbers for the leaves of this tree.
    """
    count = len(nodes.piece)
    normal = rng.standard_normal((8, count))
    uniform = rng.random((4, count))
    if count == 0:
        return
    parts = tree.bodies
    length, thick = (np.array([parts[b][name] for b in body], float) for name in ("length", "radius"))
    # leaves stand across the axis and across the row in a hedge, level in a tendone; swapped where that is the axis
    level = np.array([0.0, 0.0, 1.0])
    row = np.array([1.0, 0.0, 0.0])
    up, other = (level, row) if scene.training == "tendone" else (row, level)
    is_along = np.abs(frames.rotate(turn, np.array([1.0, 0.0, 0.0])) @ up) > 0.9
    grown = grow_leaves(
        scene,
        leaf,
        LeafNodes(
            turn=turn,
            along=nodes.share * length,
            thick=thick[:, 0] + nodes.share * (thick[:, 1] - thick[:, 0]),
            share=nodes.axis_share,
            up=np.where(is_along[:, None], other, up),
            reach=reach,
            hand=np.where(nodes.rank % 2, 1.0, -1.0)[:, None],
            grown=np.where(nodes.lateral, LATERAL_AREA, 1.0),
        ),
        normal,
        uniform,
    )
    stays = grown["present"]
    body = body[stays]
    grown = {name: value[stays] for name, value in grown.items()}
    mass, com, inertia = (np.array([part[name] for part in parts], float) for name in ("mass", "com", "inertia"))
    heavy = add_point_masses(mass, com, inertia, (body,), grown["mass"], grown["pose"][:, :3])
    for b in np.unique(body).tolist():
        parts[b].update(zip(("mass", "com", "inertia"), (part[b] for part in heavy), strict=True))
        parts[b]["drag"] += float(grown["drag"][body == b].sum())
    size = np.sqrt(grown["area"] / BLADE_AREA)
    for i, b in enumerate(body.tolist()):
        tree.leaves.append(
            {
                "body": b,
                "base": grown["base"][i],
                "pose": grown["pose"][i],
                "age": grown["age"][i],
                "size": size[i],
                "mass": grown["mass"][i],
                "drag": grown["drag"][i],
            }
        )
