"""Articulated trees on ball joints with implicit springs: free motion, response to unit impulses, commitment.

Featherstone's articulated-body recursion (Rigid Body Dynamics Algorithms, 2008, chapter 7), one thread a tree. The
springs enter the recursion implicitly: with theta the joint's rotation vector, w its rate and phi in [1/2, 1], the
torque over one tick is -K (theta + phi dt w_phi) - D w_phi, w_phi = w + phi dt dw/dt, so every joint inertia grows by
the *metric* phi dt (phi dt K + D) and stiffness cannot make the tick unstable. phi = 1 is backward Euler (MuJoCo's
``discrete`` integrator), phi = 1/2 the trapezoidal rule.

What hangs is stiff too: a force F drawing out a lever d resists turning with (d.F)(1 - dd^T / d.d). Taken explicitly
it gives a swing of rate w the damping ratio -(1 - phi) dt w / 2 (-0.018 for a bunch on 15 cm), and where a peduncle is
softer than what it carries it blows up. So it enters the inertia with phi^2 dt^2, and the force's moment is taken where
the lever will be (1 - phi) dt later: a swing then neither gains nor loses. F is weight, load and the last contacts.

That is one half of what a load stiffens a tree by. The other couples bending to twist: a force across a lever turns
with it, and so does the moment that a spring bears, with the middle of its joint (by half of what parent and body turn). Where all balances, both together are symmetric. At phi 1/2, which must keep energy, they are taken whole:
without, a level cane loses 2 % of a sideways swing in a minute, and with 100 g on its tip it gains forty times its
energy in twenty seconds. Above phi 1/2 they are left out: they would cost a quarter of the tick to mend what the scheme's own damping
outweighs.

A body with parent -1 is a root: it hangs on its tree's pose, or *floats* if it has been cut off (``body_root`` names the
cut body that everything on it moves with, -1 for what still stands). A floating root has no spring and no lever; what is
left of its inertia after its rotation is eliminated gives its linear acceleration, ``lift`` times the force left over.

Ties and air drag are forces at a point c of a body that grow against its velocity. Taken implicitly they look like a
mass W at c: W = phi dt (phi dt k + c) for a spring and damper, dt c for drag.

Gyroscopic and centrifugal terms stay explicit and err by about dt w^2 a second. A body turning faster than ``brisk``
is therefore held back by a drag dt (w^2 - brisk^2) times its momentum, and a tree with a joint beyond ``limit`` goes on
at half of it.

Signs and frames: world axes; velocities and accelerations are (linear of the body's origin, angular), wrenches (force
at the origin, moment about it). The inertia of a body or subtree about the body's origin is held as three blocks,

    moment = J alpha + H a        force = H^T alpha + M a        with H = m [c]x for one body,

and after elimination of its joint a body keeps only D = (J + metric)^-1, D J and D H.

Bodies are numbered by where they lie: those of a tree ``pitch`` apart, from ``tree_first`` on, children behind parents.
One after the other (pitch 1) suits a CPU; a GPU reads neighbouring trees at once if their bodies are neighbours. Sums
over children are read and stored, not added in place: that would be an atomic operation, in a GPU's far cache.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

AIR_DENSITY = wp.constant(1.2)
"""[kg/m^3] density of air at 20 degrees"""

STICKY_ON = wp.constant(0.1)
"""Share of ``limit``: a tree with phi = 1 of which a joint turns faster keeps it, until all are ``CALM``. Thrown, a limp
thread under a heavy load gains energy at any other phi: going back and forth it would thrash for ever."""

STICKY_OFF = wp.constant(0.06)
"""Share of ``limit`` below which all joints of a wild tree must turn for a second."""

STICKY_COUNT = wp.constant(4)
"""[tick] A count above this is a wild tree's; a touch begins with less."""


@wp.func
def exponential(v: wp.vec3):
    """Quaternion of the rotation vector v [rad]."""
    square = wp.dot(v, v)
    half_sinc = 0.5 - square * (1.0 / 48.0 - square * (1.0 / 3840.0))
    cosine = 1.0 - square * (1.0 / 8.0 - square * (1.0 / 384.0))
    if square > 0.1:
        angle = wp.sqrt(square)
        half_sinc = wp.sin(0.5 * angle) / angle
        cosine = wp.cos(0.5 * angle)
    return wp.quat(half_sinc * v[0], half_sinc * v[1], half_sinc * v[2], cosine)


@wp.func
def logarithm(q: wp.quat):
    """Rotation vector [rad] of the unit quaternion q, the short way round."""
    v = wp.vec3(q[0], q[1], q[2])
    w = q[3]
    if w < 0.0:
        v = -v
        w = -w
    square = wp.dot(v, v)
    scale = 2.0 + square * (1.0 / 3.0 + square * (3.0 / 20.0 + square * (5.0 / 56.0)))  # 2 asin(s) / s
    if square > 0.02:
        sine = wp.sqrt(square)
        scale = 2.0 * wp.atan2(sine, w) / sine
    return scale * v


@wp.func
def rotated_diagonal(frame: wp.mat33, v: wp.vec3):
    """The matrix that is diag(v) in the axes of frame (its columns): frame diag(v) frame^T."""
    x = wp.vec3(frame[0, 0], frame[1, 0], frame[2, 0])
    y = wp.vec3(frame[0, 1], frame[1, 1], frame[2, 1])
    return v[2] * wp.identity(n=3, dtype=float) + (v[0] - v[2]) * wp.outer(x, x) + (v[1] - v[2]) * wp.outer(y, y)


@wp.func
def cross_rows(A: wp.mat33, d: wp.vec3):
    """A [d]x: every row of A crossed with d."""
    return wp.matrix_from_rows(wp.cross(A[0], d), wp.cross(A[1], d), wp.cross(A[2], d))


@wp.func
def tension_stiffness(lever: wp.vec3, force: wp.vec3):
    """Stiffness [N m/rad] against turning that a steady force lends to a lever it draws out; none if it pushes."""
    pull = wp.dot(lever, force)
    stiffness = wp.mat33()
    if pull > 0.0:
        along = pull / wp.dot(lever, lever)
        stiffness = pull * wp.identity(n=3, dtype=float) - along * wp.outer(lever, lever)
    return stiffness


