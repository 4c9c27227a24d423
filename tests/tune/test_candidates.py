"""Candidates: the simulator's own motion, its own equilibrium and its own derivatives."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.support.long_rows import long
from tests.support.tuning import bunch, cane, number
from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.plants.device_buffers import DeviceBuffers
from vinesim.plants.rollout import Rollout
from vinesim.scene.builder import assemble
from vinesim.scene.state import State
from vinesim.tune import Experiment, extract_features, measure
from vinesim.tune.candidates import COLUMNS, Candidates
from vinesim.tune.priors import physical_priors
from vinesim.tune.problem import Problem
from vinesim.tune.specimen import build_tree

DT = 0.004


def test_a_candidate_moves_as_its_specimen_does_in_the_solver() -> None:
    """Candidate 3 has twice the modulus and damping of the specimen."""
    row = np.zeros((9, len(COLUMNS)))
    row[:, 5:] = 0.1, -0.3
    row[3, 0] = row[3, 1] = math.log(2.0)
    candidates = Candidates(cane(), dt=DT)
    moved = candidates.run(row, np.array([0, 7, 60])).position[3, :, 0]
    model = assemble([build_tree(cane(1e10, 0.008))])
    plants = ArticulationSolver(model, State.at_rest(model), dt=DT, substeps=False)
    held = candidates.held_pose(row)
    plants.state.joint_q[:] = held[3]
    plants.wake(0)
    seen = []
    for tick in range(61):
        plants.predict()
        if tick in (0, 7, 60):
            pose = plants.state.body_q[7]
            seen.append(pose[:3] + model.body_length[7] * _x_axis(pose[3:]))
        plants.integrate()
    np.testing.assert_allclose(moved, seen, atol=2e-5)


def _x_axis(q: np.ndarray) -> np.ndarray:
    return frames.rotate(q, np.array([1.0, 0.0, 0.0]))


def test_candidates_move_alike_where_kernels_have_copies_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a GPU what is not brought there and back is lost; copies of the CPU's stand for its memory."""
    candidates = np.zeros((5, len(COLUMNS)))
    candidates[:, 0], candidates[:, 5] = np.linspace(-0.5, 0.5, 5), 1.0
    ticks = np.array([0, 3, 10, 31])
    alone = Candidates(cane(5e9), dt=0.01).run(candidates, ticks)

    def with_copies(*arguments: Any, device: str, **options: Any) -> ArticulationSolver:
        return ArticulationSolver(*arguments, buffers=DeviceBuffers(device, interleave=4), **options)

    monkeypatch.setattr("vinesim.tune.candidates.ArticulationSolver", with_copies)
    copied = Candidates(cane(5e9), dt=0.01).run(candidates, ticks)
    np.testing.assert_array_equal(copied.position, alone.position)
    np.testing.assert_array_equal(copied.velocity, alone.velocity)


def test_a_pulled_cane_takes_the_shape_of_a_beam() -> None:
    """Tip deflection F L^3 / 3 E I of a cane without taper, small; the next term of the elastica is below 1 %."""
    specimen = cane(base_diameter=number(0.008, "m"), tip_diameter=number(0.008, "m"), segments=16)
    row = np.zeros((2, len(COLUMNS)))
    stiffness = 3.0 * 5e9 * math.pi * 0.004**4 / 4.0
    row[1, 5] = 0.05 * stiffness
    rest, pulled = Candidates(specimen, dt=DT).shape(row)[:, 0]
    assert np.linalg.norm(pulled - rest) == pytest.approx(0.05, rel=0.02)


def test_only_modulus_over_mass_shows_in_a_free_swing() -> None:
    """Twice as stiff, twice as heavy and pulled twice as hard (the pull of a candidate grows with its modulus): the
    same motion, gravity included. Why a free swing cannot tell the two apart."""
    row = np.zeros((2, len(COLUMNS)))
    row[:, 5:] = 0.1, -0.4
    row[1, [0, 2]] = math.log(2.0)
    one, other = Candidates(cane(), dt=DT).run(row, np.arange(0, 250, 10)).position
    np.testing.assert_allclose(one, other, atol=2e-5)
    assert np.ptp(one[:, 0, 2]) > 0.1


