"""The bench of picking (docs/jobs.md): tries of single bunches, and their classes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks import pruning
from benchmarks.picking import all_measurements, attempt_seen, class_name, success_measurements
from vinesim.api.picking import Grasp, PickAttempt, attempt_pick
from vinesim.client.tasks import planning
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.robot.tasks.sight import SeenBunch
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene, with_seed


@pytest.mark.parametrize(
    ("clearance", "name"),
    [
        (-0.02, "hand overlaps its neighbours"),
        (0.0, "0 to 5 mm"),
        (0.005, "5 to 15 mm"),
        (0.02, "15 to 30 mm"),
        (0.03, "30 mm or more"),
    ],
)
def test_every_clearance_has_one_class(clearance, name):
    assert class_name(clearance) == name


def test_success_is_counted_over_all_and_by_class():
    tries = [
        PickAttempt(1, 0.02, True, "", 0),
        PickAttempt(2, 0.01, False, "advance: no", 1),
        PickAttempt(3, -0.01, False, "cut: no", 0),
    ]
    values = {m.case: m.value for m in success_measurements(tries)}
    assert values["all in reach (3 tried)"] == pytest.approx(100.0 / 3.0)
    assert values["clearance: 15 to 30 mm (1 tried)"] == 100.0
    assert values["clearance: 5 to 15 mm (1 tried)"] == 0.0
    assert values["the one a job would take"] == 100.0
    assert values["failed in phase advance"] == values["other bunches that came off"] == 1.0


def test_a_bunch_counts_once_and_only_in_reach_in_its_true_class():
    first = dataclasses.asdict(PickAttempt(1, 0.02, True, "", 0, 10.0))
    line = {"by": "cameras", "in_reach": 3, "pictures": 8, "clearance": {"1": 0.03, "2": 0.016, "3": None}}
    line["tries"] = [first, first, first | {"bunch": 9}, first | {"bunch": 2, "picked": False, "reason": "cut: no"}]
    values = {m.case: m.value for m in all_measurements([line])}
    case = "demo, bunches within 3 m of start place 0, by cameras"
    assert values[f"{case}: picked"] == pytest.approx(100.0 / 3.0)
    assert values[f"{case}: picked of 2 with 15 mm of room"] == 50.0
    assert values["true clearance: no hand or base reaches it (1)"] == 0.0
    assert values["bunches that the survey found and a hand reaches"] == pytest.approx(200.0 / 3.0)


def test_a_vine_is_right_if_all_cuts_are_and_no_kept_bud_is_pressed():
    right = {"wanted": 2, "made": 2, "right": 2, "off": [0.001, 0.003], "reasons": [], "others_cut": 0}
    right |= {"bud_forces": [0.0, 4.9], "seconds": 8.0}
    pressed = right | {"bud_forces": [0.0, 5.1]}
    missed = right | {"right": 1, "off": [0.001, 0.02], "others_cut": 1}
    values = {m.case: m.value for m in pruning.measurements([right, pressed, missed])}
    assert values["vines with all cuts right and no kept bud pressed"] == 1.0
    assert values["of 6 cuts within 10 mm of their places"] == pytest.approx(500.0 / 6.0)
    assert values["of 6 kept buds, pressed by more than 5 N"] == 1.0
    assert values["seconds of a vine"] == 8.0


@pytest.mark.long
def test_the_freest_bunch_is_picked_from_where_it_was_seen():
    """The place that the robot is told is 2 cm wrong: it looks again from the place of the pick."""
    scene = with_seed(load_scene("harvest"), 7)
    model = generate(scene)
    bunch, side, base, clearance = next(planning.freest_bases(model, spawn_pose(scene, 0)[:2], 3.0))
    top = model.forward_kinematics(model.joint_settled)[model.bunch_body[bunch], :3].astype(float)
    seen = SeenBunch(top + np.array([0.02, -0.01, 0.01]), 0.16, 0.055, 1.0, 1.0, False)
    result = attempt_seen(model, 0, seen, side, base, clearance, 7)
    assert result.picked, result.reason
    assert result.bunch == bunch


@pytest.mark.long
def test_a_robot_prunes_a_spur_within_ten_millimetres_and_leaves_its_buds_alone():
    line = pruning.prune_one(1, 2)
    assert line["right"] == line["wanted"] == 3
    assert max(line["bud_forces"]) < pruning.LARGEST_FORCE


@pytest.mark.long
def test_narrow_bunches_are_tried_as_well_and_the_freest_is_the_one_that_a_job_takes():
    scene = with_seed(load_scene("harvest"), 7)
    model = generate(scene)
    near = spawn_pose(scene, 0)[:2]
    found = list(planning.freest_bases(model, near, 3.0))
    assert len({bunch for bunch, *_ in found}) == len(found) > 5
    assert min(clearance for *_, clearance in found) < 0.0
    result = attempt_pick(model, Grasp(*found[0]))
    assert result.picked, result.reason
    assert result.others == 0
