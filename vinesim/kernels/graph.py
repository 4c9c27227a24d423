"""Sequences of kernels on fixed arrays, each made by one call: captured once into a graph of Warp, then replayed.

``wp.launch`` packs the arguments of a kernel at every launch: 10 us for twenty arguments, more than most of our kernels
run. A graph keeps them: 0.2 us a kernel, and 1.4 us for the call (docs/decisions/kernel-graphs.md).

The number of threads of a launch is part of its graph. So how many items there are stands in an array, ``count`` [1]
int32, which NumPy or an earlier kernel of the sequence writes. A kernel has more threads than items, and begins with
``if wp.tid() >= count[0]: return``, which takes a CPU less than a nanosecond. A sequence has a graph for each number of
threads in :data:`TIERS`.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Sequence
from typing import Any

import warp as wp

TIERS = (64, 1024, 16384, 262144, 4194304)
"""Numbers of threads. TUNED: to capture a launch takes 0.3 ms, so that there should be few; the threads without work take
a hundredth of the time of the others."""
THREADS_PER_BLOCK = 32
"""CUDA threads a block. One thread is one tree and runs long: small blocks spread few trees over all multiprocessors."""

_capturing = threading.Lock()
"""Warp captures one graph at a time. No other thread may call ``wp.launch`` meanwhile: Warp keeps a table for the graph
that it would write to as well."""


@dataclasses.dataclass(frozen=True)
class KernelLaunch:
    """A kernel and its arguments: numbers, structs, and arrays that stay where they are."""

    kernel: wp.Kernel
    inputs: Sequence[Any]
    outputs: Sequence[Any] = ()
    threads: int | None = None
    """How many it has; None: one for each item, of which it reads how many there are."""
    width: int = 1
    """Threads for each item: the second dimension of ``wp.tid()`` if there are several."""
    block: int = THREADS_PER_BLOCK
    """Threads of a block, on CUDA."""

    def launch(self, items: int, device: wp.Device) -> None:
        """Launch it with room for so many items."""
        rows = items if self.threads is None else self.threads
        dim = rows if self.width == 1 else (rows, self.width)
        wp.launch(self.kernel, dim, inputs=self.inputs, outputs=self.outputs, device=device, block_dim=self.block)


class KernelGraph:
    """Launches that follow each other."""

    def __init__(self, *launches: KernelLaunch, device: str = "cpu") -> None:
        self._launches = launches
        self._device = wp.get_device(device)
        self._is_cuda = self._device.is_cuda
        self._graphs: dict[int, Any] = {}
        self._graph: Any = None
        self._room = range(0)
        """The graph of the last call, and the capacities that it is for."""

    def __call__(self, capacity: int = 1) -> None:
        """Make the launches; no count that their kernels read may be above ``capacity``.

        On CUDA they are only queued, and within a capture of the caller's they become part of that.
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
    """The capacities that share a graph with this one; :class:`ValueError` beyond the last of :data:`TIERS`."""
    least = 0
    for most in TIERS:
        if capacity <= most:
            return range(least, most + 1)
        least = most + 1
    raise ValueError(f"{capacity} items for one launch: there is room for {TIERS[-1]}")
