"""Child processes that run Python modules, in groups whose processes end together."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping

EXIT_TIMEOUT = 1.6
"""Time between SIGINT and SIGKILL when the group is left [s]."""
START_TIMEOUT = 300.0
"""Longest start of a client; a first run compiles kernels [s]."""
REPORT_TIMEOUT = 180.0
"""Longest time in which a process writes its report and ends [s]; a client waits up to 60 s for its last picture."""
STDERR_LINES = 40
"""Number of the last lines of standard error that are kept."""


class ProcessFailed(RuntimeError):
    """A process ended too early or printed nothing; the text names it and its last line on stderr."""

    exit_code = 4


@dataclasses.dataclass
class Process:
    """A child process, its unread lines of output and its newest lines of standard error."""

    name: str
    child: subprocess.Popen[str]
    started: float
    """Wall time at which the process was started [s since the epoch]."""
    stdout_lines: queue.Queue[str]
    """Lines of output that were not read yet. An empty string marks the end of the output."""
    stderr_tail: list[str]

    @classmethod
    def start(cls, name: str, *arguments: str, **environ: str) -> Process:
        """Run ``python ARGUMENTS`` in a session of its own, so that Ctrl-C reaches it only through its parent."""
        started = time.time()
        child = subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env={**os.environ, **environ},
        )
        process = cls(name, child, started, queue.Queue(), [])
        threading.Thread(target=process._read_stdout, daemon=True).start()
        threading.Thread(target=process._read_stderr, daemon=True).start()
        return process

    def _read_stdout(self) -> None:
        assert self.child.stdout is not None
        for line in self.child.stdout:
            self.stdout_lines.put(line.rstrip("\n"))
        self.stdout_lines.put("")

    def _read_stderr(self) -> None:
        assert self.child.stderr is not None
        for line in self.child.stderr:
            self.stderr_tail = [*self.stderr_tail[-STDERR_LINES:], line.rstrip("\n")]

    def next_line(self, timeout: float) -> str:
        """The next line of output. Raises :class:`ProcessFailed` if the process ended, or printed nothing for
        ``timeout`` [s]."""
        try:
            line = self.stdout_lines.get(timeout=timeout)
        except queue.Empty:
            raise self.fault(f"{self.name} printed nothing for {timeout:.0f} s") from None
        if not line:
            raise self.failure()
        return line

    def new_lines(self) -> list[str]:
        """The lines of output since the last call. Raises :class:`ProcessFailed` if the process has ended."""
        lines = []
        with contextlib.suppress(queue.Empty):
            while line := self.stdout_lines.get_nowait():
                lines.append(line)
            raise self.failure()
        return lines

    def write_line(self, line: str) -> None:
        """Write a line to its standard input."""
        assert self.child.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended, which the next read reports
            self.child.stdin.write(line + "\n")
            self.child.stdin.flush()

    def remaining_output(self, timeout: float) -> str:
        """Close its standard input and return everything that it prints until its end."""
        assert self.child.stdin is not None
        self.child.stdin.close()
        lines = []
        while line := self.stdout_lines.get(timeout=timeout):
            lines.append(line)
        return "\n".join(lines)

    def failure(self) -> ProcessFailed:
        """The error to raise for a process that ended too early."""
        self.wait_or_kill(REPORT_TIMEOUT)
        return self.fault(f"{self.name} ended with exit code {self.child.returncode}")

    def fault(self, text: str) -> ProcessFailed:
        """An error to raise, with the last line of standard error."""
        lines = [line for line in self.stderr_tail if line.strip()]
        summary = f"last line of {self.name} on stderr: {lines[-1]}" if lines else f"nothing on stderr of {self.name}"
        return ProcessFailed(f"{text}; {summary}")

    def interrupt(self) -> None:
        """Send SIGINT; :meth:`wait_or_kill` waits for the end."""
        if self.child.poll() is None:
            self.child.send_signal(signal.SIGINT)

    def wait_or_kill(self, timeout: float) -> None:
        """Wait up to ``timeout`` [s] for its end, then kill it."""
        try:
            self.child.wait(max(timeout, 0.0))
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()

    def finish(self) -> None:
        """Interrupt it and wait for its report; :class:`ProcessFailed` if it fails."""
        self.interrupt()
        self.wait_or_kill(REPORT_TIMEOUT)
        if self.child.returncode:
            raise self.failure()


class ProcessGroup:
    """Processes that belong together, with ROS on this machine only unless the user has chosen otherwise."""

    def __init__(self, environ: Mapping[str, str]) -> None:
        self.processes: list[Process] = []
        self._environ = dict(environ)
        if "ROS_AUTOMATIC_DISCOVERY_RANGE" not in os.environ:
            self._environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

    def start(self, name: str, *arguments: str) -> Process:
        """Start ``python ARGUMENTS``."""
        self.processes.append(Process.start(name, *arguments, **self._environ))
        return self.processes[-1]

    def start_server(self, real_time_factor: float | None = None) -> tuple[Process, str]:
        """Start a server on a free port of this machine. Returns the process and the server's endpoint.

        ``real_time_factor``: rate of the server's world; None: as fast as its clients can follow.
        """
        factor = "auto" if real_time_factor is None else f"{real_time_factor:g}"
        server = self.start(
            "server", "-m", "vinesim", "server", "--listen", "tcp/127.0.0.1:0", "--real-time-factor", factor
        )
        return server, server.next_line(START_TIMEOUT).removeprefix("listening on ")


def free_port() -> int:
    """A TCP port of this machine that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def process_group(exit_timeout: float = EXIT_TIMEOUT, **environ: str) -> Iterator[ProcessGroup]:
    """A group of processes that end with the ``with`` block, all within ``exit_timeout`` [s], also after an exception.

    ``environ`` is added to the environment of each process.
    """
    group = ProcessGroup(environ)
    try:
        yield group
    finally:
        deadline = time.monotonic() + exit_timeout
        for process in group.processes:
            process.interrupt()
        for process in group.processes:
            process.wait_or_kill(deadline - time.monotonic())
