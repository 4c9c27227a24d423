"""Time of the world: the server's clock as one client knows it at its steps. All messages of the client are stamped
with it.

Simulated time counts a client's own steps from 0. Clients start at different moments, and a client that is slow or was
stopped falls behind. Stamps are therefore simulated time plus an offset that follows the server's clock. Without a
server the offset is 0.
"""

from __future__ import annotations

import logging
from collections import deque

import numpy as np

log = logging.getLogger(__name__)

GAIN = 0.01
"""Share of the offset's error that one step corrects: jitter of single steps is smoothed over a second."""
MAX_RATE = 0.1
"""Largest rate of change of the offset [s/s]: the stamps of two successive steps of 10 ms differ by 9 to 11 ms."""
MAX_LAG = 0.05
"""[s] Largest difference between stamps and the server's clock. The stamps of a slow client that are further behind
skip ahead. If stamps are further ahead while a loop catches up, with steps faster than ``dt``, the stamps advance no
faster than the server's clock."""
MIN_RATE = 0.1
"""[s/s] Smallest rise of the stamps in a step, as a share of ``dt``."""
MAX_LEAD = 5.0
"""Time by which a server's clock may be behind the stamps before it counts as the clock of another run of the world
[s]. The offset then jumps to that clock at once."""


class WorldTime:
    """Offset between the world's time and the simulated time of one client."""

    def __init__(self, dt: float) -> None:
        """``dt``: duration of a step [s]."""
        self.offset = 0.0
        """World's time minus simulated time [s]."""
        self.is_shared = False
        """Whether a server's clock is followed."""
        self._dt = dt
        self._clock = 0.0  # server's time at the last step

    def follow(self, simulated: float, clock: float) -> None:
        """Adapt the offset to the time of the server's ``clock`` [s] at the step that starts at ``simulated`` time [s].
        Call this in every step."""
        away = clock - simulated - self.offset
        passed = clock - self._clock
        self._clock = clock
        if not self.is_shared:
            self.is_shared = True
            self.offset += away
        elif away < -MAX_LEAD:
            log.warning("the server's clock was set back by %.1f s: time goes back", -away)
            self.offset += away
        else:
            change = min(max(GAIN * away, -MAX_RATE * self._dt), MAX_RATE * self._dt)
            if away < -MAX_LAG and passed >= 0.0:
                change = min(change, max(passed, MIN_RATE * self._dt) - self._dt)
            self.offset += change
            self.offset = max(self.offset, clock - simulated - MAX_LAG)

    def take(self, offset: float) -> None:
        """Stamp steps with this ``offset`` [s], given by a loop that follows the server's clock."""
        self.is_shared = True
        self.offset = offset


class OffsetHistory:
    """Offsets of the world's time at recent simulated times, for stamps of data that become ready later than their
    time, such as pictures."""

    def __init__(self, length: int) -> None:
        """Keeps the last ``length`` offsets."""
        self._times: deque[float] = deque(maxlen=length)
        self._offsets: deque[float] = deque(maxlen=length)

    def add(self, simulated: float, offset: float) -> None:
        """Add the ``offset`` [s] at ``simulated`` time [s]. Offsets of later times are removed, because time was set
        back."""
        while self._times and self._times[-1] >= simulated:
            self._times.pop()
            self._offsets.pop()
        self._times.append(simulated)
        self._offsets.append(offset)

    def world_time(self, simulated: float) -> float:
        """Returns the world's time [s] at ``simulated`` time [s]. Outside the known range the nearest known offset
        holds.

        The result rises with ``simulated`` if the stamps of the steps rise, no matter how late it is requested. Raises
        :class:`ValueError` before the first offset.
        """
        return simulated + float(np.interp(simulated, self._times, self._offsets))
