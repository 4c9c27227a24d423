"""Hands of humans: pushing, holding, pulling off, carrying, releasing; and haptic feedback."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.physics.test_human_body import eva, put
from tests.support.contact_scenes import bunch_scene, cane, gripper, probe
from vinesim.avatar.local_human import HapticFeedback
from vinesim.core import frames
from vinesim.plants.articulation_solver import ArticulationSolver
from vinesim.rigid.human_posture import HAND_HALF_THICKNESS
from vinesim.scene.builder import assemble
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.spare_bodies import with_spares
from vinesim.scene.state import State
from vinesim.scene.values import POINT_NAMES, Drive, HumanPose, HumanSpec
from vinesim.world import Physics

FORWARD = frames.multiply(frames.from_yaw(0.5 * np.pi), frames.exp(np.array([0.0, -0.5 * np.pi, 0.0])))
"""Fingers up, palm along +y."""
SIGNS = {"left": 1.0, "right": -1.0}
SOFT = (Drive("along", 400.0, 60.0, 1000.0, 5.0, -5.0, 5.0), Drive("press", 5000.0, 300.0, 1000.0, 5.0, -1.0, 1.0))


def human_at_bunch(
    mass: float = 0.5, pull: float = 1e3, parameters: PhysicsParameters = PhysicsParameters()
) -> tuple[Physics, HumanSpec, int, np.ndarray]:
    """A human before a hanging bunch, the right palm 3 cm away; returns also the bunch's body and centre."""
    model, body, middle = bunch_scene(mass)
    model.bunch_pull[0] = pull
    model.bunch_bend[0] = 1e3
    physics = Physics(model, parameters=parameters)
    spec = eva(middle[0], middle[1] - 0.6, 0.5 * np.pi)
    at = frames.pose(middle - np.array([0.0, 0.075 + HAND_HALF_THICKNESS, 0.0]), FORWARD)
    spec = dataclasses.replace(spec, pose=put(spec.pose, at))
    physics.add_human(spec)
    return physics, spec, body, middle


def with_right_hand(spec: HumanSpec, *way: float, closed: bool = False) -> HumanPose:
    """The pose with the right controller moved by ``way`` [m]."""
    at = frames.pose(spec.pose.right[:3] + np.array(way), FORWARD)
    return put(spec.pose, at, right_closed=closed)


def move(physics: Physics, spec: HumanSpec, *way: float, ticks: int, wait: int = 0, closed: bool = False) -> HumanSpec:
    """Move the right controller by ``way`` [m] from its place in ``spec`` and wait; returns the spec with that pose."""
    for fraction in np.append(np.linspace(0.0, 1.0, ticks), np.ones(wait)):
        physics.move_human("eva", with_right_hand(spec, *(fraction * np.array(way)), closed=closed))
        physics.step()
    return dataclasses.replace(spec, pose=with_right_hand(spec, *way, closed=closed))


def middle_of(physics: Physics, body: int) -> np.ndarray:
    pose = physics.snapshot().body_q[body].astype(float)
    return pose[:3] + frames.rotate(pose[3:], np.array([0.085, 0.0, 0.0]))


# ---------------------------------------------------------------------- pushing


def test_a_hand_pushes_a_bunch_with_the_reaction_force():
    physics, spec, body, middle = human_at_bunch()
    move(physics, spec, 0.0, 0.2, 0.0, ticks=200, wait=500)
    hand = physics.hand("eva", "right")
    pressing = sum(contact.force for contact in physics.contacts if contact.actor == "eva")
    assert middle_of(physics, body)[1] > middle[1] + 0.05
    assert hand.force[1] > 0.5
    np.testing.assert_allclose(pressing, -hand.force, atol=0.02)
    np.testing.assert_allclose(hand.force, 100.0 * (hand.controller - hand.pose)[:3], atol=0.05)
    assert physics.touched == ((0, "eva"),)


def test_a_walking_body_pushes_canes():
    """Head and trunk move at 1.4 m/s and push the canes before them: none passes through."""
    model = assemble([cane((-0.5, 0.3 * i, 1.25)) for i in range(3)])
    physics = Physics(model)
    spec = eva(0.2, -0.6, 0.5 * np.pi)
    physics.add_human(spec)
    furthest = 0.0
    for tick in range(60):
        walk = np.array([0.0, 0.014 * tick, 0, 0, 0, 0, 0])
        moved = {name: getattr(spec.pose, name) + walk for name in POINT_NAMES}
        physics.move_human("eva", dataclasses.replace(spec.pose, **moved))
        physics.step()
        furthest = max(furthest, *(-contact.distance for contact in physics.contacts), 0.0)
    front = -0.6 + 0.014 * 59
    tips = model.bodies_of(0).stop - 1, model.bodies_of(1).stop - 1
    assert all(physics.snapshot().body_q[tip, 1] > front for tip in tips)
    assert furthest < 0.01
    assert {contact.link for contact in physics.contacts} <= {"chest", "left_hand", "right_hand", "hips"}


