"""Reference of the inverse kinematics of an arm: strict priorities by singular value decompositions in NumPy."""

from __future__ import annotations

import numpy as np

from vinesim.robot.control.cartesian_controller import MIN_SINGULAR_VALUE


def solve_prioritized_ik(
    tasks: list[tuple[np.ndarray, np.ndarray]],
    posture_rates: np.ndarray,
    min_rates: np.ndarray,
    max_rates: np.ndarray,
    joint_weights: np.ndarray,
) -> np.ndarray:
    """Joint rates [joint] that fulfil ``tasks`` (Jacobian [k, joint], velocity [k]) in order, then ``posture_rates``.

    Strict priority: a task uses only the null space of those before it (Siciliano and Slotine 1991). All rates are
    [joint] rad/s or m/s. ``joint_weights`` [joint]: relative use of the joints. Joints that would exceed ``min_rates``
    or ``max_rates`` are fixed at that bound, one at a time, and the others do the tasks.
    """
    held = np.zeros(len(posture_rates), bool)
    fixed = np.zeros(len(posture_rates))
    while True:
        rates = _solve_task_stack(tasks, posture_rates, np.where(held, 0.0, joint_weights), fixed)
        beyond = np.where(held, 0.0, np.maximum(rates - max_rates, min_rates - rates))
        worst = int(np.argmax(beyond))
        if beyond[worst] <= 1e-9:
            return rates
        held[worst] = True
        fixed[worst] = np.clip(rates[worst], min_rates[worst], max_rates[worst])


def _solve_task_stack(
    tasks: list[tuple[np.ndarray, np.ndarray]], posture: np.ndarray, share: np.ndarray, fixed: np.ndarray
) -> np.ndarray:
    """Rates [joint] ``fixed`` + ``share`` y, where y does each task in the null space of the ones before it."""
    y = np.zeros(len(posture))
    free = np.eye(len(posture))
    for jacobian, wanted in tasks:
        scaled = jacobian * share
        inverse, used = _damped_inverse(scaled @ free)
        y = y + inverse @ (wanted - jacobian @ fixed - scaled @ y)
        free = free - used
    movable = share > 0.0
    wanted = np.where(movable, (posture - fixed) / np.where(movable, share, 1.0), 0.0)
    return fixed + share * (y + free @ (wanted - y))


def _damped_inverse(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pseudo-inverse [joint, k] with small singular values damped, and the projector [joint, joint] on its row
    space."""
    u, s, vt = np.linalg.svd(matrix, full_matrices=False)
    damping = np.where(
        s < MIN_SINGULAR_VALUE, (1.0 - (s / MIN_SINGULAR_VALUE) ** 2) * (0.5 * MIN_SINGULAR_VALUE) ** 2, 0.0
    )
    inverse = (vt.T * (s / np.maximum(s * s + damping, 1e-12))) @ u.T
    used = vt[s > 1e-3 * MIN_SINGULAR_VALUE]
    return inverse, used.T @ used
