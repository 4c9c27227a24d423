"""Poses of trees that another client simulates."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinesim import frames

if TYPE_CHECKING:
    from vinesim.physics.plants.articulation_solver import ArticulationSolver


def blend_towards(
    plants: ArticulationSolver, tree: int, joint_q: np.ndarray, joint_qd: np.ndarray, blend: float
) -> None:
    """See :meth:`vinesim.physics.plants.articulation_solver.ArticulationSolver.blend_towards`."""
    state, bodies = plants.state, plants.model.bodies_of(tree)
    there, rates = np.asarray(joint_q, np.float32), np.asarray(joint_qd, np.float32)
    here = state.joint_q[bodies]
    if there.shape != here.shape or rates.shape != (len(here), 3):
        raise ValueError(f"tree {tree}: pulled by joints {there.shape}, {rates.shape}; it has {len(here)} bodies")
    there = frames.normalize(there)
    if not np.isfinite(there).all() or not np.isfinite(rates).all() or not (there != 0.0).any(-1).all():
        raise ValueError(f"tree {tree}: pulled to a pose that is not finite or has zero quaternions; drop the update")
    turn = frames.log(frames.multiply(frames.conjugate(here), there))
    state.joint_q[bodies] = frames.normalize(frames.multiply(here, frames.exp(blend * turn)))
    state.joint_qd[bodies] = rates
    state.joint_qd[bodies.start + plants.tree_moving[tree] : bodies.stop] = 0.0  # what rides does not turn
