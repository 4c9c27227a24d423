"""Every kind of network message, every family of keys, and the counters of both: one row for each.

:data:`MESSAGES` says for each kind under which keys it travels, and how a recording describes it. :data:`FAMILIES` says
for each family of keys whose keys they are, who may publish under them, and where they are counted and recorded. The
formats themselves stand in the modules beside this one: ``robot``, ``human``, ``trees``, ``objects``, ``forces`` and
``voice`` hold packed binary messages that travel many times a second; ``control`` and ``meshes`` hold the rare messages
in msgpack.
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
    """A kind of message."""

    kind: int
    """Fourth byte of the message."""
    families: tuple[str, ...]
    """First chunks of the keys under which it travels."""
    has_time: bool = False
    """Whether its header holds the network time [s] at which the content was sampled."""
    describe: Callable[[bytes, str], dict[str, Any]] | None = None
    """What a message under a key says, for JSON; raises ValueError if it cannot be decoded. None: not recorded."""
    fields: Mapping[str, Any] = {}
    """JSON schemas of what ``describe`` returns. Their text is part of the file format."""


_ROWS = (
    Message(robot.ROBOT, ("a",), True, human.describe_pose, human.POSE_FIELDS),
    Message(human.HUMAN, ("a",), True, human.describe_pose, human.POSE_FIELDS),
    Message(trees.TREES, ("tree", "near", "own"), True, trees.describe_trees, trees.TREES_FIELDS),
    Message(objects.OBJECTS, ("c",), True, objects.describe_objects, objects.OBJECTS_FIELDS),
    Message(control.CLAIMS, ("own",), False, control.describe_claims, control.CLAIMS_FIELDS),
    Message(control.RETAINED, ("fact", "snap"), False, control.describe_records, control.RECORDS_FIELDS),
    Message(forces.WRENCHES, ("force",), True, forces.describe_wrenches, forces.WRENCHES_FIELDS),
    Message(forces.COUPLINGS, ("force",), True, forces.describe_couplings, forces.COUPLINGS_FIELDS),
    Message(voice.VOICE, ("voice",), True),
    Message(control.HELLO, ("hello", "join"), False, control.describe_hello, control.HELLO_FIELDS),
    Message(control.WELCOME, ("join",)),
    Message(control.CLOCK, ("clock",)),
    Message(meshes.MESH_PART, ("mesh", "offer")),
    Message(meshes.MESH_REQUEST, ("mesh",)),
    Message(meshes.MESH_WANTED, ("offer",)),
)

MESSAGES = {row.kind: row for row in _ROWS}
"""By kind."""

assert len(MESSAGES) == len(_ROWS), "two kinds of messages have the same number"


class Family(NamedTuple):
    """Keys of a world, relative to its prefix, that begin with the same chunk; ``docs/network.md`` explains each."""

    keys: tuple[str, ...]
    """Patterns of all its keys: ``{actor}`` is the name of the actor that publishes, ``*`` any chunk."""
    traffic: str
    """Field of :class:`Counters` in which its messages are counted."""
    schema: str = "vinesim.Message"
    purpose: str = ""
    """Name and description of the JSON schema of its messages."""
    recorded_with: str = ""
    """Choice of ``vinesim record --only`` that records it; empty: none does, or the recorder asks for it always."""
    is_published: bool = True
    """Whether actors publish under it. If not, its messages reply to queries or are made by a recorder."""
    is_reliable: bool = False
    """Whether it is published in order and without loss."""
    by_spectators: bool = False
    """Whether spectators publish under it, too."""


FAMILIES = {
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
    "snap": Family(("snap/*/*",), "control", "vinesim.Facts", "What was true before.", is_published=False),
    "live": Family(
        ("live/{actor}", "live/{actor}/*"), "control", "vinesim.Live", "An actor came or went.", is_published=False
    ),
}
"""By first chunk: all families that are published or recorded."""

_OTHER = Family((), "event")


def family_of(key: str) -> Family:
    """The family of a key."""
    return FAMILIES.get(key.partition("/")[0], _OTHER)


_ACTOR_FIRST = frozenset(name for name, family in FAMILIES.items() if family.keys[0].startswith(f"{name}/{{actor}}"))

_OF_NO_ACTOR = frozenset(name for name, family in FAMILIES.items() if "{actor}" not in family.keys[0])


def sender_of(key: str) -> str:
    """Name of the actor that published under a key; empty for the server and for a key that names no actor."""
    family, *rest = key.split("/")
    if not rest or family in _OF_NO_ACTOR:
        return ""
    return rest[0] if family in _ACTOR_FIRST else rest[-1]


# ------------------------------------------------------------ times


def time_of(payload: bytes) -> float | None:
    """Network time [s] in the header of a message; None if its kind has none."""
    row = MESSAGES.get(kind_of(payload))
    if row is None or not row.has_time or len(payload) < HEADER.size:
        return None
    time = HEADER.unpack_from(payload)[4]
    return time if math.isfinite(time) else None


def shift_time(payload: bytes, shift: float) -> bytes:
    """Copy of a message with ``shift`` [s] added to its time; the message itself if its kind has no time."""
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
    """Name and JSON schema of the messages under a key."""
    name = key.partition("/")[0]
    family = family_of(key)
    fields: dict[str, Any] = {"live": YES} if name == "live" else {}
    for row in MESSAGES.values() if name in FAMILIES else ():
        if name in row.families and row.describe is not None:
            fields |= {"timestamp": TIME, **row.fields} if row.has_time else row.fields
    return family.schema, msgspec.json.encode(object_of(family.schema, family.purpose, **fields, **_COMMON))


def describe_message(key: str, payload: bytes) -> dict[str, Any]:
    """The JSON object of one message, with its bytes in base64 under ``raw``; of undecodable bytes only those and the
    error."""
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
    except ValueError as error:  # a key that names no cell among them
        return {"actor": actor, "error": str(error), "raw": raw}


# ------------------------------------------------------------ counters


@dataclasses.dataclass(slots=True)
class Traffic:
    """Messages and payload bytes of one family of keys, each way."""

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
    """Traffic by family, and rejected messages."""

    actor: Traffic = dataclasses.field(default_factory=Traffic)
    """Poses of robots and humans."""
    environment: Traffic = dataclasses.field(default_factory=Traffic)
    """States of moving trees, boxes and free bunches."""
    event: Traffic = dataclasses.field(default_factory=Traffic)
    """Claims, corrections and states at rest."""
    retained: Traffic = dataclasses.field(default_factory=Traffic)
    """Retained records: these leave even if no peer is near, because the server keeps them."""
    force: Traffic = dataclasses.field(default_factory=Traffic)
    """Wrenches of hands on robots of other clients, and couplings of two actors to one tree."""
    voice: Traffic = dataclasses.field(default_factory=Traffic)
    """Frames of sound."""
    control: Traffic = dataclasses.field(default_factory=Traffic)
    """Hellos, clock replies and snapshots (received only)."""
    malformed: int = 0
    """Messages that could not be decoded."""
    dropped: int = 0
    """Valid messages and states that were not used: outdated, of an unknown peer, too far away, or of a lesser claim.
    """
    wrenches_refused: int = 0
    """Wrenches of peers on links that their hands do not reach, or that there are not."""
    wrenches_limited: int = 0
    """Messages and steps whose wrenches were reduced to what hands can do."""

    couplings_refused: int = 0
    """Couplings of peers to trees that neither side owns, or that their arms do not reach."""

    foreign: int = 0
    """Messages and answers that the bus dropped: of a session that does not hold the name they came under."""
    lost: int = 0
    """Received samples that the bus discarded: its store was full, or the sample too large."""
    network_failures: int = 0
    """Puts, declarations and queries of the bus that the network refused."""

    def of(self, family: str) -> Traffic:
        """Traffic of a family of keys."""
        return getattr(self, FAMILIES[family].traffic)

    def to_report(self) -> dict[str, Any]:
        """All counters under the keys of ``report.json``, where retained records are called ``fact``."""
        return {"fact" if name == "retained" else name: value for name, value in dataclasses.asdict(self).items()}
