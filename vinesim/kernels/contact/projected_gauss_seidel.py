"""Projected Gauss-Seidel on the impulses of the contacts of islands, contact by contact, with Newton steps between.

The conditions are those of :mod:`vinesim.kernels.contact.friction_law`.
"""

import warp as wp

from vinesim.kernels.compiler_flags import INLINE_ALL
from vinesim.kernels.contact.conjugate_gradient import follow_conjugate_direction
from vinesim.kernels.contact.friction_law import MIN_IMPULSE_SCALE, relaxed, size_of_change
from vinesim.kernels.contact.island_system import (
    IslandSystem,
    contact_residual,
    contact_row,
    gather_island,
    island_dofs,
    push_rigid_bodies,
    rigid_entry,
    scatter_impulses,
    set_three,
    three,
    update_rigid_velocity,
)
from vinesim.kernels.contact.newton import newton_step
from vinesim.kernels.contact.structs import ISLANDS, Contacts, Geoms, Islands, Parameters, Rows

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINE_ALL})

NEWTON_PERIOD = wp.constant(10)
"""Number of sweeps between further Newton steps of an island that did not converge with the first Newton steps.
TUNED"""


@wp.func
def relax_contact(
    place: int, block: int, island: int, islands: Islands, matrix: wp.array(dtype=wp.float64), system_out: IslandSystem
):
    """Take one Gauss-Seidel step of a contact. Returns the size of the change of its impulse [N s]."""
    zero = wp.float64(0.0)
    row = contact_row(place, block, islands)
    before = three(row, system_out.impulse)
    residual = contact_residual(place, block, island, islands, matrix, system_out)
    after = relaxed(before, residual, system_out.steps[place], system_out.surface[place])
    change = after - before
    if change[0] != zero or change[1] != zero or change[2] != zero:
        set_three(row, after, system_out.impulse)
        push_rigid_bodies(
            change,
            system_out.response,
            rigid_entry(place, island, islands),
            system_out.velocity,
            islands.first_dof[island],
            island_dofs(island, islands),
        )
    return size_of_change(change)


@wp.func
def sweep(island: int, islands: Islands, matrix: wp.array(dtype=wp.float64), system_out: IslandSystem):
    """Take one Gauss-Seidel step of each contact in turn. Returns the largest change of an impulse and the largest
    normal impulse.

    Both are in N s.
    """
    change = wp.float64(0.0)
    largest = wp.float64(MIN_IMPULSE_SCALE)
    for block in range(islands.first_block[island], islands.first_block[island + 1]):
        for place in range(islands.block_start[block], islands.block_start[block + 1]):
            change = wp.max(change, relax_contact(place, block, island, islands, matrix, system_out))
            row = contact_row(place, block, islands)
            largest = wp.max(largest, system_out.impulse[row])
    return change, largest


@wp.func
def largest_block(island: int, islands: Islands):
    """Returns the number of contacts in the largest block of an island."""
    largest = int(0)
    for block in range(islands.first_block[island], islands.first_block[island + 1]):
        largest = wp.max(largest, islands.block_start[block + 1] - islands.block_start[block])
    return largest


@wp.func_native("""
    for (int i = first; i < last; ++i) target.data[i] = source.data[i];
""")
def copy_rows(first: int, last: int, source: wp.array(dtype=wp.float64), target: wp.array(dtype=wp.float64)):
    """Copy the values of rows ``first`` to ``last``."""
    ...


