"""Blades of a batch of worlds: what is in the mouth of a closing blade, and whether the blade's force suffices.

The law is that of :mod:`vinesim.interaction.blades` for a blade that closes within a step: it cuts all peduncles in its
mouth, and one cane of each tree, if its force is that of the cut, and nothing otherwise.
"""

import warp as wp

from vinesim.kernels.contact.body_motion import to_double

wp.set_module_options({"enable_backward": False})

CANE = wp.constant(1)
PEDUNCLE = wp.constant(2)
"""Kinds of bodies that blades cut, see :class:`Wood`."""
NONE = wp.constant(-1)
WHOLE = wp.constant(-2)
"""A cut at the joint of the bunch itself, which leaves all of its stalk on the vine."""


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
    cane_strength: wp.float64
    """[Pa] The same of a cane."""
    power: wp.float64
    """[1] Exponent of :func:`force_share`."""
    gap_step: wp.float64
    """[m] Distance between two gaps at which the force of a closing is evaluated."""
    same_cut: wp.float64
    """[m] Wood of a cane that is shorter than this before or beyond a cut is not cut again."""
    least: wp.float64
    """[m] Length of the shortest wood of a cane that can be cut."""


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
class Canes:
    """The parts of canes [body], which cuts change. A segment that was cut has a body for each part; all have its
    frame."""

    can_cut: wp.array(dtype=wp.int32)
    """1 for segments that can be cut: bare wood of a tree with spare bodies and without ties."""
    length: wp.array(dtype=float)
    """m, length of the segment."""
    segment: wp.array(dtype=wp.int32)
    """Segment of which a body is a part: itself, or that of a stump; -1: a spare body."""
    start: wp.array(dtype=float)
    """m, from the origin to the beginning of the body's wood."""
    end: wp.array(dtype=float)
    """m, from the origin to the end of its wood."""


@wp.struct
class Cuts:
    """What blades cut in this step."""

    cane: wp.array(dtype=wp.int32)
    """[tree] Body of the cane that is cut; -1: none."""
    cane_at: wp.array(dtype=wp.float64)
    """[tree] m, place of the cut from the body's origin."""
    cane_force: wp.array(dtype=wp.float64)
    """[tree] N, largest force of a cut there."""
    cane_diameter: wp.array(dtype=wp.float64)
    """[tree] m."""

    segment: wp.array(dtype=wp.int32)
    """[bunch] Body of the segment of its peduncle that is cut; -1: the bunch hangs on, or has left; -2: see
    :data:`WHOLE`."""
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
def axis_in_mouth(mouth: wp.transformd, half: wp.vec3d, pose: wp.transform, start: float, end: float):
    """Returns the heights [m] of the start of a body's axis above the plane in which the blades close and of its end
    above its start, and the shares of the axis between which it is in the mouth; it is not in it if the first share is
    larger than the second. ``mouth``: pose of the mouth in the world. ``start``, ``end`` [m]: places of both ends of
    the axis along the body."""
    first = wp.transform_point(
        wp.transform_inverse(mouth), to_double(wp.transform_point(pose, wp.vec3(start, 0.0, 0.0)))
    )
    tip = to_double(wp.transform_point(pose, wp.vec3(end, 0.0, 0.0)))
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
def cut_at(segment: int, place: wp.float64, strength: wp.float64, wood: Wood):
    """Returns the diameter [m] of a segment at a ``place`` [m] along it, and the largest force [N] of a cut there."""
    radius = wood.radius[segment]
    start = wp.float64(radius[0])
    length = wp.max(wp.float64(wood.length[segment]), wp.float64(1.0e-9))
    diameter = wp.float64(2.0) * (start + (wp.float64(radius[1]) - start) * place / length)
    return diameter, strength * wp.float64(0.25) * wp.float64(wp.pi) * diameter * diameter


@wp.func
def find_cane(
    tree: int,
    blade: BladeNumbers,
    mouth: wp.transformd,
    first: int,
    size: int,
    pitch: int,
    wood: Wood,
    canes: Canes,
    is_cut: wp.array(dtype=wp.bool),
    body_q: wp.array(dtype=wp.transform),
    cuts_out: Cuts,
):
    """Write where a blade would cut a cane of a tree: of those whose axis crosses the plane in which the blades close, in
    the mouth, the first. Returns whether it is one that cannot be cut."""
    found = int(NONE)
    for k in range(first, first + size * pitch, pitch):
        segment = canes.segment[k]
        if found < 0 and segment >= 0 and wood.kind[wp.max(segment, 0)] == CANE:
            start = canes.start[k]
            end = canes.end[k]
            height, rise, enter, leave = axis_in_mouth(mouth, blade.half, body_q[k], start, end)
            share = nearest_share(height, rise, enter, leave)
            apart = wp.abs(height + share * rise)
            thickness = wp.float64(0.5 * (wood.radius[segment][0] + wood.radius[segment][1]))
            before = share * wp.float64(end - start)
            beyond = wp.float64(end - start) - before
            is_new = before >= blade.same_cut or not (start > 0.0 or is_cut[k])
            is_new = is_new and (beyond >= blade.same_cut or end >= canes.length[segment])
            is_new = is_new and wp.float64(end - start) >= blade.least
            if enter <= leave and apart <= thickness and is_new:
                found = k
                place = wp.float64(start) + before
                diameter, force = cut_at(segment, place, blade.cane_strength, wood)
                cuts_out.cane_at[tree] = place
                cuts_out.cane_diameter[tree] = diameter
                cuts_out.cane_force[tree] = force
    cuts_out.cane[tree] = found
    return found >= 0 and canes.can_cut[canes.segment[wp.max(found, 0)]] == 0


