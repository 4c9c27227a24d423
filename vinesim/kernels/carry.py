"""Carrying what belongs to some trees from one memory to another."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def carry(
    # model
    width: int,
    stride: int,
    tree_first: wp.array(dtype=wp.int32),
    tree_size: wp.array(dtype=wp.int32),
    # in
    trees: wp.array(dtype=wp.int32),
    rows: wp.array(dtype=wp.int32),
    # out
    rows_out: wp.array(dtype=wp.int32),
):
    """Copy one word of four bytes of one listed tree; each body has a row of ``width``, a tree ``stride`` threads."""
    slot = wp.tid() / stride
    i = wp.tid() - slot * stride
    tree = trees[slot]
    if i < tree_size[tree] * width:
        at = tree_first[tree] * width + i
        rows_out[at] = rows[at]
