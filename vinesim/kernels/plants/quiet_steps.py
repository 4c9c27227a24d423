"""How long the joints of trees have been slow."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def count_quiet_steps(
    # in
    limit: wp.array(dtype=float),
    trees: wp.array(dtype=wp.int32),
    tree_rate: wp.array(dtype=float),
    # out
    quiet_steps_out: wp.array(dtype=wp.int32),
    is_at_rest_out: wp.array(dtype=wp.bool),
    seen_tick_out: wp.array(dtype=wp.int64),
    longest_out: wp.array(dtype=wp.int32),
):
    """One thread per listed tree: a step more, or none if a joint was not slower than the limit (or not a number).

    limit: [1] rad/s. tree_rate: [tree] rad/s. A tree that moves is not at rest, and was not seen still (-1) before.
    longest_out: [1] most steps of all.
    """
    tree = trees[wp.tid()]
    if tree_rate[tree] < limit[0]:
        quiet_steps_out[tree] = quiet_steps_out[tree] + 1
        wp.atomic_max(longest_out, 0, quiet_steps_out[tree])
    else:
        quiet_steps_out[tree] = 0
        is_at_rest_out[tree] = False
        seen_tick_out[tree] = wp.int64(-1)
