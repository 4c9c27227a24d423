"""Solves the contacts of one world with static geoms as a dense system, by the algorithm of the island solver.

:mod:`vinesim.kernels.contact.projected_gauss_seidel` solves islands of many blocks that rigid bodies couple, with lists
of blocks. The contacts of a single world form one matrix and no rigid body moves, so the velocity along a row is one
sum. On a GPU, :mod:`vinesim.kernels.worlds.row_solver` does the same with one thread for each row. This module solves
worlds with too many contacts for ``row_solver``, with one warp for each world. The threads of a warp share the rows and
take the same decisions from the same numbers. On a CPU one thread has all rows. The matrix is in single precision, like
the impulse response from which it is computed. All other numbers are in double precision.
"""

import warp as wp

from vinesim.kernels.contact.friction_law import (
    MIN_IMPULSE_SCALE,
    Steps,
    Surface,
    linearise_sliding,
    presses,
    project_into_cone,
    relaxed,
    size_of_change,
    slides,
    steps_of,
)
from vinesim.kernels.contact.island_system import set_three, three

wp.set_module_options({"enable_backward": False})


LANES_ACROSS = wp.constant(16)
"""Number of threads that share the columns of a row in the solution of a linear system. A warp processes two rows at
once."""
FIRST_SWEEPS = wp.constant(2)
"""Number of sweeps after which a world that has not converged is listed as busy. The search can return to the impulses
at this point."""
MOST_NEWTON_CONTACTS = wp.constant(16)
"""Largest number of contacts whose indices fit into one word. Worlds with more contacts take no Newton steps."""


@wp.struct
class WorldSystem:
    """The linear system and the contact properties that determine the impulses of one world's contacts."""

    matrix: wp.array2d(dtype=float)
    """[row, row] Delassus matrix, 1/kg."""
    free: wp.array(dtype=wp.float64)
    """[row] Velocity along the row without impulses, bias included, m/s."""
    surface: wp.array(dtype=Surface)
    """[contact] Contact properties of the pair of materials."""
    impulse: wp.array(dtype=wp.float64)
    """[row] Impulse, N s. Holds the initial guess at first."""
    velocity: wp.array(dtype=wp.float64)
    """[row] Velocity with the impulses, bias included, without compliance, m/s."""


@wp.struct
class WorldSearch:
    """Scratch of the search for the impulses of one world after its first sweeps."""

    factor: wp.array2d(dtype=wp.float64)
    """[row, row + 1] Linear system of a Newton step; the last column is the right-hand side."""
    first: wp.array(dtype=wp.float64)
    """[row] Impulses before the first Newton step, N s."""
    before: wp.array(dtype=wp.float64)
    """[row] Impulses before the last sweep, N s."""
    direction: wp.array(dtype=wp.float64)
    """[row] Direction of search, N s."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
if (lanes > 1) {
    const unsigned lane = threadIdx.x % 32, first = lane - lane % lanes;
    __syncwarp(lanes < 32 ? ((1u << lanes) - 1u) << first : 0xffffffffu);
}
#endif
""")
def synchronize_lanes(lanes: int):
    """Wait until all threads that share the world have called this function. Writes before the call are then visible to
    all of them.

    The threads are adjacent in one warp; ``lanes`` divides 32.
    """
    ...


@wp.func
def update_velocities(lane: int, lanes: int, size: int, system_out: WorldSystem):
    """Compute the velocities along all contact rows of a world from the impulses."""
    for row in range(lane, size, lanes):
        value = system_out.free[row]
        for j in range(size):  # the matrix is symmetric: along its row, threads in step read one stretch
            value = value + wp.float64(system_out.matrix[j, row]) * system_out.impulse[j]
        system_out.velocity[row] = value
    synchronize_lanes(lanes)


@wp.func
def steps_of_contact(c: int, system: WorldSystem):
    """Returns the step sizes of a contact's Gauss-Seidel step."""
    own = wp.mat33d()
    for r in range(3):
        for k in range(3):
            own[r, k] = wp.float64(system.matrix[3 * c + r, 3 * c + k])
        own[r, r] = own[r, r] + system.surface[c].compliance
    return steps_of(own)


