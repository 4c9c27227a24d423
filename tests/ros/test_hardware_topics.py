"""A plain node as the topic-based hardware of a controller_manager: its commands move the robot, by its own gains.

The node does what ``JointStateTopicSystem`` does: it takes the newest state (best effort), and publishes a command for
all its joints, with NaN for interfaces that a joint does not have.
"""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import math
import os

import numpy as np
import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState

from tests.support.contact_scenes import cane
from tests.support.stock_node import StockNode, wait_until
from vinesim.client.client import Client
from vinesim.client.tasks.ros_command_handler import RosCommandHandler
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.controllers import only_hardware
from vinesim.robot.description.loader import load_description
from vinesim.ros.robot_node import RobotNode
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene

ARM = [f"arm_left_{i}_joint" for i in range(1, 8)]
EFFORT = "head_1_joint"
"""The joint that the node moves by efforts."""
VELOCITY = "torso_lift_joint"
NAMES = [*ARM, EFFORT, VELOCITY]
STIFFNESS, DAMPING = 30.0, 6.0
"""The node's own gains of the joint that it moves by efforts [N m/rad, N m s/rad]."""
GOAL = 0.3
"""Of that joint [rad]."""
NAN = math.nan


class TopicBasedSystem:
    """The node's read and write, once for each state that it receives."""

    def __init__(self, peer: StockNode, arm: np.ndarray) -> None:
        self.state: JointState | None = None
        self.states = 0
        self.arm = arm
        self.lift = 0.0
        peer.node.create_subscription(JointState, "/robot_joint_states", self.read, qos_profile_sensor_data)
        self.commands = peer.node.create_publisher(JointState, "/robot_joint_commands", 1)

    def of(self, part: str, joint: str) -> float:
        assert self.state is not None
        return getattr(self.state, part)[self.state.name.index(joint)]

    def read(self, message: JointState) -> None:
        self.state = message
        self.states += 1
        effort = STIFFNESS * (GOAL - self.of("position", EFFORT)) - DAMPING * self.of("velocity", EFFORT)
        self.commands.publish(
            JointState(
                name=NAMES,
                position=[*self.arm, NAN, NAN],
                velocity=[*[NAN] * len(ARM), NAN, self.lift],
                effort=[*[NAN] * len(ARM), effort, NAN],
            )
        )


@pytest.fixture
def client() -> Client:
    """One vinebot without controllers, far from a single cane."""
    scene = load_scene("demo")
    vinebot = only_hardware(load_description("vinebot"))
    model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
    return Client(scene, model, vinebot, MemoryHub().bus("robot"), name="robot", pose=spawn_pose(scene, 0))


def test_another_controller_manager_moves_the_robot_by_its_own_gains(client, monkeypatch, tmp_path):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    robot = client.robot
    urdf = robot.description.urdf
    with (
        RobotNode("robot", urdf, base=robot.description.base, controllers=robot.description.controllers) as node,
        StockNode() as peer,
    ):
        client.pre_step.append(RosCommandHandler(robot, node.commands))
        client.post_step.append(lambda c: node.publish_robot_state(robot.sample(c.physics.time, c.physics.contacts)))
        home = robot.rigid.joint_measurements("robot")[0][robot.joint_indices(ARM)]
        system = TopicBasedSystem(peer, home + 0.1)
        topics = dict(peer.node.get_topic_names_and_types())
        assert "/arm_left_controller/joint_trajectory" not in topics
        wait_until(system.commands.get_subscription_count, peer.spin, "the subscriber of commands")
        wait_until(lambda: node.has_subscribers("robot_joint_states"), peer.spin, "states")

        def step() -> None:
            client.tick()
            peer.spin()

        wait_until(lambda: system.state, step, "the first state")
        assert list(system.state.name) == list(robot.description.joints)
        wait_until(lambda: abs(system.of("position", EFFORT) - GOAL) < 0.01, step, "the node's own gains at the goal")
        wait_until(
            lambda: (
                max(abs(system.of("position", joint) - goal) for joint, goal in zip(ARM, system.arm, strict=True))
                < 0.01
            ),
            step,
            "the positions",
        )
        before = system.of("position", VELOCITY)
        system.lift = 0.05
        wait_until(lambda: system.of("position", VELOCITY) > before + 0.03, step, "the lift by a velocity")
        assert node.refused_commands == 0

        for wrong in (
            JointState(name=["no_such_joint"], position=[0.0]),
            JointState(name=[EFFORT, VELOCITY], position=[0.0]),
            JointState(name=[EFFORT], position=[math.inf]),
            JointState(name=[EFFORT, EFFORT], position=[0.0, 0.0]),
        ):
            refused = node.refused_commands
            system.commands.publish(wrong)
            wait_until(lambda before=refused: node.refused_commands == before + 1, step, "a refusal")
        wait_until(lambda: abs(system.of("position", EFFORT) - GOAL) < 0.01, step, "what is refused moves nothing")
