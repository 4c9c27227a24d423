"""Atomic writing of files: they are written under temporary names, and renamed when all of them are complete."""

from __future__ import annotations

import contextlib
import os
import pathlib
from collections.abc import Iterable, Mapping


def write_files(files: Mapping[pathlib.Path, Iterable[bytes]]) -> None:
    """Write several files, each given as pieces of bytes; they appear in the given order when all of them are complete.

    Raises :class:`OSError` if a file cannot be written; then existing files do not change.
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
    """Delete the partial files that killed processes have left in a folder and its subfolders, as far as possible."""
    for part in folder.glob("**/.*.part"):
        _remove(part)


def _remove(part: pathlib.Path) -> None:
    with contextlib.suppress(OSError):  # the disk may have become read-only; readers ignore partial files
        part.unlink(missing_ok=True)
