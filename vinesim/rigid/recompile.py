"""Recompiles a MuJoCo world without changing the state of its bodies, and wakes sleeping bodies."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

AWAKE_COUNTER = -1 - mujoco.mjMINAWAKE
"""Value of MuJoCo's ``tree_asleep`` for a kinematic tree that was just woken. MuJoCo adds 1 in each step; at -1 the
tree may sleep.
"""


def wake_body(m: mujoco.MjModel, d: mujoco.MjData, body: int) -> None:
    """Wake the kinematic tree of a MuJoCo ``body``, or restart the sleep counter of an awake tree.

    MuJoCo wakes the tree because ``tree_awake`` and ``tree_asleep`` then disagree. Without the restart, an object at
    rest in a hand would fall asleep in the step in which it is released.
    """
    tree = m.body_treeid[body]
    if tree >= 0:
        d.tree_awake[tree] = 1
        if d.tree_asleep[tree] < 0:
            d.tree_asleep[tree] = AWAKE_COUNTER


def keep_touching_awake(m: mujoco.MjModel, d: mujoco.MjData, body: int) -> None:
    """Restart the sleep counters of all kinematic trees that touch the tree of ``body``, because they may lose their
    support."""
    island = d.tree_island[m.body_treeid[body]]
    touching = (d.tree_island == island) & (d.tree_asleep < 0)
    if island >= 0:
        d.tree_asleep[touching] = AWAKE_COUNTER


# Recompiles a MuJoCo world and copies the state of all bodies that stay, exactly.


_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_CONSTRAINT = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
_NEVER, _INIT, _ALLOWED = (
    int(getattr(mujoco.mjtSleepPolicy, f"mjSLEEP_{policy}")) for policy in ("NEVER", "INIT", "AUTO_ALLOWED")
)
DOF_ARRAYS = (
    "qvel",
    "qacc",
    "qacc_smooth",
    "qacc_warmstart",
    "qfrc_smooth",
    "qfrc_applied",
    "qfrc_gravcomp",
    "qfrc_actuator",
)
"""Names of the arrays of ``MjData`` with one entry for each degree of freedom, whose values persist from step to step.
"""


def compile_without_contacts(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile ``spec`` with contacts disabled, because MuJoCo's compiler computes a step in which all robots overlap at
    the origin."""
    spec.option.disableflags |= _CONSTRAINT
    world = spec.compile()
    world.opt.disableflags &= ~_CONSTRAINT
    return world


@dataclasses.dataclass(frozen=True)
class WorldNames:
    """Indices of a compiled world's objects by name, in dictionaries, because MuJoCo's look-up takes 80 us a name."""

    joints: list[str]
    bodies: list[str]
    joint: dict[str, int]
    body: dict[str, int]
    actuator: dict[str, int]
    equality: dict[str, int]

    @classmethod
    def of(cls, m: mujoco.MjModel) -> WorldNames:
        """Returns the names and indices of all objects of a compiled world."""
        lists = [object_names(m, at) for at in (m.name_jntadr, m.name_bodyadr, m.name_actuatoradr, m.name_eqadr)]
        return cls(lists[0], lists[1], *({name: i for i, name in enumerate(names)} for names in lists))


def object_names(m: mujoco.MjModel, address: np.ndarray) -> list[str]:
    """Returns the names of all joints, bodies or other objects; ``address``: MuJoCo's ``name_jntadr``, ``name_bodyadr``
    etc."""
    text = m.names
    return [text[at : text.index(b"\0", at)].decode() for at in address.tolist()]


