"""Kinematics of the trees: poses and velocities of bodies from their joints, fastest joints and roots."""

import warp as wp

from vinesim.kernels.plants.structs import ArticulationModel, BodyState, JointState

wp.set_module_options({"enable_backward": False})


@wp.func
def max_joint_rate(rates: wp.array(dtype=wp.vec3), first: int, size: int, pitch: int):
    """Returns the largest joint rate [rad/s] of ``size`` bodies; NaN if one rate is NaN.

    This is a separate function because Warp's adjoint of a kernel does not run the kernel's loops again before the
    backward pass, but does call functions again.
    """
    most = float(0.0)
    for k in range(first, first + size * pitch, pitch):
        rate = wp.length(rates[k])
        if rate > most or rate != rate:
            most = rate
    return most


@wp.func
def max_rate_and_speed(
    rates: wp.array(dtype=wp.vec3),
    places: wp.array(dtype=wp.vec3),
    speeds: wp.array(dtype=wp.vec3),
    body_parent: wp.array(dtype=wp.int32),
    body_root: wp.array(dtype=wp.int32),
    first: int,
    size: int,
    pitch: int,
):
    """Returns the largest joint rate [rad/s] and the largest speed of floating roots [m/s].

    Both are NaN if a rate, speed or position is NaN.
    """
    turning = float(0.0)
    falling = float(0.0)
    for k in range(first, first + size * pitch, pitch):
        parent = body_parent[k]
        root = body_root[k]
        rate = wp.length(rates[k])
        if rate > turning or rate != rate:
            turning = rate
        if parent < 0 and root >= 0:
            speed = wp.length(speeds[k]) + 0.0 * wp.length(places[k])
            if speed > falling or speed != speed:
                falling = speed
    return turning, falling


@wp.func
def body_kinematics(
    parent_pose: wp.transform,
    parent_velocity: wp.spatial_vector,
    offset: wp.vec3,
    rest: wp.quat,
    joint_q: wp.quat,
    joint_qd: wp.vec3,
):
    """Returns a body's joint axes and lever [m] in the world, pose and velocity, from pose and velocity of its
    parent."""
    turning = wp.spatial_bottom(parent_velocity)
    axes = wp.transform_get_rotation(parent_pose) * rest
    lever = wp.quat_rotate(wp.transform_get_rotation(parent_pose), offset)
    pose = wp.transform(wp.transform_get_translation(parent_pose) + lever, axes * joint_q)
    velocity = wp.spatial_vector(
        wp.spatial_top(parent_velocity) + wp.cross(turning, lever), turning + wp.quat_rotate(axes, joint_qd)
    )
    return axes, lever, pose, velocity


@wp.func
def parent_kinematics(k: int, tree: int, model: ArticulationModel, joints: JointState, bodies: BodyState):
    """Returns pose and velocity of the frame to which the joint of body k is attached: its parent, the tree's fixed
    pose, or the world's origin for a floating root.
    """
    parent = model.body_parent[k]
    pose = model.tree_pose[tree]
    velocity = wp.spatial_vector()
    if parent >= 0:
        pose = bodies.body_q[parent]
        velocity = bodies.body_qd[parent]
    elif model.body_root[k] >= 0:
        pose = wp.transform(joints.joint_x[k], wp.quat_identity())
        velocity = wp.spatial_vector(joints.joint_xd[k], wp.vec3())
    return pose, velocity


@wp.kernel
def forward_kinematics(
    # model
    model: ArticulationModel,
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    joints: JointState,
    # out
    bodies_out: BodyState,
):
    """One thread per tree. Compute poses and velocities of its bodies from the joints, including the clusters of a
    coarse tree.

    The outward pass of the recursive Newton-Euler algorithm (Featherstone 2008, section 5.3), velocities only.

    trees: [thread] index of the tree. joints, bodies_out: [body] see their structs. Nothing else is written, so this
    may run between a prediction and its integration.
    """
    if wp.tid() >= count[0]:
        return
    tree = trees[wp.tid()]
    first = model.tree_first[tree]
    for k in range(first, first + model.tree_size[tree] * model.pitch, model.pitch):
        above, motion = parent_kinematics(k, tree, model, joints, bodies_out)
        _axes, _lever, pose, velocity = body_kinematics(
            above, motion, model.body_offset[k], model.body_rest[k], joints.joint_q[k], joints.joint_qd[k]
        )
        bodies_out.body_q[k] = pose
        bodies_out.body_qd[k] = velocity
