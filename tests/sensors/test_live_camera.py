"""What makes a live picture cheap changes nothing: threads, outputs left out, a second view out of the first."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from tests.support import sensor_scenes
from tests.support.long_rows import each_once
from vinesim.core import frames
from vinesim.core.thread_pool import ThreadPool
from vinesim.kernels.stereo import stereo_depth
from vinesim.scene.values import CameraFrame, CameraOutput
from vinesim.sensors.camera.camera import QUALITIES, Camera, CameraSpec
from vinesim.sensors.camera.stereo import Stereo
from vinesim.sensors.camera.sunlight import Sunlight
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.sensors.raster.camera_rasterizer import pinhole
from vinesim.sensors.raster.primitive_arrays import LEAF
from vinesim.sensors.spec_file import noise_rng

SPEC = CameraSpec.load("d435")
INFO = SPEC.info("optical", 0.5)
ODD = SPEC.info("optical", 0.213)
"""Of 136 x 102 pixels."""
ALONG_THE_ROW = look_at(np.array([0.4, 1.2, 1.3]), np.array([3.0, 1.0, 1.7]))
AT_A_BUNCH = look_at(np.array([1.65, 1.9, 1.5]), np.array([1.67, 2.74, 1.65]))


@pytest.fixture(scope="module")
def primitives() -> Primitives:
    return Primitives(sensor_scenes.demo())


def _arrays(frame: CameraFrame) -> list[np.ndarray]:
    assert frame.exact_depth is not None
    return [frame.rgb, frame.depth, frame.exact_depth, frame.labels]


@pytest.mark.parametrize(("quality", "info"), each_once(list(QUALITIES), [INFO, ODD]))
def test_any_number_of_threads_gives_the_same_bits(primitives, quality: str, info) -> None:
    made = [Camera(SPEC, info, quality=quality, threads=n).render(primitives, ALONG_THE_ROW) for n in (1, 2, 3)]
    for other in made[1:]:
        for mine, theirs in zip(_arrays(other), _arrays(made[0]), strict=True):
            assert np.array_equal(mine, theirs, equal_nan=mine.dtype == np.float32)


@pytest.mark.parametrize("output", list(CameraOutput.ALL))
def test_what_is_made_alone_is_what_is_made_with_the_rest(primitives, output: CameraOutput) -> None:
    """And nothing else is in the frame."""
    every = Camera(SPEC, INFO, quality="fast").render(primitives, ALONG_THE_ROW)
    alone = Camera(SPEC, INFO, quality="fast").render(primitives, ALONG_THE_ROW, outputs=output)
    assert alone.outputs == output
    names = {CameraOutput.RGB: "rgb", CameraOutput.DEPTH: "depth", CameraOutput.LABELS: "labels"}
    name = names.get(output, "exact_depth")
    assert np.array_equal(getattr(alone, name), getattr(every, name), equal_nan=name == "depth")


def test_rows_of_the_imager_are_matched_as_single_pixels_are(primitives) -> None:
    """The kernel for CPUs against the one for GPUs, run on the CPU: the same depth, bit for bit."""
    frame = Camera(SPEC, INFO).render(primitives, ALONG_THE_ROW)
    assert SPEC.stereo is not None
    stereo = Stereo(SPEC.stereo, INFO, (SPEC.nearest.value, SPEC.farthest.value))
    lens = pinhole(INFO, ALONG_THE_ROW)
    by_rows = stereo.measure(primitives, lens, frame.exact_depth, frame.rgb, noise_rng(0, "camera", 0))
    by_pixels = wp.empty(INFO.width * INFO.height, dtype=float, device="cpu")
    _, rows, columns = stereo._noise.shape
    arrays = [stereo._disparity, stereo._grey, stereo._second_depth, stereo._noise, columns]
    inputs = [stereo._parameters, lens, stereo._second_pinhole(lens), *arrays]
    wp.launch(stereo_depth.measure_depth, rows, inputs=inputs, outputs=[by_pixels], device="cpu")
    assert np.array_equal(by_rows.ravel(), by_pixels.numpy(), equal_nan=True)


@pytest.mark.parametrize("pose", [ALONG_THE_ROW, AT_A_BUNCH], ids=["row", "bunch"])
def test_a_second_view_from_the_first_misses_what_a_true_one_misses(primitives, pose) -> None:
    """Pixels without depth: as many to a tenth, and nearly all of them the same; what is measured is the same."""
    full, fast = (Camera(SPEC, SPEC.info("optical"), quality=q).render(primitives, pose) for q in ("full", "fast"))
    assert SPEC.stereo is not None
    lens = pinhole(full.info, pose)
    reach = (SPEC.nearest.value, SPEC.farthest.value)
    warping = Stereo(SPEC.stereo, full.info, reach, second_from_first=True, workers=ThreadPool(2))
    warped = warping.measure(primitives, lens, full.exact_depth, full.rgb, noise_rng(0, "camera", 0))
    missed = np.isnan(full.depth)
    missed_too = np.isnan(warped)
    assert missed_too.mean() == pytest.approx(missed.mean(), rel=0.1)
    assert (missed != missed_too).mean() < 0.01
    measured = np.isfinite(full.depth) & np.isfinite(warped)
    assert np.array_equal(full.depth[measured], warped[measured])
    assert np.isfinite(fast.depth).mean() == pytest.approx(np.isfinite(full.depth).mean(), rel=0.02)


def test_a_pool_shares_tasks_and_raises_their_errors() -> None:
    pool = ThreadPool(3)
    done: list[int] = []
    pool.share([lambda i=i: done.append(i) for i in range(20)])
    assert sorted(done) == list(range(20))
    with pytest.raises(ZeroDivisionError):
        pool.share([lambda: 1 // 0] * 2)
    pool.share([lambda: done.append(20)])
    assert done[-1] == 20


@pytest.mark.parametrize("pose", [ALONG_THE_ROW, AT_A_BUNCH], ids=["row", "bunch"])
@pytest.mark.parametrize("info", [SPEC.info("optical"), ODD], ids=["640x480", "136x102"])
def test_eight_points_at_once_are_lit_as_each_alone(primitives, pose, info) -> None:
    """The kernels of live pictures against those of all others, at the same points: one look."""
    batched, single = (Camera(SPEC, info, quality="fast") for _ in range(2))
    assert batched._live_light is not None
    single._live_light = None
    mine, theirs = (camera.render(primitives, pose, outputs=CameraOutput.RGB).rgb for camera in (batched, single))
    apart = np.abs(mine.astype(int) - theirs)
    assert apart.mean() < 0.2
    assert (apart > 8).mean() < 1e-3
    assert mine.std() > 20.0


def test_actors_and_the_autumn_are_lit_alike(tmp_path) -> None:
    """Robots, crates and people are in no class of their own, and every leaf may have turned."""
    primitives = sensor_scenes.everything(tmp_path)
    pose = look_at(np.array([0.2, 0.4, 1.2]), np.array([1.6, 1.3, 0.9]))
    leaves = primitives.shapes.kind.numpy() == LEAF
    primitives.shapes.d.numpy()[leaves, 3] = np.linspace(0.0, 1.0, leaves.sum())
    batched, single = (Camera(SPEC, INFO, quality="fast") for _ in range(2))
    single._live_light = None
    mine, theirs = (camera.render(primitives, pose, outputs=CameraOutput.RGB).rgb for camera in (batched, single))
    assert np.abs(mine.astype(int) - theirs).mean() < 0.2


def test_shadows_drawn_in_part_are_those_drawn_anew() -> None:
    """A board is carried through the scene and out of it: after each step the near map is as if drawn anew."""
    board = sensor_scenes.shape("box", 0.2, 0.15, 0.01)
    model = sensor_scenes.demo()
    eye = np.array([0.4, 1.2, 1.3])
    forward = np.array([1.0, 0.0, 0.0])
    at = [(1.0, 1.0, 1.5), (1.1, 1.0, 1.4), (2.5, -1.0, 1.2), (40.0, 0.0, 1.0), (2.6, 1.4, 1.9)]
    links = (sensor_scenes.thing(board),)
    poses = [np.array([[*place, *frames.from_yaw(0.3 * i)]]) for i, place in enumerate(at)]
    primitives = Primitives(model, grass=3.0)
    followed = Sunlight(taps=-1, period=0.0, workers=ThreadPool(2))
    drawn = []
    for i, pose in enumerate(poses):
        snapshot = rest_snapshot(model, links, pose)
        if i == 2:  # and a vine that sways
            snapshot.body_q[: len(snapshot.body_q) // 8, 2] += 0.05
            swaying = np.unique(model.body_tree[: len(snapshot.body_q) // 8])
            snapshot = dataclasses.replace(snapshot, moved_trees=swaying)
        primitives.update(snapshot)
        followed.update(primitives, eye, forward, 0.1 * i)
        fresh = Sunlight(taps=-1, period=0.0)
        fresh.update(primitives, eye, forward, 0.0)
        mine, theirs = (light.depth.numpy()[: light.depth.size // 2] for light in (followed, fresh))
        assert np.array_equal(mine, theirs)
        drawn.append(theirs.copy())
    assert not np.array_equal(drawn[0], drawn[1])
