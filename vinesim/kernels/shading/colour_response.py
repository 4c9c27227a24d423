"""The colour response of a camera: light on the sensor, noise, clipping, colour matrix and tone curve."""

import warp as wp

from vinesim.kernels.raster.pinhole import BATCH, IntBatch

wp.set_module_options({"enable_backward": False, "fast_math": True})

NOISE_STRIDE = wp.constant(1 << 16)
"""Distance between the normal numbers of red, green and blue of one pixel."""
TONE_ENTRIES = wp.constant(4096)
"""Number of entries of a camera's tone curve, over the square root of light from 0 to the clipping point."""


@wp.struct
class ColourResponse:
    """The numbers of one picture's response. Light is a share of the clipping point."""

    gain: wp.vec3
    """Factors from exposed radiance to light on the sensor, by colour, with the white balance and its error."""
    matrix: wp.mat33
    """Colour matrix, applied to clipped light."""
    shot: float
    """Variance of the light for each unit of light: 1 / electrons at the clipping point."""
    read: float
    """Variance of the light without light."""
    falloff: float
    """Share of the light that is lost in the corners of the picture."""
    tone: wp.array(dtype=wp.uint8)
    """[4096] 8-bit value by the square root of light."""
    noise: wp.array(dtype=wp.float32)
    """[n] normal numbers with variance 1."""
    noise_start: wp.array(dtype=wp.int32)
    """[row] first of the normal numbers that each row uses."""


@wp.kernel
def average_samples(
    # in
    radiance: wp.array(dtype=wp.vec3),
    width: int,
    samples: int,
    most: float,
    # out
    light_out: wp.array(dtype=wp.vec3),
):
    """One thread averages the ``samples`` x ``samples`` samples of one pixel.

    radiance: [sample] linear RGB; width: of the picture [px]; most: larger values count as this value, so that one
    sparkling sample does not fill its surroundings; light: [pixel] linear RGB.
    """
    pixel = wp.tid()
    left = (pixel % width) * samples
    top = (pixel // width) * samples
    colour = wp.vec3(0.0, 0.0, 0.0)
    for k in range(samples * samples):
        colour += wp.min(
            radiance[(top + k // samples) * width * samples + left + k % samples], wp.vec3(most, most, most)
        )
    light_out[pixel] = colour / float(samples * samples)


@wp.func
def sensed(light: float, shot: float, read: float, normal: float) -> float:
    """Returns the share of the clipping point that a pixel reports for ``light``: with noise, clipped to 0 and 1."""
    return wp.clamp(light + wp.sqrt(shot * light + read) * normal, 0.0, 1.0)


@wp.func
def tone_index(light: float) -> int:
    return int(wp.sqrt(wp.clamp(light, 0.0, 1.0)) * 4095.0 + 0.5)


@wp.kernel
def respond_rows(
    # in
    light: wp.array2d(dtype=wp.float32),
    width: int,
    height: int,
    exposure: float,
    response: ColourResponse,
    first_row: int,
    # out
    rgb_out: wp.array2d(dtype=wp.uint8),
):
    """One thread converts one row of light to the 8-bit colours of a camera, with noise.

    light: [pixel, 3] linear RGB; width, height: of the picture [px]; exposure: factor on light; first_row: row of
    thread 0; rgb: [pixel, 3].
    """
    row = first_row + wp.tid()
    gain = response.gain * exposure
    shot = response.shot
    read = response.read
    m = response.matrix
    noise = response.noise_start[row]
    half = 0.5 * float(width - 1)
    y = float(row) - 0.5 * float(height - 1)
    per_square = response.falloff / wp.max(half * half + 0.25 * float(height - 1) * float(height - 1), 1.0)
    red = IntBatch()
    green = IntBatch()
    blue = IntBatch()
    for first in range(0, width, BATCH):
        count = wp.min(width - first, BATCH)
        k = wp.int32(0)
        while k < BATCH:
            x = first + wp.min(k, count - 1)
            pixel = row * width + x
            away = float(x) - half
            here = 1.0 - per_square * (away * away + y * y)
            place = noise + x
            r = sensed(wp.max(light[pixel, 0], 0.0) * gain[0] * here, shot, read, response.noise[place])
            g = sensed(wp.max(light[pixel, 1], 0.0) * gain[1] * here, shot, read, response.noise[place + NOISE_STRIDE])
            b = sensed(
                wp.max(light[pixel, 2], 0.0) * gain[2] * here, shot, read, response.noise[place + 2 * NOISE_STRIDE]
            )
            red[k] = tone_index(m[0, 0] * r + m[0, 1] * g + m[0, 2] * b)
            green[k] = tone_index(m[1, 0] * r + m[1, 1] * g + m[1, 2] * b)
            blue[k] = tone_index(m[2, 0] * r + m[2, 1] * g + m[2, 2] * b)
            k += 1
        for j in range(count):
            pixel = row * width + first + j
            rgb_out[pixel, 0] = response.tone[red[j]]
            rgb_out[pixel, 1] = response.tone[green[j]]
            rgb_out[pixel, 2] = response.tone[blue[j]]
