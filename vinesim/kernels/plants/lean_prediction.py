"""Prediction for GPUs: the three passes of :mod:`vinesim.kernels.plants.prediction` with little memory traffic.

In that module, the remaining inertia of a subtree is added to its parent's record and read again. On a GPU, where every
tree is a thread and no record stays in a cache, this takes most of the time. In this module, a body's own inertia is
computed when its joint is eliminated, and the remaining inertia is passed in registers to the parent, which in most
cases is the previous body. Records are used at branches only. The functions of one body and the order of sums are the
same, except where two branches or more leave one body.

Warp's adjoint does not restore values that a loop carries in registers. So gradients use
:mod:`vinesim.kernels.plants.prediction`.
"""

import warp as wp

from vinesim.kernels.plants.body_dynamics import (
    accelerate_body,
    drag_terms,
    joint_terms,
    own_terms,
    terms_left,
    tie_terms,
    turned_rest_moment,
)
from vinesim.kernels.plants.kinematics import body_kinematics, parent_kinematics
from vinesim.kernels.plants.prediction import add_terms, chosen_phi, is_conservative, predict_tree
from vinesim.kernels.plants.spatial import inverse_symmetric, symmetric, world_inertia
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

wp.set_module_options({"enable_backward": False})


@wp.func
def place_bodies(
    model: ArticulationModel,
    joints: JointState,
    is_branching: wp.array(dtype=wp.bool),
    tree: int,
    bodies_out: BodyState,
    factors_out: Factors,
    scratch_out: Scratch,
):
    """From the root to the tips of one tree: compute pose and velocity of each body, and set to zero the records in
    which branches are summed."""
    first = model.tree_first[tree]
    pose = wp.transform()
    motion = wp.spatial_vector()
    end = first + model.tree_moving[tree] * model.pitch
    for k in range(first, end, model.pitch):
        # all values of a body are read before the first branch, so that a GPU waits for memory once
        parent = model.body_parent[k]
        offset = model.body_offset[k]
        rest = model.body_rest[k]
        q = joints.joint_q[k]
        qd = joints.joint_qd[k]
        branches = is_branching[k]
        if parent < 0 or parent != k - model.pitch:
            pose, motion = parent_kinematics(k, tree, model, joints, bodies_out)
        axes, lever, pose, motion = body_kinematics(pose, motion, offset, rest, q, qd)
        bodies_out.body_q[k] = pose
        bodies_out.body_qd[k] = motion
        factors_out.axes[k] = axes
        factors_out.lever[k] = lever
        if branches:
            scratch_out.J[k] = wp.mat33()
            scratch_out.H[k] = wp.mat33()
            scratch_out.M[k] = wp.mat33()
            scratch_out.bias[k] = wp.spatial_vector()
            scratch_out.tension[k] = wp.vec3()


@wp.func
def applied_terms(
    k: int,
    tree: int,
    parent: int,
    p: SolverParameters,
    phi: float,
    model: ArticulationModel,
    forces: AppliedForces,
    joints: JointState,
    pose: wp.transform,
    motion: wp.spatial_vector,
    axes: wp.quat,
    q: wp.quat,
    stiffness: wp.vec3,
    damping: wp.vec3,
):
    """Returns the implicit inertia J, H, M of body k, its bias and its tension. Each is a sum of the terms of the body
    itself, of air drag, and of the body's ties.
    """
    mass = model.body_mass[k]
    local_com = model.body_com[k]
    local_inertia = model.body_inertia[k]
    local_product = model.body_product[k]
    does_fall = model.body_falls[k]
    load = forces.body_load[k]
    contact = wp.spatial_top(forces.body_wrench[k])
    area = model.body_drag[k]
    ties = model.tie_span[k]
    rotation = wp.quat_to_matrix(wp.transform_get_rotation(pose))
    com = rotation * local_com
    inertia = world_inertia(rotation, local_inertia, local_product)
    falls = float(0.0)
    fall = wp.vec3()
    if does_fall:
        falls = 1.0
        fall = joints.joint_xd[model.body_root[k]]
    if parent < 0:
        load = load + wp.spatial_vector(
            wp.vec3(),
            turned_rest_moment(
                p.dt, phi, axes, q, stiffness, damping, forces.root_turn[tree], forces.root_turn_rate[tree]
            ),
        )
    J, H, M, bias, tension, _steady = own_terms(p, phi, motion, mass, com, inertia, load, contact, falls, fall)
    if area > 0.0:
        J_more, H_more, M_more, bias_more, tension_more = drag_terms(p, phi, area, forces.tree_air[tree], motion, com)
        J += J_more
        H += H_more
        M += M_more
        bias += bias_more
        tension += tension_more
    for t in range(ties[0], ties[1]):
        J_more, H_more, M_more, bias_more, tension_more = tie_terms(
            p.dt,
            phi,
            model.tie_stiffness[t],
            model.tie_damping[t],
            forces.tie_anchor[t],
            forces.tie_anchor_velocity[t],
            rotation * model.tie_point[t],
            wp.transform_get_translation(pose),
            motion,
        )
        J += J_more
        H += H_more
        M += M_more
        bias += bias_more
        tension += tension_more
    return J, H, M, bias, tension


