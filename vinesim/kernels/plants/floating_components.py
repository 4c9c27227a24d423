"""Floating components: corrects momentum and path of bodies that were cut off and fall, so that both agree exactly with
the external forces.

The integration of joints changes the momentum of a free tree by an error of about dt^2. So the root's pose and rate are
corrected after the integration, until linear and angular momentum and the centre of mass are exact (angular momentum
not in the first steps of a contact, see below).

The component's centre of mass moves, and its root turns, at the mean of the rates before and after the step. A
component with contacts moves at the rate after the step instead, as the contact solve assumes. With the mean rate it
would penetrate the other body by half of its previous motion in a step, and pass through a wire from 1.5 m/s on.

Components held by a tie are left out. The force of a stiff tie turns with the bodies that hang from it, but the
momentum balance would use the force at the start of the step. This would be Euler's explicit method for a pendulum,
which gains (w dt)^2 of its kinetic energy in each step.
"""

import warp as wp

from vinesim.kernels.plants.forces import tie_and_drag_wrench
from vinesim.kernels.plants.spatial import exponential, point_mass_inertia, world_inertia
from vinesim.kernels.plants.structs import (
    AppliedForces,
    ArticulationModel,
    BodyState,
    FloatingScratch,
    JointState,
    SolverParameters,
    substep_parameters,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def least_change(inertia: wp.mat33, momentum: wp.vec3, missing: wp.vec3, dt: float):
    """Returns the vector x that defines the smallest change of pose and rate that adds the ``missing`` angular momentum
    [N m s].

    The change of pose is momentum x dt times x, the change of rate inertia / dt times x. A change of rate is measured
    by the rotation that it causes in a step, so a thin rod gets a rotation rather than a spin.
    """
    stiff = inertia / dt
    A = stiff * stiff + (wp.dot(momentum, momentum) * wp.identity(n=3, dtype=float) - wp.outer(momentum, momentum))
    x = wp.inverse(wp.mat33d(A)) * wp.vec3d(missing)
    return wp.vec3(x) / dt


@wp.func
def component_before(
    p: SolverParameters,
    model: ArticulationModel,
    forces: AppliedForces,
    bodies: BodyState,
    body_acceleration: wp.array(dtype=wp.spatial_vector),
    lever: wp.array(dtype=wp.vec3),
    root: int,
    last: int,
    phi: float,
    scratch_out: FloatingScratch,
):
    """Returns sums over the bodies of a component at the start of the step, about its root and relative to the root's
    motion.

    They are mass [kg], mass times centre of mass [kg m], linear [N s] and angular [N m s] momentum, force [N] and
    moment [N m] of all external forces except gravity over the step, and whether contacts are among these forces.
    """
    tree = model.body_tree[root]
    mass = float(0.0)
    mass_com = wp.vec3()
    linear = wp.vec3()
    angular = wp.vec3()
    force = wp.vec3()
    moment = wp.vec3()
    is_pressed = bool(False)
    for k in range(root, last, model.pitch):
        if model.body_root[k] == root:
            is_pressed = is_pressed or wp.length_sq(forces.body_wrench[k]) > 0.0
            arm = wp.vec3()
            velocity = wp.vec3()
            if k > root:  # not from world positions and velocities, which lose digits in a fall
                above = model.body_parent[k]
                arm = wp.spatial_top(scratch_out.before[above]) + lever[k]
                velocity = wp.spatial_bottom(scratch_out.before[above])
                velocity += wp.cross(wp.spatial_bottom(bodies.body_qd[above]), lever[k])
            scratch_out.before[k] = wp.spatial_vector(arm, velocity)
            pose = bodies.body_q[k]
            omega = wp.spatial_bottom(bodies.body_qd[k])
            rotation = wp.quat_to_matrix(wp.transform_get_rotation(pose))
            com = rotation * model.body_com[k]
            momentum = model.body_mass[k] * (velocity + wp.cross(omega, com))
            given = forces.body_load[k] + forces.body_wrench[k]
            given += tie_and_drag_wrench(
                k, p.dt, phi, forces.tree_air[tree], model, forces, pose, bodies.body_qd[k], body_acceleration[k]
            )
            mass += model.body_mass[k]
            mass_com += model.body_mass[k] * (arm + com)
            linear += momentum
            inertia = world_inertia(rotation, model.body_inertia[k], model.body_product[k])
            angular += wp.cross(arm + com, momentum) + inertia * omega
            force += wp.spatial_top(given)
            moment += wp.cross(arm, wp.spatial_top(given)) + wp.spatial_bottom(given)
    return mass, mass_com, linear, angular, force, moment, is_pressed


@wp.func
def component_after(model: ArticulationModel, joints: JointState, root: int, last: int, scratch_out: FloatingScratch):
    """Returns sums over the bodies of a component at the end of the step, like :func:`component_before`, and its moment
    of inertia with locked joints.

    They are mass times centre of mass [kg m], linear [N s] and angular [N m s] momentum, inertia [kg m^2], all about
    the root and relative to its motion.
    """
    mass_com = wp.vec3()
    linear = wp.vec3()
    angular = wp.vec3()
    locked = wp.mat33()
    for k in range(root, last, model.pitch):
        if model.body_root[k] == root:
            base = wp.transform(wp.vec3(), wp.quat_identity())
            motion = wp.spatial_vector()
            if k > root:
                base = scratch_out.after_q[model.body_parent[k]]
                motion = scratch_out.after_qd[model.body_parent[k]]
            turning = wp.spatial_bottom(motion)
            axes = wp.transform_get_rotation(base) * model.body_rest[k]
            lever = wp.quat_rotate(wp.transform_get_rotation(base), model.body_offset[k])
            arm = wp.transform_get_translation(base) + lever
            q = axes * joints.joint_q[k]
            omega = turning + wp.quat_rotate(axes, joints.joint_qd[k])
            velocity = wp.spatial_top(motion) + wp.cross(turning, lever)
            scratch_out.after_q[k] = wp.transform(arm, q)
            scratch_out.after_qd[k] = wp.spatial_vector(velocity, omega)
            rotation = wp.quat_to_matrix(q)
            com = rotation * model.body_com[k]
            inertia = world_inertia(rotation, model.body_inertia[k], model.body_product[k])
            momentum = model.body_mass[k] * (velocity + wp.cross(omega, com))
            mass_com += model.body_mass[k] * (arm + com)
            linear += momentum
            angular += wp.cross(arm + com, momentum) + inertia * omega
            locked += inertia + point_mass_inertia(model.body_mass[k], arm + com)
    return mass_com, linear, angular, locked


@wp.func
def angular_correction(locked: wp.mat33, angular: wp.vec3, goal: wp.vec3, dt: float):
    """Returns the rotation and rate [rad/s] that give a component the ``goal`` angular momentum [N m s] when added to
    it.

    Newton's method is needed because angular momentum and inertia turn with the component.
    """
    rotation = wp.quat_identity()
    rate = wp.vec3()
    for _ in range(3):
        frame = wp.quat_to_matrix(rotation)
        inertia = frame * locked * wp.transpose(frame)
        own = frame * angular + inertia * rate
        least = least_change(inertia, own, goal - own, dt)
        added = exponential(dt * wp.cross(own, least))
        rotation = added * rotation
        rate = wp.quat_rotate(added, rate) + inertia * least / dt
    return rotation, rate


@wp.kernel
def correct_floating_momentum(
    # model
    p: SolverParameters,
    model: ArticulationModel,
    # in
    count: wp.array(dtype=wp.int32),
    roots: wp.array(dtype=wp.int32),
    tree_phi: wp.array(dtype=float),
    tree_rate: wp.array(dtype=float),
    tree_steps: wp.array(dtype=wp.int32),
    forces: AppliedForces,
    bodies: BodyState,
    body_acceleration: wp.array(dtype=wp.spatial_vector),
    lever: wp.array(dtype=wp.vec3),
    # out
    scratch_out: FloatingScratch,
    joints_out: JointState,
):
    """One thread per floating component. Correct its momentum and the path of its centre of mass to agree with the
    external forces.

    roots: [thread] the cut body of a component that no tie holds; -1: none. Nothing happens in a tree with tree_rate [tree] above
    ``p.fault_rate``. tree_steps: [tree] number of substeps of the step; this launch corrects one substep. bodies: at
    the start of the step. body_acceleration: [body] m/s^2, rad/s^2 over the step. lever: [body] m. joints_out: joints
    at the end of the step; rotation, rates and position of the root are corrected.
    """
    if wp.tid() >= count[0]:
        return
    root = roots[wp.tid()]
    if root < 0:
        return
    tree = model.body_tree[root]
    step = substep_parameters(p, tree_steps[tree])
    dt = step.dt
    if not tree_rate[tree] <= p.fault_rate:
        return
    last = model.tree_first[tree] + model.tree_moving[tree] * model.pitch

    # the required momentum and path
    place = wp.transform_get_translation(bodies.body_q[root])
    velocity = wp.spatial_top(bodies.body_qd[root])
    mass, mass_com, linear, angular, force, moment, is_pressed = component_before(
        step, model, forces, bodies, body_acceleration, lever, root, last, tree_phi[tree], scratch_out
    )
    com = mass_com / mass
    goal_linear = linear + dt * (force + mass * p.gravity)
    goal_angular = angular - wp.cross(com, linear) + dt * (moment - wp.cross(com, force))
    path = com + dt * (velocity + 0.5 / mass * (linear + goal_linear))
    if is_pressed and tree_phi[tree] == 1.0:
        path = com + dt * (velocity + goal_linear / mass)
    if tree_phi[tree] == 1.0:  # like the joints beyond it: after a blow, rates change much in each step
        turned = exponential(dt * joints_out.joint_qd[root]) * wp.transform_get_rotation(bodies.body_q[root])
        joints_out.joint_q[root] = wp.normalize(turned)

    # the present momentum and path, and the difference
    moved = joints_out.joint_x[root] - place
    mass_com_now, linear_now, angular_now, locked = component_after(model, joints_out, root, last, scratch_out)
    com_now = mass_com_now / mass
    angular_now = angular_now - wp.cross(com_now, linear_now)
    locked = locked - point_mass_inertia(mass, com_now)
    rotation = wp.quat_identity()
    turn = wp.vec3()
    if not (is_pressed and tree_phi[tree] == 1.0):
        rotation, turn = angular_correction(locked, angular_now, goal_angular, dt)
    rate = wp.quat_rotate(rotation, joints_out.joint_qd[root]) + turn
    square = wp.length_sq(rate)
    if square > p.max_rate * p.max_rate:
        turn = turn + rate * (p.max_rate / wp.sqrt(square) - 1.0)
        rate = rate * (p.max_rate / wp.sqrt(square))
    com_now = wp.quat_rotate(rotation, com_now)
    joints_out.joint_q[root] = wp.normalize(rotation * joints_out.joint_q[root])
    joints_out.joint_qd[root] = rate
    joints_out.joint_xd[root] = (
        velocity + (goal_linear - wp.quat_rotate(rotation, linear_now)) / mass - wp.cross(turn, com_now)
    )
    joints_out.joint_x[root] = joints_out.joint_x[root] + (path - moved - com_now)
