"""Contacts of a batch of worlds: the trees of a world touch its robots, its boxes and the static geoms, but not each
other. The contacts of a world form one island.

A GPU uses one thread for each tree, for each world, or for each contact. The arrays of contacts interleave the worlds:
entry ``i`` of a world is at ``i * worlds + world``, so that threads in step read contiguous memory. A *view* of an
array has an offset and a pitch, such that it contains exactly the entries of one world. With views, narrowphase and
rows use the same functions as in a vineyard. Most of the time is spent on reading memory. One kernel finds contacts and
one solves them. Between these two, each body's record is read once outward for the tree, and once inward for each
contact beyond the body.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import to_double, to_single
from vinesim.kernels.contact.forces import store_contact
from vinesim.kernels.contact.friction_law import Surface
from vinesim.kernels.contact.jacobians import write_rows
from vinesim.kernels.contact.structs import (
    Candidates,
    Capsules,
    Contacts,
    Geoms,
    Parameters,
    PlantBodies,
    RigidBodies,
    Rows,
    WarmStart,
)
from vinesim.kernels.plants.prediction import predict_tree
from vinesim.kernels.plants.structs import (
    AppliedForces,
    ArticulationModel,
    BodyState,
    Factors,
    JointState,
    Prediction,
    Scratch,
    SolverParameters,
    WrenchScratch,
)
from vinesim.kernels.worlds.dense_solver import (
    FIRST_SWEEPS,
    MOST_NEWTON_CONTACTS,
    WorldSearch,
    WorldSystem,
    copy_rows,
    end_growth,
    solve_world,
    synchronize_lanes,
    update_velocities,
)
from vinesim.kernels.worlds.narrowphase import WorldContacts
from vinesim.kernels.worlds.row_solver import solve_few_rows, solve_many_rows
from vinesim.kernels.worlds.views import (
    part_of_rigid,
    part_of_search,
    part_of_system,
    view_contacts,
    view_int_from,
    view_rows,
    view_search,
    view_system,
    view_warm_start,
    world_and_entry,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def predict_impacted_trees(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    onset_steps: int,
    # in
    is_impact: wp.array(dtype=wp.bool),
    forces: AppliedForces,
    joints: JointState,
    # out
    tree_phi_out: wp.array(dtype=float),
    tree_euler_steps_out: wp.array(dtype=wp.int32),
    bodies_out: BodyState,
    factors_out: Factors,
    scratch_out: Scratch,
    prediction_out: Prediction,
):
    """One thread per tree.

    Repeat the prediction with phi = 1 (implicitness of the integrator: backward Euler) if one of the tree's contacts is
    an impact and the prediction was made with a smaller phi.
    """
    tree = wp.tid()
    if is_impact[tree] and tree_phi_out[tree] < 1.0:
        tree_euler_steps_out[tree] = wp.max(tree_euler_steps_out[tree], onset_steps)
        tree_phi_out[tree] = 1.0
        predict_tree(p, model, forces, joints, tree, 1.0, bodies_out, factors_out, scratch_out, prediction_out)


@wp.kernel
def write_world_rows(
    # model
    parameters: Parameters,
    pairs: wp.array2d(dtype=Surface),
    capsules: Capsules,
    geoms: Geoms,
    # in
    worlds: int,
    slots: int,
    rigid_bodies: int,
    dofs: int,
    friction_scale: wp.array(dtype=wp.float64),
    bodies: PlantBodies,
    rigid: RigidBodies,
    candidates: Candidates,
    warm_start: WarmStart,
    world_contacts: WorldContacts,
    # out
    contacts_out: Contacts,
    rows_out: Rows,
):
    """One thread per contact slot of a world. Write the three rows of the contact in this slot.

    rigid_bodies, dofs: numbers of MuJoCo bodies and degrees of freedom of a world. friction_scale: [world] factor of the
    coefficients of friction.
    """
    world, c = world_and_entry(wp.tid(), slots)
    if world < worlds and c < world_contacts.count[wp.min(world, worlds - 1)]:
        contacts = view_contacts(contacts_out, world, worlds)
        rows = view_rows(rows_out, world, worlds, dofs)
        tree = world_contacts.tree[c * worlds + world]
        found = contacts.source[c]
        contacts.feature[c] = candidates.feature[tree, found]
        contacts.other[c] = candidates.other[tree, found]
        contacts.body[c] = capsules.body[candidates.feature[tree, found] // 2]
        contacts.other_body[c] = -1
        for dof in range(dofs):
            rows.rigid_jacobian[c, dof] = wp.vec3d()
        write_rows(
            c,
            tree,
            found,
            parameters,
            pairs,
            capsules,
            geoms,
            bodies,
            part_of_rigid(rigid, world, rigid_bodies, dofs),
            candidates,
            view_warm_start(warm_start, world, worlds),
            contacts,
            rows,
        )
        surface = contacts.surface[c]
        surface.friction = surface.friction * friction_scale[world]
        contacts.surface[c] = surface


@wp.func
def wrench_at(pose: wp.transform, point: wp.vec3d, force: wp.vec3d):
    """Returns the force and the moment [N, N m] at a body's origin of a force at a point [m]."""
    lever = point - to_double(wp.transform_get_translation(pose))
    return wp.spatial_vector(to_single(force), to_single(wp.cross(lever, force)))


