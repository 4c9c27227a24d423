"""Picked bunches without bodies: many at once for nothing, and whole when somebody comes."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.shared_vineyard import BOX, BUNCH, vineyard
from vinesim import frames
from vinesim.physics.step import Physics


def test_many_are_laid_down_at_once_and_have_no_body():
    physics = Physics(vineyard(40, 2, 0.5))
    trees = physics.model.body_tree[physics.model.bunch_body]
    poses = np.array([frames.pose([3.0, 0.2 * i, 0.05]) for i in range(40)])
    generation = physics.rigid.generation
    physics.lying.lay(list(range(40)), [""] * 39 + ["box/1"], poses)
    physics.step()
    assert physics.rigid.generation == generation
    assert physics.rigid.loose == ()
    assert not physics.state.bunch_attached.any()
    assert len(physics.plants.awake) == 0, f"{trees}: nobody wakes for it"
    view = physics.view()
    assert [link.name for link in view.links][-40:] == [f"bunch/{i}" for i in range(40)]
    np.testing.assert_allclose(view.link_q[-40:-1], poses[:-1])
    box = physics.riding.read(BOX(1))[0]
    np.testing.assert_allclose(view.link_q[-1], frames.compose(box, poses[-1]), atol=1e-9)
    assert physics.view().links is view.links
    # drawn with the shapes it had on its vine
    assert len(view.links[-1].shapes) > 2


def test_who_is_near_gets_a_body_with_the_weight_it_had():
    physics, fallen = Physics(vineyard(3)), Physics(vineyard(3))
    physics.lying.lay([0, 1, 2], [""] * 3, np.array([frames.pose([x, 0.0, 0.05]) for x in (0.0, 1.0, 9.0)]))
    assert physics.lying.nearest(np.array([[0.2, 0.0, 0.0]]), 5) == [0, 1]
    assert physics.lying.nearest(np.array([[0.2, 0.0, 0.0]]), 1) == [0]
    assert physics.lying.nearest(np.array([[40.0, 0.0, 0.0]]), 5) == []
    before = physics.links()
    physics.lying.embody([0, 1])
    assert physics.links() is not before
    assert physics.rigid.loose == (0, 1)
    assert len(physics.lying) == 1
    fallen.pick(0)
    world, other = physics.rigid.world, fallen.rigid.world
    assert world.body("loose/0").mass == pytest.approx(other.body("loose/0").mass)
    np.testing.assert_allclose(world.body("loose/0").inertia, other.body("loose/0").inertia, rtol=1e-4)
    np.testing.assert_allclose(physics.riding.read(BUNCH(1))[0], frames.pose([1.0, 0.0, 0.05]), atol=1e-9)
    with pytest.raises(ValueError, match="bunch 1 is loose already"):
        physics.lying.rigid.add_bunch(1, physics.rigid._bunches[1], frames.pose([0.0, 0, 0]), np.zeros(6))


def test_a_tree_whose_bunch_was_laid_down_moves_without_it_when_it_wakes():
    physics, other = Physics(vineyard(1)), Physics(vineyard(1))
    physics.lying.lay([0], [""], frames.pose([3.0, 0.0, 0.05])[None])
    other.pick(0)
    physics.plants.wake(0)
    for _ in range(30):
        physics.step()
        other.step()
    for one in (physics, other):
        one.refresh()
    body = physics.model.bunch_body[0]
    assert physics.state.body_q[body, 2] > 1.33, "it springs up"
    np.testing.assert_allclose(physics.state.body_q[body, :3], other.state.body_q[body, :3], atol=1e-3)


def test_trees_rest_as_others_say_without_waking():
    physics, other = Physics(vineyard(2)), Physics(vineyard(2))
    other.pick(0)
    for _ in range(200):
        other.step()
    here = other.model.bodies_of(0)
    physics.told_rest([0], [other.state.joint_q[here]])
    assert len(physics.plants.awake) == 0
    assert physics.stirred.tolist() == [0]
    assert physics.view().moved.tolist() == [0]
    other.refresh()
    np.testing.assert_allclose(physics.state.body_q[here], other.state.body_q[here], atol=1e-5)
