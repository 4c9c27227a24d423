"""Contact against the same scenes entirely in MuJoCo, and against predicted velocities."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.contact_forces import force_on, ramp
from tests.support.contact_scenes import bar, bunch_scene, cane, grasp, gripper, held_point, probe
from tests.support.long_rows import long
from vinesim.bench.mujoco_reference import MujocoScene
from vinesim.core import frames
from vinesim.scene.builder import assemble
from vinesim.world import Physics

pytestmark = pytest.mark.slow

FINGERS = ("left", "right")


def realised(physics: Physics, start: np.ndarray) -> np.ndarray:
    """Body velocities [body, 6] of the new joint rates, at the poses ``start`` of the step's start."""
    model = physics.model
    velocity = np.zeros((len(physics.model.body_mass), 6))
    for b, parent in enumerate(model.body_parent):
        above = model.tree_pose[model.body_tree[b]] if parent < 0 else start[parent]
        motion = np.zeros(6) if parent < 0 else velocity[parent]
        axes = frames.multiply(above[3:].astype(float), model.body_rest[b].astype(float))
        lever = frames.rotate(above[3:].astype(float), model.body_offset[b].astype(float))
        velocity[b, :3] = motion[:3] + np.cross(motion[3:], lever)
        velocity[b, 3:] = motion[3:] + frames.rotate(axes, physics.state.joint_qd[b].astype(float))
    return velocity


CLUSTERS = pytest.mark.parametrize("clusters", [False, True], ids=["plain", "clusters"])
"""With a bunch of one body, and with one of berry clusters, as generated vines bear them."""


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "clusters"])
def held(request):
    """Close, lift, move, pull, release: bunch, finger forces and efforts of vinesim and MuJoCo, tick by tick."""
    model, body, middle = bunch_scene(clusters=request.param)
    ours = Physics(model)
    reference = MujocoScene(model, [gripper(middle)])
    ours.add_robot(gripper(middle))
    rows = {key: [] for key in ("ours", "reference", "force", "reference_force", "effort", "reference_effort")}
    for tick in range(800):
        target, pull = grasp(0.01 * tick)
        for rigid in (ours.rigid, reference.rigid):
            rigid.command("grip", target)
            rigid.apply_wrench("grip", "hand", np.array([0.0, 0.0, pull]))
        ours.step()
        reference.step()
        rows["ours"].append(held_point(model, ours.snapshot().body_q[body], body))
        rows["reference"].append(held_point(model, reference.body_pose(body), body))
        rows["force"].append([force_on(ours, finger) for finger in FINGERS])
        rows["reference_force"].append([reference.contact_force_on(finger) for finger in FINGERS])
        rows["effort"].append(ours.rigid.joint_measurements("grip")[2])
        rows["reference_effort"].append(reference.rigid.joint_measurements("grip")[2])
        if 100 < tick < 640:  # also where the hand has carried it, and while nothing moves
            assert (ours.contact_solver.near_trees == [0]).all()
            assert ours.state.tree_fine[0] == request.param
    return {key: np.array(value) for key, value in rows.items()} | {"physics": ours, "body": body, "middle": middle}


def test_pose_of_a_held_bunch_is_mujocos(held):
    error = np.linalg.norm(held["ours"] - held["reference"], axis=1)
    lifted = held["reference"][290, 2] - held["reference"][140, 2]
    assert lifted > 0.095
    assert error[:640].max() < 1e-3


def test_finger_forces_and_efforts_of_a_grasp_are_mujocos(held):
    for start, end in ((120, 150), (250, 300), (400, 450), (500, 590)):
        vinesim = held["force"][start:end].mean(0)
        mujoco = held["reference_force"][start:end].mean(0)
        np.testing.assert_allclose(vinesim[:, 1], mujoco[:, 1], rtol=0.01)
        assert vinesim[:, 2].sum() == pytest.approx(mujoco[:, 2].sum(), abs=0.05)
        np.testing.assert_allclose(
            held["effort"][start:end].mean(0), held["reference_effort"][start:end].mean(0), atol=0.05
        )