@wp.func
def apply_loaded_wrenches(
    tree: int,
    count: int,
    dt: float,
    model: ArticulationModel,
    is_branching: wp.array(dtype=wp.bool),
    loaded: wp.array(dtype=wp.int32),
    body_wrench: wp.array(dtype=wp.spatial_vector),
    factors: Factors,
    work_out: WrenchScratch,
    scratch_out: Scratch,
    prediction_out: Prediction,
):
    """Add the effect of wrenches over a step to the prediction of one tree.

    The wrenches act on the tree's ``count`` loaded bodies, which are in ascending order. The result is that of
    :func:`vinesim.kernels.plants.impulse_response.apply_tree_wrenches`, with less memory traffic: sums stay in
    registers from one body to the next, and go through records where the tree branches.
    """
    first = model.tree_first[tree]
    last = loaded[count - 1]
    end = first + model.tree_moving[tree] * model.pitch
    for k in range(first, last + 1, model.pitch):
        if is_branching[k]:
            work_out.subtree_wrench[k] = wp.spatial_vector()
    carried = wp.spatial_vector()
    at = int(count - 1)
    touched = int(last)
    for i in range((last - first) / model.pitch + 1):
        k = last - i * model.pitch
        # all values of a body are read before the first branch, so that a GPU waits for memory once
        parent = model.body_parent[k]
        branches = is_branching[k]
        lever = factors.lever[k]
        D = factors.D[k]
        DH = factors.DH[k]
        DJ = factors.DJ[k]
        wrench = carried
        if branches:
            wrench = wrench + work_out.subtree_wrench[k]
        if touched == k:
            wrench = wrench + body_wrench[k]
            while touched == k:
                at = at - 1
                touched = -1
                if at >= 0:
                    touched = loaded[at]
        moment = wp.spatial_bottom(wrench)
        scratch_out.Du[k] = D * moment
        carried = wp.spatial_vector()
        force = wp.spatial_top(wrench) - wp.transpose(DH) * moment
        if parent < 0:
            work_out.subtree_wrench[k] = wp.spatial_vector(force, wp.vec3())
        else:
            moment = moment - wp.transpose(DJ) * moment + wp.cross(lever, force)
            carried = wp.spatial_vector(force, moment)
            if parent != k - model.pitch:
                work_out.subtree_wrench[parent] = work_out.subtree_wrench[parent] + carried
                carried = wp.spatial_vector()
    a = wp.vec3()
    alpha = wp.vec3()
    for k in range(first, end, model.pitch):
        parent = model.body_parent[k]
        branches = is_branching[k]
        lever = factors.lever[k]
        DH = factors.DH[k]
        DJ = factors.DJ[k]
        Du = scratch_out.Du[k]
        axes = factors.axes[k]
        acceleration = prediction_out.body_acceleration[k]
        rate = prediction_out.joint_qd_free[k]
        if parent < 0:
            a = wp.vec3()
            alpha = wp.vec3()
            if k <= last and model.body_root[k] >= 0:
                a = factors.root_inverse_mass[k] * wp.spatial_top(work_out.subtree_wrench[k])
                prediction_out.joint_xd_free[k] = prediction_out.joint_xd_free[k] + dt * a
        elif parent != k - model.pitch:
            a = wp.spatial_top(work_out.added_acceleration[parent])
            alpha = wp.spatial_bottom(work_out.added_acceleration[parent])
        a = a + wp.cross(alpha, lever)
        relative = -(DJ * alpha + DH * a)
        if k <= last:
            relative = relative + Du
        alpha = alpha + relative
        added = wp.spatial_vector(a, alpha)
        if branches:
            work_out.added_acceleration[k] = added
        prediction_out.body_acceleration[k] = acceleration + added
        prediction_out.joint_qd_free[k] = rate + dt * wp.quat_rotate_inv(axes, relative)


