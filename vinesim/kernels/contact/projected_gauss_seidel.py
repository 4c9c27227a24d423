"""Projected Gauss-Seidel on the impulses of the contacts: Coulomb cones, contact by contact, with Newton steps between.

The conditions: v = A x + v_free + bias + compliance x along each row; normal impulses x_n >= 0 with v_n >= 0 and
x_n v_n = 0; friction |x_t| <= mu x_n against the sliding. In double precision.
"""

import warp as wp

from vinesim.kernels.contact.large_islands import (
    accelerate,
    add_impulse,
    save_impulses_before_sweep,
    velocity_along,
)
from vinesim.kernels.contact.newton import newton_step
from vinesim.kernels.contact.structs import (
    Contacts,
    Geoms,
    Islands,
    Parameters,
    RigidBodies,
    RigidFactors,
    Rows,
    TouchedBodies,
)

wp.set_module_options({"enable_backward": False})

MIN_IMPULSE_SCALE = wp.constant(wp.float64(1.0e-5))
"""[N s] The largest impulse counts as at least this when convergence is judged. TUNED: 1 mN over 10 ms."""


@wp.func
def row_residual(
    row: int,
    compliance: wp.float64,
    first: int,
    last: int,
    is_dense: bool,
    geoms: Geoms,
    rigid: RigidBodies,
    contacts: Contacts,
    touched: TouchedBodies,
    island_contact: wp.array(dtype=wp.int32),
    rows: Rows,
):
    """Velocity [m/s] along a row, bias and compliance included, with the impulses of its island."""
    r = rows.velocity_free[row] + rows.bias[row] + compliance * rows.impulse[row]
    if is_dense:
        for m in range(first, last):
            i = 3 * island_contact[m]
            k = 3 * (m - first)
            r = (
                r
                + rows.delassus[row, k] * rows.impulse[i]
                + rows.delassus[row, k + 1] * rows.impulse[i + 1]
                + rows.delassus[row, k + 2] * rows.impulse[i + 2]
            )
    else:
        r = velocity_along(r, row, geoms, rigid, contacts, touched, rows)
    return r


@wp.func
def relax_contact(
    m: int,
    compliance: wp.float64,
    first: int,
    last: int,
    is_dense: bool,
    counters: wp.array(dtype=wp.int32),
    geoms: Geoms,
    rigid: RigidBodies,
    factors: RigidFactors,
    contacts: Contacts,
    island_contact: wp.array(dtype=wp.int32),
    touched_out: TouchedBodies,
    rows_out: Rows,
):
    """One Gauss-Seidel step of a contact, normal and then friction; returns the largest change of an impulse [N s].

    ``m``: its place in the list of contacts of the islands.
    """
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    c = island_contact[m]
    n = 3 * c
    own = int(0)  # noqa: RUF046 (Warp's way to declare a variable that changes)
    if is_dense:
        own = 3 * (m - first)
    r = row_residual(
        n, compliance, first, last, is_dense, geoms, rigid, contacts, touched_out, island_contact, rows_out
    )  # fmt: skip
    before = rows_out.impulse[n]
    normal = wp.max(zero, before - r / (rows_out.delassus[n, own] + compliance))
    rows_out.impulse[n] = normal
    change = wp.abs(normal - before)
    if not is_dense and normal != before:
        add_impulse(n, normal - before, counters, geoms, rigid, factors, contacts, touched_out, rows_out)

    u = n + 1
    v = n + 2
    ru = row_residual(
        u, compliance, first, last, is_dense, geoms, rigid, contacts, touched_out, island_contact, rows_out
    )  # fmt: skip
    rv = row_residual(
        v, compliance, first, last, is_dense, geoms, rigid, contacts, touched_out, island_contact, rows_out
    )  # fmt: skip
    # the larger eigenvalue of the tangential block: the step stays inside the cone's convergence
    block_uu = rows_out.delassus[u, own + 1]
    block_vv = rows_out.delassus[v, own + 2]
    block_uv = rows_out.delassus[u, own + 2]
    mean = half * (block_uu + block_vv) + compliance
    spread = half * (block_uu - block_vv)
    eigenvalue = mean + wp.sqrt(spread * spread + block_uv * block_uv)
    fu = rows_out.impulse[u] - ru / eigenvalue
    fv = rows_out.impulse[v] - rv / eigenvalue
    tangential = wp.sqrt(fu * fu + fv * fv)
    limit = contacts.friction[c] * normal
    if tangential > limit:
        fu = fu * limit / wp.max(tangential, wp.float64(1.0e-30))
        fv = fv * limit / wp.max(tangential, wp.float64(1.0e-30))
    change_u = fu - rows_out.impulse[u]
    change_v = fv - rows_out.impulse[v]
    rows_out.impulse[u] = fu
    rows_out.impulse[v] = fv
    if not is_dense and (change_u != zero or change_v != zero):
        add_impulse(u, change_u, counters, geoms, rigid, factors, contacts, touched_out, rows_out)
        add_impulse(v, change_v, counters, geoms, rigid, factors, contacts, touched_out, rows_out)
    return wp.max(change, wp.abs(change_u) + wp.abs(change_v))


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
    tolerance: wp.float64,
    geoms: Geoms,
    # in
    counters: wp.array(dtype=wp.int32),
    rigid: RigidBodies,
    factors: RigidFactors,
    contacts: Contacts,
    # out
    touched_out: TouchedBodies,
    islands_out: Islands,
    rows_out: Rows,
):
    """One thread per island: solve it from the guess in ``impulse`` on.

    Contacts that depend on each other (two fingers about a bunch) slow Gauss-Seidel down: within a few sweeps it finds
    which contacts stick, slide or open, and takes a hundred for the rest. So small islands take a Newton step after
    every other sweep, at first. If these do not settle, sweeps alone go on from where they began. Large islands work
    without a Delassus matrix, from ``touched_out.velocity`` and ``rows_out.rigid_velocity``, which were zeroed before.
    """
    island = wp.tid()
    first = islands_out.start[island]
    last = islands_out.start[island + 1]
    is_dense = last - first <= parameters.dense_contacts
    if not is_dense:
        for m in range(first, last):
            for row in range(3 * islands_out.contact[m], 3 * islands_out.contact[m] + 3):
                if rows_out.impulse[row] != wp.float64(0.0):
                    add_impulse(
                        row, rows_out.impulse[row], counters, geoms, rigid, factors, contacts, touched_out, rows_out
                    )
    sweeps = int(0)  # noqa: RUF046 (Warp's way to declare a variable that changes)
    gradient = wp.float64(0.0)
    busy = bool(True)
    while busy and sweeps < max_sweeps:
        if not is_dense:
            save_impulses_before_sweep(first, last, islands_out.contact, rows_out)
        change = wp.float64(0.0)
        largest = wp.float64(MIN_IMPULSE_SCALE)
        for m in range(first, last):
            moved = relax_contact(
                m, parameters.compliance, first, last, is_dense, counters, geoms, rigid, factors, contacts,
                islands_out.contact, touched_out, rows_out,
            )  # fmt: skip
            change = wp.max(change, moved)
            largest = wp.max(largest, rows_out.impulse[3 * islands_out.contact[m]])
        sweeps = sweeps + 1
        busy = change > tolerance * largest
        if busy and not is_dense and sweeps < max_sweeps:
            gradient = accelerate(
                first, last, gradient, islands_out.contact, counters, geoms, rigid, factors, contacts, touched_out,
                rows_out,
            )  # fmt: skip
        if busy and is_dense and sweeps % 2 == 0 and sweeps <= 2 * max_newton_steps + 2:
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
