"""Poses, rotations and axes: one convention for the whole package.

* World: REP-103, x forward (east), y left (north), z up; metres, radians, seconds.
* Quaternions are ``(x, y, z, w)``, unit, rotating body coordinates into parent coordinates (ROS, Warp, Newton).
  Only MuJoCo uses ``(w, x, y, z)``; :func:`to_wxyz` and :func:`from_wxyz` convert.
* A pose is seven numbers, position then quaternion: ``body_q[i] = (x, y, z, qx, qy, qz, qw)`` (``wp.transform``).
* A velocity is six numbers, linear velocity of the body's origin then angular velocity, both in world axes.
* Optical frames (REP-103 suffix ``_optical``): z forward, x right, y down.

All functions broadcast over leading axes and compute in the type they are given.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from vinesim.core.numbers import as_numbers

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
"""The unit quaternion, xyzw."""

OPTICAL = np.array([-0.5, 0.5, -0.5, 0.5])
"""Rotation of an optical frame relative to its camera link (x forward), xyzw."""

# taking by an array of indices is four times as fast as by a list
_NEXT = np.array([1, 2, 0])
_LAST = np.array([2, 0, 1])
_W_FIRST = np.array([3, 0, 1, 2])
_W_LAST = np.array([1, 2, 3, 0])


_MANY = 512
"""Number of array elements above which functions of this module compute component by component, which is then faster.
"""


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the cross product of vectors [..., 3], ten times as fast as ``np.cross``."""
    if a.size + b.size > _MANY:
        result = np.empty(np.broadcast_shapes(a.shape, b.shape), np.result_type(a, b))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            np.subtract(a[..., j] * b[..., k], a[..., k] * b[..., j], out=result[..., i])
        return result
    return a.take(_NEXT, -1) * b.take(_LAST, -1) - a.take(_LAST, -1) * b.take(_NEXT, -1)


def to_wxyz(q: np.ndarray) -> np.ndarray:
    """Converts quaternions [..., 4] from xyzw to MuJoCo's wxyz."""
    return np.asarray(q).take(_W_FIRST, -1)


def from_wxyz(q: np.ndarray) -> np.ndarray:
    """Converts quaternions [..., 4] from MuJoCo's wxyz to xyzw."""
    return np.asarray(q).take(_W_LAST, -1)


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the quaternion product ``a b`` [..., 4]: the rotation by ``b`` followed by the rotation by ``a``."""
    a = np.asarray(a)
    b = np.asarray(b)
    av = a[..., :3]
    aw = a[..., 3:]
    bv = b[..., :3]
    bw = b[..., 3:]
    vector = aw * bv + bw * av + cross(av, bv)
    scalar = aw * bw - (av * bv).sum(-1, keepdims=True)
    return np.concatenate([vector, scalar], axis=-1)


def conjugate(q: np.ndarray) -> np.ndarray:
    """Returns the inverse of unit quaternions [..., 4]."""
    q = np.asarray(q)
    return np.concatenate([-q[..., :3], q[..., 3:]], axis=-1)


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Returns the vectors ``v`` [..., 3] rotated by ``q`` [..., 4]."""
    q = np.asarray(q)
    v = np.asarray(v)
    t = 2.0 * cross(q[..., :3], v)
    return v + q[..., 3:] * t + cross(q[..., :3], t)


def _length(v: np.ndarray) -> np.ndarray:
    """Returns the Euclidean norm [..., 1] of vectors [..., n]; faster than NumPy's for many short vectors."""
    if v.size <= _MANY or v.shape[-1] not in (3, 4) or v.dtype.kind != "f":
        return np.linalg.norm(v, axis=-1, keepdims=True)
    total = v[..., 0] * v[..., 0]
    for i in range(1, v.shape[-1]):  # in NumPy's order of summation, so that the bits agree
        total += v[..., i] * v[..., i]
    return np.sqrt(total)[..., None]


def normalize(q: np.ndarray) -> np.ndarray:
    """Returns quaternions or vectors [..., n] divided by their norms; zero stays zero."""
    q = np.asarray(q)
    length = _length(q)
    return q / np.where(length > 0.0, length, 1.0)


def exp(v: np.ndarray) -> np.ndarray:
    """Returns the quaternion [..., 4] of a rotation vector [..., 3] rad."""
    v = np.asarray(v, dtype=np.result_type(v, np.float32))
    angle = _length(v)
    scale = np.where(angle > 1e-6, np.sin(0.5 * angle) / np.where(angle > 1e-6, angle, 1.0), 0.5)
    return np.concatenate([v * scale, np.cos(0.5 * angle)], axis=-1)


