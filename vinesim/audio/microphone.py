"""A microphone: records the sum of all voices and tones near it in blocks of 20 ms, each with its loudness at the
microphone.

A frame of sound is stamped with the network time at which it began. A block is recorded :attr:`Microphone.delay` after
its end, so that frames on their way still reach it. A frame that arrives later is counted, and the delay grows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from vinesim.audio import opus
from vinesim.audio.frame import FRAME, FRAME_SAMPLES, SAMPLE_RATE, Codec, from_pcm

DELAY = 0.06
"""[s] Initial delay from the end of a block until it is recorded."""

MAX_DELAY = 0.3
"""[s] Largest delay from the end of a block until it is recorded; voices may be 500 ms late (CANOPIES D6.4, section
5.5)."""

MAX_CONCEALED = 3
"""Largest number of consecutive lost frames that are replaced by a copy of the last frame."""

CAPACITY = 2.0
"""[s] Length of the ring buffer; frames stamped further in the future are dropped."""

MAX_SPEAKERS = 64
"""Largest number of voices at a time. If there are more, the voice that was silent longest is forgotten."""

_RING = round(CAPACITY * SAMPLE_RATE)


@dataclasses.dataclass(frozen=True, slots=True)
class HeardFrame:
    """A frame of sound as it reaches one hearer."""

    speaker: str
    number: int
    """Sequence number of the frame, counted by the speaker, modulo 65,536."""
    time: float
    """[s] Network time at which the frame began."""
    codec: Codec
    data: bytes
    gain: float
    """Ratio of the amplitude at the hearer to the amplitude at the speaker."""


@dataclasses.dataclass(frozen=True, slots=True)
class Block:
    """Recorded sound."""

    time: float
    """[s] Network time of the first sample."""
    samples: np.ndarray
    """Samples of the block [:data:`FRAME_SAMPLES`] float32; the sum of loud sounds may exceed 1."""


@dataclasses.dataclass(slots=True)
class _Voice:
    """State of the mixing of one speaker."""

    number: int
    end: int
    """Index of the sample after the speaker's last one."""
    gain: float
    last: np.ndarray
    decoder: opus.OpusDecoder | None = None


