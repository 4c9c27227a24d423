"""Replays a recording, either on its own bus or on a network, where actors with the recorded names appear.

    recording = read_recording(path)
    bus = ReplayBus(recording, "viewer")
    client = Spectator(scene, model, bus, pose=pose, clock=lambda: bus.time)
    while not bus.ended:
        bus.play(0.01)
        client.tick()

On the bus, network time is the time of the recording and advances only by :meth:`ReplayBus.play`. So a client receives
the same messages in the same step in every replay. On a network, messages get new time stamps, as if they were new.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable

import numpy as np

from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.net.codec.control import (
    Hello,
    RetainedRecord,
    decode_hello,
    decode_records,
    decode_time,
    description_digest,
    encode_hello,
    encode_records,
    encode_time,
)
from vinesim.net.codec.header import MessageError
from vinesim.net.codec.messages import family_of, sender_of, shift_time
from vinesim.net.recording.mcap_reader import RecordedMessage, Recording
from vinesim.net.replication.network_clock import NetworkClock
from vinesim.net.replication.retained import RetainedState
from vinesim.net.transport.bus import KEEP_LAST_1, Bus, NameTaken, Publisher, Reply, SampleStore, matches

log = logging.getLogger(__name__)

MAX_REPLY = 4096
"""Largest size of a reply with retained records [B]; larger replies are split."""


_APPLIED = ("live", "hello", "fact")
"""Families of keys whose messages change the state of a :class:`Playhead`."""


class Playhead:
    """A position in a recording, with the actors and the retained state at that position."""

    def __init__(self, recording: Recording, start: float = 0.0, end: float | None = None) -> None:
        """Play from ``start`` to ``end`` [s] after the first message, with the retained state at ``start``."""
        self.recording = recording
        self.time = recording.start + start
        """Network time up to which the recording has been played [s]."""
        self.end = recording.start + (recording.length if end is None else min(end, recording.length))
        self.live: set[str] = set()
        """Names of the actors that are present."""
        self.greetings: dict[str, bytes] = {}
        """Encoded hello of each actor. It is known before the time at which it was recorded, because the recorder had
        to query it."""
        self._descriptions: dict[str, bytes] = {}
        """Encoded description of each robot, by digest."""
        self.records = RetainedState()
        """Retained records of all objects at the present position in the recording."""
        for entry in recording.messages.of("hello"):
            self.greetings.setdefault(sender_of(entry.key), entry.payload)
        for entry in recording.messages.of("robot"):
            self._descriptions.setdefault(description_digest(entry.payload), entry.payload)
        self._load_initial_records()
        times = recording.messages.times
        self._next = int(np.searchsorted(times, self.time, "left"))
        for entry in recording.messages.of(*_APPLIED, last=int(np.searchsorted(times, self.time, "right"))):
            self._apply(entry)

    @property
    def ended(self) -> bool:
        """Whether the end of the recording was reached."""
        return self.time >= self.end

    def play(self, until: float) -> list[RecordedMessage]:
        """Returns all messages since the last call up to network time ``until`` [s], in order, at most up to the
        end."""
        first = self._next
        self.time = max(self.time, min(until, self.end))
        self._next = max(first, int(np.searchsorted(self.recording.messages.times, self.time, "right")))
        entries = self.recording.messages[first : self._next]
        for entry in entries:
            self._apply(entry)
        return entries

    def description(self, name: str) -> bytes | None:
        """Returns the encoded description of an actor's robot, or None."""
        try:
            return self._descriptions.get(decode_hello(self.greetings.get(name, b"")).robot_digest)
        except MessageError:
            return None

    def _load_initial_records(self) -> None:
        """Load the server's state at the beginning of the recording: its replies without records published later."""
        said = {record for entry in self.recording.messages.of("fact") for record in _decode_records(entry.payload)}
        for entry in self.recording.messages.of("snap"):
            self._merge(entry.key, (record for record in _decode_records(entry.payload) if record not in said))

    def _apply(self, entry: RecordedMessage) -> None:
        family, _, name = entry.key.partition("/")
        if family == "live":
            (self.live.add if entry.payload else self.live.discard)(name)
        elif family == "hello":
            self.greetings[name] = entry.payload
        elif family == "fact":
            self._merge(entry.key, _decode_records(entry.payload))

    def _merge(self, key: str, records: Iterable[RetainedRecord]) -> None:
        cell = _cell(key)
        if cell is not None:
            for record in records:
                self.records.merge(cell, record)


def _decode_records(payload: bytes) -> list[RetainedRecord]:
    try:
        return decode_records(payload)
    except MessageError:
        return []


def _cell(key: str) -> tuple[int, int] | None:
    """Returns the cell that a key contains, or None."""
    try:
        x, y = key.split("/")[1:3]
        return int(x), int(y)
    except ValueError:
        return None


