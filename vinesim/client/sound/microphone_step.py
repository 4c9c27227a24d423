"""Input of a robot's microphone in one step, as plain values for the process that mixes sound."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinesim.audio.hearing import gain
from vinesim.audio.microphone import HeardFrame
from vinesim.scene.values import TONE_LEVEL

if TYPE_CHECKING:
    from vinesim.client.sound.exchange import SoundStep


class MicrophoneStep(NamedTuple):
    """Sound at one place in one step."""

    now: float
    """[s] Network time; blocks up to this time may be complete."""
    to_world: float
    """[s] World time minus network time."""
    frames: tuple[HeardFrame, ...]
    tones: tuple[tuple[str, float, float], ...]
    """Source, frequency [Hz] and amplitude of each tone."""


def at_place(step: SoundStep, place: np.ndarray) -> MicrophoneStep:
    """Returns the sounds of a step that are heard at ``place`` [3] m; sounds beyond reach are left out."""

    def loudness(source: np.ndarray) -> float:
        return gain(float(np.linalg.norm(source - place)))

    heard = ((spoken.speaker, spoken.frame, loudness(spoken.place)) for spoken in step.frames)
    return MicrophoneStep(
        step.now,
        step.to_world,
        tuple(
            HeardFrame(speaker, frame.number, frame.time, frame.codec, frame.data, level)
            for speaker, frame, level in heard
            if level > 0.0
        ),
        tuple(
            (tone.source, tone.frequency, TONE_LEVEL * loudness(tone.place) if tone.frequency else 0.0)
            for tone in step.tones
        ),
    )
