"""Model of a stereo camera's depth: matching by windows, occlusion in the second imager, noise and quantisation.

Disparity d = f B / z (focal length, baseline, depth) is in pixels of the imagers. The imagers may have fewer pixels
than the picture to which the depth is aligned.
"""

import warp as wp

from vinesim.kernels.raster.pinhole import Pinhole, pixel_ray

wp.set_module_options({"enable_backward": False, "fast_math": False, "max_unroll": 25})

WindowDisparities = wp.types.vector(length=25, dtype=wp.float32)
"""Disparities [px] at 5 x 5 points of a matching window. They are read only at edges; elsewhere 3 x 3 points suffice.
"""
SURFACE_GAP = wp.constant(1.0)
"""Difference of disparity [px], beyond the change that slant explains, from which the matcher separates two surfaces.
"""


@wp.struct
class Stereo:
    """Parameters of one kind of stereo camera (:class:`vinesim.sensors.camera.stereo.StereoSpec`)."""

    focal_baseline: float
    """Focal length times baseline [px m]: disparity = focal_baseline / depth."""
    baseline: float
    scale: float
    """Width of a pixel of the picture in pixels of the imager, at most 1 (the picture may have more pixels)."""
    stride: int
    """Distance between neighbouring points of a matching window [px of the picture]."""
    sigma: float
    """Standard deviation of the disparity's noise [px]."""
    step: float
    """Quantisation step of the disparity [px]."""
    nearest: float
    farthest: float
    fattening: float
    support: float
    slant_kept: float
    """Cosine between ray and normal; above it slant never prevents a match."""
    slant_lost: float
    """Cosine between ray and normal; below it no surface is matched."""
    slope: float
    """Relative change of disparity within a window on a surface with the slant ``slant_kept``."""
    contrast: float
    projector: float
    saturation: float


@wp.func
def surface_gap(slope: float, d: float) -> float:
    """Returns the least difference [px] of two disparities near ``d`` [px] that belong to different surfaces.

    ``slope`` is the largest relative change of disparity on one slanted surface.
    """
    return SURFACE_GAP + slope * d


@wp.func
def normal_cdf(z: float) -> float:
    """Returns the standard normal cumulative distribution at ``z``, with an error up to 0.01 (logistic function)."""
    return 1.0 / (1.0 + wp.exp(-1.702 * z))


@wp.func
def linear_step(low: float, high: float, x: float) -> float:
    """Returns 0 for ``x`` below ``low``, 1 above ``high``, and a linear interpolation between."""
    return wp.clamp((x - low) / wp.max(high - low, 1.0e-6), 0.0, 1.0)


@wp.func
def first_pixel(cell: int, scale: float) -> int:
    """Returns the first column (or row) of the picture within column (or row) ``cell`` of the imager."""
    return int(wp.ceil(float(cell) / scale))


@wp.struct
class WindowStatistics:
    """Statistics of disparity and grey level over 3 x 3 points of a matching window."""

    nearest: float
    """Largest disparity [px]."""
    farthest: float
    """Smallest disparity [px]."""
    total: float
    """Sum of the disparities [px]."""
    across: float
    """Sum of disparities of the right column minus the sum of the left column [px]."""
    down: float
    """Sum of disparities of the lowest row minus the sum of the uppermost row [px]."""
    brightness: float
    """Mean grey level, 0 to 255."""
    darkest: float
    brightest: float


