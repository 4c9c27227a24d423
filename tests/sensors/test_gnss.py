"""GNSS receivers: spread and correlation of the errors, outages, lever arm, refused files and entries."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vinesim.core import geodesy
from vinesim.core.geodesy import APRILIA, Geodetic
from vinesim.scene.spec import load_scene
from vinesim.scene.values import FixKind, GnssMount
from vinesim.sensors import spec_file
from vinesim.sensors.gnss import Gnss, GnssSpec
from vinesim.sensors.sensor import SensorSetting, maker

SPEC = GnssSpec.load("rtk")
PLACE = np.array([12.0, -7.0, 1.6])


def receiver(seed: int = 1, **keys) -> Gnss:
    return Gnss(SPEC, GnssMount("gnss", "antenna", "rtk", **keys), SensorSetting(seed=seed))


def local(fix, datum: Geodetic = APRILIA) -> np.ndarray:
    return geodesy.to_local(Geodetic(fix.latitude, fix.longitude, fix.altitude), datum)


@pytest.mark.parametrize("kind", ["fixed", "float", "single"])
def test_errors_have_the_spread_that_the_message_states(kind):
    """Samples that are five correlation times apart are independent: the sum of their squares is chi-squared."""
    gnss = receiver(fix=kind)
    step = 5.0 * SPEC.correlation_time.value
    fixes = [gnss.measure(PLACE, step * i) for i in range(400)]
    errors = np.array([local(fix) - PLACE for fix in fixes]) / np.sqrt(fixes[0].variance)
    assert np.sqrt(fixes[0].variance) == pytest.approx(getattr(SPEC, kind).axes)
    assert {fix.kind for fix in fixes} == {FixKind(kind)}
    # interpolation between the nodes of the drift takes a share of 1 - kept of its variance at most
    assert (errors**2).mean() == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / errors.size) + 0.03)
    assert abs(errors.mean()) < 4.0 / math.sqrt(errors.size)


def test_errors_drift_with_the_correlation_time_of_the_data_file():
    gnss = receiver()
    tau = SPEC.correlation_time.value
    starts = 5.0 * tau * np.arange(800)
    now = np.array([gnss.error(t) for t in starts])
    for lag in (0.01, 0.5 * tau, tau, 3.0 * tau):
        later = np.array([gnss.error(t + lag) for t in starts])
        expected = SPEC.slow_share.value * math.exp(-lag / tau)
        assert (now * later).mean() == pytest.approx(expected, abs=4.0 / math.sqrt(now.size) + 0.02)


def test_errors_depend_on_seed_name_and_time_alone():
    gnss = receiver()
    for time in (900.0, 3.0, 900.0):
        fix = gnss.measure(PLACE, time)
        assert fix.measured[0].tolist() == receiver().measure(PLACE, time).measured[0].tolist()
        assert fix.measured[0].tolist() != receiver(seed=2).measure(PLACE, time).measured[0].tolist()


def test_outages_have_their_rate_and_duration_and_end_with_float_ambiguities():
    gnss = receiver(outage_rate=60.0, outage_duration=5.0)
    times = np.arange(0.0, 20 * 3600.0, 0.5)
    kinds = np.array([gnss.kind(t).value for t in times])
    # at a Poisson process of rate r with outages of duration d, the share of time without a fix is 1 - exp(-r d)
    share = 1.0 - math.exp(-60.0 / 3600.0 * 5.0)
    assert (kinds == "none").mean() == pytest.approx(share, abs=4.0 * math.sqrt(share / 1200.0))
    ends = np.flatnonzero((kinds[:-1] == "none") & (kinds[1:] != "none"))
    assert set(kinds[ends + 1]) == {"float"}
    assert set(kinds) == {"none", "float", "fixed"}
    lost = gnss.measure(PLACE, float(times[kinds == "none"][0]))
    assert np.isnan(lost.measured[0]).all()
    assert {receiver().kind(t) for t in times[::100]} == {FixKind.FIXED}


def test_an_exact_position_has_neither_errors_nor_outages():
    gnss = receiver(outage_rate=1000.0, outage_duration=1800.0)
    fix = gnss.measure(PLACE, 100.0, is_exact=True)
    assert local(fix) == pytest.approx(PLACE, abs=1e-6)
    assert not fix.variance.any()


def test_the_datum_is_the_mounts_or_else_the_scenes(tmp_path):
    own = (48.0, 11.0, 500.0)
    assert tuple(receiver(datum=own).measure(np.zeros(3), 0.0, is_exact=True).measured[0]) == pytest.approx(own)
    text = load_scene_text("demo") + "\n[datum]\nlatitude = 45.5\nlongitude = 10.25\naltitude = 120.0\n"
    file = tmp_path / "scene.toml"
    file.write_text(text)
    datum = load_scene(file).datum.place
    assert datum == (45.5, 10.25, 120.0)
    assert load_scene("demo").datum.place == APRILIA
    gnss = Gnss(SPEC, GnssMount("gnss", "antenna", "rtk"), SensorSetting(datum=datum))
    assert tuple(gnss.measure(np.zeros(3), 0.0, is_exact=True).measured[0]) == pytest.approx(datum)


def load_scene_text(name: str) -> str:
    from vinesim.core.data_files import find_data_file

    return find_data_file("scenes", name, ".toml").read_text()


@pytest.mark.parametrize(
    ("keys", "found"),
    [
        ({"datum": (91.0, 0.0, 0.0)}, "the datum [91.0, 0.0, 0.0]"),
        ({"outage_rate": -1.0}, "the outage_rate -1.0"),
        ({"outage_duration": 0.0}, "the outage_duration 0.0"),
        ({"rate": 0.0}, "the rate 0.0"),
    ],
)
def test_wrong_entries_are_named(keys, found):
    assert GnssMount("gnss", "antenna", "rtk", **keys).fault()[0] == found


def test_a_file_with_a_wrong_unit_is_refused_in_one_line(tmp_path):
    from vinesim.core.data_files import find_data_file

    file = tmp_path / "own.toml"
    text = find_data_file("gnss", "rtk", ".toml").read_text()
    file.write_text(text.replace('value = 0.3, unit = "m"', 'value = 30, unit = "cm"'))
    with pytest.raises(spec_file.SensorError, match=r"float\.horizontal\.unit is 'cm'; give the value in 'm'"):
        maker("gnss").make(GnssMount("gnss", "antenna", str(file)), SensorSetting())
