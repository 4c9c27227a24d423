"""Prediction of eight trees of one topology at once: one lane of a SIMD vector is one tree.

The three passes are those of :mod:`vinesim.kernels.plants.prediction`, with the same functions of one body, on a CPU
only. All inputs of eight trees are copied into records. LLVM then compiles eight iterations of a loop over ``lane``
into one vector instruction (docs/decisions/eight-trees.md states the conditions). Lanes are independent, so the result
of a tree has the same bits whichever trees share its vector, and as in a separate prediction.

A record has 8 x :data:`RECORD` numbers for each body, with each number stored side by side for all eight trees. The
inputs of a tree are copied into its lane before the passes, and its results are copied out afterwards.
"""

import warp as wp

from vinesim.kernels.compiler_flags import INLINE_ALL
from vinesim.kernels.plants.body_dynamics import (
    accelerate_body,
    drag_terms,
    joint_terms,
    own_terms,
    terms_left,
    tie_terms,
    turned_rest_moment,
)
from vinesim.kernels.plants.kinematics import body_kinematics
from vinesim.kernels.plants.prediction import chosen_phi, is_conservative, predict_tree
from vinesim.kernels.plants.spatial import inverse_symmetric, world_inertia
from vinesim.kernels.plants.structs import (
    AppliedForces,
    ArticulationModel,
    BodyState,
    Factors,
    JointState,
    Prediction,
    Scratch,
    SolverParameters,
    substep_parameters,
)

LANES = 8
"""Number of trees in a vector."""

# Where the numbers of a record begin. Kinematics: 20 numbers.
POSE = wp.constant(LANES * 0)
MOTION = wp.constant(LANES * 7)
AXES = wp.constant(LANES * 13)
LEVER = wp.constant(LANES * 17)
# Implicit inertia and bias of a subtree: 30 numbers. Symmetric matrices are stored as their upper triangle.
TERMS = wp.constant(LANES * 20)
# Factors: 27 numbers.
FACTORS = wp.constant(LANES * 50)
# End of the step: 15 numbers.
END = wp.constant(LANES * 77)
# Inputs: model, joints, forces.
OFFSET = wp.constant(LANES * 92)
REST = wp.constant(LANES * 95)
JOINT_Q = wp.constant(LANES * 99)
JOINT_QD = wp.constant(LANES * 103)
MASS = wp.constant(LANES * 106)
COM = wp.constant(LANES * 107)
INERTIA = wp.constant(LANES * 110)
PRODUCT = wp.constant(LANES * 113)
DRAG = wp.constant(LANES * 116)
LOAD = wp.constant(LANES * 117)
CONTACT = wp.constant(LANES * 123)
STIFFNESS = wp.constant(LANES * 126)
DAMPING = wp.constant(LANES * 129)
RECORD = 132
"""Number of values for one body of one tree."""
STRIDE = wp.constant(LANES * RECORD)

Floats = wp.array(dtype=float)


@wp.func_native("a.data += at; a.strides[0] = sizeof(*a.data); return a;")
def record(a: wp.array(dtype=float), at: int) -> wp.array(dtype=float):
    """Returns a view of the array ``a`` that begins at index ``at``."""
    ...


@wp.func_native("const float* const p = a.data + i; return wp::vec3(p[0], p[8], p[16]);")
def vec3_at(a: wp.array(dtype=float), i: int) -> wp.vec3:
    """Returns a vector of one lane (one of eight trees stored side by side); its first number is at index i."""
    ...


@wp.func_native("const float* const p = a.data + i; return wp::quat(p[0], p[8], p[16], p[24]);")
def quat_at(a: wp.array(dtype=float), i: int) -> wp.quat:
    """Returns a rotation of one lane (one of eight trees stored side by side); its first number is at index i."""
    ...


@wp.func_native(
    "const float* const p = a.data + i; wp::vec_t<6, float> v; for (int c = 0; c < 6; ++c) v[c] = p[8 * c]; return v;"
)
def spatial_at(a: wp.array(dtype=float), i: int) -> wp.spatial_vector:
    """Returns a spatial vector of one lane (one of eight trees stored side by side); its first number is at index i."""
    ...


