"""A child process that is started before it is known what it shall do."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys

import pytest

from tests.support.waiting import wait
from vinesim.client.processes import worker_process
from vinesim.client.processes.worker_process import spawn, start_early

MODULES = ("json", "a_module.that_is_missing", "tests.client.test_spawned_process")


CONTEXT = multiprocessing.get_context("spawn")


@pytest.fixture(autouse=True)
def real_starts(monkeypatch):
    """Not those of other tests, which share their imports."""
    monkeypatch.setattr(worker_process, "CONTEXT", CONTEXT)


def report(lock, words, pipe):
    """What runs in the process."""
    with lock:
        pipe.send((os.getpid(), words, [name in sys.modules for name in MODULES]))


def test_a_process_runs_what_it_receives_after_its_imports():
    """With a lock among the arguments; a module that cannot be imported is left to who needs it."""
    lock = CONTEXT.Lock()
    spawned = spawn("test", MODULES)
    lock.acquire()
    spawned.run(report, lock, ["a", "b"])
    assert not spawned.pipe.poll(0.2)
    lock.release()
    assert spawned.pipe.recv() == (spawned.process.pid, ["a", "b"], [True, False, True])
    spawned.process.join()
    assert spawned.process.exitcode == 0


def test_a_process_that_was_started_early_is_taken_once():
    start_early("test", MODULES)
    first = spawn("test", MODULES)
    second = spawn("test", MODULES)
    assert first.process.pid != second.process.pid
    for spawned in (first, second):
        spawned.pipe.close()
        spawned.process.join()
        assert spawned.process.exitcode == 0


def test_a_process_that_nobody_took_ends_with_its_parent():
    code = (
        "from vinesim.client.processes import worker_process as s; s.start_early('x', ('json',)); "
        "print(s._started_early[('json',)].process.pid)"
    )
    parent = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    process = f"/proc/{int(parent.stdout)}"
    wait(lambda: not os.path.exists(process), "the process to end")
