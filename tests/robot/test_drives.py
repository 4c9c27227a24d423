"""Drives: commands become motion within the URDF's limits, and samples agree with the rigid world."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from tests.support.contact_scenes import bunch_scene
from tests.support.robot_yard import Yard
from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError, CommandInterface
from vinesim.robot.drives.robot_instance import RemoteRobot
from vinesim.scene.builder import assemble
from vinesim.scene.values import Contact, RobotUpdate
from vinesim.world import Physics


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


@pytest.fixture
def yard(vinebot: RobotDescription) -> Yard:
    return Yard(vinebot)


def test_home_is_held_without_sag(yard: Yard, vinebot: RobotDescription) -> None:
    position = yard.run(0.5)[-1, 0]
    np.testing.assert_allclose(position, vinebot.home, atol=1e-9)


def test_step_command_ramps_at_the_speed_limit(yard: Yard) -> None:
    joint = yard.robot.joint_indices(["arm_left_4_joint"])[0]
    limit = yard.robot.max_velocity[joint]
    start = yard.robot.setpoint[joint]
    yard.robot.command_position([start - 1.1], ["arm_left_4_joint"])
    position, velocity, _, setpoint = yard.run(1.0)[:, :, joint].T
    steps = np.abs(np.diff(setpoint, prepend=start))
    assert steps.max() <= limit * yard.rigid.dt * (1.0 + 1e-9)
    assert np.abs(velocity).max() <= limit * 1.02, "faster than the URDF allows"
    cruise = slice(15, 45)
    np.testing.assert_allclose(velocity[cruise], -limit, rtol=0.02)
    arrived = np.flatnonzero(np.abs(setpoint - (start - 1.1)) < 1e-9)[0] * yard.rigid.dt
    assert arrived == pytest.approx(1.1 / limit, abs=0.03)
    assert position[-1] == pytest.approx(start - 1.1, abs=1e-3)
    assert position.min() > start - 1.1 - 0.025, "overshoot"


def test_smooth_commands_are_tracked(yard: Yard) -> None:
    joints = yard.robot.joint_indices(["arm_left_1_joint", "arm_left_4_joint", "arm_left_6_joint", "head_1_joint"])
    start = yard.robot.setpoint[joints].copy()
    worst = 0.0
    for _ in range(300):
        desired = start + 0.3 * (1.0 - np.cos(2.0 * np.pi * 0.4 * yard.time)) * np.array([1, -1, 1, -1])
        yard.robot.command_position(desired, joints)
        position = yard.run(yard.rigid.dt)[-1, 0, joints]
        worst = max(worst, np.abs(position - desired).max())
    assert worst < 5e-3


def test_commands_beyond_a_limit_go_to_the_limit(yard: Yard) -> None:
    yard.robot.command_position([9.0, -9.0], ["head_1_joint", "head_2_joint"])
    position = yard.run(1.5)[-1, 0]
    i = yard.robot.joint_indices(["head_1_joint", "head_2_joint"])
    np.testing.assert_allclose(position[i], [1.3, -1.05], atol=2e-3)


def test_velocity_command_moves_and_ends_at_the_limit(yard: Yard) -> None:
    joint = yard.robot.joint_indices(["arm_right_2_joint"])[0]
    yard.robot.command_velocity([0.5], ["arm_right_2_joint"])
    rows = yard.run(1.0)
    np.testing.assert_allclose(rows[30:, 1, joint], 0.5, rtol=0.02)
    yard.robot.command_velocity([50.0], ["arm_right_2_joint"])
    rows = yard.run(2.0)
    assert np.abs(np.diff(rows[:, 3, joint])).max() <= yard.robot.max_velocity[joint] * yard.rigid.dt * (1.0 + 1e-9)
    assert rows[-1, 0, joint] == pytest.approx(yard.robot.upper_limit[joint], abs=2e-3)


def test_effort_command_is_the_effort_at_rest(yard: Yard) -> None:
    """The head pans about the vertical: no weight. Against its end stop it transmits the commanded effort."""
    joint = yard.robot.joint_indices(["head_1_joint"])[0]
    yard.robot.command_effort([2.0], ["head_1_joint"])
    rows = yard.run(3.0)
    assert rows[-1, 0, joint] == pytest.approx(yard.robot.upper_limit[joint], abs=0.02)
    assert rows[-1, 2, joint] == pytest.approx(2.0, rel=0.01)
    yard.robot.command_effort([100.0], ["head_1_joint"])
    assert yard.run(1.0)[-1, 2, joint] == pytest.approx(yard.robot.max_effort[joint], rel=0.01)


def test_effort_command_gives_newtons_acceleration(yard: Yard) -> None:
    """Lift: 10 N beyond the weight on what it carries, its screw, and the URDF's friction of 50 N s/m."""
    joint = yard.robot.joint_indices(["torso_lift_joint"])[0]
    urdf = ElementTree.fromstring(yard.robot.description.urdf)
    below = ("base", "torso_fixed")
    masses = {link.get("name"): link.find("inertial/mass") for link in urdf.findall("link")}
    carried = sum(float(m.get("value")) for name, m in masses.items() if m is not None and not name.startswith(below))
    yard.robot.command_effort([10.0], ["torso_lift_joint"])
    velocity = np.concatenate([[0.0], yard.run(0.8)[:, 1, joint]])
    acceleration = np.diff(velocity) / yard.rigid.dt
    expected = (10.0 - 50.0 * velocity[1:]) / (carried + yard.robot.description.drives[joint].armature)
    assert 0.04 < velocity[-1] < 0.15
    np.testing.assert_allclose(acceleration[5:], expected[5:], rtol=0.02)  # before that the arms settle in their joints


