"""The total order of claims, by which all clients agree who owns an object, in whatever order messages arrive. No I/O.

A claim is (ownership, authority, owner). Of two claims the one with the newer ownership wins (each grab, pick or cut
increments it), then the one with the newer authority (each contact increments it), then the one with the lowest actor
name. The empty name stands for no owner and precedes all names. So the claim "at rest" wins over the owner's claim with
the same sequences, and a later contact increments the authority. Every client keeps the greatest claim. This is a join
of a semilattice, independent of order, duplication and delay. After a loss, one newer message restores agreement.

Sequences are u16 and wrap around (serial number arithmetic, RFC 1982). The order holds while all claims in use span
less than 32,768 numbers. Source of ownership and authority sequences: G. Fiedler, Networked Physics in Virtual Reality,
2018.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

SEQUENCE_COUNT = 1 << 16
"""Number of sequence numbers; after the largest one follows 0."""
_HALF = SEQUENCE_COUNT >> 1

NO_OWNER = ""
"""Owner in the claim on an object that is at rest or has no owner."""


class Claim(NamedTuple):
    """A claim on an object: its sequence numbers (u16) and the name of the actor that claims the object."""

    ownership: int = 0
    authority: int = 0
    owner: str = NO_OWNER


UNTOUCHED = Claim()
"""Claim on an object before any touch."""


def is_newer(a: int, b: int) -> bool:
    """Whether the u16 sequence number ``a`` is newer than ``b``, with wrap-around.

    If they are exactly half the range apart, the greater number is newer.
    """
    ahead = (a - b) % SEQUENCE_COUNT
    return a > b if ahead == _HALF else 0 < ahead < _HALF


def wins(claim: Claim, held: Claim) -> bool:
    """Whether ``claim`` is greater than ``held`` and so replaces it. Of two different claims exactly one wins."""
    if claim.ownership != held.ownership:
        return is_newer(claim.ownership, held.ownership)
    if claim.authority != held.authority:
        return is_newer(claim.authority, held.authority)
    return claim.owner < held.owner


def is_outdated(claim: Claim, held: Claim) -> bool:
    """Whether ``claim`` has older sequences than ``held``, so that its author must have missed a message.

    False if only the names differ.
    """
    if claim.ownership != held.ownership:
        return is_newer(held.ownership, claim.ownership)
    return claim.authority != held.authority and is_newer(held.authority, claim.authority)


def claim_by_touch(held: Claim, me: str, owner_touches: bool) -> Claim:
    """Returns the claim of the actor ``me`` on an object that it touches: the next authority.

    Returns ``held`` unchanged if ``me`` is the owner, or if a live owner is in contact with the object, too
    (``owner_touches``). Otherwise two actors that press the same cane would take it from each other for ever.
    """
    if held.owner == me or (held.owner != NO_OWNER and owner_touches):
        return held
    return Claim(held.ownership, (held.authority + 1) % SEQUENCE_COUNT, me)


def claim_by_grab(held: Claim, me: str) -> Claim:
    """Returns the claim of the actor ``me`` on an object that it grabs, picks or cuts: the next ownership."""
    return Claim((held.ownership + 1) % SEQUENCE_COUNT, held.authority, me)


def release(held: Claim) -> Claim:
    """Returns the claim ``held`` without its owner, for an object that is at rest or whose owner has left."""
    return Claim(held.ownership, held.authority, NO_OWNER)


def choose_successor(position: np.ndarray, actors: dict[str, np.ndarray]) -> str:
    """Returns the name of the actor that is nearest to ``position`` [m] on the ground; if several are, the lowest name.

    ``actors``: positions [m] by name. Returns the empty name if there are none.
    """
    if not actors:
        return NO_OWNER
    return min((float(np.hypot(*(where[:2] - position[:2]))), name) for name, where in actors.items())[1]
