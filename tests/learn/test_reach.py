"""The task reach as a Gymnasium vector environment."""

import importlib.util
import pathlib
import re
import warnings
from typing import Any

import numpy as np
import pytest
import warp as wp

pytest.importorskip("gymnasium")
pytest.importorskip("mujoco_warp")
pytest.importorskip("vinesim.learn")
import gymnasium

from tests.learn.arm_control import towards
from vinesim.learn.reach import ReachEnv
from vinesim.learn.variation import Variation

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("layout")]


@pytest.fixture(scope="module")
def environment(layout: str) -> Any:
    return gymnasium.make_vec("vinesim/Reach-v0", num_envs=3)


def test_spaces_and_counts(environment):
    observation, info = environment.reset(seed=1)
    assert observation.shape == (3, 31)
    assert observation.dtype == np.float32
    assert environment.observation_space.contains(observation)
    assert not info["success"].any()
    wanted = observation[:, -4:]
    np.testing.assert_array_equal(wanted.sum(1), 1.0)
    distances = np.linalg.norm(observation[:, 14:17], axis=1)
    assert ((distances > 0.1) & (distances < 1.0)).all()


def test_equal_seeds_and_actions_give_equal_episodes_to_the_bit(environment):
    def episode() -> list[np.ndarray]:
        rng = np.random.default_rng(3)
        seen = [environment.reset(seed=7)[0]]
        for _ in range(10):
            seen += environment.step(rng.uniform(-1.0, 1.0, (3, 7)).astype(np.float32))[:2]
        return seen

    for one, other in zip(episode(), episode(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_simple_controller_reaches_the_bunches(environment):
    """A world that succeeds begins again at once, with the observation of its last state in ``final_obs``."""
    observation, _ = environment.reset(seed=2)
    reached = 0
    for _ in range(100):
        observation, reward, terminated, truncated, info = environment.step(towards(environment, observation[:, 14:17]))
        for world in np.flatnonzero(info["success"]):
            reached += 1
            assert terminated[world]
            assert reward[world] > 5.0
            assert np.linalg.norm(info["final_obs"][world, 14:17]) < 0.05
            assert np.linalg.norm(observation[world, 14:17]) > 0.1
        assert not truncated.any() or reached
    assert reached >= 3


def test_an_episode_without_success_is_truncated(environment):
    environment.reset(seed=5)
    ends = [environment.step(np.zeros((3, 7), np.float32))[2:4] for _ in range(100)]
    assert not any(terminated.any() for terminated, _ in ends)
    assert [bool(truncated.all()) for _, truncated in ends].index(True) == 99


def test_a_world_that_explodes_ends_with_its_fault_and_the_others_do_not_notice(environment):
    """NaN among the rates of the arm of the second of three worlds."""

    def run(explode: bool) -> list[list[np.ndarray]]:
        environment.reset(seed=11)
        seen = []
        for k in range(6):
            if explode and k == 2:
                qvel = environment.worlds.bodies.data.qvel
                numbers = qvel.numpy()
                numbers[1, 4] = np.nan
                qvel.assign(numbers)
            *results, info = environment.step(np.full((3, 7), 0.3, np.float32))
            seen.append([*results, info["fault"]])
            assert (k == 2 and explode) == ("final_obs" in info)
        return seen

    sound, broken = run(False), run(True)
    for one, other in zip(sound, broken, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a[[0, 2]], b[[0, 2]])
            assert np.isfinite(b).all()
    _, reward, terminated, truncated, fault = broken[2]
    assert fault[1] & 1
    assert reward[1] == -10.0
    assert terminated.tolist() == [False, True, False]
    assert not truncated.any()
    assert not broken[3][4].any(), "the world has begun again"


def test_an_action_before_the_first_reset_is_refused():
    env = gymnasium.make_vec("vinesim/Reach-v0", num_envs=1)
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        env.step(np.zeros((1, 7), np.float32))


def test_arrays_on_the_device_have_the_numbers_of_those_of_numpy_and_are_no_copies():
    """By DLPack, as PyTorch would take them; NumPy takes those of a CPU. The results of an action stay until the action
    after the next one."""
    given: dict[str, Any] = {"num_envs": 2, "device": "cpu"}
    on_host, on_device = (gymnasium.make_vec("vinesim/Reach-v0", arrays=a, **given) for a in ("numpy", "warp"))
    rng = np.random.default_rng(1)
    seen = [env.reset(seed=3)[0] for env in (on_host, on_device)]
    np.testing.assert_array_equal(seen[0], np.from_dlpack(seen[1]))
    kept, copy = [], []
    for _ in range(4):
        action = rng.uniform(-1.0, 1.0, (2, 7)).astype(np.float32)
        *expected, info = on_host.step(action)
        *results, on_device_info = on_device.step(wp.array(action, device="cpu"))
        results += [on_device_info["success"], on_device_info["fault"]]
        expected += [info["success"], info["fault"]]
        views = [np.from_dlpack(array) for array in results]
        for one, other in zip(expected, views, strict=True):
            np.testing.assert_array_equal(one, other)
        assert views[0].__array_interface__["data"][0] == results[0].ptr
        kept.append(views[0])
        copy.append(views[0].copy())
        np.testing.assert_array_equal(kept[-1], copy[-1])
        if len(kept) > 1:
            np.testing.assert_array_equal(kept[-2], copy[-2])
    assert kept[0].__array_interface__["data"] == kept[2].__array_interface__["data"]
    assert (kept[0] != copy[0]).any()
    with pytest.raises(ValueError, match=r"actions of shape \(2, 6\): give \(2, 7\)"):
        on_device.step(wp.zeros((2, 6)))


@pytest.mark.parametrize("task", ["Reach", "Expose", "Pick", "Prune"])
def test_gymnasium_finds_no_fault_in_one_world(task):
    from gymnasium.utils.env_checker import check_env

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the checker advises against observations without bounds
        check_env(gymnasium.make(f"vinesim/{task}-v0").unwrapped, skip_render_check=True)


def test_gymnasiums_wrapper_counts_the_episodes_of_the_worlds():
    wrapper = gymnasium.wrappers.vector.RecordEpisodeStatistics
    env = wrapper(gymnasium.make_vec("vinesim/Reach-v0", num_envs=2, max_episode_steps=3))
    env.reset(seed=1)
    rewards = []
    for k in range(3):
        observation, reward, _, truncated, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert ("episode" in info) == truncated.all() == (k == 2)
        rewards.append(reward)
    assert info["episode"]["l"].tolist() == [3, 3]
    np.testing.assert_allclose(info["episode"]["r"], np.sum(rewards, 0), rtol=1e-5)


def test_the_examples_of_the_page_run():
    """The blocks of docs/worlds.md."""
    page = (pathlib.Path(__file__).parents[2] / "docs" / "worlds.md").read_text()
    blocks = re.findall(r"<!-- place: tests/learn/test_reach.py -->\n```python\n(.*?)```", page, re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        exec(block, {})


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="num_envs 0"):
        gymnasium.make_vec("vinesim/Reach-v0", num_envs=0)
    with pytest.raises(ValueError, match="arrays 'jax': give one of numpy, torch, warp"):
        gymnasium.make_vec("vinesim/Reach-v0", num_envs=1, arrays="jax")
    with pytest.raises(gymnasium.error.NameNotFound, match="Reach"):
        gymnasium.make_vec("vinesim/Rech-v0", num_envs=1)
    with pytest.raises(ValueError, match="shoots tip over"):
        gymnasium.make_vec("vinesim/Reach-v0", num_envs=1, variation=Variation(modulus=(1e7, 1e7)))


@pytest.mark.skipif(importlib.util.find_spec("torch") is not None, reason="PyTorch is installed")
def test_without_pytorch_the_message_says_what_to_install():
    with pytest.raises(ImportError, match="pip install torch"):
        gymnasium.make_vec("vinesim/Reach-v0", num_envs=1, arrays="torch")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (np.array([2]), r"worlds: int64 \[1\]; give bool \[2\], one for each world"),
        (np.ones(3, bool), r"worlds: bool \[3\]; give bool \[2\]"),
        ("all", r"worlds: .* \[\]; give bool \[2\]"),
    ],
)
def test_a_reset_takes_only_a_mask_of_worlds(given: Any, words: str) -> None:
    env = ReachEnv(2)
    with pytest.raises(ValueError, match=words):
        env.worlds.reset(given)


