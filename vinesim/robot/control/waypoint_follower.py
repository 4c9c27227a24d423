"""Drives the base along waypoints: it turns towards each waypoint, drives straight to it, and finally turns to a
heading."""

from __future__ import annotations

import math

import numpy as np

from vinesim.robot.drives.controlled_robot import Robot

POSITION_TOLERANCE = 0.01
"""[m] Distance within which a waypoint is reached. GUESSED"""
HEADING_TOLERANCE = 0.01
"""[rad] Error below which a heading is reached. GUESSED"""
DECELERATION = 0.5
"""Deceleration of the base before a waypoint [m/s2] and before a heading [rad/s2]: half of the largest deceleration
of vinebot's tracks."""
LOOKAHEAD_DISTANCE = 0.4
"""[m] Distance along the line between waypoints to the point for which the base steers. GUESSED"""
STUCK_TIMEOUT = 4.0
"""[s] Time without motion after which a base that should move counts as stuck. GUESSED"""


class WaypointFollower:
    """Drives a robot's base along waypoints, one straight leg after the other, forwards or in reverse."""

    def __init__(
        self,
        robot: Robot,
        points: np.ndarray,
        heading: float | None = None,
        *,
        speed: float = 0.5,
        turn_rate: float = 0.4,
        reverse: bool = False,
    ) -> None:
        """``points`` [n, 2] m: waypoints in the world. ``heading`` [rad]: heading at the end (the heading of the
        last leg unless given). ``speed`` [m/s], ``turn_rate`` [rad/s]: largest values. ``reverse``: whether the base
        drives backwards."""
        self.robot = robot
        self.points = np.asarray(points, float).reshape(-1, 2)
        self.heading = heading
        self.speed = speed
        self.turn_rate = turn_rate
        self.is_done = False
        self.is_stuck = False
        """Whether the base does not move although it should."""
        self._direction = -1.0 if reverse else 1.0
        self._leg = 0
        self._turning = True
        self._leg_start: np.ndarray | None = None
        self._last_motion = (0.0, np.full(3, np.inf))

    def control(self, time: float) -> None:
        """Command the base for the step that starts at ``time`` [s]; call it before ``robot.control``."""
        if self.is_done:
            return
        pose, _ = self.robot.rigid.base_state(self.robot.name)
        here = pose[:2]
        yaw = 2.0 * math.atan2(pose[5], pose[6])
        self._detect_stall(time, here, yaw)
        linear = angular = 0.0
        if self._leg_start is None:
            self._leg_start = here.copy()
        if self._leg < len(self.points):
            linear, angular = self._follow_leg(here, yaw)
        elif self.heading is not None:
            angular = self._turn_towards(self.heading, yaw)
        else:
            self.is_done = True
        self.robot.command_base(linear, angular, time)

    def _follow_leg(self, here: np.ndarray, yaw: float) -> tuple[float, float]:
        """Returns velocity [m/s] and yaw rate [rad/s] to follow the present leg. ``here`` [2] m, ``yaw`` [rad]:
        position and heading of the base."""
        goal = self.points[self._leg]
        leg = goal - self._leg_start
        length = float(np.hypot(*leg))
        if length > 1e-6:
            ahead = leg / length
            course = math.atan2(ahead[1], ahead[0]) + (math.pi if self._direction < 0.0 else 0.0)
            if self._turning:
                angular = self._turn_towards(course, yaw)
                return 0.0, angular
            left = float((goal - here) @ ahead)
            if left > POSITION_TOLERANCE:
                beside = float(ahead[0] * (here - goal)[1] - ahead[1] * (here - goal)[0])
                course -= self._direction * math.atan2(beside, LOOKAHEAD_DISTANCE)
                angular = float(np.clip(2.0 * _wrap_angle(course - yaw), -self.turn_rate, self.turn_rate))
                return self._direction * min(self.speed, math.sqrt(2.0 * DECELERATION * left)), angular
        self._leg += 1
        self._turning = True
        self._leg_start = here.copy()
        return 0.0, 0.0

    def _turn_towards(self, course: float, yaw: float) -> float:
        """Returns the yaw rate [rad/s] towards the heading ``course`` [rad]. Ends the turn when the heading is
        reached."""
        error = _wrap_angle(course - yaw)
        rate = float(self.robot.rigid.base_state(self.robot.name)[1][5])
        if abs(error) < HEADING_TOLERANCE and abs(rate) < 0.02:
            if self._leg < len(self.points):
                self._turning = False
            else:
                self.is_done = True
            return 0.0
        return math.copysign(min(self.turn_rate, math.sqrt(2.0 * DECELERATION * abs(error)), 3.0 * abs(error)), error)

    def _detect_stall(self, time: float, here: np.ndarray, yaw: float) -> None:
        """Set :attr:`is_stuck` if the base has not moved for :data:`STUCK_TIMEOUT`."""
        now = np.append(here, yaw)
        if np.abs(now - self._last_motion[1]).max() > 0.01:
            self._last_motion = (time, now)
        self.is_stuck = time - self._last_motion[0] > STUCK_TIMEOUT


def _wrap_angle(angle: float) -> float:
    """Returns the equivalent angle between -pi and pi [rad]."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
