"""Pinhole projection, bounds of projected shapes, and the depth test of all rasterisers.

Each pixel keeps its nearest hit by ``atomic_min`` on a 64-bit key: depth [um] in the upper 32 bits, index of the
primitive in the lower bits. Depth is measured along the optical axis. There is no near plane: everything in front of
the pinhole is drawn.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": True})

EMPTY_KEY = wp.constant(wp.int64(1 << 62))
"""Key of a pixel in which no primitive is visible."""
PRIMITIVE_MASK = wp.constant(wp.int64(0x7FFFFFFF))
UNBOUND = wp.constant(1.0e6)
"""Tangent (x / z) that stands for an unlimited bound; every tangent within a picture is smaller."""
NEAR_DEPTH = wp.constant(0.05)
"""Depth [m] below which primitives are bounded by spheres, because projected corners would need a near plane."""
BATCH = wp.constant(64)
"""Number of pixels of a row that one loop tests together; LLVM vectorises such loops by eight."""
SMOOTH_SIZE = wp.constant(120.0)
"""Length of a leaf in the picture [px] above which its outline is interpolated between texels."""


FloatBatch = wp.types.vector(length=64, dtype=wp.float32)
"""Vectors of scratch values, one for each pixel of a :data:`BATCH`."""


IntBatch = wp.types.vector(length=64, dtype=wp.int32)


@wp.struct
class Pinhole:
    """Pose and projection of a camera. Pixel centres have whole coordinates (sensor_msgs/CameraInfo)."""

    eye: wp.vec3
    rotation: wp.mat33
    """Rotation from the world to the optical frame; its rows are right, down and forward in the world."""
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    first_row: int
    """First row that is drawn; a picture may be drawn in several bands of rows."""
    end_row: int
    """Row after the last row that is drawn."""
    max_depth: float
    """Farthest depth that is drawn [m]."""
    near_radius: float
    """Radius [m] of a ball around the eye that contains the part of the view nearer than NEAR_DEPTH."""


@wp.func
def pixel_ray(lens: Pinhole, x: int, y: int) -> wp.vec3:
    """Returns the ray of pixel (x, y) in the optical frame, with length 1 along the optical axis."""
    return wp.vec3((float(x) - lens.cx) / lens.fx, (float(y) - lens.cy) / lens.fy, 1.0)


@wp.func
def depth_key(t: float, i: int) -> wp.int64:
    """Returns the key of a hit with primitive ``i`` at depth ``t`` [m]; of two keys the smaller is the nearer hit."""
    return (wp.int64(int(t * 1.0e6)) << wp.int64(32)) | wp.int64(i)


@wp.func
def depth_test(pixel: int, t: float, i: int, reach: float, keys_out: wp.array(dtype=wp.int64)):
    """Store a hit with primitive ``i`` at depth ``t`` [m] in ``pixel`` if it is nearer than ``reach`` and all earlier
    hits."""
    if t < reach:
        wp.atomic_min(keys_out, pixel, depth_key(t, i))


@wp.func
def circle_tangents(x: float, z: float, r: float) -> wp.vec2:
    """Returns x / z of both tangents from the origin to a circle of radius ``r`` around (x, z) [m].

    A tangent beyond +-90 degrees is +-UNBOUND.
    """
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
    """Returns bounds of a sphere in the picture [px]: lowest and highest x, lowest and highest y.

    ``p``: centre in the optical frame [m]; ``r``: radius [m].
    """
    h = circle_tangents(p[0], p[2], r)
    v = circle_tangents(p[1], p[2], r)
    return wp.vec4(
        h[0] * lens.fx + lens.cx, h[1] * lens.fx + lens.cx, v[0] * lens.fy + lens.cy, v[1] * lens.fy + lens.cy
    )


@wp.func
def clip_to_image(lens: Pinhole, bound: wp.vec4) -> wp.vec4i:
    """Returns the pixels within ``bound`` (lowest and highest x, lowest and highest y [px]) and within the drawn rows:
    first and last + 1 column, first and last + 1 row."""
    w = float(lens.width)
    low = float(lens.first_row)
    high = float(lens.end_row)
    return wp.vec4i(
        int(wp.clamp(bound[0] - 0.01, 0.0, w)),
        int(wp.clamp(bound[1] + 1.01, 0.0, w)),
        int(wp.clamp(bound[2] - 0.01, low, high)),
        int(wp.clamp(bound[3] + 1.01, low, high)),
    )
