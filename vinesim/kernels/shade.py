"""What the seen primitives look like: sun shadow maps, materials, deferred shading, tone.

Linear light, RGB. Ambient light has three parts: sky through the gaps of the canopy (baked leaf area, Beer-Lambert),
green light through leaves, and the bounce of the ground. A leaf shows the sun through its blade; a berry carries
bloom, lets light through when it is pale, and darkens where it touches its neighbours.
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
    Clusters,
    Shapes,
    as_quat,
    hit,
    leaf_heights,
    squeeze,
    xyz,
)
from vinesim.kernels.visibility import Pinhole, ray_of

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

SUN_HEIGHT = wp.constant(100.0)
"""Depths of a shadow map count from this far towards the sun of its corner [m]."""
SUN_RADIUS = wp.constant(0.0047)
"""Half of the sun's angle [rad]."""


@wp.struct
class Looks:
    """Materials of all primitives and the tables they draw on."""

    material: wp.array(dtype=wp.int32)
    tint: wp.array(dtype=wp.vec3)
    sky: wp.array(dtype=wp.float32)
    """Share of the sky each primitive sees through the canopy."""
    blade: wp.array3d(dtype=wp.vec4)
    noise: wp.array2d(dtype=wp.vec4)
    soil: wp.array2d(dtype=wp.vec4)
    ground_sky: wp.array2d(dtype=wp.float32)
    ground_x: float
    ground_y: float
    ground_cell: float


@wp.struct
class ShadowMap:
    """Depth seen from the sun over a square."""

    depth: wp.array(dtype=wp.float32)
    corner: wp.vec3
    right: wp.vec3
    up: wp.vec3
    sun: wp.vec3
    texel: float
    side: int


@wp.struct
class Light:
    """Sun, sky and exposure."""

    sun: wp.vec3
    sun_colour: wp.vec3
    sky_colour: wp.vec3
    bounce: wp.vec3
    haze: wp.vec3
    exposure: float
    taps: int
    """Shadow samples a pixel."""
    spiral: wp.array(dtype=wp.vec2)
    """[taps] Vogel's spiral in the unit disc."""
    turns: wp.array(dtype=wp.vec2)
    """[64] cosine and sine of 64 angles."""
    table: wp.array2d(dtype=wp.vec3)
    tone: wp.array(dtype=wp.uint8)


# ---------------------------------------------------------------------------------------------- baking


@wp.kernel
def see_sky(
    # model
    density: wp.array3d(dtype=wp.float32),
    corner: wp.vec3,
    cell: float,
    # in
    position: wp.array(dtype=wp.vec3),
    # out
    sky_out: wp.array(dtype=wp.float32),
):
    """One thread finds the share of sky light that reaches one point through leaf area density [1/m] (13 directions)."""
    i = wp.tid()
    total = float(0.0)
    weight = float(0.0)
    for k in range(13):
        angle = 1.0472 * float(k)
        tilt = wp.where(k < 6, 0.6, 0.9)
        d = wp.vec3(tilt * wp.cos(angle), tilt * wp.sin(angle), wp.sqrt(1.0 - tilt * tilt))
        if k == 12:
            d = wp.vec3(0.0, 0.0, 1.0)
        depth = float(0.0)
        for n in range(14):
            p = (position[i] + d * (0.12 + 0.17 * float(n)) - corner) / cell
            x = int(wp.floor(p[0]))
            y = int(wp.floor(p[1]))
            z = int(wp.floor(p[2]))
            if x >= 0 and y >= 0 and z >= 0 and x < density.shape[0] and y < density.shape[1] and z < density.shape[2]:
                depth += density[x, y, z] * (0.17 * 0.5)
        total += wp.exp(-depth) * d[2]
        weight += d[2]
    sky_out[i] = total / weight


# ---------------------------------------------------------------------------------------------- shadow map


@wp.func
def darken(m: ShadowMap, x: int, y: int, z: float, depth_out: wp.array(dtype=wp.float32)):
    wp.atomic_min(depth_out, y * m.side + x, z)


