"""Leaves on imported shoots: at nodes as far apart as those of a cane, left and right in turn."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.scene.builder import TreeBuilder
from vinesim.scene.leaf_growth import LATERAL_AREA, LeafNodes, add_point_masses, grow_leaves
from vinesim.scene.leaves import SHAPE_COUNT, blade_area
from vinesim.scene.plant_parameters import Cane, Leaf
from vinesim.scene.spec import Scene


@dataclasses.dataclass(frozen=True, slots=True)
class Nodes:
    """Nodes of the shoots of one tree."""

    piece: np.ndarray
    """[k] piece of wood that carries the leaf, by the point at its end."""
    share: np.ndarray
    """[k] of that piece's length."""
    axis_share: np.ndarray
    """[k] of its axis' length."""
    rank: np.ndarray
    """[k] number along its axis."""
    lateral: np.ndarray
    """[k] bool: on a side shoot."""


def find_nodes(parent: np.ndarray, radius: np.ndarray, way: np.ndarray, members: np.ndarray, cane: Cane) -> Nodes:
    """Nodes of the pieces ``members`` [point] bool, on wood as thin as a cane; thicker wood is older and bare.

    At a fork the branch that reaches furthest is the same axis; the others are side shoots, if what bears them is thin.

    Args:
        parent: [point], parents first.
        radius: [point] m, where a piece ends.
        way: [point] m, length of the wood from the base.
        members: [point] bool, the pieces of one tree.
        cane: parameters.
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
            continue  # an axis goes on
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
    rows.sort()  # leaves lie in the order of their bodies
    piece, share, axis_share, rank, lateral = np.array(rows, float).reshape(-1, 5).T
    return Nodes(piece.astype(int), share, axis_share, rank.astype(int), lateral > 0.0)


def add_leaves(
    tree: TreeBuilder,
    nodes: Nodes,
    body: np.ndarray,
    turn: np.ndarray,
    scene: Scene,
    leaf: Leaf,
    rng: np.random.Generator,
) -> None:
    """Grow leaves of a scene's season at the nodes of a tree, with their mass and drag on its bodies.

    Args:
        tree: without leaves yet.
        nodes: where.
        body: [k] the body of each node's piece.
        turn: [k, 4] its orientation in the world.
        scene: season and training.
        leaf: parameters.
        rng: of the leaves of this tree.
    """
    count = len(nodes.piece)
    normal = rng.standard_normal((8, count))
    uniform = rng.random((4, count))
    if count == 0:
        return
    parts = tree.bodies
    length, thick = (np.array([parts[b][name] for b in body], float) for name in ("length", "radius"))
    # across the axis and the row in a hedge, level over a net; where that is along the axis, the other way round
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
    size = np.sqrt(grown["area"] / np.mean([blade_area(shape) for shape in range(SHAPE_COUNT)]))
    for i, b in enumerate(body.tolist()):
        tree.leaves.append(
            {
                "body": b,
                "base": grown["base"][i],
                "pose": grown["pose"][i],
                "age": grown["age"][i],
                "size": size[i],
            }
        )