class Microphone:
    """Mixes sounds into blocks. Use it from one thread only."""

    def __init__(self) -> None:
        self.delay = DELAY
        """[s] Delay from the end of a block until it is recorded."""
        self.lost = 0
        """Number of frames that never arrived."""
        self.late = 0
        """Number of frames that arrived after their block had been recorded."""
        self.undecoded = 0
        """Number of frames that could not be decoded."""
        self._mix = np.zeros(_RING, np.float32)
        self._next: int | None = None
        """Index of the first sample of the next block; None until the first block."""
        self._voices: dict[str, _Voice] = {}
        self._tones: dict[str, tuple[int, float, float]] = {}
        """Sample up to which a tone is mixed, its amplitude at that sample, and its frequency [Hz], by source."""

    @property
    def missed(self) -> int:
        """Number of frames that are missing from the recording."""
        return self.lost + self.late + self.undecoded

    def hear(self, frame: HeardFrame) -> None:
        """Add the sound of a frame that has arrived to the recording."""
        voice = self._voices.pop(frame.speaker, None)
        step = 1 if voice is None else (frame.number - voice.number) % 65536
        if voice is not None and not 0 < step < 32768:  # the frame was received twice or out of order
            self._voices[frame.speaker] = voice
            self.late += step != 0
            return
        samples, decoder = self._decode(frame, None if voice is None else voice.decoder)
        if samples is None:
            self.undecoded += 1
            if voice is not None:
                self._voices[frame.speaker] = voice
            return
        start = round(frame.time * SAMPLE_RATE)
        before = frame.gain if voice is None else voice.gain
        if voice is not None:
            self.lost += step - 1
            if abs(start - voice.end) <= 2:
                start = voice.end
            # the frame overlaps the speaker's last one: a voice is not added to itself
            if 0 < voice.end - start < SAMPLE_RATE:
                self.late += 1
                self._voices[frame.speaker] = dataclasses.replace(voice, number=frame.number, decoder=decoder)
                return
            missing = start - voice.end
            if 1 < step <= 1 + MAX_CONCEALED and missing > 0:
                self._conceal(voice, missing)
        ramp = np.linspace(before, frame.gain, len(samples), dtype=np.float32)
        if not self._add(start, samples * ramp):
            self.late += 1
            self.delay = min(self.delay + FRAME, MAX_DELAY)
        if len(self._voices) >= MAX_SPEAKERS:
            del self._voices[next(iter(self._voices))]
        self._voices[frame.speaker] = _Voice(frame.number, start + len(samples), frame.gain, samples, decoder)

    def sound(self, source: str, frequency: float, gain: float, now: float) -> None:
        """Add a tone of ``frequency`` [Hz] to the recording, up to network time ``now`` [s]. It continues the tone of
        this ``source`` that was added before.

        The amplitude changes linearly from its previous value to ``gain``. Frequency 0 ends the tone.
        """
        end = round(now * SAMPLE_RATE)
        start, before, last = self._tones.pop(source, (end, 0.0, frequency))
        if start < end - 2 * FRAME_SAMPLES:  # the tone was not heard for a while
            start = end - 2 * FRAME_SAMPLES
            before = 0.0
        frequency = frequency or last
        if end > start and (gain or before):
            time = np.arange(start, end)
            wave = np.sin(2.0 * np.pi * (frequency * time / SAMPLE_RATE % 1.0))
            self._add(start, (wave * np.linspace(before, gain, len(time))).astype(np.float32))
        if len(self._tones) >= MAX_SPEAKERS:
            del self._tones[next(iter(self._tones))]
        self._tones[source] = end, gain, frequency

    def blocks(self, now: float) -> Iterator[Block]:
        """Yields the blocks that are complete at network time ``now`` [s]."""
        ready = int((now - self.delay) * SAMPLE_RATE)
        if self._next is None or not self._next - _RING < ready < self._next + _RING // 2:
            self._mix[:] = 0.0  # this is the first block, or the clock was set
            self._voices.clear()
            self._next = ready - ready % FRAME_SAMPLES
        while self._next + FRAME_SAMPLES <= ready:
            rows = np.arange(self._next, self._next + FRAME_SAMPLES) % _RING
            samples = self._mix[rows]
            self._mix[rows] = 0.0
            yield Block(self._next / SAMPLE_RATE, samples)
            self._next += FRAME_SAMPLES

    def _add(self, start: int, samples: np.ndarray) -> bool:
        """Add samples to the ring buffer from sample ``start`` on. Returns whether all of them were in time."""
        if self._next is None:
            return True
        skip = max(self._next - start, 0)
        end = start + len(samples)
        if skip >= len(samples) or end > self._next + _RING:
            return False
        self._mix[np.arange(start + skip, end) % _RING] += samples[skip:]
        return skip == 0

    def _conceal(self, voice: _Voice, count: int) -> None:
        """Replace ``count`` lost samples by repetitions of the voice's last frame that fade out."""
        count = min(count, MAX_CONCEALED * FRAME_SAMPLES)
        filled = np.resize(voice.last, count) * np.linspace(voice.gain, 0.0, count, dtype=np.float32)
        self._add(voice.end, filled)

    def _decode(
        self, frame: HeardFrame, decoder: opus.OpusDecoder | None
    ) -> tuple[np.ndarray | None, opus.OpusDecoder | None]:
        """Returns the samples of a frame (None if it cannot be decoded), and the speaker's decoder for its next
        frame."""
        if frame.codec is Codec.PCM16:
            return from_pcm(frame.data), decoder
        if decoder is None:
            if not opus.is_available():
                return None, None
            decoder = opus.OpusDecoder()
        return decoder.decode(frame.data), decoder
