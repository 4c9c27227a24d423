"""Kinematics of a robot description: moving joints as arrays, and the moving link to which each link is fixed."""

from __future__ import annotations

import dataclasses

import numpy as np

from vinesim.core import frames
from vinesim.robot.description.urdf import MOVABLE_JOINT_TYPES, Joint, Robot


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MovingJoints:
    """All joints that move, driven or mimicking, as arrays, so that a few array operations compute all poses."""

    names: tuple[str, ...]
    frames: tuple[tuple[str, str], ...]
    """[joint] (parent frame, child frame)."""
    drive_index: np.ndarray
    """[joint] Index of the drive that moves the joint: the joint's own drive, or that of the joint it mimics."""
    multiplier: np.ndarray
    """[joint] Joint position per drive position [1]."""
    offset: np.ndarray
    """[joint] Joint position at drive position 0 [rad or m]."""
    origin: np.ndarray
    """[joint, 7] Pose of the child in its parent at joint position 0."""
    translation: np.ndarray
    """[joint, 3] Translation of the child in its parent per metre of a prismatic joint; 0 for other joints."""
    rotation: np.ndarray
    """[joint, 4] Quaternion of the origin times (axis, 0); 0 for a prismatic joint."""
    half_angle: np.ndarray
    """[joint, 1] Half of the rotation angle per joint position: 1/2, or 0 for a prismatic joint."""

    def poses(self, position: np.ndarray) -> np.ndarray:
        """Returns the pose of each child in its parent [joint, 7] m, 1 for drive positions [drive] rad or m."""
        q = self.multiplier * position[self.drive_index] + self.offset
        half = self.half_angle * q[:, None]
        poses = np.empty((len(q), 7))
        poses[:, :3] = self.origin[:, :3] + self.translation * q[:, None]
        poses[:, 3:] = self.origin[:, 3:] * np.cos(half) + self.rotation * np.sin(half)
        return poses


def moving_joints(robot: Robot, driven: list[str]) -> MovingJoints:
    """Returns the moving joints of ``robot`` as arrays. ``driven``: names of the driven joints, in the order of
    joint arrays."""
    joints = [joint for joint in robot.joints if joint.type in MOVABLE_JOINT_TYPES]
    origin = np.array([joint_origin(joint) for joint in joints]).reshape(-1, 7)
    drives = {name: index for index, name in enumerate(driven)}
    axis = np.array([joint.axis / np.linalg.norm(joint.axis) for joint in joints]).reshape(-1, 3)
    sliding = np.array([joint.type == "prismatic" for joint in joints], bool)[:, None]
    turn = np.concatenate([axis, np.zeros((len(joints), 1))], axis=1)
    return MovingJoints(
        names=tuple(joint.name for joint in joints),
        frames=tuple((joint.parent, joint.child) for joint in joints),
        drive_index=np.array([drives[joint.mimic.joint if joint.mimic else joint.name] for joint in joints], int),
        multiplier=np.array([joint.mimic.multiplier if joint.mimic else 1.0 for joint in joints]),
        offset=np.array([joint.mimic.offset if joint.mimic else 0.0 for joint in joints]),
        origin=origin,
        translation=np.where(sliding, frames.rotate(origin[:, 3:], axis), 0.0),
        rotation=np.where(sliding, 0.0, frames.multiply(origin[:, 3:], turn)),
        half_angle=np.where(sliding, 0.0, 0.5),
    )


def link_anchors(base: str, order: list[Joint]) -> dict[str, tuple[str, np.ndarray]]:
    """For every link, by name, returns the moving link (or the root link ``base``) to which it is fixed, and its pose
    [7] in the frame of that link.

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
    """Returns the pose [7] of a joint's child in its parent at joint position 0."""
    if joint.origin is None:
        return frames.pose([0.0, 0.0, 0.0])
    return frames.pose(joint.origin[:3, 3], frames.from_matrix(joint.origin[:3, :3]))
