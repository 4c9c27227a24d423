"""The contacts of an island as a dense system, whose values are gathered once for each solve.

The velocities along the rows are v = free + B x + J_r w, with the impulses x. B x is the velocity change of plants; B
has a matrix for each block of contacts that plants couple. w = G x, with G = H^-1 J_r^T, are the changes of the
velocities of rigid bodies, which couple the blocks. J_r and G have columns for the degrees of freedom of this island
only, and values that do not change from sweep to sweep are computed once.

Contacts are in the order of the list of islands, so that a block is contiguous in memory. Its rows are padded with
zeros to a multiple of eight, so that native loops process eight rows at a time without a remainder. No multiply-add is
fused, so the results do not depend on the vector width of a CPU.
"""

import warp as wp

from vinesim.kernels.contact.friction_law import Steps, Surface, steps_of
from vinesim.kernels.contact.structs import Contacts, Geoms, Islands, Rows

wp.set_module_options({"enable_backward": False})

EIGHT = "typedef double Eight __attribute__((vector_size(64), aligned(8)));"
"""Native code: a vector type of eight numbers. CPUs with narrower vectors process it in two or four parts."""


@wp.struct
class IslandSystem:
    """Dense systems of all islands of contacts.

    Dimensions: [place] index in ``Islands.contact``, the list of contacts sorted by island; [row] row of the padded
    blocks; [entry] index into matrices that are stored one after the other; [place of dof] index in ``Islands.dof``.
    """

    surface: wp.array(dtype=Surface)
    """[place] Contact properties of the pair of materials."""
    steps: wp.array(dtype=Steps)
    """[place] Step sizes of the contact's Gauss-Seidel step."""
    free: wp.array(dtype=wp.float64)
    """[row] Velocity without impulses, bias included, m/s."""
    impulse: wp.array(dtype=wp.float64)
    """[row] Present impulse along the row, N s."""
    impulse_first: wp.array(dtype=wp.float64)
    """[row] Impulse before the Newton steps that no sweep has tested yet, N s."""
    impulse_before: wp.array(dtype=wp.float64)
    """[row] Impulse before the last sweep, N s."""
    direction: wp.array(dtype=wp.float64)
    """[row] Search direction, N s."""
    jacobian: wp.array(dtype=wp.vec3d)
    """[entry] J_r, contact by contact: its three rows for each degree of freedom of the island."""
    response: wp.array(dtype=wp.vec3d)
    """[entry] G^T, in the order of ``jacobian``."""
    velocity: wp.array(dtype=wp.float64)
    """[place of dof] w: change of the velocities of rigid bodies by the impulses."""
    rigid_force: wp.array(dtype=wp.float64)
    """[dof of MuJoCo] Generalised force of all contacts on rigid bodies, N or N m; 0 for bodies without contact."""
    pressed: wp.array(dtype=wp.int32)
    """[place] Closed contacts of each block (contacts with a positive normal impulse), by their index in the block. The
    list of a block begins at the block's first place.
    """
    matrix: wp.array(dtype=wp.float64)
    """[entry] Linear systems of a Newton step, one for each block of an island. A block's system begins with its
    right-hand sides.
    """
    solution: wp.array(dtype=wp.vec3d)
    """[entry] Solutions of the linear systems in ``matrix``, contact by contact: impulses for w = 0, then their change
    with each entry of w.
    """
    rigid_matrix: wp.array2d(dtype=wp.float64)
    """[place of dof, 1 + dof of the island] System for w that remains after elimination; right-hand side first."""


@wp.func_native(
    EIGHT
    + """
    const double* const entry = matrix.data + at;
    const double* const x = impulse.data + row;
    Eight n = {}, u = {}, v = {};
    for (int i = 0; i < pitch; i += 8) {
        const Eight given = *(const Eight*)(x + i);
        n += *(const Eight*)(entry + i) * given;
        u += *(const Eight*)(entry + pitch + i) * given;
        v += *(const Eight*)(entry + 2 * pitch + i) * given;
    }
    const auto sum = [](Eight s) { return ((s[0] + s[4]) + (s[2] + s[6])) + ((s[1] + s[5]) + (s[3] + s[7])); };
    return wp::vec3d(sum(n), sum(u), sum(v));
"""
)
def block_velocity(
    matrix: wp.array(dtype=wp.float64), at: int, pitch: int, impulse: wp.array(dtype=wp.float64), row: int
) -> wp.vec3d:
    """Returns the velocities [m/s] along three rows by the impulses of their block.

    The matrix entries of the rows begin at ``at``, the impulses at ``row``.
    """
    ...


