"""Grippers hold by friction; cutters cut what is between their blades."""

from __future__ import annotations

import pathlib

import numpy as np
import pytest

from tests.support.contact_scenes import bunch_scene
from tests.support.robot_yard import Yard, hand_of, wrench_of
from vinesim.core import frames
from vinesim.rigid.free_bunch import FreeBunch
from vinesim.robot.control.controller_manager import ControllerManager
from vinesim.robot.control.gripper_controllers import CONTROLLERS
from vinesim.robot.control.trajectory_controller import Outcome
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.grippers import GRIPPER_KINDS
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.urdf import DescriptionError
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.scene.values import FORWARD_KINDS, ControllerKind
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

    def cut(group: str, beside: float) -> tuple[Physics, Robot, tuple]:
        physics = Physics(model)
        place = frames.pose(stalk - blade_centre + np.array([-beside, 0.0, 0.0]))
        robot = Robot(physics.rigid, vinebot, "anna", pose=place)
        robot.fit_cutters(physics)
        robot.command_cutter(group)
        detachments = []
        for _ in range(20):  # 40 mm with 0.2 m/s
            robot.control(physics.time)
            physics.step()
            detachments += physics.detachments
        assert [blade.closures for blade in robot.cutter_blades(group)] == [1]
        return physics, robot, tuple(detachments)

    assert cut("gripper_left", 0.1)[2] == ()
    assert cut("gripper_right", 0.0)[2] == ()
    physics, robot, (detachment,) = cut("gripper_left", 0.0)
    assert (detachment.bunch, detachment.cause, detachment.actor) == (0, "blade", "anna")
    robot.remove()
    assert physics.detachment_monitor.blades == []
    physics.step()


# ---------------------------------------------------------------------- what is a gripper

BODY = """<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>"""
JAW = """<joint name="{name}_joint" type="prismatic"><parent link="base"/><child link="{name}"/><axis xyz="0 1 0"/>
<limit lower="0" upper="0.05" effort="10" velocity="1"/></joint><link name="{name}">{body}</link>"""
CLAW = f"""<robot name="small"><link name="base">{BODY}</link>
{JAW.format(name="upper", body=BODY)}{JAW.format(name="lower", body=BODY)}</robot>"""
GROUP = '[groups.{}]\njoints = ["upper_joint", "lower_joint"]\n'


def load(folder: pathlib.Path, toml: str) -> RobotDescription:
    """A robot with two joints that slide from one link, and this TOML file."""
    file = folder / "small.urdf"
    file.write_text(CLAW)
    file.with_suffix(".toml").write_text(toml)
    return load_description(file)


def kinds(description: RobotDescription) -> dict[str, tuple[ControllerKind, str]]:
    """Kind of each controller that does not pass commands on, and of its gripper, by name."""
    return {spec.name: (spec.kind, spec.gripper) for spec in description.controllers if spec.kind not in FORWARD_KINDS}


def test_each_kind_of_gripper_has_a_controller() -> None:
    assert CONTROLLERS.keys() == GRIPPER_KINDS.keys()


def test_groups_called_gripper_or_hand_are_fingers_if_the_file_does_not_list_grippers(tmp_path: pathlib.Path) -> None:
    fingers = (ControllerKind.GRIPPER, "fingers")
    assert kinds(load(tmp_path, GROUP.format("gripper_left"))) == {"gripper_left_controller": fingers}
    assert kinds(load(tmp_path, GROUP.format("my_hand"))) == {"my_hand_controller": fingers}
    none = load(tmp_path, "grippers = []\n" + GROUP.format("my_hand"))
    assert kinds(none) == {"my_hand_controller": (ControllerKind.JOINT_TRAJECTORY, "")}


def test_a_group_that_looks_like_fingers_gets_a_warning_until_the_file_says_what_it_is(
    tmp_path: pathlib.Path, caplog: pytest.LogCaptureFixture
) -> None:
    trajectory = (ControllerKind.JOINT_TRAJECTORY, "")
    claw = load(tmp_path, GROUP.format("claw"))
    assert kinds(claw) == {"claw_controller": trajectory}
    (warning,) = [record.getMessage() for record in caplog.records if "no gripper" in record.getMessage()]
    assert "group 'claw' is no gripper" in warning
    assert '[[grippers]] kind = "fingers", group = "claw"' in warning
    caplog.clear()
    listed = load(tmp_path, GROUP.format("claw") + '[[grippers]]\nkind = "fingers"\ngroup = "claw"\n')
    assert kinds(listed) == {"claw_controller": (ControllerKind.GRIPPER, "fingers")}
    assert kinds(load(tmp_path, "grippers = []\n" + GROUP.format("claw"))) == {"claw_controller": trajectory}
    assert not [record for record in caplog.records if "no gripper" in record.getMessage()]


def test_cutters_may_be_listed_among_the_grippers_or_by_themselves(tmp_path: pathlib.Path) -> None:
    cutter = 'group = "claw"\nframe = "base"\nhalf = [0.02, 0.02, 0.004]\n'
    alone = load(tmp_path, GROUP.format("claw") + "[[cutters]]\n" + cutter)
    fingers = '[[grippers]]\nkind = "fingers"\ngroup = "claw"\n'
    listed = load(tmp_path, GROUP.format("claw") + fingers + '[[grippers]]\nkind = "cutter"\n' + cutter)
    assert alone.grippers == listed.grippers
    assert alone.controllers == listed.controllers
    assert kinds(alone)["claw_cutter_controller"] == (ControllerKind.GRIPPER, "cutter")


def test_controllers_of_a_toml_file_name_kinds_of_grippers(tmp_path: pathlib.Path) -> None:
    named = '[controllers.{}]\nkind = "{}"\ngroup = "claw"\n'
    toml = "grippers = []\n" + GROUP.format("claw") + named.format("shut", "gripper")
    assert kinds(load(tmp_path, toml)) == {"shut": (ControllerKind.GRIPPER, "fingers")}
    with pytest.raises(DescriptionError, match=r"small\.toml: controller 'cut': no cutter at 'claw'; name its group"):
        load(tmp_path, GROUP.format("claw") + named.format("cut", "cutter"))
    with pytest.raises(DescriptionError, match=r"controller 'x' has the kind 'magnet'; give one of cutter, fingers, "):
        load(tmp_path, GROUP.format("claw") + named.format("x", "magnet"))


def test_a_cutter_that_is_not_fitted_ends_its_goal(vinebot: RobotDescription) -> None:
    manager = ControllerManager(Yard(vinebot).robot)
    manager.start_gripper("cutter_left_controller", 0.0, None, 0.0, b"cut")
    (result,) = manager.take_results()
    assert result.outcome is Outcome.INVALID_GOAL
    assert "no cutter at 'gripper_left'; cutters fitted: none" in result.text
