"""Elastic supports of shoots: taut wires, which the ties of shoots deflect, and arms of a cordon, which shoots twist.

A support is light compared with the shoots, or far stiffer than a step can resolve, so it is kept in static balance.
Its nodes are the places where shoots are attached. Between nodes are springs in series, of stiffness T / l for a wire
with tension T and free length l, and G J / l for an arm. In balance K u = f, where K is tridiagonal and u are the
deflections. The force of node i is f_i = k_i (s_i - u_i). For a wire, k is the stiffness of a tie and s the
displacement of its point across the wire. For an arm, f is the moment along the arm of the spring of a root's joint.
With the rest of that spring turned by u e in the joint's axes, e along the arm, its energy is (theta - u e)^T K_joint
(theta - u e) / 2, so that k = e^T K_joint e and k s = e^T K_joint (theta - theta_drawn). The shoots feel the force
(K^-1 + k^-1)^-1 s: its stiffness is symmetric and less than that of ties and joints alone. Other forces on a wire
(*loads*) add to f. A wire does not stretch along its axis, and its ends are fixed at posts. An arm is clamped at the
trunk and free at its other end.

The prediction of each tree treats its ties and joints implicitly, with the anchors of ties and the rest angles of
joints on the support. The support's deflection follows from the trees' state at the start of the step; within the step
it changes at the rate that follows from the trees' velocities. Compared with a solve of all trees of a support at once,
this neglects only k K'^-1 k times the acceleration, with K' = K + k. That term is a positive semidefinite mass, at most
(phi dt)^2 k, so the scheme stays as stable as without supports for all K and k. Here phi is the implicitness of the
integrator, 0.5 trapezoidal to 1 backward Euler.
"""

import warp as wp

from vinesim.kernels.plants.forces import in_middle_axes, middle_axes_scale
from vinesim.kernels.plants.spatial import half_rotation

wp.set_module_options({"enable_backward": False})

LEAST_RISE = wp.constant(wp.float64(1.0e-4))
"""[1] Change of a wire's tension, as a share of it, that is not followed further."""
MOST_TURNS = wp.constant(12)
"""Largest number of steps of Newton's method for the tension of a wire in one step."""


@wp.struct
class SupportNodes:
    """Places where shoots are attached to supports, ordered by support and from its start to its end.

    Arrays are [node] unless stated otherwise.
    """

    first: wp.array(dtype=wp.int32)  # [support + 1] the support's first node
    is_arm: wp.array(dtype=wp.bool)  # [support] whether the support is an arm
    last_stiffness: wp.array(
        dtype=wp.float64
    )  # [support] N/m, N m/rad: stiffness between last node and end; 0: free end
    stiffness: wp.array(
        dtype=wp.float64
    )  # [N/m, N m/rad] stiffness between the previous node (or the support's start) and this node
    axis: wp.array(dtype=wp.vec3d)  # unit vector along a wire, in the world; along an arm, in joint axes
    body: wp.array(dtype=wp.int32)  # body that the tie holds; on an arm, the root
    tree: wp.array(dtype=wp.int32)  # tree of that body
    number: wp.array(dtype=wp.int32)  # index of the tie among the ties of its body
    piece: wp.array(dtype=wp.int32)  # [support] piece of wire, -1 for an arm
    point: wp.array(dtype=wp.vec3d)  # [m] point of the tie in the body
    origin: wp.array(
        dtype=wp.vec3d
    )  # [m] anchor of the tie, [rad] rotation vector of the joint, while nothing has moved
    wake_distance: wp.array(dtype=wp.float64)  # [m, rad] distance that the node may move under a sleeping tree


