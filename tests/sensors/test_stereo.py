"""Stereo depth: the laws of its noise, what the second imager misses, and what no matcher finds."""

import msgspec
import numpy as np
import pytest
import warp as wp

from tests.support import sensor_scenes
from vinesim.core import frames
from vinesim.core.data_files import find_data_file
from vinesim.kernels.stereo import stereo_input
from vinesim.scene.ids import Organ, label
from vinesim.scene.values import CameraFrame
from vinesim.sensors import spec_file
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.camera.stereo import Stereo
from vinesim.sensors.raster.camera_rasterizer import pinhole
from vinesim.sensors.spec_file import SensorError

SPEC = CameraSpec.load("d435")
INFO = SPEC.info("optical", 0.5)
assert SPEC.stereo is not None
REACH = SPEC.stereo.focal.value * SPEC.stereo.baseline.value
"""Disparity [px] times depth [m]."""


def _wall(x: float, half: float = 10.0, y: float = 0.0, index: int = 0):
    """A plate whose front stands at ``x``, across the gaze of :data:`seeing.AHEAD`."""
    return sensor_scenes.thing(
        sensor_scenes.shape("box", 0.05, half, half, at=(x + 0.05, y, 1.0)), name=str(index), index=index
    )


def _see(*things, spec: CameraSpec = SPEC, info=INFO, **others) -> CameraFrame:
    primitives, _ = sensor_scenes.world(*things)
    return Camera(spec, info, "camera", **others).render(primitives, sensor_scenes.AHEAD)


def _but(**values: float) -> CameraSpec:
    """The D435 with other values of its stereo table."""
    table = SPEC.stereo
    changed = {k: msgspec.structs.replace(getattr(table, k), value=v) for k, v in values.items()}
    return msgspec.structs.replace(SPEC, stereo=msgspec.structs.replace(table, **changed))


def _repainted(frame: CameraFrame, primitives, camera: Camera, rgb: np.ndarray) -> np.ndarray:
    """What ``camera`` measures of a frame if the picture were another one [height, width, 3]."""
    lens = pinhole(camera.info, frame.pose)
    return camera._stereo.measure(primitives, lens, frame.exact_depth, rgb, spec_file.noise_rng(0, "camera", 0))


@pytest.mark.parametrize("depth", [0.4, 0.8, 1.5, 2.5])
def test_noise_grows_with_the_square_of_depth(depth: float) -> None:
    """sigma_z = z^2 sigma_d / (f B), and a frontal plane is measured everywhere."""
    frame = _see(_wall(depth))
    error = frame.depth - frame.exact_depth
    assert np.isfinite(error).all()
    law = depth**2 * SPEC.stereo.noise.value / REACH
    assert np.sqrt((error**2).mean()) == pytest.approx(law, rel=0.08)
    assert abs(error.mean()) < 0.15 * law


def test_disparity_has_steps() -> None:
    frame = _see(_wall(1.5))
    steps = REACH / frame.depth / SPEC.stereo.step.value
    assert np.abs(steps - np.round(steps)).max() < 1e-3
    assert 4 < len(np.unique(frame.depth)) < 40
    still = _see(_wall(1.5), spec=_but(noise=0.0))
    assert len(np.unique(still.depth)) == 1
    assert abs(still.depth[0, 0] - 1.5) <= 1.5**2 * SPEC.stereo.step.value / REACH / 2.0 + 1e-6


