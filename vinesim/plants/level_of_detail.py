"""Level of detail of bunches: berries move in clusters near actors and watched points, and as one compound elsewhere.

Switching changes no pose and no momentum (:meth:`ArticulationSolver.refine`, :meth:`ArticulationSolver.coarsen`), so
it may happen in any step. A tree is refined in the step in which the bounding box of an actor first overlaps the
tree's. Coarsening waits until no actor has been near for a while and the clusters have come to rest on their bunch.
"""

from __future__ import annotations

import numpy as np

from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.scene.physics_parameters import PhysicsParameters


class LevelOfDetail:
    """Refines the trees that an actor is near to or watches, and coarsens them when no actor is near or watches."""

    def __init__(self, plants: ArticulationSolver, parameters: PhysicsParameters = PhysicsParameters()) -> None:
        """``parameters``: ``detail_duration``, ``detail_rate`` and ``detail_rest_duration`` determine when a tree is
        coarsened."""
        p = parameters
        self.plants = plants
        self.rest_rate = p.detail_rate
        self.fine_steps = p.steps(p.detail_duration)
        self.rest_steps = p.steps(p.detail_rest_duration)
        """Number of successive steps for which the clusters of a tree must have been slow before the tree is coarsened.

        ``fine_steps`` is the number of steps for which a tree stays fine after the last actor has left.
        """
        model = plants.model
        trees = len(model.tree_first)
        self._clustered = np.flatnonzero(model.bunch_clusters > 0)
        self._bodies = model.bunch_body[self._clustered]
        self._tree = model.body_tree[self._bodies]
        self._alone = np.zeros(trees, np.int32)
        self._still = np.zeros(trees, np.int32)
        self._wanted = np.zeros(trees, bool)
        self._points = np.zeros((0, 3))
        self._radius = 0.0
        self._attached = -1
        self._worth = np.zeros(trees, bool)
        self._rated_trees = self._clusters = self._first_cluster = np.zeros(0, np.int64)
        """[k] Index in ``_clusters`` of the first berry cluster of each tree in ``_rated_trees``.

        ``_rated_trees`` [k]: trees of the last call of :meth:`_rate`. ``_clusters`` [n]: bodies of all berry clusters
        of ``_rated_trees``, tree by tree.
        """

    def set_focus(self, points: np.ndarray, radius: float) -> None:
        """Watch ``points`` [n, 3] m until the next call: trees with a bunch within ``radius`` [m] of a point are
        refined."""
        self._points = np.asarray(points, float).reshape(-1, 3)
        self._radius = float(radius)

    @property
    def fine_trees(self) -> np.ndarray:
        """The trees whose clusters move, sorted [k]."""
        return self.plants.state.tree_fine.nonzero()[0]

    def update(self, near: np.ndarray) -> np.ndarray:
        """Refine trees (let their berry clusters move) that an actor is near to or watches, and coarsen trees (lock the
        clusters) that are left alone. Call it before ``predict()``.

        ``near`` [k]: awake trees whose bounding box overlaps an actor's. Returns the trees [k] that were coarsened.
        """
        coarsened = near[:0]
        if len(self._clustered) == 0:
            return coarsened
        plants = self.plants
        state = self.plants.state
        attached = int(np.count_nonzero(state.bunch_attached))
        if attached != self._attached:  # a tree whose bunches are gone has nothing to refine
            self._attached = attached
            self._worth[:] = False
            self._worth[self._tree[state.bunch_attached[self._clustered]]] = True
        wanted = near[self._worth[near]]
        if len(self._points):
            seen = self._seen()
            wanted = np.union1d(wanted, seen) if len(seen) else wanted
        if len(left := self._left_alone(wanted)):
            self._alone[left] += 1
            self._still[left] = np.where(self._rate(left) < self.rest_rate, self._still[left] + 1, 0)
            is_done = (self._alone[left] > self.fine_steps) & (self._still[left] >= self.rest_steps)
            if is_done.any():
                coarsened = left[is_done]
                plants.coarsen(coarsened)
        if len(wanted):
            self._alone[wanted] = self._still[wanted] = 0
            if not state.tree_fine[wanted].all():
                plants.refine(wanted[~state.tree_fine[wanted]])
        return coarsened

    def _left_alone(self, wanted: np.ndarray) -> np.ndarray:
        """Returns the trees [k] with moving berry clusters that are not in ``wanted``."""
        fine = self.fine_trees
        if len(fine) == 0:
            return fine
        self._wanted[wanted] = True
        left = fine[~self._wanted[fine]]
        self._wanted[wanted] = False
        return left

    def _seen(self) -> np.ndarray:
        """Returns the awake trees [k] with a bunch near a watched point, from poses at the start of the last tick."""
        state = self.plants.state
        here = np.flatnonzero(state.tree_awake[self._tree] & state.bunch_attached[self._clustered])
        apart = state.body_q[self._bodies[here], None, :3] - self._points
        close = ((apart * apart).sum(-1) < self._radius * self._radius).any(1)
        return np.unique(self._tree[here[close]])

    def _rate(self, trees: np.ndarray) -> np.ndarray:
        """Returns for each tree the rate [k] rad/s of its fastest cluster relative to the cluster's parent."""
        if not np.array_equal(trees, self._rated_trees):
            model = self.plants.model
            self._rated_trees = trees
            core = model.tree_core[trees]
            count = model.tree_size[trees] - core
            self._first_cluster = np.cumsum(count) - count
            first = np.repeat(model.tree_first[trees] + core - self._first_cluster, count)
            self._clusters = first + np.arange(count.sum())
        rate = self.plants.state.joint_qd[self._clusters]
        return np.sqrt(np.maximum.reduceat((rate * rate).sum(1), self._first_cluster))
