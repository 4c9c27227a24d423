"""Bunches that are found in RGB-D pictures without labels, against the scene."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import vinesim
from vinesim.client.tasks.start_poses import bunch_centres
from vinesim.core import frames
from vinesim.perception.bunch_detection import find_bunches
from vinesim.scene.ids import Organ, label


@pytest.fixture(scope="module")
def simulation() -> vinesim.Simulation:
    return vinesim.Simulation("demo")


@pytest.fixture(scope="module")
def picture(simulation):
    """A picture of a bunch that hangs free, with others behind it."""
    camera = vinesim.Camera("d435", quality="fast")
    robot = simulation.add_robot("vinebot", pose=(5.51, 0.8, 2.105))
    return camera.render(simulation, robot=robot)


def test_bunches_are_where_they_hang(simulation, picture):
    model = simulation.model
    centres = bunch_centres(model)
    shown = [
        bunch
        for bunch in range(len(centres))
        if np.count_nonzero(picture.labels == label(Organ.BUNCH, bunch)) > 2500
        and not np.isin(label(Organ.BUNCH, bunch), np.concatenate([picture.labels[0], picture.labels[:, 0]]))
        and np.linalg.norm(centres[bunch] - picture.pose[:3]) < 1.6
    ]
    found = find_bunches(picture).bunches
    assert shown
    assert len(found) <= len(shown) + 3
    for bunch in shown:
        nearest = min(found, key=lambda one: float(np.linalg.norm(one.centre - centres[bunch])))
        top = simulation.body_pose(int(model.bunch_body[bunch]))[:3]
        assert np.linalg.norm((nearest.top - top)[:2]) < 0.03
        assert nearest.top[2] == pytest.approx(top[2], abs=0.03)
        assert nearest.radius == pytest.approx(float(model.bunch_radius[bunch]), abs=0.02)
        assert nearest.length == pytest.approx(float(model.bunch_length[bunch]), abs=0.04)


def test_labels_and_exact_depth_are_not_used(picture):
    blind = dataclasses.replace(picture, labels=np.zeros(0, np.int32), exact_depth=None, bunches=None)
    one, other = find_bunches(picture), find_bunches(blind)
    assert len(one.bunches) == len(other.bunches)
    for a, b in zip(one.bunches, other.bunches, strict=True):
        np.testing.assert_array_equal(a.top, b.top)


def test_no_bunch_is_found_where_none_is(simulation):
    """Looking away from the vines, over the field."""
    camera = vinesim.Camera("d435", quality="fast")
    frame = camera.render(simulation, vinesim.look_at((12.0, -3.0, 1.5), (20.0, -10.0, 1.0)))
    sight = find_bunches(frame)
    assert not sight.bunches
    assert not len(sight.fruit)


def test_points_of_wood_are_on_wood(picture):
    wood = find_bunches(picture).wood
    assert len(wood) > 50
    local = frames.rotate(frames.conjugate(picture.pose[3:]), wood - picture.pose[:3])
    info = picture.info
    columns = np.round(local[:, 0] / local[:, 2] * info.fx + info.cx).astype(int)
    rows = np.round(local[:, 1] / local[:, 2] * info.fy + info.cy).astype(int)
    organ = picture.organs[np.clip(rows, 0, info.height - 1), np.clip(columns, 0, info.width - 1)]
    solid = (Organ.POLE, Organ.WIRE, Organ.TRUNK, Organ.ARM, Organ.CANE)
    assert np.isin(organ, solid).mean() > 0.6
