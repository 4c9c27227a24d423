"""Forked trees in space against MuJoCo and conservation laws, and for determinism."""

from __future__ import annotations

import hashlib

import mujoco
import numpy as np
import pytest

from tests.support.clustered_trees import fall, momenta
from tests.support.long_rows import each_once
from vinesim.bench.mujoco_reference import compile_plants, copy_state_to_mujoco
from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import GRAVITY, RodMaterial, TreeBuilder, assemble
from vinesim.scene.model import Model
from vinesim.scene.state import State

pytestmark = pytest.mark.slow

DT = 0.01


def forked(rng: np.random.Generator, *, beta: float = 0.012, isotropic: bool = True, soft: float = 1.0) -> TreeBuilder:
    """Thirteen bodies with two forks and random, unaligned frames."""
    tree = TreeBuilder(np.concatenate([rng.normal(size=3), frames.normalize(rng.normal(size=4))]))

    def grow(parent: int, count: int) -> list[int]:
        grown = []
        for _ in range(count):
            mass = rng.uniform(0.01, 0.05)
            stiffness = soft * rng.uniform(2.0, 20.0, 1 if isotropic else 3) * np.ones(3)
            parent = tree.add_body(
                parent,
                offset=(0.06, *rng.normal(size=2) * 0.004),
                rest=frames.exp(rng.normal(size=3) * 0.4),
                mass=mass,
                com=(0.03, 0.004, -0.003),
                inertia=mass * rng.uniform(5e-4, 9e-4, 3),
                length=0.06,
                stiffness=stiffness,
                damping=beta * stiffness,
            )
            grown.append(parent)
        return grown

    trunk = grow(-1, 6)
    branch = grow(trunk[2], 4)
    grow(branch[1], 3)
    return tree


def random_state(model: Model, rng: np.random.Generator, rate: float) -> State:
    state = State.at_rest(model)
    state.joint_q[:] = frames.exp(rng.normal(size=(len(state.joint_q), 3)) * 0.2)
    state.joint_qd[:] = frames.normalize(rng.normal(size=state.joint_qd.shape)) * rate
    return state


def awake(model: Model, state: State, **options: float) -> ArticulationSolver:
    plants = ArticulationSolver(model, state, dt=DT, **options)
    plants.wake(np.arange(len(model.tree_first)))
    return plants


def test_free_motion_in_space_is_mujocos() -> None:
    """Backward Euler is MuJoCo's ``discrete``: 1e-5 m over 1 s, 5 rad/s in every joint, very soft springs."""
    rng = np.random.default_rng(3)
    model = assemble([forked(rng), forked(rng, soft=0.1)])
    plants = awake(
        model, random_state(model, rng, 5.0), phi=1.0, geometric_stiffness=False, fast_rate=np.inf, max_rate=np.inf
    )
    # our solver subtracts the damping that its scheme adds; MuJoCo does not
    mj_model = compile_plants(model, dt=DT, damping=model.joint_damping[:, 1] - DT * model.joint_stiffness[:, 1])
    data = mujoco.MjData(mj_model)
    copy_state_to_mujoco(plants.state, data)
    worst = travelled = 0.0
    start = None
    for _ in range(100):
        plants.predict()
        mujoco.mj_kinematics(mj_model, data)
        start = plants.state.body_q[:, :3].copy() if start is None else start
        worst = max(worst, np.abs(data.xpos[1:] - plants.state.body_q[:, :3]).max())
        travelled = max(travelled, np.abs(plants.state.body_q[:, :3] - start).max())
        plants.integrate()
        mujoco.mj_step(mj_model, data)
    assert travelled > 0.1
    assert worst < 1e-5


