"""Estimates the offset between the server's clock and the own clock from pings. No I/O.

Of the last eight pings the one with the shortest round trip is used, because that ping waited least in queues
(F. Cristian, Probabilistic clock synchronization, 1989). The offset is slewed, so that network time never jumps back.
"""

from __future__ import annotations

import dataclasses

PING_WINDOW = 8
"""Number of last pings from which the offset is estimated."""

MAX_SLEW_RATE = 0.01
"""Largest rate at which the used offset changes [s/s]. GUESSED."""

STEP_THRESHOLD = 0.5
"""Difference between estimated and used offset above which the estimate is used at once [s]. So large a difference is
no drift of the clocks: the server is another one. GUESSED."""


@dataclasses.dataclass(frozen=True, slots=True)
class Ping:
    """One query of the server's clock with its reply."""

    sent: float
    """Time of the own clock when the query was sent [s]."""
    server: float
    """Time of the server's clock when the server replied [s]."""
    received: float
    """Time of the own clock when the reply arrived [s]."""

    @property
    def round_trip(self) -> float:
        """Time between query and reply [s]."""
        return self.received - self.sent

    @property
    def offset(self) -> float:
        """Server's clock minus own clock [s], with an error of at most half the round trip."""
        return self.server - 0.5 * (self.sent + self.received)


def estimate(pings: tuple[Ping, ...]) -> float | None:
    """Returns the offset [s] of the ping with the shortest round trip, the latest if several have it; None without
    pings."""
    return min(reversed(pings), key=lambda ping: ping.round_trip).offset if pings else None


def slew(offset: float, target: float, dt: float) -> float:
    """Change an ``offset`` [s] towards ``target`` [s] during ``dt`` [s], by at most :data:`MAX_SLEW_RATE`, and return
    it.

    A difference of :data:`STEP_THRESHOLD` or more is removed at once.
    """
    away = target - offset
    if abs(away) >= STEP_THRESHOLD:
        return target
    return offset + min(max(away, -MAX_SLEW_RATE * dt), MAX_SLEW_RATE * dt)


@dataclasses.dataclass(frozen=True, slots=True)
class ClockEstimate:
    """An estimate of the offset of the server's clock. Immutable."""

    pings: tuple[Ping, ...] = ()
    offset: float = 0.0
    """Server's clock minus own clock, as used at present [s]."""

    def with_ping(self, ping: Ping) -> ClockEstimate:
        """Returns the estimate with one more ping. Until eight pings have arrived, the best offset is used at once.

        If the offset of a ping differs from the used offset by more than the round trip explains, another server has
        replied, or the server's clock was set. The earlier pings are then discarded.
        """
        if self.pings and abs(ping.offset - self.offset) >= STEP_THRESHOLD + 0.5 * ping.round_trip:
            return ClockEstimate((ping,), ping.offset)
        settling = len(self.pings) < PING_WINDOW
        pings = (*self.pings, ping)[-PING_WINDOW:]
        best = estimate(pings)
        return ClockEstimate(pings, best if settling and best is not None else self.offset)

    def advanced(self, dt: float) -> ClockEstimate:
        """Returns the estimate after ``dt`` [s]. The used offset is slewed towards the offset of the best ping."""
        best = estimate(self.pings)
        if best is None or best == self.offset:
            return self
        return ClockEstimate(self.pings, slew(self.offset, best, dt))
