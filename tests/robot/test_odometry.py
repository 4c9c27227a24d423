"""Odometry of tracks that slip."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from tests.support.robot_yard import Yard
from vinesim.core import frames
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


@pytest.fixture
def yard(vinebot: RobotDescription) -> Yard:
    return Yard(vinebot)


@pytest.mark.parametrize(("ahead", "turning"), [(0.0, 0.0), (0.08, 0.0), (0.05, 0.2)])
def test_odometry_measures_the_travel_of_the_tracks(vinebot: RobotDescription, ahead: float, turning: float) -> None:
    """Straight, then a rotation in place: travel of the tracks = motion / (1 - slip)."""
    limits = msgspec.structs.replace(vinebot.base_limits, slip=(ahead, turning))
    start = frames.pose([3.0, -2.0, 0.0], frames.from_yaw(2.0))
    yard = Yard(dataclasses.replace(vinebot, base_limits=limits), start)
    for drive in ((0.5, 0.0), (0.0, 0.8)):
        for _ in range(250):
            yard.robot.command_base(*drive, yard.time)
            yard.run(yard.rigid.dt)
        yard.run(1.5)
        sample = yard.robot.sample(yard.time)
        way = frames.compose(frames.inverse(start), sample.base_q)
        assert sample.odom_q[0] == pytest.approx(way[0] / (1.0 - ahead), abs=2e-3)
        assert sample.odom_q[1] == pytest.approx(way[1], abs=2e-3)
        turned, measured = (2.0 * np.arctan2(q[5], q[6]) for q in (way, sample.odom_q))
        assert measured == pytest.approx(turned / (1.0 - turning), abs=2e-3)
    assert turned > 1.5


def _drive(vinebot: RobotDescription, ahead: float, turning: float) -> tuple[Yard, list]:
    """A robot with this slip that winds along, and its samples of every step, the first before it drives."""
    limits = msgspec.structs.replace(vinebot.base_limits, slip=(ahead, turning))
    yard = Yard(dataclasses.replace(vinebot, base_limits=limits), frames.pose([3.0, -2.0, 0.0], frames.from_yaw(2.0)))
    samples = [yard.robot.sample(0.0)]
    for step in range(600):
        yard.robot.command_base(0.6, 0.5 if step % 300 < 220 else -0.3, yard.time)
        yard.run(yard.rigid.dt)
        samples.append(yard.robot.sample(yard.time))
    return yard, samples


def test_measured_velocity_is_the_derivative_of_the_measured_pose(vinebot: RobotDescription) -> None:
    """So nothing of the truth is in it: it is wrong by the slip, as the pose is."""
    yard, samples = _drive(vinebot, 0.1, 0.2)
    x, y = np.array([s.odom_q[:2] for s in samples]).T
    yaw = np.unwrap([frames.to_yaw(s.odom_q[3:]) for s in samples])
    velocity = np.array([s.odom_qd for s in samples])
    assert not velocity[:, 1:5].any()
    way = np.cumsum(np.hypot(np.diff(x), np.diff(y)))
    assert yard.rigid.dt * velocity[1:, 0].sum() == pytest.approx(way[-1], rel=0.01)
    assert yard.rigid.dt * velocity[1:, 5].sum() == pytest.approx(yaw[-1] - yaw[0], rel=0.01)
    actual = np.array([s.base_qd for s in samples])
    assert velocity[-1, 0] == pytest.approx(np.hypot(*actual[-1, :2]) / 0.9, rel=1e-3)
    assert velocity[-1, 5] == pytest.approx(actual[-1, 5] / 0.8, rel=1e-3)


@pytest.mark.parametrize(("ahead", "turning"), [(0.04, 0.0), (0.0, 0.06), (0.04, 0.06)])
def test_covariance_of_the_pose_fits_its_error(vinebot: RobotDescription, ahead: float, turning: float) -> None:
    """The share that is lost is one standard deviation of what is measured: the error is that of one deviation of
    each share, so its distance by the covariance (Mahalanobis) is the root of their number, to first order."""
    _, samples = _drive(vinebot, ahead, turning)
    start = samples[0].base_q
    spread = []
    for sample in samples[200::100]:
        way = frames.compose(frames.inverse(start), sample.base_q)
        error = np.append(sample.odom_q[:2] - way[:2], frames.to_yaw(sample.odom_q[3:]) - frames.to_yaw(way[3:]))
        error[2] = (error[2] + np.pi) % (2.0 * np.pi) - np.pi
        pose, twist = sample.odom_covariance
        assert np.linalg.eigvalsh(pose)[0] > 0.0
        assert np.linalg.eigvalsh(twist)[0] > 0.0
        # along directions that the slip does not move, the error is of second order: deviations of 2 cm are allowed
        distance = error @ np.linalg.solve(pose + 4e-4 * np.eye(3), error)
        assert 0.2 < distance < 2.0 * ((ahead > 0.0) + (turning > 0.0)), (error, pose)
        spread.append(np.trace(pose))
    assert spread[-1] > spread[0]


def test_fusion_of_odometry_and_gyroscope_drifts_as_the_slip_says(vinebot: RobotDescription) -> None:
    """Turns from the gyroscope, travel from the tracks (as robot_localization fuses them without pose): whatever the
    way, it is the actual one enlarged by 1 / (1 - slip). With truth in either it would be the actual one."""
    slip = 0.1
    yard, samples = _drive(vinebot, slip, 0.2)
    place = np.zeros(2)
    yaw = 0.0
    for sample in samples[1:]:
        turn = yard.rigid.dt * sample.imus[0].angular_velocity[2]
        yaw += 0.5 * turn
        place += yard.rigid.dt * sample.odom_qd[0] * np.array([np.cos(yaw), np.sin(yaw)])
        yaw += 0.5 * turn
    way = frames.compose(frames.inverse(samples[0].base_q), samples[-1].base_q)
    assert np.linalg.norm(way[:2]) > 0.5
    assert yaw == pytest.approx(frames.to_yaw(way[3:]), abs=0.02)
    assert np.linalg.norm(place - way[:2] / (1.0 - slip)) < 0.02
    assert np.linalg.norm(place - way[:2]) > 0.04