@wp.func_native(
    "const float* const p = a.data + i; return wp::mat33(p[0], p[8], p[16], p[24], p[32], p[40], p[48], p[56], p[64]);"
)
def mat33_at(a: wp.array(dtype=float), i: int) -> wp.mat33:
    """Returns a matrix of one lane (one of eight trees stored side by side); its first number is at index i."""
    ...


@wp.func_native(
    "const float* const p = a.data + i; return wp::mat33(p[0], p[8], p[16], p[8], p[24], p[32], p[16], p[32], p[40]);"
)
def symmetric_at(a: wp.array(dtype=float), i: int) -> wp.mat33:
    """Returns a symmetric matrix of one lane (one of eight trees stored side by side). Only the upper triangle is
    stored, from index i on.
    """
    ...


@wp.func
def upper_triangle(m: wp.mat33):
    """Returns the six numbers of the upper triangle of a symmetric matrix."""
    return wp.spatial_vector(m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2])


@wp.func
def put_vec3(a_out: Floats, i: int, v: wp.vec3):
    """Write a vector of one lane (one of eight trees stored side by side), from index i on."""
    for c in range(3):
        a_out[i + 8 * c] = v[c]


@wp.func
def put_quat(a_out: Floats, i: int, q: wp.quat):
    """Write a rotation of one lane (one of eight trees stored side by side), from index i on."""
    for c in range(4):
        a_out[i + 8 * c] = q[c]


@wp.func
def put_spatial(a_out: Floats, i: int, v: wp.spatial_vector):
    """Write a spatial vector of one lane (one of eight trees stored side by side), from index i on."""
    for c in range(6):
        a_out[i + 8 * c] = v[c]


@wp.func
def parent_record(model: ArticulationModel, k: int, first: int, records: Floats):
    """Returns the record of the parent of body k; for a root, record 0, which has the motion of the frame that roots
    are attached to."""
    return record(records, wp.max(model.body_parent[k] - first + 1, 0) * STRIDE)


@wp.func
def load_tree(
    dt: float,
    phi: float,
    lane: int,
    tree: int,
    model: ArticulationModel,
    joints: JointState,
    forces: AppliedForces,
    records_out: Floats,
):
    """Copy all inputs of one tree into its lane of the records. Record 0 describes the frame that roots are attached
    to.

    ``lane``: index of the tree among the eight trees that are predicted together.
    """
    pose = model.tree_pose[tree]
    put_vec3(records_out, POSE + lane, wp.transform_get_translation(pose))
    put_quat(records_out, POSE + 24 + lane, wp.transform_get_rotation(pose))
    put_spatial(records_out, MOTION + lane, wp.spatial_vector())
    first = model.tree_first[tree]
    for i in range(model.tree_moving[tree]):
        k = first + i
        own = record(records_out, (i + 1) * STRIDE + lane)
        put_vec3(own, OFFSET, model.body_offset[k])
        put_quat(own, REST, model.body_rest[k])
        put_quat(own, JOINT_Q, joints.joint_q[k])
        put_vec3(own, JOINT_QD, joints.joint_qd[k])
        own[MASS] = model.body_mass[k]
        put_vec3(own, COM, model.body_com[k])
        put_vec3(own, INERTIA, model.body_inertia[k])
        put_vec3(own, PRODUCT, model.body_product[k])
        own[DRAG] = model.body_drag[k]
        load = forces.body_load[k]
        if model.body_parent[k] < 0:
            load = load + wp.spatial_vector(
                wp.vec3(),
                turned_rest_moment(
                    dt,
                    phi,
                    wp.transform_get_rotation(pose) * model.body_rest[k],
                    joints.joint_q[k],
                    model.joint_stiffness[k],
                    model.joint_damping[k],
                    forces.root_turn[tree],
                    forces.root_turn_rate[tree],
                ),
            )
        put_spatial(own, LOAD, load)
        put_vec3(own, CONTACT, wp.spatial_top(forces.body_wrench[k]))
        put_vec3(own, STIFFNESS, model.joint_stiffness[k])
        put_vec3(own, DAMPING, model.joint_damping[k])


