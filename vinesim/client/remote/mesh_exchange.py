"""Meshes of robots between clients, through the server: offers those of local robots, fetches those of remote ones.

All of it happens in a thread of its own, over queries of the bus, never in a tick. A mesh is asked for by its digest
and believed only if it has that digest; it goes into the cache on disk, so that it crosses the network once. The name
that a URDF of another client gives to a mesh is never used.
"""

from __future__ import annotations

import collections
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping

import numpy as np

from vinesim.core import disk_cache
from vinesim.net.codec.header import MessageError
from vinesim.net.codec.meshes import (
    MAX_PART,
    MeshPart,
    MeshWanted,
    decode_part,
    decode_wanted,
    encode_part,
    encode_request,
)
from vinesim.net.transport.bus import Bus
from vinesim.robot.description.meshes import list_meshes, read_triangles
from vinesim.scene import triangles

log = logging.getLogger(__name__)

RETRY_PERIOD = 1.0
"""Time between two rounds of questions for what is missing [s]; doubled after each round that brings nothing."""

MAX_RETRY_PERIOD = 32.0
"""Its limit [s]."""

MAX_HELD_BYTES = 256 << 20
"""Size of the received meshes of all robots that are here [B]; further ones stay boxes."""

CACHE_NAME = "mesh"
"""First part of the name of a received mesh in the cache on disk."""


class _Missing(Exception):
    """The server has no mesh of this digest now, or does not answer."""


class _RobotMeshes:
    """The meshes of one remote robot."""

    def __init__(self, urdf: str) -> None:
        self.urdf: str | None = urdf
        """None when :attr:`missing` is known."""
        self.missing: set[str] = set()
        self.received: dict[str, np.ndarray] = {}
        self.retry_period = RETRY_PERIOD
        self.retry_at = 0.0
        """Time from one round to the next [s], and when that is due (monotonic clock)."""
        self.is_changed = False
        """Meshes were received that :meth:`MeshExchange.changed` has not reported."""


