"""Grippers hold by friction; cutters cut what is between their blades."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.contact_scenes import bunch_scene
from tests.support.robot_yard import Yard, hand_of, wrench_of
from vinesim.core import frames
from vinesim.rigid.free_bunch import FreeBunch
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.world import Physics


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


@pytest.fixture
def yard(vinebot: RobotDescription) -> Yard:
    return Yard(vinebot)


def bunch_in_hand(description: RobotDescription, effort: float) -> tuple[Yard, int]:
    """A free round bunch of 0.3 kg between the fingers of the left hand, held with ``effort`` [N] each."""
    yard = Yard(description)
    yard.robot.command_gripper("gripper_left", 0.08)
    yard.run(0.5)
    middle = yard.robot.frame_pose("gripper_left_grasping_link")
    ball = FreeBunch(
        0.3, np.zeros(3), np.full(3, 1e-4), np.zeros(3), np.zeros((1, 3)), np.zeros((1, 3)), np.array([0.03])
    )
    yard.rigid.add_bunch(0, ball, middle, np.zeros(6))
    yard.robot.command_gripper("gripper_left", 0.0, effort)
    body = yard.rigid.mj_model.body("free_bunch/0").id
    weight = yard.rigid.mj_data.xfrc_applied[body]
    weight[2] = 0.3 * 9.81  # supports it until the fingers hold it
    yard.run(1.0)
    weight[:] = 0.0
    yard.run(1.0)
    return yard, body


def slip(yard: Yard, body: int, force: np.ndarray) -> float:
    """Displacement of a bunch in the hand [m] during one second of a pull."""

    def place() -> np.ndarray:
        hand = yard.robot.frame_pose("gripper_left_grasping_link")
        return frames.compose(frames.inverse(hand), yard.rigid.bunch_pose(0))[:3]

    before = place()
    yard.rigid.mj_data.xfrc_applied[body, :3] = force
    yard.run(1.0)
    return float(np.linalg.norm(place() - before))


def test_a_bunch_is_held_up_to_the_friction_limit(vinebot: RobotDescription) -> None:
    """Two pads of 15 N and mu 0.8 hold 24 N: with the weight of 2.9 N, 16 N more hold and 25 N more do not."""
    yard, body = bunch_in_hand(vinebot, 15.0)
    fingers = vinebot.joint_indices("gripper_left")
    squeeze = yard.rigid.joint_measurements("anna")[3][fingers]
    np.testing.assert_allclose(squeeze, 15.0, atol=0.3 * 9.81 * 0.2)  # the hand is tilted: part of the bunch's weight
    along = frames.rotate(yard.robot.frame_pose("gripper_left_grasping_link")[3:], np.array([0.0, 0.0, -1.0]))
    assert slip(yard, body, 16.0 * along) < 1e-3
    assert slip(yard, body, 25.0 * along) > 0.02


def test_the_wrist_carries_the_weight_of_a_held_bunch(vinebot: RobotDescription) -> None:
    yard, _ = bunch_in_hand(vinebot, 30.0)
    mass, _ = hand_of(vinebot)
    np.testing.assert_allclose(wrench_of(yard)[0], [0.0, 0.0, -9.81 * (mass + 0.3)], atol=0.05)


def test_invalid_gripper_commands_are_refused(yard: Yard) -> None:
    with pytest.raises(CommandError, match=r"no gripper 'claw'.*gripper_left"):
        yard.robot.command_gripper("claw", 0.1)
    with pytest.raises(CommandError, match="gripper effort -1"):
        yard.robot.command_gripper("gripper_left", 0.1, -1.0)
    with pytest.raises(CommandError, match="no cutter at 'gripper_left'; cutters fitted: none"):
        yard.robot.command_cutter("gripper_left")


def test_a_cutter_detaches_a_bunch_between_its_blades(vinebot: RobotDescription) -> None:
    """Beside the peduncle it cuts nothing, over it the bunch."""
    model, body, _ = bunch_scene()
    stalk = Physics(model).snapshot().body_q[body - 1, :3].astype(float)
    cutter = next(c for c in vinebot.cutters if c.group == "gripper_left")
    home = vinebot.link_poses(vinebot.home)[cutter.frame]
    ahead = np.array([cutter.half[0] - 0.005, 0.0, 0.0])  # in front of the blades' cover, not inside it
    blade_centre = frames.compose(home, frames.pose(np.array(cutter.origin) + ahead))[:3]
    physics = Physics(model)
    robot = Robot(physics.rigid, vinebot, "anna", pose=frames.pose(stalk - blade_centre + np.array([-0.1, 0.0, 0.0])))
    robot.fit_cutters(physics)

    def cut(group: str) -> tuple:
        robot.command_cutter(group)
        robot.control(physics.time)
        physics.step()
        return physics.detachments

    assert cut("gripper_left") == ()
    physics.rigid.place_robot("anna", frames.pose(stalk - blade_centre), vinebot.home)
    assert cut("gripper_right") == ()
    (detachment,) = cut("gripper_left")
    assert (detachment.bunch, detachment.cause, detachment.actor) == (0, "blade", "anna")
    robot.remove()
    assert physics.detachment_monitor.blades == []
    physics.step()
