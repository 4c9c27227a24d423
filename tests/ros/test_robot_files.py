"""A robot file as it is, from the command line to a stock node: its meshes, its names, its sensors."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import pathlib
import signal
import subprocess
import sys

import pytest
import trimesh
from lxml import etree

from vinesim.ros import middleware

pytestmark = [pytest.mark.ros, pytest.mark.slow]
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from tests.support.stock_node import StockNode, wait_until

LIMIT = '<limit lower="-1" upper="1" effort="30" velocity="1"/>'
BODY = '<inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>'
SHAPE = '<visual><geometry><mesh filename="meshes/part.stl"/></geometry></visual>'
URDF = f"""<robot name="My Arm-v2"><link name="world"/>
<joint name="fix" type="fixed"><parent link="world"/><child link="base-link"/></joint>
<link name="base-link">{BODY}</link><link name="Link 1">{BODY}{SHAPE}</link>
<joint name="Joint-1" type="revolute"><parent link="base-link"/><child link="Link 1"/><axis xyz="0 1 0"/>{LIMIT}</joint>
<link name="base_scan"/><joint name="s" type="fixed"><parent link="base-link"/><child link="base_scan"/></joint>
<gazebo reference="base_scan"><sensor name="scanner" type="gpu_lidar"/></gazebo>
<gazebo reference="base-link"><sensor name="imu" type="imu"/></gazebo></robot>"""


def test_a_stock_node_finds_the_meshes_names_and_sensors_of_a_robot_file(tmp_path: pathlib.Path) -> None:
    """Every link of robot_description has a frame, every moving joint a state, every mesh a file."""
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "meshes" / "part.stl")
    file = tmp_path / "arm.urdf"
    file.write_text(URDF)
    command = ["client", "--role", "robot", "--robot", str(file), "--scene", "vsp", "--status", "none"]
    texts: list[str] = []
    joints: list[str] = []
    frames: set[str] = set()
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)

    def store(message: TFMessage) -> None:
        frames.update(name for one in message.transforms for name in (one.header.frame_id, one.child_frame_id))

    with StockNode() as peer, subprocess.Popen([sys.executable, "-m", "vinesim", *command]) as client:
        try:
            peer.node.create_subscription(String, "robot_description", lambda m: texts.append(m.data), latched)
            peer.node.create_subscription(JointState, "joint_states", lambda m: joints.extend(m.name), 10)
            peer.node.create_subscription(TFMessage, "tf_static", store, latched)
            peer.node.create_subscription(TFMessage, "tf", store, 10)
            wait_until(lambda: texts and joints and {"base_scan", "Link_1"} <= frames, peer.spin, "state and frames")
            wanted = {"/scanner/points", "/scan", "/imu", "/Joint_controller/joint_trajectory"}
            wait_until(
                lambda: wanted <= {name for name, _ in peer.node.get_topic_names_and_types()}, peer.spin, "the sensors"
            )
        finally:
            client.send_signal(signal.SIGINT)
            client.wait()
    robot = etree.fromstring(texts[0])
    links = {link.get("name") for link in robot.iterfind("link")}
    assert links == {"world", "base_link", "Link_1", "base_scan"}
    assert links <= frames
    assert {one.get("name") for one in robot.iterfind("joint[@type='revolute']")} == set(joints) == {"Joint_1"}
    address = robot.find("link/visual/geometry/mesh").get("filename")
    assert address == (tmp_path / "meshes" / "part.stl").resolve().as_uri()
