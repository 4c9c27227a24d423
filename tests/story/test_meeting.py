"""Two people in browsers and a robot meet: one points, says a word, picks a bunch, puts it into the other's box."""

from __future__ import annotations

import contextlib
import dataclasses
import threading

import numpy as np
import pytest

from benchmarks.support.browser import AS_RECORDED, browser_page, microphone, write_tone
from benchmarks.support.sound_recorder import SoundRecorder
from tests.audio.test_microphone import amplitude
from tests.support.waiting import wait
from vinesim.avatar.gestures import Gestures
from vinesim.avatar.tracked_human import TrackedHuman
from vinesim.client.client import Client, label_index
from vinesim.client.page.page_sound import PageSound
from vinesim.client.page.page_world import PageWorld
from vinesim.client.remote.remote_human import RemoteHuman
from vinesim.client.tasks.start_poses import bunch_centres
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ, label
from vinesim.scene.spec import load_scene
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.primitives.scene_primitives import Primitives
from vinesim.web.page_server import PageServer

pytestmark = pytest.mark.slow

BUNCH = 10
BOX = 0
BOX_PLACE = np.array([-2.4, -0.7, 0.0])
HANDED_OVER_FROM = BOX_PLACE[:2] + np.array([0.0, 0.6])
POINTS_FROM = 1.15
PICKS_FROM = 0.75
"""Distances of the first person from the bunch [m]."""
WORD = 500.0
SPOKEN = 0.5
WINDOW = 160
"""Frequency [Hz] and amplitude of the word, a tone; samples of 10 ms, five periods."""
HAND = BOX_PLACE + np.array([0.0, 0.08, 1.0])
"""Where the hand lets go [m]: the bunch hangs a bit ahead of it."""
STILL = 80
"""Steps for which the bunch is held still over the box before."""
TRIES = 3
"""Of the story."""
STEERING = """
(() => {
  const { eyes, hand } = vinesim.viewer, update = eyes.update.bind(eyes);
  const near = (value, most) => Math.min(Math.max(value, -most), most);
  window.steer = { place: null, at: null };
  eyes.update = (seconds) => {
    const { place, at } = steer;
    if (place) for (const axis of [0, 1]) eyes.place[axis] += near(place[axis] - eyes.place[axis], 1.2 * seconds);
    if (at) {
      const way = at.map((value, axis) => value - eyes.place[axis]), yaw = Math.atan2(way[1], way[0]);
      eyes.yaw += near(Math.atan2(Math.sin(yaw - eyes.yaw), Math.cos(yaw - eyes.yaw)), 3.0 * seconds);
      eyes.pitch += near(Math.atan2(way[2], Math.hypot(way[0], way[1])) - eyes.pitch, 3.0 * seconds);
      hand.distance = Math.min(Math.hypot(...way) + 0.02, 0.8);
    }
    return update(seconds);
  };
  return true;
})()
"""
"""Stands for a person's mouse and keys: walks to ``place`` and looks ``at`` a point, in the time that a person has."""


