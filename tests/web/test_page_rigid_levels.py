"""Robots and people are drawn no finer than is seen: how far each level is inside the true form, and what they cost."""

import numpy as np
import pytest

from tests.support.live_page import LiveVineyard, is_drawn_anew, open_page
from tests.support.page_module import page_module
from tests.support.waiting import wait
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.robot.description.loader import load_description
from vinesim.scene.values import HumanSpec

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("browser")]

RIGID = """((eye, pixel) => {
  const { world } = vinesim.viewer;
  world.eye.set(...eye);
  world.pixel = pixel;
  world.coarser = 1;
  for (const level of world.draws.flat()) level.clear();
  world.chooseRigid();
  world.listedAt = null;
  return world.countTriangles();
})"""
"""Triangles of all rigid bodies for an eye [3] m and a pixel of an angle [rad]."""
MOVED = """((way) => {
  const { world, latest } = vinesim.viewer, { rigid_place } = latest.arrays;
  world.list(world.eye.clone(), world.eye.clone().set(1, 0, 0), { field: 0.5, turn: 0.3, pixel: 0.001 });
  world.applyRigid({ ...latest.arrays, rigid_place: rigid_place.map((x, k) => k % 3 === 0 ? x + way : x) });
  const isListed = world.listedAt !== null;
  world.applyRigid(latest.arrays);
  return isListed;
})"""
"""Whether the list is kept when all rigid bodies have gone a way [m] along x."""


def test_levels_are_as_far_inside_the_true_form_as_they_say(page):
    """By points all over their faces."""
    with page_module(page, "geometry.js", "MESHES") as run:
        meshes = run("return MESHES.filter(({ inside }) => inside)")
    assert [mesh["name"] for mesh in meshes] == ["ellipsoid", "cylinder"]
    u, v = np.meshgrid(np.linspace(0.0, 1.0, 21), np.linspace(0.0, 1.0, 21))
    weights = np.stack([u, v, 1.0 - u - v], -1)[u + v <= 1.0 + 1e-9]
    for mesh in meshes:
        for level, said in zip(mesh["levels"], mesh["inside"], strict=True):
            corners = np.reshape(level["points"], (-1, 3))[np.reshape(level["faces"], (-1, 3))]
            if mesh["name"] == "cylinder":  # its sides; ends are told by z beyond 0 to 1
                corners = corners[((corners[..., 2] >= 0.0) & (corners[..., 2] <= 1.0)).all(1)] * [1.0, 1.0, 0.0]
            radii = np.linalg.norm(weights @ corners, axis=-1)
            assert 1.0 - radii.min() == pytest.approx(said, rel=0.02)
        assert mesh["inside"] == sorted(mesh["inside"])


@pytest.mark.long
def test_a_robot_and_two_people_cost_less_where_they_are_small_in_the_picture(page):
    with MemoryHub().bus("viewer") as bus, LiveVineyard(bus) as live:
        open_page(page, live)
        place = live.client.pose[:3] * [1.0, 1.0, 0.0] + np.array([0.0, 8.0, 0.0])
        for k, who in enumerate(("anna", "bert")):
            spec = HumanSpec(who, 100 + k, standing_pose(frames.pose(place + np.array([0.0, 0.5 * k, 0.0]))), 1.75)
            live.due.append(lambda spec=spec: live.client.physics.add_human(spec))
        robot = load_description("vinebot").to_spec("robot", pose=frames.pose(place - [0.0, 0.8, 0.0]))
        live.due.append(lambda: live.client.physics.rigid.add_robot(robot))
        wait(lambda: page.run("vinesim.viewer.actors().length") == 3, "all have come")
        is_drawn_anew(page)
        with live.paused():
            eye = np.array([*place[:2], 1.6])
            cost = {
                (rows, away): page.run(f"{RIGID}({(eye - [away, 0.0, 0.0]).tolist()}, {1.155 / rows})")
                for rows in (375, 1080)
                for away in (2.0, 6.0, 12.0)
            }
            page.run(f"{RIGID}({(eye - [6.0, 0.0, 0.0]).tolist()}, 0.001)")
            kept = [page.run(f"{MOVED}({way})") for way in (0.2, -0.2, 4.0, -2.0)]
        assert page.errors == []
    assert cost[1080, 2.0] < 56_000
    assert cost[1080, 6.0] < 40_000
    assert cost[375, 2.0] < 40_000
    assert cost[375, 6.0] < 26_000
    assert cost[375, 12.0] < 23_000
    assert kept == [True, True, False, False], "another list when they come nearer or go"
