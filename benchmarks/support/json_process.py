"""A process that a benchmark controls by lines of JSON: commands on its standard input, answers on its output."""

from __future__ import annotations

import contextlib
import json
import select
import subprocess
import sys
from collections.abc import Callable
from typing import Any, Self

LEAVE_TIME = 20.0
"""[s] Time in which a process must end after its standard input has ended."""


class JsonProcess:
    """A Python module that runs in a process of its own. A context manager."""

    def __init__(self, module: str, wanted: Any, start: Callable[..., Any] = subprocess.Popen) -> None:
        """``wanted``: JSON value that the module gets as its only argument. ``start(command, **options of Popen)``:
        starts the process, for example in a network namespace."""
        self._module = module
        self.process = start(
            [sys.executable, "-m", module, json.dumps(wanted)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def send(self, **command: Any) -> None:
        """Send a command; :meth:`answer` returns the answer."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()

    def answer(self, timeout: float | None = None) -> dict[str, Any]:
        """Returns the next answer.

        ``timeout``: longest time to wait for its first byte [s]; None: no limit. Raises :class:`RuntimeError` if the
        process has ended, or has not answered by then.
        """
        assert self.process.stdout is not None
        if timeout is not None and not select.select([self.process.stdout], [], [], timeout)[0]:
            raise RuntimeError(f"{self._module} (process {self.process.pid}) has not answered for {timeout:.0f} s")
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"{self._module} ended with exit status {self.process.wait()}")
        return json.loads(line)

    def close(self) -> None:
        """End the standard input of the process, and wait until the process has ended."""
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None and not pipe.closed:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        try:
            self.process.wait(LEAVE_TIME)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