@wp.func
def shear_stiffness(lever: wp.vec3, force: wp.vec3):
    """What :func:`taut` leaves out of the symmetric part of (d.F) 1 - d F^T: what pushes, and what pulls across."""
    return (
        wp.dot(lever, force) * wp.identity(n=3, dtype=float)
        - 0.5 * (wp.outer(lever, force) + wp.outer(force, lever))
        - tension_stiffness(lever, force)
    )


@wp.func
def spring_moment(frame: wp.mat33, stiffness: wp.vec3, q: wp.quat, share: float):
    """A share of the moment that a spring bears, in world axes."""
    return share * (frame * wp.cw_mul(stiffness, logarithm(q)))


@wp.func
def couple_bending_and_twist(
    k: int,
    parent: int,
    reach: float,
    moment: wp.vec3,
    centripetal: wp.vec3,
    lever: wp.array(dtype=wp.vec3),
    drawn: wp.array(dtype=wp.vec3),
    DJ: wp.array(dtype=wp.mat33),
    DH: wp.array(dtype=wp.mat33),
    Du: wp.array(dtype=wp.vec3),
    J_out: wp.array(dtype=wp.mat33),
    H_out: wp.array(dtype=wp.mat33),
    bias_out: wp.array(dtype=wp.spatial_vector),
):
    """Hand on to the parent that a lever bears a force across, and a joint a moment: beside its spring, the joint asks
    alpha x moment of a parent's acceleration alpha, and its own asks as much of the parent (DJ knows of the first).
    """
    H_more = wp.skew(-moment) * DH[k]
    H_arm = cross_rows(H_more, lever[k])
    J_out[parent] = (
        J_out[parent]
        + reach * shear_stiffness(lever[k], drawn[k])
        + wp.skew(-moment) * DJ[k]
        + wp.skew(moment)
        - H_arm
        - wp.transpose(H_arm)
    )
    H_out[parent] = H_out[parent] + H_more
    more = wp.cross(moment, Du[k]) + H_more * centripetal
    bias_out[parent] = bias_out[parent] + wp.spatial_vector(wp.vec3(), more)


@wp.func
def point_mass_inertia(mass: float, lever: wp.vec3):
    """Moment of inertia about the origin [kg m^2] of a point mass at a lever."""
    return mass * (wp.dot(lever, lever) * wp.identity(n=3, dtype=float) - wp.outer(lever, lever))


@wp.func
def world_inertia(rotation: wp.mat33, moments: wp.vec3, products: wp.vec3):
    """Inertia in world axes from its diagonal and its entries yz, zx, xy in the body's axes."""
    inertia = rotated_diagonal(rotation, moments)
    if wp.length_sq(products) > 0.0:
        mixed = wp.mat33(
            0.0, products[2], products[1], products[2], 0.0, products[0], products[1], products[0], 0.0
        )  # fmt: skip
        inertia = inertia + rotation * mixed * wp.transpose(rotation)
    return inertia


@wp.func
def residual_damping(damping: float, stiffness: float, phi: float, dt: float):
    """Damper that is left to add when the scheme damps a spring as if beta were larger by (2 phi - 1) dt."""
    return wp.max(damping - (2.0 * phi - 1.0) * dt * stiffness, 0.0)


@wp.func
def tie_force(stiffness: float, damping: float, stretch: wp.vec3, speed: wp.vec3, phi: float, dt: float):
    """Force [N] of a tie whose point moves on at its present speed; ``damping`` is the remaining one."""
    return -stiffness * (stretch + phi * dt * speed) - damping * speed


@wp.func
def add_tie(
    k: int,
    at: wp.vec3,
    anchor: wp.vec3,
    stiffness: float,
    damping: float,
    phi: float,
    dt: float,
    pose: wp.transform,
    motion: wp.spatial_vector,
    J_out: wp.array(dtype=wp.mat33),
    H_out: wp.array(dtype=wp.mat33),
    M_out: wp.array(dtype=wp.mat33),
    bias_out: wp.array(dtype=wp.spatial_vector),
    drawn_out: wp.array(dtype=wp.vec3),
):
    """Tie one body at a point: spring and damper as a mass there, and what they pull."""
    omega = wp.spatial_bottom(motion)
    stretch = wp.transform_get_translation(pose) + at - anchor
    damper = residual_damping(damping, stiffness, phi, dt)
    grip = phi * dt * (phi * dt * stiffness + damper)
    swing = wp.cross(omega, at)
    hold = tie_force(stiffness, damper, stretch, wp.spatial_top(motion) + swing, phi, dt) - grip * wp.cross(
        omega, swing
    )
    J_out[k] = J_out[k] + point_mass_inertia(grip, at)
    H_out[k] = H_out[k] + grip * wp.skew(at)
    M_out[k] = M_out[k] + grip * wp.identity(n=3, dtype=float)
    bias_out[k] = bias_out[k] + wp.spatial_vector(-hold, -wp.cross(at, hold))
    drawn_out[k] = drawn_out[k] - stiffness * stretch


@wp.func
def drag_coefficient(area: float, wind: wp.vec3):
    """Drag [N s/m] per relative speed, of a drag area Cd A [m^2] in a wind relative to it."""
    return 0.5 * AIR_DENSITY * area * wp.length(wind)


@wp.func
def max_joint_rate(rates: wp.array(dtype=wp.vec3), first: int, size: int, pitch: int):
    """Fastest of some joint rates [rad/s]; NaN enters, and stays. (A function, since an adjoint does not repeat the
    loops of its kernel before it goes back, but calls functions.)
    """
    most = float(0.0)
    for k in range(first, first + size * pitch, pitch):
        rate = wp.length(rates[k])
        if rate > most or rate != rate:
            most = rate
    return most


@wp.func
def max_root_speed(
    places: wp.array(dtype=wp.vec3),
    speeds: wp.array(dtype=wp.vec3),
    body_parent: wp.array(dtype=wp.int32),
    body_root: wp.array(dtype=wp.int32),
    first: int,
    size: int,
    pitch: int,
):
    """Fastest of the floating roots [m/s]; NaN, be it in where one is, enters and stays."""
    most = float(0.0)
    for k in range(first, first + size * pitch, pitch):
        if body_parent[k] < 0 and body_root[k] >= 0:
            speed = wp.length(speeds[k]) + 0.0 * wp.length(places[k])
            if speed > most or speed != speed:
                most = speed
    return most


