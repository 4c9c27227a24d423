"""A child process of the client that is started again when it fails, dies or hangs, and never ends the client's loop.

Threads of the client start it, send it messages and receive its messages, so that the loop never waits for it. The
shared memory is created again for every run of the process, so a process that dies while it holds a lock does no harm.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pathlib
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from typing import Any, Generic, NoReturn, Protocol, TypeVar

from vinesim.client.processes.spawned_process import CONTEXT, SpawnedProcess, spawn

log = logging.getLogger(__name__)

EXIT_TIMEOUT = 1.2
"""How long a process that failed may take to end [s]."""
CLOSE_TIMEOUT = 10.0
"""How long a process that was asked to end may take [s]: it completes its present picture, on a busy machine."""
STABLE_TIME = 10.0
"""A process that ran this long before it failed is started again at once [s]. After a shorter run there is a pause
first. A start takes two seconds of one core."""
STANDBY_DELAY = 2.0
"""Time for which a process must have been ready before another one is started to stand by [s]."""
HANG_TIMEOUT = 15
"""A process that was ready and then sends nothing for this long is taken to hang, and is started again [s]. A process
reports to the client five times a second, unless it renders a picture or writes files. Time in which it waits for a CPU
does not count: to start it again would only load a busy machine more."""
START_TIMEOUT = 300
"""A process that is not ready and sends nothing for this long is taken to hang [s]. A first run may compile kernels."""
HOLD_TIMEOUT = 3.0
"""A process that has done nothing for this long, though it had a CPU, no longer holds the loop [s]."""
IDLE_LOOK_PERIOD = 0.1
"""Time between two checks whether a process that holds the loop is idle [s]."""
LONGEST_PAUSE = 60.0
"""Longest pause before a process is started again [s]. Pauses double with every failure, up to this."""


class WorkerError(RuntimeError):
    """A process of the client could not start; the text says why."""

    exit_code = 3


def cpu_use(pid: int) -> tuple[float, bool]:
    """CPU time of a process [s], and whether any of its threads runs or waits for a CPU now. They are 0 and False if it
    has ended, and on systems without /proc."""
    try:
        place = pathlib.Path("/proc") / str(pid)
        # The name, in brackets, may hold blanks; behind it come state, ..., user time, system time (proc_pid_stat(5)).
        fields = (place / "stat").read_text().rpartition(")")[2].split()
        used = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        threads = [(task / "stat").read_text().rpartition(")")[2] for task in (place / "task").iterdir()]
    except OSError:
        return 0.0, False
    return used, any(thread.split()[0] == "R" for thread in threads)


class IdleTime:
    """How long a process has done nothing although it could [s]. Time in which it waits for a CPU does not count.

    The time between two calls of :meth:`look` counts as one second at most. So if a shell stops both processes for an
    hour, only one second counts.
    """

    def __init__(self, pid: int) -> None:
        self.seconds = 0.0
        self._pid = pid
        self._used = 0.0
        self._looked = time.monotonic()

    def end(self) -> None:
        """End the idle time, because the process has done something."""
        self.seconds = 0.0
        self._looked = time.monotonic()

    def look(self) -> float:
        """Add the idle time since the last call. Returns the sum [s]."""
        now = time.monotonic()
        passed = min(now - self._looked, 1.0)
        used, wants_cpu = cpu_use(self._pid)
        self.seconds += min(used - self._used, passed) if wants_cpu else passed
        self._used = used
        self._looked = now
        return self.seconds


def serve(title: str, pipe: Connection, work: Callable[[], None]) -> NoReturn:
    """Main function of a process: call ``work`` until it returns, fails, or the client's process has ended.

    ``title`` names the process in its log and in ``ps -o comm``: "sensor process".
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the client, which then stops this process
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    with contextlib.suppress(OSError):  # where there is no /proc, the process keeps Python's name
        pathlib.Path("/proc/self/comm").write_text(title)
    if hasattr(os, "SCHED_BATCH"):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    code = 0
    try:
        work()
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the client is gone
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
    """Tell the client that this process is ready, and give the client's loop precedence over it from now on.

    With its ``niceness`` and scheduling class it does not take the core from the loop that wakes it (docs/decisions/
    sensor-process.md). Until it is ready it has the niceness of the client, because the start is urgent.
    """
    if hasattr(os, "nice"):
        os.nice(niceness)
    if os.path.isdir("/proc/self/task"):  # Linux, where every thread has a niceness of its own
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(OSError):  # it may have ended by now
                os.setpriority(os.PRIO_PROCESS, int(thread), os.getpriority(os.PRIO_PROCESS, 0))
    pipe.send(("ready", None))


class Shared(Protocol):
    """Shared memory of the client and one run of the process."""

    def close(self) -> None: ...


S = TypeVar("S", bound=Shared)


