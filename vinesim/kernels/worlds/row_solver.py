"""The solver of :mod:`vinesim.kernels.worlds.dense_solver` on a GPU, with one thread for each row.

The matrices of worlds are small, and their solve is a chain of dependent steps. Each step takes many times longer
through memory, even shared memory, than through registers and shuffles. The algorithm is that of ``dense_solver``. A
Newton step replaces the rows of contacts that are not closed by rows of an identity matrix.

The native code exchanges numbers between the threads of a warp and solves linear systems in registers. It does not
depend on contacts. All threads of a warp must call every function that contains native code.

The matrix column of a thread stays in registers as well, which needs loops of constant length. :func:`row_solver`
therefore makes the functions for a number of rows and of threads.
"""

from collections.abc import Callable
from typing import Any

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
from vinesim.kernels.worlds.dense_solver import FIRST_SWEEPS, WorldSystem, sliding_row, steps_of_contact

wp.set_module_options({"enable_backward": False})


def _on_gpu(code: str, elsewhere: str = "0") -> str:
    """Returns native code for a GPU. On a CPU ``elsewhere`` is compiled instead, but never called."""
    return f"#if defined(__CUDA_ARCH__)\nconstexpr unsigned ALL = 0xffffffffu;\n{code}\n#else\nreturn {elsewhere};\n#endif\n"


@wp.func_native(_on_gpu("return __shfl_sync(ALL, value, source, lanes);"))
def from_lane(value: wp.float64, source: int, lanes: int) -> wp.float64:
    """Returns the number that thread ``source`` holds in ``value``. The ``lanes`` threads that solve one world have the
    indices 0 to ``lanes`` - 1.
    """
    ...


@wp.func_native(
    _on_gpu("return __ballot_sync(ALL, value) >> (threadIdx.x % 32 - lane) & (0xffffffffu >> (32 - lanes));")
)
def lanes_where(value: bool, lane: int, lanes: int) -> wp.uint32:
    """Returns a bit for each thread of the world: whether its value is true."""
    ...


@wp.func_native(_on_gpu("return __any_sync(ALL, value);", "false"))
def any_of_warp(value: bool) -> bool:
    """Returns whether the value of any thread of the warp is true."""
    ...


@wp.func_native(
    _on_gpu("""
#if __CUDA_ARCH__ >= 800
return __reduce_max_sync(ALL, value);
#else  // Turing
for (int other = 16; other > 0; other /= 2) value = max(value, __shfl_xor_sync(ALL, value, other));
return value;
#endif
""")
)
def most_of_warp(value: int) -> int:
    """Returns the largest value of the warp's threads. The compiler knows that all threads get the same result."""
    ...


@wp.func_native(
    _on_gpu("""
for (int other = lanes / 2; other > 0; other /= 2) value += __shfl_xor_sync(ALL, value, other, lanes);
return value;
""")
)
def sum_of_lanes(value: wp.float64, lanes: int) -> wp.float64:
    """Returns the sum of the values of the world's threads."""
    ...


@wp.func_native(
    _on_gpu("""
for (int other = lanes / 2; other > 0; other /= 2) value = fmax(value, __shfl_xor_sync(ALL, value, other, lanes));
return value;
""")
)
def largest_of_lanes(value: wp.float64, lanes: int) -> wp.float64:
    """Returns the largest value of the world's threads."""
    ...


@wp.func
def of_contact(c: int, value: wp.float64, lanes: int):
    """Returns the numbers that the three threads of contact ``c`` hold in ``value``, one for each row of the contact."""
    return wp.vec3d(
        from_lane(value, 3 * c, lanes), from_lane(value, 3 * c + 1, lanes), from_lane(value, 3 * c + 2, lanes)
    )


@wp.func
def component(part: int, of: wp.vec3d):
    """Returns entry ``part`` (0 to 2) of the vector ``of``. The code compares instead of indexing, because an index
    would move the vector from registers to memory.
    """
    return wp.where(part == 0, of[0], wp.where(part == 1, of[1], of[2]))


