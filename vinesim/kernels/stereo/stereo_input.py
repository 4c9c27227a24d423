"""What a stereo measurement needs beside the picture, made where the picture is: disparity, grey levels and noise.

For GPUs; on a CPU NumPy and OpenCV do the same in less time.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.kernel
def convert_picture(
    # in
    depth: wp.array(dtype=wp.float32),
    rgb: wp.array2d(dtype=wp.uint8),
    focal_baseline: float,
    # out
    disparity_out: wp.array(dtype=wp.float32),
    grey_out: wp.array(dtype=wp.uint8),
):
    """One thread converts one pixel: exact depth [m] to disparity [px of the imager], colour to a grey level.

    rgb: [pixel, 3]; focal_baseline: [px m]. Grey levels are those of OpenCV (Rec. 601, in 15 bits), bit for bit.
    """
    i = wp.tid()
    disparity_out[i] = focal_baseline / depth[i]
    level = int(rgb[i, 0]) * 9798 + int(rgb[i, 1]) * 19235 + int(rgb[i, 2]) * 3735
    grey_out[i] = wp.uint8((level + 16384) >> 15)


@wp.kernel
def draw_normals(
    # in
    seed: int,
    # out
    normal_out: wp.array(dtype=wp.float32),
):
    """One thread draws one normal number, which follows from the seed and the number of the thread."""
    i = wp.tid()
    normal_out[i] = wp.randn(wp.rand_init(seed, i))


@wp.kernel
def correlate(
    # in
    normal: wp.array3d(dtype=wp.float32),
    window: int,
    # out
    noise_out: wp.array3d(dtype=wp.float32),
):
    """One thread sums the normal numbers of one window, over its width: variance 1, alike within a window.

    normal: [field, row + window - 1, column + window - 1]; noise: [field, row, column].
    """
    k, y, x = wp.tid()
    total = float(0.0)
    for i in range(window):
        for j in range(window):
            total += normal[k, y + i, x + j]
    noise_out[k, y, x] = total / float(window)
