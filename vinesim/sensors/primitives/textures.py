"""Computed textures that make analytic primitives look like plants: leaf outlines and veins, noise, soil, sky.

Textures are computed from fixed seeds, have linear values, and tile without seams if they repeat. They are stored in
:mod:`vinesim.core.disk_cache`, because computing them takes seconds.
"""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Callable

import cv2
import numpy as np

from vinesim.core import disk_cache
from vinesim.scene import leaves
from vinesim.scene.palette import DEFAULT, SkyColours

GRASS_OUTLINE = leaves.SHAPE_COUNT
HERB_OUTLINE = leaves.SHAPE_COUNT + 1
CLUMP_OUTLINE = leaves.SHAPE_COUNT + 2
"""Indices of the outlines that are not vine leaves: a tuft of grass (``GRASS_OUTLINE``), a broad-leaved herb, and a
clump of many leaves, for plants far away."""
OUTLINE_COUNT = leaves.SHAPE_COUNT + 3
TEXTURE_SIZE = 256
"""Number of texels along each side of square textures."""
_DISTANCE_STEPS = 400.0
SKY_ROWS = 512
SKY_COLUMNS = 1024
_SUPERSAMPLING = 4


@functools.cache
def _digest() -> str:
    """Returns a digest, for the disk cache, of the code that computes the textures."""
    return disk_cache.source_digest(pathlib.Path(__file__), pathlib.Path(leaves.__file__), cv2.__version__)


def _on_disk(make: Callable[[], disk_cache.Arrays]) -> Callable[[], disk_cache.Arrays]:
    """Decorator: returns a function that reads the arrays of ``make`` from the disk cache, or computes and stores
    them."""
    name = make.__name__.strip("_").replace("_", "-")
    return lambda: disk_cache.load_or_make(name, _digest(), make)


def _cached(make: Callable[[], disk_cache.Arrays]) -> Callable[[], disk_cache.Arrays]:
    """Decorator like :func:`_on_disk` that also keeps the arrays in the memory of this process."""
    return functools.cache(_on_disk(make))


