"""Tone mapping to 8-bit sRGB on a CPU, eight pixels at once: ``deferred.tone_map`` for pictures of one sample a
pixel."""

import warp as wp

from vinesim.kernels.raster.pinhole import BATCH, IntBatch
from vinesim.kernels.shading.deferred import WHITE_POINT

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.func
def tone_entry(light: float) -> int:
    """Returns the index into the tone table [4096] for an exposed radiance of one colour."""
    seen = wp.clamp(light, 0.0, WHITE_POINT)
    return wp.clamp(int(wp.sqrt(seen) * 1024.0), 0, 4095)


@wp.kernel
def tone_map_rows(
    # in
    radiance: wp.array2d(dtype=wp.float32),
    width: int,
    balance: wp.vec3,
    exposure: wp.array(dtype=wp.float32),
    tone: wp.array(dtype=wp.uint8),
    first_row: int,
    # out
    rgb_out: wp.array2d(dtype=wp.uint8),
):
    """One thread converts the radiance of one row of pixels to 8-bit sRGB.

    radiance: [pixel, 3] linear RGB; width: of a row [px]; balance: white balance, a factor for each colour; exposure:
    [1] factor; tone: [4096] 8-bit sRGB for sqrt(radiance / 4); first_row: row of thread 0; rgb: [pixel, 3].
    """
    start = (first_row + wp.tid()) * width
    gain = balance * exposure[0]
    red = IntBatch()
    green = IntBatch()
    blue = IntBatch()
    for first in range(start, start + width, BATCH):
        count = wp.min(start + width - first, BATCH)
        whole = (count + 7) // 8 * 8
        m = wp.int32(0)
        while m < whole:
            pixel = first + wp.min(m, count - 1)
            red[m] = tone_entry(gain[0] * radiance[pixel, 0])
            green[m] = tone_entry(gain[1] * radiance[pixel, 1])
            blue[m] = tone_entry(gain[2] * radiance[pixel, 2])
            m += 1
        for m in range(count):
            rgb_out[first + m, 0] = tone[red[m]]
            rgb_out[first + m, 1] = tone[green[m]]
            rgb_out[first + m, 2] = tone[blue[m]]
