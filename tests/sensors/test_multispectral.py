"""Multispectral cameras: reflectances of the data file, times the light that falls on what is seen."""

import dataclasses
import tomllib

import numpy as np
import pytest

from tests.support import sensor_scenes
from tests.support.sensor_scenes import shape, thing
from vinesim.core.data_files import find_data_file
from vinesim.scene.ids import LABEL_STRIDE, Organ
from vinesim.scene.values import MultispectralFrame, MultispectralMount
from vinesim.sensors.camera.multispectral import FULL_SCALE, SURFACES, MultispectralCamera, MultispectralSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot
from vinesim.sensors.sensor import SensorSetting, maker
from vinesim.sensors.spec_file import SensorError

FILE = find_data_file("multispectral", "rededge_mx", ".toml")
SPEC = MultispectralSpec.load("rededge_mx")
INFO = SPEC.info("optical", (160, 120))
DATA = tomllib.loads(FILE.read_text(encoding="utf-8"))
HIGH_SUN = SensorSetting(sun=(0.0, 0.0, 1.0))
DOWN = look_at(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.001, 0.0]))


def ndvi_of(surface: str) -> float:
    """By hand, from the numbers of the data file."""
    names = [band["name"] for band in DATA["bands"]]
    value = DATA["reflectance"][surface]["value"]
    red = value[names.index("red")]
    nir = value[names.index("nir")]
    return (nir - red) / (nir + red)


def camera(**options) -> MultispectralCamera:
    return MultispectralCamera(SPEC, INFO, is_exact=True, **options)


@pytest.fixture(scope="module")
def canopy() -> tuple[Primitives, MultispectralFrame]:
    """The demo's vines from the alley, and the picture."""
    model = sensor_scenes.demo()
    primitives = Primitives(model, grass=0.0)
    primitives.update(rest_snapshot(model))
    pose = look_at(np.array([0.4, 1.2, 1.3]), np.array([3.0, 0.0, 1.2]))
    return primitives, camera().render(primitives, pose)


def seen_surfaces(primitives: Primitives, frame: MultispectralFrame) -> tuple[np.ndarray, np.ndarray]:
    """Primitive of each pixel, and age of the leaves there."""
    _, primitive = sensor_scenes.raster(primitives, frame.pose, frame.info)
    return primitive, np.where(primitive >= 0, primitives.shapes.d.numpy()[primitive, 3], 0.0)


def test_bands_are_those_of_the_file_by_wavelength(canopy):
    bands = canopy[1].bands
    assert [b.name for b in bands] == ["blue", "green", "red", "red_edge", "nir"]
    assert [b.centre for b in bands] == [475.0, 560.0, 668.0, 717.0, 842.0]
    assert canopy[1].reflectance.shape == (5, INFO.height, INFO.width)
    assert canopy[1].reflectance.dtype == np.float32


