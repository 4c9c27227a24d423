"""MCAP recordings of a world, read message by message.

    for message in Recording("harvest.mcap"):
        print(message.time, message.actor, message.key, message.data)

``vinesim record`` writes such recordings.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Iterator
from typing import Any

from vinesim.net.codec.messages import describe_message, sender_of
from vinesim.net.recording.mcap_reader import read_recording


@dataclasses.dataclass(frozen=True, slots=True)
class RecordedMessage:
    """One message of a recording."""

    time: float
    """[s] Time since the first message."""
    actor: str
    """Name of the actor whose client sent the message; empty for the server."""
    key: str
    """Key on which the message was published."""
    data: dict[str, Any]
    """Content of the message as JSON values; ``raw`` has its bytes in base64."""


class Recording:
    """A recording by ``vinesim record``, open for reading."""

    def __init__(self, path: str | pathlib.Path) -> None:
        """Read a file. Raises :class:`~vinesim.net.recording.mcap_reader.InvalidRecording` if it is not a recording."""
        self._recording = read_recording(pathlib.Path(path))

    @property
    def info(self) -> dict[str, str]:
        """Metadata by name: ``release`` of vinesim, ``protocol`` version, ``world``, ``scene``, ``seed``, and the
        scene's ``digest``."""
        return dict(self._recording.metadata)

    @property
    def actors(self) -> list[str]:
        """Names of all actors that were in the world, sorted."""
        return self._recording.actors

    @property
    def duration(self) -> float:
        """[s] Time from the first message to the last."""
        return self._recording.length if self._recording.messages else 0.0

    @property
    def damage(self) -> str:
        """One line that explains why the file is truncated, or an empty string. All messages before the damage can be
        read."""
        return self._recording.damage

    def __len__(self) -> int:
        """Returns the number of messages."""
        return len(self._recording.messages)

    def __iter__(self) -> Iterator[RecordedMessage]:
        """Yields all messages in order of time."""
        for entry in self._recording.messages:
            data = describe_message(entry.key, entry.payload)
            yield RecordedMessage(entry.time - self._recording.start, sender_of(entry.key), entry.key, data)
