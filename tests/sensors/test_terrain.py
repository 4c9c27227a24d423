"""Cameras, lidars and rays meet the triangles of uneven ground exactly."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.terrain_scenes import bare, hills, incline
from vinesim.core import frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ, label
from vinesim.scene.spec import load_scene
from vinesim.scene.terrain import Terrain
from vinesim.scene.values import CameraInfo, CameraOutput
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.ground_truth import render_buffers
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.primitives.ray_caster import RayCaster
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot

GROUND = label(Organ.GROUND, 0)


def ground_of(terrain: Terrain | None) -> Primitives:
    model = bare(terrain)
    primitives = Primitives(model, grass=0.0)
    primitives.update(rest_snapshot(model))
    return primitives


def seen_points(depth: np.ndarray, info: CameraInfo, optical: np.ndarray) -> np.ndarray:
    """Points [height, width, 3] m in the world at the pixels of a depth picture."""
    v, u = np.mgrid[: info.height, : info.width]
    ray = np.stack([(u - info.cx) / info.fx, (v - info.cy) / info.fy, np.ones_like(u, float)], -1)
    return optical[:3] + frames.rotate(optical[3:], ray * depth[..., None])


@pytest.mark.parametrize("terrain", [hills(), hills(6, roughness=0.15, slope=(0.0, 0.0)), incline(-0.3, 0.2)])
def test_rays_end_where_they_first_meet_the_ground(terrain: Terrain) -> None:
    rng = np.random.default_rng(1)
    middle = 0.5 * (np.array(terrain.origin) + terrain.end)
    xy = middle + rng.uniform(-9.0, 9.0, (4000, 2))  # some begin and end beyond the grid
    start = np.column_stack([xy, terrain.height(*xy.T) + rng.uniform(0.01, 2.5, len(xy))]).astype(np.float32)
    way = rng.normal(size=(len(xy), 3)) - [0.0, 0.0, 0.4]
    way = (way / np.linalg.norm(way, axis=1, keepdims=True)).astype(np.float32)
    distance, primitive = RayCaster(ground_of(terrain)).cast(start, way, 40.0)
    hit = primitive == -2
    assert hit.mean() > 0.5
    end = start[hit] + distance[hit, None] * way[hit]
    assert np.abs(end[:, 2] - terrain.height(end[:, 0], end[:, 1])).max() < 1e-5
    along = np.linspace(0.0, 1.0, 1500)[:, None]
    for i in range(0, len(xy), 20):  # nothing was passed before, in particular not by rays without a hit
        length = min(float(distance[i]) - 1e-4, 40.0)
        points = start[i].astype(float) + along * length * way[i]
        assert (points[:, 2] - terrain.height(points[:, 0], points[:, 1])).min() > -2e-5


def test_from_below_the_ground_rays_meet_nothing() -> None:
    caster = RayCaster(ground_of(hills()))
    distance, primitive = caster.cast(np.array([0.0, 0.0, -3.0]), np.array([[0.1, 0.0, 1.0], [0.0, 0.1, -1.0]]))
    assert np.isinf(distance).all()
    assert (primitive == -1).all()


def test_level_terrain_looks_like_the_plane() -> None:
    info = CameraSpec.load("pinhole").info("eyes", size=(96, 72))
    optical = look_at(np.array([-1.0, 0.4, 1.1]), np.array([2.0, 0.0, 0.0]))
    plane, level = (render_buffers(ground_of(terrain), info, optical) for terrain in (None, incline(0.0)))
    assert (plane.labels == level.labels).all()
    near = plane.depth < 60.0
    assert near.mean() > 0.4
    assert np.abs(level.depth - plane.depth)[near].max() < 2e-3
    camera = Camera(CameraSpec.load("pinhole"), info, quality="still")
    pictures = [
        camera.render(ground_of(terrain), optical, outputs=CameraOutput.RGB).rgb for terrain in (None, incline(0.0))
    ]
    differs = np.abs(pictures[0].astype(int) - pictures[1]).max(-1) > 3
    assert differs.mean() < 0.01  # texture at the horizon


def test_the_camera_agrees_with_rays_and_with_the_heights() -> None:
    terrain = hills(2, roughness=0.03)
    primitives = ground_of(terrain)
    info = CameraSpec.load("pinhole").info("eyes", size=(96, 72))
    optical = look_at(np.array([-3.0, 0.4, 0.9]), np.array([2.0, 0.0, 0.2]))
    found = render_buffers(primitives, info, optical)
    ground = found.labels == GROUND
    assert (found.primitive[ground] == -2).all()
    points = seen_points(found.depth, info, optical)[ground]
    assert np.abs(points[:, 2] - terrain.height(points[:, 0], points[:, 1])).max() < 1e-4


@pytest.mark.parametrize("name", ["vlp16", "os1_64"])
def test_ideal_lidars_measure_the_heights(name: str) -> None:
    terrain = hills(2, roughness=0.03)
    pose = np.array([0.4, 0.2, float(terrain.height(0.4, 0.2)) + 0.9, *frames.exp(np.array([0.05, -0.1, 0.7]))])
    scan = Lidar(LidarSpec.load(name).ideal()).scan(ground_of(terrain), pose)
    assert len(scan.xyz) > 3000
    world = pose[:3] + frames.rotate(pose[3:], scan.xyz.astype(float))
    assert np.abs(world[:, 2] - terrain.height(world[:, 0], world[:, 1])).max() < 2e-4
    assert set(scan.labels.tolist()) == {GROUND}


def test_echoes_of_an_incline_are_as_bright_as_its_angle_says() -> None:
    """Straight down onto an incline: reflectance times the cosine of the angle of incidence."""
    spec = LidarSpec.load("vlp16").ideal()
    down = np.array([0.0, 0.0, 2.0, *frames.exp(np.array([0.0, 0.5 * np.pi, 0.0]))])
    bright = []
    for terrain in (incline(0.0), incline(0.5)):
        scan = Lidar(spec).scan(ground_of(terrain), down)
        world = down[:3] + frames.rotate(down[3:], scan.xyz.astype(float))
        nearest = np.argsort(np.hypot(world[:, 0], world[:, 1]))[:5]
        bright.append(float(scan.intensity[nearest].mean()))
    assert bright[1] / bright[0] == pytest.approx(np.cos(np.arctan(0.5)), abs=0.03)


def test_grass_and_fallen_leaves_lie_on_the_ground() -> None:
    model = generate(load_scene("slope"))
    assert model.terrain is not None
    primitives = Primitives(model)
    primitives.update(rest_snapshot(model))
    litter = np.flatnonzero(primitives.organ == int(Organ.GROUND))
    assert len(litter) > 1000
    middle = primitives.shapes.a.numpy()[litter, :3].astype(float)
    above = middle[:, 2] - model.terrain.height(middle[:, 0], middle[:, 1])
    assert above.min() > -0.03
    assert above.max() < 0.25
