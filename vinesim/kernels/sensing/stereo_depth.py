"""What a stereo camera measures of what it sees: disparity by windows, what the second imager misses, noise, steps.

Disparity d = f B / z, in pixels of the imagers, which may be coarser than the picture that the depth is aligned to.
"""

import warp as wp

from vinesim.kernels.raster.pinhole import Pinhole, pixel_ray

wp.set_module_options({"enable_backward": False, "fast_math": False})

WINDOW_SIDE = wp.constant(5)
"""A window is looked at in 5 x 5 places; first in 3 x 3 of them, which is enough where there is no edge."""
WindowDisparities = wp.types.vector(length=25, dtype=wp.float32)
"""Disparities there [px]."""
SURFACE_GAP = wp.constant(1.0)
"""Surfaces whose disparities differ by more than this [px], and by more than slant explains, are two to a matcher."""


@wp.struct
class Stereo:
    """One kind of stereo camera (:class:`vinesim.sensors.camera.stereo.StereoSpec`)."""

    focal_baseline: float
    """Focal length times baseline [px m]: disparity = focal_baseline / depth."""
    baseline: float
    scale: float
    """Imager pixels along one pixel of the picture, at most 1: a picture may be finer than what is measured."""
    stride: int
    """Between two places of a window [px of the picture]."""
    sigma: float
    """Of disparity [px]."""
    step: float
    """Of disparity [px]."""
    nearest: float
    farthest: float
    fattening: float
    support: float
    slant_kept: float
    """Cosine of the angle between ray and normal from which on every surface is measured."""
    slant_lost: float
    """Up to this cosine none is."""
    slope: float
    """How much disparity changes within a window, as a share of it, on a surface that is just measured for certain."""
    contrast: float
    projector: float
    saturation: float


@wp.func
def surface_gap(slope: float, d: float) -> float:
    """From which difference [px] on two disparities near ``d`` are those of two surfaces."""
    return SURFACE_GAP + slope * d


@wp.func
def normal_cdf(z: float) -> float:
    """Share of a normal distribution below ``z``, to 0.01."""
    return 1.0 / (1.0 + wp.exp(-1.702 * z))


@wp.func
def linear_step(low: float, high: float, x: float) -> float:
    """0 below ``low``, 1 above ``high``, straight between them."""
    return wp.clamp((x - low) / wp.max(high - low, 1.0e-6), 0.0, 1.0)


@wp.func
def first_pixel(cell: int, scale: float) -> int:
    """First pixel of the picture in an imager's pixel."""
    return int(wp.ceil(float(cell) / scale))


