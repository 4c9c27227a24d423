"""Rasteriser of a pinhole camera on a CPU: berries, canes and leaves.

Pixels of a row are tested in runs. Loops over a run have no branches, so that LLVM takes eight pixels at a time.
"""

import warp as wp

from vinesim.kernels.raster.pinhole import (
    BATCH,
    NEAR_DEPTH,
    SMOOTH_SIZE,
    UNBOUND,
    FloatBatch,
    IntBatch,
    Pinhole,
    clip_to_image,
    depth_key,
    depth_test,
    pixel_ray,
    sphere_bounds,
)
from vinesim.kernels.raster.primitives import (
    FAR,
    Clusters,
    Shapes,
    hit_cone,
    hit_leaf,
    hit_leaf_rectangle,
    hit_sphere,
    inside_outline,
    leaf_bulge,
    leaf_extent,
    leaf_height,
    scale_along,
    xyz,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.kernel
def raster_spheroids(
    # model
    shapes: Shapes,
    clusters: Clusters,
    # in
    visible: wp.array(dtype=wp.int32),
    lens: Pinhole,
    lanes: int,
    # out
    keys_out: wp.array(dtype=wp.int64),
):
    """One thread draws every ``lanes``-th spheroid (berry) of one visible cluster of spheroids.

    visible: clusters in view; lanes: number of threads that share one cluster; keys: [pixel] nearest hit, see
    :mod:`vinesim.kernels.raster.pinhole`.
    """
    k, lane = wp.tid()
    cluster = visible[k]
    first = clusters.first[cluster]
    xs = IntBatch()
    ys = IntBatch()
    depths = FloatBatch()
    for i in range(first + lane, first + clusters.size[cluster], lanes):
        a4 = shapes.a[i]
        b4 = shapes.b[i]
        p = lens.rotation * (xyz(a4) - lens.eye)
        r = a4[3] * wp.max(b4[3], 1.0)
        if p[2] > -r:
            box = clip_to_image(lens, sphere_bounds(lens, p, r))
            if box[0] < box[1] and box[2] < box[3]:
                axis = lens.rotation * xyz(b4)
                stretch = 1.0 / b4[3] - 1.0
                centre = scale_along(p, axis, stretch)
                nearest = wp.int64(int(wp.max(p[2] - r, 0.0) * 1.0e6)) << wp.int64(32)
                x = box[0]
                y = box[2]
                while y < box[3]:
                    n = wp.int32(0)
                    while n < BATCH and y < box[3]:
                        if keys_out[y * lens.width + x] > nearest:
                            xs[n] = x
                            ys[n] = y
                            n += 1
                        x += 1
                        if x == box[1]:
                            x = box[0]
                            y += 1
                    whole = (n + 7) // 8 * 8
                    m = wp.int32(0)
                    while m < whole:
                        depths[m] = hit_sphere(centre, a4[3], scale_along(pixel_ray(lens, xs[m], ys[m]), axis, stretch))
                        m += 1
                    for m in range(n):
                        depth_test(ys[m] * lens.width + xs[m], depths[m], i, lens.max_depth, keys_out)


@wp.struct
class ConeBounds:
    """Region of the picture that contains a cone: a box and, if ``banded``, a slanted band within the box."""

    box: wp.vec4i
    """Box in pixels: first and last + 1 column, first and last + 1 row."""
    banded: int
    x: float
    y: float
    """Point (``x``, ``y``) [px] on the band's middle line."""
    slope: float
    """Slope of the band [columns per row]."""
    half_width: float
    """Half of the band's width along a row [px]."""


@wp.func
def cone_bounds(lens: Pinhole, a: wp.vec3, ra: float, b: wp.vec3, rb: float) -> ConeBounds:
    """Returns the picture's region that contains a cone with rounded ends: the convex hull of two spheres.

    ``a``, ``b``: centres in the optical frame [m]; ``ra``, ``rb``: radii [m].
    """
    o = ConeBounds()
    r = wp.max(ra, rb)
    # The part of the view nearer than NEAR_DEPTH is inside a small ball around the camera. If the cone stays
    # clear of that ball, its axis may be cut at NEAR_DEPTH: a wire that passes the camera keeps a narrow bound.
    ca = a
    cb = b
    ba = b - a
    cut = NEAR_DEPTH - r
    clear = True
    if wp.min(a[2], b[2]) < cut:
        h = wp.clamp(-wp.dot(a, ba) / wp.dot(ba, ba), 0.0, 1.0)
        clear = wp.length(a + ba * h) - r > lens.near_radius
        if a[2] < cut and b[2] > cut:
            ca = a + ba * ((cut - a[2]) / ba[2])
        if b[2] < cut and a[2] > cut:
            cb = a + ba * ((cut - a[2]) / ba[2])
    bound = wp.vec4(-UNBOUND, UNBOUND, -UNBOUND, UNBOUND)
    fa = sphere_bounds(lens, ca, wp.where(a[2] < cut, r, ra))
    fb = sphere_bounds(lens, cb, wp.where(b[2] < cut, r, rb))
    if clear:
        bound = wp.vec4(wp.min(fa[0], fb[0]), wp.max(fa[1], fb[1]), wp.min(fa[2], fb[2]), wp.max(fa[3], fb[3]))
    o.box = clip_to_image(lens, bound)
    # In one row a slanted cone covers only a band around the line between the pictures of its ends, as wide as
    # these ellipses reach across it: support^2 = (n_x h_x)^2 + (n_y h_y)^2 + 2 n_x n_y h_x h_y correlation.
    ya = 0.5 * (fa[2] + fa[3])
    yb = 0.5 * (fb[2] + fb[3])
    xa = 0.5 * (fa[0] + fa[1])
    xb = 0.5 * (fb[0] + fb[1])
    half_x = 0.5 * wp.max(fa[1] - fa[0], fb[1] - fb[0]) + 0.01
    half_y = 0.5 * wp.max(fa[3] - fa[2], fb[3] - fb[2]) + 0.01
    banded = clear and wp.min(ca[2], cb[2]) > 1.5 * r + 0.01 and wp.abs(yb - ya) > 2.0
    slope = (xb - xa) / wp.where(banded, yb - ya, 1.0)
    tilt = wp.max(
        wp.abs(ca[0] * ca[1]) / wp.max(ca[2] * ca[2] - r * r, 1.0e-6),
        wp.abs(cb[0] * cb[1]) / wp.max(cb[2] * cb[2] - r * r, 1.0e-6),
    )
    across = slope * half_y
    o.half_width = wp.sqrt(half_x * half_x + across * across + 2.0 * wp.abs(half_x * across) * wp.min(tilt, 1.0)) + 0.02
    o.banded = wp.where(banded, 1, 0)
    o.x = xa
    o.y = ya
    o.slope = slope
    return o


@wp.kernel
def raster_cones(
    # model
    shapes: Shapes,
    clusters: Clusters,
    # in
    visible: wp.array(dtype=wp.int32),
    lens: Pinhole,
    lanes: int,
    # out
    keys_out: wp.array(dtype=wp.int64),
):
    """One thread draws every ``lanes``-th cone of one visible cluster of cones.

    visible: clusters in view; lanes: number of threads that share one cluster; keys: [pixel] nearest hit, see
    :mod:`vinesim.kernels.raster.pinhole`.
    """
    k, lane = wp.tid()
    cluster = visible[k]
    first = clusters.first[cluster]
    xs = IntBatch()
    ys = IntBatch()
    depths = FloatBatch()
    for i in range(first + lane, first + clusters.size[cluster], lanes):
        a4 = shapes.a[i]
        b4 = shapes.b[i]
        a = lens.rotation * (xyz(a4) - lens.eye)
        b = lens.rotation * (xyz(b4) - lens.eye)
        r = wp.max(a4[3], b4[3])
        if wp.max(a[2], b[2]) > -r:
            o = cone_bounds(lens, a, a4[3], b, b4[3])
            box = o.box
            nearest = wp.int64(int(wp.max(wp.min(a[2], b[2]) - r, 0.0) * 1.0e6)) << wp.int64(32)
            x = wp.int32(0)
            y = box[2] - 1
            last = wp.int32(0)
            while y < box[3]:
                n = wp.int32(0)
                while n < BATCH and y < box[3]:
                    if x < last:
                        if keys_out[y * lens.width + x] > nearest:
                            xs[n] = x
                            ys[n] = y
                            n += 1
                        x += 1
                    else:
                        y += 1
                        x = box[0]
                        last = box[1]
                        if o.banded != 0:
                            centre = o.x + o.slope * (float(y) - o.y)
                            x = wp.max(x, int(wp.max(centre - o.half_width, 0.0)))
                            last = wp.min(last, int(wp.max(centre + o.half_width + 1.0, 0.0)))
                        last = wp.where(y < box[3], last, 0)
                whole = (n + 7) // 8 * 8
                m = wp.int32(0)
                while m < whole:
                    depths[m] = hit_cone(a, a4[3], b, b4[3], pixel_ray(lens, xs[m], ys[m]))
                    m += 1
                for m in range(n):
                    depth_test(ys[m] * lens.width + xs[m], depths[m], i, lens.max_depth, keys_out)


@wp.struct
class LeafBounds:
    """An octagon [px] around a leaf in the picture: bounds of x, y, x + y and x - y."""

    xy: wp.vec4
    sums: wp.vec4
    """Lowest and highest x + y, lowest and highest x - y [px]."""
    depth: float
    """Lower bound of the depth of the leaf's points [m]."""


@wp.func
def leaf_bounds(
    lens: Pinhole, shapes: Shapes, i: int, p: wp.vec3, side: wp.vec3, rib: wp.vec3, up: wp.vec3
) -> LeafBounds:
    """Returns the octagon around leaf ``i`` in the picture.

    ``p``: end of the petiole [m]; ``side``, ``rib``, ``up``: unit axes across the leaf, along its midrib and along its
    normal; all in the optical frame.
    """
    size = shapes.a[i][3]
    bend = shapes.d[i]
    number = int(shapes.b[i][3])
    x_low = float(UNBOUND)
    x_high = -float(UNBOUND)
    y_low = float(UNBOUND)
    y_high = -float(UNBOUND)
    sum_low = float(UNBOUND)
    sum_high = -float(UNBOUND)
    dif_low = float(UNBOUND)
    dif_high = -float(UNBOUND)
    z_low = float(FAR)
    bulge = leaf_bulge(shapes.hull, number, bend)
    for n in range(8):
        corner = shapes.hull[number, n]
        height = leaf_height(bend, corner[0], corner[1])
        flat = p + (side * corner[0] + rib * corner[1] + up * (height - bulge[1])) * size
        for m in range(2):
            q = flat + up * (float(m) * (bulge[0] + bulge[1]) * size)
            z_low = wp.min(z_low, q[2])
            k_z = 1.0 / wp.max(q[2], 0.01)
            qx = q[0] * k_z * lens.fx + lens.cx
            qy = q[1] * k_z * lens.fy + lens.cy
            x_low = wp.min(x_low, qx)
            x_high = wp.max(x_high, qx)
            y_low = wp.min(y_low, qy)
            y_high = wp.max(y_high, qy)
            sum_low = wp.min(sum_low, qx + qy)
            sum_high = wp.max(sum_high, qx + qy)
            dif_low = wp.min(dif_low, qx - qy)
            dif_high = wp.max(dif_high, qx - qy)
    o = LeafBounds()
    o.xy = wp.vec4(x_low, x_high, y_low, y_high)
    o.sums = wp.vec4(sum_low, sum_high, dif_low, dif_high)
    o.depth = z_low
    return o


@wp.struct
class LeafPixelFrame:
    """Rays of pixels (x, y) in a leaf's own frame and unit: they start at ``eye`` and have the direction
    dz + x dx + y dy."""

    eye: wp.vec3
    dx: wp.vec3
    dy: wp.vec3
    dz: wp.vec3


@wp.func
def leaf_pixel_frame(
    lens: Pinhole, p: wp.vec3, side: wp.vec3, rib: wp.vec3, up: wp.vec3, size: float
) -> LeafPixelFrame:
    """Returns the pixels' rays in the frame of a leaf of length ``size`` [m].

    ``p``: end of the petiole [m]; ``side``, ``rib``, ``up``: unit axes of the leaf; all in the optical frame.
    """
    inv = 1.0 / size
    o = LeafPixelFrame()
    o.eye = wp.vec3(-wp.dot(p, side), -wp.dot(p, rib), -wp.dot(p, up)) * inv
    o.dx = wp.vec3(side[0], rib[0], up[0]) * (inv / lens.fx)
    o.dy = wp.vec3(side[1], rib[1], up[1]) * (inv / lens.fy)
    o.dz = wp.vec3(side[2], rib[2], up[2]) * inv - o.dx * lens.cx - o.dy * lens.cy
    return o


@wp.kernel
def raster_leaves(
    # model
    shapes: Shapes,
    clusters: Clusters,
    # in
    visible: wp.array(dtype=wp.int32),
    lens: Pinhole,
    lanes: int,
    # out
    keys_out: wp.array(dtype=wp.int64),
):
    """One thread draws every ``lanes``-th leaf of one visible cluster of leaves.

    visible: clusters in view; lanes: number of threads that share one cluster; keys: [pixel] nearest hit, see
    :mod:`vinesim.kernels.raster.pinhole`.
    """
    k, lane = wp.tid()
    cluster = visible[k]
    first = clusters.first[cluster]
    xs = IntBatch()
    ys = IntBatch()
    depths = FloatBatch()
    for i in range(first + lane, first + clusters.size[cluster], lanes):
        a4 = shapes.a[i]
        size = a4[3]
        p = lens.rotation * (xyz(a4) - lens.eye)
        if p[2] > -1.6 * size:
            b4 = shapes.b[i]
            bend = shapes.d[i]
            number = int(b4[3])
            rib = lens.rotation * xyz(b4)
            up = lens.rotation * xyz(shapes.c[i])
            side = wp.cross(rib, up)
            o = leaf_bounds(lens, shapes, i, p, side, rib, up)
            bound = o.xy
            crossing = o.depth < NEAR_DEPTH
            if crossing:
                bound = sphere_bounds(lens, p + rib * (0.25 * size), 1.45 * size)
            box = clip_to_image(lens, bound)
            if box[0] < box[1] and box[2] < box[3]:
                f = leaf_pixel_frame(lens, p, side, rib, up, size)
                smooth = wp.where(size * lens.fx > p[2] * SMOOTH_SIZE, 1, 0)
                extent = leaf_extent(shapes.hull, number)
                nearest = wp.int64(int(wp.max(o.depth, 0.0) * 1.0e6)) << wp.int64(32)
                x = wp.int32(0)
                y = box[2] - 1
                last = wp.int32(0)
                while y < box[3]:
                    n = wp.int32(0)
                    while n < BATCH and y < box[3]:
                        if x < last:
                            if keys_out[y * lens.width + x] > nearest:
                                xs[n] = x
                                ys[n] = y
                                n += 1
                            x += 1
                        else:
                            y += 1
                            x = box[0]
                            last = box[1]
                            fy = float(y)
                            if not crossing:
                                x = wp.max(x, int(wp.max(wp.max(o.sums[0] - fy, o.sums[2] + fy) - 0.01, 0.0)))
                                last = wp.min(last, int(wp.max(wp.min(o.sums[1] - fy, o.sums[3] + fy) + 1.01, 0.0)))
                            last = wp.where(y < box[3], last, 0)
                    whole = (n + 7) // 8 * 8
                    m = wp.int32(0)
                    while m < whole:
                        depths[m] = hit_leaf_rectangle(
                            bend, extent, f.eye, f.dz + f.dx * float(xs[m]) + f.dy * float(ys[m])
                        )
                        m += 1
                    for k in range(n):
                        t = depths[k]
                        if t < lens.max_depth:
                            at = ys[k] * lens.width + xs[k]
                            ray = f.dz + f.dx * float(xs[k]) + f.dy * float(ys[k])
                            if t < 0.0:
                                t = hit_leaf(shapes.outline, number, bend, f.eye, ray, smooth)
                                depth_test(at, t, i, lens.max_depth, keys_out)
                            elif depth_key(t, i) < keys_out[at]:
                                u = f.eye[0] + t * ray[0]
                                v = f.eye[1] + t * ray[1]
                                if inside_outline(shapes.outline, number, u, v, smooth):
                                    depth_test(at, t, i, lens.max_depth, keys_out)
