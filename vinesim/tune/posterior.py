"""Laplace's approximation of the posterior, the directions that the data do not determine, and importance
resampling."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy.special import stdtrit

from vinesim.tune.problem import SOFT, Evaluation, Problem

Z90 = 1.6448536269514722
"""Number of standard deviations from the mean of a normal distribution to either end of its 90 % interval."""
DECIDED = 3.0
"""Ratio of the data's information (1 / variance) along a direction to the prior's from which the data determine the
direction [1]."""
LEVERAGE_ROUNDS = 3
"""Number of rounds in which the degrees of freedom of the columns and the covariance are computed from each other."""
_CORRELATED = 3.0
BENDS = (2, 3, 4, 5)
"""Degrees of the polynomials (Legendre's, of the displacement) whose sum is a tracker's systematic error. Degrees 0 and
1 do no harm: origin and pull are fitted."""


@dataclasses.dataclass(frozen=True, slots=True)
class Ridge:
    """A direction of the fitted parameters that the data hardly determine."""

    direction: dict[str, float]
    """Unit vector: change of each parameter along the direction (logarithms; rad for bows)."""
    information: float
    """[1] Ratio of the data's information along the direction to the prior's."""


@dataclasses.dataclass(frozen=True, slots=True)
class Posterior:
    """A normal distribution of all parameters of a fit around the best parameters."""

    names: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray
    """[parameter, parameter] of noise and systematic errors together."""
    systematic: np.ndarray
    """[parameter, parameter] The part of the covariance that comes from systematic errors of the tracker."""
    physical: int
    """Number of parameters that describe the plant. These are the first ones; the remaining parameters describe the
    experiment."""
    ridges: tuple[Ridge, ...]
    correlation_time: float
    """Correlation time of the residuals in samples, 1 if they are independent. Its square root widens the intervals."""
    freedom: np.ndarray
    """[parameter] Degrees of freedom of the estimated noise (Satterthwaite 1946). The intervals are those of Student's
    t distribution."""
    weight: np.ndarray
    """[column] Factor on the loss of a column with which the loss has the curvature of this distribution [1]."""

    @property
    def deviation(self) -> np.ndarray:
        """[parameter] Standard deviation of each parameter."""
        return np.sqrt(np.diag(self.covariance))

    def interval(self, name: str) -> tuple[float, float]:
        """Returns the 90 % interval of one parameter."""
        i = self.names.index(name)
        half = float(stdtrit(self.freedom[i], 0.95)) * float(self.deviation[i])
        return float(self.mean[i]) - half, float(self.mean[i]) + half


def laplace(problem: Problem, theta: np.ndarray, found: Evaluation, noise: np.ndarray) -> Posterior:
    """Returns the posterior around a minimum ``theta`` with the evaluation ``found``, for a ``noise`` [column] m.

    The covariance is that of an M-estimator (Huber 1981) with the soft L1 loss, so outliers and heavy tails widen it.
    The spread of the residuals is estimated for each column, since usually one column determines the plant. Correlated
    residuals count as a smaller number of independent residuals. An error of the tracker that depends on the
    displacement widens the intervals as far as the residuals show it.
    """
    table = problem.residuals(found.model) / noise
    correlation_time = _correlation_time(table)
    slope, squares, count = _residual_sums(table)
    weighted = np.zeros((*table.shape, len(theta)))
    weighted[problem.seen] = found.jacobian
    weighted /= noise[:, None]
    information = np.einsum("scp,scq->cpq", weighted, weighted) / correlation_time
    readings = sum(math.isfinite(prior.deviation) for prior in problem.priors)
    gauge = found.extra_jacobian[readings:].T @ found.extra_jacobian[readings:]  # rows of the force reading
    prior = np.array([1.0 / p.deviation**2 for p in problem.priors])  # 0 without prior knowledge
    fitted = np.zeros(len(count))  # number of parameters that each column determines
    for _ in range(LEVERAGE_ROUNDS):
        columns = (slope**2 * np.maximum(count - fitted, 1.0) / squares)[:, None, None] * information
        covariance = _inverse(columns.sum(0) + gauge + np.diag(prior))
        fitted = np.einsum("pq,cqp->c", covariance, columns)
    parts = np.einsum("ip,cpq,qi->ci", covariance, columns, covariance)
    spread = squares / np.maximum(count - fitted, 1.0) / slope**2  # variance of a residual, in those of the noise
    bent = _systematic_covariance(problem, found, weighted, table, spread, covariance, columns, information)
    covariance = covariance + bent.sum(0)
    parts = np.concatenate([parts, np.einsum("cii->ci", bent)])
    few = np.concatenate([np.maximum(count - fitted, 1.0), np.full(len(count), float(len(BENDS) - 1))])
    freedom = parts.sum(0) ** 2 / np.maximum((parts**2 / few[:, None]).sum(0), 1e-300)
    return Posterior(
        problem.names,
        theta.copy(),
        covariance,
        bent.sum(0),
        len(problem.fitted),
        _ridges(problem, columns.sum(0) + gauge, prior),
        correlation_time,
        np.maximum(freedom, 1.0),
        slope * np.maximum(count - fitted, 1.0) / squares / correlation_time,
    )


def _systematic_covariance(
    problem: Problem,
    found: Evaluation,
    weighted: np.ndarray,
    table: np.ndarray,
    spread: np.ndarray,
    covariance: np.ndarray,
    columns: np.ndarray,
    information: np.ndarray,
) -> np.ndarray:
    """Returns the covariance [column, parameter, parameter] that the tracker's systematic errors add.

    A systematic error is a polynomial of the displacement. A fit hides a part of it in its parameters, since such an
    error of odd degree looks like a swing that decays faster. The part that it leaves in the residuals of a column
    tells the variance of the coefficients, and thereby of the hidden part.

    Args:
        problem: the fit.
        found: its evaluation at the minimum.
        weighted: Jacobian [sample, column, parameter] in units of the noise.
        table: residuals [sample, column] in units of the noise.
        spread: variance of a residual in each column, in those of the noise.
        covariance: [parameter, parameter] without systematic errors.
        columns: information of each column [column, parameter, parameter].
        information: the same before it was scaled by the spread of the residuals.
    """
    model = problem.residuals(found.model) + problem.observed
    off = np.nan_to_num(model - np.nanmean(model, axis=0))
    along = off @ np.linalg.svd(off, full_matrices=False)[2][0]
    bends = np.polynomial.legendre.legvander(along / max(float(np.abs(along).max()), 1e-12), max(BENDS))[:, list(BENDS)]
    added = np.zeros_like(columns)
    for c in range(len(columns)):
        seen = np.isfinite(table[:, c])
        jacobian, shape = weighted[seen, c], bends[seen]
        left = np.clip(table[seen, c], -SOFT, SOFT)
        size = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12)
        basis, values, _ = np.linalg.svd(jacobian / size, full_matrices=False)
        basis = basis[:, values > 1e-6 * values[0]]
        shown = shape - basis @ (basis.T @ shape)  # the part of each polynomial that no parameter hides
        known = np.linalg.pinv(shown.T @ shown, rcond=1e-9, hermitian=True)
        coefficient = known @ (shown.T @ left)
        noise = np.maximum(np.diag(known) * spread[c], 1e-300)
        variance = float(((coefficient**2 - noise) / noise**2).sum() / (1.0 / noise**2).sum())
        if variance > 0.0:
            scale = float(np.trace(columns[c]) / max(float(np.trace(information[c])), 1e-300))
            moved = scale * covariance @ (jacobian.T @ shape)
            added[c] = variance * moved @ moved.T
    return added


def _residual_sums(table: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns of each column of residuals [sample, column] in standard deviations: the mean second derivative of the
    soft L1 loss, the sum of its squared first derivatives, and the number of residuals, each [column]."""
    z = (table / SOFT) ** 2
    count = np.isfinite(table).sum(0).astype(float)
    squares = np.nansum(table**2 / (1.0 + z), axis=0)
    return np.nansum((1.0 + z) ** -1.5, axis=0) / count, np.maximum(squares, 1e-12 * count), count


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Returns the pseudoinverse of a symmetric matrix whose rows have different units."""
    size = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    return np.linalg.pinv(matrix * size * size[:, None], rcond=1e-12, hermitian=True) * size * size[:, None]


def _correlation_time(residuals: np.ndarray) -> float:
    """Returns the number of correlated samples that carry as much information as one independent sample.

    ``residuals`` [sample, column] are in standard deviations. The result is 1 unless neighbours are clearly correlated.
    """
    table = np.clip(residuals, -SOFT, SOFT)
    pairs = table[:-1] * table[1:]
    count = int(np.isfinite(pairs).sum())
    if count < 10:
        return 1.0
    rho = float(np.nanmean(pairs) / np.nanmean(table**2))
    return (1.0 + rho) / (1.0 - rho) if rho > _CORRELATED / math.sqrt(count) and rho < 0.99 else 1.0


def _ridges(problem: Problem, data: np.ndarray, prior: np.ndarray) -> tuple[Ridge, ...]:
    """Returns the directions of the plant's parameters, in units of their priors, that the data do not determine."""
    k = len(problem.fitted)
    if k == 0:
        return ()
    rest = data[k:, k:] + np.diag(prior[k:])
    cross = data[:k, k:]
    alone = data[:k, :k] - cross @ np.linalg.pinv(rest, rcond=1e-12, hermitian=True) @ cross.T
    width = 1.0 / np.sqrt(prior[:k])
    values, vectors = np.linalg.eigh(alone * width * width[:, None])
    ridges = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value < DECIDED:
            way = vector * width
            way /= np.linalg.norm(way) * (1.0 if way[np.argmax(np.abs(way))] > 0.0 else -1.0)
            named = {name: float(x) for name, x in zip(problem.fitted, way, strict=True) if abs(x) > 0.05}
            ridges.append(Ridge(named, max(float(value), 0.0)))
    return tuple(ridges)


@dataclasses.dataclass(frozen=True, slots=True)
class Sample:
    """Random samples of the exact posterior, from samples of a proposal distribution by importance resampling."""

    draws: np.ndarray
    """[n, parameter] Sampled parameters; all samples have equal weights."""
    effective: float
    """[1] Effective number of independent samples (Kish)."""


def importance_sample(
    problem: Problem, posterior: Posterior, noise: np.ndarray, count: int, seed: int = 0, batch: int = 64
) -> Sample:
    """Sample the exact posterior: sample ``count`` parameter sets at random from a proposal distribution, simulate
    them, and resample them with the weights posterior / proposal.

    The proposal is a Student t distribution with five degrees of freedom and the mean and covariance of ``posterior``
    without systematic errors. These are not in the likelihood: each sample is moved by one of them at the end.
    ``noise``: [column] standard deviation of the track [m]. ``seed``: seed of the random numbers. ``batch``: number of
    parameter sets that are simulated at once.
    """
    rng = np.random.default_rng(seed)
    size = len(posterior.mean)
    independent = posterior.covariance - posterior.systematic
    root = np.linalg.cholesky(independent + 1e-15 * np.diag(np.diag(independent)))
    freedom = 5.0
    normal = rng.normal(size=(count, size))
    stretch = np.sqrt(freedom / rng.chisquare(freedom, count))
    thetas = posterior.mean + (normal * stretch[:, None]) @ root.T
    distance = (normal**2).sum(1) * stretch**2
    log_weight = 0.5 * (freedom + size) * np.log1p(distance / freedom)
    for first in range(0, count, batch):
        some = thetas[first : first + batch]
        rows = np.array([problem.row(theta) for theta in some])
        x, _ = problem.samples(some, rows)
        log_weight[first : first + batch] -= [
            problem.loss(t, y, noise, posterior.weight) for t, y in zip(some, x, strict=True)
        ]
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    chosen = np.searchsorted(np.cumsum(weight), (rng.random() + np.arange(count)) / count)
    values, vectors = np.linalg.eigh(posterior.systematic)
    shift = rng.normal(size=(count, size)) * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    return Sample(thetas[np.minimum(chosen, count - 1)] + shift, float(1.0 / (weight**2).sum()))
