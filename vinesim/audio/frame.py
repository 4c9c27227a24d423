"""Frames of sound on the network and on the page's socket: 20 ms of mono sound, coded by Opus or as PCM16.

An Opus frame is one packet with one frame of 20 ms (RFC 6716, section 3.1). PCM16 has signed 16-bit little-endian
samples at :data:`SAMPLE_RATE`.
"""

from __future__ import annotations

import enum

import numpy as np

SAMPLE_RATE = 16_000
"""[Hz] Sample rate of PCM16 and of robots' microphones and loudspeakers; speech recognition expects it."""

FRAME = 0.02
"""[s] Duration of one frame."""

FRAME_SAMPLES = 320
"""Samples of a frame of PCM16."""

MAX_OPUS = 800
"""[B] Longest Opus packet that is accepted; speech at 24 kbit/s needs 60."""

_OPUS_20_MS = frozenset((1, 5, 9, 13, 15, 19, 23, 27, 31))
"""Configuration numbers of Opus with frames of 20 ms (RFC 6716, table 2)."""


class Codec(enum.IntEnum):
    """Coding of the sound in a frame. Frames on the network contain the number."""

    OPUS = 1
    PCM16 = 2


def find_fault(codec: int, data: bytes) -> str:
    """Returns the reason why ``data`` is not a frame of this codec; empty if its length and first byte are valid."""
    if codec == Codec.PCM16:
        return "" if len(data) == 2 * FRAME_SAMPLES else f"PCM16 of {len(data)} B, not {2 * FRAME_SAMPLES}"
    if codec != Codec.OPUS:
        return f"unknown codec {codec}"
    if not 1 <= len(data) <= MAX_OPUS:
        return f"Opus packet of {len(data)} B, not 1 to {MAX_OPUS}"
    configuration = data[0] >> 3
    channels = 1 + (data[0] >> 2 & 1)
    count = data[0] & 3
    if configuration not in _OPUS_20_MS or channels != 1 or count != 0:
        return f"Opus packet that is not one frame of 20 ms of mono (first byte {data[0]})"
    return ""


def to_pcm(samples: np.ndarray) -> bytes:
    """Returns samples [n] encoded as PCM16; values outside -1 to 1 are clipped."""
    return np.round(np.clip(samples, -1.0, 1.0) * 32767.0).astype("<i2").tobytes()


def from_pcm(data: bytes) -> np.ndarray:
    """Returns the samples [n] of PCM16 as float32 from -1 to 1; an odd last byte is left out."""
    return np.frombuffer(data, "<i2", len(data) // 2).astype(np.float32) / np.float32(32767.0)
