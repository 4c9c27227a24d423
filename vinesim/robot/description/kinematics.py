"""Kinematics of a description: moving joints as arrays, and the moving link that carries each link."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.robot.description.urdf import MOVABLE_JOINT_TYPES, Joint, Robot


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MovingJoints:
    """Every joint that moves, driven or mimicking, as arrays: a few array operations give all poses."""

    names: tuple[str, ...]
    frames: tuple[tuple[str, str], ...]
    """[joint] (parent frame, child frame)."""
    drive_index: np.ndarray
    """[joint] index of the drive that moves it, its own or the one that it mimics."""
    multiplier: np.ndarray
    """[joint] Joint position per drive position [1]."""
    offset: np.ndarray
    """[joint] Joint position at drive position 0 [rad or m]."""
    origin: np.ndarray
    """[joint, 7] Pose of the child in its parent at joint position 0."""
    translation: np.ndarray
    """[joint, 3] translation of the child in its parent per metre; zero for a joint that turns."""
    rotation: np.ndarray
    """[joint, 4] quaternion of the origin times (axis, 0); zero for a joint that slides."""
    half_angle: np.ndarray
    """[joint, 1] half of the angle per position: 1/2, or 0 for a joint that slides."""

    def poses(self, position: np.ndarray) -> np.ndarray:
        """Poses of the child in its parent [joint, 7] for drive positions [drive] rad or m."""
        q = self.multiplier * position[self.drive_index] + self.offset
        half = self.half_angle * q[:, None]
        poses = np.empty((len(q), 7))
        poses[:, :3] = self.origin[:, :3] + self.translation * q[:, None]
        poses[:, 3:] = self.origin[:, 3:] * np.cos(half) + self.rotation * np.sin(half)
        return poses


def moving_joints(robot: Robot, driven: list[str]) -> MovingJoints:
    """The joints of ``robot`` that move, as arrays; ``driven``: names of the drives, in the order of joint arrays."""
    joints = [joint for joint in robot.joints if joint.type in MOVABLE_JOINT_TYPES]
    origin = np.array([joint_origin(joint) for joint in joints]).reshape(-1, 7)
    axis = np.array([joint.axis / np.linalg.norm(joint.axis) for joint in joints]).reshape(-1, 3)
    sliding = np.array([joint.type == "prismatic" for joint in joints], bool)[:, None]
    turn = np.concatenate([axis, np.zeros((len(joints), 1))], axis=1)
    return MovingJoints(
        names=tuple(joint.name for joint in joints),
        frames=tuple((joint.parent, joint.child) for joint in joints),
        drive_index=np.array([driven.index(joint.mimic.joint if joint.mimic else joint.name) for joint in joints], int),
        multiplier=np.array([joint.mimic.multiplier if joint.mimic else 1.0 for joint in joints]),
        offset=np.array([joint.mimic.offset if joint.mimic else 0.0 for joint in joints]),
        origin=origin,
        translation=np.where(sliding, frames.rotate(origin[:, 3:], axis), 0.0),
        rotation=np.where(sliding, 0.0, frames.multiply(origin[:, 3:], turn)),
        half_angle=np.where(sliding, 0.0, 0.5),
    )


def link_anchors(base: str, order: list[Joint]) -> dict[str, tuple[str, np.ndarray]]:
    """For every link, by name: the moving link (or the root ``base``) to which it is fixed, and its pose [7] there.

    ``order``: all joints from the root outwards.
    """
    anchors = {base: (base, frames.pose([0.0, 0.0, 0.0]))}
    for joint in order:
        if joint.type == "fixed":
            anchor, offset = anchors[joint.parent]
            anchors[joint.child] = (anchor, frames.compose(offset, joint_origin(joint)))
        else:
            anchors[joint.child] = (joint.child, frames.pose([0.0, 0.0, 0.0]))
    return anchors


def joint_origin(joint: Joint) -> np.ndarray:
    """Pose [7] of the child in the parent at joint position 0."""
    if joint.origin is None:
        return frames.pose([0.0, 0.0, 0.0])
    return frames.pose(joint.origin[:3, 3], frames.from_matrix(joint.origin[:3, :3]))
