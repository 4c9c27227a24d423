"""What one check of ``vinesim doctor`` has found."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import pathlib

OK = "ok"
WARNING = "warning"
ERROR = "error"
"""States of a finding. An error is what an ordinary client (a robot on this machine, on the CPU) cannot do without."""


@dataclasses.dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check."""

    check: str
    """What was looked at, one or two words."""
    state: str
    """:data:`OK`, :data:`WARNING` or :data:`ERROR`."""
    found: str
    """What is there, in one line."""
    remedy: str = ""
    """What to do about it; empty if all is well."""

    @property
    def line(self) -> str:
        """The finding as one line of text."""
        return f"{self.state:<9}{self.check:<15}{self.found}" + (f"; {self.remedy}" if self.remedy else "")


def size_of(folder: pathlib.Path) -> int:
    """Size [B] of all files below a folder; 0 if it is not there."""
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):  # removed meanwhile
                total += os.lstat(os.path.join(parent, name)).st_size
    return total


def amount(size: float) -> str:
    """A number of bytes in words."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
