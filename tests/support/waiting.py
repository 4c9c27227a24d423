"""Waiting for a condition in tests of processes and networks: as long as this machine may need, and no longer than
it does need."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable

USUAL_TIME = 0.03
"""Time of the work of :func:`slowness` on an idle core [s]. MEASURED on the quickest machine that ran the tests."""

VALIDITY = 10.0
"""Time for which a measured slowness is used [s]. GUESSED: other tests begin and end within it."""

POLL_PERIOD = 0.005
"""Time between two evaluations of a condition [s]."""

_measured: tuple[float, float] | None = None
"""When the slowness was last measured, and what it was."""


def slowness() -> float:
    """How many times as long this machine now takes for the same work as an idle quick one; at least 1.

    Counts a slow core, a share of a core, and the load by other processes.
    """
    global _measured
    now = time.monotonic()
    if _measured is None or now > _measured[0] + VALIDITY:
        data = bytes(1 << 20)
        start = time.perf_counter()
        for _ in range(40):
            hashlib.sha256(data).digest()
        _measured = now, max(1.0, (time.perf_counter() - start) / USUAL_TIME)
    return _measured[1]


def deadline(seconds: float = 120.0) -> float:
    """A limit [s] for what takes a fraction of ``seconds`` on an idle machine, on this one as it is loaded now.

    The default is eight times the longest wait seen with three test processes a core.
    """
    return seconds * slowness()


TIMEOUT = deadline()
"""Limit of every wait [s], as the machine was when the tests began."""


def wait(condition: Callable[[], object], description: str, seconds: float = 120.0) -> float:
    """Block until ``condition()`` is true; return the time that took [s]. Fails with ``description`` after
    :func:`deadline` of ``seconds``."""
    start = time.monotonic()
    limit = deadline(seconds)
    while not condition():
        assert time.monotonic() < start + limit, f"waited {limit:g} s in vain for: {description}"
        time.sleep(POLL_PERIOD)
    return time.monotonic() - start
