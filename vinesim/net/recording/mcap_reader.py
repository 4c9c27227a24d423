"""Reads recordings, up to the first damage.

A recording is checked once from beginning to end. Then only times and places of its messages are in memory, 22 bytes
for each; their contents are unpacked from the file when they are needed, one chunk at a time.
"""

from __future__ import annotations

import array
import base64
import binascii
import collections
import dataclasses
import pathlib
import struct
from collections.abc import Iterator, Sequence
from typing import IO, NamedTuple, overload

import msgspec
import numpy as np
from mcap.exceptions import EndOfFile, InvalidMagic
from mcap.records import Channel, Chunk, Header, Message, Metadata, Statistics

from vinesim.core import mcap_chunks
from vinesim.net.codec.header import PROTOCOL
from vinesim.net.codec.messages import sender_of

METADATA_NAME = "vinesim"
"""Name of the MCAP metadata records that describe the recorded world. A later record replaces entries of earlier
ones."""

MAX_RECORD_LENGTH = 1 << 26
"""Largest size of an MCAP record that is read, and of what a chunk unpacks to [B]."""

MAX_RATIO = 200
"""Largest number of bytes to which a byte of a file is unpacked, on average. Recordings have 2 to 20."""
_FREE = 8 << 20
"""Number of bytes that may be unpacked at any ratio."""
_OPEN_CHUNKS = 2
"""Number of unpacked chunks that are kept in memory."""
_OUTSIDE = (1 << 32) - 1
"""Stands for the place in its chunk of a message that is in no chunk."""


class InvalidRecording(ValueError):
    """A file cannot be replayed as a recording. The text gives the reason and what to do."""


class RecordedMessage(NamedTuple):
    """One network message of a recording."""

    time: float
    """Network time at which the recorder received the message [s]."""
    key: str
    payload: bytes


class RecordedMessages(Sequence[RecordedMessage]):
    """The messages of a file, sorted by time. Each is read from the file when it is asked for."""

    def __init__(self, path: pathlib.Path, index: _Index) -> None:
        times = np.frombuffer(index.times, np.float64)
        order = np.argsort(times, kind="stable")
        self.times = times[order]
        """Network time of each message [s]."""
        self.keys = list(index.keys)
        """Keys of all messages, each once."""
        self._key_of = np.frombuffer(index.key_of, np.uint16)[order]
        self._chunk_of = np.frombuffer(index.chunk_of, np.uint32)[order]
        self._place_of = np.frombuffer(index.place_of, np.uint32)[order]
        self._chunks = list(index.chunks)
        self._path = path
        self._file: IO[bytes] | None = None
        self._open: collections.OrderedDict[int, bytes] = collections.OrderedDict()

    def __len__(self) -> int:
        return len(self.times)

    @overload
    def __getitem__(self, place: int) -> RecordedMessage: ...

    @overload
    def __getitem__(self, place: slice) -> list[RecordedMessage]: ...

    def __getitem__(self, place: int | slice) -> RecordedMessage | list[RecordedMessage]:
        if isinstance(place, slice):
            return [self._read(i) for i in range(*place.indices(len(self)))]
        return self._read(range(len(self))[place])

    def key(self, place: int) -> str:
        """Returns the key of a message without reading the message."""
        return self.keys[self._key_of[place]]

    def of(self, *families: str, first: int = 0, last: int | None = None) -> Iterator[RecordedMessage]:
        """Yield the messages of these families of keys from number ``first`` on up to ``last``, not included. Others
        are not read."""
        known = np.array([key.partition("/")[0] in families for key in self.keys] or [False])
        for place in np.flatnonzero(known[self._key_of[first:last]]):
            yield self._read(first + int(place))

    def _read(self, place: int) -> RecordedMessage:
        chunk, start = int(self._chunk_of[place]), int(self._place_of[place])
        if chunk not in self._open:
            self._open[chunk] = self._unpack(self._chunks[chunk], start == _OUTSIDE)
            while len(self._open) > _OPEN_CHUNKS:
                self._open.popitem(last=False)
        self._open.move_to_end(chunk)
        content = self._open[chunk]
        data = content if start == _OUTSIDE else mcap_chunks.message_at(content, start).data
        return RecordedMessage(float(self.times[place]), self.key(place), _raw(data))

    def _unpack(self, at: int, is_message: bool) -> bytes:
        """Returns the content of the chunk, or the data of the message, that begins after the place ``at`` in the
        file."""
        try:
            if self._file is None:
                self._file = self._path.open("rb")
            self._file.seek(at)
            for record in mcap_chunks.records(self._file, MAX_RECORD_LENGTH, skip_magic=True):
                if is_message and isinstance(record, Message):
                    return record.data
                if not is_message and isinstance(record, Chunk):
                    return mcap_chunks.unpack(record, MAX_RECORD_LENGTH)
            raise EndOfFile
        except Exception as error:  # it was whole when the recording was opened
            raise InvalidRecording(f"{self._path} has changed while it was read ({error}): read it again") from None


@dataclasses.dataclass(frozen=True)
class Recording:
    """A recording. Its messages are read from the file when they are needed."""

    path: pathlib.Path
    metadata: dict[str, str]
    """Description of the recorded world: release, protocol, world, scene, seed, digest."""
    messages: RecordedMessages
    """All messages, sorted by time."""
    damage: str
    """Reason why the messages end early, in one line; empty if the file is whole. All messages before the damage can be
    read."""

    @property
    def start(self) -> float:
        """Network time of the first message [s]."""
        return float(self.messages.times[0])

    @property
    def length(self) -> float:
        """Time from the first message to the last [s]."""
        return float(self.messages.times[-1]) - self.start

    @property
    def actors(self) -> list[str]:
        """Names of all actors that were present at any time, sorted."""
        return sorted({sender_of(key) for key in self.messages.keys if key.startswith("live/")})