class Run(Generic[S]):
    """One run of the process, from its start to its end."""

    def __init__(self, spawned: SpawnedProcess, target: Callable[..., None], config: Any, shared: S) -> None:
        self.shared = shared
        self.pipe = spawned.pipe
        self.process = spawned.process
        self.ready_since: float | None = None
        """Time at which the process was ready [s]."""
        spawned.run(target, config, shared)
        self._outgoing: queue.SimpleQueue[tuple[str, Any] | None] = queue.SimpleQueue()
        threading.Thread(target=self._send, name=f"to {spawned.process.name}", daemon=True).start()

    def send(self, kind: str, value: Any = None) -> None:
        """Send a message after the earlier ones. A thread packs and writes it."""
        self._outgoing.put((kind, value))

    def _send(self) -> None:
        with contextlib.suppress(OSError):
            while (message := self._outgoing.get()) is not None:
                self.pipe.send(message)

    def end(self) -> None:
        """Release the resources of a process that ends or should have ended. Only the supervising thread may wait for
        the process."""
        self._outgoing.put(None)
        self.process.join(EXIT_TIMEOUT)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.pipe.close()


class Hold:
    """A time in which one run of a process holds the client's steps."""

    def __init__(self, run: Run[Any], title: str, consequence: str, progress: Callable[[], object]) -> None:
        """The value of ``progress()`` changes whenever the process has done something. ``consequence``: text for the
        log about the effect if the process does nothing for :data:`HOLD_TIMEOUT`."""
        self.run = run
        self._title = title
        self._consequence = consequence
        self._progress = progress
        self._idle = IdleTime(run.process.pid or 0)
        self._seen = progress()
        self._next_look = 0.0
        self._is_logged = False

    def is_over(self) -> bool:
        """Whether the process has done nothing for :data:`HOLD_TIMEOUT`. The first such time is logged."""
        if (now := time.monotonic()) >= self._next_look:
            self._next_look = now + IDLE_LOOK_PERIOD
            if (progress := self._progress()) != self._seen:
                self._seen = progress
                self._idle.end()
            else:
                self._idle.look()
        if self._idle.seconds < HOLD_TIMEOUT:
            return False
        if not self._is_logged:
            self._is_logged = True
            log.warning(
                "%s has done nothing for %.0f s: until it goes on, %s", self._title, HOLD_TIMEOUT, self._consequence
            )
        return True


