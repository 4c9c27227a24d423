"""Files that Python packages install below ``share``: robots and meshes."""

from __future__ import annotations

import importlib.util
import pathlib
import sys


def find_installed(path: str) -> pathlib.Path | None:
    """A file that a wheel of cmeel (example-robot-data and others) installed below ``share``; None if missing."""
    roots = [pathlib.Path(sys.prefix) / "share"]
    cmeel = importlib.util.find_spec("cmeel")
    if cmeel is not None and cmeel.origin:
        roots.append(pathlib.Path(cmeel.origin).parent.parent / "cmeel.prefix" / "share")
    roots += [pathlib.Path(entry) / "cmeel.prefix" / "share" for entry in sys.path if entry]
    return next((root / path for root in roots if (root / path).is_file()), None)