@pytest.mark.parametrize("phi", [0.55, 1.0])
def test_response_is_mujocos_inverse_inertia(phi: float) -> None:
    """Y = J (M + metric)^-1 J^T with MuJoCo's J and M, metric = phi dt (phi dt K + D) in the joints' middle axes."""
    rng = np.random.default_rng(5)
    model = assemble([forked(rng, isotropic=False), forked(rng, isotropic=False)])
    plants = awake(model, random_state(model, rng, 1.0), phi=phi, geometric_stiffness=False)
    state = plants.state
    size = int(model.tree_size[0])
    touched = np.array([4, size + 12, 9, size + 3], np.int32)
    plants.predict()
    measured = plants.impulse_response(touched)

    mj_model = compile_plants(model, dt=DT)
    data = mujoco.MjData(mj_model)
    copy_state_to_mujoco(state, data)
    mujoco.mj_forward(mj_model, data)
    inertia = np.zeros((mj_model.nv, mj_model.nv))
    mujoco.mj_fullM(mj_model, data, inertia)
    stiffness = model.joint_stiffness.astype(float)
    damping = np.maximum(model.joint_damping - (2 * phi - 1) * DT * stiffness, 0.0)
    metric = phi * DT * (phi * DT * stiffness + damping)
    axes = frames.to_matrix(frames.exp(0.5 * frames.log(state.joint_q.astype(float))))
    for body in range(len(metric)):
        block = slice(3 * body, 3 * body + 3)
        inertia[block, block] += axes[body].T @ np.diag(metric[body]) @ axes[body]
    jacobian = np.zeros((len(touched), 6, mj_model.nv))
    for row, body in zip(jacobian, touched, strict=True):
        mujoco.mj_jacBody(mj_model, data, row[:3], row[3:], int(body) + 1)
    flat = jacobian.reshape(-1, mj_model.nv)
    expected = (flat @ np.linalg.solve(inertia, flat.T)).reshape(measured.shape)
    np.testing.assert_allclose(measured, expected, rtol=0, atol=1e-4 * np.abs(expected).max())
    blocks = np.linalg.norm(expected, axis=(1, 3))
    np.testing.assert_array_less(np.linalg.norm(measured - expected, axis=(1, 3)), 1e-4 * blocks + 1e-12)
    assert not measured[0, :, 1].any()  # different trees
    assert measured[0, :, 2].any()


def test_predicted_velocity_is_realised() -> None:
    """velocity_free + response @ impulse is the velocity after ``integrate``, at the poses of the step's start."""
    rng = np.random.default_rng(7)
    model = assemble([forked(rng, isotropic=False), forked(rng)])
    plants = awake(model, random_state(model, rng, 2.0), max_rate=np.inf)
    state = plants.state
    plants.predict()
    touched = np.array([5, 8, 20, 5], np.int32)  # one body twice
    wrenches = rng.normal(size=(4, 6)) * [1, 1, 1, 0.02, 0.02, 0.02]
    predicted = plants.velocity_free.astype(float)
    unique_bodies, which = np.unique(touched, return_inverse=True)
    impulse = np.zeros((len(unique_bodies), 6))
    np.add.at(impulse, which, wrenches * DT)
    predicted = predicted[unique_bodies] + np.einsum("uitj,tj->ui", plants.impulse_response(unique_bodies), impulse)
    before = state.joint_q.copy()
    plants.integrate(touched, wrenches)
    state.joint_q[:] = before
    plants.forward_kinematics()
    np.testing.assert_allclose(state.body_qd[unique_bodies], predicted, atol=1e-4, rtol=1e-4)


def energy(plants: ArticulationSolver) -> float:
    """Kinetic, potential and elastic energy [J], right after ``predict()``."""
    model = plants.model
    state = plants.state
    pose = state.body_q.astype(float)
    speed = state.body_qd.astype(float)
    com = frames.rotate(pose[:, 3:], model.body_com.astype(float))
    linear = speed[:, :3] + np.cross(speed[:, 3:], com)
    angular = frames.rotate(frames.conjugate(pose[:, 3:]), speed[:, 3:])
    theta = frames.log(state.joint_q.astype(float))
    kinetic = 0.5 * (model.body_mass @ (linear**2).sum(1) + (model.body_inertia * angular**2).sum())
    return kinetic - model.body_mass @ ((pose[:, :3] + com) @ GRAVITY) + 0.5 * (model.joint_stiffness * theta**2).sum()


def pendulum(stiffness: float = 0.0) -> TreeBuilder:
    """A bunch of 0.5 kg on a massless string of 15 cm, 17 degrees out."""
    tree = TreeBuilder(frames.pose(np.zeros(3), frames.from_x_axis(np.array([0.0, 0.0, -1.0]))))
    tree.add_body(-1, mass=0.5, com=(0.15, 0, 0), inertia=(1e-4, 3e-4, 3e-4), length=0.2, stiffness=[stiffness] * 3)
    return tree


@pytest.mark.parametrize(("phi", "loss"), [(0.5, 0.01), (0.55, 0.01)])
def test_a_hanging_bunch_gains_no_energy(phi: float, loss: float) -> None:
    """Undamped and without a spring, over 10 s: the energy stays within 1 %.

    With the weight's stiffness taken explicitly the same bunch has twenty times its energy by then.
    """
    model = assemble([pendulum()])
    rest = awake(model, State.at_rest(model))
    rest.predict()
    state = State.at_rest(model)
    state.joint_q[0] = frames.exp(np.array([0.0, 0.3, 0.0]))
    plants = awake(model, state, phi=phi)
    measured = []
    for _ in range(1000):
        plants.predict()
        measured.append(energy(plants) - energy(rest))
        plants.integrate()
    assert max(measured) < 1.01 * measured[0]
    assert min(measured) > (1.0 - loss) * measured[0]


