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
from vinesim.interaction.detachment import Blade
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
"""Names of driven joints, their indices, or None for all."""


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
        """The arguments are those of :class:`RobotInstance`. The robot holds its joints at home until commanded."""
        super().__init__(rigid, description, name, index, pose)
        self._joint_index = {drive.joint: i for i, drive in enumerate(description.drives)}
        self._cutters: dict[str, list[Blade]] = {}
        self._physics: Physics | None = None
        self._body_sensors = BodySensors(rigid, self.name, description)
        self._servos = JointServos(rigid, self.name, description.drives)
        self.lower_limit = self._servos.lower_limit
        self.upper_limit = self._servos.upper_limit
        """[joint] limits of position [rad or m]"""
        self.max_velocity = self._servos.max_velocity
        self.max_effort = self._servos.max_effort
        """[joint] limits of velocity [rad/s or m/s] and effort [N m or N]"""
        self.series_stiffness = self._servos.series_stiffness
        """[joint] stiffnesses of the series elastic elements [N m/rad or N/m]"""
        self._stop_base()

    @property
    def setpoint(self) -> np.ndarray:
        """[joint] Set-points of the servos [rad or m]."""
        return self._servos.setpoint

    @property
    def interface(self) -> np.ndarray:
        """[joint] :class:`CommandInterface` by which each joint was commanded last."""
        return self._servos.interface

    @property
    def physics(self) -> Physics:
        """The world whose plants its grippers act on; :class:`CommandError` before :meth:`fit_cutters`."""
        if self._physics is None:
            raise CommandError(f"{self.name} has no grippers for plants; call fit_cutters(physics) first")
        return self._physics

    def fit_cutters(self, physics: Physics) -> None:
        """Let grippers act on plants in ``physics``: give the robot the cutters of its description."""
        self._physics = physics
        for cutter in self.description.cutters:
            blade = physics.add_blade(self.name, cutter.frame, frames.pose(cutter.origin), np.array(cutter.half))
            self._cutters.setdefault(cutter.group, []).append(blade)

    def remove(self) -> None:
        """Remove the robot and its cutters from the world."""
        if self._physics is not None:
            self._physics.remove_robot(self.name)
        else:
            super().remove()

    def stop(self) -> None:
        """Drop all commands; hold every joint and the base where they are."""
        self._servos.hold()
        self._stop_base()

    def _stop_base(self) -> None:
        self._base_goal = self._base_velocity = 0.0, 0.0
        self._base_time = -np.inf

    # ------------------------------------------------------------------ commands

    def joint_indices(self, joints: Joints) -> np.ndarray:
        """Indices of joints in joint arrays; :class:`CommandError` for a name that has no drive."""
        if joints is None:
            return np.arange(len(self.setpoint))
        if isinstance(joints, np.ndarray):
            return joints
        try:
            return np.array([self._joint_index[joint] for joint in joints], int)
        except KeyError as error:
            known = ", ".join(self._joint_index)
            raise CommandError(f"{self.name} has no drive for {error.args[0]!r}; it drives: {known}") from None

    def command_position(self, position: Values, joints: Joints = None) -> None:
        """Move to positions [rad or m] as fast as the joints may. A position beyond a limit is clipped to the limit."""
        self._servos.command(*self._validated(position, joints), CommandInterface.POSITION)

    def command_velocity(self, velocity: Values, joints: Joints = None) -> None:
        """Move with velocities [rad/s or m/s] until the joints' limits."""
        self._servos.command(*self._validated(velocity, joints), CommandInterface.VELOCITY)

    def command_effort(self, effort: Values, joints: Joints = None) -> None:
        """Apply efforts [N m or N] in addition to the weight, which the drives carry. With effort 0 a joint can be
        moved by hand."""
        self._servos.command(*self._validated(effort, joints), CommandInterface.EFFORT)

    def command_motor_position(self, motor: Values, joints: Joints = None) -> None:
        """Hold the motors at positions [rad or m]; each link deflects by its load over the series stiffness.

        The weight is not compensated, as only the spring connects motor and link (CANOPIES D6.4, section 3.1).
        """
        self._servos.command(*self._validated(motor, joints), CommandInterface.MOTOR_POSITION)

    def command_impedance(self, stiffness: Values, damping: Values, joints: Joints = None) -> None:
        """Set the gains [N m/rad, N m s/rad or N/m, N s/m] of joints commanded by position or velocity.

        CANOPIES D6.4, section 3.1. Kept until :meth:`reset_gains`; :meth:`stop` leaves them.
        """
        i, stiffness = self._validated(stiffness, joints)
        _, damping = self._validated(damping, joints)
        if (stiffness < 0.0).any() or (damping < 0.0).any():
            raise CommandError(f"{self.name}: gains below zero would feed energy in; give 0 or more")
        self._servos.set_gains(i, stiffness, damping)

    def reset_gains(self, joints: Joints = None) -> None:
        """Restore the gains of the description."""
        self._servos.reset_gains(self.joint_indices(joints))

    def command_gripper(self, group: str, opening: float, effort: float | None = None) -> None:
        """Open a gripper's fingers to ``opening``, at most as far as they can.

        ``opening`` [m]: distance between the fingers (sum over prismatic fingers, including those that mimic a driven
        one), or [rad]. ``effort`` [N or N m]: largest effort of each finger; the drive's own limit unless given.
        Objects between the fingers are held by friction alone.
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
        """How far a gripper is open [m or rad], as :meth:`command_gripper` counts; KeyError for an unknown group."""
        fingers = self.description.joint_indices(group)
        travel, offset = self.description.finger_travel(fingers)
        return travel * float(self.rigid.joint_measurements(self.name)[0][fingers].mean()) + offset

    def command_cutter(self, group: str, force: float | None = None) -> None:
        """Close the cutter of a gripper and open it again. Wood between its blades in the next step is cut.

        ``force`` [N]: largest force, the cutter's own limit unless given. Wood that resists more is not cut.
        """
        if force is not None and not force > 0.0:
            raise CommandError(f"{self.name}: cutting force {force}; give more than 0, or none for all there is")
        limits = [cutter.force for cutter in self.description.cutters if cutter.group == group]
        for blade, limit in zip(self.cutter_blades(group), limits, strict=True):
            blade.close(min(np.inf if limit is None else limit, np.inf if force is None else force))

    def cutter_blades(self, group: str) -> tuple[Blade, ...]:
        """The cutters of a gripper, which tell what they cut; :class:`CommandError` if it has none."""
        if group not in self._cutters:
            known = ", ".join(sorted(self._cutters)) or "none"
            raise CommandError(f"{self.name} has no cutter at {group!r}; cutters fitted: {known}")
        return tuple(self._cutters[group])

    def command_base(self, linear: float, angular: float, time: float) -> None:
        """Drive with ``linear`` [m/s] ahead and ``angular`` [rad/s] to the left. A command lapses after the timeout."""
        if not np.isfinite([linear, angular]).all():
            raise CommandError(f"{self.name}: base velocity ({linear}, {angular}) is not finite")
        limits = self.description.base_limits
        self._base_goal = _clamp(linear, limits.linear), _clamp(angular, limits.angular)
        self._base_time = time

    def command_lights(self, pattern: LightPattern, color: Sequence[float] | None = None) -> None:
        """Let the indicator lights show a pattern, in a ``color`` [3] of sRGB from 0 to 1, that of the pattern unless
        given; whether it sounds stays as it was. See :class:`Lights`."""
        if color is None:
            self.lights = Lights(pattern, USUAL_COLOR[pattern], self.lights.has_sound)
            return
        if len(color) != 3 or not all(0.0 <= part <= 1.0 for part in color):
            raise CommandError(f"{self.name}: colour of lights {list(color)}; give three numbers from 0 to 1")
        red, green, blue = (round(255.0 * part) for part in color)
        self.lights = Lights(pattern, (red, green, blue), self.lights.has_sound)

    def _validated(self, values: Values, joints: Joints) -> tuple[np.ndarray, np.ndarray]:
        """Indices [k] and finite values [k], or :class:`CommandError`."""
        i = self.joint_indices(joints)
        values = np.asarray(values, float)
        if values.shape != i.shape:
            raise CommandError(f"{self.name}: {values.size} values for {len(i)} joints; give one each")
        if not np.isfinite(values).all():
            bad = self.description.joints[i[np.flatnonzero(~np.isfinite(values))[0]]]
            raise CommandError(f"{self.name}: command for {bad!r} is not finite; give a number")
        return i, values

    # ------------------------------------------------------------------ each step

    def control(self, time: float) -> None:
        """Pass the set-points of the step that starts at ``time`` [s] to the physics; call it before the step."""
        self._servos.update()
        self._drive_base(time)
        if self._tracks_slip:
            self._odometry(self.rigid.base_state(self.name)[0])

    def _drive_base(self, time: float) -> None:
        """Accelerate the base towards its commanded velocity, or towards standing once the command has lapsed."""
        limits = self.description.base_limits
        linear_goal, angular_goal = self._base_goal if time - self._base_time <= limits.timeout else (0.0, 0.0)
        linear, angular = self._base_velocity
        linear += _clamp(linear_goal - linear, self.rigid.dt * limits.linear_acceleration)
        angular += _clamp(angular_goal - angular, self.rigid.dt * limits.angular_acceleration)
        self._base_velocity = linear, angular
        self.rigid.command_base(self.name, (linear, 0.0, angular))

    def sample(self, time: float, contacts: Sequence[Contact] = (), *, body_sensors: bool = True) -> RobotSample:
        """State of the robot at ``time`` [s], with wrenches, IMUs and series elastic elements if ``body_sensors``."""
        measured = self.measure(time, contacts, body_sensors=body_sensors)
        return dataclasses.replace(
            measured,
            transform_q=self.description.moving_joints.poses(measured.joints.position),
            elements=elastic_sample(measured.joints, self.series_stiffness) if body_sensors else None,
        )

    def measure(
        self, time: float, contacts: Sequence[Contact] = (), *, body_sensors: bool = True, **more: Any
    ) -> RobotSample:
        """Like :meth:`RobotInstance.measure`. Series elastic elements are left out, too."""
        if body_sensors:
            own = self._own(contacts)
            more |= {"wrenches": self._body_sensors.wrenches(time, own), "imus": self._body_sensors.imus(time)}
        return super().measure(time, contacts, **more)

    def update(self, time: float) -> RobotUpdate:
        """State of the robot that is sent to other clients: actual joint states, never commands."""
        position, velocity = self.rigid.joint_state(self.name)
        base_q, base_qd = self.rigid.base_state(self.name)
        return RobotUpdate(self.name, time, base_q, base_qd, position, velocity, self.lights)


def _clamp(value: float, bound: float) -> float:
    """The value within -``bound`` to ``bound``."""
    return float(min(max(value, -bound), bound))
