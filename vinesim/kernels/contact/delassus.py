"""The Delassus matrix A = J M^-1 J^T: how impulses of contacts change the velocities along their rows.

For plants M^-1 J^T comes from ``row_response``; for rigid bodies from MuJoCo's sparse factor L^T D L of M^ (mass with
implicit servos). Where active constraints bind a rigid body, the caller fills in its response.

Only the plants' part is assembled, a matrix for each block of contacts that plants couple. Rigid bodies couple blocks; what
they add, J_r H^-1 J_r^T, has the rank of their degrees of freedom and stays in its factors: ``rigid_jacobian`` and
``rigid_response``.
"""

import warp as wp

from vinesim.kernels.contact.row_response import SideRows
from vinesim.kernels.contact.structs import (
    Contacts,
    Geoms,
    Islands,
    RigidBodies,
    RigidFactors,
    Rows,
    TouchedBodies,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def factor_entry(is_implicit: bool, e: int, factors: RigidFactors):
    """Entry of L of M^, or of M if nothing is implicit."""
    value = factors.plain[e]
    if is_implicit:
        value = factors.implicit[e]
    return value


@wp.func
def solve_rigid_row(
    row: int, last_dof: int, rigid: RigidBodies, factors: RigidFactors, jacobian: wp.array2d(dtype=wp.float64),
    response_out: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Solve L^T D L x = j for one row j of the Jacobian, within one kinematic tree of MuJoCo."""
    tree = rigid.dof_tree[last_dof]
    first = factors.tree_dof[tree]
    end = first + factors.tree_dof_count[tree]
    for i in range(first, end):
        response_out[row, i] = jacobian[row, i]
    is_implicit = factors.implicit_inverse[last_dof] != wp.float64(0.0)
    for k in range(end - first):
        i = end - 1 - k
        for e in range(factors.row_start[i], factors.row_start[i] + factors.row_count[i] - 1):
            j = factors.column[e]
            response_out[row, j] = response_out[row, j] - factor_entry(is_implicit, e, factors) * response_out[row, i]
    for i in range(first, end):
        pivot = factors.plain_inverse[i]
        if is_implicit:
            pivot = factors.implicit_inverse[i]
        value = response_out[row, i] * pivot
        for e in range(factors.row_start[i], factors.row_start[i] + factors.row_count[i] - 1):
            value = value - factor_entry(is_implicit, e, factors) * response_out[row, factors.column[e]]
        response_out[row, i] = value


@wp.kernel
def respond_rigidly(
    # model
    geoms: Geoms,
    # in
    items: wp.array(dtype=wp.int32),
    rigid: RigidBodies,
    factors: RigidFactors,
    contacts: Contacts,
    # out
    rows_out: Rows,
):
    """One thread per row j: M^-1 j of one kinematic tree of MuJoCo. The response was zeroed before."""
    row = items[wp.tid()]
    other = contacts.other[row // 3]
    if other >= 0 and geoms.dof[other] >= 0:
        solve_rigid_row(row, geoms.dof[other], rigid, factors, rows_out.rigid_jacobian, rows_out.rigid_response)


@wp.func
def side_slot(side: int, contacts: Contacts):
    """Place of a side's body in the list of bodies in contact; -1 if the side is empty."""
    slot = contacts.body_slot[side // 2]
    if side % 2 == 1:
        slot = contacts.other_slot[side // 2]
    return slot


@wp.func
def sides_entries(value: wp.mat33, side: int, source: int, contacts: Contacts, touched: TouchedBodies, sides: SideRows):
    """Add the velocities along the rows of ``side`` that unit impulses along those of ``source`` give.

    Of two sides the one whose body comes later in the list knows the response of the other's.
    """
    slot = side_slot(side, contacts)
    other = side_slot(source, contacts)
    if slot >= 0 and other >= 0:
        start = touched.tree_start[slot]
        if touched.tree_start[other] == start:
            if slot < other or (slot == other and side <= source):
                value = value + wp.transpose(sides.force[side]) * sides.linear[source, slot - start]
                value = value + wp.transpose(sides.moment[side]) * sides.angular[source, slot - start]
            else:
                value = value + wp.transpose(sides.linear[side, other - start]) * sides.force[source]
                value = value + wp.transpose(sides.angular[side, other - start]) * sides.moment[source]
    return value


@wp.kernel
def assemble_delassus(
    # in
    items: wp.array(dtype=wp.int32),
    contacts: Contacts,
    touched: TouchedBodies,
    islands: Islands,
    sides: SideRows,
    # out
    rows_out: Rows,
):
    """One thread per contact: the plants' entries of J M^-1 J^T of its three rows with all rows of its block."""
    c = items[wp.tid()]
    block = contacts.block[c]
    first = islands.block_start[block]
    last = islands.block_start[block + 1]
    size = 3 * (last - first)
    at = islands.matrix_start[block] + 3 * (contacts.place[c] - first) * size
    is_pair = contacts.other_slot[c] >= 0
    for m in range(first, last):
        source = islands.contact[m]
        entries = sides_entries(wp.mat33(), 2 * c, 2 * source, contacts, touched, sides)
        if contacts.other_slot[source] >= 0:
            entries = sides_entries(entries, 2 * c, 2 * source + 1, contacts, touched, sides)
        if is_pair:
            entries = sides_entries(entries, 2 * c + 1, 2 * source, contacts, touched, sides)
            if contacts.other_slot[source] >= 0:
                entries = sides_entries(entries, 2 * c + 1, 2 * source + 1, contacts, touched, sides)
        for r in range(3):
            for k in range(3):
                rows_out.delassus[at + r * size + 3 * (m - first) + k] = wp.float64(entries[r, k])
