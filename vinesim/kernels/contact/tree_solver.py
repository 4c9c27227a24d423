"""The impulses of one tree's contacts with what does not move: the conditions and steps of the solver of islands, dense.

:mod:`vinesim.kernels.contact.projected_gauss_seidel` solves islands of many blocks that rigid bodies couple, and finds its
way through lists of them. The contacts of a tree alone are one matrix, and nothing else moves: then a row is a sum. On a
GPU :mod:`vinesim.kernels.contact.row_solver` does the same in registers, and what is here solves the trees that have too
many contacts for that, a warp each, whose threads share the rows and all take the same decisions from the same numbers. On
a CPU one thread has all rows. The matrix is in single precision, as the impulse response is that it comes from; all else is
in double precision.
"""

import warp as wp

from vinesim.kernels.contact.newton import SLIDING_SHARE
from vinesim.kernels.contact.projected_gauss_seidel import MIN_IMPULSE_SCALE

wp.set_module_options({"enable_backward": False})


LANES_ACROSS = wp.constant(16)
"""Threads that share the columns of a row when a system is solved; two rows at once."""
FIRST_SWEEPS = wp.constant(2)
"""Sweeps after which a tree is listed as one that needs more; impulses as they are then are what the search returns to."""
MOST_NEWTON_CONTACTS = wp.constant(16)
"""Contacts whose numbers fit into one word: trees with more take no Newton steps."""


@wp.struct
class TreeSystem:
    """Contacts of one tree: what their impulses must fulfil, and scratch of the search."""

    matrix: wp.array2d(dtype=float)
    """[row, row] Delassus matrix, 1/kg."""
    free: wp.array(dtype=wp.float64)
    """[row] m/s without impulses, bias included."""
    friction: wp.array(dtype=wp.float64)
    """[contact] Coulomb coefficient."""
    compliance: wp.array(dtype=wp.float64)
    """[contact] m/(N s^2)"""
    impulse: wp.array(dtype=wp.float64)
    """[row] N s, the guess at first."""
    velocity: wp.array(dtype=wp.float64)
    """[row] m/s with the impulses, bias included, without compliance."""


@wp.struct
class TreeSearch:
    """What the search for the impulses of one tree works with after its first sweeps."""

    factor: wp.array2d(dtype=wp.float64)
    """[row, row + 1] the linear system of a Newton step, right-hand side last."""
    first: wp.array(dtype=wp.float64)
    """[row] impulses before the first Newton step."""
    before: wp.array(dtype=wp.float64)
    """[row] impulses before the last sweep."""
    direction: wp.array(dtype=wp.float64)
    """[row] direction of search."""


@wp.func
def reciprocal(x: wp.float64):
    """1 / x from single precision by two Newton steps: to rounding, in a fifth of the instructions of a division."""
    two = wp.float64(2.0)
    y = wp.float64(1.0 / wp.float32(x))
    y = y * (two - x * y)
    return y * (two - x * y)


@wp.func
def reciprocal_root(square: wp.float64):
    """1 / sqrt(square) in the same way."""
    y = wp.float64(1.0 / wp.sqrt(wp.max(wp.float32(square), 1.0e-30)))
    return y * (wp.float64(1.5) - wp.float64(0.5) * square * y * y)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
