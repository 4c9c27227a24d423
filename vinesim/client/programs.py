"""Programs that demos and benchmarks start: commands of vinesim and a ROS listener, in groups that end together.

The processes that a client starts for a robot are in :mod:`vinesim.client.processes`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import pathlib
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

EXIT_TIMEOUT = 1.6
"""Time between SIGINT and SIGKILL at the end of a :func:`program_group` [s]."""
START_TIMEOUT = 300.0
"""Longest time in which a client starts [s]. A first run compiles kernels."""
REPORT_TIMEOUT = 180.0
"""Longest time in which a program writes its report and ends [s]. A client waits up to 60 s for its last picture."""
STDERR_LINES = 40
"""Number of the last lines of standard error that are kept."""
TopicReport = dict[str, dict[str, Any]]
"""Statistics by topic, as :mod:`vinesim.ros.tools.topic_monitor` prints them."""


class ProgramFailed(RuntimeError):
    """A program ended too early or printed nothing. The text names the program and its last line on standard error."""

    exit_code = 4


@dataclasses.dataclass
class Program:
    """A running program, its unread lines of output and its newest lines of standard error."""

    name: str
    child: subprocess.Popen[str]
    started: float
    """Wall time at which the program was started [s since the epoch]."""
    stdout_lines: queue.Queue[str]
    """Lines of output that were not read yet. An empty string marks the end of the output."""
    stderr_tail: list[str]

    @classmethod
    def start(cls, name: str, *arguments: str, **environ: str) -> Program:
        """Run ``python ARGUMENTS`` in a session of its own, so that Ctrl-C reaches only the parent.

        ``environ`` is added to the environment.
        """
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
        """Returns the next line of output. Raises :class:`ProgramFailed` if the program ended, or printed nothing for
        ``timeout`` [s]."""
        try:
            line = self.stdout_lines.get(timeout=timeout)
        except queue.Empty:
            raise self.fault(f"{self.name} printed nothing for {timeout:.0f} s") from None
        if not line:
            raise self.failure()
        return line

    def new_lines(self) -> list[str]:
        """Returns the lines of output since the last call. Raises :class:`ProgramFailed` if the program has ended."""
        lines = []
        with contextlib.suppress(queue.Empty):
            while line := self.stdout_lines.get_nowait():
                lines.append(line)
            raise self.failure()
        return lines

    def write_line(self, line: str) -> None:
        """Write a line to the program's standard input."""
        assert self.child.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # the program has ended, which the next read reports
            self.child.stdin.write(line + "\n")
            self.child.stdin.flush()

    def remaining_output(self, timeout: float) -> str:
        """Close the program's standard input. Returns all text that it prints until its end.

        ``timeout``: longest wait for each line [s].
        """
        assert self.child.stdin is not None
        self.child.stdin.close()
        lines = []
        while line := self.stdout_lines.get(timeout=timeout):
            lines.append(line)
        return "\n".join(lines)

    def failure(self) -> ProgramFailed:
        """Returns the error to raise if the program ended too early."""
        self.wait_or_kill(REPORT_TIMEOUT)
        return self.fault(f"{self.name} ended with exit code {self.child.returncode}")

    def fault(self, text: str) -> ProgramFailed:
        """Returns an error with this ``text`` and the last line of standard error."""
        lines = [line for line in self.stderr_tail if line.strip()]
        summary = f"last line of {self.name} on stderr: {lines[-1]}" if lines else f"nothing on stderr of {self.name}"
        return ProgramFailed(f"{text}; {summary}")

    def interrupt(self) -> None:
        """Send SIGINT, and do not wait for the end."""
        if self.child.poll() is None:
            self.child.send_signal(signal.SIGINT)

    def wait_or_kill(self, timeout: float) -> None:
        """Wait up to ``timeout`` [s] for the end of the program, then kill it."""
        try:
            self.child.wait(max(timeout, 0.0))
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()

    def finish(self) -> None:
        """Interrupt the program and wait for its end. Raises :class:`ProgramFailed` if its exit code is not 0."""
        self.interrupt()
        self.wait_or_kill(REPORT_TIMEOUT)
        if self.child.returncode:
            raise self.failure()


