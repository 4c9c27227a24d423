from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import warp as wp

from tests.support.clustered_trees import clustered, momenta, moving
from vinesim.core import frames
from vinesim.kernels.graph import TIERS
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.device_buffers import DeviceBuffers, DeviceUnavailable
from vinesim.plants.fault_guard import FaultGuard
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


def test_the_drawn_pose_is_an_equilibrium(plants: ArticulationSolver) -> None:
    drawn = plants.state.body_q.copy()
    plants.wake(np.arange(4))
    step(plants, 200)
    plants.forward_kinematics()
    np.testing.assert_allclose(plants.state.body_q, drawn, atol=2e-5)


def test_kinematics_follow_writes_to_the_state(plants: ArticulationSolver) -> None:
    state = plants.state
    rng = np.random.default_rng(1)
    state.joint_q[:] = frames.exp(rng.normal(size=(20, 3)))
    state.joint_qd[:] = rng.normal(size=(20, 3))
    plants.forward_kinematics(np.arange(4))
    np.testing.assert_allclose(state.body_q, plants.model.forward_kinematics(state.joint_q), atol=2e-6)
    ahead = state.joint_q.astype(float)
    h = 1e-5
    remaining = plants.model.forward_kinematics(frames.multiply(frames.exp(h * state.joint_qd.astype(float)), ahead))
    here = plants.model.forward_kinematics(ahead)
    np.testing.assert_allclose(state.body_qd[:, :3], (remaining - here)[:, :3] / h, atol=1e-3)
    turn = frames.log(frames.multiply(remaining[:, 3:], frames.conjugate(here[:, 3:]))) / h
    np.testing.assert_allclose(state.body_qd[:, 3:], turn, atol=1e-3)


def test_awake_trees_are_sorted_and_sleeping_ones_unchanged(plants: ArticulationSolver) -> None:
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


def test_a_wrench_on_a_sleeping_tree_is_refused(plants: ArticulationSolver) -> None:
    plants.wake(np.array([0, 2]))
    plants.predict()
    plants.wake(1)  # too late for this step
    with pytest.raises(ValueError, match=r"body 7 is touched, but tree 1 slept: wake it before predict\(\)"):
        plants.integrate(np.array([2, 7]), np.zeros((2, 6)))
    with pytest.raises(ValueError, match=r"body 15 .* tree 3"):
        plants.impulse_response(np.array([15]))


def test_a_tree_put_to_sleep_between_predict_and_integrate_stays(plants: ArticulationSolver) -> None:
    plants.wake(np.array([0, 1]))
    plants.state.joint_qd[:, 1] = 1.0
    plants.predict()
    plants.put_to_sleep(0)
    before = plants.state.joint_q[:5].copy()
    plants.integrate()
    np.testing.assert_array_equal(plants.state.joint_q[:5], before)
    assert not plants.state.joint_qd[:5].any()


def test_wrenches_on_one_body_add_up_and_last_one_tick() -> None:
    model = canes(1)
    runs = []
    for bodies, wrenches in (
        ([4], [[1.0, 2.0, 3.0, 0.1, 0.0, 0.0]]),
        ([4] * 500, [[1.0, 2.0, 3.0, 0.1, 0.0, 0.0], *np.zeros((499, 6)).tolist()]),  # more than there was room for
        ([4, 4], [[1.0, 0.0, 3.0, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.1, 0.0, 0.0]]),
    ):
        plants = ArticulationSolver(model, State.at_rest(model))
        plants.wake(0)
        plants.predict()
        plants.integrate(np.array(bodies), np.array(wrenches))
        rates = plants.state.joint_qd.copy()
        step(plants, 400)
        runs.append((rates, plants.tree_rate[0]))
    for rates, _ in runs[1:]:
        np.testing.assert_allclose(runs[0][0], rates, rtol=1e-6)
    assert np.abs(runs[0][0]).max() > 0.1
    assert runs[0][1] < 0.01  # the wrench acted for one tick


def test_a_steady_load_bends_by_the_beam_formula() -> None:
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


