from __future__ import annotations

import functools
import logging

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.fault_guard import FaultGuard
from vinesim.plants.sleep import SleepMonitor
from vinesim.scene import spec
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.state import State


def row(count: int) -> ArticulationSolver:
    trees = []
    for i in range(count):
        tree = TreeBuilder(frames.pose(np.array([0.0, i, 2.0])))
        tree.add_rod(-1, 0.5, (0.004, 0.003), RodMaterial(5e9, 800.0, 0.01), 6)
        tree.solve_rest_pose()
        trees.append(tree)
    model = assemble(trees)
    return ArticulationSolver(model, State.at_rest(model))


@pytest.mark.parametrize(("force", "slowed"), [(10.0, 0), (1000.0, 1)])
def test_a_tree_slowed_to_the_largest_rate_is_counted(force: float, slowed: int) -> None:
    """The integrator takes energy from a tree beyond ``max_rate``, 50 rad/s; it goes on, and the count says so."""
    plants = row(2)
    guard = FaultGuard(plants)
    plants.wake(np.arange(2))
    plants.predict()
    plants.integrate(np.array([11]), np.array([[0.0, force, 0.0, 0.0, 0.0, 0.0]]))
    assert guard.stop_faulty_trees().size == 0
    assert (plants.tree_rate[1] > plants.max_rate) == bool(slowed)
    assert guard.slowed == slowed


@pytest.mark.parametrize("bad_value", [np.nan, np.inf, 1e9])
def test_a_faulty_tree_is_rolled_back_and_the_others_continue(
    bad_value: float, caplog: pytest.LogCaptureFixture
) -> None:
    plants = row(3)
    clean = row(3)
    guard = FaultGuard(plants)
    for each in (plants, clean):
        each.wake(np.arange(3))
        each.state.joint_qd[:, 1] = 0.3
    for tick in range(30):
        plants.predict()
        clean.predict()
        clean.integrate()
        if tick != 10:
            plants.integrate()
            assert guard.stop_faulty_trees().size == 0
            continue
        before = plants.state.joint_q.copy()
        plants.integrate(np.array([8]), np.array([[bad_value, 0.0, 0.0, 0.0, 0.0, 0.0]]))
        assert guard.stop_faulty_trees().tolist() == [1]
        assert not caplog.records
    bad = plants.model.bodies_of(1)
    good = np.delete(np.arange(18), plants.model.bodies_of(1))
    np.testing.assert_array_equal(plants.state.joint_q[bad], before[bad])
    assert not plants.state.joint_qd[bad].any()
    assert plants.awake.tolist() == [0, 2]
    np.testing.assert_array_equal(plants.state.joint_q[good], clean.state.joint_q[good])
    assert guard.count.tolist() == [0, 1, 0]
    with caplog.at_level(logging.WARNING):
        faults = guard.report()
    assert [(fault.tick, fault.tree) for fault in faults] == [(11, 1)]
    assert "tree 1 stopped in tick 11" in caplog.text
    assert guard.report() == []


def test_a_stopped_tree_wakes_in_a_valid_state() -> None:
    plants = row(1)
    guard = FaultGuard(plants)
    plants.wake(0)
    plants.state.joint_q[3] = np.nan
    plants.body_load[2, 1] = np.inf
    plants.predict()
    plants.integrate()
    assert guard.stop_faulty_trees().tolist() == [0]
    plants.wake(0)
    for _ in range(20):
        plants.predict()
        plants.integrate()
        assert guard.stop_faulty_trees().size == 0
    assert np.isfinite(plants.state.body_q).all()
    assert plants.tree_rate[0] < 0.1


@functools.cache
def clean_run(count: int) -> tuple[np.ndarray, ...]:
    """Joint rotations after each of forty ticks of a row without faults."""
    plants = row(count)
    plants.wake(np.arange(count))
    plants.state.joint_qd[:, 1] = 0.3
    joints = []
    for _ in range(40):
        plants.predict()
        plants.integrate()
        joints.append(plants.state.joint_q.copy())
    return tuple(joints)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    tick=st.integers(0, 30),
    body=st.integers(7, 11),  # not the root: a force on a clamped body moves nothing
    entry=st.integers(0, 2),
    value_in=st.one_of(
        st.tuples(st.sampled_from([np.nan, np.inf, -np.inf, 3e38]), st.sampled_from(["joint_q", "joint_qd", "wrench"])),
        st.tuples(st.sampled_from([np.nan, np.inf, -np.inf]), st.just("body_load")),
    ),
)
def test_no_non_finite_value_survives_a_tick(tick: int, body: int, entry: int, value_in: tuple[float, str]) -> None:
    """A bad value in any array at any time: its tree sleeps, finite, reported, wakeable; the others are unchanged."""
    value, array_name = value_in
    plants = row(3)
    guard = FaultGuard(plants)
    plants.wake(np.arange(3))
    plants.state.joint_qd[:, 1] = 0.3
    others = np.r_[0:6, 12:18]
    for current in range(40):
        wrench = None
        if current == tick and array_name == "wrench":
            wrench = np.zeros((1, 6))
            wrench[0, entry] = value
        elif current == tick:
            array = plants.body_load if array_name == "body_load" else getattr(plants.state, array_name)
            array[body, entry] = value
        plants.predict()
        plants.integrate(None if wrench is None else np.array([body]), wrench)
        stopped = guard.stop_faulty_trees()
        assert stopped.tolist() == ([1] if current == tick else [])
        assert_finite(plants)
        np.testing.assert_array_equal(plants.state.joint_q[others], clean_run(3)[current][others])
        if current == tick:
            assert plants.awake.tolist() == [0, 2]
        if current == tick + 1:
            plants.wake(1)
    assert [fault.tree for fault in guard.report()] == [1]
    assert plants.awake.tolist() == [0, 1, 2]
    assert np.isfinite(plants.tree_rate).all()


