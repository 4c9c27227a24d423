"""Launches over the awake trees: dealt out to threads on a CPU, captured into a graph on a GPU."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import warp as wp

from vinesim.kernels.launch import ThreadPool
from vinesim.physics.plants.device_buffers import DeviceBuffers
from vinesim.physics.plants.kernel_launches import KernelLaunches

MIN_TREES_PER_THREAD = 16
"""[tree] For fewer awake trees a thread, handing a prediction to other threads costs more than it saves. MEASURED"""

MIN_INTEGRATED_TREES_PER_THREAD = 100
"""[tree] The same for an integration, which is twelve times as short. MEASURED"""


class StepRunner:
    """Runs predictions and integrations of the listed trees.

    Args:
        buffers: of the solver.
        launches: of the solver; bound with as many partitions as there are threads.
        tree_size: [tree] bodies, by which trees are dealt out.
        stepping: [tree] int32, the list that the kernels read.
        thread_pool: who shares the work; none for one thread.
    """

    def __init__(
        self,
        buffers: DeviceBuffers,
        launches: KernelLaunches,
        tree_size: np.ndarray,
        stepping: np.ndarray,
        thread_pool: ThreadPool | None,
    ) -> None:
        self._buffers, self._launches, self._tree_size, self._list = buffers, launches, tree_size, stepping
        self._pool, self._threads = thread_pool, 1 if thread_pool is None else thread_pool.size
        self.stepped = np.zeros(0, np.int32)
        """The trees of this step [k], sorted."""
        self.partition_ends = [0] * (self._threads + 1)
        """Thread i works on ``stepped[partition_ends[i] : partition_ends[i + 1]]``."""
        self._graph: wp.Graph | None = None
        self._graph_of = (-1, -1)
        ends = self.partition_ends

        def part(launch: Callable[..., None], i: int) -> Callable[[], None]:
            return lambda: launch(ends[i + 1] - ends[i], ends[i], i)

        self._parts = {
            launch: [part(launch, i) for i in range(self._threads)] for launch in (launches.predict, launches.integrate)
        }

    def list_trees(self, trees: np.ndarray) -> None:
        """Step these trees [k] from now on; deal them out to the threads by their bodies."""
        if self.stepped is trees:
            return
        self.stepped = trees
        self._list[: len(trees)] = trees
        bodies = np.cumsum(self._tree_size[trees])
        shares = np.arange(self._threads + 1) * (int(bodies[-1]) if len(trees) else 0) // self._threads
        self.partition_ends[:] = np.searchsorted(bodies, shares, side="right").tolist()

    def predict(self) -> None:
        """Predict the listed trees."""
        self._launch(self._launches.predict, MIN_TREES_PER_THREAD)

    def integrate(self, floating: int) -> None:
        """Integrate the listed trees and correct the listed floating roots."""
        self._launch(self._launches.integrate, MIN_INTEGRATED_TREES_PER_THREAD)
        self._launches.correct_floating_momentum(floating)

    def _launch(self, launch: Callable[..., None], least: int) -> None:
        """Launch over the listed trees, on all threads if there are ``least`` for each."""
        if self._pool is None or len(self.stepped) < least * self._threads:
            launch(len(self.stepped))
        else:
            self._pool.run(self._parts[launch])

    def advance(self, steps: int, floating: int) -> None:
        """Predict and integrate so many times without coming back in between."""
        count, ends = len(self.stepped), self.partition_ends
        if count == 0:
            return
        if not self._buffers.device.is_cpu:
            if self._graph is None or self._graph_of != (count, floating):
                with wp.ScopedCapture(self._buffers.device) as capture:
                    self._steps(1, count, floating)
                self._graph, self._graph_of = capture.graph, (count, floating)
            for _ in range(steps):
                wp.capture_launch(self._graph)  # pyright: ignore[reportArgumentType]  (captured above)
            self._buffers.synchronize()
        elif self._pool is None or count < self._threads or floating:
            self._steps(steps, count, floating)
        else:
            parts = [(ends[i + 1] - ends[i], ends[i], i) for i in range(self._threads)]
            self._pool.run([functools.partial(self._steps_of_part, steps, *part) for part in parts])

    def _steps(self, steps: int, count: int, floating: int) -> None:
        for _ in range(steps):
            self._launches.predict(count)
            self._launches.integrate(count)
            self._launches.correct_floating_momentum(floating)

    def _steps_of_part(self, steps: int, count: int, first: int, partition: int) -> None:
        for _ in range(steps):
            self._launches.predict(count, first, partition)
            self._launches.integrate(count, first, partition)
