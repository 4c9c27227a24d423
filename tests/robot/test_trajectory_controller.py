"""Trajectories: followed between tolerances, ended with ROS's own codes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.control.trajectory_controller import (
    LIMIT_SLACK,
    MAX_SPLINES,
    MAX_WAIT,
    GoalHandle,
    Outcome,
    Tolerance,
    Trajectory,
    TrajectoryController,
    TrajectoryError,
)
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.builder import assemble

ARM = tuple(f"arm_left_{i}_joint" for i in range(1, 8))
TWO = ("arm_left_1_joint", "arm_left_4_joint")


class ControlledArm:
    """A robot whose left arm is moved by a trajectory controller."""

    def __init__(self, **tolerances) -> None:
        self.rigid = RigidWorld(assemble([]))
        self.robot = Robot(self.rigid, load_description("vinebot"), "anna")
        self.controller = TrajectoryController(self.robot, ARM, **tolerances)
        self.home = self.robot.setpoint[self.controller.indices].copy()
        self.time = 0.0
        self.rows: list[np.ndarray] = []

    def run(self, seconds: float, until: GoalHandle | None = None) -> None:
        """Step for ``seconds``, or until a trajectory has ended."""
        for _ in range(round(seconds / self.rigid.dt)):
            if until is not None and until.is_done:
                return
            self.controller(self.time)
            self.robot.control(self.time)
            self.rigid.predict()
            self.rigid.integrate()
            self.time += self.rigid.dt
            position, velocity, _, _ = self.rigid.joint_measurements("anna")
            self.rows.append(np.stack([position, velocity])[:, self.controller.indices])

    def at(self, joints: tuple[str, ...] = ARM) -> np.ndarray:
        """Positions of some joints."""
        return self.rigid.joint_measurements("anna")[0][self.robot.joint_indices(joints)]


def swing(arm: ControlledArm, *, smooth: bool = True) -> Trajectory:
    """Two joints back and forth in 3 s, starting at home."""
    home = arm.at(TWO)
    positions = home + np.array([[0.2, -0.3], [0.4, -0.6], [0.1, -0.2]])
    velocities = np.array([[0.3, -0.45], [0.0, 0.0], [0.0, 0.0]]) if smooth else None
    return Trajectory(TWO, np.array([1.0, 2.0, 3.0]), positions, velocities)


@pytest.mark.parametrize("smooth", [True, False])
def test_waypoints_are_reached_in_time(smooth: bool) -> None:
    """Oracle: the waypoints, and for cubics scipy's Hermite spline between them."""
    from scipy.interpolate import CubicHermiteSpline

    arm = ControlledArm()
    plan = swing(arm, smooth=smooth)
    start = arm.at(TWO)
    run = arm.controller.start(plan, 0.0)
    arm.run(4.0, until=run)
    assert run.outcome is Outcome.SUCCESSFUL
    assert arm.time == pytest.approx(3.0, abs=0.03)
    columns = [ARM.index(joint) for joint in TWO]
    position = np.array(arm.rows)[:, 0, columns]
    for t, point in zip(plan.times, plan.positions, strict=True):
        np.testing.assert_allclose(position[round(t / 0.01) - 1], point, atol=4e-3)
    if smooth:
        knots = np.concatenate([[0.0], plan.times])
        spline = CubicHermiteSpline(
            knots, np.concatenate([start[None], plan.positions]), np.concatenate([np.zeros((1, 2)), plan.velocities])
        )
        times = 0.01 * np.arange(1, len(position) + 1)
        late = np.abs(position[times <= 3.0] - spline(times[times <= 3.0])).max()
        assert late < 2e-3
    others = [i for i, joint in enumerate(ARM) if joint not in TWO]
    np.testing.assert_allclose(np.array(arm.rows)[:, 0, others], arm.home[others] + 0 * position[:, :1], atol=2e-3)


def test_the_desired_state_is_that_of_the_end_of_the_step() -> None:
    arm = ControlledArm()
    controller = arm.controller
    controller.start(swing(arm), 0.0)
    arm.run(1.5)
    error = controller.desired - arm.at()
    assert np.abs(error).max() < 2e-3  # both at the same time: 0.4 rad/s times a step were 4e-3 more
    np.testing.assert_allclose(controller.desired[[0, 3]], arm.robot.setpoint[arm.robot.joint_indices(TWO)])
    assert np.abs(controller.desired_velocity[[0, 3]]).min() > 0.05
    assert (controller.desired_velocity[[1, 2, 4, 5, 6]] == 0.0).all()


