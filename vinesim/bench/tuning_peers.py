"""Fits by other methods, compared with vinesim's on the same data with the same simulator: scipy's least squares,
CMA-ES, Stein particles.

All begin at the user's start values, with modulus and damping up to five times off. The peers are given release and
pull as vinesim's fit finds them. Time is processor time of the process.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np

from vinesim.bench.tuning_cases import DAMPING_BAR, MODULUS_BAR, Case
from vinesim.scene.plant_parameters import Specimen
from vinesim.scene.values import Measurement
from vinesim.tune import Trajectory, tune
from vinesim.tune.features import extract_features
from vinesim.tune.priors import physical_priors
from vinesim.tune.problem import Problem
from vinesim.tune.start import start_values
from vinesim.tune.tuning import STEP_PHASE

AS_GOOD = 1.0
"""Difference from the loss (half a chi square) of vinesim's minimum below which another method's fit is finished."""
MOST_SECONDS = 30.0
"""Processor time after which a method that restarts from several points gives up [s]."""
STEIN_SEGMENTS = 3
"""Number of rigid bodies of the chain of springs on which Stein particles are computed."""
STEIN_PARTICLES = 20
STEIN_ITERATIONS = 120


class PlainProblem:
    """Loss and simulator of vinesim's fit, for methods that use neither its derivatives nor its features."""

    def __init__(self, specimen: Specimen, track: Trajectory) -> None:
        features = extract_features(track)
        dt = min(0.01, STEP_PHASE / (2.0 * math.pi * features.frequency))
        self.problem = Problem(specimen, track, features, ("modulus", "damping"), physical_priors(specimen), dt)
        self.noise = features.noise
        self.good = start_values(self.problem)
        """Start values that vinesim's fit finds [8]."""
        self.plain = self.good.copy()
        self.plain[:2] = 0.0  # the user's modulus and damping
        self.scales = self.problem._scales()
        self.losses(self.plain[None])  # the first call loads every kernel

    def losses(self, thetas: np.ndarray) -> np.ndarray:
        """Returns the losses [n] of the parameters [n, 8], all computed in one kernel launch."""
        problem = self.problem
        x, _ = problem.samples(thetas, np.array([problem.row(theta) for theta in thetas]))
        return np.array([problem.loss(theta, y, self.noise) for theta, y in zip(thetas, x, strict=True)])

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """Returns the residuals for the parameters ``theta`` [8], including those of the priors, in one array for
        scipy."""
        problem = self.problem
        x, _ = problem.samples(theta[None], problem.row(theta)[None])
        off = (x[0] - problem.observed)[problem.seen] / self.noise
        return np.concatenate([off, problem._extra(theta)[0]])

    def log_gradients(self, thetas: np.ndarray) -> np.ndarray:
        """Returns gradients [n, 8] of the log posterior by forward differences, all candidates in one launch."""
        size = thetas.shape[1]
        step = 1e-2 * self.scales
        moved = np.concatenate([thetas, *(thetas + step[i] * np.eye(size)[i] for i in range(size))])
        losses = self.losses(moved).reshape(size + 1, len(thetas))
        return -((losses[1:] - losses[0]) / step[:, None]).T


def fit_by_scipy(plain: PlainProblem, start: np.ndarray) -> np.ndarray:
    """Fit by scipy's least squares with its own finite differences, from one start; return the parameters [8]."""
    from scipy.optimize import least_squares

    return least_squares(
        plain.residuals,
        start,
        x_scale=plain.scales,
        loss="soft_l1",
        f_scale=3.0,
        ftol=1e-5,
        xtol=1e-6,
        diff_step=1e-4,
        max_nfev=30,
    ).x


def fit_by_cma(plain: PlainProblem, start: np.ndarray, seed: int) -> np.ndarray:
    """Fit by CMA-ES with its default population, one launch for each generation; return the parameters [8]."""
    import cma

    spread = plain.scales.copy()
    spread[:2] = math.log(5.0)
    options = {"verbose": -9, "seed": seed + 1, "CMA_stds": spread, "maxiter": 400, "tolfun": 1e-3, "tolx": 1e-5}
    strategy = cma.CMAEvolutionStrategy(start, 0.5, options)
    while not strategy.stop():
        asked = np.array(strategy.ask())
        asked[:, :2] = np.clip(asked[:, :2], -4.0, 4.0)
        strategy.tell(list(asked), plain.losses(asked).tolist())
    return np.asarray(strategy.result.xbest)


