"""Odometry of tracks that slip: pose and velocity of the base as its track encoders measure them.

Tracks measure travel ahead and turns, never motion sideways. A constant share of both is lost on the ground. Odometry
does not know this share, so the share is the standard deviation of its measurements. The covariance of the pose follows
to first order, from the derivative of the measured pose with respect to the two shares.
"""

from __future__ import annotations

import numpy as np

from vinesim.core import frames

LEAST_VARIANCE = 1e-6
"""[m2, rad2, m2/s2, rad2/s2] Added to every variance, so that filters can invert covariances. GUESSED: the variance of
encoders that resolve a millimetre."""

_EXACT = np.tile(LEAST_VARIANCE * np.eye(3), (2, 1, 1))
"""Covariances of tracks that do not slip."""


class TrackOdometry:
    """Pose since the start, integrated from the travel of tracks. A constant share of the travel is lost by slip."""

    def __init__(self, linear_slip: float, angular_slip: float, pose: np.ndarray) -> None:
        """``linear_slip``, ``angular_slip``: shares of the travel that are lost, 0 to below 1; ``pose`` [7] at
        start."""
        self._slip = linear_slip, angular_slip
        self._gain = 1.0 / (1.0 - linear_slip), 1.0 / (1.0 - angular_slip)
        self._actual = float(pose[0]), float(pose[1]), frames.to_yaw(pose[3:])
        self._measured = 0.0, 0.0, 0.0
        self._by_linear = 0.0, 0.0
        """Derivative of the measured x and y with respect to the share of the travel that is lost."""
        self._by_angular = 0.0, 0.0, 0.0
        """Derivative of the measured x, y and yaw with respect to the share of turns that is lost."""

    def update(self, base_q: np.ndarray) -> np.ndarray:
        """Add the motion to ``base_q`` [7], the actual pose, and return the measured pose [7] since the start."""
        x, y, yaw = self._actual
        self._actual = float(base_q[0]), float(base_q[1]), frames.to_yaw(base_q[3:])
        turn = (self._actual[2] - yaw + np.pi) % (2.0 * np.pi) - np.pi
        c = np.cos(yaw + 0.5 * turn)
        s = np.sin(yaw + 0.5 * turn)
        ahead = self._gain[0] * (c * (self._actual[0] - x) + s * (self._actual[1] - y))
        turn *= self._gain[1]
        x, y, yaw = self._measured
        c = np.cos(yaw + 0.5 * turn)
        s = np.sin(yaw + 0.5 * turn)
        self._measured = x + c * ahead, y + s * ahead, yaw + turn
        linear = self._by_linear
        (across, along, angle) = self._by_angular
        middle = angle + 0.5 * turn
        self._by_linear = linear[0] + c * ahead, linear[1] + s * ahead
        self._by_angular = across - s * ahead * middle, along + c * ahead * middle, angle + turn
        return frames.pose([*self._measured[:2], 0.0], frames.from_yaw(self._measured[2]))

    def velocity(self, base_q: np.ndarray, base_qd: np.ndarray) -> np.ndarray:
        """Velocity [6] in the base's axes as the tracks measure it, at the pose [7] and velocity [6] in the world."""
        x, y, z, w = base_q[3:].tolist()
        vx, vy, vz, wx, wy, wz = base_qd.tolist()
        # along the base's x axis and about its z axis, in Python floats: ten times as fast as frames.rotate
        ahead = (1.0 - 2.0 * (y * y + z * z)) * vx + 2.0 * (x * y + w * z) * vy + 2.0 * (x * z - w * y) * vz
        turn = 2.0 * (x * z + w * y) * wx + 2.0 * (y * z - w * x) * wy + (1.0 - 2.0 * (x * x + y * y)) * wz
        return np.array([self._gain[0] * ahead, 0.0, 0.0, 0.0, 0.0, self._gain[1] * turn])

    def covariance(self, velocity: np.ndarray) -> np.ndarray:
        """Covariances [2, 3, 3] in x, y and yaw: of the measured pose, and of the measured ``velocity`` [6]."""
        if not any(self._slip):
            return _EXACT
        linear = self._slip[0] * np.array([*self._by_linear, 0.0])
        angular = self._slip[1] * np.array(self._by_angular)
        found = _EXACT.copy()
        found[0] += np.outer(linear, linear) + np.outer(angular, angular)
        found[1, 0, 0] += (self._slip[0] * velocity[0]) ** 2
        found[1, 2, 2] += (self._slip[1] * velocity[5]) ** 2
        return found
