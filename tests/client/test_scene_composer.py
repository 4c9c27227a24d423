"""Robots, people and crates set down for a picture: where they are asked for, and bunches in the crates."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim import frames
from vinesim.client.composition.scene_composer import (
    CRATE_WALL,
    HEAP_DENSITY,
    CratePlacement,
    PersonPlacement,
    PlacementError,
    RobotPlacement,
    SceneComposer,
    bunch_masses,
)
from vinesim.physics.step import Physics
from vinesim.scene.ids import Organ, label

CRATE = CratePlacement(1.3, 1.25, 0.4, 0.35)


@pytest.fixture(scope="module")
def filled() -> Physics:
    stage = SceneComposer(crates=(CRATE,))
    physics = Physics(stage.with_crates(sensor_scenes.demo()))
    stage.populate(physics)
    return physics


def test_bunches_fill_a_crate(filled: Physics) -> None:
    """As heavy as asked for, from the nearest vines, at rest, above the bottom and most of them within the walls."""
    model, rigid = filled.model, filled.rigid
    picked = np.array(rigid.free_bunches)
    assert not filled.state.bunch_attached[picked].any()
    assert filled.state.bunch_attached.sum() == len(model.bunch_body) - len(picked)
    inside = np.array(CRATE.size) - [2 * CRATE_WALL, 2 * CRATE_WALL, CRATE_WALL]
    wanted = CRATE.fill * HEAP_DENSITY * np.prod(inside)
    heavy = bunch_masses(model)
    assert wanted - heavy.max() < heavy[picked].sum() <= wanted
    crate = rigid.visual_q()[[link.name for link in rigid.visuals()].index(f"box/{len(model.box_size) - 1}")]
    assert crate[:3] == pytest.approx(CRATE.pose[:3], abs=0.01)
    within = 0
    for bunch in picked:
        pose = rigid.bunch_pose(bunch)
        middle = pose[:3] + frames.rotate(pose[3:], np.array([0.5 * model.bunch_length[bunch], 0.0, 0.0]))
        at = frames.rotate(frames.conjugate(crate[3:]), middle - crate[:3])
        within += bool((np.abs(at[:2]) < 0.5 * inside[:2]).all() and 0.0 < at[2] < CRATE.size[2] + 0.1)
    assert within >= len(picked) - 1


def test_the_same_twice(filled: Physics) -> None:
    again = SceneComposer(crates=(CRATE,))
    physics = Physics(again.with_crates(sensor_scenes.demo()))
    assert np.array_equal(again.populate(physics).visual_q, filled.snapshot().visual_q)


def test_crates_come_after_those_of_the_scene_and_change_no_plant() -> None:
    model = sensor_scenes.demo()
    furnished = SceneComposer(crates=(CratePlacement(1.0, 1.2), CRATE)).with_crates(model)
    assert len(furnished.box_size) == len(model.box_size) + 2
    assert np.array_equal(furnished.box_pose[:-2], model.box_pose)
    assert furnished.box_size[-1] == pytest.approx(CRATE.size)
    for name in ("body_mass", "bunch_seed", "leaf_pose", "joint_settled"):
        assert np.array_equal(getattr(furnished, name), getattr(model, name))
    assert SceneComposer().compose(model).bunch_attached.all()


def test_actor_records_have_the_labels_of_the_visuals() -> None:
    model = sensor_scenes.demo()
    stage = SceneComposer(
        (RobotPlacement("logistic", 1.3, 1.2),),
        (PersonPlacement(3.0, 1.2, 0.5, "wave", 1.6),),
        (CratePlacement(4.0, 1.3),),
    )
    links = stage.compose(model).visuals
    records = {one["label"]: one for one in stage.actor_records(model)}
    drawn = {label(link.organ, link.index) for link in links}
    assert drawn - {label(Organ.BOX, k) for k in range(len(model.box_size))} == set(records)
    assert records[label(Organ.HUMAN, 0)]["height"] == 1.6


@pytest.mark.parametrize(
    ("stage", "words"),
    [
        (SceneComposer((RobotPlacement("vinebot", 0.0, 0.0),)), "robot_0 stands .* cm deep in (trunk|pole); move one"),
        (SceneComposer((RobotPlacement("vinebot", 1.2, 1.2),), (PersonPlacement(1.3, 1.2),)), "stands .* deep in"),
        (SceneComposer(crates=(CratePlacement(1.0, 1.0, 0.0, 1.0, (6.0, 6.0, 1.0)),)), "more than the vineyard bears"),
    ],
)
def test_where_there_is_no_room_is_said(stage: SceneComposer, words: str) -> None:
    with pytest.raises(PlacementError, match=words) as said:
        stage.compose(sensor_scenes.demo())
    assert "\n" not in str(said.value)
