"""The fastest of some trees."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def find_fastest(
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    tree_rate: wp.array(dtype=float),
    # out
    fastest_out: wp.array(dtype=float),
):
    """One thread in all: the largest rate of the first ``count`` [1] of ``trees``, infinite if one is not a number.

    tree_rate: [tree] rad/s. fastest_out: [1] rad/s.
    """
    fastest = float(0.0)
    for i in range(count[0]):
        rate = tree_rate[trees[i]]
        if not rate <= fastest:
            fastest = rate
            if wp.isnan(rate):
                fastest = wp.inf
    fastest_out[0] = fastest
