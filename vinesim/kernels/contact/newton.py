"""Active-set Newton step on the contacts of one island, from the impulses that projected Gauss-Seidel has reached.

Which contacts are open, stick or slide, and in which direction they slide, is taken as it is: then the conditions are a
linear system. See ``docs/decisions/contact-solver.md``.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

SLIDING_SHARE = wp.constant(wp.float64(0.999999))
"""[1] A contact slides if its friction is at least this share of the largest one."""


@wp.func
def write_newton_rows(
    compliance: wp.float64,
    first: int,
    last: int,
    island_contact: wp.array(dtype=wp.int32),
    friction: wp.array(dtype=wp.float64),
    delassus: wp.array2d(dtype=wp.float64),
    velocity_free: wp.array(dtype=wp.float64),
    bias: wp.array(dtype=wp.float64),
    impulse: wp.array(dtype=wp.float64),
    system_out: wp.array2d(dtype=wp.float64),
):
    """Write the linear system of one island, right-hand side in the column after it.

    Sticking rows: (A + compliance) x = -velocity - bias. Rows of open contacts: x = 0. Friction of sliding contacts: a
    fixed share of the normal impulse.
    """
    zero = wp.float64(0.0)
    size = 3 * (last - first)
    for p in range(last - first):
        j = island_contact[first + p]
        n = 3 * j
        normal = impulse[n]
        tangential = wp.sqrt(impulse[n + 1] * impulse[n + 1] + impulse[n + 2] * impulse[n + 2])
        slides = tangential >= friction[j] * normal * SLIDING_SHARE
        for axis in range(3):
            row = n + axis
            fixed = normal <= zero or (axis > 0 and slides)
            for q in range(last - first):
                for k in range(3):
                    entry = delassus[row, 3 * q + k]
                    if fixed:
                        entry = zero
                    system_out[row, 3 * q + k] = entry
            system_out[row, size] = -velocity_free[row] - bias[row]
            if fixed:
                system_out[row, 3 * p + axis] = wp.float64(1.0)
                system_out[row, size] = zero
                if normal > zero:
                    system_out[row, 3 * p] = -impulse[row] / normal
            else:
                system_out[row, 3 * p + axis] = system_out[row, 3 * p + axis] + compliance


@wp.func
def solve_newton_rows(
    first: int,
    last: int,
    island_contact: wp.array(dtype=wp.int32),
    system_out: wp.array2d(dtype=wp.float64),
    impulse_out: wp.array(dtype=wp.float64),
):
    """Gaussian elimination without pivoting: A is positive definite, and sliding rows change that little."""
    size = 3 * (last - first)
    for k in range(size):
        pivot_row = 3 * island_contact[first + k // 3] + k % 3
        scale = wp.float64(1.0) / system_out[pivot_row, k]
        for m in range(k + 1, size):
            row = 3 * island_contact[first + m // 3] + m % 3
            factor = system_out[row, k] * scale
            if factor != wp.float64(0.0):
                for c in range(k + 1, size + 1):
                    system_out[row, c] = system_out[row, c] - factor * system_out[pivot_row, c]
    for back in range(size):
        k = size - 1 - back
        row = 3 * island_contact[first + k // 3] + k % 3
        value = system_out[row, size]
        for c in range(k + 1, size):
            value = value - system_out[row, c] * impulse_out[3 * island_contact[first + c // 3] + c % 3]
        impulse_out[row] = value / system_out[row, k]


@wp.func
def project_into_cones(
    first: int,
    last: int,
    island_contact: wp.array(dtype=wp.int32),
    friction: wp.array(dtype=wp.float64),
    impulse_out: wp.array(dtype=wp.float64),
):
    """Put the impulses of one island back into their friction cones, where the guess about a contact was wrong."""
    zero = wp.float64(0.0)
    for m in range(first, last):
        j = island_contact[m]
        n = 3 * j
        normal = wp.max(impulse_out[n], zero)
        tangential = wp.sqrt(impulse_out[n + 1] * impulse_out[n + 1] + impulse_out[n + 2] * impulse_out[n + 2])
        share = wp.float64(1.0)
        if tangential > friction[j] * normal:
            share = friction[j] * normal / tangential
        impulse_out[n] = normal
        impulse_out[n + 1] = share * impulse_out[n + 1]
        impulse_out[n + 2] = share * impulse_out[n + 2]


@wp.func
def newton_step(
    compliance: wp.float64,
    first: int,
    last: int,
    island_contact: wp.array(dtype=wp.int32),
    friction: wp.array(dtype=wp.float64),
    delassus: wp.array2d(dtype=wp.float64),
    velocity_free: wp.array(dtype=wp.float64),
    bias: wp.array(dtype=wp.float64),
    system_out: wp.array2d(dtype=wp.float64),
    impulse_out: wp.array(dtype=wp.float64),
):
    """Solve one island, contacts ``first`` to ``last`` of the list, as if each contact stayed what it is."""
    write_newton_rows(
        compliance, first, last, island_contact, friction, delassus, velocity_free, bias, impulse_out, system_out
    )
    solve_newton_rows(first, last, island_contact, system_out, impulse_out)
    project_into_cones(first, last, island_contact, friction, impulse_out)
