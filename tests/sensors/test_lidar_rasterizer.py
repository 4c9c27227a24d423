"""The rays of a spinning head, against the ray caster."""

import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.core import frames
from vinesim.sensors.lidar.lidar_rasterizer import LidarRasterizer
from vinesim.sensors.primitives.ray_caster import RayCaster

LASERS = np.radians([-15.0, 1.0, -13.0, 3.0, -11.0, 5.0, -9.0, 7.0, -7.0, 9.0, -5.0, 11.0, -3.0, 13.0, -1.0, 15.0])
STEP = -0.0034
LAG = np.arange(16) * STEP / 24.0
"""Lasers fire in turn while the head turns on."""
STANDS = {
    "between rows": [3.7, 1.25, 1.0, 0.0, 0.0, 0.0, 1.0],
    "in the canopy": [1.3, 0.15, 1.7, *frames.from_yaw(1.0)],
    "on its side": [2.0, 0.9, 1.2, *frames.exp(np.array([1.2, 0.4, 0.3]))],
    "at the solids": [0.7, 0.6, 1.1, *frames.exp(np.array([0.1, 0.2, 0.7]))],
}


def _oracle(sweep: LidarRasterizer, primitives, pose, reach: float) -> tuple[np.ndarray, np.ndarray]:
    rays = frames.rotate(pose[3:], sweep.direction.numpy().astype(float))
    distance, primitive = RayCaster(primitives).cast(pose[:3], rays, reach)
    shape = (sweep.columns, sweep.rows)
    return distance.reshape(shape), primitive.reshape(shape)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory):
    return sensor_scenes.everything(tmp_path_factory.mktemp("mesh"))


@pytest.mark.parametrize("where", STANDS)
def test_the_ray_caster_meets_the_same(scene, where: str) -> None:
    pose = np.array(STANDS[where])
    sweep = LidarRasterizer(LASERS, LAG, STEP, 1848)
    distance, primitive = sweep.cast(scene, pose, reach=60.0)
    truth, ids = _oracle(sweep, scene, pose, 60.0)
    same = primitive == ids
    assert len(np.unique(ids)) > 100
    assert same.mean() >= 0.999
    met = same & (ids != -1)
    assert np.quantile(np.abs(distance[met] - truth[met]), 0.999) < 2e-4


def test_a_slice_is_the_same_rays(scene) -> None:
    pose = np.array(STANDS["between rows"])
    whole = LidarRasterizer(LASERS, LAG, STEP, 1848)
    parts = LidarRasterizer(LASERS, LAG, STEP, 1848)
    whole.cast(scene, pose)
    for first in range(0, 1848, 100):
        parts.cast(scene, pose, first, min(100, 1848 - first))
    assert (whole.primitive.numpy() == parts.primitive.numpy()).all()
    assert (whole.distance.numpy() == parts.distance.numpy()).all()


def test_rows_may_be_sub_rays_of_a_beam(scene) -> None:
    """Rows in any order, several of one elevation, and straight up and down."""
    elevation = np.radians([5.0, 5.1, 5.0, -20.0, 89.9, -90.0, 60.0])
    azimuth = np.array([0.0, 0.0, 0.003, 2.0, 0.0, -0.5, 0.1])
    pose = np.array(STANDS["in the canopy"])
    sweep = LidarRasterizer(elevation, azimuth, 0.01, 629)
    _, primitive = sweep.cast(scene, pose)
    assert (primitive == _oracle(sweep, scene, pose, 500.0)[1]).mean() >= 0.999


@pytest.mark.parametrize("seed", range(6))
def test_solids_around_the_head_as_a_robot_body_is(seed: int) -> None:
    """Boxes and cylinders beside, above, below and around a lidar, at any angle: the same rays meet them."""
    rng = np.random.default_rng(seed)
    pose = np.array([0.3, -0.2, 1.1, *frames.exp(rng.normal(size=3))])
    parts = []
    for k in range(12):
        at = pose[:3] + rng.normal(size=3) * rng.choice([0.0, 0.1, 0.5, 1.0])
        turn = frames.exp(2.0 * rng.normal(size=3))
        half = rng.uniform(0.02, 0.25, 3)
        kind, size = ("box", half) if k % 2 else ("cylinder", half[:2])
        parts.append(sensor_scenes.shape(kind, *size, at=at, turn=turn))
    primitives, _ = sensor_scenes.world(sensor_scenes.thing(*parts))
    elevation = np.radians(np.linspace(-90.0, 90.0, 61))
    sweep = LidarRasterizer(elevation, np.zeros(61), 0.02, 315)
    _, primitive = sweep.cast(primitives, pose)
    ids = _oracle(sweep, primitives, pose, 500.0)[1]
    assert len(np.unique(ids[ids >= 0])) >= 3
    assert (primitive == ids).mean() >= 0.999
