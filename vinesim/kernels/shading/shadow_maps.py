"""Visibility of sun and sky: shadow maps drawn from the sun, and the share of sky light that passes through the
leaves."""

import warp as wp

from vinesim.kernels.raster.pinhole import BATCH, FloatBatch, IntBatch
from vinesim.kernels.raster.primitives import (
    BOX,
    CONE,
    CYLINDER,
    FAR,
    LEAF,
    SPHEROID,
    TRIANGLE,
    Clusters,
    Shapes,
    as_quat,
    hit_box,
    hit_sphere,
    hit_triangle,
    leaf_bulge,
    leaf_height,
    xyz,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})

SUN_DISTANCE = wp.constant(100.0)
"""Distance [m] from a shadow map's corner, towards the sun, of the plane from which its depths are measured."""
SHADOW_MARGIN = wp.constant(2.0)
"""Largest distance [texel] by which a drawn primitive may extend beyond the bounding sphere of its cluster."""
SUN_RADIUS = wp.constant(0.0047)
"""Half of the angle that the sun's disc subtends [rad]."""


@wp.struct
class ShadowMap:
    """A shadow map: ``side`` x ``side`` depths [m] along the sunlight over a square across it.

    ``corner``: position of texel (0, 0) [m]; ``right``, ``up``: unit vectors of its columns and rows; ``sun``: unit
    vector towards the sun; ``texel``: width of a texel [m].
    """

    depth: wp.array(dtype=wp.float32)
    corner: wp.vec3
    right: wp.vec3
    up: wp.vec3
    sun: wp.vec3
    texel: float
    side: int


@wp.kernel
def sky_visibility(
    # model
    density: wp.array3d(dtype=wp.float32),
    corner: wp.vec3,
    cell: float,
    # in
    position: wp.array(dtype=wp.vec3),
    # out
    sky_out: wp.array(dtype=wp.float32),
):
    """One thread computes the share of the sky light that reaches one point through leaves (Beer-Lambert, 13
    directions).

    density: [x, y, z] leaf area per volume [1/m] in cells of ``cell`` [m] from ``corner`` on; position: [point] m;
    sky: [point] 0 to 1.
    """
    i = wp.tid()
    total = float(0.0)
    weight = float(0.0)
    for k in range(13):
        angle = 1.0472 * float(k)
        tilt = wp.where(k < 6, 0.6, 0.9)
        d = wp.vec3(tilt * wp.cos(angle), tilt * wp.sin(angle), wp.sqrt(1.0 - tilt * tilt))
        if k == 12:
            d = wp.vec3(0.0, 0.0, 1.0)
        depth = float(0.0)
        for n in range(14):
            p = (position[i] + d * (0.12 + 0.17 * float(n)) - corner) / cell
            x = int(wp.floor(p[0]))
            y = int(wp.floor(p[1]))
            z = int(wp.floor(p[2]))
            if x >= 0 and y >= 0 and z >= 0 and x < density.shape[0] and y < density.shape[1] and z < density.shape[2]:
                depth += density[x, y, z] * (0.17 * 0.5)
        total += wp.exp(-depth) * d[2]
        weight += d[2]
    sky_out[i] = total / weight


@wp.func
def write_depth(m: ShadowMap, x: int, y: int, z: float, depth_out: wp.array(dtype=wp.float32)):
    wp.atomic_min(depth_out, y * m.side + x, z)


@wp.func
def shadow_spheroid(
    m: ShadowMap,
    r: float,
    x: float,
    y: float,
    z: float,
    part: int,
    slices: int,
    window: wp.vec4i,
    depth_out: wp.array(dtype=wp.float32),
):
    """Draw a sphere of radius ``r`` [m] at texel (x, y) and depth ``z`` [m] into the shadow map.

    Only every ``slices``-th row of texels is drawn, from row ``part`` of the sphere on, and only inside ``window``
    (first and last + 1 column, first and last + 1 row).
    """
    rt = r / m.texel
    for py in range(wp.max(int(y - rt), window[2]) + part, wp.min(int(y + rt) + 2, window[3]), slices):
        for px in range(wp.max(int(x - rt), window[0]), wp.min(int(x + rt) + 2, window[1])):
            dx = float(px) - x
            dy = float(py) - y
            h = rt * rt - dx * dx - dy * dy
            if h > 0.0:
                write_depth(m, px, py, z - wp.sqrt(h) * m.texel, depth_out)


