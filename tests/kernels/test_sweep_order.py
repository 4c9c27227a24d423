"""The order of trees along the axis of their widest spread, against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from vinesim.core.warp_arrays import SharedArrays, share
from vinesim.kernels.contact import structs
from vinesim.kernels.contact.sweep_order import sort_awake_trees


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 17, 64, 1000])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_awake_trees_are_in_the_order_of_their_boxes(count, axis):
    rng = np.random.default_rng(count)
    trees = 2 * count
    low = rng.integers(0, 9, (trees, 3)).astype(np.float32)  # many are equal: the first stays first
    low[:, axis] *= 10.0
    awake = np.sort(rng.permutation(trees)[:count]).astype(np.int32)
    low[awake[-1], axis] = 100.0  # so the spread along this axis is the widest
    boxes = SharedArrays.zeros(structs.Aabbs, trees, low=low)
    listed = structs.Trees()
    listed.awake = share(awake, wp.int32)
    counters, rows, scratch = np.zeros(structs.COUNTERS, np.int32), *np.zeros((2, trees), np.int32)
    counters[structs.AWAKE_TREES] = count
    shared = [share(data, wp.int32) for data in (counters, rows, scratch)]
    wp.launch(sort_awake_trees, 1, inputs=[listed, boxes.struct], outputs=shared, device="cpu")
    if count > 1:
        assert counters[structs.SORT_AXIS] == axis
    assert (rows[:count] == np.argsort(low[awake][:, counters[structs.SORT_AXIS]], kind="stable")).all()
