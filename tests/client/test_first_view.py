"""Where a page looks from at first: it shows its actor, and the vines in the middle, on a desktop and on a phone."""

import numpy as np
import pytest

from tests.support.long_rows import long
from vinesim.client.page.first_view import first_view
from vinesim.client.spectator import EYE_HEIGHT
from vinesim.client.tasks.start_poses import start_pose
from vinesim.core import frames
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene

HALF_DESKTOP, HALF_PHONE = (np.arctan(np.tan(np.radians(30.0)) * aspect) for aspect in (1280 / 720, 390 / 844))
"""Horizontal angle from the middle of the picture to its edge [rad]; the vertical angle of view is 60 degrees."""
COLUMNS = 32
HEAD = np.array([0.0, 0.0, 1.3])
"""Of a robot, above its base [m]."""


@pytest.fixture(scope="module", params=["demo", "vsp", *long("tendone")])
def vineyard(request):
    """Scene, model, and places [body, 3] m of its bodies."""
    scene = load_scene(request.param)
    model = generate(scene)
    return scene, model, model.forward_kinematics(model.joint_settled)[:, :3]


def seen_at(view, points):
    """Horizontal angles of points [n, 3] from the middle of the picture [n] rad, and their distances [n] m."""
    local = frames.rotate(frames.conjugate(view[3:]), points - view[:3])
    return np.arctan2(local[:, 1], local[:, 0]), np.hypot(local[:, 0], local[:, 1])


def columns_with(view, points):
    """Share of a desktop's columns in which some of the points are."""
    angles, _ = seen_at(view, points)
    across = np.tan(angles[np.abs(angles) < HALF_DESKTOP]) / np.tan(HALF_DESKTOP)
    return np.count_nonzero(np.histogram(across, COLUMNS, (-1.0, 1.0))[0]) / COLUMNS


def distance_to_line(points, start, end):
    """Distances of points [n, 3] from a line between two points [n] m."""
    way = end - start
    along = np.clip((points - start) @ way / (way @ way), 0.0, 1.0)
    return np.linalg.norm(points - start - along[:, None] * way, axis=1)


@pytest.mark.parametrize("back", [6.0, *long(9.0, 14.0)])
def test_of_an_actor_far_away_the_vines_are_in_the_middle_and_large(vineyard, back):
    scene, model, bodies = vineyard
    start = frames.pose(model.tree_pose[0, :3] * [1.0, 1.0, 0.0] - [back, 0.0, 0.0], frames.from_yaw(back))
    if scene.name == "demo":  # as its visitor does
        start = start_pose(scene, 1, back)
    view = first_view(start, model, bodies)
    assert view[2] == EYE_HEIGHT
    angles, away = seen_at(view, bodies)
    assert columns_with(view, bodies[away < 8.0]) > 0.6
    middle = angles[(away < 8.0) & (np.abs(angles) < 0.15)]
    assert np.count_nonzero(np.histogram(middle, 8, (-0.15, 0.15))[0]) >= 6, "what a phone shows, held upright"
    angle, distance = seen_at(view, start[None, :3])
    assert 0.1 < abs(angle[0]) < 0.6 < HALF_DESKTOP
    assert distance[0] < back + 10.0
    assert away.min() > 0.1
    assert np.count_nonzero(distance_to_line(bodies, view[:3], start[:3] + HEAD) < 0.3) <= 3, "nothing hides it"


def test_of_an_actor_before_a_hedge_both_are_in_the_picture():
    """From beyond the hedge it could not be seen."""
    model = generate(load_scene("vsp"))
    start = frames.pose(np.array([5.2, -9.0, 0.0]))
    view = first_view(start, model, model.forward_kinematics(model.joint_settled)[:, :3])
    angle, distance = seen_at(view, start[None, :3])
    assert 0.1 < abs(angle[0]) < HALF_PHONE
    assert distance[0] < 3.0
    assert columns_with(view, model.tree_pose[:, :3]) > 0.6


def test_of_an_actor_among_vines_nothing_hides_it_and_vines_fill_the_picture(vineyard):
    scene, model, bodies = vineyard
    for number in range(len(scene.spawns)):
        start = start_pose(scene, number)
        view = first_view(start, model, bodies)
        angle, distance = seen_at(view, start[None, :3])
        assert abs(angle[0]) < 0.01
        assert distance[0] < 3.0
        assert distance_to_line(bodies, view[:3], start[:3] + HEAD).min() > 0.15, (scene.name, number)
        _, away = seen_at(view, bodies)
        assert columns_with(view, bodies[away < 6.0]) > 0.7, (scene.name, number)
