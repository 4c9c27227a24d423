"""The Delassus matrices of the worlds of a batch: velocity changes at a world's contacts by its contact impulses.

Impulses move trees and rigid bodies. The response of a tree is computed from its factored joints, in one pass outward
for the tree and one inward for each contact: see :func:`respond_at_contacts` and :func:`write_delassus`. The response of
the rigid bodies is the inverse of their effective mass: see :func:`invert_effective_mass`.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import to_single
from vinesim.kernels.contact.jacobians import row_columns
from vinesim.kernels.contact.structs import Contacts, Geoms, Rows
from vinesim.kernels.plants.spatial import cross_rows, symmetric
from vinesim.kernels.plants.structs import ArticulationModel, Factors
from vinesim.kernels.worlds.dense_solver import WorldSystem
from vinesim.kernels.worlds.narrowphase import WorldContacts
from vinesim.kernels.worlds.views import view_contacts, view_rows, view_system, view_table, world_and_entry

wp.set_module_options({"enable_backward": False})


@wp.struct
class BodyCompliances:
    """Velocity change of a body by an impulse wrench on the same body, for bodies at which a tree branches [body].

    (a, alpha) = [[P, Q], [Q^T, R]] (force, moment).
    """

    P: wp.array(dtype=wp.mat33)
    """[1/kg] Linear velocity change per force impulse."""
    Q: wp.array(dtype=wp.mat33)
    """[1/(kg m)] Linear velocity change per moment impulse."""
    R: wp.array(dtype=wp.mat33)
    """[1/(kg m^2)] Angular velocity change per moment impulse."""


@wp.struct
class ResponseRows:
    """Velocity changes of a contact's body by unit impulses along the contact's three rows, one column for each row
    [slot * worlds + world]."""

    a: wp.array(dtype=wp.mat33)
    """[1/kg] Linear velocity changes."""
    alpha: wp.array(dtype=wp.mat33)
    """[1/(kg m)] Angular velocity changes."""


@wp.kernel
def respond_at_contacts(
    # model
    model: ArticulationModel,
    is_branching: wp.array(dtype=wp.bool),
    # in
    worlds: int,
    dofs: int,
    factors: Factors,
    contacts_all: Contacts,
    rows_all: Rows,
    world_contacts: WorldContacts,
    # out
    compliances_out: BodyCompliances,
    response_out: ResponseRows,
):
    """One thread per tree. Compute the velocity change of each body by impulses on the same body, from the root to the
    body of the last contact.

    This is the body's operational-space inverse inertia, computed by the recursion from the root (Featherstone 2008,
    section 9.6; Kreutz-Delgado, Jain and Rodriguez 1992). A root is treated as if it had a parent that can be pushed but
    not turned, whose P is ``root_inverse_mass``: 0 for a fixed root. With the parent's (a', alpha'), the lever l and
    a = a' - l x alpha', the body has alpha = (1 - DJ) alpha' - DH a + D moment, where moment acts on the body's joint.
    Contacts are in the order of their bodies. is_branching: [body] whether a body is the parent of a
    body other than the next one.
    """
    tree = wp.tid()
    world = tree % worlds
    at = int(world_contacts.first[tree])
    end = at + world_contacts.of_tree[tree]
    if at == end:
        return
    contacts = view_contacts(contacts_all, world, worlds)
    rows = view_rows(rows_all, world, worlds, dofs)
    P = wp.mat33()
    Q = wp.mat33()
    R = wp.mat33()
    touched = int(contacts.body[at])
    for k in range(model.tree_first[tree], contacts.body[end - 1] + 1, model.pitch):
        # all values of a body are read before the first branch, so that a GPU waits for memory once
        parent = model.body_parent[k]
        branches = is_branching[k]
        lever = factors.lever[k]
        D = factors.D[k]
        DH = factors.DH[k]
        DJ = factors.DJ[k]
        if parent < 0:
            P = factors.root_inverse_mass[k]
            Q = wp.mat33()
            R = wp.mat33()
        elif parent != k - model.pitch:
            P = compliances_out.P[parent]
            Q = compliances_out.Q[parent]
            R = compliances_out.R[parent]
        stay = wp.identity(n=3, dtype=float) - DJ
        arm = -wp.transpose(cross_rows(R, lever))  # [l]x R
        across = wp.transpose(cross_rows(Q, lever))  # -[l]x Q^T
        P = symmetric(P + across + wp.transpose(across) - cross_rows(arm, lever))
        Q = Q - arm
        turn = stay * wp.transpose(Q) - DH * P
        R = symmetric(D + (stay * R - DH * Q) * wp.transpose(stay) - turn * wp.transpose(DH))
        Q = wp.transpose(turn)
        if branches:
            compliances_out.P[k] = P
            compliances_out.Q[k] = Q
            compliances_out.R[k] = R
        while touched == k:
            force = row_columns(at, 0, rows.plant_jacobian)
            moment = row_columns(at, 3, rows.plant_jacobian)
            response_out.a[at * worlds + world] = P * force + Q * moment
            response_out.alpha[at * worlds + world] = turn * force + R * moment
            at = at + 1
            touched = -1
            if at < end:
                touched = contacts.body[at]


@wp.func
def carry_to_parent(k: int, factors: Factors, force: wp.mat33, moment: wp.mat33):
    """Returns the impulses (force, moment about the parent's origin) on the parent by impulses on body k. The part of
    the impulses that turns the joint is not transmitted. Each matrix has one column for each impulse.
    """
    lever = factors.lever[k]
    DH = factors.DH[k]
    DJ = factors.DJ[k]
    passed = force - wp.transpose(DH) * moment
    # [l]x of a matrix is minus the transpose of its transpose's rows crossed with l
    arm = -wp.transpose(cross_rows(wp.transpose(passed), lever))
    return passed, moment - wp.transpose(DJ) * moment + arm


@wp.func
def common_body_response(
    c: int,
    other: int,
    at: int,
    body: int,
    model: ArticulationModel,
    factors: Factors,
    compliances: BodyCompliances,
    jacobian: wp.array2d(dtype=wp.float64),
    force: wp.mat33,
    moment: wp.mat33,
):
    """Returns the velocity changes [3, 3] along the rows of contact ``other`` by three impulses ``force``, ``moment``
    on body ``at``, which may be on another branch of the tree than the contact.

    ``body``: body of contact ``other``. Each column of ``force``, ``moment`` and the result belongs to one impulse.
    """
    force_other = row_columns(other, 0, jacobian)
    moment_other = row_columns(other, 3, jacobian)
    here = int(at)
    there = int(body)
    while here != there and here >= 0 and there >= 0:
        if here > there:
            force, moment = carry_to_parent(here, factors, force, moment)
            here = model.body_parent[here]
        else:
            force_other, moment_other = carry_to_parent(there, factors, force_other, moment_other)
            there = model.body_parent[there]
    block = wp.mat33()
    if here >= 0 and there >= 0:
        a = compliances.P[here] * force + compliances.Q[here] * moment
        alpha = wp.transpose(compliances.Q[here]) * force + compliances.R[here] * moment
        block = wp.transpose(force_other) * a + wp.transpose(moment_other) * alpha
    return block


@wp.func
def write_rigid_response(c: int, dofs: int, inverse: wp.array2d(dtype=wp.float64), rows_out: Rows):
    """Write the velocity changes of a world's rigid bodies by unit impulses along the rows of contact ``c``.

    ``inverse`` [dof, dof]: inverse of the effective mass. The signs are those of impulses on the rigid bodies.
    """
    for dof in range(dofs):
        change = wp.vec3d()
        for k in range(dofs):
            change = change + inverse[dof, k] * rows_out.rigid_jacobian[c, k]
        rows_out.rigid_response[c, dof] = change


@wp.kernel
def write_delassus(
    # model
    model: ArticulationModel,
    geoms: Geoms,
    # in
    worlds: int,
    width: int,
    dofs: int,
    factors: Factors,
    world_contacts: WorldContacts,
    contacts_all: Contacts,
    compliances: BodyCompliances,
    response: ResponseRows,
    rigid_inverse: wp.array2d(dtype=wp.float64),
    # out
    rows_out: Rows,
    system_out: WorldSystem,
):
    """One thread per contact slot of a world. Write the contact in this slot into the world's system, and the entries
    of the Delassus matrix for the contact's impulses.

    The entries are velocity changes along the rows of all contacts up to this one. The contact's impulses are
    propagated inward in its tree. When they reach a body with another contact, the entry follows from the response of
    that contact, because the matrix is symmetric. Contacts of different trees act on each other through rigid bodies
    only.
    """
    world, c = world_and_entry(wp.tid(), width / 3)
    if world >= worlds or c >= world_contacts.count[wp.min(world, worlds - 1)]:
        return
    contacts = view_contacts(contacts_all, world, worlds)
    rows = view_rows(rows_out, world, worlds, dofs)
    system = view_system(system_out, world, worlds, width)
    n = 3 * c
    velocity = wp.vec3d(rows.velocity_free[n], rows.velocity_free[n + 1], rows.velocity_free[n + 2])
    bias = wp.vec3d(rows.bias[n], rows.bias[n + 1], rows.bias[n + 2])
    force = row_columns(c, 0, rows.plant_jacobian)
    moment = row_columns(c, 3, rows.plant_jacobian)
    k = int(contacts.body[c])
    first = world_contacts.first[world_contacts.tree[c * worlds + world]]
    moves = contacts.other[c] < geoms.count[0]
    if moves:
        write_rigid_response(c, dofs, view_table(rigid_inverse, world, worlds, dofs), rows)
    for r in range(3):
        system.free[n + r] = velocity[r] + bias[r]
    for back in range(c + 1):
        other = c - back
        block = wp.mat33()
        if other >= first:
            body = contacts.body[other]
            while k > body:
                parent = model.body_parent[k]
                force, moment = carry_to_parent(k, factors, force, moment)
                k = parent
            if k == body:
                slot = other * worlds + world
                block = wp.transpose(response.a[slot]) * force + wp.transpose(response.alpha[slot]) * moment
            elif k >= 0:
                block = common_body_response(
                    c, other, k, body, model, factors, compliances, rows.plant_jacobian, force, moment
                )
        if moves and contacts.other[other] < geoms.count[0]:
            for dof in range(dofs):
                along = rows.rigid_jacobian[other, dof]
                change = rows.rigid_response[c, dof]
                block = block + wp.outer(to_single(along), to_single(change))
        if other == c:
            block = symmetric(block)
        for r in range(3):
            for j in range(3):
                system.matrix[3 * other + r, 3 * c + j] = block[r, j]
                system.matrix[3 * c + j, 3 * other + r] = block[r, j]
