"""Rays against the primitives through a bounding volume hierarchy: lidars, and the oracle of the rasteriser.

Plants and links have one hierarchy each, asked one after the other: plants only sway, so theirs stays good for ever
under refits, and a robot that drives through the rows does not stretch it.
"""

import warp as wp

from vinesim.kernels.shapes import (
    BOX,
    CONE,
    CYLINDER,
    FAR,
    LEAF,
    SPHEROID,
    TRIANGLE,
    Shapes,
    as_quat,
    hit,
    squeeze,
    xyz,
)
from vinesim.kernels.visibility import SMOOTH_SIZE, Pinhole, ray_of

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class Hierarchies:
    """Bounding volumes of plants (primitives from 0) and of links (primitives from ``first_rigid``)."""

    plants: wp.uint64
    rigid: wp.uint64
    first_rigid: int
    """Negative where there are no links."""


@wp.struct
class Hit:
    t: float
    primitive: int
    """-2 the ground, -1 nothing."""


@wp.func
def smooth_from(s: Shapes, i: int, depth_scale: float, forward: wp.vec3, eye: wp.vec3) -> int:
    """Whether a leaf's outline is interpolated, by the rasteriser's rule; never without a focal length."""
    a4 = s.a[i]
    smooth = wp.int32(0)
    if s.kind[i] == LEAF and depth_scale > 0.0:
        if a4[3] * depth_scale > wp.dot(xyz(a4) - eye, forward) * SMOOTH_SIZE:
            smooth = 1
    return smooth


@wp.func
def first_hit(h: Hierarchies, s: Shapes, o: wp.vec3, d: wp.vec3, reach: float, focal: float, forward: wp.vec3) -> Hit:
    """Nearest primitive or ground along a ray; ``t`` in lengths of ``d``."""
    best = Hit()
    best.t = reach
    best.primitive = -1
    if d[2] < -1.0e-6 and o[2] > 0.0:
        t = -o[2] / d[2]
        if t < best.t:
            best.t = t
            best.primitive = -2
    i = wp.int32(0)
    query = wp.bvh_query_ray(h.plants, o, d)
    while wp.bvh_query_next(query, i, best.t):
        t = hit(s, i, o, d, smooth_from(s, i, focal, forward, o))
        if t < best.t:
            best.t = t
            best.primitive = i
    if h.first_rigid >= 0:
        j = wp.int32(0)
        other = wp.bvh_query_ray(h.rigid, o, d)
        while wp.bvh_query_next(other, j, best.t):
            t = hit(s, h.first_rigid + j, o, d, 0)
            if t < best.t:
                best.t = t
                best.primitive = h.first_rigid + j
    return best


@wp.func
def normal_at(s: Shapes, i: int, p: wp.vec3) -> wp.vec3:
    """Outward normal of primitive ``i`` at a point of its surface; of a leaf, its upper side."""
    kind = s.kind[i]
    a4 = s.a[i]
    b4 = s.b[i]
    c4 = s.c[i]
    a = xyz(a4)
    n = wp.vec3(0.0, 0.0, 1.0)
    if kind == LEAF:
        bend = s.d[i]
        rib = xyz(b4)
        up = xyz(c4)
        side = wp.cross(rib, up)
        u = wp.dot(p - a, side) / a4[3]
        v = wp.dot(p - a, rib) / a4[3]
        n = side * (-2.0 * bend[0] * u - wp.where(u > 0.0, bend[2], -bend[2])) + rib * (-2.0 * bend[1] * v) + up
    elif kind == SPHEROID:
        k = 1.0 / b4[3] - 1.0
        n = squeeze(squeeze(p - a, xyz(b4), k), xyz(b4), k)
    elif kind == CONE or kind == CYLINDER:
        ba = xyz(b4) - a
        h = wp.dot(p - a, ba) / wp.dot(ba, ba)
        n = p - a - ba * wp.clamp(h, 0.0, 1.0)
        if kind == CYLINDER and (h < 1.0e-4 or h > 0.9999):
            n = ba * wp.where(h < 0.5, -1.0, 1.0)
    elif kind == TRIANGLE:
        n = wp.cross(xyz(b4) - a, xyz(c4) - a)
    else:
        q = as_quat(b4)
        e = wp.cw_div(wp.quat_rotate_inv(q, p - a), wp.vec3(a4[3], c4[0], c4[1]))
        if kind == BOX:
            m = wp.max(wp.max(wp.abs(e[0]), wp.abs(e[1])), wp.abs(e[2])) * 0.9999
            n = wp.vec3(
                wp.where(wp.abs(e[0]) >= m, wp.sign(e[0]), 0.0),
                wp.where(wp.abs(e[1]) >= m, wp.sign(e[1]), 0.0),
                wp.where(wp.abs(e[2]) >= m, wp.sign(e[2]), 0.0),
            )
        else:
            n = wp.cw_div(e, wp.vec3(a4[3], c4[0], c4[1]))
        n = wp.quat_rotate(q, n)
    return wp.normalize(n)


@wp.kernel
def cast(
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
    """One thread follows one ray to what it meets first (-2 ground, -1 nothing)."""
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
    """One thread follows the ray of one pixel: what the rasteriser must find too."""
    pixel = wp.tid()
    back = wp.transpose(lens.turn)
    d = back * ray_of(lens, pixel % lens.width, pixel // lens.width)
    best = first_hit(hierarchies, shapes, lens.eye, d, lens.reach, lens.fx, back * wp.vec3(0.0, 0.0, 1.0))
    depth_out[pixel] = wp.where(best.primitive == -1, FAR, best.t)
    primitive_out[pixel] = best.primitive


@wp.kernel
def sweep(
    # model
    shapes: Shapes,
    label: wp.array(dtype=wp.int32),
    organ: wp.array(dtype=wp.int32),
    reflectance: wp.array(dtype=wp.float32),
    elevation: wp.array(dtype=wp.float32),
    # in
    hierarchies: Hierarchies,
    pose: wp.transform,
    azimuth: wp.array(dtype=wp.float32),
    ground_label: int,
    ground_organ: int,
    nearest: float,
    farthest: float,
    run: int,
    # out
    xyz_out: wp.array(dtype=wp.vec3),
    intensity_out: wp.array(dtype=wp.float32),
    label_out: wp.array(dtype=wp.int32),
):
    """One thread fires ``run`` shots, one laser after the other; label -1 where nothing returned."""
    first = wp.tid() * run
    for i in range(first, first + run):
        lasers = elevation.shape[0]
        e = elevation[i % lasers]
        a = azimuth[i]
        d = wp.vec3(wp.cos(e) * wp.cos(a), wp.cos(e) * wp.sin(a), wp.sin(e))
        o = wp.transform_get_translation(pose)
        ray = wp.quat_rotate(wp.transform_get_rotation(pose), d)
        best = first_hit(hierarchies, shapes, o, ray, farthest, 0.0, ray)
        name = wp.int32(-1)
        bright = wp.float32(0.0)
        if best.primitive != -1 and best.t >= nearest:
            n = wp.vec3(0.0, 0.0, 1.0)
            name = ground_label
            matter = ground_organ
            if best.primitive >= 0:
                n = normal_at(shapes, best.primitive, o + ray * best.t)
                name = label[best.primitive]
                matter = organ[best.primitive]
            bright = 100.0 * reflectance[matter] * wp.abs(wp.dot(n, ray))
        xyz_out[i] = d * best.t
        intensity_out[i] = wp.clamp(bright, 0.0, 255.0)
        label_out[i] = name