@wp.func
def store_tree(
    lane: int,
    tree: int,
    model: ArticulationModel,
    records: Floats,
    bodies_out: BodyState,
    factors_out: Factors,
    prediction_out: Prediction,
):
    """Copy one tree's results out of its lane of the records.

    ``lane``: index of the tree among the eight trees that are predicted together.
    """
    first = model.tree_first[tree]
    for i in range(model.tree_moving[tree]):
        k = first + i
        own = record(records, (i + 1) * STRIDE + lane)
        bodies_out.body_q[k] = wp.transform(vec3_at(own, POSE), quat_at(own, POSE + 24))
        bodies_out.body_qd[k] = spatial_at(own, MOTION)
        factors_out.axes[k] = quat_at(own, AXES)
        factors_out.lever[k] = vec3_at(own, LEVER)
        factors_out.D[k] = symmetric_at(own, FACTORS)
        factors_out.DJ[k] = mat33_at(own, FACTORS + 8 * 6)
        factors_out.DH[k] = mat33_at(own, FACTORS + 8 * 15)
        if model.body_parent[k] < 0:
            factors_out.root_inverse_mass[k] = wp.mat33()
        prediction_out.body_acceleration[k] = spatial_at(own, END)
        prediction_out.body_qd_free[k] = spatial_at(own, END + 8 * 6)
        prediction_out.joint_qd_free[k] = vec3_at(own, END + 8 * 12)


# Walks over eight trees.


wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINE_ALL})

MIN_LANES = wp.constant(2)
"""Least number of trees in a group that are predicted together. MEASURED: two trees together take 0.7 to 0.9 of the
time of separate predictions, eight take 0.3."""

Lanes = wp.types.vector(length=LANES, dtype=wp.float32)
LaneIndices = wp.types.vector(length=LANES, dtype=wp.int32)
# results of a loop over lanes; a loop that wrote to the record it reads would not be vectorised
KinematicsOut = wp.types.vector(length=LANES * 20, dtype=wp.float32)
TermsOut = wp.types.vector(length=LANES * 30, dtype=wp.float32)
FactorsOut = wp.types.vector(length=LANES * 27, dtype=wp.float32)
EndOut = wp.types.vector(length=LANES * 15, dtype=wp.float32)


@wp.func
def assemble_eight(p: SolverParameters, phis: Lanes, top: Floats, own_out: Floats):
    """Compute pose, velocity, implicit inertia, bias and tension of one body of each tree. ``top``: record of the
    body's parent."""
    kinematics = KinematicsOut()
    terms = TermsOut()
    lane = wp.int32(0)
    while lane < LANES:
        above = wp.transform(vec3_at(top, POSE + lane), quat_at(top, POSE + 24 + lane))
        axes, lever, pose, motion = body_kinematics(
            above,
            spatial_at(top, MOTION + lane),
            vec3_at(own_out, OFFSET + lane),
            quat_at(own_out, REST + lane),
            quat_at(own_out, JOINT_Q + lane),
            vec3_at(own_out, JOINT_QD + lane),
        )
        origin = wp.transform_get_translation(pose)
        q = wp.transform_get_rotation(pose)
        for c in range(3):
            kinematics[8 * c + lane] = origin[c]
            kinematics[8 * (17 + c) + lane] = lever[c]
        for c in range(4):
            kinematics[8 * (3 + c) + lane] = q[c]
            kinematics[8 * (13 + c) + lane] = axes[c]
        for c in range(6):
            kinematics[8 * (7 + c) + lane] = motion[c]
        rotation = wp.quat_to_matrix(q)
        inertia = world_inertia(rotation, vec3_at(own_out, INERTIA + lane), vec3_at(own_out, PRODUCT + lane))
        J, H, M, bias, tension, _steady = own_terms(
            p,
            phis[lane],
            motion,
            own_out[MASS + lane],
            rotation * vec3_at(own_out, COM + lane),
            inertia,
            spatial_at(own_out, LOAD + lane),
            vec3_at(own_out, CONTACT + lane),
            0.0,
            wp.vec3(),
        )
        J_upper = upper_triangle(J)
        M_upper = upper_triangle(M)
        for c in range(6):
            terms[8 * c + lane] = J_upper[c]
            terms[8 * (15 + c) + lane] = M_upper[c]
            terms[8 * (21 + c) + lane] = bias[c]
        for r in range(3):
            for c in range(3):
                terms[8 * (6 + 3 * r + c) + lane] = H[r, c]
            terms[8 * (27 + r) + lane] = tension[r]
        lane += 1
    i = wp.int32(0)
    while i < LANES * 20:
        own_out[POSE + i] = kinematics[i]
        i += 1
    i = wp.int32(0)
    while i < LANES * 30:
        own_out[TERMS + i] = terms[i]
        i += 1


