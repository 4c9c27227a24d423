"""What crosses the network, byte by byte: encode, decode, and nothing unchecked in between.

Every message starts with four bytes: ``VS``, the protocol version, the kind. Poses and trees follow as packed
little-endian numpy records, rare things (greetings, claims) as msgpack. Whatever is malformed, truncated, of another
version, not finite or too large raises :class:`MessageError` in words, and nothing else.

Rotations travel as rotation vectors, three i16 of pi/32767 rad (error 0.003 degrees a component); joint rates of
a tree as i8 of that tree's own scale (error 0.4 % of its fastest joint). An owner that wants to agree with its copies
to the bit uses :func:`quantised` of what it sends.
"""

from __future__ import annotations

import dataclasses
import math
import struct
from typing import Any

import msgspec
import numpy as np

from vinesim.net import smooth
from vinesim.net.authority import Claim
from vinesim.world.values import RobotUpdate, TreeUpdate

PROTOCOL = 1
"""Version of everything in this file. Others are refused."""

MAGIC = b"VS"
ROBOT, TREES, CLAIMS, HELLO, TIME = 1, 2, 3, 16, 17
"""Kinds of message."""

SAMPLE = 1100
"""Samples on the live session stay below this [B], one datagram, as far as a single tree allows."""

LARGEST = 1 << 20
"""No message is larger [B]; it is refused unread."""

TURN = np.pi / 32767.0
"""Unit of a quantised rotation vector [rad]."""

RATE = 1e-5
"""Unit of a tree's scale of rates [rad/s]."""

VELOCITY = 1e-3
"""Unit of an actor's velocities [m/s, rad/s]: 32.7 at most, faster ones are clipped."""

TOUCHED, RESTING = 1, 2
"""Flags of a tree: its owner is in contact with it; it lies still and silence follows."""

MAX_JOINTS = 256
MAX_TREES = 4096
MAX_BODIES = 1 << 16

_HEAD = struct.Struct("<2sBBHd")  # magic, version, kind, count, time
_BASE = np.dtype([("position", "<f4", 3), ("turn", "<i2", 3), ("velocity", "<i2", 6)])
_JOINT = np.dtype([("position", "<f4"), ("velocity", "<i2")])
_TREE = np.dtype(
    [("tree", "<u4"), ("ownership", "<u2"), ("authority", "<u2"), ("flags", "u1"), ("bodies", "<u2"), ("scale", "<u2")]
)
_BODY = np.dtype([("turn", "<i2", 3), ("rate", "i1", 3)])
_FURTHEST_TURN = (np.pi + 2.0 * TURN) ** 2


class MessageError(ValueError):
    """A message that must not be believed; the text says why."""


class WrongVersion(MessageError):  # noqa: N818
    """A message of another protocol version; ``theirs`` is its number."""

    def __init__(self, theirs: int) -> None:
        super().__init__(f"message of protocol version {theirs}, this program speaks {PROTOCOL}: use the same release")
        self.theirs = theirs


