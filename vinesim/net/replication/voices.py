"""Voices: sends the voice of one actor, and receives the voices of the actors within hearing reach.

Keys: a message under ``voice/<actor>`` contains a frame of 20 ms as the speaker has encoded it. A message under
``voice/<actor>/pcm`` contains the frame as PCM16, for listeners that cannot decode Opus. It is made only while such an
actor listens. All messages are best effort. An actor subscribes to the actors within reach, except spectators that it
may not hear. A key without a subscriber costs nothing.
"""

from __future__ import annotations

import collections
import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from vinesim.audio.frame import FRAME, Codec
from vinesim.audio.hearing import REACH, may_hear
from vinesim.net.codec.control import Hello
from vinesim.net.codec.header import MessageError
from vinesim.net.codec.messages import Counters
from vinesim.net.codec.voice import VOICE, VoiceFrame, decode_voice, encode_voice
from vinesim.net.replication.direct_messages import MessageSync
from vinesim.net.replication.interest import LAYER_HYSTERESIS
from vinesim.net.replication.remote_pose import RemotePose
from vinesim.net.transport.bus import KEEP_LAST_64, Bus, Publisher, Subscription
from vinesim.scene.values import HumanUpdate, RobotUpdate

MAX_WAITING = 1024
"""Largest number of received frames that wait for :meth:`VoiceSync.take`. The oldest frames are dropped."""

MAX_AGE = 2.0
"""Largest difference between the time of a frame and the present; other frames are refused [s]."""

BURST = 25.0
"""Number of frames by which one speaker may exceed its usual rate at once: half a second of sound, which a slow link
may have delayed."""


ROBOT_MOUTH = np.array([0.0, 0.0, 1.2])
"""Position of a robot's microphone and loudspeaker relative to its base [3] m. GUESSED."""


def mouth(kind: str, pose: RobotUpdate | HumanUpdate) -> np.ndarray:
    """Returns the position from which an actor speaks [3] m: a person's head, a spectator's eyes, or a point above a
    robot's base. ``kind``: kind of the actor."""
    if isinstance(pose, HumanUpdate):
        return pose.pose.head[:3]
    return pose.base_q[:3] + (ROBOT_MOUTH if kind == "robot" else 0.0)


class Heard(NamedTuple):
    """A received frame of the voice of another actor."""

    speaker: Hello
    frame: VoiceFrame
    place: np.ndarray
    """Position of the speaker when the frame arrived [3] m."""


class _Source:
    """Another actor to whose voice this actor subscribes."""

    def __init__(self, subscription: Subscription, now: float) -> None:
        self.subscription = subscription
        self.credit, self.credited = BURST, now
        """Number of frames that may arrive at once, and the own time at which this number was computed [s]."""

    def admit(self, now: float) -> bool:
        """Whether to accept a frame that arrives at own time ``now`` [s].

        Frames may arrive at most a quarter faster than real time, besides a burst of :data:`BURST` frames.
        """
        self.credit = min(BURST, self.credit + 1.25 / FRAME * max(now - self.credited, 0.0))
        self.credited = now
        if self.credit < 1.0:
            return False
        self.credit -= 1.0
        return True


