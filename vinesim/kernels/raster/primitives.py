"""Analytic primitives and their arrays.

Every primitive is four vectors ``a b c d`` whose meaning follows from its kind:

========== ======================= ======================= ============================ =====================
kind       a                       b                       c                            d
========== ======================= ======================= ============================ =====================
CONE       start, radius           end, radius             along, seed, sky at end, 1   -
SPHEROID   centre, radius          axis, length / width    seed, depth, rot, dryness    occlusion vector, mean
LEAF       petiole end, size       midrib, outline number  upper normal, seed           curvatures a b c, age
BOX        centre, half x          quaternion              half y, half z, seed, -      -
ELLIPSOID  centre, half x          quaternion              half y, half z, seed, -      -
CYLINDER   centre of one end, r    centre of the other, -  distance along, seed, -, -   -
TRIANGLE   corner, normal          corner, normal          corner, normal               carrier's quaternion
========== ======================= ======================= ============================ =====================

A ray does not hit a primitive that contains the ray's origin, and hits triangles only from outside (counter-clockwise):
a camera inside a robot's housing looks out. The direction ``d`` of a ray may have any length; ``t`` counts in lengths
of ``d``.

Primitives are grouped in *clusters*: at most some dozens of one kind, close together, on one tree, bunch or link.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": True})

CONE = wp.constant(0)
SPHEROID = wp.constant(1)
LEAF = wp.constant(2)
BOX = wp.constant(3)
ELLIPSOID = wp.constant(4)
CYLINDER = wp.constant(5)
TRIANGLE = wp.constant(6)

FAR = wp.constant(1.0e30)
TINY = wp.constant(1.0e-20)
HIDDEN_HEIGHT = wp.constant(-1.0e6)
"""World coordinate z [m] of the bounding boxes of removed primitives: so far below the ground that no ray of the ray
caster hits them.
"""


@wp.struct
class Shapes:
    """All primitives, each as four vectors ``a b c d`` in the world frame (meaning by kind: see the module)."""

    a: wp.array(dtype=wp.vec4)
    b: wp.array(dtype=wp.vec4)
    c: wp.array(dtype=wp.vec4)
    d: wp.array(dtype=wp.vec4)
    kind: wp.array(dtype=wp.int32)
    outline: wp.array3d(dtype=wp.int8)
    """[outline, 256, 256] Signed distance to the leaf's edge, positive inside [1/400 leaf unit]."""
    hull: wp.array2d(dtype=wp.vec2)
    """[outline, 8] Corners of an octagon around each outline [leaf units]."""


@wp.struct
class Clusters:
    """Clusters: runs of neighbouring primitives of one kind; each array is [cluster]."""

    first: wp.array(dtype=wp.int32)
    size: wp.array(dtype=wp.int32)
    kind: wp.array(dtype=wp.int32)
    shown: wp.array(dtype=wp.int32)
    """[cluster] 0 if the cluster was removed, for example because its bunch was picked."""


@wp.func
def xyz(v: wp.vec4) -> wp.vec3:
    return wp.vec3(v[0], v[1], v[2])


@wp.func
def with_w(v: wp.vec3, w: float) -> wp.vec4:
    return wp.vec4(v[0], v[1], v[2], w)


@wp.func
def as_quat(v: wp.vec4) -> wp.quat:
    return wp.quat(v[0], v[1], v[2], v[3])


@wp.func
def scale_along(v: wp.vec3, axis: wp.vec3, k: float) -> wp.vec3:
    """Returns ``v`` scaled by 1 + k along the unit vector ``axis``, for example to turn a spheroid into a sphere."""
    return v + axis * (k * wp.dot(v, axis))


# Leaf blades: two quadratic half surfaces that meet at the midrib, cut out by an outline. Their bounds and ray hits.
#
# A blade has its own frame and unit: u across, v along the midrib (from petiole, 0, to tip, 1), w along the normal;
# w = a u^2 + b v^2 + c |u| with the curvatures ``bend`` = (a, b, c, age).


