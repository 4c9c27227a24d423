"""Errors that every layer may raise; the command line shows them as one line without a traceback."""

from __future__ import annotations


class UsageError(ValueError):
    """A command or an API was called with arguments that contradict each other or are out of range.

    The message names the argument and gives the remedy, in one line. The command line exits with code 2.
    """


class WriteError(RuntimeError):
    """Files that a command was asked for could not be written: a full disk, a read-only folder.

    The message names the place, the reason and the remedy, in one line. The command line exits with code 5.
    """

    exit_code = 5
