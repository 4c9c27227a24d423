"""Where a person and a carrier meet: in reach of a bunch and a box, with room for both."""

import numpy as np
import pytest

from vinesim.client.tasks.planning import (
    CLAMPED_BOX_DISTANCE,
    KEPT_AWAY,
    MAX_PULL,
    PERSON_CLEARANCE,
    REACH,
    TURNING_RADIUS,
    plan_meeting,
)
from vinesim.client.tasks.start_poses import PlacementError, bunch_centres, ground_clearance, start_pose
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene


def test_person_and_carrier_have_room_and_reach():
    scene = load_scene("harvest")
    model = generate(scene)
    plan = plan_meeting(model, start_pose(scene, 0))
    waits = plan.path_to_person[-1]
    assert np.linalg.norm(bunch_centres(model)[plan.bunch, :2] - plan.stand) == pytest.approx(REACH, abs=1e-6)
    assert model.bunch_pull[plan.bunch] < MAX_PULL
    assert ground_clearance(model, waits[None])[0] > TURNING_RADIUS
    towards = np.array([np.cos(plan.heading), np.sin(plan.heading)])
    gives = waits + (CLAMPED_BOX_DISTANCE + REACH) * towards
    way = gives + np.linspace(0.0, 1.0, 20)[:, None] * (plan.stand - gives)
    assert ground_clearance(model, way).min() > 0.5 * PERSON_CLEARANCE
    assert (plan.stand - gives) @ towards == pytest.approx(np.linalg.norm(plan.stand - gives), rel=1e-6), "ahead of it"
    corners = np.concatenate([plan.path_to_box, plan.path_to_person])
    assert np.linalg.norm(corners - plan.stand, axis=1).min() > KEPT_AWAY - 1e-6


def test_a_box_that_the_scene_lacks_is_said():
    scene = load_scene("harvest")
    with pytest.raises(PlacementError, match="no box 7: this scene has 2"):
        plan_meeting(generate(scene), start_pose(scene, 0), box=7)
