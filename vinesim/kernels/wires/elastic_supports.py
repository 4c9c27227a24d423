"""Elastic supports of shoots: taut wires, which their ties deflect, and arms of a cordon, which they twist.

A support is light compared with the shoots, or far stiffer than a step can follow, so it is always in balance. Its
nodes are the places where shoots hold it, with springs in series between them: T / l for a wire, with tension T and
free length l; G J / l for an arm. In balance K u = f, where K is tridiagonal and u are the deflections. The force of
node i is f_i = k_i (s_i - u_i). For a wire, k is the stiffness of a tie and s the displacement of its point across the
wire. For an arm, f is the moment along the arm of the spring of a root's joint. With the rest of that spring turned by
u e in the joint's axes, e along the arm, its energy is (theta - u e)^T K_joint (theta - u e) / 2, so that k =
e^T K_joint e and k s = e^T K_joint (theta - theta_drawn). The shoots feel the force (K^-1 + k^-1)^-1 s: its stiffness
is symmetric and less than that of ties and joints alone. Other forces on a wire (*loads*) add to f. A wire does not
stretch along itself. It ends at posts; an arm is clamped at the trunk and free at its end.

Ties and joints are implicit in the prediction of each tree, with anchors and rests on the support. The support follows
the trees' state at the start of the step, and moves on as fast as they do. Compared with a solve of all trees of a
support at once, only k K'^-1 k times the acceleration is left out, K' = K + k. This is a positive semidefinite mass,
(phi dt)^2 k at most, with which the scheme stays as stable as without supports, whatever K and k are.
"""

import warp as wp

from vinesim.kernels.plants.forces import in_middle_axes, middle_axes_scale
from vinesim.kernels.plants.spatial import half_rotation

wp.set_module_options({"enable_backward": False})


@wp.struct
class SupportNodes:
    """Places where shoots hold supports, support by support from its start to its end. [node] unless said otherwise."""

    first: wp.array(dtype=wp.int32)  # [support + 1] the support's first node
    is_arm: wp.array(dtype=wp.bool)  # [support] whether the support is an arm
    last_stiffness: wp.array(dtype=wp.float64)  # [support] N/m, N m/rad: stiffness behind its last node; 0: a free end
    stiffness: wp.array(dtype=wp.float64)  # [N/m, N m/rad] stiffness between this node and the one before, or the start
    axis: wp.array(dtype=wp.vec3d)  # unit vector along a wire, in the world; along an arm, in joint axes
    body: wp.array(dtype=wp.int32)  # body that the tie holds; on an arm, the root
    tree: wp.array(dtype=wp.int32)  # tree of that body
    number: wp.array(dtype=wp.int32)  # index of the tie among the ties of its body
    point: wp.array(dtype=wp.vec3d)  # [m] point of the tie in the body
    origin: wp.array(
        dtype=wp.vec3d
    )  # [m] anchor of the tie, [rad] rotation vector of the joint, while nothing has moved
    wake_distance: wp.array(dtype=wp.float64)  # [m, rad] distance that the node may move under a sleeping tree


@wp.struct
class SupportState:
    """Deflections of the supports, and intermediate values of the solve. [node]"""

    load: wp.array(dtype=wp.vec3d)  # [N] force on a wire at the node, without the ties; in the world
    deflection: wp.array(dtype=wp.vec3d)  # [m] in the world; [rad, 0, 0] for an arm
    reference: wp.array(dtype=wp.vec3d)  # the deflection when the node's tree was last awake or was last placed
    ratio: wp.array(dtype=wp.float64)  # [1] ratio of a node's deflection to that of the next node
    velocity: wp.array(dtype=wp.vec3d)  # [m/s], [rad/s, 0, 0]
    share: wp.array(dtype=wp.float64)  # [1] deflection by a common displacement of all awake trees, per unit of it


@wp.struct
class Wires:
    """Pieces of wire under tension. [piece], of all fixed pieces, unless said otherwise."""

    tension: wp.array(dtype=wp.float64)  # [N] tension
    length: wp.array(dtype=wp.float64)  # [m] length
    support: wp.array(dtype=wp.int32)  # index of the piece's support; -1: no tie is bound to the piece
    node_along: wp.array(dtype=wp.float64)  # [node] m, distance from the start of the node's piece


@wp.struct
class SupportedBodies:
    """Bodies and joints at the start of the step. [body]"""

    body_q: wp.array(dtype=wp.transform)  # [m, xyzw]
    body_qd: wp.array(dtype=wp.spatial_vector)  # [m/s, rad/s]
    joint_q: wp.array(dtype=wp.quat)
    joint_qd: wp.array(dtype=wp.vec3)  # [rad/s] in joint axes
    joint_stiffness: wp.array(dtype=wp.vec3)  # [N m/rad] in joint axes


