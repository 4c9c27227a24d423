"""Wire format of how the wood and the ties of one tree have given: sets and cracks of joints, slips and breaks of ties.

Rotations and distances are sent to the bit, so that all clients have the same springs.
"""

from __future__ import annotations

import numpy as np

from vinesim.net.codec.header import MessageError
from vinesim.scene.values import GivenWood

_JOINT = np.dtype([("place", "<u2"), ("turn", "<f4", 4), ("flow", "<f4")])
_TIE = np.dtype([("place", "<u2"), ("slid", "<f4"), ("broken", "u1")])
_COUNT = np.dtype("<u2")

MAX_SLID = 100.0
"""[m] Longest distance by which a tie can have slipped; and [rad] largest flow of a joint."""


def encode_wood(wood: GivenWood) -> bytes:
    """Encode how a tree has given; empty bytes if it has not."""
    if not len(wood.joints) and not len(wood.ties):
        return b""
    joints = np.zeros(len(wood.joints), _JOINT)
    joints["place"], joints["turn"], joints["flow"] = wood.joints, wood.turns, wood.flows
    ties = np.zeros(len(wood.ties), _TIE)
    ties["place"], ties["slid"], ties["broken"] = wood.ties, wood.slid, wood.broken
    return np.array(len(joints), _COUNT).tobytes() + joints.tobytes() + ties.tobytes()


def decode_wood(payload: bytes) -> GivenWood:
    """Decode how a tree has given. Raises :class:`MessageError` if the message is invalid; whether the tree has such
    bodies and ties is not checked."""
    count = int(np.frombuffer(payload, _COUNT, 1)[0]) if len(payload) >= _COUNT.itemsize else 0
    rest = len(payload) - _COUNT.itemsize - count * _JOINT.itemsize
    if payload and (rest < 0 or rest % _TIE.itemsize):
        raise MessageError(f"wood of {count} joints in {len(payload)} B")
    joints = np.frombuffer(payload, _JOINT, count, _COUNT.itemsize) if payload else np.zeros(0, _JOINT)
    ties = np.frombuffer(payload, _TIE, -1, len(payload) - rest) if payload and rest else np.zeros(0, _TIE)
    for rows in (joints, ties):
        if (np.diff(rows["place"].astype(int)) <= 0).any():
            raise MessageError("wood with joints or ties in an order that does not increase")
    lengths = np.linalg.norm(joints["turn"].astype(float), axis=1)
    sound = (abs(lengths - 1.0) < 1e-3).all() and ((joints["flow"] >= 0.0) & (joints["flow"] < MAX_SLID)).all()
    if not (sound and (abs(ties["slid"]) < MAX_SLID).all()):
        raise MessageError("wood with a set that is no rotation, or a number out of range")
    return GivenWood(
        joints["place"].astype(int),
        joints["turn"].copy(),
        joints["flow"].copy(),
        ties["place"].astype(int),
        ties["slid"].copy(),
        ties["broken"] > 0,
    )
