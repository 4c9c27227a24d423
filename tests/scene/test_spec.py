"""Scene files: shipped ones load, and each kind of error is one line with file, place and remedy."""

import math
import pathlib
import time

import pytest
from PIL import Image

from vinesim.core.data_files import data_dir
from vinesim.scene import spec
from vinesim.scene.spec import Sun, sun_direction

GOOD = """
name = "small"
seed = 1
training = "tendone"

[layout]
rows = 1
vines = 2
row_spacing = 2.5
vine_spacing = 2.5
height = 2.0

[fruit]
bunches = [2, 4]
varieties = ["italia"]

[[boxes]]
x = 1.0
y = 1.0

[[spawns]]
name = "here"
x = 0.0
y = 1.0
"""


@pytest.mark.parametrize("path", sorted((data_dir() / "scenes").glob("*.toml")), ids=lambda p: p.stem)
def test_every_shipped_scene_loads_by_its_name(path):
    assert spec.load_scene(path.stem).name == path.stem


def test_defaults_and_values(tmp_path):
    file = tmp_path / "small.toml"
    file.write_text(GOOD)
    small = spec.load_scene(file)
    assert (small.layout.row_spacing, small.fruit.bunches, small.boxes[0].size[0]) == (2.5, (2, 4), 0.6)
    assert math.isclose(math.hypot(*small.sun.direction()), 1.0)
    assert small.spawns[0] == spec.Spawn(name="here", x=0.0, y=1.0, yaw=0.0)


MANY = "".join(f'\n[[spawns]]\nname = "r{i}"\nx = {i}.0\ny = 0.0\n' for i in range(10))
ERRORS = {
    "unknown field": (("row_spacing", "row_spacng"), ["layout.row_spacng", "did you mean 'row_spacing'?"]),
    "unknown table": (("[fruit]", "[friut]"), ["friut", "did you mean 'fruit'?"]),
    "unknown in a list": (('name = "here"\nx', 'name = "here"\nhight = 2\nx'), ["spawns[0].hight", "remove it"]),
    "wrong type": (("rows = 1", 'rows = "one"'), ["layout.rows", "'one'", "give a whole number"]),
    "fraction": (("rows = 1", "rows = 1.5"), ["layout.rows", "1.5", "give a whole number"]),
    "negative": (("height = 2.0", "height = -2.0"), ["layout.height", "-2.0", "give a number > 0"]),
    "zero": (("height = 2.0", "height = 0"), ["layout.height is 0", "give a number > 0"]),
    "nothing planted": (("vines = 2", "vines = 0"), ["layout.vines is 0", "give a whole number >= 1"]),
    "nan": (("height = 2.0", "height = nan"), ["layout.height is nan", "finite"]),
    "infinite": (("x = 0.0", "x = inf"), ["spawns[0].x is inf", "finite"]),
    "missing": (("rows = 1\n", ""), ["layout.rows is missing", "rows = ..."]),
    "missing table": (('[fruit]\nbunches = [2, 4]\nvarieties = ["italia"]', ""), ["fruit is missing", "add it"]),
    "syntax": (("vines = 2", "vines = = 2"), ["line 8", "correct the syntax"]),
    "choice": (('"tendone"', '"pergola"'), ["training is 'pergola'", "give one of: tendone, vsp"]),
    "variety": (
        ('["italia"]', '["malbec"]'),
        ["fruit.varieties[0] is 'malbec'", "italia, redglobe, black, chardonnay"],
    ),
    "ripeness falls": (("[2, 4]", "[2, 4]\nripeness = [0.8, 0.2]"), ["fruit.ripeness is [0.8, 0.2]", "rising"]),
    "ripeness above 1": (("[2, 4]", "[2, 4]\nripeness = [0.8, 1.2]"), ["fruit.ripeness", "1.2", "<= 1"]),
    "rot below 0": (("[2, 4]", "[2, 4]\nrot = -0.1"), ["fruit.rot is -0.1", ">= 0"]),
    "sunburn as a word": (("[2, 4]", "[2, 4]\nsunburn = 'much'"), ["fruit.sunburn is 'much'", "number"]),
    "no variety": (('["italia"]', "[]"), ["fruit.varieties is []", "length >= 1"]),
    "range": (("[2, 4]", "[4, 2]"), ["fruit.bunches is [4, 2]", "fewest <= most"]),
    "range of three": (("[2, 4]", "[2, 3, 4]"), ["fruit.bunches is [2, 3, 4]", "length 2"]),
    "too many robots": (
        ('[[spawns]]\nname = "here"', MANY + '\n[[spawns]]\nname = "here"'),
        ["spawns has 11", "at most 10"],
    ),
    "same name twice": (
        ('[[spawns]]\nname = "here"', '[[spawns]]\nname = "here"\nx = 1\ny = 1\n[[spawns]]\nname = "here"'),
        ["spawns[1].name is 'here'", "spawns[0].name", "own name"],
    ),
    "no such plants": (("[layout]", 'plants = "oak"\n[layout]'), ["plants", "'oak'", "vine"]),
}


@pytest.mark.parametrize("error", ERRORS)
def test_an_error_is_one_line_with_file_place_and_remedy(error, tmp_path):
    (old, new), expected = ERRORS[error]
    assert old in GOOD
    file = tmp_path / "broken.toml"
    file.write_text(GOOD.replace(old, new))
    with pytest.raises(spec.SceneError) as caught:
        spec.load_scene(file)
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(f"{file}: ")
    assert [e for e in expected if e not in text] == [], text


