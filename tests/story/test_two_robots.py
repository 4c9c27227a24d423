"""F54: one client controls several robots; each is a separate actor for others, and its topics have a prefix."""

import contextlib
import json
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

from tests.support import programs
from tests.support.waiting import deadline
from vinesim.client.client import Client
from vinesim.client.tasks.start_poses import QUEUE_SPACING, bunch_centres, find_reachable_bunch, spawn_pose, start_pose
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.robot.description.loader import load_description as load_robot
from vinesim.robot.tasks.push import PushBunch
from vinesim.scene.generation.vineyard import generate
from vinesim.scene.spec import load_scene

pytestmark = pytest.mark.slow

DT = 0.01
PROCESS_TIMEOUT = deadline(300.0)
"""Limit for a process to start or to end [s]; reached only by a failure."""


class TwoRobots:
    """A client with two robots, of which the second stands before the vines, and a client named visitor."""

    def __init__(self, visitor_back: float = 0.0) -> None:
        self.now = 100.0
        self.scene = load_scene("demo")
        self.model = generate(self.scene)
        self.hub = MemoryHub(delay=0.02)
        self.vinebot = load_robot("vinebot")
        start = spawn_pose(self.scene, 0)
        self.bunch = find_reachable_bunch(self.model, start)
        self.tree = int(self.model.body_tree[self.model.bunch_body[self.bunch]])
        self.farm = self.client("farm_1", start_pose(self.scene, 0, 4.0))
        self.farm.add_robot(self.vinebot, "farm_2", start, self.hub.bus("farm_2"))
        self.visitor = self.client("visitor", spawn_pose(self.scene, 1, visitor_back))

    def client(self, name: str, pose: np.ndarray) -> Client:
        bus = self.hub.bus(name)
        return Client(self.scene, self.model, self.vinebot, bus, name=name, pose=pose, clock=lambda: self.now)

    def reach(self) -> None:
        """The second robot pushes a bunch."""
        centre = bunch_centres(self.model)[self.bunch]
        robot = self.farm.robots["farm_2"]
        base, _ = self.farm.physics.rigid.base_state("farm_2")
        local = frames.rotate(frames.conjugate(base[3:]), centre - base[:3])
        side = "left" if local[1] >= 0.0 else "right"
        self.farm.pre_step.append(PushBunch(robot, side, lambda: centre, repeat=False).control)

    def until(self, condition, limit: float) -> None:
        for _ in range(round(limit / DT)):
            self.farm.tick()
            self.visitor.tick()
            self.hub.advance(DT)
            self.now += DT
            if condition():
                return
        pytest.fail(f"condition false after {limit} s of simulated time")


def test_two_robots_of_one_client_are_two_actors_for_others():
    world = TwoRobots()
    farm = world.farm
    visitor = world.visitor
    world.until(lambda: len(visitor.remote_actors) == 2 and len(farm.remote_actors) == 1, 3.0)
    assert set(visitor.remote_actors) == {"farm_1", "farm_2"}
    assert set(farm.remote_actors) == {"visitor"}
    assert farm.physics.rigid.robots == ("farm_1", "farm_2", "visitor")

    # each moves by its own commands, on both clients
    first, second = farm.robots.values()
    first.command_position([0.5], ["head_1_joint"])
    second.command_position([-0.5], ["head_1_joint"])
    head = world.vinebot.joints.index("head_1_joint")
    world.until(lambda: visitor.physics.rigid.joint_measurements("farm_2")[0][head] < -0.49, 3.0)
    assert visitor.physics.rigid.joint_measurements("farm_1")[0][head] == pytest.approx(0.5, abs=0.02)

    # the second robot publishes what it touches, and the copy at the visitor moves
    world.reach()
    world.until(lambda: visitor.replicator.owner(world.tree) == "farm_2", 15.0)
    assert farm.replicators["farm_2"].owner(world.tree) == "farm_2"
    here = world.model.bodies_of(world.tree)
    rest = world.model.joint_settled[here]

    def moved(client: Client) -> float:
        """Largest turn of a joint of the touched tree [rad]."""
        cosine = np.abs((client.physics.state.joint_q[here] * rest).sum(1))
        return float(2.0 * np.arccos(np.clip(cosine, 0.0, 1.0)).max())

    world.until(lambda: moved(farm) > 0.2, 10.0)
    world.until(lambda: moved(visitor) > 0.15, 1.0)
    assert farm.replicator.counters.environment.bytes_out == 0
    assert farm.replicators["farm_2"].counters.environment.bytes_out > 0


@pytest.mark.long
def test_two_robots_of_one_client_send_each_other_no_plants():
    """With the visitor 20 m away, one robot touches a vine beside the other robot of its client: no byte is sent."""
    world = TwoRobots(visitor_back=20.0)
    world.reach()
    world.until(lambda: world.farm.interest_audit.ticks_touching > 20, 15.0)
    assert world.farm.interest_audit.bytes == 0
    assert sum(e.counters.environment.bytes_out for e in world.farm.replicators.values()) == 0


def test_robots_of_one_client_start_side_by_side_then_in_a_queue():
    scene = load_scene("demo")
    poses = [start_pose(scene, 0, 0.0, i) for i in range(2 * len(scene.spawns))]
    first = poses[0]
    behind = poses[len(scene.spawns)]
    assert np.linalg.norm(first[:3] - behind[:3]) == pytest.approx(QUEUE_SPACING)
    distances = [np.linalg.norm(a[:2] - b[:2]) for i, a in enumerate(poses) for b in poses[:i]]
    assert min(distances) > 1.1


@pytest.mark.ros
def test_each_robot_publishes_under_its_prefix():
    """A stock ROS node receives the topics of both, each under its own prefix, and one clock."""
    topics = [
        "/clock",
        *(f"/farm_{i}/{topic}" for i in (1, 2) for topic in ("joint_states", "mobile_base_controller/odom", "tf")),
    ]
    options = [option for topic in topics for option in ("--topic", topic)]
    robots = ["--robot", "vinebot", "--robot", "vinebot", "--name", "farm", "--status", "json"]
    with contextlib.ExitStack() as stack:
        monitor, client = (
            stack.enter_context(
                programs.Popen(
                    [sys.executable, "-m", *command],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                )
            )
            for command in (
                ["vinesim.ros.tools.topic_monitor", *options],
                ["vinesim", "client", *robots],
            )
        )
        for process in (monitor, client):
            stack.callback(process.kill)
        watchdog = threading.Timer(PROCESS_TIMEOUT, client.kill)
        watchdog.start()
        stack.callback(watchdog.cancel)
        subscribed = None
        for status in map(json.loads, client.stdout):
            # a node waits for a second before it publishes /clock
            if subscribed is None and {"/clock", "joint_states"} <= status["topics"].keys():
                subscribed = status["time"]
            if subscribed is not None and status["time"] > subscribed + 2.0:
                break
        client.send_signal(signal.SIGINT)
        _, errors = client.communicate(timeout=PROCESS_TIMEOUT)
        assert client.returncode == 0, errors
        received, _ = monitor.communicate(timeout=PROCESS_TIMEOUT)
    report = json.loads(received)
    for topic in topics:
        assert report[topic]["count"] > 20, (topic, report)
    assert report["/clock"]["lost"] is not None, "one publisher"
