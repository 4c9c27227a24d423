"""Odometry of tracks that slip: pose and velocity of the base as measured by the track encoders.

Tracks measure travel ahead along the surface of the ground and turns, but no sideways motion. A share of travel and of
turns is lost by slip on the ground; uphill more travel is lost, downhill less. Odometry does not know these shares, so
the shares on level ground are used as the standard deviations of its measurements.
The covariance of the pose is computed to first order, from the derivative of the measured pose with respect to the two
shares.
"""

from __future__ import annotations

import numpy as np

from vinesim.core import frames

LEAST_VARIANCE = 1e-6
"""[m2, rad2, m2/s2, rad2/s2] Variance that is added to every measurement, so that filters can invert covariances.
GUESSED: the variance of encoders with a resolution of a millimetre."""

SLOPE_SLIP = 0.1
"""[1] Share of the travel that is lost on an incline, over the incline's tangent. DERIVED: at small slip a track of
length L = 1 m on soil with the shear deformation modulus K = 2 cm loses 2 K / L of its travel at full traction (Wong
2008, Theory of Ground Vehicles, 2.4; K is 1 to 2.5 cm on firm soil), and full traction climbs an incline of 0.4
(data/robots/vinebot.toml)."""
MAX_SLIP = 0.9
"""[1] Largest share of the travel that is lost."""

_EXACT = np.tile(LEAST_VARIANCE * np.eye(3), (2, 1, 1))
"""Covariances [2, 3, 3] of pose and velocity for tracks that do not slip."""


class TrackOdometry:
    """Pose of the base since the start, integrated from the travel of its tracks. A constant share of the travel is
    lost by slip."""

    def __init__(self, linear_slip: float, angular_slip: float, pose: np.ndarray) -> None:
        """``linear_slip``, ``angular_slip``: lost shares of travel ahead and of turns, from 0 to below 1. ``pose``
        [7]: pose of the base at the start."""
        self._slip = linear_slip, angular_slip
        self._gain = 1.0 / (1.0 - linear_slip), 1.0 / (1.0 - angular_slip)
        self._actual = float(pose[0]), float(pose[1]), frames.to_yaw(pose[3:])
        self._height = float(pose[2])
        self._measured = 0.0, 0.0, 0.0
        self._by_linear = 0.0, 0.0
        """Derivative of the measured x and y with respect to the lost share of travel ahead."""
        self._by_angular = 0.0, 0.0, 0.0
        """Derivative of the measured x, y and yaw with respect to the lost share of turns."""

    def update(self, base_q: np.ndarray) -> np.ndarray:
        """Add the motion to the actual pose ``base_q`` [7]. Returns the measured pose [7] since the start."""
        x, y, yaw = self._actual
        self._actual = float(base_q[0]), float(base_q[1]), frames.to_yaw(base_q[3:])
        rise = float(base_q[2]) - self._height
        self._height = float(base_q[2])
        climb = _climb(base_q)
        level = 1.0 / np.sqrt(1.0 + climb * climb)
        turn = (self._actual[2] - yaw + np.pi) % (2.0 * np.pi) - np.pi
        c = np.cos(yaw + 0.5 * turn)
        s = np.sin(yaw + 0.5 * turn)
        travel = level * (c * (self._actual[0] - x) + s * (self._actual[1] - y)) + level * climb * rise
        ahead = self._linear_gain(climb) * travel
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
        """Returns the velocity [6] m/s, rad/s that the tracks measure, in the axes of the base. ``base_q`` [7],
        ``base_qd`` [6]: pose and velocity of the base in the world."""
        x, y, z, w = base_q[3:].tolist()
        vx, vy, vz, wx, wy, wz = base_qd.tolist()
        # along the base's x axis and about its z axis, in Python floats: ten times as fast as frames.rotate
        ahead = (1.0 - 2.0 * (y * y + z * z)) * vx + 2.0 * (x * y + w * z) * vy + 2.0 * (x * z - w * y) * vz
        turn = 2.0 * (x * z + w * y) * wx + 2.0 * (y * z - w * x) * wy + (1.0 - 2.0 * (x * x + y * y)) * wz
        return np.array([self._linear_gain(_climb(base_q)) * ahead, 0.0, 0.0, 0.0, 0.0, self._gain[1] * turn])

    def _linear_gain(self, climb: float) -> float:
        """Returns the ratio of the tracks' travel to the travel of the base that climbs by ``climb`` [1] ahead."""
        return 1.0 / (1.0 - min(self._slip[0] + SLOPE_SLIP * climb, MAX_SLIP))

    def covariance(self, velocity: np.ndarray) -> np.ndarray:
        """Returns the covariances [2, 3, 3] of x, y and yaw: of the measured pose, and of the measured ``velocity``
        [6]."""
        if not any(self._slip):
            return _EXACT
        linear = self._slip[0] * np.array([*self._by_linear, 0.0])
        angular = self._slip[1] * np.array(self._by_angular)
        found = _EXACT.copy()
        found[0] += np.outer(linear, linear) + np.outer(angular, angular)
        found[1, 0, 0] += (self._slip[0] * velocity[0]) ** 2
        found[1, 2, 2] += (self._slip[1] * velocity[5]) ** 2
        return found


def _climb(base_q: np.ndarray) -> float:
    """Returns the tangent [1] of the incline of the x axis of the pose ``base_q`` [7]."""
    x, y, z, w = base_q[3:].tolist()
    sine = 2.0 * (x * z - w * y)
    return float(sine / np.sqrt(max(1.0 - sine * sine, 1e-12)))
