"""Mixes: the law of draws, values that are refused in one line, and views, light and vineyards as the mix says."""

import dataclasses
import json
import pathlib
import re
from collections import Counter

import msgspec
import numpy as np
import pytest

from vinesim.core import frames
from vinesim.core.data_files import data_dir
from vinesim.scene.camera_geometry import project_points
from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.ids import LABEL_STRIDE, Organ
from vinesim.scene.spec import Scene, sun_direction
from vinesim.scene.values import CameraInfo
from vinesim.sensors import ground_truth
from vinesim.sensors.export import dataset, views
from vinesim.sensors.export.dataset import DatasetPlan, VineyardRenderer
from vinesim.sensors.export.mix import LATITUDE, MixError, SunTable, draw_sun, load_mix
from vinesim.sensors.export.views import BUNCHES_PER_DRAW, ViewFinder
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot

MIX = """
{scenes}
[sun]
elevation = [0.1, 1.0]

[[cameras]]
camera = "pinhole"

[[views]]
name = "row"
distance = [0.5, 2.0]
bunch_height = [0.08, 0.15, 0.4]
pitch = [-0.14, 0.35]
turn = [-0.4, 0.4]
across = [-0.3, 0.3]
down = [-0.3, 0.3]
camera_height = [0.2, 2.5]
{rest}
"""
SMALL = CameraInfo(64, 48, 50.0, 50.0, 31.5, 23.5, "optical")


def _write(folder: pathlib.Path, rest: str = "", scenes: str = '[[scenes]]\nscene = "cordon"\n') -> pathlib.Path:
    file = folder / "mine.toml"
    file.write_text(MIX.format(scenes=scenes, rest=rest))
    return file


def _vineyards(file: pathlib.Path, count: int = 2000) -> list[tuple[Scene, dict]]:
    mix = load_mix(file)
    return [mix.vineyard(np.random.default_rng([1, number])) for number in range(count)]


# ---- the law of draws ------------------------------------------------------------------------------------------------


def test_rising_numbers_are_equally_likely_steps(tmp_path: pathlib.Path) -> None:
    """Shares of steps within four standard deviations of a binomial distribution."""
    file = _write(tmp_path, '[vary]\n"season.leafiness" = [0.5, 0.6, 1.0]\n"layout.rows" = [1, 3]\n')
    made = _vineyards(file)
    leafiness = np.array([scene.season.leafiness for scene, _ in made])
    assert leafiness.min() >= 0.5
    assert leafiness.max() <= 1.0
    for low, high, share in ((0.5, 0.6, 0.5), (0.6, 1.0, 0.5), (0.6, 0.8, 0.25)):
        assert ((leafiness > low) & (leafiness <= high)).mean() == pytest.approx(
            share, abs=4.0 * 0.5 / len(made) ** 0.5
        )
    rows = Counter(scene.layout.rows for scene, _ in made)
    assert set(rows) == {1, 2, 3}
    assert all(count / len(made) == pytest.approx(1.0 / 3.0, abs=0.045) for count in rows.values())
    for scene, drawn in made[:10]:
        assert drawn == {"season.leafiness": scene.season.leafiness, "layout.rows": scene.layout.rows}


def test_choices_have_their_weights(tmp_path: pathlib.Path) -> None:
    """Of an order by weights, the first is as likely as its weight (Efraimidis and Spirakis 2006)."""
    rest = '[vary]\n"plants" = ["vine"]\n"fruit.bunches" = [[4, 6], [10, 12]]\n"season.yellow" = 0.25\n'
    rest += '"fruit.varieties" = { black = 3, italia = 1, redglobe = 0 }\n'
    made = [scene for scene, _ in _vineyards(_write(tmp_path, rest))]
    assert {scene.season.yellow for scene in made} == {0.25}
    bunches = Counter(scene.fruit.bunches for scene in made)
    assert set(bunches) == {(4, 6), (10, 12)}
    assert bunches[4, 6] / len(made) == pytest.approx(0.5, abs=0.045)
    orders = Counter(scene.fruit.varieties for scene in made)
    assert set(orders) == {("black", "italia"), ("italia", "black")}
    assert orders["black", "italia"] / len(made) == pytest.approx(0.75, abs=0.04)


