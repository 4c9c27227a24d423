"""Leaf blades: two quadratic half surfaces hinged at the midrib, cut out by an outline; their bounds, and rays that hit.

A blade lives in its own frame and unit: u across, v along the midrib (from petiole, 0, to tip, 1), w along the normal;
w = a u^2 + b v^2 + c |u| with the curvatures ``bend`` = (a, b, c, age).
"""

import warp as wp

from vinesim.kernels.raster.primitives import FAR, TINY

wp.set_module_options({"enable_backward": False, "fast_math": True})

OUTLINE_TEXELS = wp.constant(128.0)
"""Texels of a leaf's outline per leaf unit: 256 texels over u in [-1, 1], v in [-0.75, 1.25]."""
LEAF_BOUND_MARGIN = wp.constant(1.0e-3)
"""By how much bounds of a blade are wider than they need be, leaf units."""


@wp.func
def leaf_heights(bend: wp.vec4) -> wp.vec2:
    """Lowest and highest w of a blade, leaf units (|u| <= 0.95, |v| <= 1.05)."""
    low = wp.min(0.0, bend[0] * 0.9) + wp.min(0.0, bend[1] * 1.1) + wp.min(0.0, bend[2] * 0.95)
    high = wp.max(0.0, bend[0] * 0.9) + wp.max(0.0, bend[1] * 1.1) + wp.max(0.0, bend[2] * 0.95)
    return wp.vec2(low, high)


@wp.func
def leaf_height(bend: wp.vec4, u: float, v: float) -> float:
    """Height w of a blade, leaf units."""
    return bend[0] * u * u + bend[1] * v * v + bend[2] * wp.abs(u)


@wp.func
def leaf_extent(hull: wp.array2d(dtype=wp.vec2), number: int) -> wp.vec3:
    """Largest |u|, lowest and highest v of an outline: corners 1 and 5 of its octagon lie at the sides, 3 and 7 at the
    ends.
    """
    return wp.vec3(
        wp.max(wp.abs(hull[number, 1][0]), wp.abs(hull[number, 5][0])), hull[number, 3][1], hull[number, 7][1]
    )


@wp.func
def leaf_bulge(hull: wp.array2d(dtype=wp.vec2), number: int, bend: wp.vec4) -> wp.vec2:
    """How far a blade rises above, and falls below, the hull of its points over the corners of its octagon, leaf units.

    A quadratic deviates from its interpolation by at most its curvature times (range / 2)^2. Each half of a blade is
    one; corners 3 and 7 lie at the midrib, or near it.
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
    """Whether a point of the leaf's plane belongs to the blade."""
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
    """First hit with a blade in its own frame and unit: two half surfaces w = a u^2 + b v^2 + c |u|, hinged at u = 0."""
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
    """``t`` if a ray is then over the half of ``sign`` of a blade's rectangle, else :data:`FAR`."""
    u = sign * (o[0] + t * d[0])
    v = o[1] + t * d[1]
    return wp.where(u >= -1.0e-5 and u < extent[0] and v > extent[1] and v < extent[2] and t > 0.0, t, FAR)


@wp.func
def leaf_surface_roots(bend: wp.vec4, extent: wp.vec3, sign: float, o: wp.vec3, d: wp.vec3) -> wp.vec2:
    """Both hits with one half of a blade's rectangle; :data:`FAR` for none."""
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
    """First hit with the rectangle |u| < x, y < v < z that a blade is cut from; negative if there are several hits.

    Without a branch, so that a compiler can take several rays at once.
    """
    right = leaf_surface_roots(bend, extent, 1.0, o, d)
    left = leaf_surface_roots(bend, extent, -1.0, o, d)
    first = wp.min(wp.min(right[0], right[1]), wp.min(left[0], left[1]))
    # several, if the nearest two differ: max-min of each pair, and of the pairs
    second = wp.min(
        wp.max(wp.min(right[0], right[1]), wp.min(left[0], left[1])),
        wp.min(wp.max(right[0], right[1]), wp.max(left[0], left[1])),
    )
    return wp.where(second < FAR, -first, first)
