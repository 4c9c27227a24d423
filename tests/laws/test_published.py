"""Canes and shoots within published bands. These are plausibility bands of other plants and places, not validation."""

from __future__ import annotations

import numpy as np

from tests.support import beam_theory
from tests.support.beam_theory import Beam
from vinesim.physics.plants.articulation_solver import ArticulationSolver
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.spec import load_scene
from vinesim.scene.state import State

CANE_MODULUS = 5.89e9
"""[Pa] Flexural, three-point bending of grapevine canes: Bu et al. 2025, BioResources 20(3):6662."""
CANE_DIAMETER = 0.0087
"""[m] Cutting force 774.55 N over cutting strength 13.16 MPa, Okuzgozu canes: JKSUS 2024 36:103034."""
BRANCH_FREQUENCY, BRANCH_SPREAD = 11.8, 4.54
"""[Hz] Mean and standard deviation of blackcurrant branches, modal tests: Transactions of the CSAE 2011."""
BRANCH_DAMPING = 0.0708
"""Damping ratio of the same branches."""
BARE_DAMPING = (0.01, 0.08)
"""Damping ratio of debranched trees: Moore and Maguire 2004, Trees 18:195 (internal damping alone: below 0.05)."""


def test_a_cane_of_published_wood_swings_within_the_published_band_of_branches() -> None:
    """Half a metre of the published modulus and diameter, 100 Hz: within two standard deviations of 11.8 Hz."""
    beam = Beam(modulus=CANE_MODULUS, radius=CANE_DIAMETER / 2, length=0.5, density=950.0)
    f = beam_theory.cantilever_frequencies(beam, 1)[0]
    beam = Beam(**(vars(beam) | {"beta": BRANCH_DAMPING / (np.pi * f)}))
    plants = beam_theory.standing([beam.tree()])
    swing = beam_theory.run(plants, 200, watch=beam_theory.last_bodies(plants))[:, 0, 2]
    measured, _ = beam_theory.fitted_swing(np.arange(200) * plants.dt, swing, f)
    assert abs(measured - BRANCH_FREQUENCY) < 2 * BRANCH_SPREAD


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