def test_a_trajectory_too_fast_for_the_drives_violates_its_path_tolerance() -> None:
    """The URDF allows 1.9 rad/s; 1.2 rad in 0.2 s are three times as fast. The arm stops."""
    arm = ControlledArm(path_tolerance=Tolerance.uniform(7, position=0.1))
    run = arm.controller.start(Trajectory(TWO, np.array([0.2]), arm.at(TWO) + np.array([[1.2, 0.0]])), 0.0)
    arm.run(1.0, until=run)
    assert run.outcome is Outcome.PATH_TOLERANCE_VIOLATED
    assert "arm_left_1_joint is off by 0.1" in run.text
    assert arm.time < 0.1
    stopped = arm.at()
    arm.run(1.0)
    assert np.abs(arm.at() - stopped).max() < 0.12
    assert np.abs(arm.rows[-1][1]).max() < 1e-3
    speeds = np.abs(np.array(arm.rows)[:, 1, 0])
    assert speeds.max() < 1.1 * arm.robot.max_velocity[arm.controller.indices[0]]


def test_a_blocked_arm_misses_its_goal_in_time() -> None:
    arm = ControlledArm(goal_tolerance=Tolerance.uniform(7, position=0.01), goal_time_tolerance=0.5)
    arm.rigid.apply_wrench("anna", "arm_left_4_link", np.array([600.0, 0.0, 0.0]))
    run = arm.controller.start(Trajectory(TWO, np.array([1.0]), arm.at(TWO) - np.array([[0.3, 0.0]])), 0.0)
    arm.run(3.0, until=run)
    assert run.outcome is Outcome.GOAL_TOLERANCE_VIOLATED
    assert "arm_left_1_joint" in run.text
    assert arm.time == pytest.approx(1.5, abs=0.05)


def test_without_a_time_tolerance_it_waits_until_the_goal_is_reached() -> None:
    arm = ControlledArm(goal_tolerance=Tolerance.uniform(7, position=0.01))
    arm.rigid.apply_wrench("anna", "arm_left_4_link", np.array([600.0, 0.0, 0.0]))
    run = arm.controller.start(Trajectory(TWO, np.array([1.0]), arm.at(TWO) - np.array([[0.3, 0.0]])), 0.0)
    arm.run(3.0, until=run)
    assert not run.is_done
    arm.rigid.apply_wrench("anna", "arm_left_4_link", np.zeros(3))
    arm.run(3.0, until=run)
    assert run.outcome is Outcome.SUCCESSFUL


def test_tolerances_of_the_trajectory_override_those_of_the_controller() -> None:
    arm = ControlledArm(path_tolerance=Tolerance.uniform(7, position=1e-9))
    trajectory = swing(arm)
    for tolerance, outcome in (
        (None, Outcome.PATH_TOLERANCE_VIOLATED),
        (Tolerance.uniform(2, 0.05), Outcome.SUCCESSFUL),
    ):
        plan = Trajectory(TWO, trajectory.times, trajectory.positions, trajectory.velocities, path_tolerance=tolerance)
        run = arm.controller.start(plan, arm.time)
        arm.run(4.0, until=run)
        assert run.outcome is outcome


def test_a_newer_trajectory_takes_over_without_a_velocity_step() -> None:
    arm = ControlledArm()
    first = arm.controller.start(swing(arm), 0.0)
    arm.run(1.5)
    there = arm.home[[0, 3]] + 0.1
    second = arm.controller.start(Trajectory(TWO, np.array([1.5]), there[None], np.zeros((1, 2))), arm.time)
    assert first.outcome is Outcome.PREEMPTED
    arm.run(3.0, until=second)
    assert second.outcome is Outcome.SUCCESSFUL
    np.testing.assert_allclose(arm.at(TWO), there, atol=3e-3)
    jerk = np.abs(np.diff(np.array(arm.rows)[20:, 1, 0]))
    assert jerk.max() < 0.04, "a step in speed"


