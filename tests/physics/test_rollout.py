from __future__ import annotations

import numpy as np
import pytest

from tests.support.clustered_trees import clustered
from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.rollout import Rollout, RolloutDiverged
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.model import Model
from vinesim.scene.state import State


def canes(count: int = 2) -> Model:
    trees = []
    for i in range(count):
        tree = TreeBuilder(frames.pose(np.array([0.0, i, 2.0])))
        tree.add_rod(-1, 0.5, (0.004, 0.003), RodMaterial(5e9, 800.0, 0.02), 4 + i)
        trees.append(tree)
    return assemble(trees)


@pytest.mark.parametrize("fine", [False, True])
def test_a_rollout_equals_the_solver(fine: bool) -> None:
    """Bitwise, over segments of different lengths, with coarse or fine clusters."""
    model = clustered(2)
    rng = np.random.default_rng(2)
    rates = 0.1 * rng.normal(size=(len(model.body_mass), 3))  # no tree is fast: a rollout takes whole steps
    load = 0.001 * rng.normal(size=(len(model.body_mass), 6))
    plants = ArticulationSolver(model, State.at_rest(model))
    plants.wake(np.arange(2))
    if fine:
        plants.refine(np.arange(2))
    else:
        rates[plants.berry_clusters.clusters_of(np.arange(2))] = 0.0
    plants.state.joint_qd[:] = rates
    plants.body_load[:] = load
    rollout = Rollout(model, 17, checkpoint=7, fine=fine)
    track = rollout.run(joint_qd=rates, load=load)
    for tick in range(17):
        plants.predict()
        np.testing.assert_array_equal(track.body_q[tick], plants.state.body_q[rollout.watched])
        np.testing.assert_array_equal(track.body_qd[tick], plants.state.body_qd[rollout.watched])
        np.testing.assert_array_equal(track.phi[tick], plants.phi_used)
        plants.integrate()
    plants.forward_kinematics()
    np.testing.assert_array_equal(track.body_q[-1], plants.state.body_q[rollout.watched])
    assert len(rollout.watched) == (
        len(rates) if fine else len(rates) - len(plants.berry_clusters.clusters_of(np.arange(2)))
    )


def test_gradients_do_not_depend_on_checkpoints_or_history() -> None:
    model = canes()
    seed = np.random.default_rng(1).normal(size=(31, 2, 7))
    found = []
    for checkpoint in (30, 11, 1):
        rollout = Rollout(model, 30, watched=np.array([3, 8]), checkpoint=checkpoint)
        for _ in range(2):
            rollout.run()
            found += [rollout.gradient(seed).stiffness, rollout.gradient(seed).stiffness]
    assert np.abs(found[0]).max() > 0.0
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_gradients_of_trees_are_independent() -> None:
    rollout = Rollout(canes(), 20, watched=np.array([3]))
    rollout.run()
    gradient = rollout.gradient(by_qd=np.ones((21, 1, 6)))
    assert np.abs(gradient.mass[:4]).min() > 0.0
    assert not gradient.mass[4:].any()


def test_invalid_input_is_refused_with_the_reason() -> None:
    model = canes()
    with pytest.raises(ValueError, match="0 ticks"):
        Rollout(model, 0)
    rollout = Rollout(model, 5)
    with pytest.raises(ValueError, match="call run"):
        rollout.gradient(np.zeros((6, 9, 7)))
    bad = model.joint_stiffness.copy()
    bad[2, 1] = -1.0
    with pytest.raises(ValueError, match=r"stiffness\[2, 1\] is -1.0; give finite numbers, 0.0 or more"):
        rollout.run(stiffness=bad)
    with pytest.raises(ValueError, match=r"mass of shape \(3,\); this rollout needs \(9,\)"):
        rollout.run(mass=np.ones(3))
    rollout.run()
    with pytest.raises(ValueError, match=r"by_q of shape"):
        rollout.gradient(np.zeros((6, 1, 7)))
    rates = np.zeros((9, 3))
    rates[5] = 1e6
    with pytest.raises(RolloutDiverged, match=r"tree 1 turned at .* rad/s in tick 0"):
        rollout.run(joint_qd=rates)
    fruit = clustered(1)
    with pytest.raises(ValueError, match="berry cluster that rides on its bunch: watch that, or give fine=True"):
        Rollout(fruit, 5, watched=np.array([len(fruit.body_mass) - 1]))
