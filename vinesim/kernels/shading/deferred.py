"""Deferred shading of the primitives that the rasteriser found: light of sun, sky, canopy and ground, then exposure and
tone.

Light is linear RGB. Ambient light has three parts: sky light through the gaps of the canopy (baked leaf area,
Beer-Lambert), green light through leaves, and light that the ground reflects. Leaves transmit sunlight. Berries have
bloom, transmit light when they are pale, and are darker where they touch other berries.
"""

import warp as wp

from vinesim.kernels.raster.ground import ground_gradient, is_uneven
from vinesim.kernels.raster.pinhole import Pinhole
from vinesim.kernels.raster.primitives import LEAF, SPHEROID, Shapes
from vinesim.kernels.shading.materials import (
    BERRY,
    Materials,
    Surface,
    berry_surface,
    ground_surface,
    leaf_surface,
    mix,
    sample_bilinear,
    smoothstep,
)
from vinesim.kernels.shading.shadow_maps import ShadowMap, sun_visibility
from vinesim.kernels.shading.solid_materials import solid_surface

wp.set_module_options({"enable_backward": False, "fast_math": True})

WHITE_POINT = wp.constant(3.0)
"""Exposed radiance (relative, linear) that the tone curve maps to nearly white; larger radiance is clipped to it."""
MIN_METERED_LUMINANCE = wp.constant(0.02)
MAX_METERED_LUMINANCE = wp.constant(2.0)
"""Largest luminance for the exposure meter: brighter pixels count as this bright. Pixels darker than
``MIN_METERED_LUMINANCE`` count as that bright.
"""


@wp.struct
class Light:
    """Colours of sun, sky, ground and canopy light (linear RGB), the direction to the sun, and shadow sampling."""

    sun: wp.vec3
    sun_colour: wp.vec3
    sky_colour: wp.vec3
    ground_colour: wp.vec3
    """Linear RGB of the light that the ground reflects."""
    canopy_colour: wp.vec3
    """Linear RGB of the green light that leaves transmit."""
    haze_colour: wp.vec3
    haze_rate: float
    """Rate [1/m] at which surfaces fade into the haze with distance."""
    flash: float
    """Radiance of a white sheet that faces the camera at 1 m, lit by a flash at the lens; 0: no flash."""
    shadow_taps: int
    """Number of samples of the shadow map for each pixel; 0 means a smooth filter of two widths, -1 of one width."""
    sample_spiral: wp.array(dtype=wp.vec2)
    """[taps] offsets of shadow samples: Vogel's spiral in the unit disc."""
    sample_rotations: wp.array(dtype=wp.vec2)
    """[64] cosine and sine of the angles by which pixels turn the spiral of shadow samples."""
    sky_table: wp.array2d(dtype=wp.vec3)


@wp.func
def fast_atan2(y: float, x: float) -> float:
    """Returns atan2(y, x) [rad] with an error below 1e-4 rad; it has no branch, so that it vectorises."""
    ax = wp.abs(x)
    ay = wp.abs(y)
    a = wp.min(ax, ay) / wp.max(wp.max(ax, ay), 1.0e-9)
    q = a * a
    r = ((-0.0464964749 * q + 0.15931422) * q - 0.327622764) * q * a + a
    r = wp.where(ay > ax, 1.57079637 - r, r)
    r = wp.where(x < 0.0, 3.14159274 - r, r)
    return wp.where(y < 0.0, -r, r)


@wp.func
def sky_radiance(light: Light, d: wp.vec3) -> wp.vec3:
    rows = light.sky_table.shape[0]
    columns = light.sky_table.shape[1]
    x = (fast_atan2(d[1], d[0]) * 0.15915494 + 0.5) * float(columns - 1)
    y = wp.sqrt(wp.max(d[2], 0.0)) * float(rows - 1)
    i = wp.clamp(int(x), 0, columns - 2)
    j = wp.clamp(int(y), 0, rows - 2)
    fx = x - float(i)
    fy = y - float(j)
    low = light.sky_table[j, i] * (1.0 - fx) + light.sky_table[j, i + 1] * fx
    high = light.sky_table[j + 1, i] * (1.0 - fx) + light.sky_table[j + 1, i + 1] * fx
    return low * (1.0 - fy) + high * fy


