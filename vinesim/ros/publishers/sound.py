"""Topics of the sound that a robot's microphone records, as messages of audio_common."""

from __future__ import annotations

import array
from collections.abc import Iterable

from vinesim.audio.frame import SAMPLE_RATE
from vinesim.ros.messages import convert
from vinesim.ros.topic import RELIABLE, TRANSIENT_LOCAL, Advertise, PendingMessage


class SoundPublisher:
    """Publishes ``audio``, ``audio_stamped`` and the latched ``audio_info``, named as in audio_capture of
    ros-drivers."""

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
        """Returns the message with the sound format, to be sent once. Subscribers that join late receive it, too."""
        return ((self._info, lambda: self._facts),)

    def pending(self, time: float, pcm: bytes) -> Iterable[PendingMessage]:
        """Returns the messages for sound (PCM16 of 16 kHz, mono) that begins at ``time`` of the world [s]."""
        plain, stamped = self._types
        data = array.array("B", pcm)

        def with_time() -> object:
            message = stamped(audio=plain(data=data))
            message.header.stamp = convert.stamp(time)
            return message

        return (self._plain, lambda: plain(data=data)), (self._stamped, with_time)
