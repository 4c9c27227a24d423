"""Threads of a pool work at the same time; a failure of one of them reaches the caller."""

from __future__ import annotations

import functools
import threading

import pytest

from tests.support.waiting import deadline
from vinesim.core.thread_pool import ThreadPool


@pytest.mark.parametrize("size", [1, 2, 3])
def test_each_task_is_done_once(size: int) -> None:
    pool = ThreadPool(size)
    for count in (0, 1, 2, 100):
        done: list[int] = []
        pool.share([functools.partial(done.append, i) for i in range(count)])
        assert sorted(done) == list(range(count))


def share_among_three(pool: ThreadPool) -> None:
    """Run three tasks, none of which ends before all three have begun."""
    barrier = threading.Barrier(3)

    def task() -> None:
        barrier.wait(deadline(10.0))

    pool.share([task] * 3)


def test_threads_work_at_the_same_time() -> None:
    share_among_three(ThreadPool(3))


@pytest.mark.parametrize("failing", [0, 1])
def test_a_failure_in_a_thread_is_raised_in_the_caller(failing: int) -> None:
    pool = ThreadPool(2)
    barrier = threading.Barrier(2)

    def task(number: int) -> None:
        barrier.wait(deadline(10.0))
        if number == failing:
            raise ValueError("this part is invalid")

    with pytest.raises(ValueError, match="part is invalid"):
        pool.share([lambda: task(0), lambda: task(1)])
    done = []
    pool.share([lambda: done.append(0), lambda: done.append(1)])
    assert sorted(done) == [0, 1]


def test_threads_end_with_their_pool() -> None:
    before = set(threading.enumerate())
    pool = ThreadPool(3)
    share_among_three(pool)
    workers = set(threading.enumerate()) - before
    assert len(workers) == 2
    del pool
    for thread in workers:
        thread.join(deadline(10.0))
        assert not thread.is_alive()
