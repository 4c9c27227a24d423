"""Recordings: what crossed the network of a world, in an MCAP file that any MCAP reader opens.

One channel per key. Every message is a JSON object: what the message says in words and numbers, for people and their
tools (poses carry the fields of ``foxglove.PoseInFrame``), and in ``raw`` the very bytes that crossed, for replays.
Log time is the network time at which the recorder had it [ns], publish time the one its author wrote on it.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import dataclasses
import os
import pathlib
import queue
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
from mcap.exceptions import EndOfFile, InvalidMagic
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from vinesim import __version__
from vinesim.net.codec import messages
from vinesim.net.codec.human import decode_pose
from vinesim.net.codec.messages import MessageError
from vinesim.net.codec.wrenches import decode_wrenches
from vinesim.scene.ids import ObjectKind, split_object_id
from vinesim.scene.values import POINT_NAMES, HumanUpdate

FLUSH_PERIOD = 0.5
"""What was recorded is in the hands of the operating system after this time [s], and on the disk: a recorder that is
killed loses no more."""

METADATA_NAME = "vinesim"
"""Name of the metadata record that says what was recorded; of several the last one holds."""

MAX_RECORD_LENGTH = 1 << 26
"""No record of a recording is larger [B]."""


class InvalidRecording(ValueError):
    """A file that cannot be replayed; the text says why."""


class RecordingStopped(RuntimeError):
    """Nothing more can be written; the text says why, and what was kept."""

    exit_code = 4


class RecordedMessage(NamedTuple):
    """One message of a recording."""

    time: float
    """Network time [s] at which the recorder had it."""
    key: str
    payload: bytes


# ---------------------------------------------------------------- what a message says


def _stamp(seconds: float) -> dict[str, int]:
    nanoseconds = round(seconds * 1e9)
    return {"sec": nanoseconds // 1_000_000_000, "nsec": nanoseconds % 1_000_000_000}


def _pose(pose: np.ndarray) -> dict[str, dict[str, float]]:
    x, y, z, qx, qy, qz, qw = pose.tolist()
    return {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": qx, "y": qy, "z": qz, "w": qw}}


def _named(thing: int) -> dict[str, Any]:
    kind, index = split_object_id(thing)
    return {"kind": kind.name.lower(), "index": index}


def _describe_pose(payload: bytes, key: str) -> dict[str, Any]:
    update = decode_pose(payload, sender_of(key))
    here = {"timestamp": _stamp(update.time), "frame_id": "map", "pose": _pose(update.base_q)}
    if isinstance(update, HumanUpdate):
        return here | {"points": {name: _pose(at) for name, at in zip(POINT_NAMES, update.pose.points, strict=True)}}
    return here | {
        "velocity": update.base_qd.tolist(),
        "joint_position": update.position.tolist(),
        "joint_velocity": update.velocity.tolist(),
    }


def _describe_trees(payload: bytes, _: str) -> dict[str, Any]:
    trees = messages.decode_trees(payload)
    columns = (trees.tree, trees.ownership, trees.authority, trees.flags, trees.bodies)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return {
        "timestamp": _stamp(trees.time),
        "trees": [
            {
                "tree": tree, "ownership": ownership, "authority": authority, "bodies": bodies,
                "touched": bool(flags & messages.TOUCHED), "resting": bool(flags & messages.RESTING),
            }
            for tree, ownership, authority, flags, bodies in rows
        ],
    }  # fmt: skip


def _describe_objects(payload: bytes, key: str) -> dict[str, Any]:
    _, x, y, _ = key.split("/")
    things = messages.decode_objects(payload, (int(x), int(y)))
    return {
        "timestamp": _stamp(things.time),
        "things": [
            {
                **_named(update.object), "ownership": update.ownership, "authority": update.authority,
                "touched": bool(flags & messages.TOUCHED), "pose": _pose(update.pose),
                "velocity": update.velocity.tolist(),
            }
            for update, flags in zip(things.updates(sender_of(key)), things.flags.tolist(), strict=True)
        ],
    }  # fmt: skip


def _describe_claims(payload: bytes, _: str) -> dict[str, Any]:
    return {
        "claims": [
            {
                **_named(thing), "ownership": claim.ownership, "authority": claim.authority, "owner": claim.owner,
                "touched": touching,
            }
            for thing, claim, touching in messages.decode_claims(payload)
        ]
    }  # fmt: skip


def _describe_records(payload: bytes, _: str) -> dict[str, Any]:
    return {
        "facts": [
            {
                **_named(fact.object), "ownership": fact.ownership, "authority": fact.authority, "author": fact.author,
                "moving": fact.moving, "pose": _pose(np.array(fact.pose)), "parent": fact.parent,
                "cut": list(fact.cut),
            }
            for fact in messages.decode_records(payload)
        ]
    }  # fmt: skip


def _describe_wrenches(payload: bytes, _: str) -> dict[str, Any]:
    push = decode_wrenches(payload)
    return {
        "timestamp": _stamp(push.time),
        "links": [{"link": link, "wrench": wrench.tolist()} for link, wrench in sorted(push.wrenches.items())],
    }


def _describe_hello(payload: bytes, _: str) -> dict[str, Any]:
    return msgspec.to_builtins(messages.decode_hello(payload))


_DESCRIBE: dict[int, Callable[[bytes, str], dict[str, Any]]] = {
    messages.MessageKind.ROBOT: _describe_pose,
    messages.MessageKind.TREES: _describe_trees,
    messages.MessageKind.CLAIMS: _describe_claims,
    messages.MessageKind.RETAINED: _describe_records,
    messages.MessageKind.OBJECTS: _describe_objects,
    messages.MessageKind.HUMAN: _describe_pose,
    messages.MessageKind.WRENCHES: _describe_wrenches,
    messages.MessageKind.HELLO: _describe_hello,
}


def sender_of(key: str) -> str:
    """Whose message it is: the name that a key carries; nobody's if it is the server's."""
    chunks = key.split("/")
    return "" if chunks[0] == "snap" else chunks[1] if chunks[0] in ("a", "hello", "live") else chunks[-1]


def describe_message(key: str, payload: bytes) -> dict[str, Any]:
    """The JSON object of one message; of bytes that are no message, only those bytes and why."""
    raw = base64.b64encode(payload).decode()
    if key.startswith("live/"):
        return {"actor": sender_of(key), "live": bool(payload), "raw": raw}
    try:
        say = _DESCRIBE.get(messages.kind_of(payload))
        return {"actor": sender_of(key), **(say(payload, key) if say is not None else {}), "raw": raw}
    except ValueError as error:  # a key that names no cell among them
        return {"actor": sender_of(key), "error": str(error), "raw": raw}


# ---------------------------------------------------------------- schemas


def _object(title: str, description: str, **properties: Any) -> dict[str, Any]:
    return {"type": "object", "title": title, "description": description, "properties": properties}


def _list(items: Any) -> dict[str, Any]:
    return {"type": "array", "items": items}


_NUMBER, _COUNT, _TEXT, _YES = ({"type": kind} for kind in ("number", "integer", "string", "boolean"))
_TIME = _object("time", "network time", sec=_COUNT, nsec=_COUNT)
_CLAIM = {"ownership": _COUNT, "authority": _COUNT}
_THING = {"kind": {"type": "string", "enum": [kind.name.lower() for kind in ObjectKind]}, "index": _COUNT, **_CLAIM}
_XYZ = _object("position", "m, world axes", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_XYZW = _object("orientation", "unit quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_COMMON = {
    "actor": {"type": "string", "description": "whose message it is"},
    "raw": {"type": "string", "contentEncoding": "base64", "description": "the message as it crossed the network"},
    "error": {"type": "string", "description": "why raw is no message"},
}
_POSE = _object("pose", "in the world, of a fact in its parent's frame", position=_XYZ, orientation=_XYZW)
_TREES = _list(_object("tree", "one record", tree=_COUNT, bodies=_COUNT, touched=_YES, resting=_YES, **_CLAIM))
_THINGS = _list(_object("thing", "a box or a loose bunch", touched=_YES, pose=_POSE, velocity=_list(_NUMBER), **_THING))
_LINKS = _list(
    _object(
        "link", "one that is pushed", link=_TEXT,
        wrench={**_list(_NUMBER), "description": "force [N], moment about its centre of mass [N m], world axes"},
    )
)  # fmt: skip
_CLAIMS = _list(_object("claim", "who says to own a thing", owner=_TEXT, touched=_YES, **_THING))
_FACTS = _list(
    _object(
        "fact", "what stays true", author=_TEXT, parent=_TEXT, moving=_YES, pose=_POSE, cut=_list(_COUNT), **_THING,
    )
)  # fmt: skip

_SCHEMAS: dict[str, tuple[str, dict[str, Any]]] = {
    "a": (
        "foxglove.PoseInFrame",
        _object(
            "foxglove.PoseInFrame", "Where an actor is, and its joints.", timestamp=_TIME, frame_id=_TEXT,
            pose=_POSE,
            velocity={**_list(_NUMBER), "description": "of its base: m/s, rad/s, world axes"},
            joint_position={**_list(_NUMBER), "description": "rad or m"},
            joint_velocity={**_list(_NUMBER), "description": "rad/s or m/s"},
            points=_object("points", "of a person", **dict.fromkeys(POINT_NAMES, _POSE)), **_COMMON,
        ),
    ),
    "c": (
        "vinesim.Moving",
        _object(
            "vinesim.Moving", "What an actor moves in a cell.", timestamp=_TIME, trees=_TREES, things=_THINGS, **_COMMON
        ),
    ),
    "own": (
        "vinesim.Event",
        _object(
            "vinesim.Event", "A claim, or what came to rest.", timestamp=_TIME, trees=_TREES, claims=_CLAIMS, **_COMMON
        ),
    ),
    "force": (
        "vinesim.Push",
        _object("vinesim.Push", "What an actor does to a robot.", timestamp=_TIME, links=_LINKS, **_COMMON),
    ),
    "fact": ("vinesim.Facts", _object("vinesim.Facts", "What stays true.", facts=_FACTS, **_COMMON)),
    "snap": ("vinesim.Facts", _object("vinesim.Facts", "What was true before.", facts=_FACTS, **_COMMON)),
    "hello": (
        "vinesim.Greeting",
        _object(
            "vinesim.Greeting", "How an actor introduced itself.", name=_TEXT, kind=_TEXT, robot=_TEXT, urdf=_TEXT,
            scene=_TEXT, digest=_TEXT, seed=_COUNT, protocol=_COUNT, index=_COUNT, joints=_COUNT, height=_NUMBER,
            **_COMMON,
        ),
    ),
    "live": ("vinesim.Live", _object("vinesim.Live", "An actor came or went.", live=_YES, **_COMMON)),
}  # fmt: skip


def _schema(key: str) -> tuple[str, bytes]:
    """Name and JSON schema of the messages under a key."""
    name, schema = _SCHEMAS.get(key.partition("/")[0], ("vinesim.Message", _object("vinesim.Message", "", **_COMMON)))
    return name, msgspec.json.encode(schema)


# ---------------------------------------------------------------- write


def free_path(path: pathlib.Path) -> pathlib.Path:
    """The path, or if there is such a file NAME-2, NAME-3 ... before its suffix: no recording is ever overwritten."""
    number, free = 1, path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


class RecordingWriter:
    """A file that grows: :meth:`put` takes no time, a thread writes. A context manager; :meth:`close` completes it."""

    def __init__(self, path: pathlib.Path, about: dict[str, str] | None = None) -> None:
        """A new file; :class:`RecordingStopped` if it cannot be made. ``about``: see :meth:`describe`."""
        self.path = path
        self.metadata = {"release": __version__, "protocol": str(messages.PROTOCOL)} | (about or {})
        """What is known of what is recorded: scene, seed, digest, ..."""
        self.count = 0
        """Messages taken."""
        self.size = 0
        """Bytes safely written."""
        self._work: queue.SimpleQueue[tuple[int, str, bytes] | dict[str, str] | None] = queue.SimpleQueue()
        self._trouble: RecordingStopped | None = None
        try:
            self._file = path.open("xb")
        except OSError as error:
            raise RecordingStopped(f"cannot record into {path}: {error.strerror}; choose another file") from error
        self._writer = Writer(self._file)
        self._channels: dict[str, int] = {}
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    def add_metadata(self, **about: str) -> None:
        """Say more of what is recorded."""
        self.metadata |= about
        self._work.put(dict(self.metadata))

    def put(self, at: int, key: str, payload: bytes) -> None:
        """Take a message that was there at network time ``at`` [ns]; raises what went wrong with the file."""
        self.check()
        self.count += 1
        self._work.put((at, key, payload))

    def check(self) -> None:
        """:class:`RecordingStopped` if nothing can be written any more."""
        if self._trouble is not None:
            raise self._trouble

    def close(self) -> None:
        """Write what is left and the index; the second time nothing happens. Raises what went wrong with the file."""
        if self._thread.is_alive():
            self._work.put(None)
            self._thread.join()
        self.check()

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        with contextlib.suppress(RecordingStopped) if kind is not None else contextlib.nullcontext():
            self.close()

    # ------------------------------------------------------------ the thread

    def _run(self) -> None:
        try:
            self._writer.start(library=f"vinesim {__version__}")
            self._write(dict(self.metadata))
            self._flush()
            due = time.monotonic() + FLUSH_PERIOD
            while True:
                with contextlib.suppress(queue.Empty):
                    work = self._work.get(timeout=max(due - time.monotonic(), 0.0))
                    if work is None:
                        break
                    self._write(work)
                if time.monotonic() >= due:
                    self._flush()
                    due = time.monotonic() + FLUSH_PERIOD
            self._flush()
            self._writer.finish()
            self._flush()
            self._file.close()
        except OSError as error:
            self._trouble = RecordingStopped(self._truncate(error))

    def _write(self, work: tuple[int, str, bytes] | dict[str, str]) -> None:
        if isinstance(work, dict):
            self._writer.add_metadata(METADATA_NAME, work)
            return
        at, key, payload = work
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = self._writer.register_channel(key, "json", self._schema_id(key))
        try:
            true_at = messages.time_of(payload)
        except MessageError:
            true_at = None
        published = at if true_at is None or not 0.0 <= true_at < 1e10 else round(true_at * 1e9)
        self._writer.add_message(channel, at, msgspec.json.encode(describe_message(key, payload)), published)

    def _schema_id(self, key: str) -> int:
        schema = _schema(key)
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(schema[0], "jsonschema", schema[1])
        return self._schemas[schema]

    def _flush(self) -> None:
        """Complete the chunk and see it onto the disk."""
        self._writer.flush()
        os.fsync(self._file.fileno())
        self.size = self._file.tell()

    def _truncate(self, error: OSError) -> str:
        """Leave the file as it was when it was last whole."""
        with contextlib.suppress(OSError):
            self._file.close()
        with contextlib.suppress(OSError):
            os.truncate(self.path, self.size)
        return (
            f"recording stopped, {self.path} cannot be written any more ({error.strerror}): "
            f"its {self.size} B stay readable; make room and record into another file"
        )


# ---------------------------------------------------------------- read


@dataclasses.dataclass(frozen=True)
class Recording:
    """A recording that was read."""

    path: pathlib.Path
    metadata: dict[str, str]
    """What the recorder knew: release, protocol, world, scene, seed, digest."""
    messages: list[RecordedMessage]
    """All messages, in order of time."""
    damage: str
    """Empty, or in one line why the file ends before its end; what lies before is all here."""

    @property
    def start(self) -> float:
        """Network time of the first message [s]."""
        return self.messages[0].time

    @property
    def length(self) -> float:
        """From the first message to the last [s]."""
        return self.messages[-1].time - self.start

    @property
    def actors(self) -> list[str]:
        """Who was there at any time, sorted."""
        return sorted({sender_of(entry.key) for entry in self.messages if entry.key.startswith("live/")})


def read(path: pathlib.Path) -> Recording:
    """A recording, as far as it is whole; :class:`NotARecording` if it is none or speaks another protocol."""
    about: dict[str, str] = {}
    entries: list[RecordedMessage] = []
    channels: dict[int, str] = {}
    damage = ""
    try:
        with path.open("rb") as file:
            try:
                for record in StreamReader(file, validate_crcs=True, record_size_limit=MAX_RECORD_LENGTH).records:
                    if isinstance(record, Metadata) and record.name == METADATA_NAME:
                        about |= record.metadata
                    elif isinstance(record, Channel):
                        channels[record.id] = record.topic
                    elif isinstance(record, Message):
                        entries.append(
                            RecordedMessage(record.log_time * 1e-9, channels[record.channel_id], _raw(record.data))
                        )
            except InvalidMagic:
                if file.tell() <= 8:
                    raise InvalidRecording(f"{path} is no MCAP file: give one that 'vinesim record' wrote") from None
                damage = "it is not whole"
            except EndOfFile:
                damage = "it ends in the middle"
            except OSError:
                raise
            except Exception as error:  # a damaged byte can break anything that reads it
                damage = f"it is damaged: {error}" if str(error) else "it is damaged"
    except OSError as error:
        raise InvalidRecording(
            f"cannot read {path}: {error.strerror}; give a file that 'vinesim record' wrote"
        ) from error
    if "protocol" not in about:
        raise InvalidRecording(f"{path} holds no recording of vinesim: {damage or 'another program wrote it'}")
    if about["protocol"] != str(messages.PROTOCOL):
        raise InvalidRecording(
            f"{path} speaks protocol version {about['protocol']}, this program version {messages.PROTOCOL}: "
            f"replay it with release {about.get('release', '?')} of vinesim, which recorded it"
        )
    entries.sort(key=lambda entry: entry.time)
    if damage:
        until = f"the {entries[-1].time - entries[0].time:.1f} s before" if entries else "nothing"
        damage = f"{path}: {damage} (was the recorder killed?); {until} can be read"
    return Recording(path, about, entries, damage)


def _raw(data: bytes) -> bytes:
    try:
        return base64.b64decode(_body.decode(data).raw, validate=True)
    except (msgspec.MsgspecError, binascii.Error) as error:
        raise ValueError(f"a message without its bytes ({error})") from error


class _Body(msgspec.Struct):
    raw: str


_body = msgspec.json.Decoder(_Body)