@wp.kernel
def cast_shadows(
    # model
    shapes: Shapes,
    clusters: Clusters,
    ball: wp.array(dtype=wp.vec4),
    # in
    which: wp.array(dtype=wp.int32),
    m: ShadowMap,
    smallest: float,
    lanes: int,
    # out
    depth_out: wp.array(dtype=wp.float32),
):
    """One thread draws every ``lanes``-th primitive of one cluster as the sun sees it."""
    k, lane = wp.tid()
    cluster = which[k]
    kind = clusters.kind[cluster]
    bound = ball[cluster]
    e = xyz(bound) - m.corner
    reach = bound[3] / m.texel
    bx = wp.dot(e, m.right) / m.texel
    by = wp.dot(e, m.up) / m.texel
    side = float(m.side)
    if bound[3] > 0.0 and bx > -reach and by > -reach and bx < side + reach and by < side + reach:
        first = clusters.first[cluster]
        for i in range(first + lane, first + clusters.size[cluster], lanes):
            a4 = shapes.a[i]
            b4 = shapes.b[i]
            c4 = shapes.c[i]
            p = xyz(a4) - m.corner
            x = wp.dot(p, m.right) / m.texel
            y = wp.dot(p, m.up) / m.texel
            z = SUN_HEIGHT - wp.dot(p, m.sun)
            r = a4[3]
            if kind == SPHEROID:
                rt = r / m.texel
                for py in range(wp.max(int(y - rt), 0), wp.min(int(y + rt) + 2, m.side)):
                    for px in range(wp.max(int(x - rt), 0), wp.min(int(x + rt) + 2, m.side)):
                        dx = float(px) - x
                        dy = float(py) - y
                        h = rt * rt - dx * dx - dy * dy
                        if h > 0.0:
                            darken(m, px, py, z - wp.sqrt(h) * m.texel, depth_out)
            elif kind == CONE or kind == CYLINDER:
                rb = wp.where(kind == CONE, b4[3], r)
                if wp.max(r, rb) > smallest * m.texel:
                    q = xyz(b4) - m.corner
                    ex = wp.dot(q, m.right) / m.texel - x
                    ey = wp.dot(q, m.up) / m.texel - y
                    ez = SUN_HEIGHT - wp.dot(q, m.sun) - z
                    wide = wp.max(wp.max(r, rb) / m.texel, 0.55)
                    per = 1.0 / wp.max(ex * ex + ey * ey, 1.0e-6)
                    y0 = wp.max(int(wp.min(y, y + ey) - wide), 0)
                    y1 = wp.min(int(wp.max(y, y + ey) + wide) + 2, m.side)
                    for py in range(y0, y1):
                        x0 = wp.min(x, x + ex) - wide
                        x1 = wp.max(x, x + ex) + wide
                        if wp.abs(ey) > 4.0:
                            s = wp.clamp((float(py) - wide - y) / ey, 0.0, 1.0)
                            t = wp.clamp((float(py) + wide - y) / ey, 0.0, 1.0)
                            x0 = x + wp.min(ex * s, ex * t) - wide
                            x1 = x + wp.max(ex * s, ex * t) + wide
                        for px in range(wp.max(int(x0), 0), wp.min(int(x1) + 2, m.side)):
                            fx = float(px) - x
                            fy = float(py) - y
                            s = wp.clamp((fx * ex + fy * ey) * per, 0.0, 1.0)
                            fx -= s * ex
                            fy -= s * ey
                            rr = wp.max((r + (rb - r) * s) / m.texel, 0.55)
                            h = rr * rr - fx * fx - fy * fy
                            if h > 0.0:
                                darken(m, px, py, z + ez * s - wp.sqrt(h) * m.texel, depth_out)
            elif kind == LEAF:
                rib = xyz(b4)
                up = xyz(c4)
                across = wp.cross(rib, up)
                slant = wp.dot(m.sun, up)
                if wp.abs(slant) > 0.1:
                    # sun rays are parallel: leaf coordinates are affine in the texel, then one step for the curvature
                    bend = shapes.d[i]
                    number = int(b4[3])
                    per_leaf = m.texel / r
                    tu = wp.dot(m.sun, across) / slant
                    tv = wp.dot(m.sun, rib) / slant
                    rn = wp.dot(m.right, up)
                    un = wp.dot(m.up, up)
                    ux = (wp.dot(m.right, across) - rn * tu) * per_leaf
                    uy = (wp.dot(m.up, across) - un * tu) * per_leaf
                    vx = (wp.dot(m.right, rib) - rn * tv) * per_leaf
                    vy = (wp.dot(m.up, rib) - un * tv) * per_leaf
                    heights = leaf_heights(bend)
                    lx = float(1.0e9)
                    hx = float(-1.0e9)
                    ly = float(1.0e9)
                    hy = float(-1.0e9)
                    for n in range(8):
                        corner = shapes.hull[number, n]
                        for level in range(2):
                            w = heights[level]
                            qx = (
                                x
                                + (corner[0] * wp.dot(m.right, across) + corner[1] * wp.dot(m.right, rib) + w * rn)
                                / per_leaf
                            )
                            qy = (
                                y
                                + (corner[0] * wp.dot(m.up, across) + corner[1] * wp.dot(m.up, rib) + w * un) / per_leaf
                            )
                            lx = wp.min(lx, qx)
                            hx = wp.max(hx, qx)
                            ly = wp.min(ly, qy)
                            hy = wp.max(hy, qy)
                    for py in range(wp.max(int(ly), 0), wp.min(int(hy) + 2, m.side)):
                        fy = float(py) - y
                        for px in range(wp.max(int(lx), 0), wp.min(int(hx) + 2, m.side)):
                            fx = float(px) - x
                            u0 = ux * fx + uy * fy
                            v0 = vx * fx + vy * fy
                            if u0 > -1.2 and u0 < 1.2 and v0 > -1.0 and v0 < 1.5:
                                w = bend[0] * u0 * u0 + bend[2] * wp.abs(u0) + bend[1] * v0 * v0
                                u = u0 + tu * w
                                v = v0 + tv * w
                                if u > -0.99 and u < 0.99 and v > -0.74 and v < 1.24:
                                    if int(shapes.outline[number, int((v + 0.75) * 128.0), int((u + 1.0) * 128.0)]) > 0:
                                        w = bend[0] * u * u + bend[2] * wp.abs(u) + bend[1] * v * v
                                        toward = wp.dot(m.sun, across) * u + wp.dot(m.sun, rib) * v + slant * w
                                        darken(m, px, py, z - toward * r, depth_out)
            else:
                o = xyz(a4)
                reach_i = r
                if kind == TRIANGLE:
                    o = (xyz(a4) + xyz(b4) + xyz(c4)) / 3.0
                    reach_i = wp.max(wp.max(wp.length(xyz(a4) - o), wp.length(xyz(b4) - o)), wp.length(xyz(c4) - o))
                else:
                    reach_i = wp.length(wp.vec3(r, c4[0], c4[1]))
                p = o - m.corner
                x = wp.dot(p, m.right) / m.texel
                y = wp.dot(p, m.up) / m.texel
                rt = reach_i / m.texel
                for py in range(wp.max(int(y - rt), 0), wp.min(int(y + rt) + 2, m.side)):
                    for px in range(wp.max(int(x - rt), 0), wp.min(int(x + rt) + 2, m.side)):
                        from_sun = (
                            m.corner
                            + m.right * (float(px) * m.texel)
                            + m.up * (float(py) * m.texel)
                            + m.sun * SUN_HEIGHT
                        )
                        t = hit(shapes, i, from_sun, -m.sun, 0)
                        if t < FAR:
                            darken(m, px, py, t, depth_out)


