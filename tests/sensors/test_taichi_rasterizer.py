"""The Taichi rasteriser finds what Warp's finds."""

import importlib
import threading

import numpy as np
import pytest

from tests.sensors.test_camera_raster import VIEWPOINTS
from tests.support import sensor_scenes
from tests.support.long_rows import long
from vinesim.kernels.raster.pinhole import EMPTY_KEY, PRIMITIVE_MASK
from vinesim.sensors.export.images import look_at
from vinesim.sensors.raster.camera_rasterizer import CameraRasterizer, pinhole
from vinesim.sensors.raster.primitive_arrays import KINDS

pytestmark = pytest.mark.slow

NEAR_PLANE = {
    "through the canopy, a solid beside the lens": ([1.17, 0.93, 0.62], [1.5, 1.2, 0.62]),
    "a leaf through the pinhole": ([1.1, 0.2, 1.97], [1.4, 0.5, 1.9]),
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory):
    return sensor_scenes.everything(tmp_path_factory.mktemp("mesh"))


def rasterizer():
    """A new one. Taichi is imported here, as its import takes a second."""
    pytest.importorskip("taichi", reason="Taichi, the extra 'taichi', is not installed")
    return importlib.import_module("vinesim.sensors.raster.taichi_rasterizer").TaichiRasterizer()


@pytest.fixture(scope="module")
def raster():
    return rasterizer()


def _seen(scene, pose: np.ndarray, raster) -> tuple[np.ndarray, np.ndarray]:
    """Primitive and depth of every pixel; by Warp unless another rasteriser is given."""
    scene.rasterizer = raster
    try:
        depth, primitive = sensor_scenes.raster(scene, pose)
    finally:
        scene.rasterizer = None
    return primitive, depth


@pytest.mark.parametrize("where", [*list(VIEWPOINTS)[:2], *NEAR_PLANE, *long(*list(VIEWPOINTS)[2:])])
def test_it_sees_the_same(scene, raster, where: str) -> None:
    pose = look_at(*map(np.array, (VIEWPOINTS | NEAR_PLANE)[where]))
    (mine, depth) = _seen(scene, pose, raster)
    (other, truth) = _seen(scene, pose, None)
    same = mine == other
    assert same.mean() >= 0.999
    hit = same & (mine >= 0)
    assert hit.sum() > 1000
    error = np.abs(depth[hit] - truth[hit]) / truth[hit]
    assert np.median(error) < 1e-6
    assert np.quantile(error, 0.99) < 1e-4  # the rest: leaves seen edge-on, from some centimetres


def test_denormal_numbers_are_as_without_it(raster) -> None:
    """Physics in the same process has the same bits: Taichi itself sets them to zero in the thread that starts it."""
    tiny = np.array([1e-40, 1e-30], np.float32) * np.array([1.0, 1e-10], np.float32)
    assert (tiny > 0.0).all()


def test_every_kind_is_seen(scene, raster) -> None:
    """None is missing from the comparison above."""
    found = set()
    for view in VIEWPOINTS.values():
        primitive = _seen(scene, look_at(*map(np.array, view)), raster)[0]
        found |= set(np.unique(scene.shapes.kind.numpy()[primitive[primitive >= 0]]))
    assert found == set(np.unique(scene.shapes.kind.numpy())) == set(KINDS.values())


@pytest.mark.long
def test_two_passes_find_what_one_finds(scene, raster) -> None:
    """As on a GPU without 64-bit atomics: depth first, then whose it is."""
    phased = rasterizer()
    phased._gpu = True
    for where in ("along the rows", "solids", "inside the canopy"):
        pose = look_at(*map(np.array, VIEWPOINTS[where]))
        assert (_seen(scene, pose, phased)[0] == _seen(scene, pose, None)[0]).mean() >= 0.999


def test_another_thread_may_draw(scene, raster) -> None:
    """The sensor scheduler has its own thread, which is not the one that started Taichi."""
    pose = look_at(*map(np.array, VIEWPOINTS["solids"]))
    found = []
    thread = threading.Thread(target=lambda: found.append(_seen(scene, pose, raster)[0]))
    thread.start()
    thread.join()
    assert np.array_equal(found[0], _seen(scene, pose, raster)[0])


def test_some_clusters_alone(scene, raster) -> None:
    seen = CameraRasterizer(sensor_scenes.SMALL.width, sensor_scenes.SMALL.height)
    some = np.arange(0, len(scene.cluster_first), 5)
    raster.rasterize(
        scene, pinhole(sensor_scenes.SMALL, look_at(*map(np.array, VIEWPOINTS["solids"]))), some, seen.keys
    )
    keys = seen.keys.numpy()
    numbers = keys[keys < int(EMPTY_KEY)] & int(PRIMITIVE_MASK)
    owner = np.repeat(np.arange(len(scene.cluster_first)), scene.cluster_size)
    assert len(numbers) > 100
    assert np.isin(owner[numbers], some).all()
