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

from vinesim.net.authority import Claim
from vinesim.world.ids import THING_STRIDE, Kind
from vinesim.world.values import RobotUpdate, TreeUpdate

PROTOCOL = 1
"""Version of everything in this file. Others are refused."""

MAGIC = b"VS"
ROBOT, TREES, CLAIMS, FACTS, HELLO, TIME = 1, 2, 3, 4, 16, 17
"""Kinds of message."""

TIMED = frozenset((ROBOT, TREES))
"""Kinds that say in their header at which network time they were true."""

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
MAX_FACTS = 4096
FARTHEST = 1e5
"""Nothing lies farther from the origin than this [m]."""

_HEAD = struct.Struct("<2sBBHd")  # magic, version, kind, count, time
_BASE = struct.Struct("<3f3h6h")  # position, turn, velocity; then all joint positions f4, all joint velocities i2
_TREE = np.dtype(
    [("tree", "<u4"), ("ownership", "<u2"), ("authority", "<u2"), ("flags", "u1"), ("bodies", "<u2"), ("scale", "<u2")]
)
_BODY = np.dtype([("turn", "<i2", 3), ("rate", "i1", 3)])
_FURTHEST_TURN = (np.pi + 2.0 * TURN) ** 2


class MessageError(ValueError):
    """A message that must not be believed; the text says why."""


class WrongVersion(MessageError):
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
    seed: int = -1
    """Seed of its vineyard, for whoever wants to grow the same; -1 keeps it to itself."""


