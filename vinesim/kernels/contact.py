"""Contacts between plants and rigid bodies: who is close, how contacts couple, which impulses keep them apart.

A plant's shape is a segment with a radius (a sphere when both ends agree), a rigid body's is one of MuJoCo's
primitives. One function gives the distance and direction from a point to a primitive; along a segment that distance
is convex, so one bisection of its slope finds where the two are closest, for every pair of kinds alike.

Contacts are solved for impulses at the end of the tick, in double precision: normal n (from the rigid body to the
plant) and two tangents, a Coulomb cone, an implicit spring and damper in each direction, and for friction an *anchor*:
the stretch that remembers where a sticking contact began.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

SPHERE = wp.constant(2)
CAPSULE = wp.constant(3)
ELLIPSOID = wp.constant(4)
CYLINDER = wp.constant(5)

SKIN = wp.constant(wp.float64(0.002))
"""Contacts are seen from this gap on [m], and from as far as the two can come together in one tick."""

AGREE = wp.constant(wp.float64(0.5))
"""Least cosine between the normals before and after a tick for which the contact moves on smoothly."""

ABRUPT = wp.constant(wp.float64(0.3))
"""[m/s] A contact that closes faster is a blow."""

vec5d = wp.types.vector(length=5, dtype=wp.float64)

BISECTIONS = wp.constant(30)
FASTEST_EXIT = wp.constant(wp.float64(1.0))
"""Overlap is undone at this speed at most [m/s]."""


@wp.func
def distance(kind: int, size: wp.vec3d, p: wp.vec3d):
    """Outward normal (x, y, z) and signed distance (w) of point p from a primitive, in the primitive's frame."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    tiny = wp.float64(1.0e-12)
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
    # in
    xpos: wp.array(dtype=wp.vec3d),
    xmat: wp.array(dtype=wp.mat33d),
    cvel: wp.array2d(dtype=wp.float64),
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
    velocity = velocity + wp.cross(spin, middle - subtree_com[geom_root[g]])
    half = geom_half[g]
    speed = wp.length(velocity) + wp.length(spin) * wp.length(half)
    grown = SKIN + speed * dt
    box = wp.vec3()
    for i in range(3):
        extent = wp.abs(rotation[i, 0]) * half[0] + wp.abs(rotation[i, 1]) * half[1] + wp.abs(rotation[i, 2]) * half[2]
        box[i] = wp.float32(extent + grown)
    center = wp.vec3(wp.float32(middle[0]), wp.float32(middle[1]), wp.float32(middle[2]))
    middle_out[g] = middle
    velocity_out[g] = velocity
    spin_out[g] = spin
    speed_out[g] = speed
    low_out[g] = center - box
    high_out[g] = center + box


@wp.func
def ahead(dt: float, pose: wp.transform, motion: wp.spatial_vector, bend: wp.spatial_vector, point: wp.vec3):
    """Where a point of a body will be after a tick, to second order in the tick."""
    arm = point - wp.transform_get_translation(pose)
    omega = wp.spatial_bottom(motion)
    velocity = wp.spatial_top(motion) + wp.cross(omega, arm)
    turn = wp.cross(omega, wp.cross(omega, arm))
    return point + dt * (velocity + 0.5 * dt * (wp.spatial_top(bend) + wp.cross(wp.spatial_bottom(bend), arm) + turn))


