"""Rasteriser of a spinning lidar: finds the nearest primitive along each ray of the grid of elevations and azimuths.

Bounds select the rows (elevations) and columns (azimuths) to test. A primitive is bounded by a ball, or by several
along a cone or cylinder; boxes, cylinders and leaves also by the corners of a box.
"""

import warp as wp

from vinesim.kernels.raster.ground import Ground, ground_hit, is_uneven
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
    ELLIPSOID,
    FAR,
    LEAF,
    SPHEROID,
    TRIANGLE,
    Clusters,
    OrientedBox,
    Shapes,
    as_quat,
    hit_box,
    hit_cone,
    hit_cylinder,
    hit_leaf,
    hit_leaf_rectangle,
    hit_primitive,
    hit_sphere,
    inside_outline,
    leaf_extent,
    leaf_heights,
    oriented_box,
    scale_along,
    xyz,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})

ELEVATION_SLOTS = wp.constant(1024)
"""Number of slots into which elevations from straight down to straight up are divided; a table by slot finds rows."""
BALL_SPACING = wp.constant(0.02)
"""Approximate angular distance [rad] between neighbouring balls that bound a slender primitive."""


@wp.struct
class LidarHead:
    """Pose of a lidar's head, its rows sorted by elevation, and the columns (azimuths) to fire."""

    eye: wp.vec3
    rotation: wp.mat33
    """Rotation from the world to the head's frame; its rows are forward, left and up in the world."""
    tangent: wp.array(dtype=wp.float32)
    """[row] Tangent of the row's elevation."""
    azimuth: wp.array(dtype=wp.float32)
    """[row] Azimuth of the row's ray in column 0 [rad]."""
    row_index: wp.array(dtype=wp.int32)
    """[row] Index of the row's ray within a column of the output."""
    row_slots: wp.array(dtype=wp.int32)
    """[slot] First row in the elevation slot or above it."""
    direction: wp.array2d(dtype=wp.float32)
    """[column * row, 3] Unit vectors of the rays in the head's frame."""
    step: float
    """Angle between neighbouring columns [rad]."""
    azimuth_middle: wp.vec2
    """Unit vector (forward, left) of the middle of the fired azimuths."""
    azimuth_half_range: wp.vec2
    """Cosine and sine of half the range of fired azimuths; the cosine is -1 for a full turn."""
    first_column: int
    end_column: int
    max_range: float


@wp.func
def elevation_slot(tangent: float) -> int:
    """Returns the slot of an elevation, given by its tangent: 0 is straight down, ELEVATION_SLOTS straight up."""
    return int((tangent / (1.0 + wp.abs(tangent)) + 1.0) * (0.5 * float(ELEVATION_SLOTS) - 0.01))


@wp.func
def first_row(head: LidarHead, tangent: float) -> int:
    """Returns the first (lowest) row whose elevation is not below the elevation with this ``tangent``."""
    row = head.row_slots[elevation_slot(tangent)]
    while row < head.tangent.shape[0] and head.tangent[row] < tangent:
        row += 1
    return row


@wp.func
def half_angle(r: float, away: float) -> float:
    """Returns an upper bound of asin(r / away) [rad], the half angle that a circle subtends at the origin; pi if the
    circle contains the origin.

    ``r``: radius [m]; ``away``: distance of the centre [m].
    """
    s = r / wp.max(away, r)
    return wp.where(s < 0.9999, s + 0.5708 * s * s * s, 3.1416)


@wp.func
def may_intersect(head: LidarHead, p: wp.vec3, r: float) -> int:
    """Returns 1 if a fired ray may hit the ball of radius ``r`` [m] around ``p`` [m], in the head's frame; else 0.

    The code has no branch, so that it vectorises.
    """
    flat2 = p[0] * p[0] + p[1] * p[1]
    flat = wp.sqrt(flat2)
    span = circle_tangents(p[2], flat, r)
    rows = head.row_slots[elevation_slot(span[1]) + 2] - head.row_slots[elevation_slot(span[0])]
    free = flat2 - r * r
    ahead = p[0] * head.azimuth_middle[0] + p[1] * head.azimuth_middle[1]
    inside = (
        free <= 0.0 or ahead >= head.azimuth_half_range[0] * wp.sqrt(wp.max(free, 0.0)) - head.azimuth_half_range[1] * r
    )
    return wp.where(rows > 0 and (inside or head.azimuth_half_range[0] <= -1.0), 1, 0)


