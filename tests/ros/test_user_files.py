"""The examples and the folder ``ros/`` against the real client of the robot tutorial, each as its users run it."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import contextlib
import json
import os
import pathlib
import queue
import re
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import types
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from benchmarks.example_signals import BOUND, UNCLEAN
from benchmarks.ros_pick import lies_in_a_box
from benchmarks.support.example_programs import EXAMPLES, NAMES, handles_sigterm, start_example
from tests.support import programs
from tests.support.waiting import deadline
from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

import yaml
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.action.client import ClientGoalHandle
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from tests.support.stock_node import StockNode, wait_until
from vinesim.bench.ros_resets import reset_rows
from vinesim.bench.ros_topics import action_rows
from vinesim.client.programs import program_group
from vinesim.core import frames
from vinesim.robot.description.loader import load_description
from vinesim.robot.drives.joint_servos import series_stiffness
from vinesim.ros.messages import message_packages
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.ids import Organ
from vinesim.scene.spec import load_scene

ROOT = pathlib.Path(__file__).parents[2]
FOLDER = ROOT / "ros"
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
    with pytest.MonkeyPatch.context() as monkeypatch, program_group(10.0) as group:
        for name, value in (*domain.items(), ("ROS_LOG_DIR", str(folder))):
            monkeypatch.setenv(name, value)
        client = group.start(
            "client",
            "-m",
            "vinesim",
            "client",
            "--role",
            "robot",
            "--scene",
            "harvest",
            "--status",
            "none",
            "--robot",
            str(folder / "vinebot.urdf"),
            "--params-file",
            str(FOLDER / "parameters.yaml"),
        )
        with StockNode() as peer:
            poses: list[Odometry] = []
            peer.node.create_subscription(Odometry, "/mobile_base_controller/odom", poses.append, 10)
            wait_until(lambda: poses, lambda: (client.new_lines(), peer.spin(0.1)), "the robot")
            yield peer


@contextlib.contextmanager
def example(name: str, *arguments: str, number: signal.Signals = signal.SIGINT) -> Iterator[Callable[[], list[str]]]:
    """Run an example where vinesim cannot be imported; call what is yielded for the lines that it has printed.

    At the end it gets a signal, and must end in order."""
    with tempfile.TemporaryDirectory() as folder:
        child = start_example(name, *arguments, folder=pathlib.Path(folder), output=subprocess.PIPE)
        printed: queue.SimpleQueue[str] = queue.SimpleQueue()
        lines: list[str] = []

        def read() -> None:
            for line in child.stdout:
                printed.put(line.strip())

        def take() -> None:
            while not printed.empty():
                lines.append(printed.get())

        def heard() -> list[str]:
            has_ended = child.poll() is not None
            take()
            assert not has_ended, f"{name} has ended: {lines}"
            return lines

        reader = threading.Thread(target=read)
        reader.start()
        try:
            yield heard
            if child.poll() is None:
                assert handles_sigterm(child.pid)
                child.send_signal(number)
            assert child.wait(deadline(BOUND)) == 0
        finally:
            child.kill()
            child.wait()
            reader.join()
            child.stdout.close()
        take()
        assert not [line for line in lines if any(word in line for word in UNCLEAN)]


def test_the_examples_import_nothing_of_vinesim_and_name_the_client_of_the_tutorial() -> None:
    client = "vinesim client --role robot --scene harvest"
    assert client in (ROOT / "docs" / "tutorials" / "robot.md").read_text().splitlines()
    assert {"battery_light.py", "compliant_arm.py", "find_bunches.py", "localise.py", "pick_a_bunch.py"} == set(NAMES)
    for name in NAMES:
        text = (EXAMPLES / name).read_text()
        assert not re.search(r"^\s*(import|from) vinesim", text, re.MULTILINE)
        assert re.search(rf"^    {client} +# in one terminal$", text, re.MULTILINE), name
        depths = re.findall(r"create_(?:subscription|publisher)\(.*, (\w+)\)$", text, re.MULTILINE)
        assert set(depths) <= {"10", "latched"}, name  # rclpy's default QoS; a latched topic needs its own


def test_bunches_are_found_where_they_are(robot: StockNode) -> None:
    """Every place that the example prints is in the picture, next to a bunch of the truth."""
    from vision_msgs.msg import Detection3DArray

    truth: dict[str, np.ndarray] = {}

    def take(message: Detection3DArray) -> None:
        for one in message.detections:
            at = one.bbox.center.position
            truth[one.id] = np.array([at.x, at.y, at.z])

    subscription = robot.node.create_subscription(Detection3DArray, "/head_front_camera/detections_3d", take, 5)
    with example("find_bunches.py", number=signal.SIGTERM) as printed:

        def bunches() -> list[str]:
            return [line for line in printed() if "bunch at" in line]

        wait_until(lambda: len(bunches()) >= 8 and truth, lambda: robot.spin(0.05), "bunches")
        lines = bunches()
    robot.node.destroy_subscription(subscription)
    found = [np.array([float(number) for number in re.findall(r"[xyz] (-?\d+\.\d+)", line)]) for line in lines]
    assert len({tuple(place.round(1)) for place in found}) >= 3
    for place in found:  # the middle of the side that faces the camera
        assert min(np.linalg.norm(place - middle) for middle in truth.values()) < 0.15, place


def arm_of_the_example(side: str) -> tuple[Any, Any]:
    """The arm of ``pick_a_bunch.py``, without a robot, and vinesim's description."""
    given = runpy.run_path(str(EXAMPLES / "pick_a_bunch.py"), run_name="example")
    description = load_description("vinebot")
    robot = types.SimpleNamespace(
        urdf=[(ROOT / "data" / "robots" / "vinebot.urdf").read_text()],
        joints=dict.fromkeys(description.joints, 0.1),
        home=dict.fromkeys(description.joints, 0.1),
        check=lambda: None,
    )
    return given["Arm"](robot, side), description


