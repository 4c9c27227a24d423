"""The rasteriser for GPUs, run on a CPU: it must find what the ray caster and the other rasteriser find."""

import numpy as np
import pytest

from tests.sensors.test_camera_raster import VIEWPOINTS
from tests.support import sensor_scenes
from vinesim.kernels.raster.pinhole import EMPTY_KEY, PRIMITIVE_MASK
from vinesim.sensors.export.images import look_at
from vinesim.sensors.raster.camera_rasterizer import CameraRasterizer, pinhole
from vinesim.sensors.raster.cuda_rasterizer import CudaRasterizer

pytestmark = pytest.mark.slow

CLOSE_TO_A_SOLID = ([1.17, 0.93, 0.62], [1.5, 1.2, 0.62])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory):
    return sensor_scenes.everything(tmp_path_factory.mktemp("mesh"))


def _seen(scene, pose: np.ndarray, raster: CudaRasterizer | None) -> tuple[np.ndarray, np.ndarray]:
    """Primitive and depth of every pixel; by Warp's rasteriser for CPUs unless another is given."""
    scene.rasterizer = raster
    try:
        depth, primitive = sensor_scenes.raster(scene, pose)
    finally:
        scene.rasterizer = None
    return primitive, depth


def _small_rasterizer(**options) -> CudaRasterizer:
    return CudaRasterizer("cpu", **({"groups": 1, "lanes": 1} | options))


@pytest.mark.parametrize("where", [*VIEWPOINTS, "close to a solid"])
def test_small_rasterizer_show_what_whole_primitives_show(scene, where: str) -> None:
    pose = look_at(*map(np.array, VIEWPOINTS.get(where, CLOSE_TO_A_SOLID)))
    (mine, depth) = _seen(scene, pose, _small_rasterizer())
    (other, truth) = _seen(scene, pose, None)
    same = mine == other
    assert same.mean() >= 0.999
    hit = same & (mine >= 0)
    assert hit.sum() > 1000
    error = np.abs(depth[hit] - truth[hit]) / truth[hit]
    assert np.median(error) < 1e-6
    assert np.quantile(error, 0.99) < 1e-4  # the rest: leaves seen edge-on, from some centimetres


def test_what_finds_no_room_in_a_list_is_drawn_too(scene) -> None:
    pose = look_at(*map(np.array, VIEWPOINTS["inside the canopy"]))
    full = _small_rasterizer(room=4)
    assert np.array_equal(_seen(scene, pose, _small_rasterizer())[0], _seen(scene, pose, full)[0])
    assert full._count.numpy().max() > 4


@pytest.mark.parametrize(("groups", "lanes"), [(1, 32), (7, 4)])
def test_any_share_of_the_work_gives_the_same_picture(scene, groups: int, lanes: int) -> None:
    pose = look_at(*map(np.array, VIEWPOINTS["solids"]))
    shared = _small_rasterizer(groups=groups, lanes=lanes, listers=3)
    assert np.array_equal(_seen(scene, pose, _small_rasterizer())[0], _seen(scene, pose, shared)[0])


def test_some_clusters_alone(scene) -> None:
    lens = pinhole(sensor_scenes.SMALL, look_at(*map(np.array, VIEWPOINTS["solids"])))
    seen = CameraRasterizer(sensor_scenes.SMALL.width, sensor_scenes.SMALL.height)
    some = np.arange(0, len(scene.cluster_first), 5)
    _small_rasterizer().rasterize(scene, lens, some, seen.keys)
    keys = seen.keys.numpy()
    numbers = keys[keys < int(EMPTY_KEY)] & int(PRIMITIVE_MASK)
    owner = np.repeat(np.arange(len(scene.cluster_first)), scene.cluster_size)
    assert len(numbers) > 100
    assert np.isin(owner[numbers], some).all()