@wp.struct
class BallChain:
    """``count`` balls of radius ``r`` [m], evenly along the line from ``a`` to ``b`` [m, head's frame], that together
    contain a primitive."""

    a: wp.vec3
    b: wp.vec3
    r: float
    count: int


@wp.func
def bounding_balls(shapes: Shapes, i: int, kind: int, head: LidarHead) -> BallChain:
    """Returns one ball that contains primitive ``i``, or several along a cone or cylinder, about BALL_SPACING apart."""
    a4 = shapes.a[i]
    b4 = shapes.b[i]
    a = head.rotation * (xyz(a4) - head.eye)
    b = a
    r = a4[3]
    pieces = wp.int32(1)
    if kind == SPHEROID:
        r *= wp.max(b4[3], 1.0)
    elif kind == LEAF:
        rib = head.rotation * xyz(b4)
        up = head.rotation * xyz(shapes.c[i])
        heights = leaf_heights(shapes.d[i])
        extent = leaf_extent(shapes.hull, int(b4[3]))
        middle = 0.5 * (extent[1] + extent[2])
        high = 0.5 * (heights[1] - heights[0])
        flat = float(0.0)
        for n in range(8):
            flat = wp.max(flat, wp.length(shapes.hull[int(b4[3]), n] - wp.vec2(0.0, middle)))
        a += (rib * middle + up * (0.5 * (heights[0] + heights[1]))) * r
        b = a
        r *= wp.sqrt(flat * flat + high * high)
    elif kind == CONE or kind == CYLINDER:
        b = head.rotation * (xyz(b4) - head.eye)
        r = wp.max(r, wp.where(kind == CONE, b4[3], 0.0))
        long = wp.length(b - a)
        along = wp.clamp(-wp.dot(a, b - a) / wp.max(long * long, 1.0e-12), 0.0, 1.0)
        away = wp.length(a + (b - a) * along)
        pieces = wp.clamp(int(long / wp.max(3.0 * r, BALL_SPACING * away)) + 1, 1, 1000)
        r += 0.5 * long / float(pieces)
    elif kind == TRIANGLE:
        q = head.rotation * (xyz(b4) - head.eye)
        s = head.rotation * (xyz(shapes.c[i]) - head.eye)
        middle_of = (a + q + s) / 3.0
        r = wp.max(wp.max(wp.length(a - middle_of), wp.length(q - middle_of)), wp.length(s - middle_of)) * 1.001
        a = middle_of
        b = a
    elif kind == BOX:
        r = wp.length(wp.vec3(r, shapes.c[i][0], shapes.c[i][1]))
    elif kind == ELLIPSOID:
        r = wp.max(wp.max(r, shapes.c[i][0]), shapes.c[i][1])
    o = BallChain()
    o.a = a
    o.b = b
    o.r = r
    o.count = pieces
    return o


@wp.struct
class AngularBound:
    """Ranges of azimuth and elevation, in the head's frame, that contain a primitive."""

    azimuth: float
    """Middle of the range of azimuths [rad]."""
    half: float
    """Half of the range of azimuths [rad]; pi for a full turn."""
    low: float
    high: float
    """Tangent of the highest elevation; ``low`` is the tangent of the lowest."""


