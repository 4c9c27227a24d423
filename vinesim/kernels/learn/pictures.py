"""Pictures as observations of the learning tasks."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def limit_depth(
    # model
    farthest: float,
    # in
    depth: wp.array(dtype=float),
    # out
    depth_out: wp.array(dtype=float),
):
    """One thread per pixel. Copy its depth [m], at most ``farthest`` [m]: that of the sky is infinite."""
    i = wp.tid()
    depth_out[i] = wp.min(depth[i], farthest)
