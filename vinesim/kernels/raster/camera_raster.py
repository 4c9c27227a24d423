"""Rasteriser of a pinhole camera on a CPU: culling of clusters, solids and triangles, depth and labels from keys.

For each primitive, a thread visits the pixels inside a conservative bound of the primitive's outline, intersects each
pixel's ray in closed form and keeps the nearest hit (:mod:`vinesim.kernels.raster.pinhole`).
"""

import warp as wp

from vinesim.kernels.raster.ground import Ground, ground_hit, is_uneven
from vinesim.kernels.raster.pinhole import (
    EMPTY_KEY,
    NEAR_DEPTH,
    PRIMITIVE_MASK,
    UNBOUND,
    Pinhole,
    clip_to_image,
    depth_test,
    pixel_ray,
    sphere_bounds,
)
from vinesim.kernels.raster.primitives import (
    BOX,
    CYLINDER,
    ELLIPSOID,
    FAR,
    Clusters,
    OrientedBox,
    Shapes,
    as_quat,
    hit_box,
    hit_cylinder,
    hit_sphere,
    hit_triangle,
    oriented_box,
    xyz,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.kernel
def cull_clusters(
    # in
    ball: wp.array(dtype=wp.vec4),
    lens: Pinhole,
    # out
    distance_out: wp.array(dtype=wp.float32),
):
    """One thread tests one cluster of primitives against the view.

    ball: [cluster] centre and radius of a bounding sphere [m]; distance: [cluster] least distance to the camera [m], or
    FAR if the cluster is out of view.
    """
    i = wp.tid()
    r = ball[i][3]
    p = lens.rotation * (xyz(ball[i]) - lens.eye)
    distance = wp.length(p) - r
    bound = sphere_bounds(lens, p, r)
    seen = r > 0.0 and p[2] > -r and p[2] - r < lens.max_depth
    seen = seen and bound[1] > -1.0 and bound[0] < float(lens.width)
    seen = seen and bound[3] > float(lens.first_row) - 1.0 and bound[2] < float(lens.end_row)
    distance_out[i] = wp.where(seen, wp.max(distance, 0.0), FAR)


@wp.func
def tangent(across: float, ahead: float, behind: float) -> float:
    """Returns across / ahead for a direction in front of the camera (``ahead`` > 0), else the value ``behind``."""
    return wp.where(ahead > 0.0, across / wp.max(ahead, 1.0e-9), behind)


@wp.func
def hull_tangents(box: OrientedBox, k: int) -> wp.vec2:
    """Returns the least and greatest x / z (``k`` 0) or y / z (``k`` 1) of directions from the camera to a box.

    The box is in the optical frame. A bounding sphere would be too coarse: the sphere around a part next to the camera,
    such as its housing, contains the camera.
    """
    across = box.centre[k]
    ahead = box.centre[2]
    low = float(UNBOUND)
    high = float(-UNBOUND)
    least = float(1.0)
    for n in range(8):
        corner = box.centre + box.x * (float(n & 1) * 2.0 - 1.0) + box.y * (float(n & 2) - 1.0)
        corner += box.z * (float(n & 4) * 0.5 - 1.0)
        along = across * corner[k] + ahead * corner[2]
        turn = (ahead * corner[k] - across * corner[2]) / wp.max(along, 1.0e-9)  # tangent of the angle to the centre
        low = wp.min(low, turn)
        high = wp.max(high, turn)
        least = wp.min(least, along)
    out = wp.vec2(-UNBOUND, UNBOUND)
    if least > 1.0e-9:  # the box subtends less than 180 degrees
        low_ahead = ahead - low * across
        high_ahead = ahead - high * across
        if low_ahead <= 0.0 and high_ahead <= 0.0:
            out = wp.vec2(UNBOUND, -UNBOUND)  # the whole box is behind
        else:
            out[0] = tangent(across + low * ahead, low_ahead, -UNBOUND)
            out[1] = tangent(across + high * ahead, high_ahead, UNBOUND)
    return out


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
    """One thread draws every ``lanes``-th box, ellipsoid or cylinder of one visible cluster of primitives.

    visible: clusters in view; lanes: number of threads that share one cluster; keys: [pixel] nearest hit, see
    :mod:`vinesim.kernels.raster.pinhole`.
    """
    k, lane = wp.tid()
    cluster = visible[k]
    kind = clusters.kind[cluster]
    first = clusters.first[cluster]
    for i in range(first + lane, first + clusters.size[cluster], lanes):
        a4 = shapes.a[i]
        b4 = shapes.b[i]
        c4 = shapes.c[i]
        hull = oriented_box(shapes, i, kind, lens.eye, lens.rotation)
        h = hull_tangents(hull, 0)
        v = hull_tangents(hull, 1)
        bound = wp.vec4(
            h[0] * lens.fx + lens.cx, h[1] * lens.fx + lens.cx, v[0] * lens.fy + lens.cy, v[1] * lens.fy + lens.cy
        )
        box = clip_to_image(lens, bound)
        half = wp.vec3(a4[3], c4[0], c4[1])
        q = as_quat(b4)
        eye = wp.vec3(0.0, 0.0, 0.0)
        if kind != CYLINDER:
            eye = wp.quat_rotate_inv(q, lens.eye - xyz(a4))
        if kind == BOX and wp.max(wp.cw_div(wp.abs(eye), half)) < 1.0:
            continue  # a box that contains the camera is not drawn
        if box[0] < box[1] and box[2] < box[3]:
            p = lens.rotation * (xyz(a4) - lens.eye)
            end = lens.rotation * (xyz(b4) - lens.eye)
            back = wp.transpose(lens.rotation)
            ax = wp.quat_rotate_inv(q, back * wp.vec3(1.0, 0.0, 0.0))
            ay = wp.quat_rotate_inv(q, back * wp.vec3(0.0, 1.0, 0.0))
            az = wp.quat_rotate_inv(q, back * wp.vec3(0.0, 0.0, 1.0))
            reach = wp.abs(hull.x[2]) + wp.abs(hull.y[2]) + wp.abs(hull.z[2])
            nearest = wp.int64(int(wp.max(hull.centre[2] - reach, 0.0) * 1.0e6)) << wp.int64(32)
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
    """One thread draws every ``lanes``-th triangle of one visible cluster of triangles.

    visible: clusters in view; lanes: number of threads that share one cluster; keys: [pixel] nearest hit, see
    :mod:`vinesim.kernels.raster.pinhole`.
    """
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
    """Returns the depth [m] at which the ray of pixel (x, y) meets the ground (z = 0), or FAR."""
    d = pixel_ray(lens, x, y)
    fall = lens.rotation[0, 2] * d[0] + lens.rotation[1, 2] * d[1] + lens.rotation[2, 2]
    meets = fall < -1.0e-6 and lens.eye[2] > 0.0
    t = -lens.eye[2] / wp.where(meets, fall, -1.0)
    return wp.where(meets and t < lens.max_depth, t, FAR)


@wp.func
def uneven_ground_depth(ground: Ground, lens: Pinhole, x: int, y: int, nearest: float) -> float:
    """Returns the depth [m] at which the ray of pixel (x, y) meets uneven ground, or FAR if it does not before
    ``nearest`` [m]."""
    d = wp.transpose(lens.rotation) * pixel_ray(lens, x, y)
    return ground_hit(ground, lens.eye, d, wp.min(lens.max_depth, nearest))


@wp.kernel
def resolve_keys(
    # model
    label: wp.array(dtype=wp.int32),
    ground: Ground,
    # in
    lens: Pinhole,
    ground_label: int,
    nearest: float,
    farthest: float,
    too_near: float,
    too_far: float,
    run: int,
    # out
    keys_out: wp.array(dtype=wp.int64),
    primitive_out: wp.array(dtype=wp.int32),
    depth_out: wp.array(dtype=wp.float32),
    labels_out: wp.array(dtype=wp.int32),
):
    """One thread converts the keys of ``run`` neighbouring pixels to primitive, depth and label.

    Threads begin at row ``lens.first_row``. label: [primitive]; keys: [pixel] see
    :mod:`vinesim.kernels.raster.pinhole`; too_near, too_far: depth reported below ``nearest`` [m] and above
    ``farthest`` [m]; primitive: [pixel] -1 the sky, -2 the ground; depth: [pixel] m; labels: [pixel]. On uneven ground
    the keys get its depth.
    """
    first = lens.first_row * lens.width + wp.tid() * run
    column = first % lens.width
    row = first // lens.width
    for pixel in range(first, first + run):
        key = keys_out[pixel]
        t = float(FAR)
        if is_uneven(ground):
            behind = wp.where(key < EMPTY_KEY, float(key >> wp.int64(32)) * 1.0e-6, FAR)
            t = uneven_ground_depth(ground, lens, column + pixel - first, row, behind)
            if t < FAR:  # shading reads it there
                keys_out[pixel] = wp.int64(t * 1.0e6) << wp.int64(32)
        else:
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