@pytest.mark.parametrize("quality", ["full", "fast"])
@pytest.mark.parametrize(("near", "far"), [(0.5, 1.0), (0.8, 2.0), (1.0, 1.6)])
def test_the_shadow_of_the_second_imager_lies_to_the_left(near: float, far: float, quality: str) -> None:
    """Width f B (1 / near - 1 / far) in pixels of the picture, on the left of what is near and nowhere else."""
    info = SPEC.info("optical")
    frame = _see(_wall(near, 0.12), _wall(far, index=1), spec=_but(noise=0.0), info=info, quality=quality)
    rows = np.abs(np.arange(info.height) - info.cy) < 0.08 / near * info.fy
    gaps = np.isnan(frame.depth[rows])
    plate = frame.exact_depth[rows] < 0.5 * (near + far)
    first = plate.argmax(1)
    width = info.fx * SPEC.stereo.baseline.value * (1.0 / near - 1.0 / far)
    assert gaps.sum(1) == pytest.approx(np.full(rows.sum(), width), abs=2.5)  # imager pixels are 1.5 of the picture's
    columns = np.arange(info.width)
    beside = (columns >= first[:, None] - width - 3.0) & (columns < first[:, None] + 2)
    assert not gaps[~beside].any()


def test_near_edges_grow_and_by_less_than_a_window() -> None:
    frame = _see(_wall(0.8, 0.12), _wall(1.6, index=1), spec=_but(noise=0.0), info=SPEC.info("optical"))
    row = frame.info.height // 2
    true = frame.exact_depth[row] < 1.2
    measured = frame.depth[row] < 1.2
    right = np.flatnonzero(measured)[-1] - np.flatnonzero(true)[-1]
    assert 0 < right <= 0.5 * SPEC.stereo.window.value * SPEC.fx.value / SPEC.stereo.focal.value


def test_range_ends_are_told_from_gaps() -> None:
    """REP-118: -Inf too near, +Inf too far and the sky, NaN only where something in range was not measured."""
    things = (
        _wall(0.10, 0.03, -0.05),
        _wall(1.9, 0.3, 0.6, index=1),
        sensor_scenes.thing(sensor_scenes.shape("box", 0.05, 3.0, 3.0, at=(13.0, 0, 3.0)), name="far", index=2),
    )
    frame = _see(*things)
    wide = frame.exact_depth > SPEC.farthest.value * 1.3
    assert np.isneginf(frame.depth[frame.exact_depth < 0.12]).mean() > 0.8
    assert np.isposinf(frame.depth[wide]).mean() > 0.9
    assert np.isposinf(frame.exact_depth[frame.labels == 0]).all()
    gaps = np.isnan(frame.depth)
    assert gaps.any()
    assert not gaps[np.isposinf(frame.exact_depth)].any()
    finite = frame.depth[np.isfinite(frame.depth)]
    assert finite.min() >= SPEC.nearest.value
    assert finite.max() <= SPEC.farthest.value


def test_a_thin_wire_is_lost() -> None:
    wire = sensor_scenes.thing(sensor_scenes.shape("cylinder", 0.0015, 2.0, at=(2.0, -0.1, 1.0)), index=1)
    frame = _see(_wall(4.0), wire)
    shown = frame.labels == label(Organ.ROBOT, 1)
    assert shown.sum() > 100
    assert not (np.abs(frame.depth[shown] - 2.0) < 0.3).any()