@wp.func_native("""
    for (int i = 0; i < count; ++i) value += jacobian.data[at + i] * velocity.data[first + i];
    return value;
""")
def add_rigid_velocity(
    value: wp.vec3d,
    jacobian: wp.array(dtype=wp.vec3d),
    at: int,
    velocity: wp.array(dtype=wp.float64),
    first: int,
    count: int,
) -> wp.vec3d:
    """Returns ``value`` [m/s] plus the velocities along three rows due to the velocities of ``count`` degrees of
    freedom."""
    ...


@wp.func_native("""
    for (int i = 0; i < count; ++i) velocity.data[first + i] += dot(response.data[at + i], impulse);
""")
def push_rigid_bodies(
    impulse: wp.vec3d,
    response: wp.array(dtype=wp.vec3d),
    at: int,
    velocity: wp.array(dtype=wp.float64),
    first: int,
    count: int,
):
    """Add to the velocities of ``count`` degrees of freedom the changes by impulses [N s] along three rows."""
    ...


@wp.func
def three(row: int, values: wp.array(dtype=wp.float64)):
    """Returns three consecutive numbers, the first at ``row``."""
    return wp.vec3d(values[row], values[row + 1], values[row + 2])


@wp.func
def set_three(row: int, value: wp.vec3d, values_out: wp.array(dtype=wp.float64)):
    """Write three consecutive numbers, the first at ``row``."""
    values_out[row] = value[0]
    values_out[row + 1] = value[1]
    values_out[row + 2] = value[2]


@wp.func
def block_pitch(block: int, islands: Islands):
    """Returns the number of rows of a block, padding included. This is the pitch of its matrix."""
    return islands.row_start[block + 1] - islands.row_start[block]


@wp.func
def contact_row(place: int, block: int, islands: Islands):
    """Returns the first of the three rows of the contact at ``place`` in the list of islands' contacts."""
    return islands.row_start[block] + 3 * (place - islands.block_start[block])


@wp.func
def island_dofs(island: int, islands: Islands):
    """Returns the number of degrees of freedom of the rigid bodies in an island."""
    return islands.first_dof[island + 1] - islands.first_dof[island]


@wp.func
def rigid_entry(place: int, island: int, islands: Islands):
    """Returns the index of the first entry of a contact's rigid Jacobian. ``place``: index in the list of islands'
    contacts.
    """
    return islands.rigid_start[island] + (place - islands.start[island]) * island_dofs(island, islands)


@wp.func
def solution_entry(place: int, island: int, islands: Islands):
    """Returns the index of the first entry of a contact's solution, which has one column more than its rigid
    Jacobian."""
    return rigid_entry(place, island, islands) + place


@wp.func
def contact_velocity(
    place: int, block: int, island: int, islands: Islands, matrix: wp.array(dtype=wp.float64), system: IslandSystem
):
    """Returns the velocities [m/s] along the rows of a contact by all impulses of its island."""
    pitch = block_pitch(block, islands)
    k = 3 * (place - islands.block_start[block])
    start = islands.row_start[block]
    value = block_velocity(matrix, islands.matrix_start[block] + k * pitch, pitch, system.impulse, start)
    return add_rigid_velocity(
        value,
        system.jacobian,
        rigid_entry(place, island, islands),
        system.velocity,
        islands.first_dof[island],
        island_dofs(island, islands),
    )


@wp.func
def contact_residual(
    place: int, block: int, island: int, islands: Islands, matrix: wp.array(dtype=wp.float64), system: IslandSystem
):
    """Returns the residual velocities [m/s] along the rows of a contact. In a solution they are 0 along rows that press
    or stick.

    The residual is the velocity by all impulses plus the velocity without impulses, the bias and the compliance term.
    """
    row = contact_row(place, block, islands)
    value = three(row, system.free) + system.surface[place].compliance * three(row, system.impulse)
    return value + contact_velocity(place, block, island, islands, matrix, system)


@wp.func
def gather_rigid_rows(
    c: int,
    place: int,
    island: int,
    geoms: Geoms,
    contacts: Contacts,
    islands: Islands,
    rows: Rows,
    system_out: IslandSystem,
):
    """Copy the rigid Jacobian J_r and the response G^T of contact ``c`` into the system of its island. Both are zero
    unless the contact's other side is a rigid body that can move.
    """
    moves = bool(False)
    if contacts.other[c] >= 0:
        moves = geoms.dof[contacts.other[c]] >= 0
    at = rigid_entry(place, island, islands)
    first = islands.first_dof[island]
    for k in range(island_dofs(island, islands)):
        jacobian = wp.vec3d()
        response = wp.vec3d()
        if moves:
            jacobian = rows.rigid_jacobian[c, islands.dof[first + k]]
            response = rows.rigid_response[c, islands.dof[first + k]]
        system_out.jacobian[at + k] = jacobian
        system_out.response[at + k] = response