def test_energy_of_an_undamped_cane() -> None:
    """phi 1/2, 60 s, swings below 1 rad/s: within 1 %."""
    tree = TreeBuilder(frames.pose(np.zeros(3)))
    tree.add_rod(-1, 1.0, (0.004, 0.004), RodMaterial(5e9, 800.0), 16)
    tree.solve_rest_pose()
    model = assemble([tree])
    rest = awake(model, State.at_rest(model), phi=0.5)
    rest.predict()
    plants = awake(model, State.at_rest(model), phi=0.5)
    plants.state.joint_qd[:, 1:] = np.array([0.5, 0.2]) / 16
    measured = []
    for _ in range(6000):
        plants.predict()
        measured.append(energy(plants) - energy(rest))
        plants.integrate()
    assert measured[0] > 1e-4
    assert np.mean(measured[-200:]) == pytest.approx(np.mean(measured[:200]), rel=0.01)


@pytest.mark.parametrize(("mass", "radius"), each_once([0.1, 0.5, 1.0], [0.0015, 0.0025]))
def test_a_heavy_bunch_on_a_thin_peduncle_is_stable(mass: float, radius: float) -> None:
    """Springs softer than the weight they carry, pulled by 60 N for a second and released: slow after 10 s."""
    tree = TreeBuilder(frames.pose(np.zeros(3), frames.from_x_axis(np.array([0.0, 0.0, -1.0]))))
    last = tree.add_rod(-1, 0.06, (radius, radius), RodMaterial(0.5e9, 900.0, 0.02), 3)[-1]
    spring = tree.bodies[last]
    bunch = tree.add_body(
        last,
        offset=(0.02, 0, 0),
        mass=mass,
        com=(0.08, 0, 0),
        inertia=np.array([1, 2, 2]) * 1e-3 * mass,
        length=0.16,
        stiffness=spring["stiffness"],
        damping=spring["damping"],
    )
    model = assemble([tree])
    state = State.at_rest(model)
    state.joint_q[0] = frames.exp(np.array([0.0, 0.3, 0.0]))
    plants = awake(model, state)
    fastest = 0.0
    for tick in range(1000):
        plants.predict()
        pull = np.array([[30.0, 10.0, -50.0, 0.0, 0.0, 0.0]]) if tick < 100 else None
        plants.integrate(np.array([bunch]) if tick < 100 else None, pull)
        fastest = plants.tree_rate[0] if tick >= 900 else fastest
    assert fastest < 2.0


@pytest.mark.parametrize(("phi", "rate"), [(0.55, 20.0), (1.0, 50.0)])
def test_survives_extreme_joint_rates(phi: float, rate: float) -> None:
    rng = np.random.default_rng(11)
    trees = []
    for i in range(4):
        tree = TreeBuilder(frames.pose(np.array([0.0, i, 2.0])))
        tree.add_rod(-1, 1.0, (0.004, 0.003), RodMaterial(5e9, 800.0, 0.004), 16)
        trees.append(tree)
    model = assemble([*trees, forked(rng, beta=0.004)])
    plants = awake(model, random_state(model, rng, rate), phi=phi)
    for _ in range(1000):
        plants.predict()
        plants.integrate()
        assert (plants.tree_rate < plants.fault_rate).all()  # also false for NaN
    assert plants.tree_rate.max() < 1.0


def test_joint_wrench_carries_weight_and_pull() -> None:
    """At rest the joint carries weight and load of all bodies beyond it."""
    rng = np.random.default_rng(13)
    model = assemble([forked(rng, beta=0.1)])
    plants = awake(model, State.at_rest(model), phi=1.0)
    plants.body_load[7] = [1.0, -2.0, 3.0, 0.01, 0.02, -0.03]
    for _ in range(1500):
        plants.predict()
        plants.integrate()
    assert plants.tree_rate.max() < 1e-3
    pose = plants.state.body_q.astype(float)
    com = pose[:, :3] + frames.rotate(pose[:, 3:], model.body_com.astype(float))
    weight = model.body_mass[:, None] * GRAVITY
    for joint, beyond in ((0, range(13)), (6, range(6, 13)), (8, [8, 9]), (10, [10, 11, 12])):
        beyond = list(beyond)
        force = weight[beyond].sum(0)
        moment = np.cross(com[beyond] - pose[joint, :3], weight[beyond]).sum(0)
        if 7 in beyond:
            load = plants.body_load[7].astype(float)
            force = force + load[:3]
            moment = moment + load[3:] + np.cross(pose[7, :3] - pose[joint, :3], load[:3])
        measured = plants.joint_wrench(np.array([joint]))[0]
        np.testing.assert_allclose(measured[:3], -force, atol=2e-3)
        np.testing.assert_allclose(measured[3:], -moment, atol=2e-3)