@pytest.mark.parametrize("side", ["left", "right"])
def test_kinematics_of_the_picker_are_those_of_the_urdf(side: str) -> None:
    """Poses against vinesim's, the Jacobian against differences, and a solution that reaches its goal."""
    arm, description = arm_of_the_example(side)
    rng = np.random.default_rng(3)
    for _ in range(5):
        q = rng.uniform(arm.lower, arm.upper)
        here, jacobian = arm.hand(q)
        positions = {**arm.robot.joints, **dict(zip(arm.names, q, strict=True))}
        links = description.link_poses(np.array([positions[name] for name in description.joints]))
        expected = links[f"gripper_{side}_grasping_link"]
        np.testing.assert_allclose(here[:3, 3], expected[:3], atol=1e-9)
        np.testing.assert_allclose(here[:3, :3], frames.to_matrix(expected[3:]), atol=1e-9)
        step = 1e-6 * rng.standard_normal(len(q))
        there, _ = arm.hand(q + step)
        np.testing.assert_allclose(there[:3, 3] - here[:3, 3], jacobian[:3] @ step, atol=1e-10)
    near = np.clip(q + 0.1, arm.lower, arm.upper)
    reached, _ = arm.hand(arm.solve(arm.hand(near)[0], q))
    np.testing.assert_allclose(reached, arm.hand(near)[0], atol=6e-3)


def test_the_picker_stops_the_robot_at_sigterm(robot: StockNode) -> None:
    """The base drives to a bunch; at the end of the program it comes to rest."""
    odometry: list[Odometry] = []
    subscription = robot.node.create_subscription(Odometry, "/mobile_base_controller/odom", odometry.append, 10)

    def speed() -> float:
        twist = odometry[-1].twist.twist if odometry else None
        return 0.0 if twist is None else abs(twist.linear.x) + abs(twist.angular.z)

    with example("pick_a_bunch.py", number=signal.SIGTERM) as printed:
        wait_until(lambda: (printed(), speed() > 0.05)[1], lambda: robot.spin(0.05), "a robot that drives")
        assert re.fullmatch(r"bunch_\d+: (left|right) hand, from \(.*\)", printed()[-1])
    wait_until(lambda: speed() < 1e-3, lambda: robot.spin(0.05), "rest")
    robot.node.destroy_subscription(subscription)


