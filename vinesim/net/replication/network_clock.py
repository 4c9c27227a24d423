"""Network time of one client: its own clock plus an offset that pings of the server estimate.

Key: the query ``clock``, whose reply repeats the time of the query and adds the server's time and real-time factor. In
a world that runs slower than real time the own clock runs at that factor as well, so that the offset stays constant.
"""

from __future__ import annotations

import logging
import math

from vinesim.net.codec import messages
from vinesim.net.replication.clock_sync import PING_WINDOW, ClockEstimate, Ping
from vinesim.net.transport.bus import Bus

log = logging.getLogger(__name__)

PING_PERIOD = (0.05, 2.0)
"""Real time between pings [s]: until twice the window is filled, and later."""

SETTLE_TIMEOUT = 2.0
"""A server that does not reply within this real time is not waited for any longer [s]."""


class NetworkClock:
    """Pings the server's clock over a bus and slews the offset.

    ``now`` is real time, of any monotonic clock [s]; own time is the same in a world that runs in real time.
    """

    def __init__(self, bus: Bus, now: float | None = None, offset: float = 0.0) -> None:
        """``now``: real time [s], if known; ``offset``: first estimate of network time minus own time [s]."""
        self.estimate = ClockEstimate(offset=offset)
        self.factor = 1.0
        """How many times as fast as real time the world's time passes, by the server's last reply."""
        self._bus, self._now, self._started = bus, now, now
        self._own = 0.0 if now is None else now
        self._pinged, self._ping_count = -math.inf, 0

    @property
    def offset(self) -> float:
        """Network time minus own time [s]."""
        return self.estimate.offset

    @property
    def time(self) -> float:
        """Network time [s] at the last :meth:`advance`."""
        assert self._now is not None
        return self._own + self.estimate.offset

    def own(self, now: float) -> float:
        """Own time [s] at real time ``now`` [s]."""
        return now if self._now is None else self._own + self.factor * (now - self._now)

    @property
    def round_trip(self) -> float | None:
        """Shortest of the last pings to the server and back, in real time [s]; None without a reply."""
        return min((ping.round_trip / self.factor for ping in self.estimate.pings), default=None)

    @property
    def is_settled(self) -> bool:
        """The server has replied, or has not within :data:`SETTLE_TIMEOUT`."""
        assert self._now is not None
        assert self._started is not None
        return bool(self.estimate.pings) or self._now - self._started > SETTLE_TIMEOUT

    def advance(self, now: float) -> float:
        """Go on to real time ``now`` [s] and slew the offset; the own time then [s]."""
        own = self.own(now)
        self.estimate = self.estimate.advanced(own - self._own if self._now is not None else 0.0)
        self._now, self._own = now, own
        self._started = now if self._started is None else self._started
        return own

    def ping_if_due(self) -> None:
        """Query the server's clock when the last ping is old enough."""
        assert self._now is not None
        if self._now - self._pinged >= PING_PERIOD[self._ping_count >= 2 * PING_WINDOW]:
            self._pinged, self._ping_count = self._now, self._ping_count + 1
            self._bus.query("clock", messages.encode_time(self._own))

    def receive(self, payload: bytes, age: float) -> None:
        """Take a reply that arrived ``age`` [s] of real time ago; :class:`MessageError` if it cannot be decoded."""
        assert self._now is not None
        asked, server, factor = messages.decode_time(payload)
        if factor != self.factor:
            self._change_factor(factor, server + factor * age)
            return
        received = self._own - factor * age
        if asked <= received:
            self.estimate = self.estimate.with_ping(Ping(asked, server, received))

    def _change_factor(self, factor: float, server: float) -> None:
        """Run at another ``factor`` from now on, where network time is about ``server`` [s]: pings until now were
        measured by a clock that ran differently."""
        log.info("the world runs at %g times real time", factor)
        self.factor, self.estimate = factor, ClockEstimate(offset=server - self._own)
        self._pinged, self._ping_count = -math.inf, 0
