"""The solver of :mod:`vinesim.kernels.contact.tree_solver` on a GPU, with one thread for each row.

The matrices of trees are small, and their solve is a chain of dependent steps. Each step takes many times longer
through memory, even shared memory, than through registers and shuffles. The algorithm is that of ``tree_solver``. A
Newton step replaces the rows of contacts that are not closed by rows of an identity matrix.

The native code exchanges numbers between the threads of a warp and solves linear systems in registers. It does not
depend on contacts. All threads of a warp must call every function that contains native code.
"""

import warp as wp

from vinesim.kernels.contact.friction_law import (
    MIN_IMPULSE_SCALE,
    Steps,
    Surface,
    presses,
    project_into_cone,
    relaxed,
    size_of_change,
    slides,
)
from vinesim.kernels.contact.tree_solver import FIRST_SWEEPS, TreeSystem, sliding_row, steps_of_contact

wp.set_module_options({"enable_backward": False})

MOST_ROWS = wp.constant(30)
"""Largest number of rows of a tree that this solver handles. Each thread of a warp has one row."""


def _on_gpu(code: str, elsewhere: str = "0") -> str:
    """Returns native code for a GPU. On a CPU ``elsewhere`` is compiled instead, but never called."""
    about = f"constexpr int ROWS = {int(MOST_ROWS)};\nconstexpr unsigned ALL = 0xffffffffu;"
    return f"#if defined(__CUDA_ARCH__)\n{about}\n{code}\n#else\nreturn {elsewhere};\n#endif\n"


@wp.func_native(_on_gpu("return __shfl_sync(ALL, value, source, lanes);"))
def from_lane(value: wp.float64, source: int, lanes: int) -> wp.float64:
    """Returns the value of thread ``source`` among the ``lanes`` threads of the same tree."""
    ...


@wp.func_native(
    _on_gpu("return __ballot_sync(ALL, value) >> (threadIdx.x % 32 - lane) & (0xffffffffu >> (32 - lanes));")
)
def lanes_where(value: bool, lane: int, lanes: int) -> wp.uint32:
    """Returns a bit mask of the tree's threads: a bit is set if the thread's value is true."""
    ...


@wp.func_native(_on_gpu("return __any_sync(ALL, value);", "false"))
def any_of_warp(value: bool) -> bool:
    """Returns whether the value of any thread of the warp is true."""
    ...


@wp.func_native(_on_gpu("return __reduce_max_sync(ALL, value);"))
def most_of_warp(value: int) -> int:
    """Returns the largest value of the warp's threads, in a form that the compiler can treat as uniform over the
    warp."""
    ...


@wp.func_native(
    _on_gpu("""
for (int other = lanes / 2; other > 0; other /= 2) value += __shfl_xor_sync(ALL, value, other, lanes);
return value;
""")
)
def sum_of_lanes(value: wp.float64, lanes: int) -> wp.float64:
    """Returns the sum of the values of the tree's threads."""
    ...


@wp.func_native(
    _on_gpu("""
for (int other = lanes / 2; other > 0; other /= 2) value = fmax(value, __shfl_xor_sync(ALL, value, other, lanes));
return value;
""")
)
def largest_of_lanes(value: wp.float64, lanes: int) -> wp.float64:
    """Returns the largest value of the tree's threads."""
    ...


@wp.func
def of_contact(c: int, value: wp.float64, lanes: int):
    """Returns the values of the three rows of a contact."""
    return wp.vec3d(
        from_lane(value, 3 * c, lanes), from_lane(value, 3 * c + 1, lanes), from_lane(value, 3 * c + 2, lanes)
    )


@wp.func
def component(part: int, of: wp.vec3d):
    """Returns entry ``part`` of a vector. Indexing would move the vector from registers to memory."""
    return wp.where(part == 0, of[0], wp.where(part == 1, of[1], of[2]))


@wp.func
def coupling(j: int, lane: int, size: int, matrix: wp.array2d(dtype=float)):
    """Returns entry j [1/kg] of a thread's row of a symmetric matrix of ``size`` rows; 0 outside of the matrix."""
    if j < size and lane < size:
        return wp.float64(matrix[j, lane])
    return wp.float64(0.0)


@wp.func
def row_velocity(
    x: wp.float64, outside: wp.float64, lane: int, lanes: int, size: int, most: int, matrix: wp.array2d(dtype=float)
):
    """Returns ``outside`` [m/s] plus the velocity along a thread's row by the impulses of all rows. ``most``: upper
    bound of the number of rows.
    """
    v = outside
    for j in range(most):
        v = v + coupling(j, lane, size, matrix) * from_lane(x, j, lanes)
    return v


