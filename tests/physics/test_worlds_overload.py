"""Peduncles and canes break under their load in batches of worlds as in a client."""

import numpy as np
import pytest

from tests.physics.test_worlds import PARAMETERS
from tests.physics.test_worlds_cutting import pose_in_client, poses_in_batch
from tests.support.layouts import order_bodies_as_a_gpu
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.world import Physics

pytest.importorskip("mujoco_warp")
from vinesim.learn.arm import arm
from vinesim.learn.shoots import shoots
from vinesim.worlds.plants import plants_of_worlds
from vinesim.worlds.worlds import Worlds

pytestmark = pytest.mark.usefixtures("layout")

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
@pytest.mark.parametrize(("pull", "strength"), [(4.0, 0.0), (500.0, 4e7)])
def test_many_steps_in_one_call_break_as_single_steps_do_and_reset_worlds_repeat_them(
    pull: float, strength: float
) -> None:
    """Peduncles break, or canes."""
    model = weak(1, pull, 5.0 if pull < 5.0 else 500.0)
    model.body_strength[model.body_organ == int(Organ.CANE)] = strength
    model.body_toughness[:] = 1e3
    worlds = Worlds(plants_of_worlds([model], 2), 2, robots=[ROBOT], parameters=PARAMETERS, breaks=True)
    assert worlds.pool is not None
    rate = 1.0 if pull < 5.0 else 6.0
    start = np.tile(np.random.default_rng(1).normal(0.0, rate, (len(model.body_mass), 3)), (2, 1))
    _set_in_motion(worlds, start)
    for _ in range(60):
        worlds.step()
    worlds.download()
    first = poses_in_batch(worlds).copy(), worlds.plants.state.joint_q.copy(), worlds.plants._parent.copy()
    _set_in_motion(worlds, start)
    assert (worlds.plants._root < 0).all()
    worlds.step(60)
    worlds.download()
    again = poses_in_batch(worlds), worlds.plants.state.joint_q, worlds.plants._parent
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    assert worlds.pool.is_free.numpy().all() == (pull < 5.0)
    assert (worlds.plants._root >= 0).any() == (strength > 0.0)


@pytest.mark.slow
def test_wood_breaks_the_same_to_the_bit_in_the_order_of_bodies_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Peduncles break in some worlds and canes in others; four trees lie side by side in the kernels' arrays."""
    models = [weak(1, 4.0, 5.0), weak(2, 500.0, 500.0), weak(3, 3.5, 500.0)]
    models[1].body_strength[models[1].body_organ == int(Organ.CANE)] = 3e7
    models[1].body_toughness[:] = 1e3

    def moved() -> np.ndarray:
        worlds = Worlds(plants_of_worlds(models, 6), 6, robots=[ROBOT], parameters=PARAMETERS, breaks=True)
        assert worlds.pool is not None
        bodies = len(models[0].body_mass)
        start = np.random.default_rng(4).normal(0.0, 5.0, (6 * bodies, 3))
        _set_in_motion(worlds, start)
        seen = []
        for _ in range(30):
            worlds.step()
            worlds.download()
            seen.append(worlds.plants.state.body_q.copy())
        assert worlds.pool.is_free.numpy()[[0, 3]].all()
        fallen = worlds.pool.canes.parts[1].numpy()[worlds.plants.buffers.slots].reshape(6, bodies)
        assert fallen.any(1).tolist() == [False, True, False, False, True, False]
        return np.array(seen)

    expected = moved()

    order_bodies_as_a_gpu(monkeypatch, 4)
    np.testing.assert_array_equal(expected, moved())


def _set_in_motion(worlds: Worlds, start: np.ndarray) -> None:
    """Reset the worlds, and give their joints the rates ``start`` [body, 3] rad/s."""
    worlds.reset()
    worlds.download()
    worlds.plants.state.joint_qd[:] = start
    worlds.plants.upload()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "strength", "toughness", "rate", "steps", "broken"),
    [
        pytest.param(1, 4e7, 1e3, 6.0, 30, True, id="brittle wood breaks"),
        pytest.param(2, 6e7, 2e5, 6.0, 50, False, id="tough wood keeps a set"),
        pytest.param(3, 3e7, 5e3, 8.0, 50, True, id="wood cracks and breaks"),
    ],
)
def test_a_cane_keeps_a_set_and_breaks_at_the_joint_and_in_the_step_of_a_client(
    seed: int, strength: float, toughness: float, rate: float, steps: int, broken: bool
) -> None:
    """Up to the first blow on the ground, or half a second. The shoot of the first world swings wildly, that of the
    second hangs still."""
    model = weak(seed, 500.0, 500.0)
    cane = model.body_organ == int(Organ.CANE)
    model.body_strength[cane] = strength
    model.body_yield_strength[cane] = 0.6 * strength
    model.body_toughness[cane] = toughness
    physics = Physics(model, parameters=PARAMETERS)
    physics.contact_solver.plant_plant_contacts = False
    physics.add_robot(ROBOT)
    physics.wake(np.arange(1))
    start = np.random.default_rng(seed).normal(0.0, rate, physics.state.joint_qd.shape)
    physics.state.joint_qd[:] = start
    worlds = Worlds(plants_of_worlds([model], 2), 2, robots=[ROBOT], parameters=PARAMETERS, breaks=True)
    assert worlds.pool is not None
    worlds.plants.state.joint_qd[:] = np.concatenate([start, np.zeros_like(start)])
    worlds.plants.upload()
    parted = 0
    for _ in range(steps):
        physics.step()
        worlds.step()
        parted += len(physics.detachments)
        physics.update_kinematics()
        worlds.download()
        bodies = len(model.body_mass)
        np.testing.assert_array_equal(worlds.plants._parent[:bodies], physics.plants._parent)
        np.testing.assert_allclose(worlds.plants.state.body_q[:bodies, :3], physics.state.body_q[:, :3], atol=1e-4)
    assert (parted > 0) == broken
    assert physics.state.joint_flow.max() > 0.01 or broken
    assert not worlds.faults.numpy().any()