def test_impulse_response_of_no_body_and_of_many(plants: ArticulationSolver) -> None:
    plants.wake(np.arange(4))
    plants.predict()
    assert plants.impulse_response(np.zeros(0, np.int32)).shape == (0, 6, 0, 6)
    single = plants.impulse_response(np.array([7]))
    many = plants.impulse_response(np.arange(20))
    assert many.shape == (20, 6, 20, 6)
    np.testing.assert_array_equal(many[7, :, 7], single[0, :, 0])
    flat = many.reshape(120, 120)
    np.testing.assert_array_equal(flat, flat.T)
    assert np.linalg.eigvalsh(flat.astype(float)).min() > -1e-4 * np.abs(flat).max()
    assert not many[0, :, 5:].any()


def test_phi_is_1_after_contact_begins_and_in_fast_motion(plants: ArticulationSolver) -> None:
    plants.wake(np.arange(2))
    used = plants.phi_used
    step(plants)
    assert used[:2].tolist() == pytest.approx([0.55, 0.55])
    measured = []
    for _ in range(6):  # a lasting contact begins
        plants.predict()
        measured.append(float(used[0]))
        plants.integrate(np.array([2]), np.array([[0.0, 0.0, 0.01, 0.0, 0.0, 0.0]]))
        assert used[1] == pytest.approx(0.55)
    assert measured == pytest.approx([0.55] + [1.0] * 3 + [0.55] * 2)
    plants.state.joint_qd[6, 0] = 6.0
    plants.predict()
    assert used[1] == 1.0


def test_blend_towards_moves_by_the_blend_weight(plants: ArticulationSolver) -> None:
    rng = np.random.default_rng(2)
    state = plants.state
    bodies = plants.model.bodies_of(2)
    start = state.joint_q[bodies].copy()
    goal = frames.exp(rng.normal(size=(5, 3)) * 0.5)
    rates = rng.normal(size=(5, 3))
    plants.blend_towards(2, -3.0 * goal, rates, 0.25)  # sign and length of a quaternion do not matter
    np.testing.assert_allclose(state.joint_qd[bodies], rates, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(state.joint_q[bodies], axis=-1), 1.0, atol=1e-6)
    total = frames.log(frames.multiply(frames.conjugate(start), goal))
    moved = frames.log(frames.multiply(frames.conjugate(start), state.joint_q[bodies]))
    np.testing.assert_allclose(moved, 0.25 * total, atol=1e-5)
    plants.blend_towards(2, goal, rates, 1.0)
    remaining = frames.multiply(frames.conjugate(goal), state.joint_q[bodies])
    np.testing.assert_allclose(frames.log(remaining), 0.0, atol=1e-5)
    with pytest.raises(ValueError, match="tree 2: pulled to a pose that is not finite"):
        plants.blend_towards(2, np.full((5, 4), np.nan), rates, 0.5)
    with pytest.raises(ValueError, match=r"tree 2: .* it has 5 bodies"):
        plants.blend_towards(2, goal[:4], rates, 0.5)


def test_a_lighter_body_sags_less(plants: ArticulationSolver) -> None:
    plants.wake(0)
    plants.set_mass(4, plants.body_mass[4] / 10)
    before = plants.state.body_q[4, 2]
    step(plants, 300)
    plants.forward_kinematics()
    assert plants.state.body_q[4, 2] > before + 1e-5
    assert plants.model.body_mass[4] > 5 * plants.body_mass[4]  # the model is shared and constant


