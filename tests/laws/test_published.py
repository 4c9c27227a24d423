"""Published measurements: what ``benchmarks/published_trees.py`` does with them, and a band of plausible damping.

The trees that it reproduces are not in this repository; their figures stand in ``docs/validation.md``.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import pathlib

import numpy as np
import pytest

from tests.support import beam_theory
from tests.support.beam_theory import Beam
from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.builder import assemble
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.spec import load_scene
from vinesim.scene.state import State

pytestmark = pytest.mark.slow

_SPEC = importlib.util.spec_from_file_location(
    "published_trees", pathlib.Path(__file__).parents[2] / "benchmarks" / "published_trees.py"
)
assert _SPEC is not None
assert _SPEC.loader is not None
published_trees = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(published_trees)

BARE_DAMPING = (0.01, 0.08)
"""Damping ratio of debranched trees: Moore and Maguire 2004, Trees 18:195 (internal damping alone: below 0.05)."""


def test_measured_cylinders_become_a_tree_of_the_same_shape() -> None:
    """Random cylinders, each somewhere along and beside an earlier one: every body begins and points where it did."""
    rng = np.random.default_rng(3)
    cylinders = np.zeros((40, 9))
    cylinders[:, 0], cylinders[:, 1] = rng.uniform(0.02, 0.1, 40), rng.uniform(0.1, 0.5, 40)
    cylinders[:, 5:8] = rng.normal(size=(40, 3)) * 0.4 + [0.0, 0.0, 1.0]
    cylinders[:, 5:8] /= np.linalg.norm(cylinders[:, 5:8], axis=1, keepdims=True)
    for k in range(1, 40):
        parent = rng.integers(max(0, k - 5), k)
        cylinders[k, 8] = parent + 1
        along = cylinders[parent, 5:8] * cylinders[parent, 1] * rng.uniform(0.0, 1.0)
        cylinders[k, 2:5] = cylinders[parent, 2:5] + along + 0.02 * rng.normal(size=3)
    model = assemble([published_trees.tree_of_cylinders(cylinders, published_trees.WOOD)])
    pose = model.forward_kinematics(model.joint_settled)
    assert np.abs(pose[:, :3] - cylinders[:, 2:5]).max() < 1e-4
    assert np.abs(frames.rotate(pose[:, 3:], np.array([1.0, 0.0, 0.0])) - cylinders[:, 5:8]).max() < 1e-4


def test_a_pole_of_measured_cylinders_sways_at_the_frequency_of_theory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beam theory, with the part of the stiffness that the pole's own weight takes (Greenhill's length)."""
    monkeypatch.setattr(published_trees, "SWAY_DURATION", 12.0)
    count = 24
    radius = 0.04
    length = 6.0
    wood = dataclasses.replace(published_trees.WOOD, damping=0.002)
    cylinders = np.zeros((count, 9))
    cylinders[:, 0], cylinders[:, 1], cylinders[:, 7], cylinders[:, 8] = radius, length / count, 1.0, np.arange(count)
    cylinders[:, 4] = np.arange(count) * length / count
    beam = Beam(modulus=wood.modulus, radius=radius, length=length, density=wood.density)
    buckles = (7.837 * beam.rigidity / (beam.line_mass * 9.81)) ** (1.0 / 3.0)
    theory = beam_theory.cantilever_frequencies(beam, 1)[0] * np.sqrt(1.0 - (length / buckles) ** 3)
    seen = published_trees.main_frequency(published_trees.sway(cylinders, wood, pull=50.0)[:, 0], 100.0)
    assert seen == pytest.approx(theory, rel=0.01)


def test_the_main_frequency_of_a_drifting_record_is_that_of_its_sway() -> None:
    """A decaying sway at 0.23 Hz, sampled at 4 Hz like the strain gauges, on a drift ten times as large."""
    time = np.arange(0.0, 60.0, 0.25)
    record = np.exp(-0.05 * time) * np.sin(2.0 * np.pi * 0.23 * time + 1.0) + 10.0 * time / 60.0
    assert published_trees.main_frequency(record, 4.0) == pytest.approx(0.23, rel=0.02)


def test_shoots_of_the_shipped_vineyard_damp_within_the_published_bands() -> None:
    """Energy of kicked shoots of the demo, leaves and bunches on: within the band of bare wood."""
    model = generate(load_scene("demo"))
    plants = ArticulationSolver(model, State.at_rest(model))
    chosen = np.arange(0, len(model.tree_first), 4)
    plants.wake(chosen)
    tips = [int(np.flatnonzero((model.body_tree == t) & (model.body_organ == Organ.CANE))[-1]) for t in chosen]
    rest = plants.state.body_q[tips, :3].copy()
    for tree in chosen:
        plants.state.joint_qd[model.tree_first[tree], 1:] = 0.5
    swing = np.linalg.norm(beam_theory.run(plants, 400, watch=np.array(tips)) - rest, axis=2)
    ratios = []
    for path in swing.T:
        peaks = np.flatnonzero((path[1:-1] > path[:-2]) & (path[1:-1] >= path[2:]) & (path[1:-1] > 5e-4)) + 1
        if len(peaks) > 4:
            slope = np.polyfit(peaks, np.log(path[peaks]), 1)[0]
            ratios.append(-slope * np.median(np.diff(peaks)) / np.pi)  # two peaks of the distance a period
    assert len(ratios) > 20

    assert BARE_DAMPING[0] < np.median(ratios) < BARE_DAMPING[1]  # 0.064; crowns reach to 1
