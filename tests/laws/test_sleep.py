"""Sleep is invisible: what sleeps is where it would have come to rest, and bears what it bore."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from tests.support.contact_scenes import cane
from tests.support.long_rows import each_once, long
from vinesim.core import frames
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spec import load_scene
from vinesim.world import Physics

pytestmark = pytest.mark.slow

WOOD = 8e9, 700.0


def rod(
    at, beta: float = 0.01, radius: float = 0.01, bodies: int = 20, tip_mass: float = 0.0, heading: float = 0.0
) -> TreeBuilder:
    """A straight, level cane of 1 m, which is not in equilibrium; ``tip_mass`` [kg] is in its tip."""
    tree = TreeBuilder(frames.pose(np.array(at, float), frames.from_yaw(heading)))
    tree.add_rod(-1, 1.0, (radius, radius), RodMaterial(*WOOD, beta), bodies)
    if tip_mass:
        tree.bodies[-1] |= {"mass": tree.bodies[-1]["mass"] + tip_mass, "com": (1.0 / bodies, 0.0, 0.0)}
    return tree


def settled(at, **options) -> TreeBuilder:
    tree = rod(at, **options)
    tree.solve_rest_pose()
    return tree


def asleep(physics: Physics, limit: float) -> float:
    """Step until every tree sleeps; the time [s] that took."""
    while len(physics.plants.awake):
        physics.step()
        assert physics.time < limit
    return physics.time


@pytest.mark.parametrize(("beta", "tip_mass", "bodies"), each_once([0.005, 0.05, 1.0], [0.0, 0.5], [8, 64]))
def test_a_released_cane_sleeps_where_it_would_come_to_rest(beta: float, tip_mass: float, bodies: int) -> None:
    if beta == 0.005 and tip_mass:
        beta = 0.01  # swings for half as long
    physics = Physics(assemble([rod((0.0, 0.0, 2.0), beta, 0.008, bodies, tip_mass)]))
    reference = Physics(
        assemble([rod((0.0, 0.0, 2.0), 0.2, 0.008, bodies, tip_mass)]), parameters=PhysicsParameters(sleep=False)
    )
    drawn = physics.snapshot().body_q[:, :3].copy()
    physics.wake(np.array([0]))
    reference.wake(np.array([0]))
    asleep(physics, 40.0)
    for _ in range(600):
        reference.step()
    rest = reference.snapshot().body_q[:, :3]
    travel = np.linalg.norm(rest - drawn, axis=1).max()
    assert travel > 5e-3
    error = np.linalg.norm(physics.snapshot().body_q[:, :3] - rest, axis=1).max()
    assert error < min(1e-4, 1e-3 * travel)


def test_a_cane_sleeps_no_sooner_than_it_is_slow() -> None:
    """Its tip is followed to the last step, and what the last one moves it is below what anyone sees."""
    physics = Physics(assemble([rod((0.0, 0.0, 2.0), 0.05, 0.008, 64, 0.5)]))
    physics.wake(np.array([0]))
    tips = []
    while len(physics.plants.awake):
        physics.step()
        physics.update_kinematics()
        tips.append(physics.state.body_q[-1, :3].copy())
        assert physics.time < 40.0
    steps = np.linalg.norm(np.diff(tips, axis=0), axis=1)
    assert steps[:50].max() > 1e-3
    assert steps[-2] < 3e-5
    assert steps[-1] < 2.3e-4


def test_a_crate_that_rests_on_two_canes_is_borne_in_every_step() -> None:
    canes = [settled((0.0, side, 1.0)) for side in (-0.1, 0.1)]
    model = assemble(canes, box_pose=[[0.5, 0, 1.0105, 0, 0, 0, 1]], box_size=[[0.1, 0.3, 0.1]], box_mass=[0.5])
    physics = Physics(model)
    borne = []
    for _ in range(800):
        physics.step()
        borne.append(sum(contact.force[2] for contact in physics.contacts))
    np.testing.assert_allclose(borne[300:], 0.5 * 9.81, rtol=1e-3)


def test_a_bunch_that_was_picked_and_lies_on_canes_is_borne_in_every_step() -> None:
    """The law of the crate for a free bunch: it never sleeps while plants bear it, so neither do these."""
    canes = [settled((0.0, side, 1.0), radius=0.012) for side in (-0.035, 0.035)]
    physics = Physics(assemble([cane((0.0, 3.0, 2.0), bunch=0.4), *canes]))
    physics.pick(0)
    physics.rigid.place_bunch(0, frames.pose(np.array([0.5, 0.0, 1.05])), np.zeros(6))
    borne = []
    for _ in range(900):
        physics.step()
        borne.append(sum(contact.force[2] for contact in physics.contacts if contact.actor == "bunch/0"))
    np.testing.assert_allclose(borne[600:], 0.4 * 9.81, rtol=1e-3)


def drag(physics: Physics, body: int, way: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pull a body along ``way`` [3] m within a second: positions [step, body, 3], the force [step, 3] of the pull, and
    how many trees were awake [step]."""
    plants = physics.plants
    stiffness = 2000.0
    physics.wake(physics.model.body_tree[[body]])
    tie = plants.add_tie(body, np.zeros(3), stiffness, 20.0)
    start = plants.tie_anchor[tie].copy()
    positions = []
    forces = []
    awake = []
    for step in range(steps):
        plants.tie_anchor[tie] = start + min(0.01 * step, 1.0) * way
        physics.step()
        physics.update_kinematics()
        positions.append(physics.state.body_q[:, :3].astype(float))
        forces.append(stiffness * (plants.tie_anchor[tie] - positions[-1][body]))
        awake.append(len(plants.awake))
    return np.array(positions), np.array(forces), np.array(awake)


