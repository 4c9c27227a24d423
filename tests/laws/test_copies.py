"""Copies of remote robots: springs pull them to the received state; they can be pushed; the larger force wins."""

from __future__ import annotations

import dataclasses
from collections import deque

import numpy as np
import pytest

from tests.support.long_rows import each_once
from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.robot_instance import RemoteRobot, RobotInstance
from vinesim.scene.builder import assemble
from vinesim.scene.values import Drive, RobotSpec, RobotUpdate

pytestmark = pytest.mark.slow

STIFFNESS = 4000.0
DAMPING = 400.0
INERTIA = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
RAM = f"""<robot name="ram"><link name="base_footprint"><inertial><mass value="500"/>{INERTIA}</inertial></link>
<link name="head"><inertial><mass value="5"/>{INERTIA}</inertial>
<collision><geometry><box size="0.2 0.2 0.2"/></geometry></collision></link>
<joint name="push" type="prismatic"><parent link="base_footprint"/><child link="head"/><origin xyz="0.5 0 0"/>
<axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="1000" velocity="1"/></joint></robot>"""
HERE = frames.pose([0.0, 0.0, 0.0])
BEYOND = 0.08
"""Goal of each ram beyond the meeting point [m]."""


def ram(name: str, effort: float) -> RobotSpec:
    """A head of 20 cm driven along x with at most ``effort`` [N]; *right* drives in the opposite direction."""
    left = name == "left"
    pose = frames.pose([-0.6, 0.0, 1.0]) if left else frames.pose([0.6, 0.0, 1.0], frames.from_yaw(np.pi))
    drives = (Drive("push", STIFFNESS, DAMPING, effort, 1.0, -1.0, 1.0),)
    return RobotSpec(name, 0 if left else 1, RAM, "base_footprint", pose, drives, np.array([-0.05]), (1e5, 1e5))


def step(rigid: RigidWorld, ticks: int = 1) -> None:
    for _ in range(ticks):
        rigid.predict()
        rigid.integrate()


def contact_point(rigid: RigidWorld) -> float:
    """Contact point of the heads along the left ram's axis [m]; 0 is the middle."""
    left = rigid.joint_measurements("left")[0][0]
    right = rigid.joint_measurements("right")[0][0]
    assert left + right == pytest.approx(0.0, abs=2e-3), "the heads touch"
    return 0.5 * (left - right)


FORCES = [(20.0, 80.0), (40.0, 80.0), (70.0, 80.0), (80.0, 70.0), (80.0, 40.0), (80.0, 20.0)]


@pytest.mark.parametrize(("left", "right"), FORCES)
def test_of_two_opposed_robots_the_stronger_wins(left, right):
    """F23. Both servos saturate towards their goals; the weaker one at its limit, and the stronger one's spring
    balances that: it stays short of its goal by (the weaker one's limit) / K."""
    rigid = RigidWorld(assemble([]))
    for name, effort in (("left", left), ("right", right)):
        rigid.add_robot(ram(name, effort))
        rigid.command(name, np.array([BEYOND]))
    step(rigid, 600)
    expected = np.sign(left - right) * (BEYOND - min(left, right) / STIFFNESS)
    assert contact_point(rigid) == pytest.approx(expected, abs=1e-3)
    for name in ("left", "right"):
        contact = rigid.joint_measurements(name)[3][0]
        assert -contact == pytest.approx(min(left, right), rel=0.02)


@pytest.mark.parametrize(("forces", "delay"), each_once([(30.0, 80.0), (80.0, 30.0)], [1, 5, 10]))
def test_of_two_opposed_robots_of_two_clients_the_stronger_wins(forces, delay):
    """Each client moves its own ram and has a copy of the other, ``delay`` ticks old. The same ram wins on both,
    and the clients differ by the deflection of the spring that carries the force: limit / K."""
    left, right = forces
    worlds = {"left": RigidWorld(assemble([])), "right": RigidWorld(assemble([]))}
    queue: dict[str, deque] = {name: deque() for name in worlds}
    for rigid in worlds.values():
        rigid.add_robot(ram("left", left))
        rigid.add_robot(ram("right", right))
    for own, rigid in worlds.items():
        rigid.command(own, np.array([BEYOND]))
    points = []
    for tick in range(1200):
        for own in worlds:
            queue[own].append(
                (*worlds[own].base_state(own), *(x.copy() for x in worlds[own].joint_measurements(own)[:2]))
            )
        for own, other in (("left", "right"), ("right", "left")):
            if tick >= delay:
                worlds[own].follow_remote(other, *queue[other].popleft())
            step(worlds[own])
        if tick >= 1000:
            points.append([contact_point(rigid) for rigid in worlds.values()])
    here, there = np.mean(points, axis=0)
    assert np.ptp(points, axis=0).max() < 2e-3, "the rams came to rest"
    deflection = min(left, right) / STIFFNESS
    stronger = here if left > right else -there
    weaker = there if left > right else -here
    assert stronger == pytest.approx(BEYOND - deflection, abs=2e-3)
    assert weaker == pytest.approx(BEYOND - 2.0 * deflection, abs=2e-3)


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


