"""Clocks that are set by an hour while a world runs: that of a server, and the time of day of any machine."""

from __future__ import annotations

import pathlib
import re

import pytest

import vinesim
from benchmarks.support.fake_client import FakeClient, tree_row
from vinesim.net.codec.control import decode_time, encode_time
from vinesim.net.replication.clock_sync import ClockEstimate, Ping
from vinesim.net.transport.memory_bus import MemoryHub

TICK = 0.01
TREE = 0


class World:
    """Two clients beside one tree, and a server whose clock can be set."""

    def __init__(self) -> None:
        self.hub = MemoryHub(delay=0.02)
        self.server_offset = 1e6
        self.hub.bus("server").declare_queryable(
            "clock/*", lambda asked: encode_time(decode_time(asked)[0], self.server_time)
        )
        model = tree_row(2)
        self.ada, self.bob = (
            FakeClient(self.hub.bus(name), model, (x, 0.0)) for name, x in (("ada", 1.0), ("bob", 2.0))
        )

    @property
    def server_time(self) -> float:
        return self.hub.time + self.server_offset

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK)):
            self.hub.advance(TICK)
            for client in (self.ada, self.bob):
                client.tick(self.hub.time)


@pytest.mark.parametrize("step", [-3600.0, 3600.0, -2.0])
def test_a_server_whose_clock_is_set_stops_no_stream(step):
    """Another server in the place of the first one begins with its own time of day if no client has reported to it."""
    world = World()
    world.run(1.5)
    world.ada.apply({"touch": [TREE]})
    world.run(1.5)
    assert world.bob.replicator.owner(TREE) == "ada"
    world.server_offset += step
    world.run(4.0)
    for client in (world.ada, world.bob):
        assert client.replicator.offset == pytest.approx(world.server_offset, abs=0.05)
        assert client.replicator.owner(TREE) == "ada"
        assert client.left_at == {}
    for _ in range(5):
        world.run(0.2)
        assert world.bob.heard[TREE] > world.hub.time - 0.25, "states of the tree arrive"
        for seen, shown in ((world.ada, world.bob.robots["ada"]), (world.bob, world.ada.robots["bob"])):
            error = abs(shown.position - seen.pose(world.hub.time).position).max()
            assert error < 0.02, "poses are of now"
    world.ada.apply({"touch": []})
    world.run(0.5)
    assert world.bob.replicator.owner(TREE) is None


def test_a_slow_reply_is_no_step_of_the_clock():
    """A ping whose round trip took 10 s, as of a process that was stopped, says nothing better than the others."""
    estimate = ClockEstimate()
    for sent in range(8):
        estimate = estimate.with_ping(Ping(sent, 100.02 + sent, sent + 0.04))
    stopped = estimate.with_ping(Ping(9.0, 109.02, 19.0))
    assert stopped.offset == estimate.offset
    assert len(stopped.pings) == 8


TIME_OF_DAY = re.compile(r"\btime\.time\(|\btime\.time_ns\(|\bdatetime\.now\(")
ALLOWED = {
    "net/server/server.py": "once, at the start: origin of the network clock",
    "net/transport/certificates.py": "validity of certificates",
    "client/recording/recorder.py": "first estimate of the network clock",
    "client/recording/replay.py": "first estimate of the network clock",
    "cli/record.py": "when a recording was made",
    "cli/ros.py": "times of reception, which rclpy takes from the same clock",
    "core/disk_cache.py": "age of files",
    "kernels/compilation.py": "age of files",
    "ros/dead_segments.py": "age of files",
    "ros/tools/topic_monitor.py": "age of stamps, which are the time of day in ROS",
    "ros/tools/bag_recorder.py": "times of messages in a recording, as rosbag2 has them",
    "client/programs.py": "beside what the topic monitor says",
    "cli/demo/push_demo.py": "beside what the topic monitor says",
    "cli/demo/readiness.py": "beside what the topic monitor says",
}


def test_the_time_of_day_measures_no_duration_and_orders_nothing():
    """So it may be set by any amount at any time; everything else goes by monotonic clocks."""
    root = pathlib.Path(vinesim.__file__).parent
    found = {
        str(file.relative_to(root))
        for file in root.rglob("*.py")
        if TIME_OF_DAY.search(file.read_text()) and "bench" not in file.parts
    }
    assert found <= ALLOWED.keys(), "measure with time.monotonic, or add the reason here"
