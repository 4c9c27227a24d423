"""A network in memory for very many actors, which counts what a router would deliver.

:class:`vinesim.net.transport.memory_bus.MemoryHub` compares every key with every subscription. This hub finds the
subscribers of a key by the patterns that vinesim uses, so a message costs as much among a thousand actors as among ten.
It has no delay and no loss: a message arrives before the next step of its receiver.
"""

from __future__ import annotations

import collections
from collections.abc import Callable

from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.net.transport.bus import KEEP_LAST_1, NameTaken, Reply, SampleStore


class IndexedHub:
    """The network. Its counters are of all members together."""

    def __init__(self) -> None:
        self.members: dict[str, IndexedBus] = {}
        self.names: frozenset[str] = frozenset()
        self.puts = 0
        """Number of messages that a router would receive: those with a subscriber."""
        self.deliveries = 0
        """Number of messages that a router would send to members, with queries and replies."""
        self.delivered_bytes = 0
        """Payloads of these messages [B]."""
        self.answers: dict[str, Callable[[str, bytes], bytes]] = {}
        """Functions of key and payload that reply for the server, by the first chunk of the key of a query."""
        self._subscribers: collections.defaultdict[str, dict[IndexedBus, int]] = collections.defaultdict(dict)

    def bus(self, name: str) -> IndexedBus:
        """Add a member. Raises :class:`NameTaken` if there is one with this name."""
        if name in self.members:
            raise NameTaken(name, "memory")
        self.members[name] = IndexedBus(self, name)
        self.names = frozenset(self.members)
        return self.members[name]

    def subscribers(self, sender: IndexedBus, key: str) -> dict[IndexedBus, int]:
        """Returns the history depth of each other member that subscribes to a key."""
        family, first, *rest = key.split("/")
        patterns = {key, "/".join((family, "*", *rest)), "/".join((family, first, *rest[:-1], "*"))}
        found: dict[IndexedBus, int] = {}
        for pattern in patterns:
            for member, depth in self._subscribers.get(pattern, {}).items():
                found[member] = max(depth, found.get(member, 0))
        found.pop(sender, None)
        return found

    def subscribe(self, member: IndexedBus, pattern: str, depth: int) -> None:
        """Store a subscription. Patterns with one ``*``, as first or last chunk after the family, are known."""
        if "**" in pattern or pattern.count("*") > 1:
            raise ValueError(f"pattern {pattern!r}: this network knows one '*' at most")
        self._subscribers[pattern][member] = depth

    def unsubscribe(self, member: IndexedBus, pattern: str) -> None:
        """Forget a subscription."""
        self._subscribers[pattern].pop(member, None)

    def count(self, payload: bytes) -> None:
        """Count one message that a router sends to a member."""
        self.deliveries += 1
        self.delivered_bytes += len(payload)


class IndexedBus:
    """A member of the network. Implements :class:`vinesim.net.transport.bus.Bus`."""

    dropped = missed = foreign = failures = admissions = 0
    status_message = ""
    spectators_speak_to = SpectatorsSpeakTo.PEOPLE

    def __init__(self, hub: IndexedHub, name: str) -> None:
        self.hub = hub
        self.name = name
        self.bytes_in = 0
        self.bytes_out = 0
        self.queryables: dict[str, Callable[[bytes], bytes]] = {}
        self.store = SampleStore()
        self._answers: list[Reply] = []

    def join(self, greeting: bytes) -> None:
        """Do nothing: there is no server that admits."""

    def publisher(self, key: str, reliable: bool = False) -> _Publisher:
        """Returns a publisher of ``key``."""
        return _Publisher(self, key)

    def subscribe(self, pattern: str, depth: int = KEEP_LAST_1) -> _Subscription:
        """Subscribe to ``pattern``."""
        self.hub.subscribe(self, pattern, depth)
        return _Subscription(self, pattern)

    def poll(self) -> list[tuple[str, bytes]]:
        """Returns the samples since the last call."""
        return self.store.take()

    def query(self, key: str, payload: bytes = b"") -> None:
        """Send a query to the member or the server that answers ``key``. The reply arrives at once."""
        family, _, name = key.partition("/")
        member = self.hub.members.get(name)
        if family in self.hub.answers:
            answer = self.hub.answers[family](key, payload)
        elif member is not None and key in member.queryables:
            answer = member.queryables[key](payload)
            member.bytes_in += len(payload)
            member.bytes_out += len(answer)
        else:
            return
        self.hub.count(payload)
        self.hub.count(answer)
        self.bytes_in += len(answer)
        self._answers.append(Reply(key, answer, 0.0))

    def replies(self) -> list[Reply]:
        """Returns the replies since the last call."""
        answers = self._answers
        self._answers = []
        return answers

    def fetch(self, key: str, payload: bytes = b"") -> list[bytes]:
        """Returns no replies: nobody offers meshes here."""
        return []

    def declare_queryable(self, key: str, respond: Callable[[bytes], bytes]) -> None:
        """Reply to queries for ``key``."""
        self.queryables[key] = respond

    def alive(self) -> frozenset[str]:
        """Returns the names of all members."""
        return self.hub.names

    def close(self) -> None:
        """Leave."""
        self.hub.members.pop(self.name, None)
        self.hub.names = frozenset(self.hub.members)


class _Publisher:
    def __init__(self, bus: IndexedBus, key: str) -> None:
        self._bus = bus
        self._key = key

    @property
    def matching(self) -> bool:
        return bool(self._bus.hub.subscribers(self._bus, self._key))

    def put(self, payload: bytes) -> bool:
        found = self._bus.hub.subscribers(self._bus, self._key)
        for member, depth in found.items():
            member.store.put(depth, self._key, payload)
            member.bytes_in += len(payload)
            self._bus.hub.count(payload)
        self._bus.hub.puts += bool(found)
        self._bus.bytes_out += len(payload) * bool(found)
        return bool(found)

    def close(self) -> None:
        pass


class _Subscription:
    def __init__(self, bus: IndexedBus, pattern: str) -> None:
        self._bus = bus
        self._pattern = pattern

    def close(self) -> None:
        self._bus.hub.unsubscribe(self._bus, self._pattern)