@pytest.mark.parametrize("latency", [0, 2, 5, 10, 20])
def test_a_copy_lags_by_speed_times_latency(vinebot, latency):
    """F81, F85: springs and dampers pull to position and velocity, so the copy itself adds hardly any lag."""
    here = RigidWorld(assemble([]))
    there = RigidWorld(assemble([]))
    robot = Robot(here, vinebot, "anna")
    copy = RemoteRobot(there, vinebot, "anna")
    arm = robot.joint_indices(["arm_left_1_joint", "arm_left_4_joint"])
    queue = deque()
    rows = []
    for tick in range(400):
        time = 0.01 * tick
        robot.command_position(vinebot.home[arm] + 0.3 * np.sin(2.0 * time) * np.array([1, -1]), arm)
        robot.command_base(0.4, 0.2, time)
        robot.control(time)
        step(here)
        queue.append(robot.update(time))
        if tick >= latency:
            copy.follow(queue.popleft())
        step(there)
        error = np.abs(there.joint_measurements("anna")[0] - here.joint_measurements("anna")[0])[arm].max()
        base = np.linalg.norm(there.base_state("anna")[0][:2] - here.base_state("anna")[0][:2])
        rows.append((error, base, np.abs(here.joint_measurements("anna")[1])[arm].max()))
    error, base, speed = np.max(rows[100:], axis=0)
    assert speed > 0.5
    assert error < speed * 0.01 * latency + 1e-3
    assert base < 0.4 * 0.01 * latency + 5e-3


def update_to(copy: RobotInstance, position: np.ndarray) -> RobotUpdate:
    return RobotUpdate(copy.name, 0.0, HERE, np.zeros(6), position, np.zeros(len(position)))


def test_step_response_of_a_copy_takes_a_tenth_of_a_second_without_overshoot(vinebot):
    """F85."""
    rigid = RigidWorld(assemble([]))
    copy = RemoteRobot(rigid, vinebot, "anna")
    elbow = vinebot.joints.index("arm_left_4_joint")
    goal = vinebot.home.copy()
    goal[elbow] -= 0.1
    response = []
    for _ in range(100):
        copy.follow(update_to(copy, goal))
        step(rigid)
        response.append((vinebot.home[elbow] - rigid.joint_measurements("anna")[0][elbow]) / 0.1)
    assert np.argmax(np.array(response) > 0.95) <= 12
    assert max(response) < 1.02
    assert response[-1] == pytest.approx(1.0, abs=1e-3)


def test_a_light_joint_that_catches_up_with_all_its_effort_is_not_thrown(vinebot):
    """The wrist turns at 2 rad/s, and a correction puts its target 30 mrad ahead at once."""
    rigid = RigidWorld(assemble([]))
    copy = RemoteRobot(rigid, vinebot, "anna")
    wrist = vinebot.joints.index("arm_left_7_joint")
    drive = vinebot.drives[wrist]
    rate = 2.0
    ahead = 0.03
    assert drive.stiffness * (ahead + 0.01 * rate) > drive.effort
    goal = vinebot.home.copy()
    velocity = np.zeros(len(vinebot.home))
    speeds = []
    step(rigid)
    velocity[wrist] = rate
    for tick in range(40):
        goal[wrist] += 0.01 * rate + (ahead if tick == 20 else 0.0)
        copy.follow(dataclasses.replace(update_to(copy, goal), velocity=velocity))
        step(rigid)
        speeds.append(rigid.joint_measurements("anna")[1][wrist])
    assert max(speeds) < rate + ahead / 0.025  # D / K of the servo is 25 ms
    assert rigid.joint_measurements("anna")[0][wrist] == pytest.approx(goal[wrist], abs=1e-3)


def test_a_pushed_copy_deflects_by_f_over_k_and_returns(vinebot):
    """F86: deflection = J^T F / K under 60 N on the wrist; a second after its end the deflection is zero."""
    rigid = RigidWorld(assemble([]))
    copy = RemoteRobot(rigid, vinebot, "anna")
    step(rigid, 20)
    rigid.apply_wrench("anna", "arm_left_7_link", np.array([0.0, 0.0, -60.0]))
    for _ in range(200):
        copy.follow(update_to(copy, vinebot.home))
        step(rigid)
    deflection = rigid.joint_measurements("anna")[0] - vinebot.home
    body = rigid.mj_model.body("anna/arm_left_7_link").id
    load_ = rigid.jacobian("anna", "arm_left_7_link", rigid.mj_data.xipos[body])[2] * -60.0
    expected = load_ / np.array([drive.stiffness for drive in vinebot.drives])
    assert np.abs(deflection).max() > 5e-3
    np.testing.assert_allclose(deflection, expected, atol=0.02 * np.abs(expected).max())
    rigid.apply_wrench("anna", "arm_left_7_link", np.zeros(3))
    for _ in range(100):
        copy.follow(update_to(copy, vinebot.home))
        step(rigid)
    assert np.abs(rigid.joint_measurements("anna")[0] - vinebot.home).max() < 1e-6


def test_the_measured_state_is_sent_and_only_the_owner_commands(vinebot):
    """F82, F84: of an arm that is held back the measured position is sent, not the commanded one."""
    rigid = RigidWorld(assemble([]))
    robot = Robot(rigid, vinebot, "anna")
    robot.command_position(vinebot.home + 0.2)
    rigid.apply_wrench("anna", "arm_left_4_link", np.array([600.0, 0.0, 0.0]))
    for tick in range(40):
        robot.control(0.01 * tick)
        step(rigid)
    update = robot.update(0.4)
    position, velocity, _, _ = rigid.joint_measurements("anna")
    np.testing.assert_array_equal(update.position, position)
    np.testing.assert_array_equal(update.velocity, velocity)
    assert np.abs(update.position - robot.setpoint).max() > 0.03
    assert not [name for name in dir(RemoteRobot) if name.startswith(("command", "control"))]
