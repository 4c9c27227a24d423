"""Environments of tasks in the shapes that learning libraries want. Each test needs its library."""

import importlib
import importlib.util

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("mujoco_warp")
from vinesim.learn.reach import ReachEnv

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("module", "library", "package"),
    [("stable_baselines", "stable_baselines3", "stable-baselines3"), ("rsl", "rsl_rl", "'vinesim\\[train\\]'")],
)
def test_without_the_library_the_message_says_what_to_install(module: str, library: str, package: str) -> None:
    if importlib.util.find_spec(library) is not None:
        pytest.skip(f"{library} is installed")
    with pytest.raises(ImportError, match=f"pip install {package}"):
        importlib.import_module(f"vinesim.learn.{module}")


@pytest.mark.gpu
def test_stable_baselines3_gets_last_observations_and_time_limits() -> None:
    pytest.importorskip("stable_baselines3")
    from vinesim.learn.stable_baselines import StableBaselinesEnv

    env = StableBaselinesEnv(ReachEnv(2, max_episode_steps=2))
    env.seed(1)
    first = env.reset()
    zero = np.zeros((2, 7), np.float32)
    _, _, ended, infos = env.step(zero)
    assert not ended.any()
    assert all("terminal_observation" not in info for info in infos)
    observation, _, ended, infos = env.step(zero)
    assert ended.all()
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert infos[0]["terminal_observation"].shape == first[0].shape
    assert (infos[0]["terminal_observation"] != observation[0]).any()
    with pytest.raises(ValueError, match="takes numpy"):
        StableBaselinesEnv(ReachEnv(1, arrays="warp"))


@pytest.mark.gpu
def test_rsl_rl_gets_time_outs_and_sets_the_ages_of_episodes() -> None:
    pytest.importorskip("rsl_rl")
    torch = pytest.importorskip("torch")
    from vinesim.learn.rsl import RslEnv

    env = RslEnv(ReachEnv(2, arrays="torch", max_episode_steps=3))
    assert env.get_observations()["policy"].shape == (2, 31)
    env.episode_length_buf = torch.tensor([2, 0], dtype=torch.int32)
    observation, _, ended, extras = env.step(torch.zeros(2, env.num_actions))
    assert ended.tolist() == [True, False]
    assert extras["time_outs"].tolist() == [True, False]
    assert observation["policy"].shape == (2, 31)
    assert env.episode_length_buf.tolist() == [0, 1]


@pytest.mark.gpu
def test_stable_baselines3_takes_one_world_and_learns_in_four() -> None:
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_checker import check_env

    from vinesim.learn.one_world import ReachOne
    from vinesim.learn.stable_baselines import StableBaselinesEnv

    check_env(ReachOne())
    model = PPO("MlpPolicy", StableBaselinesEnv(ReachEnv(4)), n_steps=32, batch_size=32, device="cpu", seed=1)
    before = model.policy.action_net.weight.detach().clone()
    model.learn(2 * 4 * 32)
    change = (model.policy.action_net.weight.detach() - before).abs().max().item()
    assert 0.0 < change < 1.0


@pytest.mark.gpu
def test_skrl_takes_the_environment_itself() -> None:
    pytest.importorskip("skrl")
    torch = pytest.importorskip("torch")
    from skrl.envs.wrappers.torch import wrap_env

    env = wrap_env(ReachEnv(2, max_episode_steps=2), wrapper="gymnasium")
    observation, _ = env.reset()
    assert observation.shape == (2, 31)
    zero = torch.zeros(2, 7, device=env.device)
    assert not env.step(zero)[3].any()
    observation, reward, terminated, truncated, _ = env.step(zero)
    assert truncated.all()
    assert not terminated.any()
    assert (reward < 0.0).all()
    assert torch.isfinite(observation).all()
