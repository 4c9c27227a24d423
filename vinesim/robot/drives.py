"""A robot in this client's world: commands in, limited set-points out, and what it knows of itself.

    robot = Robot(rigid, load_description("vinebot"), "robot_1")
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
from vinesim.robot.description.description import RobotDescription, SensorMount
from vinesim.scene.values import Contact, ElasticSample, Imu, JointSample, RobotSample, RobotUpdate, Wrench

ACCELERATION_EFFORT_SHARE = 0.7
"""Share of its effort that a drive may spend on gaining speed: the rest carries weight and meets resistance."""


class CommandInterface(enum.IntEnum):
    """What a joint is commanded by; D6.4 names the first three in section 5.2, elastic elements in section 3.1."""

    POSITION = 0
    VELOCITY = 1
    EFFORT = 2
    MOTOR_POSITION = 3


class CommandError(ValueError):
    """A command that no joint can take; the text says which and why."""


class RobotInstance:
    """A robot that stands in the rigid world, whoever moves it."""

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
        """``is_in_world``: it was added to ``rigid`` already."""
        self.rigid = rigid
        self.description = description
        self.name = name or description.name
        self._index = index
        spec = description.to_spec(self.name, index, pose)
        if not is_in_world:
            rigid.add_robot(spec)
        back = frames.conjugate(spec.pose[3:])
        self._start = spec.pose[:3].copy()
        self._start_turn = frames.to_matrix(back)
        self._start_left = frames.multiply(back, np.eye(4)).T
        """[4, 4]: quaternion product with the inverse of the start's, as a matrix"""
        self._odometer = TrackOdometry(*description.base_limits.slip, spec.pose)

    def remove(self) -> None:
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
            transforms=self.description.moving_joints.frames,
            transform_q=self.description.moving_joints.poses(position),
            contacts=tuple(c for c in contacts if c.actor == self.name),
        )

    def frame_pose(self, frame: str) -> np.ndarray:
        """World pose [7] of any link of the URDF: where a sensor sits now."""
        return self.rigid.link_pose(self.name, frame)

    def _odometry(self, base_q: np.ndarray) -> np.ndarray:
        """Pose [7] since the start as the tracks tell it: exact, unless they slip."""
        if any(self.description.base_limits.slip):
            return self._odometer.update(base_q)
        return np.concatenate([self._start_turn @ (base_q[:3] - self._start), self._start_left @ base_q[3:]])


class TrackOdometry:
    """Dead reckoning of tracks that slip: they travel farther than the base, and believe in what they travelled."""

    def __init__(self, ahead: float, turning: float, pose: np.ndarray) -> None:
        """``ahead``, ``turning``: shares of the travel that are lost; ``pose`` [7] of the base at the start."""
        self._gain = 1.0 / (1.0 - ahead), 1.0 / (1.0 - turning)
        self._seen = float(pose[0]), float(pose[1]), frames.to_yaw(pose[3:])
        self._believed = 0.0, 0.0, 0.0

    def update(self, base_q: np.ndarray) -> np.ndarray:
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


