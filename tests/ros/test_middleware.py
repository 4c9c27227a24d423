"""Whether ROS can be used, and why not."""

from __future__ import annotations

import importlib.util
import os
import xml.etree.ElementTree as ElementTree

import pytest

from vinesim.ros import middleware

WHEELS = importlib.util.find_spec("ros_wheels_bootstrapper") is not None
wheels_only = pytest.mark.skipif(not WHEELS, reason="ROS 2 is not installed as wheels: pip install 'vinesim[ros]'")


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
    assert "did not get to set LD_LIBRARY_PATH" in str(middleware.unavailable_reason())


@pytest.mark.ros
@wheels_only
def test_a_middleware_that_the_wheels_lack_is_refused(monkeypatch):
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    assert "RMW_IMPLEMENTATION is 'rmw_cyclonedds_cpp'" in str(middleware.unavailable_reason())


def test_without_ros_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)

    def missing(name: str):
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(importlib, "import_module", missing)
    assert middleware.unavailable_reason() == (
        "ROS 2 is missing (No module named 'rclpy.node'); pip install 'vinesim[ros]', "
        "or source a ROS 2 Jazzy installation"
    )


@pytest.mark.ros
@wheels_only
def test_the_profile_is_set_unless_the_user_has_chosen(monkeypatch):
    monkeypatch.delenv(middleware.PROFILE_VARIABLE, raising=False)
    middleware.configure()
    assert os.environ[middleware.PROFILE_VARIABLE] == str(middleware.PROFILE_FILE)
    middleware.clear_profile()
    assert middleware.PROFILE_VARIABLE not in os.environ

    monkeypatch.setenv(middleware.PROFILE_VARIABLE, "/srv/own.xml")
    middleware.configure()
    middleware.clear_profile()
    assert os.environ[middleware.PROFILE_VARIABLE] == "/srv/own.xml"


def test_the_segment_holds_several_of_the_largest_messages():
    space = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}"
    root = ElementTree.parse(middleware.PROFILE_FILE).getroot()
    segment = int(root.findtext(f".//{space}segment_size") or 0)
    message = int(root.findtext(f".//{space}maxMessageSize") or 0)
    organised_cloud = 640 * 480 * 16
    assert organised_cloud < message < segment
    assert segment >= 4 * organised_cloud
