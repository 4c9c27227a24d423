"""Active-set Newton step on the contacts of one island, from the impulses that projected Gauss-Seidel has reached.

Which contacts are open, stick or slide, and in which direction they slide, is taken as it is: then the conditions are a
linear system, B x + J_r w = r with one matrix B for each block, and w = H^-1 J_r^T x of the rigid bodies. Each block is
eliminated by itself; what is left is a system as large as the degrees of freedom of the rigid bodies (Woodbury). See
``docs/decisions/contact-solver.md``.
"""

import warp as wp

from vinesim.kernels.contact.row_velocity import update_rigid_velocity
from vinesim.kernels.contact.structs import Contacts, Islands, Rows, SolverScratch

wp.set_module_options({"enable_backward": False})

SLIDING_SHARE = wp.constant(wp.float64(0.999999))
"""[1] A contact slides if its friction is at least this share of the largest one."""


@wp.func
def write_block(block: int, island: int, contacts: Contacts, islands: Islands, rows: Rows, scratch_out: SolverScratch):
    """Write the linear system of one block: its matrix, and right-hand sides for w = 0 and for each entry of w.

    Sticking rows: (B + compliance) x = -velocity - bias - J_r w. Rows of open contacts: x = 0. Friction of sliding
    contacts: a fixed share of the normal impulse.
    """
    zero = wp.float64(0.0)
    start = islands.block_start[block]
    size = 3 * (islands.block_start[block + 1] - start)
    dofs = islands.first_dof[island + 1] - islands.first_dof[island]
    for p in range(size // 3):
        c = islands.contact[start + p]
        n = 3 * c
        normal = rows.impulse[n]
        tangential = wp.sqrt(rows.impulse[n + 1] * rows.impulse[n + 1] + rows.impulse[n + 2] * rows.impulse[n + 2])
        slides = tangential >= contacts.friction[c] * normal * SLIDING_SHARE
        for axis in range(3):
            row = n + axis
            at = islands.matrix_start[block] + (3 * p + axis) * size
            if normal <= zero or (axis > 0 and slides):
                for k in range(size):
                    scratch_out.matrix[at + k] = zero
                for k in range(1 + dofs):
                    scratch_out.columns[row, k] = zero
                scratch_out.matrix[at + 3 * p + axis] = wp.float64(1.0)
                if normal > zero:
                    scratch_out.matrix[at + 3 * p] = -rows.impulse[row] / normal
            else:
                for k in range(size):
                    scratch_out.matrix[at + k] = rows.delassus[at + k]
                scratch_out.matrix[at + 3 * p + axis] = scratch_out.matrix[at + 3 * p + axis] + contacts.compliance[c]
                scratch_out.columns[row, 0] = -rows.velocity_free[row] - rows.bias[row]
                for k in range(dofs):
                    dof = islands.dof[islands.first_dof[island] + k]
                    scratch_out.columns[row, 1 + k] = -rows.rigid_jacobian[row, dof]


@wp.func_native("""
    const int pitch = a.strides[0] / (int)sizeof(double);
    const double* from = a.data + source * pitch;
    double* to = a.data + target * pitch;
    if (pitch == 1) {
        for (int i = 0; i < count; ++i) {
            const double change = factor * from[i];
            to[i] -= change;
        }
    } else {
        for (int i = 0; i < count; ++i) to[i * pitch] -= factor * from[i * pitch];
    }
""")
def subtract_row(a: wp.array(dtype=wp.float64), target: int, source: int, count: int, factor: wp.float64):
    """Subtract from ``count`` numbers of an array, from ``target`` on, ``factor`` times those from ``source`` on.

    Native, as Warp's loops over arrays in structs are not vectorised.
    """
    ...


@wp.func
def solve_block(block: int, columns: int, islands: Islands, scratch_out: SolverScratch):
    """Gaussian elimination without pivoting: B is positive definite, and sliding rows change that little."""
    start = islands.block_start[block]
    size = 3 * (islands.block_start[block + 1] - start)
    matrix = islands.matrix_start[block]
    for k in range(size):
        pivot_row = 3 * islands.contact[start + k // 3] + k % 3
        pivot_at = matrix + k * size
        scale = wp.float64(1.0) / scratch_out.matrix[pivot_at + k]
        for m in range(k + 1, size):
            at = matrix + m * size
            factor = scratch_out.matrix[at + k] * scale
            if factor != wp.float64(0.0):
                row = 3 * islands.contact[start + m // 3] + m % 3
                subtract_row(scratch_out.matrix, at + k + 1, pivot_at + k + 1, size - k - 1, factor)
                for c in range(columns):
                    scratch_out.columns[row, c] = (
                        scratch_out.columns[row, c] - factor * scratch_out.columns[pivot_row, c]
                    )
    for back in range(size):
        k = size - 1 - back
        row = 3 * islands.contact[start + k // 3] + k % 3
        at = matrix + k * size
        for m in range(k + 1, size):
            entry = scratch_out.matrix[at + m]
            if entry != wp.float64(0.0):
                below = 3 * islands.contact[start + m // 3] + m % 3
                for c in range(columns):
                    scratch_out.columns[row, c] = scratch_out.columns[row, c] - entry * scratch_out.columns[below, c]
        scale = wp.float64(1.0) / scratch_out.matrix[at + k]
        for c in range(columns):
            scratch_out.columns[row, c] = scratch_out.columns[row, c] * scale


@wp.func
def solve_rigid(island: int, contacts: Contacts, islands: Islands, rows: Rows, scratch_out: SolverScratch):
    """Solve (1 - G X) w = G y for the rigid velocities, where x = y + X w and G = H^-1 J_r^T; w replaces column 0.

    With partial pivoting: velocities and angular velocities are mixed.
    """
    zero = wp.float64(0.0)
    first = islands.first_dof[island]
    dofs = islands.first_dof[island + 1] - first
    for i in range(dofs):
        for k in range(1 + dofs):
            scratch_out.rigid_system[first + i, k] = zero
        scratch_out.rigid_system[first + i, 1 + i] = wp.float64(1.0)
    for m in range(islands.start[island], islands.start[island + 1]):
        c = islands.contact[m]
        if contacts.other[c] >= 0:
            for row in range(3 * c, 3 * c + 3):
                for i in range(dofs):
                    response = rows.rigid_response[row, islands.dof[first + i]]
                    if response != zero:
                        value = scratch_out.rigid_system[first + i, 0] + response * scratch_out.columns[row, 0]
                        scratch_out.rigid_system[first + i, 0] = value
                        for k in range(1, 1 + dofs):
                            scratch_out.rigid_system[first + i, k] = (
                                scratch_out.rigid_system[first + i, k] - response * scratch_out.columns[row, k]
                            )
    for k in range(dofs):
        best = int(k)
        for i in range(k + 1, dofs):
            if wp.abs(scratch_out.rigid_system[first + i, 1 + k]) > wp.abs(
                scratch_out.rigid_system[first + best, 1 + k]
            ):
                best = i
        if best != k:
            for c in range(1 + dofs):
                swap = scratch_out.rigid_system[first + k, c]
                scratch_out.rigid_system[first + k, c] = scratch_out.rigid_system[first + best, c]
                scratch_out.rigid_system[first + best, c] = swap
        scale = wp.float64(1.0) / scratch_out.rigid_system[first + k, 1 + k]
        for i in range(k + 1, dofs):
            factor = scratch_out.rigid_system[first + i, 1 + k] * scale
            if factor != zero:
                for c in range(1 + dofs):
                    scratch_out.rigid_system[first + i, c] = (
                        scratch_out.rigid_system[first + i, c] - factor * scratch_out.rigid_system[first + k, c]
                    )
    for back in range(dofs):
        k = dofs - 1 - back
        value = scratch_out.rigid_system[first + k, 0]
        for i in range(k + 1, dofs):
            value = value - scratch_out.rigid_system[first + k, 1 + i] * scratch_out.rigid_system[first + i, 0]
        scratch_out.rigid_system[first + k, 0] = value / scratch_out.rigid_system[first + k, 1 + k]


@wp.func
def project_into_cones(island: int, contacts: Contacts, islands: Islands, rows_out: Rows):
    """Put the impulses of one island back into their friction cones, where the guess about a contact was wrong."""
    zero = wp.float64(0.0)
    for m in range(islands.start[island], islands.start[island + 1]):
        c = islands.contact[m]
        n = 3 * c
        normal = wp.max(rows_out.impulse[n], zero)
        tangential = wp.sqrt(
            rows_out.impulse[n + 1] * rows_out.impulse[n + 1] + rows_out.impulse[n + 2] * rows_out.impulse[n + 2]
        )
        share = wp.float64(1.0)
        if tangential > contacts.friction[c] * normal:
            share = contacts.friction[c] * normal / tangential
        rows_out.impulse[n] = normal
        rows_out.impulse[n + 1] = share * rows_out.impulse[n + 1]
        rows_out.impulse[n + 2] = share * rows_out.impulse[n + 2]


@wp.func
def newton_step(
    island: int,
    contacts: Contacts,
    islands: Islands,
    scratch_out: SolverScratch,
    rows_out: Rows,
):
    """Impulses that fit the present states of all contacts of one island, put back into their friction cones."""
    first = islands.first_dof[island]
    dofs = islands.first_dof[island + 1] - first
    for block in range(islands.first_block[island], islands.first_block[island + 1]):
        write_block(block, island, contacts, islands, rows_out, scratch_out)
        solve_block(block, 1 + dofs, islands, scratch_out)
    solve_rigid(island, contacts, islands, rows_out, scratch_out)
    for m in range(islands.start[island], islands.start[island + 1]):
        for row in range(3 * islands.contact[m], 3 * islands.contact[m] + 3):
            value = scratch_out.columns[row, 0]
            for k in range(dofs):
                value = value + scratch_out.columns[row, 1 + k] * scratch_out.rigid_system[first + k, 0]
            rows_out.impulse[row] = value
    project_into_cones(island, contacts, islands, rows_out)
    update_rigid_velocity(island, contacts, islands, rows_out)
