from __future__ import annotations

import threading

import numpy as np
import pytest
import warp as wp

from vinesim.kernels.launch import ThreadPool, bind_launch


def ints(*values: int) -> wp.array:
    return wp.array(np.array(values, np.int32), dtype=wp.int32, device="cpu")


@wp.kernel(enable_backward=False)
def count(
    # in
    trees: wp.array(dtype=wp.int32),
    # out
    seen_out: wp.array(dtype=wp.int32),
):
    """Count one listed tree."""
    seen_out[trees[wp.tid()]] += 1


@pytest.mark.parametrize("packed", [True, False])
def test_a_share_takes_its_part_of_the_list(packed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without Warp's inner handles it is slower and the same."""
    if not packed:
        monkeypatch.setattr("vinesim.kernels.launch.ctypes", None)
    seen = ints(0, 0, 0, 0, 0)
    launch = bind_launch(count, [ints(4, 0, 3)], [seen], index_list="trees", partitions=2)
    launch(1, 1, 1)
    assert seen.numpy().tolist() == [1, 0, 0, 0, 0]
    launch(1, 2, 1)
    assert seen.numpy().tolist() == [1, 0, 0, 1, 0]
    launch(0)
    launch(3)
    assert seen.numpy().tolist() == [2, 0, 0, 2, 1]


def test_a_crew_works_at_once_and_all_is_done_when_it_returns() -> None:
    crew = ThreadPool(3)
    meeting = threading.Barrier(3)
    try:
        for tick in range(200):
            seen = [0, 0, 0]

            def work(i: int, seen: list[int] = seen, tick: int = tick) -> None:
                if tick == 0:
                    meeting.wait(10.0)  # only if all three are at work at the same time
                seen[i] = tick + 1

            crew.run([lambda i=i, work=work: work(i) for i in range(3)])
            assert seen == [tick + 1] * 3
        crew.run([lambda: None])
    finally:
        crew.close()


def test_who_brings_the_work_hears_of_its_failure() -> None:
    crew = ThreadPool(2)

    def fail() -> None:
        raise ValueError("this share is rotten")

    try:
        with pytest.raises(ValueError, match="rotten"):
            crew.run([lambda: None, fail])
        with pytest.raises(ValueError, match="rotten"):
            crew.run([fail, lambda: None])
        done = []
        crew.run([lambda: done.append(0), lambda: done.append(1)])
        assert sorted(done) == [0, 1]
    finally:
        crew.close()
