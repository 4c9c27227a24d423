"""A recorder: hears a world and writes it down, without changing what is sent in it, or asking for more if told to.

What it listens to is told in docs/decisions/recording.md: of the environment everything, because that leaves a client
only when another *actor* is near, and a recorder is none; a pose at its full rate only while somebody else hears it,
which a publisher on the same key knows (it matches, and never sends).
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Collection

import numpy as np

from vinesim import frames
from vinesim.net.codec import messages
from vinesim.net.codec.human import decode_pose
from vinesim.net.codec.messages import Hello, MessageError
from vinesim.net.keys import sender_of
from vinesim.net.recording.mcap_writer import RecordingWriter
from vinesim.net.replication import interest
from vinesim.net.replication.clock_sync import PING_WINDOW, ClockEstimate, Ping
from vinesim.net.replication.peers import ASK_PERIOD, FAR_PERIOD, PING_PERIOD, WorldMismatch
from vinesim.net.transport.bus import KEEP_ALL, Bus, Publisher, Subscription
from vinesim.scene.values import RobotUpdate

log = logging.getLogger(__name__)

FAMILIES = ("poses", "trees", "things", "events", "facts", "forces")
"""What ``--only`` chooses from; who is there, and how they introduced themselves, is always recorded."""

SETTLE = 2.0
"""A server that does not tell the time within this is not waited for any longer [s]."""

STAND = 7.0
"""Between two that stand in an area [m]: everything in between is within 5 m of one of them, as others hear it."""

MOST_STANDS = 16
"""So many may stand in an area."""

SLACK = 1.0
"""Somebody this much farther off [m] than where the full rate ends does not count as its listener."""


class AreaTooLarge(ValueError):
    """An area that cannot be asked for; the text says what can."""


class NetworkClock:
    """Network time as a listener keeps it: own clock and the offset to the server's."""

    def __init__(self, bus: Bus, now: float) -> None:
        self.clock = ClockEstimate(offset=time.time() - now)
        self._bus, self._now = bus, now
        self._asked, self._count = -math.inf, 0
        self._begun = now

    def keep(self, now: float) -> None:
        """Note that it is own time ``now`` [s]; ask the server when that is due."""
        self.clock = self.clock.advanced(now - self._now)
        self._now = now
        if now - self._asked >= PING_PERIOD[self._count >= 2 * PING_WINDOW]:
            self._asked, self._count = now, self._count + 1
            self._bus.query("clock", messages.encode_time(now))

    @property
    def time(self) -> float:
        """Network time [s]."""
        return self._now + self.clock.offset

    def hear(self, payload: bytes, age: float) -> None:
        """Take the clock's answer, which arrived ``age`` seconds ago."""
        asked, server = messages.decode_time(payload)
        if asked <= self._now - age:
            self.clock = self.clock.with_ping(Ping(asked, server, self._now - age))

    @property
    def settled(self) -> bool:
        """The server's time is known, or it does not tell."""
        return bool(self.clock.pings) or self._now - self._begun > SETTLE


