"""Incoming half of replication: decodes messages from the bus, checks their claims, and puts the content into an
inbox."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from vinesim.net.codec.control import (
    CLAIMS,
    RETAINED,
    Hello,
    RetainedRecord,
    decode_claims,
    decode_records,
    encode_claims,
)
from vinesim.net.codec.header import MessageError, is_valid_name, kind_of
from vinesim.net.codec.human import decode_pose
from vinesim.net.codec.messages import FAMILIES, MESSAGES, sender_of
from vinesim.net.codec.objects import OBJECTS, ObjectStates, check_object_id, decode_objects
from vinesim.net.codec.trees import RESTING, TOUCHED, TreeStates, decode_trees
from vinesim.net.codec.wood import decode_wood
from vinesim.net.replication import interest
from vinesim.net.replication.authority import NO_OWNER, Claim
from vinesim.net.replication.interest import Cell
from vinesim.net.replication.replication_state import SPECTATOR, ReplicationState, put_counted
from vinesim.net.transport.bus import Reply
from vinesim.scene.ids import ObjectKind, Organ, is_tree, parse_object_name, split_object_id
from vinesim.scene.model import Model
from vinesim.scene.spare_bodies import PLACE_STEP
from vinesim.scene.values import GivenWood, HumanUpdate, ObjectUpdate, RobotUpdate, TreeUpdate

MAX_EARLY_MESSAGES = 100
"""Largest number of :class:`EarlyMessages` of one sender."""

MAX_EARLY_BYTES = 1 << 20
"""Largest size of all :class:`EarlyMessages` of one sender [B]: that of the largest single message."""

MAX_EARLY_SENDERS = 64
"""Largest number of senders with :class:`EarlyMessages`."""

MAX_EARLY_TOTAL = 4 << 20
"""Largest size of the :class:`EarlyMessages` of all senders [B]."""


@dataclasses.dataclass(slots=True)
class Inbox:
    """Content of the messages that one actor has received, for the next step of its client.

    States are extrapolated to the time of the step. All times are own time, which is that of the client's clock.
    """

    joined: list[Hello] = dataclasses.field(default_factory=list)
    left: list[str] = dataclasses.field(default_factory=list)
    robots: dict[str, RobotUpdate] = dataclasses.field(default_factory=dict)
    """Poses of the near peers that are robots or spectators, by name. They are extrapolated by at most 150 ms, and
    corrections are blended in over 100 ms."""
    people: dict[str, HumanUpdate] = dataclasses.field(default_factory=dict)
    """Poses of the near peers that are people, by name, extrapolated and blended like :attr:`robots`."""
    messages: dict[int, Any] = dataclasses.field(default_factory=dict)
    """Contents of direct messages to this actor that are valid now, by kind of message: results of
    :meth:`vinesim.net.replication.direct_messages.MessageSync.current`."""
    trees: list[TreeUpdate] = dataclasses.field(default_factory=list)
    """Newest state of each tree for which a new state has arrived, extrapolated by at most 150 ms."""
    objects: list[ObjectUpdate] = dataclasses.field(default_factory=list)
    """All boxes and free bunches that peers move, whether or not a new state has arrived, extrapolated by at most 150
    ms."""
    records: list[tuple[RetainedRecord, bool]] = dataclasses.field(default_factory=list)
    """New retained records, each with whether the pose in the record is valid. The pose is not valid if a greater claim
    on the object is known. Cuts are always valid."""
    released: list[int] = dataclasses.field(default_factory=list)
    """Ids of objects that have lost their remote owner, because they are at rest or the owner has left."""


@dataclasses.dataclass(slots=True)
class _Step:
    """Times and results of one call of :meth:`Receiver.receive`."""

    now: float
    """Own time of the step [s]: a time of this client's clock."""
    time: float
    """Network time of the step [s]: the time of the world, as this client estimates it."""
    inbox: Inbox = dataclasses.field(default_factory=Inbox)
    new_trees: dict[int, tuple[TreeStates, str]] = dataclasses.field(default_factory=dict)
    """The newest accepted batch that contains a tree, and its owner, by tree."""


