"""A robot in this client's world: commands in, limited set-points out, and what it knows of itself.

    robot = Robot(rigid, load("vinebot"), "robot_1")
    robot.command_position([0.3], ["torso_lift_joint"])
    robot.command_base(0.4, 0.0, time)
    ...
    robot.control(time)           # before each step of physics
    sample = robot.sample(time)   # after it

Servos and effort limits act in physics; what is asked of them stays within the URDF's limits here, so a step of a
position command becomes a ramp at the joint's largest speed, as in the joint_limits of ros2_control.

A drive is a motor behind a spring (D6.4 section 3.1). The motor's own control is taken to be fast: it turns to where
the spring gives what position, velocity, effort or impedance control asks for. Commanded itself, it stays put.
"""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Sequence

import numpy as np

from vinesim import frames
from vinesim.physics.plants.detachment import Blade
from vinesim.physics.rigid.rigid_world import RigidWorld
from vinesim.physics.step import Physics
from vinesim.robot.description.description import Description, Mount
from vinesim.scene.values import Contact, ElasticSample, Imu, JointSample, RobotSample, RobotUpdate, Wrench

SPARE = 0.7
"""Share of its effort that a drive may spend on gaining speed: the rest carries weight and meets resistance."""


class Interface(enum.IntEnum):
    """What a joint is commanded by; D6.4 names the first three in section 5.2, elastic elements in section 3.1."""

    POSITION = 0
    VELOCITY = 1
    EFFORT = 2
    ELASTIC = 3


class CommandError(ValueError):
    """A command that no joint can take; the text says which and why."""


class Embodied:
    """A robot that stands in the rigid world, whoever moves it."""

    def __init__(
        self,
        rigid: RigidWorld,
        description: Description,
        name: str = "",
        index: int = 0,
        pose: np.ndarray | None = None,
        *,
        here: bool = False,
    ) -> None:
        """``here``: it was admitted to ``rigid`` already."""
        self.rigid = rigid
        self.description = description
        self.name = name or description.name
        self._index = index
        spec = description.spec(self.name, index, pose)
        if not here:
            rigid.add_robot(spec)
        back = frames.conjugate(spec.pose[3:])
        self._start = spec.pose[:3].copy()
        self._start_turn = frames.to_matrix(back)
        self._start_left = frames.multiply(back, np.eye(4)).T
        """[4, 4]: quaternion product with the inverse of the start's, as a matrix"""
        self._odometer = Odometer(*description.base_limits.slip, spec.pose)

    def leave(self) -> None:
        """Take it out of the world."""
        self.rigid.remove_robot(self.name)

    def sample(self, time: float, contacts: Sequence[Contact] = ()) -> RobotSample:
        """What the robot knows of itself at ``time`` [s]; of ``contacts`` it keeps its own."""
        position, velocity, effort, contact = self.rigid.joint_measurements(self.name)
        base_q, base_qd = self.rigid.base_state(self.name)
        return RobotSample(
            actor=self.name,
            joints=JointSample(time, self.description.joints, position, velocity, effort, contact),
            base_q=base_q,
            base_qd=base_qd,
            odom_q=self._odometry(base_q),
            transforms=self.description.moving.frames,
            transform_q=self.description.moving.poses(position),
            contacts=tuple(c for c in contacts if c.actor == self.name),
        )

    def frame_pose(self, frame: str) -> np.ndarray:
        """World pose [7] of any link of the URDF: where a sensor sits now."""
        return self.rigid.link_pose(self.name, frame)

    def _odometry(self, base_q: np.ndarray) -> np.ndarray:
        """Pose [7] since the start as the tracks tell it: exact, unless they slip."""
        if any(self.description.base_limits.slip):
            return self._odometer.roll(base_q)
        return np.concatenate([self._start_turn @ (base_q[:3] - self._start), self._start_left @ base_q[3:]])


