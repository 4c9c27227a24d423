"""Starts move_group of MoveIt for a vinebot that vinesim simulates.

vinesim client --role robot --scene demo               # in another terminal
ros2 launch ros/moveit/vinebot.launch.py
"""

from pathlib import Path
from typing import Any

import yaml
from launch import LaunchDescription
from launch_ros.actions import Node

FOLDER = Path(__file__).resolve().parent


def read(name: str) -> dict[str, Any]:
    """Returns the content of a YAML file of this folder."""
    return yaml.safe_load((FOLDER / name).read_text())


def parameters() -> dict[str, Any]:
    """Returns the parameters of move_group. It receives the robot's description from vinesim on robot_description."""
    return {
        "use_sim_time": True,
        "robot_description_semantic": (FOLDER / "vinebot.srdf").read_text(),
        "robot_description_kinematics": read("kinematics.yaml"),
        "robot_description_planning": read("joint_limits.yaml"),
        "planning_pipelines": ["ompl"],
        "default_planning_pipeline": "ompl",
        "ompl": read("ompl_planning.yaml"),
        "publish_robot_description_semantic": True,
        "publish_planning_scene": True,
        "publish_state_updates": True,
        **read("moveit_controllers.yaml"),
    }


def generate_launch_description() -> LaunchDescription:
    """Start move_group."""
    return LaunchDescription(
        [Node(package="moveit_ros_move_group", executable="move_group", output="screen", parameters=[parameters()])]
    )
