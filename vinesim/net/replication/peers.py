"""The peers of one actor, which are the accepted actors (robots, people, spectators) of other clients in its world:
which are live, their hellos, their poses, and the common clock. A hello is the message with which an actor introduces
itself: name, kind, scene.

Keys: the poses of an actor are divided among ``pose/<x>/<y>/<actor>``, which contains the actor's region,
``a/<actor>/mid``, ``a/<actor>/near`` and ``a/<actor>``. A peer subscribes to the regions around itself, and the nearer
it is, to the more of the other keys (:data:`vinesim.net.replication.interest.POSE_LAYERS`). Coarse poses under
``a/<actor>/far`` go to all. Queries use ``hello/<actor>``, ``robot/<actor>`` and ``clock/<actor>``.

A peer is *near* while its poses arrive, it is within :data:`vinesim.net.replication.interest.BODY_DISTANCE`, with
hysteresis, and it is one of the nearest :data:`vinesim.net.replication.interest.MAX_BODIES`. Of other peers only the
hello and the last known position are known.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import zlib
from collections.abc import Collection, Iterator

import numpy as np

from vinesim.net.codec.control import (
    Description,
    Hello,
    decode_description,
    decode_hello,
    encode_description,
    encode_hello,
)
from vinesim.net.codec.header import PROTOCOL, MessageError, WrongVersion
from vinesim.net.codec.human import encode_pose
from vinesim.net.codec.messages import Counters
from vinesim.net.replication import interest
from vinesim.net.replication.interest import Cell
from vinesim.net.replication.jitter_buffer import JitterBuffer
from vinesim.net.replication.network_clock import NetworkClock
from vinesim.net.replication.remote_pose import RemotePose
from vinesim.net.transport.bus import KEEP_LAST_1, Bus, Publisher, Reply, Subscription
from vinesim.scene.values import HumanUpdate, RobotUpdate

log = logging.getLogger(__name__)

ASK_PERIOD = 0.5
"""Time between two queries for a peer's hello [s]."""

GREETING_RATE = 20.0
GREETING_BURST = 64.0
"""Number of hellos of peers that an actor queries a second in the long run, and at once. Peers of which a message has
arrived come first. So an actor that joins a world of 1,000 actors knows all of them after 47 s, and its neighbours at
once. GUESSED."""

INTEREST_PERIOD = 0.05
"""Time between two choices of the pose layers of near peers [s]."""

CROWD_PERIOD = 0.5
"""Time between two counts of the peers that share this actor's window of regions [s]."""

MAX_DESCRIPTIONS = 64
"""Largest number of descriptions of robots that a client keeps, each of at most 1 MiB. The oldest is dropped."""

_LONG_AGO = -1e9


class WorldMismatch(RuntimeError):
    """Two actors cannot share a world, because their scenes or their protocol versions differ."""

    exit_code = 4


