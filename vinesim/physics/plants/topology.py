"""Topology: which trees have the same bodies on the same parents, so that one vector can hold them side by side."""

from __future__ import annotations

import numpy as np

from vinesim.kernels.articulation.lane_records import LANES
from vinesim.scene.model import Model


class Topologies:
    """Numbers of topologies, equal for trees whose kernels walk from parent to child alike.

    Args:
        model: its trees.
        body_cut: [body] bool, what has been cut off; such a tree shares its topology with none.
        tree_moving: [tree] bodies that move: all of a tree's, or all but its berry clusters.
    """

    def __init__(self, model: Model, body_cut: np.ndarray, tree_moving: np.ndarray) -> None:
        self._model, self._body_cut, self._moving = model, body_cut, tree_moving
        known: dict[bytes, int] = {}
        parent = np.maximum(model.body_parent - model.tree_first[model.body_tree], -1).astype(np.int32)

        def number(first: int, size: int) -> int:
            return known.setdefault(parent[first : first + size].tobytes(), len(known))

        sizes = (model.tree_core.tolist(), model.tree_size.tolist())
        first = model.tree_first.tolist()
        self._coarse, self._fine = (np.array([*map(number, first, size)], np.int64) for size in sizes)

    def of(self, trees: np.ndarray) -> np.ndarray:
        """Numbers of the topologies of trees [k], as they are now [k]."""
        is_fine = self._moving[trees] == self._model.tree_size[trees]
        cut = self._model.body_tree[np.flatnonzero(self._body_cut)]
        alone = -1 - trees.astype(np.int64)
        return np.where(np.isin(trees, cut), alone, np.where(is_fine, self._fine[trees], self._coarse[trees]))


def group_starts(topologies: np.ndarray, whole: int) -> np.ndarray:
    """Where groups of up to eight trees begin in a list, and its end.

    Neighbours of one topology [k] go together, but none of the first ``whole`` trees with any of the others.
    """
    place = np.arange(len(topologies))
    differs = np.ones(len(topologies), bool)
    differs[1:] = (topologies[1:] != topologies[:-1]) | (place[1:] == whole)
    run = np.maximum.accumulate(np.where(differs, place, 0))
    return np.append(np.flatnonzero((place - run) % LANES == 0), len(topologies)).astype(np.int32)
