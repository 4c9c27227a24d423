"""The response of cameras: noise, clipping, colours and compression are those of the data sheet, and exact colours are
still there."""

import cv2
import msgspec
import numpy as np
import pytest
import warp as wp

from tests.support import sensor_scenes
from vinesim.core.data_files import find_data_file
from vinesim.core.thread_pool import ThreadPool
from vinesim.scene.ids import Organ
from vinesim.scene.values import CameraMount, CameraOutput
from vinesim.sensors.camera.camera import MAKER, Camera, CameraSpec
from vinesim.sensors.camera.motion import Moments, Motion
from vinesim.sensors.camera.response import LUMINANCE, ColourSpec, Response, compressed, sharpened
from vinesim.sensors.sensor import SensorSetting
from vinesim.sensors.spec_file import SensorError

NEUTRAL = {
    "white": 1.0,
    "shoulder": 0.0,
    "toe": 0.0,
    "contrast": 1.0,
    "saturation": 1.0,
    "balance": 0.0,
    "vignetting": 0.0,
    "blur": 0.0,
    "full_well": 1e9,
    "read_noise": 0.0,
    "chroma": (1.0, 1.0),
}
"""Values without any effect: light in, sRGB out."""
CAMERAS = ("d435", "dslr", "phone", "raspberry_pi")
SIZE = 256, 192


def _spec(**values) -> ColourSpec:
    """The D435's colour table with other values."""
    colour = CameraSpec.load("d435").colour
    assert colour is not None
    changed = {name: msgspec.structs.replace(getattr(colour, name), value=one) for name, one in values.items()}
    return msgspec.structs.replace(colour, **changed)


def _developed(spec: ColourSpec, light: np.ndarray, seed: int = 0, threads: int = 1) -> np.ndarray:
    """The picture of ``light`` [height, width, 3] at exposure 1, before compression."""
    height, width = light.shape[:2]
    response = Response(spec, width, height, 1, 1.0, np.random.default_rng(seed), workers=ThreadPool(threads))
    light = np.ascontiguousarray(light, np.float32)
    return response.develop(light.copy(), 1.0, np.ones(3), np.random.default_rng(seed)).copy()


