"""Poses of people, and the wrenches that hands give to robots, byte by byte; and poses of whoever it may be.

Of a person cross the network: the root, the three inputs (head, two hands), hips and feet (CANOPIES D6.4, section 5.3),
how the fingers are bent, and how fast all that moves. All but the root is told from the root: positions in steps of
0.2 mm, up to 6.5 m away. Velocities are i8 of the message's own scales. 161 bytes, whatever the person does.
"""

from __future__ import annotations

import dataclasses
import math
import struct

import numpy as np

from vinesim.net.codec import messages
from vinesim.net.codec.messages import FORCE, HUMAN, MAX_COORDINATE, TURN_LSB, MessageError, quaternion, rotation_vector
from vinesim.scene.values import POINT_NAMES, HumanPose, HumanUpdate, RobotUpdate

POSITION_LSB = 2e-4
"""Unit of a point's place from the root [m]; what is farther than 6.5 m is clipped."""

VELOCITY_LSB = 1e-5
"""Unit of a message's scales of velocity [m/s, rad/s]: 83 at most, faster ones are clipped."""

FINGER_SCALE = 255.0
"""Steps of a finger from straight to bent all the way."""

MAX_WRENCH = 2000.0
"""No wrench is greater [N, N m]: it is refused."""

MAX_LINKS = 64
"""Links of one robot that one person may push at once."""

_POINTS = len(POINT_NAMES)
_HUMAN = struct.Struct(f"<3f{6 * _POINTS - 3}h2H{6 * _POINTS}bB10B")
_FLAGS = ("left_closed", "right_closed", "left_busy", "right_busy")
_WRENCH = struct.Struct("<6f")


def encode_pose(update: RobotUpdate | HumanUpdate) -> bytes:
    """An actor's pose, as :func:`decode_pose` reads it."""
    return encode_human(update) if isinstance(update, HumanUpdate) else messages.encode_robot(update)


def decode_pose(payload: bytes, actor: str) -> RobotUpdate | HumanUpdate:
    """The pose that ``actor`` (known from the key, never from the payload) sent."""
    human = messages.kind_of(payload) == HUMAN
    return decode_human(payload, actor) if human else messages.decode_robot(payload, actor)


# ---------------------------------------------------------------- people


def encode_human(update: HumanUpdate) -> bytes:
    """A person's pose."""
    points, velocity = update.pose.points, np.asarray(update.velocity, float)
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
    places = _whole((points[1:, :3] - root) / POSITION_LSB, 32767)
    turns = _whole(rotation_vector(points[:, 3:]) / TURN_LSB, 32767)
    kinds = velocity.reshape(_POINTS, 2, 3)
    scales = np.minimum(np.ceil(np.abs(kinds).max(axis=(0, 2)) / (127.0 * VELOCITY_LSB)), 65535.0)
    speeds = _whole(kinds / np.maximum(scales * VELOCITY_LSB, VELOCITY_LSB)[:, None], 127)
    flags = sum(bool(getattr(update.pose, name)) << bit for bit, name in enumerate(_FLAGS))
    bends = (round(FINGER_SCALE * min(max(bend, 0.0), 1.0)) for bend in fingers)
    return messages.head(HUMAN, _POINTS, update.time) + _HUMAN.pack(
        *root.tolist(), *places, *turns, *scales.astype(int).tolist(), *speeds, flags, *bends
    )


