"""Robots of a batch: their effective masses are those of a client."""

import numpy as np
import pytest
import warp as wp

from vinesim.bench import scenes
from vinesim.kernels.worlds.narrowphase import WorldContacts
from vinesim.kernels.worlds.rigid_state import invert_effective_mass
from vinesim.learn.arm import JOINT_LIMIT, arm
from vinesim.rigid.effective_mass import EffectiveMass
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.physics_parameters import PhysicsParameters

pytest.importorskip("mujoco_warp")
from vinesim.worlds.rigid_batch import RigidBatch

PARAMETERS = PhysicsParameters(sleep=False, bunch_pool_size=0)
BENT = np.array([0.0, -JOINT_LIMIT - 0.02, 0.1, JOINT_LIMIT + 0.03, 0.0, 1.6, 0.0, 0.0, 0.0])
"""Two joints are beyond their limits."""


def world() -> RigidWorld:
    rigid = RigidWorld(scenes.cane_row(1), parameters=PARAMETERS)
    rigid.add_robot(arm((0.0, 0.0, 0.6), BENT))
    return rigid


@pytest.mark.slow
def test_joints_at_their_limits_resist_as_in_a_client():
    """In the second world the joints are at 0, and no limit acts."""
    client, batch = world(), RigidBatch(world(), 2)
    robot = client.robot("arm")
    qpos = batch.data.qpos.numpy()
    qpos[1, robot.q] = 0.0
    batch.data.qpos.assign(qpos)
    client.predict()
    batch.predict()
    dofs = client.mj_model.nv
    assert batch.data.nefc.numpy().tolist() == [2, 0]
    inverse = wp.zeros((2 * dofs, dofs), dtype=wp.float64, device="cpu")
    contacts = WorldContacts()
    contacts.count = wp.ones(2, dtype=wp.int32, device="cpu")
    wp.launch(
        invert_effective_mass, 2, inputs=[batch.effective_mass(), 2, dofs, contacts], outputs=[inverse], device="cpu"
    )
    limited, free = inverse.numpy().reshape(dofs, dofs, 2).transpose(2, 0, 1)
    response = EffectiveMass(client.mj_model).impulse_response(client.mj_data, np.eye(dofs))
    np.testing.assert_allclose(limited, response, rtol=1e-4, atol=1e-5 * np.abs(response).max())
    held = robot.v[[1, 3]]
    assert (np.diag(limited)[held] < 0.1 * np.diag(free)[held]).all()


@pytest.mark.slow
def test_a_joint_that_its_servo_presses_beyond_its_limit_moves_as_in_a_client():
    """Half a second without plants in reach. The limit must not be stiffer in the second half of a step."""
    client, batch = world(), RigidBatch(world(), 1)
    wanted = np.array([0.0, -3.0, 0.0, 3.0, 0.5, 1.0, 0.0, 0.0, 0.0])
    client.command("arm", wanted)
    batch.targets.assign(wanted[None].astype(np.float32))
    for _ in range(50):
        client.predict()
        client.integrate()
        batch.predict()
        wp.copy(batch.likely_acceleration, batch.data.qacc)
        batch.integrate()
    robot = client.robot("arm")
    beyond = np.abs(client.mj_data.qpos[robot.q[[1, 3]]]) - JOINT_LIMIT
    assert (beyond > 1e-4).all()
    np.testing.assert_allclose(batch.data.qpos.numpy()[0], client.mj_data.qpos, atol=1e-5)
