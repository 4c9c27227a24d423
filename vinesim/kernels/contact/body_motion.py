"""Motion of bodies within one step: velocities of material points, and their positions at the end of the step."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def to_double(v: wp.vec3):
    """Converts a vector from single to double precision."""
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def to_single(v: wp.vec3d):
    """Converts a vector from double to single precision."""
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.func
def velocity_at(pose: wp.transform, velocity: wp.spatial_vector, point: wp.vec3d):
    """Returns the velocity [m/s] of the material point of a body that is at ``point`` [m], both in the world.

    ``pose``, ``velocity`` (linear, angular): pose and velocity of the body's origin.
    """
    lever = point - to_double(wp.transform_get_translation(pose))
    return to_double(wp.spatial_top(velocity)) + wp.cross(to_double(wp.spatial_bottom(velocity)), lever)


@wp.func
def rotate_by_small_angle(angle: wp.vec3d, rotation: wp.mat33d):
    """Returns ``rotation`` turned by the rotation vector ``angle`` [rad], exact to second order in the angle."""
    columns = wp.transpose(rotation)
    x = columns[0] + wp.cross(angle, columns[0] + wp.float64(0.5) * wp.cross(angle, columns[0]))
    y = columns[1] + wp.cross(angle, columns[1] + wp.float64(0.5) * wp.cross(angle, columns[1]))
    z = columns[2] + wp.cross(angle, columns[2] + wp.float64(0.5) * wp.cross(angle, columns[2]))
    return wp.matrix_from_cols(x, y, z)


@wp.func
def extrapolate_point(
    dt: float, pose: wp.transform, velocity: wp.spatial_vector, acceleration: wp.spatial_vector, point: wp.vec3
):
    """Returns the position of a body's material point after a step of ``dt`` [s], to second order in dt."""
    arm = point - wp.transform_get_translation(pose)
    omega = wp.spatial_bottom(velocity)
    linear = wp.spatial_top(velocity) + wp.cross(omega, arm)
    centripetal = wp.cross(omega, wp.cross(omega, arm))
    tangential = wp.cross(wp.spatial_bottom(acceleration), arm)
    return point + dt * (linear + 0.5 * dt * (wp.spatial_top(acceleration) + tangential + centripetal))


@wp.func
def velocity_product_acceleration(
    body: int,
    known: int,
    known_acceleration: wp.spatial_vector,
    body_parent: wp.array(dtype=wp.int32),
    body_cut: wp.array(dtype=wp.bool),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
):
    """Returns a body's acceleration (linear, angular) while all joints between it and its root turn at constant rates.

    ``known``: a body with a known acceleration, -1 for none. If it is an ancestor of ``body``, only the joints between
    the two bodies are visited. Featherstone, Rigid Body Dynamics Algorithms (2008), section 5.3: the velocity-product
    accelerations.
    """
    origin = wp.transform_get_translation(body_q[body])
    linear = wp.vec3()
    angular = wp.vec3()
    k = int(body)
    joint = origin
    turning = wp.spatial_bottom(body_qd[body])
    parent = wp.where(body_cut[body], -1, body_parent[body])
    while k >= 0 and k != known:
        if parent >= 0:
            above = wp.transform_get_translation(body_q[parent])
            omega = wp.spatial_bottom(body_qd[parent])
            further = body_parent[parent]  # read with the rest, so that a GPU waits for memory once a body
            is_cut = body_cut[parent]
            relative = wp.cross(omega, turning)
            angular += relative
            linear += wp.cross(relative, origin - joint)
            linear += wp.cross(omega, wp.cross(omega, joint - above))
            joint = above
            turning = omega
            k = parent
            parent = wp.where(is_cut, -1, further)
        else:
            k = -1
    if k >= 0:
        turn = wp.spatial_bottom(known_acceleration)
        angular += turn
        linear += wp.spatial_top(known_acceleration)
        linear += wp.cross(turn, origin - joint)
    return wp.spatial_vector(linear, angular)


@wp.func
def was_cut_off(body: int, body_parent: wp.array(dtype=wp.int32), body_cut: wp.array(dtype=wp.bool)):
    """Returns whether a joint between a body and the root of its tree was cut."""
    is_off = bool(False)
    k = int(body)
    while k >= 0 and not is_off:
        is_off = body_cut[k]
        k = body_parent[k]
    return is_off
