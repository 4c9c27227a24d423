from __future__ import annotations

import gc
import itertools
import threading

import numpy as np
import pytest
import warp as wp

from tests.support.clustered_trees import clustered, momenta, moving
from vinesim import frames
from vinesim.physics.plants.articulation_solver import ArticulationSolver
from vinesim.physics.plants.device_buffers import DeviceBuffers, DeviceUnavailable
from vinesim.physics.plants.fault_guard import FaultGuard
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.model import Model
from vinesim.scene.state import State


def canes(count: int) -> Model:
    trees = []
    for i in range(count):
        tree = TreeBuilder(frames.pose(np.array([0.0, i, 2.0])))
        tree.add_rod(-1, 0.5, (0.004, 0.003), RodMaterial(5e9, 800.0, 0.01), 5)
        tree.solve_rest_pose()
        trees.append(tree)
    return assemble(trees)


@pytest.fixture
def plants() -> ArticulationSolver:
    model = canes(4)
    return ArticulationSolver(model, State.at_rest(model))


def step(plants: ArticulationSolver, ticks: int = 1) -> None:
    for _ in range(ticks):
        plants.predict()
        plants.integrate()


def test_drawn_shape_stays(plants: ArticulationSolver) -> None:
    drawn = plants.state.body_q.copy()
    plants.wake(np.arange(4))
    step(plants, 200)
    plants.forward_kinematics()
    np.testing.assert_allclose(plants.state.body_q, drawn, atol=2e-5)


def test_state_is_shared_memory_and_kinematics_follow_it(plants: ArticulationSolver) -> None:
    state, rng = plants.state, np.random.default_rng(1)
    state.joint_q[:] = frames.exp(rng.normal(size=(20, 3)))
    state.joint_qd[:] = rng.normal(size=(20, 3))
    plants.forward_kinematics(np.arange(4))
    np.testing.assert_allclose(state.body_q, plants.model.forward_kinematics(state.joint_q), atol=2e-6)
    ahead = state.joint_q.astype(float)
    h = 1e-5
    there = plants.model.forward_kinematics(frames.multiply(frames.exp(h * state.joint_qd.astype(float)), ahead))
    here = plants.model.forward_kinematics(ahead)
    np.testing.assert_allclose(state.body_qd[:, :3], (there - here)[:, :3] / h, atol=1e-3)
    turn = frames.log(frames.multiply(there[:, 3:], frames.conjugate(here[:, 3:]))) / h
    np.testing.assert_allclose(state.body_qd[:, 3:], turn, atol=1e-3)


def test_awake_is_sorted_and_sleepers_are_untouched(plants: ArticulationSolver) -> None:
    state = plants.state
    plants.wake(np.array([3, 1]))
    assert plants.awake.tolist() == [1, 3]
    plants.wake(0)
    plants.put_to_sleep(np.array([1]))
    assert plants.awake.tolist() == [0, 3]
    assert state.tree_awake.tolist() == [True, False, False, True]
    asleep = plants.bodies_of(np.array([1, 2]))
    assert asleep.tolist() == list(range(5, 15))
    arrays = [state.joint_q, state.joint_qd, state.body_q, state.body_qd, plants.velocity_free, plants.acceleration]
    before = [array[asleep].tobytes() for array in arrays]
    state.joint_qd[0, 1] = 1.0
    step(plants, 3)
    assert [array[asleep].tobytes() for array in arrays] == before
    assert np.abs(state.joint_qd[:5]).max() > 1e-3


def test_touching_a_sleeper_is_refused(plants: ArticulationSolver) -> None:
    plants.wake(np.array([0, 2]))
    plants.predict()
    plants.wake(1)  # too late for this tick
    with pytest.raises(ValueError, match=r"body 7 is touched, but tree 1 slept: wake it before predict\(\)"):
        plants.integrate(np.array([2, 7]), np.zeros((2, 6)))
    with pytest.raises(ValueError, match=r"body 15 .* tree 3"):
        plants.impulse_response(np.array([15]))


def test_resting_between_free_and_commit_holds(plants: ArticulationSolver) -> None:
    plants.wake(np.array([0, 1]))
    plants.state.joint_qd[:, 1] = 1.0
    plants.predict()
    plants.put_to_sleep(0)
    before = plants.state.joint_q[:5].copy()
    plants.integrate()
    np.testing.assert_array_equal(plants.state.joint_q[:5], before)
    assert not plants.state.joint_qd[:5].any()