def test_what_is_slanted_too_much_is_not_measured() -> None:
    middle = np.s_[INFO.height // 2 - 40 : INFO.height // 2 + 40, INFO.width // 2 - 2 : INFO.width // 2 + 2]
    shares = []
    for angle in (60.0, 72.0, 81.0, 88.0):
        turn = frames.exp(np.array([0.0, 0.0, np.radians(angle)]))
        plate = sensor_scenes.thing(sensor_scenes.shape("box", 0.001, 1.0, 0.3, at=(1.5, 0.0, 1.0), turn=turn))
        shares.append(np.isfinite(_see(plate, _wall(5.0, index=1)).depth[middle]).mean())
    assert shares[:2] == [1.0, 1.0]
    assert 0.1 < shares[2] < 0.9
    assert shares[3] == 0.0


def test_overexposed_and_plain_surfaces_are_not_measured() -> None:
    """Grey levels decide: too bright never; without texture only as far as the projector reaches."""
    wall = label(Organ.ROBOT, 0)
    for depth, plain in ((1.0, 1.0), (8.0, 0.0)):
        primitives, _ = sensor_scenes.world(_wall(depth))
        camera = Camera(SPEC, INFO, "camera")
        frame = camera.render(primitives, sensor_scenes.AHEAD)
        grey = np.full((INFO.height, INFO.width, 3), 120, np.uint8)
        rough = grey + np.random.default_rng(1).integers(0, 60, (*grey.shape[:2], 1), np.uint8)

        def measured(picture: np.ndarray, frame=frame, primitives=primitives, camera=camera) -> float:
            return np.isfinite(_repainted(frame, primitives, camera, picture))[frame.labels == wall].mean()

        assert measured(grey) == plain
        assert measured(rough) > 0.95
        assert measured(np.full_like(grey, 255)) == 0.0


def test_the_same_image_has_the_same_noise_and_no_other_has() -> None:
    def depth(**others) -> np.ndarray:
        return _see(_wall(1.5), **others).depth

    first = depth(seed=3, image_index=7)
    assert np.array_equal(first, depth(seed=3, image_index=7))
    assert not np.array_equal(first, depth(seed=3, image_index=8))
    assert not np.array_equal(first, depth(seed=4, image_index=7))
    primitives, _ = sensor_scenes.world(_wall(1.5))
    camera = Camera(SPEC, INFO, "camera", seed=3, image_index=6)
    camera.render(primitives, sensor_scenes.AHEAD)
    assert np.array_equal(first, camera.render(primitives, sensor_scenes.AHEAD).depth)  # it counts
    other = Camera(SPEC, INFO, "other", seed=3, image_index=7).render(primitives, sensor_scenes.AHEAD)
    assert not np.array_equal(first, other.depth)


def test_noise_is_alike_within_a_window_only() -> None:
    frame = _see(_wall(2.0), spec=_but(step=0.0), info=SPEC.info("optical"))
    error = (frame.depth - frame.exact_depth).astype(float)
    error -= error.mean()
    pixel = SPEC.fx.value / SPEC.stereo.focal.value

    def alike(apart: float) -> float:
        k = round(apart * pixel)
        return float((error[:, k:] * error[:, :-k]).mean() / (error**2).mean())

    assert alike(2.0) > 0.6
    assert alike(4.5) == pytest.approx(0.5, abs=0.12)
    assert abs(alike(15.0)) < 0.12


def test_truth_is_untouched() -> None:
    primitives, _ = sensor_scenes.world(model=sensor_scenes.demo())
    pose = sensor_scenes.AHEAD + np.array([0, 0, 0.4, 0, 0, 0, 0])
    real = Camera(SPEC, INFO).render(primitives, pose)
    ideal = Camera(SPEC.ideal(), INFO).render(primitives, pose)
    assert np.array_equal(real.exact_depth, ideal.depth)
    assert np.array_equal(real.labels, ideal.labels)
    exact = Camera(SPEC.coloured("exact"), INFO).render(primitives, pose)
    assert np.array_equal(exact.rgb, ideal.rgb)
    assert np.array_equal(exact.depth, real.depth, equal_nan=True)
    measured = np.isfinite(real.depth) & np.isfinite(ideal.depth)
    assert 0.5 < measured[ideal.depth < 4.0].mean() < 1.0
    error = np.abs(real.depth[measured] - ideal.depth[measured]) / ideal.depth[measured] ** 2
    assert np.median(error) < 3.0 * SPEC.stereo.noise.value / REACH


def test_an_ideal_camera_measures_exactly() -> None:
    frame = _see(_wall(1.5), spec=sensor_scenes.IDEAL, info=sensor_scenes.SMALL)
    assert np.array_equal(frame.depth, frame.exact_depth)
    assert frame.depth == pytest.approx(1.5, abs=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("baseline = { value = 0.050", "baseline = { value = 0.0", r"stereo\.baseline is 0 m; give 0\.001 to 2 m"),
        ("noise = { value = 0.08", "noise = { value = 800.0", r"stereo\.noise is 800 px; give 0 to 10 px"),
        ("width = { value = 640", "width = { value = 640000", r"width is 640000 px; give 1 to 8192 px"),
        ("farthest = { value = 10.0", "farthest = { value = 0.1", "an empty range; give 0 <= nearest < farthest"),
        ('focal = { value = 399.4, unit = "px"', 'focal = { value = 1.9, unit = "mm"', r"stereo\.focal\.unit is 'mm'"),
        ("window = ", "windw = ", r"stereo\.windw is not a field; did you mean 'window'\?"),
        ("saturation = ", "rate = ", r"stereo\.rate is not a field; it belongs to no table: write it above"),
    ],
)
def test_absurd_values_are_refused_in_one_line(tmp_path, old: str, new: str, says: str) -> None:
    text = find_data_file("cameras", "d435", ".toml").read_text(encoding="utf-8")
    assert old in text
    file = tmp_path / "bad.toml"
    file.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(SensorError, match=says) as caught:
        CameraSpec.load(str(file))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("quality", ["full", "fast"])