@wp.struct
class SupportState:
    """Deflections of the supports, and intermediate values of the solve. Arrays are [node]."""

    load: wp.array(dtype=wp.vec3d)  # [N] force on a wire at the node, except the ties' forces; in the world
    deflection: wp.array(dtype=wp.vec3d)  # [m] in the world; [rad, 0, 0] for an arm
    reference: wp.array(dtype=wp.vec3d)  # the deflection when the node's tree was last awake or was last placed
    ratio: wp.array(dtype=wp.float64)  # [1] ratio of a node's deflection to that of the next node
    velocity: wp.array(dtype=wp.vec3d)  # [m/s], [rad/s, 0, 0]
    share: wp.array(dtype=wp.float64)  # [1] deflection by a common displacement of all awake trees, per unit of it
    fall: wp.array(dtype=wp.vec3d)  # [m/N] decrease of the deflection per unit of tension


@wp.struct
class Wires:
    """Wires under tension. Arrays are [piece] over all fixed pieces of the scene, unless stated otherwise."""

    tension: wp.array(dtype=wp.float64)  # [N] tension now; 0: the wire is broken
    straight_tension: wp.array(dtype=wp.float64)  # [N] tension while the wire is straight
    stretch: wp.array(dtype=wp.float64)  # [N/m] rise of the tension for each metre that the piece gets longer
    bulge: wp.array(
        dtype=wp.float64
    )  # [N^2 m] lengthening by presses, beyond that of the line through the nodes, times tension squared
    resistance: wp.array(
        dtype=wp.float64
    )  # [1] fall of (tension - stretch * lengthening) if the tension falls, minus 1, per unit
    length: wp.array(dtype=wp.float64)  # [m] length
    support: wp.array(dtype=wp.int32)  # index of the piece's support; -1: no tie is bound to the piece
    node_along: wp.array(dtype=wp.float64)  # [node] m, distance from the start of the node's piece


@wp.struct
class SupportedBodies:
    """State of plant bodies and their joints at the start of the step. Arrays are [body]."""

    body_q: wp.array(dtype=wp.transform)  # [m, xyzw]
    body_qd: wp.array(dtype=wp.spatial_vector)  # [m/s, rad/s]
    joint_q: wp.array(dtype=wp.quat)
    joint_qd: wp.array(dtype=wp.vec3)  # [rad/s] in joint axes
    joint_stiffness: wp.array(dtype=wp.vec3)  # [N m/rad] in joint axes


@wp.struct
class SupportedSprings:
    """Anchors of ties (springs from shoots to wires) and rest poses of the springs of root joints, written by the
    kernels of supports.

    The kernels of supports only read ``span`` and ``stiffness``.
    """

    span: wp.array(dtype=wp.vec2i)  # [body] first tie of the body, and the one after the last
    stiffness: wp.array(dtype=float)  # [tie] N/m
    anchor: wp.array(dtype=wp.vec3)  # [tie] m
    anchor_velocity: wp.array(dtype=wp.vec3)  # [tie] m/s
    softening: wp.array(dtype=float)  # [tie] N/m by which the wire makes the tie less stiff
    root_turn: wp.array(dtype=wp.vec3)  # [tree] rad, joint axes
    root_turn_rate: wp.array(dtype=wp.vec3)  # [tree] rad/s, joint axes
    root_softening: wp.array(dtype=wp.vec3)  # [tree] (N m/rad)^(1/2), joint axes


@wp.func
def vec3d(v: wp.vec3):
    """Returns ``v`` converted to double precision."""
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def vec3f(v: wp.vec3d):
    """Returns ``v`` converted to single precision."""
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.func
def pull_of_tie(i: int, stiffness: wp.float64, nodes: SupportNodes, bodies: SupportedBodies):
    """Returns the stiffness k [N/m] of the tie at node ``i`` of a wire, its force k s [N] and the force's rate [N/s].

    s is the displacement of the tied point of the shoot across the wire.
    """
    axis = nodes.axis[i]
    body = nodes.body[i]
    pose = bodies.body_q[body]
    turn = wp.transform_get_rotation(pose)
    rotation = wp.quatd(wp.float64(turn[0]), wp.float64(turn[1]), wp.float64(turn[2]), wp.float64(turn[3]))
    arm = wp.quat_rotate(rotation, nodes.point[i])
    moved = vec3d(wp.transform_get_translation(pose)) + arm - nodes.origin[i]
    motion = vec3d(wp.spatial_top(bodies.body_qd[body])) + wp.cross(vec3d(wp.spatial_bottom(bodies.body_qd[body])), arm)
    moved = moved - wp.dot(axis, moved) * axis
    motion = motion - wp.dot(axis, motion) * axis
    return stiffness, stiffness * moved, stiffness * motion


