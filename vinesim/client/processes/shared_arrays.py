"""NumPy arrays in memory that two processes share, and a snapshot of such arrays, which a newer one overwrites."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Mapping
from multiprocessing.context import BaseContext
from multiprocessing.shared_memory import SharedMemory
from typing import Any

import numpy as np

Layout = Mapping[str, tuple[tuple[int, ...], Any]]
"""Shape and type of each array, by name."""

_ALIGNMENT = 64
"""Alignment of the first byte of each array [bytes]: a cache line."""


class SharedArrays:
    """Arrays of fixed shapes in one block of shared memory, zero at first.

    Create it in one process and pass it to the other when that is spawned, or through a pipe. The process that created
    it frees the memory.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = dict(layout)
        self._memory = SharedMemory(create=True, size=max(self._size(), 1))
        self._is_owner = True
        self._arrays = self._views()

    def __getitem__(self, name: str) -> np.ndarray:
        """The array of a name; do not keep it longer than this object is open."""
        return self._arrays[name]

    def _offsets(self) -> dict[str, int]:
        """Offset of the first byte of each array, by name, and the end of the last array under the empty name."""
        offsets = {}
        end = 0
        for name, (shape, dtype) in self.layout.items():
            offsets[name] = end
            end += -(-math.prod(shape) * np.dtype(dtype).itemsize // _ALIGNMENT) * _ALIGNMENT
        return offsets | {"": end}

    def _size(self) -> int:
        return self._offsets()[""]

    def _views(self) -> dict[str, np.ndarray]:
        offsets = self._offsets()
        return {
            name: np.ndarray(shape, dtype, buffer=self._memory.buf, offset=offsets[name])
            for name, (shape, dtype) in self.layout.items()
        }

    def close(self) -> None:
        """Release the memory. Arrays taken from here must not be used after that. A second call does nothing."""
        if self._arrays:
            self._arrays = {}
            with contextlib.suppress(BufferError):  # a view still exists, and the memory lives as long as that
                self._memory.close()
            if self._is_owner:
                self._memory.unlink()

    def __getstate__(self) -> dict[str, Any]:
        return {"layout": self.layout, "name": self._memory.name}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.layout = state["layout"]
        self._is_owner = False
        self._memory = SharedMemory(name=state["name"])
        self._arrays = self._views()


class SharedSnapshot:
    """Arrays that one process writes and another reads as a whole. The writer never waits. The reader has the newest.

    Both hold a lock while they copy. A writer that finds the lock taken leaves the snapshot as it is and counts a
    missed write. It should write the next time, with all changes since. Writing does not wake the reader; :meth:`wake`
    does.
    """

    def __init__(self, layout: Layout, context: BaseContext) -> None:
        self.arrays = SharedArrays(layout)
        self.missed_writes = 0
        """Number of snapshots that were not written because the reader was reading."""
        self._is_new = False
        """Whether a snapshot was written since the reader was last woken."""
        self._lock = context.Lock()
        self._written = context.Semaphore(0)

    @contextlib.contextmanager
    def writing(self) -> Iterator[SharedArrays | None]:
        """The arrays to write to; None if the reader is reading now."""
        if not self._lock.acquire(block=False):
            self.missed_writes += 1
            yield None
            return
        try:
            yield self.arrays
        finally:
            self._lock.release()
            self._is_new = True

    def wake(self) -> None:
        """Wake the reader if a snapshot was written since it was last woken."""
        if self._is_new:
            self._is_new = False
            self._written.release()

    def wait(self, timeout: float) -> bool:
        """Wait up to ``timeout`` [s] for the writer's :meth:`wake`. Returns whether it was called since the last
        call of this method."""
        if not self._written.acquire(timeout=timeout):
            return False
        while self._written.acquire(block=False):
            pass
        return True

    @contextlib.contextmanager
    def reading(self) -> Iterator[SharedArrays]:
        """The arrays, to be copied from."""
        with self._lock:
            yield self.arrays

    def close(self) -> None:
        """Release the memory and the semaphores; a second call does nothing."""
        self.arrays.close()
        self.__dict__.pop("_lock", None)  # a semaphore is freed with the last reference to it
        self.__dict__.pop("_written", None)
