"""Blades in batches of worlds: what they cut off moves as in a client, in its own world only."""

import mujoco
import numpy as np
import pytest

from tests.physics.test_worlds import HAND, PARAMETERS, bunches, targets
from tests.support.layouts import order_bodies_as_a_gpu
from vinesim.bench import scenes
from vinesim.core import frames
from vinesim.interaction import cutting_force
from vinesim.interaction.blades import Blade
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.values import RobotSpec
from vinesim.world import Physics

pytest.importorskip("mujoco_warp")
import warp as wp

from vinesim.kernels.worlds.cutting import force_share
from vinesim.kernels.worlds.reset import BUNCHES
from vinesim.learn.arm import arm
from vinesim.learn.shoots import shoots
from vinesim.worlds.bunch_pool import OWN
from vinesim.worlds.plants import plants_of_worlds
from vinesim.worlds.worlds import Worlds

pytestmark = pytest.mark.usefixtures("layout")

HALF = np.array([0.03, 0.03, 0.002])
MOUTH = frames.pose(np.array([0.0, 0.0, scenes.BUNCH_CENTER + 0.03]))
"""Pose of the mouth in the palm of the hand: it lies around the lower segment of the peduncle."""


def blade(force: float = 200.0) -> Blade:
    return Blade("hand", "palm", MOUTH, HALF, force)


def client(model: Model, robot: RobotSpec, parameters: PhysicsParameters = PARAMETERS) -> Physics:
    physics = Physics(model, parameters=parameters)
    physics.contact_solver.plant_plant_contacts = False
    physics.add_robot(robot)
    physics.wake(np.arange(len(model.tree_first)))
    return physics


def free_body(m: mujoco.MjModel) -> tuple[int, int, int, int]:
    """Returns the body of the first slot for free bunches, and its first geom, coordinate and degree of freedom."""
    body = m.body("free_bunch/0").id
    joint = m.body_jntadr[body]
    return body, int(m.body_geomadr[body]), int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])


def pose_in_client(physics: Physics) -> np.ndarray:
    first = free_body(physics.rigid.mj_model)[2]
    return physics.rigid.mj_data.qpos[first : first + 7].copy()


def poses_in_batch(worlds: Worlds) -> np.ndarray:
    """Returns the poses [world, 7] of the first body of each world's pool, wxyz."""
    first = free_body(worlds.bodies.rigid.mj_model)[2]
    return worlds.bodies.data.qpos.numpy()[:, first : first + 7]


