"""Reads recordings: all messages of an MCAP file into memory, up to the first damage."""

from __future__ import annotations

import base64
import binascii
import dataclasses
import pathlib
import struct
from typing import NamedTuple

import msgspec
from mcap.exceptions import EndOfFile, InvalidMagic
from mcap.records import Channel, Header, Message, Metadata
from mcap.stream_reader import StreamReader

from vinesim.net.codec.header import PROTOCOL
from vinesim.net.codec.messages import sender_of

METADATA_NAME = "vinesim"
"""Name of the MCAP metadata records that describe the recorded world. A later record replaces entries of earlier
ones."""

MAX_RECORD_LENGTH = 1 << 26
"""Largest size of an MCAP record that is read [B]."""


class InvalidRecording(ValueError):
    """A file cannot be replayed as a recording. The text gives the reason and what to do."""


class RecordedMessage(NamedTuple):
    """One network message of a recording."""

    time: float
    """Network time at which the recorder received the message [s]."""
    key: str
    payload: bytes


@dataclasses.dataclass(frozen=True)
class Recording:
    """A recording, read into memory."""

    path: pathlib.Path
    metadata: dict[str, str]
    """Description of the recorded world: release, protocol, world, scene, seed, digest."""
    messages: list[RecordedMessage]
    """All messages, sorted by time."""
    damage: str
    """Reason why the messages end early, in one line; empty if the file is whole. All messages before the damage were
    read."""

    @property
    def start(self) -> float:
        """Network time of the first message [s]."""
        return self.messages[0].time

    @property
    def length(self) -> float:
        """Time from the first message to the last [s]."""
        return self.messages[-1].time - self.start

    @property
    def actors(self) -> list[str]:
        """Names of all actors that were present at any time, sorted."""
        return sorted({sender_of(entry.key) for entry in self.messages if entry.key.startswith("live/")})


def read_recording(path: pathlib.Path) -> Recording:
    """Read a recording up to its end or to the first damage.

    Raises :class:`InvalidRecording` if the file cannot be opened, is no recording of vinesim, or has another protocol
    version.
    """
    metadata: dict[str, str] = {}
    recorded: list[RecordedMessage] = []
    channels: dict[int, str] = {}
    damage = profile = ""
    if path.is_dir():
        is_bag = any(file.suffix in (".mcap", ".db3") for file in path.iterdir())
        remedy = "play its ROS topics by: vinesim ros play" if is_bag else "give a file that 'vinesim record' wrote"
        raise InvalidRecording(f"{path} is a folder{' of rosbag2' if is_bag else ''}: {remedy}")
    try:
        with path.open("rb") as file:
            try:
                for record in StreamReader(file, validate_crcs=True, record_size_limit=MAX_RECORD_LENGTH).records:
                    if isinstance(record, Header):
                        profile = record.profile
                    elif isinstance(record, Metadata) and record.name == METADATA_NAME:
                        metadata |= record.metadata
                    elif isinstance(record, Channel):
                        channels[record.id] = record.topic
                    elif isinstance(record, Message):
                        recorded.append(
                            RecordedMessage(record.log_time * 1e-9, channels[record.channel_id], _raw(record.data))
                        )
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
                damage = f"it is damaged: {error}" if str(error) else "it is damaged"
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
    recorded.sort(key=lambda message: message.time)
    if damage:
        until = f"the {recorded[-1].time - recorded[0].time:.1f} s before" if recorded else "nothing"
        damage = f"{path}: {damage} (was the recorder killed?); {until} can be read"
    return Recording(path, metadata, recorded, damage)


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
