"""Voices, loudspeakers and the tones of lights between whole clients: what reaches whom, how loud, and how late."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.sound_delay import AS_WAVEFORM, LIGHT, TONE_OF_LIGHTS, VOICE, sound
from benchmarks.support.sound_recorder import SoundRecorder
from tests.audio.test_microphone import amplitude
from tests.support.contact_scenes import cane
from vinesim.audio.frame import FRAME, FRAME_SAMPLES, SAMPLE_RATE, Codec, to_pcm
from vinesim.audio.hearing import SpectatorsSpeakTo
from vinesim.client.client import Client
from vinesim.client.sound.exchange import MAX_WAITING
from vinesim.client.spectator import Spectator
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene
from vinesim.scene.values import LightPattern


class World:
    """Clients on one network in memory, in simulated time."""

    def __init__(self, *, delay=0.02, **actors):
        """``actors``: kind and x [m] of each, one a client."""
        self.hub = MemoryHub(delay=delay)
        self.now = 100.0
        scene = load_scene("demo")
        model = assemble([cane((0.0, 30.0, 2.0))])
        self.clients = {}
        self.ears = {}
        for name, (kind, x) in actors.items():
            description = load_description("vinebot") if kind == "robot" else None
            self.clients[name] = (Spectator if kind == "spectator" else Client)(
                scene,
                model,
                description,
                self.hub.bus(name),
                name=name,
                pose=frames.pose(np.array([x, 0.0, 0.0])),
                clock=lambda: self.now,
            )
            self.ears[name] = SoundRecorder(self.clients[name], name)
        self._phase = 0.0
        self.run(0.7)

    def run(self, seconds, speaker=None):
        """Steps; meanwhile an actor may say a tone of 440 Hz with the amplitude 0.5."""
        for step in range(round(seconds / 0.01)):
            if speaker and step % 2:
                time = self._phase + np.arange(FRAME_SAMPLES) / SAMPLE_RATE
                self._phase += FRAME
                sound = to_pcm(0.5 * np.sin(2.0 * np.pi * 440.0 * time))
                self.clients[speaker].sound.speak(speaker, Codec.PCM16, sound)
            for client in self.clients.values():
                client.tick()
            self.hub.advance(0.01)
            self.now += 0.01

    def hear(self, seconds, speaker=None):
        """What all hear in that time."""
        self.run(0.3, speaker)
        for ear in self.ears.values():
            ear.take()
        self.run(seconds, speaker)
        return {name: ear.take() for name, ear in self.ears.items()}


def test_a_robot_hears_a_person_five_times_softer_at_ten_metres_than_at_two():
    world = World(anna=("human", 0.0), bot=("robot", 2.0))
    place = world.clients["bot"].sound.place_of("bot")
    away = world.clients["anna"].humans["anna"].pose.head[:3] - place
    near = world.hear(0.5, "anna")
    assert np.abs(near["anna"]).max() == 0.0, "none hears its own voice"
    assert amplitude(near["bot"], 440.0) == pytest.approx(0.5 / np.linalg.norm(away), rel=0.02)
    robot = world.clients["bot"].physics.rigid
    base = robot.base_state("bot")[0].copy()
    height = away[2]
    base[0] = np.sqrt(25.0 * np.dot(away, away) - height**2)  # five times as far, from mouth to ear
    robot.place_robot("bot", base, robot.joint_state("bot")[0])
    far = world.hear(0.5, "anna")
    assert amplitude(near["bot"], 440.0) / amplitude(far["bot"], 440.0) == pytest.approx(5.0, rel=0.02)
    assert amplitude(far["bot"], 440.0) > 20.0 * amplitude(far["bot"], 700.0), "one pure tone"


def test_a_robots_loudspeaker_is_heard_by_people_and_spectators():
    world = World(bot=("robot", 0.0), anna=("human", 3.0), guest=("spectator", 5.0))
    said = 0.5 * np.sin(2.0 * np.pi * 500.0 * np.arange(SAMPLE_RATE) / SAMPLE_RATE)
    world.clients["bot"].sound.play("bot", to_pcm(said))
    heard = world.hear(0.4)
    for name in ("anna", "guest"):
        place = world.clients[name].sound.place_of(name) - world.clients["bot"].sound.place_of("bot")
        assert amplitude(heard[name], 500.0) == pytest.approx(0.5 / np.linalg.norm(place), rel=0.03)
    world.run(1.0)
    assert np.abs(world.hear(0.1)["anna"]).max() == 0.0, "it was played once"


def test_the_alarm_of_a_robot_is_heard_while_its_lights_are_lit_and_costs_no_byte():
    world = World(bot=("robot", 0.0), anna=("human", 3.0))
    bot = world.clients["bot"]
    bot.robot.command_lights(LightPattern.ALARM)
    assert np.abs(world.hear(0.5)["anna"]).max() == 0.0, "light alone"
    bot.robot.lights = type(bot.robot.lights)(LightPattern.ALARM, (255, 0, 0), True)
    heard = world.hear(2.0)
    tenths = np.abs(heard["anna"][: SAMPLE_RATE * 19 // 10]).reshape(-1, SAMPLE_RATE // 100).max(1)
    assert 0.4 < np.mean(tenths > 0.1) < 0.6, "half of the time, at 2 Hz"
    assert amplitude(heard["anna"], 1500.0) > 10.0 * amplitude(heard["anna"], 900.0)
    assert bot.replicators["bot"].counters.voice.messages_out == 0
    bot.robot.command_lights(LightPattern.OFF)
    assert np.abs(world.hear(0.2)["anna"]).max() == 0.0


def test_robots_are_deaf_to_spectators_unless_the_server_says_otherwise():
    world = World(guest=("spectator", 0.0), bot=("robot", 2.0), anna=("human", 3.0))
    heard = world.hear(0.2, "guest")
    assert amplitude(heard["anna"], 440.0) > 0.1
    assert np.abs(heard["bot"]).max() == 0.0
    assert world.clients["guest"].sound.voice_of("guest").may_speak
    world.hub.spectators_speak_to = SpectatorsSpeakTo.ALL
    assert amplitude(world.hear(0.2, "guest")["bot"], 440.0) > 0.1
    world.hub.spectators_speak_to = SpectatorsSpeakTo.NOBODY
    heard = world.hear(0.2, "guest")
    assert all(np.abs(samples).max() == 0.0 for samples in heard.values())
    assert not world.clients["guest"].sound.voice_of("guest").may_speak


def test_a_page_that_stood_still_is_not_heard_twice_at_once():
    world = World(anna=("human", 0.0), bot=("robot", 1.0))
    world.hear(0.2, "anna")
    world.run(0.4)
    sound = to_pcm(0.5 * np.sin(2.0 * np.pi * 500.0 * np.arange(FRAME_SAMPLES) / SAMPLE_RATE))
    for _ in range(20):
        world.clients["anna"].sound.speak("anna", Codec.PCM16, sound)
    world.run(0.4)
    heard = world.ears["bot"].take()
    assert 0.4 < np.abs(heard).max() < 0.51
    assert np.mean(np.abs(heard) > 0.01) < 0.25, "what was too much was dropped"
    assert world.clients["anna"].sound.dropped >= 14


def test_sound_that_a_loudspeaker_or_a_client_that_stands_still_has_no_room_for_is_counted():
    world = World(bot=("robot", 0.0))
    exchange = world.clients["bot"].sound
    second = bytes(2 * SAMPLE_RATE)
    exchange.play("bot", 29 * second)
    assert exchange.dropped == 0
    exchange.play("bot", 2 * second)
    assert exchange.dropped == round(1.0 / FRAME), "it has 30 s to play"
    for _ in range(MAX_WAITING + 3):
        exchange.speak("bot", Codec.PCM16, bytes(2 * FRAME_SAMPLES))
    assert exchange.dropped == round(1.0 / FRAME) + 3


def test_an_alarm_is_heard_with_its_light_and_a_voice_later_than_states_but_within_its_budget():
    """F94, F98; ``python -m benchmarks sound`` has the figures."""
    took = {row.case.split(": ")[1].split(",")[0]: row.value for row in sound((0.02,), 2) if "largest" in row.case}
    assert took[TONE_OF_LIGHTS] == took[LIGHT]
    assert took[LIGHT] <= took[AS_WAVEFORM] <= took[LIGHT] + 60.0
    assert took[LIGHT] < took[VOICE] <= 150.0


def test_frames_of_a_socket_that_jitters_follow_each_other_without_gaps():
    """Stamps of a voice are 20 ms apart although its frames come in bursts; after a pause it begins anew."""
    world = World(anna=("human", 0.0), bot=("robot", 2.0))
    for _ in range(20):
        for _ in range(2):
            world.clients["anna"].sound.speak("anna", Codec.PCM16, bytes(640))
        world.run(0.04)
    times = []
    for _ in range(2):
        frames_sent = []
        world.ears["bot"].hear = lambda step, into=frames_sent: into.extend(one.frame.time for one in step.frames)
        world.clients["anna"].sound.speak("anna", Codec.PCM16, bytes(640))
        world.clients["anna"].sound.speak("anna", Codec.PCM16, bytes(640))
        world.run(0.06)
        times.append(frames_sent)
        world.run(0.5)
    for pair in times:
        assert np.diff(pair) == pytest.approx([FRAME])
    assert times[1][0] - times[0][0] == pytest.approx(0.56, abs=0.03)