class MeshExchange:
    """Offers and fetches meshes. The thread starts with the first mesh; :meth:`close` ends it."""

    def __init__(self) -> None:
        self.bus: Bus | None = None
        """Over which meshes are fetched; nothing is fetched without it, nor without a server."""
        self.received_count = 0
        """Meshes of other clients that were received, from the network or from the cache."""
        self.refused_count = 0
        """... that had another digest or were no triangles; boxes stay in their place."""
        self.refused_offers = 0
        """Own meshes that the server did not take."""
        self._offers: list[tuple[Bus, str]] = []
        self._offered: dict[int, int] = {}
        """By index in :attr:`_offers`: the admission since which the server has them."""
        self._robots: dict[str, _RobotMeshes] = {}
        self._changed: collections.deque[str] = collections.deque()
        self._refused: set[str] = set()
        self._lock = threading.Lock()
        self._wakeup = threading.Event()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    # ------------------------------------------------------------ called by the loop

    def offer(self, bus: Bus, urdf: str) -> None:
        """Let the server keep the meshes of a local robot, whose actor is on this ``bus``."""
        if "digest=" in urdf:
            self._offers.append((bus, urdf))
            self._start()

    def want(self, name: str, urdf: str) -> None:
        """Fetch the meshes of a remote robot over :attr:`bus`."""
        if "digest=" in urdf:
            with self._lock:
                self._robots[name] = _RobotMeshes(urdf)
            self._start()

    def forget(self, name: str) -> None:
        """A remote robot has left."""
        with self._lock:
            self._robots.pop(name, None)

    def changed(self) -> list[str]:
        """Robots of which meshes have arrived since the last call, as many of them as the server has."""
        names = []
        while self._changed:
            names.append(self._changed.popleft())
        return names

    def received(self, name: str) -> Mapping[str, np.ndarray]:
        """Corners [face, 3, 3] m of all meshes of a robot that have arrived, by digest; any thread may ask."""
        with self._lock:
            robot = self._robots.get(name)
            return {} if robot is None else dict(robot.received)

    def refuse(self, name: str) -> None:
        """The received meshes of a robot cannot be used: count them, and keep boxes from now on."""
        with self._lock:
            robot = self._robots.get(name)
            if robot is not None:
                self.refused_count += len(robot.received)
                robot.received.clear()
                robot.missing.clear()

    def close(self) -> None:
        """End the thread; a question under way is given up. Idempotent."""
        self._closing.set()
        self._wakeup.set()

    def _start(self) -> None:
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="mesh exchange", daemon=True)
            self._thread.start()
        self._wakeup.set()

    # ------------------------------------------------------------ the thread

    def _run(self) -> None:
        while not self._closing.is_set():
            self._wakeup.clear()
            try:
                self._offer_all()
                self._fetch_all()
            except Exception:  # meshes are not worth the client
                log.exception("an error in the exchange of meshes; tried again")
            self._wakeup.wait(RETRY_PERIOD)

    def _offer_all(self) -> None:
        """Offer the meshes of robots that the server, or one that took its place, does not have yet."""
        for i, (bus, urdf) in enumerate(list(self._offers)):
            admissions = bus.admissions
            if admissions and self._offered.get(i) != admissions and self._offer_robot(bus, urdf):
                self._offered[i] = admissions

    def _offer_robot(self, bus: Bus, urdf: str) -> bool:
        """Offer the meshes of one robot; whether the server answered."""
        for digest, mesh in list_meshes(urdf).items():
            wanted = _ask(bus, MeshPart(digest, mesh.size))
            if wanted is None:
                return False
            if not wanted.refused and wanted.offset < mesh.size:
                try:
                    payload = triangles.encode_triangles(read_triangles(mesh.file))
                except Exception as error:  # each format has errors of its own
                    log.warning("mesh %s cannot be offered to others any more: %s", mesh.file, error)
                    self.refused_offers += 1
                    continue
                while not wanted.refused and wanted.offset < len(payload) and not self._closing.is_set():
                    data = payload[wanted.offset : wanted.offset + MAX_PART]
                    wanted = _ask(bus, MeshPart(digest, len(payload), wanted.offset, data))
                    if wanted is None:
                        return False
            if wanted.refused:
                self.refused_offers += 1
                log.warning("others see a box for %s, which the server does not take: %s", mesh.file, wanted.refused)
        return True

    def _fetch_all(self) -> None:
        """One round of questions for what is missing. A robot is reported when all of its meshes that the server has
        are there, so that it is compiled as few times as possible."""
        bus = self.bus
        if bus is None or not bus.admissions:
            return
        with self._lock:
            robots = dict(self._robots)
        for name, robot in robots.items():
            if robot.urdf is not None:
                robot.missing = set(list_meshes(robot.urdf))
                robot.urdf = None
            if time.monotonic() < robot.retry_at:
                continue
            progress = False
            for digest in sorted(robot.missing):
                if self._closing.is_set() or self._robots.get(name) is not robot:
                    break
                progress |= self._receive(bus, robot, digest)
            robot.retry_period = RETRY_PERIOD if progress else min(2.0 * robot.retry_period, MAX_RETRY_PERIOD)
            robot.retry_at = time.monotonic() + (robot.retry_period if robot.missing else math.inf)
            robot.is_changed |= progress
            if robot.is_changed and not (progress and robot.missing):
                robot.is_changed = False
                self._changed.append(name)

    def _receive(self, bus: Bus, robot: _RobotMeshes, digest: str) -> bool:
        """Get one mesh from another robot, the cache or the server; whether it came."""
        with self._lock:
            known = next((one.received[digest] for one in self._robots.values() if digest in one.received), None)
            held = sum(corners.nbytes for one in self._robots.values() for corners in one.received.values())
        if known is None and digest not in self._refused:
            try:
                known = self._load(bus, digest)
            except _Missing:
                return False
            except (MessageError, triangles.TrianglesError) as error:
                self._refused.add(digest)
                log.warning("a mesh of another client cannot be used, a box stays in its place: %s", error)
        with self._lock:
            robot.missing.discard(digest)
            if known is None or held + known.nbytes > MAX_HELD_BYTES:
                self.refused_count += 1
                return False
            robot.received[digest] = known
            self.received_count += 1
        return True

    def _load(self, bus: Bus, digest: str) -> np.ndarray:
        """Corners [face, 3, 3] m of a mesh, from the cache on disk or from the server."""
        cached = (disk_cache.load(CACHE_NAME, digest) or {}).get("corners")
        if cached is not None and triangles.digest_of(cached.tobytes()) == digest:  # else another program wrote it
            return triangles.decode_triangles(cached.tobytes())
        corners = triangles.decode_triangles(_fetch(bus, digest, self._closing.is_set))
        disk_cache.keep(CACHE_NAME, digest, {"corners": corners})
        return corners


def _ask(bus: Bus, part: MeshPart) -> MeshWanted | None:
    """Offer a part of a mesh; the reply of the server, None if there was none that can be decoded."""
    for reply in bus.fetch(f"offer/{bus.name}", encode_part(part)):
        try:
            return decode_wanted(reply)
        except MessageError as error:
            log.debug("reply to an offered mesh: %s", error)
    return None


def _fetch(bus: Bus, digest: str, is_closing: Callable[[], bool]) -> bytes:
    """A mesh from the server, part by part; :class:`_Missing`, or :class:`MessageError` if it has another digest."""
    arrived = bytearray()
    size = 1
    while len(arrived) < size:
        if is_closing():
            raise _Missing
        replies = bus.fetch(f"mesh/{digest}", encode_request(len(arrived)))
        parts = [part for part in map(decode_part, replies) if part.size]
        if not parts:
            raise _Missing
        part = parts[0]
        if (part.digest, part.offset) != (digest, len(arrived)) or not part.data or (arrived and part.size != size):
            raise MessageError(f"part of mesh {part.digest[:8]} from {part.offset} B on, not of {digest[:8]}")
        arrived += part.data
        size = part.size
    payload = bytes(arrived)
    if (found := triangles.digest_of(payload)) != digest:
        raise MessageError(f"mesh {digest[:8]} has the digest {found[:8]}")
    return payload