@wp.func
def last_newton_sweep(count: int, max_newton_steps: int, max_newton_contacts: int):
    """Returns the last sweep that is followed by a Newton step; 0 for no Newton steps."""
    return wp.where(count > wp.min(max_newton_contacts, MOST_NEWTON_CONTACTS), 0, max_newton_steps)


@wp.func
def copy_system(lane: int, lanes: int, size: int, source: WorldSystem, target_out: WorldSystem):
    """Copy the contact system of one world, and its present impulses."""
    for row in range(lane, size, lanes):
        for k in range(size):
            target_out.matrix[k, row] = source.matrix[k, row]
        target_out.free[row] = source.free[row]
        target_out.impulse[row] = source.impulse[row]
        target_out.velocity[row] = source.velocity[row]
        target_out.surface[row // 3] = source.surface[row // 3]
    synchronize_lanes(lanes)


@wp.kernel
def begin_worlds(
    # model
    max_sweeps: int,
    max_newton_steps: int,
    max_newton_contacts: int,
    tolerance: wp.float64,
    # in
    worlds: int,
    width: int,
    # out
    world_contacts_out: WorldContacts,
    system_out: WorldSystem,
    search_out: WorldSearch,
):
    """One CPU thread per world. Take two sweeps for the world's impulses, and list the world as busy if it needs more
    sweeps."""
    world = wp.tid()
    count = world_contacts_out.count[world]
    if count > 0:
        system = view_system(system_out, world, worlds, width)
        search = view_search(search_out, world, worlds, width + 1)
        newton_end = last_newton_sweep(count, max_newton_steps, max_newton_contacts)
        update_velocities(0, 1, 3 * count, system)
        limit = wp.min(FIRST_SWEEPS, max_sweeps)
        sweeps, busy = solve_world(0, 0, 1, count, limit, newton_end, tolerance, system, search)
        world_contacts_out.sweeps[world] = sweeps
        if busy and sweeps < max_sweeps:
            world_contacts_out.busy[wp.atomic_add(world_contacts_out.busy_count, 0, 1)] = world
        elif busy:
            end_growth(0, 1, 3 * count, system)


@wp.kernel(cuda_max_registers=128)
def solve_small_worlds(
    # model
    max_sweeps: int,
    max_newton_steps: int,
    max_newton_contacts: int,
    tolerance: wp.float64,
    # in
    worlds: int,
    width: int,
    lanes: int,
    # out
    world_contacts_out: WorldContacts,
    system_out: WorldSystem,
):
    """``lanes`` GPU threads per world, in full warps. Solve for the impulses of the world's contacts.

    Trees with more than 15 contact rows are skipped; see :data:`vinesim.kernels.worlds.row_solver.solve_few_rows`.
    """
    world = wp.tid() // lanes
    lane = wp.tid() % lanes
    count = int(0)
    if world < worlds:
        count = world_contacts_out.count[world]
    system = view_system(system_out, world, worlds, width)
    newton_end = last_newton_sweep(count, max_newton_steps, max_newton_contacts)
    sweeps = solve_few_rows(lane, count, max_sweeps, newton_end, tolerance, system)
    if lane == 0 and count > 0 and sweeps >= 0:
        world_contacts_out.sweeps[world] = sweeps


@wp.kernel
def solve_busy_worlds(
    # model
    max_sweeps: int,
    max_newton_steps: int,
    max_newton_contacts: int,
    tolerance: wp.float64,
    # in
    worlds: int,
    width: int,
    lanes: int,
    groups: int,
    # out
    world_contacts_out: WorldContacts,
    system_out: WorldSystem,
    dense_out: WorldSystem,
    search_out: WorldSearch,
):
    """``lanes`` threads per busy world. Solve for the impulses of the world's contacts. Each of ``groups`` groups of
    threads processes one world after the other.

    A world is *busy* if it needs more threads or sweeps than most worlds. dense_out: scratch, the system of each group's
    world in contiguous memory.
    """
    group = wp.tid() // lanes
    lane = wp.tid() % lanes
    dense = part_of_system(dense_out, group * width)
    search = part_of_search(search_out, group * width)
    for i in range(group, world_contacts_out.busy_count[0], groups):
        world = world_contacts_out.busy[i]
        count = world_contacts_out.count[world]
        system = view_system(system_out, world, worlds, width)
        newton_end = last_newton_sweep(count, max_newton_steps, max_newton_contacts)
        sweeps = int(-1)
        if lanes > 1:
            sweeps = solve_many_rows(lane, count, max_sweeps, newton_end, tolerance, system)
        if sweeps < 0:
            sweeps = world_contacts_out.sweeps[world]
            copy_system(lane, lanes, 3 * count, system, dense)
            if sweeps == 0:
                update_velocities(lane, lanes, 3 * count, dense)
            copy_rows(lane, lanes, 3 * count, dense.impulse, search.before)
            copy_rows(lane, lanes, 3 * count, dense.impulse, search.first)
            sweeps, busy = solve_world(sweeps, lane, lanes, count, max_sweeps, newton_end, tolerance, dense, search)
            if busy:
                end_growth(lane, lanes, 3 * count, dense)
            copy_rows(lane, lanes, 3 * count, dense.impulse, system.impulse)
            copy_rows(lane, lanes, 3 * count, dense.velocity, system.velocity)
        if lane == 0:
            world_contacts_out.sweeps[world] = sweeps
        synchronize_lanes(lanes)


@wp.kernel
def apply_impulses_to_trees(
    # model
    parameters: Parameters,
    model: ArticulationModel,
    is_branching: wp.array(dtype=wp.bool),
    onset_steps: int,
    # in
    worlds: int,
    width: int,
    dofs: int,
    body_q: wp.array(dtype=wp.transform),
    rows_all: Rows,
    system_all: WorldSystem,
    factors: Factors,
    # out
    was_in_contact_out: wp.array(dtype=wp.bool),
    tree_euler_steps_out: wp.array(dtype=wp.int32),
    world_contacts_out: WorldContacts,
    contacts_out: Contacts,
    warm_start_out: WarmStart,
    body_wrench_out: wp.array(dtype=wp.spatial_vector),
    work_out: WrenchScratch,
    scratch_out: Scratch,
    prediction_out: Prediction,
):
    """One thread per tree. Add the effect of the tree's contact impulses to its prediction, and store the warm start
    for the next step.

    was_in_contact_out: [tree] whether the tree was in contact in the last step; updated here. A tree whose contact
    begins takes ``onset_steps`` backward Euler steps, including this step.
    """
    tree = wp.tid()
    world = tree % worlds
    before = view_int_from(world_contacts_out.loaded, world_contacts_out.loaded_first[tree], world, worlds)
    for i in range(world_contacts_out.loaded_count[tree]):
        body_wrench_out[before[i]] = wp.spatial_vector()
    first = world_contacts_out.first[tree]
    count = world_contacts_out.of_tree[tree]
    was_in_contact = was_in_contact_out[tree]
    was_in_contact_out[tree] = count > 0
    if count > 0:
        if not was_in_contact:
            tree_euler_steps_out[tree] = wp.max(tree_euler_steps_out[tree], onset_steps + 1)
        contacts = view_contacts(contacts_out, world, worlds)
        rows = view_rows(rows_all, world, worlds, dofs)
        system = view_system(system_all, world, worlds, width)
        warm_start = view_warm_start(warm_start_out, world, worlds)
        for c in range(first, first + count):
            slip_u = system.velocity[3 * c + 1] - rows.bias[3 * c + 1]
            slip_v = system.velocity[3 * c + 2] - rows.bias[3 * c + 2]
            body = contacts.body[c]
            store_contact(c, slip_u, slip_v, parameters, rows.impulse, contacts, warm_start)
            body_wrench_out[body] = body_wrench_out[body] + wrench_at(
                body_q[body], contacts.point[c], contacts.force[c]
            )
        apply_loaded_wrenches(
            tree,
            count,
            wp.float32(parameters.dt),
            model,
            is_branching,
            view_int_from(contacts_out.body, first, world, worlds),
            body_wrench_out,
            factors,
            work_out,
            scratch_out,
            prediction_out,
        )


@wp.kernel
def end_worlds(
    # in
    worlds: int,
    trees: int,
    contacts: Contacts,
    # out
    world_contacts_out: WorldContacts,
    warm_start_out: WarmStart,
):
    """One thread per world. Note which bodies the contacts load, so that the next step can clear their wrenches."""
    world = wp.tid()
    count = world_contacts_out.count[world]
    warm_start_out.count[world] = count
    for c in range(count):
        world_contacts_out.loaded[c * worlds + world] = contacts.body[c * worlds + world]
    for tree in range(world, trees, worlds):
        world_contacts_out.loaded_first[tree] = world_contacts_out.first[tree]
        world_contacts_out.loaded_count[tree] = world_contacts_out.of_tree[tree]


@wp.kernel
def add_contact_efforts(
    # model
    parameters: Parameters,
    # in
    worlds: int,
    dofs: int,
    rows_all: Rows,
    contacts_all: Contacts,
    moving: wp.array(dtype=wp.int32),
    world_contacts: WorldContacts,
    qacc: wp.array2d(dtype=float),
    # out
    effort_out: wp.array2d(dtype=float),
    likely_out: wp.array2d(dtype=float),
):
    """One thread per degree of freedom of a world's rigid bodies. Write the generalised force of the contacts with
    plants, and the acceleration with this force if all constraints keep their states.

    moving: [1] number of geoms that can move. qacc: [world, dof] m/s^2 or rad/s^2, acceleration without these contacts.
    effort: [world, dof] N or N m. likely: [world, dof] m/s^2 or rad/s^2.
    """
    world = wp.tid() % worlds
    dof = wp.tid() / worlds
    rows = view_rows(rows_all, world, worlds, dofs)
    effort = wp.float64(0.0)
    change = wp.float64(0.0)
    for c in range(world_contacts.count[world]):
        if contacts_all.other[c * worlds + world] < moving[0]:
            entry = rows.rigid_jacobian[c, dof]
            response = rows.rigid_response[c, dof]
            for r in range(3):
                effort = effort - entry[r] * rows.impulse[3 * c + r]
                change = change - response[r] * rows.impulse[3 * c + r]
    effort_out[world, dof] = wp.float32(effort / parameters.dt)
    likely_out[world, dof] = qacc[world, dof] + wp.float32(change / parameters.dt)