def assert_finite(plants: ArticulationSolver) -> None:
    plants.forward_kinematics()
    state = plants.state
    for array in (state.joint_q, state.joint_qd, state.body_q, state.body_qd, plants.body_load, plants.acceleration):
        assert np.isfinite(array).all()


def test_a_tree_woken_at_once_after_a_bad_wrench_is_valid() -> None:
    plants = row(1)
    guard = FaultGuard(plants)
    plants.wake(0)
    plants.predict()
    plants.integrate(np.array([3]), np.full((1, 6), np.nan))
    assert guard.stop_faulty_trees().tolist() == [0]
    plants.wake(0)
    plants.predict()
    plants.integrate()
    assert guard.stop_faulty_trees().size == 0


def test_a_cut_body_with_a_non_finite_position_is_reset() -> None:
    plants = row(2)
    state = plants.state
    drawn = state.body_q[9, :3].copy()
    plants.cut(9)
    state.joint_x[9], state.joint_xd[9] = np.nan, 3.0
    plants.predict()
    plants.integrate()
    assert FaultGuard(plants).stop_faulty_trees().tolist() == [1]
    np.testing.assert_array_equal(state.joint_x[9], drawn)
    assert not state.joint_xd[9].any()


def random_tree(rng: np.random.Generator) -> TreeBuilder:
    """Any tree that the model can describe: lengths 1 mm to 3 m, E 1e5 to 1e11 Pa, masses 1 mg to 1 t, any damping."""
    tree = TreeBuilder(np.concatenate([rng.normal(size=3), frames.normalize(rng.normal(size=4))]))
    ends = [-1]
    for _ in range(rng.integers(1, 4)):
        length = 10 ** rng.uniform(-3.0, 0.5)
        radius = length * 10 ** rng.uniform(-3.5, -0.5)
        beta = rng.choice([0.0, 10 ** rng.uniform(-4.0, 3.0)])
        wood = RodMaterial(10 ** rng.uniform(5.0, 11.0), 10 ** rng.uniform(1.0, 4.3), beta)
        turn = frames.exp(rng.normal(size=3))
        tapered = (radius, rng.uniform(0.2, 1.0) * radius)
        ends += tree.add_rod(int(rng.choice(ends)), length, tapered, wood, int(rng.integers(1, 9)), rest=turn)
    if rng.random() < 0.5:
        mass = 10 ** rng.uniform(-6.0, 3.0)
        reach = 10 ** rng.uniform(-3.0, -0.5)
        tree.add_body(
            int(rng.choice(ends[1:])),
            offset=(0.01, 0, 0),
            mass=mass,
            com=(reach, 0, 0),
            length=reach,
            inertia=[0.4 * mass * reach**2] * 3,
            stiffness=[rng.choice([0.0, 10 ** rng.uniform(-4.0, 4.0)])] * 3,
            damping=[rng.choice([0.0, 10 ** rng.uniform(-6.0, 2.0)])] * 3,
        )
    for body in tree.bodies:
        scale = np.clip(body["mass"], 1e-6, 1e3) / body["mass"]
        body["mass"] *= scale
        body["inertia"] = np.maximum(scale * np.asarray(body["inertia"]), 1e-18)
    return tree


