"""Claims on all objects as one actor knows them: who owns an object, which owners are silent, which claims to correct.

The order of claims is defined in :mod:`vinesim.net.replication.authority`. Times are network time [s].
"""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Callable, Container

from vinesim.net.replication import authority, dead_reckoning
from vinesim.net.replication.authority import NO_OWNER, UNTOUCHED, Claim

CORRECTION_PERIOD = 0.2
"""Shortest time between two corrections of claims on one object [s]. GUESSED."""

OWNER_TIMEOUT = 3.0
"""Time without messages about an object after which the sender no longer counts as its owner [s]: three heartbeats."""

LONG_AGO = -1e9


@dataclasses.dataclass(slots=True)
class ObjectRecord:
    """The greatest known claim on one object, and the times at which its state was last sent or received."""

    claim: Claim = UNTOUCHED
    """Greatest claim on the object that this actor has made or received."""
    touching: bool = False
    """Whether the owner is in contact with the object."""
    previous: Claim = UNTOUCHED
    """Claim before this actor took the object."""
    announced: bool = False
    """Whether the claim was published or received, so that a peer may know it."""
    silent: bool = False
    """Whether the owner has left or timed out. The object then has no owner. The claim is kept in case the owner
    returns."""
    published_at: float = LONG_AGO
    """Time of the newest state of the object that was sent or accepted."""
    received_at: float = LONG_AGO
    """Time at which the newest message about the object arrived."""
    listener_count: int = 0
    """Number of peers within the interest radius when the object's state was last published."""
    published_to_all_at: float = LONG_AGO
    """For a tree: time of the newest state that this actor published to all peers within the interest radius."""
    near_listener_count: int = 0
    """For a tree: number of peers near enough to receive all layers of its states when it was last published."""
    corrected_at: float = LONG_AGO
    """Time at which this actor last published the claim to correct an outdated one."""


