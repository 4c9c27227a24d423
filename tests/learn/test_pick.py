"""The task pick: a hand that grasps a stalk, cuts above its fingers and holds the bunch."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("mujoco_warp")
pytest.importorskip("vinesim.learn")
import gymnasium

from tests.learn.arm_control import towards
from vinesim.learn.arm import TOOL, TOOL_LINK

pytestmark = pytest.mark.slow
OPENING = 14
STALK = slice(15, 18)
HANGS = 21
APPROACH, GRASP, SQUEEZE, CUT, HOLD = range(5)
"""What the controller does."""


@pytest.fixture(scope="module")
def environment() -> Any:
    return gymnasium.make_vec("vinesim/Pick-v0", num_envs=2)


def directions(env: Any, observation: np.ndarray) -> np.ndarray:
    """Returns the horizontal unit vectors [world, 3] from the arm's first joint to the stalks."""
    bodies = env.unwrapped.worlds.bodies
    body = bodies.rigid.robot("arm").bodies[TOOL_LINK]
    point = bodies.data.xpos.numpy()[:, body] + bodies.data.xmat.numpy()[:, body] @ np.array(TOOL)
    first = bodies.data.xpos.numpy()[:, bodies.rigid.robot("arm").bodies["link_0"]]
    ahead = (point + observation[:, STALK] - first) * [1.0, 1.0, 0.0]
    return ahead / np.linalg.norm(ahead, axis=1, keepdims=True)


def test_nothing_happens_to_a_bunch_if_nothing_is_done(environment: Any) -> None:
    observation, _ = environment.reset(seed=1)
    assert environment.observation_space.contains(observation)
    assert (observation[:, HANGS] == 1.0).all()
    for _ in range(150):
        observation, reward, terminated, truncated, info = environment.step(np.zeros((2, 9), np.float32))
        seen = info.get("final_obs", observation)
        assert (seen[:, HANGS] == 1.0).all()
        assert (reward < 0.0).all()
        assert not terminated.any()
    assert truncated.all()


def test_the_fingers_open_and_close_with_their_action(environment: Any) -> None:
    environment.reset(seed=1)
    for grip, opening in ((-1.0, 0.06), (1.0, -0.048), (0.0, 0.004)):
        action = np.zeros((2, 9), np.float32)
        action[:, 7] = grip
        for _ in range(20):
            observation = environment.step(action)[0]
        np.testing.assert_allclose(observation[:, OPENING], opening, atol=2e-3)


def pick(env: Any, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Let a controller that knows the stalks pick a bunch in each world. Returns the actions [world] with which the
    bunches came off, and those with which the worlds succeeded; -1: none.

    The hand comes to 5 cm in front of the stalk, goes on until the stalk is between the fingers, closes them for 0.4 s,
    and cuts.
    """
    observation, _ = env.reset(seed=seed)
    worlds = len(observation)
    ahead = directions(env, observation)
    stage = np.full(worlds, APPROACH)
    since = np.zeros(worlds, int)
    cut_at, succeeded_at = np.full((2, worlds), -1)
    running = np.ones(worlds, bool)
    for k in range(150):
        to_stalk = observation[:, STALK]
        ways = to_stalk + np.where(stage == APPROACH, -0.05, 0.01)[:, None] * ahead
        apart = np.linalg.norm(ways, axis=1)
        action = np.zeros((worlds, 9), np.float32)
        action[:, :7] = np.where((stage < SQUEEZE)[:, None], towards(env, ways, 8.0, ahead), 0.0)
        action[:, 7] = np.where(stage < SQUEEZE, -0.5, 1.0)
        action[:, 8] = stage == CUT
        observation, reward, terminated, _, info = env.step(action)
        seen = info.get("final_obs", observation)
        for world in np.flatnonzero(running & (seen[:, HANGS] == 0.0) & (cut_at < 0)):
            cut_at[world] = k
            assert stage[world] == CUT
            assert 1.5 < reward[world] < 2.0, "the reward for the cut, without costs"
        for world in np.flatnonzero(running & info["success"]):
            succeeded_at[world] = k
            assert reward[world] > 9.0
            assert terminated[world]
            assert np.linalg.norm(seen[world, STALK]) < 0.05
            assert observation[world, HANGS] == 1.0, "the next episode begins with a bunch that hangs"
        goes_on = np.select(
            [stage == APPROACH, stage == GRASP, stage == SQUEEZE, stage == CUT],
            [apart < 0.03, apart < 0.012, since >= 10, True],
            False,
        )
        since = np.where(goes_on, 0, since + 1)
        stage = stage + goes_on
        running &= ~terminated
        if not running.any():
            break
    assert not env.unwrapped.worlds.faults.numpy().any()
    return cut_at, succeeded_at


def test_a_hand_that_knows_the_stalks_picks_both_bunches(environment: Any) -> None:
    cut_at, succeeded_at = pick(environment, seed=1)
    assert (cut_at >= 0).all()
    assert (succeeded_at >= cut_at + 4).all()


def test_it_picks_most_bunches_of_twelve_worlds() -> None:
    """The other bunches are out of the reach of a hand that is upright, or their canes are in the blade's mouth."""
    env = gymnasium.make_vec("vinesim/Pick-v0", num_envs=12)
    picked = [int((pick(env, seed)[1] >= 0).sum()) for seed in (1, 2)]
    assert min(picked) >= 9


def test_a_bunch_that_is_cut_but_not_held_is_no_success(environment: Any) -> None:
    """The hand waits open around the stalk and cuts: the bunch falls, and its stalk goes away from the fingers."""
    observation, _ = environment.reset(seed=1)
    ahead = directions(environment, observation)
    over = np.zeros(2, bool)
    for _ in range(110):
        ways = observation[:, STALK] + 0.01 * ahead
        hangs = observation[:, HANGS] == 1.0
        action = np.zeros((2, 9), np.float32)
        action[:, :7] = np.where(hangs[:, None], towards(environment, ways, 8.0, ahead), 0.0)
        action[:, 7] = -0.5
        action[:, 8] = np.linalg.norm(ways, axis=1) < 0.015
        observation, reward, terminated, _, info = environment.step(action)
        assert not info["success"].any()
        for world in np.flatnonzero(terminated & ~over):
            last = info["final_obs"][world]
            assert last[HANGS] == 0.0
            assert np.linalg.norm(last[STALK]) > 0.2
            assert reward[world] < -2.0
            over[world] = True
        if over.all():
            break
    assert over.all()


def test_equal_seeds_and_actions_give_equal_episodes_to_the_bit(environment: Any) -> None:
    def episode() -> list[np.ndarray]:
        rng = np.random.default_rng(3)
        seen = [environment.reset(seed=7)[0]]
        for _ in range(10):
            seen += environment.step(rng.uniform(-1.0, 1.0, (2, 9)).astype(np.float32))[:2]
        return seen

    for one, other in zip(episode(), episode(), strict=True):
        np.testing.assert_array_equal(one, other)