def digest_of_a_run() -> str:
    rng = np.random.default_rng(17)
    model = assemble([forked(rng, isotropic=False) for _ in range(3)])
    plants = awake(model, random_state(model, rng, 6.0))
    h = hashlib.blake2b()
    for tick in range(200):
        plants.predict()
        touched = np.array([5, 20, 5], np.int32)
        plants.integrate(touched if tick % 3 else None, rng.normal(size=(3, 6)) * 0.1)
        h.update(plants.state.joint_q.tobytes() + plants.state.joint_qd.tobytes() + plants.state.body_q.tobytes())
        h.update(plants.impulse_response(touched[:2]).tobytes() if tick == 50 else b"")
    return h.hexdigest()


def test_two_runs_are_bitwise_equal() -> None:
    assert digest_of_a_run() == digest_of_a_run()


# ---- cut bodies


def cane(**wood: float) -> TreeBuilder:
    tree = TreeBuilder(frames.pose(np.array([0.0, 0.0, 3.0])))
    tree.add_rod(-1, 1.0, (0.004, 0.003), RodMaterial(**{"modulus": 2e9, "density": 800.0, "damping": 0.01} | wood), 12)
    return tree


def spinning_cut_tree(
    tree: TreeBuilder, rng: np.random.Generator, body: int = 0, **options: float
) -> ArticulationSolver:
    """A tree cut at a body, bent, with joint rates, spin and linear velocity."""
    model = assemble([tree])
    plants = awake(model, State.at_rest(model), **options)
    state = plants.state
    plants.cut(body)
    turn = frames.exp(rng.normal(size=(len(state.joint_q), 3)) * [0.0, 0.03, 0.03])
    state.joint_q[:] = frames.normalize(frames.multiply(turn, state.joint_q))
    state.joint_qd[:] = rng.normal(size=state.joint_qd.shape) * [0.0, 0.3, 0.3]
    state.joint_qd[body] = [1.0, 4.0, -3.0]
    state.joint_xd[body] = [1.0, -0.5, 2.0]
    return plants


@pytest.mark.parametrize(("kind", "phi"), each_once(["cane", "fork", "fast"], [0.5, 0.55, 1.0]))
def test_a_cut_cane_keeps_its_momentum(kind: str, phi: float) -> None:
    """Spinning, bending, falling for 2 s: momentum less m g t, angular momentum about the centre of mass, and its
    path: 1e-4."""
    rng = np.random.default_rng(19)
    body = 0 if kind == "cane" else 3
    plants = spinning_cut_tree(cane() if kind == "cane" else forked(rng), rng, body, phi=phi)
    if kind == "fast":
        plants.state.joint_qd[body] *= 4.0
    cut_bodies = np.flatnonzero(plants._root == body)
    plants.forward_kinematics()
    linear, _, start, energy = momenta(plants, cut_bodies, np.zeros(3))
    angular = momenta(plants, cut_bodies, start)[1]
    mass = plants.body_mass[cut_bodies].sum()

    def spring() -> float:
        return 0.5 * float(
            (plants.joint_stiffness * frames.log(plants.state.joint_q.astype(float)) ** 2)[cut_bodies].sum()
        )

    energy += spring()
    worst = np.zeros(3)
    for tick in range(1, 201):
        plants.predict()
        plants.integrate()
        plants.forward_kinematics()
        now, _, center, _ = momenta(plants, cut_bodies, np.zeros(3))
        spin = momenta(plants, cut_bodies, center)[1]
        path = start + linear / mass * tick * DT + fall(tick * DT)
        error = now - linear - mass * GRAVITY * tick * DT, spin - angular, center - path
        worst = np.maximum(worst, np.linalg.norm(error, axis=1))
    assert worst[0] < 1e-4 * np.linalg.norm(linear)
    assert worst[1] < 1e-4 * np.linalg.norm(angular)
    assert worst[2] < 1e-4
    own = momenta(plants, cut_bodies, np.zeros(3))[3] - 0.5 * mass * ((now / mass) ** 2).sum() + spring()
    assert own < energy - 0.5 * mass * ((linear / mass) ** 2).sum()  # spinning and bending lose energy only


