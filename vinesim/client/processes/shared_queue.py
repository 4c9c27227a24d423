"""A queue of records in shared memory, from one process to another. No record is overwritten; lost ones are counted.

Putting a record does not wake the reader; :meth:`SharedQueue.wake` does. If all cores are busy, the kernel often runs
a process that was woken at once and on the same core, in the middle of the writer's work.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from multiprocessing.context import BaseContext
from typing import Any

import numpy as np

from vinesim.client.processes.shared_arrays import SharedArrays


class SharedQueue:
    """One writer, one reader, and room for ``capacity`` records of one structured type. The writer never waits."""

    def __init__(self, record: np.dtype, capacity: int, context: BaseContext) -> None:
        self.lost = 0
        """Number of records that were lost because the queue was full."""
        self.capacity = capacity
        self._memory = SharedArrays({"records": ((capacity,), record), "put": ((1,), "i8"), "taken": ((1,), "i8")})
        self._free = context.Semaphore(capacity)
        self._filled = context.Semaphore(0)
        self._next = 0
        self._unannounced = 0
        """Number of records that were put since the reader was last woken."""

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
        """Context with the record to fill, which is put at the end of the ``with`` block. If the queue is full, the
        value is None and the record is counted as lost."""
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
        """Wake the reader, so that it takes the records that were put."""
        while self._unannounced:
            self._unannounced -= 1
            self._filled.release()

    def take(self, timeout: float) -> Any | None:
        """Remove the oldest record and return a copy. Waits up to ``timeout`` [s] for one, then returns None."""
        if not self._filled.acquire(timeout=timeout):
            return None
        record = self._memory["records"][self._next].copy()
        self._next = (self._next + 1) % self.capacity
        self._free.release()
        self._memory["taken"][0] += 1  # after the release, so that whoever reads it finds the room
        return record

    def close(self) -> None:
        """Release the memory and the semaphores; a second call does nothing."""
        self._memory.close()
        self.__dict__.pop("_free", None)  # a semaphore is freed with the last reference to it
        self.__dict__.pop("_filled", None)
