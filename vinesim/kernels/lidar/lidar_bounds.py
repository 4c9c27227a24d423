"""The head of a spinning lidar, and which of its rows and columns a primitive may cover.

A primitive is bound by balls, one or several along a cone or cylinder; boxes, cylinders and leaves also by the corners of
a box.
"""

import warp as wp

from vinesim.kernels.raster.leaf_surface import leaf_extent, leaf_heights
from vinesim.kernels.raster.oriented_box import OrientedBox
from vinesim.kernels.raster.pinhole import circle_tangents
from vinesim.kernels.raster.primitives import (
    BOX,
    CONE,
    CYLINDER,
    ELLIPSOID,
    LEAF,
    SPHEROID,
    TRIANGLE,
    Shapes,
    xyz,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})

ELEVATION_SLOTS = wp.constant(1024)
"""Into so many parts the way from straight down to straight up is cut to find rows."""
BALL_SPACING = wp.constant(0.02)
"""A slender thing is bound by balls about this far apart [rad]."""


@wp.struct
class LidarHead:
    """Where the head is, its rows in the order of elevation, and which columns are fired."""

    eye: wp.vec3
    rotation: wp.mat33
    """Rows: forward, left, up, in the world."""
    tangent: wp.array(dtype=wp.float32)
    """Of the elevation [row]."""
    azimuth: wp.array(dtype=wp.float32)
    """Of the ray in column 0 [row] rad."""
    row_index: wp.array(dtype=wp.int32)
    """Place within a column [row]."""
    row_slots: wp.array(dtype=wp.int32)
    """First row in each slot or above it [slot]."""
    direction: wp.array2d(dtype=wp.float32)
    """Unit vectors in the head's frame [column * row, 3]."""
    step: float
    """From column to column [rad]."""
    azimuth_middle: wp.vec2
    """Forward and left component of the middle of the azimuths that are fired."""
    azimuth_half_range: wp.vec2
    """Cosine and sine of how far they reach to either side; cosine -1 for all around."""
    first_column: int
    end_column: int
    max_range: float


@wp.func
def elevation_slot(tangent: float) -> int:
    """Slot of an elevation, given by its tangent: 0 straight down, ELEVATION_SLOTS straight up."""
    return int((tangent / (1.0 + wp.abs(tangent)) + 1.0) * (0.5 * float(ELEVATION_SLOTS) - 0.01))


@wp.func
def first_row(head: LidarHead, tangent: float) -> int:
    """First row that is not below an elevation."""
    row = head.row_slots[elevation_slot(tangent)]
    while row < head.tangent.shape[0] and head.tangent[row] < tangent:
        row += 1
    return row


@wp.func
def half_angle(r: float, away: float) -> float:
    """An upper bound of asin(r / away), pi where the circle goes round the origin."""
    s = r / wp.max(away, r)
    return wp.where(s < 0.9999, s + 0.5708 * s * s * s, 3.1416)


@wp.func
def may_intersect(head: LidarHead, p: wp.vec3, r: float) -> int:
    """1 if a ray that is fired may meet a ball, 0 if surely none does. Without a branch."""
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
    """Balls of radius ``r`` [m] that hold a primitive, evenly along the line from a to b, in the head's frame [m]."""

    a: wp.vec3
    b: wp.vec3
    r: float
    count: int


@wp.func
def bounding_balls(shapes: Shapes, i: int, kind: int, head: LidarHead) -> BallChain:
    """One ball around primitive ``i``, or several along a cone or cylinder, about BALL_SPACING apart."""
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
    """Azimuths and elevations, in the head's frame, that hold a primitive."""

    azimuth: float
    """[rad] Its middle."""
    half: float
    """[rad] How far it reaches to either side; pi for all around."""
    low: float
    high: float
    """Tangents of the elevations."""


@wp.func
def holds_eye(box: OrientedBox, kind: int, radius: float) -> bool:
    """Whether the head is inside of a box or cylinder, given by the box around it: no ray meets it from inside."""
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
    """Bound of a box by its corners. The ball around a link of the robot next to the head holds the head, and would be
    tested against every ray; the ball around a leaf that is seen edge-on holds many times the rays that the leaf does.
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
    if left - right < 3.1:  # else the head's vertical axis may pass through it
        o.half = 0.5 * (left - right) + 1.0e-4
        o.azimuth += 0.5 * (left + right)
        cosine = wp.cos(o.azimuth)
        sine = wp.sin(o.azimuth)
        # all of it lies at least as far along the middle azimuth as its nearest corner
        reach = wp.abs(x[0] * cosine + x[1] * sine) + wp.abs(y[0] * cosine + y[1] * sine)
        reach += wp.abs(z[0] * cosine + z[1] * sine)
        near = wp.max(centre[0] * cosine + centre[1] * sine - reach, 0.0)
    margin = 1.0e-5 * (far + wp.abs(top) + wp.abs(bottom))
    top += margin
    bottom -= margin
    o.high = wp.where(top > 0.0, top / wp.max(near, 1.0e-9), top / (far + margin))
    o.low = wp.where(bottom < 0.0, bottom / wp.max(near, 1.0e-9), bottom / (far + margin))
    return o
