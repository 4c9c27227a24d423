"""Outgoing half of replication: sends claims, states of moving objects, states at rest and retained records.

A state is sent only if a peer is near the object and subscribes to its cell, and only if the copies of peers would
otherwise be wrong (:mod:`vinesim.net.replication.dead_reckoning`). A retained record is sent once, wherever the peers
are, because the server keeps it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import msgspec
import numpy as np

from vinesim.net.codec.control import MAX_PASSED, RetainedRecord, encode_claims
from vinesim.net.codec.header import LARGEST_COORDINATE
from vinesim.net.codec.trees import RESTING, TOUCHED, TreeStates, encode_trees
from vinesim.net.replication import authority, dead_reckoning
from vinesim.net.replication.authority import Claim
from vinesim.net.replication.interest import TREE_LAYERS, Cell
from vinesim.net.replication.ownership import ObjectRecord
from vinesim.net.replication.replication_state import ReplicationState, put_counted
from vinesim.net.replication.streams import (
    ClaimColumns,
    DetachedRoots,
    StateReader,
    with_roots,
)
from vinesim.net.transport.bus import Publisher
from vinesim.scene.ids import is_tree, parse_object_name
from vinesim.scene.values import TreeUpdate

ADOPTION_DELAY = 0.5
"""Time for which an object moves without an owner until the nearest actor takes it over [s]. That actor later publishes
where the object comes to rest. GUESSED."""

_IDENTITY_POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclasses.dataclass(slots=True)
class LocalStep:
    """Results of one step of the own simulation: the arguments of
    :meth:`vinesim.net.replication.replicator.Replicator.send`."""

    now: float
    """Own time of the step [s]: a time of this client's clock."""
    time: float
    """Network time of the step [s]: the time of the world, as this client estimates it."""
    touched: set[int]
    moving: set[int]
    grabbed: set[int]
    detached: set[int]
    read: StateReader
    detached_roots: Callable[[int], DetachedRoots]
    pose_on_support: Callable[[int], tuple[str, np.ndarray]] | None
    is_changed: Callable[[int], bool]
    has_body: Callable[[int], bool]
    carried_on: set[int]
    stalk_of: Callable[[int], tuple[int, int] | None]
    stumps_of: Callable[[int], tuple[tuple[int, int, int], ...]]
    wood_of: Callable[[int], bytes]
    fruit_of: Callable[[int], tuple[float, float] | None]
    passed_by: Callable[[int], tuple[int, ...]]


