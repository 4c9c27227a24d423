"""A base that is shaken: the response of a beam, tracks that repeat to the byte, and fits of them."""

from __future__ import annotations

import dataclasses
import json
import math
import pathlib

import numpy as np
import pytest

from tests.support.tuning import cane, number
from vinesim.cli.tune import plan
from vinesim.core.errors import UsageError
from vinesim.core.toml_loader import DataError
from vinesim.scene.plant_parameters import load_specimen
from vinesim.tune import Experiment, Trajectory, TrajectoryError, extract_features, measure, read_trajectory, tune
from vinesim.tune.base_motion import SampledMotion, Sweep
from vinesim.tune.fit import specimen_toml

SHAKE = Experiment(kind="shake", duration=4.0, from_frequency=2.0, to_frequency=6.0, axes="z")


def response(track: Trajectory, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [k] Hz up to a third of the pictures' rate, and motion relative to the base over that of the base."""
    assert track.base is not None
    base = track.base[:, axis]
    step = 1.0 / track.rate
    moved = track.position[:, 0, axis] - base
    count = 16 * len(base)
    frequency = np.fft.rfftfreq(count, step)
    here = (frequency > 1.0) & (frequency < track.rate / 3.0)
    return frequency[here], np.abs(np.fft.rfft(moved - moved[0], count) / np.fft.rfft(base, count))[here]


def test_the_response_peaks_at_the_first_mode_of_the_beam() -> None:
    """A cane without taper that is shaken sideways: 1.8751^2 / 2 pi sqrt(E I / rho A L^4), and there the tip moves by
    1.566 / 2 zeta times the base (the mode's share of a base motion times its tip), zeta = pi f beta. The bars of 1 %
    and 5 % hold phase, sag, drag and the tails of other modes, of which each is below 0.5 % and 2 %."""
    specimen = cane(base_diameter=number(0.008, "m"), tip_diameter=number(0.008, "m"))
    first = 1.8751**2 / (2.0 * math.pi) * math.sqrt(5e9 * 0.004**2 / 4.0 / 900.0)
    shake = Experiment(
        kind="shake", angle=0.0, amplitude=1e-3, from_frequency=1.0, to_frequency=6.0, duration=12.0, rate=40.0
    )
    frequency, ratio = response(measure(specimen, shake, exact=True), axis=1)
    swept = (frequency > 1.5) & (frequency < 5.5)  # beyond, the base hardly moves
    peak = int(np.argmax(np.where(swept, ratio, 0.0)))
    assert frequency[peak] == pytest.approx(first, rel=0.01)
    assert ratio[peak] == pytest.approx(1.566 / (2.0 * math.pi * first * 0.004), rel=0.05)


def test_a_sweep_moves_as_fast_as_its_position_changes_and_begins_and_ends_at_rest() -> None:
    sweep = Sweep(np.array([0.0, 0.6, 0.8]), 0.005, (1.0, 8.0), 0.2, 4.0)
    time = np.linspace(0.0, 4.5, 45_001)
    position = sweep.position(time) @ sweep.direction
    velocity = sweep.velocity(time) @ sweep.direction
    np.testing.assert_allclose(np.gradient(position, time)[1:-1], velocity[1:-1], atol=1e-5 * np.abs(velocity).max())
    assert np.abs(position).max() == pytest.approx(0.005, rel=0.01)
    for still in (time < 0.2, time > 4.2):
        assert np.abs(position[still]).max() == 0.0
        assert np.abs(velocity[still]).max() == 0.0


def test_the_acceleration_between_samples_is_known_up_to_a_quarter_of_their_rate() -> None:
    time = np.arange(400.0)
    between = np.linspace(150.0, 250.0, 2001)
    omega = 0.5 * math.pi
    found = SampledMotion(time, np.sin(omega * time)).acceleration(between)
    np.testing.assert_allclose(found, -(omega**2) * np.sin(omega * between), atol=2e-3 * omega**2)


def test_the_same_seed_gives_the_same_file(tmp_path: pathlib.Path) -> None:
    short = dataclasses.replace(SHAKE, duration=1.0)
    for name, seed in (("one", 3), ("same", 3), ("other", 4)):
        measure(cane(segments=4), dataclasses.replace(short, seed=seed)).write(tmp_path / name)
    text = (tmp_path / "one").read_bytes()
    assert text.startswith(b"time [s],z [mm],base z [mm]\n")
    assert text == (tmp_path / "same").read_bytes()
    assert text != (tmp_path / "other").read_bytes()


@pytest.mark.long
def test_a_shaken_cane_is_written_read_and_fitted(tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From the command line's plan to a fit whose start is off: the truth lies within three of the expected standard
    deviations, and the oscillator that knows no beam has the frequency of the fitted cane."""
    (tmp_path / "cane.toml").write_text(specimen_toml(cane()))
    assert plan(SHAKE, tmp_path / "cane.toml", tmp_path / "shake.csv", "modulus,damping", True) == 0
    expected = json.loads(capsys.readouterr().out)["deviation"]
    assert 3e-4 < expected["modulus"] < 5e-3
    assert 2e-3 < expected["damping"] < 0.05
    track = read_trajectory(tmp_path / "shake.csv")
    fit = tune(cane(2e9, 0.01), track)
    assert fit.ok, fit.faults
    assert fit.estimate("modulus").value == pytest.approx(5e9, rel=3.0 * expected["modulus"])
    assert fit.estimate("damping").value == pytest.approx(0.004, rel=3.0 * expected["damping"])
    assert fit.noise == pytest.approx(2e-3, rel=0.2)
    assert extract_features(track).frequency == pytest.approx(fit.frequency, rel=0.02)
    with pytest.raises(UsageError, match="shaken, so there is no release; leave out --release"):
        tune(cane(), track, release=0.2)


@pytest.mark.long
def test_shaking_tells_modulus_over_mass_and_the_fit_says_so() -> None:
    fit = tune(cane(), measure(cane(), SHAKE), ("modulus", "damping", "mass"))
    (ridge,) = fit.posterior.ridges
    assert ridge.direction["modulus"] == pytest.approx(math.sqrt(0.5), abs=0.02)
    assert any("fix the mass, or measure a pull" in line for line in fit.lines())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"to_frequency": 12.0}, "reaches 12 Hz, .* give a rate of 40 or more"),
        ({"amplitude": 0.0}, "amplitude is 0.0; give a finite number above 0"),
        ({"from_frequency": math.nan}, "from_frequency is nan"),
        ({"force_noise": 0.01}, "a shaken plant is not pulled"),
        ({"displacement": 0.1}, "displacement is 0.1, but belongs to pull-release or push, not to shake; leave it out"),
        ({"kind": "shakes"}, "there are: pull-release, push, shake"),
    ],
)
def test_a_sweep_that_cannot_be_is_refused(changes: dict, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        measure(cane(), dataclasses.replace(SHAKE, **changes))


def test_a_base_is_known_at_every_sample_and_is_no_marker(tmp_path: pathlib.Path) -> None:
    file = tmp_path / "shake.csv"
    rows = [f"{0.1 * i:.1f},{i % 3},{i % 2}" for i in range(10)]
    file.write_text("\n".join(["time [s],z [mm],base z [cm]", *rows]))
    base = read_trajectory(file).base
    assert base is not None
    np.testing.assert_allclose(base[:, 2], [0.01 * (i % 2) for i in range(10)])
    file.write_text("\n".join(["time [s],z [mm],base z [cm]", *rows[:4], "0.4,1,", *rows[5:]]))
    with pytest.raises(TrajectoryError, match=r"shake.csv:6: column 'base z \[cm\]' is ''; give a number$"):
        read_trajectory(file)
    file.write_text("\n".join(["time [s],z [mm],base z [cm],force [N]", *(f"{row},1" for row in rows)]))
    with pytest.raises(TrajectoryError, match="a pull at the tip and a motion of the base"):
        read_trajectory(file)
    plant = tmp_path / "cane.toml"
    plant.write_text(specimen_toml(cane(markers={"base": 0.1})))
    with pytest.raises(DataError, match=r"specimen.markers.base is no name for a marker"):
        load_specimen(plant)
