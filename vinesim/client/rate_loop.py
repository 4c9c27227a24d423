"""A loop at a fixed rate: steps at absolute deadlines, with a record of how well they were kept."""

from __future__ import annotations

import dataclasses
import pathlib
import time

import numpy as np


@dataclasses.dataclass(frozen=True)
class TickLog:
    """A record of steps, for statistics of any part of a run."""

    begins: np.ndarray
    """[step] when each began, by ``time.monotonic`` of this machine [s]."""
    work: np.ndarray
    """[step] how long it took [s]."""
    dt: float
    """Simulated time of a step [s]."""
    period: float
    """From one deadline to the next [s]: longer than ``dt`` where the world is slower than real time."""

    def between(self, since: float, until: float) -> dict[str, float]:
        """Rate, percentiles of the work, overruns and real-time factor of the steps that began in a span of time [s].

        :class:`ValueError` if there are fewer than two.
        """
        part = slice(*np.searchsorted(self.begins, (since, until)))
        begins, work = self.begins[part], self.work[part]
        if len(begins) < 2:
            raise ValueError(f"{len(begins)} steps began between {since:.3f} and {until:.3f} s")
        hz = float((len(begins) - 1) / (begins[-1] - begins[0]))
        p50, p99 = (1e3 * float(value) for value in np.percentile(work, (50, 99)))
        return {
            "tick_hz": hz, "tick_p50_ms": p50, "tick_p99_ms": p99, "overruns": int((work > self.period).sum()),
            "real_time_factor": hz * self.dt,
        }  # fmt: skip

    def save(self, path: pathlib.Path) -> None:
        """Write it as a NumPy archive."""
        np.savez(path, begins=self.begins, work=self.work, dt=self.dt, period=self.period)

    @classmethod
    def load(cls, path: pathlib.Path) -> TickLog:
        """Read what :meth:`save` wrote."""
        with np.load(path) as archive:
            return cls(archive["begins"], archive["work"], float(archive["dt"]), float(archive["period"]))


class RateLoop:
    """Waits for the next of a row of deadlines, and measures the work of each step of ``dt`` [s].

    Deadlines are absolute, so a late step does not delay the ones after it. A process that fell far behind (it was
    stopped, or the machine slept) does not race to catch up: the missed deadlines are dropped.

    Simulated time passes ``target_factor`` times as fast as real time: deadlines are ``dt / target_factor`` apart.
    """

    MAX_BACKLOG = 25
    """Largest backlog that is caught up [steps]; a longer one is dropped and counted."""

    def __init__(self, dt: float, target_factor: float = 1.0, capacity: int = 1 << 16) -> None:
        self.dt = dt
        self.target_factor = target_factor
        """May be changed between steps."""
        self.ticks = 0
        self.overruns = 0
        """Steps whose work took longer than the period."""
        self.dropped = 0
        """Deadlines dropped after a stall."""
        # filled, not np.zeros: their pages are there from the start, and the memory of a run does not grow
        self._work = np.full(capacity, 0.0, np.float32)
        self._begins = np.full(capacity, 0.0)
        self._began = self._start = self._deadline = 0.0

    @property
    def period(self) -> float:
        """From one deadline to the next [s]."""
        return self.dt / self.target_factor

    def begin(self) -> None:
        """Wait until the next step is due, then start measuring its work."""
        now = time.perf_counter()
        if self.ticks == 0:
            self._start = self._deadline = now
        else:
            self._deadline += self.period
            late = now - self._deadline
            if late > self.MAX_BACKLOG * self.period:
                skipped = int(late / self.period)
                self.dropped += skipped
                self._deadline += skipped * self.period
            while (wait := self._deadline - time.perf_counter()) > 0.0:
                time.sleep(wait)
        self._began = time.perf_counter()

    def end(self) -> None:
        """End the measurement of this step's work."""
        work = time.perf_counter() - self._began
        self._work[self.ticks % len(self._work)] = work
        self._begins[self.ticks % len(self._work)] = self._began
        self.overruns += work > self.period
        self.ticks += 1

    @property
    def elapsed(self) -> float:
        """Wall time since the first step began [s]."""
        return time.perf_counter() - self._start if self.ticks else 0.0

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
        """When the last steps began and how long they took, as many as there was room for."""
        order = np.arange(max(self.ticks - len(self._work), 0), self.ticks) % len(self._work)
        return TickLog(self._begins[order], self._work[order].astype(float), self.dt, self.period)

    def work_ms(self, *percentiles: float) -> list[float]:
        """Percentiles (0 to 100) of the work of a step [ms]."""
        done = self._work[: min(self.ticks, len(self._work))]
        return [float(v) * 1e3 for v in np.percentile(done, percentiles)] if len(done) else [0.0] * len(percentiles)
