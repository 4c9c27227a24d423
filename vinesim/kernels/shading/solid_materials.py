"""Materials of solids: canes, bark, posts and wires; plastic, cloth, skin, paint, metal and glass."""

import warp as wp

from vinesim.kernels.raster.primitives import BOX, CONE, CYLINDER, SPHEROID, TRIANGLE, Shapes, as_quat, xyz
from vinesim.kernels.shading.materials import (
    BARK,
    CANE,
    CLOTH,
    GLASS,
    LAMP,
    METAL,
    OLD_BARK,
    PAINT,
    PLASTIC,
    POST,
    REFLEX,
    RUBBER,
    SKIN,
    STEM,
    STRAW,
    WIRE,
    Materials,
    Surface,
    diffuse_surface,
    mix,
    sample_bilinear,
    sample_nearest,
    smoothstep,
)

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.func
def unpack_normal(code: float) -> wp.vec3:
    """Returns the unit vector packed in one float: octahedral coordinates of eleven bits each, plus one."""
    k = int(code) - 1
    x = float(k % 2047) * (2.0 / 2046.0) - 1.0
    y = float(k / 2047) * (2.0 / 2046.0) - 1.0
    z = 1.0 - wp.abs(x) - wp.abs(y)
    fold = wp.max(-z, 0.0)
    return wp.normalize(wp.vec3(x - wp.where(x >= 0.0, fold, -fold), y - wp.where(y >= 0.0, fold, -fold), z))


@wp.func
def smooth_normal(g: Shapes, i: int, p: wp.vec3) -> wp.vec3:
    """Returns the shading normal of triangle ``i`` at ``p`` [m], interpolated between the normals at its corners."""
    a4 = g.a[i]
    b4 = g.b[i]
    c4 = g.c[i]
    ab = xyz(b4) - xyz(a4)
    ac = xyz(c4) - xyz(a4)
    ap = p - xyz(a4)
    n = wp.cross(ab, ac)
    if a4[3] > 0.0:
        whole = wp.dot(n, n)
        v = wp.clamp(wp.dot(wp.cross(ap, ac), n) / whole, 0.0, 1.0)
        w = wp.clamp(wp.dot(wp.cross(ab, ap), n) / whole, 0.0, 1.0)
        mixed = unpack_normal(a4[3]) * (1.0 - v - w) + unpack_normal(b4[3]) * v + unpack_normal(c4[3]) * w
        n = wp.quat_rotate(as_quat(g.d[i]), mixed)
    return wp.normalize(n)


@wp.struct
class SolidPoint:
    """Properties of one point of a solid that materials need: normal, position along the grain, visible sky."""

    normal: wp.vec3
    grain: wp.vec3
    """Position across (x, y) and along (z) the grain of the material [m]."""
    sky: float
    """Share of the sky that is visible from the point."""


@wp.func
def solid_point(g: Shapes, materials: Materials, i: int, p: wp.vec3) -> SolidPoint:
    """Returns normal, position in the grain and visible sky at ``p`` [m] of primitive ``i``, which is not a leaf."""
    kind = g.kind[i]
    a4 = g.a[i]
    b4 = g.b[i]
    c4 = g.c[i]
    a = xyz(a4)
    n = wp.vec3(0.0, 0.0, 1.0)
    grain = p  # position along and across the grain
    sky = materials.sky[i]
    if kind == CONE or kind == CYLINDER:
        ba = xyz(b4) - a
        h = wp.clamp(wp.dot(p - a, ba) / wp.dot(ba, ba), 0.0, 1.0)
        out = p - a - ba * h
        length = wp.length(ba)
        along = ba / length
        if c4[3] > 0.0:
            sky = sky * (1.0 - h) + c4[2] * h
        if kind == CYLINDER:
            n = wp.normalize(out)
            if h <= 1.0e-4:
                n = -along
            if h >= 0.9999:
                n = along
        else:
            n = wp.normalize(wp.normalize(out) + along * ((a4[3] - b4[3]) / length))
        if wp.abs(along[2]) < 0.7:
            grain = wp.vec3(out[2], wp.dot(out, wp.vec3(-along[1], along[0], 0.0)), c4[0] + h * length)
        else:
            grain = wp.vec3(0.8 * out[0] + 0.6 * out[1], 0.8 * out[1] - 0.6 * out[0], c4[0] + h * length)
    elif kind == SPHEROID:
        n = wp.normalize(p - a)
    elif kind == TRIANGLE:
        n = smooth_normal(g, i, p)
        grain = wp.quat_rotate_inv(as_quat(g.d[i]), p)
    else:
        q = as_quat(b4)
        grain = wp.quat_rotate_inv(q, p - a)
        half = wp.vec3(a4[3], c4[0], c4[1])
        if kind == BOX:  # edges rounded by 4 mm
            e = wp.vec3(wp.abs(grain[0]) - half[0], wp.abs(grain[1]) - half[1], wp.abs(grain[2]) - half[2])
            n = wp.vec3(
                wp.max(e[0] + 0.004, 0.0) * wp.sign(grain[0]),
                wp.max(e[1] + 0.004, 0.0) * wp.sign(grain[1]),
                wp.max(e[2] + 0.004, 0.0) * wp.sign(grain[2]),
            )
            n = wp.quat_rotate(q, wp.normalize(n))
        else:
            n = wp.normalize(wp.quat_rotate(q, wp.cw_div(grain, wp.cw_mul(half, half))))
    o = SolidPoint()
    o.normal = n
    o.grain = grain
    o.sky = sky
    return o


