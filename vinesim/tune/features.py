"""Features of a track without a plant model: frequency, logarithmic decrement, rest position, release.

A damped sinusoid is fitted to all columns at once. For a given frequency and damping ratio its amplitudes follow from
linear least squares, so gaps and irregular times do no harm. If the base was shaken, the response of a damped
oscillator to the base's acceleration is fitted instead.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np

from vinesim.tune.base_motion import SampledMotion
from vinesim.tune.trajectory import Trajectory

FREQUENCIES_PER_BIN = 4
"""Number of trial frequencies in an interval of 1 / duration."""
RELATIVE_STEP = 0.03
"""[1] Relative spacing of the trial frequencies of a shaken oscillator."""
SUBSTEPS = 8
"""Number of equal parts of a sample interval. The acceleration of a shaken base is taken as constant in each part."""
STANDS_OUT = 0.1
"""Fraction of a track's whole range by which a sample must differ from the first samples to count as motion, not noise
[1].

Detection of the onset after its true time does no harm, because the turning point is known to a quarter of a period.
Detection during the hold does.
"""
CLEARLY = 5.0
"""Reduction of the loss that another release time must achieve to replace the first estimate [squared standard
deviations]."""
GROSS_DEVIATIONS = 12.0
"""Smallest distance of a gross error from the curve of the track [standard deviations]."""
GROSS_SHARE = 0.3
"""Smallest distance of a gross error from the curve of the track, as a fraction of the largest displacement [1]. The
curve is not the plant: a wide swing and higher modes deviate from it."""
DAMPING_RATIOS = np.array([0.003, 0.01, 0.02, 0.04, 0.07, 0.12, 0.2, 0.35])
"""Trial damping ratios."""


@dataclasses.dataclass(frozen=True, slots=True)
class Features:
    """Features of the motion in a track, found without a plant model: the parameters of a damped sinusoid, or, for a
    shaken base, of a damped oscillator, fitted to the track."""

    frequency: float
    """Frequency [Hz]."""
    damping_ratio: float
    """Damping ratio [1]."""
    release: float
    """[s] Time of the release on the track's clock: the turning point at or before the onset of motion. For a shaken
    base it is the start of the track."""
    rest: np.ndarray
    """[column] m, rest position in each column of the track (axis of a marker)."""
    displacement: np.ndarray
    """[column] m, displacement of the sinusoid from the rest position at the release; for a shaken base, largest
    response of the oscillator."""
    noise: float
    """Robust standard deviation of the residuals of the curve [m]. The noise of the track is at most this."""
    column_noise: np.ndarray
    """[column] m, the same of each column."""
    explained: float
    """[1] Fraction of the motion after the release, relative to the base, that the curve explains."""
    curve: np.ndarray
    """[sample, column] m, the curve at the times of the track."""
    gross: np.ndarray
    """[sample, column] bool, gross errors such as swapped markers and wrong digits, which are left out: samples that
    are far from their neighbours and from the curve."""

    @property
    def log_decrement(self) -> float:
        """[1] Logarithmic decrement: logarithm of the ratio of two successive maxima of the swing."""
        return 2.0 * math.pi * self.damping_ratio / math.sqrt(1.0 - self.damping_ratio**2)


def columns_of(track: Trajectory, gross: np.ndarray) -> np.ndarray:
    """Returns the tracked columns [sample, column] m, with the samples ``gross`` [sample, column] replaced by NaN."""
    return np.where(gross, np.nan, track.position[:, track.tracked])


def robust_deviation(values: np.ndarray) -> float:
    """Returns the standard deviation, estimated from the median of absolute deviations."""
    values = values[np.isfinite(values)]
    return 1.4826 * float(np.median(np.abs(values - np.median(values)))) if len(values) else math.nan


def _suspects(track: Trajectory) -> np.ndarray:
    """Returns which samples are far from the median of five neighbours [sample, column] bool: gross errors, and turning
    points of a swing with few samples in each period."""
    return np.stack([_far_from_neighbours(column) for column in track.position[:, track.tracked].T], axis=1)


def _far_from_neighbours(column: np.ndarray) -> np.ndarray:
    """Returns which samples of one column [sample] are far from the median of five neighbours [sample] bool."""
    seen = np.flatnonzero(np.isfinite(column))
    if len(seen) < 5:
        return np.zeros(len(column), bool)
    padded = np.pad(column[seen], 2, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 5)
    off = np.abs(column[seen] - np.median(windows, 1))
    spread = max(1.4826 * float(np.median(off)), 0.25 * float(np.quantile(off, 0.9)), 1e-9)
    bad = np.zeros(len(column), bool)
    bad[seen[off > 12.0 * spread]] = True
    return bad


def _find_onset(track: Trajectory, gross: np.ndarray) -> float:
    """Returns the last time [s] before the motion, which is the first sample unless the track begins with a hold."""
    values = columns_of(track, gross)
    seen = np.isfinite(values).any(1)
    values = values[seen]
    time = track.time[seen]
    noise = max(_hold_noise(values), 1e-9)
    start = np.nanmedian(values[: max(3, min(5, len(values) // 8))], axis=0)
    off = np.max(np.abs(np.nan_to_num(values - start)), axis=1)
    span = float(np.nanmax(np.nanquantile(values, 0.98, axis=0) - np.nanquantile(values, 0.02, axis=0)))
    moved = np.flatnonzero(off > max(6.0 * noise, STANDS_OUT * span))
    return float(time[max(0, int(moved[0]) - 1)] if len(moved) else track.time[0])


def _hold_noise(values: np.ndarray) -> float:
    """Returns the noise [m] of the first samples if they hold still."""
    first = values[: max(4, len(values) // 20)]
    return float(np.nanmax([robust_deviation(column) for column in np.diff(first, axis=0).T])) / math.sqrt(2.0)


def _basis(time: np.ndarray, frequency: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Returns basis curves [trial, sample, 3]: constant one, damped cosine and damped sine."""
    omega = 2.0 * np.pi * frequency[:, None]
    decay = np.exp(-ratio[:, None] / np.sqrt(1.0 - ratio[:, None] ** 2) * omega * time)
    return np.stack([np.ones_like(decay), decay * np.cos(omega * time), decay * np.sin(omega * time)], -1)


