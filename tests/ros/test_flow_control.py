"""Nothing that every step publishes is lost on the way: the loop waits for the ROS process unless that stopped."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator

import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from rosgraph_msgs.msg import Clock

from tests.support.contact_scenes import cane
from tests.support.stock_node import StockNode, wait_until
from tests.support.stock_subscriber import TYPES, StockSubscriber, stock_subscriber
from vinesim.client.client import Client
from vinesim.client.processes.ros_process import RosProcess
from vinesim.client.processes.ros_worker import QUEUE_CAPACITY, Pace
from vinesim.client.processes.worker_process import HOLD_TIMEOUT
from vinesim.client.rate_loop import RateLoop
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.ros.topic import FIRST_LOOK, SUBSCRIBER_TIMEOUT, WIDE_WINDOW, WINDOW, FlowControl
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene

STEP = 10**7
"""[ns]"""
TOPICS = tuple(TYPES)


class Robot:
    """A client with one vinebot and its ROS process, and a stock node that reads /clock."""

    def __init__(self, peer: StockNode, ros: RosProcess, client: Client) -> None:
        self.peer = peer
        self.ros = ros
        self.client = client
        self.loop = RateLoop(client.physics.dt)
        self.clocks: list[int] = []
        """Stamps that came [ns]."""
        peer.node.create_subscription(Clock, "/clock", self._keep, 1000)

    def _keep(self, message: Clock) -> None:
        self.clocks.append(message.clock.sec * 10**9 + message.clock.nanosec)

    def step(self) -> str:
        """One tick in real time unless the loop is held; why it is."""
        cause = self.ros.held()
        if cause:
            time.sleep(0.002)
        else:
            self.loop.begin()
            self.client.tick()
            self.loop.end()
        for _ in range(5):
            self.peer.spin(0.0)
        return cause

    def run_until(self, condition: Callable[[], object]) -> None:
        wait_until(condition, self.step)


@pytest.fixture
def robot(monkeypatch, tmp_path) -> Iterator[Robot]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    scene = load_scene("demo")
    vinebot = load_description("vinebot")
    model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
    with StockNode() as peer, RosProcess("robot", model, vinebot) as ros:
        client = Client(scene, model, vinebot, MemoryHub().bus("robot"), name="robot", pose=spawn_pose(scene, 0))
        ros.attach(client)
        one = Robot(peer, ros, client)
        one.run_until(lambda: len(one.clocks) >= 20)
        yield one


def test_the_loop_waits_for_a_process_that_gets_no_turn_and_every_step_arrives(robot):
    pid = robot.ros.worker.pid
    first = robot.clocks[-1]
    os.kill(pid, signal.SIGSTOP)
    waits = robot.ros.worker.current().shared.wanted["waits"]
    while waits[0]:  # stopped while it waited for its subscriber
        os.kill(pid, signal.SIGCONT)
        robot.run_until(lambda: not waits[0])
        os.kill(pid, signal.SIGSTOP)
    before = robot.loop.ticks
    robot.run_until(robot.ros.held)
    assert robot.ros.held() == "ROS messages"
    assert robot.ros.backlog == 1.0
    assert robot.loop.ticks - before <= QUEUE_CAPACITY
    os.kill(pid, signal.SIGCONT)
    last = robot.client.physics.time
    robot.run_until(lambda: robot.clocks[-1] >= round((last + robot.client.world_time.offset + 1.0) * 1e9))
    robot.run_until(lambda: robot.ros.backlog < 0.5)
    times = [t for t in robot.clocks if t >= first]
    assert times == list(range(first, times[-1] + 1, STEP))
    assert robot.ros.dropped_messages()["/clock"] == 0


def test_a_process_that_is_stopped_holds_the_loop_for_three_seconds_and_its_messages_are_counted(robot, caplog):
    pid = robot.ros.worker.pid
    first = robot.clocks[-1]
    os.kill(pid, signal.SIGSTOP)
    robot.run_until(robot.ros.held)
    begin = time.monotonic()
    robot.run_until(lambda: not robot.ros.held())
    assert 0.9 * HOLD_TIMEOUT < time.monotonic() - begin < HOLD_TIMEOUT + 2.0
    robot.run_until(lambda: robot.ros.dropped_messages()["/clock"] >= 20)
    assert robot.ros.held() == ""
    assert caplog.messages == [
        "the ROS process of robot has done nothing for 3 s: until it goes on, its messages are lost, and counted"
    ]
    os.kill(pid, signal.SIGCONT)
    last = robot.clocks[-1]
    robot.run_until(lambda: robot.clocks[-1] >= last + 2 * 10**9 and robot.ros.backlog < 0.5)
    times = [t for t in robot.clocks if t >= first]
    assert times == sorted(set(times))
    missing = (times[-1] - first) // STEP + 1 - len(times)
    assert missing == robot.ros.dropped_messages()["/clock"]


def test_a_process_that_is_not_ready_does_not_hold_the_loop(robot):
    os.kill(robot.ros.worker.pid, signal.SIGKILL)
    wait_until(lambda: not robot.ros.worker.is_ready)
    assert robot.ros.held() == ""
    seen = len(robot.clocks)
    robot.run_until(lambda: len(robot.clocks) > seen + 10)


def missing(stamps: list[int], since: int = 0) -> int:
    """Stamps that are not there between the first and the last; :class:`AssertionError` if they are out of order."""
    stamps = [t for t in stamps if t >= since]
    assert stamps == sorted(set(stamps))
    return (stamps[-1] - stamps[0]) // STEP + 1 - len(stamps)


def run_for(robot: Robot, seconds: float) -> None:
    """Simulate so many seconds."""
    end = robot.client.physics.time + seconds
    robot.run_until(lambda: robot.client.physics.time >= end)


def until_listening(robot: Robot, *subscribers: StockSubscriber) -> int:
    """Simulate until all have had a message of each topic; the stamp of the newest step [ns]."""
    robot.run_until(lambda: all(one.listens for one in subscribers))
    return robot.clocks[-1]


def test_a_subscriber_that_often_waits_for_a_processor_misses_nothing(robot):
    """With rclpy's default history of ten, and held for half of the time."""
    with stock_subscriber(*TOPICS) as starved, stock_subscriber(*TOPICS) as other:
        begin = until_listening(robot, starved, other)
        with starved.starved(held=0.03, free=0.03):
            run_for(robot, 4.0)
        run_for(robot, 1.0)
        for one in (starved, other):
            heard = one.report()
            assert {topic: missing(stamps, begin) for topic, (stamps, _) in heard.items()} == dict.fromkeys(TOPICS, 0)
            assert all(stamps[-1] >= begin + 4 * 10**9 for stamps, _ in heard.values())


