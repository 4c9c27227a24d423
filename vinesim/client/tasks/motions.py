"""Motions of a robot outside its task: drive to a place, keep the head camera on a point."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vinesim.core import frames
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.scene.values import CameraMount


class DriveTo:
    """Drives the base to a place roughly straight ahead of it and stops there. Call it once in each step."""

    POSITION_TOLERANCE = 0.05
    """[m] Distance at which the base has reached the place. GUESSED"""

    def __init__(
        self, robot: Robot, place: np.ndarray, *, speed: float = 1.2, may_start: Callable[[], object] = lambda: True
    ) -> None:
        """``place`` [7]: pose of the base in the world. The base stands until ``may_start()`` is true."""
        self.robot = robot
        self.speed = speed
        self._may_start = may_start
        self._has_started = False
        self.is_done = False
        self._place = np.asarray(place, float)[:2]

    def __call__(self, time: float) -> None:
        self._has_started = self._has_started or bool(self._may_start())
        if self.is_done or not self._has_started:
            return
        base, _ = self.robot.rigid.base_state(self.robot.name)
        offset = frames.rotate(frames.conjugate(base[3:]), np.append(self._place - base[:2], 0.0))
        distance = float(np.hypot(offset[0], offset[1]))
        if distance < self.POSITION_TOLERANCE or offset[0] < 0.0:
            self.is_done = True
            self.robot.command_base(0.0, 0.0, time)
            return
        turn = float(np.arctan2(offset[1], offset[0]))
        self.robot.command_base(min(self.speed, 0.8 * distance + 0.05), np.clip(2.0 * turn, -0.6, 0.6), time)


class LookAt:
    """Keeps the head camera pointed at a place, by the Jacobian of the robot's head joints. Call it once in each
    step."""

    GAIN = 3.0
    """[1/s] Feedback gain of the pointing angle. GUESSED"""
    PERIOD = 0.05
    """Period of corrections [s]; a head does not need corrections at 100 Hz. GUESSED"""

    def __init__(self, robot: Robot, point: Callable[[], np.ndarray]) -> None:
        """``point()`` returns the place to look at [3] m in the world. A robot without a head camera does nothing."""
        description = robot.description
        self.robot = robot
        self.point = point
        cameras = description.sensors_of(CameraMount.kind)
        self._joints = description.joint_indices("head") if "head" in description.groups and cameras else None
        self._camera = cameras[0].frame if cameras else ""
        self._steps_per_correction = round(self.PERIOD / robot.rigid.dt)
        self._step = 0

    def __call__(self, time: float) -> None:
        self._step += 1
        if self._joints is None or self._step % self._steps_per_correction:
            return
        robot = self.robot
        pose = robot.frame_pose(self._camera)
        axis = frames.rotate(pose[3:], np.array([0.0, 0.0, 1.0]))
        wanted = frames.normalize(self.point() - pose[:3])
        turn = frames.cross(axis, wanted) * self.GAIN
        J = robot.rigid.jacobian(robot.name, self._camera, pose[:3])[3:, self._joints]
        rate = J.T @ np.linalg.solve(J @ J.T + 0.01 * np.eye(3), turn)
        robot.command_position(
            robot.setpoint[self._joints] + self._steps_per_correction * robot.rigid.dt * rate, self._joints
        )
