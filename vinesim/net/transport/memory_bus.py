"""A network in memory with its own clock: deterministic delay, jitter, loss and partition, for tests and benchmarks."""

from __future__ import annotations

import functools
import heapq
import random
from collections.abc import Callable
from typing import Self

from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.net.transport.bus import KEEP_ALL, KEEP_LAST_1, JoinRejected, NameTaken, Reply, SampleStore, matches
from vinesim.net.transport.name_holders import bound_name

MAX_KNOWN_KEYS = 10_000
"""Largest number of keys for which a bus stores whether it subscribes to them."""


class MemoryHub:
    """An emulated network that carries samples between its buses. :meth:`advance` moves its clock.

    The one-way delay of a sample is uniform from ``delay - jitter`` to ``delay + jitter`` [s], so samples can overtake
    each other. ``loss`` and ``duplicated`` are the probabilities that a best-effort sample is lost or arrives twice.
    Reliable samples arrive once and in order. All random numbers follow from ``seed``.
    """

    def __init__(
        self, *, delay: float = 0.0, jitter: float = 0.0, loss: float = 0.0, duplicated: float = 0.0, seed: int = 0
    ) -> None:
        if delay < 0.0 or jitter < 0.0 or not 0.0 <= loss <= 1.0:
            raise ValueError(f"delay {delay} s and jitter {jitter} s must not be negative, loss {loss} from 0 to 1")
        self.time = 0.0
        self.delay = delay
        self.jitter = jitter
        self.loss = loss
        self.duplicated = duplicated
        self.down = False
        """Whether the network is down: no message arrives, and for each member only the member itself is live."""
        self.binds_names = True
        """Whether messages under the name of another member are dropped, as by a real bus."""
        self.rejection_reason: Callable[[bytes], str] = lambda greeting: ""
        """Function that returns why the emulated server rejects a hello; empty if it admits the actor."""
        self.spectators_speak_to = SpectatorsSpeakTo.PEOPLE
        """Actors that hear spectators, as set by the emulated server."""
        self.admissions = 0
        """Number of times that the emulated server has admitted each member."""
        self._random = random.Random(seed)
        self._order = 0
        self._pending: list[tuple[float, int, Callable[[], None]]] = []
        self._members: dict[str, MemoryBus] = {}
        self._visible_names: dict[str, set[str]] = {}
        self._hidden: set[str] = set()
        self._last_arrival: dict[tuple[str, str], float] = {}
        self._subscribers: dict[str, list[str]] = {}
        """Sorted names of the members that subscribe to a key. Cleared when subscriptions or members change."""

    def bus(self, name: str, *, live: bool = True) -> MemoryBus:
        """Add a member, and return its bus. Raises :class:`NameTaken` if there is a member with this name.

        ``live``: whether the member has a liveliness token, so that others know that it is there.
        """
        if name in self._members:
            raise NameTaken(name, "memory")
        bus = MemoryBus(self, name)
        self._visible_names[name] = {name, *self._members.keys() - self._hidden}
        if live:
            for other in sorted(self._members):
                self._schedule(functools.partial(self._update_liveliness, other, name, True), ("live", other))
        else:
            self._visible_names[name].discard(name)
            self._hidden.add(name)
        self._members[name] = bus
        self.forget_subscribers()
        return bus

    def advance(self, dt: float) -> None:
        """Advance the clock by ``dt`` [s], and deliver in order all samples that arrive in this time."""
        end = self.time + dt
        while self._pending and self._pending[0][0] <= end + 1e-12:
            self.time, _, action = heapq.heappop(self._pending)
            action()
        self.time = end

    def _schedule(self, action: Callable[[], None], order_key: tuple[str, str] | None = None) -> None:
        """Call ``action`` after a random one-way delay. Actions with the same ``order_key`` are called in order."""
        at = self.time + max(0.0, self.delay + self._random.uniform(-self.jitter, self.jitter))
        if order_key is not None:
            at = self._last_arrival[order_key] = max(at, self._last_arrival.get(order_key, 0.0))
        self._order += 1
        heapq.heappush(self._pending, (at, self._order, action))

    def has_subscriber(self, sender: str, key: str) -> bool:
        """Whether a member other than ``sender`` subscribes to a key."""
        return not self.down and any(name != sender for name in self._subscribers_of(key))

    def _subscribers_of(self, key: str) -> list[str]:
        """Returns the sorted names of all members that subscribe to a key."""
        if key not in self._subscribers:
            self._subscribers[key] = sorted(name for name, bus in self._members.items() if bus.is_subscribed(key))
        return self._subscribers[key]

    def forget_subscribers(self) -> None:
        """Clear the stored subscribers. Called when subscriptions or members have changed."""
        self._subscribers.clear()

    def send(self, sender: str, key: str, payload: bytes, reliable: bool) -> None:
        """Send a sample to every other member that subscribes to the key now.

        A member that has closed its subscription when the sample arrives ignores it.
        """
        for name in self._subscribers_of(key):
            bus = self._members[name]
            if name == sender:
                continue
            if reliable:
                self._schedule(functools.partial(self._deliver, bus, sender, key, payload), (sender, name))
            elif self._random.random() >= self.loss:
                for _ in range(1 + (self.duplicated > 0.0 and self._random.random() < self.duplicated)):
                    self._schedule(functools.partial(self._deliver, bus, sender, key, payload))

    def query(self, sender: MemoryBus, key: str, payload: bytes) -> None:
        """Send a query to every other member with a matching queryable, and the replies back to ``sender``."""

        def respond(bus: MemoryBus, served_key: str) -> None:
            if not self.down and served_key in bus.queryables:
                answer = bus.queryables[served_key](payload)
                self._schedule(functools.partial(reply, bus.name, served_key, answer))

        def reply(replier: str, served_key: str, answer: bytes) -> None:
            answered_key = key if "*" in served_key else served_key
            if not self.down and not self._is_foreign(sender, replier, answered_key):
                sender.pending_replies.append((answered_key, answer, self.time))

        for name in sorted(self._members):
            for served_key in sorted(self._members[name].queryables):
                if name != sender.name and (matches(key, served_key) or matches(served_key, key)):
                    self._schedule(functools.partial(respond, self._members[name], served_key))

    def fetch(self, sender: str, key: str, payload: bytes) -> list[bytes]:
        """Send a query to every other member with a matching queryable, and return the replies at once.

        There is no delay here, because the caller cannot wait while the clock stands.
        """
        if self.down:
            return []
        return [
            respond(payload)
            for name, bus in sorted(self._members.items())
            for served_key, respond in sorted(bus.queryables.items())
            if name != sender and matches(served_key, key)
        ]

    def visible_names(self, name: str) -> frozenset[str]:
        """Returns the names that are live for the member ``name``."""
        return frozenset((name,)) if self.down else frozenset(self._visible_names.get(name, ()))

    def remove(self, name: str) -> None:
        """Remove a member. The other members are notified after a random one-way delay."""
        self._members.pop(name, None)
        self.forget_subscribers()
        self._visible_names.pop(name, None)
        self._hidden.discard(name)
        for other in sorted(self._members):
            self._schedule(functools.partial(self._update_liveliness, other, name, False), ("live", other))

    def _update_liveliness(self, observer: str, name: str, there: bool) -> None:
        if observer in self._visible_names:
            (self._visible_names[observer].add if there else self._visible_names[observer].discard)(name)

    def _is_foreign(self, bus: MemoryBus, source: str, key: str) -> bool:
        """Whether ``source`` sends under the name of another member. Counts such messages for the receiver ``bus``."""
        is_foreign = self.binds_names and bound_name(key) not in ("", source)
        bus.foreign += is_foreign
        return is_foreign

    def _deliver(self, bus: MemoryBus, source: str, key: str, payload: bytes) -> None:
        if self.down:
            return
        if self._is_foreign(bus, source, key):
            bus.miss(key)
        else:
            bus.deliver(key, payload)