class VoiceSync(MessageSync):
    """Sends and receives voices for one actor."""

    kind = VOICE

    def __init__(self, bus: Bus, hello: Hello, counters: Counters) -> None:
        self._bus = bus
        self._hello = hello
        self._counters = counters
        self.listens = False
        """Whether this actor listens to other actors."""
        self.decodes_opus = True
        """Whether all players of received voices in this client can decode Opus."""
        self._made: list[Publisher] = []
        """Publishers of this actor's voice: of frames as the speaker has encoded them, and of PCM16. Empty before the
        first use."""
        self._numbers = [0, 0]
        self._sources: dict[str, _Source] = {}
        self._is_plain = False
        """Whether :attr:`_sources` subscribe to the keys with PCM16."""
        self._heard: collections.deque[Heard] = collections.deque(maxlen=MAX_WAITING)

    @property
    def _publishers(self) -> list[Publisher]:
        """Publishers of this actor's voice: of frames as the speaker has encoded them, and of PCM16. Declared at the
        first use."""
        if not self._made:
            self._made = [self._bus.publisher(f"voice/{self._hello.name}{suffix}") for suffix in ("", "/pcm")]
        return self._made

    @property
    def is_heard(self) -> bool:
        """Whether another actor listens to this one and can decode Opus."""
        return self._publishers[0].matching

    @property
    def is_heard_plain(self) -> bool:
        """Whether another actor listens to this one and cannot decode Opus, so that it needs plain PCM16."""
        return self._publishers[1].matching

    @property
    def may_speak(self) -> bool:
        """Whether people may hear this actor, by the server's setting for spectators."""
        return may_hear(self._hello.kind, "human", self._bus.spectators_speak_to)

    def say(self, time: float, codec: Codec, data: bytes, *, is_main: bool = True) -> None:
        """Send a frame of this actor's voice that began at network ``time`` [s].

        A frame in PCM16 is sent to listeners that cannot decode Opus. If ``is_main``, a frame in any codec is sent to
        all other listeners.
        """
        if not self.may_speak:
            return
        for which, applies in enumerate((is_main, codec is Codec.PCM16)):
            if applies and self._publishers[which].matching:
                payload = encode_voice(VoiceFrame(self._numbers[which], time, codec, data))
                if self._publishers[which].put(payload):
                    self._numbers[which] += 1
                    self._counters.voice.count_out(payload)

    def update_interest(self, peers: Mapping[str, RemotePose], here: np.ndarray, now: float) -> None:
        """Subscribe to exactly those ``peers`` that are within hearing reach of ``here`` [3] m and may be heard.

        ``now``: own time [s].
        """
        if self._is_plain == self.decodes_opus:
            self._is_plain = not self.decodes_opus
            self._drop(self._sources.keys())
        if not self.listens and not self._sources:
            return
        setting = self._bus.spectators_speak_to
        wanted = set()
        for name, peer in peers.items() if self.listens else ():
            if peer.place is None:
                continue
            reach = REACH * LAYER_HYSTERESIS if name in self._sources else REACH
            is_near = math.dist(peer.place[:2], here[:2]) <= reach
            if is_near and may_hear(peer.hello.kind, self._hello.kind, setting):
                wanted.add(name)
        self._drop(self._sources.keys() - wanted)
        for name in wanted - self._sources.keys():
            key = f"voice/{name}{'/pcm' if self._is_plain else ''}"
            self._sources[name] = _Source(self._bus.subscribe(key, KEEP_LAST_64), now)

    def receive(self, payload: bytes, sender: RemotePose, now: float, time: float) -> None:
        """Store a frame of another actor that arrived at own time ``now`` and network ``time`` [s].

        Raises :class:`MessageError` if the frame is invalid, or its time is too far from the present.
        """
        source = self._sources.get(sender.hello.name)
        if source is None or sender.place is None or not source.admit(now):
            self._counters.dropped += 1
            return
        frame = decode_voice(payload)
        if abs(frame.time - time) > MAX_AGE:
            raise MessageError(f"frame of sound of {frame.time - time:+.1f} s from now")
        place = sender.place if sender.update is None else mouth(sender.hello.kind, sender.update)
        self._heard.append(Heard(sender.hello, frame, place))

    def take(self) -> list[Heard]:
        """Returns the frames that arrived since the last call."""
        heard = list(self._heard)
        self._heard.clear()
        return heard

    def remove_peer(self, name: str) -> None:
        """Unsubscribe from an actor that has left."""
        self._drop({name} & self._sources.keys())

    def _drop(self, names: Iterable[str]) -> None:
        """Unsubscribe from the voices of these actors."""
        for name in list(names):
            self._sources.pop(name).subscription.close()
