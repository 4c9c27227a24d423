"""Handles SIGINT and SIGTERM as a request to end in order."""

from __future__ import annotations

import signal
import threading


def stop_at_signals(stop: threading.Event) -> threading.Event:
    """Let Ctrl-C and SIGTERM set ``stop`` from this call on, instead of raising an exception. Returns ``stop``."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop
