"""Write-ahead log of retained records: one journal file for each world, to which every record is appended on arrival.

A journal starts with ``vsfacts`` and a version. Frames follow: length, CRC-32, bytes. The first frame is the header
(msgpack: world, scene). Every other frame has a cell and a RETAINED message with one record. To compact a journal, a
new file is written next to it and then replaces it atomically. So a process may die at any moment: all complete frames
remain, and at most the last frame is torn.
"""

from __future__ import annotations

import contextlib
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
"""Number of obsolete frames above which a journal is compacted, in addition to three for each current record."""

_RECORD = struct.Struct("<II")  # length, CRC-32
_CELL = struct.Struct("<ii")


class JournalError(BusError):
    """A journal cannot be used or written. The text names the file and what to do."""


class _Header(msgspec.Struct, frozen=True):
    """Content of the first frame of a journal."""

    world: str
    scene: str
    digest: str
    protocol: int = PROTOCOL


class Journal:
    """The journal of one world: its retained state in memory, and the file. A context manager. Only one thread uses
    it."""

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
        """Read a journal file. If it is torn, repair it and keep the original under another name.

        Raises :class:`JournalError`, and leaves the file as it is, if it is no journal or one of another version.
        """
        try:
            content = path.read_bytes()
        except OSError as error:
            raise JournalError(
                f"{path}: cannot be read ({error.strerror}): repair that, or give another --state-dir"
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
            try:
                _write(backup, content)
            except OSError as error:
                raise JournalError(
                    f"{path}: torn after {valid_end} of {len(content)} bytes, and its backup {backup.name} cannot be "
                    f"written ({error.strerror}), so it is left as it is: make room or give another --state-dir"
                ) from error
            log.warning(
                "%s: torn after %d of %d bytes; the %d facts before that are used, the original file is kept as %s",
                path,
                valid_end,
                len(content),
                len(state),
                backup.name,
            )
        return cls(path, head.world, SceneId(head.scene, head.digest), state)

    def append(self, cell: Cell, retained: RetainedRecord) -> None:
        """Append a record that is already in :attr:`state` to the file. The record then survives the end of this
        process."""
        assert self._file is not None
        try:
            self._file.write(_packed(_CELL.pack(*cell) + encode_records([retained])))
            self._file.flush()
        except OSError as error:
            raise _cannot_write(self.path, error) from error
        self._records += 1

    def sync(self) -> None:
        """Force appended records to the disk, so that they survive a crash of the machine. Compact the file if it has
        many obsolete frames."""
        try:
            if self._records > MAX_OBSOLETE_RECORDS + 4 * len(self.state):
                self.rewrite()
            elif self._file is not None:
                os.fsync(self._file.fileno())
        except OSError as error:
            raise _cannot_write(self.path, error) from error

    def rewrite(self) -> None:
        """Compact the journal: write :attr:`state` to a new file and replace the old file with it."""
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
    """Read all journals of a folder, and return them by world. Creates the folder if it is missing.

    Raises :class:`JournalError` if a journal cannot be used.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for rest in (*folder.glob(f"*{SUFFIX}.part"), *folder.glob(f"*{SUFFIX}.torn-*.part")):
            rest.unlink()  # unfinished new journal or backup: the old file is still there
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
    """Yield the bytes of each intact frame of a journal from offset ``at`` on, and the offset of the frame's end.

    Stops at the first frame that is not intact.
    """
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
    """Write a file atomically: it has the old content or the new one at any moment."""
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)  # on a full disk it takes the room that others need
        raise
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
