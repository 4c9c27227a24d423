"""Joint servos: commands become set-points within the limits of the URDF, gains and efforts, once a step.

A step of a position command becomes a ramp at the joint's largest velocity, as joint_limits of ros2_control does it.
The servos themselves, with their effort limits, act in the physics.

A series elastic drive is a motor behind a spring (CANOPIES D6.4, section 3.1). The motor's own control is taken to be
fast: it turns to where the spring gives what position, velocity, effort or impedance control asks for. In
:attr:`CommandInterface.MOTOR_POSITION` the motor itself holds a position, and the link deflects under its load.
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
"""Share of its effort that a drive may spend on acceleration: the rest carries weight and resists loads. GUESSED"""
RIGID_DEFLECTION = 0.05
"""[rad or m] Deflection at full effort of a drive for which neither spring nor servo stiffness is given. GUESSED"""
MIN_DIVISOR = 1e-9
"""Lower bound of a stiffness, inertia or velocity that is used as a divisor [SI units]."""


class CommandInterface(enum.IntEnum):
    """Quantity by which a joint is commanded: an interface of ros2_control, or the motor of a series elastic drive.

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
    """A command that the robot cannot take; the message names the robot, the joint or group, and the remedy."""


def series_stiffness(drives: Sequence[Drive]) -> np.ndarray:
    """[joint] Stiffnesses of the series elastic elements of some drives [N m/rad or N/m]."""
    return np.array([drive.series_stiffness or drive.stiffness or drive.effort / RIGID_DEFLECTION for drive in drives])


