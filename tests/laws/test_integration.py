"""Time integration: no perpetual motion, no energy from nothing, frequency and damping of stiff canes at 100 Hz."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim import frames
from vinesim.physics.parameters import PhysicsParameters
from vinesim.physics.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.state import State


def twisted_ring(pieces: int, ratio: float, twist: float) -> ArticulationSolver:
    """A straight rod of a metre, bent to a ring, twisted by so many rad and clamped at both ends; weightless, damped.

    ``ratio``: GJ / EI. The far clamp is four springs, evenly around the rod, so that no direction of the ring is preferred.
    """
    tree = TreeBuilder(frames.pose(np.zeros(3)))
    wood = RodMaterial(5e9, 800.0, 0.02, shear_modulus=ratio * 2.5e9)
    last = tree.add_rod(-1, 1.0, (0.004, 0.004), wood, pieces)[-1]
    half = np.asarray(tree.bodies[last]["far"])
    end = tree.add_body(
        last, offset=(1.0 / pieces, 0, 0), mass=1e-3, inertia=[1e-6] * 3, length=1e-3, stiffness=half,
        damping=0.02 * half,
    )  # fmt: skip
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

    Every direction of the ring has the same energy, so the smallest moment that is no gradient of it rolls the ring about
    its clamp for ever: K theta of the joints' rotation vectors does so at 30 to 85 degrees a second.
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
