"""A robot drives along a row of the scene ``slope``: 10 % uphill, with ruts. Its body, inertial unit, wheel speeds,
GNSS receiver, camera and lidar agree with the heights of the ground, within their noise."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from vinesim.core import frames, geodesy
from vinesim.core.geodesy import APRILIA, Geodetic
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.odometry import SLOPE_SLIP
from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.scene.spec import Season, load_scene
from vinesim.scene.terrain import Terrain
from vinesim.scene.values import CameraOutput, FixKind, GnssMount
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.gnss import Gnss, GnssSpec
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot

SPEED = 0.8
SLIP = 0.05
GRAVITY = 9.81
GYRO_NOISE = 0.003
"""[rad/s] Standard deviation of the inertial unit, and [m/s2] of its accelerometer."""
ACCELEROMETER_NOISE = 0.02
ANTENNA = "head_2_link"
GROUND = label(Organ.GROUND, 0)


def vineyard(length: float) -> Model:
    """Two rows of ``length`` [m] without fruit and with few leaves, on the ground of the scene ``slope``: uphill is
    along the rows, and a little across."""
    scene = load_scene("slope")
    return generate_uncached(
        msgspec.structs.replace(
            scene,
            layout=msgspec.structs.replace(scene.layout, vines=2 + int(length / scene.layout.vine_spacing)),
            fruit=msgspec.structs.replace(scene.fruit, bunches=(0, 0)),
            season=Season(leafiness=0.05),
            boxes=(),
        )
    )


def robot_with_noise() -> RobotDescription:
    """Vinebot with tracks that slip and an inertial unit with noise."""
    described = load_description("vinebot")
    (imu,) = described.imus
    noisy = msgspec.structs.replace(imu, angular_velocity_noise=GYRO_NOISE, acceleration_noise=ACCELEROMETER_NOISE)
    limits = msgspec.structs.replace(described.base_limits, slip=(SLIP, 0.0))
    return dataclasses.replace(described, base_limits=limits, imus=(noisy,))


def looking_down(rigid: RigidWorld) -> np.ndarray:
    """The optical frame of the head's camera, nodding by 0.5 rad."""
    frame = rigid.link_pose("anna", "head_front_camera_rgb_optical_frame")
    return frames.compose(frame, frames.pose(np.zeros(3), frames.exp(np.array([-0.5, 0.0, 0.0]))))


def depth_errors(terrain: Terrain, primitives: Primitives, pose: np.ndarray) -> np.ndarray:
    """Heights [n] of what the depth camera measures above the ground, in units of the standard deviation of its
    noise; grass, leaves and the robot are left out."""
    spec = CameraSpec.load("d435")
    camera = Camera(spec, spec.info("eyes", size=(160, 120)), quality="fast")
    frame = camera.render(primitives, pose, outputs=CameraOutput.ALL & ~CameraOutput.BUNCHES)
    v, u = np.mgrid[: frame.info.height, : frame.info.width]
    ray = np.stack(
        [(u - frame.info.cx) / frame.info.fx, (v - frame.info.cy) / frame.info.fy, np.ones_like(u, float)], -1
    )
    ray = frames.rotate(pose[3:], ray)
    seen = (frame.labels == GROUND) & np.isfinite(frame.depth)
    exact = pose[:3] + ray[seen] * np.asarray(frame.exact_depth)[seen, None]
    assert np.abs(exact[:, 2] - terrain.height(exact[:, 0], exact[:, 1])).max() < 2e-4
    points = pose[:3] + ray[seen] * frame.depth[seen, None]
    steep = np.abs((ray[seen] * terrain.normal(exact[:, 0], exact[:, 1])).sum(1))
    noise = spec.stereo.noise.value / (spec.stereo.focal.value * spec.stereo.baseline.value)
    height = (points[:, 2] - terrain.height(points[:, 0], points[:, 1])) * terrain.normal(*points[:, :2].T)[:, 2]
    return height / (steep * frame.depth[seen] ** 2 * noise)


def lidar_errors(terrain: Terrain, primitives: Primitives, pose: np.ndarray, time: float) -> np.ndarray:
    """Errors [n] m along the rays of the points of the ground that the lidar measures."""
    scan = Lidar(LidarSpec.load("vlp16")).scan(primitives, pose, time)
    points = pose[:3] + frames.rotate(pose[3:], scan.xyz[scan.labels == GROUND].astype(float))
    way = frames.normalize(points - pose[:3])
    steep = np.abs((way * terrain.normal(*points[:, :2].T)).sum(1))
    height = (points[:, 2] - terrain.height(*points[:, :2].T)) * terrain.normal(*points[:, :2].T)[:, 2]
    return (height / steep)[steep > 0.05]


