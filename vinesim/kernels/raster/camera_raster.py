"""Which primitive each pixel of a pinhole camera sees: a rasteriser that intersects exactly.

Each primitive visits the pixels inside a conservative bound of its outline, intersects each pixel's ray in closed
form and keeps the nearest by ``atomic_min`` on a 64-bit key, depth [um] above, number of the primitive below.
Depth runs along the optical axis. There is no near plane: whatever lies in front of the pinhole is seen.
"""

import warp as wp

from vinesim.kernels.raster.primitives import (
    BOX,
    CYLINDER,
    ELLIPSOID,
    FAR,
    Clusters,
    Shapes,
    as_quat,
    hit_box,
    hit_cone,
    hit_cylinder,
    hit_leaf,
    hit_leaf_rectangle,
    hit_sphere,
    hit_triangle,
    inside_outline,
    leaf_bulge,
    leaf_extent,
    leaf_height,
    scale_along,
    xyz,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})

EMPTY_KEY = wp.constant(wp.int64(1 << 62))
"""Key of a pixel that sees no primitive."""
PRIMITIVE_MASK = wp.constant(wp.int64(0x7FFFFFFF))
UNBOUND = wp.constant(1.0e6)
"""A tangent beyond any picture."""
NEAR_DEPTH = wp.constant(0.05)
"""Nearer than this [m] bounds are taken from spheres, which know no plane."""
BATCH = wp.constant(64)
"""Pixels of a row that are taken at once; loops over them are written so that LLVM takes eight at a time."""
SMOOTH_SIZE = wp.constant(120.0)
"""From this size in pixels on a leaf's outline is interpolated between texels."""


FloatBatch = wp.types.vector(length=64, dtype=wp.float32)
"""Scratch for one run of pixels."""


IntBatch = wp.types.vector(length=64, dtype=wp.int32)


@wp.struct
class Pinhole:
    """Where a camera is and how it projects. Pixel centres have whole coordinates (sensor_msgs/CameraInfo)."""

    eye: wp.vec3
    rotation: wp.mat33
    """Rows: right, down, forward, in the world."""
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    max_depth: float
    """Farthest depth that is drawn [m]."""
    near_radius: float
    """Radius of a ball around the eye that holds all of the view within the depth CLOSE [m]."""


@wp.func
def pixel_ray(lens: Pinhole, x: int, y: int) -> wp.vec3:
    """Ray of a pixel in the optical frame, 1 along the axis."""
    return wp.vec3((float(x) - lens.cx) / lens.fx, (float(y) - lens.cy) / lens.fy, 1.0)


@wp.func
def depth_key(t: float, i: int) -> wp.int64:
    """What a hit is kept as: the least is the nearest."""
    return (wp.int64(int(t * 1.0e6)) << wp.int64(32)) | wp.int64(i)


@wp.func
def depth_test(pixel: int, t: float, i: int, reach: float, keys_out: wp.array(dtype=wp.int64)):
    """Enter a hit."""
    if t < reach:
        wp.atomic_min(keys_out, pixel, depth_key(t, i))


@wp.func
def circle_tangents(x: float, z: float, r: float) -> wp.vec2:
    """Both tangents (x / z) from the origin to a circle; beyond +-90 degrees they are unbound, with the right sign."""
    free = x * x + z * z - r * r
    low = -UNBOUND
    high = UNBOUND
    if free > 0.0:
        t = wp.sqrt(free)
        tiny = 1.0e-6 * t
        lx = x * t - z * r
        lz = z * t + x * r
        hx = x * t + z * r
        hz = z * t - x * r
        low = wp.where(lz > tiny, lx / wp.max(lz, tiny), wp.where(lx < 0.0, -UNBOUND, UNBOUND))
        high = wp.where(hz > tiny, hx / wp.max(hz, tiny), wp.where(hx < 0.0, -UNBOUND, UNBOUND))
    return wp.vec2(low, high)


@wp.func
def sphere_bounds(lens: Pinhole, p: wp.vec3, r: float) -> wp.vec4:
    """Lowest and highest x, lowest and highest y of a sphere's picture [pixel]."""
    h = circle_tangents(p[0], p[2], r)
    v = circle_tangents(p[1], p[2], r)
    return wp.vec4(
        h[0] * lens.fx + lens.cx, h[1] * lens.fx + lens.cx, v[0] * lens.fy + lens.cy, v[1] * lens.fy + lens.cy
    )


