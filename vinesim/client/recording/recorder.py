"""Records the messages of a world, by default without changing which messages are sent.

``docs/decisions/recording.md`` explains the subscriptions. The recorder subscribes to all messages about the
environment; a client sends these only when another *actor* is near, and a recorder is not an actor. It subscribes to
poses at the full rate only while an actor receives them. To find out, it declares a publisher on the same key, which
never sends but reports whether there is a subscriber.
"""

from __future__ import annotations

import itertools
import logging
import math
import time
from collections.abc import Callable, Collection

import numpy as np

from vinesim.core import frames
from vinesim.net.codec.control import Hello, decode_description, decode_hello, encode_hello
from vinesim.net.codec.header import PROTOCOL, MessageError, WrongVersion, kind_of
from vinesim.net.codec.human import decode_pose
from vinesim.net.codec.messages import FAMILIES, sender_of
from vinesim.net.codec.robot import encode_robot
from vinesim.net.recording.mcap_writer import RecordingWriter
from vinesim.net.replication import interest
from vinesim.net.replication.interest import PoseLayer
from vinesim.net.replication.network_clock import NetworkClock
from vinesim.net.replication.peers import ASK_PERIOD, WorldMismatch
from vinesim.net.transport.bus import KEEP_ALL, Bus, Publisher, Subscription
from vinesim.scene.values import RobotUpdate

log = logging.getLogger(__name__)

CHOICES = tuple(dict.fromkeys(family.recorded_with for family in FAMILIES.values() if family.recorded_with))
"""Groups of messages that the option ``--only`` can choose. Presence and hellos of actors are always recorded."""

OBSERVER_SPACING = 7.0
"""Distance between observers in an area [m]. Every point is then within the interest radius (5 m) of an observer."""

MAX_OBSERVERS = 16
"""Largest number of observers in one area."""

COMPANY_MARGIN = 1.0
"""Distance beyond the range of a pose layer up to which another actor may still be the subscriber of the layer [m]."""


class AreaTooLarge(ValueError):
    """The area is too large to be observed; the message gives the largest one."""


