"""Velocities along the rows of contacts, and how they follow the impulses.

v = v_free + B x + J_r w: B x is what impulses do to plants, by the matrix of the contact's block; w = H^-1 J_r^T x are
the changes of the rigid world's velocities, which are kept up to date.
"""

import warp as wp

from vinesim.kernels.contact.structs import Contacts, Geoms, Islands, RigidBodies, Rows

wp.set_module_options({"enable_backward": False})


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
    m = int(first)
    while m < last:
        i = 3 * islands.contact[m]
        value = (
            value
            + rows.delassus[at] * rows.impulse[i]
            + rows.delassus[at + 1] * rows.impulse[i + 1]
            + rows.delassus[at + 2] * rows.impulse[i + 2]
        )
        at = at + 3
        m = m + 1
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
