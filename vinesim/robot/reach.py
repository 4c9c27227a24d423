"""Reach for a bunch and push it: a scripted motion for demonstrations, benchmarks and tests.

    reach = ReachAndPush(robot, "left", lambda: bunch_position)
    while running:
        reach.control(time)
        robot.control(time)
        physics.step()

The fingertips are led along straight lines by the damped pseudo-inverse of the Jacobian (Nakamura and Hanafusa 1986)
of the state as it is, so that neither a moving base nor a bunch in the way is a special case. What that leaves free, an
arm of seven joints on a lift, first points the fingers (Siciliano and Slotine 1991) and then goes to a posture.
"""

from __future__ import annotations

import enum
import logging
from collections.abc import Callable

import numpy as np

from vinesim import frames
from vinesim.robot.drives import CommandError, Robot

log = logging.getLogger(__name__)

TIP = 0.027
"""How far vinebot's fingers reach beyond its grasping frame [m]."""
GAIN = 5.0
"""Share of an error that is taken out per second [1/s]; well below the servos' bandwidth."""
POSTURE = 1.0
"""The same for the posture [1/s]."""
TURN = 1.0
"""Fastest turn of the fingers [rad/s]."""
RISE = 0.35
"""Fingers point up by this angle [rad]: forearm and wrist stay below the leaves."""
SHOULDER_BELOW = 0.10
"""The posture has the shoulder this far below the target [m]."""
SINGULAR = 0.06
"""Singular values [m/rad] below this one are damped, so that joints keep their speed near singular postures."""
RAMP = 0.15
"""Least time in which a joint comes to its full speed [s]."""
NEAR = 0.003
"""Fingertips this close to the end of a phase [m] are there."""

FAR = 0.01
"""Fingertips that end an approach farther off than this [m] have missed."""


class Phase(enum.Enum):
    """Stages of one push, in their order."""

    APPROACH = "approach"
    TOUCH = "touch"
    PUSH = "push"
    HOLD = "hold"
    RETREAT = "retreat"
    DONE = "done"