@pytest.mark.parametrize("specimen", [cane(), *long(bunch())], ids=["cane", "bunch"])
def test_the_jacobian_is_that_of_the_adjoint(specimen) -> None:
    """The gradient of a loss by modulus and damping: by candidates side by side, and by the adjoints of the same
    kernels through 250 ticks."""
    track = measure(specimen, Experiment(hold=0.0, duration=1.0, noise=0.0, displacement=0.05))
    features = extract_features(track, 0.0)
    problem = Problem(specimen, track, features, ("modulus", "damping"), physical_priors(specimen), DT)
    theta = np.zeros(len(problem.names))
    theta[problem.names.index("release")] = 0.0
    theta[0] = 0.02
    theta[problem.names.index("pull_z" if specimen.organ == "cane" else "pull_y")] = -0.3
    problem.pull_scale = 0.3
    found = problem.evaluate(theta)
    for k in range(2):  # seeded with the column itself, so that nothing cancels
        off = found.jacobian[:, k]
        assert (found.jacobian.T @ off)[k] == pytest.approx(_adjoint(problem, theta, off)[k], rel=1e-3)


def _adjoint(problem: Problem, theta: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Gradient of half the squared residuals by modulus and damping, the first pose's share by differences."""
    candidates = problem.candidates
    row = problem.row(theta)
    h = 0.01
    rows = np.array([row, row, row])
    rows[1, 0] += h
    rows[2, 0] -= h
    pose = candidates.held_pose(rows)
    turned = frames.log(frames.multiply(pose[1], frames.conjugate(pose[2]))) / (2.0 * h)
    model = assemble([build_tree(problem.specimen)])
    ticks = np.unique(np.floor(problem.track.time / DT + 1e-6).astype(int))
    body = candidates._body
    point = candidates._point
    rollout = Rollout(model, int(ticks[-1]) + 2, watched=np.unique(body), dt=DT, fast_rate=1e4, max_rate=1e4)
    stiffness = model.joint_stiffness * np.exp(theta[0])
    damping = model.joint_damping * np.exp(theta[0] + theta[1])
    seen = rollout.run(stiffness=stiffness, damping=damping, joint_q=pose[0])
    by_q = np.zeros(seen.body_q.shape)
    by_qd = np.zeros(seen.body_qd.shape)
    rows_of = problem.seen.cumsum().reshape(problem.seen.shape) - 1
    for sample, time in enumerate(problem.track.time):
        tick = int(np.floor(time / DT + 1e-6))
        s = time - tick * DT
        g = np.where(problem.seen[sample], off[rows_of[sample]], 0.0)  # left out as a gross error: no residual
        q = seen.body_q[tick, 0]
        w0 = seen.body_qd[tick, 0]
        w1 = seen.body_qd[tick + 1, 0]
        _add_marker(by_q[tick, 0], by_qd[tick, 0], by_qd[tick + 1, 0], q, w0, w1, point[0], s, g)
    gradient = rollout.gradient(by_q, by_qd)
    by_modulus = (gradient.stiffness * stiffness).sum() + (gradient.damping * damping).sum()
    by_modulus += (gradient.rotation * turned).sum()
    return np.array([by_modulus, (gradient.damping * damping).sum()])


def _add_marker(by_q, by_v, by_v_later, q, v, later, point, s, g) -> None:
    """Chain rule of a marker between two ticks, by central differences of its closed form."""

    def marker(x):
        q = x[:7]
        v = x[7:13]
        later = x[13:]
        arm = frames.rotate(q[3:], point)
        now = v[:3] + np.cross(v[3:], arm)
        then = later[:3] + np.cross(later[3:], arm + np.cross(v[3:], arm) * DT)
        return q[:3] + arm + now * s + 0.5 * (then - now) / DT * s * s

    x = np.concatenate([q, v, later]).astype(float)
    steps = 1e-6 * np.eye(len(x))
    rows = np.array([(marker(x + step) - marker(x - step)) @ g / 2e-6 for step in steps])
    by_q += rows[:7]
    by_v += rows[7:13]
    by_v_later += rows[13:]
