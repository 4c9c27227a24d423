from __future__ import annotations

import numpy as np
import pytest

from tests.support.contact_scenes import bar
from vinesim.core import frames
from vinesim.kernels.plants.forces import AIR_DENSITY
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State
from vinesim.scene.wind import Wind
from vinesim.wind.plant_wind import FADE_DURATION, WindOnPlants
from vinesim.wind.shelter import TreeDrag
from vinesim.world import Physics

CHECK_STEPS = PhysicsParameters().steps(PhysicsParameters().wind_check_period)
FADE_STEPS = PhysicsParameters().steps(2.0 * FADE_DURATION)


def leafy(count: int, area: float = 0.004, **wood: float) -> Model:
    """Upright canes of half a metre, side by side a metre apart, each body with a leaf or two."""
    trees = []
    for i in range(count):
        tree = TreeBuilder(
            frames.pose(np.array([0.0, i, 0.0]), frames.from_x_axis(np.array([0.0, 0.0, 1.0]), np.eye(3)[0]))
        )
        tree.add_rod(
            -1, 0.5, (0.003, 0.003), RodMaterial(**{"modulus": 3e9, "density": 800.0, "damping": 0.02} | wood), 8
        )
        trees.append(tree)
    model = assemble(trees)
    model.body_drag[:] = area
    return model


def step(plants: ArticulationSolver, ticks: int) -> None:
    for _ in range(ticks):
        plants.predict()
        plants.integrate()


# ---- the field


def test_wind_is_a_pure_function() -> None:
    points = np.random.default_rng(0).normal(size=(5, 7, 3)) * 10.0
    first, same_seed = (Wind([3.0, 1.0, 0.0], gusts=1.0, seed=4) for _ in range(2))
    expected = first.velocity_at(points, 12.5)
    first.velocity_at(points, 3.0)
    np.testing.assert_array_equal(first.velocity_at(points, 12.5), expected)
    np.testing.assert_array_equal(same_seed.velocity_at(points, 12.5), expected)
    assert np.abs(Wind([3.0, 1.0, 0.0], gusts=1.0, seed=5).velocity_at(points, 12.5) - expected).max() > 0.1
    np.testing.assert_array_equal(
        Wind([3.0, 1.0, 0.0]).velocity_at(points, 12.5), np.broadcast_to([3.0, 1.0, 0.0], points.shape)
    )


def test_gusts_travel_with_the_mean() -> None:
    wind = Wind([3.0, 1.0, 0.0], gusts=1.0)
    here = np.array([2.0, -1.0, 1.5])
    np.testing.assert_allclose(wind.velocity_at(here + 7.0 * wind.mean, 7.0), wind.velocity_at(here, 0.0), atol=1e-9)