class ReachAndPush:
    """One arm touches a target, pushes it, lets go, and begins again.

    ``target`` gives the bunch's centre in the world [3] m; it is asked once for every approach. The fingers come from
    the robot's side and from below, where no wire and few leaves are.
    """

    def __init__(
        self,
        robot: Robot,
        side: str,
        target: Callable[[], np.ndarray],
        *,
        radius: float = 0.05,
        depth: float = 0.04,
        clearance: float = 0.10,
        hold: float = 1.0,
        speed: float = 0.35,
        touch_speed: float = 0.10,
        acceleration: float = 0.8,
        repeat: bool = True,
        lift: bool = True,
    ) -> None:
        """``radius`` of the bunch, ``depth`` of the push and ``clearance`` before the touch [m], ``hold`` [s];
        ``speed`` through free space, ``touch_speed`` [m/s] and ``acceleration`` [m/s2] of the fingertips;
        ``lift`` False leaves the torso to somebody else, such as the other arm.
        """
        description = robot.description
        arm = description.groups.get(f"arm_{side}")
        if arm is None or not arm.tool:
            raise CommandError(f"{robot.name} has no group 'arm_{side}' with a tool; name one in its TOML")
        lifts = description.groups["torso"].joints if lift and "torso" in description.groups else ()
        self.robot = robot
        self.target = target
        self.tool = arm.tool
        self.radius, self.depth, self.clearance, self.hold = radius, depth, clearance, hold
        self.speed, self.touch_speed, self.acceleration = speed, touch_speed, acceleration
        self.repeat = repeat
        self.phase = Phase.APPROACH
        self.cycles = 0
        """Pushes done so far."""
        self.missed = 0
        """Approaches given up because the target is out of reach."""

        self._joints = robot.joint_indices([*lifts, *arm.joints])
        self._lifts = len(lifts)
        speed_of = robot.speed[self._joints]
        self._share = speed_of / speed_of.max()
        """How readily a joint is used: the slow lift less than the arm."""
        self._home = description.home[self._joints]
        moving = description.moving
        self._shoulder = moving.frames[moving.names.index(arm.joints[0])][1]
        self._gripper = f"gripper_{side}" if f"gripper_{side}" in description.groups else ""
        self._way: dict[Phase, np.ndarray] = {}
        self._place = self.tip
        self._pace = 0.0
        self._rates = np.zeros(len(self._joints))
        self._started = -np.inf

    @property
    def tip(self) -> np.ndarray:
        """Fingertips in the world [3] m."""
        pose = self.robot.frame_pose(self.tool)
        return pose[:3] + TIP * _axes(pose)[0]

    @property
    def goal(self) -> np.ndarray:
        """Where the fingertips are to be at the end of the present phase [3] m; where they are, if there is none."""
        return self._way.get(self.phase, self._place)

    @property
    def error(self) -> float:
        """Distance of the fingertips from :attr:`goal` [m]."""
        return float(np.linalg.norm(self.goal - self.tip))

    def control(self, time: float) -> None:
        """Command the arm for the tick that starts at ``time`` [s]; ``robot.control`` comes after it."""
        if self.phase is Phase.DONE:
            return
        if not self._way:
            self._plan()
            self._begin(self.phase, time)
        pose = self.robot.frame_pose(self.tool)
        axes = _axes(pose)
        tip = pose[:3] + TIP * axes[0]
        if self._ended(time, tip):
            self._advance(time)
        if self.phase is not Phase.DONE:
            self._lead(tip, axes)

    # ------------------------------------------------------------------ phases

    def _plan(self) -> None:
        """Lay the way to where the target is now."""
        center = np.asarray(self.target(), float)
        shoulder = self.robot.frame_pose(self._shoulder)[:3]
        ahead = center - shoulder
        ahead[2] = np.hypot(ahead[0], ahead[1]) * np.tan(RISE)
        self._axis = frames.normalize(ahead)
        touch = center - self.radius * self._axis
        ready = touch - self.clearance * self._axis
        pushed = touch + self.depth * self._axis
        self._way = {
            Phase.APPROACH: ready,
            Phase.TOUCH: touch,
            Phase.PUSH: pushed,
            Phase.HOLD: pushed,
            Phase.RETREAT: ready,
        }
        self._height = center[2]
        self._place, self._pace = self.tip, 0.0
        if self._gripper:
            self.robot.command_gripper(self._gripper, 0.0)

    def _begin(self, phase: Phase, time: float) -> None:
        self.phase, self._started = phase, time
        fast = phase in (Phase.APPROACH, Phase.RETREAT)
        self._fastest = self.speed if fast else self.touch_speed
        way = np.linalg.norm(self.goal - self._place)
        # a bunch that pushes back may keep the tip from arriving; then time ends the phase
        self._patience = 2.0 * way / self._fastest + 2.0 * self._fastest / self.acceleration + 3.0

    def _ended(self, time: float, tip: np.ndarray) -> bool:
        elapsed = time - self._started
        if self.phase is Phase.HOLD:
            return elapsed >= self.hold
        return bool(np.linalg.norm(self.goal - tip) < NEAR) or elapsed > self._patience

    def _advance(self, time: float) -> None:
        order = list(Phase)
        phase = order[order.index(self.phase) + 1]
        if self.phase is Phase.APPROACH and self.error > FAR:
            log.warning("%s: target out of reach by %.2f m; bring the base closer", self.robot.name, self.error)
            self.missed += 1
            phase = Phase.RETREAT
            self._way[phase] = self.tip
        if phase is Phase.DONE:
            self.cycles += 1
            if self.repeat:
                self._plan()
                phase = Phase.APPROACH
        self._begin(phase, time)

    # ------------------------------------------------------------------ motion

    def _lead(self, tip: np.ndarray, axes: np.ndarray) -> None:
        """One step of the fingertips [3] m along the way, as speeds of the joints; ``axes`` [3, 3] of the tool."""
        robot, dt = self.robot, self.robot.rigid.dt
        jacobian = robot.rigid.jacobian(robot.name, self.tool, tip)[:, self._joints]
        move = self._glide(dt) + _at_most(GAIN * (self._place - tip), self.speed)
        # forward x axis in the tool's own axes, of which the first is no turn that points
        ahead, left, up = axes @ self._axis
        turn = np.array([-up, left])
        if ahead < 0.0:
            turn /= max(float(np.hypot(up, left)), 1e-9)

        now, home = robot.setpoint[self._joints], self._home.copy()
        if self._lifts:
            raised = self._height - SHOULDER_BELOW - robot.frame_pose(self._shoulder)[2]
            home[: self._lifts] = now[: self._lifts] + raised / self._lifts
        lower, upper, fastest = robot.lower[self._joints], robot.upper[self._joints], robot.speed[self._joints]
        rates = prioritized(
            [(jacobian[:3], move), (axes[1:] @ jacobian[3:], _at_most(GAIN * turn, TURN))],
            np.clip(POSTURE * (np.clip(home, lower, upper) - now), -0.8 * fastest, 0.8 * fastest),
            (lower - now) / dt,
            (upper - now) / dt,
            self._share,
        )
        # slowed down all together, the joints keep the fingers on their line
        rates /= max(1.0, float(np.max(np.abs(rates) / fastest)))
        change = rates - self._rates
        rates = self._rates + change / max(1.0, float(np.max(np.abs(change) / (fastest * dt / RAMP))))
        self._rates = rates
        robot.command_position(now + dt * rates, self._joints)

    def _glide(self, dt: float) -> np.ndarray:
        """Advance the place where the fingertips should be; its velocity [3] m/s."""
        way = self.goal - self._place
        left = float(np.linalg.norm(way))
        if left < 1e-9:
            self._pace = 0.0
            return np.zeros(3)
        # the fastest pace from which the rest of the way suffices to stop
        braking = np.sqrt(2.0 * self.acceleration * left)
        self._pace = min(self._pace + self.acceleration * dt, self._fastest, braking)
        step = min(self._pace * dt, left)
        self._place = self._place + way * (step / left)
        return way * (step / left / dt)


