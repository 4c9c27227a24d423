"""The year of a vine: published dates, growth without jumps, and a clear line for dates and climates without curves."""

import datetime
import itertools

import msgspec
import numpy as np
import pytest

from vinesim.scene import season
from vinesim.scene import spec as scenes
from vinesim.scene.generation.vineyard import generate_uncached
from vinesim.scene.state import State
from vinesim.scene.summary import total_leaf_area

CURVES = season.load_season()
LATINA = CURVES.climate.temperatures.value
CALENDAR = season.calendar_of(CURVES, LATINA)
SMALL = scenes.Layout(rows=1, vines=2, row_spacing=2.6, vine_spacing=2.0, height=0.85)


def on(month: int, day: int, **changes: object) -> scenes.Scene:
    scene = scenes.load_scene("vsp")
    return msgspec.structs.replace(scene, layout=SMALL, date=datetime.date(2026, month, day), **changes)


def test_flowering_and_veraison_follow_the_sum_of_temperatures() -> None:
    """In a climate of 20 degC all year the sums are reached after sum / 20 days from 1 March."""
    steady = (20.0,) * 12
    found = season.calendar_of(CURVES, steady)
    np.testing.assert_allclose(found.flowering, 60 + 1270.0 / 20.0, atol=1e-9)
    np.testing.assert_allclose(found.veraison, 60 + 2641.0 / 20.0, atol=1e-9)
    np.testing.assert_allclose(found.flowering - found.budburst, 46.8)
    np.testing.assert_allclose(found.maturity - found.veraison, 54.6)


def test_the_dates_of_latium() -> None:
    """Budburst in the first half of April, flowering at the end of May, veraison in July, harvest of table grapes in the
    middle of September."""
    dates = [CALENDAR.budburst, CALENDAR.flowering, CALENDAR.veraison, CALENDAR.maturity]
    for day, (first, last) in zip(dates, ((91, 106), (141, 152), (182, 213), (250, 265)), strict=True):
        assert first <= day <= last


def test_a_berry_grows_in_two_phases() -> None:
    days = np.arange(CALENDAR.flowering + 4.0, CALENDAR.maturity)
    mass = np.array([season.berry_mass(CURVES, CALENDAR, day) for day in days])
    assert (np.diff(mass) > 0.0).all()
    assert season.berry_mass(CURVES, CALENDAR, CALENDAR.maturity) == pytest.approx(1.0)
    rate = np.gradient(mass, days)
    peaks = np.flatnonzero((rate[1:-1] > rate[:-2]) & (rate[1:-1] > rate[2:])) + 1
    assert len(peaks) == 2
    lag = days[peaks[0] + np.argmin(rate[peaks[0] : peaks[1]])]
    assert CALENDAR.flowering + 45.0 <= lag <= CALENDAR.veraison + 5.0
    slow, fast = (np.interp(day, days, rate) for day in (lag, CALENDAR.veraison + 27.3))
    assert fast > 2.0 * slow


def test_the_diameter_of_a_berry_follows_from_mass_and_density() -> None:
    assert season.berry_size(CURVES, 1.0) == pytest.approx(1.0)
    green, ripe = CURVES.berry.density.value
    assert season.berry_size(CURVES, 0.25) ** 3 * green == pytest.approx(0.25 * ripe)


def test_leaves_unfold_at_a_constant_sum_of_temperatures() -> None:
    steady = (15.0,) * 12  # 5 degC above the base temperature: a leaf every 5 days
    number = [season.unfolded_leaves(CURVES, steady, 100.0, day) for day in (104.0, 109.0, 114.0)]
    np.testing.assert_allclose(np.diff(number), 1.0, atol=1e-12)


def test_the_forms_of_a_year_follow_each_other() -> None:
    """Nothing shrinks before autumn, and no day is missing."""
    start = datetime.date(2026, 1, 1)
    states = [season.state_on(start + datetime.timedelta(k), None, (1.22, 22.5)) for k in range(365)]
    forms = [state.form for state in states]
    order = [form for form, _ in itertools.groupby(forms)]
    assert order == ["dormant", "bursting", "growing", "dormant"]
    growing = [state for state in states if state.form == "growing"]
    for name in ("unfolded", "woody", "yellow"):
        assert (np.diff([getattr(state, name) for state in growing]) >= 0.0).all(), name
    assert growing[-1].shown < 0.05
    fruit = [state.day for state in states if state.berry_mass > 0.0]
    assert fruit == list(range(fruit[0], fruit[-1] + 1))
    assert fruit[0] == np.ceil(CALENDAR.flowering + 4.0)


def test_a_leap_day_is_a_day_of_the_year() -> None:
    assert season.day_of_year(datetime.date(2028, 2, 29)) == 60
    assert season.day_of_year(datetime.date(2028, 12, 31)) == 365


