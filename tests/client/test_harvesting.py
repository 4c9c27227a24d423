"""Harvests (docs/jobs.md): which bunch is next, where bunches lie in the crate, and what a robot remembers."""

from __future__ import annotations

import functools

import msgspec
import numpy as np
import pytest

from vinesim.client.tasks import planning, start_poses
from vinesim.client.tasks.harvesting import PLACES, Candidates, HarvestOptions, PickOrder
from vinesim.client.tasks.registry import plan_task
from vinesim.client.tasks.seen_harvest import Memory, survey_places
from vinesim.core.errors import UsageError
from vinesim.rigid.static_world import CRATE_WALL
from vinesim.robot.tasks.sight import SeenBunch, Sight
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene

ALL = HarvestOptions(bunches=0)


@functools.cache
def harvest() -> tuple[Model, np.ndarray, Candidates]:
    scene = load_scene("harvest")
    model = generate(scene)
    near = start_poses.spawn_pose(scene, 0)[:2]
    return model, near, Candidates.of_model(model, near)


def test_one_bunch_is_the_one_that_was_planned_before_and_lies_in_the_middle():
    model, near, candidates = harvest()
    plan = candidates.next_plan(near, set(), HarvestOptions(), 0)
    best = next(planning.plan_picks(model, near))
    assert (plan.bunch, plan.side, plan.box, plan.place) == (best.bunch, best.side, best.box, (0.0, 0.0, 0.0))
    np.testing.assert_array_equal(plan.path, best.path)


def test_all_bunches_of_a_crate_go_into_one_box_each_once_to_places_inside_it():
    model, near, candidates = harvest()
    taken: set[int] = set()
    for number in range(len(PLACES)):
        plan = candidates.next_plan(near, taken, ALL, number)
        assert plan.bunch not in taken
        taken.add(plan.bunch)
        assert plan.box == candidates.box
        assert plan.place == PLACES[number]
        # the bunch lies along the box: its middle and half its width are between the walls
        size = model.box_size[plan.box].astype(float)
        assert abs(plan.place[0]) + 0.08 < 0.5 * size[0] - CRATE_WALL
        assert abs(plan.place[1]) + float(model.bunch_radius[plan.bunch]) < 0.5 * size[1] - CRATE_WALL


def test_the_nearest_bunch_is_the_one_whose_place_for_the_base_is_nearest():
    _, near, candidates = harvest()
    here = near + np.array([1.0, 0.3])
    plan = candidates.next_plan(here, set(), HarvestOptions(order=PickOrder.NEAREST), 0)
    roomy = [one for one in candidates.grasps if one[3] >= planning.MIN_HAND_CLEARANCE]
    least = min(float(np.linalg.norm(one[2][:2] - here)) for one in roomy)
    assert np.linalg.norm(plan.base_pose[:2] - here) == pytest.approx(least, abs=0.3)
    freest = candidates.next_plan(here, set(), HarvestOptions(), 0)
    assert np.linalg.norm(plan.base_pose[:2] - here) < np.linalg.norm(freest.base_pose[:2] - here)


def test_wrong_options_are_refused_in_a_line():
    with pytest.raises(UsageError, match=r"^no order 'biggest'; give freest or nearest$"):
        HarvestOptions.named(1, "biggest")
    with pytest.raises(UsageError, match=r"^bunches is -1; give the number to pick, or 0 for all$"):
        HarvestOptions.named(-1, "freest")
    assert HarvestOptions.named(0, "nearest").most == len(PLACES)


@pytest.mark.parametrize("eyes", [None, lambda physics, robot: None])
def test_a_vineyard_without_bunches_is_refused_in_a_line(eyes):
    scene = load_scene("harvest")
    bare = msgspec.structs.replace(scene, fruit=msgspec.structs.replace(scene.fruit, bunches=(0, 0)))
    near = start_poses.spawn_pose(bare, 0)
    with pytest.raises(start_poses.PlacementError, match=r"^this vineyard has no bunch to pick; raise fruit\.bunches"):
        plan_task("pick", generate(bare), near, ALL, eyes)


def seen(x: float, y: float, *, distance: float = 0.8, is_cut_off: bool = False) -> SeenBunch:
    return SeenBunch(np.array([x, y, 1.75]), 0.16, 0.055, 1.0, distance, is_cut_off)


def test_a_bunch_that_is_seen_twice_is_remembered_once_by_its_nearest_whole_sight():
    memory = Memory()
    nothing = np.zeros((0, 3))
    memory.add(Sight((seen(1.0, 0.0, distance=1.2), seen(1.2, 0.0)), nothing, nothing))
    memory.add(
        Sight((seen(1.03, 0.01, distance=0.7), seen(1.02, 0.0, distance=0.5, is_cut_off=True)), nothing, nothing)
    )
    memory.add(Sight((seen(2.0, 0.0, distance=1.7),), nothing, nothing))  # too far away
    assert [one.sights for one in memory.bunches] == [3, 1]
    assert memory.bunches[0].best.top[0] == 1.03


def test_wood_beside_a_remembered_bunch_takes_room_but_its_own_stalk_does_not():
    model, near, _ = harvest()
    nothing = np.zeros((0, 3))
    place = start_poses.bunch_centres(model)[planning.plan_picks(model, near).__next__().bunch]

    def room(wood: np.ndarray) -> float:
        memory = Memory()
        memory.add(Sight((SeenBunch(place + np.array([0.0, 0.0, 0.08]), 0.16, 0.055, 1.0, 0.8, False),), wood, nothing))
        return max(one[3] for one in memory.grasps(model, near))

    assert room(nothing) == planning.FULL_CLEARANCE
    assert room(place + np.array([[0.0, 0.0, 0.1]])) == planning.FULL_CLEARANCE
    around = np.array([[0.1 * np.cos(a), 0.1 * np.sin(a), 0.04] for a in np.linspace(0.0, 6.2, 40)])
    assert room(place + around) < 0.0


def test_a_survey_visits_free_places_around_the_start():
    model, near, _ = harvest()
    places = np.array(survey_places(model, near))
    assert len(places) > 5
    assert np.linalg.norm(places - near, axis=1).max() < 3.9
    assert start_poses.ground_clearance(model, places).min() > planning.BASE_CLEARANCE
    assert np.linalg.norm(places[0] - near) < 1.0