def test_wrenches_on_one_body_add_up_and_do_not_linger() -> None:
    model = canes(1)
    runs = []
    for bodies, wrenches in (
        ([4], [[1.0, 2.0, 3.0, 0.1, 0.0, 0.0]]),
        ([4, 4], [[1.0, 0.0, 3.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.1, 0.0, 0.0]]),
    ):
        plants = ArticulationSolver(model, State.at_rest(model))
        plants.wake(0)
        plants.predict()
        plants.integrate(np.array(bodies), np.array(wrenches))
        kicked = plants.state.joint_qd.copy()
        step(plants, 400)
        runs.append((kicked, plants.tree_rate[0]))
    np.testing.assert_allclose(runs[0][0], runs[1][0], rtol=1e-6)
    assert np.abs(runs[0][0]).max() > 0.1
    assert runs[0][1] < 0.01  # the push was one tick long


def test_steady_load_bends_by_the_beam_formula() -> None:
    """A small sideways force on the tip: deflection F L^3 / 3 EI."""
    tree = TreeBuilder(frames.pose(np.zeros(3)))
    tree.add_rod(-1, 1.0, (0.004, 0.004), RodMaterial(5e9, 800.0, 0.2), 16)
    tree.solve_rest_pose()
    model = assemble([tree])
    plants = ArticulationSolver(model, State.at_rest(model))
    plants.wake(0)
    plants.body_load[15] = [0.0, 0.01, 0.0, 0.0, 0.0, 0.01 / 16]  # at the tip
    step(plants, 1500)
    plants.forward_kinematics()
    tip = frames.compose(plants.state.body_q[15], frames.pose([1 / 16, 0, 0]))
    assert tip[1] == pytest.approx(0.01 / (3 * 5e9 * np.pi * 0.004**4 / 4), rel=0.01)


def test_response_of_nothing_and_of_many(plants: ArticulationSolver) -> None:
    plants.wake(np.arange(4))
    plants.predict()
    assert plants.impulse_response(np.zeros(0, np.int32)).shape == (0, 6, 0, 6)
    one = plants.impulse_response(np.array([7]))
    many = plants.impulse_response(np.arange(20))
    assert many.shape == (20, 6, 20, 6)
    np.testing.assert_array_equal(many[7, :, 7], one[0, :, 0])
    flat = many.reshape(120, 120)
    np.testing.assert_array_equal(flat, flat.T)
    assert np.linalg.eigvalsh(flat.astype(float)).min() > -1e-4 * np.abs(flat).max()
    assert not many[0, :, 5:].any()


def test_phi_is_one_after_a_touch_begins_and_when_brisk(plants: ArticulationSolver) -> None:
    plants.wake(np.arange(2))
    used = plants.phi_used
    step(plants)
    assert used[:2].tolist() == pytest.approx([0.55, 0.55])
    seen = []
    for _ in range(6):  # a lasting touch begins
        plants.predict()
        seen.append(float(used[0]))
        plants.integrate(np.array([2]), np.array([[0.0, 0.0, 0.01, 0.0, 0.0, 0.0]]))
        assert used[1] == pytest.approx(0.55)
    assert seen == pytest.approx([0.55] + [1.0] * 3 + [0.55] * 2)
    plants.state.joint_qd[6, 0] = 6.0
    plants.predict()
    assert used[1] == 1.0


def test_pull_moves_by_blend(plants: ArticulationSolver) -> None:
    rng = np.random.default_rng(2)
    state, bodies = plants.state, plants.model.bodies_of(2)
    start = state.joint_q[bodies].copy()
    goal = frames.exp(rng.normal(size=(5, 3)) * 0.5)
    rates = rng.normal(size=(5, 3))
    plants.blend_towards(2, -3.0 * goal, rates, 0.25)  # neither sign nor length of a quaternion matters
    np.testing.assert_allclose(state.joint_qd[bodies], rates, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(state.joint_q[bodies], axis=-1), 1.0, atol=1e-6)
    whole = frames.log(frames.multiply(frames.conjugate(start), goal))
    done = frames.log(frames.multiply(frames.conjugate(start), state.joint_q[bodies]))
    np.testing.assert_allclose(done, 0.25 * whole, atol=1e-5)
    plants.blend_towards(2, goal, rates, 1.0)
    there = frames.multiply(frames.conjugate(goal), state.joint_q[bodies])
    np.testing.assert_allclose(frames.log(there), 0.0, atol=1e-5)
    with pytest.raises(ValueError, match="tree 2: pulled to a pose that is not finite"):
        plants.blend_towards(2, np.full((5, 4), np.nan), rates, 0.5)
    with pytest.raises(ValueError, match=r"tree 2: .* it has 5 bodies"):
        plants.blend_towards(2, goal[:4], rates, 0.5)


