"""Tables of all kinds of network messages and of all families of keys, and the traffic counters.

A row of :data:`MESSAGES` names the keys under which messages of a kind travel, and the function that describes them in
a recording. A row of :data:`FAMILIES` has the key patterns of a family, who may publish under them, and where their
messages are counted and recorded. The formats are defined in the other modules of this package. ``robot``, ``human``,
``trees``, ``objects``, ``forces`` and ``voice`` are packed binary messages that are sent many times a second.
``control`` and ``meshes`` are rare messages in msgpack.
"""

from __future__ import annotations

import base64
import dataclasses
import math
import struct
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgspec

from vinesim.net.codec import control, forces, human, meshes, objects, robot, trees, voice
from vinesim.net.codec.header import HEADER, kind_of
from vinesim.net.codec.json_values import TIME, YES, object_of, stamp


class Message(NamedTuple):
    """A kind of network message: a row of :data:`MESSAGES`."""

    kind: int
    """Number of the kind, the fourth byte of each of its messages."""
    families: tuple[str, ...]
    """Names of the families of keys (:class:`Family`) under which messages of this kind are sent."""
    has_time: bool = False
    """Whether the header contains the network time [s] at which the content was sampled."""
    describe: Callable[[bytes, str], dict[str, Any]] | None = None
    """Function of payload and key that decodes a message for the JSON of a recording, and raises ValueError if it
    cannot. None: a recording has only the bytes of the message."""
    fields: Mapping[str, Any] = {}
    """JSON schemas of the fields that ``describe`` returns. Their text is part of the file format."""


_ROWS = (
    Message(robot.ROBOT, ("a", "pose"), True, human.describe_pose, human.POSE_FIELDS),
    Message(human.HUMAN, ("a", "pose"), True, human.describe_pose, human.POSE_FIELDS),
    Message(trees.TREES, ("tree", "near", "own"), True, trees.describe_trees, trees.TREES_FIELDS),
    Message(objects.OBJECTS, ("c",), True, objects.describe_objects, objects.OBJECTS_FIELDS),
    Message(control.CLAIMS, ("own",), False, control.describe_claims, control.CLAIMS_FIELDS),
    Message(control.RETAINED, ("fact", "snap"), False, control.describe_records, control.RECORDS_FIELDS),
    Message(forces.WRENCHES, ("force",), True, forces.describe_wrenches, forces.WRENCHES_FIELDS),
    Message(forces.COUPLINGS, ("force",), True, forces.describe_couplings, forces.COUPLINGS_FIELDS),
    Message(voice.VOICE, ("voice",), True),
    Message(control.HELLO, ("hello", "join"), False, control.describe_hello, control.HELLO_FIELDS),
    Message(
        control.DESCRIPTION,
        ("robot",),
        False,
        control.describe_description,
        control.DESCRIPTION_FIELDS,
    ),
    Message(control.WELCOME, ("join",)),
    Message(control.CLOCK, ("clock",)),
    Message(meshes.MESH_PART, ("mesh", "offer")),
    Message(meshes.MESH_REQUEST, ("mesh",)),
    Message(meshes.MESH_WANTED, ("offer",)),
)

MESSAGES = {row.kind: row for row in _ROWS}
"""All kinds of messages, by number."""

assert len(MESSAGES) == len(_ROWS), "two kinds of messages have the same number"


class Family(NamedTuple):
    """A family of keys: all Zenoh keys that begin with the same chunk after the world's prefix, like ``tree`` or
    ``own``.

    ``docs/network.md`` lists the families.
    """

    keys: tuple[str, ...]
    """Patterns of the family's keys. ``{actor}`` stands for the name of the actor that publishes, ``*`` for any
    chunk."""
    traffic: str
    """Name of the field of :class:`Counters` that counts the messages of this family of keys."""
    schema: str = "vinesim.Message"
    purpose: str = ""
    """Name (``schema``) and description (``purpose``) of the JSON schema by which recordings describe the family's
    messages."""
    recorded_with: str = ""
    """Value of ``vinesim record --only`` that selects this family; empty: the family is recorded always or never."""
    is_published: bool = True
    """Whether actors publish the messages of this family of keys. If not, the messages are replies to queries, or a
    recorder makes them."""
    is_reliable: bool = False
    """Whether the messages of this family of keys are sent reliably, in order and without loss."""
    by_spectators: bool = False
    """Whether spectators, too, publish messages of this family of keys."""


