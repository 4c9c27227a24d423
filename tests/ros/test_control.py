"""F55: messages of a stock ROS node move the joints and the base of a real client, which tells ROS of it."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import json
import os
import time

import numpy as np
import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from geometry_msgs.msg import TwistStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, ColorRGBA, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from tests.support.contact_scenes import cane
from tests.support.stock_node import StockNode, wait_until
from vinesim.client.client import Client
from vinesim.client.tasks.ros_command_handler import RosCommandHandler
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.ros.robot_node import RobotNode
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene
from vinesim.scene.values import HandGestures, Intention, LightPattern, Lights

GOAL = 0.4
"""Of the head's first joint [rad]."""


@pytest.fixture
def client() -> Client:
    """One vinebot far from a single cane."""
    scene = load_scene("demo")
    vinebot = load_description("vinebot")
    model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
    return Client(scene, model, vinebot, MemoryHub().bus("robot"), name="robot", pose=spawn_pose(scene, 0))


def test_a_trajectory_moves_a_joint_and_a_velocity_the_base(client, monkeypatch, tmp_path):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    robot = client.robot
    head = robot.description.joints.index("head_1_joint")
    received: list[JointState] = []
    played: list[bytes] = []

    def head_of(message: JointState) -> float:
        return message.position[message.name.index("head_1_joint")]

    with (
        RobotNode(
            "robot", robot.description.urdf, base=robot.description.base, controllers=robot.description.controllers
        ) as node,
        StockNode() as peer,
    ):
        client.pre_step.append(RosCommandHandler(robot, node.commands, play=played.append))
        client.post_step.append(lambda c: node.publish_robot_state(robot.sample(c.physics.time, c.physics.contacts)))
        peer.node.create_subscription(JointState, "/joint_states", received.append, 10)
        arm = peer.node.create_publisher(JointTrajectory, "/head_controller/joint_trajectory", 10)
        wheels = peer.node.create_publisher(TwistStamped, "/mobile_base_controller/cmd_vel", 10)
        wait_until(lambda: arm.get_subscription_count() and wheels.get_subscription_count(), peer.spin, "subscribers")
        wait_until(lambda: node.has_subscribers("joint_states"), peer.spin, "joint_states")

        def step() -> None:
            client.tick()
            peer.spin()

        wait_until(lambda: received, step, "the first joint state")
        assert abs(head_of(received[-1])) < 0.05
        point = JointTrajectoryPoint(positions=[GOAL])
        point.time_from_start.sec = 1
        arm.publish(JointTrajectory(joint_names=["head_1_joint"], points=[point]))
        wait_until(
            lambda: abs(robot.rigid.joint_measurements("robot")[0][head] - GOAL) < 0.02, step, "the joint at its goal"
        )
        wait_until(lambda: abs(head_of(received[-1]) - GOAL) < 0.02, step, "its joint state")

        start = robot.rigid.base_state("robot")[0][:2].copy()
        forward = TwistStamped()
        forward.twist.linear.x = 0.5

        def drive() -> None:
            wheels.publish(forward)
            step()
            time.sleep(0.01)

        wait_until(
            lambda: np.linalg.norm(robot.rigid.base_state("robot")[0][:2] - start) > 0.1, drive, "the base on its way"
        )

        # F40, F49: lights by command and colour; intentions, latched
        pattern = peer.node.create_publisher(String, "/indicator_lights/command", 10)
        color = peer.node.create_publisher(ColorRGBA, "/indicator_lights/color", 10)
        wait_until(lambda: pattern.get_subscription_count() and color.get_subscription_count(), step, "lights")
        pattern.publish(String(data="warning"))
        wait_until(lambda: robot.lights == Lights(LightPattern.WARNING, (255, 150, 0)), step, "the usual colour")
        color.publish(ColorRGBA(r=0.0, g=1.0, b=0.0, a=1.0))
        wait_until(lambda: robot.lights == Lights(LightPattern.WARNING, (0, 255, 0)), step, "green")
        sound = peer.node.create_publisher(Bool, "/indicator_lights/sound", 10)
        wait_until(sound.get_subscription_count, step, "the sound of lights")
        sound.publish(Bool(data=True))
        wait_until(lambda: robot.lights == Lights(LightPattern.WARNING, (0, 255, 0), True), step, "they sound")
        refused = node._commands.rejected
        pattern.publish(String(data="disco"))
        wait_until(lambda: node._commands.rejected == refused + 1, step, "a refusal")
        pattern.publish(String(data="off"))
        wait_until(lambda: robot.lights.pattern == LightPattern.OFF, step, "lights off")

        # F37, F38, F97: sound as audio_common has it
        from audio_common_msgs.msg import AudioData, AudioDataStamped, AudioInfo

        loudspeaker = peer.node.create_publisher(AudioData, "/speaker/audio", 10)
        wait_until(loudspeaker.get_subscription_count, step, "the loudspeaker")
        loudspeaker.publish(AudioData(data=b"odd"))
        wait_until(lambda: node._commands.rejected == refused + 2, step, "a refusal")
        loudspeaker.publish(AudioData(data=bytes(range(8))))
        wait_until(lambda: played == [bytes(range(8))], step, "what is to be played")
        plain = []
        stamped = []
        facts = []
        peer.node.create_subscription(AudioData, "/audio", plain.append, 10)
        peer.node.create_subscription(AudioDataStamped, "/audio_stamped", stamped.append, 10)
        peer.node.create_subscription(
            AudioInfo, "/audio_info", facts.append, QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        )
        wait_until(lambda: node.has_subscribers("audio") and node.has_subscribers("audio_stamped"), step, "listeners")
        node.publish_sound(12.5, bytes(range(200)))
        wait_until(lambda: plain and stamped and facts, step, "what the microphone hears")
        assert bytes(plain[0].data) == bytes(stamped[0].audio.data) == bytes(range(200))
        assert (stamped[0].header.stamp.sec, stamped[0].header.stamp.nanosec) == (12, 500_000_000)
        assert (facts[0].channels, facts[0].sample_rate, facts[0].sample_format) == (1, 16_000, "S16LE")

        node.publish_intentions([Intention("anna", "pick", 2.0)])
        node.publish_gestures(2.5, [HandGestures("anna", "open_hand", "point")])
        heard: list[String] = []
        shown: list[String] = []
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        peer.node.create_subscription(String, "/human_intention", heard.append, latched)
        peer.node.create_subscription(String, "/human_gesture", shown.append, latched)
        wait_until(lambda: heard and shown, step, "the latched intention and gesture")
        events: list[String] = []
        peer.node.create_subscription(String, "/vine/events", events.append, 10)
        wait_until(lambda: node.has_subscribers("vine/events"), step, "a listener of events")
        node.publish_events(3.5, [{"event": "blade", "outcome": "stalled"}, {"event": "detached", "bunch": 4}])
        wait_until(lambda: len(events) == 2, step, "both events")
        assert [json.loads(event.data) for event in events] == [
            {"time": 3.5, "event": "blade", "outcome": "stalled"},
            {"time": 3.5, "event": "detached", "bunch": 4},
        ]
        assert json.loads(shown[0].data) == {
            "time": 2.5,
            "people": [{"person": "anna", "left": "open_hand", "right": "point"}],
        }
        assert json.loads(heard[0].data) == {
            "people": [{"person": "anna", "intention": "pick", "start": 2.0, "end": None}]
        }
