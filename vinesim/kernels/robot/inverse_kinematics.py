"""Differential inverse kinematics of one arm: joint rates that fulfil tasks in order of priority, within bounds.

A task consists of wanted velocities along the rows of a Jacobian. The damped pseudo-inverse of each task acts only in
the null space of the tasks of higher priority (Siciliano and Slotine 1991). The singular value decomposition of a
task's few rows is a one-sided Jacobi iteration (Hestenes 1958): rotations make the rows orthogonal; their lengths then
are the singular values.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

MAX_SWEEPS = wp.constant(30)
"""Largest number of sweeps of Jacobi rotations; three rows need four to six."""
ORTHOGONAL = wp.constant(wp.float64(1e-14))
"""Cosine of the angle between two rows below which the rows count as orthogonal."""
NEGLIGIBLE_SQUARE = wp.constant(wp.float64(1e-24))
"""Squared length below which a row counts as zero, because it consists of rounding errors."""
RANK_TOLERANCE = wp.constant(wp.float64(1e-3))
"""Share of ``min_singular_value``; a direction with a smaller singular value stays free for tasks of lower priority."""
BOUND_TOLERANCE = wp.constant(wp.float64(1e-9))
"""Excess of a joint rate over its bound that is ignored [rad/s or m/s]."""


@wp.struct
class IkScratch:
    """Work arrays of the solver for one arm, with n joints and m rows of all tasks together."""

    weights: wp.array(dtype=wp.float64)
    """[n] Weights of the joints that may move; zero for joints that are fixed at a bound."""
    fixed: wp.array(dtype=wp.float64)
    """[n] Rates of the joints that are fixed at a bound [rad/s or m/s]."""
    solution: wp.array(dtype=wp.float64)
    """[n] Joint rates divided by their weights."""
    basis: wp.array2d(dtype=wp.float64)
    """[m, n] Rows of the weighted Jacobian, made orthogonal; unit vectors where ``is_used``."""
    residual: wp.array(dtype=wp.float64)
    """[m] Wanted velocities minus the velocities of the solution so far."""
    is_used: wp.array(dtype=wp.int32)
    """[m] 1 if a row of ``basis`` is used by its task, so that tasks of lower priority must not change it."""


@wp.func
def row_dot(a: wp.array2d(dtype=wp.float64), i: int, j: int, n: int):
    """Returns the inner product of rows ``i`` and ``j`` of matrix ``a`` with ``n`` columns."""
    total = wp.float64(0.0)
    for k in range(n):
        total += a[i, k] * a[j, k]
    return total


@wp.func
def orthogonalize_rows(first: int, end: int, n: int, scratch_out: IkScratch):
    """Make rows ``first`` to ``end`` - 1 of ``scratch.basis`` orthogonal by Jacobi rotations, which also turn the
    residual."""
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    for _ in range(MAX_SWEEPS):
        rotations = int(0)
        for i in range(first, end):
            for j in range(i + 1, end):
                alpha = row_dot(scratch_out.basis, i, i, n)
                beta = row_dot(scratch_out.basis, j, j, n)
                gamma = row_dot(scratch_out.basis, i, j, n)
                if wp.abs(gamma) > ORTHOGONAL * wp.sqrt(alpha * beta) and wp.min(alpha, beta) > NEGLIGIBLE_SQUARE:
                    rotations += 1
                    zeta = (beta - alpha) / (two * gamma)
                    t = wp.where(zeta < wp.float64(0.0), -one, one) / (wp.abs(zeta) + wp.sqrt(one + zeta * zeta))
                    c = one / wp.sqrt(one + t * t)
                    s = c * t
                    for k in range(n):
                        a = scratch_out.basis[i, k]
                        b = scratch_out.basis[j, k]
                        scratch_out.basis[i, k] = c * a - s * b
                        scratch_out.basis[j, k] = s * a + c * b
                    a = scratch_out.residual[i]
                    b = scratch_out.residual[j]
                    scratch_out.residual[i] = c * a - s * b
                    scratch_out.residual[j] = s * a + c * b
        if rotations == 0:
            break


@wp.func
def project_out(vector_row: int, last: int, n: int, scratch_out: IkScratch):
    """Remove from row ``vector_row`` of ``scratch.basis`` its components along all used rows before row ``last``."""
    for r in range(last):
        if scratch_out.is_used[r] == 1:
            along = row_dot(scratch_out.basis, vector_row, r, n)
            for k in range(n):
                scratch_out.basis[vector_row, k] -= along * scratch_out.basis[r, k]


@wp.func
def solve_task(
    first: int,
    end: int,
    min_singular_value: wp.float64,
    jacobian: wp.array2d(dtype=wp.float64),
    velocity: wp.array(dtype=wp.float64),
    scratch_out: IkScratch,
):
    """Add to ``scratch.solution`` the joint rates of one task, in the null space of the tasks of higher priority.

    The task has rows ``first`` to ``end`` - 1 of ``jacobian`` [m, n] and of the wanted ``velocity`` [m].
    """
    n = scratch_out.solution.shape[0]
    half = wp.float64(0.5)
    one = wp.float64(1.0)
    for r in range(first, end):
        missing = velocity[r]
        for k in range(n):
            scaled = jacobian[r, k] * scratch_out.weights[k]
            missing -= jacobian[r, k] * scratch_out.fixed[k] + scaled * scratch_out.solution[k]
            scratch_out.basis[r, k] = scaled
        scratch_out.residual[r] = missing
        scratch_out.is_used[r] = 0
        project_out(r, first, n, scratch_out)
    orthogonalize_rows(first, end, n, scratch_out)
    for r in range(first, end):
        square = row_dot(scratch_out.basis, r, r, n)
        value = wp.sqrt(square)
        damping = wp.float64(0.0)
        if value < min_singular_value:
            share = value / min_singular_value
            damping = (one - share * share) * (half * min_singular_value) * (half * min_singular_value)
        gain = scratch_out.residual[r] / wp.max(square + damping, wp.float64(1e-12))
        for k in range(n):
            scratch_out.solution[k] += scratch_out.basis[r, k] * gain
        if value > RANK_TOLERANCE * min_singular_value:
            scratch_out.is_used[r] = 1
            for k in range(n):
                scratch_out.basis[r, k] = scratch_out.basis[r, k] / value


@wp.func
def add_posture(rows: int, posture_rates: wp.array(dtype=wp.float64), scratch_out: IkScratch):
    """Add to ``scratch.solution`` the part of ``posture_rates`` [n] in the null space of all tasks (``rows`` rows)."""
    n = scratch_out.solution.shape[0]
    for k in range(n):
        wanted = wp.float64(0.0)
        if scratch_out.weights[k] > wp.float64(0.0):
            wanted = (posture_rates[k] - scratch_out.fixed[k]) / scratch_out.weights[k]
        scratch_out.basis[rows, k] = wanted - scratch_out.solution[k]
    project_out(rows, rows, n, scratch_out)
    for k in range(n):
        scratch_out.solution[k] += scratch_out.basis[rows, k]


@wp.kernel
def solve_prioritized_ik(
    # in
    task_end: wp.array(dtype=wp.int32),
    jacobian: wp.array2d(dtype=wp.float64),
    velocity: wp.array(dtype=wp.float64),
    posture_rates: wp.array(dtype=wp.float64),
    min_rates: wp.array(dtype=wp.float64),
    max_rates: wp.array(dtype=wp.float64),
    joint_weights: wp.array(dtype=wp.float64),
    min_singular_value: wp.float64,
    # out
    scratch_out: IkScratch,
    rates_out: wp.array(dtype=wp.float64),
):
    """The only thread computes joint rates that fulfil tasks in order of priority, and then approach a posture.

    A joint whose rate exceeds its bounds is fixed at the bound, the largest excess first, and the tasks are solved
    again with the other joints. task_end: [task] row after the task's last row; jacobian: [m, n]; velocity: [m] wanted;
    posture_rates, min_rates, max_rates, rates: [n] rad/s or m/s; joint_weights: [n].
    """
    n = rates_out.shape[0]
    tasks = task_end.shape[0]
    zero = wp.float64(0.0)
    for k in range(n):
        scratch_out.weights[k] = joint_weights[k]
        scratch_out.fixed[k] = zero
    for _ in range(n + 1):
        for k in range(n):
            scratch_out.solution[k] = zero
        first = int(0)
        for t in range(tasks):
            solve_task(first, task_end[t], min_singular_value, jacobian, velocity, scratch_out)
            first = task_end[t]
        add_posture(first, posture_rates, scratch_out)
        worst = int(0)
        excess = wp.float64(0.0)
        for k in range(n):
            rates_out[k] = scratch_out.fixed[k] + scratch_out.weights[k] * scratch_out.solution[k]
            beyond = wp.max(rates_out[k] - max_rates[k], min_rates[k] - rates_out[k])
            if scratch_out.weights[k] > zero and beyond > excess:
                worst = k
                excess = beyond
        if excess <= BOUND_TOLERANCE:
            break
        scratch_out.fixed[worst] = wp.clamp(rates_out[worst], min_rates[worst], max_rates[worst])
        scratch_out.weights[worst] = zero