def test_held_bunch_does_not_creep(held):
    before = held["ours"][560]
    after = held["ours"][595]
    assert np.linalg.norm(after - before) < 5e-5


def test_a_released_bunch_returns_to_rest(held):
    physics = held["physics"]
    body = held["body"]
    physics.rigid.command("grip", np.zeros(4))
    for _ in range(2500):
        physics.step()
    assert physics.contact_solver.count == 0
    assert np.linalg.norm(held_point(physics.model, physics.snapshot().body_q[body], body) - held["middle"]) < 5e-3


@CLUSTERS
def test_contact_effort_is_the_jacobian_transpose_of_the_forces_and_the_drives_balance_it(clusters):
    model, _, middle = bunch_scene(clusters=clusters)
    physics = Physics(model)
    physics.add_robot(gripper(middle, effort=30.0))
    for _ in range(60):
        physics.step()
    unloaded = physics.rigid.joint_measurements("grip")[2]
    for tick in range(500):
        target, _ = grasp(0.01 * tick)
        target[0] = 0.0
        physics.rigid.command("grip", target)
        physics.step()
    _, velocity, effort, contact = physics.rigid.joint_measurements("grip")
    expected = sum(physics.rigid.jacobian("grip", c.link, c.position)[:3].T @ c.force for c in physics.contacts)
    assert np.abs(velocity).max() < 1e-3
    assert np.abs(contact).max() > 25.0
    np.testing.assert_allclose(contact, expected, atol=0.02 * np.abs(expected).max())
    np.testing.assert_allclose(effort - unloaded, -contact, atol=0.02 * np.abs(contact).max())


@CLUSTERS
def test_predicted_velocities_are_realised_and_action_is_reaction(clusters):
    model, _, middle = bunch_scene(clusters=clusters)
    physics = Physics(model)
    physics.add_robot(gripper(middle))
    rigid = physics.rigid
    solver = physics.contact_solver
    plant_error = rigid_error = 0.0
    pressed = 0
    for tick in range(400):
        rigid.command("grip", grasp(0.01 * tick)[0])
        rigid.predict()
        solver.wake_near_trees()
        physics.plants.predict()
        start = physics.state.body_q.copy()
        solver.solve()
        free = rigid.velocity_free
        if solver.count:
            pressed += 1
            response = physics.plants.impulse_response(solver.bodies)
            rows = slice(0, len(solver.bodies))
            pushed = np.einsum("uitj,tj->ui", response[rows], solver.wrenches) * physics.dt
            predicted = physics.plants.velocity_free[solver.bodies] + pushed
            free = free + rigid.impulse_response(solver.rigid_force[None])[:, 0] * physics.dt
            on_plants = solver.wrenches[:, :3].sum(0)
            on_robot = sum((c.force for c in solver.contacts), np.zeros(3))
            np.testing.assert_allclose(on_plants, -on_robot, atol=1e-9)
            base = rigid.robot("grip").base_v[:2]
            np.testing.assert_allclose(solver.rigid_force[base], on_robot[:2], atol=1e-9)
        physics._integrate_plants()
        rigid.integrate(solver.rigid_force)
        if solver.count:
            plant_error = max(plant_error, np.abs(realised(physics, start)[solver.bodies] - predicted).max())
        rigid_error = max(rigid_error, np.abs(rigid.mj_data.qvel - free).max())
    assert pressed > 200
    assert plant_error < 1e-4
    assert rigid_error < 1e-12


