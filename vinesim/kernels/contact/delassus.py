"""The Delassus matrix A = J M^-1 J^T: how impulses of contacts change the velocities along their rows.

For plants M^-1 J^T comes from ``row_response``; for rigid bodies from MuJoCo's sparse factor L^T D L of M^ (mass with
implicit servos). For rigid bodies with active constraints the caller fills in the response.

Only the plants' part is assembled, a matrix for each block of contacts that plants couple. Rigid bodies couple blocks.
Their contribution J_r H^-1 J_r^T has the rank of their degrees of freedom and is stored as two factors:
``rigid_jacobian`` and ``rigid_response``.
"""

import warp as wp

from vinesim.kernels.contact.islands import padded
from vinesim.kernels.contact.row_response import EIGHT
from vinesim.kernels.contact.structs import (
    CONTACTS,
    Contacts,
    Geoms,
    Islands,
    RigidBodies,
    RigidFactors,
    Rows,
    SideGroups,
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
    contact: int,
    first: int,
    end: int,
    start: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    column: wp.array(dtype=wp.int32),
    entry: wp.array(dtype=wp.float64),
    inverse: wp.array(dtype=wp.float64),
    jacobian: wp.array2d(dtype=wp.vec3d),
    response: wp.array2d(dtype=wp.vec3d),
):
    """Solve L^T D L x = j for the three rows j of a contact in the rigid Jacobian.

    L^T D L is MuJoCo's factored mass matrix. Only the degrees of freedom from ``first`` to ``end`` of one kinematic
    tree are used. ``entry``: entries of L. ``inverse``: inverse of D.
    """
    ...


@wp.kernel
def respond_rigidly(
    # model
    geoms: Geoms,
    # in
    counters: wp.array(dtype=wp.int32),
    rigid: RigidBodies,
    factors: RigidFactors,
    contacts: Contacts,
    # out
    rows_out: Rows,
):
    """One thread per contact. Compute the velocity changes M^-1 j^T of the touched rigid body's kinematic tree by unit
    impulses along the contact's three rows j.
    """
    c = wp.tid()
    if c >= counters[CONTACTS]:
        return
    other = contacts.other[c]
    if other >= 0 and geoms.dof[other] >= 0:
        last_dof = geoms.dof[other]
        tree = rigid.dof_tree[last_dof]
        first = factors.tree_dof[tree]
        end = first + factors.tree_dof_count[tree]
        if factors.implicit_inverse[last_dof] != wp.float64(0.0):
            solve_rigid_rows(
                c,
                first,
                end,
                factors.row_start,
                factors.row_count,
                factors.column,
                factors.implicit,
                factors.implicit_inverse,
                rows_out.rigid_jacobian,
                rows_out.rigid_response,
            )
        else:
            solve_rigid_rows(
                c,
                first,
                end,
                factors.row_start,
                factors.row_count,
                factors.column,
                factors.plain,
                factors.plain_inverse,
                rows_out.rigid_jacobian,
                rows_out.rigid_response,
            )


@wp.func_native(
    EIGHT
    + """
    const int row_pitch = jacobian.strides[0] / (int)sizeof(double);
    const float* const velocity = response.data + number;
    for (int r = 0; r < 3; ++r) {
        const double* const row = jacobian.data + (3 * (side / 2) + r) * row_pitch + 6 * (side % 2);
        const float j[6] = {(float)row[0], (float)row[1], (float)row[2], (float)row[3], (float)row[4], (float)row[5]};
        float entry[32];
        for (int c = 0; c < width; c += 8) {
            Eight sum = {};
            for (int k = 0; k < 6; ++k) sum = sum + j[k] * *(const Eight*)(velocity + k * width + c);
            *(Eight*)(entry + c) = sum;
        }
        for (int s = 0; s < count; ++s) {
            double* const to = delassus.data + at + r * pitch + 3 * (place.data[sides.data[start + s] / 2] - first_place);
            for (int k = 0; k < 3; ++k) to[k] += (double)entry[3 * s + k];
        }
    }
"""
)
def add_entries(
    side: int,
    jacobian: wp.array2d(dtype=wp.float64),
    response: wp.array(dtype=float),
    number: int,
    width: int,
    sides: wp.array(dtype=wp.int32),
    start: int,
    count: int,
    place: wp.array(dtype=wp.int32),
    first_place: int,
    delassus: wp.array(dtype=wp.float64),
    at: int,
    pitch: int,
):
    """Add to the Delassus matrix the velocities along the three rows of one contact side, by unit impulses along the
    rows of a group of sides.

    A *side* is one body of a contact (:mod:`vinesim.kernels.contact.row_response`). jacobian: [row, 12]. response:
    velocities of bodies by unit impulses of each group; those of the body of ``side`` begin at index ``number`` and
    have ``width`` columns. sides: list of sides, in which the group has ``count`` sides from ``start`` on. place:
    [contact] index in the list of all islands' contacts; ``first_place`` is the index of the block's first contact.
    delassus: entries of the matrix; the rows of ``side`` begin at ``at`` and are ``pitch`` apart.
    """
    ...


@wp.func_native("""
    for (int i = 0; i < count; ++i) values.data[at + i] = 0.0;
""")
def clear_entries(values: wp.array(dtype=wp.float64), at: int, count: int):
    """Set ``count`` entries to zero, from ``at`` on."""
    ...


@wp.kernel
def assemble_delassus(
    # in
    counters: wp.array(dtype=wp.int32),
    contacts: Contacts,
    touched: TouchedBodies,
    islands: Islands,
    groups: SideGroups,
    response: wp.array(dtype=float),
    # out
    rows_out: Rows,
):
    """One thread per contact. Compute the plants' part of J M^-1 J^T for its three rows and all rows of its block."""
    c = wp.tid()
    if c >= counters[CONTACTS]:
        return
    block = contacts.block[c]
    first = islands.block_start[block]
    pitch = islands.row_start[block + 1] - islands.row_start[block]
    at = islands.matrix_start[block] + 3 * (contacts.place[c] - first) * pitch
    clear_entries(rows_out.delassus, at, 3 * pitch)
    for k in range(2):
        slot = contacts.body_slot[c]
        if k == 1:
            slot = contacts.other_slot[c]
        if slot >= 0:
            tree = touched.tree_start[slot]
            group = groups.first[tree]
            while groups.tree[group] == tree:
                start = groups.start[group]
                count = groups.start[group + 1] - start
                width = padded(3 * count)
                number = groups.response[group] + (slot - tree) * 6 * width
                add_entries(
                    2 * c + k,
                    rows_out.plant_jacobian,
                    response,
                    number,
                    width,
                    groups.side,
                    start,
                    count,
                    contacts.place,
                    first,
                    rows_out.delassus,
                    at,
                    pitch,
                )
                group = group + 1
