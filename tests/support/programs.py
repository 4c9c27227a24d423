"""Python programs that tests start: as ``subprocess.Popen`` and ``subprocess.run``, but by fork of a process that has
imported most of vinesim (:mod:`tests.support.fork_server`).

For a test whose subject is the start of a process, its imports, its environment or its memory, use ``subprocess``.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

ROOT = Path(__file__).parents[2]


class _Server:
    """The process from which programs are forked."""

    def __init__(self) -> None:
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.support.fork_server", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                cwd=ROOT,
                stdin=subprocess.DEVNULL,
                env=os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1", "MUJOCO_GL": "disable"},
            )
        self._lock = threading.Lock()

    def start(self, request: dict, files: list[int]) -> None:
        with self._lock:
            socket.send_fds(self._control, [json.dumps(request).encode()], files)

    def close(self) -> None:
        self._control.close()
        self._process.wait()


_starting = threading.Lock()
_started: list[_Server] = []


def _server() -> _Server:
    """The server of this process, which starts with the first program."""
    with _starting:
        if not _started:
            _started.append(_Server())
            atexit.register(_started[0].close)
        return _started[0]


class Popen:
    """A program that runs: what tests use of ``subprocess.Popen``. Its output is text."""

    def __init__(
        self,
        command: Sequence[str],
        *,
        stdin: int | IO | None = None,
        stdout: int | IO | None = None,
        stderr: int | IO | None = None,
        cwd: str | os.PathLike[str] | None = None,
        env: Mapping[str, str] | None = None,
        text: bool = True,
    ) -> None:
        assert command[0] == sys.executable, "only Python programs are forked"
        assert text, "pipes are text"
        self.args = command
        self.returncode: int | None = None
        self._status, theirs = socket.socketpair()
        with contextlib.ExitStack() as stack:
            stack.enter_context(theirs)
            self.stdin, first = self._pipe(stdin, 0, stack)
            self.stdout, second = self._pipe(stdout, 1, stack)
            if stderr == subprocess.STDOUT:
                self.stderr = None
                third = second
            else:
                self.stderr, third = self._pipe(stderr, 2, stack)
            request = {
                "arguments": [str(word) for word in command[1:]],
                "cwd": os.fspath(cwd or os.getcwd()),
                "env": dict(os.environ if env is None else env),
            }
            _server().start(request, [first, second, third, theirs.fileno()])
        self._said = self._status.makefile("r")
        line = self._said.readline()
        assert line, "the fork server has ended"
        self.pid = int(line)

    @staticmethod
    def _pipe(given: int | IO | None, number: int, stack: contextlib.ExitStack) -> tuple[IO | None, int]:
        """This end of a standard stream, if it is a pipe, and the program's."""
        if given == subprocess.PIPE:
            read, write = os.pipe()
            ours, theirs = (write, read) if number == 0 else (read, write)
            stack.callback(os.close, theirs)
            return open(ours, "w" if number == 0 else "r", buffering=1), theirs
        if given == subprocess.DEVNULL or (given is None and number == 0):
            nothing = os.open(os.devnull, os.O_RDWR)
            stack.callback(os.close, nothing)
            return None, nothing
        if given is None:
            return None, number
        return None, given if isinstance(given, int) else given.fileno()

    def poll(self) -> int | None:
        """The exit code (minus the number of the signal that ended it), or None while it runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self.wait(0.0)
        return None

    def wait(self, timeout: float | None = None) -> int:
        """The exit code. :raises subprocess.TimeoutExpired: if it runs longer than ``timeout`` [s]."""
        if self.returncode is None:
            with selectors.DefaultSelector() as events:
                events.register(self._status, selectors.EVENT_READ)
                if not events.select(timeout):
                    raise subprocess.TimeoutExpired(list(self.args), timeout or 0.0)
            line = self._said.readline()
            self.returncode = int(line) if line else -signal.SIGKILL
            self._said.close()
            self._status.close()
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal, unless the program has ended."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def communicate(self, input: str | None = None, timeout: float | None = None) -> tuple[str | None, str | None]:
        """All output that was not read yet, after the end.

        :raises subprocess.TimeoutExpired: if it runs longer than ``timeout`` [s].
        """
        end = None if timeout is None else time.monotonic() + timeout
        if self.stdin is not None and not self.stdin.closed:
            with contextlib.suppress(BrokenPipeError):
                self.stdin.write(input or "")
                self.stdin.close()
        pipes = self.stdout, self.stderr
        texts: dict[IO, list[str]] = {pipe: [] for pipe in pipes if pipe is not None and not pipe.closed}
        readers = [
            threading.Thread(target=lambda p=pipe, t=texts[pipe]: t.append(p.read()), daemon=True) for pipe in texts
        ]
        for reader in readers:
            reader.start()
        for reader in readers:
            reader.join(None if end is None else max(end - time.monotonic(), 0.0))
            if reader.is_alive():
                raise subprocess.TimeoutExpired(list(self.args), timeout or 0.0)
        self.wait(None if end is None else max(end - time.monotonic(), 0.0))
        for pipe in texts:
            pipe.close()
        out, err = ("".join(texts.get(pipe, [])) if pipe is not None else None for pipe in pipes)
        return out, err

    def __enter__(self) -> Popen:
        return self

    def __exit__(self, *_: object) -> None:
        for pipe in (self.stdout, self.stderr, self.stdin):
            if pipe is not None:
                pipe.close()
        self.wait()


def run(
    command: Sequence[str],
    *,
    cwd: str | os.PathLike[str] | None = None,
    env: Mapping[str, str] | None = None,
    timeout: float | None = None,
    check: bool = False,
    input: str | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run a program to its end, with its output. It is killed after ``timeout`` [s].

    :raises subprocess.TimeoutExpired: if it runs longer than that.
    :raises subprocess.CalledProcessError: with ``check``, if its exit code is not 0.
    """
    stdin = subprocess.DEVNULL if input is None else subprocess.PIPE
    process = Popen(command, stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=cwd, env=env)
    try:
        out, err = process.communicate(input, timeout)
    except BaseException:
        process.kill()
        raise
    done = subprocess.CompletedProcess(list(command), process.wait(), out, err)
    if check:
        done.check_returncode()
    return done
