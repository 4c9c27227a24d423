"""Shading of leaves, grass, berries and ground in live pictures on a CPU, eight points at once
(:mod:`vinesim.kernels.shading.light_points`)."""

import warp as wp

from vinesim.kernels.raster.ground import ground_relief
from vinesim.kernels.raster.pinhole import Pinhole
from vinesim.kernels.raster.primitives import scale_along
from vinesim.kernels.shading.deferred import Light, ambient_light
from vinesim.kernels.shading.light_points import (
    BERRIES,
    BLADES,
    GROUND,
    INLINE_ALL,
    FloatTables,
    Points,
    ShadowMaps,
    falling_exp,
    haze,
    point_kernel,
    point_ray,
    sun_share,
    unit,
)
from vinesim.kernels.shading.materials import (
    FAR_TONE,
    FAR_VEIN,
    GRASS,
    Materials,
    berry_occlusion,
    blade_colour,
    bloom_colour,
    bloom_cover,
    bloom_share,
    dry_cover,
    leaf_sheen,
    mix,
    row_greenness,
    smoothstep,
    straw_cover,
    trait,
    turned_colour,
)

wp.set_module_options({"enable_backward": False, "fast_math": True, "cpu_compiler_flags": INLINE_ALL})


@wp.func
def row3(table: wp.array2d(dtype=wp.float32), i: int) -> wp.vec3:
    return wp.vec3(table[i, 0], table[i, 1], table[i, 2])


@wp.struct
class Texels:
    """The four texels around a point of a table (indices a, b, c, d) and their bilinear weights (wa, wb, wc, wd)."""

    a: int
    b: int
    c: int
    d: int
    wa: float
    wb: float
    wc: float
    wd: float


@wp.func
def texels_around(x: float, y: float) -> Texels:
    """Returns the texels and weights for a bilinear sample at (x, y) of a 256 x 256 table that repeats with period
    1."""
    fx = (x - wp.floor(x)) * 256.0
    fy = (y - wp.floor(y)) * 256.0
    i = int(fx) & 255
    j = int(fy) & 255
    ax = fx - float(i)
    ay = fy - float(j)
    k = (i + 1) & 255
    n = (j + 1) & 255
    o = Texels()
    o.a = j * 256 + i
    o.b = j * 256 + k
    o.c = n * 256 + i
    o.d = n * 256 + k
    o.wa = (1.0 - ax) * (1.0 - ay)
    o.wb = ax * (1.0 - ay)
    o.wc = (1.0 - ax) * ay
    o.wd = ax * ay
    return o


@wp.func
def sampled(table: wp.array2d(dtype=wp.float32), t: Texels, channel: int) -> float:
    """Returns one channel of a table [texel, channel], interpolated between the four texels ``t``."""
    return (
        table[t.a, channel] * t.wa
        + table[t.b, channel] * t.wb
        + table[t.c, channel] * t.wc
        + table[t.d, channel] * t.wd
    )


@wp.func
def leaf_texels(outline: int, u: float, v: float) -> Texels:
    """Returns the texels and weights for a bilinear sample at (u, v) [leaf units] of the texture of leaves with
    ``outline``."""
    x = wp.clamp((u + 1.0) * 64.0 - 0.5, 0.0, 126.0)
    y = wp.clamp((v + 0.75) * 64.0 - 0.5, 0.0, 126.0)
    column = int(x)
    row = int(y)
    fx = x - float(column)
    fy = y - float(row)
    o = Texels()
    o.a = (outline * 128 + row) * 128 + column
    o.b = o.a + 1
    o.c = o.a + 128
    o.d = o.a + 129
    o.wa = (1.0 - fx) * (1.0 - fy)
    o.wb = fx * (1.0 - fy)
    o.wc = (1.0 - fx) * fy
    o.wd = fx * fy
    return o


