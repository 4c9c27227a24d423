"""Uneven ground in the physics: MuJoCo and plants meet the triangles of ``Terrain``, things hold and slide as friction
says, and the base of a robot follows the ground."""

from __future__ import annotations

import dataclasses

import msgspec
import mujoco
import numpy as np
import pytest

from tests.support.robot_yard import Yard
from tests.support.terrain_scenes import bare, hills, incline
from vinesim.core import frames
from vinesim.rigid.human_posture import standing_pose
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.rigid.robot_body import RobotBody
from vinesim.rigid.static_world import ROBOT_CODES
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.odometry import SLOPE_SLIP
from vinesim.scene.builder import assemble
from vinesim.scene.cane import CaneBuilder
from vinesim.scene.generation.vineyard import generate, generate_uncached
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spec import TerrainTable, load_scene
from vinesim.scene.state import State
from vinesim.scene.terrain import Terrain, above_ground
from vinesim.scene.values import HumanSpec
from vinesim.sensors.primitives.ray_caster import RayCaster
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.wind.shelter import TreeDrag
from vinesim.world import Physics

GRAVITY = 9.81


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


def step(rigid: RigidWorld, steps: int) -> None:
    for _ in range(steps):
        rigid.predict()
        rigid.integrate()


# one law for all


def test_mujoco_has_the_same_triangles() -> None:
    terrain = hills()
    rigid = RigidWorld(bare(terrain))
    m, d = rigid.mj_model, rigid.mj_data
    mujoco.mj_forward(m, d)
    rng = np.random.default_rng(2)
    x, y = rng.uniform(*np.array([terrain.origin, terrain.end]), (500, 2)).T
    geom = np.zeros(1, np.int32)
    down = np.array([0.0, 0.0, -1.0])
    fall = [mujoco.mj_ray(m, d, np.array([a, b, 9.0]), down, None, 1, -1, geom) for a, b in zip(x, y, strict=True)]
    assert np.abs(9.0 - np.array(fall) - terrain.height(x, y)).max() < 1e-6


def resting_cane(terrain: Terrain | None, *, base: float = 0.3) -> tuple[Physics, np.ndarray]:
    """A soft cane, clamped above the ground, after it has sunk onto it; and points along its axis."""
    cane = CaneBuilder(
        length=1.0,
        radius=(0.004, 0.003),
        youngs_modulus=3e8,
        density=900.0,
        damping_ratio=0.3,
        tip_mass=0.05,
        pose=frames.pose([0.3, 0.2, base]),
    )
    model = dataclasses.replace(assemble([cane.tree()]), terrain=terrain)
    physics = Physics(model)
    physics.plants.wake(np.array([0]))
    for _ in range(500):
        physics.step()
    physics.update_kinematics()
    ends = frames.compose(physics.state.body_q, frames.pose([float(model.body_length[-1]), 0.0, 0.0]))
    return physics, ends[:, :3]


def test_a_cane_rests_on_level_terrain_as_on_the_plane() -> None:
    (_, plane), (_, level) = (resting_cane(terrain) for terrain in (None, incline(0.0)))
    assert plane[-1, 2] == pytest.approx(0.003, abs=1e-3)
    assert np.abs(plane - level).max() < 1e-5


@pytest.mark.parametrize("terrain", [incline(0.1, 0.05), hills(5, roughness=0.01)], ids=["incline", "hills"])
def test_a_cane_rests_on_uneven_ground(terrain: Terrain) -> None:
    physics, ends = resting_cane(terrain, base=0.3 + float(terrain.height(0.3, 0.2)))
    normal = terrain.normal(ends[:, 0], ends[:, 1])
    gap = (ends[:, 2] - terrain.height(ends[:, 0], ends[:, 1])) * normal[:, 2] - physics.model.body_radius[:, 1]
    assert gap.min() == pytest.approx(0.0, abs=1e-3)
    assert physics.faults["contacts_dropped"] == 0
    assert {contact.link for contact in physics.contacts} == {"ground"}


def test_a_cane_across_two_tiles_touches_the_ground_once() -> None:
    terrain = incline(0.1, nodes=161)  # its tiles meet at x = -8 + 4 k, so one border is below the cane's tip
    moved = dataclasses.replace(terrain, origin=(terrain.origin[0] + 1.27 - 4.0, terrain.origin[1]))
    (one, inside), (two, across) = (resting_cane(ground, base=0.33) for ground in (terrain, moved))
    assert np.abs(inside - across).max() < 2e-4
    assert len(two.contacts) == len(one.contacts)