@wp.kernel
def bound_trees(
    # model
    dt: float,
    tree_first: wp.array(dtype=wp.int32),
    tree_size: wp.array(dtype=wp.int32),
    body_parent: wp.array(dtype=wp.int32),
    tree_shape: wp.array(dtype=wp.int32),
    shape_body: wp.array(dtype=wp.int32),
    shape_start: wp.array(dtype=wp.vec3),
    shape_end: wp.array(dtype=wp.vec3),
    shape_radius: wp.array(dtype=float),
    # in
    trees: wp.array(dtype=wp.int32),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
    body_cut: wp.array(dtype=wp.bool),
    # out
    bend_out: wp.array(dtype=wp.spatial_vector),
    start_out: wp.array(dtype=wp.vec3),
    end_out: wp.array(dtype=wp.vec3),
    start_ahead_out: wp.array(dtype=wp.vec3),
    end_ahead_out: wp.array(dtype=wp.vec3),
    speed_out: wp.array(dtype=float),
    low_out: wp.array(dtype=wp.vec3),
    high_out: wp.array(dtype=wp.vec3),
):
    """Put the shapes of one tree into the world, now and after a tick of steady joint rates, and find their box."""
    tree = trees[wp.tid()]
    # bend: the acceleration of a body while all joints turn steadily
    first = tree_first[tree]
    for k in range(first, first + tree_size[tree]):
        above = body_parent[k]
        bend = wp.spatial_vector()
        if above >= 0 and not body_cut[k]:
            motion = body_qd[above]
            turning = wp.spatial_bottom(motion)
            arm = wp.transform_get_translation(body_q[k]) - wp.transform_get_translation(body_q[above])
            carried = bend_out[above]
            alpha = wp.spatial_bottom(carried)
            bend = wp.spatial_vector(
                wp.spatial_top(carried) + wp.cross(alpha, arm) + wp.cross(turning, wp.cross(turning, arm)),
                alpha + wp.cross(turning, wp.spatial_bottom(body_qd[k])),
            )
        bend_out[k] = bend
    low = wp.vec3(1.0e30)
    high = wp.vec3(-1.0e30)
    for s in range(tree_shape[tree], tree_shape[tree + 1]):
        body = shape_body[s]
        pose = body_q[body]
        motion = body_qd[body]
        start = wp.transform_point(pose, shape_start[s])
        end = wp.transform_point(pose, shape_end[s])
        reach = wp.max(wp.length(shape_start[s]), wp.length(shape_end[s])) + shape_radius[s]
        speed = wp.length(wp.spatial_top(motion)) + reach * wp.length(wp.spatial_bottom(motion))
        grown = wp.vec3(shape_radius[s] + speed * dt)
        low = wp.min(low, wp.min(start, end) - grown)
        high = wp.max(high, wp.max(start, end) + grown)
        start_out[s] = start
        end_out[s] = end
        start_ahead_out[s] = ahead(dt, pose, motion, bend_out[body], start)
        end_ahead_out[s] = ahead(dt, pose, motion, bend_out[body], end)
        speed_out[s] = speed
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
    tree_low: wp.array(dtype=wp.vec3),
    tree_high: wp.array(dtype=wp.vec3),
    actor_low: wp.array(dtype=wp.vec3),
    actor_high: wp.array(dtype=wp.vec3),
    geom_low: wp.array(dtype=wp.vec3),
    geom_high: wp.array(dtype=wp.vec3),
    # out
    near_out: wp.array(dtype=wp.bool),
):
    """Say of one tree whether some shape of an actor reaches into its box; a copy counts only at trees told of."""
    tree = wp.tid()
    low = tree_low[tree]
    high = tree_high[tree]
    near = bool(False)
    for actor in range(actor_first.shape[0] - 1):
        counts = tree_told[tree] or not actor_copy[actor]
        if counts and not apart(low, high, actor_low[actor], actor_high[actor]):
            for g in range(actor_first[actor], actor_first[actor + 1]):
                if not apart(low, high, geom_low[g], geom_high[g]):
                    near = True
    near_out[tree] = near


