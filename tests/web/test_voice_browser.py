"""Sound through a real browser: its microphone to a robot of another client, and a robot's loudspeaker to its ears."""

import time

import numpy as np
import pytest

from benchmarks.support.browser import AS_RECORDED, browser_page, microphone, write_tone
from benchmarks.support.sound_recorder import SoundRecorder
from tests.audio.test_microphone import amplitude
from tests.support.contact_scenes import cane
from tests.support.live_page import SteppedPage
from tests.support.waiting import wait
from vinesim.audio import opus
from vinesim.audio.frame import SAMPLE_RATE, to_pcm
from vinesim.avatar.tracked_human import TrackedHuman
from vinesim.client.client import Client
from vinesim.client.page.page_sound import PageSound
from vinesim.client.page.page_world import PageWorld
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene
from vinesim.scene.values import LightPattern, Lights
from vinesim.web.page_server import PageServer


class LiveTalk(SteppedPage):
    """A person with a page, and a robot of another client 2 m away; both step in a thread."""

    def __init__(self):
        self.hub = MemoryHub()
        scene = load_scene("demo")
        model = assemble([cane((0.0, 30.0, 2.0))])
        start = frames.pose(np.zeros(3))
        source = TrackedHuman(start, 1.75)
        self.anna = Client(scene, model, None, self.hub.bus("anna"), name="anna", pose=start, source=source)
        there = frames.pose(np.array([2.0, 0.0, 0.0]))
        self.bot = Client(scene, model, load_description("vinebot"), self.hub.bus("bot"), name="bot", pose=there)
        self.ear = SoundRecorder(self.bot, "bot", decodes_opus=opus.is_available())
        world = PageWorld(self.anna, source)
        super().__init__(PageServer(world, sound=PageSound(self.anna)), self._tick)
        self.anna.post_step.append(lambda _: world.collect(self.server))
        self._before = time.monotonic()

    def _tick(self):
        """A step of both; messages travel for as long as it took."""
        self.anna.tick()
        self.bot.tick()
        before = self._before
        self._before = time.monotonic()
        self.hub.advance(self._before - before)

    def loudness(self, frequency):
        """Amplitude of a tone in the purest 50 ms that the robot hears: on a busy machine a voice has gaps."""

        def purest():
            self.ear.blocks = []
            wait(lambda: len(self.ear.blocks) >= 25, "half a second at the robot")
            windows = self.ear.take()[: 10 * 800].reshape(10, 800)
            levels = np.array([amplitude(one, frequency) for one in windows])
            rest = 2.0 * np.mean(windows**2, axis=1) - levels**2
            best = np.argmin(rest / np.maximum(levels, 1e-9) ** 2)
            found.append((levels[best], np.sqrt(max(rest[best], 0.0))))
            return found[-1][1] < 0.05 * found[-1][0]

        found = []
        wait(purest, "a pure tone at the robot")
        return found[-1][0]

    def distance(self):
        mouth = self.anna.humans["anna"].pose.head[:3]
        return float(np.linalg.norm(mouth - self.bot.sound.place_of("bot")))