# friction


def box_on(slope: float, friction: float, cell: float = 0.1) -> tuple[RigidWorld, np.ndarray]:
    terrain = incline(slope, cell=cell)
    model = bare(terrain, boxes=1)
    model.box_pose[0] = terrain.resting_pose(0.0, 0.0, 0.0, (0.2, 0.15))
    return RigidWorld(model, parameters=PhysicsParameters(friction=friction)), model.box_pose[0].astype(float)


@pytest.mark.parametrize("cell", [0.05, 0.1, 0.4])
def test_a_box_holds_below_the_angle_of_friction_and_slides_above_it(cell: float) -> None:
    """MuJoCo's own contacts with a height field of 10 cm cells slow the sliding box to 43 % of that."""
    rigid, start = box_on(0.28, 0.3, cell)
    step(rigid, 300)
    assert np.linalg.norm(rigid.visual_q()[0, :3] - start[:3]) < 2e-3
    rigid, start = box_on(0.40, 0.3, cell)
    step(rigid, 100)
    angle = np.arctan(0.40)
    slid = np.linalg.norm(rigid.visual_q()[0, :3] - start[:3])
    assert slid == pytest.approx(0.5 * GRAVITY * (np.sin(angle) - 0.3 * np.cos(angle)), rel=0.05)


def test_a_box_falls_onto_rough_ground_and_comes_to_rest_on_it() -> None:
    terrain = hills(4, roughness=0.01)
    model = bare(terrain, boxes=1)
    model.box_pose[0] = frames.pose([0.3, 0.4, float(terrain.height(0.3, 0.4)) + 0.2])
    rigid = RigidWorld(model)
    step(rigid, 300)
    rest = rigid.visual_q()[0].copy()
    corners = np.array([[x, y, 0.0] for x in (-0.2, 0.2) for y in (-0.15, 0.15)])
    points = rest[:3] + frames.rotate(rest[3:], corners)
    above = points[:, 2] - terrain.height(points[:, 0], points[:, 1])
    assert above.max() < 0.06
    assert above.min() > -0.01
    step(rigid, 200)
    assert np.linalg.norm(rigid.visual_q()[0, :3] - rest[:3]) < 1e-3


def test_contacts_that_are_not_used_have_no_rows() -> None:
    """The solver of contacts with plants reads the rows of all contacts."""
    rigid, _ = box_on(0.25, 0.8)
    step(rigid, 5)
    contact, rows = rigid.mj_data.contact, rigid.mj_data.nefc
    used = contact.exclude == 0
    assert 3 <= used.sum() <= 9
    assert used.sum() < len(contact.exclude)
    assert (contact.efc_address[~used] == -1).all()
    assert (contact.efc_address[used] < rows).all()
    assert rigid.penetrations() == [] or max(depth for *_, depth in rigid.penetrations()) < 2e-3


def ridges() -> Terrain:
    """Smooth ridges on an inclined plane, in x and in y, up to the edges of the grid and hence beyond."""
    terrain = incline(0.1, -0.05, nodes=81)
    at = terrain.origin[0] + terrain.cell * np.arange(81)
    height = 0.05 * np.sin(1.2 * at) + 0.05 * np.sin(0.9 * at)[:, None]
    return dataclasses.replace(terrain, residual=height.astype(np.float32))


