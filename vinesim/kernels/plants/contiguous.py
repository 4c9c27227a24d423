"""Argument structs whose arrays the compiler knows to be contiguous, so that no address costs a multiplication.

Warp makes this known by itself for arrays that are arguments of a kernel, not for those in structs: without it a
prediction on a CPU takes 4 % longer. All arrays of the solver are contiguous. Derivatives go through the arrays, which
carry their gradients along, so nothing here needs an adjoint.
"""

import warp as wp

from vinesim.kernels.plants.structs import (
    AppliedForces,
    ArticulationModel,
    BodyState,
    Factors,
    JointState,
    Prediction,
    Scratch,
)

wp.set_module_options({"enable_backward": False})

SNIPPET = "a.strides[0] = sizeof(*a.data); return a;"


@wp.func_native(SNIPPET, adj_snippet="")
def dense_int32(a: wp.array(dtype=wp.int32)) -> wp.array(dtype=wp.int32): ...


@wp.func_native(SNIPPET, adj_snippet="")
def dense_transform(a: wp.array(dtype=wp.transform)) -> wp.array(dtype=wp.transform): ...


@wp.func_native(SNIPPET, adj_snippet="")
def dense_vec3(a: wp.array(dtype=wp.vec3)) -> wp.array(dtype=wp.vec3): ...


@wp.func_native(SNIPPET, adj_snippet="")
def dense_quat(a: wp.array(dtype=wp.quat)) -> wp.array(dtype=wp.quat): ...


@wp.func_native(SNIPPET, adj_snippet="")
def dense_float(a: wp.array(dtype=float)) -> wp.array(dtype=float): ...


@wp.func_native(SNIPPET, adj_snippet="")
def dense_vec2i(a: wp.array(dtype=wp.vec2i)) -> wp.array(dtype=wp.vec2i): ...


@wp.func_native(SNIPPET, adj_snippet="")
def dense_spatial(a: wp.array(dtype=wp.spatial_vector)) -> wp.array(dtype=wp.spatial_vector): ...


@wp.func_native(SNIPPET, adj_snippet="")
def dense_bool(a: wp.array(dtype=wp.bool)) -> wp.array(dtype=wp.bool): ...


@wp.func_native(SNIPPET, adj_snippet="")
def dense_mat33(a: wp.array(dtype=wp.mat33)) -> wp.array(dtype=wp.mat33): ...


@wp.func
def contiguous_model(s: ArticulationModel):
    """The same model, its arrays contiguous."""
    return ArticulationModel(
        s.pitch,
        dense_int32(s.tree_first),
        dense_int32(s.tree_size),
        dense_int32(s.tree_moving),
        dense_transform(s.tree_pose),
        dense_int32(s.body_tree),
        dense_int32(s.body_parent),
        dense_int32(s.body_root),
        dense_bool(s.body_falls),
        dense_vec3(s.body_offset),
        dense_quat(s.body_rest),
        dense_float(s.body_mass),
        dense_vec3(s.body_com),
        dense_vec3(s.body_inertia),
        dense_vec3(s.body_product),
        dense_float(s.body_drag),
        dense_vec3(s.joint_stiffness),
        dense_vec3(s.joint_damping),
        dense_vec2i(s.tie_span),
        dense_vec3(s.tie_point),
        dense_float(s.tie_stiffness),
        dense_float(s.tie_damping),
    )


@wp.func
def contiguous_joints(s: JointState):
    """The same joints, its arrays contiguous."""
    return JointState(dense_vec3(s.joint_x), dense_vec3(s.joint_xd), dense_quat(s.joint_q), dense_vec3(s.joint_qd))


@wp.func
def contiguous_bodies(s: BodyState):
    """The same bodies, its arrays contiguous."""
    return BodyState(dense_transform(s.body_q), dense_spatial(s.body_qd))


@wp.func
def contiguous_forces(s: AppliedForces):
    """The same forces, its arrays contiguous."""
    return AppliedForces(
        dense_vec3(s.tree_air),
        dense_vec3(s.root_turn),
        dense_vec3(s.root_turn_rate),
        dense_vec3(s.tie_anchor),
        dense_vec3(s.tie_anchor_velocity),
        dense_spatial(s.body_load),
        dense_spatial(s.body_wrench),
    )


@wp.func
def contiguous_factors(s: Factors):
    """The same factors, its arrays contiguous."""
    return Factors(
        dense_quat(s.axes),
        dense_vec3(s.lever),
        dense_mat33(s.D),
        dense_mat33(s.DJ),
        dense_mat33(s.DH),
        dense_mat33(s.root_inverse_mass),
    )


@wp.func
def contiguous_scratch(s: Scratch):
    """The same scratch, its arrays contiguous."""
    return Scratch(
        dense_mat33(s.J),
        dense_mat33(s.H),
        dense_mat33(s.M),
        dense_spatial(s.bias),
        dense_vec3(s.tension),
        dense_vec3(s.Du),
    )


@wp.func
def contiguous_prediction(s: Prediction):
    """The same prediction, its arrays contiguous."""
    return Prediction(
        dense_spatial(s.body_acceleration),
        dense_vec3(s.joint_xd_free),
        dense_vec3(s.joint_qd_free),
        dense_spatial(s.body_qd_free),
    )