def test_a_lighter_body_hangs_less(plants: ArticulationSolver) -> None:
    plants.wake(0)
    plants.set_mass(4, plants.body_mass[4] / 10)
    before = plants.state.body_q[4, 2]
    step(plants, 300)
    plants.forward_kinematics()
    assert plants.state.body_q[4, 2] > before + 1e-5
    assert plants.model.body_mass[4] > 5 * plants.body_mass[4]  # the model is everyone's, and constant


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("body_length", 0.0, r"body 6 of tree 1: length \[m\] 0.0; give a positive length"),
        ("body_mass", -1.0, r"body 6 of tree 1: mass \[kg\] -1.0; give a positive mass"),
        ("body_inertia", 0.0, r"body 6 of tree 1: inertia \[kg m\^2\] .*; give positive principal moments"),
        ("joint_stiffness", -2.0, r"body 6 of tree 1: stiffness .*; a spring pulls back"),
        ("joint_damping", -2.0, r"body 6 of tree 1: damping .*; a damper takes energy"),
        ("body_parent", 6, r"body 6 of tree 1: parent 6; a parent stands before its children"),
        ("body_parent", 3, r"body 6 of tree 1: parent 3; name a body of the same tree"),
        ("body_rest", 2.0, r"body 6 of tree 1: rest rotation .*; give a unit quaternion"),
        ("body_offset", np.nan, r"Model.body_offset\[6, 0\] is not finite"),
    ],
)
def test_what_cannot_be_simulated_is_refused_in_words(name: str, value: float, says: str) -> None:
    model = canes(2)
    state = State.at_rest(model)
    getattr(model, name)[6] = value
    with pytest.raises(ValueError, match=says):
        ArticulationSolver(model, state)


def test_bad_state_and_options_are_refused() -> None:
    model = canes(1)
    state = State.at_rest(model)
    state.joint_q[2] = np.nan
    with pytest.raises(ValueError, match=r"State.joint_q\[2, 0\] is not finite"):
        ArticulationSolver(model, state)
    with pytest.raises(ValueError, match=r"phi 0\.4"):
        ArticulationSolver(model, State.at_rest(model), phi=0.4)
    with pytest.raises(ValueError, match=r"use State\.at_rest"):
        ArticulationSolver(model, State.at_rest(canes(2)))


# ---- coarse and fine


@pytest.fixture
def fruit() -> ArticulationSolver:
    """Three canes with clustered bunches and one plain."""
    model = clustered(3)
    return ArticulationSolver(model, State.at_rest(model))


def beyond(plants: ArticulationSolver, joint: int) -> np.ndarray:
    """The moving bodies that a joint carries."""
    bodies = moving(plants, plants.model.body_tree[[joint]])
    up = bodies.copy()
    while (up > joint).any():
        up = np.where(up > joint, plants.model.body_parent[up], up)
    return bodies[up == joint]


def stir(plants: ArticulationSolver, rate: float = 2.0) -> None:
    """Random rates in every joint that moves."""
    rng, state = np.random.default_rng(3), plants.state
    plants.wake(np.arange(len(plants.model.tree_first)))
    bodies = moving(plants, np.arange(len(plants.model.tree_first)))
    state.joint_q[bodies] = frames.multiply(frames.exp(rng.normal(size=(len(bodies), 3)) * 0.1), state.joint_q[bodies])
    state.joint_qd[bodies] = rng.normal(size=(len(bodies), 3)) * rate
    plants.forward_kinematics()


def test_clusters_of_a_coarse_tree_ride(fruit: ArticulationSolver) -> None:
    model, state = fruit.model, fruit.state
    stir(fruit)
    still = state.joint_q.copy()
    step(fruit, 20)
    fruit.forward_kinematics()
    riding = np.setdiff1d(np.arange(len(still)), moving(fruit, np.arange(3)))
    assert len(riding) == 15
    np.testing.assert_array_equal(state.joint_q[riding], still[riding])
    np.testing.assert_allclose(state.body_q, model.forward_kinematics(state.joint_q), atol=3e-6)
    cluster, bunch = model.bunch_cluster[1], model.bunch_body[1]
    offset = state.body_q[cluster, :3] - state.body_q[bunch, :3]
    velocity = state.body_qd[bunch, :3] + np.cross(state.body_qd[bunch, 3:], offset)
    np.testing.assert_allclose(state.body_qd[cluster], [*velocity, *state.body_qd[bunch, 3:]], atol=1e-5)


