"""Fits of synthetic tracks: how near they come, how honest their intervals are, and how long they take beside peers.

Canes of 1 m (9 to 6 mm, 900 kg/m^3), modulus 2 to 9 GPa, damping ratio 0.01 to 0.1, pulled by 10 cm; 30 pictures a
second for 3 s with 2 mm of noise in each axis; start values up to five times off. The truth is stepped at 1 ms by
vinesim, or at 0.5 ms by MuJoCo, whose scheme then has less damping of its own than the canes have.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator
from typing import Any

import msgspec
import mujoco
import numpy as np

from vinesim import frames
from vinesim.bench.mujoco_reference import compile_plants
from vinesim.scene.builder import assemble
from vinesim.scene.plant_parameters import Number, Specimen
from vinesim.scene.values import Measurement
from vinesim.tune import Experiment, Fit, Trajectory, measure, tune
from vinesim.tune.candidates import COLUMNS, Candidates
from vinesim.tune.experiment import pull_for
from vinesim.tune.features import extract_features
from vinesim.tune.priors import physical_priors
from vinesim.tune.problem import Problem
from vinesim.tune.specimen import build_tree
from vinesim.tune.start import start_values
from vinesim.tune.tuning import STEP_PHASE

SEEDS = 50
SPEED_SEEDS = 5
"""Tracks on which peers are timed."""
MUJOCO_SEEDS = 6
MUJOCO_SEGMENTS = 32
MODULUS_BAR, DAMPING_BAR = 0.03, 0.15
"""Largest relative errors."""


@dataclasses.dataclass(frozen=True, slots=True)
class Case:
    """One synthetic laboratory."""

    truth: Specimen
    guess: Specimen
    """What the user begins with."""
    experiment: Experiment


def bench_cane(modulus: float, damping: float, segments: int = 8) -> Specimen:
    """The cane of this benchmark; ``damping`` [s]."""

    def number(value: float, unit: str) -> Number:
        return Number(value, unit, "GUESSED", "benchmark")

    return Specimen(
        organ="cane", length=number(1.0, "m"), base_diameter=number(0.009, "m"), tip_diameter=number(0.006, "m"),
        modulus=number(modulus, "Pa"), density=number(900.0, "kg/m^3"), damping=number(damping, "s"),
        segments=segments,
    )  # fmt: skip


def draw_case(seed: int) -> Case:
    """Modulus, damping, start values and the moment of release of one seed."""
    rng = np.random.default_rng(seed)
    modulus = 1e9 * math.exp(rng.uniform(math.log(2.0), math.log(9.0)))
    ratio = math.exp(rng.uniform(math.log(0.01), math.log(0.1)))
    damping = ratio / (math.pi * 3.48 * math.sqrt(modulus / 5e9))
    off = np.exp(rng.uniform(-math.log(5.0), math.log(5.0), 2))
    experiment = Experiment(seed=seed, hold=0.2 + float(rng.uniform(0.0, 1.0 / 30.0)))
    return Case(bench_cane(modulus, damping), bench_cane(modulus * off[0], damping * off[1]), experiment)


@dataclasses.dataclass(frozen=True, slots=True)
class Recovery:
    """Fits of several seeds."""

    modulus_error: np.ndarray
    """[seed] Relative."""
    damping_error: np.ndarray
    covered: np.ndarray
    """[seed, 2] Whether the 90 % interval of modulus and damping holds the truth."""
    refused: np.ndarray
    """[seed] Whether the fit says that it has failed."""
    seconds: np.ndarray
    """[seed] Wall time of a fit."""

    @property
    def silent(self) -> int:
        """Fits beyond a bar that say nothing of it."""
        beyond = (np.abs(self.modulus_error) > MODULUS_BAR) | (np.abs(self.damping_error) > DAMPING_BAR)
        return int((beyond & ~self.refused).sum())


def recover(cases: list[Case], tracks: list[Trajectory] | None = None) -> Recovery:
    """Fit each case's track, its own measurement unless given."""
    rows = []
    for i, case in enumerate(cases):
        track = measure(case.truth, case.experiment) if tracks is None else tracks[i]
        begun = time.perf_counter()
        fit = tune(case.guess, track)
        rows.append((*_errors(fit, case.truth), not fit.ok, time.perf_counter() - begun))
    modulus, damping, *covered, refused, seconds = map(np.array, zip(*rows, strict=True))
    return Recovery(modulus, damping, np.stack(covered, -1), refused, seconds)


