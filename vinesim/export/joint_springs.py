"""Three hinges in place of each ball joint: axes, stiffness, damping and rest angles with the same forces.

The spring of a joint has the energy theta^T K theta / 2 of its rotation vector theta
(:func:`vinesim.kernels.plants.forces.spring_torque`). Other simulators offer springs about single axes. So the joint
becomes three hinges in series, whose zero is the drawn shape. The energy of three hinge springs matches this energy in
gradient and Hessian there: the torque, and so the equilibrium under gravity, and the frequencies of small vibrations
are the same.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames

_STEP = 2e-3
"""[rad] Step of the central differences of the Hessian. DERIVED: truncation and rounding both cause relative errors
below 1e-6."""


@dataclasses.dataclass(frozen=True)
class HingeSprings:
    """Hinges of joints, three for each joint, in order from the parent to the body."""

    axes: np.ndarray
    """[joint, 3, 3] Unit vectors of the axes in the body's frame at angle 0; ``axes[j, k]`` is the axis of hinge k."""
    stiffness: np.ndarray
    """[joint, 3] N m/rad."""
    damping: np.ndarray
    """[joint, 3] N m s/rad."""
    rest: np.ndarray
    """[joint, 3] rad, angle at which the spring is slack."""


def hinge_springs(
    drawn: np.ndarray, stiffness: np.ndarray, damping: np.ndarray, compliance: np.ndarray, *, orthogonal: bool = False
) -> HingeSprings:
    """Returns the hinges of joints.

    The axes are almost those of torsion and of bending in two directions, in the drawn shape. Hinges in series have
    off-diagonal terms in their Hessian, half of the torque about the third axis. Axes that are not exactly orthogonal
    cancel these terms.

    Args:
        drawn: [joint, 4] rotation of the joint in the drawn shape, xyzw.
        stiffness: [joint, 3] N m/rad, K of the joint.
        damping: [joint, 3] N m s/rad.
        compliance: [joint, 3, 3] rad/(N m), compliance of the support in series with the joint, in the joint's middle
            axes.
        orthogonal: whether the axes must be orthogonal; then they cancel these terms only where the bend is small.
    """
    theta = frames.log(drawn.astype(float))
    K = stiffness.astype(float)
    torque, S = _gradient_and_hessian(theta, K)
    soft = np.flatnonzero(np.abs(compliance).max((1, 2), initial=0.0) > 0.0)
    S[soft] = np.linalg.inv(np.linalg.inv(S[soft]) + compliance[soft])
    if orthogonal:
        axes = _orthogonal_axes(S, torque)
    else:
        axes = _conjugate_axes(S, torque)
    axes /= np.linalg.norm(axes, axis=2, keepdims=True)
    about = np.einsum("jki,jim,jkm->jk", axes, S, axes)
    along = np.einsum("jki,ji->jk", axes, torque)
    spring = np.maximum(about, 0.0)
    return HingeSprings(
        axes=frames.rotate(frames.exp(-0.5 * theta)[:, None], axes),
        stiffness=spring,
        damping=np.einsum("jki,ji,jki->jk", axes, damping.astype(float), axes),
        rest=np.where(spring > 0.0, -along / np.where(spring > 0.0, spring, 1.0), 0.0),
    )