@wp.kernel
def measure_depth(
    # model
    stereo: Stereo,
    # in
    lens: Pinhole,
    second: Pinhole,
    disparity: wp.array(dtype=wp.float32),
    grey: wp.array(dtype=wp.uint8),
    second_depth: wp.array(dtype=wp.float32),
    noise: wp.array3d(dtype=wp.float32),
    run: int,
    # out
    depth_out: wp.array(dtype=wp.float32),
):
    """One thread measures ``run`` pixels of the imager for the picture; NaN where no match is found (REP-118)."""
    first = wp.tid() * run
    columns = noise.shape[2]
    focal_baseline = stereo.focal_baseline
    slope = stereo.slope
    stride = stereo.stride
    width = lens.width
    height = lens.height
    for cell in range(first, first + run):
        column = cell % columns
        row = cell // columns
        left = first_pixel(column, stereo.scale)
        right = wp.min(first_pixel(column + 1, stereo.scale), width)
        top = first_pixel(row, stereo.scale)
        bottom = wp.min(first_pixel(row + 1, stereo.scale), height)
        x = wp.min((left + right) // 2, width - 1)
        y = wp.min((top + bottom) // 2, height - 1)
        pixel = y * width + x
        own = disparity[pixel]
        # what stands in the window, and how bright it is
        nearest = own
        farthest = own
        total = float(0.0)
        across = float(0.0)
        down = float(0.0)
        bright = float(0.0)
        darkest = float(255.0)
        brightest = float(0.0)
        for k in range(9):
            i = wp.clamp(x + (k % 3 - 1) * 2 * stride, 0, width - 1)
            j = wp.clamp(y + (k // 3 - 1) * 2 * stride, 0, height - 1)
            at = j * width + i
            d = disparity[at]
            nearest = wp.max(nearest, d)
            farthest = wp.min(farthest, d)
            total += d
            across += d * float(k % 3 - 1)
            down += d * float(k // 3 - 1)
            light = float(grey[at])
            bright += light / 9.0
            darkest = wp.min(darkest, light)
            brightest = wp.max(brightest, light)
        found = total / 9.0
        agree = float(1.0)
        slant = float(1.0)
        if wp.max(nearest - own, own - farthest) < surface_gap(slope, own):
            if own > 0.0:  # 1 / z is linear in the picture: its slopes are those of the surface
                ray = pixel_ray(lens, x, y)
                per = 1.0 / (12.0 * float(stride) * focal_baseline)
                a = across * per * lens.fx
                b = down * per * lens.fy
                inverse = own / focal_baseline
                normal = wp.vec3(a, b, inverse - a * ray[0] - b * ray[1])
                slant = inverse / (wp.length(normal) * wp.length(ray))
        else:  # an edge: the window goes to the surface that fills most of it
            disparities = WindowDisparities()
            for k in range(WINDOW_SIDE * WINDOW_SIDE):
                i = wp.clamp(x + (k % WINDOW_SIDE - WINDOW_SIDE // 2) * stride, 0, width - 1)
                j = wp.clamp(y + (k // WINDOW_SIDE - WINDOW_SIDE // 2) * stride, 0, height - 1)
                d = disparity[j * width + i]
                disparities[k] = d
                nearest = wp.max(nearest, d)
                farthest = wp.min(farthest, d)
            best = float(-1.0)
            for c in range(3):
                candidate = wp.where(c == 0, nearest, wp.where(c == 1, own, farthest))
                within = surface_gap(slope, candidate)
                votes = float(0.0)
                mean = float(0.0)
                for k in range(WINDOW_SIDE * WINDOW_SIDE):
                    mine = wp.where(wp.abs(disparities[k] - candidate) < within, 1.0, 0.0)
                    votes += mine
                    mean += mine * disparities[k]
                weight = votes * wp.where(c == 0, stereo.fattening, 1.0)
                if weight > best:
                    best = weight
                    agree = votes / float(WINDOW_SIDE * WINDOW_SIDE)
                    found = mean / votes
        # what is not measured at all
        kept = agree >= stereo.support
        lost = float(0.0)
        if own > 0.0:
            there = int(wp.round((float(x) - lens.cx) / lens.fx * second.fx - own + second.cx))
            level = int(wp.round((float(y) - lens.cy) / lens.fy * second.fy + second.cy))
            level = wp.clamp(level, 0, second.height - 1)
            if there < 0 or there >= second.width:
                kept = False
            elif focal_baseline > second_depth[level * second.width + there] * (own + surface_gap(slope, own)):
                kept = False  # something else stands before it there
            lost = 1.0 - linear_step(stereo.slant_lost, stereo.slant_kept, slant)
            if brightest - darkest < stereo.contrast:
                lost = wp.max(lost, linear_step(stereo.projector, 2.0 * stereo.projector, focal_baseline / own))
            if bright >= stereo.saturation:
                lost = 1.0
        kept = kept and normal_cdf(noise[1, row, column]) >= lost
        z = float(wp.inf)
        if found > 0.0:
            noisy = found + stereo.sigma * noise[0, row, column]
            if stereo.step > 0.0:
                noisy = wp.round(noisy / stereo.step) * stereo.step
            if noisy > 0.0:
                z = focal_baseline / noisy
        if z > stereo.farthest:
            z = float(wp.inf)
        elif z < stereo.nearest:
            z = -float(wp.inf)
        elif not kept:
            z = float(wp.nan)
        for j in range(top, bottom):
            for i in range(left, right):
                depth_out[j * width + i] = z
