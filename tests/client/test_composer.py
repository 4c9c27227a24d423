"""Robots, people and crates set down for a picture: where they are asked for, and bunches in the crates."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support import sensor_scenes
from vinesim import frames
from vinesim.client.composition.composer import BULK, WALL, CrateAt, NoRoom, PersonAt, RobotAt, Stage, weights
from vinesim.physics.step import Physics
from vinesim.scene.ids import Organ, label

CRATE = CrateAt(1.3, 1.25, 0.4, 0.35)


@pytest.fixture(scope="module")
def filled() -> Physics:
    stage = Stage(crates=(CRATE,))
    physics = Physics(stage.furnished(sensor_scenes.demo()))
    stage.enter(physics)
    return physics


def test_bunches_fill_a_crate(filled: Physics) -> None:
    """As heavy as asked for, from the nearest vines, at rest, above the bottom and most of them within the walls."""
    model, rigid = filled.model, filled.rigid
    picked = np.array(rigid.free_bunches)
    assert not filled.state.bunch_attached[picked].any()
    assert filled.state.bunch_attached.sum() == len(model.bunch_body) - len(picked)
    inside = np.array(CRATE.size) - [2 * WALL, 2 * WALL, WALL]
    wanted = CRATE.fill * BULK * np.prod(inside)
    heavy = weights(model)
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
    again = Stage(crates=(CRATE,))
    physics = Physics(again.furnished(sensor_scenes.demo()))
    assert np.array_equal(again.enter(physics).visual_q, filled.snapshot().visual_q)


def test_crates_come_after_those_of_the_scene_and_change_no_plant() -> None:
    model = sensor_scenes.demo()
    furnished = Stage(crates=(CrateAt(1.0, 1.2), CRATE)).furnished(model)
    assert len(furnished.box_size) == len(model.box_size) + 2
    assert np.array_equal(furnished.box_pose[:-2], model.box_pose)
    assert furnished.box_size[-1] == pytest.approx(CRATE.size)
    for name in ("body_mass", "bunch_seed", "leaf_pose", "joint_settled"):
        assert np.array_equal(getattr(furnished, name), getattr(model, name))
    assert Stage().set(model).bunch_attached.all()


def test_whoever_is_told_of_has_the_label_of_the_links() -> None:
    model = sensor_scenes.demo()
    stage = Stage((RobotAt("logistic", 1.3, 1.2),), (PersonAt(3.0, 1.2, 0.5, "wave", 1.6),), (CrateAt(4.0, 1.3),))
    links = stage.set(model).visuals
    told = {one["label"]: one for one in stage.told(model)}
    drawn = {label(link.organ, link.index) for link in links}
    assert drawn - {label(Organ.BOX, k) for k in range(len(model.box_size))} == set(told)
    assert told[label(Organ.HUMAN, 0)]["height"] == 1.6


@pytest.mark.parametrize(
    ("stage", "words"),
    [
        (Stage((RobotAt("vinebot", 0.0, 0.0),)), "robot_0 stands .* cm deep in (trunk|pole); move one"),
        (Stage((RobotAt("vinebot", 1.2, 1.2),), (PersonAt(1.3, 1.2),)), "stands .* deep in"),
        (Stage(crates=(CrateAt(1.0, 1.0, 0.0, 1.0, (6.0, 6.0, 1.0)),)), "more than the vineyard bears"),
    ],
)
def test_where_there_is_no_room_is_said(stage: Stage, words: str) -> None:
    with pytest.raises(NoRoom, match=words) as said:
        stage.set(sensor_scenes.demo())
    assert "\n" not in str(said.value)