class _Index:
    """Times, keys and places of the messages of a file, in its order."""

    def __init__(self) -> None:
        self.times = array.array("d")
        self.key_of = array.array("H")
        self.chunk_of = array.array("I")
        self.place_of = array.array("I")
        self.chunks: list[int] = []
        """Places in the file after which the chunks, and the messages outside of chunks, begin."""
        self.keys: dict[str, int] = {}
        """Number of each key that a message has."""
        self._channels: dict[int, str] = {}
        self._unpacked = 0

    def add(self, record: object, before: int, after: int) -> None:
        """Add a record of the file that begins at ``before`` or later and ends at ``after``. Raises ValueError where
        its content is damaged; messages before the damage are added."""
        if isinstance(record, Channel):
            self._channels[record.id] = record.topic
        elif isinstance(record, Message):
            self.chunks.append(before)
            self._add_message(record.channel_id, record.log_time, record.data, _OUTSIDE)
        elif isinstance(record, Chunk):
            self._unpacked += record.uncompressed_size
            if self._unpacked > _FREE + MAX_RATIO * after:
                raise ValueError(f"it unpacks to more than {MAX_RATIO} times its size, which no recording does")
            self.chunks.append(before)
            for place, one in mcap_chunks.records_of(mcap_chunks.unpack(record, MAX_RECORD_LENGTH)):
                if isinstance(one, Channel):
                    self._channels[one.id] = one.topic
                elif isinstance(one, mcap_chunks.ChunkMessage):
                    self._add_message(one.channel, one.log_time, one.data, place)

    def _add_message(self, channel: int, log_time: int, data: bytes, place: int) -> None:
        _raw(data)
        if channel not in self._channels:
            raise ValueError(f"a message names channel {channel}, which is missing")
        key = self.keys.setdefault(self._channels[channel], len(self.keys))
        self.key_of.append(key)
        self.times.append(log_time * 1e-9)
        self.chunk_of.append(len(self.chunks) - 1)
        self.place_of.append(place)


def read_recording(path: pathlib.Path) -> Recording:
    """Read a recording up to its end or to the first damage.

    Raises :class:`InvalidRecording` if the file cannot be opened, is no recording of vinesim, or has another protocol
    version.
    """
    metadata: dict[str, str] = {}
    index = _Index()
    damage = profile = ""
    if path.is_dir():
        is_bag = any(file.suffix in (".mcap", ".db3") for file in path.iterdir())
        remedy = "play its ROS topics by: vinesim ros play" if is_bag else "give a file that 'vinesim record' wrote"
        raise InvalidRecording(f"{path} is a folder{' of rosbag2' if is_bag else ''}: {remedy}")
    try:
        with path.open("rb") as file:
            try:
                before = 0
                expected: int | None = None
                for record in mcap_chunks.records(file, MAX_RECORD_LENGTH):
                    if isinstance(record, Header):
                        profile = record.profile
                    elif isinstance(record, Statistics):
                        expected = record.message_count
                    elif isinstance(record, Metadata) and record.name == METADATA_NAME:
                        metadata |= record.metadata
                    else:
                        index.add(record, before, file.tell())
                    before = file.tell()
                if expected not in (None, len(index.times)):
                    damage = f"{len(index.times)} of its {expected} messages are there"
            except InvalidMagic:
                if file.tell() <= 8:
                    kind = "no MCAP file" if file.tell() else "empty"
                    raise InvalidRecording(f"{path} is {kind}: give one that 'vinesim record' wrote") from None
                damage = "it is not whole"
            except (EndOfFile, struct.error):
                damage = "it ends in the middle"
            except OSError:
                raise
            except Exception as error:  # damaged bytes can raise anything while they are decoded
                damage = f"it is damaged: {' '.join(str(error).split())[:200]}" if str(error) else "it is damaged"
    except OSError as error:
        raise InvalidRecording(
            f"cannot read {path}: {error.strerror}; give a file that 'vinesim record' wrote"
        ) from error
    if "protocol" not in metadata:
        if profile == "ros2":
            raise InvalidRecording(f"{path} is a recording of ROS topics: play it by: vinesim ros play")
        raise InvalidRecording(
            f"{path} holds no recording of vinesim: {damage or 'another program wrote it'}; give a file that 'vinesim "
            "record' wrote"
        )
    if metadata["protocol"] != str(PROTOCOL):
        raise InvalidRecording(
            f"{path} speaks protocol version {metadata['protocol']}, this program version {PROTOCOL}: "
            f"replay it with release {metadata.get('release', '?')} of vinesim, which recorded it"
        )
    messages = RecordedMessages(path, index)
    if damage:
        times = messages.times
        until = f"the {times[-1] - times[0]:.1f} s before" if len(times) else "nothing"
        damage = f"{path}: {damage} (was the recorder killed?); {until} can be read"
    return Recording(path, metadata, messages, damage)


def _raw(data: bytes) -> bytes:
    """Returns the bytes of the network message in a recorded JSON object. Raises ValueError if there are none."""
    try:
        return base64.b64decode(_body.decode(data).raw, validate=True)
    except (msgspec.MsgspecError, binascii.Error) as error:
        raise ValueError(f"a message without its bytes ({error})") from error


class _Body(msgspec.Struct):
    """The field of a recorded JSON object that a replay needs."""

    raw: str


_body = msgspec.json.Decoder(_Body)
