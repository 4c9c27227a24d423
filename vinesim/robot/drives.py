"""A robot in this client's world: commands in, limited set-points out, and what it knows of itself.

    robot = Robot(rigid, load("vinebot"), "robot_1")
    robot.command_position([0.3], ["torso_lift_joint"])
    robot.command_base(0.4, 0.0, time)
    ...
    robot.control(time)           # before each step of physics
    sample = robot.sample(time)   # after it

Servos and effort limits act in physics; what is asked of them stays within the URDF's limits here, so a step of a
position command becomes a ramp at the joint's largest speed, as in the joint_limits of ros2_control.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence

import numpy as np

from vinesim import frames
from vinesim.physics.rigid import Rigid
from vinesim.robot.description import Description
from vinesim.world.values import Contact, JointSample, RobotSample, RobotUpdate


class Interface(enum.IntEnum):
    """What a joint is commanded by; D6.4 section 5.2 names these three."""

    POSITION = 0
    VELOCITY = 1
    EFFORT = 2


class CommandError(ValueError):
    """A command that no joint can take; the text says which and why."""


class Embodied:
    """A robot that stands in the rigid world, whoever moves it."""

    def __init__(
        self,
        rigid: Rigid,
        description: Description,
        name: str = "",
        index: int = 0,
        pose: np.ndarray | None = None,
    ) -> None:
        self.rigid = rigid
        self.description = description
        self.name = name or description.name
        self._index = index
        spec = description.spec(self.name, index, pose)
        rigid.add_robot(spec)
        back = frames.conjugate(spec.pose[3:])
        self._start = spec.pose[:3].copy()
        self._start_turn = frames.matrix(back)
        self._start_left = frames.multiply(back, np.eye(4)).T
        """[4, 4]: quaternion product with the inverse of the start's, as a matrix"""

    def leave(self) -> None:
        """Take it out of the world."""
        self.rigid.remove_robot(self.name)

    def sample(self, time: float, contacts: Sequence[Contact] = ()) -> RobotSample:
        """What the robot knows of itself at ``time`` [s]; of ``contacts`` it keeps its own."""
        position, velocity, effort, contact = self.rigid.read(self.name)
        base_q, base_qd = self.rigid.base(self.name)
        return RobotSample(
            actor=self.name,
            joints=JointSample(time, self.description.joints, position, velocity, effort, contact),
            base_q=base_q,
            base_qd=base_qd,
            odom_q=np.concatenate([self._start_turn @ (base_q[:3] - self._start), self._start_left @ base_q[3:]]),
            transforms=self.description.moving.frames,
            transform_q=self.description.moving.poses(position),
            contacts=tuple(c for c in contacts if c.actor == self.name),
        )

    def frame_pose(self, frame: str) -> np.ndarray:
        """World pose [7] of any link of the URDF: where a sensor sits now."""
        return self.rigid.link_pose(self.name, frame)


