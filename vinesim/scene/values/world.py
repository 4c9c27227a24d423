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
    leaf_off: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, bool))
    """[leaf] Whether each leaf has been taken off; empty: none has. The same array as long as none is taken off."""


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
    peak: float = 0.0
    """[N] Largest size of the force within the tick, as a mean over 1.25 ms. It is larger than the size of
    :attr:`force`, the mean over the tick, in the tick in which two bodies hit each other. 0 for a hand that holds a
    plant, and for contacts that a robot's sensor process reports."""


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
    """``"pull"``, ``"bend"`` or ``"twist"`` (the load that used most of the strength), ``"blade"`` (a cutter) or
    ``"command"``."""
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
    time: float = 0.0
    """[s] Simulated time of the detachment. A break falls within a step."""
    place: float = 0.0
    """[m] Distance of the cut or break from the base of the tree, along the wood."""
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[m] Place of the cut or break in the world."""


@dataclasses.dataclass(frozen=True, slots=True)
class Breakage:
    """The event that a plant changed for good without parting: wood cracked, a tie slipped or broke, or an actor worked
    on it."""

    kind: str
    """``"crack"``: a cane has passed its strength and hangs on its fibres; ``"slip"``: a tie began to slip along its
    wire; ``"untie"``: a tie broke; ``"notch"``: a blade has left a cut that does not go through; ``"tied"``: a cane was
    tied; ``"untied"``: a tie was opened; ``"leaves"``: leaves were taken off."""
    cause: str
    """``"pull"``, ``"bend"`` or ``"twist"``; for work of an actor ``"blade"`` or ``"command"``."""
    tick: int
    time: float
    """[s] Simulated time."""
    tree: int
    body: int
    """Index of the body at whose joint the wood cracked, which the tie held or holds, or which an actor worked on."""
    tie: int
    """Index of the tie of the model, -1 for wood and for ties that actors have made."""
    actor: str
    """Name of the actor who worked on the tree, or presses hardest on it; empty if none does."""
    force: np.ndarray
    """[3] N, force of the tree or the tie on the body, world axes."""
    moment: np.ndarray
    """[3] N m, moment about the joint on the body; 0 for a tie."""
    place: float
    """[m] Distance from the base of the tree along the wood."""
    point: tuple[float, float, float]
    """[m] Place in the world."""


@dataclasses.dataclass(frozen=True, slots=True)
class WireBreak:
    """The event that a piece of wire broke between two posts. The ties on it hold nothing any more."""

    tick: int
    piece: int
    """Index of the fixed piece."""
    tension: float
    """[N] Tension at which it broke."""
    ties: tuple[int, ...]
    """Ties that the wire held until then."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class GivenWood:
    """How one tree has changed for good, besides cuts: joints [k] with a set, ties [j] that have slipped or broken,
    cuts that did not go through [n], ties that actors have made [b], leaves that they have taken off [m].

    Places count from the tree's first body, its first tie and its first leaf, and increase."""

    joints: np.ndarray
    """[k] int, places of the bodies."""
    turns: np.ndarray
    """[k, 4] float32, sets: unit quaternions xyzw."""
    flows: np.ndarray
    """[k] rad, float32: see ``State.joint_flow``."""
    ties: np.ndarray
    """[j] int, places of the ties."""
    slid: np.ndarray
    """[j] m, float32."""
    slid_in_all: np.ndarray
    """[j] m, float32: see ``State.tie_flow``."""
    broken: np.ndarray
    """[j] bool"""
    notched: np.ndarray
    """[n] int, places of the segments."""
    notch_at: np.ndarray
    """[n] m, float32: see ``State.notch_at``."""
    notch_depth: np.ndarray
    """[n] float32: see ``State.notch_depth``."""
    tied: np.ndarray
    """[b] int, places of the segments to which actors have bound ties."""
    tied_at: np.ndarray
    """[b] int, distances of the ties from the segments' origins, in 0.1 mm."""
    tied_to: np.ndarray
    """[b, 3] m, float32: points in the world to which the ties pull."""
    opened: np.ndarray
    """[b] bool, whether the tie was opened again."""
    bare: np.ndarray
    """[m] int, places of the leaves that are off."""


@dataclasses.dataclass(frozen=True, slots=True)
class BladeClosing:
    """The event that a blade has closed, or could not close wholly."""

    tick: int
    actor: str
    link: str
    outcome: str
    """``"cut"`` (the edges met with wood between them), ``"missed"`` (without wood), ``"stalled"`` (the wood takes more
    force than the blade has) or ``"blocked"`` (a wire, a post, old wood or wood thicker than the mouth is between the
    edges)."""
    sentence: str
    """What happened, for users."""
    force: float
    """[N] Largest force that the edges exerted on the wood."""
    needed: float
    """[N] Largest force that cutting all wood in the mouth takes."""
    energy: float
    """[J] Energy that went into the wood."""
    body: int
    """Index of the thickest body between the edges, -1 for none."""
    at: float
    """[m] Place of the cut along this body."""
    diameter: float
    """[m] Diameter of this body there."""
    depth: float
    """[m] Depth of the cut in this body, the cuts of earlier closings included."""
    position: np.ndarray
    """[3] m, the place of the cut in the world; the middle of the mouth if there is no wood."""


@dataclasses.dataclass(frozen=True, slots=True)
class BunchHistory:
    """What has happened to a bunch so far; see :mod:`vinesim.interaction.fruit_damage` for the laws and their
    sources."""

    bunch: int
    berries: int
    """Number of its berries."""
    hand_time: float = 0.0
    """[s] Time for which robots or people touched or held it."""
    impulse: float = 0.0
    """[N s] Sum of the forces of robots and people on it, over time."""
    peak_force: float = 0.0
    """[N] Largest force across one 24th of its surface, by anything, over 10 ms."""
    peak_pressure: float = 0.0
    """[Pa] Largest pressure in a berry."""
    drops: int = 0
    """Number of falls."""
    drop_height: float = 0.0
    """[m] Height of the highest fall of its centre of mass."""
    acceleration: float = 0.0
    """[m/s^2] Largest acceleration by contacts since it left its vine, over 10 ms."""
    berries_burst: float = 0.0
    """Expected number of berries whose skins burst."""
    berries_lost: float = 0.0
    """Expected number of berries that fell off."""

    @property
    def damage(self) -> float:
        """Share of the berries that burst or fell off, at most 1."""
        return min((self.berries_burst + self.berries_lost) / max(self.berries, 1), 1.0)


@dataclasses.dataclass(frozen=True, slots=True)
class FruitEvent:
    """The event that a bunch fell, or that its berries burst or fell off."""

    tick: int
    bunch: int
    what: str
    """``"dropped"``, ``"burst"`` or ``"lost"``."""
    value: float
    """Height of the fall [m], or the expected number of berries that have burst or fallen off so far."""
