"""The fastest of some trees."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def find_fastest(
    # in
    trees: wp.array(dtype=wp.int32),
    tree_rate: wp.array(dtype=float),
    # out
    fastest_out: wp.array(dtype=float),
):
    """One thread per listed tree: the largest rate of all, infinite if one is not a number.

    tree_rate: [tree] rad/s. fastest_out: [1] rad/s, 0 before.
    """
    rate = tree_rate[trees[wp.tid()]]
    if wp.isnan(rate):
        rate = wp.inf
    wp.atomic_max(fastest_out, 0, rate)
