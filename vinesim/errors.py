"""Errors that every layer may raise; the command line shows them as one line without a traceback."""

from __future__ import annotations


class UsageError(ValueError):
    """A command or an API was called with arguments that contradict each other or are out of range.

    The message names the argument and gives the remedy, in one line. The command line exits with code 2.
    """