@wp.func
def shadow_cone(
    m: ShadowMap,
    shapes: Shapes,
    i: int,
    smallest: float,
    x: float,
    y: float,
    z: float,
    part: int,
    slices: int,
    window: wp.vec4i,
    depth_out: wp.array(dtype=wp.float32),
):
    """Draw cone or cylinder ``i`` into the shadow map if its radius exceeds ``smallest`` texels.

    Its start is at texel (x, y) and depth ``z`` [m]. Only every ``slices``-th row is drawn, from row ``part`` on, and
    only inside ``window`` (first and last + 1 column, first and last + 1 row).
    """
    kind = shapes.kind[i]
    r = shapes.a[i][3]
    b4 = shapes.b[i]
    rb = wp.where(kind == CONE, b4[3], r)
    if wp.max(r, rb) > smallest * m.texel:
        q = xyz(b4) - m.corner
        ex = wp.dot(q, m.right) / m.texel - x
        ey = wp.dot(q, m.up) / m.texel - y
        ez = SUN_DISTANCE - wp.dot(q, m.sun) - z
        wide = wp.max(wp.max(r, rb) / m.texel, 0.55)
        per = 1.0 / wp.max(ex * ex + ey * ey, 1.0e-6)
        y0 = wp.max(int(wp.min(y, y + ey) - wide), window[2])
        y1 = wp.min(int(wp.max(y, y + ey) + wide) + 2, window[3])
        for py in range(y0 + part, y1, slices):
            x0 = wp.min(x, x + ex) - wide
            x1 = wp.max(x, x + ex) + wide
            if wp.abs(ey) > 4.0:
                s = wp.clamp((float(py) - wide - y) / ey, 0.0, 1.0)
                t = wp.clamp((float(py) + wide - y) / ey, 0.0, 1.0)
                x0 = x + wp.min(ex * s, ex * t) - wide
                x1 = x + wp.max(ex * s, ex * t) + wide
            for px in range(wp.max(int(x0), window[0]), wp.min(int(x1) + 2, window[1])):
                fx = float(px) - x
                fy = float(py) - y
                s = wp.clamp((fx * ex + fy * ey) * per, 0.0, 1.0)
                fx -= s * ex
                fy -= s * ey
                rr = wp.max((r + (rb - r) * s) / m.texel, 0.55)
                h = rr * rr - fx * fx - fy * fy
                if h > 0.0:
                    write_depth(m, px, py, z + ez * s - wp.sqrt(h) * m.texel, depth_out)


@wp.struct
class LeafShadow:
    """An octagon [texel] around a leaf's shadow: bounds of x, y, x + y and x - y in the shadow map."""

    xy: wp.vec4
    sums: wp.vec4
    """Lowest and highest x + y, lowest and highest x - y [texel]."""


@wp.func
def leaf_shadow(m: ShadowMap, shapes: Shapes, i: int, x: float, y: float, per_leaf: float) -> LeafShadow:
    """Returns the octagon around the shadow of leaf ``i``; the end of the leaf's petiole is at texel (x, y).

    ``per_leaf`` is the width of a texel in leaf units (1: length of the midrib).
    """
    number = int(shapes.b[i][3])
    bend = shapes.d[i]
    rib = xyz(shapes.b[i])
    up = xyz(shapes.c[i])
    across = wp.cross(rib, up)
    bulge = leaf_bulge(shapes.hull, number, bend)
    lx = float(1.0e9)
    hx = float(-1.0e9)
    ly = float(1.0e9)
    hy = float(-1.0e9)
    ls = float(1.0e9)
    hs = float(-1.0e9)
    ld = float(1.0e9)
    hd = float(-1.0e9)
    for n in range(8):
        corner = shapes.hull[number, n]
        flat = across * corner[0] + rib * corner[1]
        height = leaf_height(bend, corner[0], corner[1]) - bulge[1]
        for level in range(2):
            q = (flat + up * (height + float(level) * (bulge[0] + bulge[1]))) / per_leaf
            qx = x + wp.dot(m.right, q)
            qy = y + wp.dot(m.up, q)
            lx = wp.min(lx, qx)
            hx = wp.max(hx, qx)
            ly = wp.min(ly, qy)
            hy = wp.max(hy, qy)
            ls = wp.min(ls, qx + qy)
            hs = wp.max(hs, qx + qy)
            ld = wp.min(ld, qx - qy)
            hd = wp.max(hd, qx - qy)
    o = LeafShadow()
    o.xy = wp.vec4(lx, hx, ly, hy)
    o.sums = wp.vec4(ls, hs, ld, hd)
    return o