@pytest.mark.parametrize(
    ("name", "value", "message"),
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
def test_an_invalid_model_is_refused_with_the_reason(name: str, value: float, message: str) -> None:
    model = canes(2)
    state = State.at_rest(model)
    getattr(model, name)[6] = value
    with pytest.raises(ValueError, match=message):
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


# ---- levels of detail


@pytest.fixture
def clustered_plants() -> ArticulationSolver:
    """Three canes with clustered bunches and one plain."""
    model = clustered(3)
    return ArticulationSolver(model, State.at_rest(model))


def carried_bodies(plants: ArticulationSolver, joint: int) -> np.ndarray:
    """Indices of the moving bodies that a joint carries."""
    bodies = moving(plants, plants.model.body_tree[[joint]])
    up = bodies.copy()
    while (up > joint).any():
        up = np.where(up > joint, plants.model.body_parent[up], up)
    return bodies[up == joint]


def excite(plants: ArticulationSolver, rate: float = 2.0) -> None:
    """Random rates in every joint that moves."""
    rng = np.random.default_rng(3)
    state = plants.state
    plants.wake(np.arange(len(plants.model.tree_first)))
    bodies = moving(plants, np.arange(len(plants.model.tree_first)))
    state.joint_q[bodies] = frames.multiply(frames.exp(rng.normal(size=(len(bodies), 3)) * 0.1), state.joint_q[bodies])
    state.joint_qd[bodies] = rng.normal(size=(len(bodies), 3)) * rate
    plants.forward_kinematics()


def test_clusters_of_a_coarse_tree_move_with_their_bunch(clustered_plants: ArticulationSolver) -> None:
    model = clustered_plants.model
    state = clustered_plants.state
    excite(clustered_plants)
    joint_q_before = state.joint_q.copy()
    step(clustered_plants, 20)
    clustered_plants.forward_kinematics()
    clusters = np.setdiff1d(np.arange(len(joint_q_before)), moving(clustered_plants, np.arange(3)))
    assert len(clusters) == 15
    np.testing.assert_array_equal(state.joint_q[clusters], joint_q_before[clusters])
    np.testing.assert_allclose(state.body_q, model.forward_kinematics(state.joint_q), atol=3e-6)
    cluster = model.bunch_cluster[1]
    bunch = model.bunch_body[1]
    offset = state.body_q[cluster, :3] - state.body_q[bunch, :3]
    velocity = state.body_qd[bunch, :3] + np.cross(state.body_qd[bunch, 3:], offset)
    np.testing.assert_allclose(state.body_qd[cluster], [*velocity, *state.body_qd[bunch, 3:]], atol=1e-5)


def test_refining_keeps_pose_velocity_and_momentum(clustered_plants: ArticulationSolver) -> None:
    state = clustered_plants.state
    model = clustered_plants.model
    excite(clustered_plants)
    step(clustered_plants, 5)
    clustered_plants.forward_kinematics()
    pose = state.body_q.copy()
    speed = state.body_qd.copy()
    joints = np.arange(*model.bodies_of(1).indices(99))[:-5]
    before = [momenta(clustered_plants, carried_bodies(clustered_plants, j), pose[j, :3].astype(float)) for j in joints]
    clustered_plants.refine(np.array([1, 2]))
    clustered_plants.refine(1)
    assert state.tree_fine.tolist() == [False, True, True]
    np.testing.assert_array_equal(state.body_q, pose)
    np.testing.assert_array_equal(state.body_qd, speed)
    for joint, (linear, angular, center, energy) in zip(joints, before, strict=True):
        after = momenta(clustered_plants, carried_bodies(clustered_plants, joint), pose[joint, :3].astype(float))
        np.testing.assert_allclose(after[0], linear, atol=2e-6 * np.abs(linear).max())
        np.testing.assert_allclose(after[1], angular, atol=2e-6 * np.abs(angular).max())
        np.testing.assert_allclose(after[2], center, atol=1e-6)
        assert after[3] == pytest.approx(energy, rel=2e-6)


def test_coarsening_keeps_pose_and_momentum_and_never_adds_energy(clustered_plants: ArticulationSolver) -> None:
    """A bunch keeps its angular momentum about its origin; other trees are unchanged."""
    state = clustered_plants.state
    model = clustered_plants.model
    clustered_plants.refine(np.arange(3))
    excite(clustered_plants, 4.0)
    pose = state.body_q.copy()
    joint_q = state.joint_q.copy()
    bunches = model.bunch_body[1:]
    before = [
        momenta(clustered_plants, carried_bodies(clustered_plants, j), pose[j, :3].astype(float)) for j in bunches
    ]
    energy = [momenta(clustered_plants, moving(clustered_plants, np.array([i])), np.zeros(3))[3] for i in (1, 2)]
    other = state.joint_qd[model.bodies_of(0)].copy()
    clustered_plants.coarsen(np.array([1, 2]))
    assert state.tree_fine.tolist() == [True, False, False]
    np.testing.assert_array_equal(state.body_q, pose)
    np.testing.assert_array_equal(state.joint_q, joint_q)
    np.testing.assert_array_equal(state.joint_qd[model.bodies_of(0)], other)
    for joint, (_, angular, center, _) in zip(bunches, before, strict=True):
        after = momenta(clustered_plants, carried_bodies(clustered_plants, joint), pose[joint, :3].astype(float))
        np.testing.assert_allclose(after[1], angular, atol=2e-6 * np.abs(angular).max())
        np.testing.assert_allclose(after[2], center, atol=1e-6)
    for i in (0, 1):
        assert momenta(clustered_plants, moving(clustered_plants, np.array([i + 1])), np.zeros(3))[3] < energy[i]


def test_coarsening_never_adds_energy() -> None:
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


def test_fine_and_coarse_trees_have_the_same_rest_pose() -> None:
    """A fine tree comes to rest, is coarsened, and stays within 0.1 mm; so does a coarse one that is refined."""
    model = clustered(2)
    plants = ArticulationSolver(model, State.at_rest(model))
    plants.refine(0)
    excite(plants, 1.0)
    for _ in range(100):  # stop it near every turning point
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
    """Cut at the root, or at the bunch."""
    model = clustered(1)
    plants = ArticulationSolver(model, State.at_rest(model))
    plants.refine(0)
    excite(plants)
    plants.cut(at)
    linear, angular, _, energy = momenta(plants, carried_bodies(plants, at), np.zeros(3))
    plants.coarsen(0)
    after = momenta(plants, carried_bodies(plants, at), np.zeros(3))
    np.testing.assert_allclose(after[0], linear, atol=2e-6 * np.abs(linear).max())
    np.testing.assert_allclose(after[1], angular, atol=2e-6 * np.abs(angular).max())
    assert after[3] < energy


def test_sleeping_trees_can_be_refined_and_plain_trees_ignore_it(
    plants: ArticulationSolver, clustered_plants: ArticulationSolver
) -> None:
    plants.refine(np.arange(4))
    plants.coarsen(2)
    assert not plants.state.tree_fine.any()
    clustered_plants.refine(np.array([0]))
    assert len(clustered_plants.awake) == 0
    clustered_plants.wake(0)
    step(clustered_plants, 3)
    clustered_plants.put_to_sleep(0)
    clustered_plants.coarsen(0)
    assert len(clustered_plants.awake) == 0


def test_a_wrench_on_a_cluster_of_a_coarse_tree_is_refused(clustered_plants: ArticulationSolver) -> None:
    clustered_plants.wake(0)
    clustered_plants.predict()
    cluster = int(clustered_plants.model.bunch_cluster[0])
    with pytest.raises(ValueError, match=rf"body {cluster} is touched, but tree 0 is coarse .* or refine the tree"):
        clustered_plants.integrate(np.array([cluster]), np.zeros((1, 6)))
    clustered_plants.refine(0)
    clustered_plants.predict()
    assert clustered_plants.impulse_response(np.array([cluster])).any()


def test_a_picked_bunch_stays_light_at_every_level_of_detail(clustered_plants: ArticulationSolver) -> None:
    body = int(clustered_plants.model.bunch_body[0])
    inertia = clustered_plants.body_inertia[body].copy()
    clustered_plants.set_mass(body, 0.001)
    np.testing.assert_allclose(clustered_plants.body_inertia[body], inertia * 0.002, rtol=1e-5)
    clustered_plants.refine(0)
    bodies = [body, *range(clustered_plants.model.bunch_cluster[0], clustered_plants.model.bunch_cluster[0] + 5)]
    assert clustered_plants.body_mass[bodies].sum() == pytest.approx(0.001, rel=1e-5)
    clustered_plants.set_mass(body, 0.002)
    clustered_plants.coarsen(0)
    assert clustered_plants.body_mass[body] == pytest.approx(0.002, rel=1e-5)
    np.testing.assert_allclose(clustered_plants.body_inertia[body], inertia * 0.004, rtol=1e-5)


def test_a_solver_accepts_a_fine_state() -> None:
    model = clustered(1)
    state = State.at_rest(model)
    state.tree_fine[0] = True
    plants = ArticulationSolver(model, state)
    assert plants.body_mass[model.bunch_body[0]] == pytest.approx(0.05)
    plants.wake(0)
    plants.predict()
    assert plants.impulse_response(model.bunch_cluster[:1]).any()


# ---- cutting


def test_cutting_keeps_pose_velocity_and_indices(plants: ArticulationSolver) -> None:
    excite(plants)
    state = plants.state
    plants.put_to_sleep(1)
    pose = state.body_q.copy()
    speed = state.body_qd.copy()
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


def test_a_stump_moves_like_a_shorter_cane() -> None:
    """The stump after a cut is bitwise equal to a cane built without the cut part."""
    total = canes(1)
    short = canes(1)
    plants = ArticulationSolver(total, State.at_rest(total))
    plants.wake(0)
    plants.state.joint_qd[:, 1] = 1.0
    plants.forward_kinematics()
    plants.cut(3)
    short = Model(**{name: getattr(total, name).copy() for name in Model.array_fields()})
    for name, dim in Model.array_fields().items():
        if dim.shape[0] == "body":
            setattr(short, name, getattr(total, name)[:3].copy())
    short.tree_size[:] = short.tree_core[:] = 3
    state = State.at_rest(short)
    state.joint_q[:], state.joint_qd[:] = plants.state.joint_q[:3], plants.state.joint_qd[:3]
    twin = ArticulationSolver(short, state)
    twin.wake(0)
    for _ in range(100):
        step(plants)
        step(twin)
    np.testing.assert_array_equal(plants.state.joint_q[:3], state.joint_q)


def test_cuts_of_cuts_of_roots_and_of_bunches(clustered_plants: ArticulationSolver) -> None:
    state = clustered_plants.state
    model = clustered_plants.model
    clustered_plants.wake(np.arange(3))
    clustered_plants.cut(4)
    clustered_plants.cut(2)  # nearer to the root than the cut before
    bunch = int(model.bunch_body[1])
    size = int(model.tree_size[0])
    clustered_plants.cut(bunch)
    clustered_plants.cut(2 * size)  # a whole tree
    step(clustered_plants, 30)
    clustered_plants.refine(1)
    step(clustered_plants, 30)
    clustered_plants.forward_kinematics()
    is_below = state.body_q[:, 2] < 1.5
    first = clustered_plants.model.tree_first
    assert not is_below[:2].any()
    assert is_below[2:size].all()  # the peduncle is attached to piece 4
    of_tree_1 = np.arange(first[1], first[2])
    hanging = np.isin(of_tree_1, [bunch, *range(model.bunch_cluster[1], model.bunch_cluster[1] + 5)])
    np.testing.assert_array_equal(is_below[of_tree_1], hanging)
    assert is_below[2 * size :].all()
    reloaded = ArticulationSolver(model, state)  # cuts are part of the state
    np.testing.assert_array_equal(reloaded.joint_stiffness, clustered_plants.joint_stiffness)
    step(clustered_plants)
    before = state.copy()
    clustered_plants.forward_kinematics()
    pose = state.body_q.copy()
    for name in State.array_fields():
        getattr(state, name)[:] = getattr(before, name)
    reloaded.forward_kinematics()
    np.testing.assert_array_equal(state.body_q, pose)


def test_an_invalid_cut_is_refused_with_the_reason(clustered_plants: ArticulationSolver) -> None:
    clustered_plants.cut(3)
    with pytest.raises(ValueError, match="body 3 of tree 0 has been cut off already"):
        clustered_plants.cut(3)
    with pytest.raises(ValueError, match="body 99 does not exist; give 0 to 47"):
        clustered_plants.cut(99)
    cluster = int(clustered_plants.model.bunch_cluster[0])
    with pytest.raises(ValueError, match=rf"body {cluster} of tree 0 is a berry cluster; cut off its bunch"):
        clustered_plants.cut(cluster)


@pytest.mark.parametrize(
    ("change", "message"),
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
def test_invalid_clusters_are_refused_with_the_reason(change: dict[str, float], message: str) -> None:
    model = clustered(2)
    state = State.at_rest(model)
    for name, value in change.items():
        getattr(model, name)[1] = value
    with pytest.raises(ValueError, match=message):
        ArticulationSolver(model, state)


def trees_of_different_size(rng: np.random.Generator, count: int = 7) -> Model:
    """Trees of different sizes, so that rows of device buffers are uneven."""
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


def run_with_events(**options: object) -> tuple[list[bytes], np.ndarray]:
    """Trees are pushed, loaded, woken, reweighed, pulled, cut and put to sleep: all arrays, and a response."""
    rng = np.random.default_rng(5)
    model = trees_of_different_size(rng)
    plants = ArticulationSolver(model, State.at_rest(model), **options)
    state = plants.state
    first = model.tree_first
    plants.wake(np.array([0, 2, 3, 5, 6]))
    state.joint_qd[:] = rng.normal(size=state.joint_qd.shape)
    plants.body_load[first[2]] = [0.0, 0.3, 0.0, 0.0, 0.0, 0.0]
    arrays = []
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
        arrays += [x.tobytes() for x in (state.body_q, state.body_qd, plants.velocity_free, plants.phi_used)]
        if 3 <= tick < 6:
            bodies = np.array([first[0] + 1, first[6] + 2])
            response = plants.impulse_response(bodies)
            plants.integrate(bodies, rng.normal(size=(2, 6)))
            arrays += [plants.joint_wrench(bodies).tobytes()]
        else:
            plants.integrate()
        arrays += [x.tobytes() for x in (state.joint_q, state.joint_qd, plants.acceleration, plants.tree_rate)]
    plants.upload()
    plants.advance(5)
    plants.download()
    plants.forward_kinematics()
    arrays += [x.tobytes() for x in (state.joint_q, state.joint_qd, state.joint_x, state.body_q, plants.acceleration)]
    return arrays, response


def filled_with_nan(make: Callable[..., wp.array]) -> Callable[..., wp.array]:
    def made(*arguments: object, **options: object) -> wp.array:
        array = make(*arguments, **options)
        values = array.numpy()
        if values.dtype.kind == "f":
            values[...] = np.nan
        return array

    return made


def test_device_buffers_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("empty", "empty_like"):  # whatever reads memory before it is written shall show
        monkeypatch.setattr(wp, name, filled_with_nan(getattr(wp, name)))
    in_place, response = run_with_events()
    copies = [{"buffers": DeviceBuffers("cpu", interleave=lanes)} for lanes in (1, 3)]
    for options in copies:
        arrays, measured = run_with_events(**options)
        assert arrays == in_place, options
        np.testing.assert_array_equal(measured, response)


@pytest.mark.parametrize("in_one_call", [False, True])
def test_more_trees_than_a_graph_has_room_for_move_as_one_does(in_one_call: bool) -> None:
    """Their steps are divided into substeps. The fault of the last tree is seen."""
    moved = []
    for count in (1, TIERS[0] + 6):
        model = canes(count)
        plants = ArticulationSolver(model, State.at_rest(model))
        plants.wake(np.arange(count))
        plants.state.joint_qd[:, 1] = np.tile(np.linspace(0.0, 2.0, 5), count)
        if in_one_call:
            plants.advance(20)
        else:
            step(plants, 20)
        assert (plants.tree_substeps > 1).all()
        moved.append(plants.state.joint_q[-5:].copy())
        plants.state.joint_qd[-1] = np.nan
        step(plants)
        assert plants.fastest_rate() == np.inf
        assert FaultGuard(plants).stop_faulty_trees().tolist() == [count - 1]
    np.testing.assert_array_equal(moved[0], moved[1])


def test_advance_equals_repeated_predict_and_integrate() -> None:
    runs = []
    for in_one_call in (False, True):
        model = trees_of_different_size(np.random.default_rng(2))
        plants = ArticulationSolver(model, State.at_rest(model))
        plants.wake(np.arange(6))
        plants.state.joint_qd[:, 1] = 0.5
        step(plants)
        plants.predict()
        plants.integrate(np.array([3]), np.array([[0.0, 1.0, 0.0, 0.0, 0.0, 0.0]]))
        if in_one_call:
            plants.upload()
            plants.advance(30)
            plants.download()
        else:
            step(plants, 30)
        runs.append((plants.tick, plants.state.joint_q.tobytes(), plants.velocity_free.tobytes()))
    assert runs[0] == runs[1]


def test_unavailable_devices_are_refused_with_the_reason() -> None:
    model = canes(1)
    with pytest.raises(DeviceUnavailable, match="device 'tpu': give cpu, cuda or cuda:N"):
        ArticulationSolver(model, State.at_rest(model), device="tpu")
    if wp.get_cuda_device_count() == 0:
        with pytest.raises(DeviceUnavailable, match=r"'cuda': Warp finds no NVIDIA GPU here .* use cpu") as error:
            ArticulationSolver(model, State.at_rest(model), device="cuda")
        assert error.value.exit_code == 3


@pytest.mark.gpu
@pytest.mark.skipif(wp.get_cuda_device_count() == 0, reason="needs an NVIDIA GPU; benchmarks/gpu.py holds one to this")
def test_a_gpu_agrees_with_the_cpu() -> None:
    cpu, cpu_response = run_with_events()
    gpu, gpu_response = run_with_events(device="cuda")
    np.testing.assert_allclose(gpu_response, cpu_response, rtol=1e-3, atol=1e-3 * abs(cpu_response).max())
    for a, b in zip(cpu, gpu, strict=True):
        np.testing.assert_allclose(np.frombuffer(b, np.float32), np.frombuffer(a, np.float32), atol=2e-2, rtol=1e-2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tie_body": 99}, r"tie 1 on body 99: there are 10 bodies, counted from 0"),
        ({"tie_body": -1}, r"tie 1 on body -1: there are 10 bodies"),
        ({"tie_body": 1}, r"tie 1 on body 1: it stands behind a tie of a later body; sort ties by body"),
        ({"tie_stiffness": -1.0}, r"tie 1 on body 4: stiffness below 0 N/m; a spring pulls back"),
        ({"tie_damping": -1.0}, r"tie 1 on body 4: damping below 0 N s/m; a damper takes energy"),
        ({"tie_wire": 0}, r"tie 1 on body 4: wire of 0 fixed pieces, counted from 0; give one of them, or -1 for none"),
        ({"tie_anchor": np.nan}, r"Model.tie_anchor\[1, 0\] is not finite"),
        ({"body_drag": -0.1}, r"body 1 of tree 0: drag area \[m\^2\] -0.1.*; air holds back"),
    ],
)
def test_invalid_ties_and_drag_are_refused_with_the_reason(change: dict[str, float], message: str) -> None:
    tree = TreeBuilder(frames.pose(np.zeros(3)))
    tree.add_rod(-1, 1.0, (0.004, 0.004), RodMaterial(5e9, 800.0), 10)
    model = assemble([tree], tie_body=[3, 4], tie_point=np.zeros((2, 3)), tie_stiffness=[10.0, 10.0])
    state = State.at_rest(model)
    for name, value in change.items():
        getattr(model, name)[1] = value
    with pytest.raises(ValueError, match=message):
        ArticulationSolver(model, state)


def test_a_tie_on_a_cluster_is_refused() -> None:
    model = clustered(1)
    ties = Model.allocate(**(model.counts() | {"tie": 1}))
    for name in Model.array_fields():
        if not name.startswith("tie_"):
            setattr(ties, name, getattr(model, name))
    ties.tie_body[0] = model.bunch_cluster[0]
    with pytest.raises(ValueError, match="a berry cluster cannot be tied; tie its bunch"):
        ArticulationSolver(ties, State.at_rest(ties))


def test_a_non_finite_pose_of_a_cut_tree_is_a_fault(plants: ArticulationSolver) -> None:
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
