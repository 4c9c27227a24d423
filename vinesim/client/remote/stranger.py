"""Loads the robot of a stranger in a process of its own, with a limit of CPU time, of time and of memory.

A URDF from the network is counted first (:mod:`vinesim.scene.robot_limits`) and loads in a fraction of a second.
Whatever a URDF within these limits may still do to the parser, it does to a process that ends.
"""

from __future__ import annotations

import math
import pickle
import resource
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from vinesim.net.codec.control import Hello
from vinesim.net.codec.header import is_valid_name
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.sidecar import decode_sidecar
from vinesim.robot.description.urdf import DescriptionError

CPU_TIME = 20
"""CPU time that the process may use [s]. The largest robot that is allowed takes 1 s, imports included."""

TIMEOUT = 60.0
"""Time after which the process is killed [s], for a process that waits."""

PROCESSES = 2
"""Number of processes at a time, so that a slow robot does not hold up the next one."""

MEMORY = 4 << 30
"""Address space that the process may use [B]."""


class StrangerLoader(ThreadPoolExecutor):
    """Threads that each wait for a process that loads the robot of a stranger. A context manager: at its end the
    processes are killed."""

    def __init__(self, *, cpu_time: float = CPU_TIME, timeout: float = TIMEOUT) -> None:
        """``cpu_time`` [s], ``timeout`` [s]: limits of a process, see :data:`CPU_TIME` and :data:`TIMEOUT`."""
        super().__init__(PROCESSES, "strangers' robots")
        self._limits = math.ceil(cpu_time), timeout
        self._running: set[subprocess.Popen[bytes]] = set()
        self._closed = False

    def load(self, hello: Hello) -> RobotDescription:
        """Returns the description of a stranger's robot, with boxes for its meshes. Raises :class:`DescriptionError` if
        it cannot be loaded, or not in time."""
        cpu_time, timeout = self._limits
        start = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; main({cpu_time})"
        with subprocess.Popen(
            [sys.executable, "-c", start], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        ) as process:
            self._running.add(process)
            if self._closed:
                process.kill()
            try:
                found, errors = process.communicate(pickle.dumps(hello), timeout)
            except subprocess.TimeoutExpired:
                raise DescriptionError(f"its URDF was not loaded within {timeout:g} s") from None
            finally:
                process.kill()
                self._running.discard(process)
        if process.returncode != 0:
            why = (
                f"it takes more than {cpu_time} s or too much memory" if process.returncode < 0 else _last_line(errors)
            )
            raise DescriptionError(f"its URDF was not loaded: {why}")
        result: RobotDescription | str = pickle.loads(found)
        if isinstance(result, str):
            raise DescriptionError(result)
        return result

    def __exit__(self, *_: object) -> None:
        self._closed = True
        self.shutdown(wait=False, cancel_futures=True)
        for process in list(self._running):
            process.kill()
        self.shutdown()


def load_sent(hello: Hello, received: Mapping[str, np.ndarray] | None = None) -> RobotDescription:
    """Load the URDF of a stranger's robot in this process. ``received``: see :func:`load_description`."""
    name = hello.robot if is_valid_name(hello.robot) else "robot"  # untrusted input that becomes a file name
    sidecar = decode_sidecar(hello.sidecar)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.urdf"
        file.write_text(hello.urdf, "utf-8")
        return load_description(file, is_remote=True, sidecar=sidecar, received=received)


def main(cpu_time: int) -> None:
    """Body of the process: read a hello, write the description or the reason why there is none. ``cpu_time`` [s]: CPU
    time after which the process is killed."""
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_time, hard))
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, hard))
    hello: Hello = pickle.loads(sys.stdin.buffer.read())
    try:
        result: RobotDescription | str = load_sent(hello)
    except (ValueError, OSError, RecursionError, MemoryError) as error:
        result = str(error) or type(error).__name__
    sys.stdout.buffer.write(pickle.dumps(result))


def _last_line(text: bytes) -> str:
    lines = text.decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else "its process ended"
