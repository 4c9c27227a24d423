"""Fits: what is put in comes out, with honest intervals; what cannot be known is said; failures are not silent."""

from __future__ import annotations

import dataclasses
import json
import math
import pathlib
import re

import numpy as np
import pytest

from tests.support.long_rows import long
from tests.support.tuning import bunch, cane, number
from vinesim.bench.tuning_cases import draw_case
from vinesim.cli.tune import plan, run
from vinesim.core.errors import UsageError
from vinesim.core.toml_loader import DataError
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.plant_parameters import load_plant, load_specimen
from vinesim.scene.spec import load_scene
from vinesim.tune import Experiment, Trajectory, TrajectoryError, measure, read_trajectory, tune
from vinesim.tune.fit import specimen_toml

SHORT = Experiment(duration=2.0)


@pytest.fixture(scope="module")
def track() -> Trajectory:
    """A pull of a cane of 5 GPa and 4 ms, as a camera sees it."""
    return measure(cane(), SHORT)


@pytest.mark.parametrize(("seed", "ratio", "off"), [(1, 0.01, 5.0), *long((2, 0.03, 0.2), (3, 0.1, 5.0))])
def test_modulus_and_damping_are_recovered_from_far_away(seed: int, ratio: float, off: float) -> None:
    """2 mm of noise, 30 pictures a second, 3 s, start values five times off; the truth was stepped at 1 ms."""
    damping = ratio / (math.pi * 3.48)
    truth = cane(5e9, damping)
    fit = tune(cane(5e9 * off, damping / off), measure(truth, Experiment(seed=seed)))
    assert fit.ok
    assert fit.estimate("modulus").value == pytest.approx(5e9, rel=0.03)
    assert fit.estimate("damping").value == pytest.approx(damping, rel=0.15)
    assert fit.noise == pytest.approx(2e-3, rel=0.2)
    deviation = fit.posterior.deviation
    assert 2e-4 < deviation[0] < 6e-3
    assert 0.005 < deviation[1] < 0.08


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, *long(3)])
def test_an_exact_track_tells_the_modulus_exactly(seed: int) -> None:
    """The bias of the coarse chain, 1.2 %, is taken off to a twentieth of a percent; the truth's own is 0.03 %."""
    case = draw_case(seed)
    fit = tune(case.guess, measure(case.truth, dataclasses.replace(case.experiment, noise=1e-4)))
    assert fit.estimate("modulus").value == pytest.approx(case.truth.modulus.value, rel=5e-4)
    assert fit.estimate("damping").value == pytest.approx(case.truth.damping.value, rel=5e-3)


@pytest.mark.long
def test_each_axis_weighs_by_its_own_noise() -> None:
    """A camera measures distances less exactly than directions; across the plane of the swing they tell nothing."""
    exact = measure(cane(), dataclasses.replace(SHORT, noise=0.0))
    noise = np.random.default_rng(5).normal(size=exact.position.shape)
    both = tune(cane(3e9), dataclasses.replace(exact, position=exact.position + noise * [1e-4, 2e-3, 1e-4]))
    across = exact.position + noise * [1e-4, np.nan, 1e-4]
    alone = tune(cane(3e9), dataclasses.replace(exact, position=across))
    np.testing.assert_allclose(both.column_noise, [1e-4, 2e-3, 1e-4], rtol=0.25)
    np.testing.assert_allclose(both.posterior.deviation[:2], alone.posterior.deviation[:2], rtol=0.1)
    np.testing.assert_allclose(both.posterior.mean[:2], alone.posterior.mean[:2], atol=2e-4)
    assert any("2.0" in line and "in tip y" in line for line in both.lines())


def test_a_free_swing_tells_modulus_over_mass_and_the_fit_says_so(track: Trajectory) -> None:
    fit = tune(cane(3e9), track, ("modulus", "damping", "mass"))
    (ridge,) = fit.posterior.ridges
    assert ridge.direction["modulus"] == pytest.approx(math.sqrt(0.5), abs=0.02)
    assert ridge.direction["mass"] == pytest.approx(math.sqrt(0.5), abs=0.02)
    assert [e.name for e in fit.estimates if not e.known] == ["modulus", "mass"]
    assert any("force [N]" in line for line in fit.lines())
    assert any(
        re.search(r"hardly changes if (mass|modulus) rises and (modulus|mass) rises with", s) for s in fit.lines()
    )
    written = fit.fitted_specimen()  # values that swing as the track does, but only the damping is known
    assert [n.grade for n in (written.modulus, written.density, written.damping)] == ["GUESSED", "GUESSED", "FITTED"]
    assert "not decided by the track" in written.modulus.source
    assert written.modulus.value == pytest.approx(fit.estimate("modulus").value, rel=1e-4)
    ratio = fit.posterior.mean[0] - fit.posterior.mean[2]
    assert math.exp(ratio) * 3e9 == pytest.approx(5e9, rel=0.01)  # what can be known is


