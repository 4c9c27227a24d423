"""Batches of worlds with robots: as the physics of a client, world by world."""

import numpy as np
import pytest

from vinesim.bench import scenes
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.world import Physics

pytest.importorskip("mujoco_warp")
from vinesim.worlds.plants import plants_of_worlds
from vinesim.worlds.worlds import Worlds

PARAMETERS = PhysicsParameters(sleep=False)
HAND = scenes.gripper("hand", scenes.bunch_center(0))


def bunches(count: int) -> Model:
    """Canes with a bunch, one a world, all at the same place."""
    model = scenes.cane_row(count)
    model.tree_pose[:] = model.tree_pose[0]
    return model


def targets(tick: int, lift: float) -> np.ndarray:
    """Returns the targets [lift, left finger, right finger] m of a hand that closes, and then lifts what it holds."""
    close = 0.04 * min(tick / 25, 1.0)
    return np.array([lift * min(max(tick - 35, 0) / 30, 1.0), close, close])


@pytest.mark.slow
def test_a_hand_grasps_and_lifts_a_bunch_as_in_a_client():
    """Two seconds; the hand of the second world lifts half as high, and must not change the first one."""
    physics = Physics(bunches(1), parameters=PARAMETERS)
    physics.contact_solver.plant_plant_contacts = False
    physics.add_robot(HAND)
    physics.wake(np.arange(1))
    worlds = Worlds(bunches(2), 2, robots=[HAND], parameters=PARAMETERS)
    most = 0.0
    for tick in range(200):
        physics.rigid.command("hand", targets(tick, 0.1))
        worlds.bodies.targets.assign(np.array([targets(tick, 0.1), targets(tick, 0.05)], np.float32))
        physics.step()
        worlds.step()
        most = max(
            most, max(np.linalg.norm(contact.force) for contact in physics.contacts) if physics.contacts else 0.0
        )
    worlds.download()
    physics.update_kinematics()
    bodies = len(physics.state.body_q)
    found, other = worlds.plants.state.body_q.reshape(2, bodies, 7)
    assert most > 30.0, "the fingers press with the force of their servos"
    assert worlds.contacts.count.tolist() == [physics.contact_solver.count] * 2
    np.testing.assert_allclose(found, physics.state.body_q, atol=1e-4)
    np.testing.assert_allclose(worlds.bodies.data.qpos.numpy()[0], physics.rigid.mj_data.qpos[:6], atol=1e-4)
    assert found[-1, 2] - other[-1, 2] == pytest.approx(0.05, abs=0.01)
    assert not worlds.dropped.any()


@pytest.mark.slow
def test_a_world_that_is_reset_repeats_its_steps_to_the_bit_and_the_other_goes_on():
    worlds = Worlds(bunches(2), 2, robots=[HAND], parameters=PARAMETERS)

    def run(first: int, count: int) -> np.ndarray:
        for tick in range(first, first + count):
            worlds.bodies.targets.assign(np.array([targets(tick, 0.1)] * 2, np.float32))
            worlds.step()
        worlds.download()
        return worlds.plants.state.joint_q.reshape(2, -1, 4).copy()

    begin = run(0, 60)
    later = run(60, 30)
    assert np.abs(later - begin).max() > 1e-3
    worlds.reset(np.array([True, False]))
    again = run(0, 60)
    np.testing.assert_array_equal(again[0], begin[0])
    assert np.abs(again[1] - begin[1]).max() > 1e-3


def test_plants_of_worlds_are_those_of_their_models():
    """Two worlds of one scene, and one of another, whose canes are longer."""
    one, other = scenes.cane_row(2), scenes.cane_row(2)
    other.body_length *= 1.1
    model = plants_of_worlds([one, other], 3).check()
    assert model.tree_pose[:, 1].tolist() == pytest.approx([0.0, 0.0, 0.0, 0.15, 0.15, 0.15])
    size = len(one.body_mass) // 2
    long = model.body_length[model.tree_first] / one.body_length[0]
    assert long.tolist() == pytest.approx([1.0, 1.1, 1.0, 1.0, 1.1, 1.0])
    assert (model.bunch_body == model.tree_first + size - 1).all()
    assert plants_of_worlds([one], 1).digest() == one.digest()


def test_models_with_different_numbers_of_trees_are_refused():
    with pytest.raises(ValueError, match="model 1 has 3 trees, model 0 has 2"):
        plants_of_worlds([scenes.cane_row(2), scenes.cane_row(3)], 2)
