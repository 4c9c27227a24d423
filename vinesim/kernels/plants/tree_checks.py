"""Checks of trees after a step: their largest rates, and the number of steps for which they have been slow."""

import warp as wp

# Number of steps for which the joints of trees have been slow.


wp.set_module_options({"enable_backward": False})


@wp.kernel
def count_quiet_steps(
    # in
    limit: wp.array(dtype=float),
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    tree_rate: wp.array(dtype=float),
    # out
    quiet_steps_out: wp.array(dtype=wp.int32),
    is_at_rest_out: wp.array(dtype=wp.bool),
    seen_tick_out: wp.array(dtype=wp.int64),
    longest_out: wp.array(dtype=wp.int32),
):
    """One thread per listed tree. Count the successive steps in which the tree was slow; restart from 0 if its rate is
    NaN or not below the limit.

    limit: [1] rad/s. tree_rate: [tree] rad/s. is_at_rest_out, seen_tick_out: [tree] reset to false and -1 for a tree
    that moves. longest_out: [1] largest count of all trees.
    """
    if wp.tid() >= count[0]:
        return
    tree = trees[wp.tid()]
    if tree_rate[tree] < limit[0]:
        quiet_steps_out[tree] = quiet_steps_out[tree] + 1
        wp.atomic_max(longest_out, 0, quiet_steps_out[tree])
    else:
        quiet_steps_out[tree] = 0
        is_at_rest_out[tree] = False
        seen_tick_out[tree] = wp.int64(-1)


# The rate of the fastest of the listed trees.


@wp.kernel
def find_fastest(
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    tree_rate: wp.array(dtype=float),
    # out
    fastest_out: wp.array(dtype=float),
):
    """One thread per listed tree. Find the largest rate of all listed trees; infinity if one is NaN.

    tree_rate: [tree] rad/s. fastest_out: [1] rad/s, raised to the largest rate.
    """
    if wp.tid() >= count[0]:
        return
    rate = tree_rate[trees[wp.tid()]]
    if wp.isnan(rate):
        rate = wp.inf
    wp.atomic_max(fastest_out, 0, rate)