class EarlyMessages:
    """Messages with retained records that arrived before their senders were accepted as peers.

    The messages are kept until the sender is accepted, because records are published only once. Their number and size
    are limited. If there is no room, messages of live senders displace those of senders that are not live.
    """

    def __init__(self) -> None:
        self._messages: dict[str, list[tuple[str, bytes]]] = {}
        self._sizes: dict[str, int] = {}

    def __len__(self) -> int:
        """Number of senders with messages."""
        return len(self._messages)

    @property
    def size(self) -> int:
        """Size of all payloads [B]."""
        return sum(self._sizes.values())

    def put(self, sender: str, key: str, payload: bytes, is_live: Callable[[str], bool]) -> int:
        """Keep a message if there is room. Returns the number of messages that were discarded, including this one.

        ``is_live(sender)``: whether a sender may be accepted as a peer soon.
        """
        discarded = 0
        if self._has_no_room(sender, len(payload)) and is_live(sender):
            for other in [other for other in self._messages if other != sender and not is_live(other)]:
                discarded += len(self.take(other))
        if self._has_no_room(sender, len(payload)):
            return discarded + 1
        self._messages.setdefault(sender, []).append((key, payload))
        self._sizes[sender] = self._sizes.get(sender, 0) + len(payload)
        return discarded

    def take(self, sender: str) -> list[tuple[str, bytes]]:
        """Remove and return the messages of a sender, in order of arrival."""
        self._sizes.pop(sender, None)
        return self._messages.pop(sender, [])

    def _has_no_room(self, sender: str, size: int) -> bool:
        """Whether the store has no room for a further message of ``size`` [B] from ``sender``: the message would exceed
        the number or size of one sender's messages, the number of senders, or the size of all messages."""
        return (
            len(self._messages.get(sender, ())) >= MAX_EARLY_MESSAGES
            or self._sizes.get(sender, 0) + size > MAX_EARLY_BYTES
            or (sender not in self._messages and len(self._messages) >= MAX_EARLY_SENDERS)
            or self.size + size > MAX_EARLY_TOTAL
        )


class Receiver:
    """Applies the messages from peers and the server to the state of one actor."""

    def __init__(self, state: ReplicationState) -> None:
        self._state = state
        self.early = EarlyMessages()
        """Messages with retained records whose author has not been accepted as a peer yet."""

    def receive(self, now: float, offset: float) -> Inbox:
        """Apply everything that arrived since the last call, and return the inbox for the step at own time ``now`` [s].

        ``offset`` [s]: network time minus own time.

        Raises :class:`vinesim.net.replication.peers.WorldMismatch` if this actor does not belong to the world.
        """
        state = self._state
        step = _Step(now, now + offset)
        inbox = step.inbox
        peers = state.peers
        time = step.time
        inbox.left = peers.poll_liveliness(now)
        for name in inbox.left:
            state.ownership.remove_actor(name, time, state.successor_of)
            for sync in state.syncs.values():
                sync.remove_peer(name)
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
        poses = [peer.sample(time, now) for _, peer in sorted(peers.near.items()) if peer.update is not None]
        inbox.robots = {update.actor: update for update in poses if isinstance(update, RobotUpdate)}
        inbox.people = {update.actor: update for update in poses if isinstance(update, HumanUpdate)}
        inbox.messages = {kind: sync.current(now) for kind, sync in state.syncs.items()}
        for object_id in state.ownership.corrections(time):
            if not state.is_spectator:
                self._publish_correction(object_id)
        return inbox

    def _dispatch(self, key: str, payload: bytes, step: _Step) -> None:
        """Decode and apply one message. The key determines the sender, whatever the payload says."""
        state = self._state
        counters = state.counters
        family, *chunks = key.split("/")
        sender = sender_of(key)
        counters.of(family).count_in(payload)
        peer = state.peers.known.get(sender)
        if peer is None and not (family == "fact" and state.peers.was_admitted(sender)):
            if sender not in state.peers.local_actors:
                if key != interest.FAR_KEY.format(actor=sender):
                    state.peers.ask_soon(sender)
                discarded = self._keep_early(sender, key, payload) if family == "fact" else 1
                counters.dropped += discarded
                if discarded and family == "fact":
                    state.retained.repair(step.now)
            return
        try:
            if peer is not None and peer.hello.kind == SPECTATOR and not FAMILIES[family].by_spectators:
                raise MessageError(f"a spectator publishes only its pose and its voice, not {key!r}")
            kind = kind_of(payload)
            if kind not in MESSAGES or family not in MESSAGES[kind].families:
                raise MessageError(f"message of kind {kind} under {key!r}, where there is none of this kind")
            if family in ("a", "pose"):
                assert peer is not None
                is_coarse = key == interest.FAR_KEY.format(actor=sender)
                counters.dropped += not state.peers.receive_pose(
                    peer, decode_pose(payload, sender), step.time, is_coarse=is_coarse
                )
            elif kind in state.syncs:
                assert peer is not None
                state.syncs[kind].receive(payload, peer, step.now, step.time)
            else:
                self._receive_in_cell(kind, (int(chunks[0]), int(chunks[1])), payload, sender, step)
        except MessageError as error:
            state.peers.count_malformed(sender, error)

    def _receive_in_cell(self, kind: int, cell: Cell, payload: bytes, sender: str, step: _Step) -> None:
        """Decode and apply a message about objects in a cell: records, claims, or states."""
        state = self._state
        if kind == RETAINED:
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
        """Keep a message with records whose sender is no peer yet, in :attr:`early`. Returns how many were
        discarded."""
        peers = self._state.peers
        if not is_valid_name(sender) or peers.is_rejected(sender):
            return 1
        return self.early.put(sender, key, payload, peers.may_join)

    def _receive_trees(self, trees: TreeStates, sender: str, step: _Step) -> None:
        """Accept or drop each state in a batch of trees, by the claim in it and by the distance of the tree from this
        actor."""
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
        """Accept or drop each state in a batch of boxes and bunches, by the claim in it and by the distance of the
        object from this actor."""
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
        """Merge a retained record. If it changes the retained state, and ``is_remote``, add it to the inbox.

        A record that contradicts the model is dropped; others in the same message are not affected. ``is_remote``:
        whether the record comes from another client.
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
        """Merge the server's reply with retained records of one cell."""
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
        """Publish the greatest known claim on an object again, for peers that have missed it."""
        state = self._state
        entry = state.ownership[object_id]
        publisher = state.cells.event_publisher(state.cell_of(object_id))
        if publisher is not None:
            payload = encode_claims([(object_id, entry.claim, entry.touching)])
            put_counted(publisher, payload, state.counters.event)


