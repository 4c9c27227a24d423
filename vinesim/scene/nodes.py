"""Canes, nodes and buds of dormant vines: where they are, and by which bodies they are carried.

A *cane* is a shoot of last year, or a piece of *two-year wood* (a spur or a fruiting cane) on which last year's canes
stand. A *node* is a place of a cane at which a leaf grew. Each node of last year's canes has a *bud*. Ids count over
the vineyard; they are the same on every client.

    nodes = model.nodes
    mine = np.flatnonzero(nodes.cane == 12)  # from the base of cane 12 to its tip
    place = nodes.positions(state.body_q)[mine]  # m, in the world
    body, along = nodes.body[mine], nodes.along[mine]  # where a cut would be at these nodes

Vineyards without a dormant date have no nodes.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.core.array_fields import StructOfArrays, array

_UNIT_POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclasses.dataclass
class Nodes(StructOfArrays):
    """All nodes of dormant wood, cane by cane, from base to tip. The id of a node is its index."""

    body: np.ndarray = array("node", unit="1", dtype=np.int32)
    """Body that carries the node."""
    along: np.ndarray = array("node", unit="m")
    """Distance of the node from the origin of its body, along the body's x axis."""
    cane: np.ndarray = array("node", unit="1", dtype=np.int32)
    """Id of the cane: index into :class:`DormantCanes`."""
    rank: np.ndarray = array("node", unit="1", dtype=np.int32)
    """Number of the node on its cane, from 0 at the base."""
    bud: np.ndarray = array("node", unit="1", dtype=np.int32, fill=-1)
    """Id of the node's bud, counted over the vineyard; -1: the node has none, because it has borne a cane."""
    bud_pose: np.ndarray = array("node", 7, unit="m, 1", fill=_UNIT_POSE)
    """Base of the bud on the cane's surface, in the frame of the body; the bud points along x."""
    bud_length: np.ndarray = array("node", unit="m")
    bud_radius: np.ndarray = array("node", unit="m")
    """Radius of the bud at its base."""

    def carriers(self, stump_of: np.ndarray, stump_end: np.ndarray) -> np.ndarray:
        """Returns the bodies [node] that carry the nodes after cuts within their segments: the stump before a cut, the
        body itself beyond it. ``stump_of``, ``stump_end``: those of :class:`~vinesim.scene.state.State`."""
        carrier = self.body.copy()
        stumps = np.flatnonzero(stump_of >= 0)
        for stump in stumps[np.argsort(-stump_end[stumps], kind="stable")].tolist():
            carrier[(self.body == stump_of[stump]) & (self.along < stump_end[stump])] = stump
        return carrier

    def positions(self, body_q: np.ndarray, carrier: np.ndarray | None = None) -> np.ndarray:
        """Returns the positions of the nodes on the axes of their canes [node, 3] m.

        Args:
            body_q: [body, 7] m, 1, poses of all bodies.
            carrier: bodies of :meth:`carriers`, where canes may have been cut within a segment; :attr:`body` unless
                given.
        """
        pose = np.asarray(body_q, float)[self.body if carrier is None else carrier]
        along = self.along.astype(float)[:, None] * np.array([1.0, 0.0, 0.0])
        return pose[:, :3] + frames.rotate(pose[:, 3:], along)

    def bud_poses(self, body_q: np.ndarray, carrier: np.ndarray | None = None) -> np.ndarray:
        """Returns the poses of the buds [bud, 7] m, 1 in the world, by the bud's id; see :meth:`positions`."""
        has = np.flatnonzero(self.bud >= 0)
        has = has[np.argsort(self.bud[has], kind="stable")]
        body = (self.body if carrier is None else carrier)[has]
        return frames.compose(np.asarray(body_q, float)[body], self.bud_pose[has].astype(float))


@dataclasses.dataclass
class DormantCanes(StructOfArrays):
    """All dormant canes, tree by tree: two-year wood first, then the canes on it. The id of a cane is its index."""

    body: np.ndarray = array("cane", unit="1", dtype=np.int32)
    """First body of the cane. Its bodies are contiguous, from base to tip."""
    size: np.ndarray = array("cane", unit="1", dtype=np.int32)
    """Number of bodies."""
    tree: np.ndarray = array("cane", unit="1", dtype=np.int32)
    vine: np.ndarray = array("cane", unit="1", dtype=np.int32)
    year: np.ndarray = array("cane", unit="1", dtype=np.int32, fill=1)
    """Age of the wood: 1 for last year's cane, 2 for two-year wood."""
    shoot: np.ndarray = array("cane", unit="1", dtype=np.int32, fill=-1)
    """Index of the shoot that became this cane: the index of its tree in the same scene in summer; -1 for two-year
    wood."""
    parent: np.ndarray = array("cane", unit="1", dtype=np.int32, fill=-1)
    """Id of the two-year wood that carries the cane; -1 for two-year wood."""
    node: np.ndarray = array("cane", unit="1", dtype=np.int32, fill=-1)
    """Id of the node from which the cane grew; -1 for two-year wood."""
    length: np.ndarray = array("cane", unit="m")
    diameter: np.ndarray = array("cane", unit="m")
    """Diameter in the middle between the second and the third node, where canes are measured; at the base of two-year
    wood."""
    from_trunk: np.ndarray = array("cane", unit="m")
    """Level distance of the cane's base from the upper end of its vine's trunk."""
    height: np.ndarray = array("cane", unit="m")
    """Height of the cane's base above the foot of its vine."""

    def of_bodies(self, bodies: int) -> np.ndarray:
        """Returns the id of the cane that each of ``bodies`` bodies belongs to [body], -1 for none."""
        cane = np.full(bodies, -1, np.int32)
        for number, (first, size) in enumerate(zip(self.body.tolist(), self.size.tolist(), strict=True)):
            cane[first : first + size] = number
        return cane


def no_nodes() -> Nodes:
    """Returns the nodes of a vineyard without dormant wood."""
    return Nodes.allocate(node=0)


def no_canes() -> DormantCanes:
    """Returns the canes of a vineyard without dormant wood."""
    return DormantCanes.allocate(cane=0)
