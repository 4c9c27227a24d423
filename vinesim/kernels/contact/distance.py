"""Distances: from points and segments to MuJoCo's primitives, and between two segments.

A plant's capsule is a segment with a radius (a sphere when both ends agree). A rigid geom is one of MuJoCo's
primitives. :func:`primitive_distance` returns distance and direction from a point to a primitive. For planes, spheres
and capsules, the closest point of a segment is computed by a formula. For other primitives a bisection of the slope of
the distance finds it, since the distance from any of them is convex along a segment.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# MuJoCo's mjtGeom
PLANE = wp.constant(0)
HEIGHT_FIELD = wp.constant(1)
SPHERE = wp.constant(2)
CAPSULE = wp.constant(3)
ELLIPSOID = wp.constant(4)
CYLINDER = wp.constant(5)
BOX = wp.constant(6)
MESH = wp.constant(7)

MIN_COPLANAR_COSINE = wp.constant(wp.float64(0.999))
"""[1] Least cosine between the normals at two points of a segment for which both points lie along the same face.
TUNED."""
MIN_SLANT = wp.constant(wp.float64(1.0e-6))
"""[1] Squared sine of the angle between a segment and a cylinder's axis below which the segment is treated as parallel
to the axis."""
SLOPE_BISECTIONS = wp.constant(30)
"""Number of bisections in the search for a segment's closest point: precise to 1e-9 of its length."""
ELLIPSOID_NEWTON_STEPS = wp.constant(12)
"""Number of Newton steps to the closest point of an ellipsoid: precise to 1e-9 m for any point."""
FACE_BISECTIONS = wp.constant(12)
"""Number of bisections in the search for the ends of the part of a segment along a face: precise to 1/4096 of the
segment's length."""

vec5d = wp.types.vector(length=5, dtype=wp.float64)
vec6d = wp.types.vector(length=6, dtype=wp.float64)


@wp.func
def cylinder_distance(size: wp.vec3d, p: wp.vec3d):
    """Returns outward normal (entries 0 to 2) and signed distance (3) [m] of a point from a cylinder along z, in the
    cylinder's frame."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    rho = wp.sqrt(p[0] * p[0] + p[1] * p[1])
    radial = wp.vec3d(one, zero, zero)
    if rho > wp.float64(1.0e-12):
        radial = wp.vec3d(p[0] / rho, p[1] / rho, zero)
    axial = wp.vec3d(zero, zero, wp.where(p[2] < zero, -one, one))
    across = rho - size[0]
    along = wp.abs(p[2]) - size[1]
    if across > zero and along > zero:
        gap = wp.sqrt(across * across + along * along)
        n = (across * radial + along * axial) / gap
        return wp.vec4d(n[0], n[1], n[2], gap)
    if across > along:
        return wp.vec4d(radial[0], radial[1], radial[2], across)
    return wp.vec4d(axial[0], axial[1], axial[2], along)


@wp.func
def box_distance(size: wp.vec3d, p: wp.vec3d):
    """Returns outward normal (entries 0 to 2) and signed distance (3) [m] of a point from a box, in the box's frame."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    q = wp.vec3d(
        wp.clamp(p[0], -size[0], size[0]), wp.clamp(p[1], -size[1], size[1]), wp.clamp(p[2], -size[2], size[2])
    )
    out = p - q
    gap = wp.length(out)
    if gap > wp.float64(1.0e-12):
        n = out / gap
        return wp.vec4d(n[0], n[1], n[2], gap)
    depth = wp.vec3d(size[0] - wp.abs(p[0]), size[1] - wp.abs(p[1]), size[2] - wp.abs(p[2]))
    if depth[0] <= depth[1] and depth[0] <= depth[2]:
        return wp.vec4d(wp.where(p[0] < zero, -one, one), zero, zero, -depth[0])
    if depth[1] <= depth[2]:
        return wp.vec4d(zero, wp.where(p[1] < zero, -one, one), zero, -depth[1])
    return wp.vec4d(zero, zero, wp.where(p[2] < zero, -one, one), -depth[2])


