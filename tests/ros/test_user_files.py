"""The examples and the folder ``ros/`` against a real robot client, each as its users run it."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import contextlib
import json
import os
import pathlib
import queue
import re
import runpy
import shutil
import subprocess
import sys
import threading
import types
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

import yaml
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import BatteryState
from std_msgs.msg import String

from tests.support.stock_node import StockNode, wait_until
from vinesim.bench.ros_topics import action_rows
from vinesim.client.processes.child_process import process_group
from vinesim.ros.messages import message_packages

ROOT = pathlib.Path(__file__).parents[2]
EXAMPLES, FOLDER = ROOT / "examples" / "ros", ROOT / "ros"
SLIP = 0.2


@pytest.fixture(scope="module")
def robot(tmp_path_factory) -> Iterator[StockNode]:
    """A vinebot whose turning tracks slip, in a process of its own with the parameter file; and a stock node."""
    folder = tmp_path_factory.mktemp("robot")
    shutil.copy(ROOT / "data" / "robots" / "vinebot.urdf", folder)
    text = (ROOT / "data" / "robots" / "vinebot.toml").read_text()
    (folder / "vinebot.toml").write_text(text.replace("[base]", f"[base]\nslip = [0.0, {SLIP}]", 1))
    message_packages.ensure_importable(["tf2_msgs", "control_msgs", "simulation_interfaces"])
    domain = {"ROS_DOMAIN_ID": str(1 + os.getpid() % 100), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with pytest.MonkeyPatch.context() as monkeypatch, process_group(10.0) as group:
        for name, value in (*domain.items(), ("ROS_LOG_DIR", str(folder))):
            monkeypatch.setenv(name, value)
        client = group.start(
            "client", "-m", "vinesim.cli", "client", "--role", "robot", "--name", "vinebot", "--status", "none",
            "--robot", str(folder / "vinebot.urdf"), "--params-file", str(FOLDER / "parameters.yaml"),
        )  # fmt: skip
        with StockNode() as peer:
            poses: list[Odometry] = []
            peer.node.create_subscription(Odometry, "/mobile_base_controller/odom", poses.append, 10)
            wait_until(lambda: poses, lambda: (client.new_lines(), peer.spin(0.1)), "the robot")
            yield peer


@contextlib.contextmanager
def example(name: str, *arguments: str) -> Iterator[Callable[[], list[str]]]:
    """Run an example that knows nothing of vinesim; call what is yielded for the lines that it has printed."""
    text = (EXAMPLES / name).read_text()
    assert len(text.splitlines()) < 60
    assert not re.search(r"^\s*(import|from) vinesim", text, re.MULTILINE)
    packages = [path for path in sys.path if "interfaces" in path]  # as if they were installed
    child = subprocess.Popen(
        [sys.executable, str(EXAMPLES / name), *arguments], stdout=subprocess.PIPE, text=True, cwd="/",
        env=os.environ | {"PYTHONPATH": os.pathsep.join(packages)},
    )  # fmt: skip
    printed: queue.SimpleQueue[str] = queue.SimpleQueue()
    lines: list[str] = []

    def read() -> None:
        for line in child.stdout:
            printed.put(line.strip())

    def heard() -> list[str]:
        assert child.poll() is None, f"{name} has ended"
        while not printed.empty():
            lines.append(printed.get())
        return lines

    reader = threading.Thread(target=read)
    reader.start()
    try:
        yield heard
    finally:
        child.kill()
        child.wait()
        reader.join()


def driver(peer: StockNode) -> Callable[[float, float], None]:
    """A function that commands a velocity of the base [m/s, rad/s] and takes messages for a moment."""
    commands = peer.node.create_publisher(TwistStamped, "/mobile_base_controller/cmd_vel", 1)

    def drive(ahead: float, turn: float) -> None:
        twist = TwistStamped()
        twist.twist.linear.x, twist.twist.angular.z = ahead, turn
        commands.publish(twist)
        for _ in range(40):
            peer.spin(0.001)

    return drive


def yaw(q) -> float:
    return float(2.0 * np.arctan2(q.z, q.w))


def turned(after: float, before: float) -> float:
    return (after - before + np.pi) % (2.0 * np.pi) - np.pi


def test_an_arm_gives_way_and_comes_back(robot: StockNode) -> None:
    """The base jerks, which pushes the arm by its inertia."""
    drive = driver(robot)
    with example("compliant_arm.py") as printed:
        wait_until(lambda: "soft" in printed(), lambda: robot.spin(0.05), "a soft arm")
        ways = iter(range(10**6))
        wait_until(
            lambda: any("gives way by" in line for line in printed()),
            lambda: drive(0.0, 1.0 if next(ways) // 16 % 2 else -1.0), "a push",
        )  # fmt: skip
        count = len(printed())
        wait_until(lambda: "back" in printed()[count - 1 :], lambda: drive(0.0, 0.0), "rest")


def test_a_low_battery_lights_the_signal_tower(robot: StockNode) -> None:
    """The pattern follows the charge with a margin, and the robot takes the command."""
    told: list[str] = []
    subscription = robot.node.create_subscription(
        String, "/indicator_lights/command", lambda message: told.append(message.data), 10
    )
    battery = robot.node.create_publisher(BatteryState, "/battery_state", 10)
    with example("battery_light.py") as printed:
        said: list[str] = []
        for charge, pattern in (
            (0.15, "warning"), (0.21, "warning"), (0.04, "alarm"), (0.06, "alarm"), (0.1, "warning"),
            (float("nan"), "warning"), (0.9, "off"),
        ):  # fmt: skip
            told.clear()
            if pattern != (said or ["off"])[-1]:
                said.append(pattern)

            def publish(charge: float = charge) -> None:
                battery.publish(BatteryState(percentage=charge))
                robot.spin(0.05)

            wait_until(lambda pattern=pattern: told[-1:] == [pattern] and printed() == said, publish, pattern)
        assert robot.node.count_subscribers("/indicator_lights/command") >= 2  # the robot, and this test
    robot.node.destroy_subscription(subscription)
    robot.node.destroy_publisher(battery)


def test_a_robot_is_localised_without_truth(robot: StockNode) -> None:
    """The turn in the map is the true one; odometry alone is wrong by the slip."""
    from simulation_interfaces.srv import GetEntityState
    from tf2_msgs.msg import TFMessage

    own: list[dict] = []  # the transforms of each message, by child frame: of the robot, and of the example
    others: list[dict] = []

    def take(message: TFMessage) -> None:
        found = {t.child_frame_id: t.transform for t in message.transforms}
        (own if "base_footprint" in found else others).append(found)

    odometry: list[Odometry] = []
    subscriptions = [
        robot.node.create_subscription(TFMessage, "/tf", take, 100),
        robot.node.create_subscription(Odometry, "/mobile_base_controller/odom", odometry.append, 100),
    ]
    ask = robot.node.create_client(GetEntityState, "/get_entity_state")
    wait_until(ask.service_is_ready, lambda: robot.spin(0.05), "the simulation")

    def true_yaw() -> float:
        future = ask.call_async(GetEntityState.Request(entity="vinebot"))
        wait_until(future.done, lambda: robot.spin(0.05), "a state")
        return yaw(future.result().state.pose.orientation)

    with example("localise.py", "vinebot") as printed:
        wait_until(lambda: own and others and "odom" not in own[-1], lambda: (printed(), robot.spin(0.05)), "tf")
        before, start = true_yaw(), yaw(odometry[-1].pose.pose.orientation)
        drive = driver(robot)

        def counted() -> float:
            return turned(yaw(odometry[-1].pose.pose.orientation), start)

        def found() -> float:
            return turned(yaw(others[-1]["odom"].rotation), -yaw(own[-1]["base_footprint"].rotation))

        wait_until(lambda: counted() > 1.0, lambda: drive(0.0, 0.4))
        for _ in range(20):
            drive(0.0, 0.0)
        truth = turned(true_yaw(), before)
        # what was sent while it turned may still wait; then both hold
        wait_until(lambda: abs(turned(found(), truth)) < 0.04, lambda: drive(0.0, 0.0), f"a turn of {truth:.2f} rad")
        wait_until(lambda: abs(counted() - truth / (1.0 - SLIP)) < 0.04, lambda: drive(0.0, 0.0), "odometry")
        assert abs(turned(found(), truth)) < 0.04
    for one in subscriptions:
        robot.node.destroy_subscription(one)


@pytest.mark.slow
def test_goals_from_another_process_end_as_they_should(robot: StockNode) -> None:
    """A small version of ``vinesim bench ros``: one goal to its end, one cancelled, one preempted; none is kept."""
    done = subprocess.run(
        [sys.executable, "-m", "vinesim.bench.goal_sender", "--goals", "1", "--cancels", "1", "--preempts", "1"],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert sorted(row["kind"] for row in rows) == ["cancel", "end", "goal", "preempt"]
    assert all(row["right"] for row in rows if row["kind"] != "end"), rows
    assert rows[-1]["known"] == 0
    for row in action_rows(rows):
        assert row.ratio is None or row.ratio >= 1.0, row


# ---------------------------------------------------------------- the folder ros/


def test_files_name_topics_that_there_are(robot: StockNode) -> None:
    """RViz, Foxglove and the parameter file against the topics and parameters of the running robot."""
    rviz = yaml.safe_load((FOLDER / "vinebot.rviz").read_text())
    layout = json.loads((FOLDER / "foxglove.json").read_text())
    named = set(re.findall(r'"(/[\w/]+)', json.dumps(rviz) + json.dumps(layout)))
    assert {"/robot_description", "/head_front_camera/depth/points", "/tf_environment"} <= named
    wait_until(lambda: named <= {name for name, _ in robot.node.get_topic_names_and_types()},
               lambda: robot.spin(0.05), f"topics {sorted(named)}")  # fmt: skip
    assert rviz["Visualization Manager"]["Global Options"]["Fixed Frame"] == "map"


def test_the_parameter_file_names_parameters_that_there_are(robot: StockNode) -> None:
    from rclpy.parameter_client import AsyncParameterClient

    def names(values: dict, above: str = "") -> Iterator[str]:
        for key, value in values.items():
            yield from names(value, f"{above}{key}.") if isinstance(value, dict) else [above + key]

    wanted = set(names(yaml.safe_load((FOLDER / "parameters.yaml").read_text())["/**"]["ros__parameters"]))
    declared: set[str] = set()
    for node in ("vinebot", "vinebot_sensors"):
        client = AsyncParameterClient(robot.node, node)
        wait_until(client.services_are_ready, lambda: robot.spin(0.05), node)
        future = client.list_parameters()
        wait_until(future.done, lambda: robot.spin(0.05), f"parameters of {node}")
        declared.update(future.result().result.names)
    assert wanted <= declared


def test_the_launch_file_starts_a_robot_with_options_that_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """The package launch is on no index: what it would start is read from a stand-in."""
    started: list[list] = []

    class StandIn(types.ModuleType):
        def __getattr__(self, name: str):
            if name.startswith("__"):
                raise AttributeError(name)
            return lambda *values, **options: started.append(options["cmd"]) if "cmd" in options else (name, *values)

    for module in ("launch", "launch.actions", "launch.conditions", "launch.events", "launch.substitutions"):
        monkeypatch.setitem(sys.modules, module, StandIn(module))
    runpy.run_path(str(FOLDER / "vinebot.launch.py"))["generate_launch_description"]()
    (vinesim, rviz, relay) = started
    assert vinesim[:4] == ["vinesim", "client", "--role", "robot"]
    done = subprocess.run(
        [sys.executable, "-m", "vinesim.cli", "client", "--help"], capture_output=True, text=True, check=True,
        env=os.environ | {"COLUMNS": "200"},
    )  # fmt: skip
    assert [word for word in vinesim if str(word).startswith("--") and word not in done.stdout] == []
    assert pathlib.Path(rviz[2]).is_file()
    assert relay[-2:] == ["/tf_environment", "/tf"]
