"""Checks of trees after a step: their largest rates, the number of steps for which they have been slow, and the number
of steps for which peduncles have been overloaded."""

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


# Number of steps for which peduncles have been overloaded.


@wp.kernel
def count_overloaded_steps(
    # model
    bunch_body: wp.array(dtype=wp.int32),
    body_tree: wp.array(dtype=wp.int32),
    bunch_pull: wp.array(dtype=float),
    bunch_bend: wp.array(dtype=float),
    # in
    count: wp.array(dtype=wp.int32),
    bunches: wp.array(dtype=wp.int32),
    carried: wp.array(dtype=wp.spatial_vector),
    is_attached: wp.array(dtype=wp.bool),
    is_remote: wp.array(dtype=wp.bool),
    # out
    overloaded_steps_out: wp.array(dtype=wp.int32),
    longest_out: wp.array(dtype=wp.int32),
):
    """One thread per listed bunch. Count the successive steps in which its peduncle is overloaded; restart from 0 if it
    is not.

    A peduncle is overloaded if it is pulled or bent beyond its strength. bunch_pull, bunch_bend: [bunch] N, N m.
    carried: [thread] wrench in the peduncle's joint, N, N m. is_attached: [bunch] whether the bunch hangs on its vine.
    is_remote: [tree] whether another client owns the tree. Picked bunches and bunches of remote trees are left out.
    longest_out: [1] the largest count of all bunches.
    """
    i = wp.tid()
    if i >= count[0]:
        return
    bunch = bunches[i]
    if is_attached[bunch] and not is_remote[body_tree[bunch_body[bunch]]]:
        force = wp.spatial_top(carried[i])
        moment = wp.spatial_bottom(carried[i])
        pulled = wp.dot(force, force) / (bunch_pull[bunch] * bunch_pull[bunch])
        bent = wp.dot(moment, moment) / (bunch_bend[bunch] * bunch_bend[bunch])
        steps = int(0)
        if wp.max(pulled, bent) > 1.0:
            steps = overloaded_steps_out[bunch] + 1
        overloaded_steps_out[bunch] = steps
        wp.atomic_max(longest_out, 0, steps)
