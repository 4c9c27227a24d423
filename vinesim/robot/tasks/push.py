"""A scripted motion for demonstrations, benchmarks and tests: the fingertips push a bunch.

    push = PushBunch(robot, "left", lambda: bunch_position)
    while running:
        push.control(time)
        robot.control(time)
        physics.step()

The fingertips follow straight lines, see :mod:`vinesim.robot.control.cartesian_controller`.
"""

from __future__ import annotations

import enum
import logging
from collections.abc import Callable

import numpy as np

from vinesim.core import frames
from vinesim.robot.control.cartesian_controller import CartesianController
from vinesim.robot.drives.controlled_robot import Robot

log = logging.getLogger(__name__)

FINGER_LENGTH = 0.027
"""[m] Distance of vinebot's fingertips from the frame of its tool."""
PUSH_ELEVATION = 0.35
"""[rad] Angle by which the fingers point upwards, so that forearm and wrist stay below the leaves. GUESSED"""
CLOSED_OPENING = 0.002
"""[m] Opening of closed fingers. It is not 0, so that they do not press on their end stops. GUESSED"""
POSITION_TOLERANCE = 0.003
"""[m] Distance within which the fingertips have reached the goal of a phase. GUESSED"""

MISS_DISTANCE = 0.01
"""[m] Distance from the goal at the end of an approach above which the fingertips have missed. GUESSED"""


class Phase(enum.Enum):
    """Stages of one push, in their order."""

    APPROACH = "approach"
    TOUCH = "touch"
    PUSH = "push"
    HOLD = "hold"
    RETREAT = "retreat"
    DONE = "done"


class PushBunch:
    """Moves one arm so that its fingertips touch a target, push it, retreat, and begin again.

    ``target`` returns the centre of the bunch in the world [3] m. It is called before every approach. The fingers
    approach from the robot's side and from below, where there is no wire and few leaves.
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
        hold_time: float = 1.0,
        speed: float = 0.35,
        touch_speed: float = 0.10,
        acceleration: float = 0.8,
        repeat: bool = True,
        use_lift: bool = True,
    ) -> None:
        """``radius`` [m]: of the bunch. ``depth`` [m]: of the push. ``clearance`` [m]: distance from the bunch
        before the touch. ``hold_time`` [s]: duration for which the bunch is held pushed. ``speed``, ``touch_speed``
        [m/s], ``acceleration`` [m/s2]: of the fingertips, where ``touch_speed`` is used near the bunch. ``repeat``:
        whether to begin again after a push. ``use_lift``: whether the torso moves, too; False leaves it to another
        controller, such as that of the other arm."""
        self.robot = robot
        self.target = target
        self.arm = CartesianController(
            robot, side, tip_offset=FINGER_LENGTH, acceleration=acceleration, use_lift=use_lift
        )
        self.tool = self.arm.tool
        self.radius = radius
        self.depth = depth
        self.clearance = clearance
        self.hold_time = hold_time
        self.speed = speed
        self.touch_speed = touch_speed
        self.repeat = repeat
        self.phase = Phase.APPROACH
        self.push_count = 0
        """Number of completed pushes."""
        self.missed_count = 0
        """Number of approaches that did not reach the target."""

        self._waypoints: dict[Phase, np.ndarray] = {}
        self._started = -np.inf

    @property
    def tip(self) -> np.ndarray:
        """Position of the fingertips in the world [3] m."""
        return self.arm.tip_position

    @property
    def goal(self) -> np.ndarray:
        """Goal of the fingertips in the present phase [3] m; before the first phase, their reference position."""
        return self._waypoints.get(self.phase, self.arm.reference)

    @property
    def error(self) -> float:
        """Distance between the fingertips and :attr:`goal` [m]."""
        return self.arm.distance_to(self.goal)

    def control(self, time: float) -> None:
        """Command the arm for the step that starts at ``time`` [s]. Call this before ``robot.control``."""
        if self.phase is Phase.DONE:
            return
        if not self._waypoints:
            self._plan()
            self._begin(self.phase, time)
        if self._is_phase_over(time):
            self._advance(time)
        if self.phase is not Phase.DONE:
            self.arm.move_towards(self.goal, self._push_axis, speed=self._phase_speed, working_height=self._height)

    # ------------------------------------------------------------------ phases

    def _plan(self) -> None:
        """Compute the waypoints of all phases for the present position of the target."""
        center = np.asarray(self.target(), float)
        ahead = center - self.arm.shoulder_position
        ahead[2] = np.hypot(ahead[0], ahead[1]) * np.tan(PUSH_ELEVATION)
        self._push_axis = frames.normalize(ahead)
        touch = center - self.radius * self._push_axis
        ready = touch - self.clearance * self._push_axis
        pushed = touch + self.depth * self._push_axis
        self._waypoints = {
            Phase.APPROACH: ready,
            Phase.TOUCH: touch,
            Phase.PUSH: pushed,
            Phase.HOLD: pushed,
            Phase.RETREAT: ready,
        }
        self._height = center[2]
        self.arm.reset()
        if self.arm.gripper:
            self.robot.command_gripper(self.arm.gripper, CLOSED_OPENING)

    def _begin(self, phase: Phase, time: float) -> None:
        """Start a phase at ``time`` [s]: set its speed and its timeout."""
        self.phase = phase
        self._started = time
        fast = phase in (Phase.APPROACH, Phase.RETREAT)
        self._phase_speed = self.speed if fast else self.touch_speed
        distance = np.linalg.norm(self.goal - self.arm.reference)
        # A bunch that resists may stop the tip before its goal; then the timeout ends the phase.
        self._phase_timeout = 2.0 * distance / self._phase_speed + 2.0 * self._phase_speed / self.arm.acceleration + 3.0

    def _is_phase_over(self, time: float) -> bool:
        """Returns whether the present phase has reached its goal or its timeout at ``time`` [s]."""
        elapsed = time - self._started
        if self.phase is Phase.HOLD:
            return elapsed >= self.hold_time
        return bool(self.error < POSITION_TOLERANCE or elapsed > self._phase_timeout)

    def _advance(self, time: float) -> None:
        """Start the next phase at ``time`` [s]. After a missed approach, this is the retreat."""
        order = list(Phase)
        phase = order[order.index(self.phase) + 1]
        if self.phase is Phase.APPROACH and self.error > MISS_DISTANCE:
            log.warning("%s: target out of reach by %.2f m; bring the base closer", self.robot.name, self.error)
            self.missed_count += 1
            phase = Phase.RETREAT
            self._waypoints[phase] = self.tip
        if phase is Phase.DONE:
            self.push_count += 1
            if self.repeat:
                self._plan()
                phase = Phase.APPROACH
        self._begin(phase, time)
