"""Two whole clients, each with a robot, in one world and one ROS domain: one clock, and no name or frame twice."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import collections
import itertools
import os
import signal
from collections.abc import Iterator

import numpy as np
import psutil
import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray

from tests.support.stock_node import StockNode, wait_until
from vinesim.client.programs import Program, ProgramGroup, program_group
from vinesim.client.world_time import MAX_LAG
from vinesim.ros.messages import message_packages
from vinesim.ros.robot_node import RobotNode
from vinesim.ros.tools.subscribing import offered_qos

SHARED = {"/clock", "/diagnostics", "/rosout", "/parameter_events"}
"""Topics that are the same whatever the namespace."""
TF = "tf2_msgs/msg/TFMessage"
INTEREST_RADIUS = 4.5
"""[m] Of all clients: near their default."""
NEWEST = 300
"""Messages of a topic whose stamps are compared with the time at which they were sent."""


@pytest.fixture(scope="module")
def peer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StockNode]:
    """A stock node in a ROS domain of this module."""
    message_packages.ensure_importable(["tf2_msgs"])
    variables = {
        "ROS_DOMAIN_ID": str(1 + os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(tmp_path_factory.mktemp("log")),
    }
    with pytest.MonkeyPatch.context() as monkeypatch:
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        with StockNode() as node:
            yield node


def test_two_robots_under_one_namespace_are_told_of_in_one_line(peer: StockNode, caplog) -> None:
    with RobotNode("one", "<robot name='one'/>"), RobotNode("two", "<robot name='two'/>", clock=False):
        wait_until(lambda: len(caplog.records) >= 2, peer.spin)
    told = sorted(record.getMessage() for record in caplog.records)
    assert told == [
        f"{one} and {other} publish /mobile_base_controller/odom: frames, joints and commands of two robots mix; "
        "give each client its own --namespace"
        for one, other in (("/one", "/two"), ("/two", "/one"))
    ]


class World:
    """A server and its clients, and a stock node that hears every message of /clock."""

    def __init__(self, group: ProgramGroup, peer: StockNode) -> None:
        self._group = group
        self.peer = peer
        _, self._endpoint = group.start_server()
        self.clients: dict[str, Program] = {}
        self.clocks: list[tuple[int, int]] = []
        """Time [ns] and number of each message, which its publisher counts."""
        self.clock_leads: collections.deque[int] = collections.deque(maxlen=NEWEST)
        """Of the newest messages, by how much its time is ahead of the wall time at which it was sent [ns]."""
        peer.node.create_subscription(Clock, "/clock", self._take_clock, 1000)

    def start(self, name: str, spawn: int) -> None:
        """Start a client whose robot has this name and namespace, and an :data:`INTEREST_RADIUS`."""
        self.clients[name] = self._group.start(
            name,
            "-m",
            "vinesim",
            "client",
            "--role",
            "robot",
            "--connect",
            self._endpoint,
            "--name",
            name,
            "--namespace",
            f"/{name}/",
            "--spawn",
            str(spawn),
            "--status",
            "none",
            "--interest-radius",
            str(INTEREST_RADIUS),
        )

    def look(self) -> None:
        """Take messages for a moment; every client must be running."""
        for client in self.clients.values():
            client.new_lines()
        for _ in range(20):
            self.peer.spin(0.002)

    def clock_publishers(self) -> list[str]:
        """Names of the robots whose node publishes /clock."""
        return [one.node_name for one in self.peer.node.get_publishers_info_by_topic("/clock")]

    def kill(self, name: str, *, whole: bool) -> list[psutil.Process]:
        """Kill a client's process by SIGKILL; with ``whole`` also those that it has started, at once. Returns these."""
        client = psutil.Process(self.clients.pop(name).child.pid)
        others = client.children(recursive=True)
        killed = [client, *others] if whole else [client]
        for what in (signal.SIGSTOP, signal.SIGKILL):
            for process in killed:
                process.send_signal(what)
        return others

    def _take_clock(self, message: Clock, info: dict) -> None:
        time = message.clock.sec * 10**9 + message.clock.nanosec
        self.clocks.append((time, info["publication_sequence_number"]))
        self.clock_leads.append(time - info["source_timestamp"])

    def successions(self) -> int:
        """How often another publisher followed, as the numbers of messages tell; times must rise all along."""
        times, numbers = zip(*self.clocks, strict=True)
        assert list(times) == sorted(set(times)), "/clock went back or stood"
        return sum(after <= before for before, after in itertools.pairwise(numbers))


@pytest.fixture(scope="module")
def world(peer: StockNode) -> Iterator[World]:
    """Two clients that were started at once."""
    with program_group(10.0) as group:
        one = World(group, peer)
        one.start("north", 0)
        one.start("south", 1)
        wait_until(lambda: len(one.clocks) > 100 and len(robots(peer)) == 2, one.look, "two robots and a clock")
        yield one


def robots(peer: StockNode) -> set[str]:
    """Namespaces of the robots whose nodes are all there."""
    nodes = set(peer.node.get_node_names_and_namespaces())
    names = {name for name, _ in nodes}
    return {name for name in names if {(name + part, f"/{name}") for part in ("", "_sensors", "_simulation")} <= nodes}


