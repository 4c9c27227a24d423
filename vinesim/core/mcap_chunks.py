"""Reads the records of MCAP files within bounds: what a chunk unpacks to, and what a record says of its own length, are
limited before memory is taken. A file is read as a stream, one chunk at a time."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from typing import IO, Any, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import StreamReader

MAX_UNKNOWN = 1000
"""Largest number of records of unknown kinds in a chunk; MCAP allows them, and readers ignore them."""
_BLOCK = 1 << 20
_MAX_WINDOW = 1 << 27
"""Largest memory of a decompressor [B], as of the program zstd."""
_HEAD = struct.Struct("<BQ")  # kind and length of a record
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence number, time of recording and of publishing [ns]


class ChunkError(ValueError):
    """A chunk is damaged, or unpacks to more than the limit."""


class ChunkMessage(NamedTuple):
    """A message in an unpacked chunk."""

    channel: int
    log_time: int
    """Time at which it was recorded [ns]."""
    data: bytes


class BoundedStream:
    """A stream for :class:`mcap.stream_reader.StreamReader` that refuses to read more than ``limit`` [B] at once."""

    def __init__(self, stream: IO[bytes], limit: int) -> None:
        self._stream = stream
        self._limit = limit

    def read(self, size: int) -> bytes:
        """Returns ``size`` bytes, or fewer at the end. Raises :class:`ChunkError` for a ``size`` above the limit."""
        if size > self._limit:
            raise ChunkError(f"a record says it has {size} bytes, the limit is {self._limit}")
        return self._stream.read(size)


def records(stream: IO[bytes], limit: int, *, skip_magic: bool = False) -> Iterator[Any]:
    """Yield the records of an MCAP file from the present place of ``stream`` on, chunks as they are. ``limit``: largest
    size of a record [B]. Damaged bytes may raise anything."""
    bounded: Any = BoundedStream(stream, limit)
    reader = StreamReader(bounded, skip_magic=skip_magic, emit_chunks=True, validate_crcs=True, record_size_limit=limit)
    return iter(reader.records)


def unpack(chunk: Chunk, limit: int) -> bytes:
    """Returns the content of a chunk. Raises :class:`ChunkError` if it has more than ``limit`` [B], or if its length or
    its checksum differs from what the chunk says."""
    if chunk.uncompressed_size > limit:
        raise ChunkError(f"a chunk unpacks to {chunk.uncompressed_size} bytes, the limit is {limit}")
    packed = io.BytesIO(chunk.data)
    if chunk.compression == "":
        content = bytes(chunk.data)
    elif chunk.compression == "zstd":
        with zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW).stream_reader(packed) as stream:
            content = _read_bounded(stream, chunk.uncompressed_size)
    elif chunk.compression == "lz4":
        import lz4.frame  # mcap needs it

        with lz4.frame.open(packed) as stream:
            content = _read_bounded(stream, chunk.uncompressed_size)
    else:
        raise ChunkError(f"a chunk is compressed by {chunk.compression[:20]!r}, which is not read")
    if len(content) != chunk.uncompressed_size:
        raise ChunkError(f"a chunk says it unpacks to {chunk.uncompressed_size} bytes, which is wrong")
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise ChunkError("crc validation failed in Chunk")
    return content


def unpack_zstd(data: bytes, limit: int) -> bytes:
    """Returns what was compressed by zstd. Raises :class:`ChunkError` if it has more than ``limit`` [B] or is cut
    off."""
    unpacker = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW)
    said = zstandard.get_frame_parameters(data).content_size
    with unpacker.stream_reader(io.BytesIO(data)) as stream:
        content = _read_bounded(stream, limit)
    if len(content) > limit:
        raise ChunkError(f"a message unpacks to more than {limit} bytes")
    if said not in (len(content), zstandard.CONTENTSIZE_UNKNOWN):
        raise ChunkError("a compressed message is cut off")
    return content


def _read_bounded(stream: Any, size: int) -> bytes:
    """Returns the content of a stream; it ends after one byte more than ``size`` [B]."""
    parts = []
    left = size + 1
    while left > 0 and (part := stream.read(min(left, _BLOCK))):
        parts.append(part)
        left -= len(part)
    return b"".join(parts)


def records_of(content: bytes) -> Iterator[tuple[int, Schema | Channel | ChunkMessage]]:
    """Yield the records in the content of a chunk, each with the place at which it begins. Raises :class:`ChunkError`
    where the content is damaged."""
    at = unknown = 0
    while at < len(content):
        if at + _HEAD.size > len(content):
            raise ChunkError("a chunk ends in the middle of a record")
        kind, length = _HEAD.unpack_from(content, at)
        start = at + _HEAD.size
        if length > len(content) - start:
            raise ChunkError("a chunk ends in the middle of a record")
        if kind == Opcode.MESSAGE:
            yield at, message_at(content, at)
        elif kind == Opcode.CHANNEL:
            yield at, Channel.read(ReadDataStream(io.BytesIO(content[start : start + length])))
        elif kind == Opcode.SCHEMA:
            yield at, Schema.read(ReadDataStream(io.BytesIO(content[start : start + length])))
        else:
            unknown += 1
            if kind == 0 or unknown > MAX_UNKNOWN:
                raise ChunkError("a chunk has no records of MCAP")
        at = start + length


def message_at(content: bytes, at: int) -> ChunkMessage:
    """Returns the message that begins ``at`` a place in the content of a chunk."""
    _, length = _HEAD.unpack_from(content, at)
    start = at + _HEAD.size
    if length < _MESSAGE.size:
        raise ChunkError("a message is too short")
    channel, _, log_time, _ = _MESSAGE.unpack_from(content, start)
    return ChunkMessage(channel, log_time, content[start + _MESSAGE.size : start + length])