def test_ndvi_of_green_leaves_is_that_of_the_file(canopy):
    primitives, frame = canopy
    primitive, age = seen_surfaces(primitives, frame)
    blades = primitives.shapes.kind.numpy()[primitive] == 2
    leaves = (frame.labels // LABEL_STRIDE == int(Organ.LEAF)) & blades & (age <= 0.42)
    assert leaves.sum() > 1000
    np.testing.assert_allclose(frame.ndvi[leaves], ndvi_of("leaf"), atol=1e-5)
    assert np.ptp(frame.band("nir")[leaves]) > 0.2  # in the sun and in the shade


def test_old_leaves_dry(canopy):
    primitives, frame = canopy
    primitive, age = seen_surfaces(primitives, frame)
    blades = (primitive >= 0) & (primitives.shapes.kind.numpy()[primitive] == 2)
    ndvi = frame.ndvi[blades & (age > 0.5)]
    assert (ndvi < ndvi_of("leaf") - 1e-3).all()
    assert (ndvi > ndvi_of("leaf_dry") - 1e-5).all()


def test_all_bands_get_the_same_share_of_light(canopy):
    primitives, frame = canopy
    primitive, age = seen_surfaces(primitives, frame)
    leaves = (primitive >= 0) & (frame.labels // LABEL_STRIDE == int(Organ.LEAF)) & (age <= 0.42)
    leaves &= primitives.shapes.kind.numpy()[primitive] == 2
    light = frame.reflectance[:, leaves] / np.array(DATA["reflectance"]["leaf"]["value"])[:, None]
    np.testing.assert_allclose(light, light[:1].repeat(5, 0), rtol=1e-5)


def test_ndvi_of_bare_soil_is_that_of_the_file():
    model = sensor_scenes.demo()
    primitives = Primitives(model, grass=0.0)
    primitives.update(rest_snapshot(model))
    frame = camera().render(primitives, look_at(np.array([0.4, 1.2, 1.3]), np.array([3.0, 0.0, 0.6])))
    ground = frame.ndvi[sensor_scenes.raster(primitives, frame.pose, INFO)[1] == -2]
    assert (np.abs(ground - ndvi_of("soil")) < 1e-5).mean() > 0.2
    assert (ground > ndvi_of("soil") - 1e-5).all()  # the rest is on its way to sod
    assert (ground < ndvi_of("grass") + 1e-5).all()


def test_a_level_panel_in_the_open_reflects_what_the_file_says():
    """It sees less than the whole sky, as all that moves does, and gets a little less light for that."""
    panel = thing(shape("box", 0.3, 0.3, 0.01, surface="plastic"), organ=Organ.BOX)
    frame = camera(setting=HIGH_SUN).render(sensor_scenes.world(panel)[0], DOWN)
    found = frame.reflectance[:, INFO.height // 2, INFO.width // 2]
    np.testing.assert_allclose(found, DATA["reflectance"]["plastic"]["value"], rtol=0.12)
    assert (found < DATA["reflectance"]["plastic"]["value"]).all()


def test_shadow_darkens_every_band_and_leaves_the_ndvi():
    board = thing(shape("box", 0.3, 0.3, 0.01, at=(0.0, 0.0, 2.0)))
    sun = SensorSetting(sun=(0.0, 0.0, 1.0))
    lit = camera(setting=sun).render(sensor_scenes.world()[0], DOWN)
    dark = camera(setting=sun).render(sensor_scenes.world(board)[0], DOWN)
    middle = np.s_[INFO.height // 2 - 5 : INFO.height // 2 + 5, INFO.width // 2 - 5 : INFO.width // 2 + 5]
    assert (dark.reflectance[:, *middle] < 0.5 * lit.reflectance[:, *middle]).all()
    np.testing.assert_allclose(dark.ndvi[middle], lit.ndvi[middle], atol=1e-5)


def test_a_plastic_box_and_the_sky_have_no_ndvi_of_plants():
    box = thing(shape("box", 0.2, 0.2, 0.2, at=(1.5, 0.0, 1.0), surface="plastic"), organ=Organ.BOX)
    frame = camera().render(sensor_scenes.world(box)[0], sensor_scenes.AHEAD)
    np.testing.assert_allclose(frame.ndvi[INFO.height // 2, INFO.width // 2], ndvi_of("plastic"), atol=1e-5)
    np.testing.assert_allclose(frame.reflectance[:, 0, 0], DATA["reflectance"]["sky"]["value"], rtol=1e-6)


def test_dark_berries_absorb_green_and_pale_ones_do_not(canopy):
    primitives, frame = canopy
    primitive, _ = seen_surfaces(primitives, frame)
    berries = (primitive >= 0) & (primitives.materials.material.numpy()[primitive] == 1)
    tint = primitives.materials.tint.numpy()[primitive[berries]]
    found = frame.band("green")[berries] / frame.band("nir")[berries]
    values = {name: DATA["reflectance"][name]["value"] for name in ("berry_green", "berry_dark")}
    for name, these in (("berry_dark", tint[:, 1] < 0.5 * tint[:, 0]), ("berry_green", tint[:, 1] > tint[:, 0])):
        np.testing.assert_allclose(found[these], values[name][1] / values[name][4], rtol=1e-4)
    assert len(found) > 100


def test_radiance_is_that_of_a_matt_panel():
    """L = reflectance x E / pi."""
    frame = camera(setting=HIGH_SUN).render(sensor_scenes.world()[0], DOWN)
    irradiance = np.array([band["irradiance"]["value"] for band in DATA["bands"]])
    np.testing.assert_allclose(frame.radiance, frame.reflectance * (irradiance / np.pi)[:, None, None], rtol=1e-5)


def test_noise_is_that_of_electrons_and_follows_from_the_seed(canopy):
    primitives, exact = canopy
    noisy = MultispectralCamera(SPEC, INFO, "m", SensorSetting(seed=3, number=7)).render(primitives, exact.pose)
    again = MultispectralCamera(SPEC, INFO, "m", SensorSetting(seed=3, number=7)).render(primitives, exact.pose)
    other = MultispectralCamera(SPEC, INFO, "m", SensorSetting(seed=3, number=8)).render(primitives, exact.pose)
    np.testing.assert_array_equal(noisy.reflectance, again.reflectance)
    assert (noisy.reflectance != other.reflectance).any()
    scale = SPEC.full_well.value / SPEC.brightest.value
    inside = exact.reflectance < 0.9 * SPEC.brightest.value
    inside &= exact.reflectance > 0.03  # where the noise does not reach below zero
    error = (noisy.reflectance - exact.reflectance)[inside] * scale
    expected = exact.reflectance[inside] * scale + SPEC.read_noise.value**2
    assert np.mean(error**2 / expected) == pytest.approx(1.0, abs=0.03)
    steps = noisy.reflectance / (SPEC.brightest.value / 4095)
    np.testing.assert_allclose(steps, np.rint(steps), atol=2e-3)


def test_the_export_keeps_reflectances_in_16_bits(canopy):
    frame = canopy[1]
    export = maker("multispectral").export
    assert export is not None
    kept = export(frame)
    assert list(kept.images) == ["blue", "green", "red", "red_edge", "nir", "ndvi"]
    assert kept.images["nir"].dtype == np.uint16
    np.testing.assert_allclose(kept.images["nir"] / FULL_SCALE, frame.band("nir"), atol=1.0 / FULL_SCALE)
    assert [band["centre_nm"] for band in kept.record["bands"]] == [475.0, 560.0, 668.0, 717.0, 842.0]


def test_a_mount_sets_size_and_name():
    made = maker("multispectral").make(MultispectralMount("m", "f", "rededge_mx", size=(64, 48)), SensorSetting())
    primitives, view = sensor_scenes.world()
    frame = made.frame(primitives, view, sensor_scenes.AHEAD, outputs=None)
    assert (frame.name, frame.info.frame_id, frame.band("red").shape) == ("m", "f", (48, 64))
    assert dataclasses.replace(frame, time=2.0).time == 2.0
    assert made.rate == 1.0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "nir"', 'name = "ir"', r"give different names, with red and nir"),
        ("value = 475", "value = 600", r"give them sorted by wavelength"),
        ('name = "red_edge"', 'name = "red"', r"give different names"),
        (
            "value = [0.043, 0.135, 0.038, 0.282, 0.442]",
            "value = [0.1]",
            r"reflectance.leaf is \[0.1\]; give 5 numbers",
        ),
        (
            "[reflectance] # by surface, one number a band\n",
            "[reflectance]\nmoss = { value = [], unit = '1', grade = 'GUESSED', source = '' }\n",
            r"reflectance.moss is missing or unknown",
        ),
        ("value = 32, unit", "value = 900, unit", r"bands\[0\].width is 900 nm; give 1 to 500 nm"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, old, new, message):
    text = FILE.read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "m.toml").write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(SensorError, match=message) as refused:
        MultispectralSpec.load(str(tmp_path / "m.toml"))
    assert "\n" not in str(refused.value)


def test_every_surface_has_a_source():
    assert set(DATA["reflectance"]) == set(SURFACES)
    assert all(entry["grade"] and entry["source"] for entry in DATA["reflectance"].values())
