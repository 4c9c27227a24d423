"""Publish, subscribe and query on one world: the :class:`Bus` protocol that Zenoh, memory and recordings implement.

Keys are relative to the world, chunks joined by ``/``. In a key expression ``*`` matches one chunk and ``**`` any
number (Zenoh's grammar without ``$*``). A bus never calls back into the real-time loop: samples are stored on arrival
and :meth:`Bus.poll` returns them. Every member has a name, whose liveliness token holds from construction to
:meth:`Bus.close`.
"""

from __future__ import annotations

import collections
import functools
import threading
from collections.abc import Callable
from typing import NamedTuple, Protocol

from vinesim.audio.hearing import SpectatorsSpeakTo

KEEP_LAST_1 = 1
"""History depth that keeps the newest sample of each key: poses."""

KEEP_LAST_64 = 64
"""History depth that keeps the last samples of each key, in order: records that complete each other."""

KEEP_ALL = 10_000
"""History depth that keeps all samples, in order: events. The number only bounds memory in a flood."""

MAX_STORED_BYTES = 64 << 20
"""Largest size of the payloads that wait to be polled [B]."""


class BusError(RuntimeError):
    """The network cannot be used as requested; the text gives the cause, the place and the remedy."""

    exit_code = 4


class NameTaken(BusError):
    """Another live actor has this name."""

    def __init__(self, name: str, world: str) -> None:
        super().__init__(
            f"an actor named {name!r} is already live in world {world!r}: choose another name or stop that one"
        )


class JoinRejected(BusError):
    """The server rejects this actor. The text is the server's reason."""


class Reply(NamedTuple):
    """One reply to :meth:`Bus.query`."""

    key: str
    payload: bytes
    age: float
    """Time since it arrived [s]."""


class Publisher(Protocol):
    """Sends samples under one exact key."""

    @property
    def matching(self) -> bool:
        """Whether another member subscribes to this key now."""
        ...

    def put(self, payload: bytes) -> bool:
        """Send without blocking. Without a subscriber, nothing is sent or counted, and the result is False."""
        ...

    def close(self) -> None:
        """Undeclare the publisher."""


class Subscription(Protocol):
    """Receives samples under a key expression; :meth:`Bus.poll` returns them."""

    def close(self) -> None:
        """Undeclare the subscription; samples that have arrived stay until polled."""


class Bus(Protocol):
    """Membership of one actor in one world on the network."""

    name: str
    bytes_in: int
    """Payload bytes received."""
    bytes_out: int
    """Payload bytes sent; without a subscriber nothing is sent."""

    @property
    def dropped(self) -> int:
        """Number of received samples that were discarded because the store was full or the sample too large."""
        ...

    foreign: int
    """Number of samples and replies that were dropped because their session does not hold the name in their key."""
    failures: int
    """Number of puts, declarations and queries that the network refused. None of them raises."""

    @property
    def status_message(self) -> str:
        """Returns why the network is unreachable now, or "" if it is reachable."""
        ...

    def join(self, greeting: bytes) -> None:
        """Ask the server for admission with an encoded :class:`~vinesim.net.codec.control.Hello`, once, before anything
        else is sent.

        Raises :class:`JoinRejected`. Without a server the actors check each other
        (:mod:`vinesim.net.replication.peers`).
        """

    def publisher(self, key: str, reliable: bool = False) -> Publisher:
        """Declare a publisher of one exact key. Reliable: in order and without loss while the connection lives."""
        ...

    def subscribe(self, pattern: str, depth: int = KEEP_LAST_1) -> Subscription:
        """Receive samples of other members: the last ``depth`` of each key until polled. A sample under the name of an
        actor comes from the session that holds this name (:mod:`vinesim.net.transport.name_holders`).

        Reliable samples need ``KEEP_ALL``: they use another session than poses.
        """
        ...

    def poll(self) -> list[tuple[str, bytes]]:
        """All (key, payload) that arrived since the last call, in order of arrival."""
        ...

    def query(self, key: str, payload: bytes = b"") -> None:
        """Send a query to all queryables that match ``key``. :meth:`replies` returns the replies, if any arrive."""

    def replies(self) -> list[Reply]:
        """Replies that arrived since the last call."""
        ...

    def fetch(self, key: str, payload: bytes = b"") -> list[bytes]:
        """Ask all queryables that match ``key`` and wait for their replies, some seconds at most: not for the real-time
        loop. Any thread may call it; it delays no other message, and returns nothing if the network fails."""
        ...

    @property
    def spectators_speak_to(self) -> SpectatorsSpeakTo:
        """Who hears spectators in this world, as the server has set it. People, if the server has not set it."""
        ...

    @property
    def admissions(self) -> int:
        """How often a server has admitted this actor: 0 without a server, one more whenever a server starts again."""
        ...

    def declare_queryable(self, key: str, respond: Callable[[bytes], bytes]) -> None:
        """Reply to queries for ``key``; ``respond`` is called from any thread and must return quickly."""

    def alive(self) -> frozenset[str]:
        """Names of all live actors, including this one."""
        ...

    def close(self) -> None:
        """Leave the world. Idempotent."""


@functools.lru_cache(maxsize=65536)
def matches(pattern: str, key: str) -> bool:
    """Whether a key expression matches a key."""
    return _covers(tuple(pattern.split("/")), tuple(key.split("/")))


def _covers(pattern: tuple[str, ...], key: tuple[str, ...]) -> bool:
    if not pattern:
        return not key
    if pattern[0] == "**":
        return any(_covers(pattern[1:], key[skip:]) for skip in range(len(key) + 1))
    return bool(key) and pattern[0] in ("*", key[0]) and _covers(pattern[1:], key[1:])


class SampleStore:
    """Queue of received samples between a network thread, which puts, and the real-time loop, which takes."""

    def __init__(self) -> None:
        self._samples: collections.deque[tuple[int, str, bytes]] = collections.deque()
        self._bytes = 0
        self._lock = threading.Lock()
        self.overflowed = 0

    def put(self, depth: int, key: str, payload: bytes) -> None:
        """Append a sample that was received with this history depth; the oldest ones make room for it."""
        with self._lock:
            self._samples.append((depth, key, payload))
            self._bytes += len(payload)
            while len(self._samples) > KEEP_ALL or (self._bytes > MAX_STORED_BYTES and len(self._samples) > 1):
                self._bytes -= len(self._samples.popleft()[2])
                self.overflowed += 1

    def take(self) -> list[tuple[str, bytes]]:
        """Remove and return all samples in order of arrival. Samples beyond the depth of their key are dropped."""
        with self._lock:
            taken = self._samples
            self._samples = collections.deque()
            self._bytes = 0
        left: dict[str, int] = {}
        kept = []
        for depth, key, payload in reversed(taken):
            free = left.get(key, depth)
            left[key] = free - 1
            if free > 0:
                kept.append((key, payload))
        kept.reverse()
        return kept
