"""Stereo matching for CPUs: eight pixels of the first imager (image sensor) at once.

Occlusion needs the depth that the stereo camera's second imager has in view. :func:`warp_to_second` can compute this
depth from the depth of the first imager, which is faster than to render the view of the second imager.

The arithmetic is that of :mod:`vinesim.kernels.stereo.stereo_depth`, which suits GPUs (one pixel a thread); depths are
equal bit for bit. docs/decisions/raster.md explains how loops must be written to vectorise.
"""

import warp as wp

from vinesim.kernels.raster.pinhole import BATCH, FloatBatch, IntBatch, Pinhole
from vinesim.kernels.stereo.stereo_depth import (
    Stereo,
    is_edge,
    loss_probability,
    match_window,
    normal_cdf,
    reported_depth,
    second_row,
    seen_by_second,
    surface_slant,
    window_statistics,
)

wp.set_module_options({"enable_backward": False, "fast_math": False, "max_unroll": 25})

_NOTHING = wp.constant(1.0e9)
"""Depth [m] of pixels of the second imager without a surface."""


@wp.struct
class ImagerPixels:
    """Mapping from the columns and rows of a stereo camera's first imager (image sensor) to columns and rows of the
    picture.
    """

    first_column: wp.array(dtype=wp.int32)
    """[imager's columns + 1] First column of the picture within each column of the imager."""
    middle_column: wp.array(dtype=wp.int32)
    """[imager's column] Column of the picture at which the imager's column is sampled."""
    first_row: wp.array(dtype=wp.int32)
    middle_row: wp.array(dtype=wp.int32)


@wp.kernel
def warp_to_second(
    # model
    stereo: Stereo,
    pixels: ImagerPixels,
    # in
    lens: Pinhole,
    second: Pinhole,
    disparity: wp.array(dtype=wp.float32),
    first_row: int,
    # out
    second_depth_out: wp.array(dtype=wp.float32),
):
    """One thread projects the pixels of one row of the picture into the second imager and keeps the nearest depth.

    disparity: [pixel] px of the imager; first_row: imager's row of thread 0; second_depth: [row of the first imager,
    column of the second imager] m.
    """
    row = first_row + wp.tid()
    y = pixels.middle_row[row]
    for column in range(second.width):
        second_depth_out[row * second.width + column] = _NOTHING
    per = second.fx / lens.fx
    start = second.cx - lens.cx * per
    for x in range(lens.width):
        d = disparity[y * lens.width + x]
        column = int(float(x) * per + start - d + 0.5)
        if d > 0.0 and column >= 0 and column < second.width:
            at = row * second.width + column
            second_depth_out[at] = wp.min(second_depth_out[at], stereo.focal_baseline / d)


@wp.kernel
def measure_depth_rows(
    # model
    stereo: Stereo,
    pixels: ImagerPixels,
    # in
    lens: Pinhole,
    second: Pinhole,
    disparity: wp.array(dtype=wp.float32),
    grey: wp.array(dtype=wp.uint8),
    second_depth: wp.array(dtype=wp.float32),
    is_warped: int,
    noise: wp.array3d(dtype=wp.float32),
    first_row: int,
    # out
    depth_out: wp.array(dtype=wp.float32),
):
    """One thread measures depth in one row of the imager, eight pixels at once, with the result of ``measure_depth``.

    second_depth: [row, column of the second imager] m; is_warped: 1 if ``second_depth`` is from :func:`warp_to_second`;
    first_row: imager's row of thread 0; other arguments:
    :func:`vinesim.kernels.stereo.stereo_depth.measure_depth`. The function is long so that batches stay in registers.
    """
    row = first_row + wp.tid()
    columns = noise.shape[2]
    top = pixels.first_row[row]
    bottom = pixels.first_row[row + 1]
    y = pixels.middle_row[row]
    seen_row = wp.where(is_warped != 0, row, second_row(lens, second, y))
    nearest = FloatBatch()
    farthest = FloatBatch()
    total = FloatBatch()
    across = FloatBatch()
    down = FloatBatch()
    brightness = FloatBatch()
    darkest = FloatBatch()
    brightest = FloatBatch()
    owns = FloatBatch()
    agree = FloatBatch()
    xs = IntBatch()
    edges = IntBatch()
    edge_xs = IntBatch()
    edge_nearest = FloatBatch()
    edge_farthest = FloatBatch()
    found = FloatBatch()
    for start in range(0, columns, BATCH):
        count = wp.min(columns - start, BATCH)
        for m in range(count):
            xs[m] = pixels.middle_column[start + m]
        whole = (count + 7) // 8 * 8
        m = wp.int32(0)
        while m < whole:
            w = window_statistics(disparity, grey, lens, xs[m], y, stereo.stride)
            owns[m] = disparity[y * lens.width + xs[m]]
            nearest[m] = w.nearest
            farthest[m] = w.farthest
            total[m] = w.total
            across[m] = w.across
            down[m] = w.down
            brightness[m] = w.brightness
            darkest[m] = w.darkest
            brightest[m] = w.brightest
            m += 1
        edge_count = wp.int32(0)
        for m in range(count):
            if is_edge(stereo, owns[m], nearest[m], farthest[m]):
                edges[edge_count] = m
                edge_count += 1
        for m in range(edge_count):
            e = edges[m]
            edge_xs[m] = xs[e]
            edge_nearest[m] = nearest[e]
            edge_farthest[m] = farthest[e]
        whole = (edge_count + 7) // 8 * 8
        m = wp.int32(0)
        while m < whole:
            match = match_window(stereo, disparity, lens, edge_nearest[m], edge_farthest[m], edge_xs[m], y)
            found[m] = match[0]
            agree[m] = match[1]
            m += 1
        n = wp.int32(0)
        for m in range(count):
            own = owns[m]
            match = wp.vec2(total[m] / 9.0, 1.0)
            slant = float(1.0)
            if is_edge(stereo, own, nearest[m], farthest[m]):
                match = wp.vec2(found[n], agree[n])
                n += 1
            elif own > 0.0:
                slant = surface_slant(stereo, lens, across[m], down[m], xs[m], y, own)
            is_matched = match[1] >= stereo.support
            lost = float(0.0)
            if own > 0.0:
                is_matched = is_matched and seen_by_second(stereo, lens, second, second_depth, seen_row, xs[m], own)
                lost = loss_probability(stereo, brightness[m], brightest[m] - darkest[m], slant, own)
            column = start + m
            if lost > 0.0:
                is_matched = is_matched and normal_cdf(noise[1, row, column]) >= lost
            z = reported_depth(stereo, match[0], is_matched, noise[0, row, column])
            for j in range(top, bottom):
                for i in range(pixels.first_column[column], pixels.first_column[column + 1]):
                    depth_out[j * lens.width + i] = z
