"""Reads recordings of ROS 2 topics without ROS: MCAP and SQLite files, rosbag2 folders of them, whole or cut off.

bag = open_bag(pathlib.Path("run"))
for topic, time, data in bag.messages():
    ...
print(bag.damage)
"""

from __future__ import annotations

import abc
import contextlib
import heapq
import pathlib
import re
import sqlite3
import struct
import tempfile
from collections.abc import Collection, Iterator
from typing import IO, Any, NamedTuple

import yaml
import zstandard
from mcap.exceptions import EndOfFile
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Message, Schema

from vinesim.core import mcap_chunks

MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\0"
ROS1_MAGIC = b"#ROSBAG V"
METADATA = "metadata.yaml"
"""File of a rosbag2 folder that names the files of the recording in order."""
MAX_RECORD = 1 << 28
"""Largest MCAP record that is read, and largest size of an unpacked chunk or message [B]; a larger one ends the
reading."""
MAX_FILE = 1 << 36
"""Largest size to which a compressed file is unpacked on the disk [B]."""
_KINDS = (".mcap", ".db3")


class BagError(ValueError):
    """A file or folder that cannot be read as a recording of ROS topics. The message is one line with the place, the
    reason and the remedy."""


class Topic(NamedTuple):
    """A recorded topic."""

    type_name: str
    """Message type, such as ``sensor_msgs/msg/Image``."""
    encoding: str
    """Encoding of the messages; ROS 2 has ``cdr``."""
    qos: str
    """Offered QoS as rosbag2 writes it (YAML); empty if it is not recorded."""


class BagMessage(NamedTuple):
    """A recorded message."""

    topic: str
    time: int
    """Time at which it was recorded [ns]."""
    data: bytes


class Bag:
    """A recording of ROS topics; :func:`open_bag` opens it."""

    def __init__(self, path: pathlib.Path, files: list[_File]) -> None:
        self.path = path
        self._files = files
        self.topics: dict[str, Topic] = {}
        """All recorded topics by name."""
        for file in files:
            self.topics |= file.topics

    @property
    def damage(self) -> str:
        """One line about messages that could not be read; empty without damage. It is complete after the last
        message."""
        return "; ".join(file.damage for file in self._files if file.damage)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Yield all messages, or those of some topics, file after file, sorted by time in each; those after damage in a
        file are left out."""
        for file in self._files:
            yield from file.messages(topics)


def open_bag(path: pathlib.Path) -> Bag:
    """Open an MCAP or SQLite file of ROS topics, or a rosbag2 folder of such files.

    Raises :class:`BagError` if there is no such recording. Damage after the beginning is no error: :attr:`Bag.damage`.
    """
    try:
        is_packed = False
        if not path.is_dir():
            files = [path]
        else:
            files, is_packed = _files_of(path)
        return Bag(path, [_open(file, is_packed) for file in files])
    except OSError as bad:
        place = bad.filename or path
        raise BagError(f"{place}: {bad.strerror}; give a recording of ROS topics") from None


def _files_of(folder: pathlib.Path) -> tuple[list[pathlib.Path], bool]:
    """Returns the files of a rosbag2 folder in order, and whether each message is compressed by itself."""
    about: Any = {}
    with contextlib.suppress(FileNotFoundError, yaml.YAMLError, UnicodeDecodeError):
        about = yaml.safe_load((folder / METADATA).read_text("utf-8-sig"))
    about = about.get("rosbag2_bagfile_information") if isinstance(about, dict) else None
    about = about if isinstance(about, dict) else {}
    there = sorted((file for file in folder.iterdir() if _kind_of(file) in _KINDS), key=_natural)
    named = about.get("relative_file_paths")
    if not isinstance(named, list) or not named:  # the recorder was killed before it wrote the names
        named = [file.name for file in there]
    if not named:
        other = "it holds a data set" if (folder / "records").is_dir() else "no .mcap and no .db3 file is in it"
        raise BagError(f"{folder}: {other}; give a folder that 'ros2 bag record' wrote, or an MCAP file")
    files = [folder / str(name) for name in named]
    for file in files:
        if not file.is_file():
            raise BagError(f"{file}: is not there, but {folder / METADATA} names it; copy it into the folder as well")
    mode, form = (str(about.get(key) or "").lower() for key in ("compression_mode", "compression_format"))
    if mode in ("message", "file") and form != "zstd":
        raise BagError(f"{folder}: is compressed by {form or '?'}; convert it without compression by: ros2 bag convert")
    return files, mode == "message"


def _kind_of(file: pathlib.Path) -> str:
    """Returns the suffix of a file, without that of a compressor."""
    return (file.with_suffix("") if file.suffix in (".zstd", ".zst") else file).suffix


def _natural(file: pathlib.Path) -> list[Any]:
    """Returns a key by which ``run_10`` comes after ``run_9``."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", file.name)]


