"""Removes shared memory of Fast DDS whose process was killed. Otherwise 24 MiB of each sensor process stay until boot.

Fast DDS keeps a lock (flock) on ``NAME_el`` while the owner of segment ``NAME`` lives; its own ``fastdds shm clean``
goes by the same lock. Readers that still have a removed segment mapped keep it until they unmap it.

The port files of Fast DDS are left: they take 52 KB each, and the next node with that number uses them again.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pathlib
import time
from collections.abc import Iterator

log = logging.getLogger(__name__)

FOLDER = pathlib.Path("/dev/shm")
SMALLEST = 4 << 20
"""The smallest segment of vinesim's profiles [B]. Smaller ones, such as the 0.5 MiB of Fast DDS itself, are left."""
YOUNGEST = 60.0
"""A segment younger than this may belong to a process that is about to lock it [s]."""


def dead_segments(folder: pathlib.Path = FOLDER) -> Iterator[tuple[pathlib.Path, pathlib.Path]]:
    """Large segments of this user whose owner is dead, each with its lock file. The file stays locked until the next
    segment is taken."""
    try:
        import fcntl
    except ImportError:
        return  # no such system has Fast DDS's locks
    for path in (*folder.glob("fastrtps_*"), *folder.glob("fastdds_*")):
        lock = path.with_name(f"{path.name}_el")
        with contextlib.suppress(OSError):  # gone, locked, or of another user: not ours to remove
            status = path.stat()
            is_ours = status.st_size >= SMALLEST and status.st_uid == os.getuid()
            if not is_ours or time.time() - status.st_mtime < YOUNGEST:
                continue
            with lock.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                yield path, lock


def remove_dead_segments(folder: pathlib.Path = FOLDER) -> int:
    """Remove large segments of this user whose owner is dead. Returns their number. The log has their number and
    size."""
    removed = size = 0
    for path, lock in dead_segments(folder):
        with contextlib.suppress(OSError):  # another process removes them as well
            length = path.stat().st_size
            path.unlink()
            lock.unlink()
            removed = removed + 1
            size = size + length
    if removed:
        log.info("removed %d shared-memory segments (%.0f MB) that killed processes left", removed, size / 1e6)
    return removed
