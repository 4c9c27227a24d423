"""Time of a world: it passes as fast as all clients that simulate can follow, and at most in real time; pure.

Clients report the time that their steps have reached, and the largest real-time factor that they could follow. The
factor of the world falls at once to the smallest of these, and rises slowly. A client that falls behind nevertheless
slows the clock within half a second of simulated time, so that it need not skip steps. A client that reports nothing
for :data:`SILENCE` is left behind: it does not slow the others any more, until it has caught up.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from typing import NamedTuple

log = logging.getLogger(__name__)

MIN_FACTOR = 0.01
"""Smallest real-time factor of a world; the largest is 1."""
FALL_TIME = 0.3
"""Time constant with which the factor falls to what the slowest client can follow [s]."""
RISE_TIME = 4.0
"""Time constant with which the factor rises [s]. It is long so that the factor does not oscillate with a client that
can only just follow."""
LEAST_RISE = 0.04
"""Lowest rate at which the factor rises [1/s]."""
FREE_LAG = 0.15
"""A client that is less than this behind does not slow the clock [s of the world]: messages take some time."""
STOP_LAG = 0.5
"""The factor is :data:`MIN_FACTOR`, so that the clock almost stops, if a client is this far behind [s of the world]."""
OVERDUE = 0.6
"""A client that has reported nothing for this long is taken to have stopped [s]; it reports five times a second."""
SILENCE = 3.0
"""A client that has reported nothing for this long is left behind [s]."""
STEP = 0.05
"""Longest real time for which the clock runs at a constant factor [s]."""


SHOWN_FACTOR = 0.995
"""A real-time factor of at least this is shown as real time."""


def describe(factor: float, cause: str) -> str:
    """Text for a status line with a real-time factor and what limits it: "0.43 of real time (picker: sensors)". It is
    "" for real time."""
    if factor >= SHOWN_FACTOR:
        return ""
    return f"{factor:.2f} of real time" + (f" ({cause})" if cause else "")


MAX_STEP = 4.0 * STEP
"""Longest time that two successive calls of :meth:`WorldClock.advance` add to the silence of clients [s]."""


class PaceReport(NamedTuple):
    """Report of one client to the clock of its world."""

    time: float
    """Time of the world that its steps have reached [s]."""
    factor: float
    """Largest real-time factor that the client can follow; may be above 1."""
    cause: str = ""
    """What limits this factor: "steps", "sensors", "ROS messages"."""


@dataclasses.dataclass
class _Client:
    report: PaceReport
    arrived: float
    """Real time of its last report [s]."""
    lag: float
    """How far it is behind [s of the world]."""
    silence: float = 0.0
    """Time since its last report [s]. Time in which this clock itself got no processor does not count."""
    is_left_behind: bool = False


class WorldClock:
    """The clock of one world. ``now`` is real time, of any monotonic clock [s]."""

    def __init__(self, now: float, time: float = 0.0, factor: float | None = None) -> None:
        """The world begins at ``time`` [s]. ``factor``: a fixed real-time factor; None: as the clients can follow."""
        self.is_fixed = factor is not None
        self.factor = 1.0 if factor is None else factor
        """Present real-time factor of the world: seconds of its time in a second of real time."""
        self.cause = ""
        """Client that limits the factor, and the cause: "picker: sensors". Empty while nothing limits it."""
        self._time = time
        self._now = now
        self._pace = self.factor
        """The factor before it is reduced for clients that are behind."""
        self._clients: dict[str, _Client] = {}

    @property
    def left_behind(self) -> list[str]:
        """Clients that are left behind, sorted."""
        return sorted(name for name, one in self._clients.items() if one.is_left_behind)

    def time(self, now: float) -> float:
        """Time of the world at ``now`` [s], not earlier than the last :meth:`advance`."""
        return self._time + self.factor * (now - self._now)

    def report(self, name: str, now: float, report: PaceReport) -> None:
        """Take a report of a client that arrived at ``now`` [s]."""
        self.advance(now)
        lag = max(self._time - report.time, 0.0)
        before = self._clients.get(name)
        stays_behind = before is not None and before.is_left_behind and lag >= STOP_LAG
        if before is not None and before.is_left_behind and not stays_behind:
            log.info("%s follows the world's clock again", name)
        self._clients[name] = _Client(report, now, lag, is_left_behind=stays_behind)

    def forget(self, name: str) -> None:
        """Remove a client that has left."""
        self._clients.pop(name, None)

    def advance(self, now: float) -> None:
        """Advance to real time ``now`` [s]. Call it several times a second."""
        for client in self._clients.values():  # a machine that starves the server starves its clients, too
            client.silence += min(now - self._now, MAX_STEP)
        while self._now < now:
            step = min(STEP, now - self._now)
            self._time += self.factor * step
            self._now += step
            for name, client in sorted(self._clients.items()):
                self._watch(name, client, step)
            if not self.is_fixed:
                self._adapt(step)

    def _watch(self, name: str, client: _Client, step: float) -> None:
        """Update the lag of a client without a new report, and leave it behind after :data:`SILENCE`."""
        if self._now - client.arrived > OVERDUE:
            client.lag += self.factor * step
        if client.silence > SILENCE and not client.is_left_behind:
            client.is_left_behind = True
            log.warning("%s has not answered for %.0f s: the world goes on without waiting for it", name, SILENCE)

    def _adapt(self, step: float) -> None:
        """Choose the factor for the next time step, and note its cause."""
        limit = 1.0
        brake = 1.0
        limited_by = braked_by = ""
        for name, client in sorted(self._clients.items()):
            if client.is_left_behind:
                continue
            if client.report.factor < limit:
                limit = client.report.factor
                limited_by = f"{name}: {client.report.cause}"
            free = min(max((STOP_LAG - client.lag) / (STOP_LAG - FREE_LAG), 0.0), 1.0)
            if free < brake:
                brake = free
                braked_by = f"{name}: behind"
        if limit < self._pace:
            self._pace += (limit - self._pace) * -math.expm1(-step / FALL_TIME)
        else:
            rise = max((limit - self._pace) * -math.expm1(-step / RISE_TIME), LEAST_RISE * step)
            self._pace = min(self._pace + rise, limit)
        self.factor = max(self._pace * brake, MIN_FACTOR)
        if brake < 1.0 and brake * self._pace < 0.9 * limit:
            self.cause = braked_by
        elif self._pace < SHOWN_FACTOR:
            self.cause = limited_by or self.cause
        else:
            self.cause = ""
