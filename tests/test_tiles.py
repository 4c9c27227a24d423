"""The rasteriser for GPUs, run on a CPU: it must find what the ray caster and the other rasteriser find."""

import numpy as np
import pytest
import seeing
from test_visibility import VIEWPOINTS

from vinesim.kernels import visibility
from vinesim.sensors.camera import Visibility, pinhole
from vinesim.sensors.picture import looking
from vinesim.sensors.tiles import Tiles

CLOSE_TO_A_SOLID = ([1.17, 0.93, 0.62], [1.5, 1.2, 0.62])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory):
    return seeing.everything(tmp_path_factory.mktemp("mesh"))


def _keys(scene, pose: np.ndarray, raster: Tiles | None, clusters: np.ndarray | None = None) -> np.ndarray:
    seen, lens = Visibility(seeing.SMALL.width, seeing.SMALL.height), pinhole(seeing.SMALL, pose)
    if raster is None:
        seen.draw(scene, lens)
    else:
        raster.fill(scene, lens, clusters, seen.keys)
    return seen.keys.numpy().copy()


def _numbers(keys: np.ndarray) -> np.ndarray:
    return np.where(keys < int(visibility.EMPTY), keys & int(visibility.LOW), -1)


@pytest.mark.parametrize("where", [*VIEWPOINTS, "close to a solid"])
def test_pieces_show_what_whole_primitives_show(scene, where: str) -> None:
    pose = looking(*map(np.array, VIEWPOINTS.get(where, CLOSE_TO_A_SOLID)))
    mine, other = _keys(scene, pose, Tiles("cpu", groups=1, lanes=1)), _keys(scene, pose, None)
    same = _numbers(mine) == _numbers(other)
    assert same.mean() >= 0.999
    hit = same & (_numbers(mine) >= 0)
    assert hit.sum() > 1000
    depth = other[hit] >> 32
    assert np.quantile(np.abs((mine[hit] >> 32) - depth) / np.maximum(depth, 100_000), 0.99) < 2e-5


def test_what_finds_no_room_in_a_list_is_drawn_too(scene) -> None:
    pose = looking(*map(np.array, VIEWPOINTS["inside the canopy"]))
    roomy, full = Tiles("cpu", groups=1, lanes=1), Tiles("cpu", groups=1, lanes=1, room=4)
    assert np.array_equal(_keys(scene, pose, roomy), _keys(scene, pose, full))
    assert full._count.numpy().max() > 4


@pytest.mark.parametrize(("groups", "lanes"), [(1, 32), (7, 4)])
def test_any_share_of_the_work_gives_the_same_picture(scene, groups: int, lanes: int) -> None:
    pose = looking(*map(np.array, VIEWPOINTS["solids"]))
    alone = _keys(scene, pose, Tiles("cpu", groups=1, lanes=1))
    assert np.array_equal(alone, _keys(scene, pose, Tiles("cpu", groups=groups, lanes=lanes, listers=3)))


def test_some_clusters_alone(scene) -> None:
    pose = looking(*map(np.array, VIEWPOINTS["solids"]))
    raster = Tiles("cpu", groups=1, lanes=1)
    some = np.arange(0, len(scene.cluster_first), 5)
    numbers = _numbers(_keys(scene, pose, raster, some))
    owner = np.repeat(np.arange(len(scene.cluster_first)), scene.cluster_size)
    assert np.isin(owner[numbers[numbers >= 0]], some).all()
    assert (numbers >= 0).sum() > 100
