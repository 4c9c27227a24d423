"""Wood that gives: peduncles in tension, bending and twist, at both ends and for seconds of load."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest, weibull_min

from vinesim.core import frames
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.strength import peduncle_strength, weibull
from vinesim.scene.values import Detachment
from vinesim.world import Physics

DOWN = frames.from_x_axis(np.array([0.0, 0.0, -1.0]))


def stalks(pull: np.ndarray, bend: float, *, length: float = 0.08, modulus: float = 1e9) -> Model:
    """Bunches of 0.4 kg that hang straight down on stalks of 4.4 mm from fixed points, with given strengths."""
    trees = []
    for i, strength in enumerate(np.asarray(pull, float).tolist()):
        tree = TreeBuilder(frames.pose(np.array([0.5 * i, 0.0, 2.0]), DOWN))
        green = RodMaterial(modulus, 1000.0, 0.05)
        last = tree.add_rod(-1, length, (0.0022, 0.0022), green, 2, organ=Organ.PEDUNCLE)[-1]
        tree.add_bunch(last, 0.4, seed=i, clusters=False, pull=strength, bend=bend)
        trees.append(tree)
    return assemble(trees)


def load_until_broken(model: Model, dt: float, rate: np.ndarray, seconds: float, **numbers: float) -> list[Detachment]:
    """Load all bunches by a wrench that grows by ``rate`` [6] each second. Returns the breaks, bunch by bunch."""
    physics = Physics(model, parameters=PhysicsParameters(dt=dt, sleep=False, **numbers))
    physics.plants.wake(np.arange(len(model.tree_first)))
    found: dict[int, Detachment] = {}
    for step in range(round(seconds / dt)):
        hanging = physics.state.bunch_attached
        physics.plants.body_load[model.bunch_body] = np.where(hanging[:, None], (step + 1) * dt * rate, 0.0)
        physics.step()
        found |= {one.bunch: one for one in physics.detachments}
        if len(found) == len(model.bunch_body):
            break
    return [found[bunch] for bunch in sorted(found)]


def test_peduncles_that_are_pulled_break_as_the_distribution_says():
    """200 strengths from a Weibull distribution, measured by pulling: Kolmogorov-Smirnov, and equal at all dt."""
    low, high = 30.0, 120.0
    pull, _ = peduncle_strength(np.random.default_rng(5).random(200), low, high)
    forces = []
    for dt in (0.001, 0.005, 0.01):
        broken = load_until_broken(stalks(pull, 1e3), dt, np.array([0.0, 0, -40.0, 0, 0, 0]), 6.0)
        assert len(broken) == 200
        assert {one.cause for one in broken} == {"pull"}
        forces.append([one.force[2] for one in broken])
        assert [one.time for one in broken] == pytest.approx([(f - 0.4 * 9.81) / 40.0 for f in forces[-1]], abs=0.03)
    scale, shape = weibull(low, high)
    assert kstest(forces[2], weibull_min(shape, scale=scale).cdf).pvalue > 0.05
    np.testing.assert_allclose(forces[1], forces[0], rtol=0.02)
    np.testing.assert_allclose(forces[2], forces[0], rtol=0.02)
    # the break comes 30 ms after the strength was passed
    np.testing.assert_allclose(forces[0], pull + 0.03 * 40.0, rtol=0.01)


@pytest.mark.parametrize("dt", [0.001, 0.01])
def test_tension_bending_and_twist_add_up_as_stresses(dt):
    """A stalk that does not bend, with force across, along and a twist: it breaks where von Mises' stress of the beam
    reaches its strength, at the shoot."""
    model = stalks(np.array([60.0]), 0.5, modulus=1e11)
    model.joint_damping[:] = 0.03 * model.joint_stiffness
    across, along, twist = 4.0, 25.0, 0.6
    rate = np.array([across, 0.0, -along, 0.0, 0.0, twist])
    (broken,) = load_until_broken(model, dt, rate, 3.0, detachment_duration=1e-6)
    share = broken.time
    tension = share * along + 9.81 * (model.body_mass.sum())
    used = np.hypot(tension / 60.0 + share * across * 0.08 / 0.5, 0.5 * np.sqrt(3.0) * share * twist / 0.5)
    assert used == pytest.approx(1.0, rel=0.02)
    assert broken.segment == 0
    assert broken.place == pytest.approx(broken.at)
    assert broken.point[2] == pytest.approx(2.0, abs=1e-3)
    assert broken.at < 1e-3


@pytest.mark.parametrize(("rate", "cause", "end"), [
    ([0, 0, -30.0, 0, 0, 0], "pull", None),
    ([6.0, 0, 0, 0, 0, 0], "bend", 0),  # a force at the bunch: the moment is largest at the shoot
    ([0, 0, 0, 0, 0, 0.5], "twist", None),
])  # fmt: skip
def test_the_event_names_cause_and_end(rate, cause, end):
    model = stalks(np.array([60.0]), 0.3, modulus=1e11)
    model.joint_damping[:] = 0.03 * model.joint_stiffness
    (broken,) = load_until_broken(model, 0.01, np.array(rate, float), 4.0)
    assert broken.cause == cause
    if end is not None:
        assert broken.segment == end


def test_a_stalk_that_is_pushed_does_not_break_by_pull():
    broken = load_until_broken(stalks(np.array([20.0]), 1e3), 0.01, np.array([0.0, 0.0, 30.0, 0, 0, 0]), 1.0)
    assert broken == []
