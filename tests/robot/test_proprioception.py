"""Wrist force-torque sensors and IMUs against weights, pushes, accelerations and contacts."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.contact_scenes import bunch_scene
from tests.support.robot_yard import Yard, centre_of_hand, hand_of, wrench_of
from vinesim.core import frames
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.world import Physics


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


@pytest.fixture
def yard(vinebot: RobotDescription) -> Yard:
    return Yard(vinebot)


def test_the_wrist_measures_the_weight_of_the_hand_and_a_push(yard: Yard, vinebot: RobotDescription) -> None:
    yard.run(0.5)
    force, torque = wrench_of(yard)
    mass, centre = hand_of(vinebot)
    down = np.array([0.0, 0.0, -9.81 * mass])
    place = yard.robot.frame_pose("wrist_left_ft_link")[:3]
    np.testing.assert_allclose(force, down, atol=0.01)
    np.testing.assert_allclose(torque, np.cross(centre - place, down), atol=0.01)
    push = np.array([6.0, -8.0, 3.0])
    yard.rigid.apply_wrench("anna", "gripper_left_base_link", push)
    yard.run(3.0)
    pushed, twisted = wrench_of(yard)
    np.testing.assert_allclose(pushed - force, push, atol=0.03)
    body = yard.rigid.mj_model.body("anna/gripper_left_base_link").id
    lever = yard.rigid.mj_data.xipos[body] - yard.robot.frame_pose("wrist_left_ft_link")[:3]
    np.testing.assert_allclose(twisted - torque, np.cross(lever, push), atol=0.03)
    other = next(w for w in yard.robot.sample(yard.time).wrenches if w.name == "wrist_right_ft")
    assert np.linalg.norm(other.force) == pytest.approx(9.81 * mass, rel=0.01)


def test_the_wrist_measures_the_inertia_of_a_falling_hand(yard: Yard, vinebot: RobotDescription) -> None:
    """With inertia: as the lift drops with the hand, the wrist carries m (g + a)."""
    hand, _ = hand_of(vinebot)
    yard.run(0.2)
    yard.robot.command_effort([-400.0], ["torso_lift_joint"])
    heights = []
    forces = []
    for _ in range(8):
        yard.run(yard.rigid.dt)
        heights.append(centre_of_hand(yard)[2])
        forces.append(wrench_of(yard)[0][2])
    acceleration = np.diff(heights, 2) / yard.rigid.dt**2
    assert acceleration.min() < -0.5
    np.testing.assert_allclose(forces[2:], -hand * (9.81 + acceleration), atol=0.1)


def test_the_imu_measures_gravity_acceleration_and_rotation(yard: Yard) -> None:
    yard.run(0.3)
    imu = yard.robot.sample(yard.time).imus[0]
    assert (imu.name, imu.frame) == ("base_imu", "base_imu_link")
    np.testing.assert_allclose(imu.linear_acceleration, [0.0, 0.0, 9.81], atol=1e-3)
    np.testing.assert_allclose(imu.angular_velocity, 0.0, atol=1e-6)
    yard.robot.command_base(0.8, 0.0, yard.time)
    yard.run(0.4)
    imu = yard.robot.sample(yard.time).imus[0]
    assert imu.linear_acceleration[0] == pytest.approx(yard.robot.description.base_limits.linear_acceleration, rel=0.05)
    for _ in range(200):
        yard.robot.command_base(0.5, 0.6, yard.time)
        yard.run(yard.rigid.dt)
    imu = yard.robot.sample(yard.time).imus[0]
    x, y = yard.robot.description.link_poses(yard.robot.description.home)["base_imu_link"][:2]
    np.testing.assert_allclose(imu.angular_velocity, [0.0, 0.0, 0.6], atol=0.005)
    expected = [-(0.6**2) * x, 0.5 * 0.6 - 0.6**2 * y, 9.81]
    np.testing.assert_allclose(imu.linear_acceleration, expected, atol=0.02)


def test_the_wrist_measures_contact_forces_of_plants() -> None:
    """Oracle: the reading at rest is the weight of the hand and the contact forces of plants."""
    description = load_description("vinebot")
    model, _, middle = bunch_scene()
    physics = Physics(model)
    tip = description.link_poses(description.home)["gripper_left_grasping_link"][:3]
    ahead = np.array([0.15, 0.0, 0.0])  # it approaches from beyond the cane's tip
    place = middle + ahead - frames.rotate(frames.from_yaw(np.pi), tip)
    robot = Robot(physics.rigid, description, "anna", pose=frames.pose(place, frames.from_yaw(np.pi)))
    contact_ticks = 0
    for _ in range(900):
        contact_ticks += any(c.link.startswith("gripper_left") for c in physics.contacts)
        if contact_ticks < 20:
            robot.command_base(0.2, 0.0, physics.time)
        robot.control(physics.time)
        physics.step()
    sample = robot.sample(physics.time, physics.contacts)
    hand = [c for c in sample.contacts if c.link.startswith("gripper_left")]
    force = np.sum([c.force for c in hand], axis=0)
    assert np.linalg.norm(force) > 0.3
    wrench = next(w for w in sample.wrenches if w.name == "wrist_left_ft")
    turn = robot.frame_pose(wrench.frame)[3:]
    mass, _ = hand_of(description)
    measured = frames.rotate(turn, wrench.force) + np.array([0.0, 0.0, 9.81 * mass])
    np.testing.assert_allclose(measured, force, atol=0.05)