def test_scenes_have_their_weights_and_values_of_their_own(tmp_path: pathlib.Path) -> None:
    scenes = '[[scenes]]\nscene = "cordon"\nweight = 3\nvary = { "season.yellow" = 0.5 }\n[[scenes]]\nscene = "vsp"\n'
    made = [scene for scene, _ in _vineyards(_write(tmp_path, '[vary]\n"season.yellow" = 0.1\n', scenes))]
    assert {(scene.name, scene.season.yellow) for scene in made} == {("cordon", 0.5), ("vsp", 0.1)}
    assert np.mean([scene.name == "cordon" for scene in made]) == pytest.approx(0.75, abs=0.04)
    assert len({scene.seed for scene in made}) == len(made)


def test_a_scene_or_camera_given_beside_a_mix_replaces_those_of_the_mix(tmp_path: pathlib.Path) -> None:
    mix = load_mix("default", "cordon", "d435")
    names = {mix.vineyard(np.random.default_rng(number))[0].name for number in range(20)}
    assert names == {"cordon"}
    assert [one.camera for one in mix.table.cameras] == ["d435"]
    own = next(one.vary for one in load_mix("default").table.scenes if one.scene == "cordon")
    assert mix.table.scenes[0].vary == own
    (tmp_path / "own.toml").write_text((data_dir() / "scenes/vsp.toml").read_text().replace('"vsp"', '"own"', 1))
    file = _write(tmp_path, scenes='[[scenes]]\nscene = "own.toml"\n')  # beside the mix
    assert load_mix(file).scenes[0].name == "own"


# ---- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("", '[vary]\n"season.leafines" = 0.5\n'), r'vary\."season\.leafines": .*did you mean .leafiness.'),
        (("", '[vary]\n"seasons.yellow" = 0.5\n'), r'vary\."seasons\.yellow": .*did you mean .season.'),
        (("", '[vary]\n"season.yellow" = [0.1, 1.4]\n'), r"in scene 'cordon': season\.yellow is 1\.4; give .*<= 1"),
        (("", '[vary]\n"season.yellow" = [0.4, 0.1]\n'), r'vary\."season\.yellow" is \[0\.4, 0\.1\]; give rising'),
        (("", '[vary]\n"season.yellow" = []\n'), r'"season\.yellow" is \[\]; give a value, a range or choices'),
        (("", '[vary]\n"season.yellow" = "much"\n'), r"season\.yellow is 'much'; give a number"),
        (("", '[vary]\n"training" = ["vsp", "pergola"]\n'), r"training is 'pergola'; give one of: tendone, vsp"),
        (
            ("", '[vary]\n"fruit.varieties" = { merlo = 1 }\n'),
            r"fruit\.varieties\[0\] is 'merlo'; give one of: .*italia",
        ),
        (("", '[vary]\n"fruit.varieties" = { italia = -1 }\n'), r"weights of 0 or more, one of them above 0"),
        (("", '[vary]\n"fruit.bunches" = [[9, 4]]\n'), r"fruit\.bunches is \[9, 4\]; give \[fewest, most\]"),
        (("", "[sequence]\nrate = 0.0\n"), r"sequence\.rate is 0\.0; give a number > 0"),
        (("", "[sequences]\n"), r"sequences is not a field; did you mean .sequence."),
        (('"pinhole"', '"kinect"'), r"cameras\[0\]\.camera is 'kinect'; .*one of: d435"),
        (('"cordon"', '"moon"'), r"scenes\[0\]\.scene is 'moon'; .*one of: cordon"),
        (("distance = [0.5, 2.0]", "distance = [2.0, 0.5]"), r"views\[0\]\.distance is \[2\.0, 0\.5\]; give rising"),
        (("distance = [0.5, 2.0]", "distance = 0.0"), r"views\[0\]\.distance is 0\.0; give numbers from 0\.1 to 20"),
        (("distance = [0.5, 2.0]\n", ""), r"views\[0\]\.distance is missing; add it"),
        (("pitch = [-0.14, 0.35]", "pitch = 90"), r"views\[0\]\.pitch is 90\.0; give numbers from -1\.5 to 1\.5"),
        (
            ("elevation = [0.1, 1.0]", "elevation = [-0.2, 1.0]"),
            r"sun\.elevation is \[-0\.2, 1\.0\]; give .* 0 to 1\.57",
        ),
        (
            ('scene = "cordon"', 'scene = "cordon"\nweight = 0'),
            r"scenes have no weight above 0; give one of them a weight",
        ),
        (('scene = "cordon"', 'scene = "cordon"\nweight = -1'), r"scenes\[0\]\.weight is -1; give a number >= 0"),
        (('name = "row"', 'name = "row"\nbunches = 0'), r"views\[0\]\.bunches is 0; give a whole number >= 1"),
    ],
)
def test_impossible_values_are_refused_in_one_line(tmp_path: pathlib.Path, change: tuple[str, str], words: str) -> None:
    """The line names the file, the field, the value and the remedy."""
    file = _write(tmp_path)
    old, new = change
    file.write_text(file.read_text().replace(old, new, 1) if old else file.read_text() + new)
    with pytest.raises(MixError) as said:
        load_mix(file)
    assert re.search(words, str(said.value)), str(said.value)
    assert str(said.value).startswith(str(file))
    assert "\n" not in str(said.value)


