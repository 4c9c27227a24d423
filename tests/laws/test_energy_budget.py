"""Energy budget: what only weight and springs act on gains no energy at any phi; what is pushed keeps its own."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.long_rows import long
from vinesim.core import frames
from vinesim.kernels.plants.energy_budget import CLOSELY, NO_BUDGET, NOW_AND_THEN
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.model import Model
from vinesim.scene.state import State

pytestmark = pytest.mark.slow

G = 9.81


def add_rod(
    tree: TreeBuilder, length: float, radii: tuple[float, float], wood: RodMaterial, pieces: int, tip: float
) -> None:
    """A rod on a tree, with a sphere of ``tip`` kg at its end."""
    last = tree.add_rod(-1, length, radii, wood, pieces)[-1]
    if tip > 0.0:
        far = np.asarray(tree.bodies[last]["far"])
        radius = (tip / 4190.0) ** (1.0 / 3.0)
        tree.add_body(
            last,
            offset=(length / pieces, 0, 0),
            mass=tip,
            inertia=[0.4 * tip * radius**2] * 3,
            length=2.0 * radius,
            com=(radius, 0, 0),
            stiffness=far,
            damping=wood.damping * far,
        )


def random_rods(count: int, seed: int, damping: float = 0.0) -> tuple[Model, np.ndarray]:
    """Rods of so much damping [s], 0.3 to 1.5 m long, 4 to 10 mm thick, 0.3 to 8 GPa, clamped in any direction.

    Six in ten have a mass on the tip, half of them are drawn in equilibrium. Also returns how each joint [body, 3] is
    to be bent and twisted before release.
    """
    rng = np.random.default_rng(seed)
    trees = []
    bends = []
    for i in range(count):
        clamp = rng.normal(size=4)
        tree = TreeBuilder(np.array([3.0 * i, 0.0, 2.0, *(clamp / np.linalg.norm(clamp))]))
        length = rng.uniform(0.3, 1.5)
        radius = rng.uniform(0.002, 0.005)
        modulus = 10.0 ** rng.uniform(8.5, 9.9)
        wood = RodMaterial(modulus, 950.0, damping, shear_modulus=rng.uniform(0.15, 0.75) * modulus)
        tip = rng.uniform(0.1, 3.0) * 950.0 * np.pi * radius**2 * length if rng.random() < 0.6 else 0.0
        add_rod(tree, length, (radius, radius * rng.uniform(0.5, 1.0)), wood, int(rng.integers(4, 17)), tip)
        if rng.random() < 0.5:
            tree.solve_rest_pose()
        axis = rng.normal(size=3) * ([0, 1, 1], [1, 1, 1], [1, 0, 0])[rng.choice(3, p=(0.4, 0.4, 0.2))]
        bodies = len(tree.bodies)
        angle = np.exp(rng.uniform(np.log(0.02), np.log(0.6)))
        trees.append(tree)
        bends.append(np.tile(angle / bodies * axis / np.linalg.norm(axis), (bodies, 1)))
    return assemble(trees), np.concatenate(bends)


def released(model: Model, bends: np.ndarray, phi: float) -> ArticulationSolver:
    """The trees, bent, awake and at rest."""
    plants = ArticulationSolver(model, State.at_rest(model), phi=phi)
    plants.state.joint_q[:] = frames.multiply(plants.state.joint_q.astype(float), frames.exp(bends))
    plants.wake(np.arange(len(model.tree_first)))
    return plants


def energies(plants: ArticulationSolver) -> np.ndarray:
    """Kinetic, elastic and potential energy of each tree together [tree] J, between steps."""
    model = plants.model
    state = plants.state
    plants.forward_kinematics()
    pose = state.body_q.astype(float)
    motion = state.body_qd.astype(float)
    mass = plants.body_mass.astype(float)
    com = frames.rotate(pose[:, 3:], plants.body_com.astype(float))
    velocity = motion[:, :3] + np.cross(motion[:, 3:], com)
    spin = frames.rotate(frames.conjugate(pose[:, 3:]), motion[:, 3:])
    angle = frames.log(state.joint_q.astype(float))
    height = (pose[:, :3] + com - model.tree_pose[model.body_tree, :3])[:, 2]
    each = mass * ((velocity**2).sum(1) / 2.0 + G * height)
    each += ((plants.body_inertia * spin**2).sum(1) + (plants.joint_stiffness * angle**2).sum(1)) / 2.0
    return np.add.reduceat(each, model.tree_first)


def largest_gain(plants: ArticulationSolver, steps: int, every: int = 1) -> np.ndarray:
    """The largest energy of each tree after any step, above its first [tree] J."""
    start = energies(plants)
    gain = np.full(len(start), -np.inf)
    for step in range(steps):
        plants.predict()
        plants.integrate()
        if step % every == 0:
            gain = np.maximum(gain, energies(plants) - start)
    return gain


def releasable(model: Model, bends: np.ndarray, steps: int) -> np.ndarray:
    """Energy that the trees have given off after so many steps with phi = 1 [tree] J, no less than floats resolve."""
    plants = released(model, bends, 1.0)
    start = energies(plants)
    for _ in range(steps):
        plants.predict()
        plants.integrate()
    weight = np.add.reduceat(G * plants.body_mass, model.tree_first)
    return start - energies(plants) + 1e-6 * weight


@pytest.mark.parametrize(
    ("phi", "damping", "seconds"),
    [
        (0.5, 0.0, 5),
        (0.55, 0.006, 5),
        *long((0.55, 0.0, 5), (0.5, 0.0, 20), (0.55, 0.0, 20)),
    ],
)
def test_no_random_rod_gains_energy(phi: float, damping: float, seconds: int) -> None:
    """100 random rods released from 0.02 to 0.6 rad: after no step more than 2 % of what they can give off is added."""
    model, bends = random_rods(100, 1, damping)
    gain = largest_gain(released(model, bends, phi), 100 * seconds, every=seconds // 5) / releasable(model, bends, 500)
    assert gain.max() < 0.02, f"rods {np.argsort(-gain)[:5]}: {np.sort(gain)[:-6:-1]}"


def test_trees_are_watched_as_closely_as_they_need() -> None:
    """A cane with a bunch now and then, one without damping or one that is limp closely, one that is cut never."""
    wood, soft, dry = (RodMaterial(modulus, 900.0, beta) for modulus, beta in ((5e9, 0.006), (5e7, 0.006), (5e9, 0.0)))
    trees = [TreeBuilder(frames.pose(np.array([0.0, i, 2.0]))) for i in range(4)]
    for tree, material in zip(trees, (wood, soft, dry, wood), strict=True):
        tree.add_rod(-1, 1.0, (0.004, 0.004), material, 8)
    model = assemble(trees)
    plants = ArticulationSolver(model, State.at_rest(model))
    plants.wake(np.arange(4))
    plants.predict()
    assert plants.tree_budget.tolist() == [NOW_AND_THEN, CLOSELY, CLOSELY, NOW_AND_THEN]
    plants.cut(int(model.tree_first[3]) + 4)
    plants.predict()
    assert plants.tree_budget.tolist() == [NOW_AND_THEN, CLOSELY, CLOSELY, NO_BUDGET]


def loaded_cane(phi: float, bend: float) -> ArticulationSolver:
    """A level cane of a metre with 100 g on its tip, in equilibrium, then bent aside by so many rad a joint."""
    tree = TreeBuilder(frames.pose(np.array([0.0, 0.0, 2.0])))
    add_rod(tree, 1.0, (0.00435, 0.00435), RodMaterial(5.89e9, 950.0, 0.0, shear_modulus=2.27e9), 16, 0.1)
    tree.solve_rest_pose()
    model = assemble([tree])
    return released(model, np.tile([0.0, 0.0, bend], (len(model.body_mass), 1)), phi)


@pytest.mark.parametrize("bend", [1e-3, 1e-2])
def test_a_loaded_cane_keeps_its_energy_at_phi_half(bend: float) -> None:
    """A mass on the tip, settled, then bent: without a budget energy is tenfold after 5 s, 33-fold after 40 s."""
    plants = loaded_cane(0.5, bend)
    rest = energies(loaded_cane(0.5, 0.0))
    assert largest_gain(plants, 1000) < 0.02 * (energies(loaded_cane(0.5, bend)) - rest)


@pytest.mark.parametrize("how", ["load", "rates", "pose"])
def test_work_from_outside_is_kept(how: str) -> None:
    """A resolved swing that a load, new rates or a new pose have made stronger than it ever was goes on so.

    What is taken for a gain of energy would be taken off within a step. The new pose bends all joints alike, which
    excites modes that phi 0.55 damps.
    """
    plants = loaded_cane(0.55, 1e-3)
    rest = energies(loaded_cane(0.55, 0.0))
    for _ in range(20):
        plants.predict()
        plants.integrate()
    before = energies(plants)
    for _ in range(4 if how == "load" else 0):
        plants.body_load[-1, 1] = 2.0
        plants.predict()
        plants.integrate()
    plants.body_load[:] = 0.0
    if how == "rates":
        plants.state.joint_qd[:, 2] += 0.05
    elif how == "pose":
        turn = np.tile([0.0, 0.0, 0.01], (len(plants.state.joint_q), 1))
        plants.state.joint_q[:] = frames.multiply(plants.state.joint_q.astype(float), frames.exp(turn))
    start = energies(plants)
    assert start - rest > 10.0 * (before - rest)
    for _ in range(16):
        plants.predict()
        plants.integrate()
    assert energies(plants) - rest > 0.7 * (start - rest)