@wp.func
def gather_contact(
    c: int,
    place: int,
    block: int,
    island: int,
    contacts: Contacts,
    islands: Islands,
    rows: Rows,
    system_out: IslandSystem,
):
    """Copy the values of contact ``c`` into the system of its island, and compute the contact's Gauss-Seidel step sizes
    from its response to its own impulses.

    Call :func:`gather_rigid_rows` for the contact before.
    """
    k = 3 * (place - islands.block_start[block])
    row = islands.row_start[block] + k
    pitch = block_pitch(block, islands)
    entry = islands.matrix_start[block] + k * pitch + k
    surface = contacts.surface[c]
    own = wp.mat33d()
    for axis in range(3):
        for other in range(3):
            own[axis, other] = rows.delassus[entry + axis * pitch + other]
        own[axis, axis] = own[axis, axis] + surface.compliance
    at = rigid_entry(place, island, islands)
    for i in range(island_dofs(island, islands)):
        own = own + wp.outer(system_out.jacobian[at + i], system_out.response[at + i])
    system_out.surface[place] = surface
    system_out.steps[place] = steps_of(own)
    set_three(row, three(3 * c, rows.velocity_free) + three(3 * c, rows.bias), system_out.free)
    set_three(row, three(3 * c, rows.impulse), system_out.impulse)


@wp.func
def update_rigid_velocity(island: int, islands: Islands, system_out: IslandSystem):
    """Recompute the velocity changes of an island's rigid bodies from all its impulses."""
    first = islands.first_dof[island]
    dofs = island_dofs(island, islands)
    for k in range(dofs):
        system_out.velocity[first + k] = wp.float64(0.0)
    if dofs > 0:
        for block in range(islands.first_block[island], islands.first_block[island + 1]):
            for place in range(islands.block_start[block], islands.block_start[block + 1]):
                row = contact_row(place, block, islands)
                push_rigid_bodies(
                    three(row, system_out.impulse),
                    system_out.response,
                    rigid_entry(place, island, islands),
                    system_out.velocity,
                    first,
                    dofs,
                )


@wp.func
def gather_island(
    island: int, geoms: Geoms, contacts: Contacts, islands: Islands, rows: Rows, system_out: IslandSystem
):
    """Copy the values of all contacts of an island into the island's dense system. The impulses in ``rows`` are the
    start of the solve.
    """
    for block in range(islands.first_block[island], islands.first_block[island + 1]):
        for place in range(islands.block_start[block], islands.block_start[block + 1]):
            c = islands.contact[place]
            gather_rigid_rows(c, place, island, geoms, contacts, islands, rows, system_out)
            gather_contact(c, place, block, island, contacts, islands, rows, system_out)
        used = islands.row_start[block] + 3 * (islands.block_start[block + 1] - islands.block_start[block])
        for row in range(used, islands.row_start[block + 1]):
            system_out.impulse[row] = wp.float64(0.0)
    update_rigid_velocity(island, islands, system_out)


@wp.func_native("""
    for (int i = 0; i < count; ++i) force.data[dof.data[first + i]] -= dot(jacobian.data[at + i], impulse) / dt;
""")
def add_rigid_force(
    impulse: wp.vec3d,
    dt: wp.float64,
    jacobian: wp.array(dtype=wp.vec3d),
    at: int,
    dof: wp.array(dtype=wp.int32),
    first: int,
    count: int,
    force: wp.array(dtype=wp.float64),
):
    """Add the force of impulses [N s] along three rows on ``count`` degrees of freedom, listed from ``first`` on."""
    ...


@wp.func
def scatter_impulses(island: int, dt: wp.float64, islands: Islands, system_out: IslandSystem, rows_out: Rows):
    """Write the impulses of an island back to the rows of its contacts, and their force on rigid bodies."""
    first = islands.first_dof[island]
    dofs = island_dofs(island, islands)
    for k in range(dofs):
        dof = islands.dof[first + k]
        system_out.rigid_force[dof] = wp.float64(0.0)
    for block in range(islands.first_block[island], islands.first_block[island + 1]):
        for place in range(islands.block_start[block], islands.block_start[block + 1]):
            x = three(contact_row(place, block, islands), system_out.impulse)
            set_three(3 * islands.contact[place], x, rows_out.impulse)
            at = rigid_entry(place, island, islands)
            add_rigid_force(x, dt, system_out.jacobian, at, islands.dof, first, dofs, system_out.rigid_force)
