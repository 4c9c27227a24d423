"""Cartesian control of one arm: the tip follows straight lines, the tool turns to an orientation.

    arm = CartesianController(robot, "left")
    arm.reset()
    while arm.distance_to(goal) > 0.003:
        arm.move_towards(goal, x_axis=[1, 0, 0], z_axis=[0, 0, 1], speed=0.3, working_height=1.4)
        robot.control(time)
        physics.step()

Differential inverse kinematics: the damped pseudo-inverse of the Jacobian (Nakamura and Hanafusa 1986) at the measured
state moves the tip, so moving bases and obstacles need no special case. The remaining degrees of freedom of an arm
with seven joints on a lift first turn the tool, then approach a posture (Siciliano and Slotine 1991).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from vinesim.core import frames
from vinesim.core.warp_arrays import SharedArrays, share
from vinesim.kernels.graph import KernelGraph, KernelLaunch
from vinesim.kernels.robot import inverse_kinematics
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError, clip

POSITION_GAIN = 5.0
"""[1/s] Feedback gain of position and orientation; well below the servos' bandwidth. GUESSED"""
POSTURE_GAIN = 1.0
"""[1/s] Gain towards the posture. GUESSED"""
MAX_TOOL_RATE = 1.0
"""[rad/s] Largest rate at which the tool turns. GUESSED"""
SHOULDER_DROP = 0.10
"""[m] The lift brings the shoulder this far below the working height. GUESSED"""
MIN_SINGULAR_VALUE = 0.06
"""[m/rad] Smaller singular values are damped, which bounds joint rates near singular postures. GUESSED"""
LIMIT_MARGIN = 0.005
"""[rad or m] Joints stop this far before their limits, where each would press on an end stop, a constraint for the
physics to solve. GUESSED"""
RATE_RAMP_TIME = 0.15
"""[s] Shortest time in which a joint reaches its largest velocity. GUESSED"""


