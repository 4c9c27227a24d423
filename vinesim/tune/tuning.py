"""Fits a plant to a track, with the function :func:`tune`. Returns fitted numbers, their uncertainty, and reasons to
distrust them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import msgspec
import numpy as np

from vinesim.core.errors import UsageError
from vinesim.scene import plausibility
from vinesim.scene.plant_parameters import Specimen
from vinesim.tune.candidates import COLUMNS
from vinesim.tune.features import Features, extract_features, robust_deviation
from vinesim.tune.fit import Fit, Minimum
from vinesim.tune.posterior import Posterior, importance_sample, laplace
from vinesim.tune.priors import physical_priors
from vinesim.tune.problem import Evaluation, Noise, Problem
from vinesim.tune.start import start_values
from vinesim.tune.trajectory import Trajectory, TrajectoryError

STEP_PHASE = 0.1
"""[rad] Phase of the first mode in one step of the simulation; the modulus error before correction is then 0.2 %."""
PARAMETERS = {"modulus": ("modulus",), "damping": ("damping",), "mass": ("mass",), "rest": ("bow_y", "bow_z")}
"""Parameters that can be fitted, and their columns in :data:`vinesim.tune.candidates.COLUMNS`."""
CONTRADICTS = 4.0
"""[standard deviations] Distance of a fitted mass from its prior beyond which it cannot be a mass of wood."""
UNFITTED = 3
"""Factor by which all candidates have more segments and steps if the modulus is not fitted."""
WIDE = 0.5
"""Width of the swing as a fraction of the plant's length [1]. A larger swing suggests a wrong unit."""
UNEXPLAINED = 1.3
"""[1] Ratio of a fit's residuals to the residuals of a damped sinusoid from which the fit has failed."""
EXACT = 3e-5
"""[m] Smallest noise of a column that a fit assumes: just after the release its simulation is no more exact."""
COLUMN_UNEXPLAINED = 1.25
"""[1] The same ratio in a single column that swings. Good fits have 0.8 to 1.1, those with a late time of release 1.5
or more, and those with a wrong unit of the positions 1.3."""
SWINGS = 0.3
"""Smallest displacement of a column that swings, relative to the column with the largest displacement [1]. Columns that
hardly swing consist of noise, whose robust deviation scatters. In a wide swing all columns move."""
FREQUENCIES_AGREE = 0.03
"""Largest relative difference between the frequencies of the fit and of the track alone [1]. Good fits of canes and
bunches differ by 0.2 % at most."""
DAMPINGS_AGREE = 0.25
"""Largest difference between the logarithms of the damping ratios of the fit and of the track alone [1], or else four
standard deviations. Good fits differ by 8 % with 2 mm of noise, by 14 % with 10 mm."""
HORIZONS = (1.0, 2.0, 4.0, 8.0)
"""[period] Growing durations after the release that are fitted if fitting the whole track at once fails."""
MINIMA = 2.0 ** np.linspace(-2.0, 2.0, 24)
"""Ratios to the best modulus at which other minima are searched."""


