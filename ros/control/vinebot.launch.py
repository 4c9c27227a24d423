"""Starts a vinebot without controllers of vinesim, and a controller_manager of ros2_control that moves it.

ros2 launch ros/control/vinebot.launch.py
ros2 launch ros/control/vinebot.launch.py controllers:=my_controllers.yaml spawn:="my_controller other_controller"

Needs ros2_control, ros2_controllers and joint_state_topic_hardware_interface.
"""

from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, ExecuteProcess, OpaqueFunction
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration

FOLDER = Path(__file__).resolve().parent
SPAWNED = (
    "arm_left_controller arm_right_controller torso_controller head_controller gripper_left_controller "
    "gripper_right_controller"
)
ARGUMENTS = {
    "scene": ("demo", "A scene file, or demo, harvest, tendone, vsp."),
    "robot": ("vinebot", "A URDF file with a ros2_control tag for the topics, or vinebot."),
    "controllers": (str(FOLDER / "controllers.yaml"), "File with the parameters of controller_manager."),
    "spawn": (SPAWNED, "Controllers to start, separated by blanks."),
}


def spawner(context: LaunchContext) -> list[ExecuteProcess]:
    """Start the spawner with one argument for each controller."""
    names = LaunchConfiguration("spawn").perform(context).split()
    return [ExecuteProcess(cmd=["ros2", "run", "controller_manager", "spawner", *names], output="screen")]


def generate_launch_description() -> LaunchDescription:
    """Start vinesim, controller_manager and its spawner. controller_manager takes the description that vinesim
    publishes."""
    client = ExecuteProcess(
        name="vinesim",
        cmd=[
            *("vinesim", "client", "--role", "robot", "--name", "vinebot", "--status", "none", "--controllers", "none"),
            *("--scene", LaunchConfiguration("scene"), "--robot", LaunchConfiguration("robot")),
        ],
        output="screen",
        on_exit=[EmitEvent(event=Shutdown(reason="vinesim has ended"))],
    )
    manager = ExecuteProcess(
        cmd=[
            *("ros2", "run", "controller_manager", "ros2_control_node", "--ros-args"),
            *("--params-file", LaunchConfiguration("controllers")),
            *("-r", "/controller_manager/robot_description:=/robot_description"),
        ],
        output="screen",
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=about)
        for name, (default, about) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, client, manager, OpaqueFunction(function=spawner)])
