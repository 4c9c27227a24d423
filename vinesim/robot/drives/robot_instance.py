"""A robot in the rigid world: the base class of all robots, and the copy of a robot that another client controls."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.robot.drives.odometry import TrackOdometry
from vinesim.scene.values import Contact, JointSample, Lights, RobotSample, RobotUpdate
from vinesim.scene.values.signals import Color

_NO_POSES = np.zeros((0, 7))


class RobotInstance:
    """A robot in the rigid world. Base class of robots that this client controls and of copies of other clients'
    robots."""

    def __init__(
        self,
        rigid: RigidWorld,
        description: RobotDescription,
        name: str = "",
        index: int = 0,
        pose: np.ndarray | None = None,
        *,
        is_in_world: bool = False,
    ) -> None:
        """Add the robot to ``rigid`` at ``pose`` [7] (the origin unless given).

        ``name``: the name in the description unless given. ``index``: number of the robot's instance label.
        ``is_in_world``: whether the robot was added to ``rigid`` before.
        """
        self.rigid = rigid
        self.description = description
        self._joint_names = description.joints
        self.name = name or description.name
        self._index = index
        spec = description.to_spec(self.name, index, pose)
        if not is_in_world:
            rigid.add_robot(spec)
        self.lights = Lights()
        """State of the indicator lights."""
        self._shown_color: Color | None = None
        # on uneven ground the base stands lower or higher than given, and tilted
        self._is_free = description.base_limits.kind == "free"
        start = spec.pose if rigid.model.terrain is None else rigid.base_state(self.name)[0]
        back = frames.conjugate(start[3:])
        self._start = start[:3].copy()
        self._start_turn = frames.to_matrix(back)
        self._start_left = frames.multiply(back, np.eye(4)).T
        """[4, 4] Matrix that multiplies a quaternion from the left by the inverse of the orientation at the start."""
        self._tracks_slip = any(description.base_limits.slip)
        self._track_odometry = TrackOdometry(*description.base_limits.slip, start)

    @property
    def shown_lights(self) -> Color | None:
        """Colour that the indicator lights show now: :data:`UNLIT` between flashes, None while they are off."""
        return self._shown_color

    def show_lights(self, time: float) -> None:
        """Set the colour that the indicator lights show at the ``time`` of the world [s]. This is cheap if the colour
        does not change."""
        shown = self.lights.shown(time)
        if shown != self._shown_color:
            self._shown_color = shown
            self.rigid.set_indicator_color(self.name, shown)

    def remove(self) -> None:
        """Remove the robot from the rigid world."""
        self.rigid.remove_robot(self.name)

    def sample(self, time: float, contacts: Sequence[Contact] = ()) -> RobotSample:
        """Returns the state of the robot at ``time`` [s]. ``contacts``: all contacts in the world; the state includes
        those of this robot."""
        measured = self.measure(time, contacts)
        return dataclasses.replace(measured, transform_q=self.description.moving_joints.poses(measured.joints.position))

    def measure(self, time: float, contacts: Sequence[Contact] = (), **more: Any) -> RobotSample:
        """Like :meth:`sample`, without the transforms, which follow from the joints: :attr:`RobotSample.transform_q`
        is empty. ``more``: values of further fields of the sample."""
        position, velocity, effort, contact = self.rigid.joint_measurements(self.name)
        base_q, base_qd = self.rigid.base_state(self.name)
        odom_q = self._odometry(base_q)
        odom_qd = self._odometry_velocity(base_q, base_qd)
        return RobotSample(
            actor=self.name,
            joints=JointSample(time, self._joint_names, position, velocity, effort, contact),
            base_q=base_q,
            base_qd=base_qd,
            odom_q=odom_q,
            odom_qd=odom_qd,
            odom_covariance=self._track_odometry.covariance(odom_qd),
            transforms=self.description.moving_joints.frames,
            transform_q=_NO_POSES,
            contacts=self._own(contacts),
            odom_is_spatial=self._is_free,
            **more,
        )

    def _own(self, contacts: Sequence[Contact]) -> tuple[Contact, ...]:
        """Returns the contacts that involve this robot."""
        return tuple(c for c in contacts if c.actor == self.name)

    def frame_pose(self, frame: str) -> np.ndarray:
        """Returns the pose [7] in the world of a link of the URDF, such as a sensor's frame."""
        return self.rigid.link_pose(self.name, frame)

    def _odometry(self, base_q: np.ndarray) -> np.ndarray:
        """Returns the pose [7] of the base since the start as odometry measures it. It is exact, unless the tracks
        slip."""
        if self._tracks_slip and not self._is_free:
            return self._track_odometry.update(base_q)
        return np.concatenate([self._start_turn @ (base_q[:3] - self._start), self._start_left @ base_q[3:]])

    def _odometry_velocity(self, base_q: np.ndarray, base_qd: np.ndarray) -> np.ndarray:
        """Returns the velocity [6] by odometry, in the axes of the base: that of the tracks; on legs it is exact."""
        if not self._is_free:
            return self._track_odometry.velocity(base_q, base_qd)
        back = frames.conjugate(base_q[3:])
        return np.concatenate([frames.rotate(back, base_qd[:3]), frames.rotate(back, base_qd[3:])])


class RemoteRobot(RobotInstance):
    """The copy of a robot that another client controls. The copy is pulled to the received states, yet it can be
    held and pushed."""

    TELEPORT_DISTANCE = 1.0
    """[m] Distance of the copy from the received state above which the copy is placed at that state instead of
    pulled. GUESSED"""

    def follow(self, update: RobotUpdate) -> None:
        """Pull the copy to the state of ``update``, until the next update.

        Raises :class:`CommandError` if the update and the description have different numbers of joints.
        """
        count = len(self.description.drives)
        if update.position.shape != (count,) or update.velocity.shape != (count,):
            raise CommandError(
                f"{self.name}: the update has {update.position.size} joints, the robot's description {count}; "
                "load the same robot on both clients"
            )
        self.lights = update.lights
        here, _ = self.rigid.base_state(self.name)
        if np.linalg.norm(update.base_q[:3] - here[:3]) > self.TELEPORT_DISTANCE:
            self._teleport(update, here)
        self.rigid.follow_remote(self.name, update.base_q, update.base_qd, update.position, update.velocity)

    def _teleport(self, update: RobotUpdate, here: np.ndarray) -> None:
        """Place the copy at the state of ``update``. ``here`` [7]: present pose of its base."""
        is_planar = self.rigid.model.terrain is None and not self._is_free
        if (
            is_planar and abs(update.base_q[2] - here[2]) > 1e-3
        ):  # the base joint is planar, so another height needs a new body
            self.rigid.remove_robot(self.name)
            self._shown_color = None
            self.rigid.add_robot(self.description.to_spec(self.name, self._index, update.base_q))
        self.rigid.place_robot(self.name, update.base_q, update.position)
