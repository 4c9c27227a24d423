"""Voices between clients: who hears whom, at what distance, what it costs, and what a speaker cannot do to hearers."""

import numpy as np
import pytest

from benchmarks.support.fake_client import FakeClient, tree_row
from vinesim.audio.frame import FRAME_SAMPLES, Codec, to_pcm
from vinesim.audio.hearing import REACH, SpectatorsSpeakTo
from vinesim.net.codec.header import MAX_DATAGRAM, MessageError
from vinesim.net.codec.voice import VoiceFrame, decode_voice, encode_voice
from vinesim.net.transport.memory_bus import MemoryHub

TONE = to_pcm(0.5 * np.sin(0.1 * np.arange(FRAME_SAMPLES)))
OPUS = bytes((72,)) + bytes(50)


class Talk:
    """Actors of several clients on one network in memory."""

    def __init__(self, **places):
        """``places``: kind and x [m] of each."""
        self.hub = MemoryHub(delay=0.005)
        model = tree_row(2)
        self.actors = {
            name: FakeClient(self.hub.bus(name), model, (x, 0.0), kind=kind) for name, (kind, x) in places.items()
        }
        for actor in self.actors.values():
            actor.replicator.voices.listens = True
        self.run(0.7)

    def run(self, seconds):
        for _ in range(round(seconds / 0.025)):
            self.hub.advance(0.025)
            for actor in self.actors.values():
                actor.tick(self.hub.time)

    def say(self, name, codec=Codec.PCM16, data=TONE, count=1, time=None, **options):
        """Let an actor speak; who has heard how many frames."""
        for other in self.actors.values():
            other.replicator.voices.take()
        voices = self.actors[name].replicator.voices
        for number in range(count):
            voices.say(self.hub.time + 0.02 * number if time is None else time, codec, data, **options)
        self.run(0.05)
        heard = {other: actor.replicator.voices.take() for other, actor in self.actors.items()}
        return {other: len(frames) for other, frames in heard.items() if frames}

    def bytes_out(self, name):
        return self.actors[name].bus.bytes_out


def test_a_frame_goes_in_one_datagram_and_comes_out_as_it_went_in():
    for codec, data in ((Codec.PCM16, TONE), (Codec.OPUS, OPUS)):
        frame = VoiceFrame(7, 123.25, codec, data)
        payload = encode_voice(frame)
        assert len(payload) <= MAX_DATAGRAM
        assert decode_voice(payload) == frame


@pytest.mark.parametrize(
    ("codec", "data"), [(1, b""), (1, bytes(2000)), (1, b"\xff" * 9), (2, b"\0"), (0, TONE), (9, TONE)]
)
def test_what_is_no_frame_is_refused(codec, data):
    payload = bytearray(encode_voice(VoiceFrame(0, 1.0, Codec.PCM16, TONE)))
    with pytest.raises(MessageError):
        decode_voice(bytes(payload[:14]) + bytes((codec,)) + data)


def test_people_and_robots_hear_each_other_within_reach_and_a_voice_beyond_costs_nothing():
    talk = Talk(anna=("human", 0.0), ben=("human", 3.0), robot=("robot", 10.0), far=("human", REACH + 5.0))
    assert talk.say("anna") == {"ben": 1, "robot": 1}
    assert talk.say("far") == {"robot": 1}, "20 m away; the others are beyond reach"
    talk.actors["far"].place[0] = 200.0
    talk.run(0.5)
    voices = talk.actors["far"].replicator.voices
    assert not voices.is_heard
    assert talk.say("far") == {}
    sent = talk.actors["far"].replicator.counters.voice.bytes_out
    assert sent == len(encode_voice(VoiceFrame(0, 0.0, Codec.PCM16, TONE)))


def test_who_does_not_listen_receives_nothing():
    talk = Talk(anna=("human", 0.0), robot=("robot", 2.0))
    talk.actors["robot"].replicator.voices.listens = False
    talk.run(0.1)
    assert talk.say("anna") == {}
    assert talk.actors["anna"].replicator.counters.voice.bytes_out == 0


def test_only_one_who_cannot_decode_opus_is_sent_pcm():
    talk = Talk(anna=("human", 0.0), ben=("human", 1.0), robot=("robot", 2.0))
    assert not talk.actors["anna"].replicator.voices.is_heard_plain
    talk.actors["robot"].replicator.voices.decodes_opus = False
    talk.run(0.1)
    assert talk.actors["anna"].replicator.voices.is_heard_plain
    assert talk.say("anna", Codec.OPUS, OPUS) == {"ben": 1}
    assert talk.say("anna", Codec.PCM16, TONE, is_main=False) == {"robot": 1}
    assert talk.say("anna", Codec.PCM16, TONE) == {"ben": 1, "robot": 1}, "a speaker without Opus"


@pytest.mark.parametrize(
    ("setting", "hearers"),
    [("nobody", {}), ("people", {"anna": 1, "guest": 1}), ("all", {"anna": 1, "guest": 1, "robot": 1})],
)
def test_the_servers_setting_decides_who_hears_spectators(setting, hearers):
    talk = Talk(visitor=("spectator", 0.0), anna=("human", 1.0), guest=("spectator", 2.0), robot=("robot", 3.0))
    talk.hub.spectators_speak_to = SpectatorsSpeakTo(setting)
    talk.run(0.1)
    assert talk.say("visitor") == hearers
    assert talk.say("anna") == {"guest": 1, "robot": 1, "visitor": 1}, "spectators and robots hear people"


def test_a_speaker_that_ignores_the_setting_is_not_heard():
    """Its own program may be changed: hearers apply the setting themselves."""
    talk = Talk(visitor=("spectator", 0.0), robot=("robot", 3.0))
    talk.actors["visitor"].bus.publisher("voice/visitor").put(
        encode_voice(VoiceFrame(0, talk.hub.time, Codec.PCM16, TONE))
    )
    talk.run(0.05)
    assert talk.actors["robot"].replicator.voices.take() == []


def test_a_flood_and_frames_of_another_time_are_dropped_and_counted():
    talk = Talk(anna=("human", 0.0), robot=("robot", 2.0))
    counters = talk.actors["robot"].replicator.counters
    before = counters.dropped
    assert 20 <= talk.say("anna", count=60, time=talk.hub.time)["robot"] <= 30
    assert counters.dropped - before >= 30
    talk.run(1.0)
    assert talk.say("anna", time=talk.hub.time - 60.0) == {}
    assert counters.malformed == 1
    assert talk.say("anna") == {"robot": 1}
