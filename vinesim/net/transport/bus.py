"""How messages travel, whatever carries them: the :class:`Bus` protocol, and a bus in memory for tests.

Keys are relative to a world, chunks joined by ``/``; in a pattern ``*`` stands for one chunk and ``**`` for any number.
A bus never calls anybody back in the tick: arrivals are only stored, and :meth:`Bus.drain` hands them out.
Every member has a name, and its name is live from construction to :meth:`Bus.close`.
"""

from __future__ import annotations

import collections
import functools
import heapq
import random
from collections.abc import Callable
from typing import NamedTuple, Protocol, Self

KEEP_LAST_1 = 1
"""Depth of a subscription that wants the newest sample of each key: poses."""

KEEP_LAST_64 = 64
"""... the last few of each key, in order: records that complete each other."""

KEEP_ALL = 10_000
"""... all of them, in order: events (the bound only stops a flood)."""


class BusError(RuntimeError):
    """The network cannot be used as asked; the text says what, where and the remedy."""

    exit_code = 4


class WrongUse(ValueError):
    """What was asked for cannot be meant: a name, an endpoint, a combination; the text says what would be right."""


class NameTaken(BusError):
    """Another live actor has this name."""

    def __init__(self, name: str, world: str) -> None:
        super().__init__(
            f"an actor named {name!r} is already live in world {world!r}: choose another name or stop that one"
        )


class JoinRejected(BusError):
    """The server does not let this actor in; the text is the server's."""


class Reply(NamedTuple):
    """Reply to :meth:`Bus.ask`."""

    key: str
    payload: bytes
    age: float
    """How long ago it arrived [s]."""


class Publisher(Protocol):
    """The right to send under one exact key."""

    @property
    def matching(self) -> bool:
        """Somebody else listens to this key now."""

    def put(self, payload: bytes) -> bool:
        """Send; returns at once. False, and nothing leaves nor is counted, when nobody listens."""

    def close(self) -> None:
        """Give the key up."""


class Subscription(Protocol):
    """The wish to hear a pattern of keys."""

    def close(self) -> None:
        """Hear it no more; what has arrived stays to be drained."""


class Bus(Protocol):
    """A member of one world on the network."""

    name: str
    bytes_in: int
    """Payload bytes that arrived."""
    bytes_out: int
    """Payload bytes that left: with no listener none leave."""
    dropped: int
    """Samples thrown away here because a store was full or a sample was too large."""

    @property
    def status_message(self) -> str:
        """Empty, or in words why nobody can be reached now."""

    def join(self, greeting: bytes) -> None:
        """Ask the server to be let in with this :class:`messages.Hello`, once, before anything else is sent.

        :class:`Refused` if it says no. Where no server keeps the world, those who are there judge each other.
        """

    def publisher(self, key: str, reliable: bool = False) -> Publisher:
        """For one exact key. Reliable: nothing is lost or reordered while the connection lives."""

    def subscribe(self, pattern: str, depth: int = KEEP_LAST_1) -> Subscription:
        """Hear what others send: the last ``depth`` samples of each key until they are drained.

        What is sent reliably is heard with ``EVERY``: it travels apart from poses.
        """

    def poll(self) -> list[tuple[str, bytes]]:
        """All (key, payload) that arrived since, in order of arrival."""

    def query(self, key: str, payload: bytes = b"") -> None:
        """Put a question to whoever serves ``key``; answers appear in :meth:`answers`, or never."""

    def replies(self) -> list[Reply]:
        """Replies that arrived since."""

    def declare_queryable(self, key: str, respond: Callable[[bytes], bytes]) -> None:
        """Answer questions under ``key`` until closed; ``respond`` is called by any thread and must be quick."""

    def alive(self) -> frozenset[str]:
        """Names of all live actors, one's own among them."""

    def close(self) -> None:
        """Leave; the second time nothing happens."""


@functools.lru_cache(maxsize=65536)
def matches(pattern: str, key: str) -> bool:
    """Whether a key expression covers a key."""
    return _covers(tuple(pattern.split("/")), tuple(key.split("/")))


def _covers(pattern: tuple[str, ...], key: tuple[str, ...]) -> bool:
    if not pattern:
        return not key
    if pattern[0] == "**":
        return any(_covers(pattern[1:], key[skip:]) for skip in range(len(key) + 1))
    return bool(key) and pattern[0] in ("*", key[0]) and _covers(pattern[1:], key[1:])


