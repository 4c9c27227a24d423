"""Clock of a world: its time passes as fast as all clients that simulate can follow, and at most in real time. No I/O.

Clients report the time that their steps have reached, and the largest real-time factor that they could follow. The
factor of the world falls quickly to the smallest of the reported factors, and rises slowly. If a client falls behind
nevertheless, the clock slows down within half a second of simulated time, so that the client need not skip steps. A
client that reports nothing for :data:`SILENCE` is left behind: the world does not wait for it until it has caught up.

A server that was restarted does not know the time of its worlds, but the clients do: for a while after the start, the
clock of a world goes on from the latest time that a client reports.
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
"""Time of the world [s] by which a client may be behind without slowing the clock, because messages take some time."""
STOP_LAG = 0.5
"""Time of the world [s] by which a client is behind when the factor is reduced to :data:`MIN_FACTOR`."""
OVERDUE = 0.6
"""Time without a report after which a client is assumed to have stopped [s]. Clients report five times a second."""
SILENCE = 3.0
"""Time without a report after which a client is left behind: the world does not wait for it any more [s]."""
STEP = 0.05
"""Longest real time for which the factor of the world stays constant [s]."""


SHOWN_FACTOR = 0.995
"""Smallest real-time factor that is shown as real time."""


def describe(factor: float, cause: str) -> str:
    """Returns the text of a status line with the real-time factor and what limits it: "0.43 of real time (picker:
    sensors)". The text is empty for real time."""
    if factor >= SHOWN_FACTOR:
        return ""
    return f"{factor:.2f} of real time" + (f" ({cause})" if cause else "")


MAX_STEP = 4.0 * STEP
"""Longest time that one call of :meth:`WorldClock.advance` adds to the silence of clients [s]."""


class PaceReport(NamedTuple):
    """Report of one client to the clock of its world."""

    time: float
    """Time of the world that the client's steps have reached [s]."""
    factor: float
    """Largest real-time factor that the client can follow. May be above 1."""
    cause: str = ""
    """Part of the client that limits the factor: "steps", "sensors" or "ROS messages"."""


@dataclasses.dataclass
class _Client:
    """The last report of a client, and how far the client is behind the clock of the world."""

    report: PaceReport
    arrived: float
    """Real time at which the last report arrived [s]."""
    lag: float
    """Time of the world by which the client is behind [s]."""
    silence: float = 0.0
    """Real time since the last report [s], without times in which the server itself did not run."""
    is_left_behind: bool = False


class WorldClock:
    """The clock of one world. All arguments ``now`` are real time [s] of one monotonic clock."""

    def __init__(
        self, now: float, time: float = 0.0, factor: float | None = None, *, open_until: float = -math.inf
    ) -> None:
        """``time``: time of the world at ``now`` [s]. ``factor``: fixed real-time factor; None: as fast as clients can
        follow. ``open_until``: ``now`` [s] until which the clock takes its time from reports."""
        self.is_fixed = factor is not None
        self.factor = 1.0 if factor is None else factor
        """Present real-time factor of the world: seconds of simulated time in a second of real time."""
        self.cause = ""
        """Client that limits the factor, and the cause: "picker: sensors". Empty while nothing limits it."""
        self._time = time
        self._now = now
        self._open_until = open_until
        self._begin = now, time
        self._pace = self.factor
        """Real-time factor before it is reduced for clients that are behind."""
        self._clients: dict[str, _Client] = {}

    @property
    def left_behind(self) -> list[str]:
        """Names of the clients for which the world does not wait any more, sorted."""
        return sorted(name for name, one in self._clients.items() if one.is_left_behind)

    def time(self, now: float) -> float:
        """Returns the time of the world [s] at ``now`` [s], which is not earlier than the last :meth:`advance`."""
        return self._time + self.factor * (now - self._now)

    def awaits_report(self, now: float) -> bool:
        """Whether the time of the world is not known at ``now`` [s], because the clients that may know it have not
        reported."""
        return now < self._open_until and not self._clients

    def report(self, name: str, now: float, report: PaceReport) -> None:
        """Store a report that arrived from the client ``name`` at ``now`` [s]."""
        self.advance(now)
        if now < self._open_until:
            self._take(report.time)
        lag = max(self._time - report.time, 0.0)
        before = self._clients.get(name)
        stays_behind = before is not None and before.is_left_behind and lag >= STOP_LAG
        if before is not None and before.is_left_behind and not stays_behind:
            log.info("%s follows the world's clock again", name)
        self._clients[name] = _Client(report, now, lag, is_left_behind=stays_behind)

    def _take(self, reached: float) -> None:
        """Go on from the time that a client has ``reached`` [s]: from that of the first client in any case, from that
        of further ones if they are ahead.

        No client is ahead of a world that passed in real time since the clock began, so no report moves the clock
        beyond that.
        """
        begin, time = self._begin
        reached = min(max(reached, 0.0), time + self._now - begin)
        self._time = max(self._time, reached) if self._clients else reached

    def forget(self, name: str) -> None:
        """Remove a client that has left."""
        self._clients.pop(name, None)

    def advance(self, now: float) -> None:
        """Advance the clock to real time ``now`` [s] and adapt its factor. Must be called several times a second."""
        for client in self._clients.values():  # if the server does not run, its clients may not either
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
        """Increase the lag of a client that does not report, and leave it behind after :data:`SILENCE`.

        ``step``: real time that has passed [s].
        """
        if self._now - client.arrived > OVERDUE:
            client.lag += self.factor * step
        if client.silence > SILENCE and not client.is_left_behind:
            client.is_left_behind = True
            log.warning("%s has not answered for %.0f s: the world goes on without waiting for it", name, SILENCE)

    def _adapt(self, step: float) -> None:
        """Choose the real-time factor after ``step`` [s] of real time, and note what limits it."""
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
