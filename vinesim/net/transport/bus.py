"""The :class:`Bus` protocol: publish, subscribe and query in one world. Implemented over Zenoh, in memory and by
replays.

Keys are relative to the world. Their chunks are separated by ``/``. In a key expression ``*`` matches one chunk and
``**`` any number of chunks (Zenoh's grammar without ``$*``). A bus never calls back into the real-time loop: samples
are stored on arrival, and :meth:`Bus.poll` returns them. Every member of the world has a name. The liveliness token of
the name exists from construction of the bus to :meth:`Bus.close`.
"""

from __future__ import annotations

import collections
import functools
import threading
from collections.abc import Callable
from typing import NamedTuple, Protocol

from vinesim.audio.hearing import SpectatorsSpeakTo

KEEP_LAST_1 = 1
"""History depth that keeps only the newest sample of each key. For poses."""

KEEP_LAST_64 = 64
"""History depth that keeps the last 64 samples of each key, in order. For messages that complete each other."""

KEEP_ALL = 10_000
"""History depth that keeps all samples of each key, in order. For events. The number only bounds the memory."""

MIN_REPLACED = KEEP_ALL // 10
"""Number of samples with a smaller depth than ``KEEP_ALL`` after which a full :class:`SampleStore` looks for those that
newer ones replace. A look takes some ms, so that it costs some us a sample. GUESSED."""

MAX_STORED_BYTES = 64 << 20
"""Largest size of all payloads that wait for :meth:`Bus.poll` [B]."""


SENDER_RATE = 400.0
"""Rate of messages that one client accepts of one actor [1/s]. GUESSED: 60 poses, and 60 states of moving things in
each of five cells, with what belongs to them."""

SENDER_BURST = 1000.0
"""Number of messages that one client accepts of one actor at once, after a silence."""

MAX_SENDERS = 1024
"""Number of senders at which those that have been silent are forgotten."""


class BusError(RuntimeError):
    """The network cannot be used as requested. The text gives the cause, the place and what to do."""

    exit_code = 4


class NameTaken(BusError):
    """An actor cannot join because another live actor has its name."""

    def __init__(self, name: str, world: str) -> None:
        super().__init__(
            f"an actor named {name!r} is already live in world {world!r}: choose another name or stop that one"
        )


class JoinRejected(BusError):
    """The server does not admit an actor. The text is the server's reason."""


class Reply(NamedTuple):
    """One reply to :meth:`Bus.query`."""

    key: str
    payload: bytes
    age: float
    """Time since the reply arrived [s]."""


class Publisher(Protocol):
    """Sends samples under one key, which has no wildcards."""

    @property
    def matching(self) -> bool:
        """Whether another member of the world subscribes to the key now."""
        ...

    def put(self, payload: bytes) -> bool:
        """Send a sample without blocking. Returns False, and sends and counts nothing, if there is no subscriber."""
        ...

    def close(self) -> None:
        """Undeclare the publisher."""


class Subscription(Protocol):
    """Receives samples under a key expression. :meth:`Bus.poll` returns the samples."""

    def close(self) -> None:
        """Undeclare the subscription. :meth:`Bus.poll` still returns samples that arrived before."""


class Bus(Protocol):
    """Connection of one actor to one world on the network."""

    name: str
    bytes_in: int
    """Number of payload bytes that were received."""
    bytes_out: int
    """Number of payload bytes that were sent. Without a subscriber nothing is sent."""

    @property
    def dropped(self) -> int:
        """Number of received samples that were discarded because the store was full or the sample too large."""
        ...

    foreign: int
    """Number of samples and replies that were dropped because another session holds the name in their key."""

    @property
    def missed(self) -> int:
        """Number of signs that reliable samples did not arrive: samples of subscriptions with the depth ``KEEP_ALL``
        that were discarded for any reason, and names that were not live for a while, because a connection between
        others was lost."""
        ...

    failures: int
    """Number of puts, declarations and queries that failed on the network. They are counted and raise nothing."""

    @property
    def status_message(self) -> str:
        """Reason why the network is unreachable now; empty if it is reachable."""
        ...

    def join(self, greeting: bytes) -> None:
        """Ask the server to admit this actor. Call it once, before anything else is sent.

        ``greeting``: encoded :class:`~vinesim.net.codec.control.Hello`. Raises :class:`JoinRejected` if the server does
        not admit the actor. Without a server the actors check each other (:mod:`vinesim.net.replication.peers`).
        """

    def publisher(self, key: str, reliable: bool = False) -> Publisher:
        """Declare a publisher of one key without wildcards.

        ``reliable``: samples arrive in order and without loss while the connection exists; else they are best effort.
        """
        ...

    def subscribe(self, pattern: str, depth: int = KEEP_LAST_1) -> Subscription:
        """Receive samples of other members under the key expression ``pattern``.

        The last ``depth`` samples of each key are kept until :meth:`poll`. Samples under the name of an actor that do
        not come from the session that holds this name are dropped (:mod:`vinesim.net.transport.name_holders`). Reliable
        samples need the depth ``KEEP_ALL``, because they use another session than poses.
        """
        ...

    def poll(self) -> list[tuple[str, bytes]]:
        """Returns all samples (key, payload) that arrived since the last call, in order of arrival."""
        ...

    def query(self, key: str, payload: bytes = b"") -> None:
        """Send a query to all queryables that match ``key``. :meth:`replies` returns the replies that arrive."""

    def replies(self) -> list[Reply]:
        """Returns the replies to queries that arrived since the last call."""
        ...

    def fetch(self, key: str, payload: bytes = b"") -> list[bytes]:
        """Send a query to all queryables that match ``key``, wait for their replies, and return them.

        Waits some seconds at most, so the real-time loop must not call it. Any other thread may. Delays no other
        message. Returns an empty list if the network fails.
        """
        ...

    @property
    def spectators_speak_to(self) -> SpectatorsSpeakTo:
        """Actors that hear spectators in this world, as set by the server; people if there is no server."""
        ...

    @property
    def admissions(self) -> int:
        """Number of times that a server has admitted this actor: 0 without a server, one more after each restart of
        it."""
        ...

    def declare_queryable(self, key: str, respond: Callable[[bytes], bytes]) -> None:
        """Reply to queries for ``key``.

        ``respond(payload)`` returns the payload of the reply. Any thread may call it, so it must return quickly.
        """

    def alive(self) -> frozenset[str]:
        """Returns the names of all live actors, including this one."""
        ...

    def close(self) -> None:
        """Leave the world. Idempotent."""


