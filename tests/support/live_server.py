"""What tests of the network share: waiting for conditions, and links that are skipped where they cannot be."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Callable

import pytest

from tests.support.waiting import wait as wait
from vinesim.bench.support import network_emulator


@functools.cache
def no_links() -> str:
    return network_emulator.unusable()


def need_links() -> None:
    """Skip a test where links cannot be emulated."""
    if reason := no_links():
        pytest.skip(f"links cannot be emulated here: {reason}")


class Served:
    """A server in a process of its own, perhaps in a namespace; it can be killed and started again."""

    def __init__(self, listen: str, start: Callable[..., subprocess.Popen] = subprocess.Popen) -> None:
        self._start = start
        self.endpoint = listen
        self.run()

    def run(self) -> None:
        """Start it, and wait until it listens."""
        command = [sys.executable, "-m", "vinesim.cli", "server", "--status", "none", "--listen", self.endpoint]
        self.process = self._start(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("listening on "), line
        self.endpoint = line.split()[2]

    def kill(self) -> None:
        """As a crash would."""
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()

    def __enter__(self) -> Served:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
