"""One /clock in a ROS domain, in the time of the world: who publishes it, and whose time it is."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import os

import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from rosgraph_msgs.msg import Clock

from tests.support.stock_node import StockNode, wait_until
from vinesim.ros.robot_node import RobotNode

URDF = "<robot name='small'/>"


def test_one_node_of_a_domain_publishes_the_clock_and_another_follows(monkeypatch, tmp_path):
    """Whatever the namespaces: a stock node hears one clock, and after its publisher has gone it hears the other's."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    with StockNode() as peer:
        nodes = [RobotNode(f"robot_{i}", URDF, namespace=f"space_{i}") for i in range(3)]
        heard: list[float] = []
        peer.node.create_subscription(Clock, "/clock", lambda m: heard.append(m.clock.sec), 100)

        def publishers() -> list[str]:
            return [info.node_name for info in peer.node.get_publishers_info_by_topic("/clock")]

        def tick() -> None:
            for i, node in enumerate(nodes):
                node.publish_clock(float(i))
            peer.spin(0.01)

        wait_until(lambda: len(publishers()) == 1 and len(heard) > 20, tick, "one clock")
        first = publishers()[0]
        heard.clear()
        wait_until(lambda: len(heard) > 20, tick, "its messages")
        assert set(heard) == {float(first[-1])}
        nodes.pop([node._node.get_name() for node in nodes].index(first)).close()
        nodes_left = [node._node.get_name() for node in nodes]
        heard.clear()

        def tick_left() -> None:
            for node in nodes:
                node.publish_clock(10.0)
            peer.spin(0.01)

        wait_until(lambda: len(publishers()) == 1 and publishers()[0] in nodes_left, tick_left, "another clock")
        wait_until(lambda: 10.0 in heard, tick_left, "its time")
        for node in nodes:
            node.close()
