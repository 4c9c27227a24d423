"""Voices: speech of this actor and, if this client listens, of the actors within hearing reach.

Keys: ``voice/<actor>`` has a frame of 20 ms in each message, as the speaker coded it. ``voice/<actor>/pcm`` has the
frame as PCM16, for hearers that cannot decode Opus; it is made only while one of them listens. Both are best effort. A
hearer subscribes to the actors within reach, except spectators that it may not hear. A key without a subscriber costs
nothing.
"""

from __future__ import annotations

import collections
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
"""Largest number of frames that wait to be taken. Older frames are dropped."""

MAX_AGE = 2.0
"""[s] Frames that began earlier before the present, or later after it, are refused."""

BURST = 25.0
"""Number of frames that a speaker may send at once in addition to the frames of the passing time: half a second, for
which a link may have held frames back."""


ROBOT_MOUTH = np.array([0.0, 0.0, 1.2])
"""[m] From a robot's base to its microphone and its loudspeaker. GUESSED."""


def mouth(kind: str, pose: RobotUpdate | HumanUpdate) -> np.ndarray:
    """Position from which an actor of a ``kind`` speaks [3] m: a person's head, a spectator's eyes, or a point above a
    robot's base."""
    if isinstance(pose, HumanUpdate):
        return pose.pose.head[:3]
    return pose.base_q[:3] + (ROBOT_MOUTH if kind == "robot" else 0.0)


class Heard(NamedTuple):
    """A frame of another actor."""

    speaker: Hello
    frame: VoiceFrame
    place: np.ndarray
    """[3] m Position of the speaker when the frame arrived."""


class _Source:
    """Another actor that may be heard."""

    def __init__(self, subscription: Subscription, now: float) -> None:
        self.subscription = subscription
        self.credit, self.credited = BURST, now
        """Number of frames that the speaker may send now, and the time at which it was computed [s]."""

    def admit(self, now: float) -> bool:
        """Whether to accept a frame: frames may arrive at most a quarter faster than real time."""
        self.credit = min(BURST, self.credit + 1.25 / FRAME * max(now - self.credited, 0.0))
        self.credited = now
        if self.credit < 1.0:
            return False
        self.credit -= 1.0
        return True


class VoiceSync(MessageSync):
    """Voices to and from one actor."""

    kind = VOICE

    def __init__(self, bus: Bus, hello: Hello, counters: Counters) -> None:
        self._bus = bus
        self._hello = hello
        self._counters = counters
        self.listens = False
        """Whether this actor wants to hear."""
        self.decodes_opus = True
        """Whether all listeners of this client can decode Opus."""
        self._made: list[Publisher] = []
        """Publishers of this actor's voice. Empty until it speaks."""
        self._numbers = [0, 0]
        self._sources: dict[str, _Source] = {}
        self._is_plain = False
        """Whether :attr:`_sources` subscribe to the keys with PCM16."""
        self._heard: collections.deque[Heard] = collections.deque(maxlen=MAX_WAITING)

    @property
    def _publishers(self) -> list[Publisher]:
        if not self._made:
            self._made = [self._bus.publisher(f"voice/{self._hello.name}{suffix}") for suffix in ("", "/pcm")]
        return self._made

    @property
    def is_heard(self) -> bool:
        """Whether anyone listens to this actor."""
        return self._publishers[0].matching

    @property
    def is_heard_plain(self) -> bool:
        """Whether anyone who cannot decode Opus listens to this actor."""
        return self._publishers[1].matching

    @property
    def may_speak(self) -> bool:
        """Whether anyone may hear this actor, by the server's setting for spectators."""
        return may_hear(self._hello.kind, "human", self._bus.spectators_speak_to)

    def say(self, time: float, codec: Codec, data: bytes, *, is_main: bool = True) -> None:
        """Send a frame that began at network ``time`` [s]. PCM16 goes to the hearers without Opus and, if ``is_main``,
        to the others, too."""
        if not self.may_speak:
            return
        for which, applies in enumerate((is_main, codec is Codec.PCM16)):
            if applies and self._publishers[which].matching:
                payload = encode_voice(VoiceFrame(self._numbers[which], time, codec, data))
                if self._publishers[which].put(payload):
                    self._numbers[which] += 1
                    self._counters.voice.count_out(payload)

    def update_interest(self, peers: Mapping[str, RemotePose], here: np.ndarray, now: float) -> None:
        """Listen to exactly the ``peers`` that are within reach of ``here`` [3] m and may be heard."""
        if self._is_plain == self.decodes_opus:
            self._is_plain = not self.decodes_opus
            self._drop(self._sources.keys())
        if not self.listens and not self._sources:
            return
        setting = self._bus.spectators_speak_to
        wanted = set()
        for name, peer in peers.items() if self.listens else ():
            if peer.update is None:
                continue
            reach = REACH * LAYER_HYSTERESIS if name in self._sources else REACH
            is_near = np.hypot(*(peer.update.base_q[:2] - here[:2])) <= reach
            if is_near and may_hear(peer.hello.kind, self._hello.kind, setting):
                wanted.add(name)
        self._drop(self._sources.keys() - wanted)
        for name in wanted - self._sources.keys():
            key = f"voice/{name}{'/pcm' if self._is_plain else ''}"
            self._sources[name] = _Source(self._bus.subscribe(key, KEEP_LAST_64), now)

    def receive(self, payload: bytes, sender: RemotePose, now: float, time: float) -> None:
        """Take a frame at own time ``now`` and network ``time`` [s]. Raises :class:`MessageError` if the payload is no
        frame, or its time is too far from the present."""
        source = self._sources.get(sender.hello.name)
        pose = sender.update
        if source is None or pose is None or not source.admit(now):
            self._counters.dropped += 1
            return
        frame = decode_voice(payload)
        if abs(frame.time - time) > MAX_AGE:
            raise MessageError(f"frame of sound of {frame.time - time:+.1f} s from now")
        self._heard.append(Heard(sender.hello, frame, mouth(sender.hello.kind, pose)))

    def take(self) -> list[Heard]:
        """Frames that arrived since the last call."""
        heard = list(self._heard)
        self._heard.clear()
        return heard

    def remove_peer(self, name: str) -> None:
        """An actor has left."""
        self._drop({name} & self._sources.keys())

    def _drop(self, names: Iterable[str]) -> None:
        for name in list(names):
            self._sources.pop(name).subscription.close()