def _open(file: pathlib.Path, is_packed: bool) -> _File:
    if file.suffix in (".zstd", ".zst"):
        stream: IO[bytes] = tempfile.NamedTemporaryFile(prefix="vinesim-bag-")  # noqa: SIM115 (lives as long as the bag)
        with file.open("rb") as packed, contextlib.suppress(zstandard.ZstdError):  # a cut file ends early
            for part in zstandard.ZstdDecompressor(max_window_size=1 << 27).read_to_iter(packed):
                stream.write(part)
                if stream.tell() > MAX_FILE:
                    raise BagError(f"{file}: unpacks to more than {MAX_FILE >> 30} GiB; unpack it by: zstd -d")
        stream.seek(0)
    else:
        stream = file.open("rb")
    magic = stream.read(len(SQLITE_MAGIC))
    stream.seek(0)
    if magic.startswith(MCAP_MAGIC):
        return _McapFile(file, stream, is_packed)
    if magic.startswith(SQLITE_MAGIC):
        return _SqliteFile(file, stream, is_packed)
    stream.close()
    if magic.startswith(ROS1_MAGIC):
        raise BagError(f"{file}: is a recording of ROS 1; convert it by: rosbags-convert --src {file.name}")
    kind = "no MCAP or SQLite file" if magic else "empty"
    raise BagError(f"{file}: is {kind}; give a recording of ROS topics ('vinesim ros record' or 'ros2 bag record')")


class _File(abc.ABC):
    """One file of a recording."""

    def __init__(self, path: pathlib.Path, stream: IO[bytes], is_packed: bool) -> None:
        """``is_packed``: whether each message is compressed by itself."""
        self.path = path
        self.stream = stream
        self.topics: dict[str, Topic] = {}
        self.damage = ""
        self._is_packed = is_packed

    def messages(self, topics: Collection[str] | None) -> Iterator[BagMessage]:
        """Yield the messages of some topics, or of all, until the end or the first damage, which is noted."""
        count = 0
        try:
            for message in self.read(topics):
                if self._is_packed:
                    message = message._replace(data=mcap_chunks.unpack_zstd(message.data, MAX_RECORD))
                yield message
                count += 1
        except GeneratorExit:
            raise
        except Exception as bad:  # damaged bytes can raise anything while they are decoded
            self.damage = self.damage or f"{self.path}: is damaged after message {count} ({_reason(bad)})"

    @abc.abstractmethod
    def read(self, topics: Collection[str] | None) -> Iterator[BagMessage]:
        """Yield the messages of some topics, or of all, as they are in the file. Damaged bytes may raise anything."""