@wp.func
def relax_contact(c: int, lane: int, lanes: int, size: int, system_out: WorldSystem):
    """Take one Gauss-Seidel step of a contact.

    Returns its normal impulse and the size of the change of impulse [N s].
    """
    zero = wp.float64(0.0)
    n = 3 * c
    surface = system_out.surface[c]
    before = three(n, system_out.impulse)
    residual = surface.compliance * before + three(n, system_out.velocity)
    after = relaxed(before, residual, steps_of_contact(c, system_out), surface)
    change = after - before
    synchronize_lanes(lanes)
    if change[0] != zero or change[1] != zero or change[2] != zero:
        if lane == 0:
            set_three(n, after, system_out.impulse)
        for row in range(lane, size, lanes):
            system_out.velocity[row] = (
                system_out.velocity[row]
                + wp.float64(system_out.matrix[n, row]) * change[0]
                + wp.float64(system_out.matrix[n + 1, row]) * change[1]
                + wp.float64(system_out.matrix[n + 2, row]) * change[2]
            )
    synchronize_lanes(lanes)
    return after[0], size_of_change(change)


@wp.func
def list_pressing(count: int, system: WorldSystem):
    """Returns the indices of the closed contacts, four bits each, and their number."""
    listed = wp.int64(0)
    found = int(0)
    for c in range(count):
        if presses(three(3 * c, system.impulse)):
            listed = listed | (wp.int64(c) << wp.int64(4 * found))
            found = found + 1
    return listed, found


