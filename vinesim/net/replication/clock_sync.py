"""Offset between the own clock and the server's, estimated from pings; pure.

Of the last eight pings the one with the shortest round trip is used, because it waited least in queues (F. Cristian,
Probabilistic clock synchronization, 1989). The estimate is slewed, so that network time never jumps backwards.
"""

from __future__ import annotations

import dataclasses

PING_WINDOW = 8
"""Number of pings that are remembered."""

MAX_SLEW_RATE = 0.01
"""Largest rate of change of the offset in use [s/s]. GUESSED."""

STEP_THRESHOLD = 0.5
"""An estimate that differs by more than this is used at once: it is another server, not drift [s]. GUESSED."""


@dataclasses.dataclass(frozen=True, slots=True)
class Ping:
    """One query of the server's clock."""

    sent: float
    """Own clock when the query was sent [s]."""
    server: float
    """Server's clock when it replied [s]."""
    received: float
    """Own clock when the reply arrived [s]."""

    @property
    def round_trip(self) -> float:
        """Time between query and reply [s]."""
        return self.received - self.sent

    @property
    def offset(self) -> float:
        """Server's clock minus own clock [s], in error by at most half the round trip."""
        return self.server - 0.5 * (self.sent + self.received)


def estimate(pings: tuple[Ping, ...]) -> float | None:
    """Offset [s] of the ping with the shortest round trip (the latest of equals); None without pings."""
    return min(reversed(pings), key=lambda ping: ping.round_trip).offset if pings else None


def slew(offset: float, target: float, dt: float) -> float:
    """Offset [s] after ``dt`` [s] on its way to ``target`` [s]: at most 10 ms per second, far ones at once."""
    away = target - offset
    if abs(away) >= STEP_THRESHOLD:
        return target
    return offset + min(max(away, -MAX_SLEW_RATE * dt), MAX_SLEW_RATE * dt)


@dataclasses.dataclass(frozen=True, slots=True)
class ClockEstimate:
    """Offset of the server's clock, immutable."""

    pings: tuple[Ping, ...] = ()
    offset: float = 0.0
    """Server's clock minus own clock as used now [s]."""

    def with_ping(self, ping: Ping) -> ClockEstimate:
        """Returns the estimate with one more ping. Until the first eight have arrived the best offset is used at once.

        If a ping contradicts the offset in use by more than its round trip explains, it comes from another server, or
        the server's clock was set. The earlier pings are forgotten then.
        """
        if self.pings and abs(ping.offset - self.offset) >= STEP_THRESHOLD + 0.5 * ping.round_trip:
            return ClockEstimate((ping,), ping.offset)
        settling = len(self.pings) < PING_WINDOW
        pings = (*self.pings, ping)[-PING_WINDOW:]
        best = estimate(pings)
        return ClockEstimate(pings, best if settling and best is not None else self.offset)

    def advanced(self, dt: float) -> ClockEstimate:
        """Returns the estimate after ``dt`` [s], with the offset in use slewed towards the best one."""
        best = estimate(self.pings)
        if best is None or best == self.offset:
            return self
        return ClockEstimate(self.pings, slew(self.offset, best, dt))
