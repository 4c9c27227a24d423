"""Wire format of a person's pose, and encoding of any actor's pose.

A person's pose consists of the root, the tracked points (head, two hands; CANOPIES D6.4, section 5.3), hips and feet,
the flexion of ten fingers, six flags, the intention, and the velocities of all points: always 162 bytes. All positions
but the root's are relative to the root, in steps of 0.2 mm, up to 6.5 m. Rotations are rotation vectors of 3 i16.
Velocities are i8, in steps of two scales that the message states: one for linear, one for angular velocities.
"""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np

from vinesim.net.codec import robot
from vinesim.net.codec.header import (
    HEADER,
    MAX_COORDINATE,
    MessageError,
    kind_of,
    pack_header,
    unpack_header,
)
from vinesim.net.codec.json_values import COUNT, NUMBER, POSE, TEXT, list_of, object_of, pose_value
from vinesim.net.codec.rotation import TURN_LSB, quaternion, rotation_vector
from vinesim.scene.values import INTENTIONS, POINT_NAMES, HumanPose, HumanUpdate, RobotUpdate

HUMAN = 6
"""Number of the kind of message with a person's pose, the fourth byte of the message."""

POSITION_LSB = 2e-4
"""Quantisation step of a position relative to the root [m]. Positions are clipped at 6.5 m."""

VELOCITY_LSB = 1e-5
"""Quantisation step of the scales of linear and angular velocity [m/s, rad/s]. Velocities are clipped at 83."""

FINGER_SCALE = 255.0
"""Number of quantisation steps from a straight finger (0) to a fully bent one (1)."""

MAX_REACH = 2.5
"""Largest distance of head, hands and feet from the hips [m]. A person of 2.2 m reaches 1.5 m. GUESSED."""

MAX_SPEED = 40.0
"""Largest speed of a point of a person [m/s]. The hand of a person that throws reaches 25 m/s. GUESSED."""

_POINTS = len(POINT_NAMES)
_HIPS = POINT_NAMES.index("hips")
_BODY = slice(1, None)

_HUMAN = struct.Struct(f"<3f{6 * _POINTS - 3}h2H{6 * _POINTS}bB10BB")

_FLAGS = ("left_closed", "right_closed", "left_busy", "right_busy", "left_shears", "right_shears")


def encode_pose(update: RobotUpdate | HumanUpdate) -> bytes:
    """Encode the pose of a robot, a person or a spectator. Inverse of :func:`decode_pose`."""
    return encode_human(update) if isinstance(update, HumanUpdate) else robot.encode_robot(update)


def decode_pose(payload: bytes, actor: str) -> RobotUpdate | HumanUpdate:
    """Decode the pose of a robot, a person or a spectator. ``actor``: name of the actor, which the key states."""
    human = kind_of(payload) == HUMAN
    return decode_human(payload, actor) if human else robot.decode_robot(payload, actor)


POSE_FIELDS = {
    "frame_id": TEXT,
    "pose": POSE,
    "velocity": list_of(NUMBER, "of its base: m/s, rad/s, world axes"),
    "joint_position": list_of(NUMBER, "rad or m"),
    "joint_velocity": list_of(NUMBER, "rad/s or m/s"),
    "points": object_of("points", "of a person", **dict.fromkeys(POINT_NAMES, POSE)),
    "intention": TEXT,
    "lights": object_of("lights", "of a robot, sRGB 0 to 255", pattern=TEXT, color=list_of(COUNT)),
}
"""JSON schema of what :func:`describe_pose` returns."""


def describe_pose(payload: bytes, _: str) -> dict[str, Any]:
    """Decode the pose of any actor for the JSON of a recording."""
    update = decode_pose(payload, "")
    here = {"frame_id": "map", "pose": pose_value(update.base_q)}
    if isinstance(update, HumanUpdate):
        points = {name: pose_value(at) for name, at in zip(POINT_NAMES, update.pose.points, strict=True)}
        return here | {"points": points, "intention": update.intention}
    return here | {
        "velocity": update.base_qd.tolist(),
        "joint_position": update.position.tolist(),
        "joint_velocity": update.velocity.tolist(),
        "lights": {"pattern": update.lights.pattern.name.lower(), "color": list(update.lights.color)},
    }


