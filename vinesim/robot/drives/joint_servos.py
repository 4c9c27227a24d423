"""Joint servos: convert commands to set-points, gains and efforts within the limits of the URDF, once per step.

A sudden change of a position command becomes a ramp with the joint's largest velocity, as in joint_limits of
ros2_control. The servos themselves, with their effort limits, act in the physics.

A series elastic drive is a motor behind a spring (CANOPIES D6.4, section 3.1). The motor's own control is assumed to be
fast: the motor turns to the position at which the spring exerts the effort that position, velocity, effort or impedance
control requests. In :attr:`CommandInterface.MOTOR_POSITION` the motor itself holds a position, and the link deflects
under its load.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence

import numpy as np
import warp as wp

from vinesim.core.warp_arrays import SharedArrays, share
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.rigid import joint_servos
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.scene.values import Drive

ACCELERATION_EFFORT_SHARE = 0.7
"""Share of a drive's effort that may be used for acceleration. The rest carries weight and resists loads. GUESSED"""
RIGID_DEFLECTION = 0.05
"""[rad or m] Deflection at full effort of a drive for which neither a spring nor a servo stiffness is given. GUESSED"""
MIN_DIVISOR = 1e-9
"""Smallest stiffness, inertia or velocity that is used as a divisor [SI units]."""


class CommandInterface(enum.IntEnum):
    """Quantity by which a joint is commanded: a command interface of ros2_control, or the motor position of a series
    elastic drive.

    Source: CANOPIES D6.4, sections 5.2 (position, velocity, effort) and 3.1 (series elastic elements).
    """

    POSITION = 0
    """Position of the joint [rad or m]."""
    VELOCITY = 1
    """Velocity of the joint [rad/s or m/s]."""
    EFFORT = 2
    """Effort of the joint [N m or N]."""
    MOTOR_POSITION = 3
    """Position of the motor behind its spring, converted to the joint side [rad or m]."""


class CommandError(ValueError):
    """A command that the robot cannot execute. The message names the robot, the joint or group, and the remedy."""


def series_stiffness(drives: Sequence[Drive]) -> np.ndarray:
    """Returns the stiffness of the series elastic element of each drive [joint] N m/rad or N/m."""
    return np.array([drive.series_stiffness or drive.stiffness or drive.effort / RIGID_DEFLECTION for drive in drives])