def test_a_force_reading_tells_the_mass() -> None:
    track = measure(cane(), dataclasses.replace(SHORT, force_noise=0.0))
    wrong = cane(3e9, density=number(700.0, "kg/m^3"))
    fit = tune(wrong, track, ("modulus", "damping", "mass"))
    assert fit.ok
    assert not fit.posterior.ridges
    assert fit.estimate("modulus").value == pytest.approx(5e9, rel=0.03)
    assert fit.estimate("mass").value * 700.0 == pytest.approx(900.0, rel=0.03)


def test_the_slack_shape_is_recovered() -> None:
    fit = tune(cane(), measure(cane(bow=(0.25, -0.15)), SHORT), ("modulus", "damping", "rest"))
    assert fit.ok
    assert fit.fitted_specimen().bow == pytest.approx((0.25, -0.15), abs=0.02)
    assert fit.estimate("modulus").value == pytest.approx(5e9, rel=0.02)


def test_a_bunch_that_swings_tells_its_peduncle() -> None:
    fit = tune(bunch(1e9, 0.02), measure(bunch(), Experiment(displacement=0.04, axes="xy")))
    assert fit.ok
    assert fit.estimate("modulus").value == pytest.approx(0.3e9, rel=0.1)
    assert fit.estimate("damping").value == pytest.approx(0.05, rel=0.15)


def test_outliers_and_gaps_hardly_matter(track: Trajectory) -> None:
    rng = np.random.default_rng(4)
    position = track.position.copy()
    position[rng.random(len(position)) < 0.2, 0, 2] = np.nan
    position[rng.random(len(position)) < 0.1, 0, 2] += 0.03
    position[50, 0, 2] *= 1000.0
    fit = tune(cane(8e9), dataclasses.replace(track, position=position))
    assert fit.ok
    assert fit.gaps == np.isnan(position).sum()
    assert fit.left_out > 0
    assert fit.outliers > fit.left_out + 3
    assert np.isfinite(fit.model[np.isfinite(position[:, 0])]).all()  # also where samples are left out
    assert fit.estimate("modulus").value == pytest.approx(5e9, rel=0.02)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"axes": [2, 1, 0]}, "the fitted plant swings at 5"),
        ({"position": 10.0}, "is the unit right (m, cm, mm)?"),
        ({"release": 0.5}, "check the unit of the positions, the axes (z is up), the time of the release"),
    ],
)
def test_a_track_that_contradicts_the_fitted_plant_is_a_fault(change: dict, words: str) -> None:
    """x and z swapped, mm named cm, a late release: each fit was once accepted."""
    track = measure(cane(1.011e10, 0.00433), Experiment())
    position = change.get("position", 1.0) * track.position[..., change.get("axes", [0, 1, 2])]
    track = dataclasses.replace(track, position=position)
    fit = tune(cane(5.89e9), track, release=change.get("release"))
    assert any(words in fault for fault in fit.faults), fit.faults


@pytest.mark.parametrize(("scale", "hertz"), [(1e-3, "34"), (30.0, "0.11")])
def test_a_wrong_time_is_refused(track: Trajectory, scale: float, hertz: str) -> None:
    """Seconds named milliseconds, and numbers of pictures named seconds."""
    with pytest.raises(TrajectoryError, match=f"swings at {hertz}.* Hz, plants at 0.2 to 50 Hz; correct the unit"):
        tune(cane(), dataclasses.replace(track, time=scale * track.time))


def test_a_push_and_a_pull_are_told_apart_by_their_force() -> None:
    for kind, remedy in (("pull-release", "as of a pull; leave out --push"), ("push", "as of a push; give --push")):
        track = measure(cane(), Experiment(kind=kind, force_noise=0.0))
        with pytest.raises(TrajectoryError, match=remedy):
            tune(cane(), track, pushed=kind != "push")


@pytest.mark.parametrize("noise", [2e-3, 0.0])
def test_noise_alone_makes_no_outliers(noise: float) -> None:
    """The first cane of the tutorial: 5 Hz, so six pictures in each period."""
    truth = cane(1.011e10, 0.00433)
    fit = tune(cane(), measure(truth, Experiment(noise=noise)))
    assert fit.ok
    assert fit.outliers == 0


def test_draws_of_the_posterior_agree_with_its_approximation(track: Trajectory) -> None:
    fit = tune(cane(), track, samples=256, seed=2)
    assert fit.sample is not None
    assert fit.sample.effective > 60
    np.testing.assert_allclose(fit.sample.draws[:, :2].std(0), fit.posterior.deviation[:2], rtol=0.3)
    np.testing.assert_allclose(fit.sample.draws[:, :2].mean(0), fit.posterior.mean[:2], atol=0.01)


