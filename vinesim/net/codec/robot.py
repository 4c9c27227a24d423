"""Wire format of a robot's pose: base pose and twist, joint positions and velocities.

Base: position 3 f4 [m], rotation vector 3 i2, linear and angular velocity 6 i2; scale of the joint velocities u2;
pattern and colour of the lights 4 u1. Then all joint positions as i2, all joint velocities as i1 in steps of the scale,
and an f4 for each joint position that is too large for an i2.
"""

from __future__ import annotations

import math
import struct

import numpy as np

from vinesim.net.codec.header import HEADER, MessageError, pack_header, unpack_header
from vinesim.net.codec.rotation import TURN_LSB, check_rotation_vectors, quaternion
from vinesim.scene.robot_limits import MAX_JOINTS
from vinesim.scene.values import LightPattern, Lights, RobotUpdate

ROBOT = 1
"""Number of the kind of message with a robot's pose, the fourth byte of the message."""

JOINT_RATE_LSB = 1e-5
"""Quantisation step of the scale of a message's joint velocities [rad/s, m/s]. With the largest scale, velocities up to
83 rad/s or m/s can be encoded."""

JOINT_POSITION_LSB = 2e-4
"""Quantisation step of a joint position [rad, m]."""

BASE_VELOCITY_LSB = 1e-3
"""Quantisation step of base velocities [m/s, rad/s]. Velocities are clipped at 32.7."""

_BASE = struct.Struct("<3f3h6hH4B")  # position, turn, velocity, scale of joint velocities, lights; then joints

_PATTERNS = frozenset(map(int, LightPattern))

_SOUND = 128
"""Flag that is added to the pattern of lights if the lights have a sound."""

_OUT_OF_RANGE = -32768
"""Value in place of a joint position that is too large for an i2. The position follows as f4."""


def _to_lsb(values: list[float], unit: float) -> list[int]:
    """Returns values as whole numbers of quantisation steps of size ``unit``, clipped to i16."""
    return [min(max(round(value / unit), -32767), 32767) for value in values]


def encode_robot(update: RobotUpdate) -> bytes:
    """Encode a robot's pose in 50 bytes, 3 for each joint and 4 more for each joint beyond 6.5 rad or m (a wheel).

    Errors: joint positions 0.1 mrad or mm, joint velocities 0.4 % of the fastest joint. Base velocities are clipped at
    32.7 m/s or rad/s, joint velocities at 83. Raises :class:`MessageError` for wrong sizes, values that are not finite
    or beyond 1e9, and a quaternion that is not of unit length.
    """
    pose = update.base_q.tolist()
    twist = update.base_qd.tolist()
    position = np.asarray(update.position, float)
    velocity = np.asarray(update.velocity, float)
    count = len(position)
    if count > MAX_JOINTS or len(velocity) != count or len(pose) != 7 or len(twist) != 6:
        raise MessageError(
            f"{update.actor!r}: pose of {len(pose)} numbers (7), velocity of {len(twist)} (6), {count} joint positions "
            f"and {len(velocity)} velocities (equal, at most {MAX_JOINTS})"
        )
    distance = np.abs(position)
    speed = np.abs(velocity)
    if not (all(-1e9 < number < 1e9 for number in (*pose, *twist)) and (distance < 1e9).all() and (speed < 1e9).all()):
        raise MessageError(f"state of {update.actor!r} has a number that is not finite or beyond 1e9")
    x, y, z, w = pose[3:]
    sine = math.hypot(x, y, z)
    if not 0.95 < math.hypot(sine, w) < 1.05:
        raise MessageError(f"orientation {pose[3:]} of {update.actor!r} is no unit quaternion")
    factor = math.copysign(2.0 * math.atan2(sine, abs(w)) / sine, w) if sine > 1e-12 else 0.0
    near = distance < JOINT_POSITION_LSB * 32767.5
    steps = np.where(near, np.rint(position / JOINT_POSITION_LSB), _OUT_OF_RANGE)
    scale = min(math.ceil(float(speed.max(initial=0.0)) / (127.0 * JOINT_RATE_LSB)), 65535)
    unit = max(scale, 1) * JOINT_RATE_LSB
    rates = np.minimum(np.maximum(np.rint(velocity / unit), -127.0), 127.0)
    lights = (int(update.lights.pattern) + _SOUND * update.lights.has_sound, *update.lights.color)
    if not all(0 <= number <= 255 for number in lights):
        raise MessageError(f"lights {lights} of {update.actor!r}: each of four numbers must be 0 to 255")
    turn = _to_lsb([x * factor, y * factor, z * factor], TURN_LSB)
    return b"".join(
        (
            pack_header(ROBOT, count, update.time),
            _BASE.pack(*pose[:3], *turn, *_to_lsb(twist, BASE_VELOCITY_LSB), scale, *lights),
            steps.astype("<i2").tobytes(),
            rates.astype("i1").tobytes(),
            position[~near].astype("<f4").tobytes(),
        )
    )


def decode_robot(payload: bytes, actor: str) -> RobotUpdate:
    """Decode a robot's pose. ``actor``: name of the robot, which the key states.

    Raises :class:`MessageError` if the message is invalid.
    """
    count, time = unpack_header(payload, ROBOT, "actor pose")
    joints = HEADER.size + _BASE.size
    rest = len(payload) - joints - 3 * count
    if count > MAX_JOINTS or rest < 0:
        raise MessageError(f"actor pose with {count} joints (at most {MAX_JOINTS}) in {len(payload)} B")
    steps = np.frombuffer(payload, "<i2", count, joints)
    apart = steps == _OUT_OF_RANGE
    if rest != 4 * np.count_nonzero(apart):
        raise MessageError(f"actor pose with {np.count_nonzero(apart)} wide joints and {rest} B for them")
    base = _BASE.unpack_from(payload, HEADER.size)
    position = steps * JOINT_POSITION_LSB
    position[apart] = np.frombuffer(payload, "<f4", rest // 4, joints + 3 * count)
    if not (all(-1e9 < number < 1e9 for number in base[:3]) and (np.abs(position) < 1e9).all()):
        raise MessageError("actor pose with a number that is not finite or beyond 1e9")
    if base[13] % _SOUND not in _PATTERNS:
        raise MessageError(f"actor pose with lights of an unknown pattern, {base[13]}")
    turn = check_rotation_vectors(np.array(base[3:6]) * TURN_LSB, "actor pose")
    velocity = np.frombuffer(payload, "i1", count, joints + 2 * count) * (base[12] * JOINT_RATE_LSB)
    return RobotUpdate(
        actor,
        time,
        np.concatenate([base[:3], quaternion(turn)]),
        np.array(base[6:12]) * BASE_VELOCITY_LSB,
        position,
        velocity,
        Lights(LightPattern(base[13] % _SOUND), base[14:17], base[13] >= _SOUND),
    )