def _grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the coordinates u in [-1, 1], v in [-0.75, 1.25] of the centres of a leaf texture's texels.

    The unit is the length of the midrib from petiole to tip; ``side``: number of texels along a side.
    """
    step = (np.arange(side) + 0.5) / side * 2.0
    u, v = np.meshgrid(step - 1.0, step - 0.75)
    return u, v


def leaf_scale(shape: int | np.ndarray) -> np.ndarray:
    """Returns the length from petiole to tip, in units of ``Model.leaf_size``, of leaves with outline ``shape``."""
    return np.array([leaves.midrib_length(i) for i in range(leaves.SHAPE_COUNT)])[shape]


def _signed_distance(mask: np.ndarray) -> np.ndarray:
    """Returns the signed distance [SIDE, SIDE] in leaf units to the edge of a finely sampled mask, positive inside."""
    inside = mask.astype(np.uint8)
    pixels = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    return cv2.resize(pixels, (TEXTURE_SIZE, TEXTURE_SIZE), interpolation=cv2.INTER_AREA) * (
        2.0 / (TEXTURE_SIZE * _SUPERSAMPLING)
    )


def _grass_mask() -> np.ndarray:
    """Returns the finely sampled mask of a tuft of grass: bent, tapering blades that grow from the lower edge."""
    rng = np.random.default_rng(31)
    side = TEXTURE_SIZE * _SUPERSAMPLING
    mask = np.zeros((side, side), np.uint8)
    along = np.linspace(0.0, 1.0, 20)
    for _ in range(30):
        root = rng.uniform(-0.4, 0.4)
        lean = rng.normal(0.6 * root, 0.4)
        height = rng.uniform(0.5, 1.8)
        half = rng.uniform(0.018, 0.036) * (1.0 - along**1.6)
        x = root + lean * along**2
        y = -0.75 + height * along * (1.0 - 0.15 * abs(lean) * along)
        blade = np.concatenate([np.stack([x - half, y], 1), np.stack([x + half, y], 1)[::-1]])
        cv2.fillPoly(mask, [np.round((blade + np.array([1.0, 0.75])) * 0.5 * side).astype(np.int32)], 1)
    return mask


def _clump_mask() -> np.ndarray:
    """Returns the finely sampled mask of a clump of vine leaves with gaps between them."""
    rng = np.random.default_rng(37)
    side = TEXTURE_SIZE * _SUPERSAMPLING
    mask = np.zeros((side, side), np.uint8)
    theta = np.linspace(-np.pi, np.pi, 60)
    for number in range(22):
        shape = number % leaves.SHAPE_COUNT
        angle = 2.4 * number + rng.normal(0.0, 0.3)
        away = 0.74 * np.sqrt((number + 0.5) / 22.0)
        edge = leaves.blade_outline(theta, shape) / leaf_scale(shape) * rng.uniform(0.17, 0.26)
        turn = theta + rng.uniform(0.0, 2.0 * np.pi)
        x = away * np.sin(angle) + edge * np.sin(turn) * rng.uniform(0.55, 1.0)
        y = 0.25 + away * np.cos(angle) + edge * np.cos(turn)
        blade = np.stack([x + 1.0, y + 0.75], 1) * 0.5 * side
        cv2.fillPoly(mask, [np.round(blade).astype(np.int32)], 1)
    return mask


def leaf_outlines() -> tuple[np.ndarray, np.ndarray]:
    """Returns signed distances to the edge of all leaf outlines [outline, SIDE, SIDE] int8 in 1/400 leaf unit, and
    octagons around the outlines [outline, 8, 2] in leaf units."""
    baked = _leaf_outlines()
    return baked["distance"], baked["hull"]


@_cached
def _leaf_outlines() -> disk_cache.Arrays:
    u, v = _grid(TEXTURE_SIZE * _SUPERSAMPLING)
    theta = np.arctan2(u, v)
    radius = np.hypot(u, v)
    table = np.zeros((OUTLINE_COUNT, TEXTURE_SIZE, TEXTURE_SIZE))
    knots = np.linspace(-np.pi, np.pi, 8193)
    for shape in range(leaves.SHAPE_COUNT):
        edge = leaves.blade_outline(knots, shape) / leaf_scale(shape)
        blade = radius < np.interp(theta, knots, edge)
        for hole_u, hole_v, wide in leaves.blade_holes(shape):
            blade &= np.hypot(u - hole_u, v - hole_v) > wide
        table[shape] = _signed_distance(blade)
    table[GRASS_OUTLINE] = _signed_distance(_grass_mask())
    table[HERB_OUTLINE] = _signed_distance((u / 0.42) ** 2 + ((v - 0.45) / 0.55) ** 2 < 1.0)
    table[CLUMP_OUTLINE] = _signed_distance(_clump_mask())
    table = np.clip(table * _DISTANCE_STEPS, -127, 127).astype(np.int8)
    angle = (np.arange(8) + 0.5) * np.pi / 4.0
    normal = np.stack([np.sin(angle), np.cos(angle)], 1)
    hull = np.zeros((OUTLINE_COUNT, 8, 2), np.float32)
    u, v = _grid(TEXTURE_SIZE)
    for shape in range(OUTLINE_COUNT):
        inside = table[shape] > -4
        reach = (np.stack([u[inside], v[inside]], 1) @ normal.T).max(0) + 0.012
        for k in range(8):
            sides = [k, (k + 1) % 8]
            hull[shape, k] = np.linalg.solve(normal[sides], reach[sides])
    return {"distance": table, "hull": hull}


def _smooth_noise(rng: np.random.Generator, sigma: float) -> np.ndarray:
    """Returns Gaussian-filtered noise [SIDE, SIDE] of unit variance; ``sigma``: width of the filter [texel]."""
    noise = cv2.GaussianBlur(rng.normal(size=(TEXTURE_SIZE, TEXTURE_SIZE)).astype(np.float32), (0, 0), sigma)
    return noise / noise.std()


def leaf_texture() -> np.ndarray:
    """Returns the texture of leaves [outline, SIDE/2, SIDE/2, 4] float32: vein strength, slope of the relief along u
    and v, tone."""
    return _leaf_texture()["table"]


@_cached
def _leaf_texture() -> disk_cache.Arrays:
    u, v = _grid(TEXTURE_SIZE)
    table = np.zeros((OUTLINE_COUNT, TEXTURE_SIZE, TEXTURE_SIZE, 4), np.float32)
    for shape in range(leaves.SHAPE_COUNT):
        rng = np.random.default_rng(71 + shape)
        vein = np.zeros_like(u)
        away_from_vein = np.full_like(u, 1.0)
        for angle, length in ((0.0, 1.0), (52.0, 0.90), (-52.0, 0.90), (112.0, 0.72), (-112.0, 0.72)):
            turn = np.radians(angle)
            tip = length * np.array([np.sin(turn), np.cos(turn)])
            away, along = _segment(u, v, np.zeros(2), tip)
            vein = np.maximum(vein, np.exp(-((away / (0.018 * (1.0 - 0.65 * along))) ** 2)))
            away_from_vein = np.minimum(away_from_vein, away)
            for start in np.linspace(0.14, 0.88, 6) + rng.normal(0.0, 0.015, 6):
                for side in (1.0, -1.0):
                    root = (start + 0.05 * side) * tip
                    out = turn + side * np.radians(48.0 + rng.normal(0.0, 4.0))
                    bent = turn + side * np.radians(34.0)  # secondary veins bend towards the tip
                    reach = 0.5 * length * (1.0 - 0.7 * abs(start - 0.35))
                    knee = root + 0.5 * reach * np.array([np.sin(out), np.cos(out)])
                    end = knee + 0.5 * reach * np.array([np.sin(bent), np.cos(bent)])
                    for first, last, wide in ((root, knee, 0.010), (knee, end, 0.007)):
                        away, along = _segment(u, v, first, last)
                        vein = np.maximum(vein, 0.62 * np.exp(-((away / (wide * (1.0 - 0.3 * along))) ** 2)))
                        away_from_vein = np.minimum(away_from_vein, away)
        fine = _smooth_noise(rng, 3.0)
        wide = _smooth_noise(rng, 9.0)
        net = np.exp(-((fine / 0.25) ** 2))  # areoles: where a band-limited noise crosses zero
        puffed = 1.0 - np.exp(-((away_from_vein / 0.05) ** 2))  # the blade rises between its veins
        height = 0.015 * puffed + 0.004 * wide + 0.0018 * fine
        slope_v, slope_u = np.gradient(height, 2.0 / TEXTURE_SIZE)
        tone = 0.47 + 0.05 * wide + 0.07 * fine + 0.15 * np.exp(-((away_from_vein / 0.024) ** 2))
        for spot_u, spot_v, size in rng.uniform((-0.7, -0.4, 0.008), (0.7, 0.8, 0.03), (6 * (shape % 4 > 1), 3)):
            tone -= 1.3 * np.exp(-((np.hypot(u - spot_u, v - spot_v) / size) ** 4))  # spots of blight
        table[shape] = np.stack([np.maximum(vein, 0.16 * net), slope_u, slope_v, tone], -1)
    table[GRASS_OUTLINE, ..., 3] = 0.5 + 0.5 * v
    table[HERB_OUTLINE, ..., 0] = 0.6 * np.exp(-((u / 0.03) ** 2))
    table[HERB_OUTLINE, ..., 3] = 0.5
    table[CLUMP_OUTLINE, ..., 3] = 0.5
    half = table.reshape(OUTLINE_COUNT, TEXTURE_SIZE // 2, 2, TEXTURE_SIZE // 2, 2, 4).mean((2, 4))
    return {"table": np.ascontiguousarray(half, np.float32)}


def _segment(u: np.ndarray, v: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distance of points (u, v) to the segment from ``a`` to ``b``, and the position along it, 0 to 1."""
    d = b - a
    along = np.clip(((u - a[0]) * d[0] + (v - a[1]) * d[1]) / (d @ d), 0.0, 1.0)
    return np.hypot(u - a[0] - along * d[0], v - a[1] - along * d[1]), along