def _at_most(vector: np.ndarray, length: float) -> np.ndarray:
    """The vector, shortened to ``length`` if it is longer."""
    return vector * min(1.0, length / max(float(np.linalg.norm(vector)), 1e-12))


def _axes(pose: np.ndarray) -> np.ndarray:
    """The axes of a pose [7] as rows [3, 3], in its parent (frames.matrix in plain numbers: ten times as fast)."""
    x, y, z, w = pose[3:].tolist()
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)],
            [2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)],
            [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def prioritized(
    tasks: list[tuple[np.ndarray, np.ndarray]],
    posture: np.ndarray,
    lowest: np.ndarray,
    highest: np.ndarray,
    share: np.ndarray,
) -> np.ndarray:
    """Joint speeds [joint] that do ``tasks`` (Jacobian [k, joint], wanted [k]) in order, then ``posture`` [joint].

    Later tasks use only what earlier ones leave free. ``share`` [joint] says how readily a joint is used. Joints that
    would pass ``lowest`` or ``highest`` [joint] stay at that bound, and the others do their work.
    """
    held = np.zeros(len(posture), bool)
    fixed = np.zeros(len(posture))
    while True:
        rates = _stacked(tasks, posture, np.where(held, 0.0, share), fixed)
        beyond = np.where(held, 0.0, np.maximum(rates - highest, lowest - rates))
        worst = int(np.argmax(beyond))
        if beyond[worst] <= 1e-9:
            return rates
        held[worst] = True
        fixed[worst] = np.clip(rates[worst], lowest[worst], highest[worst])


def _stacked(
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
    damping = np.where(s < SINGULAR, (1.0 - (s / SINGULAR) ** 2) * (0.5 * SINGULAR) ** 2, 0.0)
    inverse = (vt.T * (s / np.maximum(s * s + damping, 1e-12))) @ u.T
    used = vt[s > 1e-3 * SINGULAR]
    return inverse, used.T @ used
