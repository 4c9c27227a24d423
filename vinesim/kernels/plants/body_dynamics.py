"""Dynamics of one body and its joint within a prediction, as functions of plain values.

They are the steps of the articulated-body algorithm (Featherstone 2008, table 7.1) at each body of a tree:
:mod:`vinesim.kernels.plants.prediction` calls them tree by tree, :mod:`vinesim.kernels.plants.eight_trees` for eight
trees at once. Both yield the same bits, because no function has a branch and only the upper triangle of symmetric
matrices is used.
"""

import warp as wp

from vinesim.kernels.plants.forces import (
    drag_coefficient,
    in_middle_axes,
    middle_axes_scale,
    residual_damping,
    spring_torque,
    tension_stiffness,
    tie_force,
)
from vinesim.kernels.plants.spatial import cross_rows, half_rotation, point_mass_inertia, rotated_diagonal, symmetric
from vinesim.kernels.plants.structs import SolverParameters, lever_time

wp.set_module_options({"enable_backward": False})


@wp.func
def own_terms(
    p: SolverParameters,
    phi: float,
    motion: wp.spatial_vector,
    mass: float,
    com: wp.vec3,
    inertia: wp.mat33,
    load: wp.spatial_vector,
    contact: wp.vec3,
    falls: float,
    fall: wp.vec3,
):
    """Returns the implicit inertia J, H, M of one body, its bias, and its tension: the steady force [N] that pulls on
    levers. Without ties and drag, which other functions compute.

    com: [m] centre of mass from the origin, world axes. inertia: [kg m^2] about the centre of mass. load: [N, N m]
    applied wrench. contact: [N] force of the contacts of the last step. falls: 1 for a body of a floating component
    that no tie holds, else 0. The weight of such a body causes no tension, and the drag of fast bodies does not slow
    its fall. fall: [m/s] velocity of that component's root.
    """
    ahead = lever_time(p, phi)
    reach = p.geometric_stiffness * phi * phi * p.dt * p.dt
    velocity = wp.spatial_top(motion)
    omega = wp.spatial_bottom(motion)
    slip = wp.cross(omega, com)  # velocity of the centre of mass against the origin
    spin_drag = p.dt * wp.max(wp.length_sq(omega) - p.fast_rate * p.fast_rate, 0.0)
    implicit_scale = 1.0 + p.dt * spin_drag
    weight = mass * p.gravity
    steady_force = (1.0 - falls) * weight
    force = (
        mass * (wp.cross(omega, slip) + spin_drag * (velocity + slip - fall))
        - (1.0 + falls * (implicit_scale - 1.0)) * weight
    )
    spin = inertia * omega
    moment = wp.cross(omega, spin) + wp.cross(com, force) + spin_drag * spin - ahead * wp.cross(slip, steady_force)
    bias = wp.spatial_vector(force, moment) - load
    tension = steady_force + wp.spatial_top(load) + contact
    J = implicit_scale * (inertia + point_mass_inertia(mass, com)) + reach * tension_stiffness(com, steady_force)
    H = implicit_scale * mass * wp.skew(com)
    M = implicit_scale * mass * wp.identity(n=3, dtype=float)
    return J, H, M, bias, tension, steady_force


@wp.func
def drag_terms(p: SolverParameters, phi: float, area: float, air: wp.vec3, motion: wp.spatial_vector, com: wp.vec3):
    """Returns the J, H, M, bias and tension of air drag on one body: an added mass at the centre of mass, and the drag
    force.

    air: [m/s] velocity of the air.
    """
    ahead = lever_time(p, phi)
    reach = p.geometric_stiffness * phi * phi * p.dt * p.dt
    slip = wp.cross(wp.spatial_bottom(motion), com)
    wind = air - wp.spatial_top(motion) - slip
    coefficient = drag_coefficient(area, wind)
    force = coefficient * wind
    J = point_mass_inertia(p.dt * coefficient, com) + reach * tension_stiffness(com, force)
    H = p.dt * coefficient * wp.skew(com)
    M = p.dt * coefficient * wp.identity(n=3, dtype=float)
    return J, H, M, wp.spatial_vector(-force, -coefficient * wp.cross(com + ahead * slip, wind)), force


@wp.func
def tie_terms(
    dt: float,
    phi: float,
    stiffness: float,
    damping: float,
    anchor: wp.vec3,
    anchor_velocity: wp.vec3,
    point: wp.vec3,
    origin: wp.vec3,
    motion: wp.spatial_vector,
):
    """Returns the J, H, M, bias and tension of a tie at ``point`` [m from the origin, world axes] of one body.

    Spring and damper act as an added mass at the point, and by their force. anchor, origin: [m] in the world.
    anchor_velocity: [m/s].
    """
    omega = wp.spatial_bottom(motion)
    stretch = origin + point - anchor
    damper = residual_damping(damping, stiffness, phi, dt)
    mass = phi * dt * (phi * dt * stiffness + damper)
    swing = wp.cross(omega, point)
    force = tie_force(stiffness, damper, stretch, wp.spatial_top(motion) + swing - anchor_velocity, phi, dt)
    force = force - mass * wp.cross(omega, swing)
    H = mass * wp.skew(point)
    M = mass * wp.identity(n=3, dtype=float)
    bias = wp.spatial_vector(-force, -wp.cross(point, force))
    return point_mass_inertia(mass, point), H, M, bias, -stiffness * stretch


