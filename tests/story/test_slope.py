"""A robot drives along a row on a slope of 10 % with ruts. Its body, inertial unit, odometry, camera and lidar agree
with the heights of the ground, within their noise."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.odometry import SLOPE_SLIP
from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.ids import Organ, label
from vinesim.scene.model import Model
from vinesim.scene.spec import Roughness, Ruts, Season, TerrainTable, load_scene
from vinesim.scene.terrain import Terrain
from vinesim.scene.values import CameraOutput
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot

SPEED = 0.8
SLIP = 0.05
GRAVITY = 9.81
GROUND = label(Organ.GROUND, 0)


def vineyard(length: float) -> Model:
    """Two rows of ``length`` [m] without fruit and with few leaves. Uphill is along the rows, and a little across."""
    scene = load_scene("slope")
    return generate_uncached(
        msgspec.structs.replace(
            scene,
            layout=msgspec.structs.replace(scene.layout, vines=2 + int(length / scene.layout.vine_spacing)),
            fruit=msgspec.structs.replace(scene.fruit, bunches=(0, 0)),
            season=Season(leafiness=0.05),
            boxes=(),
            terrain=TerrainTable(
                slope=0.1,
                direction=0.1,
                ruts=Ruts(depth=0.06, width=0.4, gauge=0.9),
                roughness=Roughness(deviation=0.015, wavelength=2.0),
                margin=10.0,
            ),
        )
    )


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


def check_drive(length: float, looks: int) -> None:
    model = vineyard(length)
    terrain = model.terrain
    assert terrain is not None
    rigid = RigidWorld(model)
    described = load_description("vinebot")
    limits = msgspec.structs.replace(described.base_limits, slip=(SLIP, 0.0))
    start = frames.pose([0.0, 1.3, 0.0])
    robot = Robot(rigid, dataclasses.replace(described, base_limits=limits), "anna", pose=start)
    primitives = Primitives(model, grass=0.0)
    primitives.update(rest_snapshot(model))
    footprint = rigid.robot("anna").follower.footprint  # type: ignore[union-attr]
    lidar = Lidar(LidarSpec.load("vlp16"))
    time = travel = lost = 0.0
    last, _ = rigid.base_state("anna")
    plane, gyro, accelerometer, climbs = [], [], [], []
    errors, ranges = [], []
    while last[0] < length:
        robot.command_base(SPEED, 0.0, time)
        robot.control(time)
        rigid.predict()
        rigid.integrate()
        time += rigid.dt
        sample = robot.sample(time)
        here = sample.base_q
        moved = float(np.linalg.norm(here[:3] - last[:3]))
        height, along, across = terrain.fit_plane(here[0], here[1], frames.to_yaw(here[3:]), footprint)
        travel += moved
        lost += moved / (1.0 - SLIP - SLOPE_SLIP * along)
        up = frames.rotate(here[3:], np.array([0.0, 0.0, 1.0]))
        ahead = frames.rotate(here[3:], np.array([1.0, 0.0, 0.0]))
        imu = sample.imus[0]
        if time > 2.0:
            tilted = frames.normalize(np.array([-along, -across, 1.0]))
            plane.append([here[2] - height, *(up - frames.rotate(frames.from_yaw(frames.to_yaw(here[3:])), tilted))])
            turned = frames.log(frames.multiply(frames.conjugate(last[3:]), here[3:])) / rigid.dt
            gyro.append(imu.angular_velocity - turned)
            accelerometer.append(
                [*imu.linear_acceleration, *frames.rotate(frames.conjugate(imu.orientation), [0, 0, 1])]
            )
            climbs.append(ahead[2] / np.sqrt(1.0 - ahead[2] ** 2) - along)
        last = here.copy()
        if here[0] > length * (0.5 + len(errors)) / looks:
            errors.append(depth_errors(terrain, primitives, looking_down(rigid)))
            head = rigid.link_pose("anna", "base_lidar_link")
            head = frames.compose(head, frames.pose([0.0, 0.0, 1.0]))  # above the chassis
            scan = lidar.scan(primitives, head, time)
            points = head[:3] + frames.rotate(head[3:], scan.xyz[scan.labels == GROUND].astype(float))
            way = frames.normalize(points - head[:3])
            steep = np.abs((way * terrain.normal(*points[:, :2].T)).sum(1))
            clear = steep > 0.05
            height = (points[:, 2] - terrain.height(*points[:, :2].T)) * terrain.normal(*points[:, :2].T)[:, 2]
            ranges.append((height / steep)[clear])

    # the body: within half a millimetre and half a milliradian of the plane under its tracks
    assert np.abs(plane).max(0) == pytest.approx([0.0, 0.0, 0.0, 0.0], abs=5e-4)
    assert np.abs(climbs).max() < 5e-4
    assert last[2] == pytest.approx(terrain.slope[0] * last[0] + terrain.slope[1] * last[1], abs=0.15)
    # the inertial unit: rates of the body; over a second the accelerometer points up
    assert np.abs(gyro).max() < 1e-3
    seconds = np.array(accelerometer)[: len(accelerometer) // 100 * 100].reshape(-1, 100, 6).mean(1)
    measured, true = frames.normalize(seconds[:, :3]), frames.normalize(seconds[:, 3:])
    assert np.abs(measured - true).max() < 5e-3
    assert np.linalg.norm(seconds[:, :3], axis=1) == pytest.approx(GRAVITY, abs=0.05)
    # odometry: travel along the surface, and more of it lost where it is steeper
    assert travel == pytest.approx(
        np.hypot(last[0], last[2] - terrain.fit_plane(0.0, 1.3, 0.0, footprint)[0]), rel=5e-3
    )
    assert robot.sample(time).odom_q[0] == pytest.approx(lost, rel=2e-3)
    # the camera's depth and the lidar's ranges: without bias, and as noisy as their data sheets say
    depth = np.concatenate(errors)
    assert len(depth) > 2000 * looks
    assert abs(np.median(depth)) < 0.3
    assert np.median(np.abs(depth)) / 0.6745 < 1.5
    away = np.concatenate(ranges)
    noise = LidarSpec.load("vlp16").noise.value
    assert len(away) > 1000 * looks
    assert abs(np.median(away)) < 0.3 * noise
    assert np.median(np.abs(away)) / 0.6745 == pytest.approx(noise, rel=0.5)


def test_a_robot_drives_up_a_slope_with_ruts() -> None:
    check_drive(6.0, 1)


@pytest.mark.long
def test_a_robot_drives_fifty_metres_up_a_slope_with_ruts() -> None:
    check_drive(50.0, 5)
