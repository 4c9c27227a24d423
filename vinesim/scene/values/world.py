"""The world at one instant or in one step: snapshots for sensors, contacts, detachments."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.scene.values.rigid import RigidVisual
from vinesim.scene.wind import Wind


@dataclasses.dataclass(frozen=True, slots=True)
class WindState:
    """The wind at one instant, and for each tree the share of its sway (motion in the wind) that is added to its
    rendered pose instead of simulated (:mod:`vinesim.wind.sway`)."""

    wind: Wind
    time: float
    """[s] World time of this state."""
    strength: float
    """[1] Strength that rises from 0 to 1 when a wind begins and falls back to 0 when it ends."""
    tree_air: np.ndarray
    """[tree, 3] m/s, air velocity that acts on the simulated pose of each tree."""
    tree_drawn: np.ndarray
    """[tree] Share of the sway (motion in the wind) that is added for rendering. 1: the tree is rendered with the full
    sway; 0: in its simulated pose."""


@dataclasses.dataclass(frozen=True, slots=True)
class SegmentPoses:
    """Poses of the segments of wires that are displaced from their rest poses. A segment is a short straight part of a
    wire (:mod:`vinesim.wires.wire_segments`)."""

    segment: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    """[k] Indices of the displaced segments among all segments of wires, ascending."""
    q: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 7), np.float32))
    """[k, 7] m, 1, poses of the displaced segments in the world."""


@dataclasses.dataclass(frozen=True, slots=True)
class Snapshot:
    """The whole world at one instant, with the data that sensors need. The physics thread makes it; any thread may read
    it."""

    time: float
    """[s] World time of this state."""
    tick: int
    body_q: np.ndarray
    """[body, 7] m, 1, poses of plant bodies."""
    bunch_attached: np.ndarray
    """[bunch] bool, whether the bunch hangs on its plant."""
    visuals: tuple[RigidVisual, ...]
    """Visible rigid bodies with their shapes. The same tuple object as long as no body is added or removed."""
    visual_q: np.ndarray
    """[visual, 7] m, 1: world poses of the bodies in ``visuals``."""
    moved_trees: np.ndarray
    """[k] Indices of the trees whose pose may have changed: trees that are awake, and sleeping trees whose rest pose
    another client has sent.
    """
    wind: WindState | None = None
    """The wind; None in calm air. Wind is simulated only on trees near actors. ``body_q`` does not contain the sway
    (motion in the wind) of all other trees, which :mod:`vinesim.wind.sway` adds for rendering."""
    wires: SegmentPoses = dataclasses.field(default_factory=SegmentPoses)
    """Poses of displaced segments of wires; all other segments have their rest poses."""
    stumps: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """[k, 3] Stumps that cuts of canes have left: body of the stump, segment that was cut, and distance of the cut from
    the segment's origin [m]. The stump has the segment's frame."""


@dataclasses.dataclass(frozen=True, slots=True)
class Contact:
    """One contact of a rigid body with a plant, as solved in one tick."""

    actor: str
    link: str
    body: int
    """Index of the plant body in the model."""
    position: np.ndarray
    """[3] m, contact point in the world."""
    force: np.ndarray
    """[3] N on the rigid body, world axes; the opposite force acts on the plant."""
    distance: float
    """Gap [m], negative if the bodies overlap."""


@dataclasses.dataclass(frozen=True, slots=True)
class Detachment:
    """The event that a bunch or a piece of wood was detached from its plant."""

    tick: int
    tree: int
    body: int
    """Index in the model of the body that was detached, together with its descendants."""
    bunch: int
    """Index of the bunch, -1 for a cane."""
    cause: str
    """``"pull"`` (too large force), ``"bend"`` (too large moment), ``"blade"`` (a cutter) or ``"command"``."""
    actor: str
    """Name of the actor who caused the detachment; empty if unknown."""
    force: np.ndarray
    """[3] N, last force of the joint on the detached part, world axes."""
    moment: np.ndarray
    """[3] N m, last moment about the joint on the detached part."""
    segment: int = -1
    """Index of the body of wood that was cut: a segment of the peduncle of a bunch, or the body of a cane, which is the
    root of what falls. -1: the part was detached at its joint.
    """
    at: float = 0.0
    """[m] Distance of the cut from the origin of ``segment``."""
