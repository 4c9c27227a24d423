"""The error that an unfit robot description raises."""

from __future__ import annotations

import pathlib


class DescriptionError(ValueError):
    """A robot description that cannot be simulated: one line with the file, what is wrong, and the remedy."""


def description_error(file: pathlib.Path, problem: str, remedy: str) -> DescriptionError:
    """The error with its text in one line, to be raised."""
    return DescriptionError(" ".join(f"{file}: {problem}; {remedy}".split()))
