"""Progress messages of long operations: on a terminal one line that is updated, in a log file a new line every few
seconds."""

from __future__ import annotations

import logging
import multiprocessing
import sys
import time
from typing import Self, TextIO

log = logging.getLogger("vinesim.core.progress")
"""Logger of progress texts, used by :class:`ProgressLine`. An empty text ends the line."""

PERIOD = 1.0
"""Least time between two texts of a :class:`ProgressLine` [s]."""

LINE_PERIOD = 5.0
"""Least time [s] between two lines in an output in which a line cannot be overwritten, such as a log file."""

_ERASE = "\r\x1b[K"
"""Terminal control sequence that moves the cursor to the beginning of the line and erases the line."""


class ProgressLine:
    """A line that shows the progress of one operation. A context manager: leaving it ends the line.

    Nothing is logged in the first second, because most operations end within it.
    """

    def __init__(self) -> None:
        self._due = time.monotonic() + PERIOD
        self._is_shown = False

    def show(self, text: str) -> None:
        """Log ``text`` if at least :data:`PERIOD` has passed since the last one."""
        if (now := time.monotonic()) >= self._due:
            self._due = now + PERIOD
            self._is_shown = True
            log.info("%s", text)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._is_shown:
            log.info("")


class ProgressHandler(logging.Handler):
    """Shows the records of :data:`log` on a stream."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self._stream = stream
        self._is_terminal = stream.isatty()
        self._next_line = 0.0

    def emit(self, record: logging.LogRecord) -> None:
        """Write the text of a log record to the stream."""
        text = record.getMessage()
        try:
            if self._is_terminal:
                # the cursor returns to the beginning, so that other output overwrites this line
                self._stream.write(f"{_ERASE}vinesim: {text}\r" if text else _ERASE)
            elif text and time.monotonic() >= self._next_line:
                self._next_line = time.monotonic() + LINE_PERIOD
                self._stream.write(f"vinesim: {text}\n")
            self._stream.flush()
        except (OSError, ValueError):
            self.handleError(record)


def show_on(stream: TextIO) -> None:
    """Show the progress messages of this program on ``stream`` only."""
    log.handlers = [ProgressHandler(stream)]
    log.propagate = False
    log.setLevel(logging.INFO)


def show_by_default() -> None:
    """Show the progress messages of this program on standard error, unless the program shows or logs them already. A
    process that another one has started through :mod:`multiprocessing` shows none."""
    if not log.hasHandlers() and multiprocessing.parent_process() is None:
        show_on(sys.stderr)