@pytest.mark.long
def test_bunches_are_picked_and_put_into_a_box(robot: StockNode) -> None:
    """Two runs, so that the first one must leave the robot ready for the next. The simulation says where the bunches
    are at the end."""
    for _ in range(2):
        with tempfile.TemporaryDirectory() as folder:
            output = pathlib.Path(folder) / "output"
            with output.open("w") as file:
                child = start_example("pick_a_bunch.py", folder=pathlib.Path(folder), output=file)
            try:
                wait_until(lambda child=child: child.poll() is not None, lambda: robot.spin(0.05), "a bunch in a box")
            finally:
                child.kill()
            lines = output.read_text().splitlines()
        assert child.wait() == 0, lines
        bunch, said = lines[-1].split(": ")
        assert said == "in the box"
        assert lies_in_a_box(bunch)


def test_poles_and_elastic_elements_are_those_of_the_scene_and_the_drives(robot: StockNode) -> None:
    """F56: poles in tf_environment_static. F20: torque of each spring is its stiffness times its deflection."""
    from tf2_msgs.msg import TFMessage

    joint = "arm_left_4_joint"
    static: list[TFMessage] = []
    links: dict[tuple[int, int], JointState] = {}
    springs: dict[tuple[int, int], JointState] = {}

    def stamp_of(message: JointState) -> tuple[int, int]:
        return message.header.stamp.sec, message.header.stamp.nanosec

    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    subscriptions = [
        robot.node.create_subscription(TFMessage, "/tf_environment_static", static.append, latched),
        robot.node.create_subscription(JointState, "/joint_states", lambda m: links.update({stamp_of(m): m}), 10),
        robot.node.create_subscription(
            JointState, f"/see/{joint}/state", lambda m: springs.update({stamp_of(m): m}), 10
        ),
    ]
    wait_until(lambda: static and len(links.keys() & springs.keys()) >= 5, lambda: robot.spin(0.05), "springs")
    for one in subscriptions:
        robot.node.destroy_subscription(one)
    model = generate(load_scene("harvest"))
    poles = model.fixed_start[model.fixed_organ == Organ.POLE]
    told = {one.child_frame_id: one.transform.translation for one in static[-1].transforms}
    assert list(told) == [f"pole_{i:04d}" for i in range(len(poles))]
    np.testing.assert_allclose([[one.x, one.y, one.z] for one in told.values()], poles, atol=1e-6)
    description = load_description("vinebot")
    stiffness = series_stiffness(description.drives)[description.joints.index(joint)]
    for stamp in links.keys() & springs.keys():
        link = links[stamp]
        spring = springs[stamp]
        place = link.name.index(joint)
        assert spring.name == [joint]
        assert spring.effort[0] == pytest.approx(stiffness * (spring.position[0] - link.position[place]), abs=1e-6)
        assert spring.effort[0] == pytest.approx(link.effort[place], abs=1e-9)
        assert abs(spring.effort[0]) > 0.5  # N m: it carries the forearm


def driver(peer: StockNode) -> Callable[[float, float], None]:
    """A function that commands a velocity of the base [m/s, rad/s] and takes messages for a moment."""
    commands = peer.node.create_publisher(TwistStamped, "/mobile_base_controller/cmd_vel", 1)

    def drive(ahead: float, turn: float) -> None:
        twist = TwistStamped()
        twist.twist.linear.x = ahead
        twist.twist.angular.z = turn
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
            lambda: drive(0.0, 1.0 if next(ways) // 16 % 2 else -1.0),
            "a push",
        )
        count = len(printed())
        wait_until(lambda: "back" in printed()[count - 1 :], lambda: drive(0.0, 0.0), "rest")


def _lamps_of(messages: list[MarkerArray]) -> tuple[float, float, float] | str | None:
    """The colour of the lamps by the newest message, None if they are off."""
    if not messages:
        return "not known"
    if messages[-1].markers[0].action == Marker.DELETEALL:
        return None
    colour = messages[-1].markers[0].color
    return round(colour.r, 3), round(colour.g, 3), round(colour.b, 3)