OUTLINE_TEXELS = wp.constant(128.0)
"""Number of texels of a leaf's outline per leaf unit: 256 texels cover u in [-1, 1] and v in [-0.75, 1.25]."""
LEAF_BOUND_MARGIN = wp.constant(1.0e-3)
"""Margin that is added to the bounds of a leaf blade [leaf units]."""


@wp.func
def leaf_heights(bend: wp.vec4) -> wp.vec2:
    """Returns bounds of a leaf blade's height w above its plane [leaf units]: lowest, highest (|u| <= 0.95, |v| <=
    1.05).

    ``bend``: curvatures a, b, c of w = a u^2 + b v^2 + c |u|, and age.
    """
    low = wp.min(0.0, bend[0] * 0.9) + wp.min(0.0, bend[1] * 1.1) + wp.min(0.0, bend[2] * 0.95)
    high = wp.max(0.0, bend[0] * 0.9) + wp.max(0.0, bend[1] * 1.1) + wp.max(0.0, bend[2] * 0.95)
    return wp.vec2(low, high)


@wp.func
def leaf_height(bend: wp.vec4, u: float, v: float) -> float:
    """Returns the height w of a leaf blade above its plane at (u, v) [leaf units].

    ``bend``: curvatures a, b, c of w = a u^2 + b v^2 + c |u|, and age.
    """
    return bend[0] * u * u + bend[1] * v * v + bend[2] * wp.abs(u)


@wp.func
def leaf_extent(hull: wp.array2d(dtype=wp.vec2), number: int) -> wp.vec3:
    """Returns bounds of leaf outline ``number`` [leaf units]: largest |u|, lowest and highest v.

    hull: [outline, 8] octagon around each outline; corners 1 and 5 are at the sides, 3 and 7 at the ends.
    """
    return wp.vec3(
        wp.max(wp.abs(hull[number, 1][0]), wp.abs(hull[number, 5][0])), hull[number, 3][1], hull[number, 7][1]
    )


@wp.func
def leaf_bulge(hull: wp.array2d(dtype=wp.vec2), number: int, bend: wp.vec4) -> wp.vec2:
    """Returns the largest distances of a leaf blade above and below a polyhedron [leaf units].

    The polyhedron is the convex hull of the eight points of the blade over the corners of its outline's octagon. A
    quadratic deviates from its linear interpolation by at most its curvature times (range / 2)^2. Each half of a blade
    is a quadratic; corners 3 and 7 are at the midrib or near it. ``bend``: curvatures a, b, c, and age.
    """
    extent = leaf_extent(hull, number)
    wide = 0.5 * extent[0]
    long = 0.5 * (extent[2] - extent[1])
    across = wide * wide * bend[0]
    along = long * long * bend[1]
    off = wp.abs(bend[2]) * wp.max(wp.abs(hull[number, 3][0]), wp.abs(hull[number, 7][0])) + LEAF_BOUND_MARGIN
    above = wp.max(-across, 0.0) + wp.max(-along, 0.0) + off
    below = wp.max(across, 0.0) + wp.max(along, 0.0) + off
    return wp.vec2(above, below)


@wp.func
def inside_outline(outline: wp.array3d(dtype=wp.int8), number: int, u: float, v: float, smooth: int) -> bool:
    """Returns whether point (u, v) [leaf units] of a leaf's plane is inside leaf outline ``number``.

    ``smooth``: 1 to interpolate between texels of the outline.
    """
    x = (u + 1.0) * OUTLINE_TEXELS - 0.5
    y = (v + 0.75) * OUTLINE_TEXELS - 0.5
    i = wp.clamp(int(x), 0, 254)
    j = wp.clamp(int(y), 0, 254)
    if smooth == 0:
        return int(outline[number, j, i]) > 0
    fx = x - float(i)
    fy = y - float(j)
    low = float(outline[number, j, i]) * (1.0 - fx) + float(outline[number, j, i + 1]) * fx
    high = float(outline[number, j + 1, i]) * (1.0 - fx) + float(outline[number, j + 1, i + 1]) * fx
    return low * (1.0 - fy) + high * fy > 0.0


