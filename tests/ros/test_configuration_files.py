"""Configuration of other packages in ``ros/`` against vinebot: names of joints and topics, types and rates.

The packages themselves are on no index of wheels, so none of them is run.
"""

from __future__ import annotations

import pathlib
import runpy
import sys
import types
from typing import Any
from xml.etree import ElementTree

import pytest

from vinesim.cli.client_options import CONTROLLERS
from vinesim.core import data_files
from vinesim.robot.description.controllers import command_interfaces, only_hardware
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.loader import load_description
from vinesim.scene.values import ControllerKind

yaml = pytest.importorskip("yaml", reason="PyYAML, which rclpy brings, is not installed")

FOLDER = pathlib.Path(__file__).parents[2] / "ros"


@pytest.fixture(scope="module")
def vinebot() -> RobotDescription:
    return load_description("vinebot")


def read(name: str) -> dict[str, Any]:
    return yaml.safe_load((FOLDER / name).read_text())


def parameters(file: dict[str, Any], node: str) -> dict[str, Any]:
    return file[node]["ros__parameters"]


# ---------------------------------------------------------------- ros2_control


def test_the_urdf_names_the_topics_of_the_robot_and_all_its_joints(vinebot):
    root = ElementTree.parse(data_files.find_data_file("robots", "vinebot", ".urdf")).getroot()
    system = root.find("ros2_control")
    given = {one.get("name"): one.text for one in system.iterfind("hardware/param")}
    (topics,) = [spec.hardware for spec in only_hardware(vinebot).controllers if spec.hardware]
    assert given["joint_commands_topic"] == f"/{topics.commands}"
    assert given["joint_states_topic"] == f"/{topics.states}"
    everything = {"position", "velocity", "effort"}
    assert command_interfaces(vinebot.urdf) == dict.fromkeys(vinebot.joints, everything)
    for joint in system.iterfind("joint"):
        assert {one.get("name") for one in joint.iterfind("state_interface")} == everything


def test_controllers_have_the_joints_of_vinebots_own(vinebot):
    file = read("control/controllers.yaml")
    manager = parameters(file, "controller_manager")
    assert manager.pop("update_rate") == 100
    assert manager.pop("use_sim_time") is True
    assert set(file) == {"controller_manager", *manager}
    interfaces = command_interfaces(vinebot.urdf)
    own = {spec.name: spec for spec in vinebot.controllers}
    for name, each in manager.items():
        given = parameters(file, name)
        assert tuple(given["joints"]) == own[name].joints
        is_trajectory = each["type"] == "joint_trajectory_controller/JointTrajectoryController"
        assert is_trajectory == (own[name].kind is ControllerKind.JOINT_TRAJECTORY)
        commanded = given["command_interfaces"] if is_trajectory else [given["interface_name"]]
        assert all(set(commanded) <= interfaces[joint] for joint in given["joints"])
        assert set(given.get("gains", {})) == (set(given["joints"]) if commanded == ["effort"] else set())


def test_the_launch_file_starts_a_robot_without_controllers_and_their_spawner(monkeypatch):
    """By a stand-in for the package launch, which is on no index."""
    started: list[list] = []

    class StandIn(types.ModuleType):
        def __getattr__(self, name: str):
            if name.startswith("__"):
                raise AttributeError(name)
            return lambda *values, **options: started.append(options["cmd"]) if "cmd" in options else (name, *values)

    for module in ("launch", "launch.actions", "launch.events", "launch.substitutions"):
        monkeypatch.setitem(sys.modules, module, StandIn(module))
    names = runpy.run_path(str(FOLDER / "control" / "vinebot.launch.py"))
    names["generate_launch_description"]()
    vinesim, manager = started
    assert vinesim[vinesim.index("--controllers") + 1] == CONTROLLERS[1]
    assert manager[:4] == ["ros2", "run", "controller_manager", "ros2_control_node"]
    managed = set(parameters(read("control/controllers.yaml"), "controller_manager")) - {"update_rate", "use_sim_time"}
    assert set(names["SPAWNED"].split()) == managed
