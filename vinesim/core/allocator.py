"""Settings of glibc's allocator: freed large blocks return to the system at once, freed pages of the heap regularly.

glibc allocates a block with mmap if it is larger than a threshold, and otherwise in the heap. By default it raises the
threshold to the largest block that was ever freed, up to 32 MiB. After the first tables of a vineyard have been freed,
later ones would therefore lie in the heap, which keeps the gaps between them. A threshold set by mallopt(3) stays.

The heap also keeps the gaps between small blocks. On a busy machine messages queue up, and the heap grows whenever the
queue is longer than ever before. So free pages are given back every minute. Other C libraries are left as they are.
"""

from __future__ import annotations

import ctypes
import functools
import gc
import sys
import threading
import time

BLOCK_SIZE = 4 << 20
"""Blocks of at least this size [bytes] lie outside the heap: tables of a scene do, arrays of one picture do not."""

KEPT_SIZE = 64 << 20
"""Free memory kept at the end of the heap [bytes]; glibc keeps the same amount when it sets the threshold itself."""

TRIM_PERIOD = 60.0
"""Period at which free pages are given back to the system [s]."""
_TRIM_THRESHOLD = -1
_MMAP_THRESHOLD = -3
"""Parameter numbers of mallopt(3), from glibc's malloc.h."""


@functools.cache
def _glibc() -> ctypes.CDLL | None:
    """The C library of this process; None unless it is glibc."""
    if sys.platform != "linux":
        return None
    library = ctypes.CDLL(None)
    return library if hasattr(library, "gnu_get_libc_version") else None


def keep_large_blocks_apart() -> None:
    """Let blocks of :data:`BLOCK_SIZE` go back to the system when they are freed. Call it before tables are made."""
    if (library := _glibc()) is not None:
        library.mallopt(_MMAP_THRESHOLD, BLOCK_SIZE)
        library.mallopt(_TRIM_THRESHOLD, KEPT_SIZE)


def trim_regularly(period: float = TRIM_PERIOD) -> None:
    """Give free pages of the heap back to the system every ``period`` [s] from now on, in a thread of its own."""
    if (library := _glibc()) is not None:
        threading.Thread(target=_trim_for_ever, args=(library, period), name="heap trimmer", daemon=True).start()


def _trim_for_ever(library: ctypes.CDLL, period: float) -> None:
    while True:
        time.sleep(period)
        library.malloc_trim(0)


def release_free_memory() -> None:
    """Collect garbage, frozen objects included, and give free pages of the heap back to the system.

    It takes up to a second, so call it only after the world was built or rebuilt.
    """
    frozen = gc.get_freeze_count()
    gc.unfreeze()
    gc.collect()
    if frozen:
        gc.freeze()
    if (library := _glibc()) is not None:
        library.malloc_trim(0)
