"""Sums of contact wrenches on the bodies of plants, and the list of trees with such wrenches."""

import warp as wp

wp.set_module_options({"enable_backward": False})

LOADED = wp.constant(0)
"""Index in ``numbers``: number of bodies that the last step loaded."""
GIVEN = wp.constant(1)
"""Index in ``numbers``: number of bodies that this step loads."""
TICK = wp.constant(2)
"""Index in ``numbers``: number of this step."""
ONSET_STEPS = wp.constant(3)
"""Index in ``numbers``: number of steps with backward Euler (phi = 1) at the beginning of a contact, including the
first one."""
REFUSED = wp.constant(4)
"""Index in ``numbers``: the first given body that cannot be loaded, counted from 1; 0 if all can be loaded."""
NUMBERS = 5


@wp.kernel
def load_bodies(
    # model
    body_tree: wp.array(dtype=wp.int32),
    place_in_tree: wp.array(dtype=wp.int32),
    # in
    is_stepped: wp.array(dtype=wp.bool),
    tree_moving: wp.array(dtype=wp.int32),
    body: wp.array(dtype=wp.int32),
    wrench: wp.array(dtype=wp.spatial_vector),
    # out
    numbers_out: wp.array(dtype=wp.int64),
    loaded_out: wp.array(dtype=wp.int32),
    body_wrench_out: wp.array(dtype=wp.spatial_vector),
    touched_out: wp.array(dtype=wp.int32),
    touched_count_out: wp.array(dtype=wp.int32),
    last_contact_out: wp.array(dtype=wp.int64),
    tree_euler_steps_out: wp.array(dtype=wp.int32),
):
    """One thread in all. Replace the wrenches of the last step by the wrenches of this step, and list the trees of the
    loaded bodies.

    Nothing happens if a body cannot be loaded: its tree was not in the last prediction (is_stepped [tree]), or it is
    not among the first tree_moving [tree] bodies of its tree. place_in_tree: [body] index in the tree, from 0 on. body,
    wrench: [k] bodies and their wrenches (N, N m); a body may occur several times. loaded_out: [k] loaded bodies; the
    array holds the bodies of the last call and is overwritten with the bodies of this call. body_wrench_out: [body] N,
    N m sums. touched_out: [j] each tree once; touched_count_out: [1] number of touched trees. last_contact_out: [tree]
    number of the step with the last contact. tree_euler_steps_out: [tree] number of steps with backward Euler (phi = 1)
    still to be taken; set to at least ``ONSET_STEPS`` where contact begins.
    """
    given = int(numbers_out[GIVEN])
    numbers_out[REFUSED] = wp.int64(0)
    touched_count_out[0] = 0
    for i in range(given):
        tree = body_tree[body[i]]
        if not is_stepped[tree] or place_in_tree[body[i]] >= tree_moving[tree]:
            numbers_out[REFUSED] = wp.int64(i + 1)
            return
    for i in range(int(numbers_out[LOADED])):
        body_wrench_out[loaded_out[i]] = wp.spatial_vector()
    tick = numbers_out[TICK]
    count = int(0)
    for i in range(given):
        k = body[i]
        loaded_out[i] = k
        body_wrench_out[k] = body_wrench_out[k] + wrench[i]
        tree = body_tree[k]
        last = last_contact_out[tree]
        if last != tick:
            touched_out[count] = tree
            count = count + 1
            last_contact_out[tree] = tick
            if last < tick - wp.int64(1):
                tree_euler_steps_out[tree] = wp.max(tree_euler_steps_out[tree], int(numbers_out[ONSET_STEPS]))
    numbers_out[LOADED] = wp.int64(given)
    touched_count_out[0] = count