@pytest.mark.slow
@pytest.mark.xdist_group("browser")
def test_a_word_in_a_page_reaches_a_robot_and_a_robots_loudspeaker_reaches_the_page(tmp_path):
    speaks = microphone(write_tone(tmp_path / "tone.wav", 440.0, 0.5))
    with LiveTalk() as live, browser_page(*speaks) as page:
        page.call("Emulation.setDeviceMetricsOverride", width=320, height=240, deviceScaleFactor=1, mobile=False)
        page.open(live.server.address + "?triangles=3000&rate=10", before=AS_RECORDED)
        wait(lambda: page.run("window.vinesim?.drawn >= 3 || window.vinesim?.failure"), "three states are drawn")
        assert page.run("vinesim.voice.counts.sent") == 0
        page.run("document.querySelectorAll('#sound button')[1].click()")
        wait(lambda: page.run("vinesim.voice.counts.sent") > 50, "a second was said")
        assert page.run("document.querySelector('#sound span').textContent") == ""
        heard = {}
        for goal in (2.0, 10.0):

            def stand(goal=goal):
                rigid = live.bot.physics.rigid
                base = rigid.base_state("bot")[0].copy()
                mouth = live.anna.humans["anna"].pose.head
                height = mouth[2] - live.bot.sound.place_of("bot")[2]
                base[:2] = mouth[:2] + np.array([np.sqrt(goal**2 - height**2), 0.0])
                rigid.place_robot("bot", base, rigid.joint_state("bot")[0])

            live.due.append(stand)
            wait(lambda goal=goal: abs(live.distance() - goal) < 0.02, "the robot stands there")
            live.ear.blocks = []
            wait(lambda: len(live.ear.blocks) >= 30, "what was said before is over")
            heard[goal] = live.loudness(440.0)
        assert heard[2.0] / heard[10.0] == pytest.approx(5.0, rel=0.1)
        assert heard[2.0] == pytest.approx(0.25, rel=0.15)

        # the other way: what the robot plays is heard in the page, and the tone of its lights
        said = 0.5 * np.sin(2.0 * np.pi * 625.0 * np.arange(20 * SAMPLE_RATE) / SAMPLE_RATE)
        live.due.append(lambda: live.bot.sound.play("bot", to_pcm(said)))
        live.due.append(lambda: setattr(live.bot.robot, "lights", Lights(LightPattern.ALARM, (255, 0, 0), True)))
        wait(lambda: page.run("vinesim.voice.speakers.get('bot')?.received > 5"), "frames of the robot arrive")
        page.run("""
          vinesim.ear = new AnalyserNode(vinesim.voice.context, { fftSize: 4096 });
          vinesim.voice.speakers.get("bot").player.connect(vinesim.ear);
          vinesim.peak = () => {
            const bins = new Float32Array(vinesim.ear.frequencyBinCount);
            vinesim.ear.getFloatFrequencyData(bins);
            return bins.indexOf(Math.max(...bins)) * 48000 / 4096;
          }, 0""")
        wait(lambda: abs(page.run("vinesim.peak()") - 625.0) < 13.0, "the page plays the robot's tone")
        wait(lambda: page.run("vinesim.voice.tones.get('bot')?.level.gain.value > 0.4"), "the alarm sounds in the page")
        wait(lambda: page.run("vinesim.voice.tones.get('bot')?.level.gain.value < 0.01"), "it ends between two flashes")
        place = page.run("vinesim.voice.speakers.get('bot').place")
        np.testing.assert_allclose(place, live.bot.sound.place_of("bot"), atol=0.1)
        assert page.errors == []
        assert live.server.voice.refused == 0


@pytest.mark.long
@pytest.mark.xdist_group("browser")
def test_what_a_browser_lacks_to_speak_is_said_with_the_remedy():
    refuse = "navigator.mediaDevices.getUserMedia = async () => { throw new DOMException('', '%s'); };"
    clicks_may_come_from_scripts = "--autoplay-policy=no-user-gesture-required"
    with LiveTalk() as live, browser_page(clicks_may_come_from_scripts) as page:
        page.resize(320, 240)
        for lacks, said in (
            (refuse % "NotFoundError", "no microphone was found: connect one"),
            (refuse % "NotAllowedError", "allow it at the address bar"),
            ("Object.defineProperty(window, 'isSecureContext', {value: false});", "start the client with --page-lan"),
        ):
            page.open(live.server.address + "?triangles=3000&rate=10&shadows=0", before=lacks)
            wait(lambda: page.run("window.vinesim?.drawn >= 1 || window.vinesim?.failure"), "a state is drawn")
            page.run("document.querySelectorAll('#sound button')[1].click()")
            told = "document.querySelector('#sound span').textContent"
            wait(lambda said=said, told=told: said in page.run(told), said)
            assert page.run("vinesim.failure") is None
            assert page.errors == []