FAMILIES = {
    "pose": Family(
        ("pose/*/*/{actor}",),
        "actor",
        "foxglove.PoseInFrame",
        "Where an actor is, and its joints.",
        "poses",
        by_spectators=True,
    ),
    "a": Family(
        ("a/{actor}", "a/{actor}/far", "a/{actor}/mid", "a/{actor}/near"),
        "actor",
        "foxglove.PoseInFrame",
        "Where an actor is, and its joints.",
        "poses",
        by_spectators=True,
    ),
    "tree": Family(("tree/*/*/{actor}",), "environment", "vinesim.Trees", "Trees that an actor moves.", "trees"),
    "near": Family(("near/*/*/{actor}",), "environment", "vinesim.Trees", "Trees that an actor moves.", "trees"),
    "c": Family(
        ("c/*/*/{actor}",),
        "environment",
        "vinesim.Moving",
        "Boxes and bunches that an actor moves in a cell.",
        "things",
    ),
    "own": Family(
        ("own/*/*/{actor}",),
        "event",
        "vinesim.Event",
        "A claim, or what came to rest.",
        "events",
        is_reliable=True,
    ),
    "fact": Family(("fact/*/*/{actor}",), "retained", "vinesim.Facts", "What stays true.", "facts", is_reliable=True),
    "force": Family(
        ("force/*/{actor}",),
        "force",
        "vinesim.Push",
        "What an actor does to a robot, or to a tree that another touches, too.",
        "forces",
    ),
    "voice": Family(("voice/{actor}", "voice/{actor}/pcm"), "voice", by_spectators=True),
    "hello": Family(
        ("hello/{actor}",), "control", "vinesim.Greeting", "How an actor introduced itself.", is_published=False
    ),
    "robot": Family(
        ("robot/{actor}",), "control", "vinesim.Robot", "The URDF of a robot, and its sidecar.", is_published=False
    ),
    "snap": Family(("snap/*/*",), "control", "vinesim.Facts", "What was true before.", is_published=False),
    "live": Family(
        ("live/{actor}", "live/{actor}/*"), "control", "vinesim.Live", "An actor came or went.", is_published=False
    ),
}
"""All families of keys (:class:`Family`) that are published or recorded, by the first chunk of their keys."""

_OTHER = Family((), "event")


def family_of(key: str) -> Family:
    """Returns the family of a key. An unknown key gets a family without patterns that is counted as events."""
    return FAMILIES.get(key.partition("/")[0], _OTHER)


_ACTOR_FIRST = frozenset(name for name, family in FAMILIES.items() if family.keys[0].startswith(f"{name}/{{actor}}"))

_OF_NO_ACTOR = frozenset(name for name, family in FAMILIES.items() if "{actor}" not in family.keys[0])


def sender_of(key: str) -> str:
    """Returns the name of the actor that published under a key; empty for the server and for keys without an actor."""
    family, *rest = key.split("/")
    if not rest or family in _OF_NO_ACTOR:
        return ""
    return rest[0] if family in _ACTOR_FIRST else rest[-1]


# ------------------------------------------------------------ times


def time_of(payload: bytes) -> float | None:
    """Returns the network time [s] in the header of a message; None if this kind of message has no time."""
    row = MESSAGES.get(kind_of(payload))
    if row is None or not row.has_time or len(payload) < HEADER.size:
        return None
    time = HEADER.unpack_from(payload)[4]
    return time if math.isfinite(time) else None


def shift_time(payload: bytes, shift: float) -> bytes:
    """Returns a message with ``shift`` [s] added to its time, or unchanged if this kind of message has no time."""
    time = time_of(payload)
    return (
        payload
        if time is None
        else payload[: HEADER.size - 8] + struct.pack("<d", time + shift) + payload[HEADER.size :]
    )


# ------------------------------------------------------------ JSON

_COMMON = {
    "actor": {"type": "string", "description": "whose message it is"},
    "raw": {"type": "string", "contentEncoding": "base64", "description": "the message as it crossed the network"},
    "error": {"type": "string", "description": "why raw is no message"},
}