def _periodic_noise(rng: np.random.Generator, lowest: float, power: float) -> np.ndarray:
    """Returns periodic noise [SIDE, SIDE] with a 1/f^power spectrum above the frequency ``lowest``, of zero mean and
    unit variance."""
    cycles = np.fft.fftfreq(TEXTURE_SIZE) * TEXTURE_SIZE
    f = np.hypot(*np.meshgrid(cycles, cycles))
    gain = np.where(f >= lowest, 1.0 / np.maximum(f, lowest) ** power, 0.0)
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(TEXTURE_SIZE, TEXTURE_SIZE))) * gain).real
    return field / field.std()


def noise_texture() -> np.ndarray:
    """Returns four octaves of periodic noise, from coarse to fine: [SIDE, SIDE, 4] float32 from 0 to 1, mean 0.5."""
    return _noise_texture()["table"]


@_cached
def _noise_texture() -> disk_cache.Arrays:
    rng = np.random.default_rng(17)
    bands = [_periodic_noise(rng, low, power) for low, power in ((1, 1.6), (3, 1.4), (10, 1.1), (30, 0.4))]
    return {"table": np.clip(0.5 + 0.2 * np.stack(bands, -1), 0.0, 1.0).astype(np.float32)}


def soil_texture() -> np.ndarray:
    """Returns the texture of 1.25 m x 1.25 m of ground [SIDE, SIDE, 4] float32: tone of clods, sod, slopes along x and
    y."""
    return _soil_texture()["table"]


