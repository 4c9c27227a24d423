"""Facts on their way: mine until somebody hears them, others' as they come, and the server's when a cell comes near.

A fact leaves even when nobody is near, for the server keeps it; it leaves once. What I said is said again when the
server was gone and is back: it may be another one, that knows nothing.
"""

from __future__ import annotations

from collections.abc import Iterable

from vinesim.net.codec import messages
from vinesim.net.codec.messages import RetainedRecord
from vinesim.net.counters import Counters
from vinesim.net.replication.interest import Cell
from vinesim.net.replication.retained import RetainedState
from vinesim.net.transport.bus import KEEP_ALL, Bus, Publisher, Subscription

QUERY_TIMEOUT = 0.5
"""The server is asked again after this [s], then after twice as long, and so on ..."""

MAX_QUERY_PERIOD = 8.0
"""... up to this [s], until it has answered."""

TYPICAL_RECORD_SIZE = 110
"""A fact about a box or a bunch takes no more [B]; about a tree, its state comes on top."""


class RetainedSync:
    """What this client knows for good, and what of it others must still hear."""

    def __init__(self, bus: Bus, counters: Counters) -> None:
        self.bus, self.counters = bus, counters
        self.state = RetainedState()
        self._pending: dict[Cell, dict[int, RetainedRecord]] = {}
        self._authored: dict[int, tuple[Cell, RetainedRecord]] = {}
        self._publishers: dict[Cell, Publisher] = {}
        self._subscriptions: dict[Cell, Subscription] = {}
        self._asked: dict[Cell, tuple[float, float]] = {}
        self._apart = False

    def publish(self, cell: Cell, fact: RetainedRecord) -> None:
        """A fact that I am the author of, about something that is in ``cell``."""
        self.state.merge(cell, fact)
        if fact.object in self._authored:
            before = self._authored[fact.object][0]
            self._pending.get(before, {}).pop(fact.object, None)
        self._authored[fact.object] = cell, fact
        self._pending.setdefault(cell, {})[fact.object] = fact

    def merge(self, cell: Cell, fact: RetainedRecord) -> bool:
        """A fact that somebody else said, or the server kept; whether it is news."""
        news = self.state.merge(cell, fact)
        if news and fact.author != self.bus.name:
            held = self.state.get(fact.object)
            if held is not None and held.author != self.bus.name and fact.object in self._authored:
                mine, _ = self._authored.pop(fact.object)
                self._pending.get(mine, {}).pop(fact.object, None)
        return news

    def update_window(self, window: Iterable[Cell], now: float) -> None:
        """Hear the facts of these cells from now on, and ask what was known of those that are new."""
        wanted, apart = set(window), bool(self.bus.status_message)
        if not self._asked and apart == self._apart and wanted == self._subscriptions.keys() == self._publishers.keys():
            return
        if self._apart and not apart:
            for thing, (cell, fact) in self._authored.items():
                self._pending.setdefault(cell, {})[thing] = fact
            self._asked = dict.fromkeys(wanted, (now, QUERY_TIMEOUT))
        self._apart = apart
        for cell in sorted(self._subscriptions.keys() - wanted):
            self._subscriptions.pop(cell).close()
            self._asked.pop(cell, None)
        for cell in sorted(wanted - self._subscriptions.keys()):
            self._subscriptions[cell] = self.bus.subscribe(f"fact/{cell[0]}/{cell[1]}/*", KEEP_ALL)
            self._asked[cell] = now, QUERY_TIMEOUT
        for cell in sorted(self._publishers.keys() - wanted - self._pending.keys()):
            self._publishers.pop(cell).close()
        for cell in sorted(wanted - self._publishers.keys()):
            self._publishers[cell] = self._publisher(cell)
        if not apart:
            for cell, (due, pause) in sorted(self._asked.items()):
                if now >= due:
                    self._asked[cell] = now + pause, min(2.0 * pause, MAX_QUERY_PERIOD)
                    self.bus.query(f"snap/{cell[0]}/{cell[1]}")

    def mark_answered(self, cell: Cell) -> None:
        """The server told what it knows of a cell."""
        self._asked.pop(cell, None)

    def flush(self) -> None:
        """Send what was not said yet, a message for each cell; what nobody listens to waits."""
        for cell in sorted(self._pending):
            waiting = self._pending[cell]
            voice = self._publishers.get(cell)
            if voice is None:
                voice = self._publishers[cell] = self._publisher(cell)
            if waiting and voice.matching:
                chosen, room = [], messages.MAX_DATAGRAM
                for thing in sorted(waiting):
                    room -= TYPICAL_RECORD_SIZE + len(waiting[thing].trees)
                    if room < 0 and chosen:
                        break
                    chosen.append(thing)
                payload = messages.encode_records([waiting[thing] for thing in chosen])
                if voice.put(payload):
                    self.counters.retained.count_out(payload)
                    for thing in chosen:
                        del waiting[thing]
            if not waiting:
                del self._pending[cell]

    def _publisher(self, cell: Cell) -> Publisher:
        return self.bus.publisher(f"fact/{cell[0]}/{cell[1]}/{self.bus.name}", reliable=True)
