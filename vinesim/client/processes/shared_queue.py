"""A queue of records in shared memory, from one process to another: none is replaced, each lost one is counted.

Putting a record does not wake the reader, :meth:`SharedQueue.wake` does: where all cores are busy the kernel often runs
the process that was woken at once and on the same core, in the middle of the writer's work.
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
        """Records that found no room."""
        self.capacity = capacity
        self._memory = SharedArrays({"records": ((capacity,), record), "put": ((1,), "i8"), "taken": ((1,), "i8")})
        self._free = context.Semaphore(capacity)
        self._filled = context.Semaphore(0)
        self._next = 0
        self._unannounced = 0
        """Records that were put since the reader was woken last."""

    @property
    def put_count(self) -> int:
        """Records that were put."""
        return int(self._memory["put"][0])

    @property
    def taken_count(self) -> int:
        """Records that were taken."""
        return int(self._memory["taken"][0])

    @property
    def waiting_count(self) -> int:
        """Records that were put and not taken yet."""
        return self.put_count - self.taken_count

    @contextlib.contextmanager
    def put(self) -> Iterator[Any | None]:
        """The record to fill, put when the block is left; None if there is no room, which is counted."""
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
        """Let the reader take what was put."""
        while self._unannounced:
            self._unannounced -= 1
            self._filled.release()

    def take(self, timeout: float) -> Any | None:
        """The oldest record, a copy; waits up to ``timeout`` [s] for one, then None."""
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