def test_a_joint_moves_under_force_with_zero_effort_and_not_with_position_control(yard: Yard) -> None:
    joint = yard.robot.joint_indices(["arm_left_1_joint"])[0]
    start = yard.run(0.2)[-1, 0, joint]
    yard.rigid.apply_wrench("anna", "arm_left_7_link", np.array([0.0, 0.0, 20.0]))
    assert abs(yard.run(1.0)[-1, 0, joint] - start) < 0.01
    yard.robot.command_effort([0.0], ["arm_left_1_joint"])
    assert abs(yard.run(1.0)[-1, 0, joint] - start) > 0.2


def test_impedance_deflects_by_force_over_stiffness(yard: Yard) -> None:
    """Oracle: k times deflection is J^T f of a known push (D6.4 section 3.1: compliance by stiffness gains)."""
    joint = yard.robot.joint_indices(["arm_left_4_joint"])[0]
    start = yard.run(0.1)[-1, 0, joint]
    yard.robot.command_impedance([60.0], [12.0], ["arm_left_4_joint"])
    force = np.array([0.0, 0.0, -12.0])
    yard.rigid.apply_wrench("anna", "arm_left_7_link", force)
    rows = yard.run(4.0)
    body = yard.rigid.mj_model.body("anna/arm_left_7_link").id
    jacobian = yard.rigid.jacobian("anna", "arm_left_7_link", yard.rigid.mj_data.xipos[body])[:3, joint]
    assert abs(rows[-1, 0, joint] - start) > 0.03
    assert 60.0 * (rows[-1, 0, joint] - start) == pytest.approx(jacobian @ force, rel=0.01)
    with pytest.raises(CommandError, match="below zero"):
        yard.robot.command_impedance([-1.0], [1.0], ["arm_left_4_joint"])


def test_gains_persist_when_another_robot_joins(yard: Yard, vinebot: RobotDescription) -> None:
    yard.robot.command_effort([0.0], ["arm_left_1_joint"])
    yard.run(0.02)
    Robot(yard.rigid, vinebot, "bert", 1, frames.pose([4.0, 0.0, 0.0]))
    joint = yard.robot.joint_indices(["arm_left_1_joint"])[0]
    start = yard.rigid.joint_measurements("anna")[0][joint]
    yard.rigid.apply_wrench("anna", "arm_left_7_link", np.array([0.0, 0.0, 20.0]))
    assert abs(yard.run(1.0)[-1, 0, joint] - start) > 0.2


def test_overpowered_joints_yield_at_their_effort_limit_and_return_without_overshoot(yard: Yard) -> None:
    before = yard.run(0.2)[-1, 0]
    yard.rigid.apply_wrench("anna", "arm_left_4_link", np.array([900.0, 0.0, 0.0]))
    rows = yard.run(0.6)
    assert (np.abs(rows[:, 2]) <= yard.robot.max_effort * (1.0 + 1e-9)).all()
    joint = yard.robot.joint_indices(["arm_left_1_joint"])[0]
    yielded = rows[-1, 0, joint] - before[joint]
    assert abs(yielded) > 0.1
    yard.rigid.apply_wrench("anna", "arm_left_4_link", np.zeros(3))
    returned = yard.run(2.5)
    assert returned[-1, 0, joint] == pytest.approx(before[joint], abs=1e-3)
    beyond = (before[joint] - returned[:, 0, joint]) * np.sign(yielded)
    assert beyond.max() < 0.05, "overshoot"


