"""For tests over real Zenoh: a server process, and a skip where network links cannot be emulated."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Callable

import pytest

from benchmarks.support import network_emulator
from tests.support import programs
from tests.support.waiting import wait as wait


@functools.cache
def unavailable_reason() -> str:
    return network_emulator.unusable()


def require_network_emulation() -> None:
    """Skip a test where network links cannot be emulated."""
    if reason := unavailable_reason():
        pytest.skip(f"links cannot be emulated here: {reason}")


class ServerProcess:
    """A server in a process of its own, perhaps in a namespace; it can be killed and started again."""

    def __init__(self, listen: str, start: Callable[..., subprocess.Popen | programs.Popen] = programs.Popen) -> None:
        self._start = start
        self.endpoint = listen
        self.run()

    def run(self) -> None:
        """Start the process and wait until it listens."""
        command = [sys.executable, "-m", "vinesim", "server", "--insecure", "--status", "none", "--listen"]
        command.append(self.endpoint)
        self.process = self._start(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("listening on "), line
        self.endpoint = line.split()[2]

    def kill(self) -> None:
        """Kill the process (SIGKILL), as a crash would."""
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()

    def __enter__(self) -> ServerProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
