"""The push task: fingertips reach bunches in the whole workspace, slowly, and skip those out of reach."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.robot.description.urdf import DescriptionError
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.drives.joint_servos import CommandError
from vinesim.robot.tasks.push import Phase, PushBunch
from vinesim.scene.builder import assemble

pytestmark = pytest.mark.slow

HERE = frames.pose([0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


@pytest.fixture(scope="module")
def robot(vinebot: RobotDescription) -> Robot:
    return Robot(RigidWorld(assemble([])), vinebot, "anna")


class Run:
    """One push at ``target``, recorded tick by tick."""

    def __init__(self, robot: Robot, side: str, target: np.ndarray, base: np.ndarray = HERE, **options) -> None:
        robot.rigid.place_robot("anna", base, robot.description.home)
        robot.stop()
        self.reach = reach = PushBunch(robot, side, lambda: target, repeat=False, **options)
        self.phases = []
        self.tips = []
        self.speeds = []
        self.setpoints = [robot.setpoint.copy()]
        self.errors = {}
        self.time = 0.0
        while reach.phase is not Phase.DONE and self.time < 40.0:
            before = reach.phase
            error = reach.error
            reach.control(self.time)
            if reach.phase is not before:
                self.errors[before] = error
            robot.control(self.time)
            robot.rigid.predict()
            robot.rigid.integrate()
            self.time += robot.rigid.dt
            self.phases.append(reach.phase)
            self.tips.append(reach.tip)
            self.speeds.append(robot.rigid.joint_measurements("anna")[1])
            self.setpoints.append(robot.setpoint.copy())


# 0.45 to 0.9 m ahead, 1.3 to 1.8 m high, across the half of the alley that an arm covers
GRID = list(itertools.product((0.45, 0.65, 0.9), (0.1, 0.35), (1.3, 1.55, 1.8)))


@pytest.mark.parametrize("target", GRID, ids=str)
def test_fingertips_arrive_within_a_centimetre(robot: Robot, target: tuple[float, float, float]) -> None:
    run = Run(robot, "left", np.array(target), radius=0.0, hold_time=0.1)
    for phase in (Phase.APPROACH, Phase.TOUCH, Phase.PUSH):
        assert run.errors[phase] < 0.01, phase
    touched = np.flatnonzero([phase is Phase.PUSH for phase in run.phases])[0]
    assert np.linalg.norm(run.tips[touched - 1] - np.array(target)) < 0.01
    # within the limits of the URDF: set-points strictly, velocities up to the servos' overshoot
    steps = np.abs(np.diff(run.setpoints, axis=0)) / robot.rigid.dt
    assert (steps <= robot.max_velocity * (1.0 + 1e-6)).all()
    assert (np.abs(run.speeds) <= 1.5 * robot.max_velocity).all()
    assert run.reach.push_count == 1
    assert run.reach.missed_count == 0


@pytest.mark.parametrize("target", [(0.5, -0.2, 1.4), (0.8, -0.3, 1.7), (0.7, 0.1, 1.5)], ids=str)
def test_the_right_arm_mirrors_the_left(robot: Robot, target: tuple[float, float, float]) -> None:
    right = Run(robot, "right", np.array(target))
    left = Run(robot, "left", np.array(target) * [1, -1, 1])
    assert right.time == left.time
    np.testing.assert_allclose(right.tips, np.array(left.tips) * [1, -1, 1], atol=1e-6)


def test_targets_are_in_world_coordinates(robot: Robot) -> None:
    base = frames.pose([4.0, -3.0, 0.0], frames.from_yaw(2.5))
    target = frames.compose(base, frames.pose([0.65, 0.2, 1.5]))[:3]
    run = Run(robot, "left", target, base, radius=0.05)
    assert run.errors[Phase.TOUCH] < 0.01
    touched = np.flatnonzero([phase is Phase.PUSH for phase in run.phases])[0]
    assert np.linalg.norm(run.tips[touched] - target) == pytest.approx(0.05, abs=0.01)


def test_the_fingers_approach_from_below_and_touch_slowly(robot: Robot) -> None:
    target = np.array([0.65, 0.2, 1.55])
    run = Run(robot, "left", target, radius=0.05, clearance=0.10, depth=0.04)
    tips = np.array(run.tips)
    phases = np.array([phase.value for phase in run.phases])
    gap = np.linalg.norm(tips - target, axis=1)
    approach, touch, push = (phases == phase.value for phase in (Phase.APPROACH, Phase.TOUCH, Phase.PUSH))
    assert gap[approach].min() > 0.14
    assert (tips[approach, 2] < target[2]).all()
    assert (tips[approach, 0] < target[0]).all()
    speed = np.linalg.norm(np.diff(tips, axis=0), axis=1) / robot.rigid.dt
    assert speed[approach[1:]].max() < 0.35 * 1.2
    assert speed[touch[1:] & touch[:-1]].max() < 0.10 * 1.3
    assert gap[push].min() == pytest.approx(0.01, abs=0.006), "4 cm deep from a radius of 5 cm"
    forward = frames.rotate(robot.frame_pose(run.reach.tool)[3:], np.array([1.0, 0.0, 0.0]))
    assert forward[0] > 0.7


def test_the_hand_moves_smoothly(robot: Robot) -> None:
    run = Run(robot, "left", np.array([0.7, 0.25, 1.5]))
    arm = robot.description.joint_indices("arm_left")
    acceleration = np.diff(np.array(run.speeds)[:, arm], axis=0) / robot.rigid.dt
    assert np.abs(acceleration).max() < 60.0


def test_pushes_repeat_on_a_moving_target_and_a_rolling_base(vinebot: RobotDescription) -> None:
    robot = Robot(RigidWorld(assemble([])), vinebot, "anna")
    time = 0.0
    reach = PushBunch(robot, "left", lambda: np.array([0.70, 0.15, 1.5 + 0.02 * time]), hold_time=0.2)
    errors = []
    while reach.push_count < 2 and time < 30.0:
        before = reach.phase
        error = reach.error
        robot.command_base(0.05 if time < 2.0 else 0.0, 0.0, time)
        reach.control(time)
        if reach.phase is not before and before is Phase.TOUCH:
            errors.append(error)
        robot.control(time)
        robot.rigid.predict()
        robot.rigid.integrate()
        time += robot.rigid.dt
    assert reach.push_count == 2
    assert max(errors) < 0.01


def test_a_target_out_of_reach_is_skipped(robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    run = Run(robot, "left", np.array([1.6, 0.2, 1.5]))
    assert run.reach.missed_count == 1
    assert Phase.TOUCH not in run.phases
    assert "out of reach" in caplog.text
    assert (np.abs(run.speeds) <= 2.0 * robot.max_velocity).all()
    position = robot.rigid.joint_measurements("anna")[0]
    assert (position >= robot.lower_limit - 0.02).all()
    assert (position <= robot.upper_limit + 0.02).all()


def test_two_arms_of_one_robot_push_independently(vinebot: RobotDescription) -> None:
    robot = Robot(RigidWorld(assemble([])), vinebot, "anna")
    arms = [
        PushBunch(robot, "left", lambda: np.array([0.7, 0.25, 1.45]), repeat=False),
        PushBunch(robot, "right", lambda: np.array([0.6, -0.3, 1.4]), repeat=False, use_lift=False),
    ]
    touched = {}
    time = 0.0
    while any(arm.phase is not Phase.DONE for arm in arms) and time < 30.0:
        for arm in arms:
            before = arm.phase
            error = arm.error
            arm.control(time)
            if before is Phase.TOUCH and arm.phase is Phase.PUSH:
                touched[arm.tool] = error
        robot.control(time)
        robot.rigid.predict()
        robot.rigid.integrate()
        time += robot.rigid.dt
    assert len(touched) == 2
    assert max(touched.values()) < 0.01


def test_two_pushes_are_bitwise_equal(vinebot: RobotDescription) -> None:
    ends = []
    for _ in range(2):
        robot = Robot(RigidWorld(assemble([])), vinebot, "anna")
        ends.append(np.array(Run(robot, "left", np.array([0.6, 0.1, 1.6])).tips).tobytes())
    assert ends[0] == ends[1]


def test_an_arm_without_a_tool_is_refused(robot: Robot) -> None:
    with pytest.raises(CommandError, match="'arm_middle' with a tool"):
        PushBunch(robot, "middle", lambda: np.zeros(3))


def test_tiago_pro_pushes_by_its_joint_names_alone() -> None:
    try:
        tiago = load_description("tiago_pro")
    except DescriptionError as error:
        if "not installed" in str(error):
            pytest.skip(str(error))
        raise
    run = Run(Robot(RigidWorld(assemble([])), tiago, "anna"), "left", np.array([0.55, 0.25, 1.1]))
    assert run.reach.push_count == 1
    assert run.errors[Phase.TOUCH] < 0.01