def test_refining_goes_on_with_pose_velocity_and_momentum(fruit: ArticulationSolver) -> None:
    state, model = fruit.state, fruit.model
    stir(fruit)
    step(fruit, 5)
    fruit.forward_kinematics()
    pose, speed = state.body_q.copy(), state.body_qd.copy()
    joints = np.arange(*model.bodies_of(1).indices(99))[:-5]
    before = [momenta(fruit, beyond(fruit, j), pose[j, :3].astype(float)) for j in joints]
    fruit.refine(np.array([1, 2]))
    fruit.refine(1)
    assert state.tree_fine.tolist() == [False, True, True]
    np.testing.assert_array_equal(state.body_q, pose)
    np.testing.assert_array_equal(state.body_qd, speed)
    for joint, (linear, angular, center, energy) in zip(joints, before, strict=True):
        after = momenta(fruit, beyond(fruit, joint), pose[joint, :3].astype(float))
        np.testing.assert_allclose(after[0], linear, atol=2e-6 * np.abs(linear).max())
        np.testing.assert_allclose(after[1], angular, atol=2e-6 * np.abs(angular).max())
        np.testing.assert_allclose(after[2], center, atol=1e-6)
        assert after[3] == pytest.approx(energy, rel=2e-6)


def test_coarsening_keeps_pose_and_momentum_and_never_adds_energy(fruit: ArticulationSolver) -> None:
    """A bunch keeps its angular momentum about its origin; no other tree feels anything."""
    state, model = fruit.state, fruit.model
    fruit.refine(np.arange(3))
    stir(fruit, 4.0)
    pose, joint_q = state.body_q.copy(), state.joint_q.copy()
    bunches = model.bunch_body[1:]
    before = [momenta(fruit, beyond(fruit, j), pose[j, :3].astype(float)) for j in bunches]
    energy = [momenta(fruit, moving(fruit, np.array([i])), np.zeros(3))[3] for i in (1, 2)]
    other = state.joint_qd[model.bodies_of(0)].copy()
    fruit.coarsen(np.array([1, 2]))
    assert state.tree_fine.tolist() == [True, False, False]
    np.testing.assert_array_equal(state.body_q, pose)
    np.testing.assert_array_equal(state.joint_q, joint_q)
    np.testing.assert_array_equal(state.joint_qd[model.bodies_of(0)], other)
    for joint, (_, angular, center, _) in zip(bunches, before, strict=True):
        after = momenta(fruit, beyond(fruit, joint), pose[joint, :3].astype(float))
        np.testing.assert_allclose(after[1], angular, atol=2e-6 * np.abs(angular).max())
        np.testing.assert_allclose(after[2], center, atol=1e-6)
    for i in (0, 1):
        assert momenta(fruit, moving(fruit, np.array([i + 1])), np.zeros(3))[3] < energy[i]


def test_energy_never_grows_whatever_the_clusters_do() -> None:
    model = clustered(1)
    for seed in range(20):
        plants = ArticulationSolver(model, State.at_rest(model))
        rng = np.random.default_rng(seed)
        plants.refine(0)
        plants.state.joint_q[:] = frames.exp(rng.normal(size=(len(model.body_mass), 3)))
        plants.state.joint_qd[-5:] = rng.normal(size=(5, 3)) * 10.0
        plants.forward_kinematics(0)
        energy = momenta(plants, moving(plants, np.array([0])), np.zeros(3))[3]
        plants.coarsen(0)
        assert momenta(plants, moving(plants, np.array([0])), np.zeros(3))[3] < energy


def test_fine_and_coarse_hang_the_same() -> None:
    """A fine tree comes to rest, is coarsened, and stays: nothing moves by 0.1 mm, nor does it as its twin."""
    model = clustered(2)
    plants = ArticulationSolver(model, State.at_rest(model))
    plants.refine(0)
    stir(plants, 1.0)
    for _ in range(100):  # stop it at every turning point, or nearly
        step(plants, 12)
        plants.state.joint_qd[:] = 0.0
    plants.forward_kinematics()
    pose = plants.state.body_q[:, :3].copy()
    size = int(model.tree_size[0])
    tips = pose[[7, size + 7]]
    np.testing.assert_allclose(tips[1] - tips[0], [0.0, 0.5, 0.0], atol=1e-4)
    plants.coarsen(0)
    plants.refine(1)
    step(plants, 300)
    plants.forward_kinematics()
    np.testing.assert_allclose(plants.state.body_q[:, :3][[7, size + 7]], tips, atol=1e-4)
    np.testing.assert_allclose(plants.state.body_q[:size, :3], pose[:size], atol=1e-4)