@wp.func
def edge_distance(tables: FloatTables, i: int, u: float, v: float) -> float:
    """Returns the distance [leaf units] of (u, v) from the edge of leaf ``i``."""
    row = wp.clamp(int((v + 0.75) * 128.0), 0, 255)
    column = wp.clamp(int((u + 1.0) * 128.0), 0, 255)
    return float(tables.outline[(int(tables.b[i, 3]) * 256 + row) * 256 + column]) * 0.0025


@wp.func
def blade_light(
    tables: FloatTables,
    materials: Materials,
    light: Light,
    maps: ShadowMaps,
    lens: Pinhole,
    back: wp.mat33,
    points: Points,
    slot: int,
) -> wp.vec3:
    """Returns the radiance (linear RGB) of point ``slot`` of :class:`Points`, which is on a leaf or on grass.

    The formulas are those of ``leaf_surface`` and ``shade_surface``; ``back`` turns the optical frame into the world's.
    The function is long because one body without calls keeps eight points in SIMD lanes.
    """
    i = points.primitive[slot]
    ray = point_ray(lens, back, points.u[slot], points.v[slot])
    z = points.z[slot]
    scale = wp.length(ray)
    d = ray / scale
    p = lens.eye + ray * z
    pixel = z * 2.0 / lens.fx
    size = tables.a[i, 3]
    rib = row3(tables.b, i)
    up = row3(tables.c, i)
    side = wp.cross(rib, up)
    q = (p - row3(tables.a, i)) / size
    u = wp.dot(q, side)
    v = wp.dot(q, rib)
    bend = tables.d[i, 2]
    slope_u = -2.0 * tables.d[i, 0] * u - wp.where(u > 0.0, bend, -bend)
    slope_v = -2.0 * tables.d[i, 1] * v
    plain = unit(side * slope_u + rib * slope_v + up)
    grass = wp.where(materials.material[i] == GRASS, 1.0, 0.0)
    t = leaf_texels(int(tables.b[i, 3]), u, v)  # the texture: vein, relief, tone
    near = wp.where(size > pixel * 10.0, 1.0 - grass, 0.0)
    clear = near * wp.clamp(wp.abs(wp.dot(up, d)) * 2.2, 0.0, 1.0) / (1.0 + 3.0 * pixel / size)
    vein = sampled(tables.leaf_texture, t, 0) * clear + FAR_VEIN * (1.0 - near)
    seed = tables.c[i, 3]
    spots = texels_around(u * 0.13 + seed * 5.3, v * 0.13 + seed * 2.7)
    hue = sampled(tables.noise, spots, 0)
    wide = sampled(tables.noise, spots, 1)
    middle = sampled(tables.noise, spots, 2)
    wave = near * (0.25 + 0.5 * trait(seed, 57.77))
    slope_u += (wide - 0.5) * wave - sampled(tables.leaf_texture, t, 1) * clear
    slope_v += (middle - 0.5) * wave - sampled(tables.leaf_texture, t, 2) * clear
    bumpy = side * slope_u + rib * slope_v + up
    n = unit(mix(bumpy, plain * 0.5 + wp.vec3(0.0, 0.0, 0.8), grass))
    tint = row3(tables.tint, i)
    tone = FAR_TONE + near * (sampled(tables.leaf_texture, t, 3) - FAR_TONE)
    albedo = mix(blade_colour(tint, tone, wide, middle, hue), tint * (0.35 + 0.75 * (0.5 + 0.5 * v)), grass)
    colours = materials.colours
    age = wp.max(tables.d[i, 3] - 0.42, 0.0) * 1.7 * (1.0 - grass)
    turned = turned_colour(colours, albedo, age, edge_distance(tables, i, u, v), vein, hue, wide, middle)
    albedo = mix(albedo, turned, wp.where(age > 0.02, 1.0, 0.0))
    passing = mix(colours.through * (1.0 - 0.55 * vein), wp.vec3(0.7, 0.7, 0.7), grass)
    transmission = wp.cw_mul(albedo, passing)
    # the lower side is paler, felted, with raised veins
    under = wp.where(wp.dot(plain, d) > 0.0, 1.0, 0.0)
    below = under * (1.0 - grass)
    above = (1.0 - under) * (1.0 - grass)
    felt = mix(albedo * 1.05, colours.under, 0.42)
    albedo = mix(mix(albedo, felt, below), colours.under_vein, below * vein * 0.7)
    albedo = mix(albedo, colours.vein, above * vein * 0.85)
    gloss = trait(seed, 17.31)
    specular = 0.012 + (0.023 + 0.03 * gloss) * above
    shininess = 12.0 - 6.0 * below + (26.0 * gloss * gloss - 3.0) * above
    occlusion = wp.where(grass > 0.5, 0.35 + 0.65 * smoothstep(-0.75, 0.0, v), 1.0)
    sky = materials.sky[i]
    # light
    turn = 1.0 - 2.0 * under
    n = n * turn
    ndl = wp.dot(n, light.sun)
    towards = wp.where(wp.dot(plain, light.sun) < 0.0, -1.0, 1.0)
    lit = sun_share(maps, p, plain * towards, sky)
    direct = light.sun_colour * (wp.max(ndl, 0.0) * lit * (0.35 + 0.65 * occlusion))
    colour = wp.cw_mul(albedo, direct + ambient_light(light, n, sky) * occlusion)
    through = light.sun_colour * (wp.max(-ndl, 0.0) * lit * 0.55)
    colour += wp.cw_mul(transmission, through + ambient_light(light, -n, sky) * (0.30 * occlusion))
    cosine = wp.max(-wp.dot(n, d), 0.0)
    grazing = 1.0 - cosine
    g2 = grazing * grazing
    fresnel = specular + (1.0 - specular) * g2 * g2 * grazing * wp.min(specular * 14.0, 1.0) * 0.8
    peak = 1.0 - wp.max(wp.dot(n, unit(light.sun - d)), 0.0)
    bright = falling_exp(shininess * peak) * (shininess * 0.14 + 0.4) * wp.max(ndl + 0.05, 0.0)
    colour += light.sun_colour * (fresnel * lit * bright)
    mirrored = d[2] - n[2] * 2.0 * wp.dot(n, d)
    surroundings = mix(
        light.ground_colour, mix(light.canopy_colour * 0.45, light.sky_colour, sky * sky), 0.5 + 0.5 * mirrored
    )
    colour += surroundings * (wp.min(fresnel, 0.16) * leaf_sheen(gloss) * above * occlusion)
    return haze(light, colour, z * scale)