@wp.func
def bark_surface(materials: Materials, s: Surface, old: bool, grain: wp.vec3, seed: float, pixel: float) -> Surface:
    """Returns surface ``s`` with the look of bark: fibrous strips of unlike width that cross, break off and peel.

    Fissures of ``old`` bark are deeper. ``grain``, ``seed``, ``pixel``: as in :func:`woody_surface`.
    """
    tint = s.albedo
    clear = 1.0 / (1.0 + pixel * 250.0)
    bow = sample_bilinear(
        materials.noise_texture, grain[2] * 0.9 + grain[0] * 1.9 + seed, grain[1] * 1.9 - grain[2] * 0.6
    )
    x = grain[0] + 0.022 * (bow[1] - 0.5)
    y = grain[1] + 0.022 * (bow[2] - 0.5)
    wide = sample_bilinear(materials.noise_texture, x * 7.5 + y * 2.1 + seed, grain[2] * 0.7 + y * 2.4 + x * 0.9)
    fine = sample_bilinear(
        materials.noise_texture, x * 13.0 - y * 10.0 - seed, grain[2] * 1.0 + (x + y) * 2.2 + seed * 0.7
    )
    height = 0.5 + ((0.40 * wide[2] + 0.26 * wide[3] + 0.34 * fine[2] + 0.25 * (bow[1] - 0.5)) - 0.5) * clear
    ridge = smoothstep(0.36, 0.64, height)
    relief = float(1.1)
    if old:
        grey = (tint[0] + tint[1] + tint[2]) / 3.0
        s.albedo = mix(tint, wp.vec3(grey, grey, grey), 0.3 + 0.6 * wide[0]) * (
            (0.70 + 0.42 * ridge) * (0.82 + 0.36 * wide[1])
        )
        s.albedo = mix(s.albedo, wp.vec3(0.175, 0.165, 0.150), 0.45 * smoothstep(0.46, 0.72, wide[0]) * ridge)
        # inner bark where a strip has come off
        s.albedo = mix(s.albedo, wp.vec3(0.115, 0.080, 0.056), 0.4 * smoothstep(0.60, 0.74, bow[1]))
        relief = 1.3
    else:
        s.albedo = mix(materials.colours.bark_dark, materials.colours.bark_light, ridge) * (0.7 + 0.6 * wide[1])
    s.occlusion = 0.5 + 0.5 * smoothstep(0.34, 0.50, height)
    s.normal = wp.normalize(
        s.normal
        + wp.vec3(wide[2] + 0.7 * fine[3] - 0.85, fine[2] + 0.5 * wide[3] - 0.75, bow[2] + 0.6 * fine[1] - 0.8)
        * (relief * clear)
    )
    s.specular = 0.009
    return s


@wp.func
def woody_surface(
    materials: Materials, s: Surface, material: int, grain: wp.vec3, seed: float, p: wp.vec3, pixel: float
) -> Surface:
    """Returns surface ``s`` with the look of a cane, bark or a post: relief and colour by noise along the grain.

    ``grain``: position across (x, y) and along (z) the grain [m]; ``p``: position in the world [m]; ``pixel``: size of
    a pixel on the surface [m].
    """
    tint = s.albedo
    n = s.normal
    near = pixel < 0.004
    if material == CANE:
        if near:
            # fine ribs along the cane, patches of unlike ripeness, dark specks
            rib = sample_bilinear(
                materials.noise_texture, grain[0] * 12.0 + grain[1] * 9.5 + seed, grain[2] * 0.6 + seed * 3.1
            )
            patch = sample_bilinear(
                materials.noise_texture, grain[2] * 0.9 + seed * 1.7, grain[0] * 2.5 + grain[1] * 3.5 + seed
            )
            clear = 1.0 / (1.0 + pixel * 400.0)
            s.albedo = tint * (1.0 + clear * (0.9 * (rib[2] - 0.5) + 0.5 * (rib[3] - 0.5)) + 0.7 * (patch[1] - 0.5))
            s.albedo = mix(
                s.albedo, materials.colours.blotch, 0.55 * smoothstep(0.46, 0.74, patch[0] * 0.6 + rib[0] * 0.4)
            )
            # weathered streaks along the cane
            share = 0.75 * smoothstep(0.46, 0.62, 0.7 * rib[1] + 0.3 * patch[2])
            grey = 0.36 * (s.albedo[0] + s.albedo[1] + s.albedo[2])
            s.albedo = mix(s.albedo, wp.vec3(grey, grey, grey), share)
            s.normal = wp.normalize(n + wp.vec3(rib[1] - 0.5, rib[2] - 0.5, rib[3] - 0.5) * (0.7 * clear))
        s.shininess = 14.0
    elif material == BARK or material == OLD_BARK:
        s = bark_surface(materials, s, material == OLD_BARK, grain, seed, pixel)
    elif material == POST:
        wide = sample_bilinear(materials.noise_texture, grain[0] * 1.7 + grain[1] * 1.3 + seed, grain[2] * 0.35)
        fine = sample_nearest(materials.noise_texture, grain[0] * 6.0 + grain[1] * 5.0, grain[2] * 0.9 + seed)
        s.albedo = (
            tint * (0.55 + 0.55 * wide[1] + 0.35 * fine[2]) * (1.0 - 0.45 * smoothstep(0.35, 0.0, p[2]) * wide[0])
        )
        s.normal = wp.normalize(n + wp.vec3(fine[1] - 0.5, fine[2] - 0.5, 0.0) * 0.5)
        s.specular = 0.02
    return s


