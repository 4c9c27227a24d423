"""The task prune: shears that cut a cane above its second bud."""

from typing import Any

import msgspec
import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("mujoco_warp")
pytest.importorskip("vinesim.learn")
import gymnasium

from tests.learn.arm_control import towards
from vinesim.learn.prune import CANES, INTERNODES, KEPT, TOLERANCE, canes, least_length
from vinesim.learn.variation import Variation
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("layout")]
PLACE = slice(14, 17)
ALONG = slice(17, 20)
APPROACH, ENTER, CUT = range(3)
"""What the controller does."""


@pytest.fixture(scope="module")
def environment(layout: str) -> Any:
    return gymnasium.make_vec("vinesim/Prune-v0", num_envs=2)


def prune(env: Any, seed: int, above: float = 0.0) -> tuple[np.ndarray, list[np.ndarray]]:
    """Let a controller that knows the canes cut in each world, ``above`` [m] the wanted place. Returns the actions
    [world] with which the worlds succeeded, -1: not; and for each world that ended its last reward and observation.

    The hand comes to 7 cm in front of the place, upright, goes on until the cane is between the fingers, and cuts.
    """
    observation, _ = env.reset(seed=seed)
    worlds = len(observation)
    succeeded_at = np.full(worlds, -1)
    running = np.ones(worlds, bool)
    stage = np.full(worlds, APPROACH)
    last: list[np.ndarray] = [np.zeros(0)] * worlds
    ahead = np.tile([1.0, 0.0, 0.0], (worlds, 1))
    for k in range(100):
        way = observation[:, PLACE] + above * observation[:, ALONG]
        ways = way + np.where(stage == APPROACH, -0.07, 0.0)[:, None] * ahead
        action = np.zeros((worlds, 8), np.float32)
        action[:, :7] = towards(env, ways, 8.0, ahead)
        action[:, 7] = stage == CUT
        observation, reward, terminated, _, info = env.step(action)
        seen = info.get("final_obs", observation)
        for world in np.flatnonzero(running & terminated):
            last[world] = np.append(reward[world], seen[world])
            if info["success"][world]:
                succeeded_at[world] = k
        apart = np.linalg.norm(
            seen[:, PLACE] + above * seen[:, ALONG] + (stage == APPROACH)[:, None] * -0.07 * ahead, axis=1
        )
        stage = stage + np.select([stage == APPROACH, stage == ENTER], [apart < 0.01, apart < 0.006], False)
        running &= ~terminated
        if not running.any():
            break
    return succeeded_at, last


def test_nothing_is_cut_and_no_bud_is_pressed_if_nothing_is_done(environment: Any) -> None:
    observation, _ = environment.reset(seed=1)
    assert environment.observation_space.contains(observation)
    for _ in range(100):
        observation, reward, terminated, truncated, info = environment.step(np.zeros((2, 8), np.float32))
        seen = info.get("final_obs", observation)
        assert (seen[:, 23:25] == 0.0).all()
        np.testing.assert_allclose(reward, -np.linalg.norm(seen[:, PLACE], axis=1), rtol=1e-5)
        assert not terminated.any()
    assert truncated.all()


def test_the_observed_place_is_between_the_second_and_the_third_bud(environment: Any) -> None:
    observation, _ = environment.reset(seed=1)
    worlds = environment.unwrapped.worlds
    worlds.download()
    model = worlds.model
    wanted = observation[:, 25:].argmax(1)
    body = model.tree_first[wanted * 2 + np.arange(2)] + KEPT
    poses = worlds.plants.state.body_q[[body, body + 1], :3]
    robot = worlds.bodies.rigid.robot("arm")
    tool = robot.bodies["link_6"]
    data = worlds.bodies.data
    mouth = data.xpos.numpy()[:, tool] + data.xmat.numpy()[:, tool] @ np.array([0.2, 0.0, 0.0])
    np.testing.assert_allclose(mouth + observation[:, PLACE], poses.mean(0), atol=1e-4)
    way = poses[1] - poses[0]
    np.testing.assert_allclose(observation[:, ALONG], way / np.linalg.norm(way, axis=1, keepdims=True), atol=1e-4)