class MemoryPublisher:
    """A publisher of a :class:`MemoryBus`. Implements :class:`vinesim.net.transport.bus.Publisher`."""

    def __init__(self, bus: MemoryBus, key: str, reliable: bool) -> None:
        self._bus = bus
        self._key = key
        self._reliable = reliable

    @property
    def matching(self) -> bool:
        return self._bus.hub.has_subscriber(self._bus.name, self._key)

    def put(self, payload: bytes) -> bool:
        if not self.matching:
            return False
        self._bus.bytes_out += len(payload)
        self._bus.hub.send(self._bus.name, self._key, payload, self._reliable)
        return True

    def close(self) -> None:
        pass


class MemorySubscription:
    """A subscription of a :class:`MemoryBus`. Implements :class:`vinesim.net.transport.bus.Subscription`."""

    def __init__(self, bus: MemoryBus, pattern: str, depth: int) -> None:
        self._bus = bus
        self.pattern = pattern
        self.depth = depth

    def close(self) -> None:
        self._bus.unsubscribe(self)


class MemoryBus:
    """A bus on a :class:`MemoryHub`, made by :meth:`MemoryHub.bus`. Implements
    :class:`vinesim.net.transport.bus.Bus`."""

    def __init__(self, hub: MemoryHub, name: str) -> None:
        self.hub = hub
        self.name = name
        self.bytes_in = self.bytes_out = self.failures = self.foreign = self._missed = 0
        self.queryables: dict[str, Callable[[bytes], bytes]] = {}
        self.pending_replies: list[tuple[str, bytes, float]] = []
        self._store = SampleStore()
        self._subscriptions: list[MemorySubscription] = []
        self._depths: dict[str, int] = {}
        """Largest history depth of the subscriptions that match a key; 0 if none matches. Cleared when subscriptions
        change."""

    @property
    def dropped(self) -> int:
        return self._store.overflowed

    @property
    def missed(self) -> int:
        return self._missed + self._store.missed

    @property
    def status_message(self) -> str:
        return "the hub is down" if self.hub.down else ""

    def join(self, greeting: bytes) -> None:
        if why := self.hub.rejection_reason(greeting):
            raise JoinRejected(why)

    def publisher(self, key: str, reliable: bool = False) -> MemoryPublisher:
        if "*" in key:
            raise ValueError(f"publisher key {key!r} has a wildcard: only exact keys send nothing without a subscriber")
        return MemoryPublisher(self, key, reliable)

    def subscribe(self, pattern: str, depth: int = KEEP_LAST_1) -> MemorySubscription:
        subscription = MemorySubscription(self, pattern, depth)
        self._subscriptions.append(subscription)
        self._depths.clear()
        self.hub.forget_subscribers()
        return subscription

    def unsubscribe(self, subscription: MemorySubscription) -> None:
        if subscription in self._subscriptions:
            self._subscriptions.remove(subscription)
            self._depths.clear()
            self.hub.forget_subscribers()

    def is_subscribed(self, key: str) -> bool:
        return self._depth_of(key) > 0

    def _depth_of(self, key: str) -> int:
        depth = self._depths.get(key)
        if depth is None:
            if len(self._depths) >= MAX_KNOWN_KEYS:
                self._depths.clear()
            depth = max((s.depth for s in self._subscriptions if matches(s.pattern, key)), default=0)
            self._depths[key] = depth
        return depth

    def deliver(self, key: str, payload: bytes) -> None:
        if depth := self._depth_of(key):
            self.bytes_in += len(payload)
            self._store.put(depth, key, payload)

    def miss(self, key: str) -> None:
        """Note that a sample under a key was not delivered."""
        self._missed += self._depth_of(key) >= KEEP_ALL

    def poll(self) -> list[tuple[str, bytes]]:
        return self._store.take()

    def query(self, key: str, payload: bytes = b"") -> None:
        if not self.hub.down:
            self.hub.query(self, key, payload)

    def replies(self) -> list[Reply]:
        pending_replies = self.pending_replies
        self.pending_replies = []
        return [Reply(key, payload, self.hub.time - at) for key, payload, at in pending_replies]

    def fetch(self, key: str, payload: bytes = b"") -> list[bytes]:
        return self.hub.fetch(self.name, key, payload)

    @property
    def spectators_speak_to(self) -> SpectatorsSpeakTo:
        return self.hub.spectators_speak_to

    @property
    def admissions(self) -> int:
        return self.hub.admissions

    def declare_queryable(self, key: str, respond: Callable[[bytes], bytes]) -> None:
        self.queryables[key] = respond

    def alive(self) -> frozenset[str]:
        return self.hub.visible_names(self.name)

    def close(self) -> None:
        self._subscriptions.clear()
        self._depths.clear()
        self.queryables.clear()
        self.hub.remove(self.name)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
