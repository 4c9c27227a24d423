"""Shading of live pictures on a CPU: points are sorted by class of surface, then shaded eight at once.

Within each block of 2 x 2 pixels, a visible primitive is shaded once: at one point, the mean of its pixels. Points are
sorted into lists of one class. A loop over a list has no branch, so that LLVM vectorises it by eight
(docs/decisions/raster.md). The result approximates :mod:`vinesim.kernels.shading.deferred`, which also shades the class
of all other surfaces (wood, robots, people, crates).
"""

import warp as wp

from vinesim.kernels.compiler_flags import INLINE_ALL
from vinesim.kernels.raster.pinhole import BATCH, FloatBatch, Pinhole
from vinesim.kernels.raster.primitives import LEAF, SPHEROID, Shapes
from vinesim.kernels.shading.deferred import Light, fast_atan2, surface_light
from vinesim.kernels.shading.materials import BERRY, Materials, mix
from vinesim.kernels.shading.shadow_maps import SUN_DISTANCE, ShadowMap

wp.set_module_options({"enable_backward": False, "fast_math": True, "cpu_compiler_flags": INLINE_ALL})

SKY = wp.constant(0)
GROUND = wp.constant(1)
BLADES = wp.constant(2)
BERRIES = wp.constant(3)
OTHERS = wp.constant(4)
CLASS_COUNT = 5
"""Number of classes of points that are shaded separately: sky, ground, leaves and grass, berries, all others."""


@wp.struct
class Points:
    """Points to be shaded, in lists; the arrays are flattened from [list, class, place in the list]."""

    u: wp.array(dtype=wp.float32)
    """Mean column of the pixels of a point [px]."""
    v: wp.array(dtype=wp.float32)
    """Mean row [px]."""
    z: wp.array(dtype=wp.float32)
    """Mean depth [m]."""
    primitive: wp.array(dtype=wp.int32)
    pixels: wp.array(dtype=wp.int32)
    """Index of the block's upper left pixel times 16, plus one bit for each of the block's four pixels that show the
    point's primitive."""
    count: wp.array2d(dtype=wp.int32)
    """[list, class] Number of points."""
    capacity: int
    """Largest number of points of one class in one list."""


@wp.struct
class FloatTables:
    """Arrays of primitives and materials as scalars, because LLVM vectorises loads of scalars but not of vectors."""

    a: wp.array2d(dtype=wp.float32)
    b: wp.array2d(dtype=wp.float32)
    c: wp.array2d(dtype=wp.float32)
    d: wp.array2d(dtype=wp.float32)
    tint: wp.array2d(dtype=wp.float32)
    outline: wp.array(dtype=wp.int8)
    """[outline * 256 * 256] signed distance to the leaf's edge, as in ``Shapes.outline``."""
    leaf_texture: wp.array2d(dtype=wp.float32)
    """[texel, 4] Vein strength, slopes of the relief and tone of leaves."""
    noise: wp.array2d(dtype=wp.float32)
    """[texel, 4] Four octaves of noise."""
    soil: wp.array2d(dtype=wp.float32)
    """[texel, 4] Tone, sod and slopes of the ground."""
    sky_table: wp.array2d(dtype=wp.float32)
    """[texel, 3] Radiance of the sky, linear RGB."""
    ground_sky: wp.array(dtype=wp.float32)
    """[cell] Share of the sky that is visible from the ground; flattened from rows and columns."""


@wp.struct
class ShadowMaps:
    """The near and the far shadow map with their depths in one array, so that eight SIMD lanes can read different
    maps."""

    near: ShadowMap
    far: ShadowMap
    depth: wp.array(dtype=wp.float32)
    """Depths [m] of the near map's texels, followed by the depths of the far map's texels."""


@wp.func
def point_class(shapes: Shapes, materials: Materials, i: int) -> int:
    """Returns the shading class (0 to :data:`CLASS_COUNT` - 1) of a point on primitive ``i`` (-1: the sky, -2: the
    ground)."""
    if i < 0:
        return wp.where(i == -1, SKY, GROUND)
    kind = shapes.kind[i]
    material = materials.material[i]
    if kind == LEAF:
        return BLADES
    return wp.where(kind == SPHEROID and material == BERRY, BERRIES, OTHERS)


