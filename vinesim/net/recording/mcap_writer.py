"""Writes recordings: the network messages of a world, in an MCAP file that any MCAP reader opens.

The file has one channel for each key. A recorded message is a JSON object
(:func:`~vinesim.net.codec.messages.describe_message`) with the decoded content. Its field ``raw`` has the bytes that
crossed the network, for replays. The log time is the network time [ns] at which the recorder received the message. The
publish time is the network time in the header of the message.
"""

from __future__ import annotations

import contextlib
import os
import pathlib
import queue
import threading
import time

import msgspec

from vinesim.core.errors import WriteError
from vinesim.core.version import __version__
from vinesim.net.codec.header import PROTOCOL, MessageError
from vinesim.net.codec.messages import describe_message, schema_of, time_of
from vinesim.net.recording.mcap_file import McapFile
from vinesim.net.recording.mcap_reader import METADATA_NAME

FLUSH_PERIOD = 0.5
"""Time after which recorded messages are on the disk [s]. A recorder that is killed loses the messages of this time."""


class RecordingStopped(WriteError):
    """A recording cannot be created or continued. The text gives the reason and how much of the file is kept."""


def free_path(path: pathlib.Path) -> pathlib.Path:
    """Returns ``path`` if no such file exists, else the first free one of NAME-2, NAME-3 and so on, with the same
    suffix.

    So no recording is ever overwritten.
    """
    number = 1
    free = path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


_Work = tuple[int, str, bytes] | dict[str, str]


class RecordingWriter:
    """A recording that is being written. :meth:`put` does not block: a thread of the writer writes the file.

    A context manager. :meth:`close` completes the file.
    """

    def __init__(self, path: pathlib.Path, metadata: dict[str, str] | None = None) -> None:
        """Create the file. Raises :class:`RecordingStopped` if that fails. ``metadata``: first entries of
        :attr:`metadata`."""
        self.path = path
        self.metadata = {"release": __version__, "protocol": str(PROTOCOL)} | (metadata or {})
        """Description of the recorded world: release, protocol, and what was added, like scene, seed and digest."""
        self.count = 0
        """Number of messages that :meth:`put` has taken."""
        self.size = 0
        """Size of the file on the disk [B], up to the last complete chunk."""
        self._work: queue.SimpleQueue[_Work | None] = queue.SimpleQueue()
        self._error: RecordingStopped | None = None
        try:
            self._file = path.open("xb")
        except OSError as error:
            raise RecordingStopped(f"cannot record into {path}: {error.strerror}; choose another file") from error
        self._writer = McapFile(self._file)
        self._channels: dict[str, int] = {}
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    def add_metadata(self, **metadata: str) -> None:
        """Add entries to :attr:`metadata` and write all entries to the file again."""
        self.metadata |= metadata
        self._work.put(dict(self.metadata))

    def put(self, at: int, key: str, payload: bytes) -> None:
        """Record a message that was received at network time ``at`` [ns]. Raises what :meth:`check` raises."""
        self.check()
        self.count += 1
        self._work.put((at, key, payload))

    def check(self) -> None:
        """Raise :class:`RecordingStopped` if an error has ended the recording."""
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Write the messages that wait and the index of the file. Idempotent. Raises what :meth:`check` raises."""
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
        """Body of the thread that writes the file."""
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
            self._error = RecordingStopped(self._truncate(error.strerror or str(error)))
        except Exception as error:  # otherwise the recorder would continue without a file
            self._error = RecordingStopped(self._truncate(f"{type(error).__name__}: {error}"))

    def _write(self, work: _Work) -> None:
        """Write a message (time of arrival [ns], key, payload) or, if ``work`` is a dictionary, metadata."""
        if isinstance(work, dict):
            self._writer.add_metadata(METADATA_NAME, work)
            return
        at, key, payload = work
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = self._writer.register_channel(key, "json", self._schema_id(key))
        try:
            sampled_at = time_of(payload)
        except MessageError:
            sampled_at = None
        published = at if sampled_at is None or not 0.0 <= sampled_at < 1e10 else round(sampled_at * 1e9)
        self._writer.add_message(channel, at, msgspec.json.encode(describe_message(key, payload)), published)

    def _schema_id(self, key: str) -> int:
        """Returns the id of the JSON schema of the messages under a key; adds the schema to the file if it is new."""
        schema = schema_of(key)
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(schema[0], "jsonschema", schema[1])
        return self._schemas[schema]

    def _flush(self) -> None:
        """Complete the MCAP chunk in progress and force it to the disk."""
        self._writer.flush()
        os.fsync(self._file.fileno())
        self.size = self._file.tell()

    def _truncate(self, reason: str) -> str:
        """Cut the file after its last complete chunk, or remove it if it has none. Returns the text of the error."""
        with contextlib.suppress(OSError):
            self._file.close()
        with contextlib.suppress(OSError):
            if self.size:
                os.truncate(self.path, self.size)
            else:
                self.path.unlink()
        if not self.size:
            return f"{self.path} cannot be written ({reason}), nothing is recorded; make room and record again"
        return (
            f"recording stopped, {self.path} cannot be written any more ({reason}): "
            f"its {self.size} B stay readable; make room and record into another file"
        )