@pytest.mark.slow
@pytest.mark.parametrize("is_held", [True, False])
def test_a_bunch_is_cut_off_and_held_or_falls_as_in_a_client(is_held: bool) -> None:
    """Two seconds. The hand lifts the bunch while the blade cuts, or it is open and the bunch falls to the ground. The
    second world's hand does not cut."""
    physics = client(bunches(1), HAND)
    cutter = physics.add_blade("hand", "palm", MOUTH, HALF, force=200.0)
    worlds = Worlds(bunches(2), 2, robots=[HAND], parameters=PARAMETERS, blade=blade())
    assert worlds.pool is not None
    apart = []
    for tick in range(200):
        target = targets(tick, 0.1) * [1.0, is_held, is_held]
        physics.rigid.command("hand", target)
        worlds.bodies.targets.assign(np.tile(target, (2, 1)).astype(np.float32))
        if tick == 45:
            cutter.close()
            worlds.pool.closing.assign(np.array([True, False]))
        physics.step()
        worlds.step()
        if tick >= 45:
            apart.append(np.abs(poses_in_batch(worlds)[0] - pose_in_client(physics)).max())
    worlds.download()
    physics.update_kinematics()
    assert cutter.detachments[0].bunch == 0
    assert max(apart) < 1e-4
    found, other = worlds.plants.state.body_q.reshape(2, -1, 7)
    np.testing.assert_allclose(found, physics.state.body_q, atol=1e-4)
    np.testing.assert_allclose(worlds.bodies.data.qpos.numpy()[0, :3], physics.rigid.mj_data.qpos[:3], atol=1e-4)
    height = poses_in_batch(worlds)[0, 2]
    if is_held:
        assert height == pytest.approx(scenes.bunch_center(0)[2] + scenes.BUNCH_CENTER + 0.1, abs=0.02)
    else:
        assert height < 0.2
    assert worlds.pool.is_free.numpy().tolist() == [1, 0]
    assert worlds.pool.needed.numpy()[0] == pytest.approx(cutter.resistance, rel=1e-5)
    assert found[-1, 2] - other[-1, 2] > 0.01, "the cane whose bunch has left stands higher"
    assert not worlds.faults.numpy().any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_swinging_bunch_leaves_with_the_mass_shapes_and_momentum_that_a_client_gives_it(seed: int) -> None:
    """A random shoot swings and a blade that stands still cuts the peduncle somewhere."""
    rng = np.random.default_rng(seed)
    model = shoots(1, rng, 1.2)
    robot = arm((0.0, 0.0, 0.6))
    physics = client(model, robot)
    physics.state.joint_qd[:] = rng.normal(0.0, 0.3, physics.state.joint_qd.shape)
    start = physics.state.joint_qd.copy()
    for _ in range(5):
        physics.step()
    physics.update_kinematics()
    segment = int(model.bunch_body[0]) - 1 - seed % 2
    pose = physics.state.body_q[segment].astype(float)
    place = frames.compose(pose, frames.pose(np.array([0.4 * float(model.body_length[segment]), 0.0, 0.0])))
    place[3:] = frames.multiply(
        frames.from_x_axis(frames.rotate(pose[3:], np.array([0.0, 1.0, 0.1]))), frames.exp(np.array([0.7, 0.0, 0.0]))
    )
    mouth = frames.compose(frames.inverse(physics.rigid.link_pose("arm", "base_footprint")), place)
    half = np.array([0.02, 0.02, 0.03])
    cutter = physics.add_blade("arm", "base_footprint", mouth, half)
    worlds = Worlds(model, 1, robots=[robot], parameters=PARAMETERS, blade=Blade("arm", "base_footprint", mouth, half))
    worlds.plants.state.joint_qd[:] = start
    worlds.plants.upload()
    worlds.step(5)
    cutter.close()
    worlds.pool.closing.fill_(True)
    physics.step()
    worlds.step()
    assert worlds.pool.is_free.numpy()[0] == 1
    ours, theirs = worlds.bodies.rigid.mj_model, physics.rigid.mj_model
    body, geom, _, dof = free_body(ours)
    other_body, other_geom, _, other_dof = free_body(theirs)
    np.testing.assert_allclose(poses_in_batch(worlds)[0], pose_in_client(physics), atol=1e-6)
    velocity = worlds.bodies.data.qvel.numpy()[0, dof : dof + 6]
    np.testing.assert_allclose(velocity, physics.rigid.mj_data.qvel[other_dof : other_dof + 6], atol=1e-5)
    found = {name: getattr(worlds.bodies.model, name).numpy()[0] for name in OWN}
    for name in ("body_mass", "body_subtreemass", "body_ipos", "body_invweight0"):
        np.testing.assert_allclose(found[name][body], getattr(theirs, name)[other_body], rtol=1e-4, atol=1e-7)
    tensors = []
    for inertia, wxyz in (
        (found["body_inertia"][body], found["body_iquat"][body]),
        (theirs.body_inertia[other_body], theirs.body_iquat[other_body]),
    ):
        axes = frames.to_matrix(frames.from_wxyz(np.asarray(wxyz, float)))
        tensors.append(axes @ np.diag(inertia) @ axes.T)
    np.testing.assert_allclose(tensors[0], tensors[1], rtol=1e-4, atol=1e-8)
    free = physics.rigid.free_bunch(0)
    count = len(free.radius)
    spheres = count - free.stalk.pieces
    here = np.r_[geom : geom + spheres, geom + spheres : geom + count]
    there = np.arange(other_geom, other_geom + count)
    there[spheres:] = there[spheres:][::-1] if free.stalk.pieces > 1 else there[spheres:]
    for name in ("geom_pos", "geom_rbound", "geom_friction"):
        np.testing.assert_allclose(found[name][here], getattr(theirs, name)[there], rtol=1e-5, atol=2e-6)
    np.testing.assert_allclose(found["geom_size"][here, :2], theirs.geom_size[there, :2], rtol=1e-5, atol=2e-6)
    np.testing.assert_array_equal(ours.geom_type[here], theirs.geom_type[there])
    worlds.download()
    for name in ("body_mass", "body_com", "body_inertia", "body_product"):
        np.testing.assert_allclose(getattr(worlds.plants, name), getattr(physics.plants, name), rtol=1e-4, atol=1e-12)


