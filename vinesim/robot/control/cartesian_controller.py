"""Cartesian control of one arm: the tip of its tool follows straight lines, and the tool turns to an orientation.

    arm = CartesianController(robot, "left")
    arm.reset()
    while arm.distance_to(goal) > 0.003:
        arm.move_towards(goal, x_axis=[1, 0, 0], z_axis=[0, 0, 1], speed=0.3, working_height=1.4)
        robot.control(time)
        physics.step()

The method is differential inverse kinematics with the damped pseudo-inverse of the Jacobian (Nakamura and Hanafusa
1986) at the measured state. So a moving base and obstacles need no special case. The remaining degrees of freedom of an
arm with seven joints on a lift first turn the tool, then approach a posture (Siciliano and Slotine 1991).
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
"""[1/s] Feedback gain of position and orientation. It is well below the bandwidth of the servos. GUESSED"""
POSTURE_GAIN = 1.0
"""[1/s] Feedback gain of the posture. GUESSED"""
MAX_TOOL_RATE = 1.0
"""[rad/s] Largest rate at which the tool turns. GUESSED"""
SHOULDER_DROP = 0.10
"""[m] Distance below the working height at which the lift holds the shoulder. GUESSED"""
MIN_SINGULAR_VALUE = 0.06
"""[m/rad] Singular value of the Jacobian below which damping begins. It limits joint rates near singular postures.
GUESSED"""
LIMIT_MARGIN = 0.005
"""[rad or m] Distance from its limits at which a joint stops. At a limit, the joint would press on its end stop,
which is a constraint that the physics must solve. GUESSED"""
RATE_RAMP_TIME = 0.15
"""[s] Shortest time in which a joint reaches its largest velocity. GUESSED"""


class CartesianController:
    """Moves the tip of one arm's tool, by the joints of the arm and of the lift that carries the arm."""

    def __init__(
        self, robot: Robot, side: str, *, tip_offset: float = 0.0, acceleration: float = 0.8, use_lift: bool = True
    ) -> None:
        """``robot``: its group ``arm_{side}`` is controlled, and its torso if ``use_lift``. ``tip_offset`` [m]:
        distance of the tip ahead of the tool's frame, along the x axis. ``acceleration`` [m/s2]: of the tip.

        Raises :class:`CommandError` if the robot has no such arm with a tool.
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
        """Joint group of the arm's fingers; empty if there is none."""
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
        """[joint] Largest change of the joint rate in one step [rad/s or m/s]."""
        weights = self._fastest / self._fastest.max()  # the lift is slow, so it moves less than the arm
        self._pointing = InverseKinematics(weights, (3, 2))
        """Inverse kinematics for a tip on a line and the direction of the tool's x axis."""
        self._orienting = InverseKinematics(weights, (3, 3))
        """Inverse kinematics for a tip on a line and the tool's whole orientation."""
        self._home = description.home[self._joints]
        moving = description.moving_joints
        self._shoulder = moving.frames[moving.names.index(arm.joints[0])][1]
        self._rates = np.zeros(len(self._joints))
        self.reset()

    def reset(self) -> None:
        """Set the reference to the present position of the tip, with velocity 0."""
        self._reference, self._reference_speed = self.tip_position, 0.0

    @property
    def reference(self) -> np.ndarray:
        """Reference position of the tip [3] m in the world, which :attr:`tip_position` follows."""
        return self._reference

    @property
    def tip_position(self) -> np.ndarray:
        """Position of the tip [3] m in the world."""
        pose = self.robot.frame_pose(self.tool)
        return pose[:3] + self._tip_offset * axes_of_pose(pose)[0]

    @property
    def shoulder_position(self) -> np.ndarray:
        """Position of the origin of the arm's first link [3] m in the world."""
        return self.robot.frame_pose(self._shoulder)[:3]

    def distance_to(self, goal: np.ndarray) -> float:
        """Returns the distance [m] between the tip and ``goal`` [3] m in the world."""
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
        """Command the arm for one step, in which the tip moves towards ``goal`` [3] m in the world with at most
        ``speed`` [m/s].

        The tool's x axis turns to ``x_axis`` [3], and its z axis to ``z_axis`` [3] if given. These are unit vectors in
        the world, perpendicular to each other. The lift moves the shoulder to :data:`SHOULDER_DROP` below
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
        # all joints are slowed down by the same factor, so that the tip stays on its line
        rates = rates / max(1.0, float((np.abs(rates) / fastest).max()))
        change = rates - self._rates
        self._rates = self._rates + change / max(1.0, float((np.abs(change) / self._largest_change).max()))
        robot.command_position(now + dt * self._rates, self._joints)

    def move_home(self, share: float) -> bool:
        """Command the joints for one step towards the home posture, all with the same time to go and at most with
        ``share`` of their largest velocities. Returns whether they are there."""
        left = self._home - self.robot.setpoint[self._joints]
        steps = float((np.abs(left) / (share * self._fastest)).max()) / self.robot.rigid.dt
        self._rates[:] = 0.0
        self.robot.command_position(self._home - left * (1.0 - 1.0 / max(steps, 1.0)), self._joints)
        return steps <= 1.0

    def hold_position(self) -> None:
        """Command the joints to keep their present set-points, in a step in which the arm is not to move."""
        self._rates[:] = 0.0
        self.robot.command_position(self.robot.setpoint[self._joints], self._joints)

    def _advance_reference(self, goal: np.ndarray, speed: float, dt: float) -> np.ndarray:
        """Advance the reference position by one step of a trapezoidal velocity profile. Returns the velocity [3]
        m/s."""
        offset = goal - self._reference
        left = _length(offset)
        if left < 1e-9:
            self._reference_speed = 0.0
            return np.zeros(3)
        # the largest speed from which the reference can stop at the goal
        braking = math.sqrt(2.0 * self.acceleration * left)
        self._reference_speed = min(self._reference_speed + self.acceleration * dt, speed, braking)
        step = min(self._reference_speed * dt, left)
        self._reference = self._reference + offset * (step / left)
        return offset * (step / left / dt)


def _pointing_error(axis: np.ndarray) -> np.ndarray:
    """Returns the rotation [2] rad about a tool's y and z axes that turns its x axis to ``axis`` [3], which is given
    in the tool's frame."""
    ahead, left, up = axis
    turn = np.array([-up, left])
    if ahead < 0.0:
        turn /= max(float(np.hypot(up, left)), 1e-9)
    return turn


