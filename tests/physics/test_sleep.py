from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.device_buffers import DeviceBuffers
from vinesim.plants.sleep import SleepMonitor
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.state import State
from vinesim.scene.wind import Wind
from vinesim.world import Physics


def row(count: int) -> ArticulationSolver:
    trees = []
    for i in range(count):
        tree = TreeBuilder(frames.pose(np.array([0.0, i, 2.0])))
        tree.add_rod(-1, 0.5, (0.004, 0.003), RodMaterial(5e9, 800.0, 0.01), 6)
        tree.solve_rest_pose()
        trees.append(tree)
    model = assemble(trees)
    return ArticulationSolver(model, State.at_rest(model))


def tick(plants: ArticulationSolver, sleep: SleepMonitor, *keep_awake: Any) -> np.ndarray:
    plants.predict()
    plants.integrate()
    return sleep.update(*keep_awake)


def test_a_kicked_tree_swings_then_sleeps_and_the_others_stay_asleep() -> None:
    plants = row(5)
    sleep = SleepMonitor(plants)
    state = plants.state
    others = np.delete(np.arange(30), plants.model.bodies_of(2))
    before = [getattr(state, name)[others].tobytes() for name in ("joint_q", "joint_qd", "body_q", "body_qd")]
    sleep.wake(2)
    state.joint_qd[plants.model.bodies_of(2), 1] = 0.5
    ticks = 0
    while len(plants.awake):
        tick(plants, sleep)
        ticks += 1
        assert ticks < 1000
    assert ticks > 50  # longer than one at rest is awake
    assert not state.joint_qd.any()
    assert not state.tree_awake.any()
    after = [getattr(state, name)[others].tobytes() for name in ("joint_q", "joint_qd", "body_q", "body_qd")]
    assert before == after
    np.testing.assert_allclose(
        state.body_q, plants.model.forward_kinematics(state.joint_q), atol=1e-5
    )  # current, not one tick old


def test_a_tree_at_rest_sleeps_after_the_sleep_duration() -> None:
    plants = row(2)
    sleep = SleepMonitor(plants, PhysicsParameters(sleep_duration=0.1))
    sleep.wake(np.array([0, 1]))
    drawn = plants.state.body_q.copy()
    slept = [tick(plants, sleep).tolist() for _ in range(10)]
    assert slept == [[]] * 9 + [[0, 1]]
    np.testing.assert_allclose(plants.state.body_q, drawn, atol=1e-5)


def test_busy_trees_stay_awake() -> None:
    plants = row(3)
    sleep = SleepMonitor(plants, PhysicsParameters(sleep_duration=0.05))
    sleep.wake(np.array([0, 2]))
    for _ in range(20):
        tick(plants, sleep, np.array([False, True, True]))
    assert plants.awake.tolist() == [2]
    assert sleep.restless.tolist() == []


def test_trees_in_contact_sleep_together() -> None:
    """1 touches 0 and 2, 3 touches none: while 2 moves, 0 and 1 stay awake, however quiet."""
    plants = row(4)
    sleep = SleepMonitor(plants, PhysicsParameters(sleep_duration=0.05))
    sleep.wake(np.arange(4))
    pairs = np.array([[0, 1], [2, 1]])
    for _ in range(20):
        plants.state.joint_qd[plants.model.bodies_of(2), 1] += 0.2
        tick(plants, sleep, None, pairs)
    assert plants.awake.tolist() == [0, 1, 2]
    assert sleep.restless.tolist() == [2]
    ticks = 0
    while len(plants.awake):
        slept = tick(plants, sleep, None, pairs).tolist()
        ticks += 1
        assert ticks < 2000
    assert slept == [0, 1, 2]


