"""Boxes, loose bunches and what was cut: what others say of them is done, and what is to be said of them is found.

What others move is pulled to where they say. What lies by a fact is held there: at rest in its parent's frame, wherever
that goes, unless it is our own robot that moves it.
"""

from __future__ import annotations

from collections.abc import Collection, Container, Iterable

import numpy as np

from vinesim.net.codec import messages
from vinesim.net.codec.messages import Fact
from vinesim.net.replication.exchange import Inbox
from vinesim.net.replication.streams import NO_ROOTS, Roots
from vinesim.physics.rigid.support_tracking import GROUND
from vinesim.physics.step import Physics
from vinesim.scene.ids import Kind, is_tree, thing, thing_named, unthing
from vinesim.scene.values import Parting, ThingUpdate, TreeUpdate

PULL = 0.2
"""Share of the way to where its owner says it is by which a copy moves in one tick."""
EMBODY_TICKS, EMBODIED = 20, 4
"""So many bunches get their bodies at once, and so many ticks pass between two times: making one costs milliseconds."""


class Things:
    """What one client knows of all that is loose."""

    def __init__(self, physics: Physics, ours: Collection[str]) -> None:
        """``ours``: the names of all actors that this client moves."""
        self.physics, self._ours = physics, ours
        self._told: dict[int, ThingUpdate] = {}
        self._lies: dict[int, Fact] = {}
        self._riders: dict[str, set[int]] = {}
        self._changed: set[int] = set()
        self._cut: dict[int, list[int]] = {}
        self._partings: tuple[Parting, ...] = ()

    # ------------------------------------------------------------------ what others say

    def receive(self, inbox: Inbox) -> None:
        """Do what others say is so, every tick before the step."""
        riding = self.physics.support_tracker
        self.physics.remotely_posed = self.physics.remotely_posed[:0]
        self._believe(inbox.facts)
        told = {update.thing: update for update in inbox.things}
        for update in inbox.things:
            self._rise(update.thing)
            self._loosen(update.thing, update.pose, update.velocity)
        if told:
            blend = np.array([PULL if number in self._told else 1.0 for number in told])
            poses = np.array([update.pose for update in inbox.things])
            riding.blend_towards(list(told), poses, np.array([update.velocity for update in inbox.things]), blend)
            riding.set_moving(list(told))
        self._told = told
        self._hold()
        self._embody()

    def _believe(self, facts: Iterable[tuple[Fact, bool]]) -> None:
        """Take facts over, many at once for whoever comes late; where one says that a thing is counts if it holds."""
        lie, trees = [], []
        for fact, holds in facts:
            if is_tree(fact.thing):
                trees += self._cut_as(fact, holds)
            elif self._lies_as(fact, holds):
                lie.append(fact)
        if trees:
            self.physics.apply_remote_rest([update.tree for update in trees], [update.joint_q for update in trees])
        if lie:
            bunches = [unthing(fact.thing)[1] for fact in lie]
            self._changed.update(self._tree_of(bunch) for bunch in bunches)
            self.physics.dormant_bunches.add(bunches, [fact.parent for fact in lie], np.array([fact.pose for fact in lie]))

    def _lies_as(self, fact: Fact, holds: bool) -> bool:
        """Let a box or a bunch be where a fact says; True if it is a bunch that has no body here and needs none yet."""
        number = fact.thing
        kind, bunch = unthing(number)
        bodiless = kind == Kind.BUNCH and number not in self.physics.support_tracker
        if not (holds or (bodiless and bunch not in self.physics.dormant_bunches)):
            return False
        self._told.pop(number, None)
        if fact.moving:
            self._rise(number)
            pose = np.array(fact.pose)
            self._loosen(number, *(self.physics.support_tracker.to_world(fact.parent, pose) or (pose, np.zeros(6))))
            self.physics.support_tracker.set_moving([number])
            return False
        self._lie(number, fact)
        if not bodiless:
            self._put([number])
        return bodiless

    def _cut_as(self, fact: Fact, holds: bool) -> list[TreeUpdate]:
        """Cut of a tree what a fact says; the state in which it rests, if the fact says that and ``holds``."""
        for body in fact.cut:
            if self.physics.model.body_tree[body] == fact.thing and not self.physics.state.body_cut[body]:
                self.cut(body)
        if not (holds and fact.trees):
            return []
        self._changed.add(fact.thing)
        (update,) = messages.decode_trees(fact.trees, self.physics.model.tree_size).updates(fact.author)
        self.pull_tree(update, 1.0)
        return [] if fact.moving else [update]

    def _embody(self) -> None:
        """Give bunches that lie near an actor their bodies, a few now and then."""
        lying = self.physics.dormant_bunches
        if len(lying) and self.physics.tick % EMBODY_TICKS == 0:
            rigid = self.physics.rigid
            actors = [rigid.base_state(name)[0][:3] for name in rigid.robots]
            actors += [rigid.human(name).part_poses[0, :3] for name in rigid.humans]
            bunches = lying.nearest(np.array(actors), EMBODIED)
            lying.activate(bunches)
            for bunch in bunches:
                self._put([thing(Kind.BUNCH, bunch)])

    def cut(self, body: int) -> None:
        """Cut a body off because others have."""
        self.physics.apply_remote_cut(body)
        self._note_cut(body)

    def _loosen(self, number: int, pose: np.ndarray, velocity: np.ndarray) -> None:
        """Of a bunch that hangs here still, or has no body: take it off, give it one."""
        kind, bunch = unthing(number)
        if kind == Kind.BUNCH and bunch in self.physics.dormant_bunches:
            self.physics.dormant_bunches.activate([bunch])
        elif kind == Kind.BUNCH and self.physics.state.bunch_attached[bunch]:
            self.physics.apply_remote_pick(bunch, pose, velocity)
            self._changed.add(self._tree_of(bunch))

    def _hold(self) -> None:
        """What lies in a frame that others move goes with it; what was pushed by copies only goes back."""
        moving = set(self.physics.support_tracker.moving)
        pushed = {number for number in moving & self._lies.keys() if self._bearer(number) not in self._ours}
        for name in self._ours if pushed else ():
            pushed -= self.physics.support_tracker.objects_moved_by(name)
        for number in sorted(pushed):
            self._put([number])
        for parent, riders in self._riders.items():
            if riders and self._moved_by_others(parent):
                self._put(sorted(riders))

    def _lie(self, number: int, fact: Fact) -> None:
        """From now on a thing lies where a fact says."""
        self._rise(number)
        self._lies[number] = fact
        if fact.parent != GROUND:
            self._riders.setdefault(fact.parent, set()).add(number)

    def _rise(self, number: int) -> None:
        """A thing does not lie any more."""
        fact = self._lies.pop(number, None)
        if fact is not None and fact.parent != GROUND:
            self._riders[fact.parent].discard(number)

    def _moved_by_others(self, parent: str) -> bool:
        """Whether a parent goes where somebody else says."""
        if parent == GROUND:
            return False
        box = thing_named(parent)
        if box is None:
            return parent.partition("/")[0] not in self._ours
        return box in self._told or (box in self._lies and self._moved_by_others(self._lies[box].parent))

    def _put(self, numbers: list[int]) -> None:
        """Put things of one parent where they lie, as far as they have bodies."""
        riding = self.physics.support_tracker
        numbers = [number for number in numbers if number in riding]
        if not numbers:
            return
        parent = self._lies[numbers[0]].parent
        relative = np.array([self._lies[number].pose for number in numbers])
        there = riding.to_world(parent, relative)
        if there is not None:
            riding.set_states(numbers, *there)
            for number, pose in zip(numbers, relative, strict=True):
                riding.set_at_rest(number, parent, pose)

    def pull_tree(self, update: TreeUpdate, blend: float) -> None:
        """Move a tree towards what its owner says, and what was cut off it."""
        plants, state = self.physics.plants, self.physics.state
        first = int(self.physics.model.tree_first[update.tree])
        for body, x, xd in zip((first + update.root).tolist(), update.root_x, update.root_xd, strict=True):
            if not state.body_cut[body]:
                self.cut(body)
                state.joint_x[body] = x
            state.joint_x[body] += blend * (x - state.joint_x[body])
            state.joint_xd[body] = xd
        plants.pull(update.tree, update.joint_q, update.joint_qd, blend)

    # ------------------------------------------------------------------ what is to be said

    def look(self) -> None:
        """After the step: note what parted and what moves."""
        self.physics.support_tracker.update()
        self._partings = self.physics.detachments
        for parting in self._partings:
            self._changed.add(parting.tree)
            if parting.bunch < 0:
                self._note_cut(parting.body)

    def parted(self, name: str, *, all_others: bool) -> list[int]:
        """What left its plant in the last tick by the doing of an actor of ours, or by nobody's if ``all_others``."""
        mine = [p for p in self._partings if p.actor == name or (all_others and p.actor not in self._ours)]
        return [thing(Kind.BUNCH, p.bunch) if p.bunch >= 0 else p.tree for p in mine]

    def grabbed(self, parted: Iterable[int]) -> list[int]:
        """What was parted and the trees that it was parted from."""
        trees = [number if is_tree(number) else self._tree_of(unthing(number)[1]) for number in parted]
        return [*parted, *trees]

    def touched(self, name: str, mine: Container[int]) -> list[int]:
        """Everything that moves and that an actor of ours touches, or what it moves; and what slips off it."""
        riding = self.physics.support_tracker
        found = {number for number in riding.moving if self._bearer(number) == name} | riding.objects_moved_by(name)
        for number, actor in (*riding.touched, *self.physics.touched):
            other = thing_named(actor)
            if other in mine or (actor == name and is_tree(number)):
                found.add(number)
        for number in found:
            self._rise(number)
        return sorted(found)

    def _bearer(self, number: int) -> str:
        """Who bears what a thing is said to lie on: whose link it is, or who put the box down; of the ground nobody."""
        fact = self._lies.get(number)
        if fact is None or fact.parent == GROUND:
            return ""
        box = thing_named(fact.parent)
        if box is None:
            return fact.parent.partition("/")[0]
        return (self._bearer(box) or self._lies[box].author) if box in self._lies else ""

    @property
    def moving(self) -> list[int]:
        """All that moves: trees that are not asleep, and what does not rest in its parent's frame."""
        return [*self.physics.sleep_monitor.moving.tolist(), *self.physics.support_tracker.moving]

    def read(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """State of a thing, as :meth:`Exchange.send` wants it."""
        if not is_tree(number):
            return self.physics.support_tracker.object_state(number)
        here, state = self.physics.model.bodies_of(number), self.physics.state
        return state.joint_q[here], state.joint_qd[here]

    def cuts(self, tree: int) -> Roots:
        """What was cut off a tree, as :meth:`Exchange.send` wants it."""
        bodies = self._cut.get(tree)
        if not bodies:
            return NO_ROOTS
        state, first = self.physics.state, int(self.physics.model.tree_first[tree])
        return np.array(bodies) - first, state.joint_x[bodies].astype(float), state.joint_xd[bodies].astype(float)

    def changed(self, tree: int) -> bool:
        """Whether picks or cuts have changed a tree for good."""
        return tree in self._changed

    def riders(self, name: str) -> list[int]:
        """What lies, as everybody knows, on the links of an actor."""
        return sorted(
            number for parent, riders in self._riders.items() if parent.startswith(f"{name}/") for number in riders
        )  # fmt: skip

    def rested(self, fact: Fact | None) -> None:
        """We have said that a thing of ours lies still: from now on it does, as for everybody else."""
        if fact is not None and not fact.moving and not is_tree(fact.thing):
            self._lie(fact.thing, fact)
            self.physics.support_tracker.set_at_rest(fact.thing, fact.parent, np.array(fact.pose))

    # ------------------------------------------------------------------ inside

    def _note_cut(self, body: int) -> None:
        tree = int(self.physics.model.body_tree[body])
        bodies = self._cut.setdefault(tree, [])
        if body not in bodies:
            bodies.append(body)
            bodies.sort()
        self._changed.add(tree)

    def _tree_of(self, bunch: int) -> int:
        return int(self.physics.model.body_tree[self.physics.model.bunch_body[bunch]])
