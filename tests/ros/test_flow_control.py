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
from vinesim.client.client import Client
from vinesim.client.rate_loop import RateLoop
from vinesim.client.sensing.ros_process import RosProcess
from vinesim.client.sensing.ros_worker import QUEUE_CAPACITY
from vinesim.client.sensing.worker_process import HOLD_TIMEOUT
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description
from vinesim.scene.builder import assemble
from vinesim.scene.spec import load_scene

STEP = 10**7
"""[ns]"""


class Robot:
    """A client with one vinebot and its ROS process, and a stock node that reads /clock."""

    def __init__(self, peer: StockNode, ros: RosProcess, client: Client) -> None:
        self.peer, self.ros, self.client = peer, ros, client
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
    scene, vinebot = load_scene("demo"), load_description("vinebot")
    model = assemble([cane((50.0, 5.0, 1.0), radius=0.005)])
    with StockNode() as peer, RosProcess("robot", model, vinebot) as ros:
        client = Client(scene, model, vinebot, MemoryHub().bus("robot"), name="robot", pose=spawn_pose(scene, 0))
        ros.attach(client)
        one = Robot(peer, ros, client)
        one.run_until(lambda: len(one.clocks) >= 20)
        yield one


def test_the_loop_waits_for_a_process_that_gets_no_turn_and_every_step_arrives(robot):
    pid, first = robot.ros.worker.pid, robot.clocks[-1]
    os.kill(pid, signal.SIGSTOP)
    before = robot.loop.ticks
    robot.run_until(robot.ros.held)
    assert robot.ros.held() == "ROS messages"
    assert robot.ros.backlog == 1.0
    assert QUEUE_CAPACITY - 2 <= robot.loop.ticks - before <= QUEUE_CAPACITY
    os.kill(pid, signal.SIGCONT)
    last = robot.client.physics.time
    robot.run_until(lambda: robot.clocks[-1] >= round((last + robot.client.world_time.offset + 1.0) * 1e9))
    assert robot.ros.backlog < 0.5
    times = [t for t in robot.clocks if t >= first]
    assert times == list(range(first, times[-1] + 1, STEP))
    assert robot.ros.dropped_messages()["/clock"] == 0


def test_a_process_that_is_stopped_holds_the_loop_for_three_seconds_and_its_messages_are_counted(robot, caplog):
    pid, first = robot.ros.worker.pid, robot.clocks[-1]
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
