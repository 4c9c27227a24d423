"""The Delassus matrix A = J M^-1 J^T: how impulses of contacts change the velocities along their rows.

For plants M^-1 is the impulse response of the articulation solver; for rigid bodies it comes from MuJoCo's sparse factor
L^T D L of M^ (mass with implicit servos). Where active constraints bind a rigid body, the caller fills in its response.
"""

import warp as wp

from vinesim.kernels.contact.structs import (
    BODIES,
    IS_CONSTRAINED,
    Contacts,
    Geoms,
    Islands,
    PlantBodies,
    RigidBodies,
    RigidFactors,
    Rows,
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
def inverse_mass_times_jacobian(
    # model
    geoms: Geoms,
    # in
    bodies: PlantBodies,
    rigid: RigidBodies,
    factors: RigidFactors,
    contacts: Contacts,
    touched_bodies: wp.array(dtype=wp.int32),
    counters: wp.array(dtype=wp.int32),
    body_response: wp.array2d(dtype=float),
    # out
    rows_out: Rows,
):
    """One thread per row j: M^-1 j of all plant bodies in contact, and of one kinematic tree if it is unconstrained.

    ``body_response`` [6 body, 6 body]: change of velocity of a plant body in contact for a unit impulse on another. The
    rigid response was zeroed before.
    """
    row = wp.tid()
    c = row // 3
    at = 6 * contacts.body_slot[c]
    other_at = 6 * contacts.other_slot[c]
    is_plant = contacts.other[c] < 0
    tree = bodies.tree[contacts.body[c]]
    other_tree = int(-1)  # noqa: RUF046 (Warp's way to declare a variable that changes)
    if is_plant:
        other_tree = bodies.tree[contacts.other_body[c]]
    for b in range(counters[BODIES]):
        tree_b = bodies.tree[touched_bodies[b]]
        for k in range(6 * b, 6 * b + 6):
            change = wp.float64(0.0)
            if tree_b == tree:
                for j in range(6):
                    change = change + rows_out.plant_jacobian[row, j] * wp.float64(body_response[k, at + j])
            if tree_b == other_tree:
                for j in range(6):
                    change = change + rows_out.plant_jacobian[row, 6 + j] * wp.float64(body_response[k, other_at + j])
            rows_out.plant_response[row, k] = change
    last_dof = int(-1)  # noqa: RUF046
    if not is_plant:
        last_dof = geoms.dof[contacts.other[c]]
    if last_dof >= 0 and counters[IS_CONSTRAINED] == 0:
        solve_rigid_row(row, last_dof, rigid, factors, rows_out.rigid_jacobian, rows_out.rigid_response)


@wp.kernel
def assemble_delassus(
    # model
    geoms: Geoms,
    # in
    rigid: RigidBodies,
    contacts: Contacts,
    islands: Islands,
    # out
    rows_out: Rows,
):
    """One thread per row of the Delassus matrix: entries of the contacts of its island; the others are never read."""
    row = wp.tid()
    c = row // 3
    at = 6 * contacts.body_slot[c]
    other_at = 6 * contacts.other_slot[c]
    last_dof = int(-1)  # noqa: RUF046
    if contacts.other[c] >= 0:
        last_dof = geoms.dof[contacts.other[c]]
    for m in range(islands.start[contacts.island[c]], islands.start[contacts.island[c] + 1]):
        for column in range(3 * islands.contact[m], 3 * islands.contact[m] + 3):
            value = wp.float64(0.0)
            for k in range(6):
                value = value + rows_out.plant_jacobian[row, k] * rows_out.plant_response[column, at + k]
            if contacts.other[c] < 0:
                for k in range(6):
                    value = value + rows_out.plant_jacobian[row, 6 + k] * rows_out.plant_response[column, other_at + k]
            dof = int(last_dof)
            while dof >= 0:
                value = value + rows_out.rigid_jacobian[row, dof] * rows_out.rigid_response[column, dof]
                dof = rigid.dof_parent[dof]
            rows_out.delassus[row, column] = value
