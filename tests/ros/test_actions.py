"""Actions as MoveIt and a person at a shell send them: a stock client in ROS, the real controllers simulated."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator

import numpy as np
import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from tests.support.contact_scenes import cane
from tests.support.stock_node import TIMEOUT, StockNode, wait_until
from vinesim.bench.goal_sender import wait_until_forgotten
from vinesim.client.client import Client
from vinesim.client.tasks.ros_command_handler import RosCommandHandler
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.ros.commands import actions
from vinesim.ros.commands.actions import ControllerActions
from vinesim.ros.commands.subscriptions import CommandQueue
from vinesim.ros.commands.types import GoalResult
from vinesim.ros.commands.types import GoalStatus as StatusOfGoal
from vinesim.ros.messages import message_packages
from vinesim.ros.robot_node import RobotNode
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene
from vinesim.scene.values import ControllerKind, ControllerSpec, JointReference

HEAD = ("head_1_joint", "head_2_joint")


class RobotInRos:
    """A vinebot far from a single cane with its ROS node, and a stock peer; time passes in :meth:`step`."""

    def __init__(self) -> None:
        message_packages.ensure_importable(["control_msgs"])
        scene = load_scene("demo")
        model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
        self.client = Client(
            scene, model, load_description("vinebot"), MemoryHub().bus("robot"), name="robot", pose=spawn_pose(scene, 0)
        )
        robot = self.client.robot
        self.node = RobotNode("robot", robot.description.urdf, controllers=robot.description.controllers)
        self.peer = StockNode()
        self.handler = RosCommandHandler(robot, self.node.commands, self.node.finish_goal)
        self.client.pre_step.append(self.handler)
        self.client.post_step.append(self._publish)

    def _publish(self, client: Client) -> None:
        controllers = self.handler.controllers
        sample = client.robot.sample(client.physics.time, body_sensors=False)
        reference = JointReference(controllers.desired.copy(), controllers.desired_velocity.copy())
        self.node.publish_robot_state(dataclasses.replace(sample, reference=reference))

    def step(self) -> None:
        self.client.tick()
        for _ in range(3):
            self.peer.spin(0.0)

    def wait(self, condition, name: str) -> None:
        wait_until(condition, self.step, name)

    def connect(self, action: type, name: str) -> ActionClient:
        found = ActionClient(self.peer.node, action, name)
        self.wait(found.server_is_ready, name)
        return found

    def send(self, to: ActionClient, goal, feedback=None):
        """The goal's handle, None if it is refused."""
        future = to.send_goal_async(goal, feedback_callback=feedback)
        self.wait(future.done, "an answer")
        return future.result() if future.result().accepted else None

    def result(self, handle):
        """Status and result of a goal."""
        future = handle.get_result_async()
        self.wait(future.done, "a result")
        return future.result().status, future.result().result

    def head(self) -> np.ndarray:
        robot = self.client.robot
        return robot.rigid.joint_measurements(robot.name)[0][robot.joint_indices(HEAD)]


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Iterator[RobotInRos]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("log")))
        found = RobotInRos()
        with found.node, found.peer:
            yield found


def swing(target: list[float], seconds: float = 1.0, velocities: list[float] | None = None):
    """A goal of one point for the head."""
    from control_msgs.action import FollowJointTrajectory

    point = JointTrajectoryPoint(positions=target, velocities=velocities or [])
    point.time_from_start.sec, point.time_from_start.nanosec = divmod(round(seconds * 1e9), 10**9)
    return FollowJointTrajectory.Goal(trajectory=JointTrajectory(joint_names=list(HEAD), points=[point]))


@pytest.fixture(scope="module")
def head(world: RobotInRos) -> ActionClient:
    from control_msgs.action import FollowJointTrajectory

    return world.connect(FollowJointTrajectory, "/head_controller/follow_joint_trajectory")


