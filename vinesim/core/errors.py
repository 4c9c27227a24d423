"""Errors that every layer may raise; the command line shows them as one line without a traceback."""

from __future__ import annotations

import contextlib
import operator
import os
import pathlib
from collections.abc import Iterator
from typing import SupportsIndex

MAX_LINE = 1000
"""Largest number of letters of a message about a file; a file may contain words of any length."""


def one_line(text: str) -> str:
    """Returns a text in one line of at most :data:`MAX_LINE` letters. The middle of a longer text is left out, because
    the place stands at its beginning and the remedy at its end."""
    line = " ".join(text.splitlines())
    return line if len(line) <= MAX_LINE else f"{line[: MAX_LINE - 305]} ... {line[-300:]}"


class UsageError(ValueError):
    """A command or an API was called with arguments that contradict each other or are out of range.

    The message is one line that names the argument and a valid value. The command line exits with code 2.
    """


class WriteError(RuntimeError):
    """Output files of a command could not be written: a full disk, a read-only folder.

    The message is one line that names the path, the reason and what the user can do. The command line exits with code
    5.
    """

    exit_code = 5


@contextlib.contextmanager
def writing(place: str | os.PathLike[str]) -> Iterator[None]:
    """Context manager for writing to the path ``place``: turns an :class:`OSError` into a :class:`WriteError` that
    names the path."""
    try:
        yield
    except BrokenPipeError:
        raise  # the reader of a pipe has closed it: not an error of a file
    except OSError as bad:
        reason = bad.strerror or str(bad)
        raise WriteError(f"{place} cannot be written: {reason}; make room there or give another place") from None


def require_place(option: str, path: str | os.PathLike[str]) -> None:
    """Raise :class:`UsageError` if the output file ``path`` of ``option`` cannot be written, before any work is done:
    its folder does not exist, or the file or folder may not be changed."""
    file = pathlib.Path(path)
    if file.is_dir():
        raise UsageError(f"{option} {file} is a folder; give a file")
    if not file.parent.is_dir():
        raise UsageError(f"{option} {file} cannot be written: there is no folder {file.parent}; make it first")
    if not os.access(file if file.exists() else file.parent, os.W_OK):
        raise UsageError(f"{option} {file} cannot be written: permission denied; give another place")


def checked_index(what: str, index: SupportsIndex, count: int, error: type[ValueError] = ValueError) -> int:
    """Returns ``index`` as an int. Raises ``error``, with a message that names ``what``, unless 0 <= ``index`` <
    ``count``."""
    try:
        number = -1 if isinstance(index, bool) else operator.index(index)  # True would be 1
    except TypeError:
        number = -1
    if not 0 <= number < count:
        remedy = f"give 0 to {count - 1}, a whole number" if count else "there is none"
        raise error(f"{what} {index} does not exist; {remedy}")
    return number