def _errors(fit: Fit, truth: Specimen) -> tuple[float, float, bool, bool]:
    modulus, damping = fit.estimate("modulus"), fit.estimate("damping")
    return (
        modulus.value / truth.modulus.value - 1.0, damping.value / truth.damping.value - 1.0,
        modulus.low <= truth.modulus.value <= modulus.high, damping.low <= truth.damping.value <= damping.high,
    )  # fmt: skip


# ---------------------------------------------------------------------- another simulator as the truth


def mujoco_track(case: Case, dt: float = 5e-4) -> Trajectory:
    """The case's track from a MuJoCo chain of 32 ball joints, released from vinesim's equilibrium of the same chain."""
    specimen = msgspec.structs.replace(case.truth, segments=MUJOCO_SEGMENTS)
    e = case.experiment
    candidates = Candidates(specimen, dt=dt)
    row = np.zeros((1, len(COLUMNS)))
    row[0, 5:] = pull_for(candidates, e.displacement, math.radians(e.angle))
    pose = candidates.held_pose(row)[0]
    model = assemble([build_tree(specimen)])
    # the ball joint takes the bending stiffness for all axes; the cane bends in one plane and does not twist
    damping = (model.joint_damping - dt * model.joint_stiffness)[:, 1]  # MuJoCo's scheme adds the rest
    world = compile_plants(model, dt=dt, damping=damping)
    data = mujoco.MjData(world)
    data.qpos[:] = frames.to_wxyz(pose).ravel()
    mujoco.mj_forward(world, data)
    tip = np.array([model.body_length[-1], 0.0, 0.0])

    def position() -> np.ndarray:
        body = data.body(f"plant/{len(model.body_mass) - 1}")
        return body.xpos + body.xmat.reshape(3, 3) @ tip

    clock = np.arange(math.ceil((e.hold + e.duration) * e.rate)) / e.rate
    ticks = int(e.duration / dt) + 2
    path = np.empty((ticks, 3))
    for tick in range(ticks):
        path[tick] = position()
        mujoco.mj_step(world, data)
        mujoco.mj_kinematics(world, data)
    after = np.maximum(clock - e.hold, 0.0)
    seen = np.stack([np.interp(after, dt * np.arange(ticks), axis) for axis in path.T], -1)
    noise = np.random.default_rng(e.seed).normal(0.0, e.noise, (len(clock), 1, 3))
    return Trajectory(clock, seen[:, None] + noise, source=f"MuJoCo, seed {e.seed}")


# ---------------------------------------------------------------------- peers


class PlainProblem:
    """The same loss and the same simulator, for optimisers that know neither derivatives nor features.

    Start values of release and pull are given to them; modulus and damping begin where the user's do.
    """

    def __init__(self, case: Case, track: Trajectory) -> None:
        features = extract_features(track)
        dt = min(0.01, STEP_PHASE / (2.0 * math.pi * features.frequency))
        names = ("modulus", "damping")
        self.problem = Problem(case.guess, track, features, names, physical_priors(case.guess), dt)
        self.noise = features.noise
        self.good = start_values(self.problem)
        """Our own start values."""
        self.plain = self.good.copy()
        self.plain[:2] = 0.0  # the user's
        self.scales = self.problem._scales()

    def losses(self, thetas: np.ndarray) -> np.ndarray:
        """[n] of parameters [n, 8], all of one launch."""
        problem = self.problem
        x, _ = problem.samples(thetas, np.array([problem.row(theta) for theta in thetas]))
        return np.array([problem.loss(theta, y, self.noise) for theta, y in zip(thetas, x, strict=True)])

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """Of one candidate, priors included, for scipy."""
        problem = self.problem
        x, _ = problem.samples(theta[None], problem.row(theta)[None])
        off = (x[0] - problem.observed)[problem.seen] / self.noise
        return np.concatenate([off, problem._extra(theta)[0]])


def fit_by_scipy(plain: PlainProblem, starts: np.ndarray) -> np.ndarray:
    """scipy's least squares with its own finite differences, from each start; the best."""
    from scipy.optimize import least_squares

    found = [
        least_squares(
            plain.residuals, start, x_scale=plain.scales, loss="soft_l1", f_scale=3.0, ftol=1e-5, xtol=1e-6,
            diff_step=1e-4, max_nfev=30,
        )
        for start in starts
    ]  # fmt: skip
    return min(found, key=lambda one: one.cost).x


