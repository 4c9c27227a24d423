"""Exchanges meshes of robots through the server: offers the meshes of local robots, fetches those of remote robots.

It runs in its own thread, with queries on the bus, never in a tick. A mesh is requested by its digest and accepted only
with this digest. It is stored in the disk cache, so it is transferred only once. File names of meshes in a URDF of
another client are never used.
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
from vinesim.robot.description.meshes import list_meshes
from vinesim.scene import triangles
from vinesim.scene.appearance.mesh_files import read_triangles

log = logging.getLogger(__name__)

RETRY_PERIOD = 1.0
"""Time between two rounds of requests for missing meshes [s]; it doubles after each round without success."""

MAX_RETRY_PERIOD = 32.0
"""Largest time between two rounds of requests [s]."""

MAX_HELD_BYTES = 256 << 20
"""Largest total size of received meshes of all present robots [B]; boxes replace further meshes."""

CACHE_NAME = "mesh"
"""First part of the name of a received mesh in the disk cache."""


class _Missing(Exception):
    """The server has no mesh with this digest, or does not answer."""


class _RobotMeshes:
    """The meshes of one remote robot."""

    def __init__(self, urdf: str) -> None:
        self.urdf: str | None = urdf
        """URDF text; None after :attr:`missing` was read from it."""
        self.missing: set[str] = set()
        self.received: dict[str, np.ndarray] = {}
        self.retry_period = RETRY_PERIOD
        """Time from one round of requests to the next [s]."""
        self.retry_at = 0.0
        """Time of the next round [s, monotonic clock]."""
        self.is_changed = False
        """Whether meshes were received that :meth:`MeshExchange.changed` has not reported yet."""


class MeshExchange:
    """Offers and fetches meshes. The thread starts with the first mesh; :meth:`close` ends it."""

    def __init__(self) -> None:
        self.bus: Bus | None = None
        """Bus for fetching meshes; nothing is fetched without a bus or without a server."""
        self.received_count = 0
        """Number of meshes of other clients that were received, from the network or from the cache."""
        self.refused_count = 0
        """Number of meshes of other clients refused for a wrong digest or invalid triangles; boxes replace them."""
        self.refused_offers = 0
        """Number of meshes of local robots that the server did not accept."""
        self._offers: list[tuple[Bus, str]] = []
        self._offered: dict[int, int] = {}
        """Number of the admission at the server since which the server has the meshes, by index in :attr:`_offers`."""
        self._robots: dict[str, _RobotMeshes] = {}
        self._changed: collections.deque[str] = collections.deque()
        self._refused: set[str] = set()
        self._lock = threading.Lock()
        self._wakeup = threading.Event()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    # ------------------------------------------------------------ called by the loop

    def offer(self, bus: Bus, urdf: str) -> None:
        """Offer the server the meshes of a local robot, whose actor uses ``bus``."""
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
        """Forget a remote robot that has left."""
        with self._lock:
            self._robots.pop(name, None)

    def changed(self) -> list[str]:
        """Returns the robots that, since the last call, have received all their meshes that the server has."""
        names = []
        while self._changed:
            names.append(self._changed.popleft())
        return names

    def received(self, name: str) -> Mapping[str, np.ndarray]:
        """Returns corners [face, 3, 3] m of the received meshes of a robot, by digest. Safe from any thread."""
        with self._lock:
            robot = self._robots.get(name)
            return {} if robot is None else dict(robot.received)

    def refuse(self, name: str) -> None:
        """Count the received meshes of a robot as unusable, and stop using them, so that boxes replace them."""
        with self._lock:
            robot = self._robots.get(name)
            if robot is not None:
                self.refused_count += len(robot.received)
                robot.received.clear()
                robot.missing.clear()

    def close(self) -> None:
        """End the thread; a running request is abandoned. Further calls do nothing."""
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
            except Exception:  # failures with meshes must not end the client
                log.exception("an error in the exchange of meshes; tried again")
            self._wakeup.wait(RETRY_PERIOD)

    def _offer_all(self) -> None:
        """Offer the meshes of robots that the present server does not have yet."""
        for i, (bus, urdf) in enumerate(list(self._offers)):
            admissions = bus.admissions
            if admissions and self._offered.get(i) != admissions and self._offer_robot(bus, urdf):
                self._offered[i] = admissions

    def _offer_robot(self, bus: Bus, urdf: str) -> bool:
        """Offer the meshes of one robot. Returns whether the server answered."""
        for digest, mesh in list_meshes(urdf).items():
            wanted = _ask(bus, MeshPart(digest, mesh.size))
            if wanted is None:
                return False
            if not wanted.refused and wanted.offset < mesh.size:
                try:
                    payload = triangles.encode_triangles(read_triangles(mesh.file))
                except Exception as error:  # each mesh format raises its own errors
                    log.warning("mesh %s can no longer be offered to other clients: %s", mesh.file, error)
                    self.refused_offers += 1
                    continue
                while not wanted.refused and wanted.offset < len(payload) and not self._closing.is_set():
                    data = payload[wanted.offset : wanted.offset + MAX_PART]
                    wanted = _ask(bus, MeshPart(digest, len(payload), wanted.offset, data))
                    if wanted is None:
                        return False
            if wanted.refused:
                self.refused_offers += 1
                log.warning("the server refused %s, so other clients show a box: %s", mesh.file, wanted.refused)
        return True

    def _fetch_all(self) -> None:
        """Request all missing meshes once.

        A robot is reported when all its meshes on the server have arrived, so that it is compiled as rarely as
        possible.
        """
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
        """Get one mesh from another robot, the cache or the server. Returns whether it was received."""
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
                log.warning("a mesh of another client cannot be used, a box replaces it: %s", error)
        with self._lock:
            robot.missing.discard(digest)
            if known is None or held + known.nbytes > MAX_HELD_BYTES:
                self.refused_count += 1
                return False
            robot.received[digest] = known
            self.received_count += 1
        return True

    def _load(self, bus: Bus, digest: str) -> np.ndarray:
        """Returns corners [face, 3, 3] m of a mesh, from the disk cache or from the server."""
        cached = (disk_cache.load(CACHE_NAME, digest) or {}).get("corners")
        if cached is not None and triangles.digest_of(cached.tobytes()) == digest:  # otherwise another program wrote it
            return triangles.decode_triangles(cached.tobytes())
        corners = triangles.decode_triangles(_fetch(bus, digest, self._closing.is_set))
        disk_cache.keep(CACHE_NAME, digest, {"corners": corners})
        return corners


def _ask(bus: Bus, part: MeshPart) -> MeshWanted | None:
    """Offer a part of a mesh. Returns the server's reply, or None if no reply came that can be decoded."""
    for reply in bus.fetch(f"offer/{bus.name}", encode_part(part)):
        try:
            return decode_wanted(reply)
        except MessageError as error:
            log.debug("reply to an offered mesh: %s", error)
    return None


def _fetch(bus: Bus, digest: str, is_closing: Callable[[], bool]) -> bytes:
    """Fetch a mesh from the server, part by part.

    Raises :class:`_Missing`, or :class:`MessageError` if the mesh has another digest.
    """
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