class ProgramGroup:
    """Programs that belong together. Their ROS nodes are found on this machine only, unless the user chose a range.

    ``environ`` is added to the environment of each program.
    """

    def __init__(self, environ: Mapping[str, str]) -> None:
        self.programs: list[Program] = []
        self._environ = dict(environ)
        if "ROS_AUTOMATIC_DISCOVERY_RANGE" not in os.environ:
            self._environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

    def start(self, name: str, *arguments: str) -> Program:
        """Start ``python ARGUMENTS`` under a ``name`` for messages."""
        self.programs.append(Program.start(name, *arguments, **self._environ))
        return self.programs[-1]

    def start_server(self, real_time_factor: float | None = None) -> tuple[Program, str]:
        """Start a server on a free port of this machine. Returns the program and the server's endpoint.

        ``real_time_factor``: rate of the server's world; None: as fast as its clients can follow.
        """
        factor = "auto" if real_time_factor is None else f"{real_time_factor:g}"
        server = self.start(
            "server", "-m", "vinesim", "server", "--listen", "tcp/127.0.0.1:0", "--real-time-factor", factor
        )
        return server, server.next_line(START_TIMEOUT).removeprefix("listening on ")


def free_port() -> int:
    """Returns a TCP port of this machine that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def program_group(exit_timeout: float = EXIT_TIMEOUT, **environ: str) -> Iterator[ProgramGroup]:
    """Context with a group of programs. All programs end with the ``with`` block, within ``exit_timeout`` [s], also
    after an exception.

    ``environ`` is added to the environment of each program.
    """
    group = ProgramGroup(environ)
    try:
        yield group
    finally:
        deadline = time.monotonic() + exit_timeout
        for program in group.programs:
            program.interrupt()
        for program in group.programs:
            program.wait_or_kill(deadline - time.monotonic())


class RosListener:
    """A stock ROS node in a program of its own. It records the first message and the number of messages of each topic.

    It subscribes to topics as they appear. Its methods raise :class:`ProgramFailed` if the program has ended.
    """

    def __init__(
        self,
        group: ProgramGroup,
        topics: Sequence[str],
        once: Sequence[str] = (),
        events: Sequence[str] = (),
        arrivals: pathlib.Path | None = None,
    ) -> None:
        """``topics``: topics that :meth:`missing` waits for. ``once``: further such topics, from which the node
        unsubscribes after their first message. ``events``: topics that may stay silent. ``arrivals``: file for the
        times of every message, see :attr:`TopicStats.arrivals`."""
        self.topics = (*topics, *once)
        words = [word for topic in (*topics, *events) for word in ("--topic", topic)]
        words += [word for topic in once for word in ("--once", topic)]
        words += [] if arrivals is None else ["--arrivals", str(arrivals)]
        self._program: Program = group.start(
            "ROS listener", "-m", "vinesim.ros.tools.topic_monitor", "--announce", *words
        )
        self.listens_since: float | None = None
        """Wall time at which the node began to look for topics [s since the epoch]. None before."""
        self.first: dict[str, float] = {}
        """Wall time of the first message of each topic [s since the epoch], by topic."""

    @property
    def pid(self) -> int:
        """Process id of the program."""
        return self._program.child.pid

    @property
    def started(self) -> float:
        """Wall time at which the program was started [s since the epoch]."""
        return self._program.started

    def wait_until_listening(self) -> None:
        """Wait until the node subscribes to topics that appear."""
        while self.listens_since is None:
            self._read(json.loads(self._program.next_line(START_TIMEOUT)))

    def missing(self) -> list[str]:
        """Returns the topics without a message so far, in the order in which they were named, without ``events``."""
        for line in self._program.new_lines():
            self._read(json.loads(line))
        return [topic for topic in self.topics if topic not in self.first]

    def _read(self, announcement: dict[str, Any]) -> None:
        if "listening" in announcement:
            self.listens_since = announcement["listening"]
        else:
            self.first[announcement["topic"]] = announcement["first"]

    def restart(self) -> None:
        """Set all counts to 0, so that rates and losses are those after this call."""
        self._program.write_line("restart")

    def stop(self) -> None:
        """End all counts, and the program."""
        self._program.write_line("stop")

    def report(self) -> TopicReport:
        """Returns statistics of all messages that came before :meth:`stop` or, if it was not called, before this
        call."""
        *_, report = self._program.remaining_output(REPORT_TIMEOUT).splitlines()
        return json.loads(report)