# ---------------------------------------------------------------- as a bus


class ReplayBus:
    """A bus in a recorded world, see :class:`vinesim.net.transport.bus.Bus`. Published messages are discarded."""

    bytes_out = failures = foreign = missed = 0
    status_message = ""

    def __init__(
        self, recording: Recording, name: str = "viewer", *, start: float = 0.0, end: float | None = None
    ) -> None:
        """``start``, ``end``: times after the first message [s]. Raises :class:`NameTaken` if a recorded actor has
        ``name``."""
        if name in recording.actors:
            raise NameTaken(name, str(recording.path))
        self.name = name
        self.bytes_in = 0
        self._playhead = Playhead(recording, start, end)
        self._begun = self._playhead.time
        self._played = 0.0
        self._store = SampleStore()
        self._subscriptions: list[_Subscription] = []
        self._answers: list[Reply] = []

    @property
    def time(self) -> float:
        """Network time up to which the recording has been played [s]."""
        return self._playhead.time

    @property
    def start(self) -> float:
        """Network time of the beginning of the recording [s]."""
        return self._playhead.recording.start

    @property
    def ended(self) -> bool:
        """Whether the end of the recording was reached."""
        return self._playhead.ended

    def play(self, dt: float) -> None:
        """Play the next ``dt`` seconds."""
        self._played += dt
        for _, key, payload in self._playhead.play(self._begun + self._played):
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
        return _NullPublisher()

    def subscribe(self, pattern: str, depth: int = KEEP_LAST_1) -> _Subscription:
        self._subscriptions.append(_Subscription(self._subscriptions, pattern, depth))
        return self._subscriptions[-1]

    def poll(self) -> list[tuple[str, bytes]]:
        return self._store.take()

    def query(self, key: str, payload: bytes = b"") -> None:
        family, _, rest = key.partition("/")
        if family == "clock":
            asked, *_ = decode_time(payload)
            self._reply(key, encode_time(asked, self.time))
        elif family == "hello" and rest in self._playhead.live and rest in self._playhead.greetings:
            self._reply(key, self._playhead.greetings[rest])
        elif family == "robot" and (described := self._playhead.description(rest)) is not None:
            self._reply(key, described)
        elif family == "snap":
            records = self._playhead.records
            asked = _cell(key)  # for a single cell, an empty state is also a reply
            cells = {cell for cell, _ in records if matches(key, f"snap/{cell[0]}/{cell[1]}")}
            for x, y in sorted(cells if asked is None else {asked}):
                for part in _split_records(records.in_cell((x, y))):
                    self._reply(f"snap/{x}/{y}", encode_records(part))

    def replies(self) -> list[Reply]:
        answers = self._answers
        self._answers = []
        return answers

    def fetch(self, key: str, payload: bytes = b"") -> list[bytes]:
        return []

    @property
    def spectators_speak_to(self) -> SpectatorsSpeakTo:
        return SpectatorsSpeakTo.PEOPLE

    @property
    def admissions(self) -> int:
        return 0

    def declare_queryable(self, key: str, respond: Callable[[bytes], bytes]) -> None:
        pass

    def alive(self) -> frozenset[str]:
        return frozenset((*self._playhead.live, self.name))

    def close(self) -> None:
        self._subscriptions.clear()

    def _reply(self, key: str, payload: bytes) -> None:
        self._answers.append(Reply(key, payload, 0.0))


class _Subscription:
    """Subscription on a :class:`ReplayBus`, see :class:`vinesim.net.transport.bus.Subscription`."""

    def __init__(self, among: list[_Subscription], pattern: str, depth: int) -> None:
        self.pattern = pattern
        self.depth = depth
        self._among = among

    def close(self) -> None:
        if self in self._among:
            self._among.remove(self)


class _NullPublisher:
    """Publisher that discards all messages, see :class:`vinesim.net.transport.bus.Publisher`."""

    matching = False

    def put(self, payload: bytes) -> bool:
        return False

    def close(self) -> None:
        pass


def _split_records(records: list[RetainedRecord]) -> Iterable[list[RetainedRecord]]:
    """Yields the records in parts that are small enough to send; at least one part, which may be empty."""
    part: list[RetainedRecord] = []
    size = 0
    for record in records:
        part.append(record)
        size += 64 + 4 * len(record.cut) + len(record.trees) + len(record.wood)
        if size > MAX_REPLY:
            yield part
            part = []
            size = 0
    if part or not records:
        yield part


# ---------------------------------------------------------------- to a network