class Recorder:
    """Hears a world through a bus that is not live, and hands all to a recording. Call :meth:`step` often."""

    def __init__(
        self,
        bus: Bus,
        recording: RecordingWriter,
        *,
        only: Collection[str] = FAMILIES,
        everything: bool = False,
        digest: str = "",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """``everything``: hear each actor at its full rate, even if nobody else does; that changes what is sent.

        ``digest``: of the vineyard that is to be recorded; the first actor says which it is unless given.
        """
        self.bus, self.recording = bus, recording
        self.digest = digest
        self.own: set[str] = set()
        """Names of those who stand in the world for the recorder: they are no part of what happens."""
        self.greetings: dict[str, Hello] = {}
        """Who introduced themselves, by name."""
        self.malformed = 0
        """Messages that were recorded, but are none."""
        self._only, self._everything, self._clock = frozenset(only), everything, clock
        self._keeper = NetworkClock(bus, clock())
        self._listening = False
        self._live: set[str] = set()
        self._asked: dict[str, float] = {}
        self._strangers: set[str] = set()
        self._place: dict[str, np.ndarray] = {}
        self._far: Subscription | None = None
        self._near: dict[str, tuple[Publisher, Subscription | None]] = {}
        self._at = 0

    @property
    def actors(self) -> frozenset[str]:
        """Who is there now."""
        return frozenset(self._live)

    def step(self) -> None:
        """Write down what arrived, and follow who is heard by whom."""
        now = self._clock()
        self._keeper.keep(now)
        self._take_answers()
        self.recording.check()
        if not self._keeper.settled:
            return
        self._at = max(self._at + 1, int(self._keeper.time * 1e9))
        if not self._listening:
            self._listen()
        self._roster(now)
        for key, payload in self.bus.poll():
            if sender_of(key) not in self.own:
                self._hear(key, payload)
        self._follow()

    def close(self) -> None:
        """Listen no more."""
        for publisher, subscription in self._near.values():
            publisher.close()
            if subscription is not None:
                subscription.close()

    # ------------------------------------------------------------ hear

    def _listen(self) -> None:
        self._listening = True
        if self._only & {"trees", "things"}:
            self.bus.subscribe("c/**", KEEP_ALL)
        if "events" in self._only:
            self.bus.subscribe("own/**", KEEP_ALL)
        if "facts" in self._only:
            self.bus.subscribe("fact/**", KEEP_ALL)
            self.bus.query("snap/*/*")  # what became true before
        if "forces" in self._only:
            self.bus.subscribe("force/**", KEEP_ALL)

    def _put(self, key: str, payload: bytes) -> None:
        self.recording.put(self._at, key, payload)

    def _roster(self, now: float) -> None:
        """Note who came and who went, and ask those who did not introduce themselves yet."""
        alive = self.bus.alive() - self.own - {self.bus.name}
        for name in sorted(self._live - alive):
            self._live.discard(name)
            self._strangers.discard(name)
            self._place.pop(name, None)
            self.greetings.pop(name, None)
            self._put(f"live/{name}", b"")
        for name in sorted(alive - self._live):
            self._live.add(name)
            self._asked.pop(name, None)
            self._put(f"live/{name}", b"\x01")
        for name in sorted(self._live - self.greetings.keys() - self._strangers):
            if now - self._asked.get(name, -math.inf) >= ASK_PERIOD:
                self._asked[name] = now
                self.bus.query(f"hello/{name}")

    def _take_answers(self) -> None:
        for key, payload, age in self.bus.replies():
            family, _, name = key.partition("/")
            try:
                if family == "clock":
                    self._keeper.hear(payload, age)
                elif family == "hello" and name in self._live - self.greetings.keys() - self._strangers:
                    self._greet(name, payload)
                elif family == "snap":
                    self._put(key, payload)
            except MessageError:
                self.malformed += 1

    def _greet(self, name: str, payload: bytes) -> None:
        """Note how an actor introduced itself. A stranger among others is ignored, as they ignore it themselves."""
        try:
            hello = messages.decode_hello(payload)
        except messages.WrongVersion as error:
            self._refuse(name, f"speaks protocol version {error.theirs}, this recorder version {messages.PROTOCOL}")
            return
        if self.digest and hello.digest != self.digest:
            wanted = f"{self.recording.metadata.get('scene', '?')!r} with {self.digest!r}"
            self._refuse(name, f"has scene {hello.scene!r} with digest {hello.digest!r}, this recording {wanted}")
            return
        if not self.digest:
            self.digest = hello.digest
            seed = {"seed": str(hello.seed)} if hello.seed >= 0 else {}
            self.recording.add_metadata(scene=hello.scene, digest=hello.digest, **seed)
        self.greetings[name] = hello
        self._put(f"hello/{name}", payload)

    def _refuse(self, name: str, why: str) -> None:
        text = f"{name!r} {why}: record with the scene, seed and release of vinesim that are used there"
        if not self.greetings:
            raise WorldMismatch(text)
        log.warning("ignoring a stranger: %s", text)
        self._strangers.add(name)

    def _hear(self, key: str, payload: bytes) -> None:
        family, _, rest = key.partition("/")
        kind = -1
        try:
            kind = messages.kind_of(payload)
            if family == "a":
                name = rest.partition("/")[0]
                self._place[name] = decode_pose(payload, name).base_q[:3]
        except MessageError:
            self.malformed += 1
        if family == "a" and "poses" not in self._only:
            return
        if family == "c" and self._only.isdisjoint({"trees"} if kind == messages.MessageKind.TREES else {"things"}):
            return
        self._put(key, payload)

    # ------------------------------------------------------------ who is heard by whom

    def _follow(self) -> None:
        """Hear of each actor what somebody else hears of it too: for all, its slow poses, near ones, its fast ones."""
        company = self._everything or len(self._live) >= 2
        if company and self._far is None:
            self._far = self.bus.subscribe("a/*/far", KEEP_ALL)
        elif not company and self._far is not None:
            self._far.close()
            self._far = None
        for name in sorted(self._near.keys() - self._live):
            publisher, subscription = self._near.pop(name)
            publisher.close()
            if subscription is not None:
                subscription.close()
        for name in self._live:
            if name not in self._near:
                self._near[name] = self.bus.publisher(f"a/{name}"), None
            publisher, subscription = self._near[name]
            wanted = "poses" in self._only and (self._everything or (publisher.matching and self._in_company(name)))
            if wanted and subscription is None:
                self._near[name] = publisher, self.bus.subscribe(f"a/{name}", KEEP_ALL)
            elif not wanted and subscription is not None:
                subscription.close()
                self._near[name] = publisher, None

    def _in_company(self, name: str) -> bool:
        """Whether another actor can be the listener: else it is a recorder, and two would keep each other listening."""
        if name not in self._place:
            return False
        away = [math.dist(self._place[name][:2], place[:2]) for other, place in self._place.items() if other != name]
        return min(away, default=math.inf) <= interest.REDUCED_RATE_DISTANCE + SLACK


def grid(area: tuple[float, float, float, float]) -> list[tuple[float, float]]:
    """Where to stand so that everything in an area (x0, y0, x1, y1) [m] is within 5 m of somebody."""
    x0, y0, x1, y1 = area
    if not (all(map(math.isfinite, area)) and x0 < x1 and y0 < y1):
        raise AreaTooLarge(f"area {x0:g} {y0:g} {x1:g} {y1:g}: give X0 Y0 X1 Y1 [m] with X0 < X1 and Y0 < Y1")
    columns, rows = math.ceil((x1 - x0) / STAND), math.ceil((y1 - y0) / STAND)
    if columns * rows > MOST_STANDS:
        raise AreaTooLarge(
            f"an area of {x1 - x0:g} x {y1 - y0:g} m needs {columns * rows} who stand in it, at most {MOST_STANDS}: "
            f"give a smaller one, e.g. {4 * STAND:g} x {4 * STAND:g} m"
        )
    return [
        (x0 + (column + 0.5) * (x1 - x0) / columns, y0 + (row + 0.5) * (y1 - y0) / rows)
        for column in range(columns)
        for row in range(rows)
    ]


class Observer:
    """A spectator without a world of its own: it is only there, so that others send what happens around it."""

    def __init__(self, bus: Bus, place: tuple[float, float], scene: str, digest: str, now: float) -> None:
        """At ``place`` [m], through a live bus of its own, from own time ``now`` on."""
        self.bus = bus
        hello = messages.encode_hello(Hello(bus.name, kind="spectator", scene=scene, digest=digest, joints=0))
        bus.join(hello)
        bus.declare_queryable(f"hello/{bus.name}", lambda _: hello)
        self._place = frames.pose([*place, 1.6])
        self._pose = bus.publisher(f"a/{bus.name}/far")
        self._keeper = NetworkClock(bus, now)
        self._due = -math.inf

    def step(self, now: float) -> None:
        """Say five times a second that one is there."""
        self._keeper.keep(now)
        for key, payload, age in self.bus.replies():
            if key == "clock":
                self._keeper.hear(payload, age)
        if now >= self._due:
            self._due = now + FAR_PERIOD
            update = RobotUpdate(self.bus.name, self._keeper.time, self._place, np.zeros(6), np.zeros(0), np.zeros(0))
            self._pose.put(messages.encode_robot(update))
