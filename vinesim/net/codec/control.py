"""Wire formats of rare messages, in msgpack: hello, welcome, claims, retained records, clock."""

from __future__ import annotations

import hashlib
import itertools
import math
from typing import Any, NamedTuple

import msgspec
import numpy as np

from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.net.codec.header import (
    MAGIC,
    MAX_COORDINATE,
    MAX_MESSAGE,
    PROTOCOL,
    MessageError,
    WrongVersion,
    is_valid_name,
    kind_of,
)
from vinesim.net.codec.json_values import COUNT, NUMBER, POSE, TEXT, THING, YES, list_of, named, object_of, pose_value
from vinesim.net.codec.objects import check_object_id
from vinesim.net.codec.trees import MAX_BODIES, MAX_TREES
from vinesim.net.codec.wood import decode_wood
from vinesim.net.pace import MIN_FACTOR, PaceReport
from vinesim.net.replication.authority import Claim
from vinesim.scene.ids import FIXED_PIECES, LABEL_STRIDE
from vinesim.scene.robot_limits import MAX_JOINTS, urdf_objection
from vinesim.scene.triangles import is_digest

CLAIMS = 3
RETAINED = 4
HELLO = 16
CLOCK = 17
WELCOME = 18
DESCRIPTION = 22
"""Numbers of the kinds of messages in this module. The fourth byte of a message is the number of its kind."""

MAX_RECORDS = 4096
"""Largest number of retained records in one message."""

MAX_PASSED = 64
"""Largest number of trees through which a bunch passes by its record. The record names the first ones."""

MAX_CAUSE = 120
"""Largest number of letters in the text that names what limits the real-time factor of a world."""

HEIGHT_RANGE = (1.0, 2.5)
"""Smallest and largest height of a person [m]. GUESSED."""

MAX_SEED = (1 << 63) - 1
"""Largest seed of a scene."""

ACTOR_KINDS = ("robot", "human", "spectator")
"""Values of :attr:`Hello.kind`."""