class CartesianController:
    """Moves the tip of one arm's tool, and with it the lift that carries the arm."""

    def __init__(
        self, robot: Robot, side: str, *, tip_offset: float = 0.0, acceleration: float = 0.8, use_lift: bool = True
    ) -> None:
        """Control the group ``arm_{side}`` of ``robot``, and its torso if ``use_lift``.

        ``tip_offset`` [m]: distance of the tip ahead of the tool's frame, along its x axis. ``acceleration`` [m/s2] of
        the tip. Raises :class:`CommandError` if the robot has no such arm with a tool.
        """
        description = robot.description
        arm = description.groups.get(f"arm_{side}")
        if arm is None or not arm.tool:
            raise CommandError(f"{robot.name} has no group 'arm_{side}' with a tool; name one in its TOML")
        lifts = description.groups["torso"].joints if use_lift and "torso" in description.groups else ()
        self.robot = robot
        self.tool = arm.tool
        self.acceleration = acceleration
        self.gripper = f"gripper_{side}" if f"gripper_{side}" in description.groups else ""
        """The group of its fingers; empty if it has none."""
        self._tip_offset = tip_offset
        self._joints = robot.joint_indices([*lifts, *arm.joints])
        self._lifts = len(lifts)
        lower = robot.lower_limit[self._joints]
        upper = robot.upper_limit[self._joints]
        margin = np.minimum(LIMIT_MARGIN, 0.25 * (upper - lower))
        self._lower = lower + margin
        self._upper = upper - margin
        self._fastest = robot.max_velocity[self._joints]
        self._largest_change = self._fastest * robot.rigid.dt / RATE_RAMP_TIME
        """[joint] Largest change of a rate in one step [rad/s or m/s]."""
        weights = self._fastest / self._fastest.max()  # the slow lift moves less than the arm
        self._pointing = InverseKinematics(weights, (3, 2))
        """Inverse kinematics of a tip on a line, and of the tool's x axis."""
        self._orienting = InverseKinematics(weights, (3, 3))
        """Inverse kinematics of a tip on a line, and of the tool's whole orientation."""
        self._home = description.home[self._joints]
        moving = description.moving_joints
        self._shoulder = moving.frames[moving.names.index(arm.joints[0])][1]
        self._rates = np.zeros(len(self._joints))
        self.reset()

    def reset(self) -> None:
        """Restart the reference at the present tip position, at rest."""
        self._reference, self._reference_speed = self.tip_position, 0.0

    @property
    def reference(self) -> np.ndarray:
        """Reference position [3] m in the world, which :attr:`tip_position` follows."""
        return self._reference

    @property
    def tip_position(self) -> np.ndarray:
        """Position of the tip [3] m in the world."""
        pose = self.robot.frame_pose(self.tool)
        return pose[:3] + self._tip_offset * axes_of_pose(pose)[0]

    @property
    def shoulder_position(self) -> np.ndarray:
        """Origin of the arm's first link [3] m in the world."""
        return self.robot.frame_pose(self._shoulder)[:3]

    def distance_to(self, goal: np.ndarray) -> float:
        """Distance [m] of the tip from ``goal`` [3] m in the world."""
        return _length(goal - self.tip_position)

    def move_towards(
        self,
        goal: np.ndarray,
        x_axis: np.ndarray,
        z_axis: np.ndarray | None = None,
        *,
        speed: float,
        working_height: float,
    ) -> None:
        """Command the arm for one step: the tip moves towards ``goal`` [3] m at no more than ``speed`` [m/s].

        The tool's x axis turns to ``x_axis`` [3], and its z axis to ``z_axis`` [3] if given: unit vectors in the
        world, perpendicular to each other. The lift brings the shoulder to :data:`SHOULDER_DROP` below
        ``working_height`` [m].
        """
        robot = self.robot
        dt = self.robot.rigid.dt
        pose = robot.frame_pose(self.tool)
        axes = axes_of_pose(pose)
        tip = pose[:3] + self._tip_offset * axes[0]
        jacobian = robot.rigid.jacobian(robot.name, self.tool, tip)[:, self._joints]
        move = self._advance_reference(goal, speed, dt) + _clip_norm(POSITION_GAIN * (self._reference - tip), speed)
        ik = self._pointing if z_axis is None else self._orienting
        ik.jacobian[:3] = jacobian[:3]
        ik.velocity[:3] = move
        if z_axis is None:
            ik.jacobian[3:] = axes[1:] @ jacobian[3:]
            ik.velocity[3:] = _clip_norm(POSITION_GAIN * _pointing_error(axes @ x_axis), MAX_TOOL_RATE)
        else:
            wanted = np.array([x_axis, frames.cross(z_axis, x_axis), z_axis])
            ik.jacobian[3:] = jacobian[3:]
            ik.velocity[3:] = _clip_norm(POSITION_GAIN * frames.log(frames.from_matrix(wanted.T @ axes)), MAX_TOOL_RATE)

        now = robot.setpoint[self._joints]
        home = self._home.copy()
        if self._lifts:
            raised = working_height - SHOULDER_DROP - self.shoulder_position[2]
            home[: self._lifts] = now[: self._lifts] + raised / self._lifts
        fastest = self._fastest
        home = clip(home, self._lower, self._upper)
        ik.posture_rates[:] = clip(POSTURE_GAIN * (home - now), -0.8 * fastest, 0.8 * fastest)
        ik.min_rates[:] = (self._lower - now) / dt
        ik.max_rates[:] = (self._upper - now) / dt
        rates = ik.solve()
        # all joints are slowed down by the same factor: the tip stays on its line
        rates = rates / max(1.0, float((np.abs(rates) / fastest).max()))
        change = rates - self._rates
        self._rates = self._rates + change / max(1.0, float((np.abs(change) / self._largest_change).max()))
        robot.command_position(now + dt * self._rates, self._joints)

    def hold_position(self) -> None:
        """Command the joints to their present set-points, for one step in which the arm does not move."""
        self._rates[:] = 0.0
        self.robot.command_position(self.robot.setpoint[self._joints], self._joints)

    def _advance_reference(self, goal: np.ndarray, speed: float, dt: float) -> np.ndarray:
        """Advance the reference by a step of a trapezoidal velocity profile; its velocity [3] m/s."""
        offset = goal - self._reference
        left = _length(offset)
        if left < 1e-9:
            self._reference_speed = 0.0
            return np.zeros(3)
        # the largest speed from which it can stop at the goal
        braking = math.sqrt(2.0 * self.acceleration * left)
        self._reference_speed = min(self._reference_speed + self.acceleration * dt, speed, braking)
        step = min(self._reference_speed * dt, left)
        self._reference = self._reference + offset * (step / left)
        return offset * (step / left / dt)


