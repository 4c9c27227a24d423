"""Network time of one client: the world's time, as the server's replies let the client know it at every moment.

Pings measure the offset between two real-time clocks, the client's and the server's; whatever the factor of the
world, that offset stays constant. Each reply also gives a time of the server's clock, the world's time then, and the
real-time factor. The world's time now follows from both. Own time runs at the factor of the world and is slewed towards
the world's time.

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
"""Real time between pings [s]: at first, until twice the number of :data:`PING_WINDOW` pings, and after that."""

SETTLE_TIMEOUT = 2.0
"""Longest real time for which a client waits for a server's first reply [s]."""

MAX_REPLY_AGE = 2.0
"""A reply to a ping older than this does not tell the present speed of the world [s]."""

CURRENT_AGE = 0.75
"""Network time is current if the server has answered a ping that is not older than this [s]."""

SLEW_TIME = 0.5
"""Time constant with which own time approaches the world's time [s]."""

MAX_SLEW = 0.25
"""Largest share by which own time runs faster or slower while it approaches the world's time."""


class NetworkClock:
    """Pings the server's clock over a bus, and follows the time of its world.

    ``now`` is real time, of any monotonic clock [s]; own time is the same in a world that runs in real time.
    """

    def __init__(self, bus: Bus, now: float | None = None, offset: float = 0.0) -> None:
        """``now``: real time [s], if known; ``offset``: first estimate of network time minus own time [s]."""
        self.estimate = ClockEstimate()
        """Estimate of the server's real time minus the client's [s]."""
        self.factor = 1.0
        """Real-time factor of the world, by the server's last reply."""
        self.cause = ""
        """What limits the factor, by the server's last reply. Empty if nothing limits it."""
        self.offset = offset
        """Network time minus own time [s]."""
        self.report: Callable[[], PaceReport | None] = lambda: None
        """Returns how fast this client can follow, to be sent with the next ping. None: it does not slow the world."""
        self._bus = bus
        self._now = now
        self._started = now
        self._own = 0.0 if now is None else now
        self._rate = 1.0
        """Rate at which own time passes, with slewing [s/s]."""
        self._known: tuple[float, float] | None = None
        """Real time of the server's clock, and the world's time then [s], by its last reply."""
        self._answered = -math.inf
        """Real time of the last ping that the server has answered [s]."""
        self._pinged = -math.inf
        self._ping_count = 0

    @property
    def time(self) -> float:
        """Network time [s] at the last :meth:`advance`."""
        assert self._now is not None
        return self._own + self.offset

    def own(self, now: float) -> float:
        """Own time [s] at real time ``now`` [s]."""
        return now if self._now is None else self._own + self._rate * (now - self._now)

    @property
    def round_trip(self) -> float | None:
        """Shortest of the last pings to the server and back [s]; None without a reply."""
        return min((ping.round_trip for ping in self.estimate.pings), default=None)

    @property
    def is_settled(self) -> bool:
        """Whether the server has replied, or :data:`SETTLE_TIMEOUT` has passed without a reply."""
        assert self._now is not None
        assert self._started is not None
        return bool(self.estimate.pings) or self._now - self._started > SETTLE_TIMEOUT

    def is_current(self, now: float) -> bool:
        """Whether the server has told the world's time recently."""
        return now - self._answered <= CURRENT_AGE

    def advance(self, now: float) -> float:
        """Advance to real time ``now`` [s]. Returns the own time then [s]."""
        own = self.own(now)
        self.estimate = self.estimate.advanced(now - self._now if self._now is not None else 0.0)
        self._now = now
        self._own = own
        self._started = now if self._started is None else self._started
        self._slew()
        return own

    def ping_if_due(self) -> None:
        """Query the server's clock when the last ping is old enough."""
        assert self._now is not None
        if self._now - self._pinged >= PING_PERIOD[self._ping_count >= 2 * PING_WINDOW]:
            self._pinged = self._now
            self._ping_count = self._ping_count + 1
            self._bus.query(f"clock/{self._bus.name}", encode_time(self._now, report=self.report()))

    def receive(self, payload: bytes, age: float) -> None:
        """Take a reply that arrived ``age`` [s] of real time ago; :class:`MessageError` if it cannot be decoded."""
        assert self._now is not None
        reply = decode_time(payload)
        received = self._now - age
        if reply.asked > received:
            return
        is_first = not self.estimate.pings
        settles = len(self.estimate.pings) < PING_WINDOW
        self.estimate = self.estimate.with_ping(Ping(reply.asked, reply.real, received))
        is_other = len(self.estimate.pings) == 1 and not is_first
        """Whether another server has replied, or one whose clock was set."""
        if not (is_first or is_other) and (
            self._now - reply.asked > MAX_REPLY_AGE or (self._known is not None and reply.real < self._known[0])
        ):
            return
        was_silent = reply.asked - self._answered > MAX_REPLY_AGE
        self._known = (reply.real, reply.world)
        self._answered = reply.asked
        self.factor = reply.factor
        self.cause = reply.cause
        # The first estimates are as wrong as their round trips are long, and what was extrapolated through a long
        # silence may be wrong by seconds: correct both at once.
        if settles or was_silent:
            self.offset += self._away()
        self._slew()

    def _away(self) -> float:
        """The world's time, as far as it is known, minus network time [s]."""
        if self._known is None:
            return 0.0
        assert self._now is not None
        real, world = self._known
        return world + self.factor * (self._now + self.estimate.offset - real) - self.time

    def _slew(self) -> None:
        """Run faster or slower until network time equals the world's time. If they differ by :data:`STEP_THRESHOLD` or
        more, the clock is another one, and its time is taken at once."""
        away = self._away()
        if abs(away) >= STEP_THRESHOLD:
            self.offset = self.offset + away
            away = 0.0
        share = away / (SLEW_TIME * self.factor)
        self._rate = self.factor * (1.0 + min(max(share, -MAX_SLEW), MAX_SLEW))