@wp.func
def clip_to_image(lens: Pinhole, bound: wp.vec4) -> wp.vec4i:
    """Bound cut to the picture: first and last + 1 column, first and last + 1 row."""
    w = float(lens.width)
    h = float(lens.height)
    return wp.vec4i(
        int(wp.clamp(bound[0] - 0.01, 0.0, w)),
        int(wp.clamp(bound[1] + 1.01, 0.0, w)),
        int(wp.clamp(bound[2] - 0.01, 0.0, h)),
        int(wp.clamp(bound[3] + 1.01, 0.0, h)),
    )


@wp.kernel
def cull_clusters(
    # in
    ball: wp.array(dtype=wp.vec4),
    lens: Pinhole,
    # out
    distance_out: wp.array(dtype=wp.float32),
):
    """One thread tells how near one cluster may come to the eye, or FAR if no pixel can see it."""
    i = wp.tid()
    r = ball[i][3]
    p = lens.rotation * (xyz(ball[i]) - lens.eye)
    distance = wp.length(p) - r
    bound = sphere_bounds(lens, p, r)
    seen = r > 0.0 and p[2] > -r and p[2] - r < lens.max_depth
    seen = seen and bound[1] > -1.0 and bound[0] < float(lens.width)
    seen = seen and bound[3] > -1.0 and bound[2] < float(lens.height)
    distance_out[i] = wp.where(seen, wp.max(distance, 0.0), FAR)


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
    """One thread draws every ``lanes``-th berry of one visible cluster."""
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
    """One thread draws every ``lanes``-th cone of one visible cluster."""
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
            # What reaches no farther than CLOSE is in view only within a small ball around the eye. An axis that
            # stays clear of that ball may be cut there: a wire that passes the camera keeps a narrow bound.
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
            fa = sphere_bounds(lens, ca, wp.where(a[2] < cut, r, a4[3]))
            fb = sphere_bounds(lens, cb, wp.where(b[2] < cut, r, b4[3]))
            if clear:
                bound = wp.vec4(wp.min(fa[0], fb[0]), wp.max(fa[1], fb[1]), wp.min(fa[2], fb[2]), wp.max(fa[3], fb[3]))
            box = clip_to_image(lens, bound)
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
            band = wp.sqrt(half_x * half_x + across * across + 2.0 * wp.abs(half_x * across) * wp.min(tilt, 1.0)) + 0.02
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
                        if banded:
                            centre = xa + slope * (float(y) - ya)
                            x = wp.max(x, int(wp.max(centre - band, 0.0)))
                            last = wp.min(last, int(wp.max(centre + band + 1.0, 0.0)))
                        last = wp.where(y < box[3], last, 0)
                whole = (n + 7) // 8 * 8
                m = wp.int32(0)
                while m < whole:
                    depths[m] = hit_cone(a, a4[3], b, b4[3], pixel_ray(lens, xs[m], ys[m]))
                    m += 1
                for m in range(n):
                    depth_test(ys[m] * lens.width + xs[m], depths[m], i, lens.max_depth, keys_out)


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
    """One thread draws every ``lanes``-th leaf of one visible cluster."""
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
            # octagon around the picture of the blade: bounds of x, y, x + y, x - y
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
            bound = wp.vec4(x_low, x_high, y_low, y_high)
            crossing = z_low < NEAR_DEPTH
            if crossing:
                bound = sphere_bounds(lens, p + rib * (0.25 * size), 1.45 * size)
            box = clip_to_image(lens, bound)
            if box[0] < box[1] and box[2] < box[3]:
                inv = 1.0 / size
                eye = wp.vec3(-wp.dot(p, side), -wp.dot(p, rib), -wp.dot(p, up)) * inv
                dx = wp.vec3(side[0], rib[0], up[0]) * (inv / lens.fx)
                dy = wp.vec3(side[1], rib[1], up[1]) * (inv / lens.fy)
                dz = wp.vec3(side[2], rib[2], up[2]) * inv - dx * lens.cx - dy * lens.cy
                smooth = wp.int32(0)
                if size * lens.fx > p[2] * SMOOTH_SIZE:
                    smooth = 1
                extent = leaf_extent(shapes.hull, number)
                nearest = wp.int64(int(wp.max(z_low, 0.0) * 1.0e6)) << wp.int64(32)
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
                                x = wp.max(x, int(wp.max(wp.max(sum_low - fy, dif_low + fy) - 0.01, 0.0)))
                                last = wp.min(last, int(wp.max(wp.min(sum_high - fy, dif_high + fy) + 1.01, 0.0)))
                            last = wp.where(y < box[3], last, 0)
                    whole = (n + 7) // 8 * 8
                    m = wp.int32(0)
                    while m < whole:
                        depths[m] = hit_leaf_rectangle(bend, extent, eye, dz + dx * float(xs[m]) + dy * float(ys[m]))
                        m += 1
                    for k in range(n):
                        t = depths[k]
                        if t < lens.max_depth:
                            at = ys[k] * lens.width + xs[k]
                            ray = dz + dx * float(xs[k]) + dy * float(ys[k])
                            if t < 0.0:
                                t = hit_leaf(shapes.outline, number, bend, eye, ray, smooth)
                                depth_test(at, t, i, lens.max_depth, keys_out)
                            elif depth_key(t, i) < keys_out[at]:
                                u = eye[0] + t * ray[0]
                                v = eye[1] + t * ray[1]
                                if inside_outline(shapes.outline, number, u, v, smooth):
                                    depth_test(at, t, i, lens.max_depth, keys_out)


