"""Wires, cordon arms, poles and trunks stop everything that moves: canes, cut canes, bunches, boxes, robots, people."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.contact_scenes import cane, probe
from vinesim.core import frames
from vinesim.rigid.human_posture import standing_pose
from vinesim.rigid.static_world import MIN_STATIC_RADIUS
from vinesim.scene.builder import assemble
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.spec import load_scene
from vinesim.scene.values import HumanSpec
from vinesim.world import Physics

pytestmark = pytest.mark.slow

WIRE = {"fixed_organ": [int(Organ.WIRE)], "fixed_index": [0]}
ARM = {"fixed_organ": [int(Organ.ARM)], "fixed_index": [0]}
RADIUS = {int(Organ.WIRE): 0.0015, int(Organ.ARM): 0.02}


def piece(organ: dict, at: tuple[float, float, float], half: tuple[float, float, float] = (0.0, 1.0, 0.0)) -> dict:
    """A level wire or arm about ``at`` [3] m, with ends at +-``half`` [3] m."""
    radius = RADIUS[organ["fixed_organ"][0]]
    start = np.subtract(at, half)
    end = np.add(at, half)
    return organ | {"fixed_start": [start], "fixed_end": [end], "fixed_radius": [[radius, radius]]}


@pytest.mark.parametrize("organ", [WIRE, ARM])
def test_a_cane_that_is_pressed_down_bears_on_the_piece_below_it(organ: dict) -> None:
    """A piece 1 cm below a cane that is pressed down with 6 N at its tip: it bends about the piece, not through it."""
    below = 1.0 - 0.01 - RADIUS[organ["fixed_organ"][0]] - 0.006
    physics = Physics(assemble([cane((0.0, 0.0, 1.0))], **piece(organ, (0.5, 0.0, below))))
    physics.add_robot(probe((0.95, 0.0, 1.05)))
    rigid = physics.rigid
    forces = []
    for _ in range(200):
        rigid.apply_wrench("probe", "rod", np.array([0.0, 0.0, -6.0]))
        physics.step()
        forces.append(sum((c.force for c in physics.contacts if c.link == "fixed/0"), np.zeros(3)))
    at = physics.snapshot().body_q[:, :3]
    over = float(np.interp(0.5, at[:, 0], at[:, 2]))
    assert over == pytest.approx(1.0 - 0.01, abs=2e-3)
    assert at[-1, 2] < over - 0.03
    assert abs(forces[-1][2]) > 1.0


@pytest.mark.parametrize("organ", [WIRE, ARM])
def test_a_cut_cane_hangs_over_the_piece_on_which_it_falls(organ: dict) -> None:
    physics = Physics(assemble([cane((0.0, 0.0, 1.0))], **piece(organ, (0.5, 0.0, 0.9))))
    physics.plants.cut(0)
    lowest = np.inf
    for _ in range(35):
        physics.step()
        at = physics.snapshot().body_q[:, :3]
        near = np.abs(at[:, 0] - 0.5) < 0.04
        lowest = min(lowest, float(at[near, 2].min(initial=np.inf)))
    assert lowest > 0.9


@pytest.mark.parametrize("organ", [WIRE, ARM])
def test_a_bunch_that_is_picked_above_an_arm_does_not_fall_through_it(organ: dict) -> None:
    physics = Physics(assemble([cane((0.0, 0.0, 1.4), bunch=0.5)], **piece(organ, (1.0, 0.0, 0.9))), detachment=False)
    physics.pick(0)
    touched = False
    for _ in range(60):
        physics.step()
        data = physics.rigid.mj_data
        touched |= any(
            "fixed/0" in (physics.rigid.mj_model.geom(g).name for g in contact.geom) for contact in data.contact
        )
    assert touched


@pytest.mark.parametrize("organ", [WIRE, ARM])
def test_a_robot_stops_at_a_piece_that_is_in_its_way(organ: dict) -> None:
    """A rod that is pulled down with 20 N rests on a piece across it."""
    radius = max(RADIUS[organ["fixed_organ"][0]], MIN_STATIC_RADIUS)
    physics = Physics(assemble([], **piece(organ, (0.0, 0.0, 0.9), (1.0, 0.0, 0.0))))
    physics.add_robot(probe((0.0, 0.0, 1.0)))
    for _ in range(150):
        physics.rigid.apply_wrench("probe", "rod", np.array([0.0, 0.0, -20.0]))
        physics.step()
    assert physics.rigid.link_pose("probe", "rod")[2] == pytest.approx(0.9 + radius + 0.02, abs=2e-3)


def test_a_person_meets_a_wire_at_the_height_of_the_chest() -> None:
    physics = Physics(assemble([], **piece(WIRE, (0.4, 0.0, 1.2))))
    physics.add_human(HumanSpec("eva", 0, standing_pose(frames.pose([0.4, 0.0, 0.0]))))
    physics.step()
    names = {physics.rigid.mj_model.geom(g).name for c in physics.rigid.mj_data.contact for g in c.geom}
    assert "fixed/0" in names


def test_a_crate_rests_on_two_wires() -> None:
    model = assemble(
        [], fixed_start=[[-0.15, -1, 0.5], [0.15, -1, 0.5]], fixed_end=[[-0.15, 1, 0.5], [0.15, 1, 0.5]],
        fixed_radius=[[0.0015, 0.0015]] * 2, fixed_organ=[int(Organ.WIRE)] * 2, fixed_index=[0, 1],
        box_pose=[frames.pose([0.0, 0.0, 0.505])], box_size=[[0.6, 0.4, 0.3]], box_mass=[2.0],
    )  # fmt: skip
    physics = Physics(model)
    for _ in range(200):
        physics.step()
    height = physics.rigid.mj_data.body("box/0").xpos[2]
    assert height == pytest.approx(0.5 + MIN_STATIC_RADIUS, abs=1e-3)


def test_shoots_on_their_wires_and_arms_are_at_rest_as_generated() -> None:
    """Nothing of a vineyard presses on anything while it is as it was generated, all of it awake."""
    physics = Physics(generate(load_scene("demo")))
    physics.plants.wake(np.arange(len(physics.model.tree_first)))
    fastest = 0.0
    for _ in range(20):
        physics.step()
        assert not [contact for contact in physics.contacts if contact.link.startswith("fixed/")]
        fastest = max(fastest, float(physics.plants.tree_rate.max()))
    assert fastest < physics.parameters.sleep_rate
