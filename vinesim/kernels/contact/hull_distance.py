"""Distance from a segment to a convex hull, exact to rounding, by the hull's planes and edges.

If the segment enters the hull, the distance is the distance to the nearest plane, as for MuJoCo's primitives.
Otherwise, the closest points are at an end of the segment above the inside of a face, or on one of the hull's edges.
Edges are tested only if an end of the segment is in front of one of their two faces.
"""

import warp as wp

from vinesim.kernels.contact.distance import MIN_COPLANAR_COSINE, segment_segment_distance, vec5d
from vinesim.kernels.contact.structs import Hulls

wp.set_module_options({"enable_backward": False})

PLANE_STEPS = wp.constant(64)
"""Largest number of steps in the search for the deepest point of a segment. Each step takes another plane, so about
five are enough."""
HULL_TOLERANCE = wp.constant(wp.float64(1.0e-7))
"""[m] Distance beyond a face's border up to which a point counts as above the face, because vertices of a mesh are
rounded."""


@wp.func
def plane_gap(plane: wp.vec4d, p: wp.vec3d):
    """Returns the signed distance [m] of a point from a plane (outward normal, offset)."""
    return plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2] - plane[3]


@wp.func
def outermost_plane(hulls: Hulls, hull: int, p: wp.vec3d):
    """Returns the plane of a hull with the largest signed distance to a point."""
    best = hulls.first_plane[hull]
    most = plane_gap(hulls.plane[best], p)
    for k in range(best + 1, hulls.first_plane[hull + 1]):
        gap = plane_gap(hulls.plane[k], p)
        if gap > most:
            most = gap
            best = k
    return best


@wp.func
def is_above_face(hulls: Hulls, hull: int, face: int, p: wp.vec3d):
    """Returns whether the projection of point ``p`` onto the plane of a face is on that face."""
    plane = hulls.plane[face]
    foot = p - plane_gap(plane, p) * wp.vec3d(plane[0], plane[1], plane[2])
    inside = bool(True)
    for k in range(hulls.first_plane[hull], hulls.first_plane[hull + 1]):
        if plane_gap(hulls.plane[k], foot) > HULL_TOLERANCE:
            inside = False
    return inside


@wp.func
def deepest_place(hulls: Hulls, hull: int, a: wp.vec3d, b: wp.vec3d):
    """Returns the parameter (0 to 1) of the point of the segment a b that is deepest in the hull: its largest signed
    distance from the planes is smallest.

    The largest signed distance is the maximum of linear functions of the parameter. The search intersects a falling and
    a rising function. If a third function is larger at the intersection, it replaces one of the two.
    """
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    flat = wp.float64(1.0e-12)
    left = hulls.plane[outermost_plane(hulls, hull, a)]
    right = hulls.plane[outermost_plane(hulls, hull, b)]
    if plane_gap(left, b) - plane_gap(left, a) >= -flat:
        return zero
    if plane_gap(right, b) - plane_gap(right, a) <= flat:
        return one
    t = zero
    for _ in range(PLANE_STEPS):
        from_left = plane_gap(left, a)
        fall = plane_gap(left, b) - from_left
        from_right = plane_gap(right, a)
        rise = plane_gap(right, b) - from_right
        t = wp.clamp((from_left - from_right) / (rise - fall), zero, one)
        p = a + t * (b - a)
        third = hulls.plane[outermost_plane(hulls, hull, p)]
        if plane_gap(third, p) <= from_left + t * fall + flat:
            break
        slope = plane_gap(third, b) - plane_gap(third, a)
        if slope < -flat:
            left = third
        elif slope > flat:
            right = third
        else:
            break
    return t


@wp.func
def segment_hull_distance(hulls: Hulls, hull: int, a: wp.vec3d, b: wp.vec3d, reach: wp.float64):
    """Returns normal (entries 0 to 2) and distance (3) [m] from a hull to the segment a b, and the parameter (4) of its
    closest point, 0 to 1.

    All in the hull's frame. Beyond ``reach`` [m] the distance is a lower bound.
    """
    zero = wp.float64(0.0)
    along = b - a
    t = deepest_place(hulls, hull, a, b)
    p = a + t * along
    plane = hulls.plane[outermost_plane(hulls, hull, p)]
    gap = plane_gap(plane, p)
    found = vec5d(plane[0], plane[1], plane[2], gap, t)
    if gap > zero and gap <= reach:
        least = wp.float64(1.0e30)
        for end in range(2):
            q = wp.where(end == 0, a, b)
            face = outermost_plane(hulls, hull, q)
            height = plane_gap(hulls.plane[face], q)
            if height < least and is_above_face(hulls, hull, face, q):
                least = height
                under = hulls.plane[face]
                found = vec5d(under[0], under[1], under[2], height, wp.float64(end))
        for edge in range(hulls.first_edge[hull], hulls.first_edge[hull + 1]):
            first = hulls.plane[hulls.edge_left[edge]]
            second = hulls.plane[hulls.edge_right[edge]]
            seen = wp.max(
                wp.max(plane_gap(first, a), plane_gap(first, b)), wp.max(plane_gap(second, a), plane_gap(second, b))
            )
            if seen > zero:
                near = segment_segment_distance(a, b, hulls.edge_start[edge], hulls.edge_end[edge])
                if near[3] < least:
                    least = near[3]
                    n = wp.vec3d(near[0], near[1], near[2])
                    if near[3] < HULL_TOLERANCE:
                        n = wp.vec3d(plane[0], plane[1], plane[2])
                    found = vec5d(n[0], n[1], n[2], near[3], near[4])
    return found


