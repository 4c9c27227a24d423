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
from vinesim.sensors.sensor import maker

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


# ---------------------------------------------------------------- MoveIt

ARMS = ("arm_left", "arm_right", "arm_left_torso", "arm_right_torso")


@pytest.fixture(scope="module")
def srdf() -> ElementTree.Element:
    return ElementTree.parse(FOLDER / "moveit" / "vinebot.srdf").getroot()


def chain(vinebot: RobotDescription, base: str, tip: str) -> tuple[str, ...]:
    """Driven joints between two links of the URDF, from the base on."""
    above = {
        one.find("child").get("link"): (one.find("parent").get("link"), one.get("name"))
        for one in ElementTree.fromstring(vinebot.urdf).iterfind("joint")
    }
    found = []
    while tip != base:
        parent, joint = above[tip]
        tip = str(parent)
        found.append(joint)
    return tuple(joint for joint in reversed(found) if joint in vinebot.joints)


def test_the_groups_of_moveit_are_those_of_the_robot(vinebot, srdf):
    for group in srdf.iterfind("group"):
        joints = tuple(one.get("name") for one in group.iterfind("joint"))
        for one in group.iterfind("chain"):
            joints = chain(vinebot, one.get("base_link"), one.get("tip_link"))
            assert one.get("tip_link") == vinebot.groups[group.get("name").removesuffix("_torso")].tool
        name = group.get("name")
        torso = vinebot.groups["torso"].joints if name.endswith("_torso") else ()
        assert joints == torso + vinebot.groups[name.removesuffix("_torso")].joints
    for state in srdf.iterfind("group_state"):
        given = {one.get("name"): float(one.get("value")) for one in state.iterfind("joint")}
        group = vinebot.groups[state.get("group")]
        assert given == dict(zip(group.joints, group.home, strict=True))
    assert srdf.find("virtual_joint").get("child_link") == vinebot.base
    named = {one.get(key) for one in srdf.iterfind("disable_collisions") for key in ("link1", "link2")}
    assert named <= set(vinebot.link_anchors)


def test_the_srdf_is_the_output_of_its_generator(srdf, monkeypatch):
    """Groups, states and connected links; which links never touch depends on the drawn configurations in rare cases."""
    monkeypatch.syspath_prepend(FOLDER.parent / "tools")
    writer = __import__("make_vinebot_srdf")
    written = ElementTree.fromstring(writer.srdf())
    ours, theirs = (
        [(one.tag, sorted(one.attrib.items())) for one in root.iter() if one.get("reason") not in ("Never", "Always")]
        for root in (written, srdf)
    )
    assert ours == theirs
    pairs = [
        {frozenset((one.get("link1"), one.get("link2"))) for one in root.iterfind("disable_collisions")}
        for root in (written, srdf)
    ]
    assert len(pairs[0] ^ pairs[1]) <= 2


def test_no_checked_links_touch_at_home(vinebot, srdf, monkeypatch):
    monkeypatch.syspath_prepend(FOLDER.parent / "tools")
    writer = __import__("make_vinebot_srdf")
    _, shares = writer.touching(vinebot.urdf, dict(zip(vinebot.joints, vinebot.home, strict=True)))
    ignored = {frozenset((one.get("link1"), one.get("link2"))) for one in srdf.iterfind("disable_collisions")}
    assert shares
    assert set(shares) <= ignored


def test_arms_are_checked_against_each_other_and_the_body(srdf):
    ignored = {frozenset((one.get("link1"), one.get("link2"))) for one in srdf.iterfind("disable_collisions")}
    for pair in (
        ("arm_left_5_link", "arm_right_5_link"),
        ("gripper_left_base_link", "base_link"),
        ("gripper_right_base_link", "head_2_link"),
    ):
        assert frozenset(pair) not in ignored


def test_limits_kinematics_and_planners_name_what_there_is(vinebot, srdf):
    groups = {one.get("name") for one in srdf.iterfind("group")}
    assert set(read("moveit/kinematics.yaml")) == set(ARMS) <= groups
    limits = read("moveit/joint_limits.yaml")["joint_limits"]
    assert list(limits) == list(vinebot.joints)
    assert [one["max_velocity"] for one in limits.values()] == [drive.velocity for drive in vinebot.drives]
    planning = read("moveit/ompl_planning.yaml")
    for arm in ARMS:
        assert set(planning[arm]["planner_configs"]) <= set(planning["planner_configs"])
        assert planning[arm]["default_planner_config"] in planning[arm]["planner_configs"]


def test_moveit_executes_by_the_actions_of_the_robots_controllers(vinebot):
    managed = read("moveit/moveit_controllers.yaml")["moveit_simple_controller_manager"]
    own = {spec.name: spec for spec in vinebot.controllers}
    actions = {
        ControllerKind.JOINT_TRAJECTORY: ("FollowJointTrajectory", "follow_joint_trajectory"),
        ControllerKind.GRIPPER: ("GripperCommand", "gripper_cmd"),
    }
    trajectories = {spec.name for spec in own.values() if spec.kind is ControllerKind.JOINT_TRAJECTORY}
    assert trajectories <= set(managed["controller_names"])
    for name in managed["controller_names"]:
        given = managed[name]
        assert (given["type"], given["action_ns"]) == actions[own[name].kind]
        assert tuple(given["joints"]) == own[name].joints


