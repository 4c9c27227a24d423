"""A recording, played: as a bus on which everything happens again, or to a network, by actors of the same names.

    tape = read(path)
    bus = ReplayBus(tape, "viewer")
    client = Spectator(scene, model, bus, pose=pose, clock=lambda: bus.time)
    while not bus.ended:
        bus.play(0.01)
        client.tick()

On the bus, network time is the time of the recording and moves only when it is told to: whoever listens to it sees the
same at the same tick, every time. On a network messages are stamped anew, as if they had just become true.
"""

from __future__ import annotations

import bisect
import logging
from collections.abc import Callable, Iterable

from vinesim.client.recording.recorder import NetworkClock
from vinesim.net.codec import messages
from vinesim.net.codec.messages import MessageError
from vinesim.net.recording.mcap_file import RecordedMessage, Recording, sender_of
from vinesim.net.replication.retained import RetainedState
from vinesim.net.transport.bus import KEEP_LAST_1, Bus, NameTaken, Publisher, Reply, SampleStore, matches

log = logging.getLogger(__name__)

RELIABLE = ("own", "fact")
"""Families of keys that are sent reliably."""

_ANSWERED = ("live", "hello", "snap")
"""Families of keys that are answers to questions, not said of one's own accord."""

ENOUGH = 4096
"""So many bytes of facts make an answer [B]."""


class Playhead:
    """A place on a tape, and who was there and what was true when it was played so far."""

    def __init__(self, tape: Recording, start: float = 0.0, end: float | None = None) -> None:
        """From ``start`` to ``end`` [s] after the first message; what was true at ``start`` is known at once."""
        self.tape = tape
        self.time = tape.start + start
        """Network time [s] up to which the tape has been played."""
        self.end = tape.start + (tape.length if end is None else min(end, tape.length))
        self.live: set[str] = set()
        """Who is there."""
        self.greetings: dict[str, bytes] = {}
        """How each introduced itself, as a message, even before it did: the recorder had to ask."""
        self.facts = RetainedState()
        """What stays true."""
        for entry in reversed(tape.messages):
            if entry.key.startswith("hello/"):
                self.greetings[sender_of(entry.key)] = entry.payload
        self._know_before()
        self._next = bisect.bisect_left(tape.messages, self.time, key=lambda entry: entry.time)
        for entry in tape.messages[: bisect.bisect_right(tape.messages, self.time, key=lambda entry: entry.time)]:
            self._note(entry)

    @property
    def ended(self) -> bool:
        """Nothing follows."""
        return self.time >= self.end

    def play(self, until: float) -> list[RecordedMessage]:
        """All that is new up to network time ``until`` [s], in order."""
        first = self._next
        self.time = max(self.time, until)
        last = min(self.time, self.end)
        while self._next < len(self.tape.messages) and self.tape.messages[self._next].time <= last:
            self._note(self.tape.messages[self._next])
            self._next += 1
        return self.tape.messages[first : self._next]

    def _know_before(self) -> None:
        """What the server knew when the recording began: what it answered, less what was said only later."""
        said = {fact for entry in self.tape.messages if entry.key.startswith("fact/") for fact in _facts(entry.payload)}
        for entry in self.tape.messages:
            if entry.key.startswith("snap/"):
                self._add(entry.key, (fact for fact in _facts(entry.payload) if fact not in said))

    def _note(self, entry: RecordedMessage) -> None:
        family, _, name = entry.key.partition("/")
        if family == "live":
            (self.live.add if entry.payload else self.live.discard)(name)
        elif family == "hello":
            self.greetings[name] = entry.payload
        elif family == "fact":
            self._add(entry.key, _facts(entry.payload))

    def _add(self, key: str, facts: Iterable[messages.RetainedRecord]) -> None:
        cell = _cell(key)
        if cell is not None:
            for fact in facts:
                self.facts.merge(cell, fact)


def _facts(payload: bytes) -> list[messages.RetainedRecord]:
    try:
        return messages.decode_records(payload)
    except MessageError:
        return []