@pytest.mark.slow
def test_vines_grow_from_spring_to_harvest() -> None:
    """Lengths, leaf areas and fruit of the generated models follow the curves."""
    models = [generate_uncached(on(*date)) for date in ((5, 5), (5, 25), (6, 20), (7, 25), (9, 15))]
    lengths = [_main_lengths(model).mean() for model in models]
    areas = [total_leaf_area(model) for model in models]
    fruit = [model.body_mass[model.bunch_body].sum() for model in models]
    assert (np.diff(lengths) >= -1e-6).all()
    assert lengths[0] < 0.4 < 1.1 < lengths[-1]
    assert (np.diff(areas) > -1e-6).all()
    assert fruit[0] == fruit[1] == 0.0
    state = scenes.season_of(on(6, 20))
    assert state is not None
    assert fruit[2] / fruit[4] == pytest.approx(state.berry_mass, rel=1e-3)
    sizes = [model.bunch_radius.mean() for model in models[2:]]
    assert sizes[0] / sizes[2] == pytest.approx(state.berry_size, rel=1e-3)
    for model in models:
        moved = State.at_rest(model).body_q[:, :3] - model.forward_kinematics(model.joint_settled)[:, :3]
        assert np.abs(moved).max() < 1e-4


def _main_lengths(model: object) -> np.ndarray:
    first = model.tree_first  # pyright: ignore[reportAttributeAccessIssue]
    return np.array([model.body_length[k : k + 14].sum() for k in first])  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.slow
def test_a_shoot_keeps_its_path() -> None:
    """On every date a shoot ends on the path that it has at harvest."""
    young, old = (generate_uncached(on(*date)) for date in ((5, 20), (9, 15)))
    q, final = (State.at_rest(model).body_q[:, :3].astype(float) for model in (young, old))
    for tree in range(0, len(young.tree_first), 5):
        path = final[old.tree_first[tree] : old.tree_first[tree] + 14]
        for point in q[young.tree_first[tree] : young.tree_first[tree] + 14]:
            ahead = np.diff(path, axis=0)
            share = np.clip(((point - path[:-1]) * ahead).sum(1) / (ahead * ahead).sum(1), 0.0, 1.0)
            gap = np.linalg.norm(point - path[:-1] - share[:, None] * ahead, axis=1).min()
            assert gap < 1e-4


@pytest.mark.slow
def test_berries_turn_at_veraison() -> None:
    ripeness = [generate_uncached(on(*date)).look.fruit.ripeness for date in ((7, 1), (7, 22), (8, 20))]
    assert ripeness[0] == (0.0, 0.0)
    low, high = ripeness[1]
    assert low < 0.5 < high
    assert ripeness[2] == (1.0, 1.0)


@pytest.mark.slow
def test_without_a_date_a_year_changes_nothing() -> None:
    scene = msgspec.structs.replace(scenes.load_scene("vsp"), layout=SMALL)
    assert scenes.on_its_date(scene) is scene
    model = generate_uncached(scene)
    assert len(model.nodes.body) == len(model.canes.body) == 0


BAD = {
    "south": ({"datum": scenes.Datum(latitude=-33.0)}, ["datum.latitude is -33.0", "remove date"]),
    "cold": ({"season": scenes.Season(temperatures=(5.0,) * 12)}, ["date is 2026-06-15", "flowering", "warmer months"]),
    "hot": ({"season": scenes.Season(temperatures=(32.0,) * 12)}, ["date is 2026-06-15", "cooler months"]),
    "no cordon": ({"training": "tendone", "pruning": "cane"}, ["pruning", "tendone", 'pruning = "spur"']),
    "no date": ({"date": None, "pruning": "cane"}, ["pruning is given without date"]),
    "temperatures": ({"date": None, "season": scenes.Season(temperatures=(9.0,) * 12)}, ["season.temperatures"]),
}


@pytest.mark.parametrize("name", BAD)
def test_a_scene_without_curves_is_refused_with_one_line(name: str) -> None:
    changes, words = BAD[name]
    scene = msgspec.structs.replace(on(6, 15), **changes)
    with pytest.raises(scenes.SceneError) as refused:
        scenes.check_scene(scene, "vineyard.toml")
    text = str(refused.value)
    assert text.startswith("vineyard.toml: ")
    assert "\n" not in text
    for word in words:
        assert word in text


@pytest.mark.parametrize("date", ['"2026-06-15"', "2026-13-01", "20260615", "2026-06-15T12:00:00"])
def test_a_date_that_is_none_is_refused_with_one_line(date: str, tmp_path: object) -> None:
    file = tmp_path / "vineyard.toml"  # pyright: ignore[reportOperatorIssue]
    file.write_text(
        f'name = "a"\nseed = 1\ntraining = "vsp"\ndate = {date}\n'
        "layout = { rows = 1, vines = 1, row_spacing = 2.6, vine_spacing = 2.0, height = 0.85 }\n"
        'fruit = { bunches = [1, 2], varieties = ["black"] }\n'
    )
    if date.startswith('"'):  # a date in quotes is a date
        assert scenes.load_scene(file).date == datetime.date(2026, 6, 15)
        return
    with pytest.raises(scenes.SceneError) as refused:
        scenes.load_scene(file)
    assert "\n" not in str(refused.value)
    assert str(file) in str(refused.value)
