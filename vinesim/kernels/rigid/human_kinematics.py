"""Inverse kinematics of people from tracked head, hips, feet and hands; differences of poses. Poses are [7]: m,
xyzw."""

import warp as wp

wp.set_module_options({"enable_backward": False})

HEAD = wp.constant(0)
HIPS = wp.constant(1)
LEFT_FOOT = wp.constant(2)
RIGHT_FOOT = wp.constant(3)


@wp.func
def position(poses: wp.array2d(dtype=wp.float64), i: int):
    """Returns the position [m] of row ``i`` of ``poses`` [row, 7]."""
    return wp.vec3d(poses[i, 0], poses[i, 1], poses[i, 2])


@wp.func
def orientation(poses: wp.array2d(dtype=wp.float64), i: int):
    """Returns the orientation (quaternion, xyzw) of row ``i`` of ``poses`` [row, 7]."""
    return wp.quatd(poses[i, 3], poses[i, 4], poses[i, 5], poses[i, 6])


@wp.func
def perpendicular(v: wp.vec3d, axis: wp.vec3d):
    """Returns the component of ``v`` perpendicular to the unit vector ``axis``, normalised."""
    return wp.normalize(v - wp.dot(v, axis) * axis)


@wp.func
def rotation_from_axes(x: wp.vec3d, z: wp.vec3d):
    """Returns the rotation that turns the x and z axes into the perpendicular unit vectors ``x`` and ``z``."""
    y = wp.cross(z, x)
    return wp.normalize(wp.quat_from_matrix(wp.matrix_from_cols(x, y, z)))


@wp.func
def write_pose(at: wp.vec3d, q: wp.quatd, i: int, poses_out: wp.array2d(dtype=wp.float64)):
    """Write position ``at`` [m] and orientation ``q`` into row ``i`` of ``poses_out`` [row, 7]."""
    for k in range(3):
        poses_out[i, k] = at[k]
    for k in range(4):
        poses_out[i, 3 + k] = q[k]


@wp.kernel
def pose_torso_and_legs(
    # model
    thigh: wp.float64,
    shank: wp.float64,
    hip: wp.float64,
    neck: wp.vec3d,
    # in
    tracked: wp.array2d(dtype=wp.float64),
    # out
    parts_out: wp.array2d(dtype=wp.float64),
):
    """One thread poses the left leg (thread 0), the right leg (1), or head, chest and hips (2) of a person.

    thigh, shank: lengths [m]; hip: distance of a hip joint from the middle [m]; neck: position of the neck in the
    head's frame [m]; tracked: [point, 7] head, hips, feet; parts: [part, 7] head, chest, hips, then thigh, shank and
    foot of each leg.
    """
    side = wp.tid()
    zero = wp.float64(0.0)
    x = wp.vec3d(wp.float64(1.0), zero, zero)
    hips = position(tracked, HIPS)
    ahead = wp.quat_rotate(orientation(tracked, HIPS), x)
    if side == 2:
        for k in range(7):  # copied, so that the pose is exactly the tracked one
            parts_out[0, k] = tracked[HEAD, k]
            parts_out[2, k] = tracked[HIPS, k]
        up = wp.normalize(position(tracked, HEAD) + wp.quat_rotate(orientation(tracked, HEAD), neck) - hips)
        write_pose(hips, rotation_from_axes(perpendicular(ahead, up), up), 1, parts_out)
    else:
        foot = LEFT_FOOT + side
        leg = 3 + 3 * side
        sign = wp.float64(1 - 2 * side)
        joint = hips + wp.quat_rotate(orientation(tracked, HIPS), wp.vec3d(zero, sign * hip, zero))
        apart = position(tracked, foot) - joint
        down = wp.normalize(apart)
        reach = wp.clamp(
            wp.length(apart), wp.abs(thigh - shank) + wp.float64(1.0e-3), thigh + shank - wp.float64(1.0e-6)
        )
        along = (thigh * thigh - shank * shank + reach * reach) / (wp.float64(2.0) * reach)
        front = perpendicular(wp.quat_rotate(orientation(tracked, foot), x) + ahead, down)
        knee = joint + along * down + wp.sqrt(wp.max(thigh * thigh - along * along, zero)) * front
        upper = wp.normalize(knee - joint)
        lower = wp.normalize(joint + reach * down - knee)
        write_pose(joint, rotation_from_axes(upper, perpendicular(front, upper)), leg, parts_out)
        write_pose(knee, rotation_from_axes(lower, perpendicular(front, lower)), leg + 1, parts_out)
        for k in range(7):
            parts_out[leg + 2, k] = tracked[foot, k]


@wp.func
def rotate_by_pose(poses: wp.array2d(dtype=wp.float64), i: int, v: wp.vec3d):
    """Returns vector ``v``, given in the frame of pose ``i``, rotated into the world frame."""
    return wp.quat_rotate(orientation(poses, i), v)