def test_a_track_that_the_plant_cannot_make_is_a_failure_in_words(track: Trajectory) -> None:
    """Two swings of different frequency in two axes: a cane that is round has one."""
    position = track.position.copy()
    time = track.time - 0.2
    position[:, 0, 1] += np.where(time > 0.0, 0.05 * np.sin(2.0 * np.pi * 2.2 * time), 0.0)
    fit = tune(cane(), dataclasses.replace(track, position=position))
    assert not fit.ok
    assert fit.lines()[0].startswith("FAILED")
    assert any(line.startswith("fault") for line in fit.lines())


@pytest.mark.parametrize(
    ("scale", "words"), [(1e3, "correct the unit"), (1e-3, "no swing stands out|correct the unit")]
)
def test_a_wrong_unit_is_refused(track: Trajectory, scale: float, words: str) -> None:
    with pytest.raises(TrajectoryError, match=words):
        tune(cane(), dataclasses.replace(track, position=scale * track.position))


def test_tracks_that_tell_nothing_are_refused(track: Trajectory) -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(TrajectoryError, match="no swing stands out"):
        tune(cane(), dataclasses.replace(track, position=rng.normal(0.0, 2e-3, track.position.shape)))
    with pytest.raises(TrajectoryError, match="less than one period"):
        tune(cane(), track.between(0.0, 0.45), release=0.25)
    with pytest.raises(TrajectoryError, match=r"ends at 2\.167 s, and the release at 9 s is not before"):
        tune(cane(), track, release=9.0)
    with pytest.raises(TrajectoryError, match="less than one period"):  # the hold and two samples of the swing
        tune(cane(), track.between(0.0, 0.25))
    with pytest.raises(UsageError, match="'colour' cannot be fitted; give one or more of: modulus"):
        tune(cane(), track, ("colour",))
    with pytest.raises(UsageError, match="marker 'middle' is not in the specimen, which has: tip"):
        tune(cane(), dataclasses.replace(track, markers=("middle",)))


def test_scenes_load_what_was_fitted(track: Trajectory, tmp_path, capsys) -> None:
    """From files on the command line: a plant whose numbers carry source and date, and a vineyard of it."""
    track.write(tmp_path / "pull.csv")
    (tmp_path / "cane.toml").write_text(specimen_toml(cane(8e9)))
    out = tmp_path / "fitted.toml"
    plot = tmp_path / "fit.png"
    code = run(
        tmp_path / "pull.csv", tmp_path / "cane.toml", "modulus,damping", out, True, plot, None, False, 0, 0, "cpu"
    )
    said = json.loads(capsys.readouterr().out)
    assert code == 0
    assert said["ok"]
    assert plot.stat().st_size > 10_000
    modulus = load_plant(str(out)).cane.woody_modulus
    assert modulus.grade == "FITTED"
    assert modulus.value == pytest.approx(said["estimates"][0]["value"], rel=1e-4)
    assert "pull.csv: 90 %" in modulus.source
    assert load_specimen(out).modulus == modulus
    scene = tmp_path / "scene.toml"
    layout = "[layout]\nrows = 1\nvines = 1\nrow_spacing = 2.5\nvine_spacing = 2.5\nheight = 2.0\n"
    layout += '[fruit]\nbunches = [1, 2]\nvarieties = ["italia"]\n'
    stiffness = []
    for plants in ("vine", str(out)):
        head = f'name = "one"\nseed = 1\ntraining = "tendone"\nplants = "{plants}"\n'
        scene.write_text(head + layout)
        stiffness.append(generate(load_scene(str(scene))).joint_stiffness.max())
    assert stiffness[1] / stiffness[0] == pytest.approx(modulus.value / 5.89e9, rel=0.05)


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("out", "nodir/fitted.toml", "--out nodir/fitted.toml cannot be written: there is no folder nodir"),
        ("out", ".", "--out . is a folder; give a file"),
        ("plot", "nodir/fit.png", "--plot nodir/fit.png cannot be written: there is no folder nodir"),
        ("plot", "fit.xyz", "--plot is fit.xyz; give a file with the suffix .png, .pdf or .svg"),
        ("truth", "bunch.toml", "--truth bunch.toml is a bunch, --model cane.toml a cane"),
    ],
)
def test_files_that_cannot_be_used_are_refused_before_the_fit(tmp_path, monkeypatch, option, value, words) -> None:
    """They are wrong use, exit code 2; exit code 5 means that the fit failed."""
    monkeypatch.chdir(tmp_path)
    pathlib.Path("cane.toml").write_text(specimen_toml(cane()))
    pathlib.Path("bunch.toml").write_text(specimen_toml(bunch()))
    places = {"out": None, "plot": None, "truth": None} | {option: pathlib.Path(value)}
    arguments = pathlib.Path("missing.csv"), pathlib.Path("cane.toml"), "modulus,damping", places["out"], False
    with pytest.raises(UsageError) as refused:
        run(*arguments, places["plot"], None, False, 0, 0, "cpu", truth=places["truth"])
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("out", "hidden", "words"),
    [
        ("track.csv", "nodir/truth.toml", "--hidden nodir/truth.toml cannot be written: there is no folder nodir"),
        ("track.csv", "track.csv", "--out and --hidden are the same file track.csv"),
        ("track.csv", "cane.toml", "--hidden and --model are the same file cane.toml"),
    ],
)
def test_an_experiment_writes_all_files_or_none(tmp_path, monkeypatch, out, hidden, words) -> None:
    monkeypatch.chdir(tmp_path)
    pathlib.Path("cane.toml").write_text(specimen_toml(cane()))
    pathlib.Path("track.csv").write_text("former")
    with pytest.raises(UsageError) as refused:
        plan(SHORT, pathlib.Path("cane.toml"), pathlib.Path(out), "modulus", False, pathlib.Path(hidden))
    assert words in str(refused.value)
    assert pathlib.Path("track.csv").read_text() == "former"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cane.toml", "track.csv"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "specimen is missing"),
        (specimen_toml(cane()).replace('"Pa"', '"GPa"'), "specimen.modulus.unit is 'GPa'; give the value in 'Pa'"),
        (specimen_toml(cane()).replace("value = 1.0", "value = -1.0"), "specimen.length.value is -1.0"),
        (specimen_toml(bunch()).replace("tip_mass", "# "), "specimen.tip_mass is missing"),
        (specimen_toml(cane(markers={"middle": 3.0})), "specimen.markers.middle is 3.0"),
        (specimen_toml(cane()).replace("segments = 8", "segments = 1"), "specimen.segments is 1"),
    ],
)
def test_a_specimen_that_cannot_be_is_refused(tmp_path, text: str, words: str) -> None:
    path = tmp_path / "cane.toml"
    path.write_text(text)
    with pytest.raises(DataError) as refused:
        load_specimen(path)
    assert words in str(refused.value)
    assert str(path) in str(refused.value)


