"""A loop at a fixed rate: steps at absolute deadlines, with a record of how well they were kept."""

from __future__ import annotations

import time

import numpy as np


class RateLoop:
    """Waits for the next of a row of deadlines ``dt`` [s] apart, and measures the work of each step.

    Deadlines are absolute, so a late step does not delay the ones after it. A process that fell far behind (it was
    stopped, or the machine slept) does not race to catch up: the missed deadlines are dropped.
    """

    MAX_BACKLOG = 25
    """Largest backlog that is caught up [steps]; a longer one is dropped and counted."""

    def __init__(self, dt: float, capacity: int = 1 << 16) -> None:
        self.dt = dt
        self.ticks = 0
        self.overruns = 0
        """Steps whose work took longer than ``dt``."""
        self.dropped = 0
        """Deadlines dropped after a stall."""
        self._work = np.zeros(capacity, np.float32)
        self._began = self._start = self._deadline = 0.0

    def begin(self) -> None:
        """Wait until the next step is due, then start measuring its work."""
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
        """End the measurement of this step's work."""
        work = time.perf_counter() - self._began
        self._work[self.ticks % len(self._work)] = work
        self.overruns += work > self.dt
        self.ticks += 1

    @property
    def elapsed(self) -> float:
        """Wall time since the first step began [s]."""
        return time.perf_counter() - self._start if self.ticks else 0.0

    @property
    def hz(self) -> float:
        """Steps per second of wall time, over the whole run."""
        span = self._began - self._start
        return (self.ticks - 1) / span if span > 0.0 else 0.0

    @property
    def real_time_factor(self) -> float:
        """Simulated time over wall time at the end of the last step."""
        span = self._began - self._start + float(self._work[(self.ticks - 1) % len(self._work)])
        return self.ticks * self.dt / span if span > 0.0 else 0.0

    def work_ms(self, *percentiles: float) -> list[float]:
        """Percentiles (0 to 100) of the work of a step [ms]."""
        done = self._work[: min(self.ticks, len(self._work))]
        return [float(v) * 1e3 for v in np.percentile(done, percentiles)] if len(done) else [0.0] * len(percentiles)
