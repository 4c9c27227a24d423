"""A base that follows waypoints: their order, the final heading, speed limits, and obstacles."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.core import frames
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.control.waypoint_follower import STUCK_TIMEOUT, WaypointFollower
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.builder import assemble


def heading(pose: np.ndarray) -> float:
    return 2.0 * float(np.arctan2(pose[5], pose[6]))


def drive(follower: WaypointFollower, seconds: float = 60.0) -> np.ndarray:
    """Poses of the base [tick, 7] until the path is done or the base is stuck."""
    robot = follower.robot
    poses = []
    while not follower.is_done and not follower.is_stuck and len(poses) < 100 * seconds:
        time = 0.01 * len(poses)
        follower.control(time)
        robot.control(time)
        robot.rigid.predict()
        robot.rigid.integrate()
        poses.append(robot.rigid.base_state(robot.name)[0])
    return np.array(poses)


@pytest.mark.parametrize("backwards", [False, True])
def test_waypoints_are_passed_in_order_with_the_final_heading(backwards: bool):
    robot = Robot(RigidWorld(assemble([])), load_description("vinebot"), "anna")
    points = np.array([[1.0, 0.5], [1.0, 1.5], [0.2, 1.0]])
    follower = WaypointFollower(robot, points, 2.0, reverse=backwards)
    poses = drive(follower)
    assert follower.is_done
    distance = np.linalg.norm(poses[:, None, :2] - points, axis=-1)
    assert (distance.min(0) < 0.015).all()
    assert (np.diff(distance.argmin(0)) > 0).all()
    assert heading(poses[-1]) == pytest.approx(2.0, abs=0.02)
    # straight between the points, with the heading along each leg or opposite to it
    leg = poses[distance[:, 0].argmin() + 1 : distance[:, 1].argmin(), :2]
    assert np.abs(leg[:, 0] - 1.0).max() < 0.03
    middle = poses[int(0.5 * (distance[:, 0].argmin() + distance[:, 1].argmin()))]
    assert np.cos(heading(middle) - (-1.0 if backwards else 1.0) * np.pi / 2) > 0.99


def test_a_base_keeps_its_speed_limits():
    robot = Robot(RigidWorld(assemble([])), load_description("vinebot"), "anna")
    poses = drive(WaypointFollower(robot, np.array([[2.0, 0.0]]), 1.0, speed=0.4, turn_rate=0.3))
    assert np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).max() / 0.01 < 1.1 * 0.4
    assert np.abs(np.diff([heading(pose) for pose in poses])).max() / 0.01 < 1.1 * 0.3


def test_a_base_stops_at_an_obstacle():
    wall = {"fixed_start": [[1.0, 0.0, -0.3]], "fixed_end": [[1.0, 0.0, 2.0]], "fixed_radius": [[0.1, 0.1]]}
    robot = Robot(
        RigidWorld(assemble([], **wall)), load_description("vinebot"), "anna", pose=frames.pose([0.0, 0.0, 0.0])
    )
    follower = WaypointFollower(robot, np.array([[2.0, 0.0]]))
    poses = drive(follower, 30.0)
    assert follower.is_stuck
    assert not follower.is_done
    assert poses[-1][0] < 1.0
    assert len(poses) > 100 * STUCK_TIMEOUT