# ---------------------------------------------------------------------- holding


def test_an_added_tie_acts_beside_ties_of_the_model():
    """An added tie of 200 N/m at the tip of a tied cane acts like a tie of the model."""
    tree = cane((0.0, 0.0, 2.0))
    model = assemble(
        [tree],
        tie_body=[15],
        tie_point=np.zeros((1, 3)),
        tie_anchor=np.zeros((1, 3)),
        tie_stiffness=[500.0],
        tie_damping=[5.0],
    )
    model.tie_anchor[0] = model.forward_kinematics(model.joint_settled)[15, :3]
    twin = assemble(
        [tree],
        tie_body=[15, 15],
        tie_point=[[0.0, 0, 0], [0.05, 0, 0]],
        tie_anchor=np.zeros((2, 3)),
        tie_stiffness=[500.0, 200.0],
        tie_damping=[5.0, 10.0],
    )
    at = model.forward_kinematics(model.joint_settled)[15]
    twin.tie_anchor[:] = model.tie_anchor[0], at[:3] + frames.rotate(at[3:], np.array([0.05, 0.0, 0.0]))
    held = ArticulationSolver(model, State.at_rest(model))
    modelled = ArticulationSolver(twin, State.at_rest(twin))
    tie = held.add_tie(15, np.array([0.05, 0.0, 0.0]), 200.0, 10.0)
    np.testing.assert_allclose(held.tie_anchor[tie], twin.tie_anchor[1], atol=1e-6)
    modelled.tie_anchor[1] = held.tie_anchor[tie]
    for plants, k in ((held, tie), (modelled, 1)):
        plants.tie_anchor[k, 1] += 0.1
        plants.wake(0)
        for _ in range(100):
            plants.predict()
            plants.integrate()
    np.testing.assert_array_equal(held.state.joint_q, modelled.state.joint_q)
    assert np.abs(held.state.joint_q - model.joint_settled).max() > 1e-3
    held.remove_tie(15, tie)
    modelled.tie_stiffness[1] = modelled.tie_damping[1] = 0.0
    for plants in (held, modelled):
        for _ in range(100):
            plants.predict()
            plants.integrate()
    np.testing.assert_array_equal(held.state.joint_q, modelled.state.joint_q)


def test_the_number_of_held_bodies_is_limited():
    model = assemble([cane((0.0, y, 2.0)) for y in range(2)])
    plants = ArticulationSolver(model, State.at_rest(model))
    for _ in range(PhysicsParameters().max_hands_per_body):
        plants.add_tie(0, np.zeros(3), 1.0, 0.0)
    with pytest.raises(ValueError, match=f"body 0 is held in {PhysicsParameters().max_hands_per_body} places already"):
        plants.add_tie(0, np.zeros(3), 1.0, 0.0)
    for body in range(1, PhysicsParameters().max_held_bodies):
        plants.add_tie(body, np.zeros(3), 1.0, 0.0)
    with pytest.raises(ValueError, match=f"body {PhysicsParameters().max_held_bodies} is one too many"):
        plants.add_tie(PhysicsParameters().max_held_bodies, np.zeros(3), 1.0, 0.0)


def test_a_bunch_is_held_and_follows():
    physics, spec, body, middle = human_at_bunch()
    near = move(physics, spec, 0.0, 0.04, 0.0, ticks=50, wait=50)
    move(physics, near, 0.0, -0.3, 0.0, ticks=150, wait=550, closed=True)
    hand = physics.hand("eva", "right")
    assert hand.held == ("plants", f"body/{body}")
    assert middle_of(physics, body)[1] < middle[1] - 0.05
    offset = hand.controller[:3] - hand.pose[:3]
    assert np.linalg.norm(offset) > 0.02
    np.testing.assert_allclose(hand.force, 100.0 * offset, atol=0.02)
    assert physics.touched == ((0, "eva"),)
    (contact,) = [contact for contact in physics.contacts if contact.actor == "eva"]
    np.testing.assert_allclose(contact.force, -hand.force)
    for _ in range(200):  # a held tree stays awake without motion
        physics.step()
    assert physics.state.tree_awake[0]
    physics.move_human("eva", put(spec.pose))
    for _ in range(600):
        physics.step()
    assert physics.hand("eva", "right").held is None
    assert abs(middle_of(physics, body)[1] - middle[1]) < 0.02
    assert physics.contacts == ()