def plane_pose(terrain: Terrain, pose: np.ndarray, footprint: tuple[float, float]) -> tuple[np.ndarray, float]:
    """Pose [7] of a base at the x, y and yaw of ``pose`` in the plane of the ground under its tracks, and the rise [1]
    of that plane ahead. It is known from the heights alone."""
    yaw = frames.to_yaw(pose[3:])
    height, along, across = terrain.fit_plane(pose[0], pose[1], yaw, footprint).tolist()
    normal = frames.normalize(np.array([-along, -across, 1.0]))
    ahead = frames.normalize(np.array([1.0, 0.0, along]))
    level = frames.from_matrix(np.stack([ahead, frames.cross(normal, ahead), normal], -1))
    return frames.pose([pose[0], pose[1], height], frames.multiply(frames.from_yaw(yaw), level)), along


@dataclasses.dataclass
class Drive:
    """What a drive measured. Lists have one entry for each step, or for each fix or look."""

    model: Model
    body: list[np.ndarray] = dataclasses.field(default_factory=list)
    """[3 + 3] offset [m] and rotation [rad] of the base from the plane under its tracks."""
    gyro: list[np.ndarray] = dataclasses.field(default_factory=list)
    """[3] rad/s, angular velocity minus the rotation of the base in the step."""
    gravity: list[np.ndarray] = dataclasses.field(default_factory=list)
    """[3 + 3] m/s2, specific force, and that of a body at rest in the plane."""
    wheels: list[tuple[float, float]] = dataclasses.field(default_factory=list)
    """Speed of the tracks [m/s], and that of the ground below them as the law of slip says."""
    fixes: list[np.ndarray] = dataclasses.field(default_factory=list)
    """[3] errors of the antenna's place east, north and up, in standard deviations."""
    depth: list[np.ndarray] = dataclasses.field(default_factory=list)
    ranges: list[np.ndarray] = dataclasses.field(default_factory=list)
    way: float = 0.0
    """[m] Way of the base along the surface."""
    lost: float = 0.0
    """[m] Way of the tracks, as the law of slip says."""
    measured: float = 0.0
    """[m] Way of the tracks, as their speeds say."""
    odometry: float = 0.0
    """[m] The x of odometry."""


def drive(length: float, looks: int) -> Drive:
    """Drive ``length`` [m] between two rows, and look around ``looks`` times."""
    model = vineyard(length)
    terrain = model.terrain
    assert terrain is not None
    rigid = RigidWorld(model)
    described = robot_with_noise()
    robot = Robot(rigid, described, "anna", pose=frames.pose([0.0, 1.3, 0.0]))
    primitives = Primitives(model, grass=0.0)
    primitives.update(rest_snapshot(model))
    footprint = rigid.robot("anna").follower.footprint  # type: ignore[union-attr]
    gnss = Gnss(GnssSpec.load("rtk"), GnssMount("gnss", ANTENNA, "rtk"))
    links = described.link_poses(described.home)
    antenna = links[ANTENNA]
    unit = links[described.imus[0].frame][3:]
    found = Drive(model)
    time = 0.0
    last, _ = rigid.base_state("anna")
    plane, _ = plane_pose(terrain, last, footprint)
    first = plane
    fix_period = round(1.0 / (gnss.rate * rigid.dt))
    step = 0
    while last[0] < length:
        robot.command_base(SPEED, 0.0, time)
        robot.control(time)
        rigid.predict()
        rigid.integrate()
        time += rigid.dt
        step += 1
        sample = robot.sample(time)
        here = sample.base_q
        plane, along = plane_pose(terrain, here, footprint)
        moved = float(np.linalg.norm(here[:3] - last[:3]))
        ratio = 1.0 - SLIP - SLOPE_SLIP * along
        found.way += moved
        found.lost += moved / ratio
        found.measured += rigid.dt * sample.odom_qd[0]
        if time > 2.0:
            turned = frames.log(frames.multiply(frames.conjugate(plane[3:]), here[3:]))
            found.body.append(np.concatenate([here[:3] - plane[:3], turned]))
            imu = sample.imus[0]
            rate = frames.log(frames.multiply(frames.conjugate(last[3:]), here[3:])) / rigid.dt
            found.gyro.append(imu.angular_velocity - frames.rotate(frames.conjugate(unit), rate))
            tilt = frames.conjugate(frames.multiply(plane[3:], unit))
            found.gravity.append(
                np.concatenate([imu.linear_acceleration, frames.rotate(tilt, np.array([0.0, 0.0, GRAVITY]))])
            )
            found.wheels.append((sample.odom_qd[0], moved / rigid.dt / ratio))
        if step % fix_period == 0:
            fix = gnss.measure(rigid.link_pose("anna", ANTENNA)[:3], time)
            assert fix.kind is FixKind.FIXED
            place = geodesy.to_local(Geodetic(fix.latitude, fix.longitude, fix.altitude), APRILIA)
            found.fixes.append((place - frames.compose(plane, antenna)[:3]) / np.sqrt(fix.variance))
        last = here.copy()
        if here[0] > length * (0.5 + len(found.depth)) / looks:
            found.depth.append(depth_errors(terrain, primitives, looking_down(rigid)))
            mast = frames.pose([0.0, 0.0, 1.0])  # above the chassis
            lidar = frames.compose(rigid.link_pose("anna", "base_lidar_link"), mast)
            found.ranges.append(lidar_errors(terrain, primitives, lidar, time))
    found.odometry = float(robot.sample(time).odom_q[0])
    climbed = float(last[2] - first[2])
    assert climbed == pytest.approx(terrain.slope[0] * last[0] + terrain.slope[1] * (last[1] - 1.3), abs=0.15)
    assert found.way == pytest.approx(np.hypot(last[0] - first[0], climbed), rel=5e-3)
    return found


