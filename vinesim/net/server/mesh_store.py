"""Store of robots' meshes on the server, in memory, for clients that do not have the files.

An actor offers a mesh part by part (:class:`vinesim.net.codec.meshes.MeshPart`). Each reply names the next missing
part, so a lost message costs one repetition. A complete mesh is kept if it has the stated digest and can be decoded. A
mesh that several actors offer is sent and kept once. It is kept while one of these actors is present, and afterwards
until the store needs the memory.

No actor can fill the store for others: if there is no room, an actor gets the room of the group (all actors of one
address, or an actor of this machine) that holds most, as long as its own group then holds less than that one.
"""

from __future__ import annotations

import collections
import dataclasses
import logging
import threading

from vinesim.net.codec.meshes import MAX_PART, MeshPart, MeshWanted
from vinesim.scene.triangles import MAX_BYTES, TrianglesError, decode_triangles, digest_of

log = logging.getLogger(__name__)

Actor = tuple[str, str]
"""World and name of an actor."""


@dataclasses.dataclass(frozen=True)
class MeshLimits:
    """Limits for the meshes that the server keeps."""

    count: int = 4096
    """Largest number of meshes in the store."""
    total: int = 256 << 20
    """Largest size of all meshes together [B], including incomplete ones."""
    per_actor: int = 64 << 20
    """Largest size of all meshes that one actor offers [B], including meshes that other actors offer, too."""
    count_per_actor: int = 256
    """Largest number of meshes that one actor offers."""


@dataclasses.dataclass(slots=True)
class MeshCounters:
    """Counters of offered and requested meshes."""

    kept: int = 0
    """Number of meshes that arrived completely and were kept."""
    corrupt: int = 0
    """Number of meshes that arrived completely, but had another digest or could not be decoded."""
    refused: int = 0
    """Number of offers that were refused because of a limit."""
    served: int = 0
    """Number of parts that were sent to clients."""


@dataclasses.dataclass(slots=True)
class _Kept:
    """A complete mesh in the store."""

    payload: bytes
    holders: dict[Actor, str]
    """Present actors that have offered the mesh, and the group of each."""