PLACES = {
    "on the grid": (1.0, 0.5),
    "across its edge": (4.05, 0.5),
    "beyond it": (7.0, 0.5),
    "at a corner": (9.0, -8.0),
}


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
def test_a_box_rests_on_the_heights_that_rays_meet_also_beyond_the_grid(place: tuple[float, float]) -> None:
    terrain = ridges()
    model = bare(terrain, boxes=1)
    resting = terrain.resting_pose(*place, 0.0, (0.2, 0.15))
    model.box_pose[0] = frames.compose(resting, frames.pose([0.0, 0.0, 0.05]))
    rigid = RigidWorld(model)
    step(rigid, 200)
    rest = rigid.visual_q()[0].copy()
    assert rest[:3] == pytest.approx(resting[:3], abs=0.01)
    corners = np.array([[x, y, 0.0] for x in (-0.2, 0.2) for y in (-0.15, 0.15)])
    points = rest[:3] + frames.rotate(rest[3:], corners)
    primitives = Primitives(bare(terrain), grass=0.0)
    primitives.update(rest_snapshot(bare(terrain)))
    down = np.tile([0.0, 0.0, -1.0], (4, 1))
    distance, _ = RayCaster(primitives).cast(points + np.array([0.0, 0.0, 1.0]), down, 9.0)
    gap = distance - 1.0
    assert distance == pytest.approx(points[:, 2] + 1.0 - terrain.height(points[:, 0], points[:, 1]), abs=1e-5)
    assert gap.min() == pytest.approx(0.0, abs=2e-3)
    assert gap.max() < 0.01  # the ridges rise less than that under a box


def stay_awake(rigid: RigidWorld) -> None:
    """Switch off MuJoCo's sleep, which would hide a slow motion."""
    rigid.mj_model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)


@pytest.mark.parametrize("x", [0.0, 5.95, 9.0], ids=["on the grid", "across its edge", "beyond it"])
@pytest.mark.parametrize("slope", [0.1, 0.45])
def test_a_box_does_not_creep_where_friction_holds(slope: float, x: float) -> None:
    terrain = incline(slope)
    model = bare(terrain, boxes=1)
    model.box_pose[0] = terrain.resting_pose(x, 0.2, 0.3, (0.2, 0.15))
    rigid = RigidWorld(model)
    stay_awake(rigid)
    step(rigid, 50)
    start = rigid.visual_q()[0].copy()
    step(rigid, 500)
    assert np.linalg.norm(rigid.visual_q()[0, :3] - start[:3]) < 2e-5


def test_bunches_that_were_cut_do_not_creep_on_the_slope() -> None:
    physics = Physics(generate(load_scene("slope")))
    bunches = [0, 2, 5]
    for bunch in bunches:
        physics.pick(bunch)

    def run(steps: int) -> np.ndarray:
        for _ in range(steps):
            stay_awake(physics.rigid)
            physics.step()
        poses = zip(physics.rigid.visuals(), physics.rigid.visual_q(), strict=True)
        return np.array([pose[:3] for link, pose in poses if link.name in {f"bunch/{one}" for one in bunches}])

    start = run(300)  # they fall and roll
    terrain = physics.model.terrain
    assert len(start) == 3
    assert (above_ground(terrain, start) < 0.15).all()
    assert np.linalg.norm(run(500) - start, axis=1).max() < 5e-4


def test_hands_take_nothing_of_the_ground() -> None:
    rigid = RigidWorld(bare(incline(0.1)))
    rigid.add_human(HumanSpec("eva", 0, standing_pose(frames.pose([0.0, 0.0, -0.8]))))  # her hands are in the ground
    assert rigid.nearest_to_hand("eva", "left", 0.5) is None


# robots


def test_a_robot_stands_in_the_plane_under_its_footprint(vinebot: RobotDescription) -> None:
    terrain = hills(7, roughness=0.01)
    yard = Yard(vinebot, frames.pose([0.5, 0.3, 0.0], frames.from_yaw(0.8)), terrain)
    yard.run(0.5)
    follower = yard.rigid.robot("anna").follower
    assert follower is not None
    assert follower.footprint == pytest.approx((0.40, 0.35), abs=1e-6)  # its tracks
    pose, rate = yard.rigid.base_state("anna")
    height, along, across = terrain.fit_plane(0.5, 0.3, 0.8, follower.footprint)
    assert pose[:3] == pytest.approx([0.5, 0.3, height], abs=1e-5)
    assert frames.rotate(pose[3:], np.array([1.0, 0.0, 0.0]))[2] == pytest.approx(np.sin(np.arctan(along)), abs=1e-5)
    assert frames.to_yaw(pose[3:]) == pytest.approx(0.8, abs=1e-6)
    up = frames.rotate(pose[3:], np.array([0.0, 0.0, 1.0]))
    level = frames.rotate(frames.from_yaw(0.8), frames.normalize(np.array([-along, -across, 1.0])))
    assert up == pytest.approx(level, abs=1e-5)
    assert np.abs(rate).max() < 1e-4