def run_random(
    seed: int, trees: list[TreeBuilder], ticks: int, start: int = 0
) -> tuple[ArticulationSolver, FaultGuard]:
    """Trees in any pose, up to 1e4 rad/s, under loads and forces up to 1e6 N for half the time; checked every tick.

    Each tree has its own random stream, numbered from ``start``: its input does not depend on its neighbours.
    """
    draws = [np.random.default_rng((seed, start + i)) for i in range(len(trees))]
    model = assemble(trees)
    plants = ArticulationSolver(model, State.at_rest(model))
    guard = FaultGuard(plants)
    spans = [model.bodies_of(i) for i in range(len(trees))]
    sizes = []
    for rng, span in zip(draws, spans, strict=True):
        count = span.stop - span.start
        plants.state.joint_q[span] = frames.normalize(rng.normal(size=(count, 4)))
        rate = frames.normalize(rng.normal(size=(count, 3))) * 10 ** rng.uniform(-2.0, 4.0)
        plants.state.joint_qd[span] = rate
        sizes.append(10 ** rng.uniform(-3.0, 6.0))
    plants.wake(np.arange(len(trees)))
    for tick in range(ticks):
        is_loaded = tick < ticks // 2
        for rng, span, size in zip(draws, spans, sizes, strict=True):
            plants.body_load[span] = is_loaded * size * rng.uniform(-1.0, 1.0, (span.stop - span.start, 6))
        plants.predict()
        bodies = model.tree_first[plants.awake]
        pushes = [is_loaded * draws[i].uniform(-1e6, 1e6, 6) for i in plants.awake]
        plants.integrate(bodies, np.array(pushes).reshape(-1, 6))
        guard.stop_faulty_trees()
        assert_finite(plants)
        assert np.linalg.norm(plants.state.joint_qd, axis=1).max() <= 1.001 * plants.max_rate or tick == 0
    return plants, guard


@settings(max_examples=8, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**31))
def test_any_tree_under_any_load_stays_finite(seed: int) -> None:
    """Any input: no non-finite value survives a tick, faults are counted, stopped trees wake again."""
    rng = np.random.default_rng(seed)
    plants, guard = run_random(seed, [random_tree(rng) for _ in range(24)], 40)
    stopped = np.flatnonzero(guard.count)
    assert not plants.state.tree_awake[stopped].any()
    assert sorted({fault.tree for fault in guard.report()}) == stopped.tolist()
    plants.wake(stopped)
    assert plants.state.tree_awake.all()
    for _ in range(100):
        plants.predict()
        plants.integrate()
        guard.stop_faulty_trees()
    assert_finite(plants)


def test_trees_do_not_depend_on_their_neighbours() -> None:
    rng = np.random.default_rng(7)
    trees = [random_tree(rng) for _ in range(12)]
    group, _ = run_random(3, trees, 40)
    for i in (0, 5, 11):
        single, _ = run_random(3, [trees[i]], 40, start=i)
        for name in ("joint_q", "joint_qd", "body_q"):
            in_group = getattr(group.state, name)[group.model.bodies_of(i)]
            np.testing.assert_array_equal(in_group, getattr(single.state, name))


def test_a_vineyard_slows_down_after_any_load() -> None:
    """Every shoot of the demo under loads up to 1e6 N, ten ticks at a time: ten seconds later all are slow."""
    rng = np.random.default_rng(1)
    model = generate(spec.load_scene("demo"))
    plants = ArticulationSolver(model, State.at_rest(model))
    guard = FaultGuard(plants)
    sleep = SleepMonitor(plants)
    all_trees = np.arange(len(model.tree_first))
    size = 10 ** rng.uniform(0.0, 6.0, len(all_trees))[model.body_tree]
    for tick in range(60):
        if tick % 10 == 0:
            chosen = rng.random(len(size)) < 0.1
            plants.body_load[:, :3] = (chosen * size)[:, None] * frames.normalize(rng.normal(size=(len(size), 3)))
        plants.wake(all_trees)
        plants.predict()
        plants.integrate()
        guard.stop_faulty_trees()
    assert guard.count.sum() > 10
    plants.body_load[:] = 0.0
    plants.wake(all_trees)
    before = guard.count.sum()
    for _ in range(1000):
        plants.predict()
        plants.integrate()
        guard.stop_faulty_trees()
        sleep.update()
    assert guard.count.sum() == before
    assert plants.tree_rate.max() < 2.0
    plants.forward_kinematics()
    displacement = np.linalg.norm(
        plants.state.body_q[:, :3] - model.forward_kinematics(model.joint_settled)[:, :3], axis=1
    )
    assert np.median(displacement) < 0.02


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"length": 0.0}, r"rod of length 0.0 m, .*all must be positive"),
        ({"radius": (0.004, -0.001)}, r"rod of .*radius \(0.004, -0.001\) m.*all must be positive"),
        ({"material": RodMaterial(-5e9, 800.0)}, r"rod of .*modulus=-5000000000.0.*all must be positive"),
        ({"material": RodMaterial(5e9, 0.0)}, r"rod of .*density=0.0.*all must be positive"),
        ({"segments": 0}, r"rod of .* 0 segments.*all must be positive"),
        ({"parent": 3, "offset": (0, 0, 0)}, r"body 0 names parent 3, which does not stand before it"),
    ],
)
def test_invalid_rods_are_refused_with_the_reason(change: dict, message: str) -> None:
    given = {
        "parent": -1,
        "length": 1.0,
        "radius": (0.004, 0.004),
        "material": RodMaterial(5e9, 800.0),
        "segments": 4,
    } | change
    with pytest.raises(ValueError, match=message):
        TreeBuilder(frames.pose(np.zeros(3))).add_rod(**given)