@pytest.mark.parametrize("at", [0, 10])
def test_a_cut_tree_that_coarsens_keeps_all_momentum(at: int) -> None:
    """The whole tree, or the bunch alone."""
    model = clustered(1)
    plants = ArticulationSolver(model, State.at_rest(model))
    plants.refine(0)
    stir(plants)
    plants.cut(at)
    linear, angular, _, energy = momenta(plants, beyond(plants, at), np.zeros(3))
    plants.coarsen(0)
    after = momenta(plants, beyond(plants, at), np.zeros(3))
    np.testing.assert_allclose(after[0], linear, atol=2e-6 * np.abs(linear).max())
    np.testing.assert_allclose(after[1], angular, atol=2e-6 * np.abs(angular).max())
    assert after[3] < energy


def test_sleepers_refine_in_their_sleep_and_plain_trees_ignore_it(
    plants: ArticulationSolver, fruit: ArticulationSolver
) -> None:
    plants.refine(np.arange(4))
    plants.coarsen(2)
    assert not plants.state.tree_fine.any()
    fruit.refine(np.array([0]))
    assert len(fruit.awake) == 0
    fruit.wake(0)
    step(fruit, 3)
    fruit.put_to_sleep(0)
    fruit.coarsen(0)
    assert len(fruit.awake) == 0


def test_a_touch_on_what_rides_is_refused(fruit: ArticulationSolver) -> None:
    fruit.wake(0)
    fruit.predict()
    cluster = int(fruit.model.bunch_cluster[0])
    with pytest.raises(ValueError, match=rf"body {cluster} is touched, but tree 0 is coarse .* or refine the tree"):
        fruit.integrate(np.array([cluster]), np.zeros((1, 6)))
    fruit.refine(0)
    fruit.predict()
    assert fruit.impulse_response(np.array([cluster])).any()


def test_a_picked_bunch_stays_light_however_it_is_seen(fruit: ArticulationSolver) -> None:
    body = int(fruit.model.bunch_body[0])
    inertia = fruit.body_inertia[body].copy()
    fruit.set_mass(body, 0.001)
    np.testing.assert_allclose(fruit.body_inertia[body], inertia * 0.002, rtol=1e-5)
    fruit.refine(0)
    bodies = [body, *range(fruit.model.bunch_cluster[0], fruit.model.bunch_cluster[0] + 5)]
    assert fruit.body_mass[bodies].sum() == pytest.approx(0.001, rel=1e-5)
    fruit.set_mass(body, 0.002)
    fruit.coarsen(0)
    assert fruit.body_mass[body] == pytest.approx(0.002, rel=1e-5)
    np.testing.assert_allclose(fruit.body_inertia[body], inertia * 0.004, rtol=1e-5)


def test_a_fine_state_is_taken_over() -> None:
    model = clustered(1)
    state = State.at_rest(model)
    state.tree_fine[0] = True
    plants = ArticulationSolver(model, state)
    assert plants.body_mass[model.bunch_body[0]] == pytest.approx(0.05)
    plants.wake(0)
    plants.predict()
    assert plants.impulse_response(model.bunch_cluster[:1]).any()


# ---- cutting


def test_cutting_leaves_pose_velocity_and_numbers(plants: ArticulationSolver) -> None:
    stir(plants)
    state = plants.state
    plants.put_to_sleep(1)
    pose, speed = state.body_q.copy(), state.body_qd.copy()
    plants.cut(7)
    assert plants.awake.tolist() == [0, 1, 2, 3]
    assert np.flatnonzero(state.body_cut).tolist() == [7]
    plants.forward_kinematics()
    np.testing.assert_allclose(state.body_q, pose, atol=1e-6)
    np.testing.assert_allclose(state.body_qd, speed, atol=1e-6)
    step(plants, 50)
    plants.forward_kinematics()
    drop = state.body_q[5:10, 2] - pose[5:10, 2]
    assert (drop[2:] < -1.0).all()
    assert np.abs(drop[:2]).max() < 0.01
    assert not plants.joint_wrench(np.array([7])).any()
    plants.put_to_sleep(1)
    assert not state.joint_xd.any()


