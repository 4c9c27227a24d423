"""Time integration: no perpetual motion, no energy from nothing, frequency and damping of stiff canes at 100 Hz."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.support import beam_theory
from tests.support.beam_theory import Beam
from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State

pytestmark = pytest.mark.slow


def twisted_ring(pieces: int, ratio: float, twist: float) -> ArticulationSolver:
    """A straight rod of a metre, bent to a ring, twisted by so many rad and clamped at both ends; weightless, damped.

    ``ratio``: GJ / EI. The far clamp is four springs, evenly around the rod: all directions of the ring are equal.
    """
    tree = TreeBuilder(frames.pose(np.zeros(3)))
    wood = RodMaterial(5e9, 800.0, 0.02, shear_modulus=ratio * 2.5e9)
    last = tree.add_rod(-1, 1.0, (0.004, 0.004), wood, pieces)[-1]
    half = np.asarray(tree.bodies[last]["far"])
    end = tree.add_body(
        last,
        offset=(1.0 / pieces, 0, 0),
        mass=1e-3,
        inertia=[1e-6] * 3,
        length=1e-3,
        stiffness=half,
        damping=0.02 * half,
    )
    model = assemble([tree])
    plants = ArticulationSolver(model, State.at_rest(model), PhysicsParameters(gravity=0.0))
    clamp = 0.1 * np.array([[0.0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    ties = [plants.add_tie(end, point, 2000.0, 1.0) for point in clamp]
    plants.tie_anchor[ties] = frames.rotate(frames.exp(np.array([twist, 0.0, 0.0])), clamp)
    share = np.append((np.arange(pieces) + 0.5) / pieces, 1.0)[:, None]
    bent = frames.exp(2.0 * np.pi * share * np.array([0.0, 1.0, 0.0]))
    world = frames.multiply(bent, frames.exp(twist * share * np.array([1.0, 0.0, 0.0])))
    plants.state.joint_q[0] = world[0]
    plants.state.joint_q[1:] = frames.multiply(frames.conjugate(world[:-1]), world[1:])
    plants.wake(0)
    return plants


@pytest.mark.parametrize("ratio", [0.4, 0.77, 1.5])
def test_a_twisted_ring_comes_to_rest(ratio: float) -> None:
    """A damped ring clamped at both ends stands still, whatever GJ / EI, at the shipped phi.

    Every direction of the ring has the same energy, so the smallest moment that is no gradient of it rolls the ring
    about its clamp for ever: K theta of the joints' rotation vectors does so at 30 to 85 degrees a second.
    """
    plants = twisted_ring(16, ratio, 2.0)
    angle = []
    for _ in range(2):
        for _ in range(500):
            plants.predict()
            plants.integrate()
        plants.forward_kinematics()
        _, y, z = plants.state.body_q[8, :3]
        assert np.hypot(y, z) > 0.25  # still a ring
        angle.append(np.degrees(np.arctan2(y, z)))
    assert plants.tree_rate[0] < 0.01
    assert abs(angle[1] - angle[0]) < 0.1


def swinging_canes(
    lengths: tuple[float, ...], zeta: float, *, substeps: bool = True
) -> tuple[ArticulationSolver, np.ndarray, np.ndarray]:
    """Canes of these lengths [m] released in the shape of their first mode, bent by at most 3 mrad a joint.

    The solver, the first frequency [Hz] of each chain by its eigenvalues, and the tips [tick, cane, 3] m of 1.2 s.
    """
    trees = []
    shapes = []
    frequencies = []
    for side, length in enumerate(lengths):
        beam = Beam(modulus=5.89e9, radius=0.00435, density=950.0, length=length)
        frequency = beam_theory.chain_modes(beam.tree())[0][0]
        tree = dataclasses.replace(beam, beta=zeta / (np.pi * frequency)).tree(side)
        tree.solve_rest_pose()
        trees.append(tree)
        frequencies.append(frequency)
        shapes.append(beam_theory.first_shape(tree))
    plants = beam_theory.standing(trees, substeps=substeps)
    bend = frames.exp(0.003 * np.concatenate(shapes)[:, None] * np.array([0.0, 0.0, 1.0]))
    plants.state.joint_q[:] = frames.multiply(plants.state.joint_q.astype(float), bend)
    swings = beam_theory.run(plants, 120, watch=beam_theory.last_bodies(plants))
    return plants, np.array(frequencies), swings


LENGTHS = (0.95, 0.77, 0.65, 0.58, 0.5, 0.45, 0.42)
"""[m] of canes with a first mode of 3.3 to 17 Hz."""


def first_modes(zeta: float, *, substeps: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of canes of :data:`LENGTHS`: substeps; first frequency [Hz] by the chain's eigenvalues, and as measured; damping
    ratio as measured."""
    plants, expected, swings = swinging_canes(LENGTHS, zeta, substeps=substeps)
    fits = []
    for cane, frequency in enumerate(expected):
        ticks = int(np.clip(3.0 / zeta / frequency, 40, 120))
        swing = swings[:ticks, cane, 1] - plants.model.tree_pose[cane, 1]
        fits.append(beam_theory.fitted_swing(0.01 * np.arange(ticks), swing, frequency))
    measured, damping = np.array(fits).T
    return plants.tree_substeps.copy(), expected, measured, damping


