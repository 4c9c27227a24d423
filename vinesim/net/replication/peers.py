"""The others who are here: greetings, their poses between two messages, and the common clock.

Keys: ``a/<actor>`` pose at the full rate for those who are near, ``a/<actor>/far`` the same at 5 Hz for everybody, and
the questions ``hello/<actor>`` and ``clock``.
"""

from __future__ import annotations

import dataclasses
import logging
import zlib
from collections.abc import Iterator

import numpy as np

from vinesim.net.codec import messages
from vinesim.net.codec.human import encode_pose
from vinesim.net.codec.messages import Hello, MessageError
from vinesim.net.counters import Counters
from vinesim.net.replication import interest
from vinesim.net.replication.clock_sync import PING_WINDOW, ClockEstimate, Ping
from vinesim.net.replication.jitter_buffer import JitterBuffer
from vinesim.net.replication.remote_pose import RemotePose
from vinesim.net.transport.bus import KEEP_LAST_1, Bus, Publisher, Reply
from vinesim.scene.values import HumanUpdate, RobotUpdate

log = logging.getLogger(__name__)

ACTOR_PERIOD = 1.0 / 60.0
"""Between poses for those who are near [s]."""

FAR_PERIOD = 1.0 / 5.0
"""Between poses for everybody [s]."""

ASK_PERIOD = 0.5
"""Between two attempts to hear an actor's greeting [s]."""

PING_PERIOD = (0.05, 2.0)
"""Between pings of the clock at the start, twice as many as are needed, and later [s]."""

_LONG_AGO = -1e9


class WorldMismatch(RuntimeError):
    """Actors that cannot share a world: their vineyards or their protocols differ."""

    exit_code = 4