@wp.func
def ambient_light(light: Light, n: wp.vec3, sky: float) -> wp.vec3:
    """Returns the ambient light (linear RGB) on a surface with normal ``n`` that can see the share ``sky`` of the sky.

    It is the sum of sky light through the gaps of the canopy, green light through leaves, and light from the ground.
    """
    up = 0.5 + 0.5 * n[2]
    above = light.sky_colour * (sky * sky) + light.canopy_colour * (1.0 - sky)
    return above * (0.25 + 0.75 * up) + light.ground_colour * ((1.0 - up) * (0.35 + 0.65 * sky))


@wp.func
def reflected_light(materials: Materials, light: Light, r: wp.vec3, sky: float) -> wp.vec3:
    """Returns the radiance that a glossy surface mirrors in the direction ``r``; ``sky`` is the share of visible sky.

    The surroundings are a model: above the horizon a dark canopy with gaps of sky, below it the ground.
    """
    t = sample_bilinear(materials.noise_texture, r[0] * 0.16 + r[2] * 0.09, r[1] * 0.16 - r[2] * 0.07)
    hole = smoothstep(0.50 - 0.30 * sky, 0.78 - 0.30 * sky, t[1])
    above = mix(light.canopy_colour * 0.4, light.sky_colour * 1.3, hole)
    return mix(light.ground_colour * 0.8, above, smoothstep(-0.25, 0.25, r[2]))


@wp.func
def specular_light(
    materials: Materials, light: Light, s: Surface, kind: int, d: wp.vec3, n: wp.vec3, ndl: float, lit: float
) -> wp.vec3:
    """Returns the sun's highlight plus the mirrored surroundings (Schlick's Fresnel term), seen along the unit ray
    ``d``.

    ``n``: unit normal that faces the camera; ``ndl``: cosine between ``n`` and the direction to the sun; ``lit``:
    visible share of the sun's disc.
    """
    colour = wp.vec3(0.0, 0.0, 0.0)
    grazing = 1.0 - wp.max(-wp.dot(n, d), 0.0)
    g2 = grazing * grazing
    fresnel = s.specular + (1.0 - s.specular) * g2 * g2 * grazing * wp.min(s.specular * 14.0, 1.0) * 0.8
    if lit > 0.0 and ndl > -0.05:
        half = wp.normalize(light.sun - d)
        peak = 1.0 - wp.max(wp.dot(n, half), 0.0)
        if s.shininess * peak < 8.0:
            colour += light.sun_colour * (
                fresnel * wp.exp(-s.shininess * peak) * (s.shininess * 0.14 + 0.4) * lit * (ndl + 0.05)
            )
    if s.reflectivity * fresnel > 0.006:
        r = d - n * (2.0 * wp.dot(n, d))
        if kind == LEAF:
            above = mix(light.canopy_colour * 0.45, light.sky_colour, s.sky * s.sky)
            colour += mix(light.ground_colour, above, 0.5 + 0.5 * r[2]) * (
                wp.min(fresnel, 0.16) * s.reflectivity * s.occlusion
            )
        else:
            colour += reflected_light(materials, light, r, s.sky) * (fresnel * s.reflectivity * s.occlusion)
    return colour


@wp.func
def sun_share(
    light: Light, near: ShadowMap, far: ShadowMap, s: Surface, p: wp.vec3, plain: wp.vec3, turn: wp.vec2
) -> float:
    """Returns the share of the sun's disc that is visible from a surface at ``p`` [m] with geometric normal ``plain``.

    ``near`` and ``far`` are shadow maps; outside both, the share of visible sky decides. ``turn``: see
    :func:`shadow_turn`.
    """
    away = plain
    if wp.dot(plain, light.sun) < 0.0:
        away = -plain
    lit = sun_visibility(near, p, away, turn, light.sample_spiral, light.shadow_taps)
    if lit < 0.0:
        lit = sun_visibility(far, p, away, turn, light.sample_spiral, light.shadow_taps)
        if lit < 0.0:
            lit = wp.where(s.sky > 0.7, 1.0, s.sky)
    return lit