def test_a_tree_is_moved_to_rest_but_not_while_a_contact_bears_it() -> None:
    """Equilibrium is where the net moment of every joint is zero: a step from there moves nothing."""
    plants = row(2)
    sleep = SleepMonitor(plants)
    for pressed in (False, True):
        sleep.wake(0)
        plants.body_load[5, 2] = 0.05 if pressed else -0.05
        slept = []
        for _ in range(3000):
            plants.predict()
            plants.integrate(*((np.array([4]), np.array([[0, 0, 0.01, 0, 0, 0]])) if pressed else ()))
            slept = sleep.update()
            if len(slept):
                break
        assert slept.tolist() == [0]
        assert not plants.state.joint_qd.any()
        sleep.wake(0)
        before = plants.state.body_q[:6, :3].copy()
        for _ in range(40):
            plants.predict()
            plants.integrate(*((np.array([4]), np.array([[0, 0, 0.01, 0, 0, 0]])) if pressed else ()))
        plants.forward_kinematics()
        np.testing.assert_allclose(plants.state.body_q[:6, :3], before, atol=3e-5 if pressed else 2e-6)
        while not len(sleep.update()):
            plants.predict()
            plants.integrate()


def test_a_tree_that_another_client_owns_or_a_tie_holds_stays_awake() -> None:
    physics = Physics(row(2).model)
    physics.wake(np.array([0, 1]))
    physics.contact_solver.remote_trees[0] = True
    tie = physics.plants.add_tie(9, np.zeros(3), 200.0, 2.0)
    for _ in range(150):
        physics.step()
    assert physics.plants.awake.tolist() == [0, 1]
    assert physics.sleep_monitor.restless.tolist() == []
    physics.contact_solver.remote_trees[0] = False
    physics.plants.remove_tie(9, tie)
    for _ in range(10):
        physics.step()
    assert physics.plants.awake.tolist() == []


def test_a_tree_in_a_steady_wind_sleeps_where_the_wind_holds_it() -> None:
    paths = []
    for sleep in (True, False):
        tree = TreeBuilder(frames.pose(np.array([0.0, 0.0, 2.0])))
        tree.add_rod(-1, 0.6, (0.003, 0.003), RodMaterial(5e9, 800.0, 0.05), 8)
        tree.solve_rest_pose()
        model = assemble([tree])
        model.body_drag[:] = 0.002
        physics = Physics(model, parameters=PhysicsParameters(sleep=sleep))
        physics.wind = Wind(np.array([0.0, 5.0, 0.0]))
        for _ in range(1200):
            physics.step()
        assert physics.state.tree_awake[0] != sleep
        paths.append(physics.snapshot().body_q[:, :3].astype(float))
    assert paths[0][-1, 1] > 0.005
    np.testing.assert_allclose(paths[0], paths[1], atol=1e-5)


def test_copies_of_the_arrays_for_a_gpu_measure_the_same() -> None:
    found = []
    for interleave in (0, 4):
        model = row(6).model
        plants = ArticulationSolver(model, State.at_rest(model), buffers=DeviceBuffers("cpu", interleave))
        sleep = SleepMonitor(plants, PhysicsParameters(sleep_duration=0.02))
        sleep.wake(np.arange(6))
        plants.body_load[[3, 20], 2] = -0.02, 0.01
        for _ in range(600):
            tick(plants, sleep)
        assert len(plants.awake) == 0
        found.append(plants.state.joint_q.copy())
    assert not np.array_equal(found[0], model.joint_settled)
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)


@pytest.mark.parametrize(("length", "falls"), [(0.97, False), (1.03, True)])
def test_what_stands_where_it_cannot_stay_does_not_sleep(length: float, falls: bool) -> None:
    """A column a little shorter and longer than Greenhill's (1881): L^3 = 7.8373 E I / (rho A g)."""
    material = RodMaterial(1e9, 1000.0, 0.3)
    radius = 0.002
    critical = (7.8373 * 1e9 * 0.25 * radius**2 / (1000.0 * 9.81)) ** (1.0 / 3.0)
    tree = TreeBuilder(frames.pose(np.array([0.0, 0.0, 0.1]), frames.from_x_axis(np.array([0.0, 0.0, 1.0]))))
    tree.add_rod(-1, length * critical, (radius, radius), material, 24)
    physics = Physics(assemble([tree]))
    physics.wake(np.array([0]))
    for _ in range(100):
        physics.step()
    assert (len(physics.plants.awake) == 1) == falls
