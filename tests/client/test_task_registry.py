"""Tasks in a client: planned from the scene, started with its robot, run step by step, without peers."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.client.client import Client
from vinesim.client.tasks import start_poses
from vinesim.client.tasks.harvesting import HarvestByTruth
from vinesim.client.tasks.motions import DriveTo, LookAt
from vinesim.client.tasks.registry import UnknownTask, plan_task
from vinesim.client.tasks.ros_command_handler import MAX_LOGGED, RosCommandHandler
from vinesim.client.vine_events import fruit_report
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.rigid_world import RigidWorld
from vinesim.robot.description.loader import load_description as load_robot
from vinesim.robot.drives.controlled_robot import Robot
from vinesim.robot.tasks.swap_boxes import SwapBoxes
from vinesim.robot.tasks.task import Task
from vinesim.ros.commands.types import BaseVelocity, Command, ForwardCommand, JointTrajectory
from vinesim.scene.builder import assemble
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene

pytestmark = pytest.mark.slow


def client_with(job: str, robot: str, spawn: int) -> tuple[Client, Task]:
    scene = load_scene("harvest")
    model = generate(scene)
    start_task, start = plan_task(job, model, start_poses.spawn_pose(scene, spawn))
    now = iter(range(1_000_000))
    client = Client(
        scene,
        model,
        load_robot(robot),
        MemoryHub().bus("worker"),
        name="worker",
        pose=start,
        clock=lambda: 0.01 * next(now),
    )
    task = start_task(client.physics, client.robot)
    client.pre_step += [task.control, LookAt(client.robot, task.focus)]
    return client, task


def run_to_the_end(client: Client, task: Task) -> Task:
    """Step the client until its task is done; more steps than its timeout has fail."""
    for _ in range(round(task.timeout / client.physics.dt) + 1):
        if task.is_done:
            break
        client.tick()
    assert task.is_done
    assert task.succeeded, task.reason
    return task


def test_a_client_runs_the_pick_task():
    """F51, farming: a bunch is cut, carried to a box and rests in it."""
    client, task = client_with("pick", "vinebot", 0)
    assert isinstance(task, HarvestByTruth)
    while not task.is_done and task.phase != "tuck":
        client.tick()
    assert not task.reason
    pick = task.pick
    assert pick is not None
    assert client.physics.rigid.free_bunches == (pick.plan.bunch,)
    assert task.report()["others_off"] == 0, "the bunch in the hand"
    assert task.report()["phases_s"]["cut"] < 0.3  # the blades of vinebot close in 0.2 s
    run_to_the_end(client, task)
    assert task.report()["picked"] == task.report()["tried"] == 1
    assert task.report()["others_off"] == 0
    fruit = fruit_report(client.physics)  # one attempt: its berries are all that were damaged
    (row,) = task.report()["bunches"]
    assert row["damage"] == round(client.physics.fruit_monitor.history(pick.plan.bunch).damage, 3)
    assert row["berries_burst"] == pytest.approx(fruit["berries_burst"], abs=1e-3)
    assert row["berries_lost"] == pytest.approx(fruit["berries_lost"], abs=1e-3)
    assert task.report()["berries_lost"] == pytest.approx(fruit["berries_lost"], abs=1e-2)
    assert not client.physics.state.bunch_attached[pick.plan.bunch]
    local = frames.compose(frames.inverse(pick.box_pose), pick.bunch_pose)[:3]
    assert (np.abs(local[:2]) < 0.5 * client.physics.model.box_size[pick.plan.box, :2]).all()


def test_a_client_runs_the_exchange_task():
    """F51, logistics: the full box is carried away with its bunches, the empty one takes its place."""
    client, task = client_with("exchange", "logistic", 1)
    assert isinstance(task, SwapBoxes)
    place = task.box_pose(task.plan.full_box)[:2].copy()
    for _ in range(200):
        client.tick()
    assert not task.reason
    assert task.phase == "to the empty box"
    assert len(client.physics.rigid.free_bunches) == task.report()["bunches"] == 6
    run_to_the_end(client, task)
    assert np.linalg.norm(task.box_pose(task.plan.empty_box)[:2] - place) < 0.05
    assert task.box_pose(task.plan.full_box)[2] > 0.1


def test_an_unknown_task_is_refused_with_the_known_ones():
    scene = load_scene("harvest")
    with pytest.raises(UnknownTask, match="no job 'dance'; give pick, exchange, meet or prune"):
        plan_task("dance", generate(scene), start_poses.spawn_pose(scene, 0))


# ---------------------------------------------------------------------- commands by ROS


JOINTS = ("arm_left_1_joint", "arm_left_2_joint")
FAR = np.array([0.6, 0.0])


class CommandedRobot:
    """A robot alone in a world, and a queue of ROS commands for it."""

    def __init__(self) -> None:
        self.robot = Robot(RigidWorld(assemble([])), load_robot("vinebot"), "anna")
        self.queue: list[Command] = []
        self.handle_commands = RosCommandHandler(self.robot, self._take)
        self.time = 0.0
        self.joints = self.robot.joint_indices(JOINTS)

    def _take(self) -> list[Command]:
        commands = self.queue
        self.queue = []
        return commands

    def run(self, seconds: float) -> np.ndarray:
        """Positions [2] of :data:`JOINTS` after ``seconds``."""
        for _ in range(round(100 * seconds)):
            self.handle_commands(self.time)
            self.robot.control(self.time)
            self.robot.rigid.predict()
            self.robot.rigid.integrate()
            self.time += 0.01
        return self.robot.rigid.joint_measurements("anna")[0][self.joints]


def trajectory(
    *positions: tuple[float, float], joints: tuple[str, ...] = JOINTS, seconds: float = 1.0
) -> JointTrajectory:
    times = seconds * np.arange(1.0, len(positions) + 1.0)
    return JointTrajectory("arm_left_controller", 0.0, joints, times, np.reshape(positions, (-1, 2)), None)


def test_a_trajectory_is_linear_between_its_points():
    commanded = CommandedRobot()
    start = commanded.run(0.1)
    first = start + np.array([0.3, -0.2])
    last = start + np.array([0.1, 0.0])
    commanded.queue = [trajectory(first, last)]
    np.testing.assert_allclose(commanded.run(0.5), 0.5 * (start + first), atol=0.01)
    np.testing.assert_allclose(commanded.run(0.5), first, atol=0.01)
    np.testing.assert_allclose(commanded.run(0.5), 0.5 * (first + last), atol=0.01)
    np.testing.assert_allclose(commanded.run(1.5), last, atol=1e-3)


def test_newer_empty_and_position_commands_replace_a_trajectory():
    commanded = CommandedRobot()
    start = commanded.run(0.1)
    commanded.queue = [trajectory(start + FAR, seconds=2.0)]
    middle = commanded.run(1.0)
    commanded.queue = [trajectory(start)]
    np.testing.assert_allclose(commanded.run(1.5), start, atol=1e-3)
    commanded.queue = [trajectory(start + FAR, seconds=2.0)]
    stopped = commanded.run(1.0)
    np.testing.assert_allclose(stopped, middle, atol=0.01)
    commanded.queue = [trajectory()]
    np.testing.assert_allclose(commanded.run(1.0), stopped, atol=0.01)
    setpoint = commanded.robot.setpoint.copy()
    setpoint[commanded.joints] = start
    commanded.queue = [trajectory(start + FAR, seconds=2.0), ForwardCommand("forward_position_controller", setpoint)]
    np.testing.assert_allclose(commanded.run(2.0), start, atol=1e-3)


def test_invalid_commands_are_counted_and_ignored():
    commanded = CommandedRobot()
    start = commanded.run(0.1)
    late = JointTrajectory("arm_left_controller", 0.0, JOINTS, np.array([2.0, 1.0]), np.zeros((2, 2)), None)
    commanded.queue = [
        trajectory(start + 0.2, joints=("arm_left_1_joint", "no_joint")),
        late,
        trajectory(start + np.nan),
    ]
    np.testing.assert_allclose(commanded.run(0.5), start, atol=1e-4)
    assert commanded.handle_commands.rejected_count == 3


def test_the_log_has_each_kind_of_refusal_once(caplog):
    """Whatever values the commands have; every refusal counts."""
    commanded = CommandedRobot()
    commanded.run(0.1)
    missing = ("arm_left_1_joint", "no_joint")
    for value in (0.1, 0.25, -3e-7):
        commanded.queue = [
            BaseVelocity(0.0, np.full(3, np.nan), np.full(3, value)),
            ForwardCommand("no_controller", np.full(2, value)),
            ForwardCommand("forward_position_controller", np.full(round(abs(value) * 10) + 1, value)),
            ForwardCommand("forward_velocity_controller", np.full(2, value)),
            trajectory(np.full(2, value), joints=missing),
            trajectory(np.full(2, value), joints=missing[::-1]),
        ]
        commanded.run(0.01)
    assert commanded.handle_commands.rejected_count == 18
    logged = [record.getMessage() for record in caplog.records]
    assert len(logged) == 6, logged
    assert logged[0] == (
        "refused a command of BaseVelocity, further ones of this kind are only counted: "
        "anna: base velocity is (nan, 0.1); give finite numbers [m/s, rad/s]"
    )
    for number in range(3 * MAX_LOGGED):
        commanded.queue = [ForwardCommand(f"controller_{number}", np.zeros(2))]
        commanded.run(0.01)
    assert len(caplog.records) == MAX_LOGGED
    assert commanded.handle_commands.rejected_count == 18 + 3 * MAX_LOGGED


def test_a_robot_stands_until_it_may_start_and_then_drives_there() -> None:
    """It goes on when the reason to start is gone again."""
    robot = Robot(RigidWorld(assemble([])), load_robot("vinebot"), "anna")
    others: list[str] = []
    drive = DriveTo(robot, frames.pose([2.0, 0.0, 0.0]), may_start=lambda: others)
    times = iter(range(100_000))

    def go(seconds: float) -> float:
        for _ in range(round(100 * seconds)):
            time = 0.01 * next(times)
            drive(time)
            robot.control(time)
            robot.rigid.predict()
            robot.rigid.integrate()
        return float(robot.rigid.base_state("anna")[0][0])

    assert go(1.0) == pytest.approx(0.0, abs=1e-3)
    others.append("bob")
    assert go(0.5) > 0.1
    others.clear()
    assert go(12.0) == pytest.approx(2.0, abs=0.1)
    assert drive.is_done