@wp.func
def shadow_leaf(
    m: ShadowMap,
    shapes: Shapes,
    i: int,
    x: float,
    y: float,
    z: float,
    part: int,
    slices: int,
    window: wp.vec4i,
    depth_out: wp.array(dtype=wp.float32),
):
    """Draw leaf ``i`` into the shadow map, unless the leaf is edge-on to the sun.

    The end of its petiole is at texel (x, y) and depth ``z`` [m]. Only every ``slices``-th row is drawn, from row
    ``part`` on, and only inside ``window`` (first and last + 1 column, first and last + 1 row).
    """
    texels = IntBatch()
    depths = FloatBatch()
    r = shapes.a[i][3]
    b4 = shapes.b[i]
    c4 = shapes.c[i]
    rib = xyz(b4)
    up = xyz(c4)
    across = wp.cross(rib, up)
    slant = wp.dot(m.sun, up)
    if wp.abs(slant) > 0.1:
        # sun rays are parallel: leaf coordinates are affine in the texel, plus one correction for the leaf's curvature
        bend = shapes.d[i]
        number = int(b4[3])
        per_leaf = m.texel / r
        tu = wp.dot(m.sun, across) / slant
        tv = wp.dot(m.sun, rib) / slant
        rn = wp.dot(m.right, up)
        un = wp.dot(m.up, up)
        ux = (wp.dot(m.right, across) - rn * tu) * per_leaf
        uy = (wp.dot(m.up, across) - un * tu) * per_leaf
        vx = (wp.dot(m.right, rib) - rn * tv) * per_leaf
        vy = (wp.dot(m.up, rib) - un * tv) * per_leaf
        o = leaf_shadow(m, shapes, i, x, y, per_leaf)
        su = wp.dot(m.sun, across)
        sv = wp.dot(m.sun, rib)
        for py in range(wp.max(int(o.xy[2]), window[2]) + part, wp.min(int(o.xy[3]) + 2, window[3]), slices):
            row = float(py)
            first_x = wp.max(int(wp.max(wp.max(o.xy[0], wp.max(o.sums[0] - row, o.sums[2] + row)), 0.0)), window[0])
            last_x = int(wp.max(wp.min(o.xy[1], wp.min(o.sums[1] - row, o.sums[3] + row)) + 2.0, 0.0))
            last_x = wp.min(last_x, window[1])
            for start in range(first_x, last_x, BATCH):
                run = wp.min(last_x - start, BATCH)
                whole = (run + 7) // 8 * 8
                lot = wp.int32(0)
                while lot < whole:  # no branch, so that LLVM takes eight texels at once
                    fx = float(start + lot) - x
                    u0 = ux * fx + uy * (row - y)
                    v0 = vx * fx + vy * (row - y)
                    w = leaf_height(bend, u0, v0)
                    u = u0 + tu * w
                    v = v0 + tv * w
                    over = u > -0.99 and u < 0.99 and v > -0.74 and v < 1.24
                    over = over and u0 > -1.2 and u0 < 1.2 and v0 > -1.0 and v0 < 1.5
                    texel = int((v + 0.75) * 128.0) * 256 + int((u + 1.0) * 128.0)
                    texels[lot] = wp.where(over, texel, 0)  # texel 0, a corner, is outside of every leaf
                    depths[lot] = z - (su * u + sv * v + slant * leaf_height(bend, u, v)) * r
                    lot += 1
                for lot in range(run):
                    texel = texels[lot]
                    inside = int(shapes.outline[number, texel >> 8, texel & 255]) > 0
                    write_depth(m, start + lot, py, wp.where(inside, depths[lot], FAR), depth_out)


