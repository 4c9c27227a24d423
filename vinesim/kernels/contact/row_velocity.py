"""Velocities along the rows of contacts, and how they follow the impulses.

v = v_free + B x + J_r w: B x is what impulses do to plants, by the matrix of the contact's block; w = H^-1 J_r^T x are
the changes of the rigid world's velocities, which are kept up to date.
"""

import warp as wp

from vinesim.kernels.contact.structs import Contacts, Geoms, Islands, RigidBodies, Rows

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
    const int pitch = delassus.strides[0] / (int)sizeof(double);
    const int impulse_pitch = impulse.strides[0] / (int)sizeof(double);
    const double* entry = delassus.data + at * pitch;
    double n = 0.0, u = 0.0, v = 0.0;
    for (int m = first; m < last; ++m) {
        const double* x = impulse.data + 3 * contact.data[m] * impulse_pitch;
        n += entry[0] * x[0];
        u += entry[pitch] * x[impulse_pitch];
        v += entry[2 * pitch] * x[2 * impulse_pitch];
        entry += 3 * pitch;
    }
    return n + u + v;
""")
def block_velocity(
    delassus: wp.array(dtype=wp.float64),
    at: int,
    contact: wp.array(dtype=wp.int32),
    first: int,
    last: int,
    impulse: wp.array(dtype=wp.float64),
) -> wp.float64:
    """Velocity [m/s] along a row, whose matrix entries begin at ``at``, by the impulses of the contacts of its block.

    Native, with a sum for each axis: one sum would wait for itself, and Warp's loops count slowly.
    """
    ...


@wp.func
def velocity_along(
    value: wp.float64, row: int, geoms: Geoms, rigid: RigidBodies, contacts: Contacts, islands: Islands, rows: Rows
):
    """Add the velocity [m/s] along a row that the impulses give."""
    c = row // 3
    block = contacts.block[c]
    first = islands.block_start[block]
    last = islands.block_start[block + 1]
    at = islands.matrix_start[block] + (3 * (contacts.place[c] - first) + row % 3) * 3 * (last - first)
    value = value + block_velocity(rows.delassus, at, islands.contact, first, last, rows.impulse)
    if contacts.other[c] >= 0:
        dof = geoms.dof[contacts.other[c]]
        while dof >= 0:
            value = value + rows.rigid_jacobian[row, dof] * rows.rigid_velocity[dof]
            dof = rigid.dof_parent[dof]
    return value


@wp.func
def delassus_entry(
    row: int, k: int, geoms: Geoms, rigid: RigidBodies, contacts: Contacts, islands: Islands, rows: Rows
):
    """Entry of J M^-1 J^T for a row and row ``k`` (0 to 2) of the same contact."""
    c = row // 3
    block = contacts.block[c]
    first = islands.block_start[block]
    size = 3 * (islands.block_start[block + 1] - first)
    place = 3 * (contacts.place[c] - first)
    value = rows.delassus[islands.matrix_start[block] + (place + row % 3) * size + place + k]
    if contacts.other[c] >= 0:
        dof = geoms.dof[contacts.other[c]]
        while dof >= 0:
            value = value + rows.rigid_jacobian[row, dof] * rows.rigid_response[3 * c + k, dof]
            dof = rigid.dof_parent[dof]
    return value


@wp.func
def row_residual(row: int, geoms: Geoms, rigid: RigidBodies, contacts: Contacts, islands: Islands, rows: Rows):
    """Velocity [m/s] along a row, bias and compliance included, with the impulses of its island."""
    r = rows.velocity_free[row] + rows.bias[row] + contacts.compliance[row // 3] * rows.impulse[row]
    return velocity_along(r, row, geoms, rigid, contacts, islands, rows)


@wp.func
def tangential_eigenvalue(c: int, geoms: Geoms, rigid: RigidBodies, contacts: Contacts, islands: Islands, rows: Rows):
    """The larger eigenvalue [1/kg] of the tangential block of a contact, compliance included: a step of friction by the
    residual over it stays inside the cone's convergence."""
    u = 3 * c + 1
    uu = delassus_entry(u, 1, geoms, rigid, contacts, islands, rows)
    vv = delassus_entry(u + 1, 2, geoms, rigid, contacts, islands, rows)
    uv = delassus_entry(u, 2, geoms, rigid, contacts, islands, rows)
    mean = wp.float64(0.5) * (uu + vv) + contacts.compliance[c]
    spread = wp.float64(0.5) * (uu - vv)
    return mean + wp.sqrt(spread * spread + uv * uv)


@wp.func
def add_impulse(row: int, change: wp.float64, island: int, contacts: Contacts, islands: Islands, rows_out: Rows):
    """Change the impulse along a row by so many N s; the rigid velocities follow."""
    rows_out.impulse[row] = rows_out.impulse[row] + change
    if contacts.other[row // 3] >= 0:
        for place in range(islands.first_dof[island], islands.first_dof[island + 1]):
            dof = islands.dof[place]
            rows_out.rigid_velocity[dof] = rows_out.rigid_velocity[dof] + change * rows_out.rigid_response[row, dof]


@wp.func
def update_rigid_velocity(island: int, contacts: Contacts, islands: Islands, rows_out: Rows):
    """Compute the rigid velocities of an island anew from all its impulses."""
    for place in range(islands.first_dof[island], islands.first_dof[island + 1]):
        dof = islands.dof[place]
        rows_out.rigid_velocity[dof] = wp.float64(0.0)
    for m in range(islands.start[island], islands.start[island + 1]):
        c = islands.contact[m]
        if contacts.other[c] >= 0:
            for row in range(3 * c, 3 * c + 3):
                if rows_out.impulse[row] != wp.float64(0.0):
                    for place in range(islands.first_dof[island], islands.first_dof[island + 1]):
                        dof = islands.dof[place]
                        rows_out.rigid_velocity[dof] = (
                            rows_out.rigid_velocity[dof] + rows_out.impulse[row] * rows_out.rigid_response[row, dof]
                        )
