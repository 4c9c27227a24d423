"""The nearest primitive along each ray of a spinning head: primitives rasterised into its grid of azimuths and elevations.

Bounds of a primitive (:mod:`vinesim.kernels.lidar.lidar_bounds`) reach over a range of elevations, which picks rows, and
over a range of azimuths, which picks columns; the rays found are tested eight at a time and kept as a camera's pixels
are (:mod:`vinesim.kernels.raster.camera_raster`).
"""

import warp as wp

from vinesim.kernels.lidar.lidar_bounds import (
    AngularBound,
    LidarHead,
    angular_bound,
    bounding_balls,
    first_row,
    half_angle,
    holds_eye,
    may_intersect,
)
from vinesim.kernels.raster.intersections import hit_box, hit_cone, hit_cylinder, hit_primitive, hit_sphere
from vinesim.kernels.raster.leaf_surface import hit_leaf, hit_leaf_rectangle, inside_outline, leaf_extent
from vinesim.kernels.raster.oriented_box import oriented_box
from vinesim.kernels.raster.pinhole import (
    BATCH,
    EMPTY_KEY,
    PRIMITIVE_MASK,
    FloatBatch,
    IntBatch,
    circle_tangents,
    depth_test,
)
from vinesim.kernels.raster.primitives import (
    BOX,
    CONE,
    CYLINDER,
    FAR,
    LEAF,
    SPHEROID,
    Clusters,
    Shapes,
    as_quat,
    scale_along,
    xyz,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.func
def ray_direction(head: LidarHead, at: int) -> wp.vec3:
    """One ray; read number by number, for LLVM makes nothing of eight vectors."""
    return wp.vec3(head.direction[at, 0], head.direction[at, 1], head.direction[at, 2])


@wp.kernel
def cull_clusters(
    # in
    ball: wp.array(dtype=wp.vec4),
    head: LidarHead,
    # out
    distance_out: wp.array(dtype=wp.float32),
):
    """One thread bounds one cluster: its least distance [m] to the head, or FAR if no ray can meet it.

    ball: [cluster] centre and radius of a bounding sphere [m]; distance: [cluster] m.
    """
    i = wp.tid()
    r = ball[i][3]
    p = head.rotation * (xyz(ball[i]) - head.eye)
    away = wp.length(p) - r
    seen = r > 0.0 and away < head.max_range and may_intersect(head, p, r) == 1
    distance_out[i] = wp.where(seen, wp.max(away, 0.0), FAR)


@wp.func
def axes_in_box(head: LidarHead, q: wp.quat) -> wp.mat33:
    """Columns: the head's axes in the frame of a box of attitude ``q``."""
    return wp.transpose(wp.quat_to_matrix(q)) * wp.transpose(head.rotation)


@wp.struct
class LeafFrame:
    """A blade's axes, over its size, in the head's frame, and where the head is in the blade's frame and unit."""

    side: wp.vec3
    rib: wp.vec3
    up: wp.vec3
    eye: wp.vec3
    per: float
    """1 / size [1/m]"""


@wp.func
def leaf_frame(shapes: Shapes, i: int, head: LidarHead) -> LeafFrame:
    """Frame of blade ``i``."""
    a4 = shapes.a[i]
    o = LeafFrame()
    base = head.rotation * (xyz(a4) - head.eye)
    o.rib = head.rotation * xyz(shapes.b[i])
    o.up = head.rotation * xyz(shapes.c[i])
    o.side = wp.cross(o.rib, o.up)
    o.per = 1.0 / a4[3]
    o.eye = wp.vec3(-wp.dot(base, o.side), -wp.dot(base, o.rib), -wp.dot(base, o.up)) * o.per
    return o


@wp.func
def leaf_ray(leaf: LeafFrame, direction: wp.vec3) -> wp.vec3:
    """A ray's direction, given in the head's frame, in the blade's frame and unit."""
    d = direction * leaf.per
    return wp.vec3(wp.dot(d, leaf.side), wp.dot(d, leaf.rib), wp.dot(d, leaf.up))


@wp.func
def leaf_range(shapes: Shapes, i: int, leaf: LeafFrame, ray: wp.vec3, t: float) -> float:
    """Range [m] of blade ``i`` along a ray that meets its rectangle at ``t``, or in several places if that is negative; FAR
    where its outline is missed."""
    number = int(shapes.b[i][3])
    if t < 0.0:
        return hit_leaf(shapes.outline, number, shapes.d[i], leaf.eye, ray, 0)
    u = leaf.eye[0] + t * ray[0]
    v = leaf.eye[1] + t * ray[1]
    return wp.where(inside_outline(shapes.outline, number, u, v, 0), t, FAR)


@wp.kernel
def raster_clusters(  # noqa: PLR0915 - one loop over all kinds of primitives keeps its state in registers
    # model
    shapes: Shapes,
    clusters: Clusters,
    lower: wp.array2d(dtype=wp.float32),
    upper: wp.array2d(dtype=wp.float32),
    # in
    visible: wp.array(dtype=wp.int32),
    head: LidarHead,
    lanes: int,
    slices: int,
    # out
    keys_out: wp.array(dtype=wp.int64),
):
    """A thread enters every ``lanes``-th primitive of a cluster into every ``slices``-th row of the keys; reason: batches
    stay in registers.

    lower, upper: [primitive, 3] m; visible: [thread] clusters; keys: [column * row] as in
    :mod:`vinesim.kernels.raster.pinhole`, range [um] above.
    """
    k, lane, part = wp.tid()
    cluster = visible[k]
    kind = clusters.kind[cluster]
    first = clusters.first[cluster]
    rows = head.tangent.shape[0]
    period = 6.2831853 / wp.abs(head.step)
    spots = IntBatch()
    depths = FloatBatch()
    size = clusters.size[cluster]
    # most primitives of far clusters lie between two rows
    found = IntBatch()
    n = wp.int32(0)
    while n < (size + 7) // 8 * 8:
        i = first + wp.min(n, size - 1)
        lo = wp.vec3(lower[i, 0], lower[i, 1], lower[i, 2])
        hi = wp.vec3(upper[i, 0], upper[i, 1], upper[i, 2])
        found[n] = may_intersect(head, head.rotation * ((lo + hi) * 0.5 - head.eye), wp.length(hi - lo) * 0.5)
        n += 1
    for member in range(lane, size, lanes):
        if found[member] == 0:
            continue
        i = first + member
        a4 = shapes.a[i]
        b4 = shapes.b[i]
        balls = bounding_balls(shapes, i, kind, head)
        a = balls.a
        b = balls.b
        r = balls.r
        pieces = balls.count
        bound = AngularBound()
        is_boxed = kind == BOX or kind == LEAF or (kind == CYLINDER and pieces == 1)
        if is_boxed:
            box = oriented_box(shapes, i, kind, head.eye, head.rotation)
            if kind != LEAF and holds_eye(box, kind, a4[3]):
                continue
            bound = angular_bound(box)
        for piece in range(pieces):
            p = a + (b - a) * ((float(piece) + 0.5) / float(pieces))
            around = wp.sqrt(p[0] * p[0] + p[1] * p[1])
            span = circle_tangents(p[2], around, r)
            if is_boxed:
                span = wp.vec2(wp.max(span[0], bound.low), wp.min(span[1], bound.high))
            row = first_row(head, span[0])
            row += (part - row % slices + slices) % slices - slices
            more = row + slices < rows
            if more:
                more = head.tangent[row + slices] <= span[1]
            if more:
                azimuth = wp.atan2(p[1], p[0])
                half = half_angle(r, around) + 1.0e-5
                if is_boxed and bound.half < half:
                    azimuth = bound.azimuth
                    half = bound.half
                half = wp.min(half / wp.abs(head.step), 0.5 * period)
                nearest = wp.int64(int(wp.max(wp.length(p) - r, 0.0) * 1.0e6)) << wp.int64(32)
                column = wp.int32(0)
                last = wp.int32(0)
                begin = float(head.end_column)
                while more:
                    n = wp.int32(0)
                    while n < BATCH and more:
                        if column < last:
                            at = column * rows + head.row_index[row]
                            if keys_out[at] > nearest:
                                spots[n] = at
                                n += 1
                            column += 1
                        else:
                            # the same row one turn further, or the next row
                            begin += period
                            if begin >= float(head.end_column):
                                row += slices
                                more = row < rows
                                if more:
                                    more = head.tangent[row] <= span[1]
                                if more:
                                    begin = (azimuth - head.azimuth[row]) / head.step - half
                                    begin += wp.ceil((float(head.first_column) - begin - 2.0 * half) / period) * period
                            if more:
                                column = wp.max(int(wp.ceil(begin)), head.first_column)
                                last = wp.min(int(wp.floor(begin + 2.0 * half)) + 1, head.end_column)
                    whole = (n + 7) // 8 * 8
                    m = wp.int32(0)
                    if kind == SPHEROID:
                        axis = head.rotation * xyz(b4)
                        stretch = 1.0 / b4[3] - 1.0
                        centre = scale_along(p, axis, stretch)
                        while m < whole:
                            depths[m] = hit_sphere(
                                centre, a4[3], scale_along(ray_direction(head, spots[m]), axis, stretch)
                            )
                            m += 1
                    elif kind == CONE:
                        while m < whole:
                            depths[m] = hit_cone(a, a4[3], b, b4[3], ray_direction(head, spots[m]))
                            m += 1
                    elif kind == LEAF:
                        bend = shapes.d[i]
                        extent = leaf_extent(shapes.hull, int(b4[3]))
                        leaf = leaf_frame(shapes, i, head)
                        while m < whole:
                            depths[m] = hit_leaf_rectangle(
                                bend, extent, leaf.eye, leaf_ray(leaf, ray_direction(head, spots[m]))
                            )
                            m += 1
                        for m in range(n):
                            if depths[m] < head.max_range:
                                ray = leaf_ray(leaf, ray_direction(head, spots[m]))
                                depths[m] = leaf_range(shapes, i, leaf, ray, depths[m])
                    elif kind == CYLINDER:
                        while m < whole:
                            depths[m] = hit_cylinder(a, b, a4[3], ray_direction(head, spots[m]))
                            m += 1
                    elif kind == BOX:
                        half_size = wp.vec3(a4[3], shapes.c[i][0], shapes.c[i][1])
                        eye = wp.quat_rotate_inv(as_quat(b4), head.eye - xyz(a4))
                        turned = axes_in_box(head, as_quat(b4))
                        while m < whole:
                            depths[m] = hit_box(eye, turned * ray_direction(head, spots[m]), half_size)
                            m += 1
                    else:
                        back = wp.transpose(head.rotation)
                        for m in range(n):
                            depths[m] = hit_primitive(shapes, i, head.eye, back * ray_direction(head, spots[m]), 0)
                    for m in range(n):
                        depth_test(spots[m], depths[m], i, head.max_range, keys_out)


@wp.kernel
def resolve_keys(
    # in
    keys: wp.array(dtype=wp.int64),
    head: LidarHead,
    run: int,
    # out
    distance_out: wp.array(dtype=wp.float32),
    primitive_out: wp.array(dtype=wp.int32),
):
    """One thread reads the keys of ``run`` rays into distance [m] and primitive (-1 nothing, -2 the ground)."""
    up = wp.vec3(head.rotation[0, 2], head.rotation[1, 2], head.rotation[2, 2])
    first = head.first_column * head.tangent.shape[0] + wp.tid() * run
    for at in range(first, first + run):
        t = head.max_range
        i = wp.int32(-1)
        fall = wp.dot(up, ray_direction(head, at))
        if fall < -1.0e-6 and head.eye[2] > 0.0 and -head.eye[2] / fall < t:
            t = -head.eye[2] / fall
            i = -2
        key = keys[at]
        if key < EMPTY_KEY:
            z = float(key >> wp.int64(32)) * 1.0e-6
            if z < t:
                t = z
                i = int(key & PRIMITIVE_MASK)
        distance_out[at] = wp.where(i == -1, FAR, t)
        primitive_out[at] = i