@pytest.mark.parametrize("zeta", [0.03, 0.06, 0.12])
def test_first_mode_and_its_damping_at_the_shipped_step(zeta: float) -> None:
    """100 Hz, shipped phi, 3 to 17 Hz: the first mode within 1 %, its damping ratio within 0.005 of what is asked.

    With one step a tick 16.6 Hz come out 8 % slow, and a damping ratio of 0.12 as 0.10.
    """
    substeps, expected, measured, damping = first_modes(zeta)
    assert expected[0] < 4.0 < 16.0 < expected[-1]
    assert substeps[0] == 1  # what swings below 4 Hz costs what it did
    assert (np.diff(substeps) >= 0).all()
    np.testing.assert_allclose(measured / expected, 1.0, atol=0.01)
    np.testing.assert_allclose(damping, zeta, atol=0.005)


def test_substeps_are_counted_for_the_chains_first_mode() -> None:
    """As few as let the mode turn by 0.3 rad in each, from the model alone; also with a tip mass, which slows it."""
    beams = [
        Beam(modulus=5.89e9, radius=0.00435, density=950.0, length=length, tip=tip)
        for length in (0.3, 0.42, 0.5, 0.58, 0.77, 1.0)
        for tip in (0.0, 0.01, 0.05)
    ]
    trees = [beam.tree(side) for side, beam in enumerate(beams)]
    for tree in trees:
        tree.bodies[-1]["stiffness"] = [1e3] * 3  # the tip's joint is no mode of its own
    plants = beam_theory.standing(trees)
    plants.predict()
    angle = [2.0 * np.pi * beam_theory.chain_modes(tree)[0][0] * plants.dt for tree in trees]
    expected = np.clip(np.ceil(np.array(angle) / 0.3), 1, 4)
    assert plants.tree_substeps.tolist() == expected.tolist()
    assert set(expected) == {1, 2, 3, 4}


def test_substeps_are_counted_again_when_a_tree_changes() -> None:
    """A load on the tip makes a cane slow; a stump of a slow cane is fast."""
    plants, _, _ = swinging_canes((0.45, 0.95), 0.02)
    assert plants.tree_substeps.tolist() == [4, 1]
    plants.set_mass(16, 0.5)
    plants.cut(17 + 8)
    plants.forward_kinematics()
    plants.predict()
    assert plants.tree_substeps[0] == 1
    assert plants.tree_substeps[1] > 1


def test_a_touched_tree_takes_whole_steps() -> None:
    """The velocity that contacts were solved for is the velocity that the step ends with, to single precision."""
    plants, _, _ = swinging_canes((0.45,), 0.05)
    assert plants.tree_substeps[0] > 1
    body = np.array([12])
    wrench = np.array([[0.02, 0.1, -0.05, 0.0, 0.001, 0.0]])
    plants.predict()
    predicted = plants.velocity_free[12] + plants.impulse_response(body)[0, :, 0] @ (plants.dt * wrench[0])
    before = plants.state.joint_q.copy()
    plants.integrate(body, wrench)
    plants.state.joint_q[:] = before
    plants.forward_kinematics()
    np.testing.assert_allclose(plants.state.body_qd[12], predicted, atol=1e-5)


def test_a_cut_cane_in_substeps_falls_with_its_momentum() -> None:
    """A stiff cane cut in its middle while it swings: its linear momentum grows by its weight, and by nothing else."""
    plants, _, _ = swinging_canes((0.45, 0.95), 0.02)
    plants.cut(6)
    falls = np.arange(6, 17)
    mass = plants.model.body_mass[falls].astype(float)

    def momentum() -> np.ndarray:
        plants.forward_kinematics()
        pose, speed = (x[falls].astype(float) for x in (plants.state.body_q, plants.state.body_qd))
        arm = frames.rotate(pose[:, 3:], plants.model.body_com[falls].astype(float))
        return mass @ (speed[:, :3] + np.cross(speed[:, 3:], arm))

    before = momentum()
    for _ in range(20):
        plants.predict()
        plants.integrate()
    assert plants.tree_substeps[0] > 1
    weight = np.array([0.0, 0.0, -9.81 * mass.sum()])
    np.testing.assert_allclose(momentum(), before + 20 * plants.dt * weight, atol=1e-4 * np.linalg.norm(0.2 * weight))


def test_a_tree_that_fails_in_a_substep_is_reported() -> None:
    """A stiff cane with a rate that is no number stops, and says so, though its last substep found it at rest."""
    plants, _, _ = swinging_canes((0.45, 0.95), 0.02)
    plants.state.joint_qd[3] = [0.0, np.nan, 0.0]
    plants.predict()
    plants.integrate()
    assert not plants.tree_rate[0] <= plants.fault_rate
    assert plants.tree_rate[1] <= plants.fault_rate