@wp.func_native(
    _on_gpu("""
double row[ROWS];
#pragma unroll
for (int j = 0; j < ROWS; ++j) {
    row[j] = 0.0;
    if (columns >> j & 1) {
        row[j] = own * wp::load(wp::address(matrix, j, lane)) + others * wp::load(wp::address(matrix, j, partner));
    }
    if (j / 3 == lane / 3) row[j] += added[j % 3];
}
double by_pivot = 0.0;
#pragma unroll
for (int k = 0; k < ROWS; ++k) {
    if (k % 3 == 0 && k >= most) break;
    const double reciprocal = 1.0 / __shfl_sync(ALL, row[k], k, lanes);
    const double factor = lane == k ? 0.0 : row[k] * reciprocal;
    if (lane == k) by_pivot = reciprocal;
    #pragma unroll
    for (int j = k + 1; j < ROWS; ++j) {
        if (j % 3 == 0 && j >= most) break;
        row[j] -= factor * __shfl_sync(ALL, row[j], k, lanes);
    }
    right -= factor * __shfl_sync(ALL, right, k, lanes);
}
return right * by_pivot;
""")
)
def solve_combined(
    matrix: wp.array2d(dtype=float),
    columns: wp.uint32,
    partner: int,
    own: wp.float64,
    others: wp.float64,
    added: wp.vec3d,
    right: wp.float64,
    lane: int,
    lanes: int,
    most: int,
) -> wp.float64:
    """Solve a linear system of at most ``most`` rows. Returns the entry of this thread.

    The thread's row of the system is ``own`` times its row of the matrix plus ``others`` times its partner's row, in
    the given columns, plus ``added`` in the columns of its own contact. ``right`` is its right-hand side. Gauss-Jordan
    elimination without pivoting: see :func:`vinesim.kernels.contact.tree_solver.solve_newton_system`.
    """
    ...