@wp.func
def hit_leaf(
    outline: wp.array3d(dtype=wp.int8), number: int, bend: wp.vec4, o: wp.vec3, d: wp.vec3, smooth: int
) -> float:
    """Returns ``t`` of a ray's first hit with a leaf blade, or FAR; ray and blade are in the blade's own frame and
    unit.

    The blade is two half surfaces w = a u^2 + b v^2 + c |u| that meet at u = 0, cut out by outline ``number``. ``o``,
    ``d``: origin and direction of the ray; ``smooth``: 1 to interpolate between texels of the outline.
    """
    best = FAR
    q2 = -(bend[0] * d[0] * d[0] + bend[1] * d[1] * d[1])
    linear = d[2] - 2.0 * (bend[0] * o[0] * d[0] + bend[1] * o[1] * d[1])
    constant = o[2] - bend[0] * o[0] * o[0] - bend[1] * o[1] * o[1]
    for half in range(2):
        sign = 1.0 - 2.0 * float(half)
        q1 = linear - bend[2] * sign * d[0]
        q0 = constant - bend[2] * sign * o[0]
        h = q1 * q1 - 4.0 * q2 * q0
        if h >= 0.0:
            root = wp.sqrt(h)
            q = -0.5 * (q1 + wp.where(q1 > 0.0, root, -root))
            for k in range(2):
                top = wp.where(k == 0, q0, q)
                bottom = wp.where(k == 0, q, q2)
                if bottom != 0.0:
                    t = top / bottom
                    if t > 0.0 and t < best:
                        u = o[0] + t * d[0]
                        v = o[1] + t * d[1]
                        if sign * u >= -1.0e-5 and u < 0.99 and u > -0.99 and v > -0.74 and v < 1.24:
                            if inside_outline(outline, number, u, v, smooth):
                                best = t
    return best


@wp.func
def within_leaf_rectangle(sign: float, extent: wp.vec3, o: wp.vec3, d: wp.vec3, t: float) -> float:
    """Returns ``t`` if the point o + t d of a ray is within one half of a leaf's bounding rectangle, else :data:`FAR`.

    ``sign``: side of the midrib, 1 or -1; ``extent``: largest |u|, lowest and highest v [leaf units].
    """
    u = sign * (o[0] + t * d[0])
    v = o[1] + t * d[1]
    return wp.where(u >= -1.0e-5 and u < extent[0] and v > extent[1] and v < extent[2] and t > 0.0, t, FAR)


@wp.func
def leaf_surface_roots(bend: wp.vec4, extent: wp.vec3, sign: float, o: wp.vec3, d: wp.vec3) -> wp.vec2:
    """Returns ``t`` of both hits of a ray with one half of a leaf's curved bounding rectangle; :data:`FAR` for no hit.

    ``sign``: side of the midrib, 1 or -1; ``extent``: largest |u|, lowest and highest v [leaf units].
    """
    q2 = -(bend[0] * d[0] * d[0] + bend[1] * d[1] * d[1])
    q1 = d[2] - 2.0 * (bend[0] * o[0] * d[0] + bend[1] * o[1] * d[1]) - bend[2] * sign * d[0]
    q0 = o[2] - bend[0] * o[0] * o[0] - bend[1] * o[1] * o[1] - bend[2] * sign * o[0]
    h = q1 * q1 - 4.0 * q2 * q0
    root = wp.sqrt(wp.max(h, 0.0))
    q = -0.5 * (q1 + wp.where(q1 > 0.0, root, -root))
    one = within_leaf_rectangle(sign, extent, o, d, q0 / wp.where(wp.abs(q) > TINY, q, TINY))
    other = within_leaf_rectangle(sign, extent, o, d, q / wp.where(wp.abs(q2) > TINY, q2, TINY))
    return wp.vec2(wp.where(h >= 0.0, one, FAR), wp.where(h >= 0.0, other, FAR))


