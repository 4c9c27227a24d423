"""Forces on single bodies: springs, geometric stiffness, ties, and air drag."""

import warp as wp

from vinesim.kernels.plants.structs import AppliedForces, ArticulationModel

wp.set_module_options({"enable_backward": False})

AIR_DENSITY = wp.constant(1.2)
"""[kg/m^3] Density of air at 20 degrees Celsius and sea level"""


@wp.func
def tension_stiffness(lever: wp.vec3, force: wp.vec3):
    """Returns the geometric stiffness [N m/rad] of a lever [m] under a steady force [N] that pulls along it; 0 if the
    force pushes."""
    along_lever = wp.max(wp.dot(lever, force), 0.0)
    share = along_lever / wp.max(wp.dot(lever, lever), 1.0e-30)
    return along_lever * wp.identity(n=3, dtype=float) - share * wp.outer(lever, lever)


@wp.func
def shear_stiffness(lever: wp.vec3, force: wp.vec3):
    """Returns the symmetric part of (d.F) 1 - d F^T minus :func:`tension_stiffness`, with d the lever and F the force:
    the geometric stiffness [N m/rad] due to compression and shear.
    """
    return (
        wp.dot(lever, force) * wp.identity(n=3, dtype=float)
        - 0.5 * (wp.outer(lever, force) + wp.outer(force, lever))
        - tension_stiffness(lever, force)
    )


@wp.func
def middle_axes_scale(q: wp.quat):
    """Returns coefficients of the relation between rates in the middle axes of a rotation q and its rotation vector
    theta.

    A rate w in the middle axes changes theta by s w + (1 - s) n n^T w, with n along theta and s the ratio of |theta| /
    2 to its sine. Returns s, (s - 1) / v^2, and v = theta / (2 s); see :func:`in_middle_axes`.
    """
    v = wp.vec3(q[0], q[1], q[2])
    v = wp.where(q[3] < 0.0, -1.0, 1.0) * v
    square = wp.dot(v, v)
    # with y = sin(|theta| / 4) and c its cosine, s = asin(y) / (y c); the polynomial is (asin(y) / y - 1) / y^2 up to
    # y^2 = 1/2, so that s errs by 5e-8 at most
    cosine = wp.sqrt(0.5 * (1.0 + wp.abs(q[3])))
    u = square / (2.0 * (1.0 + wp.abs(q[3])))
    series = -0.050192467868328094 + u * 0.08603843301534653
    series = 0.02518542669713497 + u * (0.04930693283677101 + u * series)
    series = 0.16666674613952637 + u * (0.07498478889465332 + u * (0.04510609060525894 + u * series))
    excess = (series + 1.0 / (1.0 + cosine)) / (4.0 * cosine * cosine * cosine)
    return 1.0 + excess * square, excess, v


@wp.func
def in_middle_axes(s: float, excess: float, v: wp.vec3, a: wp.vec3):
    """Returns s a + (1 - s) n n^T a; see :func:`middle_axes_scale`.

    This maps a rate in the middle axes to the rate of theta, and a gradient with respect to theta to one with respect
    to a rotation.
    """
    return s * a - excess * wp.dot(v, a) * v


@wp.func
def spring_torque(stiffness: wp.vec3, q: wp.quat):
    """Returns the torque [N m] of a joint's spring against the rotation q, in the joint's middle axes.

    The torque is the gradient of theta^T K theta / 2 with respect to a rotation of the joint, with theta the rotation
    vector of q. The middle axes are turned from the joint's axes by half of q. In them the torque is s K theta + (1 -
    s) n n^T K theta, with n along theta and s the ratio of |theta| / 2 to its sine. K theta itself is no gradient
    unless K is isotropic: it does work around a cycle of bending and twist.
    """
    s, excess, v = middle_axes_scale(q)
    return in_middle_axes(s, excess, v, wp.cw_mul(stiffness, 2.0 * s * v))


@wp.func
def residual_damping(damping: float, stiffness: float, phi: float, dt: float):
    """Returns the damping [N s/m] of a tie minus the damping that the scheme itself adds, at least 0.

    The scheme damps a spring as if its damping time (damping / stiffness) were larger by (2 phi - 1) dt, with phi the
    implicitness of the integrator (0.5 trapezoidal to 1 backward Euler).
    """
    return wp.max(damping - (2.0 * phi - 1.0) * dt * stiffness, 0.0)


@wp.func
def tie_force(stiffness: float, damping: float, stretch: wp.vec3, speed: wp.vec3, phi: float, dt: float):
    """Returns the force [N] of a tie whose point keeps its present ``speed`` relative to the anchor.

    ``damping``: the residual damping.
    """
    return -stiffness * (stretch + phi * dt * speed) - damping * speed


@wp.func
def drag_coefficient(area: float, wind: wp.vec3):
    """Returns drag force divided by relative speed [N s/m] for a drag area Cd A [m^2]. ``wind``: [m/s] velocity of the
    air relative to the body."""
    return 0.5 * AIR_DENSITY * area * wp.length(wind)


@wp.func
def tie_and_drag_wrench(
    k: int,
    dt: float,
    phi: float,
    air: wp.vec3,
    model: ArticulationModel,
    forces: AppliedForces,
    pose: wp.transform,
    motion: wp.spatial_vector,
    acceleration: wp.spatial_vector,
):
    """Returns the force [N] of ties and air on body k in the last step, and its moment about the body's origin [N m].

    These are the forces of the implicit solve, evaluated with the resulting acceleration.
    """
    velocity = wp.spatial_top(motion)
    omega = wp.spatial_bottom(motion)
    a = wp.spatial_top(acceleration)
    alpha = wp.spatial_bottom(acceleration)
    wrench = wp.spatial_vector()
    area = model.body_drag[k]
    if area > 0.0:
        com = wp.quat_rotate(wp.transform_get_rotation(pose), model.body_com[k])
        wind = air - velocity - wp.cross(omega, com)
        force = drag_coefficient(area, wind) * (wind - dt * (a + wp.cross(alpha, com)))
        wrench += wp.spatial_vector(force, wp.cross(com, force))
    ties = model.tie_span[k]
    for t in range(ties[0], ties[1]):
        point = wp.quat_rotate(wp.transform_get_rotation(pose), model.tie_point[t])
        stretch = wp.transform_get_translation(pose) + point - forces.tie_anchor[t]
        stiffness = model.tie_stiffness[t]
        damping = residual_damping(model.tie_damping[t], stiffness, phi, dt)
        implicit_mass = phi * dt * (phi * dt * stiffness + damping)
        swing = wp.cross(omega, point)
        force = tie_force(stiffness, damping, stretch, velocity + swing - forces.tie_anchor_velocity[t], phi, dt)
        force = force - implicit_mass * (a + wp.cross(alpha, point) + wp.cross(omega, swing))
        wrench += wp.spatial_vector(force, wp.cross(point, force))
    return wrench