@pytest.fixture(scope="module")
def eight(layout: str) -> Worlds:
    return Worlds(bunches(8), 8, robots=[HAND], parameters=PARAMETERS, blade=blade())


def run(worlds: Worlds, first: int, count: int, cuts: dict[int, list[int]]) -> list[np.ndarray]:
    """Take ``count`` steps of hands that grasp and lift. ``cuts``: worlds whose blades close, by step. Returns the
    states of robots, bunches and plants, each with a row for each world."""
    assert worlds.pool is not None
    for tick in range(first, first + count):
        worlds.bodies.targets.assign(np.tile(targets(tick, 0.1), (worlds.count, 1)).astype(np.float32))
        worlds.pool.closing.assign(np.isin(np.arange(worlds.count), cuts.get(tick, [])))
        worlds.step()
    worlds.download()
    rows = worlds.plants.state.joint_q.reshape(worlds.count, -1).copy()
    mass = worlds.plants.body_mass.reshape(worlds.count, -1).copy()
    data = worlds.bodies.data
    rigid = [data.qpos, data.qvel, *(getattr(worlds.bodies.model, name) for name in OWN)]
    return [rows, mass, *(array.numpy().reshape(worlds.count, -1).copy() for array in rigid)]


@pytest.mark.slow
def test_only_the_worlds_that_cut_change_and_a_reset_world_repeats_all_to_the_bit(eight: Worlds) -> None:
    worlds = eight
    assert worlds.pool is not None
    cutting = [1, 4, 6]
    others = [0, 2, 3, 5, 7]
    worlds.reset()
    whole = run(worlds, 0, 70, {})
    worlds.reset()
    cut = run(worlds, 0, 70, {40: [1, 4], 55: [6]})
    for one, other in zip(whole, cut, strict=True):
        np.testing.assert_array_equal(one[others], other[others])
    assert all((one[cutting] != other[cutting]).any() for one, other in zip(whole[:3], cut, strict=False))
    assert worlds.pool.is_free.numpy().tolist() == [0, 1, 0, 0, 1, 0, 1, 0]
    assert worlds.pool.bunch.numpy()[:, 0].tolist() == [-1, 1, -1, -1, 4, -1, 6, -1]
    mask = np.isin(np.arange(8), [1, 6])
    worlds.reset(mask)
    assert worlds.pool.is_free.numpy().tolist() == [0, 0, 0, 0, 1, 0, 0, 0]
    again = run(worlds, 0, 70, {})
    for one, other in zip(whole, again, strict=True):
        np.testing.assert_array_equal(one[[1, 6]], other[[1, 6]])
    worlds.reset(mask)
    again = run(worlds, 0, 70, {40: [1], 55: [6]})
    for one, other in zip(cut, again, strict=True):
        np.testing.assert_array_equal(one[[1, 6]], other[[1, 6]])
    assert not worlds.faults.numpy().any()


