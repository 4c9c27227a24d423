"""Materials (linear RGB): tables of textures, the class of a shaded surface, and surfaces of ground, berries,
leaves."""

import warp as wp

from vinesim.kernels.raster.ground import Ground, ground_relief, is_uneven
from vinesim.kernels.raster.primitives import Shapes, scale_along, xyz

wp.set_module_options({"enable_backward": False, "fast_math": True})

FOLIAGE = wp.constant(0)
BERRY = wp.constant(1)
CANE = wp.constant(2)
BARK = wp.constant(3)
POST = wp.constant(4)
WIRE = wp.constant(5)
STEM = wp.constant(6)
PLASTIC = wp.constant(7)
CLOTH = wp.constant(8)
SKIN = wp.constant(9)
PAINT = wp.constant(10)
GRASS = wp.constant(11)
LAMP = wp.constant(12)
RUBBER = wp.constant(13)
METAL = wp.constant(14)
STRAW = wp.constant(15)
REFLEX = wp.constant(16)
GLASS = wp.constant(17)
OLD_BARK = wp.constant(18)

FAR_VEIN = wp.constant(0.09)
FAR_TONE = wp.constant(0.53)
"""Vein strength and tone of a leaf too small to show its texture: the means over the texture, 0.134 and 0.529; of the
veins those 0.7 that are clear at that distance."""


@wp.struct
class Colours:
    """Colours of plants and ground (linear RGB) that belong to no single primitive, and shares of the ground."""

    soil_dark: wp.vec3
    soil_light: wp.vec3
    turf_dark: wp.vec3
    turf_light: wp.vec3
    field: wp.vec3
    """Sod of the fields around the vineyard."""
    dry: wp.vec3
    """Dry grass."""
    straw: wp.vec3
    cover: float
    """Added to the noise that decides where sod is."""
    most_cover: float
    """Largest share of sod at one place."""
    far_cover: float
    """Share of sod of the fields around the vineyard, relative to that of the default palette."""
    strip: float
    """Contrast between bare ground under the vines and sod between the rows."""
    dry_share: float
    dry_gain: float
    """Share of the sod that is dry, and how much it varies with the noise."""
    straw_share: float
    straw_gain: float
    """Share of the soil that straw covers, and how much it varies with the noise."""
    soil_ratio: float
    sod_ratio: float
    """Ratios of green to red albedo of bare soil and of sod."""
    margin: wp.vec3
    """Yellow margins of leaves."""
    scorch: wp.vec3
    """Dead edges of leaves."""
    through: wp.vec3
    """Light through a leaf, relative to its albedo."""
    under: wp.vec3
    """Felt of the lower side of leaves."""
    under_vein: wp.vec3
    vein: wp.vec3
    blotch: wp.vec3
    """Dark blotches on canes."""
    bark_dark: wp.vec3
    bark_light: wp.vec3


@wp.struct
class Materials:
    """Material and tint of each primitive, and the textures that materials sample."""

    material: wp.array(dtype=wp.int32)
    tint: wp.array(dtype=wp.vec3)
    sky: wp.array(dtype=wp.float32)
    """[primitive] Share of the sky that is visible from the primitive through the canopy, 0 to 1."""
    leaf_texture: wp.array3d(dtype=wp.vec4)
    noise_texture: wp.array2d(dtype=wp.vec4)
    soil_texture: wp.array2d(dtype=wp.vec4)
    rows: wp.vec2
    """Position of the first row of vines, and the spacing of rows [m], along y."""
    ground_sky: wp.array2d(dtype=wp.float32)
    ground_x: float
    ground_y: float
    ground_cell: float
    """The share of visible sky [row, column] above the ground, position of its first entry and its spacing [m]."""
    ground: Ground
    colours: Colours


