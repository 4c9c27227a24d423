"""Gradients of the differentiable rollout against central differences of the same scheme, and their use."""

from __future__ import annotations

import pathlib
import re
from collections.abc import Callable

import numpy as np
import pytest

from tests.support.long_rows import long
from vinesim.core import frames
from vinesim.plants.rollout import Rollout, Trajectory
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.model import Model

pytestmark = pytest.mark.slow


def forked() -> Model:
    """A cane that forks in space, a bunch on one arm; at the origin, where single precision is finest."""
    wood = RodMaterial(4e9, 800.0, 0.03)
    tree = TreeBuilder(frames.pose(np.zeros(3)))
    stem = tree.add_rod(-1, 0.5, (0.004, 0.0035), wood, 6)
    arm = tree.add_rod(stem[-1], 0.3, (0.003, 0.002), wood, 4, rest=frames.exp(np.array([0.3, 0.0, 0.6])))
    tree.add_rod(stem[2], 0.3, (0.003, 0.002), wood, 4, rest=frames.exp(np.array([0.0, 0.7, -0.5])))
    tree.add_body(
        arm[-1], offset=(0.075, 0.0, 0.0), mass=0.1, com=(0.05, 0.01, 0.0), inertia=(2e-4, 3e-4, 3e-4), length=0.1,
        radius=(0.03, 0.03), stiffness=(0.05, 0.05, 0.05), damping=(0.002, 0.002, 0.002),
    )  # fmt: skip
    return assemble([tree])


def swinging(model: Model) -> np.ndarray:
    """Joint rates [body, 3] that set all of it in motion."""
    return np.random.default_rng(4).normal(size=(len(model.body_mass), 3)) * 0.5 + [0.0, 0.7, 0.7]


def squares(track: Trajectory) -> tuple[float, np.ndarray, np.ndarray]:
    """A loss of poses and velocities of unlike weights, and its derivatives by both."""
    weight_q = np.array([3.0, 1.0, 2.0, 0.3, 0.2, 0.1, 0.0])
    weight_qd = np.array([0.1, 0.2, 0.05, 0.01, 0.0, 0.02])
    q = track.body_q.astype(float)
    qd = track.body_qd.astype(float)
    loss = 0.5 * (weight_q * q * q).sum() + 0.5 * (weight_qd * qd * qd).sum()
    return loss, weight_q * q, weight_qd * qd


def slope(loss: Callable[[float], float], reach: float = 0.06) -> float:
    """d loss(1 + e) / de at 0: the odd part of the loss over eight steps up to ``reach``, fitted by e and its cube.

    A single central difference would be dominated by single precision rounding.
    """
    e = np.linspace(reach / 3.0, reach, 8)
    odd = np.array([0.5 * (loss(1.0 + x) - loss(1.0 - x)) for x in e])
    return float(np.linalg.lstsq(np.stack([e, e**3], 1), odd, rcond=None)[0][0])


@pytest.mark.parametrize(("ticks", "checkpoint"), [(50, 33), *long((200, 50), (200, 33))])
def test_gradient_is_the_slope_of_the_loss(ticks: int, checkpoint: int) -> None:
    """Within 1e-3 in every parameter: all together, and the springs, dampers and masses of single bodies."""
    model = forked()
    rates = swinging(model)
    rollout = Rollout(model, ticks, watched=np.array([9, 13, 14]), checkpoint=checkpoint, fast_rate=1e9)
    _, *by = squares(rollout.run(joint_qd=rates))
    gradient = rollout.gradient(*by)
    all_bodies = np.arange(len(model.body_mass))
    cases = [
        ("stiffness", model.joint_stiffness, all_bodies),
        ("stiffness", model.joint_stiffness, [0]),
        ("damping", model.joint_damping, all_bodies),
        ("damping", model.joint_damping, [3]),
        ("mass", model.body_mass, all_bodies),
        ("mass", model.body_mass, [14]),
        ("joint_qd", rates, all_bodies),
    ]
    for name, value, bodies in cases:

        def loss(scale: float, name: str = name, value: np.ndarray = value, bodies: object = bodies) -> float:
            scaled = value.astype(float)
            scaled[bodies] *= scale
            return squares(rollout.run(**({"joint_qd": rates} | {name: scaled})))[0]

        found = float((getattr(gradient, name) * value)[bodies].sum())
        assert found == pytest.approx(slope(loss), rel=1e-3), (name, bodies)
    # scaling stiffness, damping and mass by one factor does not change the motion
    terms = [(getattr(gradient, name) * value).sum() for name, value, _ in cases[:6:2]]
    assert sum(terms) == pytest.approx(0.0, abs=1e-4 * max(map(abs, terms)))


