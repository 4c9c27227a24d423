"""A sourced ROS 2 of any name: a client uses it, and nodes of this ROS receive the client's messages."""

from __future__ import annotations

import json
import os
import signal
import sys

import pytest

from tests.support.sourced_ros import DISTRIBUTION, SourcedRos
from tests.support.waiting import deadline
from vinesim.core import disk_cache
from vinesim.ros import installation, middleware

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(middleware.unavailable_reason() is not None, reason=str(middleware.unavailable_reason())),
    pytest.mark.skipif(not installation.is_of_wheels(), reason="the stand-in is made of the wheels"),
]

STOCK_NODE = """
import sys, rclpy
from sensor_msgs.msg import JointState
assert "vinesim" not in sys.modules
rclpy.init()
node = rclpy.create_node("stock_node")
heard = []
node.create_subscription(JointState, "/joint_states", heard.append, 10)
while not heard:
    rclpy.spin_once(node)
print(len(heard[0].name), rclpy.get_rmw_implementation_identifier())
rclpy.shutdown()
"""
ASK = "from vinesim.ros import middleware; print(middleware.unavailable_reason())"


@pytest.fixture(scope="module")
def sourced(tmp_path_factory) -> SourcedRos:
    return SourcedRos(tmp_path_factory.mktemp("sourced"))


def test_doctor_names_distribution_folder_and_middleware(sourced):
    done = sourced.run("-m", "vinesim", "doctor", "--json", timeout=deadline(300.0))
    (found,) = [each["found"] for each in json.loads(done.stdout)["checks"] if each["check"] == "ros"]
    assert found.startswith(f"{DISTRIBUTION}, installation in {sourced.prefix}, rmw_fastrtps_cpp, domain ")


def test_a_stock_node_of_the_sourced_ros_hears_a_client(sourced):
    caches = {
        "WARP_CACHE_PATH": os.environ.get("WARP_CACHE_PATH") or str(disk_cache.user_folder() / "warp"),
        "VINESIM_CACHE": str(disk_cache.folder()),
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }
    client = sourced.start("-m", "vinesim", "client", "--role", "robot", "--scene", "demo", **caches)
    try:
        stock = sourced.run("-c", STOCK_NODE, timeout=deadline(400.0), **caches)
        echo = ("-m", "vinesim", "ros", "echo", "/joint_states", "--once", "--field", "name")
        told = sourced.run(*echo, timeout=deadline(), **caches)
    finally:
        client.send_signal(signal.SIGINT)
        _, log = client.communicate(timeout=deadline())
    assert stock.returncode == 0, stock.stderr + log
    joints, rmw = stock.stdout.split()
    assert int(joints) > 10
    assert rmw == "rmw_fastrtps_cpp"
    assert "torso_lift_joint" in told.stdout, told.stderr


def test_a_middleware_that_is_not_installed_is_refused(sourced):
    told = sourced.run("-c", ASK, timeout=deadline(), RMW_IMPLEMENTATION="rmw_zenoh_cpp").stdout
    assert told == (
        f"RMW_IMPLEMENTATION is 'rmw_zenoh_cpp', but the ROS 2 in {sourced.prefix} has only rmw_fastrtps_cpp; "
        f"unset it, or apt install ros-{DISTRIBUTION}-rmw-zenoh-cpp\n"
    )


def test_a_ros_for_another_python_is_named(sourced, tmp_path):
    (tmp_path / "lib" / "python3.99").mkdir(parents=True)
    root = sourced.environment()["PYTHONPATH"].split(os.pathsep)[0]
    told = sourced.run("-c", ASK, timeout=deadline(), AMENT_PREFIX_PATH=str(tmp_path), PYTHONPATH=root).stdout
    own = ".".join(map(str, sys.version_info[:2]))
    assert told == (
        f"the ROS 2 sourced from {tmp_path} has packages for Python 3.99, and this is Python {own} "
        "(No module named 'rclpy'); install vinesim in an environment of Python 3.99\n"
    )


def test_what_is_not_sourced_completely_is_named(sourced, tmp_path):
    root = sourced.environment()["PYTHONPATH"].split(os.pathsep)[0]
    told = sourced.run("-c", ASK, timeout=deadline(), AMENT_PREFIX_PATH=str(tmp_path), PYTHONPATH=root).stdout
    assert told == (
        f"the ROS 2 sourced from {tmp_path} cannot be imported (No module named 'rclpy'); source its setup.bash again\n"
    )


def test_an_overlay_comes_before_what_it_lies_over(tmp_path, monkeypatch):
    for name, version in (("overlay", "2.0.0"), ("underlay", "1.0.0")):
        folder = tmp_path / name / "share" / "my_msgs"
        folder.mkdir(parents=True)
        (folder / "package.xml").write_text(f"<package><version>{version}</version></package>")
    prefixes = os.pathsep.join(str(tmp_path / name) for name in ("overlay", "underlay"))
    monkeypatch.setenv("AMENT_PREFIX_PATH", prefixes)
    assert installation.version("my_msgs") == "2.0.0"
    assert installation.version("other_msgs") == "-"
