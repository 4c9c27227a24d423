"""A letter box between two processes in which only the newest letter lies: the writer never waits for the reader."""

from __future__ import annotations

import multiprocessing
import multiprocessing.context
import select
import struct
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.shared_memory import SharedMemory

_HEAD = struct.Struct("<QQ")


class LatestValue:
    """One writer, one reader. Make it in the writer's process and hand it to the reader's when that is spawned."""

    def __init__(self, capacity: int, context: multiprocessing.context.BaseContext) -> None:
        """``capacity``: the largest letter [bytes]."""
        self.capacity = capacity
        self.missed_writes = 0
        """Letters that were not written because the reader was just taking one."""
        self._memory = SharedMemory(create=True, size=_HEAD.size + capacity)
        self._memory.buf[: _HEAD.size] = bytes(_HEAD.size)
        self._lock = context.Lock()
        self._news = context.Semaphore(0)
        self._number = 0
        self._owner = True

    def put(self, value: bytes) -> bool:
        """Leave a letter in the place of the last one. False if the reader has its hand in the box: try again."""
        if len(value) > self.capacity:
            raise ValueError(f"letter of {len(value)} bytes for a mailbox of {self.capacity}")
        if not self._lock.acquire(block=False):
            self.missed_writes += 1
            return False
        try:
            self._number += 1
            end = _HEAD.size + len(value)
            self._memory.buf[_HEAD.size : end] = value
            self._memory.buf[: _HEAD.size] = _HEAD.pack(self._number, len(value))
        finally:
            self._lock.release()
        self._news.release()
        return True

    def take(self, timeout: float) -> bytes | None:
        """The newest letter, if one came that was not taken yet; waits for one up to ``timeout`` [s]."""
        if not self._news.acquire(timeout=timeout):
            return None
        while self._news.acquire(block=False):
            pass
        with self._lock:
            number, size = _HEAD.unpack(self._memory.buf[: _HEAD.size])
            if number == self._number:
                return None
            self._number = number
            return bytes(self._memory.buf[_HEAD.size : _HEAD.size + size])

    def close(self) -> None:
        """Let go of the memory and the semaphores; their owner frees them."""
        self._memory.close()
        if self._owner:
            self._memory.unlink()
        del self._lock, self._news  # a semaphore is freed with the last reference to it

    def __getstate__(self) -> dict:
        return {**self.__dict__, "_owner": False, "_number": 0}


def poller(pipe: Connection) -> Callable[[], bool]:
    """Whether a pipe has something to read; by ``select.poll`` where there is one, a tenth of ``pipe.poll``'s time."""
    if not hasattr(select, "poll"):
        return pipe.poll
    poll = select.poll()
    poll.register(pipe.fileno(), select.POLLIN)
    return lambda: bool(poll.poll(0))
