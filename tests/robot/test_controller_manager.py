"""Controllers of a robot: one owner for each joint, goals that end with a reason, derived and given controllers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.control.controller_manager import ControllerManager, GoalResult
from vinesim.robot.control.gripper_controllers import GOAL_TOLERANCE, STALL_DURATION, STALL_SPEED
from vinesim.robot.control.trajectory_controller import Outcome, Trajectory
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.urdf import DescriptionError
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.scene.builder import assemble
from vinesim.scene.values import ControllerKind

ARM = tuple(f"arm_left_{i}_joint" for i in range(1, 8))


class ManagedRobot:
    """A vinebot whose joints obey a controller manager."""

    def __init__(self) -> None:
        self.rigid = RigidWorld(assemble([]))
        self.robot = Robot(self.rigid, load_description("vinebot"), "anna")
        self.manager = ControllerManager(self.robot)
        self.time = 0.0
        self.ended: dict[bytes, GoalResult] = {}

    def run(self, seconds: float, until: bytes | None = None) -> None:
        """Step for ``seconds``, or until a goal has ended."""
        for _ in range(round(seconds / self.rigid.dt)):
            self.manager(self.time)
            self.ended.update({result.goal: result for result in self.manager.take_results()})
            if until in self.ended:
                return
            self.robot.control(self.time)
            self.rigid.predict()
            self.rigid.integrate()
            self.time += self.rigid.dt

    def arm(self) -> np.ndarray:
        """Positions of the left arm's joints."""
        return self.rigid.joint_measurements("anna")[0][self.robot.joint_indices(ARM)]

    def swing(self, by: float, seconds: float = 1.0) -> Trajectory:
        """All joints of the left arm by so many rad."""
        return Trajectory(ARM, np.array([seconds]), self.arm()[None] + by)


def test_vinebot_has_the_controllers_of_a_ros2_control_robot() -> None:
    specs = {spec.name: spec for spec in load_description("vinebot").controllers}
    assert {name for name, spec in specs.items() if spec.kind is ControllerKind.JOINT_TRAJECTORY} == {
        "arm_left_controller",
        "arm_right_controller",
        "torso_controller",
        "head_controller",
    }
    assert {name for name, spec in specs.items() if spec.gripper == "fingers"} == {
        "gripper_left_controller",
        "gripper_right_controller",
    }
    assert specs["cutter_left_controller"].group == "gripper_left"
    assert specs["arm_left_impedance_controller"].joints == ARM
    assert specs["forward_velocity_controller"].joints == load_description("vinebot").joints


def test_each_joint_obeys_one_controller() -> None:
    """A forward command to one joint of the arm ends the arm's goal; a trajectory takes the joint back."""
    managed = ManagedRobot()
    managed.manager.start_trajectory("arm_left_controller", managed.swing(0.3), 0.0, b"first")
    managed.run(0.3)
    command = np.full(len(managed.robot.setpoint), np.nan)
    shoulder = managed.robot.joint_indices([ARM[0]])[0]
    command[shoulder] = 0.0
    managed.manager.forward("forward_position_controller", command)
    managed.run(0.1)
    assert managed.ended[b"first"].outcome is Outcome.PREEMPTED
    assert "forward_position_controller took over" in managed.ended[b"first"].text
    managed.run(1.0)
    assert abs(managed.arm()[0]) < 1e-3
    goal = managed.swing(-0.2)
    managed.manager.start_trajectory("arm_left_controller", goal, managed.time, b"second")
    managed.run(3.0, until=b"second")
    assert managed.ended[b"second"].outcome is Outcome.SUCCESSFUL
    np.testing.assert_allclose(managed.arm(), goal.positions[0], atol=5e-3)