class Odometer:
    """Dead reckoning of tracks that slip: they travel farther than the base, and believe in what they travelled."""

    def __init__(self, ahead: float, turning: float, pose: np.ndarray) -> None:
        """``ahead``, ``turning``: shares of the travel that are lost; ``pose`` [7] of the base at the start."""
        self._gain = 1.0 / (1.0 - ahead), 1.0 / (1.0 - turning)
        self._seen = float(pose[0]), float(pose[1]), frames.to_yaw(pose[3:])
        self._believed = 0.0, 0.0, 0.0

    def roll(self, base_q: np.ndarray) -> np.ndarray:
        """Count the way to ``base_q`` [7] and return the pose [7] since the start as odometry believes it."""
        x, y, yaw = self._seen
        self._seen = float(base_q[0]), float(base_q[1]), frames.to_yaw(base_q[3:])
        turn = (self._seen[2] - yaw + np.pi) % (2.0 * np.pi) - np.pi
        c, s = np.cos(yaw + 0.5 * turn), np.sin(yaw + 0.5 * turn)
        way = self._seen[0] - x, self._seen[1] - y
        ahead, left = self._gain[0] * (c * way[0] + s * way[1]), c * way[1] - s * way[0]
        turn *= self._gain[1]
        x, y, yaw = self._believed
        c, s = np.cos(yaw + 0.5 * turn), np.sin(yaw + 0.5 * turn)
        self._believed = x + c * ahead - s * left, y + s * ahead + c * left, yaw + turn
        return frames.pose([*self._believed[:2], 0.0], frames.from_yaw(self._believed[2]))


