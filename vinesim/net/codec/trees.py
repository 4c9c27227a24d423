"""Wire format of moving trees: joint rotations and rates of all bodies, and detached bodies with their positions.

A batch contains several trees of one owner at one instant. Joint rotations are rotation vectors of 3 i16. Joint rates
are i8 in steps of a scale of the tree (error 0.4 % of the fastest joint). A tree takes 13 bytes, and 9 for each of its
bodies. A body that was cut off its parent has a floating root: its position [m] as f4 and its velocity as i2 follow, in
20 bytes. To have the same bits as all copies, an owner applies the values that :func:`quantise_tree` or
:func:`encode_trees` returns.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from vinesim.net.codec.header import (
    HEADER,
    LARGEST_COORDINATE,
    MAX_COORDINATE,
    MAX_DATAGRAM,
    MessageError,
    pack_header,
    unpack_header,
)
from vinesim.net.codec.json_values import CLAIM, COUNT, YES, list_of, object_of
from vinesim.net.codec.robot import BASE_VELOCITY_LSB, JOINT_RATE_LSB
from vinesim.net.codec.rotation import TURN_LSB, check_rotation_vectors, quaternion, rotation_vector
from vinesim.scene.values import TreeUpdate

TREES = 2
"""Number of the kind of message with states of trees, the fourth byte of the message."""

TOUCHED = 1
RESTING = 2
"""Flags of a tree or an object. TOUCHED: its owner is in contact with it. RESTING: it is at rest, so that no further
messages follow."""

DETACHED_COUNT_UNIT = 4
"""Unit in which the flags of a tree count its detached bodies: their number is ``flags // DETACHED_COUNT_UNIT``."""

MAX_DETACHED = 255 // DETACHED_COUNT_UNIT
"""Largest number of detached bodies of one tree in a message."""

MAX_TREES = 4096
"""Largest number of trees, objects or claims in one message."""

MAX_BODIES = 1 << 16
"""Largest number of bodies of all trees in one message."""

_TREE = np.dtype(
    [("tree", "<u4"), ("ownership", "<u2"), ("authority", "<u2"), ("flags", "u1"), ("bodies", "<u2"), ("scale", "<u2")]
)

_BODY = np.dtype([("turn", "<i2", 3), ("rate", "i1", 3)])

_ROOT = np.dtype([("body", "<u2"), ("position", "<f4", 3), ("velocity", "<i2", 3)])

_NO_ROOTS = np.zeros(0, np.int64)


@dataclasses.dataclass(frozen=True, slots=True)
class TreeStates:
    """States of several trees of one owner at one instant, as flat arrays. Tree ids strictly increase."""

    time: float
    """Network time of the states [s]."""
    tree: np.ndarray
    """[k] tree ids"""
    ownership: np.ndarray
    """[k] ownership sequences (u16) of the owner's claims"""
    authority: np.ndarray
    """[k] authority sequences (u16) of the owner's claims"""
    flags: np.ndarray
    """[k] flags: sum of :data:`TOUCHED` and :data:`RESTING`, or 0"""
    bodies: np.ndarray
    """[k] number of bodies of each tree; ``joint_q`` and ``joint_qd`` list the joints of all bodies tree by tree"""
    joint_q: np.ndarray
    """[sum of bodies, 4] joint rotations, quaternions xyzw"""
    joint_qd: np.ndarray
    """[sum of bodies, 3] joint rates [rad/s]"""
    roots: np.ndarray = dataclasses.field(default_factory=lambda: _NO_ROOTS)
    """[k] number of detached bodies of each tree, or empty if no tree has any; ``root``, ``root_x`` and ``root_xd``
    list the detached bodies tree by tree"""
    root: np.ndarray = dataclasses.field(default_factory=lambda: _NO_ROOTS)
    """[sum of roots] index of each detached body within its tree"""
    root_x: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """[sum of roots, 3] positions of the detached bodies in the world [m]"""
    root_xd: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """[sum of roots, 3] velocities of the detached bodies in the world [m/s]"""

    def updates(self, owner: str) -> list[TreeUpdate]:
        """Returns one update per tree. The arrays of an update are views of this batch's arrays."""
        ends = np.cumsum(self.bodies).tolist()
        lasts = np.cumsum(self.roots).tolist() if len(self.roots) else [0] * len(ends)
        columns = (self.tree, self.ownership, self.authority, self.flags)
        rows = zip(
            *(column.tolist() for column in columns), [0, *ends[:-1]], ends, [0, *lasts[:-1]], lasts, strict=True
        )
        return [
            TreeUpdate(
                tree,
                owner,
                ownership,
                authority,
                self.time,
                bool(flags & RESTING),
                bool(flags & TOUCHED),
                self.joint_q[start:end],
                self.joint_qd[start:end],
                self.root[first:last],
                self.root_x[first:last],
                self.root_xd[first:last],
            )
            for tree, ownership, authority, flags, start, end, first, last in rows
        ]