def test_gusts_have_the_given_strength_and_scale_and_no_divergence() -> None:
    """Mean and standard deviation of each component over many points; correlation over many seeds."""
    points = np.random.default_rng(1).uniform(-300, 300, (20000, 3))
    wind = Wind([3.0, 0.0, 0.0], gusts=0.8, scale=2.0, seed=3)
    gust = wind.velocity_at(points, 0.0) - wind.mean
    np.testing.assert_allclose(gust.mean(0), 0.0, atol=0.03)
    near = []
    far = []
    power = np.zeros(3)
    for seed in range(40):
        wind = Wind([3.0, 0.0, 0.0], gusts=0.8, scale=2.0, seed=seed)
        a, b, c = (
            wind.velocity_at(points[:500] + shift, 0.0) - wind.mean for shift in ([0, 0, 0], [0.2, 0, 0], [20.0, 0, 0])
        )
        power += (a * a).mean(0) / 40
        near.append((a * b).sum(1).mean() / 1.92)
        far.append((a * c).sum(1).mean() / 1.92)
    np.testing.assert_allclose(np.sqrt(power), 0.8, rtol=0.1)
    assert 0.7 < np.mean(near) < 0.9  # von Karman: about 1 - (r / L)^(2/3)
    assert abs(np.mean(far)) < 0.1
    h = 1e-4
    divergence = sum(
        (wind.velocity_at(points + h * e, 0.0) - wind.velocity_at(points - h * e, 0.0))[:, i]
        for i, e in enumerate(np.eye(3))
    )
    np.testing.assert_allclose(divergence / (2 * h), 0.0, atol=2e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mean": [1.0, 2.0]}, "give three finite numbers"),
        ({"mean": [np.nan, 0, 0]}, "give three finite numbers"),
        ({"mean": [1, 0, 0], "gusts": -1.0}, r"gusts -1.0 m/s"),
        ({"mean": [1, 0, 0], "scale": 0.0}, r"scale 0.0 m"),
    ],
)
def test_invalid_wind_is_refused_with_the_reason(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Wind(**arguments)


# ---- drag on plants


def test_without_drag_wind_changes_no_bit() -> None:
    runs = []
    for air in (0.0, 20.0):
        model = leafy(1, area=0.0)
        plants = ArticulationSolver(model, State.at_rest(model))
        plants.wake(0)
        plants.state.joint_qd[:] = 1.0
        plants.tree_air[:] = air
        step(plants, 50)
        runs.append(plants.state.joint_q.tobytes() + plants.velocity_free.tobytes())
    assert runs[0] == runs[1]


def test_deflection_by_wind_is_that_of_statics() -> None:
    """Uniform wind on an upright cane, its weight in balance: w(L) = q L^4 / 8 EI, from the model's own springs."""
    model = leafy(1, area=1e-4)
    plants = ArticulationSolver(model, State.at_rest(model), phi=1.0)
    plants.wake(0)
    plants.tree_air[0] = [0.0, 3.0, 0.0]
    plants.body_load[:, 2] = 9.81 * model.body_mass  # compensate the weight, so that only the wind bends
    for body, frame in enumerate(plants.state.body_q):
        arm = frames.rotate(frame[3:].astype(float), model.body_com[body].astype(float))
        plants.body_load[body, 3:] = np.cross(arm, plants.body_load[body, :3])
    step(plants, 1500)
    plants.forward_kinematics()
    q = 0.5 * AIR_DENSITY * 1e-4 * 9.0 / (0.5 / 8)
    tip = frames.compose(plants.state.body_q[7], frames.pose([0.5 / 8, 0, 0]))
    assert tip[1] == pytest.approx(q * 0.5**4 / 8 / (3e9 * np.pi / 4 * 0.003**4), rel=0.02)
    root = plants.joint_wrench(np.array([0]))[0]
    assert root[1] == pytest.approx(-q * 0.5, rel=0.01)  # the root joint balances the wind


def test_a_falling_cane_reaches_its_terminal_velocity() -> None:
    """m g = rho Cd A v^2 / 2, straight down, momentum lost to the air only."""
    model = leafy(1, area=0.002)
    plants = ArticulationSolver(model, State.at_rest(model))
    plants.cut(0)
    step(plants, 500)
    mass = model.body_mass.sum()
    area = model.body_drag.sum()
    terminal_speed = np.sqrt(2.0 * mass * 9.81 / AIR_DENSITY / area)
    np.testing.assert_allclose(plants.state.joint_xd[0], [0.0, 0.0, -terminal_speed], atol=2e-3 * terminal_speed)
    plants.tree_air[0] = [2.0, 0.0, 0.0]
    step(plants, 1500)
    np.testing.assert_allclose(
        plants.velocity_free[:, :3].mean(0), [2.0, 0.0, -terminal_speed], atol=0.05 * terminal_speed
    )


@pytest.mark.parametrize("area", [0.004, 0.02])
def test_a_storm_is_stable(area: float) -> None:
    """40 m/s and gusts, a thousand times the weight: canes align with the wind, no faster than the air."""
    model = leafy(3, area=area, damping=0.004)
    plants = ArticulationSolver(model, State.at_rest(model))
    plants.wake(np.arange(3))
    wind = Wind([32.0, 24.0, 0.0], gusts=16.0, seed=2)
    blown = WindOnPlants(plants)
    for tick in range(1000):
        blown.update(wind, 0.01 * tick)
        step(plants, 1)
        assert plants.tree_rate.max() < 300.0
        assert np.linalg.norm(plants.velocity_free[:, :3], axis=1).max() < 80.0
    plants.tree_air[:] = [32.0, 24.0, 0.0]
    step(plants, 1000)
    if area == 0.004:
        assert plants.tree_rate.max() < 0.01
    plants.forward_kinematics()
    lean = plants.state.body_q[7::8, :3] - model.tree_pose[:, :3]
    assert (lean @ [0.8, 0.6, 0.0] > 0.38).all()


# ---- waking


def test_wind_wakes_only_trees_that_it_moves() -> None:
    model = leafy(100)
    model.body_drag[model.bodies_of(7)] = 0.0
    plants = ArticulationSolver(model, State.at_rest(model))
    breeze = Wind([0.05, 0.0, 0.0])
    blown = WindOnPlants(plants)
    for tick in range(CHECK_STEPS):
        blown.update(breeze, 0.01 * tick)
    assert len(plants.awake) == 0
    wind = Wind([4.0, 0.0, 0.0], gusts=1.0)
    blown = WindOnPlants(plants)
    for tick in range(CHECK_STEPS):
        blown.update(wind, 0.01 * tick)
    assert plants.awake.tolist() == [t for t in range(100) if t != 7]
    share = TreeDrag.of(model, plants.state.body_q).air_share(wind.mean)[50]
    growing = []
    for _ in range(FADE_STEPS):
        blown.update(wind, 1.0)
        growing.append(float(np.linalg.norm(plants.tree_air[50])))
    assert np.diff(growing).min() >= -1e-6  # no gust front hits a tree that has just been woken
    np.testing.assert_allclose(plants.tree_air[50], share * wind.velocity_at(model.tree_pose[50, :3], 1.0), rtol=1e-5)


def test_beyond_the_radius_there_is_no_simulated_wind() -> None:
    model = leafy(100)
    plants = ArticulationSolver(model, State.at_rest(model))
    wind = Wind([4.0, 0.0, 0.0], gusts=1.0)
    blown = WindOnPlants(plants)
    for tick in range(CHECK_STEPS):
        blown.update(wind, 0.01 * tick, (np.array([[0.0, 10.0, 0.0], [0.0, 40.0, 0.0]]), 2.5))
    assert plants.awake.tolist() == [8, 9, 10, 11, 12, 38, 39, 40, 41, 42]
    assert not plants.tree_air[90].any()
    assert blown.state is not None
    drawn = blown.state.tree_drawn
    assert (np.delete(drawn, plants.awake) == 1.0).all()  # sensors draw all others in it


def test_a_tree_asleep_in_steady_wind_stays_asleep() -> None:
    model = leafy(1)
    plants = ArticulationSolver(model, State.at_rest(model))
    wind = Wind([2.0, 0.0, 0.0])
    blown = WindOnPlants(plants)
    for tick in range(CHECK_STEPS + FADE_STEPS):
        blown.update(wind, 0.01 * tick)
    assert plants.awake.tolist() == [0]
    plants.put_to_sleep(0)
    for tick in range(CHECK_STEPS):
        blown.update(wind, 0.01 * tick)
    assert len(plants.awake) == 0


def test_trees_come_to_rest_again_when_the_wind_ends() -> None:
    """They neither keep the last air that they felt, nor are they let go at once."""
    physics = Physics(leafy(1, damping=0.2))
    physics.wind = Wind([3.0, 0.0, 0.0])
    for _ in range(600):
        physics.step()
    tip = physics.model.bodies_of(0).stop - 1
    assert physics.snapshot().body_q[tip, 0] > 0.005
    physics.wind = None
    before = physics.snapshot().body_q[tip, 0]
    for _ in range(1500):
        physics.step()
        now = physics.snapshot().body_q[tip, 0]
        assert abs(now - before) < 1e-3
        before = now
    assert before == pytest.approx(0.0, abs=1e-4)
    assert physics.snapshot().wind is None
    assert len(physics.plants.awake) == 0


def test_a_step_applies_wind_near_robots() -> None:
    """In a breeze the cane beside the robot leans and stays awake; one nine metres away sleeps undeformed."""
    physics = Physics(leafy(10))
    physics.add_robot(bar((1.0, -0.5, 0.2)))
    physics.wind = Wind(np.array([0.0, 6.0, 0.0]), gusts=1.0)
    for _ in range(400):
        physics.step()
    model = physics.model
    rest_pose = model.forward_kinematics(model.joint_settled)
    first = model.bodies_of(0)
    last = model.bodies_of(9)
    assert 0 in physics.plants.awake
    assert 9 not in physics.plants.awake
    assert physics.snapshot().body_q[first.stop - 1, 1] > rest_pose[first.stop - 1, 1] + 0.01
    np.testing.assert_array_equal(physics.state.joint_q[last], model.joint_settled[last])
