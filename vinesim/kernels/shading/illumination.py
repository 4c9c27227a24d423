"""Illumination of the surface in each pixel, for multispectral cameras, whose bands are not red, green and blue.

The illumination is the light of the RGB renderer, averaged over its three colours and without the surface's albedo. Its
unit is the light on a level white panel in the open.
"""

import warp as wp

from vinesim.kernels.raster.ground import is_uneven
from vinesim.kernels.raster.pinhole import Pinhole
from vinesim.kernels.raster.primitives import LEAF, Shapes
from vinesim.kernels.shading.deferred import Light, ambient_light, seen_surface, shadow_turn, sun_share
from vinesim.kernels.shading.materials import Materials
from vinesim.kernels.shading.shadow_maps import ShadowMap

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.func
def grey(colour: wp.vec3) -> float:
    return (colour[0] + colour[1] + colour[2]) / 3.0


@wp.kernel
def illuminate_pixels(
    # model
    shapes: Shapes,
    materials: Materials,
    # in
    light: Light,
    near: ShadowMap,
    far: ShadowMap,
    lens: Pinhole,
    primitive: wp.array(dtype=wp.int32),
    keys: wp.array(dtype=wp.int64),
    transmission: float,
    run: int,
    # out
    light_out: wp.array(dtype=wp.float32),
    sod_out: wp.array(dtype=wp.float32),
):
    """One thread computes the illumination of the surfaces in ``run`` neighbouring pixels.

    Threads begin at row ``lens.first_row``. primitive: [pixel] -1 the sky, -2 the ground; keys: [pixel] depth [um] in
    the upper 32 bits; near, far: shadow maps; transmission: transmittance of a leaf divided by its reflectance; light:
    [pixel] illumination relative to that of a level white panel in the open, 1 for the sky; sod: [pixel] share of sod
    on the ground, 0 elsewhere.
    """
    panel = grey(light.sun_colour) * wp.max(light.sun[2], 0.05) + grey(light.sky_colour)
    back = wp.transpose(lens.rotation)
    first = lens.first_row * lens.width + wp.tid() * run
    for pixel in range(first, first + run):
        i = primitive[pixel]
        lux = float(1.0)
        sod = float(0.0)
        if i != -1:
            top = pixel // lens.width
            left = pixel - top * lens.width
            ray = back * wp.vec3((float(left) - lens.cx) / lens.fx, (float(top) - lens.cy) / lens.fy, 1.0)
            z = float(keys[pixel] >> wp.int64(32)) * 1.0e-6
            if i == -2 and not is_uneven(materials.ground):
                z = -lens.eye[2] / ray[2]
            scale = wp.length(ray)
            d = ray / scale
            p = lens.eye + ray * z
            footprint = z / lens.fx
            s = seen_surface(shapes, materials, i, p, d, footprint, footprint * z * scale / lens.eye[2])
            n = s.normal
            plain = s.geometric_normal
            through = float(0.0)
            if i == -2:
                ratio = s.albedo[1] / wp.max(s.albedo[0], 1.0e-6)
                bare = materials.colours.soil_ratio
                sod = wp.clamp((ratio - bare) / (materials.colours.sod_ratio - bare), 0.0, 1.0)
            elif shapes.kind[i] == LEAF:
                through = transmission
                if wp.dot(plain, d) > 0.0:
                    n = -n
                    plain = -plain
            ndl = wp.dot(n, light.sun)
            lit = sun_share(light, near, far, s, p, plain, shadow_turn(light, left, top))
            direct = (wp.max(ndl, 0.0) + wp.max(-ndl, 0.0) * through) * lit * (0.35 + 0.65 * s.occlusion)
            ambient = grey(ambient_light(light, n, s.sky)) + grey(ambient_light(light, -n, s.sky)) * through
            lux = (direct * grey(light.sun_colour) + ambient * s.occlusion) / panel
        light_out[pixel] = lux
        sod_out[pixel] = sod
