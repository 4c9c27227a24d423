"""Voices: what an actor says, and what those within hearing reach say, if anything of this client listens.

Keys ``voice/<actor>``, a frame of 20 ms in each message as the speaker coded it, and ``voice/<actor>/pcm``, the same as
PCM16 for those who cannot decode Opus: it is made only while one of them listens. Best effort. A hearer subscribes to
the actors within reach, and to no spectator that it may not hear; a key without a subscriber costs nothing.
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
"""Frames that wait to be taken; older ones are dropped."""

MAX_AGE = 2.0
"""[s] Frames that began earlier before the present, or later after it, are refused."""

BURST = 25.0
"""Frames that a speaker may send at once beyond those of the passing time: what a link held back for half a second."""


ROBOT_MOUTH = np.array([0.0, 0.0, 1.2])
"""[m] From a robot's base to its microphone and its loudspeaker. GUESSED."""


def mouth(kind: str, pose: RobotUpdate | HumanUpdate) -> np.ndarray:
    """Where an actor of a ``kind`` speaks [3] m: a person's head, a spectator's eyes, above a robot's base."""
    if isinstance(pose, HumanUpdate):
        return pose.pose.head[:3]
    return pose.base_q[:3] + (ROBOT_MOUTH if kind == "robot" else 0.0)


class Heard(NamedTuple):
    """A frame of another actor."""

    speaker: Hello
    frame: VoiceFrame
    place: np.ndarray
    """[3] m Where the speaker was when it arrived."""


class _Source:
    """Another actor that may be heard."""

    def __init__(self, subscription: Subscription, now: float) -> None:
        self.subscription = subscription
        self.credit, self.credited = BURST, now
        """Frames that it may send now, and when they were counted [s]."""

    def admit(self, now: float) -> bool:
        """Whether a frame keeps to the pace of sound, a quarter faster at most."""
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
        """Whether all that listens here decodes Opus."""
        self._made: list[Publisher] = []
        """Empty until this actor speaks."""
        self._numbers = [0, 0]
        self._sources: dict[str, _Source] = {}
        self._is_plain = False
        """Whether :attr:`_sources` are those without Opus."""
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
        """Send a frame that began at network ``time`` [s]. PCM16 goes to those without Opus;
        ``is_main``: to the others, too."""
        if not self.may_speak:
            return
        for which, applies in enumerate((is_main, codec is Codec.PCM16)):
            if applies and self._publishers[which].matching:
                payload = encode_voice(VoiceFrame(self._numbers[which], time, codec, data))
                if self._publishers[which].put(payload):
                    self._numbers[which] += 1
                    self._counters.voice.count_out(payload)

    def update_interest(self, peers: Mapping[str, RemotePose], here: np.ndarray, now: float) -> None:
        """Listen to those of the ``peers`` within reach of ``here`` [3] m that may be heard, and to no others."""
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
        """Take a frame at own time ``now`` and network ``time`` [s]; :class:`MessageError` if it is none, or nothing of
        the present."""
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
