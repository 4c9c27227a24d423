"""Sweeps: results in order, a killed process loses nothing, one that always dies is named."""

from __future__ import annotations

import concurrent.futures

import pytest

import vinesim
from tests.support.sweep_tasks import die_at_three, die_once, fail_at_three, square
from vinesim.api.sweep import WorkerLost


def test_results_come_in_the_order_of_the_parameters():
    assert vinesim.sweep(square, range(7), workers=2) == [0, 1, 4, 9, 16, 25, 36]
    assert vinesim.sweep(square, []) == []


def test_another_executor_takes_the_tasks():
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        assert vinesim.sweep(square, range(4), executor=pool) == [0, 1, 4, 9]


def test_a_killed_process_loses_nothing(tmp_path, caplog):
    assert vinesim.sweep(die_once, [(str(tmp_path), number) for number in range(8)], workers=2) == [
        number * number for number in range(8)
    ]
    assert (tmp_path / "3-1").exists()  # it was run again
    assert len(list(tmp_path.glob("0-*"))) <= 2  # what was done before stays done, or was at work beside it
    assert "died" in caplog.text


def test_a_parameter_that_always_kills_its_process_is_named():
    with pytest.raises(WorkerLost, match="3 times with the parameter 3"):
        vinesim.sweep(die_at_three, range(5), workers=2)


def test_an_error_of_the_function_ends_the_sweep():
    with pytest.raises(ValueError, match="three is not taken"):
        vinesim.sweep(fail_at_three, range(6), workers=2)
    with pytest.raises(vinesim.UsageError, match="workers"):
        vinesim.sweep(square, range(3), workers=0)
