"""The client's part of a worker process: it starts the process, supervises it, and starts it again when it fails.

Threads of the client start the process, send it messages and receive its messages, so that the loop never waits for
it. :mod:`vinesim.client.processes.worker` is the part that runs in the process. The command line imports this module
before all others, to start a process early (:func:`start_early`), so this module imports nothing large.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import multiprocessing.context
import os
import pathlib
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from multiprocessing import connection
from multiprocessing.context import BaseContext
from multiprocessing.reduction import ForkingPickler
from typing import Any, Generic, Protocol, TypeVar

from vinesim.client.processes.worker import STANDING_BY, import_and_run

log = logging.getLogger(__name__)

ROS_MODULES = ("vinesim.client.processes.ros_worker", "vinesim.ros.robot_node", "vinesim.ros.simulation_node")
"""Modules that a ROS process imports."""
SENSOR_WORKER = "vinesim.client.processes.sensor_worker"
"""Module of the sensor process. Its function ``rehearse`` prepares a sensor process that stands by."""

EXIT_TIMEOUT = 1.2
"""Longest time in which a process that failed ends by itself [s]."""
CLOSE_TIMEOUT = 10.0
"""Longest time in which a process that was asked to end ends by itself [s]. It completes its present picture first, on
a busy machine."""
STABLE_TIME = 10.0
"""A process that was ready for this long before it failed is started again at once [s]. After a shorter time there is a
pause first. A start takes two seconds of one core."""
STANDBY_DELAY = 2.0
"""Time for which a process must have been ready before another process is started to stand by [s]."""
HANG_TIMEOUT = 15
"""A process that was ready and then sends nothing for this long hangs, and is started again [s]. A process reports to
the client five times a second, unless it renders a picture or writes files. Time in which it waits for a CPU does not
count, because another start would only load a busy machine more."""
START_TIMEOUT = 300
"""A process that is not ready and sends nothing for this long hangs [s]. A first run may compile kernels."""
HOLD_TIMEOUT = 3.0
"""A process that has done nothing for this long, though it had a CPU, no longer holds the loop [s]."""
IDLE_LOOK_PERIOD = 0.1
"""Time between two checks whether a process that holds the loop is idle [s]."""
LONGEST_PAUSE = 60.0
"""Longest pause before a process is started again [s]. Pauses double with every failure, up to this."""

CONTEXT = multiprocessing.get_context("spawn")
Counts = Mapping[str, Mapping[str, int]]
"""Counts of messages, frames and losses: kind of count -> sensor or topic -> number."""


class SpawnedProcess:
    """A daemon process that imports its modules and then waits for its function, and a pipe to the process.

    Imports take most of the time in which a process starts. So a process can start before its function is known, or
    stand by until another process fails.
    """

    def __init__(self, title: str, modules: Sequence[str], rehearsal: str = "") -> None:
        """``modules``: names of the modules that the process imports. ``rehearsal``: name of a module with a function
        ``rehearse``. If it is given, the process stands by: it imports ``modules``, calls ``rehearse()``, both in a
        thread of higher niceness than this process, and then reports."""
        self.pipe, end = CONTEXT.Pipe()
        """The parent's end of the pipe."""
        self.stands_by = False
        """Whether the process ran and had rehearsed when :meth:`look` was called last."""
        self.process = CONTEXT.Process(
            target=import_and_run, args=(tuple(modules), end, rehearsal), name=title, daemon=True
        )
        self.process.start()
        end.close()

    def look(self) -> bool:
        """Update :attr:`stands_by`. Returns whether the process runs. Call it from one thread, before :meth:`run`."""
        runs = self.process.is_alive()
        with contextlib.suppress(EOFError, OSError):
            self.stands_by = runs and (self.stands_by or (self.pipe.poll() and self.pipe.recv() == STANDING_BY))
        return runs

    def end(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.pipe.close()

    def run(self, function: Callable[..., None], *arguments: Any) -> None:
        """Make the process call ``function(*arguments, pipe)``, where ``pipe`` is the process's end of the pipe.

        Locks and semaphores of :data:`CONTEXT` may be among the arguments.
        """
        # multiprocessing pickles its locks only while it spawns a process, so the process that it spawned is set here
        multiprocessing.context.set_spawning_popen(self.process._popen)  # type: ignore[attr-defined]
        try:
            message = ForkingPickler.dumps((function, arguments))
        finally:
            multiprocessing.context.set_spawning_popen(None)
        self.pipe.send_bytes(message)


_started_early: dict[tuple[str, ...], SpawnedProcess] = {}
"""Processes that :func:`spawn` has not returned yet, by their modules."""


def sensor_modules(ros: bool) -> tuple[str, ...]:
    """Returns the modules that a sensor process imports, with a ROS node or without."""
    sensors = ("vinesim.sensors.scheduler", "vinesim.sensors.camera.camera", "vinesim.sensors.lidar.lidar")
    node = ("vinesim.ros.sensor_node", "vinesim.ros.publishers.camera", "vinesim.ros.publishers.lidar")
    return (SENSOR_WORKER, *sensors, *(node if ros else ()))


def start_early(title: str, modules: Sequence[str]) -> None:
    """Start a process that :func:`spawn` will return for the same modules.

    The process imports its modules while this program still imports its own.
    """
    _started_early[tuple(modules)] = SpawnedProcess(title, modules)


def spawn(title: str, modules: Sequence[str]) -> SpawnedProcess:
    """Returns a process that imports ``modules``: the one that was started early, or a new one."""
    return _started_early.pop(tuple(modules), None) or SpawnedProcess(title, modules)


class WorkerError(RuntimeError):
    """A process of the client could not start. The text is the reason."""

    exit_code = 3


def cpu_use(pid: int) -> tuple[float, bool]:
    """Returns the CPU time of a process [s], and whether any of its threads runs or waits for a CPU now.

    The values are 0 and False if the process has ended, and on systems without /proc.
    """
    try:
        place = pathlib.Path("/proc") / str(pid)
        # The name, in brackets, may contain blanks. Then come state, ..., user time, system time (proc_pid_stat(5)).
        fields = (place / "stat").read_text().rpartition(")")[2].split()
        used = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        threads = [(task / "stat").read_text().rpartition(")")[2] for task in (place / "task").iterdir()]
    except OSError:
        return 0.0, False
    return used, any(thread.split()[0] == "R" for thread in threads)


class IdleTime:
    """Time for which a process has done nothing although it could. Time in which it waits for a CPU does not count.

    The time between two calls of :meth:`look` counts as one second at most. So if a shell stops the client and the
    process for an hour, only one second counts.
    """

    def __init__(self, pid: int) -> None:
        self.seconds = 0.0
        """Idle time so far [s]."""
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


class Shared(Protocol):
    """Memory that the client and one run of the process share."""

    def close(self) -> None:
        """Release the memory."""
        ...


S = TypeVar("S", bound=Shared)


class Run(Generic[S]):
    """One run of a process, from the call of its function to its end.

    Each run has shared memory and locks of its own, so a process that dies while it holds a lock does no harm.
    """

    def __init__(self, spawned: SpawnedProcess, target: Callable[..., None], config: Any, shared: S) -> None:
        self.shared = shared
        self.pipe = spawned.pipe
        self.process = spawned.process
        self.ready_since: float | None = None
        """Time at which the process became ready [s]. None before, and after its end."""
        spawned.run(target, config, shared)
        self._outgoing: queue.SimpleQueue[tuple[str, Any] | None] = queue.SimpleQueue()
        threading.Thread(target=self._send, name=f"to {spawned.process.name}", daemon=True).start()

    def send(self, kind: str, value: Any = None) -> None:
        """Send a message to the process. A thread packs and writes the messages in order, so this method does not
        wait."""
        self._outgoing.put((kind, value))

    def _send(self) -> None:
        with contextlib.suppress(OSError):
            while (message := self._outgoing.get()) is not None:
                self.pipe.send(message)

    def end(self) -> None:
        """Wait for the end of the process, or kill it, and close the pipe.

        The shared memory stays, because the loop may use it. Call this method in the supervising thread only, because
        no other thread may wait for the process.
        """
        self._outgoing.put(None)
        self.process.join(EXIT_TIMEOUT)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.pipe.close()


class Hold:
    """Limit on the time for which the client's loop waits for a process: until the process has done nothing for
    :data:`HOLD_TIMEOUT`."""

    def __init__(self, title: str, consequence: str, progress: Callable[[Run[Any]], object]) -> None:
        """``title``: see :class:`WorkerProcess`. ``consequence``: text for the log about the effect of the end of the
        wait. ``progress``: function whose value changes whenever the process of a run has done something."""
        self._title = title
        self._consequence = consequence
        self._progress = progress
        self._run: Run[Any] | None = None
        """The run that the loop waits for now."""

    def end(self) -> None:
        """Note that the loop does not wait now."""
        self._run = None

    def is_over(self, run: Run[Any]) -> bool:
        """Note that the loop waits for ``run`` now. Returns whether the process of ``run`` has done nothing for
        :data:`HOLD_TIMEOUT` since the wait began. The first such time is logged."""
        now = time.monotonic()
        if run is not self._run:
            self._run = run
            self._idle = IdleTime(run.process.pid or 0)
            self._seen = self._progress(run)
            self._next_look = 0.0
            self._is_logged = False
        if now >= self._next_look:
            self._next_look = now + IDLE_LOOK_PERIOD
            if (progress := self._progress(run)) != self._seen:
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


class Totals:
    """Counts that a process reports, as sums over all its runs. The methods may be called in different threads."""

    def __init__(self) -> None:
        self._counts: tuple[Counts, Counts] = {}, {}
        """Counts of all earlier runs, and of the present run."""

    def take(self, counts: Counts) -> None:
        """Take the counts of the present run: all counts of each kind so far."""
        self._counts = self._counts[0], counts

    def begin_run(self) -> None:
        """Begin another run, which counts from 0."""
        kinds = self._counts[0].keys() | self._counts[1].keys()
        self._counts = {kind: self.of(kind) for kind in kinds}, {}

    def of(self, kind: str) -> dict[str, int]:
        """Returns the sums of one kind of count, by sensor or topic."""
        before, now = (counts.get(kind, {}) for counts in self._counts)
        return {name: before.get(name, 0) + now.get(name, 0) for name in {**before, **now}}


class WorkerProcess(Generic[S]):
    """A process that runs a worker for the client. It is started again when it fails, dies or hangs.

    ``title`` names the process in messages: "the sensor process of picker". The process imports ``modules`` and then
    calls ``target(config, shared, pipe)``. ``share(context)`` creates the shared memory of one run.

    Messages of the process are pairs of a kind and a value:

    * ("ready", None) when the process is ready, ("failed", text) before it ends with an error;
    * ("statistics", :data:`Counts`) with the counts of this run, see :meth:`total`;
    * ("parameters", values by name) with ROS parameters that were set. They are added to ``config.parameters``, so that
      the next run starts with them;
    * all others, which are passed to ``receive(kind, value)`` in a thread. The client adds ("restarted", None) before
      the messages of a further run.

    The process ends at the message ("stop", None), or when the pipe is closed. While it is ready it sends some message
    at least every :data:`HANG_TIMEOUT`. Otherwise it hangs, and is killed and started again.

    ``rehearsal``: see :class:`SpawnedProcess`. If it is given, another process stands by while one is ready, and
    replaces it if it fails.
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
        """Number of times that the process was started again."""
        self.restart_time = 0.0
        """Time from the last restart of the process until the process was ready [s]."""
        self._modules = modules
        self._target = target
        self.config = config
        self._totals = Totals()
        self._share = share
        self._receive = receive
        self._rehearsal = rehearsal
        self._standby: SpawnedProcess | None = None
        self._standby_due = 0.0
        """Earliest time at which another process may be started to stand by [s]."""
        self._closing = threading.Event()
        self._started = 0.0
        """Time at which the newest run started [s]."""
        self._first_result = threading.Event()
        self._failure = ""
        """Reason why the first run failed before it was ready."""
        self._newest = self._current = self._start()
        self._thread = threading.Thread(target=self._supervise, name=f"supervisor of {title}", daemon=True)
        self._thread.start()

    # ------------------------------------------------------------------ for the loop

    def current(self) -> Run[S]:
        """Returns the newest run, and releases the memory of the run before. Call it in the loop's thread only."""
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

    def total(self, kind: str) -> dict[str, int]:
        """Returns the sums over all runs of one kind of count, by sensor or topic."""
        return self._totals.of(kind)

    # ------------------------------------------------------------------ outside the loop

    def wait_until_ready(self, timeout: float, waiting: Callable[[], object] = lambda: None) -> None:
        """Wait until the first run is ready. Raises :class:`WorkerError` if it fails, or after ``timeout`` [s].

        ``waiting()`` is called about once a second meanwhile.
        """
        until = time.monotonic() + timeout
        while not self._first_result.wait(min(1.0, max(until - time.monotonic(), 0.0))):
            if time.monotonic() >= until:
                raise WorkerError(f"{self.title} was not ready within {timeout:.0f} s")
            waiting()
        self.raise_failure()

    def raise_failure(self) -> None:
        """Raise :class:`WorkerError` if the first run failed before it was ready. The process is not started again
        then. This method does not wait."""
        if self._failure:
            raise WorkerError(f"{self.title} failed: {self._failure}")

    def send(self, kind: str, value: Any = None) -> None:
        """Send a message to the newest run. This method does not wait."""
        self._newest.send(kind, value)

    def close(self) -> None:
        """End the process. A second call does nothing."""
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
                with contextlib.suppress(OSError):  # the process has ended just now
                    return Run(standby, self._target, self.config, shared)
            standby.end()
        return Run(spawn(self.title, self._modules), self._target, self.config, shared)

    def _keep_standby(self, run: Run[S]) -> None:
        """Start a process that stands by when it is due, and another one if it has ended."""
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
            self._totals.begin_run()
            self._receive("restarted", None)
            self._started = time.monotonic()
            self._newest = self._start()

    def _log_failure(self, failures: int, reason: str) -> None:
        if failures == 1:
            log.warning("%s failed: %s; starting it again", self.title, reason)
        elif failures == 2:
            log.error("%s failed again: %s; further attempts follow without a message", self.title, reason)

    def _serve(self, run: Run[S]) -> str:
        """Take the messages of a run until the process ends or hangs. Returns the reason."""
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
                    elif kind == "statistics":
                        self._totals.take(value)
                    elif kind == "parameters":
                        self.config.parameters.update(value)
                    else:
                        self._receive(kind, value)
            except (EOFError, OSError):
                run.process.join(EXIT_TIMEOUT)
                return reason or f"it ended with exit code {run.process.exitcode}"
            if not run.process.is_alive():
                return reason or f"it ended with exit code {run.process.exitcode}"
        run.process.kill()
        return reason or f"it hung: nothing came from it for {silence.seconds:.0f} s"