@wp.struct
class SupportedSprings:
    """Ties and rests of root springs that the kernels of supports write. They only read ``span`` and ``stiffness``."""

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
    """Returns the vector in double precision."""
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def vec3f(v: wp.vec3d):
    """Returns the vector in single precision."""
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.func
def pull_of_tie(i: int, stiffness: wp.float64, nodes: SupportNodes, bodies: SupportedBodies):
    """Returns a tie's stiffness k [N/m], and k s [N] and its rate [N/s], with s the displacement of its point across
    the wire.
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
    """Returns the stiffness k [N m/rad] of a root's spring about the arm, and k s [N m, 0, 0] and its rate.

    s is the turn of the shoot.
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
    """Turn the rest of a root's spring with its arm, by ``deflection`` [rad]."""
    tree = nodes.tree[i]
    axis = nodes.axis[i]
    gradient = wp.cw_mul(vec3d(bodies.joint_stiffness[nodes.body[i]]), axis)
    springs_out.root_turn[tree] = vec3f(deflection * axis)
    springs_out.root_turn_rate[tree] = vec3f(velocity * axis)
    stiffness = wp.max(wp.dot(gradient, axis), wp.float64(1.0e-30))
    springs_out.root_softening[tree] = vec3f(wp.sqrt(wp.max(share, wp.float64(0.0)) / stiffness) * gradient)


@wp.kernel
def balance_supports(
    # model
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
    is_moved_out: wp.array(dtype=wp.bool),
    moved_count_out: wp.array(dtype=wp.int32),
):
    """One thread per support. Bring it to balance with the trees that it holds, by elimination along it.

    supports: [thread] index of the support. is_placed: [tree] sleeping trees that were placed since the last step.
    state_out, springs_out: of this support's nodes. is_moved_out: [tree] set for sleeping trees under which the support
    has moved further than ``wake_distance`` since they fell asleep; moved_count_out: [1] raised by one for each of
    them.
    """
    if wp.tid() >= count[0]:
        return
    support = supports[wp.tid()]
    first = nodes.first[support]
    end = nodes.first[support + 1]
    is_arm = nodes.is_arm[support]
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    left = nodes.stiffness[first]
    ratio = zero
    deflection = wp.vec3d()
    velocity = wp.vec3d()
    share = zero
    for i in range(first, end):
        right = nodes.last_stiffness[support]
        if i + 1 < end:
            right = nodes.stiffness[i + 1]
        stiffness = zero
        moved = wp.vec3d()
        motion = wp.vec3d()
        if is_arm:
            stiffness, moved, motion = pull_of_root(i, nodes, bodies)
        else:
            stiffness = wp.float64(springs_out.stiffness[springs_out.span[nodes.body[i]][0] + nodes.number[i]])
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
    """Returns the stiffness k [N/m] of the tie of a wire's node, and k s [N]; see :func:`pull_of_tie`."""
    stiffness = wp.float64(springs.stiffness[springs.span[nodes.body[i]][0] + nodes.number[i]])
    stiffness, moved, _ = pull_of_tie(i, stiffness, nodes, bodies)
    return stiffness, moved


@wp.func
def in_series(a: wp.float64, b: wp.float64):
    """Returns the stiffness of two springs in series."""
    return a * b / (a + b)


@wp.func
def wire_spring(
    piece: int,
    x: wp.float64,
    least_share: wp.float64,
    wires: Wires,
    nodes: SupportNodes,
    bodies: SupportedBodies,
    springs: SupportedSprings,
    loads: wp.array(dtype=wp.vec3d),
):
    """Returns the spring with which a wire resists, ``x`` [m] from its start, while its shoots stay where they are.

    Its stiffness across the wire [N/m]; the offset of the point without loads [m] from its undeflected position; and by
    how much the ``loads`` [node] N move it from there [m], without the loads between its own two nodes.
    ``least_share``: least distance from a post or a node, as a share of the length.
    """
    tension = wires.tension[piece]
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
    behind = wp.float64(0.0)  # stiffness of all springs up to a node, its tie included
    right_first = end
    for i in range(first, end):
        if wires.node_along[i] < x:
            between = nodes.stiffness[i]
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
        between = nodes.last_stiffness[support]
        if j > 0:
            between = in_series(nodes.stiffness[i + 1], behind)
        stiffness, pull = pull_of_node(i, nodes, bodies, springs)
        behind = stiffness + between
        right_rest = (pull + between * right_rest) / behind
        right_deflection = (loads[i] + between * right_deflection) / behind
        right = in_series(tension / wp.max(wires.node_along[i] - x, least), behind)
    whole = left + right
    rest = (left * left_rest + right * right_rest) / whole
    deflection = (left * left_deflection + right * right_deflection) / whole
    return whole, rest, deflection
