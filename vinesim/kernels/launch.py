"""Launches of kernels whose arguments are packed once, and a pool of threads that share one launch.

Warp packs a kernel's arguments again at every CPU launch, recorded or not: 10 us for twenty arguments, longer than most
of our kernels run. :func:`bind_launch` packs them once; the launch then only calls the compiled function: 1 us. That
call releases the interpreter lock, so Python threads can run a kernel side by side on parts of its list; see
:class:`ThreadPool`.
"""

import ctypes
import dataclasses
import os
import threading
from collections.abc import Callable, Sequence
from typing import Protocol, cast

import warp as wp

from vinesim.kernels.graph import THREADS_PER_BLOCK

MAX_THREADS = 4
"""Largest number of CPU threads that share a picture or a scan. More threads bring no gain."""


@dataclasses.dataclass(frozen=True)
class PackedLaunch:
    """The addresses that native code needs to make a launch."""

    head: tuple[int, int, int]
    """Address of the kernel, address of the list, bytes of an entry. The last two are 0 without a list."""
    parts: tuple[tuple[int, int, int, int, int], ...]
    """For each partition the addresses of its bounds, of their shape and their size, and of its arguments, and the
    address at which these arguments store the address of the list."""


class BoundLaunch(Protocol):
    """A kernel on its arrays: ``launch(threads, first, partition)``, see :func:`bind_launch`."""

    packed: PackedLaunch | None
    """The launch with its arguments packed in advance.

    None on CUDA, with another Warp version, and for several kernels.
    """
    job: ctypes.Array | None
    """Job that :meth:`vinesim.kernels.shared_launch.LaunchPool.share` made for the threads of a pool; else None."""

    def __call__(self, threads: int, first: int = 0, partition: int = 0) -> None: ...


def bind_launch(
    kernel: wp.Kernel,
    inputs: list,
    outputs: list,
    *,
    device: str = "cpu",
    index_list: str = "",
    partitions: int = 1,
    block: int = THREADS_PER_BLOCK,
) -> BoundLaunch:
    """Returns a function that launches ``kernel`` with ``threads`` [first argument] threads on these arrays and
    structs.

    The arrays must keep their memory; the function holds Warp's handles of them. ``index_list`` names a list argument
    of which thread i takes entry i. With it, the CPU function also takes ``first``, the entry of its first thread, and
    ``partition``, a number below ``partitions`` that no other Python thread uses at the same time. ``block`` is for
    CUDA.
    """
    commands = [
        wp.launch(kernel, 1, inputs=inputs, outputs=outputs, device=device, record_cmd=True, block_dim=block)
        for _ in range(partitions)
    ]
    at = kernel.arg_indices[index_list] if index_list else -1
    if not wp.get_device(device).is_cpu:
        return _recorded(commands, inputs, at)
    try:
        calls = []
        parts = []
        no_list = ctypes.c_int64()
        for command in commands:
            bounds = command.params[0]
            values = command.params[1:]
            fields = [(arg.label, type(value)) for arg, value in zip(kernel.adj.args, values, strict=True)]
            packed = type("Arguments", (ctypes.Structure,), {"_fields_": fields})(*values)
            listed = getattr(packed, index_list) if index_list else None
            calls.append((bounds, bounds.shape, listed, ctypes.byref(bounds), ctypes.byref(packed)))
            at_bounds = ctypes.addressof(bounds)
            fields_of = type(bounds)
            at_list = ctypes.addressof(no_list if listed is None else listed)
            parts.append(
                (
                    at_bounds,
                    at_bounds + fields_of.shape.offset,
                    at_bounds + fields_of.size.offset,
                    ctypes.addressof(packed),
                    at_list + (0 if listed is None else type(listed).data.offset),
                )
            )
        forward = commands[0].hooks.forward
        start, step = (listed.data, inputs[at].strides[0]) if index_list else (0, 0)
        address = ctypes.cast(forward, ctypes.c_void_p).value or 0
    except (AttributeError, TypeError, ValueError):  # another Warp: its own way, at its own speed
        return _recorded(commands, inputs, at)

    def launch(threads: int, first: int = 0, partition: int = 0) -> None:
        if threads:
            bounds, shape, listed, at_bounds, at_packed = calls[partition]
            if listed is not None:
                listed.data = start + first * step
            shape[0] = bounds.size = threads
            forward(at_bounds, at_packed)

    launch.keeps = (commands, inputs, outputs, calls, no_list)  # type: ignore[attr-defined]
    return bound(launch, PackedLaunch((address, start, step), tuple(parts)))


