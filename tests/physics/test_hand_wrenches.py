"""Wrenches of hands on robots, and robots under such wrenches of remote hands."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.physics.test_human_body import eva, put, soft_arm
from tests.physics.test_rigid_world import HOME, arm, step, yard
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.rigid.urdf import RobotError


def pushing() -> RigidWorld:
    """A human pushes the soft arm slowly by 0.1 m and stays."""
    rigid, spec = soft_arm()
    for x in np.linspace(-0.4, 0.1, 200):
        rigid.move_human("eva", put(spec.pose, (x, 0.0, 1.1)))
        step(rigid)
    step(rigid, 300)
    return rigid


def test_a_push_is_the_hands_force_and_joint_contact_is_its_jacobian_transpose():
    rigid = pushing()
    wrenches, (left, right) = rigid.hand_wrenches("eva")
    assert (left, right) == (False, True)
    (link,) = wrenches["probe"]
    wrench = wrenches["probe"][link]
    np.testing.assert_allclose(wrench[:3], rigid.hand_sample("eva", "right").force, atol=1e-6)
    body = rigid.mj_model.body(f"probe/{link}").id
    jacobian = rigid.jacobian("probe", link, rigid.mj_data.xipos[body])
    np.testing.assert_allclose(jacobian.T @ wrench, rigid.joint_measurements("probe")[3], atol=1e-6)


def test_the_wrench_of_a_hand_has_the_effect_of_the_hand():
    """F05 in one world: position, effort and contact are the same under the hand and under its wrench alone."""
    touched = pushing()
    wrenches, _ = touched.hand_wrenches("eva")
    rigid, spec = soft_arm()
    rigid.move_human("eva", spec.pose)
    rigid.set_remote_wrenches("probe", wrenches["probe"])
    step(rigid, 600)
    for first, other in zip(rigid.joint_measurements("probe"), touched.joint_measurements("probe"), strict=True):
        np.testing.assert_allclose(first, other, atol=2e-3 * max(1.0, np.abs(other).max()))
    rigid.set_remote_wrenches("probe", {})
    step(rigid, 300)
    assert abs(rigid.joint_measurements("probe")[0][0]) < 1e-4
    assert (rigid.joint_measurements("probe")[3] == 0.0).all()
    assert not rigid.mj_data.xfrc_applied.any()
    with pytest.raises(RobotError, match="which is not one of its links"):
        rigid.set_remote_wrenches("probe", {"tail": np.zeros(6)})


def test_remote_wrenches_persist_through_a_compilation():
    rigid = RigidWorld(yard())
    rigid.add_robot(arm("early", y=3.0))
    rigid.add_robot(arm())
    rigid.set_remote_wrenches("anna", {"lower": np.array([0.0, 0.0, -30.0, 0.0, 0.0, 0.0])})
    step(rigid, 300)
    before = rigid.joint_measurements("anna")[3].copy()
    assert before[0] > 10.0
    rigid.remove_robot("early")
    step(rigid, 50)
    np.testing.assert_allclose(rigid.joint_measurements("anna")[3], before, rtol=1e-3)


def test_a_hand_that_holds_a_link_reports_its_wrench():
    """Held by the weld, 0.1 m sideways: the spring's force, and its moment about the link's centre of mass."""
    rigid, spec = soft_arm()
    for x in np.linspace(-0.4, -0.14, 100):
        rigid.move_human("eva", put(spec.pose, (x, 0.0, 1.1)))
        step(rigid)
    nearest = rigid.nearest_to_hand("eva", "right", 0.1)
    assert nearest is not None
    rigid.grasp("eva", "right", nearest[1], nearest[2])
    for y in np.linspace(0.0, 0.1, 100):
        rigid.move_human("eva", put(spec.pose, (-0.2, y, 1.1)))
        step(rigid)
    step(rigid, 300)
    wrenches, is_holding = rigid.hand_wrenches("eva")
    assert is_holding == (False, True)
    wrench = wrenches["probe"][nearest[2]]
    hand = rigid.hand_sample("eva", "right")
    np.testing.assert_allclose(wrench[:3], hand.force, atol=1e-9)
    assert np.linalg.norm(hand.force) > 2.0
    np.testing.assert_allclose(hand.force, 100.0 * (hand.controller - hand.pose)[:3], rtol=0.02, atol=0.05)
    body = rigid.mj_model.body(f"probe/{nearest[2]}").id
    jacobian = rigid.jacobian("probe", nearest[2], rigid.mj_data.xipos[body])
    np.testing.assert_allclose(
        jacobian.T @ wrench, rigid.gravity_effort("probe") - rigid.joint_measurements("probe")[2], atol=0.05
    )


# ---------------------------------------------------------------------- remote humans


def test_hands_of_a_remote_human_touch_no_robot_and_hold_nothing():
    rigid = RigidWorld(yard())
    spec = eva(-1.0)
    rigid.add_robot(arm())
    rigid.add_human(spec, is_remote=True)
    for x in np.linspace(-0.6, 0.0, 100):
        pose = put(spec.pose, (x, 0.0, 0.3))
        rigid.move_human("eva", dataclasses.replace(pose, right_closed=True))
        step(rigid)
    step(rigid, 50)
    hand = rigid.hand_sample("eva", "right")
    np.testing.assert_allclose(hand.pose, hand.controller, atol=1e-6)  # inside the chassis
    assert (hand.touching, hand.held) == (False, None)
    np.testing.assert_array_equal(rigid.joint_measurements("anna")[3], 0.0)
    np.testing.assert_allclose(rigid.joint_measurements("anna")[0], HOME, atol=1e-3)


def test_legs_of_a_remote_human_stop_a_base():
    """F27 on the robot's client: contact with legs is computed there, against the remote human."""
    rigid = RigidWorld(yard())
    spec = eva(1.0, heading=np.pi)
    rigid.add_robot(arm(heading=np.pi))
    rigid.add_human(spec, is_remote=True)
    rigid.command_base("anna", (-0.5, 0.0, 0.0))
    step(rigid, 500)
    assert rigid.base_state("anna")[0][0] == pytest.approx(1.0 - 0.05 - 0.3, abs=2e-3)


