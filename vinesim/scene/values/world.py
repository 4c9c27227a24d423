"""The world at one instant or in one step: snapshots for sensors, contacts, detachments."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.scene.values.rigid import RigidVisual
from vinesim.scene.wind import Wind


@dataclasses.dataclass(frozen=True, slots=True)
class WindState:
    """The wind at one instant, and how much of what it does to each tree is drawn because it is not simulated."""

    wind: Wind
    time: float
    """[s] Of the wind: that of the world."""
    strength: float
    """[1] From 0 when a wind begins to 1, and back to 0 when it ends."""
    tree_air: np.ndarray
    """[tree, 3] m/s Air in which the simulated pose of each tree is."""
    tree_drawn: np.ndarray
    """[tree] 1: the tree is drawn where the wind would hold it, 0: where it is simulated."""


@dataclasses.dataclass(frozen=True, slots=True)
class SegmentPoses:
    """Where segments of wires are that are away from where they were drawn, see :mod:`vinesim.wires.wire_segments`."""

    segment: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    """[k] Their numbers, ascending."""
    q: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 7), np.float32))
    """[k, 7] m, 1"""


@dataclasses.dataclass(frozen=True, slots=True)
class Snapshot:
    """The whole world at one instant, as sensors need it: taken by the physics thread, read by any other."""

    time: float
    """[s]"""
    tick: int
    body_q: np.ndarray
    """Plant bodies [body, 7] m, 1."""
    bunch_attached: np.ndarray
    """[bunch] bool"""
    visuals: tuple[RigidVisual, ...]
    """Rigid bodies; the same tuple object as long as no actor comes or goes."""
    visual_q: np.ndarray
    """Their poses [link, 7] m, 1."""
    moved_trees: np.ndarray
    """Indices of the trees that are awake [k]: only these have moved since they fell asleep."""
    wind: WindState | None = None
    """None: the air is calm. Else ``body_q`` lacks the sway of trees on which wind is not simulated; see
    :mod:`vinesim.wind.sway`."""
    wires: SegmentPoses = dataclasses.field(default_factory=SegmentPoses)
    """All other segments of wires are where they were drawn."""


@dataclasses.dataclass(frozen=True, slots=True)
class Contact:
    """One contact of a rigid body with a plant, as solved in one tick."""

    actor: str
    link: str
    body: int
    """Plant body in the model."""
    position: np.ndarray
    """[3] m, world"""
    force: np.ndarray
    """[3] N on the rigid body, world axes; the plant feels the opposite."""
    distance: float
    """Gap [m], negative when they overlap."""


@dataclasses.dataclass(frozen=True, slots=True)
class Detachment:
    """Something left its plant: a bunch its peduncle, or a cane the rest of its tree."""

    tick: int
    tree: int
    body: int
    """The body that left; what grows on it went with it."""
    bunch: int
    """Which bunch, -1 for a cane."""
    cause: str
    """``"pull"`` (too much force), ``"bend"`` (too much moment), ``"blade"`` (a cutter closed on it), ``"command"``."""
    actor: str
    """Whose doing it was, as far as is known; empty otherwise."""
    force: np.ndarray
    """[3] N that the joint carried at the end, world axes, on what left."""
    moment: np.ndarray
    """[3] N m about the joint."""
