"""A rod of 16 bodies against beam theory: elastica, taper, two woods, frequencies, damping, buckling.

Theory is computed in ``tests/support/beam_theory.py``; ``make validation`` plots these comparisons.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import jv

from tests.support import beam_theory
from tests.support.beam_theory import Beam
from vinesim.core import frames
from vinesim.scene.builder import RodMaterial, TreeBuilder

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("alpha", [0.1, 1.0, 5.0, 20.0])
def test_the_elastica_agrees_with_its_elliptic_integrals(alpha: float) -> None:
    """Checks the reference of the tests below by another method: Bisshopp and Drucker 1945."""
    beam = Beam(density=1e-6, tip=1.0)
    beam = dataclasses.replace(beam, modulus=beam_theory.G / alpha / (beam.rigidity / beam.modulus))
    assert beam_theory.elastica(beam) == pytest.approx(beam_theory.elastica_by_integrals(alpha), abs=1e-6)


@pytest.mark.long
def test_elastica_at_any_load() -> None:
    """Tips of 135 canes, alpha 0.05 to 20, by own weight, a bunch, or both, clamped from -57 to 57 degrees: 0.5 %."""
    cases, expected, measured = beam_theory.elastica_sweep()
    error = np.linalg.norm(measured - expected, axis=1)
    angle = np.array([case[2] for case in cases])
    travel = np.linalg.norm(expected - np.stack([np.cos(angle), np.sin(angle)], 1), axis=1)
    worst = int(np.argmax(error / travel))
    assert error[worst] < 0.005 * travel[worst], (
        f"alpha, share, angle {cases[worst]}: {error[worst] / travel[worst]:.4f}"
    )
    assert error.max() < 0.005  # and of the length


def test_elastica_of_random_canes() -> None:
    """Random lengths, radii, densities and loads of forty canes."""
    rng = np.random.default_rng(1)
    drawn = [
        beam_theory.of_load(
            rng.uniform(0.1, 20.0),
            rng.uniform(0.0, 0.95),
            length=rng.uniform(0.2, 2.0),
            angle=rng.uniform(-1.2, 1.0),
            radius=rng.uniform(0.002, 0.02),
            density=rng.uniform(400.0, 1200.0),
        )
        for _ in range(40)
    ]
    expected = np.array([beam_theory.elastica(beam) for beam in drawn])
    measured = beam_theory.resting_tips(drawn)
    straight = np.array([[np.cos(b.angle), np.sin(b.angle)] * np.array(b.length) for b in drawn])
    error = np.linalg.norm(measured - expected, axis=1) / np.linalg.norm(expected - straight, axis=1)
    assert error.max() < 0.005, drawn[int(error.argmax())]


def test_a_tapered_cane() -> None:
    """Radius down to 0.4 of the clamp's, against the elastica with EI(s) and w(s): 0.5 % of the tip's travel."""
    drawn = [
        beam_theory.of_load(alpha, share, taper=taper)
        for alpha in (0.2, 1.0, 2.0)
        for share in (0.0, 0.3)
        for taper in (0.85, 0.6, 0.4)
    ]
    expected = np.array([beam_theory.elastica(beam) for beam in drawn])
    measured = beam_theory.resting_tips(drawn)
    error = np.linalg.norm(measured - expected, axis=1) / np.linalg.norm(expected - [1.0, 0.0], axis=1)
    assert error.max() < 0.005, (drawn[int(error.argmax())], error.max())


@pytest.mark.parametrize("case", beam_theory.CONVERGING)
def test_error_falls_with_the_square_of_the_pieces(case: str) -> None:
    errors = beam_theory.errors_over_pieces()[case]
    assert (np.log2(errors[:-1] / errors[1:]) > 1.8).all(), errors


def test_the_elastica_of_parts_is_that_of_the_whole() -> None:
    """Checks the reference of the test below: a tapered cane divided into three parts."""
    beam = beam_theory.of_load(2.0, 0.3, taper=0.5, angle=0.3)
    thin = [1.0 - 0.5 * s for s in (0.0, 0.3, 0.6, 1.0)]
    parts = [
        dataclasses.replace(beam, length=length, radius=beam.radius * a, taper=b / a)
        for length, a, b in zip((0.3, 0.3, 0.4), thin, thin[1:], strict=False)
    ]
    assert beam_theory.elastica_of_parts(parts) == pytest.approx(beam_theory.elastica(beam), abs=1e-6)


@pytest.mark.parametrize("case", beam_theory.JOINED)
def test_error_falls_with_the_square_of_the_pieces_where_woods_join(case: str) -> None:
    errors = beam_theory.errors_over_pieces_of_joined()[case]
    assert (np.log2(errors[:-1] / errors[1:]) > 1.8).all(), errors


def test_error_falls_with_the_square_of_the_step() -> None:
    """phi 1/2: order 1.8 and more, in frequency by the factor that theory gives the trapezoidal rule."""
    errors = beam_theory.errors_over_dt()
    assert beam_theory.order(beam_theory.STEPS, errors["frequency"]) > 1.8
    assert beam_theory.order(beam_theory.STEPS, errors["tip"]) > 1.8
    np.testing.assert_allclose(errors["frequency"], errors["theory"], rtol=0.25)


def test_first_three_frequencies() -> None:
    """Against Euler and Bernoulli: 1, 3, 5 % (dt small enough that time is not the error)."""
    measured, expected = beam_theory.measured_frequencies()
    np.testing.assert_array_less(abs(measured / expected - 1.0), [0.01, 0.03, 0.05])


def test_measured_damping_is_the_requested_one() -> None:
    """100 Hz, shipping phi, first mode (joint damping beta K gives zeta = beta w / 2), zeta 0 to 0.2: 0.005.

    Below its floor the solver has the damping of the floor, ``ArticulationSolver.damping_floor``.
    """
    measured, frequency, floor = beam_theory.damping_sweep()
    requested = np.maximum(beam_theory.ZETAS, floor)
    np.testing.assert_allclose(measured, requested, atol=0.005)
    below = np.array(beam_theory.ZETAS) < floor
    assert below.sum() >= 2
    np.testing.assert_allclose(measured[below], floor[below], rtol=0.02)
    np.testing.assert_allclose(frequency, 1.0, atol=0.01)


@pytest.mark.parametrize("stiff_first", [True, False])
def test_a_cane_of_two_woods_bends_as_two(stiff_first: bool) -> None:
    """A side load on the tip: P/3E1I (L^3 - l^3) + P l^3 / 3E2I, each joint with its own spring."""
    load = 0.002
    half = 0.5
    tree = beam_theory.two_woods(stiff_first, density=8.0)  # its weight is negligible
    tree.solve_rest_pose()
    for body in tree.bodies:
        body["damping"] = 0.3 * np.asarray(body["stiffness"])
    plants = beam_theory.standing([tree], phi=1.0, dt=0.02)
    plants.body_load[15] = [0.0, load, 0.0, 0.0, 0.0, load / 16]
    before = plants.state.body_q[15].copy()
    beam_theory.run(plants, 1500)
    plants.forward_kinematics()
    tips = [
        frames.compose(pose.astype(float), frames.pose([1 / 16, 0, 0])) for pose in (before, plants.state.body_q[15])
    ]
    second_moment = np.pi * 0.004**4 / 4
    near, far = (5e9, 1e9) if stiff_first else (1e9, 5e9)
    expected = load / (3 * second_moment) * ((1.0 - half**3) / near + half**3 / far)
    assert tips[1][1] - tips[0][1] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("pieces", [2, 8])
def test_a_cane_of_two_thicknesses_twists_as_two(pieces: int) -> None:
    """A small weight beside the tip: W a (l / GJ + l' / G'J'), exact as the moment is constant along the cane."""
    tree = TreeBuilder(frames.pose(np.array([0.0, 0.0, beam_theory.HEIGHT])))
    thick = tree.add_rod(-1, 0.4, (0.005, 0.005), RodMaterial(5e9, 8.0, 0.3), pieces)
    thin = tree.add_rod(thick[-1], 0.6, (0.003, 0.003), RodMaterial(2e9, 8.0, 0.3, shear_modulus=1e9), pieces)
    mass = 0.002
    beside = 0.05
    half = tree.bodies[thin[-1]]["far"]
    tree.add_body(
        thin[-1],
        offset=(0.6 / pieces, 0, 0),
        mass=mass,
        com=(0, beside, 0),
        inertia=[mass * 1e-4] * 3,
        length=1e-3,
        stiffness=half,
        damping=0.3 * half,
    )
    plants = beam_theory.settle([tree])
    side = frames.rotate(plants.state.body_q[-1, 3:].astype(float), np.array([0.0, 1.0, 0.0]))
    polar = np.pi / 2 * np.array([0.005, 0.003]) ** 4
    expected = mass * beam_theory.G * beside * (0.4 / (5e9 / 2.6 * polar[0]) + 0.6 / (1e9 * polar[1]))
    assert -np.arcsin(side[2]) == pytest.approx(expected, rel=0.003)


@pytest.mark.parametrize("beta", [(0.006, 0.0), (0.0, 0.006), (0.003, 0.009)])
def test_each_segment_has_its_own_damping(beta: tuple[float, float]) -> None:
    """Two woods damped differently: the damping ratio is that of the chain's quadratic eigenvalue problem."""
    tree = beam_theory.two_woods(True, beta=beta)
    frequency, zeta = (values[0] for values in beam_theory.chain_modes(tree))
    plants = beam_theory.standing([tree], phi=0.5, dt=0.002)
    swing = beam_theory.run(plants, 2000, watch=np.array([15]))[:, 0, 2]
    measured = beam_theory.fitted_swing(np.arange(2000)[200:] * 0.002, swing[200:], frequency)
    assert measured[0] == pytest.approx(frequency, rel=0.02)
    assert measured[1] == pytest.approx(zeta, rel=0.03)


@pytest.mark.parametrize(("share", "stands"), [(0.95, True), (1.05, False)])
def test_self_buckling_length_is_greenhills(share: float, stands: bool) -> None:
    """A rod of more than the self-buckling length falls over: rho g A L^3 / EI = 9/4 j^2, J_-1/3(j) = 0."""
    critical = 2.25 * brentq(lambda z: jv(-1.0 / 3.0, z), 1.5, 2.2) ** 2
    beam = beam_theory.of_load(critical * share**3, 0.0, angle=np.pi / 2, beta=0.05)
    plants = beam_theory.standing([beam.tree()])
    plants.state.joint_qd[0, 1] = 0.02
    beam_theory.run(plants, 6000)
    plants.forward_kinematics()
    lean = np.hypot(*plants.state.body_q[beam.pieces, :2])
    assert lean < 0.02 if stands else lean > 0.2
