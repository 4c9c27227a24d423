"""Boxes, loose bunches and what was cut: what others say of them is done, and what is to be said of them is found.

What others move is pulled to where they say. What lies by a fact is held there: at rest in its parent's frame, wherever
that goes, unless it is our own robot that moves it.
"""

from __future__ import annotations

from collections.abc import Container, Iterable

import numpy as np

from vinesim.net import messages
from vinesim.net.exchange import Inbox
from vinesim.net.messages import Fact
from vinesim.net.streams import NO_ROOTS, Roots
from vinesim.physics.riding import GROUND
from vinesim.physics.step import Physics
from vinesim.world.ids import Kind, is_tree, thing, thing_named, unthing
from vinesim.world.values import Parting, ThingUpdate, TreeUpdate

PULL = 0.2
"""Share of the way to where its owner says it is by which a copy moves in one tick."""


class Things:
    """What one client knows of all that is loose."""

    def __init__(self, physics: Physics, ours: Container[str]) -> None:
        """``ours``: the names of all actors that this client moves."""
        self.physics, self._ours = physics, ours
        self._told: dict[int, ThingUpdate] = {}
        self._lies: dict[int, Fact] = {}
        self._changed: set[int] = set()
        self._cut: dict[int, list[int]] = {}
        self._partings: tuple[Parting, ...] = ()

    # ------------------------------------------------------------------ what others say

    def receive(self, inbox: Inbox) -> None:
        """Do what others say is so, every tick before the step."""
        for fact, holds in inbox.facts:
            self._believe(fact, holds)
        for number in inbox.released:
            self._told.pop(number, None)
        told = {update.thing: update for update in inbox.things}
        riding = self.physics.riding
        for number in self._told.keys() - told.keys():
            self._told.pop(number)
        for number, update in sorted(told.items()):
            first = number not in self._told
            self._told[number] = update
            self._lies.pop(number, None)
            self._loosen(number, update.pose, update.velocity)
            riding.pull(number, update.pose, update.velocity, 1.0 if first else PULL)
            riding.unsettle(number)
        self._hold()

    def _believe(self, fact: Fact, holds: bool) -> None:
        """Take a fact over; where it says that a thing is counts only if that ``holds``."""
        number = fact.thing
        if is_tree(number):
            self._believe_tree(fact, holds)
            return
        pose = np.array(fact.pose)
        there = self.physics.riding.where(fact.parent, pose) or (pose, np.zeros(6))
        fresh = self._loosen(number, *there)
        if not (holds or fresh):
            return
        self._told.pop(number, None)
        if fact.moving:
            self._lies.pop(number, None)
            self.physics.riding.unsettle(number)
        else:
            self._lies[number] = fact
            self._put(number)

    def _believe_tree(self, fact: Fact, holds: bool) -> None:
        for body in fact.cut:
            if self.physics.model.body_tree[body] == fact.thing and not self.physics.state.body_cut[body]:
                self.cut(body)
        if not (holds and fact.trees):
            return
        self._changed.add(fact.thing)
        (update,) = messages.decode_trees(fact.trees, self.physics.model.tree_size).updates(fact.author)
        self.physics.sleep.wake(np.array([fact.thing]))
        self.pull_tree(update, 1.0)

    def cut(self, body: int) -> None:
        """Cut a body off because others have."""
        self.physics.told_cut(body)
        self._note_cut(body)

    def _loosen(self, number: int, pose: np.ndarray, velocity: np.ndarray) -> bool:
        """Of a bunch that hangs here still and nowhere else: take it off; whether that was so."""
        kind, bunch = unthing(number)
        if kind != Kind.BUNCH or not self.physics.state.bunch_attached[bunch]:
            return False
        self.physics.told_pick(bunch, pose, velocity)
        self._changed.add(self._tree_of(bunch))
        return True

    def _hold(self) -> None:
        """What lies in a frame that others move goes with it; what was pushed by copies only goes back."""
        moving = set(self.physics.riding.moving)
        pushed = moving & self._lies.keys()
        if pushed:
            pushed -= {number for number, actor in self.physics.riding.touched if actor in self._ours}
        for number, fact in self._lies.items():
            if number in pushed or self._moved_by_others(fact.parent):
                self._put(number)

    def _moved_by_others(self, parent: str) -> bool:
        """Whether a parent goes where somebody else says."""
        if parent == GROUND:
            return False
        box = thing_named(parent)
        if box is None:
            return parent.partition("/")[0] not in self._ours
        return box in self._told or (box in self._lies and self._moved_by_others(self._lies[box].parent))

    def _put(self, number: int) -> None:
        """Put a thing where it lies."""
        parent, relative = self._lies[number].parent, np.array(self._lies[number].pose)
        there = self.physics.riding.where(parent, relative)
        if there is not None:
            self.physics.riding.place(number, *there)
            self.physics.riding.settle(number, parent, relative)

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
        self.physics.riding.update()
        self._partings = self.physics.partings
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
        """Everything that moves and that an actor of ours touches, or what it moves; and what lies in its boxes."""
        found = [number for number in self.physics.riding.moving if self._box_of(number) == name]
        for number, actor in (*self.physics.riding.touched, *self.physics.touched):
            other = thing_named(actor)
            if actor == name or (other is not None and other in mine):
                found.append(number)
        for number in found:
            self._lies.pop(number, None)
        return found

    def _box_of(self, number: int) -> str:
        """Who put the box down in which a thing is said to lie."""
        fact = self._lies.get(number)
        box = None if fact is None else thing_named(fact.parent)
        return self._lies[box].author if box in self._lies else ""

    @property
    def moving(self) -> list[int]:
        """All that moves: trees that are not asleep, and what does not rest in its parent's frame."""
        return [*self.physics.sleep.moving.tolist(), *self.physics.riding.moving]

    def read(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """State of a thing, as :meth:`Exchange.send` wants it."""
        if not is_tree(number):
            return self.physics.riding.read(number)
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

    def rested(self, fact: Fact | None) -> None:
        """We have said that a thing of ours lies still: from now on it does, as for everybody else."""
        if fact is not None and not fact.moving and not is_tree(fact.thing):
            self._lies[fact.thing] = fact
            self.physics.riding.settle(fact.thing, fact.parent, np.array(fact.pose))

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