@wp.func
def hit_leaf_rectangle(bend: wp.vec4, extent: wp.vec3, o: wp.vec3, d: wp.vec3) -> float:
    """Returns ``t`` of a ray's first hit with the curved rectangle that contains a leaf blade, negated if there are
    several hits; FAR for none.

    ``extent``: largest |u|, lowest and highest v [leaf units]. The code has no branch, so that a compiler can vectorise
    it over several rays.
    """
    right = leaf_surface_roots(bend, extent, 1.0, o, d)
    left = leaf_surface_roots(bend, extent, -1.0, o, d)
    first = wp.min(wp.min(right[0], right[1]), wp.min(left[0], left[1]))
    # there are several hits if the second smallest of the four roots exists: max-min of each pair, and of the pairs
    second = wp.min(
        wp.max(wp.min(right[0], right[1]), wp.min(left[0], left[1])),
        wp.min(wp.max(right[0], right[1]), wp.max(left[0], left[1])),
    )
    return wp.where(second < FAR, -first, first)


# Closed-form intersections of a ray with each kind of primitive, and the normal at the hit.
#
# A ray starts at the origin unless an argument ``o`` gives its start; ``d`` is its direction, of any length. Results
# are in lengths of ``d``, or FAR where the ray misses.


@wp.func
def hit_sphere(centre: wp.vec3, r: float, d: wp.vec3) -> float:
    """Returns the first hit of a ray from the origin with a sphere, in lengths of ``d``; FAR if the ray misses or the
    sphere contains the origin."""
    dd = wp.dot(d, d)
    along = wp.dot(d, centre) / dd
    miss = centre - d * along  # perpendicular from the ray to the centre: r^2 - |miss|^2 stays precise far away
    h = (r * r - wp.dot(miss, miss)) / dd
    t = along - wp.sqrt(wp.max(h, 0.0))
    return wp.where(h >= 0.0 and t > 0.0, t, FAR)


@wp.func
def hit_cone(a: wp.vec3, ra: float, b: wp.vec3, rb: float, d: wp.vec3) -> float:
    """Returns the first hit of a ray from the origin with a cone with rounded ends, in lengths of ``d``, or FAR.

    The cone is the convex hull of spheres around ``a`` and ``b`` with radii ``ra`` and ``rb`` [m] (Quilez, "round
    cone"). The code has no branch, so that it vectorises.
    """
    ba = b - a
    slope = ra - rb
    dd = wp.dot(d, d)
    # t is measured from the ray's point nearest to the middle of the axis, so that float32 resolves micrometres
    shift = wp.dot((a + b) * 0.5, d) / dd
    o = d * shift
    oa = o - a
    ob = o - b
    m0 = wp.dot(ba, ba)
    m1 = wp.dot(ba, oa)
    m2 = wp.dot(ba, d)
    m3 = wp.dot(d, oa)
    m5 = wp.dot(oa, oa)
    d2 = m0 - slope * slope
    k2 = d2 * dd - m2 * m2
    k1 = d2 * m3 - m1 * m2 + m2 * slope * ra
    k0 = d2 * m5 - m1 * m1 + m1 * slope * ra * 2.0 - m0 * ra * ra
    h = k1 * k1 - k0 * k2
    root = wp.sqrt(wp.max(h, 0.0))
    per = 1.0 / wp.where(wp.abs(k2) > TINY, k2, TINY)
    t1 = (-root - k1) * per
    t2 = (root - k1) * per
    y1 = m1 - ra * slope + t1 * m2
    y2 = m1 - ra * slope + t2 * m2
    wide = d2 > 0.0 and h >= 0.0  # neither sphere contains the other, and the ray meets the infinite cone
    steep = k2 < 0.0  # the ray is steeper than the cone's slope, as along the axis: either root may be the first hit
    best = wp.where(wide and y1 > 0.0 and y1 < d2 and (t1 + shift > 0.0 or not steep), t1 + shift, FAR)
    best = wp.min(best, wp.where(wide and steep and y2 > 0.0 and y2 < d2 and t2 + shift > 0.0, t2 + shift, FAR))
    h1 = m3 * m3 - dd * (m5 - ra * ra)
    best = wp.min(best, wp.where(h1 > 0.0, (-m3 - wp.sqrt(wp.max(h1, 0.0))) / dd + shift, FAR))
    m6 = wp.dot(ob, d)
    h2 = m6 * m6 - dd * (wp.dot(ob, ob) - rb * rb)
    best = wp.min(best, wp.where(h2 > 0.0, (-m6 - wp.sqrt(wp.max(h2, 0.0))) / dd + shift, FAR))
    return wp.where(best > 0.0, best, FAR)


