"""Progress is one line that is updated on a terminal, and a line now and then elsewhere."""

from __future__ import annotations

import io
import logging
import sys

import pytest

from vinesim.core import progress
from vinesim.core.progress import ProgressHandler


class Terminal(io.StringIO):
    """What a terminal shows in its line, and what was written."""

    def isatty(self) -> bool:
        return True


def say(handler: ProgressHandler, *texts: str) -> None:
    for text in texts:
        handler.handle(logging.LogRecord("vinesim.core.progress", logging.INFO, "", 0, text, None, None))


def test_a_terminal_shows_one_line_that_is_erased_at_the_end() -> None:
    terminal = Terminal()
    say(ProgressHandler(terminal), "compiling: 1 of 2", "compiling: 2 of 2", "")
    assert "\n" not in terminal.getvalue()
    lines = terminal.getvalue().split("\x1b[K")
    assert [line.strip("\r") for line in lines] == ["", "vinesim: compiling: 1 of 2", "vinesim: compiling: 2 of 2", ""]
    assert all(line.endswith("\r") for line in lines[:-1])  # what is printed next begins at the left


def test_elsewhere_a_line_is_written_every_few_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    stream = io.StringIO()
    handler = ProgressHandler(stream)
    for number in range(9):
        say(handler, f"compiling: {number}")
        now += 1.0
    say(handler, "")
    assert stream.getvalue() == "vinesim: compiling: 0\nvinesim: compiling: 5\n"


@pytest.mark.parametrize("own", [False, True])
def test_progress_is_shown_on_standard_error_unless_the_program_logs_it(
    own: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As in programs that use the Python interface, which have set up no output of their own."""
    monkeypatch.setattr(progress.log, "handlers", [logging.StreamHandler(sys.stdout)] if own else [])
    monkeypatch.setattr(progress.log, "propagate", False)
    monkeypatch.setattr(progress.log, "level", logging.INFO)
    progress.show_by_default()
    progress.log.info("compiling kernels, only once: 1 of 31 done")
    said = capsys.readouterr()
    assert said.out == ("compiling kernels, only once: 1 of 31 done\n" if own else "")
    assert said.err == ("" if own else "vinesim: compiling kernels, only once: 1 of 31 done\n")
