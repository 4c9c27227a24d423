"""Two people in browsers and a robot meet: one points at a bunch and picks it, and all see it."""

from __future__ import annotations

import contextlib
import threading

import numpy as np
import pytest

from tests.support.browser import browser_page
from tests.support.waiting import wait
from vinesim import frames
from vinesim.avatar.gestures import Gestures
from vinesim.avatar.tracked_human import TrackedHuman
from vinesim.client.client import Client, label_index
from vinesim.client.page_world import PageWorld
from vinesim.client.remote.remote_human import RemoteHuman
from vinesim.client.tasks.start_poses import bunch_centres
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ, label
from vinesim.scene.spec import load_scene
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.scene.primitives import Primitives
from vinesim.web.page_server import PageServer

BUNCH = 10
POINTS_FROM, PICKS_FROM = 1.15, 0.75
"""Distances of the first person from the bunch [m]."""
PULLS_FROM_X = -2.9
"""Where that person pulls at the bunch with all of a hand's 100 N [m]."""
SECOND_PLACE = np.array([-2.4, -1.4, 0.0])
STEERING = """
(() => {
  const { eyes, hand } = vinesim.viewer, update = eyes.update.bind(eyes);
  const near = (value, most) => Math.min(Math.max(value, -most), most);
  window.steer = { place: null, at: null };
  eyes.update = (seconds) => {
    const { place, at } = steer;
    if (place) for (const axis of [0, 1]) eyes.place[axis] += near(place[axis] - eyes.place[axis], 0.04);
    if (at) {
      const way = at.map((value, axis) => value - eyes.place[axis]), yaw = Math.atan2(way[1], way[0]);
      eyes.yaw += near(Math.atan2(Math.sin(yaw - eyes.yaw), Math.cos(yaw - eyes.yaw)), 0.15);
      eyes.pitch += near(Math.atan2(way[2], Math.hypot(way[0], way[1])) - eyes.pitch, 0.15);
      hand.distance = Math.min(Math.hypot(...way) + 0.02, 0.8);
    }
    return update(seconds);
  };
  return true;
})()
"""
"""Stands for a person's mouse and keys: walks to ``place`` and looks ``at`` a point, at most so far in a picture."""


class Meeting:
    """Clients of anna, ben and a robot, which step in turn in one thread; two of them serve pages."""

    def __init__(self) -> None:
        self.hub, self.now = MemoryHub(), 0.0
        scene = load_scene("demo")
        model = generate(scene)
        self.model = model
        self.bunch = bunch_centres(self.model)[BUNCH]
        starts = {
            "anna": frames.pose(np.array([self.bunch[0] - POINTS_FROM, self.bunch[1], 0.0])),
            "ben": frames.pose(SECOND_PLACE, frames.from_yaw(0.5 * np.pi)),
            "robot": frames.pose(np.array([-4.6, -0.4, 0.0])),
        }
        self.clients: dict[str, Client] = {}
        self.servers: dict[str, PageServer] = {}
        for name, start in starts.items():
            person = None if name == "robot" else TrackedHuman(start)
            client = Client(
                scene, self.model, load_description("vinebot") if person is None else None, self.hub.bus(name),
                name=name, pose=start, source=person, clock=lambda: self.now,
            )  # fmt: skip
            self.clients[name] = client
            if person is not None:
                world = PageWorld(client, person)
                self.servers[name] = server = PageServer(world)
                client.post_step.append(lambda _, world=world, server=server: world.collect(server))
        self.anna, self.ben, self.robot = self.clients.values()

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
        mount = self.robot.robot.description.cameras[0]
        spec = CameraSpec.load(mount.type)
        primitives = Primitives(self.model, grass=0.0)
        primitives.update(self.robot.physics.snapshot())
        frame = Camera(spec, spec.info(mount.frame, 0.25)).render(
            primitives, self.robot.robot.frame_pose(mount.frame)
        )  # fmt: skip
        return {name for name in ("anna", "ben") if (frame.labels == label(Organ.HUMAN, label_index(name))).sum() > 50}


def tap(page, code):
    page.key(code, down=True)
    page.key(code, down=False)


def point_at(page, point):
    page.run(f"steer.at = {[float(value) for value in point]}, 0")


def walk_to(page, x, y):
    page.run(f"steer.place = {[float(x), float(y)]}, 0")


@pytest.mark.slow
@pytest.mark.xdist_group("browser")
def test_one_person_points_and_picks_and_all_others_see_it():
    """Every step is judged by what the other clients, the other person's page and the robot's camera hold."""
    meeting = Meeting()
    with meeting.run(), browser_page() as a, browser_page() as b:
        for page, name in ((a, "anna"), (b, "ben")):
            page.call("Emulation.setDeviceMetricsOverride", width=160, height=120, deviceScaleFactor=1, mobile=False)
            page.open(meeting.servers[name].address + "?triangles=15000")
        for page in (a, b):
            wait(lambda page=page: page.run("window.vinesim?.drawn >= 2 || window.vinesim?.failure"), "a page draws")
            assert page.run("vinesim.failure") is None
            page.run("vinesim.viewer.shadowAt = Infinity, 0")  # no shadows: the browser has no graphics card
        wait(lambda: {"anna", "robot"} <= meeting.ben.remote_actors.keys(), "all have met")
        wait(lambda: {"anna", "ben"} <= meeting.robot.remote_actors.keys(), "the robot has met both")
        a.run(STEERING)
        robot, bunch = meeting.robot.physics, meeting.bunch

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
            way, ahead = bunch - palm[:3], frames.rotate(palm[3:], np.array([1.0, 0.0, 0.0]))
            return float(np.degrees(np.arccos(ahead @ way / np.linalg.norm(way))))

        wait(lambda: off() < 10.0, "she points at the bunch, within 10 degrees")
        wait(lambda: meeting.seen_by_robot() == {"anna", "ben"}, "the robot's camera shows both")
        assert robot.state.bunch_attached[BUNCH]

        # she takes it and walks back with it: off its vine for all
        tap(a, "Digit3")
        walk_to(a, bunch[0] - PICKS_FROM, bunch[1])
        wait(lambda: meeting.anna.physics.hand("anna", "right").touching, "her hand reaches the bunch")
        tap(a, "Space")
        wait(lambda: meeting.anna.physics.hand("anna", "right").held is not None, "she holds it")
        walk_to(a, PULLS_FROM_X, bunch[1])
        a.run("steer.at = null")
        wait(lambda: not meeting.anna.physics.state.bunch_attached[BUNCH], "she has picked it")
        for client in meeting.clients.values():
            wait(lambda client=client: not client.physics.state.bunch_attached[BUNCH], f"{client.name} knows of it")

        wait(lambda: b.run("vinesim.viewer.world.picked.size") == 1, "ben's page knows of the picked bunch")
        assert meeting.seen_by_robot() == {"anna", "ben"}
        assert (a.errors, b.errors) == ([], [])
