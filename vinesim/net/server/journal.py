"""Write-ahead log of retained records: one journal file for a world, to which every record is appended on arrival.

A journal starts with ``vsfacts`` and a version; then come frames: length, CRC-32, bytes. The first frame is the header
(msgpack: world, scene), every other one a cell and a RETAINED message. A journal is compacted by writing it anew beside
the old one, which is then replaced atomically. So a process may die at any byte: what was appended before is there, and
at most the last frame is torn.
"""

from __future__ import annotations

import logging
import os
import pathlib
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, Self

import msgspec

from vinesim.net.codec.control import RetainedRecord, decode_records, encode_records
from vinesim.net.codec.header import PROTOCOL, MessageError
from vinesim.net.replication.interest import Cell
from vinesim.net.replication.retained import RetainedState
from vinesim.net.server.admission import SceneId
from vinesim.net.transport.bus import BusError

log = logging.getLogger(__name__)

MAGIC = b"vsfacts"
VERSION = 1
SUFFIX = ".facts"

MAX_OBSOLETE_RECORDS = 1000
"""A journal is compacted when it has more obsolete frames than this plus three for each record that holds."""

_RECORD = struct.Struct("<II")  # length, CRC-32
_CELL = struct.Struct("<ii")


class JournalError(BusError):
    """A journal cannot be used or written; the text names the file and the remedy."""


class _Header(msgspec.Struct, frozen=True):
    world: str
    scene: str
    digest: str
    protocol: int = PROTOCOL


class Journal:
    """The retained state of one world, in memory and on disk. A context manager; used by one thread."""

    def __init__(self, path: pathlib.Path, world: str, scene_id: SceneId, state: RetainedState) -> None:
        self.path = path
        self.world = world
        self.scene_id = scene_id
        self.state = state
        self._file: BinaryIO | None = None
        self._records = 0
        self.rewrite()

    @classmethod
    def load(cls, path: pathlib.Path) -> Self:
        """Read a journal. A torn one is repaired and its original kept under another name.

        Raises :class:`JournalError` if it is no journal or one of another version; then the file stays untouched.
        """
        try:
            content = path.read_bytes()
        except OSError as error:
            raise JournalError(
                f"{path}: cannot be read ({error.strerror}): mend that, or give another --state-dir"
            ) from error
        start = MAGIC + bytes((VERSION,))
        if not content.startswith(MAGIC):
            raise JournalError(f"{path}: is no journal of facts: move it away, or give another --state-dir")
        if not content.startswith(start):
            raise JournalError(
                f"{path}: journal of version {content[len(MAGIC) : len(start)].hex() or 'none'}, this release reads "
                f"{VERSION:02x}: use the release that wrote it, or give another --state-dir"
            )
        head: _Header | None = None
        state = RetainedState()
        valid_end = len(start)
        reason = "its head is torn"
        try:
            for record, end in _records(content, len(start)):
                if head is None:
                    head = _head_decoder.decode(record)
                    if head.protocol != PROTOCOL:
                        raise JournalError(
                            f"{path}: facts of protocol version {head.protocol}, this release speaks "
                            f"{PROTOCOL}: use the release that wrote them, or give another --state-dir"
                        )
                else:
                    for retained in decode_records(record[_CELL.size :]):
                        state.merge(_CELL.unpack_from(record), retained)
                valid_end = end
        except (msgspec.DecodeError, MessageError, struct.error) as error:
            reason = str(error)
        if head is None:
            raise JournalError(f"{path}: {reason}, so its world is unknown: move it away, or give another --state-dir")
        if valid_end < len(content):
            backup = _free_name(path)
            _write(backup, content)
            log.warning(
                "%s: torn after %d of %d bytes; %d facts before that hold, the file as it was is kept as %s",
                path,
                valid_end,
                len(content),
                len(state),
                backup.name,
            )
        return cls(path, head.world, SceneId(head.scene, head.digest), state)

    def append(self, cell: Cell, retained: RetainedRecord) -> None:
        """Append a record that :attr:`state` has merged. Survives the end of this process at once."""
        assert self._file is not None
        try:
            self._file.write(_packed(_CELL.pack(*cell) + encode_records([retained])))
            self._file.flush()
        except OSError as error:
            raise _cannot_write(self.path, error) from error
        self._records += 1

    def sync(self) -> None:
        """Force what was appended to the disk; compact the file if that is worth it."""
        try:
            if self._records > MAX_OBSOLETE_RECORDS + 4 * len(self.state):
                self.rewrite()
            elif self._file is not None:
                os.fsync(self._file.fileno())
        except OSError as error:
            raise _cannot_write(self.path, error) from error

    def rewrite(self) -> None:
        """Write the state to a new file and replace the old one."""
        head = _encoder.encode(_Header(self.world, *self.scene_id))
        records = [_CELL.pack(*cell) + encode_records([retained]) for cell, retained in self.state]
        try:
            _write(self.path, MAGIC + bytes((VERSION,)) + b"".join(map(_packed, [head, *records])))
            if self._file is not None:
                self._file.close()
            self._file = self.path.open("ab")
        except OSError as error:
            raise _cannot_write(self.path, error) from error
        self._records = len(self.state)

    def close(self) -> None:
        """Sync and close the file."""
        if self._file is not None:
            try:
                self.sync()
            finally:
                self._file.close()
                self._file = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def load_all(folder: pathlib.Path) -> dict[str, Journal]:
    """The journals of a folder by their worlds; the folder is created if necessary. Raises :class:`JournalError`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for rest in folder.glob(f"*{SUFFIX}.part"):
            rest.unlink()  # half of a journal written anew: the old one is still there
    except OSError as error:
        raise _cannot_write(folder, error) from error
    journals: dict[str, Journal] = {}
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        journal = Journal.load(path)
        if path.name != f"{journal.world}{SUFFIX}":
            raise JournalError(
                f"{path}: holds world {journal.world!r}: rename it to {journal.world}{SUFFIX} or move it away"
            )
        journals[journal.world] = journal
    return journals


def _records(content: bytes, at: int) -> Iterator[tuple[bytes, int]]:
    """Intact frames and where each ends, up to the first that is not intact."""
    while at + _RECORD.size <= len(content):
        length, crc = _RECORD.unpack_from(content, at)
        record = content[at + _RECORD.size : at + _RECORD.size + length]
        if len(record) < length or zlib.crc32(record) != crc:
            return
        at += _RECORD.size + length
        yield record, at


def _packed(record: bytes) -> bytes:
    return _RECORD.pack(len(record), zlib.crc32(record)) + record


def _write(path: pathlib.Path, content: bytes) -> None:
    """Write a file atomically."""
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _free_name(path: pathlib.Path) -> pathlib.Path:
    number = 1
    while (backup := path.with_name(f"{path.name}.torn-{number}")).exists():
        number += 1
    return backup


def _cannot_write(path: pathlib.Path, error: OSError) -> JournalError:
    return JournalError(f"{path}: cannot be written ({error.strerror}): make room or give another --state-dir")


_encoder = msgspec.msgpack.Encoder()
_head_decoder = msgspec.msgpack.Decoder(_Header)
