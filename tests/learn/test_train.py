"""``vinesim train``: files of a training, its end by Ctrl-C, evaluations, and refused options."""

import csv
import importlib.util
import json
import pathlib
import re
import signal
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("mujoco_warp")
from tests.support import programs
from tests.support.waiting import deadline
from vinesim.cli.train import run_evaluation, run_training
from vinesim.core.errors import UsageError
from vinesim.learn.policy import Policy, load_policy
from vinesim.learn.train import Rank

TIMEOUT = deadline(300.0)
"""Limit for a command [s]; reached only by a failure."""
OPTIONS = {"device": "cpu", "seed": 1, "variation": None}


def resting() -> Policy:
    """Does nothing."""
    layer = np.zeros((7, 31), np.float32), np.zeros(7, np.float32)
    return Policy("reach", np.zeros(31, np.float32), np.ones(31, np.float32), layer[:1], layer[1:])


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "vinesim", "train", *map(str, arguments)]


def test_options_that_do_not_fit_are_refused_in_one_line(tmp_path: pathlib.Path) -> None:
    file = tmp_path / "policy.npz"
    resting().save(file)
    training = {"iterations": 1, "minutes": None, **OPTIONS}
    for task, out, full, message in (
        ("reach", None, False, "give --out FOLDER to train, or --evaluate FILE"),
        ("reach", tmp_path / "run", True, "--full-physics without --evaluate"),
        ("swim", tmp_path / "run", False, "no task 'swim'; give one of reach, expose, pick"),
    ):
        with pytest.raises(UsageError, match=message):
            run_training(task, out, 4, full=full, **training)
    for task, out, full, message in (
        ("reach", tmp_path, False, "an evaluation writes no files"),
        ("expose", None, False, "is a policy for reach; run: vinesim train reach --evaluate"),
    ):
        with pytest.raises(UsageError, match=message):
            run_evaluation(task, file, out, 4, full=full, **OPTIONS)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("option", [("--minutes", "0.5"), ("--iterations", "20")])
def test_an_evaluation_refuses_the_options_of_a_training(option: tuple[str, str]) -> None:
    done = programs.run(command("reach", "--evaluate", "reach", *option), timeout=TIMEOUT)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert f"{' '.join(option)} with --evaluate reach: nothing is trained; omit {option[0]}" in done.stderr


@pytest.mark.skipif(importlib.util.find_spec("rsl_rl") is not None, reason="rsl_rl is installed")
def test_without_the_libraries_a_training_says_what_to_install(tmp_path: pathlib.Path) -> None:
    done = programs.run(command("reach", "--out", tmp_path / "run"), timeout=TIMEOUT)
    assert done.returncode == 3
    assert "pip install 'vinesim[train]'" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.parametrize("more", [(), ("--full-physics",)])
def test_an_evaluation_prints_one_line(tmp_path: pathlib.Path, more: tuple[str, ...]) -> None:
    """A policy that rests reaches nothing."""
    file = tmp_path / "policy.npz"
    resting().save(file)
    done = programs.run(command("reach", "--evaluate", file, "--worlds", 2, *more), timeout=TIMEOUT)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "reached 0 of 2 (0.0 %)\n"


@pytest.mark.slow
def test_ctrl_c_ends_an_evaluation_and_says_how_far_it_was() -> None:
    arguments = command("pick", "--evaluate", "pick", "--full-physics", "--worlds", 5000)
    with programs.Popen(arguments, stderr=subprocess.PIPE, stdout=subprocess.PIPE) as evaluation:
        assert evaluation.stderr is not None
        next(line for line in evaluation.stderr if "of 5000" in line)
        evaluation.send_signal(signal.SIGINT)
        assert evaluation.wait(TIMEOUT) == 130
        assert re.search(r"^interrupted  world \d+ of 5000, \d+ picked$", evaluation.stderr.read(), re.MULTILINE)