if (lanes > 1) {
    const unsigned lane = threadIdx.x % 32, first = lane - lane % lanes;
    __syncwarp(lanes < 32 ? ((1u << lanes) - 1u) << first : 0xffffffffu);
}
#endif
""")
def synchronize_lanes(lanes: int):
    """Wait until all threads that share the tree have come here; each then sees what the others wrote.

    They are neighbours of one warp; ``lanes`` divides 32.
    """
    ...


@wp.func
def update_velocities(lane: int, lanes: int, size: int, system_out: TreeSystem):
    """Compute the velocities along all rows anew from the impulses."""
    for row in range(lane, size, lanes):
        value = system_out.free[row]
        for j in range(size):  # the matrix is symmetric: along its row, threads in step read one stretch
            value = value + wp.float64(system_out.matrix[j, row]) * system_out.impulse[j]
        system_out.velocity[row] = value
    synchronize_lanes(lanes)


@wp.func
def tangential_eigenvalue(c: int, system: TreeSystem):
    """The larger eigenvalue [1/kg] of the tangential block of a contact, with compliance."""
    half = wp.float64(0.5)
    uu = wp.float64(system.matrix[3 * c + 1, 3 * c + 1])
    vv = wp.float64(system.matrix[3 * c + 2, 3 * c + 2])
    uv = wp.float64(system.matrix[3 * c + 1, 3 * c + 2])
    spread = half * (uu - vv)
    square = spread * spread + uv * uv
    return half * (uu + vv) + system.compliance[c] + square * reciprocal_root(square)


@wp.func
def relax_contact(c: int, lane: int, lanes: int, size: int, system_out: TreeSystem):
    """One Gauss-Seidel step of a contact, normal and then friction: its normal impulse and the largest change [N s]."""
    compliance = system_out.compliance[c]
    n = 3 * c
    before = wp.vec3d(system_out.impulse[n], system_out.impulse[n + 1], system_out.impulse[n + 2])
    r = compliance * before + wp.vec3d(system_out.velocity[n], system_out.velocity[n + 1], system_out.velocity[n + 2])
    normal = wp.max(wp.float64(0.0), before[0] - r[0] * reciprocal(wp.float64(system_out.matrix[n, n]) + compliance))
    change = normal - before[0]
    ru = r[1] + change * wp.float64(system_out.matrix[n, n + 1])
    rv = r[2] + change * wp.float64(system_out.matrix[n, n + 2])
    # the larger eigenvalue of the tangential block: the step stays inside the cone's convergence
    step = reciprocal(tangential_eigenvalue(c, system_out))
    fu = before[1] - ru * step
    fv = before[2] - rv * step
    square = fu * fu + fv * fv
    limit = system_out.friction[c] * normal
    if square > limit * limit:
        share = limit * reciprocal_root(square)
        fu = fu * share
        fv = fv * share
    change_u = fu - before[1]
    change_v = fv - before[2]
    synchronize_lanes(lanes)
    if change != wp.float64(0.0) or change_u != wp.float64(0.0) or change_v != wp.float64(0.0):
        if lane == 0:
            system_out.impulse[n] = normal
            system_out.impulse[n + 1] = fu
            system_out.impulse[n + 2] = fv
        for row in range(lane, size, lanes):
            system_out.velocity[row] = (
                system_out.velocity[row]
                + wp.float64(system_out.matrix[n, row]) * change
                + wp.float64(system_out.matrix[n + 1, row]) * change_u
                + wp.float64(system_out.matrix[n + 2, row]) * change_v
            )
    synchronize_lanes(lanes)
    return normal, wp.max(wp.abs(change), wp.abs(change_u) + wp.abs(change_v))


@wp.func
def list_pressing(count: int, system: TreeSystem):
    """Numbers of the contacts that press, four bits each, and how many they are."""
    listed = wp.int64(0)
    found = int(0)
    for c in range(count):
        if system.impulse[3 * c] > wp.float64(0.0):
            listed = listed | (wp.int64(c) << wp.int64(4 * found))
            found = found + 1
    return listed, found


@wp.func
def row_of(listed: wp.int64, i: int):
    """Row of entry ``i`` of the linear system, which has the rows of listed contacts only."""
    return 3 * int((listed >> wp.int64(4 * (i // 3))) & wp.int64(15)) + i % 3


@wp.func
def write_sliding_row(i: int, listed: wp.int64, size: int, system: TreeSystem, search_out: TreeSearch):
    """Write a friction row of a sliding contact.

    Friction is the projection of f = x_t - r_t / e on the disk of radius mu x_n, where r_t is the velocity along the
    tangents, compliance included, and e their eigenvalue. Linearised about the present f, with d = f / |f|,
    P = 1 - d d^T and s = mu x_n / |f|:  x_t - s P (x_t - r_t / e) - mu d x_n = 0 (Alart and Curnier, A mixed
    formulation for frictional contact problems prone to Newton like solution methods, 1991).
    """
    one = wp.float64(1.0)
    c = row_of(listed, i) // 3
    n = 3 * c
    u = n + 1
    v = n + 2
    softness = reciprocal(tangential_eigenvalue(c, system))
    softer = one - system.compliance[c] * softness
    fu = softer * system.impulse[u] - softness * system.velocity[u]
    fv = softer * system.impulse[v] - softness * system.velocity[v]
    scale = reciprocal_root(fu * fu + fv * fv)
    friction = system.friction[c]
    share = wp.min(friction * system.impulse[n] * scale, one)
    along_u = wp.where(i % 3 == 1, one, wp.float64(0.0))
    along_v = one - along_u
    mine = (along_u * fu + along_v * fv) * scale
    cu = share * (along_u - mine * fu * scale)
    cv = share * (along_v - mine * fv * scale)
    for k in range(size):
        column = row_of(listed, k)
        search_out.factor[i, k] = softness * (
            cu * wp.float64(system.matrix[column, u]) + cv * wp.float64(system.matrix[column, v])
        )
    k = i - i % 3
    search_out.factor[i, k] = search_out.factor[i, k] - friction * mine
    search_out.factor[i, k + 1] = search_out.factor[i, k + 1] + along_u - softer * cu
    search_out.factor[i, k + 2] = search_out.factor[i, k + 2] + along_v - softer * cv
    search_out.factor[i, size] = -softness * (cu * system.free[u] + cv * system.free[v])


@wp.func
def write_newton_system(listed: wp.int64, lane: int, lanes: int, size: int, system: TreeSystem, search_out: TreeSearch):
    """The linear system of the present states of the listed contacts, which press; others have no impulse.

    Sticking rows: (A + compliance) x = -velocity. Friction of sliding contacts: see :func:`write_sliding_row`.
    """
    for i in range(lane, size, lanes):
        row = row_of(listed, i)
        c = row // 3
        u = system.impulse[3 * c + 1]
        v = system.impulse[3 * c + 2]
        limit = system.friction[c] * system.impulse[3 * c] * SLIDING_SHARE
        if i % 3 > 0 and u * u + v * v >= limit * limit:
            write_sliding_row(i, listed, size, system, search_out)
        else:
            for k in range(size):
                search_out.factor[i, k] = wp.float64(system.matrix[row_of(listed, k), row])
            search_out.factor[i, i] = search_out.factor[i, i] + system.compliance[c]
            search_out.factor[i, size] = -system.free[row]
    synchronize_lanes(lanes)


@wp.func
def solve_newton_system(
    listed: wp.int64, lane: int, lanes: int, size: int, system_out: TreeSystem, search_out: TreeSearch
):
    """Gaussian elimination without pivoting: the matrix is positive definite, and sliding rows change that little."""
    across = wp.min(lanes, LANES_ACROSS)
    down = wp.max(lanes / LANES_ACROSS, 1)
    for k in range(size):
        scale = reciprocal(search_out.factor[k, k])
        for m in range(k + 1 + lane // across, size, down):
            factor = search_out.factor[m, k] * scale
            if factor != wp.float64(0.0):
                for j in range(k + 1 + lane % across, size + 1, across):
                    search_out.factor[m, j] = search_out.factor[m, j] - factor * search_out.factor[k, j]
        synchronize_lanes(lanes)
    for back in range(size):
        k = size - 1 - back
        value = search_out.factor[k, size] * reciprocal(search_out.factor[k, k])
        for m in range(lane, k, lanes):
            search_out.factor[m, size] = search_out.factor[m, size] - search_out.factor[m, k] * value
        if lane == 0:
            system_out.impulse[row_of(listed, k)] = value
        synchronize_lanes(lanes)


@wp.func
def take_newton_step(lane: int, lanes: int, count: int, system_out: TreeSystem, search_out: TreeSearch):
    """Impulses that fit the present states of all contacts, put back into their friction cones."""
    listed, found = list_pressing(count, system_out)
    synchronize_lanes(lanes)
    write_newton_system(listed, lane, lanes, 3 * found, system_out, search_out)
    solve_newton_system(listed, lane, lanes, 3 * found, system_out, search_out)
    project_into_cones(lane, lanes, count, system_out)
    update_velocities(lane, lanes, 3 * count, system_out)


@wp.func
def project_into_cones(lane: int, lanes: int, count: int, system_out: TreeSystem):
    """Put the impulses back into their friction cones, where the guess about a contact was wrong."""
    for c in range(lane, count, lanes):
        n = 3 * c
        normal = wp.max(system_out.impulse[n], wp.float64(0.0))
        u = system_out.impulse[n + 1]
        v = system_out.impulse[n + 2]
        tangential = wp.sqrt(u * u + v * v)
        share = wp.float64(1.0)
        if tangential > system_out.friction[c] * normal:
            share = system_out.friction[c] * normal / tangential
        system_out.impulse[n] = normal
        system_out.impulse[n + 1] = share * u
        system_out.impulse[n + 2] = share * v
    synchronize_lanes(lanes)


@wp.func
def follow_conjugate_direction(
    gradient_before: wp.float64, lane: int, lanes: int, size: int, system_out: TreeSystem, search_out: TreeSearch
):
    """Go on in the conjugate direction after a sweep; returns the square of the gradient [N^2 s^2].

    As :func:`vinesim.kernels.contact.conjugate_gradient.follow_conjugate_direction`.
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
    """Copy the rows of one tree."""
    for row in range(lane, size, lanes):
        target_out[row] = source[row]
    synchronize_lanes(lanes)


