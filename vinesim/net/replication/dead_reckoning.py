"""Dead reckoning: extrapolation of states between messages, decision when to send a state, and error smoothing. No I/O.

The owner of an object sends its states. Every other client nearby moves a copy of the object.

Sender and receiver extrapolate with the same function, :func:`extrapolate`. So the sender knows the error of the copies
and sends nothing while the error is small (IEEE 1278.1, dead reckoning). Distances in metres, angles in radians, times
in seconds.
"""

from __future__ import annotations

import numpy as np

MAX_EXTRAPOLATION = 0.150
"""Longest time by which a state is extrapolated [s]. After this time a copy stands still. GUESSED."""

TREE_VELOCITY_DECAY = 0.080
"""Time in which the velocity that is used to extrapolate a tree falls to 37 % [s].

TUNED on a bunch that is pushed: from 60 to 120 ms the errors differ by 4 %."""

POSITION_ERROR = 0.005
"""Position error of an object's copies, which other clients move, above which the object's state is published [m]."""

ANGLE_ERROR = float(np.radians(1.0))
"""Angle error of an object's copies, which other clients move, above which the object's state is published [rad]."""

HEARTBEAT_PERIOD = 1.0
"""Longest time between two published states of an object that is awake [s]."""

MAX_CLOCK_SKEW = 1.0
"""Longest time by which the time in a message may be in the future [s].

A later time is reduced to this. Otherwise the state would count as newer than all states that follow."""

BLEND_TIME = 0.100
"""Time in which 95 % of a correction is blended into a shown pose [s]. Velocities are corrected at once."""


def normalize(q: np.ndarray) -> np.ndarray:
    """Scale quaternions [..., 4] to unit length. None of them may be zero."""
    return q / np.sqrt(np.einsum("...i,...i->...", q, q))[..., None]


def quaternion_rate(q: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Returns the time derivative [..., 4] of unit quaternions ``q`` [..., 4] xyzw.

    ``omega`` [..., 3] rad/s: angular velocity, in the frame into which ``q`` rotates (world axes for a base, axes of
    the joint's frame for a body).
    """
    x = q[..., 0]
    y = q[..., 1]
    z = q[..., 2]
    w = q[..., 3]
    a = 0.5 * omega[..., 0]
    b = 0.5 * omega[..., 1]
    c = 0.5 * omega[..., 2]
    rate = np.empty((*np.broadcast_shapes(q.shape[:-1], omega.shape[:-1]), 4), np.result_type(q, omega))
    rate[..., 0] = a * w + b * z - c * y
    rate[..., 1] = b * w + c * x - a * z
    rate[..., 2] = c * w + a * y - b * x
    rate[..., 3] = -a * x - b * y - c * z
    return rate


def clamp_age(age: float | np.ndarray) -> float | np.ndarray:
    """Returns the time [s] by which a state of ``age`` [s] is extrapolated, at most :data:`MAX_EXTRAPOLATION`.

    The age is negative if the steps of the sender are ahead of those of the receiver. The state is then extrapolated
    backwards.
    """
    return np.minimum(np.maximum(age, -MAX_EXTRAPOLATION), MAX_EXTRAPOLATION)


def faded_age(age: float | np.ndarray) -> float | np.ndarray:
    """Returns the time [s] for which a tree must move at its last sent velocity to reach its extrapolated state.

    ``age``: time since the state was sent [s].

    The extrapolated velocity decays exponentially with :data:`TREE_VELOCITY_DECAY`, because hands stop branches and
    branches swing back. So the returned time, which is the integral of the decay, is shorter than ``age``.
    """
    return TREE_VELOCITY_DECAY * -np.expm1(-clamp_age(age) / TREE_VELOCITY_DECAY)


def faded_share(age: float) -> float:
    """Returns the share of its last sent velocity that a tree still has ``age`` [s] after the state was sent.

    The velocity decays as in :func:`faded_age`. The share is 0 from :data:`MAX_EXTRAPOLATION` on.
    """
    return float(np.exp(-max(age, 0.0) / TREE_VELOCITY_DECAY)) if age < MAX_EXTRAPOLATION else 0.0


def extrapolate(q: np.ndarray, rate: np.ndarray, dt: float | np.ndarray) -> np.ndarray:
    """Returns quaternions ``q`` [..., 4] after ``dt`` [s] at the ``rate`` [..., 4] 1/s of :func:`quaternion_rate`.

    ``dt``: a number, or an array with a trailing axis of length 1. First order and normalised: the rotation by
    2 atan(|omega| dt / 2) is exact within 0.4 degrees at 3 rad/s and 150 ms.
    """
    return normalize(q + rate * dt)


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the angle [...] rad between the rotations ``a`` and ``b``, quaternions [..., 4].

    Computed from the chord between the quaternions. With the arccosine of their dot product, the rounding of
    single-precision states would become 0.04 degrees, and the sum over a chain of bodies would cause needless messages.
    """
    same = a - b
    opposite = a + b
    chord = np.minimum(np.einsum("...i,...i->...", same, same), np.einsum("...i,...i->...", opposite, opposite))
    return 4.0 * np.arcsin(np.minimum(0.5 * np.sqrt(chord), 1.0))


def needs_update(
    position_error: np.ndarray, angle_error: np.ndarray, silence: np.ndarray, tolerance: float = 1.0
) -> np.ndarray:
    """Returns which of ``k`` objects need to be published: [k] bool.

    The state of an object needs to be published if its copies on other clients are wrong by more than ``tolerance``
    times 5 mm or 1 degree, or if its last state was sent a :data:`HEARTBEAT_PERIOD` ago. ``position_error`` [k] m,
    ``angle_error`` [k] rad: errors of the copies. ``silence`` [k] s: time since the last state.
    """
    wrong = (position_error > tolerance * POSITION_ERROR) | (angle_error > tolerance * ANGLE_ERROR)
    return wrong | (silence >= HEARTBEAT_PERIOD - 1e-9)


def blend_weight(age: float | np.ndarray) -> float | np.ndarray:
    """Returns the share of a correction that is not shown yet ``age`` [s] after it: 1 at first, 5 % after 100 ms.

    The share decays exponentially. So blending may restart with every new pose, every 17 ms.
    """
    return np.exp(-3.0 * np.maximum(age, 0.0) / BLEND_TIME)
