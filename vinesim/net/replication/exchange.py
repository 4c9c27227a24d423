"""The network as a client's tick sees it: :meth:`Exchange.receive` before the step, :meth:`Exchange.send` after it.

What is decided here is decided by pure functions: who owns (:mod:`authority`), who is near (:mod:`interest`), whether
a record is due (:mod:`smooth`). Who is here is kept by :mod:`actors`, who owns what by :mod:`ownership`, what was said
of what moves by :mod:`streams`, and what stays true by :mod:`telling`; this class puts them together. Environment
records leave only when another actor is near what moves and somebody listens to its cell; else not one byte does.
A fact leaves once, whoever is near: the server keeps it.

Keys: ``c/<x>/<y>/<actor>`` what moves in a cell, ``own/<x>/<y>/<actor>`` claims and rest (reliable),
``fact/<x>/<y>/<actor>`` facts (reliable), and the question ``snap/<x>/<y>``: what is known of a cell.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable

import msgspec
import numpy as np

from vinesim.net.codec import messages
from vinesim.net.codec.human import decode_pose
from vinesim.net.codec.messages import Hello, MessageError, ObjectStates, RetainedRecord, TreeStates
from vinesim.net.counters import Counters, Traffic
from vinesim.net.replication import authority, dead_reckoning, interest
from vinesim.net.replication.authority import NOBODY, Claim
from vinesim.net.replication.hand_forces import WrenchSync
from vinesim.net.replication.interest import Cell
from vinesim.net.replication.ownership import Ownership
from vinesim.net.replication.peers import PeerRegistry, WorldMismatch
from vinesim.net.replication.retained_sync import RetainedSync
from vinesim.net.replication.streams import (
    NO_ROOTS,
    ClaimColumns,
    DetachedRoots,
    ObjectStream,
    StateReader,
    TreeStream,
    object_counts,
    with_roots,
)
from vinesim.net.transport.bus import KEEP_ALL, KEEP_LAST_64, Bus, Publisher, Reply, Subscription
from vinesim.scene.ids import is_tree
from vinesim.scene.model import Model
from vinesim.scene.values import HumanUpdate, ObjectUpdate, RobotUpdate, TreeUpdate

__all__ = ["Counters", "Inbox", "Replicator", "Traffic", "WorldMismatch"]

ADOPTION_DELAY = 0.5
"""What moves and is nobody's for so long [s] becomes the nearest actor's: somebody must say where it comes to rest."""

SPECTATOR = "spectator"
"""Kind of actor that owns nothing and says nothing but where it is."""

MAX_EARLY_MESSAGES = 100
"""So many messages with facts of one actor are kept until its greeting has come."""

_NOWHERE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclasses.dataclass(slots=True)
class Inbox:
    """What the network brought for this tick. States are extrapolated to now, times are the client's own."""

    joined: list[Hello] = dataclasses.field(default_factory=list)
    left: list[str] = dataclasses.field(default_factory=list)
    robots: dict[str, RobotUpdate] = dataclasses.field(default_factory=dict)
    """Every other robot whose pose is known, every tick: extrapolated at most 150 ms, corrections blended in 100 ms."""
    people: dict[str, HumanUpdate] = dataclasses.field(default_factory=dict)
    """The same of people."""
    wrenches: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """With what wrench [6] others push each of my links now: see :class:`vinesim.net.codec.human.Push`."""
    trees: list[TreeUpdate] = dataclasses.field(default_factory=list)
    """Trees of which their owner sent news: the last record of each, extrapolated at most 150 ms."""
    objects: list[ObjectUpdate] = dataclasses.field(default_factory=list)
    """Every box and loose bunch that somebody else moves, every tick, extrapolated at most 150 ms."""
    records: list[tuple[RetainedRecord, bool]] = dataclasses.field(default_factory=list)
    """What has become known for good, and whether its poses hold: they do not if something newer is known, but what
    was picked or cut stays so."""
    released: list[int] = dataclasses.field(default_factory=list)
    """Things another actor owned until now and nobody does any more: they rest, or their owner is gone."""