@wp.func
def add_drag_eight(p: SolverParameters, phis: Lanes, air: Floats, own_out: Floats):
    """Add air drag to one body of each tree. ``air``: [8 x 3] m/s, velocity of the air at each tree."""
    terms = TermsOut()
    lane = wp.int32(0)
    while lane < LANES:
        rotation = wp.quat_to_matrix(quat_at(own_out, POSE + 24 + lane))
        J, H, M, bias, tension = drag_terms(
            p,
            phis[lane],
            own_out[DRAG + lane],
            vec3_at(air, lane),
            spatial_at(own_out, MOTION + lane),
            rotation * vec3_at(own_out, COM + lane),
        )
        J_upper = upper_triangle(J)
        M_upper = upper_triangle(M)
        for c in range(6):
            terms[8 * c + lane] = J_upper[c]
            terms[8 * (15 + c) + lane] = M_upper[c]
            terms[8 * (21 + c) + lane] = bias[c]
        for r in range(3):
            for c in range(3):
                terms[8 * (6 + 3 * r + c) + lane] = H[r, c]
            terms[8 * (27 + r) + lane] = tension[r]
        lane += 1
    i = wp.int32(0)
    while i < LANES * 30:
        own_out[TERMS + i] = own_out[TERMS + i] + terms[i]
        i += 1


@wp.func
def add_ties(p: SolverParameters, phi: float, k: int, model: ArticulationModel, forces: AppliedForces, own_out: Floats):
    """Add the ties of body k of one tree to the body's record. ``own_out``: view of the record that begins at the
    tree's lane."""
    ties = model.tie_span[k]
    for t in range(ties[0], ties[1]):
        J, H, M, bias, tension = tie_terms(
            p.dt,
            phi,
            model.tie_stiffness[t],
            model.tie_damping[t],
            forces.tie_anchor[t],
            forces.tie_anchor_velocity[t],
            wp.quat_to_matrix(quat_at(own_out, POSE + 24)) * model.tie_point[t],
            vec3_at(own_out, POSE),
            spatial_at(own_out, MOTION),
        )
        put_spatial(own_out, TERMS, spatial_at(own_out, TERMS) + upper_triangle(J))
        for r in range(3):
            at = TERMS + 8 * (6 + 3 * r)
            put_vec3(own_out, at, vec3_at(own_out, at) + H[r])
        put_spatial(own_out, TERMS + 8 * 15, spatial_at(own_out, TERMS + 8 * 15) + upper_triangle(M))
        put_spatial(own_out, TERMS + 8 * 21, spatial_at(own_out, TERMS + 8 * 21) + bias)
        put_vec3(own_out, TERMS + 8 * 27, vec3_at(own_out, TERMS + 8 * 27) + tension)