@wp.func
def shadow_solid(
    m: ShadowMap,
    shapes: Shapes,
    i: int,
    part: int,
    slices: int,
    window: wp.vec4i,
    depth_out: wp.array(dtype=wp.float32),
):
    """Draw box, ellipsoid or triangle ``i`` into the shadow map, by one ray from the sun for each texel of a sphere
    that bounds it.

    Only every ``slices``-th row is drawn, from row ``part`` on, and only inside ``window`` (first and last + 1 column,
    first and last + 1 row).
    """
    kind = shapes.kind[i]
    a4 = shapes.a[i]
    b4 = shapes.b[i]
    c4 = shapes.c[i]
    r = a4[3]
    o = xyz(a4)
    reach_i = r
    half = wp.vec3(r, c4[0], c4[1])
    ray = wp.quat_rotate_inv(as_quat(b4), -m.sun)
    if kind == TRIANGLE:
        o = (xyz(a4) + xyz(b4) + xyz(c4)) / 3.0
        reach_i = wp.max(wp.max(wp.length(xyz(a4) - o), wp.length(xyz(b4) - o)), wp.length(xyz(c4) - o))
    else:
        reach_i = wp.length(half)
    p = o - m.corner
    x = wp.dot(p, m.right) / m.texel
    y = wp.dot(p, m.up) / m.texel
    rt = reach_i / m.texel
    for py in range(wp.max(int(y - rt), window[2]) + part, wp.min(int(y + rt) + 2, window[3]), slices):
        for px in range(wp.max(int(x - rt), window[0]), wp.min(int(x + rt) + 2, window[1])):
            from_sun = m.corner + m.right * (float(px) * m.texel) + m.up * (float(py) * m.texel) + m.sun * SUN_DISTANCE
            t = FAR
            if kind == TRIANGLE:
                t = hit_triangle(xyz(a4) - from_sun, xyz(b4) - from_sun, xyz(c4) - from_sun, -m.sun)
            else:
                eye = wp.quat_rotate_inv(as_quat(b4), from_sun - xyz(a4))
                if kind == BOX:
                    t = hit_box(eye, ray, half)
                else:
                    t = hit_sphere(-wp.cw_div(eye, half), 1.0, wp.cw_div(ray, half))
            if t < FAR:
                write_depth(m, px, py, t, depth_out)


@wp.kernel
def raster_shadow_map(
    # model
    shapes: Shapes,
    clusters: Clusters,
    ball: wp.array(dtype=wp.vec4),
    # in
    which: wp.array(dtype=wp.int32),
    m: ShadowMap,
    smallest: float,
    window: wp.vec4i,
    lanes: int,
    slices: int,
    # out
    depth_out: wp.array(dtype=wp.float32),
):
    """One thread draws every ``slices``-th row of every ``lanes``-th primitive of one cluster of primitives into a
    shadow map.

    ball: [cluster] centre and radius [m]; which: clusters to draw; smallest: least radius [texel] of canes that are
    drawn; window: first and last + 1 column, first and last + 1 row to draw; depth: [side * side] least distance [m]
    along the sunlight from a plane SUN_DISTANCE above the map's corner.
    """
    k, lane, part = wp.tid()
    cluster = which[k]
    kind = clusters.kind[cluster]
    bound = ball[cluster]
    e = xyz(bound) - m.corner
    reach = bound[3] / m.texel + SHADOW_MARGIN
    bx = wp.dot(e, m.right) / m.texel
    by = wp.dot(e, m.up) / m.texel
    left = float(window[0])
    right = float(window[1])
    low = float(window[2])
    high = float(window[3])
    if bound[3] > 0.0 and bx > left - reach and by > low - reach and bx < right + reach and by < high + reach:
        first = clusters.first[cluster]
        for i in range(first + lane, first + clusters.size[cluster], lanes):
            a4 = shapes.a[i]
            p = xyz(a4) - m.corner
            x = wp.dot(p, m.right) / m.texel
            y = wp.dot(p, m.up) / m.texel
            z = SUN_DISTANCE - wp.dot(p, m.sun)
            blade = 1.8 * a4[3] / m.texel + 2.0  # largest reach of a leaf from its petiole [texel]
            beside = x < left - blade or y < low - blade or x > right + blade or y > high + blade
            if kind == LEAF and beside:
                continue
            if kind == SPHEROID:
                shadow_spheroid(m, a4[3], x, y, z, part, slices, window, depth_out)
            elif kind == CONE or kind == CYLINDER:
                shadow_cone(m, shapes, i, smallest, x, y, z, part, slices, window, depth_out)
            elif kind == LEAF:
                shadow_leaf(m, shapes, i, x, y, z, part, slices, window, depth_out)
            else:
                shadow_solid(m, shapes, i, part, slices, window, depth_out)


