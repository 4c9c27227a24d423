"""Odometry of tracks that slip."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from tests.support.robot_yard import Yard
from vinesim import frames
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
