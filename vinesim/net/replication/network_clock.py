"""Network time of one client: its estimate of the world's time, from the server's replies to pings.

Pings measure the offset between the real-time clocks of client and server. This offset does not depend on the world's
real-time factor. Each reply also contains a time of the server's clock, the time of the world at that moment, and the
real-time factor. The present time of the world follows from these. Own time runs at the real-time factor and is slewed
towards the time of the world.

Key: the query ``clock/<actor>``, which also reports how fast the actor's client can follow (:mod:`vinesim.net.pace`).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

from vinesim.net.codec.control import decode_time, encode_time
from vinesim.net.pace import PaceReport
from vinesim.net.replication.clock_sync import PING_WINDOW, STEP_THRESHOLD, ClockEstimate, Ping
from vinesim.net.transport.bus import Bus

log = logging.getLogger(__name__)

PING_PERIOD = (0.05, 0.2)
"""Real time between two pings [s]: for the first ``2 * PING_WINDOW`` pings, and afterwards."""

SETTLE_TIMEOUT = 2.0
"""Longest real time for which a client waits for the server's first reply [s]."""

MAX_REPLY_AGE = 2.0
"""Largest age of a ping whose reply is used for the present real-time factor of the world [s]."""

CURRENT_AGE = 0.75
"""Largest age of the last answered ping with which network time counts as current [s]."""

SLEW_TIME = 0.5
"""Time constant with which own time approaches the world's time [s]."""

MAX_REPORTED_LAG = 3600.0
"""Largest difference between network time and the time of a report [s]. Steps that are further away follow another
clock, and say nothing about the time of this world."""

MAX_SLEW = 0.25
"""Largest relative change of the rate of own time while it approaches the world's time."""


class NetworkClock:
    """Pings the server's clock over a bus, and estimates the time of the world.

    Arguments ``now`` are real time [s] of one monotonic clock. In a world that runs in real time, own time equals this
    time. Network time is own time plus :attr:`offset`.
    """

    def __init__(self, bus: Bus, now: float | None = None, offset: float = 0.0) -> None:
        """``now``: present real time [s]; None: given by the first :meth:`advance`. ``offset``: first value of
        :attr:`offset`."""
        self.estimate = ClockEstimate()
        """Estimate of the server's real time minus the client's real time."""
        self.factor = 1.0
        """Real-time factor of the world, from the server's last reply."""
        self.cause = ""
        """Client and part that limit the real-time factor, from the server's last reply; empty if nothing limits it."""
        self.offset = offset
        """Network time minus own time [s]."""
        self.report: Callable[[], PaceReport | None] = lambda: None
        """Function that returns how fast this client can follow; each ping sends its value. It returns None if the
        client shall not slow the world."""
        self._bus = bus
        self._now = now
        self._started = now
        self._own = 0.0 if now is None else now
        self._rate = 1.0
        """Rate at which own time passes [s/s]: the real-time factor, changed by slewing."""
        self._known: tuple[float, float] | None = None
        """Real time of the server's clock, and the world's time at that moment [s], from the server's last reply."""
        self._answered = -math.inf
        """Own real time of the last ping that the server has answered [s]."""
        self._pinged = -math.inf
        self._ping_count = 0

    @property
    def time(self) -> float:
        """Network time [s] at the last :meth:`advance`."""
        assert self._now is not None
        return self._own + self.offset

    def own(self, now: float) -> float:
        """Returns own time [s] at real time ``now`` [s]."""
        return now if self._now is None else self._own + self._rate * (now - self._now)

    @property
    def round_trip(self) -> float | None:
        """Shortest round trip of the last pings [s]; None before the first reply."""
        return min((ping.round_trip for ping in self.estimate.pings), default=None)

    @property
    def is_settled(self) -> bool:
        """Whether the server has replied, or :data:`SETTLE_TIMEOUT` has passed without a reply."""
        assert self._now is not None
        assert self._started is not None
        return bool(self.estimate.pings) or self._now - self._started > SETTLE_TIMEOUT

    def is_current(self, now: float) -> bool:
        """Whether the server has answered a recent ping (:data:`CURRENT_AGE`) at real time ``now`` [s]."""
        return now - self._answered <= CURRENT_AGE

    def advance(self, now: float) -> float:
        """Advance the clock to real time ``now`` [s]. Returns own time at ``now`` [s]."""
        own = self.own(now)
        self.estimate = self.estimate.advanced(now - self._now if self._now is not None else 0.0)
        self._now = now
        self._own = own
        self._started = now if self._started is None else self._started
        self._slew()
        return own

    def ping_if_due(self) -> None:
        """Send a ping to the server's clock if the last one is older than :data:`PING_PERIOD`."""
        assert self._now is not None
        if self._now - self._pinged >= PING_PERIOD[self._ping_count >= 2 * PING_WINDOW]:
            self._pinged = self._now
            self._ping_count = self._ping_count + 1
            self._bus.query(f"clock/{self._bus.name}", encode_time(self._now, report=self._own_report()))

    def _own_report(self) -> PaceReport | None:
        """Returns the report of this client; None before the first reply, and while its steps follow another clock."""
        report = None if self._known is None else self.report()
        return None if report is None or abs(report.time - self.time) > MAX_REPORTED_LAG else report

    def receive(self, payload: bytes, age: float) -> None:
        """Use a reply to a ping, which arrived ``age`` [s] of real time ago, for the estimate of the world's time.

        Raises :class:`MessageError` if the reply cannot be decoded.
        """
        assert self._now is not None
        reply = decode_time(payload)
        received = self._now - age
        if reply.asked > received:
            return
        is_first = not self.estimate.pings
        settles = len(self.estimate.pings) < PING_WINDOW
        self.estimate = self.estimate.with_ping(Ping(reply.asked, reply.real, received))
        is_other = len(self.estimate.pings) == 1 and not is_first
        """Whether another server has replied, or this server has set its clock."""
        if not (is_first or is_other) and (
            self._now - reply.asked > MAX_REPLY_AGE or (self._known is not None and reply.real < self._known[0])
        ):
            return
        was_silent = reply.asked - self._answered > MAX_REPLY_AGE
        self._known = (reply.real, reply.world)
        self._answered = reply.asked
        self.factor = reply.factor
        self.cause = reply.cause
        # Estimates from the first pings may be wrong by half their round trips, and time that was extrapolated through
        # a long silence may be wrong by seconds. Both are corrected at once, without slewing.
        if settles or was_silent:
            self.offset += self._away()
        self._slew()

    def _away(self) -> float:
        """Returns the world's time, by the server's last reply, minus network time [s]; 0 before the first reply."""
        if self._known is None:
            return 0.0
        assert self._now is not None
        real, world = self._known
        return world + self.factor * (self._now + self.estimate.offset - real) - self.time

    def _slew(self) -> None:
        """Set the rate of own time such that network time approaches the world's time.

        If they differ by :data:`STEP_THRESHOLD` or more, the server or its clock has changed, and network time is set
        to the world's time at once.
        """
        away = self._away()
        if abs(away) >= STEP_THRESHOLD:
            self.offset = self.offset + away
            away = 0.0
        share = away / (SLEW_TIME * self.factor)
        self._rate = self.factor * (1.0 + min(max(share, -MAX_SLEW), MAX_SLEW))
