"""People on uneven ground: body and feet are on it."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.terrain_scenes import incline
from vinesim.avatar.scripted_human import ScriptedHuman
from vinesim.avatar.tracked_human import TrackedHuman, TrackedPoints
from vinesim.core import frames
from vinesim.rigid.human_posture import ANKLE_HEIGHT
from vinesim.scene.terrain import on_ground

TERRAIN = incline(0.2, 0.1)
ANKLE = ANKLE_HEIGHT * 1.75


def test_a_walker_climbs_with_the_ground_and_each_foot_stands_on_it() -> None:
    root = on_ground(TERRAIN, frames.pose([-1.0, 0.0, 0.0]))
    human = ScriptedHuman(root, terrain=TERRAIN)
    standing = human.pose.head[2] - root[2]
    human.do(human.walk((1.5, 0.5)), human.wait(1.0))
    heights = []
    for k in range(500):
        pose = human(0.01 * k)
        ground = float(TERRAIN.height(*pose.root[:2]))
        assert pose.root[2] == pytest.approx(ground, abs=1e-9)
        assert pose.head[2] - ground == pytest.approx(standing, abs=1e-9)
        for foot in (pose.left_foot, pose.right_foot):
            heights.append(foot[2] - float(TERRAIN.height(*foot[:2])))
    assert human.place == pytest.approx([1.5, 0.5], abs=1e-6)
    heights = np.array(heights)
    assert heights[-2:] == pytest.approx(ANKLE, abs=0.01)
    assert heights.min() > ANKLE - 0.02  # no foot steps into the ground
    assert heights.max() < ANKLE + 0.12


def test_a_tracked_person_stands_on_the_ground_below() -> None:
    root = on_ground(TERRAIN, frames.pose([0.5, 0.5, 0.0]))
    human = TrackedHuman(root, terrain=TERRAIN)
    head = human.pose.head.copy()
    head[:3] += 0.6, 0.0, 0.12  # the headset has moved uphill
    human.take(TrackedPoints(head))
    for k in range(100):
        pose = human(0.01 * k)
    assert pose.root[2] == pytest.approx(float(TERRAIN.height(*pose.root[:2])), abs=1e-9)
    for foot in (pose.left_foot, pose.right_foot):
        assert foot[2] - float(TERRAIN.height(*foot[:2])) == pytest.approx(ANKLE, abs=0.01)
