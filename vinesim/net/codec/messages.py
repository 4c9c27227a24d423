"""What crosses the network, byte by byte: encode, decode, and nothing unchecked in between.

Every message starts with four bytes: ``VS``, the protocol version, the kind. Poses and trees follow as packed
little-endian numpy records, rare things (greetings, claims) as msgpack. Whatever is malformed, truncated, of another
version, not finite or too large raises :class:`MessageError` in words, and nothing else.

Rotations travel as rotation vectors, three i16 of pi/32767 rad (error 0.003 degrees a component); joint rates of
a tree as i8 of that tree's own scale (error 0.4 % of its fastest joint). An owner that wants to agree with its copies
to the bit uses :func:`quantised` of what it sends. Boxes and loose bunches travel as 26 bytes each, in the cell under
which they are said: position in steps of 0.1 mm, rotation as the three smallest of four numbers, 10 bits each (error
0.28 degrees).
"""

from __future__ import annotations

import dataclasses
import math
import struct
from typing import Any

import msgspec
import numpy as np

from vinesim.net.replication.authority import Claim
from vinesim.net.replication.interest import CELL_SIZE, Cell
from vinesim.scene.ids import OBJECT_STRIDE, ObjectKind
from vinesim.scene.values import ObjectUpdate, RobotUpdate, TreeUpdate

PROTOCOL = 1
"""Version of everything in this file. Others are refused."""

MAGIC = b"VS"
ROBOT, TREES, CLAIMS, FACTS, THINGS, HUMAN, FORCE, HELLO, TIME, WELCOME = 1, 2, 3, 4, 5, 6, 7, 16, 17, 18
"""Kinds of message."""

TIMED = frozenset((ROBOT, TREES, THINGS, HUMAN, FORCE))
"""Kinds that say in their header at which network time they were true."""

MAX_DATAGRAM = 1100
"""Samples on the live session stay below this [B], one datagram, as far as a single tree allows."""

MAX_MESSAGE = 1 << 20
"""No message is larger [B]; it is refused unread."""

TURN_LSB = np.pi / 32767.0
"""Unit of a quantised rotation vector [rad]."""

RATE_LSB = 1e-5
"""Unit of a message's scale of joint rates [rad/s, m/s]."""

JOINT_LSB = 2e-4
"""Unit of a joint's position [rad, m]."""

VELOCITY_LSB = 1e-3
"""Unit of a base's velocities [m/s, rad/s]: 32.7 at most, faster ones are clipped."""

TOUCHED, RESTING = 1, 2
"""Flags of a tree or thing: its owner is in contact with it; it lies still and silence follows."""

ROOT_FLAG_UNIT = 4
"""Flags of a tree count in steps of this how many bodies were cut off it; their places follow all joints."""

MAX_ROOTS = 255 // ROOT_FLAG_UNIT

POSITION_LSB = 1e-4
"""Unit of a thing's position in its cell [m]: 3.2 m about :data:`MIDDLE`, farther ones are clipped."""

CELL_CENTRE = np.array([0.5 * CELL_SIZE, 0.5 * CELL_SIZE, 2.5])
"""From a cell's corner on the ground to the point from which positions count [m]."""

MIN_VELOCITY_SCALE = np.array([2.0**-10, 2.0**-8])
"""Least units of a thing's velocity [m/s] and rate of turn [rad/s]; each record doubles them as often as it must."""

MAX_JOINTS = 256
MAX_TREES = 4096
MAX_BODIES = 1 << 16
MAX_RECORDS = 4096
MAX_COORDINATE = 1e5
"""Nothing lies farther from the origin than this [m]."""