def test_a_newer_goal_ends_the_older_and_cancelling_holds() -> None:
    managed = ManagedRobot()
    managed.manager.start_trajectory("arm_left_controller", managed.swing(0.3), 0.0, b"a")
    managed.run(0.2)
    managed.manager.start_trajectory("arm_left_controller", managed.swing(-0.3), managed.time, b"b")
    managed.run(0.3)
    assert managed.ended.keys() == {b"a"}
    assert managed.ended[b"a"].outcome is Outcome.PREEMPTED
    managed.manager.cancel(b"b", managed.time)
    managed.run(0.5)
    assert managed.ended[b"b"].outcome is Outcome.CANCELED
    here = managed.arm()
    managed.run(0.5)
    np.testing.assert_allclose(managed.arm(), here, atol=2e-3)
    managed.manager.cancel(b"b", managed.time)  # it has ended: nothing happens
    managed.run(0.1)
    assert len(managed.ended) == 2


@pytest.mark.parametrize("how", ["cancel", "stop"])
def test_after_a_trajectory_was_stopped_the_desired_state_is_that_the_joints_hold(how) -> None:
    managed = ManagedRobot()
    manager = managed.manager
    joints = managed.robot.joint_indices(ARM)
    manager.start_trajectory("arm_left_controller", managed.swing(0.3), managed.time, b"a")
    managed.run(0.5)
    assert (manager.desired_velocity[joints] > 0.1).all()
    if how == "cancel":
        manager.cancel(b"a", managed.time)
    else:
        manager.stop_trajectory("arm_left_controller")
    managed.run(1.0)
    assert not manager.desired_velocity.any()
    np.testing.assert_allclose(manager.desired[joints], managed.arm(), atol=1e-4)


def test_a_gripper_reaches_its_goal_or_stalls() -> None:
    """Empty fingers close to where they are asked; behind a stop of the joint's limit they stall."""
    managed = ManagedRobot()
    managed.manager.start_gripper("gripper_left_controller", 0.02, None, 0.0, b"close")
    managed.run(5.0, until=b"close")
    closed = managed.ended[b"close"].gripper
    assert closed is not None
    assert closed.reached_goal
    assert not closed.stalled
    assert abs(managed.robot.gripper_opening("gripper_left") - 0.02) < 3e-3
    managed.manager.start_gripper("gripper_left_controller", 0.5, None, managed.time, b"too far")
    managed.run(5.0, until=b"too far")
    opened = managed.ended[b"too far"].gripper
    assert opened is not None
    assert opened.stalled
    assert not opened.reached_goal


def test_a_gripper_that_passes_its_goal_has_not_reached_it() -> None:
    """Fingers that open fast get a goal just ahead of them: it counts when they stand still there, not before."""
    managed = ManagedRobot()
    robot = managed.robot
    fingers = robot.description.joint_indices("gripper_left")
    managed.manager.start_gripper("gripper_left_controller", 0.0, None, 0.0, b"close")
    managed.run(5.0, until=b"close")
    managed.manager.start_gripper("gripper_left_controller", 0.08, None, managed.time, b"open")
    before = robot.gripper_opening("gripper_left")
    managed.run(0.3)
    speed = np.abs(managed.rigid.joint_measurements("anna")[1][fingers]).max()
    assert robot.gripper_opening("gripper_left") > before
    assert speed > 10.0 * STALL_SPEED
    here = robot.gripper_opening("gripper_left")
    managed.manager.start_gripper("gripper_left_controller", here, None, managed.time, b"here")
    managed.run(0.02)
    assert b"here" not in managed.ended
    managed.run(5.0, until=b"here")
    reached = managed.ended[b"here"].gripper
    assert reached is not None
    assert reached.reached_goal
    assert abs(reached.position - here) <= GOAL_TOLERANCE
    assert np.abs(managed.rigid.joint_measurements("anna")[1][fingers]).max() <= STALL_SPEED


def test_a_gripper_stalls_after_the_stall_timeout() -> None:
    managed = ManagedRobot()
    managed.manager.start_gripper("gripper_left_controller", 0.5, None, 0.0, b"a")
    managed.run(8.0, until=b"a")
    managed.manager.start_gripper("gripper_left_controller", 0.5, None, managed.time, b"b")  # it cannot move on
    began = managed.time
    managed.run(8.0, until=b"b")
    assert managed.ended[b"b"].gripper.stalled
    assert managed.time - began == pytest.approx(STALL_DURATION, abs=0.03)


