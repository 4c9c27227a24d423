"""What a robot's microphone gets in one step, as plain values for the process that mixes it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinesim.audio.hearing import gain
from vinesim.audio.microphone import HeardFrame
from vinesim.scene.values import TONE_LEVEL

if TYPE_CHECKING:
    from vinesim.client.sound.exchange import SoundStep


class MicrophoneStep(NamedTuple):
    """Sound at one place."""

    now: float
    """[s] of the network; blocks up to here may be complete."""
    to_world: float
    """[s] Time of the world less that of the network."""
    frames: tuple[HeardFrame, ...]
    tones: tuple[tuple[str, float, float], ...]
    """Source, frequency [Hz] and amplitude of each tone."""


def at_place(step: SoundStep, place: np.ndarray) -> MicrophoneStep:
    """What is heard at a ``place`` [3] m; what is beyond reach is left out."""

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
