"""Ends the processes that tests have started when the process of the tests ends, also when a signal killed it.

A test process sets :data:`VARIABLE`, which all processes that it starts inherit, and their children, too. A watcher
waits until the test process has ended. Then it ends all processes whose environment has that value.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import select
import signal
import sys
import time
from pathlib import Path

VARIABLE = "VINESIM_TEST_PROCESS"
GRACE = 5.0
"""Time [s] that processes have to end after SIGTERM, before they are killed."""


def end_with_this_process() -> None:
    """Let all processes that this process starts from now on end with it."""
    token = f"{os.getpid()}-{secrets.token_hex(8)}"
    environment = {name: value for name, value in os.environ.items() if name != VARIABLE}
    nothing = [(os.POSIX_SPAWN_OPEN, number, os.devnull, os.O_RDWR, 0) for number in range(3)]
    command = [sys.executable, "-I", "-S", __file__, str(os.getpid()), token]
    # a signal to the group of the tests, as of Ctrl-C, does not reach the watcher
    os.posix_spawn(sys.executable, command, environment, file_actions=nothing, setpgroup=0)
    os.environ[VARIABLE] = token


def started_with(token: str) -> list[int]:
    """Returns the ids of all processes whose environment has a value of :data:`VARIABLE`."""
    entry = f"{VARIABLE}={token}".encode()
    found = []
    for folder in Path("/proc").iterdir():
        with contextlib.suppress(OSError):  # it has ended, or belongs to another user
            if folder.name.isdecimal() and entry in (folder / "environ").read_bytes().split(b"\0"):
                found.append(int(folder.name))
    return found


def watch(pid: int, token: str) -> None:
    """Wait for the end of the test process, and end all that it has started."""
    with contextlib.suppress(ProcessLookupError):
        ended = os.pidfd_open(pid)
        if os.getppid() == pid:  # else it has ended before
            select.select([ended], [], [])
    limit = time.monotonic() + GRACE
    told: set[int] = set()
    while left := started_with(token):
        is_late = time.monotonic() > limit
        for one in left:
            if is_late or one not in told:
                told.add(one)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(one, signal.SIGKILL if is_late else signal.SIGTERM)
        time.sleep(0.05)


if __name__ == "__main__":
    watch(int(sys.argv[1]), sys.argv[2])