@wp.kernel
def forward_kinematics(
    # model
    pitch: int,
    tree_first: wp.array(dtype=wp.int32),
    tree_size: wp.array(dtype=wp.int32),
    tree_pose: wp.array(dtype=wp.transform),
    body_parent: wp.array(dtype=wp.int32),
    body_root: wp.array(dtype=wp.int32),
    body_offset: wp.array(dtype=wp.vec3),
    body_rest: wp.array(dtype=wp.quat),
    # in
    trees: wp.array(dtype=wp.int32),
    joint_x: wp.array(dtype=wp.vec3),
    joint_xd: wp.array(dtype=wp.vec3),
    joint_q: wp.array(dtype=wp.quat),
    joint_qd: wp.array(dtype=wp.vec3),
    # out
    body_q_out: wp.array(dtype=wp.transform),
    body_qd_out: wp.array(dtype=wp.spatial_vector),
):
    """Put the bodies of one tree where its joints say, without moving anything."""
    tree = trees[wp.tid()]
    first = tree_first[tree]
    for k in range(first, first + tree_size[tree] * pitch, pitch):
        parent = body_parent[k]
        above = tree_pose[tree]
        motion = wp.spatial_vector()
        if parent >= 0:
            above = body_q_out[parent]
            motion = body_qd_out[parent]
        elif body_root[k] >= 0:
            above = wp.transform(joint_x[k], wp.quat_identity())
            motion = wp.spatial_vector(joint_xd[k], wp.vec3())
        turning = wp.spatial_bottom(motion)
        axes = wp.transform_get_rotation(above) * body_rest[k]
        lever = wp.quat_rotate(wp.transform_get_rotation(above), body_offset[k])
        body_q_out[k] = wp.transform(wp.transform_get_translation(above) + lever, axes * joint_q[k])
        body_qd_out[k] = wp.spatial_vector(
            wp.spatial_top(motion) + wp.cross(turning, lever), turning + wp.quat_rotate(axes, joint_qd[k])
        )


