"""Distance from points and segments to uneven ground, by the law of :class:`vinesim.scene.terrain.Terrain`."""

import warp as wp

from vinesim.kernels.contact.distance import vec5d
from vinesim.kernels.contact.structs import Hulls

wp.set_module_options({"enable_backward": False})

SEGMENT_POINTS = wp.constant(5)
"""Number of evenly spaced points of a segment, among which the one closest to the ground is searched. Neighbouring
points of a capsule are closer to each other than the ground's nodes."""


@wp.func
def ground_plane(hulls: Hulls, p: wp.vec3d):
    """Returns the upward normal (entries 0 to 2) of the ground's triangle below or above ``p`` [m], and the signed
    distance (3) [m] of ``p`` from the triangle's plane."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    cell = hulls.ground_frame[2]
    last_column = hulls.ground.shape[1] - 1
    last_row = hulls.ground.shape[0] - 1
    u = (p[0] - hulls.ground_frame[0]) / cell
    v = (p[1] - hulls.ground_frame[1]) / cell
    # beyond the grid the residual of the edge continues
    scale_x = wp.where(u >= zero and u <= wp.float64(last_column), one / cell, zero)
    scale_y = wp.where(v >= zero and v <= wp.float64(last_row), one / cell, zero)
    u = wp.clamp(u, zero, wp.float64(last_column))
    v = wp.clamp(v, zero, wp.float64(last_row))
    i = wp.min(int(u), last_column - 1)
    j = wp.min(int(v), last_row - 1)
    fx = u - wp.float64(i)
    fy = v - wp.float64(j)
    low = wp.float64(hulls.ground[j, i])
    high = wp.float64(hulls.ground[j + 1, i + 1])
    right = wp.float64(hulls.ground[j, i + 1])
    left = wp.float64(hulls.ground[j + 1, i])
    along_x = wp.where(fx >= fy, right - low, high - left)
    along_y = wp.where(fx >= fy, high - right, left - low)
    height = hulls.ground_frame[3] * p[0] + hulls.ground_frame[4] * p[1] + (low + fx * along_x + fy * along_y)
    normal = wp.normalize(
        wp.vec3d(-hulls.ground_frame[3] - scale_x * along_x, -hulls.ground_frame[4] - scale_y * along_y, one)
    )
    return wp.vec4d(normal[0], normal[1], normal[2], (p[2] - height) * normal[2])


@wp.func
def segment_ground_distance(hulls: Hulls, a: wp.vec3d, b: wp.vec3d):
    """Returns the world normal (entries 0 to 2) and distance (3) [m] from the ground to the segment a b, and the
    parameter (4) of its closest point, 0 to 1; the middle if all points are equally close."""
    flat = wp.float64(1.0e-9) * wp.length(b - a)
    t = wp.float64(0.5)
    best = ground_plane(hulls, a + t * (b - a))
    for k in range(SEGMENT_POINTS):
        share = wp.float64(k) / wp.float64(SEGMENT_POINTS - 1)
        plane = ground_plane(hulls, a + share * (b - a))
        if plane[3] < best[3] - flat:
            best = plane
            t = share
    return vec5d(best[0], best[1], best[2], best[3], t)
