"""Order of the awake trees along the axis on which their boxes are spread widest (sweep and prune)."""

import warp as wp

from vinesim.kernels.contact.broadphase import FAR
from vinesim.kernels.contact.structs import AWAKE_TREES, SORT_AXIS, Aabbs, Trees

wp.set_module_options({"enable_backward": False})


@wp.func
def widest_axis(count: int, trees: Trees, boxes: Aabbs):
    """Returns the axis (0, 1, 2) along which the lower corners of the awake trees' boxes differ most."""
    least = wp.vec3(FAR)
    greatest = wp.vec3(-FAR)
    for row in range(count):
        low = boxes.low[trees.awake[row]]
        least = wp.min(least, low)
        greatest = wp.max(greatest, low)
    spread = greatest - least
    axis = int(0)
    for i in range(1, 3):
        if spread[i] > spread[axis]:
            axis = i
    return axis


@wp.func
def merge_runs(
    count: int,
    width: int,
    axis: int,
    trees: Trees,
    boxes: Aabbs,
    rows: wp.array(dtype=wp.int32),
    rows_out: wp.array(dtype=wp.int32),
):
    """Merge each two adjacent sorted runs of ``width`` rows into one sorted run (stable)."""
    for start in range(0, count, 2 * width):
        left = int(start)
        middle = wp.min(start + width, count)
        right = int(middle)
        end = wp.min(start + 2 * width, count)
        for place in range(start, end):
            take_right = left == middle
            if left < middle and right < end:
                take_right = boxes.low[trees.awake[rows[right]]][axis] < boxes.low[trees.awake[rows[left]]][axis]
            if take_right:
                rows_out[place] = rows[right]
                right = right + 1
            else:
                rows_out[place] = rows[left]
                left = left + 1


@wp.kernel
def sort_awake_trees(
    # in
    trees: Trees,
    boxes: Aabbs,
    # out
    counters_out: wp.array(dtype=wp.int32),
    rows_out: wp.array(dtype=wp.int32),
    scratch_out: wp.array(dtype=wp.int32),
):
    """One thread in all. Choose the axis (``SORT_AXIS``), and sort the rows of the awake trees by their boxes along
    this axis.

    The algorithm is a merge sort. scratch_out: [row].
    """
    count = counters_out[AWAKE_TREES]
    axis = widest_axis(count, trees, boxes)
    counters_out[SORT_AXIS] = axis
    for row in range(count):
        rows_out[row] = row
    width = int(1)
    while width < count:
        merge_runs(count, width, axis, trees, boxes, rows_out, scratch_out)
        merge_runs(count, 2 * width, axis, trees, boxes, scratch_out, rows_out)
        width = 4 * width