@wp.kernel
def sort_points(
    # model
    shapes: Shapes,
    materials: Materials,
    # in
    lens: Pinhole,
    primitive: wp.array(dtype=wp.int32),
    keys: wp.array(dtype=wp.int64),
    rows: int,
    first_list: int,
    points: Points,
    # out
    u_out: wp.array(dtype=wp.float32),
    v_out: wp.array(dtype=wp.float32),
    z_out: wp.array(dtype=wp.float32),
    primitive_out: wp.array(dtype=wp.int32),
    pixels_out: wp.array(dtype=wp.int32),
    count_out: wp.array2d(dtype=wp.int32),
):
    """One thread sorts the points of ``rows`` rows of 2 x 2 pixel blocks by class into one list.

    primitive: [pixel] -1 the sky, -2 the ground; keys: [pixel] depth [um] in the upper 32 bits; first_list: list of
    thread 0; points: only ``capacity`` is read; the outputs are the arrays of :class:`Points`.
    """
    number = first_list + wp.tid()
    counts = wp.types.vector(length=8, dtype=wp.int32)
    last_row = wp.min((number + 1) * rows * 2, lens.height)
    for top in range(number * rows * 2, last_row, 2):
        for left in range(0, lens.width, 2):
            pixel = top * lens.width + left
            done = wp.int32(0)  # one bit for each pixel of the block that already has a point or is outside the picture
            if left + 1 >= lens.width:
                done = 10
            if top + 1 >= lens.height:
                done = done | 12
            while done != 15:
                u = float(0.0)
                v = float(0.0)
                depth = float(0.0)
                nearness = float(0.0)
                share = float(0.0)
                mask = wp.int32(0)
                i = wp.int32(-3)
                for k in range(4):
                    if (done >> k) & 1 == 0:
                        at = pixel + (k & 1) + (k >> 1) * lens.width
                        if i == -3:
                            i = primitive[at]
                        if primitive[at] == i:
                            mask = mask | (1 << k)
                            u += float(k & 1)
                            v += float(k >> 1)
                            depth += float(keys[at] >> wp.int64(32))
                            nearness += 1.0 / wp.max(float(keys[at] >> wp.int64(32)), 1.0)
                            share += 1.0
                done = done | mask
                kind = point_class(shapes, materials, i)
                slot = (number * CLASS_COUNT + kind) * points.capacity + counts[kind]
                counts[kind] = counts[kind] + 1
                u_out[slot] = float(left) + u / share
                v_out[slot] = float(top) + v / share
                z_out[slot] = depth / share * 1.0e-6
                if i == -2:  # on a plane 1 / z is linear in the picture
                    z_out[slot] = share / nearness * 1.0e-6
                primitive_out[slot] = i
                pixels_out[slot] = (pixel << 4) | mask
    for k in range(CLASS_COUNT):
        count_out[number, k] = counts[k]