def tune(
    specimen: Specimen,
    track: Trajectory,
    parameters: Sequence[str] = ("modulus", "damping"),
    *,
    release: float | None = None,
    samples: int = 0,
    seed: int = 0,
    device: str = "cpu",
    pushed: bool = False,
) -> Fit:
    """Fit a specimen to a track of a pull and release, of a push, or of a shaken base.

    Args:
        specimen: the plant as far as it is known; modulus and damping may be wrong by a factor of up to 40.
        track: track of one or more markers. It may start before or after the release. With motion of the base it must
            start at rest.
        parameters: names from :data:`PARAMETERS`; empty to test the plant unchanged on another release. ``mass`` scales
            all masses equally and needs a force reading; ``rest`` is the slack shape and needs positions relative to
            the base.
        release: time of the release [s]; detected unless given.
        samples: number of random samples of the exact posterior, in addition to Laplace's approximation of it.
        seed: seed of the random samples.
        device: ``cpu``, ``cuda`` or ``cuda:N``.
        pushed: whether the track shows a push (from rest, a steady force begins to act at ``release``) instead of a
            pull and release.

    Raises :class:`~vinesim.tune.trajectory.TrajectoryError` for a track that cannot belong to the specimen, and
    :class:`~vinesim.core.errors.UsageError` for invalid parameters. A failed fit is returned, with the reasons in
    :attr:`Fit.faults`.
    """
    fitted = _columns(parameters)
    if specimen.axis and "rest" in parameters:
        raise UsageError(
            "'rest' cannot be fitted together with specimen.axis, which defines the shape; leave out one of them"
        )
    if track.base is not None and (pushed or release is not None):
        what = "push" if pushed else "release"
        raise UsageError(f"{track.source}: its base is shaken, so there is no {what}; leave out --{what}")
    if release is not None and not release < track.time[-3]:
        raise TrajectoryError(
            f"{track.source}: ends at {track.time[-1]:.4g} s, and the release at {release:g} s is not before its last "
            "samples; give an earlier --release"
        )
    features = extract_features(track, release)
    if release is not None:
        features = dataclasses.replace(features, release=release)
    _check_track(specimen, track, features)
    dt = float(np.clip(STEP_PHASE / (2.0 * math.pi * features.frequency), 5e-4, 0.01))
    chain = specimen
    coarse = "modulus" in fitted
    if not coarse:  # a coarse chain swings up to 1 % too slowly; only a fitted modulus can compensate this
        chain = msgspec.structs.replace(specimen, segments=UNFITTED * specimen.segments)
        dt = dt / UNFITTED
    problem = Problem(chain, track, features, fitted, physical_priors(specimen), dt, device, pushed)
    theta, found, noise = _minimise(problem, start_values(problem))
    minima: tuple[Minimum, ...] = ()
    if coarse:
        theta, found, noise, minima = _look_for_minima(problem, theta, found, noise)
        theta = problem.correct_discretisation(theta, noise)
        found = problem.evaluate(theta)
    posterior = laplace(problem, theta, found, noise)
    sample = importance_sample(problem, posterior, noise, samples, seed) if samples else None
    everywhere = problem.samples(theta[None], problem.row(theta)[None])[0][0]
    model = np.where(np.isfinite(track.position[:, track.tracked]), everywhere, np.nan)
    swing = _fitted_features(problem, theta, model)
    faults = (
        *_faults(problem, posterior, _left(problem, found), noise),
        *_disagreements(problem, posterior, swing),
        *_contradictions(problem, found, noise, theta),
    )
    return Fit(
        specimen=specimen,
        track=track,
        features=features,
        posterior=posterior,
        sample=sample,
        noise=_left(problem, found),
        column_noise=noise,
        frequency=swing.frequency,
        damping_ratio=swing.damping_ratio,
        model=model,
        jacobian=found.jacobian,
        minima=minima,
        faults=faults,
        dt=dt,
        force=problem.force,
        priors=dict(zip(problem.names, problem.priors, strict=True)),
    )


def _columns(parameters: Sequence[str]) -> tuple[str, ...]:
    unknown = [name for name in parameters if name not in PARAMETERS]
    if unknown:
        raise UsageError(f"{unknown[0]!r} cannot be fitted; give one or more of: {', '.join(PARAMETERS)}")
    return tuple(column for name, columns in PARAMETERS.items() if name in parameters for column in columns)


def _check_track(specimen: Specimen, track: Trajectory, features: Features) -> None:
    """Raise an error for a track that cannot belong to this plant."""
    duration = float(track.time[-1] - features.release)
    known = plausibility.RANGES["frequency"]
    if not known.low <= features.frequency <= known.high:
        raise TrajectoryError(
            f"{track.source}: swings at {features.frequency:.4g} Hz, plants at {known.low:g} to {known.high:g} Hz; "
            "correct the unit of the time (s, ms), and give times, not numbers of pictures"
        )
    shaken = track.base is not None
    if duration * features.frequency < 1.0 and not shaken:
        raise TrajectoryError(
            f"{track.source}: {duration:.2g} s after the release at {features.release:.2f} s are less than one period "
            f"of {1.0 / features.frequency:.2g} s; track longer, or give the time of the release (--release)"
        )
    reach = float(np.nanmax(np.abs(features.displacement)))
    length = specimen.length.value + 0.3 * (specimen.organ == "bunch")
    if reach > 1.5 * length:
        raise TrajectoryError(
            f"{track.source}: the swing is {reach:.3g} m wide, the plant {length:.3g} m long; correct the unit in the "
            "header (m, cm or mm) or specimen.length"
        )
    if reach < 3.0 * features.noise or features.explained < 0.3:
        remedy = "cut the track to one release, or pull further"
        if shaken:
            remedy = "sweep through the plant's first mode, or shake further"
        raise TrajectoryError(
            f"{track.source}: no swing stands out: {1e3 * reach:.3g} mm of it, {1e3 * features.noise:.3g} mm of noise; "
            f"check the unit, and that an axis of the swing has a column; {remedy}"
        )
    if reach < 0.002 * length:
        raise TrajectoryError(
            f"{track.source}: the swing is {1e3 * reach:.3g} mm wide, 0.2 % of the plant's length of {length:.3g} m; "
            "correct the unit in the header (m, cm or mm)"
        )