def sweep(speed: float, seconds: float, damping: float, *, substeps: int = 10, time_constant: float | None = None):
    """A bar of 3 kg moves through five canes, coasting or (with damping) driven: vinesim, and MuJoCo in substeps.

    Returns physics, force on the bar along y by vinesim and MuJoCo [tick, 2] N, and the trees that were touched.
    """
    model = assemble([cane((0.0, 0.15 * i, 1.0), radius=0.005) for i in range(5)])
    spec = bar((0.7, -0.08, 0.95), damping=damping)
    ours = Physics(model)
    reference = MujocoScene(model, [spec], dt=0.01 / substeps, contact_time_constant=time_constant)
    ours.contact_solver.plant_plant_contacts = False  # in the reference canes pass through each other
    ours.add_robot(spec)
    for rigid in (ours.rigid, reference.rigid):
        rigid.command("bar", np.zeros(1), np.array([speed]))
        rigid.mj_data.qvel[rigid.robot("bar").v] = speed
    force = []
    touched = set()
    base = ours.rigid.robot("bar").base_v[:2]
    for _ in range(round(seconds / ours.dt)):
        ours.step()
        on_bar = force_on(ours, "bar")
        mujoco = np.zeros(3)
        for _ in range(substeps):
            reference.step()
            mujoco += reference.contact_force_on("bar") / substeps
        force.append((on_bar[1], mujoco[1]))
        touched.update(tree for tree, _ in ours.touched)
        np.testing.assert_allclose(ours.contact_solver.wrenches[:, :3].sum(0), -on_bar, atol=1e-9)
        if ours.contact_solver.rigid_force is not None:
            np.testing.assert_allclose(ours.contact_solver.rigid_force[base], on_bar[:2], atol=1e-9)
    return ours, np.array(force), touched


def peaks(force: np.ndarray) -> np.ndarray:
    """Largest mean force over 30 ms: that over one tick depends on whether an impact falls into one tick or two."""
    return np.abs(force[:-2] + force[1:-1] + force[2:]).max(0) / 3.0


def test_rebound_of_a_coasting_bar_is_mujocos():
    _, force, _ = sweep(0.5, 3.0, 0.0)
    impulse = 0.01 * force.sum(0)
    peak = np.abs(force).max(0)
    assert impulse[0] == pytest.approx(impulse[1], rel=0.02)
    assert peak[0] == pytest.approx(peak[1], rel=0.05)


@pytest.mark.parametrize("speed", [0.5, 3.0, *long(0.25, 1.0, 2.0)])
def test_a_driven_bar_passes_five_canes_and_loses_none(speed):
    """Impulse and peak equal MuJoCo's, every cane is touched, none is passed through, all return to rest.


    At 3 m/s the bar moves 3 cm a tick, five times a cane's radius. MuJoCo steps by 1 ms, where it has converged:
    with 0.25 ms and contacts ten times as stiff its impulse changes by 1.7 % at 3 m/s, by 0.4 % at 0.5 m/s.
    """
    ours, force, touched = sweep(speed, 2.0 / speed, 200.0)
    impulse = 0.01 * force.sum(0)
    peak = peaks(force)
    assert touched == {0, 1, 2, 3, 4}
    assert ours.rigid.joint_measurements("bar")[0][0] > 1.2
    assert impulse[0] == pytest.approx(impulse[1], rel=0.02)
    assert peak[0] == pytest.approx(peak[1], rel=0.05)
    ours.remove_robot("bar")
    for _ in range(1500):
        ours.step()
    assert np.abs(ours.snapshot().body_q - ours.model.forward_kinematics(ours.model.joint_settled))[:, :3].max() < 0.01


def test_a_fast_sweep_agrees_with_mujoco_at_a_quarter_of_a_millisecond():
    _, force, _ = sweep(3.0, 0.66, 200.0, substeps=40, time_constant=0.002)
    impulse = 0.01 * force.sum(0)
    peak = np.abs(force).max(0)
    assert impulse[0] == pytest.approx(impulse[1], rel=0.01)
    assert peak[0] == pytest.approx(peak[1], rel=0.05)


