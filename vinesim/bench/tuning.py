"""``vinesim bench tune``: errors of fits to synthetic tracks, calibration of their intervals, and their cost.

The true swing is stepped at 1 ms by vinesim, or at 0.5 ms by MuJoCo (its scheme then has less damping of its own than
the canes have), or by PyElastica (:mod:`vinesim.bench.tuning_rods`); or the tracks come from pictures
(:mod:`vinesim.bench.tuning_pictures`). The peers are in :mod:`vinesim.bench.tuning_peers`.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Iterator

import msgspec
import mujoco
import numpy as np

from vinesim.bench.mujoco_reference import compile_plants
from vinesim.bench.tuning_cases import BUNCH_MODULUS_BAR, DAMPING_BAR, MODULUS_BAR, Case, draw_bunch, draw_case
from vinesim.bench.tuning_peers import peer_rows, stein_rows
from vinesim.bench.tuning_pictures import film
from vinesim.bench.tuning_rods import is_installed, rod_track
from vinesim.core import frames
from vinesim.scene.builder import assemble
from vinesim.scene.plant_parameters import Specimen
from vinesim.scene.values import Measurement
from vinesim.tune import Fit, Trajectory, measure, tune
from vinesim.tune.candidates import COLUMNS, Candidates
from vinesim.tune.experiment import pull_for
from vinesim.tune.specimen import build_tree

SEEDS = 50
SPEED_SEEDS = 3
"""Number of tracks on which peers are timed."""
STEIN_SEEDS = 4
"""Number of tracks for which Stein particles compute the posterior."""
PICTURE_SEEDS = 20
"""Number of swings that are filmed."""
ROD_SEEDS = 5
"""Number of tracks from PyElastica, each of some 700,000 steps: 20 s of CPU."""
MUJOCO_SEEDS = 6
MUJOCO_SEGMENTS = 32


@dataclasses.dataclass(frozen=True, slots=True)
class Recovery:
    """Results of fits, one for each seed."""

    modulus_error: np.ndarray
    """[seed] Relative error of the modulus."""
    damping_error: np.ndarray
    covered: np.ndarray
    """Whether the 90 % interval of modulus and of damping contains the true value [seed, 2]."""
    score: np.ndarray
    """Errors of the logarithms of modulus and damping, in standard deviations of the posterior [seed, 2]."""
    refused: np.ndarray
    """Whether the fit reports that it has failed [seed]."""
    seconds: np.ndarray
    """[seed] Wall time of a fit."""
    modulus_bar: float = MODULUS_BAR
    """Largest accepted relative error of a modulus."""

    @property
    def silent(self) -> int:
        """Number of fits with errors beyond the bar that do not report a failure."""
        beyond = (np.abs(self.modulus_error) > self.modulus_bar) | (np.abs(self.damping_error) > DAMPING_BAR)
        return int((beyond & ~self.refused).sum())


def recover(cases: list[Case], tracks: list[Trajectory] | None = None, modulus_bar: float = MODULUS_BAR) -> Recovery:
    """Fit one track for each case, and return the results. ``tracks``: tracks to fit, by default simulated measurements
    of the cases."""
    rows = []
    for i, case in enumerate(cases):
        track = measure(case.truth, case.experiment) if tracks is None else tracks[i]
        begun = time.perf_counter()
        fit = tune(case.guess, track)
        rows.append((*_errors(fit, case.truth), not fit.ok, time.perf_counter() - begun))
    return Recovery(*map(np.array, zip(*rows, strict=True)), modulus_bar=modulus_bar)


def _errors(fit: Fit, truth: Specimen) -> tuple[float, float, list[bool], list[float]]:
    """Returns the first four fields of a :class:`Recovery` for one fit."""
    found = [fit.estimate("modulus"), fit.estimate("damping")]
    true = [truth.modulus.value, truth.damping.value]
    off = [one.value / value for one, value in zip(found, true, strict=True)]
    covered = [one.low <= value <= one.high for one, value in zip(found, true, strict=True)]
    score = [math.log(x) / deviation for x, deviation in zip(off, fit.posterior.deviation[:2].tolist(), strict=True)]
    return off[0] - 1.0, off[1] - 1.0, covered, score


# ---------------------------------------------------------------------- another simulator as the truth


def mujoco_track(case: Case, dt: float = 5e-4) -> Trajectory:
    """Returns the case's track from a MuJoCo chain of 32 ball joints, released from vinesim's equilibrium of the same
    chain."""
    specimen = msgspec.structs.replace(case.truth, segments=MUJOCO_SEGMENTS)
    e = case.experiment
    candidates = Candidates(specimen, dt=dt)
    row = np.zeros((1, len(COLUMNS)))
    row[0, 5:] = pull_for(candidates, e.number("displacement"), math.radians(e.angle))
    pose = candidates.held_pose(row)[0]
    model = assemble([build_tree(specimen)])
    # a ball joint has the bending stiffness for all axes, which suffices: the cane bends in one plane and does not
    # twist
    damping = (model.joint_damping - dt * model.joint_stiffness)[:, 1]  # MuJoCo's scheme adds the rest
    world = compile_plants(model, dt=dt, damping=damping)
    data = mujoco.MjData(world)
    data.qpos[:] = frames.to_wxyz(pose).ravel()
    mujoco.mj_forward(world, data)
    tip = np.array([model.body_length[-1], 0.0, 0.0])

    def position() -> np.ndarray:
        body = data.body(f"plant/{len(model.body_mass) - 1}")
        return body.xpos + body.xmat.reshape(3, 3) @ tip

    clock = np.arange(math.ceil((e.hold + e.number("duration")) * e.rate)) / e.rate
    ticks = int(e.number("duration") / dt) + 2
    path = np.empty((ticks, 3))
    for tick in range(ticks):
        path[tick] = position()
        mujoco.mj_step(world, data)
        mujoco.mj_kinematics(world, data)
    after = np.maximum(clock - e.hold, 0.0)
    seen = np.stack([np.interp(after, dt * np.arange(ticks), axis) for axis in path.T], -1)
    noise = np.random.default_rng(e.seed).normal(0.0, e.noise, (len(clock), 1, 3))
    return Trajectory(clock, seen[:, None] + noise, source=f"MuJoCo, seed {e.seed}")


def recovery_rows(name: str, found: Recovery) -> Iterator[Measurement]:
    yield Measurement("tune", f"{name}: modulus, largest error", 100.0 * float(np.abs(found.modulus_error).max()), "%")
    yield Measurement("tune", f"{name}: damping, largest error", 100.0 * float(np.abs(found.damping_error).max()), "%")
    for i, part in enumerate(("modulus", "damping")):
        yield Measurement(
            "tune", f"{name}: {part} in its 90 % interval", 100.0 * float(found.covered[:, i].mean()), "%"
        )
        size = float(np.sqrt(np.mean(found.score[:, i] ** 2)))
        yield Measurement("tune", f"{name}: {part}, RMS error in standard deviations", size, "1")
    yield Measurement("tune", f"{name}: fits beyond a bar, silent", found.silent, "1")
    yield Measurement("tune", f"{name}: fits that say they failed", int(found.refused.sum()), "1")
    yield Measurement("tune", f"{name}: wall time of a fit, median", float(np.median(found.seconds)), "s")


def picture_rows(cases: list[Case]) -> Iterator[Measurement]:
    """Yields results of fits to pictures, and the errors of the tracks."""
    swings = [film(case) for case in cases]
    name = f"{len(cases)} swings filmed by a D435"
    off = np.concatenate([swing.error for swing in swings])
    seen = np.isfinite(off).all(1)
    across, ahead = (1e3 * np.sqrt(np.mean(off[seen][:, axes] ** 2)) for axes in ([0, 1], [2]))
    yield Measurement("tune", f"{name}: pictures in which the marker was found", 100.0 * float(seen.mean()), "%")
    yield Measurement("tune", f"{name}: error of a position across the view, RMS of an axis", float(across), "mm")
    yield Measurement("tune", f"{name}: error of a position along the view, RMS", float(ahead), "mm")
    yield from recovery_rows(name, recover(cases, [swing.track for swing in swings]))


def tuning(announce: Callable[[str], None], seeds: int = SEEDS) -> Iterator[Measurement]:
    """Measure fits over seeds to tracks from vinesim, from pictures, from MuJoCo and from PyElastica; compare processor
    time and calibration with peers.

    ``announce`` is called with a line of text about each part that is skipped.
    """
    cases = [draw_case(seed) for seed in range(seeds)]
    tracks = [measure(case.truth, case.experiment) for case in cases]
    yield from recovery_rows(f"{seeds} seeds", recover(cases, tracks))
    bunches = [draw_bunch(seed) for seed in range(seeds)]
    yield from recovery_rows(f"{seeds} bunches", recover(bunches, modulus_bar=BUNCH_MODULUS_BAR))
    yield from picture_rows(cases[:PICTURE_SEEDS])
    few = cases[:MUJOCO_SEEDS]
    yield from recovery_rows(f"{len(few)} tracks of MuJoCo", recover(few, [mujoco_track(case) for case in few]))
    if is_installed():
        few = cases[:ROD_SEEDS]
        yield from recovery_rows(f"{len(few)} tracks of PyElastica", recover(few, [rod_track(case) for case in few]))
    else:
        announce("tune: no tracks of PyElastica, which is not installed; run: pip install 'vinesim[bench]'")
    yield from peer_rows(cases[:SPEED_SEEDS], tracks[:SPEED_SEEDS])
    yield from stein_rows(cases[:STEIN_SEEDS], tracks[:STEIN_SEEDS])