@wp.kernel
def raster_solids(
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
    """One thread draws every ``lanes``-th box, ellipsoid or cylinder of one visible cluster."""
    k, lane = wp.tid()
    cluster = visible[k]
    kind = clusters.kind[cluster]
    first = clusters.first[cluster]
    for i in range(first + lane, first + clusters.size[cluster], lanes):
        a4 = shapes.a[i]
        b4 = shapes.b[i]
        c4 = shapes.c[i]
        p = lens.rotation * (xyz(a4) - lens.eye)
        half = wp.vec3(a4[3], c4[0], c4[1])
        q = as_quat(b4)
        end = p
        centre = p
        r = wp.length(half)
        if kind == ELLIPSOID:
            r = wp.max(wp.max(half[0], half[1]), half[2])
        if kind == CYLINDER:
            end = lens.rotation * (xyz(b4) - lens.eye)
            centre = (p + end) * 0.5
            r = wp.length(wp.vec2(wp.length(end - p) * 0.5, a4[3]))
        if centre[2] > -r:
            bound = sphere_bounds(lens, centre, r)
            if kind == BOX and centre[2] - r > NEAR_DEPTH:
                ex = lens.rotation * wp.quat_rotate(q, wp.vec3(half[0], 0.0, 0.0))
                ey = lens.rotation * wp.quat_rotate(q, wp.vec3(0.0, half[1], 0.0))
                ez = lens.rotation * wp.quat_rotate(q, wp.vec3(0.0, 0.0, half[2]))
                bound = wp.vec4(UNBOUND, -UNBOUND, UNBOUND, -UNBOUND)
                for n in range(8):
                    corner = (
                        centre
                        + ex * (float(n & 1) * 2.0 - 1.0)
                        + ey * (float(n & 2) - 1.0)
                        + ez * (float(n & 4) * 0.5 - 1.0)
                    )
                    x = corner[0] / corner[2] * lens.fx + lens.cx
                    y = corner[1] / corner[2] * lens.fy + lens.cy
                    bound = wp.vec4(wp.min(bound[0], x), wp.max(bound[1], x), wp.min(bound[2], y), wp.max(bound[3], y))
            box = clip_to_image(lens, bound)
            if box[0] < box[1] and box[2] < box[3]:
                back = wp.transpose(lens.rotation)
                eye = wp.vec3(0.0, 0.0, 0.0)
                ax = eye
                ay = eye
                az = eye
                if kind != CYLINDER:
                    eye = wp.quat_rotate_inv(q, lens.eye - xyz(a4))
                    ax = wp.quat_rotate_inv(q, back * wp.vec3(1.0, 0.0, 0.0))
                    ay = wp.quat_rotate_inv(q, back * wp.vec3(0.0, 1.0, 0.0))
                    az = wp.quat_rotate_inv(q, back * wp.vec3(0.0, 0.0, 1.0))
                nearest = wp.int64(int(wp.max(centre[2] - r, 0.0) * 1.0e6)) << wp.int64(32)
                for py in range(box[2], box[3]):
                    for px in range(box[0], box[1]):
                        at = py * lens.width + px
                        if keys_out[at] > nearest:
                            d = pixel_ray(lens, px, py)
                            ray = ax * d[0] + ay * d[1] + az
                            t = FAR
                            if kind == BOX:
                                t = hit_box(eye, ray, half)
                            elif kind == ELLIPSOID:
                                t = hit_sphere(-wp.cw_div(eye, half), 1.0, wp.cw_div(ray, half))
                            else:
                                t = hit_cylinder(p, end, a4[3], d)
                            depth_test(at, t, i, lens.max_depth, keys_out)


@wp.kernel
def raster_triangles(
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
    """One thread draws every ``lanes``-th triangle of one visible cluster."""
    k, lane = wp.tid()
    cluster = visible[k]
    first = clusters.first[cluster]
    for i in range(first + lane, first + clusters.size[cluster], lanes):
        p = lens.rotation * (xyz(shapes.a[i]) - lens.eye)
        q = lens.rotation * (xyz(shapes.b[i]) - lens.eye)
        r = lens.rotation * (xyz(shapes.c[i]) - lens.eye)
        n = wp.cross(q - p, r - p)
        if wp.dot(p, n) < 0.0 and wp.max(wp.max(p[2], q[2]), r[2]) > 0.0:
            bound = wp.vec4(-UNBOUND, UNBOUND, -UNBOUND, UNBOUND)
            z_low = wp.min(wp.min(p[2], q[2]), r[2])
            if z_low > NEAR_DEPTH:
                bound = wp.vec4(
                    wp.min(wp.min(p[0] / p[2], q[0] / q[2]), r[0] / r[2]) * lens.fx + lens.cx,
                    wp.max(wp.max(p[0] / p[2], q[0] / q[2]), r[0] / r[2]) * lens.fx + lens.cx,
                    wp.min(wp.min(p[1] / p[2], q[1] / q[2]), r[1] / r[2]) * lens.fy + lens.cy,
                    wp.max(wp.max(p[1] / p[2], q[1] / q[2]), r[1] / r[2]) * lens.fy + lens.cy,
                )
            else:
                middle = (p + q + r) / 3.0
                away = wp.max(wp.max(wp.length(p - middle), wp.length(q - middle)), wp.length(r - middle))
                bound = sphere_bounds(lens, middle, away * 1.001)
            box = clip_to_image(lens, bound)
            nearest = wp.int64(int(wp.max(z_low, 0.0) * 1.0e6)) << wp.int64(32)
            for y in range(box[2], box[3]):
                for x in range(box[0], box[1]):
                    at = y * lens.width + x
                    if keys_out[at] > nearest:
                        depth_test(at, hit_triangle(p, q, r, pixel_ray(lens, x, y)), i, lens.max_depth, keys_out)


@wp.func
def ground_depth(lens: Pinhole, x: int, y: int) -> float:
    """Depth at which a pixel's ray meets the ground, z = 0."""
    d = pixel_ray(lens, x, y)
    fall = lens.rotation[0, 2] * d[0] + lens.rotation[1, 2] * d[1] + lens.rotation[2, 2]
    meets = fall < -1.0e-6 and lens.eye[2] > 0.0
    t = -lens.eye[2] / wp.where(meets, fall, -1.0)
    return wp.where(meets and t < lens.max_depth, t, FAR)


@wp.kernel
def resolve_keys(
    # model
    label: wp.array(dtype=wp.int32),
    # in
    keys: wp.array(dtype=wp.int64),
    lens: Pinhole,
    ground_label: int,
    nearest: float,
    farthest: float,
    too_near: float,
    too_far: float,
    run: int,
    # out
    primitive_out: wp.array(dtype=wp.int32),
    depth_out: wp.array(dtype=wp.float32),
    labels_out: wp.array(dtype=wp.int32),
):
    """One thread reads ``run`` pixels' keys into depth [m], label and primitive (-1 sky, -2 ground)."""
    first = wp.tid() * run
    column = first % lens.width
    row = first // lens.width
    for pixel in range(first, first + run):
        key = keys[pixel]
        t = ground_depth(lens, column + pixel - first, row)
        i = wp.where(t < FAR, -2, -1)
        name = wp.where(t < FAR, ground_label, 0)
        if key < EMPTY_KEY:
            z = float(key >> wp.int64(32)) * 1.0e-6
            if z < t:
                t = z
                i = int(key & PRIMITIVE_MASK)
                name = label[i]
        primitive_out[pixel] = i
        labels_out[pixel] = name
        depth_out[pixel] = wp.where(t < nearest, too_near, wp.where(t > farthest, too_far, t))
