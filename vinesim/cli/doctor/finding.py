"""The result of one check of ``vinesim doctor``."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import pathlib

OK = "ok"
"""State of a check without findings."""
WARNING = "warning"
"""State of a finding that does not prevent an ordinary client (a robot on this machine, on the CPU)."""
ERROR = "error"
"""State of a finding with which an ordinary client cannot run."""


@dataclasses.dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check."""

    check: str
    """Subject of the check, one or two words."""
    state: str
    """:data:`OK`, :data:`WARNING` or :data:`ERROR`."""
    found: str
    """Result of the check in one line."""
    remedy: str = ""
    """Instruction for the user that solves the problem; empty if there is none."""

    @property
    def line(self) -> str:
        """Returns the finding as one line of text."""
        return f"{self.state:<9}{self.check:<15}{self.found}" + (f"; {self.remedy}" if self.remedy else "")


def size_of(folder: pathlib.Path) -> int:
    """Returns the size [B] of all files below a folder; 0 if it does not exist."""
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):  # a file may be removed meanwhile
                total += os.lstat(os.path.join(parent, name)).st_size
    return total


def amount(size: float) -> str:
    """Returns a number of bytes as text with a unit."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
