"""The page in a real browser: it draws the live vineyard within its budgets, and what happens there is seen."""

import threading

import numpy as np
import pytest

from tests.support.browser import browser_page
from tests.support.waiting import wait
from vinesim import frames
from vinesim.client.page_world import PageWorld
from vinesim.client.spectator import Spectator
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene
from vinesim.web.page_server import WINDOW, PageServer

MAX_CALLS, MAX_TRIANGLES, MAX_BYTES = 20, 300_000, 4_000_000
"""Of one picture for one eye, and of the vineyard that a page loads [B]."""
BUNCH = 10


class LiveVineyard:
    """A client that steps in a thread of its own, as in its process."""

    def __init__(self, bus):
        model = generate(load_scene("demo"))
        hangs = model.forward_kinematics(model.joint_settled)[model.bunch_body[BUNCH]]
        self.bunch = frames.compose(hangs, frames.pose(np.array([0.06, 0.0, 0.0])))[:3]
        eye = self.bunch - np.array([0.7, 0.0, 0.0])
        self.client = Spectator(load_scene("demo"), model, None, bus, name="viewer", pose=frames.pose(eye))
        self.world = PageWorld(self.client)
        self.server = PageServer(self.world)
        self.client.post_step.append(lambda _: self.world.collect(self.server))
        self.due = []
        """Called once before the next step."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="client")

    def _run(self):
        while not self._stop.wait(0.005):
            while self.due:
                self.due.pop()()
            self.client.tick()

    def __enter__(self):
        self.server.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *exception):
        self._stop.set()
        self._thread.join()
        self.server.__exit__(*exception)


@pytest.mark.slow
@pytest.mark.xdist_group("browser")
def test_the_live_vineyard_in_a_browser():
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus) as live, browser_page() as page:
        page.open(live.server.address)
        wait(lambda: page.run("window.vinesim?.drawn >= 3 || window.vinesim?.failure"), "three states are drawn")
        assert page.run("vinesim.failure") is None
        assert page.errors == []
        assert 0 < page.run("vinesim.calls") <= MAX_CALLS
        assert 50_000 < page.run("vinesim.triangles") <= MAX_TRIANGLES
        assert len(live.world.scene()) <= MAX_BYTES
        page.run("vinesim.viewer.world.budget = 60000, vinesim.viewer.world.listedAt = null")  # for a slow machine
        wait(lambda: page.run("vinesim.triangles") <= 60_000, "fewer triangles are drawn")
        before = page.picture()
        assert before.std() > 30.0, "a vineyard, not one colour"

        # a page whose loop stands still gets no more than the window
        page.run("vinesim.viewer.renderer.setAnimationLoop(null)")
        sent = live.server.states_sent
        tick = live.client.physics.tick
        wait(lambda: live.client.physics.tick > tick + 40, "40 steps without a picture")
        assert live.server.states_sent - sent <= WINDOW
        page.run("vinesim.viewer.renderer.setAnimationLoop(() => vinesim.viewer.draw())")
        drawn = page.run("vinesim.drawn")
        wait(lambda: page.run("vinesim.drawn") > drawn + 1, "the page goes on")

        # the bunch before the eyes is picked, and falls out of sight
        live.due.append(lambda: live.client.physics.pick(BUNCH))
        wait(lambda: page.run("vinesim.viewer.world.picked.size") == 1, "the page knows of the picked bunch")
        carrier = f"vinesim.viewer.world.bodies + 1 + vinesim.viewer.world.names.findIndex(n => n.includes('{BUNCH}'))"
        wait(lambda: page.run(f"vinesim.viewer.world.place({carrier}).z") < 0.5, "the bunch has fallen")
        drawn = page.run("vinesim.drawn")
        wait(lambda: page.run("vinesim.drawn") > drawn + 1, "it is drawn there")
        change = np.abs(page.picture().astype(float) - before).mean(2)
        high, wide = change.shape
        middle = change[high // 2 - 25 : high // 2 + 25, wide // 2 - 25 : wide // 2 + 25].mean()
        assert middle > 8.0 * change.mean(), "where the bunch hung, the picture has changed"

        # keys fly, and the client knows where the eyes are
        page.key("KeyS", down=True)
        wait(lambda: np.linalg.norm(live.client.pose[:3] - live.bunch) > 1.2, "the eyes have flown away")
        page.key("KeyS", down=False)
        assert page.errors == []
