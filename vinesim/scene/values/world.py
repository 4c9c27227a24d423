"""The world at one instant or in one step: snapshots for sensors, contacts, detachments."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.scene.values.rigid import RigidVisual
from vinesim.scene.wind import Wind


@dataclasses.dataclass(frozen=True, slots=True)
class WindState:
    """The wind at one instant, and how much of each tree's sway is drawn instead of simulated."""

    wind: Wind
    time: float
    """[s] World time."""
    strength: float
    """[1] Strength that rises from 0 to 1 when a wind begins and falls back to 0 when it ends."""
    tree_air: np.ndarray
    """[tree, 3] m/s, air velocity that acts on the simulated pose of each tree."""
    tree_drawn: np.ndarray
    """[tree] 1: the tree is drawn where the wind would hold it; 0: it is drawn where it is simulated."""


@dataclasses.dataclass(frozen=True, slots=True)
class SegmentPoses:
    """Poses of the displaced segments of wires, see :mod:`vinesim.wires.wire_segments`."""

    segment: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    """[k] Numbers of the segments, ascending."""
    q: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 7), np.float32))
    """[k, 7] m, 1, poses in the world."""


@dataclasses.dataclass(frozen=True, slots=True)
class Snapshot:
    """The whole world at one instant, as sensors need it: taken by the physics thread, read by any other."""

    time: float
    """[s] World time."""
    tick: int
    body_q: np.ndarray
    """[body, 7] m, 1, poses of plant bodies."""
    bunch_attached: np.ndarray
    """[bunch] bool, whether the bunch hangs on its plant."""
    visuals: tuple[RigidVisual, ...]
    """Rigid bodies; the same tuple object as long as no actor joins or leaves."""
    visual_q: np.ndarray
    """[link, 7] m, 1, poses of ``visuals``."""
    moved_trees: np.ndarray
    """[k] Indices of the trees that are awake; all other trees stand still."""
    wind: WindState | None = None
    """None: the air is calm. Otherwise ``body_q`` lacks the sway of trees on which wind is not simulated; see
    :mod:`vinesim.wind.sway`."""
    wires: SegmentPoses = dataclasses.field(default_factory=SegmentPoses)
    """Poses of displaced segments of wires; all other segments are where they were drawn."""


@dataclasses.dataclass(frozen=True, slots=True)
class Contact:
    """One contact of a rigid body with a plant, as solved in one tick."""

    actor: str
    link: str
    body: int
    """Index of the plant body in the model."""
    position: np.ndarray
    """[3] m, world"""
    force: np.ndarray
    """[3] N on the rigid body, world axes; the plant feels the opposite force."""
    distance: float
    """Gap [m], negative if the bodies overlap."""


@dataclasses.dataclass(frozen=True, slots=True)
class Detachment:
    """A part came off its plant: a bunch off its peduncle, or a cane off its tree."""

    tick: int
    tree: int
    body: int
    """Body that came off, together with everything that grows on it."""
    bunch: int
    """Index of the bunch, -1 for a cane."""
    cause: str
    """``"pull"`` (too much force), ``"bend"`` (too much moment), ``"blade"`` (a cutter closed on it), ``"command"``."""
    actor: str
    """Actor who caused it; empty if unknown."""
    force: np.ndarray
    """[3] N, last force of the joint on the part that came off, world axes."""
    moment: np.ndarray
    """[3] N m, last moment about the joint on that part."""