@wp.func
def holds_eye(box: OrientedBox, kind: int, radius: float) -> bool:
    """Returns whether the lidar's head is inside a box or cylinder, which its rays then do not hit.

    ``box``: bounding box of the primitive, in the head's frame; ``radius``: of the cylinder [m].
    """
    c = box.centre
    inside = wp.where(kind == BOX, 1.0, 0.999999)
    u = wp.abs(wp.dot(c, box.x)) < inside * wp.dot(box.x, box.x)
    v = wp.abs(wp.dot(c, box.y)) < inside * wp.dot(box.y, box.y)
    w = wp.abs(wp.dot(c, box.z)) < inside * wp.dot(box.z, box.z)
    if kind == CYLINDER:
        off = c - box.z * (wp.dot(c, box.z) / wp.max(wp.dot(box.z, box.z), 1.0e-12))
        u = wp.dot(off, off) < inside * radius * radius
        v = u
    return u and v and w


@wp.func
def angular_bound(box: OrientedBox) -> AngularBound:
    """Returns the ranges of azimuth and elevation of a box in the head's frame, from its corners.

    Balls would be too coarse a bound: the ball around a robot link next to the head contains the head, so that every
    ray would be tested; the ball around an edge-on leaf contains many times as many rays as the leaf.
    """
    centre = box.centre
    x = box.x
    y = box.y
    z = box.z
    o = AngularBound()
    o.azimuth = wp.atan2(centre[1], centre[0])
    o.half = 3.1416
    left = float(-4.0)
    right = float(4.0)
    top = float(-1.0e9)
    bottom = float(1.0e9)
    far = float(0.0)
    for k in range(8):
        p = centre
        p += x * wp.where((k & 1) == 0, 1.0, -1.0)
        p += y * wp.where((k & 2) == 0, 1.0, -1.0)
        p += z * wp.where((k & 4) == 0, 1.0, -1.0)
        turn = wp.atan2(p[1] * centre[0] - p[0] * centre[1], p[0] * centre[0] + p[1] * centre[1])
        left = wp.max(left, turn)
        right = wp.min(right, turn)
        top = wp.max(top, p[2])
        bottom = wp.min(bottom, p[2])
        far = wp.max(far, wp.sqrt(p[0] * p[0] + p[1] * p[1]))
    near = float(0.0)
    if left - right < 3.1:  # else the head's vertical axis may pass through the box
        o.half = 0.5 * (left - right) + 1.0e-4
        o.azimuth += 0.5 * (left + right)
        cosine = wp.cos(o.azimuth)
        sine = wp.sin(o.azimuth)
        # along the middle azimuth, every point of the box is at least as far as its nearest corner
        reach = wp.abs(x[0] * cosine + x[1] * sine) + wp.abs(y[0] * cosine + y[1] * sine)
        reach += wp.abs(z[0] * cosine + z[1] * sine)
        near = wp.max(centre[0] * cosine + centre[1] * sine - reach, 0.0)
    margin = 1.0e-5 * (far + wp.abs(top) + wp.abs(bottom))
    top += margin
    bottom -= margin
    o.high = wp.where(top > 0.0, top / wp.max(near, 1.0e-9), top / (far + margin))
    o.low = wp.where(bottom < 0.0, bottom / wp.max(near, 1.0e-9), bottom / (far + margin))
    return o


# The nearest primitive along each ray of a spinning head: primitives rasterised into its grid of azimuths and
# elevations.
#
# The bounds of a primitive cover a range of elevations, which selects rows, and a range of azimuths, which selects
# columns. The selected rays are tested eight at a time. Hits are stored as keys, like those of a camera's pixels
# (:mod:`vinesim.kernels.raster.camera_raster`).


@wp.func
def ray_direction(head: LidarHead, at: int) -> wp.vec3:
    """Returns the unit vector of ray ``at`` in the head's frame; it is read as three scalars so that LLVM vectorises
    it."""
    return wp.vec3(head.direction[at, 0], head.direction[at, 1], head.direction[at, 2])


@wp.kernel
def cull_clusters(
    # in
    ball: wp.array(dtype=wp.vec4),
    head: LidarHead,
    # out
    distance_out: wp.array(dtype=wp.float32),
):
    """One thread tests one cluster of primitives against the fired rays.

    ball: [cluster] centre and radius of a bounding sphere [m]; distance: [cluster] least distance to the head [m], or
    FAR if no ray can hit the cluster.
    """
    i = wp.tid()
    r = ball[i][3]
    p = head.rotation * (xyz(ball[i]) - head.eye)
    away = wp.length(p) - r
    seen = r > 0.0 and away < head.max_range and may_intersect(head, p, r) == 1
    distance_out[i] = wp.where(seen, wp.max(away, 0.0), FAR)