@wp.kernel
def predict(
    # model
    dt: float,
    brisk: float,
    tension: float,
    gravity: wp.vec3,
    pitch: int,
    tree_first: wp.array(dtype=wp.int32),
    tree_moving: wp.array(dtype=wp.int32),
    tree_pose: wp.array(dtype=wp.transform),
    body_parent: wp.array(dtype=wp.int32),
    body_root: wp.array(dtype=wp.int32),
    body_offset: wp.array(dtype=wp.vec3),
    body_rest: wp.array(dtype=wp.quat),
    body_mass: wp.array(dtype=float),
    body_com: wp.array(dtype=wp.vec3),
    body_inertia: wp.array(dtype=wp.vec3),
    body_product: wp.array(dtype=wp.vec3),
    body_drag: wp.array(dtype=float),
    joint_stiffness: wp.array(dtype=wp.vec3),
    joint_damping: wp.array(dtype=wp.vec3),
    tie_span: wp.array(dtype=wp.vec2i),
    tie_point: wp.array(dtype=wp.vec3),
    tie_stiffness: wp.array(dtype=float),
    tie_damping: wp.array(dtype=float),
    # in
    trees: wp.array(dtype=wp.int32),
    tree_phi: wp.array(dtype=float),
    tree_onset: wp.array(dtype=wp.int32),
    tree_air: wp.array(dtype=wp.vec3),
    tie_anchor: wp.array(dtype=wp.vec3),
    body_load: wp.array(dtype=wp.spatial_vector),
    body_wrench: wp.array(dtype=wp.spatial_vector),
    joint_x: wp.array(dtype=wp.vec3),
    joint_xd: wp.array(dtype=wp.vec3),
    joint_q: wp.array(dtype=wp.quat),
    joint_qd: wp.array(dtype=wp.vec3),
    # out
    body_q_out: wp.array(dtype=wp.transform),
    body_qd_out: wp.array(dtype=wp.spatial_vector),
    tree_phi_out: wp.array(dtype=float),
    axes_out: wp.array(dtype=wp.quat),
    lever_out: wp.array(dtype=wp.vec3),
    J_out: wp.array(dtype=wp.mat33),
    H_out: wp.array(dtype=wp.mat33),
    M_out: wp.array(dtype=wp.mat33),
    bias_out: wp.array(dtype=wp.spatial_vector),
    drawn_out: wp.array(dtype=wp.vec3),
    D_out: wp.array(dtype=wp.mat33),
    DJ_out: wp.array(dtype=wp.mat33),
    DH_out: wp.array(dtype=wp.mat33),
    Du_out: wp.array(dtype=wp.vec3),
    lift_out: wp.array(dtype=wp.mat33),
    body_acceleration_out: wp.array(dtype=wp.spatial_vector),
    joint_xd_free_out: wp.array(dtype=wp.vec3),
    joint_qd_free_out: wp.array(dtype=wp.vec3),
    body_qd_free_out: wp.array(dtype=wp.spatial_vector),
):
    """Solve the motion of one tree over a tick without contacts, and keep the factors of its implicit inertia."""
    tree = trees[wp.tid()]
    first = tree_first[tree]
    size = tree_moving[tree]

    # outward: poses and velocities at the start of the tick, each body's own inertia and bias
    phi = tree_phi[tree]
    if max_joint_rate(joint_qd, first, size, pitch) > brisk or tree_onset[tree] > 0:
        phi = 1.0
    tree_phi_out[tree] = phi
    ahead = tension * (1.0 - phi) * dt
    reach = tension * phi * phi * dt * dt
    keeping = tension > 0.0 and phi == 0.5  # energy

    for k in range(first, first + size * pitch, pitch):
        parent = body_parent[k]
        above = tree_pose[tree]
        motion = wp.spatial_vector()
        if parent >= 0:
            above = body_q_out[parent]
            motion = body_qd_out[parent]
        elif body_root[k] >= 0:
            above = wp.transform(joint_x[k], wp.quat_identity())
            motion = wp.spatial_vector(joint_xd[k], wp.vec3())
        turning = wp.spatial_bottom(motion)
        axes = wp.transform_get_rotation(above) * body_rest[k]
        lever = wp.quat_rotate(wp.transform_get_rotation(above), body_offset[k])
        pose = axes * joint_q[k]
        omega = turning + wp.quat_rotate(axes, joint_qd[k])
        body_q_out[k] = wp.transform(wp.transform_get_translation(above) + lever, pose)
        velocity = wp.spatial_top(motion) + wp.cross(turning, lever)
        body_qd_out[k] = wp.spatial_vector(velocity, omega)
        axes_out[k] = axes
        lever_out[k] = lever

        mass = body_mass[k]
        rotation = wp.quat_to_matrix(pose)
        com = rotation * body_com[k]
        inertia = world_inertia(rotation, body_inertia[k], body_product[k])
        load = body_load[k]
        slip = wp.cross(omega, com)
        drag = dt * wp.max(wp.length_sq(omega) - brisk * brisk, 0.0)
        burden = 1.0 + dt * drag
        pace = velocity + slip
        weight = mass * gravity
        drawing = weight
        root = body_root[k]
        if root >= 0:  # what falls is not drawn out by its weight, nor held back in its fall
            pace = pace - joint_xd[root]
            weight = burden * weight
            drawing = wp.vec3()
        force = mass * (wp.cross(omega, slip) + drag * pace) - weight
        moment = (
            wp.cross(omega, inertia * omega)
            + wp.cross(com, force)
            + drag * (inertia * omega)
            - ahead * wp.cross(slip, drawing)
        )
        bias_out[k] = wp.spatial_vector(force, moment) - load
        drawn_out[k] = drawing + wp.spatial_top(load) + wp.spatial_top(body_wrench[k])
        J_out[k] = burden * (inertia + point_mass_inertia(mass, com)) + reach * tension_stiffness(com, drawing)
        H_out[k] = burden * mass * wp.skew(com)
        M_out[k] = burden * mass * wp.identity(n=3, dtype=float)

        if keeping:
            J_out[k] = J_out[k] + reach * shear_stiffness(com, drawing)
        area = body_drag[k]
        if area > 0.0:
            wind = tree_air[tree] - velocity - slip
            c = drag_coefficient(area, wind)
            J_out[k] = J_out[k] + point_mass_inertia(dt * c, com) + reach * tension_stiffness(com, c * wind)
            H_out[k] = H_out[k] + dt * c * wp.skew(com)
            M_out[k] = M_out[k] + dt * c * wp.identity(n=3, dtype=float)
            bias_out[k] = bias_out[k] + wp.spatial_vector(-c * wind, -c * wp.cross(com + ahead * slip, wind))
            drawn_out[k] = drawn_out[k] + c * wind
        ties = tie_span[k]
        for t in range(ties[0], ties[1]):
            add_tie(
                k, rotation * tie_point[t], tie_anchor[t], tie_stiffness[t], tie_damping[t], phi, dt, body_q_out[k],
                body_qd_out[k], J_out, H_out, M_out, bias_out, drawn_out,
            )  # fmt: skip

    # inward: eliminate each joint and hand what is left of the subtree to the parent
    for i in range(size):
        k = first + (size - 1 - i) * pitch
        parent = body_parent[k]
        turning = wp.vec3()
        if parent >= 0:
            turning = wp.spatial_bottom(body_qd_out[parent])
        frame = wp.quat_to_matrix(axes_out[k])
        stiffness = joint_stiffness[k]
        artificial = (2.0 * phi - 1.0) * dt  # [s] the scheme damps as if beta were larger by this
        damping = wp.max(joint_damping[k] - artificial * stiffness, wp.vec3())
        metric = rotated_diagonal(frame, phi * dt * (phi * dt * stiffness + damping))
        rate = joint_qd[k]
        spring = wp.cw_mul(stiffness, logarithm(joint_q[k]) + phi * dt * rate) + wp.cw_mul(damping, rate)
        bias = bias_out[k]
        J = J_out[k]
        H = H_out[k]
        M = M_out[k]
        # the metric acts on the rate as the joint frame sees it, hence turning x omega = turning x (joint rate)
        u = metric * wp.cross(turning, wp.spatial_bottom(body_qd_out[k])) - frame * spring - wp.spatial_bottom(bias)
        if keeping:
            turns = turning + wp.spatial_bottom(body_qd_out[k])
            u = u - wp.cross(turns, spring_moment(frame, stiffness, joint_q[k], 0.5 * ahead))
        D = wp.inverse(J + metric)
        DJ = D * J
        if keeping and parent >= 0:
            DJ = DJ - cross_rows(D, spring_moment(frame, stiffness, joint_q[k], 0.5 * reach))
        DH = D * H
        Du = D * u
        D_out[k] = D
        DJ_out[k] = DJ
        DH_out[k] = DH
        Du_out[k] = Du
        if parent >= 0:
            lever = lever_out[k]
            J_left = metric * DJ  # = J - J D J without the cancellation; the same for H
            H_left = metric * DH
            M_left = M - wp.transpose(H) * DH
            centripetal = wp.cross(turning, wp.cross(turning, lever))
            force = wp.spatial_top(bias) + wp.transpose(H) * Du + M_left * centripetal
            moment = wp.spatial_bottom(bias) + J * Du + H_left * centripetal + wp.cross(lever, force)
            drawn = drawn_out[k]
            drawn_out[parent] = drawn_out[parent] + drawn
            M_arm = wp.transpose(cross_rows(M_left, lever))
            H_arm = cross_rows(H_left, lever)
            J_out[parent] = (
                J_out[parent]
                + reach * tension_stiffness(lever, drawn)
                + J_left
                + cross_rows(M_arm, lever)
                - H_arm
                - wp.transpose(H_arm)
            )
            H_out[parent] = H_out[parent] + (H_left - M_arm)
            M_out[parent] = M_out[parent] + M_left
            bias_out[parent] = bias_out[parent] + wp.spatial_vector(
                force, moment - ahead * wp.cross(wp.cross(turning, lever), drawn)
            )
            if keeping:
                couple_bending_and_twist(
                    k, parent, reach, spring_moment(frame, stiffness, joint_q[k], 0.5 * reach), centripetal, lever_out, drawn_out,
                    DJ_out, DH_out, Du_out, J_out, H_out, bias_out,
                )  # fmt: skip
        else:
            lift_out[k] = wp.mat33()
            if body_root[k] >= 0:
                lift_out[k] = wp.inverse(M - wp.transpose(H) * DH)

    # outward: accelerations, and the rates and velocities they lead to
    for k in range(first, first + size * pitch, pitch):
        parent = body_parent[k]
        pushed = wp.spatial_vector()
        motion = wp.spatial_vector()
        turning = wp.vec3()
        if parent >= 0:
            pushed = body_acceleration_out[parent]
            motion = body_qd_free_out[parent]
            turning = wp.spatial_bottom(body_qd_out[parent])
        elif body_root[k] >= 0:
            force = wp.spatial_top(bias_out[k]) + wp.transpose(H_out[k]) * Du_out[k]
            falling = -(lift_out[k] * force)
            pushed = wp.spatial_vector(falling, wp.vec3())
            joint_xd_free_out[k] = joint_xd[k] + dt * falling
            motion = wp.spatial_vector(joint_xd_free_out[k], wp.vec3())
        lever = lever_out[k]
        alpha = wp.spatial_bottom(pushed)
        a = wp.spatial_top(pushed) + wp.cross(alpha, lever) + wp.cross(turning, wp.cross(turning, lever))
        relative = Du_out[k] - DJ_out[k] * alpha - DH_out[k] * a
        body_acceleration_out[k] = wp.spatial_vector(a, alpha + relative)
        swing = wp.spatial_bottom(body_qd_out[k]) - turning
        gain = dt * (relative - wp.cross(turning, swing))
        joint_qd_free_out[k] = joint_qd[k] + wp.quat_rotate_inv(axes_out[k], gain)
        omega = wp.spatial_bottom(motion)
        body_qd_free_out[k] = wp.spatial_vector(wp.spatial_top(motion) + wp.cross(omega, lever), omega + swing + gain)


