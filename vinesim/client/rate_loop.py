"""A loop with steps that follow a clock: each step begins when it is due. The loop records begin and duration of the
steps."""

from __future__ import annotations

import dataclasses
import logging
import math
import pathlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from vinesim.client.pace import OwnPace, PaceMeter, RealTime, StepClock, WorldPace
from vinesim.net.pace import PaceReport, describe

if TYPE_CHECKING:
    from vinesim.client.client import Client

log = logging.getLogger(__name__)

WAITING_MAX_LAG = 1.0
"""Largest lag behind the clock of a server, which waits for slow clients [s]. A loop that is further behind skips
steps."""


@dataclasses.dataclass(frozen=True)
class TickLog:
    """Begin and duration of each step of a loop, for statistics of any part of a run."""

    begins: np.ndarray
    """Time at which each step began, by ``time.monotonic`` of this machine [step] s."""
    work: np.ndarray
    """Duration of the work of each step [step] s."""
    dt: float
    """Simulated time of a step [s]."""
    periods: np.ndarray
    """Real time from one deadline to the next [step] s: longer than ``dt`` if the world is slower than real time."""

    def between(self, since: float, until: float) -> dict[str, float]:
        """Returns rate, percentiles of the work, overruns and real-time factor of the steps that began from time
        ``since`` to ``until`` [s].

        Raises :class:`ValueError` if fewer than two steps began in this span of time.
        """
        part = slice(*np.searchsorted(self.begins, (since, until)))
        begins = self.begins[part]
        work = self.work[part]
        periods = self.periods[part]
        if len(begins) < 2:
            raise ValueError(f"{len(begins)} steps began between {since:.3f} and {until:.3f} s")
        hz = float((len(begins) - 1) / (begins[-1] - begins[0]))
        p50, p99 = (1e3 * float(value) for value in np.percentile(work, (50, 99)))
        return {
            "tick_hz": hz,
            "tick_p50_ms": p50,
            "tick_p99_ms": p99,
            "overruns": int((work > periods).sum()),
            "real_time_factor": hz * self.dt,
        }

    def save(self, path: pathlib.Path) -> None:
        """Write the record as a NumPy archive."""
        np.savez(path, begins=self.begins, work=self.work, dt=self.dt, periods=self.periods)

    @classmethod
    def load(cls, path: pathlib.Path) -> TickLog:
        """Read a record that :meth:`save` wrote."""
        with np.load(path) as archive:
            return cls(archive["begins"], archive["work"], float(archive["dt"]), archive["periods"])