class Replicator:
    """One client's share in a world: call :meth:`receive` and :meth:`send` once a tick, from one thread.

    ``now`` is any clock of the client that runs in seconds; the offset to the server's clock is kept inside. Trees,
    boxes and loose bunches are things, numbered by :func:`vinesim.scene.ids.object_id`.
    """

    def __init__(
        self, bus: Bus, me: Hello, model: Model, *, near: float = interest.INTEREST_RADIUS, jitter_buffer: float = 0.0
    ) -> None:
        """``near`` [m]: others nearer than this to a thing see what I do to it (at most 5 m, what cells cover).

        ``jitter_buffer`` [s]: others' poses are shown so much later, and smoother, see :mod:`buffer`.
        """
        if me.name != bus.name:
            raise ValueError(f"greeting of {me.name!r} on the bus of {bus.name!r}: one actor has one name")
        self.bus, self.name, self.model = bus, me, model
        self.interest_radius = interest.check_radius(near)
        self.counters = Counters()
        self._actors = PeerRegistry(bus, me, self.counters, jitter_buffer)
        self._wrench_sync = WrenchSync(bus, me.name)
        self._ownership = Ownership(me.name, self._actors.known)
        self._retained = RetainedSync(bus, self.counters)
        self._tree_stream = TreeStream(model)
        self._object_stream = ObjectStream()
        self._counts = object_counts(model)
        self._orphans: dict[int, float] = {}
        self._early: dict[str, list[tuple[str, bytes]]] = {}
        self._window: Cell | None = None
        self._position = np.zeros(3)
        self._cell_subscriptions: dict[Cell, tuple[Subscription, Subscription]] = {}
        self._cell_publishers: dict[Cell, tuple[Publisher, Publisher]] = {}
        self._now: float | None = None
        self._last_sent = -1e9

    # ------------------------------------------------------------ questions

    @property
    def local_actors(self) -> set[str]:
        """Actors of the same client: they share its world and need not be told of it, nor heard."""
        return self._actors.local_actors

    @local_actors.setter
    def local_actors(self, names: set[str]) -> None:
        self._actors.local_actors = set(names)

    def owner(self, thing: int) -> str | None:
        """Who owns a thing now: a live actor's name (perhaps one's own), or None."""
        return self._ownership.owner(thing)

    def claim(self, thing: int) -> Claim:
        """The greatest claim on a thing that was made or heard."""
        return self._ownership.claim(thing)

    def record(self, thing: int) -> RetainedRecord | None:
        """What is known of a thing for good."""
        return self._retained.state.get(thing)

    @property
    def owned(self) -> frozenset[int]:
        """What I own."""
        return frozenset(self._ownership.owned)

    @property
    def known(self) -> frozenset[int]:
        """All things on which any claim was made or heard."""
        return frozenset(self._ownership.known)

    @property
    def peers(self) -> dict[str, Hello]:
        """The greetings of all others who are in this world now."""
        return {name: actor.hello for name, actor in self._actors.known.items()}

    @property
    def offset(self) -> float:
        """Network time minus the client's own [s]."""
        return self._actors.clock.offset

    # ------------------------------------------------------------ receive

    def receive(self, now: float) -> Inbox:
        """All that arrived since the last call, decided upon; :class:`Mismatch` if I do not belong to this world."""
        inbox, actors = Inbox(), self._actors
        actors.clock = actors.clock.advanced(now - self._now if self._now is not None else 0.0)
        self._now = now
        time = now + self.offset
        inbox.left = actors.poll_liveliness(now)
        for name in inbox.left:
            self._ownership.remove_actor(name, time, self._successor_of)
            self._wrench_sync.remove_peer(name)
        inbox.joined, answers = actors.process_replies(now)
        for answer in answers:
            self._take_snapshot(answer, time, inbox)
        news: dict[int, tuple[TreeStates, str]] = {}
        early = [letter for hello in inbox.joined for letter in self._early.pop(hello.name, ())]
        for key, payload in early + self.bus.poll():
            self._dispatch(key, payload, time, news, inbox)
        self._ownership.expire(time)
        inbox.released = self._ownership.released()
        for thing in inbox.released:
            self._object_stream.remove(thing)
        inbox.trees = self._tree_stream.extrapolated(news, now, time)
        inbox.objects = self._object_stream.extrapolated(self._ownership.remote, now, time)
        shown = [actor.sample(time, now) for actor in actors.known.values() if actor.update is not None]
        inbox.robots = {update.actor: update for update in shown if isinstance(update, RobotUpdate)}
        inbox.people = {update.actor: update for update in shown if isinstance(update, HumanUpdate)}
        inbox.wrenches = self._wrench_sync.net_wrenches(now)
        for thing in self._ownership.corrections(time):
            if self.name.kind != SPECTATOR:
                self._publish_correction(thing)
        return inbox

    def _dispatch(
        self, key: str, payload: bytes, time: float, news: dict[int, tuple[TreeStates, str]], inbox: Inbox
    ) -> None:
        """One message: whose it is stands in its key, never in the payload."""
        family, _, rest = key.partition("/")
        parts = rest.split("/")
        sender = parts[0] if family == "a" else parts[-1]
        counters = self.counters
        families = {
            "a": counters.actor, "c": counters.environment, "fact": counters.retained, "force": counters.force
        }  # fmt: skip
        families.get(family, counters.event).count_in(payload)
        actor = self._actors.known.get(sender)
        if actor is None and not (family == "fact" and self._may_publish_record(sender, key, payload)):
            counters.dropped += sender not in self.local_actors
            return
        try:
            if family == "a":
                assert actor is not None
                counters.dropped += not actor.receive(decode_pose(payload, sender), time)
                return
            if family == "force":
                counters.dropped += not self._wrench_sync.receive(payload, sender, time - self.offset)
                return
            cell = int(parts[0]), int(parts[1])
            kind = messages.kind_of(payload)
            if family == "fact":
                for fact in messages.decode_records(payload, self._counts):
                    if fact.author != sender:
                        raise MessageError(f"fact by {fact.author!r} said by {sender!r}")
                    self._receive_record(cell, fact, time, inbox, told=sender not in self.local_actors)
            elif kind == messages.MessageKind.CLAIMS:
                for thing, claim, touching in messages.decode_claims(payload, self._counts):
                    self._ownership.receive_claim(thing, claim, touching, sender, time)
            elif kind == messages.MessageKind.OBJECTS:
                self._receive_objects(messages.decode_objects(payload, cell), cell, sender, time)
            else:
                self._receive_trees(messages.decode_trees(payload, self.model.tree_size), sender, time, news)
        except MessageError as error:
            self._actors.count_malformed(sender, error)

    def _may_publish_record(self, sender: str, key: str, payload: bytes) -> bool:
        """Whether a fact of somebody who is not here counts. One who is about to be let in is heard then: nobody says
        a fact twice.
        """
        if sender in self.local_actors or sender in self._actors.seen_names:
            return True
        if not self._actors.is_rejected(sender) and len(self._early.setdefault(sender, [])) < MAX_EARLY_MESSAGES:
            self._early[sender].append((key, payload))
        return False

    def _receive_trees(
        self, trees: TreeStates, sender: str, time: float, news: dict[int, tuple[TreeStates, str]]
    ) -> None:
        """Judge every record by its claim."""
        near = self._within_radius(self._tree_stream.middle[trees.tree])
        columns = (trees.tree, trees.ownership, trees.authority, trees.flags)
        for row, (tree, ownership, seq, flags) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
            claim = Claim(ownership, seq, NOBODY if flags & messages.RESTING else sender)
            believed = self._ownership.receive_state(tree, claim, bool(flags & messages.TOUCHED), trees.time, time)
            if believed and near[row]:
                news[tree] = (trees, sender)
            else:
                self.counters.dropped += 1

    def _receive_objects(self, things: ObjectStates, cell: Cell, sender: str, time: float) -> None:
        """Judge every record by its claim."""
        for update in things.updates(sender):
            messages.check_object_id(update.object, self._counts)
        near = self._within_radius(things.pose[:, :3])
        for row, (update, flags) in enumerate(zip(things.updates(sender), things.flags.tolist(), strict=True)):
            claim = Claim(update.ownership, update.authority, sender)
            believed = self._ownership.receive_state(
                update.object, claim, bool(flags & messages.TOUCHED), things.time, time
            )
            if believed and near[row]:
                self._object_stream.receive(update, cell)
            else:
                self.counters.dropped += 1

    def _receive_record(
        self, cell: Cell, fact: RetainedRecord, time: float, inbox: Inbox, *, told: bool = True
    ) -> None:
        """Take a fact over if it is news; the client must be ``told``, unless it is its own."""
        if not self._retained.merge(cell, fact):
            return
        claim = Claim(fact.ownership, fact.authority, fact.author if fact.moving else NOBODY)
        holds = self._ownership.receive_retained(fact.object, claim, fact.moving, time)
        if told:
            inbox.records.append((self._retained.state.get(fact.object) or fact, holds))

    def _take_snapshot(self, answer: Reply, time: float, inbox: Inbox) -> None:
        """What the server knows of a cell."""
        family, *parts = answer.key.split("/")
        if family != "snap" or len(parts) != 2:
            return
        try:
            cell = int(parts[0]), int(parts[1])
            facts = messages.decode_records(answer.payload, self._counts)
        except (MessageError, ValueError) as error:
            self._actors.count_malformed("the server", MessageError(str(error)))
            return
        self._retained.mark_answered(cell)
        for fact in facts:
            self._receive_record(cell, fact, time, inbox)

    def _within_radius(self, where: np.ndarray) -> np.ndarray:
        """Which places [k, 3] are near enough for me to see what moves there [k] bool; hysteresis as for cells."""
        if self._window is None:
            return np.zeros(len(where), bool)
        away = where[:, :2] - self._position[:2]
        return np.einsum("ij,ij->i", away, away) <= (self.interest_radius + interest.HYSTERESIS) ** 2

    def _position_of(self, thing: int) -> np.ndarray:
        """Where a thing was last [3] m."""
        return self._tree_stream.middle[thing] if is_tree(thing) else self._object_stream.position(thing)

    def _cell_of(self, thing: int) -> Cell | None:
        return self._tree_stream.cell[thing] if is_tree(thing) else self._object_stream.cell(thing)

    def _successor_of(self, thing: int) -> str:
        """Who takes over what a gone actor moved."""
        return authority.choose_successor(self._position_of(thing), self._owner_candidates())

    def _owner_candidates(self) -> dict[str, np.ndarray]:
        """Where those are who can own things: all but onlookers."""
        known, where = self._actors.known, self._actors.positions()
        where = {name: place for name, place in where.items() if known[name].hello.kind != SPECTATOR}
        if self._window is not None and self.name.kind != SPECTATOR:
            where[self.name.name] = self._position
        return where

    def _publish_correction(self, thing: int) -> None:
        """Say what holds, to all who listen to the thing's cell."""
        known, cell = self._ownership[thing], self._cell_of(thing)
        if cell is not None and cell in self._cell_publishers:
            payload = messages.encode_claims([(thing, known.claim, known.touching)])
            self._put(self._cell_publishers[cell][1], payload, self.counters.event)

    # ------------------------------------------------------------ send

    def send(
        self,
        now: float,
        robot: RobotUpdate | HumanUpdate,
        *,
        touched: Iterable[int] = (),
        moving: Iterable[int] = (),
        read: StateReader,
        grabbed: Iterable[int] = (),
        parted: Iterable[int] = (),
        cut: Callable[[int], DetachedRoots] = lambda _: NO_ROOTS,
        lies: Callable[[int], tuple[str, np.ndarray]] | None = None,
        changed: Callable[[int], bool] = lambda _: False,
        pushed: dict[str, dict[str, np.ndarray]] | None = None,
    ) -> list[TreeUpdate]:
        """Say what must be said this tick; returns the rest records that left, exactly as all copies hold them.

        ``robot`` is my pose (its ``time`` is replaced by ``now``; a spectator passes its viewpoint, without joints).
        ``touched``: things I am in contact with now, boxes and bunches only while they move in their parent's frame;
        ``moving``: things that still move by themselves (trees and boxes that are others' are ignored); ``grabbed``:
        things that I grabbed, picked or cut this tick, and ``parted`` those of them that everybody must know of for
        good. ``read(thing)`` gives joints ([n, 4], [n, 3] rad/s) of a tree, and is called only for trees that somebody
        near may have to hear of, or pose [7] and velocity [6] of any other thing. ``cut(tree)`` tells what was cut off
        a tree, ``lies(thing)`` parent and pose [7] in its frame, and whether a tree was ``changed`` for good by picks
        or cuts: then the shape in which it comes to rest is a fact. ``pushed``: what my hands did to others' robots in
        this tick, by robot and link, as wrenches [6].
        """
        time = self._last_sent = max(now + self.offset, self._last_sent + 1e-6)
        self._position = np.asarray(robot.base_q[:3], float)
        self._actors.publish_pose(robot, now, time)
        for payload in self._wrench_sync.publish(pushed or {}, now, time):
            self.counters.force.count_out(payload)
        touched, moving = {int(thing) for thing in touched}, {int(thing) for thing in moving}
        for thing in sorted({int(thing) for thing in grabbed}):
            self._ownership.grab(thing)
            touched.add(thing)
        for thing in sorted(touched):
            self._ownership.touch(thing)
        self._adopt_orphans(moving - touched, now, read)
        self._update_interest(now)
        mine = self._ownership.owned
        active = tuple(sorted(mine & (touched | moving)))
        left: list[TreeUpdate] = []
        if mine:
            for thing in sorted(mine.difference(active)):
                if not is_tree(thing):
                    self._publish_object_at_rest(thing, read, lies)
                elif (rest := self._publish_tree_at_rest(thing, read, cut, time, changed(thing))) is not None:
                    left.append(rest)
        for thing in sorted({int(thing) for thing in parted} & mine):
            self._publish_detachment(thing, read, cut, time)
        self._retained.flush()
        split = sum(map(is_tree, active))
        for stream, share in ((self._tree_stream, active[:split]), (self._object_stream, active[split:])):
            if share:
                self._stream(stream, share, touched, read, cut, time)
        return left

    def _adopt_orphans(self, moving: set[int], now: float, read: StateReader) -> None:
        """What moves and has been nobody's for a while becomes mine, if nobody is nearer."""
        homeless = {thing for thing in moving if not is_tree(thing) and self.owner(thing) is None}
        self._orphans = {thing: self._orphans.get(thing, now) for thing in homeless}
        for thing in sorted(thing for thing, since in self._orphans.items() if now - since >= ADOPTION_DELAY):
            if authority.choose_successor(read(thing)[0][:3], self._owner_candidates()) == self.name.name:
                self._ownership.take_over(thing)

    def _update_interest(self, now: float) -> None:
        """Move the window of cells and the circle of actors heard at the full rate."""
        window = interest.move_window(self._window, self._position)
        owned = {cell for thing in self._ownership.owned if (cell := self._cell_of(thing)) is not None}
        if window != self._window or not owned <= self._cell_subscriptions.keys() or len(self._cell_subscriptions) > 9:
            self._window = window
            wanted = interest.cell_window(window) | owned
            for cell in sorted(self._cell_subscriptions.keys() - wanted):
                for end in (*self._cell_subscriptions.pop(cell), *self._cell_publishers.pop(cell)):
                    end.close()
            for cell in sorted(wanted - self._cell_subscriptions.keys()):
                self._cell_subscriptions[cell] = (
                    self.bus.subscribe(f"c/{cell[0]}/{cell[1]}/*", KEEP_LAST_64),
                    self.bus.subscribe(f"own/{cell[0]}/{cell[1]}/*", KEEP_ALL),
                )
                self._cell_publishers[cell] = (
                    self.bus.publisher(f"c/{cell[0]}/{cell[1]}/{self.name.name}"),
                    self.bus.publisher(f"own/{cell[0]}/{cell[1]}/{self.name.name}", reliable=True),
                )
        self._retained.update_window(self._cell_subscriptions, now)
        self._actors.update_interest(self._position)

    def _count_listeners(self, where: np.ndarray) -> np.ndarray:
        """How many other actors are near each place [k, 3]: [k] int."""
        others = np.array(list(self._actors.positions().values())).reshape(-1, 3)
        return interest.count_listeners(where, others, self.interest_radius)

    def _stream(
        self, stream: TreeStream | ObjectStream, active: tuple[int, ...], touched: set[int], read: StateReader,
        cut: Callable[[int], DetachedRoots], time: float,
    ) -> None:  # fmt: skip
        """One batch per cell of what copies would otherwise have wrong."""
        known = [self._ownership[thing] for thing in active]
        audience = self._count_listeners(stream.positions(active, read))
        contact = [thing in touched for thing in active]
        if not audience.any():
            for one, touching in zip(known, contact, strict=True):
                one.said_to, one.touching = 0, touching
            return
        silence = time - np.array([one.said_at for one in known])
        due = dead_reckoning.needs_update(*stream.prediction_error(active, silence, read, cut), silence)
        for row, (one, touching) in enumerate(zip(known, contact, strict=True)):
            # somebody came near, or the claim or the contact changed: copies must know at once
            due[row] |= audience[row] > one.said_to or one.touching != touching
            one.touching = touching
            one.said_to = min(one.said_to, int(audience[row]))
        due &= audience > 0

        cells = stream.cells(active)
        by_cell: dict[Cell, list[int]] = {}
        for row in np.flatnonzero(due).tolist():
            by_cell.setdefault(cells[row], []).append(row)
        for cell, rows in sorted(by_cell.items()):
            voice, events = self._cell_publishers.get(cell, (None, None))
            if voice is None or events is None or not voice.matching:
                continue
            here = [(active[row], known[row]) for row in rows]
            fresh = [(thing, one.claim, one.touching) for thing, one in here if not one.announced]
            if fresh:
                self._put(events, messages.encode_claims(fresh), self.counters.event)
            said = ClaimColumns([one.claim for _, one in here], [messages.TOUCHED * one.touching for _, one in here])
            for payload in stream.encode(rows, said, time, cell):
                self._put(voice, payload, self.counters.environment)
            for row in rows:
                known[row].announced, known[row].said_at, known[row].said_to = True, time, int(audience[row])

    # ------------------------------------------------------------ rest and facts

    def _publish_tree_at_rest(
        self, tree: int, read: StateReader, cut: Callable[[int], DetachedRoots], time: float, changed: bool
    ) -> TreeUpdate | None:
        """A tree that I moved lies still: one reliable record to those who are near, and silence.

        If it is not the tree that everybody knows from the start, the record is a fact.
        """
        if changed:
            self._ownership.increment(tree)
        known, held = self._ownership[tree], self._ownership.release(tree)
        cell = self._tree_stream.cell[tree]
        _, events = self._cell_publishers.get(cell, (None, None))
        heard = self._count_listeners(self._tree_stream.middle[[tree]])[0] and events is not None and events.matching
        if not (heard or changed):
            if not known.announced:
                self._ownership.rollback(tree)
            return None
        payload, update = self._state_of(tree, held, read, cut, time)
        if changed:
            self._publish_record(
                cell,
                RetainedRecord(tree, held.ownership, held.authority, self.name.name, _NOWHERE, "", (), payload),
                cut,
            )
        if heard and events is not None:
            self._put(events, payload, self.counters.event)
        known.announced, known.said_at = True, time
        return update

    def _state_of(
        self,
        tree: int,
        claim: Claim,
        read: StateReader,
        cut: Callable[[int], DetachedRoots],
        time: float,
        flags: int = messages.RESTING,
    ) -> tuple[bytes, TreeUpdate]:
        """A tree's state as a message, and as all who read it have it."""
        q, qd = read(tree)
        numbers, x, xd = cut(tree)
        still = 0.0 if flags & messages.RESTING else 1.0
        said = ClaimColumns([claim], [flags])
        batch = TreeStates(
            time, np.array([tree]), *said.columns(), np.array([len(q)]), np.asarray(q, float),
            still * np.asarray(qd, float),
        )  # fmt: skip
        (payload,), heard = messages.encode_trees(with_roots(batch, [(numbers, x, still * xd)]))
        (update,) = heard.updates(self.name.name)
        return payload, update

    def _publish_object_at_rest(
        self, thing: int, read: StateReader, lies: Callable[[int], tuple[str, np.ndarray]] | None
    ) -> None:
        """A box or a bunch that I moved lies still in its parent's frame: a fact, and silence."""
        assert lies is not None, f"thing {thing} rests, and nobody can say where"
        self._ownership.increment(thing)
        held = self._ownership.release(thing)
        self._object_stream.positions((thing,), read)
        parent, pose = lies(thing)
        self._ownership[thing].announced = True
        self._publish_record(
            self._object_stream.cells((thing,))[0],
            RetainedRecord(thing, held.ownership, held.authority, self.name.name, tuple(pose.tolist()), parent),
        )

    def _publish_detachment(
        self, thing: int, read: StateReader, cut: Callable[[int], DetachedRoots], time: float
    ) -> None:
        """Something left its vine, and is moving: everybody must know at once, near or not."""
        claim = self._ownership.claim(thing)
        fact = RetainedRecord(thing, claim.ownership, claim.authority, self.name.name, moving=True)
        self._ownership[thing].announced = True
        if is_tree(thing):
            payload, _ = self._state_of(thing, claim, read, cut, time, messages.TOUCHED)
            self._publish_record(self._tree_stream.cell[thing], msgspec.structs.replace(fact, trees=payload), cut)
            return
        self._object_stream.positions((thing,), read)
        pose, _ = read(thing)
        fact = msgspec.structs.replace(fact, pose=tuple(np.asarray(pose, float).tolist()))
        self._publish_record(self._object_stream.cells((thing,))[0], fact)

    def _publish_record(
        self, cell: Cell, fact: RetainedRecord, cut: Callable[[int], DetachedRoots] | None = None
    ) -> None:
        """Say a fact; of a tree, with all that was cut off it."""
        if cut is not None:
            first = int(self.model.tree_first[fact.object])
            fact = msgspec.structs.replace(fact, cut=tuple((first + cut(fact.object)[0]).tolist()))
        self._retained.publish(cell, fact)

    def _put(self, publisher: Publisher, payload: bytes, traffic: Traffic) -> bool:
        if not publisher.put(payload):
            return False
        traffic.count_out(payload)
        return True