@wp.func
def axes_in_box(head: LidarHead, q: wp.quat) -> wp.mat33:
    """Returns the rotation from the head's frame to the frame of a box with orientation ``q`` in the world."""
    return wp.transpose(wp.quat_to_matrix(q)) * wp.transpose(head.rotation)


@wp.struct
class LeafFrame:
    """Transform of rays from the head's frame to the frame and unit of a leaf.

    ``side``, ``rib``, ``up``: axes of the leaf in the head's frame, divided by its size [m]; ``eye``: position of the
    head in the leaf's frame and unit.
    """

    side: wp.vec3
    rib: wp.vec3
    up: wp.vec3
    eye: wp.vec3
    per: float
    """1 divided by the size of the leaf [1/m]."""


@wp.func
def leaf_frame(shapes: Shapes, i: int, head: LidarHead) -> LeafFrame:
    """Returns the transform of rays from the head's frame to the frame and unit of leaf ``i``."""
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
    """Returns a ray's ``direction``, given in the head's frame, in the frame and unit of a leaf."""
    d = direction * leaf.per
    return wp.vec3(wp.dot(d, leaf.side), wp.dot(d, leaf.rib), wp.dot(d, leaf.up))


@wp.func
def leaf_range(shapes: Shapes, i: int, leaf: LeafFrame, ray: wp.vec3, t: float) -> float:
    """Returns the range [m] at which a ray hits leaf ``i``, or FAR if the ray misses the leaf's outline.

    ``ray``: direction in the leaf's frame and unit; ``t``: hit with the rectangle around the leaf [m], negative if the
    ray hits the rectangle several times.
    """
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
    """One thread draws every ``lanes``-th primitive of one cluster of primitives into every ``slices``-th row of the
    lidar's rays.

    lower, upper: [primitive, 3] bounding boxes [m]; visible: clusters in view; keys: [column * row] nearest hit, as in
    :mod:`vinesim.kernels.raster.pinhole` but with the range [um] in the upper 32 bits. The function is long so that
    batches of rays stay in registers.
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
    # most primitives of far clusters are between two rows
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
                            # go on with the same row, one turn further, or with the next row
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
    # model
    ground: Ground,
    # in
    keys: wp.array(dtype=wp.int64),
    head: LidarHead,
    run: int,
    # out
    distance_out: wp.array(dtype=wp.float32),
    primitive_out: wp.array(dtype=wp.int32),
):
    """One thread converts the keys of ``run`` rays to distance and primitive.

    keys: [column * row] see :func:`raster_clusters`; distance: [column * row] m; primitive: [column * row] index, -1 no
    hit, -2 the ground.
    """
    up = wp.vec3(head.rotation[0, 2], head.rotation[1, 2], head.rotation[2, 2])
    first = head.first_column * head.tangent.shape[0] + wp.tid() * run
    for at in range(first, first + run):
        t = head.max_range
        i = wp.int32(-1)
        key = keys[at]
        fall = wp.dot(up, ray_direction(head, at))
        if is_uneven(ground):
            if key < EMPTY_KEY:
                t = wp.min(t, float(key >> wp.int64(32)) * 1.0e-6)
            met = ground_hit(ground, head.eye, wp.transpose(head.rotation) * ray_direction(head, at), t)
            t = wp.min(met, head.max_range)
            if met < FAR:
                i = -2
        elif fall < -1.0e-6 and head.eye[2] > 0.0 and -head.eye[2] / fall < t:
            t = -head.eye[2] / fall
            i = -2
        if key < EMPTY_KEY:
            z = float(key >> wp.int64(32)) * 1.0e-6
            if z < t:
                t = z
                i = int(key & PRIMITIVE_MASK)
        distance_out[at] = wp.where(i == -1, FAR, t)
        primitive_out[at] = i
