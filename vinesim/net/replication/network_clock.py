"""Network time of one client: its own clock plus an offset that pings of the server estimate.

Key: the query ``clock``, whose reply repeats the time of the query and adds the server's time.
"""

from __future__ import annotations

import math

from vinesim.net.codec import messages
from vinesim.net.replication.clock_sync import PING_WINDOW, ClockEstimate, Ping
from vinesim.net.transport.bus import Bus

PING_PERIOD = (0.05, 2.0)
"""Time between pings [s]: until twice the window is filled, and later."""

SETTLE_TIMEOUT = 2.0
"""A server that does not reply within this time is not waited for any longer [s]."""


class NetworkClock:
    """Pings the server's clock over a bus and slews the offset."""

    def __init__(self, bus: Bus, now: float | None = None, offset: float = 0.0) -> None:
        """``now``: own clock [s], if known; ``offset``: first estimate of network time minus own time [s]."""
        self.estimate = ClockEstimate(offset=offset)
        self._bus, self._now, self._started = bus, now, now
        self._pinged, self._ping_count = -math.inf, 0

    @property
    def offset(self) -> float:
        """Network time minus own time [s]."""
        return self.estimate.offset

    @property
    def time(self) -> float:
        """Network time [s] at the last :meth:`advance`."""
        assert self._now is not None
        return self._now + self.estimate.offset

    @property
    def round_trip(self) -> float | None:
        """Shortest of the last pings to the server and back [s]; None without a reply."""
        return min((ping.round_trip for ping in self.estimate.pings), default=None)

    @property
    def is_settled(self) -> bool:
        """The server has replied, or has not within :data:`SETTLE_TIMEOUT`."""
        assert self._now is not None
        assert self._started is not None
        return bool(self.estimate.pings) or self._now - self._started > SETTLE_TIMEOUT

    def advance(self, now: float) -> None:
        """Set the own clock to ``now`` [s] and slew the offset."""
        self.estimate = self.estimate.advanced(now - self._now if self._now is not None else 0.0)
        self._now = now
        self._started = now if self._started is None else self._started

    def ping_if_due(self) -> None:
        """Query the server's clock when the last ping is old enough."""
        assert self._now is not None
        if self._now - self._pinged >= PING_PERIOD[self._ping_count >= 2 * PING_WINDOW]:
            self._pinged, self._ping_count = self._now, self._ping_count + 1
            self._bus.query("clock", messages.encode_time(self._now))

    def receive(self, payload: bytes, age: float) -> None:
        """Take a reply that arrived ``age`` [s] ago; :class:`MessageError` if it cannot be decoded."""
        assert self._now is not None
        asked, server = messages.decode_time(payload)
        received = self._now - age
        if asked <= received:
            self.estimate = self.estimate.with_ping(Ping(asked, server, received))