@wp.func
def solve_island(
    island: int,
    max_sweeps: int,
    max_newton_steps: int,
    max_newton_contacts: int,
    tolerance: wp.float64,
    islands_out: Islands,
    matrix: wp.array(dtype=wp.float64),
    system_out: IslandSystem,
):
    """Solve an island, starting from the initial guess in ``impulse``.

    Gauss-Seidel converges slowly if contacts depend strongly on each other, such as two fingers around a bunch. It
    finds the states of contacts (sticking, sliding, open) within a few sweeps, but takes a hundred sweeps for the
    impulses. So islands of small blocks at first take a Newton step after every sweep, then one in
    :data:`NEWTON_PERIOD`, and conjugate gradients between. Newton steps may lead away from the solution. They are kept
    only if the next sweep changes the impulses less than the sweep before the steps; otherwise sweeps continue from the
    impulses before the steps. In islands with a large block, conjugate gradients are used from the first sweep on.
    """
    first = islands_out.row_start[islands_out.first_block[island]]
    last = islands_out.row_start[islands_out.first_block[island + 1]]
    newton_end = max_newton_steps
    if largest_block(island, islands_out) > max_newton_contacts:
        newton_end = 0
    sweeps = int(0)
    gradient = wp.float64(0.0)
    change_first = wp.float64(0.0)
    is_untested = bool(False)
    busy = bool(True)
    while busy and sweeps < max_sweeps:
        copy_rows(first, last, system_out.impulse, system_out.impulse_before)
        change, largest = sweep(island, islands_out, matrix, system_out)
        sweeps = sweeps + 1
        busy = change > tolerance * largest
        if busy and is_untested and sweeps > newton_end and change > change_first:
            copy_rows(first, last, system_out.impulse_first, system_out.impulse)
            update_rigid_velocity(island, islands_out, system_out)
            is_untested = False
        elif busy and sweeps < max_sweeps:
            if sweeps > newton_end and (newton_end == 0 or sweeps % NEWTON_PERIOD != 0):
                gradient = follow_conjugate_direction(island, first, last, gradient, islands_out, system_out)
                is_untested = False
            else:
                if not is_untested:
                    copy_rows(first, last, system_out.impulse, system_out.impulse_first)
                    change_first = change
                is_untested = True
                gradient = wp.float64(0.0)
                newton_step(island, islands_out, matrix, system_out)
    if busy:
        end_growth(island, islands_out, matrix, system_out)
    islands_out.sweeps[island] = sweeps


@wp.func
def end_growth(island: int, islands: Islands, matrix: wp.array(dtype=wp.float64), system_out: IslandSystem):
    """Scale the impulses x of an island whose solve did not converge, so that they add no energy: x . r <= 0.

    In a solution the residual velocities r are 0 along normals that press and opposite to friction, so a solution is
    not changed. Impulses far from a solution can add any energy. Of the impulses s x with s from 0 to 1, which lie in
    the same friction cones, the largest that add no energy have s = -x . r_0 / x . (r - r_0), where r_0 are the
    residuals without impulses.
    """
    zero = wp.float64(0.0)
    free = wp.float64(0.0)
    own = wp.float64(0.0)
    for block in range(islands.first_block[island], islands.first_block[island + 1]):
        for place in range(islands.block_start[block], islands.block_start[block + 1]):
            row = contact_row(place, block, islands)
            x = three(row, system_out.impulse)
            before = three(row, system_out.free)
            free = free + wp.dot(x, before)
            own = own + wp.dot(x, contact_residual(place, block, island, islands, matrix, system_out) - before)
    if free + own > zero:
        share = wp.max(zero, -free / own)
        for row in range(
            islands.row_start[islands.first_block[island]], islands.row_start[islands.first_block[island + 1]]
        ):
            system_out.impulse[row] = share * system_out.impulse[row]
        update_rigid_velocity(island, islands, system_out)


@wp.kernel
def solve_islands(
    # model
    parameters: Parameters,
    max_sweeps: int,
    max_newton_steps: int,
    max_newton_contacts: int,
    tolerance: wp.float64,
    geoms: Geoms,
    # in
    counters: wp.array(dtype=wp.int32),
    contacts: Contacts,
    # out
    islands_out: Islands,
    system_out: IslandSystem,
    rows_out: Rows,
):
    """One thread per island. Solve it; see :func:`solve_island`."""
    island = wp.tid()
    if island >= counters[ISLANDS]:
        return
    gather_island(island, geoms, contacts, islands_out, rows_out, system_out)
    solve_island(
        island, max_sweeps, max_newton_steps, max_newton_contacts, tolerance, islands_out, rows_out.delassus, system_out
    )
    scatter_impulses(island, parameters.dt, islands_out, system_out, rows_out)