class MeshStore:
    """The meshes that the server keeps, by digest. All methods may be called from any thread."""

    def __init__(self, limits: MeshLimits = MeshLimits()) -> None:
        self.limits = limits
        self.counters = MeshCounters()
        self._kept: dict[str, _Kept] = {}
        """Complete meshes by digest, in the order of their last request or offer."""
        self._incomplete: dict[Actor, tuple[MeshPart, bytearray, str]] = {}
        """Incomplete mesh that each actor is sending: its first part without data, all bytes that have arrived, and the
        group of the actor."""
        self._bytes = 0
        """Size of all meshes in :attr:`_kept` [B]."""
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def bytes(self) -> int:
        """Size of all complete and incomplete meshes [B]."""
        with self._lock:
            return self._used()

    def part(self, digest: str, offset: int) -> MeshPart:
        """Returns the part of a mesh that begins at ``offset`` [B]; if the mesh is not in the store, one whose ``size``
        is 0."""
        with self._lock:
            kept = self._kept.pop(digest, None)
            if kept is None:
                return MeshPart(digest, 0)
            self._kept[digest] = kept
            self.counters.served += 1
        size = len(kept.payload)
        offset = min(offset, size)
        return MeshPart(digest, size, offset, kept.payload[offset : offset + MAX_PART])

    def offer(self, actor: Actor, part: MeshPart, group: str = "") -> MeshWanted:
        """Store a part of a mesh that an actor offers. Returns the reply, which names the part that the actor shall
        send next. ``group``: of which the actor is a part when room is short; empty: the actor alone."""
        group = group or "/".join(actor)
        with self._lock:
            kept = self._kept.get(part.digest)
            if kept is not None:
                if refused := "" if actor in kept.holders else self._objection(actor, group, len(kept.payload), 0):
                    return self._refuse(actor, refused)
                self._incomplete.pop(actor, None)
                kept.holders[actor] = group
                return MeshWanted(len(kept.payload))
            begun, arrived, _ = self._incomplete.get(actor, (None, bytearray(), ""))
            if begun is None or (begun.digest, begun.size) != (part.digest, part.size):
                self._incomplete.pop(actor, None)
                if refused := self._objection(actor, group, part.size, part.size):
                    return self._refuse(actor, refused)
                begun, arrived, _ = self._incomplete[actor] = MeshPart(part.digest, part.size), bytearray(), group
            if part.offset == len(arrived):
                arrived += part.data
            if len(arrived) < part.size:
                return MeshWanted(len(arrived))
            del self._incomplete[actor]
        return self._complete(actor, group, part, bytes(arrived))

    def release(self, actor: Actor) -> None:
        """Note that an actor has left. Meshes that no other live actor offered may then be removed to make room."""
        with self._lock:
            self._incomplete.pop(actor, None)
            for kept in self._kept.values():
                kept.holders.pop(actor, None)

    def _complete(self, actor: Actor, group: str, part: MeshPart, payload: bytes) -> MeshWanted:
        """Keep a mesh that has arrived completely, if it has the stated digest and can be decoded. Returns the
        reply."""
        try:  # without the lock: decoding a large mesh takes milliseconds
            if digest_of(payload) != part.digest:
                raise TrianglesError("its digest is another")
            decode_triangles(payload)
        except TrianglesError as error:
            self.counters.corrupt += 1
            return self._refuse(actor, f"mesh {part.digest[:8]} is corrupt: {error}", is_limit=False)
        with self._lock:
            if part.digest not in self._kept:
                if refused := self._objection(actor, group, len(payload), len(payload)):
                    return self._refuse(actor, refused)
                self._kept[part.digest] = _Kept(payload, {})
                self._bytes += len(payload)
                self.counters.kept += 1
            self._kept[part.digest].holders[actor] = group
        return MeshWanted(len(payload))

    def _used(self) -> int:
        return self._bytes + sum(begun.size for begun, _, _ in self._incomplete.values())

    def _objection(self, actor: Actor, group: str, size: int, room: int) -> str:
        """Returns the reason why an actor may not offer a mesh of ``size`` [B]; empty if it may.

        If fewer than ``room`` [B] are free, removes meshes of actors that have left, then those of the group that holds
        most.
        """
        limits = self.limits
        own = [len(kept.payload) for kept in self._kept.values() if actor in kept.holders]
        if not 1 <= size <= MAX_BYTES:
            return f"a mesh of {size} B, at most {MAX_BYTES} B"
        if len(own) >= limits.count_per_actor or sum(own) + size > limits.per_actor:
            return f"more than {limits.count_per_actor} meshes or {limits.per_actor >> 20} MiB of one actor"
        unused = [digest for digest, kept in self._kept.items() if not kept.holders]
        while room and (len(self._kept) >= limits.count or self._used() + room > limits.total):
            if not unused:
                if self._take_from_largest(group, room):
                    continue
                return f"the server keeps {len(self._kept)} meshes, {self._used() >> 20} MiB, and has no room"
            self._bytes -= len(self._kept.pop(unused.pop(0)).payload)
        return ""

    def _take_from_largest(self, group: str, room: int) -> bool:
        """Remove one mesh of the group that holds most. Returns whether that was done: not if ``group`` would hold more
        than that group with further ``room`` [B]."""
        held: collections.Counter[str] = collections.Counter()
        for kept in self._kept.values():
            for one in set(kept.holders.values()):
                held[one] += len(kept.payload)
        for begun, _, one in self._incomplete.values():
            held[one] += begun.size
        largest, most = max(held.items(), key=lambda item: item[1], default=(group, 0))
        if held[group] + room >= most:
            return False
        for actor, (_, _, one) in self._incomplete.items():
            if one == largest:
                del self._incomplete[actor]
                return True
        for digest, kept in self._kept.items():
            if set(kept.holders.values()) == {largest}:
                self._bytes -= len(self._kept.pop(digest).payload)
                return True
        return False

    def _refuse(self, actor: Actor, reason: str, *, is_limit: bool = True) -> MeshWanted:
        """Count a refused offer, log the first one, and return the reply that refuses it."""
        if is_limit:
            self.counters.refused += 1
        if self.counters.refused + self.counters.corrupt == 1:
            log.warning("refused a mesh of %s/%s (further ones are only counted): %s", *actor, reason)
        return MeshWanted(0, reason)