@wp.func
def eliminate_eight(p: SolverParameters, phis: Lanes, top_out: Floats, own_out: Floats):
    """Factor the joint of one body of each tree, and add the remaining inertia and bias to the parent's record."""
    factors = FactorsOut()
    terms = TermsOut()
    lane = wp.int32(0)
    while lane < LANES:
        turning = vec3_at(top_out, MOTION + 24 + lane)
        metric, drive, _torque = joint_terms(
            p.dt,
            phis[lane],
            quat_at(own_out, AXES + lane),
            quat_at(own_out, JOINT_Q + lane),
            vec3_at(own_out, JOINT_QD + lane),
            vec3_at(own_out, STIFFNESS + lane),
            vec3_at(own_out, DAMPING + lane),
            turning,
            vec3_at(own_out, MOTION + 24 + lane),
        )
        J = symmetric_at(own_out, TERMS + lane)
        H = mat33_at(own_out, TERMS + 8 * 6 + lane)
        M = symmetric_at(own_out, TERMS + 8 * 15 + lane)
        bias = spatial_at(own_out, TERMS + 8 * 21 + lane)
        tension = vec3_at(own_out, TERMS + 8 * 27 + lane)
        u = drive - wp.spatial_bottom(bias)
        D = inverse_symmetric(J + metric)
        DJ = D * J
        DH = D * H
        Du = D * u
        D_upper = upper_triangle(D)
        for c in range(6):
            factors[8 * c + lane] = D_upper[c]
        for r in range(3):
            for c in range(3):
                factors[8 * (6 + 3 * r + c) + lane] = DJ[r, c]
                factors[8 * (15 + 3 * r + c) + lane] = DH[r, c]
            factors[8 * (24 + r) + lane] = Du[r]
        J_left, H_left, M_left, bias_left = terms_left(
            p, phis[lane], turning, metric, vec3_at(own_out, LEVER + lane), J, H, M, bias, tension, DJ, DH, Du
        )
        J_upper = upper_triangle(J_left)
        M_upper = upper_triangle(M_left)
        for c in range(6):
            terms[8 * c + lane] = J_upper[c]
            terms[8 * (15 + c) + lane] = M_upper[c]
            terms[8 * (21 + c) + lane] = bias_left[c]
        for r in range(3):
            for c in range(3):
                terms[8 * (6 + 3 * r + c) + lane] = H_left[r, c]
            terms[8 * (27 + r) + lane] = tension[r]
        lane += 1
    i = wp.int32(0)
    while i < LANES * 27:
        own_out[FACTORS + i] = factors[i]
        i += 1
    i = wp.int32(0)
    while i < LANES * 30:
        top_out[TERMS + i] = top_out[TERMS + i] + terms[i]
        i += 1


@wp.func
def accelerate_eight(dt: float, top: Floats, own_out: Floats):
    """Compute the acceleration of one body of each tree over the step, and its joint rate and velocity at the end of
    the step."""
    end = EndOut()
    lane = wp.int32(0)
    while lane < LANES:
        acceleration, rate, velocity = accelerate_body(
            dt,
            spatial_at(top, END + lane),
            spatial_at(top, END + 8 * 6 + lane),
            vec3_at(top, MOTION + 24 + lane),
            vec3_at(own_out, MOTION + 24 + lane),
            vec3_at(own_out, LEVER + lane),
            quat_at(own_out, AXES + lane),
            vec3_at(own_out, JOINT_QD + lane),
            mat33_at(own_out, FACTORS + 8 * 6 + lane),
            mat33_at(own_out, FACTORS + 8 * 15 + lane),
            vec3_at(own_out, FACTORS + 8 * 24 + lane),
        )
        for c in range(6):
            end[8 * c + lane] = acceleration[c]
            end[8 * (6 + c) + lane] = velocity[c]
        for c in range(3):
            end[8 * (12 + c) + lane] = rate[c]
        lane += 1
    i = wp.int32(0)
    while i < LANES * 15:
        own_out[END + i] = end[i]
        i += 1