@pytest.mark.slow
def test_a_bunch_for_which_there_is_no_body_hangs_on_and_is_the_fault_of_its_world() -> None:
    """Each world has two canes at the same place, and the blade cuts both peduncles, but the pool has one body. The
    second world's blade does not close."""
    worlds = Worlds(bunches(4), 2, robots=[HAND], parameters=PARAMETERS, blade=blade())
    assert worlds.pool is not None
    worlds.pool.closing.assign(np.array([True, False]))
    worlds.step()
    assert worlds.pool.is_free.numpy().tolist() == [1, 0, 0, 0]
    assert worlds.pool.needed.numpy()[0] == pytest.approx(2.0 * cutting_force.shear_force(0.004, 4.8e6), rel=1e-3)
    assert worlds.faults.numpy().tolist() == [BUNCHES, 0]
    assert worlds.fault_count.numpy().tolist() == [1, 0]
    worlds.step(5)
    assert worlds.faults.numpy().tolist() == [BUNCHES, 0]
    worlds.reset()
    assert not worlds.faults.numpy().any()
    roomy = Worlds(bunches(4), 2, robots=[HAND], parameters=PARAMETERS, blade=blade(), bunches=2)
    assert roomy.pool is not None
    roomy.pool.closing.assign(np.array([True, False]))
    roomy.step()
    roomy.step(30)
    assert roomy.pool.is_free.numpy().tolist() == [1, 0, 1, 0]
    first, second = (roomy.bodies.data.xpos.numpy()[0, body] for body in roomy.pool.body)
    np.testing.assert_array_equal(first, second)
    assert first[2] == pytest.approx(scenes.HEIGHT - 0.08 - 0.5 * 9.81 * 0.3**2, abs=0.03)
    assert not roomy.faults.numpy().any()


@pytest.mark.slow
def test_stalks_of_different_thickness_take_the_force_of_a_client_together() -> None:
    """The stalks of two canes at nearly the same place are 4 and about 2.6 mm thick. The forces of the two cuts are
    largest at different gaps between the edges, so that together they take less than their sum."""
    model = bunches(2)
    model.tree_pose[1, 1] += 0.01
    thin = np.arange(len(model.body_mass)) >= len(model.body_mass) // 2
    model.body_radius[thin & (model.body_organ == int(Organ.PEDUNCLE))] = [0.0014, 0.0012]
    physics = client(model, HAND)
    cutter = physics.add_blade("hand", "palm", MOUTH, HALF, force=200.0)
    worlds = Worlds(model, 1, robots=[HAND], parameters=PARAMETERS, blade=blade(), bunches=2)
    assert worlds.pool is not None
    cutter.close()
    worlds.pool.closing.fill_(True)
    physics.step()
    worlds.step()
    assert len(cutter.detachments) == worlds.pool.is_free.numpy().sum() == 2
    thickness = 0.0028 - 0.0004 * cutter.detachments[1].at / 0.04
    most = sum(cutting_force.shear_force(diameter, 4.8e6) for diameter in (0.004, thickness))
    assert 0.9 * most < cutter.resistance < 0.999 * most
    assert worlds.pool.needed.numpy()[0] == pytest.approx(cutter.resistance, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cutter", "needed"),
    [
        pytest.param(blade(50.0), 60.32, id="too weak"),
        pytest.param(Blade("hand", "palm", MOUTH, HALF, 62.0, kind="anvil"), 69.37, id="too weak for an anvil"),
        pytest.param(Blade("hand", "palm", MOUTH, np.array([0.03, 0.0015, 0.002])), np.inf, id="mouth too small"),
        pytest.param(Blade("hand", "palm", frames.pose(np.zeros(3)), HALF), 0.0, id="missed"),
        pytest.param(
            Blade("hand", "palm", frames.pose(np.array([-0.05, 0.0, 0.165])), np.array([0.03, 0.03, 0.01])),
            np.inf,
            id="cane",
        ),
    ],
)
def test_a_blade_that_cannot_cut_leaves_the_bunch(cutter: Blade, needed: float) -> None:
    worlds = Worlds(bunches(1), 1, robots=[HAND], parameters=PARAMETERS, blade=cutter)
    assert worlds.pool is not None
    worlds.pool.closing.fill_(True)
    worlds.step()
    assert worlds.pool.needed.numpy()[0] == pytest.approx(needed, rel=1e-3)
    assert worlds.pool.is_free.numpy()[0] == 0
    assert worlds.pool.closing.numpy()[0] == 0, "a command to close counts once"


