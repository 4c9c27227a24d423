"""Contacts of many trees that touch rigid geoms but not each other: the contacts of each tree are an island of one block.

On a GPU a tree is a thread. The arrays of contacts hold all trees side by side: entry ``i`` of a tree lies at
``i * trees + tree``, so that threads in step read one stretch of memory. A *view* of an array has an offset and a pitch
that show one tree all of its own entries and nothing else: with views, a tree is solved by the functions that solve an
island of a vineyard.
"""

import warp as wp

from vinesim.kernels.articulation.impulse_response import apply_tree_wrenches
from vinesim.kernels.articulation.prediction import predict_tree
from vinesim.kernels.articulation.structs import (
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
from vinesim.kernels.contact.broadphase import aabbs_disjoint, is_collidable, sweep_capsule
from vinesim.kernels.contact.forces import store_contact
from vinesim.kernels.contact.jacobians import write_rows
from vinesim.kernels.contact.narrowphase_rigid import add_pair
from vinesim.kernels.contact.projected_gauss_seidel import solve_island
from vinesim.kernels.contact.structs import (
    AABB_BLOCK,
    Aabbs,
    Candidates,
    Capsules,
    CapsuleStates,
    Contacts,
    Geoms,
    GeomStates,
    Hulls,
    Islands,
    MaterialPairs,
    Parameters,
    PlantBodies,
    RigidBodies,
    Rows,
    SolverScratch,
    Trees,
    WarmStart,
)
from vinesim.kernels.contact.tree_views import (
    view_candidates,
    view_contacts,
    view_int,
    view_islands,
    view_rows,
    view_scratch,
    view_warm_start,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class TreeContacts:
    """What is kept of each tree's contacts [tree] from step to step."""

    count: wp.array(dtype=wp.int32)
    """of this step."""
    found: wp.array(dtype=wp.int32)
    """[capsule of the tree * trees + tree] contacts of each capsule in this step."""
    hits: wp.array(dtype=wp.bool)
    """[capsule of the tree * trees + tree] whether one of them is an impact."""
    is_impact: wp.array(dtype=wp.bool)
    """[tree]"""
    dropped: wp.array(dtype=wp.int32)
    """left out since the start, for want of room."""
    loaded_count: wp.array(dtype=wp.int32)
    """bodies that the wrenches of the last contacts act on."""
    loaded: wp.array(dtype=wp.int32)
    """[i * trees + tree] these bodies."""


@wp.struct
class ResponseRows:
    """Velocities by unit impulses along the three rows of a contact [slot * bodies + body]."""

    a: wp.array(dtype=wp.mat33)
    """[1/kg] linear."""
    alpha: wp.array(dtype=wp.mat33)
    """[1/(kg m)] angular."""


@wp.kernel
def find_capsule_contacts(
    # model
    parameters: Parameters,
    capsules: Capsules,
    geoms: Geoms,
    # in
    trees: int,
    slots: int,
    tree_states: Trees,
    bodies: PlantBodies,
    rigid: RigidBodies,
    hulls: Hulls,
    geom_states: GeomStates,
    static_blocks: Aabbs,
    # out
    capsule_states_out: CapsuleStates,
    tree_contacts_out: TreeContacts,
    candidates_out: Candidates,
):
    """One thread per capsule of a tree: its contacts with static geoms, in the order of (geom, end).

    Capsule i of a tree is ``i * trees + tree``, and ``slots`` slots of the candidates are its own; a capsule without a
    body is none.
    """
    s = wp.tid()
    tree = s % trees
    count = int(0)
    is_impact = bool(False)
    if capsules.body[s] >= 0 and is_collidable(
        capsules.level[s], tree_states.is_fine[tree], capsules.bunch[s], tree_states.bunch_attached
    ):
        start, end, speed, low, high = sweep_capsule(s, wp.float32(parameters.dt), capsules, bodies)
        for block in range(static_blocks.low.shape[0]):
            if not aabbs_disjoint(low, high, static_blocks.low[block], static_blocks.high[block]):
                capsule_states_out.start[s] = start
                capsule_states_out.end[s] = end
                capsule_states_out.speed[s] = speed
                capsule_states_out.low[s] = low
                capsule_states_out.high[s] = high
                for g in range(block * AABB_BLOCK, wp.min((block + 1) * AABB_BLOCK, geoms.count[1])):
                    count, hits = add_pair(
                        tree, count, s, g, parameters, capsules, geoms, bodies, capsule_states_out, rigid, hulls,
                        geom_states, view_candidates(candidates_out, (s // trees) * slots, slots),
                    )  # fmt: skip
                    is_impact = is_impact or hits
    tree_contacts_out.found[s] = count
    tree_contacts_out.hits[s] = is_impact


@wp.kernel
def list_tree_contacts(
    # in
    trees: int,
    capsule_slots: int,
    slots: int,
    # out
    tree_contacts_out: TreeContacts,
    contacts_out: Contacts,
    islands_out: Islands,
):
    """One thread per tree: its contacts in the order of its capsules; what exceeds the slots is only counted."""
    tree = wp.tid()
    count = int(0)
    dropped = int(0)
    is_impact = bool(False)
    for i in range(tree_contacts_out.found.shape[0] / trees):
        s = i * trees + tree
        found = tree_contacts_out.found[s]
        if found > 0:
            is_impact = is_impact or tree_contacts_out.hits[s]
            for k in range(found):
                if k < capsule_slots and count < slots:
                    contacts_out.source[count * trees + tree] = i * capsule_slots + k
                    count = count + 1
                else:
                    dropped = dropped + 1
    tree_contacts_out.is_impact[tree] = is_impact
    tree_contacts_out.count[tree] = count
    tree_contacts_out.dropped[tree] += dropped
    islands_out.start[tree] = 0
    islands_out.start[trees + tree] = count


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
    """One thread predicts one tree anew with phi = 1 if it is about to suffer an impact and was not predicted so."""
    tree = wp.tid()
    if is_impact[tree] and tree_phi_out[tree] < 1.0:
        tree_euler_steps_out[tree] = wp.max(tree_euler_steps_out[tree], onset_steps)
        tree_phi_out[tree] = 1.0
        predict_tree(p, model, forces, joints, tree, 1.0, bodies_out, factors_out, scratch_out, prediction_out)


@wp.kernel
def write_tree_rows(
    # model
    parameters: Parameters,
    pairs: MaterialPairs,
    capsules: Capsules,
    geoms: Geoms,
    # in
    trees: int,
    bodies: PlantBodies,
    rigid: RigidBodies,
    candidates: Candidates,
    warm_start: WarmStart,
    tree_contacts: TreeContacts,
    # out
    contacts_out: Contacts,
    rows_out: Rows,
):
    """One thread per slot of a tree: the rows of its contact."""
    tree = wp.tid() % trees
    c = wp.tid() // trees
    if c < tree_contacts.count[tree]:
        contacts = view_contacts(contacts_out, tree, trees)
        slot = contacts.source[c]
        contacts.feature[c] = candidates.feature[tree, slot]
        contacts.other[c] = candidates.other[tree, slot]
        contacts.body[c] = capsules.body[candidates.feature[tree, slot] // 2]
        contacts.other_body[c] = -1
        write_rows(
            c, tree, slot, parameters, pairs, capsules, geoms, bodies, rigid, candidates,
            view_warm_start(warm_start, tree, trees), contacts, view_rows(rows_out, tree, trees),
        )  # fmt: skip


@wp.func
def row_vector(row: int, column: int, jacobian: wp.array2d(dtype=wp.float64)):
    """Three entries of a row, in single precision."""
    return wp.vec3(
        wp.float32(jacobian[row, column]), wp.float32(jacobian[row, column + 1]), wp.float32(jacobian[row, column + 2])
    )


@wp.func
def propagate_rows_inward(
    c: int,
    body: int,
    first: int,
    last: int,
    shift: int,
    jacobian: wp.array2d(dtype=wp.float64),
    model: ArticulationModel,
    factors: Factors,
    response_out: ResponseRows,
):
    """Carry unit impulses along the three rows of contact ``c`` from its body to the root, and note what each joint on
    the path takes of them."""
    force = wp.mat33()
    moment = wp.mat33()
    for r in range(3):
        f = row_vector(3 * c + r, 0, jacobian)
        m = row_vector(3 * c + r, 3, jacobian)
        for j in range(3):
            force[j, r] = f[j]
            moment[j, r] = m[j]
    path = int(body)
    for i in range((last - first) / model.pitch + 1):
        k = last - i * model.pitch
        taken = wp.mat33()
        if k == path:
            taken = factors.D[k] * moment
            force = force - wp.transpose(factors.DH[k]) * moment
            moment = moment - wp.transpose(factors.DJ[k]) * moment + wp.skew(factors.lever[k]) * force
            path = model.body_parent[k]
        response_out.alpha[shift + k] = taken


@wp.kernel
def respond_to_rows(
    # model
    model: ArticulationModel,
    is_branching: wp.array(dtype=wp.bool),
    # in
    trees: int,
    bodies: int,
    factors: Factors,
    tree_contacts: TreeContacts,
    contacts_all: Contacts,
    # out
    response_out: ResponseRows,
    rows_out: Rows,
):
    """One thread per slot of a tree: the columns of the Delassus matrix of its contact.

    The articulated-body algorithm with impulses only (Featherstone 2008, section 7.3), of trees that stand. Contacts are in the order of
    their bodies. is_branching: [body] whether a body is the parent of another than the next one. bodies: how many
    entries of ``response_out``, which is scratch, each slot has.
    """
    tree = wp.tid() % trees
    c = wp.tid() // trees
    count = tree_contacts.count[tree]
    if c >= count:
        return
    contacts = view_contacts(contacts_all, tree, trees)
    rows = view_rows(rows_out, tree, trees)
    first = model.tree_first[tree]
    last = contacts.body[count - 1]
    shift = c * bodies
    propagate_rows_inward(c, contacts.body[c], first, last, shift, rows.plant_jacobian, model, factors, response_out)
    a = wp.mat33()
    alpha = wp.mat33()
    at = int(0)
    for k in range(first, last + 1, model.pitch):
        parent = model.body_parent[k]
        if parent < 0:
            a = wp.mat33()
            alpha = wp.mat33()
        else:
            if parent != k - model.pitch:
                a = response_out.a[shift + parent]
                alpha = response_out.alpha[shift + parent]
            a = a - wp.skew(factors.lever[k]) * alpha
        alpha = alpha + response_out.alpha[shift + k] - factors.DJ[k] * alpha - factors.DH[k] * a
        if is_branching[k]:
            response_out.a[shift + k] = a
            response_out.alpha[shift + k] = alpha
        while at < count and contacts.body[wp.min(at, count - 1)] == k:
            for r in range(3):
                row = 3 * at + r
                along = wp.transpose(a) * row_vector(row, 0, rows.plant_jacobian)
                along = along + wp.transpose(alpha) * row_vector(row, 3, rows.plant_jacobian)
                for j in range(3):
                    rows.delassus[3 * row * count + 3 * c + j] = wp.float64(along[j])
            at = at + 1


@wp.kernel
def solve_trees(
    # model
    max_sweeps: int,
    max_newton_steps: int,
    max_newton_contacts: int,
    tolerance: wp.float64,
    parameters: Parameters,
    geoms: Geoms,
    # in
    trees: int,
    rigid: RigidBodies,
    # out
    tree_contacts_out: TreeContacts,
    contacts_out: Contacts,
    islands_out: Islands,
    scratch_out: SolverScratch,
    rows_out: Rows,
    warm_start_out: WarmStart,
    body_wrench_out: wp.array(dtype=wp.spatial_vector),
):
    """One thread per tree: the impulses of its contacts, the wrenches on its bodies, and what the next step starts from."""
    tree = wp.tid()
    loaded = view_int(tree_contacts_out.loaded, tree, trees)
    for i in range(tree_contacts_out.loaded_count[tree]):
        body_wrench_out[loaded[i]] = wp.spatial_vector()
    count = tree_contacts_out.count[tree]
    tree_contacts_out.loaded_count[tree] = count
    warm_start_out.count[tree] = count
    if count == 0:
        return
    contacts = view_contacts(contacts_out, tree, trees)
    islands = view_islands(islands_out, tree, trees)
    rows = view_rows(rows_out, tree, trees)
    warm_start = view_warm_start(warm_start_out, tree, trees)
    solve_island(
        0, max_sweeps, max_newton_steps, max_newton_contacts, tolerance, geoms, rigid, contacts, islands,
        view_scratch(scratch_out, tree, trees), rows,
    )  # fmt: skip
    for c in range(count):
        store_contact(c, parameters, geoms, rigid, islands, rows, contacts, warm_start)
        body = contacts.body[c]
        loaded[c] = body
        wrench = body_wrench_out[body]
        for r in range(3):
            row = 3 * c + r
            share = wp.float32(rows.impulse[row] / parameters.dt)
            wrench = wrench + share * wp.spatial_vector(
                row_vector(row, 0, rows.plant_jacobian), row_vector(row, 3, rows.plant_jacobian)
            )
        body_wrench_out[body] = wrench


@wp.kernel
def apply_contact_wrenches(
    # model
    dt: float,
    model: ArticulationModel,
    onset_steps: int,
    # in
    tree_contacts: TreeContacts,
    body_wrench: wp.array(dtype=wp.spatial_vector),
    factors: Factors,
    # out
    was_in_contact_out: wp.array(dtype=wp.bool),
    tree_euler_steps_out: wp.array(dtype=wp.int32),
    work_out: WrenchScratch,
    scratch_out: Scratch,
    prediction_out: Prediction,
):
    """One thread adds to the prediction of one tree what its contacts do over the step.

    was_in_contact_out: [tree] whether it was in contact in the last step; brought up to date. A tree whose contact begins
    takes ``onset_steps`` backward Euler steps, this one included.
    """
    tree = wp.tid()
    is_in_contact = tree_contacts.count[tree] > 0
    if is_in_contact:
        if not was_in_contact_out[tree]:
            tree_euler_steps_out[tree] = wp.max(tree_euler_steps_out[tree], onset_steps + 1)
        apply_tree_wrenches(tree, dt, model, body_wrench, factors, work_out, scratch_out, prediction_out)
    was_in_contact_out[tree] = is_in_contact