@wp.kernel
def meet(
    # model
    dt: wp.float64,
    slots: int,
    tree_shape: wp.array(dtype=wp.int32),
    shape_body: wp.array(dtype=wp.int32),
    shape_bunch: wp.array(dtype=wp.int32),
    shape_radius: wp.array(dtype=float),
    geom_id: wp.array(dtype=wp.int32),
    geom_kind: wp.array(dtype=wp.int32),
    geom_size: wp.array(dtype=wp.vec3d),
    geom_radius: wp.array(dtype=wp.float64),
    geom_copy: wp.array(dtype=wp.bool),
    # in
    tree_told: wp.array(dtype=wp.bool),
    bunch_attached: wp.array(dtype=wp.bool),
    trees: wp.array(dtype=wp.int32),
    tree_low: wp.array(dtype=wp.vec3),
    tree_high: wp.array(dtype=wp.vec3),
    body_q: wp.array(dtype=wp.transform),
    body_qd: wp.array(dtype=wp.spatial_vector),
    start: wp.array(dtype=wp.vec3),
    end: wp.array(dtype=wp.vec3),
    start_ahead: wp.array(dtype=wp.vec3),
    end_ahead: wp.array(dtype=wp.vec3),
    shape_speed: wp.array(dtype=float),
    xmat: wp.array(dtype=wp.mat33d),
    middle: wp.array(dtype=wp.vec3d),
    geom_velocity: wp.array(dtype=wp.vec3d),
    geom_spin: wp.array(dtype=wp.vec3d),
    geom_speed: wp.array(dtype=wp.float64),
    geom_low: wp.array(dtype=wp.vec3),
    geom_high: wp.array(dtype=wp.vec3),
    # out
    close_out: wp.array2d(dtype=wp.int32),
    hit_shape_out: wp.array2d(dtype=wp.int32),
    hit_geom_out: wp.array2d(dtype=wp.int32),
    hit_gap_out: wp.array2d(dtype=wp.float64),
    hit_room_out: wp.array2d(dtype=wp.float64),
    hit_normal_out: wp.array2d(dtype=wp.vec3d),
    hit_point_out: wp.array2d(dtype=wp.vec3d),
    onset_out: wp.array(dtype=wp.bool),
    missed_out: wp.array(dtype=wp.int32),
):
    """Find where one tree touches rigid shapes or may touch them before the tick ends, by (shape, geom)."""
    i = wp.tid()
    tree = trees[i]
    close = int(0)  # noqa: RUF046 (Warp's way to say that it will change)
    for g in range(geom_id.shape[0]):
        counts = tree_told[tree] or not geom_copy[g]
        if counts and not apart(tree_low[tree], tree_high[tree], geom_low[g], geom_high[g]):
            close_out[i, close] = g
            close = close + 1
    zero = wp.float64(0.0)
    onset = bool(False)
    found = int(0)  # noqa: RUF046
    last = tree_shape[tree + 1]
    if close == 0:
        last = tree_shape[tree]
    for s in range(tree_shape[tree], last):
        there = bool(True)
        if shape_bunch[s] >= 0:
            there = bunch_attached[shape_bunch[s]]
        if there:
            radius = wp.float64(shape_radius[s])
            a = to_double(start[s])
            b = to_double(end[s])
            center = wp.float64(0.5) * (a + b)
            bound = wp.float64(0.5) * wp.length(b - a) + radius
            for k in range(close):
                g = close_out[i, k]
                margin = SKIN + (wp.float64(shape_speed[s]) + geom_speed[g]) * dt
                between = center - middle[g]
                limit = bound + geom_radius[g] + margin
                if wp.dot(between, between) < limit * limit:
                    rotation = xmat[geom_id[g]]
                    near = nearest(geom_kind[g], geom_size[g], rotation, middle[g], a, b)
                    gap = near[3] - radius
                    if gap < margin:
                        if found < slots:
                            normal = wp.vec3d(near[0], near[1], near[2])
                            point = a + near[4] * (b - a) - (radius + wp.float64(0.5) * gap) * normal
                            # how the two would come together if both went on as they go, and where they would touch
                            body = shape_body[s]
                            motion = body_qd[body]
                            spin = to_double(wp.spatial_bottom(motion))
                            lever = point - to_double(wp.transform_get_translation(body_q[body]))
                            velocity = to_double(wp.spatial_top(motion)) + wp.cross(spin, lever)
                            push = geom_velocity[g] + wp.cross(geom_spin[g], point - middle[g])
                            come = dt * wp.dot(normal, velocity - push)
                            turned = turn(dt * geom_spin[g], rotation)
                            later = nearest(
                                geom_kind[g],
                                geom_size[g],
                                turned,
                                middle[g] + dt * geom_velocity[g],
                                to_double(start_ahead[s]),
                                to_double(end_ahead[s]),
                            )
                            normal_later = wp.vec3d(later[0], later[1], later[2])
                            bent = wp.float64(0.0)
                            if wp.dot(normal, normal_later) > AGREE:
                                moved = dt * wp.length(velocity - push)
                                bent = wp.clamp(later[3] - radius - gap - come, -moved, moved)
                                onto = to_double(start_ahead[s]) + later[4] * to_double(end_ahead[s] - start_ahead[s])
                                onto = onto - (later[3] - wp.float64(0.5) * gap) * normal_later - dt * velocity
                                normal = wp.normalize(normal + normal_later)
                                point = wp.float64(0.5) * (point + onto)
                            if gap + come + bent < zero and come < -ABRUPT * dt:
                                onset = True
                            hit_shape_out[i, found] = s
                            hit_geom_out[i, found] = g
                            hit_gap_out[i, found] = gap
                            hit_room_out[i, found] = gap + bent
                            hit_normal_out[i, found] = normal
                            hit_point_out[i, found] = point
                        found = found + 1
    onset_out[i] = onset
    missed_out[i] = wp.max(found - slots, 0)
    for k in range(wp.min(found, slots), slots):
        hit_shape_out[i, k] = -1


