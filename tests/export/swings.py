"""Modes of some joints of a MuJoCo model, and frequencies of recorded swings."""

from __future__ import annotations

import mujoco
import numpy as np
import scipy.linalg


def modes(world: mujoco.MjModel, hinges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the frequencies [k] Hz of the dofs ``hinges`` [k] about the start pose, all others at rest, and the
    shapes [k, k] of the modes as columns."""
    data = mujoco.MjData(world)
    mujoco.mj_forward(world, data)
    M = np.zeros((world.nv, world.nv))
    mujoco.mj_fullM(world, data, M)
    start = data.qpos.copy()
    adr = np.array([world.jnt_qposadr[world.dof_jntid[dof]] for dof in hinges])
    K = np.zeros((len(hinges), len(hinges)))
    for column, place in enumerate(adr):
        sides = []
        for change in (1e-6, -1e-6):
            data.qpos[:] = start
            data.qpos[place] += change
            mujoco.mj_fwdPosition(world, data)
            mujoco.mj_fwdVelocity(world, data)
            sides.append((data.qfrc_passive - data.qfrc_bias)[hinges])
        K[:, column] = (sides[1] - sides[0]) / 2e-6
    squares, shapes = scipy.linalg.eigh(0.5 * (K + K.T), M[np.ix_(hinges, hinges)])
    return np.sqrt(squares) / (2.0 * np.pi), shapes


def crossing_frequency(signal: np.ndarray, dt: float) -> float:
    """Returns the frequency [Hz] of a swing about 0 from the times of its first and last crossing of 0."""
    at = np.flatnonzero((signal[:-1] < 0) != (signal[1:] < 0))
    times = (at + signal[at] / (signal[at] - signal[at + 1])) * dt
    return (len(times) - 1) / (2.0 * (times[-1] - times[0]))