@wp.func
def sun_visibility(
    m: ShadowMap, p: wp.vec3, n: wp.vec3, turn: wp.vec2, spiral: wp.array(dtype=wp.vec2), taps: int
) -> float:
    """Returns the visible share of the sun's disc at ``p`` [m] with normal ``n``, or -1 outside the shadow map.

    The shadow's edge is the softer, the farther away the object that casts the shadow. ``spiral``: [taps] offsets of
    samples in the unit disc, turned by ``turn`` (cosine, sine); ``taps``: see ``Light.shadow_taps``.
    """
    facing = wp.abs(wp.dot(n, m.sun))
    e = p + n * (m.texel * (1.0 + 1.6 * (1.0 - facing))) - m.corner
    x = wp.dot(e, m.right) / m.texel + 0.5
    y = wp.dot(e, m.up) / m.texel + 0.5
    lit = float(-1.0)
    if x > 8.0 and y > 8.0 and x < float(m.side) - 9.0 and y < float(m.side) - 9.0:
        z = (
            SUN_DISTANCE
            - wp.dot(e, m.sun)
            - m.texel * (0.4 + 0.7 * wp.sqrt(1.0 - facing * facing) / wp.max(facing, 0.12))
        )
        gap = z - m.depth[int(y) * m.side + int(x)]
        spread = float(1.6)
        if gap > 0.0:
            spread = wp.clamp(SUN_RADIUS * gap / m.texel, 1.0, 6.0)
        z -= spread * m.texel * 0.3
        if taps <= 0:  # a box of two texels, or of four if the shadow comes from far away; smooth without noise
            i = int(x)
            j = int(y)
            a = x - float(i)
            b = y - float(j)
            half = wp.int32(1)
            if taps == 0:
                for k in range(4):
                    at = (j + (k & 1) * 4 - 2) * m.side + i + (k & 2) * 2 - 2
                    gap = wp.max(gap, z - m.depth[at])
                if SUN_RADIUS * gap > 1.5 * m.texel:
                    half = 2
            lit = float(0.0)
            for row in range(-half, half + 1):
                at = (j + row) * m.side + i
                line = float(0.0)
                if m.depth[at - half] > z:
                    line += 1.0 - a
                if m.depth[at + half] > z:
                    line += a
                for column in range(1 - half, half):
                    if m.depth[at + column] > z:
                        line += 1.0
                lit += line * wp.where(row == -half, 1.0 - b, wp.where(row == half, b, 1.0))
            lit = lit * 0.25 / float(half * half)
        else:
            lit = wp.where(gap > 0.0, 0.0, 1.0)
            for k in range(taps):
                v = spiral[k] * spread
                row = int(y + v[0] * turn[1] + v[1] * turn[0])
                if m.depth[row * m.side + int(x + v[0] * turn[0] - v[1] * turn[1])] > z:
                    lit += 1.0
            lit = lit / (float(taps) + 1.0)
    return lit
