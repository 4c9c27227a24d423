"""Removes shared-memory segments of Fast DDS whose process was killed. Otherwise 24 MiB of each killed sensor process
would stay until the machine restarts.

Fast DDS keeps a lock (flock) on the file ``NAME_el`` while the owner of segment ``NAME`` lives. Its own tool ``fastdds
shm clean`` tests the same lock. A reader that has a removed segment mapped can use the segment until it unmaps it.

Port files of Fast DDS are not removed: they take 52 KB each, and the next participant with that port uses them again.
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
"""Size of the smallest segment that is removed [B]. Segments of vinesim's profiles are larger, those of Fast DDS's
own default (0.5 MiB) are smaller."""
YOUNGEST = 60.0
"""Age below which a segment is not removed [s], because it may belong to a process that is about to lock it."""


def dead_segments(folder: pathlib.Path = FOLDER) -> Iterator[tuple[pathlib.Path, pathlib.Path]]:
    """Yield each large segment of this user whose owner is dead, with its lock file. The lock file stays locked
    until the iterator goes on."""
    try:
        import fcntl
    except ImportError:
        return  # systems without fcntl have no locks of Fast DDS
    for path in (*folder.glob("fastrtps_*"), *folder.glob("fastdds_*")):
        lock = path.with_name(f"{path.name}_el")
        with contextlib.suppress(OSError):  # removed meanwhile, locked, or of another user
            status = path.stat()
            is_ours = status.st_size >= SMALLEST and status.st_uid == os.getuid()
            if not is_ours or time.time() - status.st_mtime < YOUNGEST:
                continue
            with lock.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                yield path, lock


def remove_dead_segments(folder: pathlib.Path = FOLDER) -> int:
    """Remove the large segments of this user whose owner is dead, and log their number and size. Returns their
    number."""
    removed = size = 0
    for path, lock in dead_segments(folder):
        with contextlib.suppress(OSError):  # another process may remove the same segment
            length = path.stat().st_size
            path.unlink()
            lock.unlink()
            removed = removed + 1
            size = size + length
    if removed:
        log.info("removed %d shared-memory segments (%.0f MB) that killed processes left", removed, size / 1e6)
    return removed
