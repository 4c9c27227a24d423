"""People: tracked poses, hands and haptics."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True, slots=True)
class HumanPose:
    """Where a person's tracked points are at one instant: all that crosses the network (CANOPIES D6.4, section 5.3).

    All poses [7] in the world, x forward, z up for a person who stands upright.
    """

    root: np.ndarray
    """Floor of the tracked space."""
    head: np.ndarray
    """Head-mounted display: between the eyes."""
    left: np.ndarray
    """Controller of the left hand, in the middle of the palm: x along the fingers, z out of the back of the hand."""
    right: np.ndarray
    hips: np.ndarray
    """Middle between the hip joints."""
    left_foot: np.ndarray
    """Ankle, x to the toes."""
    right_foot: np.ndarray
    left_closed: bool = False
    """Whether the hand closes on what it touches; what it holds it keeps until this is false again."""
    right_closed: bool = False
    left_fingers: tuple[float, ...] = (0.0,) * 5
    """How far thumb, index, middle, ring and little finger are bent: 0 straight, 1 all the way. To be seen only."""
    right_fingers: tuple[float, ...] = (0.0,) * 5
    left_busy: bool = False
    """The human's own client reports that the hand pushes a robot or holds an object: ``left`` is then the palm, not
    the controller, and the remote copy is placed there without contacts. Unused on the human's own client."""
    right_busy: bool = False
    left_shears: bool = False
    """Whether the hand has shears: when it closes, they cut what is between their blades, and it holds nothing."""
    right_shears: bool = False

    @property
    def points(self) -> np.ndarray:
        """[7, 7] all poses, in the order of :data:`POINT_NAMES`."""
        return np.stack([getattr(self, name) for name in POINT_NAMES])

    def with_points(self, points: np.ndarray) -> HumanPose:
        """The same hands and fingers with all poses [7, 7] elsewhere."""
        return dataclasses.replace(self, **dict(zip(POINT_NAMES, points, strict=True)))


POINT_NAMES = ("root", "head", "left", "right", "hips", "left_foot", "right_foot")
"""Poses of a :class:`HumanPose`."""


@dataclasses.dataclass(frozen=True, slots=True)
class HumanSpec:
    """A person as physics needs one."""

    name: str
    """The actor's name: prefix of everything it owns."""
    index: int
    """Index of its label."""
    pose: HumanPose
    """At the start."""
    height: float = 1.75
    """[m] It gives the limbs their lengths."""
    stiffness: float | None = None
    """Force of a hand in contact per offset from its controller [N/m]; None: ``PhysicsParameters.hand_stiffness``."""
    force: float | None = None
    """Largest force of a hand [N]; None: ``PhysicsParameters.hand_force``."""
    outfit: str = ""
    """What it wears, one of :func:`vinesim.scene.appearance.outfit_names`; empty: what follows from its name."""


@dataclasses.dataclass(frozen=True, slots=True)
class HandSample:
    """One hand at the end of a tick."""

    pose: np.ndarray
    """[7] of the palm in the world."""
    controller: np.ndarray
    """[7] where the person holds the controller."""
    force: np.ndarray
    """[3] N with which the hand pushes or pulls the world in this tick, world axes."""
    touching: bool
    held: tuple[str, str] | None
    """Actor and link of what it holds, named as in :class:`Contact`."""


@dataclasses.dataclass(frozen=True, slots=True)
class Haptic:
    """One vibration command for a human's controller."""

    actor: str
    hand: str
    """``"left"`` or ``"right"``."""
    onset: bool
    """The contact has just begun; otherwise it lasts."""
    amplitude: float
    """0 to 1, the share of the hand's greatest force; an onset is never weaker than can be felt."""
    duration: float
    """[s]"""
