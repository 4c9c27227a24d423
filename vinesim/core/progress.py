"""What a program says while something takes long: one line that is updated on a terminal, else a line now and then."""

from __future__ import annotations

import logging
import time
from typing import Self, TextIO

log = logging.getLogger("vinesim.core.progress")
"""What is worth a line on the terminal because it takes longer than a second: see :class:`ProgressLine`. An empty text
ends the line."""
PERIOD = 1.0
"""Between two texts of a :class:`ProgressLine` [s]."""
LINE_PERIOD = 5.0
"""Between two lines where no line can be updated [s]."""
_ERASE = "\r\x1b[K"
"""To the beginning of the line, and erase all of it."""


class ProgressLine:
    """A line that says how far a program is with one thing, logged again and again while that lasts.

    A context: it ends the line. Nothing is logged in the first second, as most things are done by then.
    """

    def __init__(self) -> None:
        self._due = time.monotonic() + PERIOD
        self._is_shown = False

    def show(self, text: str) -> None:
        """Log the text of now, if the last one is :data:`PERIOD` old."""
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
        """Show the text of a record."""
        text = record.getMessage()
        try:
            if self._is_terminal:
                # the cursor returns to the beginning, where whatever else is printed then goes
                self._stream.write(f"{_ERASE}vinesim: {text}\r" if text else _ERASE)
            elif text and time.monotonic() >= self._next_line:
                self._next_line = time.monotonic() + LINE_PERIOD
                self._stream.write(f"vinesim: {text}\n")
            self._stream.flush()
        except (OSError, ValueError):
            self.handleError(record)


def show_on(stream: TextIO) -> None:
    """Show the progress of this program on a stream from now on, and nowhere else."""
    log.handlers = [ProgressHandler(stream)]
    log.propagate = False
    log.setLevel(logging.INFO)