class Robot(Embodied):
    """A robot that this client controls: the local robot of D6.4 section 5.2."""

    def __init__(
        self,
        rigid: RigidWorld,
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
        self._compliant = np.zeros(len(drives), bool)
        """[joint] whose gains were asked for, so that they must be right to the letter"""
        self._limit = self.effort.copy()
        self.spring = np.array([drive.elastic or drive.stiffness or drive.effort / 0.05 for drive in drives])
        """[joint] stiffnesses of the series elastic elements [N m/rad or N/m]"""
        self._spring_damping = np.array([drive.elastic_damping if drive.elastic else drive.damping for drive in drives])
        self._order = {drive.joint: i for i, drive in enumerate(drives)}
        self._grippers: dict[str, np.ndarray] = {}
        """Fingers that close together: a hand that drifted with what it holds would be two hands."""
        self._cutters: dict[str, list[Blade]] = {}
        self._physics: Physics | None = None
        for mount in (*description.wrenches, *description.imus):
            rigid.add_link_sensor(self.name, mount.frame)
        self._beyond = {mount.frame: _links_beyond(description, mount.frame) for mount in description.wrenches}
        self.stop()

    def fit_cutters(self, physics: Physics) -> None:
        """Give the robot the cutters of its description, to cut what grows in ``physics``."""
        self._physics = physics
        for cutter in self.description.cutters:
            blade = physics.add_blade(self.name, cutter.frame, frames.pose(cutter.origin), np.array(cutter.half))
            self._cutters.setdefault(cutter.group, []).append(blade)

    def leave(self) -> None:
        """Take it out of the world, its cutters with it."""
        if self._physics is not None:
            self._physics.remove_robot(self.name)
        else:
            super().leave()

    def stop(self) -> None:
        """Forget all commands and hold every joint and the base where they are."""
        self.setpoint = self.rigid.joint_measurements(self.name)[0].copy()
        """[joint] what the servos are asked for [rad or m]"""
        self.interface = np.full(len(self.setpoint), Interface.POSITION)
        """[joint] :class:`Interface` by which each was commanded last"""
        self._goal = self.setpoint.copy()
        self._velocity = np.zeros(len(self.setpoint))
        self._rate = np.zeros(len(self.setpoint))
        self._braked = np.zeros(len(self.setpoint), bool)
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

    def command_elastic(
        self, motor: Sequence[float] | np.ndarray, joints: Sequence[str] | np.ndarray | None = None
    ) -> None:
        """Hold the motors at positions [rad or m]; each link hangs on its spring and sags by load over stiffness.

        Nothing makes up for the weight, as nothing but the spring connects the two (D6.4 section 3.1).
        """
        i, values = self._checked(motor, joints)
        self._goal[i] = values
        self._switch(i, Interface.ELASTIC)

    def command_gripper(self, group: str, opening: float, effort: float | None = None) -> None:
        """Open a gripper's fingers to ``opening`` [m] between them (sum over prismatic fingers) or [rad].

        ``effort`` is the most that each finger may give [N or N m], the drives' own unless it is given. What lies
        between the fingers is held by friction alone.
        """
        fingers = self._gripper(group)
        if effort is not None and not effort > 0.0:
            raise CommandError(f"{self.name}: gripper effort {effort}; give more than 0, or none for all there is")
        self.command_position(np.full(len(fingers), opening / len(fingers)), fingers)
        self._grippers[group] = fingers
        self._limit[fingers] = self.effort[fingers] if effort is None else np.minimum(effort, self.effort[fingers])
        self._retuned = True

    def command_cutter(self, group: str) -> None:
        """Close the cutter of a gripper, and open it again: what is in its mouth at the end of the tick is cut."""
        if group not in self._cutters:
            known = ", ".join(sorted(self._cutters)) or "none"
            raise CommandError(f"{self.name} has no cutter at {group!r}; cutters fitted: {known}")
        for blade in self._cutters[group]:
            blade.close()

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
        self._compliant[i] = True
        self._retuned = True

    def stiffen(self, joints: Sequence[str] | np.ndarray | None = None) -> None:
        """Give joints back the stiff servos of their description."""
        i, drives = self.joint_indices(joints), self.description.drives
        self._stiffness[i] = [drives[j].stiffness for j in i]
        self._damping[i] = [drives[j].damping for j in i]
        self._compliant[i] = False
        self._retuned = True

    def _gripper(self, group: str) -> np.ndarray:
        if group not in self.description.groups:
            known = ", ".join(self.description.groups)
            raise CommandError(f"{self.name} has no gripper {group!r}; its groups are: {known}")
        return self.description.indices(group)

    def _switch(self, joints: np.ndarray, interface: Interface) -> None:
        before = self.interface[joints] == Interface.ELASTIC
        if before.any() or interface == Interface.ELASTIC:  # from motors to links, or back
            position, _, effort, _ = self.rigid.joint_measurements(self.name)
            motor = position + effort / self.spring
            self.setpoint[joints] = np.where(
                before == (interface == Interface.ELASTIC),
                self.setpoint[joints],
                np.where(before, position[joints], motor[joints]),
            )
        self.interface[joints] = interface
        self._retuned = True

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
        if self._retuned:
            self._arrange()
        position, velocity = self.rigid.joint_state(self.name)
        rate = self._advance(position, velocity)
        if self._retuned or self._changing:
            braked, brake = self._brakes(velocity)
            self._tune(braked, brake)
            rate = np.where(braked, np.copysign(self.speed, velocity), rate)
        self._velocity = velocity
        self.rigid.command(self.name, self.setpoint, rate)
        self._drive(time)
        self._odometry(self.rigid.base_state(self.name)[0])

    def _arrange(self) -> None:
        """Prepare what changes only with the interfaces, gains and limits."""
        self._by_effort, self._by_motor = self.interface == Interface.EFFORT, self.interface == Interface.ELASTIC
        self._by_velocity = np.flatnonzero(self.interface == Interface.VELOCITY)
        self._changing = bool(self._by_effort.any() or self._by_motor.any())
        """Whether gains follow the state, so that they must be set in every tick."""
        self._spring_in_use = np.where(self._by_motor, self.spring, self._stiffness)
        self._lead = self._limit / np.maximum(self._spring_in_use, 1e-9) + self.speed * self.rigid.dt
        self._gain = SPARE * self.rigid.dt * self._limit

    def _advance(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Move the set-points on by a tick; their rates [joint]."""
        dt = self.rigid.dt
        # A servo that already gives all it has gives no more when asked for more, but would overshoot when let go.
        middle = position
        if self._grippers:
            middle = position.copy()
            for fingers in self._grippers.values():
                middle[fingers] = position[fingers].mean()
        start = np.clip(self.setpoint, middle - self._lead, middle + self._lead)
        wanted = (self._goal - start) / dt
        wanted[self._by_velocity] = self._goal[self._by_velocity]
        # Nor may it run ahead faster than the drive can follow: at its limit the servo would shoot past the speed.
        gain = self._gain / np.maximum(self.rigid.joint_inertia(self.name), 1e-9)
        slowest = np.maximum(np.minimum(self._rate, 0.0) - gain, -self.speed)
        fastest = np.minimum(np.maximum(self._rate, 0.0) + gain, self.speed)
        rate = np.clip(wanted, slowest, fastest)
        if self._changing:
            start, rate = np.where(self._by_effort, position, start), np.where(self._by_effort, 0.0, rate)
        self.setpoint = np.clip(start + dt * rate, self.lower, self.upper)
        rate = (self.setpoint - start) / dt
        self._rate = np.where(self._by_effort, velocity, rate)
        return rate

    def _brakes(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joints whose effort would drive them too fast, bool, and the damping about their largest speed [joint].

        90 % of the speed are free. It looks a tick ahead, and brakes no harder than the effort that was asked for:
        at its limit a servo does not feel how the speed falls within the tick.
        """
        towards = np.copysign(1.0, velocity)
        brake, along = 10.0 * self.effort / self.speed, towards * self._goal
        ahead = towards * (2.0 * velocity - self._velocity)
        near = (along > brake * (self.speed - ahead)) | (self._braked & (np.abs(velocity) > 0.5 * self.speed))
        self._braked = near & (along >= 0.0) & self._by_effort
        spare = self.speed - np.abs(velocity)
        most = 0.8 * np.where(spare > 0.0, along, self.effort)
        return self._braked, np.minimum(brake, most / np.maximum(np.abs(spare), 1e-9))

    def _tune(self, braked: np.ndarray, brake: np.ndarray) -> None:
        """Give the servos the gains and efforts that the interfaces ask for."""
        by_effort, by_motor = self._by_effort, self._by_motor
        damping = np.where(by_motor, self._spring_damping, self._damping)
        effort = np.where(by_motor, -self.rigid.gravity_effort(self.name), 0.0)
        self.rigid.set_gains(
            self.name,
            np.where(by_effort, 0.0, self._spring_in_use),
            np.where(braked, brake, np.where(by_effort, 0.0, damping)),
            np.where(by_effort & ~braked, self._goal, effort),
            limit=self._limit,
            exact=by_motor | (self._compliant & ~by_effort),
        )
        self._retuned = False

    def _drive(self, time: float) -> None:
        """Let the base gain and lose speed as it may."""
        limits = self.description.base_limits
        goal = self._base_goal if time - self._base_time <= limits.timeout else np.zeros(2)
        change = self.rigid.dt * np.array([limits.linear_acceleration, limits.angular_acceleration])
        self._base_velocity += np.clip(goal - self._base_velocity, -change, change)
        self.rigid.command_base(self.name, (self._base_velocity[0], 0.0, self._base_velocity[1]))

    def sample(self, time: float, contacts: Sequence[Contact] = ()) -> RobotSample:
        """What the robot knows of itself at ``time`` [s], sensors and elastic elements included."""
        known = super().sample(time, contacts)
        effort = known.joints.effort
        deflection = effort / self.spring
        elements = ElasticSample(
            time, self.description.joints, self.spring, known.joints.position + deflection, deflection,
            self.spring * deflection,
        )  # fmt: skip
        return dataclasses.replace(
            known,
            elements=elements,
            wrenches=tuple(self._wrench(mount, time, known.contacts) for mount in self.description.wrenches),
            imus=tuple(self._imu(mount, time) for mount in self.description.imus),
        )

    def _wrench(self, mount: Mount, time: float, contacts: Sequence[Contact]) -> Wrench:
        wrench = self.rigid.link_wrench(self.name, mount.frame)
        mine = [contact for contact in contacts if contact.link in self._beyond[mount.frame]]
        if mine:  # with plants, which the rigid world does not know
            pose = self.frame_pose(mount.frame)
            back = frames.conjugate(pose[3:])
            force = np.array([contact.force for contact in mine])
            arm = np.array([contact.position for contact in mine]) - pose[:3]
            wrench[:3] += frames.rotate(back, force.sum(0))
            wrench[3:] += frames.rotate(back, frames.cross(arm, force).sum(0))
        return Wrench(time, mount.name, mount.frame, wrench[:3], wrench[3:])

    def _imu(self, mount: Mount, time: float) -> Imu:
        turn = self.frame_pose(mount.frame)[3:]
        spin = self.rigid.link_angular_velocity(self.name, mount.frame)
        acceleration = self.rigid.link_acceleration(self.name, mount.frame)[3:]
        return Imu(time, mount.name, mount.frame, turn, spin, acceleration)

    def update(self, time: float) -> RobotUpdate:
        """What other clients are told: actual joints, never commands."""
        position, velocity, _, _ = self.rigid.joint_measurements(self.name)
        base_q, base_qd = self.rigid.base_state(self.name)
        return RobotUpdate(self.name, time, base_q, base_qd, position, velocity)


def _links_beyond(description: Description, frame: str) -> frozenset[str]:
    """A link and all that hangs on it."""
    beyond = {frame}
    joints = (*description.fixed, *description.moving.frames)
    while more := {child for parent, child in joints if parent in beyond} - beyond:
        beyond |= more
    return frozenset(beyond)


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
        here, _ = self.rigid.base_state(self.name)
        if np.linalg.norm(update.base_q[:3] - here[:3]) > self.SNAP:
            self._set_down(update, here)
        self.rigid.follow_remote(self.name, update.base_q, update.base_qd, update.position, update.velocity)

    def _set_down(self, update: RobotUpdate, here: np.ndarray) -> None:
        if abs(update.base_q[2] - here[2]) > 1e-3:  # a base rolls on its plane; another height is another world
            self.rigid.remove_robot(self.name)
            self.rigid.add_robot(self.description.spec(self.name, self._index, update.base_q))
        self.rigid.place_robot(self.name, update.base_q, update.position)