def test_cancelling_stops_the_arm() -> None:
    arm = ControlledArm()
    run = arm.controller.start(swing(arm), 0.0)
    arm.run(1.5)
    arm.controller.cancel()
    assert run.outcome is Outcome.CANCELED
    here = arm.at()
    arm.run(1.0)
    np.testing.assert_allclose(arm.at(), here, atol=0.02)
    assert np.abs(arm.rows[-1][1]).max() < 1e-3
    arm.controller.cancel()  # without effect when no trajectory runs


def test_a_trajectory_may_start_later_but_not_be_over() -> None:
    arm = ControlledArm()
    plan = swing(arm)
    later = Trajectory(TWO, plan.times, plan.positions, plan.velocities, start_time=0.5)
    run = arm.controller.start(later, 0.0)
    arm.run(0.4)
    np.testing.assert_allclose(arm.at(), arm.home, atol=1e-4)
    assert not arm.controller.desired_velocity.any()  # it waits
    np.testing.assert_allclose(arm.controller.desired, arm.robot.setpoint[arm.controller.indices])
    arm.run(1.5)
    run = arm.controller.start(dataclasses.replace(later, start_time=arm.time + 0.5), arm.time)
    assert arm.controller.desired_velocity.any()  # the older one goes on
    arm.run(0.45)
    arm.rows.clear()
    arm.run(4.0, until=run)
    assert np.abs(np.diff(np.array(arm.rows)[:20, 1], axis=0)).max() < 0.04
    assert arm.time == pytest.approx(1.9 + 3.5, abs=0.03)
    with pytest.raises(TrajectoryError, match=r"ended at 3\.50 s, now is 9\.00 s") as error:
        arm.controller.start(later, 9.0)
    assert error.value.code is Outcome.OLD_HEADER_TIMESTAMP


def test_a_trajectory_that_starts_later_replaces_the_older_one_at_its_start() -> None:
    """Until then the joints follow the older one exactly; there they have its place and speed, and it is continuous."""
    arm = ControlledArm()
    alone = ControlledArm()
    older = swing(arm)
    first = arm.controller.start(older, 0.0)
    whole = alone.controller.start(older, 0.0)
    arm.run(0.5)
    there = arm.home[[0, 3]] + [0.1, -0.1]
    newer = Trajectory(TWO, np.array([1.2]), there[None], np.zeros((1, 2)), start_time=1.5)
    second = arm.controller.start(newer, arm.time)
    assert first.outcome is Outcome.PREEMPTED  # its goal ends at once, as in joint_trajectory_controller
    arm.run(4.0, until=second)
    alone.run(4.0, until=whole)
    assert second.outcome is Outcome.SUCCESSFUL
    assert arm.time == pytest.approx(1.5 + 1.2, abs=0.03)
    np.testing.assert_allclose(arm.at(TWO), there, atol=3e-3)
    same = np.array(alone.rows)
    rows = np.array(arm.rows)
    assert rows[:149].tobytes() == same[:149].tobytes()
    assert np.abs(same[148, 1, 0]) > 0.05  # it is on its way then
    assert np.abs(rows[200:, 0, 0] - same[200 : len(rows), 0, 0]).max() > 0.1
    assert np.abs(np.diff(rows[20:, 1, [0, 3]], axis=0)).max() < 0.04, "a step in speed"


def test_joints_that_a_newer_trajectory_does_not_name_follow_the_older_one() -> None:
    arm = ControlledArm()
    alone = ControlledArm()
    plan = swing(arm)
    arm.controller.start(plan, 0.0)
    alone.controller.start(plan, 0.0)
    arm.run(0.5)
    newer = Trajectory(TWO[:1], np.array([0.4]), arm.home[:1][None] + 0.3, start_time=0.8)
    goal = arm.controller.start(newer, arm.time)
    arm.run(1.0, until=goal)
    assert goal.outcome is Outcome.SUCCESSFUL
    assert arm.time < 1.25
    arm.run(2.5)
    alone.run(arm.time)
    wrist = ARM.index(TWO[1])
    np.testing.assert_allclose(
        np.array(arm.rows)[:, 0, wrist], np.array(alone.rows)[: len(arm.rows), 0, wrist], atol=2e-3
    )
    assert arm.at(TWO[:1]) == pytest.approx(arm.home[:1] + 0.3, abs=3e-3)  # the older one, which ends later, is over
    assert not arm.controller.is_moving


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_waypoints_may_be_at_a_limit_but_not_beyond_it(side: float) -> None:
    arm = ControlledArm()
    robot = arm.robot
    joint = robot.joint_indices(TWO)[1]
    limit = (robot.lower_limit if side < 0.0 else robot.upper_limit)[joint]
    for beyond, is_allowed in ((0.0, True), (0.5 * LIMIT_SLACK, True), (0.02, False)):
        points = np.tile(arm.at(TWO), (2, 1))
        points[1, 1] = limit + side * beyond
        plan = Trajectory(TWO, np.array([5.0, 9.0]), points)
        if is_allowed:
            arm.controller.start(plan, 0.0)
        else:
            with pytest.raises(
                TrajectoryError, match=r"point 1 moves arm_left_4_joint to .*give a position between"
            ) as no:
                arm.controller.start(plan, 0.0)
            assert no.value.code is Outcome.INVALID_GOAL


