"""The Taichi twin of the rasteriser finds what Warp's finds."""

import threading

import numpy as np
import pytest
import seeing
from test_visibility import VIEWPOINTS

from vinesim.kernels import visibility
from vinesim.sensors.camera import Visibility, pinhole
from vinesim.sensors.picture import looking

pytest.importorskip("taichi", reason="Taichi, the extra 'taichi', is not installed")
twin = pytest.importorskip("vinesim.sensors.twin")
NEAR_PLANE = {
    "through the canopy, a solid beside the lens": ([1.17, 0.93, 0.62], [1.5, 1.2, 0.62]),
    "a leaf through the pinhole": ([1.1, 0.2, 1.97], [1.4, 0.5, 1.9]),
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory):
    return seeing.everything(tmp_path_factory.mktemp("mesh"))


@pytest.fixture(scope="module")
def raster():
    return twin.Twin()


def _both(scene, raster, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keys by Warp and by Taichi."""
    lens, seen = pinhole(seeing.SMALL, pose), Visibility(seeing.SMALL.width, seeing.SMALL.height)
    seen.draw(scene, lens)
    warp = seen.keys.numpy().copy()
    raster.fill(scene, lens, None, seen.keys)
    return warp, seen.keys.numpy().copy()


def _numbers(keys: np.ndarray) -> np.ndarray:
    return np.where(keys < int(visibility.EMPTY), keys & int(visibility.LOW), -1)


@pytest.mark.parametrize("where", [*VIEWPOINTS, *NEAR_PLANE])
def test_the_twin_sees_the_same(scene, raster, where: str) -> None:
    warp, taichi = _both(scene, raster, looking(*map(np.array, (VIEWPOINTS | NEAR_PLANE)[where])))
    same = _numbers(warp) == _numbers(taichi)
    assert same.mean() >= 0.999
    hit = same & (_numbers(warp) >= 0)
    assert hit.sum() > 1000
    apart = np.abs((warp[hit] >> 32) - (taichi[hit] >> 32))
    assert np.quantile(apart / np.maximum(warp[hit] >> 32, 100_000), 0.99) < 2e-5  # the rest is grazed


def test_every_kind_is_seen(scene, raster) -> None:
    """All kinds that there are, by the twin alone: none is missing from the comparison above."""
    found = set()
    for view in VIEWPOINTS.values():
        numbers = _numbers(_both(scene, raster, looking(*map(np.array, view)))[1])
        found |= set(np.unique(scene.shapes.kind.numpy()[numbers[numbers >= 0]]))
    assert found == set(np.unique(scene.shapes.kind.numpy()))


def test_two_passes_find_what_one_finds(scene, raster) -> None:
    """As on a GPU without 64-bit atomics: depth first, then whose it is."""
    phased = twin.Twin()
    phased._gpu = True
    for where in ("along the rows", "solids", "inside the canopy"):
        warp, taichi = _both(scene, phased, looking(*map(np.array, VIEWPOINTS[where])))
        assert (_numbers(warp) == _numbers(taichi)).mean() >= 0.999


def test_another_thread_may_draw(scene, raster) -> None:
    """Eyes have a thread of their own, which is not the one that started Taichi."""
    pose = looking(*map(np.array, VIEWPOINTS["solids"]))
    found = []
    thread = threading.Thread(target=lambda: found.append(_both(scene, raster, pose)[1]))
    thread.start()
    thread.join()
    assert np.array_equal(found[0], _both(scene, raster, pose)[1])


def test_some_clusters_alone(scene, raster) -> None:
    seen = Visibility(seeing.SMALL.width, seeing.SMALL.height)
    some = np.arange(0, len(scene.cluster_first), 5)
    raster.fill(scene, pinhole(seeing.SMALL, looking(*map(np.array, VIEWPOINTS["solids"]))), some, seen.keys)
    numbers = _numbers(seen.keys.numpy())
    owner = np.repeat(np.arange(len(scene.cluster_first)), scene.cluster_size)
    assert np.isin(owner[numbers[numbers >= 0]], some).all()
    assert (numbers >= 0).sum() > 100
