"""Contacts of plants with rigid bodies and each other: who is close, how contacts couple, what keeps them apart.

A plant's shape is a segment with a radius (a sphere when both ends agree), a rigid body's is one of MuJoCo's
primitives. One function gives the distance and direction from a point to a primitive; along a segment that distance
is convex, so one bisection of its slope finds where the two are closest, for every pair of kinds alike.

A contact has a plant's shape on its one side; on the other a rigid shape (its number) or another plant's (-1 - its
number). What overlaps as drawn, or stands that close, is held apart only from there on.

Contacts are solved for impulses at the end of the tick, in double precision: normal n (from the other side to the
plant) and two tangents, a Coulomb cone, an implicit spring and damper in each direction, and for friction an *anchor*:
the stretch that remembers where a sticking contact began.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

PLANE = wp.constant(0)
SPHERE = wp.constant(2)
CAPSULE = wp.constant(3)
ELLIPSOID = wp.constant(4)
CYLINDER = wp.constant(5)
BOX = wp.constant(6)

# what is counted in one tick: awake trees, hits, hits without room, trees that are struck, plant bodies in contact,
# whether constraints of MuJoCo's own bind what is touched, islands of contacts that do not feel each other, and the axis
# along which trees are sorted
TREES = wp.constant(0)
HITS = wp.constant(1)
MISSED = wp.constant(2)
STRUCK = wp.constant(3)
BODIES = wp.constant(4)
BOUND = wp.constant(5)
ISLANDS = wp.constant(6)
AXIS = wp.constant(7)

SKIN = wp.constant(wp.float64(0.002))
"""Contacts are seen from this gap on [m], and from as far as the two can come together in one tick."""

HAIR = wp.constant(wp.float64(0.0002))
"""What stands and other branches count when a tick brings them closer than this [m]."""

AGREE = wp.constant(wp.float64(0.5))
"""Least cosine between the normals before and after a tick for which the contact moves on smoothly."""

ABRUPT = wp.constant(wp.float64(0.3))
"""[m/s] A contact that closes faster is a blow."""

vec5d = wp.types.vector(length=5, dtype=wp.float64)
vec6d = wp.types.vector(length=6, dtype=wp.float64)

FLAT = wp.constant(wp.float64(0.999))
"""Least cosine between the normals at both ends of what runs along a face."""

FACE_BISECTIONS = wp.constant(12)
BLOCK = wp.constant(32)
"""So many things that do not move share one box, and are sorted out by one comparison."""

BISECTIONS = wp.constant(30)
FASTEST_EXIT = wp.constant(wp.float64(1.0))
"""Overlap is undone at this speed at most [m/s]."""


@wp.func
def distance(kind: int, size: wp.vec3d, p: wp.vec3d):
    """Outward normal (x, y, z) and signed distance (w) of point p from a primitive, in the primitive's frame."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    tiny = wp.float64(1.0e-12)
    if kind == PLANE:
        return wp.vec4d(zero, zero, one, p[2])
    if kind == SPHERE or kind == CAPSULE:
        q = wp.vec3d(p[0], p[1], p[2] - wp.clamp(p[2], -size[1], size[1]))
        length = wp.length(q)
        n = wp.vec3d(one, zero, zero)
        if length > tiny:
            n = q / length
        return wp.vec4d(n[0], n[1], n[2], length - size[0])
    if kind == ELLIPSOID:  # first order in the distance: exact on the surface
        a = wp.cw_div(p, size)
        b = wp.cw_div(a, size)
        stretch = wp.length(a)
        slope = wp.length(b)
        if slope < tiny:
            return wp.vec4d(zero, zero, one, -size[2])
        n = b / slope
        return wp.vec4d(n[0], n[1], n[2], stretch * (stretch - one) / slope)
    if kind == CYLINDER:
        rho = wp.sqrt(p[0] * p[0] + p[1] * p[1])
        side = wp.vec3d(one, zero, zero)
        if rho > tiny:
            side = wp.vec3d(p[0] / rho, p[1] / rho, zero)
        cap = wp.vec3d(zero, zero, wp.where(p[2] < zero, -one, one))
        across = rho - size[0]
        along = wp.abs(p[2]) - size[1]
        if across > zero and along > zero:
            gap = wp.sqrt(across * across + along * along)
            n = (across * side + along * cap) / gap
            return wp.vec4d(n[0], n[1], n[2], gap)
        if across > along:
            return wp.vec4d(side[0], side[1], side[2], across)
        return wp.vec4d(cap[0], cap[1], cap[2], along)
    # box
    q = wp.vec3d(
        wp.clamp(p[0], -size[0], size[0]), wp.clamp(p[1], -size[1], size[1]), wp.clamp(p[2], -size[2], size[2])
    )
    out = p - q
    gap = wp.length(out)
    if gap > tiny:
        n = out / gap
        return wp.vec4d(n[0], n[1], n[2], gap)
    depth = wp.vec3d(size[0] - wp.abs(p[0]), size[1] - wp.abs(p[1]), size[2] - wp.abs(p[2]))
    if depth[0] <= depth[1] and depth[0] <= depth[2]:
        return wp.vec4d(wp.where(p[0] < zero, -one, one), zero, zero, -depth[0])
    if depth[1] <= depth[2]:
        return wp.vec4d(zero, wp.where(p[1] < zero, -one, one), zero, -depth[1])
    return wp.vec4d(zero, zero, wp.where(p[2] < zero, -one, one), -depth[2])


@wp.func
def slope(kind: int, size: wp.vec3d, p: wp.vec3d, along: wp.vec3d):
    """How fast the distance grows when the point moves along a direction."""
    n = distance(kind, size, p)
    return n[0] * along[0] + n[1] * along[1] + n[2] * along[2]


