"""Programs that tests start by fork behave as those that ``subprocess`` starts."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support import programs, waiting

SEEN = "import os, sys; print(os.getcwd(), sys.argv, os.environ['WHO'], __name__, sys.stdin.read()); sys.exit(3)"


def test_arguments_folder_environment_input_and_exit_code_are_those_of_a_process(tmp_path: Path) -> None:
    command = [sys.executable, "-c", SEEN, "a b"]
    given = {"cwd": tmp_path, "env": os.environ | {"WHO": "ada"}, "input": "words"}
    forked = programs.run(command, **given)
    real = subprocess.run(command, capture_output=True, text=True, check=False, **given)
    assert (forked.returncode, forked.stdout) == (real.returncode, real.stdout) == (3, real.stdout)
    assert "ada __main__ words" in real.stdout


def test_an_error_is_a_traceback_and_exit_code_1() -> None:
    done = programs.run([sys.executable, "-c", "1 / 0"])
    assert done.returncode == 1
    assert done.stderr.endswith("ZeroDivisionError: division by zero\n")
    with pytest.raises(subprocess.CalledProcessError):
        programs.run([sys.executable, "-c", "1 / 0"], check=True)


def test_a_signal_is_minus_its_number() -> None:
    with programs.Popen(
        [sys.executable, "-c", "print('up', flush=True); input()"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as program:
        assert program.stdout.readline() == "up\n"
        assert program.poll() is None
        program.send_signal(signal.SIGKILL)
        assert program.wait() == -signal.SIGKILL


def test_a_program_that_does_not_end_is_killed() -> None:
    with pytest.raises(subprocess.TimeoutExpired):
        programs.run([sys.executable, "-c", "import threading; threading.Event().wait()"], timeout=0.2)


STARTS = """
import signal, subprocess, sys, threading
from tests.support import orphans, programs
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
orphans.end_with_this_process()
waits = "import subprocess, sys; child = subprocess.Popen(['sleep', 'infinity'], start_new_session=True); "
waits += "print(child.pid, flush=True); child.wait()"
for start in (programs.Popen, subprocess.Popen):
    one = start([sys.executable, "-c", waits], stdout=subprocess.PIPE, text=True)
    print(one.pid, one.stdout.readline(), flush=True)
threading.Event().wait()
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL, signal.SIGINT])
def test_what_tests_have_started_ends_with_them(number: signal.Signals) -> None:
    """Also what their programs have started, in sessions of their own."""
    with subprocess.Popen([sys.executable, "-c", STARTS], stdout=subprocess.PIPE, text=True) as tests:
        assert tests.stdout is not None
        pids = [int(word) for _ in range(4) for word in tests.stdout.readline().split()]
        ends = [os.pidfd_open(pid) for pid in pids]
        assert len(ends) == 4
        assert not select.select(ends, [], [], 0.0)[0]
        tests.send_signal(number)
    waiting.wait(lambda: len(select.select(ends, [], [], 0.0)[0]) == 4, "all programs to end")
    for end in ends:
        os.close(end)


def test_a_limit_is_never_shorter_than_on_an_idle_machine() -> None:
    assert waiting.slowness() >= 1.0
    assert waiting.deadline(2.0) >= 2.0