_HEAD = struct.Struct("<2sBBHd")  # magic, version, kind, count, time
_BASE = struct.Struct("<3f3h6hH")  # position, turn, velocity, scale of joint velocities; then joints: all i2, all i1
_WIDE = -32768  # a joint position that no i2 holds; it follows as f4
_TREE = np.dtype(
    [("tree", "<u4"), ("ownership", "<u2"), ("authority", "<u2"), ("flags", "u1"), ("bodies", "<u2"), ("scale", "<u2")]
)
_BODY = np.dtype([("turn", "<i2", 3), ("rate", "i1", 3)])
_ROOT = np.dtype([("body", "<u2"), ("position", "<f4", 3), ("velocity", "<i2", 3)])
_THING = np.dtype(
    [("object", "<u4"), ("ownership", "<u2"), ("authority", "<u2"), ("flags", "u1"), ("scale", "u1"),
     ("position", "<i2", 3), ("turn", "<u4"), ("velocity", "i1", 3), ("spin", "i1", 3)]
)  # fmt: skip
_THIRDS = 1023.0 / np.sqrt(2.0)
"""Steps of the three smallest components of a unit quaternion, which lie between +-1/sqrt(2)."""
_FURTHEST_TURN = (np.pi + 2.0 * TURN_LSB) ** 2


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
    height: float = 1.75
    """Of a human [m]."""