@wp.kernel
def impulse_response(
    # model
    pitch: int,
    tree_first: wp.array(dtype=wp.int32),
    body_tree: wp.array(dtype=wp.int32),
    body_parent: wp.array(dtype=wp.int32),
    stride: int,
    # in
    bodies: wp.array(dtype=wp.int32),
    lever: wp.array(dtype=wp.vec3),
    D: wp.array(dtype=wp.mat33),
    DJ: wp.array(dtype=wp.mat33),
    DH: wp.array(dtype=wp.mat33),
    lift: wp.array(dtype=wp.mat33),
    # out
    a_by_force_out: wp.array(dtype=wp.mat33),
    a_by_moment_out: wp.array(dtype=wp.mat33),
    alpha_by_force_out: wp.array(dtype=wp.mat33),
    alpha_by_moment_out: wp.array(dtype=wp.mat33),
    response_out: wp.array4d(dtype=float),
):
    """Push one body by six unit impulses; write the velocity of every body up to it in the list, and the transpose."""
    slot = wp.tid()
    body = bodies[slot]
    tree = body_tree[body]
    first = tree_first[tree]
    shift = slot * stride - first  # scratch of this thread: one entry for each body of the tree
    last = body
    for other in range(slot):
        if body_tree[bodies[other]] == tree:
            last = wp.max(last, bodies[other])

    # inward along the path to the root; columns are the three unit forces and the three unit moments
    zero = wp.mat33()
    force_f = wp.identity(n=3, dtype=float)
    force_m = wp.mat33()
    moment_f = wp.mat33()
    moment_m = wp.identity(n=3, dtype=float)
    path = int(body)
    for i in range((last - first) / pitch + 1):
        k = last - i * pitch
        alpha_by_force_out[shift + k] = zero
        alpha_by_moment_out[shift + k] = zero
        a_by_force_out[shift + k] = zero
        a_by_moment_out[shift + k] = zero
        if k == path:
            alpha_by_force_out[shift + k] = D[k] * moment_f
            alpha_by_moment_out[shift + k] = D[k] * moment_m
            DJt = wp.transpose(DJ[k])
            DHt = wp.transpose(DH[k])
            arm = wp.skew(lever[k])
            force_f = force_f - DHt * moment_f
            force_m = force_m - DHt * moment_m
            moment_f = moment_f - DJt * moment_f + arm * force_f
            moment_m = moment_m - DJt * moment_m + arm * force_m
            path = body_parent[k]
            if path < 0:
                a_by_force_out[shift + k] = lift[k] * force_f
                a_by_moment_out[shift + k] = lift[k] * force_m

    for k in range(first, last + 1, pitch):
        parent = body_parent[k]
        a_f = a_by_force_out[shift + k]
        a_m = a_by_moment_out[shift + k]
        alpha_f = wp.mat33()
        alpha_m = wp.mat33()
        if parent >= 0:
            arm = wp.skew(lever[k])
            alpha_f = alpha_by_force_out[shift + parent]
            alpha_m = alpha_by_moment_out[shift + parent]
            a_f = a_by_force_out[shift + parent] - arm * alpha_f
            a_m = a_by_moment_out[shift + parent] - arm * alpha_m
        a_by_force_out[shift + k] = a_f
        a_by_moment_out[shift + k] = a_m
        alpha_by_force_out[shift + k] = alpha_f + alpha_by_force_out[shift + k] - DJ[k] * alpha_f - DH[k] * a_f
        alpha_by_moment_out[shift + k] = alpha_m + alpha_by_moment_out[shift + k] - DJ[k] * alpha_m - DH[k] * a_m

    for other in range(slot + 1):
        a_f = zero
        a_m = zero
        alpha_f = zero
        alpha_m = zero
        if body_tree[bodies[other]] == tree:
            at = shift + bodies[other]
            a_f = a_by_force_out[at]
            a_m = a_by_moment_out[at]
            alpha_f = alpha_by_force_out[at]
            alpha_m = alpha_by_moment_out[at]
        if other == slot:  # symmetric but for rounding
            a_f = 0.5 * (a_f + wp.transpose(a_f))
            alpha_m = 0.5 * (alpha_m + wp.transpose(alpha_m))
            a_m = 0.5 * (a_m + wp.transpose(alpha_f))
            alpha_f = wp.transpose(a_m)
        for r in range(3):
            for c in range(3):
                response_out[other, r, slot, c] = a_f[r, c]
                response_out[other, r, slot, 3 + c] = a_m[r, c]
                response_out[other, 3 + r, slot, c] = alpha_f[r, c]
                response_out[other, 3 + r, slot, 3 + c] = alpha_m[r, c]
                response_out[slot, c, other, r] = a_f[r, c]
                response_out[slot, 3 + c, other, r] = a_m[r, c]
                response_out[slot, c, other, 3 + r] = alpha_f[r, c]
                response_out[slot, 3 + c, other, 3 + r] = alpha_m[r, c]


