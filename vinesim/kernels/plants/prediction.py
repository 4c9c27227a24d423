"""Prediction: the motion of each tree over a step without the contacts of this step, by the articulated-body algorithm.

Featherstone, Rigid Body Dynamics Algorithms, 2008, section 7.3: one pass outward for kinematics, inertia and bias of
each body, one inward that eliminates the joints, one outward for accelerations. Springs, ties, drag and geometric
stiffness are implicit; :mod:`vinesim.kernels.plants` describes the scheme.
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
from vinesim.kernels.plants.forces import shear_stiffness
from vinesim.kernels.plants.kinematics import body_kinematics, max_joint_rate, parent_kinematics
from vinesim.kernels.plants.spatial import cross_rows, inverse_symmetric, symmetric, world_inertia
from vinesim.kernels.plants.structs import (
    AppliedForces,
    ArticulationModel,
    BodyState,
    Factors,
    JointState,
    Prediction,
    Scratch,
    SolverParameters,
    lever_time,
    substep_parameters,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def is_conservative(p: SolverParameters, phi: float):
    """Returns whether a step must conserve energy: with phi = 1/2, the trapezoidal rule. Such steps include the
    coupling of bending and twist. ``phi``: implicitness of the integrator, 0.5 trapezoidal to 1 backward Euler."""
    return p.geometric_stiffness > 0.0 and phi == 0.5


@wp.func
def add_terms(
    k: int, J: wp.mat33, H: wp.mat33, M: wp.mat33, bias: wp.spatial_vector, tension: wp.vec3, scratch_out: Scratch
):
    """Add terms (of a child, a tie, drag) to the implicit inertia J, H, M, the bias and the tension of body k."""
    scratch_out.J[k] = scratch_out.J[k] + J
    scratch_out.H[k] = scratch_out.H[k] + H
    scratch_out.M[k] = scratch_out.M[k] + M
    scratch_out.bias[k] = scratch_out.bias[k] + bias
    scratch_out.tension[k] = scratch_out.tension[k] + tension


@wp.func
def assemble_bodies(
    p: SolverParameters,
    model: ArticulationModel,
    forces: AppliedForces,
    joints: JointState,
    tree: int,
    phi: float,
    bodies_out: BodyState,
    factors_out: Factors,
    scratch_out: Scratch,
):
    """From the root to the tips of one tree: compute each body's pose, velocity, implicit inertia, bias and tension."""
    reach = p.geometric_stiffness * phi * phi * p.dt * p.dt
    conservative = is_conservative(p, phi)
    first = model.tree_first[tree]
    for k in range(first, first + model.tree_moving[tree] * model.pitch, model.pitch):
        above, above_motion = parent_kinematics(k, tree, model, joints, bodies_out)
        axes, lever, pose, motion = body_kinematics(
            above, above_motion, model.body_offset[k], model.body_rest[k], joints.joint_q[k], joints.joint_qd[k]
        )
        bodies_out.body_q[k] = pose
        bodies_out.body_qd[k] = motion
        factors_out.axes[k] = axes
        factors_out.lever[k] = lever
        rotation = wp.quat_to_matrix(wp.transform_get_rotation(pose))
        com = rotation * model.body_com[k]
        inertia = world_inertia(rotation, model.body_inertia[k], model.body_product[k])
        falls = float(0.0)
        fall = wp.vec3()
        if model.body_falls[k]:
            falls = 1.0
            fall = joints.joint_xd[model.body_root[k]]
        contact = wp.spatial_top(forces.body_wrench[k])
        load = forces.body_load[k]
        if model.body_parent[k] < 0:
            load = load + wp.spatial_vector(
                wp.vec3(),
                turned_rest_moment(
                    p.dt,
                    phi,
                    axes,
                    joints.joint_q[k],
                    model.joint_stiffness[k],
                    model.joint_damping[k],
                    forces.root_turn[tree],
                    forces.root_turn_rate[tree],
                ),
            )
        J, H, M, bias, tension, steady_force = own_terms(
            p, phi, motion, model.body_mass[k], com, inertia, load, contact, falls, fall
        )
        scratch_out.J[k] = J
        scratch_out.H[k] = H
        scratch_out.M[k] = M
        scratch_out.bias[k] = bias
        scratch_out.tension[k] = tension
        if conservative:
            scratch_out.J[k] = scratch_out.J[k] + reach * shear_stiffness(com, steady_force)
        area = model.body_drag[k]
        if area > 0.0:
            J, H, M, bias, tension = drag_terms(p, phi, area, forces.tree_air[tree], motion, com)
            add_terms(k, J, H, M, bias, tension, scratch_out)
        ties = model.tie_span[k]
        for t in range(ties[0], ties[1]):
            J, H, M, bias, tension = tie_terms(
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
            add_terms(k, J, H, M, bias, tension, scratch_out)


@wp.func
def couple_bending_and_twist(
    k: int,
    parent: int,
    reach: float,
    moment: wp.vec3,
    centripetal: wp.vec3,
    lever: wp.vec3,
    DJ: wp.mat33,
    DH: wp.mat33,
    scratch_out: Scratch,
):
    """Add to the parent's record the coupling of bending and twist, due to a force across a lever and to the moment in
    a joint.

    An angular acceleration alpha of the parent adds the torque alpha x moment to the spring's torque on the joint, and
    the joint's own acceleration acts on the parent with the same coupling (DJ contains the first part).
    """
    H_more = wp.skew(-moment) * DH
    H_arm = cross_rows(H_more, lever)
    scratch_out.J[parent] = (
        scratch_out.J[parent]
        + reach * shear_stiffness(lever, scratch_out.tension[k])
        + wp.skew(-moment) * DJ
        + wp.skew(moment)
        - H_arm
        - wp.transpose(H_arm)
    )
    scratch_out.H[parent] = scratch_out.H[parent] + H_more
    more = wp.cross(moment, scratch_out.Du[k]) + H_more * centripetal
    scratch_out.bias[parent] = scratch_out.bias[parent] + wp.spatial_vector(wp.vec3(), more)


@wp.func
def eliminate_joints(
    p: SolverParameters,
    model: ArticulationModel,
    joints: JointState,
    bodies: BodyState,
    tree: int,
    phi: float,
    factors_out: Factors,
    scratch_out: Scratch,
):
    """From the tips to the root of one tree: factor each joint's implicit inertia and pass the rest to the parent."""
    ahead = lever_time(p, phi)
    reach = p.geometric_stiffness * phi * phi * p.dt * p.dt
    conservative = is_conservative(p, phi)
    first = model.tree_first[tree]
    size = model.tree_moving[tree]
    for i in range(size):
        k = first + (size - 1 - i) * model.pitch
        parent = model.body_parent[k]
        turning = wp.vec3()
        if parent >= 0:
            turning = wp.spatial_bottom(bodies.body_qd[parent])
        omega = wp.spatial_bottom(bodies.body_qd[k])
        metric, drive, torque = joint_terms(
            p.dt,
            phi,
            factors_out.axes[k],
            joints.joint_q[k],
            joints.joint_qd[k],
            model.joint_stiffness[k],
            model.joint_damping[k],
            turning,
            omega,
        )
        bias = scratch_out.bias[k]
        J = symmetric(scratch_out.J[k])
        H = scratch_out.H[k]
        M = symmetric(scratch_out.M[k])
        u = drive - wp.spatial_bottom(bias)
        if conservative:
            turns = turning + omega
            u = u - 0.5 * ahead * wp.cross(turns, torque)
        D = inverse_symmetric(J + metric)
        DJ = D * J
        if conservative and parent >= 0:
            DJ = DJ - cross_rows(D, 0.5 * reach * torque)
        DH = D * H
        factors_out.D[k] = D
        factors_out.DJ[k] = DJ
        factors_out.DH[k] = DH
        Du = D * u
        scratch_out.Du[k] = Du
        if parent >= 0:
            lever = factors_out.lever[k]
            tension = scratch_out.tension[k]
            J_left, H_left, M_left, bias_left = terms_left(
                p, phi, turning, metric, lever, J, H, M, bias, tension, DJ, DH, Du
            )
            add_terms(parent, J_left, H_left, M_left, bias_left, tension, scratch_out)
            if conservative:
                centripetal = wp.cross(turning, wp.cross(turning, lever))
                couple_bending_and_twist(
                    k, parent, reach, 0.5 * reach * torque, centripetal, lever, DJ, DH, scratch_out
                )
        else:
            factors_out.root_inverse_mass[k] = wp.mat33()
            if model.body_root[k] >= 0:
                factors_out.root_inverse_mass[k] = wp.inverse(M - wp.transpose(H) * DH)


@wp.func
def accelerate_bodies(
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
    for k in range(first, first + model.tree_moving[tree] * model.pitch, model.pitch):
        parent = model.body_parent[k]
        above = wp.spatial_vector()
        motion = wp.spatial_vector()
        turning = wp.vec3()
        if parent >= 0:
            above = prediction_out.body_acceleration[parent]
            motion = prediction_out.body_qd_free[parent]
            turning = wp.spatial_bottom(bodies.body_qd[parent])
        elif model.body_root[k] >= 0:
            force = wp.spatial_top(scratch.bias[k]) + wp.transpose(scratch.H[k]) * scratch.Du[k]
            falling = -(factors.root_inverse_mass[k] * force)
            above = wp.spatial_vector(falling, wp.vec3())
            prediction_out.joint_xd_free[k] = joints.joint_xd[k] + dt * falling
            motion = wp.spatial_vector(prediction_out.joint_xd_free[k], wp.vec3())
        acceleration, rate, velocity = accelerate_body(
            dt,
            above,
            motion,
            turning,
            wp.spatial_bottom(bodies.body_qd[k]),
            factors.lever[k],
            factors.axes[k],
            joints.joint_qd[k],
            factors.DJ[k],
            factors.DH[k],
            scratch.Du[k],
        )
        prediction_out.body_acceleration[k] = acceleration
        prediction_out.joint_qd_free[k] = rate
        prediction_out.body_qd_free[k] = velocity


@wp.func
def chosen_phi(
    p: SolverParameters, model: ArticulationModel, joints: JointState, tree: int, asked: float, euler_steps: int
):
    """Returns phi (implicitness of the integrator, 0.5 trapezoidal to 1 backward Euler) for this step of a tree: 1 if a
    joint is faster than ``p.fast_rate`` or ``euler_steps`` is above 0, otherwise ``asked``."""
    fastest = max_joint_rate(joints.joint_qd, model.tree_first[tree], model.tree_moving[tree], model.pitch)
    phi = asked
    if fastest > p.fast_rate or euler_steps > 0:
        phi = 1.0
    return phi


@wp.func
def predict_tree(
    p: SolverParameters,
    model: ArticulationModel,
    forces: AppliedForces,
    joints: JointState,
    tree: int,
    phi: float,
    bodies_out: BodyState,
    factors_out: Factors,
    scratch_out: Scratch,
    prediction_out: Prediction,
):
    """Run the three passes over one tree."""
    assemble_bodies(p, model, forces, joints, tree, phi, bodies_out, factors_out, scratch_out)
    eliminate_joints(p, model, joints, bodies_out, tree, phi, factors_out, scratch_out)
    accelerate_bodies(p.dt, model, joints, bodies_out, factors_out, scratch_out, tree, prediction_out)


@wp.kernel
def predict(
    # model
    p: SolverParameters,
    model: ArticulationModel,
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
    """One thread per tree. Solve its motion over a step without the contacts of this step, and store the factors for
    impulse responses.

    The articulated-body algorithm (Featherstone 2008, table 7.1) with implicit springs.

    trees: [thread] index of the tree. tree_phi: [tree] requested phi (implicitness of the integrator, 0.5 trapezoidal
    to 1 backward Euler). tree_phi_out: [tree] phi used, 1 for a tree with a joint faster than ``p.fast_rate`` or with
    ``tree_euler_steps`` [tree] left. tree_steps: [tree] number of substeps of the step; this launch computes one
    substep. bodies_out: poses and velocities at the start of the step. prediction_out: accelerations over the step and
    velocities at its end. scratch_out: scratch; later kernels do not need it.
    """
    if wp.tid() >= count[0]:
        return
    tree = trees[wp.tid()]
    phi = chosen_phi(p, model, joints, tree, tree_phi[tree], tree_euler_steps[tree])
    tree_phi_out[tree] = phi
    predict_tree(
        substep_parameters(p, tree_steps[tree]),
        model,
        forces,
        joints,
        tree,
        phi,
        bodies_out,
        factors_out,
        scratch_out,
        prediction_out,
    )
