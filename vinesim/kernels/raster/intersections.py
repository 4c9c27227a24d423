"""Where a ray meets a primitive, in closed form, and the normal there.

A ray starts at the origin unless said otherwise; ``d`` is its direction, of any length, and results count in lengths of
``d``; FAR where the ray misses.
"""

import warp as wp

from vinesim.kernels.raster.leaf_surface import hit_leaf
from vinesim.kernels.raster.primitives import (
    BOX,
    CONE,
    CYLINDER,
    FAR,
    LEAF,
    SPHEROID,
    TINY,
    TRIANGLE,
    Shapes,
    as_quat,
    scale_along,
    xyz,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.func
def hit_sphere(centre: wp.vec3, r: float, d: wp.vec3) -> float:
    """First hit of a ray from the origin with a sphere that does not hold the origin."""
    dd = wp.dot(d, d)
    along = wp.dot(d, centre) / dd
    miss = centre - d * along  # the perpendicular: r^2 - |miss|^2 loses no digits far away
    h = (r * r - wp.dot(miss, miss)) / dd
    t = along - wp.sqrt(wp.max(h, 0.0))
    return wp.where(h >= 0.0 and t > 0.0, t, FAR)


@wp.func
def hit_cone(a: wp.vec3, ra: float, b: wp.vec3, rb: float, d: wp.vec3) -> float:
    """First hit of a ray from the origin with the hull of two spheres (Quilez, "round cone"), without a branch."""
    ba = b - a
    slope = ra - rb
    dd = wp.dot(d, d)
    # measured from the foot of the perpendicular onto the axis' middle, so that float32 keeps micrometres
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
    wide = d2 > 0.0 and h >= 0.0  # neither sphere holds the other, and the ray meets the infinite cone
    steep = k2 < 0.0  # than the slope, as when looking along the axis: either root may be the first hit
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
    """First hit of a ray from the origin with a solid cylinder with flat ends, without a branch."""
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
    meets = k2 > 1.0e-12 * length2 and h >= 0.0  # not along the axis
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
    """First hit with a box around the origin of its own frame."""
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
    """Hit of a ray from the origin with the front of a triangle (edge functions: neighbours leave no gap)."""
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
    """First hit of a world ray with primitive ``i``; :data:`FAR` if there is none."""
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
    """Outward normal of primitive ``i`` at a point of its surface; of a leaf, its upper side."""
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
