"""Boxes, free bunches and cut branches shared by several clients: applies remote states and collects local changes.

Objects moved by a remote actor are blended towards its states. An object with a retained record of rest is held in the
frame of its support, even if the support moves, unless an actor of this client moves the object.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Container, Iterable

import numpy as np

from vinesim.interaction.support_tracking import GROUND
from vinesim.net.codec.control import RetainedRecord
from vinesim.net.codec.trees import decode_trees
from vinesim.net.codec.wood import decode_wood, encode_wood
from vinesim.net.replication import dead_reckoning
from vinesim.net.replication.authority import wins
from vinesim.net.replication.receiver import Inbox
from vinesim.net.replication.streams import NO_ROOTS, DetachedRoots
from vinesim.scene.ids import ObjectKind, is_tree, object_id, parse_object_name, split_object_id
from vinesim.scene.spare_bodies import PLACE_STEP
from vinesim.scene.values import Breakage, Detachment, ObjectUpdate, TreeUpdate
from vinesim.world import Physics

BLEND_PER_STEP = 0.2
"""Share of the difference between a copy and its owner's state by which the copy is corrected in one step."""
TOUCHED_BLEND_PER_STEP = 0.05
"""``BLEND_PER_STEP`` for a copy that any actor touches on this client, because corrections must not pull the copy
through a hand. TUNED."""
FAR_ANGLE = 0.1
"""Joint error [rad] from which a touched copy is corrected as fast as other copies: an error as large as this shows
that a hand has slipped off the copy or the original. Below it the share is interpolated. TUNED."""
ACTIVATION_PERIOD = 20
"""Ticks between two activations of dormant bunches."""
WOOD_PERIOD = 0.25
"""Longest time [s] after which the record of a tree whose wood gives is published again."""
CARRIED_DISTANCE = 3.0
"""Distance over which an actor carries a resting object before the object's record is published again [m]. It is half a
cell, so that clients that join later receive the record from the cells around them."""
ACTIVATION_BATCH = 4
"""Largest number of dormant bunches that get bodies at once; making a body takes milliseconds."""


