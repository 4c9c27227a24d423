"""Projected Gauss-Seidel on the impulses of the contacts: Coulomb cones, contact by contact, with Newton steps between.

The conditions: v = A x + v_free + bias + compliance x along each row; normal impulses x_n >= 0 with v_n >= 0 and
x_n v_n = 0; friction |x_t| <= mu x_n against the sliding. In double precision.
"""

import warp as wp

from vinesim.kernels.compiler_flags import INLINE_ALL
from vinesim.kernels.contact.conjugate_gradient import follow_conjugate_direction
from vinesim.kernels.contact.newton import newton_step
from vinesim.kernels.contact.row_velocity import (
    add_impulse,
    delassus_entry,
    row_residual,
    tangential_eigenvalue,
    update_rigid_velocity,
)
from vinesim.kernels.contact.structs import Contacts, Geoms, Islands, RigidBodies, Rows, SolverScratch

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINE_ALL})

MIN_IMPULSE_SCALE = wp.constant(wp.float64(1.0e-5))
"""[N s] The largest impulse counts as at least this when convergence is judged. TUNED: 1 mN over 10 ms."""

NEWTON_PERIOD = wp.constant(10)
"""Sweeps between two further Newton steps of an island that the first ones did not settle. TUNED"""


@wp.func
def relax_contact(
    c: int, island: int, geoms: Geoms, rigid: RigidBodies, contacts: Contacts, islands: Islands, rows_out: Rows
):
    """One Gauss-Seidel step of a contact, normal and then friction; returns the largest change of an impulse [N s]."""
    zero = wp.float64(0.0)
    compliance = contacts.compliance[c]
    n = 3 * c
    r = row_residual(n, geoms, rigid, contacts, islands, rows_out)
    before = rows_out.impulse[n]
    normal = wp.max(zero, before - r / (delassus_entry(n, 0, geoms, rigid, contacts, islands, rows_out) + compliance))
    if normal != before:
        add_impulse(n, normal - before, island, contacts, islands, rows_out)
        rows_out.impulse[n] = normal

    u = n + 1
    v = n + 2
    if normal == zero and rows_out.impulse[u] == zero and rows_out.impulse[v] == zero:
        return wp.abs(normal - before)
    ru = row_residual(u, geoms, rigid, contacts, islands, rows_out)
    rv = row_residual(v, geoms, rigid, contacts, islands, rows_out)
    eigenvalue = tangential_eigenvalue(c, geoms, rigid, contacts, islands, rows_out)
    fu = rows_out.impulse[u] - ru / eigenvalue
    fv = rows_out.impulse[v] - rv / eigenvalue
    tangential = wp.sqrt(fu * fu + fv * fv)
    limit = contacts.friction[c] * normal
    if tangential > limit:
        fu = fu * limit / wp.max(tangential, wp.float64(1.0e-30))
        fv = fv * limit / wp.max(tangential, wp.float64(1.0e-30))
    change_u = fu - rows_out.impulse[u]
    change_v = fv - rows_out.impulse[v]
    if change_u != zero or change_v != zero:
        add_impulse(u, change_u, island, contacts, islands, rows_out)
        add_impulse(v, change_v, island, contacts, islands, rows_out)
    return wp.max(wp.abs(normal - before), wp.abs(change_u) + wp.abs(change_v))


@wp.func
def largest_block(island: int, islands: Islands):
    """Contacts of the largest block of an island."""
    largest = int(0)
    for block in range(islands.first_block[island], islands.first_block[island + 1]):
        largest = wp.max(largest, islands.block_start[block + 1] - islands.block_start[block])
    return largest


@wp.func
def copy_impulses(
    island: int, islands: Islands, impulse: wp.array(dtype=wp.float64), impulse_out: wp.array(dtype=wp.float64)
):
    """Copy the impulses of one island."""
    for m in range(islands.start[island], islands.start[island + 1]):
        for row in range(3 * islands.contact[m], 3 * islands.contact[m] + 3):
            impulse_out[row] = impulse[row]


@wp.func
def solve_island(
    island: int,
    max_sweeps: int,
    max_newton_steps: int,
    max_newton_contacts: int,
    tolerance: wp.float64,
    geoms: Geoms,
    rigid: RigidBodies,
    contacts: Contacts,
    islands_out: Islands,
    scratch_out: SolverScratch,
    rows_out: Rows,
):
    """Solve an island from the guess in ``impulse`` on.

    Contacts that depend on each other (two fingers about a bunch) slow Gauss-Seidel down: within a few sweeps it finds
    which contacts stick, slide or open, and takes a hundred for the rest. So islands of small blocks take a Newton step
    after every sweep, at first. If these do not settle, sweeps go on from where they began, with conjugate
    gradients, as they do from the first one on in islands with a large block.
    """
    first = islands_out.start[island]
    last = islands_out.start[island + 1]
    newton_end = max_newton_steps
    if largest_block(island, islands_out) > max_newton_contacts:
        newton_end = 0
    update_rigid_velocity(island, contacts, islands_out, rows_out)
    sweeps = int(0)
    gradient = wp.float64(0.0)
    busy = bool(True)
    while busy and sweeps < max_sweeps:
        copy_impulses(island, islands_out, rows_out.impulse, scratch_out.impulse_before)
        change = wp.float64(0.0)
        largest = wp.float64(MIN_IMPULSE_SCALE)
        for m in range(first, last):
            c = islands_out.contact[m]
            moved = relax_contact(c, island, geoms, rigid, contacts, islands_out, rows_out)
            change = wp.max(change, moved)
            largest = wp.max(largest, rows_out.impulse[3 * c])
        sweeps = sweeps + 1
        busy = change > tolerance * largest
        if busy and sweeps < max_sweeps:
            if sweeps == newton_end + 1 and newton_end > 0:
                copy_impulses(island, islands_out, scratch_out.impulse_first, rows_out.impulse)
                update_rigid_velocity(island, contacts, islands_out, rows_out)
            elif sweeps > newton_end and (newton_end == 0 or sweeps % NEWTON_PERIOD != 0):
                gradient = follow_conjugate_direction(island, gradient, contacts, islands_out, scratch_out, rows_out)
            else:
                if sweeps == 1:
                    copy_impulses(island, islands_out, rows_out.impulse, scratch_out.impulse_first)
                gradient = wp.float64(0.0)
                newton_step(island, geoms, rigid, contacts, islands_out, scratch_out, rows_out)
    islands_out.sweeps[island] = sweeps


@wp.kernel
def solve_islands(
    # model
    max_sweeps: int,
    max_newton_steps: int,
    max_newton_contacts: int,
    tolerance: wp.float64,
    geoms: Geoms,
    # in
    items: wp.array(dtype=wp.int32),
    rigid: RigidBodies,
    contacts: Contacts,
    # out
    islands_out: Islands,
    scratch_out: SolverScratch,
    rows_out: Rows,
):
    """One thread per island: see :func:`solve_island`."""
    solve_island(
        items[wp.tid()], max_sweeps, max_newton_steps, max_newton_contacts, tolerance, geoms, rigid, contacts,
        islands_out, scratch_out, rows_out,
    )  # fmt: skip