def test_actions_are_limited_and_one_that_is_not_finite_is_a_fault() -> None:
    """An action of 5 moves, costs and observes as one of 1. A NaN ends the episode of its world with -10, and moves
    nothing; the other world goes on as without it, to the bit."""
    wild, tame = ReachEnv(2), ReachEnv(2)
    wild.reset(seed=1)
    tame.reset(seed=1)
    action = np.full((2, 7), 5.0, np.float32)
    for one, other in zip(wild.step(action)[:4], tame.step(np.ones((2, 7), np.float32))[:4], strict=True):
        np.testing.assert_array_equal(one, other)
    action[0, 3] = np.nan
    seen, reward, terminated, _, info = wild.step(action)
    usual, paid, *_ = tame.step(np.ones((2, 7), np.float32))
    assert terminated.tolist() == [True, False]
    assert info["fault"].tolist() == [1, 0]
    assert reward[0] == -10.0
    np.testing.assert_array_equal(seen[1], usual[1])
    assert reward[1] == paid[1]


def test_wrong_arguments_are_one_clear_line() -> None:
    env = ReachEnv(2)
    env.reset(seed=1)
    for actions, words in ((np.zeros(14), r"shape \(14,\): give \(2, 7\)"), (np.zeros((7, 2)), r"give \(2, 7\)")):
        with pytest.raises(ValueError, match=words):
            env.step(actions)
    for options, words in (
        ({"num_envs": 0}, "num_envs 0: give a whole number, at least 1"),
        ({"vines": 0}, "vines 0"),
        ({"max_episode_steps": "x"}, "max_episode_steps 'x'"),
        ({"device": "tpu"}, "device 'tpu': give cpu, cuda or cuda:N"),
        ({"picture_size": 64.5}, "picture_size 64.5: give 8 to 256 px"),
        ({"observation": "sound"}, "observation 'sound': give state or pictures"),
        ({"render_mode": "human"}, "render_mode 'human': give rgb_array, or None"),
    ):
        with pytest.raises(ValueError, match=words):
            ReachEnv(**options)