@CLUSTERS
@pytest.mark.parametrize(("pull", "effort"), [(40.0, 40.0), *long((20.0, 40.0), (60.0, 60.0))])
def test_a_held_bunch_does_not_slip_when_the_hand_is_pulled(pull, effort, clusters):
    model, body, middle = bunch_scene(clusters=clusters)
    spec = gripper(middle, effort=effort)
    ours = Physics(model, detachment=False)
    reference = MujocoScene(model, [spec])
    ours.add_robot(spec)
    held = []
    force = []
    error = 0.0
    for tick in range(450):
        t = 0.01 * tick
        grip = 0.05 * ramp(t, 0.3, 0.8)
        for rigid in (ours.rigid, reference.rigid):
            rigid.command("grip", np.array([0.0, 0.05 * ramp(t, 1.0, 2.0), grip, grip]))
            rigid.apply_wrench("grip", "hand", np.array([0.0, 0.0, -pull * ramp(t, 2.5, 3.0)]))
        ours.step()
        reference.step()
        vinesim = held_point(model, ours.snapshot().body_q[body], body)
        held.append(vinesim - ours.rigid.link_pose("grip", "left")[:3])
        force.append(
            [
                [world.contact_force_on(f) if world is reference else force_on(ours, f) for f in FINGERS]
                for world in (ours, reference)
            ]
        )
        error = max(error, float(np.linalg.norm(vinesim - held_point(model, reference.body_pose(body), body))))
    held = np.array(held)
    force = np.array(force)
    assert np.linalg.norm(held[440:].mean(0) - held[240:250].mean(0)) < 5e-5
    assert error < 1e-3
    np.testing.assert_allclose(force[400:, 0, :, 1].mean(0), force[400:, 1, :, 1].mean(0), rtol=0.01)
    np.testing.assert_allclose(
        ours.rigid.joint_measurements("grip")[2][2:],
        reference.rigid.joint_measurements("grip")[2][2:],
        rtol=0.01,
        atol=0.01 * effort,
    )


@CLUSTERS
def test_a_mimicking_finger_presses_like_the_driven_one(clusters):
    model, body, middle = bunch_scene(clusters=clusters)
    spec = gripper(middle, mimic=True)
    ours = Physics(model)
    reference = MujocoScene(model, [spec])
    ours.add_robot(spec)
    force = []
    error = 0.0
    for tick in range(450):
        t = 0.01 * tick
        for rigid in (ours.rigid, reference.rigid):
            rigid.command("grip", np.array([0.0, 0.05 * ramp(t, 1.0, 2.0), 0.05 * ramp(t, 0.3, 0.8)]))
            rigid.apply_wrench("grip", "hand", np.array([0.0, 0.0, -20.0 * ramp(t, 2.5, 3.0)]))
        ours.step()
        reference.step()
        force.append([[force_on(ours, f)[1], reference.contact_force_on(f)[1]] for f in FINGERS])
        error = max(
            error,
            float(
                np.linalg.norm(
                    held_point(model, ours.snapshot().body_q[body], body)
                    - held_point(model, reference.body_pose(body), body)
                )
            ),
        )
    force = np.array(force)
    for phase in (slice(150, 240), slice(400, 450)):
        vinesim, mujoco = force[phase].mean(0).T
        np.testing.assert_allclose(vinesim, mujoco, rtol=0.01)
        assert np.abs(vinesim).min() > 15.0
    assert error < 1e-3