def test_a_stump_moves_as_if_it_had_grown_that_way() -> None:
    """What is left of a cane after a cut is, bit for bit, a cane that never had more."""
    whole, short = canes(1), canes(1)
    plants = ArticulationSolver(whole, State.at_rest(whole))
    plants.wake(0)
    plants.state.joint_qd[:, 1] = 1.0
    plants.forward_kinematics()
    plants.cut(3)
    short = Model(**{name: getattr(whole, name).copy() for name in Model.array_fields()})
    for name, dim in Model.array_fields().items():
        if dim.shape[0] == "body":
            setattr(short, name, getattr(whole, name)[:3].copy())
    short.tree_size[:] = short.tree_core[:] = 3
    state = State.at_rest(short)
    state.joint_q[:], state.joint_qd[:] = plants.state.joint_q[:3], plants.state.joint_qd[:3]
    twin = ArticulationSolver(short, state)
    twin.wake(0)
    for _ in range(100):
        step(plants)
        step(twin)
    np.testing.assert_array_equal(plants.state.joint_q[:3], state.joint_q)


def test_cuts_of_cuts_of_roots_and_of_bunches(fruit: ArticulationSolver) -> None:
    state, model = fruit.state, fruit.model
    fruit.wake(np.arange(3))
    fruit.cut(4)
    fruit.cut(2)  # nearer to the root, after the other
    bunch, size = int(model.bunch_body[1]), int(model.tree_size[0])
    fruit.cut(bunch)
    fruit.cut(2 * size)  # a whole tree
    step(fruit, 30)
    fruit.refine(1)
    step(fruit, 30)
    fruit.forward_kinematics()
    fallen = state.body_q[:, 2] < 1.5
    first = fruit.model.tree_first
    assert not fallen[:2].any()
    assert fallen[2:size].all()  # the bunch's stalk was on piece 4
    at_one = np.arange(first[1], first[2])
    hanging = np.isin(at_one, [bunch, *range(model.bunch_cluster[1], model.bunch_cluster[1] + 5)])
    np.testing.assert_array_equal(fallen[at_one], hanging)
    assert fallen[2 * size :].all()
    again = ArticulationSolver(model, state)  # the cuts are in the state
    np.testing.assert_array_equal(again.joint_stiffness, fruit.joint_stiffness)
    step(fruit)
    before = state.copy()
    fruit.forward_kinematics()
    pose = state.body_q.copy()
    for name in State.array_fields():
        getattr(state, name)[:] = getattr(before, name)
    again.forward_kinematics()
    np.testing.assert_array_equal(state.body_q, pose)


def test_what_cannot_be_cut_is_refused_in_words(fruit: ArticulationSolver) -> None:
    fruit.cut(3)
    with pytest.raises(ValueError, match="body 3 of tree 0 has been cut off already"):
        fruit.cut(3)
    with pytest.raises(ValueError, match=r"body 99 cannot be cut off: there are 48, counted from 0"):
        fruit.cut(99)
    cluster = int(fruit.model.bunch_cluster[0])
    with pytest.raises(ValueError, match=rf"body {cluster} of tree 0 is a berry cluster; cut off its bunch"):
        fruit.cut(cluster)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"tree_core": 0}, r"tree 1: tree_core 0 of 16 bodies; give 1 to tree_size \(all\)"),
        ({"tree_core": 17}, r"tree 1: tree_core 17 of 16 bodies"),
        ({"tree_core": 10}, r"body 26 of tree 1 is behind its core, but no bunch's cluster"),
        ({"tree_core": 12}, r"bunch 1: clusters 27 to 31 are not behind the core of a tree"),
        ({"bunch_cluster": 30}, r"bunch 1: clusters 30 to 34 are not behind the core"),
        ({"bunch_cluster": 11}, r"bunch 1: clusters 11 to 15 are also bunch 0's; give each bunch its own"),
        ({"bunch_body": 25}, r"bunch 1: cluster 27 hangs on body 26; hang it on the bunch, body 25"),
        ({"bunch_head_mass": 0.0}, r"bunch 1: its head has mass 0.0 kg"),
        ({"bunch_head_mass": 0.2}, r"bunch 1: head and clusters weigh 0.65 kg, its body 0.5 kg"),
    ],
)
def test_wrong_clusters_are_refused_in_words(change: dict[str, float], says: str) -> None:
    model = clustered(2)
    state = State.at_rest(model)
    for name, value in change.items():
        getattr(model, name)[1] = value
    with pytest.raises(ValueError, match=says):
        ArticulationSolver(model, state)