@wp.kernel
def apply_wrenches(
    # model
    dt: float,
    pitch: int,
    tree_first: wp.array(dtype=wp.int32),
    tree_moving: wp.array(dtype=wp.int32),
    body_parent: wp.array(dtype=wp.int32),
    body_root: wp.array(dtype=wp.int32),
    # in
    trees: wp.array(dtype=wp.int32),
    body_wrench: wp.array(dtype=wp.spatial_vector),
    axes: wp.array(dtype=wp.quat),
    lever: wp.array(dtype=wp.vec3),
    D: wp.array(dtype=wp.mat33),
    DJ: wp.array(dtype=wp.mat33),
    DH: wp.array(dtype=wp.mat33),
    lift: wp.array(dtype=wp.mat33),
    # out
    spread_out: wp.array(dtype=wp.spatial_vector),
    added_out: wp.array(dtype=wp.spatial_vector),
    Du_out: wp.array(dtype=wp.vec3),
    body_acceleration_out: wp.array(dtype=wp.spatial_vector),
    joint_xd_free_out: wp.array(dtype=wp.vec3),
    joint_qd_free_out: wp.array(dtype=wp.vec3),
):
    """Add what the wrenches on one touched tree do to its free accelerations and joint rates."""
    tree = trees[wp.tid()]
    first = tree_first[tree]
    size = tree_moving[tree]
    for k in range(first, first + size * pitch, pitch):
        spread_out[k] = body_wrench[k]
    for i in range(size):
        k = first + (size - 1 - i) * pitch
        parent = body_parent[k]
        wrench = spread_out[k]
        moment = wp.spatial_bottom(wrench)
        Du_out[k] = D[k] * moment
        if parent >= 0:
            force = wp.spatial_top(wrench) - wp.transpose(DH[k]) * moment
            moment = moment - wp.transpose(DJ[k]) * moment + wp.cross(lever[k], force)
            spread_out[parent] = spread_out[parent] + wp.spatial_vector(force, moment)
    for k in range(first, first + size * pitch, pitch):
        parent = body_parent[k]
        above = wp.spatial_vector()
        if parent >= 0:
            above = added_out[parent]
        elif body_root[k] >= 0:
            wrench = spread_out[k]
            force = wp.spatial_top(wrench) - wp.transpose(DH[k]) * wp.spatial_bottom(wrench)
            above = wp.spatial_vector(lift[k] * force, wp.vec3())
            joint_xd_free_out[k] = joint_xd_free_out[k] + dt * (lift[k] * force)
        alpha = wp.spatial_bottom(above)
        a = wp.spatial_top(above) + wp.cross(alpha, lever[k])
        relative = Du_out[k] - DJ[k] * alpha - DH[k] * a
        added_out[k] = wp.spatial_vector(a, alpha + relative)
        body_acceleration_out[k] = body_acceleration_out[k] + added_out[k]
        joint_qd_free_out[k] = joint_qd_free_out[k] + dt * wp.quat_rotate_inv(axes[k], relative)


@wp.kernel
def integrate(
    # model
    dt: float,
    limit: float,
    bound: float,
    pitch: int,
    tree_first: wp.array(dtype=wp.int32),
    tree_moving: wp.array(dtype=wp.int32),
    body_parent: wp.array(dtype=wp.int32),
    body_root: wp.array(dtype=wp.int32),
    # in
    trees: wp.array(dtype=wp.int32),
    tree_awake: wp.array(dtype=wp.bool),
    tree_phi: wp.array(dtype=float),
    joint_x: wp.array(dtype=wp.vec3),
    joint_xd: wp.array(dtype=wp.vec3),
    joint_q: wp.array(dtype=wp.quat),
    joint_qd: wp.array(dtype=wp.vec3),
    joint_xd_free: wp.array(dtype=wp.vec3),
    joint_qd_free: wp.array(dtype=wp.vec3),
    # out
    tree_rate_out: wp.array(dtype=float),
    tree_onset_out: wp.array(dtype=wp.int32),
    joint_x_out: wp.array(dtype=wp.vec3),
    joint_xd_out: wp.array(dtype=wp.vec3),
    joint_q_out: wp.array(dtype=wp.quat),
    joint_qd_out: wp.array(dtype=wp.vec3),
):
    """Move the joints of one tree to the end of the tick; a tree beyond bound stops where the tick began."""
    tree = trees[wp.tid()]
    if not tree_awake[tree]:
        return
    first = tree_first[tree]
    size = tree_moving[tree]
    turning = max_joint_rate(joint_qd_free, first, size, pitch)
    most = wp.length(
        wp.vec2(turning, max_root_speed(joint_x, joint_xd_free, body_parent, body_root, first, size, pitch))
    )
    tree_rate_out[tree] = most
    onset = wp.max(tree_onset_out[tree] - 1, 0)
    phi = tree_phi[tree]
    if (phi == 1.0 and turning > STICKY_ON * limit) or (onset > STICKY_COUNT and turning > STICKY_OFF * limit):
        onset = wp.max(onset, int(1.0 / dt))
    tree_onset_out[tree] = onset
    sound = most <= bound
    # a tree beyond limit is slowed as a whole and well below it: holding back single joints would feed energy into the
    # others, and a loaded cane would thrash at the limit for ever
    slower = float(1.0)
    if turning > limit:
        slower = 0.5 * limit / turning
    for k in range(first, first + size * pitch, pitch):
        floats = body_parent[k] < 0 and body_root[k] >= 0
        if sound:
            rate = slower * joint_qd_free[k]
            share = phi
            if floats:  # no spring turns it: nothing to be had from phi but error
                share = 0.5
                joint_x_out[k] = joint_x[k] + 0.5 * dt * (joint_xd[k] + joint_xd_free[k])
                joint_xd_out[k] = joint_xd_free[k]
            mean = (1.0 - share) * joint_qd[k] + share * rate
            joint_qd_out[k] = rate
            joint_q_out[k] = wp.normalize(exponential(dt * mean) * joint_q[k])
        else:
            joint_qd_out[k] = wp.vec3()
            joint_q_out[k] = joint_q[k]
            if floats:
                joint_xd_out[k] = wp.vec3()
                joint_x_out[k] = joint_x[k]


