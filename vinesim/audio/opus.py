"""Decoding of Opus by PyAV. A client without PyAV asks speakers to send PCM16 instead."""

from __future__ import annotations

import importlib.util

import numpy as np

from vinesim.audio.frame import FRAME_SAMPLES, SAMPLE_RATE

OPUS_RATE = 48_000
"""[Hz] Sample rate at which PyAV decodes."""

_FACTOR = OPUS_RATE // SAMPLE_RATE
_TAPS = 48
_HALF = (_TAPS - 1) / 2.0
_TIME = (np.arange(_TAPS) - _HALF) / _FACTOR
_LOW_PASS = (0.9 * np.sinc(0.9 * _TIME) * np.hamming(_TAPS)).astype(np.float32)
_LOW_PASS /= _LOW_PASS.sum()
"""Windowed sinc with its cut-off at 7.2 kHz. It prevents aliasing of frequencies above half of :data:`SAMPLE_RATE`."""


def is_available() -> bool:
    """Returns whether Opus can be decoded on this machine."""
    return importlib.util.find_spec("av") is not None


class OpusDecoder:
    """Decodes the packets of one speaker, in order."""

    def __init__(self) -> None:
        """Raises ImportError if PyAV is not installed."""
        import av

        self._av = av
        self._before = np.zeros(_TAPS - 1, np.float32)
        self._codec = self._new()

    def _new(self):
        codec = self._av.CodecContext.create("libopus", "r")
        codec.sample_rate = OPUS_RATE
        codec.layout = "mono"
        return codec

    def decode(self, packet: bytes) -> np.ndarray | None:
        """Returns samples [:data:`FRAME_SAMPLES`] float32 from -1 to 1; None if ``packet`` is not an Opus packet of 20
        ms."""
        try:
            decoded = [frame.to_ndarray() for frame in self._codec.decode(self._av.Packet(packet))]
        except ValueError:
            self._codec = self._new()
            return None
        if not decoded or decoded[0].dtype != np.int16 or decoded[0].size != FRAME_SAMPLES * _FACTOR:
            return None
        samples = np.concatenate([self._before, decoded[0].ravel().astype(np.float32) / np.float32(32768.0)])
        self._before = samples[1 - _TAPS :].copy()
        return np.convolve(samples, _LOW_PASS, "valid")[::_FACTOR].astype(np.float32)