def grove(rng: np.random.Generator, count: int = 7) -> Model:
    """Trees of unlike size: the shares of threads and the rows of a device's copies are uneven."""
    trees = []
    for i in range(count):
        tree = TreeBuilder(frames.pose(np.array([0.0, i, 2.0])))
        rod = tree.add_rod(-1, 0.5, (0.004, 0.003), RodMaterial(5e9, 800.0, 0.01), int(rng.integers(2, 9)))
        tree.add_rod(
            rod[1], 0.3, (0.003, 0.002), RodMaterial(5e9, 800.0, 0.01), 3, rest=frames.exp(np.array([0.0, 0.4, 0.9]))
        )
        tree.solve_rest_pose()
        trees.append(tree)
    return assemble(trees)


def eventful(**options: object) -> tuple[list[bytes], np.ndarray]:
    """Trees are pushed, loaded, woken, reweighed, pulled, cut and put to rest: what was told, and a response."""
    rng = np.random.default_rng(5)
    model = grove(rng)
    plants = ArticulationSolver(model, State.at_rest(model), **options)
    state, first = plants.state, model.tree_first
    plants.wake(np.array([0, 2, 3, 5, 6]))
    state.joint_qd[:] = rng.normal(size=state.joint_qd.shape)
    plants.body_load[first[2]] = [0.0, 0.3, 0.0, 0.0, 0.0, 0.0]
    told = []
    for tick in range(12):
        if tick == 4:
            plants.wake(1)
            plants.set_mass(int(first[3]) + 1, 0.2)
        if tick == 9:
            plants.cut(int(first[6]) + 1)
        if tick == 7:
            plants.put_to_sleep(5)
            plants.blend_towards(0, model.joint_settled[model.bodies_of(0)], np.zeros((model.tree_size[0], 3)), 0.5)
        plants.predict()
        told += [x.tobytes() for x in (state.body_q, state.body_qd, plants.velocity_free, plants.phi_used)]
        if 3 <= tick < 6:
            bodies = np.array([first[0] + 1, first[6] + 2])
            response = plants.impulse_response(bodies)
            plants.integrate(bodies, rng.normal(size=(2, 6)))
            told += [plants.joint_wrench(bodies).tobytes()]
        else:
            plants.integrate()
        told += [x.tobytes() for x in (state.joint_q, state.joint_qd, plants.acceleration, plants.tree_rate)]
    plants.upload()
    plants.advance(5)
    plants.download()
    plants.forward_kinematics()
    told += [x.tobytes() for x in (state.joint_q, state.joint_qd, state.joint_x, state.body_q, plants.acceleration)]
    return told, response


def test_threads_and_copies_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vinesim.physics.plants.step_runner.MIN_TREES_PER_THREAD", 0)
    monkeypatch.setattr("vinesim.physics.plants.step_runner.MIN_INTEGRATED_TREES_PER_THREAD", 0)
    alone, response = eventful()
    copies = [{"buffers": DeviceBuffers("cpu", interleave=lanes)} for lanes in (1, 3)]
    for options in ({"threads": 2}, {"threads": 3}, *copies):
        told, seen = eventful(**options)
        assert told == alone, options
        np.testing.assert_array_equal(seen, response)


def test_advance_is_free_and_commit_many_times() -> None:
    runs = []
    for together in (False, True):
        model = grove(np.random.default_rng(2))
        plants = ArticulationSolver(model, State.at_rest(model), threads=2)
        plants.wake(np.arange(6))
        plants.state.joint_qd[:, 1] = 0.5
        step(plants)
        plants.predict()
        plants.integrate(np.array([3]), np.array([[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]]))
        if together:
            plants.upload()
            plants.advance(30)
            plants.download()
        else:
            step(plants, 30)
        runs.append((plants.tick, plants.state.joint_q.tobytes(), plants.velocity_free.tobytes()))
    assert runs[0] == runs[1]


def test_shares_hold_like_numbers_of_bodies() -> None:
    model = grove(np.random.default_rng(3), 40)
    plants = ArticulationSolver(model, State.at_rest(model), threads=3)
    plants.wake(np.arange(1, 40))
    plants.predict()
    ends, trees = plants._runner.partition_ends, np.arange(1, 40)
    assert (ends[0], ends[-1]) == (0, 39)
    shares = [int(model.tree_size[trees[a:b]].sum()) for a, b in itertools.pairwise(ends)]
    assert max(shares) - min(shares) <= 2 * model.tree_size.max()


