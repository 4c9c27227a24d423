"""Whether ROS can be used, and why not."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest

from tests.support.waiting import deadline
from vinesim.ros import installation, middleware

WHEELS = importlib.util.find_spec("ros_wheels_bootstrapper") is not None
wheels_only = pytest.mark.skipif(not WHEELS, reason="ROS 2 is not installed as wheels: pip install 'vinesim[ros]'")
VARIABLE, ENDING = {
    2: ("FASTRTPS_DEFAULT_PROFILES_FILE", ".xml"),
    3: ("FASTDDS_DEFAULT_PROFILES_FILE", "_fast_dds_3.xml"),
}[installation.fast_dds_version()]
"""Variable with the profile of the Fast DDS that is installed, and the end of the names of its profiles."""


def profiles() -> dict[str, str]:
    """The variables with profiles that are set."""
    return {name: os.environ[name] for name in middleware.PROFILE_VARIABLES if name in os.environ}


@pytest.mark.ros
@wheels_only
def test_wheels_beside_a_sourced_ros_are_refused(monkeypatch):
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy:/srv/ws")
    assert "sourced from /opt/ros/jazzy as well" in str(middleware.unavailable_reason())
    with pytest.raises(middleware.RosUnavailableError, match="nothing is sourced"):
        middleware.configure()


@pytest.mark.ros
@wheels_only
def test_wheels_without_their_library_path_are_refused(monkeypatch):
    monkeypatch.setenv("LD_LIBRARY_PATH", "/usr/lib")
    assert "could not set LD_LIBRARY_PATH" in str(middleware.unavailable_reason())


@pytest.mark.ros
@wheels_only
def test_a_middleware_that_the_wheels_lack_is_refused(monkeypatch):
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    assert str(middleware.unavailable_reason()) == (
        "RMW_IMPLEMENTATION is 'rmw_cyclonedds_cpp', but the ROS 2 wheels have only rmw_fastrtps_cpp; unset it"
    )


def test_without_ros_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)

    def missing(name: str):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(importlib, "import_module", missing)
    assert middleware.unavailable_reason() == (
        "ROS 2 is missing (No module named 'rclpy.node'); pip install 'vinesim[ros]', or source a ROS 2 installation"
    )


@pytest.mark.ros
@wheels_only
def test_the_profile_is_set_unless_the_user_has_chosen(monkeypatch):
    for each in middleware.PROFILE_VARIABLES:
        monkeypatch.delenv(each, raising=False)
    monkeypatch.setenv(middleware.RANGE_VARIABLE, "SUBNET")
    middleware.configure()
    assert profiles()[VARIABLE].endswith(f"/shared_memory{ENDING}")
    assert os.environ[middleware.RANGE_VARIABLE] == "SUBNET"
    middleware.configure(large_messages=False)
    middleware.configure()  # as every node does
    assert profiles()[VARIABLE].endswith(f"/udp{ENDING}")
    middleware.clear_profile()
    assert profiles() == {}
    assert os.environ[middleware.RANGE_VARIABLE] == "SUBNET"

    for chosen in middleware.PROFILE_VARIABLES:
        monkeypatch.setenv(chosen, "/srv/own.xml")
        middleware.configure()
        middleware.clear_profile()
        assert profiles() == {chosen: "/srv/own.xml"}
        monkeypatch.delenv(chosen)


@pytest.mark.ros
@wheels_only
@pytest.mark.parametrize(
    ("variable", "value"), [(middleware.RANGE_VARIABLE, "LOCALHOST"), (middleware.LOCALHOST_VARIABLE, "1")]
)
def test_discovery_on_this_machine_is_the_profiles(monkeypatch, variable, value):
    for each in middleware.PROFILE_VARIABLES:
        monkeypatch.delenv(each, raising=False)
    monkeypatch.setenv(middleware.RANGE_VARIABLE, "SUBNET")
    monkeypatch.setenv(middleware.LOCALHOST_VARIABLE, "0")
    monkeypatch.setenv(variable, value)
    middleware.configure()
    assert profiles()[VARIABLE].endswith(f"/shared_memory_loopback{ENDING}")
    assert not middleware.discovers_this_machine_only()
    middleware.configure(large_messages=False)  # as in a process that was started by this one
    assert profiles()[VARIABLE].endswith(f"/udp_loopback{ENDING}")
    middleware.clear_profile()
    assert os.environ[middleware.RANGE_VARIABLE] == "LOCALHOST"

    monkeypatch.setenv("ROS_STATIC_PEERS", "192.0.2.7")  # which only the range LOCALHOST itself reaches
    middleware.configure()
    assert middleware.discovers_this_machine_only()


NODE = """
import os, pathlib, sys
from vinesim.ros import installation, middleware
middleware.configure(large_messages=sys.argv[1] == "large")
import rclpy
rclpy.init()
node = rclpy.create_node("some_node")
maps = pathlib.Path("/proc/self/maps").read_text().split()
ours = ("/dev/shm/fastrtps_", "/dev/shm/fastdds_")
segments = {path for path in maps if path.startswith(ours) and "port" not in path}
print(sorted(os.path.getsize(path) for path in segments))
"""


@pytest.mark.ros
@wheels_only
@pytest.mark.parametrize("reach", ["SUBNET", "LOCALHOST"])
def test_only_nodes_with_pictures_use_shared_memory(reach):
    """Writing to the shared-memory queue of a stopped subscriber takes two seconds, so small topics go by UDP."""
    environ = {name: value for name, value in os.environ.items() if name not in middleware.PROFILE_VARIABLES}
    environ |= {middleware.RANGE_VARIABLE: reach, "ROS_DOMAIN_ID": str(101 + os.getpid() % 100)}  # without peers

    def segments(kind: str) -> list[int]:
        command = [sys.executable, "-c", NODE, kind]
        done = subprocess.run(command, env=environ, capture_output=True, text=True, check=True, timeout=deadline(300.0))
        return json.loads(done.stdout)

    assert segments("small") == []
    (size,) = segments("large")
    assert size >= 24 * 1024**2


@pytest.mark.parametrize("local", [False, True])
def test_the_segment_holds_several_of_the_largest_messages(local):
    path = middleware.profile_file(large_messages=True, local=local)
    space = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}"
    root = ElementTree.parse(path).getroot()
    segment = int(root.findtext(f".//{space}segment_size") or 0)
    message = int(root.findtext(f".//{space}maxMessageSize") or 0)
    organised_cloud = 640 * 480 * 16
    assert organised_cloud < message < segment
    assert segment >= 4 * organised_cloud


@pytest.mark.parametrize("local", [False, True])
@pytest.mark.parametrize("large", [False, True])
def test_the_profile_of_fast_dds_3_adds_names_and_no_type_objects(large, local):
    two, three = (
        middleware.profile_file(large_messages=large, local=local, version=version).read_text() for version in (2, 3)
    )
    for before, after in {"heartbeatPeriod": "heartbeat_period", "nackResponseDelay": "nack_response_delay"}.items():
        assert large or before in two
        two = two.replace(before, after)
    own = three[three.index("        <!-- Eclipse Cyclone") : three.index("      </rtps>")]
    assert "<name>fastdds.type_propagation</name>" in own
    assert three.replace(own, "") == two