def test_shears_that_know_the_canes_cut_most_of_them_in_24_worlds() -> None:
    env = gymnasium.make_vec("vinesim/Prune-v0", num_envs=24)
    succeeded_at, last = prune(env, seed=1)
    assert (succeeded_at >= 0).sum() >= 20
    for world in np.flatnonzero(succeeded_at >= 0):
        assert last[world][0] > 9.0
        assert np.linalg.norm(last[world][1:][PLACE]) < 0.02
    assert not env.unwrapped.worlds.faults.numpy().any()


def test_a_cut_elsewhere_ends_the_episode_without_success(environment: Any) -> None:
    """The shears cut 3 cm too high."""
    succeeded_at, last = prune(environment, seed=1, above=3.0 * TOLERANCE)
    assert (succeeded_at < 0).all()
    assert all(one[0] < -2.0 for one in last)


def test_a_finger_that_presses_a_bud_costs_its_force(environment: Any) -> None:
    """The hand moves against the second bud from the side."""
    observation, _ = environment.reset(seed=1)
    most = np.zeros(2)
    for _ in range(90):
        bud = (
            observation[:, PLACE] - 0.04 * observation[:, ALONG] + np.array([0.03, 0.07, 0.0]) * (most == 0.0)[:, None]
        )
        action = np.zeros((2, 8), np.float32)
        action[:, :7] = towards(environment, bud, 8.0, np.tile([1.0, 0.0, 0.0], (2, 1)))
        observation, reward, _, _, _ = environment.step(action)
        assert (reward < -0.02 * observation[:, 24]).all()
        most = np.maximum(most, observation[:, 24])
    assert (most > 0.5).any()


def _substeps(model: Model) -> list[int]:
    plants = ArticulationSolver(model, State.at_rest(model), PhysicsParameters(sleep=False))
    plants.wake(np.arange(len(model.tree_first)))
    plants.upload()
    return plants.tree_substeps.tolist()


def test_no_cane_swings_too_fast_for_the_step() -> None:
    """In 200 worlds, with the default variation."""
    for number in range(200):
        model = canes(np.random.default_rng([0, number]), Variation())
        assert (model.tree_core - model.tree_spares == INTERNODES).all()
        assert _substeps(model) == [1] * CANES


@pytest.mark.parametrize(("thickness", "modulus"), [(0.007, 2e9), (0.01, 6e9), (0.013, 1e10)])
def test_canes_have_the_length_of_the_variation_down_to_the_one_that_swings_too_fast(
    thickness: float, modulus: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    least = least_length(thickness, modulus)
    given = Variation(cane=(1.001 * least, 1.001 * least), thickness=(thickness,) * 2, modulus=(modulus,) * 2)
    model = canes(np.random.default_rng(0), given)
    lengths = model.body_length[~model.is_spare()].reshape(CANES, INTERNODES).sum(1)
    np.testing.assert_allclose(lengths, 1.001 * least, rtol=1e-5)
    assert _substeps(model) == [1] * CANES
    shorter = msgspec.structs.replace(given, cane=(0.998 * least, 2.0))
    with pytest.raises(ValueError, match=rf"^cane from .*: below {least:.3f} m, .* swing too fast; give longer.*$"):
        canes(np.random.default_rng(0), shorter)
    monkeypatch.setattr("vinesim.learn.prune.LEAST_LENGTH", 0.0)
    short = canes(np.random.default_rng(0), msgspec.structs.replace(given, cane=(0.998 * least,) * 2))
    assert _substeps(short) == [2] * CANES


def test_equal_seeds_and_actions_give_equal_episodes_to_the_bit(environment: Any) -> None:
    def episode() -> list[np.ndarray]:
        rng = np.random.default_rng(3)
        seen = [environment.reset(seed=7)[0]]
        for _ in range(10):
            seen += environment.step(rng.uniform(-1.0, 1.0, (2, 8)).astype(np.float32))[:2]
        return seen

    for one, other in zip(episode(), episode(), strict=True):
        np.testing.assert_array_equal(one, other)
