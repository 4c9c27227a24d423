"""Active-set Newton step on the contacts of one island, from the impulses that projected Gauss-Seidel has reached.

The step assumes that open, sticking and sliding contacts keep their state, and linearises the direction of sliding. The
conditions are then a linear system, B x + J_r w = r with one matrix B for each block, and w = H^-1 J_r^T x of the rigid
bodies. Each block is eliminated separately. The size of the remaining system is the number of degrees of freedom of the
rigid bodies (Woodbury). See ``docs/decisions/contact-solver.md``.
"""

import warp as wp

from vinesim.kernels.contact.friction_law import linearise_sliding, presses, project_into_cone, slides
from vinesim.kernels.contact.island_system import (
    EIGHT,
    IslandSystem,
    block_pitch,
    contact_residual,
    contact_row,
    island_dofs,
    rigid_entry,
    set_three,
    solution_entry,
    three,
    update_rigid_velocity,
)
from vinesim.kernels.contact.islands import padded
from vinesim.kernels.contact.structs import Islands

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
    const double* const from = block.data + source;
    double* const to = system.data + target;
    for (int i = 3 * count; i < pitch; ++i) to[i] = 0.0;
    for (int m = 0; m < count; ++m) {
        const double* const entry = from + 3 * pressed.data[start + m];
        for (int k = 0; k < 3; ++k) to[3 * m + k] = entry[k];
    }
""")
def gather_row(
    block: wp.array(dtype=wp.float64),
    source: int,
    pressed: wp.array(dtype=wp.int32),
    start: int,
    count: int,
    system: wp.array(dtype=wp.float64),
    target: int,
    pitch: int,
):
    """Copy the entries of ``count`` listed contacts from a row of a block, and pad with zeros up to ``pitch``.

    The contacts are listed from ``start`` on; the row of the block begins at ``source``.
    """
    ...


@wp.func_native(
    EIGHT
    + """
    double* const u = system.data + at;
    double* const v = u + pitch;
    const double uu = factor.data[0][0], uv = factor.data[0][1], vu = factor.data[1][0], vv = factor.data[1][1];
    for (int i = 0; i < pitch; i += 8) {
        const Eight along_u = *(const Eight*)(u + i), along_v = *(const Eight*)(v + i);
        *(Eight*)(u + i) = along_u * uu + along_v * uv;
        *(Eight*)(v + i) = along_u * vu + along_v * vv;
    }