class Replay:
    """Replays a recording to a network; each actor has its own live bus. Call :meth:`step` often."""

    def __init__(
        self,
        recording: Recording,
        bus: Bus,
        live_bus: Callable[[str], Bus],
        now: float,
        *,
        speed: float = 1.0,
        start: float = 0.0,
        end: float | None = None,
    ) -> None:
        """Begin a replay of a recording to a network.

        Args:
            recording: the recording.
            bus: a bus that is not live, to query the network clock.
            live_bus: function that opens the bus of the actor of this name, also of an absent actor while its retained
                records are published.
            now: time of any clock [s], the same as in :meth:`step`.
            speed: speed of playing relative to real time.
            start: beginning [s] after the first message.
            end: end [s] after the first message; None: end of the recording.
        """
        self.playhead = Playhead(recording, start, end)
        self.sent = 0
        """Number of messages that had a subscriber."""
        self._bus = bus
        self._live_bus = live_bus
        self._speed = speed
        self._network_clock = NetworkClock(bus, now, time.time() - now)
        self._buses: dict[str, Bus] = {}
        self._absent: dict[str, Bus] = {}
        """Buses of actors that are not present, by name; their retained records are published now."""
        self._publishers: dict[str, Publisher] = {}
        self._start = self.playhead.time
        self._begun: float | None = None
        self._begun_at = 0.0
        self._initial_messages = [
            (_record_key(cell, record), encode_records([record])) for cell, record in self.playhead.records
        ]
        self._keys: dict[str, list[str]] = {}
        for key in sorted(key for key in recording.messages.keys if family_of(key).is_published):
            self._keys.setdefault(sender_of(key), []).append(key)

    @property
    def ended(self) -> bool:
        """Whether the end of the recording was reached."""
        return self.playhead.ended

    def step(self, now: float) -> None:
        """Publish all messages that are due at ``now`` [s], a time of the clock that was passed at the start."""
        self._network_clock.advance(now)
        self._network_clock.ping_if_due()
        for key, payload, age in self._bus.replies():
            if key.partition("/")[0] == "clock":
                self._network_clock.receive(payload, age)
        if not self._network_clock.is_settled:
            return
        if self._begun is None:
            self._begun, self._begun_at = now, self._network_clock.time
        entries = self.playhead.play(self._start + (now - self._begun) * self._speed)
        self._update_actors()
        if self._buses:  # earlier retained records are sent once a world exists whose server keeps them
            self._initial_messages = [
                (key, payload) for key, payload in self._initial_messages if not self._publish(key, payload)
            ]
            if not self._initial_messages:
                self._close_absent(set(self._absent))
        for entry in entries:
            if family_of(entry.key).is_published:
                # the message has the same age as when the recorder received it
                due = self._begun_at + (entry.time - self._start) / self._speed
                self._publish(entry.key, shift_time(entry.payload, due - entry.time))

    def close(self) -> None:
        """Let all actors leave."""
        for bus in self._buses.values():
            bus.close()
        self._buses.clear()
        self._close_absent(set(self._absent))

    def _update_actors(self) -> None:
        """Let actors join and leave as recorded."""
        for name in sorted(self._buses.keys() - self.playhead.live):
            self._buses.pop(name).close()
            self._publishers = {k: p for k, p in self._publishers.items() if sender_of(k) != name}
        self._close_absent(self.playhead.live & self._absent.keys())
        for name in sorted(self.playhead.live - self._buses.keys()):
            greeting = self.playhead.greetings.get(name)
            if greeting is not None:
                bus = self._buses[name] = self._live_bus(name)
                bus.join(greeting)
                bus.declare_queryable(f"hello/{name}", lambda _, greeting=greeting: greeting)
                if (described := self.playhead.description(name)) is not None:
                    bus.declare_queryable(f"robot/{name}", lambda _, described=described: described)
                for key in self._keys.get(name, ()):
                    self._publishers[key] = bus.publisher(key, family_of(key).is_reliable)

    def _publish(self, key: str, payload: bytes) -> bool:
        """Publish a message. Returns whether it had a subscriber."""
        if key not in self._publishers:
            name = sender_of(key)
            bus = self._buses.get(name) or self._absent.get(name) or self._join_absent(name)
            self._publishers[key] = bus.publisher(key, family_of(key).is_reliable)
        was_sent = self._publishers[key].put(payload)
        self.sent += was_sent
        return was_sent

    def _join_absent(self, name: str) -> Bus:
        """Join as an actor that is not present, because the server accepts records only from joined actors."""
        bus = self._absent[name] = self._live_bus(name)
        greeting = self.playhead.greetings.get(name)
        if greeting is None:
            other = decode_hello(next(iter(self.playhead.greetings.values())))
            greeting = encode_hello(Hello(name, scene=other.scene, digest=other.digest))
        bus.join(greeting)
        return bus

    def _close_absent(self, names: set[str]) -> None:
        for name in sorted(names):
            self._absent.pop(name).close()
            self._publishers = {k: p for k, p in self._publishers.items() if sender_of(k) != name}


def _record_key(cell: tuple[int, int], record: RetainedRecord) -> str:
    return f"fact/{cell[0]}/{cell[1]}/{record.author}"
