"""Wakes bodies that MuJoCo has put to sleep."""

from __future__ import annotations

import mujoco

AWAKE_COUNTER = -1 - mujoco.mjMINAWAKE
"""[step] Value of ``tree_asleep`` of a tree that has just been woken; MuJoCo counts it up to -1, then it may sleep."""


def wake_body(m: mujoco.MjModel, d: mujoco.MjData, body: int) -> None:
    """Wake the kinematic tree of a body: MuJoCo does so when ``tree_awake`` and ``tree_asleep`` disagree.

    A tree that is awake but at rest, as an object in a hand is, would fall asleep in the step in which it is released:
    its counter starts anew.
    """
    tree = m.body_treeid[body]
    if tree >= 0:
        d.tree_awake[tree] = 1
        if d.tree_asleep[tree] < 0:
            d.tree_asleep[tree] = AWAKE_COUNTER


def keep_touching_awake(m: mujoco.MjModel, d: mujoco.MjData, body: int) -> None:
    """Start the counters anew of all trees that touch the tree of a body: what rests on it may lose its support."""
    island = d.tree_island[m.body_treeid[body]]
    touching = (d.tree_island == island) & (d.tree_asleep < 0)
    if island >= 0:
        d.tree_asleep[touching] = AWAKE_COUNTER
