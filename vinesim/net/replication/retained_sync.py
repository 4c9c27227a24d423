"""Facts on their way: mine until somebody hears them, others' as they come, and the server's when a cell comes near.

A fact leaves even when nobody is near, for the server keeps it; it leaves once. What I said is said again when the
server was gone and is back: it may be another one, that knows nothing.
"""

from __future__ import annotations

from collections.abc import Iterable

from vinesim.net.codec import messages
from vinesim.net.codec.messages import Fact
from vinesim.net.counters import Counters
from vinesim.net.replication.interest import Cell
from vinesim.net.replication.retained import Facts
from vinesim.net.transport.bus import EVERY, Bus, Publisher, Subscription

PATIENCE = 0.5
"""The server is asked again after this [s], then after twice as long, and so on ..."""

RARELY = 8.0
"""... up to this [s], until it has answered."""

USUAL = 110
"""A fact about a box or a bunch takes no more [B]; about a tree, its state comes on top."""


class Telling:
    """What this client knows for good, and what of it others must still hear."""

    def __init__(self, bus: Bus, counters: Counters) -> None:
        self.bus, self.counters = bus, counters
        self.facts = Facts()
        self._unsaid: dict[Cell, dict[int, Fact]] = {}
        self._authored: dict[int, tuple[Cell, Fact]] = {}
        self._voices: dict[Cell, Publisher] = {}
        self._ears: dict[Cell, Subscription] = {}
        self._asked: dict[Cell, tuple[float, float]] = {}
        self._apart = False

    def say(self, cell: Cell, fact: Fact) -> None:
        """A fact that I am the author of, about something that is in ``cell``."""
        self.facts.add(cell, fact)
        if fact.thing in self._authored:
            before = self._authored[fact.thing][0]
            self._unsaid.get(before, {}).pop(fact.thing, None)
        self._authored[fact.thing] = cell, fact
        self._unsaid.setdefault(cell, {})[fact.thing] = fact

    def hear(self, cell: Cell, fact: Fact) -> bool:
        """A fact that somebody else said, or the server kept; whether it is news."""
        news = self.facts.add(cell, fact)
        if news and fact.author != self.bus.name:
            held = self.facts.of(fact.thing)
            if held is not None and held.author != self.bus.name and fact.thing in self._authored:
                mine, _ = self._authored.pop(fact.thing)
                self._unsaid.get(mine, {}).pop(fact.thing, None)
        return news

    def follow(self, window: Iterable[Cell], now: float) -> None:
        """Hear the facts of these cells from now on, and ask what was known of those that are new."""
        wanted, apart = set(window), bool(self.bus.trouble)
        if not self._asked and apart == self._apart and wanted == self._ears.keys() == self._voices.keys():
            return
        if self._apart and not apart:
            for thing, (cell, fact) in self._authored.items():
                self._unsaid.setdefault(cell, {})[thing] = fact
            self._asked = dict.fromkeys(wanted, (now, PATIENCE))
        self._apart = apart
        for cell in sorted(self._ears.keys() - wanted):
            self._ears.pop(cell).close()
            self._asked.pop(cell, None)
        for cell in sorted(wanted - self._ears.keys()):
            self._ears[cell] = self.bus.subscribe(f"fact/{cell[0]}/{cell[1]}/*", EVERY)
            self._asked[cell] = now, PATIENCE
        for cell in sorted(self._voices.keys() - wanted - self._unsaid.keys()):
            self._voices.pop(cell).close()
        for cell in sorted(wanted - self._voices.keys()):
            self._voices[cell] = self._voice(cell)
        if not apart:
            for cell, (due, pause) in sorted(self._asked.items()):
                if now >= due:
                    self._asked[cell] = now + pause, min(2.0 * pause, RARELY)
                    self.bus.ask(f"snap/{cell[0]}/{cell[1]}")

    def answered(self, cell: Cell) -> None:
        """The server told what it knows of a cell."""
        self._asked.pop(cell, None)

    def speak(self) -> None:
        """Send what was not said yet, a message for each cell; what nobody listens to waits."""
        for cell in sorted(self._unsaid):
            waiting = self._unsaid[cell]
            voice = self._voices.get(cell)
            if voice is None:
                voice = self._voices[cell] = self._voice(cell)
            if waiting and voice.matching:
                chosen, room = [], messages.SAMPLE
                for thing in sorted(waiting):
                    room -= USUAL + len(waiting[thing].trees)
                    if room < 0 and chosen:
                        break
                    chosen.append(thing)
                payload = messages.encode_facts([waiting[thing] for thing in chosen])
                if voice.put(payload):
                    self.counters.fact.said(payload)
                    for thing in chosen:
                        del waiting[thing]
            if not waiting:
                del self._unsaid[cell]

    def _voice(self, cell: Cell) -> Publisher:
        return self.bus.publisher(f"fact/{cell[0]}/{cell[1]}/{self.bus.name}", reliable=True)