class Robot(Embodied):
    """A robot that this client controls: the local robot of D6.4 section 5.2."""

    def __init__(
        self,
        rigid: Rigid,
        description: Description,
        name: str = "",
        index: int = 0,
        pose: np.ndarray | None = None,
    ) -> None:
        super().__init__(rigid, description, name, index, pose)
        drives = description.drives
        self.lower = np.array([drive.lower for drive in drives])
        self.upper = np.array([drive.upper for drive in drives])
        self.speed = np.array([drive.velocity for drive in drives])
        """[joint] largest speeds [rad/s or m/s]"""
        self.effort = np.array([drive.effort for drive in drives])
        """[joint] largest efforts [N m or N]"""
        self._stiffness = np.array([drive.stiffness for drive in drives])
        self._damping = np.array([drive.damping for drive in drives])
        self._order = {drive.joint: i for i, drive in enumerate(drives)}
        self.stop()

    def stop(self) -> None:
        """Forget all commands and hold every joint and the base where they are."""
        self.setpoint = self.rigid.read(self.name)[0].copy()
        """[joint] what the servos are asked for [rad or m]"""
        self.interface = np.full(len(self.setpoint), Interface.POSITION)
        """[joint] :class:`Interface` by which each was commanded last"""
        self._goal = self.setpoint.copy()
        self._retuned = True
        self._base_goal = np.zeros(2)
        self._base_velocity = np.zeros(2)
        self._base_time = -np.inf

    # ------------------------------------------------------------------ commands

    def joint_indices(self, joints: Sequence[str] | np.ndarray | None) -> np.ndarray:
        """Positions in joint arrays of joints given by name; indices stay what they are, None means all."""
        if joints is None:
            return np.arange(len(self.setpoint))
        if isinstance(joints, np.ndarray):
            return joints
        try:
            return np.array([self._order[joint] for joint in joints], int)
        except KeyError as error:
            known = ", ".join(self._order)
            raise CommandError(f"{self.name} has no drive for {error.args[0]!r}; it drives: {known}") from None

    def command_position(
        self, position: Sequence[float] | np.ndarray, joints: Sequence[str] | np.ndarray | None = None
    ) -> None:
        """Go to positions [rad or m] as fast as the joints may; beyond a limit means to the limit."""
        i, values = self._checked(position, joints)
        self._goal[i] = np.clip(values, self.lower[i], self.upper[i])
        self._switch(i, Interface.POSITION)

    def command_velocity(
        self, velocity: Sequence[float] | np.ndarray, joints: Sequence[str] | np.ndarray | None = None
    ) -> None:
        """Move with velocities [rad/s or m/s] until the joints' limits."""
        i, values = self._checked(velocity, joints)
        self._goal[i] = np.clip(values, -self.speed[i], self.speed[i])
        self._switch(i, Interface.VELOCITY)

    def command_effort(
        self, effort: Sequence[float] | np.ndarray, joints: Sequence[str] | np.ndarray | None = None
    ) -> None:
        """Transmit efforts [N m or N] beyond the weight, which the drives carry; zero lets the joint be moved."""
        i, values = self._checked(effort, joints)
        self._goal[i] = np.clip(values, -self.effort[i], self.effort[i])
        self._switch(i, Interface.EFFORT)

    def command_gripper(self, group: str, opening: float) -> None:
        """Open a gripper's fingers to ``opening`` [m] between them (sum over prismatic fingers) or [rad]."""
        fingers = self.description.indices(group)
        self.command_position(np.full(len(fingers), opening / len(fingers)), fingers)

    def command_base(self, linear: float, angular: float, time: float) -> None:
        """Drive with ``linear`` [m/s] ahead and ``angular`` [rad/s] to the left; lapses after the timeout."""
        if not np.isfinite([linear, angular]).all():
            raise CommandError(f"{self.name}: base velocity ({linear}, {angular}) is not finite")
        limits = self.description.base_limits
        self._base_goal[:] = (
            np.clip(linear, -limits.linear, limits.linear),
            np.clip(angular, -limits.angular, limits.angular),
        )
        self._base_time = time

    def command_impedance(
        self,
        stiffness: Sequence[float] | np.ndarray,
        damping: Sequence[float] | np.ndarray,
        joints: Sequence[str] | np.ndarray | None = None,
    ) -> None:
        """Be compliant: gains [N m/rad, N m s/rad or N/m, N s/m] of joints commanded by position or velocity.

        D6.4 section 3.1. Kept until given anew; :meth:`stop` leaves them.
        """
        i, stiff = self._checked(stiffness, joints)
        _, damp = self._checked(damping, joints)
        if (stiff < 0.0).any() or (damp < 0.0).any():
            raise CommandError(f"{self.name}: gains below zero would feed energy in; give 0 or more")
        self._stiffness[i], self._damping[i] = stiff, damp
        self._retuned = True

    def _switch(self, joints: np.ndarray, interface: Interface) -> None:
        if interface == Interface.EFFORT or (self.interface[joints] == Interface.EFFORT).any():
            self._retuned = True
        self.interface[joints] = interface

    def _checked(
        self, values: Sequence[float] | np.ndarray, joints: Sequence[str] | np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        i, values = self.joint_indices(joints), np.asarray(values, float)
        if values.shape != i.shape:
            raise CommandError(f"{self.name}: {values.size} values for {len(i)} joints; give one each")
        if not np.isfinite(values).all():
            bad = self.description.joints[i[np.flatnonzero(~np.isfinite(values))[0]]]
            raise CommandError(f"{self.name}: command for {bad!r} is not finite; give a number")
        return i, values

    # ------------------------------------------------------------------ each tick

    def control(self, time: float) -> None:
        """Hand set-points for the tick that starts at ``time`` [s] to the servos; call it before physics steps."""
        dt = self.rigid.dt
        position = self.rigid.read(self.name)[0]
        by_velocity = self.interface == Interface.VELOCITY
        by_effort = self.interface == Interface.EFFORT

        # A servo that already gives all it has gives no more when asked for more, but would overshoot when let go.
        lead = self.effort / np.maximum(self._stiffness, 1e-9) + self.speed * dt
        start = np.where(by_effort, position, np.clip(self.setpoint, position - lead, position + lead))
        step = np.where(by_velocity, self._goal * dt, np.where(by_effort, 0.0, self._goal - start))
        target = np.clip(start + np.clip(step, -self.speed * dt, self.speed * dt), self.lower, self.upper)
        self.setpoint = target
        self.rigid.command(self.name, target, np.where(by_effort, 0.0, (target - start) / dt))
        if self._retuned:
            self.rigid.tune(
                self.name,
                np.where(by_effort, 0.0, self._stiffness),
                np.where(by_effort, 0.0, self._damping),
                np.where(by_effort, self._goal, 0.0),
            )
            self._retuned = False

        limits = self.description.base_limits
        goal = self._base_goal if time - self._base_time <= limits.timeout else np.zeros(2)
        change = dt * np.array([limits.linear_acceleration, limits.angular_acceleration])
        self._base_velocity += np.clip(goal - self._base_velocity, -change, change)
        self.rigid.drive_base(self.name, (self._base_velocity[0], 0.0, self._base_velocity[1]))

    def update(self, time: float) -> RobotUpdate:
        """What other clients are told: actual joints, never commands."""
        position, velocity, _, _ = self.rigid.read(self.name)
        base_q, base_qd = self.rigid.base(self.name)
        return RobotUpdate(self.name, time, base_q, base_qd, position, velocity)


class RemoteRobot(Embodied):
    """The copy of a robot that another client controls: pulled to its states, yet it can be held and pushed."""

    SNAP = 1.0
    """Distance [m] beyond which the copy is set down anew instead of pulled."""

    def follow(self, update: RobotUpdate) -> None:
        """Pull the copy to the state of ``update`` from now on."""
        count = len(self.description.drives)
        if update.position.shape != (count,) or update.velocity.shape != (count,):
            raise CommandError(
                f"{self.name}: update has {update.position.size} joints, its description {count}; "
                "load the same robot on both clients"
            )
        here, _ = self.rigid.base(self.name)
        if np.linalg.norm(update.base_q[:3] - here[:3]) > self.SNAP:
            self._set_down(update, here)
        self.rigid.follow(self.name, update.base_q, update.base_qd, update.position, update.velocity)

    def _set_down(self, update: RobotUpdate, here: np.ndarray) -> None:
        if abs(update.base_q[2] - here[2]) > 1e-3:  # a base rolls on its plane; another height is another world
            self.rigid.remove_robot(self.name)
            self.rigid.add_robot(self.description.spec(self.name, self._index, update.base_q))
        self.rigid.place(self.name, update.base_q, update.position)
