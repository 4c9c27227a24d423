"""Shears in a hand: closing them cuts the bodies between the blades and no others; the page receives the result."""

import dataclasses

import numpy as np
import pytest

from tests.support.contact_scenes import bunch_scene, cane
from vinesim.avatar.local_human import CUT_PULSE, MISS_PULSE, LocalHuman
from vinesim.core import frames
from vinesim.interaction.cutting_force import remaining_strength
from vinesim.rigid.human_posture import standing_pose
from vinesim.scene import appearance
from vinesim.scene.builder import assemble
from vinesim.scene.values import HumanSpec
from vinesim.world import Physics

CLOSING = 18
"""Steps in which the shears close wholly: 32 mm with 0.2 m/s."""
AHEAD = frames.from_yaw(0.5 * np.pi)
"""The person looks along y."""


class Person:
    """Eva, who stands before a point with the mouth of the shears in her right hand there; the left one elsewhere."""

    def __init__(self, physics: Physics, point: np.ndarray, left: np.ndarray | None = None, **hand: bool) -> None:
        root = frames.pose(np.array([point[0] + 0.2, point[1] - 0.6, 0.0]), AHEAD)
        points = {"right": point} | ({} if left is None else {"left": left})
        mouth = frames.rotate(AHEAD, appearance.load_shears().mouth[:3])
        palms = {side: frames.pose(there - mouth, AHEAD) for side, there in points.items()}
        self.physics = physics
        self.pose = dataclasses.replace(standing_pose(root), **palms, **hand)
        self.human = LocalHuman(physics, HumanSpec("eva", 1, self.pose), lambda _: self.pose)

    def run(self, steps: int, **hand: bool) -> list:
        """Do some steps with the hand in another state; how the shears closed meanwhile."""
        self.pose = dataclasses.replace(self.pose, **hand)
        found = []
        self.detachments = []
        for _ in range(steps):
            self.human.control(self.physics.time)
            self.physics.step()
            self.detachments += self.physics.detachments
            self.human.update(self.physics.time)
            found += self.human.closures
        return found


def at_peduncle(aside: float = 0.0) -> tuple[Physics, int, Person]:
    """Before the lower half of a bunch's peduncle, the shears open around it or ``aside`` [m]; the bunch's body."""
    model, body, _ = bunch_scene()
    physics = Physics(model)
    stalk = physics.snapshot().body_q[body - 1, :3].astype(float)
    return physics, body, Person(physics, stalk + np.array([aside, 0.0, -0.02]), right_shears=True)


def test_shears_cut_the_peduncle_between_their_blades_when_the_hand_closes():
    physics, body, eva = at_peduncle()
    assert eva.run(10) == []
    assert physics.state.bunch_attached.all(), "open shears cut nothing"
    assert eva.run(10, right_closed=True) == []
    assert physics.state.bunch_attached.all(), "the blades need 16 steps"
    (closure,) = eva.run(CLOSING)
    (detachment,) = eva.detachments
    assert (detachment.bunch, detachment.body, detachment.cause, detachment.actor) == (0, body, "blade", "eva")
    assert (closure.side, closure.bunches, closure.canes) == ("right", 1, 0)
    assert closure.sentence == "The shears in the right hand cut 1 bunch."
    assert closure.haptic("eva").amplitude == CUT_PULSE[0]
    assert eva.run(20) == [], "a hand that stays closed has closed once"
    assert physics.hand("eva", "right").held is None, "a hand with shears holds nothing"


def test_shears_beside_the_wood_miss_and_may_close_again():
    physics, _, eva = at_peduncle(aside=0.05)
    (closure,) = eva.run(CLOSING, right_closed=True)
    assert (closure.has_cut, closure.resistance) == (False, 0.0)
    assert "missed" in closure.sentence
    assert closure.haptic("eva").amplitude == MISS_PULSE[0]
    assert eva.run(5, right_closed=False) == []
    assert len(eva.run(CLOSING, right_closed=True)) == 1
    assert physics.state.bunch_attached.all()