def _quantise(bodies: np.ndarray, joint_q: np.ndarray, joint_qd: np.ndarray) -> tuple[np.ndarray, ...]:
    """Quantise the joints of ``k`` trees with ``n`` bodies in all.

    Returns rotation steps and rate steps [n, 3] (whole numbers as floats), the rate scale of each tree [k], and the
    quantisation step of the rates of each body [n, 1] rad/s.
    """
    if not (np.isfinite(joint_q).all() and np.isfinite(joint_qd).all()):
        raise MessageError("joint state of a tree is not finite")
    fastest = np.maximum.reduceat(np.abs(joint_qd).ravel(), 3 * (np.cumsum(bodies) - bodies))
    scale = np.minimum(np.ceil(fastest / (127.0 * JOINT_RATE_LSB)), 65535.0)
    unit = _rate_units(bodies, scale)
    turn = np.rint(rotation_vector(joint_q) / TURN_LSB) + 0.0  # an integer has no negative zero
    rate = np.minimum(np.maximum(np.rint(joint_qd / np.maximum(unit, JOINT_RATE_LSB)), -127.0), 127.0) + 0.0
    return turn, rate, scale, unit


def _rate_units(bodies: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Returns the quantisation step of the joint rates of each body [n, 1] rad/s, from the rate scale of each tree
    [k]."""
    return np.repeat(scale * JOINT_RATE_LSB, bodies)[:, None]


def quantise_tree(joint_q: np.ndarray, joint_qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns joint rotations [n, 4] and rates [n, 3] rad/s of one tree as all receivers decode them, bit by bit.

    Errors: rotations 0.005 degrees, rates 0.4 % of the fastest joint. Rates are clipped at 83 rad/s.
    """
    turn, rate, _, unit = _quantise(np.array([len(joint_q)]), np.asarray(joint_q, float), np.asarray(joint_qd, float))
    return quaternion(turn * TURN_LSB), rate * unit


def encode_trees(trees: TreeStates) -> tuple[list[bytes], TreeStates]:
    """Encode a batch. Returns its messages, and the batch as receivers decode it.

    A message has at most :data:`MAX_DATAGRAM` bytes unless a single tree needs more. Raises :class:`MessageError` if
    ids do not increase, sizes disagree or a value is not finite.
    """
    ids = trees.tree
    if not len(ids) or (len(ids) > 1 and not (ids[1:] > ids[:-1]).all()):
        raise MessageError("trees of a batch must be at least one, in strictly increasing order")
    sizes = trees.bodies.tolist()
    if min(sizes) < 1 or sum(sizes) != len(trees.joint_q) or len(trees.joint_q) != len(trees.joint_qd):
        raise MessageError(
            f"{sum(sizes)} bodies declared, {len(trees.joint_q)} rotations and {len(trees.joint_qd)} rates"
        )
    turn, rate, scale, unit = _quantise(trees.bodies, trees.joint_q, trees.joint_qd)
    records = np.empty(len(turn), _BODY)
    records["turn"], records["rate"] = turn, rate
    heads = np.empty(len(ids), _TREE)
    for name in ("tree", "ownership", "authority", "flags", "bodies"):
        heads[name] = getattr(trees, name)
    heads["scale"] = scale
    cuts = [0] * len(sizes)
    roots = np.empty(len(trees.root), _ROOT)
    if len(trees.roots):
        cuts = trees.roots.tolist()
        if max(cuts) > MAX_DETACHED or sum(cuts) != len(roots) or not np.isfinite(trees.root_x).all():
            raise MessageError(
                f"trees with {cuts} bodies cut off (at most {MAX_DETACHED} each) and {len(roots)} places"
            )
        heads["flags"] += np.array(cuts, np.uint8) * DETACHED_COUNT_UNIT
        roots["body"] = trees.root
        roots["position"] = np.clip(trees.root_x, -LARGEST_COORDINATE, LARGEST_COORDINATE)
        roots["velocity"] = np.clip(np.rint(trees.root_xd / BASE_VELOCITY_LSB), -32767, 32767)

    payloads = []
    start = 0
    body = 0
    root = 0
    head_bytes = heads.tobytes()
    body_bytes = records.tobytes()
    root_bytes = roots.tobytes()
    while start < len(sizes):
        end = start
        last = body
        end_root = root
        room = MAX_DATAGRAM - HEADER.size
        while end < len(sizes):
            room -= _TREE.itemsize + sizes[end] * _BODY.itemsize + cuts[end] * _ROOT.itemsize
            if room < 0 and end > start:
                break
            last += sizes[end]
            end_root += cuts[end]
            end += 1
        payloads.append(
            pack_header(TREES, end - start, trees.time)
            + head_bytes[start * _TREE.itemsize : end * _TREE.itemsize]
            + body_bytes[body * _BODY.itemsize : last * _BODY.itemsize]
            + root_bytes[root * _ROOT.itemsize : end_root * _ROOT.itemsize]
        )
        start = end
        body = last
        root = end_root
    decoded = dataclasses.replace(
        trees,
        joint_q=quaternion(turn * TURN_LSB),
        joint_qd=rate * unit,
        root_x=roots["position"].astype(float),
        root_xd=roots["velocity"] * BASE_VELOCITY_LSB,
    )
    return payloads, decoded


def decode_trees(payload: bytes, tree_size: np.ndarray | None = None) -> TreeStates:
    """Decode a batch. Raises :class:`MessageError` for anything that :func:`encode_trees` cannot have written.

    ``tree_size``: number of bodies of each tree in the model, to check ids and sizes; None: not checked.
    """
    count, time = unpack_header(payload, TREES, "trees")
    at = HEADER.size + count * _TREE.itemsize
    if not 1 <= count <= MAX_TREES or len(payload) < at:
        raise MessageError(f"{count} trees announced (1 to {MAX_TREES}) in {len(payload)} B")
    heads = np.frombuffer(payload, _TREE, count, HEADER.size)
    tree = heads["tree"].astype(np.int64)
    bodies = heads["bodies"].astype(np.int64)
    total = int(bodies.sum())
    cuts = heads["flags"].astype(np.int64) // DETACHED_COUNT_UNIT
    after = at + total * _BODY.itemsize
    expected = after + int(cuts.sum()) * _ROOT.itemsize
    if len(payload) != expected or bodies.min() < 1 or total > MAX_BODIES:
        raise MessageError(f"trees of {total} bodies in {len(payload)} B, expected {expected} B")
    if (tree[1:] <= tree[:-1]).any():
        raise MessageError("tree ids that do not increase")
    if tree_size is not None:
        if tree[-1] >= len(tree_size):
            raise MessageError(f"tree {tree[-1]}, this scene has {len(tree_size)}")
        if (bodies != tree_size[tree]).any():
            wrong = int(np.flatnonzero(bodies != tree_size[tree])[0])
            raise MessageError(
                f"tree {tree[wrong]} with {bodies[wrong]} bodies, in this scene it has {tree_size[tree[wrong]]}"
            )
    records = np.frombuffer(payload, _BODY, total, at)
    joint_q = quaternion(check_rotation_vectors(records["turn"] * TURN_LSB, "tree"))
    joint_qd = records["rate"] * _rate_units(bodies, heads["scale"])
    known = (
        time,
        tree,
        heads["ownership"],
        heads["authority"],
        heads["flags"] % DETACHED_COUNT_UNIT,
        bodies,
        joint_q,
        joint_qd,
    )
    if not cuts.any():
        return TreeStates(*known)
    roots = np.frombuffer(payload, _ROOT, int(cuts.sum()), after)
    with np.errstate(invalid="ignore"):  # signalling NaNs would warn; they are refused below
        root = roots["body"].astype(np.int64)
        root_x = roots["position"].astype(float)
    if (root >= np.repeat(bodies, cuts)).any() or not (np.abs(root_x) < MAX_COORDINATE).all():
        raise MessageError("a detached body that the tree does not have, or with a position out of range")
    if (np.diff(root)[np.diff(np.repeat(tree, cuts)) == 0] <= 0).any():
        raise MessageError("detached bodies of a tree in an order that does not increase")
    return TreeStates(*known, cuts, root, root_x, roots["velocity"] * BASE_VELOCITY_LSB)


TREES_FIELDS = {
    "trees": list_of(object_of("tree", "one record", tree=COUNT, bodies=COUNT, touched=YES, resting=YES, **CLAIM))
}
"""JSON schema of what :func:`describe_trees` returns."""


def describe_trees(payload: bytes, _: str) -> dict[str, Any]:
    """Decode trees, without their joints, for the JSON of a recording."""
    trees = decode_trees(payload)
    columns = (trees.tree, trees.ownership, trees.authority, trees.flags, trees.bodies)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return {
        "trees": [
            {
                "tree": tree,
                "ownership": ownership,
                "authority": authority,
                "bodies": bodies,
                "touched": bool(flags & TOUCHED),
                "resting": bool(flags & RESTING),
            }
            for tree, ownership, authority, flags, bodies in rows
        ],
    }