class Hello(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How an actor introduces itself to those it meets."""

    name: str
    """The actor's name, unique in its world: 1 to 48 letters, digits, ``_``, ``-`` or ``.``."""
    kind: str = "robot"
    """``robot``, ``human`` or ``spectator``."""
    robot: str = ""
    """Name of the robot's description."""
    urdf: str = ""
    """Its URDF as text."""
    scene: str = ""
    """Name of the scene."""
    digest: str = ""
    """``Model.digest()`` of its vineyard."""
    protocol: int = PROTOCOL
    index: int = 0
    """Index of its label in label images."""
    joints: int = -1
    """How many joints its updates carry; -1 leaves it open until the first one."""


@dataclasses.dataclass(frozen=True, slots=True)
class Trees:
    """Records of several trees of one owner at one instant, as flat arrays. Tree ids strictly increase."""

    time: float
    """Network time [s]."""
    tree: np.ndarray
    """[k] ids"""
    ownership: np.ndarray
    """[k] u16 sequences"""
    authority: np.ndarray
    """[k] u16 sequences"""
    flags: np.ndarray
    """[k] sum of ``TOUCHED`` and ``RESTING``"""
    bodies: np.ndarray
    """[k] how many bodies each tree has; their joints follow each other below."""
    joint_q: np.ndarray
    """[sum of bodies, 4] xyzw"""
    joint_qd: np.ndarray
    """[sum of bodies, 3] rad/s"""

    def updates(self, owner: str) -> list[TreeUpdate]:
        """One value per tree; their arrays are views of this batch."""
        ends = np.cumsum(self.bodies).tolist()
        columns = (self.tree, self.ownership, self.authority, self.flags)
        rows = zip(*(column.tolist() for column in columns), [0, *ends[:-1]], ends, strict=True)
        return [
            TreeUpdate(
                tree, owner, ownership, authority, self.time, bool(flags & RESTING),
                self.joint_q[start:end], self.joint_qd[start:end],
            )
            for tree, ownership, authority, flags, start, end in rows
        ]  # fmt: skip


# ---------------------------------------------------------------- rotations


def rotation_vector(q: np.ndarray) -> np.ndarray:
    """Unit quaternions [..., 4] to rotation vectors [..., 3] rad, the short way round; lean, for the tick."""
    v, w = q[..., :3], q[..., 3]
    sine = np.sqrt(np.einsum("...i,...i->...", v, v))
    factor = 2.0 * np.arctan2(sine, np.abs(w)) / np.maximum(sine, 1e-12)
    factor = np.where(sine > 1e-9, factor, 2.0)
    return v * np.where(w < 0.0, -factor, factor)[..., None]


def quaternion(v: np.ndarray) -> np.ndarray:
    """Rotation vectors [..., 3] rad to unit quaternions [..., 4]; lean, for the tick."""
    half = 0.5 * np.sqrt(np.einsum("...i,...i->...", v, v))
    q = np.empty((*v.shape[:-1], 4), v.dtype)
    q[..., :3] = v * (0.5 * np.sinc(half / np.pi))[..., None]
    q[..., 3] = np.cos(half)
    return q


# ---------------------------------------------------------------- frame


def _head(kind: int, count: int, time: float) -> bytes:
    if not math.isfinite(time):
        raise MessageError(f"time {time} is not finite")
    return _HEAD.pack(MAGIC, PROTOCOL, kind, count, time)


def kind_of(payload: bytes) -> int:
    """Kind of a message after checking its size and its first four bytes."""
    if len(payload) > LARGEST:
        raise MessageError(f"message of {len(payload)} B, at most {LARGEST} B are read")
    if len(payload) < 4:
        raise MessageError(f"message of {len(payload)} B is cut off before its kind")
    if payload[:2] != MAGIC:
        raise MessageError(f"message starts with {payload[:2]!r} instead of {MAGIC!r}: not from vinesim")
    if payload[2] != PROTOCOL:
        raise WrongVersion(payload[2])
    return payload[3]


def _open(payload: bytes, kind: int, name: str) -> tuple[int, float]:
    """Count and time of a numpy message of the given kind."""
    if (found := kind_of(payload)) != kind:
        raise MessageError(f"message of kind {found} where {name} (kind {kind}) was expected")
    if len(payload) < _HEAD.size:
        raise MessageError(f"{name} of {len(payload)} B is cut off in its header")
    _, _, _, count, time = _HEAD.unpack_from(payload)
    if not math.isfinite(time):
        raise MessageError(f"{name} with time {time}")
    return count, time


def _pack(kind: int, value: Any) -> bytes:
    return MAGIC + bytes((PROTOCOL, kind)) + _encoder.encode(value)


def _unpack(payload: bytes, kind: int, name: str, decoder: msgspec.msgpack.Decoder) -> Any:
    if (found := kind_of(payload)) != kind:
        raise MessageError(f"message of kind {found} where {name} (kind {kind}) was expected")
    try:
        return decoder.decode(payload[4:])
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise MessageError(f"{name}: {error}") from error


_encoder = msgspec.msgpack.Encoder()
_hello_decoder = msgspec.msgpack.Decoder(Hello)
_claims_decoder = msgspec.msgpack.Decoder(list[tuple[int, int, int, str, bool]])
_time_decoder = msgspec.msgpack.Decoder(tuple[float, float])

# ---------------------------------------------------------------- actors


def _whole(value: np.ndarray, unit: float) -> np.ndarray:
    return np.clip(np.rint(value / unit), -32767, 32767)


def encode_robot(update: RobotUpdate) -> bytes:
    """An actor's pose: 44 bytes and 6 a joint. Velocities beyond 32.7 m/s or rad/s are clipped."""
    count = len(update.position)
    if count > MAX_JOINTS or len(update.velocity) != count:
        raise MessageError(
            f"{count} joint positions and {len(update.velocity)} velocities; equal, at most {MAX_JOINTS}"
        )
    numbers = np.concatenate([update.base_q, update.base_qd, update.position, update.velocity]).astype(np.float64)
    if len(numbers) != 13 + 2 * count or not np.isfinite(numbers).all() or np.abs(numbers).max() > 1e9:
        raise MessageError(f"state of {update.actor!r} is not 7 + 6 finite numbers and {count} finite joints")
    if not 0.9 < float(numbers[3:7] @ numbers[3:7]) < 1.1:
        raise MessageError(f"orientation {numbers[3:7].tolist()} of {update.actor!r} is no unit quaternion")
    base, joints = np.empty(1, _BASE), np.empty(count, _JOINT)
    base["position"] = numbers[:3]
    base["turn"] = _whole(rotation_vector(smooth.unit(numbers[3:7])), TURN)
    base["velocity"] = _whole(numbers[7:13], VELOCITY)
    joints["position"] = numbers[13 : 13 + count]
    joints["velocity"] = _whole(numbers[13 + count :], VELOCITY)
    return _head(ROBOT, count, update.time) + base.tobytes() + joints.tobytes()


def decode_robot(payload: bytes, actor: str) -> RobotUpdate:
    """The pose that ``actor`` (known from the key, never from the payload) sent."""
    count, time = _open(payload, ROBOT, "actor pose")
    expected = _HEAD.size + _BASE.itemsize + count * _JOINT.itemsize
    if count > MAX_JOINTS or len(payload) != expected:
        raise MessageError(
            f"actor pose with {count} joints (at most {MAX_JOINTS}) in {len(payload)} B, expected {expected} B"
        )
    base = np.frombuffer(payload, _BASE, 1, _HEAD.size)[0]
    joints = np.frombuffer(payload, _JOINT, count, _HEAD.size + _BASE.itemsize)
    where, position = base["position"].astype(np.float64), joints["position"].astype(np.float64)
    if not (np.isfinite(where).all() and np.isfinite(position).all()) or max(np.abs(where).max(), 0.0) > 1e9:
        raise MessageError("actor pose that is not finite")
    turn = _checked_turn(base["turn"] * TURN, "actor pose")
    return RobotUpdate(
        actor, time, np.concatenate([where, quaternion(turn)]), base["velocity"] * VELOCITY, position,
        joints["velocity"] * VELOCITY,
    )  # fmt: skip


def _checked_turn(turn: np.ndarray, name: str) -> np.ndarray:
    """Rotation vectors [..., 3] if none is longer than half a turn: each rotation has one way to be written."""
    if turn.size and np.einsum("...i,...i->...", turn, turn).max() > _FURTHEST_TURN:
        raise MessageError(f"{name} with a rotation of more than half a turn")
    return turn


# ---------------------------------------------------------------- trees


def _quantise(bodies: np.ndarray, joint_q: np.ndarray, joint_qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Body records [sum of bodies] and scales of rates [k] of the given joints."""
    if not (np.isfinite(joint_q).all() and np.isfinite(joint_qd).all()):
        raise MessageError("joint state of a tree is not finite")
    starts = np.cumsum(bodies) - bodies
    fastest = np.maximum.reduceat(np.abs(joint_qd).max(axis=1), starts)
    scale = np.minimum(np.ceil(fastest / (127.0 * RATE)), 65535.0).astype(np.uint16)
    step = np.repeat(np.maximum(scale, 1) * RATE, bodies)[:, None]
    records = np.empty(len(joint_q), _BODY)
    records["turn"] = np.rint(rotation_vector(joint_q) * (1.0 / TURN))
    records["rate"] = np.clip(np.rint(joint_qd / step), -127, 127)
    return records, scale


def _restore(bodies: np.ndarray, records: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joint rotations and rates of body records: the inverse of :func:`_quantise`."""
    step = np.repeat(scale * RATE, bodies)[:, None]
    return quaternion(_checked_turn(records["turn"] * TURN, "tree")), records["rate"] * step


def quantised(joint_q: np.ndarray, joint_qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """State of one tree ([n, 4], [n, 3] rad/s) as every copy will hold it, to the bit.

    Rotations are off by at most 0.005 degrees; rates by 0.4 % of the fastest joint (beyond 83 rad/s they are clipped).
    """
    bodies = np.array([len(joint_q)])
    records, scale = _quantise(bodies, np.asarray(joint_q), np.asarray(joint_qd))
    return _restore(bodies, records, scale)


def encode_trees(trees: Trees) -> tuple[list[bytes], Trees]:
    """Messages of at most 1.1 kB where single trees allow it, and what their receivers will decode, taken together."""
    ids = trees.tree
    if not len(ids) or (len(ids) > 1 and not (ids[1:] > ids[:-1]).all()):
        raise MessageError("trees of a batch must be at least one, in strictly increasing order")
    sizes = trees.bodies.tolist()
    if min(sizes) < 1 or sum(sizes) != len(trees.joint_q) or len(trees.joint_q) != len(trees.joint_qd):
        raise MessageError(
            f"{sum(sizes)} bodies declared, {len(trees.joint_q)} rotations and {len(trees.joint_qd)} rates"
        )
    records, scale = _quantise(trees.bodies, trees.joint_q, trees.joint_qd)
    joint_q, joint_qd = _restore(trees.bodies, records, scale)
    heads = np.empty(len(ids), _TREE)
    for name in ("tree", "ownership", "authority", "flags", "bodies"):
        heads[name] = getattr(trees, name)
    heads["scale"] = scale

    payloads, start, body = [], 0, 0
    head_bytes, body_bytes = heads.tobytes(), records.tobytes()
    while start < len(sizes):
        end, last, room = start, body, SAMPLE - _HEAD.size
        while end < len(sizes):
            room -= _TREE.itemsize + sizes[end] * _BODY.itemsize
            if room < 0 and end > start:
                break
            last += sizes[end]
            end += 1
        payloads.append(
            _head(TREES, end - start, trees.time)
            + head_bytes[start * _TREE.itemsize : end * _TREE.itemsize]
            + body_bytes[body * _BODY.itemsize : last * _BODY.itemsize]
        )
        start, body = end, last
    return payloads, dataclasses.replace(trees, joint_q=joint_q, joint_qd=joint_qd)


def decode_trees(payload: bytes, tree_size: np.ndarray | None = None) -> Trees:
    """Records of trees; with ``tree_size`` [tree] of the model, ids and body counts are held against it."""
    count, time = _open(payload, TREES, "trees")
    at = _HEAD.size + count * _TREE.itemsize
    if not 1 <= count <= MAX_TREES or len(payload) < at:
        raise MessageError(f"{count} trees announced (1 to {MAX_TREES}) in {len(payload)} B")
    heads = np.frombuffer(payload, _TREE, count, _HEAD.size)
    tree, bodies = heads["tree"].astype(np.int64), heads["bodies"].astype(np.int64)
    total = int(bodies.sum())
    if len(payload) != at + total * _BODY.itemsize or bodies.min() < 1 or total > MAX_BODIES:
        raise MessageError(f"trees of {total} bodies in {len(payload)} B, expected {at + total * _BODY.itemsize} B")
    if (tree[1:] <= tree[:-1]).any() or (heads["flags"] > (TOUCHED | RESTING)).any():
        raise MessageError("tree ids that do not increase, or unknown flags")
    if tree_size is not None:
        if tree[-1] >= len(tree_size):
            raise MessageError(f"tree {tree[-1]}, this vineyard has {len(tree_size)}")
        if (bodies != tree_size[tree]).any():
            wrong = int(np.flatnonzero(bodies != tree_size[tree])[0])
            raise MessageError(
                f"tree {tree[wrong]} with {bodies[wrong]} bodies, this vineyard's has {tree_size[tree[wrong]]}"
            )
    joint_q, joint_qd = _restore(bodies, np.frombuffer(payload, _BODY, total, at), heads["scale"])
    return Trees(time, tree, heads["ownership"], heads["authority"], heads["flags"], bodies, joint_q, joint_qd)


# ---------------------------------------------------------------- rare things


def valid_name(name: str) -> bool:
    """Whether an actor may be called so: the name is one chunk of a key."""
    return 1 <= len(name) <= 48 and all(c.isascii() and (c.isalnum() or c in "_-.") for c in name)


def encode_hello(hello: Hello) -> bytes:
    """A greeting; :class:`MessageError` if its name cannot be part of a key."""
    if not valid_name(hello.name):
        raise MessageError(f"actor name {hello.name!r}: use 1 to 48 letters, digits, '_', '-' or '.'")
    payload = _pack(HELLO, hello)
    if len(payload) > LARGEST:
        raise MessageError(f"greeting of {len(payload)} B, at most {LARGEST} B: the URDF is too long")
    return payload


def decode_hello(payload: bytes) -> Hello:
    """A greeting. One of another protocol version raises :class:`WrongVersion` before anything else is read."""
    hello = _unpack(payload, HELLO, "greeting", _hello_decoder)
    if not valid_name(hello.name):
        raise MessageError(f"greeting of an actor named {hello.name[:60]!r}")
    if hello.protocol != PROTOCOL:
        raise WrongVersion(hello.protocol)
    return hello


def encode_claims(claims: list[tuple[int, Claim, bool]]) -> bytes:
    """Claims as (tree, claim, whether its owner touches the tree now)."""
    return _pack(CLAIMS, [(int(tree), *claim, touching) for tree, claim, touching in claims])


def decode_claims(payload: bytes, tree_count: int | None = None) -> list[tuple[int, Claim, bool]]:
    """Claims, each checked: a tree of this vineyard, u16 sequences, a possible name or nobody's."""
    rows = _unpack(payload, CLAIMS, "claims", _claims_decoder)
    if len(rows) > MAX_TREES:
        raise MessageError(f"{len(rows)} claims in one message, at most {MAX_TREES}")
    for tree, ownership, authority, owner, _ in rows:
        if not 0 <= tree < (1 << 32 if tree_count is None else tree_count):
            raise MessageError(f"claim on tree {tree}, this vineyard has {tree_count}")
        if not (0 <= ownership < 1 << 16 and 0 <= authority < 1 << 16) or (owner and not valid_name(owner)):
            raise MessageError(f"claim ({ownership}, {authority}, {owner[:60]!r}) on tree {tree} is impossible")
    return [
        (tree, Claim(ownership, authority, owner), touching) for tree, ownership, authority, owner, touching in rows
    ]


def encode_time(asked: float, server: float = 0.0) -> bytes:
    """Question to the clock (own clock ``asked`` [s]) or its answer, which repeats the question."""
    return _pack(TIME, (float(asked), float(server)))


def decode_time(payload: bytes) -> tuple[float, float]:
    """(own clock when asked, server's clock when answered) [s], both finite."""
    asked, server = _unpack(payload, TIME, "clock", _time_decoder)
    if not (np.isfinite(asked) and np.isfinite(server)):
        raise MessageError(f"clock message ({asked}, {server}) that is not finite")
    return asked, server
