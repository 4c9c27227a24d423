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


@wp.func_native("""
    const wp::vec3d* const from = jacobian.data + contact * (jacobian.strides[0] / (int)sizeof(wp::vec3d));
    wp::vec3d* const to = response.data + contact * (response.strides[0] / (int)sizeof(wp::vec3d));
    for (int i = first; i < end; ++i) to[i] = from[i];
    for (int i = end - 1; i >= first; --i) {
        const wp::vec3d value = to[i];
        if (value[0] == 0.0 && value[1] == 0.0 && value[2] == 0.0) continue;
        for (int e = start.data[i]; e < start.data[i] + size.data[i] - 1; ++e) to[column.data[e]] -= entry.data[e] * value;
    }
    for (int i = first; i < end; ++i) {
        wp::vec3d value = to[i] * inverse.data[i];
        for (int e = start.data[i]; e < start.data[i] + size.data[i] - 1; ++e) value -= entry.data[e] * to[column.data[e]];
        to[i] = value;
    }
""")
def solve_rigid_rows(
    contact: int, first: int, end: int, start: wp.array(dtype=wp.int32), size: wp.array(dtype=wp.int32),
    column: wp.array(dtype=wp.int32), entry: wp.array(dtype=wp.float64), inverse: wp.array(dtype=wp.float64),
    jacobian: wp.array2d(dtype=wp.vec3d), response: wp.array2d(dtype=wp.vec3d),
):  # fmt: skip
    """Solve L^T D L x = j for the three rows j of a contact, within the degrees of freedom from ``first`` to ``end`` of
    one kinematic tree; ``entry`` of L, ``inverse`` of D."""
    ...


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
    """One thread per contact: M^-1 j of its three rows j, of one kinematic tree of MuJoCo."""
    c = items[wp.tid()]
    other = contacts.other[c]
    if other >= 0 and geoms.dof[other] >= 0:
        last_dof = geoms.dof[other]
        tree = rigid.dof_tree[last_dof]
        first = factors.tree_dof[tree]
        end = first + factors.tree_dof_count[tree]
        if factors.implicit_inverse[last_dof] != wp.float64(0.0):
            solve_rigid_rows(
                c, first, end, factors.row_start, factors.row_count, factors.column, factors.implicit,
                factors.implicit_inverse, rows_out.rigid_jacobian, rows_out.rigid_response,
            )  # fmt: skip
        else:
            solve_rigid_rows(
                c, first, end, factors.row_start, factors.row_count, factors.column, factors.plain,
                factors.plain_inverse, rows_out.rigid_jacobian, rows_out.rigid_response,
            )  # fmt: skip


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
    pitch = islands.row_start[block + 1] - islands.row_start[block]
    at = islands.matrix_start[block] + 3 * (contacts.place[c] - first) * pitch
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
                rows_out.delassus[at + r * pitch + 3 * (m - first) + k] = wp.float64(entries[r, k])
    for k in range(3 * (last - first), pitch):
        for r in range(3):
            rows_out.delassus[at + r * pitch + k] = wp.float64(0.0)