class SampleStore:
    """Where arrivals wait for the tick. Appending is safe from another thread; only one thread takes."""

    def __init__(self) -> None:
        self._samples: collections.deque[tuple[int, str, bytes]] = collections.deque()
        self.overflowed = 0

    def put(self, depth: int, key: str, payload: bytes) -> None:
        """Keep a sample that arrived under a subscription of this depth."""
        self._samples.append((depth, key, payload))
        if len(self._samples) > KEEP_ALL:
            self._samples.popleft()
            self.overflowed += 1

    def take(self) -> list[tuple[str, bytes]]:
        """Everything kept, in order of arrival, the older beyond its depth left out."""
        taken = []
        while True:
            try:
                taken.append(self._samples.popleft())
            except IndexError:
                break
        left: dict[str, int] = {}
        kept = []
        for depth, key, payload in reversed(taken):
            room = left.get(key, depth)
            left[key] = room - 1
            if room > 0:
                kept.append((key, payload))
        kept.reverse()
        return kept


# ---------------------------------------------------------------- in memory


class MemoryHub:
    """A network in memory with its own explicit clock: delay, jitter, loss and splits, all seeded.

    ``delay`` and ``jitter`` [s] are one way (uniform delay - jitter to delay + jitter, so samples overtake each
    other); ``loss`` is the chance that an unreliable sample vanishes, ``doubled`` that it arrives twice. Reliable ones
    arrive once and in order.
    """

    def __init__(
        self, *, delay: float = 0.0, jitter: float = 0.0, loss: float = 0.0, doubled: float = 0.0, seed: int = 0
    ) -> None:
        if delay < 0.0 or jitter < 0.0 or not 0.0 <= loss <= 1.0:
            raise ValueError(f"delay {delay} s and jitter {jitter} s must not be negative, loss {loss} from 0 to 1")
        self.time = 0.0
        self.delay, self.jitter, self.loss, self.doubled = delay, jitter, loss, doubled
        self.down = False
        """True: the server is gone, nothing passes and nobody sees anybody."""
        self.refuses: Callable[[bytes], str] = lambda greeting: ""
        """Why the server of this network lets nobody in with such a greeting; empty: it does."""
        self._random = random.Random(seed)
        self._order = 0
        self._pending: list[tuple[float, int, Callable[[], None]]] = []
        self._members: dict[str, MemoryBus] = {}
        self._seen: dict[str, set[str]] = {}
        self._unseen: set[str] = set()
        self._last: dict[tuple[str, str], float] = {}

    def bus(self, name: str, *, live: bool = True) -> MemoryBus:
        """A new member; :class:`NameTaken` if the name is live. Not ``live``: nobody sees that it is there."""
        if name in self._members:
            raise NameTaken(name, "memory")
        bus = MemoryBus(self, name)
        self._seen[name] = {name, *self._members.keys() - self._unseen}
        if live:
            for other in sorted(self._members):
                self.later(functools.partial(self._notice, other, name, True), ("live", other))
        else:
            self._seen[name].discard(name)
            self._unseen.add(name)
        self._members[name] = bus
        return bus

    def advance(self, dt: float) -> None:
        """Let time pass: everything that arrives meanwhile is delivered in order."""
        until = self.time + dt
        while self._pending and self._pending[0][0] <= until + 1e-12:
            self.time, _, happen = heapq.heappop(self._pending)
            happen()
        self.time = until

    def later(self, happen: Callable[[], None], lane: tuple[str, str] | None = None) -> None:
        """Let something happen one journey from now; things of one ``lane`` stay in order."""
        at = self.time + max(0.0, self.delay + self._random.uniform(-self.jitter, self.jitter))
        if lane is not None:
            at = self._last[lane] = max(at, self._last.get(lane, 0.0))
        self._order += 1
        heapq.heappush(self._pending, (at, self._order, happen))

    def listened(self, sender: str, key: str) -> bool:
        """Another member subscribes to this key."""
        return not self.down and any(bus.hears(key) for name, bus in self._members.items() if name != sender)

    def send(self, sender: str, key: str, payload: bytes, reliable: bool) -> None:
        """One sample to every other member that listens on arrival."""
        for name in sorted(self._members):
            bus = self._members[name]
            if name == sender or not bus.hears(key):
                continue
            if reliable:
                self.later(functools.partial(self._deliver, bus, key, payload), (sender, name))
            elif self._random.random() >= self.loss:
                for _ in range(1 + (self.doubled > 0.0 and self._random.random() < self.doubled)):
                    self.later(functools.partial(self._deliver, bus, key, payload))

    def question(self, asker: MemoryBus, key: str, payload: bytes) -> None:
        """To every member that serves ``key``, and back."""

        def ask(bus: MemoryBus, served: str) -> None:
            if not self.down and served in bus.served:
                answer = bus.served[served](payload)
                self.later(functools.partial(reply, served, answer))

        def reply(served: str, answer: bytes) -> None:
            if not self.down:
                asker.replied.append((served, answer, self.time))

        for name in sorted(self._members):
            for served in sorted(self._members[name].served):
                if matches(key, served) and name != asker.name:
                    self.later(functools.partial(ask, self._members[name], served))

    def visible(self, name: str) -> frozenset[str]:
        """Whom a member believes to be live."""
        return frozenset((name,)) if self.down else frozenset(self._seen.get(name, ()))

    def leave(self, name: str) -> None:
        """A member is gone; the others notice one journey later."""
        self._members.pop(name, None)
        self._seen.pop(name, None)
        self._unseen.discard(name)
        for other in sorted(self._members):
            self.later(functools.partial(self._notice, other, name, False), ("live", other))

    def _notice(self, observer: str, name: str, there: bool) -> None:
        if observer in self._seen:
            (self._seen[observer].add if there else self._seen[observer].discard)(name)

    def _deliver(self, bus: MemoryBus, key: str, payload: bytes) -> None:
        if not self.down:
            bus.arrive(key, payload)


