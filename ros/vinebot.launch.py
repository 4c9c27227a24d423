"""Starts a robot of vinesim, and RViz.

ros2 launch vinesim_ros vinebot.launch.py              # the installed package
ros2 launch ros/vinebot.launch.py                      # from the checkout
ros2 launch ros/vinebot.launch.py scene:=harvest environment:=true rviz:=false
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, ExecuteProcess
from launch.conditions import IfCondition
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration

FOLDER = Path(__file__).resolve().parent
ARGUMENTS = {
    "scene": ("demo", "A scene file, or demo, harvest, tendone, vsp."),
    "robot": ("vinebot", "A URDF file, or vinebot, logistic."),
    "namespace": ("", "Namespace of all topics."),
    "params_file": (str(FOLDER / "parameters.yaml"), "File with ROS parameters of the robot's nodes."),
    "rviz": ("true", "Whether RViz is started."),
    "environment": ("false", "Whether bunches, boxes and people are shown as frames; needs topic_tools."),
}


def generate_launch_description() -> LaunchDescription:
    """Start vinesim, RViz and the relay of frames. There is no robot_state_publisher, because vinesim publishes all
    frames."""
    client = ExecuteProcess(
        name="vinesim",
        cmd=[
            "vinesim",
            "client",
            "--role",
            "robot",
            "--name",
            "vinebot",
            "--status",
            "none",
            *("--scene", LaunchConfiguration("scene"), "--robot", LaunchConfiguration("robot")),
            *("--namespace", LaunchConfiguration("namespace"), "--params-file", LaunchConfiguration("params_file")),
        ],
        output="screen",
        on_exit=[EmitEvent(event=Shutdown(reason="vinesim has ended"))],
    )
    rviz = ExecuteProcess(
        cmd=["rviz2", "-d", str(FOLDER / "vinebot.rviz"), "--ros-args", "-p", "use_sim_time:=true"],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    environment = ExecuteProcess(
        cmd=["ros2", "run", "topic_tools", "relay", "/tf_environment", "/tf"],
        condition=IfCondition(LaunchConfiguration("environment")),
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=about)
        for name, (default, about) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, client, rviz, environment])
