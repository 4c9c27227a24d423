"""Dead reckoning and the hiding of corrections: pure functions, the clock is an argument.

Sender and receiver extrapolate with the same :func:`ahead`, so the sender knows how wrong its copies are and stays
silent while that error is small. Distances in metres, angles in radians, times in seconds.
"""

from __future__ import annotations

import numpy as np

MAX_EXTRAPOLATION = 0.150
"""Nobody extrapolates further than this [s]; later the copy stands still."""

POSITION_ERROR = 0.005
"""A record is due when copies are wrong by more than this [m] ..."""

ANGLE_ERROR = float(np.radians(1.0))
"""... or by more than this [rad] ..."""

HEARTBEAT_PERIOD = 1.0
"""... or when nothing was said for this long [s] while awake."""

MAX_CLOCK_SKEW = 1.0
"""Records from further ahead than this [s] count as made then: else a single one would be newer than all to come."""

BLEND_TIME = 0.100
"""A correction is spread over this time [s] in what is shown (95 % of it); velocities are taken at once."""


def normalize(q: np.ndarray) -> np.ndarray:
    """Quaternions [..., 4] brought back to length one (none of them may be zero)."""
    return q / np.sqrt(np.einsum("...i,...i->...", q, q))[..., None]


def quaternion_rate(q: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Time derivative [..., 4] of unit quaternions ``q`` [..., 4] xyzw that turn with ``omega`` [..., 3] rad/s.

    ``omega`` is given in the frame that ``q`` rotates into (world axes for a base, joint-frame axes for a body).
    """
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    a, b, c = 0.5 * omega[..., 0], 0.5 * omega[..., 1], 0.5 * omega[..., 2]
    rate = np.empty((*np.broadcast_shapes(q.shape[:-1], omega.shape[:-1]), 4), np.result_type(q, omega))
    rate[..., 0] = a * w + b * z - c * y
    rate[..., 1] = b * w + c * x - a * z
    rate[..., 2] = c * w + a * y - b * x
    rate[..., 3] = -a * x - b * y - c * z
    return rate


def clamp_age(age: float | np.ndarray) -> float | np.ndarray:
    """How far a record of this ``age`` [s] is extrapolated [s]: never back in time, never past the cap."""
    return np.minimum(np.maximum(age, 0.0), MAX_EXTRAPOLATION)


def extrapolate(q: np.ndarray, rate: np.ndarray, dt: float | np.ndarray) -> np.ndarray:
    """Quaternions [..., 4] after ``dt`` [s] (a number, or one with a trailing axis) at the rate of :func:`spin`.

    First order, normalised: it turns by 2 atan(|omega| dt / 2), within 0.4 degrees of exact at 3 rad/s and 150 ms.
    """
    return normalize(q + rate * dt)


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle [...] rad between rotations ``a`` and ``b`` [..., 4].

    By the chord, not the dot product: the arccosine would make 0.04 degrees of the rounding of single-precision
    states, and a chain of bodies adds that up to a record nobody needs.
    """
    same, opposite = a - b, a + b
    chord = np.minimum(np.einsum("...i,...i->...", same, same), np.einsum("...i,...i->...", opposite, opposite))
    return 4.0 * np.arcsin(np.minimum(0.5 * np.sqrt(chord), 1.0))


def needs_update(position_error: np.ndarray, angle_error: np.ndarray, silence: np.ndarray) -> np.ndarray:
    """Which things must be sent again [k] bool: copies wrong by 5 mm or 1 degree, or silent for a heartbeat."""
    return (position_error > POSITION_ERROR) | (angle_error > ANGLE_ERROR) | (silence >= HEARTBEAT_PERIOD - 1e-9)


def blend_weight(age: float | np.ndarray) -> float | np.ndarray:
    """How much of a correction is still hidden ``age`` seconds after it: 1 falling to 5 % in 100 ms, and on to 0.

    Exponential, because it must not matter that the next pose arrives, and the fading starts anew, every 17 ms.
    """
    return np.exp(-3.0 * np.maximum(age, 0.0) / BLEND_TIME)
