"""``vinesim ros build-interfaces``: what it leaves is importable by a node that knows nothing of vinesim."""

from __future__ import annotations

import importlib
import json
import os
import pathlib
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from tests.support.waiting import TIMEOUT
from vinesim.core import frames
from vinesim.ros import middleware
from vinesim.ros.messages import message_packages
from vinesim.ros.messages import message_packages as package_build

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(middleware.unavailable_reason() is not None, reason=str(middleware.unavailable_reason())),
]

PACKAGES = ["audio_common_msgs", "control_msgs", "simulation_interfaces", "tf2_msgs", "vision_msgs"]

PUBLISHED = {
    # As generated sources, listings of `ros2 topic info --verbose` and clients without rosidl state them.
    "audio_common_msgs/msg/AudioData": "RIHS01_a9742fba1567e649bbdba6ae034a72c7ef129b97c7a4da50fd2f3e1bfd8ffa86",
    "control_msgs/action/FollowJointTrajectory_FeedbackMessage": (
        "RIHS01_80398fcb9674a79081a9906e2ccf0c804dd7cb15e22e362e606ee87186beab71"
    ),
    "control_msgs/action/FollowJointTrajectory_SendGoal_Request": (
        "RIHS01_179c93691f1f6d1d115881ff88c3917b7cc6eac2ba4bf56766cc7c4389e19ef1"
    ),
    "control_msgs/action/GripperCommand_FeedbackMessage": (
        "RIHS01_392ff03fcd872f9dc2405cbeb2897fcf011ad9998458b6aa85c603b8a49e431d"
    ),
    "control_msgs/msg/JointTrajectoryControllerState": (
        "RIHS01_51d8dd89cc624cbe9daaeeb4d80d6de9b86168ffdc3be41fefc0953e3c26e480"
    ),
    "simulation_interfaces/msg/Result": "RIHS01_cf43a306adff3337a0a47143d8f5689933bc70a30478f13b077dc1fe3bc5ad17",
    "tf2_msgs/msg/TFMessage": "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "vision_msgs/msg/Detection3D": "RIHS01_ddd703be132ab0b69d33121f1bb034132bfbb3b0ac5f9fb1516005ba1c8a265b",
    "vision_msgs/msg/Detection3DArray": "RIHS01_793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018",
}

FROM_OFFICIAL_DEFINITIONS = json.loads(pathlib.Path(__file__).with_name("type_hashes.json").read_text())
"""What rosidl makes of the official definitions: control_msgs 5.8.0 (jazzy), vision_msgs 4.1.1, simulation_interfaces
1.5.1 (jazzy), audio_common_msgs of ros-drivers (ros2)."""

USERS_NODE = """
import sys, rclpy
from control_msgs.action import FollowJointTrajectory
from rclpy.qos import DurabilityPolicy, QoSProfile
from simulation_interfaces.srv import GetSimulatorFeatures
from tf2_msgs.msg import TFMessage
from vision_msgs.msg import Detection3DArray
assert "vinesim" not in sys.modules
rclpy.init()
node = rclpy.create_node("users_node")
heard = []
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(TFMessage, "/tf_static", heard.append, latched)
while not heard:
    rclpy.spin_once(node)
print(heard[0].transforms[0].child_frame_id)
rclpy.shutdown()
"""


def run(arguments: list[str], place: pathlib.Path) -> str:
    """What ``vinesim ros build-interfaces`` prints; pip installs into ``place``, which is on its path."""
    path = os.pathsep.join([str(pathlib.Path(__file__).parents[2]), str(place)])
    told = subprocess.run(
        [sys.executable, "-c", "from vinesim.cli import main; main()", "ros", "build-interfaces", *arguments],
        env=os.environ | {"PYTHONPATH": path, "PIP_TARGET": str(place)},
        capture_output=True,
        text=True,
        timeout=5 * TIMEOUT,
        check=False,
    )
    assert told.returncode == 0, told.stderr
    return told.stdout


def test_every_type_has_the_official_hash():
    hashes = {}
    for package, place in message_packages.build(PACKAGES).items():
        hashes |= json.loads((place / package / package_build.MARK).read_text())["type_hashes"]
    assert hashes == FROM_OFFICIAL_DEFINITIONS
    assert {name: hashes[name] for name in PUBLISHED} == PUBLISHED


def test_a_users_node_imports_the_packages_and_hears_vinesim(tmp_path, monkeypatch):
    from vinesim.ros.robot_node import RobotNode

    told = run([], tmp_path)
    assert [line.split(":")[0] for line in told.splitlines()] == PACKAGES
    assert "control_msgs: installed; pip uninstall vinesim-control-msgs removes it" in told.splitlines()
    assert run([], tmp_path) == told

    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    imu = ("base_link", "imu_link", frames.pose(np.zeros(3)))
    with RobotNode("vinebot", "<robot name='vinebot'/>", static_transforms=[imu]):
        heard = subprocess.run(
            [sys.executable, "-c", USERS_NODE],
            env=os.environ | {"PYTHONPATH": str(tmp_path)},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=TIMEOUT,
            check=False,
        )
    assert heard.stdout == "imu_link\n", heard.stderr


def test_wheels_hold_the_packages_and_the_official_package_wins(tmp_path):
    official = tmp_path / "official" / "control_msgs"
    official.mkdir(parents=True)
    (official / "__init__.py").write_text("")
    told = run(["--wheel", str(tmp_path / "wheels")], official.parent)
    assert f"control_msgs: the official one is there, {official}" in told.splitlines()
    wheels = sorted((tmp_path / "wheels").iterdir())
    assert [wheel.name.split("-")[0] for wheel in wheels] == [
        f"vinesim_{package}" for package in PACKAGES if package != "control_msgs"
    ]
    with zipfile.ZipFile(wheels[-1]) as archive:
        assert {"vision_msgs/__init__.py", "vision_msgs/msg/_detection3_d.py"} <= set(archive.namelist())


def test_a_missing_package_of_a_sourced_ros_names_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    with pytest.raises(message_packages.InterfacesError, match=r"/opt/ros/jazzy; apt install ros-jazzy-control-msgs$"):
        message_packages.build(["control_msgs"])


def test_what_an_older_vinesim_installed_is_not_used(tmp_path, monkeypatch):
    old = tmp_path / "tf2_msgs"
    old.mkdir()
    (old / "__init__.py").write_text("")
    (old / package_build.MARK).write_text(json.dumps({"key": "of an older vinesim", "type_hashes": {}}))
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    monkeypatch.delitem(sys.modules, "tf2_msgs", raising=False)
    assert message_packages.place_of_official("tf2_msgs") is None
    assert not message_packages.is_installed("tf2_msgs")
