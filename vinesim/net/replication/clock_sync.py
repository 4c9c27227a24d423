"""The common clock: how far one's own clock is from the server's, from pings; pure.

Of the last eight pings the one with the shortest round trip is believed (it waited least in queues; Cristian 1989),
and the estimate is slewed, so that network time never jumps backwards under a running simulation.
"""

from __future__ import annotations

import dataclasses

PING_WINDOW = 8
"""How many pings are remembered."""

MAX_SLEW_RATE = 0.01
"""Largest change of the offset in use [s/s]."""

STEP_THRESHOLD = 0.5
"""An estimate this far away [s] is taken at once: it is another server, not drift."""


@dataclasses.dataclass(frozen=True, slots=True)
class Ping:
    """One question to the server's clock and its answer."""

    sent: float
    """Own clock when the question left [s]."""
    server: float
    """Server's clock when it answered [s]."""
    received: float
    """Own clock when the answer came [s]."""

    @property
    def round_trip(self) -> float:
        """[s]"""
        return self.received - self.sent

    @property
    def offset(self) -> float:
        """Server's clock minus own clock [s], wrong by at most half the round trip."""
        return self.server - 0.5 * (self.sent + self.received)


def estimate(pings: tuple[Ping, ...]) -> float | None:
    """Offset [s] of the ping with the shortest round trip (the latest of equals); None without pings."""
    return min(reversed(pings), key=lambda ping: ping.round_trip).offset if pings else None


def slew(offset: float, target: float, dt: float) -> float:
    """The offset in use after ``dt`` seconds on its way to ``target``: at most 10 ms per second, far ones at once."""
    away = target - offset
    if abs(away) >= STEP_THRESHOLD:
        return target
    return offset + min(max(away, -MAX_SLEW_RATE * dt), MAX_SLEW_RATE * dt)


@dataclasses.dataclass(frozen=True, slots=True)
class ClockEstimate:
    """Own clock plus an offset; every change makes a new one."""

    pings: tuple[Ping, ...] = ()
    offset: float = 0.0
    """Server's clock minus own clock as used now [s]."""

    def with_ping(self, ping: Ping) -> ClockEstimate:
        """With one more ping. While the first eight come in the best estimate is taken at once, later it is slewed."""
        settling = len(self.pings) < PING_WINDOW
        pings = (*self.pings, ping)[-PING_WINDOW:]
        best = estimate(pings)
        return ClockEstimate(pings, best if settling and best is not None else self.offset)

    def advanced(self, dt: float) -> ClockEstimate:
        """``dt`` seconds later, slewed towards the estimate."""
        best = estimate(self.pings)
        if best is None or best == self.offset:
            return self
        return ClockEstimate(self.pings, slew(self.offset, best, dt))