def test_a_goal_is_reached_with_feedback(world: RobotInRos, head: ActionClient) -> None:
    """The joints arrive, feedback says where they are and should be, the result is SUCCESSFUL."""
    heard = []
    handle = world.send(head, swing([0.3, -0.2]), lambda message: heard.append(message.feedback))
    status, result = world.result(handle)
    assert (status, result.error_code, result.error_string) == (GoalStatus.STATUS_SUCCEEDED, 0, "")
    np.testing.assert_allclose(world.head(), [0.3, -0.2], atol=0.01)
    assert len(heard) >= 5
    assert list(heard[-1].joint_names) == list(HEAD)
    assert heard[-1].desired.positions[0] == pytest.approx(0.3, abs=0.1)
    np.testing.assert_allclose(
        heard[-1].error.positions, np.subtract(heard[-1].desired.positions, heard[-1].actual.positions), atol=1e-12
    )


def test_cancel_preempt_and_refusal(world: RobotInRos, head: ActionClient) -> None:
    """A cancelled goal is CANCELED and its joints stop; a newer goal aborts the older; nonsense is refused at once."""
    before = world.node._commands.rejected
    handle = world.send(head, swing([-0.4, 0.2], seconds=4.0))
    for _ in range(30):
        world.step()
    answer = handle.cancel_goal_async()
    world.wait(answer.done, "the cancel's answer")
    status, _ = world.result(handle)
    assert status == GoalStatus.STATUS_CANCELED
    stopped = world.head()
    for _ in range(50):
        world.step()
    np.testing.assert_allclose(world.head(), stopped, atol=0.01)

    older = world.send(head, swing([0.4, 0.2], seconds=4.0))
    newer = world.send(head, swing([0.0, 0.0]))
    status, result = world.result(older)
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, -1)
    assert "newer" in result.error_string
    assert world.result(newer)[0] == GoalStatus.STATUS_SUCCEEDED

    wrong = swing([0.1, 0.1])
    wrong.trajectory.joint_names = ["head_1_joint", "arm_left_1_joint"]
    assert world.send(head, wrong) is None
    assert world.send(head, swing([float("nan"), 0.0])) is None
    assert world.node._commands.rejected == before + 2


def test_tolerances_and_velocities_are_honoured(world: RobotInRos, head: ActionClient) -> None:
    """What the drives cannot follow violates the path's tolerance; given velocities shape the path."""
    from control_msgs.msg import JointTolerance

    fast = swing([1.0, 0.0], seconds=0.05)
    fast.path_tolerance = [JointTolerance(name=HEAD[0], position=0.02)]
    status, result = world.result(world.send(head, fast))
    assert (status, result.error_code) == (GoalStatus.STATUS_ABORTED, -4)
    assert result.error_string.startswith("head_1_joint is off by")

    world.result(world.send(head, swing([0.0, 0.0])))
    goal = swing([0.2, 0.0], seconds=1.0, velocities=[0.0, 0.0])
    halfway = JointTrajectoryPoint(positions=[0.0, 0.0], velocities=[0.4, 0.0])
    halfway.time_from_start.nanosec = 500_000_000
    goal.trajectory.points.insert(0, halfway)
    speeds = []
    handle = world.send(head, goal, lambda message: speeds.append(message.feedback.desired.velocities[0]))
    assert world.result(handle)[0] == GoalStatus.STATUS_SUCCEEDED
    assert max(speeds) > 0.35  # a straight line from 0 to 0.2 would never ask for more than 0.4 after standing still
    assert min(speeds) < -0.05  # the spline first swings back, to be at 0 with 0.4 rad/s


def test_forward_controllers_move_joints_by_position_velocity_and_effort(world: RobotInRos) -> None:
    """F83 over ROS: one value a joint in the order of joint_states, NaN leaves the others alone; a joint obeys the
    controller that was commanded last."""
    robot = world.client.robot
    count = len(robot.description.joints)
    head = robot.joint_indices(HEAD)[0]
    publishers = {
        kind: world.peer.node.create_publisher(Float64MultiArray, f"/forward_{kind}_controller/commands", 10)
        for kind in ("position", "velocity", "effort")
    }
    world.wait(lambda: all(one.get_subscription_count() for one in publishers.values()), "three controllers")

    def command(kind: str, value: float) -> None:
        values = np.full(count, np.nan)
        values[head] = value
        publishers[kind].publish(Float64MultiArray(data=values.tolist()))

    def moved(least: float, most: float):
        return lambda: least < world.head()[0] < most

    others = robot.rigid.joint_measurements(robot.name)[0].copy()
    command("position", 0.3)
    world.wait(moved(0.29, 0.31), "the position")
    command("velocity", -0.5)
    world.wait(moved(-np.inf, 0.1), "a motion back")
    velocity = robot.rigid.joint_measurements(robot.name)[1][head]
    assert velocity == pytest.approx(-0.5, abs=0.05)
    command("effort", 2.0)
    world.wait(lambda: robot.rigid.joint_measurements(robot.name)[1][head] > 0.1, "the effort to turn it round")
    command("position", 0.0)
    world.wait(moved(-0.01, 0.01), "the position again")
    after = robot.rigid.joint_measurements(robot.name)[0]
    rest = [i for i, name in enumerate(robot.description.joints) if name not in HEAD]
    np.testing.assert_allclose(after[rest], others[rest], atol=0.01)


