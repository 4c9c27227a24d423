"""Copies of trees that other clients own: what moves them between two states of their owner."""

import numpy as np
import pytest

from tests.support.contact_scenes import bunch_scene, held_point
from vinesim.client.remote.objects import ObjectSync
from vinesim.client.remote.tree_copies import TreeCopies
from vinesim.scene.values import TreeUpdate
from vinesim.world import Physics

ASIDE = np.array([0.0, 0.06, 0.0])
"""By which the owner draws the bunch aside [3] m."""


class Pair:
    """A bunch of one client, and its copy on another, which receives a state every ``period`` [s]."""

    def __init__(self, period: float) -> None:
        model, self.body, self.rest = bunch_scene(0.5)
        self.owner = Physics(model)
        self.other = Physics(model)
        self.copies = TreeCopies(self.other, ObjectSync(self.other, {"other"}))
        self.every = round(period / self.owner.dt)
        self.touched = False

    def run(self, seconds: float) -> np.ndarray:
        """Where the bunch is on both, from its rest [step, 2, 3] m."""
        rows = []
        for _ in range(round(seconds / self.owner.dt)):
            news = [self.state()] if self.owner.tick % self.every == 0 else []
            self.copies.apply(
                news, self.other.time, is_owned_remotely=lambda _: True, local_actors={"other"}, coupled_trees=()
            )
            for physics in (self.owner, self.other):
                physics.step()
                physics.update_kinematics()
            places = [physics.state.body_q[self.body].astype(float) for physics in (self.owner, self.other)]
            rows.append([held_point(self.owner.model, pose, self.body) - self.rest for pose in places])
        return np.array(rows)

    def state(self) -> TreeUpdate:
        here = self.owner.model.bodies_of(0)
        state = self.owner.state
        q = state.joint_q[here].astype(float)
        qd = state.joint_qd[here].astype(float)
        return TreeUpdate(0, "owner", 0, 0, self.other.time, False, self.touched, q, qd)

    def hold(self) -> int:
        """Draw the owner's bunch aside, as a hand does that holds it; the tie."""
        self.touched = True
        tie = self.owner.plants.add_tie(self.body, np.array([0.085, 0.0, 0.0]), 300.0, 20.0)
        self.owner.plants.tie_anchor[tie] += ASIDE
        self.owner.plants.wake(0)
        return tie


@pytest.fixture
def pair() -> Pair:
    return Pair(period=0.5)


def test_a_copy_that_nobody_touches_swings_between_two_states(pair):
    tie = pair.hold()
    pair.run(1.0)
    pair.owner.plants.remove_tie(pair.body, tie)
    pair.touched = False
    pair.run(0.5)
    own, copied = pair.run(3.0).swapaxes(0, 1)
    assert np.ptp(own[:, 1]) > 0.05
    assert np.linalg.norm(own - copied, axis=1).max() < 2e-3


def test_a_copy_stays_where_a_hand_holds_it_that_is_not_here(pair):
    pair.hold()
    pair.run(3.0)
    own, copied = pair.run(2.0).swapaxes(0, 1)
    assert np.linalg.norm(own, axis=1).min() > 0.03
    assert np.linalg.norm(own - copied, axis=1).max() < 5e-3


def test_an_error_is_corrected_once_and_smoothly(pair):
    """A state moves a copy by a fifth of the error in each step, and what it corrected stays corrected."""
    pair.run(1.0)
    first = pair.owner.model.bodies_of(0)
    turned = pair.state()
    turned.joint_q[0] = (np.sin(0.01), 0.0, 0.0, np.cos(0.01))
    before = pair.other.state.joint_q[first][0, 0]
    pair.copies.apply(
        [turned], pair.other.time, is_owned_remotely=lambda _: True, local_actors={"other"}, coupled_trees=()
    )
    assert pair.other.state.joint_q[first][0, 0] - before == pytest.approx(0.2 * (np.sin(0.01) - before), rel=0.01)