@wp.func
def pull_of_root(i: int, nodes: SupportNodes, bodies: SupportedBodies):
    """Returns the stiffness k [N m/rad] of the root joint at node ``i`` about its arm, the moment k s [N m, 0, 0] and
    its rate.

    s is the rotation [rad] of the shoot about the arm.
    """
    body = nodes.body[i]
    s, excess, v = middle_axes_scale(bodies.joint_q[body])
    rate = wp.quat_rotate_inv(half_rotation(bodies.joint_q[body]), bodies.joint_qd[body])
    gradient = wp.cw_mul(vec3d(bodies.joint_stiffness[body]), nodes.axis[i])
    zero = wp.float64(0.0)
    moved = wp.dot(gradient, vec3d(2.0 * s * v) - nodes.origin[i])
    motion = wp.dot(gradient, vec3d(in_middle_axes(s, excess, v, rate)))
    return wp.dot(gradient, nodes.axis[i]), wp.vec3d(moved, zero, zero), wp.vec3d(motion, zero, zero)


@wp.func
def turn_rest(
    i: int,
    deflection: wp.float64,
    velocity: wp.float64,
    share: wp.float64,
    nodes: SupportNodes,
    bodies: SupportedBodies,
    springs_out: SupportedSprings,
):
    """Rotate the rest pose of the root joint's spring at node ``i`` of an arm with the twist of the arm, ``deflection``
    [rad].

    ``velocity`` [rad/s]: rate of the twist; ``share``: see ``SupportState.share``.
    """
    tree = nodes.tree[i]
    axis = nodes.axis[i]
    gradient = wp.cw_mul(vec3d(bodies.joint_stiffness[nodes.body[i]]), axis)
    springs_out.root_turn[tree] = vec3f(deflection * axis)
    springs_out.root_turn_rate[tree] = vec3f(velocity * axis)
    stiffness = wp.max(wp.dot(gradient, axis), wp.float64(1.0e-30))
    springs_out.root_softening[tree] = vec3f(wp.sqrt(wp.max(share, wp.float64(0.0)) / stiffness) * gradient)


@wp.func
def stiffness_before(i: int, support: int, nodes: SupportNodes):
    """Returns the stiffness of the part of a support before node ``i``; beyond its last node, of the part behind it."""
    if i < nodes.first[support + 1]:
        return nodes.stiffness[i]
    return nodes.last_stiffness[support]


@wp.func
def kink(i: int, support: int, nodes: SupportNodes, deflection: wp.array(dtype=wp.vec3d)):
    """Returns the change of the length of a wire, times its straight tension, per displacement of node ``i`` [N]."""
    here = deflection[i]
    before = wp.vec3d()
    after = wp.vec3d()
    if i > nodes.first[support]:
        before = deflection[i - 1]
    if i + 1 < nodes.first[support + 1]:
        after = deflection[i + 1]
    left = stiffness_before(i, support, nodes)
    right = stiffness_before(i + 1, support, nodes)
    return left * (here - before) - right * (after - here)


@wp.func
def lengthening(support: int, straight: wp.float64, nodes: SupportNodes, deflection: wp.array(dtype=wp.vec3d)):
    """Returns by how much [m] the line through the nodes of a wire with ``deflection`` is longer than the straight
    wire: the sum of squares of its slopes times lengths, halved."""
    total = wp.float64(0.0)
    last = wp.vec3d()
    for i in range(nodes.first[support], nodes.first[support + 1]):
        total += nodes.stiffness[i] * wp.length_sq(deflection[i] - last)
        last = deflection[i]
    total += nodes.last_stiffness[support] * wp.length_sq(last)
    return wp.float64(0.5) * total / straight


