"""Bunches that are drawn into canes and wires fall when they are picked, and touch these once they are clear."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from tests.laws.test_sleep import settled
from tests.support.contact_scenes import cane
from vinesim.core import frames
from vinesim.scene.builder import assemble
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.model import Model
from vinesim.scene.spec import load_scene
from vinesim.world import Physics

pytestmark = pytest.mark.slow

MASS = 0.4


def force_on(physics: Physics, bunch: int) -> float:
    """[N] with which plants bear and press a free bunch, upwards and aside."""
    forces = [contact.force for contact in physics.contacts if contact.actor == f"bunch/{bunch}"]
    return float(np.linalg.norm(np.sum(forces, 0))) if forces else 0.0


@pytest.mark.long
def test_bunches_of_a_hedge_fall_when_they_are_picked() -> None:
    """They hang beside upright shoots and over wires, most of them drawn into these by some centimetres."""
    scene = load_scene("vsp")
    layout = msgspec.structs.replace(scene.layout, rows=1, vines=5)
    physics = Physics(generate(msgspec.structs.replace(scene, layout=layout, boxes=(), spawns=())))
    bunches = range(len(physics.model.bunch_body))
    for bunch in bunches:
        physics.pick(bunch)
    start = np.array([physics.rigid.bunch_pose(bunch)[2] for bunch in bunches])
    hardest = 0.0
    for _ in range(150):
        physics.step()
        hardest = max([hardest, *(float(np.linalg.norm(contact.force)) for contact in physics.contacts)])
    fallen = start - np.array([physics.rigid.bunch_pose(bunch)[2] for bunch in bunches])
    assert np.mean(fallen > 0.5) > 0.75  # the others lie on wires
    assert hardest < 200.0


def among_canes(overlapping: bool) -> Model:
    """A bunch that hangs 2 cm deep in two level canes, or a metre beside them; trees 1 and 2."""
    carrier = cane((0.0, 0.0, 2.0), bunch=MASS)
    alone = assemble([carrier])
    middle = alone.forward_kinematics(alone.joint_settled)[alone.bunch_body[0]]
    at = middle[:3] + frames.rotate(middle[3:], np.array([0.085, 0.0, 0.0]))
    at += (-0.5, 0.0 if overlapping else 1.0, 0.0)
    return assemble([carrier, *(settled(at + np.array([0.0, side, 0.0]), radius=0.012) for side in (-0.035, 0.035))])


@pytest.mark.parametrize("overlapping", [True, False])
def test_a_bunch_passes_what_it_overlapped_and_lies_on_it_once_it_is_clear(overlapping: bool) -> None:
    model = among_canes(overlapping)
    physics = Physics(model)
    canes = model.forward_kinematics(model.joint_settled)[model.tree_first[1:]]
    physics.pick(0)
    pressed = []
    for _ in range(30):
        physics.step()
        pressed.append(force_on(physics, 0))
    assert max(pressed) == 0.0
    fallen = canes[0, 2] - physics.rigid.bunch_pose(0)[2]
    assert fallen > 0.2
    physics.rigid.place_bunch(0, frames.pose(canes[:, :3].mean(0) + np.array([0.5, 0.0, 0.05])), np.zeros(6))
    borne = []
    for _ in range(900):
        physics.step()
        borne.append(force_on(physics, 0))
    np.testing.assert_allclose(borne[600:], MASS * 9.81, rtol=1e-3)
