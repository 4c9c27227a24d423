"""Planned picks are feasible: a reachable bunch, space for the base, a path clear of posts."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest

from vinesim.client.tasks import planning, start_poses
from vinesim.core import frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import Box, Scene, load_scene, with_seed


def harvest(seed: int, **changes) -> Scene:
    return msgspec.structs.replace(with_seed(load_scene("harvest"), seed), **changes)


@pytest.mark.parametrize("seed", range(2))
def test_planned_tasks_are_geometrically_feasible(seed: int):
    plan = harvest(seed)
    model = generate(plan)
    start = start_poses.spawn_pose(plan, 0)[:2]
    for task in itertools.islice(planning.plan_picks(model, start), 3):
        centre = start_poses.bunch_centres(model)[task.bunch]
        local = frames.compose(frames.inverse(task.base_pose), frames.pose(centre))[:3]
        assert local[0] == pytest.approx(planning.BUNCH_AHEAD, abs=0.02)
        assert local[1] == pytest.approx(
            planning.BUNCH_ASIDE if task.side == "left" else -planning.BUNCH_ASIDE, abs=0.02
        )
        assert model.bunch_radius[task.bunch] <= planning.MAX_BUNCH_RADIUS
        # the path keeps clear of static objects and ends with the box beside the base, on the arm's side
        points = np.concatenate([task.base_pose[None, :2], task.path])
        for a, b in itertools.pairwise(points[:-1]):
            line = a + np.linspace(0.0, 1.0, 50)[:, None] * (b - a)
            assert start_poses.ground_clearance(model, line).min() > planning.BASE_CLEARANCE - planning.GRID_SIZE
        end = frames.pose(np.append(points[-1], 0.0), frames.from_yaw(task.final_heading))
        box = frames.compose(frames.inverse(end), model.box_pose[task.box].astype(float))[:3]
        gap = abs(box[1]) - 0.5 * float(model.box_size[task.box, 1]) - planning.BASE_HALF_WIDTH
        assert gap == pytest.approx(planning.BOX_GAP, abs=1e-6)
        assert (box[1] > 0.0) == (task.side == "left")


def test_a_path_avoids_static_objects_and_is_short():
    model = generate(harvest(7, boxes=()))
    # a vine stands between
    start = np.array([5.0, 1.4])
    goal = np.array([5.0, -1.4])
    points = planning.find_path(model, start, goal, planning.BASE_CLEARANCE)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    assert 2.8 < length < 5.0
    for a, b in itertools.pairwise(points):
        line = a + np.linspace(0.0, 1.0, 100)[:, None] * (b - a)
        assert start_poses.ground_clearance(model, line).min() > planning.BASE_CLEARANCE - planning.GRID_SIZE


def test_there_is_no_path_through_a_vine():
    model = generate(harvest(7))
    assert planning.find_path(model, np.array([5.0, 1.4]), np.array([5.0, 0.1]), planning.BASE_CLEARANCE) is None


def test_boxes_without_free_space_are_reported():
    model = generate(harvest(7, boxes=()))
    with pytest.raises(start_poses.PlacementError, match=r"no box of this scene has .* room beside it"):
        next(planning.plan_picks(model, np.zeros(2)))


def test_a_box_is_an_obstacle_of_its_size():
    model = generate(harvest(7, boxes=(Box(x=3.75, y=1.2, yaw=0.5),)))
    corner = np.array([3.75, 1.2]) + frames.rotate(frames.from_yaw(0.5), np.array([0.3, 0.2, 0.0]))[:2]
    offset = frames.rotate(frames.from_yaw(0.5), np.array([0.3, 0.4, 0.0]))[:2]
    assert start_poses.ground_clearance(model, (corner + offset)[None])[0] == pytest.approx(0.5, abs=1e-6)
    assert start_poses.ground_clearance(model, corner[None], without=0)[0] > 1.0