def test_shadows_fall_on_the_same_side_in_a_turned_picture(quality: str) -> None:
    """The second imager hangs at the camera, not in the world: rolled by 180 degrees it is on the other side."""
    primitives, _ = sensor_scenes.world(_wall(0.8, 0.1), _wall(1.6, index=1))
    camera = Camera(_but(noise=0.0), INFO, quality=quality)
    pose = sensor_scenes.AHEAD.copy()
    pose[3:] = frames.multiply(pose[3:], frames.exp(np.array([0.0, 0.0, np.pi])))
    for one in (sensor_scenes.AHEAD, pose):
        frame = camera.render(primitives, one)
        columns = np.flatnonzero(np.isnan(frame.depth[INFO.height // 2]))
        plate = np.flatnonzero(frame.exact_depth[INFO.height // 2] < 1.0)
        assert len(columns) > 3
        assert columns.max() <= plate[0]


def test_what_a_gpu_measures_from_its_own_picture_is_what_the_host_measures() -> None:
    """The same noise, exact depth and colours as arrays of the device: the same bits."""
    primitives, _ = sensor_scenes.world(_wall(2.5), _wall(1.2, half=0.2, index=1))
    frame = Camera(SPEC, INFO, "camera").render(primitives, sensor_scenes.AHEAD)
    lens = pinhole(INFO, frame.pose)
    stereo = Stereo(SPEC.stereo, INFO, (SPEC.nearest.value, SPEC.farthest.value))
    stereo.draw_noise(spec_file.noise_rng(0, "camera", 0))
    by_host = stereo.measure(primitives, lens, frame.exact_depth, frame.rgb, None)
    arrays = wp.array(frame.exact_depth.ravel()), wp.array(frame.rgb.reshape(-1, 3))
    by_device = stereo.measure_on_device(primitives, lens, *arrays).numpy().reshape(by_host.shape)
    assert np.isnan(by_host).any()
    assert np.array_equal(by_host, by_device, equal_nan=True)


def test_noise_of_a_gpu_is_normal_and_alike_within_a_window() -> None:
    """Variance 1; fields that are independent; correlation falls to zero over one window."""
    raw = wp.empty((2, 308, 408))
    noise = wp.empty((2, 300, 400))
    window = 9
    wp.launch(stereo_input.draw_normals, raw.size, inputs=[5], outputs=[raw.flatten()])
    wp.launch(stereo_input.correlate, noise.shape, inputs=[raw, window], outputs=[noise])
    first, second = noise.numpy()
    assert np.abs(raw.numpy().mean()) < 0.01
    assert raw.numpy().std() == pytest.approx(1.0, abs=0.01)
    assert first.std() == pytest.approx(1.0, abs=0.08)
    assert abs((first * second).mean()) < 0.1
    for lag in (1, 4, window):
        alike = (first[:, lag:] * first[:, :-lag]).mean() / first.var()
        assert alike == pytest.approx(1.0 - lag / window, abs=0.08)