@wp.func
def joint_terms(
    dt: float,
    phi: float,
    axes: wp.quat,
    q: wp.quat,
    qd: wp.vec3,
    stiffness: wp.vec3,
    damping: wp.vec3,
    turning: wp.vec3,
    omega: wp.vec3,
):
    """Returns a joint's metric [kg m^2], its driving torque without the bias of its subtree [N m], and its spring
    torque [N m].

    turning, omega: [rad/s] angular velocity of the parent and of the body. All in world axes.
    """
    half = half_rotation(q)
    frame = wp.quat_to_matrix(axes * half)
    artificial = (2.0 * phi - 1.0) * dt  # [s] the scheme damps as if beta were larger by this
    residual = wp.max(damping - artificial * stiffness, wp.vec3())
    metric = symmetric(rotated_diagonal(frame, phi * dt * (phi * dt * stiffness + residual)))
    rate = wp.quat_rotate_inv(half, qd)
    torque = spring_torque(stiffness, q)
    spring = torque + wp.cw_mul(phi * dt * stiffness + residual, rate)
    # the metric acts on the rate in the rotating joint frame, hence turning x omega = turning x (joint rate)
    drive = metric * wp.cross(turning, omega) - frame * spring
    return metric, drive, frame * torque


@wp.func
def turned_rest_moment(
    dt: float,
    phi: float,
    axes: wp.quat,
    q: wp.quat,
    stiffness: wp.vec3,
    damping: wp.vec3,
    turn: wp.vec3,
    turn_rate: wp.vec3,
):
    """Returns the moment [N m], world axes, on a root because its arm has turned the rest pose of its spring by
    ``turn`` [rad] and turns it at ``turn_rate`` [rad/s].

    With this moment, spring and damper of :func:`joint_terms` act on theta - turn instead of theta. axes: [xyzw] joint
    frame in the world; stiffness, damping, turn, turn_rate: in joint axes.
    """
    residual = wp.max(damping - (2.0 * phi - 1.0) * dt * stiffness, wp.vec3())
    moment = wp.cw_mul(stiffness, turn) + wp.cw_mul(phi * dt * stiffness + residual, turn_rate)
    s, excess, v = middle_axes_scale(q)
    return wp.quat_rotate(axes * half_rotation(q), in_middle_axes(s, excess, v, moment))


@wp.func
def terms_left(
    p: SolverParameters,
    phi: float,
    turning: wp.vec3,
    metric: wp.mat33,
    lever: wp.vec3,
    J: wp.mat33,
    H: wp.mat33,
    M: wp.mat33,
    bias: wp.spatial_vector,
    tension: wp.vec3,
    DJ: wp.mat33,
    DH: wp.mat33,
    Du: wp.vec3,
):
    """Returns the J, H, M and bias that a subtree passes to its parent after its joint is eliminated."""
    ahead = lever_time(p, phi)
    reach = p.geometric_stiffness * phi * phi * p.dt * p.dt
    J_left = metric * DJ  # = J - J D J without the cancellation; the same for H
    H_left = metric * DH
    M_left = symmetric(M - wp.transpose(H) * DH)
    centripetal = wp.cross(turning, wp.cross(turning, lever))
    force = wp.spatial_top(bias) + wp.transpose(H) * Du + M_left * centripetal
    moment = wp.spatial_bottom(bias) + J * Du + H_left * centripetal + wp.cross(lever, force)
    M_arm = wp.transpose(cross_rows(M_left, lever))
    H_arm = cross_rows(H_left, lever)
    J_parent = (
        reach * tension_stiffness(lever, tension) + J_left + cross_rows(M_arm, lever) - H_arm - wp.transpose(H_arm)
    )
    moment = moment - ahead * wp.cross(wp.cross(turning, lever), tension)
    return J_parent, H_left - M_arm, M_left, wp.spatial_vector(force, moment)


@wp.func
def accelerate_body(
    dt: float,
    above: wp.spatial_vector,
    motion_above: wp.spatial_vector,
    turning: wp.vec3,
    omega: wp.vec3,
    lever: wp.vec3,
    axes: wp.quat,
    qd: wp.vec3,
    DJ: wp.mat33,
    DH: wp.mat33,
    Du: wp.vec3,
):
    """Returns the acceleration of a body over the step, and its joint rate [rad/s] and velocity at the end of the step.

    above: acceleration of the parent. motion_above: velocity of the parent at the end of the step. turning, omega:
    [rad/s] angular velocity of the parent and of the body at the start of the step.
    """
    alpha = wp.spatial_bottom(above)
    a = wp.spatial_top(above) + wp.cross(alpha, lever) + wp.cross(turning, wp.cross(turning, lever))
    relative = Du - DJ * alpha - DH * a
    swing = omega - turning
    gain = dt * (relative - wp.cross(turning, swing))
    end = wp.spatial_bottom(motion_above)
    velocity = wp.spatial_vector(wp.spatial_top(motion_above) + wp.cross(end, lever), end + swing + gain)
    return wp.spatial_vector(a, alpha + relative), qd + wp.quat_rotate_inv(axes, gain), velocity