@wp.func
def made_surface(materials: Materials, s: Surface, material: int, grain: wp.vec3, seed: float, pixel: float) -> Surface:
    """Returns surface ``s`` with the look of a manufactured material or of skin: gloss, colour and folds.

    ``grain``: position across (x, y) and along (z) the grain [m]; ``pixel``: size of a pixel on the surface [m].
    """
    tint = s.albedo
    n = s.normal
    near = pixel < 0.004
    if material == WIRE:
        s.specular = 0.35
        s.shininess = 30.0
        s.reflectivity = 0.5
    elif material == PLASTIC:
        t = sample_nearest(materials.noise_texture, grain[0] * 2.0 + grain[2], grain[1] * 2.0 + grain[2])
        s.albedo = tint * (0.85 + 0.3 * t[1])
        s.specular = 0.045
        s.shininess = 45.0
        s.reflectivity = 0.6
    elif material == CLOTH:
        wide = sample_bilinear(materials.noise_texture, grain[0] * 1.4 + seed, grain[2] * 1.1 + grain[1] * 0.9)
        s.albedo = tint * (0.78 + 0.45 * wide[0])
        s.normal = wp.normalize(n + wp.vec3(wide[0] - 0.5, wide[1] - 0.5, (wide[2] - 0.5) * 0.7) * 0.9)
        s.specular = 0.008
        s.wrap = wp.vec3(0.15, 0.15, 0.15)
    elif material == SKIN:
        s.wrap = wp.vec3(0.35, 0.15, 0.10)
        s.shininess = 14.0
    elif material == PAINT:
        s.specular = 0.05
        s.shininess = 80.0
        s.reflectivity = 0.4
    elif material == LAMP:
        s.emission = 3.0
    elif material == RUBBER:
        s.specular = 0.03
        s.shininess = 8.0
    elif material == METAL:
        s.albedo = tint * 0.55
        s.specular = 0.45
        s.shininess = 40.0
        s.reflectivity = 0.7
    elif material == STRAW:
        if near:
            t = sample_nearest(
                materials.noise_texture, grain[0] * 9.0 + grain[2] * 5.0, grain[1] * 9.0 - grain[2] * 5.0
            )
            s.albedo = tint * (0.70 + 0.5 * t[3])
            s.normal = wp.normalize(n + wp.vec3(t[3] - 0.5, t[2] - 0.5, 0.0) * 0.5)
        s.transmission = tint * 0.25
        s.specular = 0.02
    elif material == REFLEX:
        s.specular = 0.12
        s.shininess = 20.0
        s.reflectivity = 0.5
    elif material == GLASS:
        s.specular = 0.05
        s.shininess = 250.0
        s.reflectivity = 1.0
    elif material == STEM:
        s.transmission = tint * 0.3
    return s


@wp.func
def solid_surface(g: Shapes, materials: Materials, i: int, p: wp.vec3, pixel: float) -> Surface:
    """Returns the surface of primitive ``i``, neither leaf nor berry, at ``p`` [m]; ``pixel`` [m] is a pixel's size
    there."""
    o = solid_point(g, materials, i, p)
    material = materials.material[i]
    seed = g.c[i][1]
    s = diffuse_surface(o.normal, materials.tint[i], o.sky)
    if material == CANE or material == BARK or material == POST or material == OLD_BARK:
        s = woody_surface(materials, s, material, o.grain, seed, p, pixel)
    else:
        s = made_surface(materials, s, material, o.grain, seed, pixel)
    if material != WIRE:
        s.occlusion = s.occlusion * (0.55 + 0.45 * smoothstep(0.0, 0.35, p[2] + wp.max(o.normal[2], 0.0) * 0.35))
    return s
