from __future__ import annotations

import threading

import numpy as np
import pytest
import warp as wp

from vinesim.core.warp_arrays import share
from vinesim.kernels.graph import TIERS, ForeignLaunches, KernelGraph, KernelLaunch, outside_captures, tier_of


@wp.kernel(enable_backward=False)
def count_visits(
    # in
    count: wp.array(dtype=wp.int32),
    entries: wp.array(dtype=wp.int32),
    # out
    visits_out: wp.array(dtype=wp.int32),
):
    """One thread counts one visit to one listed entry."""
    if wp.tid() >= count[0]:
        return
    visits_out[entries[wp.tid()]] += 1


@wp.kernel(enable_backward=False)
def count_even(
    # in
    count: wp.array(dtype=wp.int32),
    entries: wp.array(dtype=wp.int32),
    # out
    even_count_out: wp.array(dtype=wp.int32),
    even_out: wp.array(dtype=wp.int32),
):
    """One thread in all lists the even entries."""
    even_count_out[0] = 0
    for i in range(count[0]):
        if entries[i] % 2 == 0:
            even_out[even_count_out[0]] = entries[i]
            even_count_out[0] += 1


@wp.kernel(enable_backward=False)
def number_cells(
    # in
    count: wp.array(dtype=wp.int32),
    # out
    cells_out: wp.array2d(dtype=wp.int32),
):
    """One thread numbers one cell of one row."""
    row, column = wp.tid()
    if row < count[0]:
        cells_out[row, column] = 10 * row + column


def ints(data: np.ndarray) -> wp.array:
    return share(data, wp.int32)


def test_as_many_items_are_visited_as_the_count_says() -> None:
    """Also after the count has changed, within a tier and beyond it."""
    size = TIERS[0] + 3
    count = np.zeros(1, np.int32)
    entries = np.arange(size, dtype=np.int32)[::-1].copy()
    visits = np.zeros(size, np.int32)
    visit = KernelGraph(KernelLaunch(count_visits, [ints(count), ints(entries)], [ints(visits)]))
    for items in (2, 0, TIERS[0], 1, size):
        visits[:] = 0
        count[0] = items
        visit(items)
        assert visits[::-1].tolist() == [1] * items + [0] * (size - items)


def test_a_launch_reads_the_count_that_the_launch_before_it_wrote() -> None:
    count = np.full(1, 5, np.int32)
    even_count = np.zeros(1, np.int32)
    entries = np.array([3, 4, 0, 7, 2], np.int32)
    even = np.zeros(5, np.int32)
    visits = np.zeros(8, np.int32)
    both = KernelGraph(
        KernelLaunch(count_even, [ints(count), ints(entries)], [ints(even_count), ints(even)], threads=1),
        KernelLaunch(count_visits, [ints(even_count), ints(even)], [ints(visits)]),
    )
    both(5)
    assert visits.tolist() == [1, 0, 1, 0, 1, 0, 0, 0]
    entries[0] = 6
    both(5)
    assert visits.tolist() == [2, 0, 2, 0, 2, 0, 1, 0]


def test_the_threads_of_an_item_are_the_second_dimension() -> None:
    count = np.full(1, 2, np.int32)
    cells = np.full((3, 3), -1, np.int32)
    KernelGraph(KernelLaunch(number_cells, [ints(count)], [ints(cells)], width=3))(2)
    assert cells.tolist() == [[0, 1, 2], [10, 11, 12], [-1, -1, -1]]


def test_a_launch_of_no_threads_does_nothing() -> None:
    cells = np.full((1, 2), -1, np.int32)
    KernelGraph(KernelLaunch(number_cells, [ints(np.ones(1, np.int32))], [ints(cells)], threads=0, width=2))()
    assert cells.tolist() == [[-1, -1]]


def test_tiers_hold_what_is_asked_for() -> None:
    first, second = range(TIERS[0] + 1), range(TIERS[0] + 1, TIERS[1] + 1)
    assert [tier_of(n) for n in (0, 1, TIERS[0], TIERS[0] + 1)] == [first, first, first, second]
    with pytest.raises(ValueError, match="4194305 items in one launch; the largest number is 4194304"):
        tier_of(TIERS[-1] + 1)


def test_what_another_thread_launches_during_a_capture_runs_once_and_is_no_part_of_the_graph() -> None:
    mine, theirs = np.zeros(4, np.int32), np.zeros(4, np.int32)
    count, entries = ints(np.array([4], np.int32)), ints(np.arange(4, dtype=np.int32))

    def launch() -> None:
        with outside_captures():
            wp.launch(count_visits, 4, inputs=[count, entries], outputs=[ints(theirs)], device="cpu")

    other = threading.Thread(target=launch)

    def start_the_other() -> None:
        other.start()
        other.join(0.2)

    sequence = KernelGraph(ForeignLaunches(start_the_other), KernelLaunch(count_visits, [count, entries], [ints(mine)]))
    sequence(4)
    other.join()
    for _ in range(2):
        sequence(4)
    assert theirs.tolist() == [1] * 4
    assert mine.tolist() == [3] * 4


def test_a_sequence_runs_while_another_thread_launches_and_is_captured_later() -> None:
    visits, captures = np.zeros(4, np.int32), []
    count, entries = ints(np.array([4], np.int32)), ints(np.arange(4, dtype=np.int32))
    sequence = KernelGraph(
        ForeignLaunches(lambda: captures.append(wp.get_device("cpu").is_capturing)),
        KernelLaunch(count_visits, [count, entries], [ints(visits)]),
    )
    with outside_captures():
        sequence(4)
        sequence(3)
    assert captures == [False, False]
    assert visits.tolist() == [2] * 4
    for _ in range(3):
        sequence(4)
    assert captures == [False, False, True]
    assert visits.tolist() == [5] * 4
