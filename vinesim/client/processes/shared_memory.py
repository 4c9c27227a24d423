"""Memory that two processes share. There are three kinds, by what the reader needs:

* :class:`SharedArrays`: single values, such as flags. Both processes use them at any time, without a lock.
* :class:`SharedSnapshot`: arrays that belong together. The reader gets the newest snapshot, and always a whole one.
* :class:`SharedQueue`: records. The reader gets all records in their order. Records that found no room are counted.

The writer never waits. Writing does not wake the reader: a method ``wake`` does, so that a writer can complete its work
first. If all cores are busy, the kernel often runs a process that was woken at once and on the writer's core.
"""

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

    Create the object in one process and pass it to the other process through a pipe. The process that created the
    object frees the memory.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = dict(layout)
        self._memory = SharedMemory(create=True, size=max(self._size(), 1))
        self._is_owner = True
        self._arrays = self._views()

    def __getitem__(self, name: str) -> np.ndarray:
        """Returns the array with this name. Do not use the array after :meth:`close`."""
        return self._arrays[name]

    def _offsets(self) -> dict[str, int]:
        """Returns the offset of each array [bytes], by name, and the end of the last array under the empty name."""
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
        """Release the memory. Its arrays must not be used after that. A second call does nothing."""
        if self._arrays:
            self._arrays = {}
            with contextlib.suppress(BufferError):  # a view still exists, and keeps the memory
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
    """Arrays that one process writes and another process reads as a whole. A new snapshot overwrites the one before.

    Writer and reader hold a lock while they copy. A writer that finds the lock taken leaves the snapshot as it is, and
    a missed write is counted. The next snapshot should then have all changes since the last one that was written.
    """

    def __init__(self, layout: Layout, context: BaseContext) -> None:
        self.arrays = SharedArrays(layout)
        self.missed_writes = 0
        """Number of snapshots that were not written, because the reader was reading."""
        self._is_new = False
        """Whether a snapshot was written after the last :meth:`wake`."""
        self._lock = context.Lock()
        self._written = context.Semaphore(0)

    @contextlib.contextmanager
    def writing(self) -> Iterator[SharedArrays | None]:
        """Context with the arrays to write to. The value is None if the reader is reading now."""
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
        """Wake the reader if a snapshot was written after the last call."""
        if self._is_new:
            self._is_new = False
            self._written.release()

    def wait(self, timeout: float) -> bool:
        """Wait up to ``timeout`` [s] until the writer wakes the reader. Returns whether the writer did so after the
        last call of this method."""
        if not self._written.acquire(timeout=timeout):
            return False
        while self._written.acquire(block=False):
            pass
        return True

    @contextlib.contextmanager
    def reading(self) -> Iterator[SharedArrays]:
        """Context with the arrays to copy from."""
        with self._lock:
            yield self.arrays

    def close(self) -> None:
        """Release the memory and the semaphores. A second call does nothing."""
        self.arrays.close()
        self.__dict__.pop("_lock", None)  # a semaphore is freed with the last reference to it
        self.__dict__.pop("_written", None)


class SharedQueue:
    """A queue with one writer, one reader, and room for ``capacity`` records of one structured type. No record is
    overwritten."""

    def __init__(self, record: np.dtype, capacity: int, context: BaseContext) -> None:
        self.lost = 0
        """Number of records that were lost because the queue was full."""
        self.capacity = capacity
        self._memory = SharedArrays({"records": ((capacity,), record), "put": ((1,), "i8"), "taken": ((1,), "i8")})
        self._free = context.Semaphore(capacity)
        self._filled = context.Semaphore(0)
        self._next = 0
        self._unannounced = 0
        """Number of records that were put after the last :meth:`wake`."""

    @property
    def put_count(self) -> int:
        """Number of records that were put."""
        return int(self._memory["put"][0])

    @property
    def taken_count(self) -> int:
        """Number of records that were taken."""
        return int(self._memory["taken"][0])

    @property
    def waiting_count(self) -> int:
        """Number of records that were put and not taken yet."""
        return self.put_count - self.taken_count

    @contextlib.contextmanager
    def put(self) -> Iterator[Any | None]:
        """Context with the record to fill, which is put at the end of the ``with`` block.

        If the queue is full, the value is None, and the record is counted as lost.
        """
        if not self._free.acquire(block=False):
            self.lost += 1
            yield None
            return
        try:
            yield self._memory["records"][self._next]
        except BaseException:
            self._free.release()
            raise
        self._next = (self._next + 1) % self.capacity
        self._unannounced += 1
        self._memory["put"][0] += 1

    def wake(self) -> None:
        """Wake the reader once for every record that was put after the last call."""
        while self._unannounced:
            self._unannounced -= 1
            self._filled.release()

    def wait(self, timeout: float) -> bool:
        """Returns whether there is a record, after waiting up to ``timeout`` [s] for one."""
        if not self._filled.acquire(timeout=timeout):
            return False
        self._filled.release()
        return True

    def take(self, timeout: float) -> Any | None:
        """Remove the oldest record. Returns a copy of it, or None if there is no record within ``timeout`` [s]."""
        if not self._filled.acquire(timeout=timeout):
            return None
        record = self._memory["records"][self._next].copy()
        self._next = (self._next + 1) % self.capacity
        self._free.release()
        self._memory["taken"][0] += 1  # after the release, so that a writer that reads the count finds room
        return record

    def close(self) -> None:
        """Release the memory and the semaphores. A second call does nothing."""
        self._memory.close()
        self.__dict__.pop("_free", None)  # a semaphore is freed with the last reference to it
        self.__dict__.pop("_filled", None)
