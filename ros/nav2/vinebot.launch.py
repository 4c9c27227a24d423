"""Starts Nav2 for a vinebot that vinesim simulates.

vinesim client --role robot --scene demo               # in another terminal
ros2 launch ros/nav2/vinebot.launch.py
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

FILE = str(Path(__file__).resolve().parent / "nav2.yaml")
NODES = {
    "controller_server": "nav2_controller",
    "planner_server": "nav2_planner",
    "behavior_server": "nav2_behaviors",
    "bt_navigator": "nav2_bt_navigator",
    "waypoint_follower": "nav2_waypoint_follower",
    "lifecycle_manager": "nav2_lifecycle_manager",
}
"""Executables and their packages."""
COMMAND = ("cmd_vel", "/mobile_base_controller/cmd_vel")
"""The topic of Nav2's commands, and that of the robot."""


def generate_launch_description() -> LaunchDescription:
    """Start the servers of Nav2, and the manager that activates them."""
    nodes = [
        Node(
            package=package,
            executable=executable,
            name="lifecycle_manager_navigation" if executable == "lifecycle_manager" else executable,
            output="screen",
            parameters=[LaunchConfiguration("params_file")],
            remappings=[COMMAND],
        )
        for executable, package in NODES.items()
    ]
    file = DeclareLaunchArgument("params_file", default_value=FILE, description="File with the parameters of Nav2.")
    return LaunchDescription([file, *nodes])