# ---------------------------------------------------------------- Nav2


def nav2() -> dict[str, dict[str, Any]]:
    """Parameters of each node of Nav2, by name."""
    return {
        name: each.get("ros__parameters") or parameters(each, name) for name, each in read("nav2/nav2.yaml").items()
    }


def test_nav2_has_the_frames_topics_and_limits_of_the_robot(vinebot):
    from vinesim.ros.publishers import robot

    nodes = nav2()
    assert {node["use_sim_time"] for node in nodes.values()} == {True}
    bases = {node["robot_base_frame"] for node in nodes.values() if "robot_base_frame" in node}
    assert bases == {vinebot.base}
    worlds = {node["global_frame"] for node in nodes.values() if "global_frame" in node}
    assert worlds == {robot.MAP_FRAME, robot.ODOM_FRAME}
    odometry = {node["odom_topic"] for node in nodes.values() if "odom_topic" in node}
    assert odometry == {f"/{robot.ODOMETRY}"}
    (lidar,) = vinebot.sensors_of("lidar")
    for costmap in ("local_costmap", "global_costmap"):
        scan = nodes[costmap]["obstacle_layer"]["scan"]
        assert (scan["topic"], scan["data_type"], scan["sensor_frame"]) == ("/scan", "LaserScan", lidar.frame)
    assert nodes["local_costmap"]["update_frequency"] == maker("lidar").rate(lidar.type)
    limits = vinebot.base_limits
    follow = nodes["controller_server"]["FollowPath"]
    assert follow["desired_linear_vel"] <= limits.linear
    assert follow["rotate_to_heading_angular_vel"] <= limits.angular
    assert follow["max_angular_accel"] <= limits.angular_acceleration
    assert nodes["behavior_server"]["max_rotational_vel"] <= limits.angular
    assert 1.0 / nodes["controller_server"]["controller_frequency"] < limits.timeout
    assert all(nodes[name]["enable_stamped_cmd_vel"] for name in ("controller_server", "behavior_server"))


def test_the_footprint_of_nav2_holds_the_body_of_the_robot(vinebot):
    """The boxes of links that are fixed to the base, seen from above."""
    corners = yaml.safe_load(nav2()["local_costmap"]["footprint"])
    half = [max(abs(corner[axis]) for corner in corners) for axis in range(2)]
    link = next(one for one in ElementTree.fromstring(vinebot.urdf).iterfind("link") if one.get("name") == "base_link")
    reach = [0.0, 0.0]
    for shape in link.iterfind("collision"):
        centre = [float(value) for value in shape.find("origin").get("xyz").split()]
        turned = any(float(value) for value in shape.find("origin").get("rpy").split())
        if (box := shape.find("geometry/box")) is not None and not turned:
            size = [float(value) for value in box.get("size").split()]
            reach = [max(reach[axis], abs(centre[axis]) + 0.5 * size[axis]) for axis in range(2)]
    assert reach[0] > 0.3
    assert all(reach[axis] <= half[axis] <= reach[axis] + 0.1 for axis in range(2))


def test_the_launch_files_of_nav2_and_moveit_start_what_is_configured(monkeypatch):
    """By stand-ins for the packages launch and launch_ros, which are on no index."""
    from vinesim.ros.commands.subscriptions import BASE_COMMAND

    started: list[dict[str, Any]] = []

    class StandIn(types.ModuleType):
        def __getattr__(self, name: str):
            if name.startswith("__"):
                raise AttributeError(name)
            return lambda *values, **options: started.append(options) if "executable" in options else (name, *values)

    for module in ("launch", "launch.actions", "launch.substitutions", "launch_ros", "launch_ros.actions"):
        monkeypatch.setitem(sys.modules, module, StandIn(module))
    names = runpy.run_path(str(FOLDER / "nav2" / "vinebot.launch.py"))
    names["generate_launch_description"]()
    assert {options["remappings"][0] for options in started} == {("cmd_vel", f"/{BASE_COMMAND}")}
    nodes = nav2()
    assert {options["name"] for options in started} | {"local_costmap", "global_costmap"} == set(nodes)
    managed = nodes["lifecycle_manager_navigation"]["node_names"]
    assert set(managed) == {options["name"] for options in started} - {"lifecycle_manager_navigation"}
    assert pathlib.Path(names["FILE"]).is_file()

    started.clear()
    runpy.run_path(str(FOLDER / "moveit" / "vinebot.launch.py"))["generate_launch_description"]()
    (move_group,) = started
    (given,) = move_group["parameters"]
    assert ElementTree.fromstring(given["robot_description_semantic"]).get("name") == "vinebot"
    assert given["moveit_simple_controller_manager"]["controller_names"]