class WorkerProcess(Generic[S]):
    """Keeps one process running. ``title`` names it in messages: "the sensor process of picker".

    ``target(config, shared, pipe)`` runs in the process after the process has imported ``modules``. It sends
    ("ready", None) when it is ready, and ("failed", text) before it ends with an error. It ends at ("stop", None) or
    when the pipe is closed. While it is ready it sends some message at least every :data:`HANG_TIMEOUT`, otherwise it
    is killed and started again. ``share(context)`` creates the shared memory of one run. ``receive(kind, value)`` is
    called in a thread with all other messages, and with ("restarted", None) before the messages of a further run.

    With a ``rehearsal``, another process stands by while one is ready, and replaces it if it fails; see
    :class:`SpawnedProcess`.
    """

    def __init__(
        self,
        title: str,
        modules: Sequence[str],
        target: Callable[..., None],
        config: Any,
        share: Callable[[BaseContext], S],
        receive: Callable[[str, Any], None],
        *,
        rehearsal: str = "",
    ) -> None:
        self.title = title
        self.restarts = 0
        """How often the process was started again."""
        self.restart_time = 0.0
        """Time from the last restart of the process until it was ready [s]."""
        self._modules = modules
        self._target = target
        self._config = config
        self._share = share
        self._receive = receive
        self._rehearsal = rehearsal
        self._standby: SpawnedProcess | None = None
        self._standby_due = 0.0
        """Earliest time at which another process may be started to stand by [s]."""
        self._closing = threading.Event()
        self._started = 0.0
        """When the newest run started [s]."""
        self._first_result = threading.Event()
        self._failure = ""
        """Why the first run failed before it was ready."""
        self._newest = self._current = self._start()
        self._thread = threading.Thread(target=self._supervise, name=f"supervisor of {title}", daemon=True)
        self._thread.start()

    # ------------------------------------------------------------------ for the loop

    def current(self) -> Run[S]:
        """The present run. Call it in one thread only, because it releases the memory of the run before."""
        if self._newest is not self._current:
            former = self._current
            self._current = self._newest
            former.shared.close()
        return self._current

    @property
    def pid(self) -> int | None:
        """Process id of the newest run."""
        return self._newest.process.pid

    @property
    def standby_pid(self) -> int | None:
        """Process id of the process that stands by; None if there is none."""
        standby = self._standby
        return standby.process.pid if standby is not None and standby.stands_by else None

    @property
    def is_ready(self) -> bool:
        """Whether the process is ready now."""
        return self._newest.ready_since is not None

    # ------------------------------------------------------------------ outside the loop

    def wait_until_ready(self, timeout: float) -> None:
        """Wait until the first run is ready. Raises :class:`WorkerError` if it fails, or after ``timeout`` [s]."""
        if not self._first_result.wait(timeout):
            raise WorkerError(f"{self.title} was not ready within {timeout:.0f} s")
        self.raise_failure()

    def raise_failure(self) -> None:
        """Raise :class:`WorkerError` if the first run failed before it was ready. The process is not started again
        then. This method does not wait."""
        if self._failure:
            raise WorkerError(f"{self.title} failed: {self._failure}")

    def send(self, kind: str, value: Any = None) -> None:
        """Send a message to the newest run."""
        self._newest.send(kind, value)

    def close(self) -> None:
        """End the process; a second call does nothing."""
        if self._closing.is_set():
            return
        was_ready = self.is_ready
        self._closing.set()
        self._newest.send("stop")
        self._thread.join(CLOSE_TIMEOUT if was_ready else 0.0)
        if self._thread.is_alive() and was_ready:
            log.warning("%s did not end by itself", self.title)
        while self._thread.is_alive():
            self._newest.process.kill()
            self._thread.join(0.05)
        self._current.shared.close()
        self._newest.shared.close()

    # ------------------------------------------------------------------ the supervising thread

    def _start(self) -> Run[S]:
        """Start a run, in the process that stands by or in a new one."""
        shared = self._share(CONTEXT)
        standby = self._standby
        self._standby = None
        if standby is not None:
            standby.look()
            if standby.stands_by:
                with contextlib.suppress(OSError):  # it has ended just now
                    return Run(standby, self._target, self._config, shared)
            standby.end()
        return Run(spawn(self.title, self._modules), self._target, self._config, shared)

    def _keep_standby(self, run: Run[S]) -> None:
        """Start a process that stands by when it is due, and again if it has ended."""
        if not self._rehearsal or run.ready_since is None:
            return
        now = time.monotonic()
        if self._standby is not None and not self._standby.look():
            self._standby.end()
            self._standby, self._standby_due = None, now + LONGEST_PAUSE
        if self._standby is None and now > max(run.ready_since + STANDBY_DELAY, self._standby_due):
            self._standby = SpawnedProcess(self.title, self._modules, self._rehearsal)

    def _supervise(self) -> None:
        try:
            self._keep_running()
        finally:
            if self._standby is not None:
                self._standby.end()

    def _keep_running(self) -> None:
        failures = 0
        while True:
            run = self._newest
            reason = self._serve(run)
            was_ready = run.ready_since
            run.ready_since = None
            run.end()
            if self._closing.is_set():
                return
            if not self._first_result.is_set():
                self._failure = reason
                self._first_result.set()
                return
            is_stable = was_ready is not None and time.monotonic() - was_ready > STABLE_TIME
            failures = 1 if is_stable else failures + 1
            pause = min(2.0 ** (failures - 2), LONGEST_PAUSE) if failures > 1 else 0.0
            self._log_failure(failures, reason)
            if self._closing.wait(pause):
                return
            self.restarts += 1
            self._receive("restarted", None)
            self._started = time.monotonic()
            self._newest = self._start()

    def _log_failure(self, failures: int, reason: str) -> None:
        if failures == 1:
            log.warning("%s failed: %s; starting it again", self.title, reason)
        elif failures == 2:
            log.error("%s failed again: %s; further attempts follow without a message", self.title, reason)

    def _serve(self, run: Run[S]) -> str:
        """Take the messages of a run until it ends or hangs. Returns the reason."""
        reason = ""
        silence = IdleTime(run.process.pid or 0)
        while silence.seconds < (START_TIMEOUT if run.ready_since is None else HANG_TIMEOUT):
            self._keep_standby(run)
            if connection.wait([run.pipe, run.process.sentinel], 1.0):
                silence.end()
            else:
                silence.look()
            try:
                while run.pipe.poll():
                    kind, value = run.pipe.recv()
                    if kind == "ready":
                        run.ready_since = time.monotonic()
                        if self._first_result.is_set():
                            self.restart_time = run.ready_since - self._started
                        self._first_result.set()
                    elif kind == "failed":
                        reason = value
                    else:
                        self._receive(kind, value)
            except (EOFError, OSError):
                run.process.join(EXIT_TIMEOUT)
                return reason or f"it ended with exit code {run.process.exitcode}"
            if not run.process.is_alive():
                return reason or f"it ended with exit code {run.process.exitcode}"
        run.process.kill()
        return reason or f"it hung: nothing came from it for {silence.seconds:.0f} s"
