"""The least-squares problem of a fit: parameters of a plant and of the experiment, residuals of a track, their
derivatives.

The Jacobian is computed by central differences of candidates that run in parallel in one launch. So a residual vector
and its Jacobian cost one simulation of about nine trees (docs/decisions/tuning.md).
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import msgspec
import numpy as np
from scipy.optimize import least_squares

from vinesim.scene.plant_parameters import Specimen
from vinesim.tune.base_motion import SampledMotion
from vinesim.tune.candidates import COLUMNS, Candidates
from vinesim.tune.features import Features, columns_of
from vinesim.tune.priors import Prior
from vinesim.tune.trajectory import Trajectory, TrajectoryError

PHYSICAL = COLUMNS[:5]
SOFT = 3.0
"""[standard deviations] Size from which residuals have reduced weight (soft L1)."""
FINER = 9
"""Factor by which the finer run that determines the discretisation bias has more steps and segments."""
CORRECTIONS = 4
"""Number of rounds in which this bias is determined. It is 5 % of a bunch's modulus, and one round leaves 0.6 %. With
both numbers 0.01 % remains; 3 and 2 left 0.1 % of a bunch's modulus and 0.2 % of its damping."""
Noise = float | np.ndarray
"""[m] Standard deviation of all columns together, or of each column [column]."""
PHASE_STEP = 0.05
"""Change of phase at the end of the track that the finite differences by modulus and mass cause [rad]."""


@dataclasses.dataclass(frozen=True, slots=True)
class Evaluation:
    """Simulated track and its derivatives for one set of parameters."""

    model: np.ndarray
    """Positions of the simulated markers [observation] m."""
    jacobian: np.ndarray
    """Derivatives of ``model`` by the parameters [observation, parameter] m."""
    extra: np.ndarray
    """[row] Residuals of force reading and priors, in standard deviations."""
    extra_jacobian: np.ndarray
    """Derivatives of ``extra`` by the parameters [row, parameter]."""