def test_two_fingers_grasp_lift_pull_and_release_a_cane():
    """Force: each finger closes against its servo (4000 N/m) and two contacts in a row of the fingers' compliance."""
    model = assemble([cane((0.0, 0.0, 1.0), radius=0.006, beta=0.02)])
    body = 12
    home = model.forward_kinematics(model.joint_settled)
    at = home[body, :3] + np.array([0.03, 0.0, 0.0])
    spec = gripper(at)
    ours = Physics(model)
    ours.add_robot(spec)
    held = []
    force = []
    for tick in range(500):
        t = 0.01 * tick
        grip = 0.074 * ramp(t, 0.3, 0.8)
        ours.rigid.command("grip", np.array([0.05 * ramp(t, 2.0, 2.6), 0.1 * ramp(t, 1.2, 1.8), grip, grip]))
        ours.rigid.apply_wrench("grip", "hand", np.array([0.0, 0.0, -15.0 * ramp(t, 3.0, 3.4)]))
        ours.step()
        held.append(ours.snapshot().body_q[body, :3] - ours.rigid.link_pose("grip", "left")[:3])
        force.append([force_on(ours, finger) for finger in FINGERS])
    held = np.array(held)
    force = np.array(force)
    closed = 4000.0 * (0.074 - (0.085 - 0.01 - 0.006))
    expected = closed / (1.0 + 4000.0 / (2.0 * ours.parameters.contact_stiffness))
    np.testing.assert_allclose(force[110:119, 0, 1], expected, rtol=0.01)
    np.testing.assert_allclose(force[110:119, 1, 1], -expected, rtol=0.01)
    assert ours.snapshot().body_q[body, 2] - home[body, 2] > 0.08
    assert np.abs(held[480:] - held[290:300].mean(0)).max() < 5e-4  # it yields when the pull begins
    assert np.abs(held[480:] - held[380:390].mean(0)).max() < 1e-6  # and is constant afterwards
    on_fingers = force[480:, :, 2].sum(1)
    assert np.abs(np.diff(on_fingers)).max() < 1e-3
    assert on_fingers.mean() < -3.0  # elastic force and weight of the bent cane
    ours.rigid.command("grip", np.zeros(4))
    for _ in range(1500):
        ours.step()
    assert ours.contact_solver.count == 0
    assert np.abs(ours.snapshot().body_q - home)[:, :3].max() < 1e-3


@pytest.mark.long
def test_friction_along_a_cane_is_mujocos():
    """Mean force over three pieces within 1 %; from tick to tick it is smooth but for the corners between pieces."""
    model = assemble([cane((0.0, 0.0, 1.0), radius=0.005, beta=0.1)])
    spec = probe((0.5, 0.0, 1.03))
    ours = Physics(model)
    reference = MujocoScene(model, [spec], dt=0.0005, contact_time_constant=0.004)
    ours.add_robot(spec)
    force = []
    for tick in range(1000):
        for rigid in (ours.rigid, reference.rigid):
            rigid.apply_wrench("probe", "rod", np.array([0.0, 0.0, -3.0]))
            if tick > 600:
                rigid.command("probe", np.array([0.001 * (tick - 600), 0.0]), np.array([0.1, 0.0]))
        ours.step()
        mujoco = np.zeros(3)
        for _ in range(20):
            reference.step()
            mujoco += reference.contact_force_on("rod") / 20
        force.append([force_on(ours, "rod"), mujoco])
    force = np.array(force)[650:]
    np.testing.assert_allclose(force[:, 0].mean(0)[[0, 2]], force[:, 1].mean(0)[[0, 2]], rtol=0.01)
    roughness = np.diff(force[:, :, 2], n=2, axis=0)
    assert np.sqrt((roughness[:, 0] ** 2).mean()) < 0.01 * 3.0
    assert np.sqrt((roughness[:, 0] ** 2).mean()) < np.sqrt((roughness[:, 1] ** 2).mean())


@CLUSTERS
def test_two_runs_are_bitwise_equal(clusters):
    def run() -> bytes:
        model, _, middle = bunch_scene(clusters=clusters)
        physics = Physics(model)
        physics.add_robot(gripper(middle))
        history = b""
        for tick in range(300):
            physics.rigid.command("grip", grasp(0.01 * tick)[0])
            physics.step()
            if tick % 10 == 0:
                history += physics.state.joint_q.tobytes() + physics.rigid.mj_data.qpos.tobytes()
        return history

    assert run() == run()