@wp.func(inline=True)
def follow_direction(
    follows: bool,
    x: wp.float64,
    change: wp.float64,
    direction: wp.float64,
    gradient_before: wp.float64,
    lanes: int,
):
    """Add a step along the conjugate direction to a thread's impulse, after a sweep that changed the impulse by
    ``change``. Only worlds that follow the direction (``follows``) take the step.

    Returns the impulse, the direction, and the square of the change of all impulses of the world. See
    :func:`vinesim.kernels.worlds.dense_solver.follow_conjugate_direction`.
    """
    if not any_of_warp(follows):
        return x, direction, gradient_before
    gradient = sum_of_lanes(change * change, lanes)
    goes = gradient_before > wp.float64(0.0) and gradient <= gradient_before
    further = wp.where(goes, gradient / gradient_before * direction, wp.float64(0.0))
    return (
        wp.where(follows, x + further, x),
        wp.where(follows, further + change, direction),
        wp.where(follows, gradient, gradient_before),
    )


_ELIMINATION = """
double row[ROWS];
#pragma unroll
for (int j = 0; j < ROWS; ++j) {
    const float theirs = __shfl_sync(ALL, column[j], partner, lanes);
    row[j] = columns >> j & 1 ? own * column[j] + others * theirs : 0.0;
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
"""