class RateLoop:
    """Waits until a step of ``dt`` [s] is due by a clock and nothing holds the step back, and measures its work.

    Steps are due at the clock's times ``next_time``, ``dt`` apart, so a late step does not delay later steps. A loop
    that is late makes at most 200 steps a second, so that it does not flood the subscribers of its messages. A loop
    that is more than ``max_lag`` late (it was stopped, or the machine slept) skips the steps that it has missed.
    """

    MAX_LAG = 0.25
    """Default of the largest lag that is caught up [s]."""
    LEAST_SPACING = 0.5
    """Real time between the begins of two steps, as a share of ``dt``."""
    MAX_LEAD = 5.0
    """Time by which the clock may be behind the loop before it counts as a different clock [s]. The loop then jumps to
    the clock's time at once."""
    MAX_SKIP = 3600.0
    """Time by which the clock may be ahead of the loop before the loop jumps to the clock's time at once [s]. The first
    time that a server reports is that far ahead."""
    FREE_LEAD = 0.015
    """Time by which the clock may be behind the loop before it counts as set back [s]. Steps then continue at the
    real-time factor :data:`LEAD_RATE` until the clock has caught up."""
    LEAD_RATE = 0.9
    LONGEST_SLEEP = 0.05
    """Longest single sleep [s]. The loop keeps the clock up to date between two sleeps."""
    SHORTEST_SLEEP = 1e-6
    """Largest time until a step is due with which the step begins now, without a sleep [s]."""
    HOLD_POLL = 0.001
    """Time between two checks whether a step is still held back [s]."""
    CLOCK_PATIENCE = 3.0
    """Longest wait for a clock whose time must be requested from a server, before steps are skipped [s]."""

    def __init__(
        self, dt: float, clock: StepClock | None = None, *, max_lag: float = MAX_LAG, capacity: int = 1 << 16
    ) -> None:
        """``clock``: the clock that steps follow; by default real time. ``capacity``: number of steps whose times are
        stored."""
        self.dt = dt
        self.clock = clock or RealTime()
        self.max_lag = max_lag
        self.next_time = 0.0
        """Time of the clock at which the next step is due [s]; between :meth:`begin` and :meth:`end`, the time of the
        present step."""
        self.hold: Callable[[], str] = lambda: ""
        """Function that returns the reason why the step that is due has to wait, such as "sensors", or "" if it may
        begin."""
        self.is_stopping: Callable[[], bool] = lambda: False
        """Function that returns whether the loop should stop waiting, because the run ends."""
        self.meter = PaceMeter(dt)
        self.ticks = 0
        self.overruns = 0
        """Number of steps whose work took longer than the period."""
        self.dropped = 0
        """Number of steps that were skipped after a stall."""
        # np.full touches all pages now, unlike np.zeros, so the memory of a run does not grow later.
        self._work = np.full(capacity, 0.0, np.float32)
        self._begins = np.full(capacity, 0.0)
        self._periods = np.full(capacity, dt, np.float32)
        self._began = self._start = 0.0

    @property
    def target_factor(self) -> float:
        """Real-time factor at which the steps should follow each other now."""
        return self.clock.factor

    @property
    def period(self) -> float:
        """Real time from one deadline to the next [s]."""
        return self.dt / self.clock.factor

    def report(self) -> PaceReport:
        """Returns the report of this client to the clock of its world: the world's time that the steps have reached,
        the largest real-time factor that the client can keep up with, and the part of the client that limits this
        factor. The clock adapts its real-time factor to the report."""
        return PaceReport(self.next_time, *self.meter.limit())

    def begin(self) -> None:
        """Wait until the next step is due and nothing holds it back, then start measuring its work."""
        now = time.monotonic()
        self.clock.keep(now)
        if self.ticks == 0:
            self._start = now
            self.next_time = self.clock.time(now)
            self.meter.begin(now)
        while (wait := self._time_to_wait(now)) > self.SHORTEST_SLEEP and not self.is_stopping():
            sleep = min(wait, self.LONGEST_SLEEP)
            time.sleep(sleep)
            since = now
            now = time.monotonic()
            self.meter.idle(now - since)
            if wait > sleep:
                self.clock.keep(now)
        while (cause := self.hold()) and not self.is_stopping():
            time.sleep(self.HOLD_POLL)
            since = now
            now = time.monotonic()
            self.meter.hold(cause, now - since)
            self.clock.keep(now)
        now = self._wait_for_clock(now)
        self._skip_missed(now)
        self._began = now

    def _time_to_wait(self, now: float) -> float:
        """Real time until the next step may begin [s]."""
        lead = self.next_time - self.clock.time(now)
        if not -self.MAX_SKIP <= lead <= self.MAX_LEAD:
            log.info("the loop follows another clock, whose time differs by %+.1f s", -lead)
            self.next_time -= lead
            lead = 0.0
        if self.ticks == 0:
            return 0.0
        since = now - self._began
        wait = lead / self.clock.factor
        if lead > self.FREE_LEAD:
            wait = min(wait, self.period / self.LEAD_RATE - since)
        return max(wait, self.LEAST_SPACING * self.dt - since)

    def _wait_for_clock(self, now: float) -> float:
        """If steps would be skipped, wait until the clock knows its time again. Returns the real time after the wait
        [s].

        A client that was stopped knows only the world's time from before the stop, and would skip too many steps.
        """
        until = now + self.CLOCK_PATIENCE
        while (
            self.clock.time(now) - self.next_time > self.max_lag
            and not self.clock.is_current(now)
            and now < until
            and not self.is_stopping()
        ):
            time.sleep(self.HOLD_POLL)
            since = now
            now = time.monotonic()
            self.meter.idle(now - since)
            self.clock.keep(now)
        return now

    def _skip_missed(self, now: float) -> None:
        lag = self.clock.time(now) - self.next_time
        if lag > self.max_lag:
            skipped = int(lag / self.dt)
            self.dropped += skipped
            self.next_time += skipped * self.dt

    def end(self) -> None:
        """End the measurement of this step's work."""
        now = time.monotonic()
        work = now - self._began
        row = self.ticks % len(self._work)
        self._work[row] = work
        self._begins[row] = self._began
        self._periods[row] = self.period
        self.overruns += work > self.period
        self.ticks += 1
        is_ahead = self.next_time - self.clock.time(now) > self.FREE_LEAD
        self.next_time += self.dt * (self.LEAD_RATE if is_ahead else 1.0)
        self.meter.step(now)

    @property
    def elapsed(self) -> float:
        """Wall time since the first step began [s]."""
        return time.monotonic() - self._start if self.ticks else 0.0

    @property
    def hz(self) -> float:
        """Steps per second of wall time, over the whole run."""
        span = self._began - self._start
        return (self.ticks - 1) / span if span > 0.0 and self.ticks > 1 else 0.0

    @property
    def real_time_factor(self) -> float:
        """Simulated time over wall time at the end of the last step."""
        span = self._began - self._start + float(self._work[(self.ticks - 1) % len(self._work)])
        return self.ticks * self.dt / span if span > 0.0 else 0.0

    def log(self) -> TickLog:
        """Returns the begin and the duration of the last steps; at most ``capacity`` of them."""
        order = np.arange(max(self.ticks - len(self._work), 0), self.ticks) % len(self._work)
        return TickLog(
            self._begins[order], self._work[order].astype(float), self.dt, self._periods[order].astype(float)
        )

    def work_ms(self, *percentiles: float) -> list[float]:
        """Returns percentiles (0 to 100) of the work of a step [ms]."""
        done = self._work[: min(self.ticks, len(self._work))]
        return [float(v) * 1e3 for v in np.percentile(done, percentiles)] if len(done) else [0.0] * len(percentiles)


def paced_loop(client: Client, *, is_shared: bool, factor: float | None = None) -> RateLoop:
    """Returns a loop for the steps of a client. The loop follows the clock of the server if the world ``is_shared``.
    Otherwise it follows a clock of its own, which runs at a fixed real-time ``factor`` or, if that is None, as fast as
    this client can compute."""
    if is_shared:
        loop = RateLoop(client.physics.dt, WorldPace(client.replicator), max_lag=WAITING_MAX_LAG)
        client.follow_steps(lambda: loop.next_time)
    elif factor is not None:
        loop = RateLoop(client.physics.dt, RealTime(factor))
    else:
        loop = RateLoop(client.physics.dt, max_lag=math.inf)  # the clock stops when the client does
        loop.clock = OwnPace(client.name, time.monotonic(), loop.report)
    client.pace_text = lambda: describe(loop.clock.factor, loop.clock.cause)
    loop.meter.limits += client.pace_limits
    loop.hold = client.held
    return loop