def _response_basis(time: np.ndarray, motion: SampledMotion, frequency: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """Returns basis curves [trial, sample, 3]: constant one, response of a damped oscillator, and acceleration of the
    base.

    The acceleration represents higher modes, which follow it without delay. The last two curves are scaled to a mean
    square of one. The response is exact for an acceleration that is constant over each of :data:`SUBSTEPS` parts of a
    sample interval.
    """
    omega = 2.0 * np.pi * frequency
    pole = omega * (-ratio + 1j * np.sqrt(1.0 - ratio**2))
    rows = np.zeros((len(time), len(pole)))
    z = np.zeros(len(pole), complex)
    for i, interval in enumerate(np.diff(time)):
        h = interval / SUBSTEPS
        turn = np.exp(pole * h)
        velocity = motion.velocity(time[i] + h * np.arange(SUBSTEPS + 1))
        for gain in np.diff(velocity) / h:
            z = turn * z + gain * (turn - 1.0) / pole
        rows[i + 1] = -np.imag(z)
    acceleration = motion.acceleration(time)
    rows /= np.maximum(np.sqrt((rows**2).mean(0)), 1e-300)
    acceleration = np.broadcast_to(acceleration / max(float(np.sqrt((acceleration**2).mean())), 1e-300), rows.T.shape)
    return np.stack([np.ones_like(rows.T), rows.T, acceleration], -1)


def _misfit(basis: np.ndarray, values: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns weighted squared residuals [trial] and coefficients [trial, 3, column] for ``basis`` [trial, sample,
    3]."""
    clean = np.where(weight > 0.0, values, 0.0)
    normal = np.einsum("tsi,sc,tsj->tcij", basis, weight, basis) + 1e-9 * np.eye(3)
    right = np.einsum("tsi,sc->tci", basis, weight * clean)
    found = np.linalg.solve(normal, right[..., None])[..., 0]
    total = (weight * clean**2).sum()
    return total - np.einsum("tci,tci->t", right, found), found.swapaxes(1, 2)


def extract_features(track: Trajectory, onset: float | None = None) -> Features:
    """Returns the features of the motion after ``onset`` [s], which is detected unless given.

    A track with a shaken base is used from its first sample on, at which the plant must be at rest. Samples that are
    far from their neighbours are left out at first; then those that are near the curve are used, too.
    """
    suspects = _suspects(track)
    found = _features_without(track, onset, suspects)
    off = np.abs(track.position[:, track.tracked] - found.curve)
    least = max(GROSS_DEVIATIONS * found.noise, GROSS_SHARE * float(np.abs(found.displacement).max()))
    gross = suspects & (off > least)
    return found if (gross == suspects).all() else _features_without(track, onset, gross)


def _features_without(track: Trajectory, onset: float | None, gross: np.ndarray) -> Features:
    """Returns the features without the samples ``gross`` [sample, column]."""
    if track.base is not None:
        return _shaken_features(track, gross)
    if onset is None:
        found = _free_features(track, _find_onset(track, gross), gross)
        release = _find_release(track, found)
        if release == found.release:
            return found
        onset = max(release, float(track.time[0]))
    return _free_features(track, onset, gross)


def _free_features(track: Trajectory, onset: float, gross: np.ndarray) -> Features:
    """Returns the features of the damped sinusoid that fits the track best after ``onset`` [s]."""
    here = track.time >= onset
    time = track.time[here] - onset
    values = columns_of(track, gross)[here]
    duration = float(time[-1] - time[0])
    step = 1.0 / (FREQUENCIES_PER_BIN * duration)
    grid = np.arange(0.5 / duration, max(0.45 * track.rate, 1.0 / duration), step)
    best, found, off = _search(functools.partial(_basis, time), values, grid, lambda _: step, 0.05 / duration)
    return _describe(track, onset, best, found, off, gross)


def _find_release(track: Trajectory, features: Features) -> float:
    """Returns the time of the release [s]: the turning point of the sinusoid before which the track is still.

    This is the release in ``features``, unless a turning point one or more half periods earlier or later fits clearly
    better.
    """
    values = columns_of(track, features.gross)
    time = track.time
    half = 0.5 / features.frequency
    first = min(features.release, float(time[0]))
    count = int((0.5 * (time[0] + time[-1]) - first) / half)
    turn = np.arange(-1, max(count, 1) + 1)
    places = features.release + half * turn
    places = places[(turn <= 0) | (places <= time[-1] - 2.0 * half)]  # a whole period must follow a later release
    after = np.maximum(time, places[:, None]) - features.release  # [place, sample]
    wave = _wave(after, features.frequency, features.damping_ratio)
    off = values - features.rest - wave[..., None] * features.displacement
    spread = np.array([robust_deviation(column) for column in off[int(np.argmin(np.abs(places - features.release)))].T])
    loss = np.nansum(np.sqrt(1.0 + (off / np.maximum(spread, 1e-9)) ** 2) - 1.0, (1, 2))
    best = int(np.argmin(loss))
    return float(places[best]) if loss[best] < loss[1] - CLEARLY else features.release


def _wave(after: np.ndarray, frequency: float, ratio: float) -> np.ndarray:
    """Returns a damped cosine of ``frequency`` [Hz] and damping ``ratio`` at times ``after`` its maximum [s]."""
    omega = 2.0 * np.pi * frequency
    return np.exp(-ratio / math.sqrt(1.0 - ratio**2) * omega * after) * np.cos(omega * after)


def _shaken_features(track: Trajectory, gross: np.ndarray) -> Features:
    """Returns the features of the oscillator whose response to the base's motion fits the track best."""
    assert track.base is not None
    along = _direction(track.base)
    motion = SampledMotion(track.time, track.base @ along)
    base = track.base[:, np.nonzero(track.tracked)[1]]
    values = columns_of(track, gross) - base
    lowest = 0.5 / float(track.time[-1] - track.time[0])
    grid = np.exp(np.arange(math.log(lowest), math.log(max(0.45 * track.rate, 2.0 * lowest)), RELATIVE_STEP))
    basis = functools.partial(_response_basis, track.time, motion)
    best, found, off = _search(basis, values, grid, lambda frequency: RELATIVE_STEP * frequency, 0.1 * lowest)
    curves = basis(*(np.array([x]) for x in best))[0]
    return Features(
        frequency=best[0],
        damping_ratio=best[1],
        release=float(track.time[0]),
        rest=found[0],
        displacement=np.abs(curves[:, 1]).max() * found[1],
        noise=max(robust_deviation(off), 1e-9),
        column_noise=np.array([robust_deviation(column) for column in off.T]),
        explained=_explained(off, values),
        curve=base + curves @ found,
        gross=gross,
    )


def _direction(base: np.ndarray) -> np.ndarray:
    """Returns the unit vector [3] of the largest motion of a base [sample, 3]."""
    return np.linalg.svd(base, full_matrices=False)[2][0]


def _search(
    basis: Callable[[np.ndarray, np.ndarray], np.ndarray],
    values: np.ndarray,
    grid: np.ndarray,
    step_at: Callable[[float], float],
    lowest: float,
) -> tuple[tuple[float, float], np.ndarray, np.ndarray]:
    """Find the frequency and damping ratio whose curves fit ``values`` [sample, column] best.

    Args:
        basis: function of trial frequencies and damping ratios [trial] that gives curves [trial, sample, 3].
        values: positions; NaN for missing ones.
        grid: frequencies that are tried first [Hz].
        step_at: function of a frequency that gives their spacing there [Hz].
        lowest: lowest frequency that is tried [Hz].

    Returns frequency and damping ratio, coefficients [3, column], and residuals [sample, column].
    """
    weight = np.isfinite(values).astype(float)
    ratio = DAMPING_RATIOS
    best = (0.0, 0.0)
    step = 0.0
    for turn in range(7):  # each turn is finer; outliers have less weight after the first
        trials = [x.ravel() for x in np.meshgrid(grid, ratio, indexing="ij")]
        curves = basis(*trials)
        left, found = _misfit(curves, values, weight)
        at = int(np.argmin(left))
        best = (float(trials[0][at]), float(trials[1][at]))
        off = values - curves[at] @ found[at]
        noise = max(robust_deviation(off), 1e-9)
        weight = np.where(np.isfinite(off), 1.0 / np.maximum(1.0, np.abs(np.nan_to_num(off)) / (3.0 * noise)), 0.0)
        step = step_at(best[0]) if turn == 0 else 0.3 * step
        grid = np.maximum(best[0] + step * np.linspace(-1.0, 1.0, 9), lowest)
        ratio = np.clip(best[1] * np.exp(np.linspace(-1.0, 1.0, 9) * 0.9 * 0.45**turn), 1e-3, 0.6)
    return best, found[at], off


def _explained(off: np.ndarray, values: np.ndarray) -> float:
    """Returns the explained fraction [1] of the variance of ``values`` [sample, column]: the part that is not in the
    residuals ``off``."""
    moved = np.nanvar(values, axis=0).sum()
    return float(1.0 - np.nanvar(off, axis=0).sum() / max(moved, 1e-18))


def _describe(
    track: Trajectory,
    onset: float,
    best: tuple[float, float],
    found: np.ndarray,
    off: np.ndarray,
    gross: np.ndarray,
) -> Features:
    frequency, ratio = best
    rest, cosine, sine = found
    strong = int(np.argmax(np.hypot(cosine, sine)))
    phase = math.atan2(sine[strong], cosine[strong])  # phase at which the column with the largest swing has its maximum
    turning = phase - math.pi * round(phase / math.pi)
    shift = turning / (2.0 * math.pi * frequency)
    if shift > 1.5 / track.rate:  # the track begins within a swing, after the release
        shift -= 0.5 / frequency
    basis = _basis(np.array([shift]), np.array([frequency]), np.array([ratio]))[0, 0]
    wave = _basis(np.maximum(track.time - onset, shift), np.array([frequency]), np.array([ratio]))[0]
    return Features(
        frequency=frequency,
        damping_ratio=ratio,
        release=onset + shift,
        rest=rest,
        displacement=basis[1:] @ found[1:],
        noise=max(robust_deviation(off), 1e-9),
        column_noise=np.array([robust_deviation(column) for column in off.T]),
        explained=_explained(off, columns_of(track, gross)[track.time >= onset]),
        curve=wave @ found,
        gross=gross,
    )