def test_on_an_incline_speed_and_instruments_are_those_of_the_surface(vinebot: RobotDescription) -> None:
    """0.6 m/s along the surface; the accelerometer at constant speed measures gravity in the base's axes."""
    terrain = incline(0.1, 0.05, nodes=201)
    yard = Yard(vinebot, frames.pose([-2.0, 0.0, 0.0], frames.from_yaw(0.3)), terrain)
    samples = []
    for _ in range(400):
        yard.robot.command_base(0.6, 0.0, yard.time)
        yard.run(yard.rigid.dt)
        samples.append(yard.robot.sample(yard.time))
    way = np.linalg.norm(samples[-1].base_q[:3] - samples[-201].base_q[:3])
    assert way == pytest.approx(0.6 * 2.0, rel=1e-3)
    last = samples[-1]
    assert frames.rotate(frames.conjugate(last.base_q[3:]), last.base_qd[:3]) == pytest.approx([0.6, 0, 0], abs=2e-3)
    imu = last.imus[0]
    up = frames.rotate(frames.conjugate(imu.orientation), np.array([0.0, 0.0, GRAVITY]))
    assert imu.linear_acceleration == pytest.approx(up, abs=0.05)
    assert np.abs(imu.angular_velocity).max() < 2e-3
    turn = frames.multiply(frames.conjugate(last.base_q[3:]), imu.orientation)
    level = frames.multiply(frames.conjugate(samples[0].base_q[3:]), samples[0].imus[0].orientation)
    assert turn == pytest.approx(level, abs=1e-3)  # the unit is fixed to the body, or to a still head
    assert last.odom_q[:3] == pytest.approx(
        frames.rotate(frames.conjugate(samples[0].base_q[3:]), last.base_q[:3] - samples[0].base_q[:3])
        + samples[0].odom_q[:3],
        abs=2e-3,
    )


def test_on_hills_velocities_are_the_derivatives_of_the_pose(vinebot: RobotDescription) -> None:
    terrain = hills(8, roughness=0.008)
    yard = Yard(vinebot, frames.pose([-1.0, 0.0, 0.0], frames.from_yaw(0.2)), terrain)
    before = None
    for k in range(300):
        yard.robot.command_base(0.5, 0.2, yard.time)
        yard.run(yard.rigid.dt)
        pose, rate = yard.rigid.base_state("anna")
        if before is not None and k > 100:
            moved = (pose[:3] - before[:3]) / yard.rigid.dt
            turned = frames.log(frames.multiply(pose[3:], frames.conjugate(before[3:]))) / yard.rigid.dt
            assert moved == pytest.approx(rate[:3], abs=1e-6)
            assert turned == pytest.approx(rate[3:], abs=2e-3)
            imu = yard.robot.sample(yard.time).imus[0]
            spin = frames.rotate(imu.orientation, imu.angular_velocity)
            assert spin[:2] == pytest.approx(rate[3:5], abs=0.02)  # a head on its neck adds a little
        before = pose


@pytest.mark.parametrize("uphill", [1.0, -1.0])
def test_tracks_slip_more_uphill_and_less_downhill(vinebot: RobotDescription, uphill: float) -> None:
    limits = msgspec.structs.replace(vinebot.base_limits, slip=(0.05, 0.0))
    slope = 0.2 * uphill
    yard = Yard(dataclasses.replace(vinebot, base_limits=limits), frames.pose([-2.0, 0, 0]), incline(slope, nodes=201))
    start = yard.robot.sample(0.0).base_q
    for _ in range(400):
        yard.robot.command_base(0.6, 0.0, yard.time)
        yard.run(yard.rigid.dt)
    sample = yard.robot.sample(yard.time)
    way = float(np.linalg.norm(sample.base_q[:3] - start[:3]))
    assert way > 2.0
    assert sample.odom_q[0] == pytest.approx(way / (1.0 - 0.05 - SLOPE_SLIP * slope), rel=1e-3)
    ahead = frames.rotate(frames.conjugate(sample.base_q[3:]), sample.base_qd[:3])[0]
    assert ahead == pytest.approx(0.6, rel=0.02)
    assert sample.odom_qd[0] == pytest.approx(ahead / (1.0 - 0.05 - SLOPE_SLIP * slope), rel=1e-3)