def check_drive(length: float, looks: int) -> None:
    found = drive(length, looks)
    # the body: within half a millimetre and half a milliradian of the plane under its tracks
    assert np.abs(found.body).max() < 5e-4
    # the inertial unit: rates are those of the base, with white noise
    gyro = np.array(found.gyro)
    assert gyro.std(0) == pytest.approx(3 * [GYRO_NOISE], rel=0.15)
    assert np.abs(gyro.mean(0)).max() < 4.0 * GYRO_NOISE / np.sqrt(len(gyro))
    # gravity: over a second the accelerometer points along the normal of the tilted base
    gravity = np.array(found.gravity)
    seconds = gravity[: len(gravity) // 100 * 100].reshape(-1, 100, 6).mean(1)
    measured, true = frames.normalize(seconds[:, :3]), frames.normalize(seconds[:, 3:])
    assert np.abs(measured - true).max() < 5e-3
    assert np.linalg.norm(seconds[:, :3], axis=1) == pytest.approx(GRAVITY, abs=0.05)
    # wheel speeds: those of the ground, and more where the slope makes the tracks slip
    speed, law = np.array(found.wheels).T
    assert np.abs(speed - law).max() < 5e-3 * SPEED
    assert found.measured == pytest.approx(found.lost, rel=1e-3)
    assert found.odometry == pytest.approx(found.lost, rel=2e-3)
    assert found.lost > found.way / (1.0 - SLIP)
    # GNSS: the antenna is above the tilted base, with the drift and the white noise of its data sheet
    fixes = np.array(found.fixes)
    assert np.abs(fixes).max() < 4.0
    white = np.diff(fixes, axis=0) / np.sqrt(2.0 * (1.0 - GnssSpec.load("rtk").slow_share.value))
    assert white.std() == pytest.approx(1.0, abs=4.0 / np.sqrt(white.size))
    # the camera's depth and the lidar's ranges: without bias, and as noisy as their data sheets say
    depth = np.concatenate(found.depth)
    assert len(depth) > 2000 * looks
    assert abs(np.median(depth)) < 0.3
    assert np.median(np.abs(depth)) / 0.6745 < 1.5
    away = np.concatenate(found.ranges)
    noise = LidarSpec.load("vlp16").noise.value
    assert len(away) > 1000 * looks
    assert abs(np.median(away)) < 0.3 * noise
    assert np.median(np.abs(away)) / 0.6745 == pytest.approx(noise, rel=0.5)


def test_a_robot_drives_up_a_slope_with_ruts() -> None:
    check_drive(6.0, 1)


@pytest.mark.long
def test_a_robot_drives_fifty_metres_up_a_slope_with_ruts() -> None:
    check_drive(50.0, 5)
