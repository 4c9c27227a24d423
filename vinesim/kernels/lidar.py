"""Laser shots through the vineyard, in the order in which a lidar fires them."""

import warp as wp

from vinesim.kernels.rays import Hierarchies, first_hit
from vinesim.kernels.shapes import Shapes, normal_at

wp.set_module_options({"enable_backward": False, "fast_math": True})


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
