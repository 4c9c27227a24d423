"""The part of a worker process that runs in the process: it imports modules, receives its function, works and reports.

:mod:`vinesim.client.processes.worker_process` is the client's part. A process imports this module first, so this
module imports nothing large.
"""

from __future__ import annotations

import abc
import contextlib
import gc
import importlib
import logging
import os
import pathlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any, NoReturn, Protocol

from vinesim.core import allocator

log = logging.getLogger(__name__)

STANDBY_NICENESS = 5
"""Difference between the niceness of a process and that of its parent, while the process prepares to stand by."""
SWITCH_INTERVAL = 5e-4
"""Python's switch interval: time after which one thread of a worker yields to another thread [s]. Python's default is
half a step."""
STATISTICS_PERIOD = 0.2
"""Wall time between two reports of counts to the client [s]."""
POLL_PERIOD = 0.02
"""Longest time between two checks for messages of the client and of ROS [s]."""

STANDING_BY = "standing by"
"""Message of a process that has imported its modules and rehearsed."""


def import_and_run(modules: Sequence[str], pipe: Connection, rehearsal: str) -> None:
    """Import ``modules``, receive a function, and run it. This is the main function of every process.

    It returns if the parent ends before it has sent a function. ``rehearsal``: see
    :class:`~vinesim.client.processes.worker_process.SpawnedProcess`.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the client, which then stops its processes
    allocator.keep_large_blocks_apart()
    allocator.trim_regularly()
    if rehearsal:
        _set_title("standby process")
        # Linux has a niceness of each thread, and the process could not lower its own again
        thread = threading.Thread(target=_rehearse, args=(modules, rehearsal))
        thread.start()
        thread.join()
        pipe.send(STANDING_BY)
    else:
        _import(modules)
    with contextlib.suppress(EOFError):
        function, arguments = pipe.recv()
        function(*arguments, pipe)


def _set_title(title: str) -> None:
    """Set the name of this process in ``ps -o comm``."""
    with contextlib.suppress(OSError):  # without /proc, the process keeps Python's name
        pathlib.Path("/proc/self/comm").write_text(title)


def _import(modules: Sequence[str]) -> None:
    gc.disable()  # collection takes a fifth of the time of imports, and imported objects stay anyway
    for name in modules:
        with contextlib.suppress(ImportError):  # the code that needs the module reports the error
            importlib.import_module(name)
    gc.freeze()
    gc.enable()


def _rehearse(modules: Sequence[str], rehearsal: str) -> None:
    if os.path.isdir("/proc/self/task"):
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + STANDBY_NICENESS)
    _import(modules)
    importlib.import_module(rehearsal).rehearse()


def serve(title: str, pipe: Connection, work: Callable[[], None]) -> NoReturn:
    """Call ``work`` until it returns, fails, or the client's process has ended. Then end this process.

    If ``work`` fails, the client receives ("failed", text). ``title`` names the process in its log and in
    ``ps -o comm``: "sensor process".
    """
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.setswitchinterval(SWITCH_INTERVAL)
    _set_title(title)
    if hasattr(os, "SCHED_BATCH"):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    code = 0
    try:
        work()
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the client's process has ended
    except Exception as error:
        log.exception("the %s failed", title)
        with contextlib.suppress(OSError):
            pipe.send(("failed", f"{type(error).__name__}: {error}"))
        code = 1
    # All is closed. An orderly shutdown of the interpreter would only delay the client, which waits.
    logging.shutdown()
    sys.stdout.flush()
    os._exit(code)


def report_ready(pipe: Connection, niceness: int) -> None:
    """Send "ready" to the client, after adding ``niceness`` to the niceness of this process and all its threads.

    With its niceness and scheduling class the process does not take the core from the client's loop that wakes it
    (docs/decisions/sensor-process.md). Until it is ready it has the niceness of the client, because the start is
    urgent.
    """
    if hasattr(os, "nice"):
        os.nice(niceness)
    if os.path.isdir("/proc/self/task"):  # Linux, where every thread has a niceness of its own
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(OSError):  # the thread may have ended by now
                os.setpriority(os.PRIO_PROCESS, int(thread), os.getpriority(os.PRIO_PROCESS, 0))
    pipe.send(("ready", None))


class NodeWithParameters(Protocol):
    """A ROS node whose parameters can be set."""

    @property
    def set_parameters(self) -> dict[str, Any]:
        """Values of the parameters that were ever set, by name. It is a new object after each change."""
        ...


class Worker(abc.ABC):
    """The work of one process: a loop that takes messages of the client, works and reports to the client.

    A subclass has the loop, and overrides :meth:`_take` and :meth:`_statistics`.
    """

    def __init__(self, pipe: Connection) -> None:
        self.pipe = pipe
        """The process's end of the pipe to the client."""
        self._watched_node: NodeWithParameters | None = None
        self._reported_parameters: dict[str, Any] = {}
        self._next_statistics = 0.0

    @abc.abstractmethod
    def _take(self, kind: str, value: Any) -> None:
        """Handle a message from the client. Called for every message except "stop"."""

    @abc.abstractmethod
    def _statistics(self) -> dict[str, dict[str, int]]:
        """Returns the counts of this run: kind of count -> sensor or topic -> number."""

    def _take_messages(self) -> bool:
        """Take the messages that the client has sent. Returns False after a "stop"."""
        while self.pipe.poll():
            kind, value = self.pipe.recv()
            if kind == "stop":
                return False
            self._take(kind, value)
        return True

    def _watch_parameters(self, node: NodeWithParameters) -> None:
        """Report the parameters of ``node`` whenever one is set after this call."""
        self._watched_node = node
        self._reported_parameters = node.set_parameters

    def _report(self) -> None:
        """Send the client the parameters that were set, and the counts every :data:`STATISTICS_PERIOD`."""
        node = self._watched_node
        if node is not None and (parameters := node.set_parameters) is not self._reported_parameters:
            self._reported_parameters = parameters
            self.pipe.send(("parameters", parameters))
        if time.monotonic() >= self._next_statistics:
            self._next_statistics = time.monotonic() + STATISTICS_PERIOD
            self._send_statistics()

    def _send_statistics(self) -> None:
        self.pipe.send(("statistics", self._statistics()))
