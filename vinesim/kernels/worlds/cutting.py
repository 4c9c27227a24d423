"""Blades of a batch of worlds: what is in the mouth of a closing blade, and whether the blade's force suffices.

The law is that of :mod:`vinesim.interaction.blades` for a blade that closes within a step: it cuts all peduncles in its
mouth if its force is that of the cut, and nothing otherwise.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import to_double

wp.set_module_options({"enable_backward": False})

CANE = wp.constant(1)
PEDUNCLE = wp.constant(2)
"""Kinds of bodies that blades cut, see :class:`Wood`."""
NONE = wp.constant(-1)


@wp.struct
class BladeNumbers:
    """The blade of each world's robot, and the strength of the wood."""

    body: int
    """MuJoCo body of the link that carries the blade."""
    pose: wp.transformd
    """[m] Pose of the mouth in the link: x along the blades, y from blade to blade, z across their plane."""
    half: wp.vec3d
    """[m] Half edges of the mouth."""
    force: wp.float64
    """[N] Largest force."""
    factor: wp.float64
    """[1] Force of this kind of blade relative to a bypass blade."""
    strength: wp.float64
    """[Pa] Largest cutting force of a peduncle per cross-section."""
    power: wp.float64
    """[1] Exponent of :func:`force_share`."""
    gap_step: wp.float64
    """[m] Distance between two gaps at which the force of a closing is evaluated."""


@wp.struct
class Wood:
    """Shapes of the plants' bodies [body], and the bunches."""

    kind: wp.array(dtype=wp.int32)
    """[body] :data:`CANE`, :data:`PEDUNCLE`, or 0."""
    length: wp.array(dtype=float)
    """[body] m."""
    radius: wp.array(dtype=wp.vec2)
    """[body] m, at the start and at the end."""
    bunch_body: wp.array(dtype=wp.int32)
    """[bunch] Body of the bunch."""
    of_tree: wp.array(dtype=wp.int32)
    """[k] Bunches, sorted by tree."""
    tree_start: wp.array(dtype=wp.int32)
    """[tree + 1] First entry of each tree in ``of_tree``."""


@wp.struct
class Cuts:
    """What blades cut in this step."""

    segment: wp.array(dtype=wp.int32)
    """[bunch] Body of the segment of its peduncle that is cut; -1: the bunch hangs on, or has left."""
    at: wp.array(dtype=wp.float64)
    """[bunch] m, place of the cut along the segment."""
    force: wp.array(dtype=wp.float64)
    """[bunch] N, largest force of a cut there."""
    diameter: wp.array(dtype=wp.float64)
    """[bunch] m."""


@wp.func
def force_share(depth: wp.float64, power: wp.float64):
    """Returns :func:`vinesim.interaction.cutting_force.force_share`: the force at a ``depth``, as a share of the largest
    force. ``power``: the exponent that belongs to the cutting energy."""
    inside = wp.clamp(depth, wp.float64(0.0), wp.float64(1.0))
    return wp.pow(wp.float64(4.0) * inside * (wp.float64(1.0) - inside), power)


@wp.func
def axis_in_mouth(mouth: wp.transformd, half: wp.vec3d, pose: wp.transform, length: wp.float64):
    """Returns the heights [m] of the start of a body's axis above the plane in which the blades close and of its end
    above its start, and the shares of the axis between which it is in the mouth; it is not in it if the first share is
    larger than the second. ``mouth``: pose of the mouth in the world."""
    first = wp.transform_point(wp.transform_inverse(mouth), to_double(wp.transform_get_translation(pose)))
    tip = to_double(wp.transform_point(pose, wp.vec3(wp.float32(length), 0.0, 0.0)))
    along = wp.transform_point(wp.transform_inverse(mouth), tip) - first
    enter = wp.float64(0.0)
    leave = wp.float64(1.0)
    for i in range(3):
        step = wp.where(wp.abs(along[i]) < wp.float64(1.0e-12), wp.float64(1.0e-12), along[i])
        one = (-half[i] - first[i]) / step
        other = (half[i] - first[i]) / step
        enter = wp.max(enter, wp.min(one, other))
        leave = wp.min(leave, wp.max(one, other))
    return first[2], along[2], enter, leave


@wp.func
def nearest_share(height: wp.float64, rise: wp.float64, enter: wp.float64, leave: wp.float64):
    """Returns the share of an axis in the mouth at which it is nearest to the plane in which the blades close."""
    climb = wp.where(wp.abs(rise) < wp.float64(1.0e-12), wp.float64(1.0e-12), rise)
    return wp.clamp(-height / climb, enter, leave)


@wp.func
def has_cane(
    tree: int,
    mouth: wp.transformd,
    half: wp.vec3d,
    first: int,
    size: int,
    pitch: int,
    wood: Wood,
    body_q: wp.array(dtype=wp.transform),
):
    """Returns whether a cane of a tree crosses the plane in which the blades close, in the mouth."""
    found = bool(False)
    for k in range(first, first + size * pitch, pitch):
        if wood.kind[k] == CANE:
            height, rise, enter, leave = axis_in_mouth(mouth, half, body_q[k], wp.float64(wood.length[k]))
            apart = wp.abs(height + nearest_share(height, rise, enter, leave) * rise)
            thickness = wp.float64(0.5 * (wood.radius[k][0] + wood.radius[k][1]))
            found = found or (enter <= leave and apart <= thickness)
    return found


