"""Impulses of large islands, without a Delassus matrix: the velocities of touched bodies follow every change of one.

The velocity along a row is J V, where V are the changes of velocity that all impulses so far give to the bodies of its
contact. A change of an impulse adds M^-1 J^T times it to V. Both cost as much as the contact has touched neighbours in
its trees and degrees of freedom, however many contacts the island has.

Sweeps alone converge slowly where many contacts share a body. The change that a sweep makes serves as the gradient of a
nonlinear conjugate gradient method: Silcowitz-Hansen, Niebe, Erleben, A nonsmooth nonlinear conjugate gradient method
for interactive contact force problems, The Visual Computer 26, 2010.
"""

import warp as wp

from vinesim.kernels.contact.structs import (
    IS_CONSTRAINED,
    Contacts,
    Geoms,
    RigidBodies,
    RigidFactors,
    Rows,
    TouchedBodies,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def velocity_along(
    value: wp.float64, row: int, geoms: Geoms, rigid: RigidBodies, contacts: Contacts, touched: TouchedBodies,
    rows: Rows,
):  # fmt: skip
    """Add the velocity [m/s] along a row that the impulses so far give."""
    c = row // 3
    slot = contacts.body_slot[c]
    for k in range(6):
        value = value + rows.plant_jacobian[row, k] * touched.velocity[slot, k]
    if contacts.other[c] < 0:
        other = contacts.other_slot[c]
        for k in range(6):
            value = value + rows.plant_jacobian[row, 6 + k] * touched.velocity[other, k]
    else:
        dof = geoms.dof[contacts.other[c]]
        while dof >= 0:
            value = value + rows.rigid_jacobian[row, dof] * rows.rigid_velocity[dof]
            dof = rigid.dof_parent[dof]
    return value


@wp.func
def add_response(
    row: int, start: int, end: int, change: wp.float64, response: wp.array2d(dtype=wp.float64),
    velocity_out: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Add what an impulse along a row does to the touched bodies from one slot to another."""
    for b in range(start, end):
        for k in range(6):
            velocity_out[b, k] = velocity_out[b, k] + change * response[row, 6 * (b - start) + k]


@wp.func
def add_impulse(
    row: int, change: wp.float64, counters: wp.array(dtype=wp.int32), geoms: Geoms, rigid: RigidBodies,
    factors: RigidFactors, contacts: Contacts, touched_out: TouchedBodies, rows_out: Rows,
):  # fmt: skip
    """Let the velocities follow a change [N s] of the impulse along a row."""
    c = row // 3
    slot = contacts.body_slot[c]
    start = touched_out.tree_start[slot]
    add_response(row, start, touched_out.tree_end[slot], change, rows_out.plant_response, touched_out.velocity)
    if contacts.other[c] < 0:
        other = contacts.other_slot[c]
        other_start = touched_out.tree_start[other]
        if other_start != start:
            end = touched_out.tree_end[other]
            add_response(row, other_start, end, change, rows_out.other_response, touched_out.velocity)
    elif geoms.dof[contacts.other[c]] >= 0:
        first = int(0)  # noqa: RUF046 (Warp's way to declare a variable that changes)
        last = rows_out.rigid_velocity.shape[0]
        if counters[IS_CONSTRAINED] == 0:
            tree = rigid.dof_tree[geoms.dof[contacts.other[c]]]
            first = factors.tree_dof[tree]
            last = first + factors.tree_dof_count[tree]
        for dof in range(first, last):
            rows_out.rigid_velocity[dof] = rows_out.rigid_velocity[dof] + change * rows_out.rigid_response[row, dof]


IMPULSE_BEFORE = wp.constant(0)
"""Column of the scratch matrix with the impulses from before the last sweep."""
DIRECTION = wp.constant(1)
"""Column of the scratch matrix with the direction of search."""


@wp.func
def save_impulses_before_sweep(first: int, last: int, island_contact: wp.array(dtype=wp.int32), rows_out: Rows):
    """Keep the impulses of an island, to know what a sweep changes."""
    for m in range(first, last):
        for row in range(3 * island_contact[m], 3 * island_contact[m] + 3):
            rows_out.newton_system[row, IMPULSE_BEFORE] = rows_out.impulse[row]


@wp.func
def accelerate(
    first: int, last: int, gradient_before: wp.float64, island_contact: wp.array(dtype=wp.int32),
    counters: wp.array(dtype=wp.int32), geoms: Geoms, rigid: RigidBodies, factors: RigidFactors, contacts: Contacts,
    touched_out: TouchedBodies, rows_out: Rows,
):  # fmt: skip
    """Go on in the conjugate direction after a sweep; returns the square of the gradient [N^2 s^2].

    ``gradient_before``: that of the sweep before; 0 after none. A gradient that grows begins the search anew.
    """
    zero = wp.float64(0.0)
    gradient = wp.float64(0.0)
    for m in range(first, last):
        for row in range(3 * island_contact[m], 3 * island_contact[m] + 3):
            change = rows_out.impulse[row] - rows_out.newton_system[row, IMPULSE_BEFORE]
            gradient = gradient + change * change
    share = wp.float64(0.0)
    if gradient_before > zero and gradient <= gradient_before:
        share = gradient / gradient_before
    for m in range(first, last):
        for row in range(3 * island_contact[m], 3 * island_contact[m] + 3):
            change = rows_out.impulse[row] - rows_out.newton_system[row, IMPULSE_BEFORE]
            further = zero
            if share > zero:
                further = share * rows_out.newton_system[row, DIRECTION]
            if further != zero:
                rows_out.impulse[row] = rows_out.impulse[row] + further
                add_impulse(row, further, counters, geoms, rigid, factors, contacts, touched_out, rows_out)
            rows_out.newton_system[row, DIRECTION] = further + change
    return gradient
