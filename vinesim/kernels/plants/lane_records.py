"""Records of eight trees: for each body 8 x :data:`RECORD` numbers, in which a number of all eight lies side by side.

One lane of a record is one tree. What is known of a tree is copied into its lane before a walk, and results out of it
afterwards; see :mod:`vinesim.kernels.plants.eight_trees`.
"""

import warp as wp

from vinesim.kernels.plants.body_dynamics import turned_rest_moment
from vinesim.kernels.plants.structs import AppliedForces, ArticulationModel, BodyState, Factors, JointState, Prediction

wp.set_module_options({"enable_backward": False})

LANES = 8
"""Trees in a vector."""

# Where the numbers of a record begin. Kinematics: 20 of them.
POSE = wp.constant(LANES * 0)
MOTION = wp.constant(LANES * 7)
AXES = wp.constant(LANES * 13)
LEVER = wp.constant(LANES * 17)
# Implicit inertia and bias of a subtree: 30. Of symmetric matrices the upper triangle.
TERMS = wp.constant(LANES * 20)
# Factors: 27.
FACTORS = wp.constant(LANES * 50)
# End of the step: 15.
END = wp.constant(LANES * 77)
# What is given: model, joints, forces.
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
"""Numbers of one body of one tree."""
STRIDE = wp.constant(LANES * RECORD)

Floats = wp.array(dtype=float)


@wp.func_native("a.data += at; a.strides[0] = sizeof(*a.data); return a;")
def record(a: wp.array(dtype=float), at: int) -> wp.array(dtype=float):
    """The same array from number ``at`` on."""
    ...


@wp.func_native("const float* const p = a.data + i; return wp::vec3(p[0], p[8], p[16]);")
def vec3_at(a: wp.array(dtype=float), i: int) -> wp.vec3:
    """A vector of one lane, its first number at i."""
    ...


@wp.func_native("const float* const p = a.data + i; return wp::quat(p[0], p[8], p[16], p[24]);")
def quat_at(a: wp.array(dtype=float), i: int) -> wp.quat:
    """A rotation of one lane."""
    ...


@wp.func_native(
    "const float* const p = a.data + i; wp::vec_t<6, float> v; for (int c = 0; c < 6; ++c) v[c] = p[8 * c]; return v;"
)
def spatial_at(a: wp.array(dtype=float), i: int) -> wp.spatial_vector:
    """A spatial vector of one lane."""
    ...


@wp.func_native(
    "const float* const p = a.data + i; return wp::mat33(p[0], p[8], p[16], p[24], p[32], p[40], p[48], p[56], p[64]);"
)
def mat33_at(a: wp.array(dtype=float), i: int) -> wp.mat33:
    """A matrix of one lane."""
    ...


@wp.func_native(
    "const float* const p = a.data + i; return wp::mat33(p[0], p[8], p[16], p[8], p[24], p[32], p[16], p[32], p[40]);"
)
def symmetric_at(a: wp.array(dtype=float), i: int) -> wp.mat33:
    """A symmetric matrix of one lane, of which the upper triangle is kept."""
    ...


@wp.func
def upper_triangle(m: wp.mat33):
    """The six numbers of a symmetric matrix that are kept."""
    return wp.spatial_vector(m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2])


@wp.func
def put_vec3(a_out: Floats, i: int, v: wp.vec3):
    """Write a vector of one lane."""
    for c in range(3):
        a_out[i + 8 * c] = v[c]


@wp.func
def put_quat(a_out: Floats, i: int, q: wp.quat):
    """Write a rotation of one lane."""
    for c in range(4):
        a_out[i + 8 * c] = q[c]


@wp.func
def put_spatial(a_out: Floats, i: int, v: wp.spatial_vector):
    """Write a spatial vector of one lane."""
    for c in range(6):
        a_out[i + 8 * c] = v[c]


@wp.func
def parent_record(model: ArticulationModel, k: int, first: int, records: Floats):
    """The record of the parent of body k, or that of what roots stand on."""
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
    """Copy what the walk needs of one tree into its lane; record 0 is what roots stand on."""
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
    """Copy one tree's results out of its lane."""
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
