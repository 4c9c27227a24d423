"""The rasteriser for GPUs: primitives are cut into tiles of a few pixels, and a few threads draw each tile.

One leaf may fill the picture while a thousand berries cover one pixel each. With one thread for each primitive the
whole GPU would wait for that leaf. So a first kernel, :func:`list_tiles`, only bounds the region of each primitive in
the picture, and appends the tiles that cover the region to a list in GPU memory. A *tile* is a rectangle of at most
TILE_SIZE x TILE_SIZE pixels in which one primitive is to be drawn. A second kernel, :func:`draw_tiles`, draws the
tiles, which all take about the same work. Intersections are computed as in the ray caster. The host never reads the
lengths of the lists: a frame is two launches.
"""

import warp as wp

from vinesim.kernels.raster.pinhole import (
    NEAR_DEPTH,
    SMOOTH_SIZE,
    UNBOUND,
    Pinhole,
    clip_to_image,
    depth_test,
    pixel_ray,
    sphere_bounds,
)
from vinesim.kernels.raster.primitives import (
    BOX,
    CONE,
    CYLINDER,
    ELLIPSOID,
    FAR,
    LEAF,
    SPHEROID,
    TRIANGLE,
    Clusters,
    Shapes,
    as_quat,
    hit_primitive,
    leaf_heights,
    xyz,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})

TILE_SIZE = wp.constant(16)
"""Width and height of a tile [px].

Tiles of primitives larger than LARGE_PRIMITIVE are twice as wide and high, because one thread lists all tiles of a
primitive.
"""
LARGE_PRIMITIVE = wp.constant(256)
TILE_LISTS = wp.constant(64)
"""Number of lists of tiles that :func:`list_tiles` writes. Several lists reduce contention, because threads append to
a list one at a time."""
EMPTY_BOUNDS = wp.constant(wp.vec4(1.0e6, -1.0e6, 1.0e6, -1.0e6))
"""Bounds [px] of no pixels, from which bounds of a primitive are extended: lowest and highest x, lowest and highest y.
"""
UNBOUNDED_STRIP = wp.constant(wp.vec3(0.0, -1.0e6, 1.0e6))
"""A strip low <= x - slope y <= high [px] that contains every pixel: slope, low, high."""


@wp.struct
class Outline:
    """Region of the picture that contains a primitive: the intersection of a box and two slanted strips
    ``low <= x - slope y <= high`` [px]."""

    box: wp.vec4i
    """First and last + 1 column, first and last + 1 row."""
    rising: wp.vec3
    """Slope, low, high [px] of a strip; ``falling`` is the other strip."""
    falling: wp.vec3
    depth: float
    """Lower bound of the depth of the primitive's points [m]."""


@wp.func
def extend_bounds(lens: Pinhole, bound: wp.vec4, p: wp.vec3) -> wp.vec4:
    """Returns ``bound`` (lowest and highest x, lowest and highest y [px]), extended to the image of point ``p`` [m].

    ``p`` is in the optical frame, in front of the camera.
    """
    x = p[0] / p[2] * lens.fx + lens.cx
    y = p[1] / p[2] * lens.fy + lens.cy
    return wp.vec4(wp.min(bound[0], x), wp.max(bound[1], x), wp.min(bound[2], y), wp.max(bound[3], y))


@wp.func
def make_outline(lens: Pinhole, bound: wp.vec4, depth: float, rising: wp.vec3, falling: wp.vec3) -> Outline:
    o = Outline()
    o.box = clip_to_image(lens, bound)
    o.rising = rising
    o.falling = falling
    o.depth = wp.clamp(depth, 0.0, lens.max_depth)
    return o