@wp.kernel
def pose_arms_and_fingers(
    # model
    upper: wp.float64,
    lower: wp.float64,
    shoulder: wp.vec3d,
    wrist: wp.vec3d,
    pole: wp.vec3d,
    neck: wp.float64,
    nape: wp.vec3d,
    root: wp.array2d(dtype=wp.float64),
    length: wp.array2d(dtype=wp.float64),
    bent: wp.array2d(dtype=wp.float64),
    # in
    held: wp.array2d(dtype=wp.float64),
    closed: wp.array(dtype=wp.float64),
    # out
    limbs_out: wp.array2d(dtype=wp.float64),
):
    """One thread poses the neck (thread 0), the left or right arm (1, 2) or one finger (3 to 12) of a person.

    held: [4, 7] poses of chest, head, left and right hand; closed: [10] bend of each finger, 0 to 1; upper, lower:
    lengths of the arm [m]; other lengths [m] and positions [m] are of the left side, the right side mirrors them;
    limbs: [part, 7].
    """
    # If the hand is out of the arm's reach, the shoulder makes two thirds of the missing way and the elbow stretches by
    # one third, so that the hand stays joined to the arm. Both gaps are then inside the sleeve.
    thread = wp.tid()
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    x = wp.vec3d(one, zero, zero)
    z = wp.vec3d(zero, zero, one)
    if thread == 0:
        foot = position(held, 0) + rotate_by_pose(held, 0, wp.vec3d(zero, zero, neck))
        up = wp.normalize(position(held, 1) + rotate_by_pose(held, 1, nape) - foot)
        write_pose(foot, rotation_from_axes(up, perpendicular(rotate_by_pose(held, 0, x), up)), 0, limbs_out)
    elif thread < 3:
        hand = thread + 1
        mirror = wp.vec3d(one, wp.float64(3 - 2 * thread), one)
        joint = position(held, 0) + rotate_by_pose(held, 0, wp.cw_mul(shoulder, mirror))
        target = position(held, hand) + rotate_by_pose(held, hand, wp.cw_mul(wrist, mirror))
        reach = wp.length(target - joint)
        way = wp.normalize(target - joint)
        most = upper + lower - wp.float64(1.0e-6)
        stretch = wp.max(reach - most, zero) / wp.float64(3.0)
        joint = joint + wp.float64(2.0) * stretch * way
        reach = wp.clamp(wp.length(target - joint), wp.abs(upper - lower) + wp.float64(1.0e-3), most)
        along = (upper * upper - lower * lower + reach * reach) / (wp.float64(2.0) * reach)
        out = perpendicular(rotate_by_pose(held, 0, wp.cw_mul(pole, mirror)), way)
        elbow = joint + along * way + wp.sqrt(wp.max(upper * upper - along * along, zero)) * out
        arm = wp.normalize(elbow - joint)
        fore = wp.normalize(joint + reach * way - elbow)
        write_pose(joint, rotation_from_axes(arm, perpendicular(-out, arm)), 2 * thread - 1, limbs_out)
        back = rotate_by_pose(held, hand, z) + wp.float64(1.0e-3) * rotate_by_pose(held, hand, x)
        write_pose(elbow + stretch * way, rotation_from_axes(fore, perpendicular(back, fore)), 2 * thread, limbs_out)
    else:
        finger = thread - 3
        hand = 2 + finger / 5
        at = position(held, hand) + rotate_by_pose(held, hand, position(root, finger))
        q = orientation(held, hand) * orientation(root, finger)
        for k in range(3):
            q = q * wp.quat_from_axis_angle(wp.vec3d(zero, one, zero), bent[finger, k] * closed[finger])
            write_pose(at, wp.normalize(q), 5 + 3 * finger + k, limbs_out)
            at = at + wp.quat_rotate(q, length[finger, k] * x)


@wp.kernel
def pose_difference(
    # in
    start: wp.array2d(dtype=wp.float64),
    goal: wp.array2d(dtype=wp.float64),
    # out
    way_out: wp.array2d(dtype=wp.float64),
    turn_out: wp.array2d(dtype=wp.float64),
    turn_within_out: wp.array2d(dtype=wp.float64),
):
    """One thread computes the motion from one pose in ``start`` to the pose of the same row in ``goal`` [row, 7].

    way: [row, 3] translation [m]; turn, turn_within: [row, 3] rotation vector [rad] in the world's axes, and in the
    axes of ``start``.
    """
    i = wp.tid()
    way = position(goal, i) - position(start, i)
    q = orientation(start, i)
    turn = wp.quat_inverse(q) * orientation(goal, i)
    vector = wp.vec3d(turn[0], turn[1], turn[2])
    if turn[3] < wp.float64(0.0):
        vector = -vector
    sine = wp.length(vector)
    scale = wp.float64(2.0)
    if sine > wp.float64(1.0e-9):
        scale = wp.float64(2.0) * wp.atan2(sine, wp.abs(turn[3])) / sine
    within = scale * vector
    outside = wp.quat_rotate(q, within)
    for k in range(3):
        way_out[i, k] = way[k]
        turn_out[i, k] = outside[k]
        turn_within_out[i, k] = within[k]