def test_joints_carry_the_weight_of_a_tilted_arm(vinebot: RobotDescription) -> None:
    """At rest the efforts of the drives equal the weight's moments, computed from the tilted poses of the links."""
    level, tilted = (Yard(vinebot, frames.pose([0.0, 0.0, 0.0]), t) for t in (None, incline(0.15, 0.1)))
    for yard in (level, tilted):
        yard.run(1.0)
        rigid = yard.rigid
        m, d = rigid.mj_model, rigid.mj_data
        drives = rigid.robot("anna").v
        weight = np.zeros(m.nv)
        for body in range(1, m.nbody):
            mujoco.mj_applyFT(m, d, [0, 0, GRAVITY * m.body_mass[body]], np.zeros(3), d.xipos[body], body, weight)
        effort = rigid.joint_measurements("anna")[2]
        assert effort == pytest.approx(weight[drives], abs=0.3)
    efforts = [yard.rigid.joint_measurements("anna")[2] for yard in (level, tilted)]
    assert np.abs(efforts[1] - efforts[0]).max() > 1.0


def test_the_copy_of_a_robot_follows_it_over_hills(vinebot: RobotDescription) -> None:
    terrain = hills(9, roughness=0.008)
    yard, other = (Yard(vinebot, frames.pose([-1.0, 0.0, 0.0]), terrain) for _ in range(2))
    for _ in range(300):
        yard.robot.command_base(0.5, 0.1, yard.time)
        yard.run(yard.rigid.dt)
        q, qd = yard.rigid.base_state("anna")
        other.rigid.follow_remote("anna", q, qd, *yard.rigid.joint_state("anna"))
        step(other.rigid, 1)
    here, there = (y.rigid.base_state("anna")[0] for y in (yard, other))
    assert there[:3] == pytest.approx(here[:3], abs=0.02)
    assert frames.log(frames.multiply(frames.conjugate(here[3:]), there[3:])) == pytest.approx([0, 0, 0], abs=0.02)


@pytest.mark.parametrize(("share", "slides"), [(0.9, True), (1.1, False)])
def test_tracks_hold_a_robot_on_an_incline_if_they_are_strong_enough(
    vinebot: RobotDescription, share: float, slides: bool
) -> None:
    slope = 0.3
    weight = GRAVITY * float(Yard(vinebot).rigid.mj_model.body_subtreemass[1])
    needed = weight * np.sin(np.arctan(slope))
    limits = msgspec.structs.replace(vinebot.base_limits, effort=(share * needed, 400.0))
    yard = Yard(dataclasses.replace(vinebot, base_limits=limits), frames.pose([0, 0, 0]), incline(slope))
    yard.run(1.0)
    pose, rate = yard.rigid.base_state("anna")
    along = pose[0] * np.sqrt(1.0 + slope**2)
    if slides:  # with the part of its weight that the tracks do not hold
        assert along == pytest.approx(-0.5 * (1.0 - share) * GRAVITY * np.sin(np.arctan(slope)), rel=0.1)
        assert rate[0] < 0.0
    else:
        assert abs(along) < 0.01


def test_without_terrain_a_base_has_three_joints(vinebot: RobotDescription) -> None:
    spec = vinebot.to_spec("anna")
    assert RobotBody(spec, ROBOT_CODES[0]).follower is None
    joints = [len(Yard(vinebot, None, t).rigid.robot("anna").base_q) for t in (None, incline(0.0))]
    assert joints == [3, 3]
    count = [Yard(vinebot, None, terrain).rigid.mj_model.nv for terrain in (None, incline(0.0))]
    assert count[1] == count[0] + 3


def test_the_wind_at_a_plant_depends_on_its_height_above_the_ground() -> None:
    scene = load_scene("vsp")
    small = msgspec.structs.replace(scene, layout=msgspec.structs.replace(scene.layout, rows=2, vines=2))
    models = [
        generate_uncached(msgspec.structs.replace(small, terrain=table)) for table in (None, TerrainTable(slope=0.4))
    ]
    level, slope = (TreeDrag.of(model, State.at_rest(model).body_q) for model in models)
    assert slope.profile == pytest.approx(level.profile, rel=0.15)
    assert slope.depth == pytest.approx(level.depth, rel=0.1)
