"""A child process that starts before it is known what it shall do: it imports its modules, then receives its function.

Imports take most of the time in which a process starts. The command line starts the sensor process while it still
imports what the client itself needs (:func:`start_early`); so this module imports nothing large. A process may also
stand by, having imported all, until another one fails.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import multiprocessing
import multiprocessing.context
import os
import signal
import threading
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any

from vinesim import allocator

ROS_MODULES = ("vinesim.client.sensing.ros_worker", "vinesim.ros.robot_node")
"""What a ROS process needs."""
CONTEXT = multiprocessing.get_context("spawn")
_started_early: dict[tuple[str, ...], SpawnedProcess] = {}
"""Processes that :func:`spawn` has not returned yet, by their modules."""


def _import_and_run(modules: Sequence[str], pipe: Connection, niceness: int) -> None:
    """The life of the process; it ends if the parent ends before it has sent a function."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    allocator.keep_large_blocks_apart()
    if niceness and os.path.isdir("/proc/self/task"):  # Linux, where every thread has a niceness of its own
        with contextlib.suppress(OSError), open("/proc/self/comm", "w") as file:  # its name in ps
            file.write("standby process")
        # the process could not lower its niceness again
        thread = threading.Thread(target=_import, args=(modules, niceness))
        thread.start()
        thread.join()
        pipe.send("imported")
    else:
        _import(modules)
    with contextlib.suppress(EOFError):
        function, arguments = pipe.recv()
        function(*arguments, pipe)


def _import(modules: Sequence[str], niceness: int = 0) -> None:
    if niceness:
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + niceness)
    gc.disable()  # a fifth of the time, and all that is imported stays
    for name in modules:
        with contextlib.suppress(ImportError):  # reported where it is needed
            importlib.import_module(name)
    gc.freeze()
    gc.enable()


class SpawnedProcess:
    """A daemon process that has imported ``modules``, or is about to, and a pipe to it."""

    def __init__(self, title: str, modules: Sequence[str], niceness: int = 0) -> None:
        """With a ``niceness`` it imports nicer than this process by so much, says when it has, and runs like this
        one."""
        self.pipe, end = CONTEXT.Pipe()
        """This end of the pipe."""
        self.process = CONTEXT.Process(target=_import_and_run, args=(tuple(modules), end, niceness), name=title, daemon=True)
        self.process.start()
        end.close()

    def has_imported(self) -> bool:
        """Whether a process with a niceness runs and has imported all; after True call :meth:`run`, or :meth:`end`."""
        with contextlib.suppress(EOFError, OSError):
            return self.process.is_alive() and self.pipe.poll() and self.pipe.recv() == "imported"
        return False

    def end(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()

    def run(self, function: Callable[..., None], *arguments: Any) -> None:
        """Let the process call ``function(*arguments, pipe)`` with its end of the pipe.

        Locks and semaphores of :data:`CONTEXT` may be among the arguments.
        """
        # multiprocessing refuses to pickle its locks unless it is spawning a process: this one is one that it spawned
        multiprocessing.context.set_spawning_popen(self.process._popen)  # type: ignore[attr-defined]
        try:
            message = ForkingPickler.dumps((function, arguments))
        finally:
            multiprocessing.context.set_spawning_popen(None)
        self.pipe.send_bytes(message)


def sensor_modules(ros: bool) -> tuple[str, ...]:
    """What a sensor process needs, with a ROS node or without."""
    modules = ("vinesim.client.sensing.sensor_worker", "vinesim.sensors.scheduler")
    return (*modules, "vinesim.ros.sensor_node") if ros else modules


def start_early(title: str, modules: Sequence[str]) -> None:
    """Start a process that :func:`spawn` will return for the same modules."""
    _started_early[tuple(modules)] = SpawnedProcess(title, modules)


def spawn(title: str, modules: Sequence[str]) -> SpawnedProcess:
    """A process that imports ``modules``: the one that was started early, or a new one."""
    return _started_early.pop(tuple(modules), None) or SpawnedProcess(title, modules)
