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

import numpy as np

from vinesim import frames
from vinesim.robot.drives.commands import CommandError
from vinesim.robot.drives.controlled_robot import Robot

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
        self.robot, self.tool = robot, arm.tool
        self.acceleration = acceleration
        self.gripper = f"gripper_{side}" if f"gripper_{side}" in description.groups else ""
        """The group of its fingers; empty if it has none."""
        self._tip_offset = tip_offset
        self._joints = robot.joint_indices([*lifts, *arm.joints])
        self._lifts = len(lifts)
        speed_of = robot.max_velocity[self._joints]
        self._joint_weights = speed_of / speed_of.max()
        """[joint] Weights in the inverse kinematics: the slow lift moves less than the arm."""
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
        return float(np.linalg.norm(goal - self.tip_position))

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
        robot, dt = self.robot, self.robot.rigid.dt
        pose = robot.frame_pose(self.tool)
        axes = axes_of_pose(pose)
        tip = pose[:3] + self._tip_offset * axes[0]
        jacobian = robot.rigid.jacobian(robot.name, self.tool, tip)[:, self._joints]
        move = self._advance_reference(goal, speed, dt) + _clip_norm(POSITION_GAIN * (self._reference - tip), speed)
        if z_axis is None:
            turning = axes[1:] @ jacobian[3:], _clip_norm(POSITION_GAIN * _pointing_error(axes @ x_axis), MAX_TOOL_RATE)
        else:
            wanted = np.array([x_axis, frames.cross(z_axis, x_axis), z_axis])
            turning = (
                jacobian[3:],
                _clip_norm(POSITION_GAIN * frames.log(frames.from_matrix(wanted.T @ axes)), MAX_TOOL_RATE),
            )

        now, home = robot.setpoint[self._joints], self._home.copy()
        if self._lifts:
            raised = working_height - SHOULDER_DROP - self.shoulder_position[2]
            home[: self._lifts] = now[: self._lifts] + raised / self._lifts
        lower, upper, fastest = (
            robot.lower_limit[self._joints],
            robot.upper_limit[self._joints],
            robot.max_velocity[self._joints],
        )
        rates = solve_prioritized_ik(
            [(jacobian[:3], move), turning],
            np.clip(POSTURE_GAIN * (np.clip(home, lower, upper) - now), -0.8 * fastest, 0.8 * fastest),
            (lower - now) / dt,
            (upper - now) / dt,
            self._joint_weights,
        )
        # all joints are slowed down by the same factor: the tip stays on its line
        rates /= max(1.0, float(np.max(np.abs(rates) / fastest)))
        change = rates - self._rates
        rates = self._rates + change / max(1.0, float(np.max(np.abs(change) / (fastest * dt / RATE_RAMP_TIME))))
        self._rates = rates
        robot.command_position(now + dt * rates, self._joints)

    def hold_position(self) -> None:
        """Command the joints to their present set-points, for one step in which the arm does not move."""
        self._rates[:] = 0.0
        self.robot.command_position(self.robot.setpoint[self._joints], self._joints)

    def _advance_reference(self, goal: np.ndarray, speed: float, dt: float) -> np.ndarray:
        """Advance the reference by a step of a trapezoidal velocity profile; its velocity [3] m/s."""
        offset = goal - self._reference
        left = float(np.linalg.norm(offset))
        if left < 1e-9:
            self._reference_speed = 0.0
            return np.zeros(3)
        # the largest speed from which it can stop at the goal
        braking = np.sqrt(2.0 * self.acceleration * left)
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
    return vector * min(1.0, length / max(float(np.linalg.norm(vector)), 1e-12))


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


def solve_prioritized_ik(
    tasks: list[tuple[np.ndarray, np.ndarray]],
    posture_rates: np.ndarray,
    min_rates: np.ndarray,
    max_rates: np.ndarray,
    joint_weights: np.ndarray,
) -> np.ndarray:
    """Joint rates [joint] that fulfil ``tasks`` (Jacobian [k, joint], velocity [k]) in order, then ``posture_rates``.

    Strict priority: a task uses only the null space of those before it (Siciliano and Slotine 1991). All rates are
    [joint] rad/s or m/s. ``joint_weights`` [joint]: relative use of the joints. Joints that would exceed ``min_rates``
    or ``max_rates`` are fixed at that bound, one at a time, and the others do the tasks.
    """
    held = np.zeros(len(posture_rates), bool)
    fixed = np.zeros(len(posture_rates))
    while True:
        rates = _solve_task_stack(tasks, posture_rates, np.where(held, 0.0, joint_weights), fixed)
        beyond = np.where(held, 0.0, np.maximum(rates - max_rates, min_rates - rates))
        worst = int(np.argmax(beyond))
        if beyond[worst] <= 1e-9:
            return rates
        held[worst] = True
        fixed[worst] = np.clip(rates[worst], min_rates[worst], max_rates[worst])


def _solve_task_stack(
    tasks: list[tuple[np.ndarray, np.ndarray]], posture: np.ndarray, share: np.ndarray, fixed: np.ndarray
) -> np.ndarray:
    """Rates [joint] ``fixed`` + ``share`` y, where y does each task in the null space of the ones before it."""
    y = np.zeros(len(posture))
    free = np.eye(len(posture))
    for jacobian, wanted in tasks:
        scaled = jacobian * share
        inverse, used = _damped_inverse(scaled @ free)
        y = y + inverse @ (wanted - jacobian @ fixed - scaled @ y)
        free = free - used
    movable = share > 0.0
    wanted = np.where(movable, (posture - fixed) / np.where(movable, share, 1.0), 0.0)
    return fixed + share * (y + free @ (wanted - y))


def _damped_inverse(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pseudo-inverse [joint, k] with small singular values damped, and the projector [joint, joint] on its row
    space."""
    u, s, vt = np.linalg.svd(matrix, full_matrices=False)
    damping = np.where(
        s < MIN_SINGULAR_VALUE, (1.0 - (s / MIN_SINGULAR_VALUE) ** 2) * (0.5 * MIN_SINGULAR_VALUE) ** 2, 0.0
    )
    inverse = (vt.T * (s / np.maximum(s * s + damping, 1e-12))) @ u.T
    used = vt[s > 1e-3 * MIN_SINGULAR_VALUE]
    return inverse, used.T @ used