def fit_by_cma(plain: PlainProblem, seed: int) -> np.ndarray:
    """CMA-ES with its default population, each generation one launch, from the user's start."""
    import cma

    spread = plain.scales.copy()
    spread[:2] = math.log(5.0)
    options = {"verbose": -9, "seed": seed + 1, "CMA_stds": spread, "maxiter": 400, "tolfun": 1e-3, "tolx": 1e-5}
    strategy = cma.CMAEvolutionStrategy(plain.plain, 0.5, options)
    while not strategy.stop():
        asked = np.array(strategy.ask())
        asked[:, :2] = np.clip(asked[:, :2], -4.0, 4.0)
        strategy.tell(list(asked), plain.losses(asked).tolist())
    return np.asarray(strategy.result.xbest)


FREQUENCY_STARTS = np.log(np.array([0.04, 0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.5, 5.0, 10.0, 25.0]))
"""Moduli over the guess from which scipy starts; fewer miss the right cycle more often."""


def _peer_rows(seeds: int) -> Iterator[Measurement]:
    cases = [draw_case(seed) for seed in range(seeds)]
    tracks = [measure(case.truth, case.experiment) for case in cases]
    peers: dict[str, Any] = {
        "scipy, one start": lambda p, s: fit_by_scipy(p, p.plain[None]),
        "scipy, 11 starts": lambda p, s: fit_by_scipy(p, _fan(p)),
        "scipy, from our start values": lambda p, s: fit_by_scipy(p, p.good[None]),
        "CMA-ES": fit_by_cma,
    }
    for case, track in zip(cases[:1], tracks[:1], strict=True):  # loads every kernel
        tune(case.guess, track)
    ours, seconds, good = [], {name: [] for name in peers}, dict.fromkeys(peers, 0)
    for seed, (case, track) in enumerate(zip(cases, tracks, strict=True)):
        begun = time.perf_counter()
        tune(case.guess, track)
        ours.append(time.perf_counter() - begun)
        plain = PlainProblem(case, track)
        plain.losses(plain.plain[None])
        for name, peer in peers.items():
            begun = time.perf_counter()
            found = peer(plain, seed)
            seconds[name].append(time.perf_counter() - begun)
            value = case.guess.modulus.value * math.exp(found[0])
            good[name] += abs(value / case.truth.modulus.value - 1.0) < MODULUS_BAR
    mine = float(np.median(ours))
    for name in peers:
        theirs = float(np.median(seconds[name]))
        case_name = f"fit of 3 s ({name}: {good[name]} of {seeds} right)"
        yield Measurement("tune", case_name, mine, "s", name, theirs, theirs / mine)


def _fan(plain: PlainProblem) -> np.ndarray:
    starts = np.repeat(plain.plain[None], len(FREQUENCY_STARTS), 0)
    starts[:, 0] = FREQUENCY_STARTS
    return starts


def _recovery_rows(name: str, found: Recovery) -> Iterator[Measurement]:
    yield Measurement("tune", f"{name}: modulus, largest error", 100.0 * float(np.abs(found.modulus_error).max()), "%")
    yield Measurement("tune", f"{name}: damping, largest error", 100.0 * float(np.abs(found.damping_error).max()), "%")
    for i, part in enumerate(("modulus", "damping")):
        yield Measurement(
            "tune", f"{name}: {part} in its 90 % interval", 100.0 * float(found.covered[:, i].mean()), "%"
        )
    yield Measurement("tune", f"{name}: fits beyond a bar, silent", found.silent, "1")
    yield Measurement("tune", f"{name}: fits that say they failed", int(found.refused.sum()), "1")
    yield Measurement("tune", f"{name}: wall time of a fit, median", float(np.median(found.seconds)), "s")


def tuning(seeds: int = SEEDS) -> Iterator[Measurement]:
    """Recovery over seeds, from vinesim's and from MuJoCo's tracks; wall time beside scipy and CMA-ES."""
    cases = [draw_case(seed) for seed in range(seeds)]
    yield from _recovery_rows(f"{seeds} seeds", recover(cases))
    few = cases[: min(MUJOCO_SEEDS, seeds)]
    yield from _recovery_rows(f"{len(few)} tracks of MuJoCo", recover(few, [mujoco_track(case) for case in few]))
    yield from _peer_rows(min(SPEED_SEEDS, seeds))
