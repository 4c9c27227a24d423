"""Quantisation of rotations on the wire: rotation vectors, and "smallest three" quaternions in 32 bits.

Quaternions are xyzw as in :mod:`vinesim.core.frames`. Two conversions of that module are repeated here without checks,
because they run for every moving joint in every step, and because their exact results are part of the wire format.

Source of "smallest three": G. Fiedler, Snapshot Compression, Gaffer on Games 2015.
"""

from __future__ import annotations

import numpy as np

from vinesim.net.codec.header import MessageError

TURN_LSB = np.pi / 32767.0
"""Quantisation step of a component of a rotation vector [rad]: i16 for -pi to pi, error 0.003 degrees."""

_MAX_ANGLE_SQUARED = (np.pi + 2.0 * TURN_LSB) ** 2
"""Largest squared length of a rotation vector [rad^2]: half a turn and two quantisation steps for rounding."""

_COMPONENT_STEPS = 1023.0 / np.sqrt(2.0)
"""Quantisation steps per unit of the three smallest components of a quaternion: 10 bits for -1/sqrt(2) to 1/sqrt(2)."""


def rotation_vector(q: np.ndarray) -> np.ndarray:
    """Convert unit quaternions [..., 4] to rotation vectors [..., 3] rad of at most half a turn."""
    v = q[..., :3]
    w = q[..., 3]
    sine = np.maximum(np.sqrt(np.einsum("...i,...i->...", v, v)), 1e-12)
    return v * np.copysign(2.0 * np.arctan2(sine, np.abs(w)) / sine, w)[..., None]


def quaternion(v: np.ndarray) -> np.ndarray:
    """Convert rotation vectors [..., 3] rad to unit quaternions [..., 4]."""
    half = np.maximum(0.5 * np.sqrt(np.einsum("...i,...i->...", v, v)), 1e-12)
    q = np.empty((*v.shape[:-1], 4), v.dtype)
    np.multiply(v, (0.5 * np.sin(half) / half)[..., None], out=q[..., :3])
    np.cos(half, out=q[..., 3])
    return q


def check_rotation_vectors(turn: np.ndarray, name: str) -> np.ndarray:
    """Return the rotation vectors ``turn`` [..., 3] rad. Raises :class:`MessageError` if one exceeds half a turn.

    So every rotation has exactly one encoding. ``name``: what to call the message in the error.
    """
    if turn.size and np.einsum("...i,...i->...", turn, turn).max() > _MAX_ANGLE_SQUARED:
        raise MessageError(f"{name} with a rotation of more than half a turn")
    return turn


def pack_quaternions(q: np.ndarray) -> np.ndarray:
    """Encode unit quaternions [k, 4] as u32 [k]: 2 bits for the index of the largest component, 10 for each other one.

    Error: 0.28 degrees.
    """
    rows = np.arange(len(q))
    largest = np.argmax(np.abs(q), axis=1)
    signed = q * np.copysign(1.0, q[rows, largest])[:, None]
    three = signed[rows[:, None], (largest[:, None] + [1, 2, 3]) % 4]
    steps = np.clip(np.rint(three * _COMPONENT_STEPS) + 511.0, 0.0, 1022.0).astype(np.uint32)
    return (largest.astype(np.uint32) << 30) | (steps[:, 0] << 20) | (steps[:, 1] << 10) | steps[:, 2]


def unpack_quaternions(bits: np.ndarray) -> np.ndarray:
    """Decode ``bits`` [k] u32 of :func:`pack_quaternions` to unit quaternions [k, 4].

    Raises :class:`MessageError` if the three smallest components are too large for a unit quaternion.
    """
    largest = (bits >> 30).astype(np.int64)
    three = (np.stack([bits >> 20, bits >> 10, bits], -1) & 1023).astype(float) - 511.0
    three /= _COMPONENT_STEPS
    rest = 1.0 - (three * three).sum(1)
    if (rest < 0.2).any():
        raise MessageError("an object with an impossible rotation")
    q = np.empty((len(bits), 4))
    rows = np.arange(len(bits))
    q[rows, largest] = np.sqrt(rest)
    q[rows[:, None], (largest[:, None] + [1, 2, 3]) % 4] = three
    return q