"""
)
def combine_rows(system: wp.array(dtype=wp.float64), at: int, pitch: int, factor: wp.mat22d):
    """Multiply two consecutive rows by the 2 x 2 matrix ``factor``. The first row begins at ``at``."""
    ...


@wp.func
def linearise_friction(
    place: int,
    block: int,
    island: int,
    number: int,
    at: int,
    right: int,
    pitch: int,
    islands: Islands,
    matrix: wp.array(dtype=wp.float64),
    system_out: IslandSystem,
):
    """Convert the two friction rows at ``at`` from those of a sticking contact to those of a sliding contact.

    x_t - K (x_t - step r_t) - g x_n = 0, see :func:`vinesim.kernels.contact.friction_law.linearise_sliding`.
    ``number``: index of the contact among the closed contacts. ``right``: number of entries of right-hand sides.
    """
    one = wp.float64(1.0)
    x = three(contact_row(place, block, islands), system_out.impulse)
    steps = system_out.steps[place]
    residual = contact_residual(place, block, island, islands, matrix, system_out)
    K, g = linearise_sliding(x, residual, steps, system_out.surface[place])
    combine_rows(system_out.matrix, at, pitch, K * steps.tangential)
    n = at + right + 3 * number
    system_out.matrix[n] = system_out.matrix[n] - g[0]
    system_out.matrix[n + 1] = system_out.matrix[n + 1] + one - K[0, 0]
    system_out.matrix[n + 2] = system_out.matrix[n + 2] - K[0, 1]
    n = n + pitch
    system_out.matrix[n] = system_out.matrix[n] - g[1]
    system_out.matrix[n + 1] = system_out.matrix[n + 1] - K[1, 0]
    system_out.matrix[n + 2] = system_out.matrix[n + 2] + one - K[1, 1]


@wp.func
def list_pressed(block: int, islands: Islands, system_out: IslandSystem):
    """List the closed contacts of a block. Returns their number."""
    start = islands.block_start[block]
    count = int(0)
    for k in range(islands.block_start[block + 1] - start):
        if presses(three(islands.row_start[block] + 3 * k, system_out.impulse)):
            system_out.pressed[start + count] = k
            count = count + 1
    return count


@wp.func
def write_block(
    block: int,
    island: int,
    count: int,
    right: int,
    pitch: int,
    islands: Islands,
    matrix: wp.array(dtype=wp.float64),
    system_out: IslandSystem,
):
    """Write the linear system of the ``count`` closed contacts of a block.

    Right-hand sides come first, for w = 0 and for each entry of w, then the matrix. Sticking rows:
    (B + compliance) x = -free - J_r w. Friction of sliding contacts: see :func:`linearise_friction`.
    """
    start = islands.block_start[block]
    source_pitch = block_pitch(block, islands)
    dofs = island_dofs(island, islands)
    for p in range(count):
        k = 3 * system_out.pressed[start + p]
        place = start + system_out.pressed[start + p]
        row = islands.row_start[block] + k
        at = islands.system_start[island] + 3 * p * pitch
        rigid = rigid_entry(place, island, islands)
        for axis in range(3):
            entry = at + axis * pitch
            gather_row(
                matrix,
                islands.matrix_start[block] + (k + axis) * source_pitch,
                system_out.pressed,
                start,
                count,
                system_out.matrix,
                entry + right,
                pitch - right,
            )
            diagonal = entry + right + 3 * p + axis
            system_out.matrix[diagonal] = system_out.matrix[diagonal] + system_out.surface[place].compliance
            system_out.matrix[entry] = -system_out.free[row + axis]
            for i in range(dofs):
                system_out.matrix[entry + 1 + i] = -system_out.jacobian[rigid + i][axis]
            for i in range(1 + dofs, right):
                system_out.matrix[entry + i] = wp.float64(0.0)
        if slides(three(row, system_out.impulse), system_out.surface[place]):
            linearise_friction(place, block, island, p, at + pitch, right, pitch, islands, matrix, system_out)


@wp.func_native(
    EIGHT
    + """
    using Matrix = wp::mat_t<3, 3, double>;
    const auto subtract = [pitch](double* row, const double* rows, const wp::vec3d& f, int from, int to) {
        for (int i = from; i < to; i += 8) {
            const double* const p = rows + i;
            const Eight first = *(const Eight*)p * f[0], second = *(const Eight*)(p + pitch) * f[1];
            *(Eight*)(row + i) = *(const Eight*)(row + i) - first - second - *(const Eight*)(p + 2 * pitch) * f[2];
        }
    };
    for (int k = 0; k < size; k += 3) {
        double* const pivot = system.data + at + k * pitch;
        double *const p = pivot + right + k, *const q = p + pitch, *const r = q + pitch;
        const Matrix inverse = wp::inverse(Matrix(p[0], p[1], p[2], q[0], q[1], q[2], r[0], r[1], r[2]));
        for (int m = k + 3; m < size; ++m) {
            double* const row = system.data + at + m * pitch;
            const double* const entry = row + right + k;
            const wp::vec3d factor = wp::mul(wp::vec3d(entry[0], entry[1], entry[2]), inverse);
            subtract(row, pivot, factor, 0, right);
            subtract(row, pivot, factor, right + (k + 3) / 8 * 8, pitch);
        }
        for (int i = 0; i < 3; ++i) p[i] = inverse.data[0][i], q[i] = inverse.data[1][i], r[i] = inverse.data[2][i];
    }
    for (int k = size - 3; k >= 0; k -= 3) {
        double* const pivot = system.data + at + k * pitch;
        const double *const p = pivot + right + k, *const q = p + pitch, *const r = q + pitch;
        for (int i = 0; i < right; i += 8) {
            const Eight n = *(Eight*)(pivot + i), u = *(Eight*)(pivot + pitch + i), v = *(Eight*)(pivot + 2 * pitch + i);
            *(Eight*)(pivot + i) = n * p[0] + u * p[1] + v * p[2];
            *(Eight*)(pivot + pitch + i) = n * q[0] + u * q[1] + v * q[2];
            *(Eight*)(pivot + 2 * pitch + i) = n * r[0] + u * r[1] + v * r[2];
        }
        for (int m = 0; m < k; ++m) {
            double* const row = system.data + at + m * pitch;
            const double* const entry = row + right + k;
            subtract(row, pivot, wp::vec3d(entry[0], entry[1], entry[2]), 0, right);
        }
    }
"""
)
def eliminate(system: wp.array(dtype=wp.float64), at: int, size: int, right: int, pitch: int):
    """Gaussian elimination, by contacts, of ``size`` rows that begin at ``at``.

    Solutions replace the first ``right`` entries of each row. No pivoting is needed: B is positive definite, and
    sliding rows change it little.
    """
    ...


@wp.func
def keep_solution(block: int, island: int, count: int, pitch: int, islands: Islands, system_out: IslandSystem):
    """Store the solution of a block for all of its contacts: 0 for contacts that are not closed."""
    start = islands.block_start[block]
    columns = 1 + island_dofs(island, islands)
    p = int(0)
    for place in range(start, islands.block_start[block + 1]):
        to = solution_entry(place, island, islands)
        presses = p < count and start + system_out.pressed[start + wp.min(p, count - 1)] == place
        entry = islands.system_start[island] + 3 * p * pitch
        for i in range(columns):
            value = wp.vec3d()
            if presses:
                value = wp.vec3d(
                    system_out.matrix[entry + i],
                    system_out.matrix[entry + pitch + i],
                    system_out.matrix[entry + 2 * pitch + i],
                )
            system_out.solution[to + i] = value
        if presses:
            p = p + 1


@wp.func_native("""
    for (int i = 0; i < count; ++i) row.data[at + i] -= dot(response, solution.data[entry + i]);