@wp.func
def newton_impulse(
    x: wp.float64,
    v: wp.float64,
    outside: wp.float64,
    lane: int,
    lanes: int,
    is_row: bool,
    most: int,
    steps: Steps,
    surface: Surface,
    matrix: wp.array2d(dtype=float),
):
    """Returns the impulse along a thread's row from a Newton step with all contacts in their present states, projected
    into the contact's friction cone."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    c = lane // 3
    part = lane % 3
    impulse = of_contact(c, x, lanes)
    velocity = of_contact(c, v, lanes)
    partner = 3 * c + wp.where(part == 1, 2, 1)
    outside_partner = from_lane(outside, partner, lanes)
    is_pressed = is_row and presses(impulse)
    pressing = lanes_where(is_pressed, lane, lanes)
    columns = wp.where(is_pressed, pressing, wp.uint32(0))
    own = wp.where(is_pressed, one, zero)
    others = wp.float64(0.0)
    diagonal = wp.where(is_pressed, surface.compliance, one)
    added = wp.vec3d(
        wp.where(part == 0, diagonal, zero),
        wp.where(part == 1, diagonal, zero),
        wp.where(part == 2, diagonal, zero),
    )
    if is_pressed and part > 0 and slides(impulse, surface):
        by_tangents, added = sliding_row(part, impulse, velocity, steps, surface)
        own = wp.where(part == 1, by_tangents[0], by_tangents[1])
        others = wp.where(part == 1, by_tangents[1], by_tangents[0])
    right = -(own * outside + others * outside_partner)
    found = solve_combined(matrix, columns, partner, own, others, added, right, lane, lanes, most)
    found = wp.where(is_pressed, found, x)
    return component(part, project_into_cone(of_contact(c, found, lanes), surface))


@wp.func
def sweep_rows(
    x: wp.float64,
    v: wp.float64,
    lane: int,
    lanes: int,
    size: int,
    busy: bool,
    most: int,
    steps: Steps,
    surface: Surface,
    matrix: wp.array2d(dtype=float),
):
    """Take one Gauss-Seidel step of each contact of a tree.

    Returns the impulse and the velocity along the row of a thread, the size of the change of its contact's impulse, and
    the normal impulse [N s]. The contacts take turns. In each turn every thread computes a step for its own contact,
    but only the result for the contact with this turn is used.
    """
    c = lane // 3
    part = lane % 3
    change = wp.float64(0.0)
    normal = wp.float64(0.0)
    for k in range(most // 3):
        impulse = of_contact(c, x, lanes)
        residual = of_contact(c, v, lanes) + surface.compliance * impulse
        after = relaxed(impulse, residual, steps, surface)
        is_next = busy and lane < size and c == k
        mine = wp.where(is_next, after - impulse, wp.vec3d())
        x = wp.where(is_next, component(part, after), x)
        change = wp.where(is_next, size_of_change(mine), change)
        normal = wp.where(is_next, after[0], normal)
        for axis in range(3):
            v = v + coupling(3 * k + axis, lane, size, matrix) * from_lane(mine[axis], 3 * k, lanes)
    return x, v, change, normal


@wp.func
def further_along(change: wp.float64, direction: wp.float64, gradient: wp.float64, gradient_before: wp.float64):
    """Returns the change of a thread's impulse along the conjugate direction after a sweep.

    See :func:`vinesim.kernels.contact.tree_solver.follow_conjugate_direction`.
    """
    goes = gradient_before > wp.float64(0.0) and gradient <= gradient_before
    return wp.where(goes, gradient / gradient_before * direction, wp.float64(0.0))


@wp.func
def solve_rows(
    lane: int,
    lanes: int,
    count: int,
    max_sweeps: int,
    newton_end: int,
    tolerance: wp.float64,
    system_out: TreeSystem,
):
    """Solve for the impulses of ``count`` contacts of a tree with ``lanes`` threads; this thread has the index
    ``lane``.

    Returns the number of sweeps. If there are more rows than threads, returns -1 and changes nothing.

    Variables that the loop assigns under a condition stay in registers from one turn to the next, since generated code
    declares all variables before the loop. So the loop selects values instead of branching, and computes in functions.
    """
    size = wp.where(3 * count <= wp.min(lanes, MOST_ROWS), 3 * count, 0)
    most = most_of_warp(size)  # all trees of a warp take the same steps
    if most == 0:
        return wp.where(count > 0, -1, 0)
    is_row = lane < size
    steps = Steps()
    surface = Surface()
    x = wp.float64(0.0)
    outside = wp.float64(0.0)
    if is_row:
        steps = steps_of_contact(lane // 3, system_out)
        surface = system_out.surface[lane // 3]
        x = system_out.impulse[lane]
        outside = system_out.free[lane]
    v = row_velocity(x, outside, lane, lanes, size, most, system_out.matrix)
    first = wp.float64(0.0)
    before = wp.float64(0.0)
    direction = wp.float64(0.0)
    gradient_before = wp.float64(0.0)
    busy = bool(size > 0)
    done = int(0)
    sweeps = int(0)
    while sweeps < max_sweeps and any_of_warp(busy):
        restarts = busy and newton_end > 0 and sweeps == newton_end + 1
        follows = busy and sweeps > newton_end and not restarts
        takes_step = busy and sweeps > 0 and sweeps <= newton_end
        first = wp.where(sweeps == FIRST_SWEEPS, x, first)
        found = wp.where(restarts, first, x)
        if any_of_warp(follows):
            change = x - before
            gradient = sum_of_lanes(change * change, lanes)
            further = further_along(change, direction, gradient, gradient_before)
            direction = wp.where(follows, further + change, direction)
            gradient_before = wp.where(follows, gradient, gradient_before)
            found = wp.where(follows, x + further, found)
        if any_of_warp(takes_step):
            impulse = newton_impulse(x, v, outside, lane, lanes, is_row, most, steps, surface, system_out.matrix)
            found = wp.where(takes_step, impulse, found)
        x = found
        moves = restarts or follows or takes_step
        if any_of_warp(moves):
            velocity = row_velocity(x, outside, lane, lanes, size, most, system_out.matrix)
            v = wp.where(moves, velocity, v)
        before = x
        x, v, change, normal = sweep_rows(x, v, lane, lanes, size, busy, most, steps, surface, system_out.matrix)
        largest = largest_of_lanes(wp.max(normal, MIN_IMPULSE_SCALE), lanes)
        sweeps = sweeps + 1
        done = wp.where(busy, sweeps, done)
        changing = lanes_where(
            change > tolerance * largest, lane, lanes
        )  # all threads call this, including those of finished trees
        busy = busy and changing != wp.uint32(0)
    if is_row:
        system_out.impulse[lane] = x
        system_out.velocity[lane] = v
    return wp.where(size > 0 or count == 0, done, -1)
