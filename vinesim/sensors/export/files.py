"""Files that are never seen half-written: they are written under other names, and renamed when all are complete."""

from __future__ import annotations

import contextlib
import os
import pathlib
from collections.abc import Iterable, Mapping


def write_files(files: Mapping[pathlib.Path, Iterable[bytes]]) -> None:
    """Write files from their pieces; they appear in the given order, when all are complete.

    :class:`OSError` if one cannot be written; then files that were there before stay as they were.
    """
    parts = {path: path.with_name(f".{path.name}.{os.getpid()}.part") for path in files}
    try:
        for path, pieces in files.items():
            with parts[path].open("wb") as file:
                file.writelines(pieces)
        for path, part in parts.items():
            part.replace(path)
    except BaseException:
        for part in parts.values():
            _remove(part)
        raise


def remove_partial_files(folder: pathlib.Path) -> None:
    """Remove the half-written files that killed processes have left anywhere in a folder, as far as possible."""
    for part in folder.glob("**/.*.part"):
        _remove(part)


def _remove(part: pathlib.Path) -> None:
    with contextlib.suppress(OSError):  # the disk may have become read-only; readers ignore partial files
        part.unlink(missing_ok=True)
