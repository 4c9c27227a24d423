"""States of robots, people, trees and objects as they cross the network."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.scene.values.human import HumanPose
from vinesim.scene.values.signals import LIGHTS_OFF, Lights


@dataclasses.dataclass(frozen=True, slots=True)
class RobotUpdate:
    """Pose of one robot as it crosses the network: actual joints, never commands (D6.4 section 5.2)."""

    actor: str
    time: float
    base_q: np.ndarray
    """[7]"""
    base_qd: np.ndarray
    """[6]"""
    position: np.ndarray
    """[joint] rad or m"""
    velocity: np.ndarray
    """[joint] rad/s or m/s"""
    lights: Lights = LIGHTS_OFF


@dataclasses.dataclass(frozen=True, slots=True)
class HumanUpdate:
    """Pose of one person as it crosses the network (D6.4 section 5.3)."""

    actor: str
    time: float
    pose: HumanPose
    velocity: np.ndarray
    """[7, 6] of all points, m/s and rad/s in world axes, for extrapolation."""
    intention: str = ""
    """One of :data:`INTENTIONS`: what the person indicates to do."""

    @property
    def base_q(self) -> np.ndarray:
        """[7] where others take the person to be: the hips."""
        return self.pose.hips


@dataclasses.dataclass(frozen=True, slots=True)
class TreeUpdate:
    """State of one touched tree as it crosses the network."""

    tree: int
    owner: str
    ownership: int
    """Ownership sequence, u16 with wraparound: +1 by grab, pick, cut."""
    authority: int
    """Authority sequence, u16 with wraparound: +1 by touch."""
    time: float
    resting: bool
    """True in the last, reliable record: silence follows."""
    touched: bool
    """Whether its owner, or an object of its owner's, is in contact with it."""
    joint_q: np.ndarray
    """[body of the tree, 4]"""
    joint_qd: np.ndarray
    """[body of the tree, 3] rad/s"""
    root: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    """[k] numbers in the tree of the bodies that were cut off their parents, in increasing order."""
    root_x: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """[k, 3] m, where their origins are in the world."""
    root_xd: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """[k, 3] m/s"""


@dataclasses.dataclass(frozen=True, slots=True)
class ObjectUpdate:
    """State of one moving box or free bunch, as sent over the network."""

    object: int
    """:func:`vinesim.scene.ids.object_id`"""
    owner: str
    ownership: int
    authority: int
    time: float
    pose: np.ndarray
    """[7] in the world"""
    velocity: np.ndarray
    """[6] m/s and rad/s, of its origin, world axes."""
