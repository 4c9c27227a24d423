"""Threads that share the tasks of a picture or a scan.

Warp and MuJoCo release the interpreter's lock while they compute, so threads of Python run them on several cores.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

MAX_THREADS = 4
"""Largest number of CPU threads that share a picture or a scan. More threads bring no gain."""


def usable_cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class ThreadPool:
    """Threads that share tasks with the caller of :meth:`share`."""

    def __init__(self, size: int) -> None:
        """``size``: number of threads that work at the same time, including the caller of :meth:`share`."""
        self.size = size
        self._executor = ThreadPoolExecutor(size - 1, "thread pool") if size > 1 else None

    def share(self, tasks: Sequence[Callable[[], None]]) -> None:
        """Run ``tasks`` and return when all are done. Each thread takes the next task as soon as it is free.

        If a task raises an exception, its thread takes no further tasks, and ``share`` raises the exception at the end.
        """
        queue = iter(tasks)  # one iterator of a list serves all threads, because its steps are atomic

        def work() -> None:
            for task in queue:
                task()

        helpers = min(self.size, len(tasks)) - 1
        futures = [self._executor.submit(work) for _ in range(helpers)] if self._executor else []
        try:
            work()
        finally:
            # A helper thread that has not begun by now has no task left, so it is cancelled.
            failures = [future.exception() for future in futures if not future.cancel()]
        for failure in filter(None, failures):
            raise failure