@wp.func
def eliminate_bodies(
    p: SolverParameters,
    model: ArticulationModel,
    forces: AppliedForces,
    joints: JointState,
    bodies: BodyState,
    is_branching: wp.array(dtype=wp.bool),
    tree: int,
    phi: float,
    factors_out: Factors,
    scratch_out: Scratch,
):
    """From the tips to the root of one tree: compute each body's implicit inertia and bias, factor its joint, and pass
    the remaining inertia and bias to its parent."""
    first = model.tree_first[tree]
    size = model.tree_moving[tree]
    last = first + (size - 1) * model.pitch
    motion = bodies.body_qd[last]
    carried = bool(False)
    J_carried = wp.mat33()
    H_carried = wp.mat33()
    M_carried = wp.mat33()
    bias_carried = wp.spatial_vector()
    tension_carried = wp.vec3()
    for i in range(size):
        k = last - i * model.pitch
        parent = model.body_parent[k]
        pose = bodies.body_q[k]
        axes = factors_out.axes[k]
        lever = factors_out.lever[k]
        q = joints.joint_q[k]
        qd = joints.joint_qd[k]
        stiffness = model.joint_stiffness[k]
        damping = model.joint_damping[k]
        branches = is_branching[k]
        before = bodies.body_qd[wp.max(k - model.pitch, first)]
        J, H, M, bias, tension = applied_terms(
            k, tree, parent, p, phi, model, forces, joints, pose, motion, axes, q, stiffness, damping
        )
        if branches:
            J += scratch_out.J[k]
            H += scratch_out.H[k]
            M += scratch_out.M[k]
            bias += scratch_out.bias[k]
            tension += scratch_out.tension[k]
        if carried:
            J += J_carried
            H += H_carried
            M += M_carried
            bias += bias_carried
            tension += tension_carried
        above = wp.spatial_vector()
        if parent == k - model.pitch:
            above = before
        elif parent >= 0:
            above = bodies.body_qd[parent]
        metric, drive, _torque = joint_terms(
            p.dt, phi, axes, q, qd, stiffness, damping, wp.spatial_bottom(above), wp.spatial_bottom(motion)
        )
        J = symmetric(J)
        M = symmetric(M)
        D = inverse_symmetric(J + metric)
        DJ = D * J
        DH = D * H
        Du = D * (drive - wp.spatial_bottom(bias))
        factors_out.D[k] = D
        factors_out.DJ[k] = DJ
        factors_out.DH[k] = DH
        scratch_out.Du[k] = Du
        carried = False
        if parent >= 0:
            J_left, H_left, M_left, bias_left = terms_left(
                p, phi, wp.spatial_bottom(above), metric, lever, J, H, M, bias, tension, DJ, DH, Du
            )
            if parent == k - model.pitch:
                carried = True
                J_carried = J_left
                H_carried = H_left
                M_carried = M_left
                bias_carried = bias_left
                tension_carried = tension
            else:
                add_terms(parent, J_left, H_left, M_left, bias_left, tension, scratch_out)
        else:
            factors_out.root_inverse_mass[k] = wp.mat33()
            if model.body_root[k] >= 0:
                scratch_out.H[k] = H
                scratch_out.bias[k] = bias
                factors_out.root_inverse_mass[k] = wp.inverse(M - wp.transpose(H) * DH)
        motion = before


