"""Starts Python programs of tests by fork of a process that has imported most of vinesim: the imports of a command
cost 1 to 2 s, its fork 0.05 s.

The server has one thread, so a fork of it is safe. It imports, and starts nothing. What a program finds in the
environment when it imports is that of the server: tests of imports and of compilation start real processes.
"""

from __future__ import annotations

import array
import contextlib
import gc
import importlib
import json
import os
import runpy
import selectors
import signal
import socket
import sys
import types

PRELOADED = (
    "vinesim.cli.server",
    "vinesim.cli.robot_client",
    "vinesim.cli.human_client",
    "vinesim.cli.spectator_client",
    "vinesim.cli.record",
    "vinesim.cli.replay",
    "vinesim.cli.render",
    "vinesim.cli.dataset",
    "vinesim.cli.scene",
    "vinesim.cli.tune",
    "vinesim.cli.certs",
    "vinesim.cli.doctor.command",
    "vinesim.cli.bench",
    "vinesim.api.simulation",
    "vinesim.api.client",
    "vinesim.api.sensors",
    "vinesim.tune",
    "matplotlib.pyplot",
    "scipy.optimize",
)
MAX_REQUEST = 1 << 20
"""Longest request [bytes]."""


def serve(control: socket.socket) -> None:
    """Start a program for every request, and say how each ended, until the tests close their end of ``control``."""
    for module in PRELOADED:
        importlib.import_module(module)
    gc.freeze()  # what is shared is neither looked through nor copied by the collector of a program
    assert len(os.listdir("/proc/self/task")) == 1, "a module that is imported here has started a thread"
    events = selectors.DefaultSelector()
    events.register(control, selectors.EVENT_READ)
    running: dict[int, tuple[int, socket.socket]] = {}
    """Process id, and the socket to those who wait for its end, by the process's descriptor."""
    while True:
        for key, _ in events.select():
            if key.fileobj is not control:
                pid, status = running.pop(key.fd)
                events.unregister(key.fd)
                os.close(key.fd)
                code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                with status, contextlib.suppress(OSError):  # nobody may wait for it any more
                    status.sendall(f"{code}\n".encode())
                continue
            text, ancillary, _, _ = control.recvmsg(MAX_REQUEST, socket.CMSG_SPACE(4 * 4))
            if not text:
                for pid, _ in running.values():
                    os.kill(pid, signal.SIGKILL)
                return
            files = array.array("i")
            files.frombytes(ancillary[0][2])
            pid = os.fork()
            if pid == 0:
                for _, status in running.values():
                    status.close()
                control.close()
                events.close()
                _become(json.loads(text), *files)
                return
            for file in files[:3]:
                os.close(file)
            status = socket.socket(fileno=files[3])
            with contextlib.suppress(OSError):
                status.sendall(f"{pid}\n".encode())
            descriptor = os.pidfd_open(pid)
            running[descriptor] = pid, status
            events.register(descriptor, selectors.EVENT_READ)


def _become(request: dict, stdin: int, stdout: int, stderr: int, status: int) -> None:
    """In the new process: run a program as ``python`` does with these arguments, folder, environment and files."""
    os.close(status)
    for target, file in enumerate((stdin, stdout, stderr)):
        os.dup2(file, target)
        os.close(file)
    sys.stdin = open(0)  # noqa: SIM115
    sys.stdout = open(1, "w")  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace")  # noqa: SIM115
    sys.__stdin__ = sys.stdin
    sys.__stdout__ = sys.stdout
    sys.__stderr__ = sys.stderr
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    how, *arguments = request["arguments"]
    if how == "-m":
        sys.path[0] = os.getcwd()
        sys.argv = arguments
        runpy.run_module(arguments[0], run_name="__main__", alter_sys=True)
    elif how == "-c":
        sys.path[0] = ""
        sys.argv = ["-c", *arguments[1:]]
        main = sys.modules["__main__"] = types.ModuleType("__main__")
        exec(compile(arguments[0], "<string>", "exec"), main.__dict__)
    else:
        sys.path[0] = os.path.dirname(os.path.abspath(how))
        sys.argv = [how, *arguments]
        runpy.run_path(how, run_name="__main__")


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