def row_solver(rows: int, lanes: int) -> Any:  # noqa: PLR0915 (it holds nine functions)
    """Returns a Warp function that solves a world of at most ``rows`` rows with ``lanes`` threads of a GPU, 16 or 32."""
    Column = wp.types.vector(length=rows, dtype=wp.float32)

    def func(function: Callable[..., Any]) -> Any:
        """Returns ``function`` as an inlined Warp function with the number of rows in its name.

        Warp needs different names, because each call of :func:`row_solver` makes functions of the same names.
        """
        return wp.func(function, name=f"{function.__name__}_{rows}", inline=True)

    @func
    def column_of(lane: int, size: int, matrix: wp.array2d(dtype=float)):
        """Returns the column [1/kg] of a thread's row in a symmetric matrix of ``size`` rows, filled up with zeros."""
        column = Column()
        for j in range(wp.static(rows)):
            if j < size and lane < size:
                column[j] = matrix[j, lane]
        return column

    @func
    def row_velocity(x: wp.float64, outside: wp.float64, column: Column):
        """Returns the velocity [m/s] along a thread's row: ``outside`` (the velocity without impulses) plus the
        velocity by the impulses ``x`` of all rows.
        """
        v = outside
        for j in range(wp.static(rows)):
            v = v + wp.float64(column[j]) * from_lane(x, j, lanes)
        return v

    @func
    def moved_velocity(moves: bool, x: wp.float64, v: wp.float64, outside: wp.float64, column: Column):
        """Returns the velocity [m/s] along a thread's row: the present velocity ``v`` if no impulse of the thread's
        world has changed (``moves`` false), else the result of ``row_velocity``.
        """
        if not any_of_warp(moves):
            return v
        return wp.where(moves, row_velocity(x, outside, column), v)

    @wp.func_native(_on_gpu(_ELIMINATION.replace("ROWS", str(rows))))
    def solve_combined(
        column: Column,
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
        """Solve a linear system of at most ``most`` rows. Returns this thread's entry of the solution.

        The thread's row of the system is ``own`` times its column of the symmetric matrix plus ``others`` times its
        partner's column, in the given columns, plus ``added`` in the columns of its own contact. ``right`` is its
        right-hand side. Gauss-Jordan elimination without pivoting: see
        :func:`vinesim.kernels.worlds.dense_solver.solve_newton_system`.
        """
        ...

    @func
    def newton_impulse(
        takes_step: bool,
        x: wp.float64,
        v: wp.float64,
        outside: wp.float64,
        lane: int,
        is_row: bool,
        most: int,
        steps: Steps,
        surface: Surface,
        column: Column,
    ):
        """Returns the impulse along a thread's row. If the thread's world ``takes_step``, the impulse comes from a Newton
        step with all contacts in their present states, projected into the contact's friction cone; otherwise it is
        ``x``.
        """
        if not any_of_warp(takes_step):
            return x
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
        found = solve_combined(column, columns, partner, own, others, added, right, lane, lanes, most)
        found = wp.where(is_pressed, found, x)
        projected = component(part, project_into_cone(of_contact(c, found, lanes), surface))
        return wp.where(takes_step, projected, x)

    @func
    def sweep_rows(x: wp.float64, v: wp.float64, lane: int, turns: int, steps: Steps, surface: Surface, column: Column):
        """Take one Gauss-Seidel sweep over the contacts, one contact after the other. Returns the impulse and the
        velocity along the row of a thread, the size of the change of its contact's impulse, and the normal impulse [N
        s].

        Each thread computes for its own contact, and uses the result at that contact's turn. turns: number of contacts
        of the thread's world; 0 if its impulses do not change any more.
        """
        c = lane // 3
        part = lane % 3
        change = wp.float64(0.0)
        normal = wp.float64(0.0)
        for k in range(wp.static(rows // 3)):
            impulse = of_contact(c, x, lanes)
            residual = of_contact(c, v, lanes) + surface.compliance * impulse
            after = relaxed(impulse, residual, steps, surface)
            is_next = c == k and k < turns
            mine = wp.where(is_next, after - impulse, wp.vec3d())
            x = wp.where(is_next, component(part, after), x)
            change = wp.where(is_next, size_of_change(mine), change)
            normal = wp.where(is_next, after[0], normal)
            v = v + wp.float64(column[3 * k]) * from_lane(mine[0], 3 * k, lanes)
            v = v + wp.float64(column[3 * k + 1]) * from_lane(mine[1], 3 * k, lanes)
            v = v + wp.float64(column[3 * k + 2]) * from_lane(mine[2], 3 * k, lanes)
        return x, v, change, normal

    @func
    def without_growth(ends: bool, x: wp.float64, v: wp.float64, outside: wp.float64, compliance: wp.float64):
        """Returns the impulse and the velocity along a thread's row, scaled in worlds whose search ``ends`` before it
        has converged. See :func:`vinesim.kernels.worlds.dense_solver.end_growth`."""
        if not any_of_warp(ends):
            return x, v
        free = sum_of_lanes(x * outside, lanes)
        own = sum_of_lanes(x * (compliance * x + v - outside), lanes)
        share = wp.float64(1.0)
        if ends and free + own > wp.float64(0.0):
            share = wp.max(wp.float64(0.0), -free / own)
        return share * x, outside + share * (v - outside)

    @func
    def solve_rows(
        lane: int,
        count: int,
        max_sweeps: int,
        newton_end: int,
        tolerance: wp.float64,
        system_out: WorldSystem,
    ):
        """Solve for the impulses of ``count`` contacts of a world; this thread has the index ``lane``.

        Returns the number of sweeps, or -1 if there are too many rows; nothing is changed then.

        Variables that the loop assigns under a condition stay in registers from one turn to the next, since generated
        code declares all variables before the loop. So the loop selects values instead of branching, and computes in
        functions.
        """
        size = wp.where(3 * count <= rows, 3 * count, 0)
        most = most_of_warp(size)  # all worlds of a warp go through the same steps
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
        column = column_of(lane, size, system_out.matrix)
        v = row_velocity(x, outside, column)
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
            found, direction, gradient_before = follow_direction(
                follows, found, x - before, direction, gradient_before, lanes
            )
            x = newton_impulse(takes_step, found, v, outside, lane, is_row, most, steps, surface, column)
            v = moved_velocity(restarts or follows or takes_step, x, v, outside, column)
            before = x
            x, v, change, normal = sweep_rows(x, v, lane, wp.where(busy, count, 0), steps, surface, column)
            largest = largest_of_lanes(wp.max(normal, MIN_IMPULSE_SCALE), lanes)
            sweeps = sweeps + 1
            done = wp.where(busy, sweeps, done)
            changing = lanes_where(
                change > tolerance * largest, lane, lanes
            )  # all threads call this, also of finished worlds
            busy = busy and changing != wp.uint32(0)
        x, v = without_growth(busy, x, v, outside, surface.compliance)
        if is_row:
            system_out.impulse[lane] = x
            system_out.velocity[lane] = v
        return wp.where(size > 0 or count == 0, done, -1)

    return solve_rows


solve_few_rows = row_solver(15, 16)
"""Solves a world of at most 15 rows with 16 threads."""
solve_many_rows = row_solver(30, 32)
"""Solves a world of at most 30 rows with the 32 threads of a warp."""