@wp.func
def deflect_nodes(
    support: int,
    taut: wp.float64,
    nodes: SupportNodes,
    tree_awake: wp.array(dtype=wp.bool),
    bodies: SupportedBodies,
    springs: SupportedSprings,
    state_out: SupportState,
):
    """Solve the static balance of one support by tridiagonal elimination: deflection, velocity and share of its nodes.

    ``taut`` [1]: tension of a wire over its tension while it is straight; 1 for an arm.
    """
    first = nodes.first[support]
    end = nodes.first[support + 1]
    is_arm = nodes.is_arm[support]
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    left = taut * nodes.stiffness[first]
    ratio = zero
    deflection = wp.vec3d()
    velocity = wp.vec3d()
    share = zero
    for i in range(first, end):
        right = taut * stiffness_before(i + 1, support, nodes)
        stiffness = zero
        moved = wp.vec3d()
        motion = wp.vec3d()
        if is_arm:
            stiffness, moved, motion = pull_of_root(i, nodes, bodies)
        else:
            stiffness = wp.float64(springs.stiffness[springs.span[nodes.body[i]][0] + nodes.number[i]])
            stiffness, moved, motion = pull_of_tie(i, stiffness, nodes, bodies)
            moved = moved + state_out.load[i]
        pivot = one / (left + right + stiffness - left * ratio)
        deflection = pivot * (moved + left * deflection)
        velocity = pivot * (motion + left * velocity)
        share = pivot * (wp.where(tree_awake[nodes.tree[i]], stiffness, zero) + left * share)
        ratio = pivot * right
        state_out.deflection[i] = deflection
        state_out.velocity[i] = velocity
        state_out.share[i] = share
        state_out.ratio[i] = ratio
        left = right
    deflection = wp.vec3d()
    velocity = wp.vec3d()
    share = zero
    for j in range(end - first):
        i = end - 1 - j
        ratio = state_out.ratio[i]
        deflection = state_out.deflection[i] + ratio * deflection
        velocity = state_out.velocity[i] + ratio * velocity
        share = state_out.share[i] + ratio * share
        state_out.deflection[i] = deflection
        state_out.velocity[i] = velocity
        state_out.share[i] = share


@wp.func
def find_fall(
    support: int,
    taut: wp.float64,
    straight: wp.float64,
    nodes: SupportNodes,
    springs: SupportedSprings,
    state_out: SupportState,
):
    """Find the decrease of a wire's deflection per unit of its tension, at ``taut`` times its ``straight`` tension [N].

    Returns the decrease of its length per unit of tension [m/N], and its change of length per second [m/s] with the
    nodes' velocities at constant tension.
    """
    first = nodes.first[support]
    end = nodes.first[support + 1]
    zero = wp.float64(0.0)
    left = taut * nodes.stiffness[first]
    ratio = zero
    fall = wp.vec3d()
    for i in range(first, end):
        right = taut * stiffness_before(i + 1, support, nodes)
        stiffness = wp.float64(springs.stiffness[springs.span[nodes.body[i]][0] + nodes.number[i]])
        pivot = wp.float64(1.0) / (left + right + stiffness - left * ratio)
        fall = pivot * (kink(i, support, nodes, state_out.deflection) / straight + left * fall)
        ratio = pivot * right
        state_out.fall[i] = fall
        left = right
    fall = wp.vec3d()
    shorter = zero
    speed = zero
    for j in range(end - first):
        i = end - 1 - j
        fall = state_out.fall[i] + state_out.ratio[i] * fall
        state_out.fall[i] = fall
        bend = kink(i, support, nodes, state_out.deflection) / straight
        shorter = shorter + wp.dot(bend, fall)
        speed = speed + wp.dot(bend, state_out.velocity[i])
    return shorter, speed