def test_a_bunch_pulled_off_stays_in_the_hand_with_its_weight():
    """F34: 0.8 kg hang 7.8 cm below the controller."""
    physics, spec, _, _ = human_at_bunch(0.8, pull=15.0)
    near = move(physics, spec, 0.0, 0.04, 0.0, ticks=50, wait=50)
    detachments = []
    for fraction in np.append(np.linspace(0.0, 1.0, 200), np.ones(600)):
        physics.move_human("eva", with_right_hand(near, 0.0, -0.3 * fraction, -0.6 * fraction, closed=True))
        physics.step()
        detachments += physics.detachments
    assert [(detachment.bunch, detachment.cause, detachment.actor) for detachment in detachments] == [
        (0, "pull", "eva")
    ]
    hand = physics.hand("eva", "right")
    assert hand.held == ("bunch/0", "bunch")
    assert hand.controller[2] - hand.pose[2] == pytest.approx(0.0785, abs=5e-4)
    assert hand.force[2] == pytest.approx(0.8 * 9.81, rel=5e-3)
    assert physics.rigid.bunch_pose(0)[2] > 0.5
    physics.move_human("eva", with_right_hand(near, 0.0, -0.3, -0.6))
    for _ in range(150):
        physics.step()
    assert physics.hand("eva", "right").held is None
    assert physics.rigid.bunch_pose(0)[2] < 0.2


def test_a_bunch_on_the_ground_is_picked_up():
    """F34: a free bunch of 0.8 kg leaves the ground when the controller is 7.8 cm above the hand."""
    model, _, middle = bunch_scene(0.8)
    physics = Physics(model)
    physics.pick(0)
    for _ in range(200):
        physics.step()
    resting_pose = physics.rigid.bunch_pose(0)
    middle = resting_pose[:3] + frames.rotate(resting_pose[3:], np.array([0.085, 0.0, 0.0]))
    spec = eva(middle[0] - 0.5, middle[1])
    physics.add_human(spec)
    grasp_point = middle + np.array([0.0, 0.0, 0.045 + 2.0 * HAND_HALF_THICKNESS])
    for fraction in np.linspace(0.0, 1.0, 150):
        physics.move_human("eva", put(spec.pose, (1.0 - fraction) * spec.pose.right[:3] + fraction * grasp_point))
        physics.step()
    for rise in np.concatenate([np.linspace(0.0, 0.4, 200), np.full(400, 0.4)]):
        physics.move_human("eva", put(spec.pose, grasp_point + np.array([0.0, 0.0, rise]), right_closed=True))
        physics.step()
    hand = physics.hand("eva", "right")
    assert hand.held == ("bunch/0", "bunch")
    assert hand.controller[2] - hand.pose[2] == pytest.approx(0.0785, abs=5e-4)
    assert physics.rigid.bunch_pose(0)[2] > resting_pose[2] + 0.2


def test_a_cut_bunch_stays_in_the_hand_that_holds_it():
    physics, spec, body, _ = human_at_bunch(0.8)
    near = move(physics, spec, 0.0, 0.04, 0.0, ticks=50, wait=50)
    move(physics, near, 0.0, 0.0, 0.0, ticks=50, closed=True)
    assert physics.hand("eva", "right").held == ("plants", f"body/{body}")
    physics.pick(0)
    move(physics, near, 0.0, 0.0, 0.0, ticks=400, closed=True)
    hand = physics.hand("eva", "right")
    assert hand.held == ("bunch/0", "bunch")
    assert hand.controller[2] - hand.pose[2] == pytest.approx(0.0785, abs=1e-3)
    assert not physics.plants.tie_stiffness.any()


def test_a_robot_joins_while_a_hand_holds_a_plant():
    physics, spec, body, middle = human_at_bunch()
    near = move(physics, spec, 0.0, 0.04, 0.0, ticks=50, wait=50)
    move(physics, near, 0.0, -0.2, 0.0, ticks=100, wait=50, closed=True)
    before = physics.hand("eva", "right")
    physics.add_robot(gripper(middle + np.array([5.0, 0.0, 0.0])))
    np.testing.assert_array_equal(physics.hand("eva", "right").pose, before.pose)
    for _ in range(20):
        physics.step()
    hand = physics.hand("eva", "right")
    assert hand.held == ("plants", f"body/{body}")
    assert np.linalg.norm(hand.force - before.force) < 0.3