class PeerRegistry:
    """All others in this world: who came, who went, where they are."""

    def __init__(self, bus: Bus, me: Hello, counters: Counters, buffer: float = 0.0) -> None:
        """``buffer`` [s]: all others' poses are shown so much later, see :class:`Buffer`."""
        self.bus, self.name, self.counters = bus, me, counters
        self._buffer = JitterBuffer(buffer).delay
        self.local_actors: set[str] = set()
        self.clock = ClockEstimate()
        self.known: dict[str, RemotePose] = {}
        self.seen_names: set[str] = set()
        """Who was ever let in: last words may arrive when their author has gone."""
        greeting = messages.encode_hello(me)
        bus.join(greeting)
        bus.declare_queryable(f"hello/{me.name}", lambda _: greeting)
        self._initial_names = bus.alive() - {me.name}
        self._asked: dict[str, float] = {}
        self._refused: set[str] = set()
        self._blamed: set[str] = set()
        self._pose = bus.publisher(f"a/{me.name}")
        self._far_pose = bus.publisher(f"a/{me.name}/far")
        bus.subscribe("a/*/far", KEEP_LAST_1)
        self._pose_due: dict[Publisher, float] = {}
        self._phase = zlib.crc32(me.name.encode()) % 1024 / 1024.0
        self._pinged, self._pings = _LONG_AGO, 0

    def positions(self) -> dict[str, np.ndarray]:
        """Where everybody else is [m], as far as it is known."""
        return {name: actor.update.base_q[:3] for name, actor in self.known.items() if actor.update is not None}

    # ------------------------------------------------------------ who is here

    def poll_liveliness(self, now: float) -> list[str]:
        """Notice who came and ask for their greetings; who went."""
        alive = self.bus.alive() - self.local_actors
        gone = sorted(self.known.keys() - alive)
        for name in gone:
            actor = self.known.pop(name)
            self._asked.pop(name, None)
            self._blamed.discard(name)
            if actor.near is not None:
                actor.near.close()
        self._refused &= alive
        self._initial_names &= alive
        for name in sorted(alive - self.known.keys() - self._refused - {self.name.name}):
            if now - self._asked.get(name, _LONG_AGO) >= ASK_PERIOD:
                self._asked[name] = now
                self.bus.query(f"hello/{name}")
        if now - self._pinged >= PING_PERIOD[self._pings >= 2 * PING_WINDOW]:
            self._pinged, self._pings = now, self._pings + 1
            self.bus.query("clock", messages.encode_time(now))
        return gone

    def process_replies(self, now: float) -> tuple[list[Hello], list[Reply]]:
        """Take greetings and the clock's answers; who joined, and the answers to other questions."""
        joined: list[Hello] = []
        others: list[Reply] = []
        for answer in self.bus.replies():
            key, payload, age = answer
            self.counters.control.count_in(payload)
            family, _, name = key.partition("/")
            try:
                if key == "clock":
                    asked, server = messages.decode_time(payload)
                    received = now - age
                    if asked <= received:
                        self.clock = self.clock.with_ping(Ping(asked, server, received))
                elif family != "hello":
                    others.append(answer)
                elif name in self.bus.alive() and name not in self.known and name not in self._refused:
                    joined += self._admit(name, payload)
            except MessageError as error:
                self.count_malformed(name or "the clock", error)
        return joined, others

    def _admit(self, name: str, payload: bytes) -> Iterator[Hello]:
        """Let an actor in, unless it lives in another vineyard or speaks another protocol."""
        try:
            hello = messages.decode_hello(payload)
        except messages.WrongVersion as error:
            self._reject(
                name, f"speaks protocol version {error.theirs}, {self.name.name!r} version {messages.PROTOCOL}"
            )
            return
        if hello.name != name:
            raise MessageError(f"{name!r} introduces itself as {hello.name!r}")
        if hello.digest != self.name.digest:
            self._reject(
                name,
                f"has scene {hello.scene!r} with digest {hello.digest!r}, "
                f"{self.name.name!r} has {self.name.scene!r} with {self.name.digest!r}",
            )
            return
        self.known[name] = RemotePose(hello, self._buffer)
        self.seen_names.add(name)
        yield hello

    def _reject(self, name: str, why: str) -> None:
        """Whoever was here first is right: the newcomer stops, those who were here ignore it."""
        text = f"{name!r} {why}: start both with the same scene, seed and release of vinesim"
        if name in self._initial_names:
            raise WorldMismatch(text)
        log.warning("ignoring a newcomer: %s", text)
        self._refused.add(name)
        self.seen_names.discard(name)

    def is_rejected(self, name: str) -> bool:
        """Whether an actor was found to live in another world."""
        return name in self._refused

    def count_malformed(self, sender: str, error: MessageError) -> None:
        """Count a message that cannot be believed, and say so once for each sender."""
        self.counters.malformed += 1
        if sender not in self._blamed:
            self._blamed.add(sender)
            log.warning("dropped a message of %r, further ones only counted: %s", sender, error)

    # ------------------------------------------------------------ poses

    def update_interest(self, position: np.ndarray) -> None:
        """Move the circle of actors heard at the full rate."""
        for name, actor in self.known.items():
            if actor.update is None:
                continue
            away = float(np.hypot(*(actor.update.base_q[:2] - position[:2])))
            if interest.is_full_rate(away, actor.near is not None):
                actor.near = actor.near or self.bus.subscribe(f"a/{name}", KEEP_LAST_1)
            elif actor.near is not None:
                actor.near.close()
                actor.near = None

    def publish_pose(self, robot: RobotUpdate | HumanUpdate, now: float, time: float) -> None:
        """My pose: 60 Hz to those who are near, 5 Hz to everybody; encoded once, and only if somebody listens."""
        payload = b""
        for publisher, period in ((self._pose, ACTOR_PERIOD), (self._far_pose, FAR_PERIOD)):
            due = self._pose_due.get(publisher)
            if due is None:  # those who come at once need not speak at once for ever
                due = now - period * self._phase
            elif now < due - 1e-9:
                continue
            self._pose_due[publisher] = max(due, now - period) + period
            if publisher.matching:
                payload = payload or encode_pose(dataclasses.replace(robot, actor=self.name.name, time=time))
                if publisher.put(payload):
                    self.counters.actor.count_out(payload)
