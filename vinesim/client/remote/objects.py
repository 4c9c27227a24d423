"""Boxes, loose bunches and what was cut: what others say of them is done, and what is to be said of them is found.

What others move is pulled to where they say. What lies by a fact is held there: at rest in its parent's frame, wherever
that goes, unless it is our own robot that moves it.
"""

from __future__ import annotations

from collections.abc import Collection, Container, Iterable

import numpy as np

from vinesim.net.codec import messages
from vinesim.net.codec.messages import RetainedRecord
from vinesim.net.replication.exchange import Inbox
from vinesim.net.replication.streams import NO_ROOTS, DetachedRoots
from vinesim.physics.rigid.support_tracking import GROUND
from vinesim.physics.step import Physics
from vinesim.scene.ids import ObjectKind, is_tree, object_id, parse_object_name, split_object_id
from vinesim.scene.values import Detachment, ObjectUpdate, TreeUpdate

BLEND_PER_STEP = 0.2
"""Share of the way to where its owner says it is by which a copy moves in one tick."""
ACTIVATION_PERIOD, ACTIVATION_BATCH = 20, 4
"""So many bunches get their bodies at once, and so many ticks pass between two times: making one costs milliseconds."""


class ObjectSync:
    """What one client knows of all that is loose."""

    def __init__(self, physics: Physics, ours: Collection[str]) -> None:
        """``ours``: the names of all actors that this client moves."""
        self.physics, self._local_actors = physics, ours
        self._remote_updates: dict[int, ObjectUpdate] = {}
        self._resting: dict[int, RetainedRecord] = {}
        self._supported: dict[str, set[int]] = {}
        self._changed_trees: set[int] = set()
        self._cut_bodies: dict[int, list[int]] = {}
        self._detachments: tuple[Detachment, ...] = ()

    # ------------------------------------------------------------------ what others say

    def receive(self, inbox: Inbox) -> None:
        """Do what others say is so, every tick before the step."""
        riding = self.physics.support_tracker
        self.physics.remotely_posed = self.physics.remotely_posed[:0]
        self._apply_records(inbox.records)
        told = {update.object: update for update in inbox.objects}
        for update in inbox.objects:
            self._clear_resting(update.object)
            self._ensure_body(update.object, update.pose, update.velocity)
        if told:
            blend = np.array([BLEND_PER_STEP if number in self._remote_updates else 1.0 for number in told])
            poses = np.array([update.pose for update in inbox.objects])
            riding.blend_towards(list(told), poses, np.array([update.velocity for update in inbox.objects]), blend)
            riding.set_moving(list(told))
        self._remote_updates = told
        self._hold_resting_objects()
        self._activate_dormant_bunches()

    def _apply_records(self, facts: Iterable[tuple[RetainedRecord, bool]]) -> None:
        """Take facts over, many at once for whoever comes late; where one says that a thing is counts if it holds."""
        lie, trees = [], []
        for fact, holds in facts:
            if is_tree(fact.object):
                trees += self._apply_tree_record(fact, holds)
            elif self._apply_object_record(fact, holds):
                lie.append(fact)
        if trees:
            self.physics.apply_remote_rest([update.tree for update in trees], [update.joint_q for update in trees])
        if lie:
            bunches = [split_object_id(fact.object)[1] for fact in lie]
            self._changed_trees.update(self._tree_of(bunch) for bunch in bunches)
            self.physics.dormant_bunches.add(
                bunches, [fact.parent for fact in lie], np.array([fact.pose for fact in lie])
            )

    def _apply_object_record(self, fact: RetainedRecord, holds: bool) -> bool:
        """Let a box or a bunch be where a fact says; True if it is a bunch that has no body here and needs none yet."""
        number = fact.object
        kind, bunch = split_object_id(number)
        bodiless = kind == ObjectKind.BUNCH and number not in self.physics.support_tracker
        if not (holds or (bodiless and bunch not in self.physics.dormant_bunches)):
            return False
        self._remote_updates.pop(number, None)
        if fact.moving:
            self._clear_resting(number)
            pose = np.array(fact.pose)
            self._ensure_body(
                number, *(self.physics.support_tracker.to_world(fact.parent, pose) or (pose, np.zeros(6)))
            )
            self.physics.support_tracker.set_moving([number])
            return False
        self._set_resting(number, fact)
        if not bodiless:
            self._place_on_support([number])
        return bodiless

    def _apply_tree_record(self, fact: RetainedRecord, holds: bool) -> list[TreeUpdate]:
        """Cut of a tree what a fact says; the state in which it rests, if the fact says that and ``holds``."""
        for body in fact.cut:
            if self.physics.model.body_tree[body] == fact.object and not self.physics.state.body_cut[body]:
                self.apply_remote_cut(body)
        if not (holds and fact.trees):
            return []
        self._changed_trees.add(fact.object)
        (update,) = messages.decode_trees(fact.trees, self.physics.model.tree_size).updates(fact.author)
        self.blend_tree(update, 1.0)
        return [] if fact.moving else [update]

    def _activate_dormant_bunches(self) -> None:
        """Give bunches that lie near an actor their bodies, a few now and then."""
        lying = self.physics.dormant_bunches
        if len(lying) and self.physics.tick % ACTIVATION_PERIOD == 0:
            rigid = self.physics.rigid
            actors = [rigid.base_state(name)[0][:3] for name in rigid.robots]
            actors += [rigid.human(name).part_poses[0, :3] for name in rigid.humans]
            bunches = lying.nearest(np.array(actors), ACTIVATION_BATCH)
            lying.activate(bunches)
            for bunch in bunches:
                self._place_on_support([object_id(ObjectKind.BUNCH, bunch)])

    def apply_remote_cut(self, body: int) -> None:
        """Cut a body off because others have."""
        self.physics.apply_remote_cut(body)
        self._record_cut(body)

    def _ensure_body(self, number: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Of a bunch that hangs here still, or has no body: take it off, give it one."""
        kind, bunch = split_object_id(number)
        if kind == ObjectKind.BUNCH and bunch in self.physics.dormant_bunches:
            self.physics.dormant_bunches.activate([bunch])
        elif kind == ObjectKind.BUNCH and self.physics.state.bunch_attached[bunch]:
            self.physics.apply_remote_pick(bunch, pose, velocity)
            self._changed_trees.add(self._tree_of(bunch))

    def _hold_resting_objects(self) -> None:
        """What lies in a frame that others move goes with it; what was pushed by copies only goes back."""
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
        for parent, riders in self._supported.items():
            if riders and self._is_moved_remotely(parent):
                self._place_on_support(sorted(riders))

    def _set_resting(self, number: int, fact: RetainedRecord) -> None:
        """From now on a thing lies where a fact says."""
        self._clear_resting(number)
        self._resting[number] = fact
        if fact.parent != GROUND:
            self._supported.setdefault(fact.parent, set()).add(number)

    def _clear_resting(self, number: int) -> None:
        """A thing does not lie any more."""
        fact = self._resting.pop(number, None)
        if fact is not None and fact.parent != GROUND:
            self._supported[fact.parent].discard(number)

    def _is_moved_remotely(self, parent: str) -> bool:
        """Whether a parent goes where somebody else says."""
        if parent == GROUND:
            return False
        box = parse_object_name(parent)
        if box is None:
            return parent.partition("/")[0] not in self._local_actors
        return box in self._remote_updates or (
            box in self._resting and self._is_moved_remotely(self._resting[box].parent)
        )

    def _place_on_support(self, numbers: list[int]) -> None:
        """Put things of one parent where they lie, as far as they have bodies."""
        riding = self.physics.support_tracker
        numbers = [number for number in numbers if number in riding]
        if not numbers:
            return
        parent = self._resting[numbers[0]].parent
        relative = np.array([self._resting[number].pose for number in numbers])
        there = riding.to_world(parent, relative)
        if there is not None:
            riding.set_states(numbers, *there)
            for number, pose in zip(numbers, relative, strict=True):
                riding.set_at_rest(number, parent, pose)

    def blend_tree(self, update: TreeUpdate, blend: float) -> None:
        """Move a tree towards what its owner says, and what was cut off it."""
        plants, state = self.physics.plants, self.physics.state
        first = int(self.physics.model.tree_first[update.tree])
        for body, x, xd in zip((first + update.root).tolist(), update.root_x, update.root_xd, strict=True):
            if not state.body_cut[body]:
                self.apply_remote_cut(body)
                state.joint_x[body] = x
            state.joint_x[body] += blend * (x - state.joint_x[body])
            state.joint_xd[body] = xd
        plants.blend_towards(update.tree, update.joint_q, update.joint_qd, blend)

    # ------------------------------------------------------------------ what is to be said

    def collect(self) -> None:
        """After the step: note what parted and what moves."""
        self.physics.support_tracker.update()
        self._detachments = self.physics.detachments
        for parting in self._detachments:
            self._changed_trees.add(parting.tree)
            if parting.bunch < 0:
                self._record_cut(parting.body)

    def detached_by(self, name: str, *, all_others: bool) -> list[int]:
        """What left its plant in the last tick by the doing of an actor of ours, or by nobody's if ``all_others``."""
        mine = [p for p in self._detachments if p.actor == name or (all_others and p.actor not in self._local_actors)]
        return [object_id(ObjectKind.BUNCH, p.bunch) if p.bunch >= 0 else p.tree for p in mine]

    def with_trees(self, parted: Iterable[int]) -> list[int]:
        """What was parted and the trees that it was parted from."""
        trees = [number if is_tree(number) else self._tree_of(split_object_id(number)[1]) for number in parted]
        return [*parted, *trees]

    def touched_by(self, name: str, mine: Container[int]) -> list[int]:
        """Everything that moves and that an actor of ours touches, or what it moves; and what slips off it."""
        riding = self.physics.support_tracker
        found = {
            number for number in riding.moving if self._supporting_actor(number) == name
        } | riding.objects_moved_by(name)
        for number, actor in (*riding.touched, *self.physics.touched):
            other = parse_object_name(actor)
            if other in mine or (actor == name and is_tree(number)):
                found.add(number)
        for number in found:
            self._clear_resting(number)
        return sorted(found)

    def _supporting_actor(self, number: int) -> str:
        """Who bears what a thing is said to lie on: whose link it is, or who put the box down; of the ground nobody."""
        fact = self._resting.get(number)
        if fact is None or fact.parent == GROUND:
            return ""
        box = parse_object_name(fact.parent)
        if box is None:
            return fact.parent.partition("/")[0]
        return (self._supporting_actor(box) or self._resting[box].author) if box in self._resting else ""

    @property
    def moving(self) -> list[int]:
        """All that moves: trees that are not asleep, and what does not rest in its parent's frame."""
        return [*self.physics.sleep_monitor.restless.tolist(), *self.physics.support_tracker.moving]

    def read_state(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """State of a thing, as :meth:`Exchange.send` wants it."""
        if not is_tree(number):
            return self.physics.support_tracker.object_state(number)
        here, state = self.physics.model.bodies_of(number), self.physics.state
        return state.joint_q[here], state.joint_qd[here]

    def cut_roots(self, tree: int) -> DetachedRoots:
        """What was cut off a tree, as :meth:`Exchange.send` wants it."""
        bodies = self._cut_bodies.get(tree)
        if not bodies:
            return NO_ROOTS
        state, first = self.physics.state, int(self.physics.model.tree_first[tree])
        return np.array(bodies) - first, state.joint_x[bodies].astype(float), state.joint_xd[bodies].astype(float)

    def is_changed(self, tree: int) -> bool:
        """Whether picks or cuts have changed a tree for good."""
        return tree in self._changed_trees

    def supported_by(self, name: str) -> list[int]:
        """What lies, as everybody knows, on the links of an actor."""
        return sorted(
            number for parent, riders in self._supported.items() if parent.startswith(f"{name}/") for number in riders
        )  # fmt: skip

    def mark_resting(self, fact: RetainedRecord | None) -> None:
        """We have said that a thing of ours lies still: from now on it does, as for everybody else."""
        if fact is not None and not fact.moving and not is_tree(fact.object):
            self._set_resting(fact.object, fact)
            self.physics.support_tracker.set_at_rest(fact.object, fact.parent, np.array(fact.pose))

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