def log(q: np.ndarray) -> np.ndarray:
    """Returns the shortest rotation vector [..., 3] rad of a quaternion [..., 4]."""
    q = np.asarray(q)
    q = np.where(q[..., 3:] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., 3:])
    return q[..., :3] * np.where(sine > 1e-9, angle / np.where(sine > 1e-9, sine, 1.0), 2.0)


def to_matrix(q: np.ndarray) -> np.ndarray:
    """Returns the rotation matrices [..., 3, 3] of quaternions [..., 4]."""
    q = np.asarray(q)
    return np.swapaxes(rotate(q[..., None, :], np.eye(3, dtype=q.dtype)), -1, -2)


def from_matrix(r: np.ndarray) -> np.ndarray:
    """Returns the quaternions [..., 4] of rotation matrices [..., 3, 3]. Their largest component is positive."""
    r = np.asarray(r, float)
    xx, yy, zz = (r[..., i, i] for i in range(3))
    rows = np.empty((*r.shape[:-2], 4, 4))
    rows[..., 0, 0], rows[..., 1, 1] = 1 + xx - yy - zz, 1 - xx + yy - zz
    rows[..., 2, 2], rows[..., 3, 3] = 1 - xx - yy + zz, 1 + xx + yy + zz
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        rows[..., i, j] = rows[..., j, i] = r[..., j, i] + r[..., i, j]
        rows[..., k, 3] = rows[..., 3, k] = r[..., j, i] - r[..., i, j]
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), -1)
    return normalize(np.take_along_axis(rows, best[..., None, None], -2)[..., 0, :])


def from_yaw(angle: float | np.ndarray) -> np.ndarray:
    """Returns the quaternion [..., 4] of a rotation about z by ``angle`` [...] rad, counter-clockwise seen from
    above."""
    half = 0.5 * np.asarray(angle, float)
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], -1)


def to_yaw(q: np.ndarray) -> float:
    """Returns the yaw angle [rad] of a rotation [4]: the direction of its x axis seen from above. Inverse of
    :func:`from_yaw`."""
    x, y, z, w = q
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def from_x_axis(x: np.ndarray, up: np.ndarray = np.array([0.0, 0.0, 1.0])) -> np.ndarray:
    """Returns the quaternion [..., 4] of a frame with its x axis along ``x`` [..., 3] and its z axis as close to ``up``
    as possible.

    Where ``x`` and ``up`` are parallel, the z axis leans towards world y.
    """
    ex = normalize(np.asarray(x, float))
    side = cross(np.broadcast_to(up, ex.shape), ex)
    degenerate = _length(side) < 1e-6
    side = np.where(degenerate, cross(np.broadcast_to([0.0, 1.0, 0.0], ex.shape), ex), side)
    ey = normalize(side)
    return from_matrix(np.stack([ex, ey, cross(ex, ey)], -1))


def pose(position: npt.ArrayLike, quaternion: npt.ArrayLike = IDENTITY) -> np.ndarray:
    """Returns the pose [..., 7] with a position [..., 3] m and a quaternion [..., 4]."""
    x = np.asarray(position, float)
    q = np.asarray(quaternion, float)
    lead = np.broadcast_shapes(x.shape[:-1], q.shape[:-1])
    return np.concatenate([np.broadcast_to(x, (*lead, 3)), np.broadcast_to(q, (*lead, 4))], -1)


def checked_pose(what: str, given: npt.ArrayLike, error: type[ValueError] = ValueError) -> np.ndarray:
    """Returns the pose ``given`` [7] as an array of floats. Raises ``error``, with a message that names ``what``,
    unless all numbers are finite and the quaternion has length 1."""
    values = as_numbers(given)
    if values.shape != (7,) or not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1.0) > 1e-3:
        raise error(
            f"{what} is {values.tolist() if values.ndim else given}; give position [m] and unit quaternion "
            "(x, y, z, w), 7 finite numbers"
        )
    return values


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns the product of poses [..., 7]. ``b`` is a pose in the frame ``a``; the result is the same pose in the
    parent frame of ``a``."""
    a = np.asarray(a)
    b = np.asarray(b)
    return np.concatenate([a[..., :3] + rotate(a[..., 3:], b[..., :3]), multiply(a[..., 3:], b[..., 3:])], axis=-1)


def inverse(p: np.ndarray) -> np.ndarray:
    """Returns the inverse of a pose [..., 7]: the pose of the parent frame, expressed in the frame ``p``."""
    back = conjugate(np.asarray(p)[..., 3:])
    return np.concatenate([-rotate(back, np.asarray(p)[..., :3]), back], axis=-1)
