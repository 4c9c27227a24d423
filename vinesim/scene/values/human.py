"""People: tracked poses, hands and haptics."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True, slots=True)
class HumanPose:
    """Poses of a person's tracked points at one instant, as sent over the network (CANOPIES D6.4, section 5.3).

    All poses [7] (position [m], quaternion xyzw) are in the world. With an upright person, x points forward and z up.
    """

    root: np.ndarray
    """Origin of the tracked space, on the floor."""
    head: np.ndarray
    """Head-mounted display, between the eyes."""
    left: np.ndarray
    """Controller of the left hand, in the middle of the palm: x along the fingers, z out of the back of the hand."""
    right: np.ndarray
    hips: np.ndarray
    """Midpoint between the hip joints."""
    left_foot: np.ndarray
    """Left ankle, x to the toes."""
    right_foot: np.ndarray
    left_closed: bool = False
    """Whether the left hand is closed. When it closes, it grasps the plant or object that it touches, and holds it
    until it opens."""
    right_closed: bool = False
    left_fingers: tuple[float, ...] = (0.0,) * 5
    """Bend of thumb, index, middle, ring and little finger: 0 straight, 1 fully bent. It affects only the drawn
    hand."""
    right_fingers: tuple[float, ...] = (0.0,) * 5
    left_busy: bool = False
    """Whether the left hand pushes a robot or holds an object, as the person's own client reports. If so, ``left`` is
    the pose of the palm, not of the controller, and other clients place their copy of the hand there without contacts.
    The person's own client does not use this field."""
    right_busy: bool = False
    left_shears: bool = False
    """Whether the left hand has shears: when the hand closes, the shears cut, and the hand grasps nothing."""
    right_shears: bool = False

    @property
    def points(self) -> np.ndarray:
        """[point, 7] All seven poses, in the order of :data:`POINT_NAMES`."""
        return np.stack([getattr(self, name) for name in POINT_NAMES])

    def with_points(self, points: np.ndarray) -> HumanPose:
        """Returns a copy with the poses ``points`` [point, 7], in the order of :data:`POINT_NAMES`. States of hands and
        fingers are unchanged."""
        return dataclasses.replace(self, **dict(zip(POINT_NAMES, points, strict=True)))


POINT_NAMES = ("root", "head", "left", "right", "hips", "left_foot", "right_foot")
"""Names of the tracked points whose poses a :class:`HumanPose` contains."""


@dataclasses.dataclass(frozen=True, slots=True)
class HumanSpec:
    """Description of a person for the physics."""

    name: str
    """The actor's name, which is a prefix of the names of its bodies."""
    index: int
    """Index of the person in label images (:func:`vinesim.scene.ids.label`)."""
    pose: HumanPose
    """Pose at the start."""
    height: float = 1.75
    """[m] Height, which determines the lengths of the limbs."""
    stiffness: float | None = None
    """[N/m] Stiffness of the spring that pulls a hand in contact to its controller; None:
    ``PhysicsParameters.hand_stiffness``."""
    force: float | None = None
    """Largest force of a hand [N]; None: ``PhysicsParameters.hand_force``."""
    outfit: str = ""
    """Outfit, one of :func:`vinesim.scene.appearance.outfit_names`; empty: chosen by the person's name."""


@dataclasses.dataclass(frozen=True, slots=True)
class HandSample:
    """State of one hand of a person at the end of a tick."""

    pose: np.ndarray
    """[7] Pose of the simulated palm in the world."""
    controller: np.ndarray
    """[7] Pose in the world of the tracked controller that the palm follows."""
    force: np.ndarray
    """[3] N, force of the hand on its surroundings in this tick, world axes."""
    touching: bool
    held: tuple[str, str] | None
    """Actor and link of the object that the hand holds, named as in :class:`Contact`; None if it holds nothing."""


@dataclasses.dataclass(frozen=True, slots=True)
class Haptic:
    """Command to vibrate one of the hand-held controllers of a person."""

    actor: str
    hand: str
    """``"left"`` or ``"right"``."""
    onset: bool
    """Whether the contact has just begun. If not, the command is for a lasting contact."""
    amplitude: float
    """0 to 1, force as a fraction of the hand's largest force; an onset is always strong enough to be felt."""
    duration: float
    """[s] Duration of the vibration."""
