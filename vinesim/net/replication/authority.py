"""Who owns a tree: one total order on claims, so that all clients agree whatever order they hear them in; pure.

A claim is (ownership, authority, owner). The newer ownership wins (grab, pick, cut: +1), then the newer authority
(touch: +1), then the lowest actor name; nobody, the empty name, comes before all names, so "it rests" ends its own
sequence number and any later touch starts the next one. Everybody keeps the greatest claim heard: a join of
a semilattice, indifferent to order, duplication and delay. After loss one newer message repairs everything.

Sequences are u16 and wrap (RFC 1982); the order holds while claims in flight span less than 32,768 steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

SEQUENCE_COUNT = 1 << 16
_HALF = SEQUENCE_COUNT >> 1

NOBODY = ""
"""Owner of what rests or was left."""


class Claim(NamedTuple):
    """Who says to own one tree, and with what right."""

    ownership: int = 0
    authority: int = 0
    owner: str = NOBODY


UNTOUCHED = Claim()
"""What everybody holds of a tree before anybody touched it."""


def is_newer(a: int, b: int) -> bool:
    """Sequence ``a`` comes after ``b`` around the u16 circle; exactly half a circle apart the greater number does."""
    ahead = (a - b) % SEQUENCE_COUNT
    return a > b if ahead == _HALF else 0 < ahead < _HALF


def wins(claim: Claim, held: Claim) -> bool:
    """``claim`` takes the place of ``held``. Of two different claims exactly one wins over the other."""
    if claim.ownership != held.ownership:
        return is_newer(claim.ownership, held.ownership)
    if claim.authority != held.authority:
        return is_newer(claim.authority, held.authority)
    return claim.owner < held.owner


def is_outdated(claim: Claim, held: Claim) -> bool:
    """``claim`` carries an older sequence than ``held``: its author has missed something (no mere tie of names)."""
    if claim.ownership != held.ownership:
        return is_newer(held.ownership, claim.ownership)
    return claim.authority != held.authority and is_newer(held.authority, claim.authority)


def claim_by_touch(held: Claim, me: str, owner_touches: bool) -> Claim:
    """What ``me`` claims by touching: the next authority, unless I own it or a living owner touches it as well.

    That condition keeps two who press the same cane from taking it from each other forever.
    """
    if held.owner == me or (held.owner != NOBODY and owner_touches):
        return held
    return Claim(held.ownership, (held.authority + 1) % SEQUENCE_COUNT, me)


def claim_by_grab(held: Claim, me: str) -> Claim:
    """What ``me`` claims by grabbing, picking or cutting: the next ownership, whoever had it."""
    return Claim((held.ownership + 1) % SEQUENCE_COUNT, held.authority, me)


def release(held: Claim) -> Claim:
    """The same sequence, owned by nobody: it lies still, or its owner is gone."""
    return Claim(held.ownership, held.authority, NOBODY)


def choose_successor(position: np.ndarray, actors: dict[str, np.ndarray]) -> str:
    """Who takes over what a gone actor left at ``position`` m: the nearest on the ground plan, then the lowest name."""
    if not actors:
        return NOBODY
    return min((float(np.hypot(*(where[:2] - position[:2]))), name) for name, where in actors.items())[1]