@_cached
def _soil_texture() -> disk_cache.Arrays:
    rng = np.random.default_rng(43)
    clods = (
        0.55 * _periodic_noise(rng, 3, 1.5)
        + 0.6 * np.abs(_periodic_noise(rng, 4, 1.5))
        + 0.35 * _periodic_noise(rng, 20, 1.0)
    )
    sod = _periodic_noise(rng, 25, 0.7)
    straw = np.zeros((TEXTURE_SIZE, TEXTURE_SIZE), np.float32)
    for x, y, turn, length in zip(*rng.uniform(size=(4, 90)), strict=True):
        start = np.array([x, y]) * TEXTURE_SIZE
        step = (6.0 + 14.0 * length) * np.array([np.cos(np.pi * turn), np.sin(np.pi * turn)])
        end = start + step
        cv2.line(straw, (int(start[0]), int(start[1])), (int(end[0]), int(end[1])), (1.0,), 1, cv2.LINE_AA)
    height = 0.5 * clods + 0.35 * sod
    slope_y, slope_x = (0.5 * (np.roll(height, -1, axis) - np.roll(height, 1, axis)) for axis in (0, 1))
    tone = np.clip(0.45 + 0.17 * clods + 0.5 * straw, 0.0, 1.0)
    green = np.clip(0.5 + 0.22 * sod + 0.3 * straw, 0.0, 1.0)
    return {"table": np.stack([tone, green, -0.9 * slope_x, -0.9 * slope_y], -1).astype(np.float32)}


@_on_disk  # 13 MB, needed only while the sky is computed after the sun has moved
def _sky_layers() -> disk_cache.Arrays:
    """Compute the parts of the sky's texture that do not depend on the sun, as float64.

    Array ``cloud`` is the share of clouds, ``ridges`` and ``tree_share`` are the shares of hills and of trees in front
    of the sky, in the lowest :data:`_RIDGE_ROWS` rows, and ``leafy`` is the tone of the trees, 0 to 1.
    """
    height, azimuth = (np.ascontiguousarray(part) for part in np.broadcast_arrays(*_sky_directions()))
    flat = np.sqrt(1.0 - height**2)
    far = 0.22 / (height + 0.12)
    cover = sample_noise(flat * np.cos(azimuth) * far * 0.5, flat * np.sin(azimuth) * far * 0.5, slice(0, 2))
    cloud = smoothstep(0.56, 0.86, cover[..., 0] + 0.25 * (cover[..., 1] - 0.5)) * smoothstep(0.02, 0.2, height)
    height = height[:_RIDGE_ROWS]
    azimuth = azimuth[:_RIDGE_ROWS]
    turns = azimuth / (2.0 * np.pi)
    shares = []
    for base, rise, count in ((0.045, 0.085, 2.0), (0.020, 0.050, 3.0)):
        ridge = base + rise * (
            sample_noise(turns * count, np.full_like(turns, 0.13 * count), slice(0, 1))[..., 0] - 0.35
        )
        shares.append(smoothstep(0.004, -0.004, height - ridge))
    crowns = 0.014 + 0.020 * sample_noise(turns * 16.0, np.full_like(turns, 0.71), slice(1, 2))[..., 0]
    leafy = sample_noise(turns * 20.0, height * 8.0, slice(2, 3))
    return {
        "cloud": cloud,
        "ridges": np.stack(shares),
        "leafy": leafy,
        "tree_share": smoothstep(0.004, -0.004, height - crowns),
    }


_RIDGE_ROWS = 180
"""Number of rows of the sky's texture that ridges and trees can cover, up to a sine of elevation of 0.12."""
_SKY_BAND = 12
"""Number of rows of the sky's texture that are computed at once, which fit into a core's cache; a divisor of
:data:`_RIDGE_ROWS`."""


def _sky_directions() -> tuple[np.ndarray, np.ndarray]:
    """Returns sine of elevation [row, 1] and azimuth [1, column] rad of the texels of the sky's texture."""
    return np.linspace(0.0, 1.0, SKY_ROWS)[:, None] ** 2, np.linspace(-np.pi, np.pi, SKY_COLUMNS)[None]


def _clear_sky(sky: SkyColours) -> np.ndarray:
    """Returns the colour [row, 1, 3] (linear RGB) of a sky without thin clouds, which does not depend on azimuth.

    A closed layer of clouds has the CIE's standard of an overcast sky: three times as bright above as at the horizon.
    """
    height, _ = _sky_directions()
    horizon = np.exp(-5.5 * height)[..., None]
    clear = (1.0 - horizon) * np.array(sky.zenith) + horizon * np.array(sky.horizon)
    closed = np.array(sky.light) * (0.45 + 0.9 * height[..., None])
    return clear * (1.0 - sky.overcast) + closed * sky.overcast