@wp.func
def find_cut(
    bunch: int,
    blade: BladeNumbers,
    mouth: wp.transformd,
    wood: Wood,
    body_parent: wp.array(dtype=wp.int32),
    body_q: wp.array(dtype=wp.transform),
    cuts_out: Cuts,
):
    """Write where a blade would cut the peduncle of a bunch: at the point in the mouth that is nearest to the plane in
    which the blades close."""
    nearest = wp.float64(wp.inf)
    segment = int(NONE)
    place = wp.float64(0.0)
    k = body_parent[wood.bunch_body[bunch]]
    while k >= 0 and wood.kind[wp.max(k, 0)] == PEDUNCLE:
        height, rise, enter, leave = axis_in_mouth(mouth, blade.half, body_q[k], wp.float64(wood.length[k]))
        share = nearest_share(height, rise, enter, leave)
        apart = wp.abs(height + share * rise)
        if enter <= leave and apart < nearest:
            nearest = apart
            segment = k
            place = share * wp.float64(wood.length[k])
        k = body_parent[k]
    cuts_out.segment[bunch] = segment
    if segment >= 0:
        radius = wood.radius[segment]
        start = wp.float64(radius[0])
        length = wp.max(wp.float64(wood.length[segment]), wp.float64(1.0e-9))
        diameter = wp.float64(2.0) * (start + (wp.float64(radius[1]) - start) * place / length)
        cuts_out.at[bunch] = place
        cuts_out.diameter[bunch] = diameter
        cuts_out.force[bunch] = blade.strength * wp.float64(0.25) * wp.float64(wp.pi) * diameter * diameter


@wp.kernel
def close_blades(
    # model
    blade: BladeNumbers,
    worlds: int,
    trees: int,
    pitch: int,
    tree_first: wp.array(dtype=wp.int32),
    tree_size: wp.array(dtype=wp.int32),
    body_parent: wp.array(dtype=wp.int32),
    wood: Wood,
    # in
    is_free: wp.array(dtype=wp.int32),
    body_q: wp.array(dtype=wp.transform),
    xpos: wp.array2d(dtype=wp.vec3),
    xquat: wp.array2d(dtype=wp.quat),
    # out
    closing_out: wp.array(dtype=wp.bool),
    needed_out: wp.array(dtype=float),
    cuts_out: Cuts,
):
    """One thread per world. Close its blade if it shall: list the bunches that the blade cuts off.

    is_free: [bunch] 1 if the bunch has left its vine. xpos, xquat: mujoco_warp's poses of bodies (wxyz). closing:
    [world] whether the blade closes; cleared here. needed: [world] N, force that the last closing takes; infinite if a
    cane, or wood thicker than the mouth, is between the blades, of which nothing is cut.
    """
    world = wp.tid()
    closes = closing_out[world]
    closing_out[world] = False
    turn = xquat[world, blade.body]
    link = wp.transformd(
        to_double(xpos[world, blade.body]),
        wp.normalize(wp.quatd(wp.float64(turn[1]), wp.float64(turn[2]), wp.float64(turn[3]), wp.float64(turn[0]))),
    )
    mouth = link * blade.pose
    opening = wp.float64(2.0) * blade.half[1]
    needed = wp.float64(0.0)
    for tree in range(world, trees, worlds):
        if closes and has_cane(tree, mouth, blade.half, tree_first[tree], tree_size[tree], pitch, wood, body_q):
            needed = wp.float64(wp.inf)
        for k in range(wood.tree_start[tree], wood.tree_start[tree + 1]):
            bunch = wood.of_tree[k]
            cuts_out.segment[bunch] = NONE
            if closes and is_free[bunch] == 0:
                find_cut(bunch, blade, mouth, wood, body_parent, body_q, cuts_out)
                if cuts_out.segment[bunch] >= 0 and cuts_out.diameter[bunch] > opening:
                    needed = wp.float64(wp.inf)
    if not closes:
        return
    steps = int(wp.ceil(opening / blade.gap_step))
    for i in range(steps + 1):
        gap = opening * (wp.float64(1.0) - wp.float64(i) / wp.float64(steps))
        force = wp.float64(0.0)
        for tree in range(world, trees, worlds):
            for k in range(wood.tree_start[tree], wood.tree_start[tree + 1]):
                bunch = wood.of_tree[k]
                if cuts_out.segment[bunch] >= 0:
                    depth = wp.float64(1.0) - gap / cuts_out.diameter[bunch]
                    if depth > wp.float64(0.0):
                        force = force + cuts_out.force[bunch] * force_share(depth, blade.power)
        needed = wp.max(needed, force * blade.factor)
    needed_out[world] = wp.float32(needed)
    if needed > blade.force or not wp.isfinite(needed):
        for tree in range(world, trees, worlds):
            for k in range(wood.tree_start[tree], wood.tree_start[tree + 1]):
                bunch = wood.of_tree[k]
                cuts_out.segment[bunch] = NONE