class Welcome(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The server's answer to who asks to be let into a world."""

    refused: str = ""
    """Empty, or in words why not and what to do."""
    scene: str = ""
    """Name of the world's scene."""
    digest: str = ""
    """``Model.digest()`` of its vineyard."""
    protocol: int = PROTOCOL


class RetainedRecord(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """What stays true when its author has gone: a bunch or a box lies somewhere, a tree was cut.

    Facts travel once, reliably, and the server keeps the greatest of each thing for those who come later.
    """

    object: int
    """:func:`vinesim.scene.ids.thing`"""
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
    moving: bool = False
    """It fell or was carried when this was said: its author goes on to tell those who are near."""

    @property
    def claim(self) -> Claim:
        """By which facts about one thing are ordered."""
        return Claim(self.ownership, self.authority, self.author)


@dataclasses.dataclass(frozen=True, slots=True)
class TreeStates:
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
    roots: np.ndarray = dataclasses.field(default_factory=lambda: _NO_ROOTS)
    """[k] how many bodies were cut off each tree, or nothing at all if none was anywhere. Of these, tree by tree:"""
    root: np.ndarray = dataclasses.field(default_factory=lambda: _NO_ROOTS)
    """[sum of roots] number of the body in its tree"""
    root_x: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """[sum of roots, 3] m, world"""
    root_xd: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    """[sum of roots, 3] m/s"""

    def updates(self, owner: str) -> list[TreeUpdate]:
        """One value per tree; their arrays are views of this batch."""
        ends = np.cumsum(self.bodies).tolist()
        lasts = np.cumsum(self.roots).tolist() if len(self.roots) else [0] * len(ends)
        columns = (self.tree, self.ownership, self.authority, self.flags)
        rows = zip(
            *(column.tolist() for column in columns), [0, *ends[:-1]], ends, [0, *lasts[:-1]], lasts, strict=True
        )
        return [
            TreeUpdate(
                tree, owner, ownership, authority, self.time, bool(flags & RESTING),
                self.joint_q[start:end], self.joint_qd[start:end],
                self.root[first:last], self.root_x[first:last], self.root_xd[first:last],
            )
            for tree, ownership, authority, flags, start, end, first, last in rows
        ]  # fmt: skip


@dataclasses.dataclass(frozen=True, slots=True)
class ObjectStates:
    """Records of several boxes and loose bunches of one owner at one instant. Numbers strictly increase."""

    time: float
    """Network time [s]."""
    object: np.ndarray
    """[k] :func:`vinesim.scene.ids.thing`"""
    ownership: np.ndarray
    """[k] u16 sequences"""
    authority: np.ndarray
    """[k] u16 sequences"""
    flags: np.ndarray
    """[k] ``TOUCHED`` or 0"""
    pose: np.ndarray
    """[k, 7] m, 1; in the world"""
    velocity: np.ndarray
    """[k, 6] m/s and rad/s; of the origin, world axes"""

    def updates(self, owner: str) -> list[ObjectUpdate]:
        """One value per thing; their arrays are views of this batch."""
        columns = (self.object, self.ownership, self.authority)
        rows = zip(*(column.tolist() for column in columns), self.pose, self.velocity, strict=True)
        return [
            ObjectUpdate(thing, owner, ownership, authority, self.time, pose, velocity)
            for thing, ownership, authority, pose, velocity in rows
        ]


_NO_ROOTS = np.zeros(0, np.int64)


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
    if len(payload) > MAX_MESSAGE:
        raise MessageError(f"message of {len(payload)} B, at most {MAX_MESSAGE} B are read")
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


def shift_time(payload: bytes, shift: float) -> bytes:
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


HEAD, head, opened = _HEAD.size, _head, _open
"""The same for messages that are written elsewhere: size of a header, how it is written and read."""


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
_welcome_decoder = msgspec.msgpack.Decoder(Welcome)
_claims_decoder = msgspec.msgpack.Decoder(list[tuple[int, int, int, str, bool]])
_facts_decoder = msgspec.msgpack.Decoder(list[RetainedRecord])
_time_decoder = msgspec.msgpack.Decoder(tuple[float, float])

# ---------------------------------------------------------------- actors


def _to_lsb(values: list[float], unit: float) -> list[int]:
    """Values in whole units, clipped to i16."""
    return [min(max(round(value / unit), -32767), 32767) for value in values]


def encode_robot(update: RobotUpdate) -> bytes:
    """An actor's pose: 46 bytes, 3 a joint, and 4 more for each joint beyond 6.5 rad or m (a wheel that rolled).

    Joint positions are off by at most 0.1 mrad or mm, joint velocities by 0.4 % of the fastest. The base's velocities
    are clipped at 32.7 m/s or rad/s, those of joints at 83.
    """
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
    near = [abs(value) < JOINT_LSB * 32767.5 for value in position]
    steps = [round(value / JOINT_LSB) if fits else _WIDE for value, fits in zip(position, near, strict=True)]
    wide = [value for value, fits in zip(position, near, strict=True) if not fits]
    scale = min(math.ceil(max(map(abs, velocity), default=0.0) / (127.0 * RATE_LSB)), 65535)
    unit = max(scale, 1) * RATE_LSB
    rates = [min(max(round(value / unit), -127), 127) for value in velocity]
    turn = _to_lsb([x * factor, y * factor, z * factor], TURN_LSB)
    return (
        _head(ROBOT, count, update.time)
        + _BASE.pack(*pose[:3], *turn, *_to_lsb(twist, VELOCITY_LSB), scale)
        + struct.pack(f"<{count}h{count}b{len(wide)}f", *steps, *rates, *wide)
    )


def decode_robot(payload: bytes, actor: str) -> RobotUpdate:
    """The pose that ``actor`` (known from the key, never from the payload) sent."""
    count, time = _open(payload, ROBOT, "actor pose")
    joints = _HEAD.size + _BASE.size
    rest = len(payload) - joints - 3 * count
    if count > MAX_JOINTS or rest < 0:
        raise MessageError(f"actor pose with {count} joints (at most {MAX_JOINTS}) in {len(payload)} B")
    steps = np.frombuffer(payload, "<i2", count, joints)
    apart = steps == _WIDE
    if rest != 4 * np.count_nonzero(apart):
        raise MessageError(f"actor pose with {np.count_nonzero(apart)} wide joints and {rest} B for them")
    base = _BASE.unpack_from(payload, _HEAD.size)
    position = steps * JOINT_LSB
    position[apart] = np.frombuffer(payload, "<f4", rest // 4, joints + 3 * count)
    if not (all(-1e9 < number < 1e9 for number in base[:3]) and (np.abs(position) < 1e9).all()):
        raise MessageError("actor pose with a number that is not finite or beyond 1e9")
    turn = _checked_turn(np.array(base[3:6]) * TURN_LSB, "actor pose")
    velocity = np.frombuffer(payload, "i1", count, joints + 2 * count) * (base[12] * RATE_LSB)
    return RobotUpdate(
        actor, time, np.concatenate([base[:3], quaternion(turn)]), np.array(base[6:12]) * VELOCITY_LSB, position, velocity,
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
    scale = np.minimum(np.ceil(fastest / (127.0 * RATE_LSB)), 65535.0)
    unit = _unit_quaternions(bodies, scale)
    turn = np.rint(rotation_vector(joint_q) / TURN_LSB) + 0.0  # an integer has no negative zero
    rate = np.minimum(np.maximum(np.rint(joint_qd / np.maximum(unit, RATE_LSB)), -127.0), 127.0) + 0.0
    return turn, rate, scale, unit


def _unit_quaternions(bodies: np.ndarray, scale: np.ndarray) -> np.ndarray:
    return np.repeat(scale * RATE_LSB, bodies)[:, None]


def quantise_tree(joint_q: np.ndarray, joint_qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """State of one tree ([n, 4], [n, 3] rad/s) as every copy will hold it, to the bit.

    Rotations are off by at most 0.005 degrees; rates by 0.4 % of the fastest joint (beyond 83 rad/s they are clipped).
    """
    turn, rate, _, unit = _quantise(np.array([len(joint_q)]), np.asarray(joint_q, float), np.asarray(joint_qd, float))
    return quaternion(turn * TURN_LSB), rate * unit


def encode_trees(trees: TreeStates) -> tuple[list[bytes], TreeStates]:
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
    cuts = [0] * len(sizes)
    roots = np.empty(len(trees.root), _ROOT)
    if len(trees.roots):
        cuts = trees.roots.tolist()
        if max(cuts) > MAX_ROOTS or sum(cuts) != len(roots) or not np.isfinite(trees.root_x).all():
            raise MessageError(f"trees with {cuts} bodies cut off (at most {MAX_ROOTS} each) and {len(roots)} places")
        heads["flags"] += np.array(cuts, np.uint8) * ROOT_FLAG_UNIT
        roots["body"], roots["position"] = trees.root, trees.root_x
        roots["velocity"] = np.clip(np.rint(trees.root_xd / VELOCITY_LSB), -32767, 32767)

    payloads, start, body, root = [], 0, 0, 0
    head_bytes, body_bytes, root_bytes = heads.tobytes(), records.tobytes(), roots.tobytes()
    while start < len(sizes):
        end, last, end_root, room = start, body, root, MAX_DATAGRAM - _HEAD.size
        while end < len(sizes):
            room -= _TREE.itemsize + sizes[end] * _BODY.itemsize + cuts[end] * _ROOT.itemsize
            if room < 0 and end > start:
                break
            last += sizes[end]
            end_root += cuts[end]
            end += 1
        payloads.append(
            _head(TREES, end - start, trees.time)
            + head_bytes[start * _TREE.itemsize : end * _TREE.itemsize]
            + body_bytes[body * _BODY.itemsize : last * _BODY.itemsize]
            + root_bytes[root * _ROOT.itemsize : end_root * _ROOT.itemsize]
        )
        start, body, root = end, last, end_root
    heard = dataclasses.replace(
        trees, joint_q=quaternion(turn * TURN_LSB), joint_qd=rate * unit,
        root_x=roots["position"].astype(float), root_xd=roots["velocity"] * VELOCITY_LSB,
    )  # fmt: skip
    return payloads, heard


def decode_trees(payload: bytes, tree_size: np.ndarray | None = None) -> TreeStates:
    """Records of trees; with ``tree_size`` [tree] of the model, ids and body counts are held against it."""
    count, time = _open(payload, TREES, "trees")
    at = _HEAD.size + count * _TREE.itemsize
    if not 1 <= count <= MAX_TREES or len(payload) < at:
        raise MessageError(f"{count} trees announced (1 to {MAX_TREES}) in {len(payload)} B")
    heads = np.frombuffer(payload, _TREE, count, _HEAD.size)
    tree, bodies = heads["tree"].astype(np.int64), heads["bodies"].astype(np.int64)
    total = int(bodies.sum())
    cuts = heads["flags"].astype(np.int64) // ROOT_FLAG_UNIT
    after = at + total * _BODY.itemsize
    expected = after + int(cuts.sum()) * _ROOT.itemsize
    if len(payload) != expected or bodies.min() < 1 or total > MAX_BODIES:
        raise MessageError(f"trees of {total} bodies in {len(payload)} B, expected {expected} B")
    if (tree[1:] <= tree[:-1]).any():
        raise MessageError("tree ids that do not increase")
    if tree_size is not None:
        if tree[-1] >= len(tree_size):
            raise MessageError(f"tree {tree[-1]}, this vineyard has {len(tree_size)}")
        if (bodies != tree_size[tree]).any():
            wrong = int(np.flatnonzero(bodies != tree_size[tree])[0])
            raise MessageError(
                f"tree {tree[wrong]} with {bodies[wrong]} bodies, this vineyard's has {tree_size[tree[wrong]]}"
            )
    records = np.frombuffer(payload, _BODY, total, at)
    joint_q = quaternion(_checked_turn(records["turn"] * TURN_LSB, "tree"))
    joint_qd = records["rate"] * _unit_quaternions(bodies, heads["scale"])
    known = (
        time,
        tree,
        heads["ownership"],
        heads["authority"],
        heads["flags"] % ROOT_FLAG_UNIT,
        bodies,
        joint_q,
        joint_qd,
    )
    if not cuts.any():
        return TreeStates(*known)
    roots = np.frombuffer(payload, _ROOT, int(cuts.sum()), after)
    root, root_x = roots["body"].astype(np.int64), roots["position"].astype(float)
    if (root >= np.repeat(bodies, cuts)).any() or not (np.abs(root_x) < MAX_COORDINATE).all():
        raise MessageError("a body cut off a tree that has not so many, or lying nowhere")
    if (np.diff(root)[np.diff(np.repeat(tree, cuts)) == 0] <= 0).any():
        raise MessageError("bodies cut off a tree in an order that does not increase")
    return TreeStates(*known, cuts, root, root_x, roots["velocity"] * VELOCITY_LSB)


# ---------------------------------------------------------------- boxes and loose bunches


def _pack_quaternion(q: np.ndarray) -> np.ndarray:
    """Unit quaternions [k, 4] as 32 bits [k]: which component is the largest, and the other three, 10 bits each."""
    rows = np.arange(len(q))
    largest = np.argmax(np.abs(q), axis=1)
    signed = q * np.copysign(1.0, q[rows, largest])[:, None]
    three = signed[rows[:, None], (largest[:, None] + [1, 2, 3]) % 4]
    steps = np.clip(np.rint(three * _THIRDS) + 511.0, 0.0, 1022.0).astype(np.uint32)
    return (largest.astype(np.uint32) << 30) | (steps[:, 0] << 20) | (steps[:, 1] << 10) | steps[:, 2]


def _unpack_quaternion(bits: np.ndarray) -> np.ndarray:
    """Unit quaternions [k, 4] from 32 bits [k]; no other rotation has these bits, and these bits no other."""
    largest = (bits >> 30).astype(np.int64)
    three = (np.stack([bits >> 20, bits >> 10, bits], -1) & 1023).astype(float) - 511.0
    three /= _THIRDS
    rest = 1.0 - (three * three).sum(1)
    if (rest < 0.2).any():
        raise MessageError("a thing with a rotation that cannot be")
    q = np.empty((len(bits), 4))
    rows = np.arange(len(bits))
    q[rows, largest] = np.sqrt(rest)
    q[rows[:, None], (largest[:, None] + [1, 2, 3]) % 4] = three
    return q


def encode_objects(things: ObjectStates, cell: Cell) -> tuple[list[bytes], ObjectStates]:
    """Messages of at most 1.1 kB about things said under ``cell``, and what their receivers will decode, together."""
    ids = things.object
    if not len(ids) or (len(ids) > 1 and not (ids[1:] > ids[:-1]).all()):
        raise MessageError("things of a batch must be at least one, in strictly increasing order")
    if not (np.isfinite(things.pose).all() and np.isfinite(things.velocity).all()):
        raise MessageError("state of a thing is not finite")
    records = np.empty(len(ids), _THING)
    for name in ("object", "ownership", "authority", "flags"):
        records[name] = getattr(things, name)
    records["position"] = np.clip(np.rint((things.pose[:, :3] - _cell_origin(cell)) / POSITION_LSB), -32767, 32767)
    records["turn"] = _pack_quaternion(things.pose[:, 3:])
    velocity = things.velocity.reshape(-1, 2, 3)
    fastest = np.maximum(np.abs(velocity).max(2) / (127.0 * MIN_VELOCITY_SCALE), 1.0)
    doubled = np.minimum(np.ceil(np.log2(fastest)), 15.0)
    steps = np.clip(np.rint(velocity / (MIN_VELOCITY_SCALE * 2.0**doubled)[:, :, None]), -127.0, 127.0)
    records["velocity"], records["spin"] = steps[:, 0], steps[:, 1]
    records["scale"] = doubled[:, 0] + 16.0 * doubled[:, 1]
    count = (MAX_DATAGRAM - _HEAD.size) // _THING.itemsize
    parts = [records[first : first + count] for first in range(0, len(records), count)]
    payloads = [_head(THINGS, len(part), things.time) + part.tobytes() for part in parts]
    return payloads, _read_objects(things.time, records, cell)


def decode_objects(payload: bytes, cell: Cell) -> ObjectStates:
    """Records of things that were said under ``cell``; of which vineyard is for the reader to check."""
    count, time = _open(payload, THINGS, "things")
    if not 1 <= count <= MAX_TREES or len(payload) != _HEAD.size + count * _THING.itemsize:
        raise MessageError(f"{count} things announced (1 to {MAX_TREES}) in {len(payload)} B")
    records = np.frombuffer(payload, _THING, count, _HEAD.size)
    ids = records["object"].astype(np.int64)
    if (ids[1:] <= ids[:-1]).any() or ids[0] < OBJECT_STRIDE or ids[-1] >= len(ObjectKind) * OBJECT_STRIDE:
        raise MessageError("things that are trees, of no kind, or in an order that does not increase")
    if (records["flags"] > TOUCHED).any():
        raise MessageError("things with unknown flags")
    return _read_objects(time, records, cell)


def _read_objects(time: float, records: np.ndarray, cell: Cell) -> ObjectStates:
    pose = np.empty((len(records), 7))
    pose[:, :3] = records["position"] * POSITION_LSB + _cell_origin(cell)
    pose[:, 3:] = _unpack_quaternion(records["turn"])
    doubled = np.stack([records["scale"] % 16, records["scale"] // 16], -1).astype(float)
    unit = np.repeat(MIN_VELOCITY_SCALE * 2.0**doubled, 3, axis=1)
    velocity = np.concatenate([records["velocity"], records["spin"]], -1) * unit
    ids = records["object"].astype(np.int64)
    return ObjectStates(time, ids, records["ownership"], records["authority"], records["flags"], pose, velocity)


def _cell_origin(cell: Cell) -> np.ndarray:
    """Where positions of a cell are zero [3] m."""
    return np.array([cell[0] * CELL_SIZE, cell[1] * CELL_SIZE, 0.0]) + CELL_CENTRE


# ---------------------------------------------------------------- rare things


def is_valid_name(name: str) -> bool:
    """Whether an actor may be called so: the name is one chunk of a key."""
    return 1 <= len(name) <= 48 and all(c.isascii() and (c.isalnum() or c in "_-.") for c in name)


def encode_hello(hello: Hello) -> bytes:
    """A greeting; :class:`MessageError` if its name cannot be part of a key."""
    if not is_valid_name(hello.name):
        raise MessageError(f"actor name {hello.name!r}: use 1 to 48 letters, digits, '_', '-' or '.'")
    payload = _pack(HELLO, hello)
    if len(payload) > MAX_MESSAGE:
        raise MessageError(f"greeting of {len(payload)} B, at most {MAX_MESSAGE} B: the URDF is too long")
    return payload


def decode_hello(payload: bytes) -> Hello:
    """A greeting. One of another protocol version raises :class:`WrongVersion` before anything else is read."""
    hello = _unpack(payload, HELLO, "greeting", _hello_decoder)
    if not is_valid_name(hello.name):
        raise MessageError(f"greeting of an actor named {hello.name[:60]!r}")
    if hello.protocol != PROTOCOL:
        raise WrongVersion(hello.protocol)
    return hello


def check_object_id(thing: int, counts: tuple[int, ...] | None = None) -> None:
    """:class:`MessageError` unless there can be a thing of this number; ``counts``: how many there are of each kind."""
    kind, index = divmod(thing, OBJECT_STRIDE)
    if not 0 <= kind < len(ObjectKind):
        raise MessageError(f"something is said of thing {thing}, which is of no kind")
    if counts is not None and index >= counts[kind]:
        raise MessageError(f"{ObjectKind(kind).name.lower()} {index}, this vineyard has {counts[kind]}")


def encode_welcome(welcome: Welcome) -> bytes:
    """The answer to a greeting."""
    return _pack(WELCOME, welcome)


def decode_welcome(payload: bytes) -> Welcome:
    """The answer to a greeting; a server of another protocol version raises :class:`WrongVersion`."""
    return _unpack(payload, WELCOME, "welcome", _welcome_decoder)


def encode_claims(claims: list[tuple[int, Claim, bool]]) -> bytes:
    """Claims as (thing, claim, whether its owner touches the thing now)."""
    return _pack(CLAIMS, [(int(tree), *claim, touching) for tree, claim, touching in claims])


def decode_claims(payload: bytes, counts: tuple[int, ...] | None = None) -> list[tuple[int, Claim, bool]]:
    """Claims, each checked: a thing of this vineyard, u16 sequences, a possible name or nobody's.

    ``counts``: how many things there are of each kind.
    """
    rows = _unpack(payload, CLAIMS, "claims", _claims_decoder)
    if len(rows) > MAX_TREES:
        raise MessageError(f"{len(rows)} claims in one message, at most {MAX_TREES}")
    for tree, ownership, authority, owner, _ in rows:
        check_object_id(tree, counts)
        if not (0 <= ownership < 1 << 16 and 0 <= authority < 1 << 16) or (owner and not is_valid_name(owner)):
            raise MessageError(f"claim ({ownership}, {authority}, {owner[:60]!r}) on thing {tree} is impossible")
    return [
        (tree, Claim(ownership, authority, owner), touching) for tree, ownership, authority, owner, touching in rows
    ]


def encode_records(facts: list[RetainedRecord]) -> bytes:
    """Facts as their author, or the server that kept them, tells them."""
    return _pack(FACTS, facts)


def decode_records(payload: bytes, counts: tuple[int, ...] | None = None) -> list[RetainedRecord]:
    """Facts, each checked as far as that is possible without the vineyard: numbers, names, poses, sizes.

    ``counts``: how many things there are of each kind, if that is known.
    """
    facts = _unpack(payload, FACTS, "facts", _facts_decoder)
    if len(facts) > MAX_RECORDS:
        raise MessageError(f"{len(facts)} facts in one message, at most {MAX_RECORDS}")
    for fact in facts:
        check_object_id(fact.object, counts)
        if not (0 <= fact.ownership < 1 << 16 and 0 <= fact.authority < 1 << 16 and is_valid_name(fact.author)):
            raise MessageError(f"fact by {fact.author[:60]!r} with claim ({fact.ownership}, {fact.authority})")
        if not all(-MAX_COORDINATE < number < MAX_COORDINATE for number in fact.pose):
            raise MessageError(f"fact about thing {fact.object} at {fact.pose}, not finite or too far away")
        if not 0.95 < math.hypot(*fact.pose[3:]) < 1.05:
            raise MessageError(f"fact about thing {fact.object} with orientation {fact.pose[3:]}, no unit quaternion")
        if len(fact.parent) > 200 or len(fact.cut) > MAX_BODIES or any(body < 0 for body in fact.cut):
            raise MessageError(f"fact about thing {fact.object} with a parent or cuts that cannot be")
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