def _minimise(problem: Problem, theta: np.ndarray) -> tuple[np.ndarray, Evaluation, np.ndarray]:
    """Returns the parameters at the minimum near ``theta``, their evaluation, and the noise [column] m.

    If fitting the whole track at once fails, growing parts of the track are fitted one after the other.
    """
    features = problem.features
    best = _settle(problem, theta, features.noise)
    if _left(problem, best[1]) <= UNEXPLAINED * features.noise:
        return best
    grown = start_values(problem)
    for periods in HORIZONS:
        end = features.release + periods / features.frequency
        if end < problem.track.time[-1]:
            grown, _ = problem.minimise(grown, features.noise, end, 15, 1e-3)
    found = _settle(problem, grown, features.noise)
    return found if _left(problem, found[1]) < _left(problem, best[1]) else best


def _settle(problem: Problem, theta: np.ndarray, noise: Noise) -> tuple[np.ndarray, Evaluation, np.ndarray]:
    """Minimise the loss from ``theta`` on, estimate the noise [column] m from the residuals, and repeat if the weights
    change.

    Returns parameters, evaluation and noise.
    """
    for _ in range(2):
        theta, found = problem.minimise(theta, noise)
        left = np.array([max(robust_deviation(column), EXACT) for column in problem.residuals(found.model).T])
        if np.abs(np.log(left / noise)).max() < 0.3:
            break
        noise = left
    return theta, found, left


def _left(problem: Problem, found: Evaluation) -> float:
    """Returns the robust standard deviation [m] of the residuals of all columns together."""
    return max(robust_deviation(found.model - problem.observed[problem.seen]), 1e-7)


def _look_for_minima(
    problem: Problem, theta: np.ndarray, found: Evaluation, noise: np.ndarray
) -> tuple[np.ndarray, Evaluation, np.ndarray, tuple[Minimum, ...]]:
    """Scan the modulus for other minima of the loss, and move to a better one if there is one.

    Returns parameters, evaluation and noise at the best minimum, and the other minima.
    """
    at = problem.names.index("modulus")
    thetas = np.repeat(theta[None], len(MINIMA) + 1, 0)
    thetas[1:, at] += np.log(MINIMA)
    x, _ = problem.samples(thetas, np.array([problem.row(t) for t in thetas]))
    losses = np.array([problem.loss(t, y, noise) for t, y in zip(thetas, x, strict=True)])
    here = losses[0]
    scan = losses[1:]
    lower = np.flatnonzero((scan[1:-1] < scan[:-2]) & (scan[1:-1] < scan[2:])) + 1
    lower = lower[np.abs(np.log(MINIMA[lower])) > 0.1]
    if len(lower) and scan[lower].min() < here:
        start = thetas[1 + lower[np.argmin(scan[lower])]]
        other = _settle(problem, start, noise)
        if _left(problem, other[1]) < 0.95 * _left(problem, found):
            return *other, ()
    own = problem.specimen.modulus.value
    minima = [Minimum(own * math.exp(thetas[1 + i, at]), float(scan[i] / here)) for i in lower]
    return theta, found, noise, tuple(sorted(minima, key=lambda minimum: minimum.loss_ratio))


def _fitted_features(problem: Problem, theta: np.ndarray, model: np.ndarray) -> Features:
    """Returns frequency, damping and other features of the fitted plant's swing without noise, at the times of the
    track."""
    position = np.full(problem.track.position.shape, np.nan)
    position[:, problem.track.tracked] = model
    release = float(theta[problem.names.index("release")]) if problem.begins else None
    return extract_features(dataclasses.replace(problem.track, position=position), release)