@wp.func
def hit_cylinder(a: wp.vec3, b: wp.vec3, r: float, d: wp.vec3) -> float:
    """Returns the first hit of a ray from the origin with a solid cylinder with flat ends, in lengths of ``d``, or FAR.

    ``a``, ``b``: centres of the ends [m]; ``r``: radius [m]. The code has no branch, so that it vectorises.
    """
    ba = b - a
    length2 = wp.dot(ba, ba)
    m = wp.dot(ba, d)
    shift = wp.dot((a + b) * 0.5, d) / wp.dot(d, d)  # see hit_cone
    oa = d * shift - a
    n = wp.dot(ba, oa)
    k2 = length2 * wp.dot(d, d) - m * m
    k1 = length2 * wp.dot(oa, d) - n * m
    k0 = length2 * wp.dot(oa, oa) - n * n - r * r * length2
    h = k1 * k1 - k2 * k0
    meets = k2 > 1.0e-12 * length2 and h >= 0.0  # the ray is not along the axis and meets the infinite cylinder
    t = (-k1 - wp.sqrt(wp.max(h, 0.0))) / wp.where(meets, k2, 1.0)
    y = n + t * m
    best = wp.where(meets and t + shift > 0.0 and y > 0.0 and y < length2, t + shift, FAR)
    end = wp.where(m > 0.0, 0.0, length2)  # the end that faces the ray
    t = (end - n) / wp.where(m != 0.0, m, 1.0)
    p = oa + d * t - ba * (end / length2)
    within = m != 0.0 and wp.dot(p, p) <= r * r
    return wp.where(within and t + shift > 0.0 and t + shift < best, t + shift, best)


@wp.func
def hit_box(o: wp.vec3, d: wp.vec3, half: wp.vec3) -> float:
    """Returns the first hit of the ray from ``o`` along ``d`` with a box of half sizes ``half`` [m], in lengths of
    ``d``, or FAR.

    Ray and box are in the box's frame, whose origin is the box's centre.
    """
    tiny = 1.0e-12
    m = wp.vec3(
        1.0 / wp.where(wp.abs(d[0]) > tiny, d[0], tiny),
        1.0 / wp.where(wp.abs(d[1]) > tiny, d[1], tiny),
        1.0 / wp.where(wp.abs(d[2]) > tiny, d[2], tiny),
    )
    n = wp.cw_mul(m, o)
    k = wp.vec3(wp.abs(m[0]) * half[0], wp.abs(m[1]) * half[1], wp.abs(m[2]) * half[2])
    near = wp.max(wp.max(-n[0] - k[0], -n[1] - k[1]), -n[2] - k[2])
    far = wp.min(wp.min(-n[0] + k[0], -n[1] + k[1]), -n[2] + k[2])
    return wp.where(near <= far and near > 0.0, near, FAR)