@wp.func
def search_on(
    sweeps: int,
    newton_end: int,
    gradient: wp.float64,
    lane: int,
    lanes: int,
    count: int,
    system_out: TreeSystem,
    search_out: TreeSearch,
):
    """What comes between two sweeps; returns the square of the gradient."""
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
def sweep_contacts(lane: int, lanes: int, count: int, tolerance: wp.float64, system_out: TreeSystem):
    """One sweep over all contacts of a tree; returns whether it changed more than ``tolerance`` of the largest impulse."""
    change = wp.float64(0.0)
    largest = wp.float64(MIN_IMPULSE_SCALE)
    for c in range(count):
        normal, moved = relax_contact(c, lane, lanes, 3 * count, system_out)
        change = wp.max(change, moved)
        largest = wp.max(largest, normal)
    return change > tolerance * largest


@wp.func
def solve_tree(
    sweeps: int,
    lane: int,
    lanes: int,
    count: int,
    max_sweeps: int,
    newton_end: int,
    tolerance: wp.float64,
    system_out: TreeSystem,
    search_out: TreeSearch,
):
    """Solve for the impulses of ``count`` contacts of a tree that has had so many ``sweeps``; returns their number then, and
    whether the last one changed more than ``tolerance``.

    As :func:`vinesim.kernels.contact.projected_gauss_seidel.solve_island` does, but with a Newton step after every
    sweep up to ``newton_end``, in which the direction of sliding is linearised. ``lane``: which of the ``lanes`` threads that share the tree this one is.
    """
    gradient = wp.float64(0.0)
    busy = bool(True)
    while busy and sweeps < max_sweeps:
        gradient = search_on(sweeps, newton_end, gradient, lane, lanes, count, system_out, search_out)
        if sweeps >= newton_end:
            copy_rows(lane, lanes, 3 * count, system_out.impulse, search_out.before)
        busy = sweep_contacts(lane, lanes, count, tolerance, system_out)
        sweeps = sweeps + 1
    return sweeps, busy