class JointServos:
    """The servos of one robot's driven joints; all arrays are [joint], in the order of ``drives``."""

    def __init__(self, rigid: RigidWorld, name: str, drives: Sequence[Drive]) -> None:
        """``name``: the robot's name in ``rigid``."""
        self._rigid = rigid
        self._name = name
        self._drives = tuple(drives)
        self.lower_limit = np.array([drive.lower for drive in drives], float)
        self.upper_limit = np.array([drive.upper for drive in drives], float)
        """[joint] limits of position [rad or m]"""
        self.max_velocity = np.array([drive.velocity for drive in drives], float)
        """[joint] largest velocities [rad/s or m/s]"""
        self.max_effort = np.array([drive.effort for drive in drives], float)
        """[joint] largest efforts [N m or N]"""
        self.series_stiffness = series_stiffness(drives)
        """[joint] stiffnesses of the series elastic elements [N m/rad or N/m]"""
        self._series_damping = np.array(
            [drive.series_damping if drive.series_stiffness else drive.damping for drive in drives]
        )
        self._stiffness = np.array([drive.stiffness for drive in drives])
        self._damping = np.array([drive.damping for drive in drives])
        self._is_compliant = np.zeros(len(drives), bool)
        """[joint] whether gains were commanded, so that the physics must not add damping of its own"""
        self._effort_limit = self.max_effort.copy()
        self._finger_groups: dict[str, np.ndarray] = {}
        """Indices of the fingers that move together, by group. Fingers that moved independently would drift to one side
        with the object that they hold."""
        joints = len(drives)
        self.setpoint = np.zeros(joints)
        self.interface = np.zeros(joints, np.int64)
        """[joint] position that the servos are asked for [rad or m], and :class:`CommandInterface` by which each was
        commanded last; both are written in place."""
        self._command = np.zeros(joints)
        self._rate = np.zeros(joints)
        self._target_velocity = np.zeros(joints)
        self._position, self._middle, self._velocity_now, self._inertia = (np.zeros(joints) for _ in range(4))
        self._max_tracking_error = np.zeros(joints)
        self._max_impulse = np.zeros(joints)
        self._advance = self._advance_kernel()
        self.hold()

    def _advance_kernel(self) -> KernelGraph:
        """The kernel of :meth:`_advance_setpoints` on the arrays of this robot."""
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
        """Drop all commands: position control at the present positions. Gains and effort limits stay."""
        self.setpoint[:] = self._command[:] = self._rigid.joint_measurements(self._name)[0]
        self.interface[:] = CommandInterface.POSITION
        self._velocity = np.zeros(len(self.setpoint))
        self._rate[:] = 0.0
        self._is_speed_limited = np.zeros(len(self.setpoint), bool)
        self._gains_changed = True

    # ------------------------------------------------------------------ commands

    def command(self, joints: np.ndarray, values: np.ndarray, interface: CommandInterface) -> None:
        """Command ``joints`` [k] (indices) by ``values`` [k] in the units of ``interface``, clipped to the limits."""
        if interface == CommandInterface.POSITION:
            values = clip(values, self.lower_limit[joints], self.upper_limit[joints])
        elif interface == CommandInterface.VELOCITY:
            values = clip(values, -self.max_velocity[joints], self.max_velocity[joints])
        elif interface == CommandInterface.EFFORT:
            values = clip(values, -self.max_effort[joints], self.max_effort[joints])
        self._command[joints] = values
        self._switch_interface(joints, interface)

    def set_gains(self, joints: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> None:
        """Impedance of ``joints`` [k]: gains [k] N m/rad or N/m, and N m s/rad or N s/m."""
        self._stiffness[joints] = stiffness
        self._damping[joints] = damping
        self._is_compliant[joints] = True
        self._gains_changed = True

    def reset_gains(self, joints: np.ndarray) -> None:
        """Restore the gains that the description gives to ``joints`` [k]."""
        self._stiffness[joints] = [self._drives[j].stiffness for j in joints]
        self._damping[joints] = [self._drives[j].damping for j in joints]
        self._is_compliant[joints] = False
        self._gains_changed = True

    def group_fingers(self, group: str, fingers: np.ndarray, effort: float | None) -> None:
        """Move ``fingers`` [k] about their common middle from now on, with at most ``effort`` [N m or N] each."""
        self._finger_groups[group] = fingers
        self._effort_limit[fingers] = (
            self.max_effort[fingers] if effort is None else np.minimum(effort, self.max_effort[fingers])
        )
        self._gains_changed = True

    def _switch_interface(self, joints: np.ndarray, interface: CommandInterface) -> None:
        """Convert the set-points from links to motors or back, so that no joint jumps."""
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
        """Compute the values that change only with the interfaces, gains and limits."""
        self._in_effort = self.interface == CommandInterface.EFFORT
        self._in_motor_position = self.interface == CommandInterface.MOTOR_POSITION
        self._gains_vary = bool(self._in_effort.any() or self._in_motor_position.any())
        """Whether gains depend on the state, so that they must be set in every step."""
        self._active_stiffness = np.where(self._in_motor_position, self.series_stiffness, self._stiffness)
        self._max_tracking_error[:] = (
            self._effort_limit / np.maximum(self._active_stiffness, MIN_DIVISOR) + self.max_velocity * self._rigid.dt
        )
        self._max_impulse[:] = ACCELERATION_EFFORT_SHARE * self._rigid.dt * self._effort_limit

    def _advance_setpoints(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Advance the set-points by a step. Returns their rates [joint] rad/s or m/s."""
        self._position[:] = self._middle[:] = position
        self._velocity_now[:], self._inertia[:] = velocity, self._rigid.joint_inertia(self._name)
        for fingers in self._finger_groups.values():
            self._middle[fingers] = position[fingers].sum() / len(fingers)
        self._advance()
        return self._target_velocity

    def _speed_limiters(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joints whose commanded effort would exceed their largest velocity [joint] bool, and the damping [joint]
        N m s/rad or N s/m about that velocity which prevents it.

        Below 90 % of the largest velocity there is no damping. The velocity is extrapolated by one step. The damping
        force never exceeds the commanded effort, because a saturated servo does not see that the velocity falls within
        the step.
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
        """Give the servos in the physics the gains and efforts that the interfaces ask for."""
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
    """``np.clip`` of finite numbers, in half its time."""
    return np.minimum(np.maximum(values, lower), upper)