@wp.func
def hangs_from(k: int, cane: int, body_parent: wp.array(dtype=wp.int32)):
    """Returns whether body ``k`` is beyond the body ``cane`` of its tree."""
    at = int(k)
    while at > cane:
        at = body_parent[at]
    return at == cane and k != cane


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
        height, rise, enter, leave = axis_in_mouth(mouth, blade.half, body_q[k], 0.0, wood.length[k])
        share = nearest_share(height, rise, enter, leave)
        apart = wp.abs(height + share * rise)
        if enter <= leave and apart < nearest:
            nearest = apart
            segment = k
            place = share * wp.float64(wood.length[k])
        k = body_parent[k]
    cuts_out.segment[bunch] = segment
    if segment >= 0:
        diameter, force = cut_at(segment, place, blade.strength, wood)
        cuts_out.at[bunch] = place
        cuts_out.diameter[bunch] = diameter
        cuts_out.force[bunch] = force


@wp.func
def force_at(depth: wp.float64, most: wp.float64, power: wp.float64):
    """Returns the force [N] of a cut at a ``depth``, whose largest force is ``most`` [N]; 0 before the edges touch."""
    return wp.where(depth > wp.float64(0.0), most * force_share(depth, power), wp.float64(0.0))


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
    canes: Canes,
    is_cut: wp.array(dtype=wp.bool),
    body_q: wp.array(dtype=wp.transform),
    xpos: wp.array2d(dtype=wp.vec3),
    xquat: wp.array2d(dtype=wp.quat),
    # out
    closing_out: wp.array(dtype=wp.bool),
    needed_out: wp.array(dtype=float),
    cuts_out: Cuts,
):
    """One thread per world. Close its blade if it shall: list the bunches and the canes that the blade cuts off.

    is_free: [bunch] 1 if the bunch has left its vine. is_cut: [body] whether a body was cut off. xpos, xquat: mujoco_warp's poses of bodies (wxyz). closing:
    [world] whether the blade closes; cleared here. needed: [world] N, force that the last closing takes; infinite if a
    cane that cannot be cut, or wood thicker than the mouth, is between the blades: then nothing is cut.
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
        cuts_out.cane[tree] = NONE
        if closes:
            first = tree_first[tree]
            size = tree_size[tree]
            stops = find_cane(tree, blade, mouth, first, size, pitch, wood, canes, is_cut, body_q, cuts_out)
            if stops or (cuts_out.cane[tree] >= 0 and cuts_out.cane_diameter[tree] > opening):
                needed = wp.float64(wp.inf)
        for k in range(wood.tree_start[tree], wood.tree_start[tree + 1]):
            bunch = wood.of_tree[k]
            cuts_out.segment[bunch] = NONE
            if closes and is_free[bunch] == 0:
                find_cut(bunch, blade, mouth, wood, body_parent, body_q, cuts_out)
                if cuts_out.cane[tree] >= 0 and hangs_from(cuts_out.segment[bunch], cuts_out.cane[tree], body_parent):
                    cuts_out.segment[bunch] = NONE
                if cuts_out.segment[bunch] >= 0 and cuts_out.diameter[bunch] > opening:
                    needed = wp.float64(wp.inf)
    if not closes:
        return
    steps = int(wp.ceil(opening / blade.gap_step))
    for i in range(steps + 1):
        gap = opening * (wp.float64(1.0) - wp.float64(i) / wp.float64(steps))
        force = wp.float64(0.0)
        for tree in range(world, trees, worlds):
            if cuts_out.cane[tree] >= 0:
                depth = wp.float64(1.0) - gap / cuts_out.cane_diameter[tree]
                force = force + force_at(depth, cuts_out.cane_force[tree], blade.power)
            for k in range(wood.tree_start[tree], wood.tree_start[tree + 1]):
                bunch = wood.of_tree[k]
                if cuts_out.segment[bunch] >= 0:
                    depth = wp.float64(1.0) - gap / cuts_out.diameter[bunch]
                    force = force + force_at(depth, cuts_out.force[bunch], blade.power)
        needed = wp.max(needed, force * blade.factor)
    needed_out[world] = wp.float32(needed)
    if needed > blade.force or not wp.isfinite(needed):
        for tree in range(world, trees, worlds):
            cuts_out.cane[tree] = NONE
            for k in range(wood.tree_start[tree], wood.tree_start[tree + 1]):
                bunch = wood.of_tree[k]
                cuts_out.segment[bunch] = NONE