class Sender:
    """Publishes states, claims and records of the objects that the own actor owns."""

    def __init__(self, state: ReplicationState) -> None:
        self._state = state
        self._orphans: dict[int, float] = {}
        """Own time at which a moving object lost its owner [s], by object id."""

    def send(self, step: LocalStep) -> list[TreeUpdate]:
        """Publish the results of one step. Returns the states of trees at rest that were sent, as all receivers decode
        them."""
        state = self._state
        touched = set(step.touched)
        for object_id in sorted(step.grabbed):
            state.ownership.grab(object_id)
            touched.add(object_id)
        for object_id in sorted(touched):
            state.ownership.touch(object_id)
        if step.moving or self._orphans:
            self._adopt_orphans(step.moving - touched, step)
        for object_id in sorted(step.carried_on):
            if state.ownership.owner(object_id) is None:
                state.ownership.take_over(object_id)
        self._update_interest(step.now)
        owned = state.ownership.owned
        active = tuple(sorted(owned & (touched | step.moving)))
        settled = self._publish_at_rest(sorted(owned.difference(active)), step) if owned else []
        for object_id in sorted(step.detached & owned):
            self._publish_detachment(object_id, step)
        state.retained.flush()
        tree_count = sum(map(is_tree, active))
        if tree_count:
            self._publish_trees(active[:tree_count], touched, step)
        if tree_count < len(active):
            self._publish_objects(active[tree_count:], touched, step)
        return settled

    def _adopt_orphans(self, moving: set[int], step: LocalStep) -> None:
        """Take over objects that have moved without an owner for :data:`ADOPTION_DELAY`, if no other actor is
        nearer."""
        state = self._state
        orphans = {
            object_id for object_id in moving if not is_tree(object_id) and state.ownership.owner(object_id) is None
        }
        self._orphans = {object_id: self._orphans.get(object_id, step.now) for object_id in orphans}
        due = (object_id for object_id, since in self._orphans.items() if step.now - since >= ADOPTION_DELAY)
        for object_id in sorted(due):
            position = step.read(object_id)[0][:3]
            if authority.choose_successor(position, state.owner_candidates()) == state.hello.name:
                state.ownership.take_over(object_id)

    def _update_interest(self, now: float) -> None:
        """Adapt subscriptions and publishers to the actor's present position and to the objects that it owns.

        The actor exchanges states of objects in the cells of the ground around it and in the cells of its own objects,
        poses of actors at rates that depend on their distance, and voices of actors within hearing reach. ``now``: own
        time [s].
        """
        state = self._state
        owned = {cell for object_id in state.ownership.owned if (cell := state.cell_of(object_id)) is not None}
        state.cells.update(owned)
        trees = {state.tree_stream.layer_cell[object_id] for object_id in state.ownership.owned if is_tree(object_id)}
        state.tree_channels.update(state.cells.position, trees)
        state.retained.update_window(state.cells.subscriptions, state.cells.changes, now)
        if state.peers.update_interest(state.cells.position, now):
            state.voices.update_interest(state.peers.known, state.cells.position, now)

    # ------------------------------------------------------------ moving

    def _publish_trees(self, active: tuple[int, ...], touched: set[int], step: LocalStep) -> None:
        """Publish the states of those trees whose copies at peers are wrong, one message or more for each cell of each
        layer (:data:`vinesim.net.replication.interest.TREE_LAYERS`)."""
        state = self._state
        stream = self._state.tree_stream
        channels = self._state.tree_channels
        entries = [state.ownership[tree] for tree in active]
        contact = [tree in touched for tree in active]
        middles = stream.middle[list(active)]
        listeners = [state.count_listeners(middles, distance) for distance in channels.distances]
        if not listeners[0].any():
            for entry, touching in zip(entries, contact, strict=True):
                entry.listener_count = 0
                entry.near_listener_count = 0
                entry.touching = touching
            return
        stream.read(active, step.read, step.detached_roots)
        for layer, due in enumerate(self._find_due_trees(entries, listeners, contact, step)):
            rows_by_cell: dict[Cell, list[int]] = {}
            for row in np.flatnonzero(due).tolist():
                rows_by_cell.setdefault(stream.layer_cell[active[row]], []).append(row)
            for cell, rows in sorted(rows_by_cell.items()):
                publisher = channels.publishers[layer].get(cell)
                if publisher is None or not publisher.matching:
                    continue
                here = [(active[row], entries[row]) for row in rows]
                # a cell for events consists of whole cells for trees
                self._announce(state.cells.event_publisher(stream.cell[here[0][0]]), here)
                for payload in stream.encode(rows, _columns(here), step.time, layer):
                    put_counted(publisher, payload, state.counters.environment)
                for row in rows:
                    entry = entries[row]
                    entry.announced = True
                    entry.published_at = step.time
                    entry.near_listener_count = int(listeners[-1][row])
                    if layer == 0:
                        entry.published_to_all_at = step.time
                        entry.listener_count = int(listeners[0][row])

    def _find_due_trees(
        self, entries: list[ObjectRecord], listeners: list[np.ndarray], contact: list[bool], step: LocalStep
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns which of the ``k`` trees that were last read are to be published: [k] bool for each of the two
        layers.

        A tree is published if the copies of the layer's receivers are wrong, if a peer has come near, if this actor has
        just claimed the tree, or if its contact with the tree has begun or ended.
        ``listeners``: number of receivers of each layer [k]. ``contact`` [k]: whether this actor touches the tree.
        """
        stream = self._state.tree_stream
        (all_, near) = listeners
        silence = step.time - np.array([(entry.published_to_all_at, entry.published_at) for entry in entries]).T
        errors = [stream.prediction_error(number, silence[number]) for number in range(len(TREE_LAYERS))]
        wrong = [
            dead_reckoning.needs_update(*error, since, layer.tolerance)
            for error, since, layer in zip(errors, silence, TREE_LAYERS, strict=True)
        ]
        # Some peers farther away receive the second layer, too. When all near peers have left, nothing is sent on this
        # layer any more, but those peers keep the copies that it has updated.
        wrong[0] |= (near == 0) & dead_reckoning.needs_update(*errors[1], silence[1], TREE_LAYERS[0].tolerance)
        for row, (entry, touching) in enumerate(zip(entries, contact, strict=True)):
            wrong[0][row] |= all_[row] > entry.listener_count or entry.touching != touching
            wrong[1][row] |= near[row] > entry.near_listener_count
            entry.touching = touching
            entry.listener_count = min(entry.listener_count, int(all_[row]))
            entry.near_listener_count = min(entry.near_listener_count, int(near[row]))
        for_all = wrong[0] & (all_ > 0)
        return for_all, wrong[1] & (near > 0) & ~for_all

    def _publish_objects(self, active: tuple[int, ...], touched: set[int], step: LocalStep) -> None:
        """Publish the states of those boxes and bunches whose copies at peers are wrong, one message or more for each
        cell."""
        state = self._state
        stream = self._state.object_stream
        entries = [state.ownership[object_id] for object_id in active]
        listeners = state.count_listeners(stream.positions(active, step.read))
        contact = [object_id in touched for object_id in active]
        if not listeners.any():
            for entry, touching in zip(entries, contact, strict=True):
                entry.listener_count = 0
                entry.touching = touching
            return
        due = self._find_due_objects(active, entries, listeners, contact, step)
        cells = stream.cells(active)
        rows_by_cell: dict[Cell, list[int]] = {}
        for row in np.flatnonzero(due).tolist():
            rows_by_cell.setdefault(cells[row], []).append(row)
        for cell, rows in sorted(rows_by_cell.items()):
            if cell not in state.cells.publishers:
                continue
            states, events = state.cells.publishers[cell]
            if not states.matching:
                continue
            here = [(active[row], entries[row]) for row in rows]
            self._announce(events, here)
            for payload in stream.encode(rows, _columns(here), step.time, cell):
                put_counted(states, payload, state.counters.environment)
            for row in rows:
                entry = entries[row]
                entry.announced = True
                entry.published_at = step.time
                entry.listener_count = int(listeners[row])

    def _find_due_objects(
        self,
        active: tuple[int, ...],
        entries: list[ObjectRecord],
        listeners: np.ndarray,
        contact: list[bool],
        step: LocalStep,
    ) -> np.ndarray:
        """Returns which of the ``k`` boxes and bunches ``active`` are to be published: [k] bool.

        An object is published if its copies are wrong, if a peer has come near, if this actor has just claimed the
        object, or if its contact with the object has begun or ended.
        """
        silence = step.time - np.array([entry.published_at for entry in entries])
        due = dead_reckoning.needs_update(*self._state.object_stream.prediction_error(active, silence), silence)
        for row, (entry, touching) in enumerate(zip(entries, contact, strict=True)):
            due[row] |= listeners[row] > entry.listener_count or entry.touching != touching
            entry.touching = touching
            entry.listener_count = min(entry.listener_count, int(listeners[row]))
        return due & (listeners > 0)

    def _announce(self, events: Publisher | None, objects: list[tuple[int, ObjectRecord]]) -> None:
        """Publish reliably, through ``events``, the claims on ``objects`` that no peer can know yet."""
        new = [(object_id, entry.claim, entry.touching) for object_id, entry in objects if not entry.announced]
        if new and events is not None:
            put_counted(events, encode_claims(new), self._state.counters.event)

    # ------------------------------------------------------------ rest and retained records

    def _publish_at_rest(self, object_ids: list[int], step: LocalStep) -> list[TreeUpdate]:
        """Publish and release owned objects that have come to rest. Returns the states of trees that were sent."""
        settled = []
        for object_id in object_ids:
            if not is_tree(object_id):
                self._publish_object_at_rest(object_id, step)
            elif (update := self._publish_tree_at_rest(object_id, step)) is not None:
                settled.append(update)
        return settled

    def _publish_tree_at_rest(self, tree: int, step: LocalStep) -> TreeUpdate | None:
        """Publish the state of a tree at rest reliably to subscribers nearby, and release the tree.

        If picks or cuts have changed the tree, its state is also published as a retained record. Returns the state as
        receivers decode it, or None if nothing was sent.
        """
        state = self._state
        is_changed = step.is_changed(tree)
        if is_changed:
            state.ownership.increment(tree)
        entry = state.ownership[tree]
        claim = state.ownership.release(tree)
        cell = state.tree_stream.cell[tree]
        events = state.cells.event_publisher(cell)
        is_near = bool(state.count_listeners(state.tree_stream.middle[[tree]])[0])
        listened = events if is_near and events is not None and events.matching else None
        if listened is None and not is_changed:
            if not entry.announced:
                state.ownership.rollback(tree)
            return None
        payload, update = self._encode_tree(tree, claim, step, RESTING)
        if is_changed:
            record = RetainedRecord(
                tree, claim.ownership, claim.authority, state.hello.name, _IDENTITY_POSE, "", (), payload
            )
            self._publish_tree_record(cell, record, step)
        if listened is not None:
            put_counted(listened, payload, state.counters.event)
        entry.announced = True
        entry.published_at = step.time
        return update

    def _publish_object_at_rest(self, object_id: int, step: LocalStep) -> None:
        """Publish the pose of an object at rest in the frame of its support, as a retained record, and release it.

        An object without a body in this simulation was taken over from an actor that left. For such an object only the
        claim is undone, because this client knows nothing new about the object.
        """
        state = self._state
        if not step.has_body(object_id):
            state.ownership.release(object_id)
            state.ownership.rollback(object_id)
            return
        assert step.pose_on_support is not None, f"object {object_id} rests, but no pose_on_support was given"
        state.ownership.increment(object_id)
        claim = state.ownership.release(object_id)
        state.object_stream.positions((object_id,), step.read)
        parent, pose = step.pose_on_support(object_id)
        state.ownership[object_id].announced = True
        record = RetainedRecord(
            object_id, claim.ownership, claim.authority, state.hello.name, _within_range(pose), parent
        )
        record = _with_properties(record, step)
        if parent and parse_object_name(parent) is None:
            record = msgspec.structs.replace(record, place=_within_range(step.read(object_id)[0]))
        state.retained.publish(state.object_stream.cells((object_id,))[0], record)

    def _publish_detachment(self, object_id: int, step: LocalStep) -> None:
        """Publish, as a retained record, that an object has left its plant and moves."""
        state = self._state
        claim = state.ownership.claim(object_id)
        record = RetainedRecord(object_id, claim.ownership, claim.authority, state.hello.name, moving=True)
        state.ownership[object_id].announced = True
        if is_tree(object_id):
            payload, _ = self._encode_tree(object_id, claim, step, TOUCHED)
            record = msgspec.structs.replace(record, trees=payload)
            self._publish_tree_record(state.tree_stream.cell[object_id], record, step)
            return
        state.object_stream.positions((object_id,), step.read)
        pose, _ = step.read(object_id)
        record = _with_properties(msgspec.structs.replace(record, pose=_within_range(pose)), step)
        state.retained.publish(state.object_stream.cells((object_id,))[0], record)

    def _publish_tree_record(self, cell: Cell, record: RetainedRecord, step: LocalStep) -> None:
        """Add all bodies that were cut off a tree, all stumps, and how its wood has given, to its retained record, and
        publish the record."""
        first = int(self._state.model.tree_first[record.object])
        cut = tuple((first + step.detached_roots(record.object)[0]).tolist())
        record = msgspec.structs.replace(
            record, cut=cut, stumps=step.stumps_of(record.object), wood=step.wood_of(record.object)
        )
        self._state.retained.publish(cell, record)

    def _encode_tree(self, tree: int, claim: Claim, step: LocalStep, flags: int) -> tuple[bytes, TreeUpdate]:
        """Encode the state of a tree. Returns the message, and the state as receivers decode it.

        If ``flags`` contains :data:`RESTING`, all rates are zero.
        """
        q, qd = step.read(tree)
        numbers, x, xd = step.detached_roots(tree)
        rate_factor = 0.0 if flags & RESTING else 1.0
        columns = ClaimColumns([claim], [flags])
        batch = TreeStates(
            step.time,
            np.array([tree]),
            *columns.columns(),
            np.array([len(q)]),
            np.asarray(q, float),
            rate_factor * np.asarray(qd, float),
        )
        (payload,), decoded = encode_trees(with_roots(batch, [(numbers, x, rate_factor * xd)]))
        (update,) = decoded.updates(self._state.hello.name)
        return payload, update


def _columns(objects: list[tuple[int, ObjectRecord]]) -> ClaimColumns:
    """Returns the claims and flags of objects for a message."""
    entries = [entry for _, entry in objects]
    return ClaimColumns([entry.claim for entry in entries], [TOUCHED * entry.touching for entry in entries])


def _with_properties(record: RetainedRecord, step: LocalStep) -> RetainedRecord:
    """Returns the record of a box or a bunch with what only bunches have: stalk, lost berries, and trees that it
    passes."""
    number = record.object
    passed = step.passed_by(number)[:MAX_PASSED]
    return msgspec.structs.replace(record, stalk=step.stalk_of(number), fruit=step.fruit_of(number), passed=passed)


def _within_range(pose: np.ndarray) -> tuple[float, float, float, float, float, float, float]:
    """Returns a pose [7] in the format of a retained record, with a clipped position."""
    x, y, z = np.clip(pose[:3], -LARGEST_COORDINATE, LARGEST_COORDINATE).tolist()
    qx, qy, qz, qw = pose[3:].tolist()
    return x, y, z, qx, qy, qz, qw
