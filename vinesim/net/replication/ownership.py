"""What one client knows of who owns what: the greatest claim on each thing, and what follows from it.

The order of claims is :mod:`vinesim.net.replication.authority`'s. Here are the rules around it: what counts as heard,
who is silent, who takes over, and which claims deserve a correction. Times are network time [s].
"""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Callable, Container

from vinesim.net.replication import authority, dead_reckoning
from vinesim.net.replication.authority import NOBODY, UNTOUCHED, Claim

CORRECTION_PERIOD = 0.2
"""Between two corrections of the same thing [s]."""

OWNER_TIMEOUT = 3.0
"""An owner that says nothing of its thing for so long [s] (three heartbeats) is believed to own it no more."""

LONG_AGO = -1e9


@dataclasses.dataclass(slots=True)
class ObjectRecord:
    """What was last said of one thing, by me or by its owner."""

    claim: Claim = UNTOUCHED
    touching: bool = False
    """Whether its owner is in contact with it."""
    before: Claim = UNTOUCHED
    """What held before I took it."""
    announced: bool = False
    """Whether anybody else can have heard of the claim."""
    silent: bool = False
    """Its owner is gone, or was not heard for long: the claim holds, should it come back, but it owns no more."""
    said_at: float = LONG_AGO
    """When the newest record was made."""
    heard_at: float = LONG_AGO
    said_to: int = 0
    """How many were near when I last spoke of it."""
    answered: float = LONG_AGO