class Ownership:
    """The greatest known claims on all objects that were ever claimed, as one actor knows them."""

    def __init__(self, name: str, live: Container[str]) -> None:
        """``name``: name of the own actor. ``live``: names of all present peers, which the caller keeps up to date."""
        self.name = name
        self._live = live
        self._known: collections.defaultdict[int, ObjectRecord] = collections.defaultdict(ObjectRecord)
        self.siblings: tuple[Ownership, ...] = ()
        """Claims as known by the other actors of the same client. These actors send this one no messages about the
        objects that they own, so it reads their claims here."""
        self.owned: set[int] = set()
        self.remote: set[int] = set()
        self._losing_claims: list[tuple[int, Claim]] = []

    # ------------------------------------------------------------ questions

    @property
    def known(self) -> list[int]:
        """Ids of all objects that were ever claimed."""
        return list(self._known)

    def __getitem__(self, object_id: int) -> ObjectRecord:
        return self._known[object_id]

    def claim(self, object_id: int) -> Claim:
        """Returns the greatest claim on an object that this actor has made or received."""
        return self._known[object_id].claim if object_id in self._known else UNTOUCHED

    def owner(self, object_id: int) -> str | None:
        """Returns the name of the live actor that owns an object now, which may be the own actor, or None."""
        if object_id not in self.owned and (sibling := self._owning_sibling(object_id)) is not None:
            return sibling.name
        if object_id not in self._known:
            return None
        known = self._known[object_id]
        owner = known.claim.owner
        if owner == self.name:
            return owner
        return owner if owner in self._live and not known.silent else None

    def _owning_sibling(self, object_id: int) -> Ownership | None:
        """Returns the claims of the other actor of the same client that owns an object now, or None."""
        return next((sibling for sibling in self.siblings if object_id in sibling.owned), None)

    # ------------------------------------------------------------ what I do

    def touch(self, object_id: int) -> None:
        """Claim an object that the own actor touches, unless its live owner touches it, too."""
        self._merge_sibling(object_id)
        known = self._known[object_id]
        claim = authority.claim_by_touch(known.claim, self.name, self.owner(object_id) is not None and known.touching)
        if claim is not known.claim:
            self._take(object_id, claim)

    def grab(self, object_id: int) -> None:
        """Claim an object that the own actor grabs, picks or cuts, whoever owns it."""
        self._merge_sibling(object_id)
        self._take(object_id, authority.claim_by_grab(self.claim(object_id), self.name))

    def take_over(self, object_id: int) -> None:
        """Claim an object that has no live owner."""
        self._take(object_id, authority.claim_by_touch(self.claim(object_id), self.name, False))

    def _merge_sibling(self, object_id: int) -> None:
        """Adopt the claim of another actor of the same client that owns the object, unless a greater claim is known."""
        sibling = None if object_id in self.owned else self._owning_sibling(object_id)
        if sibling is not None and not authority.wins(self.claim(object_id), sibling.claim(object_id)):
            self._adopt(object_id, sibling.claim(object_id), sibling[object_id].touching)

    def _take(self, object_id: int, claim: Claim) -> None:
        """Make the own ``claim`` on an object. The claim is not announced yet."""
        known = self._known[object_id]
        if object_id not in self.owned or known.announced:
            known.previous = known.claim
        if (sibling := self._owning_sibling(object_id)) is not None:
            theirs = sibling[object_id]
            known.previous = theirs.claim if theirs.announced else theirs.previous
            sibling._adopt(object_id, claim, True)
        known.claim = claim
        known.touching = True
        known.announced = False
        known.silent = False
        known.listener_count = known.near_listener_count = 0
        self.owned.add(object_id)

    def release(self, object_id: int) -> Claim:
        """Give up the ownership of an object that is at rest. Returns the claim with which to publish its state at
        rest."""
        known = self._known[object_id]
        held = known.claim
        self.owned.discard(object_id)
        known.claim = authority.release(held)
        known.touching = False
        return held

    def increment(self, object_id: int) -> None:
        """Increment the own claim on an object before a retained record is published, so that no two records share a
        claim."""
        known = self._known[object_id]
        known.claim = known.claim._replace(authority=(known.claim.authority + 1) % authority.SEQUENCE_COUNT)

    def rollback(self, object_id: int) -> None:
        """Undo the own claim on an object, which no peer knows yet, so that sequence numbers count only published
        claims."""
        known = self._known[object_id]
        known.claim = authority.release(known.previous) if known.previous.owner == self.name else known.previous
        known.silent = True

    # ------------------------------------------------------------ what others say

    def receive_state(self, object_id: int, claim: Claim, touching: bool, published_at: float, time: float) -> bool:
        """Merge the claim in a received state of an object. Returns whether to accept the state.

        ``touching``: whether the owner touches the object. ``published_at`` [s]: time in the message. ``time`` [s]:
        present time. If the object is at rest, the claim has no owner.
        """
        known = self._known[object_id]
        published_at = min(published_at, time + dead_reckoning.MAX_CLOCK_SKEW)
        fresh = published_at > known.published_at
        if claim != known.claim and not authority.wins(claim, known.claim):
            if fresh and claim.owner != NO_OWNER:
                self._losing_claims.append((object_id, claim))
            return False
        if not fresh and claim == known.claim:
            return False
        self._adopt(object_id, claim, touching)
        known.published_at = published_at
        known.received_at = time
        return True

    def receive_claim(self, object_id: int, claim: Claim, touching: bool, sender: str, time: float) -> None:
        """Merge a claim on an object that ``sender`` has made, or has repeated to correct an outdated one."""
        known = self._known[object_id]
        if claim == known.claim and claim.owner != sender:
            return
        if claim == known.claim or authority.wins(claim, known.claim):
            self._adopt(object_id, claim, touching)
            known.received_at = time
        elif claim.owner == sender:
            self._losing_claims.append((object_id, claim))

    def receive_retained(self, object_id: int, claim: Claim, touching: bool, time: float) -> bool:
        """Merge the claim of a retained record about an object. Returns whether the pose in the record is valid now."""
        known = self._known[object_id]
        if claim != known.claim and not authority.wins(claim, known.claim):
            return False
        self._adopt(object_id, claim, touching)
        known.received_at = time
        return True

    def _adopt(self, object_id: int, claim: Claim, touching: bool) -> None:
        """Store a claim of a peer as the greatest one, and update which objects are owned and remote."""
        known = self._known[object_id]
        known.claim = claim
        known.touching = touching
        known.announced = True
        known.silent = False
        if claim.owner == self.name:
            self.owned.add(object_id)
            return
        self.owned.discard(object_id)
        if claim.owner != NO_OWNER:
            self.remote.add(object_id)

    # ------------------------------------------------------------ what follows

    def remove_actor(self, name: str, time: float, successor: Callable[[int], str]) -> None:
        """Mark the claims of an actor that has left as silent, and take over its objects whose successor is the own
        actor.

        ``successor(object_id)``: name of the actor that takes over an object. Silent claims are kept in case the actor
        returns. Without them two clients might never agree again.
        """
        for object_id in sorted(object_id for object_id, known in self._known.items() if known.claim.owner == name):
            known = self._known[object_id]
            recent = not known.silent and time - known.received_at < OWNER_TIMEOUT
            known.silent = True
            if recent and self._owning_sibling(object_id) is None and successor(object_id) == self.name:
                self.take_over(object_id)

    def shift_time(self, step: float) -> None:
        """Shift all stored times, because the network clock was set by ``step`` [s]."""
        for known in self._known.values():
            known.published_at += step
            known.received_at += step
            known.published_to_all_at += step
            known.corrected_at += step

    def expire(self, time: float) -> None:
        """Mark remote owners as silent that have timed out at ``time`` [s]. Their claims are kept."""
        for object_id in self.remote:
            known = self._known[object_id]
            if time - known.received_at > OWNER_TIMEOUT:
                known.silent = True

    def released(self) -> list[int]:
        """Returns the ids of objects that have lost their remote owner since the last call, and that this actor does
        not own."""
        released = []
        for object_id in sorted(self.remote):
            if object_id in self.owned or self.owner(object_id) is None:
                self.remote.discard(object_id)
                if object_id not in self.owned:
                    released.append(object_id)
        return released

    def corrections(self, time: float) -> list[int]:
        """Returns the ids of objects for which this actor shall publish the greatest known claim again, because a peer
        has made a lesser claim.

        The peer must have missed a message. The correction restores agreement.
        """
        losing = self._losing_claims
        self._losing_claims = []
        corrections = []
        for object_id, claim in losing:
            known = self._known[object_id]
            if claim == known.claim or authority.wins(claim, known.claim):
                continue
            is_mine_to_correct = self.owner(object_id) in (self.name, None) or authority.is_outdated(claim, known.claim)
            if is_mine_to_correct and time - known.corrected_at >= CORRECTION_PERIOD:
                known.corrected_at = time
                corrections.append(object_id)
        return corrections