def row_of_canes() -> Model:
    return assemble([cane((0.0, 0.06 * i, 2.0), radius=0.005) for i in range(8)])


def small_tendone() -> Model:
    scene = load_scene("tendone")
    layout = msgspec.structs.replace(scene.layout, rows=2, vines=2)
    model = generate(msgspec.structs.replace(scene, layout=layout, boxes=(), spawns=()))
    # wood that keeps a set would magnify the last bits by which the two runs differ
    return dataclasses.replace(model, body_strength=np.zeros_like(model.body_strength))


@pytest.mark.parametrize(
    ("scene", "tree", "depth", "way"),
    [(row_of_canes, 0, 12, (0.0, 0.25, 0.0)), (small_tendone, 77, 5, (0.2, 0.2, -0.028))],
)
def test_a_cane_dragged_through_sleeping_ones_moves_them_as_if_they_were_awake(
    scene: Callable[[], Model], tree: int, depth: int, way: tuple[float, float, float]
) -> None:
    """Drags so gentle that two runs with everything awake, a micrometre apart, agree too."""
    model = scene()
    body = int(model.tree_first[tree]) + depth
    positions, forces, awake = drag(Physics(model), body, np.array(way), 150)
    all_awake = Physics(model, parameters=PhysicsParameters(sleep=False))
    all_awake.wake(np.arange(len(model.tree_first)))
    expected, expected_forces, _ = drag(all_awake, body, np.array(way), 150)
    moved = np.zeros(len(model.tree_first))
    np.maximum.at(moved, model.body_tree, np.linalg.norm(expected - expected[0], axis=-1).max(0))
    assert awake[0] == 1
    assert 2 <= np.count_nonzero(moved > 1e-4) <= awake.max() <= np.count_nonzero(moved > 5e-5)
    assert awake.max() < len(moved)  # what is not reached sleeps on
    np.testing.assert_allclose(positions, expected, atol=1e-3)
    largest = np.linalg.norm(expected_forces, axis=1).max()
    assert np.abs(forces - expected_forces).max() < 0.02 * largest


@pytest.mark.parametrize("seed", [0, *long(1, 2)])
def test_what_was_clear_of_sleepers_and_hardly_moved_need_not_be_compared_again(seed: int) -> None:
    """Comparing every capsule with all sleepers in every step gives the same, to the bit."""
    rng = np.random.default_rng(seed)
    model = assemble(
        [cane((rng.uniform(0.0, 0.6), 0.03 * i, rng.uniform(0.98, 1.02)), radius=0.005) for i in range(16)]
    )
    worlds = [Physics(model), Physics(model)]
    bodies = model.tree_first[[2, 9]] + rng.integers(6, 15, 2)
    ties = [[physics.plants.add_tie(int(body), np.zeros(3), 1000.0, 10.0) for body in bodies] for physics in worlds]
    anchor = worlds[0].plants.tie_anchor[ties[0]].copy()
    velocity = np.zeros((2, 3))
    most = 0
    for physics in worlds:
        physics.wake(np.array([2, 9]))
    for step in range(250):
        if step % 25 == 0:
            velocity = rng.normal(size=(2, 3)) * rng.choice([0.003, 0.1, 0.8])
        anchor += np.float32(0.01) * velocity
        for physics, tied in zip(worlds, ties, strict=True):
            physics.plants.tie_anchor[tied] = anchor
        worlds[1].contact_solver.detection.forget_clearances()
        for physics in worlds:
            physics.step()
        most = max(most, len(worlds[0].plants.awake))
        assert worlds[0].plants.awake.tolist() == worlds[1].plants.awake.tolist()
        assert np.array_equal(worlds[0].state.joint_q, worlds[1].state.joint_q)
    assert most >= 3


def pressure(physics: Physics) -> float:
    return sum(float(np.linalg.norm(contact.force)) for contact in physics.contacts if contact.actor == "plants")


def test_a_cane_that_came_to_rest_on_another_sleeps_and_wakes_with_it() -> None:
    """A slack cane sags onto one that sleeps. Whichever is woken then, both are, and the contact bears what it bore."""
    physics = Physics(assemble([settled((0.0, 0.0, 1.0)), rod((0.5, -0.8, 1.021), heading=np.pi / 2, beta=0.03)]))
    physics.wake(np.array([1]))
    awake = []
    borne = 0.0
    while len(physics.plants.awake):
        borne = pressure(physics)
        physics.step()
        awake.append(physics.plants.awake.tolist())
        assert physics.time < 30.0
    assert awake[0] == [1]
    assert awake[-2:] == [[0, 1], []]
    assert borne > 0.05
    rest = physics.snapshot().body_q[:, :3].copy()
    for tree in (0, 1):
        physics.wake(np.array([tree]))
        physics.step()
        assert physics.plants.awake.tolist() == [0, 1]
        pressures = []
        while len(physics.plants.awake):
            physics.step()
            pressures.append(pressure(physics))
        np.testing.assert_allclose(pressures[:-1], borne, rtol=0.01)
        np.testing.assert_allclose(physics.snapshot().body_q[:, :3], rest, atol=2e-5)