@wp.func
def ground_light(
    tables: FloatTables,
    materials: Materials,
    light: Light,
    maps: ShadowMaps,
    lens: Pinhole,
    back: wp.mat33,
    points: Points,
    slot: int,
) -> wp.vec3:
    """Returns the radiance (linear RGB) of point ``slot`` of :class:`Points`, which is on the ground.

    The formulas are those of ``ground_surface`` and ``shade_surface``; ``back`` turns the optical frame into the
    world's.
    """
    ray = point_ray(lens, back, points.u[slot], points.v[slot])
    z = -lens.eye[2] / ray[2]
    scale = wp.length(ray)
    pixel = z * 2.0 / lens.fx
    slant = pixel * z * scale / lens.eye[2]
    level = wp.vec2(0.0, 0.0)
    return soil_light(tables, materials, light, maps, lens.eye + ray * z, level, pixel, slant, z * scale)


@wp.func
def uneven_ground_light(
    tables: FloatTables,
    materials: Materials,
    light: Light,
    maps: ShadowMaps,
    lens: Pinhole,
    back: wp.mat33,
    points: Points,
    slot: int,
) -> wp.vec3:
    """Returns the radiance (linear RGB) of point ``slot`` of :class:`Points`, which is on uneven ground; see
    :func:`ground_light`."""
    ray = point_ray(lens, back, points.u[slot], points.v[slot])
    z = points.z[slot]
    scale = wp.length(ray)
    p = lens.eye + ray * z
    pixel = z * 2.0 / lens.fx
    rise = ground_relief(materials.ground, p[0], p[1])
    incidence = (ray[2] - rise[0] * ray[0] - rise[1] * ray[1]) / (scale * wp.sqrt(1.0 + wp.dot(rise, rise)))
    return soil_light(tables, materials, light, maps, p, rise, pixel, pixel / wp.max(-incidence, 1.0e-3), z * scale)


