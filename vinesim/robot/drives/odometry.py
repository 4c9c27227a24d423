"""Odometry of tracks that slip: pose of the base as its track encoders measure it."""

from __future__ import annotations

import numpy as np

from vinesim import frames


class TrackOdometry:
    """Pose since the start, integrated from the travel of tracks of which the ground loses a constant share."""

    def __init__(self, linear_slip: float, angular_slip: float, pose: np.ndarray) -> None:
        """``linear_slip``, ``angular_slip``: shares of the travel that are lost, 0 to below 1; ``pose`` [7] at
        start."""
        self._gain = 1.0 / (1.0 - linear_slip), 1.0 / (1.0 - angular_slip)
        self._actual = float(pose[0]), float(pose[1]), frames.to_yaw(pose[3:])
        self._measured = 0.0, 0.0, 0.0

    def update(self, base_q: np.ndarray) -> np.ndarray:
        """Add the motion to ``base_q`` [7], the actual pose, and return the measured pose [7] since the start."""
        x, y, yaw = self._actual
        self._actual = float(base_q[0]), float(base_q[1]), frames.to_yaw(base_q[3:])
        turn = (self._actual[2] - yaw + np.pi) % (2.0 * np.pi) - np.pi
        c, s = np.cos(yaw + 0.5 * turn), np.sin(yaw + 0.5 * turn)
        travel = self._actual[0] - x, self._actual[1] - y
        ahead, left = self._gain[0] * (c * travel[0] + s * travel[1]), c * travel[1] - s * travel[0]
        turn *= self._gain[1]
        x, y, yaw = self._measured
        c, s = np.cos(yaw + 0.5 * turn), np.sin(yaw + 0.5 * turn)
        self._measured = x + c * ahead - s * left, y + s * ahead + c * left, yaw + turn
        return frames.pose([*self._measured[:2], 0.0], frames.from_yaw(self._measured[2]))
