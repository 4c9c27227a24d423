"""Imported plants as wood: what is thick stands still, every thinner part that grows on it is a tree of bodies."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from vinesim.core import frames
from vinesim.scene import berries, builder
from vinesim.scene.builder import RodMaterial, TreeBuilder
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.plant_import.foliage import add_leaves, find_nodes
from vinesim.scene.plant_import.imported_plant import ImportedPlant, Wood
from vinesim.scene.plant_parameters import VineParameters
from vinesim.scene.spec import Scene

_SHORT = 0.3
"""[piece] Wood between two forks that is shorter than this becomes part of the fork."""
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
"""Fields of a model that count something, and what; negative ones mean none."""


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
    """The plant at a pose [7]: its trees, and the old wood that they stand on.

    ``parameters`` give peduncles and bunches, which are of ``variety``; bare unless ``leaves`` gives the scene whose
    season and training its leaves have, and their random numbers.
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
    """Both as one; trees, bodies and bunches of the second are numbered behind those of the first, to whose wires its
    ties are bound."""
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
    return Model(**joined).check()


def _on(old: np.ndarray, parent: np.ndarray) -> np.ndarray:
    """Nodes that grow on old wood, or on the base [node]."""
    return old[parent] | (parent == 0)


def _old_wood(points: _Points, wood: Wood) -> np.ndarray:
    """Nodes that stand still [node]: thick ones below which all is thick."""
    old = 2.0 * points.radius > wood.old_wood.value
    for node in range(1, len(old)):
        old[node] &= old[points.parent[node]]
    return old


def _main_axis(points: _Points, members: np.ndarray) -> np.ndarray:
    """Of nodes [node] bool that hang together, those on the way to the furthest one [node]."""
    on = np.zeros(len(members), bool)
    node = int(np.argmax(np.where(members, points.way, -1.0)))
    while node >= 0 and members[node]:
        on[node] = True
        node = int(points.parent[node])
    return on


def _cut(plant: ImportedPlant) -> _Points:
    """The skeleton with nodes about one piece apart: wood between forks is cut evenly, too short wood left out."""
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
            # the first node's diameter is that of what bears the run
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
    """The tree whose first piece ends at ``root``."""
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
        # a side shoot is as thick at its base as where its first piece ends
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
        add_leaves(tree, nodes, body, turn, leaves[0], parameters.leaf, leaves[1])
    return tree


def _turned(turn: np.ndarray, along: np.ndarray) -> np.ndarray:
    """The orientation [4] of a piece along a direction: that of the piece before, turned the shortest way."""
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
    """Hang a bunch below a piece, on a peduncle of mean size."""
    stalk = parameters.peduncle
    thick = 0.5 * float(stalk.diameter.at(0.5))
    down = frames.multiply(frames.conjugate(turn), frames.from_x_axis(np.array([0.0, 0.0, -1.0])))
    material = RodMaterial(stalk.modulus.value, stalk.density.value, stalk.damping.value)
    last = tree.add_rod(
        body, float(stalk.length.at(0.5)), (thick, thick), material, _PEDUNCLE_SEGMENTS, organ=Organ.PEDUNCLE, rest=down
    )[-1]
    fruit = mass * (1.0 - parameters.bunch.stem_share.value) / berries.VARIETIES[variety].mass
    count = int(np.clip(round(fruit), 1, berries.PROTOTYPE_BERRIES[-1]))
    tree.add_bunch(
        last,
        mass,
        count=count,
        variety=variety,
        parameters=parameters,
        pull=float(stalk.pull.at(0.5)),
        bend=float(stalk.bend_strength.value * np.pi / 4.0 * thick**3),
    )
