"""Copies rows of some trees between host arrays and device arrays, which have different orders of bodies."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def copy_rows(
    # model
    pitch: int,
    pitch_there: int,
    tree_first: wp.array(dtype=wp.int32),
    tree_first_there: wp.array(dtype=wp.int32),
    tree_size: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    widths: wp.array(dtype=wp.int32),
    # in
    count: wp.array(dtype=wp.int32),
    trees: wp.array(dtype=wp.int32),
    addresses: wp.array(dtype=wp.uint64),
    # out
    addresses_out: wp.array(dtype=wp.uint64),
):
    """One thread copies one word of four bytes. First dimension of the launch: listed tree; second: word within the
    rows of that tree.

    starts, widths: [array] first thread of each array within a tree, and number of words in a row. addresses,
    addresses_out: [array] pointers to source and target. pitch, pitch_there: distance between rows of consecutive
    bodies in source and target.
    """
    slot, thread = wp.tid()
    if slot >= count[0]:
        return
    tree = trees[slot]
    n = wp.int32(0)
    while thread >= starts[n + 1]:
        n = n + 1
    width = widths[n]
    word = thread - starts[n]
    body = word / width
    if body < tree_size[tree]:
        column = word - body * width
        at = (tree_first[tree] + body * pitch) * width + column
        there = (tree_first_there[tree] + body * pitch_there) * width + column
        words = wp.array(ptr=addresses[n], shape=(at + 1,), dtype=wp.int32)
        words_out = wp.array(ptr=addresses_out[n], shape=(there + 1,), dtype=wp.int32)
        words_out[there] = words[at]
