"""Active-set Newton step on the contacts of one island, from the impulses that projected Gauss-Seidel has reached.

Which contacts are open, stick or slide is taken as it is, and the direction in which they slide is linearised: then the
conditions are a linear system, B x + J_r w = r with one matrix B for each block, and w = H^-1 J_r^T x of the rigid
bodies. Each block is eliminated by itself; what is left is a system as large as the degrees of freedom of the rigid
bodies (Woodbury). See ``docs/decisions/contact-solver.md``.
"""

import warp as wp

from vinesim.kernels.contact.row_velocity import row_residual, tangential_eigenvalue, update_rigid_velocity
from vinesim.kernels.contact.structs import Contacts, Geoms, Islands, RigidBodies, Rows, SolverScratch

wp.set_module_options({"enable_backward": False})

SLIDING_SHARE = wp.constant(wp.float64(0.999999))
"""[1] A contact slides if its friction is at least this share of the largest one."""


@wp.func_native("""
    const double* const from = delassus.data + source;
    double* const to = matrix.data + target;
    for (int m = 0; m < count; ++m) {
        const double* const entry = from + 3 * (place.data[contact.data[start + m]] - start);
        for (int k = 0; k < 3; ++k) to[3 * m + k] = entry[k];
    }
""")
def gather_row(
    delassus: wp.array(dtype=wp.float64),
    source: int,
    contact: wp.array(dtype=wp.int32),
    place: wp.array(dtype=wp.int32),
    start: int,
    count: int,
    matrix: wp.array(dtype=wp.float64),
    target: int,
):
    """Copy the entries of ``count`` contacts, listed from ``start`` on, of a row of a block that begins at ``source``."""
    ...


@wp.func
def write_sliding_rows(
    c: int,
    number: int,
    at: int,
    size: int,
    island: int,
    geoms: Geoms,
    rigid: RigidBodies,
    contacts: Contacts,
    islands: Islands,
    rows: Rows,
    scratch_out: SolverScratch,
):
    """Make both friction rows of a sliding contact, of entries of B that begin at ``at`` and ``at + size``.

    Friction is the projection of f = x_t - r_t / e on the disk of radius mu x_n, where r_t is the residual velocity along
    the tangents and e their eigenvalue. Linearised about the present f, with d = f / |f|, P = 1 - d d^T and
    s = mu x_n / |f|:  x_t - s P (x_t - r_t / e) - mu d x_n = 0 (Alart and Curnier, A mixed formulation for frictional
    contact problems prone to Newton like solution methods, 1991). ``number``: of the contact among those that press.
    """
    one = wp.float64(1.0)
    u = 3 * c + 1
    eigenvalue = tangential_eigenvalue(c, geoms, rigid, contacts, islands, rows)
    fu = rows.impulse[u] - row_residual(u, geoms, rigid, contacts, islands, rows) / eigenvalue
    fv = rows.impulse[u + 1] - row_residual(u + 1, geoms, rigid, contacts, islands, rows) / eigenvalue
    friction = contacts.friction[c]
    length = wp.max(wp.sqrt(fu * fu + fv * fv), wp.float64(1.0e-30))
    share = wp.min(friction * rows.impulse[u - 1] / length, one)
    du = fu / length
    dv = fv / length
    uu = share * (one - du * du)
    uv = -share * du * dv
    vv = share * (one - dv * dv)
    for k in range(size):
        along_u = scratch_out.matrix[at + k] / eigenvalue
        along_v = scratch_out.matrix[at + size + k] / eigenvalue
        scratch_out.matrix[at + k] = uu * along_u + uv * along_v
        scratch_out.matrix[at + size + k] = uv * along_u + vv * along_v
    softer = one - contacts.compliance[c] / eigenvalue
    n = at + 3 * number
    scratch_out.matrix[n] = scratch_out.matrix[n] - friction * du
    scratch_out.matrix[n + 1] = scratch_out.matrix[n + 1] + one - softer * uu
    scratch_out.matrix[n + 2] = scratch_out.matrix[n + 2] - softer * uv
    n = n + size
    scratch_out.matrix[n] = scratch_out.matrix[n] - friction * dv
    scratch_out.matrix[n + 1] = scratch_out.matrix[n + 1] - softer * uv
    scratch_out.matrix[n + 2] = scratch_out.matrix[n + 2] + one - softer * vv
    along_u = -(rows.velocity_free[u] + rows.bias[u]) / eigenvalue
    along_v = -(rows.velocity_free[u + 1] + rows.bias[u + 1]) / eigenvalue
    scratch_out.columns[u, 0] = uu * along_u + uv * along_v
    scratch_out.columns[u + 1, 0] = uv * along_u + vv * along_v
    for k in range(islands.first_dof[island + 1] - islands.first_dof[island]):
        dof = islands.dof[islands.first_dof[island] + k]
        along_u = -rows.rigid_jacobian[u, dof] / eigenvalue
        along_v = -rows.rigid_jacobian[u + 1, dof] / eigenvalue
        scratch_out.columns[u, 1 + k] = uu * along_u + uv * along_v
        scratch_out.columns[u + 1, 1 + k] = uv * along_u + vv * along_v


