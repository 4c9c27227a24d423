"""A buffer against jitter: what others say is shown a fixed while later, between two things they said; pure.

Extrapolation shows others where they should be by now, and is wrong when they turn meanwhile. A buffer waits: as long
as every sample comes within its delay, what is shown is exactly what was, however unevenly it came. The price is that
delay, on everything, always. Off by default: a hand that is seen late is touched where it no longer is.
"""

from __future__ import annotations

import bisect
import dataclasses

import numpy as np

from vinesim.net.replication import dead_reckoning

MAX_DELAY = 0.5
"""No buffer waits longer than this [s]."""

MAX_SAMPLES = 64
"""Samples that are remembered: half a second at the full rate, and as much again."""


@dataclasses.dataclass(frozen=True)
class JitterBuffer:
    """What one actor said, in the order of its times; every sample more makes a new one."""

    delay: float = 0.0
    """How much later all is shown [s]; 0 extrapolates to now instead."""
    times: tuple[float, ...] = ()
    """[s], strictly increasing."""
    states: tuple[np.ndarray, ...] = ()
    rates: tuple[np.ndarray, ...] = ()
    """Their change [1/s], for the time after the newest."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.delay <= MAX_DELAY:
            raise ValueError(f"jitter buffer of {1e3 * self.delay:g} ms: give 0 to {1e3 * MAX_DELAY:g} ms")

    def insert(self, time: float, state: np.ndarray, rate: np.ndarray) -> JitterBuffer:
        """With one more sample, whenever it comes; the first of two of the same time is kept."""
        at = bisect.bisect_left(self.times, time)
        if at < len(self.times) and self.times[at] == time:
            return self

        def put(values: tuple, value: object) -> tuple:
            return (*values[:at], value, *values[at:])[-MAX_SAMPLES:]

        return JitterBuffer(self.delay, put(self.times, time), put(self.states, state), put(self.rates, rate))

    def sample(self, now: float) -> np.ndarray:
        """The state to show at ``now``: what was ``delay`` earlier, on a straight line between two samples.

        Before the first sample it is that one; after the newest it is extrapolated, as without a buffer.
        """
        before, after, share, since = self._between(now)
        if before == after:
            return self.states[before] + self.rates[before] * dead_reckoning.clamp_age(since)
        return (1.0 - share) * self.states[before] + share * self.states[after]

    def rate(self, now: float) -> np.ndarray:
        """The change of what is shown at ``now`` [1/s]: said by its author, not found by differences."""
        before, after, share, since = self._between(now)
        if before == after:
            return self.rates[before] * float(0.0 <= since <= dead_reckoning.MAX_EXTRAPOLATION)
        return (1.0 - share) * self.rates[before] + share * self.rates[after]

    def _between(self, now: float) -> tuple[int, int, float, float]:
        """The samples around what is shown (one twice at an end), how far between them, how long after the first."""
        time = now - self.delay
        after = bisect.bisect_right(self.times, time)
        if after in (0, len(self.times)):
            end = max(after - 1, 0)
            return end, end, 0.0, time - self.times[end]
        since = time - self.times[after - 1]
        return after - 1, after, since / (self.times[after] - self.times[after - 1]), since