@wp.func
def shade_surface(
    materials: Materials,
    light: Light,
    near: ShadowMap,
    far: ShadowMap,
    s: Surface,
    kind: int,
    p: wp.vec3,
    d: wp.vec3,
    t: float,
    turn: wp.vec2,
) -> wp.vec3:
    """Returns the radiance (linear RGB) of surface ``s`` at ``p`` [m] towards a camera that looks along the unit ray
    ``d``.

    ``t`` [m] is the distance to the camera, for haze; ``turn``: see :func:`shadow_turn`.
    """
    n = s.normal
    plain = s.geometric_normal
    if kind == LEAF and wp.dot(plain, d) > 0.0:
        n = -n
        plain = -plain
    ndl = wp.dot(n, light.sun)
    lit = float(0.0)
    if ndl > 0.0 or s.transmission[0] > 0.0 or s.wrap[0] > 0.0:
        lit = sun_share(light, near, far, s, p, plain, turn)
    direct = wp.vec3(
        wp.max((ndl + s.wrap[0]) / (1.0 + s.wrap[0]), 0.0),
        wp.max((ndl + s.wrap[1]) / (1.0 + s.wrap[1]), 0.0),
        wp.max((ndl + s.wrap[2]) / (1.0 + s.wrap[2]), 0.0),
    )
    colour = wp.cw_mul(
        s.albedo,
        wp.cw_mul(direct, light.sun_colour) * (lit * (0.35 + 0.65 * s.occlusion))
        + ambient_light(light, n, s.sky) * s.occlusion,
    )
    if s.transmission[0] > 0.0:
        if kind == SPHEROID:  # light passes a long way through the berry: saturated, brightest at the rim
            rim = wp.clamp(0.55 - 0.75 * ndl, 0.0, 1.0)
            sunny = rim * rim * 0.30 * (0.15 + 0.85 * lit) * s.occlusion * (0.25 + 0.75 * s.sky)
            colour += wp.cw_mul(
                s.transmission, light.sun_colour * sunny + ambient_light(light, -n, s.sky) * (0.35 * s.occlusion)
            )
        else:
            colour += wp.cw_mul(
                s.transmission,
                light.sun_colour * (wp.max(-ndl, 0.0) * lit * 0.55)
                + ambient_light(light, -n, s.sky) * (0.30 * s.occlusion),
            )
    if s.specular > 0.0:
        colour += specular_light(materials, light, s, kind, d, n, ndl, lit)
    colour += s.albedo * s.emission
    if light.flash > 0.0:
        facing = wp.max(-wp.dot(n, d), 0.0)
        gloss = s.specular * wp.exp(-s.shininess * (1.0 - facing)) * (s.shininess * 0.14 + 0.4)
        falls = light.flash * facing / wp.max(t * t, 0.01)
        colour += s.albedo * falls + wp.vec3(falls * gloss, falls * gloss, falls * gloss)
    return mix(colour, light.haze_colour, 0.6 * (1.0 - wp.exp(-t * light.haze_rate)))


@wp.func
def seen_surface(
    shapes: Shapes, materials: Materials, i: int, p: wp.vec3, d: wp.vec3, footprint: float, slant: float
) -> Surface:
    """Returns the material properties of primitive ``i`` (-2: the ground) at ``p`` [m], seen along the unit ray ``d``.

    ``footprint`` and ``slant`` are the lengths that one pixel covers across and along the line of sight [m]; ``slant``
    is used on level ground only.
    """
    s = Surface()
    if i >= 0:
        kind = shapes.kind[i]
        if kind == LEAF:
            s = leaf_surface(shapes, materials, i, p, d, footprint)
        elif kind == SPHEROID and materials.material[i] == BERRY:
            s = berry_surface(shapes, materials, i, p, footprint)
        else:
            s = solid_surface(shapes, materials, i, p, footprint)
    else:
        along = slant
        if is_uneven(materials.ground):
            rise = ground_gradient(materials.ground, p[0], p[1])
            incidence = (d[2] - rise[0] * d[0] - rise[1] * d[1]) / wp.sqrt(1.0 + wp.dot(rise, rise))
            along = footprint / wp.max(-incidence, 1.0e-3)
        s = ground_surface(materials, p, footprint, along)
    return s


