"""The task expose: a hidden bunch, and a hand that pushes aside what hides it."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("mujoco_warp")
pytest.importorskip("vinesim.learn")
import gymnasium

from tests.learn.arm_control import towards

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("layout")]
HIDING = slice(17, 20)
SHARE = 20
FORCE = 21


@pytest.fixture(scope="module")
def environment(layout: str) -> Any:
    return gymnasium.make_vec("vinesim/Expose-v0", num_envs=4)


def test_bunches_stay_hidden_if_nothing_is_done(environment):
    observation, _ = environment.reset(seed=1)
    assert environment.observation_space.contains(observation)
    assert (observation[:, SHARE] < 0.5).all()
    for _ in range(100):
        observation, reward, terminated, truncated, info = environment.step(np.zeros((4, 7), np.float32))
        assert (info.get("final_obs", observation)[:, SHARE] < 0.5).all()
        assert (reward < 0.0).all()
        assert not terminated.any()
    assert truncated.all()


def test_a_bunch_beside_the_line_of_sight_hides_nothing(environment):
    """The hiding shoot's root is moved by 0.3 m: all nine points are visible, and the task is solved."""
    env = environment.unwrapped
    environment.reset(seed=1)
    pose = env.worlds.plants.launches.resident_arrays["tree_pose"]
    rooted = pose.numpy()
    moved = rooted.copy()
    moved[4 + 1, 1] += 0.3  # tree 1 of world 1
    pose.assign(moved)
    _, reward, terminated, _, info = environment.step(np.zeros((4, 7), np.float32))
    pose.assign(rooted)
    environment.reset(seed=1)
    assert terminated.tolist() == [False, True, False, False]
    assert info["success"].tolist() == [False, True, False, False]
    assert info["final_obs"][:, SHARE].tolist() == [0.0, 1.0, 0.0, 0.0]
    assert reward[1] == pytest.approx(10.0)


def test_a_hand_pushes_the_hiding_bunch_aside_and_holds_it(environment):
    """It goes beside the bunch, then 0.22 m across. At least three of four succeed in 4 s."""
    observation, _ = environment.reset(seed=1)
    side = np.where(observation[:, HIDING][:, 1] < 0.0, 1.0, -1.0)[:, None] * np.array([0.0, 1.0, 0.0])
    pushed = np.full(4, -1)
    succeeded = np.zeros(4, bool)
    for k in range(100):
        beside = observation[:, HIDING] + 0.1 * side
        pushed[(pushed < 0) & (np.linalg.norm(beside, axis=1) < 0.05)] = k
        across = np.clip(0.22 - 0.01 * (k - pushed), 0.0, 0.08)[:, None] * -side
        ways = np.where((pushed < 0)[:, None], beside, across)
        observation, reward, terminated, _, info = environment.step(towards(environment, ways, 6.0))
        assert (reward[info["success"]] > 5.0).all()
        assert (info["success"] <= terminated).all()
        succeeded |= info["success"]
        pushed[terminated] = -1
    assert succeeded.sum() >= 3