class Problem:
    """Residuals of a track as a function of parameters.

    Args:
        specimen: the plant with the user's numbers.
        track: the measured track.
        features: features of the track.
        fitted: names of the fitted parameters among :data:`PHYSICAL`.
        priors: priors of the fitted parameters, by name.
        dt: step of the simulation [s].
        device: ``cpu``, ``cuda`` or ``cuda:N``.
        pushed: the plant starts at rest, and a steady force begins to act at the release.

    If the track contains the motion of a shaken base, there is no pull and no release: the plant starts at rest.
    """

    def __init__(
        self,
        specimen: Specimen,
        track: Trajectory,
        features: Features,
        fitted: tuple[str, ...],
        priors: dict[str, Prior],
        dt: float,
        device: str = "cpu",
        pushed: bool = False,
    ) -> None:
        self.specimen = specimen
        self.track = track
        self.features = features
        self.fitted = fitted
        self._device = device
        self.pushed = pushed
        self.candidates = Candidates(specimen, track.markers, dt=dt, device=device, least=9)
        self.observed = columns_of(track, features.gross)
        self.seen = np.isfinite(self.observed)
        self.axes = np.flatnonzero(track.tracked.any(0))
        tips = self.candidates.pull_axes()[:, self.axes]
        self.shaking = None if track.base is None else SampledMotion(track.time, track.base)
        pulls = tuple(name for name, way in zip(COLUMNS[5:], tips, strict=True) if np.linalg.norm(way) > 0.3)
        self.pulls = pulls if self.shaking is None else ()
        self.begins = ("release",) if self.shaking is None else ()
        """Name of the parameter for the time at which the motion begins; empty if the base is shaken."""
        free = "bow_y" not in fitted and "bow_z" not in fitted
        self.origins = tuple(f"origin_{'xyz'[axis]}" for axis in self.axes) if free else ()
        self.names = (*fitted, *self.pulls, *self.begins, *self.origins)
        self.simulated = tuple(name for name in self.names if name in COLUMNS)
        turn = max(2.0 / track.rate, 0.1 / features.frequency)
        flat = Prior(0.0, math.inf, "flat")
        known = priors | {"release": Prior(features.release, turn, "onset of the motion")}
        self.priors = [known.get(name, flat) for name in self.names]
        self.force = _force_reading(track, features.release, pushed)
        if track.force is not None and self.force is None and _force_reading(track, features.release, not pushed):
            when, remedy = ("before", "leave out --push") if pushed else ("after", "give --push")
            raise TrajectoryError(
                f"{track.source}: 'force' has readings above 0 only {when} {features.release:.2f} s, where the motion "
                f"begins, as of a {'pull' if pushed else 'push'}; {remedy}"
            )
        if track.force is not None and self.force is None and "mass" in fitted:
            when = "after the push" if pushed else f"before the release at {features.release:.2f} s"
            raise TrajectoryError(
                f"{track.source}: 'force' has no reading above 0 {when}; give the pull that held the tip, "
                "or do not fit the mass"
            )
        self.pull_scale = 1.0
        """[N] Magnitude of the pull, for the step of its finite difference."""
        self.evaluations = 0
        self.shift = np.zeros(len(self.names))
        """[parameter] Bias of the coarse candidates; see :meth:`correct_discretisation`."""

    # ------------------------------------------------------------------ parameters

    def row(self, theta: np.ndarray) -> np.ndarray:
        """Returns the candidate [7], a row of :data:`vinesim.tune.candidates.COLUMNS`, for the parameters ``theta``
        [parameter]."""
        theta = theta + self.shift
        candidate = np.zeros(len(COLUMNS))
        candidate[3:5] = self.specimen.bow
        for name in self.simulated:
            candidate[COLUMNS.index(name)] = theta[self.names.index(name)]
        return candidate

    def step(self, name: str) -> float:
        """Returns the step of the central difference by the parameter ``name``."""
        if name in ("modulus", "mass"):
            swing = math.pi * self.features.frequency * max(self.track.time[-1] - self.features.release, 0.2)
            by_weight = 4.0 if self.specimen.organ == "bunch" else 1.0  # a bunch's modulus changes the frequency less
            return min(0.1, 2.0 * by_weight * PHASE_STEP / swing)
        return {"damping": 0.1, "bow_y": 0.01, "bow_z": 0.01}.get(name, 0.05 * self.pull_scale)

    # ------------------------------------------------------------------ model

    def samples(
        self, thetas: np.ndarray, candidates: np.ndarray, end: float = math.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions and velocities [n, sample, column] of ``candidates`` [n, 7] at the samples up to ``end``
        [s].

        ``thetas`` [n, parameter] contain the release and the origin of each candidate.
        """
        thetas = thetas + self.shift
        time = self.track.time[self.track.time <= end]
        release = self._release(thetas)
        after = np.maximum(time - release.mean(), 0.0)
        tick = np.floor(after / self.candidates.dt + 1e-6).astype(int)
        ticks, index = np.unique(tick, return_inverse=True)
        motion = self.candidates.run(candidates, ticks, self.pushed, self._base_velocity(int(ticks[-1])))
        begun = time > release[:, None]
        offset = np.where(begun, time - release[:, None] - tick * self.candidates.dt, 0.0)
        position, velocity = motion.at(index, offset)
        velocity = velocity * begun[..., None, None]
        x, v = (rows[:, :, self.track.tracked] for rows in (position, velocity))
        if self.track.base is not None:
            x = x + self.track.base[: len(time), np.nonzero(self.track.tracked)[1]]
        return x + self._origin(thetas)[:, None], v

    def _release(self, thetas: np.ndarray) -> np.ndarray:
        """Returns the time at which the motion of each candidate begins [n] s."""
        if not self.begins:
            return np.full(len(thetas), self.track.time[0])
        return thetas[:, self.names.index("release")]

    def _base_velocity(self, last: int) -> np.ndarray | None:
        """Returns the velocity of the shaken base at ticks 0 to ``last`` + 1: [tick, 3] m/s; None if the base is not
        shaken.

        ``last``: last tick at which the simulated motion is compared with the track.
        """
        if self.shaking is None:
            return None
        return self.shaking.velocity(self.track.time[0] + self.candidates.dt * np.arange(last + 2))

    def correct_discretisation(self, theta: np.ndarray, noise: Noise) -> np.ndarray:
        """Determine the bias that coarse segments and steps cause in a fit whose minimum is ``theta``. Returns
        ``theta`` without the bias.

        Coarse candidates are fitted to the track of one candidate with finer segments and steps at known parameters.
        The difference between the result and the known parameters is the bias, of second order in segment length and
        step. The first round knows only ``theta``; later rounds determine the bias at the corrected parameters. After
        this call :meth:`row` and :meth:`samples` add the bias to their parameters.
        """
        coarse = self.candidates
        finer = Candidates(
            msgspec.structs.replace(self.specimen, segments=FINER * self.specimen.segments),
            self.track.markers,
            dt=coarse.dt / FINER,
            device=self._device,
        )
        shift = np.zeros(len(theta))
        for _ in range(CORRECTIONS):
            self.candidates = finer
            known = theta - shift
            fine, _ = self.samples(known[None], self.row(known)[None])
            self.candidates = coarse
            biased = self._fit_to(fine[0], known, theta, noise)
            shift = (biased - known) * FINER**2 / (FINER**2 - 1.0)
        self.shift = shift
        return theta - shift

    def _fit_to(self, positions: np.ndarray, known: np.ndarray, start: np.ndarray, noise: Noise) -> np.ndarray:
        """Returns the parameters of the coarse candidate that is nearest to the simulated ``positions`` [sample,
        column] of the parameters ``known``. The search begins at ``start``."""
        own = self.observed, self.priors, self.force
        self.observed = np.where(self.seen, positions, np.nan)
        self.priors = [dataclasses.replace(p, mean=float(m)) for p, m in zip(own[1], known, strict=True)]
        if self.force is not None:
            reading, deviation = self.force
            self.force = (deviation * float(self._extra(known)[0][-1]) + reading, deviation)
        found, _ = self.minimise(start, noise)
        self.observed, self.priors, self.force = own
        return found

    def _origin(self, thetas: np.ndarray) -> np.ndarray:
        """Returns the origin that is added to simulated positions, in the columns of the track: [n, column] m. It is 0
        unless it is fitted. ``thetas`` [n, parameter]: parameters of each candidate."""
        axis = np.nonzero(self.track.tracked)[1]
        if not self.origins:
            return np.zeros((len(thetas), len(axis)))
        first = self.names.index(self.origins[0])
        return thetas[:, first + np.searchsorted(self.axes, axis)]

    def evaluate(self, theta: np.ndarray, end: float = math.inf) -> Evaluation:
        """Returns model, Jacobian and extra rows at the parameters ``theta``, for the samples up to ``end`` [s]."""
        self.evaluations += 1
        base = self.row(theta)
        steps = [self.step(name) for name in self.simulated]
        rows = [base]
        for name, h in zip(self.simulated, steps, strict=True):
            for sign in (h, -h):
                changed = base.copy()
                changed[COLUMNS.index(name)] += sign
                rows.append(changed)
        x, v = self.samples(np.repeat(theta[None], len(rows), 0), np.array(rows), end)
        seen = self.seen[: x.shape[1]]
        jacobian = np.zeros((int(seen.sum()), len(self.names)))
        for i, (name, h) in enumerate(zip(self.simulated, steps, strict=True)):
            jacobian[:, self.names.index(name)] = ((x[1 + 2 * i] - x[2 + 2 * i]) / (2.0 * h))[seen]
        for name in self.begins:
            jacobian[:, self.names.index(name)] = -v[0][seen]
        axis = np.broadcast_to(np.nonzero(self.track.tracked)[1], seen.shape)[seen]
        for i, name in enumerate(self.origins):
            jacobian[:, self.names.index(name)] = axis == self.axes[i]
        return Evaluation(x[0][seen], jacobian, *self._extra(theta))

    def _extra(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the residuals [row] of the force reading and the priors, in standard deviations, and their
        derivatives [row, parameter]."""
        values = []
        rows = []
        for i, prior in enumerate(self.priors):
            if math.isfinite(prior.deviation):
                values.append((theta[i] - prior.mean) / prior.deviation)
                rows.append(np.eye(len(theta))[i] / prior.deviation)
        if self.force is not None:
            at = [self.names.index(name) for name in self.pulls]
            stiff = math.exp(theta[self.names.index("modulus")]) if "modulus" in self.names else 1.0
            pull = float(np.linalg.norm(theta[at]))
            row = np.zeros(len(theta))
            row[at] = stiff * theta[at] / max(pull, 1e-12)
            if "modulus" in self.names:
                row[self.names.index("modulus")] = stiff * pull
            reading, deviation = self.force
            values.append((stiff * pull - reading) / deviation)
            rows.append(row / deviation)
        return np.array(values), np.array(rows).reshape(len(values), len(theta))

    # ------------------------------------------------------------------ minimum

    def minimise(
        self, theta: np.ndarray, noise: Noise, end: float = math.inf, most: int = 30, tolerance: float = 1e-5
    ) -> tuple[np.ndarray, Evaluation]:
        """Minimise the loss from ``theta`` on, for a ``noise`` [m] and the samples up to ``end`` [s].

        Returns the parameters and their evaluation.
        """
        known: dict[bytes, Evaluation] = {}
        table = self.observed[: int((self.track.time <= end).sum())]
        data = table[np.isfinite(table)]
        noise = np.broadcast_to(noise, table.shape)[np.isfinite(table)]

        def at(point: np.ndarray) -> Evaluation:
            key = point.tobytes()
            if key not in known:
                known[key] = self.evaluate(point, end)
            return known[key]

        def residuals(point: np.ndarray) -> np.ndarray:
            found = at(point)
            return np.concatenate([(found.model - data) / noise, found.extra])

        def jacobian(point: np.ndarray) -> np.ndarray:
            found = at(point)
            return np.concatenate([found.jacobian / noise[:, None], found.extra_jacobian])

        soft = np.arange(len(data) + len(at(theta).extra)) < len(data)

        def loss(z: np.ndarray) -> np.ndarray:
            root = np.sqrt(1.0 + z)
            rows = np.array([2.0 * (root - 1.0), 1.0 / root, -0.5 / root**3])
            return np.where(soft, rows, np.array([z, np.ones_like(z), np.zeros_like(z)]))

        options: Any = {"jac": jacobian, "loss": loss}  # scipy's stubs accept only names
        found = least_squares(
            residuals,
            theta,
            method="trf",
            x_scale=self._scales(),
            f_scale=SOFT,
            max_nfev=most,
            ftol=tolerance,
            xtol=1e-6,
            gtol=1e-8,
            **options,
        )
        return found.x, at(found.x)

    def residuals(self, model: np.ndarray) -> np.ndarray:
        """Returns the residuals [sample, column] m of a model [observation] m; NaN where there are no data."""
        table = np.full(self.observed.shape, np.nan)
        table[self.seen] = model - self.observed[self.seen]
        return table

    def loss(self, theta: np.ndarray, positions: np.ndarray, noise: Noise, weight: Noise = 1.0) -> float:
        """Returns the loss that :meth:`minimise` minimises, for positions [sample, column], including priors and
        force. ``weight``: factor on the loss of all columns, or of each [column]."""
        z = ((positions - self.observed) / noise / SOFT) ** 2
        losses = SOFT**2 * (np.sqrt(1.0 + z) - 1.0) * weight
        return float(losses[self.seen].sum() + 0.5 * (self._extra(theta)[0] ** 2).sum())

    def _scales(self) -> np.ndarray:
        """Returns typical changes of the parameters [parameter], which scale the minimisation."""
        sizes = {"release": 0.5 / self.track.rate, "modulus": 0.1, "damping": 0.3, "mass": 0.1}
        sizes |= dict.fromkeys(("bow_y", "bow_z"), 0.1) | dict.fromkeys(self.pulls, 0.2 * self.pull_scale)
        return np.array([sizes.get(name, 0.02) for name in self.names])


def _force_reading(track: Trajectory, release: float, pushed: bool) -> tuple[float, float] | None:
    """Returns the mean [N] of the pull before the release, or of the push after it, and its standard deviation, at
    least 1 %.

    None if the track has no force.
    """
    if track.force is None:
        return None
    held = track.force[((track.time <= release) ^ pushed) & np.isfinite(track.force)]
    held = held[held > 0.0]
    if len(held) == 0:
        return None
    mean = float(np.median(held))
    return mean, max(float(np.std(held)) / math.sqrt(len(held)), 0.01 * mean)
