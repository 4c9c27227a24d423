"""Lines about the course of a benchmark. Worker processes must be able to import them, which they cannot from
``__main__``."""

from __future__ import annotations

import sys


def announce(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
