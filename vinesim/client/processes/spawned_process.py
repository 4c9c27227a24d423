"""A child process that starts before its function is known: it imports its modules, then receives the function.

Imports take most of the time in which a process starts. The command line starts the sensor process while it still
imports the modules of the client itself (:func:`start_early`), so this module imports nothing large. A process may also
stand by, with all modules imported, until another one fails.
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

from vinesim.core import allocator

ROS_MODULES = ("vinesim.client.processes.ros_worker", "vinesim.ros.robot_node", "vinesim.ros.simulation_node")
"""Modules that a ROS process imports."""
SENSOR_REHEARSAL = "vinesim.client.processes.sensor_rehearsal"
"""Module whose function ``rehearse`` a sensor process calls before it stands by."""
STANDBY_NICENESS = 5
"""Difference between the niceness of a process and that of its parent, until the process stands by."""
CONTEXT = multiprocessing.get_context("spawn")
_started_early: dict[tuple[str, ...], SpawnedProcess] = {}
"""Processes that :func:`spawn` has not returned yet, by their modules."""


def _import_and_run(modules: Sequence[str], pipe: Connection, rehearsal: str) -> None:
    """Main function of the process. It returns if the parent ends before it has sent a function."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent
    allocator.keep_large_blocks_apart()
    allocator.trim_regularly()
    if rehearsal:
        with contextlib.suppress(OSError), open("/proc/self/comm", "w") as file:  # its name in ps
            file.write("standby process")
        # Linux has a niceness of each thread, and the process could not lower its own again
        thread = threading.Thread(target=_rehearse, args=(modules, rehearsal))
        thread.start()
        thread.join()
        pipe.send("standing by")
    else:
        _import(modules)
    with contextlib.suppress(EOFError):
        function, arguments = pipe.recv()
        function(*arguments, pipe)


def _import(modules: Sequence[str]) -> None:
    gc.disable()  # collection takes a fifth of the time of imports, and imported objects stay anyway
    for name in modules:
        with contextlib.suppress(ImportError):  # reported where it is needed
            importlib.import_module(name)
    gc.freeze()
    gc.enable()


def _rehearse(modules: Sequence[str], rehearsal: str) -> None:
    if os.path.isdir("/proc/self/task"):
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + STANDBY_NICENESS)
    _import(modules)
    importlib.import_module(rehearsal).rehearse()


class SpawnedProcess:
    """A daemon process that has imported ``modules``, or is about to, and a pipe to it."""

    def __init__(self, title: str, modules: Sequence[str], rehearsal: str = "") -> None:
        """``rehearsal``: name of a module. If it is given, the process stands by: it imports ``modules`` and calls the
        function ``rehearse`` of that module, in a thread of higher niceness than this process, and then reports."""
        self.pipe, end = CONTEXT.Pipe()
        """The parent's end of the pipe."""
        self.stands_by = False
        """Whether the process ran and had rehearsed at the last :meth:`look`."""
        self.process = CONTEXT.Process(
            target=_import_and_run, args=(tuple(modules), end, rehearsal), name=title, daemon=True
        )
        self.process.start()
        end.close()

    def look(self) -> bool:
        """Update :attr:`stands_by`. Returns whether the process runs. Call it from one thread, before :meth:`run`."""
        runs = self.process.is_alive()
        with contextlib.suppress(EOFError, OSError):
            self.stands_by = runs and (self.stands_by or (self.pipe.poll() and self.pipe.recv() == "standing by"))
        return runs

    def end(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()

    def run(self, function: Callable[..., None], *arguments: Any) -> None:
        """Let the process call ``function(*arguments, pipe)`` with its end of the pipe.

        Locks and semaphores of :data:`CONTEXT` may be among the arguments.
        """
        # multiprocessing pickles its locks only while it spawns a process, so the process that it spawned is set here
        multiprocessing.context.set_spawning_popen(self.process._popen)  # type: ignore[attr-defined]
        try:
            message = ForkingPickler.dumps((function, arguments))
        finally:
            multiprocessing.context.set_spawning_popen(None)
        self.pipe.send_bytes(message)


def sensor_modules(ros: bool) -> tuple[str, ...]:
    """Modules that a sensor process imports, with a ROS node or without."""
    usual = ("vinesim.sensors.camera.camera", "vinesim.sensors.lidar.lidar")
    modules = ("vinesim.client.processes.sensor_worker", "vinesim.sensors.scheduler", *usual)
    if not ros:
        return modules
    return (*modules, "vinesim.ros.sensor_node", "vinesim.ros.publishers.camera", "vinesim.ros.publishers.lidar")


def start_early(title: str, modules: Sequence[str]) -> None:
    """Start a process that :func:`spawn` will return for the same modules."""
    _started_early[tuple(modules)] = SpawnedProcess(title, modules)


def spawn(title: str, modules: Sequence[str]) -> SpawnedProcess:
    """A process that imports ``modules``: the one that was started early, or a new one."""
    return _started_early.pop(tuple(modules), None) or SpawnedProcess(title, modules)