@wp.func
def ellipsoid_distance(size: wp.vec3d, p: wp.vec3d):
    """Returns outward normal (entries 0 to 2) and signed distance (3) [m] of a point from an ellipsoid, in the
    ellipsoid's frame.

    Outside, the closest point is q_i = a_i^2 p_i / (a_i^2 + m), where m solves sum (q_i / a_i)^2 = 1 (Eberly,
    Distance from a Point to an Ellipsoid, 2013). The sum falls with m and is convex, so Newton's method approaches the
    root from below. Inside the ellipsoid the distance is a first-order approximation about the surface.
    """
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    a = wp.cw_div(p, size)
    b = wp.cw_div(a, size)
    level = wp.length(a)
    gradient = wp.length(b)
    if gradient < wp.float64(1.0e-12):
        return wp.vec4d(zero, zero, one, -size[2])
    if level <= one:
        n = b / gradient
        return wp.vec4d(n[0], n[1], n[2], level * (level - one) / gradient)
    square = wp.cw_mul(size, size)
    multiplier = wp.float64(0.0)
    for i in range(3):  # no term of the sum exceeds 1
        multiplier = wp.max(multiplier, size[i] * wp.abs(p[i]) - square[i])
    for i in range(ELLIPSOID_NEWTON_STEPS):
        shifted = wp.vec3d(square[0] + multiplier, square[1] + multiplier, square[2] + multiplier)
        c = wp.cw_div(wp.cw_mul(size, p), shifted)
        excess = wp.dot(c, c) - one
        slope = wp.float64(2.0) * wp.dot(c, wp.cw_div(c, shifted))
        if excess > wp.float64(1.0e-14):
            multiplier += excess / slope
    shifted = wp.vec3d(square[0] + multiplier, square[1] + multiplier, square[2] + multiplier)
    # the normal at the closest point q, and p - q = multiplier times q_i / a_i^2
    out = wp.cw_div(p, shifted)
    n = wp.normalize(out)
    return wp.vec4d(n[0], n[1], n[2], multiplier * wp.length(out))


