"""Ray caster: intersects rays with the primitives by bounding volume hierarchies; reference of the rasterisers.

Plants and robot links have one hierarchy each, and each ray is tested against both. Plants only sway, so refitting
never degrades their hierarchy, and a robot that drives through the rows does not stretch it.
"""

import warp as wp

from vinesim.kernels.raster.ground import Ground, ground_hit, is_uneven
from vinesim.kernels.raster.pinhole import SMOOTH_SIZE, Pinhole, pixel_ray
from vinesim.kernels.raster.primitives import FAR, LEAF, Shapes, hit_primitive, xyz

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class Hierarchies:
    """Ids of two Warp BVHs: of plants (primitives 0 to ``first_rigid`` - 1) and of rigid links (all later primitives);
    and the ground."""

    plants: wp.uint64
    rigid: wp.uint64
    first_rigid: int
    """Index of the first primitive of a link. Negative if there are no links."""
    ground: Ground


@wp.struct
class Hit:
    t: float
    primitive: int
    """Index of the primitive that was hit; -2: the ground, -1: no hit."""


@wp.func
def needs_smooth_outline(s: Shapes, i: int, depth_scale: float, forward: wp.vec3, eye: wp.vec3) -> int:
    """Returns 1 if leaf ``i`` is so large in the picture that the rasteriser interpolates its outline, else 0.

    ``depth_scale``: focal length [px], 0 for rays without a camera; ``forward``: optical axis; ``eye``: [m].
    """
    a4 = s.a[i]
    smooth = wp.int32(0)
    if s.kind[i] == LEAF and depth_scale > 0.0:
        if a4[3] * depth_scale > wp.dot(xyz(a4) - eye, forward) * SMOOTH_SIZE:
            smooth = 1
    return smooth


@wp.func
def first_hit(h: Hierarchies, s: Shapes, o: wp.vec3, d: wp.vec3, reach: float, focal: float, forward: wp.vec3) -> Hit:
    """Returns the nearest hit with a primitive or the ground along the ray from ``o`` in direction ``d``.

    ``reach``: farthest hit, like ``Hit.t`` in lengths of ``d``; ``focal`` and ``forward``: focal length [px] and
    optical axis of a camera, for :func:`needs_smooth_outline`.
    """
    best = Hit()
    best.t = reach
    best.primitive = -1
    if is_uneven(h.ground):
        t = ground_hit(h.ground, o, d, best.t)
        if t < best.t:
            best.t = t
            best.primitive = -2
    elif d[2] < -1.0e-6 and o[2] > 0.0:
        t = -o[2] / d[2]
        if t < best.t:
            best.t = t
            best.primitive = -2
    i = wp.int32(0)
    query = wp.bvh_query_ray(h.plants, o, d)
    while wp.bvh_query_next(query, i, best.t):
        t = hit_primitive(s, i, o, d, needs_smooth_outline(s, i, focal, forward, o))
        if t < best.t:
            best.t = t
            best.primitive = i
    if h.first_rigid >= 0:
        j = wp.int32(0)
        other = wp.bvh_query_ray(h.rigid, o, d)
        while wp.bvh_query_next(other, j, best.t):
            t = hit_primitive(s, h.first_rigid + j, o, d, 0)
            if t < best.t:
                best.t = t
                best.primitive = h.first_rigid + j
    return best


@wp.kernel
def cast_rays(
    # model
    shapes: Shapes,
    # in
    hierarchies: Hierarchies,
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    reach: float,
    # out
    distance_out: wp.array(dtype=wp.float32),
    primitive_out: wp.array(dtype=wp.int32),
):
    """One thread finds the first primitive that one ray hits.

    origin: [ray] start of each ray [m]. direction: [ray] vectors of any length. reach: largest distance of a hit, in
    lengths of ``direction``. distance_out: [ray] distance to the hit, in lengths of ``direction``; FAR without a hit.
    primitive_out: [ray] index of the primitive that was hit; -2: the ground, -1: no hit.
    """
    i = wp.tid()
    best = first_hit(hierarchies, shapes, origin[i], direction[i], reach, 0.0, direction[i])
    distance_out[i] = wp.where(best.primitive == -1, FAR, best.t)
    primitive_out[i] = best.primitive


@wp.kernel
def cast_camera(
    # model
    shapes: Shapes,
    # in
    hierarchies: Hierarchies,
    lens: Pinhole,
    # out
    depth_out: wp.array(dtype=wp.float32),
    primitive_out: wp.array(dtype=wp.int32),
):
    """One thread finds the nearest hit of one pixel's ray; the result is the reference for the rasteriser.

    depth: [pixel] m along the optical axis, FAR without a hit; primitive: [pixel] index, -2 the ground, -1 no hit.
    """
    pixel = wp.tid()
    back = wp.transpose(lens.rotation)
    d = back * pixel_ray(lens, pixel % lens.width, pixel // lens.width)
    best = first_hit(hierarchies, shapes, lens.eye, d, lens.max_depth, lens.fx, back * wp.vec3(0.0, 0.0, 1.0))
    depth_out[pixel] = wp.where(best.primitive == -1, FAR, best.t)
    primitive_out[pixel] = best.primitive
