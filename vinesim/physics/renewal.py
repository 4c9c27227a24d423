"""The rigid world compiled anew when somebody comes or goes: all others go on in it exactly where they are."""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim.physics.people import ROUSED

_FREE = mujoco.mjtJoint.mjJNT_FREE
_CONSTRAINT = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
_INIT, _ALLOWED = int(mujoco.mjtSleepPolicy.mjSLEEP_INIT), int(mujoco.mjtSleepPolicy.mjSLEEP_AUTO_ALLOWED)
OF_DOFS = (
    "qvel", "qacc", "qacc_smooth", "qacc_warmstart", "qfrc_smooth", "qfrc_applied", "qfrc_gravcomp",
    "qfrc_actuator",
)  # fmt: skip
"""What MuJoCo keeps of every degree of freedom from one tick to the next."""


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile without contacts: MuJoCo tries a step, in which all robots would stand on one another at the origin."""
    spec.option.disableflags |= _CONSTRAINT
    world = spec.compile()
    world.opt.disableflags &= ~_CONSTRAINT
    return world


def carried(
    old: mujoco.MjModel, old_data: mujoco.MjData, old_contact: np.ndarray, new: mujoco.MjModel, parked: set[str]
) -> tuple[mujoco.MjData, np.ndarray]:
    """State and contact efforts [dof] of a new world: all joints, bodies and sleepers of the old, bit by bit.

    ``parked`` names joints that only seem to be the same ones.
    """
    joints = {old.joint(i).name: i for i in range(old.njnt)}
    pairs = [(i, joints[name]) for i in range(new.njnt) if (name := new.joint(i).name) in joints and name not in parked]
    asleep = _sleepers(old, old_data, new, pairs)
    leaning = _leaning(old, old_data, pairs)
    # Only making its data lets MuJoCo take things for asleep. They lie where they are and depend on nothing.
    for i, j in pairs:
        if new.jnt_type[i] == _FREE:
            to, source, tree = new.jnt_qposadr[i], old.jnt_qposadr[j], int(new.dof_treeid[new.jnt_dofadr[i]])
            new.qpos0[to : to + 7] = old_data.qpos[source : source + 7]
            new.tree_sleep_policy[tree] = _INIT if tree in asleep else _ALLOWED
    new.opt.disableflags |= _CONSTRAINT
    data = mujoco.MjData(new)
    new.opt.disableflags &= ~_CONSTRAINT
    contact = np.zeros(new.nv)
    data.time = old_data.time
    for i, j in pairs:
        q, v = (7, 6) if new.jnt_type[i] == _FREE else (1, 1)
        to_q, from_q, to_v, from_v = new.jnt_qposadr[i], old.jnt_qposadr[j], new.jnt_dofadr[i], old.jnt_dofadr[j]
        data.qpos[to_q : to_q + q] = old_data.qpos[from_q : from_q + q]
        for name in OF_DOFS:
            getattr(data, name)[to_v : to_v + v] = getattr(old_data, name)[from_v : from_v + v]
        contact[to_v : to_v + v] = old_contact[from_v : from_v + v]
        tree, was = new.dof_treeid[to_v], old.dof_treeid[from_v]
        if tree in asleep:
            data.tree_asleep[tree] = asleep[tree]
        elif old_data.tree_asleep[was] < 0:
            data.tree_asleep[tree] = ROUSED if was in leaning else old_data.tree_asleep[was]
    bodies = {old.body(i).name: i for i in range(1, old.nbody)}
    for i in range(1, new.nbody):
        if (j := bodies.get(new.body(i).name)) is not None and new.body(i).name not in parked:
            data.xfrc_applied[i] = old_data.xfrc_applied[j]
            if new.body_mocapid[i] >= 0 and old.body_mocapid[j] >= 0:
                data.mocap_pos[new.body_mocapid[i]] = old_data.mocap_pos[old.body_mocapid[j]]
                data.mocap_quat[new.body_mocapid[i]] = old_data.mocap_quat[old.body_mocapid[j]]
    return data, contact


def _leaning(old: mujoco.MjModel, old_data: mujoco.MjData, pairs: list[tuple[int, int]]) -> set[int]:
    """Trees of the old world that were in touch with one that is gone, or held by it: they may not sleep at once."""
    gone = np.setdiff1d(np.arange(old.ntree), old.dof_treeid[old.jnt_dofadr[[j for _, j in pairs]]])
    islands = np.unique(old_data.tree_island[gone])
    return set(np.flatnonzero(np.isin(old_data.tree_island, islands[islands >= 0])).tolist())


def _sleepers(
    old: mujoco.MjModel, old_data: mujoco.MjData, new: mujoco.MjModel, pairs: list[tuple[int, int]]
) -> dict[int, int]:
    """Trees of the new world that sleep: each with the next of those that wake together.

    Whoever slept leaning on something that is gone wakes, and so does whoever somebody has just roused.
    """
    now = {int(old.dof_treeid[old.jnt_dofadr[j]]): int(new.dof_treeid[new.jnt_dofadr[i]]) for i, j in pairs}
    following = old_data.tree_asleep.tolist()
    asleep = {}
    for first in now:
        tree = first
        while following[tree] >= 0 and tree in now and not old_data.tree_awake[tree]:
            tree = following[tree]
            if tree == first:
                asleep[now[first]] = now[following[first]]
                break
    return asleep
