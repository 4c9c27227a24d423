"""A steady clock: ticks at absolute deadlines, and an honest record of how well they were kept."""

from __future__ import annotations

import time

import numpy as np


class RateLoop:
    """Waits for the next of a row of deadlines ``dt`` apart, and measures.

    Deadlines are absolute, so a late tick does not delay the ones after it. A process that fell far behind
    (it was stopped, or the machine slept) does not race to catch up: it takes up the beat again where it is.
    """

    MAX_BACKLOG = 25
    """Ticks of backlog that are caught up; a longer backlog is dropped and counted."""

    def __init__(self, dt: float, capacity: int = 1 << 16) -> None:
        self.dt = dt
        self.ticks = 0
        self.overruns = 0
        """Ticks whose work took longer than ``dt``."""
        self.dropped = 0
        """Deadlines given up after a stall."""
        self._work = np.zeros(capacity, np.float32)
        self._began = self._start = self._deadline = 0.0

    def begin(self) -> None:
        """Wait until the next tick is due, then start measuring its work."""
        now = time.perf_counter()
        if self.ticks == 0:
            self._start = self._deadline = now
        else:
            self._deadline += self.dt
            late = now - self._deadline
            if late > self.MAX_BACKLOG * self.dt:
                skipped = int(late / self.dt)
                self.dropped += skipped
                self._deadline += skipped * self.dt
            while (wait := self._deadline - time.perf_counter()) > 0.0:
                time.sleep(wait)
        self._began = time.perf_counter()

    def end(self) -> None:
        """The tick's work is done."""
        work = time.perf_counter() - self._began
        self._work[self.ticks % len(self._work)] = work
        self.overruns += work > self.dt
        self.ticks += 1

    @property
    def elapsed(self) -> float:
        """Wall time since the first tick began [s]."""
        return time.perf_counter() - self._start if self.ticks else 0.0

    @property
    def hz(self) -> float:
        """Ticks per second of wall time, over the whole run."""
        span = self._began - self._start
        return (self.ticks - 1) / span if span > 0.0 else 0.0

    @property
    def real_time_factor(self) -> float:
        """Simulated time over wall time when the last tick had finished."""
        span = self._began - self._start + float(self._work[(self.ticks - 1) % len(self._work)])
        return self.ticks * self.dt / span if span > 0.0 else 0.0

    def work_ms(self, *percentiles: float) -> list[float]:
        """Percentiles of a tick's work [ms]."""
        done = self._work[: min(self.ticks, len(self._work))]
        return [float(v) * 1e3 for v in np.percentile(done, percentiles)] if len(done) else [0.0] * len(percentiles)
