from __future__ import annotations

import logging

import numpy as np
import pytest

from vinesim import frames
from vinesim.physics.guard import Guard
from vinesim.physics.plants import Plants
from vinesim.world.grow import Tree, Wood, assemble
from vinesim.world.state import State


def row(count: int) -> Plants:
    trees = []
    for i in range(count):
        tree = Tree(frames.pose(np.array([0.0, i, 2.0])))
        tree.rod(-1, 0.5, (0.004, 0.003), Wood(5e9, 800.0, 0.01), 6)
        tree.settle()
        trees.append(tree)
    model = assemble(trees)
    return Plants(model, State.at_rest(model))


@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e9])
def test_a_poisoned_tree_is_rolled_back_and_the_others_go_on(poison: float, caplog: pytest.LogCaptureFixture) -> None:
    plants, clean = row(3), row(3)
    guard = Guard(plants)
    for each in (plants, clean):
        each.wake(np.arange(3))
        each.state.joint_qd[:, 1] = 0.3
    for tick in range(30):
        plants.free()
        clean.free()
        clean.commit()
        if tick != 10:
            plants.commit()
            assert guard.check().size == 0
            continue
        before = plants.state.joint_q.copy()
        plants.commit(np.array([8]), np.array([[poison, 0.0, 0.0, 0.0, 0.0, 0.0]]))
        assert guard.check().tolist() == [1]
        assert not caplog.records
    bad, good = plants.model.bodies_of(1), np.delete(np.arange(18), plants.model.bodies_of(1))
    np.testing.assert_array_equal(plants.state.joint_q[bad], before[bad])
    assert not plants.state.joint_qd[bad].any()
    assert plants.awake.tolist() == [0, 2]
    np.testing.assert_array_equal(plants.state.joint_q[good], clean.state.joint_q[good])
    assert guard.count.tolist() == [0, 1, 0]
    with caplog.at_level(logging.WARNING):
        faults = guard.report()
    assert [(fault.tick, fault.tree) for fault in faults] == [(11, 1)]
    assert "tree 1 stopped in tick 11" in caplog.text
    assert guard.report() == []


def test_a_stopped_tree_wakes_sound() -> None:
    plants = row(1)
    guard = Guard(plants)
    plants.wake(0)
    plants.state.joint_q[3] = np.nan
    plants.body_load[2, 1] = np.inf
    plants.free()
    plants.commit()
    assert guard.check().tolist() == [0]
    plants.wake(0)
    for _ in range(20):
        plants.free()
        plants.commit()
        assert guard.check().size == 0
    assert np.isfinite(plants.state.body_q).all()
    assert plants.tree_rate[0] < 0.1