# ------------------------------------------------------------ what cannot be true of the model


def check_record(record: RetainedRecord, model: Model, counts: tuple[int, ...]) -> None:
    """Raise :class:`MessageError` if a retained record contradicts the model.

    ``counts``: number of objects of each kind in the scene.
    """
    if is_tree(record.object):
        _check_tree_record(record, model)
    elif record.cut or record.trees or record.stumps or record.wood:
        raise MessageError(f"record of object {record.object} with cuts or the state of a tree; it is none")
    if record.passed and split_object_id(record.object)[0] != ObjectKind.BUNCH:
        raise MessageError(f"record of object {record.object} that passes through trees; it is no bunch")
    for tree in record.passed[-1:]:
        if tree >= len(model.tree_first):
            raise MessageError(f"record of object {record.object} that passes through tree {tree}; there is none")
    parent = parse_object_name(record.parent)
    if parent is not None:
        check_object_id(parent, counts)
        if parent == record.object:
            raise MessageError(f"record of object {record.object} that rests on itself")


def _check_tree_record(record: RetainedRecord, model: Model) -> None:
    """Raise :class:`MessageError` if the cuts or the state in a record of a tree contradict the model."""
    tree = record.object
    first = int(model.tree_first[tree])
    core = int(model.tree_core[tree])
    wrong = next((body for body in record.cut if not first <= body < first + core), None)
    if wrong is not None:
        raise MessageError(f"record of tree {tree} cut at body {wrong}; it has wood from {first} to {first + core - 1}")
    for stump, segment, place in record.stumps:
        _check_stump(record, stump, segment, PLACE_STEP * place, model)
    if record.wood:
        _check_wood(tree, decode_wood(record.wood), model)
    if record.trees:
        states = decode_trees(record.trees, model.tree_size)
        if states.tree.tolist() != [tree]:
            raise MessageError(f"record of tree {tree} with the state of {states.tree.tolist()}")
        check_tree_states(states, model)


def _check_wood(tree: int, wood: GivenWood, model: Model) -> None:
    """Raise :class:`MessageError` if a tree has no such joints, ties, segments or leaves."""
    core = int(model.tree_core[tree])
    ties = int((model.body_tree[model.tie_body] == tree).sum())
    leaves = int((model.body_tree[model.leaf_body] == tree).sum())
    for what, places, count in (
        ("joint", wood.joints, core),
        ("tie", wood.ties, ties),
        ("notched segment", wood.notched, core),
        ("tied segment", wood.tied, core),
        ("leaf", wood.bare, leaves),
    ):
        if len(places) and int(places[-1]) >= count:
            raise MessageError(f"record of tree {tree} with {what} {places[-1]}; it has {count}")
    length = model.body_length[int(model.tree_first[tree]) + wood.tied]
    if (PLACE_STEP * (wood.tied_at - 1) > length).any():
        raise MessageError(f"record of tree {tree} with a tie beyond the end of its segment")


def _check_stump(record: RetainedRecord, stump: int, segment: int, place: float, model: Model) -> None:
    """Raise :class:`MessageError` if a stump in a record of a tree contradicts the model. ``place`` [m]: of its cut."""
    first = int(model.tree_first[record.object])
    spares = first + int(model.tree_core[record.object]) - int(model.tree_spares[record.object])
    if not spares <= stump < spares + int(model.tree_spares[record.object]):
        raise MessageError(f"record of tree {record.object} with the stump {stump}, which is no spare body")
    if not first <= segment < spares or model.body_organ[segment] != int(Organ.CANE) or segment not in record.cut:
        raise MessageError(
            f"record of tree {record.object} with a stump of body {segment}, which is no cane that was cut"
        )
    if not 0.0 < place < float(model.body_length[segment]):
        raise MessageError(f"record of tree {record.object} cut {place:.4g} m along body {segment}, beyond its end")


def check_tree_states(states: TreeStates, model: Model) -> None:
    """Raise :class:`MessageError` if a detached body of a tree is a berry cluster, which never leaves its bunch."""
    if len(states.root) and (states.root >= np.repeat(model.tree_core[states.tree], states.roots)).any():
        raise MessageError("a berry cluster that was cut off its bunch")
