"""The bench of picking: tries of single bunches, and their classes."""

from __future__ import annotations

import pytest

from benchmarks.picking import class_name, success_measurements
from vinesim.api.picking import Grasp, PickAttempt, attempt_pick
from vinesim.client.tasks import planning
from vinesim.client.tasks.start_poses import spawn_pose
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