@wp.func
def lit_share(m: ShadowMap, p: wp.vec3, n: wp.vec3, turn: wp.vec2, spiral: wp.array(dtype=wp.vec2), taps: int) -> float:
    """Share of the sun's disc seen from ``p``; -1 outside the map. Soft by the distance of what stands between."""
    facing = wp.abs(wp.dot(n, m.sun))
    e = p + n * (m.texel * (1.0 + 1.6 * (1.0 - facing))) - m.corner
    x = wp.dot(e, m.right) / m.texel + 0.5
    y = wp.dot(e, m.up) / m.texel + 0.5
    lit = float(-1.0)
    if x > 8.0 and y > 8.0 and x < float(m.side) - 9.0 and y < float(m.side) - 9.0:
        z = (
            SUN_HEIGHT
            - wp.dot(e, m.sun)
            - m.texel * (0.4 + 0.7 * wp.sqrt(1.0 - facing * facing) / wp.max(facing, 0.12))
        )
        gap = z - m.depth[int(y) * m.side + int(x)]
        spread = float(1.6)
        if gap > 0.0:
            spread = wp.clamp(SUN_RADIUS * gap / m.texel, 1.0, 6.0)
        z -= spread * m.texel * 0.3
        lit = wp.where(gap > 0.0, 0.0, 1.0)
        for k in range(taps):
            v = spiral[k] * spread
            if (
                m.depth[int(y + v[0] * turn[1] + v[1] * turn[0]) * m.side + int(x + v[0] * turn[0] - v[1] * turn[1])]
                > z
            ):
                lit += 1.0
        lit = lit / (float(taps) + 1.0)
    return lit


# ---------------------------------------------------------------------------------------------- materials


