"""Sequences of kernel launches on fixed arrays. A sequence is captured once into a Warp graph, then replayed by one
call.

``wp.launch`` packs the arguments of a kernel at every launch: 10 us for twenty arguments, which is longer than most
kernels of vinesim run. A graph stores packed arguments: 0.2 us a kernel, and 1.4 us for the call
(docs/decisions/kernel-graphs.md).

The number of threads of a launch is part of its graph. The number of items is therefore stored in an array, ``count``
[1] int32, which NumPy or an earlier kernel of the sequence writes. A kernel has at least as many threads as items, and
begins with ``if wp.tid() >= count[0]: return``, which takes a CPU less than a nanosecond. A sequence has a graph for
each number of threads in :data:`TIERS`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

import warp as wp

TIERS = (64, 1024, 16384, 262144, 4194304)
"""Numbers of threads for which a sequence has graphs.

TUNED: capturing a launch takes 0.3 ms, so there should be few numbers; a thread without work takes a hundredth of the
time of a thread with work.
"""
THREADS_PER_BLOCK = 32
"""Number of CUDA threads in a block.

One thread simulates one tree and runs long; small blocks spread few trees over all multiprocessors.
"""

_changed = threading.Condition()
"""Lock of :data:`_users`; it is notified at the end of a capture."""
_users = {"captures": 0, "launches": 0}
"""Number of threads that capture a graph (at most one), and number of calls of :func:`outside_captures` in progress."""


class Launchable(Protocol):
    """What a graph can consist of."""

    def launch(self, items: int, device: wp.Device) -> None:
        """Launch kernels with enough threads for ``items`` items."""


@dataclasses.dataclass(frozen=True)
class ForeignLaunches:
    """Launches by a function of another library, which has no items."""

    function: Callable[[], object]

    def launch(self, items: int, device: wp.Device) -> None:
        """Call the function, with ``device`` as Warp's device."""
        with wp.ScopedDevice(device):
            self.function()


@dataclasses.dataclass(frozen=True)
class KernelLaunch:
    """One launch in a sequence: a kernel and its arguments (numbers, structs, and arrays whose addresses never
    change)."""

    kernel: wp.Kernel
    inputs: Sequence[Any]
    outputs: Sequence[Any] = ()
    threads: int | None = None
    """Number of threads; None: one for each item, where the kernel itself reads the number of items from an array."""
    width: int = 1
    """Number of threads for each item; if above 1, the second dimension of ``wp.tid()``."""
    block: int = THREADS_PER_BLOCK
    """Number of threads in a CUDA block."""

    def launch(self, items: int, device: wp.Device) -> None:
        """Launch the kernel with enough threads for ``items`` items."""
        rows = items if self.threads is None else self.threads
        dim = rows if self.width == 1 else (rows, self.width)
        wp.launch(self.kernel, dim, inputs=self.inputs, outputs=self.outputs, device=device, block_dim=self.block)


class KernelGraph:
    """A sequence of kernel launches that one call runs in order, as a captured Warp graph."""

    def __init__(self, *launches: Launchable, device: str = "cpu") -> None:
        self._launches = launches
        self._device = wp.get_device(device)
        self._is_cuda = self._device.is_cuda
        self._graphs: dict[int, Any] = {}
        self._graph: Any = None
        self._room = range(0)
        """Range of capacities that the graph of the last call can serve."""

    def __call__(self, capacity: int = 1) -> None:
        """Run the launches in order; the numbers of items that their kernels read must not exceed ``capacity``.

        The first call for a number of threads captures the graph; while another thread uses Warp, the call launches
        the kernels one by one instead. On CUDA the call returns when the launches are queued. If the caller is capturing a graph, the launches become
        part of it.
        """
        if self._is_cuda and self._device.is_capturing:
            self._launch(tier_of(capacity).stop - 1)
            return
        if capacity in self._room or self._choose(tier_of(capacity)):
            wp.capture_launch(self._graph)
            return
        with outside_captures():
            self._launch(tier_of(capacity).stop - 1)

    def _launch(self, items: int) -> None:
        for launch in self._launches:
            launch.launch(items, self._device)

    def _choose(self, tier: range) -> bool:
        """Whether there is now a graph for ``tier``, which later calls use; not if another thread uses Warp."""
        most = tier.stop - 1
        if most not in self._graphs:
            with _begin_capture() as may_capture:
                if not may_capture:
                    return False
                with wp.ScopedCapture(self._device) as capture:
                    self._launch(most)
            self._graphs[most] = capture.graph
        self._graph = self._graphs[most]
        self._room = tier
        return True


@contextlib.contextmanager
def outside_captures() -> Iterator[None]:
    """Context, also a decorator, in which a thread may call Warp while another thread may call a :class:`KernelGraph`.

    Warp captures for the whole process: a launch or a copy of any thread would become part of the graph that another
    thread captures, and would not run. So the context waits for the end of a capture [ms], and none begins before its
    own end.
    """
    with _changed:
        _changed.wait_for(lambda: not _users["captures"])
        _users["launches"] += 1
    try:
        yield
    finally:
        with _changed:
            _users["launches"] -= 1


@contextlib.contextmanager
def _begin_capture() -> Iterator[bool]:
    """Context of a capture; its value is False if another thread captures or launches now, and this one may not."""
    with _changed:
        is_free = not any(_users.values())
        _users["captures"] += is_free
    try:
        yield is_free
    finally:
        with _changed:
            _users["captures"] -= is_free
            _changed.notify_all()


def tier_of(capacity: int) -> range:
    """Returns the range of capacities that share one graph with ``capacity``.

    Raises :class:`ValueError` if ``capacity`` exceeds the last of :data:`TIERS`.
    """
    least = 0
    for most in TIERS:
        if capacity <= most:
            return range(least, most + 1)
        least = most + 1
    raise ValueError(f"{capacity} items in one launch; the largest number is {TIERS[-1]}")