@wp.func
def tighten(
    support: int,
    piece: int,
    wires: Wires,
    nodes: SupportNodes,
    tree_awake: wp.array(dtype=wp.bool),
    bodies: SupportedBodies,
    springs: SupportedSprings,
    state_out: SupportState,
    tension_out: wp.array(dtype=wp.float64),
    resistance_out: wp.array(dtype=wp.float64),
):
    """Find the tension of a wire that its deflection lengthens, by Newton's method, and its deflection with it.

    The tension is the root of T - T_straight - stretch * lengthening(T), which grows with T. The nodes' velocities
    include that of the tension.
    """
    one = wp.float64(1.0)
    straight = wires.straight_tension[piece]
    stretch = wires.stretch[piece]
    tension = tension_out[piece]
    resistance = wp.float64(0.0)
    for turn in range(MOST_TURNS):
        deflect_nodes(support, tension / straight, nodes, tree_awake, bodies, springs, state_out)
        bulge = wires.bulge[piece] / (tension * tension)
        longer = lengthening(support, straight, nodes, state_out.deflection) + bulge
        missing = straight + stretch * longer - tension
        if stretch * longer < LEAST_RISE * straight and wp.abs(missing) < LEAST_RISE * straight:
            break
        shorter, speed = find_fall(support, tension / straight, straight, nodes, springs, state_out)
        resistance = stretch * (shorter + wp.float64(2.0) * bulge / tension)
        step = missing / (one + resistance)
        if wp.abs(step) < LEAST_RISE * tension or turn == MOST_TURNS - 1:
            rise = stretch * speed / (one + resistance)
            for i in range(nodes.first[support], nodes.first[support + 1]):
                state_out.velocity[i] = state_out.velocity[i] - rise * state_out.fall[i]
                state_out.deflection[i] = state_out.deflection[i] - step * state_out.fall[i]
            tension = tension + step
            break
        tension = wp.max(tension + step, straight)
    tension_out[piece] = tension
    resistance_out[piece] = resistance


@wp.kernel
def balance_supports(
    # model
    wires: Wires,
    nodes: SupportNodes,
    # in
    count: wp.array(dtype=wp.int32),
    supports: wp.array(dtype=wp.int32),
    tree_awake: wp.array(dtype=wp.bool),
    is_placed: wp.array(dtype=wp.bool),
    bodies: SupportedBodies,
    # out
    state_out: SupportState,
    springs_out: SupportedSprings,
    tension_out: wp.array(dtype=wp.float64),
    resistance_out: wp.array(dtype=wp.float64),
    is_moved_out: wp.array(dtype=wp.bool),
    moved_count_out: wp.array(dtype=wp.int32),
):
    """One thread solves the static balance of one support (wire or arm) with the trees on it, by tridiagonal
    elimination.

    count: [1] number of supports; supports: [thread] index of the support; is_placed: [tree] sleeping trees that were
    moved to another pose since the last step; state, springs: results at this support's nodes; tension, resistance:
    [piece] those of ``wires``; is_moved: [tree] set for sleeping trees whose support has moved further than
    ``wake_distance`` since they fell asleep; moved_count: [1] number of such trees.
    """
    if wp.tid() >= count[0]:
        return
    support = supports[wp.tid()]
    first = nodes.first[support]
    end = nodes.first[support + 1]
    is_arm = nodes.is_arm[support]
    piece = nodes.piece[support]
    if not is_arm and wires.tension[piece] <= wp.float64(0.0):
        for i in range(first, end):
            state_out.deflection[i] = wp.vec3d()
        return
    if not is_arm and wires.stretch[piece] > wp.float64(0.0):
        tighten(support, piece, wires, nodes, tree_awake, bodies, springs_out, state_out, tension_out, resistance_out)
    else:
        deflect_nodes(support, wp.float64(1.0), nodes, tree_awake, bodies, springs_out, state_out)
    for i in range(first, end):
        deflection = state_out.deflection[i]
        velocity = state_out.velocity[i]
        share = state_out.share[i]
        tree = nodes.tree[i]
        if is_arm:
            turn_rest(i, deflection[0], velocity[0], share, nodes, bodies, springs_out)
        else:
            tie = springs_out.span[nodes.body[i]][0] + nodes.number[i]
            springs_out.anchor[tie] = vec3f(nodes.origin[i] + deflection)
            springs_out.anchor_velocity[tie] = vec3f(velocity)
            springs_out.softening[tie] = springs_out.stiffness[tie] * wp.float32(share)
        if tree_awake[tree] or is_placed[tree]:
            state_out.reference[i] = deflection
        elif wp.length(deflection - state_out.reference[i]) > nodes.wake_distance[i]:
            is_moved_out[tree] = True
            wp.atomic_add(moved_count_out, 0, 1)