def until_as_good(
    plain: PlainProblem, fit: Callable[[np.ndarray, int], np.ndarray], target: float, seed: int
) -> tuple[np.ndarray, float]:
    """Repeat a ``fit`` until its loss is as good as ``target``, the loss of vinesim's fit.

    The first start is the user's; further starts are up to five times off. Returns the best parameters and the
    processor time [s].
    """
    rng = np.random.default_rng(seed)
    begun = time.process_time()
    start = plain.plain
    best = plain.plain
    least = math.inf
    turn = 0
    while True:
        found = fit(start, 100 * seed + turn)
        loss = float(plain.losses(found[None])[0])
        if loss < least:
            best = found
            least = loss
        spent = time.process_time() - begun
        if least < target + AS_GOOD or spent > MOST_SECONDS:
            return best, spent
        start = plain.plain.copy()
        turn = turn + 1
        start[:2] = rng.uniform(-math.log(5.0), math.log(5.0), 2)


def peer_rows(cases: list[Case], tracks: list[Trajectory]) -> Iterator[Measurement]:
    """Yields the processor time of vinesim's fit, and of equally good fits by scipy and CMA-ES."""
    peers: dict[str, Callable[[PlainProblem], Any]] = {
        "scipy with finite differences": lambda p: lambda start, _: fit_by_scipy(p, start),
        "CMA-ES": lambda p: lambda start, seed: fit_by_cma(p, start, seed),
    }
    tune(cases[0].guess, tracks[0])  # the first call loads every kernel
    ours = []
    seconds = {name: [] for name in peers}
    good = dict.fromkeys(peers, 0)
    for seed, (case, track) in enumerate(zip(cases, tracks, strict=True)):
        begun = time.process_time()
        tune(case.guess, track)
        ours.append(time.process_time() - begun)
        plain = PlainProblem(case.guess, track)
        theta, _ = plain.problem.minimise(plain.good, plain.noise)
        target = float(plain.losses(theta[None])[0])
        for name, peer in peers.items():
            found, spent = until_as_good(plain, peer(plain), target, seed)
            seconds[name].append(spent)
            good[name] += float(plain.losses(found[None])[0]) < target + AS_GOOD
    for name in peers:
        mine = float(np.mean(ours))
        theirs = float(np.mean(seconds[name]))
        title = f"CPU time of a fit, mean ({name}: {good[name]} of {len(cases)} as good)"
        yield Measurement("tune", title, mine, "s", name, theirs, theirs / mine)


# ---------------------------------------------------------------------- Stein variational gradient descent


def stein_descent(
    log_gradients: Callable[[np.ndarray], np.ndarray], particles: np.ndarray, iterations: int, rate: float = 0.1
) -> np.ndarray:
    """Move particles [n, k] to a posterior by Stein variational gradient descent (Liu and Wang 2016); return them.

    The kernel is exp(-d^2 / h), with h the squared median distance over ln n. Steps are AdaGrad's with momentum, as in
    that paper.

    Args:
        log_gradients: function from particles [n, k] to gradients of the log posterior [n, k].
        particles: initial particles [n, k], in units in which the posterior is about equally wide in all directions.
        iterations: number of steps.
        rate: length of a step in those units [1].
    """
    x = particles.astype(float).copy()
    history = np.zeros_like(particles)
    for turn in range(iterations):
        apart = x[:, None] - x[None]
        square = (apart**2).sum(-1)
        h = max(float(np.median(square)) / math.log(len(x) + 1.0), 1e-12)
        kernel = np.exp(-square / h)
        way = (kernel @ log_gradients(x) + 2.0 / h * (kernel[..., None] * apart).sum(1)) / len(x)
        history = way**2 if turn == 0 else 0.9 * history + 0.1 * way**2
        x += rate * way / (1e-6 + np.sqrt(history))
    return x