@wp.func
def walk_eight(
    p: SolverParameters,
    model: ArticulationModel,
    forces: AppliedForces,
    joints: JointState,
    trees: LaneIndices,
    count: int,
    phis: Lanes,
    records_out: Floats,
    bodies_out: BodyState,
    factors_out: Factors,
    prediction_out: Prediction,
):
    """Run the three passes over eight trees of one topology, and store the results of the first ``count``."""
    first = model.tree_first[trees[0]]
    size = model.tree_moving[trees[0]]
    air = record(records_out, (size + 1) * STRIDE)
    lane = wp.int32(0)  # no "for", which Warp would unroll
    while lane < LANES:
        load_tree(p.dt, phis[lane], lane, trees[lane], model, joints, forces, records_out)
        put_vec3(air, lane, forces.tree_air[trees[lane]])
        lane += 1
    i = wp.int32(0)
    while i < LANES * 15:
        records_out[END + i] = 0.0
        i += 1
    i = wp.int32(0)
    while i < LANES * 30:
        records_out[TERMS + i] = 0.0
        i += 1
    for i in range(size):
        own = record(records_out, (i + 1) * STRIDE)
        assemble_eight(p, phis, parent_record(model, first + i, first, records_out), own)
        has_drag = bool(False)
        for lane in range(count):
            has_drag = has_drag or own[DRAG + lane] > 0.0
        if has_drag:
            add_drag_eight(p, phis, air, own)
        for lane in range(count):
            k = model.tree_first[trees[lane]] + i
            add_ties(p, phis[lane], k, model, forces, record(own, lane))
    for j in range(size):
        i = size - 1 - j
        top = parent_record(model, first + i, first, records_out)
        eliminate_eight(p, phis, top, record(records_out, (i + 1) * STRIDE))
    for i in range(size):
        top = parent_record(model, first + i, first, records_out)
        accelerate_eight(p.dt, top, record(records_out, (i + 1) * STRIDE))
    for lane in range(count):
        store_tree(lane, trees[lane], model, records_out, bodies_out, factors_out, prediction_out)


@wp.kernel
def predict_groups(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    # in
    count: wp.array(dtype=wp.int32),
    groups: wp.array(dtype=wp.vec2i),
    trees: wp.array(dtype=wp.int32),
    tree_phi: wp.array(dtype=float),
    tree_euler_steps: wp.array(dtype=wp.int32),
    tree_steps: wp.array(dtype=wp.int32),
    forces: AppliedForces,
    joints: JointState,
    # out
    records_out: wp.array(dtype=float),
    tree_phi_out: wp.array(dtype=float),
    bodies_out: BodyState,
    factors_out: Factors,
    scratch_out: Scratch,
    prediction_out: Prediction,
):
    """One thread solves the motion of up to eight trees of one topology, with the same results as :func:`predict`.

    groups: [thread] first index in ``trees`` and number of trees; a group of two or more has no floating roots.
    records_out: scratch that all threads share, because they run one after the other. :func:`predict` describes the
    other arguments.
    """
    if wp.tid() >= count[0]:
        return
    span = groups[wp.tid()]
    members = span[1]
    phis = Lanes()
    listed = LaneIndices()
    together = members >= MIN_LANES
    for lane in range(LANES):
        tree = trees[span[0] + wp.min(lane, members - 1)]
        listed[lane] = tree
        phi = chosen_phi(p, model, joints, tree, tree_phi[tree], tree_euler_steps[tree])
        phis[lane] = phi
        tree_phi_out[tree] = phi
        together = together and tree_steps[tree] == 1 and not is_conservative(p, phi)
    if together:
        walk_eight(
            p, model, forces, joints, listed, members, phis, records_out, bodies_out, factors_out, prediction_out
        )
    else:
        for lane in range(members):
            tree = listed[lane]
            step = substep_parameters(p, tree_steps[tree])
            predict_tree(
                step,
                model,
                forces,
                joints,
                tree,
                phis[lane],
                bodies_out,
                factors_out,
                scratch_out,
                prediction_out,
            )