def test_a_cane_is_held():
    model = assemble([cane((-0.5, 0.0, 1.1))])
    physics = Physics(model)
    spec = eva(0.2, -0.6, 0.5 * np.pi)
    spec = dataclasses.replace(spec, pose=put(spec.pose, frames.pose(np.array([0.2, -0.1, 1.1]), FORWARD)))
    physics.add_human(spec)
    near = move(physics, spec, 0.0, 0.09, 0.0, ticks=60, wait=30)
    move(physics, near, 0.0, -0.2, 0.1, ticks=100, wait=500, closed=True)
    hand = physics.hand("eva", "right")
    assert hand.held[0] == "plants"
    np.testing.assert_allclose(hand.force, 100.0 * (hand.controller - hand.pose)[:3], atol=0.02)
    assert np.linalg.norm(hand.force) > 1.0
    assert physics.snapshot().body_q[12, 1] < -0.05


@pytest.mark.parametrize("side", ["stump", "piece"])
def test_a_hand_keeps_the_wood_that_it_holds_when_a_cane_is_cut(side):
    """A cut beyond the hand leaves the stump in it; a cut before the hand leaves the piece in it."""
    model = with_spares(assemble([cane((-0.5, 0.0, 1.1))]))
    physics = Physics(model)
    spec = eva(0.2, -0.6, 0.5 * np.pi)
    spec = dataclasses.replace(spec, pose=put(spec.pose, frames.pose(np.array([0.2, -0.1, 1.1]), FORWARD)))
    physics.add_human(spec)
    near = move(physics, spec, 0.0, 0.09, 0.0, ticks=60, wait=30)
    move(physics, near, 0.0, 0.0, 0.0, ticks=40, closed=True)
    (grasp,) = physics.grasp_manager._grasps.values()
    held, along = grasp.body, float(grasp.point[0])
    length = float(model.body_length[held])
    assert 0.004 < along < length - 0.004
    physics.cut(held, along + 0.003 if side == "stump" else along - 0.003)
    for _ in range(100):
        physics.step()
    (grasp,) = physics.grasp_manager._grasps.values()
    stump = int(physics.plants.stumps.table[0, 0])
    assert grasp.body == (stump if side == "stump" else held)
    assert physics.hand("eva", "right").held == ("plants", f"body/{grasp.body}")
    assert physics.plants.held_bodies == [grasp.body]
    pose = physics.snapshot().body_q[grasp.body].astype(float)
    point = pose[:3] + frames.rotate(pose[3:], grasp.point)
    assert np.linalg.norm(point - physics.plants.tie_anchor[grasp.tie]) < 0.03


def test_two_hands_carry_a_box():
    """F34: 10 kg on two hands, 49 cm each."""
    model = assemble(
        [cane((0.0, -5.0, 3.0))], box_pose=[[0, 0, 0.002, 0, 0, 0, 1]], box_size=[[0.6, 0.4, 0.24]], box_mass=[10.0]
    )
    physics = Physics(model)
    spec = eva(-0.7, 0.0)
    physics.add_human(spec)

    def hold(inside: float, height: float, *, closed: bool) -> None:
        at = {side: np.array([0.0, sign * (0.2 + 0.1 - inside), height, 0, 0, 0, 1]) for side, sign in SIGNS.items()}
        for side, sign in SIGNS.items():  # palms towards the box
            at[side][3:] = frames.exp(np.array([-sign * 0.5 * np.pi, 0.0, 0.0]))
        physics.move_human("eva", put(spec.pose, **at, left_closed=closed, right_closed=closed))
        physics.step()

    for _ in range(150):
        hold(0.0, 0.15, closed=False)
    for inside in np.linspace(0.0, 0.1, 100):
        hold(inside, 0.15, closed=False)
    for rise in np.append(np.linspace(0.0, 0.8, 200), np.full(1200, 0.8)):
        hold(0.1, 0.15 + rise, closed=True)
    left = physics.hand("eva", "left")
    right = physics.hand("eva", "right")
    assert left.held == right.held == ("box/0", "box")
    for hand in (left, right):
        assert hand.controller[2] - hand.pose[2] == pytest.approx(0.4905, rel=0.02)
    assert physics.rigid.mj_data.body("box/0").xpos[2] == pytest.approx(0.8 - 0.4905, abs=0.02)