def _unexplained(problem: Problem, noise: float, column_noise: np.ndarray) -> list[str]:
    """Returns the names of the columns in which the residuals of the fit are clearly larger than those of the curve,
    or "all columns", for the noise of all columns together and of each column [m]."""
    features = problem.features
    if noise > UNEXPLAINED * features.noise:
        return ["all columns"]
    size = np.abs(features.displacement)
    more = column_noise > COLUMN_UNEXPLAINED * np.maximum(features.column_noise, EXACT)
    if size.max() < WIDE * problem.specimen.length.value:
        more &= size > SWINGS * size.max()
    return [name for name, one in zip(problem.track.column_names, more, strict=True) if one]


def _faults(problem: Problem, posterior: Posterior, noise: float, column_noise: np.ndarray) -> tuple[str, ...]:
    """Returns reasons not to trust the fit; empty if there are none."""
    faults = []
    features = problem.features
    curve = "sinusoid" if problem.shaking is None else "oscillator"
    if noise > UNEXPLAINED * features.noise:
        faults.append(
            f"the residuals of the fit are {1e3 * noise:.3g} mm, those of a damped {curve} "
            f"only {1e3 * features.noise:.3g} mm: another minimum, or a plant that the specimen "
            "does not describe (length, diameters, direction, tip mass)"
        )
    elif columns := _unexplained(problem, noise, column_noise):
        at = problem.track.column_names.index(columns[0])
        faults.append(
            f"the residuals of the fit in {columns[0]} are {1e3 * column_noise[at]:.3g} mm, those of a damped {curve} "
            f"only {1e3 * features.column_noise[at]:.3g} mm: check the unit of the positions, the axes (z is up), the "
            "time of the release (--release), and whether it is a pull or a push (--push)"
        )
    if posterior.correlation_time > 4.0:
        faults.append(
            f"neighbouring residuals are correlated over {posterior.correlation_time:.1f} samples: the model misses "
            "some of the motion (a second plane or mode, a slipping clamp, wind)"
        )
    for name, (low, high) in {"modulus": (-3.7, 3.7), "damping": (-5.0, 5.0)}.items():
        if name in problem.names and not low < posterior.mean[problem.names.index(name)] < high:
            faults.append(f"{name} is {math.exp(posterior.mean[problem.names.index(name)]):.3g} times its start value")
    assert set(problem.fitted) <= set(COLUMNS)
    return tuple(faults)


def _disagreements(problem: Problem, posterior: Posterior, swing: Features) -> list[str]:
    """Returns sentences about a frequency or damping ratio of the track alone that the fitted plant does not
    have."""
    own = problem.features
    faults = []
    if abs(math.log(swing.frequency / own.frequency)) > FREQUENCIES_AGREE:
        faults.append(
            f"the fitted plant swings at {swing.frequency:.4g} Hz, the track alone at {own.frequency:.4g} Hz: check "
            "the unit of the time, the axes of the columns (z is up), and length, diameters and masses of the plant"
        )
    if "damping" in problem.fitted:
        deviation = float(posterior.deviation[problem.names.index("damping")])
        differ = abs(math.log(swing.damping_ratio / own.damping_ratio))
        if differ > max(DAMPINGS_AGREE, 4.0 * deviation):
            faults.append(
                f"the damping ratio of the fitted plant is {swing.damping_ratio:.4f}, that of the track alone "
                f"{own.damping_ratio:.4f}: check the time of the release (--release), and that the track has one swing"
            )
    return faults


def _contradictions(problem: Problem, found: Evaluation, noise: np.ndarray, theta: np.ndarray) -> list[str]:
    """Returns sentences about numbers given by the user, other than the track, that contradict the fit."""
    faults = []
    features = problem.features
    specimen = problem.specimen
    reach = float(np.abs(features.displacement).max())
    length = specimen.length.value
    failed = bool(_unexplained(problem, _left(problem, found), noise))
    if reach > WIDE * length and failed:
        faults.append(f"the swing is {reach:.3g} m wide, the plant {length:.3g} m long: is the unit right (m, cm, mm)?")
    if problem.force is not None and "mass" not in problem.names and failed:
        faults.append(
            f"the gauge showed {problem.force[0]:.3g} N, which such a mass may not allow: check unit and zero of the "
            "gauge, density and diameters; or fit the mass (--fit modulus,damping,mass), or remove the column"
        )
    if "mass" in problem.names:
        at = problem.names.index("mass")
        prior = problem.priors[at]
        if abs(theta[at] - prior.mean) > CONTRADICTS * prior.deviation:
            faults.append(
                f"the mass is {math.exp(theta[at]):.3g} times that of the specimen, which wood cannot have: check unit "
                "and zero of the force, and the diameters"
            )
    return faults
