"""Robots, humans and crates placed for a picture, and bunches in the crates."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support import sensor_scenes
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
from vinesim.core import frames
from vinesim.scene.ids import Organ, label
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.world import Physics

CRATE = CratePlacement(1.3, 1.25, 0.4, 0.35)


@pytest.fixture(scope="module")
def filled() -> Physics:
    composer = SceneComposer(crates=(CRATE,))
    physics = Physics(composer.with_crates(sensor_scenes.demo()))
    composer.populate(physics)
    return physics


def test_bunches_fill_a_crate(filled: Physics) -> None:
    """The requested mass of bunches, at rest, above the bottom and most of them within the walls."""
    model = filled.model
    rigid = filled.rigid
    picked = np.array(rigid.free_bunches)
    assert not filled.state.bunch_attached[picked].any()
    assert filled.state.bunch_attached.sum() == len(model.bunch_body) - len(picked)
    inside = np.array(CRATE.size) - [2 * CRATE_WALL, 2 * CRATE_WALL, CRATE_WALL]
    requested = CRATE.fill * HEAP_DENSITY * np.prod(inside)
    masses = bunch_masses(model)
    assert requested - masses.max() < masses[picked].sum() <= requested
    crate = rigid.visual_q()[[link.name for link in rigid.visuals()].index(f"box/{len(model.box_size) - 1}")]
    assert crate[:3] == pytest.approx(CRATE.pose[:3], abs=0.01)
    within = 0
    for bunch in picked:
        pose = rigid.bunch_pose(bunch)
        middle = pose[:3] + frames.rotate(pose[3:], np.array([0.5 * model.bunch_length[bunch], 0.0, 0.0]))
        at = frames.rotate(frames.conjugate(crate[3:]), middle - crate[:3])
        within += bool((np.abs(at[:2]) < 0.5 * inside[:2]).all() and 0.0 < at[2] < CRATE.size[2] + 0.1)
    assert within >= len(picked) - 1


def test_two_compositions_are_equal(filled: Physics) -> None:
    composer = SceneComposer(crates=(CRATE,))
    physics = Physics(composer.with_crates(sensor_scenes.demo()))
    assert np.array_equal(composer.populate(physics).visual_q, filled.snapshot().visual_q)


def test_the_parameters_of_the_scene_are_used() -> None:
    """Without weight no bunch falls into the crate: the heap stays at the height from which bunches are dropped."""
    model = sensor_scenes.demo()
    heights = []
    composer = SceneComposer(crates=(CratePlacement(1.3, 1.25, 0.4, 0.05),))
    for gravity in (9.81, 0.0):
        snapshot = composer.compose(model, PhysicsParameters(gravity=gravity))
        heap = [visual.name.startswith("bunch/") for visual in snapshot.visuals]
        heights.append(snapshot.visual_q[heap, 2].mean())
    assert heights[0] < heights[1] - 0.005


def test_crates_are_appended_and_change_no_plant() -> None:
    model = sensor_scenes.demo()
    with_crates = SceneComposer(crates=(CratePlacement(1.0, 1.2), CRATE)).with_crates(model)
    assert len(with_crates.box_size) == len(model.box_size) + 2
    assert np.array_equal(with_crates.box_pose[:-2], model.box_pose)
    assert with_crates.box_size[-1] == pytest.approx(CRATE.size)
    for name in ("body_mass", "bunch_seed", "leaf_pose", "joint_settled"):
        assert np.array_equal(getattr(with_crates, name), getattr(model, name))
    assert SceneComposer().compose(model).bunch_attached.all()


def test_actor_records_have_the_labels_of_the_visuals() -> None:
    model = sensor_scenes.demo()
    composer = SceneComposer(
        (RobotPlacement("logistic", 1.3, 1.2),),
        (PersonPlacement(3.0, 1.2, 0.5, "wave", 1.6),),
        (CratePlacement(4.0, 1.3),),
    )
    links = composer.compose(model).visuals
    records = {one["label"]: one for one in composer.actor_records(model)}
    drawn = {label(link.organ, link.index) for link in links}
    assert drawn - {label(Organ.BOX, k) for k in range(len(model.box_size))} == set(records)
    assert records[label(Organ.HUMAN, 0)]["height"] == 1.6


@pytest.mark.parametrize(
    ("composer", "reason"),
    [
        (SceneComposer((RobotPlacement("vinebot", 0.0, 0.0),)), "robot_0 stands .* cm deep in (trunk|pole); move one"),
        (SceneComposer((RobotPlacement("vinebot", 1.2, 1.2),), (PersonPlacement(1.3, 1.2),)), "stands .* deep in"),
        (SceneComposer(crates=(CratePlacement(1.0, 1.0, 0.0, 1.0, (6.0, 6.0, 1.0)),)), "more than the vineyard bears"),
    ],
)
def test_placement_without_free_space_is_refused_with_the_reason(composer: SceneComposer, reason: str) -> None:
    with pytest.raises(PlacementError, match=reason) as caught:
        composer.compose(sensor_scenes.demo())
    assert "\n" not in str(caught.value)
