"""Launches over the awake trees: in groups of one topology on a CPU, captured into a graph on a GPU.

A tree whose first mode is too fast for the step takes substeps instead, of which all others see the sum:
:mod:`vinesim.kernels.articulation.first_mode` says how many. While contacts act on it, it takes the whole step that
they were solved for; and so does always a tree that is tied to wires, which move once a step.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from vinesim.kernels.articulation.energy_budget import NO_BUDGET
from vinesim.physics.plants.device_buffers import DeviceBuffers
from vinesim.physics.plants.kernel_launches import KernelLaunches, Step
from vinesim.physics.plants.topology import Topologies, group_starts

Levels = tuple[int, ...]
"""How many of a list take a first, a second, a third substep."""


class StepRunner:
    """Runs predictions and integrations of the listed trees.

    The list that the kernels read has the trees of one step first, then the others, those of most substeps first. On a
    CPU those of one topology are neighbours within that order and are predicted in groups of up to eight; on a GPU each
    tree is a group.

    Args:
        buffers: of the solver.
        launches: of the solver.
        tree_substeps: [tree] into how many substeps each tree's step is to be divided.
        tree_steps: [tree] into how many it is divided now, which the kernels read.
        tree_budget: [tree] how each tree's energy is watched.
        whole: [tree] bool, trees on wires, whose steps are never divided.
        tree_rate: [tree] what the kernels write of each tree's speed.
        stepping: [tree] int32, the list that the kernels read.
        groups: [tree, 2] int32, groups that the kernels read: first place in the list, number of trees.
        floating: [tree] int32, the floating roots that the kernels read.
        topologies: of the trees.
    """

    def __init__(
        self,
        buffers: DeviceBuffers,
        launches: KernelLaunches,
        *,
        tree_substeps: np.ndarray,
        tree_steps: np.ndarray,
        tree_budget: np.ndarray,
        whole: np.ndarray,
        tree_rate: np.ndarray,
        stepping: np.ndarray,
        groups: np.ndarray,
        floating: np.ndarray,
        topologies: Topologies,
    ) -> None:
        self._buffers, self._launches, self._list = buffers, launches, stepping
        self._substeps, self._steps_of, self._rate, self._floating = tree_substeps, tree_steps, tree_rate, floating
        self._is_whole, self._budget_kind = whole, tree_budget
        self.stepped = np.zeros(0, np.int32)
        """The trees of this step [k], sorted."""
        self.is_stepped = np.zeros(len(tree_rate), np.bool_)
        """Which these are [tree]."""
        self.fast = np.zeros(0, np.int32)
        """Those of them whose step is to be divided [k], sorted."""
        self._whole, self._levels, self._roots, self._root_levels = 0, (), 0, ()
        self._divided = np.zeros(0, np.int32)
        """Into how many substeps the steps of ``fast`` were divided when the list was put in order [k]."""
        self._graph: wp.Graph | None = None
        self._graph_of: tuple = ()
        self._groups, self._topologies = groups, topologies
        self._starts = np.zeros(1, np.int32)
        """Place in the list at which each group begins, and the end of the list."""
        self._whole_groups = 0
        """Groups of the trees of whole steps: the first ones."""

    # ------------------------------------------------------------------ which trees, in which order

    def list_trees(self, trees: np.ndarray) -> None:
        """Step these trees [k] from now on, as the model is now; count their substeps if one of both has changed."""
        self._launches.upload_changed()
        if self.stepped is trees and not self._launches.substeps_due:
            return
        self._launches.substeps_due = False
        self.is_stepped[self.stepped] = False
        self.is_stepped[trees] = True
        self.stepped = trees
        self._list[: len(trees)] = trees
        self._launches.count_substeps(len(trees))
        self._launches.choose_budget(len(trees))
        self._buffers.synchronize()
        self._budget_kind[trees[self._is_whole[trees]]] = NO_BUDGET  # a wire that moves does work on them
        self._launches.list_budgets(trees[self._budget_kind[trees] != NO_BUDGET])
        self.fast = trees[(self._substeps[trees] > 1) & ~self._is_whole[trees]]
        self._steps_of[trees] = 1
        self._divided = np.ones(len(self.fast), np.int32)
        self._order()

    def _order(self) -> None:
        """List the trees by what ``_steps_of`` says of each."""
        trees, on_cpu = self.stepped, self._buffers.device.is_cpu
        topologies = self._topologies.of(trees)
        if on_cpu:
            order = np.argsort(topologies, kind="stable")
            trees, topologies = trees[order], topologies[order]
        listed, self._whole, self._levels = _by_substeps(np.arange(len(trees)), self._steps_of[trees])
        trees, topologies = trees[listed], topologies[listed]
        self._list[: len(trees)] = trees
        in_groups = self._launches.predict_groups is not None
        self._starts = group_starts(topologies, self._whole) if in_groups else np.arange(len(trees) + 1)
        counts = np.diff(self._starts)
        self._groups[: len(counts), 0], self._groups[: len(counts), 1] = self._starts[:-1], counts
        self._whole_groups = int(np.searchsorted(self._starts, self._whole))

    def _divide(self, touched: np.ndarray) -> None:
        """Divide the coming step of all fast trees but those ``touched`` [k]."""
        if len(self.fast) == 0:
            return
        steps = self._substeps[self.fast]
        if len(touched):
            steps[np.isin(self.fast, touched)] = 1
        self._steps_of[self.fast] = steps
        self._rate[self.fast] = 0.0
        if not np.array_equal(steps, self._divided):
            self._divided = steps
            self._order()

    def _list_roots(self, roots: np.ndarray, trees: np.ndarray) -> None:
        """List floating roots [k] (places of bodies) of trees [k] as their trees are listed."""
        if len(roots) == 0:
            self._roots, self._root_levels = 0, ()
            return
        order, self._roots, self._root_levels = _by_substeps(np.arange(len(roots)), self._steps_of[trees])
        self._floating[: len(roots)] = roots[order]

    # ------------------------------------------------------------------ a step

    def predict(self) -> None:
        """Predict the listed trees over the whole step."""
        if len(self.fast):
            self._steps_of[self.fast] = 1
        self._launches.shared.predict_groups(len(self._starts) - 1)

    def integrate(self, touched: np.ndarray, roots: np.ndarray, root_trees: np.ndarray) -> None:
        """Integrate the listed trees, those that are fast and not ``touched`` [k] in substeps.

        ``roots`` [j]: places of floating roots, of trees ``root_trees`` [j].
        """
        self._divide(touched)
        self._list_roots(roots, root_trees)
        self._launches.look_for_budgets()
        self._launches.integrate(self._whole)
        self._launches.correct_floating_momentum(self._roots)
        self._take_substeps(self._launches.shared)

    def _take_substeps(self, step: Step) -> None:
        roots, first = self._root_levels, self._whole
        for level, count in enumerate(self._levels):
            step.predict(count, first)
            step.integrate(count, first)
            if level < len(roots):
                step.correct_floating_momentum(roots[level], self._roots)

    # ------------------------------------------------------------------ many steps

    def advance(
        self, steps: int, roots: np.ndarray, root_trees: np.ndarray, between: Callable[[], None] | None = None
    ) -> None:
        """Predict and integrate so many times without coming back in between; ``between`` launches what comes there."""
        self._divide(np.zeros(0, np.int32))
        self._list_roots(roots, root_trees)
        count = len(self.stepped)
        if count == 0:
            return
        self._launches.look_for_budgets(steps)
        self._launches.upload_trees()
        if not self._buffers.device.is_cpu:
            what = (self._whole, self._levels, self._roots, self._root_levels, between)
            if self._graph is None or self._graph_of != what:
                with wp.ScopedCapture(self._buffers.device) as capture:
                    self._steps(1, between)
                self._graph, self._graph_of = capture.graph, what
            for _ in range(steps):
                wp.capture_launch(self._graph)  # pyright: ignore[reportArgumentType]  (captured above)
        else:
            self._steps(steps, between)
        self._launches.download_trees()
        self._buffers.synchronize()

    def _steps(self, steps: int, between: Callable[[], None] | None) -> None:
        step = self._launches.resident
        for _ in range(steps):
            step.predict_groups(self._whole_groups)
            if between is not None:
                between()
            step.integrate(self._whole)
            step.correct_floating_momentum(self._roots)
            self._take_substeps(step)


def _levels(steps: np.ndarray) -> Levels:
    """How many of some numbers of substeps [k] are above 0, above 1, and so on."""
    return tuple(int(np.count_nonzero(steps > level)) for level in range(int(steps.max(initial=0))))


def _by_substeps(items: np.ndarray, steps: np.ndarray) -> tuple[np.ndarray, int, Levels]:
    """Items [k] of so many substeps each: those of one step first, then by falling number; how many of each."""
    whole = steps == 1
    rest = items[~whole][np.argsort(-steps[~whole], kind="stable")]
    return np.concatenate([items[whole], rest]), int(np.count_nonzero(whole)), _levels(steps[~whole])