def test_threads_end_with_their_plants() -> None:
    gc.collect()
    before = set(threading.enumerate())
    model = canes(1)
    plants = ArticulationSolver(model, State.at_rest(model), threads=3)
    crew = set(threading.enumerate()) - before
    assert len(crew) == 2
    del plants
    gc.collect()
    for thread in crew:
        thread.join(10.0)
        assert not thread.is_alive()


def test_devices_that_are_not_there_are_refused_in_words() -> None:
    model = canes(1)
    with pytest.raises(DeviceUnavailable, match="device 'tpu': give cpu, cuda or cuda:N"):
        ArticulationSolver(model, State.at_rest(model), device="tpu")
    with pytest.raises(ValueError, match="0 threads on cpu"):
        ArticulationSolver(model, State.at_rest(model), threads=0)
    if wp.get_cuda_device_count() == 0:
        with pytest.raises(DeviceUnavailable, match=r"'cuda': Warp sees no NVIDIA GPU here .* use cpu") as refused:
            ArticulationSolver(model, State.at_rest(model), device="cuda")
        assert refused.value.exit_code == 3


@pytest.mark.gpu
@pytest.mark.skipif(wp.get_cuda_device_count() == 0, reason="needs an NVIDIA GPU; benchmarks/gpu.py holds one to this")
def test_a_gpu_agrees_with_the_cpu() -> None:
    cpu, near = eventful()
    gpu, far = eventful(device="cuda")
    np.testing.assert_allclose(far, near, rtol=1e-3, atol=1e-3 * abs(near).max())
    for a, b in zip(cpu, gpu, strict=True):
        np.testing.assert_allclose(np.frombuffer(b, np.float32), np.frombuffer(a, np.float32), atol=2e-2, rtol=1e-2)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"tie_body": 99}, r"tie 1 on body 99: there are 10 bodies, counted from 0"),
        ({"tie_body": -1}, r"tie 1 on body -1: there are 10 bodies"),
        ({"tie_body": 1}, r"tie 1 on body 1: it stands behind a tie of a later body; sort ties by body"),
        ({"tie_stiffness": -1.0}, r"tie 1 on body 4: stiffness below 0 N/m; a spring pulls back"),
        ({"tie_damping": -1.0}, r"tie 1 on body 4: damping below 0 N s/m; a damper takes energy"),
        ({"tie_anchor": np.nan}, r"Model.tie_anchor\[1, 0\] is not finite"),
        ({"body_drag": -0.1}, r"body 1 of tree 0: drag area \[m\^2\] -0.1.*; air holds back"),
    ],
)
def test_wrong_ties_and_drag_are_refused_in_words(change: dict[str, float], says: str) -> None:
    tree = TreeBuilder(frames.pose(np.zeros(3)))
    tree.add_rod(-1, 1.0, (0.004, 0.004), RodMaterial(5e9, 800.0), 10)
    model = assemble([tree], tie_body=[3, 4], tie_point=np.zeros((2, 3)), tie_stiffness=[10.0, 10.0])
    state = State.at_rest(model)
    for name, value in change.items():
        getattr(model, name)[1] = value
    with pytest.raises(ValueError, match=says):
        ArticulationSolver(model, state)


def test_a_cluster_is_not_tied() -> None:
    model = clustered(1)
    ties = Model.allocate(**(model.counts() | {"tie": 1}))
    for name in Model.array_fields():
        if not name.startswith("tie_"):
            setattr(ties, name, getattr(model, name))
    ties.tie_body[0] = model.bunch_cluster[0]
    with pytest.raises(ValueError, match="a berry cluster cannot be tied; tie its bunch"):
        ArticulationSolver(ties, State.at_rest(ties))


def test_a_bad_pose_of_a_cut_tree_is_stopped(plants: ArticulationSolver) -> None:
    guard = FaultGuard(plants)
    plants.wake(np.arange(4))
    plants.cut(7)
    plants.state.joint_x[7, 1] = np.nan
    step(plants)
    assert guard.stop_faulty_trees().tolist() == [1]
    plants.forward_kinematics(np.arange(4))
    assert np.isfinite(plants.state.body_q).all()
    plants.wake(1)
    step(plants, 5)
    assert len(guard.stop_faulty_trees()) == 0
    plants.state.joint_xd[7] = [0.0, 0.0, np.inf]
    step(plants)
    assert guard.stop_faulty_trees().tolist() == [1]
    assert not plants.state.joint_xd[7].any()
