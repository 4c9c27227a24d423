"""Settings of glibc's allocator: freed large blocks return to the system at once, freed pages of the heap every minute.

glibc allocates a block with mmap if it is larger than a threshold, and otherwise in the heap. By default it raises the
threshold to the largest block that was ever freed, up to 32 MiB. After the first large tables of a vineyard have been
freed, later tables would therefore be allocated in the heap, and the heap keeps the gaps that they leave. glibc does
not raise a threshold that mallopt(3) has set.

The heap also keeps the gaps between small blocks. On a busy machine messages queue up, and each new longest queue makes
the heap grow. So free pages are returned to the system every minute. With other C libraries these functions do nothing.
"""

from __future__ import annotations

import ctypes
import functools
import gc
import sys
import threading
import time

BLOCK_SIZE = 4 << 20
"""Least size [bytes] of a block that is allocated outside the heap. Tables of a scene are larger, arrays of one picture
are smaller."""

KEPT_SIZE = 64 << 20
"""Free memory that stays at the end of the heap [bytes]. It is the largest amount that glibc would choose itself."""

TRIM_PERIOD = 60.0
"""Period at which free pages are given back to the operating system [s]."""
_TRIM_THRESHOLD = -1
_MMAP_THRESHOLD = -3
"""Number of the parameter M_MMAP_THRESHOLD of mallopt(3), from glibc's malloc.h; ``_TRIM_THRESHOLD`` likewise."""


@functools.cache
def _glibc() -> ctypes.CDLL | None:
    """Returns the C library of this process; None unless it is glibc."""
    if sys.platform != "linux":
        return None
    library = ctypes.CDLL(None)
    return library if hasattr(library, "gnu_get_libc_version") else None


def keep_large_blocks_apart() -> None:
    """Set the allocator to give blocks of at least :data:`BLOCK_SIZE` back to the operating system as soon as they are
    freed. Call it before large tables are allocated.
    """
    if (library := _glibc()) is not None:
        library.mallopt(_MMAP_THRESHOLD, BLOCK_SIZE)
        library.mallopt(_TRIM_THRESHOLD, KEPT_SIZE)


def trim_regularly(period: float = TRIM_PERIOD) -> None:
    """Start a thread that gives free pages of the heap back to the operating system every ``period`` [s]."""
    if (library := _glibc()) is not None:
        threading.Thread(target=_trim_for_ever, args=(library, period), name="heap trimmer", daemon=True).start()


def _trim_for_ever(library: ctypes.CDLL, period: float) -> None:
    while True:
        time.sleep(period)
        library.malloc_trim(0)


def release_free_memory() -> None:
    """Collect garbage, including objects frozen by ``gc.freeze``, and give free pages of the heap back to the operating
    system.

    This takes up to a second, so call it only after the world was built or rebuilt.
    """
    frozen = gc.get_freeze_count()
    gc.unfreeze()
    gc.collect()
    if frozen:
        gc.freeze()
    if (library := _glibc()) is not None:
        library.malloc_trim(0)
