"""Writes recordings: every network message of a world, in an MCAP file that any MCAP reader opens.

One channel for each key. A message is a JSON object (:func:`~vinesim.net.codec.messages.describe_message`) that holds
the decoded content and, in ``raw``, the bytes that crossed the network, for replays. Log time is the network time at
which the recorder received it [ns], publish time the one in its header.
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
"""Time after which recorded messages are on the disk [s]: a recorder that is killed loses no more."""


class RecordingStopped(WriteError):
    """Nothing more can be written; the text gives the reason and what was kept."""


def free_path(path: pathlib.Path) -> pathlib.Path:
    """The path; if the file exists, NAME-2, NAME-3 ... before the suffix. No recording is ever overwritten."""
    number = 1
    free = path
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


_Work = tuple[int, str, bytes] | dict[str, str]


class RecordingWriter:
    """A growing recording: :meth:`put` does not block, a thread writes. A context manager; :meth:`close` completes the
    file."""

    def __init__(self, path: pathlib.Path, metadata: dict[str, str] | None = None) -> None:
        """Create the file; :class:`RecordingStopped` if that fails. ``metadata``: see :meth:`add_metadata`."""
        self.path = path
        self.metadata = {"release": __version__, "protocol": str(PROTOCOL)} | (metadata or {})
        """What is known of the recorded world: scene, seed, digest, release, protocol."""
        self.count = 0
        """Messages taken."""
        self.size = 0
        """Bytes on the disk."""
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
        """Add entries to :attr:`metadata` and write it."""
        self.metadata |= metadata
        self._work.put(dict(self.metadata))

    def put(self, at: int, key: str, payload: bytes) -> None:
        """Record a message that was received at network time ``at`` [ns]; raises an earlier error of the file."""
        self.check()
        self.count += 1
        self._work.put((at, key, payload))

    def check(self) -> None:
        """Raise :class:`RecordingStopped` if the file can no longer be written."""
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """Write what is left and the index. Idempotent. Raises an earlier error of the file."""
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
            self._error = RecordingStopped(self._truncate(error.strerror or str(error)))
        except Exception as error:  # else the recorder would go on without a file
            self._error = RecordingStopped(self._truncate(f"{type(error).__name__}: {error}"))

    def _write(self, work: _Work) -> None:
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
        schema = schema_of(key)
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(schema[0], "jsonschema", schema[1])
        return self._schemas[schema]

    def _flush(self) -> None:
        """Complete the chunk and force it to the disk."""
        self._writer.flush()
        os.fsync(self._file.fileno())
        self.size = self._file.tell()

    def _truncate(self, reason: str) -> str:
        """Cut the file to its last complete state, or remove it if there is none; the text of the error."""
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
