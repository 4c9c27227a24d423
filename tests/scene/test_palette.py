"""Palettes: files give ranges, seeds draw from them, and bad values are refused in one line."""

import itertools

import msgspec
import numpy as np
import pytest

from vinesim.core.data_files import find_data_file
from vinesim.core.toml_loader import DataError
from vinesim.scene import palette
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.palette import ANY_NAME, DEFAULT, Tone, draw, load_palette, palette_names, to_hsv
from vinesim.scene.spec import SceneError, load_scene, with_palette

NAMED = palette_names()[1:]
PARTS = ("leaf", "wood", "ground", "sky")


def test_a_scene_that_names_no_palette_has_the_default_whatever_its_seed():
    for seed in (1, 2):
        assert generate(load_scene("vsp", seed=seed)).look.palette == DEFAULT
    assert draw(palette.DEFAULT_NAME, 7) == DEFAULT


def test_the_palette_changes_neither_plants_nor_their_digest():
    scene = load_scene("vsp")
    plain, red = generate(scene), generate(with_palette(scene, "red-earth"))
    assert red.look.palette.name == "red-earth"
    assert red.digest() == plain.digest()
    assert red.copy().look.palette == red.look.palette


@pytest.mark.parametrize("name", NAMED)
def test_a_drawn_colour_lies_in_the_ranges_of_the_file(name):
    ranges = load_palette(name)
    for seed, part in itertools.product(range(5), ("leaf", "wood", "ground", "sky")):
        drawn = getattr(draw(name, seed), part)
        table = getattr(ranges, part)
        for key in table.__struct_fields__:
            tone = getattr(table, key)
            if isinstance(tone, Tone) and hasattr(drawn, key):
                for value, (low, high), error in zip(
                    to_hsv(getattr(drawn, key)),
                    (tone.hue, tone.saturation, tone.value),
                    (0.5, 0.002, 0.002),
                    strict=True,
                ):
                    assert low - error <= value <= high + error, (part, key, seed)


def test_palettes_span_the_leaves_and_soils_of_real_vineyards():
    leaf = [to_hsv(draw(name, seed).leaf.grown)[0] for name in NAMED for seed in range(20)]
    assert min(leaf) < 62.0
    assert max(leaf) > 150.0
    assert 0.1 < np.mean(np.array(leaf) > 120.0) < 0.4
    soil = np.array([to_hsv(draw(name, seed).ground.soil_light) for name in NAMED for seed in range(20)])
    assert soil[:, 0].min() < 20.0  # red
    assert soil[:, 1].min() < 0.1  # grey
    assert soil[:, 2].min() < 0.45
    assert soil[:, 2].max() > 0.88


@pytest.mark.parametrize("name", [*NAMED, ANY_NAME])
def test_the_same_seed_draws_the_same_palette_and_another_seed_another(name):
    assert draw(name, 3) == draw(name, 3)
    assert draw(name, 3) != draw(name, 4)


def test_the_seed_is_that_of_the_table_or_else_of_the_scene():
    scene = load_scene("vsp", seed=5)
    assert palette.resolve(with_palette(scene, "chalk")) == draw("chalk", 5)
    assert palette.resolve(with_palette(scene, "chalk", 9)) == draw("chalk", 9)


def test_any_mixes_the_parts_of_all_palettes():
    """Every part of every palette turns up, and parts of one draw come from different palettes."""
    known = {part: {} for part in PARTS}
    mixed = 0
    for seed in range(80):
        drawn = draw(ANY_NAME, seed)
        origins = set()
        for part in PARTS:
            for name in palette_names():
                if getattr(draw(name, seed), part) == getattr(drawn, part):
                    known[part].setdefault(name, seed)
                    origins.add(name)
        mixed += len(origins) > 1
    assert all(set(known[part]) == set(palette_names()) for part in PARTS), known
    assert mixed > 70


def test_hue_saturation_and_value_come_back():
    for hue, saturation, value in itertools.product((5.0, 97.0, 151.0, 216.0), (0.2, 0.7), (0.1, 0.5, 0.9)):
        assert to_hsv(palette.from_hsv(hue, saturation, value)) == pytest.approx((hue, saturation, value), abs=0.1)


LEAF = 'grown = { hue = [90, 100], saturation = [0.4, 0.5], value = [0.4, 0.5], grade = "GUESSED", source = "by eye" }'
SHARE = 'cover = { value = [0.1, 0.5], unit = "1", grade = "GUESSED", source = "by eye" }'
SOIL = LEAF.replace("grown", "soil_light")
GOOD = f"[leaf]\n{LEAF}\n[ground]\n{SHARE}\n{SOIL}\n"
ERRORS = {
    "hue": (("[90, 100]", "[90, 400]"), ["leaf.grown.hue[1] is 400", "<= 360"]),
    "order": (("[90, 100]", "[100, 90]"), ["leaf.grown.hue is [100.0, 90.0]", "[lowest, highest]"]),
    "share": (("[0.1, 0.5]", "[-0.1, 0.5]"), ["ground.cover.value is [-0.1, 0.5]", "from 0 to 1"]),
    "light soil": (
        (SOIL, SOIL.replace("[0.4, 0.5], grade", "[0.4, 1.5], grade")),
        ["ground.soil_light.value[1] is 1.5", "<= 1"],
    ),
    "unit": (('unit = "1"', 'unit = "%"'), ["ground.cover.unit is '%'", "give the value in '1'"]),
    "key": (("cover =", "cver ="), ["ground.cver is not a field", "did you mean 'cover'?"]),
    "grade": (('"GUESSED"', '"SEEN"'), ["'SEEN'", "DERIVED, FITTED, GUESSED, READ"]),
    "table": (("[ground]", "[soil]"), ["soil is not a field"]),
}


@pytest.mark.parametrize("error", ERRORS)
def test_an_error_is_one_line_with_file_place_and_remedy(error, tmp_path):
    (old, new), expected = ERRORS[error]
    assert old in GOOD
    file = tmp_path / "mine.toml"
    file.write_text(GOOD)
    assert draw(str(file), 1).leaf != DEFAULT.leaf
    file.write_text(GOOD.replace(old, new))
    with pytest.raises(DataError) as caught:
        load_palette(str(file))
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(f"{file}: ")
    assert [e for e in expected if e not in text] == [], text


def test_an_unknown_palette_is_refused_with_the_known_ones():
    with pytest.raises(SceneError, match=r"no palette 'moon'.*any, default, autumn, blue-leaf, chalk"):
        with_palette(load_scene("vsp"), "moon")


def test_a_scene_file_names_its_palette_and_a_wrong_one_is_an_error_of_the_scene(tmp_path):
    text = find_data_file("scenes", "vsp", ".toml").read_text()
    file = tmp_path / "mine.toml"
    file.write_text(text + '\n[palette]\nname = "slate"\nseed = 4\n')
    assert palette.resolve(load_scene(file)) == draw("slate", 4)
    file.write_text(text + '\n[palette]\nname = "slat"\n')
    with pytest.raises(SceneError) as caught:
        load_scene(file)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(f"{file}: palette.name is 'slat'; no palette 'slat'; give")
    file.write_text(text + "\n[palette]\nseed = -1\n")
    with pytest.raises(SceneError, match=r"palette.seed is -1; give a whole number >= 0"):
        load_scene(file)


def test_every_colour_of_the_default_palette_is_a_reflectance():
    for part in PARTS[:3]:
        for name, value in msgspec.structs.asdict(getattr(DEFAULT, part)).items():
            if isinstance(value, tuple) and name != "through":
                assert all(0.0 <= c <= 1.0 for c in value), name