def bound(
    launch: Callable[..., None], packed: PackedLaunch | None = None, job: ctypes.Array | None = None
) -> BoundLaunch:
    """Returns a function that launches kernels one after the other, as a :class:`BoundLaunch`."""
    # type: ignore[attr-defined]
    launch.packed = packed
    launch.job = job
    return cast(BoundLaunch, launch)


def join_partitions(launches: Sequence[BoundLaunch]) -> BoundLaunch:
    """Returns one launch whose partition i is the only partition of ``launches[i]``, for kernels with memory per
    thread.
    """

    def launch(threads: int, first: int = 0, partition: int = 0) -> None:
        launches[partition](threads, first)

    packed = [one.packed for one in launches]
    parts = tuple(one.parts[0] for one in packed if one is not None)
    return bound(launch, PackedLaunch(packed[0].head, parts) if packed[0] is not None else None)


def _recorded(commands: list[wp.Launch], inputs: list, at: int) -> BoundLaunch:
    """Returns Warp's own replay, which CUDA uses and which can be captured into a graph."""
    starts = [0] * len(commands)

    def launch(threads: int, first: int = 0, partition: int = 0) -> None:
        if threads:
            if at >= 0 and first != starts[partition]:
                commands[partition].set_param_at_index(at, inputs[at][first:])
                starts[partition] = first
            commands[partition].set_dim(threads)
            commands[partition].launch()

    return bound(launch)


def usable_cores() -> int:
    """Returns the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class ThreadPool:
    """Threads that wait for work and share it with the caller of :meth:`run`.

    A hand-over costs 10 to 30 us: worth it for work of 100 us and more.
    """

    def __init__(self, size: int) -> None:
        """``size``: number of threads that work at once, including the caller of :meth:`run`."""
        self.size = size
        self._work: list[Callable[[], None] | None] = [None] * size
        self._failed: list[BaseException] = []
        self._start = [threading.Lock() for _ in range(size)]
        self._done = [threading.Lock() for _ in range(size)]
        for i in range(1, size):
            self._start[i].acquire()
            self._done[i].acquire()
            loop = (self._work, self._failed, self._start[i], self._done[i], i)
            threading.Thread(target=_wait_and_work, args=loop, name=f"thread pool {i}", daemon=True).start()

    def run(self, works: Sequence[Callable[[], None]]) -> None:
        """Do all of ``works`` [1 to ``size``] at once and return when all are done."""
        for i in range(1, len(works)):
            self._work[i] = works[i]
            self._start[i].release()
        try:
            works[0]()
        finally:
            for i in range(1, len(works)):
                self._done[i].acquire()
            failed = self._failed[:]
            self._failed.clear()
        if failed:
            raise failed[0]

    def share(self, tasks: Sequence[Callable[[], None]]) -> None:
        """Do any number of ``tasks``, each by whichever thread is free next, and return when all are done."""
        queue = iter(tasks)

        def work() -> None:
            for task in queue:  # one iterator of a list serves all threads: its steps are atomic
                task()

        if tasks:
            self.run([work] * min(self.size, len(tasks)))

    def close(self) -> None:
        """End the threads."""
        size = self.size
        self.size = 1
        for i in range(1, size):
            self._work[i] = None
            self._start[i].release()

    def __del__(self) -> None:
        self.close()


def _wait_and_work(
    work: list[Callable[[], None] | None],
    failed: list[BaseException],
    start: threading.Lock,
    done: threading.Lock,
    i: int,
) -> None:
    while True:
        start.acquire()
        mine = work[i]
        work[i] = None
        if mine is None:
            return
        try:
            mine()
        except BaseException as error:  # raised again in the caller of run()
            failed.append(error)
        del mine  # keep no arrays alive while waiting
        done.release()