@pytest.mark.slow
def test_the_example_of_the_page_runs_with_a_policy(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The block of docs/worlds.md. The commands of the page are those of the tests here, with fewer worlds."""
    page = (pathlib.Path(__file__).parents[2] / "docs" / "worlds.md").read_text()
    (block,) = (text for text in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "load_policy" in text)
    (tmp_path / "run").mkdir()
    resting().save(tmp_path / "run" / "policy.npz")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(block, names)
    assert np.shape(names["observation"]) == (2, 31)


@pytest.mark.gpu
@pytest.mark.slow
def test_a_training_writes_its_policy_its_curve_and_a_summary(tmp_path: pathlib.Path) -> None:
    pytest.importorskip("rsl_rl")
    torch = pytest.importorskip("torch")
    from vinesim.learn.train import ACTIONS, Training

    training = Training("reach", 4, seed=3)
    training.save(tmp_path)
    before = load_policy(tmp_path / "policy.npz")
    done = list(training.iterations(4))
    training.save(tmp_path, {"unseen_vines": {"worlds": 1}})
    policy = load_policy(tmp_path / "policy.npz")
    observations = torch.randn(20, 31)
    actor = training._runner.get_inference_policy("cpu")
    with torch.inference_mode():
        expected = actor({"policy": observations}).clamp(-1.0, 1.0).numpy()
    np.testing.assert_allclose(policy(observations.numpy()), expected, atol=1e-5)
    assert np.abs(policy(observations.numpy()) - before(observations.numpy())).max() > 1e-3
    rows = list(csv.DictReader((tmp_path / "curve.csv").open()))
    assert [int(row["iteration"]) for row in rows] == [1, 2, 3, 4]
    assert [int(row["actions"]) for row in rows] == [4 * ACTIONS * i for i in (1, 2, 3, 4)]
    rewards = [float(row["mean_reward"]) for row in rows]
    np.testing.assert_allclose(rewards, [one.mean_reward for one in done], atol=1e-4)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["iterations"] == 4
    assert summary["unseen_vines"] == {"worlds": 1}
    assert "torch" in summary["libraries"]


@pytest.mark.gpu
@pytest.mark.slow
def test_the_noise_of_a_training_of_pick_falls() -> None:
    pytest.importorskip("rsl_rl")
    from vinesim.learn.pick import Pick
    from vinesim.learn.train import LEAST_NOISE, Training

    training = Training("pick", 2, seed=3)
    deviations = training._runner.alg.get_policy().distribution.log_std_param
    np.testing.assert_allclose(deviations.exp().tolist(), Pick.noise, rtol=1e-5)
    for largest, expected in ((0.3, 0.3), (0.5, 0.3), (0.01, LEAST_NOISE)):
        training._limit_noise(largest)
        np.testing.assert_allclose(deviations.exp().tolist(), expected, rtol=1e-5)


@pytest.mark.gpu
@pytest.mark.slow
def test_success_counts_episodes_not_actions() -> None:
    """Two episodes of three actions each end without success; a further one was not ended."""
    pytest.importorskip("rsl_rl")
    torch = pytest.importorskip("torch")
    from vinesim.learn.reach import ReachEnv
    from vinesim.learn.rsl import RslEnv

    env = RslEnv(ReachEnv(2, arrays="torch", max_episode_steps=3))
    rewards = [env.step(torch.zeros(2, 7))[1].sum().item() for _ in range(4)]
    totals = env.take_totals()
    assert (totals.ended, totals.success, totals.fault) == (2, 0, 0)
    assert totals.reward == pytest.approx(sum(rewards), rel=1e-5)
    assert env.take_totals().ended == 0


@pytest.mark.gpu
@pytest.mark.slow
def test_ctrl_c_keeps_what_was_learned(tmp_path: pathlib.Path) -> None:
    pytest.importorskip("rsl_rl")
    arguments = command("reach", "--out", tmp_path, "--worlds", 4, "--iterations", 100000)
    with subprocess.Popen(arguments, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as training:
        assert training.stderr is not None
        assert training.stdout is not None
        for line in training.stderr:
            if "iteration" in line:
                break
        training.send_signal(signal.SIGINT)
        printed = training.stdout.read()
        assert training.wait(TIMEOUT) == 130
    assert "iterations" in printed
    assert load_policy(tmp_path / "policy.npz").task == "reach"
    assert len((tmp_path / "curve.csv").read_text().splitlines()) >= 2
    assert json.loads((tmp_path / "summary.json").read_text())["iterations"] >= 1


def test_a_process_of_torchrun_knows_its_place(monkeypatch):
    assert Rank.of_environment() == Rank(number=0, count=1, gpu=0)
    for name, value in (("RANK", "3"), ("WORLD_SIZE", "4"), ("LOCAL_RANK", "1")):
        monkeypatch.setenv(name, value)
    assert Rank.of_environment() == Rank(number=3, count=4, gpu=1)
