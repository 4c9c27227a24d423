"""Blades in batches of worlds cut canes: stumps and what falls move as in a client, in their own world only."""

import msgspec
import numpy as np
import pytest

from tests.physics.test_worlds import PARAMETERS
from tests.physics.test_worlds_cutting import client
from tests.support.layouts import order_bodies_as_a_gpu
from vinesim.core import frames
from vinesim.interaction import cutting_force
from vinesim.interaction.blades import Blade
from vinesim.scene.builder import RodMaterial, TreeBuilder, assemble
from vinesim.scene.model import Model
from vinesim.scene.spare_bodies import with_spares
from vinesim.scene.values import Drive, RobotSpec

pytest.importorskip("mujoco_warp")
from vinesim.kernels.worlds.reset import STUMPS
from vinesim.learn.arm import arm
from vinesim.learn.shoots import shoots
from vinesim.worlds.plants import plants_of_worlds
from vinesim.worlds.worlds import Worlds

pytestmark = pytest.mark.usefixtures("layout")

INERTIA = '<mass value="2"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
SHEARS = RobotSpec(
    "shears",
    0,
    f'<robot name="shears"><link name="base_footprint"><inertial>{INERTIA}</inertial></link>'
    f'<link name="head"><inertial>{INERTIA}</inertial></link><joint name="lift" type="prismatic">'
    '<parent link="base_footprint"/><child link="head"/><axis xyz="0 0 1"/>'
    '<limit lower="-0.3" upper="0.3" effort="500" velocity="2"/></joint></robot>',
    "base_footprint",
    frames.pose(np.array([0.0, 0.0, 1.0])),
    (Drive("lift", 4000.0, 200.0, 500.0, 2.0, -0.3, 0.3),),
    np.zeros(1),
)
"""A pair of shears 1 m above the ground that moves up and down and touches nothing."""
HALF = np.array([0.03, 0.03, 0.01])
BLADE = Blade("shears", "head", frames.pose(np.zeros(3)), HALF)


def hanging(count: int, spares: int = 3, side: float = 0.0) -> Model:
    """Canes of two segments of 0.2 m that hang in the middle of the shears' way, with a side shoot in the lower one."""
    trees = []
    for i in range(count):
        tree = TreeBuilder(frames.pose(np.array([0.0, i * side, 1.2])))
        wood = RodMaterial(2e8, 900.0, 0.1, shear_modulus=8e7)
        down = frames.from_x_axis(np.array([0.0, 0.0, -1.0]))
        last = tree.add_rod(-1, 0.4, (0.004, 0.003), wood, 2, rest=down)[-1]
        tree.add_rod(last, 0.2, (0.002, 0.002), wood, 2, rest=frames.from_x_axis(np.array([1.0, 1.0, 1.0])))
        tree.solve_rest_pose()
        trees.append(tree)
    return with_spares(assemble(trees), spares)


def poses(worlds: Worlds) -> np.ndarray:
    """Returns the poses [world, body, 7] of worlds with one tree each."""
    worlds.download()
    return worlds.plants.state.body_q.reshape(worlds.count, -1, 7)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "segment"), [(1, 4), (2, 2), (3, 0)])
def test_a_shoot_falls_with_its_bunch_and_lies_down_as_in_a_client(seed: int, segment: int) -> None:
    """A shoot swings, and a blade that stands still cuts it. One second: the shoot falls to the ground and lies. From
    the second blow on, rounding errors grow."""
    rng = np.random.default_rng(seed)
    model = with_spares(shoots(1, rng, 1.2))
    robot = arm((0.0, 0.0, 0.6))
    physics = client(model, robot)
    live = ~model.is_spare()
    physics.state.joint_qd[live] = rng.normal(0.0, 0.3, (live.sum(), 3))
    start = physics.state.joint_qd.copy()
    for _ in range(5):
        physics.step()
    physics.update_kinematics()
    pose = physics.state.body_q[segment].astype(float)
    place = frames.compose(pose, frames.pose(np.array([0.4 * float(model.body_length[segment]), 0.0, 0.0])))
    across = frames.from_x_axis(frames.rotate(pose[3:], np.array([0.0, 1.0, 0.1])))
    place[3:] = frames.multiply(across, frames.exp(np.array([0.7, 0.0, 0.0])))
    mouth = frames.compose(frames.inverse(physics.rigid.link_pose("arm", "base_footprint")), place)
    cutter = physics.add_blade("arm", "base_footprint", mouth, HALF)
    blade = Blade("arm", "base_footprint", mouth, HALF)
    models = plants_of_worlds([model], 2)
    worlds = Worlds(models, 2, robots=[robot], parameters=PARAMETERS, slots=64, blade=blade)
    assert worlds.pool is not None
    worlds.plants.state.joint_qd[:] = np.tile(start, (2, 1))
    worlds.plants.upload()
    worlds.step(5)
    cutter.close()
    worlds.pool.closing.assign(np.array([True, False]))
    for tick in range(100):
        physics.step()
        worlds.step()
        if tick == 0:
            assert cutter.detachments[0].body == segment
            stump = worlds.plants.buffers.slots[np.flatnonzero(model.is_spare())[0]]
            place_along = worlds.pool.canes.parts[0].end.numpy()[stump]
            assert place_along == pytest.approx(cutter.detachments[0].at, abs=1e-7)
            assert worlds.pool.needed.numpy()[0] == pytest.approx(cutter.resistance, rel=1e-5)
            worlds.download()
            for name in ("body_mass", "body_com", "body_inertia", "body_product", "body_drag"):
                ours = getattr(worlds.plants, name)[: len(live)]
                np.testing.assert_allclose(ours, getattr(physics.plants, name), rtol=1e-5, atol=1e-12)
        if tick % 10 == 9:
            physics.update_kinematics()
            near = 1e-4 if tick < 70 else 1e-3
            np.testing.assert_allclose(poses(worlds)[0, :, :3], physics.state.body_q[:, :3], atol=near)
    bunch = int(model.bunch_body[0])
    assert poses(worlds)[0, bunch, 2] < 0.2
    assert poses(worlds)[1, bunch, 2] > 0.6
    assert not worlds.faults.numpy().any()


