"""Depth of field: the circle of confusion of a thin lens, light is kept, and labels and depth stay sharp."""

from __future__ import annotations

import pathlib

import msgspec
import numpy as np
import pytest

from vinesim.core.data_files import find_data_file
from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.plant_parameters import Number
from vinesim.scene.spec import load_scene
from vinesim.sensors import spec_file
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.camera.defocus import LensSpec, automatic_focus, defocused
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.scene_primitives import Primitives


def _number(value: float, unit: str) -> Number:
    return Number(value=value, unit=unit, grade="GUESSED", source="test")


def _lens(f_number: float = 5.6, sensor_width: float = 22.3) -> LensSpec:
    return LensSpec(f_number=_number(f_number, "1"), sensor_width=_number(sensor_width, "mm"))


@pytest.mark.parametrize(("focal", "f_number", "focus"), [(0.028, 5.6, 1.0), (0.055, 4.0, 0.7), (0.018, 11.0, 2.5)])
def test_the_disc_of_infinity_is_that_of_a_thin_lens(focal: float, f_number: float, focus: float) -> None:
    """Oracle: the rays of a far point meet at the focal length, the sensor is at the image of the plane of focus, and
    the cone between them has the aperture as its base (thin lens equation)."""
    pixel = 22.3e-3 / 768
    sensor = 1.0 / (1.0 / focal - 1.0 / focus)
    cone = focal / f_number * (sensor - focal) / focal
    assert _lens(f_number).infinity_disc(focal / pixel, 768, focus) == pytest.approx(cone / pixel, rel=1e-9)


@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("depth", [0.6, 1.7, np.inf])
def test_a_point_becomes_its_disc_and_keeps_its_light(samples: int, depth: float) -> None:
    focus, disc, size = 1.0, 12.0, 64
    radiance = np.zeros((size * samples, size * samples, 3), np.float32)
    middle = slice(32 * samples, 33 * samples)
    radiance[middle, middle] = [1.0, 2.0, 0.5]
    spread = defocused(radiance, np.full(radiance.shape[:2], depth, np.float32), samples, disc, focus)
    assert spread.sum((0, 1)) == pytest.approx([1.0, 2.0, 0.5], rel=1e-4)
    row, column = np.mgrid[:size, :size] - 32.0
    second_moment = float((spread[..., 0] * (row**2 + column**2)).sum())
    diameter = disc * abs(1.0 - focus / depth)
    # of a disc radius^2 / 2, and 1/6 for the area of the pixel
    assert second_moment == pytest.approx(diameter**2 / 8.0 + 1.0 / 6.0, rel=0.12)


def test_what_is_in_focus_stays_sharp_before_a_blurred_background() -> None:
    depth = np.full((64, 64), np.inf, np.float32)
    depth[:, :32] = 1.0
    radiance = np.zeros((64, 64, 3), np.float32)
    radiance[:, :32] = 0.2
    radiance[::2, 32:] = 1.0
    picture = defocused(radiance, depth, 1, 12.0, 1.0)
    assert picture[:, :31] == pytest.approx(np.full((64, 31, 3), 0.2), abs=1e-5)
    assert picture[16:48, 34:60].std() < 0.12  # of stripes with 0.5


def test_what_is_before_the_focus_covers_it_softly() -> None:
    depth = np.full((64, 64), 1.0, np.float32)
    depth[:, :32] = 0.6
    radiance = np.where(np.isclose(depth, 1.0)[..., None], 1.0, 0.0).astype(np.float32).repeat(3, 2)
    edge = defocused(radiance, depth, 1, 12.0, 1.0)[32, :, 0]
    assert (np.diff(edge) > -1e-4).all()
    # inside of the outline the lens would see past it, but what is there is unknown
    radius = 0.5 * 12.0 * (1.0 / 0.6 - 1.0)
    assert np.count_nonzero((edge > 0.02) & (edge < 0.98)) == pytest.approx(radius, abs=1.5)


def test_automatic_focus_finds_near_things_in_the_middle() -> None:
    depth = np.full((40, 60), 30.0, np.float32)
    depth[:, 20:40] = 1.2
    assert automatic_focus(depth) == pytest.approx(1.2)
    assert automatic_focus(np.full((4, 4), np.inf)) > 100.0


def test_only_colours_are_blurred() -> None:
    scene = load_scene("vsp")
    scene = msgspec.structs.replace(scene, layout=msgspec.structs.replace(scene.layout, rows=2, vines=2))
    primitives = Primitives(generate_uncached(scene), grass=10.0)
    pose = look_at(np.array([1.0, -1.0, 1.1]), np.array([1.2, 0.0, 1.0]))
    spec = CameraSpec.load("dslr")
    info = spec.info("", size=(192, 128))
    sharp, soft, softer = (
        Camera(msgspec.structs.replace(spec, lens=lens), info, quality="still", threads=1).render(primitives, pose)
        for lens in (None, _lens(2.8), _lens(1.0))
    )
    for one in (soft, softer):
        for name in ("labels", "exact_depth", "depth"):
            assert np.array_equal(getattr(one, name), getattr(sharp, name))

    far = sharp.exact_depth > 3.0

    def detail(frame) -> float:
        return float(np.abs(np.diff(frame.rgb.astype(float), axis=1))[far[:, 1:] & far[:, :-1]].mean())

    assert detail(softer) < detail(soft) < detail(sharp)
    assert detail(softer) < 0.7 * detail(sharp)
    assert CameraSpec.load("dslr").coloured("exact").lens is None


def test_a_lens_without_colours_is_refused_in_one_line(tmp_path: pathlib.Path) -> None:
    text = find_data_file("cameras", "dslr", ".toml").read_text()
    file = tmp_path / "lens.toml"
    file.write_text(text[: text.index("[colour]")])
    with pytest.raises(spec_file.SensorError, match=r"has a table lens but none with its colours; give colour, too"):
        CameraSpec.load(str(file))