@dataclasses.dataclass(frozen=True, slots=True)
class _Sides:
    """Results of one method over several tracks."""

    error: np.ndarray
    """[track, 2] Relative errors of modulus and damping."""
    covered: np.ndarray
    """[track, 2] Whether the 90 % interval contains the true value."""
    seconds: float


def _stein(cases: list[Case], tracks: list[Trajectory], from_features: bool) -> _Sides:
    """Compute posteriors by Stein particles on a chain of few springs.

    ``from_features``: particles begin near the start values that vinesim's fit finds; otherwise up to five times off
    the user's.
    """
    error = []
    covered = []
    seconds = []
    for seed, (case, track) in enumerate(zip(cases, tracks, strict=True)):
        rng = np.random.default_rng(seed)
        plain = PlainProblem(msgspec.structs.replace(case.guess, segments=STEIN_SEGMENTS), track)
        begun = time.process_time()
        scale = 0.1 * plain.scales
        first = np.repeat((plain.good if from_features else plain.plain)[None], STEIN_PARTICLES, 0)
        first[:, 2:] += scale[2:] * rng.normal(size=first[:, 2:].shape)
        wide = 0.1 if from_features else math.log(5.0)
        first[:, :2] += rng.uniform(-wide, wide, (STEIN_PARTICLES, 2))

        def gradients(x: np.ndarray, plain: PlainProblem = plain, scale: np.ndarray = scale) -> np.ndarray:
            theta = x * scale
            theta[:, :2] = np.clip(theta[:, :2], -4.0, 4.0)
            return plain.log_gradients(theta) * scale

        found = stein_descent(gradients, first / scale, STEIN_ITERATIONS) * scale
        seconds.append(time.process_time() - begun)
        own = np.array([case.guess.modulus.value, case.guess.damping.value])
        truth = np.array([case.truth.modulus.value, case.truth.damping.value])
        values = own * np.exp(found[:, :2])
        low, high = np.quantile(values, [0.05, 0.95], axis=0)
        error.append(np.median(values, 0) / truth - 1.0)
        covered.append((low <= truth) & (truth <= high))
    return _Sides(np.array(error), np.array(covered), float(np.mean(seconds)))


def _ours(cases: list[Case], tracks: list[Trajectory]) -> _Sides:
    error = []
    covered = []
    seconds = []
    for case, track in zip(cases, tracks, strict=True):
        begun = time.process_time()
        fit = tune(case.guess, track)
        seconds.append(time.process_time() - begun)
        both = [(fit.estimate(name), getattr(case.truth, name).value) for name in ("modulus", "damping")]
        error.append([one.value / truth - 1.0 for one, truth in both])
        covered.append([one.low <= truth <= one.high for one, truth in both])
    return _Sides(np.array(error), np.array(covered), float(np.mean(seconds)))


def stein_rows(cases: list[Case], tracks: list[Trajectory]) -> Iterator[Measurement]:
    """Yields time and calibration of vinesim's posterior, compared with Stein particles on chains of springs (arXiv
    2306.03410)."""
    ours = _ours(cases, tracks)
    for name, from_features in (("SVGD", False), ("SVGD from our start values", True)):
        peer = _stein(cases, tracks, from_features)
        yield Measurement(
            "tune", "CPU time of a posterior, mean", ours.seconds, "s", name, peer.seconds, peer.seconds / ours.seconds
        )
        for i, part in enumerate(("modulus", "damping")):
            pairs = {
                f"{part}, median error": [100.0 * float(np.median(np.abs(one.error[:, i]))) for one in (ours, peer)],
                f"{part} in its 90 % interval": [100.0 * float(one.covered[:, i].mean()) for one in (ours, peer)],
            }
            for title, (mine, theirs) in pairs.items():
                yield Measurement("tune", f"{len(cases)} posteriors: {title}", mine, "%", name, theirs)
        bars = np.array([MODULUS_BAR, DAMPING_BAR])
        right = [100.0 * float((np.abs(one.error) < bars).all(1).mean()) for one in (ours, peer)]
        yield Measurement("tune", f"{len(cases)} posteriors: median within the bars", right[0], "%", name, right[1])