def _clip_norm(vector: np.ndarray, length: float) -> np.ndarray:
    """Returns the vector, scaled to ``length`` if it is longer."""
    return vector * min(1.0, length / max(_length(vector), 1e-12))


def _length(vector: np.ndarray) -> float:
    """Returns the length of a vector, in a quarter of the time of ``np.linalg.norm``."""
    return math.sqrt(vector.dot(vector))


def axes_of_pose(pose: np.ndarray) -> np.ndarray:
    """Returns the axes of a pose [7] as rows [3, 3], in the pose's parent frame. This is frames.to_matrix in Python
    floats, which is ten times as fast."""
    x, y, z, w = pose[3:].tolist()
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)],
            [2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)],
            [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


class InverseKinematics:
    """Computes, in one compiled call, bounded joint rates of one arm that fulfil several tasks in order of priority.

    A task uses only the null space of the tasks before it (Siciliano and Slotine 1991). See
    :mod:`vinesim.kernels.robot.inverse_kinematics`.
    """

    def __init__(self, joint_weights: np.ndarray, task_rows: Sequence[int]) -> None:
        """``joint_weights`` [joint]: relative use of the joints. ``task_rows``: number of rows of each task."""
        joints = len(joint_weights)
        rows = sum(task_rows)
        self.jacobian = np.zeros((rows, joints))
        self.velocity = np.zeros(rows)
        """[row] Input: requested velocity along each row of :attr:`jacobian`, whose rows [row, joint] are those of
        all tasks in order."""
        self.posture_rates = np.zeros(joints)
        """[joint] Input: rates towards a posture, applied in the null space of the tasks [rad/s or m/s]."""
        self.rates = np.zeros(joints)
        """[joint] Output: the result [rad/s or m/s]."""
        self.min_rates = np.zeros(joints)
        self.max_rates = np.zeros(joints)
        """[joint] Input: upper bounds of the rates [rad/s or m/s]. :attr:`min_rates` has the lower bounds."""
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
        """Returns the joint rates [joint] for the present inputs. The next call overwrites the returned array.

        Joints that would exceed their bounds are fixed at the bounds, one at a time, and the other joints fulfil the
        tasks.
        """
        self._solve()
        return self.rates