@wp.func
def clip(ends: wp.vec2d, gap_a: wp.float64, gap_b: wp.float64):
    """Returns the part (0 to 1) of the interval ``ends`` in which a linear function, with the values ``gap_a`` at 0 and
    ``gap_b`` at 1, is not above 0."""
    change = gap_b - gap_a
    low = ends[0]
    high = ends[1]
    if change > wp.float64(0.0):
        high = wp.min(high, -gap_a / change)
    elif change < wp.float64(0.0):
        low = wp.max(low, -gap_a / change)
    elif gap_a > wp.float64(0.0):
        high = low
    return wp.vec2d(low, high)


@wp.func
def interval_along_hull(hulls: Hulls, hull: int, a: wp.vec3d, b: wp.vec3d, closest: vec5d, tolerance: wp.float64):
    """Returns the interval of the segment a b that runs along a face or an edge of a convex hull, as the parameters (0
    to 1) of its ends.

    Both parameters are that of the closest point if no face or edge is nearly parallel to the segment, or if the
    interval is shorter than twice ``tolerance``: one contact point is then enough. ``a``, ``b`` [m]: ends of the
    segment in the hull's frame. ``closest``: result of :func:`segment_hull_distance`. ``tolerance`` [m]: along a face,
    the interval contains the points that are at most this much farther from the face than the closest point is.
    """
    t = closest[4]
    along = b - a
    length = wp.length(along)
    single = wp.vec2d(t, t)
    ends = single
    normal = wp.vec3d(closest[0], closest[1], closest[2])
    steep = wp.abs(wp.dot(normal, along)) > wp.float64(0.5) * length
    if length < wp.float64(2.0) * tolerance or steep:
        return single
    face = int(-1)
    most = MIN_COPLANAR_COSINE
    for k in range(hulls.first_plane[hull], hulls.first_plane[hull + 1]):
        plane = hulls.plane[k]
        cosine = plane[0] * normal[0] + plane[1] * normal[1] + plane[2] * normal[2]
        if cosine > most:
            most = cosine
            face = k
    if face >= 0:
        plane = hulls.plane[face]
        up = wp.vec3d(plane[0], plane[1], plane[2])
        height_a = plane_gap(plane, a)
        height_b = plane_gap(plane, b)
        foot_a = a - height_a * up
        foot_b = b - height_b * up
        limit = closest[3] + tolerance
        ends = clip(wp.vec2d(wp.float64(0.0), wp.float64(1.0)), height_a - limit, height_b - limit)
        for k in range(hulls.first_plane[hull], hulls.first_plane[hull + 1]):
            if k != face:
                border = HULL_TOLERANCE
                ends = clip(
                    ends, plane_gap(hulls.plane[k], foot_a) - border, plane_gap(hulls.plane[k], foot_b) - border
                )
    else:
        for edge in range(hulls.first_edge[hull], hulls.first_edge[hull + 1]):
            start = hulls.edge_start[edge]
            end = hulls.edge_end[edge]
            axis = end - start
            if wp.abs(wp.dot(axis, along)) > MIN_COPLANAR_COSINE * wp.length(axis) * length:
                near = segment_segment_distance(a, b, start, end)
                if near[3] < closest[3] + HULL_TOLERANCE:
                    one_end = wp.clamp(wp.dot(start - a, along) / (length * length), wp.float64(0.0), wp.float64(1.0))
                    other = wp.clamp(wp.dot(end - a, along) / (length * length), wp.float64(0.0), wp.float64(1.0))
                    ends = wp.vec2d(wp.min(one_end, other), wp.max(one_end, other))
    if (ends[1] - ends[0]) * length < wp.float64(2.0) * tolerance:
        ends = single
    return ends
