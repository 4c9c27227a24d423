"""A way on the ground: the base turns towards each point, drives there straight, and turns to the last heading."""

from __future__ import annotations

import math

import numpy as np

from vinesim.robot.drives import Robot

ARRIVED = 0.01
"""This near is there [m]."""
FACING = 0.01
"""This exactly turned is turned [rad]."""
DECELERATION = 0.5
"""Of the base before a point [m/s2] and before a heading [rad/s2]; half of what vinebot's tracks can do."""
LOOKAHEAD = 0.4
"""A base beside its line steers for the point so far ahead on it [m]."""
PATIENCE = 4.0
"""A base that has not moved for so long while it should is stuck [s]."""


class Way:
    """Drive along points, one straight leg after the other, forwards unless told otherwise."""

    def __init__(
        self, robot: Robot, points: np.ndarray, heading: float | None = None, *, speed: float = 0.5, turn: float = 0.4,
        backwards: bool = False,
    ) -> None:  # fmt: skip
        """``points`` [n, 2] m in the world, ``heading`` [rad] at the end (as the last leg left it, unless given);
        ``speed`` [m/s], ``turn`` [rad/s]; ``backwards``: the base looks back along every leg.
        """
        self.robot = robot
        self.points = np.asarray(points, float).reshape(-1, 2)
        self.heading, self.speed, self.turn = heading, speed, turn
        self.done = False
        self.stuck = False
        """Whether something keeps the base from going on."""
        self._side = -1.0 if backwards else 1.0
        self._leg = 0
        self._turning = True
        self._from: np.ndarray | None = None
        self._rested = (0.0, np.full(3, np.inf))

    def control(self, time: float) -> None:
        """Command the base for the tick that starts at ``time`` [s]; ``robot.control`` comes after it."""
        if self.done:
            return
        pose, _ = self.robot.rigid.base_state(self.robot.name)
        here, yaw = pose[:2], 2.0 * math.atan2(pose[5], pose[6])
        self._watch(time, here, yaw)
        linear = angular = 0.0
        if self._from is None:
            self._from = here.copy()
        if self._leg < len(self.points):
            linear, angular = self._drive(here, yaw)
        elif self.heading is not None:
            angular = self._face(self.heading, yaw)
        else:
            self.done = True
        self.robot.command_base(linear, angular, time)

    def _drive(self, here: np.ndarray, yaw: float) -> tuple[float, float]:
        """Speeds ahead and to the left on the present leg."""
        goal = self.points[self._leg]
        leg = goal - self._from
        length = float(np.hypot(*leg))
        if length > 1e-6:
            ahead = leg / length
            course = math.atan2(ahead[1], ahead[0]) + (math.pi if self._side < 0.0 else 0.0)
            if self._turning:
                angular = self._face(course, yaw)
                return 0.0, angular
            left = float((goal - here) @ ahead)
            if left > ARRIVED:
                beside = float(ahead[0] * (here - goal)[1] - ahead[1] * (here - goal)[0])
                course -= self._side * math.atan2(beside, LOOKAHEAD)
                angular = float(np.clip(2.0 * _wrapped(course - yaw), -self.turn, self.turn))
                return self._side * min(self.speed, math.sqrt(2.0 * DECELERATION * left)), angular
        self._leg += 1
        self._turning, self._from = True, here.copy()
        return 0.0, 0.0

    def _face(self, course: float, yaw: float) -> float:
        """Rate of turn [rad/s] towards a heading; takes note when it is reached."""
        error = _wrapped(course - yaw)
        rate = float(self.robot.rigid.base_state(self.robot.name)[1][5])
        if abs(error) < FACING and abs(rate) < 0.02:
            if self._leg < len(self.points):
                self._turning = False
            else:
                self.done = True
            return 0.0
        return math.copysign(min(self.turn, math.sqrt(2.0 * DECELERATION * abs(error)), 3.0 * abs(error)), error)

    def _watch(self, time: float, here: np.ndarray, yaw: float) -> None:
        """Notice when the base stands where it should move."""
        now = np.append(here, yaw)
        if np.abs(now - self._rested[1]).max() > 0.01:
            self._rested = (time, now)
        self.stuck = time - self._rested[0] > PATIENCE


def _wrapped(angle: float) -> float:
    """The angle between -pi and pi [rad]."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