""")
def subtract_products(
    row: wp.array(dtype=wp.float64),
    at: int,
    response: wp.vec3d,
    solution: wp.array(dtype=wp.vec3d),
    entry: int,
    count: int,
):
    """Subtract from ``count`` numbers, which begin at index ``at``, the inner products of ``response`` with ``count``
    vectors, which begin at index ``entry``.
    """
    ...


@wp.func
def solve_rigid(island: int, islands: Islands, system_out: IslandSystem):
    """Solve (1 - G X) w = G y for the rigid velocities, where x = y + X w and G = H^-1 J_r^T; w replaces column 0.

    The elimination uses partial pivoting, because linear and angular velocities have different scales.
    """
    zero = wp.float64(0.0)
    first = islands.first_dof[island]
    dofs = island_dofs(island, islands)
    for i in range(dofs):
        for k in range(1 + dofs):
            system_out.rigid_matrix[first + i, k] = zero
        system_out.rigid_matrix[first + i, 1 + i] = wp.float64(1.0)
    for place in range(islands.start[island], islands.start[island + 1]):
        at = rigid_entry(place, island, islands)
        solution = solution_entry(place, island, islands)
        y = system_out.solution[solution]
        for i in range(dofs):
            response = system_out.response[at + i]
            if response[0] != zero or response[1] != zero or response[2] != zero:
                value = system_out.rigid_matrix[first + i, 0] + wp.dot(response, y)
                system_out.rigid_matrix[first + i, 0] = value
                subtract_products(
                    system_out.rigid_matrix[first + i], 1, response, system_out.solution, solution + 1, dofs
                )
    for k in range(dofs):
        best = int(k)
        for i in range(k + 1, dofs):
            if wp.abs(system_out.rigid_matrix[first + i, 1 + k]) > wp.abs(system_out.rigid_matrix[first + best, 1 + k]):
                best = i
        if best != k:
            for c in range(1 + dofs):
                swap = system_out.rigid_matrix[first + k, c]
                system_out.rigid_matrix[first + k, c] = system_out.rigid_matrix[first + best, c]
                system_out.rigid_matrix[first + best, c] = swap
        scale = wp.float64(1.0) / system_out.rigid_matrix[first + k, 1 + k]
        for i in range(k + 1, dofs):
            factor = system_out.rigid_matrix[first + i, 1 + k] * scale
            if factor != zero:
                for c in range(1 + dofs):
                    system_out.rigid_matrix[first + i, c] = (
                        system_out.rigid_matrix[first + i, c] - factor * system_out.rigid_matrix[first + k, c]
                    )
    for back in range(dofs):
        k = dofs - 1 - back
        value = system_out.rigid_matrix[first + k, 0]
        for i in range(k + 1, dofs):
            value = value - system_out.rigid_matrix[first + k, 1 + i] * system_out.rigid_matrix[first + i, 0]
        system_out.rigid_matrix[first + k, 0] = value / system_out.rigid_matrix[first + k, 1 + k]


@wp.func
def newton_step(island: int, islands: Islands, matrix: wp.array(dtype=wp.float64), system_out: IslandSystem):
    """Solve for the impulses of an island with each contact in its present state (open, sticking or sliding), and
    project them into their friction cones.
    """
    first = islands.first_dof[island]
    dofs = island_dofs(island, islands)
    right = padded(1 + dofs)
    for block in range(islands.first_block[island], islands.first_block[island + 1]):
        count = list_pressed(block, islands, system_out)
        pitch = right + padded(3 * count)
        write_block(block, island, count, right, pitch, islands, matrix, system_out)
        eliminate(system_out.matrix, islands.system_start[island], 3 * count, right, pitch)
        keep_solution(block, island, count, pitch, islands, system_out)
    solve_rigid(island, islands, system_out)
    for block in range(islands.first_block[island], islands.first_block[island + 1]):
        for place in range(islands.block_start[block], islands.block_start[block + 1]):
            at = solution_entry(place, island, islands)
            x = system_out.solution[at]
            for i in range(dofs):
                x = x + system_out.solution[at + 1 + i] * system_out.rigid_matrix[first + i, 0]
            row = contact_row(place, block, islands)
            set_three(row, project_into_cone(x, system_out.surface[place]), system_out.impulse)
    update_rigid_velocity(island, islands, system_out)