@wp.func
def tie_and_drag_wrench(
    k: int,
    dt: float,
    phi: float,
    air: wp.vec3,
    body_com: wp.array(dtype=wp.vec3),
    body_drag: wp.array(dtype=float),
    tie_span: wp.array(dtype=wp.vec2i),
    tie_point: wp.array(dtype=wp.vec3),
    tie_anchor: wp.array(dtype=wp.vec3),
    tie_stiffness: wp.array(dtype=float),
    tie_damping: wp.array(dtype=float),
    pose: wp.transform,
    motion: wp.spatial_vector,
    acceleration: wp.spatial_vector,
):
    """What ties and air did to a body in the last tick: force [N], moment about its origin [N m]."""
    velocity = wp.spatial_top(motion)
    omega = wp.spatial_bottom(motion)
    a = wp.spatial_top(acceleration)
    alpha = wp.spatial_bottom(acceleration)
    wrench = wp.spatial_vector()
    area = body_drag[k]
    if area > 0.0:
        com = wp.quat_rotate(wp.transform_get_rotation(pose), body_com[k])
        wind = air - velocity - wp.cross(omega, com)
        force = drag_coefficient(area, wind) * (wind - dt * (a + wp.cross(alpha, com)))
        wrench += wp.spatial_vector(force, wp.cross(com, force))
    ties = tie_span[k]
    for t in range(ties[0], ties[1]):
        at = wp.quat_rotate(wp.transform_get_rotation(pose), tie_point[t])
        stretch = wp.transform_get_translation(pose) + at - tie_anchor[t]
        tie = tie_stiffness[t]
        damper = residual_damping(tie_damping[t], tie, phi, dt)
        grip = phi * dt * (phi * dt * tie + damper)
        swing = wp.cross(omega, at)
        force = tie_force(tie, damper, stretch, velocity + swing, phi, dt)
        force = force - grip * (a + wp.cross(alpha, at) + wp.cross(omega, swing))
        wrench += wp.spatial_vector(force, wp.cross(at, force))
    return wrench


@wp.func
def least_change(inertia: wp.mat33, momentum: wp.vec3, missing: wp.vec3, dt: float):
    """The x of the least change of pose, momentum x dt times x, and of rate, inertia / dt times x, that adds what is
    missing to an angular momentum. A rate counts by what it turns in a tick, so a thin rod is rather turned than spun.
    """
    stiff = inertia / dt
    A = stiff * stiff + (wp.dot(momentum, momentum) * wp.identity(n=3, dtype=float) - wp.outer(momentum, momentum))
    x = wp.inverse(wp.mat33d(A)) * wp.vec3d(missing)
    return wp.vec3(x) / dt


@wp.kernel
def correct_floating_momentum(
    # model
    dt: float,
    limit: float,
    bound: float,
    gravity: wp.vec3,
    pitch: int,
    tree_first: wp.array(dtype=wp.int32),
    tree_moving: wp.array(dtype=wp.int32),
    body_tree: wp.array(dtype=wp.int32),
    body_parent: wp.array(dtype=wp.int32),
    body_root: wp.array(dtype=wp.int32),
    body_offset: wp.array(dtype=wp.vec3),
    body_rest: wp.array(dtype=wp.quat),
    body_mass: wp.array(dtype=float),
    body_com: wp.array(dtype=wp.vec3),
    body_inertia: wp.array(dtype=wp.vec3),
    body_product: wp.array(dtype=wp.vec3),
    body_drag: wp.array(dtype=float),
    tie_span: wp.array(dtype=wp.vec2i),
    tie_point: wp.array(dtype=wp.vec3),
    tie_stiffness: wp.array(dtype=float),
    tie_damping: wp.array(dtype=float),
    # in
    roots: wp.array(dtype=wp.int32),
    tree_phi: wp.array(dtype=float),
    tree_rate: wp.array(dtype=float),
    tree_air: wp.array(dtype=wp.vec3),
    tie_anchor: wp.array(dtype=wp.vec3),
    body_load: wp.array(dtype=wp.spatial_vector),
    body_wrench: wp.array(dtype=wp.spatial_vector),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
    body_acceleration: wp.array(dtype=wp.spatial_vector),
    lever: wp.array(dtype=wp.vec3),
    # out
    earlier_out: wp.array(dtype=wp.spatial_vector),
    later_q_out: wp.array(dtype=wp.transform),
    later_qd_out: wp.array(dtype=wp.spatial_vector),
    joint_x_out: wp.array(dtype=wp.vec3),
    joint_xd_out: wp.array(dtype=wp.vec3),
    joint_q_out: wp.array(dtype=wp.quat),
    joint_qd_out: wp.array(dtype=wp.vec3),
):
    """Give one floating component the momentum and the path of its centre of mass that outer forces leave it."""
    root = roots[wp.tid()]
    tree = body_tree[root]
    if not tree_rate[tree] <= bound:
        return
    last = tree_first[tree] + tree_moving[tree] * pitch

    # before the tick, about the root and against it: momentum, and what acted on it since
    here = wp.transform_get_translation(body_q[root])
    pace = wp.spatial_top(body_qd[root])
    mass = float(0.0)
    lean = wp.vec3()  # mass times centre of mass
    linear = wp.vec3()
    angular = wp.vec3()
    force = wp.vec3()
    moment = wp.vec3()
    for k in range(root, last, pitch):
        if body_root[k] == root:
            arm = wp.vec3()
            velocity = wp.vec3()
            if k > root:  # not from world positions and velocities, whose digits go into the fall
                above = body_parent[k]
                arm = wp.spatial_top(earlier_out[above]) + lever[k]
                velocity = wp.spatial_bottom(earlier_out[above])
                velocity += wp.cross(wp.spatial_bottom(body_qd[above]), lever[k])
            earlier_out[k] = wp.spatial_vector(arm, velocity)
            pose = body_q[k]
            omega = wp.spatial_bottom(body_qd[k])
            rotation = wp.quat_to_matrix(wp.transform_get_rotation(pose))
            com = rotation * body_com[k]
            momentum = body_mass[k] * (velocity + wp.cross(omega, com))
            given = body_load[k] + body_wrench[k]
            given += tie_and_drag_wrench(
                k, dt, tree_phi[tree], tree_air[tree], body_com, body_drag, tie_span, tie_point, tie_anchor,
                tie_stiffness, tie_damping, pose, body_qd[k], body_acceleration[k],
            )  # fmt: skip
            mass += body_mass[k]
            lean += body_mass[k] * (arm + com)
            linear += momentum
            angular += wp.cross(arm + com, momentum) + world_inertia(rotation, body_inertia[k], body_product[k]) * omega
            force += wp.spatial_top(given)
            moment += wp.cross(arm, wp.spatial_top(given)) + wp.spatial_bottom(given)
    com = lean / mass
    goal = linear + dt * (force + mass * gravity)
    spin = angular - wp.cross(com, linear) + dt * (moment - wp.cross(com, force))
    path = com + dt * (pace + 0.5 / mass * (linear + goal))

    # after it: the same sums with the joints as they are now, and the inertia of all that, locked
    moved = joint_x_out[root] - here
    lean = wp.vec3()
    linear = wp.vec3()
    angular = wp.vec3()
    locked = wp.mat33()
    for k in range(root, last, pitch):
        if body_root[k] == root:
            base = wp.transform(wp.vec3(), wp.quat_identity())
            motion = wp.spatial_vector()
            if k > root:
                base = later_q_out[body_parent[k]]
                motion = later_qd_out[body_parent[k]]
            turning = wp.spatial_bottom(motion)
            axes = wp.transform_get_rotation(base) * body_rest[k]
            reach = wp.quat_rotate(wp.transform_get_rotation(base), body_offset[k])
            arm = wp.transform_get_translation(base) + reach
            turned_by = axes * joint_q_out[k]
            omega = turning + wp.quat_rotate(axes, joint_qd_out[k])
            velocity = wp.spatial_top(motion) + wp.cross(turning, reach)
            later_q_out[k] = wp.transform(arm, turned_by)
            later_qd_out[k] = wp.spatial_vector(velocity, omega)
            rotation = wp.quat_to_matrix(turned_by)
            com_k = rotation * body_com[k]
            inertia = world_inertia(rotation, body_inertia[k], body_product[k])
            momentum = body_mass[k] * (velocity + wp.cross(omega, com_k))
            lean += body_mass[k] * (arm + com_k)
            linear += momentum
            angular += wp.cross(arm + com_k, momentum) + inertia * omega
            locked += inertia + point_mass_inertia(body_mass[k], arm + com_k)
    com = lean / mass
    angular = angular - wp.cross(com, linear)
    locked = locked - point_mass_inertia(mass, com)
    twist = wp.quat_identity()
    rate = joint_qd_out[root]
    turn = wp.vec3()
    for _ in range(3):  # Newton: angular momentum and inertia turn along
        frame = wp.quat_to_matrix(twist)
        inertia = frame * locked * wp.transpose(frame)
        own = frame * angular + inertia * turn
        least = least_change(inertia, own, spin - own, dt)
        added = exponential(dt * wp.cross(own, least))
        twist = added * twist
        turn = wp.quat_rotate(added, turn) + inertia * least / dt
    rate = wp.quat_rotate(twist, rate) + turn
    square = wp.length_sq(rate)
    if square > limit * limit:
        turn = turn + rate * (limit / wp.sqrt(square) - 1.0)
        rate = rate * (limit / wp.sqrt(square))
    com = wp.quat_rotate(twist, com)
    joint_q_out[root] = wp.normalize(twist * joint_q_out[root])
    joint_qd_out[root] = rate
    joint_xd_out[root] = pace + (goal - wp.quat_rotate(twist, linear)) / mass - wp.cross(turn, com)
    joint_x_out[root] = joint_x_out[root] + (path - moved - com)


