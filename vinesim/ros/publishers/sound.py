"""What a robot's microphone records: as messages of audio_common, and how they are to be read."""

from __future__ import annotations

import array
from collections.abc import Iterable

from vinesim.audio.frame import SAMPLE_RATE
from vinesim.ros.messages import convert
from vinesim.ros.topic import RELIABLE, TRANSIENT_LOCAL, Advertise, PendingMessage


class SoundPublisher:
    """``audio``, ``audio_stamped`` and the latched ``audio_info``, as audio_capture of ros-drivers names them."""

    def __init__(self, advertise: Advertise) -> None:
        from audio_common_msgs.msg import AudioData, AudioDataStamped, AudioInfo

        self._types = AudioData, AudioDataStamped
        self._plain = advertise(AudioData, "audio", RELIABLE)
        self._stamped = advertise(AudioDataStamped, "audio_stamped", RELIABLE)
        self._info = advertise(AudioInfo, "audio_info", TRANSIENT_LOCAL)
        self._facts = AudioInfo(
            channels=1, sample_rate=SAMPLE_RATE, sample_format="S16LE", bitrate=16 * SAMPLE_RATE, coding_format="wave"
        )

    def pending_info(self) -> Iterable[PendingMessage]:
        """How the sound is to be read, once; late subscribers receive it, too."""
        return ((self._info, lambda: self._facts),)

    def pending(self, time: float, pcm: bytes) -> Iterable[PendingMessage]:
        """PCM16 that begins at a ``time`` of the world [s]."""
        plain, stamped = self._types
        data = array.array("B", pcm)

        def with_time() -> object:
            message = stamped(audio=plain(data=data))
            message.header.stamp = convert.stamp(time)
            return message

        return (self._plain, lambda: plain(data=data)), (self._stamped, with_time)
