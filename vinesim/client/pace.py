"""Clocks that determine when a client's steps are due, and a meter of the largest real-time factor that the client can
keep up with."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple, Protocol

from vinesim.net.pace import PaceReport, WorldClock
from vinesim.net.replication.replicator import Replicator

HEADROOM = 0.9
"""Share of a core's time that steps may take. The rest is for work that occurs rarely."""
WINDOW = 0.5
"""Length of a span of real time over which the work of steps is measured [s]. The last two spans count."""
HELD_SHARE = 0.1
"""Share of the time [1] for which due steps are held back, by sensors or ROS, above which a client reports its present
speed as its limit."""
REPORT_PERIOD = 0.05
"""Real time between two reports of speed to :class:`OwnPace`, the clock of a client without a server [s]."""
LONGEST_GAP = 0.25
"""Longest real time between two calls of :meth:`OwnPace.keep` that the clock counts [s]."""


class StepClock(Protocol):
    """A clock that determines when steps are due. ``now`` is ``time.monotonic()`` [s]."""

    @property
    def factor(self) -> float:
        """Returns the present real-time factor: seconds of this clock in a second of real time."""
        ...

    @property
    def cause(self) -> str:
        """Returns the name of the part that limits the factor, or "" if nothing limits it."""
        ...

    def time(self, now: float) -> float:
        """Returns the time of this clock at ``now`` [s]."""
        ...

    def is_current(self, now: float) -> bool:
        """Returns whether the time at ``now`` [s] is known, rather than extrapolated from an old value."""
        ...

    def keep(self, now: float) -> None:
        """Keep the clock up to date. Called several times a second, also while no step is made."""


class RealTime:
    """A clock that shows real time, or a fixed multiple of it."""

    cause = ""

    def __init__(self, factor: float = 1.0) -> None:
        self.factor = factor

    def time(self, now: float) -> float:
        return self.factor * now

    def is_current(self, now: float) -> bool:
        return True

    def keep(self, now: float) -> None:
        pass


class OwnPace:
    """The clock of a client without a server. Its time passes as fast as this client can compute, at most in real
    time.

    The clock stops while the client is stalled, because nobody else follows it. So the client skips no steps.
    """

    def __init__(self, name: str, now: float, report: Callable[[], PaceReport]) -> None:
        self._name = name
        self._report = report
        self._clock = WorldClock(now)
        self._next_report = now
        self._kept = now
        """Real time of the last call of :meth:`keep` [s]."""
        self._stalled = 0.0
        """Real time that the clock has not counted [s]."""

    @property
    def factor(self) -> float:
        return self._clock.factor

    @property
    def cause(self) -> str:
        return self._clock.cause

    def time(self, now: float) -> float:
        return self._clock.time(self._counted(now))

    def is_current(self, now: float) -> bool:
        return True

    def keep(self, now: float) -> None:
        counted = self._counted(now)
        self._stalled = now - counted
        self._kept = now
        self._clock.advance(counted)
        if now >= self._next_report:
            self._next_report = now + REPORT_PERIOD
            self._clock.report(self._name, counted, self._report())

    def _counted(self, now: float) -> float:
        """Returns ``now`` [s] without the time for which the client was stalled."""
        return min(now, self._kept + LONGEST_GAP) - self._stalled


class WorldPace:
    """The clock of the world that this client shares with others, as its replicator knows it."""

    def __init__(self, replicator: Replicator) -> None:
        self._replicator = replicator

    @property
    def factor(self) -> float:
        return self._replicator.real_time_factor

    @property
    def cause(self) -> str:
        return self._replicator.pace_cause

    def time(self, now: float) -> float:
        return self._replicator.network_time(now)

    def is_current(self, now: float) -> bool:
        return self._replicator.is_clock_current(now)

    def keep(self, now: float) -> None:
        self._replicator.keep_clock(now)


class Limit(NamedTuple):
    """The largest real-time factor that a part of a client can keep up with, and the name of the part."""

    factor: float
    cause: str


class _Span:
    """Steps, idle time and held time of a loop in one span of real time."""

    def __init__(self, begun: float) -> None:
        self.begun = begun
        self.ended = begun
        self.steps = 0
        self.idle = 0.0
        """Time for which no step was due [s]."""
        self.held: dict[str, float] = {}
        """Time for which a due step was held back, by cause [s]."""


class PaceMeter:
    """Computes from a loop's idle time how fast the loop could make steps of ``dt`` [s].

    Time in which a step waits for a processor core counts as work.
    """

    def __init__(self, dt: float) -> None:
        self.limits: list[Callable[[], Limit]] = []
        """Functions that return the limits of further parts of the client, such as its sensors."""
        self._dt = dt
        self._spans: deque[_Span] = deque(maxlen=2)
        self._span: _Span | None = None
        self._measured = Limit(1.0, "")

    def begin(self, now: float) -> None:
        """Start measuring at ``now`` [s]."""
        self._span = _Span(now)

    def idle(self, seconds: float) -> None:
        """Count ``seconds`` [s] for which the loop slept. A sleep that took longer than requested counts in full,
        because a loop that is late sleeps less the next time."""
        if self._span is not None:
            self._span.idle += seconds

    def hold(self, cause: str, seconds: float) -> None:
        """Count ``seconds`` [s] for which a step that was due waited because of ``cause``."""
        if self._span is not None:
            self._span.held[cause] = self._span.held.get(cause, 0.0) + seconds

    def step(self, now: float) -> None:
        """Count a step that ended at ``now`` [s]."""
        if (span := self._span) is None:
            return
        span.steps += 1
        if now - span.begun >= WINDOW:
            self._close(span, now)

    def _close(self, span: _Span, now: float) -> None:
        span.ended = now
        self._spans.append(span)
        self._span = _Span(now)
        elapsed = sum(one.ended - one.begun for one in self._spans)
        simulated = self._dt * sum(one.steps for one in self._spans)
        held: dict[str, float] = {}
        for one in self._spans:
            for cause, seconds in one.held.items():
                held[cause] = held.get(cause, 0.0) + seconds
        busy = elapsed - sum(one.idle for one in self._spans) - sum(held.values())
        self._measured = Limit(HEADROOM * simulated / max(busy, 1e-6), "steps")
        if sum(held.values()) > HELD_SHARE * elapsed:
            longest = max(sorted(held), key=lambda cause: held[cause])
            self._measured = min(self._measured, Limit(simulated / elapsed, longest))

    def limit(self) -> Limit:
        """Returns the largest real-time factor that the client can keep up with, and the part that limits it."""
        return min([self._measured, *(limit() for limit in self.limits)])
