from __future__ import annotations

import threading

import numpy as np
import pytest
import warp as wp

from tests.support.waiting import deadline
from vinesim.kernels.launch import ThreadPool, bind_launch


def ints(*values: int) -> wp.array:
    return wp.array(np.array(values, np.int32), dtype=wp.int32, device="cpu")


@wp.kernel(enable_backward=False)
def count(
    # in
    trees: wp.array(dtype=wp.int32),
    # out
    counts_out: wp.array(dtype=wp.int32),
):
    """Count one listed tree."""
    counts_out[trees[wp.tid()]] += 1


@pytest.mark.parametrize("packed", [True, False])
def test_a_partition_runs_its_part_of_the_list(packed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without access to Warp's internal handles the launch is slower, with the same result."""
    if not packed:
        monkeypatch.setattr("vinesim.kernels.launch.ctypes", None)
    counts = ints(0, 0, 0, 0, 0)
    launch = bind_launch(count, [ints(4, 0, 3)], [counts], index_list="trees", partitions=2)
    launch(1, 1, 1)
    assert counts.numpy().tolist() == [1, 0, 0, 0, 0]
    launch(1, 2, 1)
    assert counts.numpy().tolist() == [1, 0, 0, 1, 0]
    launch(0)
    launch(3)
    assert counts.numpy().tolist() == [2, 0, 0, 2, 1]


def test_a_thread_pool_runs_in_parallel_and_returns_when_all_is_done() -> None:
    pool = ThreadPool(3)
    barrier = threading.Barrier(3)
    try:
        for tick in range(200):
            counts = [0, 0, 0]

            def work(i: int, counts: list[int] = counts, tick: int = tick) -> None:
                if tick == 0:
                    barrier.wait(deadline(10.0))  # passes only if all three run at the same time
                counts[i] = tick + 1

            pool.run([lambda i=i, work=work: work(i) for i in range(3)])
            assert counts == [tick + 1] * 3
        pool.run([lambda: None])
    finally:
        pool.close()


def test_a_failure_in_a_thread_is_raised_in_the_caller() -> None:
    pool = ThreadPool(2)

    def fail() -> None:
        raise ValueError("this part is invalid")

    try:
        with pytest.raises(ValueError, match="part is invalid"):
            pool.run([lambda: None, fail])
        with pytest.raises(ValueError, match="part is invalid"):
            pool.run([fail, lambda: None])
        done = []
        pool.run([lambda: done.append(0), lambda: done.append(1)])
        assert sorted(done) == [0, 1]
    finally:
        pool.close()