def schema_of(key: str) -> tuple[str, bytes]:
    """Returns the name and the JSON schema of the messages under a key, for a recording."""
    name = key.partition("/")[0]
    family = family_of(key)
    fields: dict[str, Any] = {"live": YES} if name == "live" else {}
    for row in MESSAGES.values() if name in FAMILIES else ():
        if name in row.families and row.describe is not None:
            fields |= {"timestamp": TIME, **row.fields} if row.has_time else row.fields
    return family.schema, msgspec.json.encode(object_of(family.schema, family.purpose, **fields, **_COMMON))


def describe_message(key: str, payload: bytes) -> dict[str, Any]:
    """Returns the JSON object that describes a message in a recording.

    ``raw`` contains the bytes of the message in base64. For a message that cannot be decoded, ``error`` contains the
    reason instead of the content.
    """
    raw = base64.b64encode(payload).decode()
    actor = sender_of(key)
    if key.startswith("live/"):
        return {"actor": actor, "live": bool(payload), "raw": raw}
    try:
        row = MESSAGES.get(kind_of(payload))
        if row is None or row.describe is None:
            return {"actor": actor, "raw": raw}
        described = row.describe(payload, key)
        time = time_of(payload)
        return {"actor": actor, **({} if time is None else {"timestamp": stamp(time)}), **described, "raw": raw}
    except ValueError as error:  # also raised for a key without a cell
        return {"actor": actor, "error": str(error), "raw": raw}


# ------------------------------------------------------------ counters


@dataclasses.dataclass(slots=True)
class Traffic:
    """Number of messages and of payload bytes that were received and sent, for one of the groups in
    :class:`Counters`."""

    messages_in: int = 0
    bytes_in: int = 0
    messages_out: int = 0
    bytes_out: int = 0

    def count_in(self, payload: bytes) -> None:
        """Count a received message."""
        self.messages_in += 1
        self.bytes_in += len(payload)

    def count_out(self, payload: bytes) -> None:
        """Count a sent message."""
        self.messages_out += 1
        self.bytes_out += len(payload)


@dataclasses.dataclass(slots=True)
class Counters:
    """Counters of one client's traffic and of messages that were rejected or lost."""

    actor: Traffic = dataclasses.field(default_factory=Traffic)
    """Poses of robots and humans."""
    environment: Traffic = dataclasses.field(default_factory=Traffic)
    """States of moving trees, boxes and free bunches."""
    event: Traffic = dataclasses.field(default_factory=Traffic)
    """Claims, corrections and states at rest."""
    retained: Traffic = dataclasses.field(default_factory=Traffic)
    """Retained records. They are sent even if no peer is near, because the server keeps them."""
    force: Traffic = dataclasses.field(default_factory=Traffic)
    """Wrenches of people's hands on robots of other clients, and couplings (virtual springs) of two actors to one
    tree."""
    voice: Traffic = dataclasses.field(default_factory=Traffic)
    """Frames of sound: voices, and loudspeakers of robots."""
    control: Traffic = dataclasses.field(default_factory=Traffic)
    """Hellos, clock replies and snapshots (received only)."""
    malformed: int = 0
    """Number of messages that could not be decoded."""
    dropped: int = 0
    """Number of valid messages and states that were not used, because they were outdated, from an unknown peer, about
    an object too far away, or because a greater claim on the object is known."""
    wrenches_refused: int = 0
    """Number of refused wrenches of peers: their hands do not reach the link, or the link does not exist."""
    wrenches_limited: int = 0
    """Number of messages and steps in which wrenches were reduced to what hands can exert."""

    couplings_refused: int = 0
    """Number of refused couplings (virtual springs that peers send for their contacts with trees): neither side owns
    the tree, or the peer's arms do not reach it."""

    foreign: int = 0
    """Number of messages and replies that the bus dropped because their key contains the name of an actor and they come
    from another session than the actor's."""
    lost: int = 0
    """Number of received samples that the bus discarded because its store was full or the sample too large."""
    network_failures: int = 0
    """Number of puts, declarations and queries that the network refused."""

    def of(self, family: str) -> Traffic:
        """Returns the counters for a family of keys, given by the first chunk of its keys."""
        return getattr(self, FAMILIES[family].traffic)

    def to_report(self) -> dict[str, Any]:
        """Returns all counters under the keys of ``report.json``, where :attr:`retained` is called ``fact``."""
        return {"fact" if name == "retained" else name: value for name, value in dataclasses.asdict(self).items()}