@wp.func
def point_ray(lens: Pinhole, back: wp.mat33, u: float, v: float) -> wp.vec3:
    """Returns the ray through image point (u, v) [px], in the world's frame, with length 1 along the optical axis.

    ``back`` is the rotation from the optical frame to the world.
    """
    return back * wp.vec3((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, 1.0)


@wp.func
def unit(v: wp.vec3) -> wp.vec3:
    """Returns ``v`` normalised to length 1; unlike Warp's ``normalize`` it has no branch, so that it vectorises."""
    return v * (1.0 / wp.sqrt(wp.dot(v, v) + 1.0e-20))


@wp.func
def write_light(code: int, width: int, colour: wp.vec3, radiance_out: wp.array(dtype=wp.vec3)):
    """Write a point's radiance ``colour`` to its pixels; ``code`` is an element of :attr:`Points.pixels`."""
    first = code >> 4
    if code & 1 != 0:
        radiance_out[first] = colour
    if code & 2 != 0:
        radiance_out[first + 1] = colour
    if code & 4 != 0:
        radiance_out[first + width] = colour
    if code & 8 != 0:
        radiance_out[first + width + 1] = colour


@wp.func
def falling_exp(x: float) -> float:
    """Returns exp(-x) for x >= 0 with an error up to 0.012, by arithmetic that LLVM can vectorise (it cannot
    ``exp``)."""
    y = wp.max(1.0 - x * 0.0625, 0.0)
    y = y * y
    y = y * y
    y = y * y
    return y * y


@wp.func
def sun_share(maps: ShadowMaps, p: wp.vec3, n: wp.vec3, sky: float) -> float:
    """Returns the visible share of the sun's disc at ``p`` [m], by a box filter of two texels of a shadow map.

    The near map is read where it covers the point, else the far map; outside both, ``sky``, the share of visible sky,
    decides. ``n``: unit normal on the side of the sun.
    """
    side = float(maps.near.side)
    e = p - maps.near.corner
    x = wp.dot(e, maps.near.right) / maps.near.texel
    y = wp.dot(e, maps.near.up) / maps.near.texel
    is_near = x > 10.0 and y > 10.0 and x < side - 11.0 and y < side - 11.0
    texel = wp.where(is_near, maps.near.texel, maps.far.texel)
    side = wp.where(is_near, side, float(maps.far.side))
    facing = wp.abs(wp.dot(n, maps.near.sun))
    e = (
        p
        + n * (texel * (1.0 + 1.6 * (1.0 - facing)))
        - wp.vec3(
            wp.where(is_near, maps.near.corner[0], maps.far.corner[0]),
            wp.where(is_near, maps.near.corner[1], maps.far.corner[1]),
            wp.where(is_near, maps.near.corner[2], maps.far.corner[2]),
        )
    )
    x = wp.dot(e, maps.near.right) / texel + 0.5
    y = wp.dot(e, maps.near.up) / texel + 0.5
    inside = x > 8.0 and y > 8.0 and x < side - 9.0 and y < side - 9.0
    x = wp.clamp(x, 8.0, side - 9.0)
    y = wp.clamp(y, 8.0, side - 9.0)
    steep = wp.sqrt(wp.max(1.0 - facing * facing, 0.0)) / wp.max(facing, 0.12)
    z = SUN_DISTANCE - wp.dot(e, maps.near.sun) - texel * (0.4 + 0.7 * steep)
    i = int(x)
    j = int(y)
    across = int(side)
    at = j * across + i + wp.where(is_near, 0, maps.near.side * maps.near.side)
    gap = z - maps.depth[at]
    spread = wp.where(gap > 0.0, wp.clamp(0.0047 * gap / texel, 1.0, 6.0), 1.6)
    z -= spread * texel * 0.3
    a = x - float(i)
    b = y - float(j)
    lit = sun_row(maps.depth, at - across, z, a) * (1.0 - b)
    lit += sun_row(maps.depth, at, z, a)
    lit += sun_row(maps.depth, at + across, z, a) * b
    return wp.where(inside, lit * 0.25, wp.where(sky > 0.7, 1.0, sky))


@wp.func
def sun_row(depth: wp.array(dtype=wp.float32), at: int, z: float, a: float) -> float:
    """Returns the weighted number of lit texels among the three around index ``at``; the outer weights are 1 - a and a.

    A texel is lit if its depth [m] exceeds ``z``.
    """
    left = wp.where(depth[at - 1] > z, 1.0 - a, 0.0)
    middle = wp.where(depth[at] > z, 1.0, 0.0)
    return left + middle + wp.where(depth[at + 1] > z, a, 0.0)


@wp.func
def haze(light: Light, colour: wp.vec3, distance: float) -> wp.vec3:
    """Returns the radiance ``colour`` as it appears through ``distance`` [m] of hazy air."""
    return mix(colour, light.haze_colour, 0.6 * (1.0 - falling_exp(distance * light.haze_rate)))


@wp.kernel
def light_others(
    # model
    shapes: Shapes,
    materials: Materials,
    # in
    light: Light,
    near: ShadowMap,
    far: ShadowMap,
    lens: Pinhole,
    points: Points,
    first_list: int,
    # out
    radiance_out: wp.array(dtype=wp.vec3),
):
    """One thread shades, one by one, the points of one list that are neither sky, ground, leaf, grass nor berry.

    first_list: list of thread 0; radiance: [pixel] linear RGB.
    """
    number = first_list + wp.tid()
    first = (number * CLASS_COUNT + OTHERS) * points.capacity
    back = wp.transpose(lens.rotation)
    for slot in range(first, first + points.count[number, OTHERS]):
        ray = point_ray(lens, back, points.u[slot], points.v[slot])
        i = points.primitive[slot]
        colour = surface_light(shapes, materials, light, near, far, lens, i, ray, points.z[slot], 0, 0, 2)
        write_light(points.pixels[slot], lens.width, colour, radiance_out)


def point_kernel(module: str, name: str, kind: int, light_point: wp.Function) -> wp.Kernel:
    """Returns a kernel that shades the points of class ``kind`` with the function ``light_point``, eight at a time.

    ``module``: Warp module of the kernel; ``name``: key of the kernel within the module.
    """
    kind = wp.constant(kind)

    def light_list(
        # model
        tables: FloatTables,
        materials: Materials,
        # in
        light: Light,
        maps: ShadowMaps,
        lens: Pinhole,
        points: Points,
        first_list: int,
        # out
        radiance_out: wp.array(dtype=wp.vec3),
    ):
        """One thread shades the points of one class of surface in one list, eight at a time.

        first_list: list of thread 0; radiance: [pixel] linear RGB.
        """
        number = first_list + wp.tid()
        start = (number * CLASS_COUNT + kind) * points.capacity
        end = start + points.count[number, kind]
        back = wp.transpose(lens.rotation)
        red = FloatBatch()
        green = FloatBatch()
        blue = FloatBatch()
        for first in range(start, end, BATCH):
            count = wp.min(end - first, BATCH)
            whole = (count + 7) // 8 * 8
            m = wp.int32(0)
            while m < whole:
                slot = first + wp.min(m, count - 1)
                colour = light_point(tables, materials, light, maps, lens, back, points, slot)
                red[m] = colour[0]
                green[m] = colour[1]
                blue[m] = colour[2]
                m += 1
            for k in range(count):
                write_light(points.pixels[first + k], lens.width, wp.vec3(red[k], green[k], blue[k]), radiance_out)

    return wp.Kernel(light_list, key=name, module=wp.get_module(module))


@wp.func
def sky_light(
    tables: FloatTables,
    materials: Materials,
    light: Light,
    maps: ShadowMaps,
    lens: Pinhole,
    back: wp.mat33,
    points: Points,
    slot: int,
) -> wp.vec3:
    """Returns the radiance (linear RGB) of point ``slot`` of :class:`Points`, which shows the sky."""
    rows = light.sky_table.shape[0]
    columns = light.sky_table.shape[1]
    d = unit(point_ray(lens, back, points.u[slot], points.v[slot]))
    x = (fast_atan2(d[1], d[0]) * 0.15915494 + 0.5) * float(columns - 1)
    y = wp.sqrt(wp.max(d[2], 0.0)) * float(rows - 1)
    i = wp.clamp(int(x), 0, columns - 2)
    j = wp.clamp(int(y), 0, rows - 2)
    fx = x - float(i)
    fy = y - float(j)
    at = j * columns + i
    a = (1.0 - fx) * (1.0 - fy)
    b = fx * (1.0 - fy)
    c = (1.0 - fx) * fy
    e = fx * fy
    under = at + columns
    t = tables.sky_table
    return wp.vec3(
        t[at, 0] * a + t[at + 1, 0] * b + t[under, 0] * c + t[under + 1, 0] * e,
        t[at, 1] * a + t[at + 1, 1] * b + t[under, 1] * c + t[under + 1, 1] * e,
        t[at, 2] * a + t[at + 1, 2] * b + t[under, 2] * c + t[under + 1, 2] * e,
    )


light_sky = point_kernel(__name__, "light_sky", SKY, sky_light)
