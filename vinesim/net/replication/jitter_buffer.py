"""Jitter buffer: poses of a peer are shown after a fixed delay, interpolated between two received ones; pure.

Extrapolation shows peers where they should be now, and is wrong if they turn meanwhile. A buffer waits: while every
sample arrives within its delay, the shown motion is exactly the motion of the peer, however unevenly samples arrive.
The price is that delay. The buffer is off by default, because a hand that is shown late is touched where it no longer
is.
"""

from __future__ import annotations

import bisect
import dataclasses

import numpy as np

from vinesim.net.replication import dead_reckoning

MAX_DELAY = 0.5
"""Longest delay [s]."""

MAX_SAMPLES = 64
"""Samples that are kept: twice as many as arrive in the longest delay at the full rate."""


@dataclasses.dataclass(frozen=True)
class JitterBuffer:
    """Samples of one peer in the order of their times; immutable."""

    delay: float = 0.0
    """Delay of the shown state [s]; 0 extrapolates to now instead."""
    times: tuple[float, ...] = ()
    """Network times of the samples [s], strictly increasing."""
    states: tuple[np.ndarray, ...] = ()
    rates: tuple[np.ndarray, ...] = ()
    """Time derivatives of the samples [1/s], used after the newest sample."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.delay <= MAX_DELAY:
            raise ValueError(f"jitter buffer of {1e3 * self.delay:g} ms: give 0 to {1e3 * MAX_DELAY:g} ms")

    def insert(self, time: float, state: np.ndarray, rate: np.ndarray) -> JitterBuffer:
        """Returns the buffer with one more sample. Samples may arrive in any order. If two have the same time, the
        first is kept."""
        at = bisect.bisect_left(self.times, time)
        if at < len(self.times) and self.times[at] == time:
            return self

        def put(values: tuple, value: object) -> tuple:
            return (*values[:at], value, *values[at:])[-MAX_SAMPLES:]

        return JitterBuffer(self.delay, put(self.times, time), put(self.states, state), put(self.rates, rate))

    def sample(self, now: float) -> np.ndarray:
        """The state to show at ``now`` [s]: the state at ``now - delay``, interpolated linearly between two samples.

        Before the first sample it is the first sample. After the newest it is extrapolated as without a buffer.
        """
        before, after, share, since = self._between(now)
        if before == after:
            return self.states[before] + self.rates[before] * dead_reckoning.clamp_age(since)
        return (1.0 - share) * self.states[before] + share * self.states[after]

    def rate(self, now: float) -> np.ndarray:
        """Time derivative of the state shown at ``now`` [1/s], as sent by the peer, not a finite difference."""
        before, after, share, since = self._between(now)
        if before == after:
            return self.rates[before] * float(0.0 <= since <= dead_reckoning.MAX_EXTRAPOLATION)
        return (1.0 - share) * self.rates[before] + share * self.rates[after]

    def _between(self, now: float) -> tuple[int, int, float, float]:
        """Indices of the two samples around ``now``, which are equal at an end; the interpolation weight between them;
        the time since the first of the two [s]."""
        time = now - self.delay
        after = bisect.bisect_right(self.times, time)
        if after in (0, len(self.times)):
            end = max(after - 1, 0)
            return end, end, 0.0, time - self.times[end]
        since = time - self.times[after - 1]
        return after - 1, after, since / (self.times[after] - self.times[after - 1]), since
