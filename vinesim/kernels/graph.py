"""Sequences of kernels on fixed arrays. A sequence is captured once into a Warp graph, then replayed by one call.

``wp.launch`` packs the arguments of a kernel at every launch: 10 us for twenty arguments, longer than most of our
kernels run. A graph keeps them packed: 0.2 us a kernel, and 1.4 us for the call (docs/decisions/kernel-graphs.md).

The number of threads of a launch is part of its graph. The number of items is therefore stored in an array, ``count``
[1] int32, which NumPy or an earlier kernel of the sequence writes. A kernel has at least as many threads as items, and
begins with ``if wp.tid() >= count[0]: return``, which takes a CPU less than a nanosecond. A sequence has a graph for
each number of threads in :data:`TIERS`.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Sequence
from typing import Any

import warp as wp

TIERS = (64, 1024, 16384, 262144, 4194304)
"""Numbers of threads for which graphs are captured.

TUNED: capturing a launch takes 0.3 ms, so there should be few; threads without work take a hundredth of the time of the
others.
"""
THREADS_PER_BLOCK = 32
"""CUDA threads in a block.

One thread is one tree and runs long; small blocks spread few trees over all multiprocessors.
"""

_capturing = threading.Lock()
"""Lock: Warp captures one graph at a time.

No other thread may call ``wp.launch`` during a capture, because it would write to a table that Warp keeps for the
graph.
"""


@dataclasses.dataclass(frozen=True)
class KernelLaunch:
    """A kernel and its arguments: numbers, structs, and arrays that keep their memory."""

    kernel: wp.Kernel
    inputs: Sequence[Any]
    outputs: Sequence[Any] = ()
    threads: int | None = None
    """Number of threads. None: one for each item; the kernel reads the number of items."""
    width: int = 1
    """Threads for each item: the second dimension of ``wp.tid()`` if there are several."""
    block: int = THREADS_PER_BLOCK
    """Threads in a block, on CUDA."""

    def launch(self, items: int, device: wp.Device) -> None:
        """Launch the kernel with room for ``items`` items."""
        rows = items if self.threads is None else self.threads
        dim = rows if self.width == 1 else (rows, self.width)
        wp.launch(self.kernel, dim, inputs=self.inputs, outputs=self.outputs, device=device, block_dim=self.block)


class KernelGraph:
    """Kernel launches that run one after the other."""

    def __init__(self, *launches: KernelLaunch, device: str = "cpu") -> None:
        self._launches = launches
        self._device = wp.get_device(device)
        self._is_cuda = self._device.is_cuda
        self._graphs: dict[int, Any] = {}
        self._graph: Any = None
        self._room = range(0)
        """The capacities for which the graph of the last call was captured."""

    def __call__(self, capacity: int = 1) -> None:
        """Run the launches. No count that their kernels read may be above ``capacity``.

        On CUDA the launches are only queued. Within a capture of the caller they become part of that capture.
        """
        if self._is_cuda and self._device.is_capturing:
            self._launch(tier_of(capacity).stop - 1)
            return
        if capacity not in self._room:
            self._choose(tier_of(capacity))
        wp.capture_launch(self._graph)

    def _launch(self, items: int) -> None:
        for launch in self._launches:
            launch.launch(items, self._device)

    def _choose(self, tier: range) -> None:
        most = tier.stop - 1
        if most not in self._graphs:
            with _capturing, wp.ScopedCapture(self._device) as capture:
                self._launch(most)
            self._graphs[most] = capture.graph
        self._graph = self._graphs[most]
        self._room = tier


def tier_of(capacity: int) -> range:
    """Returns the capacities that share a graph with this one. :class:`ValueError` beyond the last of :data:`TIERS`."""
    least = 0
    for most in TIERS:
        if capacity <= most:
            return range(least, most + 1)
        least = most + 1
    raise ValueError(f"{capacity} items for one launch: there is room for {TIERS[-1]}")