@wp.func
def row_of(listed: wp.int64, i: int):
    """Returns the contact row of row ``i`` of the linear system, which contains only the rows of the contacts in
    ``listed`` (indices of four bits each).
    """
    return 3 * int((listed >> wp.int64(4 * (i // 3))) & wp.int64(15)) + i % 3


@wp.func
def sliding_row(part: int, x: wp.vec3d, velocity: wp.vec3d, steps: Steps, surface: Surface):
    """Returns the coefficients of the row of the Newton system for the friction of a sliding contact along its tangent
    ``part`` (1 or 2): x_t - K (x_t - step r_t) - g x_n = 0, see
    :func:`vinesim.kernels.contact.friction_law.linearise_sliding`.

    ``x`` [N s]: impulses of the contact. ``velocity`` [m/s]: its velocities without the compliance term. Returns the
    factors of the matrix rows and free velocities of the two tangents, and the terms that are added for the contact's
    own impulses.
    """
    K, g = linearise_sliding(x, velocity + surface.compliance * x, steps, surface)
    along_u = wp.where(part == 1, wp.float64(1.0), wp.float64(0.0))
    along_v = wp.float64(1.0) - along_u
    by_u = along_u * K[0, 0] + along_v * K[1, 0]
    by_v = along_u * K[0, 1] + along_v * K[1, 1]
    softer = wp.float64(1.0) - surface.compliance * steps.tangential
    added = wp.vec3d(-(along_u * g[0] + along_v * g[1]), along_u - softer * by_u, along_v - softer * by_v)
    return wp.vec2d(steps.tangential * by_u, steps.tangential * by_v), added


@wp.func
def write_sliding_row(i: int, listed: wp.int64, size: int, system: WorldSystem, search_out: WorldSearch):
    """Write a friction row of a sliding contact; see :func:`sliding_row`."""
    n = row_of(listed, i - i % 3)
    c = n // 3
    by, added = sliding_row(
        i % 3, three(n, system.impulse), three(n, system.velocity), steps_of_contact(c, system), system.surface[c]
    )
    for k in range(size):
        column = row_of(listed, k)
        search_out.factor[i, k] = by[0] * wp.float64(system.matrix[column, n + 1]) + by[1] * wp.float64(
            system.matrix[column, n + 2]
        )
    for axis in range(3):
        k = i - i % 3 + axis
        search_out.factor[i, k] = search_out.factor[i, k] + added[axis]
    search_out.factor[i, size] = -(by[0] * system.free[n + 1] + by[1] * system.free[n + 2])


@wp.func
def write_newton_system(
    listed: wp.int64, lane: int, lanes: int, size: int, system: WorldSystem, search_out: WorldSearch
):
    """Write the linear system for the present states of the listed contacts, which are the closed ones. Open contacts
    have no impulse.

    Sticking rows: (A + compliance) x = -velocity. Friction of sliding contacts: see :func:`write_sliding_row`.
    """
    for i in range(lane, size, lanes):
        row = row_of(listed, i)
        c = row // 3
        if i % 3 > 0 and slides(three(3 * c, system.impulse), system.surface[c]):
            write_sliding_row(i, listed, size, system, search_out)
        else:
            for k in range(size):
                search_out.factor[i, k] = wp.float64(system.matrix[row_of(listed, k), row])
            search_out.factor[i, i] = search_out.factor[i, i] + system.surface[c].compliance
            search_out.factor[i, size] = -system.free[row]
    synchronize_lanes(lanes)


@wp.func
def solve_newton_system(
    listed: wp.int64, lane: int, lanes: int, size: int, system_out: WorldSystem, search_out: WorldSearch
):
    """Solve the linear system by Gaussian elimination without pivoting: the matrix is positive definite, and sliding
    rows change it little."""
    across = wp.min(lanes, LANES_ACROSS)
    down = wp.max(lanes / LANES_ACROSS, 1)
    for k in range(size):
        scale = wp.float64(1.0) / search_out.factor[k, k]
        for m in range(k + 1 + lane // across, size, down):
            factor = search_out.factor[m, k] * scale
            if factor != wp.float64(0.0):
                for j in range(k + 1 + lane % across, size + 1, across):
                    search_out.factor[m, j] = search_out.factor[m, j] - factor * search_out.factor[k, j]
        synchronize_lanes(lanes)
    for back in range(size):
        k = size - 1 - back
        value = search_out.factor[k, size] / search_out.factor[k, k]
        for m in range(lane, k, lanes):
            search_out.factor[m, size] = search_out.factor[m, size] - search_out.factor[m, k] * value
        if lane == 0:
            system_out.impulse[row_of(listed, k)] = value
        synchronize_lanes(lanes)


@wp.func
def take_newton_step(lane: int, lanes: int, count: int, system_out: WorldSystem, search_out: WorldSearch):
    """Solve for the impulses with each contact in its present state (open, sticking or sliding), and project them into
    their friction cones."""
    listed, found = list_pressing(count, system_out)
    synchronize_lanes(lanes)
    write_newton_system(listed, lane, lanes, 3 * found, system_out, search_out)
    solve_newton_system(listed, lane, lanes, 3 * found, system_out, search_out)
    project_into_cones(lane, lanes, count, system_out)
    update_velocities(lane, lanes, 3 * count, system_out)


@wp.func
def project_into_cones(lane: int, lanes: int, count: int, system_out: WorldSystem):
    """Project the impulses into their friction cones, where the assumed state of a contact was wrong."""
    for c in range(lane, count, lanes):
        x = project_into_cone(three(3 * c, system_out.impulse), system_out.surface[c])
        set_three(3 * c, x, system_out.impulse)
    synchronize_lanes(lanes)


@wp.func
def follow_conjugate_direction(
    gradient_before: wp.float64, lane: int, lanes: int, size: int, system_out: WorldSystem, search_out: WorldSearch
):
    """Move the impulses of a world along the conjugate direction after a Gauss-Seidel sweep. Returns the square of the
    gradient, which is the change of the impulses by the sweep [N^2 s^2].

    See :func:`vinesim.kernels.contact.conjugate_gradient.follow_conjugate_direction`.
    """
    zero = wp.float64(0.0)
    gradient = wp.float64(0.0)
    for row in range(size):
        change = system_out.impulse[row] - search_out.before[row]
        gradient = gradient + change * change
    share = wp.float64(0.0)
    if gradient_before > zero and gradient <= gradient_before:
        share = gradient / gradient_before
    synchronize_lanes(lanes)
    for row in range(lane, size, lanes):
        change = system_out.impulse[row] - search_out.before[row]
        further = zero
        if share > zero:
            further = share * search_out.direction[row]
            system_out.impulse[row] = system_out.impulse[row] + further
        search_out.direction[row] = further + change
    synchronize_lanes(lanes)
    if share > zero:
        update_velocities(lane, lanes, size, system_out)
    return gradient


@wp.func
def copy_rows(
    lane: int, lanes: int, size: int, source: wp.array(dtype=wp.float64), target_out: wp.array(dtype=wp.float64)
):
    """Copy the values of all contact rows of one world."""
    for row in range(lane, size, lanes):
        target_out[row] = source[row]
    synchronize_lanes(lanes)


@wp.func
def step_or_follow(
    sweeps: int,
    newton_end: int,
    gradient: wp.float64,
    lane: int,
    lanes: int,
    count: int,
    system_out: WorldSystem,
    search_out: WorldSearch,
):
    """Continue the search between two sweeps, by a Newton step or along a conjugate direction. Returns the square of
    the gradient [N^2 s^2]."""
    size = 3 * count
    if sweeps == newton_end + 1 and newton_end > 0:
        copy_rows(lane, lanes, size, search_out.first, system_out.impulse)
        update_velocities(lane, lanes, size, system_out)
    elif sweeps > newton_end:
        gradient = follow_conjugate_direction(gradient, lane, lanes, size, system_out, search_out)
    elif sweeps > 0:
        take_newton_step(lane, lanes, count, system_out, search_out)
    return gradient


@wp.func
def sweep_contacts(lane: int, lanes: int, count: int, tolerance: wp.float64, system_out: WorldSystem):
    """Take one Gauss-Seidel step of each contact of a world.

    Returns whether an impulse changed by more than ``tolerance`` times the largest impulse.
    """
    change = wp.float64(0.0)
    largest = wp.float64(MIN_IMPULSE_SCALE)
    for c in range(count):
        normal, moved = relax_contact(c, lane, lanes, 3 * count, system_out)
        change = wp.max(change, moved)
        largest = wp.max(largest, normal)
    return change > tolerance * largest


@wp.func
def solve_world(
    sweeps: int,
    lane: int,
    lanes: int,
    count: int,
    max_sweeps: int,
    newton_end: int,
    tolerance: wp.float64,
    system_out: WorldSystem,
    search_out: WorldSearch,
):
    """Solve for the impulses of ``count`` contacts of a world. ``sweeps``: number of sweeps that were taken before the
    call.

    Returns the total number of sweeps, and whether the last sweep changed more than ``tolerance``.

    The method is that of :func:`vinesim.kernels.contact.projected_gauss_seidel.solve_island`, but with a Newton step
    after every sweep up to ``newton_end``, in which the direction of sliding is linearised. ``lane``: index of this
    thread among the ``lanes`` threads that share the world.
    """
    gradient = wp.float64(0.0)
    busy = bool(True)
    while busy and sweeps < max_sweeps:
        gradient = step_or_follow(sweeps, newton_end, gradient, lane, lanes, count, system_out, search_out)
        if sweeps >= newton_end:
            copy_rows(lane, lanes, 3 * count, system_out.impulse, search_out.before)
        busy = sweep_contacts(lane, lanes, count, tolerance, system_out)
        sweeps = sweeps + 1
    return sweeps, busy


@wp.func
def end_growth(lane: int, lanes: int, size: int, system_out: WorldSystem):
    """Scale the impulses of a world whose solve did not converge, so that they add no energy.

    See :func:`vinesim.kernels.contact.projected_gauss_seidel.end_growth`.
    """
    free = wp.float64(0.0)
    own = wp.float64(0.0)
    for row in range(size):
        x = system_out.impulse[row]
        before = system_out.free[row]
        free = free + x * before
        own = own + x * (system_out.surface[row // 3].compliance * x + system_out.velocity[row] - before)
    synchronize_lanes(lanes)
    if free + own > wp.float64(0.0):
        share = wp.max(wp.float64(0.0), -free / own)
        for row in range(lane, size, lanes):
            system_out.impulse[row] = share * system_out.impulse[row]
        synchronize_lanes(lanes)
        update_velocities(lane, lanes, size, system_out)
