"""Projected Gauss-Seidel on the impulses of the contacts: Coulomb cones, contact by contact, with Newton steps between.

The conditions: v = A x + v_free + bias + compliance x along each row; normal impulses x_n >= 0 with v_n >= 0 and
x_n v_n = 0; friction |x_t| <= mu x_n against the sliding. In double precision.
"""

import warp as wp

from vinesim.kernels.contact.newton import newton_step
from vinesim.kernels.contact.structs import Contacts, Islands, Parameters, Rows

wp.set_module_options({"enable_backward": False})

MIN_IMPULSE_SCALE = wp.constant(wp.float64(1.0e-5))
"""[N s] The largest impulse counts as at least this when convergence is judged. TUNED: 1 mN over 10 ms."""


@wp.func
def row_residual(
    row: int,
    compliance: wp.float64,
    first: int,
    last: int,
    island_contact: wp.array(dtype=wp.int32),
    delassus: wp.array2d(dtype=wp.float64),
    velocity_free: wp.array(dtype=wp.float64),
    bias: wp.array(dtype=wp.float64),
    impulse: wp.array(dtype=wp.float64),
):
    """Velocity [m/s] along a row, bias and compliance included, with the impulses of its island."""
    r = velocity_free[row] + bias[row] + compliance * impulse[row]
    for m in range(first, last):
        i = 3 * island_contact[m]
        r = (
            r
            + delassus[row, i] * impulse[i]
            + delassus[row, i + 1] * impulse[i + 1]
            + delassus[row, i + 2] * impulse[i + 2]
        )
    return r


@wp.func
def relax_contact(
    c: int,
    mu: wp.float64,
    compliance: wp.float64,
    first: int,
    last: int,
    island_contact: wp.array(dtype=wp.int32),
    delassus: wp.array2d(dtype=wp.float64),
    velocity_free: wp.array(dtype=wp.float64),
    bias: wp.array(dtype=wp.float64),
    impulse_out: wp.array(dtype=wp.float64),
):
    """One Gauss-Seidel step of a contact, normal and then friction; returns the largest change of an impulse [N s]."""
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    n = 3 * c
    r = row_residual(n, compliance, first, last, island_contact, delassus, velocity_free, bias, impulse_out)
    before = impulse_out[n]
    normal = wp.max(zero, before - r / (delassus[n, n] + compliance))
    impulse_out[n] = normal
    change = wp.abs(normal - before)

    u = n + 1
    v = n + 2
    ru = row_residual(u, compliance, first, last, island_contact, delassus, velocity_free, bias, impulse_out)
    rv = row_residual(v, compliance, first, last, island_contact, delassus, velocity_free, bias, impulse_out)
    # the larger eigenvalue of the tangential block: the step stays inside the cone's convergence
    mean = half * (delassus[u, u] + delassus[v, v]) + compliance
    spread = half * (delassus[u, u] - delassus[v, v])
    eigenvalue = mean + wp.sqrt(spread * spread + delassus[u, v] * delassus[u, v])
    fu = impulse_out[u] - ru / eigenvalue
    fv = impulse_out[v] - rv / eigenvalue
    tangential = wp.sqrt(fu * fu + fv * fv)
    limit = mu * normal
    if tangential > limit:
        fu = fu * limit / wp.max(tangential, wp.float64(1.0e-30))
        fv = fv * limit / wp.max(tangential, wp.float64(1.0e-30))
    change = wp.max(change, wp.abs(fu - impulse_out[u]) + wp.abs(fv - impulse_out[v]))
    impulse_out[u] = fu
    impulse_out[v] = fv
    return change


@wp.func
def save_impulses(
    first: int,
    last: int,
    island_contact: wp.array(dtype=wp.int32),
    impulse: wp.array(dtype=wp.float64),
    system_out: wp.array2d(dtype=wp.float64),
):
    """Keep the impulses of one island in the last column of the scratch matrix."""
    for m in range(first, last):
        for k in range(3):
            row = 3 * island_contact[m] + k
            system_out[row, system_out.shape[1] - 1] = impulse[row]


@wp.func
def restore_impulses(
    first: int,
    last: int,
    island_contact: wp.array(dtype=wp.int32),
    system: wp.array2d(dtype=wp.float64),
    impulse_out: wp.array(dtype=wp.float64),
):
    """Go back to the impulses that were kept."""
    for m in range(first, last):
        for k in range(3):
            row = 3 * island_contact[m] + k
            impulse_out[row] = system[row, system.shape[1] - 1]


@wp.kernel
def solve_islands(
    # model
    parameters: Parameters,
    max_sweeps: int,
    max_newton_steps: int,
    max_newton_contacts: int,
    tolerance: wp.float64,
    # in
    contacts: Contacts,
    # out
    islands_out: Islands,
    rows_out: Rows,
):
    """One thread per island: solve it from the guess in ``impulse`` on.

    Contacts that depend on each other (two fingers about a bunch) slow Gauss-Seidel down: within a few sweeps it finds
    which contacts stick, slide or open, and takes a hundred for the rest. So small islands take a Newton step after
    every other sweep, at first. If these do not settle, sweeps alone go on from where they began.
    """
    island = wp.tid()
    first = islands_out.start[island]
    last = islands_out.start[island + 1]
    sweeps = int(0)  # noqa: RUF046 (Warp's way to declare a variable that changes)
    busy = bool(True)
    while busy and sweeps < max_sweeps:
        change = wp.float64(0.0)
        largest = wp.float64(MIN_IMPULSE_SCALE)
        for m in range(first, last):
            c = islands_out.contact[m]
            moved = relax_contact(
                c, contacts.friction[c], parameters.compliance, first, last, islands_out.contact,
                rows_out.delassus, rows_out.velocity_free, rows_out.bias, rows_out.impulse,
            )  # fmt: skip
            change = wp.max(change, moved)
            largest = wp.max(largest, rows_out.impulse[3 * c])
        sweeps = sweeps + 1
        busy = change > tolerance * largest
        if busy and last - first <= max_newton_contacts and sweeps % 2 == 0 and sweeps <= 2 * max_newton_steps + 2:
            if sweeps <= 2 * max_newton_steps:
                if sweeps == 2:
                    save_impulses(first, last, islands_out.contact, rows_out.impulse, rows_out.newton_system)
                newton_step(
                    parameters.compliance, first, last, islands_out.contact, contacts.friction, rows_out.delassus,
                    rows_out.velocity_free, rows_out.bias, rows_out.newton_system, rows_out.impulse,
                )  # fmt: skip
            else:
                restore_impulses(first, last, islands_out.contact, rows_out.newton_system, rows_out.impulse)
    islands_out.sweeps[island] = sweeps