@pytest.mark.parametrize(
    ("trajectory", "words"),
    [
        (lambda managed: managed.swing(9.0), "point 0 moves arm_left_1_joint to"),
        (
            lambda managed: dataclasses.replace(managed.swing(0.1), start_time=1.76e9),
            "s from now; stamp it with the time of /clock",
        ),
    ],
)
def test_a_trajectory_that_cannot_be_followed_ends_with_the_reason(trajectory, words) -> None:
    """Beyond a joint's limit, or with the stamp of another clock: INVALID_GOAL at once, and the joints stay."""
    managed = ManagedRobot()
    before = managed.arm()
    managed.manager.start_trajectory("arm_left_controller", trajectory(managed), 0.0, b"a")
    managed.run(0.1)
    assert managed.ended[b"a"].outcome is Outcome.INVALID_GOAL
    assert words in managed.ended[b"a"].text
    np.testing.assert_allclose(managed.arm(), before, atol=1e-3)


def test_impedance_and_motor_commands() -> None:
    """A softer joint is set, a wrong number of gains refused; a motor's position needs its own joint."""
    managed = ManagedRobot()
    name = "arm_left_impedance_controller"
    managed.manager.command_impedance(name, "stiffness", np.full(7, 300.0))
    with pytest.raises(CommandError, match="below zero"):
        managed.manager.command_impedance(name, "damping", np.full(7, -1.0))
    with pytest.raises(CommandError, match="values for"):
        managed.manager.command_impedance(name, "equilibrium", np.zeros(3))
    with pytest.raises(CommandError, match="see of anna does not move 'head_1_joint'"):
        managed.manager.command_motor("see", "head_1_joint", 0.0)
    managed.manager.command_motor("see", ARM[0], 0.1)


def test_what_a_robot_lacks_is_said_with_what_it_has() -> None:
    managed = ManagedRobot()
    with pytest.raises(CommandError, match=r"no gripper controller 'hand'; there are: .*gripper_left_controller"):
        managed.manager.start_gripper("hand", 0.0, None, 0.0, b"x")
    with pytest.raises(CommandError, match="no forward controller 'arm_left_controller'"):
        managed.manager.forward("arm_left_controller", np.zeros(7))


URDF = """<robot name="small"><link name="base"><inertial><mass value="5"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<link name="a"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<link name="b"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="one" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="10" velocity="1"/></joint>
<joint name="two" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="10" velocity="1"/></joint>
<ros2_control name="arm" type="system"><joint name="one"><command_interface name="position"/></joint>
<joint name="two"><command_interface name="velocity"/></joint></ros2_control></robot>"""


def test_ros2_control_tags_say_what_may_be_commanded(tmp_path) -> None:
    file = tmp_path / "small.urdf"
    file.write_text(URDF)
    specs = {spec.kind: spec for spec in load_description(file).controllers}
    assert specs[ControllerKind.FORWARD_POSITION].joints == ("one",)
    assert specs[ControllerKind.FORWARD_VELOCITY].joints == ("two",)
    assert ControllerKind.FORWARD_EFFORT not in specs


def test_controllers_of_a_toml_file_replace_the_derived_ones(tmp_path) -> None:
    file = tmp_path / "small.urdf"
    file.write_text(URDF.replace('"velocity"/>', '"velocity"/><command_interface name="position"/>'))
    file.with_suffix(".toml").write_text('[controllers.my_arm]\nkind = "joint_trajectory"\njoints = ["two", "one"]\n')
    (spec,) = load_description(file).controllers
    assert (spec.name, spec.joints) == ("my_arm", ("two", "one"))
    file.with_suffix(".toml").write_text('[controllers.my_arm]\nkind = "joint_trajectory"\njoints = ["three"]\n')
    with pytest.raises(DescriptionError, match="controller 'my_arm' moves 'three'; name driven joints only"):
        load_description(file)
