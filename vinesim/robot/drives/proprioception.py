"""Measurements of a robot's own state: wrist wrenches, inertial measurement units, series elastic elements."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.description import RobotDescription
from vinesim.scene.values import Contact, ElasticSample, Imu, ImuMount, JointSample, SensorMount, Wrench


class BodySensors:
    """Force-torque sensors and IMUs of one robot, at the frames that are given in its description."""

    def __init__(self, rigid: RigidWorld, name: str, description: RobotDescription) -> None:
        self._rigid = rigid
        self._name = name
        self._description = description
        for mount in (*description.wrenches, *description.imus):
            rigid.add_link_sensor(name, mount.frame)
        self._distal_links = {mount.frame: _subtree_links(description, mount.frame) for mount in description.wrenches}

    def wrenches(self, time: float, contacts: Sequence[Contact]) -> tuple[Wrench, ...]:
        """Returns the wrenches at ``time`` [s]. They include the forces of plants on the robot, ``contacts``, which
        MuJoCo does not know."""
        return tuple(self._wrench(mount, time, contacts) for mount in self._description.wrenches)

    def imus(self, time: float) -> tuple[Imu, ...]:
        """Returns the readings of all IMUs at ``time`` [s]."""
        return tuple(self._imu(mount, time) for mount in self._description.imus)

    def _wrench(self, mount: SensorMount, time: float, contacts: Sequence[Contact]) -> Wrench:
        wrench = self._rigid.link_wrench(self._name, mount.frame)
        distal = [contact for contact in contacts if contact.link in self._distal_links[mount.frame]]
        if distal:
            pose = self._rigid.link_pose(self._name, mount.frame)
            back = frames.conjugate(pose[3:])
            force = np.array([contact.force for contact in distal])
            arm = np.array([contact.position for contact in distal]) - pose[:3]
            wrench[:3] += frames.rotate(back, force.sum(0))
            wrench[3:] += frames.rotate(back, frames.cross(arm, force).sum(0))
        return Wrench(time, mount.name, mount.frame, wrench[:3], wrench[3:])

    def _imu(self, mount: ImuMount, time: float) -> Imu:
        orientation = self._rigid.link_pose(self._name, mount.frame)[3:]
        angular_velocity = self._rigid.link_angular_velocity(self._name, mount.frame)
        acceleration = self._rigid.link_acceleration(self._name, mount.frame)[3:]
        if mount.angular_velocity_noise or mount.acceleration_noise:
            rng = np.random.default_rng([zlib.crc32(mount.name.encode()), round(time / self._rigid.dt)])
            angular_velocity = angular_velocity + mount.angular_velocity_noise * rng.standard_normal(3)
            acceleration = acceleration + mount.acceleration_noise * rng.standard_normal(3)
        return Imu(time, mount.name, mount.frame, orientation, angular_velocity, acceleration)


def elastic_sample(joints: JointSample, stiffness: np.ndarray) -> ElasticSample:
    """Returns motor positions and deflections of series elastic elements. ``stiffness`` [joint] N m/rad or N/m."""
    deflection = joints.effort / stiffness
    return ElasticSample(
        joints.time, joints.names, stiffness, joints.position + deflection, deflection, stiffness * deflection
    )


def _subtree_links(description: RobotDescription, frame: str) -> frozenset[str]:
    """Returns the link ``frame`` and all links that it carries."""
    subtree = {frame}
    joints = (*description.fixed_frames, *description.moving_joints.frames)
    while children := {child for parent, child in joints if parent in subtree} - subtree:
        subtree |= children
    return frozenset(subtree)
