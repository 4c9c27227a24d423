"""Pictures of a palette have the colours that its file gives: leaves and soil in white light, shares of the ground."""

import cv2
import msgspec
import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.look import Look
from vinesim.scene.palette import DEFAULT, GroundColours, Palette, _sky, draw, palette_names, to_hsv
from vinesim.scene.spec import load_scene
from vinesim.sensors.camera.camera import Camera
from vinesim.sensors.camera.sunlight import OutdoorLight, Sunlight
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives import palette_colours, scene_primitives
from vinesim.sensors.primitives.plant_primitives import shown_age
from vinesim.sensors.primitives.scene_primitives import Primitives

SUN = (0.15, 0.75, 0.6)
"""Behind a camera that looks at the row."""
AT_THE_ROW = look_at(np.array([2.0, 1.6, 1.35]), np.array([2.0, 0.0, 1.2]))
DOWN = look_at(np.array([2.0, 8.0, 6.0]), np.array([2.01, 8.0, 0.0]))
"""From 6 m above the ground of an alley."""
HUE_ERROR = 5.0
"""[deg]"""


@pytest.fixture(scope="module")
def model():
    scene = load_scene("vsp")
    return generate(msgspec.structs.replace(scene, layout=msgspec.structs.replace(scene.layout, rows=1, vines=3)))


@pytest.fixture
def white(monkeypatch):
    """Light of sun, sky, canopy and ground without a colour."""
    grey = np.ones(3)
    light = OutdoorLight(2.8 * grey, 0.75 * grey, 0.6 * grey, 0.2 * grey, 0.13 * grey, 1.0, 1.0, grey)
    monkeypatch.setattr(OutdoorLight, "of", lambda height, palette=DEFAULT: light)


def picture(model, palette: Palette, pose=AT_THE_ROW, quality="full", grass=0.0, exposure=0.6):
    """The picture [row, column, 3] of the model with a palette, and the organ of each pixel."""
    model.look = Look(palette)
    camera = Camera(sensor_scenes.IDEAL, sensor_scenes.SMALL, sun=SUN, quality=quality, exposure=exposure)
    frame = camera.render(Primitives(model, grass=grass), pose)
    return frame.rgb, frame.labels >> 20


def hue_of(pixels) -> float:
    """Median hue [deg] of pixels [n, 3]."""
    return float(np.median(cv2.cvtColor((pixels / np.float32(255.0))[None], cv2.COLOR_RGB2HSV)[0, :, 0]))


def albedo(pixels) -> np.ndarray:
    """Mean luminance of sRGB pixels, by the inverse of the tone curve."""
    tone = scene_primitives.textures.tone_curve()
    radiance = (np.searchsorted(tone, pixels.reshape(-1, 3)) / 1024.0) ** 2
    return radiance.mean()


@pytest.mark.parametrize("name", palette_names()[1:])
def test_leaves_and_soil_have_the_hue_of_the_file_in_white_light(name, model, white):
    palette = draw(name, 2)
    rgb, organ = picture(model, palette)
    leaves = rgb[organ == int(Organ.LEAF)]
    assert len(leaves) > 10_000
    assert hue_of(leaves) == pytest.approx(to_hsv(palette.leaf.grown)[0], abs=HUE_ERROR)

    bare = msgspec.structs.replace(palette.ground, cover=-2.0, far_cover=0.0, straw_share=0.0)
    # pale soil is exposed less, because the tone curve turns the hue of bright colours
    rgb, organ = picture(model, msgspec.structs.replace(palette, ground=bare), DOWN, exposure=0.25)
    soil = rgb[organ == int(Organ.GROUND)]
    assert len(soil) > 10_000
    hues = sorted(to_hsv(colour)[0] for colour in (bare.soil_dark, bare.soil_light))
    assert hues[0] - HUE_ERROR < hue_of(soil) < hues[1] + HUE_ERROR


BLACK = (0.0, 0.0, 0.0)
WHITE = (0.5, 0.5, 0.5)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("what", ["dry_share", "straw_share"])
def test_a_share_of_the_ground_is_that_of_the_picture(what, share, model, white):
    """White straw on black soil, and white dry grass in black sod, over the light of white ground."""

    def light(**others) -> float:
        colours = dict.fromkeys(("soil_dark", "soil_light", "turf_dark", "turf_light", "field"), BLACK)
        ground = GroundColours(**(colours | {"dry": WHITE, "straw": WHITE, "most_cover": 1.0} | others))
        return albedo(picture(model, Palette(ground=ground), DOWN)[0])

    only = {"cover": 2.0, "far_cover": 9.0} if what == "dry_share" else {"cover": -2.0, "far_cover": 0.0}
    assert light(**only, **{what: share}) / light(**only, **{what: 1.0}) == pytest.approx(share, abs=0.12)


