"""The rigid world compiled anew when somebody comes or goes: all others go on in it exactly where they are."""

from __future__ import annotations

import mujoco
import numpy as np

from vinesim.physics.rigid.human_body import WAKE_COUNTER

_FREE = mujoco.mjtJoint.mjJNT_FREE
_CONSTRAINT = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
_INIT, _ALLOWED = int(mujoco.mjtSleepPolicy.mjSLEEP_INIT), int(mujoco.mjtSleepPolicy.mjSLEEP_AUTO_ALLOWED)
DOF_ARRAYS = (
    "qvel", "qacc", "qacc_smooth", "qacc_warmstart", "qfrc_smooth", "qfrc_applied", "qfrc_gravcomp",
    "qfrc_actuator",
)  # fmt: skip
"""What MuJoCo keeps of every degree of freedom from one tick to the next."""


def compile_without_contacts(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile without contacts: MuJoCo tries a step, in which all robots would stand on one another at the origin."""
    spec.option.disableflags |= _CONSTRAINT
    world = spec.compile()
    world.opt.disableflags &= ~_CONSTRAINT
    return world


def object_names(m: mujoco.MjModel, of: np.ndarray) -> list[str]:
    """Names of all joints, bodies or the like, ``of`` being MuJoCo's ``name_jntadr``, ``name_bodyadr`` and so on."""
    text = m.names
    return [text[at : text.index(b"\0", at)].decode() for at in of.tolist()]


def transfer_state(
    old: mujoco.MjModel, old_data: mujoco.MjData, old_contact: np.ndarray, new: mujoco.MjModel, parked: set[str]
) -> tuple[mujoco.MjData, np.ndarray]:
    """State and contact efforts [dof] of a new world: all joints, bodies and sleepers of the old, bit by bit.

    ``parked`` names joints that only seem to be the same ones.
    """
    pairs = _pairs(object_names(new, new.name_jntadr), object_names(old, old.name_jntadr), parked)
    to, source = np.array(pairs, int).reshape(-1, 2).T
    asleep = _sleepers(old, old_data, new, pairs)
    leaning = _leaning(old, old_data, source)
    # Only making its data lets MuJoCo take things for asleep. They lie where they are and depend on nothing.
    free = new.jnt_type[to] == _FREE
    to_q, from_q = (_spread(m.jnt_qposadr[joint], np.where(free, 7, 1)) for m, joint in ((new, to), (old, source)))
    to_v, from_v = (_spread(m.jnt_dofadr[joint], np.where(free, 6, 1)) for m, joint in ((new, to), (old, source)))
    lying = np.repeat(free, np.where(free, 7, 1))
    new.qpos0[to_q[lying]] = old_data.qpos[from_q[lying]]
    for tree in np.unique(new.dof_treeid[new.jnt_dofadr[to[free]]]).tolist():
        new.tree_sleep_policy[tree] = _INIT if tree in asleep else _ALLOWED
    new.opt.disableflags |= _CONSTRAINT
    data = mujoco.MjData(new)
    new.opt.disableflags &= ~_CONSTRAINT
    contact = np.zeros(new.nv)
    data.time = old_data.time
    data.qpos[to_q], contact[to_v] = old_data.qpos[from_q], old_contact[from_v]
    for name in DOF_ARRAYS:
        getattr(data, name)[to_v] = getattr(old_data, name)[from_v]
    trees = set(zip(new.dof_treeid[to_v].tolist(), old.dof_treeid[from_v].tolist(), strict=True))
    for tree, was in sorted(trees):
        if tree in asleep:
            data.tree_asleep[tree] = asleep[tree]
        elif old_data.tree_asleep[was] < 0:
            data.tree_asleep[tree] = WAKE_COUNTER if was in leaning else old_data.tree_asleep[was]
    bodies = _pairs(object_names(new, new.name_bodyadr), object_names(old, old.name_bodyadr), parked)
    to, source = np.array(bodies, int).reshape(-1, 2).T
    data.xfrc_applied[to] = old_data.xfrc_applied[source]
    to, source = new.body_mocapid[to], old.body_mocapid[source]
    led = (to >= 0) & (source >= 0)
    data.mocap_pos[to[led]], data.mocap_quat[to[led]] = (
        old_data.mocap_pos[source[led]],
        old_data.mocap_quat[source[led]],
    )
    return data, contact


def _pairs(new: list[str], old: list[str], parked: set[str]) -> list[tuple[int, int]]:
    """(number in the new world, number in the old) of whatever is in both."""
    was = {name: number for number, name in enumerate(old)}
    return [(number, was[name]) for number, name in enumerate(new) if name in was and name not in parked]


def _spread(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """``count`` [k] numbers in a row from each ``first`` [k]."""
    return np.repeat(first - (np.cumsum(count) - count), count) + np.arange(count.sum())


def _leaning(old: mujoco.MjModel, old_data: mujoco.MjData, staying: np.ndarray) -> set[int]:
    """Trees of the old world that were in touch with one that is gone, or held by it: they may not sleep at once."""
    gone = np.setdiff1d(np.arange(old.ntree), old.dof_treeid[old.jnt_dofadr[staying]])
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
