"""The peers of one actor, which are the accepted actors (robots, people, spectators) of other clients in its world:
which are live, their hellos, their poses, and the common clock. A hello is the message with which an actor introduces
itself: name, kind, scene.

Keys: the poses of an actor are divided among ``a/<actor>/far``, ``a/<actor>/mid``, ``a/<actor>/near`` and
``a/<actor>``. The nearer a peer is, the more of these keys it subscribes to
(:data:`vinesim.net.replication.interest.POSE_LAYERS`). Queries use ``hello/<actor>`` and ``clock/<actor>``.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import zlib
from collections.abc import Iterator

import numpy as np

from vinesim.net.codec.control import Hello, decode_hello, encode_hello
from vinesim.net.codec.header import PROTOCOL, MessageError, WrongVersion
from vinesim.net.codec.human import encode_pose
from vinesim.net.codec.messages import Counters
from vinesim.net.replication import interest
from vinesim.net.replication.jitter_buffer import JitterBuffer
from vinesim.net.replication.network_clock import NetworkClock
from vinesim.net.replication.remote_pose import RemotePose
from vinesim.net.transport.bus import KEEP_LAST_1, Bus, Reply
from vinesim.scene.values import HumanUpdate, RobotUpdate

log = logging.getLogger(__name__)

ASK_PERIOD = 0.5
"""Time between two queries for a peer's hello [s]."""

_LONG_AGO = -1e9


class WorldMismatch(RuntimeError):
    """Two actors cannot share a world, because their scenes or their protocol versions differ."""

    exit_code = 4