def test_a_robot_is_moved_by_a_holding_hand():
    """F14: a closing hand grasps the link it touches and moves the robot against its drive."""
    model = assemble([cane((0.0, -5.0, 3.0))])
    physics = Physics(model)
    spec = eva(-1.0)
    physics.add_robot(probe((0.0, 0.0, 1.1), drives=SOFT))
    physics.add_human(spec)

    def lead(x: float, *, closed: bool) -> None:
        physics.move_human("eva", put(spec.pose, (x, 0.0, 1.1), right_closed=closed))
        physics.step()

    for x in np.append(np.linspace(-0.6, -0.05, 200), np.full(50, -0.05)):
        lead(x, closed=False)
    for x in np.append(np.linspace(-0.05, -0.6, 200), np.full(400, -0.6)):
        lead(x, closed=True)
    assert physics.hand("eva", "right").held == ("probe", "rod")
    position, _, effort, _ = physics.rigid.joint_measurements("probe")
    assert position[0] < -0.05
    assert effort[0] == pytest.approx(-physics.hand("eva", "right").force[0], rel=1e-2)
    for _ in range(300):
        lead(-0.6, closed=False)
    assert physics.hand("eva", "right").held is None
    assert abs(physics.rigid.joint_measurements("probe")[0][0]) < 1e-4


def test_a_closed_hand_grasps_nothing():
    physics, spec, _, _ = human_at_bunch()
    retracted = move(physics, spec, 0.0, -0.2, 0.0, ticks=50)
    move(physics, retracted, 0.0, 0.0, 0.0, ticks=30, closed=True)
    move(physics, retracted, 0.0, 0.3, 0.0, ticks=100, wait=100, closed=True)
    assert physics.hand("eva", "right").held is None
    assert physics.hand("eva", "right").touching


def test_a_human_that_leaves_releases():
    physics, spec, body, _ = human_at_bunch()
    near = move(physics, spec, 0.0, 0.04, 0.0, ticks=50)
    move(physics, near, 0.0, -0.1, 0.0, ticks=50, closed=True)
    assert physics.hand("eva", "right").held == ("plants", f"body/{body}")
    physics.remove_human("eva")
    assert not physics.plants.tie_stiffness.any()
    physics.step()
    assert physics.contacts == ()


# ---------------------------------------------------------------------- haptic feedback


def test_haptic_pulses_start_at_contact_and_follow_the_force():
    """F33"""
    physics, spec, _, _ = human_at_bunch()
    feedback = HapticFeedback(physics, "eva")
    pulses = []
    for fraction in np.concatenate([np.linspace(0.0, 1.0, 100), np.ones(200)]):
        physics.move_human("eva", with_right_hand(spec, 0.0, 0.15 * fraction, 0.0))
        physics.step()
        touching = physics.hand("eva", "right").touching
        pulses += [(physics.tick, haptic, touching) for haptic in feedback.update()]
    ticks, haptics, touching = zip(*pulses, strict=True)
    assert all(touching)
    assert {(haptic.actor, haptic.hand) for haptic in haptics} == {("eva", "right")}
    assert haptics[0].onset
    assert haptics[0].amplitude >= 0.2
    assert sum(haptic.onset for haptic in haptics) <= 3
    last = haptics[-1]
    assert not last.onset
    assert last.amplitude == pytest.approx(np.linalg.norm(physics.hand("eva", "right").force) / 100.0, rel=0.05)
    assert np.diff(ticks).min() >= 2
    assert last.duration == pytest.approx(0.05)


def test_a_free_hand_gives_no_haptic_pulse():
    physics, _, _, _ = human_at_bunch()
    feedback = HapticFeedback(physics, "eva")
    for _ in range(50):
        physics.step()
        assert feedback.update() == ()


def test_two_runs_are_bitwise_equal():
    def run() -> bytes:
        physics, spec, _, _ = human_at_bunch(0.8, pull=15.0)
        near = move(physics, spec, 0.0, 0.04, 0.0, ticks=30)
        move(physics, near, 0.0, -0.3, -0.2, ticks=100, closed=True)
        data = physics.rigid.mj_data
        return data.qpos.tobytes() + data.qvel.tobytes() + physics.state.joint_q.tobytes()

    assert run() == run()
