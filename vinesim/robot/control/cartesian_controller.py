"""A hand, led: a point of an arm's tool follows straight lines, and the tool turns to where it is to point.

    hand = Hand(robot, "left")
    hand.start()
    while hand.distance(goal) > 0.003:
        hand.lead(goal, ahead=[1, 0, 0], up=[0, 0, 1], speed=0.3)
        robot.control(time)
        physics.step()

The point is led by the damped pseudo-inverse of the Jacobian (Nakamura and Hanafusa 1986) of the state as it is, so
that neither a moving base nor a thing in the way is a special case. What that leaves free, an arm of seven joints on a
lift, first turns the tool (Siciliano and Slotine 1991) and then goes to a posture.
"""

from __future__ import annotations

import numpy as np

from vinesim import frames
from vinesim.robot.drives.commands import CommandError
from vinesim.robot.drives.robot import Robot

POSITION_GAIN = 5.0
"""Share of an error that is taken out per second [1/s]; well below the servos' bandwidth."""
POSTURE_GAIN = 1.0
"""The same for the posture [1/s]."""
MAX_TOOL_RATE = 1.0
"""Fastest turn of the tool [rad/s]."""
SHOULDER_DROP = 0.10
"""The posture has the shoulder this far below the hand's goal [m]."""
MIN_SINGULAR_VALUE = 0.06
"""Singular values [m/rad] below this one are damped, so that joints keep their speed near singular postures."""
RATE_RAMP_TIME = 0.15
"""Least time in which a joint comes to its full speed [s]."""


class CartesianController:
    """One arm's tool: where it is, and how it is led."""

    def __init__(
        self, robot: Robot, side: str, *, tip_offset: float = 0.0, acceleration: float = 0.8, use_lift: bool = True
    ) -> None:
        """``tip``: how far ahead of the tool's frame the led point lies [m]; ``acceleration`` of that point [m/s2];
        ``lift`` False leaves the torso to somebody else, such as the other arm.
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
        """How readily a joint is used: the slow lift less than the arm."""
        self._home = description.home[self._joints]
        moving = description.moving_joints
        self._shoulder = moving.frames[moving.names.index(arm.joints[0])][1]
        self._rates = np.zeros(len(self._joints))
        self.reset()

    def reset(self) -> None:
        """Begin a new way where the hand is now, at rest."""
        self._reference, self._reference_speed = self.tip_position, 0.0

    @property
    def reference(self) -> np.ndarray:
        """Where the point should be by now [3] m; :attr:`point` follows it."""
        return self._reference

    @property
    def tip_position(self) -> np.ndarray:
        """The led point in the world [3] m."""
        pose = self.robot.frame_pose(self.tool)
        return pose[:3] + self._tip_offset * axes_of_pose(pose)[0]

    @property
    def shoulder_position(self) -> np.ndarray:
        """Where the arm begins, in the world [3] m."""
        return self.robot.frame_pose(self._shoulder)[:3]

    def distance_to(self, goal: np.ndarray) -> float:
        """From the led point to ``goal`` [3] in the world [m]."""
        return float(np.linalg.norm(goal - self.tip_position))

    def move_towards(
        self,
        goal: np.ndarray,
        x_axis: np.ndarray,
        z_axis: np.ndarray | None = None,
        *,
        speed: float,
        shoulder_height: float,
    ) -> None:
        """Command the arm for one tick: the point towards ``goal`` [3] m at most at ``speed`` [m/s].

        The tool's x axis turns to ``ahead`` [3], and its z axis to ``up`` [3] if that is given; both in the world and
        perpendicular. The lift brings the shoulder a little below ``height`` [m].
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
            raised = shoulder_height - SHOULDER_DROP - self.shoulder_position[2]
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
        # slowed down all together, the joints keep the hand on its line
        rates /= max(1.0, float(np.max(np.abs(rates) / fastest)))
        change = rates - self._rates
        rates = self._rates + change / max(1.0, float(np.max(np.abs(change) / (fastest * dt / RATE_RAMP_TIME))))
        self._rates = rates
        robot.command_position(now + dt * rates, self._joints)

    def hold_position(self) -> None:
        """Stay as the joints are, whatever the base does."""
        self._rates[:] = 0.0
        self.robot.command_position(self.robot.setpoint[self._joints], self._joints)

    def _advance_reference(self, goal: np.ndarray, speed: float, dt: float) -> np.ndarray:
        """Advance the place where the point should be; its velocity [3] m/s."""
        way = goal - self._reference
        left = float(np.linalg.norm(way))
        if left < 1e-9:
            self._reference_speed = 0.0
            return np.zeros(3)
        # the fastest pace from which the rest of the way suffices to stop
        braking = np.sqrt(2.0 * self.acceleration * left)
        self._reference_speed = min(self._reference_speed + self.acceleration * dt, speed, braking)
        step = min(self._reference_speed * dt, left)
        self._reference = self._reference + way * (step / left)
        return way * (step / left / dt)


def _pointing_error(axis: np.ndarray) -> np.ndarray:
    """Turn [2] about a tool's y and z axes that brings its x axis to ``axis`` [3], given in the tool's own axes."""
    ahead, left, up = axis
    turn = np.array([-up, left])
    if ahead < 0.0:
        turn /= max(float(np.hypot(up, left)), 1e-9)
    return turn


def _clip_norm(vector: np.ndarray, length: float) -> np.ndarray:
    """The vector, shortened to ``length`` if it is longer."""
    return vector * min(1.0, length / max(float(np.linalg.norm(vector)), 1e-12))


def axes_of_pose(pose: np.ndarray) -> np.ndarray:
    """The axes of a pose [7] as rows [3, 3], in its parent (frames.to_matrix in plain numbers: ten times as fast)."""
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
    """Joint speeds [joint] that do ``tasks`` (Jacobian [k, joint], wanted [k]) in order, then ``posture`` [joint].

    Later tasks use only what earlier ones leave free. ``share`` [joint] says how readily a joint is used. Joints that
    would pass ``lowest`` or ``highest`` [joint] stay at that bound, and the others do their work.
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
    """Speeds [joint] ``fixed`` + ``share`` y, where y does each task in what the ones before it leave free."""
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
    """Pseudo-inverse [joint, k] with small singular values damped, and the projector [joint, joint] on what it uses."""
    u, s, vt = np.linalg.svd(matrix, full_matrices=False)
    damping = np.where(
        s < MIN_SINGULAR_VALUE, (1.0 - (s / MIN_SINGULAR_VALUE) ** 2) * (0.5 * MIN_SINGULAR_VALUE) ** 2, 0.0
    )
    inverse = (vt.T * (s / np.maximum(s * s + damping, 1e-12))) @ u.T
    used = vt[s > 1e-3 * MIN_SINGULAR_VALUE]
    return inverse, used.T @ used