class SenderBudget:
    """Budget of messages of each sender: whoever sends more has the rest dropped, before it costs time."""

    def __init__(self) -> None:
        self._left: dict[str, tuple[float, float]] = {}
        """Number of messages that a sender may send at once, and when that number was valid [s], by name."""
        self.dropped = 0
        """Number of messages that were above the budget."""

    def admits(self, name: str, now: float) -> bool:
        """Whether a message of a sender is within its budget at ``now`` [s]. Counts it."""
        left, since = self._left.get(name, (SENDER_BURST, now))
        left = min(left + (now - since) * SENDER_RATE, SENDER_BURST)
        if left < 1.0:
            self.dropped += 1
            return False
        if len(self._left) >= MAX_SENDERS:
            self._left = {one: kept for one, kept in self._left.items() if now - kept[1] < SENDER_BURST / SENDER_RATE}
        self._left[name] = left - 1.0, now
        return True


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
    """Queue of received samples: a thread of the network puts them, the real-time loop takes them."""

    def __init__(self) -> None:
        self._samples: collections.deque[tuple[int, str, bytes]] = collections.deque()
        self._bytes = 0
        self._replaceable = 0
        """Number of samples with a depth below ``KEEP_ALL`` since newer ones last replaced older ones."""
        self._lock = threading.Lock()
        self.overflowed = 0
        self.missed = 0
        """Number of samples with the depth ``KEEP_ALL`` among those that overflowed."""

    def put(self, depth: int, key: str, payload: bytes) -> None:
        """Append a sample of a subscription with this history ``depth``. If there is no room, newer samples replace
        older ones beyond the depth of their key. If that is not enough, drop the oldest samples.

        So the poses of a crowd push out no event of a real-time loop that gets no processor time.
        """
        with self._lock:
            self._samples.append((depth, key, payload))
            self._bytes += len(payload)
            self._replaceable += depth < KEEP_ALL
            if self._is_over_full() and self._replaceable > MIN_REPLACED:
                self._samples = collections.deque(_newest(self._samples))
                self._bytes = sum(len(kept) for _, _, kept in self._samples)
                self._replaceable = 0
            while self._is_over_full():
                dropped_depth, _, dropped = self._samples.popleft()
                self._bytes -= len(dropped)
                self.overflowed += 1
                self.missed += dropped_depth >= KEEP_ALL

    def _is_over_full(self) -> bool:
        return len(self._samples) > KEEP_ALL or (self._bytes > MAX_STORED_BYTES and len(self._samples) > 1)

    def take(self) -> list[tuple[str, bytes]]:
        """Remove and return all samples in order of arrival, without those beyond the history depth of their key."""
        with self._lock:
            taken = self._samples
            self._samples = collections.deque()
            self._bytes = self._replaceable = 0
        return [(key, payload) for _, key, payload in _newest(taken)]


def _newest(samples: collections.deque[tuple[int, str, bytes]]) -> list[tuple[int, str, bytes]]:
    """Returns samples (depth, key, payload) without those beyond the history depth of their key, in the same order."""
    left: dict[str, int] = {}
    kept = []
    for sample in reversed(samples):
        depth, key, _ = sample
        free = left.get(key, depth)
        left[key] = free - 1
        if free > 0:
            kept.append(sample)
    kept.reverse()
    return kept
