"""The Cosserat rod of ``vinesim bench tune`` is the cane: its shape at the start, its length, its slowest swing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from vinesim.bench import tuning_rods
from vinesim.bench.tuning_cases import draw_case
from vinesim.tune import measure


@pytest.mark.long
def test_the_rod_begins_in_the_equilibrium_of_the_cane() -> None:
    case = draw_case(0)
    nodes, tangents = tuning_rods._held_shape(case)
    lengths = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
    np.testing.assert_allclose(lengths, lengths[0], rtol=1e-12)
    np.testing.assert_allclose(0.5 * (nodes[0] + nodes[1]), 0.0, atol=1e-12)
    np.testing.assert_allclose(tangents[0], [1.0, 0.0, 0.0])
    assert (tuning_rods.ELEMENTS - 0.5) * lengths[0] == pytest.approx(case.truth.length.value)
    held = measure(case.truth, case.experiment, exact=True).position[0, 0]
    np.testing.assert_allclose(nodes[-1], held, atol=5e-4)


@pytest.mark.long
def test_the_rod_swings_as_the_cane_does() -> None:
    if not tuning_rods.is_installed():
        pytest.skip("PyElastica is not installed")
    case = draw_case(0)
    quarter = dataclasses.replace(case.experiment, duration=0.1, hold=0.0, noise=0.0, rate=100.0)
    case = dataclasses.replace(case, experiment=quarter)
    rod = tuning_rods.rod_track(case)
    cane = measure(case.truth, quarter, exact=True)
    np.testing.assert_allclose(rod.position, cane.position, atol=0.004)
    assert np.abs(np.diff(rod.position[:, 0, 2])).max() > 0.01
