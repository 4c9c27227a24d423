"""First steps in the page: a newcomer is told one thing at a time, and not again after all was done or closed."""

import numpy as np
import pytest

from tests.support.live_page import BUNCH, LiveVineyard, is_drawn_anew, look_at, open_page, press
from tests.support.waiting import wait
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.scene.values import HumanSpec

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("browser")]

STEP = "document.querySelector('#guide li[aria-current]')?.dataset.name"
IS_OPEN = "document.getElementById('guide').checkVisibility()"
HELP = "document.querySelector('.help.person').checkVisibility()"


def test_a_newcomer_looks_walks_reaches_holds_and_picks(page):
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus, is_person=True) as live:
        open_page(page, live)
        assert page.run(STEP) == "look"
        assert not page.run(HELP), "one thing at a time"
        page.run("vinesim.viewer.eyes.place[0] += 0.1, vinesim.viewer.eyes.yaw += 0.6, 0")
        wait(lambda: page.run(STEP) == "walk", "the person has looked around")
        near = "vinesim.viewer.guide.nearestBunch(vinesim.viewer.eyes.place).away < 0.75"
        assert page.run(near)
        updated = page.run("vinesim.viewer.guide.updatedAt")
        wait(lambda: page.run("vinesim.viewer.guide.updatedAt") > updated, "another look at what was done")
        assert page.run(STEP) == "walk", "a person who stands before a bunch has not walked yet"
        page.run("vinesim.viewer.eyes.place[0] -= 1.6, 0")
        wait(lambda: not page.run(near) and page.run("vinesim.viewer.guide.hasWalked"), "the person has walked")
        where = page.run("document.querySelector('#guide p').textContent")
        assert "nearest bunch" in where
        start = page.run("vinesim.viewer.eyes.place[0]")
        page.run(f"vinesim.viewer.eyes.place[0] = {start} + 1.5, 0")
        wait(lambda: page.run(STEP) == "reach", "a bunch is within reach")
        look_at(page, live.bunch)
        is_drawn_anew(page)
        button = "document.querySelector('#hold span').textContent"
        press(page, "Space")
        wait(lambda: page.run(button) == "open", "a closed hand that holds nothing")
        press(page, "Space")
        wait(lambda: page.run(button) == "grasp", "an open hand")
        page.run("vinesim.viewer.reach([0, 0]), 0")
        wait(lambda: page.run(STEP) == "hold", "the hand reaches for the bunch")
        wait(lambda: live.client.physics.hand("viewer", "right").touching, "the hand is there")
        press(page, "Space")
        wait(lambda: page.run(STEP) == "pick", "the hand holds the bunch")
        assert page.run(button) == "let go"
        press(page, "KeyT")
        said = page.run("document.getElementById('notices').textContent")
        assert "The right hand let go of the bunch to take the shears." in said
        live.due.append(lambda: live.client.physics.pick(BUNCH))
        wait(lambda: not page.run(IS_OPEN), "all steps are done")
        assert "Well done" in page.run("document.getElementById('notices').textContent")
        open_page(page, live)
        assert not page.run(IS_OPEN), "the browser remembers"
        assert page.run(HELP)
        page.run("document.getElementById('steps').click()")
        assert page.run(STEP) == "look", "and begins again when asked"
        press(page, "KeyH")
        assert not page.run(IS_OPEN)
        assert page.errors == []


def test_the_steps_tell_where_the_others_are_and_stay_closed(page):
    """Arrows point to the place of a person whom the eyes cannot see."""
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus) as live:
        open_page(page, live)
        eye = page.run("vinesim.viewer.eyes.place")
        behind = frames.pose(np.array([eye[0] - 3.0, eye[1] - 0.1, 0.0]))
        live.due.append(lambda: live.client.physics.add_human(HumanSpec("anna", 1, standing_pose(behind))))
        told = "Number(/anna (.*) m/.exec(document.querySelector('#guide p').textContent)?.[1] ?? 0)"
        wait(lambda: abs(page.run(told) - 3.0) < 0.25, f"anna's distance, not {page.run(told)}", 30)
        page.run("vinesim.viewer.eyes.yaw = 0, 0")
        said = "document.querySelector('#guide b').getAttribute('aria-label')"
        wait(lambda: page.run(said) == "behind", "she is behind the eyes")
        page.run("vinesim.viewer.eyes.yaw = Math.PI / 2, 0")
        wait(lambda: page.run(said) == "left", "she is on the left of eyes that look to the left")
        page.run("document.querySelector('#guide button').click()")
        open_page(page, live)
        assert not page.run(IS_OPEN)
        assert page.errors == []