@wp.kernel
def joint_wrench(
    # model
    dt: float,
    gravity: wp.vec3,
    pitch: int,
    tree_first: wp.array(dtype=wp.int32),
    tree_moving: wp.array(dtype=wp.int32),
    body_tree: wp.array(dtype=wp.int32),
    body_parent: wp.array(dtype=wp.int32),
    body_root: wp.array(dtype=wp.int32),
    body_mass: wp.array(dtype=float),
    body_com: wp.array(dtype=wp.vec3),
    body_inertia: wp.array(dtype=wp.vec3),
    body_product: wp.array(dtype=wp.vec3),
    body_drag: wp.array(dtype=float),
    tie_span: wp.array(dtype=wp.vec2i),
    tie_point: wp.array(dtype=wp.vec3),
    tie_stiffness: wp.array(dtype=float),
    tie_damping: wp.array(dtype=float),
    # in
    bodies: wp.array(dtype=wp.int32),
    tree_phi: wp.array(dtype=float),
    tree_air: wp.array(dtype=wp.vec3),
    tie_anchor: wp.array(dtype=wp.vec3),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
    body_acceleration: wp.array(dtype=wp.spatial_vector),
    body_load: wp.array(dtype=wp.spatial_vector),
    body_wrench: wp.array(dtype=wp.spatial_vector),
    # out
    wrench_out: wp.array(dtype=wp.spatial_vector),
):
    """Add up what one joint must carry so that everything beyond it moves as it did in the last tick."""
    slot = wp.tid()
    body = bodies[slot]
    tree = body_tree[body]
    at = wp.transform_get_translation(body_q[body])
    force = wp.vec3()
    moment = wp.vec3()
    last = tree_first[tree] + tree_moving[tree] * pitch
    if body_parent[body] < 0 and body_root[body] >= 0:
        last = body  # nothing holds what has been cut off
    for k in range(body, last, pitch):
        up = int(k)
        while up > body:
            up = body_parent[up]
        if up == body:
            pose = body_q[k]
            rotation = wp.quat_to_matrix(wp.transform_get_rotation(pose))
            inertia = world_inertia(rotation, body_inertia[k], body_product[k])
            com = rotation * body_com[k]
            omega = wp.spatial_bottom(body_qd[k])
            alpha = wp.spatial_bottom(body_acceleration[k])
            a = wp.spatial_top(body_acceleration[k]) + wp.cross(alpha, com) + wp.cross(omega, wp.cross(omega, com))
            own = body_mass[k] * (a - gravity)
            given = body_load[k] + body_wrench[k]
            given += tie_and_drag_wrench(
                k, dt, tree_phi[tree], tree_air[tree], body_com, body_drag, tie_span, tie_point, tie_anchor,
                tie_stiffness, tie_damping, pose, body_qd[k], body_acceleration[k],
            )  # fmt: skip
            arm = wp.transform_get_translation(pose) - at
            force += own - wp.spatial_top(given)
            moment += wp.cross(arm + com, own) + inertia * alpha + wp.cross(omega, inertia * omega)
            moment -= wp.cross(arm, wp.spatial_top(given)) + wp.spatial_bottom(given)
    wrench_out[slot] = wp.spatial_vector(force, moment)
