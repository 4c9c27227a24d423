"""The commands ``vinesim ros topics``, ``hz``, ``echo``, ``pub`` and ``call`` with stock nodes; with a robot:
``test_user_files.py``."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

import yaml
from geometry_msgs.msg import PoseArray, TwistStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import BatteryState, Imu, JointState, PointCloud2
from std_msgs.msg import Byte, Header, String, UInt8
from std_srvs.srv import SetBool

from tests.support.stock_node import StockNode, wait_until
from vinesim.cli import ros
from vinesim.core.errors import UsageError
from vinesim.ros.tools import graph_node
from vinesim.ros.tools.graph_node import GraphNode, NoAnswerError, TypeMissingError
from vinesim.ros.tools.plain_values import LONGEST_LIST, LONGEST_TEXT, field_of, from_plain, to_plain

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture(autouse=True)
def own_domain(monkeypatch, tmp_path):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    monkeypatch.setattr(ros, "stop_at_signals", lambda stop: stop)  # the handlers of pytest stay


@pytest.fixture
def peer() -> Iterator[StockNode]:
    """A stock node that spins in a thread."""
    with StockNode() as node:
        is_over = threading.Event()

        def spin() -> None:
            while not is_over.is_set():
                node.spin(0.02)

        thread = threading.Thread(target=spin)
        thread.start()
        yield node
        is_over.set()
        thread.join()


# ---------------------------------------------------------------- plain values


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (TwistStamped, {"twist": {"linear": {"x": 1}}}),
        (JointState, {"name": ["a", "b"], "position": [1, 2.5]}),
        (Imu, {"orientation_covariance": [1.0] * 9}),
        (PointCloud2, {"data": [1, 2, 255], "fields": [{"name": "x", "offset": 4, "datatype": 7, "count": 1}]}),
        (PoseArray, {"poses": [{"position": {"x": 1.0}}, {}]}),
        (Byte, {"data": 200}),
        (String, {"data": "\u00e4: {}"}),
    ],
)
def test_plain_values_become_a_message_and_come_back_through_yaml(kind: type, values: dict[str, Any]) -> None:
    message = deserialize_message(serialize_message(from_plain(kind, values)), kind)
    plain = yaml.safe_load(ros._yaml(to_plain(message, full=True)))

    def check(given: Any, found: Any) -> None:
        if isinstance(given, dict):
            for name, value in given.items():
                check(value, found[name])
        elif isinstance(given, list):
            assert len(given) == len(found)
            for one, other in zip(given, found, strict=True):
                check(one, other)
        else:
            assert given == found

    check(values, plain)
    assert from_plain(kind, plain) == message


@pytest.mark.parametrize(
    ("kind", "values", "said"),
    [
        (TwistStamped, {"twist": {"linear": {"x": "a"}}}, "twist.linear.x: 'a' is no double"),
        (TwistStamped, {"twst": {}}, "twst: geometry_msgs/msg/TwistStamped has no such field; do you mean twist?"),
        (String, {"data": 3}, "data: 3 is no string"),
        (String, [1], r"message: \[1\] is no std_msgs/msg/String"),
        (Imu, {"orientation_covariance": [1.0] * 8}, r"is no double\[9\]"),
        (PointCloud2, {"fields": [{"count": -1}]}, r"fields\[0\].count: -1 is no uint32"),
        (UInt8, {"data": 256}, "data: 256 is no uint8"),
        (Header, {"stamp": {"sec": 1.5}}, "stamp.sec: 1.5 is no int32"),
        (SetBool.Request, {"data": 1}, "data: 1 is no boolean"),
    ],
)
def test_a_wrong_value_is_refused_with_its_place(kind: type, values: Any, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        from_plain(kind, values)


def test_fields_are_named_by_paths_and_long_ones_are_shortened() -> None:
    message = JointState(name=["a"], position=[0.5, math.nan])
    assert field_of(message, "position[0]") == 0.5
    assert field_of(message, "header.stamp.sec") == 0
    for path, said in (
        ("position[2]", "position has 2 elements"),
        ("header.foo", "no field foo in header; fields: stamp, frame_id"),
        ("position.x", "no field x in position; it is not a message"),
        ("header[0]", "header is no list"),
    ):
        with pytest.raises(UsageError, match=said):
            field_of(message, path)
    cloud = to_plain(PointCloud2(data=bytes(1000)))
    assert cloud["data"][LONGEST_LIST:] == [f"... {1000 - LONGEST_LIST} more"]
    assert to_plain(String(data="x" * 2000))["data"] == "x" * LONGEST_TEXT + "... 1000 more characters"


# ---------------------------------------------------------------- the graph


def test_a_latched_and_a_best_effort_topic_are_received(peer: StockNode, capsys: pytest.CaptureFixture[str]) -> None:
    """The QoS is that of the publishers: the message that came before is there, and one of a best-effort publisher."""
    peer.node.create_publisher(String, "/robot_description", LATCHED).publish(String(data="<robot/>"))
    assert ros.echo("/robot_description", "", "data", True, False) == 0
    assert capsys.readouterr().out == "<robot/>\n---\n"
    sensor = peer.node.create_publisher(
        BatteryState, "/north/battery", QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    peer.node.create_timer(0.05, lambda: sensor.publish(BatteryState(voltage=24.0)))
    assert ros.echo("battery", "north", "voltage", True, False) == 0
    assert capsys.readouterr().out == "24.0\n---\n"
    assert ros.topics("north", True) == 0
    assert capsys.readouterr().out == "/north/battery  sensor_msgs/msg/BatteryState  1 -> 0\n"
    assert ros.hz("battery", "north", 0.5) == 0
    assert " Hz  gaps " in capsys.readouterr().out


def test_a_message_is_published_with_the_type_of_the_subscribers(peer: StockNode) -> None:
    """Also to a subscriber that asks for a latched topic; the last message arrives before the program ends."""
    for topic, qos in (("/plain", 10), ("/latched", LATCHED)):
        heard: list[BatteryState] = []
        peer.node.create_subscription(BatteryState, topic, heard.append, qos)
        assert ros.publish(topic, '{"percentage": 0.5}', "", None, 1.0, True) == 0
        wait_until(lambda heard=heard: heard, name=topic)
        assert heard[0].percentage == 0.5


def test_a_service_answers_or_is_late(peer: StockNode, capsys: pytest.CaptureFixture[str]) -> None:
    may_answer = threading.Event()

    def serve(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        may_answer.wait()
        response.success = request.data
        return response

    peer.node.create_service(SetBool, "/switch", serve)
    with pytest.raises(NoAnswerError, match=r"/switch has not answered for 0\.2 s"):
        ros.call("/switch", "{data: true}", "", 0.2)
    may_answer.set()
    assert ros.call("/switch", '{"data": true}', "", 60.0) == 0
    assert capsys.readouterr().out == "{success: true, message: ''}\n"


def test_errors_name_what_is_wrong(
    peer: StockNode, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(graph_node, "SILENCE", 0.2)
    monkeypatch.setattr(graph_node, "DISCOVERY_TIME", 0.5)
    publisher = peer.node.create_publisher(JointState, "/joint_states", 10)

    def attempt(call: Callable[[GraphNode], Any], namespace: str = "") -> None:
        with GraphNode(lambda: False, namespace) as node:
            wait_until(lambda: node._node.count_publishers("/joint_states"), node.spin, "discovery")
            call(node)

    assert ros.topics("empty", False) == 0
    assert "no topics in namespace empty of ROS_DOMAIN_ID" in capsys.readouterr().err
    domain = os.environ["ROS_DOMAIN_ID"]
    with pytest.raises(UsageError, match=f"topic /joint_state in ROS_DOMAIN_ID {domain}; do you mean /joint_states?"):
        attempt(lambda node: next(node.subscribe("/joint_state")))
    with pytest.raises(UsageError, match="nobody offers the service /switch in"):
        attempt(lambda node: node.call("/switch", SetBool.Request, 1.0))
    with pytest.raises(UsageError, match=r"nobody subscribes to the topic /charge in .*; start the subscriber first"):
        attempt(lambda node: next(node.publish("/charge", lambda kind: kind(), 1.0, None)))
    with pytest.raises(UsageError, match="'a b' is no name of a topic"):
        attempt(lambda node: next(node.subscribe("a b")))
    with pytest.raises(UsageError, match="--namespace '1 2' is no ROS namespace"):
        attempt(lambda _: None, "1 2")
    with pytest.raises(UsageError, match="is no JSON"):
        ros.call("/switch", "{", "", 1.0)
    monkeypatch.setattr(graph_node, "message_class", lambda _: None)
    with pytest.raises(TypeMissingError, match="install the package sensor_msgs for ROS 2") as missing:
        attempt(lambda node: next(node.subscribe("/joint_states")))
    assert missing.value.exit_code == 3
    peer.node.destroy_publisher(publisher)