@pytest.mark.slow
def test_pieces_and_stumps_are_cut_again_as_in_a_client() -> None:
    """Without weight. The first cut parts the upper segment of a cane, the second one the piece, the third one the
    stump; what grows on the lower segment stays on it."""
    parameters = msgspec.structs.replace(PARAMETERS, gravity=0.0)
    model = hanging(1)
    worlds = Worlds(model, 1, robots=[SHEARS], parameters=parameters, blade=BLADE)
    physics = client(model, SHEARS, parameters)
    cutter = physics.add_blade("shears", "head", BLADE.pose, HALF)
    assert worlds.pool is not None
    for tick, height in enumerate([0.1] * 60 + [0.05] * 60 + [0.15] * 60):
        physics.rigid.command("shears", np.array([height]))
        worlds.bodies.targets.assign(np.array([[height]], np.float32))
        if tick % 60 == 50:
            cutter.close()
            worlds.pool.closing.fill_(True)
        physics.step()
        worlds.step()
        if tick % 60 == 50:
            assert len(cutter.detachments) == 1
            assert worlds.pool.needed.numpy()[0] == pytest.approx(cutter.resistance, rel=1e-4)
    physics.update_kinematics()
    np.testing.assert_allclose(poses(worlds)[0], physics.state.body_q, atol=1e-4)
    for name in ("body_mass", "body_com", "body_inertia", "joint_stiffness", "_parent", "_root"):
        np.testing.assert_allclose(getattr(worlds.plants, name), getattr(physics.plants, name), rtol=1e-4, atol=1e-9)
    parts = worlds.pool.canes.parts[0]
    end, start = (one.numpy()[worlds.plants.buffers.slots] for one in (parts.end, parts.start))
    spare = int(model.tree_first[0] + model.tree_core[0] - 3)
    np.testing.assert_allclose(end[spare : spare + 3], [0.1, 0.15, 0.05], atol=1e-3)
    np.testing.assert_allclose(start[[0, spare, spare + 1, spare + 2]], [0.15, 0.05, 0.1, 0.0], atol=1e-3)
    assert not worlds.faults.numpy().any()


@pytest.mark.slow
def test_stump_and_piece_keep_mass_and_momentum_and_the_piece_falls_with_its_weight() -> None:
    model = hanging(1)
    worlds = Worlds(model, 1, robots=[SHEARS], parameters=PARAMETERS, blade=BLADE)
    assert worlds.pool is not None
    rng = np.random.default_rng(5)
    worlds.plants.state.joint_qd[:4] = rng.normal(0.0, 1.0, (4, 3))
    worlds.plants.upload()
    worlds.step(3)

    def moments(bodies: list[int]) -> tuple[float, np.ndarray, np.ndarray]:
        """Returns mass [kg], first moment [kg m] and momentum [N s] of bodies."""
        plants = worlds.plants
        pose, motion = (rows[bodies].astype(float) for rows in (plants.state.body_q, plants.state.body_qd))
        arm_of = frames.rotate(pose[:, 3:], plants.body_com[bodies].astype(float))
        mass = plants.body_mass[bodies].astype(float)
        velocity = motion[:, :3] + np.cross(motion[:, 3:], arm_of)
        return float(mass.sum()), mass @ (pose[:, :3] + arm_of), mass @ velocity

    poses(worlds)
    worlds.pool.closing.fill_(True)
    worlds.step()
    poses(worlds)
    plants = worlds.plants
    mass, first, momentum = moments([0, 1, 2, 3, 4])
    whole = model.body_mass[:4].astype(float)
    assert mass == pytest.approx(whole.sum(), rel=1e-6)
    at = frames.rotate(plants.state.body_q[:4, 3:].astype(float), model.body_com[:4].astype(float))
    np.testing.assert_allclose(first, whole @ (plants.state.body_q[:4, :3] + at), rtol=1e-6)
    turning = plants.state.body_qd[:4].astype(float)
    np.testing.assert_allclose(momentum, whole @ (turning[:, :3] + np.cross(turning[:, 3:], at)), atol=1e-8)
    assert np.linalg.norm(momentum) > 1e-4
    piece = np.flatnonzero(plants._root[:5] >= 0).tolist()
    assert len(piece) == 4 - 1 + (plants._root[0] >= 0)
    before, _, start = moments(piece)
    worlds.step(20)
    poses(worlds)
    after, _, end = moments(piece)
    assert after == before
    np.testing.assert_allclose(end - start, [0.0, 0.0, -9.81 * 0.2 * before], atol=2e-5 * before)


