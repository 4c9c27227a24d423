"""Writes MCAP files of any length in little memory, with the public record types of the ``mcap`` package.

``mcap.writer.Writer`` keeps one Python object with the index of each chunk until it finishes the file. A recording with
30 channels and two chunks a second has 18 MB of such objects after an hour. :class:`McapFile` writes the same bytes
and compresses the indexes in memory: 0.9 MB after an hour.
"""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from typing import BinaryIO

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of an MCAP file, by the MCAP specification."""

CHUNK_SIZE = 1 << 20
"""Size after which a chunk is completed [B], before compression. The default of ``mcap.writer.Writer``."""

INDEX_PIECE = 1 << 16
"""Number of bytes of the chunk index that are decompressed at once when the file is finished."""


def _encode(record: McapRecord) -> bytes:
    """Return an MCAP record as bytes."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


class ChunkIndexes:
    """The :class:`mcap.records.ChunkIndex` records of a file, encoded and compressed in memory."""

    def __init__(self) -> None:
        self._compressor = zlib.compressobj()
        self._compressed = bytearray()

    @property
    def size(self) -> int:
        """Memory that the compressed records take [B]."""
        return len(self._compressed)

    def append(self, index: ChunkIndex) -> None:
        """Add the index of one chunk."""
        self._compressed += self._compressor.compress(_encode(index))

    def finish(self) -> Iterator[bytes]:
        """Yield all records as consecutive pieces of at most :data:`INDEX_PIECE` bytes. Can be called once."""
        self._compressed += self._compressor.flush()
        decompressor = zlib.decompressobj()
        rest = bytes(self._compressed)
        while rest and not decompressor.eof:
            yield decompressor.decompress(rest, INDEX_PIECE)
            rest = decompressor.unconsumed_tail


class McapFile:
    """An MCAP file that is being written, with chunks compressed by zstd and with all indexes."""

    def __init__(self, stream: BinaryIO) -> None:
        """``stream``: an empty file, opened for writing."""
        self.stream = stream
        self.chunk_indexes = ChunkIndexes()
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._statistics = Statistics(
            attachment_count=0,
            channel_count=0,
            channel_message_counts=defaultdict(int),
            chunk_count=0,
            message_count=0,
            message_end_time=0,
            message_start_time=0,
            metadata_count=0,
            schema_count=0,
        )
        self._chunk = RecordBuilder()
        """Schemas, channels and messages of the chunk in progress."""
        self._message_indexes: dict[int, MessageIndex] = {}
        """Log times and offsets of the messages in the chunk in progress, by channel id."""

    def start(self, library: str) -> None:
        """Write the beginning of the file. ``library``: name of the program that writes the file."""
        self.stream.write(MAGIC)
        self._write(Header(profile="", library=library))

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Write a metadata record."""
        offset = self.stream.tell()
        length = self._write(Metadata(name, metadata))
        self._statistics.metadata_count += 1
        self._metadata_indexes.append(MetadataIndex(offset, length, name))

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema and return its id."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._statistics.schema_count += 1
        self._add_to_chunk(schema)
        return schema.id

    def register_channel(self, topic: str, message_encoding: str, schema_id: int) -> int:
        """Add a channel and return its id."""
        channel = Channel(len(self._channels) + 1, topic, message_encoding, {}, schema_id)
        self._channels.append(channel)
        self._statistics.channel_count += 1
        self._add_to_chunk(channel)
        return channel.id

    def add_message(self, channel_id: int, log_time: int, data: bytes, publish_time: int) -> None:
        """Add a message to the chunk in progress. Times in ns."""
        statistics = self._statistics
        if statistics.message_count == 0:
            statistics.message_start_time = log_time
        statistics.message_start_time = min(statistics.message_start_time, log_time)
        statistics.message_end_time = max(statistics.message_end_time, log_time)
        statistics.message_count += 1
        statistics.channel_message_counts[channel_id] += 1
        index = self._message_indexes.setdefault(channel_id, MessageIndex(channel_id, []))
        index.records.append((log_time, self._chunk.count))
        self._add_to_chunk(Message(channel_id, log_time, data, publish_time, sequence=0))

    def flush(self) -> None:
        """Complete the chunk in progress and pass everything to the operating system."""
        self._end_chunk()
        self.stream.flush()

    def finish(self) -> None:
        """Write the summary with all indexes and the end of the file. The stream stays open."""
        self._end_chunk()
        self._write(DataEnd(data_section_crc=0))
        start = self.stream.tell()
        crc = 0
        offsets = b""
        for opcode, pieces in self._summary():
            group_start = self.stream.tell()
            for piece in pieces:
                crc = zlib.crc32(piece, crc)
                self.stream.write(piece)
            offsets += _encode(SummaryOffset(opcode, group_start, self.stream.tell() - group_start))
        offset_start = self.stream.tell()
        self.stream.write(offsets)
        unsigned_footer = _encode(Footer(start, offset_start, summary_crc=0))
        crc = zlib.crc32(unsigned_footer[:-4], zlib.crc32(offsets, crc))
        self._write(Footer(start, offset_start, crc))
        self.stream.write(MAGIC)

    def _summary(self) -> Iterator[tuple[Opcode, Iterable[bytes]]]:
        """Yield each group of the summary: kind of its records, and the records as pieces of bytes."""
        yield Opcode.SCHEMA, map(_encode, self._schemas)
        yield Opcode.CHANNEL, map(_encode, self._channels)
        yield Opcode.STATISTICS, [_encode(self._statistics)]
        yield Opcode.CHUNK_INDEX, self.chunk_indexes.finish()
        yield Opcode.ATTACHMENT_INDEX, []
        yield Opcode.METADATA_INDEX, map(_encode, self._metadata_indexes)

    def _write(self, record: McapRecord) -> int:
        """Write a record to the file and return its length [B]."""
        data = _encode(record)
        self.stream.write(data)
        return len(data)

    def _add_to_chunk(self, record: Schema | Channel | Message) -> None:
        """Add a record to the chunk in progress; complete the chunk when it exceeds :data:`CHUNK_SIZE`."""
        record.write(self._chunk)
        if self._chunk.count > CHUNK_SIZE:
            self._end_chunk()

    def _end_chunk(self) -> None:
        """Write the chunk in progress and its message indexes, unless it has no message."""
        if not self._message_indexes:
            return
        content = self._chunk.end()
        times = [log_time for index in self._message_indexes.values() for log_time, _ in index.records]
        chunk = Chunk(
            compression="zstd",
            data=zstandard.compress(content),
            message_start_time=min(times),
            message_end_time=max(times),
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        )
        chunk_start = self.stream.tell()
        chunk_length = self._write(chunk)
        offsets = {}
        for channel_id, index in self._message_indexes.items():
            offsets[channel_id] = self.stream.tell()
            self._write(index)
        self._statistics.chunk_count += 1
        self.chunk_indexes.append(
            ChunkIndex(
                message_start_time=chunk.message_start_time,
                message_end_time=chunk.message_end_time,
                chunk_start_offset=chunk_start,
                chunk_length=chunk_length,
                message_index_offsets=offsets,
                message_index_length=self.stream.tell() - chunk_start - chunk_length,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        self._message_indexes.clear()
