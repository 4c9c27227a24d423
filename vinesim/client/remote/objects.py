"""Boxes, free bunches and cut branches that several clients share: remote states applied, local changes collected.

Objects that a remote actor moves are blended towards its states. An object at rest by a retained record is held in the
frame of what it rests on, wherever that moves, unless an actor of this client moves it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Container, Iterable

import numpy as np

from vinesim.interaction.support_tracking import GROUND
from vinesim.net.codec.control import RetainedRecord
from vinesim.net.codec.trees import decode_trees
from vinesim.net.replication import dead_reckoning
from vinesim.net.replication.authority import wins
from vinesim.net.replication.receiver import Inbox
from vinesim.net.replication.streams import NO_ROOTS, DetachedRoots
from vinesim.scene.ids import ObjectKind, is_tree, object_id, parse_object_name, split_object_id
from vinesim.scene.values import Detachment, ObjectUpdate, TreeUpdate
from vinesim.world import Physics

BLEND_PER_STEP = 0.2
"""Share of the difference to its owner's state by which a copy is corrected in one step."""
TOUCHED_BLEND_PER_STEP = 0.05
"""The same of a copy that an actor touches here, of this client or the copy of another's: corrections must not pull the
copy through the hand. TUNED."""
FAR_ANGLE = 0.1
"""Difference of a joint [rad] from which a touched copy is corrected as fast as any other, and between in proportion:
one of the two has slipped off. TUNED."""
ACTIVATION_PERIOD = 20
"""Ticks between two activations of dormant bunches."""
CARRIED_DISTANCE = 3.0
"""The record of what rests on an actor is published again when it was carried so far [m]: half a cell, so that those
who come later receive it from the cells around them."""
ACTIVATION_BATCH = 4
"""Dormant bunches that get bodies at once: making one takes milliseconds."""