def test_a_subscriber_that_stops_holds_the_others_for_three_seconds_and_comes_back(robot):
    with stock_subscriber(*TOPICS) as stopped, stock_subscriber(*TOPICS) as other:
        begin = until_listening(robot, stopped, other)
        stopped.stop()
        robot.run_until(lambda: robot.ros.held() == "ROS subscribers")
        held_since = time.monotonic()
        robot.run_until(lambda: not robot.ros.held())
        assert time.monotonic() - held_since < SUBSCRIBER_TIMEOUT + 2.0
        run_for(robot, 2.0)
        robot.run_until(lambda: not robot.ros.held())
        last = robot.clocks[-1]
        stopped.go_on()
        run_for(robot, 2.0)
        heard = other.report()
        assert {topic: missing(stamps, begin) for topic, (stamps, _) in heard.items()} == dict.fromkeys(TOPICS, 0)
        for stamps, _ in stopped.report().values():
            missing(stamps)  # in order
            assert stamps[-1] > last


class FakeTopic:
    """A topic that acknowledges as the test says."""

    name = "/clock"
    subscription_count = 1

    def __init__(self) -> None:
        self.sent = 0
        self.acknowledged = 0
        self.is_local = True

    def is_acknowledged(self) -> bool:
        return self.acknowledged == self.sent


def test_no_more_messages_are_on_their_way_than_a_subscriber_keeps(caplog):
    """Fewer than half of rclpy's ten: what is acknowledged may still wait for the program. Far more on a network."""
    topic = FakeTopic()
    flow = FlowControl()
    while not flow.must_wait([topic], 0.0):
        topic.sent += 1
    assert FIRST_LOOK < topic.sent == WINDOW <= 5
    assert flow.must_wait([topic], 0.9 * SUBSCRIBER_TIMEOUT)
    topic.acknowledged = topic.sent
    assert not flow.must_wait([topic], 0.9 * SUBSCRIBER_TIMEOUT)
    topic.is_local = False
    while not flow.must_wait([topic], 5.0):
        topic.sent += 1
    assert topic.sent - topic.acknowledged == WIDE_WINDOW
    assert not caplog.messages
    assert not flow.must_wait([topic], 5.0 + SUBSCRIBER_TIMEOUT)
    for _ in range(1000):
        topic.sent += 1
        assert not flow.must_wait([topic], 10.0), "it is waited for no longer"
    assert len(caplog.messages) == 1
    topic.is_local = True
    topic.acknowledged = topic.sent
    assert not flow.must_wait([topic], 10.0)
    topic.sent += WINDOW
    assert flow.must_wait([topic], 10.0), "it is waited for again"


@pytest.mark.parametrize("rate", [30.0, 100.0, 1000.0])
def test_steps_that_have_waited_come_few_at_once_and_little_faster_than_the_world_makes_them(monkeypatch, rate):
    now = 0.0
    published = []
    monkeypatch.setattr("vinesim.client.processes.ros_worker.time.monotonic", lambda: now)
    pace = Pace()
    while now < 4.0:
        # a hundred steps wait all the time
        if (delay := pace.delay(100 + round(rate * now))) > 0.0:
            now += max(delay, 1e-6)
        else:
            pace.add()
            published.append(now)
    late = [t for t in published if t >= 2.0]
    assert len(late) / 2.0 == pytest.approx(max(1.5 * rate, 50.0), rel=0.03)
    most = max(sum(t <= u < t + 0.5 / rate for u in late) for t in late)
    assert most <= Pace.BURST