def _pointing_error(axis: np.ndarray) -> np.ndarray:
    """Rotation [2] rad about a tool's y and z axes that turns its x axis to ``axis`` [3], given in the tool's frame."""
    ahead, left, up = axis
    turn = np.array([-up, left])
    if ahead < 0.0:
        turn /= max(float(np.hypot(up, left)), 1e-9)
    return turn


def _clip_norm(vector: np.ndarray, length: float) -> np.ndarray:
    """The vector, scaled down to ``length`` if it is longer."""
    return vector * min(1.0, length / max(_length(vector), 1e-12))


def _length(vector: np.ndarray) -> float:
    """Length of a vector; takes a quarter of the time of ``np.linalg.norm``."""
    return math.sqrt(vector.dot(vector))


def axes_of_pose(pose: np.ndarray) -> np.ndarray:
    """The axes of a pose [7] as rows [3, 3], in its parent: frames.to_matrix in Python floats, ten times as fast."""
    x, y, z, w = pose[3:].tolist()
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)],
            [2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)],
            [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


class InverseKinematics:
    """Joint rates of one arm that fulfil tasks in order of priority, within bounds; one compiled call.

    A task uses only the null space of those before it (Siciliano and Slotine 1991). See
    :mod:`vinesim.kernels.robot.inverse_kinematics`.
    """

    def __init__(self, joint_weights: np.ndarray, task_rows: Sequence[int]) -> None:
        """``joint_weights`` [joint]: relative use of the joints; ``task_rows``: number of rows of each task."""
        joints = len(joint_weights)
        rows = sum(task_rows)
        self.jacobian = np.zeros((rows, joints))
        self.velocity = np.zeros(rows)
        """[row, joint] and [row]: rows of all tasks, in order; velocities along them that are asked for."""
        self.posture_rates = np.zeros(joints)
        self.rates = np.zeros(joints)
        """[joint] Input: rates towards a posture, used in the null space of the tasks. Output: the result [rad/s or
        m/s]."""
        self.min_rates = np.zeros(joints)
        self.max_rates = np.zeros(joints)
        """[joint] bounds of the rates [rad/s or m/s]."""
        scratch = SharedArrays(
            inverse_kinematics.IkScratch,
            weights=np.zeros(joints),
            fixed=np.zeros(joints),
            solution=np.zeros(joints),
            basis=np.zeros((rows + 1, joints)),
            residual=np.zeros(rows),
            is_used=np.zeros(rows, np.int32),
        )
        inputs = (self.jacobian, self.velocity, self.posture_rates, self.min_rates, self.max_rates, joint_weights)
        solve = KernelLaunch(
            inverse_kinematics.solve_prioritized_ik,
            [
                share(np.cumsum(task_rows, dtype=np.int32), wp.int32),
                *(share(array, wp.float64) for array in inputs),
                MIN_SINGULAR_VALUE,
            ],
            [scratch.struct, share(self.rates, wp.float64)],
            threads=1,
        )
        self._solve = KernelGraph(solve)

    def solve(self) -> np.ndarray:
        """Joint rates [joint] for the present inputs; the array is used again by the next call.

        Joints that would exceed their bounds are fixed there, one at a time, and the others do the tasks.
        """
        self._solve()
        return self.rates