def decode_human(payload: bytes, actor: str) -> HumanUpdate:
    """The pose that a person sent."""
    count, time = messages.opened(payload, HUMAN, "human pose")
    if count != _POINTS or len(payload) != messages.HEAD + _HUMAN.size:
        raise MessageError(
            f"human pose of {count} points ({_POINTS}) in {len(payload)} B ({messages.HEAD + _HUMAN.size})"
        )
    told = _HUMAN.unpack_from(payload, messages.HEAD)
    root, told = np.array(told[:3]), told[3:]
    if not (np.abs(root) < MAX_COORDINATE).all():
        raise MessageError(f"human pose with a root at {root}, not finite or too far away")
    places, turns, scales = told[: 3 * _POINTS - 3], told[3 * _POINTS - 3 : 6 * _POINTS - 3], told[6 * _POINTS - 3 :]
    turn = np.array(turns, float).reshape(_POINTS, 3) * TURN_LSB
    if (turn * turn).sum(1).max() > (np.pi + 2.0 * TURN_LSB) ** 2:
        raise MessageError("human pose with a rotation of more than half a turn")
    points = np.empty((_POINTS, 7))
    points[0, :3], points[1:, :3] = root, root + POSITION_LSB * np.array(places, float).reshape(-1, 3)
    points[:, 3:] = quaternion(turn)
    speeds, rest = np.array(scales[2 : 2 + 6 * _POINTS], float), scales[2 + 6 * _POINTS :]
    velocity = speeds.reshape(_POINTS, 2, 3) * (VELOCITY_LSB * np.array(scales[:2], float))[:, None]
    flags, bends = rest[0], [bend / FINGER_SCALE for bend in rest[1:]]
    if flags >= 1 << len(_FLAGS):
        raise MessageError("human pose with unknown flags")
    pose = HumanPose(
        *points, left_fingers=tuple(bends[:5]), right_fingers=tuple(bends[5:]),
        **{name: bool(flags >> bit & 1) for bit, name in enumerate(_FLAGS)},
    )  # fmt: skip
    return HumanUpdate(actor, time, pose, velocity.reshape(_POINTS, 6))


def quantise_pose(pose: HumanPose) -> HumanPose:
    """A pose as every copy will hold it, to the bit: places off by at most 0.1 mm, turns by 0.003 degrees."""
    return decode_human(encode_human(HumanUpdate("", 0.0, pose, np.zeros((_POINTS, 6)))), "").pose


def _whole(values: np.ndarray, most: int) -> list[int]:
    return np.clip(np.rint(values), -most, most).astype(int).ravel().tolist()


# ---------------------------------------------------------------- forces


@dataclasses.dataclass(frozen=True, slots=True)
class WrenchMessage:
    """With what wrenches one person pushes links of one robot, mean of a sixtieth of a second."""

    time: float
    """Network time [s]."""
    wrenches: dict[str, np.ndarray]
    """Link: force [N] and moment about its centre of mass [N m], world axes [6]. Empty: the touch is over."""


def encode_wrenches(push: WrenchMessage) -> bytes:
    """A push: 14 bytes, and 25 and its name for each link."""
    if len(push.wrenches) > MAX_LINKS:
        raise MessageError(f"push on {len(push.wrenches)} links, at most {MAX_LINKS}")
    payload = [messages.head(FORCE, len(push.wrenches), push.time)]
    for link, wrench in sorted(push.wrenches.items()):
        name = link.encode()
        if len(name) > 255 or not (np.abs(wrench) <= MAX_WRENCH).all():
            raise MessageError(f"push on {link[:60]!r} with {wrench}: not finite, too strong, or too long a name")
        payload += [bytes((len(name),)), name, _WRENCH.pack(*wrench)]
    return b"".join(payload)


def decode_wrenches(payload: bytes) -> WrenchMessage:
    """A push, each number checked; which links there are is for the reader to know."""
    count, time = messages.opened(payload, FORCE, "push")
    if count > MAX_LINKS:
        raise MessageError(f"push on {count} links, at most {MAX_LINKS}")
    at, wrenches = messages.HEAD, {}
    for _ in range(count):
        end = at + 1 + (payload[at] if at < len(payload) else 0)
        if end + _WRENCH.size > len(payload):
            raise MessageError(f"push on {count} links is cut off at {len(payload)} B")
        wrench = np.array(_WRENCH.unpack_from(payload, end))
        if not (np.abs(wrench) <= MAX_WRENCH).all():
            raise MessageError(f"push with {wrench}: not finite or stronger than {MAX_WRENCH} N")
        try:
            wrenches[payload[at + 1 : end].decode()] = wrench
        except UnicodeDecodeError as error:
            raise MessageError(f"push on a link whose name is no text: {error}") from error
        at = end + _WRENCH.size
    if at != len(payload):
        raise MessageError(f"push of {len(payload)} B, {count} links take {at} B")
    return WrenchMessage(time, wrenches)