class Ownership:
    """The claims on all things that anybody ever touched."""

    def __init__(self, me: str, live: Container[str]) -> None:
        """``live``: the other actors who are here, kept by somebody else."""
        self.name = me
        self._live = live
        self._known: collections.defaultdict[int, ObjectRecord] = collections.defaultdict(ObjectRecord)
        self.owned: set[int] = set()
        self.remote: set[int] = set()
        self._lost: list[tuple[int, Claim]] = []

    # ------------------------------------------------------------ questions

    @property
    def known(self) -> list[int]:
        """All things that anybody ever touched."""
        return list(self._known)

    def __getitem__(self, thing: int) -> ObjectRecord:
        return self._known[thing]

    def claim(self, thing: int) -> Claim:
        """The greatest claim that was made or heard."""
        return self._known[thing].claim if thing in self._known else UNTOUCHED

    def owner(self, thing: int) -> str | None:
        """Who owns a thing now: a live actor's name (perhaps one's own), or None."""
        if thing not in self._known:
            return None
        known = self._known[thing]
        owner = known.claim.owner
        if owner == self.name:
            return owner
        return owner if owner in self._live and not known.silent else None

    # ------------------------------------------------------------ what I do

    def touch(self, thing: int) -> None:
        """I am in contact with it: mine, unless its living owner touches it as well."""
        known = self._known[thing]
        taken = authority.claim_by_touch(known.claim, self.name, self.owner(thing) is not None and known.touching)
        if taken is not known.claim:
            self._take(thing, taken)

    def grab(self, thing: int) -> None:
        """I grabbed, picked or cut it: mine, whoever had it."""
        self._take(thing, authority.claim_by_grab(self.claim(thing), self.name))

    def take_over(self, thing: int) -> None:
        """Its owner is gone or there is none: mine."""
        self._take(thing, authority.claim_by_touch(self.claim(thing), self.name, False))

    def _take(self, thing: int, claim: Claim) -> None:
        known = self._known[thing]
        if thing not in self.owned or known.announced:
            known.before = known.claim
        known.claim, known.touching, known.announced, known.silent, known.said_to = claim, True, False, False, 0
        self.owned.add(thing)

    def release(self, thing: int) -> Claim:
        """What I moved lies still; the claim under which I say so."""
        known = self._known[thing]
        held = known.claim
        self.owned.discard(thing)
        known.claim, known.touching = authority.release(held), False
        return held

    def increment(self, thing: int) -> None:
        """Count one up, still mine: a fact about it is coming, and no two facts share a claim."""
        known = self._known[thing]
        known.claim = known.claim._replace(authority=(known.claim.authority + 1) % authority.SEQUENCE_COUNT)

    def rollback(self, thing: int) -> None:
        """Nobody ever heard of the claim: as if it had not been, so that sequences only count what was said."""
        known = self._known[thing]
        known.claim = authority.release(known.before) if known.before.owner == self.name else known.before
        known.silent = True

    # ------------------------------------------------------------ what others say

    def receive_state(self, thing: int, claim: Claim, touching: bool, said_at: float, time: float) -> bool:
        """Judge a record by its claim; whether its state is to be believed. The name of a thing at rest is nobody's."""
        known = self._known[thing]
        said_at = min(said_at, time + dead_reckoning.MAX_CLOCK_SKEW)
        fresh = said_at > known.said_at
        if claim != known.claim and not authority.wins(claim, known.claim):
            if fresh and claim.owner != NOBODY:
                self._lost.append((thing, claim))
            return False
        if not fresh and claim == known.claim:
            return False
        self._adopt(thing, claim, touching)
        known.said_at, known.heard_at = said_at, time
        return True

    def receive_claim(self, thing: int, claim: Claim, touching: bool, sender: str, time: float) -> None:
        """A claim, made by its sender or repeated by it as a correction."""
        known = self._known[thing]
        if claim == known.claim and claim.owner != sender:
            return
        if claim == known.claim or authority.wins(claim, known.claim):
            self._adopt(thing, claim, touching)
            known.heard_at = time
        elif claim.owner == sender:
            self._lost.append((thing, claim))

    def receive_retained(self, thing: int, claim: Claim, touching: bool, time: float) -> bool:
        """A claim that comes with a fact; whether where it says the thing is holds now."""
        known = self._known[thing]
        if claim != known.claim and not authority.wins(claim, known.claim):
            return False
        self._adopt(thing, claim, touching)
        known.heard_at = time
        return True

    def _adopt(self, thing: int, claim: Claim, touching: bool) -> None:
        """Hold a claim that somebody else made or reported."""
        known = self._known[thing]
        known.claim, known.touching, known.announced, known.silent = claim, touching, True, False
        if claim.owner == self.name:
            self.owned.add(thing)
            return
        self.owned.discard(thing)
        if claim.owner != NOBODY:
            self.remote.add(thing)

    # ------------------------------------------------------------ what follows

    def remove_actor(self, name: str, time: float, heir: Callable[[int], str]) -> None:
        """An actor is gone: what it still moved goes to its ``heir``.

        Its claims still hold, should it come back; only its silence counts, or two would never agree again.
        """
        for thing in sorted(thing for thing, known in self._known.items() if known.claim.owner == name):
            known = self._known[thing]
            recent = not known.silent and time - known.heard_at < OWNER_TIMEOUT
            known.silent = True
            if recent and heir(thing) == self.name:
                self.take_over(thing)

    def expire(self, time: float) -> None:
        """Owners who fell silent own no more, until they are heard again: their claim still holds."""
        for thing in self.remote:
            known = self._known[thing]
            if time - known.heard_at > OWNER_TIMEOUT:
                known.silent = True

    def released(self) -> list[int]:
        """Things another actor owned until now and nobody does any more."""
        free = []
        for thing in sorted(self.remote):
            if thing in self.owned or self.owner(thing) is None:
                self.remote.discard(thing)
                if thing not in self.owned:
                    free.append(thing)
        return free

    def corrections(self, time: float) -> list[int]:
        """Things that somebody claimed from old knowledge: saying what holds is how everybody agrees after a loss."""
        lost, self._lost = self._lost, []
        wrong = []
        for thing, claim in lost:
            known = self._known[thing]
            if claim == known.claim or authority.wins(claim, known.claim):
                continue
            mine_to_say = self.owner(thing) in (self.name, None) or authority.is_outdated(claim, known.claim)
            if mine_to_say and time - known.answered >= CORRECTION_PERIOD:
                known.answered = time
                wrong.append(thing)
        return wrong