@wp.func
def shadow_turn(light: Light, left: int, top: int) -> wp.vec2:
    """Returns cosine and sine of the angle by which pixel (left, top) turns its shadow samples: interleaved gradient
    noise (Jimenez 2014)."""
    f = 0.06711056 * float(left) + 0.00583715 * float(top)
    f = 52.9829189 * (f - wp.floor(f))
    return light.sample_rotations[int((f - wp.floor(f)) * 64.0) & 63]


@wp.func
def surface_light(
    shapes: Shapes,
    materials: Materials,
    light: Light,
    near: ShadowMap,
    far: ShadowMap,
    lens: Pinhole,
    i: int,
    ray: wp.vec3,
    z: float,
    left: int,
    top: int,
    block: int,
) -> wp.vec3:
    """Returns the radiance (linear RGB) of primitive ``i`` (-2: the ground) at depth ``z`` [m] along ``ray``.

    (left, top) [px] is the upper left pixel, ``block`` [px] the width of the square of pixels that share this light.
    """
    scale = wp.length(ray)
    d = ray / scale
    p = lens.eye + ray * z
    footprint = z * float(block) / lens.fx
    turn = shadow_turn(light, left, top)
    kind = wp.int32(-1)
    if i >= 0:
        kind = shapes.kind[i]
    s = seen_surface(shapes, materials, i, p, d, footprint, footprint * z * scale / lens.eye[2])
    return shade_surface(materials, light, near, far, s, kind, p, d, z * scale, turn)


@wp.kernel
def shade_pixels(
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
    block: int,
    run: int,
    # out
    radiance_out: wp.array(dtype=wp.vec3),
):
    """One thread shades ``run`` neighbouring blocks of 1 x 1 or 2 x 2 pixels; within a block each visible primitive is
    shaded once, in the mean of its pixels.

    primitive: [pixel] -1 the sky, -2 the ground; keys: [pixel] depth [um] in the upper 32 bits; near, far: shadow maps;
    block: width of a block [px]; radiance: [pixel] linear RGB.
    """
    half = block - 1  # corners are numbered by bits: divisions would cost as much as the shading
    across = (lens.width + half) >> half
    first = (lens.first_row >> half) * across + wp.tid() * run
    corners = block * block
    back = wp.transpose(lens.rotation)
    for n in range(first, first + run):
        down = n // across
        left = (n - down * across) * block
        top = down * block
        for c in range(corners):
            i = wp.int32(-3)
            x = left + (c & half)
            y = top + (c >> half)
            if x < lens.width and y < lens.height:
                i = primitive[y * lens.width + x]
                for k in range(c):  # skip primitives that an earlier corner of the block has already shaded
                    if primitive[(top + (k >> half)) * lens.width + left + (k & half)] == i:
                        i = -3
            if i != -3:
                u = float(0.0)
                v = float(0.0)
                depth = float(0.0)
                nearness = float(0.0)
                share = float(0.0)
                for k in range(c, corners):
                    x = left + (k & half)
                    y = top + (k >> half)
                    if x < lens.width and y < lens.height:
                        pixel = y * lens.width + x
                        if primitive[pixel] == i:
                            u += float(x)
                            v += float(y)
                            depth += float(keys[pixel] >> wp.int64(32))
                            nearness += 1.0e6 / wp.max(float(keys[pixel] >> wp.int64(32)), 1.0)
                            share += 1.0
                per = 1.0 / share
                ray = back * wp.vec3((u * per - lens.cx) / lens.fx, (v * per - lens.cy) / lens.fy, 1.0)
                z = depth * per * 1.0e-6
                if i == -2 and is_uneven(materials.ground):
                    z = share / nearness  # on a plane 1 / z is linear in the picture
                elif i == -2:
                    z = -lens.eye[2] / ray[2]
                colour = wp.vec3(0.0, 0.0, 0.0)
                if i == -1:
                    colour = sky_radiance(light, ray / wp.length(ray))
                else:
                    colour = surface_light(shapes, materials, light, near, far, lens, i, ray, z, left, top, block)
                for k in range(c, corners):
                    x = left + (k & half)
                    y = top + (k >> half)
                    if x < lens.width and y < lens.height:
                        if primitive[y * lens.width + x] == i:
                            radiance_out[y * lens.width + x] = colour