def _gradient_and_hessian(theta: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns gradient [joint, 3] N m and Hessian [joint, 3, 3] N m/rad of theta^T K theta / 2 with respect to a
    rotation vector in the middle axes, at ``theta`` [joint, 3] rad."""
    half = frames.exp(0.5 * theta)

    def energy(turn: np.ndarray) -> np.ndarray:
        after = frames.log(frames.multiply(half, frames.multiply(frames.exp(turn), half)))
        return 0.5 * (K * after * after).sum(-1)

    step = _STEP * np.eye(3)
    here = energy(0.0 * theta)
    gradient = np.empty_like(theta)
    hessian = np.empty((*theta.shape, 3))
    for i in range(3):
        ahead, behind = energy(step[i] + 0.0 * theta), energy(-step[i] + 0.0 * theta)
        hessian[:, i, i] = (ahead - 2.0 * here + behind) / _STEP**2
        for j in range(i):
            corners = [a * b * energy(a * step[i] + b * step[j] + 0.0 * theta) for a in (1, -1) for b in (1, -1)]
            hessian[:, i, j] = hessian[:, j, i] = sum(corners) / (4.0 * _STEP**2)
    # the gradient is exact: s K theta + (1 - s) n n^T K theta
    angle = np.linalg.norm(theta, axis=1, keepdims=True)
    s = 1.0 / np.sinc(0.5 * angle / np.pi)
    n = theta / np.maximum(angle, 1e-12)
    gradient[:] = s * K * theta + (1.0 - s) * (n * K * theta).sum(1, keepdims=True) * n
    return gradient, hessian


def _conjugate_axes(S: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Returns axes [joint, 3, 3] of hinges in series whose energy has the Hessian S.

    The rotation vector of hinge angles a is sum a_i A_i + sum over i < j of a_i a_j A_i x A_j / 2. So the energy has
    the mixed derivative A_i^T S A_j + torque . (A_i x A_j) / 2, which must vanish. A_1 is the first axis; the others
    are the second and the third plus shares of the axes before.
    """
    e = np.eye(3)
    axes = np.broadcast_to(e, S.shape).copy()
    stiff = np.flatnonzero(np.linalg.eigvalsh(S)[:, 0] > 0.0)
    S, torque = S[stiff], torque[stiff]

    def mixed(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        bend = (torque * np.cross(one, other)).sum(-1)
        return np.einsum("...i,...ij,...j->...", one, S, other) + 0.5 * bend

    first = np.broadcast_to(e[0], torque.shape)
    second = e[1] - (mixed(first, e[1]) / mixed(first, first))[:, None] * first
    pair = np.stack([first, second], 1)
    matrix = np.stack([[mixed(one, other) for other in (first, second)] for one in (first, second)])
    wanted = np.stack([mixed(first, e[2]), mixed(second, e[2])], -1)
    share = -np.linalg.solve(np.moveaxis(matrix, 2, 0), wanted[..., None])[..., 0]
    axes[stiff, 1] = second
    axes[stiff, 2] = e[2] + np.einsum("jk,jki->ji", share, pair)
    return axes


def _orthogonal_axes(S: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Returns orthonormal axes [joint, 3, 3] whose mixed derivatives are smallest, see :func:`_conjugate_axes`.

    Levenberg-Marquardt over rotations. It starts with the third axis along the bending torque: then one mixed
    derivative remains, of torsion and bending, which a rotation about that axis cancels for torques up to the
    difference of their stiffnesses.
    """
    turn = frames.exp(np.arctan2(torque[:, 2], torque[:, 1])[:, None] * [1.0, 0.0, 0.0])
    turn = frames.multiply(turn, frames.exp(np.array([-0.5 * np.pi, 0.0, 0.0])))
    scale = np.maximum(np.trace(S, axis1=1, axis2=2), 1e-30)

    def residual(q: np.ndarray) -> np.ndarray:
        axes = frames.to_matrix(q)
        product = np.swapaxes(axes, 1, 2) @ S @ axes
        bend = 0.5 * np.einsum("ji,jik->jk", torque, axes)
        mixed = [product[:, 0, 1] + bend[:, 2], product[:, 0, 2] - bend[:, 1], product[:, 1, 2] + bend[:, 0]]
        return np.stack(mixed, -1) / scale[:, None]

    shift = np.full(len(S), 1e-3)
    left = residual(turn)
    for _ in range(40):
        sides = [[residual(frames.multiply(turn, frames.exp(a * e))) for a in (1e-5, -1e-5)] for e in np.eye(3)]
        J = np.stack([(ahead - behind) / 2e-5 for ahead, behind in sides], -1)
        damped = np.swapaxes(J, 1, 2) @ J + shift[:, None, None] * np.eye(3)
        step = -np.linalg.solve(damped, np.einsum("jki,jk->ji", J, left)[..., None])[..., 0]
        tried = frames.multiply(turn, frames.exp(step))
        after = residual(tried)
        better = (after * after).sum(1) < (left * left).sum(1)
        turn = np.where(better[:, None], tried, turn)
        left = np.where(better[:, None], after, left)
        shift = np.where(better, 0.2 * shift, 5.0 * shift)
        shift = np.clip(shift, 1e-9, 1e3)
    return np.swapaxes(frames.to_matrix(turn), 1, 2)