@pytest.mark.parametrize("phi", [0.55, 1.0])
def test_response_of_a_cut_tree_is_that_of_a_free_joint(phi: float) -> None:
    """Against MuJoCo's inertia with a free joint at the cut; standing and cut bodies are not coupled."""
    rng = np.random.default_rng(23)
    plants = spinning_cut_tree(
        forked(rng, isotropic=False), rng, 0, phi=phi, geometric_stiffness=False, fast_rate=np.inf
    )
    model = plants.model
    state = plants.state
    plants.cut(6)
    plants.predict()
    touched = np.array([5, 0, 9, 6], np.int32)
    measured = plants.impulse_response(touched)

    spec = mujoco.MjSpec()
    mj_bodies: list[mujoco.MjsBody] = []
    for body in range(len(model.body_mass)):
        parent = int(plants._parent[body])
        pose = state.body_q[body] if parent < 0 else frames.pose(model.body_offset[body], model.body_rest[body])
        child = (spec.worldbody if parent < 0 else mj_bodies[parent]).add_body(
            pos=pose[:3],
            quat=frames.to_wxyz(pose[3:]),
            mass=float(model.body_mass[body]),
            ipos=model.body_com[body],
            inertia=model.body_inertia[body],
            explicitinertial=True,
        )
        child.add_joint(type=mujoco.mjtJoint.mjJNT_FREE if parent < 0 else mujoco.mjtJoint.mjJNT_BALL)
        mj_bodies.append(child)
    mj_model = spec.compile()
    data = mujoco.MjData(mj_model)
    for body, at in enumerate(mj_model.jnt_qposadr):
        if plants._parent[body] >= 0:
            data.qpos[at : at + 4] = frames.to_wxyz(state.joint_q[body])
    mujoco.mj_forward(mj_model, data)
    np.testing.assert_allclose(data.xpos[1:], state.body_q[:, :3], atol=1e-5)
    inertia = np.zeros((mj_model.nv, mj_model.nv))
    mujoco.mj_fullM(mj_model, data, inertia)
    stiffness = model.joint_stiffness.astype(float)
    damping = np.maximum(model.joint_damping - (2 * phi - 1) * DT * stiffness, 0.0)
    used = float(plants.phi_used[0])
    metric = used * DT * (used * DT * stiffness + np.maximum(damping, 0.0))
    assert used == pytest.approx(phi)
    axes = frames.to_matrix(frames.exp(0.5 * frames.log(state.joint_q.astype(float))))
    for body, at in enumerate(mj_model.jnt_dofadr):
        if plants._parent[body] >= 0:
            inertia[at : at + 3, at : at + 3] += axes[body].T @ np.diag(metric[body]) @ axes[body]
    jacobian = np.zeros((len(touched), 6, mj_model.nv))
    for row, body in zip(jacobian, touched, strict=True):
        mujoco.mj_jacBody(mj_model, data, row[:3], row[3:], int(body) + 1)
    flat = jacobian.reshape(-1, mj_model.nv)
    expected = (flat @ np.linalg.solve(inertia, flat.T)).reshape(measured.shape)
    np.testing.assert_allclose(measured, expected, rtol=0, atol=1e-4 * np.abs(expected).max())
    assert measured[1, :3, 1, :3].any()  # the root moves
    root = plants._root[touched]
    assert set(root.tolist()) == {0, 6}
    for u in range(4):
        for t in range(4):
            assert measured[u, :, t].any() == (root[u] == root[t])


def test_a_force_on_a_cut_cane_moves_it_as_predicted() -> None:
    """Impulses change the momentum, and velocities are those predicted by ``impulse_response``."""
    rng = np.random.default_rng(29)
    plants = spinning_cut_tree(cane(), rng, 4)
    plants.state.joint_q[5:] = [0.0, 0.0, 0.0, 1.0]
    plants.state.joint_qd[:] *= 0.1
    cut_bodies = np.flatnonzero(plants._root == 4)
    plants.forward_kinematics()
    linear, angular, center, _ = momenta(plants, cut_bodies, np.zeros(3))
    plants.predict()
    touched = np.array([6, 4, 10])
    wrench = rng.normal(size=(3, 6)) * [0.1, 0.1, 0.1, 1e-5, 1e-5, 1e-5]
    at = plants.state.body_q[touched, :3].astype(float)
    predicted = plants.velocity_free[touched] + np.einsum("uitj,tj->ui", plants.impulse_response(touched), wrench * DT)
    plants.integrate(touched, wrench)
    plants.forward_kinematics()
    after = momenta(plants, cut_bodies, np.zeros(3))
    force = plants.body_mass[cut_bodies].sum() * GRAVITY + wrench[:, :3].sum(0)
    np.testing.assert_allclose(after[0], linear + DT * force, atol=1e-6)
    twist = (np.cross(at - center, wrench[:, :3]) + wrench[:, 3:]).sum(0)
    spin = momenta(plants, cut_bodies, after[2])[1] - (angular - np.cross(center, linear))
    np.testing.assert_allclose(spin, DT * twist, atol=2e-7)
    np.testing.assert_allclose(plants.state.body_qd[touched], predicted, atol=0.05)  # the poses have changed since


