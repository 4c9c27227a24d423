"""Incoming half of replication: what arrived on the bus is decoded, judged by its claim and put into an inbox."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.net.codec.control import CLAIMS, Hello, RetainedRecord, decode_claims, decode_records, encode_claims
from vinesim.net.codec.forces import COUPLINGS
from vinesim.net.codec.header import MessageError, is_valid_name, kind_of
from vinesim.net.codec.human import decode_pose
from vinesim.net.codec.objects import OBJECTS, ObjectStates, check_object_id, decode_objects
from vinesim.net.codec.trees import RESTING, TOUCHED, TreeStates, decode_trees
from vinesim.net.replication import interest
from vinesim.net.replication.authority import NO_OWNER, Claim
from vinesim.net.replication.early_messages import EarlyMessages
from vinesim.net.replication.hand_forces import MAX_POSE_AGE, LinkCentre
from vinesim.net.replication.interest import Cell
from vinesim.net.replication.model_check import check_record, check_tree_states
from vinesim.net.replication.replication_state import SPECTATOR, ReplicationState, put_counted
from vinesim.net.transport.bus import Reply
from vinesim.scene.values import Coupling, HumanUpdate, ObjectUpdate, RobotUpdate, TreeUpdate


def _no_link(_: str) -> None:
    """The actor is no robot."""


@dataclasses.dataclass(slots=True)
class Inbox:
    """What arrived for one step. States are extrapolated to now; times are those of the client's own clock."""

    joined: list[Hello] = dataclasses.field(default_factory=list)
    left: list[str] = dataclasses.field(default_factory=list)
    robots: dict[str, RobotUpdate] = dataclasses.field(default_factory=dict)
    """Every robot of a peer, in every step: extrapolated by at most 150 ms, corrections blended over 100 ms."""
    people: dict[str, HumanUpdate] = dataclasses.field(default_factory=dict)
    """The same for people."""
    wrenches: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Sum of the wrenches [6] of peers on each own link: :class:`vinesim.net.codec.forces.WrenchMessage`."""
    couplings: dict[str, tuple[Coupling, ...]] = dataclasses.field(default_factory=dict)
    """Couplings of peers to trees that they or this actor own, by actor."""
    trees: list[TreeUpdate] = dataclasses.field(default_factory=list)
    """Trees with a new state: the last state of each, extrapolated by at most 150 ms."""
    objects: list[ObjectUpdate] = dataclasses.field(default_factory=list)
    """Every box and free bunch that a peer moves, in every step, extrapolated by at most 150 ms."""
    records: list[tuple[RetainedRecord, bool]] = dataclasses.field(default_factory=list)
    """New retained records, and whether their poses hold. They do not if a newer claim is known; cuts always hold."""
    released: list[int] = dataclasses.field(default_factory=list)
    """Objects that have lost their remote owner: they are at rest, or the owner has left."""


_TREE_FAMILIES = tuple(layer.family for layer in interest.TREE_LAYERS)


@dataclasses.dataclass(slots=True)
class _Step:
    """One call of :meth:`Receiver.receive`."""

    now: float
    """Own clock [s]."""
    time: float
    """Network time [s]."""
    link_centre: LinkCentre = _no_link
    inbox: Inbox = dataclasses.field(default_factory=Inbox)
    new_trees: dict[int, tuple[TreeStates, str]] = dataclasses.field(default_factory=dict)
    """The newest accepted batch and its owner, by tree."""


class Receiver:
    """Takes over what peers and the server send."""

    def __init__(self, state: ReplicationState) -> None:
        self._state = state
        self.early = EarlyMessages()
        """Messages with retained records whose author has not been admitted yet."""

    def receive(self, now: float, offset: float, link_centre: LinkCentre | None = None) -> Inbox:
        """Everything since the last call; ``offset`` [s]: network time minus own time ``now`` [s].

        ``link_centre``: of the own robot's links; None: nothing can be pushed.

        Raises :class:`vinesim.net.replication.peers.WorldMismatch` if this actor does not belong to the world.
        """
        state = self._state
        step = _Step(now, now + offset, link_centre or _no_link)
        inbox = step.inbox
        peers = state.peers
        time = step.time
        inbox.left = peers.poll_liveliness(now)
        for name in inbox.left:
            state.ownership.remove_actor(name, time, state.successor_of)
            state.wrench_sync.remove_peer(name)
            state.coupling_sync.remove_peer(name)
            state.voices.remove_peer(name)
        inbox.joined, replies = peers.process_replies()
        for reply in replies:
            self._receive_snapshot(reply, step)
        early = [message for hello in inbox.joined for message in self.early.take(hello.name)]
        for key, payload in early + state.bus.poll():
            self._dispatch(key, payload, step)
        state.counters.lost = state.bus.dropped
        state.counters.network_failures = state.bus.failures
        state.counters.foreign = state.bus.foreign
        state.ownership.expire(time)
        inbox.released = state.ownership.released()
        for object_id in inbox.released:
            state.object_stream.remove(object_id)
        inbox.trees = state.tree_stream.extrapolated(step.new_trees, now, time)
        inbox.objects = state.object_stream.extrapolated(state.ownership.remote, now, time)
        poses = [peer.sample(time, now) for peer in peers.known.values() if peer.update is not None]
        inbox.robots = {update.actor: update for update in poses if isinstance(update, RobotUpdate)}
        inbox.people = {update.actor: update for update in poses if isinstance(update, HumanUpdate)}
        inbox.wrenches = state.wrench_sync.net_wrenches(now)
        inbox.couplings = state.coupling_sync.couplings(now)
        for object_id in state.ownership.corrections(time):
            if not state.is_spectator:
                self._publish_correction(object_id)
        return inbox

    def _dispatch(self, key: str, payload: bytes, step: _Step) -> None:
        """Decode and apply one message. Its sender is read from the key, never from the payload."""
        state = self._state
        counters = self._state.counters
        family, _, rest = key.partition("/")
        chunks = rest.split("/")
        sender = chunks[0] if family in ("a", "voice") else chunks[-1]
        traffic = {
            "a": counters.actor,
            "c": counters.environment,
            "fact": counters.retained,
            "force": counters.force,
            "voice": counters.voice,
            **dict.fromkeys(_TREE_FAMILIES, counters.environment),
        }
        traffic.get(family, counters.event).count_in(payload)
        peer = state.peers.known.get(sender)
        if peer is None and not (family == "fact" and state.peers.was_admitted(sender)):
            if sender not in state.peers.local_actors:
                counters.dropped += self._keep_early(sender, key, payload) if family == "fact" else 1
            return
        try:
            if family not in ("a", "voice") and peer is not None and peer.hello.kind == SPECTATOR:
                raise MessageError(f"a spectator publishes only its pose and its voice, not {key!r}")
            if family == "a":
                assert peer is not None
                counters.dropped += not peer.receive(decode_pose(payload, sender), step.time)
            elif family == "voice":
                assert peer is not None
                state.voices.receive(payload, peer, step.now, step.time)
            elif family == "force":
                assert peer is not None
                pose = peer.update if peer.update and step.time - peer.update.time <= MAX_POSE_AGE else None
                if kind_of(payload) == COUPLINGS:
                    state.coupling_sync.receive(payload, peer.hello, pose, step.now, state.ownership.owner)
                else:
                    state.wrench_sync.receive(payload, peer.hello, pose, step.now, step.link_centre)
            else:
                self._receive_in_cell(family, (int(chunks[0]), int(chunks[1])), payload, sender, step)
        except MessageError as error:
            state.peers.count_malformed(sender, error)

    def _receive_in_cell(self, family: str, cell: Cell, payload: bytes, sender: str, step: _Step) -> None:
        """Apply a message about objects in a cell."""
        state = self._state
        kind = kind_of(payload)
        if family == "fact":
            for record in decode_records(payload, state.object_counts):
                if record.author != sender:
                    raise MessageError(f"record by {record.author!r} published by {sender!r}")
                self._receive_record(cell, record, sender, step, is_remote=sender not in state.peers.local_actors)
        elif kind == CLAIMS:
            for object_id, claim, touching in decode_claims(payload, state.object_counts):
                state.ownership.receive_claim(object_id, claim, touching, sender, step.time)
        elif kind == OBJECTS:
            self._receive_objects(decode_objects(payload, cell), cell, sender, step)
        else:
            self._receive_trees(decode_trees(payload, state.model.tree_size), sender, step)

    def _keep_early(self, sender: str, key: str, payload: bytes) -> int:
        """Keep records of an actor that may be admitted soon until then, for they are published only once; the number
        of messages that were discarded."""
        peers = self._state.peers
        if not is_valid_name(sender) or peers.is_rejected(sender):
            return 1
        return self.early.put(sender, key, payload, peers.may_join)

    def _receive_trees(self, trees: TreeStates, sender: str, step: _Step) -> None:
        """Accept or drop each state by its claim."""
        state = self._state
        check_tree_states(trees, state.model)
        is_near = state.cells.is_within_radius(state.tree_stream.middle[trees.tree])
        columns = (trees.tree, trees.ownership, trees.authority, trees.flags)
        for row, (tree, ownership, sequence, flags) in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
            claim = Claim(ownership, sequence, NO_OWNER if flags & RESTING else sender)
            touching = bool(flags & TOUCHED)
            is_accepted = state.ownership.receive_state(tree, claim, touching, trees.time, step.time)
            if is_accepted and is_near[row]:
                step.new_trees[tree] = (trees, sender)
            else:
                state.counters.dropped += 1

    def _receive_objects(self, objects: ObjectStates, cell: Cell, sender: str, step: _Step) -> None:
        """Accept or drop each state by its claim."""
        state = self._state
        updates = objects.updates(sender)
        for update in updates:
            check_object_id(update.object, state.object_counts)
        is_near = state.cells.is_within_radius(objects.pose[:, :3])
        for row, (update, flags) in enumerate(zip(updates, objects.flags.tolist(), strict=True)):
            claim = Claim(update.ownership, update.authority, sender)
            touching = bool(flags & TOUCHED)
            is_accepted = state.ownership.receive_state(update.object, claim, touching, objects.time, step.time)
            if is_accepted and is_near[row]:
                state.object_stream.receive(update, cell)
            else:
                state.counters.dropped += 1

    def _receive_record(
        self, cell: Cell, record: RetainedRecord, sender: str, step: _Step, *, is_remote: bool = True
    ) -> None:
        """Merge a record; if that changed anything, the client gets it unless its own actor published it.

        One that cannot be true of the model is dropped, and the others of its message are not.
        """
        state = self._state
        try:
            check_record(record, state.model, state.object_counts)
        except MessageError as error:
            state.peers.count_malformed(sender, error)
            return
        if not state.retained.merge(cell, record):
            return
        claim = Claim(record.ownership, record.authority, record.author if record.moving else NO_OWNER)
        holds = state.ownership.receive_retained(record.object, claim, record.moving, step.time)
        if is_remote:
            step.inbox.records.append((state.retained.state.get(record.object) or record, holds))

    def _receive_snapshot(self, reply: Reply, step: _Step) -> None:
        """Merge the server's records of one cell."""
        state = self._state
        family, *chunks = reply.key.split("/")
        if family != "snap" or len(chunks) != 2:
            return
        try:
            cell = int(chunks[0]), int(chunks[1])
            records = decode_records(reply.payload, state.object_counts)
        except (MessageError, ValueError) as error:
            state.peers.count_malformed("the server", MessageError(str(error)))
            return
        state.retained.mark_answered(cell)
        for record in records:
            self._receive_record(cell, record, "the server", step)

    def _publish_correction(self, object_id: int) -> None:
        """Repeat the winning claim to all subscribers of the object's cell."""
        state = self._state
        entry = state.ownership[object_id]
        publisher = state.cells.event_publisher(state.cell_of(object_id))
        if publisher is not None:
            payload = encode_claims([(object_id, entry.claim, entry.touching)])
            put_counted(publisher, payload, state.counters.event)