class JointServos:
    """The servos of one robot's driven joints. All arrays are [joint], in the order of ``drives``."""

    def __init__(self, rigid: RigidWorld, name: str, drives: Sequence[Drive]) -> None:
        """``name``: the robot's name in ``rigid``."""
        self._rigid = rigid
        self._name = name
        self._drives = tuple(drives)
        self.lower_limit = np.array([drive.lower for drive in drives], float)
        self.upper_limit = np.array([drive.upper for drive in drives], float)
        """[joint] Upper position limits [rad or m]."""
        self.max_velocity = np.array([drive.velocity for drive in drives], float)
        """[joint] Largest velocities [rad/s or m/s]."""
        self.max_effort = np.array([drive.effort for drive in drives], float)
        """[joint] Largest efforts [N m or N]."""
        self.series_stiffness = series_stiffness(drives)
        """[joint] Stiffnesses of the series elastic elements [N m/rad or N/m]."""
        self._series_damping = np.array(
            [drive.series_damping if drive.series_stiffness else drive.damping for drive in drives]
        )
        self._stiffness = np.array([drive.stiffness for drive in drives])
        self._damping = np.array([drive.damping for drive in drives])
        self._is_compliant = np.zeros(len(drives), bool)
        """[joint] Whether gains were commanded, so that the physics must not add its own damping."""
        self._effort_limit = self.max_effort.copy()
        self._finger_groups: dict[str, np.ndarray] = {}
        """Indices of the fingers of a gripper, which move together, by group. Fingers that moved independently would
        drift to one side with the object that they hold."""
        joints = len(drives)
        self.setpoint = np.zeros(joints)
        self.interface = np.zeros(joints, np.int64)
        """[joint] :class:`CommandInterface` of the last command to each joint. :attr:`setpoint` is the position that
        the servo is to reach [rad or m]. Both arrays are changed in place."""
        self._command = np.zeros(joints)
        self._rate = np.zeros(joints)
        self._target_velocity = np.zeros(joints)
        self._position, self._middle, self._velocity_now, self._inertia = (np.zeros(joints) for _ in range(4))
        self._max_tracking_error = np.zeros(joints)
        self._max_impulse = np.zeros(joints)
        self._advance = self._advance_kernel()
        self.hold()

    def _advance_kernel(self) -> KernelGraph:
        """Returns the kernel of :meth:`_advance_setpoints`, bound to the arrays of this robot."""
        limits = SharedArrays(
            joint_servos.ServoLimits,
            lower=self.lower_limit,
            upper=self.upper_limit,
            velocity=self.max_velocity,
            tracking_error=self._max_tracking_error,
            impulse=self._max_impulse,
        )
        read = (self._command, self._position, self._middle, self._velocity_now, self._inertia)
        written = (self.setpoint, self._rate, self._target_velocity)
        advance = KernelLaunch(
            joint_servos.advance_setpoints,
            [self._rigid.dt, limits.struct, share(self.interface, wp.int64), *(share(a, wp.float64) for a in read)],
            [share(a, wp.float64) for a in written],
            threads=len(self.setpoint),
        )
        return KernelGraph(advance)

    def hold(self) -> None:
        """Drop all commands and hold the present positions by position control. Gains and effort limits stay."""
        self.setpoint[:] = self._command[:] = self._rigid.joint_measurements(self._name)[0]
        self.interface[:] = CommandInterface.POSITION
        self._velocity = np.zeros(len(self.setpoint))
        self._rate[:] = 0.0
        self._is_speed_limited = np.zeros(len(self.setpoint), bool)
        self._gains_changed = True

    # ------------------------------------------------------------------ commands

    def command(self, joints: np.ndarray, values: np.ndarray, interface: CommandInterface) -> None:
        """Command ``joints`` [k] (indices) to ``values`` [k], in the unit of ``interface``. Values are clipped to
        the limits."""
        if interface == CommandInterface.POSITION:
            values = clip(values, self.lower_limit[joints], self.upper_limit[joints])
        elif interface == CommandInterface.VELOCITY:
            values = clip(values, -self.max_velocity[joints], self.max_velocity[joints])
        elif interface == CommandInterface.EFFORT:
            values = clip(values, -self.max_effort[joints], self.max_effort[joints])
        self._command[joints] = values
        self._switch_interface(joints, interface)

    def set_gains(self, joints: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        """Set stiffness [k] N m/rad or N/m and damping [k] N m s/rad or N s/m of ``joints`` [k] (indices)."""
        self._stiffness[joints] = stiffness
        self._damping[joints] = damping
        self._is_compliant[joints] = True
        self._gains_changed = True

    def reset_gains(self, joints: np.ndarray) -> None:
        """Restore the gains that the robot's description gives for ``joints`` [k] (indices)."""
        self._stiffness[joints] = [self._drives[j].stiffness for j in joints]
        self._damping[joints] = [self._drives[j].damping for j in joints]
        self._is_compliant[joints] = False
        self._gains_changed = True

    def group_fingers(self, group: str, fingers: np.ndarray, effort: float | None) -> None:
        """Move ``fingers`` [k] (indices) together, about their common middle, with at most ``effort`` [N m or N]
        each. None: the drives' own limits."""
        self._finger_groups[group] = fingers
        self._effort_limit[fingers] = (
            self.max_effort[fingers] if effort is None else np.minimum(effort, self.max_effort[fingers])
        )
        self._gains_changed = True

    def _switch_interface(self, joints: np.ndarray, interface: CommandInterface) -> None:
        """Switch joints [k] to another interface. Set-points are converted from links to motors or back, so that no
        joint jumps."""
        if (self.interface[joints] == interface).all():
            return
        before = self.interface[joints] == CommandInterface.MOTOR_POSITION
        if before.any() or interface == CommandInterface.MOTOR_POSITION:
            position, _, effort, _ = self._rigid.joint_measurements(self._name)
            motor = position + effort / self.series_stiffness
            self.setpoint[joints] = np.where(
                before == (interface == CommandInterface.MOTOR_POSITION),
                self.setpoint[joints],
                np.where(before, position[joints], motor[joints]),
            )
        self.interface[joints] = interface
        self._gains_changed = True

    # ------------------------------------------------------------------ each step

    def update(self) -> None:
        """Pass the set-points of the coming step to the servos in the physics."""
        if self._gains_changed:
            self._prepare_interfaces()
        position, velocity = self._rigid.joint_state(self._name)
        rate = self._advance_setpoints(position, velocity)
        if self._gains_changed or self._gains_vary:
            is_limited, damping = self._speed_limiters(velocity)
            self._apply_gains(is_limited, damping)
            rate = np.where(is_limited, np.copysign(self.max_velocity, velocity), rate)
        self._velocity = velocity
        self._rigid.command(self._name, self.setpoint, rate)

    def _prepare_interfaces(self) -> None:
        """Compute again the values of the set-points' computation that depend only on interfaces, gains and effort
        limits."""
        self._in_effort = self.interface == CommandInterface.EFFORT
        self._in_motor_position = self.interface == CommandInterface.MOTOR_POSITION
        self._gains_vary = bool(self._in_effort.any() or self._in_motor_position.any())
        """Whether the gains depend on the state, so that they must be set in every step."""
        self._active_stiffness = np.where(self._in_motor_position, self.series_stiffness, self._stiffness)
        self._max_tracking_error[:] = (
            self._effort_limit / np.maximum(self._active_stiffness, MIN_DIVISOR) + self.max_velocity * self._rigid.dt
        )
        self._max_impulse[:] = ACCELERATION_EFFORT_SHARE * self._rigid.dt * self._effort_limit

    def _advance_setpoints(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Advance the set-points by one step. Returns their rates [joint] rad/s or m/s."""
        self._position[:] = self._middle[:] = position
        self._velocity_now[:], self._inertia[:] = velocity, self._rigid.joint_inertia(self._name)
        for fingers in self._finger_groups.values():
            self._middle[fingers] = position[fingers].sum() / len(fingers)
        self._advance()
        return self._target_velocity

    def _speed_limiters(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns which joints would exceed their largest velocity under their commanded effort [joint] bool, and the
        damping [joint] N m s/rad or N s/m that prevents this. The damping acts on the difference from the largest
        velocity.

        ``velocity``: present velocities [joint] rad/s or m/s.

        Below 90 % of the largest velocity there is no damping. The velocity is extrapolated by one step. The damping
        force never exceeds the commanded effort, because a saturated servo does not notice that the velocity decreases
        within the step.
        """
        sign = np.copysign(1.0, velocity)
        brake = 10.0 * self.max_effort / self.max_velocity
        along = sign * self._command
        predicted = sign * (2.0 * velocity - self._velocity)
        is_near = (along > brake * (self.max_velocity - predicted)) | (
            self._is_speed_limited & (np.abs(velocity) > 0.5 * self.max_velocity)
        )
        self._is_speed_limited = is_near & (along >= 0.0) & self._in_effort
        spare = self.max_velocity - np.abs(velocity)
        most = 0.8 * np.where(spare > 0.0, along, self.max_effort)
        return self._is_speed_limited, np.minimum(brake, most / np.maximum(np.abs(spare), MIN_DIVISOR))

    def _apply_gains(self, is_limited: np.ndarray, limiter_damping: np.ndarray) -> None:
        """Set the gains and efforts of the servos in the physics, according to the interface of each joint."""
        in_effort = self._in_effort
        in_motor_position = self._in_motor_position
        damping = np.where(in_motor_position, self._series_damping, self._damping)
        effort = np.where(in_motor_position, -self._rigid.gravity_effort(self._name), 0.0)
        self._rigid.set_gains(
            self._name,
            np.where(in_effort, 0.0, self._active_stiffness),
            np.where(is_limited, limiter_damping, np.where(in_effort, 0.0, damping)),
            np.where(in_effort & ~is_limited, self._command, effort),
            limit=self._effort_limit,
            exact=in_motor_position | (self._is_compliant & ~in_effort),
        )
        self._gains_changed = False


def clip(values: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Same as ``np.clip`` for finite numbers, in half the time."""
    return np.minimum(np.maximum(values, lower), upper)
