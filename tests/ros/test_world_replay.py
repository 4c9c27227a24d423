"""A recording of a world as ROS topics: a stock node hears its robot, its clock and its bunches."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import os
import pathlib

import numpy as np
import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from tests.support.stock_node import StockNode, wait_until
from vinesim.cli.replay import _spectator
from vinesim.client.client import Client
from vinesim.client.recording.recorder import Recorder
from vinesim.client.recording.ros_replay import RosReplay
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.codec.control import decode_time, encode_time
from vinesim.net.recording.mcap_reader import read_recording
from vinesim.net.recording.mcap_writer import RecordingWriter
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.ros.messages import message_packages
from vinesim.ros.world_node import WorldNode
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene

EPOCH = 1e6
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def record(path: pathlib.Path) -> tuple[Client, float]:
    """A robot turns its head; the client, and the network time at the end [s]."""
    hub = MemoryHub(delay=0.004)
    server = hub.bus("server", live=False)
    server.declare_queryable("clock/*", lambda asked: encode_time(decode_time(asked)[0], EPOCH + hub.time))
    scene = load_scene("demo")
    client = Client(
        scene,
        generate(scene),
        load_description("vinebot"),
        hub.bus("picker"),
        name="picker",
        pose=spawn_pose(scene, 0),
        clock=lambda: hub.time,
    )
    with RecordingWriter(path) as recording:
        recorder = Recorder(hub.bus("recorder", live=False), recording, clock=lambda: hub.time, everything=True)
        client.robot.command_position([0.4], ["head_1_joint"])
        for _ in range(150):
            hub.advance(0.01)
            client.tick()
            recorder.step()
    return client, EPOCH + hub.time


@pytest.mark.long
def test_a_recorded_world_is_heard_in_ros(tmp_path, monkeypatch) -> None:
    """Joints and frames are those of the recorded robot, the clock is that of the recording, and it never goes back."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    client, ended = record(tmp_path / "run.mcap")
    message_packages.ensure_importable(["tf2_msgs"])
    from tf2_msgs.msg import TFMessage

    spectator, bus = _spectator(read_recording(tmp_path / "run.mcap"), None, None, None, 0.0, None)
    heard: dict[str, list] = {}
    with StockNode() as peer, WorldNode("vinesim_replay") as node:
        for name, message, qos in (
            ("/clock", Clock, 100),
            ("/picker/joint_states", JointState, 100),
            ("/picker/tf", TFMessage, 100),
            ("/picker/robot_description", String, LATCHED),
            ("/picker/tf_static", TFMessage, LATCHED),
            ("/tf_environment", TFMessage, 100),
            ("/tf_environment_static", TFMessage, LATCHED),
        ):
            heard[name] = []
            peer.node.create_subscription(message, name, heard[name].append, qos)
        RosReplay(spectator, node, lambda: bus.time)

        def step() -> None:
            bus.play(0.002)  # slowly: the clock needs a second to find that no other node publishes it
            spectator.tick()
            for _ in range(6):
                peer.spin(0.0)

        wait_until(lambda: bus.ended, step)
        wait_until(
            lambda: all(heard.values()), lambda: (step(), peer.spin(0.05)), str({k: len(v) for k, v in heard.items()})
        )
    times = [m.clock.sec + 1e-9 * m.clock.nanosec for m in heard["/clock"]]
    assert times == sorted(times)
    assert ended - 1.5 < times[-1] <= ended
    last = heard["/picker/joint_states"][-1]
    robot = client.robot
    position = robot.rigid.joint_measurements("picker")[0]
    assert tuple(last.name) == robot.description.joints
    np.testing.assert_allclose(last.position, position, atol=0.02)
    pose = {t.child_frame_id: t for t in heard["/picker/tf"][-1].transforms}["base_footprint"]
    assert pose.header.frame_id == "map"
    place = [getattr(pose.transform.translation, axis) for axis in "xyz"]
    np.testing.assert_allclose(place, robot.rigid.base_state("picker")[0][:3], atol=0.02)
    assert heard["/picker/robot_description"][0].data == robot.description.urdf
    static = {t.child_frame_id for t in heard["/picker/tf_static"][0].transforms}
    assert static == {child for _, child in robot.description.fixed_frames}
    bunches = {t.child_frame_id: t.transform for t in heard["/tf_environment"][-1].transforms}
    assert sum(name.startswith("bunch_") for name in bunches) == len(client.model.bunch_body)
    assert {"box_0", "box_1"} <= bunches.keys()
    first = client.physics.state.body_q[client.model.bunch_body[0]]
    here = [getattr(bunches["bunch_00000"].translation, axis) for axis in "xyz"]
    np.testing.assert_allclose(here, first[:3], atol=0.01)
    assert all(t.child_frame_id.startswith("pole_") for t in heard["/tf_environment_static"][0].transforms)