def test_gripper_opens_by_the_given_width(yard: Yard) -> None:
    fingers = yard.robot.description.joint_indices("gripper_left")
    for opening in (0.0, 0.1):
        yard.robot.command_gripper("gripper_left", opening)
        assert yard.run(1.2)[-1, 0, fingers].sum() == pytest.approx(opening, abs=1e-4)


def test_base_speeds_up_within_its_limits_and_stops_without_commands(yard: Yard) -> None:
    limits = yard.robot.description.base_limits
    yard.robot.command_base(0.5, 0.4, yard.time)
    speeds = []
    turns = []
    for _ in range(200):
        yard.run(yard.rigid.dt)
        _, velocity = yard.rigid.base_state("anna")
        speeds.append(np.hypot(velocity[0], velocity[1]))
        turns.append(velocity[5])
    speeds = np.array(speeds)
    commanded = 0.5 / limits.linear_acceleration
    assert speeds[5] < 0.15, "faster than its acceleration limit"
    assert speeds[48] == pytest.approx(0.5, abs=0.05)
    assert turns[48] == pytest.approx(0.4, abs=0.02)
    stopped = round((limits.timeout + commanded + 0.4) / yard.rigid.dt)
    assert speeds[stopped:].max() < 0.03
    assert np.abs(turns[stopped:]).max() < 0.01
    yard.robot.command_base(9.0, 9.0, yard.time)
    yard.run(0.45)
    assert np.linalg.norm(yard.rigid.base_state("anna")[1][:2]) < limits.linear * 1.1


def test_samples_agree_with_the_rigid_world(vinebot: RobotDescription) -> None:
    """Oracle: MuJoCo's kinematics of every moving link; odometry: the pose relative to the start."""
    start = frames.pose([3.0, -2.0, 0.0], frames.from_yaw(2.0))
    yard = Yard(vinebot, start)
    first = yard.robot.sample(0.0)
    np.testing.assert_allclose(first.odom_q, frames.pose([0.0, 0.0, 0.0]), atol=1e-12)
    yard.robot.command_position(vinebot.home + 0.05)
    for _ in range(60):
        yard.robot.command_base(0.4, 0.3, yard.time)
        yard.run(yard.rigid.dt)
    sample = yard.robot.sample(yard.time)
    assert sample.transforms is first.transforms
    assert sample.joints.names == vinebot.joints
    for (parent, child), pose in zip(sample.transforms, sample.transform_q, strict=True):
        expected = yard.robot.frame_pose(child)
        composed = frames.compose(yard.robot.frame_pose(parent), pose)
        np.testing.assert_allclose(composed[:3], expected[:3], atol=1e-9)
        assert abs(composed[3:] @ expected[3:]) == pytest.approx(1.0, abs=1e-9)
    for (parent, child), pose in zip(vinebot.fixed_frames, vinebot.fixed_poses, strict=True):
        composed = frames.compose(yard.robot.frame_pose(parent), pose)
        np.testing.assert_allclose(composed[:3], yard.robot.frame_pose(child)[:3], atol=1e-9)
    np.testing.assert_allclose(frames.compose(start, sample.odom_q), sample.base_q, atol=1e-9)
    np.testing.assert_allclose(yard.robot.frame_pose("base_footprint"), sample.base_q, atol=1e-9)
    assert np.linalg.norm(sample.odom_q[:3]) > 0.05


def test_samples_keep_their_own_contacts(yard: Yard) -> None:
    own, other = (Contact(name, "link", 0, np.zeros(3), np.zeros(3), 0.0) for name in ("anna", "bert"))
    assert yard.robot.sample(0.0, (other, own)).contacts == (own,)


def test_two_runs_are_bitwise_equal(vinebot: RobotDescription) -> None:
    ends = []
    for _ in range(2):
        yard = Yard(vinebot)
        yard.robot.command_position(vinebot.home * 0.7)
        yard.robot.command_effort([3.0], ["head_1_joint"])
        yard.robot.command_base(0.3, -0.2, 0.0)
        ends.append(yard.run(1.0).tobytes())
    assert ends[0] == ends[1]


def test_stop_holds_the_current_pose(yard: Yard) -> None:
    yard.robot.command_velocity(0.3 * yard.robot.max_velocity)
    yard.robot.command_base(0.5, 0.0, yard.time)
    yard.run(0.3)
    yard.robot.stop()
    assert (yard.robot.interface == CommandInterface.POSITION).all()
    rows = yard.run(1.5)
    np.testing.assert_allclose(rows[-1, 1], 0.0, atol=1e-3)
    assert np.abs(yard.rigid.base_state("anna")[1]).max() < 0.02


