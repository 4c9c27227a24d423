"""Time of the world: the server's clock as one client sees it at its steps, for the stamps of all that leaves a client.

Simulated time counts a client's own steps from 0. Clients start at different moments, and one that is slow or stood
still falls behind, so stamps are simulated time plus an offset that follows the server's clock. Without a server the
offset is 0.
"""

from __future__ import annotations

import logging
from collections import deque

import numpy as np

log = logging.getLogger(__name__)

GAIN = 0.01
"""Share of its error by which the offset follows in one step: jitter of single steps is smoothed over a second."""
MAX_RATE = 0.1
"""[s/s] Largest rate at which the offset follows: a step of 10 ms is stamped as 9 to 11 ms."""
MAX_LAG = 0.05
"""[s] Stamps are never further behind the server's clock: a client that is slow skips ahead. Where they are further
ahead of it, steps that follow each other faster than ``dt`` (a loop catches up) are stamped no faster than it runs."""
MIN_RATE = 0.1
"""[s/s] Stamps rise in every step, by this share of ``dt`` at least."""
MAX_LEAD = 5.0
"""[s] A server's clock that is further behind belongs to another run of the world, and is taken at once."""


class WorldTime:
    """Offset of the world's time against the simulated time of one client."""

    def __init__(self, dt: float) -> None:
        """``dt``: duration of a step [s]."""
        self.offset = 0.0
        """World's time minus simulated time [s]."""
        self.is_shared = False
        """Whether a server's clock is followed."""
        self._dt = dt
        self._clock = 0.0  # at the last step

    def follow(self, simulated: float, clock: float) -> None:
        """Follow the server's ``clock`` [s] at the step that starts at ``simulated`` time [s]; call it every step."""
        away = clock - simulated - self.offset
        passed = clock - self._clock
        self._clock = clock
        if not self.is_shared:
            self.is_shared = True
            self.offset += away
        elif away < -MAX_LEAD:
            log.warning("the server's clock is %.1f s behind what it was: time goes back", -away)
            self.offset += away
        else:
            change = min(max(GAIN * away, -MAX_RATE * self._dt), MAX_RATE * self._dt)
            if away < -MAX_LAG and passed >= 0.0:
                change = min(change, max(passed, MIN_RATE * self._dt) - self._dt)
            self.offset += change
            self.offset = max(self.offset, clock - simulated - MAX_LAG)

    def take(self, offset: float) -> None:
        """Stamp steps with this ``offset`` [s], which a loop that follows the server's clock says."""
        self.is_shared = True
        self.offset = offset


class OffsetHistory:
    """Offsets of the world's time at recent simulated times, for the stamps of what is ready later than it happened."""

    def __init__(self, length: int) -> None:
        """Keeps the last ``length`` offsets."""
        self._times: deque[float] = deque(maxlen=length)
        self._offsets: deque[float] = deque(maxlen=length)

    def add(self, simulated: float, offset: float) -> None:
        """Add the ``offset`` [s] at ``simulated`` time [s]; those of later times are removed, as time was set back."""
        while self._times and self._times[-1] >= simulated:
            self._times.pop()
            self._offsets.pop()
        self._times.append(simulated)
        self._offsets.append(offset)

    def world_time(self, simulated: float) -> float:
        """World's time [s] at ``simulated`` time [s]; beyond the known offsets the nearest of them holds.

        Rises with ``simulated`` if the stamps of the steps rise, however late it is asked for. :class:`ValueError`
        before the first offset.
        """
        return simulated + float(np.interp(simulated, self._times, self._offsets))