def _cell(key: str) -> tuple[int, int] | None:
    """The cell that a key names."""
    try:
        x, y = key.split("/")[1:3]
        return int(x), int(y)
    except ValueError:
        return None


# ---------------------------------------------------------------- as a bus


class ReplayBus:
    """A member of a world that happened already; see :class:`vinesim.net.transport.bus.Bus`. What it says nobody
    hears."""

    bytes_out = 0
    status_message = ""

    def __init__(self, tape: Recording, name: str = "viewer", *, start: float = 0.0, end: float | None = None) -> None:
        """``start``, ``end`` [s] after the first message; :class:`NameTaken` if somebody on the tape has the name."""
        if name in tape.actors:
            raise NameTaken(name, str(tape.path))
        self.name = name
        self.bytes_in = 0
        self._cursor = Playhead(tape, start, end)
        self._begun, self._played = self._cursor.time, 0.0
        self._store = SampleStore()
        self._subscriptions: list[_Subscription] = []
        self._answers: list[Reply] = []

    @property
    def time(self) -> float:
        """Network time [s]."""
        return self._cursor.time

    @property
    def ended(self) -> bool:
        """All was played."""
        return self._cursor.ended

    def play(self, dt: float) -> None:
        """Let ``dt`` seconds of the recording happen."""
        self._played += dt
        for _, key, payload in self._cursor.play(self._begun + self._played):
            depths = [s.depth for s in self._subscriptions if matches(s.pattern, key)]
            if depths:
                self.bytes_in += len(payload)
                self._store.put(max(depths), key, payload)

    # ------------------------------------------------------------ the bus

    @property
    def dropped(self) -> int:
        return self._store.overflowed

    def join(self, greeting: bytes) -> None:
        pass

    def publisher(self, key: str, reliable: bool = False) -> Publisher:
        return _Unheard()

    def subscribe(self, pattern: str, depth: int = KEEP_LAST_1) -> _Subscription:
        self._subscriptions.append(_Subscription(self._subscriptions, pattern, depth))
        return self._subscriptions[-1]

    def poll(self) -> list[tuple[str, bytes]]:
        return self._store.take()

    def query(self, key: str, payload: bytes = b"") -> None:
        family, _, rest = key.partition("/")
        if family == "clock":
            asked, _ = messages.decode_time(payload)
            self._reply(key, messages.encode_time(asked, self.time))
        elif family == "hello" and rest in self._cursor.live and rest in self._cursor.greetings:
            self._reply(key, self._cursor.greetings[rest])
        elif family == "snap":
            facts = self._cursor.facts
            asked = _cell(key)  # of one cell even that there is nothing is an answer
            cells = {cell for cell, _ in facts if matches(key, f"snap/{cell[0]}/{cell[1]}")}
            for x, y in sorted(cells if asked is None else {asked}):
                for part in _parts(facts.in_cell((x, y))):
                    self._reply(f"snap/{x}/{y}", messages.encode_records(part))

    def replies(self) -> list[Reply]:
        answers, self._answers = self._answers, []
        return answers

    def declare_queryable(self, key: str, respond: Callable[[bytes], bytes]) -> None:
        pass

    def alive(self) -> frozenset[str]:
        return frozenset((*self._cursor.live, self.name))

    def close(self) -> None:
        self._subscriptions.clear()

    def _reply(self, key: str, payload: bytes) -> None:
        self._answers.append(Reply(key, payload, 0.0))


class _Subscription:
    """See :class:`vinesim.net.transport.bus.Subscription`."""

    def __init__(self, among: list[_Subscription], pattern: str, depth: int) -> None:
        self.pattern, self.depth, self._among = pattern, depth, among

    def close(self) -> None:
        if self in self._among:
            self._among.remove(self)


class _Unheard:
    """See :class:`vinesim.net.transport.bus.Publisher`."""

    matching = False

    def put(self, payload: bytes) -> bool:
        return False

    def close(self) -> None:
        pass