def test_a_cut_tree_with_extreme_rates_slows_down() -> None:
    rng = np.random.default_rng(31)
    for body in (0, 2, 7):
        plants = spinning_cut_tree(forked(rng, beta=0.004), rng, body)
        plants.state.joint_qd[:] = frames.normalize(rng.normal(size=plants.state.joint_qd.shape)) * 20.0
        rates = []
        for _ in range(1000):
            plants.predict()
            plants.integrate()
            rates.append(np.linalg.norm(np.delete(plants.state.joint_qd, body, 0), axis=1).max())
            assert rates[-1] < 100.0
        assert np.mean(rates[-100:]) < 2.0


# ---- ties


def tied(
    tree: TreeBuilder,
    body: int,
    stiffness: float,
    damping: float = 0.0,
    point: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Model:
    """A tree with one tie that is unstretched at the drawn pose."""
    drawn = assemble([tree])
    at = frames.compose(drawn.forward_kinematics(drawn.joint_settled)[body], frames.pose(np.array(point)))[:3]
    return assemble(
        [tree], tie_body=[body], tie_point=[point], tie_anchor=[at], tie_stiffness=[stiffness], tie_damping=[damping]
    )


def flat(mass: float = 0.0, beta: float = 0.01) -> TreeBuilder:
    """A horizontal cane of 1 m, settled, with a mass at its tip."""
    tree = TreeBuilder(frames.pose(np.zeros(3)))
    tree.add_rod(-1, 1.0, (0.004, 0.004), RodMaterial(5e9, 800.0, beta), 16)
    tree.bodies[-1]["mass"] += mass
    tree.solve_rest_pose()
    return tree


@pytest.mark.parametrize("stiffness", [5.0, 100.0, 1e4, 1e6])
def test_a_tied_cane_bends_like_a_propped_beam(stiffness: float) -> None:
    """Side load P at the tip, spring support at a: w(x) by superposition of two cantilevers (Euler-Bernoulli)."""
    model = tied(flat(beta=0.05), 9, stiffness, point=(1 / 16, 0.0, 0.0))
    plants = awake(model, State.at_rest(model), phi=1.0)
    load = 0.01
    bend = 5e9 * np.pi / 4 * 0.004**4
    a = 10 / 16
    plants.body_load[15] = [0.0, load, 0.0, 0.0, 0.0, load / 16]
    for _ in range(1500):
        plants.predict()
        plants.integrate()
    plants.forward_kinematics()
    assert plants.tree_rate[0] < 1e-4
    deflection_without_tie = load * a * a * (3.0 - a) / (6.0 * bend)
    tie_force = stiffness * deflection_without_tie / (1.0 + stiffness * a**3 / (3.0 * bend))
    tip = load / (3.0 * bend) - tie_force * a * a * (3.0 - a) / (6.0 * bend)
    rest = model.forward_kinematics(model.joint_settled)
    measured = [
        frames.compose(plants.state.body_q[b], frames.pose([1 / 16, 0, 0]))[1]
        - frames.compose(rest[b], frames.pose([1 / 16, 0, 0]))[1]
        for b in (15, 9)
    ]
    assert measured[0] == pytest.approx(tip, rel=0.02)
    assert stiffness * measured[1] == pytest.approx(tie_force, rel=0.01, abs=1e-7 * stiffness)
    # the joint carries the load less the force of the tie, and the weight
    root = plants.joint_wrench(np.array([0]))[0]
    assert root[1] == pytest.approx(tie_force - load, abs=2e-4 + 2e-7 * stiffness)


@pytest.mark.parametrize(("stiffness", "loaded"), each_once([1e2, 1e3, 1e4, 1e5, 1e6], [(0.0, 0.0), (0.5, 0.006)]))
def test_a_tied_cane_gains_no_energy(stiffness: float, loaded: tuple[float, float]) -> None:
    """Bare and undamped, or with a mass [kg] at its tip and damped."""
    model = tied(flat(*loaded), 9, stiffness, point=(1 / 16, 0.0, 0.0))
    rest = awake(model, State.at_rest(model))
    rest.predict()
    plants = awake(model, State.at_rest(model))
    plants.state.joint_qd[:, 1:] = [0.1, 0.06]
    measured = []
    for _ in range(1000):
        plants.predict()
        at = frames.compose(plants.state.body_q[9], frames.pose([1 / 16, 0, 0]))[:3]
        elastic = 0.5 * stiffness * ((at - model.tie_anchor[0]) ** 2).sum()
        measured.append(energy(plants) - energy(rest) + elastic)
        plants.integrate()
    assert max(measured[1:]) <= measured[0]
    assert plants.tree_rate[0] < 0.1


@pytest.mark.parametrize("zeta", [0.03, 0.1, 0.2])
def test_a_tie_has_the_given_damping_ratio(zeta: float) -> None:
    """A balanced wheel of 0.02 kg m^2 on a spring of 50 N/m at a lever of 0.2 m: 10 rad/s."""
    inertia = 0.02
    lever = 0.2
    stiffness = 50.0
    tree = TreeBuilder(frames.pose(np.zeros(3)))
    tree.add_body(-1, mass=1.0, inertia=[inertia] * 3, length=0.2)
    damping = 2.0 * zeta * np.sqrt(stiffness * inertia) / lever
    model = tied(tree, 0, stiffness, damping, point=(lever, 0.0, 0.0))
    state = State.at_rest(model)
    state.joint_q[0] = frames.exp(np.array([0.0, 0.0, 0.02]))
    plants = awake(model, state)
    angle = []
    for _ in range(400):
        plants.predict()
        plants.integrate()
        angle.append(frames.log(state.joint_q[0].astype(float))[2])
    angle = np.array(angle)
    troughs = np.flatnonzero((angle[1:-1] < angle[:-2]) & (angle[1:-1] < angle[2:])) + 1  # troughs, by a parabola
    trough = angle[troughs] - (angle[troughs + 1] - angle[troughs - 1]) ** 2 / (
        8.0 * (angle[troughs + 1] - 2 * angle[troughs] + angle[troughs - 1])
    )
    loss = np.log(trough[0] / trough[1])
    assert loss / np.hypot(loss, 2.0 * np.pi) == pytest.approx(zeta, abs=0.005)
    assert (troughs[1] - troughs[0]) * DT == pytest.approx(2.0 * np.pi / (10.0 * np.sqrt(1.0 - zeta**2)), rel=0.03)


def test_a_tie_follows_its_anchor_and_can_be_removed() -> None:
    model = tied(flat(), 15, 200.0, 1.0)
    plants = awake(model, State.at_rest(model), phi=1.0)
    plants.tie_anchor[0, 1] += 0.05
    for _ in range(500):
        plants.predict()
        plants.integrate()
    plants.forward_kinematics()
    drawn = model.forward_kinematics(model.joint_settled)
    assert plants.state.body_q[15, 1] == pytest.approx(0.05, abs=0.002)
    plants.tie_stiffness[0] = plants.tie_damping[0] = 0.0
    for _ in range(1500):
        plants.predict()
        plants.integrate()
    plants.forward_kinematics()
    np.testing.assert_allclose(plants.state.body_q[15, :3], drawn[15, :3], atol=2e-3)


def test_a_cut_cane_hangs_by_its_tie() -> None:
    model = tied(flat(), 9, 500.0, 2.0)
    plants = awake(model, State.at_rest(model), phi=1.0)
    plants.cut(4)
    for tick in range(3000):
        plants.predict()
        plants.integrate()
        if tick % 12 == 0:  # damp the free swing
            plants.state.joint_qd[:] = 0.0
            plants.state.joint_xd[:] = 0.0
    plants.forward_kinematics()
    at = plants.state.body_q[9, :3].astype(float)
    cut_bodies = np.arange(4, 16)
    _, _, center, _ = momenta(plants, cut_bodies, np.zeros(3))
    weight = 9.81 * plants.body_mass[cut_bodies].sum()
    np.testing.assert_allclose(at - model.tie_anchor[0], [0.0, 0.0, -weight / 500.0], atol=1e-4)
    np.testing.assert_allclose(center[:2], at[:2], atol=1e-3)  # hanging vertically below


# ---- trunk, arms and canes as one tree


def vine() -> tuple[TreeBuilder, list[int]]:
    """A trunk of 7 cm and 1.5 m, two arms, eight canes, a bunch on each, as one tree."""
    tree = TreeBuilder(frames.pose(np.zeros(3), frames.from_x_axis(np.array([0.0, 0.0, 1.0]), np.eye(3)[0])))
    trunk = tree.add_rod(-1, 1.5, (0.035, 0.035), RodMaterial(10e9, 900.0, 0.004), 6)
    bunches = []
    for side in (-1.0, 1.0):
        arm = tree.add_rod(
            trunk[-1],
            1.0,
            (0.02, 0.015),
            RodMaterial(8e9, 900.0, 0.005),
            5,
            rest=frames.exp(np.array([0.0, 0.0, 1.5 * side])),
        )
        for i in range(4):
            out = frames.exp(np.array([0.0, 0.8 * (-1) ** i, 0.2 * side]))
            cane = tree.add_rod(arm[1 + i], 0.8, (0.005, 0.003), RodMaterial(4e9, 800.0, 0.008), 8, rest=out)
            bunches.append(
                tree.add_body(
                    cane[2],
                    offset=(0.1, 0.0, 0.0),
                    rest=frames.exp(np.array([0.3 * i, 1.0, 0.2])),
                    mass=0.4,
                    com=(0.1, 0, 0),
                    inertia=(4e-4, 5e-4, 5e-4),
                    length=0.15,
                    stiffness=[1.5] * 3,
                    damping=[0.03] * 3,
                )
            )
    return tree, bunches


def test_a_whole_vine_as_one_tree_stands() -> None:
    """Drawn at rest it stays; after a strong kick it returns; its root joint carries all its weight."""
    tree, bunches = vine()
    tree.solve_rest_pose()
    model = assemble([tree])
    assert len(bunches) == 8
    drawn = model.forward_kinematics(model.joint_settled)
    plants = awake(model, State.at_rest(model))
    for _ in range(200):
        plants.predict()
        plants.integrate()
    plants.forward_kinematics()
    np.testing.assert_allclose(plants.state.body_q[:, :3], drawn[:, :3], atol=2e-4)
    root_wrench = plants.joint_wrench(np.array([0]))[0]
    np.testing.assert_allclose(root_wrench[:3], -model.body_mass.sum() * GRAVITY, atol=0.02)
    plants.state.joint_qd[:] = np.random.default_rng(37).normal(size=plants.state.joint_qd.shape) * 3.0
    for _ in range(3000):
        plants.predict()
        plants.integrate()
        assert plants.tree_rate[0] < 1000.0
    plants.forward_kinematics()
    assert plants.tree_rate[0] < 0.1
    np.testing.assert_allclose(plants.state.body_q[:, :3], drawn[:, :3], atol=2e-2)


def test_sag_of_an_arm_on_its_trunk() -> None:
    """A stiff arm sideways on a trunk: its tip sinks by w L^4 / 8EI and by the rotation of the trunk's head,
    (w L^2 / 2) h / EI L."""
    tree = TreeBuilder(frames.pose(np.zeros(3), frames.from_x_axis(np.array([0.0, 0.0, 1.0]), np.eye(3)[0])))
    trunk = tree.add_rod(-1, 1.5, (0.035, 0.035), RodMaterial(10e9, 900.0, 0.05), 12)
    arm = tree.add_rod(
        trunk[-1],
        1.0,
        (0.02, 0.02),
        RodMaterial(8e9, 900.0, 0.05),
        12,
        rest=frames.exp(np.array([0.0, 0.0, np.pi / 2])),
    )
    model = assemble([tree])
    plants = awake(model, State.at_rest(model), phi=1.0)
    start = plants.state.body_q[:, :3].copy()
    for _ in range(1500):
        plants.predict()
        plants.integrate()
    plants.forward_kinematics()
    w = 900.0 * np.pi * 0.02**2 * 9.81
    arm_bend = 8e9 * np.pi / 4 * 0.02**4
    trunk_bend = 10e9 * np.pi / 4 * 0.035**4
    pose = plants.state.body_q[arm[-1]].astype(float)
    tip = frames.compose(pose, frames.pose([1 / 12, 0, 0]))[2]
    sag = w / (8.0 * arm_bend) + 0.5 * w * 1.5 / trunk_bend
    assert start[arm[-1], 2] == pytest.approx(1.5, abs=1e-6)
    assert 1.5 - tip == pytest.approx(sag, rel=0.02)


def test_a_trunks_first_frequency() -> None:
    """A bare trunk under its own stiffness, 10 Hz and more: free swings at 1 ms against Euler-Bernoulli, 1 %."""
    tree = TreeBuilder(frames.pose(np.zeros(3), frames.from_x_axis(np.array([0.0, 0.0, 1.0]), np.eye(3)[0])))
    tree.add_rod(-1, 1.5, (0.035, 0.035), RodMaterial(10e9, 900.0), 12)
    model = assemble([tree])
    plants = ArticulationSolver(model, State.at_rest(model), dt=0.001, phi=0.5)
    plants.wake(0)
    shape = (np.arange(12) + 0.5)[::-1]
    plants.state.joint_qd[:, 1] = 1e-3 * shape
    measured = []
    for _ in range(4000):
        plants.predict()
        measured.append(plants.velocity_free[11, 0])
        plants.integrate()
    spectrum = np.abs(np.fft.rfft(np.array(measured) * np.hanning(len(measured)), 1 << 18))
    frequency = np.argmax(spectrum) * 1000.0 / (1 << 18)
    theory = 1.8751**2 / (2 * np.pi) * np.sqrt(10e9 * 0.035**2 / 4 / 900.0) / 1.5**2
    assert theory == pytest.approx(14.5, rel=0.01)
    assert frequency == pytest.approx(theory, rel=0.01)
