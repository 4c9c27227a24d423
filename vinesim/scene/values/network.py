"""States of robots, people, trees and objects as sent over the network."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.scene.values.human import HumanPose
from vinesim.scene.values.signals import LIGHTS_OFF, Lights


@dataclasses.dataclass(frozen=True, slots=True)
class RobotUpdate:
    """State of one robot as sent over the network: actual joints, never commands (D6.4 section 5.2)."""

    actor: str
    time: float
    base_q: np.ndarray
    """[7] pose of the base in the world."""
    base_qd: np.ndarray
    """[6] velocity of the base, world axes."""
    position: np.ndarray
    """[joint] rad or m, joint positions."""
    velocity: np.ndarray
    """[joint] rad/s or m/s, joint velocities."""
    lights: Lights = LIGHTS_OFF


@dataclasses.dataclass(frozen=True, slots=True)
class HumanUpdate:
    """Pose of one person as sent over the network (D6.4 section 5.3)."""

    actor: str
    time: float
    pose: HumanPose
    velocity: np.ndarray
    """[7, 6] velocities of all points, m/s and rad/s in world axes, for extrapolation."""
    intention: str = ""
    """Intention that the person indicates, one of :data:`INTENTIONS`."""

    @property
    def base_q(self) -> np.ndarray:
        """[7] pose of the hips, which other clients use as the position of the person."""
        return self.pose.hips


@dataclasses.dataclass(frozen=True, slots=True)
class TreeUpdate:
    """State of one tree (kinematic tree of a plant, such as a cane) that an actor has touched, as sent over the
    network."""

    tree: int
    owner: str
    ownership: int
    """Sequence number (u16 with wraparound) of the owner's claim on the tree; every grab, pick and cut increments it.
    The client of the owner simulates the tree for all clients."""
    authority: int
    """Second sequence number (u16 with wraparound) of the claim, for equal ownership; every touch increments it."""
    time: float
    resting: bool
    """Whether the tree is at rest (slow and near its equilibrium). If so, this update is sent reliably, and no update
    follows until the tree is touched again.
    """
    touched: bool
    """Whether the owner of the tree, or an object of the owner, is in contact with the tree."""
    joint_q: np.ndarray
    """[body of the tree, 4] joint rotations, quaternions xyzw."""
    joint_qd: np.ndarray
    """[body of the tree, 3] rad/s, joint rates."""
    root: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
    """[k] indices within the tree of the bodies that were cut off their parents, ascending."""
    root_x: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """[k, 3] m, world positions of the origins of the cut bodies ``root``."""
    root_xd: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """[k, 3] m/s, velocities of the origins of the cut bodies ``root``."""


@dataclasses.dataclass(frozen=True, slots=True)
class ObjectUpdate:
    """State of one moving box or free bunch, as sent over the network."""

    object: int
    """Id of the object, see :func:`vinesim.scene.ids.object_id`."""
    owner: str
    ownership: int
    authority: int
    time: float
    pose: np.ndarray
    """[7] Pose of the object in the world."""
    velocity: np.ndarray
    """[6] m/s, rad/s: linear velocity of the object's origin, then angular velocity, world axes."""
