"""The Delassus matrix A = J M^-1 J^T: how impulses of contacts change the velocities along their rows.

For plants M^-1 is the impulse response of the articulation solver; for rigid bodies it comes from MuJoCo's sparse factor
L^T D L of M^ (mass with implicit servos). Where active constraints bind a rigid body, the caller fills in its response.

Only the plants' part is assembled, a matrix for each block of contacts that plants couple. Rigid bodies couple blocks; what
they add, J_r H^-1 J_r^T, has the rank of their degrees of freedom and stays in its factors: ``rigid_jacobian`` and
``rigid_response``.
"""

import warp as wp

from vinesim.kernels.contact.structs import (
    IS_CONSTRAINED,
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


@wp.func_native("""
    const float* from = body_response.data + source;
    double* to = response.data + target;
    for (int i = 0; i < count; ++i) {
        const double change = factor * from[i];
        to[i] += change;
    }
""")
def add_body_response(
    response: wp.array2d(dtype=wp.float64),
    target: int,
    body_response: wp.array4d(dtype=float),
    source: int,
    count: int,
    factor: wp.float64,
):
    """Add ``factor`` times ``count`` numbers of the body response, from ``source`` on, to a response from ``target`` on.

    Both contiguous. Native, as Warp's loops over arrays in structs are not vectorised.
    """
    ...


@wp.func
def respond_within_tree(
    row: int,
    column: int,
    slot: int,
    touched: TouchedBodies,
    plant_jacobian: wp.array2d(dtype=wp.float64),
    body_response: wp.array4d(dtype=float),
    response_out: wp.array2d(dtype=wp.float64),
):
    """Add to a row's response in one tree what its six entries from ``column`` on, of the body in ``slot``, give.

    The body response is symmetric: what an impulse on one body gives all is read along its row, not down its column.
    """
    count = 6 * (touched.tree_end[slot] - touched.tree_start[slot])
    for j in range(6):
        source = (6 * slot + j) * 6 * body_response.shape[2]
        factor = plant_jacobian[row, column + j]
        add_body_response(response_out, row * response_out.shape[1], body_response, source, count, factor)


@wp.kernel
def inverse_mass_times_jacobian(
    # model
    geoms: Geoms,
    # in
    rigid: RigidBodies,
    factors: RigidFactors,
    contacts: Contacts,
    touched: TouchedBodies,
    counters: wp.array(dtype=wp.int32),
    body_response: wp.array4d(dtype=float),
    # out
    rows_out: Rows,
):
    """One thread per row j: M^-1 j of the plant bodies in contact, and of one kinematic tree if it is unconstrained.

    ``body_response`` [u, 6, t, 6]: change of velocity of plant body u in contact for a unit impulse on body t of its
    tree. The rigid response was zeroed before.
    """
    row = wp.tid()
    c = row // 3
    slot = contacts.body_slot[c]
    start = touched.tree_start[slot]
    for k in range(6 * (touched.tree_end[slot] - start)):
        rows_out.plant_response[row, k] = wp.float64(0.0)
    respond_within_tree(row, 0, slot, touched, rows_out.plant_jacobian, body_response, rows_out.plant_response)
    last_dof = int(-1)
    if contacts.other[c] < 0:
        other = contacts.other_slot[c]
        if touched.tree_start[other] == start:
            respond_within_tree(row, 6, other, touched, rows_out.plant_jacobian, body_response, rows_out.plant_response)
        else:
            for k in range(6 * (touched.tree_end[other] - touched.tree_start[other])):
                rows_out.other_response[row, k] = wp.float64(0.0)
            respond_within_tree(row, 6, other, touched, rows_out.plant_jacobian, body_response, rows_out.other_response)
    else:
        last_dof = geoms.dof[contacts.other[c]]
    if last_dof >= 0 and counters[IS_CONSTRAINED] == 0:
        solve_rigid_row(row, last_dof, rigid, factors, rows_out.rigid_jacobian, rows_out.rigid_response)


@wp.func
def body_velocity_along(
    value: wp.float64, row: int, column: int, slot: int, source_row: int, source: int, contacts: Contacts,
    touched: TouchedBodies, rows: Rows,
):  # fmt: skip
    """Add the velocity along six entries of ``row`` that a unit impulse along ``source_row`` gives the body in a slot.

    ``source``: the contact of ``source_row``.
    """
    start = touched.tree_start[slot]
    at = 6 * (slot - start)
    if touched.tree_start[contacts.body_slot[source]] == start:
        for k in range(6):
            value = value + rows.plant_jacobian[row, column + k] * rows.plant_response[source_row, at + k]
    elif contacts.other[source] < 0 and touched.tree_start[contacts.other_slot[source]] == start:
        for k in range(6):
            value = value + rows.plant_jacobian[row, column + k] * rows.other_response[source_row, at + k]
    return value


@wp.kernel
def assemble_delassus(
    # in
    contacts: Contacts,
    touched: TouchedBodies,
    islands: Islands,
    # out
    rows_out: Rows,
):
    """One thread per row: the plants' entries of J M^-1 J^T with all rows of its block."""
    row = wp.tid()
    c = row // 3
    block = contacts.block[c]
    first = islands.block_start[block]
    last = islands.block_start[block + 1]
    at = islands.matrix_start[block] + (3 * (contacts.place[c] - first) + row % 3) * 3 * (last - first)
    for m in range(first, last):
        source = islands.contact[m]
        for k in range(3):
            column = 3 * source + k
            value = body_velocity_along(
                wp.float64(0.0), row, 0, contacts.body_slot[c], column, source, contacts, touched, rows_out
            )  # fmt: skip
            if contacts.other[c] < 0:
                value = body_velocity_along(
                    value, row, 6, contacts.other_slot[c], column, source, contacts, touched, rows_out
                )  # fmt: skip
            rows_out.delassus[at + 3 * (m - first) + k] = value
