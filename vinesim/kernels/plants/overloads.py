"""How long peduncles have carried more than they can."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def count_overloaded_steps(
    # model
    bunch_body: wp.array(dtype=wp.int32),
    body_tree: wp.array(dtype=wp.int32),
    bunch_pull: wp.array(dtype=float),
    bunch_bend: wp.array(dtype=float),
    # in
    bunches: wp.array(dtype=wp.int32),
    carried: wp.array(dtype=wp.spatial_vector),
    is_attached: wp.array(dtype=wp.bool),
    is_remote: wp.array(dtype=wp.bool),
    # out
    overloaded_steps_out: wp.array(dtype=wp.int32),
    longest_out: wp.array(dtype=wp.int32),
):
    """One thread per listed bunch: a step more if its peduncle is pulled or bent beyond its strength, none otherwise.

    bunch_pull, bunch_bend: [bunch] N, N m. carried: [thread] force and moment of its joint, N, N m. is_attached: [bunch];
    is_remote: [tree]; picked bunches and those of remote trees are left out. longest_out: [1] most steps of all.
    """
    i = wp.tid()
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