class Hello(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Self-description of an actor, sent to the server and to every peer.

    :attr:`urdf` and :attr:`sidecar` are not sent with it. Only clients that give the robot a body ask for them, by
    :attr:`robot_digest`, once for all robots that have the same (:func:`encode_description`).
    """

    name: str
    """Name of the actor, unique in its world: see :func:`vinesim.net.codec.header.is_valid_name`."""
    kind: str = "robot"
    """``robot``, ``human`` or ``spectator``."""
    robot: str = ""
    """Name of the robot description."""
    urdf: str = ""
    """The URDF as text."""
    sidecar: str = ""
    """Properties of the robot that a URDF cannot express, as JSON: see
    :func:`vinesim.robot.description.sidecar.encode_sidecar`."""
    scene: str = ""
    """Name of the actor's scene."""
    digest: str = ""
    """``Model.digest()`` of the actor's scene. Clients whose digests are equal use equal object ids."""
    protocol: int = PROTOCOL
    index: int = 0
    """Instance index of the actor in label images, below :data:`vinesim.scene.ids.LABEL_STRIDE`."""
    joints: int = -1
    """Number of joints in the actor's poses, at most :data:`MAX_JOINTS`; -1: as many as its first pose has."""
    seed: int = -1
    """Seed from which the actor's scene was generated, so that others can generate an equal one; -1: not given."""
    height: float = 1.75
    """Height of a person [m], in :data:`HEIGHT_RANGE`."""
    outfit: str = ""
    """Name of the outfit that a person has chosen; empty: the outfit is derived from the person's name."""
    robot_digest: str = ""
    """Digest of URDF and sidecar, by :func:`description_digest`; empty: the actor has none."""


class Welcome(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The server's reply to a :class:`Hello`."""

    refused: str = ""
    """Reason why the actor is not admitted, and the remedy; empty if it is admitted."""
    scene: str = ""
    """Name of the world's scene."""
    digest: str = ""
    """``Model.digest()`` of the world's scene."""
    spectators_speak_to: SpectatorsSpeakTo = SpectatorsSpeakTo.PEOPLE
    """Actors that hear spectators in this world."""
    protocol: int = PROTOCOL


class RetainedRecord(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Lasting state of one object: a pose at rest, or which bodies were cut off a tree. Stays valid when its author
    leaves.

    Records are sent once, reliably. For clients that join later, the server keeps the record with the greatest claim of
    each object (:mod:`vinesim.net.replication.retained`). On the wire a record is an array without field names.
    """

    object: int
    """Id of the object, by :func:`vinesim.scene.ids.object_id`."""
    ownership: int
    authority: int
    """Ownership and authority sequence (u16) of the author's :class:`~vinesim.net.replication.authority.Claim` on the
    object when the record was published."""
    author: str
    pose: tuple[float, float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    """Pose of a bunch or a box in the frame of ``parent``: position [m], quaternion xyzw."""
    parent: str = ""
    """Frame of ``pose``: a box as ``box/3``, or a robot's link as ``actor/link``; empty: the world."""
    cut: tuple[int, ...] = ()
    """Bodies of the tree that were cut off their parents, in increasing order."""
    trees: bytes = b""
    """State of the tree, encoded by :func:`vinesim.net.codec.trees.encode_trees`; empty for other objects."""
    moving: bool = False
    """Whether the object was falling or carried when the record was published. Clients nearby then receive its
    states."""
    place: tuple[float, float, float, float, float, float, float] | None = None
    """For an object that rests on a link of a robot: pose in the world when the record was published, position [m] and
    quaternion xyzw. Clients use this pose if the robot has left."""
    stalk: tuple[int, int] | None = None
    """For a bunch that was cut in its peduncle: body of the segment in which it was cut, and place of the cut along it
    [0.1 mm]."""
    stumps: tuple[tuple[int, int, int], ...] = ()
    """Stumps that cuts of the tree's canes have left, in increasing order: body of the stump, segment that was cut, and
    place of the cut along it [0.1 mm]."""
    wood: bytes = b""
    """For a tree that has changed for good, besides cuts: encoded by :func:`vinesim.net.codec.wood.encode_wood`."""
    fruit: tuple[float, float] | None = None
    """For a bunch that was handled: expected numbers of its berries that burst and that were lost."""
    passed: tuple[int, ...] = ()
    """For a bunch that was picked where it overlapped plants, and has overlapped them since: the trees through which it
    passes, in increasing order, before them :data:`vinesim.scene.ids.FIXED_PIECES`; at most :data:`MAX_PASSED`."""

    @property
    def claim(self) -> Claim:
        """The claim that orders the records of one object: the record with the greatest claim is valid."""
        return Claim(self.ownership, self.authority, self.author)


def pack(kind: int, value: Any) -> bytes:
    """Encode a value in msgpack as a message of this ``kind``."""
    return MAGIC + bytes((PROTOCOL, kind)) + _encoder.encode(value)


def unpack(payload: bytes, kind: int, name: str, decoder: msgspec.msgpack.Decoder) -> Any:
    """Decode a message in msgpack. ``name``: what to call the message in errors.

    Raises :class:`MessageError` if the message is of another ``kind`` or cannot be decoded.
    """
    if (found := kind_of(payload)) != kind:
        raise MessageError(f"message of kind {found} where {name} (kind {kind}) was expected")
    try:
        return decoder.decode(payload[4:])
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise MessageError(f"{name}: {error}") from error


def encode_hello(hello: Hello) -> bytes:
    """Encode a hello without its URDF and sidecar, whose digest it contains.

    Raises :class:`MessageError` if its name cannot be part of a key or a number is out of its range.
    """
    if not is_valid_name(hello.name):
        raise MessageError(f"actor name {hello.name!r}: use 1 to 48 letters, digits, '_', '-' or '.'")
    if hello.urdf or hello.sidecar:
        digest = description_digest(encode_description(hello))
        hello = msgspec.structs.replace(hello, urdf="", sidecar="", robot_digest=digest)
    _check_hello(hello)
    return pack(HELLO, hello)


def decode_hello(payload: bytes) -> Hello:
    """Decode a hello. Raises :class:`WrongVersion` for another protocol version, and :class:`MessageError` if the hello
    is invalid."""
    hello = unpack(payload, HELLO, "greeting", _hello_decoder)
    if not is_valid_name(hello.name):
        raise MessageError(f"greeting of an actor named {hello.name[:60]!r}")
    if hello.protocol != PROTOCOL:
        raise WrongVersion(hello.protocol)
    if hello.urdf or hello.sidecar:
        raise MessageError(f"greeting of {hello.name!r} with a URDF: only the reply to a query has it")
    _check_hello(hello)
    return hello


def encode_description(hello: Hello) -> bytes:
    """Encode URDF and sidecar of a robot. Raises :class:`MessageError` if they exceed a limit."""
    payload = pack(DESCRIPTION, (hello.urdf, hello.sidecar))
    if len(payload) > MAX_MESSAGE:
        raise MessageError(f"description of {len(payload)} B, at most {MAX_MESSAGE} B: the URDF is too long")
    if objection := urdf_objection(hello.urdf):
        raise MessageError(f"description of {hello.name!r}: {objection}")
    return payload


def description_digest(payload: bytes) -> str:
    """Returns the digest of an encoded description: BLAKE2b of 160 bits in hexadecimal, without the first 4 bytes,
    which contain the version."""
    return hashlib.blake2b(payload[4:], digest_size=20).hexdigest()


class Description(NamedTuple):
    """What a hello names by its digest only."""

    urdf: str
    sidecar: str

    def complete(self, hello: Hello) -> Hello:
        """Returns a hello with this URDF and sidecar."""
        return msgspec.structs.replace(hello, urdf=self.urdf, sidecar=self.sidecar)


def decode_description(payload: bytes, digest: str) -> Description:
    """Decode URDF and sidecar of a robot. Raises :class:`MessageError` if the message is invalid or has another
    ``digest``."""
    urdf, sidecar = unpack(payload, DESCRIPTION, "description", _description_decoder)
    if (found := description_digest(payload)) != digest:
        raise MessageError(f"description with the digest {found[:8]}, the greeting announced {digest[:8]!r}")
    if objection := urdf_objection(urdf):
        raise MessageError(f"description {digest[:8]}: {objection}")
    return Description(urdf, sidecar)


def _check_hello(hello: Hello) -> None:
    """Raise :class:`MessageError` unless the kind of actor exists, the outfit is a name, the digest is one, and each
    number is in its range."""
    if hello.kind not in ACTOR_KINDS:
        raise MessageError(f"greeting of {hello.name!r} with kind {hello.kind[:60]!r}, not {', '.join(ACTOR_KINDS)}")
    if hello.outfit and not is_valid_name(hello.outfit):
        raise MessageError(
            f"greeting of {hello.name!r} with outfit {hello.outfit[:60]!r}: give 1 to 48 letters, digits, '_', '-', '.'"
        )
    for what, value, low, high in (
        ("index", hello.index, 0, LABEL_STRIDE - 1),
        ("joints", hello.joints, -1, MAX_JOINTS),
        ("seed", hello.seed, -1, MAX_SEED),
        ("height", hello.height, *HEIGHT_RANGE),
    ):
        if not low <= value <= high:
            raise MessageError(f"greeting of {hello.name!r} with {what} {value}, not from {low} to {high}")
    if hello.robot_digest and not is_digest(hello.robot_digest):
        raise MessageError(f"greeting of {hello.name!r} with the digest {hello.robot_digest[:60]!r}")


def encode_welcome(welcome: Welcome) -> bytes:
    """Encode a welcome."""
    return pack(WELCOME, welcome)


def decode_welcome(payload: bytes) -> Welcome:
    """Decode a welcome. Raises :class:`WrongVersion` if the server has another protocol version."""
    return unpack(payload, WELCOME, "welcome", _welcome_decoder)


def encode_claims(claims: list[tuple[int, Claim, bool]]) -> bytes:
    """Encode claims, each given as (object id, claim, whether the owner is in contact with the object)."""
    return pack(CLAIMS, [(int(object_id), *claim, touching) for object_id, claim, touching in claims])


def decode_claims(payload: bytes, counts: tuple[int, ...] | None = None) -> list[tuple[int, Claim, bool]]:
    """Decode claims: (object id, claim, whether the owner is in contact with the object).

    Checks each object id, sequence number (u16) and owner name. ``counts``: number of objects of each kind in the
    scene; None: unknown.
    """
    rows = unpack(payload, CLAIMS, "claims", _claims_decoder)
    if len(rows) > MAX_TREES:
        raise MessageError(f"{len(rows)} claims in one message, at most {MAX_TREES}")
    for object_id, ownership, authority, owner, _ in rows:
        check_object_id(object_id, counts)
        if not (0 <= ownership < 1 << 16 and 0 <= authority < 1 << 16) or (owner and not is_valid_name(owner)):
            raise MessageError(f"claim ({ownership}, {authority}, {owner[:60]!r}) on object {object_id} is impossible")
    return [
        (object_id, Claim(ownership, authority, owner), touching)
        for object_id, ownership, authority, owner, touching in rows
    ]


def encode_records(records: list[RetainedRecord]) -> bytes:
    """Encode retained records."""
    return pack(RETAINED, records)


def decode_records(payload: bytes, counts: tuple[int, ...] | None = None) -> list[RetainedRecord]:
    """Decode retained records and check ids, sequences, names, poses and sizes.

    ``counts``: number of objects of each kind in the scene; None: unknown. Whether the states of trees fit the model is
    not checked here.
    """
    records = unpack(payload, RETAINED, "retained records", _records_decoder)
    if len(records) > MAX_RECORDS:
        raise MessageError(f"{len(records)} records in one message, at most {MAX_RECORDS}")
    for record in records:
        check_object_id(record.object, counts)
        if not (0 <= record.ownership < 1 << 16 and 0 <= record.authority < 1 << 16 and is_valid_name(record.author)):
            raise MessageError(f"record by {record.author[:60]!r} with claim ({record.ownership}, {record.authority})")
        for pose in (record.pose, record.place or record.pose):
            if not all(-MAX_COORDINATE < number < MAX_COORDINATE for number in pose):
                raise MessageError(f"record of object {record.object} at {pose}, not finite or too far away")
            if not 0.95 < math.hypot(*pose[3:]) < 1.05:
                raise MessageError(f"record of object {record.object} with orientation {pose[3:]}, no unit quaternion")
        if len(record.parent) > 200 or len(record.cut) > MAX_BODIES or any(body < 0 for body in record.cut):
            raise MessageError(f"record of object {record.object} with an impossible parent or list of cut bodies")
        if record.stalk is not None and not (record.stalk[0] >= 0 and 0 < record.stalk[1] < 1 << 16):
            raise MessageError(f"record of object {record.object} with an impossible stalk {record.stalk}")
        if len(record.stumps) > MAX_BODIES or any(
            body < 0 or segment < 0 or not 0 < place < 1 << 16 for body, segment, place in record.stumps
        ):
            raise MessageError(f"record of object {record.object} with impossible stumps {record.stumps[:4]}")
        if record.wood:
            decode_wood(record.wood)
        if record.fruit is not None and not all(0.0 <= number < 1e5 for number in record.fruit):
            raise MessageError(f"record of object {record.object} with an impossible number of berries {record.fruit}")
        if len(record.passed) > MAX_PASSED or not _increases((FIXED_PIECES - 1, *record.passed)):
            raise MessageError(f"record of object {record.object} with impossible passed trees {record.passed[:4]}")
    return records


def _increases(numbers: tuple[int, ...]) -> bool:
    """Returns whether each number is greater than the one before it."""
    return all(one < two for one, two in itertools.pairwise(numbers))


class ClockMessage(NamedTuple):
    """A query for the time of the world, or the server's reply to it."""

    asked: float
    """Real time of the client's clock when it sent the query [s]; the reply repeats it."""
    world: float = 0.0
    """Time of the world when the server replied [s]."""
    factor: float = 1.0
    """Real-time factor of the world when the server replied."""
    real: float = 0.0
    """Real time of the server's clock when it replied [s]."""
    cause: str = ""
    """Text that names what limits the factor, like "picker: sensors"; empty if nothing limits it."""
    report: PaceReport | None = None
    """In a query: how fast the client can simulate. None if the client does not simulate, and in replies."""


def encode_time(
    asked: float,
    world: float = 0.0,
    factor: float = 1.0,
    real: float | None = None,
    cause: str = "",
    report: PaceReport | None = None,
) -> bytes:
    """Encode the fields of a :class:`ClockMessage`. ``real`` is by default equal to ``world``, as in a world that runs
    in real time."""
    real = world if real is None else real
    return pack(
        CLOCK,
        (float(asked), float(world), float(factor), float(real), cause[:MAX_CAUSE], report and _plain(report)),
    )


def _plain(report: PaceReport) -> tuple[float, float, str]:
    """Returns a report as built-in values that msgpack can encode."""
    return float(report.time), float(report.factor), report.cause[:MAX_CAUSE]


def decode_time(payload: bytes) -> ClockMessage:
    """Decode a query of the clock or a reply. Raises :class:`MessageError` unless all numbers are finite and in
    range."""
    asked, world, factor, real, cause, report = unpack(payload, CLOCK, "clock", _time_decoder)
    if not all(map(math.isfinite, (asked, world, real, *(report or ())[:2]))):
        raise MessageError(f"clock message ({asked}, {world}, {real}) that is not finite")
    if not MIN_FACTOR <= factor <= 1.0:
        raise MessageError(f"clock message with the real-time factor {factor}, from {MIN_FACTOR:g} to 1")
    if report is not None and report[1] < 0.0:
        raise MessageError(f"clock message with the report of a real-time factor of {report[1]}, which is below 0")
    if max(len(cause), len(report[2]) if report else 0) > MAX_CAUSE:
        raise MessageError(f"clock message with a cause of more than {MAX_CAUSE} letters")
    return ClockMessage(asked, world, factor, real, cause, None if report is None else PaceReport(*report))


HELLO_FIELDS = {
    "name": TEXT,
    "kind": TEXT,
    "robot": TEXT,
    "robot_digest": TEXT,
    "scene": TEXT,
    "digest": TEXT,
    "seed": COUNT,
    "protocol": COUNT,
    "index": COUNT,
    "joints": COUNT,
    "height": NUMBER,
    "outfit": TEXT,
}
"""JSON schema of what :func:`describe_hello` returns."""


def describe_hello(payload: bytes, _: str) -> dict[str, Any]:
    """Decode a hello for the JSON of a recording."""
    hello = decode_hello(payload)
    return {name: getattr(hello, name) for name in HELLO_FIELDS}


DESCRIPTION_FIELDS = {"digest": TEXT, "urdf": TEXT, "sidecar": TEXT}
"""JSON schema of what :func:`describe_description` returns."""


def describe_description(payload: bytes, _: str) -> dict[str, Any]:
    """Decode the description of a robot for the JSON of a recording."""
    digest = description_digest(payload)
    return {"digest": digest, **decode_description(payload, digest)._asdict()}


CLAIMS_FIELDS = {"claims": list_of(object_of("claim", "who says to own a thing", owner=TEXT, touched=YES, **THING))}
"""JSON schema of what :func:`describe_claims` returns."""


def describe_claims(payload: bytes, _: str) -> dict[str, Any]:
    """Decode claims for the JSON of a recording."""
    return {
        "claims": [
            {
                **named(object_id),
                "ownership": claim.ownership,
                "authority": claim.authority,
                "owner": claim.owner,
                "touched": touching,
            }
            for object_id, claim, touching in decode_claims(payload)
        ]
    }


RECORDS_FIELDS = {
    "facts": list_of(
        object_of(
            "fact", "what stays true", author=TEXT, parent=TEXT, moving=YES, pose=POSE, cut=list_of(COUNT), **THING
        )
    )
}
"""JSON schema of what :func:`describe_records` returns."""


def describe_records(payload: bytes, _: str) -> dict[str, Any]:
    """Decode retained records for the JSON of a recording."""
    return {
        "facts": [
            {
                **named(record.object),
                "ownership": record.ownership,
                "authority": record.authority,
                "author": record.author,
                "moving": record.moving,
                "pose": pose_value(np.array(record.pose)),
                "parent": record.parent,
                "cut": list(record.cut),
            }
            for record in decode_records(payload)
        ]
    }


_encoder = msgspec.msgpack.Encoder()

_hello_decoder = msgspec.msgpack.Decoder(Hello)

_description_decoder = msgspec.msgpack.Decoder(tuple[str, str])

_welcome_decoder = msgspec.msgpack.Decoder(Welcome)

_claims_decoder = msgspec.msgpack.Decoder(list[tuple[int, int, int, str, bool]])

_records_decoder = msgspec.msgpack.Decoder(list[RetainedRecord])

_time_decoder = msgspec.msgpack.Decoder(tuple[float, float, float, float, str, tuple[float, float, str] | None])