@wp.func
def leaf_outline(s: Shapes, i: int, lens: Pinhole) -> Outline:
    a4 = s.a[i]
    b4 = s.b[i]
    size = a4[3]
    p = lens.rotation * (xyz(a4) - lens.eye)
    rib = lens.rotation * xyz(b4)
    up = lens.rotation * xyz(s.c[i])
    side = wp.cross(rib, up)
    heights = leaf_heights(s.d[i])
    depth = float(FAR)
    bound = EMPTY_BOUNDS
    turned = bound  # bounds of x - y and x + y
    for n in range(16):
        corner = s.hull[int(b4[3]), n >> 1]
        q = p + (side * corner[0] + rib * corner[1] + up * heights[n & 1]) * size
        depth = wp.min(depth, q[2])
        x = q[0] / wp.max(q[2], 0.01) * lens.fx + lens.cx
        y = q[1] / wp.max(q[2], 0.01) * lens.fy + lens.cy
        bound = wp.vec4(wp.min(bound[0], x), wp.max(bound[1], x), wp.min(bound[2], y), wp.max(bound[3], y))
        turned = wp.vec4(
            wp.min(turned[0], x - y), wp.max(turned[1], x - y), wp.min(turned[2], x + y), wp.max(turned[3], x + y)
        )
    if depth < NEAR_DEPTH:
        turned = wp.vec4(-UNBOUND, UNBOUND, -UNBOUND, UNBOUND)
        bound = sphere_bounds(lens, p + rib * (0.25 * size), 1.45 * size)
        if p[2] < -1.6 * size:
            bound = EMPTY_BOUNDS
    return make_outline(lens, bound, depth, wp.vec3(1.0, turned[0], turned[1]), wp.vec3(-1.0, turned[2], turned[3]))


@wp.func
def cone_outline(s: Shapes, i: int, lens: Pinhole) -> Outline:
    a4 = s.a[i]
    b4 = s.b[i]
    a = lens.rotation * (xyz(a4) - lens.eye)
    b = lens.rotation * (xyz(b4) - lens.eye)
    r = wp.max(a4[3], b4[3])
    bound = EMPTY_BOUNDS
    strip = UNBOUNDED_STRIP
    if wp.max(a[2], b[2]) > -r:
        # The part of the view nearer than NEAR_DEPTH is inside a small ball around the camera. If the cone stays
        # clear of that ball, its axis may be cut at NEAR_DEPTH: a wire that passes the camera keeps a narrow bound.
        axis = b - a
        cut = NEAR_DEPTH - r
        start = a
        end = b
        clear = True
        if wp.min(a[2], b[2]) < cut:
            h = wp.clamp(-wp.dot(a, axis) / wp.dot(axis, axis), 0.0, 1.0)
            clear = wp.length(a + axis * h) - r > lens.near_radius
            if a[2] < cut and b[2] > cut:
                start = a + axis * ((cut - a[2]) / axis[2])
            if b[2] < cut and a[2] > cut:
                end = a + axis * ((cut - a[2]) / axis[2])
        f = sphere_bounds(lens, start, r)
        g = sphere_bounds(lens, end, r)
        bound = wp.vec4(-UNBOUND, UNBOUND, -UNBOUND, UNBOUND)
        if clear:
            bound = wp.vec4(wp.min(f[0], g[0]), wp.max(f[1], g[1]), wp.min(f[2], g[2]), wp.max(f[3], g[3]))
            rise = 0.5 * (g[2] + g[3] - f[2] - f[3])
            if wp.min(start[2], end[2]) - r > 0.01 and wp.abs(rise) > 2.0:  # a slanted cone covers only a strip
                slope = 0.5 * (g[0] + g[1] - f[0] - f[1]) / rise
                middle = 0.5 * (f[0] + f[1] - slope * (f[2] + f[3]))
                half = 0.5 * (wp.max(f[1] - f[0], g[1] - g[0]) + wp.abs(slope) * wp.max(f[3] - f[2], g[3] - g[2]))
                strip = wp.vec3(slope, middle - half, middle + half)
    return make_outline(lens, bound, wp.min(a[2], b[2]) - r, strip, UNBOUNDED_STRIP)


@wp.func
def triangle_outline(s: Shapes, i: int, lens: Pinhole) -> Outline:
    a = lens.rotation * (xyz(s.a[i]) - lens.eye)
    b = lens.rotation * (xyz(s.b[i]) - lens.eye)
    c = lens.rotation * (xyz(s.c[i]) - lens.eye)
    depth = wp.min(wp.min(a[2], b[2]), c[2])
    bound = EMPTY_BOUNDS
    if wp.dot(a, wp.cross(b - a, c - a)) < 0.0 and wp.max(wp.max(a[2], b[2]), c[2]) > 0.0:
        if depth > NEAR_DEPTH:
            bound = extend_bounds(lens, extend_bounds(lens, extend_bounds(lens, bound, a), b), c)
        else:
            middle = (a + b + c) / 3.0
            away = wp.max(wp.max(wp.length(a - middle), wp.length(b - middle)), wp.length(c - middle))
            bound = sphere_bounds(lens, middle, away * 1.001)
    return make_outline(lens, bound, depth, UNBOUNDED_STRIP, UNBOUNDED_STRIP)


