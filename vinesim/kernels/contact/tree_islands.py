"""Contacts of many trees that touch static geoms and not each other: each tree is an island of its own.

A GPU uses one thread for each tree, or one for each contact. The arrays of contacts interleave the trees: entry ``i``
of a tree is at ``i * trees + tree``, so that threads in step read contiguous memory. A *view* of an array has an offset
and a pitch, such that it contains exactly the entries of one tree. With views, narrowphase and rows use the same
functions as in a vineyard. Most of the time is spent on reading memory. One kernel finds contacts and one solves them.
Between these two, each body's record is read once outward for the tree, and once inward for each contact beyond the
body.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import to_double, to_single
from vinesim.kernels.contact.forces import store_contact
from vinesim.kernels.contact.friction_law import Surface
from vinesim.kernels.contact.jacobians import write_rows
from vinesim.kernels.contact.row_solver import solve_few_rows, solve_many_rows
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
from vinesim.kernels.contact.tree_narrowphase import TreeContacts
from vinesim.kernels.contact.tree_solver import (
    FIRST_SWEEPS,
    MOST_NEWTON_CONTACTS,
    TreeSearch,
    TreeSystem,
    copy_rows,
    solve_tree,
    synchronize_lanes,
    update_velocities,
)
from vinesim.kernels.contact.tree_views import (
    part_of_search,
    part_of_system,
    tree_and_entry,
    view_contacts,
    view_int,
    view_rows,
    view_search,
    view_system,
    view_warm_start,
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
def write_tree_rows(
    # model
    parameters: Parameters,
    pairs: wp.array2d(dtype=Surface),
    capsules: Capsules,
    geoms: Geoms,
    # in
    trees: int,
    slots: int,
    bodies: PlantBodies,
    rigid: RigidBodies,
    candidates: Candidates,
    warm_start: WarmStart,
    tree_contacts: TreeContacts,
    # out
    contacts_out: Contacts,
    rows_out: Rows,
):
    """One thread per contact slot of a tree. Write the three rows of the contact in this slot."""
    tree, c = tree_and_entry(wp.tid(), slots)
    if tree < trees and c < tree_contacts.count[wp.min(tree, trees - 1)]:
        contacts = view_contacts(contacts_out, tree, trees)
        found = contacts.source[c]
        contacts.feature[c] = candidates.feature[tree, found]
        contacts.other[c] = candidates.other[tree, found]
        contacts.body[c] = capsules.body[candidates.feature[tree, found] // 2]
        contacts.other_body[c] = -1
        write_rows(
            c,
            tree,
            found,
            parameters,
            pairs,
            capsules,
            geoms,
            bodies,
            rigid,
            candidates,
            view_warm_start(warm_start, tree, trees),
            contacts,
            view_rows(rows_out, tree, trees),
        )


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
    """Add the effect of wrenches over a step to the prediction of one tree with a fixed root.

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
        if parent >= 0:
            force = wp.spatial_top(wrench) - wp.transpose(DH) * moment
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
def copy_system(lane: int, lanes: int, size: int, source: TreeSystem, target_out: TreeSystem):
    """Copy the contact system of one tree, and its present impulses."""
    for row in range(lane, size, lanes):
        for k in range(size):
            target_out.matrix[k, row] = source.matrix[k, row]
        target_out.free[row] = source.free[row]
        target_out.impulse[row] = source.impulse[row]
        target_out.velocity[row] = source.velocity[row]
        target_out.surface[row // 3] = source.surface[row // 3]
    synchronize_lanes(lanes)


@wp.kernel
def begin_trees(
    # model
    max_sweeps: int,
    max_newton_steps: int,
    max_newton_contacts: int,
    tolerance: wp.float64,
    # in
    trees: int,
    width: int,
    # out
    tree_contacts_out: TreeContacts,
    system_out: TreeSystem,
    search_out: TreeSearch,
):
    """One CPU thread per tree. Take two sweeps for the tree's impulses, and list the tree as busy if it needs more
    sweeps."""
    tree = wp.tid()
    count = tree_contacts_out.count[tree]
    if count > 0:
        system = view_system(system_out, tree, trees, width)
        search = view_search(search_out, tree, trees, width + 1)
        newton_end = last_newton_sweep(count, max_newton_steps, max_newton_contacts)
        update_velocities(0, 1, 3 * count, system)
        limit = wp.min(FIRST_SWEEPS, max_sweeps)
        sweeps, busy = solve_tree(0, 0, 1, count, limit, newton_end, tolerance, system, search)
        tree_contacts_out.sweeps[tree] = sweeps
        if busy and sweeps < max_sweeps:
            tree_contacts_out.busy[wp.atomic_add(tree_contacts_out.busy_count, 0, 1)] = tree


@wp.kernel(cuda_max_registers=128)
def solve_small_trees(
    # model
    max_sweeps: int,
    max_newton_steps: int,
    max_newton_contacts: int,
    tolerance: wp.float64,
    # in
    trees: int,
    width: int,
    lanes: int,
    # out
    tree_contacts_out: TreeContacts,
    system_out: TreeSystem,
):
    """``lanes`` GPU threads per tree, in full warps. Solve for the impulses of the tree's contacts.

    Trees with more than 15 contact rows are skipped; see :data:`vinesim.kernels.contact.row_solver.solve_few_rows`.
    """
    tree = wp.tid() // lanes
    lane = wp.tid() % lanes
    count = int(0)
    if tree < trees:
        count = tree_contacts_out.count[tree]
    system = view_system(system_out, tree, trees, width)
    newton_end = last_newton_sweep(count, max_newton_steps, max_newton_contacts)
    sweeps = solve_few_rows(lane, count, max_sweeps, newton_end, tolerance, system)
    if lane == 0 and count > 0 and sweeps >= 0:
        tree_contacts_out.sweeps[tree] = sweeps


@wp.kernel
def solve_busy_trees(
    # model
    max_sweeps: int,
    max_newton_steps: int,
    max_newton_contacts: int,
    tolerance: wp.float64,
    # in
    trees: int,
    width: int,
    lanes: int,
    groups: int,
    # out
    tree_contacts_out: TreeContacts,
    system_out: TreeSystem,
    dense_out: TreeSystem,
    search_out: TreeSearch,
):
    """``lanes`` threads per busy tree. Solve for the impulses of the tree's contacts. Each of ``groups`` groups of
    threads processes one tree after the other.

    A tree is *busy* if it needs more threads or sweeps than most trees. dense_out: scratch, the system of each group's
    tree in contiguous memory.
    """
    group = wp.tid() // lanes
    lane = wp.tid() % lanes
    dense = part_of_system(dense_out, group * width)
    search = part_of_search(search_out, group * width)
    for i in range(group, tree_contacts_out.busy_count[0], groups):
        tree = tree_contacts_out.busy[i]
        count = tree_contacts_out.count[tree]
        system = view_system(system_out, tree, trees, width)
        newton_end = last_newton_sweep(count, max_newton_steps, max_newton_contacts)
        sweeps = int(-1)
        if lanes > 1:
            sweeps = solve_many_rows(lane, count, max_sweeps, newton_end, tolerance, system)
        if sweeps < 0:
            sweeps = tree_contacts_out.sweeps[tree]
            copy_system(lane, lanes, 3 * count, system, dense)
            if sweeps == 0:
                update_velocities(lane, lanes, 3 * count, dense)
            copy_rows(lane, lanes, 3 * count, dense.impulse, search.before)
            copy_rows(lane, lanes, 3 * count, dense.impulse, search.first)
            sweeps, _busy = solve_tree(sweeps, lane, lanes, count, max_sweeps, newton_end, tolerance, dense, search)
            copy_rows(lane, lanes, 3 * count, dense.impulse, system.impulse)
            copy_rows(lane, lanes, 3 * count, dense.velocity, system.velocity)
        if lane == 0:
            tree_contacts_out.sweeps[tree] = sweeps
        synchronize_lanes(lanes)


@wp.kernel
def apply_tree_impulses(
    # model
    parameters: Parameters,
    model: ArticulationModel,
    is_branching: wp.array(dtype=wp.bool),
    onset_steps: int,
    # in
    trees: int,
    width: int,
    body_q: wp.array(dtype=wp.transform),
    rows_all: Rows,
    system_all: TreeSystem,
    factors: Factors,
    # out
    was_in_contact_out: wp.array(dtype=wp.bool),
    tree_euler_steps_out: wp.array(dtype=wp.int32),
    tree_contacts_out: TreeContacts,
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
    loaded = view_int(tree_contacts_out.loaded, tree, trees)
    for i in range(tree_contacts_out.loaded_count[tree]):
        body_wrench_out[loaded[i]] = wp.spatial_vector()
    count = tree_contacts_out.count[tree]
    tree_contacts_out.loaded_count[tree] = count
    warm_start_out.count[tree] = count
    was_in_contact = was_in_contact_out[tree]
    was_in_contact_out[tree] = count > 0
    if count == 0:
        return
    if not was_in_contact:
        tree_euler_steps_out[tree] = wp.max(tree_euler_steps_out[tree], onset_steps + 1)
    contacts = view_contacts(contacts_out, tree, trees)
    rows = view_rows(rows_all, tree, trees)
    system = view_system(system_all, tree, trees, width)
    warm_start = view_warm_start(warm_start_out, tree, trees)
    for c in range(count):
        slip_u = system.velocity[3 * c + 1] - rows.bias[3 * c + 1]
        slip_v = system.velocity[3 * c + 2] - rows.bias[3 * c + 2]
        body = contacts.body[c]
        point = contacts.point[c]
        pose = body_q[body]
        store_contact(c, slip_u, slip_v, parameters, rows.impulse, contacts, warm_start)
        loaded[c] = body
        body_wrench_out[body] = body_wrench_out[body] + wrench_at(pose, point, contacts.force[c])
    apply_loaded_wrenches(
        tree,
        count,
        wp.float32(parameters.dt),
        model,
        is_branching,
        loaded,
        body_wrench_out,
        factors,
        work_out,
        scratch_out,
        prediction_out,
    )