@wp.func
def hit_triangle(p: wp.vec3, q: wp.vec3, r: wp.vec3, d: wp.vec3) -> float:
    """Returns the hit of a ray from the origin with the front of triangle p q r [m], in lengths of ``d``, or FAR.

    The test uses edge functions, so that triangles with a common edge leave no gap.
    """
    u = wp.dot(d, wp.cross(r, q))
    v = wp.dot(d, wp.cross(p, r))
    w = wp.dot(d, wp.cross(q, p))
    t = FAR
    slack = -1.0e-6 * (wp.abs(u) + wp.abs(v) + wp.abs(w))
    if u >= slack and v >= slack and w >= slack and u + v + w > 0.0:
        n = wp.cross(q - p, r - p)
        t = wp.dot(p, n) / wp.dot(d, n)
    return wp.where(t > 0.0, t, FAR)


@wp.func
def hit_primitive(s: Shapes, i: int, o: wp.vec3, d: wp.vec3, smooth: int) -> float:
    """Returns the first hit of the world ray from ``o`` along ``d`` with primitive ``i``, in lengths of ``d``, or FAR.

    ``smooth``: 1 to interpolate between texels of a leaf's outline.
    """
    kind = s.kind[i]
    a4 = s.a[i]
    b4 = s.b[i]
    a = xyz(a4) - o
    t = FAR
    if kind == LEAF:
        up = xyz(s.c[i])
        rib = xyz(b4)
        side = wp.cross(rib, up)
        k = 1.0 / a4[3]
        eye = wp.vec3(-wp.dot(a, side), -wp.dot(a, rib), -wp.dot(a, up)) * k
        t = hit_leaf(
            s.outline, int(b4[3]), s.d[i], eye, wp.vec3(wp.dot(d, side), wp.dot(d, rib), wp.dot(d, up)) * k, smooth
        )
    elif kind == SPHEROID:
        k = 1.0 / b4[3] - 1.0
        t = hit_sphere(scale_along(a, xyz(b4), k), a4[3], scale_along(d, xyz(b4), k))
    elif kind == CONE:
        t = hit_cone(a, a4[3], xyz(b4) - o, b4[3], d)
    elif kind == TRIANGLE:
        t = hit_triangle(a, xyz(b4) - o, xyz(s.c[i]) - o, d)
    elif kind == CYLINDER:
        t = hit_cylinder(a, xyz(b4) - o, a4[3], d)
    else:
        c4 = s.c[i]
        q = as_quat(b4)
        half = wp.vec3(a4[3], c4[0], c4[1])
        eye = wp.quat_rotate_inv(q, -a)
        ray = wp.quat_rotate_inv(q, d)
        if kind == BOX:
            t = hit_box(eye, ray, half)
        else:
            t = hit_sphere(-wp.cw_div(eye, half), 1.0, wp.cw_div(ray, half))
    return t