class PeerRegistry:
    """All peers of one actor. A *peer* is an accepted actor (robot, person or spectator) of another client in the same
    world. Constructing the registry joins the world."""

    def __init__(
        self,
        bus: Bus,
        hello: Hello,
        counters: Counters,
        jitter_buffer: float = 0.0,
        descriptions: dict[str, Description] | None = None,
    ) -> None:
        """Join the world and offer the own ``hello`` to peers. Raises what :meth:`Bus.join` raises.

        ``jitter_buffer``: delay with which poses of peers are shown [s]; 0: they are extrapolated. ``descriptions``:
        known descriptions of robots by digest, which the actors of one client share.
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
        self.near: dict[str, RemotePose] = {}
        """The near ones of :attr:`known`."""
        self.seen_names: set[str] = set()
        """Names of all peers that were ever accepted. Their last retained records may arrive after they have left."""
        self._descriptions = {} if descriptions is None else descriptions
        greeting = encode_hello(hello)
        bus.join(greeting)
        bus.declare_queryable(f"hello/{hello.name}", lambda _: greeting)
        if hello.urdf:
            description = encode_description(hello)
            bus.declare_queryable(f"robot/{hello.name}", lambda _: description)
            self._descriptions[decode_hello(greeting).robot_digest] = Description(hello.urdf, hello.sidecar)
        self._initial_names = bus.alive() - {hello.name}
        self._queried: dict[str, float] = {}
        """Own time of the last query for the hello of each live name [s]."""
        self._described: dict[str, float] = {}
        """Own time of the last query for each description [s], by digest; infinite: it was refused."""
        self._urgent: set[str] = set()
        """Names without a hello of which another message has arrived."""
        self._credit = GREETING_BURST
        """Number of hellos that may be queried now."""
        self._credited = _LONG_AGO
        self._rejected: set[str] = set()
        self._warned: set[str] = set()
        self._unread: tuple[Reply, ...] = ()
        """Replies to other queries than pings that arrived in :meth:`keep_clock` and wait for
        :meth:`process_replies`."""
        self.position: np.ndarray | None = None
        """Own position [3] m; None before the first :meth:`update_interest`."""
        self.region: Cell | None = None
        """Region in the middle of the window of regions, under which the own poses are published; None before the first
        :meth:`update_interest`."""
        self._published_region: Cell | None = None
        self._regions: dict[Cell, Subscription] = {}
        self._layers: list[Publisher | None] = [
            None,
            *(bus.publisher(layer.key.format(actor=hello.name)) for layer in interest.POSE_LAYERS[1:]),
        ]
        """Publishers of the layers of the own poses; None: the own region is unknown yet."""
        self._far = bus.publisher(interest.FAR_KEY.format(actor=hello.name))
        bus.subscribe(interest.FAR_KEY.format(actor="*"), KEEP_LAST_1)
        self._thinning = self._far_thinning = 1
        """Whole numbers by which the rates of the first layer and of coarse poses are divided."""
        self._reach = interest.BODY_DISTANCE
        """Distance within which a peer becomes near [m]; smaller in a crowd."""
        self._interest_due = self._crowd_due = _LONG_AGO
        self._pose_number: int | None = None
        """Number of the last pose that was due; None before the first one."""
        self._phase = zlib.crc32(hello.name.encode()) % (1 << 20) / 97.0

    def positions(self) -> dict[str, np.ndarray]:
        """Returns the last known positions [3] m of all peers, also of far ones, by name."""
        return {name: actor.place for name, actor in self.known.items() if actor.place is not None}

    def near_positions(self) -> np.ndarray:
        """Returns the positions [k, 3] m of the near peers."""
        return np.array([actor.place for actor in self.near.values()]).reshape(-1, 3)

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
            self.known.pop(name).forget()
            self.near.pop(name, None)
            self._warned.discard(name)
        for name in self._queried.keys() - alive:
            del self._queried[name]
        self._rejected &= alive
        self._urgent &= alive
        self._initial_names &= alive
        strangers = alive - self.known.keys() - self._rejected - {self.hello.name}
        self._query_hellos(strangers, now)
        self._alive = None if strangers else live_names
        self.clock.ping_if_due()
        return gone

    def _query_hellos(self, strangers: Collection[str], now: float) -> None:
        """Query hellos of ``strangers`` at a bounded rate at own time ``now`` [s]: first of those of which a message
        arrived, then of those that were queried longest ago."""
        self._credit = min(GREETING_BURST, self._credit + GREETING_RATE * max(now - self._credited, 0.0))
        self._credited = now
        if self._credit < 1.0:
            return
        due = [name for name in strangers if now - self._queried.get(name, _LONG_AGO) >= ASK_PERIOD]
        due.sort(key=lambda name: (name not in self._urgent, self._queried.get(name, _LONG_AGO), name))
        for name in due[: int(self._credit)]:
            self._credit -= 1.0
            self._queried[name] = now
            self.bus.query(f"hello/{name}")

    def ask_soon(self, name: str) -> None:
        """Query the hello of a live name before those of others, because a message of it has arrived."""
        if name in self.bus.alive():
            self._urgent.add(name)

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
                elif family == "robot":
                    self._receive_description(name, payload)
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
        self._urgent.discard(name)
        self._queried.pop(name, None)
        yield hello

    def describe(self, name: str, now: float) -> Hello | None:
        """Returns the hello of a peer with its URDF. None: the description is not known yet, so it was queried at own
        time ``now`` [s], or it was refused."""
        hello = self.known[name].hello
        if not hello.robot_digest:
            return hello
        if (known := self._descriptions.get(hello.robot_digest)) is not None:
            return known.complete(hello)
        if now - self._described.get(hello.robot_digest, _LONG_AGO) >= ASK_PERIOD:
            self._described[hello.robot_digest] = now
            self.bus.query(f"robot/{name}")
        return None

    def _receive_description(self, name: str, payload: bytes) -> None:
        """Keep a description that arrived. Raises :class:`MessageError` if it is none or not the one that the actor has
        announced; it is not queried again then."""
        digest = self.known[name].hello.robot_digest if name in self.known else ""
        if digest not in self._described or digest in self._descriptions:
            return
        try:
            found = decode_description(payload, digest)
        except MessageError:
            self._described[digest] = math.inf
            raise
        del self._described[digest]
        self._descriptions[digest] = found
        while len(self._descriptions) > MAX_DESCRIPTIONS:
            del self._descriptions[next(iter(self._descriptions))]

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

    def receive_pose(
        self, peer: RemotePose, update: RobotUpdate | HumanUpdate, time: float, *, is_coarse: bool
    ) -> bool:
        """Store a pose of a peer that arrived at network ``time`` [s]. Returns whether it is newer than the last one.

        Of coarse poses and of far peers only the position is stored. Raises :class:`MessageError` if the pose does not
        fit the peer.
        """
        name = peer.hello.name
        if is_coarse or (name not in self.near and self._away(update.base_q) > self._reach):
            return peer.put(update, time)
        self.near[name] = peer
        return peer.receive(update, time)

    def _away(self, place: np.ndarray) -> float:
        """Returns the distance on the ground of a ``place`` from this actor [m]; 0 while its own position is
        unknown."""
        if self.position is None:
            return 0.0
        return math.hypot(place[0] - self.position[0], place[1] - self.position[1])

    def update_interest(self, position: np.ndarray, now: float) -> bool:
        """Follow the own ``position`` [3] m at own time ``now`` [s]: choose the window of regions, the near peers, and
        the pose layers of each of them.

        Returns whether it is time to choose what else is received from peers.
        """
        self.position = position
        region = interest.move_window(self.region, position, interest.REGION_SIZE)
        if region != self.region:
            self.region = region
            wanted = interest.cell_window(region)
            key = interest.POSE_LAYERS[0].key
            for cell in sorted(self._regions.keys() - wanted):
                self._regions.pop(cell).close()
            for cell in sorted(wanted - self._regions.keys()):
                pattern = key.format(region=interest.region_chunks(cell), actor="*")
                self._regions[cell] = self.bus.subscribe(pattern, KEEP_LAST_1)
        if 0.0 <= now - self._interest_due < INTEREST_PERIOD:
            return False
        self._interest_due = now
        self._choose_layers()
        if not 0.0 <= now - self._crowd_due < CROWD_PERIOD:
            self._crowd_due = now
            self._count_crowd()
        return True

    def _choose_layers(self) -> None:
        """Subscribe to more layers of the poses of near peers, the nearest ones first, and forget peers that are far
        now."""
        away = {name: self._away(actor.place) for name, actor in self.near.items() if actor.place is not None}
        order = sorted(away, key=lambda name: (away[name], name))
        self._reach = interest.BODY_DISTANCE
        if len(order) >= interest.MAX_BODIES:
            self._reach = min(self._reach, interest.NEARER * away[order[interest.MAX_BODIES - 1]])
        for rank, name in enumerate(order):
            actor = self.near[name]
            wanted = interest.count_layers(away[name], 1 + len(actor.near), rank)
            if wanted == 0:
                actor.forget()
                del self.near[name]
                continue
            while len(actor.near) > wanted - 1:
                actor.near.pop().close()
            for layer in interest.POSE_LAYERS[1 + len(actor.near) : wanted]:
                actor.near.append(self.bus.subscribe(layer.key.format(actor=name), KEEP_LAST_1))

    def _count_crowd(self) -> None:
        """Choose how much more rarely than usual the own poses are published, because others share their keys'
        subscribers."""
        assert self.region is not None
        places = np.array([actor.place[:2] for actor in self.known.values() if actor.place is not None]).reshape(-1, 2)
        offset = np.abs(interest.cells_of(places, interest.REGION_SIZE) - np.array(self.region))
        around = int(np.count_nonzero((offset <= 1).all(axis=1)))
        layer_rate = interest.POSE_RATE / interest.POSE_LAYERS[0].every
        self._thinning = interest.thinning(around, layer_rate, interest.REGION_BUDGET)
        far_rate = interest.POSE_RATE / interest.FAR_EVERY
        self._far_thinning = interest.thinning(len(self.bus.alive()) - 1, far_rate, interest.FAR_BUDGET)

    def publish_pose(self, robot: RobotUpdate | HumanUpdate, now: float, time: float) -> None:
        """Publish the own pose on one of the :data:`~vinesim.net.replication.interest.POSE_LAYERS`, if it is due at own
        time ``now`` [s]: 60 times a second. Publish a coarse pose, too, if one is due.

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
        layer = interest.pose_layer(before, number, self._thinning)
        left = self._follow_region()
        for publisher in (self._layers[layer], *left):
            if publisher is not None and publisher.matching:
                self._put(publisher, dataclasses.replace(robot, actor=self.hello.name, time=time))
        for publisher in left:
            publisher.close()
        share = interest.FAR_EVERY * self._far_thinning
        if number // share != before // share and self._far.matching:
            base_qd = robot.base_qd if isinstance(robot, RobotUpdate) else np.zeros(6)
            nothing = np.zeros(0)
            self._put(self._far, RobotUpdate(self.hello.name, time, robot.base_q, base_qd, nothing, nothing))

    def _follow_region(self) -> list[Publisher]:
        """Declare the publisher of poses in the own region if the region has changed.

        Returns the publisher of the region that was left, for one more pose: its subscribers then know where the actor
        is now.
        """
        if self.region is None or self.region == self._published_region:
            return []
        self._published_region = self.region
        left = self._layers[0]
        key = interest.POSE_LAYERS[0].key.format(region=interest.region_chunks(self.region), actor=self.hello.name)
        self._layers[0] = self.bus.publisher(key)
        return [] if left is None else [left]

    def _put(self, publisher: Publisher, update: RobotUpdate | HumanUpdate) -> None:
        payload = encode_pose(update)
        if publisher.put(payload):
            self.counters.actor.count_out(payload)
