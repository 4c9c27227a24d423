"""Primitives in Taichi: for each kind, functions that transform it to the optical frame, bound it and intersect rays.

Functions ``place_*`` transform a primitive into the optical frame, ``*_outline`` bound its picture by a box and two
strips ``low <= x - slope y <= high``, ``hit_*`` intersect it with the ray of a pixel. The arrays are those of
:mod:`vinesim.kernels.raster.primitives`. This module must not import ``annotations`` from ``__future__``, because
Taichi evaluates annotations.
"""

import os

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # standard output is for the command's results

import taichi as ti
from taichi.math import clamp, cross, dot, length, vec2, vec3, vec4

from vinesim.kernels.raster import pinhole, primitives
from vinesim.kernels.raster import primitives as leaf_surface
from vinesim.sensors.raster.primitive_arrays import BOX, CONE, CYLINDER, ELLIPSOID, LEAF, SPHEROID, TRIANGLE

FAR = float(primitives.FAR)
UNBOUND = float(pinhole.UNBOUND)
NEAR_DEPTH = float(pinhole.NEAR_DEPTH)
TEXELS = float(leaf_surface.OUTLINE_TEXELS)

mat3 = ti.types.matrix(3, 3, ti.f32)
Placed = ti.types.struct(a=vec4, b=vec4, c=vec4, d=vec4)
"""A primitive in the optical frame, as four vectors. For boxes and ellipsoids, b and c are two axes, each with a half
size as fourth component."""
Lens = ti.types.struct(
    eye=vec3, rotation=mat3, focal=vec2, centre=vec2, size=vec2, max_depth=ti.f32, near_radius=ti.f32
)
Bound = ti.types.struct(box=vec4, rising=vec3, falling=vec3, depth=ti.f32)
"""Bounds of a primitive in the picture. ``box``: lowest and highest x, lowest and highest y [px]. ``rising``,
``falling``: strips (slope, low, high). ``depth``: lower bound of the depth of the primitive's points [m]."""
EMPTY_BOUNDS = vec4(UNBOUND, -UNBOUND, UNBOUND, -UNBOUND)
UNBOUNDED_STRIP = vec3(0.0, -UNBOUND, UNBOUND)


# ------------------------------------------------------------------------------------------------- bounds


@ti.func
def tangents(x, z, r):
    """Returns x / z of both tangents from the origin to a circle of radius ``r`` around (x, z) [m]; very large numbers
    of the right sign for tangents beyond +-90 degrees."""
    out = vec2(-UNBOUND, UNBOUND)
    free = x * x + z * z - r * r
    if free > 0.0:
        t = ti.sqrt(free)
        tiny = 1.0e-6 * t
        low = vec2(x * t - z * r, z * t + x * r)
        high = vec2(x * t + z * r, z * t - x * r)
        out[0] = ti.select(low[1] > tiny, low[0] / ti.max(low[1], tiny), ti.select(low[0] < 0.0, -UNBOUND, UNBOUND))
        out[1] = ti.select(high[1] > tiny, high[0] / ti.max(high[1], tiny), ti.select(high[0] < 0.0, -UNBOUND, UNBOUND))
    return out


@ti.func
def ball(lens, p, r):
    """Returns the box [px] around the picture of a sphere of radius ``r`` [m] around ``p`` [m], in the optical
    frame."""
    h = tangents(p[0], p[2], r) * lens.focal[0] + lens.centre[0]
    v = tangents(p[1], p[2], r) * lens.focal[1]
    return vec4(h[0], h[1], v[0] + lens.centre[1], v[1] + lens.centre[1])


@ti.func
def pixel_of(lens, p):
    return p.xy / p[2] * lens.focal + lens.centre


@ti.func
def widened(box, q):
    return vec4(ti.min(box[0], q[0]), ti.max(box[1], q[0]), ti.min(box[2], q[1]), ti.max(box[3], q[1]))