@wp.func
def smoothstep(a: float, b: float, x: float) -> float:
    t = wp.clamp((x - a) / (b - a), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def mix(a: wp.vec3, b: wp.vec3, t: float) -> wp.vec3:
    return a * (1.0 - t) + b * t


@wp.func
def sample_bilinear(table: wp.array2d(dtype=wp.vec4), x: float, y: float) -> wp.vec4:
    """Returns the bilinear sample at (x, y) of a 256 x 256 table that repeats with period 1."""
    fx = (x - wp.floor(x)) * 256.0
    fy = (y - wp.floor(y)) * 256.0
    i = int(fx) & 255
    j = int(fy) & 255
    ax = fx - float(i)
    ay = fy - float(j)
    k = (i + 1) & 255
    below = (j + 1) & 255
    return (table[j, i] * (1.0 - ax) + table[j, k] * ax) * (1.0 - ay) + (
        table[below, i] * (1.0 - ax) + table[below, k] * ax
    ) * ay


@wp.func
def sample_nearest(table: wp.array2d(dtype=wp.vec4), x: float, y: float) -> wp.vec4:
    """Returns the texel nearest to (x, y) of a 256 x 256 table that repeats with period 1."""
    return table[int((y - wp.floor(y)) * 256.0) & 255, int((x - wp.floor(x)) * 256.0) & 255]


@wp.struct
class Surface:
    """Reflection properties of a surface at one point, for shading."""

    normal: wp.vec3
    geometric_normal: wp.vec3
    """Unit normal of the primitive's shape, without the relief of the material."""
    albedo: wp.vec3
    transmission: wp.vec3
    """Colour of the light that passes through the surface."""
    wrap: wp.vec3
    """Wrap lighting: share by which diffuse light reaches beyond the terminator, for each colour."""
    sky: float
    occlusion: float
    specular: float
    """Fresnel reflectance at normal incidence."""
    shininess: float
    """Sharpness of the highlight."""
    reflectivity: float
    emission: float


@wp.func
def diffuse_surface(n: wp.vec3, albedo: wp.vec3, sky: float) -> Surface:
    s = Surface()
    s.normal = n
    s.geometric_normal = n
    s.albedo = albedo
    s.transmission = wp.vec3(0.0, 0.0, 0.0)
    s.wrap = wp.vec3(0.0, 0.0, 0.0)
    s.sky = sky
    s.occlusion = 1.0
    s.specular = 0.03
    s.shininess = 12.0
    s.reflectivity = 0.0
    s.emission = 0.0
    return s


@wp.func
def ground_surface(materials: Materials, p: wp.vec3, pixel: float, slant: float) -> Surface:
    """Returns the surface of the ground, a mix of soil and sod, at ``p`` [m].

    ``pixel`` and ``slant`` are the lengths that one pixel covers across and along the line of sight [m].
    """
    colours = materials.colours
    # at grazing angles spots of the texture would become bands: far away only the texture's mean is used
    blur = 1.0 / (1.0 + slant * slant * 1.5)
    mean = wp.vec4(0.5, 0.5, 0.5, 0.5)
    coarse = mean
    if blur > 0.01:
        coarse = (sample_bilinear(materials.noise_texture, p[0] * 0.21, p[1] * 0.21) - mean) * blur + mean
    detail = 1.0 / (1.0 + pixel * pixel * 20000.0)
    tone = float(0.5)
    sod = float(0.5)
    n = wp.vec3(0.0, 0.0, 1.0)
    if detail > 0.08:
        t = sample_bilinear(materials.soil_texture, p[0] * 0.8, p[1] * 0.8)
        tone = 0.5 + (t[0] - 0.5) * detail
        sod = 0.5 + (t[1] - 0.5) * detail
        n = wp.normalize(wp.vec3(t[2] * detail, t[3] * detail, 1.0))
    if is_uneven(materials.ground):
        rise = ground_relief(materials.ground, p[0], p[1])
        n = wp.normalize(wp.vec3(n[0] / n[2] - rise[0], n[1] / n[2] - rise[1], 1.0))
    s = diffuse_surface(n, wp.vec3(0.0, 0.0, 0.0), 0.75)
    inside = float(0.0)
    x = (p[0] - materials.ground_x) / materials.ground_cell
    y = (p[1] - materials.ground_y) / materials.ground_cell
    wide = float(materials.ground_sky.shape[1] - 1)
    high = float(materials.ground_sky.shape[0] - 1)
    if x > 0.0 and y > 0.0 and x < wide and y < high:
        i = int(x)
        j = int(y)
        fx = x - float(i)
        fy = y - float(j)
        low = materials.ground_sky[j, i] * (1.0 - fx) + materials.ground_sky[j, i + 1] * fx
        above = materials.ground_sky[j + 1, i] * (1.0 - fx) + materials.ground_sky[j + 1, i + 1] * fx
        s.sky = low * (1.0 - fy) + above * fy
        edge = wp.min(wp.min(x, wide - x), wp.min(y, high - y)) * materials.ground_cell
        inside = smoothstep(0.0, 3.0, edge)
    green = smoothstep(
        0.38,
        0.60,
        0.55 * coarse[0]
        + 0.2 * coarse[2]
        + 0.25 * sod
        + row_greenness(materials.rows, p[1]) * inside * blur * colours.strip
        + colours.cover,
    )
    green = green * colours.most_cover
    earth = mix(colours.soil_dark, colours.soil_light, tone)
    turf = mix(colours.turf_dark, colours.turf_light, sod)
    if inside < 1.0:
        fields = sample_bilinear(materials.noise_texture, p[0] * 0.011, p[1] * 0.011 + 0.37)
        far = (0.22 + 0.45 * smoothstep(0.35, 0.65, fields[1])) * (1.0 - inside) * colours.far_cover
        green = wp.min(green + far, 0.92)
        turf = mix(turf, colours.field, (1.0 - inside) * smoothstep(0.35, 0.6, fields[2]))
    earth = mix(earth, colours.straw * (0.6 + 0.8 * tone), straw_cover(colours, sod, coarse[1]))
    turf = mix(turf, colours.dry * (0.6 + 0.8 * sod), dry_cover(colours, sod, coarse[2]))
    s.albedo = mix(earth, turf, green) * (0.8 + 0.4 * coarse[1])
    s.occlusion = 0.6 + 0.8 * wp.min(tone, 0.5)
    s.specular = 0.0
    return s


@wp.func
def row_greenness(rows: wp.vec2, y: float) -> float:
    """Returns the change of the ground's share of sod at ``y`` [m], across the rows of vines.

    It is negative (bare) under the vines and in wheel tracks, positive (green) between them. ``rows``: y of the first
    row and spacing of rows [m].
    """
    lane = (y - rows[0]) / rows[1]
    away = wp.abs(lane - wp.floor(lane + 0.5)) * rows[1]
    track = wp.abs(away - 0.5 * rows[1] + 0.7)
    return 0.16 - 0.26 * smoothstep(0.65, 0.25, away) - 0.14 * smoothstep(0.22, 0.08, track)


@wp.func
def dry_cover(colours: Colours, sod: float, spots: float) -> float:
    """Returns the share of dry grass in the sod, 0 to 1; ``sod``, ``spots``: fine and coarse noise around 0.5."""
    return wp.clamp(colours.dry_share + colours.dry_gain * (0.4 * sod + 0.6 * spots - 0.5), 0.0, 1.0)


@wp.func
def straw_cover(colours: Colours, sod: float, spots: float) -> float:
    """Returns the share of the soil that straw covers, 0 to 1; ``sod``, ``spots``: fine and coarse noise around 0.5."""
    return wp.clamp(colours.straw_share + colours.straw_gain * (0.7 * sod + 0.3 * spots - 0.5), 0.0, 1.0)


@wp.func
def trait(seed: float, factor: float) -> float:
    """Returns a number from 0 to 1 that belongs to the leaf or berry with ``seed``; each ``factor`` gives another."""
    x = seed * factor
    return x - wp.floor(x)


@wp.func
def leaf_sheen(gloss: float) -> float:
    """Returns how well a leaf mirrors its surroundings, from its ``gloss``, 0 to 1: GUESSED, by the blue of photographed
    leaves below the sky."""
    return 0.55 + 1.15 * gloss


@wp.func
def blade_colour(tint: wp.vec3, tone: float, wide: float, middle: float, hue: float) -> wp.vec3:
    """Returns the albedo of a green blade at a point, from the leaf's mean ``tint`` and the ``tone`` of its texture.

    ``wide``, ``middle`` and ``hue`` are noise around 0.5: brightness in large and in small patches, and yellowness.
    """
    warm = wp.clamp(hue - 0.58, -0.4, 0.4)
    bright = (0.62 + 0.70 * tone) * (0.82 + 0.26 * wide + 0.10 * middle)
    return wp.cw_mul(tint, wp.vec3(1.0 + 0.5 * warm, 1.0 + 0.2 * warm, 1.0 - 0.1 * warm)) * bright


@wp.func
def turned_colour(
    colours: Colours, albedo: wp.vec3, age: float, edge: float, vein: float, hue: float, wide: float, middle: float
) -> wp.vec3:
    """Returns the albedo of an old leaf: yellow in blotches that follow its edge here and there and stay off its
    veins, then brown.

    ``age`` is 0 for a green leaf and 1 for the oldest; ``edge``: distance from the edge [leaf units]; ``vein``: 0 to 1;
    ``hue``, ``wide``, ``middle``: noise around 0.5.
    """
    patch = smoothstep(0.38, 0.62, 0.8 * wide + 0.2 * middle)
    ragged = edge - 0.40 * (wide - 0.35) - 0.22 * (middle - 0.4)
    yellow = age * smoothstep(0.16 + 0.14 * age, -0.04, ragged) * (0.15 + 0.85 * patch)
    yellow += 0.85 * smoothstep(0.50, 0.75, age) * smoothstep(0.30, 0.62, 0.5 * (wide + hue))
    brown = smoothstep(0.02, -0.04, edge - 0.32 * (middle - 0.38) * age) * smoothstep(0.30, 0.6, age)
    turned = mix(albedo, colours.margin, wp.min(yellow, 1.0) * (1.0 - 0.5 * vein))
    return mix(turned, colours.scorch, brown)


@wp.func
def bloom_cover(seed: float, pale: float, red: float) -> float:
    """Returns the largest share of a berry's skin that bloom whitens: it lies thick on some berries and is rubbed off
    others. ``pale``, ``red``: 0 to 1, by the berry's colour."""
    return (0.28 - 0.16 * pale - 0.06 * red) * (0.2 + 1.2 * trait(seed, 29.3))


@wp.func
def bloom_share(cover: float, hue: float, wide: float, fine: float, rise: float) -> float:
    """Returns the share of bloom at a point of a berry, from its :func:`bloom_cover`.

    ``hue``, ``wide``, ``fine``: noise around 0.5; ``rise``: vertical part of the normal. Bloom stays on upper sides.
    """
    rubbed = smoothstep(0.36, 0.60, 0.45 * wide + 0.55 * fine + 0.10 * rise)
    return cover * (0.12 + 1.05 * rubbed) * (0.6 + 0.8 * hue)


@wp.func
def bloom_colour(pale: float) -> wp.vec3:
    return wp.vec3(0.20, 0.22, 0.36) + wp.vec3(0.14, 0.21, -0.20) * pale


@wp.func
def berry_occlusion(hidden: float, pale: float, depth: float) -> float:
    """Returns the share of light that reaches a point of a berry, of which neighbours hide the share ``hidden``.

    Light comes through ``pale`` neighbours; ``depth``: relative distance from the bunch's axis, 0 to 1.
    """
    return wp.clamp(1.0 - hidden, 0.04 + 0.05 * pale, 1.0) * (0.15 + 0.85 * depth * depth)


@wp.func
def berry_surface(g: Shapes, materials: Materials, i: int, p: wp.vec3, pixel: float) -> Surface:
    a4 = g.a[i]
    b4 = g.b[i]
    c4 = g.c[i]
    block = g.d[i]
    axis = xyz(b4)
    stretch = 1.0 / b4[3] - 1.0
    e = scale_along(p - xyz(a4), axis, stretch)
    n = wp.normalize(scale_along(e, axis, stretch))
    tint = materials.tint[i]
    s = diffuse_surface(n, tint, materials.sky[i])
    rot = c4[2]
    dry = wp.max(c4[3], 0.0)
    burnt = wp.max(-c4[3], 0.0)
    pale = wp.clamp(tint[1] * 2.2, 0.0, 1.0)  # pale berries transmit light, dark ones show bloom
    # occlusion by neighbouring berries: a baked cosine lobe
    s.occlusion = berry_occlusion(block[3] + wp.dot(xyz(block), n), pale, c4[1])
    red = wp.clamp((tint[0] - tint[1]) * 4.0, 0.0, 1.0) * (1.0 - pale)
    s.wrap = wp.vec3(0.12, 0.06, 0.08) + wp.vec3(0.33, 0.34, 0.12) * pale + wp.vec3(0.2, 0.05, 0.02) * red
    s.transmission = tint * (1.8 * (1.0 - rot)) * pale
    s.transmission += wp.vec3(0.26, 0.03, 0.012) * red + wp.vec3(0.03, 0.003, 0.004)
    bloom = bloom_cover(c4[0], pale, red)
    s.specular = 0.05
    bm = bloom * 0.45
    fuzz = float(0.4)
    if pixel < a4[3] * 0.35:
        w = wp.normalize(e)
        seed = c4[0]
        wide = sample_bilinear(
            materials.noise_texture, w[0] * 0.20 + seed * 7.1, w[1] * 0.20 + w[2] * 0.31 + seed * 3.3
        )
        fine = sample_bilinear(materials.noise_texture, w[0] * 1.1 + w[2] * 0.6 + seed, w[1] * 1.1 - w[2] * 0.4)
        s.albedo = tint * (0.86 + 0.52 * wide[1])
        amber = pale * 0.35 * wp.clamp(8.0 * (tint[0] / tint[1] - 0.8), 0.0, 1.0)
        s.albedo = mix(s.albedo, wp.vec3(0.46, 0.30, 0.06), amber * smoothstep(0.5, 0.8, wide[0] + 0.15 * n[2]))
        s.albedo = s.albedo * (1.0 + pale * (0.14 * fine[2] - 0.07) + red * wp.where(fine[3] > 0.82, 0.22, 0.0))
        along = wp.dot(w, axis)
        bm = bloom_share(bloom, wide[0], wide[1], fine[1], n[2])
        scar = smoothstep(0.986, 0.994, along)
        s.albedo = mix(s.albedo, wp.vec3(0.07, 0.045, 0.025), scar)
        s.albedo = mix(s.albedo, wp.vec3(0.16, 0.18, 0.06), 0.7 * smoothstep(-0.95, -0.985, along))
        # damage: sunburn above, the fur of grey mould, the wrinkles of a shrivelled berry
        burn = burnt * smoothstep(-0.3, 0.5, n[2] + wide[0] - 0.5)
        s.albedo = mix(s.albedo, wp.vec3(0.22, 0.11, 0.04), burn)
        fuzz = smoothstep(0.40, 0.65, fine[1])
        s.normal = wp.normalize(n + wp.vec3(fine[1] - 0.5, fine[2] - 0.5, fine[3] - 0.5) * (1.6 * dry + 0.8 * rot))
    bm = bm * (1.0 - rot) * (1.0 - 0.5 * dry)
    s.albedo = mix(s.albedo, bloom_colour(pale), wp.clamp(bm, 0.0, 0.8))
    s.albedo = mix(s.albedo, wp.vec3(0.33, 0.30, 0.25), rot * 0.75 * fuzz)
    s.shininess = (70.0 - 72.0 * wp.min(bm, 0.75)) * (1.0 - 0.8 * rot)
    s.reflectivity = 0.75 * (1.0 - wp.min(bm * 1.6, 0.85)) * (1.0 - rot)
    return s


@wp.func
def leaf_surface(g: Shapes, materials: Materials, i: int, p: wp.vec3, d: wp.vec3, pixel: float) -> Surface:
    a4 = g.a[i]
    b4 = g.b[i]
    c4 = g.c[i]
    bend = g.d[i]
    size = a4[3]
    rib = xyz(b4)
    up = xyz(c4)
    side = wp.cross(rib, up)
    q = (p - xyz(a4)) / size
    u = wp.dot(q, side)
    v = wp.dot(q, rib)
    slope_u = -2.0 * bend[0] * u - wp.where(u > 0.0, bend[2], -bend[2])
    slope_v = -2.0 * bend[1] * v
    plain = wp.normalize(side * slope_u + rib * slope_v + up)
    s = diffuse_surface(plain, materials.tint[i], materials.sky[i])
    grass = materials.material[i] == GRASS
    if grass:
        s.albedo = s.albedo * (0.35 + 0.75 * (0.5 + 0.5 * v))
        s.transmission = s.albedo * 0.7
        s.specular = 0.012
        s.normal = wp.normalize(plain * 0.5 + wp.vec3(0.0, 0.0, 0.8))
        s.occlusion = 0.35 + 0.65 * smoothstep(-0.75, 0.0, v)
    else:
        vein = float(FAR_VEIN)
        tone = float(FAR_TONE)
        age = wp.max(bend[3] - 0.42, 0.0) * 1.7  # leaves younger than 0.42 keep their colour
        gloss = trait(c4[3], 17.31)
        near = size > pixel * 10.0
        number = int(b4[3])
        spot = sample_bilinear(materials.noise_texture, u * 0.13 + c4[3] * 5.3, v * 0.13 + c4[3] * 2.7)
        if near:
            x = wp.clamp((u + 1.0) * 64.0 - 0.5, 0.0, 126.0)
            y = wp.clamp((v + 0.75) * 64.0 - 0.5, 0.0, 126.0)
            m = int(x)
            n = int(y)
            fx = x - float(m)
            fy = y - float(n)
            low = materials.leaf_texture[number, n, m] * (1.0 - fx) + materials.leaf_texture[number, n, m + 1] * fx
            high = (
                materials.leaf_texture[number, n + 1, m] * (1.0 - fx)
                + materials.leaf_texture[number, n + 1, m + 1] * fx
            )
            t = low * (1.0 - fy) + high * fy
            clear = wp.clamp(wp.abs(wp.dot(up, d)) * 2.2, 0.0, 1.0) / (1.0 + 3.0 * pixel / size)
            vein = t[0] * clear
            # the blade is puckered between its veins, and each leaf has waves of its own
            wave = 0.25 + 0.5 * trait(c4[3], 57.77)
            s.normal = wp.normalize(
                side * (slope_u - t[1] * clear + (spot[1] - 0.5) * wave)
                + rib * (slope_v - t[2] * clear + (spot[2] - 0.5) * wave)
                + up
            )
            tone = t[3]
        s.albedo = blade_colour(s.albedo, tone, spot[1], spot[2], spot[0])
        if age > 0.02:
            edge = (
                float(
                    g.outline[
                        number, wp.clamp(int((v + 0.75) * 128.0), 0, 255), wp.clamp(int((u + 1.0) * 128.0), 0, 255)
                    ]
                )
                * 0.0025
            )
            s.albedo = turned_colour(materials.colours, s.albedo, age, edge, vein, spot[0], spot[1], spot[2])
        s.transmission = wp.cw_mul(s.albedo, materials.colours.through) * (1.0 - 0.55 * vein)
        if wp.dot(plain, d) > 0.0:  # the lower side is paler, felted, with raised veins
            s.albedo = mix(s.albedo * 1.05, materials.colours.under, 0.42)
            s.albedo = mix(s.albedo, materials.colours.under_vein, vein * 0.7)
            s.specular = 0.012
            s.shininess = 6.0
        else:
            s.albedo = mix(s.albedo, materials.colours.vein, vein * 0.85)
            s.specular = 0.035 + 0.03 * gloss
            s.shininess = 9.0 + 26.0 * gloss * gloss
            s.reflectivity = leaf_sheen(gloss)
    return s
