"""Copies of trees that other clients own. This client simulates each copy, and states from its owner correct it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterable, KeysView

import numpy as np

from vinesim.client.remote.objects import BLEND_PER_STEP, ObjectSync, touched_share
from vinesim.core import frames
from vinesim.net.replication import dead_reckoning
from vinesim.scene.ids import parse_object_name
from vinesim.scene.values import TreeUpdate
from vinesim.world import Physics

CONTACT_MEMORY = 0.15
"""Time after the end of a contact for which a tree's copy still counts as pressed [s], so that a contact may open
briefly. GUESSED."""


@dataclasses.dataclass(slots=True)
class _Copy:
    """The copy of one tree that an actor of another client owns."""

    update: TreeUpdate
    """Last state from the owner, with its time of arrival."""
    is_new: bool
    """Whether ``update`` has not yet corrected the copy."""
    correction: np.ndarray
    """Remaining correcting rotation of each joint, in the joint's own frame [body, 3] rad."""
    pressed_at: float = -np.inf
    """Time at which copies of actors or objects last pressed on the copy [s, client's clock]."""


class TreeCopies:
    """Simulated copies of the trees that other clients own.

    The simulation of a copy includes its weight, wind and contacts, also contacts with the copies of other clients'
    actors. If no other forces act on the owner's tree, this simulation predicts it better than any extrapolation, and
    each received state corrects the copy once. If a force is missing on this client, such as a hand that holds the
    owner's tree, the copy is pulled to the extrapolated state in every step.
    """

    def __init__(self, physics: Physics, objects: ObjectSync) -> None:
        self.physics = physics
        self.objects = objects
        self._copies: dict[int, _Copy] = {}

    def __contains__(self, tree: int) -> bool:
        return tree in self._copies

    @property
    def trees(self) -> KeysView[int]:
        """Indices of the trees of which this client moves copies."""
        return self._copies.keys()

    def apply(
        self,
        updates: Iterable[TreeUpdate],
        now: float,
        *,
        is_owned_remotely: Callable[[int], bool],
        local_actors: Collection[str],
        coupled_trees: Collection[int],
    ) -> None:
        """Before every step: take new states from owners and correct the copies; ``now``: time of the client's clock
        [s].

        ``coupled_trees``: trees on which couplings (virtual springs) of other clients' actors act.
        """
        solver = self.physics.contact_solver
        copies = self._copies
        for update in updates:
            if (copy := copies.get(update.tree)) is None:
                self.physics.plants.wake(update.tree)
                self.objects.blend_tree(update, 1.0)
                solver.remote_trees[update.tree] = True
                copies[update.tree] = _Copy(update, False, np.zeros((len(update.joint_q), 3)))
            else:
                copy.update = update
                copy.is_new = True
        for tree in [tree for tree in copies if not is_owned_remotely(tree)]:
            update = copies.pop(tree).update
            solver.remote_trees[tree] = solver.trees_touched_by_copies[tree] = False
            if update.resting:
                self.objects.blend_tree(update, 1.0)
        touching: dict[int, set[str]] = {}
        for tree, actor in self.physics.touched if copies else ():
            touching.setdefault(tree, set()).add(actor)
        for tree, copy in copies.items():
            self.physics.plants.wake(tree)
            # otherwise the forces of couplings would act twice on this client
            solver.trees_touched_by_copies[tree] = tree not in coupled_trees
            self._correct(copy, now, touching.get(tree, set()), local_actors)

    def _correct(self, copy: _Copy, now: float, touching: set[str], local_actors: Collection[str]) -> None:
        """Correct one copy; ``touching``: names of actors and objects that pressed on it in the last step."""
        update = copy.update
        objects = self.objects
        if update.owner in touching or any(parse_object_name(name) is not None for name in touching):
            copy.pressed_at = now
        is_pressed = now - copy.pressed_at <= CONTACT_MEMORY
        if not touching.isdisjoint(local_actors):
            blend = objects.touched_blend(update)
            objects.blend_tree(update, blend, blend)
        elif len(update.root) or (update.touched and not is_pressed):
            objects.blend_tree(_extrapolated(update, now), BLEND_PER_STEP)
        else:
            self._correct_once(copy, is_pressed)
        copy.is_new = False

    def _correct_once(self, copy: _Copy, is_pressed: bool) -> None:
        """Rotate the joints by a share of the error that the last state revealed, until that error is corrected."""
        update = copy.update
        here = self.physics.state.whole_turn(self.physics.model.bodies_of(update.tree)).astype(float)
        if copy.is_new:
            copy.correction = frames.log(frames.multiply(frames.conjugate(here), update.joint_q))
        away = float(np.sqrt((copy.correction * copy.correction).sum(1).max()))
        share = touched_share(away) if is_pressed else BLEND_PER_STEP
        there = frames.multiply(here, frames.exp(copy.correction))
        self.objects.blend_tree(dataclasses.replace(update, joint_q=there), share, share if copy.is_new else 0.0)
        copy.correction *= 1.0 - share


def _extrapolated(update: TreeUpdate, now: float) -> TreeUpdate:
    """Extrapolate a state from its arrival to ``now`` [s] with velocities that fade to zero; return it."""
    age = float(dead_reckoning.clamp_age(now - update.time))
    rate = dead_reckoning.quaternion_rate(update.joint_q, update.joint_qd)
    return dataclasses.replace(
        update,
        joint_q=dead_reckoning.extrapolate(update.joint_q, rate, dead_reckoning.faded_age(age)),
        joint_qd=update.joint_qd * dead_reckoning.faded_share(age),
        root_x=update.root_x + age * update.root_xd,
    )
