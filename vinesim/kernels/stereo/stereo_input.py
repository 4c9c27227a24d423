"""Kernels that compute the inputs of a stereo measurement on a GPU: disparity, grey levels and noise.

On a CPU, NumPy and OpenCV compute these inputs in less time.
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
    """One thread converts one pixel: exact depth [m] to disparity [px of the imager], and colour to a grey level.

    rgb: [pixel, 3]; focal_baseline: focal length times baseline [px m]. Grey levels equal those of OpenCV (Rec. 601,
    15-bit fixed point) bit for bit.
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
    """One thread draws one standard normal number, determined by ``seed`` and the thread's index."""
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
    """One thread sums ``window`` x ``window`` normal numbers and divides by ``window``: noise of variance 1 that is
    correlated over the width of a matching window.

    normal: [field, row + window - 1, column + window - 1]; noise: [field, row, column].
    """
    k, y, x = wp.tid()
    total = float(0.0)
    for i in range(window):
        for j in range(window):
            total += normal[k, y + i, x + j]
    noise_out[k, y, x] = total / float(window)