@wp.func
def list_pressed(block: int, columns: int, islands: Islands, rows: Rows, scratch_out: SolverScratch):
    """List the contacts of a block that press, and let the others stay at 0; returns their number."""
    start = islands.block_start[block]
    count = int(0)
    for place in range(start, islands.block_start[block + 1]):
        c = islands.contact[place]
        if rows.impulse[3 * c] > wp.float64(0.0):
            scratch_out.pressed[start + count] = c
            count = count + 1
        else:
            for row in range(3 * c, 3 * c + 3):
                for k in range(columns):
                    scratch_out.columns[row, k] = wp.float64(0.0)
    return count


@wp.func
def write_block(
    block: int,
    count: int,
    island: int,
    geoms: Geoms,
    rigid: RigidBodies,
    contacts: Contacts,
    islands: Islands,
    rows: Rows,
    scratch_out: SolverScratch,
):
    """Write the linear system of the ``count`` contacts of a block that press: its matrix, and right-hand sides for w = 0
    and for each entry of w.

    Sticking rows: (B + compliance) x = -velocity - bias - J_r w. Friction of sliding contacts: see
    :func:`write_sliding_rows`.
    """
    start = islands.block_start[block]
    full = 3 * (islands.block_start[block + 1] - start)
    size = 3 * count
    dofs = islands.first_dof[island + 1] - islands.first_dof[island]
    for p in range(count):
        c = scratch_out.pressed[start + p]
        n = 3 * c
        limit = contacts.friction[c] * rows.impulse[n]
        tangential = wp.sqrt(rows.impulse[n + 1] * rows.impulse[n + 1] + rows.impulse[n + 2] * rows.impulse[n + 2])
        slides = tangential >= limit * SLIDING_SHARE
        source = islands.matrix_start[block] + 3 * (contacts.place[c] - start) * full
        at = islands.matrix_start[block] + 3 * p * size
        for axis in range(3):
            gather_row(
                rows.delassus, source + axis * full, scratch_out.pressed, contacts.place, start, count,
                scratch_out.matrix, at + axis * size,
            )  # fmt: skip
            if axis == 0 or not slides:
                row = n + axis
                entry = at + axis * size + 3 * p + axis
                scratch_out.matrix[entry] = scratch_out.matrix[entry] + contacts.compliance[c]
                scratch_out.columns[row, 0] = -rows.velocity_free[row] - rows.bias[row]
                for k in range(dofs):
                    dof = islands.dof[islands.first_dof[island] + k]
                    scratch_out.columns[row, 1 + k] = -rows.rigid_jacobian[row, dof]
        if slides:
            write_sliding_rows(
                c, p, at + size, size, island, geoms, rigid, contacts, islands, rows, scratch_out
            )  # fmt: skip


