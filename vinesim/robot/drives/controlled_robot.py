"""A robot that this client controls: it takes commands, gives limited set-points to its servos, and measures its state.

robot = Robot(rigid, load_description("vinebot"), "robot_1")
robot.command_position([0.3], ["torso_lift_joint"])
robot.command_base(0.4, 0.0, time)
...
robot.control(time)           # before each step of physics
sample = robot.sample(time)   # after it
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from vinesim.core import frames
from vinesim.core.numbers import is_number
from vinesim.interaction.blades import Blade
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.drives.joint_servos import CommandError, CommandInterface, JointServos
from vinesim.robot.drives.proprioception import BodySensors, elastic_sample
from vinesim.robot.drives.robot_instance import RobotInstance
from vinesim.scene.values import Contact, LightPattern, Lights, RobotSample, RobotUpdate
from vinesim.scene.values.signals import USUAL_COLOR
from vinesim.world import Physics

Values = Sequence[float] | np.ndarray
Joints = Sequence[str] | np.ndarray | None
"""Joints to command: names, indices, or None for all driven joints."""


class Robot(RobotInstance):
    """A robot that this client controls: the local robot of CANOPIES D6.4, section 5.2."""

    def __init__(
        self,
        rigid: RigidWorld,
        description: RobotDescription,
        name: str = "",
        index: int = 0,
        pose: np.ndarray | None = None,
    ) -> None:
        """Add the robot to ``rigid`` at ``pose`` [7] (the origin unless given), holding its joints at their home
        positions.

        ``name``: the name in the description unless given. ``index``: index of the robot in label images.
        """
        super().__init__(rigid, description, name, index, pose)
        self._joint_index = {drive.joint: i for i, drive in enumerate(description.drives)}
        self._joint_index |= {
            description.original_names[joint]: i
            for joint, i in self._joint_index.items()
            if joint in description.original_names
        }
        self._cutters: dict[str, list[Blade]] = {}
        self._physics: Physics | None = None
        self._body_sensors = BodySensors(rigid, self.name, description)
        self._servos = JointServos(rigid, self.name, description.drives)
        self.lower_limit = self._servos.lower_limit
        self.upper_limit = self._servos.upper_limit
        """[joint] Upper position limits [rad or m]. :attr:`lower_limit` has the lower ones."""
        self.max_velocity = self._servos.max_velocity
        self.max_effort = self._servos.max_effort
        """[joint] Largest efforts [N m or N]. :attr:`max_velocity` has the largest velocities [rad/s or m/s]."""
        self.series_stiffness = self._servos.series_stiffness
        """[joint] Stiffnesses of the series elastic elements [N m/rad or N/m]."""
        self._stop_base()

    @property
    def setpoint(self) -> np.ndarray:
        """[joint] Set-points of the servos [rad or m]."""
        return self._servos.setpoint

    @property
    def interface(self) -> np.ndarray:
        """[joint] :class:`CommandInterface` of the last command to each joint."""
        return self._servos.interface

    @property
    def physics(self) -> Physics:
        """The physics with the plants that the robot's grippers act on. Raises :class:`CommandError` if
        :meth:`fit_cutters` was not called yet."""
        if self._physics is None:
            raise CommandError(f"{self.name} has no grippers for plants; call fit_cutters(physics) first")
        return self._physics

    def fit_cutters(self, physics: Physics) -> None:
        """Add the cutters of the robot's description to ``physics``, so that grippers act on plants."""
        self._physics = physics
        for cutter in self.description.cutters:
            blade = physics.add_blade(
                self.name,
                cutter.frame,
                frames.pose(cutter.origin),
                np.array(cutter.half),
                force=np.inf if cutter.force is None else cutter.force,
                speed=cutter.speed,
                kind=cutter.blade,
            )
            self._cutters.setdefault(cutter.group, []).append(blade)

    def work_on_plant(self, what: str) -> str:
        """Tie, untie or strip the wood at the mouth of the robot's cutter that is nearest to wood; see
        :meth:`vinesim.interaction.handwork.Handwork.work_at`. Call this between steps. Returns what was done. Raises
        :class:`CommandError` if the robot has no cutter, or there is nothing to do within reach."""
        blades = [blade for blades in self._cutters.values() for blade in blades]
        if not blades:
            raise CommandError(f"{self.name} has no cutter at which it could work on plants")
        failed = ""
        for blade in blades:
            mouth = frames.compose(self.rigid.link_pose(self.name, blade.link), blade.pose)
            try:
                return self.physics.handwork.work_at(what, mouth[:3], self.name)
            except ValueError as reason:
                failed = failed or str(reason)
        raise CommandError(f"{self.name}: {failed}")

    def remove(self) -> None:
        """Remove the robot and its cutters from the world."""
        if self._physics is not None:
            self._physics.remove_robot(self.name)
        else:
            super().remove()

    def stop(self) -> None:
        """Drop all commands, and hold all joints and the base at their present positions."""
        self._servos.hold()
        self._stop_base()

    def _stop_base(self) -> None:
        self._base_goal = self._base_velocity = 0.0, 0.0
        self._base_time = -np.inf

    # ------------------------------------------------------------------ commands

    def joint_indices(self, joints: Joints) -> np.ndarray:
        """Returns the indices of joints in joint arrays. Raises :class:`CommandError` for a joint without a
        drive. Names may be those of the robot file, too."""
        if joints is None:
            return np.arange(len(self.setpoint))
        if isinstance(joints, np.ndarray):
            return joints
        try:
            return np.array([self._joint_index[joint] for joint in joints], int)
        except KeyError as error:
            known = ", ".join(self.description.joints)
            raise CommandError(f"{self.name} has no drive for {error.args[0]!r}; it drives: {known}") from None

    def command_position(self, position: Values, joints: Joints = None) -> None:
        """Move joints to positions [rad or m] as fast as their limits permit. Positions beyond the limits are
        clipped."""
        self._servos.command(*self._validated(position, joints), CommandInterface.POSITION)

    def command_velocity(self, velocity: Values, joints: Joints = None) -> None:
        """Move joints with velocities [rad/s or m/s], until they reach their limits."""
        self._servos.command(*self._validated(velocity, joints), CommandInterface.VELOCITY)

    def command_effort(self, effort: Values, joints: Joints = None) -> None:
        """Apply efforts [N m or N] in addition to gravity compensation. With effort 0, a joint can be moved by hand."""
        self._servos.command(*self._validated(effort, joints), CommandInterface.EFFORT)

    def command_motor_position(self, motor: Values, joints: Joints = None) -> None:
        """Hold the motors of series elastic joints at positions [rad or m]. Each link deflects by its load divided by
        the series stiffness.

        Gravity is not compensated, because only the spring connects motor and link (CANOPIES D6.4, section 3.1).
        """
        self._servos.command(*self._validated(motor, joints), CommandInterface.MOTOR_POSITION)

    def command_impedance(self, stiffness: Values, damping: Values, joints: Joints = None) -> None:
        """Set stiffness [N m/rad or N/m] and damping [N m s/rad or N s/m] of joints with position or velocity commands.

        See CANOPIES D6.4, section 3.1. The gains stay until :meth:`reset_gains`, also after :meth:`stop`.
        """
        i, stiffness = self._validated(stiffness, joints)
        _, damping = self._validated(damping, joints)
        if (stiffness < 0.0).any() or (damping < 0.0).any():
            raise CommandError(f"{self.name}: gains below zero would add energy; give 0 or more")
        self._servos.set_gains(i, stiffness, damping)

    def reset_gains(self, joints: Joints = None) -> None:
        """Restore the gains of the robot's description."""
        self._servos.reset_gains(self.joint_indices(joints))

    def command_gripper(self, group: str, opening: float, effort: float | None = None) -> None:
        """Move a gripper's fingers to ``opening``, limited to their range.

        ``opening``: distance between the fingers [m] (sum over prismatic fingers, including those that mimic a driven
        finger), or angle [rad]. ``effort`` [N or N m]: largest effort of each finger; the drive's own limit unless
        given. Objects between the fingers are held by friction only.
        """
        if group not in self.description.groups:
            known = ", ".join(self.description.groups)
            raise CommandError(f"{self.name} has no gripper {group!r}; its groups are: {known}")
        fingers = self.description.joint_indices(group)
        if effort is not None and not effort > 0.0:
            raise CommandError(f"{self.name}: gripper effort {effort}; give more than 0, or none for all there is")
        travel, offset = self.description.finger_travel(fingers)
        self.command_position(np.full(len(fingers), (opening - offset) / travel), fingers)
        self._servos.group_fingers(group, fingers, effort)

    def gripper_opening(self, group: str) -> float:
        """Returns the opening of a gripper [m or rad], as defined in :meth:`command_gripper`. Raises KeyError for an
        unknown group."""
        fingers = self.description.joint_indices(group)
        travel, offset = self.description.finger_travel(fingers)
        return travel * float(self.rigid.joint_measurements(self.name)[0][fingers].mean()) + offset

    def command_cutter(self, group: str, force: float | None = None) -> None:
        """Close the cutter of a gripper and open it again. The wood between its blades is cut when they meet.

        ``force`` [N]: largest force; the cutter's own limit unless given. If the wood needs more force, the blades
        stall in it (:class:`~vinesim.interaction.blades.Blade`).
        """
        if force is not None and not force > 0.0:
            raise CommandError(f"{self.name}: cutting force {force}; give more than 0, or none for all there is")
        for blade in self.cutter_blades(group):
            blade.close(np.inf if force is None else force)

    def cutter_blades(self, group: str) -> tuple[Blade, ...]:
        """Returns the blades of a gripper's cutters, which report what they cut. Raises :class:`CommandError` if
        there are none."""
        if group not in self._cutters:
            known = ", ".join(sorted(self._cutters)) or "none"
            raise CommandError(f"{self.name} has no cutter at {group!r}; cutters fitted: {known}")
        return tuple(self._cutters[group])

    def command_base(self, linear: float, angular: float, time: float) -> None:
        """Drive with ``linear`` [m/s] ahead and ``angular`` [rad/s] to the left. The base stops
        :attr:`BaseLimits.timeout` after the last command."""
        if not (is_number(linear) and is_number(angular)):
            raise CommandError(f"{self.name}: base velocity is ({linear}, {angular}); give finite numbers [m/s, rad/s]")
        limits = self.description.base_limits
        if limits.kind == "free":
            raise CommandError(f"{self.name} stands on its legs: it has no wheels to drive; command its joints")
        self._base_goal = _clamp(linear, limits.linear), _clamp(angular, limits.angular)
        self._base_time = time

    def command_lights(self, pattern: LightPattern, color: Sequence[float] | None = None) -> None:
        """Show a pattern with the indicator lights, see :class:`Lights`. ``color`` [3]: sRGB from 0 to 1; the colour
        of the pattern unless given. The call does not change whether a tone sounds while the lamps are lit."""
        if color is None:
            self.lights = Lights(pattern, USUAL_COLOR[pattern], self.lights.has_sound)
            return
        if len(color) != 3 or not all(0.0 <= part <= 1.0 for part in color):
            raise CommandError(f"{self.name}: colour of lights {list(color)}; give three numbers from 0 to 1")
        red, green, blue = (round(255.0 * part) for part in color)
        self.lights = Lights(pattern, (red, green, blue), self.lights.has_sound)

    def _validated(self, values: Values, joints: Joints) -> tuple[np.ndarray, np.ndarray]:
        """Returns indices [k] and values [k] of a command. Raises :class:`CommandError` if their numbers differ or a
        value is not finite."""
        i = self.joint_indices(joints)
        given = np.asarray(values)
        values = given.astype(float) if given.dtype.kind in "iuf" else np.full(given.shape, np.nan)
        if values.shape != i.shape:
            raise CommandError(f"{self.name}: {values.size} values for {len(i)} joints; give one each")
        if not np.isfinite(values).all():
            bad = self.description.joints[i[np.flatnonzero(~np.isfinite(values))[0]]]
            raise CommandError(f"{self.name}: command for {bad!r} is not finite; give a number")
        return i, values

    # ------------------------------------------------------------------ each step

    def control(self, time: float) -> None:
        """Pass the set-points of the step that starts at ``time`` [s] to the physics. Call this before the step."""
        self._servos.update()
        self._drive_base(time)
        if self._tracks_slip:
            self._odometry(self.rigid.base_state(self.name)[0])

    def _drive_base(self, time: float) -> None:
        """Accelerate the base towards its commanded velocity, or to a stop if the last command is too old."""
        limits = self.description.base_limits
        if limits.kind == "free":
            return
        linear_goal, angular_goal = self._base_goal if time - self._base_time <= limits.timeout else (0.0, 0.0)
        linear, angular = self._base_velocity
        linear += _clamp(linear_goal - linear, self.rigid.dt * limits.linear_acceleration)
        angular += _clamp(angular_goal - angular, self.rigid.dt * limits.angular_acceleration)
        self._base_velocity = linear, angular
        self.rigid.command_base(self.name, (linear, 0.0, angular))

    def sample(self, time: float, contacts: Sequence[Contact] = (), *, body_sensors: bool = True) -> RobotSample:
        """Returns the state of the robot at ``time`` [s]. ``body_sensors``: whether it includes wrenches, IMUs and
        series elastic elements."""
        measured = self.measure(time, contacts, body_sensors=body_sensors)
        return dataclasses.replace(
            measured,
            transform_q=self.description.moving_joints.poses(measured.joints.position),
            elements=elastic_sample(measured.joints, self.series_stiffness) if body_sensors else None,
        )

    def measure(
        self, time: float, contacts: Sequence[Contact] = (), *, body_sensors: bool = True, **more: Any
    ) -> RobotSample:
        """Like :meth:`RobotInstance.measure`. ``body_sensors``: whether the sample includes wrenches and IMUs;
        series elastic elements are never included."""
        if body_sensors:
            own = self._own(contacts)
            more |= {"wrenches": self._body_sensors.wrenches(time, own), "imus": self._body_sensors.imus(time)}
        return super().measure(time, contacts, **more)

    def update(self, time: float) -> RobotUpdate:
        """Returns the state of the robot that is sent to other clients: measured joint states, never commands."""
        position, velocity = self.rigid.joint_state(self.name)
        base_q, base_qd = self.rigid.base_state(self.name)
        return RobotUpdate(self.name, time, base_q, base_qd, position, velocity, self.lights)


def _clamp(value: float, bound: float) -> float:
    """Returns the value, limited to the range from -``bound`` to ``bound``."""
    return float(min(max(value, -bound), bound))