@pytest.mark.parametrize("busy", [False, True])
def test_a_remote_hand_pushes_objects_unless_it_is_busy(busy):
    rigid = RigidWorld(yard(boxes=1))
    spec = eva(0.0, 4.0, heading=np.pi / 2)
    rigid.add_human(spec, is_remote=True)
    generation = rigid.generation
    for y in np.linspace(4.3, 5.0, 100):
        pose = put(spec.pose, (0.0, y, 0.2))
        rigid.move_human("eva", dataclasses.replace(pose, right_busy=busy))
        step(rigid)
    if not busy:
        assert rigid.mj_data.joint("box/0").qpos[1] > 5.05
        return
    assert rigid.mj_data.joint("box/0").qpos[1] == pytest.approx(5.0, abs=1e-3)
    assert rigid.generation == generation + 1, "compiled once, not every tick"
    np.testing.assert_allclose(rigid.hand_sample("eva", "right").pose, pose.right, atol=1e-3)
    rigid.add_robot(arm(x=8.0))
    step(rigid, 20)
    assert rigid.mj_data.joint("box/0").qpos[1] == pytest.approx(5.0, abs=1e-3), "it persists through a compilation"


def test_a_local_and_a_remote_hand_push_each_other():
    """F14 between clients: each side has its own hand and the remote controller of the other."""
    rigid = RigidWorld(yard())
    local = eva(-1.0)
    remote = eva(1.0, name="ida", heading=np.pi)
    rigid.add_human(local)
    rigid.add_human(remote, is_remote=True)
    for x in np.linspace(-0.4, 0.0, 150):
        rigid.move_human("eva", put(local.pose, (x, 0.0, 1.1)))
        rigid.move_human("ida", put(remote.pose, (-x, 0.0, 1.1)))
        step(rigid)
    step(rigid, 200)
    force = rigid.hand_sample("eva", "right").force[0]
    assert force > 5.0
    assert rigid.hand_sample("ida", "right").force[0] == pytest.approx(-force, rel=1e-3)