class Fact(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """What stays true when its author has gone: a bunch or a box lies somewhere, a tree was cut.

    Facts travel once, reliably, and the server keeps the greatest of each thing for those who come later.
    """

    thing: int
    """:func:`vinesim.world.ids.thing`"""
    ownership: int
    authority: int
    """The author's claim when it was said, u16 sequences."""
    author: str
    pose: tuple[float, float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    """Where a bunch or a box lies [m, 1], in the frame of ``parent``."""
    parent: str = ""
    """What it rides on: ``box/3`` or a robot's ``actor/link``; empty: the ground."""
    cut: tuple[int, ...] = ()
    """Bodies of the tree that were cut off their parents, in increasing order."""
    trees: bytes = b""
    """The tree's state as a message of one tree, :func:`encode_trees`."""

    @property
    def claim(self) -> Claim:
        """By which facts about one thing are ordered."""
        return Claim(self.ownership, self.authority, self.author)


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
    sine = np.maximum(np.sqrt(np.einsum("...i,...i->...", v, v)), 1e-12)
    return v * np.copysign(2.0 * np.arctan2(sine, np.abs(w)) / sine, w)[..., None]


def quaternion(v: np.ndarray) -> np.ndarray:
    """Rotation vectors [..., 3] rad to unit quaternions [..., 4]; lean, for the tick."""
    half = np.maximum(0.5 * np.sqrt(np.einsum("...i,...i->...", v, v)), 1e-12)
    q = np.empty((*v.shape[:-1], 4), v.dtype)
    np.multiply(v, (0.5 * np.sin(half) / half)[..., None], out=q[..., :3])
    np.cos(half, out=q[..., 3])
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


def time_of(payload: bytes) -> float | None:
    """The network time [s] at which a message was true; None if its kind does not say."""
    if kind_of(payload) not in TIMED or len(payload) < _HEAD.size:
        return None
    time = _HEAD.unpack_from(payload)[4]
    return time if math.isfinite(time) else None


def restamped(payload: bytes, shift: float) -> bytes:
    """The same message as if it had been true ``shift`` seconds later; itself if its kind does not say when it was."""
    time = time_of(payload)
    return (
        payload if time is None else payload[: _HEAD.size - 8] + struct.pack("<d", time + shift) + payload[_HEAD.size :]
    )


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
_facts_decoder = msgspec.msgpack.Decoder(list[Fact])
_time_decoder = msgspec.msgpack.Decoder(tuple[float, float])

# ---------------------------------------------------------------- actors


def _steps(values: list[float], unit: float) -> list[int]:
    """Values in whole units, clipped to i16."""
    return [min(max(round(value / unit), -32767), 32767) for value in values]


def encode_robot(update: RobotUpdate) -> bytes:
    """An actor's pose: 44 bytes and 6 a joint. Velocities beyond 32.7 m/s or rad/s are clipped."""
    pose, twist = update.base_q.tolist(), update.base_qd.tolist()
    position, velocity = update.position.tolist(), update.velocity.tolist()
    count = len(position)
    if count > MAX_JOINTS or len(velocity) != count or len(pose) != 7 or len(twist) != 6:
        raise MessageError(
            f"{update.actor!r}: pose of {len(pose)} numbers (7), velocity of {len(twist)} (6), {count} joint positions "
            f"and {len(velocity)} velocities (equal, at most {MAX_JOINTS})"
        )
    if not all(-1e9 < number < 1e9 for number in (*pose, *twist, *position, *velocity)):
        raise MessageError(f"state of {update.actor!r} has a number that is not finite or beyond 1e9")
    x, y, z, w = pose[3:]
    sine = math.hypot(x, y, z)
    if not 0.95 < math.hypot(sine, w) < 1.05:
        raise MessageError(f"orientation {pose[3:]} of {update.actor!r} is no unit quaternion")
    factor = math.copysign(2.0 * math.atan2(sine, abs(w)) / sine, w) if sine > 1e-12 else 0.0
    return (
        _head(ROBOT, count, update.time)
        + _BASE.pack(*pose[:3], *_steps([x * factor, y * factor, z * factor], TURN), *_steps(twist, VELOCITY))
        + struct.pack(f"<{count}f{count}h", *position, *_steps(velocity, VELOCITY))
    )


def decode_robot(payload: bytes, actor: str) -> RobotUpdate:
    """The pose that ``actor`` (known from the key, never from the payload) sent."""
    count, time = _open(payload, ROBOT, "actor pose")
    expected = _HEAD.size + _BASE.size + 6 * count
    if count > MAX_JOINTS or len(payload) != expected:
        raise MessageError(
            f"actor pose with {count} joints (at most {MAX_JOINTS}) in {len(payload)} B, not {expected} B"
        )
    base = _BASE.unpack_from(payload, _HEAD.size)
    joints = struct.unpack_from(f"<{count}f{count}h", payload, _HEAD.size + _BASE.size)
    if not all(-1e9 < number < 1e9 for number in (*base[:3], *joints[:count])):
        raise MessageError("actor pose with a number that is not finite or beyond 1e9")
    turn = _checked_turn(np.array(base[3:6]) * TURN, "actor pose")
    return RobotUpdate(
        actor, time, np.concatenate([base[:3], quaternion(turn)]), np.array(base[6:]) * VELOCITY,
        np.array(joints[:count], float), np.array(joints[count:], float) * VELOCITY,
    )  # fmt: skip


def _checked_turn(turn: np.ndarray, name: str) -> np.ndarray:
    """Rotation vectors [..., 3] if none is longer than half a turn: each rotation has one way to be written."""
    if turn.size and np.einsum("...i,...i->...", turn, turn).max() > _FURTHEST_TURN:
        raise MessageError(f"{name} with a rotation of more than half a turn")
    return turn


# ---------------------------------------------------------------- trees


def _quantise(bodies: np.ndarray, joint_q: np.ndarray, joint_qd: np.ndarray) -> tuple[np.ndarray, ...]:
    """Whole steps of turn [n, 3] and of rate [n, 3] as floats, scales of rates [k], and the unit of rate [n, 1]."""
    if not (np.isfinite(joint_q).all() and np.isfinite(joint_qd).all()):
        raise MessageError("joint state of a tree is not finite")
    fastest = np.maximum.reduceat(np.abs(joint_qd).ravel(), 3 * (np.cumsum(bodies) - bodies))
    scale = np.minimum(np.ceil(fastest / (127.0 * RATE)), 65535.0)
    unit = _unit(bodies, scale)
    turn = np.rint(rotation_vector(joint_q) / TURN) + 0.0  # an integer has no negative zero
    rate = np.minimum(np.maximum(np.rint(joint_qd / np.maximum(unit, RATE)), -127.0), 127.0) + 0.0
    return turn, rate, scale, unit


def _unit(bodies: np.ndarray, scale: np.ndarray) -> np.ndarray:
    return np.repeat(scale * RATE, bodies)[:, None]


def quantised(joint_q: np.ndarray, joint_qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """State of one tree ([n, 4], [n, 3] rad/s) as every copy will hold it, to the bit.

    Rotations are off by at most 0.005 degrees; rates by 0.4 % of the fastest joint (beyond 83 rad/s they are clipped).
    """
    turn, rate, _, unit = _quantise(np.array([len(joint_q)]), np.asarray(joint_q, float), np.asarray(joint_qd, float))
    return quaternion(turn * TURN), rate * unit


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
    turn, rate, scale, unit = _quantise(trees.bodies, trees.joint_q, trees.joint_qd)
    records = np.empty(len(turn), _BODY)
    records["turn"], records["rate"] = turn, rate
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
    return payloads, dataclasses.replace(trees, joint_q=quaternion(turn * TURN), joint_qd=rate * unit)


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
    records = np.frombuffer(payload, _BODY, total, at)
    joint_q = quaternion(_checked_turn(records["turn"] * TURN, "tree"))
    joint_qd = records["rate"] * _unit(bodies, heads["scale"])
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


def encode_facts(facts: list[Fact]) -> bytes:
    """Facts as their author, or the server that kept them, tells them."""
    return _pack(FACTS, facts)


def decode_facts(payload: bytes) -> list[Fact]:
    """Facts, each checked as far as that is possible without the vineyard: numbers, names, poses, sizes."""
    facts = _unpack(payload, FACTS, "facts", _facts_decoder)
    if len(facts) > MAX_FACTS:
        raise MessageError(f"{len(facts)} facts in one message, at most {MAX_FACTS}")
    for fact in facts:
        if not 0 <= fact.thing < len(Kind) * THING_STRIDE:
            raise MessageError(f"fact about thing {fact.thing}, which is of no kind")
        if not (0 <= fact.ownership < 1 << 16 and 0 <= fact.authority < 1 << 16 and valid_name(fact.author)):
            raise MessageError(f"fact by {fact.author[:60]!r} with claim ({fact.ownership}, {fact.authority})")
        if not all(-FARTHEST < number < FARTHEST for number in fact.pose):
            raise MessageError(f"fact about thing {fact.thing} at {fact.pose}, not finite or too far away")
        if not 0.95 < math.hypot(*fact.pose[3:]) < 1.05:
            raise MessageError(f"fact about thing {fact.thing} with orientation {fact.pose[3:]}, no unit quaternion")
        if len(fact.parent) > 200 or len(fact.cut) > MAX_BODIES or any(body < 0 for body in fact.cut):
            raise MessageError(f"fact about thing {fact.thing} with a parent or cuts that cannot be")
    return facts


def encode_time(asked: float, server: float = 0.0) -> bytes:
    """Question to the clock (own clock ``asked`` [s]) or its answer, which repeats the question."""
    return _pack(TIME, (float(asked), float(server)))


def decode_time(payload: bytes) -> tuple[float, float]:
    """(own clock when asked, server's clock when answered) [s], both finite."""
    asked, server = _unpack(payload, TIME, "clock", _time_decoder)
    if not (np.isfinite(asked) and np.isfinite(server)):
        raise MessageError(f"clock message ({asked}, {server}) that is not finite")
    return asked, server
