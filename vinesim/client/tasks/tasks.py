"""What a robot is to do: called every tick with the simulation time, before the drives."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterable

import numpy as np

from vinesim import frames
from vinesim.client.tasks import pick_planning, swap_planning
from vinesim.physics.step import Physics
from vinesim.robot.control.trajectory_controller import Trajectory, TrajectoryController
from vinesim.robot.drives.commands import CommandError
from vinesim.robot.drives.robot import Robot
from vinesim.robot.tasks.pick import PickBunch
from vinesim.robot.tasks.swap_boxes import SwapBoxes, SwapPlan
from vinesim.robot.tasks.task import Task
from vinesim.ros.commands.types import BaseVelocity, Command, JointPositions
from vinesim.scene.model import Model

log = logging.getLogger(__name__)


TASKS = ("pick", "exchange")
"""What :func:`plan_task` knows."""


class UnknownTask(ValueError):
    """A job that no robot here knows; the text says which it knows."""


def validate_task_name(job: str | None) -> str | None:
    """The job, if there is one of that name."""
    if job is not None and job not in TASKS:
        raise UnknownTask(f"no job {job!r}; give {' or '.join(TASKS)}")
    return job


def plan_task(job: str, model: Model, near: np.ndarray) -> tuple[Callable[[Physics, Robot], Task], np.ndarray]:
    """How to begin a job once physics and robot are there, and the pose [7] where the robot starts.

    ``near`` [7]: where it would be otherwise. Planning takes a second or two: not for the tick.
    """
    if validate_task_name(job) == "pick":
        task = next(pick_planning.plan_picks(model, near[:2]))
        return functools.partial(PickBunch, plan=task), task.base_pose
    boxes = swap_planning.plan_swap(model, near)
    return functools.partial(_begin_swap, swap=boxes), near


def _begin_swap(physics: Physics, robot: Robot, swap: SwapPlan) -> SwapBoxes:
    """Fill the box that is to be full, and exchange it."""
    swap_planning.fill_box(physics, swap.full_box)
    return SwapBoxes(physics, robot, swap)


class DriveTo:
    """Drive the base to a place that lies about straight ahead, and stop there."""

    POSITION_TOLERANCE = 0.05
    """This near is there [m]."""

    def __init__(self, robot: Robot, place: np.ndarray, *, speed: float = 1.2) -> None:
        """``place`` [7]: pose of the base in the world."""
        self.robot, self.speed = robot, speed
        self.is_done = False
        self._place = np.asarray(place, float)[:2]

    def __call__(self, time: float) -> None:
        if self.is_done:
            return
        base, _ = self.robot.rigid.base_state(self.robot.name)
        way = frames.rotate(frames.conjugate(base[3:]), np.append(self._place - base[:2], 0.0))
        distance = float(np.hypot(way[0], way[1]))
        if distance < self.POSITION_TOLERANCE or way[0] < 0.0:
            self.is_done = True
            self.robot.command_base(0.0, 0.0, time)
            return
        turn = float(np.arctan2(way[1], way[0]))
        self.robot.command_base(min(self.speed, 0.8 * distance + 0.05), np.clip(2.0 * turn, -0.6, 0.6), time)


class LookAt:
    """Keep the head's camera on a point, whatever the head is made of."""

    GAIN = 3.0
    """Share of the angle that is taken out per second [1/s]."""
    EVERY = 5
    """Ticks between two corrections: a head need not be led at 100 Hz."""

    def __init__(self, robot: Robot, point: Callable[[], np.ndarray]) -> None:
        """``point`` gives the place to look at [3] m in the world. Does nothing without a head and a camera on it."""
        description = robot.description
        self.robot, self.point = robot, point
        self._joints = (
            description.joint_indices("head") if "head" in description.groups and description.cameras else None
        )
        self._camera = description.cameras[0].frame if description.cameras else ""
        self._tick = 0

    def __call__(self, time: float) -> None:
        self._tick += 1
        if self._joints is None or self._tick % self.EVERY:
            return
        robot = self.robot
        pose = robot.frame_pose(self._camera)
        axis = frames.rotate(pose[3:], np.array([0.0, 0.0, 1.0]))
        wanted = frames.normalize(self.point() - pose[:3])
        turn = frames.cross(axis, wanted) * self.GAIN
        J = robot.rigid.jacobian(robot.name, self._camera, pose[:3])[3:, self._joints]
        rate = J.T @ np.linalg.solve(J @ J.T + 0.01 * np.eye(3), turn)
        robot.command_position(robot.setpoint[self._joints] + self.EVERY * robot.rigid.dt * rate, self._joints)


class RosCommandHandler:
    """Do what ROS asks: drive the base, hold joint positions, follow trajectories (straight between their points)."""

    def __init__(self, robot: Robot, commands: Callable[[], Iterable[Command]]) -> None:
        """``commands`` returns what was asked since the last call."""
        self.robot = robot
        self.rejected_count = 0
        """Commands that no joint of this robot can take."""
        self._commands = commands
        self._controllers: dict[str, TrajectoryController] = {}

    def __call__(self, time: float) -> None:
        for command in self._commands():
            try:
                self._apply(command, time)
            except CommandError as error:
                self.rejected_count += 1
                if self.rejected_count == 1:
                    log.warning("refused a command, further ones are only counted: %s", error)
        for controller in self._controllers.values():
            controller(time)

    def _apply(self, command: Command, time: float) -> None:
        robot = self.robot
        if isinstance(command, BaseVelocity):
            robot.command_base(float(command.linear[0]), float(command.angular[2]), time)
        elif isinstance(command, JointPositions):
            for controller in self._controllers.values():
                controller.cancel()
            robot.command_position(command.positions)
        else:
            if command.controller not in self._controllers:
                self._controllers[command.controller] = TrajectoryController(robot, robot.description.joints)
            controller = self._controllers[command.controller]
            if len(command.times):
                way = Trajectory(command.joints, command.times, command.positions, start_time=command.time)
                controller.start(way, time)
            else:
                controller.cancel()