@wp.func
def pull_of_node(i: int, nodes: SupportNodes, bodies: SupportedBodies, springs: SupportedSprings):
    """Returns the stiffness k [N/m] of the tie at node ``i`` of a wire, and its force k s [N]. s is the displacement of
    the tied point of the shoot across the wire; see :func:`pull_of_tie`.
    """
    stiffness = wp.float64(springs.stiffness[springs.span[nodes.body[i]][0] + nodes.number[i]])
    stiffness, moved, _ = pull_of_tie(i, stiffness, nodes, bodies)
    return stiffness, moved


@wp.func
def in_series(a: wp.float64, b: wp.float64):
    """Returns the stiffness of two springs in series with stiffnesses ``a`` and ``b``."""
    return a * b / (a + b)


@wp.func
def wire_spring(
    piece: int,
    x: wp.float64,
    tension: wp.float64,
    least_share: wp.float64,
    wires: Wires,
    nodes: SupportNodes,
    bodies: SupportedBodies,
    springs: SupportedSprings,
    loads: wp.array(dtype=wp.vec3d),
):
    """Returns the spring by which a wire resists a force at its point ``x`` [m] from its start, while its shoots stand
    still.

    Returns the stiffness across the wire [N/m]; the displacement of the point by the ties alone [m, world]; and the
    further displacement by ``loads`` [node] N [m, world], except loads between the two nodes next to the point.
    ``tension`` [N]: tension of the wire. ``least_share``: least distance of the point from a post or node, as a share
    of the wire's length.
    """
    taut = tension / wires.straight_tension[piece]
    length = wires.length[piece]
    least = least_share * length
    support = wires.support[piece]
    first = int(0)
    end = int(0)
    if support >= 0:
        first = nodes.first[support]
        end = nodes.first[support + 1]
    left = tension / wp.max(x, least)
    left_rest = wp.vec3d()
    left_deflection = wp.vec3d()
    behind = wp.float64(0.0)  # stiffness of all springs up to and including a node's tie
    right_first = end
    for i in range(first, end):
        if wires.node_along[i] < x:
            between = taut * nodes.stiffness[i]
            if i > first:
                between = in_series(between, behind)
            stiffness, pull = pull_of_node(i, nodes, bodies, springs)
            behind = stiffness + between
            left_rest = (pull + between * left_rest) / behind
            left_deflection = (loads[i] + between * left_deflection) / behind
            left = in_series(tension / wp.max(x - wires.node_along[i], least), behind)
        elif right_first == end:
            right_first = i
    right = tension / wp.max(length - x, least)
    right_rest = wp.vec3d()
    right_deflection = wp.vec3d()
    for j in range(end - right_first):
        i = end - 1 - j
        between = taut * nodes.last_stiffness[support]
        if j > 0:
            between = in_series(taut * nodes.stiffness[i + 1], behind)
        stiffness, pull = pull_of_node(i, nodes, bodies, springs)
        behind = stiffness + between
        right_rest = (pull + between * right_rest) / behind
        right_deflection = (loads[i] + between * right_deflection) / behind
        right = in_series(tension / wp.max(wires.node_along[i] - x, least), behind)
    whole = left + right
    rest = (left * left_rest + right * right_rest) / whole
    deflection = (left * left_deflection + right * right_deflection) / whole
    return whole, rest, deflection
