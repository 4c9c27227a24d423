"""An actor of another client may put all objects into one place: the step goes on, and others pay little for it."""

from __future__ import annotations

import numpy as np
import pytest

import vinesim
from vinesim.scene.ids import ObjectKind, object_id


@pytest.mark.slow
def test_forty_bunches_in_one_place_do_not_end_the_step() -> None:
    """They made 7,311 contacts, for which MuJoCo's memory does not suffice."""
    physics = vinesim.Simulation("demo").physics
    bunches = range(40)
    for bunch in bunches:
        physics.pick(bunch)
    numbers = [object_id(ObjectKind.BUNCH, bunch) for bunch in bunches]
    pose = np.tile([0.5, 0.5, 1.0, 0.0, 0.0, 0.0, 1.0], (len(numbers), 1))
    for _ in range(3):
        physics.support_tracker.set_states(numbers, pose, np.zeros((len(numbers), 6)))
        physics.step()
    assert physics.faults["objects_in_heaps"] >= 3 * 30
    assert np.isfinite(physics.rigid.mj_data.qpos).all()
    pose[:, 0] = 0.5 * np.arange(len(numbers))
    pose[:, 2] = 20.0
    physics.support_tracker.set_states(numbers, pose, np.zeros((len(numbers), 6)))
    before = physics.faults["objects_in_heaps"]
    physics.step()
    assert physics.faults["objects_in_heaps"] == before, "apart from each other they collide as before"