@pytest.mark.long
def test_a_low_battery_lights_the_signal_tower(robot: StockNode) -> None:
    """The pattern follows the charge with a margin, and the robot takes the command."""
    told: list[str] = []
    subscription = robot.node.create_subscription(
        String, "/indicator_lights/command", lambda message: told.append(message.data), 10
    )
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    shown: list[MarkerArray] = []
    lamps = robot.node.create_subscription(MarkerArray, "/indicator_lights/markers", shown.append, latched)
    battery = robot.node.create_publisher(BatteryState, "/battery_state", 10)
    with example("battery_light.py") as printed:
        said = ["waiting for /battery_state"]
        for charge, pattern in (
            (0.15, "warning"),
            (0.21, "warning"),
            (0.04, "alarm"),
            (0.06, "alarm"),
            (0.1, "warning"),
            (float("nan"), "warning"),
            (0.9, "off"),
        ):
            told.clear()
            if pattern != (said[1:] or ["off"])[-1]:
                said.append(pattern)

            def publish(charge: float = charge) -> None:
                battery.publish(BatteryState(percentage=charge))
                robot.spin(0.05)

            wait_until(lambda pattern=pattern: told[-1:] == [pattern] and printed() == said, publish, pattern)
            colour = {"warning": (1.0, 0.588, 0.0), "alarm": (1.0, 0.0, 0.0), "off": None}[pattern]
            wait_until(lambda colour=colour: _lamps_of(shown) == colour, publish, f"{pattern} lamps")
            if colour is not None:  # the tower's three lamps, where the URDF has them
                places = [(one.header.frame_id, round(one.pose.position.z, 3)) for one in shown[-1].markers]
                assert places == [("base_link", 0.356), ("base_link", 0.392), ("base_link", 0.428)]
        assert robot.node.count_subscribers("/indicator_lights/command") >= 2  # the robot, and this test
    robot.node.destroy_subscription(subscription)
    robot.node.destroy_subscription(lamps)
    robot.node.destroy_publisher(battery)


@pytest.mark.long
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
        future = ask.call_async(GetEntityState.Request(entity="robot"))
        wait_until(future.done, lambda: robot.spin(0.05), "a state")
        return yaw(future.result().state.pose.orientation)

    with example("localise.py", number=signal.SIGTERM) as printed:
        wait_until(lambda: own and others and "odom" not in own[-1], lambda: (printed(), robot.spin(0.05)), "tf")
        before = true_yaw()
        start = yaw(odometry[-1].pose.pose.orientation)
        drive = driver(robot)

        def counted() -> float:
            return turned(yaw(odometry[-1].pose.pose.orientation), start)

        def found() -> float:
            return turned(yaw(others[-1]["odom"].rotation), -yaw(own[-1]["base_footprint"].rotation))

        wait_until(lambda: counted() > 1.0, lambda: drive(0.0, 0.4))
        wait_until(lambda: abs(odometry[-1].twist.twist.angular.z) < 1e-3, lambda: drive(0.0, 0.0), "rest")

        def truth() -> float:
            return turned(true_yaw(), before)

        # commands and transforms that a busy machine held back may still come; then all hold
        wait_until(lambda: abs(turned(found(), truth())) < 0.04, lambda: drive(0.0, 0.0), "the true turn")
        lines = len(printed())
        wait_until(lambda: len(printed()) > lines, lambda: drive(0.0, 0.0), "the pose once more")
        x, y, angle = map(float, re.fullmatch(r"x (\S+) m, y (\S+) m, yaw (\S+) rad", printed()[-1]).groups())
        assert turned(angle, truth()) == pytest.approx(0.0, abs=0.05)
        assert abs(x) + abs(y) < 0.2  # it turned on the spot
        wait_until(lambda: abs(counted() - truth() / (1.0 - SLIP)) < 0.04, lambda: drive(0.0, 0.0), "odometry")
        assert abs(turned(found(), truth())) < 0.04
    settings = AsyncParameterClient(robot.node, "robot")
    asked = settings.get_parameters(["publish_map_to_odom"])
    wait_until(asked.done, lambda: robot.spin(0.05), "the parameter")
    assert asked.result().values[0].bool_value  # the example has restored the true pose
    for one in subscriptions:
        robot.node.destroy_subscription(one)


