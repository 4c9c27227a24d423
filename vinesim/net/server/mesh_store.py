"""Meshes of robots that the server keeps for clients without their files: by digest, in memory, within bounds.

An actor offers a mesh part by part (:class:`vinesim.net.codec.meshes.MeshPart`); each reply says which part is missing
next, so that a lost message costs one repetition. What is complete is kept if its digest is right and it decodes. A
mesh that several actors offer is sent and kept once. It stays while one of them is there, and then until its room is
needed.
"""

from __future__ import annotations

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
    """Number of meshes."""
    total: int = 256 << 20
    """Size of all meshes, including parts of incomplete ones [B]."""
    per_actor: int = 64 << 20
    """Size of the meshes that one actor offers, including shared ones [B]."""
    count_per_actor: int = 256
    """Number of meshes that one actor offers."""


@dataclasses.dataclass(slots=True)
class MeshCounters:
    """Counts of offered and requested meshes, by their fate."""

    kept: int = 0
    """Meshes that were complete and right."""
    corrupt: int = 0
    """Meshes that were complete, but had another digest or were no triangles."""
    refused: int = 0
    """Offers beyond a limit."""
    served: int = 0
    """Parts sent."""


@dataclasses.dataclass(slots=True)
class _Kept:
    payload: bytes
    holders: set[Actor]
    """Present actors that have offered the mesh."""


class MeshStore:
    """Meshes by digest. All methods may be called from any thread."""

    def __init__(self, limits: MeshLimits = MeshLimits()) -> None:
        self.limits = limits
        self.counters = MeshCounters()
        self._kept: dict[str, _Kept] = {}
        """Complete meshes by digest. The mesh that was last requested or offered is the last one."""
        self._incomplete: dict[Actor, tuple[MeshPart, bytearray]] = {}
        """Mesh that each actor is sending: its first part without data, and the bytes that have arrived."""
        self._bytes = 0
        """Size of all meshes in :attr:`_kept` [B]."""
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def bytes(self) -> int:
        """Size of all meshes and incomplete meshes [B]."""
        with self._lock:
            return self._used()

    def part(self, digest: str, offset: int) -> MeshPart:
        """The part of a mesh that begins at ``offset`` [B]; one of size 0 if there is no such mesh."""
        with self._lock:
            kept = self._kept.pop(digest, None)
            if kept is None:
                return MeshPart(digest, 0)
            self._kept[digest] = kept
            self.counters.served += 1
        size = len(kept.payload)
        offset = min(offset, size)
        return MeshPart(digest, size, offset, kept.payload[offset : offset + MAX_PART])

    def offer(self, actor: Actor, part: MeshPart) -> MeshWanted:
        """Take a part that an actor offers. Returns the part that the actor shall send next."""
        with self._lock:
            kept = self._kept.get(part.digest)
            if kept is not None:
                if refused := "" if actor in kept.holders else self._objection(actor, len(kept.payload), 0):
                    return self._refuse(actor, refused)
                self._incomplete.pop(actor, None)
                kept.holders.add(actor)
                return MeshWanted(len(kept.payload))
            begun, arrived = self._incomplete.get(actor, (None, bytearray()))
            if begun is None or (begun.digest, begun.size) != (part.digest, part.size):
                self._incomplete.pop(actor, None)
                if refused := self._objection(actor, part.size, part.size):
                    return self._refuse(actor, refused)
                begun, arrived = self._incomplete[actor] = MeshPart(part.digest, part.size), bytearray()
            if part.offset == len(arrived):
                arrived += part.data
            if len(arrived) < part.size:
                return MeshWanted(len(arrived))
            del self._incomplete[actor]
        return self._complete(actor, part, bytes(arrived))

    def release(self, actor: Actor) -> None:
        """Note that an actor has left. Meshes that only it offered may be removed to make room for others."""
        with self._lock:
            self._incomplete.pop(actor, None)
            for kept in self._kept.values():
                kept.holders.discard(actor)

    def _complete(self, actor: Actor, part: MeshPart, payload: bytes) -> MeshWanted:
        """Keep a mesh that has arrived completely, if its content has its digest."""
        try:  # without the lock: of a large mesh this takes milliseconds
            if digest_of(payload) != part.digest:
                raise TrianglesError("its digest is another")
            decode_triangles(payload)
        except TrianglesError as error:
            self.counters.corrupt += 1
            return self._refuse(actor, f"mesh {part.digest[:8]} is corrupt: {error}", is_limit=False)
        with self._lock:
            if part.digest not in self._kept:
                if refused := self._objection(actor, len(payload), len(payload)):
                    return self._refuse(actor, refused)
                self._kept[part.digest] = _Kept(payload, set())
                self._bytes += len(payload)
                self.counters.kept += 1
            self._kept[part.digest].holders.add(actor)
        return MeshWanted(len(payload))

    def _used(self) -> int:
        return self._bytes + sum(begun.size for begun, _ in self._incomplete.values())

    def _objection(self, actor: Actor, size: int, room: int) -> str:
        """Why an actor may not offer a mesh of this ``size`` [B]; empty if it may. Makes ``room`` [B] if need be."""
        limits = self.limits
        own = [len(kept.payload) for kept in self._kept.values() if actor in kept.holders]
        if not 1 <= size <= MAX_BYTES:
            return f"a mesh of {size} B, at most {MAX_BYTES} B"
        if len(own) >= limits.count_per_actor or sum(own) + size > limits.per_actor:
            return f"more than {limits.count_per_actor} meshes or {limits.per_actor >> 20} MiB of one actor"
        unused = [digest for digest, kept in self._kept.items() if not kept.holders]
        while room and (len(self._kept) >= limits.count or self._used() + room > limits.total):
            if not unused:
                return f"the server keeps {len(self._kept)} meshes, {self._used() >> 20} MiB, and has no room"
            self._bytes -= len(self._kept.pop(unused.pop(0)).payload)
        return ""

    def _refuse(self, actor: Actor, reason: str, *, is_limit: bool = True) -> MeshWanted:
        """Refuse an offer, and log the first refusal."""
        if is_limit:
            self.counters.refused += 1
        if self.counters.refused + self.counters.corrupt == 1:
            log.warning("refused a mesh of %s/%s (further ones are only counted): %s", *actor, reason)
        return MeshWanted(0, reason)