@wp.kernel
def couple(
    # model
    dt: wp.float64,
    stiffness: wp.float64,
    damping: wp.float64,
    geom_dof: wp.array(dtype=wp.int32),
    geom_root: wp.array(dtype=wp.int32),
    dof_parent: wp.array(dtype=wp.int32),
    # in
    hits: wp.array(dtype=wp.int32),
    hit_geom: wp.array(dtype=wp.int32),
    hit_gap: wp.array(dtype=wp.float64),
    hit_room: wp.array(dtype=wp.float64),
    hit_normal: wp.array(dtype=wp.vec3d),
    hit_point: wp.array(dtype=wp.vec3d),
    contact_shape: wp.array(dtype=wp.int32),
    contact_body: wp.array(dtype=wp.int32),
    contact_column: wp.array(dtype=wp.int32),
    body_q: wp.array(dtype=wp.transform),
    body_qd_free: wp.array(dtype=wp.spatial_vector),
    dof_free: wp.array(dtype=wp.float64),
    cdof: wp.array2d(dtype=wp.float64),
    subtree_com: wp.array(dtype=wp.vec3d),
    known_count: wp.array(dtype=wp.int32),
    known_shape: wp.array(dtype=wp.int32),
    known_geom: wp.array(dtype=wp.int32),
    known_push: wp.array(dtype=wp.float64),
    known_rub: wp.array(dtype=wp.vec3d),
    known_anchor: wp.array(dtype=wp.vec3d),
    # out
    geom_out: wp.array(dtype=wp.int32),
    gap_out: wp.array(dtype=wp.float64),
    point_out: wp.array(dtype=wp.vec3d),
    axes_out: wp.array(dtype=wp.mat33d),
    plant_rows_out: wp.array2d(dtype=wp.float64),
    rigid_rows_out: wp.array2d(dtype=wp.float64),
    free_out: wp.array(dtype=wp.float64),
    offset_out: wp.array(dtype=wp.float64),
    impulse_out: wp.array(dtype=wp.float64),
):
    """Write the three rows of one contact into zeroed Jacobians, with its free approach, stored stretch, first guess."""
    c = wp.tid()
    zero = wp.float64(0.0)
    h = hits[c]
    g = hit_geom[h]
    n = hit_normal[h]
    x = hit_point[h]
    gap = hit_gap[h]
    t1 = tangent(n)
    t2 = wp.cross(n, t1)
    geom_out[c] = g
    gap_out[c] = gap
    point_out[c] = x
    axes_out[c] = wp.matrix_from_rows(n, t1, t2)
    body = contact_body[c]
    lever = x - to_double(wp.transform_get_translation(body_q[body]))
    motion = body_qd_free[body]
    spin = to_double(wp.spatial_bottom(motion))
    approach = to_double(wp.spatial_top(motion)) + wp.cross(spin, lever)

    for r in range(3):
        axis = n
        if r == 1:
            axis = t1
        if r == 2:
            axis = t2
        row = 3 * c + r
        turn = wp.cross(lever, axis)
        column = contact_column[c]
        for k in range(3):
            plant_rows_out[row, column + k] = axis[k]
            plant_rows_out[row, column + 3 + k] = turn[k]
        about = x - subtree_com[geom_root[g]]
        dof = geom_dof[g]
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
        if known_shape[k] == contact_shape[c] and known_geom[k] == g:
            impulse_out[3 * c] = known_push[k]
            impulse_out[3 * c + 1] = wp.dot(t1, known_rub[k])
            impulse_out[3 * c + 2] = wp.dot(t2, known_rub[k])
            offset_out[3 * c + 1] = wp.dot(t1, known_anchor[k]) * stiffness / give
            offset_out[3 * c + 2] = wp.dot(t2, known_anchor[k]) * stiffness / give