@wp.func
def smoothstep(a: float, b: float, x: float) -> float:
    t = wp.clamp((x - a) / (b - a), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def mix(a: wp.vec3, b: wp.vec3, t: float) -> wp.vec3:
    return a * (1.0 - t) + b * t


@wp.func
def smooth(table: wp.array2d(dtype=wp.vec4), x: float, y: float) -> wp.vec4:
    """Bilinear sample of a 256 x 256 table of period 1."""
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
def texel_of(table: wp.array2d(dtype=wp.vec4), x: float, y: float) -> wp.vec4:
    """Nearest sample of a 256 x 256 table of period 1."""
    return table[int((y - wp.floor(y)) * 256.0) & 255, int((x - wp.floor(x)) * 256.0) & 255]


@wp.struct
class Surface:
    """What one point reflects."""

    normal: wp.vec3
    plain: wp.vec3
    """Normal of the shape, without relief."""
    albedo: wp.vec3
    through: wp.vec3
    """Colour of the light that passes."""
    wrap: wp.vec3
    """How far light creeps round the terminator, by colour."""
    sky: float
    occlusion: float
    gloss: float
    """Fresnel reflectance at normal incidence."""
    polish: float
    """Sharpness of the highlight."""
    mirror: float
    glow: float


@wp.func
def matte(n: wp.vec3, albedo: wp.vec3, sky: float) -> Surface:
    s = Surface()
    s.normal = n
    s.plain = n
    s.albedo = albedo
    s.through = wp.vec3(0.0, 0.0, 0.0)
    s.wrap = wp.vec3(0.0, 0.0, 0.0)
    s.sky = sky
    s.occlusion = 1.0
    s.gloss = 0.03
    s.polish = 12.0
    s.mirror = 0.0
    s.glow = 0.0
    return s


@wp.func
def ground_surface(looks: Looks, p: wp.vec3, pixel: float) -> Surface:
    coarse = smooth(looks.noise, p[0] * 0.21, p[1] * 0.21)
    detail = 1.0 / (1.0 + pixel * pixel * 20000.0)
    tone = float(0.5)
    sod = float(0.5)
    n = wp.vec3(0.0, 0.0, 1.0)
    if detail > 0.08:
        t = smooth(looks.soil, p[0] * 0.8, p[1] * 0.8)
        tone = 0.5 + (t[0] - 0.5) * detail
        sod = 0.5 + (t[1] - 0.5) * detail
        n = wp.normalize(wp.vec3(t[2] * detail, t[3] * detail, 1.0))
    green = smoothstep(0.38, 0.60, coarse[0] * 0.55 + 0.2 * coarse[2] + 0.25 * sod) * 0.85
    earth = mix(wp.vec3(0.11, 0.072, 0.042), wp.vec3(0.28, 0.195, 0.12), tone)
    turf = mix(wp.vec3(0.035, 0.055, 0.014), wp.vec3(0.13, 0.15, 0.042), sod)
    s = matte(n, mix(earth, turf, green) * (0.8 + 0.4 * coarse[1]), 0.75)
    s.plain = wp.vec3(0.0, 0.0, 1.0)
    s.occlusion = 0.6 + 0.8 * wp.min(tone, 0.5)
    s.gloss = 0.0
    x = (p[0] - looks.ground_x) / looks.ground_cell
    y = (p[1] - looks.ground_y) / looks.ground_cell
    if x > 0.0 and y > 0.0 and x < float(looks.ground_sky.shape[1] - 1) and y < float(looks.ground_sky.shape[0] - 1):
        i = int(x)
        j = int(y)
        fx = x - float(i)
        fy = y - float(j)
        low = looks.ground_sky[j, i] * (1.0 - fx) + looks.ground_sky[j, i + 1] * fx
        high = looks.ground_sky[j + 1, i] * (1.0 - fx) + looks.ground_sky[j + 1, i + 1] * fx
        s.sky = low * (1.0 - fy) + high * fy
    return s


@wp.func
def berry_surface(g: Shapes, looks: Looks, i: int, p: wp.vec3, pixel: float) -> Surface:
    a4 = g.a[i]
    b4 = g.b[i]
    c4 = g.c[i]
    block = g.d[i]
    axis = xyz(b4)
    stretch = 1.0 / b4[3] - 1.0
    e = squeeze(p - xyz(a4), axis, stretch)
    n = wp.normalize(squeeze(e, axis, stretch))
    tint = looks.tint[i]
    s = matte(n, tint, looks.sky[i])
    # neighbours: a baked cosine lobe of what stands around
    s.occlusion = wp.clamp(1.0 - block[3] - wp.dot(xyz(block), n), 0.12, 1.0) * (0.4 + 0.6 * c4[1])
    light = tint[1] * 2.2  # pale berries let light through, dark ones carry the bloom
    pale = wp.clamp(light, 0.0, 1.0)
    red = wp.clamp((tint[0] - tint[1]) * 4.0, 0.0, 1.0) * (1.0 - pale)
    s.wrap = wp.vec3(0.12, 0.06, 0.08) + wp.vec3(0.33, 0.34, 0.12) * pale + wp.vec3(0.2, 0.05, 0.02) * red
    s.through = wp.vec3(0.95, 0.76, 0.12) * pale + wp.vec3(0.26, 0.03, 0.012) * red + wp.vec3(0.03, 0.003, 0.004)
    bloom = 0.30 - 0.20 * pale - 0.10 * red
    s.gloss = 0.045
    bm = bloom * 0.6
    if pixel < a4[3] * 0.35:
        w = wp.normalize(e)
        seed = c4[0]
        wide = smooth(looks.noise, w[0] * 0.20 + seed * 7.1, w[1] * 0.20 + w[2] * 0.31 + seed * 3.3)
        fine = smooth(looks.noise, w[0] * 1.1 + w[2] * 0.6 + seed, w[1] * 1.1 - w[2] * 0.4)
        s.albedo = tint * (0.86 + 0.28 * wide[1])
        s.albedo = mix(s.albedo, wp.vec3(0.46, 0.30, 0.06), pale * 0.35 * smoothstep(0.5, 0.8, wide[0] + 0.15 * n[2]))
        s.albedo = s.albedo * (1.0 + pale * (0.14 * fine[2] - 0.07) + red * wp.where(fine[3] > 0.82, 0.22, 0.0))
        along = wp.dot(w, axis)
        bm = bloom * smoothstep(0.30, 0.62, wide[0] * 0.55 + wide[1] * 0.45 + 0.12 * n[2]) * (0.75 + 0.5 * fine[1])
        scar = smoothstep(0.986, 0.994, along)
        s.albedo = mix(s.albedo, wp.vec3(0.07, 0.045, 0.025), scar)
        s.albedo = mix(s.albedo, wp.vec3(0.16, 0.18, 0.06), 0.7 * smoothstep(-0.95, -0.985, along))
    s.albedo = mix(s.albedo, wp.vec3(0.42, 0.46, 0.56), wp.clamp(bm, 0.0, 0.8))
    s.polish = 260.0 - 300.0 * wp.min(bm, 0.75)
    s.mirror = 1.0 - wp.min(bm * 1.6, 0.85)
    return s


@wp.func
def leaf_surface(g: Shapes, looks: Looks, i: int, p: wp.vec3, d: wp.vec3, pixel: float) -> Surface:
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
    s = matte(plain, looks.tint[i], looks.sky[i])
    grass = looks.material[i] == GRASS
    if grass:
        s.albedo = s.albedo * (0.35 + 0.75 * (0.5 + 0.5 * v))
        s.through = s.albedo * 0.7
        s.gloss = 0.012
        s.normal = wp.normalize(plain * 0.5 + wp.vec3(0.0, 0.0, 0.8))
        s.occlusion = 0.35 + 0.65 * smoothstep(-0.75, 0.0, v)
    else:
        vein = float(0.0)
        age = wp.max(bend[3] - 0.42, 0.0) * 1.7  # a leaf turns late
        near = size > pixel * 10.0
        number = int(b4[3])
        if near:
            x = wp.clamp((u + 1.0) * 64.0 - 0.5, 0.0, 126.0)
            y = wp.clamp((v + 0.75) * 64.0 - 0.5, 0.0, 126.0)
            m = int(x)
            n = int(y)
            fx = x - float(m)
            fy = y - float(n)
            low = looks.blade[number, n, m] * (1.0 - fx) + looks.blade[number, n, m + 1] * fx
            high = looks.blade[number, n + 1, m] * (1.0 - fx) + looks.blade[number, n + 1, m + 1] * fx
            t = low * (1.0 - fy) + high * fy
            clear = wp.clamp(wp.abs(wp.dot(up, d)) * 2.2, 0.0, 1.0) / (1.0 + 6.0 * pixel / size)
            vein = t[0] * clear
            relief = 0.8 * clear
            s.normal = wp.normalize(side * (slope_u - t[1] * relief) + rib * (slope_v - t[2] * relief) + up)
            s.albedo = s.albedo * (0.72 + 0.5 * t[3])
        if age > 0.02:
            spot = texel_of(looks.noise, u * 0.13 + c4[3] * 5.3, v * 0.13 + c4[3] * 2.7)
            edge = (
                float(
                    g.outline[
                        number, wp.clamp(int((v + 0.75) * 128.0), 0, 255), wp.clamp(int((u + 1.0) * 128.0), 0, 255)
                    ]
                )
                * 0.0025
            )
            yellow = (
                age * smoothstep(0.16 + 0.1 * age, 0.0, edge - 0.10 * spot[1])
                + 0.7 * smoothstep(0.62, 0.9, age) * spot[0]
            )
            s.albedo = mix(s.albedo, wp.vec3(0.40, 0.34, 0.05), wp.clamp(yellow, 0.0, 1.0))
            brown = smoothstep(0.03, 0.0, edge - 0.05 * spot[2] * age) * smoothstep(0.35, 0.6, age)
            s.albedo = mix(s.albedo, wp.vec3(0.16, 0.085, 0.03), brown)
        s.through = wp.cw_mul(s.albedo, wp.vec3(2.3, 2.0, 0.75)) * (1.0 - 0.45 * vein)
        if wp.dot(plain, d) > 0.0:  # from below: paler, felted, veins stand out
            s.albedo = mix(s.albedo * 1.05, wp.vec3(0.22, 0.27, 0.16), 0.42)
            s.albedo = mix(s.albedo, wp.vec3(0.34, 0.38, 0.20), vein * 0.7)
            s.gloss = 0.012
            s.polish = 6.0
        else:
            s.albedo = mix(s.albedo, wp.vec3(0.30, 0.38, 0.12), vein * 0.55)
            s.gloss = 0.05
            s.polish = 22.0
            s.mirror = 0.55
    return s


@wp.func
def solid_surface(g: Shapes, looks: Looks, i: int, p: wp.vec3, pixel: float) -> Surface:
    kind = g.kind[i]
    a4 = g.a[i]
    b4 = g.b[i]
    c4 = g.c[i]
    a = xyz(a4)
    n = wp.vec3(0.0, 0.0, 1.0)
    grain = p  # position along and across the grain
    sky = looks.sky[i]
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
        n = wp.normalize(wp.cross(xyz(b4) - a, xyz(c4) - a))
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
    material = looks.material[i]
    tint = looks.tint[i]
    s = matte(n, tint, sky)
    seed = c4[1]
    near = pixel < 0.004
    if material == CANE:
        if near:
            t = smooth(looks.noise, grain[0] * 9.0 + grain[1] * 7.0 + seed, grain[2] * 1.6 + seed * 3.1)
            s.albedo = mix(tint * (0.55 + 0.9 * t[2]), wp.vec3(0.20, 0.10, 0.045), 0.5 * smoothstep(0.45, 0.7, t[0]))
            s.normal = wp.normalize(n + wp.vec3(t[1] - 0.5, t[2] - 0.5, t[3] - 0.5) * (0.7 / (1.0 + pixel * 500.0)))
        s.polish = 14.0
    elif material == BARK:
        wide = smooth(
            looks.noise, grain[0] * 2.6 + grain[2] * 0.24 + seed, grain[1] * 2.6 - grain[2] * 0.10 + grain[0] * 0.4
        )
        fine = texel_of(looks.noise, grain[0] * 6.0 + grain[2] * 0.45, grain[1] * 6.0 + grain[2] * 0.32 + seed)
        height = wide[2] * 0.6 + fine[1] * 0.4
        s.albedo = mix(wp.vec3(0.075, 0.054, 0.038), wp.vec3(0.27, 0.20, 0.14), smoothstep(0.28, 0.75, height))
        s.occlusion = 0.6 + 0.4 * smoothstep(0.3, 0.55, height)
        s.normal = wp.normalize(n + wp.vec3(wide[2] - 0.5, fine[1] - 0.5, (wide[3] - 0.5) * 0.3) * 1.6)
        s.gloss = 0.01
    elif material == POST:
        wide = smooth(looks.noise, grain[0] * 1.7 + grain[1] * 1.3 + seed, grain[2] * 0.35)
        fine = texel_of(looks.noise, grain[0] * 6.0 + grain[1] * 5.0, grain[2] * 0.9 + seed)
        s.albedo = (
            tint * (0.55 + 0.55 * wide[1] + 0.35 * fine[2]) * (1.0 - 0.45 * smoothstep(0.35, 0.0, p[2]) * wide[0])
        )
        s.normal = wp.normalize(n + wp.vec3(fine[1] - 0.5, fine[2] - 0.5, 0.0) * 0.5)
        s.gloss = 0.02
    elif material == WIRE:
        s.gloss = 0.35
        s.polish = 30.0
        s.mirror = 0.5
    elif material == PLASTIC:
        t = texel_of(looks.noise, grain[0] * 2.0 + grain[2], grain[1] * 2.0 + grain[2])
        s.albedo = tint * (0.85 + 0.3 * t[1])
        s.gloss = 0.045
        s.polish = 45.0
        s.mirror = 0.6
    elif material == CLOTH:
        wide = smooth(looks.noise, grain[0] * 1.4 + seed, grain[2] * 1.1 + grain[1] * 0.9)
        s.albedo = tint * (0.78 + 0.45 * wide[0])
        s.normal = wp.normalize(n + wp.vec3(wide[0] - 0.5, wide[1] - 0.5, (wide[2] - 0.5) * 0.7) * 0.9)
        s.gloss = 0.008
        s.wrap = wp.vec3(0.15, 0.15, 0.15)
    elif material == SKIN:
        s.wrap = wp.vec3(0.35, 0.15, 0.10)
        s.polish = 14.0
    elif material == PAINT:
        s.gloss = 0.05
        s.polish = 80.0
        s.mirror = 0.4
    elif material == LAMP:
        s.glow = 3.0
    elif material == STEM:
        s.through = tint * 0.3
    if material != WIRE:
        s.occlusion = s.occlusion * (0.55 + 0.45 * smoothstep(0.0, 0.35, p[2] + wp.max(n[2], 0.0) * 0.35))
    return s


# ---------------------------------------------------------------------------------------------- light


@wp.func
def arctangent(y: float, x: float) -> float:
    """atan2 to 1e-4 rad."""
    ax = wp.abs(x)
    ay = wp.abs(y)
    a = wp.min(ax, ay) / wp.max(wp.max(ax, ay), 1.0e-9)
    q = a * a
    r = ((-0.0464964749 * q + 0.15931422) * q - 0.327622764) * q * a + a
    if ay > ax:
        r = 1.57079637 - r
    if x < 0.0:
        r = 3.14159274 - r
    return wp.where(y < 0.0, -r, r)


@wp.func
def sky_light(light: Light, d: wp.vec3) -> wp.vec3:
    rows = light.table.shape[0]
    columns = light.table.shape[1]
    x = (arctangent(d[1], d[0]) * 0.15915494 + 0.5) * float(columns - 1)
    y = wp.sqrt(wp.max(d[2], 0.0)) * float(rows - 1)
    i = wp.clamp(int(x), 0, columns - 2)
    j = wp.clamp(int(y), 0, rows - 2)
    fx = x - float(i)
    fy = y - float(j)
    low = light.table[j, i] * (1.0 - fx) + light.table[j, i + 1] * fx
    high = light.table[j + 1, i] * (1.0 - fx) + light.table[j + 1, i + 1] * fx
    return low * (1.0 - fy) + high * fy


@wp.func
def ambient(light: Light, n: wp.vec3, sky: float) -> wp.vec3:
    """Cool sky through the gaps, green light through leaves, warm bounce from the ground."""
    up = 0.5 + 0.5 * n[2]
    above = light.sky_colour * (sky * sky) + wp.vec3(0.16, 0.24, 0.045) * (1.0 - sky)
    return above * (0.25 + 0.75 * up) + light.bounce * ((1.0 - up) * (0.35 + 0.65 * sky))


@wp.func
def mirrored(looks: Looks, light: Light, r: wp.vec3, sky: float) -> wp.vec3:
    """What a glossy surface mirrors: holes of sky in a dark canopy above, ground below."""
    t = texel_of(looks.noise, r[0] * 0.35 + r[2] * 0.2, r[1] * 0.35 - r[2] * 0.15)
    hole = smoothstep(0.62 - 0.35 * sky, 0.72 - 0.35 * sky, t[1])
    above = mix(wp.vec3(0.05, 0.08, 0.02), wp.vec3(0.75, 0.95, 1.25), hole)
    return mix(light.bounce * 0.8, above, smoothstep(-0.25, 0.25, r[2]))


@wp.func
def shine(
    looks: Looks,
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
    """Light that leaves a surface at ``p`` against the unit ray ``d``."""
    n = s.normal
    plain = s.plain
    if kind >= 0 and wp.dot(plain, d) > 0.0:
        n = -n
        plain = -plain
    ndl = wp.dot(n, light.sun)
    lit = float(0.0)
    if ndl > 0.0 or s.through[0] > 0.0 or s.wrap[0] > 0.0:
        away = plain
        if wp.dot(plain, light.sun) < 0.0:
            away = -plain
        lit = lit_share(near, p, away, turn, light.spiral, light.taps)
        if lit < 0.0:
            lit = lit_share(far, p, away, turn, light.spiral, light.taps)
            if lit < 0.0:
                lit = wp.where(s.sky > 0.7, 1.0, s.sky)
    direct = wp.vec3(
        wp.max((ndl + s.wrap[0]) / (1.0 + s.wrap[0]), 0.0),
        wp.max((ndl + s.wrap[1]) / (1.0 + s.wrap[1]), 0.0),
        wp.max((ndl + s.wrap[2]) / (1.0 + s.wrap[2]), 0.0),
    )
    colour = wp.cw_mul(
        s.albedo,
        wp.cw_mul(direct, light.sun_colour) * (lit * (0.35 + 0.65 * s.occlusion))
        + ambient(light, n, s.sky) * s.occlusion,
    )
    if s.through[0] > 0.0:
        if kind == SPHEROID:  # a long way through the berry: saturated, brightest at the rim
            rim = wp.clamp(0.55 - 0.75 * ndl, 0.0, 1.0)
            sunny = rim * rim * 0.30 * (0.15 + 0.85 * lit) * s.occlusion * (0.25 + 0.75 * s.sky)
            colour += wp.cw_mul(s.through, light.sun_colour * sunny + ambient(light, -n, s.sky) * (0.35 * s.occlusion))
        else:
            colour += wp.cw_mul(
                s.through,
                light.sun_colour * (wp.max(-ndl, 0.0) * lit * 0.55) + ambient(light, -n, s.sky) * (0.30 * s.occlusion),
            )
    if s.gloss > 0.0:
        grazing = 1.0 - wp.max(-wp.dot(n, d), 0.0)
        g2 = grazing * grazing
        fresnel = s.gloss + (1.0 - s.gloss) * g2 * g2 * grazing * wp.min(s.gloss * 14.0, 1.0) * 0.8
        if lit > 0.0 and ndl > -0.05:
            half = wp.normalize(light.sun - d)
            peak = 1.0 - wp.max(wp.dot(n, half), 0.0)
            if s.polish * peak < 8.0:
                colour += light.sun_colour * (
                    fresnel * wp.exp(-s.polish * peak) * (s.polish * 0.14 + 0.4) * lit * (ndl + 0.05)
                )
        if s.mirror * fresnel > 0.006:
            r = d - n * (2.0 * wp.dot(n, d))
            if kind == LEAF:
                above = mix(wp.vec3(0.06, 0.09, 0.03), light.sky_colour, s.sky * s.sky)
                colour += mix(light.bounce, above, 0.5 + 0.5 * r[2]) * (wp.min(fresnel, 0.16) * s.mirror * s.occlusion)
            else:
                colour += mirrored(looks, light, r, s.sky) * (fresnel * s.mirror * s.occlusion)
    colour += s.albedo * s.glow
    return mix(colour, light.haze, 1.0 - wp.exp(-t * 0.003))


@wp.kernel
def shade(
    # model
    shapes: Shapes,
    looks: Looks,
    # in
    light: Light,
    near: ShadowMap,
    far: ShadowMap,
    lens: Pinhole,
    primitive: wp.array(dtype=wp.int32),
    keys: wp.array(dtype=wp.int64),
    run: int,
    # out
    rgb_out: wp.array2d(dtype=wp.uint8),
):
    """One thread colours ``run`` neighbouring pixels from the primitives they see."""
    first = wp.tid() * run
    for pixel in range(first, first + run):
        x = pixel % lens.width
        y = pixel // lens.width
        i = primitive[pixel]
        ray = wp.transpose(lens.turn) * ray_of(lens, x, y)
        scale = wp.length(ray)
        d = ray / scale
        colour = wp.vec3(0.0, 0.0, 0.0)
        if i == -1:
            colour = sky_light(light, d)
        else:
            z = float(keys[pixel] >> wp.int64(32)) * 1.0e-6
            if i == -2:
                z = -lens.eye[2] / ray[2]
            p = lens.eye + ray * z
            footprint = z / lens.fx
            # interleaved gradient noise (Jimenez 2014) turns the shadow samples from pixel to pixel
            f = 0.06711056 * float(x) + 0.00583715 * float(y)
            f = 52.9829189 * (f - wp.floor(f))
            turn = light.turns[int((f - wp.floor(f)) * 64.0) & 63]
            kind = wp.int32(-1)
            s = Surface()
            if i >= 0:
                kind = shapes.kind[i]
                if kind == LEAF:
                    s = leaf_surface(shapes, looks, i, p, d, footprint)
                elif kind == SPHEROID and looks.material[i] == BERRY:
                    s = berry_surface(shapes, looks, i, p, footprint)
                else:
                    s = solid_surface(shapes, looks, i, p, footprint)
            else:
                s = ground_surface(looks, p, footprint)
            colour = shine(looks, light, near, far, s, kind, p, d, z * scale, turn)
        for k in range(3):
            rgb_out[pixel, k] = light.tone[
                wp.clamp(int(wp.sqrt(wp.max(colour[k], 0.0) * light.exposure) * 1024.0), 0, 4095)
            ]
