"""Sweeps: results in order, a killed process loses nothing, one that always dies is named."""

from __future__ import annotations

import concurrent.futures
import threading

import psutil
import pytest

import vinesim
from tests.support.sweep_tasks import die_at_three, die_once, fail_at_three, square, swing
from tests.support.waiting import deadline, wait
from vinesim.api.sweep import WorkerLost


def test_results_come_in_the_order_of_the_parameters():
    assert vinesim.sweep(square, range(7), workers=2) == [0, 1, 4, 9, 16, 25, 36]
    assert vinesim.sweep(square, []) == []


def test_another_executor_takes_the_tasks():
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        assert vinesim.sweep(square, range(4), executor=pool) == [0, 1, 4, 9]


def test_an_error_on_an_executor_cancels_what_has_not_begun():
    begun = []
    ended = threading.Event()

    def task(number):
        begun.append(number)
        if number == 0:
            raise ValueError("zero is not taken")
        ended.wait(deadline())

    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        with pytest.raises(ValueError, match="zero is not taken"):
            vinesim.sweep(task, range(5), executor=pool)
        ended.set()
    assert begun in ([0], [0, 1])  # its thread may have taken the next one


def test_a_killed_process_loses_nothing(tmp_path, caplog):
    assert vinesim.sweep(die_once, [(str(tmp_path), number) for number in range(8)], workers=2) == [
        number * number for number in range(8)
    ]
    assert (tmp_path / "3-1").exists()  # it was run again
    assert len(list(tmp_path.glob("0-*"))) <= 2  # what was done before stays done, or was at work beside it
    assert "died" in caplog.text


@pytest.mark.long
def test_dask_workers_give_the_bits_of_local_processes_though_one_is_killed(tmp_path):
    """Two worker processes on the loopback, of which one is killed half-way through the third of eight tasks."""
    distributed = pytest.importorskip("distributed", reason="Dask is an extra (dask)")

    def tasks(name):
        (tmp_path / name).mkdir()
        return [(str(tmp_path / name), number) for number in range(8)]

    undisturbed = tasks("local")
    (tmp_path / "local/3-0").touch()
    local = vinesim.sweep(swing, undisturbed, workers=2)
    before = set(psutil.Process().children(recursive=True))  # Python's tracker of resources stays
    cluster = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=None,
        local_directory=str(tmp_path),
    )
    with cluster, distributed.Client(cluster) as client:
        on_dask = vinesim.sweep(swing, tasks("dask"), executor=client.get_executor())
    assert on_dask == local
    assert len(set(on_dask)) == 8
    process = {file.name: int(file.read_text()) for file in (tmp_path / "dask").iterdir()}
    assert {name.partition("-")[0] for name in process} == set("01234567")
    assert process["3-0"] != process["3-1"]  # killed there, run again elsewhere
    wait(lambda: set(psutil.Process().children(recursive=True)) <= before, "the processes of Dask to end")


def test_a_parameter_that_always_kills_its_process_is_named():
    with pytest.raises(WorkerLost, match="3 times with the parameter 3"):
        vinesim.sweep(die_at_three, range(5), workers=2)


def test_an_error_of_the_function_ends_the_sweep():
    with pytest.raises(ValueError, match="three is not taken"):
        vinesim.sweep(fail_at_three, range(6), workers=2)
    with pytest.raises(vinesim.UsageError, match="workers"):
        vinesim.sweep(square, range(3), workers=0)