@functools.lru_cache(maxsize=1)  # cameras of one robot see the same sun
def sky_texture(
    sun: tuple[float, float, float], colour_of_sun: tuple[float, float, float], sky: SkyColours = DEFAULT.sky
) -> np.ndarray:
    """Returns the radiance of the sky [SKY_ROWS, SKY_COLUMNS, 3] float32, by square root of the sine of elevation and
    by azimuth.

    The sky is blue with thin clouds, a halo around the sun that is redder for a low sun, and hills in the haze.
    ``sun``: unit vector towards the sun; ``colour_of_sun``: linear RGB; ``sky``: its colours.
    """
    table = np.empty((SKY_ROWS, SKY_COLUMNS, 3), np.float32)
    layers = _sky_layers()
    for first in range(0, SKY_ROWS, _SKY_BAND):
        rows = slice(first, first + _SKY_BAND)
        table[rows] = _sky_rows(rows, layers, np.array(sun), np.array(colour_of_sun), sky)
    return table


def _sky_rows(
    rows: slice, layers: disk_cache.Arrays, sun: np.ndarray, colour_of_sun: np.ndarray, sky: SkyColours
) -> np.ndarray:
    """Returns some ``rows`` of the sky's texture [row, SKY_COLUMNS, 3], which are all below or all above
    :data:`_RIDGE_ROWS`."""
    height, azimuth = _sky_directions()
    height = height[rows]
    colour = _clear_sky(sky)[rows]
    flat = np.sqrt(1.0 - height**2)
    x = flat * np.cos(azimuth)
    y = flat * np.sin(azimuth)
    away = 1.0 - np.clip(x * sun[0] + y * sun[1] + height * sun[2], 0.0, 1.0)
    halo = 0.07 * np.exp(-6.0 * away) + 0.35 * np.exp(-60.0 * away) + 6.0 * np.exp(-4000.0 * away)
    colour = colour + halo[..., None] * colour_of_sun
    colour = _mix(colour, np.array(sky.cloud), layers["cloud"][rows] * (sky.clouds * (1.0 - sky.overcast)))
    if rows.start < _RIDGE_ROWS:
        for tone, share in zip((sky.far_hills, sky.hills), layers["ridges"], strict=True):
            colour = _mix(colour, np.array(tone), share[rows])
        trees = np.array(sky.trees) + (layers["leafy"][rows] - 0.5) * np.array(sky.trees_spread)
        colour = _mix(colour, trees, layers["tree_share"][rows])
    return colour


def sample_noise(x: np.ndarray, y: np.ndarray, octaves: slice = slice(None)) -> np.ndarray:
    """Returns the noise texture [..., 4], of period 1, interpolated bilinearly at positions (x, y) [...].

    ``octaves``: the octaves (last index) to return.
    """
    table = np.ascontiguousarray(noise_texture()[..., octaves]).reshape(TEXTURE_SIZE**2, -1)
    fx = (x % 1.0) * TEXTURE_SIZE
    fy = (y % 1.0) * TEXTURE_SIZE
    i = fx.astype(int) % TEXTURE_SIZE
    j = fy.astype(int) % TEXTURE_SIZE
    ax = (fx % 1.0)[..., None]
    ay = (fy % 1.0)[..., None]
    right = (i + 1) % TEXTURE_SIZE
    here = j * TEXTURE_SIZE
    above = (j + 1) % TEXTURE_SIZE * TEXTURE_SIZE
    upper = table.take(here + i, 0) * (1.0 - ax) + table.take(here + right, 0) * ax
    lower = table.take(above + i, 0) * (1.0 - ax) + table.take(above + right, 0) * ax
    return upper * (1.0 - ay) + lower * ay


def smoothstep(a: float, b: float, x: np.ndarray) -> np.ndarray:
    t = np.clip((x - a) / (b - a), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _mix(a: np.ndarray, b: np.ndarray, t: np.ndarray) -> np.ndarray:
    return a * (1.0 - t[..., None]) + b * t[..., None]


@functools.cache
def tone_curve() -> np.ndarray:
    """Returns the tone curve [4096]: 8-bit sRGB by the square root of exposed radiance from 0 to 4.

    It is the filmic curve of Narkowicz (2015), followed by the sRGB encoding of IEC 61966-2-1.
    """
    x = (np.arange(4096) / 1024.0) ** 2
    film = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0)
    srgb = np.where(film <= 0.0031308, 12.92 * film, 1.055 * film ** (1.0 / 2.4) - 0.055)
    return np.round(srgb * 255.0).astype(np.uint8)
