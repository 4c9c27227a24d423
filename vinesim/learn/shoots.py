"""The plants of the learning tasks: a few shoots with one bunch each, drawn at random."""

from __future__ import annotations

import numpy as np

from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.learn.variation import Variation
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State

PIECES = 8
"""Number of bodies of a shoot's wood."""
SPACING = 0.22
"""[m] Mean distance between shoots."""
DENSITY = 900.0
"""[kg/m^3] Density of shoots and peduncles. GUESSED."""
HEIGHT = 0.95
"""[m] Mean height at which shoots grow from their arm."""

DRAWS = 50
"""Number of draws after which no stable shoot is expected any more."""
PUSH = 0.02
"""[rad/s] Rates of all joints, about each axis, with which a shoot must not tip over."""
SETTLING = 3.0
"""[s] Time in which a shoot that tips over goes away."""
DRIFT = 0.02
"""[m] A shoot tips over if its bunch moves farther than this within :data:`SETTLING`."""


def shoots(count: int, rng: np.random.Generator, distance: float, variation: Variation = Variation()) -> Model:
    """Returns ``count`` shoots that hang towards an arm at the origin, from a row at x = ``distance`` [m].

    ``variation``: ranges of their numbers. Places and directions are GUESSED. A shoot that would tip over under its
    bunch is drawn again. Raises :class:`ValueError` if nearly all shoots in the ranges would.
    """
    side = SPACING * (np.arange(count) - 0.5 * (count - 1))
    trees = [_shoot(rng, distance, float(y), variation) for y in side]
    for _ in range(DRAWS):
        falls = np.flatnonzero(_falls(assemble(trees)))
        if len(falls) == 0:
            return assemble(trees)
        for i in falls:
            trees[i] = _shoot(rng, distance, float(side[i]), variation)
    raise UsageError(f"shoots tip over under their bunches in {DRAWS} draws: give a higher modulus or lighter bunches")


def _falls(model: Model) -> np.ndarray:
    """Returns for each tree [tree] whether its bunch goes away from where it hangs at rest, after a light push."""
    state = State.at_rest(model)
    plants = ArticulationSolver(model, state, PhysicsParameters(sleep=False))
    plants.wake(np.arange(len(model.tree_first)))
    plants.forward_kinematics()
    before = state.body_q[model.bunch_body, :3].copy()
    state.joint_qd[:] = PUSH
    plants.upload()
    plants.advance(round(SETTLING / plants.dt))
    plants.download()
    plants.forward_kinematics()
    return np.linalg.norm(state.body_q[model.bunch_body, :3] - before, axis=1) > DRIFT


def _shoot(rng: np.random.Generator, distance: float, side: float, variation: Variation) -> TreeBuilder:
    low, high = np.array([-0.03, -0.04, -0.08]), np.array([0.03, 0.04, 0.08])
    tree = TreeBuilder(frames.pose(np.array([distance, side, HEIGHT]) + rng.uniform(low, high)))
    length = rng.uniform(*variation.length)
    radius = 0.5 * rng.uniform(*variation.thickness)
    modulus = rng.uniform(*variation.modulus)
    damping = rng.uniform(*variation.damping)
    towards = np.array([-1.0, rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.5)])
    wood = RodMaterial(modulus, DENSITY, damping, shear_modulus=0.4 * modulus)
    last = tree.add_rod(-1, length, (radius, 0.7 * radius), wood, PIECES, rest=frames.from_x_axis(towards))[-1]
    stalk = rng.uniform(*variation.peduncle)
    down = frames.from_x_axis(np.array([0.3, 0.0, -1.0]))
    material = RodMaterial(1e9, DENSITY, 0.05, shear_modulus=0.4e9)
    last = tree.add_rod(last, stalk, (0.002, 0.002), material, 2, organ=Organ.PEDUNCLE, rest=down)[-1]
    mass = rng.uniform(*variation.bunch_mass)
    extent = 0.17 * (mass / 0.5) ** (1.0 / 3.0)
    spring = np.asarray(tree.bodies[last]["stiffness"])
    width = 0.25 * extent
    bunch = tree.add_body(
        last,
        offset=(0.5 * stalk, 0, 0),
        organ=int(Organ.BUNCH),
        mass=mass,
        com=(0.5 * extent, 0, 0),
        length=extent,
        radius=(width, width),
        inertia=mass * np.array([0.4 * width**2, 0.06 * extent**2, 0.06 * extent**2]),
        stiffness=spring,
        damping=0.02 * spring + 1e-3,
    )
    tree.bunches.append({"body": bunch, "length": extent, "radius": width, "berries": 80, "pull": 60.0, "bend": 2.0})
    tree.solve_rest_pose()
    return tree