def _flat(*colour: float) -> np.ndarray:
    return np.broadcast_to(np.array(colour * (3 // len(colour))), (SIZE[1], SIZE[0], 3))


def _linear(rgb: np.ndarray) -> np.ndarray:
    """Light for 8-bit sRGB (IEC 61966-2-1)."""
    seen = rgb / 255.0
    return np.where(seen <= 0.04045, seen / 12.92, ((seen + 0.055) / 1.055) ** 2.4)


def test_without_effects_the_picture_is_srgb() -> None:
    ramp = np.broadcast_to(np.linspace(0.0, 1.0, SIZE[0])[None, :, None], (SIZE[1], SIZE[0], 3))
    seen = np.where(ramp <= 0.0031308, 12.92 * ramp, 1.055 * ramp ** (1.0 / 2.4) - 0.055) * 255.0
    assert np.abs(_developed(_spec(**NEUTRAL), ramp) - seen).max() <= 1.1


@pytest.mark.parametrize(("full_well", "read_noise"), [(1500.0, 0.0), (4000.0, 60.0)])
def test_variance_is_linear_in_the_mean(full_well: float, read_noise: float) -> None:
    """Photon transfer: the variance of linear light rises by 1 / full well, from that of the read-out."""
    spec = _spec(**NEUTRAL | {"full_well": full_well, "read_noise": read_noise})
    levels = np.linspace(0.1, 0.6, 6)
    patches = [_linear(_developed(spec, _flat(level), seed)) for seed, level in enumerate(levels)]
    slope, start = np.polyfit([one.mean() for one in patches], [one.var() for one in patches], 1)
    assert slope == pytest.approx(1.0 / full_well, rel=0.04)
    assert start == pytest.approx((read_noise / full_well) ** 2, abs=0.02 / full_well)


def test_noise_of_pixels_and_colours_is_independent() -> None:
    picture = _linear(_developed(_spec(**NEUTRAL | {"full_well": 1000.0}), _flat(0.3)))
    off = picture - picture.mean()
    for other in (np.roll(off, 1, 0), np.roll(off, 1, 1), np.roll(off, 1, 2)):
        assert abs((off * other).mean() / off.var()) < 0.02


def test_light_above_white_is_clipped() -> None:
    """A ramp to 2.5 times white: three fifths of it are 255, and nothing below is."""
    ramp = np.broadcast_to(np.linspace(0.0, 2.0, 1000)[None, :, None], (8, 1000, 3))
    clipped = (_developed(_spec(**NEUTRAL | {"white": 0.8}), ramp) == 255).all(2)
    assert clipped.mean() == pytest.approx(0.6, abs=0.003)


def test_saturation_scales_the_distance_from_grey() -> None:
    colour = np.array([0.35, 0.5, 0.2])
    grey = float(colour @ LUMINANCE)
    for factor in (0.0, 0.5, 1.3):
        seen = _linear(_developed(_spec(**NEUTRAL | {"saturation": factor}), _flat(*colour))).mean((0, 1))
        assert seen - grey == pytest.approx(factor * (colour - grey), abs=0.004)


def test_corners_lose_the_stated_share() -> None:
    seen = _linear(_developed(_spec(**NEUTRAL | {"vignetting": 0.4}), _flat(0.5)))
    assert seen[0, 0, 1] / seen[SIZE[1] // 2, SIZE[0] // 2, 1] == pytest.approx(0.6, abs=0.01)


def test_blur_has_the_stated_width() -> None:
    """The point spread of a bright point has the second moment of the data sheet."""
    point = np.zeros((41, 41, 3))
    point[20, 20] = 5.0
    seen = _linear(_developed(_spec(**NEUTRAL | {"blur": 1.5}), point))[..., 1]
    away = np.arange(41) - 20.0
    assert np.sqrt((seen.sum(0) * away**2).sum() / seen.sum()) == pytest.approx(1.5, rel=0.08)


def test_sharpening_adds_to_edges_and_nothing_to_plains() -> None:
    rgb = np.full((20, 40, 3), 80, np.uint8)
    rgb[:, 20:] = 160
    twice, once = (sharpened(rgb, strength).astype(float) for strength in (1.0, 0.5))
    assert (twice[:, :14] == 80.0).all()
    assert (twice[:, 26:] == 160.0).all()
    # beside an edge of height h a Gaussian filter of sigma 1 px moves the level by h Phi(-0.5)
    assert once[0, 20, 0] - 160.0 == pytest.approx(0.5 * 80.0 * 0.3085, abs=1.5)
    assert twice - rgb == pytest.approx(2.0 * (once - rgb), abs=1.5)


def test_white_balance_errs_by_image_as_stated() -> None:
    """One error for each camera object, so a film keeps its colours; between images it has the stated spread."""
    spec = _spec(**NEUTRAL | {"balance": 0.1})
    errors = [Response(spec, 8, 8, 1, None, np.random.default_rng(n)).balance_error for n in range(400)]
    spread = np.log(errors).std(0)
    assert spread[[0, 2]] == pytest.approx(0.1, rel=0.12)
    assert spread[1] == 0.0


def test_automatic_exposure_reaches_the_key() -> None:
    spec = _spec(key=0.2, adaptation=1.0)
    response = Response(spec, 64, 48, 1, None, np.random.default_rng(0))
    for light in (0.05, 0.6):
        radiance = wp.array(np.full((64 * 48, 3), light), dtype=wp.vec3, device="cpu")
        assert light * response.meter(radiance, -1.0, 1.0) == pytest.approx(0.2, rel=1e-3)
        response = Response(spec, 64, 48, 1, None, np.random.default_rng(0))


def test_tone_curves_rise_from_black_to_white() -> None:
    for name in CAMERAS:
        colour = CameraSpec.load(name).colour
        assert colour is not None
        curve = colour.tone_curve().astype(int)
        assert (curve[0], curve[-1]) == (0, 255)
        assert (np.diff(curve) >= 0).all()
    steep, flat = (_spec(**NEUTRAL | {"contrast": c}).tone_curve().astype(float) for c in (1.5, 1.0))
    near = np.abs(flat - 127.5) < 10.0
    assert np.polyfit(flat[near], steep[near], 1)[0] == pytest.approx(1.5, rel=0.04)


def _stripes(across: int, down: int) -> np.ndarray:
    """Red and blue squares of equal luma, ``across`` x ``down`` pixels each."""
    rows, columns = np.mgrid[:64, :64]
    red = (rows // down + columns // across) % 2 == 0
    return np.where(red[..., None], [180, 60, 60], [60, 102, 146]).astype(np.uint8)


@pytest.mark.parametrize("quality", [None, 98])
@pytest.mark.parametrize("subsampling", [(1, 1), (2, 1), (2, 2)])
def test_chroma_is_subsampled(subsampling: tuple[int, int], quality: int | None) -> None:
    """Stripes of chroma that are finer than a chroma sample vanish; luma and coarser stripes stay."""

    def chroma(picture: np.ndarray) -> float:
        return float(picture.astype(float)[8:-8, 8:-8, 0].std())

    fine_columns, fine_rows, coarse = (_stripes(*size) for size in ((1, 64), (64, 1), (16, 16)))
    for picture, stays in ((fine_columns, subsampling[0] == 1), (fine_rows, subsampling[1] == 1), (coarse, True)):
        seen = compressed(picture, subsampling, quality)
        assert seen.shape == picture.shape
        assert (chroma(seen) > 0.6 * chroma(picture)) == stays
        luma = [cv2.cvtColor(one, cv2.COLOR_RGB2GRAY).astype(float) for one in (seen, picture)]
        assert np.abs(luma[0] - luma[1]).mean() < 4.0


def test_odd_sizes_are_subsampled_too() -> None:
    picture = np.random.default_rng(1).integers(0, 255, (33, 47, 3)).astype(np.uint8)
    for subsampling in ((2, 1), (2, 2)):
        assert compressed(picture, subsampling, None).shape == picture.shape


def test_lower_jpeg_quality_loses_more() -> None:
    picture = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (64, 64, 3)).astype(np.uint8), (0, 0), 1.0)
    lost = [np.abs(compressed(picture, (2, 2), q).astype(float) - picture).mean() for q in (95, 60, 10)]
    assert lost == sorted(lost)


# ---- cameras ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def board():
    """A slim upright board in front of the camera."""
    shape = sensor_scenes.shape("box", 0.02, 0.03, 3.0, at=(2.0, 0.0, 1.0))
    return sensor_scenes.world(sensor_scenes.thing(shape))[0]


def _camera(name: str = "d435", *, colour: str = "camera", label: str = "camera", **others) -> Camera:
    spec = CameraSpec.load(name).coloured(colour)
    return Camera(spec, spec.info("optical", 0.5), label, **others)


@pytest.mark.parametrize("quality", ["fast", "full", "still"])
@pytest.mark.parametrize("name", CAMERAS)
def test_only_colours_have_the_response(board, name: str, quality: str) -> None:
    """Labels and both depths are equal to the bit with and without response, and exact colours are those of a data
    sheet without it."""
    real, exact = (
        _camera(name, colour=c, quality=quality).render(board, sensor_scenes.AHEAD) for c in ("camera", "exact")
    )
    for field in ("labels", "exact_depth", "depth"):
        assert np.array_equal(getattr(real, field), getattr(exact, field), equal_nan=True)
    assert not np.array_equal(real.rgb, exact.rgb)
    spec = msgspec.structs.replace(CameraSpec.load(name), colour=None)
    plain = Camera(spec, spec.info("optical", 0.5), quality=quality).render(board, sensor_scenes.AHEAD)
    assert np.array_equal(plain.rgb, exact.rgb)


def test_seed_name_and_number_determine_a_picture(board) -> None:
    def picture(**others) -> np.ndarray:
        return _camera(**others).render(board, sensor_scenes.AHEAD, outputs=CameraOutput.RGB).rgb

    first = picture(seed=3, image_index=5, threads=1)
    assert np.array_equal(first, picture(seed=3, image_index=5, threads=3))
    for other in (
        {"seed": 4, "image_index": 5},
        {"seed": 3, "image_index": 6},
        {"seed": 3, "image_index": 5, "label": "x"},
    ):
        assert not np.array_equal(first, picture(**other))


def test_frames_of_a_film_have_noise_of_their_own(board) -> None:
    camera = _camera(exposure=0.7)
    one, other = (camera.render(board, sensor_scenes.AHEAD, outputs=CameraOutput.RGB).rgb for _ in "ab")
    apart = one.astype(float) - other
    assert 0.2 < apart.std() / np.sqrt(2.0) < 3.0
    assert abs(apart.mean()) < 0.2


def test_a_mount_may_ask_for_exact_colours(board) -> None:
    setting = SensorSetting()
    real, exact = (
        MAKER.make(CameraMount("head", "optical", "d435", size=(160, 120), colour=colour), setting)
        for colour in ("camera", "exact")
    )
    pictures = [camera.render(board, sensor_scenes.AHEAD).rgb for camera in (real, exact)]
    assert not np.array_equal(*pictures)
    assert exact.spec.colour is None


def test_bad_values_are_one_clear_line(tmp_path) -> None:
    shipped = find_data_file("cameras", "d435", ".toml").read_text(encoding="utf-8")
    file = tmp_path / "bad.toml"
    for old, new, said in (
        (
            "value = [2.0, 1.0]",
            "value = [1.0, 2.0]",
            r"colour\.chroma is \[1\.0, 2\.0\] px; give \[1, 1\], \[2, 1\] or \[2, 2\]",
        ),
        ("saturation = { value = 0.62", "saturation = { value = -1.0", r"colour\.saturation is -1 1; give 0 to 4 1"),
        (
            'full_well = { value = 26000.0, unit = "e"',
            'full_well = { value = 26000.0, unit = "ke"',
            r"colour\.full_well\.unit is 'ke'",
        ),
        ("toe = {", "tow = {", "tow"),
    ):
        assert shipped.count(old) == 1
        file.write_text(shipped.replace(old, new), encoding="utf-8")
        with pytest.raises(SensorError, match=said) as error:
            CameraSpec.load(str(file))
        assert "\n" not in str(error.value)
    with pytest.raises(SensorError, match="colour is 'film'; give camera or exact"):
        CameraSpec.load("d435").coloured("film")


# ---- motion and flash ------------------------------------------------------------------------------------------------


def _timed(exposure_time: float, line_delay: float, **others) -> Camera:
    """A pinhole camera with neutral colours and these times."""
    spec = CameraSpec.load("pinhole")
    values = NEUTRAL | {"exposure_time": exposure_time, "line_delay": line_delay}
    spec = msgspec.structs.replace(spec, colour=_spec(**values))
    return Camera(spec, spec.info("optical", 0.5), quality="full", exposure=0.5, threads=1, **others)


def test_weights_of_moments_sum_to_one() -> None:
    for exposure_time, line_delay in ((0.01, 0.0), (0.001, 5e-5), (0.02, 5e-5), (0.0, 5e-5)):
        moments = Moments.of(Motion(angular=(0.0, 0.0, 3.0)), 480, 600.0, exposure_time, line_delay)
        assert moments.weights.sum(0) == pytest.approx(1.0)
        assert moments.times[len(moments.times) // 2] == 0.0
        row = moments.weights[:, 100] @ moments.times
        assert row == pytest.approx(line_delay * (100 - 239.5), abs=moments.times[1] - moments.times[0])
    assert len(Moments.of(Motion(), 480, 600.0, 0.01, 5e-5).times) == 1


def test_no_motion_is_no_change(board) -> None:
    still, moved = (_timed(0.01, 1e-4).render(board, sensor_scenes.AHEAD, motion=m) for m in (None, Motion()))
    assert np.array_equal(still.rgb, moved.rgb)
    assert np.array_equal(still.labels, moved.labels)


def _left_edge(frame) -> np.ndarray:
    return (frame.labels >> 20 == int(Organ.ROBOT)).argmax(1)


def test_a_rolling_shutter_shears_an_upright_board(board) -> None:
    """A camera that turns by w shifts each row by w times focal length times its delay; labels and depth are of the
    same rows."""
    turn = 2.0
    delay = 1e-4
    camera = _timed(0.0, delay)
    frame = camera.render(board, sensor_scenes.AHEAD, motion=Motion(angular=(0.0, 0.0, turn)))
    rows = np.arange(5, 235)
    slope = np.polyfit(rows, _left_edge(frame)[rows], 1)[0]
    # rows of a picture of half the size take twice the time
    assert slope == pytest.approx(turn * 2.0 * delay * frame.info.fx, rel=0.06)
    seen = frame.labels >> 20 == int(Organ.ROBOT)
    assert np.array_equal(seen[:200], frame.exact_depth[:200] < 2.2)  # the rows above the near ground
    still = camera.render(board, sensor_scenes.AHEAD)
    assert np.ptp(_left_edge(still)[rows]) <= 1


def test_motion_blur_has_the_length_of_the_motion(board) -> None:
    """The edge of a board becomes a ramp as long as the motion in the picture."""
    speed, time = 3.0, 0.02
    frame = _timed(time, 0.0).render(board, sensor_scenes.AHEAD, motion=Motion(linear=(0.0, speed, 0.0)))
    still = _timed(time, 0.0).render(board, sensor_scenes.AHEAD)
    assert np.array_equal(frame.labels, still.labels)
    length = speed * time * frame.info.fx / 1.98
    width = 0.06 * frame.info.fx / 1.98
    row = slice(100, 110)
    alone, _ = sensor_scenes.world()
    behind = _timed(time, 0.0).render(alone, sensor_scenes.AHEAD, motion=Motion(linear=(0.0, speed, 0.0)))
    away = np.abs(_linear(frame.rgb) - _linear(behind.rgb))[row, :, 1].mean(0)
    touched = np.flatnonzero(away > 0.1 * away.max())
    assert np.ptp(touched) + 1 == pytest.approx(length + width, abs=1.5)


def test_a_moving_scene_is_blurred_and_put_back(board) -> None:
    offsets = []
    motion = Motion(pose_scene=offsets.append, scene_speed=5.0)
    _timed(0.02, 0.0).render(board, sensor_scenes.AHEAD, motion=motion)
    assert offsets[-1] == 0.0
    assert min(offsets) == pytest.approx(-max(offsets))
    assert 0.008 < max(offsets) < 0.01


def test_a_flash_falls_with_the_square_of_distance() -> None:
    """At night, boards at 1 m and 2 m that face the camera reflect 4 : 1; by day the flash does not fire."""
    near, far = (
        sensor_scenes.thing(sensor_scenes.shape("box", 0.01, x * 0.2, x * 0.2, at=(x + 0.01, y, 1.0)), index=i)
        for i, (x, y) in enumerate([(1.0, 0.3), (2.0, -0.6)])
    )
    primitives = sensor_scenes.world(near, far)[0]
    spec = CameraSpec.load("pinhole")
    seen = {}
    for sun in ((0.3, 0.2, -0.9), (0.3, 0.2, 0.9)):
        for flash in (0.0, 0.3):
            lit = msgspec.structs.replace(spec, colour=_spec(**NEUTRAL | {"white": 2.0}))
            number = msgspec.structs.replace(lit.colour.key, value=flash, unit="m^2")
            lit = msgspec.structs.replace(lit, colour=msgspec.structs.replace(lit.colour, flash=number))
            camera = Camera(lit, spec.info("optical", 0.5), sun=sun, quality="full", exposure=1.0)
            frame = camera.render(primitives, sensor_scenes.AHEAD)
            light = _linear(frame.rgb)
            numbers = frame.labels & 0xFFFFF
            robot = frame.labels >> 20 == int(Organ.ROBOT)
            seen[sun[2] > 0, flash > 0] = np.array([light[robot & (numbers == i)].mean(0) for i in range(2)])
    assert np.array_equal(seen[True, True], seen[True, False])
    near_light, far_light = seen[False, True]  # at equal angles, and the sky is dark
    assert near_light / far_light == pytest.approx(4.0, rel=0.03)


def test_the_data_sheets_say_where_each_figure_is_from() -> None:
    for name in CAMERAS:
        spec = CameraSpec.load(name)
        assert spec.colour is not None
        for field in spec.colour.__struct_fields__:
            number = getattr(spec.colour, field)
            assert number is None or len(number.source) > 5
        field_of_view = 2.0 * np.degrees(np.arctan(0.5 * spec.width.value / spec.fx.value))
        if name not in ("d435", "dslr"):
            assert 62.0 <= field_of_view <= 78.0