@wp.func
def round_distance(kind: int, size: wp.vec3d, p: wp.vec3d):
    """Returns the result of :func:`primitive_distance` for a plane, sphere or capsule."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    q = wp.vec3d(p[0], p[1], p[2] - wp.clamp(p[2], -size[1], size[1]))
    length = wp.length(q)
    n = wp.vec3d(one, zero, zero)
    if length > wp.float64(1.0e-12):
        n = q / length
    distance = length - size[0]
    if kind == PLANE:
        n = wp.vec3d(zero, zero, one)
        distance = p[2]
    return wp.vec4d(n[0], n[1], n[2], distance)


@wp.func
def primitive_distance(kind: int, size: wp.vec3d, p: wp.vec3d):
    """Returns outward normal (entries 0 to 2) and signed distance (3) [m] of a point from a primitive, in the
    primitive's frame.

    ``size`` is MuJoCo's ``geom_size``. Inside an ellipsoid the distance is a first-order approximation; all other
    results are exact.
    """
    if kind == PLANE or kind == SPHERE or kind == CAPSULE:
        return round_distance(kind, size, p)
    if kind == ELLIPSOID:
        return ellipsoid_distance(size, p)
    if kind == CYLINDER:
        return cylinder_distance(size, p)
    return box_distance(size, p)


@wp.func
def distance_of(is_round: bool, kind: int, size: wp.vec3d, p: wp.vec3d):
    """Returns the result of :func:`primitive_distance`. ``is_round``: whether ``kind`` is known to be a plane, sphere
    or capsule, so that less code is compiled.
    """
    found = wp.vec4d()
    if is_round:
        found = round_distance(kind, size, p)
    else:
        found = primitive_distance(kind, size, p)
    return found


@wp.func
def distance_slope(kind: int, size: wp.vec3d, p: wp.vec3d, direction: wp.vec3d):
    """Returns the directional derivative of the distance from a primitive at point ``p`` along ``direction``."""
    n = primitive_distance(kind, size, p)
    return n[0] * direction[0] + n[1] * direction[1] + n[2] * direction[2]


@wp.func
def closest_to_plane(a: wp.vec3d, b: wp.vec3d):
    """Returns the parameter (0 to 1) of the point of the segment a b that is closest to the plane z = 0; 0.5 if the
    segment is level."""
    rise = b[2] - a[2]
    flat = wp.float64(1.0e-9) * wp.length(b - a)
    t = wp.float64(0.5)
    if rise > flat or flat == wp.float64(0.0):
        t = wp.float64(0.0)
    elif rise < -flat:
        t = wp.float64(1.0)
    return t


@wp.func
def closest_to_axis(a: wp.vec3d, along: wp.vec3d):
    """Returns the parameter (0 to 1) of the point of the segment from ``a`` to ``a + along`` that is closest to the z
    axis; 0 if both are parallel."""
    zero = wp.float64(0.0)
    t = wp.float64(0.0)
    across = along[0] * along[0] + along[1] * along[1]
    if across > zero:
        t = wp.clamp(-(a[0] * along[0] + a[1] * along[1]) / across, zero, wp.float64(1.0))
    return t


@wp.func
def closest_by_bisection(kind: int, size: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    """Returns the result of :func:`closest_on_segment` for any kind of primitive, by bisection; for the side of a
    cylinder by a formula.
    """
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    half = wp.float64(0.5)
    along = b - a
    flat = wp.float64(1.0e-9) * wp.length(along)
    if flat == zero:
        return zero
    if (
        kind == CYLINDER
    ):  # the point closest to the axis, if the side is the closest part there: no point is nearer to the side
        t = closest_to_axis(a, along)
        p = a + t * along
        across = along[0] * along[0] + along[1] * along[1]
        is_outside = p[0] * p[0] + p[1] * p[1] > size[0] * size[0]
        if is_outside and wp.abs(p[2]) <= size[1] and across > MIN_SLANT * wp.length_sq(along):
            return t
    if distance_slope(kind, size, a, along) > flat:
        return zero
    if distance_slope(kind, size, b, along) < -flat:
        return one
    # where the slope stops being negative, where it starts being positive
    low = zero
    high = one
    first = zero
    if kind == CYLINDER:
        first = closest_to_axis(a, along)
    if kind != CYLINDER or wp.abs(distance_slope(kind, size, a + first * along, along)) > flat:
        for i in range(SLOPE_BISECTIONS):
            middle = half * (low + high)
            if distance_slope(kind, size, a + middle * along, along) < -flat:
                low = middle
            else:
                high = middle
        first = high
    low = first
    high = one
    if distance_slope(kind, size, a + wp.min(first + wp.float64(1.0e-6), one) * along, along) > flat:
        return first
    for i in range(SLOPE_BISECTIONS):
        middle = half * (low + high)
        if distance_slope(kind, size, a + middle * along, along) > flat:
            high = middle
        else:
            low = middle
    return half * (first + low)


@wp.func
def closest_to_round(kind: int, size: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    """Returns the result of :func:`closest_on_segment` for a plane, sphere or capsule."""
    t = wp.float64(0.0)
    if kind == PLANE:
        t = closest_to_plane(a, b)
    else:
        end = wp.vec3d(wp.float64(0.0), wp.float64(0.0), size[1])
        found = segment_segment_distance(a, b, -end, end)
        t = found[4]
    return t


@wp.func
def closest_on_segment(kind: int, size: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    """Returns the parameter (0 to 1) of the point of the segment a b that is closest to the primitive; the middle if
    several points are equally close."""
    t = wp.float64(0.0)
    if kind == PLANE or kind == SPHERE or kind == CAPSULE:
        t = closest_to_round(kind, size, a, b)
    else:
        t = closest_by_bisection(kind, size, a, b)
    return t


@wp.func
def segment_primitive_distance(
    is_round: bool, kind: int, size: wp.vec3d, rotation: wp.mat33d, center: wp.vec3d, a: wp.vec3d, b: wp.vec3d
):
    """Returns world normal (entries 0 to 2) and distance (3) [m] from a primitive to the segment a b, and the parameter
    (4) of its closest point, 0 to 1.

    ``is_round``: see :func:`distance_of`.
    """
    to_local = wp.transpose(rotation)
    start = to_local * (a - center)
    along = to_local * (b - center) - start
    t = wp.float64(0.0)
    if is_round:
        t = closest_to_round(kind, size, start, start + along)
    else:
        t = closest_on_segment(kind, size, start, start + along)
    n = distance_of(is_round, kind, size, start + t * along)
    normal = rotation * wp.vec3d(n[0], n[1], n[2])
    return vec5d(normal[0], normal[1], normal[2], n[3], t)


@wp.func
def is_outside_box(half: wp.vec3d, a: wp.vec3d, b: wp.vec3d, reach: wp.float64):
    """Returns whether the segment a b is farther than ``reach`` [m] beyond one side of a box, in the box's frame.

    ``half`` [m]: half edges of the box. If the result is true, any shape inside the box is also farther than ``reach``
    from the segment.
    """
    outside = bool(False)
    for i in range(3):
        outside = outside or wp.max(wp.min(a[i], b[i]), -wp.max(a[i], b[i])) - half[i] > reach
    return outside


@wp.func
def has_flat_or_straight_side(kind: int):
    """Returns whether this kind of primitive has a flat or straight side, along which a segment can lie."""
    return kind == BOX or kind == CAPSULE or kind == CYLINDER


@wp.func
def on_same_face(closest: wp.vec4d, other: wp.vec4d, tolerance: wp.float64):
    """Returns whether another point of a segment is near the same face of a primitive as the closest point, to within
    ``tolerance`` [m].

    ``closest``, ``other``: outward normal (entries 0 to 2) and distance (3) [m] at the closest and at the other point.
    """
    cosine = closest[0] * other[0] + closest[1] * other[1] + closest[2] * other[2]
    return cosine > MIN_COPLANAR_COSINE and other[3] < closest[3] + tolerance


@wp.func
def interval_along_face(
    is_round: bool, kind: int, size: wp.vec3d, a: wp.vec3d, b: wp.vec3d, t: wp.float64, tolerance: wp.float64
):
    """Returns the parameters (0 to 1) of both ends of the part of the segment a b that lies along a primitive's face,
    around the closest point ``t``.

    The two are equal if the segment crosses the face. A capsule that lies along a face needs two contacts; with one
    contact it would rock from step to step. All arguments are in the primitive's frame. ``is_round``: see
    :func:`distance_of`.
    """
    half = wp.float64(0.5)
    along = b - a
    closest = distance_of(is_round, kind, size, a + t * along)
    near = tolerance / wp.length(along)
    leaves = bool(True)  # whether the part along the face is too short on both sides
    for side in range(2):
        u = t + wp.where(side == 0, -near, near)
        if u >= wp.float64(0.0) and u <= wp.float64(1.0):
            leaves = leaves and not on_same_face(closest, distance_of(is_round, kind, size, a + u * along), tolerance)
    if leaves:
        return wp.vec2d(t, t)
    ends = wp.vec2d(wp.float64(0.0), wp.float64(1.0))
    for side in range(2):
        if not on_same_face(closest, distance_of(is_round, kind, size, a + ends[side] * along), tolerance):
            outer = ends[side]
            inner = t
            for i in range(FACE_BISECTIONS):
                middle = half * (outer + inner)
                if on_same_face(closest, distance_of(is_round, kind, size, a + middle * along), tolerance):
                    inner = middle
                else:
                    outer = middle
            ends[side] = inner
    if (ends[1] - ends[0]) * wp.length(along) < wp.float64(2.0) * tolerance:
        ends = wp.vec2d(t, t)
    return ends


@wp.func
def segment_segment_distance(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """Returns world normal (entries 0 to 2) and distance (3) [m] from segment c d to segment a b, and the parameters of
    the closest points on a b (4) and on c d (5), 0 to 1.

    Ericson, Real-Time Collision Detection (2005), section 5.1.9; parallel segments meet in the middle of their overlap.
    """
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
    determinant = uu * vv - uv * uv
    if determinant > tiny * uu * vv:
        s = wp.clamp((uv * vw - vv * uw) / determinant, zero, one)
    elif uu > tiny and vv > tiny:
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