ABSURD = {
    "name of another folder": (('"small"', '"../../x"'), ["name is '../../x'", "letters"]),
    "hidden name": (('"small"', '".small"'), ["name is", "letters"]),
    "long name": (('"small"', f'"{"x" * 300}"'), ["name is", "48"]),
    "rows": (("rows = 1", "rows = 1_000_000_000"), ["layout.rows is 1000000000", "1 to 10000"]),
    "vines": (("rows = 1\nvines = 2", "rows = 9000\nvines = 9000"), ["9000 x 9000", "10000 vines"]),
    "spacing": (("row_spacing = 2.5", "row_spacing = 1e8"), ["layout.row_spacing", "100 m"]),
    "extent": (("vines = 2", "vines = 9999"), ["layout.vines reach 24997.5 m", "10000 m"]),
    "height": (("height = 2.0", "height = 1e300"), ["layout.height is 1e+300", "10 m"]),
    "place": (("x = 1.0", "x = -1e300"), ["boxes[0].x is -1e+300", "10000 m"]),
    "mass": (("y = 1.0", "y = 1.0\nmass = 1e300"), ["boxes[0].mass is 1e+300", "kg"]),
    "bunches": (("[2, 4]", "[2, 4000]"), ["fruit.bunches[1] is 4000", "0 to 1000"]),
    "many bunches": (("vines = 2", "vines = 3000"), ["fruit.bunches is [2, 40]", "at most 33 on a vine"]),
    "digits": (("seed = 1", f"seed = {'9' * 5000}"), ["not valid TOML", "digits"]),
    "bits": (("seed = 1", f"seed = 0x{'f' * 5000}"), ["seed has more than 64 bits"]),
    "step": (("[fruit]", "[physics]\ndt = 1e300\n[fruit]"), ["physics.dt is 1e+300", "0.1 s"]),
    "lists": (("seed = 1", f"seed = {'[' * 20_000}{']' * 20_000}"), ["more than 50 deep"]),
    "tables": (("seed = 1", f"seed = {'{a=' * 20_000}1{'}' * 20_000}"), ["more than 50 deep"]),
    "dotted key": (("[fruit]", f"[{'a.' * 20_000}a]\n[fruit]"), ["more than 50 deep"]),
    "long list": (("height = 2.0", f"height = [{'1,' * 10_000}]"), ["layout.height is [1, 1", "give a number"]),
    "large file": (("[fruit]", f"#{'x' * (4 << 20)}\n[fruit]"), ["more than 4 MiB"]),
    "path": (("[layout]", f'plants = "{"x" * 300}"\n[layout]'), ["plants is", "no file"]),
}


@pytest.mark.parametrize("error", ABSURD)
def test_an_absurd_scene_is_one_line_before_memory_or_time_is_spent(error, tmp_path):
    (old, new), parts = ABSURD[error]
    file = tmp_path / "bad.toml"
    text = GOOD.replace("[2, 4]", "[2, 40]") if error == "many bunches" else GOOD
    assert old in text
    file.write_text(text.replace(old, new, 1))
    begin = time.process_time()
    with pytest.raises(spec.SceneError) as caught:
        spec.load_scene(file)
    assert time.process_time() - begin < 1.0
    line = str(caught.value)
    assert line.startswith(f"{file}: ")
    assert "\n" not in line
    assert len(line) <= 1000
    for part in parts:
        assert part in line


def test_an_image_of_heights_that_unpacks_to_gigabytes_is_refused(tmp_path):
    """80 million pixels are 80 kB as a PNG."""
    Image.new("L", (20_000, 4_000)).save(tmp_path / "heights.png")
    file = tmp_path / "bad.toml"
    file.write_text(GOOD + '\n[terrain]\nimage = "heights.png"\n')
    with pytest.raises(spec.SceneError, match="20000 x 4000 pixels; give at most 4000000"):
        spec.load_scene(file)


def test_an_unknown_scene_is_refused_with_the_shipped_ones():
    with pytest.raises(spec.SceneError, match=r"'vineyard'.*cordon, demo, harvest, slope, tendone, vsp"):
        spec.load_scene("vineyard")


def test_a_binary_file_is_not_a_scene(tmp_path):
    binary = pathlib.Path(tmp_path / "x.toml")
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(spec.SceneError, match="UTF-8"):
        spec.load_scene(binary)


def test_sun_direction_at_the_equinox() -> None:
    """South at noon at 90 degrees less the latitude; west at six in the evening, on the horizon."""
    latitude = math.radians(41.6)
    assert sun_direction(12.0, 0.0, latitude) == pytest.approx(
        [0.0, -math.sin(latitude), math.cos(latitude)], abs=1e-12
    )
    assert sun_direction(18.0, 0.0, latitude) == pytest.approx([-1.0, 0.0, 0.0], abs=1e-12)
    assert math.hypot(*sun_direction(15.3, 0.2, latitude)) == pytest.approx(1.0)


def test_the_sun_moves_with_the_hour() -> None:
    """From nine in the morning to noon in three hours; day 80 is the equinox within the half degree of the formula."""
    sun = Sun(hour=9.0, day=80, latitude=0.7)
    east, north, up = sun.direction(3 * 3600.0)
    assert (east, north) == pytest.approx((0.0, -math.sin(0.7)), abs=0.01)
    assert sun.direction(0.0)[0] > 0.6
    assert sun.direction(0.0)[2] < up
    fixed = Sun(azimuth=0.3, elevation=0.4)
    assert fixed.direction(0.0) == fixed.direction(9000.0)