@wp.func
def solid_outline(s: Shapes, i: int, kind: int, lens: Pinhole) -> Outline:
    a4 = s.a[i]
    b4 = s.b[i]
    c4 = s.c[i]
    centre = lens.rotation * (xyz(a4) - lens.eye)
    half = wp.vec3(a4[3], c4[0], c4[1])
    reach = wp.length(half)
    if kind == SPHEROID:
        reach = a4[3] * wp.max(b4[3], 1.0)
    elif kind == ELLIPSOID:
        reach = wp.max(wp.max(half[0], half[1]), half[2])
    elif kind == CYLINDER:
        end = lens.rotation * (xyz(b4) - lens.eye)
        reach = wp.length(wp.vec2(wp.length(end - centre) * 0.5, a4[3]))
        centre = (centre + end) * 0.5
    depth = centre[2] - reach
    bound = EMPTY_BOUNDS
    if centre[2] > -reach:
        if kind == BOX and depth > NEAR_DEPTH:
            for n in range(8):
                corner = wp.vec3(float(n & 1) * 2.0 - 1.0, float(n & 2) - 1.0, float(n & 4) * 0.5 - 1.0)
                away = wp.quat_rotate(as_quat(b4), wp.cw_mul(half, corner))
                bound = extend_bounds(lens, bound, centre + lens.rotation * away)
        else:
            bound = sphere_bounds(lens, centre, reach)
    return make_outline(lens, bound, depth, UNBOUNDED_STRIP, UNBOUNDED_STRIP)


@wp.func
def outline_of(s: Shapes, i: int, lens: Pinhole) -> Outline:
    """Returns the picture's region that contains primitive ``i``; its box is empty if the primitive is out of view."""
    kind = s.kind[i]
    o = Outline()
    if kind == LEAF:
        o = leaf_outline(s, i, lens)
    elif kind == CONE:
        o = cone_outline(s, i, lens)
    elif kind == TRIANGLE:
        o = triangle_outline(s, i, lens)
    else:
        o = solid_outline(s, i, kind, lens)
    return o


@wp.func
def column_span(o: Outline, top: int, bottom: int) -> wp.vec2i:
    """Returns the first and last + 1 column of an outline within the rows from ``top`` to ``bottom`` - 1."""
    first = float(o.box[0])
    last = float(o.box[1])
    y = float(top)
    z = float(bottom - 1)
    first = wp.max(first, o.rising[1] + wp.min(o.rising[0] * y, o.rising[0] * z) - 0.02)
    first = wp.max(first, o.falling[1] + wp.min(o.falling[0] * y, o.falling[0] * z) - 0.02)
    last = wp.min(last, o.rising[2] + wp.max(o.rising[0] * y, o.rising[0] * z) + 1.02)
    last = wp.min(last, o.falling[2] + wp.max(o.falling[0] * y, o.falling[0] * z) + 1.02)
    return wp.vec2i(int(first), int(wp.max(last, 0.0)))


@wp.func
def draw_tile(s: Shapes, lens: Pinhole, piece: wp.vec4i, lane: int, lanes: int, keys_out: wp.array(dtype=wp.int64)):
    """Draw every ``lanes``-th pixel of a tile (a rectangle of pixels that covers a part of one primitive), from pixel
    ``lane`` on.

    ``piece``: the tile as four integers: index of the primitive, upper left pixel (x + 65536 y), size (width + 65536
    height), least depth of the primitive [um]. keys_out: [pixel] depth [um] in the upper 32 bits and index of the
    nearest primitive in the lower bits.
    """
    i = piece[0]
    left = piece[1] & 0xFFFF
    top = piece[1] >> 16
    wide = piece[2] & 0xFFFF
    nearest = wp.int64(piece[3]) << wp.int64(32)
    back = wp.transpose(lens.rotation)
    smooth = wp.int32(0)
    if s.kind[i] == LEAF:
        a4 = s.a[i]
        if a4[3] * lens.fx > wp.dot(lens.rotation[2], xyz(a4) - lens.eye) * SMOOTH_SIZE:
            smooth = 1
    for n in range(lane, wide * (piece[2] >> 16), lanes):
        x = left + n % wide
        y = top + n // wide
        pixel = y * lens.width + x
        if keys_out[pixel] > nearest:
            depth_test(
                pixel, hit_primitive(s, i, lens.eye, back * pixel_ray(lens, x, y), smooth), i, lens.max_depth, keys_out
            )