def test_an_unknown_mix_lists_the_shipped_ones() -> None:
    with pytest.raises(MixError, match=r"no file 'moon'.*data/mixes; give a path or one of: around, default"):
        load_mix("moon")


# ---- shipped mixes ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(path.stem for path in (data_dir() / "mixes").glob("*.toml")))
def test_a_thousand_pictures_of_a_shipped_mix_come_from_a_hundred_vineyards(name: str) -> None:
    plan = DatasetPlan(load_mix(name), 1)
    count = len({image // plan.images_per_vineyard for image in range(1000)})
    made = [plan.mix.vineyard(np.random.default_rng([1, 1, number])) for number in range(count)]
    assert len({msgspec.json.encode(scene) for scene, _ in made}) == count >= 100
    for field, values in plan.mix.table.vary.items():
        is_constant = not isinstance(values, list | dict)
        assert (len({str(drawn[field]) for _, drawn in made}) == 1) == is_constant


# ---- light -----------------------------------------------------------------------------------------------------------


def test_the_sun_has_the_drawn_elevation_on_its_path() -> None:
    rng = np.random.default_rng(4)
    elevations = []
    for _ in range(400):
        bearing = rng.uniform(-np.pi, np.pi)
        sun = draw_sun(rng, SunTable(elevation=(0.1, 0.4, 0.7)), bearing)
        elevations.append(sun["elevation"])
        c, s = np.cos(bearing), np.sin(bearing)
        x, y, z = sun["direction"]
        east, north = c * x - s * y, s * x + c * y
        assert np.arcsin(z) == pytest.approx(sun["elevation"])
        # the declination that the elevation and the azimuth tell gives the same sun at that hour
        sine = np.sin(LATITUDE) * z + np.cos(LATITUDE) * north
        assert sun_direction(sun["hour"], float(np.arcsin(sine)), float(LATITUDE)) == pytest.approx((east, north, z))
    assert np.quantile(elevations, [0.0, 0.5, 1.0]) == pytest.approx([0.1, 0.4, 0.7], abs=0.04)
    noon = [draw_sun(rng, SunTable(elevation=1.5), 0.0) for _ in range(20)]
    assert all(one["hour"] == pytest.approx(12.0) for one in noon)  # it never stands so high


# ---- views -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finder() -> ViewFinder:
    scene = load_mix("default", "cordon").scenes[0]
    model = generate_uncached(scene)
    return ViewFinder(scene.name, Primitives(model, grass=0.0), rest_snapshot(model))


@pytest.mark.slow
def test_views_are_as_the_mix_says(finder: ViewFinder, tmp_path: pathlib.Path) -> None:
    """Pose and picture agree with the drawn values, which are within the mix's limits and distributed as it says."""
    entry = load_mix(_write(tmp_path)).table.views[0]
    rng = np.random.default_rng(3)
    model = finder.primitives.model
    found = []
    for _ in range(120):
        seen, values = finder.of_bunch(rng, entry, SMALL, [])
        found.append(values)
        body = finder.snapshot.body_q[model.bunch_body[values["bunch"]]].astype(float)
        length = float(model.bunch_length[values["bunch"]])
        ends = body[:3] + frames.rotate(body[3:], np.array([[0.0, 0.0, 0.0], [length, 0.0, 0.0]]))
        middle = ends.mean(0)
        forward = frames.rotate(seen.pose[3:], np.array([0.0, 0.0, 1.0]))
        assert np.arcsin(forward[2]) == pytest.approx(values["pitch"], abs=1e-6)
        assert -values["side"] * forward[1] == pytest.approx(np.cos(values["turn"]) * np.hypot(*forward[:2]), abs=1e-6)
        assert np.linalg.norm(middle - seen.pose[:3]) == pytest.approx(values["distance"], rel=1e-6)
        local = frames.rotate(frames.conjugate(seen.pose[3:]), middle - seen.pose[:3])
        pixel = (project_points(local, SMALL) + 0.5) / [SMALL.width, SMALL.height] - 0.5
        assert pixel == pytest.approx([values["across"], values["down"]], abs=1e-5)
        assert length * SMALL.fy / local[2] / SMALL.height == pytest.approx(values["bunch_height"], rel=1e-5)
        assert 0.5 <= values["distance"] <= 2.0
        assert 0.2 <= seen.pose[2] <= 2.5
    for name in ("pitch", "turn", "across", "down", "bunch_height"):
        drawn = np.array([one[name] for one in found])
        steps = np.asarray(getattr(entry, name))
        assert steps[0] <= drawn.min() <= drawn.max() <= steps[-1]
        if name in ("pitch", "turn"):  # places and sizes at which nothing is hidden are more likely
            share = np.interp(drawn, steps, np.linspace(0.0, 1.0, len(steps)))
            assert np.quantile(share, [0.25, 0.5, 0.75]) == pytest.approx([0.25, 0.5, 0.75], abs=0.17)
    assert BUNCHES_PER_DRAW > 1


@pytest.mark.slow
def test_pictures_without_bunches_show_their_subjects(finder: ViewFinder) -> None:
    entry = load_mix("default").table.views[0]
    rng = np.random.default_rng(4)
    subjects = set()
    for _ in range(24):
        seen, values = finder.without_bunches(rng, entry, SMALL)
        organs = seen.labels // LABEL_STRIDE
        assert not (organs == Organ.BUNCH).any()
        assert ((organs >= Organ.TRUNK) & (organs <= Organ.LEAF)).mean() >= views.MIN_PLANT_SHARE
        least, most = views.SUBJECT_PITCH.get(values["subject"], (-1.2, 0.3))
        assert least <= values["pitch"] <= most
        subjects.add(values["subject"])
    assert subjects == set(views.SUBJECTS)


@pytest.mark.slow
def test_views_after_the_harvest_are_those_of_bunches_but_for_the_bunches(finder: ViewFinder) -> None:
    entry = load_mix("default").table.views[0]
    rng = np.random.default_rng(5)
    before = finder.snapshot
    picked = dataclasses.replace(before, bunch_attached=np.zeros_like(before.bunch_attached))
    later = dataclasses.replace(finder, snapshot=picked)
    shown = []
    for _ in range(12):
        finder.primitives.update(picked)
        found = later.of_picked(rng, entry, SMALL, before.bunch_attached)
        finder.primitives.update(before)
        assert found is not None
        seen, values = found
        assert values["subject"] == "picked"
        assert not (seen.labels // LABEL_STRIDE == Organ.BUNCH).any()
        same = ground_truth.render_buffers(finder.primitives, SMALL, seen.pose)
        is_bunch = same.labels // LABEL_STRIDE == Organ.BUNCH
        assert (seen.depth[is_bunch] >= same.depth[is_bunch]).all()
        assert np.array_equal(seen.labels[~is_bunch], same.labels[~is_bunch])
        shown.append(is_bunch.any())
    assert np.mean(shown) > 0.7


@pytest.mark.slow
def test_records_hold_the_draws_and_files_repeat(tmp_path: pathlib.Path) -> None:
    mix = load_mix("default", "cordon")
    plan = DatasetPlan(mix, 5, (96, 72))
    for folder in ("one", "two"):
        dataset.prepare_folder(plan, tmp_path / folder, 2)
        list(dataset.render_images(plan, tmp_path / folder, [0, 1]))
    files = {path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file()}
    assert all((tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes() for name in files)
    scene = VineyardRenderer(plan, 0).scene
    views = {one.name: one for one in mix.table.views}
    for image in range(2):
        record = json.loads((tmp_path / f"one/records/{image:06d}.json").read_text())
        drawn = record["scene"]["drawn"]
        assert drawn.keys() == mix.table.vary.keys() | mix.table.scenes[0].vary.keys()
        assert drawn["season.fruit_zone_leafiness"] == scene.season.fruit_zone_leafiness
        assert drawn["layout.rows"] == scene.layout.rows
        view = record["view"]
        assert view["camera"] in {one.camera for one in mix.table.cameras}
        limits = np.asarray(views[view["name"]].distance)
        assert limits[0] <= view["distance"] <= limits[-1]
        assert record["sun"]["elevation"] == pytest.approx(np.arcsin(record["sun"]["direction"][2]))
    told = json.loads((tmp_path / "one/dataset.json").read_text())
    assert told["mix"]["scene_files"][0]["name"] == "cordon"
    other = DatasetPlan(load_mix("around", "cordon"), 5, (96, 72))
    with pytest.raises(dataset.DatasetError, match="begun with mix another one, not this one; go on as it was begun"):
        dataset.prepare_folder(other, tmp_path / "one", 2)
