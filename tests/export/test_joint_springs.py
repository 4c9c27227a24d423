"""Hinges in series have the torque and the stiffness of a ball joint with vinesim's spring."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.core import frames
from vinesim.export.joint_springs import hinge_springs


def spring_energy(theta0: np.ndarray, K: np.ndarray, compliance: np.ndarray, turn: np.ndarray) -> float:
    """Energy of a spring whose body is turned by ``turn`` [rad], in the body's axes, from the drawn shape ``theta0``,
    on a support that gives way."""
    after = frames.log(frames.multiply(frames.exp(theta0), frames.exp(turn)))
    assert not compliance.any()
    return 0.5 * (K * after * after).sum()


def hinge_energy(axes: np.ndarray, stiffness: np.ndarray, rest: np.ndarray, turn: np.ndarray) -> float:
    """Energy of three hinges in series at the angles [3] that turn the body by ``turn`` [rad], in its drawn axes."""
    angles = np.zeros(3)
    for _ in range(20):

        def rotation(a: np.ndarray) -> np.ndarray:
            q = frames.IDENTITY
            for axis, angle in zip(axes, a, strict=True):
                q = frames.multiply(q, frames.exp(angle * axis))
            return frames.log(q)

        J = np.stack([(rotation(angles + e) - rotation(angles - e)) / 2e-6 for e in 1e-6 * np.eye(3)], 1)
        angles = angles - np.linalg.solve(J, rotation(angles) - turn)
    return 0.5 * (stiffness * (angles - rest) ** 2).sum()


def derivatives(energy, h: float = 1e-3) -> tuple[np.ndarray, np.ndarray]:
    """Gradient [3] and Hessian [3, 3] of a function of three numbers at 0, by central differences."""
    e = h * np.eye(3)
    gradient = np.array([energy(x) - energy(-x) for x in e]) / (2 * h)
    hessian = np.array([[sum(a * b * energy(a * x + b * y) for a in (1, -1) for b in (1, -1)) for x in e] for y in e])
    return gradient, hessian / (4 * h * h)


@pytest.mark.parametrize("seed", range(4))
def test_hinges_have_the_torque_and_stiffness_of_the_spring(seed):
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=3) * 0.3
    K = rng.uniform(0.5, 2.0, 3)
    none = np.zeros((1, 3, 3))
    one = hinge_springs(frames.exp(theta)[None], K[None], 0.01 * K[None], none)
    wanted = derivatives(lambda turn: spring_energy(theta, K, none[0], turn))
    made = derivatives(lambda turn: hinge_energy(one.axes[0], one.stiffness[0], one.rest[0], turn))
    np.testing.assert_allclose(made[0], wanted[0], atol=1e-5)
    np.testing.assert_allclose(made[1], wanted[1], atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(one.axes[0], axis=1), 1.0)


def test_orthogonal_hinges_have_the_same_torque_and_nearly_the_same_stiffness():
    theta = np.array([0.01, 0.1, -0.08])
    K = np.array([0.77, 1.0, 1.0])
    none = np.zeros((1, 3, 3))
    one = hinge_springs(frames.exp(theta)[None], K[None], 0.01 * K[None], none, orthogonal=True)
    np.testing.assert_allclose(one.axes[0] @ one.axes[0].T, np.eye(3), atol=1e-9)
    wanted = derivatives(lambda turn: spring_energy(theta, K, none[0], turn))
    made = derivatives(lambda turn: hinge_energy(one.axes[0], one.stiffness[0], one.rest[0], turn))
    np.testing.assert_allclose(made[0], wanted[0], atol=1e-5)
    np.testing.assert_allclose(made[1], wanted[1], atol=5e-3)


def test_a_support_in_series_softens_the_joint_about_its_axis():
    K = np.array([[1.0, 2.0, 2.0]])
    compliance = np.diag([0.0, 0.5, 0.0])[None]
    one = hinge_springs(frames.IDENTITY[None], K, 0.0 * K, compliance)
    np.testing.assert_allclose(one.stiffness[0], [1.0, 1.0 / (1.0 / 2.0 + 0.5), 2.0], rtol=1e-6)


def test_a_joint_without_spring_stays_free():
    free = np.zeros((1, 3))
    for orthogonal in (False, True):
        one = hinge_springs(frames.IDENTITY[None], free, free, np.zeros((1, 3, 3)), orthogonal=orthogonal)
        assert not one.stiffness.any()
        assert not one.rest.any()
        np.testing.assert_allclose(np.abs(np.linalg.det(one.axes[0])), 1.0)
