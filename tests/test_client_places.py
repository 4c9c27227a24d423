"""Where robots start and what they reach, in every vineyard that a seed may grow."""

import numpy as np
import pytest

from vinesim import frames
from vinesim.client import places
from vinesim.world.generate import generate
from vinesim.world.scene import load, reseeded


@pytest.mark.parametrize("seed", [0, 6, 11, 14, 29])
def test_before_some_bunch_a_robot_finds_room(seed):
    scene = reseeded(load("demo"), seed)
    model = generate(scene)
    bunch, pose = places.stand_before_a_bunch(model, places.spawn_pose(scene, 0)[:2])
    local = frames.rotate(frames.conjugate(pose[3:]), places.bunch_centres(model)[bunch] - pose[:3])
    assert local[:2] == pytest.approx([0.6, 0.0], abs=1e-6)
    assert places.HEIGHT[0] < local[2] < places.HEIGHT[1]
    assert places.free_room(model, pose[None, :2])[0] > places.ROOM

    goal = places.way_to(model, pose, 14.0)
    back = frames.rotate(goal[3:], np.array([-1.0, 0.0, 0.0]))[:2]
    way = goal[:2] + np.linspace(0, 14, 200)[:, None] * back
    assert places.free_room(model, way).min() > 0.45
    assert np.linalg.norm(way - pose[:2], axis=1).min() > 1.0


def test_vsp_bunches_hang_too_low_and_that_is_said():
    scene = load("vsp")
    with pytest.raises(places.NoPlace, match="no bunch of this vineyard can be pushed"):
        places.stand_before_a_bunch(generate(scene), np.zeros(2))


def test_a_start_place_moves_back_along_its_heading():
    scene = load("demo")
    pose, behind = places.spawn_pose(scene, 0), places.spawn_pose(scene, 0, 3.0)
    local = frames.rotate(frames.conjugate(pose[3:]), behind[:3] - pose[:3])
    assert local == pytest.approx([-3.0, 0.0, 0.0], abs=1e-9)


def test_a_place_the_scene_does_not_have_is_named_with_those_it_has():
    with pytest.raises(places.NoPlace, match=r"no start place 9; it has: 0 left, 1 right"):
        places.spawn_pose(load("demo"), 9)
