"""The processes of one robot as a stock node sees them: every step's messages, restarts, diagnostics."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import copy
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter, parameter_value_to_python
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Image, JointState, PointCloud2
from std_msgs.msg import Float64MultiArray

from tests.support.contact_scenes import cane
from tests.support.stock_node import StockNode, wait_until
from vinesim.client.client import Client
from vinesim.client.processes import ros_worker
from vinesim.client.processes.robot_processes import RobotProcesses
from vinesim.client.processes.ros_worker import RosChannel, RosConfig, RosWorker
from vinesim.client.processes.step_record import MAX_CONTACTS, StepRecords
from vinesim.client.rate_loop import RateLoop
from vinesim.client.status import Status
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.ros.commands.types import GoalResult, GoalStatus
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene
from vinesim.scene.values import Contact

CAMERA = "head_front_camera"


class Robot:
    """A client with one vinebot far from a single cane, its processes, and a stock node that listens."""

    def __init__(self, peer: StockNode) -> None:
        self.peer = peer
        scene = load_scene("demo")
        vinebot = load_description("vinebot")
        model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
        self.processes = RobotProcesses("robot", scene, model, vinebot, sensor_hz=5.0, standby=True)
        self.client = Client(scene, model, vinebot, MemoryHub().bus("robot"), name="robot", pose=spawn_pose(scene, 0))
        self.loop = RateLoop(self.client.physics.dt)
        self.status = Status(self.client, self.loop, self.processes.sent_messages, sensors=self.processes.status)

    def subscribe(self, message: type, topic: str, queue: int = 10) -> list:
        """Messages from now on, received with the default QoS of rclpy and a queue of so many messages."""
        received: list = []
        self.peer.node.create_subscription(message, topic, received.append, queue)
        return received

    def step(self) -> None:
        """One tick in real time, a status every hundred, and whatever the stock node has received."""
        self.loop.begin()
        self.client.tick()
        self.loop.end()
        if self.loop.ticks % 100 == 0:
            self.processes.publish_diagnostics(self.status.current())
        for _ in range(5):
            self.peer.spin(0.0)

    def run_until(self, condition: Callable[[], object]) -> None:
        wait_until(condition, self.step)


@pytest.fixture
def robot(monkeypatch, tmp_path) -> Iterator[Robot]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    with StockNode() as peer:
        one = Robot(peer)
        with one.processes:
            one.processes.attach(one.client)
            yield one


def call(robot: Robot, kind: type, service: str, **fields: Any) -> Any:
    """The response of a service."""
    client = robot.peer.node.create_client(kind, service)
    robot.run_until(client.service_is_ready)
    answer = client.call_async(kind.Request(**fields))
    robot.run_until(answer.done)
    robot.peer.node.destroy_client(client)
    return answer.result()


def set_parameter(robot: Robot, node: str, name: str, value: float) -> None:
    message = Parameter(name, value=value).to_parameter_msg()
    assert call(robot, SetParameters, f"{node}/set_parameters", parameters=[message]).results[0].successful


def get_parameter(robot: Robot, node: str, name: str) -> Any:
    return parameter_value_to_python(call(robot, GetParameters, f"{node}/get_parameters", names=[name]).values[0])


def nanoseconds(message: Clock) -> int:
    return message.clock.sec * 10**9 + message.clock.nanosec


def test_every_step_is_published_once_and_in_order_or_counted_as_lost(robot):
    """Exactly by the counts of the process. A stock reader receives all within one of a few windows of 3 s: without
    a processor for a second it loses messages, as the publisher keeps no more than a hundred."""
    wanted = wanted_topics(robot)
    clocks = robot.subscribe(Clock, "/clock", 1000)
    joints = robot.subscribe(JointState, "/joint_states")
    robot.run_until(lambda: len(clocks) >= 20 and joints)
    missing = []
    while 0 not in missing and len(missing) < 5:
        first = nanoseconds(clocks[-1])
        lost_before = lost_clocks(robot)
        robot.run_until(lambda first=first: nanoseconds(clocks[-1]) - first >= 3 * 10**9)
        times = [t for t in map(nanoseconds, clocks) if t >= first]
        steps = (times[-1] - first) // 10**7 + 1
        missing.append(max(0, steps - len(times) - (lost_clocks(robot) - lost_before)))
        assert times == sorted(set(times))
        assert {t % 10**7 for t in times} == {0}
    assert 0 in missing
    check_clock_counts(robot, wanted)


@pytest.mark.long
def test_pictures_and_clouds_come_and_killed_processes_come_back_and_diagnostics_say_so(robot):
    """To subscribers with the default QoS of rclpy."""
    topics = {
        f"/{CAMERA}/rgb/image_raw": Image,
        f"/{CAMERA}/depth/image_raw": Image,
        f"/{CAMERA}/depth/points": PointCloud2,
        "/lidar/points": PointCloud2,
    }
    received = [robot.subscribe(message, topic) for topic, message in topics.items()]
    pictures = received[0]
    joints = robot.subscribe(JointState, "/joint_states")
    robot.run_until(lambda: all(len(messages) >= 2 for messages in received))
    diagnostics = robot.subscribe(DiagnosticArray, "/diagnostics")

    def sensors() -> tuple[bytes, str] | None:
        """Level and message of the newest status of the sensors."""
        found = [(s.level, s.message) for array in diagnostics for s in array.status if s.name.endswith(": sensors")]
        return found[-1] if found else None

    robot.run_until(lambda: pictures and joints and sensors() == (DiagnosticStatus.OK, "well"))
    values = {"/robot": ("environment_rate", 4.0), "/robot_sensors": (f"{CAMERA}.jpeg_quality", 40)}
    for node, (name, value) in values.items():
        set_parameter(robot, node, name, value)
    workers = robot.processes.ros, robot.processes.sensors
    robot.run_until(lambda: all(one.worker.config.parameters for one in workers))
    commands = robot.peer.node.create_publisher(Float64MultiArray, "/forward_position_controller/commands", 10)
    robot.run_until(commands.get_subscription_count)
    commands.publish(Float64MultiArray(data=[1.0, 2.0]))  # it has more joints
    robot.run_until(lambda: robot.status.current()["faults"].get("commands_refused") == 1)
    worker = robot.processes.sensors.worker
    robot.run_until(lambda: worker.standby_pid is not None)
    standby = worker.standby_pid
    os.kill(standby, signal.SIGSTOP)  # it takes over only later
    os.kill(worker.current().process.pid, signal.SIGKILL)
    robot.run_until(lambda: sensors()[0] == DiagnosticStatus.ERROR)
    assert not robot.status.current()["sensors_ready"]
    os.kill(standby, signal.SIGCONT)
    robot.run_until(lambda: sensors() == (DiagnosticStatus.WARN, "sensor process restarted"))
    seen = len(pictures)
    robot.run_until(lambda: len(pictures) > seen)
    assert robot.status.current()["sensor_restarts"] == 1

    os.kill(robot.processes.ros.worker.current().process.pid, signal.SIGKILL)
    robot.run_until(lambda: robot.status.current()["ros_restarts"] == 1)
    seen = len(joints), len(diagnostics)
    robot.run_until(lambda: len(joints) > seen[0] + 20 and len(diagnostics) > seen[1])
    for node, (name, value) in values.items():
        assert get_parameter(robot, node, name) == value, "parameters that were set hold for the new process"
    assert robot.status.current()["faults"]["commands_refused"] == 1, "what the killed process refused is not forgotten"


@pytest.mark.long
def test_of_a_process_that_stops_for_a_while_every_step_is_sent_or_counted_as_lost(robot):
    wanted = wanted_topics(robot)
    clocks = robot.subscribe(Clock, "/clock")
    robot.run_until(lambda: len(clocks) >= 5)
    process = robot.processes.ros.worker.current().process
    os.kill(process.pid, signal.SIGSTOP)
    begin = robot.loop.ticks
    robot.run_until(lambda: lost_clocks(robot) >= 10)
    assert robot.loop.ticks - begin < 150  # a second of steps waits, more are lost; the loop waits for nothing
    os.kill(process.pid, signal.SIGCONT)
    last = nanoseconds(clocks[-1])
    robot.run_until(lambda: nanoseconds(clocks[-1]) > last + 2 * 10**9)
    times = list(map(nanoseconds, clocks))
    assert times == sorted(set(times))
    check_clock_counts(robot, wanted)


def wanted_topics(robot: Robot) -> list[np.ndarray]:
    """Of every step from now on, which topics of steps the process asks for."""
    wanted: list[np.ndarray] = []
    robot.client.post_step.append(
        lambda _: wanted.append(robot.processes.ros.worker.current().shared.wanted["steps"].copy())
    )
    return wanted


def check_clock_counts(robot: Robot, wanted: list[np.ndarray]) -> None:
    """Each step that was wanted on /clock was sent or counted as lost.

    One more or less: the subscription may be seen between the step and its count. And the process publishes a step that
    it received for another topic on /clock as well, once it has seen a subscriber; the client learns of that one later.
    """
    at_least = sum(int(topics[0]) for topics in wanted)
    at_most = sum(int(topics.any()) for topics in wanted)
    wait_until(lambda: robot.processes.sent_messages()["/clock"] + lost_clocks(robot) >= at_least - 1)
    assert robot.processes.sent_messages()["/clock"] + lost_clocks(robot) <= at_most + 1


def lost_clocks(robot: Robot) -> int:
    return robot.processes.dropped_messages().get("/clock", 0)


def test_a_record_holds_a_sample_exactly():
    scene = load_scene("demo")
    model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
    vinebot = load_description("vinebot")
    bus = MemoryHub().bus("robot")
    client = Client(scene, model, vinebot, bus, name="robot", pose=spawn_pose(scene, 0))
    client.tick()
    contacts = [
        Contact("robot", f"robot/{link}", i, np.full(3, i + 0.5), np.full(3, 2.0 * i), -0.001 * i)
        for i, link in enumerate((*list(client.robot.description.link_anchors)[:3], "unknown"))
    ]
    sample = client.robot.sample(client.physics.time, contacts)
    records = StepRecords("robot", client.robot.description, client.robot.series_stiffness)
    row = np.zeros(1, records.dtype)[0]
    assert records.write(row, client.physics.time, sample) == 0
    copy = records.read(row)
    for name in ("base_q", "base_qd", "odom_q", "odom_qd", "odom_covariance", "transform_q"):
        assert np.array_equal(getattr(copy, name), getattr(sample, name)), name
    for name in ("position", "velocity", "effort", "contact"):
        assert np.array_equal(getattr(copy.joints, name), getattr(sample.joints, name)), name
    assert (copy.actor, copy.transforms, copy.joints.names) == (sample.actor, sample.transforms, sample.joints.names)
    assert [c.link for c in copy.contacts] == [*[c.link for c in contacts[:3]], ""]
    assert [c.force.tolist() for c in copy.contacts] == [c.force.tolist() for c in contacts]
    np.testing.assert_allclose(copy.elements.motor, sample.elements.motor, rtol=1e-12)
    np.testing.assert_allclose(copy.elements.torque, sample.elements.torque, rtol=1e-12)
    assert [(w.name, w.force.tolist()) for w in copy.wrenches] == [(w.name, w.force.tolist()) for w in sample.wrenches]
    assert [u.linear_acceleration.tolist() for u in copy.imus] == [u.linear_acceleration.tolist() for u in sample.imus]
    many = client.robot.sample(client.physics.time, contacts[:1] * (MAX_CONTACTS + 5))
    assert records.write(row, client.physics.time, many) == 5
    # of a step before the loop knew that a sensor of the body has a subscriber, no reading is made up
    records.write(row, client.physics.time, client.robot.sample(client.physics.time, (), body_sensors=False))
    assert records.read(row).imus == records.read(row).wrenches == ()


class RecordingNode:
    """Takes the place of the robot's node, and notes what it is told, in order."""

    set_parameters: dict[str, Any] = {}  # noqa: RUF012 (constant)
    has_goals = False
    environment_rate = 10.0
    refused_commands = 0

    def __init__(self, *_, **__) -> None:
        self.told: list[tuple[str, Any]] = []
        self.sent: dict[str, int] = {}
        self.dropped: dict[str, int] = {}

    def publish_clock(self, time: float) -> None:
        self.told.append(("clock", time))

    def finish_goal(self, result: GoalResult) -> None:
        self.told.append(("end", result.goal))

    def publish_environment_static(self, *_) -> None:
        pass

    def has_subscribers(self, _: str) -> bool:
        return True

    def must_wait(self, _: float) -> bool:
        return False

    def commands(self) -> list:
        return []

    def __enter__(self) -> RecordingNode:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def test_a_result_is_sent_after_the_steps_that_led_to_it(monkeypatch):
    """However long the steps have waited for the process, and when the result overtakes them on the way to it."""
    monkeypatch.setattr("vinesim.ros.robot_node.RobotNode", RecordingNode)
    monkeypatch.setattr(middleware, "configure", lambda **_: None)
    monkeypatch.setattr(ros_worker, "report_ready", lambda *_: None)  # it lowers the priority of its process
    description = load_description("vinebot")
    context = multiprocessing.get_context("spawn")
    records = StepRecords("robot", description, np.zeros(len(description.joints)))
    config = RosConfig(
        "robot", "", description.base, "", False, (), np.zeros((0, 7)), records, 0, np.zeros(0, np.int32), (), (), ()
    )
    channel = RosChannel(config, context)
    (ours, theirs) = context.Pipe()
    read_end = copy.copy(channel)
    read_end.steps = copy.copy(channel.steps)  # each end counts for itself, as in two processes
    worker = RosWorker(config, read_end, theirs)
    assert isinstance(worker.node, RecordingNode)
    told = worker.node.told
    thread = threading.Thread(target=worker.run, daemon=True)
    try:
        for time in (1.0, 2.0, 3.0):
            with channel.steps.put() as record:
                assert record is not None
                record["time"], record["has_state"] = time, False
            if time == 2.0:
                ours.send(("finish", (channel.steps.put_count, GoalResult(b"1", GoalStatus.SUCCEEDED, 0))))
        ours.send(("finish", (channel.steps.put_count + 1, GoalResult(b"2", GoalStatus.SUCCEEDED, 0))))
        channel.steps.wake()
        thread.start()
        wait_until(lambda: len(told) >= 4)
        with channel.steps.put() as record:
            assert record is not None
            record["time"], record["has_state"] = 4.0, False
        channel.steps.wake()
        wait_until(lambda: len(told) >= 6)
        assert told == [("clock", 1.0), ("clock", 2.0), ("end", b"1"), ("clock", 3.0), ("clock", 4.0), ("end", b"2")]
    finally:
        ours.send(("stop", None))
        thread.join()
        channel.close()
        ours.close()