class Meeting:
    """Clients of anna, ben and a robot, which step in turn in one thread; two of them serve pages."""

    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.now = 0.0
        scene = load_scene("demo")
        model = generate(scene)
        boxes = model.box_pose.copy()
        boxes[BOX, :3] = BOX_PLACE
        self.model = dataclasses.replace(model, box_pose=boxes)
        self.bunch = bunch_centres(self.model)[BUNCH]
        starts = {
            "anna": frames.pose(np.array([self.bunch[0] - POINTS_FROM, self.bunch[1], 0.0])),
            "ben": frames.pose(BOX_PLACE - np.array([0.0, 0.7, 0.0]), frames.from_yaw(0.5 * np.pi)),
            "robot": frames.pose(np.array([-4.6, -0.4, 0.0])),
        }
        self.clients: dict[str, Client] = {}
        self.servers: dict[str, PageServer] = {}
        for name, start in starts.items():
            person = None if name == "robot" else TrackedHuman(start)
            client = Client(
                scene,
                self.model,
                load_description("vinebot") if person is None else None,
                self.hub.bus(name),
                name=name,
                pose=start,
                source=person,
                clock=lambda: self.now,
            )
            self.clients[name] = client
            if person is not None:
                world = PageWorld(client, person)
                self.servers[name] = server = PageServer(world, sound=PageSound(client))
                client.post_step.append(lambda _, world=world, server=server: world.collect(server))
        self.anna, self.ben, self.robot = self.clients.values()
        self.primitives = Primitives(self.model, grass=0.0)
        self.ear = SoundRecorder(self.robot, "robot", decodes_opus=False)

    @contextlib.contextmanager
    def run(self):
        """Step until the block ends."""
        stop = threading.Event()

        def step() -> None:
            while not stop.wait(0.001):
                for client in self.clients.values():
                    client.tick()
                self.hub.advance(client.physics.dt)
                self.now += client.physics.dt

        thread = threading.Thread(target=step, name="clients")
        with contextlib.ExitStack() as servers:
            for server in self.servers.values():
                servers.enter_context(server)
            thread.start()
            try:
                yield
            finally:
                stop.set()
                thread.join()

    def seen_by_robot(self) -> set[str]:
        """People in a picture of the robot's own camera."""
        mount = self.robot.robot.description.sensors_of("camera")[0]
        spec = CameraSpec.load(mount.type)
        primitives = self.primitives
        primitives.update(self.robot.physics.snapshot())
        frame = Camera(spec, spec.info(mount.frame, 0.25)).render(primitives, self.robot.robot.frame_pose(mount.frame))
        return {name for name in ("anna", "ben") if (frame.labels == label(Organ.HUMAN, label_index(name))).sum() > 50}

    def robot_hears(self, frequency: float) -> float:
        """Amplitude of a tone in the purest 10 ms that the robot's microphone has recorded since the last call; 0 if it
        has none. The clients are slower than the sound, so that parts of it are missing."""
        if not self.ear.blocks:
            return 0.0
        samples = self.ear.take()
        windows = samples[: len(samples) // WINDOW * WINDOW].reshape(-1, WINDOW)
        levels = np.array([amplitude(one, frequency) for one in windows])
        rest = np.maximum(2.0 * np.mean(windows**2, axis=1) - levels**2, 0.0)
        is_pure = (levels > 0.01) & (rest < (0.1 * levels) ** 2)
        return float(levels[is_pure].max(initial=0.0))

    def in_box(self, client: Client) -> bool:
        """Whether a client has the bunch between the walls of the box."""
        rigid = client.physics.rigid
        if BUNCH not in rigid.free_bunches:
            return False
        box = rigid.visual_q()[[visual.name for visual in rigid.visuals()].index(f"box/{BOX}")]
        return self.is_within(self.middle(rigid.bunch_pose(BUNCH)), box)

    def middle(self, bunch: np.ndarray) -> np.ndarray:
        """Middle [3] m of the bunch at a pose [7] of its upper end."""
        return frames.compose(bunch, frames.pose([0.5 * float(self.model.bunch_length[BUNCH]), 0.0, 0.0]))[:3]

    def is_within(self, point: np.ndarray, box: np.ndarray) -> bool:
        """Whether a point [3] m is between the walls of the box at a pose [7]."""
        local = frames.compose(frames.inverse(box), frames.pose(point))[:3]
        size = self.model.box_size[BOX]
        return bool((np.abs(local[:2]) < 0.5 * size[:2]).all() and 0.0 < local[2] < size[2])


def tap(page, code):
    page.key(code, down=True)
    page.key(code, down=False)


def point_at(page, point):
    page.run(f"steer.at = {[float(value) for value in point]}, 0")


def walk_to(page, x, y):
    page.run(f"steer.place = {[float(x), float(y)]}, 0")


@pytest.mark.xdist_group("browser")
def test_one_person_points_says_a_word_picks_and_lays_the_bunch_into_the_box_of_another(tmp_path):
    """Every step is judged by what the other clients, the other person's page, the robot's camera and its microphone
    hold.

    A browser without a graphics card draws less than twice a second on a busy machine, and who moves a hand that seldom
    may drop the bunch beside the box: then they begin anew.
    """
    for attempt in range(TRIES):
        try:
            meet(tmp_path)
        except AssertionError:
            if attempt == TRIES - 1:
                raise
        else:
            break


def meet(tmp_path):
    """The story, once."""
    meeting = Meeting()
    speaks = microphone(write_tone(tmp_path / "word.wav", WORD, SPOKEN))
    with meeting.run(), browser_page(*speaks) as a, browser_page() as b:
        for page, name, rate in ((a, "anna", 10), (b, "ben", 5)):
            page.call("Emulation.setDeviceMetricsOverride", width=160, height=120, deviceScaleFactor=1, mobile=False)
            page.open(meeting.servers[name].address + f"?triangles=100&rate={rate}&shadows=0", before=AS_RECORDED)
        for page in (a, b):
            wait(lambda page=page: page.run("window.vinesim?.drawn >= 2 || window.vinesim?.failure"), "a page draws")
            assert page.run("vinesim.failure") is None
        wait(lambda: {"anna", "robot"} <= meeting.ben.remote_actors.keys(), "all have met")
        wait(lambda: {"anna", "ben"} <= meeting.robot.remote_actors.keys(), "the robot has met both")
        a.run(STEERING)
        robot = meeting.robot.physics
        bunch = meeting.bunch

        # anna points at the bunch: on the robot's client her hand makes the gesture, towards the bunch
        point_at(a, bunch)
        tap(a, "KeyR")
        tap(a, "Digit3")

        def gesture() -> str:
            copy = meeting.robot.remote_actors["anna"]
            assert isinstance(copy, RemoteHuman)
            return "" if copy.pose is None else Gestures().name_of(copy.pose.right_fingers)

        wait(lambda: gesture() == "point", "the robot is told of the gesture")

        def off() -> float:
            palm = robot.hand("anna", "right").pose
            way = bunch - palm[:3]
            ahead = frames.rotate(palm[3:], np.array([1.0, 0.0, 0.0]))
            return float(np.degrees(np.arccos(ahead @ way / np.linalg.norm(way))))

        wait(lambda: off() < 10.0, "she points at the bunch, within 10 degrees")
        wait(lambda: meeting.seen_by_robot() == {"anna", "ben"}, "the robot's camera shows both")
        assert robot.state.bunch_attached[BUNCH]

        # she says a word: the robot's microphone records it as loud as it is there
        tap(a, "KeyM")
        heard: list[float] = []

        def is_heard() -> bool:
            heard.append(meeting.robot_hears(WORD))
            return heard[-1] > 0.0

        wait(is_heard, "the robot's microphone records the word")
        tap(a, "KeyM")
        mouth = meeting.anna.humans["anna"].pose.head[:3]
        distance = float(np.linalg.norm(mouth - meeting.robot.sound.place_of("robot")))
        assert heard[-1] == pytest.approx(SPOKEN / distance, rel=0.3)

        # she takes it and walks back with it: off its vine for all
        tap(a, "Digit3")
        walk_to(a, bunch[0] - PICKS_FROM, bunch[1])
        wait(lambda: meeting.anna.physics.hand("anna", "right").touching, "her hand reaches the bunch")
        tap(a, "Space")
        wait(lambda: meeting.anna.physics.hand("anna", "right").held is not None, "she holds it")
        walk_to(a, HANDED_OVER_FROM[0] - 0.5, bunch[1])  # until her hand pulls with all its 100 N
        a.run("steer.at = null")
        wait(lambda: not meeting.anna.physics.state.bunch_attached[BUNCH], "she has picked it")
        for client in meeting.clients.values():
            wait(lambda client=client: not client.physics.state.bunch_attached[BUNCH], f"{client.name} knows of it")

        # she brings it to ben's box, steps to where it hangs over the box, holds it still and opens her hand
        walk_to(a, *HANDED_OVER_FROM)
        point_at(a, HAND)
        seen: list[tuple[int, np.ndarray]] = []

        def off_box() -> np.ndarray:
            return (seen[-1][1] - BOX_PLACE)[:2]

        def is_still() -> bool:
            physics = meeting.ben.physics
            here = physics.tick, meeting.middle(physics.rigid.bunch_pose(BUNCH))
            seen.append(here)
            before = next((place for tick, place in reversed(seen) if tick <= here[0] - STILL), None)
            return before is not None and float(np.linalg.norm(here[1] - before)) < 0.01

        def is_still_over_box() -> bool:
            return is_still() and bool((np.abs(off_box()) < 0.1).all())

        wait(lambda: is_still() and np.linalg.norm(off_box()) < 0.4, "ben's client has the bunch still near his box")
        walk_to(a, *(HANDED_OVER_FROM - off_box()))
        wait(is_still_over_box, "ben's client has the bunch still over his box")
        tap(a, "Space")
        for client in meeting.clients.values():
            wait(lambda client=client: meeting.in_box(client), f"the bunch lies in the box of {client.name}'s world")

        # ben's page shows it there
        wait(lambda: b.run("vinesim.viewer.world.picked.size") == 1, "ben's page knows of the picked bunch")
        places = f"""(({{ world }}) => ['bunch/{BUNCH}', 'box/{BOX}'].map((name) => {{
            const carrier = world.bodies + 1 + world.names.indexOf(name);
            return [...world.poses.image.data.slice(8 * carrier, 8 * carrier + 8)];
        }}))(vinesim.viewer)"""

        def is_shown_in_box() -> bool:
            shown, box = (np.array([*pose[:3], *pose[4:]]) for pose in b.run(places))
            return meeting.is_within(meeting.middle(shown), box)

        wait(is_shown_in_box, "ben's page shows the bunch in his box")
        assert meeting.seen_by_robot() == {"anna", "ben"}
        assert (a.errors, b.errors) == ([], [])
