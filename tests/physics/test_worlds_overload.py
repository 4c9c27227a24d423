"""Peduncles break under their load in batches of worlds as in a client."""

import numpy as np
import pytest

from tests.physics.test_worlds import PARAMETERS
from tests.physics.test_worlds_cutting import pose_in_client, poses_in_batch
from vinesim.scene.model import Model
from vinesim.world import Physics

pytest.importorskip("mujoco_warp")
from vinesim.learn.arm import arm
from vinesim.learn.shoots import shoots
from vinesim.worlds.plants import plants_of_worlds
from vinesim.worlds.worlds import Worlds

ROBOT = arm((-2.0, 0.0, 0.6))


def weak(seed: int, pull: float, bend: float) -> Model:
    model = shoots(1, np.random.default_rng(seed), 1.2)
    model.bunch_pull[:] = pull
    model.bunch_bend[:] = bend
    return model


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "pull", "bend", "rate", "segment"),
    [
        pytest.param(1, 4.0, 5.0, 1.0, 8, id="at the shoot"),
        pytest.param(3, 3.5, 50.0, 2.0, -1, id="at the bunch"),
        pytest.param(8, 4.0, 5.0, 1.0, 8, id="at the shoot, after half a second"),
        pytest.param(5, 8.0, 50.0, 6.0, -1, id="at the bunch, in a wild swing"),
    ],
)
def test_a_peduncle_breaks_in_the_step_and_at_the_end_of_a_client(
    seed: int, pull: float, bend: float, rate: float, segment: int
) -> None:
    """The shoot of the first world swings, that of the second hangs still and bears more."""
    model = weak(seed, pull, bend)
    physics = Physics(model, parameters=PARAMETERS)
    physics.contact_solver.plant_plant_contacts = False
    physics.add_robot(ROBOT)
    physics.wake(np.arange(1))
    start = np.random.default_rng(seed).normal(0.0, rate, physics.state.joint_qd.shape)
    physics.state.joint_qd[:] = start
    strong = weak(seed, 500.0, 50.0)
    worlds = Worlds(plants_of_worlds([model, strong], 2), 2, robots=[ROBOT], parameters=PARAMETERS, breaks=True)
    assert worlds.pool is not None
    worlds.plants.state.joint_qd[:] = np.concatenate([start, np.zeros_like(start)])
    worlds.plants.upload()
    broke = -1
    for tick in range(150):
        physics.step()
        worlds.step()
        if physics.detachments:
            broke = tick
            assert physics.detachments[0].segment == segment
        assert worlds.pool.is_free.numpy().tolist() == [int(broke >= 0), 0]
        if 0 <= broke <= tick:
            np.testing.assert_allclose(poses_in_batch(worlds)[0], pose_in_client(physics), atol=1e-4)
        if broke >= 0 and tick == broke + 30:
            break
    assert broke > 2
    physics.update_kinematics()
    worlds.download()
    found = worlds.plants.state.body_q[: len(model.body_mass)]
    assert physics.plants.tree_substeps[0] == 2, "the step of a shoot without its bunch is divided only in a client"
    np.testing.assert_allclose(found[:, :3], physics.state.body_q[:, :3], atol=1e-3)
    assert not worlds.faults.numpy().any()
    worlds.reset()
    assert not worlds.pool.is_free.numpy().any()


@pytest.mark.slow
def test_many_steps_in_one_call_break_as_single_steps_do_and_a_reset_world_repeats_it() -> None:
    model = weak(1, 4.0, 5.0)
    worlds = Worlds(plants_of_worlds([model], 2), 2, robots=[ROBOT], parameters=PARAMETERS, breaks=True)
    assert worlds.pool is not None
    start = np.tile(np.random.default_rng(1).normal(0.0, 1.0, (len(model.body_mass), 3)), (2, 1))
    _set_in_motion(worlds, start)
    for _ in range(60):
        worlds.step()
    first = poses_in_batch(worlds).copy()
    _set_in_motion(worlds, start)
    worlds.step(60)
    np.testing.assert_array_equal(poses_in_batch(worlds), first)
    assert worlds.pool.is_free.numpy().tolist() == [1, 1]


def _set_in_motion(worlds: Worlds, start: np.ndarray) -> None:
    """Reset the worlds, and give their joints the rates ``start`` [body, 3] rad/s."""
    worlds.reset()
    worlds.download()
    worlds.plants.state.joint_qd[:] = start
    worlds.plants.upload()
