"""The total order on claims by which all clients agree who owns an object, in whatever order messages arrive; pure.

A claim is (ownership, authority, owner). The newer ownership wins (grab, pick, cut: +1), then the newer authority
(contact: +1), then the lowest actor name; no owner, the empty name, precedes all names, so that "at rest" ends its own
sequence number and a later contact starts the next one. Every client keeps the greatest claim: a join of a semilattice,
independent of order, duplication and delay. After a loss one newer message restores agreement.

Sequences are u16 and wrap (serial number arithmetic, RFC 1982); the order holds while the claims in flight span less
than 32,768 numbers. Source of ownership and authority sequences: G. Fiedler, Networked Physics in Virtual Reality,
2018.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

SEQUENCE_COUNT = 1 << 16
"""Sequence numbers before they wrap."""
_HALF = SEQUENCE_COUNT >> 1

NO_OWNER = ""
"""Owner of an object at rest or without an owner."""


class Claim(NamedTuple):
    """Who claims an object, and with which sequences."""

    ownership: int = 0
    authority: int = 0
    owner: str = NO_OWNER


UNTOUCHED = Claim()
"""Claim on an object before any touch."""


def is_newer(a: int, b: int) -> bool:
    """Whether sequence ``a`` follows ``b`` around the u16 circle; at exactly half a circle the greater number does."""
    ahead = (a - b) % SEQUENCE_COUNT
    return a > b if ahead == _HALF else 0 < ahead < _HALF


def wins(claim: Claim, held: Claim) -> bool:
    """Whether ``claim`` replaces ``held``. Of two different claims exactly one wins over the other."""
    if claim.ownership != held.ownership:
        return is_newer(claim.ownership, held.ownership)
    if claim.authority != held.authority:
        return is_newer(claim.authority, held.authority)
    return claim.owner < held.owner


def is_outdated(claim: Claim, held: Claim) -> bool:
    """Whether ``claim`` has an older sequence than ``held``: its author has missed a message (no mere tie of names)."""
    if claim.ownership != held.ownership:
        return is_newer(held.ownership, claim.ownership)
    return claim.authority != held.authority and is_newer(held.authority, claim.authority)


def claim_by_touch(held: Claim, me: str, owner_touches: bool) -> Claim:
    """Claim of ``me`` by contact: the next authority, unless I own it or a live owner is in contact with it, too.

    That condition keeps two actors that press the same cane from taking it from each other for ever.
    """
    if held.owner == me or (held.owner != NO_OWNER and owner_touches):
        return held
    return Claim(held.ownership, (held.authority + 1) % SEQUENCE_COUNT, me)


def claim_by_grab(held: Claim, me: str) -> Claim:
    """Claim of ``me`` by grabbing, picking or cutting: the next ownership."""
    return Claim((held.ownership + 1) % SEQUENCE_COUNT, held.authority, me)


def release(held: Claim) -> Claim:
    """The same sequences without an owner: the object is at rest, or its owner has left."""
    return Claim(held.ownership, held.authority, NO_OWNER)


def choose_successor(position: np.ndarray, actors: dict[str, np.ndarray]) -> str:
    """Name of the actor nearest to ``position`` [m] on the ground, then the lowest name; empty without ``actors``."""
    if not actors:
        return NO_OWNER
    return min((float(np.hypot(*(where[:2] - position[:2]))), name) for name, where in actors.items())[1]
