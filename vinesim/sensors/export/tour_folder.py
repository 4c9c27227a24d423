"""The folder of a tour: the pictures of ``vinesim render --path`` in folders ``0000``, ``0001``, ..., and
``tour.json``, which holds the settings that determine them.

An interrupted tour is continued, and a folder never holds pictures of two tours.
"""

from __future__ import annotations

import json
import pathlib
from collections.abc import Mapping
from typing import Any

from vinesim.core.errors import UsageError
from vinesim.sensors.export import annotations as formats
from vinesim.sensors.export.files import remove_partial_files, write_files

SETTINGS = "tour.json"
_REMEDY = "give another folder, or delete this one"
_LONG = ("path", "scene")
"""Settings that are too long for a message."""


def check(folder: pathlib.Path, settings: Mapping[str, Any]) -> None:
    """Raise :class:`UsageError` if the folder holds pictures other than those of a tour with these ``settings``."""
    file = folder / SETTINGS
    if not file.exists():
        if any(folder.glob("camera.json")) or any(folder.glob("*/camera.json")) or (folder / "records").exists():
            raise UsageError(f"--out {folder} holds pictures that are not of this tour; {_REMEDY}")
        return
    wanted = json.loads(json.dumps(settings))
    try:
        there = json.loads(file.read_text("utf-8"))
        differing = [name for name in wanted if there.get(name) != wanted[name]]
    except (ValueError, AttributeError):
        raise UsageError(f"--out {folder}: {file.name} holds no settings of a tour; {_REMEDY}") from None
    for name in differing:
        what = f"another {name}" if name in _LONG else f"{name} {there.get(name)}, not {wanted[name]}"
        raise UsageError(f"--out {folder} holds a tour with {what}; {_REMEDY}")


def begin(folder: pathlib.Path, settings: Mapping[str, Any]) -> None:
    """Create the folder of a tour and write its ``settings``. Raises OSError if that fails."""
    folder.mkdir(parents=True, exist_ok=True)
    remove_partial_files(folder)
    write_files({folder / SETTINGS: [formats.json_text(dict(settings)).encode()]})