@pytest.mark.slow
def test_names_and_frames_of_two_clients_do_not_collide(world: World, peer: StockNode) -> None:
    """Nodes, topics and services have one owner each, and a frame one publisher and one parent in a robot's tf."""
    from tf2_msgs.msg import TFMessage

    ours = {name: f"/{name}" for name in ("north", "south")}
    nodes = [one for one in peer.node.get_node_names_and_namespaces() if one[1] in ours.values()]
    assert len(nodes) == len(set(nodes)) == 6
    services = [name for one in nodes for name, _ in peer.node.get_service_names_and_types_by_node(*one)]
    assert len(services) == len(set(services)) > 50
    types = {name: kind for name, (kind, *_) in peer.node.get_topic_names_and_types()}
    publishers = {topic: peer.node.get_publishers_info_by_topic(topic) for topic in types}
    for topic in types.keys() - SHARED:
        owners = [one.node_namespace for one in publishers[topic] if one.node_namespace in ours.values()]
        assert owners in ([], [f"/{topic.split('/')[1]}"]), topic

    parents: dict[str, dict[str, set[str]]] = {topic: {} for topic, kind in types.items() if kind == TF}

    def take(topic: str, message: TFMessage) -> None:
        for one in message.transforms:
            parents[topic].setdefault(one.child_frame_id, set()).add(one.header.frame_id)

    subscriptions = [
        peer.node.create_subscription(
            TFMessage, topic, lambda message, topic=topic: take(topic, message), offered_qos(publishers[topic], 100)
        )
        for topic in parents
    ]
    wait_until(lambda: all(parents.values()), world.look, "all frames")
    for one in subscriptions:
        peer.node.destroy_subscription(one)
    assert {topic.split("/")[1] for topic in parents} == ours.keys()
    for space in ours.values():
        moving = parents[f"{space}/tf"]
        fixed = parents[f"{space}/tf_static"]
        assert moving.keys().isdisjoint(fixed)
        assert all(len(of) == 1 for of in (*moving.values(), *fixed.values()))
        for frame in moving.keys() | fixed.keys():
            while frame != "map":  # ends: every frame hangs on the map
                (frame,) = (moving | fixed)[frame]


@pytest.mark.slow
def test_markers_show_the_area_of_interest_of_each_client(world: World, peer: StockNode) -> None:
    heard: dict[str, list[MarkerArray]] = {"north": [], "south": []}
    subscriptions = [
        peer.node.create_subscription(MarkerArray, f"/{name}/vine/markers", messages.append, 10)
        for name, messages in heard.items()
    ]
    wait_until(lambda: all(heard.values()), world.look, "markers")
    for one in subscriptions:
        peer.node.destroy_subscription(one)
    for messages in heard.values():
        (circle,) = [one for one in messages[-1].markers if one.ns == "interest"]
        assert [np.hypot(point.x, point.y) for point in circle.points] == pytest.approx(
            [INTEREST_RADIUS] * len(circle.points)
        )


@pytest.mark.slow
def test_stamps_of_both_clients_compare_with_the_one_clock(world: World, peer: StockNode) -> None:
    """At one moment, what either client stamps and what /clock says differ by no more than a client may be off.

    Of the newest messages the one counts that was sent soonest after its step: the others only tell how busy the
    machine is. A client that the machine starves for seconds sends none in time; those seconds pass.
    """
    leads = collections.defaultdict[str, collections.deque[int]](lambda: collections.deque(maxlen=NEWEST))

    def take(name: str, message: JointState, info: dict) -> None:
        stamp = message.header.stamp
        leads[name].append(stamp.sec * 10**9 + stamp.nanosec - info["source_timestamp"])

    world.clock_leads.clear()
    subscriptions = [
        peer.node.create_subscription(
            JointState, f"/{name}/joint_states", lambda message, info, name=name: take(name, message, info), 1000
        )
        for name in ("north", "south")
    ]
    counted = (world.clock_leads, leads["north"], leads["south"])

    def apart() -> float:
        """By how much the stamps of a client differ from /clock [s]."""
        clock, *others = map(max, counted)
        return np.abs(np.array(others) - clock).max() * 1e-9

    wait_until(lambda: all(len(one) == NEWEST for one in counted), world.look, "stamps")
    wait_until(lambda: apart() < 2 * MAX_LAG, world.look, "stamps that compare")
    for one in subscriptions:
        peer.node.destroy_subscription(one)
    assert len(world.clock_publishers()) == 1
    assert world.successions() == 0


@pytest.mark.long
def test_another_client_takes_the_clock_over_and_it_never_goes_back(world: World, peer: StockNode) -> None:
    """After SIGKILL of a client's process, whose others then leave by themselves; and of all its processes, which are
    missed only when their lease has run out."""
    spawns = {"north": 0, "south": 1}
    names = iter(("west", "east"))
    for successions, whole in enumerate((False, True), start=world.successions() + 1):
        (leader,) = world.clock_publishers()
        ended = world.kill(leader, whole=whole)
        (heir,) = world.clients
        wait_until(lambda heir=heir: world.clock_publishers() == [heir], world.look, f"a clock of {heir}")
        since = len(world.clocks)
        wait_until(lambda since=since: len(world.clocks) > since + 200, world.look, "its messages")
        assert world.successions() == successions
        wait_until(lambda ended=ended: not any(map(is_alive, ended)), world.look, "the end of the client's processes")
        name = next(names)
        spawns[name] = spawns[leader]
        world.start(name, spawns[name])
        wait_until(lambda name=name, heir=heir: robots(peer) == {name, heir}, world.look, f"{name} in the domain")
    since = len(world.clocks)
    wait_until(lambda: len(world.clocks) > since + 300, world.look, "the same clock")
    assert world.clock_publishers() == [heir]
    assert world.successions() == successions


def is_alive(process: psutil.Process) -> bool:
    """Whether a process runs; one that ended and that nobody waited for does not."""
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