@wp.kernel
def relax(
    # model
    softness: wp.float64,
    iterations: int,
    tolerance: wp.float64,
    geom_friction: wp.array(dtype=wp.float64),
    # in
    island_first: wp.array(dtype=wp.int32),
    island_member: wp.array(dtype=wp.int32),
    geom: wp.array(dtype=wp.int32),
    A: wp.array2d(dtype=wp.float64),
    free: wp.array(dtype=wp.float64),
    offset: wp.array(dtype=wp.float64),
    # out
    impulse_out: wp.array(dtype=wp.float64),
    sweeps_out: wp.array(dtype=wp.int32),
):
    """Solve one island of contacts: projected Gauss-Seidel on |rub| <= mu push, block by block, from the guess on."""
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
            limit = geom_friction[geom[j]] * push
            if rub > limit:
                fu = fu * limit / wp.max(rub, wp.float64(1.0e-30))
                fv = fv * limit / wp.max(rub, wp.float64(1.0e-30))
            change = wp.max(change, wp.abs(fu - impulse_out[u]) + wp.abs(fv - impulse_out[v]))
            impulse_out[u] = fu
            impulse_out[v] = fv
        sweeps = sweeps + 1
        busy = change > tolerance * largest
    sweeps_out[island] = sweeps


@wp.kernel
def remember(
    # model
    dt: wp.float64,
    stiffness: wp.float64,
    damping: wp.float64,
    # in
    count: wp.array(dtype=wp.int32),
    shape: wp.array(dtype=wp.int32),
    geom: wp.array(dtype=wp.int32),
    axes: wp.array(dtype=wp.mat33d),
    A: wp.array2d(dtype=wp.float64),
    free: wp.array(dtype=wp.float64),
    impulse: wp.array(dtype=wp.float64),
    # out
    force_out: wp.array(dtype=wp.vec3d),
    known_shape_out: wp.array(dtype=wp.int32),
    known_geom_out: wp.array(dtype=wp.int32),
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
    for k in range(3 * count[0]):
        slip_u = slip_u + A[n + 1, k] * impulse[k]
        slip_v = slip_v + A[n + 2, k] * impulse[k]
    # the stretch with which spring and damper give just this friction: a contact that slides drags its anchor along
    stretch = -(impulse[n + 1] / dt + damping * slip_u) / stiffness * t1
    stretch = stretch - (impulse[n + 2] / dt + damping * slip_v) / stiffness * t2
    known_shape_out[c] = shape[c]
    known_geom_out[c] = geom[c]
    known_push_out[c] = impulse[n]
    known_rub_out[c] = impulse[n + 1] * t1 + impulse[n + 2] * t2
    known_anchor_out[c] = stretch
    if impulse[n] <= wp.float64(0.0):
        known_shape_out[c] = -1