class Robot(RobotInstance):
    """A robot that this client controls: the local robot of D6.4 section 5.2."""

    def __init__(
        self,
        rigid: RigidWorld,
        description: RobotDescription,
        name: str = "",
        index: int = 0,
        pose: np.ndarray | None = None,
    ) -> None:
        super().__init__(rigid, description, name, index, pose)
        drives = description.drives
        self.lower_limit = np.array([drive.lower for drive in drives])
        self.upper_limit = np.array([drive.upper for drive in drives])
        self.max_velocity = np.array([drive.velocity for drive in drives])
        """[joint] largest speeds [rad/s or m/s]"""
        self.max_effort = np.array([drive.effort for drive in drives])
        """[joint] largest efforts [N m or N]"""
        self._stiffness = np.array([drive.stiffness for drive in drives])
        self._damping = np.array([drive.damping for drive in drives])
        self._is_compliant = np.zeros(len(drives), bool)
        """[joint] whose gains were asked for, so that they must be right to the letter"""
        self._effort_limit = self.max_effort.copy()
        self.series_stiffness = np.array(
            [drive.series_stiffness or drive.stiffness or drive.effort / 0.05 for drive in drives]
        )
        """[joint] stiffnesses of the series elastic elements [N m/rad or N/m]"""
        self._series_damping = np.array(
            [drive.series_damping if drive.series_stiffness else drive.damping for drive in drives]
        )
        self._joint_index = {drive.joint: i for i, drive in enumerate(drives)}
        self._finger_groups: dict[str, np.ndarray] = {}
        """Fingers that close together: a hand that drifted with what it holds would be two hands."""
        self._cutters: dict[str, list[Blade]] = {}
        self._physics: Physics | None = None
        for mount in (*description.wrenches, *description.imus):
            rigid.add_link_sensor(self.name, mount.frame)
        self._links_beyond_sensor = {
            mount.frame: _subtree_links(description, mount.frame) for mount in description.wrenches
        }
        self.stop()

    def fit_cutters(self, physics: Physics) -> None:
        """Give the robot the cutters of its description, to cut what grows in ``physics``."""
        self._physics = physics
        for cutter in self.description.cutters:
            blade = physics.add_blade(self.name, cutter.frame, frames.pose(cutter.origin), np.array(cutter.half))
            self._cutters.setdefault(cutter.group, []).append(blade)

    def remove(self) -> None:
        """Take it out of the world, its cutters with it."""
        if self._physics is not None:
            self._physics.remove_robot(self.name)
        else:
            super().remove()

    def stop(self) -> None:
        """Forget all commands and hold every joint and the base where they are."""
        self.setpoint = self.rigid.joint_measurements(self.name)[0].copy()
        """[joint] what the servos are asked for [rad or m]"""
        self.interface = np.full(len(self.setpoint), CommandInterface.POSITION)
        """[joint] :class:`CommandInterface` by which each was commanded last"""
        self._command = self.setpoint.copy()
        self._velocity = np.zeros(len(self.setpoint))
        self._rate = np.zeros(len(self.setpoint))
        self._is_speed_limited = np.zeros(len(self.setpoint), bool)
        self._gains_changed = True
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
            return np.array([self._joint_index[joint] for joint in joints], int)
        except KeyError as error:
            known = ", ".join(self._joint_index)
            raise CommandError(f"{self.name} has no drive for {error.args[0]!r}; it drives: {known}") from None

    def command_position(
        self, position: Sequence[float] | np.ndarray, joints: Sequence[str] | np.ndarray | None = None
    ) -> None:
        """Go to positions [rad or m] as fast as the joints may; beyond a limit means to the limit."""
        i, values = self._validated(position, joints)
        self._command[i] = np.clip(values, self.lower_limit[i], self.upper_limit[i])
        self._switch_interface(i, CommandInterface.POSITION)

    def command_velocity(
        self, velocity: Sequence[float] | np.ndarray, joints: Sequence[str] | np.ndarray | None = None
    ) -> None:
        """Move with velocities [rad/s or m/s] until the joints' limits."""
        i, values = self._validated(velocity, joints)
        self._command[i] = np.clip(values, -self.max_velocity[i], self.max_velocity[i])
        self._switch_interface(i, CommandInterface.VELOCITY)

    def command_effort(
        self, effort: Sequence[float] | np.ndarray, joints: Sequence[str] | np.ndarray | None = None
    ) -> None:
        """Transmit efforts [N m or N] beyond the weight, which the drives carry; zero lets the joint be moved."""
        i, values = self._validated(effort, joints)
        self._command[i] = np.clip(values, -self.max_effort[i], self.max_effort[i])
        self._switch_interface(i, CommandInterface.EFFORT)

    def command_motor_position(
        self, motor: Sequence[float] | np.ndarray, joints: Sequence[str] | np.ndarray | None = None
    ) -> None:
        """Hold the motors at positions [rad or m]; each link hangs on its spring and sags by load over stiffness.

        Nothing makes up for the weight, as nothing but the spring connects the two (D6.4 section 3.1).
        """
        i, values = self._validated(motor, joints)
        self._command[i] = values
        self._switch_interface(i, CommandInterface.MOTOR_POSITION)

    def command_gripper(self, group: str, opening: float, effort: float | None = None) -> None:
        """Open a gripper's fingers to ``opening`` [m] between them (sum over prismatic fingers) or [rad].

        ``effort`` is the most that each finger may give [N or N m], the drives' own unless it is given. What lies
        between the fingers is held by friction alone.
        """
        fingers = self._gripper_indices(group)
        if effort is not None and not effort > 0.0:
            raise CommandError(f"{self.name}: gripper effort {effort}; give more than 0, or none for all there is")
        self.command_position(np.full(len(fingers), opening / len(fingers)), fingers)
        self._finger_groups[group] = fingers
        self._effort_limit[fingers] = (
            self.max_effort[fingers] if effort is None else np.minimum(effort, self.max_effort[fingers])
        )
        self._gains_changed = True

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
        i, stiff = self._validated(stiffness, joints)
        _, damp = self._validated(damping, joints)
        if (stiff < 0.0).any() or (damp < 0.0).any():
            raise CommandError(f"{self.name}: gains below zero would feed energy in; give 0 or more")
        self._stiffness[i], self._damping[i] = stiff, damp
        self._is_compliant[i] = True
        self._gains_changed = True

    def reset_gains(self, joints: Sequence[str] | np.ndarray | None = None) -> None:
        """Give joints back the stiff servos of their description."""
        i, drives = self.joint_indices(joints), self.description.drives
        self._stiffness[i] = [drives[j].stiffness for j in i]
        self._damping[i] = [drives[j].damping for j in i]
        self._is_compliant[i] = False
        self._gains_changed = True

    def _gripper_indices(self, group: str) -> np.ndarray:
        if group not in self.description.groups:
            known = ", ".join(self.description.groups)
            raise CommandError(f"{self.name} has no gripper {group!r}; its groups are: {known}")
        return self.description.joint_indices(group)

    def _switch_interface(self, joints: np.ndarray, interface: CommandInterface) -> None:
        before = self.interface[joints] == CommandInterface.MOTOR_POSITION
        if before.any() or interface == CommandInterface.MOTOR_POSITION:  # from motors to links, or back
            position, _, effort, _ = self.rigid.joint_measurements(self.name)
            motor = position + effort / self.series_stiffness
            self.setpoint[joints] = np.where(
                before == (interface == CommandInterface.MOTOR_POSITION),
                self.setpoint[joints],
                np.where(before, position[joints], motor[joints]),
            )
        self.interface[joints] = interface
        self._gains_changed = True

    def _validated(
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
        if self._gains_changed:
            self._prepare_interfaces()
        position, velocity = self.rigid.joint_state(self.name)
        rate = self._advance_setpoints(position, velocity)
        if self._gains_changed or self._gains_vary:
            braked, brake = self._speed_limiters(velocity)
            self._apply_gains(braked, brake)
            rate = np.where(braked, np.copysign(self.max_velocity, velocity), rate)
        self._velocity = velocity
        self.rigid.command(self.name, self.setpoint, rate)
        self._command_base_velocity(time)
        self._odometry(self.rigid.base_state(self.name)[0])

    def _prepare_interfaces(self) -> None:
        """Prepare what changes only with the interfaces, gains and limits."""
        self._in_effort, self._in_motor_position = (
            self.interface == CommandInterface.EFFORT,
            self.interface == CommandInterface.MOTOR_POSITION,
        )
        self._velocity_joints = np.flatnonzero(self.interface == CommandInterface.VELOCITY)
        self._gains_vary = bool(self._in_effort.any() or self._in_motor_position.any())
        """Whether gains follow the state, so that they must be set in every tick."""
        self._active_stiffness = np.where(self._in_motor_position, self.series_stiffness, self._stiffness)
        self._max_tracking_error = (
            self._effort_limit / np.maximum(self._active_stiffness, 1e-9) + self.max_velocity * self.rigid.dt
        )
        self._max_impulse = ACCELERATION_EFFORT_SHARE * self.rigid.dt * self._effort_limit

    def _advance_setpoints(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Move the set-points on by a tick; their rates [joint]."""
        dt = self.rigid.dt
        # A servo that already gives all it has gives no more when asked for more, but would overshoot when let go.
        middle = position
        if self._finger_groups:
            middle = position.copy()
            for fingers in self._finger_groups.values():
                middle[fingers] = position[fingers].mean()
        start = np.clip(self.setpoint, middle - self._max_tracking_error, middle + self._max_tracking_error)
        wanted = (self._command - start) / dt
        wanted[self._velocity_joints] = self._command[self._velocity_joints]
        # Nor may it run ahead faster than the drive can follow: at its limit the servo would shoot past the speed.
        gain = self._max_impulse / np.maximum(self.rigid.joint_inertia(self.name), 1e-9)
        slowest = np.maximum(np.minimum(self._rate, 0.0) - gain, -self.max_velocity)
        fastest = np.minimum(np.maximum(self._rate, 0.0) + gain, self.max_velocity)
        rate = np.clip(wanted, slowest, fastest)
        if self._gains_vary:
            start, rate = np.where(self._in_effort, position, start), np.where(self._in_effort, 0.0, rate)
        self.setpoint = np.clip(start + dt * rate, self.lower_limit, self.upper_limit)
        rate = (self.setpoint - start) / dt
        self._rate = np.where(self._in_effort, velocity, rate)
        return rate

    def _speed_limiters(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joints whose effort would drive them too fast, bool, and the damping about their largest speed [joint].

        90 % of the speed are free. It looks a tick ahead, and brakes no harder than the effort that was asked for:
        at its limit a servo does not feel how the speed falls within the tick.
        """
        towards = np.copysign(1.0, velocity)
        brake, along = 10.0 * self.max_effort / self.max_velocity, towards * self._command
        ahead = towards * (2.0 * velocity - self._velocity)
        near = (along > brake * (self.max_velocity - ahead)) | (
            self._is_speed_limited & (np.abs(velocity) > 0.5 * self.max_velocity)
        )
        self._is_speed_limited = near & (along >= 0.0) & self._in_effort
        spare = self.max_velocity - np.abs(velocity)
        most = 0.8 * np.where(spare > 0.0, along, self.max_effort)
        return self._is_speed_limited, np.minimum(brake, most / np.maximum(np.abs(spare), 1e-9))

    def _apply_gains(self, braked: np.ndarray, brake: np.ndarray) -> None:
        """Give the servos the gains and efforts that the interfaces ask for."""
        by_effort, by_motor = self._in_effort, self._in_motor_position
        damping = np.where(by_motor, self._series_damping, self._damping)
        effort = np.where(by_motor, -self.rigid.gravity_effort(self.name), 0.0)
        self.rigid.set_gains(
            self.name,
            np.where(by_effort, 0.0, self._active_stiffness),
            np.where(braked, brake, np.where(by_effort, 0.0, damping)),
            np.where(by_effort & ~braked, self._command, effort),
            limit=self._effort_limit,
            exact=by_motor | (self._is_compliant & ~by_effort),
        )
        self._gains_changed = False

    def _command_base_velocity(self, time: float) -> None:
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
        deflection = effort / self.series_stiffness
        elements = ElasticSample(
            time, self.description.joints, self.series_stiffness, known.joints.position + deflection, deflection,
            self.series_stiffness * deflection,
        )  # fmt: skip
        return dataclasses.replace(
            known,
            elements=elements,
            wrenches=tuple(self._wrench(mount, time, known.contacts) for mount in self.description.wrenches),
            imus=tuple(self._imu(mount, time) for mount in self.description.imus),
        )

    def _wrench(self, mount: SensorMount, time: float, contacts: Sequence[Contact]) -> Wrench:
        wrench = self.rigid.link_wrench(self.name, mount.frame)
        mine = [contact for contact in contacts if contact.link in self._links_beyond_sensor[mount.frame]]
        if mine:  # with plants, which the rigid world does not know
            pose = self.frame_pose(mount.frame)
            back = frames.conjugate(pose[3:])
            force = np.array([contact.force for contact in mine])
            arm = np.array([contact.position for contact in mine]) - pose[:3]
            wrench[:3] += frames.rotate(back, force.sum(0))
            wrench[3:] += frames.rotate(back, frames.cross(arm, force).sum(0))
        return Wrench(time, mount.name, mount.frame, wrench[:3], wrench[3:])

    def _imu(self, mount: SensorMount, time: float) -> Imu:
        turn = self.frame_pose(mount.frame)[3:]
        spin = self.rigid.link_angular_velocity(self.name, mount.frame)
        acceleration = self.rigid.link_acceleration(self.name, mount.frame)[3:]
        return Imu(time, mount.name, mount.frame, turn, spin, acceleration)

    def update(self, time: float) -> RobotUpdate:
        """What other clients are told: actual joints, never commands."""
        position, velocity, _, _ = self.rigid.joint_measurements(self.name)
        base_q, base_qd = self.rigid.base_state(self.name)
        return RobotUpdate(self.name, time, base_q, base_qd, position, velocity)


def _subtree_links(description: RobotDescription, frame: str) -> frozenset[str]:
    """A link and all that hangs on it."""
    beyond = {frame}
    joints = (*description.fixed_frames, *description.moving_joints.frames)
    while more := {child for parent, child in joints if parent in beyond} - beyond:
        beyond |= more
    return frozenset(beyond)


class RemoteRobot(RobotInstance):
    """The copy of a robot that another client controls: pulled to its states, yet it can be held and pushed."""

    TELEPORT_DISTANCE = 1.0
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
        if np.linalg.norm(update.base_q[:3] - here[:3]) > self.TELEPORT_DISTANCE:
            self._teleport(update, here)
        self.rigid.follow_remote(self.name, update.base_q, update.base_qd, update.position, update.velocity)

    def _teleport(self, update: RobotUpdate, here: np.ndarray) -> None:
        if abs(update.base_q[2] - here[2]) > 1e-3:  # a base rolls on its plane; another height is another world
            self.rigid.remove_robot(self.name)
            self.rigid.add_robot(self.description.to_spec(self.name, self._index, update.base_q))
        self.rigid.place_robot(self.name, update.base_q, update.position)
