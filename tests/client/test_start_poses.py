"""Start poses of robots and bunches within their reach, in generated vineyards."""

import numpy as np
import pytest

from tests.support.long_rows import long
from vinesim.client.tasks import start_poses
from vinesim.core import frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene, with_seed


@pytest.mark.parametrize("seed", [0, *long(6, 11, 14, 29)])
def test_there_is_space_for_a_robot_before_some_bunch(seed):
    scene = with_seed(load_scene("demo"), seed)
    model = generate(scene)
    bunch, pose = start_poses.find_push_pose(model, start_poses.spawn_pose(scene, 0)[:2])
    local = frames.rotate(frames.conjugate(pose[3:]), start_poses.bunch_centres(model)[bunch] - pose[:3])
    assert local[:2] == pytest.approx([0.6, 0.0], abs=1e-6)
    assert start_poses.PUSH_HEIGHT[0] < local[2] < start_poses.PUSH_HEIGHT[1]
    assert start_poses.ground_clearance(model, pose[None, :2])[0] > start_poses.BASE_CLEARANCE

    goal = start_poses.find_approach_pose(model, pose, 14.0)
    back = frames.rotate(goal[3:], np.array([-1.0, 0.0, 0.0]))[:2]
    path = goal[:2] + np.linspace(0, 14, 200)[:, None] * back
    assert start_poses.ground_clearance(model, path).min() > 0.45
    assert np.linalg.norm(path - pose[:2], axis=1).min() > 1.0


def test_a_vineyard_with_too_low_bunches_is_refused():
    scene = load_scene("vsp")
    with pytest.raises(start_poses.PlacementError, match="no bunch of this vineyard can be pushed"):
        start_poses.find_push_pose(generate(scene), np.zeros(2))


def test_a_start_place_moves_back_along_its_heading():
    scene = load_scene("demo")
    pose = start_poses.spawn_pose(scene, 0)
    behind = start_poses.spawn_pose(scene, 0, 3.0)
    local = frames.rotate(frames.conjugate(pose[3:]), behind[:3] - pose[:3])
    assert local == pytest.approx([-3.0, 0.0, 0.0], abs=1e-9)


def test_an_unknown_start_place_is_refused_with_the_known_ones():
    with pytest.raises(start_poses.PlacementError, match=r"no start place 9; it has: 0 left, 1 right"):
        start_poses.spawn_pose(load_scene("demo"), 9)
