"""A launch that threads share runs its kernels once for each entry of its list, whichever threads of the pool sleep; a
pool that is closed or garbage-collected leaves no thread running."""

from __future__ import annotations

import ctypes
import random
import threading
import time

import numpy as np
import pytest
import warp as wp

from tests.support.waiting import wait
from vinesim.kernels.launch import bind_launch, join_partitions
from vinesim.kernels.shared_launch import ONCE, LaunchPool

SIZE = 500


@wp.kernel(enable_backward=False)
def add_one(
    # in
    entries: wp.array(dtype=wp.int32),
    # out
    counts_out: wp.array(dtype=wp.int32),
):
    """Count one listed entry."""
    counts_out[entries[wp.tid()]] += 1


@wp.kernel(enable_backward=False)
def double(
    # in
    entries: wp.array(dtype=wp.int32),
    # out
    counts_out: wp.array(dtype=wp.int32),
):
    """Double the count of one listed entry."""
    counts_out[entries[wp.tid()]] *= 2


@wp.kernel(enable_backward=False)
def count_positive(
    # in
    entries: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
    # out
    number_out: wp.array(dtype=wp.int32),
):
    """One thread in all: how many entries have been counted."""
    for i in range(counts.shape[0]):
        if counts[i] > 0:
            number_out[0] += 1


@wp.kernel(enable_backward=False)
def note_thread(
    # in
    entries: wp.array(dtype=wp.int32),
    turns: int,
    # out
    memory_out: wp.array(dtype=wp.float64),
):
    """Work for a while in memory that only one thread has."""
    for _ in range(turns):
        memory_out[0] = memory_out[0] + wp.float64(1.0)


class Counted:
    """A list in random order, and how often each of its entries was counted."""

    def __init__(self, pool: LaunchPool, chunk: int) -> None:
        self.entries = np.random.default_rng(1).permutation(SIZE).astype(np.int32)
        listed = wp.array(self.entries, dtype=wp.int32, device="cpu")
        self.counts = wp.zeros(SIZE, dtype=wp.int32, device="cpu")
        launches = [
            bind_launch(kernel, [listed], [self.counts], index_list="entries", partitions=pool.size)
            for kernel in (add_one, double)
        ]
        self.launch = pool.share(launches, chunk)

    def check(self, count: int, first: int) -> None:
        self.counts.zero_()
        self.launch(count, first)
        wanted = np.zeros(SIZE, np.int32)
        wanted[self.entries[first : first + count]] = 2
        np.testing.assert_array_equal(self.counts.numpy(), wanted)


@pytest.fixture(params=[1, 2, 3, 5])
def pool(request: pytest.FixtureRequest):
    pool = LaunchPool(request.param)
    yield pool
    pool.close()


@pytest.mark.parametrize("packed", [True, False])
def test_each_entry_goes_once_through_all_launches_in_their_order(pool: LaunchPool, packed: bool, monkeypatch) -> None:
    """Also where Warp's internal handles cannot be had."""
    if not packed:
        monkeypatch.setattr("vinesim.kernels.launch.ctypes", None)
    draw = random.Random(1)
    for chunk in (1, 3, 64):
        counted = Counted(pool, chunk)
        for count in (0, 1, 2 * chunk - 1, 2 * chunk, SIZE, *(draw.randint(0, SIZE) for _ in range(200))):
            counted.check(count, draw.randint(0, SIZE - count))


@pytest.mark.parametrize("packed", [True, False])
def test_a_launch_of_a_sequence_may_determine_the_number_of_threads_of_the_next(
    pool: LaunchPool, packed: bool, monkeypatch
) -> None:
    if not packed:
        monkeypatch.setattr("vinesim.kernels.launch.ctypes", None)
    counted = Counted(pool, 3)
    following = Counted(pool, 64)
    listed = np.zeros(1, np.int32)
    given = ctypes.c_int32()
    number = wp.array(listed, dtype=wp.int32, device="cpu", copy=False)
    entries = wp.array(counted.entries, dtype=wp.int32, device="cpu")
    count = bind_launch(count_positive, [entries, counted.counts], [number])
    run = pool.sequence(
        [(counted.launch, given), (count, ONCE), (following.launch, ctypes.c_int32.from_buffer(listed))]
    )
    for entry_count in (0, 1, 5, 6, 127, 128, SIZE):
        counted.launch(2, 7)  # the next launch begins with the first entry again
        counted.counts.zero_()
        following.counts.zero_()
        given.value = entry_count
        listed[0] = 0
        run()
        assert listed[0] == entry_count
        for each in (counted, following):
            wanted = np.zeros(SIZE, np.int32)
            wanted[each.entries[:entry_count]] = 2
            np.testing.assert_array_equal(each.counts.numpy(), wanted)


def test_threads_that_sleep_are_woken_by_a_launch(pool: LaunchPool) -> None:
    counted = Counted(pool, 1)
    for turn in range(20):
        wait(lambda: pool.sleeping == pool.size - 1, "threads that sleep")
        if turn % 2:
            pool.wake()
        counted.check(SIZE, 0)
    for _ in range(200):  # some of them while they fall asleep
        counted.check(SIZE, 0)
        time.sleep(random.Random(1).uniform(0.0, 5e-4))


def test_threads_work_at_the_same_time_each_with_memory_of_its_own() -> None:
    pool = LaunchPool(2)
    entries = wp.array(np.arange(64), dtype=wp.int32, device="cpu")
    memory = [wp.zeros(1, dtype=wp.float64, device="cpu") for _ in range(2)]
    launches = [bind_launch(note_thread, [entries, 20000], [mine], index_list="entries") for mine in memory]
    launch = pool.share([join_partitions(launches)], 1)

    def both_worked() -> bool:
        launch(64)
        return all(mine.numpy()[0] > 0.0 for mine in memory)

    wait(both_worked, "work of both threads")
    assert sum(mine.numpy()[0] for mine in memory) % (64 * 20000) == 0.0
    pool.close()


def test_a_pool_that_is_closed_or_gone_leaves_no_thread() -> None:
    def use() -> LaunchPool:
        pool = LaunchPool(4)
        Counted(pool, 1).check(SIZE, 0)
        wait(lambda: pool.sleeping == 3, "threads that sleep")
        return pool

    def new() -> list[threading.Thread]:
        return [thread for thread in threading.enumerate() if thread not in before]

    before = threading.enumerate()
    pool = use()
    assert len(new()) == 3
    pool.close()
    pool.close()
    wait(lambda: not new(), "the end of the threads")
    use()
    wait(lambda: not new(), "the end of the threads of a pool that was garbage-collected")