class PeerRegistry:
    """All peers of one actor. A *peer* is an accepted actor (robot, person or spectator) of another client in the same
    world. Constructing the registry joins the world."""

    def __init__(self, bus: Bus, hello: Hello, counters: Counters, jitter_buffer: float = 0.0) -> None:
        """Join the world and offer the own ``hello`` to peers. Raises what :meth:`Bus.join` raises.

        ``jitter_buffer``: delay with which poses of peers are shown [s]; 0: they are extrapolated.
        """
        self.bus = bus
        self.hello = hello
        self.counters = counters
        self._jitter_buffer = JitterBuffer(jitter_buffer).delay
        self._local_actors: set[str] = set()
        self._alive: frozenset[str] | None = None
        """All live names, if each of them is a known, rejected or local actor; None while a hello is missing."""
        self.clock = NetworkClock(bus)
        self.known: dict[str, RemotePose] = {}
        self.seen_names: set[str] = set()
        """Names of all peers that were ever accepted. Their last retained records may arrive after they have left."""
        greeting = encode_hello(hello)
        bus.join(greeting)
        bus.declare_queryable(f"hello/{hello.name}", lambda _: greeting)
        self._initial_names = bus.alive() - {hello.name}
        self._queried: dict[str, float] = {}
        self._rejected: set[str] = set()
        self._warned: set[str] = set()
        self._unread: tuple[Reply, ...] = ()
        """Replies to other queries than pings that arrived in :meth:`keep_clock` and wait for
        :meth:`process_replies`."""
        self._layers = [bus.publisher(f"a/{hello.name}{layer.suffix}") for layer in interest.POSE_LAYERS]
        bus.subscribe(f"a/*{interest.POSE_LAYERS[0].suffix}", KEEP_LAST_1)
        self._pose_number: int | None = None
        """Number of the last pose that was due; None before the first one."""
        self._phase = zlib.crc32(hello.name.encode()) % 1024 / 1024.0 * interest.POSE_LAYERS[0].every

    def positions(self) -> dict[str, np.ndarray]:
        """Returns the positions [3] m of all peers whose pose is known, by name."""
        return {name: actor.update.base_q[:3] for name, actor in self.known.items() if actor.update is not None}

    # ------------------------------------------------------------ who is here

    @property
    def local_actors(self) -> set[str]:
        """Names of the other actors of the same client, which are no peers."""
        return self._local_actors

    @local_actors.setter
    def local_actors(self, names: set[str]) -> None:
        self._local_actors = names
        self._alive = None

    def poll_liveliness(self, now: float) -> list[str]:
        """Send due queries: for the hellos of new peers, and for the server's clock. Returns the peers that have left.

        ``now``: own time [s].
        """
        live_names = self.bus.alive()
        if live_names == self._alive:
            self.clock.ping_if_due()
            return []
        alive = live_names - self._local_actors
        gone = sorted(self.known.keys() - alive)
        for name in gone:
            actor = self.known.pop(name)
            self._queried.pop(name, None)
            self._warned.discard(name)
            for channel in actor.near:
                channel.close()
        self._rejected &= alive
        self._initial_names &= alive
        strangers = sorted(alive - self.known.keys() - self._rejected - {self.hello.name})
        for name in strangers:
            if now - self._queried.get(name, _LONG_AGO) >= ASK_PERIOD:
                self._queried[name] = now
                self.bus.query(f"hello/{name}")
        self._alive = None if strangers else live_names
        self.clock.ping_if_due()
        return gone

    def keep_clock(self, now: float) -> None:
        """Advance the clock to real time ``now`` [s], send a ping to the server if it is due, and process replies to
        pings.

        Called between steps that are far apart. Other replies wait for :meth:`process_replies`.
        """
        self.clock.advance(now)
        self.clock.ping_if_due()
        others: list[Reply] = []
        for answer in self.bus.replies():
            if answer.key.partition("/")[0] == "clock":
                self.counters.control.count_in(answer.payload)
                try:
                    self.clock.receive(answer.payload, answer.age)
                except MessageError as error:
                    self.count_malformed("the clock", error)
            else:
                others.append(answer)
        self._unread += tuple(others)

    def process_replies(self) -> tuple[list[Hello], list[Reply]]:
        """Process the replies to queries for hellos and for the server's clock.

        Returns the hellos of new peers, and the replies to all other queries.
        """
        joined: list[Hello] = []
        others: list[Reply] = []
        answers = (*self._unread, *self.bus.replies())
        self._unread = ()
        for answer in answers:
            key, payload, age = answer
            self.counters.control.count_in(payload)
            family, _, name = key.partition("/")
            try:
                if family == "clock":
                    self.clock.receive(payload, age)
                elif family != "hello":
                    others.append(answer)
                elif name in self.bus.alive() and name not in self.known and name not in self._rejected:
                    joined += self._admit(name, payload)
            except MessageError as error:
                self.count_malformed(name or "the clock", error)
        return joined, others

    def _admit(self, name: str, payload: bytes) -> Iterator[Hello]:
        """Accept a live actor as a peer, and yield its hello, unless it has another scene or protocol version.

        ``payload``: the encoded hello.
        """
        try:
            hello = decode_hello(payload)
        except WrongVersion as error:
            self._reject(name, f"speaks protocol version {error.theirs}, {self.hello.name!r} version {PROTOCOL}")
            return
        if hello.name != name:
            raise MessageError(f"{name!r} introduces itself as {hello.name!r}")
        if hello.digest != self.hello.digest:
            self._reject(
                name,
                f"has scene {hello.scene!r} with digest {hello.digest!r}, "
                f"{self.hello.name!r} has {self.hello.scene!r} with {self.hello.digest!r}",
            )
            return
        self.known[name] = RemotePose(hello, self._jitter_buffer)
        self.seen_names.add(name)
        yield hello

    def _reject(self, name: str, why: str) -> None:
        """Reject an actor as a peer, if it joined after this actor. ``why``: the reason, without the name.

        Raises :class:`WorldMismatch` if it was live before this actor: then it is this actor that does not belong to
        the world.
        """
        text = f"{name!r} {why}: start both with the same scene, seed and release of vinesim"
        if name in self._initial_names:
            raise WorldMismatch(text)
        log.warning("ignoring a newcomer: %s", text)
        self._rejected.add(name)
        self.seen_names.discard(name)

    def is_rejected(self, name: str) -> bool:
        """Whether a live actor was rejected as a peer, because it has another scene or protocol version."""
        return name in self._rejected

    def may_join(self, name: str) -> bool:
        """Whether an actor is a peer or may become one: it is live and was not rejected."""
        return name in self.bus.alive() and name not in self._rejected

    def was_admitted(self, name: str) -> bool:
        """Whether an actor was ever accepted as a peer, or belongs to the same client."""
        return name in self.seen_names or name in self._local_actors

    def count_malformed(self, sender: str, error: MessageError) -> None:
        """Count an invalid message, and log the first one of each sender."""
        self.counters.malformed += 1
        if sender not in self._warned:
            self._warned.add(sender)
            log.warning("dropped a message of %r, further ones are only counted: %s", sender, error)

    # ------------------------------------------------------------ poses

    def update_interest(self, position: np.ndarray) -> None:
        """Subscribe to more layers of the poses of near peers, and to fewer of far ones. ``position`` [3] m: own
        position."""
        for name, actor in self.known.items():
            if actor.update is None:
                continue
            away = float(np.hypot(*(actor.update.base_q[:2] - position[:2])))
            wanted = interest.count_layers(away, 1 + len(actor.near)) - 1
            while len(actor.near) > wanted:
                actor.near.pop().close()
            for layer in interest.POSE_LAYERS[1 + len(actor.near) : 1 + wanted]:
                actor.near.append(self.bus.subscribe(f"a/{name}{layer.suffix}", KEEP_LAST_1))

    def publish_pose(self, robot: RobotUpdate | HumanUpdate, now: float, time: float) -> None:
        """Publish the own pose on one of the :data:`~vinesim.net.replication.interest.POSE_LAYERS`, if it is due at own
        time ``now`` [s]: 60 times a second.

        ``time``: network time [s], which becomes the time of the pose. The pose is encoded only if the layer has a
        subscriber.
        """
        number = math.floor(now * interest.POSE_RATE + self._phase + 1e-6)
        before = self._pose_number
        if number == before:
            return
        self._pose_number = number
        if before is None:  # so actors that join at one moment need not publish at the same moments
            return
        publisher = self._layers[interest.pose_layer(before, number)]
        if publisher.matching:
            payload = encode_pose(dataclasses.replace(robot, actor=self.hello.name, time=time))
            if publisher.put(payload):
                self.counters.actor.count_out(payload)
