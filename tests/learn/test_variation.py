"""Ranges in which the worlds of a task differ."""

import pathlib

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("mujoco_warp")
from vinesim.core.toml_loader import DataError
from vinesim.learn.reach import SHOOTS, ReachEnv
from vinesim.learn.variation import Variation, as_variation


@pytest.mark.slow
def test_worlds_differ_within_the_ranges_of_a_file(tmp_path: pathlib.Path) -> None:
    """An action acts after its world's delay, 2 actions later at least."""
    file = tmp_path / "variation.toml"
    file.write_text("bunch_mass = [1.0, 1.5]\nfriction = [0.5, 0.9]\ndelay = [2, 4]\n")
    env = ReachEnv(8, variation=str(file))
    model = env.worlds.model
    mass = model.body_mass[model.bunch_body].reshape(SHOOTS, 8)
    assert ((mass > 1.0) & (mass < 1.5)).all()
    assert len(np.unique(mass)) == mass.size
    friction = env.worlds.contacts.friction_scale.numpy()
    assert ((friction > 0.5) & (friction < 0.9)).all()
    assert len(np.unique(friction)) == 8
    for _ in range(2):  # an episode does not begin with actions of the one before
        env.reset(seed=1)
        first = env.worlds.bodies.targets.numpy().copy()
        began = np.full(8, -1)
        for k in range(6):
            env.step(np.ones((8, 7), np.float32))
            moved = (env.worlds.bodies.targets.numpy() != first).any(1)
            began[(began < 0) & moved] = k
        assert set(began) == {2, 3, 4}


@pytest.mark.slow
def test_a_bunch_slides_out_of_fingers_with_less_friction() -> None:
    """The same grasp and lift in two worlds, the second with a hundredth of the friction."""
    from tests.physics.test_worlds import HAND, PARAMETERS, bunches, targets
    from vinesim.worlds.worlds import Worlds

    worlds = Worlds(bunches(2), 2, robots=[HAND], parameters=PARAMETERS)
    worlds.contacts.friction_scale.assign(np.array([1.0, 0.01]))
    for tick in range(100):
        worlds.bodies.targets.assign(np.array([targets(tick, 0.1)] * 2, np.float32))
        worlds.step()
    worlds.download()
    height = worlds.plants.state.body_q.reshape(2, -1, 7)[:, -1, 2]
    assert height[0] - height[1] > 0.02


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mass = [1.0, 2.0]", "mass"),
        ("friction = [1.0, 0.5]", "friction from 1.0 to 0.5: give the lower end first"),
        ("modulus = [0.0, 1e9]", "modulus from 0.0: give numbers above 0"),
        ("delay = [0, 99]", "delay from 0 to 99: give 0 to 25 actions"),
        ("delay = [0.5, 1]", "delay"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path: pathlib.Path, text: str, message: str) -> None:
    file = tmp_path / "variation.toml"
    file.write_text(text)
    with pytest.raises(DataError, match=message) as refused:
        as_variation(file)
    assert str(file) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_without_a_file_the_ranges_are_the_defaults() -> None:
    assert as_variation(Variation()).delay == (0, 0)
