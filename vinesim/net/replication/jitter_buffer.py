"""Jitter buffer: shows the poses of a peer after a fixed delay, interpolated between two received poses. No I/O.

Extrapolation shows a peer where it should be now, and is wrong if the peer has turned meanwhile. A jitter buffer waits
instead. While every sample arrives within the delay, the shown motion is exactly that of the peer, however unevenly the
samples arrive. The price is the delay. The buffer is off by default, because contacts with a hand that is shown late
would happen where the hand no longer is.
"""

from __future__ import annotations

import bisect
import dataclasses

import numpy as np

from vinesim.net.replication import dead_reckoning

MAX_DELAY = 0.5
"""Longest delay of a jitter buffer [s]."""

MAX_SAMPLES = 64
"""Largest number of samples in a buffer: twice as many as arrive during the longest delay at the full rate."""


@dataclasses.dataclass(frozen=True)
class JitterBuffer:
    """A buffer of the last poses of one peer, in order of their times. Immutable."""

    delay: float = 0.0
    """Delay of the shown pose [s]. 0: no buffer, poses are extrapolated to the present."""
    times: tuple[float, ...] = ()
    """Network times of the samples [s], strictly increasing."""
    states: tuple[np.ndarray, ...] = ()
    rates: tuple[np.ndarray, ...] = ()
    """Time derivatives of the samples [1/s], with which the newest sample is extrapolated."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.delay <= MAX_DELAY:
            raise ValueError(f"jitter buffer of {1e3 * self.delay:g} ms: give 0 to {1e3 * MAX_DELAY:g} ms")

    def insert(self, time: float, state: np.ndarray, rate: np.ndarray) -> JitterBuffer:
        """Returns the buffer with one more sample. Samples may arrive in any order.

        ``time``: network time of the sample [s]. ``state``: flat array of the pose. ``rate``: its time derivative
        [1/s]. Of two samples with the same time the first one is kept.
        """
        at = bisect.bisect_left(self.times, time)
        if at < len(self.times) and self.times[at] == time:
            return self

        def put(values: tuple, value: object) -> tuple:
            return (*values[:at], value, *values[at:])[-MAX_SAMPLES:]

        return JitterBuffer(self.delay, put(self.times, time), put(self.states, state), put(self.rates, rate))

    def sample(self, now: float) -> np.ndarray:
        """Returns the state to show at network time ``now`` [s]: the state at ``now - delay``.

        It is interpolated linearly between two samples. Before the first sample and after the newest one, that sample
        is extrapolated, as without a buffer.
        """
        before, after, share, since = self._between(now)
        if before == after:
            return self.states[before] + self.rates[before] * dead_reckoning.clamp_age(since)
        return (1.0 - share) * self.states[before] + share * self.states[after]

    def rate(self, now: float) -> np.ndarray:
        """Returns the time derivative [1/s] of the state that is shown at network time ``now`` [s].

        It is interpolated between the derivatives that the peer has sent, and is no finite difference.
        """
        before, after, share, since = self._between(now)
        if before == after:
            return self.rates[before] * float(0.0 <= since <= dead_reckoning.MAX_EXTRAPOLATION)
        return (1.0 - share) * self.rates[before] + share * self.rates[after]

    def _between(self, now: float) -> tuple[int, int, float, float]:
        """Returns the two samples around the time ``now - delay`` [s], from which the shown state is interpolated: the
        index of the earlier sample, the index of the later sample, the weight of the later sample (0 to 1), and the
        time from the earlier sample to ``now - delay`` [s].

        Before the first and after the newest sample, both indices are those of this one sample, and the weight is 0.
        """
        time = now - self.delay
        after = bisect.bisect_right(self.times, time)
        if after in (0, len(self.times)):
            end = max(after - 1, 0)
            return end, end, 0.0, time - self.times[end]
        since = time - self.times[after - 1]
        return after - 1, after, since / (self.times[after] - self.times[after - 1]), since