def test_the_force_at_a_depth_is_that_of_a_client() -> None:
    depths = np.linspace(-0.1, 1.1, 200)
    for share in (cutting_force.CHORD_ENERGY_SHARE, cutting_force.DORMANT_ENERGY_SHARE):
        found = wp.zeros(len(depths), dtype=wp.float64)
        power = cutting_force.energy_exponent(share)
        wp.launch(
            share_kernel, len(depths), inputs=[wp.array(depths, dtype=wp.float64), wp.float64(power)], outputs=[found]
        )
        np.testing.assert_allclose(found.numpy(), cutting_force.force_share(depths, share), rtol=1e-12, atol=1e-15)


@wp.kernel
def share_kernel(depth: wp.array(dtype=wp.float64), power: wp.float64, found_out: wp.array(dtype=wp.float64)):
    i = wp.tid()
    found_out[i] = force_share(depth[i], power)


@pytest.mark.parametrize(
    ("cutter", "number", "message"),
    [
        (Blade("hand", "palm", MOUTH, HALF, speed=0.1), 1, "a bypass blade with 0.1 m/s"),
        (Blade("hand", "palm", MOUTH, HALF, kind="saw"), 1, "a saw blade"),
        (Blade("hand", "thumb", MOUTH, HALF), 1, "no link 'thumb'"),
        (Blade("hand", "palm", MOUTH, HALF), 0, "bunches 0"),
    ],
)
def test_blades_that_a_batch_cannot_have_are_refused(cutter: Blade, number: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Worlds(bunches(1), 1, robots=[HAND], parameters=PARAMETERS, blade=cutter, bunches=number)


@pytest.mark.slow
def test_cuts_are_the_same_to_the_bit_in_the_order_of_bodies_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four trees lie side by side in the kernels' arrays. Canes of a world are 2 cm apart, and both are cut."""
    model = bunches(12)
    model.tree_pose[6:, 1] += 0.02

    def moved() -> list[np.ndarray]:
        worlds = Worlds(model, 6, robots=[HAND], parameters=PARAMETERS, blade=blade(), bunches=2, slots=32)
        found = run(worlds, 0, 60, {40: [1, 4], 50: [3]})
        assert worlds.pool is not None
        assert worlds.pool.is_free.numpy().reshape(2, 6).sum(0).tolist() == [0, 2, 0, 2, 2, 0]
        assert not worlds.faults.numpy().any()
        return [found[0], *found[2:]]

    expected = moved()

    order_bodies_as_a_gpu(monkeypatch, 4)
    for one, other in zip(expected, moved(), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_a_bunch_falls_on_a_cane_as_in_a_client() -> None:
    """The cane of a second tree, half a metre below, is 15 mm beside the middle of the bunch; the bunch bends it down,
    and slides off. In the second world the same happens later."""
    model = bunches(2)
    model.tree_pose[1, :3] += [0.25, 0.015, -0.5]
    physics = client(model, HAND)
    cutter = physics.add_blade("hand", "palm", MOUTH, HALF, force=200.0)
    worlds = Worlds(plants_of_worlds([model], 2), 2, robots=[HAND], parameters=PARAMETERS, blade=blade())
    assert worlds.pool is not None
    begin = model.bodies_of(1)
    seen: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    lowest = 0.0
    for tick in range(90):
        if tick == 0:
            cutter.close()
        worlds.pool.closing.assign(np.array([tick == 0, tick == 10]))
        physics.step()
        worlds.step()
        if tick < 80:
            seen[0].append(poses_in_batch(worlds)[0].copy())
            np.testing.assert_allclose(seen[0][-1], pose_in_client(physics), atol=1e-4)
        if tick >= 10:
            seen[1].append(poses_in_batch(worlds)[1].copy())
        if tick == 79:
            physics.update_kinematics()
            worlds.download()
            found = worlds.plants.state.body_q.reshape(2, 2, -1, 7)[1, 0]
            np.testing.assert_allclose(found, physics.state.body_q[begin], atol=1e-4)
        lowest = min(lowest, float(physics.state.body_q[begin][12, 2]) - 1.5)
    np.testing.assert_allclose(seen[0], seen[1], atol=1e-4)
    assert lowest < -0.02, "the bunch has pressed on the cane"
    assert not worlds.faults.numpy().any()
