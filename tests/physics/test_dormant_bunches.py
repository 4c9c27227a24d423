"""Dormant bunches: many at once without bodies, activated with their full mass near actors."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.shared_vineyard import BOX, BUNCH, vineyard
from vinesim.core import frames
from vinesim.world import Physics


def test_many_dormant_bunches_are_added_without_bodies():
    physics = Physics(vineyard(40, 2, 0.5))
    trees = physics.model.body_tree[physics.model.bunch_body]
    poses = np.array([frames.pose([3.0, 0.2 * i, 0.05]) for i in range(40)])
    generation = physics.rigid.generation
    physics.dormant_bunches.add(list(range(40)), [""] * 39 + ["box/1"], poses)
    physics.step()
    assert physics.rigid.generation == generation
    assert physics.rigid.free_bunches == ()
    assert not physics.state.bunch_attached.any()
    assert len(physics.plants.awake) == 0, f"{trees}: no tree wakes"
    snapshot = physics.snapshot()
    assert [link.name for link in snapshot.visuals][-40:] == [f"bunch/{i}" for i in range(40)]
    np.testing.assert_allclose(snapshot.visual_q[-40:-1], poses[:-1])
    box = physics.support_tracker.object_state(BOX(1))[0]
    np.testing.assert_allclose(snapshot.visual_q[-1], frames.compose(box, poses[-1]), atol=1e-9)
    assert physics.snapshot().visuals is snapshot.visuals
    # drawn with the shapes it had on the vine
    assert len(snapshot.visuals[-1].shapes) > 2


def test_an_activated_bunch_has_the_mass_of_a_picked_one():
    physics = Physics(vineyard(3))
    picked = Physics(vineyard(3))
    physics.dormant_bunches.add([0, 1, 2], [""] * 3, np.array([frames.pose([x, 0.0, 0.05]) for x in (0.0, 1.0, 9.0)]))
    assert physics.dormant_bunches.nearest(np.array([[0.2, 0.0, 0.0]]), 5) == [0, 1]
    assert physics.dormant_bunches.nearest(np.array([[0.2, 0.0, 0.0]]), 1) == [0]
    assert physics.dormant_bunches.nearest(np.array([[40.0, 0.0, 0.0]]), 5) == []
    before = physics.visuals()
    physics.dormant_bunches.activate([0, 1])
    assert physics.visuals() is not before
    assert physics.rigid.free_bunches == (0, 1)
    assert len(physics.dormant_bunches) == 1
    picked.pick(0)
    world = physics.rigid.mj_model
    other = picked.rigid.mj_model
    assert world.body("free_bunch/0").mass == pytest.approx(other.body("free_bunch/0").mass)
    np.testing.assert_allclose(world.body("free_bunch/0").inertia, other.body("free_bunch/0").inertia, rtol=1e-4)
    np.testing.assert_allclose(
        physics.support_tracker.object_state(BUNCH(1))[0], frames.pose([1.0, 0.0, 0.05]), atol=1e-9
    )
    with pytest.raises(ValueError, match="bunch 1 is already a free bunch"):
        physics.dormant_bunches.rigid.add_bunch(
            1, physics.rigid._free_bunches[1], frames.pose([0.0, 0, 0]), np.zeros(6)
        )


def test_a_tree_moves_without_its_dormant_bunch():
    physics = Physics(vineyard(1))
    other = Physics(vineyard(1))
    physics.dormant_bunches.add([0], [""], frames.pose([3.0, 0.0, 0.05])[None])
    other.pick(0)
    physics.plants.wake(0)
    for _ in range(30):
        physics.step()
        other.step()
    for each in (physics, other):
        each.update_kinematics()
    body = physics.model.bunch_body[0]
    assert physics.state.body_q[body, 2] > 1.33, "the cane rises"
    np.testing.assert_allclose(physics.state.body_q[body, :3], other.state.body_q[body, :3], atol=1e-3)


def test_a_remote_rest_pose_is_applied_without_waking():
    physics = Physics(vineyard(2))
    other = Physics(vineyard(2))
    other.pick(0)
    for _ in range(200):
        other.step()
    bodies = other.model.bodies_of(0)
    other_pose = other.state.joint_q[bodies]
    several = 2 * len(physics.model.tree_first)  # as several actors of one client are told
    physics.apply_remote_rest(several * [0], (several - 1) * [physics.state.joint_q[bodies]] + [other_pose])
    assert len(physics.plants.awake) == 0
    assert physics.remotely_posed.tolist() == [0]
    assert physics.snapshot().moved_trees.tolist() == [0]
    other.update_kinematics()
    np.testing.assert_allclose(physics.state.body_q[bodies], other.state.body_q[bodies], atol=1e-5)