@wp.func
def soil_light(
    tables: FloatTables,
    materials: Materials,
    light: Light,
    maps: ShadowMaps,
    p: wp.vec3,
    rise: wp.vec2,
    pixel: float,
    slant: float,
    distance: float,
) -> wp.vec3:
    """Returns the radiance (linear RGB) of the ground at ``p`` [m], where it rises by ``rise`` [1] along x and y.

    ``pixel`` and ``slant`` are the lengths that one pixel covers across and along the line of sight [m]; ``distance``:
    from the camera [m].
    """
    blur = 1.0 / (1.0 + slant * slant * 1.5)
    t = texels_around(p[0] * 0.21, p[1] * 0.21)
    coarse = 0.5 + (sampled(tables.noise, t, 0) - 0.5) * blur
    shade = 0.5 + (sampled(tables.noise, t, 1) - 0.5) * blur
    spots = 0.5 + (sampled(tables.noise, t, 2) - 0.5) * blur
    detail = 1.0 / (1.0 + pixel * pixel * 20000.0)
    detail = wp.where(detail > 0.08, detail, 0.0)
    t = texels_around(p[0] * 0.8, p[1] * 0.8)
    tone = 0.5 + (sampled(tables.soil, t, 0) - 0.5) * detail
    sod = 0.5 + (sampled(tables.soil, t, 1) - 0.5) * detail
    n = unit(wp.vec3(sampled(tables.soil, t, 2) * detail - rise[0], sampled(tables.soil, t, 3) * detail - rise[1], 1.0))
    # the share of visible sky, and whether the point is inside the vineyard (0 to 1)
    x = (p[0] - materials.ground_x) / materials.ground_cell
    y = (p[1] - materials.ground_y) / materials.ground_cell
    columns = materials.ground_sky.shape[1]
    wide = float(columns - 1)
    high = float(materials.ground_sky.shape[0] - 1)
    within = x > 0.0 and y > 0.0 and x < wide and y < high
    i = int(wp.clamp(x, 0.0, wide - 1.0))
    j = int(wp.clamp(y, 0.0, high - 1.0))
    fx = x - float(i)
    fy = y - float(j)
    at = j * columns + i
    low = tables.ground_sky[at] * (1.0 - fx) + tables.ground_sky[at + 1] * fx
    above = tables.ground_sky[at + columns] * (1.0 - fx) + tables.ground_sky[at + columns + 1] * fx
    sky = wp.where(within, low * (1.0 - fy) + above * fy, 0.75)
    edge = wp.min(wp.min(x, wide - x), wp.min(y, high - y)) * materials.ground_cell
    inside = wp.where(within, smoothstep(0.0, 3.0, edge), 0.0)
    colours = materials.colours
    lanes = row_greenness(materials.rows, p[1]) * inside * blur * colours.strip
    green = colours.most_cover * smoothstep(
        0.38, 0.60, 0.55 * coarse + 0.2 * spots + 0.25 * sod + lanes + colours.cover
    )
    t = texels_around(p[0] * 0.011, p[1] * 0.011 + 0.37)
    outside = 1.0 - inside
    fields = 0.22 + 0.45 * smoothstep(0.35, 0.65, sampled(tables.noise, t, 1))
    green = wp.where(outside > 0.0, wp.min(green + fields * outside * colours.far_cover, 0.92), green)
    earth = mix(colours.soil_dark, colours.soil_light, tone)
    turf = mix(colours.turf_dark, colours.turf_light, sod)
    turf = mix(turf, colours.field, outside * smoothstep(0.35, 0.6, sampled(tables.noise, t, 2)))
    earth = mix(earth, colours.straw * (0.6 + 0.8 * tone), straw_cover(colours, sod, shade))
    turf = mix(turf, colours.dry * (0.6 + 0.8 * sod), dry_cover(colours, sod, spots))
    albedo = mix(earth, turf, green) * (0.8 + 0.4 * shade)
    occlusion = 0.6 + 0.8 * wp.min(tone, 0.5)
    ndl = wp.dot(n, light.sun)
    lit = sun_share(maps, p, n * wp.where(ndl < 0.0, -1.0, 1.0), sky)
    direct = light.sun_colour * (wp.max(ndl, 0.0) * lit * (0.35 + 0.65 * occlusion))
    colour = wp.cw_mul(albedo, direct + ambient_light(light, n, sky) * occlusion)
    return haze(light, colour, distance)