@pytest.mark.parametrize(("ahead", "is_allowed"), [(MAX_WAIT - 1.0, True), (MAX_WAIT + 1.0, False), (1.76e9, False)])
def test_a_stamp_far_ahead_is_of_another_clock(ahead: float, is_allowed: bool) -> None:
    arm = ControlledArm()
    arm.time = 20.0
    plan = dataclasses.replace(swing(arm), start_time=arm.time + ahead)
    if is_allowed:
        assert arm.controller.start(plan, arm.time).start_time == arm.time + ahead
    else:
        with pytest.raises(TrajectoryError, match="at most 60 s ahead, or with 0") as no:
            arm.controller.start(plan, arm.time)
        assert no.value.code is Outcome.INVALID_GOAL


def test_trajectories_that_wait_are_bounded() -> None:
    """Each of them replaces the one before only for the last part of its time, so that all are kept."""
    arm = ControlledArm()
    one = np.array([1.0])
    here = arm.at(TWO)[None]
    for i in range(MAX_SPLINES):
        arm.controller.start(Trajectory(TWO, one, here, start_time=1.0 + i), 0.0)
    with pytest.raises(TrajectoryError, match="32 trajectories are executed or wait"):
        arm.controller.start(Trajectory(TWO, one, here, start_time=50.0), 0.0)
    now = arm.controller.start(Trajectory(TWO, one, here), 0.0)  # replaces all
    arm.run(2.0, until=now)
    assert now.outcome is Outcome.SUCCESSFUL
    assert not arm.controller.is_moving


def test_invalid_trajectories_are_refused_without_effect() -> None:
    arm = ControlledArm()
    run = arm.controller.start(swing(arm), 0.0)
    here = arm.at(TWO)
    one = np.array([1.0])
    for joints, times, positions, code, text in (
        (("head_1_joint",), one, np.zeros((1, 1)), Outcome.INVALID_JOINTS, "trajectory for head_1_joint"),
        ((TWO[0], TWO[0]), one, np.zeros((1, 2)), Outcome.INVALID_JOINTS, "once"),
        ((), one, np.zeros((1, 0)), Outcome.INVALID_JOINTS, "no joints"),
        (TWO, one, np.zeros((2, 2)), Outcome.INVALID_GOAL, r"\(1, 2\) is needed"),
        (TWO, one, np.full((1, 2), np.nan), Outcome.INVALID_GOAL, "not finite"),
        (TWO, np.array([1.0, 1.0]), np.zeros((2, 2)), Outcome.INVALID_GOAL, "increase from 0"),
        (TWO, np.zeros(0), np.zeros((0, 2)), Outcome.INVALID_GOAL, "increase from 0"),
    ):
        with pytest.raises(TrajectoryError, match=text) as error:
            arm.controller.start(Trajectory(joints, times, positions), 0.0)
        assert error.value.code is code
    with pytest.raises(TrajectoryError, match="path tolerances for 7 joints"):
        arm.controller.start(Trajectory(TWO, one, here[None], path_tolerance=Tolerance.uniform(7)), 0.0)
    assert not run.is_done


def test_two_runs_are_bitwise_equal() -> None:
    ends = []
    for _ in range(2):
        arm = ControlledArm()
        arm.controller.start(swing(arm), 0.0)
        arm.run(2.0)
        ends.append(np.array(arm.rows).tobytes())
    assert ends[0] == ends[1]
