"""The person's own arm in the page: it ends at the hand in every picture, however few there are."""

import json

import numpy as np
import pytest

from tests.support.live_page import LiveVineyard, open_page, press
from tests.support.waiting import wait
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.scene.appearance import load_human_model

pytestmark = [pytest.mark.xdist_group("browser")]

MOST = 1e-3
"""Largest gap at the wrist and at the elbow [m]. Poses have float32."""
WATCH = """
((limbs) => {
  const { viewer } = vinesim, { world } = viewer, seen = window.seen = { wrist: [], elbow: [], moved: [], at: [] };
  const carrier = (part) => world.bodies + 1 + world.names.indexOf(`viewer/${part}`);
  const at = (part, [x, y, z]) => world.beyond(carrier(part), world.place(0).set(x, y, z));
  const { renderer } = viewer, render = renderer.render.bind(renderer);
  renderer.render = (scene, camera) => {
    if (scene === viewer.scene && carrier("right_hand") > world.bodies) {
      const [x, y, z] = limbs.wrist, palm = world.place(carrier("right_hand"));
      seen.wrist.push(at("right_hand", [x, -y, z]).distanceTo(at("right_forearm", [limbs.forearm, 0, 0])));
      seen.elbow.push(world.place(carrier("right_forearm")).distanceTo(at("right_upper_arm", [limbs.upper_arm, 0, 0])));
      seen.moved.push(palm.distanceTo(world.place(0).set(...viewer.eyes.place)));
      seen.at.push(performance.now());
    }
    if (DRAWS) render(scene, camera);
  };
})(LIMBS)
"""
"""Script after which every picture records the gaps of the right arm [m], the hand's distance from the eyes [m] and the
time [ms]."""


@pytest.mark.slow
@pytest.mark.parametrize("rate", [2, 10, 60])
def test_the_hand_is_joined_to_the_arm_in_every_picture(page, rate):
    """The hand reaches up to its farthest point while the person walks and turns, and hangs again."""
    limbs = load_human_model(1.75).limbs
    own = {"wrist": limbs.wrist, "forearm": limbs.forearm, "upper_arm": limbs.upper_arm}
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus, is_person=True) as live:
        open_page(page, live)
        wait(lambda: page.run("vinesim.viewer.lateHands.held !== null"), "the person's hands are known")
        draws = json.dumps(rate < 60)  # a browser without a graphics card computes poses 60 times a second, not pixels
        page.run(WATCH.replace("LIMBS", json.dumps(own)).replace("DRAWS", draws))
        page.run(f"vinesim.viewer.shortest = {0.0 if rate == 60 else 1.0 / rate - 0.002}, 0")
        page.run("vinesim.viewer.hand.distance = 0.75, vinesim.viewer.eyes.pitch = 0.4, 0")
        press(page, "KeyR")
        page.key("KeyD", down=True)
        wait(lambda: page.run("Math.max(...seen.moved) > 0.65"), "the hand is an arm's length away")
        page.key("KeyD", down=False)
        page.run("vinesim.viewer.eyes.yaw += 1.0, 0")
        count = page.run("seen.at.length")
        wait(lambda: page.run("seen.at.length") > count + 3, "the person has turned")
        press(page, "KeyR")
        wait(lambda: page.run("seen.moved.length > 10"), "enough pictures")
        seen = page.run("seen")
        assert page.errors == []
    reached = 1e3 / np.median(np.diff(seen["at"]))
    assert reached < 1.4 * rate, "no more than the test is about; a slow machine draws fewer"
    assert max(seen["elbow"]) < MOST
    assert max(seen["wrist"]) < MOST, f"gap of {1e3 * max(seen['wrist']):.1f} mm at {reached:.0f} pictures a second"
