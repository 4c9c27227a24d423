"""Sleep of trees: one that nothing touches and in which no joint turns is put to sleep after half a second."""

from __future__ import annotations

import numpy as np

from vinesim.physics.parameters import PhysicsParameters
from vinesim.physics.plants.articulation_solver import ArticulationSolver


class SleepMonitor:
    """Counts quiet steps of the awake trees and puts to sleep those that have been quiet for long enough."""

    def __init__(self, plants: ArticulationSolver, parameters: PhysicsParameters = PhysicsParameters()) -> None:
        """``parameters``: :attr:`sleep_rate` and :attr:`sleep_duration` say what is quiet, and for how long."""
        self.plants, self.rate = plants, parameters.sleep_rate
        self.patience = parameters.steps(parameters.sleep_duration)
        """Steps that a tree must be quiet."""
        self._busy = np.zeros(len(plants.model.tree_first), bool)
        self.quiet_steps = np.zeros(len(plants.model.tree_first), np.int32)
        """How long each awake tree has been quiet [tree] steps."""

    @property
    def restless(self) -> np.ndarray:
        """Awake trees that have not been quiet for long, whose state is still changing, sorted [k]."""
        awake = self.plants.awake
        return awake[self.quiet_steps[awake] < self.patience]

    def wake(self, trees: np.ndarray) -> None:
        """Wake trees, or keep them awake, for at least ``patience`` steps from now. :class:`ValueError` as in
        :meth:`ArticulationSolver.wake`."""
        trees = np.atleast_1d(trees)
        self.plants.wake(trees)
        self.quiet_steps[trees] = 0

    def update(self, busy: np.ndarray | None = None) -> np.ndarray:
        """After a commit: the trees that have just been put to rest [k].

        ``busy`` [n] are in contact or near an actor: they stay awake, however quiet.
        """
        awake = self.plants.awake
        self.quiet_steps[awake] += 1
        self.quiet_steps[awake[~(self.plants.tree_rate[awake] < self.rate)]] = 0
        quiet = awake[self.quiet_steps[awake] >= self.patience]
        if len(quiet) and busy is not None:
            self._busy[busy] = True
            quiet = quiet[~self._busy[quiet]]
            self._busy[busy] = False
        if len(quiet):
            self.plants.put_to_sleep(quiet)
            self.quiet_steps[quiet] = 0
        return quiet