@pytest.mark.long
def test_gradient_by_initial_pose_load_and_fast_motion() -> None:
    """phi = 1 while a joint turns fast is the same in the adjoint; a turn of the first pose; a steady wrench."""
    model = forked()
    rates = 3.0 * swinging(model)
    rollout = Rollout(model, 15, watched=np.array([13, 14]), fast_rate=1.0)
    load = np.zeros((len(model.body_mass), 6))
    load[[5, 12]] = [0.1, 0.2, -0.1, 0.01, 0.02, 0.0]
    turn = 0.1 * np.random.default_rng(1).normal(size=(len(model.body_mass), 3))

    def run(*, load: np.ndarray = load, angle: float = 0.0, **values: np.ndarray) -> Trajectory:
        joint_q = frames.multiply(frames.exp(angle * turn), model.joint_settled)
        return rollout.run(joint_qd=rates, joint_q=joint_q, load=load, **values)

    track = run()
    assert (track.phi == 1.0).all()
    gradient = rollout.gradient(*squares(track)[1:])
    assert float((gradient.load * load).sum()) == pytest.approx(
        slope(lambda s: squares(run(load=s * load))[0], 0.2), rel=1e-3
    )
    assert float((gradient.rotation * turn).sum()) == pytest.approx(
        slope(lambda s: squares(run(angle=s - 1.0))[0], 0.2), rel=1e-3
    )
    stiffness = model.joint_stiffness
    assert float((gradient.stiffness * stiffness).sum()) == pytest.approx(
        slope(lambda s: squares(run(stiffness=s * stiffness))[0]), rel=1e-3
    )


def test_damping_below_that_of_the_scheme_has_no_gradient() -> None:
    model = forked()
    rollout = Rollout(model, 30, watched=np.array([14]))
    _, *by = squares(rollout.run(damping=0.0005 * model.joint_stiffness, joint_qd=swinging(model)))
    assert not rollout.gradient(*by).damping.any()


def test_stiffness_and_damping_of_a_cane_from_a_noisy_track() -> None:
    """The example in the docs finds EI within 1 % and beta within 2 % from one release seen with 1 mm of noise."""
    text = (pathlib.Path(__file__).parents[2] / "docs/gradients.md").read_text()
    example: dict = {}
    exec(re.search(r"```python\n(.*?)```", text, re.S).group(1), example)
    assert example["scale"] == pytest.approx(0.8, rel=0.01)
    assert example["beta"] == pytest.approx(0.03, rel=0.02)
    assert example["found"].fun == pytest.approx(0.5, rel=0.1)  # the residual is the noise
    assert example["found"].nfev <= 30


def test_one_descent_ends_in_a_wrong_minimum_and_the_remedies_in_the_docs_do_not() -> None:
    """A modulus five times too high on a track of three cycles: a growing horizon and several starts find the truth."""
    text = (pathlib.Path(__file__).parents[2] / "docs/gradients.md").read_text()
    example: dict = {}
    exec(re.findall(r"```python\n(.*?)```", text, re.S)[1], example)
    modulus, loss = example["plain"]
    assert modulus > 8.0
    assert loss > 100.0
    for found in (example["grown"], example["best"]):
        assert found[0] == pytest.approx(4.0, rel=0.005)
        assert found[1] == pytest.approx(0.5, rel=0.1)  # the residual is the noise