class ObjectSync:
    """One client's record of shared objects and of changes to trees. Arguments ``number`` are object ids, by
    :mod:`vinesim.scene.ids`."""

    def __init__(
        self, physics: Physics, local_actors: Collection[str], is_present: Callable[[str], bool] = lambda _: True
    ) -> None:
        """``local_actors``: names of this client's actors; ``is_present(name)``: whether another actor is present."""
        self.physics = physics
        self._local_actors = local_actors
        self._is_present = is_present
        self._remote_updates: dict[int, ObjectUpdate] = {}
        """Last received state of each object that a remote actor is moving, by object id."""
        self._resting: dict[int, RetainedRecord] = {}
        """Retained record of each object that is at rest according to its record, by object id. Boxes that nobody has
        moved since the world began have such a record too, though none was published."""
        self._unmoved: set[int] = set(physics.support_tracker.object_ids.tolist())
        """Boxes that nobody has moved since the world began, and that have not come to rest yet."""
        self._supported: dict[str, set[int]] = {}
        """Ids of the objects at rest on each parent frame, except the ground, by name of the frame."""
        self._changed_trees: set[int] = set()
        """Indices of the trees that picks or cuts have changed."""
        self._cut_bodies: dict[int, list[int]] = {}
        """Bodies that were cut off each tree, ascending."""
        self._detachments: tuple[Detachment, ...] = ()
        self._breakages: tuple[Breakage, ...] = ()
        self._given_since: dict[int, int] = {}
        """Tick in which the wood or ties of each tree first gave since the tree's last record."""
        self._given: list[int] = []
        """Trees whose records are to be published because their wood or ties gave."""

    # ------------------------------------------------------------------ received

    def receive(self, inbox: Inbox) -> None:
        """Before every step: apply all messages received from the network."""
        tracker = self.physics.support_tracker
        self.physics.remotely_posed = self.physics.remotely_posed[:0]
        self._apply_records(inbox.records)
        updates = {update.object: update for update in inbox.objects}
        for update in inbox.objects:
            self._clear_resting(update.object)
            self._ensure_body(update.object, update.pose, update.velocity)
        if updates:
            blend = np.array([BLEND_PER_STEP if number in self._remote_updates else 1.0 for number in updates])
            poses = np.array([update.pose for update in inbox.objects])
            velocities = np.array([update.velocity for update in inbox.objects])
            tracker.blend_towards(list(updates), poses, velocities, blend, self._local_actors)
            tracker.set_moving(list(updates))
        self._remote_updates = updates
        remote = self.physics.fruit_monitor.remote
        remote[:] = False
        remote[[bunch for kind, bunch in map(split_object_id, updates) if kind == ObjectKind.BUNCH]] = True
        self._hold_resting_objects()
        self._activate_dormant_bunches()

    def _apply_records(self, records: Iterable[tuple[RetainedRecord, bool]]) -> None:
        """Apply retained records (many at once after joining late), each with whether its pose still applies
        (``holds``)."""
        newest: dict[int, tuple[RetainedRecord, bool]] = {}  # several local actors receive the same records
        for record, holds in records:
            if is_tree(record.object):
                self._apply_cuts(record)
                self._apply_wood(record)
            else:
                if record.stalk is not None:
                    self._apply_stalk(record.object, *record.stalk)
                kind, bunch = split_object_id(record.object)
                if record.fruit is not None and kind == ObjectKind.BUNCH:
                    self.physics.fruit_monitor.learn(bunch, *record.fruit)
            known = newest.get(record.object)
            if known is None or (holds, known[0].claim) == (True, record.claim) or wins(record.claim, known[0].claim):
                newest.pop(record.object, None)
                newest[record.object] = record, holds
        dormant = []
        trees = []
        for record, holds in newest.values():
            if is_tree(record.object):
                trees += self._apply_tree_record(record) if holds and record.trees else []
            elif self._apply_object_record(record, holds):
                dormant.append(record)
        if trees:
            self.physics.apply_remote_rest([update.tree for update in trees], [update.joint_q for update in trees])
        if dormant:
            bunches = [split_object_id(record.object)[1] for record in dormant]
            self._changed_trees.update(self._tree_of(bunch) for bunch in bunches)
            self.physics.dormant_bunches.add(
                bunches,
                [record.parent for record in dormant],
                np.array([record.pose for record in dormant]),
                np.array([record.place or record.pose for record in dormant]),
                [record.passed for record in dormant],
            )

    def _apply_object_record(self, record: RetainedRecord, holds: bool) -> bool:
        """Move a box or a bunch to the pose in a record. Returns True for a bunch that needs no body on this client
        yet."""
        number = record.object
        kind, bunch = split_object_id(number)
        bodiless = kind == ObjectKind.BUNCH and number not in self.physics.support_tracker
        if not (holds or (bodiless and bunch not in self.physics.dormant_bunches)):
            return False
        self._remote_updates.pop(number, None)
        mover = record.author if record.moving else _carrier(record.parent)
        has_left = bool(mover) and mover not in self._local_actors and not self._is_present(mover)
        if record.moving or has_left:
            self._let_fall(record, is_known=not has_left)
            return False
        self._set_resting(number, record)
        if not bodiless:
            self._place_on_support([number])
            self._apply_passing(record)
        return bodiless

    def _let_fall(self, record: RetainedRecord, *, is_known: bool) -> None:
        """Let a box or a bunch move freely from the pose in a record.

        ``is_known``: the present pose of its body is more exact than the record, so the body stays at that pose.
        """
        number = record.object
        tracker = self.physics.support_tracker
        self._clear_resting(number)
        known_place = np.array(record.pose if record.place is None else record.place)
        pose, velocity = tracker.to_world(record.parent, np.array(record.pose)) or (known_place, np.zeros(6))
        had_body = number in tracker
        self._ensure_body(number, pose, velocity)
        if not (had_body and is_known):
            tracker.set_state(number, pose, velocity)
        tracker.set_moving([number])
        self._apply_passing(record)

    def _apply_passing(self, record: RetainedRecord) -> None:
        """Let a bunch with a body pass the trees that its record names."""
        kind, bunch = split_object_id(record.object)
        if kind == ObjectKind.BUNCH:
            self.physics.apply_remote_passing(bunch, record.passed)

    def carrier_left(self, name: str) -> None:
        """Give bodies to the objects that rested on an actor that has left. They fall when the actor's copy is removed.

        Call it while the copy still exists.
        """
        for parent in [parent for parent in self._supported if _carrier(parent) == name]:
            has_frame = self.physics.support_tracker.support_state(parent) is not None
            for number in sorted(self._supported[parent]):
                if not has_frame or number not in self.physics.support_tracker:
                    self._let_fall(self._resting[number], is_known=False)

    def _apply_cuts(self, record: RetainedRecord) -> None:
        """Cut off the bodies that the record of a tree names, and leave the stumps that it names."""
        for stump, segment, steps in sorted(record.stumps, key=lambda stump: stump[1:]):  # from the joint to the tip
            self.physics.apply_remote_stump(stump, segment, PLACE_STEP * steps, floats=stump in record.cut)
            self._changed_trees.add(record.object)
        for body in record.cut:
            if self.physics.model.body_tree[body] == record.object and not self.physics.state.body_cut[body]:
                self.apply_remote_cut(body)

    def _apply_wood(self, record: RetainedRecord) -> None:
        """Let the wood and ties of a tree give as they have given on the client that owned it."""
        if not record.wood:
            return
        self._changed_trees.add(record.object)
        self.physics.apply_remote_wood(record.object, decode_wood(record.wood))

    def wood_of(self, tree: int) -> bytes:
        """Returns how a tree has changed for good, besides cuts, as its record states it."""
        return encode_wood(self.physics.given_wood(tree))

    def fruit_of(self, number: int) -> tuple[float, float] | None:
        """Returns how many berries of a bunch burst and were lost, as its record states it; None for other objects and
        for bunches that were not handled."""
        kind, bunch = split_object_id(number)
        return self.physics.fruit_monitor.berries_off(bunch) if kind == ObjectKind.BUNCH else None

    def passed_by(self, number: int) -> tuple[int, ...]:
        """Returns the trees through which a bunch passes, as its record states them; none for other objects."""
        kind, bunch = split_object_id(number)
        return self.physics.contact_solver.passed_by(bunch) if kind == ObjectKind.BUNCH else ()

    def _apply_stalk(self, number: int, segment: int, steps: int) -> None:
        """Cut a bunch where its record names the cut, or give a bunch that was cut before its record came the stalk
        that it has. A record that names no place on the bunch's peduncle counts as one without a stalk."""
        kind, bunch = split_object_id(number)
        if kind == ObjectKind.BUNCH:
            self.physics.apply_remote_stalk(bunch, segment, PLACE_STEP * steps)

    def stumps_of(self, tree: int) -> tuple[tuple[int, int, int], ...]:
        """Returns the stumps of a tree, as its record names them."""
        state = self.physics.state
        bodies = self.physics.model.bodies_of(tree)
        return tuple(
            (stump, int(state.stump_of[stump]), round(float(state.stump_end[stump]) / PLACE_STEP))
            for stump in (bodies.start + np.flatnonzero(state.stump_of[bodies] >= 0)).tolist()
        )

    def stalk_of(self, number: int) -> tuple[int, int] | None:
        """Returns where a bunch was cut in its peduncle, as its record names it; None without a stalk."""
        kind, bunch = split_object_id(number)
        if kind != ObjectKind.BUNCH or (segment := int(self.physics.state.cut_segment[bunch])) < 0:
            return None
        return segment, round(float(self.physics.state.cut_at[bunch]) / PLACE_STEP)

    def _apply_tree_record(self, record: RetainedRecord) -> list[TreeUpdate]:
        """Apply the state of a tree in a record. Returns that state if the tree rests in it."""
        self._changed_trees.add(record.object)
        (update,) = decode_trees(record.trees, self.physics.model.tree_size).updates(record.author)
        self.blend_tree(update, 1.0)
        return [] if record.moving else [update]

    def _activate_dormant_bunches(self) -> None:
        """Give bodies to dormant bunches near an actor, a few at a time."""
        dormant = self.physics.dormant_bunches
        if len(dormant) and self.physics.tick % ACTIVATION_PERIOD == 0:
            rigid = self.physics.rigid
            actors = [rigid.base_state(name)[0][:3] for name in rigid.robots]
            actors += [rigid.human(name).part_poses[0, :3] for name in rigid.humans]
            bunches = dormant.nearest(np.array(actors), ACTIVATION_BATCH)
            dormant.activate(bunches)
            for bunch in bunches:
                self._place_on_support([object_id(ObjectKind.BUNCH, bunch)])

    def apply_remote_cut(self, body: int) -> None:
        """Cut off a body that a remote actor has cut off."""
        self.physics.apply_remote_cut(body)
        self._record_cut(body)

    def _ensure_body(self, number: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Detach a bunch that still hangs on this client, or activate it if it is dormant; boxes always have bodies."""
        kind, bunch = split_object_id(number)
        if kind == ObjectKind.BUNCH and bunch in self.physics.dormant_bunches:
            self.physics.dormant_bunches.activate([bunch])
        elif kind == ObjectKind.BUNCH and self.physics.state.bunch_attached[bunch]:
            self.physics.apply_remote_pick(bunch, pose, velocity)
            self._changed_trees.add(self._tree_of(bunch))

    def _hold_resting_objects(self) -> None:
        """Move resting objects with the supports that remote actors move, and put back objects that only copies of
        remote actors have pushed."""
        if not self._resting:
            return
        moving = set(self.physics.support_tracker.moving)
        pushed = {
            number
            for number in moving & self._resting.keys()
            if self._supporting_actor(number) not in self._local_actors
        }
        for name in self._local_actors if pushed else ():
            pushed -= self.physics.support_tracker.objects_moved_by(name)
        for number in sorted(pushed):
            self._place_on_support([number])
        for parent, objects in self._supported.items():
            if objects and self._is_moved_remotely(parent):
                self._place_on_support(sorted(objects))

    def _set_resting(self, number: int, record: RetainedRecord) -> None:
        """Set an object at rest at the pose in a record."""
        self._clear_resting(number)
        self._resting[number] = record
        if record.parent != GROUND:
            self._supported.setdefault(record.parent, set()).add(number)

    def _clear_resting(self, number: int) -> None:
        """Forget the record of rest of an object."""
        self._unmoved.discard(number)
        record = self._resting.pop(number, None)
        if record is not None and record.parent != GROUND:
            self._supported[record.parent].discard(number)

    def _is_moved_remotely(self, parent: str) -> bool:
        """Returns whether a remote actor moves a parent frame directly, or moves a body that supports the frame."""
        boxes, base = self._supports(parent)
        if any(box in self._remote_updates for box in boxes):
            return True
        return base != GROUND and _carrier(base) not in self._local_actors

    def _place_on_support(self, numbers: list[int]) -> None:
        """Put the objects of one parent that have bodies at their poses of rest in its frame."""
        tracker = self.physics.support_tracker
        numbers = [number for number in numbers if number in tracker]
        if not numbers:
            return
        parent = self._resting[numbers[0]].parent
        relative = np.array([self._resting[number].pose for number in numbers])
        there = tracker.to_world(parent, relative)
        if there is not None:
            tracker.set_states(numbers, *there)
            for number, pose in zip(numbers, relative, strict=True):
                tracker.set_at_rest(number, parent, pose)
        elif self._is_present(_carrier(parent)):  # the carrier has no body on this client yet
            for number in numbers:
                if (place := self._resting[number].place) is not None:
                    tracker.set_state(number, np.array(place), np.zeros(6))
                    tracker.set_at_rest(number, GROUND, np.array(place))

    def touched_blend(self, update: TreeUpdate) -> float:
        """Returns the share of the error by which :meth:`blend_tree` shall correct a tree in one step while an actor of
        this client touches the tree."""
        here = self.physics.state.whole_turn(self.physics.model.bodies_of(update.tree)).astype(float)
        return touched_share(float(dead_reckoning.angle_between(here, update.joint_q).max()))

    def blend_tree(self, update: TreeUpdate, blend: float, rate_blend: float = 1.0) -> None:
        """Move a tree, including parts cut off it, towards its owner's state by the share ``blend`` (0 to 1).

        Rates are blended by the share ``rate_blend``.
        """
        plants = self.physics.plants
        state = self.physics.state
        first = int(self.physics.model.tree_first[update.tree])
        for body, x, xd in zip((first + update.root).tolist(), update.root_x, update.root_xd, strict=True):
            if plants.body_end[body] == 0.0:  # a spare: the record that makes it a stump has not arrived yet
                continue
            if not state.body_cut[body]:
                self.apply_remote_cut(body)
                state.joint_x[body] = x
            state.joint_x[body] += blend * (x - state.joint_x[body])
            state.joint_xd[body] = xd
        here = self.physics.model.bodies_of(update.tree)
        rates = state.joint_qd[here] + rate_blend * (update.joint_qd - state.joint_qd[here])
        turned = state.elastic_turn(here, update.joint_q)
        plants.blend_towards(update.tree, turned, rates if rate_blend < 1.0 else update.joint_qd, blend)

    # ------------------------------------------------------------------ to send

    def collect(self) -> None:
        """Record the detachments of the last step, and update the set of moving objects. Call it after every step."""
        self.physics.support_tracker.update()
        self._record_starts()
        self._detachments = self.physics.detachments
        for detachment in self._detachments:
            self._changed_trees.add(detachment.tree)
            if detachment.bunch < 0:
                self._record_cut(detachment.body)
        monitor = self.physics.detachment_monitor
        self._breakages = monitor.breakages
        for tree in monitor.wood.given:
            self._changed_trees.add(tree)
            self._given_since.setdefault(tree, self.physics.tick)
        period = self.physics.parameters.steps(WOOD_PERIOD)
        due = {tree for tree, since in self._given_since.items() if self.physics.tick - since >= period}
        self._given = sorted(due | {one.tree for one in self._breakages})
        for tree in self._given:
            self._given_since.pop(tree, None)

    def _record_starts(self) -> None:
        """Record where boxes have come to rest that nobody has moved since the world began: it is the same place on all
        clients, unless an actor carries it."""
        if not self._unmoved:
            return
        tracker = self.physics.support_tracker
        for number in sorted(self._unmoved.intersection(tracker.sleeping)):
            parent, pose = tracker.pose_on_support(number)
            if not _carrier(parent):
                self._set_resting(number, RetainedRecord(number, 0, 0, "", pose=tuple(pose.tolist()), parent=parent))

    def detached_by(self, name: str, *, all_others: bool) -> list[int]:
        """Returns the objects that actor ``name`` detached in the last step, and the trees whose wood or ties it broke;
        with ``all_others`` also those that no local actor changed."""
        mine = [p for p in self._detachments if p.actor == name or (all_others and p.actor not in self._local_actors)]
        numbers = [object_id(ObjectKind.BUNCH, p.bunch) if p.bunch >= 0 else p.tree for p in mine]
        actor = {one.tree: one.actor for one in self._breakages}
        for tree in self._given:
            mine = actor.get(tree, "") == name or (all_others and actor.get(tree, "") not in self._local_actors)
            numbers += [tree] if mine and tree not in numbers else []
        return [number for number in numbers if is_tree(number) or number in self.physics.support_tracker]

    def forget(self, number: int) -> None:
        """Forget a box or free bunch that was removed from the world."""
        self._clear_resting(number)
        self._remote_updates.pop(number, None)

    def with_trees(self, detached: Iterable[int]) -> list[int]:
        """Returns detached objects together with the trees from which they were detached."""
        trees = [number if is_tree(number) else self._tree_of(split_object_id(number)[1]) for number in detached]
        return [*detached, *trees]

    def touched_by(self, name: str, mine: Container[int]) -> list[int]:
        """Returns the ids of the moving objects for which an actor of this client is responsible.

        These are the objects that the actor ``name`` touches, the objects that touch one of ``mine``, and the objects
        that slip off the actor. ``mine``: ids of the objects that the actor owns.
        """
        tracker = self.physics.support_tracker
        touched = self.physics.touched
        found: set[int] = set()
        if moving := tracker.moving:
            found = {number for number in moving if self._supporting_actor(number) == name}
            found |= tracker.objects_moved_by(name)
            touched = (*tracker.touched, *touched)
        for number, actor in touched:
            other = parse_object_name(actor)
            if (other is not None and other in mine) or (actor == name and is_tree(number)):
                found.add(number)
        for number in found:
            self._clear_resting(number)
        return sorted(found)

    def _supporting_actor(self, number: int) -> str:
        """Returns the actor whose link supports an object, or who put down the box that contains the object; empty on
        the ground."""
        record = self._resting.get(number)
        if record is None or record.parent == GROUND:
            return ""
        boxes, base = self._supports(record.parent)
        if base != GROUND:
            return _carrier(base)
        resting = [self._resting[box].author for box in boxes if box in self._resting]
        return resting[-1] if resting else ""

    def _supports(self, parent: str) -> tuple[list[int], str]:
        """Returns the chain of nested boxes from ``parent`` on, and the frame on which the last box rests.

        This frame is :data:`GROUND` if a box has no record of rest, or if the records form a cycle, which is possible
        with several authors.
        """
        boxes: list[int] = []
        while (box := parse_object_name(parent)) is not None and box not in boxes:
            boxes.append(box)
            if box not in self._resting:
                return boxes, GROUND
            parent = self._resting[box].parent
        return boxes, parent if box is None else GROUND

    @property
    def moving(self) -> list[int]:
        """Returns all objects that move: awake trees, and objects that are not at rest in their parent's frame."""
        return [*self.physics.sleep_monitor.restless.tolist(), *self.physics.support_tracker.moving]

    def read_state(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns state and rate of an object for :meth:`Replicator.send`: joints of a tree ([n, 4], [n, 3] rad/s), or
        pose [7] and velocity [6] of another object."""
        if not is_tree(number):
            return self.physics.support_tracker.object_state(number)
        here = self.physics.model.bodies_of(number)
        state = self.physics.state
        return state.whole_turn(here), state.joint_qd[here]

    def cut_roots(self, tree: int) -> DetachedRoots:
        """Returns the bodies that were cut off a tree, for :meth:`Replicator.send`."""
        bodies = self._cut_bodies.get(tree)
        if not bodies:
            return NO_ROOTS
        state = self.physics.state
        first = int(self.physics.model.tree_first[tree])
        return np.array(bodies) - first, state.joint_x[bodies].astype(float), state.joint_xd[bodies].astype(float)

    def is_changed(self, tree: int) -> bool:
        """Returns whether picks or cuts have changed a tree permanently."""
        return tree in self._changed_trees

    def supported_by(self, name: str) -> list[int]:
        """Returns the objects with bodies that rest on the links of an actor according to their records."""
        tracker = self.physics.support_tracker
        return sorted(
            number
            for parent, objects in self._supported.items()
            if parent.startswith(f"{name}/")
            for number in objects
            if number in tracker
        )

    def carried_on(self, name: str) -> list[int]:
        """Returns the objects at rest on an actor of this client that are far from the positions in their records."""
        if self.physics.tick % ACTIVATION_PERIOD:
            return []
        return [
            number
            for number in self.supported_by(name)
            if (place := self._resting[number].place) is not None
            and np.hypot(*(self.read_state(number)[0][:2] - place[:2])) > CARRIED_DISTANCE
        ]

    def mark_resting(self, record: RetainedRecord | None) -> None:
        """Treat an object as at rest after its retained record was sent, as all other clients do. ``record``: the
        record; None: nothing was sent."""
        if record is not None and not record.moving and record.object in self.physics.support_tracker:
            self._set_resting(record.object, record)
            self.physics.support_tracker.set_at_rest(record.object, record.parent, np.array(record.pose))

    # ------------------------------------------------------------------ inside

    def _record_cut(self, body: int) -> None:
        tree = int(self.physics.model.body_tree[body])
        here = self.physics.model.bodies_of(tree)
        self._cut_bodies[tree] = (here.start + np.flatnonzero(self.physics.state.body_cut[here])).tolist()
        self._changed_trees.add(tree)

    def _tree_of(self, bunch: int) -> int:
        return int(self.physics.model.body_tree[self.physics.model.bunch_body[bunch]])


def touched_share(away: float) -> float:
    """Returns the share of its error by which a touched copy of a tree is corrected in one step. ``away`` [rad]:
    largest error of a joint."""
    return max(TOUCHED_BLEND_PER_STEP, BLEND_PER_STEP * min(1.0, away / FAR_ANGLE))


def _carrier(parent: str) -> str:
    """Returns the actor to which the link of a parent frame belongs; empty for the ground and for boxes."""
    return "" if parse_object_name(parent) is not None else parent.partition("/")[0]