@pytest.mark.parametrize("bunches", [(1, 1), (1, 0), (0, 1)], ids=["both", "left", "right"])
def test_two_hands_that_close_in_one_step_report_each_its_own_cut(bunches):
    """Two peduncles 0.4 m apart; a hand that is to cut nothing closes 5 cm beside its own."""
    model = assemble([cane((x, 1.0, 2.0), bunch=0.5, heading=-0.5 * np.pi) for x in (0.0, 0.4)])
    physics = Physics(model)
    stalks = physics.snapshot().body_q[model.bunch_body - 1, :3].astype(float) - np.array([0.0, 0.0, 0.02])
    stalks[:, 0] += [0.0 if cuts else 0.05 for cuts in bunches]
    eva = Person(physics, stalks[1], stalks[0], left_shears=True, right_shears=True)
    assert eva.run(5) == []
    closures = eva.run(CLOSING, left_closed=True, right_closed=True)
    assert [(one.side, one.bunches, one.canes) for one in closures] == [
        ("left", bunches[0], 0),
        ("right", bunches[1], 0),
    ]
    assert physics.state.bunch_attached.tolist() == [not cuts for cuts in bunches]


def test_shears_that_close_on_a_peduncle_without_its_bunch_say_so():
    physics, _, eva = at_peduncle()
    physics.pick(0)
    (closure,) = eva.run(CLOSING, right_closed=True)
    assert not closure.has_cut
    assert 0.0 < closure.resistance < closure.force
    assert "was picked before" in closure.sentence


def test_a_hand_that_closes_without_shears_cuts_nothing():
    physics, _, eva = at_peduncle()
    assert eva.run(5, right_shears=False, right_closed=True) == []
    assert eva.run(5, right_shears=True) == [], "it was closed already when it took the shears"
    assert physics.state.bunch_attached.all()


@pytest.mark.parametrize(("radius", "is_cut"), [(0.0055, True), (0.009, False)])
def test_wood_that_resists_more_than_the_shears_can_do_stays_and_the_person_is_told(radius, is_cut):
    """13.16 MPa over the cross-section: 1,251 N at 11 mm, 3,349 N at 18 mm."""
    physics = Physics(assemble([cane((0.0, 0.0, 1.3), radius=radius)]))
    at = physics.snapshot().body_q[8].astype(float)
    eva = Person(physics, at[:3] + frames.rotate(at[3:], np.array([0.03, 0.0, 0.0])), right_shears=True)
    (closure,) = eva.run(CLOSING, right_closed=True)
    expected = physics.parameters.cutting_strength * np.pi * radius**2
    assert closure.resistance == pytest.approx(expected, rel=1e-3)
    assert (closure.bunches, closure.canes) == (0, int(is_cut))
    assert physics.state.body_cut.any() == is_cut
    assert is_cut or f"too weak: this wood takes {expected:,.0f} N" in closure.sentence


def test_shears_in_a_hand_that_opens_early_leave_a_partial_cut_that_weakens_the_peduncle():
    physics, body, eva = at_peduncle()
    assert eva.run(15, right_closed=True) == [], "30 of 32 mm: 2 mm deep in a peduncle of 4 mm"
    assert eva.run(5, right_closed=False) == []
    (segment,) = np.flatnonzero(physics.state.notch_depth).tolist()
    depth = float(physics.state.notch_depth[segment])
    assert segment == body - 1
    assert depth == pytest.approx(0.5, abs=0.01)
    monitor = physics.detachment_monitor
    pull, bend = remaining_strength(depth)
    assert monitor.wood.left[0] == pytest.approx((pull, bend))
    assert physics.plants.held_bodies == []


def test_the_blades_go_with_the_person():
    physics, _, _ = at_peduncle()
    assert {blade.actor for blade in physics.detachment_monitor.blades} == {"eva"}
    physics.remove_human("eva")
    assert physics.detachment_monitor.blades == []
    with pytest.raises(ValueError, match="no robot 'eva'"):
        physics.add_blade("eva", "right_hand", frames.pose(np.zeros(3)), np.ones(3))


def test_what_is_between_the_blades_is_known_before_they_close():
    physics, _, eva = at_peduncle()
    eva.run(1)
    assert eva.human.between_blades() == ("", "bunch")
    eva.run(CLOSING, right_closed=True)
    assert eva.human.between_blades() == ("", ""), "a stalk without its bunch"
    eva.run(1, right_closed=False, right_shears=False)
    assert eva.human.between_blades() == ("", ""), "no shears"
    assert not physics.state.bunch_attached.any()


@pytest.mark.parametrize(("radius", "between"), [(0.0055, "cane"), (0.009, "strong wood")])
def test_wood_between_the_blades_is_told_apart_by_its_strength(radius, between):
    physics = Physics(assemble([cane((0.0, 0.0, 1.3), radius=radius)]))
    at = physics.snapshot().body_q[8].astype(float)
    eva = Person(physics, at[:3] + frames.rotate(at[3:], np.array([0.03, 0.0, 0.0])), right_shears=True)
    eva.run(1)
    assert eva.human.between_blades() == ("", between)
    assert not physics.state.body_cut.any()
