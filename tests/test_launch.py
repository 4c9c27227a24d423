from __future__ import annotations

import threading

import numpy as np
import pytest
import warp as wp

from vinesim.kernels.carry import carry
from vinesim.kernels.launch import Crew, bind


def ints(*values: int) -> wp.array:
    return wp.array(np.array(values, np.int32), dtype=wp.int32, device="cpu")


@pytest.mark.parametrize("packed", [True, False])
def test_a_share_takes_its_part_of_the_list(packed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three trees of 1, 2 and 3 bodies with rows of two; without Warp's inner handles it is slower and the same."""
    if not packed:
        monkeypatch.setattr("vinesim.kernels.launch.ctypes", None)
    rows, out = ints(*range(12)), ints(*[0] * 12)
    launch = bind(carry, [2, 6, ints(0, 1, 3), ints(1, 2, 3), ints(2, 0, 1), rows], [out], over="trees", shares=2)
    launch(6, 1, 1)
    np.testing.assert_array_equal(out.numpy(), [0, 1, *[0] * 10])
    launch(6, 2, 1)
    np.testing.assert_array_equal(out.numpy(), [0, 1, 2, 3, 4, 5, *[0] * 6])
    launch(0)
    launch(6)
    np.testing.assert_array_equal(out.numpy(), np.arange(12))


def test_a_crew_works_at_once_and_all_is_done_when_it_returns() -> None:
    crew = Crew(3)
    meeting = threading.Barrier(3)
    try:
        for tick in range(200):
            seen = [0, 0, 0]

            def work(i: int, seen: list[int] = seen, tick: int = tick) -> None:
                if tick == 0:
                    meeting.wait(10.0)  # only if all three are at work at the same time
                seen[i] = tick + 1

            crew.share([lambda i=i, work=work: work(i) for i in range(3)])
            assert seen == [tick + 1] * 3
        crew.share([lambda: None])
    finally:
        crew.close()


def test_who_brings_the_work_hears_of_its_failure() -> None:
    crew = Crew(2)

    def fail() -> None:
        raise ValueError("this share is rotten")

    try:
        with pytest.raises(ValueError, match="rotten"):
            crew.share([lambda: None, fail])
        with pytest.raises(ValueError, match="rotten"):
            crew.share([fail, lambda: None])
        done = []
        crew.share([lambda: done.append(0), lambda: done.append(1)])
        assert sorted(done) == [0, 1]
    finally:
        crew.close()