@wp.func
def accelerate_tree(
    dt: float,
    model: ArticulationModel,
    joints: JointState,
    bodies: BodyState,
    factors: Factors,
    scratch: Scratch,
    tree: int,
    prediction_out: Prediction,
):
    """From the root to the tips of one tree: compute accelerations, and the resulting rates and velocities."""
    first = model.tree_first[tree]
    acceleration = wp.spatial_vector()
    velocity = wp.spatial_vector()
    omega = wp.vec3()
    end = first + model.tree_moving[tree] * model.pitch
    for k in range(first, end, model.pitch):
        parent = model.body_parent[k]
        lever = factors.lever[k]
        axes = factors.axes[k]
        qd = joints.joint_qd[k]
        DJ = factors.DJ[k]
        DH = factors.DH[k]
        Du = scratch.Du[k]
        turning = omega
        omega = wp.spatial_bottom(bodies.body_qd[k])
        if parent < 0:
            acceleration = wp.spatial_vector()
            velocity = wp.spatial_vector()
            turning = wp.vec3()
            if model.body_root[k] >= 0:
                force = wp.spatial_top(scratch.bias[k]) + wp.transpose(scratch.H[k]) * scratch.Du[k]
                falling = -(factors.root_inverse_mass[k] * force)
                acceleration = wp.spatial_vector(falling, wp.vec3())
                prediction_out.joint_xd_free[k] = joints.joint_xd[k] + dt * falling
                velocity = wp.spatial_vector(prediction_out.joint_xd_free[k], wp.vec3())
        elif parent != k - model.pitch:
            acceleration = prediction_out.body_acceleration[parent]
            velocity = prediction_out.body_qd_free[parent]
            turning = wp.spatial_bottom(bodies.body_qd[parent])
        acceleration, rate, velocity = accelerate_body(
            dt, acceleration, velocity, turning, omega, lever, axes, qd, DJ, DH, Du
        )
        prediction_out.body_acceleration[k] = acceleration
        prediction_out.joint_qd_free[k] = rate
        prediction_out.body_qd_free[k] = velocity


@wp.kernel
def predict_lean(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    is_branching: wp.array(dtype=wp.bool),
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    tree_phi: wp.array(dtype=float),
    tree_euler_steps: wp.array(dtype=wp.int32),
    tree_steps: wp.array(dtype=wp.int32),
    forces: AppliedForces,
    joints: JointState,
    # out
    tree_phi_out: wp.array(dtype=float),
    bodies_out: BodyState,
    factors_out: Factors,
    scratch_out: Scratch,
    prediction_out: Prediction,
):
    """One thread per tree. Solve the tree's motion, with the arguments and results of
    :func:`vinesim.kernels.plants.prediction.predict`.

    is_branching: [body] whether a body is the parent of a body other than the next one. Trees that must conserve
    energy, because phi = 1/2 (the implicitness of the integrator: trapezoidal rule), use the passes of :func:`predict`.
    """
    if wp.tid() >= count[0]:
        return
    tree = trees[wp.tid()]
    phi = chosen_phi(p, model, joints, tree, tree_phi[tree], tree_euler_steps[tree])
    tree_phi_out[tree] = phi
    step = substep_parameters(p, tree_steps[tree])
    if is_conservative(step, phi):
        predict_tree(step, model, forces, joints, tree, phi, bodies_out, factors_out, scratch_out, prediction_out)
    else:
        place_bodies(model, joints, is_branching, tree, bodies_out, factors_out, scratch_out)
        eliminate_bodies(step, model, forces, joints, bodies_out, is_branching, tree, phi, factors_out, scratch_out)
        accelerate_tree(step.dt, model, joints, bodies_out, factors_out, scratch_out, tree, prediction_out)
