"""Frequency and decrement of a track, without a model."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.tune import Trajectory, extract_features


def swing(frequency: float, ratio: float, released: float, hold: bool, seed: int = 0) -> Trajectory:
    """A damped sinusoid in two axes, irregular in time, with 2 mm noise, gaps and gross outliers."""
    rng = np.random.default_rng(seed)
    time = np.sort(rng.uniform(0.0 if hold else released + 0.3, 4.0, 120))
    omega = 2.0 * np.pi * frequency
    after = np.maximum(time - released, 0.0)
    wave = np.exp(-ratio * omega * after) * np.cos(omega * np.sqrt(1.0 - ratio**2) * after)
    position = np.full((120, 1, 3), np.nan)
    position[:, 0, 0] = 0.3 + 0.02 * wave
    position[:, 0, 2] = -0.1 - 0.06 * wave
    position[:, 0, ::2] += rng.normal(0.0, 2e-3, (120, 2))
    position[rng.random(120) < 0.15, 0, 2] = np.nan
    position[rng.random(120) < 0.04, 0, 2] *= 30.0
    return Trajectory(time, position)


@pytest.mark.parametrize("noise", [1e-4, 2e-3])
def test_a_release_after_a_hold_is_not_taken_for_half_a_period_earlier(noise: float) -> None:
    """Noise of a few samples is a poor measure of what stands out: a third of filmed tracks began within their hold."""
    time = np.arange(100) / 30.0
    after = np.maximum(time - 0.21, 0.0)
    wave = np.exp(-0.6 * after) * np.cos(17.0 * after)
    for seed in range(30):
        position = np.full((100, 1, 3), np.nan)
        position[:, 0, 2] = 0.1 * wave + np.random.default_rng(seed).normal(0.0, noise, 100)
        found = extract_features(Trajectory(time, position))
        assert found.release == pytest.approx(0.21, abs=0.02), seed
        assert found.frequency == pytest.approx(17.0 / (2.0 * np.pi), rel=0.01)


@pytest.mark.parametrize("noise", [0.0, 1e-4, 2e-3])
def test_turning_points_between_few_pictures_are_no_gross_errors(noise: float) -> None:
    """Six pictures in each period, as of a cane of 5 Hz: each turning point is far from its neighbours. Errors that the
    swing does not explain are left out, at a turning point as well."""
    time = np.arange(96) / 30.0
    after = np.maximum(time - 0.2, 0.0)
    wave = np.exp(-2.1 * after) * np.cos(2.0 * np.pi * 4.96 * after)
    for seed in range(10):
        position = np.full((96, 1, 3), np.nan)
        position[:, 0, 2] = 0.1 * wave + np.random.default_rng(seed).normal(0.0, noise, 96)
        assert not extract_features(Trajectory(time, position)).gross.any(), seed
        wrong = [9, 12, 40, 70]
        position[wrong, 0, 2] *= [30.0, 1e3, -1e3, 1e3]
        found = extract_features(Trajectory(time, position))
        assert np.flatnonzero(found.gross[:, 0]).tolist() == wrong, seed
        assert found.frequency == pytest.approx(4.96, rel=5e-3)
        np.testing.assert_allclose(found.curve[:, 0], 0.1 * wave, atol=1e-5 + 2.0 * noise)


@pytest.mark.parametrize(("frequency", "ratio"), [(0.8, 0.05), (2.7, 0.01), (6.0, 0.03)])
@pytest.mark.parametrize("hold", [True, False])
def test_a_damped_sinusoid_is_recovered(frequency: float, ratio: float, hold: bool) -> None:
    found = extract_features(swing(frequency, ratio, 0.5, hold))
    assert found.frequency == pytest.approx(frequency, rel=0.01)
    assert found.damping_ratio == pytest.approx(ratio, rel=0.2)
    assert found.log_decrement == pytest.approx(2.0 * np.pi * found.damping_ratio, rel=0.01)
    np.testing.assert_allclose(found.rest, [0.3, -0.1], atol=2e-3)
    assert found.noise == pytest.approx(2e-3, rel=0.3)
    # the release is known but for whole half periods if the track begins later
    halves = 2.0 * found.frequency * (found.release - 0.5)
    assert abs(halves if hold else halves - round(halves)) < 0.4
    if hold:
        np.testing.assert_allclose(found.displacement, [0.02, -0.06], atol=0.005)
