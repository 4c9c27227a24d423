"""Batches of worlds with robots: as the physics of a client, world by world."""

import numpy as np
import pytest

from vinesim.bench import scenes
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.world import Physics

pytest.importorskip("mujoco_warp")
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
        most = max(most, max(np.linalg.norm(contact.force) for contact in physics.contacts) if physics.contacts else 0.0)
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
