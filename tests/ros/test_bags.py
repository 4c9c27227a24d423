"""Recordings of ROS topics: what rosbag2 and Foxglove need is in the file, and it plays as it was recorded."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import os
import threading

import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from mcap.reader import make_reader
from mcap.writer import Writer
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from tests.support.stock_node import StockNode, wait_until
from vinesim.core.bag_files import BagError
from vinesim.ros.messages.definitions import UnknownTypeError, message_definition
from vinesim.ros.tools import bag_player
from vinesim.ros.tools.bag_recorder import BagRecorder

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture(autouse=True)
def own_domain(monkeypatch, tmp_path):
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))


def test_a_recording_holds_messages_definitions_and_qos_and_plays(tmp_path):
    """Messages to the byte, a latched one that came before the recorder; played, a late node receives it, too."""
    path = tmp_path / "run.mcap"
    with StockNode() as peer:
        joints = peer.node.create_publisher(JointState, "/joint_states", 100)  # all wait for a recorder that is late
        text = peer.node.create_publisher(String, "/robot_description", LATCHED)
        text.publish(String(data="<robot/>"))
        with BagRecorder(path) as recorder:
            wait_until(joints.get_subscription_count, lambda: recorder.spin(0.01), "the recorder's subscription")
            for i in range(20):
                message = JointState(name=["a"], position=[0.1 * i])
                message.header.stamp.sec = i
                joints.publish(message)
            wait_until(
                lambda: recorder.counts["/joint_states"] == 20 and recorder.counts["/robot_description"] == 1,
                lambda: recorder.spin(0.01),
                "all messages",
            )
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        rows = list(reader.iter_messages(topics=["/joint_states"]))
    schema, channel, _ = rows[0]
    assert (schema.name, schema.encoding, channel.message_encoding) == ("sensor_msgs/msg/JointState", "ros2msg", "cdr")
    assert "MSG: std_msgs/Header" in schema.data.decode()
    assert "MSG: builtin_interfaces/Time" in schema.data.decode()
    assert "reliability: reliable" in channel.metadata["offered_qos_profiles"]
    stamps = [deserialize_message(row[2].data, JointState).header.stamp.sec for row in rows]
    assert stamps == list(range(20))

    with StockNode() as peer:
        heard: list[int] = []
        texts: list[str] = []
        peer.node.create_subscription(JointState, "/joint_states", lambda m: heard.append(m.header.stamp.sec), 100)
        peer.node.create_subscription(String, "/robot_description", lambda m: texts.append(m.data), LATCHED)
        stop = threading.Event()
        player = threading.Thread(target=bag_player.play, args=(path,), kwargs={"is_stopped": stop.is_set})
        player.start()
        try:
            wait_until(lambda: len(heard) == 20 and texts, peer.spin, "the played messages")
        finally:
            stop.set()
            player.join()
        assert heard == list(range(20))
        assert texts == ["<robot/>"]


def test_definitions_hold_what_they_refer_to_and_unknown_types_are_named():
    text = message_definition("nav_msgs/msg/Odometry")
    for name in ("geometry_msgs/PoseWithCovariance", "geometry_msgs/Quaternion", "std_msgs/Header"):
        assert text.count(f"MSG: {name}\n") == 1
    with pytest.raises(UnknownTypeError, match="no_such_msgs/msg/Thing"):
        message_definition("no_such_msgs/msg/Thing")


def test_a_rosbag2_folder_plays_and_what_is_whole_of_a_cut_file(tmp_path, caplog):
    """Two files, the second one cut off: all messages of the first, and those before the cut."""
    folder = tmp_path / "mybag"
    folder.mkdir()
    texts = [f"note {number}" for number in range(20)]
    for part in range(2):
        with (folder / f"mybag_{part}.mcap").open("wb") as stream:
            writer = Writer(stream, use_chunking=False)
            writer.start(profile="ros2")
            schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
            channel = writer.register_channel("/note", "cdr", schema, {"offered_qos_profiles": ""})
            for number in range(10 * part, 10 * part + 10):
                time = 10_000_000 * number
                writer.add_message(channel, time, serialize_message(String(data=texts[number])), time)
            writer.finish()
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  relative_file_paths:\n    - mybag_0.mcap\n    - mybag_1.mcap\n"
    )
    last = folder / "mybag_1.mcap"
    whole = last.read_bytes()
    last.write_bytes(whole[: whole.index(b"note 17")])
    heard: list[str] = []
    with StockNode() as peer:
        peer.node.create_subscription(String, "/note", lambda message: heard.append(message.data), 100)
        player = threading.Thread(target=bag_player.play, args=(folder,))
        player.start()
        wait_until(lambda: not player.is_alive() and len(heard) == 17, peer.spin, "the played messages")
    assert heard == texts[:17]
    assert f"{last}: is cut off after message 7; the messages before are played" in caplog.text


def test_what_is_no_recording_is_refused_in_words(tmp_path):
    wrong = tmp_path / "wrong.mcap"
    wrong.write_bytes(b"nothing")
    with pytest.raises(BagError, match="give a recording of ROS topics"):
        bag_player.play(wrong)
    with pytest.raises(BagError, match="No such file"):
        bag_player.play(tmp_path / "missing.mcap")
    with wrong.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("vinesim", "jsonschema", b"{}")
        writer.register_channel("hello/ada", "json", schema)
        writer.finish()
    with pytest.raises(BagError, match="by: vinesim replay"):
        bag_player.play(wrong)