def test_a_share_of_cover_is_that_of_the_picture(model, white, tmp_path):
    """White soil under black sod, over the light of bare white soil; the file gives the share of sod."""
    tone = '{ hue = [0, 0], saturation = [0, 0], value = [%g, %g], grade = "GUESSED", source = "a test" }'
    number = '{ value = [%g, %g], unit = "1", grade = "GUESSED", source = "a test" }'

    def light(share: float) -> float:
        lines = [f"{key} = {tone % (0.7, 0.7)}" for key in ("soil_dark", "soil_light")]
        lines += [f"{key} = {tone % (0.0, 0.0)}" for key in ("turf_dark", "turf_light")]
        lines += [f"cover = {number % (share, share)}", f"strip = {number % (0.0, 0.0)}"]
        file = tmp_path / "mine.toml"
        file.write_text("\n".join(["[ground]", *lines]))
        return albedo(
            picture(model, draw(str(file), 1), look_at(np.array([2.0, 0.9, 9.0]), np.array([2.01, 0.9, 0.0])))[0]
        )

    bare = light(0.0)
    found = [1.0 - light(share) / bare for share in (0.2, 0.5, 0.8)]
    assert found == pytest.approx([0.2, 0.5, 0.8], abs=0.15)


@pytest.mark.parametrize("name", ["red-earth", "blue-leaf"])
def test_live_pictures_have_the_colours_of_exact_ones(name, model):
    """Two kernels compute them: the mean colours of leaves and ground differ by 3 % at most."""
    palette = draw(name, 1)
    exact, organ = picture(model, palette, quality="full", grass=20.0)
    live, _ = picture(model, palette, quality="fast", grass=20.0)
    for kind in (Organ.LEAF, Organ.GROUND):
        there = organ == int(kind)
        assert live[there].mean(0) == pytest.approx(exact[there].mean(0), rel=0.03), kind


def test_another_palette_is_another_entry_of_the_cache(model, tmp_path, monkeypatch):
    monkeypatch.setenv("VINESIM_CACHE", str(tmp_path))
    tints = []
    for name in ("slate", "chalk", "slate"):
        model.look = Look(draw(name, 1))
        tints.append(Primitives(model, grass=5.0).materials.tint.numpy())
    assert np.array_equal(tints[0], tints[2])
    assert not np.array_equal(tints[0], tints[1])
    assert len(list(tmp_path.rglob("primitives*"))) >= 2


def test_a_camera_that_sees_another_palette_has_its_light(model):
    light = Sunlight(SUN)
    found = []
    for name in ("default", "chalk", "default"):
        model.look = Look(draw(name, 1))
        light.update(Primitives(model, grass=0.0), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), 0.0)
        found.append(tuple(light.light.ground_colour))
    assert found[0] == found[2] != found[1]
    assert found[1] > found[0]  # chalk reflects more light than brown soil


def test_leaves_turned_by_the_season_show_margins_where_others_do_not():
    age = np.array([0.1, 0.5, 0.6, 0.75, 0.9])
    none = msgspec.structs.replace(DEFAULT.leaf, margins=0.0)
    assert shown_age(none, age) == pytest.approx([0.1, 0.42, 0.42, 0.75, 0.9])
    assert np.array_equal(shown_age(DEFAULT.leaf, age), age)


def test_the_default_palette_adds_nothing():
    """No share varies, so that pictures are those of constant colours."""
    colours = palette_colours.shared_colours(DEFAULT)
    assert [colours[name] for name in ("cover", "dry_share", "dry_gain", "straw_share", "straw_gain")] == [0.0] * 5
    assert (colours["strip"], colours["far_cover"]) == (1.0, 1.0)


def test_an_overcast_sky_is_white_and_the_sun_weak():
    clear, closed = (OutdoorLight.of(0.7, Palette(sky=draw_sky(share))) for share in (0.0, 1.0))
    assert closed.sun.max() < 0.1 * clear.sun.max()
    assert np.ptp(closed.sky) / closed.sky.mean() < 0.3 * np.ptp(clear.sky) / clear.sky.mean()
    assert 0.2 < closed.brightness < 0.5


def draw_sky(overcast: float):
    return _sky({"overcast": overcast})
