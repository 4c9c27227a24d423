"""Dead reckoning against exact rotation, its limits, and the decay of corrections."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vinesim.core import frames
from vinesim.net.replication import dead_reckoning

vectors = st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3).map(np.array)


@given(vectors, vectors)
def test_quaternion_rate_is_the_derivative_of_rotation(turn, omega):
    q = frames.exp(turn)
    h = 1e-5
    after, before = (frames.multiply(frames.exp(s * h * omega), q) for s in (1.0, -1.0))
    np.testing.assert_allclose(dead_reckoning.quaternion_rate(q, omega), (after - before) / (2 * h), atol=1e-8)


@given(vectors, vectors, st.floats(0, 0.15))
def test_extrapolation_is_close_to_exact_rotation(turn, omega, dt):
    q = frames.exp(turn)
    exact = frames.multiply(frames.exp(omega * dt), q)
    found = dead_reckoning.extrapolate(q, dead_reckoning.quaternion_rate(q, omega), dt)
    assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-12)
    assert dead_reckoning.angle_between(found, exact) <= np.radians(0.4)


def test_extrapolation_takes_an_age_for_each():
    q = np.tile(frames.IDENTITY, (2, 1))
    found = dead_reckoning.extrapolate(q, dead_reckoning.quaternion_rate(q, np.ones((2, 3))), np.array([[0.0], [0.1]]))
    np.testing.assert_array_equal(found[0], frames.IDENTITY)
    assert found[1, 0] > 0.04


@given(vectors, st.floats(0, np.pi))
def test_angle_between_is_the_angle_of_the_difference(turn, angle):
    q = frames.exp(turn)
    turned = frames.multiply(frames.exp(np.array([0.0, 0.6, 0.8]) * angle), q)
    assert dead_reckoning.angle_between(turned, q) == pytest.approx(angle, abs=1e-6)
    assert dead_reckoning.angle_between(-turned, q) == pytest.approx(angle, abs=1e-6)


def test_single_precision_rounding_gives_no_angle():
    q = frames.exp(np.random.default_rng(0).uniform(-1, 1, (1000, 3)))
    assert dead_reckoning.angle_between(q.astype(np.float32).astype(float), q).max() < 1e-6


def test_extrapolation_age_is_limited_to_150_ms_in_both_directions():
    np.testing.assert_allclose(
        dead_reckoning.clamp_age(np.array([-1.0, 0.0, 0.1, 0.15, 9.0])), [-0.15, 0, 0.1, 0.15, 0.15]
    )


def test_an_update_is_due_by_distance_angle_or_time():
    zero = np.zeros(1)
    assert not dead_reckoning.needs_update(np.array([0.0049]), np.radians([0.99]), np.array([0.99]))[0]
    assert dead_reckoning.needs_update(np.array([0.0051]), zero, zero)[0]
    assert dead_reckoning.needs_update(zero, np.radians([1.01]), zero)[0]
    assert dead_reckoning.needs_update(zero, zero, np.array([1.0]))[0]


def test_a_correction_decays_within_100_ms_also_if_restarted():
    assert dead_reckoning.blend_weight(0.0) == dead_reckoning.blend_weight(-1.0) == 1.0
    assert dead_reckoning.blend_weight(0.1) == pytest.approx(0.05, abs=1e-3)
    assert dead_reckoning.blend_weight(1.0) < 1e-12
    assert dead_reckoning.blend_weight(1 / 60) ** 6 == pytest.approx(dead_reckoning.blend_weight(0.1))
