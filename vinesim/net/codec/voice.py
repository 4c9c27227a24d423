"""Wire format of a frame of sound: header with the number of the frame and its start time, codec, encoded sound."""

from __future__ import annotations

from typing import NamedTuple

from vinesim.audio.frame import Codec, find_fault
from vinesim.net.codec.header import HEADER, MessageError, pack_header, unpack_header

VOICE = 9
"""Number of the kind of message with a frame of sound, the fourth byte of the message."""


class VoiceFrame(NamedTuple):
    """A frame of sound: 20 ms of an actor's voice or of a robot's loudspeaker."""

    number: int
    """Number of the frame, which the speaker counts modulo 65,536."""
    time: float
    """Network time at which the frame began [s]."""
    codec: Codec
    data: bytes


def encode_voice(frame: VoiceFrame) -> bytes:
    """Encode a frame in 15 bytes and the sound. Raises :class:`MessageError` if codec and data do not fit together."""
    if fault := find_fault(frame.codec, frame.data):
        raise MessageError(fault)
    header = pack_header(VOICE, frame.number % 65536, frame.time)
    return b"".join((header, bytes((frame.codec,)), frame.data))


def decode_voice(payload: bytes) -> VoiceFrame:
    """Decode a frame, but not its sound. Raises :class:`MessageError` if codec and data do not fit together."""
    number, time = unpack_header(payload, VOICE, "frame of sound")
    if len(payload) <= HEADER.size:
        raise MessageError(f"frame of sound of {len(payload)} B without a codec")
    codec = payload[HEADER.size]
    data = payload[HEADER.size + 1 :]
    if fault := find_fault(codec, data):
        raise MessageError(f"frame of sound: {fault}")
    return VoiceFrame(number, time, Codec(codec), data)
