"""Policies in files, and their arithmetic."""

import pathlib

import numpy as np
import pytest

pytest.importorskip("gymnasium")
from vinesim.learn import TASKS
from vinesim.learn.policy import ACTIVATIONS, Policy, PolicyError, load_policy


def by_hand(activation: str = "relu") -> Policy:
    """One hidden layer of two: the sum, and the difference of the two components."""
    return Policy(
        "reach",
        np.array([1.0, 2.0], np.float32),
        np.array([2.0, 4.0], np.float32),
        (np.array([[1.0, 1.0], [1.0, -1.0]], np.float32), np.array([[0.5, 0.25]], np.float32)),
        (np.array([0.0, 0.1], np.float32), np.array([-0.2], np.float32)),
        activation,
    )


@pytest.mark.parametrize(
    ("observation", "action"),
    [
        ([1.0, 2.0], 0.25 * 0.1 - 0.2),
        ([2.0, 2.0], 0.5 * 0.5 + 0.25 * 0.6 - 0.2),
        ([1.0, 4.0], 0.5 * 0.5 - 0.2),  # the second unit is below 0
        ([9.0, 2.0], 1.0),  # clipped
    ],
)
def test_actions_are_those_computed_by_hand(observation: list[float], action: float) -> None:
    policy = by_hand()
    np.testing.assert_allclose(policy(np.array(observation, np.float32)), [action], atol=1e-6)
    np.testing.assert_allclose(policy(np.array([observation] * 3, np.float32)), [[action]] * 3, atol=1e-6)


def test_a_file_gives_the_same_policy(tmp_path: pathlib.Path) -> None:
    policy = by_hand("elu")
    policy.save(tmp_path / "policy.npz")
    loaded = load_policy(tmp_path / "policy.npz")
    observations = np.random.default_rng(1).normal(size=(20, 2)).astype(np.float32)
    np.testing.assert_array_equal(loaded(observations), policy(observations))
    assert (loaded.task, loaded.activation, loaded.inputs, loaded.outputs) == ("reach", "elu", 2, 1)


@pytest.mark.gpu
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_actions_are_those_of_pytorch(activation: str) -> None:
    torch = pytest.importorskip("torch")
    functions = {"elu": torch.nn.ELU, "relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}
    torch.manual_seed(1)
    net = torch.nn.Sequential(
        torch.nn.Linear(31, 64), functions[activation](), torch.nn.Linear(64, 64), functions[activation](),
        torch.nn.Linear(64, 7),
    )  # fmt: skip
    linear = [layer for layer in net if isinstance(layer, torch.nn.Linear)]
    rng = np.random.default_rng(1)
    mean, deviation = rng.normal(size=31).astype(np.float32), rng.uniform(0.5, 2.0, 31).astype(np.float32)
    policy = Policy(
        "reach",
        mean,
        deviation,
        tuple(layer.weight.detach().numpy() for layer in linear),
        tuple(layer.bias.detach().numpy() for layer in linear),
        activation,
    )
    observations = 0.5 * rng.normal(size=(50, 31)).astype(np.float32)
    expected = net((torch.from_numpy(observations) - torch.from_numpy(mean)) / torch.from_numpy(deviation))
    assert expected.abs().max() < 1.0, "nothing is clipped"
    np.testing.assert_allclose(policy(observations), expected.detach().numpy(), atol=1e-5)


def test_a_file_that_is_no_policy_is_refused_in_one_line(tmp_path: pathlib.Path) -> None:
    text, other, single, cut = (tmp_path / name for name in ("a.npz", "b.npz", "c.npz", "d.npz"))
    text.write_text("weights")
    np.savez(other, mean=np.zeros(3))
    np.save(single.open("wb"), np.zeros(3))
    by_hand().save(cut)
    cut.write_bytes(cut.read_bytes()[:-100])
    for path, message in (
        (tmp_path / "none.npz", "no file .*none.npz.*give a path or one of: expose, pick, prune, reach"),
        (tmp_path, "is a folder; give the policy.npz"),
        (text, "a.npz is no policy"),
        (other, "b.npz is no policy of this version"),
        (single, "c.npz is no policy"),
        (cut, "d.npz is no policy"),
    ):
        with pytest.raises(PolicyError, match=message) as refused:
            load_policy(path)
        assert "\n" not in str(refused.value)


def test_observations_of_another_task_or_with_pictures_are_refused() -> None:
    policy = load_policy("reach")
    with pytest.raises(ValueError, match=r"\(1, 34\): the policy for reach takes \[\.\.\., 31\]"):
        policy(np.zeros((1, 34)))
    with pytest.raises(ValueError, match=r"observation\['state'\]"):
        policy({"state": np.zeros(31)})  # pyright: ignore[reportArgumentType]
    assert repr(policy) == "Policy('reach', 31 -> 256 -> 128 -> 64 -> 7, 'elu')"


def test_code_in_a_file_does_not_run(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "policy.npz"
    np.savez(path, format=np.array([{"a": 1}], object))
    with pytest.raises(PolicyError, match="is no policy"):
        load_policy(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weight_0": None}, "no field weight_0|arrays of weights"),
        ({"bias_1": None}, "no field bias_1"),
        ({"weight_1": np.zeros((1, 3), np.float32)}, r"layer 1: weights \(1, 3\) and biases \(1,\) after 2 numbers"),
        ({"bias_0": np.zeros(3, np.float32)}, "layer 0"),
        ({"deviation": np.zeros(2, np.float32)}, "a deviation is not above 0"),
        ({"deviation": np.ones(3, np.float32)}, r"mean \(2,\), deviation \(3,\)"),
        ({"mean": np.array([0.0, np.nan], np.float32)}, "not finite"),
        ({"mean": np.array(["a", "b"])}, "not finite"),
        ({"activation": "sine"}, "activation 'sine': give one of elu, relu, tanh"),
    ],
)
def test_a_damaged_file_is_refused_with_what_is_wrong(
    tmp_path: pathlib.Path, changes: dict[str, object], message: str
) -> None:
    path = tmp_path / "policy.npz"
    by_hand().save(path)
    with np.load(path) as file:
        fields = {name: file[name] for name in file.files} | changes
    np.savez(path, **{name: value for name, value in fields.items() if value is not None})
    with pytest.raises(PolicyError, match=message):
        load_policy(path)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_the_policies_that_ship_do_their_tasks_on_vines_never_seen(task: str) -> None:
    """docs/worlds.md has the shares of 500."""
    pytest.importorskip("mujoco_warp")
    from vinesim.learn.evaluate import evaluate, evaluate_with_full_physics

    policy = load_policy(task)
    assert policy.task == task
    in_batch = evaluate(policy, 40, seed=7)
    assert in_batch.successes >= 36
    assert in_batch.faults == 0
    assert evaluate_with_full_physics(policy, 5, seed=7).successes >= 4
