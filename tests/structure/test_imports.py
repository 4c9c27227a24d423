"""Cost and direction of imports, measured in new processes."""

import subprocess
import sys

import pytest

from vinesim.client.processes.worker_process import ROS_MODULES

HEAVY = ("warp", "mujoco", "zenoh", "rclpy", "cv2", "numpy", "open3d")


def modules_after(statement):
    code = f"{statement}; import sys; print(*sorted(m for m in sys.modules if m in {HEAVY!r}))"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


def test_the_command_line_starts_without_mujoco_and_warp():
    assert modules_after("import vinesim.cli") == set()


def test_the_server_simulates_nothing():
    assert modules_after("import vinesim.net.server.server").isdisjoint({"warp", "mujoco", "rclpy"})


def test_physics_needs_no_network_and_no_ros():
    assert modules_after("import vinesim.world").isdisjoint({"zenoh", "rclpy", "cv2"})


def test_the_ros_process_needs_no_physics_and_no_renderer():
    """Its memory and its start are small; most of a robot's processes run on two cores."""
    pytest.importorskip("rclpy")
    modules = "; ".join(f"import {module}" for module in ROS_MODULES)
    assert modules_after(modules) == {"numpy", "rclpy"}


def test_a_client_without_ros_imports_no_ros():
    assert modules_after("import vinesim.client.client").isdisjoint({"rclpy"})