def test_gripper_and_cutter(world: RobotInRos) -> None:
    """The gripper closes to its goal; the cutter finds nothing between its blades: no effort, not stalled."""
    from control_msgs.action import GripperCommand

    gripper = world.connect(GripperCommand, "/gripper_left_controller/gripper_cmd")
    goal = GripperCommand.Goal()
    goal.command.position = 0.03
    status, result = world.result(world.send(gripper, goal))
    assert (status, result.reached_goal, result.stalled) == (GoalStatus.STATUS_SUCCEEDED, True, False)
    assert result.position == pytest.approx(0.03, abs=3e-3)
    cutter = world.connect(GripperCommand, "/cutter_left_controller/gripper_cmd")
    status, result = world.result(world.send(cutter, GripperCommand.Goal()))
    assert (status, result.reached_goal, result.stalled, result.effort) == (GoalStatus.STATUS_SUCCEEDED, True, False, 0)


def test_many_goals_leave_no_handle_behind(world: RobotInRos, head: ActionClient) -> None:
    """Random goals, cancels and preemptions: each ends with its code, and the servers keep none."""
    random = np.random.default_rng(5)
    for number in range(12):
        target = random.uniform(-0.3, 0.3, 2)
        handle = world.send(head, swing(target.tolist(), seconds=0.3))
        if number % 4 == 3:
            handle.cancel_goal_async()
            assert world.result(handle)[0] in (GoalStatus.STATUS_CANCELED, GoalStatus.STATUS_SUCCEEDED)
        elif number % 4 == 2:
            newer = world.send(head, swing([0.0, 0.0], seconds=0.2))
            assert world.result(handle)[0] in (GoalStatus.STATUS_ABORTED, GoalStatus.STATUS_SUCCEEDED)
            assert world.result(newer)[0] == GoalStatus.STATUS_SUCCEEDED
        else:
            assert world.result(handle)[0] == GoalStatus.STATUS_SUCCEEDED
            np.testing.assert_allclose(world.head(), target, atol=0.02)
    assert not world.node.has_goals


def test_servers_forget_every_goal_that_has_ended(world: RobotInRos, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reached, cancelled and aborted goals are unknown to the server some time after their end."""
    from control_msgs.action import FollowJointTrajectory

    monkeypatch.setattr(actions, "RESULT_TIMEOUT", 1)
    spec = ControllerSpec("short_memory_controller", ControllerKind.JOINT_TRAJECTORY, HEAD)
    with StockNode() as server:
        served = ControllerActions(server.node, [spec], CommandQueue())
        client = ActionClient(server.node, FollowJointTrajectory, f"/{spec.name}/follow_joint_trajectory")

        def done(future):
            wait_until(future.done, lambda: server.spin(0.05), "an answer")
            return future.result()

        wait_until(client.server_is_ready, lambda: server.spin(0.05), spec.name)
        handles = [done(client.send_goal_async(swing([0.1 * i, 0.0]))) for i in range(6)]
        assert len(done(handles[0].cancel_goal_async()).goals_canceling) == 1
        ends = [StatusOfGoal.CANCELED, StatusOfGoal.ABORTED, *[StatusOfGoal.SUCCEEDED] * 4]
        for handle, end in zip(handles, ends, strict=True):
            served.finish(GoalResult(bytes(handle.goal_id.uuid), end, 0))
        assert not served.goals
        known, _ = wait_until_forgotten(lambda handle: done(handle.get_result_async()).status, handles, TIMEOUT)
        assert known == 0
