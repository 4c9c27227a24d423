"""A live vineyard with a page, in a real browser: for tests of the page."""

from __future__ import annotations

import contextlib
import threading

import numpy as np

from tests.support.waiting import wait
from vinesim.avatar.gestures import GESTURES, Gestures
from vinesim.avatar.tracked_human import TrackedHuman
from vinesim.client.client import Client
from vinesim.client.page.page_world import MAX_PRIMITIVES, PageWorld
from vinesim.client.spectator import Spectator
from vinesim.core import frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.web.page_server import PageServer

BUNCH = 10
"""The bunch before which the page looks or the person stands."""
VICTORY = (1.0, 0.0, 0.0, 1.0, 1.0)
"""Fingers on the button a of a person."""
CONTROLS = "[...document.querySelectorAll('button, input, select, summary')].filter((one) => one.checkVisibility())"


class SteppedPage:
    """A page's server, and the clients behind it, which step in a thread of their own, as in their processes."""

    def __init__(self, server, step):
        self.server = server
        self._step = step
        self.due = []
        """Called once before the next step."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="clients")

    def _run(self):
        while not self._stop.wait(0.005):
            while self.due:
                self.due.pop()()
            self._step()

    def __enter__(self):
        self.server.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *exception):
        self._stop.set()
        self._thread.join()
        self.server.__exit__(*exception)


class LiveVineyard(SteppedPage):
    """A client that steps in a thread of its own, as in its process: a spectator or a person before a bunch."""

    def __init__(self, bus, *, is_person=False, port=0, most=MAX_PRIMITIVES):
        scene = load_scene("demo")
        model = generate(scene)
        hangs = model.forward_kinematics(model.joint_settled)[model.bunch_body[BUNCH]]
        self.bunch = frames.compose(hangs, frames.pose(np.array([0.06, 0.0, 0.0])))[:3]
        person = None
        if is_person:
            start = frames.pose(np.array([self.bunch[0] - 0.75, self.bunch[1], 0.0]))
            person = TrackedHuman(start, 1.75, gestures=Gestures(GESTURES, {"a": VICTORY}))
            self.client = Client(scene, model, None, bus, name="viewer", pose=start, source=person)
        else:
            eye = frames.pose(self.bunch - np.array([0.7, 0.0, 0.0]))
            self.client = Spectator(scene, model, None, bus, name="viewer", pose=eye)
        self.world = PageWorld(self.client, person, most)
        super().__init__(PageServer(self.world, port), self.client.tick)
        self.client.post_step.append(lambda _: self.world.collect(self.server))

    @contextlib.contextmanager
    def paused(self):
        """The client stands still within the block."""
        standing = threading.Event()
        go_on = threading.Event()
        self.due.append(lambda: (standing.set(), go_on.wait()))
        standing.wait()
        try:
            yield
        finally:
            go_on.set()


def open_page(page, live, before=""):
    """Open the page, and let it draw little: the browser of a test has no graphics card."""
    page.resize(320, 240)
    page.open(live.server.address + "?triangles=10000&rate=10&shadows=0", before=before)
    wait(lambda: page.run("window.vinesim?.drawn >= 3 || window.vinesim?.failure"), "three states are drawn")
    assert page.run("vinesim.failure") is None
    assert page.errors == []


def look_at(page, point):
    """Turn the page's eyes to a point [3] m; where they are [3] m."""
    eye = np.array(page.run("vinesim.viewer.eyes.place"))
    way = point - eye
    pitch = np.arctan2(way[2], np.hypot(*way[:2]))
    page.run(f"vinesim.viewer.eyes.yaw = {np.arctan2(way[1], way[0])}, vinesim.viewer.eyes.pitch = {pitch}, 0")
    return eye


def press(page, code):
    """Press a key once."""
    page.key(code, down=True)
    page.key(code, down=False)


@contextlib.contextmanager
def touch_screen(page, width, height):
    """A phone without a mouse, within the block."""
    page.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": True}
    page.call("Emulation.setDeviceMetricsOverride", **metrics)
    try:
        yield
    finally:
        page.call("Emulation.setTouchEmulationEnabled", enabled=False)


def is_drawn_anew(page):
    """Wait until pictures begun from now on are drawn."""
    drawn = page.run("vinesim.frames")
    wait(lambda: page.run("vinesim.frames") > drawn + 1, "two pictures later")