class _McapFile(_File):
    def __init__(self, path: pathlib.Path, stream: IO[bytes], is_packed: bool) -> None:
        super().__init__(path, stream, is_packed)
        self._is_indexed = False
        self._chunks: list[ChunkIndex] = []
        self._topic_of: dict[int, str] = {}
        try:
            summary = SeekingReader(stream, record_size_limit=MAX_RECORD).get_summary()
        except Exception:  # the end, which has the summary, is missing or damaged
            summary = None
        statistics = None if summary is None else summary.statistics
        if summary is not None and statistics is not None and (summary.chunk_indexes or not statistics.message_count):
            self._is_indexed = True
            self._chunks = summary.chunk_indexes
            schemas, channels = summary.schemas, list(summary.channels.values())
        else:
            schemas, channels = self._scan()
        for channel in channels:
            schema = schemas.get(channel.schema_id)
            qos = channel.metadata.get("offered_qos_profiles", "")
            self._topic_of[channel.id] = channel.topic
            self.topics[channel.topic] = Topic(schema.name if schema else "", channel.message_encoding, qos)

    def _scan(self) -> tuple[dict[int, Schema], list[Channel]]:
        """Read a file without a usable summary from the beginning. Returns its schemas and channels, and notes where
        it is cut off."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        count = 0
        try:
            for record in self._records():
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                count += isinstance(record, mcap_chunks.ChunkMessage)
        except Exception as bad:
            how = "cut off" if isinstance(bad, (EndOfFile, struct.error)) else f"damaged ({_reason(bad)})"
            self.damage = f"{self.path}: is {how} after message {count}"
        return schemas, list(channels.values())

    def _records(self) -> Iterator[Any]:
        self.stream.seek(0)
        for record in mcap_chunks.records(self.stream, MAX_RECORD):
            if isinstance(record, Chunk):
                for _, one in mcap_chunks.records_of(mcap_chunks.unpack(record, MAX_RECORD)):
                    yield one
            elif isinstance(record, Message):
                yield mcap_chunks.ChunkMessage(record.channel_id, record.log_time, record.data)
            else:
                yield record

    def _sorted_messages(self) -> Iterator[tuple[int, mcap_chunks.ChunkMessage]]:
        """Yield all messages of the indexed chunks, sorted by time. Chunks are unpacked when their first message is
        due."""
        waiting: list[tuple[int, int, int, mcap_chunks.ChunkMessage | None]] = [
            (one.message_start_time, one.chunk_start_offset, -1, None) for one in self._chunks
        ]
        heapq.heapify(waiting)
        while waiting:
            time, chunk, _, message = heapq.heappop(waiting)
            if message is not None:
                yield time, message
                continue
            self.stream.seek(chunk)
            record = next(mcap_chunks.records(self.stream, MAX_RECORD, skip_magic=True))
            if not isinstance(record, Chunk):
                raise BagError("the index names a chunk that is not there")
            for place, one in mcap_chunks.records_of(mcap_chunks.unpack(record, MAX_RECORD)):
                if isinstance(one, mcap_chunks.ChunkMessage):
                    heapq.heappush(waiting, (one.log_time, chunk, place, one))

    def read(self, topics: Collection[str] | None) -> Iterator[BagMessage]:
        if self._is_indexed:
            for _, message in self._sorted_messages():
                topic = self._topic_of[message.channel]
                if topics is None or topic in topics:
                    yield BagMessage(topic, message.log_time, message.data)
            return
        names: dict[int, str] = {}
        with contextlib.suppress(Exception):  # the scan has noted the damage
            for record in self._records():
                if isinstance(record, Channel):
                    names[record.id] = record.topic
                elif isinstance(record, mcap_chunks.ChunkMessage):
                    topic = names[record.channel]
                    if topics is None or topic in topics:
                        yield BagMessage(topic, record.log_time, record.data)


class _SqliteFile(_File):
    def __init__(self, path: pathlib.Path, stream: IO[bytes], is_packed: bool) -> None:
        super().__init__(path, stream, is_packed)
        head = stream.read(100)
        there = stream.seek(0, 2)
        # SQLite reads missing bytes of a page as zeros and would return wrong messages
        page, count = struct.unpack_from(">HxxxxxxxxxxI", head, 16) if len(head) == 100 else (100, 1)
        size = (65536 if page == 1 else page) * count
        if there < size:
            raise BagError(
                f"{path}: is cut off, {there} of {size} bytes are there; recover what is whole by: sqlite3 {path.name} "
                f".recover | sqlite3 recovered{path.suffix}"
            )
        try:
            columns = {row[1] for row in self._rows("PRAGMA table_info(topics)")}
            qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
            rows = list(self._rows(f"SELECT name, type, serialization_format, {qos} FROM topics"))
        except sqlite3.Error as bad:
            raise BagError(f"{path}: is no whole recording of rosbag2 ({bad}); give another one") from None
        self.topics = {name: Topic(kind, encoding, offered or "") for name, kind, encoding, offered in rows}

    def _rows(self, query: str) -> Iterator[tuple[Any, ...]]:
        name = pathlib.Path(self.stream.name).resolve().as_uri()
        with contextlib.closing(sqlite3.connect(f"{name}?mode=ro", uri=True)) as base:
            yield from base.execute(query)

    def read(self, topics: Collection[str] | None) -> Iterator[BagMessage]:
        query = (
            "SELECT t.name, m.timestamp, m.data FROM messages m JOIN topics t ON t.id = m.topic_id "
            "ORDER BY m.timestamp, m.id"
        )
        for name, time, data in self._rows(query):
            if topics is None or name in topics:
                yield BagMessage(name, time, data)


def _reason(bad: Exception) -> str:
    """Returns the reason of an error in one line."""
    return " ".join(str(bad).split()) or type(bad).__name__
