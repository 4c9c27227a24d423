"""Pictures of the learning tasks: as observations, and by ``render``."""

import pathlib
import re
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("mujoco_warp")
pytest.importorskip("vinesim.learn")
import gymnasium
from gymnasium.utils.env_checker import check_env

from vinesim.learn.task_pictures import FARTHEST
from vinesim.scene.ids import LABEL_STRIDE, Organ

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("layout")]

SIZE = 32


@pytest.fixture(scope="module")
def environment(layout: str) -> Any:
    return gymnasium.make_vec("vinesim/Reach-v0", num_envs=2, observation="pictures", picture_size=SIZE)


@pytest.mark.parametrize("task", ["Reach", "Expose", "Pick"])
def test_observations_are_in_their_space_and_show_the_robot_and_bunches(task: str) -> None:
    env = gymnasium.make_vec(f"vinesim/{task}-v0", num_envs=2, observation="pictures", picture_size=SIZE)
    observation, _ = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    assert observation["rgb"].shape == (2, 2, SIZE, SIZE, 3)
    assert observation["depth"].max() == FARTHEST, "the sky"
    assert 0.1 < observation["depth"][:, 0].min() < 1.0
    organs = observation["labels"] // LABEL_STRIDE
    assert {int(Organ.ROBOT), int(Organ.BUNCH), int(Organ.GROUND)} <= set(np.unique(organs[:, 0]))
    assert (organs[:, 1] == int(Organ.ROBOT)).any(axis=(1, 2)).all(), "the camera of the hand sees the fingers"
    before = {name: values.copy() for name, values in observation.items()}
    assert env.action_space.shape is not None
    observation, *_ = env.step(np.full(env.action_space.shape, 0.5, np.float32))
    assert env.observation_space.contains(observation)
    for name in ("rgb", "depth"):
        assert (observation[name] != before[name]).reshape(4, -1).any(1).all(), "both cameras of both worlds"


def test_pictures_do_not_change_the_episode(environment) -> None:
    plain = gymnasium.make_vec("vinesim/Reach-v0", num_envs=2)
    rng = np.random.default_rng(1)
    seen = environment.reset(seed=4)[0]["state"]
    np.testing.assert_array_equal(seen, plain.reset(seed=4)[0])
    for _ in range(4):
        action = rng.uniform(-1.0, 1.0, (2, 7)).astype(np.float32)
        observation, *_ = environment.step(action)
        np.testing.assert_array_equal(observation["state"], plain.step(action)[0])


def test_the_last_pictures_of_an_episode_are_kept_and_the_next_ones_are_those_of_its_begin() -> None:
    short = gymnasium.make_vec(
        "vinesim/Reach-v0", num_envs=2, observation="pictures", picture_size=SIZE, max_episode_steps=3
    )
    first, _ = short.reset(seed=1)
    first = {name: values.copy() for name, values in first.items()}
    for _ in range(3):
        observation, _, _, truncated, info = short.step(np.ones((2, 7), np.float32))
    assert truncated.all()
    assert info["_final_obs"].all()
    for name in ("rgb", "depth", "labels"):
        np.testing.assert_array_equal(observation[name], first[name])
        assert (info["final_obs"][name] != first[name]).any()


def test_arrays_on_the_device_are_no_copies() -> None:
    """NumPy takes those of a CPU."""
    given: dict[str, Any] = {"num_envs": 2, "observation": "pictures", "picture_size": SIZE, "device": "cpu"}
    env = gymnasium.make_vec("vinesim/Reach-v0", arrays="warp", **given)
    on_host = gymnasium.make_vec("vinesim/Reach-v0", **given)
    observation, _ = env.reset(seed=1)
    expected, _ = on_host.reset(seed=1)
    for name, values in observation.items():
        view = np.from_dlpack(values)
        np.testing.assert_array_equal(view, expected[name])
        assert view.__array_interface__["data"][0] == values.ptr


@pytest.mark.parametrize("options", [{}, {"observation": "pictures", "picture_size": SIZE}], ids=["state", "pictures"])
def test_gymnasium_accepts_the_environment_with_one_world(options: dict[str, Any]) -> None:
    env = gymnasium.make("vinesim/Reach-v0", render_mode="rgb_array", **options)
    check_env(env.unwrapped)
    env.reset(seed=1)
    before = env.render()
    assert isinstance(before, np.ndarray)
    assert before.dtype == np.uint8
    assert before.shape == (256, 256, 3)
    env.step(np.ones(7, np.float32))
    assert (env.render() != before).any()


def test_render_gives_a_picture_of_each_world() -> None:
    env = gymnasium.make_vec("vinesim/Reach-v0", num_envs=2, render_mode="rgb_array")
    env.reset(seed=1)
    pictures = env.render()
    assert isinstance(pictures, tuple)
    assert [picture.shape for picture in pictures] == [(256, 256, 3)] * 2
    assert (pictures[0] != pictures[1]).any(), "the worlds have different vines"
    blind = gymnasium.make_vec("vinesim/Reach-v0", num_envs=2)
    blind.reset(seed=1)
    assert blind.unwrapped.render() is None


def test_the_example_of_the_page_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """The block of docs/worlds.md."""
    page = (pathlib.Path(__file__).parents[2] / "docs" / "worlds.md").read_text()
    (block,) = re.findall(r"<!-- place: tests/learn/test_task_pictures.py -->\n```python\n(.*?)```", page, re.DOTALL)
    exec(block, {})
    assert capsys.readouterr().out.startswith("(2, 2, 128, 128, 3) 0.")


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="observation 'touch': give state or pictures"):
        gymnasium.make_vec("vinesim/Reach-v0", num_envs=1, observation="touch")
    with pytest.raises(ValueError, match="picture_size 4: give 8 to 256 px"):
        gymnasium.make_vec("vinesim/Reach-v0", num_envs=1, observation="pictures", picture_size=4)
    with pytest.raises(ValueError, match="render_mode 'human': give rgb_array, or None"):
        gymnasium.make_vec("vinesim/Reach-v0", num_envs=1, render_mode="human")