@pytest.mark.long
def test_goals_from_another_process_end_as_they_should(robot: StockNode) -> None:
    """A small version of ``vinesim bench ros``: one goal to its end, one cancelled, one preempted; none is kept."""
    done = subprocess.run(
        [sys.executable, "-m", "vinesim.bench.goal_sender", "--goals", "1", "--cancels", "1", "--preempts", "1"],
        capture_output=True,
        text=True,
        timeout=deadline(300.0),
        check=False,
    )
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert sorted(row["kind"] for row in rows) == ["cancel", "end", "goal", "preempt"]
    assert all(row["right"] for row in rows if row["kind"] != "end"), rows
    assert rows[-1]["known"] == 0
    for row in action_rows(rows):
        assert row.ratio is None or row.ratio >= 1.0, row


@pytest.mark.long
def test_resets_from_another_process_leave_nothing_behind(robot: StockNode) -> None:
    """A small version of the resets of ``vinesim bench ros``: spawned, driven and commanded before each."""
    done = subprocess.run(
        [sys.executable, "-m", "vinesim.bench.reset_caller", "--resets", "2"],
        capture_output=True,
        text=True,
        timeout=deadline(600.0),
        check=False,
        input="\n\n",
    )
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(rows) == 2
    for row in reset_rows(rows, {}):
        assert row.peer != "bar, at most" or row.value <= row.peer_value, (row, rows)
        assert row.peer != "bar, at least" or row.value >= row.peer_value, (row, rows)


def test_steps_of_the_paused_robot_are_told_of_and_cancelled(robot: StockNode) -> None:
    """By its ROS process; the robot's state says how many there were."""
    from rclpy.action import ActionClient
    from simulation_interfaces.action import SimulateSteps
    from simulation_interfaces.msg import Result, SimulationState
    from simulation_interfaces.srv import GetEntityState, SetSimulationState

    state = robot.node.create_client(GetEntityState, "/get_entity_state")
    setter = robot.node.create_client(SetSimulationState, "/set_simulation_state")
    actions = ActionClient(robot.node, SimulateSteps, "/simulate_steps")

    def wait_for(future: Future) -> Any:
        wait_until(future.done, lambda: robot.spin(0.05), "an answer")
        return future.result()

    def put(state: int) -> None:
        answer = wait_for(setter.call_async(SetSimulationState.Request(state=SimulationState(state=state))))
        assert answer.result.result == Result.RESULT_OK

    def steps_done() -> int:
        stamp = wait_for(state.call_async(GetEntityState.Request(entity="robot"))).state.header.stamp
        return stamp.sec * 100 + round(stamp.nanosec / 10**7)

    def send(steps: int, heard: list[int]) -> ClientGoalHandle:
        take = lambda message: heard.append(message.feedback.completed_steps)  # noqa: E731
        return wait_for(actions.send_goal_async(SimulateSteps.Goal(steps=steps), feedback_callback=take))

    servers = (state.service_is_ready, setter.service_is_ready, actions.server_is_ready)
    wait_until(lambda: all(is_ready() for is_ready in servers), lambda: robot.spin(0.05), "the simulation's node")
    put(SimulationState.STATE_PAUSED)
    heard: list[int] = []
    while heard[-1:] != [20]:  # the robot may not have found this node's subscription to feedback yet
        heard.clear()
        stood = steps_done()
        answer = wait_for(send(20, heard).get_result_async())
        assert (answer.status, answer.result.result.result) == (GoalStatus.STATUS_SUCCEEDED, Result.RESULT_OK)
        assert steps_done() == stood + 20
        for _ in range(10):
            robot.spin(0.02)
    assert heard == sorted(set(heard))
    stood = steps_done()
    heard.clear()
    handle = send(50_000, heard)
    wait_until(lambda: len(heard) > 5, lambda: robot.spin(0.05), "steps")
    assert len(wait_for(handle.cancel_goal_async()).goals_canceling) == 1
    answer = wait_for(handle.get_result_async())
    assert answer.status == GoalStatus.STATUS_CANCELED
    text = answer.result.result.error_message
    assert text == f"cancelled after {steps_done() - stood} of 50000 steps"
    put(SimulationState.STATE_PLAYING)
    actions.destroy()