@pytest.mark.slow
def test_only_the_worlds_that_cut_change_and_a_reset_world_repeats_all_to_the_bit() -> None:
    worlds = Worlds(hanging(6), 6, robots=[SHEARS], parameters=PARAMETERS, blade=BLADE)
    assert worlds.pool is not None

    def run(cuts: dict[int, list[int]]) -> list[np.ndarray]:
        assert worlds.pool is not None
        for tick in range(60):
            worlds.bodies.targets.fill_(0.1 if tick < 30 else 0.15)
            worlds.pool.closing.assign(np.isin(np.arange(6), cuts.get(tick, [])))
            worlds.step()
        plants = worlds.plants
        rows = [poses(worlds), plants.state.joint_qd, plants.body_mass, plants.joint_stiffness, plants._root]
        return [np.array(row).reshape(6, -1) for row in rows]

    whole = run({})
    worlds.reset()
    cuts = {20: [1, 4], 50: [4, 5]}
    cut = run(cuts)
    for one, other in zip(whole, cut, strict=True):
        np.testing.assert_array_equal(one[[0, 2, 3]], other[[0, 2, 3]])
        assert (one[[1, 4, 5]] != other[[1, 4, 5]]).any(1).all()
    mask = np.isin(np.arange(6), [1, 4, 5])
    worlds.reset(mask)
    again = run({})
    for one, other in zip(whole, again, strict=True):
        np.testing.assert_array_equal(one[mask], other[mask])
    worlds.reset(mask)
    again = run(cuts)
    for one, other in zip(cut, again, strict=True):
        np.testing.assert_array_equal(one[mask], other[mask])
    assert not worlds.faults.numpy().any()


@pytest.mark.slow
def test_a_tree_without_a_spare_body_for_another_stump_hangs_on_and_is_the_fault_of_its_world() -> None:
    worlds = Worlds(hanging(2, spares=1), 2, robots=[SHEARS], parameters=PARAMETERS, blade=BLADE)
    assert worlds.pool is not None
    for height, closes in ((0.05, [True, True]), (0.15, [True, False])):
        worlds.bodies.targets.fill_(height)
        worlds.step(60)
        worlds.pool.closing.assign(np.array(closes))
        worlds.step()
    assert worlds.faults.numpy().tolist() == [STUMPS, 0]
    assert worlds.fault_count.numpy().tolist() == [1, 0]
    np.testing.assert_allclose(poses(worlds)[0, 2], poses(worlds)[1, 2], atol=1e-6)
    worlds.reset()
    assert not worlds.faults.numpy().any()


@pytest.mark.slow
def test_a_blade_that_is_too_weak_and_a_tree_without_spare_bodies_leave_the_cane() -> None:
    needed = cutting_force.shear_force(2 * 0.00325, PARAMETERS.cutting_strength)
    weak = Blade("shears", "head", BLADE.pose, HALF, 0.9 * needed)
    worlds = Worlds(hanging(1), 1, robots=[SHEARS], parameters=PARAMETERS, blade=weak)
    assert worlds.pool is not None
    worlds.pool.closing.fill_(True)
    worlds.step()
    assert 0.9 * needed < worlds.pool.needed.numpy()[0] < 1.3 * needed
    assert (worlds.plants._root < 0).all()


@pytest.mark.slow
def test_cuts_are_the_same_to_the_bit_in_the_order_of_bodies_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four trees lie side by side in the kernels' arrays."""

    def moved() -> np.ndarray:
        worlds = Worlds(hanging(6), 3, robots=[SHEARS], parameters=PARAMETERS, blade=BLADE)
        assert worlds.pool is not None
        seen = []
        for tick in range(40):
            worlds.pool.closing.assign(np.array([tick == 5, tick == 15, False]))
            worlds.step()
            worlds.download()
            seen.append(worlds.plants.state.body_q.copy())
        assert not worlds.faults.numpy().any()
        return np.array(seen)

    expected = moved()

    order_bodies_as_a_gpu(monkeypatch, 4)
    np.testing.assert_array_equal(expected, moved())
