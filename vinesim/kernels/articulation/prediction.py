"""Prediction: the motion of each tree over a step without new contacts, by the articulated-body algorithm.

Featherstone, Rigid Body Dynamics Algorithms, 2008, section 7.3: one pass outward for kinematics, inertia and bias of
each body, one inward that eliminates the joints, one outward for accelerations. Springs, ties, drag and the stiffness
that loads lend to levers are implicit; :mod:`vinesim.kernels.articulation` states the scheme.
"""

import warp as wp

from vinesim.kernels.articulation.contiguous import (
    contiguous_bodies,
    contiguous_factors,
    contiguous_forces,
    contiguous_joints,
    contiguous_model,
    contiguous_prediction,
    contiguous_scratch,
)
from vinesim.kernels.articulation.forces import (
    drag_coefficient,
    residual_damping,
    shear_stiffness,
    spring_torque,
    tension_stiffness,
    tie_force,
)
from vinesim.kernels.articulation.kinematics import body_kinematics, max_joint_rate, parent_kinematics
from vinesim.kernels.articulation.spatial import (
    cross_rows,
    half_rotation,
    point_mass_inertia,
    rotated_diagonal,
    world_inertia,
)
from vinesim.kernels.articulation.structs import (
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
def add_tie(
    k: int,
    point: wp.vec3,
    anchor: wp.vec3,
    anchor_velocity: wp.vec3,
    stiffness: float,
    damping: float,
    phi: float,
    dt: float,
    pose: wp.transform,
    motion: wp.spatial_vector,
    scratch_out: Scratch,
):
    """Add one tie to body k: spring and damper as a mass at its point, and their force."""
    omega = wp.spatial_bottom(motion)
    stretch = wp.transform_get_translation(pose) + point - anchor
    damper = residual_damping(damping, stiffness, phi, dt)
    mass = phi * dt * (phi * dt * stiffness + damper)
    swing = wp.cross(omega, point)
    force = tie_force(stiffness, damper, stretch, wp.spatial_top(motion) + swing - anchor_velocity, phi, dt)
    force = force - mass * wp.cross(omega, swing)
    scratch_out.J[k] = scratch_out.J[k] + point_mass_inertia(mass, point)
    scratch_out.H[k] = scratch_out.H[k] + mass * wp.skew(point)
    scratch_out.M[k] = scratch_out.M[k] + mass * wp.identity(n=3, dtype=float)
    scratch_out.bias[k] = scratch_out.bias[k] + wp.spatial_vector(-force, -wp.cross(point, force))
    scratch_out.tension[k] = scratch_out.tension[k] - stiffness * stretch


@wp.func
def add_drag(
    k: int,
    coefficient: float,
    wind: wp.vec3,
    com: wp.vec3,
    slip: wp.vec3,
    ahead: float,
    reach: float,
    dt: float,
    scratch_out: Scratch,
):
    """Add the drag of a relative ``wind`` [m/s] at the centre of mass of body k, as a mass there and its force."""
    force = coefficient * wind
    scratch_out.J[k] = (
        scratch_out.J[k] + point_mass_inertia(dt * coefficient, com) + reach * tension_stiffness(com, force)
    )
    scratch_out.H[k] = scratch_out.H[k] + dt * coefficient * wp.skew(com)
    scratch_out.M[k] = scratch_out.M[k] + dt * coefficient * wp.identity(n=3, dtype=float)
    scratch_out.bias[k] = scratch_out.bias[k] + wp.spatial_vector(
        -coefficient * wind, -coefficient * wp.cross(com + ahead * slip, wind)
    )
    scratch_out.tension[k] = scratch_out.tension[k] + coefficient * wind


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
    """From the root to the tips of one tree: pose and velocity of each body, its own implicit inertia, bias, tension."""
    ahead = p.geometric_stiffness * (1.0 - phi) * p.dt
    reach = p.geometric_stiffness * phi * phi * p.dt * p.dt
    conservative = p.geometric_stiffness > 0.0 and phi == 0.5
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
        velocity = wp.spatial_top(motion)
        omega = wp.spatial_bottom(motion)
        mass = model.body_mass[k]
        rotation = wp.quat_to_matrix(wp.transform_get_rotation(pose))
        com = rotation * model.body_com[k]
        inertia = world_inertia(rotation, model.body_inertia[k], model.body_product[k])
        load = forces.body_load[k]
        slip = wp.cross(omega, com)  # velocity of the centre of mass against the origin
        spin_drag = p.dt * wp.max(wp.length_sq(omega) - p.fast_rate * p.fast_rate, 0.0)
        implicit_scale = 1.0 + p.dt * spin_drag
        dragged_velocity = velocity + slip
        weight = mass * p.gravity
        steady_force = weight
        if model.body_root[k] >= 0:  # weight does not draw out what falls, and drag does not hold back its fall
            dragged_velocity = dragged_velocity - joints.joint_xd[model.body_root[k]]
            weight = implicit_scale * weight
            steady_force = wp.vec3()
        force = mass * (wp.cross(omega, slip) + spin_drag * dragged_velocity) - weight
        moment = (
            wp.cross(omega, inertia * omega)
            + wp.cross(com, force)
            + spin_drag * (inertia * omega)
            - ahead * wp.cross(slip, steady_force)
        )
        scratch_out.bias[k] = wp.spatial_vector(force, moment) - load
        scratch_out.tension[k] = steady_force + wp.spatial_top(load) + wp.spatial_top(forces.body_wrench[k])
        scratch_out.J[k] = implicit_scale * (inertia + point_mass_inertia(mass, com)) + reach * tension_stiffness(
            com, steady_force
        )
        scratch_out.H[k] = implicit_scale * mass * wp.skew(com)
        scratch_out.M[k] = implicit_scale * mass * wp.identity(n=3, dtype=float)
        if conservative:
            scratch_out.J[k] = scratch_out.J[k] + reach * shear_stiffness(com, steady_force)
        area = model.body_drag[k]
        if area > 0.0:
            wind = forces.tree_air[tree] - velocity - slip
            add_drag(k, drag_coefficient(area, wind), wind, com, slip, ahead, reach, p.dt, scratch_out)
        ties = model.tie_span[k]
        for t in range(ties[0], ties[1]):
            add_tie(
                k, rotation * model.tie_point[t], forces.tie_anchor[t], forces.tie_anchor_velocity[t],
                model.tie_stiffness[t], model.tie_damping[t], phi, p.dt, pose, motion, scratch_out,
            )  # fmt: skip


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
    """Hand on to the parent that a lever bears a force across, and a joint a moment.

    Beside its spring, the joint asks alpha x moment of a parent's acceleration alpha, and its own acceleration asks as
    much of the parent (DJ holds the first).
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
def add_to_parent(
    k: int,
    parent: int,
    ahead: float,
    reach: float,
    turning: wp.vec3,
    metric: wp.mat33,
    lever: wp.vec3,
    J: wp.mat33,
    H: wp.mat33,
    M: wp.mat33,
    bias: wp.spatial_vector,
    DJ: wp.mat33,
    DH: wp.mat33,
    Du: wp.vec3,
    scratch_out: Scratch,
):
    """Add what is left of a subtree's inertia and bias, its joint eliminated, to its parent."""
    J_left = metric * DJ  # = J - J D J without the cancellation; the same for H
    H_left = metric * DH
    M_left = M - wp.transpose(H) * DH
    centripetal = wp.cross(turning, wp.cross(turning, lever))
    force = wp.spatial_top(bias) + wp.transpose(H) * Du + M_left * centripetal
    moment = wp.spatial_bottom(bias) + J * Du + H_left * centripetal + wp.cross(lever, force)
    tension = scratch_out.tension[k]
    scratch_out.tension[parent] = scratch_out.tension[parent] + tension
    M_arm = wp.transpose(cross_rows(M_left, lever))
    H_arm = cross_rows(H_left, lever)
    scratch_out.J[parent] = (
        scratch_out.J[parent]
        + reach * tension_stiffness(lever, tension)
        + J_left
        + cross_rows(M_arm, lever)
        - H_arm
        - wp.transpose(H_arm)
    )
    scratch_out.H[parent] = scratch_out.H[parent] + (H_left - M_arm)
    scratch_out.M[parent] = scratch_out.M[parent] + M_left
    scratch_out.bias[parent] = scratch_out.bias[parent] + wp.spatial_vector(
        force, moment - ahead * wp.cross(wp.cross(turning, lever), tension)
    )


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
    """From the tips to the root of one tree: factor each joint's implicit inertia and hand the rest to the parent."""
    dt = p.dt
    ahead = p.geometric_stiffness * (1.0 - phi) * dt
    reach = p.geometric_stiffness * phi * phi * dt * dt
    conservative = p.geometric_stiffness > 0.0 and phi == 0.5
    first = model.tree_first[tree]
    size = model.tree_moving[tree]
    for i in range(size):
        k = first + (size - 1 - i) * model.pitch
        parent = model.body_parent[k]
        turning = wp.vec3()
        if parent >= 0:
            turning = wp.spatial_bottom(bodies.body_qd[parent])
        half = half_rotation(joints.joint_q[k])
        frame = wp.quat_to_matrix(factors_out.axes[k] * half)
        stiffness = model.joint_stiffness[k]
        artificial = (2.0 * phi - 1.0) * dt  # [s] the scheme damps as if beta were larger by this
        damping = wp.max(model.joint_damping[k] - artificial * stiffness, wp.vec3())
        metric = rotated_diagonal(frame, phi * dt * (phi * dt * stiffness + damping))
        rate = wp.quat_rotate_inv(half, joints.joint_qd[k])
        torque = spring_torque(stiffness, joints.joint_q[k])
        spring = torque + wp.cw_mul(phi * dt * stiffness + damping, rate)
        bias = scratch_out.bias[k]
        J = scratch_out.J[k]
        H = scratch_out.H[k]
        M = scratch_out.M[k]
        # the metric acts on the rate as the joint frame sees it, hence turning x omega = turning x (joint rate)
        omega = wp.spatial_bottom(bodies.body_qd[k])
        u = metric * wp.cross(turning, omega) - frame * spring - wp.spatial_bottom(bias)
        if conservative:
            turns = turning + omega
            u = u - 0.5 * ahead * wp.cross(turns, frame * torque)
        D = wp.inverse(J + metric)
        DJ = D * J
        if conservative and parent >= 0:
            DJ = DJ - cross_rows(D, 0.5 * reach * (frame * torque))
        DH = D * H
        factors_out.D[k] = D
        factors_out.DJ[k] = DJ
        factors_out.DH[k] = DH
        Du = D * u
        scratch_out.Du[k] = Du
        if parent >= 0:
            lever = factors_out.lever[k]
            add_to_parent(k, parent, ahead, reach, turning, metric, lever, J, H, M, bias, DJ, DH, Du, scratch_out)
            if conservative:
                moment = 0.5 * reach * (frame * torque)
                centripetal = wp.cross(turning, wp.cross(turning, lever))
                couple_bending_and_twist(k, parent, reach, moment, centripetal, lever, DJ, DH, scratch_out)
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
    """From the root to the tips of one tree: accelerations, and the rates and velocities they lead to."""
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
        lever = factors.lever[k]
        alpha = wp.spatial_bottom(above)
        a = wp.spatial_top(above) + wp.cross(alpha, lever) + wp.cross(turning, wp.cross(turning, lever))
        relative = scratch.Du[k] - factors.DJ[k] * alpha - factors.DH[k] * a
        prediction_out.body_acceleration[k] = wp.spatial_vector(a, alpha + relative)
        swing = wp.spatial_bottom(bodies.body_qd[k]) - turning
        gain = dt * (relative - wp.cross(turning, swing))
        prediction_out.joint_qd_free[k] = joints.joint_qd[k] + wp.quat_rotate_inv(factors.axes[k], gain)
        omega = wp.spatial_bottom(motion)
        prediction_out.body_qd_free[k] = wp.spatial_vector(
            wp.spatial_top(motion) + wp.cross(omega, lever), omega + swing + gain
        )


@wp.kernel
def predict(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    # in
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
    """One thread solves the motion of one tree over a step without new contacts, and keeps the factors it used.

    The articulated-body algorithm (Featherstone 2008, table 7.1) with implicit springs.

    trees: [thread] which tree. tree_phi: [tree] phi asked for, 1/2 to 1; tree_phi_out: [tree] phi used, 1 for a tree
    with a joint faster than ``p.fast_rate`` or with ``tree_euler_steps`` [tree] left. tree_steps: [tree] substeps that the
    step is divided into; this is one of them. bodies_out: poses and velocities
    at the start of the step. prediction_out: accelerations over it and velocities at its end. scratch_out holds nothing
    that is needed later.
    """
    trees_model = contiguous_model(model)
    state = contiguous_joints(joints)
    bodies = contiguous_bodies(bodies_out)
    factors = contiguous_factors(factors_out)
    scratch = contiguous_scratch(scratch_out)
    tree = trees[wp.tid()]
    step = substep_parameters(p, tree_steps[tree])
    phi = tree_phi[tree]
    first = trees_model.tree_first[tree]
    fastest = max_joint_rate(state.joint_qd, first, trees_model.tree_moving[tree], trees_model.pitch)
    if fastest > p.fast_rate or tree_euler_steps[tree] > 0:
        phi = 1.0
    tree_phi_out[tree] = phi
    assemble_bodies(step, trees_model, contiguous_forces(forces), state, tree, phi, bodies, factors, scratch)
    eliminate_joints(step, trees_model, state, bodies, tree, phi, factors, scratch)
    accelerate_bodies(
        step.dt, trees_model, state, bodies, factors, scratch, tree, contiguous_prediction(prediction_out)
    )