def _parts(facts: list[messages.RetainedRecord]) -> Iterable[list[messages.RetainedRecord]]:
    """Facts in portions, each small enough to travel, at least one."""
    part: list[messages.RetainedRecord] = []
    size = 0
    for fact in facts:
        part.append(fact)
        size += 64 + 4 * len(fact.cut) + len(fact.trees)
        if size > ENOUGH:
            yield part
            part, size = [], 0
    if part or not facts:
        yield part


# ---------------------------------------------------------------- to a network


class Replay:
    """Plays a tape to a network, each recorded actor through a live bus of its own. Call :meth:`step` often."""

    def __init__(
        self, tape: Recording, bus: Bus, live_bus: Callable[[str], Bus], now: float, *,
        speed: float = 1.0, start: float = 0.0, end: float | None = None,
    ) -> None:  # fmt: skip
        """``bus`` is not live: it asks for the time and says what no actor says any more; ``live_bus(name)`` opens
        one for an actor; ``now`` is any clock [s], as in :meth:`step`.
        """
        self.cursor = Playhead(tape, start, end)
        self.sent = 0
        """Messages that somebody heard."""
        self._bus, self._live_bus, self._speed = bus, live_bus, speed
        self._keeper = NetworkClock(bus, now)
        self._buses: dict[str, Bus] = {}
        self._publishers: dict[str, Publisher] = {}
        self._start = self.cursor.time
        self._begun: float | None = None
        self._begun_at = 0.0
        self._before = [(_fact_key(cell, fact), messages.encode_records([fact])) for cell, fact in self.cursor.facts]
        self._keys: dict[str, list[str]] = {}
        for key in sorted({entry.key for entry in tape.messages if entry.key.partition("/")[0] not in _ANSWERED}):
            self._keys.setdefault(sender_of(key), []).append(key)

    @property
    def ended(self) -> bool:
        """All was played."""
        return self.cursor.ended

    def step(self, now: float) -> None:
        """Say all that is due at own time ``now`` [s]."""
        self._keeper.keep(now)
        for key, payload, age in self._bus.replies():
            if key == "clock":
                self._keeper.hear(payload, age)
        if not self._keeper.settled:
            return
        if self._begun is None:
            self._begun, self._begun_at = now, self._keeper.time
        entries = self.cursor.play(self._start + (now - self._begun) * self._speed)
        self._follow()
        if self._buses:  # what was true before is said once there is a world and somebody who keeps it
            self._before = [(key, payload) for key, payload in self._before if not self._say(key, payload)]
        for entry in entries:
            if entry.key.partition("/")[0] not in _ANSWERED:
                # as old as it was when the recorder had it
                due = self._begun_at + (entry.time - self._start) / self._speed
                self._say(entry.key, messages.shift_time(entry.payload, due - entry.time))

    def close(self) -> None:
        """Let all actors leave."""
        for bus in self._buses.values():
            bus.close()
        self._buses.clear()

    def _follow(self) -> None:
        """Let actors come and go."""
        for name in sorted(self._buses.keys() - self.cursor.live):
            self._buses.pop(name).close()
            self._publishers = {k: p for k, p in self._publishers.items() if sender_of(k) != name}
        for name in sorted(self.cursor.live - self._buses.keys()):
            greeting = self.cursor.greetings.get(name)
            if greeting is not None:
                bus = self._buses[name] = self._live_bus(name)
                bus.join(greeting)
                bus.declare_queryable(f"hello/{name}", lambda _, greeting=greeting: greeting)
                for key in self._keys.get(name, ()):
                    self._publishers[key] = bus.publisher(key, key.partition("/")[0] in RELIABLE)

    def _say(self, key: str, payload: bytes) -> bool:
        """Whether anybody listens."""
        if key not in self._publishers:
            self._publishers[key] = self._bus.publisher(key, key.partition("/")[0] in RELIABLE)
        heard = self._publishers[key].put(payload)
        self.sent += heard
        return heard


def _fact_key(cell: tuple[int, int], fact: messages.RetainedRecord) -> str:
    return f"fact/{cell[0]}/{cell[1]}/{fact.author}"