def test_invalid_commands_are_refused(yard: Yard) -> None:
    with pytest.raises(CommandError, match=r"anna has no drive for 'arm_left_9_joint'.*arm_left_1_joint"):
        yard.robot.command_position([0.0], ["arm_left_9_joint"])
    with pytest.raises(CommandError, match="2 values for 1 joints"):
        yard.robot.command_position([0.0, 1.0], ["head_1_joint"])
    with pytest.raises(CommandError, match=r"'head_2_joint' is not finite"):
        yard.robot.command_effort([0.0, np.nan], ["head_1_joint", "head_2_joint"])
    with pytest.raises(CommandError, match="base velocity"):
        yard.robot.command_base(np.inf, 0.0, 0.0)


def test_a_remote_copy_follows_its_robot(vinebot: RobotDescription) -> None:
    local = Yard(vinebot)
    remote_world = RigidWorld(assemble([]))
    copy = RemoteRobot(remote_world, vinebot, "anna", pose=frames.pose([50.0, 0.0, -10.0]))
    home = vinebot.home.copy()
    reach = local.robot.joint_indices(["arm_left_1_joint", "arm_left_4_joint", "torso_lift_joint"])
    joints = []
    bases = []
    for tick in range(300):
        local.robot.command_position(home[reach] + 0.15 * np.sin(1.5 * local.time) * np.array([1, -1, 0.5]), reach)
        local.robot.command_base(0.3, 0.2, local.time)
        local.run(local.rigid.dt)
        copy.follow(local.robot.update(local.time))
        remote_world.predict()
        remote_world.integrate()
        if tick > 50:
            joints.append(
                np.abs(remote_world.joint_measurements("anna")[0] - local.rigid.joint_measurements("anna")[0]).max()
            )
            bases.append(np.linalg.norm(remote_world.base_state("anna")[0][:3] - local.rigid.base_state("anna")[0][:3]))
    assert max(joints) < 0.01
    assert max(bases) < 0.03
    assert copy.sample(0.0).base_q[2] == 0.0
    with pytest.raises(CommandError, match="same robot on both clients"):
        copy.follow(RobotUpdate("anna", 0.0, np.zeros(7), np.zeros(6), np.zeros(3), np.zeros(3)))


def test_robots_leave(yard: Yard, vinebot: RobotDescription) -> None:
    second = Robot(yard.rigid, vinebot, "bert", 1, frames.pose([4.0, 0.0, 0.0]))
    yard.run(0.05)
    second.remove()
    assert yard.rigid.robots == ("anna",)
    np.testing.assert_allclose(yard.run(0.05)[-1, 0], vinebot.home, atol=1e-9)


def test_a_robot_with_continuous_and_mimic_joints_moves(tmp_path) -> None:
    """Continuous joints have no limits; a mimicking finger follows through MuJoCo's equality."""
    inertial = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
    joints = """<joint name="spin_joint" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
        <limit effort="20" velocity="2"/></joint>
      <joint name="left_joint" type="prismatic"><parent link="arm"/><child link="left"/><axis xyz="0 1 0"/>
        <limit lower="0" upper="0.1" effort="50" velocity="0.1"/></joint>
      <joint name="right_joint" type="prismatic"><parent link="arm"/><child link="right"/><axis xyz="0 -1 0"/>
        <limit lower="0" upper="0.1" effort="50" velocity="0.1"/><mimic joint="left_joint" multiplier="0.5"/></joint>"""
    links = "".join(f'<link name="{name}">{inertial}</link>' for name in ("arm", "left", "right"))
    file = tmp_path / "foreign.urdf"
    file.write_text(f'<robot name="foreign"><link name="base">{inertial}</link>{links}{joints}</robot>')
    yard = Yard(load_description(file))
    yard.robot.command_position([7.0, 0.08])
    yard.run(5.0)
    sample = yard.robot.sample(yard.time)
    np.testing.assert_allclose(sample.joints.position, [7.0, 0.08], atol=2e-3)
    right = sample.transforms.index(("arm", "right"))
    np.testing.assert_allclose(sample.transform_q[right, :3], [0.0, -0.04, 0.0], atol=2e-3)
    offset = yard.robot.frame_pose("right")[:3] - yard.robot.frame_pose("arm")[:3]
    assert np.linalg.norm(offset) == pytest.approx(0.04, abs=2e-3)


# ---------------------------------------------------------------------- F83: three interfaces that track