def transfer_state(
    old: mujoco.MjModel,
    old_names: WorldNames,
    old_data: mujoco.MjData,
    old_contact: np.ndarray,
    new: mujoco.MjModel,
    new_names: WorldNames,
    unused: set[str],
) -> tuple[mujoco.MjData, np.ndarray]:
    """Returns the state of a new world and its contact forces [dof], copied by name from joints and bodies of the old
    one.

    Sleeping trees stay asleep.

    Args:
        old: the old model.
        old_names: names of its objects.
        old_data: its state.
        old_contact: [dof] generalised contact forces of the last step in the old world.
        new: the new model; ``qpos0`` and sleep policies of bodies that stay are overwritten.
        new_names: names of its objects.
        unused: names of free joints that exist in both worlds but belong to different objects.
    """
    pairs = _pairs(new_names.joints, old_names.joints, unused)
    to, source = np.array(pairs, int).reshape(-1, 2).T
    asleep = _sleeping_trees(old, old_data, new, pairs)
    touched_removed = _trees_touching_removed(old, old_data, source)
    # MuJoCo puts trees to sleep when its data is created, at qpos0; so qpos0 is set to the present state
    free = new.jnt_type[to] == _FREE
    to_q, from_q = (_ranges(m.jnt_qposadr[joint], np.where(free, 7, 1)) for m, joint in ((new, to), (old, source)))
    to_v, from_v = (_ranges(m.jnt_dofadr[joint], np.where(free, 6, 1)) for m, joint in ((new, to), (old, source)))
    of_free = np.repeat(free, np.where(free, 7, 1))
    new.qpos0[to_q[of_free]] = old_data.qpos[from_q[of_free]]
    for tree in np.unique(new.dof_treeid[new.jnt_dofadr[to[free]]]).tolist():
        if new.tree_sleep_policy[tree] != _NEVER:  # _NEVER: parts of people, whose masses change
            new.tree_sleep_policy[tree] = _INIT if tree in asleep else _ALLOWED
    new.opt.disableflags |= _CONSTRAINT
    data = mujoco.MjData(new)
    new.opt.disableflags &= ~_CONSTRAINT
    contact = np.zeros(new.nv)
    data.time = old_data.time
    data.qpos[to_q] = old_data.qpos[from_q]
    contact[to_v] = old_contact[from_v]
    for name in DOF_ARRAYS:
        getattr(data, name)[to_v] = getattr(old_data, name)[from_v]
    trees = set(zip(new.dof_treeid[to_v].tolist(), old.dof_treeid[from_v].tolist(), strict=True))
    for tree, was in sorted(trees):
        if tree in asleep:
            data.tree_asleep[tree] = asleep[tree]
        elif old_data.tree_asleep[was] < 0:
            data.tree_asleep[tree] = AWAKE_COUNTER if was in touched_removed else old_data.tree_asleep[was]
    bodies = _pairs(new_names.bodies, old_names.bodies, unused)
    to, source = np.array(bodies, int).reshape(-1, 2).T
    data.xfrc_applied[to] = old_data.xfrc_applied[source]
    to = new.body_mocapid[to]
    source = old.body_mocapid[source]
    mocap = (to >= 0) & (source >= 0)
    data.mocap_pos[to[mocap]] = old_data.mocap_pos[source[mocap]]
    data.mocap_quat[to[mocap]] = old_data.mocap_quat[source[mocap]]
    return data, contact


def _pairs(new: list[str], old: list[str], unused: set[str]) -> list[tuple[int, int]]:
    """Returns (index in the new world, index in the old world) of every name that exists in both, except ``unused``."""
    was = {name: number for number, name in enumerate(old)}
    return [(number, was[name]) for number, name in enumerate(new) if name in was and name not in unused]


def _ranges(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Returns concatenated ranges of integers: ``count[i]`` consecutive numbers from ``first[i]``, for each i."""
    return np.repeat(first - (np.cumsum(count) - count), count) + np.arange(count.sum())


def _trees_touching_removed(old: mujoco.MjModel, old_data: mujoco.MjData, staying: np.ndarray) -> set[int]:
    """Returns trees of the old world that a removed tree touched or held, and which therefore must not stay asleep."""
    gone = np.setdiff1d(np.arange(old.ntree), old.dof_treeid[old.jnt_dofadr[staying]])
    islands = np.unique(old_data.tree_island[gone])
    return set(np.flatnonzero(np.isin(old_data.tree_island, islands[islands >= 0])).tolist())


def _sleeping_trees(
    old: mujoco.MjModel, old_data: mujoco.MjData, new: mujoco.MjModel, pairs: list[tuple[int, int]]
) -> dict[int, int]:
    """Returns the sleeping trees of the new world, each with the next tree of its cycle (MuJoCo's ``tree_asleep``).

    The trees of a cycle wake together. Trees that slept in a cycle with a removed tree, or were just woken, are left
    out.
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
