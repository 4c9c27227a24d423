"""Waiting for a condition in tests of processes and networks: generous on a busy machine, quick on an idle one."""

from __future__ import annotations

import time
from collections.abc import Callable

TIMEOUT = 120.0
"""Limit of every wait [s]. GUESSED: eight times the longest wait seen with three test processes a core."""

POLL_PERIOD = 0.005
"""Time between two evaluations of a condition [s]."""


def wait(condition: Callable[[], object], description: str, timeout: float = TIMEOUT) -> float:
    """Block until ``condition()`` is true; return the time that took [s]. Fails with ``description`` after ``timeout``
    [s]."""
    start = time.monotonic()
    while not condition():
        assert time.monotonic() < start + timeout, f"waited {timeout:g} s in vain for: {description}"
        time.sleep(POLL_PERIOD)
    return time.monotonic() - start
