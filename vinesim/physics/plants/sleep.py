"""Who may fall asleep: a tree that nobody touches and in which nothing turns, for half a second."""

from __future__ import annotations

import numpy as np

from vinesim.physics.plants.articulation_solver import ArticulationSolver

QUIET = 0.02
"""[rad/s] A tree is quiet while every joint turns slower than this."""

PATIENCE = 50
"""[tick] So long must a tree be quiet: longer than the turning point of any swing."""


class SleepMonitor:
    """Counts quiet ticks of the awake trees and puts to rest those that have been quiet for long enough."""

    def __init__(self, plants: ArticulationSolver, *, quiet: float = QUIET, patience: int = PATIENCE) -> None:
        self.plants, self.quiet, self.patience = plants, quiet, patience
        self._busy = np.zeros(len(plants.model.tree_first), bool)
        self.quiet_steps = np.zeros(len(plants.model.tree_first), np.int32)
        """How long each awake tree has been quiet [tree] ticks."""

    @property
    def restless(self) -> np.ndarray:
        """Awake trees that have not been quiet for long: those whose state is news, sorted [k]."""
        awake = self.plants.awake
        return awake[self.quiet_steps[awake] < self.patience]

    def wake(self, trees: np.ndarray) -> None:
        """Wake trees, or keep them awake, for at least ``patience`` ticks from now."""
        trees = np.atleast_1d(trees)
        self.quiet_steps[trees] = 0
        self.plants.wake(trees)

    def update(self, busy: np.ndarray | None = None) -> np.ndarray:
        """After a commit: the trees that have just been put to rest [k].

        ``busy`` [n] are touched or near somebody: they stay awake, however quiet.
        """
        awake = self.plants.awake
        self.quiet_steps[awake] += 1
        self.quiet_steps[awake[~(self.plants.tree_rate[awake] < self.quiet)]] = 0
        quiet = awake[self.quiet_steps[awake] >= self.patience]
        if len(quiet) and busy is not None:
            self._busy[busy] = True
            quiet = quiet[~self._busy[quiet]]
            self._busy[busy] = False
        if len(quiet):
            self.plants.put_to_sleep(quiet)
            self.quiet_steps[quiet] = 0
        return quiet