@wp.func
def window_statistics(
    disparity: wp.array(dtype=wp.float32), grey: wp.array(dtype=wp.uint8), lens: Pinhole, x: int, y: int, stride: int
) -> WindowStatistics:
    """Returns the statistics of 3 x 3 points, ``2 stride`` pixels apart, around pixel (x, y) of the picture.

    disparity: [pixel] px; grey: [pixel] 0 to 255.
    """
    o = WindowStatistics()
    own = disparity[y * lens.width + x]
    o.nearest = own
    o.farthest = own
    o.darkest = 255.0
    for k in range(9):
        i = wp.clamp(x + (k % 3 - 1) * 2 * stride, 0, lens.width - 1)
        j = wp.clamp(y + (k // 3 - 1) * 2 * stride, 0, lens.height - 1)
        at = j * lens.width + i
        d = disparity[at]
        o.nearest = wp.max(o.nearest, d)
        o.farthest = wp.min(o.farthest, d)
        o.total += d
        o.across += d * float(k % 3 - 1)
        o.down += d * float(k // 3 - 1)
        light = float(grey[at])
        o.brightness += light / 9.0
        o.darkest = wp.min(o.darkest, light)
        o.brightest = wp.max(o.brightest, light)
    return o


@wp.func
def is_edge(stereo: Stereo, own: float, nearest: float, farthest: float) -> bool:
    """Returns whether a window contains more than one surface.

    ``own``, ``nearest`` and ``farthest`` are the disparities [px] at the window's middle, the largest and the smallest.
    """
    return not (wp.max(nearest - own, own - farthest) < surface_gap(stereo.slope, own))


@wp.func
def surface_slant(stereo: Stereo, lens: Pinhole, across: float, down: float, x: int, y: int, own: float) -> float:
    """Returns the cosine between the ray of pixel (x, y) and the normal of the surface in its matching window.

    On a plane 1 / z is linear in the pixel coordinates, so differences of disparity determine the normal. ``across``
    and ``down``: see :class:`WindowStatistics` [px]; ``own``: disparity at the middle [px].
    """
    ray = pixel_ray(lens, x, y)
    per = 1.0 / (12.0 * float(stereo.stride) * stereo.focal_baseline)
    a = across * per * lens.fx
    b = down * per * lens.fy
    inverse = own / stereo.focal_baseline
    normal = wp.vec3(a, b, inverse - a * ray[0] - b * ray[1])
    return inverse / (wp.length(normal) * wp.length(ray))


@wp.func
def match_window(
    stereo: Stereo,
    disparity: wp.array(dtype=wp.float32),
    lens: Pinhole,
    window_nearest: float,
    window_farthest: float,
    x: int,
    y: int,
) -> wp.vec2:
    """Returns the disparity [px] of the surface that covers most of a matching window at an edge, and its share of the
    window (0 to 1).

    Candidates are the nearest surface, the one at the middle pixel (x, y) and the farthest; ``window_nearest`` and
    ``window_farthest`` [px] are the window's extreme disparities. The code has no branch, so that it vectorises.
    """
    disparities = WindowDisparities()
    own = disparity[y * lens.width + x]
    nearest = window_nearest
    farthest = window_farthest
    for k in range(25):
        i = wp.clamp(x + (k % 5 - 2) * stereo.stride, 0, lens.width - 1)
        j = wp.clamp(y + (k // 5 - 2) * stereo.stride, 0, lens.height - 1)
        d = disparity[j * lens.width + i]
        disparities[k] = d
        nearest = wp.max(nearest, d)
        farthest = wp.min(farthest, d)
    best = float(-1.0)
    found = float(0.0)
    agree = float(1.0)
    for c in range(3):
        candidate = wp.where(c == 0, nearest, wp.where(c == 1, own, farthest))
        within = surface_gap(stereo.slope, candidate)
        votes = float(0.0)
        mean = float(0.0)
        for k in range(25):
            mine = wp.where(wp.abs(disparities[k] - candidate) < within, 1.0, 0.0)
            votes += mine
            mean += mine * disparities[k]
        weight = votes * wp.where(c == 0, stereo.fattening, 1.0)
        better = weight > best
        best = wp.where(better, weight, best)
        agree = wp.where(better, votes / 25.0, agree)
        found = wp.where(better, mean / votes, found)
    return wp.vec2(found, agree)


@wp.func
def seen_by_second(
    stereo: Stereo,
    lens: Pinhole,
    second: Pinhole,
    second_depth: wp.array(dtype=wp.float32),
    row: int,
    x: int,
    own: float,
) -> bool:
    """Returns whether a surface with disparity ``own`` [px] in column ``x`` of the picture is in the second imager's
    view and not occluded there.

    ``row``: row of the second imager; second_depth: [pixel of the second imager] m.
    """
    column = int(wp.round((float(x) - lens.cx) / lens.fx * second.fx - own + second.cx))
    if column < 0 or column >= second.width:
        return False
    near = second_depth[row * second.width + column] * (own + surface_gap(stereo.slope, own))
    return not (stereo.focal_baseline > near)


@wp.func
def second_row(lens: Pinhole, second: Pinhole, y: int) -> int:
    """Returns the row of the stereo camera's second imager (image sensor) that corresponds to row ``y`` of the picture."""
    row = int(wp.round((float(y) - lens.cy) / lens.fy * second.fy + second.cy))
    return wp.clamp(row, 0, second.height - 1)


@wp.func
def loss_probability(stereo: Stereo, brightness: float, contrast: float, slant: float, own: float) -> float:
    """Returns the probability that a window finds no match: too slanted, without texture, or overexposed.

    ``brightness``, ``contrast``: mean and range of grey levels, 0 to 255; ``slant``: cosine between ray and normal;
    ``own``: disparity [px].
    """
    lost = 1.0 - linear_step(stereo.slant_lost, stereo.slant_kept, slant)
    if contrast < stereo.contrast:
        lost = wp.max(lost, linear_step(stereo.projector, 2.0 * stereo.projector, stereo.focal_baseline / own))
    if brightness >= stereo.saturation:
        lost = 1.0
    return lost


@wp.func
def reported_depth(stereo: Stereo, disparity: float, is_matched: bool, noise: float) -> float:
    """Returns the depth [m], as REP-118 defines it, for a ``disparity`` [px] with added noise and quantisation.

    ``noise`` is a standard normal number; the result is NaN without a match, infinite beyond the range.
    """
    z = float(wp.inf)
    if disparity > 0.0:
        noisy = disparity + stereo.sigma * noise
        if stereo.step > 0.0:
            noisy = wp.round(noisy / stereo.step) * stereo.step
        if noisy > 0.0:
            z = stereo.focal_baseline / noisy
    if z > stereo.farthest:
        z = float(wp.inf)
    elif z < stereo.nearest:
        z = -float(wp.inf)
    elif not is_matched:
        z = float(wp.nan)
    return z


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
    """One thread measures depth in ``run`` pixels of the imager and writes it to the pixels of the picture.

    disparity: [pixel] exact, px of the imager; grey: [pixel] 0 to 255; second_depth: [pixel of the second imager] m;
    noise: [2, row, column] standard normal, of the disparity and of the match; depth: [pixel] m, REP-118: NaN where no
    match is found, infinite beyond the range of the sensor.
    """
    first = wp.tid() * run
    columns = noise.shape[2]
    width = lens.width
    for cell in range(first, first + run):
        column = cell % columns
        row = cell // columns
        left = first_pixel(column, stereo.scale)
        right = wp.min(first_pixel(column + 1, stereo.scale), width)
        top = first_pixel(row, stereo.scale)
        bottom = wp.min(first_pixel(row + 1, stereo.scale), lens.height)
        x = wp.min((left + right) // 2, width - 1)
        y = wp.min((top + bottom) // 2, lens.height - 1)
        own = disparity[y * width + x]
        window = window_statistics(disparity, grey, lens, x, y, stereo.stride)
        match = wp.vec2(window.total / 9.0, 1.0)
        slant = float(1.0)
        if is_edge(stereo, own, window.nearest, window.farthest):
            match = match_window(stereo, disparity, lens, window.nearest, window.farthest, x, y)
        elif own > 0.0:
            slant = surface_slant(stereo, lens, window.across, window.down, x, y, own)
        is_matched = match[1] >= stereo.support
        lost = float(0.0)
        if own > 0.0:
            is_matched = is_matched and seen_by_second(
                stereo, lens, second, second_depth, second_row(lens, second, y), x, own
            )
            lost = loss_probability(stereo, window.brightness, window.brightest - window.darkest, slant, own)
        is_matched = is_matched and normal_cdf(noise[1, row, column]) >= lost
        z = reported_depth(stereo, match[0], is_matched, noise[0, row, column])
        for j in range(top, bottom):
            for i in range(left, right):
                depth_out[j * width + i] = z