class Recorder:
    """Subscribes through a bus that is not live and writes to a recording. Call :meth:`step` often."""

    def __init__(
        self,
        bus: Bus,
        recording: RecordingWriter,
        *,
        only: Collection[str] = CHOICES,
        everything: bool = False,
        digest: str = "",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start recording from ``bus``.

        ``everything``: record each actor at its full rate even if no actor receives it, which causes additional
        messages. ``digest``: digest of the scene to record; by default the digest of the first actor's scene.
        ``clock``: this process's clock [s].
        """
        self.bus = bus
        self.recording = recording
        self.digest = digest
        self.observers: set[str] = set()
        """Names of this recorder's own observers, which are not recorded."""
        self.greetings: dict[str, Hello] = {}
        """Hellos of the actors, by name."""
        self.malformed = 0
        """Number of messages that were recorded but cannot be decoded."""
        self._choices = frozenset(only)
        self._everything = everything
        self._clock = clock
        now = clock()
        self._network_clock = NetworkClock(bus, now, time.time() - now)
        self._is_subscribed = False
        self._live: set[str] = set()
        self._asked: dict[str, float] = {}
        self._described: dict[str, float] = {}
        """Time of the last query for each robot's description [s], by digest; infinite: it was recorded."""
        self._rejected: set[str] = set()
        self._positions: dict[str, np.ndarray] = {}
        self._all_poses: tuple[Subscription, ...] = ()
        """Subscriptions to the poses that all actors send, wherever they are: those of their regions, and coarse
        ones."""
        self._faster: dict[tuple[str, PoseLayer], tuple[Publisher, Subscription | None]] = {}
        """For each actor and each pose layer after the first: a publisher that reports whether the layer has
        subscribers, and this recorder's subscription to the layer, if any."""
        self._log_time = 0

    @property
    def actors(self) -> frozenset[str]:
        """Names of the actors that are present."""
        return frozenset(self._live)

    def step(self) -> None:
        """Record what has arrived and adapt the subscriptions.

        Raises :class:`vinesim.net.recording.mcap_writer.RecordingStopped` if the file cannot be written, and
        :class:`vinesim.net.replication.peers.WorldMismatch` if the first actor has another scene than ``digest``.
        """
        now = self._clock()
        self._network_clock.advance(now)
        self._network_clock.ping_if_due()
        self._process_replies()
        self.recording.check()
        if not self._network_clock.is_settled:
            return
        self._log_time = max(self._log_time + 1, int(self._network_clock.time * 1e9))
        if not self._is_subscribed:
            self._subscribe()
        self._poll_liveliness(now)
        for key, payload in self.bus.poll():
            if sender_of(key) not in self.observers:
                self._record(key, payload)
        self._update_pose_subscriptions()

    def close(self) -> None:
        """Undeclare the pose publishers and subscriptions."""
        for publisher, subscription in self._faster.values():
            publisher.close()
            if subscription is not None:
                subscription.close()

    # ------------------------------------------------------------ hear

    def _subscribe(self) -> None:
        self._is_subscribed = True
        for name, family in FAMILIES.items():
            if (
                name not in ("a", "pose") and family.recorded_with in self._choices
            ):  # poses: see _update_pose_subscriptions
                self.bus.subscribe(f"{name}/**", KEEP_ALL)
        if "facts" in self._choices:
            self.bus.query("snap/*/*")  # records of earlier changes

    def _put(self, key: str, payload: bytes) -> None:
        self.recording.put(self._log_time, key, payload)

    def _poll_liveliness(self, now: float) -> None:
        """Record which actors joined and left, and query actors whose hello is missing."""
        alive = self.bus.alive() - self.observers - {self.bus.name}
        for name in sorted(self._live - alive):
            self._live.discard(name)
            self._rejected.discard(name)
            self._positions.pop(name, None)
            self.greetings.pop(name, None)
            self._put(f"live/{name}", b"")
        for name in sorted(alive - self._live):
            self._live.add(name)
            self._asked.pop(name, None)
            self._put(f"live/{name}", b"\x01")
        for name in sorted(self._live - self.greetings.keys() - self._rejected):
            if now - self._asked.get(name, -math.inf) >= ASK_PERIOD:
                self._asked[name] = now
                self.bus.query(f"hello/{name}")
        for name, hello in sorted(self.greetings.items()):
            digest = hello.robot_digest
            if digest and now - self._described.get(digest, -math.inf) >= ASK_PERIOD:
                self._described[digest] = now
                self.bus.query(f"robot/{name}")

    def _process_replies(self) -> None:
        for key, payload, age in self.bus.replies():
            family, _, name = key.partition("/")
            try:
                if family == "clock":
                    self._network_clock.receive(payload, age)
                elif family == "hello" and name in self._live - self.greetings.keys() - self._rejected:
                    self._admit(name, payload)
                elif family == "robot" and name in self.greetings:
                    self._record_description(key, payload, self.greetings[name].robot_digest)
                elif family == "snap":
                    self._put(key, payload)
            except MessageError:
                self.malformed += 1

    def _admit(self, name: str, payload: bytes) -> None:
        """Record the hello of an actor. An actor of another scene is ignored, as by all actors."""
        try:
            hello = decode_hello(payload)
        except WrongVersion as error:
            self._reject(name, f"speaks protocol version {error.theirs}, this recorder version {PROTOCOL}")
            return
        if self.digest and hello.digest != self.digest:
            wanted = f"{self.recording.metadata.get('scene', '?')!r} with {self.digest!r}"
            self._reject(name, f"has scene {hello.scene!r} with digest {hello.digest!r}, this recording {wanted}")
            return
        if not self.digest:
            self.digest = hello.digest
            seed = {"seed": str(hello.seed)} if hello.seed >= 0 else {}
            self.recording.add_metadata(scene=hello.scene, digest=hello.digest, **seed)
        self.greetings[name] = hello
        self._put(f"hello/{name}", payload)

    def _record_description(self, key: str, payload: bytes, digest: str) -> None:
        """Record the description of a robot, once for all robots that have the same."""
        if self._described.get(digest) != math.inf:
            decode_description(payload, digest)
            self._described[digest] = math.inf
            self._put(key, payload)

    def _reject(self, name: str, why: str) -> None:
        text = f"{name!r} {why}: record with the scene, seed and release of vinesim that are used there"
        if not self.greetings:
            raise WorldMismatch(text)
        log.warning("ignoring an actor of another world: %s", text)
        self._rejected.add(name)

    def _record(self, key: str, payload: bytes) -> None:
        family = key.partition("/")[0]
        try:
            kind_of(payload)
            if family in ("a", "pose"):
                name = sender_of(key)
                self._positions[name] = decode_pose(payload, name).base_q[:3]
        except MessageError:
            self.malformed += 1
        if family in ("a", "pose") and "poses" not in self._choices:
            return
        self._put(key, payload)

    # ------------------------------------------------------------ who is heard by whom

    def _update_pose_subscriptions(self) -> None:
        """Subscribe to the poses that actors may receive: the slowest pose layer of all actors, and each faster layer
        that another actor may have subscribed to. A pose layer is a share of an actor's poses
        (:data:`vinesim.net.replication.interest.POSE_LAYERS`)."""
        has_company = self._everything or len(self._live) >= 2
        if has_company and not self._all_poses:
            region_key = interest.POSE_LAYERS[0].key.format(region="*/*", actor="*")
            keys = (region_key, interest.FAR_KEY.format(actor="*"))
            self._all_poses = tuple(self.bus.subscribe(key, KEEP_ALL) for key in keys)
        elif not has_company and self._all_poses:
            for subscription in self._all_poses:
                subscription.close()
            self._all_poses = ()
        for name, layer in [key for key in self._faster if key[0] not in self._live]:
            publisher, subscription = self._faster.pop((name, layer))
            publisher.close()
            if subscription is not None:
                subscription.close()
        for name, layer in itertools.product(self._live, interest.POSE_LAYERS[1:]):
            key = layer.key.format(actor=name)
            if (name, layer) not in self._faster:
                self._faster[name, layer] = self.bus.publisher(key), None
            publisher, subscription = self._faster[name, layer]
            wanted = "poses" in self._choices and (
                self._everything or (publisher.matching and self._has_company(name, layer))
            )
            if wanted and subscription is None:
                self._faster[name, layer] = publisher, self.bus.subscribe(key, KEEP_ALL)
            elif not wanted and subscription is not None:
                subscription.close()
                self._faster[name, layer] = publisher, None

    def _has_company(self, name: str, layer: PoseLayer) -> bool:
        """Returns whether another actor is near enough to be the subscriber of the actor's pose ``layer``.

        If not, the subscriber is another recorder, and two recorders would keep each other subscribed for ever.
        """
        if name not in self._positions:
            return False
        away = [
            math.dist(self._positions[name][:2], place[:2]) for other, place in self._positions.items() if other != name
        ]
        return min(away, default=math.inf) <= interest.LAYER_HYSTERESIS * layer.distance + COMPANY_MARGIN


def observer_grid(area: tuple[float, float, float, float]) -> list[tuple[float, float]]:
    """Returns positions of observers [m] such that every point of an area (x0, y0, x1, y1) [m] is within 5 m of an
    observer.

    Raises :class:`AreaTooLarge`.
    """
    x0, y0, x1, y1 = area
    if not (all(map(math.isfinite, area)) and x0 < x1 and y0 < y1):
        raise AreaTooLarge(f"area {x0:g} {y0:g} {x1:g} {y1:g}: give X0 Y0 X1 Y1 [m] with X0 < X1 and Y0 < Y1")
    columns = math.ceil((x1 - x0) / OBSERVER_SPACING)
    rows = math.ceil((y1 - y0) / OBSERVER_SPACING)
    if columns * rows > MAX_OBSERVERS:
        raise AreaTooLarge(
            f"an area of {x1 - x0:g} x {y1 - y0:g} m needs {columns * rows} observers, at most {MAX_OBSERVERS} are "
            f"possible: give a smaller one, e.g. {4 * OBSERVER_SPACING:g} x {4 * OBSERVER_SPACING:g} m"
        )
    return [
        (x0 + (column + 0.5) * (x1 - x0) / columns, y0 + (row + 0.5) * (y1 - y0) / rows)
        for column in range(columns)
        for row in range(rows)
    ]


class Observer:
    """A spectator without a simulation. Its presence makes actors publish the motion of objects around it."""

    def __init__(self, bus: Bus, place: tuple[float, float], scene: str, digest: str, now: float) -> None:
        """Join at ``place`` [m] through this observer's own live bus; ``now``: time of this process's clock [s]."""
        self.bus = bus
        hello = encode_hello(Hello(bus.name, kind="spectator", scene=scene, digest=digest, joints=0))
        bus.join(hello)
        bus.declare_queryable(f"hello/{bus.name}", lambda _: hello)
        self._positions = frames.pose([*place, 1.6])
        region = interest.region_chunks(interest.cell_of(np.array(place), interest.REGION_SIZE))
        self._pose = bus.publisher(interest.POSE_LAYERS[0].key.format(region=region, actor=bus.name))
        self._far = bus.publisher(interest.FAR_KEY.format(actor=bus.name))
        self._count = 0
        """Number of positions that were published."""
        self._network_clock = NetworkClock(bus, now, time.time() - now)
        self._due = -math.inf

    def step(self, now: float) -> None:
        """Publish this observer's position: five times a second for the actors around it, and rarely for all others."""
        self._network_clock.advance(now)
        self._network_clock.ping_if_due()
        for key, payload, age in self.bus.replies():
            if key.partition("/")[0] == "clock":
                self._network_clock.receive(payload, age)
        if now >= self._due:
            self._due = now + interest.POSE_LAYERS[0].every / interest.POSE_RATE
            update = RobotUpdate(
                self.bus.name, self._network_clock.time, self._positions, np.zeros(6), np.zeros(0), np.zeros(0)
            )
            self._pose.put(encode_robot(update))
            if self._count % (interest.FAR_EVERY // interest.POSE_LAYERS[0].every) == 0:
                self._far.put(encode_robot(update))
            self._count += 1
