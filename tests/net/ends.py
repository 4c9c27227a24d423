"""What tests of the network share: waiting for conditions, and links that are skipped where they cannot be."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable

import pytest

from vinesim.net import emulator

PATIENCE = 15.0


def wait(condition: Callable[[], object], what: str, patience: float = PATIENCE) -> float:
    """Until it holds; fails in words. Returns how long it took [s]."""
    start = time.monotonic()
    while not condition():
        assert time.monotonic() < start + patience, f"waited {patience} s in vain for: {what}"
        time.sleep(0.01)
    return time.monotonic() - start


@functools.cache
def no_links() -> str:
    return emulator.unusable()


def need_links() -> None:
    """Skip a test where links cannot be emulated."""
    if reason := no_links():
        pytest.skip(f"links cannot be emulated here: {reason}")
