"""Handles SIGINT and SIGTERM as a request to end in order."""

from __future__ import annotations

import signal
import threading


class Interrupts:
    """Context in which Ctrl-C raises :class:`KeyboardInterrupt`. Python drops exceptions that are raised in ``__del__``
    of an object; :meth:`check` raises it again."""

    def __init__(self) -> None:
        self._happened = False

    def __enter__(self) -> Interrupts:
        self._before = signal.signal(signal.SIGINT, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _on_signal(self, *_: object) -> None:
        self._happened = True
        raise KeyboardInterrupt

    def check(self) -> None:
        """Raise :class:`KeyboardInterrupt` if Ctrl-C was pressed."""
        if self._happened:
            raise KeyboardInterrupt


def stop_at_signals(stop: threading.Event) -> threading.Event:
    """Let Ctrl-C and SIGTERM set ``stop`` from this call on, instead of raising an exception. Returns ``stop``."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop
