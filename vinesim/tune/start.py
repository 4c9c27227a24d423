"""Start values for least squares: the modulus with which a candidate has the track's frequency, and the damping.

Least squares on a long track has many minima, in which the candidate is whole cycles off. A comparison of frequencies
has only one minimum.
"""

from __future__ import annotations

import math

import numpy as np

from vinesim.tune.candidates import COLUMNS
from vinesim.tune.features import Features
from vinesim.tune.problem import Problem

RATIOS = np.exp(np.linspace(-math.log(40.0), math.log(40.0), 8))
"""Ratios of the tried moduli to the specimen's own modulus."""
SCAN_DAMPING_RATIO = 0.04


def start_values(problem: Problem) -> np.ndarray:
    """Returns parameters from which least squares converges, whatever the specimen's own modulus and damping are."""
    features = problem.features
    theta = np.zeros(len(problem.names))
    at = {name: i for i, name in enumerate(problem.names)}
    for name in problem.begins:
        theta[at[name]] = features.release
    for name in ("bow_y", "bow_z"):
        if name in at:
            theta[at[name]] = problem.specimen.bow["yz".index(name[-1])]
    for turn in range(2):
        _start_pull(problem, theta, at)
        if turn == 0:
            modulus, damping = _scan(problem, theta, features)
            if "modulus" in at:
                theta[at["modulus"]] = modulus
            if "damping" in at:
                theta[at["damping"]] = damping
    return theta


def _start_pull(problem: Problem, theta: np.ndarray, at: dict[str, int]) -> None:
    """Set the pull that displaces the markers as at the start of the track, and the resulting origin."""
    unit = _unit_pull(problem)
    base = problem.row(theta)
    base[5:] = 0.0
    rows = np.repeat(base[None], 1 + len(problem.pulls), 0)
    for i, name in enumerate(problem.pulls):
        rows[1 + i, COLUMNS.index(name)] = unit
    shape = problem.candidates.shape(rows)[:, problem.track.tracked]
    response = (shape[1:] - shape[0]) / unit  # [pull, column]
    way = -1.0 if problem.pushed else 1.0  # at the start, a pushed plant is displaced against the force
    pull = np.zeros(0)
    if problem.pulls:
        pull = np.linalg.lstsq(response.T, way * problem.features.displacement, rcond=None)[0]
    for name, value in zip(problem.pulls, pull, strict=True):
        theta[at[name]] = value
    problem.pull_scale = max(float(np.linalg.norm(pull)), 1e-3 * unit)
    axis = np.nonzero(problem.track.tracked)[1]
    for i, name in enumerate(problem.origins):
        rest = shape[0] + (pull @ response if problem.pushed else 0.0)
        theta[at[name]] = (problem.features.rest - rest)[axis == problem.axes[i]].mean()


def _unit_pull(problem: Problem) -> float:
    """Returns the force [N] that moves the tip of a cane without taper by a tenth of its length."""
    specimen = problem.specimen
    radius = 0.5 * specimen.base_diameter.value
    return 0.1 * 3.0 * specimen.modulus.value * math.pi * radius**4 / 4.0 / specimen.length.value**2


def _scan(problem: Problem, theta: np.ndarray, features: Features) -> tuple[float, float]:
    """Returns the logarithms of the ratios of modulus and damping to the specimen's with which a candidate has the
    track's frequency and decay.

    They are found from free swings after the pull of ``theta``, or after any pull if the base was shaken.
    """
    own = problem.specimen.damping.value
    base = problem.row(theta)
    base[1] = math.log(SCAN_DAMPING_RATIO / (math.pi * features.frequency) / own)
    if problem.shaking is not None:
        base[5:] = 0.5 * _unit_pull(problem)
    rows = np.repeat(base[None], len(RATIOS), 0)
    if "modulus" in problem.names:
        rows[:, 0] = np.log(RATIOS)
    duration = min(max(6.0 / features.frequency, 1.0), 4.0)
    stride = 2
    ticks = np.arange(0, int(duration / problem.candidates.dt), stride)
    motion = problem.candidates.run(rows, ticks, problem.pushed).position[:, :, problem.track.tracked].astype(float)
    strongest = int(np.argmax(np.abs(features.displacement)))
    swing = motion[:, :, strongest] - motion[:, :, strongest].mean(1, keepdims=True)
    frequency = _peak_frequency(swing, stride * problem.candidates.dt)
    if "modulus" not in problem.names:
        modulus = 0.0
    else:
        order = np.argsort(frequency)
        modulus = float(np.interp(math.log(features.frequency), np.log(frequency[order]), rows[order, 0]))
    near = int(np.argmin(np.abs(rows[:, 0] - modulus)))
    ratio = _decay(swing[near], stride * problem.candidates.dt) / (2.0 * math.pi * frequency[near])
    # the damping ratio grows with frequency, so it is converted to the track's frequency
    ratio = max(ratio * features.frequency / frequency[near], 0.2 * SCAN_DAMPING_RATIO)
    return modulus, base[1] + math.log(max(features.damping_ratio, 1e-3) / ratio)


def _peak_frequency(swing: np.ndarray, step: float) -> np.ndarray:
    """Returns the frequency [row] Hz of the strongest spectral line of signals [row, sample]."""
    count = swing.shape[1]
    padded = 8 * count
    power = np.abs(np.fft.rfft(swing * np.hanning(count), padded, axis=1))
    peak = np.clip(power.argmax(1), 1, power.shape[1] - 2)
    row = np.arange(len(swing))
    left, middle, right = (np.log(power[row, peak + k] + 1e-30) for k in (-1, 0, 1))
    curve = np.minimum(left - 2.0 * middle + right, -1e-9)
    return (peak + 0.5 * (left - right) / curve) / (padded * step)


def _decay(swing: np.ndarray, step: float) -> float:
    """Returns the decay rate [1/s] of the amplitude of a signal [sample], from the energies of its two halves."""
    half = len(swing) // 2
    first, second = (float((part**2).sum()) for part in (swing[:half], swing[half : 2 * half]))
    return max(math.log(max(first, 1e-18) / max(second, 1e-18)), 1e-3) / (2.0 * half * step)
