"""A process that hangs is started again; one that is slow to start is not."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest

from tests.support.waiting import wait
from vinesim.client.processes import worker_process
from vinesim.client.processes.worker_process import Totals, WorkerProcess

MODULES = ("tests.client.test_worker_process",)
HANG_TIMEOUT = 2


class Nothing:
    """What a process of these tests shares with its parent."""

    def close(self) -> None:
        pass


def report_until_stopped(start_time: float, _shared: Nothing, pipe) -> None:
    """Ready after ``start_time`` [s], then a message ten times a second."""
    time.sleep(start_time)
    pipe.send(("ready", None))
    while not pipe.poll(0.1):
        pipe.send(("alive", None))


@pytest.fixture
def start(monkeypatch) -> Iterator[Callable[[float], WorkerProcess]]:
    monkeypatch.setattr(worker_process, "HANG_TIMEOUT", HANG_TIMEOUT)
    workers = []

    def start_worker(start_time: float) -> WorkerProcess:
        workers.append(
            WorkerProcess(
                "the test process", MODULES, report_until_stopped, start_time, lambda _: Nothing(), lambda *_: None
            )
        )
        return workers[-1]

    yield start_worker
    for worker in workers:
        worker.close()


def test_a_process_that_hangs_is_killed_and_started_again(start, caplog):
    caplog.set_level(logging.WARNING)
    worker = start(0.0)
    wait(lambda: worker.is_ready, "the process to be ready")
    former = worker.current().process
    os.kill(former.pid, signal.SIGSTOP)
    wait(lambda: worker.restarts == 1 and worker.is_ready, "a process that is ready again")
    assert not former.is_alive()
    assert worker.current().process.pid != former.pid
    assert "the test process failed: it hung: nothing came from it for 2 s; starting it again" in caplog.messages


def test_a_process_that_waits_for_a_cpu_does_not_hang(start, monkeypatch):
    """On a busy machine it is silent for longer than that, and is left alone; it goes on afterwards."""
    looks: list[int] = []
    monkeypatch.setattr(worker_process, "cpu_use", lambda pid: (looks.append(pid) or 0.1 * len(looks), True))
    worker = start(0.0)
    wait(lambda: worker.is_ready, "the process to be ready")
    former = worker.current().process
    os.kill(former.pid, signal.SIGSTOP)
    wait(lambda: len(looks) == 2 * HANG_TIMEOUT, "silence")
    os.kill(former.pid, signal.SIGCONT)
    assert set(looks) == {former.pid}
    assert worker.restarts == 0
    assert former.is_alive()


@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="needs /proc of Linux")
def test_what_a_process_asks_of_the_cpu():
    """One that computes asks for it, one that waits for input does not; both use the time that they say."""
    code = "import sys; print(flush=True); sys.stdin.readline(); print(flush=True)\nwhile True: pass"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        child.stdout.readline()
        wait(lambda: not worker_process.cpu_use(child.pid)[1], "a process that waits")
        before, _ = worker_process.cpu_use(child.pid)
        child.stdin.write("\n")
        child.stdin.flush()
        wait(lambda: worker_process.cpu_use(child.pid)[0] > before + 0.1, "CPU time")
        assert worker_process.cpu_use(child.pid)[1]
        child.kill()
    assert worker_process.cpu_use(child.pid) == (0.0, False)


@pytest.mark.slow
def test_a_process_that_hangs_before_it_is_ready_is_started_again_later(start, monkeypatch):
    """What may compile kernels for minutes is not hung, yet it is not waited for without end."""
    monkeypatch.setattr(worker_process, "START_TIMEOUT", 3 * HANG_TIMEOUT)
    worker = start(2.0 * HANG_TIMEOUT)
    calls: list[None] = []
    worker.wait_until_ready(60.0, lambda: calls.append(None))
    assert len(calls) >= 2  # about once a second
    assert worker.restarts == 0
    former = worker.current().process.pid
    os.kill(former, signal.SIGKILL)
    wait(lambda: worker.current().process.pid != former, "a restart")
    os.kill(worker.current().process.pid, signal.SIGSTOP)
    stopped = time.monotonic()
    wait(lambda: worker.restarts == 2, "another restart")
    assert time.monotonic() - stopped > 2.0 * HANG_TIMEOUT


def test_counts_are_summed_over_all_runs_of_a_process():
    """A topic that the present run has not yet, and a kind that no run has, are no errors."""
    totals = Totals()
    assert totals.of("sent") == {}
    totals.take({"sent": {"/clock": 3, "/tf": 1}})
    totals.take({"sent": {"/clock": 5, "/tf": 2}})
    assert totals.of("sent") == {"/clock": 5, "/tf": 2}
    totals.begin_run()
    assert totals.of("sent") == {"/clock": 5, "/tf": 2}
    totals.take({"sent": {"/clock": 1}, "dropped": {"/clock": 4}})
    totals.begin_run()
    totals.take({"sent": {"/joint_states": 1}})
    assert totals.of("sent") == {"/clock": 6, "/tf": 2, "/joint_states": 1}
    assert totals.of("dropped") == {"/clock": 4}
