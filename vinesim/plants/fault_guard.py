"""Faults: a tree whose motion is not finite or too fast is stopped, put to sleep and reported. All other trees
continue.

``ArticulationSolver.integrate()`` does not integrate a tree in which a rate is not finite or above
``ArticulationSolver.fault_rate``. The joints of this tree keep their state at the start of the tick, which is the last
valid one. This module finds such trees after the integration.
"""

from __future__ import annotations

import dataclasses
import logging

import numpy as np

from vinesim.plants.articulation_solver import ArticulationSolver

log = logging.getLogger(__name__)

MAX_PENDING_FAULTS = 1000
"""Largest number of faults that are stored for the log between two reports. :attr:`FaultGuard.count` counts all
faults."""
_NO_TREES = np.zeros(0, np.int32)


@dataclasses.dataclass(frozen=True, slots=True)
class Fault:
    """One tree that was stopped."""

    tick: int
    tree: int
    rate: float
    """[rad/s] Rate that the fastest joint would have had at the end of the tick; may be NaN."""


class FaultGuard:
    """Finds trees that the solver refused to integrate, and puts them to sleep in their last valid pose."""

    def __init__(self, plants: ArticulationSolver) -> None:
        self.plants = plants
        self.count = np.zeros(len(plants.model.tree_first), np.int32)
        """[tree] Number of faults of each tree so far."""
        self.slowed = 0
        """Number of times that a tree moved faster than ``max_rate`` and was slowed to it, which removes energy from
        the tree."""
        self._faults: list[Fault] = []

    def stop_faulty_trees(self) -> np.ndarray:
        """Put the trees to sleep that the last integration has stopped, and return them [k]. :meth:`report` writes the
        log."""
        plants = self.plants
        state = self.plants.state
        awake = plants.awake
        fastest = plants.fastest_rate()
        if fastest <= plants.max_rate and fastest <= plants.fault_rate:
            return _NO_TREES
        rate = plants.tree_rate[awake]
        stopped = awake[~(rate <= plants.fault_rate)]
        self.slowed += int(np.count_nonzero(rate > plants.max_rate)) - int(np.count_nonzero(rate > plants.fault_rate))
        if len(stopped) == 0:
            return stopped
        self.count[stopped] += 1
        rates = plants.tree_rate[stopped].tolist()
        room = max(MAX_PENDING_FAULTS - len(self._faults), 0)
        self._faults += [Fault(plants.tick, *what) for what in zip(stopped.tolist(), rates, strict=True)][:room]
        bodies = plants.bodies_of(stopped)
        length = np.square(state.joint_q[bodies], dtype=float).sum(-1)
        unsound = bodies[~(abs(length - 1.0) < 0.01)]  # an invalid pose was written from outside: no valid one is left
        state.joint_q[unsound] = plants.joint_settled[unsound]
        cut = bodies[state.body_cut[bodies]]
        state.joint_xd[cut] = 0.0
        lost = cut[~np.isfinite(state.joint_x[cut]).all(-1)]
        if len(lost):
            state.joint_x[lost] = plants.model.forward_kinematics(plants.model.joint_settled)[lost, :3]  # where it grew
        loads = plants.body_load[bodies]
        plants.body_load[bodies] = np.where(np.isfinite(loads), loads, 0.0)
        plants.put_to_sleep(stopped)
        return stopped

    def report(self) -> list[Fault]:
        """Log the faults since the last report and return them. Call it outside a step."""
        faults = self._faults
        self._faults = []
        for fault in faults:
            log.warning("tree %d stopped in tick %d at %g rad/s; it rests", fault.tree, fault.tick, fault.rate)
        return faults