@wp.func
def berry_light(
    tables: FloatTables,
    materials: Materials,
    light: Light,
    maps: ShadowMaps,
    lens: Pinhole,
    back: wp.mat33,
    points: Points,
    slot: int,
) -> wp.vec3:
    """Returns the radiance (linear RGB) of point ``slot`` of :class:`Points`, which is on a berry.

    The formulas are those of ``berry_surface`` and ``shade_surface``; ``back`` turns the optical frame into the
    world's.
    """
    number = points.primitive[slot]
    ray = point_ray(lens, back, points.u[slot], points.v[slot])
    z = points.z[slot]
    scale = wp.length(ray)
    d = ray / scale
    p = lens.eye + ray * z
    radius = tables.a[number, 3]
    axis = row3(tables.b, number)
    stretch = 1.0 / tables.b[number, 3] - 1.0
    e = scale_along(p - row3(tables.a, number), axis, stretch)
    n = unit(scale_along(e, axis, stretch))
    tint = row3(tables.tint, number)
    sky = materials.sky[number]
    seed = tables.c[number, 0]
    neighbours = tables.d[number, 3] + wp.dot(row3(tables.d, number), n)
    rot = tables.c[number, 2]
    dry = wp.max(tables.c[number, 3], 0.0)
    burnt = wp.max(-tables.c[number, 3], 0.0)
    pale = wp.clamp(tint[1] * 2.2, 0.0, 1.0)
    occlusion = berry_occlusion(neighbours, pale, tables.c[number, 1])
    red = wp.clamp((tint[0] - tint[1]) * 4.0, 0.0, 1.0) * (1.0 - pale)
    wrap = wp.vec3(0.12, 0.06, 0.08) + wp.vec3(0.33, 0.34, 0.12) * pale + wp.vec3(0.2, 0.05, 0.02) * red
    transmission = tint * (1.8 * (1.0 - rot)) * pale
    transmission += wp.vec3(0.26, 0.03, 0.012) * red + wp.vec3(0.03, 0.003, 0.004)
    bloom = bloom_cover(seed, pale, red)
    near = wp.where(z * 2.0 / lens.fx < radius * 0.35, 1.0, 0.0)
    w = unit(e)
    t = texels_around(w[0] * 0.20 + seed * 7.1, w[1] * 0.20 + w[2] * 0.31 + seed * 3.3)
    wide0 = sampled(tables.noise, t, 0)
    wide1 = sampled(tables.noise, t, 1)
    t = texels_around(w[0] * 1.1 + w[2] * 0.6 + seed, w[1] * 1.1 - w[2] * 0.4)
    fine = sampled(tables.noise, t, 1)
    albedo = tint * (0.86 + 0.52 * wide1)
    amber = pale * 0.35 * wp.clamp(8.0 * (tint[0] / tint[1] - 0.8), 0.0, 1.0)
    albedo = mix(albedo, wp.vec3(0.46, 0.30, 0.06), amber * smoothstep(0.5, 0.8, wide0 + 0.15 * n[2]))
    fine2 = sampled(tables.noise, t, 2)
    fine3 = sampled(tables.noise, t, 3)
    speck = wp.where(fine3 > 0.82, 0.22, 0.0)
    albedo = albedo * (1.0 + pale * (0.14 * fine2 - 0.07) + red * speck)
    along = wp.dot(w, axis)
    dusty = bloom_share(bloom, wide0, wide1, fine, n[2])
    albedo = mix(albedo, wp.vec3(0.07, 0.045, 0.025), smoothstep(0.986, 0.994, along))
    albedo = mix(albedo, wp.vec3(0.16, 0.18, 0.06), 0.7 * smoothstep(-0.95, -0.985, along))
    burn = burnt * smoothstep(-0.3, 0.5, n[2] + wide0 - 0.5)
    albedo = mix(albedo, wp.vec3(0.22, 0.11, 0.04), burn)
    fuzz = wp.where(near > 0.5, smoothstep(0.40, 0.65, fine), 0.4)
    albedo = mix(tint, albedo, near)
    dusty = wp.where(near > 0.5, dusty, bloom * 0.45) * (1.0 - rot) * (1.0 - 0.5 * dry)
    albedo = mix(albedo, bloom_colour(pale), wp.clamp(dusty, 0.0, 0.8))
    albedo = mix(albedo, wp.vec3(0.33, 0.30, 0.25), rot * 0.75 * fuzz)
    shininess = (70.0 - 72.0 * wp.min(dusty, 0.75)) * (1.0 - 0.8 * rot)
    reflectivity = 0.75 * (1.0 - wp.min(dusty * 1.6, 0.85)) * (1.0 - rot)
    plain = n
    n = unit(n + wp.vec3(fine - 0.5, fine2 - 0.5, fine3 - 0.5) * ((1.6 * dry + 0.8 * rot) * near))
    # light
    ndl = wp.dot(n, light.sun)
    lit = sun_share(maps, p, plain * wp.where(wp.dot(plain, light.sun) < 0.0, -1.0, 1.0), sky)
    direct = wp.vec3(
        wp.max((ndl + wrap[0]) / (1.0 + wrap[0]), 0.0),
        wp.max((ndl + wrap[1]) / (1.0 + wrap[1]), 0.0),
        wp.max((ndl + wrap[2]) / (1.0 + wrap[2]), 0.0),
    )
    direct = wp.cw_mul(direct, light.sun_colour) * (lit * (0.35 + 0.65 * occlusion))
    colour = wp.cw_mul(albedo, direct + ambient_light(light, n, sky) * occlusion)
    rim = wp.clamp(0.55 - 0.75 * ndl, 0.0, 1.0)
    sunny = rim * rim * 0.30 * (0.15 + 0.85 * lit) * occlusion * (0.25 + 0.75 * sky)
    colour += wp.cw_mul(transmission, light.sun_colour * sunny + ambient_light(light, -n, sky) * (0.35 * occlusion))
    grazing = 1.0 - wp.max(-wp.dot(n, d), 0.0)
    g2 = grazing * grazing
    fresnel = 0.05 + 0.95 * g2 * g2 * grazing * 0.56
    peak = 1.0 - wp.max(wp.dot(n, unit(light.sun - d)), 0.0)
    bright = falling_exp(shininess * peak) * (shininess * 0.14 + 0.4) * wp.max(ndl + 0.05, 0.0)
    colour += light.sun_colour * (fresnel * lit * bright)
    r = d - n * (2.0 * wp.dot(n, d))
    t = texels_around(r[0] * 0.16 + r[2] * 0.09, r[1] * 0.16 - r[2] * 0.07)
    hole = smoothstep(0.50 - 0.30 * sky, 0.78 - 0.30 * sky, sampled(tables.noise, t, 1))
    mirrored = mix(light.canopy_colour * 0.4, light.sky_colour * 1.3, hole)
    mirrored = mix(light.ground_colour * 0.8, mirrored, smoothstep(-0.25, 0.25, r[2]))
    colour += mirrored * (fresnel * reflectivity * occlusion)
    return haze(light, colour, z * scale)


light_ground = point_kernel(__name__, "light_ground", GROUND, ground_light)
light_uneven_ground = point_kernel(__name__, "light_uneven_ground", GROUND, uneven_ground_light)
light_blades = point_kernel(__name__, "light_blades", BLADES, blade_light)
light_berries = point_kernel(__name__, "light_berries", BERRIES, berry_light)