@wp.func_native("""
    double* const a = matrix.data + at;
    const int pitch = columns.strides[0] / (int)sizeof(double);
    const auto right_side = [&](int k) { return columns.data + (3 * contact.data[start + k / 3] + k % 3) * pitch; };
    for (int k = 0; k < size; ++k) {
        const double* const __restrict__ pivot = a + k * size;
        const double* const __restrict__ pivot_right = right_side(k);
        const double scale = 1.0 / pivot[k];
        for (int m = k + 1; m < size; ++m) {
            double* const __restrict__ row = a + m * size;
            const double factor = row[k] * scale;
            if (factor == 0.0) continue;
            for (int i = k + 1; i < size; ++i) row[i] -= factor * pivot[i];
            double* const __restrict__ right = right_side(m);
            for (int i = 0; i < count; ++i) right[i] -= factor * pivot_right[i];
        }
    }
    for (int k = size - 1; k >= 0; --k) {
        const double* const row = a + k * size;
        double* const __restrict__ right = right_side(k);
        for (int m = k + 1; m < size; ++m) {
            const double* const __restrict__ below = right_side(m);
            for (int i = 0; i < count; ++i) right[i] -= row[m] * below[i];
        }
        const double scale = 1.0 / row[k];
        for (int i = 0; i < count; ++i) right[i] *= scale;
    }
""")
def eliminate(
    matrix: wp.array(dtype=wp.float64),
    at: int,
    size: int,
    contact: wp.array(dtype=wp.int32),
    start: int,
    columns: wp.array2d(dtype=wp.float64),
    count: int,
):
    """Gaussian elimination without pivoting of the matrix that begins at ``at``; its solutions replace ``columns``.

    Row k of the matrix is row 3 * contact[start + k / 3] + k % 3 of the columns. B is positive definite, and sliding rows
    change that little. Native, as Warp's loops over arrays in structs are not vectorised, and a call copies its structs.
    """
    ...


@wp.func_native("""
    double* to = a.data + target * (a.strides[0] / (int)sizeof(double));
    const int pitch = columns.strides[1] / (int)sizeof(double);
    const double* from = columns.data + source * (columns.strides[0] / (int)sizeof(double));
    for (int i = 1; i <= count; ++i) to[i] -= factor * from[i * pitch];
""")
def subtract_columns(
    a: wp.array2d(dtype=wp.float64), target: int, columns: wp.array2d(dtype=wp.float64), source: int, count: int,
    factor: wp.float64,
):  # fmt: skip
    """Subtract from a row, its first number left out, ``factor`` times ``count`` numbers of a row of ``columns``."""
    ...


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
                        subtract_columns(scratch_out.rigid_system, first + i, scratch_out.columns, row, dofs, response)
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
    geoms: Geoms,
    rigid: RigidBodies,
    contacts: Contacts,
    islands: Islands,
    scratch_out: SolverScratch,
    rows_out: Rows,
):
    """Impulses that fit the present states of all contacts of one island, put back into their friction cones."""
    first = islands.first_dof[island]
    dofs = islands.first_dof[island + 1] - first
    for block in range(islands.first_block[island], islands.first_block[island + 1]):
        count = list_pressed(block, 1 + dofs, islands, rows_out, scratch_out)
        write_block(block, count, island, geoms, rigid, contacts, islands, rows_out, scratch_out)
        eliminate(
            scratch_out.matrix, islands.matrix_start[block], 3 * count, scratch_out.pressed,
            islands.block_start[block], scratch_out.columns, 1 + dofs,
        )  # fmt: skip
    solve_rigid(island, contacts, islands, rows_out, scratch_out)
    for m in range(islands.start[island], islands.start[island + 1]):
        for row in range(3 * islands.contact[m], 3 * islands.contact[m] + 3):
            value = scratch_out.columns[row, 0]
            for k in range(dofs):
                value = value + scratch_out.columns[row, 1 + k] * scratch_out.rigid_system[first + k, 0]
            rows_out.impulse[row] = value
    project_into_cones(island, contacts, islands, rows_out)
    update_rigid_velocity(island, contacts, islands, rows_out)