def test_a_robot_without_a_server_shows_no_area_of_interest(robot: StockNode) -> None:
    heard: list[MarkerArray] = []
    subscription = robot.node.create_subscription(MarkerArray, "/vine/markers", heard.append, 10)
    wait_until(lambda: heard, lambda: robot.spin(0.05), "markers")
    robot.node.destroy_subscription(subscription)
    assert {one.ns for one in heard[-1].markers} == {"contacts"}


# ---------------------------------------------------------------- the commands vinesim ros


def tutorial_commands() -> dict[str, list[str]]:
    """What the tutorial gives to ``vinesim ros``, by the command's name and its first argument."""
    found = {}
    for line in (ROOT / "docs" / "tutorials" / "robot.md").read_text().splitlines():
        if re.match("vinesim ros (topics|hz|echo|pub|call) ", line):
            words = shlex.split(line, comments=True)[2:]
            found[" ".join(words[:2])] = words
    return found


@contextlib.contextmanager
def ros_command(words: list[str], number: signal.Signals = signal.SIGINT) -> Iterator[programs.Popen]:
    """Run ``vinesim ros`` with these words, and end it by a signal, as users do: in order, with exit code 0."""
    with programs.Popen(
        [sys.executable, "-m", "vinesim", "ros", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as command:
        try:
            yield command
            command.send_signal(number)
            _, said = command.communicate(timeout=deadline(30.0))
            assert (command.returncode, "Traceback" in said) == (0, False), said
        finally:
            command.kill()


def test_the_commands_of_the_tutorial_do_what_it_says(robot: StockNode) -> None:
    """They list and measure topics, print and publish messages, and call a service of the running robot."""
    commands = tutorial_commands()
    assert {name.split()[0] for name in commands} == {"topics", "hz", "echo", "pub", "call"}

    def run(name: str) -> str:
        command = [sys.executable, "-m", "vinesim", "ros", *commands[name]]
        done = programs.run(command, timeout=deadline(60.0))
        assert done.returncode == 0, done.stderr
        return done.stdout

    line = re.compile(r"^/joint_states +sensor_msgs/msg/JointState  1 -> \d+$", re.MULTILINE)
    wait_until(lambda: line.search(run("topics --types")), name="the list of topics")  # busy nodes are discovered late
    place = yaml.safe_load(run("echo /mobile_base_controller/odom").removesuffix("---\n"))
    assert place.keys() == {"x", "y", "z"}
    state = yaml.safe_load(run("call /get_entity_state"))
    assert state["result"]["result"] == 1
    assert state["state"]["pose"]["position"]["x"] == pytest.approx(5.0, abs=3.0)  # in the alley
    with ros_command(commands["hz /joint_states"]) as command:
        while (line := command.stdout.readline()) == "no new messages\n":
            pass
        rate = re.match(r"(\d+\.\d\d) Hz  gaps \d+\.\d to \d+\.\d ms, standard deviation", line)
        assert rate, line
        assert 1.0 < float(rate[1]) < 120.0  # 100 on an idle machine
    odometry: list[Odometry] = []
    subscription = robot.node.create_subscription(Odometry, "/mobile_base_controller/odom", odometry.append, 10)
    with ros_command(commands["pub /mobile_base_controller/cmd_vel"], signal.SIGTERM) as command:
        assert command.stdout.readline() == "publishing to /mobile_base_controller/cmd_vel at 10 Hz; Ctrl-C ends it\n"
        wait_until(
            lambda: odometry and odometry[-1].twist.twist.linear.x > 0.15,
            lambda: robot.spin(0.05),
            "a robot that drives",
        )
    wait_until(lambda: abs(odometry[-1].twist.twist.linear.x) < 1e-3, lambda: robot.spin(0.05), "rest")
    robot.node.destroy_subscription(subscription)
    with example("battery_light.py") as printed, ros_command(commands["pub /battery_state"]):
        wait_until(lambda: printed()[1:] == ["warning"], lambda: robot.spin(0.05), "a warning")


# ---------------------------------------------------------------- the folder ros/


RVIZ_TYPES = {
    "RobotModel": "std_msgs/msg/String",
    "Odometry": "nav_msgs/msg/Odometry",
    "Image": "sensor_msgs/msg/Image",
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "LaserScan": "sensor_msgs/msg/LaserScan",
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
}
"""What displays of rviz_default_plugins subscribe to."""
FOXGLOVE_PANELS = ("3D", "Image", "Plot", "DiagnosticSummary", "RawMessages", "StateTransitions")


def _panels_of(layout: dict | str) -> set[str]:
    """Panels that a Foxglove layout arranges."""
    if isinstance(layout, str):
        return {layout}
    return _panels_of(layout["first"]) | _panels_of(layout["second"])


def test_files_name_topics_that_there_are(robot: StockNode) -> None:
    """RViz, Foxglove and the parameter file against the topics and parameters of the running robot."""
    rviz = yaml.safe_load((FOLDER / "vinebot.rviz").read_text())
    layout = json.loads((FOLDER / "foxglove.json").read_text())
    named = set(re.findall(r'"(/[\w/]+)', json.dumps(rviz) + json.dumps(layout)))
    assert {"/robot_description", "/head_front_camera/depth/points", "/tf_environment"} <= named
    displays = {
        one.get("Topic", one.get("Description Topic"))["Value"]: one
        for one in rviz["Visualization Manager"]["Displays"]
        if "Topic" in one or "Description Topic" in one
    }
    assert displays.keys() <= named
    wait_until(
        lambda: named <= {name for name, _ in robot.node.get_topic_names_and_types()},
        lambda: robot.spin(0.05),
        f"topics {sorted(named)}",
    )
    types = dict(robot.node.get_topic_names_and_types())
    for topic, one in displays.items():
        name = one["Class"].removeprefix("rviz_default_plugins/")
        assert types[topic] == [RVIZ_TYPES[name]], topic
        (publisher,) = robot.node.get_publishers_info_by_topic(topic)
        asked = one.get("Topic", one.get("Description Topic"))
        is_latched = publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        assert asked["Durability Policy"] == ("Transient Local" if is_latched else "Volatile"), topic
        assert asked["Reliability Policy"] in ("Reliable", "Best Effort"), topic
    for panel, options in layout["configById"].items():
        kind = panel.split("!")[0]
        assert kind in FOXGLOVE_PANELS, panel
        if kind == "Image":
            mode = options["imageMode"]
            assert types[mode["imageTopic"]] == ["sensor_msgs/msg/Image"]
            assert types[mode["calibrationTopic"]] == ["sensor_msgs/msg/CameraInfo"]
            assert mode["imageTopic"].rpartition("/")[0] == mode["calibrationTopic"].rpartition("/")[0]
    assert _panels_of(layout["layout"]) == set(layout["configById"])
    assert rviz["Visualization Manager"]["Global Options"]["Fixed Frame"] == "map"


def test_the_parameter_file_names_parameters_that_there_are(robot: StockNode) -> None:
    def names(values: dict, above: str = "") -> Iterator[str]:
        for key, value in values.items():
            yield from names(value, f"{above}{key}.") if isinstance(value, dict) else [above + key]

    wanted = set(names(yaml.safe_load((FOLDER / "parameters.yaml").read_text())["/**"]["ros__parameters"]))
    declared: set[str] = set()
    for node in ("robot", "robot_sensors"):
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
        [sys.executable, "-m", "vinesim", "client", "--help"],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"COLUMNS": "200"},
    )
    assert [word for word in vinesim if str(word).startswith("--") and word not in done.stdout] == []
    assert pathlib.Path(rviz[2]).is_file()
    assert relay[-2:] == ["/tf_environment", "/tf"]