@wp.kernel
def list_tiles(
    # model
    shapes: Shapes,
    clusters: Clusters,
    # in
    ball: wp.array(dtype=wp.vec4),
    which: wp.array(dtype=wp.int32),
    lens: Pinhole,
    lanes: int,
    # out
    count_out: wp.array(dtype=wp.int32),
    pieces_out: wp.array2d(dtype=wp.vec4i),
    keys_out: wp.array(dtype=wp.int64),
):
    """One thread appends the tiles of every ``lanes``-th primitive of one cluster to a list, for :func:`draw_tiles`.

    A tile is a rectangle of pixels that covers a part of one primitive. A cluster is a run of primitives with a common
    bounding ball. There are :data:`TILE_LISTS` lists of tiles. If the thread's list is full, the thread draws the tile
    itself.

    ball: [cluster] centre and radius [m] of the bounding ball; which: [k] clusters to draw; count_out: [list] number
    of tiles in each list; pieces_out: [list, slot] tiles in the format of :func:`draw_tile`; keys_out: [pixel] depth
    and index of the nearest primitive, written only for tiles that the thread draws.
    """
    k, lane = wp.tid()
    cluster = which[k]
    r = ball[cluster][3]
    p = lens.rotation * (xyz(ball[cluster]) - lens.eye)
    seen = clip_to_image(lens, sphere_bounds(lens, p, r))
    if r > 0.0 and p[2] > -r and p[2] - r < lens.max_depth and seen[0] < seen[1] and seen[2] < seen[3]:
        mine = k % TILE_LISTS
        first = clusters.first[cluster]
        for i in range(first + lane, first + clusters.size[cluster], lanes):
            o = outline_of(shapes, i, lens)
            side = wp.where(
                wp.max(o.box[1] - o.box[0], o.box[3] - o.box[2]) > LARGE_PRIMITIVE, 2 * TILE_SIZE, TILE_SIZE
            )
            needed = wp.int32(0)
            for top in range(o.box[2], o.box[3], side):
                span = column_span(o, top, wp.min(top + side, o.box[3]))
                needed += wp.max(span[1] - span[0] + side - 1, 0) // side
            if needed > 0:
                slot = wp.atomic_add(count_out, mine, needed)
                for top in range(o.box[2], o.box[3], side):
                    bottom = wp.min(top + side, o.box[3])
                    span = column_span(o, top, bottom)
                    for left in range(span[0], span[1], side):
                        piece = wp.vec4i(
                            i,
                            left | (top << 16),
                            wp.min(side, span[1] - left) | ((bottom - top) << 16),
                            int(o.depth * 1.0e6),
                        )
                        if slot < pieces_out.shape[1]:
                            pieces_out[mine, slot] = piece
                        else:
                            draw_tile(shapes, lens, piece, 0, 1, keys_out)
                        slot += 1


@wp.kernel
def draw_tiles(
    # model
    shapes: Shapes,
    # in
    count: wp.array(dtype=wp.int32),
    pieces: wp.array2d(dtype=wp.vec4i),
    lens: Pinhole,
    groups: int,
    lanes: int,
    # out
    keys_out: wp.array(dtype=wp.int64),
):
    """One thread draws every ``lanes``-th pixel of every ``groups``-th tile in one of the lists that
    :func:`list_tiles` wrote. A tile is a rectangle of pixels that covers a part of one primitive.

    count: [list] number of tiles in each list; pieces: [list, slot] tiles in the format of :func:`draw_tile`;
    keys_out: [pixel] depth [um] in the upper 32 bits and index of the nearest primitive in the lower bits.
    """
    group = wp.tid() // lanes
    lane = wp.tid() % lanes
    mine = group % TILE_LISTS
    for slot in range(group // TILE_LISTS, wp.min(count[mine], pieces.shape[1]), groups):
        draw_tile(shapes, lens, pieces[mine, slot], lane, lanes, keys_out)