@wp.func
def normal_at(s: Shapes, i: int, p: wp.vec3) -> wp.vec3:
    """Returns the outward unit normal of primitive ``i`` at point ``p`` [m] of its surface; for a leaf, of its upper
    side."""
    kind = s.kind[i]
    a4 = s.a[i]
    b4 = s.b[i]
    c4 = s.c[i]
    a = xyz(a4)
    n = wp.vec3(0.0, 0.0, 1.0)
    if kind == LEAF:
        bend = s.d[i]
        rib = xyz(b4)
        up = xyz(c4)
        side = wp.cross(rib, up)
        u = wp.dot(p - a, side) / a4[3]
        v = wp.dot(p - a, rib) / a4[3]
        n = side * (-2.0 * bend[0] * u - wp.where(u > 0.0, bend[2], -bend[2])) + rib * (-2.0 * bend[1] * v) + up
    elif kind == SPHEROID:
        k = 1.0 / b4[3] - 1.0
        n = scale_along(scale_along(p - a, xyz(b4), k), xyz(b4), k)
    elif kind == CONE or kind == CYLINDER:
        ba = xyz(b4) - a
        h = wp.dot(p - a, ba) / wp.dot(ba, ba)
        n = p - a - ba * wp.clamp(h, 0.0, 1.0)
        if kind == CYLINDER and (h < 1.0e-4 or h > 0.9999):
            n = ba * wp.where(h < 0.5, -1.0, 1.0)
    elif kind == TRIANGLE:
        n = wp.cross(xyz(b4) - a, xyz(c4) - a)
    else:
        q = as_quat(b4)
        e = wp.cw_div(wp.quat_rotate_inv(q, p - a), wp.vec3(a4[3], c4[0], c4[1]))
        if kind == BOX:
            m = wp.max(wp.max(wp.abs(e[0]), wp.abs(e[1])), wp.abs(e[2])) * 0.9999
            n = wp.vec3(
                wp.where(wp.abs(e[0]) >= m, wp.sign(e[0]), 0.0),
                wp.where(wp.abs(e[1]) >= m, wp.sign(e[1]), 0.0),
                wp.where(wp.abs(e[2]) >= m, wp.sign(e[2]), 0.0),
            )
        else:
            n = wp.cw_div(e, wp.vec3(a4[3], c4[0], c4[1]))
        n = wp.quat_rotate(q, n)
    return wp.normalize(n)


# The box around a primitive, in the frame of the camera or lidar: a bound that stays narrow next to the sensor.


@wp.struct
class OrientedBox:
    """A box: its centre and three half axes [m]."""

    centre: wp.vec3
    x: wp.vec3
    y: wp.vec3
    z: wp.vec3


@wp.func
def oriented_box(shapes: Shapes, i: int, kind: int, eye: wp.vec3, rotation: wp.mat33) -> OrientedBox:
    """Returns the bounding box of box, ellipsoid, cylinder or leaf ``i`` in the frame of a sensor.

    ``eye``: position of the sensor in the world [m]; ``rotation``: rotation from the world to the sensor's frame.
    """
    a4 = shapes.a[i]
    b4 = shapes.b[i]
    c4 = shapes.c[i]
    o = OrientedBox()
    o.centre = rotation * (xyz(a4) - eye)
    if kind == CYLINDER:
        o.z = 0.5 * (rotation * (xyz(b4) - xyz(a4)))
        o.centre += o.z
        axis = o.z / wp.max(wp.length(o.z), 1.0e-9)
        other = wp.where(wp.abs(axis[2]) < 0.7, wp.vec3(0.0, 0.0, 1.0), wp.vec3(1.0, 0.0, 0.0))
        o.x = wp.normalize(wp.cross(axis, other)) * a4[3]
        o.y = wp.cross(axis, o.x)
    elif kind == LEAF:
        rib = rotation * xyz(b4)
        up = rotation * xyz(c4)
        heights = leaf_heights(shapes.d[i])
        extent = leaf_extent(shapes.hull, int(b4[3]))
        o.centre += (rib * (extent[1] + extent[2]) + up * (heights[0] + heights[1])) * (0.5 * a4[3])
        o.x = wp.cross(rib, up) * (extent[0] * a4[3])
        o.y = rib * (0.5 * (extent[2] - extent[1]) * a4[3])
        o.z = up * (0.5 * (heights[1] - heights[0]) * a4[3])
    else:
        q = as_quat(b4)
        o.x = rotation * wp.quat_rotate(q, wp.vec3(a4[3], 0.0, 0.0))
        o.y = rotation * wp.quat_rotate(q, wp.vec3(0.0, c4[0], 0.0))
        o.z = rotation * wp.quat_rotate(q, wp.vec3(0.0, 0.0, c4[1]))
    return o