def encode_human(update: HumanUpdate) -> bytes:
    """Encode a person's pose. Raises :class:`MessageError` for wrong shapes, values that are not finite, quaternions
    that are not of unit length, and an unknown intention."""
    points = update.pose.points
    velocity = np.asarray(update.velocity, float)
    fingers = (*update.pose.left_fingers, *update.pose.right_fingers)
    if velocity.shape != (_POINTS, 6) or len(fingers) != 10:
        raise MessageError(
            f"{update.actor!r}: velocity of shape {velocity.shape} ({_POINTS}, 6), {len(fingers)} fingers"
        )
    if not (np.isfinite(points).all() and np.isfinite(velocity).all() and all(map(math.isfinite, fingers))):
        raise MessageError(f"pose of {update.actor!r} has a number that is not finite")
    if not np.allclose(np.linalg.norm(points[:, 3:], axis=1), 1.0, atol=0.05):
        raise MessageError(f"pose of {update.actor!r} has an orientation that is no unit quaternion")
    root = points[0, :3].astype(np.float32)
    places = _to_integers((points[1:, :3] - root) / POSITION_LSB, 32767)
    turns = _to_integers(rotation_vector(points[:, 3:]) / TURN_LSB, 32767)
    kinds = velocity.reshape(_POINTS, 2, 3)
    scales = np.minimum(np.ceil(np.abs(kinds).max(axis=(0, 2)) / (127.0 * VELOCITY_LSB)), 65535.0)
    speeds = _to_integers(kinds / np.maximum(scales * VELOCITY_LSB, VELOCITY_LSB)[:, None], 127)
    if update.intention not in INTENTIONS:
        raise MessageError(
            f"intention {update.intention!r} of {update.actor!r}; give one of {', '.join(INTENTIONS[1:])}"
        )
    flags = sum(bool(getattr(update.pose, name)) << bit for bit, name in enumerate(_FLAGS))
    bends = (round(FINGER_SCALE * min(max(bend, 0.0), 1.0)) for bend in fingers)
    return pack_header(HUMAN, _POINTS, update.time) + _HUMAN.pack(
        *root.tolist(),
        *places,
        *turns,
        *scales.astype(int).tolist(),
        *speeds,
        flags,
        *bends,
        INTENTIONS.index(update.intention),
    )


def decode_human(payload: bytes, actor: str) -> HumanUpdate:
    """Decode the pose of the person ``actor``. Raises :class:`MessageError` if the message is invalid."""
    count, time = unpack_header(payload, HUMAN, "human pose")
    if count != _POINTS or len(payload) != HEADER.size + _HUMAN.size:
        raise MessageError(
            f"human pose of {count} points ({_POINTS}) in {len(payload)} B ({HEADER.size + _HUMAN.size})"
        )
    fields = _HUMAN.unpack_from(payload, HEADER.size)
    root = np.array(fields[:3])
    fields = fields[3:]
    if not (np.abs(root) < MAX_COORDINATE).all():
        raise MessageError(f"human pose with a root at {root}, not finite or too far away")
    places = fields[: 3 * _POINTS - 3]
    turns = fields[3 * _POINTS - 3 : 6 * _POINTS - 3]
    scales = fields[6 * _POINTS - 3 :]
    turn = np.array(turns, float).reshape(_POINTS, 3) * TURN_LSB
    if (turn * turn).sum(1).max() > (np.pi + 2.0 * TURN_LSB) ** 2:
        raise MessageError("human pose with a rotation of more than half a turn")
    points = np.empty((_POINTS, 7))
    points[0, :3], points[1:, :3] = root, root + POSITION_LSB * np.array(places, float).reshape(-1, 3)
    points[:, 3:] = quaternion(turn)
    speeds = np.array(scales[2 : 2 + 6 * _POINTS], float)
    rest = scales[2 + 6 * _POINTS :]
    velocity = speeds.reshape(_POINTS, 2, 3) * (VELOCITY_LSB * np.array(scales[:2], float))[:, None]
    if np.linalg.norm(points[_BODY, :3] - points[_HIPS, :3], axis=1).max() > MAX_REACH:
        raise MessageError(f"human pose with a point more than {MAX_REACH} m from the hips")
    if np.linalg.norm(velocity[:, 0], axis=1).max() > MAX_SPEED:
        raise MessageError(f"human pose with a point faster than {MAX_SPEED} m/s")
    flags = rest[0]
    bends = [bend / FINGER_SCALE for bend in rest[1:11]]
    if rest[11] >= len(INTENTIONS):
        raise MessageError(f"human pose with an unknown intention, {rest[11]}")
    if flags >= 1 << len(_FLAGS):
        raise MessageError("human pose with unknown flags")
    left_closed, right_closed, left_busy, right_busy, left_shears, right_shears = (
        bool(flags >> bit & 1) for bit in range(len(_FLAGS))
    )
    pose = HumanPose(
        *points,
        left_closed=left_closed,
        right_closed=right_closed,
        left_busy=left_busy,
        right_busy=right_busy,
        left_fingers=tuple(bends[:5]),
        right_fingers=tuple(bends[5:]),
        left_shears=left_shears,
        right_shears=right_shears,
    )
    return HumanUpdate(actor, time, pose, velocity.reshape(_POINTS, 6), INTENTIONS[rest[11]])


def quantise_pose(pose: HumanPose) -> HumanPose:
    """Returns a pose as all receivers decode it, bit by bit. Errors: positions 0.1 mm, rotations 0.003 degrees."""
    return decode_human(encode_human(HumanUpdate("", 0.0, pose, np.zeros((_POINTS, 6)))), "").pose


def _to_integers(values: np.ndarray, limit: int) -> list[int]:
    """Round values, clip them to -``limit`` to ``limit``, and return them as a flat list."""
    return np.clip(np.rint(values), -limit, limit).astype(int).ravel().tolist()
