"""Digests of a client's world: of all its states in a run, and of what has changed for good.

Equal digests of runs mean runs that are equal to the bit. Equal digests of what has changed for good mean that clients
have the same cuts, stumps, sets, cracks, notches, ties, leaves, picked bunches and lost berries, to the bit. Poses are
not part of the latter: every client simulates its own copies.
"""

from __future__ import annotations

import hashlib

import numpy as np

from vinesim.client.client import Client
from vinesim.scene.state import State
from vinesim.world import Physics

_DERIVED = ("body_q", "body_qd")
"""Fields of the state that follow from others."""
_POSES = ("joint_q", "joint_qd", "joint_x", "joint_xd", "tree_fine", "tree_awake", *_DERIVED)
"""Fields of the state that change without lasting work."""


class StateDigest:
    """Digest of the states of plants and rigid bodies in all steps of a run. Call it after every step."""

    def __init__(self) -> None:
        self._digest = hashlib.blake2b(digest_size=16)

    def __call__(self, client: Client) -> None:
        physics = client.physics
        for name in State.array_fields():
            if name not in _DERIVED:
                self._digest.update(getattr(physics.state, name).tobytes())
        self._digest.update(physics.rigid.mj_data.qpos.tobytes())
        self._digest.update(_ties(physics))
        self._digest.update(_berries(physics))

    def hexdigest(self) -> str:
        """Returns the digest of all states so far."""
        return self._digest.hexdigest()


def lasting_parts(physics: Physics) -> dict[str, bytes]:
    """Returns what has changed for good in a world, each part by name: the fields of the state that are no poses, the
    ties that actors have bound or opened, and the berries that burst or were lost."""
    state = physics.state
    parts = {name: getattr(state, name).tobytes() for name in State.array_fields() if name not in _POSES}
    return parts | {"ties of actors": _ties(physics), "berries": _berries(physics)}


def lasting_digest(physics: Physics) -> str:
    """Returns the digest of :func:`lasting_parts` (32 hex digits)."""
    digest = hashlib.blake2b(digest_size=16)
    for part in lasting_parts(physics).values():
        digest.update(part)
    return digest.hexdigest()


def _ties(physics: Physics) -> bytes:
    ties = physics.handwork.ties
    kept = [ties[key] for key in sorted(ties) if not ties[key].is_pulling]
    return repr([(tie.segment, tie.steps, tie.to.tolist(), tie.is_open) for tie in kept]).encode()


def _berries(physics: Physics) -> bytes:
    monitor = physics.fruit_monitor
    picked = np.flatnonzero(~physics.state.bunch_attached).tolist()
    return repr([(bunch, monitor.berries_off(bunch)) for bunch in picked]).encode()