class MemoryPublisher:
    """See :class:`Publisher`."""

    def __init__(self, bus: MemoryBus, key: str, reliable: bool) -> None:
        self._bus, self._key, self._reliable = bus, key, reliable

    @property
    def matching(self) -> bool:
        return self._bus.hub.listened(self._bus.name, self._key)

    def put(self, payload: bytes) -> bool:
        if not self.matching:
            return False
        self._bus.bytes_out += len(payload)
        self._bus.hub.send(self._bus.name, self._key, payload, self._reliable)
        return True

    def close(self) -> None:
        pass


class MemorySubscription:
    """See :class:`Subscription`."""

    def __init__(self, bus: MemoryBus, pattern: str, depth: int) -> None:
        self._bus, self.pattern, self.depth = bus, pattern, depth

    def close(self) -> None:
        self._bus.forget(self)


class MemoryBus:
    """See :class:`Bus`; made by :meth:`MemoryHub.bus`."""

    def __init__(self, hub: MemoryHub, name: str) -> None:
        self.hub, self.name = hub, name
        self.bytes_in = self.bytes_out = 0
        self.served: dict[str, Callable[[bytes], bytes]] = {}
        self.replied: list[tuple[str, bytes, float]] = []
        self._store = SampleStore()
        self._subscriptions: list[MemorySubscription] = []

    @property
    def dropped(self) -> int:
        return self._store.overflowed

    @property
    def status_message(self) -> str:
        return "the hub is down" if self.hub.down else ""

    def join(self, greeting: bytes) -> None:
        if why := self.hub.refuses(greeting):
            raise JoinRejected(why)

    def publisher(self, key: str, reliable: bool = False) -> MemoryPublisher:
        if "*" in key:
            raise ValueError(f"publisher key {key!r} has a wildcard: only exact keys send nothing when nobody listens")
        return MemoryPublisher(self, key, reliable)

    def subscribe(self, pattern: str, depth: int = KEEP_LAST_1) -> MemorySubscription:
        subscription = MemorySubscription(self, pattern, depth)
        self._subscriptions.append(subscription)
        return subscription

    def forget(self, subscription: MemorySubscription) -> None:
        if subscription in self._subscriptions:
            self._subscriptions.remove(subscription)

    def hears(self, key: str) -> bool:
        return any(matches(subscription.pattern, key) for subscription in self._subscriptions)

    def arrive(self, key: str, payload: bytes) -> None:
        depths = [s.depth for s in self._subscriptions if matches(s.pattern, key)]
        if depths:
            self.bytes_in += len(payload)
            self._store.put(max(depths), key, payload)

    def poll(self) -> list[tuple[str, bytes]]:
        return self._store.take()

    def query(self, key: str, payload: bytes = b"") -> None:
        if not self.hub.down:
            self.hub.question(self, key, payload)

    def replies(self) -> list[Reply]:
        replied, self.replied = self.replied, []
        return [Reply(key, payload, self.hub.time - at) for key, payload, at in replied]

    def declare_queryable(self, key: str, respond: Callable[[bytes], bytes]) -> None:
        self.served[key] = respond

    def alive(self) -> frozenset[str]:
        return self.hub.visible(self.name)

    def close(self) -> None:
        self._subscriptions.clear()
        self.served.clear()
        self.hub.leave(self.name)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