@wp.func
def closest(kind: int, size: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    """Where (0 to 1) on the segment from a to b the primitive is closest; the middle of all such places if many."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    half = wp.float64(0.5)
    along = b - a
    flat = wp.float64(1.0e-9) * wp.length(along)
    if flat == zero:
        return zero
    if slope(kind, size, a, along) > flat:
        return zero
    if slope(kind, size, b, along) < -flat:
        return one
    # where the slope stops being negative, where it starts being positive
    low = zero
    high = one
    for i in range(BISECTIONS):
        middle = half * (low + high)
        if slope(kind, size, a + middle * along, along) < -flat:
            low = middle
        else:
            high = middle
    first = high
    low = first
    high = one
    if slope(kind, size, a + wp.min(first + wp.float64(1.0e-6), one) * along, along) > flat:
        return first
    for i in range(BISECTIONS):
        middle = half * (low + high)
        if slope(kind, size, a + middle * along, along) > flat:
            high = middle
        else:
            low = middle
    return half * (first + low)


@wp.func
def nearest(kind: int, size: wp.vec3d, rotation: wp.mat33d, middle: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    """World normal (0 to 2) and distance (3) of a primitive from a segment, and where on the segment that is (4)."""
    back = wp.transpose(rotation)
    start = back * (a - middle)
    along = back * (b - middle) - start
    t = closest(kind, size, start, start + along)
    n = distance(kind, size, start + t * along)
    normal = rotation * wp.vec3d(n[0], n[1], n[2])
    return vec5d(normal[0], normal[1], normal[2], n[3], t)


@wp.func
def close_to_flat(kind: int):
    """Whether a segment can lie along this kind of primitive."""
    return kind == BOX or kind == CAPSULE or kind == CYLINDER


@wp.func
def level(least: wp.vec4d, there: wp.vec4d):
    """Whether a point lies along the same face as the closest one."""
    agree = least[0] * there[0] + least[1] * there[1] + least[2] * there[2]
    return agree > FLAT and there[3] < least[3] + SKIN


@wp.func
def along_face(kind: int, size: wp.vec3d, a: wp.vec3d, b: wp.vec3d, t: wp.float64):
    """Both ends (0 to 1) of what runs along a primitive about its closest point; one place twice if it crosses it.

    A segment that lies along a face needs two contacts: with one, it rocks about it from tick to tick.
    """
    half = wp.float64(0.5)
    along = b - a
    least = distance(kind, size, a + t * along)
    ends = wp.vec2d(wp.float64(0.0), wp.float64(1.0))
    for side in range(2):
        if not level(least, distance(kind, size, a + ends[side] * along)):
            outer = ends[side]
            inner = t
            for i in range(FACE_BISECTIONS):
                middle = half * (outer + inner)
                if level(least, distance(kind, size, a + middle * along)):
                    inner = middle
                else:
                    outer = middle
            ends[side] = inner
    if (ends[1] - ends[0]) * wp.length(along) < wp.float64(2.0) * SKIN:
        ends = wp.vec2d(t, t)
    return ends


@wp.func
def crossing(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """World normal (0 to 2) and distance (3) from the segment c d to a b, where on a b that is (4), where on c d (5)."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    tiny = wp.float64(1.0e-12)
    u = b - a
    v = d - c
    w = a - c
    uu = wp.dot(u, u)
    vv = wp.dot(v, v)
    uv = wp.dot(u, v)
    uw = wp.dot(u, w)
    vw = wp.dot(v, w)
    s = zero
    spread = uu * vv - uv * uv
    if spread > tiny * uu * vv:
        s = wp.clamp((uv * vw - vv * uw) / spread, zero, one)
    elif uu > tiny and vv > tiny:  # side by side: the middle of where both run
        low = wp.clamp(wp.min(-uw, uv - uw) / uu, zero, one)
        high = wp.clamp(wp.max(-uw, uv - uw) / uu, zero, one)
        s = wp.float64(0.5) * (low + high)
    t = zero
    if vv > tiny:
        t = wp.clamp((uv * s + vw) / vv, zero, one)
    if uu > tiny:
        s = wp.clamp((uv * t - uw) / uu, zero, one)
    between = w + s * u - t * v
    length = wp.length(between)
    n = wp.vec3d(zero, zero, one)
    if length > tiny:
        n = between / length
    return vec6d(n[0], n[1], n[2], length, s, t)


@wp.func
def turn(angle: wp.vec3d, rotation: wp.mat33d):
    """A rotation turned by a small angle, to second order."""
    columns = wp.transpose(rotation)
    x = columns[0] + wp.cross(angle, columns[0] + wp.float64(0.5) * wp.cross(angle, columns[0]))
    y = columns[1] + wp.cross(angle, columns[1] + wp.float64(0.5) * wp.cross(angle, columns[1]))
    z = columns[2] + wp.cross(angle, columns[2] + wp.float64(0.5) * wp.cross(angle, columns[2]))
    return wp.matrix_from_cols(x, y, z)


@wp.func
def tangent(n: wp.vec3d):
    """A unit vector across n, the same for the same n."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    other = wp.vec3d(zero, one, zero)
    if wp.abs(n[0]) < wp.float64(0.7):
        other = wp.vec3d(one, zero, zero)
    return wp.normalize(wp.cross(n, other))


@wp.func
def to_double(v: wp.vec3):
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.kernel
def bound_geoms(
    # model
    dt: wp.float64,
    geom_id: wp.array(dtype=wp.int32),
    geom_body: wp.array(dtype=wp.int32),
    geom_root: wp.array(dtype=wp.int32),
    geom_center: wp.array(dtype=wp.vec3d),
    geom_half: wp.array(dtype=wp.vec3d),
    geom_dof: wp.array(dtype=wp.int32),
    dof_parent: wp.array(dtype=wp.int32),
    # in
    xpos: wp.array(dtype=wp.vec3d),
    xmat: wp.array(dtype=wp.mat33d),
    cvel: wp.array2d(dtype=wp.float64),
    cdof: wp.array2d(dtype=wp.float64),
    dof_free: wp.array(dtype=wp.float64),
    dof_held: wp.array(dtype=wp.float64),
    dof_held_before: wp.array(dtype=wp.float64),
    subtree_com: wp.array(dtype=wp.vec3d),
    # out
    middle_out: wp.array(dtype=wp.vec3d),
    velocity_out: wp.array(dtype=wp.vec3d),
    spin_out: wp.array(dtype=wp.vec3d),
    speed_out: wp.array(dtype=wp.float64),
    low_out: wp.array(dtype=wp.vec3),
    high_out: wp.array(dtype=wp.vec3),
):
    """Motion of one rigid shape's middle, and its box in the world, grown by how far it can come in a tick."""
    g = wp.tid()
    rotation = xmat[geom_id[g]]
    middle = xpos[geom_id[g]] + rotation * geom_center[g]
    body = geom_body[g]
    spin = wp.vec3d(cvel[body, 0], cvel[body, 1], cvel[body, 2])
    velocity = wp.vec3d(cvel[body, 3], cvel[body, 4], cvel[body, 5])
    arm = middle - subtree_com[geom_root[g]]
    velocity = velocity + wp.cross(spin, arm)
    half = geom_half[g]
    extent = wp.length(half)
    speed = wp.length(velocity) + wp.length(spin) * extent
    # a drive may start within the tick: as fast as it will be if it is held back as in the last two, or by nothing
    linear_likely = wp.vec3d()
    spin_likely = wp.vec3d()
    linear_free = wp.vec3d()
    spin_free = wp.vec3d()
    dof = geom_dof[g]
    while dof >= 0:
        angular = wp.vec3d(cdof[dof, 0], cdof[dof, 1], cdof[dof, 2])
        linear = wp.vec3d(cdof[dof, 3], cdof[dof, 4], cdof[dof, 5]) + wp.cross(angular, arm)
        rate = dof_free[dof]
        linear_free += rate * linear
        spin_free += rate * angular
        one = dof_held[dof]
        other = dof_held_before[dof]
        if one * other > wp.float64(0.0):
            rate += wp.where(wp.abs(one) < wp.abs(other), one, other)
        linear_likely += rate * linear
        spin_likely += rate * angular
        dof = dof_parent[dof]
    speed = wp.max(speed, wp.length(linear_likely) + wp.length(spin_likely) * extent)
    grown = SKIN + dt * wp.max(speed, wp.length(linear_free) + wp.length(spin_free) * extent)
    box = wp.vec3()
    for i in range(3):
        reach = wp.abs(rotation[i, 0]) * half[0] + wp.abs(rotation[i, 1]) * half[1] + wp.abs(rotation[i, 2]) * half[2]
        box[i] = wp.float32(reach + grown)
    center = wp.vec3(wp.float32(middle[0]), wp.float32(middle[1]), wp.float32(middle[2]))
    middle_out[g] = middle
    velocity_out[g] = velocity
    spin_out[g] = spin
    speed_out[g] = speed
    low_out[g] = center - box
    high_out[g] = center + box


@wp.func
def here(when: int, fine: bool):
    """Whether a shape counts: always (0), while its tree is coarse (1), while it is fine (2)."""
    return when == 0 or (when == 2) == fine


@wp.func
def ahead(dt: float, pose: wp.transform, motion: wp.spatial_vector, bend: wp.spatial_vector, point: wp.vec3):
    """Where a point of a body will be after a tick, to second order in the tick."""
    arm = point - wp.transform_get_translation(pose)
    omega = wp.spatial_bottom(motion)
    velocity = wp.spatial_top(motion) + wp.cross(omega, arm)
    turn = wp.cross(omega, wp.cross(omega, arm))
    return point + dt * (velocity + 0.5 * dt * (wp.spatial_top(bend) + wp.cross(wp.spatial_bottom(bend), arm) + turn))


@wp.func
def bent(
    body: int,
    body_parent: wp.array(dtype=wp.int32),
    body_cut: wp.array(dtype=wp.bool),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
):
    """The acceleration of a body while all joints between it and its root turn steadily."""
    here = wp.transform_get_translation(body_q[body])
    a = wp.vec3()
    alpha = wp.vec3()
    k = int(body)
    while k >= 0:
        above = body_parent[k]
        if body_cut[k]:
            above = -1
        if above >= 0:
            at = wp.transform_get_translation(body_q[k])
            turning = wp.spatial_bottom(body_qd[above])
            swing = wp.cross(turning, wp.spatial_bottom(body_qd[k]))
            alpha += swing
            a += wp.cross(swing, here - at)
            a += wp.cross(turning, wp.cross(turning, at - wp.transform_get_translation(body_q[above])))
        k = above
    return wp.spatial_vector(a, alpha)


@wp.kernel
def bound_trees(
    # model
    dt: float,
    tree_shape: wp.array(dtype=wp.int32),
    shape_body: wp.array(dtype=wp.int32),
    shape_bunch: wp.array(dtype=wp.int32),
    shape_when: wp.array(dtype=wp.int32),
    shape_start: wp.array(dtype=wp.vec3),
    shape_end: wp.array(dtype=wp.vec3),
    shape_radius: wp.array(dtype=float),
    shape_reach: wp.array(dtype=float),
    # in
    every: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
    tree_fine: wp.array(dtype=wp.bool),
    # out
    start_out: wp.array(dtype=wp.vec3),
    end_out: wp.array(dtype=wp.vec3),
    speed_out: wp.array(dtype=float),
    shape_low_out: wp.array(dtype=wp.vec3),
    shape_high_out: wp.array(dtype=wp.vec3),
    wood_low_out: wp.array(dtype=wp.vec3),
    wood_high_out: wp.array(dtype=wp.vec3),
    low_out: wp.array(dtype=wp.vec3),
    high_out: wp.array(dtype=wp.vec3),
):
    """Put the shapes of one tree into the world and find their boxes, that of the tree, and that of its wood."""
    tree = trees[every[wp.tid()]]
    fine = tree_fine[tree]
    low = wp.vec3(1.0e30)
    high = wp.vec3(-1.0e30)
    wood_low = wp.vec3(1.0e30)
    wood_high = wp.vec3(-1.0e30)
    for s in range(tree_shape[tree], tree_shape[tree + 1]):
        if here(shape_when[s], fine):
            body = shape_body[s]
            pose = body_q[body]
            motion = body_qd[body]
            start = wp.transform_point(pose, shape_start[s])
            end = wp.transform_point(pose, shape_end[s])
            speed = wp.length(wp.spatial_top(motion)) + shape_reach[s] * wp.length(wp.spatial_bottom(motion))
            grown = wp.vec3(shape_radius[s] + speed * dt)
            shape_low = wp.min(start, end) - grown
            shape_high = wp.max(start, end) + grown
            low = wp.min(low, shape_low)
            high = wp.max(high, shape_high)
            if shape_bunch[s] < 0:
                wood_low = wp.min(wood_low, shape_low)
                wood_high = wp.max(wood_high, shape_high)
            start_out[s] = start
            end_out[s] = end
            speed_out[s] = speed
            shape_low_out[s] = shape_low
            shape_high_out[s] = shape_high
    wood_low_out[tree] = wood_low
    wood_high_out[tree] = wood_high
    low_out[tree] = low
    high_out[tree] = high


@wp.kernel
def bound_actors(
    # model
    stir: wp.float64,
    actor_first: wp.array(dtype=wp.int32),
    actor_lies: wp.array(dtype=wp.bool),
    # in
    geom_speed: wp.array(dtype=wp.float64),
    geom_low: wp.array(dtype=wp.vec3),
    geom_high: wp.array(dtype=wp.vec3),
    # out
    low_out: wp.array(dtype=wp.vec3),
    high_out: wp.array(dtype=wp.vec3),
):
    """Box in the world around one actor; an empty one if it is of the kind that lies about and does not stir."""
    actor = wp.tid()
    low = wp.vec3(1.0e30)
    high = wp.vec3(-1.0e30)
    fastest = wp.float64(0.0)
    for g in range(actor_first[actor], actor_first[actor + 1]):
        low = wp.min(low, geom_low[g])
        high = wp.max(high, geom_high[g])
        fastest = wp.max(fastest, geom_speed[g])
    if actor_lies[actor] and fastest < stir:
        low = wp.vec3(1.0e30)
        high = wp.vec3(-1.0e30)
    low_out[actor] = low
    high_out[actor] = high


@wp.func
def apart(a_low: wp.vec3, a_high: wp.vec3, b_low: wp.vec3, b_high: wp.vec3):
    """Whether two boxes have nothing in common."""
    return (
        a_low[0] > b_high[0]
        or a_low[1] > b_high[1]
        or a_low[2] > b_high[2]
        or b_low[0] > a_high[0]
        or b_low[1] > a_high[1]
        or b_low[2] > a_high[2]
    )


@wp.kernel
def reach(
    # model
    actor_first: wp.array(dtype=wp.int32),
    actor_copy: wp.array(dtype=wp.bool),
    # in
    tree_told: wp.array(dtype=wp.bool),
    block_low: wp.array(dtype=wp.vec3),
    block_high: wp.array(dtype=wp.vec3),
    tree_low: wp.array(dtype=wp.vec3),
    tree_high: wp.array(dtype=wp.vec3),
    actor_low: wp.array(dtype=wp.vec3),
    actor_high: wp.array(dtype=wp.vec3),
    geom_low: wp.array(dtype=wp.vec3),
    geom_high: wp.array(dtype=wp.vec3),
    # out
    near_out: wp.array(dtype=wp.bool),
):
    """Mark those trees of one block into whose box a shape of an actor reaches; a copy counts only at trees told of."""
    block = wp.tid()
    for actor in range(actor_first.shape[0] - 1):
        if not apart(block_low[block], block_high[block], actor_low[actor], actor_high[actor]):
            for tree in range(block * BLOCK, wp.min((block + 1) * BLOCK, tree_low.shape[0])):
                low = tree_low[tree]
                high = tree_high[tree]
                counts = tree_told[tree] or not actor_copy[actor]
                if counts and not near_out[tree] and not apart(low, high, actor_low[actor], actor_high[actor]):
                    for g in range(actor_first[actor], actor_first[actor + 1]):
                        if not apart(low, high, geom_low[g], geom_high[g]):
                            near_out[tree] = True


@wp.kernel
def bound_blocks(
    # in
    blocks: wp.array(dtype=wp.int32),
    low: wp.array(dtype=wp.vec3),
    high: wp.array(dtype=wp.vec3),
    # out
    low_out: wp.array(dtype=wp.vec3),
    high_out: wp.array(dtype=wp.vec3),
):
    """Find the box around the boxes of one block."""
    block = blocks[wp.tid()]
    lowest = wp.vec3(1.0e30)
    highest = wp.vec3(-1.0e30)
    for i in range(block * BLOCK, wp.min((block + 1) * BLOCK, low.shape[0])):
        lowest = wp.min(lowest, low[i])
        highest = wp.max(highest, high[i])
    low_out[block] = lowest
    high_out[block] = highest


@wp.func
def there(when: int, fine: bool, bunch: int, attached: wp.array(dtype=wp.bool)):
    """Whether a shape of a tree can be touched now."""
    counts = here(when, fine)
    if counts and bunch >= 0:
        counts = attached[bunch]
    return counts


@wp.func
def velocity_at(pose: wp.transform, motion: wp.spatial_vector, point: wp.vec3d):
    """World velocity of a body's material at a point."""
    lever = point - to_double(wp.transform_get_translation(pose))
    return to_double(wp.spatial_top(motion)) + wp.cross(to_double(wp.spatial_bottom(motion)), lever)


@wp.kernel
def meet(
    # model
    dt: wp.float64,
    slots: int,
    movable: int,
    body_parent: wp.array(dtype=wp.int32),
    tree_shape: wp.array(dtype=wp.int32),
    shape_body: wp.array(dtype=wp.int32),
    shape_bunch: wp.array(dtype=wp.int32),
    shape_when: wp.array(dtype=wp.int32),
    shape_radius: wp.array(dtype=float),
    start_drawn: wp.array(dtype=wp.vec3),
    end_drawn: wp.array(dtype=wp.vec3),
    geom_id: wp.array(dtype=wp.int32),
    geom_kind: wp.array(dtype=wp.int32),
    geom_size: wp.array(dtype=wp.vec3d),
    geom_radius: wp.array(dtype=wp.float64),
    geom_copy: wp.array(dtype=wp.bool),
    # in
    every: wp.array(dtype=wp.int32),
    tree_told: wp.array(dtype=wp.bool),
    tree_fine: wp.array(dtype=wp.bool),
    bunch_attached: wp.array(dtype=wp.bool),
    trees: wp.array(dtype=wp.int32),
    tree_low: wp.array(dtype=wp.vec3),
    tree_high: wp.array(dtype=wp.vec3),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
    body_qd_free: wp.array(dtype=wp.spatial_vector),
    start: wp.array(dtype=wp.vec3),
    end: wp.array(dtype=wp.vec3),
    body_cut: wp.array(dtype=wp.bool),
    shape_speed: wp.array(dtype=float),
    shape_low: wp.array(dtype=wp.vec3),
    shape_high: wp.array(dtype=wp.vec3),
    xmat: wp.array(dtype=wp.mat33d),
    middle: wp.array(dtype=wp.vec3d),
    geom_velocity: wp.array(dtype=wp.vec3d),
    geom_spin: wp.array(dtype=wp.vec3d),
    geom_speed: wp.array(dtype=wp.float64),
    geom_low: wp.array(dtype=wp.vec3),
    geom_high: wp.array(dtype=wp.vec3),
    standing_low: wp.array(dtype=wp.vec3),
    standing_high: wp.array(dtype=wp.vec3),
    # out
    close_out: wp.array2d(dtype=wp.int32),
    found_out: wp.array(dtype=wp.int32),
    hit_shape_out: wp.array2d(dtype=wp.int32),
    hit_other_out: wp.array2d(dtype=wp.int32),
    hit_gap_out: wp.array2d(dtype=wp.float64),
    hit_room_out: wp.array2d(dtype=wp.float64),
    hit_normal_out: wp.array2d(dtype=wp.vec3d),
    hit_point_out: wp.array2d(dtype=wp.vec3d),
    onset_out: wp.array(dtype=wp.bool),
):
    """Find where one tree touches rigid shapes or may touch them before the tick ends, by (shape, geom)."""
    i = every[wp.tid()]
    tree = trees[i]
    fine = tree_fine[tree]
    low = tree_low[tree]
    high = tree_high[tree]
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    close = int(0)  # noqa: RUF046 (Warp's way to say that it will change)
    for g in range(movable):
        counts = tree_told[tree] or not geom_copy[g]
        if counts and not apart(low, high, geom_low[g], geom_high[g]):
            close_out[i, close] = g
            close = close + 1
    for block in range(standing_low.shape[0]):
        if not apart(low, high, standing_low[block], standing_high[block]):
            from_g = movable + block * BLOCK
            for g in range(from_g, wp.min(from_g + BLOCK, geom_id.shape[0])):
                if close < close_out.shape[1] and not apart(low, high, geom_low[g], geom_high[g]):
                    close_out[i, close] = g
                    close = close + 1
    onset = bool(False)
    found = int(0)  # noqa: RUF046
    last = tree_shape[tree + 1]
    if close == 0:
        last = tree_shape[tree]
    for s in range(tree_shape[tree], last):
        if there(shape_when[s], fine, shape_bunch[s], bunch_attached):
            radius = wp.float64(shape_radius[s])
            a = to_double(start[s])
            b = to_double(end[s])
            center = half * (a + b)
            bound = half * wp.length(b - a) + radius
            for k in range(close):
                g = close_out[i, k]
                margin = SKIN + (wp.float64(shape_speed[s]) + geom_speed[g]) * dt
                between = center - middle[g]
                limit = bound + geom_radius[g] + margin
                touch = not apart(shape_low[s], shape_high[s], geom_low[g], geom_high[g])
                if touch and wp.dot(between, between) < limit * limit:
                    rotation = xmat[geom_id[g]]
                    near = nearest(geom_kind[g], geom_size[g], rotation, middle[g], a, b)
                    sides = int(0)  # noqa: RUF046
                    ends = wp.vec2d(near[4], near[4])
                    if near[3] - radius < margin:
                        sides = 1
                        if close_to_flat(geom_kind[g]):
                            back = wp.transpose(rotation)
                            ends = along_face(
                                geom_kind[g], geom_size[g], back * (a - middle[g]), back * (b - middle[g]), near[4]
                            )
                            if ends[0] < ends[1]:
                                sides = 2
                    for side in range(sides):
                        # two points of a side along a face are followed each for itself, a single one is looked for
                        if sides == 2:
                            p = a + ends[side] * (b - a)
                            near = nearest(geom_kind[g], geom_size[g], rotation, middle[g], p, p)
                        t = ends[side]
                        gap = near[3] - radius
                        normal = wp.vec3d(near[0], near[1], near[2])
                        point = a + t * (b - a) - (radius + half * gap) * normal
                        # how the two come together if both go on as they go, and where they are when the tick ends
                        body = shape_body[s]
                        velocity = velocity_at(body_q[body], body_qd[body], point)
                        push = geom_velocity[g] + wp.cross(geom_spin[g], point - middle[g])
                        come = dt * wp.dot(normal, velocity - push)
                        wanted = bool(True)
                        if g >= movable:
                            drawn = nearest(
                                geom_kind[g], geom_size[g], rotation, middle[g], to_double(start_drawn[s]),
                                to_double(end_drawn[s]),
                            )  # fmt: skip
                            gap = gap - wp.min(drawn[3] - radius - SKIN, zero)
                            freely = velocity_at(body_q[body], body_qd_free[body], point)
                            wanted = gap + wp.min(wp.min(come, dt * wp.dot(normal, freely)), zero) < HAIR
                        if wanted:
                            bend = bent(body, body_parent, body_cut, body_q, body_qd)
                            from_a = to_double(ahead(wp.float32(dt), body_q[body], body_qd[body], bend, start[s]))
                            from_b = to_double(ahead(wp.float32(dt), body_q[body], body_qd[body], bend, end[s]))
                            if sides == 2:
                                from_a = from_a + t * (from_b - from_a)
                                from_b = from_a
                            later = nearest(
                                geom_kind[g], geom_size[g], turn(dt * geom_spin[g], rotation),
                                middle[g] + dt * geom_velocity[g], from_a, from_b,
                            )  # fmt: skip
                            normal_later = wp.vec3d(later[0], later[1], later[2])
                            bent = zero
                            if wp.dot(normal, normal_later) > AGREE:
                                moved = dt * wp.length(velocity - push)
                                bent = wp.clamp(later[3] - near[3] - come, -moved, moved)
                                onto = from_a + later[4] * (from_b - from_a)
                                onto = onto - (later[3] - half * gap) * normal_later - dt * velocity
                                normal = wp.normalize(normal + normal_later)
                                point = half * (point + onto)
                            if gap + come + bent < zero and come < -ABRUPT * dt:
                                onset = True
                            if found < slots:
                                hit_shape_out[i, found] = 2 * s + side
                                hit_other_out[i, found] = g
                                hit_gap_out[i, found] = gap
                                hit_room_out[i, found] = gap + bent
                                hit_normal_out[i, found] = normal
                                hit_point_out[i, found] = point
                            found = found + 1
    onset_out[i] = onset
    found_out[i] = found
    for k in range(wp.min(found, slots), slots):
        hit_shape_out[i, k] = -1


@wp.func
def kin(x: int, y: int, parent: wp.array(dtype=wp.int32)):
    """Whether two bodies are one, or at most two joints apart."""
    close = x == y
    if x >= 0 and y >= 0:
        up = parent[x]
        over = parent[y]
        close = close or up == y or over == x or (up >= 0 and up == over)
        if up >= 0:
            close = close or parent[up] == y
        if over >= 0:
            close = close or parent[over] == x
    return close


@wp.kernel
def meet_branches(
    # model
    dt: wp.float64,
    slots: int,
    body_parent: wp.array(dtype=wp.int32),
    tree_shape: wp.array(dtype=wp.int32),
    shape_body: wp.array(dtype=wp.int32),
    shape_bunch: wp.array(dtype=wp.int32),
    shape_when: wp.array(dtype=wp.int32),
    shape_radius: wp.array(dtype=float),
    start_drawn: wp.array(dtype=wp.vec3),
    end_drawn: wp.array(dtype=wp.vec3),
    tree_last: wp.array(dtype=wp.int32),
    # in
    every: wp.array(dtype=wp.int32),
    tree_fine: wp.array(dtype=wp.bool),
    bunch_attached: wp.array(dtype=wp.bool),
    order: wp.array(dtype=wp.int32),
    tally: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    tree_low: wp.array(dtype=wp.vec3),
    tree_high: wp.array(dtype=wp.vec3),
    wood_low: wp.array(dtype=wp.vec3),
    wood_high: wp.array(dtype=wp.vec3),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
    body_qd_free: wp.array(dtype=wp.spatial_vector),
    start: wp.array(dtype=wp.vec3),
    end: wp.array(dtype=wp.vec3),
    body_cut: wp.array(dtype=wp.bool),
    shape_speed: wp.array(dtype=float),
    shape_low: wp.array(dtype=wp.vec3),
    shape_high: wp.array(dtype=wp.vec3),
    # out
    found_out: wp.array(dtype=wp.int32),
    hit_shape_out: wp.array2d(dtype=wp.int32),
    hit_other_out: wp.array2d(dtype=wp.int32),
    hit_gap_out: wp.array2d(dtype=wp.float64),
    hit_room_out: wp.array2d(dtype=wp.float64),
    hit_normal_out: wp.array2d(dtype=wp.vec3d),
    hit_point_out: wp.array2d(dtype=wp.vec3d),
    onset_out: wp.array(dtype=wp.bool),
):
    """Find where one tree touches itself (with a bunch) or awake trees behind it in the order of their boxes."""
    place = every[wp.tid()]
    i = order[place]
    tree = trees[i]
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    found = found_out[i]
    axis = tally[AXIS]
    for ahead_of in range(place, tally[TREES]):
        other = trees[order[ahead_of]]
        if tree_low[other][axis] > tree_high[tree][axis]:
            break
        if not apart(tree_low[tree], tree_high[tree], tree_low[other], tree_high[other]):
            low = wp.max(tree_low[tree], tree_low[other])
            high = wp.min(tree_high[tree], tree_high[other])
            for s in range(tree_shape[tree], tree_shape[tree + 1]):
                s_low = shape_low[s] - wp.vec3(0.002)
                s_high = shape_high[s] + wp.vec3(0.002)
                within = not apart(s_low, s_high, low, high)
                if other == tree:  # bunches against wood, and against later bunches
                    clear = apart(s_low, s_high, wood_low[tree], wood_high[tree])
                    within = shape_bunch[s] >= 0 and (not clear or shape_bunch[s] < tree_last[tree])
                if within and there(shape_when[s], tree_fine[tree], shape_bunch[s], bunch_attached):
                    for t in range(tree_shape[other], tree_shape[other + 1]):
                        pair = not apart(s_low, s_high, shape_low[t], shape_high[t])
                        if pair and other == tree:
                            pair = not kin(shape_body[s], shape_body[t], body_parent)
                            if shape_bunch[t] >= 0:
                                pair = pair and shape_bunch[t] > shape_bunch[s]
                        if pair and there(shape_when[t], tree_fine[other], shape_bunch[t], bunch_attached):
                            a = to_double(start[s])
                            b = to_double(end[s])
                            c = to_double(start[t])
                            d = to_double(end[t])
                            radius = shape_radius[s] + shape_radius[t]
                            margin = radius + 0.002 + (shape_speed[s] + shape_speed[t]) * float(dt)
                            near = crossing(a, b, c, d)
                            gap = near[3] - wp.float64(radius)
                            if near[3] < wp.float64(margin):
                                drawn = crossing(
                                    to_double(start_drawn[s]), to_double(end_drawn[s]), to_double(start_drawn[t]),
                                    to_double(end_drawn[t]),
                                )  # fmt: skip
                                normal = wp.vec3d(near[0], near[1], near[2])
                                reach_s = wp.float64(shape_radius[s]) + half * gap
                                point = a + near[4] * (b - a) - reach_s * normal
                                velocity = velocity_at(body_q[shape_body[s]], body_qd[shape_body[s]], point)
                                push = velocity_at(body_q[shape_body[t]], body_qd[shape_body[t]], point)
                                come = dt * wp.dot(normal, velocity - push)
                                gap = gap - wp.min(drawn[3] - wp.float64(radius) - SKIN, zero)
                                freely = velocity_at(body_q[shape_body[s]], body_qd_free[shape_body[s]], point)
                                freely = freely - velocity_at(body_q[shape_body[t]], body_qd_free[shape_body[t]], point)
                                if gap + wp.min(wp.min(come, dt * wp.dot(normal, freely)), zero) < HAIR:
                                    mine = shape_body[s]
                                    its = shape_body[t]
                                    h = wp.float32(dt)
                                    bend = bent(mine, body_parent, body_cut, body_q, body_qd)
                                    its_bend = bent(its, body_parent, body_cut, body_q, body_qd)
                                    later = crossing(
                                        to_double(ahead(h, body_q[mine], body_qd[mine], bend, start[s])),
                                        to_double(ahead(h, body_q[mine], body_qd[mine], bend, end[s])),
                                        to_double(ahead(h, body_q[its], body_qd[its], its_bend, start[t])),
                                        to_double(ahead(h, body_q[its], body_qd[its], its_bend, end[t])),
                                    )
                                    normal_later = wp.vec3d(later[0], later[1], later[2])
                                    bent = zero
                                    if wp.dot(normal, normal_later) > AGREE:
                                        moved = dt * wp.length(velocity - push)
                                        bent = wp.clamp(later[3] - near[3] - come, -moved, moved)
                                        normal = wp.normalize(normal + normal_later)
                                    if gap + come + bent < zero and come < -ABRUPT * dt:
                                        onset_out[i] = True
                                    if found < slots:
                                        hit_shape_out[i, found] = 2 * s
                                        hit_other_out[i, found] = -1 - t
                                        hit_gap_out[i, found] = gap
                                        hit_room_out[i, found] = gap + bent
                                        hit_normal_out[i, found] = normal
                                        hit_point_out[i, found] = point
                                    found = found + 1
    found_out[i] = found


@wp.kernel
def gather(
    # model
    slots: int,
    # in
    found: wp.array(dtype=wp.int32),
    onset: wp.array(dtype=wp.bool),
    # out
    hits_out: wp.array(dtype=wp.int32),
    tally_out: wp.array(dtype=wp.int32),
):
    """List the hits of all trees one after the other (one thread does all); of too many only count the rest."""
    trees = tally_out[TREES]
    count = int(0)  # noqa: RUF046
    missed = int(0)  # noqa: RUF046
    struck = int(0)  # noqa: RUF046
    for i in range(trees):
        kept = wp.min(found[i], slots)
        missed = missed + found[i] - kept
        if onset[i]:
            struck = struck + 1
        for k in range(kept):
            if count < hits_out.shape[0]:
                hits_out[count] = i * slots + k
            count = count + 1
    tally_out[HITS] = count
    tally_out[MISSED] = missed
    tally_out[STRUCK] = struck


@wp.func
def root_of(label: wp.array(dtype=wp.int32), c: int):
    """The first contact of the island that this one is in so far."""
    at = int(c)
    while label[at] != at:
        at = label[at]
    return at


@wp.func
def moved_along(
    other: int, geom_dof: wp.array(dtype=wp.int32), dof_tree: wp.array(dtype=wp.int32), group: wp.array(dtype=wp.int32)
):
    """The group of rigid bodies that feel what presses on one of them; -1 for a branch, or what stands."""
    found = int(-1)  # noqa: RUF046
    if other >= 0 and geom_dof[wp.max(other, 0)] >= 0:
        found = group[dof_tree[geom_dof[other]]]
    return found


@wp.kernel
def index(
    # model
    shape_body: wp.array(dtype=wp.int32),
    body_tree: wp.array(dtype=wp.int32),
    geom_dof: wp.array(dtype=wp.int32),
    dof_tree: wp.array(dtype=wp.int32),
    # in
    hits: wp.array(dtype=wp.int32),
    hit_shape: wp.array(dtype=wp.int32),
    hit_other: wp.array(dtype=wp.int32),
    group: wp.array(dtype=wp.int32),
    # out
    tally_out: wp.array(dtype=wp.int32),
    bodies_out: wp.array(dtype=wp.int32),
    shape_out: wp.array(dtype=wp.int32),
    body_out: wp.array(dtype=wp.int32),
    place_out: wp.array(dtype=wp.int32),
    other_body_out: wp.array(dtype=wp.int32),
    other_place_out: wp.array(dtype=wp.int32),
    island_out: wp.array(dtype=wp.int32),
    island_first_out: wp.array(dtype=wp.int32),
    island_member_out: wp.array(dtype=wp.int32),
):
    """Number the plant bodies in contact, sorted, each once, and part contacts into islands (one thread does all)."""
    contacts = tally_out[HITS]
    count = int(0)  # noqa: RUF046
    for c in range(contacts):
        shape = hit_shape[hits[c]]
        other = hit_other[hits[c]]
        shape_out[c] = shape
        body_out[c] = shape_body[shape // 2]
        other_body_out[c] = -1
        if other < 0:
            other_body_out[c] = shape_body[-1 - other]
        for side in range(2):
            body = body_out[c]
            if side == 1:
                body = other_body_out[c]
            at = int(count)
            while at > 0 and bodies_out[at - 1] >= body:
                at = at - 1
            if body >= 0 and (at == count or bodies_out[at] != body):
                for k in range(count - at):
                    bodies_out[count - k] = bodies_out[count - k - 1]
                bodies_out[at] = body
                count = count + 1
    for c in range(contacts):
        place_out[c] = 0
        other_place_out[c] = 0
        for k in range(count):
            if bodies_out[k] == body_out[c]:
                place_out[c] = k
            if bodies_out[k] == other_body_out[c]:
                other_place_out[c] = k
    tally_out[BODIES] = count

    # contacts that share a plant, or things that move each other
    for c in range(contacts):
        island_out[c] = c
        tree = body_tree[body_out[c]]
        over = int(-1)  # noqa: RUF046
        if other_body_out[c] >= 0:
            over = body_tree[other_body_out[c]]
        with_c = moved_along(hit_other[hits[c]], geom_dof, dof_tree, group)
        for d in range(c):
            tree_d = body_tree[body_out[d]]
            linked = tree_d == tree or tree_d == over
            if other_body_out[d] >= 0:
                over_d = body_tree[other_body_out[d]]
                linked = linked or over_d == tree or over_d == over
            if not linked and with_c >= 0:
                linked = with_c == moved_along(hit_other[hits[d]], geom_dof, dof_tree, group)
            if linked:
                one = root_of(island_out, c)
                two = root_of(island_out, d)
                island_out[wp.max(one, two)] = wp.min(one, two)
    islands = int(0)  # noqa: RUF046
    members = int(0)  # noqa: RUF046
    for c in range(contacts):
        if island_out[c] == c:
            island_first_out[islands] = members
            for d in range(c, contacts):
                if root_of(island_out, d) == c:
                    island_member_out[members] = d
                    members = members + 1
            islands = islands + 1
    island_first_out[islands] = members
    for i in range(islands):
        for m in range(island_first_out[i], island_first_out[i + 1]):
            island_out[island_member_out[m]] = i
    tally_out[ISLANDS] = islands


@wp.kernel
def couple(
    # model
    dt: wp.float64,
    stiffness: wp.float64,
    damping: wp.float64,
    bark: wp.float64,
    geom_friction: wp.array(dtype=wp.float64),
    geom_dof: wp.array(dtype=wp.int32),
    geom_root: wp.array(dtype=wp.int32),
    dof_parent: wp.array(dtype=wp.int32),
    # in
    hits: wp.array(dtype=wp.int32),
    hit_other: wp.array(dtype=wp.int32),
    hit_gap: wp.array(dtype=wp.float64),
    hit_room: wp.array(dtype=wp.float64),
    hit_normal: wp.array(dtype=wp.vec3d),
    hit_point: wp.array(dtype=wp.vec3d),
    contact_shape: wp.array(dtype=wp.int32),
    contact_body: wp.array(dtype=wp.int32),
    other_body: wp.array(dtype=wp.int32),
    body_q: wp.array(dtype=wp.transform),
    body_qd_free: wp.array(dtype=wp.spatial_vector),
    dof_free: wp.array(dtype=wp.float64),
    cdof: wp.array2d(dtype=wp.float64),
    subtree_com: wp.array(dtype=wp.vec3d),
    known_count: wp.array(dtype=wp.int32),
    known_shape: wp.array(dtype=wp.int32),
    known_other: wp.array(dtype=wp.int32),
    known_push: wp.array(dtype=wp.float64),
    known_rub: wp.array(dtype=wp.vec3d),
    known_anchor: wp.array(dtype=wp.vec3d),
    # out
    other_out: wp.array(dtype=wp.int32),
    gap_out: wp.array(dtype=wp.float64),
    friction_out: wp.array(dtype=wp.float64),
    point_out: wp.array(dtype=wp.vec3d),
    axes_out: wp.array(dtype=wp.mat33d),
    plant_rows_out: wp.array2d(dtype=wp.float64),
    rigid_rows_out: wp.array2d(dtype=wp.float64),
    free_out: wp.array(dtype=wp.float64),
    offset_out: wp.array(dtype=wp.float64),
    impulse_out: wp.array(dtype=wp.float64),
):
    """Write one contact's three rows of the Jacobians (body and other; zeroed for the rigid), free approach, guess."""
    c = wp.tid()
    zero = wp.float64(0.0)
    h = hits[c]
    g = hit_other[h]
    n = hit_normal[h]
    x = hit_point[h]
    gap = hit_gap[h]
    t1 = tangent(n)
    t2 = wp.cross(n, t1)
    other_out[c] = g
    gap_out[c] = gap
    point_out[c] = x
    axes_out[c] = wp.matrix_from_rows(n, t1, t2)
    body = contact_body[c]
    lever = x - to_double(wp.transform_get_translation(body_q[body]))
    approach = velocity_at(body_q[body], body_qd_free[body], x)
    friction_out[c] = bark
    other = other_body[c]
    other_lever = lever
    dof = int(-1)  # noqa: RUF046
    about = lever
    if g >= 0:
        friction_out[c] = geom_friction[g]
        dof = geom_dof[g]
        about = x - subtree_com[geom_root[g]]
    else:
        other_lever = x - to_double(wp.transform_get_translation(body_q[other]))
        approach = approach - velocity_at(body_q[other], body_qd_free[other], x)
    last_dof = dof

    for r in range(3):
        axis = n
        if r == 1:
            axis = t1
        if r == 2:
            axis = t2
        row = 3 * c + r
        turn = wp.cross(lever, axis)
        for k in range(3):
            plant_rows_out[row, k] = axis[k]
            plant_rows_out[row, 3 + k] = turn[k]
        if g < 0:
            other_turn = wp.cross(other_lever, axis)
            for k in range(3):
                plant_rows_out[row, 6 + k] = -axis[k]
                plant_rows_out[row, 9 + k] = -other_turn[k]
        dof = last_dof
        carried = zero
        while dof >= 0:
            angular = wp.vec3d(cdof[dof, 0], cdof[dof, 1], cdof[dof, 2])
            linear = wp.vec3d(cdof[dof, 3], cdof[dof, 4], cdof[dof, 5])
            moved = wp.dot(axis, linear + wp.cross(angular, about))
            rigid_rows_out[row, dof] = moved
            carried = carried + moved * dof_free[dof]
            dof = dof_parent[dof]
        free_out[row] = wp.dot(axis, approach) - carried
        offset_out[row] = zero
        impulse_out[row] = zero

    # the spring of an open gap has nothing to push yet: it only must not be overrun within the tick
    give = stiffness * dt + damping
    room = hit_room[h]
    if room > zero:
        offset_out[3 * c] = room / dt
    else:
        offset_out[3 * c] = wp.max(room * stiffness / give, -FASTEST_EXIT)
    for k in range(known_count[0]):
        if known_shape[k] == contact_shape[c] and known_other[k] == g:
            impulse_out[3 * c] = known_push[k]
            impulse_out[3 * c + 1] = wp.dot(t1, known_rub[k])
            impulse_out[3 * c + 2] = wp.dot(t2, known_rub[k])
            offset_out[3 * c + 1] = wp.dot(t1, known_anchor[k]) * stiffness / give
            offset_out[3 * c + 2] = wp.dot(t2, known_anchor[k]) * stiffness / give


@wp.kernel
def answer(
    # model
    dof_tree: wp.array(dtype=wp.int32),
    tree_dof: wp.array(dtype=wp.int32),
    tree_dofs: wp.array(dtype=wp.int32),
    geom_dof: wp.array(dtype=wp.int32),
    row_entry: wp.array(dtype=wp.int32),
    row_entries: wp.array(dtype=wp.int32),
    entry_dof: wp.array(dtype=wp.int32),
    body_tree: wp.array(dtype=wp.int32),
    # in
    bodies: wp.array(dtype=wp.int32),
    tally: wp.array(dtype=wp.int32),
    other: wp.array(dtype=wp.int32),
    place: wp.array(dtype=wp.int32),
    other_place: wp.array(dtype=wp.int32),
    plant_rows: wp.array2d(dtype=wp.float64),
    rigid_rows: wp.array2d(dtype=wp.float64),
    response: wp.array2d(dtype=float),
    factor: wp.array(dtype=wp.float64),
    factor_inverse: wp.array(dtype=wp.float64),
    plain: wp.array(dtype=wp.float64),
    plain_inverse: wp.array(dtype=wp.float64),
    # out
    plant_answer_out: wp.array2d(dtype=wp.float64),
    rigid_answer_out: wp.array2d(dtype=wp.float64),
):
    """Find how all bodies in contact, and one kinematic tree (if free of constraints), answer one row's impulse."""
    row = wp.tid()
    zero = wp.float64(0.0)
    c = row // 3
    at = 6 * place[c]
    over = 6 * other_place[c]
    branch = other[c] < 0
    tree = body_tree[bodies[place[c]]]
    over_tree = int(-1)  # noqa: RUF046
    if branch:
        over_tree = body_tree[bodies[other_place[c]]]
    for b in range(tally[BODIES]):
        its_tree = body_tree[bodies[b]]
        for k in range(6 * b, 6 * b + 6):
            moved = zero
            if its_tree == tree:
                for j in range(6):
                    moved = moved + plant_rows[row, j] * wp.float64(response[k, at + j])
            if its_tree == over_tree:
                for j in range(6):
                    moved = moved + plant_rows[row, 6 + j] * wp.float64(response[k, over + j])
            plant_answer_out[row, k] = moved
    last = int(-1)  # noqa: RUF046
    if not branch:
        last = geom_dof[other[c]]
    if last >= 0 and tally[BOUND] == 0:
        tree = dof_tree[last]
        first = tree_dof[tree]
        end = first + tree_dofs[tree]
        for i in range(first, end):
            rigid_answer_out[row, i] = rigid_rows[row, i]
        # L^T D L x = b, where MuJoCo keeps it; without anything implicit it leaves M^ unset, which then is M
        implicit = factor_inverse[last] != zero
        for k in range(end - first):
            i = end - 1 - k
            for e in range(row_entry[i], row_entry[i] + row_entries[i] - 1):
                scale = plain[e]
                if implicit:
                    scale = factor[e]
                j = entry_dof[e]
                rigid_answer_out[row, j] = rigid_answer_out[row, j] - scale * rigid_answer_out[row, i]
        for i in range(first, end):
            pivot = plain_inverse[i]
            if implicit:
                pivot = factor_inverse[i]
            moved = rigid_answer_out[row, i] * pivot
            for e in range(row_entry[i], row_entry[i] + row_entries[i] - 1):
                scale = plain[e]
                if implicit:
                    scale = factor[e]
                moved = moved - scale * rigid_answer_out[row, entry_dof[e]]
            rigid_answer_out[row, i] = moved


@wp.kernel
def assemble(
    # model
    geom_dof: wp.array(dtype=wp.int32),
    dof_parent: wp.array(dtype=wp.int32),
    # in
    island: wp.array(dtype=wp.int32),
    island_first: wp.array(dtype=wp.int32),
    island_member: wp.array(dtype=wp.int32),
    other: wp.array(dtype=wp.int32),
    place: wp.array(dtype=wp.int32),
    other_place: wp.array(dtype=wp.int32),
    plant_rows: wp.array2d(dtype=wp.float64),
    rigid_rows: wp.array2d(dtype=wp.float64),
    plant_answer: wp.array2d(dtype=wp.float64),
    rigid_answer: wp.array2d(dtype=wp.float64),
    # out
    A_out: wp.array2d(dtype=wp.float64),
):
    """Write one row of A: how fast the impulses of its island part the two bodies of a contact along one axis."""
    row = wp.tid()
    c = row // 3
    at = 6 * place[c]
    over = 6 * other_place[c]
    last = int(-1)  # noqa: RUF046
    if other[c] >= 0:
        last = geom_dof[other[c]]
    for m in range(island_first[island[c]], island_first[island[c] + 1]):
        for column in range(3 * island_member[m], 3 * island_member[m] + 3):
            moved = wp.float64(0.0)
            for k in range(6):
                moved = moved + plant_rows[row, k] * plant_answer[column, at + k]
            if other[c] < 0:
                for k in range(6):
                    moved = moved + plant_rows[row, 6 + k] * plant_answer[column, over + k]
            dof = last
            while dof >= 0:
                moved = moved + rigid_rows[row, dof] * rigid_answer[column, dof]
                dof = dof_parent[dof]
            A_out[row, column] = moved


@wp.func
def leap(
    softness: wp.float64,
    first: int,
    last: int,
    island_member: wp.array(dtype=wp.int32),
    friction: wp.array(dtype=wp.float64),
    A: wp.array2d(dtype=wp.float64),
    free: wp.array(dtype=wp.float64),
    offset: wp.array(dtype=wp.float64),
    rows_out: wp.array2d(dtype=wp.float64),
    impulse_out: wp.array(dtype=wp.float64),
):
    """Solve one island as if each contact stayed what it is: open, sticking, or sliding the way it slides.

    That is a linear system, eliminated here without pivoting: A is positive definite, and sliding bends it little. Where
    the guess about a contact was wrong, its impulse is put back into its cone, and the next sweep makes a better guess.
    """
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    size = 3 * (last - first)
    for p in range(last - first):
        j = island_member[first + p]
        n = 3 * j
        push = impulse_out[n]
        rub = wp.sqrt(impulse_out[n + 1] * impulse_out[n + 1] + impulse_out[n + 2] * impulse_out[n + 2])
        limit = friction[j] * push
        slides = rub >= limit * wp.float64(0.999999)
        for axis in range(3):
            row = n + axis
            fixed = push <= zero or (axis > 0 and slides)
            for q in range(last - first):
                i = 3 * island_member[first + q]
                for k in range(3):
                    entry = A[row, i + k]
                    if fixed:
                        entry = zero
                    rows_out[row, 3 * q + k] = entry
            rows_out[row, size] = -free[row] - offset[row]
            if fixed:
                rows_out[row, 3 * p + axis] = one
                rows_out[row, size] = zero
                if push > zero:
                    rows_out[row, 3 * p] = -impulse_out[row] / push
            else:
                rows_out[row, 3 * p + axis] = rows_out[row, 3 * p + axis] + softness
    for k in range(size):
        pivot_row = 3 * island_member[first + k // 3] + k % 3
        scale = one / rows_out[pivot_row, k]
        for m in range(k + 1, size):
            row = 3 * island_member[first + m // 3] + m % 3
            factor = rows_out[row, k] * scale
            if factor != zero:
                for c in range(k + 1, size + 1):
                    rows_out[row, c] = rows_out[row, c] - factor * rows_out[pivot_row, c]
    for back in range(size):
        k = size - 1 - back
        row = 3 * island_member[first + k // 3] + k % 3
        value = rows_out[row, size]
        for c in range(k + 1, size):
            value = value - rows_out[row, c] * impulse_out[3 * island_member[first + c // 3] + c % 3]
        impulse_out[row] = value / rows_out[row, k]
    for m in range(first, last):
        j = island_member[m]
        n = 3 * j
        push = wp.max(impulse_out[n], zero)
        rub = wp.sqrt(impulse_out[n + 1] * impulse_out[n + 1] + impulse_out[n + 2] * impulse_out[n + 2])
        share = one
        if rub > friction[j] * push:
            share = friction[j] * push / rub
        impulse_out[n] = push
        impulse_out[n + 1] = share * impulse_out[n + 1]
        impulse_out[n + 2] = share * impulse_out[n + 2]


@wp.kernel
def relax(
    # model
    softness: wp.float64,
    iterations: int,
    leaps: int,
    largest_leap: int,
    tolerance: wp.float64,
    # in
    island_first: wp.array(dtype=wp.int32),
    island_member: wp.array(dtype=wp.int32),
    friction: wp.array(dtype=wp.float64),
    A: wp.array2d(dtype=wp.float64),
    free: wp.array(dtype=wp.float64),
    offset: wp.array(dtype=wp.float64),
    # out
    rows_out: wp.array2d(dtype=wp.float64),
    impulse_out: wp.array(dtype=wp.float64),
    sweeps_out: wp.array(dtype=wp.int32),
):
    """Solve one island of contacts: projected Gauss-Seidel on |rub| <= mu push, block by block, from the guess on."""
    # Contacts that lean on each other (two fingers about a bunch) let it creep: it tells which contacts stick, slide or
    # open within a few sweeps, and takes a hundred for the rest. So small islands leap after every other sweep, at first.
    island = wp.tid()
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    first = island_first[island]
    last = island_first[island + 1]
    sweeps = int(0)  # noqa: RUF046
    busy = bool(True)
    while busy and sweeps < iterations:
        change = zero
        largest = wp.float64(1.0e-5)
        for m in range(first, last):
            j = island_member[m]
            n = 3 * j
            r = free[n] + offset[n] + softness * impulse_out[n]
            for k in range(first, last):
                i = 3 * island_member[k]
                r = r + A[n, i] * impulse_out[i] + A[n, i + 1] * impulse_out[i + 1] + A[n, i + 2] * impulse_out[i + 2]
            before = impulse_out[n]
            push = wp.max(zero, before - r / (A[n, n] + softness))
            impulse_out[n] = push
            change = wp.max(change, wp.abs(push - before))
            largest = wp.max(largest, push)

            u = n + 1
            v = n + 2
            ru = free[u] + offset[u] + softness * impulse_out[u]
            rv = free[v] + offset[v] + softness * impulse_out[v]
            for k in range(first, last):
                i = 3 * island_member[k]
                ru = ru + A[u, i] * impulse_out[i] + A[u, i + 1] * impulse_out[i + 1] + A[u, i + 2] * impulse_out[i + 2]
                rv = rv + A[v, i] * impulse_out[i] + A[v, i + 1] * impulse_out[i + 1] + A[v, i + 2] * impulse_out[i + 2]
            # the stiffer of the two principal directions keeps the step inside the cone's convergence
            mean = half * (A[u, u] + A[v, v]) + softness
            spread = half * (A[u, u] - A[v, v])
            step = mean + wp.sqrt(spread * spread + A[u, v] * A[u, v])
            fu = impulse_out[u] - ru / step
            fv = impulse_out[v] - rv / step
            rub = wp.sqrt(fu * fu + fv * fv)
            limit = friction[j] * push
            if rub > limit:
                fu = fu * limit / wp.max(rub, wp.float64(1.0e-30))
                fv = fv * limit / wp.max(rub, wp.float64(1.0e-30))
            change = wp.max(change, wp.abs(fu - impulse_out[u]) + wp.abs(fv - impulse_out[v]))
            impulse_out[u] = fu
            impulse_out[v] = fv
        sweeps = sweeps + 1
        busy = change > tolerance * largest
        if busy and last - first <= largest_leap and sweeps % 2 == 0 and sweeps <= 2 * leaps + 2:
            if sweeps <= 2 * leaps:
                if sweeps == 2:
                    for m in range(first, last):
                        for k in range(3):
                            row = 3 * island_member[m] + k
                            rows_out[row, rows_out.shape[1] - 1] = impulse_out[row]
                leap(softness, first, last, island_member, friction, A, free, offset, rows_out, impulse_out)
            else:  # guesses go round in circles: sweeps alone, from where they were
                for m in range(first, last):
                    for k in range(3):
                        row = 3 * island_member[m] + k
                        impulse_out[row] = rows_out[row, rows_out.shape[1] - 1]
    sweeps_out[island] = sweeps


@wp.kernel
def remember(
    # model
    dt: wp.float64,
    stiffness: wp.float64,
    damping: wp.float64,
    # in
    island: wp.array(dtype=wp.int32),
    island_first: wp.array(dtype=wp.int32),
    island_member: wp.array(dtype=wp.int32),
    shape: wp.array(dtype=wp.int32),
    other: wp.array(dtype=wp.int32),
    axes: wp.array(dtype=wp.mat33d),
    A: wp.array2d(dtype=wp.float64),
    free: wp.array(dtype=wp.float64),
    impulse: wp.array(dtype=wp.float64),
    # out
    force_out: wp.array(dtype=wp.vec3d),
    known_shape_out: wp.array(dtype=wp.int32),
    known_other_out: wp.array(dtype=wp.int32),
    known_push_out: wp.array(dtype=wp.float64),
    known_rub_out: wp.array(dtype=wp.vec3d),
    known_anchor_out: wp.array(dtype=wp.vec3d),
):
    """Turn one contact's impulse into a force on the plant, and keep what the next tick starts from."""
    c = wp.tid()
    n = 3 * c
    frame = axes[c]
    t1 = wp.vec3d(frame[1, 0], frame[1, 1], frame[1, 2])
    t2 = wp.vec3d(frame[2, 0], frame[2, 1], frame[2, 2])
    pressed = wp.vec3d(impulse[n], impulse[n + 1], impulse[n + 2])
    force_out[c] = wp.transpose(frame) * pressed / dt
    slip_u = free[n + 1]
    slip_v = free[n + 2]
    for m in range(island_first[island[c]], island_first[island[c] + 1]):
        for k in range(3 * island_member[m], 3 * island_member[m] + 3):
            slip_u = slip_u + A[n + 1, k] * impulse[k]
            slip_v = slip_v + A[n + 2, k] * impulse[k]
    # the stretch with which spring and damper give just this friction: a contact that slides drags its anchor along
    stretch = -(impulse[n + 1] / dt + damping * slip_u) / stiffness * t1
    stretch = stretch - (impulse[n + 2] / dt + damping * slip_v) / stiffness * t2
    known_shape_out[c] = shape[c]
    known_other_out[c] = other[c]
    known_push_out[c] = impulse[n]
    known_rub_out[c] = impulse[n + 1] * t1 + impulse[n + 2] * t2
    known_anchor_out[c] = stretch
    if impulse[n] <= wp.float64(0.0):
        known_shape_out[c] = -1


@wp.kernel
def add_up(
    # model
    dt: wp.float64,
    # in
    tally: wp.array(dtype=wp.int32),
    other: wp.array(dtype=wp.int32),
    place: wp.array(dtype=wp.int32),
    other_place: wp.array(dtype=wp.int32),
    plant_rows: wp.array2d(dtype=wp.float64),
    impulse: wp.array(dtype=wp.float64),
    # out
    wrench_out: wp.array2d(dtype=wp.float64),
):
    """Add up the wrenches of all contacts on one plant body."""
    body = wp.tid()
    for k in range(6):
        wrench_out[body, k] = wp.float64(0.0)
    for row in range(3 * tally[HITS]):
        force = impulse[row] / dt
        if place[row // 3] == body:
            for k in range(6):
                wrench_out[body, k] = wrench_out[body, k] + force * plant_rows[row, k]
        if other[row // 3] < 0 and other_place[row // 3] == body:
            for k in range(6):
                wrench_out[body, k] = wrench_out[body, k] + force * plant_rows[row, 6 + k]