@pytest.mark.long
def test_an_experiment_writes_the_track_and_says_what_a_fit_would_know(tmp_path, capsys) -> None:
    """A push with a force gauge, read back from CSV and fitted."""
    (tmp_path / "cane.toml").write_text(specimen_toml(cane(segments=4)))
    experiment = Experiment(kind="push", force_noise=0.0, duration=1.5, axes="z")
    assert plan(experiment, tmp_path / "cane.toml", tmp_path / "push.csv", "modulus,damping,mass", True) == 0
    said = json.loads(capsys.readouterr().out)
    assert 0.0 < said["deviation"]["modulus"] < 0.1
    assert 0.0 < said["deviation"]["mass"] < 0.1
    track = read_trajectory(tmp_path / "push.csv")
    assert len(track.time) == said["samples"]
    fit = tune(cane(2e9, segments=4), track, ("modulus", "damping", "mass"), pushed=True)
    assert fit.ok
    assert fit.estimate("modulus").value == pytest.approx(5e9, rel=0.1)
    assert fit.estimate("mass").value == pytest.approx(1.0, rel=0.1)


@pytest.mark.long
def test_a_plant_is_tested_on_another_release(track: Trajectory) -> None:
    """Nothing of the plant is fitted: the right one leaves the noise, a stiffer one leaves more and says so."""
    right = tune(cane(), track, ())
    assert right.ok
    assert right.noise == pytest.approx(2e-3, rel=0.15)
    assert not right.estimates
    wrong = tune(cane(5.5e9), track, ())
    assert not wrong.ok
    assert wrong.noise > 1.3 * right.noise


@pytest.mark.long
def test_a_force_that_contradicts_the_fit_is_a_fault(track: Trajectory) -> None:
    """A gauge that was read in the wrong unit made a modulus three times too high, or a mass."""
    held = np.where(track.time < 0.2, 1.2, np.nan)
    wrong = dataclasses.replace(track, force=held)
    assert any("the gauge showed 1.2 N" in fault for fault in tune(cane(3e9), wrong).faults)
    heavy = tune(cane(3e9), wrong, ("modulus", "damping", "mass"))
    assert any("times that of the specimen" in fault for fault in heavy.faults)
    nothing = dataclasses.replace(track, force=np.zeros(len(track.time)))
    with pytest.raises(TrajectoryError, match=r"no reading above 0 before the release at 0\.2"):
        tune(cane(3e9), nothing, ("modulus", "damping", "mass"))


@pytest.mark.long
def test_centimetres_for_millimetres_are_asked_for(track: Trajectory) -> None:
    fit = tune(cane(3e9), dataclasses.replace(track, position=10.0 * track.position))
    assert any("is the unit right" in fault for fault in fit.faults)
