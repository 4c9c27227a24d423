"""Leaves at the nodes of shoots: which node stands where, and the leaves' weight on the bodies that carry them."""

from __future__ import annotations

import numpy as np

from vinesim.scene.generation.plant_bodies import Bodies
from vinesim.scene.generation.shoot_slots import AXIS_SEGMENTS, LATERAL_NODES, LATERAL_SEGMENTS, MAX_NODES
from vinesim.scene.generation.shoots import Shoots
from vinesim.scene.leaf_growth import LATERAL_AREA, LeafNodes, add_point_masses, grow_leaves
from vinesim.scene.plant_parameters import VineParameters
from vinesim.scene.spec import Scene


def place_leaves(scene: Scene, parameters: VineParameters, shoots: Shoots, bodies: Bodies) -> dict[str, np.ndarray]:
    """Leaves at the nodes, left and right in turn, and their weight on the bodies that carry them."""
    node = np.arange(MAX_NODES + LATERAL_NODES)
    main = node < MAX_NODES
    many = np.where(main, shoots.nodes[:, None], LATERAL_NODES)
    rank = np.where(main, node, node - MAX_NODES)
    share = np.minimum((rank + 0.7) / many, 0.999)

    pieces = np.where(main, AXIS_SEGMENTS, LATERAL_SEGMENTS)
    piece = (share * pieces).astype(int)
    slot = np.where(main, piece, AXIS_SEGMENTS + piece)
    rows = np.arange(len(shoots.vine))[:, None]
    nodes = LeafNodes(
        turn=bodies.turn[rows, slot],
        along=(share * pieces - piece) * bodies.length[rows, slot],
        thick=bodies.radius[rows, slot, 0],
        share=share,
        up=shoots.up[:, None],
        hand=np.where((rank + shoots.lateral_at[:, None]) % 2, 1.0, -1.0)[..., None],
        grown=np.where(main, 1.0, LATERAL_AREA),
    )
    leaf = grow_leaves(scene, parameters.leaf, nodes, shoots.leaf_normal, shoots.leaf_uniform)
    present = (rank < many) & leaf["present"] & (main | shoots.has_lateral[:, None])

    at = np.broadcast_to(rows, slot.shape), slot
    bodies.mass, bodies.com, bodies.inertia = add_point_masses(
        bodies.mass, bodies.com, bodies.inertia, at, np.where(present, leaf["mass"], 0.0), leaf["pose"][..., :3]
    )
    np.add.at(bodies.drag, at, np.where(present, leaf["drag"], 0.0))
    return {"slot": slot} | leaf | {"present": present}