@wp.kernel
def meter_luminance(
    # in
    radiance: wp.array(dtype=wp.vec3),
    width: int,
    height: int,
    step: int,
    # out
    sum_out: wp.array(dtype=wp.int64),
):
    """One thread adds the log2 luminance of the middle pixel of a ``step`` x ``step`` block to a sum.

    The sum is of integers, so that it does not depend on the order of threads. radiance: [pixel] linear RGB; step:
    [px]; sum: [2] sum of log2 luminance times 65536, and number of pixels.
    """
    i = wp.tid()
    across = width // step
    x = (i % across) * step + step / 2
    y = (i // across) * step + step / 2
    if y < height:
        c = radiance[y * width + x]
        light = wp.clamp(0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2], MIN_METERED_LUMINANCE, MAX_METERED_LUMINANCE)
        wp.atomic_add(sum_out, 0, wp.int64(int(wp.log2(light) * 65536.0)))
        wp.atomic_add(sum_out, 1, wp.int64(1))


@wp.kernel
def update_exposure(
    # in
    usual: float,
    key: float,
    share: float,
    least: float,
    most: float,
    keep: float,
    # out
    sum_out: wp.array(dtype=wp.int64),
    exposure_out: wp.array(dtype=wp.float32),
):
    """The only thread updates the exposure: from ``usual`` it goes ``share`` of the way, in stops, to the exposure that
    the picture's luminance asks for, limited to [least, most] and smoothed in time.

    key: wanted geometric mean of the exposed luminance (Reinhard et al. 2002); keep: weight of the old exposure in the
    smoothing, in stops; sum: [2] from :func:`meter_luminance`, set to 0 here; exposure: [1] factor on radiance.
    """
    mean = float(sum_out[0]) / (65536.0 * float(wp.max(sum_out[1], wp.int64(1))))
    wanted = wp.clamp(usual * wp.pow(key * wp.pow(2.0, -mean) / usual, share), least, most)
    old = exposure_out[0]
    exposure_out[0] = wp.where(old > 0.0, wanted * wp.pow(wp.max(old, 1.0e-6) / wanted, keep), wanted)
    sum_out[0] = wp.int64(0)
    sum_out[1] = wp.int64(0)


@wp.kernel
def tone_map(
    # in
    radiance: wp.array(dtype=wp.vec3),
    width: int,
    samples: int,
    balance: wp.vec3,
    exposure: wp.array(dtype=wp.float32),
    tone: wp.array(dtype=wp.uint8),
    first_pixel: int,
    run: int,
    # out
    rgb_out: wp.array2d(dtype=wp.uint8),
):
    """One thread converts the radiance of ``run`` pixels, each averaged over ``samples`` x ``samples`` samples, to
    sRGB.

    radiance: [sample] linear RGB; width: of the picture [px]; balance: white balance, a factor for each colour;
    exposure: [1] factor; tone: [4096] 8-bit sRGB for sqrt(radiance / 4); first_pixel: first pixel of thread 0; rgb:
    [pixel, 3].
    """
    first = first_pixel + wp.tid() * run
    per = 1.0 / float(samples * samples)
    gain = balance * exposure[0]
    for pixel in range(first, first + run):
        left = (pixel % width) * samples
        top = (pixel // width) * samples
        colour = wp.vec3(0.0, 0.0, 0.0)
        for k in range(samples * samples):
            c = wp.cw_mul(gain, radiance[(top + k // samples) * width * samples + left + k % samples])
            # clip samples to white before the mean: edges against the sky stay smooth
            colour += wp.min(c, wp.vec3(WHITE_POINT, WHITE_POINT, WHITE_POINT))
        for k in range(3):
            rgb_out[pixel, k] = tone[wp.clamp(int(wp.sqrt(wp.max(colour[k] * per, 0.0)) * 1024.0), 0, 4095)]
