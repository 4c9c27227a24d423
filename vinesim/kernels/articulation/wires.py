"""Wires: taut strings between posts, which the ties of shoots deflect.

A wire is light beside the shoots, so that it is always in balance: with tension T and free lengths l between the places
where ties are bound to it, K u = f, where K is tridiagonal with T / l. The force of tie i is f_i = k_i (s_i - u_i), with s
the displacement of its point across the wire. What shoots feel is (K^-1 + k^-1)^-1 s: symmetric, and less stiff than
the ties alone. Along itself a wire does not give.

Ties are implicit in the prediction of each tree, with their anchors on the wire; the wire follows the trees' state at the
start of the step, and moves on as fast as they do. Against a solve of all trees of a wire at once only k K'^-1 k times the
acceleration is left out, K' = K + k: a positive semidefinite mass, (phi dt)^2 k at most, with which the scheme stays
as stable as without wires, whatever T and k are.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

MIN_SPACING = wp.constant(wp.float64(1.0e-3))
"""[m] Ties on one wire are taken to be at least so far from each other and from its ends."""


@wp.struct
class WireNodes:
    """Where ties are bound to wires, wire by wire from its start to its end. [node] unless said otherwise."""

    wire_first: wp.array(dtype=wp.int32)  # [wire + 1] its first node
    wire_length: wp.array(dtype=wp.float64)  # [wire] m
    wire_tension: wp.array(dtype=wp.float64)  # [wire] N
    wire_axis: wp.array(dtype=wp.vec3d)  # [wire] unit vector
    along: wp.array(dtype=wp.float64)  # [m] from the start
    body: wp.array(dtype=wp.int32)  # that the tie holds
    tree: wp.array(dtype=wp.int32)  # of that body
    number: wp.array(dtype=wp.int32)  # of the tie among those of its body
    point: wp.array(dtype=wp.vec3d)  # [m] in the body
    anchor: wp.array(dtype=wp.vec3d)  # [m] of the tie while the wire is straight


@wp.struct
class WireShape:
    """How wires lie, and what the solve needs on its way. [node]"""

    deflection: wp.array(dtype=wp.vec3d)  # [m]
    reference: wp.array(dtype=wp.vec3d)  # [m] the deflection when the node's tree was last awake or put somewhere
    ratio: wp.array(dtype=wp.float64)  # [1] of a node's deflection to that of the next
    velocity: wp.array(dtype=wp.vec3d)  # [m/s]
    share: wp.array(dtype=wp.float64)  # [1] deflection if all awake trees move as one, by the same


@wp.struct
class WireTies:
    """The tie table as wires write it."""

    span: wp.array(dtype=wp.vec2i)  # [body] first tie, and the one after the last
    stiffness: wp.array(dtype=float)  # [tie] N/m
    anchor: wp.array(dtype=wp.vec3)  # [tie] m
    anchor_velocity: wp.array(dtype=wp.vec3)  # [tie] m/s
    softening: wp.array(dtype=float)  # [tie] N/m by which the wire makes the tie less stiff


@wp.func
def vec3d(v: wp.vec3):
    """The same in double precision."""
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def vec3f(v: wp.vec3d):
    """The same in single precision."""
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.kernel
def deflect_wires(
    # model
    nodes: WireNodes,
    wake_distance: float,
    # in
    wires: wp.array(dtype=wp.int32),
    tree_awake: wp.array(dtype=wp.bool),
    is_placed: wp.array(dtype=wp.bool),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
    # out
    shape_out: WireShape,
    ties_out: WireTies,
    is_moved_out: wp.array(dtype=wp.bool),
    moved_count_out: wp.array(dtype=wp.int32),
):
    """One thread brings one wire to balance with the trees that are tied to it, by elimination along the wire.

    wires: [thread] which. is_placed: [tree] sleeping trees that were put somewhere since the last step. body_q, body_qd: [body] at the start of the step. shape_out, ties_out: of this wire's nodes;
    ``span`` and ``stiffness`` are read. is_moved_out: [tree] set for sleeping trees whose anchor has moved further than
    wake_distance [m] since they fell asleep; moved_count_out: [1] raised for each.
    """
    wire = wires[wp.tid()]
    first = nodes.wire_first[wire]
    end = nodes.wire_first[wire + 1]
    tension = nodes.wire_tension[wire]
    axis = nodes.wire_axis[wire]
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    left = tension / wp.max(nodes.along[first], MIN_SPACING)
    ratio = zero
    deflection = wp.vec3d()
    velocity = wp.vec3d()
    share = zero
    for i in range(first, end):
        here = nodes.along[i]
        after = nodes.wire_length[wire]
        if i + 1 < end:
            after = nodes.along[i + 1]
        right = tension / wp.max(after - here, MIN_SPACING)
        body = nodes.body[i]
        stiffness = wp.float64(ties_out.stiffness[ties_out.span[body][0] + nodes.number[i]])
        pose = body_q[body]
        turn = wp.transform_get_rotation(pose)
        rotation = wp.quatd(wp.float64(turn[0]), wp.float64(turn[1]), wp.float64(turn[2]), wp.float64(turn[3]))
        arm = wp.quat_rotate(rotation, nodes.point[i])
        moved = vec3d(wp.transform_get_translation(pose)) + arm - nodes.anchor[i]
        motion = vec3d(wp.spatial_top(body_qd[body])) + wp.cross(vec3d(wp.spatial_bottom(body_qd[body])), arm)
        moved = moved - wp.dot(axis, moved) * axis
        motion = motion - wp.dot(axis, motion) * axis
        pivot = one / (left + right + stiffness - left * ratio)
        deflection = pivot * (stiffness * moved + left * deflection)
        velocity = pivot * (stiffness * motion + left * velocity)
        share = pivot * (wp.where(tree_awake[nodes.tree[i]], stiffness, zero) + left * share)
        ratio = pivot * right
        shape_out.deflection[i] = deflection
        shape_out.velocity[i] = velocity
        shape_out.share[i] = share
        shape_out.ratio[i] = ratio
        left = right
    deflection = wp.vec3d()
    velocity = wp.vec3d()
    share = zero
    for j in range(end - first):
        i = end - 1 - j
        ratio = shape_out.ratio[i]
        deflection = shape_out.deflection[i] + ratio * deflection
        velocity = shape_out.velocity[i] + ratio * velocity
        share = shape_out.share[i] + ratio * share
        shape_out.deflection[i] = deflection
        tree = nodes.tree[i]
        tie = ties_out.span[nodes.body[i]][0] + nodes.number[i]
        ties_out.anchor[tie] = vec3f(nodes.anchor[i] + deflection)
        ties_out.anchor_velocity[tie] = vec3f(velocity)
        ties_out.softening[tie] = ties_out.stiffness[tie] * wp.float32(share)
        if tree_awake[tree] or is_placed[tree]:
            shape_out.reference[i] = deflection
        elif wp.length(deflection - shape_out.reference[i]) > wp.float64(wake_distance):
            is_moved_out[tree] = True
            wp.atomic_add(moved_count_out, 0, 1)