@ti.func
def leaf_outline(s, hull: ti.template(), lens):
    size = s.a[3]
    p = s.a.xyz
    rib = s.b.xyz
    up = s.c.xyz
    side = cross(rib, up)
    reach = s.d.xyz * vec3(0.9, 1.1, 0.95)
    levels = vec2(ti.min(reach, 0.0).sum(), ti.max(reach, 0.0).sum())
    depth = FAR
    box = EMPTY_BOUNDS
    turned = EMPTY_BOUNDS
    for n in ti.static(range(16)):
        u = hull[int(s.b[3]), n // 2, 0]
        v = hull[int(s.b[3]), n // 2, 1]
        q = p + (side * u + rib * v + up * levels[n % 2]) * size
        depth = ti.min(depth, q[2])
        q[2] = ti.max(q[2], 0.01)
        at = pixel_of(lens, q)
        box = widened(box, at)
        turned = widened(turned, vec2(at[0] - at[1], at[0] + at[1]))
    if depth < NEAR_DEPTH:
        turned = vec4(-UNBOUND, UNBOUND, -UNBOUND, UNBOUND)
        box = ball(lens, p + rib * (0.25 * size), 1.45 * size)
        if p[2] < -1.6 * size:
            box = EMPTY_BOUNDS
    return Bound(box=box, rising=vec3(1.0, turned[0], turned[1]), falling=vec3(-1.0, turned[2], turned[3]), depth=depth)


@ti.func
def cone_outline(s, hull: ti.template(), lens):
    a = s.a.xyz
    b = s.b.xyz
    r = ti.max(s.a[3], s.b[3])
    box = EMPTY_BOUNDS
    strip = UNBOUNDED_STRIP
    if ti.max(a[2], b[2]) > -r:
        # if the cone stays clear of the part of the view nearer than NEAR_DEPTH, its axis may be cut at NEAR_DEPTH
        axis = b - a
        cut = NEAR_DEPTH - r
        start = a
        end = b
        clear = True
        if ti.min(a[2], b[2]) < cut:
            clear = length(a + axis * clamp(-dot(a, axis) / dot(axis, axis), 0.0, 1.0)) - r > lens.near_radius
            if a[2] < cut and b[2] > cut:
                start = a + axis * ((cut - a[2]) / axis[2])
            if b[2] < cut and a[2] > cut:
                end = a + axis * ((cut - a[2]) / axis[2])
        box = vec4(-UNBOUND, UNBOUND, -UNBOUND, UNBOUND)
        if clear:
            f = ball(lens, start, r)
            g = ball(lens, end, r)
            box = vec4(ti.min(f[0], g[0]), ti.max(f[1], g[1]), ti.min(f[2], g[2]), ti.max(f[3], g[3]))
            rise = 0.5 * (g[2] + g[3] - f[2] - f[3])
            if ti.min(start[2], end[2]) - r > 0.01 and ti.abs(rise) > 2.0:
                slope = 0.5 * (g[0] + g[1] - f[0] - f[1]) / rise
                middle = 0.5 * (f[0] + f[1] - slope * (f[2] + f[3]))
                half = 0.5 * (ti.max(f[1] - f[0], g[1] - g[0]) + ti.abs(slope) * ti.max(f[3] - f[2], g[3] - g[2]))
                strip = vec3(slope, middle - half, middle + half)
    return Bound(box=box, rising=strip, falling=UNBOUNDED_STRIP, depth=ti.min(a[2], b[2]) - r)


@ti.func
def ball_outline(lens, centre, r):
    box = EMPTY_BOUNDS
    if centre[2] > -r:
        box = ball(lens, centre, r)
    return Bound(box=box, rising=UNBOUNDED_STRIP, falling=UNBOUNDED_STRIP, depth=centre[2] - r)


@ti.func
def spheroid_outline(s, hull: ti.template(), lens):
    return ball_outline(lens, s.a.xyz, s.a[3] * ti.max(s.b[3], 1.0))


@ti.func
def ellipsoid_outline(s, hull: ti.template(), lens):
    return ball_outline(lens, s.a.xyz, ti.max(s.a[3], s.b[3], s.c[3]))


@ti.func
def cylinder_outline(s, hull: ti.template(), lens):
    return ball_outline(lens, (s.a.xyz + s.b.xyz) * 0.5, length(vec2(length(s.b.xyz - s.a.xyz) * 0.5, s.a[3])))


@ti.func
def box_outline(s, hull: ti.template(), lens):
    o = ball_outline(lens, s.a.xyz, length(vec3(s.a[3], s.b[3], s.c[3])))
    if o.depth > NEAR_DEPTH:
        o.box = EMPTY_BOUNDS
        x = s.b.xyz * s.a[3]
        y = s.c.xyz * s.b[3]
        z = cross(s.b.xyz, s.c.xyz) * s.c[3]
        for n in ti.static(range(8)):
            corner = x * (n % 2 * 2 - 1) + y * (n // 2 % 2 * 2 - 1) + z * (n // 4 * 2 - 1)
            o.box = widened(o.box, pixel_of(lens, s.a.xyz + corner))
    return o


@ti.func
def triangle_outline(s, hull: ti.template(), lens):
    a = s.a.xyz
    b = s.b.xyz
    c = s.c.xyz
    depth = ti.min(a[2], b[2], c[2])
    box = EMPTY_BOUNDS
    if dot(a, cross(b - a, c - a)) < 0.0 and ti.max(a[2], b[2], c[2]) > 0.0:
        if depth > NEAR_DEPTH:
            box = widened(widened(widened(box, pixel_of(lens, a)), pixel_of(lens, b)), pixel_of(lens, c))
        else:
            middle = (a + b + c) / 3.0
            box = ball(lens, middle, ti.max(length(a - middle), length(b - middle), length(c - middle)) * 1.001)
    return Bound(box=box, rising=UNBOUNDED_STRIP, falling=UNBOUNDED_STRIP, depth=depth)


# --------------------------------------------------------------------------------------------------- rays


@ti.func
def hit_ball(centre, r, d):
    """Returns the first hit of a ray from the origin with a sphere that does not contain the origin, in lengths of
    ``d``."""
    dd = dot(d, d)
    along = dot(d, centre) / dd
    miss = centre - d * along
    h = (r * r - dot(miss, miss)) / dd
    t = FAR
    if h >= 0.0:
        t = along - ti.sqrt(h)
    return ti.select(t > 0.0, t, FAR)


@ti.func
def squeezed(v, axis, k):
    return v + axis * (k * dot(v, axis))


@ti.func
def hit_spheroid(s, outlines: ti.template(), d, smooth):
    k = 1.0 / s.b[3] - 1.0
    return hit_ball(squeezed(s.a.xyz, s.b.xyz, k), s.a[3], squeezed(d, s.b.xyz, k))


@ti.func
def in_box_frame(s, v):
    return vec3(dot(v, s.b.xyz), dot(v, s.c.xyz), dot(v, cross(s.b.xyz, s.c.xyz)))


@ti.func
def hit_ellipsoid(s, outlines: ti.template(), d, smooth):
    half = vec3(s.a[3], s.b[3], s.c[3])
    return hit_ball(in_box_frame(s, s.a.xyz) / half, 1.0, in_box_frame(s, d) / half)


@ti.func
def hit_box(s, outlines: ti.template(), d, smooth):
    ray = in_box_frame(s, d)
    m = 1.0 / ti.select(ti.abs(ray) > 1.0e-12, ray, 1.0e-12)
    n = m * in_box_frame(s, s.a.xyz)
    k = ti.abs(m) * vec3(s.a[3], s.b[3], s.c[3])
    near = (n - k).max()
    far = (n + k).min()
    return ti.select(near <= far and near > 0.0, near, FAR)


@ti.func
def hit_cone(s, outlines: ti.template(), d, smooth):
    """Returns the hit with a cone with rounded ends (the convex hull of two spheres), in lengths of ``d``.

    The equations are solved from the ray's point nearest to the middle of the axis, for precision.
    """
    a = s.a.xyz
    b = s.b.xyz
    ra = s.a[3]
    rb = s.b[3]
    ba = b - a
    slope = ra - rb
    dd = dot(d, d)
    shift = dot((a + b) * 0.5, d) / dd
    oa = d * shift - a
    ob = d * shift - b
    m0 = dot(ba, ba)
    m1 = dot(ba, oa)
    m2 = dot(ba, d)
    m3 = dot(d, oa)
    m5 = dot(oa, oa)
    d2 = m0 - slope * slope
    k2 = d2 * dd - m2 * m2
    k1 = d2 * m3 - m1 * m2 + m2 * slope * ra
    k0 = d2 * m5 - m1 * m1 + m1 * slope * ra * 2.0 - m0 * ra * ra
    h = k1 * k1 - k0 * k2
    best = FAR
    side = False
    if d2 > 0.0 and h >= 0.0:
        root = ti.sqrt(h)
        if k2 > 0.0:
            t = (-root - k1) / k2
            y = m1 - ra * slope + t * m2
            if y > 0.0 and y < d2:
                best = t + shift
                side = True
        elif k2 < 0.0:  # the ray is steeper than the cone's slope: either root may be the first hit
            for sign in ti.static((1.0, -1.0)):
                t = (sign * root - k1) / k2
                y = m1 - ra * slope + t * m2
                if y > 0.0 and y < d2 and t + shift > 0.0:
                    best = ti.min(best, t + shift)
    if not side:
        h1 = m3 * m3 - dd * (m5 - ra * ra)
        if h1 > 0.0:
            best = (-m3 - ti.sqrt(h1)) / dd + shift
        m6 = dot(ob, d)
        h2 = m6 * m6 - dd * (dot(ob, ob) - rb * rb)
        if h2 > 0.0:
            best = ti.min(best, (-m6 - ti.sqrt(h2)) / dd + shift)
    return ti.select(best > 0.0, best, FAR)


@ti.func
def hit_cylinder(s, outlines: ti.template(), d, smooth):
    a = s.a.xyz
    b = s.b.xyz
    r = s.a[3]
    ba = b - a
    length2 = dot(ba, ba)
    m = dot(ba, d)
    shift = dot((a + b) * 0.5, d) / dot(d, d)
    oa = d * shift - a
    n = dot(ba, oa)
    k2 = length2 * dot(d, d) - m * m
    k1 = length2 * dot(oa, d) - n * m
    h = k1 * k1 - k2 * (length2 * dot(oa, oa) - n * n - r * r * length2)
    best = FAR
    if k2 > 1.0e-12 * length2 and h >= 0.0:
        t = (-k1 - ti.sqrt(h)) / k2
        y = n + t * m
        if t + shift > 0.0 and y > 0.0 and y < length2:
            best = t + shift
    if m != 0.0:
        end = ti.select(m > 0.0, 0.0, length2)
        t = (end - n) / m
        p = oa + d * t - ba * (end / length2)
        if t + shift > 0.0 and t + shift < best and dot(p, p) <= r * r:
            best = t + shift
    return best


@ti.func
def hit_triangle(s, outlines: ti.template(), d, smooth):
    p = s.a.xyz
    q = s.b.xyz
    r = s.c.xyz
    u = dot(d, cross(r, q))
    v = dot(d, cross(p, r))
    w = dot(d, cross(q, p))
    slack = -1.0e-6 * (ti.abs(u) + ti.abs(v) + ti.abs(w))
    t = FAR
    if u >= slack and v >= slack and w >= slack and u + v + w > 0.0:
        n = cross(q - p, r - p)
        t = dot(p, n) / dot(d, n)
    return ti.select(t > 0.0, t, FAR)


@ti.func
def on_blade(outlines: ti.template(), number, u, v, smooth):
    x = (u + 1.0) * TEXELS - 0.5
    y = (v + 0.75) * TEXELS - 0.5
    i = clamp(int(x), 0, 254)
    j = clamp(int(y), 0, 254)
    inside = int(outlines[number, j, i]) > 0
    if smooth:
        fx = x - i
        fy = y - j
        low = outlines[number, j, i] * (1.0 - fx) + outlines[number, j, i + 1] * fx
        high = outlines[number, j + 1, i] * (1.0 - fx) + outlines[number, j + 1, i + 1] * fx
        inside = low * (1.0 - fy) + high * fy > 0.0
    return inside


@ti.func
def hit_leaf(s, outlines: ti.template(), ray, smooth):
    """Returns the hit with a leaf: two half surfaces w = a u^2 + b v^2 + c |u|, in the leaf's own frame and unit, that
    meet at u = 0."""
    rib = s.b.xyz
    up = s.c.xyz
    bend = s.d
    side = cross(rib, up)
    per = 1.0 / s.a[3]
    o = vec3(dot(s.a.xyz, side), dot(s.a.xyz, rib), dot(s.a.xyz, up)) * -per
    d = vec3(dot(ray, side), dot(ray, rib), dot(ray, up)) * per
    q2 = -(bend[0] * d[0] * d[0] + bend[1] * d[1] * d[1])
    linear = d[2] - 2.0 * (bend[0] * o[0] * d[0] + bend[1] * o[1] * d[1])
    constant = o[2] - bend[0] * o[0] * o[0] - bend[1] * o[1] * o[1]
    best = FAR
    for sign in ti.static((1.0, -1.0)):
        q1 = linear - bend[2] * sign * d[0]
        q0 = constant - bend[2] * sign * o[0]
        h = q1 * q1 - 4.0 * q2 * q0
        if h >= 0.0:
            root = ti.sqrt(h)
            q = -0.5 * (q1 + ti.select(q1 > 0.0, root, -root))
            for k in ti.static(range(2)):
                top, bottom = (q0, q) if ti.static(k == 0) else (q, q2)
                if bottom != 0.0:
                    t = top / bottom
                    u = o[0] + t * d[0]
                    v = o[1] + t * d[1]
                    nearer = t > 0.0 and t < best and sign * u >= -1.0e-5
                    if nearer and u < 0.99 and u > -0.99 and v > -0.74 and v < 1.24:
                        best = ti.select(on_blade(outlines, int(s.b[3]), u, v, smooth), t, best)
    return best


# ---------------------------------------------------------------------------- transforms to the optical frame


@ti.func
def point(lens, v):
    return vec4(lens.rotation @ (v.xyz - lens.eye), v[3])


@ti.func
def arrow(lens, v):
    return vec4(lens.rotation @ v.xyz, v[3])


@ti.func
def place_blade(lens, a, b, c, d):
    """Transform a leaf or spheroid to the optical frame: ``a`` is a point, the other vectors are directions."""
    return Placed(a=point(lens, a), b=arrow(lens, b), c=arrow(lens, c), d=d)


@ti.func
def place_points(lens, a, b, c, d):
    return Placed(a=point(lens, a), b=point(lens, b), c=point(lens, c), d=d)


@ti.func
def place_box(lens, a, b, c, d):
    x = b[0]
    y = b[1]
    z = b[2]
    w = b[3]
    first = vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + z * w), 2.0 * (x * z - y * w))
    second = vec3(2.0 * (x * y - z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + x * w))
    return Placed(a=point(lens, a), b=arrow(lens, vec4(first, c[0])), c=arrow(lens, vec4(second, c[1])), d=d)


KERNEL_FUNCTIONS = {
    CONE: (place_points, cone_outline, hit_cone),
    SPHEROID: (place_blade, spheroid_outline, hit_spheroid),
    TRIANGLE: (place_points, triangle_outline, hit_triangle),
    BOX: (place_box, box_outline, hit_box),
    ELLIPSOID: (place_box, ellipsoid_outline, hit_ellipsoid),
    CYLINDER: (place_points, cylinder_outline, hit_cylinder),
    LEAF: (place_blade, leaf_outline, hit_leaf),  # last, because leaves cost most, and most are then already hidden
}
