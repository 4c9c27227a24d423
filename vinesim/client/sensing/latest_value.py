"""A value in shared memory, written by one process and read by another: only the newest is kept, no writer waits."""

from __future__ import annotations

import multiprocessing
import multiprocessing.context
import select
import struct
from collections.abc import Callable
from multiprocessing.shared_memory import SharedMemory
from typing import Protocol

_HEAD = struct.Struct("<QQ")
"""Sequence number and size [bytes] of the value that follows."""


class LatestValue:
    """One writer, one reader. Create it in the writer's process and pass it to the reader's when that is spawned."""

    def __init__(self, capacity: int, context: multiprocessing.context.BaseContext) -> None:
        """``capacity``: size of the largest value [bytes]."""
        self.capacity = capacity
        self.missed_writes = 0
        """Values that were not written because the reader held the lock."""
        self._memory = SharedMemory(create=True, size=_HEAD.size + capacity)
        self._buffer[: _HEAD.size] = bytes(_HEAD.size)
        self._lock = context.Lock()
        self._written = context.Semaphore(0)
        self._sequence = 0
        self._owner = True

    @property
    def _buffer(self) -> memoryview:
        assert self._memory.buf is not None, "closed"
        return self._memory.buf

    def put(self, value: bytes) -> bool:
        """Replace the value; False if the reader is just reading, and then the value is lost.

        :class:`ValueError` if it is larger than ``capacity``.
        """
        if len(value) > self.capacity:
            raise ValueError(f"value of {len(value)} bytes for a capacity of {self.capacity}")
        if not self._lock.acquire(block=False):
            self.missed_writes += 1
            return False
        try:
            self._sequence += 1
            end = _HEAD.size + len(value)
            self._buffer[_HEAD.size : end] = value
            self._buffer[: _HEAD.size] = _HEAD.pack(self._sequence, len(value))
        finally:
            self._lock.release()
        self._written.release()
        return True

    def take(self, timeout: float) -> bytes | None:
        """The newest value unless it was taken before; waits up to ``timeout`` [s] for one, then None."""
        if not self._written.acquire(timeout=timeout):
            return None
        while self._written.acquire(block=False):
            pass
        with self._lock:
            sequence, size = _HEAD.unpack(self._buffer[: _HEAD.size])
            if sequence == self._sequence:
                return None
            self._sequence = sequence
            return bytes(self._buffer[_HEAD.size : _HEAD.size + size])

    def close(self) -> None:
        """Release the memory and the semaphores; the process that created them frees them."""
        self._memory.close()
        if self._owner:
            self._memory.unlink()
        del self._lock, self._written  # a semaphore is freed with the last reference to it

    def __getstate__(self) -> dict:
        return {**self.__dict__, "_owner": False, "_sequence": 0}


class Pipe(Protocol):
    """The end of a pipe, as far as it is polled."""

    def poll(self, timeout: float = ...) -> bool: ...

    def fileno(self) -> int: ...


def make_poll(pipe: Pipe) -> Callable[[], bool]:
    """A function that tells whether a pipe can be read; with ``select.poll`` in a tenth of ``pipe.poll``'s time."""
    if not hasattr(select, "poll"):
        return pipe.poll
    poll = select.poll()
    poll.register(pipe.fileno(), select.POLLIN)
    return lambda: bool(poll.poll(0))
