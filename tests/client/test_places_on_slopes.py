"""Start places, plans, crates, spectators and cameras of users on uneven ground."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from vinesim.cli.render import Viewpoint, _check_above_ground
from vinesim.client.composition.scene_composer import CratePlacement, PersonPlacement, RobotPlacement, SceneComposer
from vinesim.client.spectator import EYE_HEIGHT, follow_view, standing_view
from vinesim.client.tasks import start_poses
from vinesim.core import frames
from vinesim.core.errors import UsageError
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.model import Model
from vinesim.scene.spec import TerrainTable, load_scene
from vinesim.scene.terrain import Terrain


@pytest.fixture(scope="module")
def model() -> Model:
    return generate(load_scene("slope"))


@pytest.fixture(scope="module")
def ground(model: Model) -> Terrain:
    assert model.terrain is not None
    return model.terrain


def test_start_places_and_views_are_at_the_height_of_the_ground(ground: Terrain) -> None:
    start = start_poses.spawn_pose(load_scene("slope"), 1)
    assert start[2] == pytest.approx(float(ground.height(6.0, 1.3)))
    eyes = standing_view(6.0, 1.3, 0.3, ground)
    assert eyes[2] == pytest.approx(float(ground.height(6.0, 1.3)) + EYE_HEIGHT)
    behind = follow_view(start, ground)
    assert behind[2] == pytest.approx(float(ground.height(*behind[:2])) + EYE_HEIGHT)


def test_a_robot_is_placed_at_a_bunch_whose_height_counts_from_the_ground() -> None:
    model = generate(msgspec.structs.replace(load_scene("demo"), terrain=TerrainTable(slope=0.4)))
    ground = model.terrain
    assert ground is not None
    bunch, pose = start_poses.find_push_pose(model, np.array([6.0, 1.3]))
    centre = start_poses.bunch_centres(model)[bunch]
    low, high = start_poses.PUSH_HEIGHT
    assert low < centre[2] - float(ground.height(*centre[:2])) < high
    assert pose[2] == pytest.approx(float(ground.height(*pose[:2])))
    assert abs(pose[2]) > 0.1


def test_actors_and_crates_of_a_picture_stand_on_the_ground(model: Model, ground: Terrain) -> None:
    composed = SceneComposer(
        (RobotPlacement("vinebot", 1.0, 1.3, 0.0),),
        (PersonPlacement(3.0, 1.3),),
        (CratePlacement(7.0, 1.3, 0.4),),
    )
    view = composed.compose(model)
    poses = {visual.name: pose for visual, pose in zip(view.visuals, view.visual_q, strict=True)}
    boxes = [pose for visual, pose in zip(view.visuals, view.visual_q, strict=True) if visual.organ == Organ.BOX]
    assert len(boxes) == 2
    for box in boxes:
        assert abs(box[2] - float(ground.height(*box[:2]))) < 0.05
        up = frames.rotate(box[3:], np.array([0.0, 0.0, 1.0]))
        assert up @ ground.normal(*box[:2]) > 0.98
    head = poses["person_0/head"]
    assert 1.4 < head[2] - float(ground.height(*head[:2])) < 1.8


def test_a_camera_below_the_ground_is_refused(model: Model, ground: Terrain) -> None:
    level = float(ground.height(6.0, 1.3))
    _check_above_ground(model, Viewpoint(np.array([6.0, 1.3, level + 0.1]), np.zeros(3), "--at"))
    with pytest.raises(UsageError, match=f"--at is below the ground; give a height above {level:.4g}"):
        _check_above_ground(model, Viewpoint(np.array([6.0, 1.3, level - 0.1]), np.zeros(3), "--at"))