class ObjectSync:
    """The state of shared objects, and of changes to trees, that one client knows; numbers are ids of :mod:`ids`."""

    def __init__(
        self, physics: Physics, local_actors: Collection[str], is_present: Callable[[str], bool] = lambda _: True
    ) -> None:
        """``local_actors``: the names of all actors that this client simulates; ``is_present(name)``: whether another
        actor is in the world now."""
        self.physics = physics
        self._local_actors = local_actors
        self._is_present = is_present
        self._remote_updates: dict[int, ObjectUpdate] = {}
        """Objects that remote actors move now."""
        self._resting: dict[int, RetainedRecord] = {}
        """Objects at rest by a retained record."""
        self._supported: dict[str, set[int]] = {}
        """Objects at rest on each parent frame but the ground."""
        self._changed_trees: set[int] = set()
        """Trees that picks or cuts have changed."""
        self._cut_bodies: dict[int, list[int]] = {}
        """Bodies that were cut off each tree, in rising order."""
        self._detachments: tuple[Detachment, ...] = ()

    # ------------------------------------------------------------------ received

    def receive(self, inbox: Inbox) -> None:
        """Apply everything that the network brought; once before every step."""
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
            tracker.blend_towards(list(updates), poses, np.array([update.velocity for update in inbox.objects]), blend)
            tracker.set_moving(list(updates))
        self._remote_updates = updates
        self._hold_resting_objects()
        self._activate_dormant_bunches()

    def _apply_records(self, records: Iterable[tuple[RetainedRecord, bool]]) -> None:
        """Apply retained records, many at once after joining late; the pose in a record counts only if it ``holds``."""
        newest: dict[int, tuple[RetainedRecord, bool]] = {}  # several local actors receive the same records
        for record, holds in records:
            if is_tree(record.object):
                self._apply_cuts(record)
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
            )

    def _apply_object_record(self, record: RetainedRecord, holds: bool) -> bool:
        """Put a box or a bunch where a record says; True if it is a bunch that has no body here and needs none yet."""
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
        return bodiless

    def _let_fall(self, record: RetainedRecord, *, is_known: bool) -> None:
        """Let a box or a bunch move from where a record says; one with a body stays where it is if that ``is_known``
        better than from the record."""
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

    def carrier_left(self, name: str) -> None:
        """An actor has left: what rested on it and has no body here gets one, and falls when the actor's copy is gone.

        To be called while the copy is still there.
        """
        for parent in [parent for parent in self._supported if _carrier(parent) == name]:
            has_frame = self.physics.support_tracker.support_state(parent) is not None
            for number in sorted(self._supported[parent]):
                if not has_frame or number not in self.physics.support_tracker:
                    self._let_fall(self._resting[number], is_known=False)

    def _apply_cuts(self, record: RetainedRecord) -> None:
        """Cut off the bodies that the record of a tree names."""
        for body in record.cut:
            if self.physics.model.body_tree[body] == record.object and not self.physics.state.body_cut[body]:
                self.apply_remote_cut(body)

    def _apply_tree_record(self, record: RetainedRecord) -> list[TreeUpdate]:
        """Take over the state of a tree that a record has; that state if the tree rests in it."""
        self._changed_trees.add(record.object)
        (update,) = decode_trees(record.trees, self.physics.model.tree_size).updates(record.author)
        self.blend_tree(update, 1.0)
        return [] if record.moving else [update]

    def _activate_dormant_bunches(self) -> None:
        """Give dormant bunches near an actor their bodies, a few at a time."""
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
        """Detach a bunch that still hangs here, or activate it if it is dormant; boxes always have bodies."""
        kind, bunch = split_object_id(number)
        if kind == ObjectKind.BUNCH and bunch in self.physics.dormant_bunches:
            self.physics.dormant_bunches.activate([bunch])
        elif kind == ObjectKind.BUNCH and self.physics.state.bunch_attached[bunch]:
            self.physics.apply_remote_pick(bunch, pose, velocity)
            self._changed_trees.add(self._tree_of(bunch))

    def _hold_resting_objects(self) -> None:
        """Move objects with the remote frames that they rest in; put back those that only remote copies have pushed."""
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
        """From now on an object rests where a record says."""
        self._clear_resting(number)
        self._resting[number] = record
        if record.parent != GROUND:
            self._supported.setdefault(record.parent, set()).add(number)

    def _clear_resting(self, number: int) -> None:
        """An object does not rest by a record any more."""
        record = self._resting.pop(number, None)
        if record is not None and record.parent != GROUND:
            self._supported[record.parent].discard(number)

    def _is_moved_remotely(self, parent: str) -> bool:
        """Whether a remote actor moves a parent frame, itself or by what it rests on."""
        boxes, base = self._supports(parent)
        if any(box in self._remote_updates for box in boxes):
            return True
        return base != GROUND and _carrier(base) not in self._local_actors

    def _place_on_support(self, numbers: list[int]) -> None:
        """Put objects of one parent, as far as they have bodies, where they rest in its frame."""
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
        elif self._is_present(_carrier(parent)):  # it has no body here yet
            for number in numbers:
                if (place := self._resting[number].place) is not None:
                    tracker.set_state(number, np.array(place), np.zeros(6))
                    tracker.set_at_rest(number, GROUND, np.array(place))

    def touched_blend(self, update: TreeUpdate) -> float:
        """Share for :meth:`blend_tree` of a tree that an actor of this client touches."""
        here = self.physics.state.joint_q[self.physics.model.bodies_of(update.tree)].astype(float)
        return touched_share(float(dead_reckoning.angle_between(here, update.joint_q).max()))

    def blend_tree(self, update: TreeUpdate, blend: float, rate_blend: float = 1.0) -> None:
        """Move a tree, and what was cut off it, towards its owner's state by the share ``blend`` (0 to 1), its rates
        by ``rate_blend``."""
        plants = self.physics.plants
        state = self.physics.state
        first = int(self.physics.model.tree_first[update.tree])
        for body, x, xd in zip((first + update.root).tolist(), update.root_x, update.root_xd, strict=True):
            if not state.body_cut[body]:
                self.apply_remote_cut(body)
                state.joint_x[body] = x
            state.joint_x[body] += blend * (x - state.joint_x[body])
            state.joint_xd[body] = xd
        here = self.physics.model.bodies_of(update.tree)
        rates = state.joint_qd[here] + rate_blend * (update.joint_qd - state.joint_qd[here])
        plants.blend_towards(update.tree, update.joint_q, rates if rate_blend < 1.0 else update.joint_qd, blend)

    # ------------------------------------------------------------------ to send

    def collect(self) -> None:
        """After the step: note detachments and update what moves."""
        self.physics.support_tracker.update()
        self._detachments = self.physics.detachments
        for detachment in self._detachments:
            self._changed_trees.add(detachment.tree)
            if detachment.bunch < 0:
                self._record_cut(detachment.body)

    def detached_by(self, name: str, *, all_others: bool) -> list[int]:
        """Objects that actor ``name`` detached in the last step; and those of no local actor if ``all_others``."""
        mine = [p for p in self._detachments if p.actor == name or (all_others and p.actor not in self._local_actors)]
        numbers = [object_id(ObjectKind.BUNCH, p.bunch) if p.bunch >= 0 else p.tree for p in mine]
        return [number for number in numbers if is_tree(number) or number in self.physics.support_tracker]

    def forget(self, number: int) -> None:
        """A box or free bunch has left the world."""
        self._clear_resting(number)
        self._remote_updates.pop(number, None)

    def with_trees(self, detached: Iterable[int]) -> list[int]:
        """Detached objects and the trees that they were detached from."""
        trees = [number if is_tree(number) else self._tree_of(split_object_id(number)[1]) for number in detached]
        return [*detached, *trees]

    def touched_by(self, name: str, mine: Container[int]) -> list[int]:
        """All that moves and that a local actor touches, itself or by an object of ``mine``, or that slips off it."""
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
        """The actor whose link an object rests on, or who put down the box that it rests in; empty on the ground."""
        record = self._resting.get(number)
        if record is None or record.parent == GROUND:
            return ""
        boxes, base = self._supports(record.parent)
        if base != GROUND:
            return _carrier(base)
        resting = [self._resting[box].author for box in boxes if box in self._resting]
        return resting[-1] if resting else ""

    def _supports(self, parent: str) -> tuple[list[int], str]:
        """The boxes that ``parent`` is or rests in, one in the other, and the frame below them that is no box.

        That is :data:`GROUND` if a box does not rest by a record, or rests in itself by way of others: records of
        several authors may say so.
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
        """All that moves: trees that are not asleep, and objects that do not rest in their parent's frame."""
        return [*self.physics.sleep_monitor.restless.tolist(), *self.physics.support_tracker.moving]

    def read_state(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """State of an object, as :meth:`Replicator.send` takes it."""
        if not is_tree(number):
            return self.physics.support_tracker.object_state(number)
        here = self.physics.model.bodies_of(number)
        state = self.physics.state
        return state.joint_q[here], state.joint_qd[here]

    def cut_roots(self, tree: int) -> DetachedRoots:
        """Bodies that were cut off a tree, as :meth:`Replicator.send` takes them."""
        bodies = self._cut_bodies.get(tree)
        if not bodies:
            return NO_ROOTS
        state = self.physics.state
        first = int(self.physics.model.tree_first[tree])
        return np.array(bodies) - first, state.joint_x[bodies].astype(float), state.joint_xd[bodies].astype(float)

    def is_changed(self, tree: int) -> bool:
        """Whether picks or cuts have changed a tree permanently."""
        return tree in self._changed_trees

    def supported_by(self, name: str) -> list[int]:
        """Objects with a body here that rest, by their records, on the links of an actor."""
        tracker = self.physics.support_tracker
        return sorted(
            number
            for parent, objects in self._supported.items()
            if parent.startswith(f"{name}/")
            for number in objects
            if number in tracker
        )

    def carried_on(self, name: str) -> list[int]:
        """Objects at rest on an actor of this client whose records name a place that is far from where they are now."""
        if self.physics.tick % ACTIVATION_PERIOD:
            return []
        return [
            number
            for number in self.supported_by(name)
            if (place := self._resting[number].place) is not None
            and np.hypot(*(self.read_state(number)[0][:2] - place[:2])) > CARRIED_DISTANCE
        ]

    def mark_resting(self, record: RetainedRecord | None) -> None:
        """A record of an object at rest was sent: from now on it rests here as for all other clients."""
        if record is not None and not record.moving and record.object in self.physics.support_tracker:
            self._set_resting(record.object, record)
            self.physics.support_tracker.set_at_rest(record.object, record.parent, np.array(record.pose))

    # ------------------------------------------------------------------ inside

    def _record_cut(self, body: int) -> None:
        tree = int(self.physics.model.body_tree[body])
        bodies = self._cut_bodies.setdefault(tree, [])
        if body not in bodies:
            bodies.append(body)
            bodies.sort()
        self._changed_trees.add(tree)

    def _tree_of(self, bunch: int) -> int:
        return int(self.physics.model.body_tree[self.physics.model.bunch_body[bunch]])


def touched_share(away: float) -> float:
    """Share by which a touched copy is corrected in one step; ``away`` [rad]: the largest error of a joint."""
    return max(TOUCHED_BLEND_PER_STEP, BLEND_PER_STEP * min(1.0, away / FAR_ANGLE))


def _carrier(parent: str) -> str:
    """The actor that a parent frame is a link of; empty for the ground and for boxes."""
    return "" if parse_object_name(parent) is not None else parent.partition("/")[0]