@pytest.mark.parametrize("interface", ["position", "velocity", "effort"])
def test_each_interface_tracks_a_sine(vinebot: RobotDescription, interface: str) -> None:
    """0.3 rad at 0.4 Hz in shoulder and elbow; by effort a controller outside closes the loop at 100 Hz."""
    yard = Yard(vinebot)
    names = ["arm_left_1_joint", "arm_left_4_joint"]
    joints = yard.robot.joint_indices(names)
    start = yard.robot.setpoint[joints].copy()
    w = 2.0 * np.pi * 0.4
    worst = 0.0
    for _ in range(400):
        t = yard.time + yard.rigid.dt
        desired = start + 0.15 * (1.0 - np.cos(w * t)) * np.array([1, -1])
        rate = 0.15 * w * np.sin(w * t) * np.array([1, -1])
        position, velocity, _, _ = yard.rigid.joint_measurements("anna")
        if interface == "position":
            yard.robot.command_position(desired, names)
        elif interface == "velocity":
            yard.robot.command_velocity(rate, names)
        else:
            effort = 1500.0 * (desired - position[joints]) + 80.0 * (rate - velocity[joints])
            yard.robot.command_effort(effort, names)
        now = yard.run(yard.rigid.dt)[-1, 0, joints]
        worst = max(worst, np.abs(now - desired).max())
    assert worst < {"position": 2e-3, "velocity": 2e-3, "effort": 1e-2}[interface]


def test_switching_the_interface_at_the_current_state_causes_no_motion(yard: Yard) -> None:
    yard.robot.command_position(yard.robot.description.home * 0.8)
    yard.run(3.0)
    joints = yard.robot.joint_indices(None)
    for command in (
        lambda: yard.robot.command_velocity(np.zeros(len(joints))),
        lambda: yard.robot.command_motor_position(yard.robot.sample(yard.time).elements.motor),
        lambda: yard.robot.command_position(yard.rigid.joint_measurements("anna")[0]),
        lambda: yard.robot.command_effort(np.zeros(len(joints))),
        lambda: yard.robot.command_velocity(np.zeros(len(joints))),
    ):
        before = yard.rigid.joint_measurements("anna")[0].copy()
        command()
        rows = yard.run(0.5)
        assert np.abs(rows[:, 0] - before).max() < 2e-4


def test_effort_control_keeps_the_speed_limit(yard: Yard) -> None:
    """The full effort is available at rest, nearly none at the largest speed."""
    joint = yard.robot.joint_indices(["arm_left_1_joint"])[0]
    yard.robot.command_effort([yard.robot.max_effort[joint]], ["arm_left_1_joint"])
    rows = yard.run(1.5)[:, :, joint]
    moving = rows[:, 0] < yard.robot.upper_limit[joint] - 0.2
    assert rows[moving, 1].max() == pytest.approx(yard.robot.max_velocity[joint], rel=0.02)
    assert rows[0, 2] == pytest.approx(yard.robot.max_effort[joint], rel=1e-6)
    assert np.abs(rows[10:40, 2] - yard.rigid.gravity_effort("anna")[joint]).max() < 0.2 * yard.robot.max_effort[joint]


def test_a_compliant_arm_presses_on_a_vine_by_stiffness_times_error() -> None:
    """All joints soft, a set-point behind the bunch: at rest K times the position error is the contact effort."""
    description = load_description("vinebot")
    model, _, middle = bunch_scene()
    physics = Physics(model)
    tip = description.link_poses(description.home)["gripper_left_grasping_link"][:3]
    place = middle + np.array([0.22, 0.0, 0.0]) - frames.rotate(frames.from_yaw(np.pi), tip)
    robot = Robot(physics.rigid, description, "anna", pose=frames.pose(place, frames.from_yaw(np.pi)))
    joints = description.joint_indices("arm_left")
    stiffness = np.array([60.0, 60.0, 40.0, 40.0, 15.0, 15.0, 15.0])
    robot.command_impedance(stiffness, 0.2 * stiffness, joints)
    robot.control(physics.time)
    physics.step()
    local = robot.frame_pose("gripper_left_grasping_link")[:3]
    J = physics.rigid.jacobian("anna", "gripper_left_grasping_link", local)[:3, joints]
    desired = robot.setpoint[joints] + np.linalg.pinv(J) @ np.array([-0.25, 0.0, 0.0])
    robot.command_position(desired, joints)
    for _ in range(1500):
        robot.control(physics.time)
        physics.step()
    position, velocity, _, contact = physics.rigid.joint_measurements("anna")
    assert any(c.link.startswith("gripper_left") for c in physics.contacts)
    assert np.abs(contact[joints]).max() > 0.3
    assert np.abs(velocity[joints]).max() < 2e-3
    np.testing.assert_allclose(stiffness * (desired - position[joints]), -contact[joints], atol=0.03)
