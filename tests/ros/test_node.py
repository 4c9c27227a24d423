"""The node as others see it: stock rclpy in a second process, or in a context of its own."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from vinesim.core import frames
from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image, JointState, PointCloud2, PointField
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

from tests.support.stock_node import TIMEOUT, StockNode, wait_until
from vinesim.ros.commands.convert import CommandError
from vinesim.ros.commands.subscriptions import MAX_LOGGED, MAX_QUEUED, CommandQueue
from vinesim.ros.commands.types import BaseVelocity, CancelGoal, ForwardCommand
from vinesim.ros.commands.types import JointTrajectory as Trajectory
from vinesim.ros.robot_node import RobotNode
from vinesim.ros.sensor_node import SensorNode
from vinesim.ros.tools.subscribing import message_class
from vinesim.ros.tools.topic_monitor import SimulationClock, TopicStats
from vinesim.scene.values import (
    CameraFrame,
    CameraInfo,
    ComponentStatus,
    Contact,
    ControllerKind,
    ControllerSpec,
    JointSample,
    LevelLaser,
    LidarScan,
    RobotSample,
)

REST = frames.pose(np.zeros(3))
JOINTS = tuple(f"arm_left_{i}_joint" for i in range(1, 8))
FRAMES = tuple(("torso_link" if i == 1 else f"arm_left_{i - 1}_link", f"arm_left_{i}_link") for i in range(1, 8))
URDF = "<robot name='vinebot'/>"


@pytest.fixture(autouse=True)
def own_domain(monkeypatch, tmp_path_factory):
    """No other ROS on this machine or network hears these tests."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("log")))


def robot_sample(t: float, actor: str = "vinebot", contacts: tuple[Contact, ...] = ()) -> RobotSample:
    zeros = np.zeros(len(JOINTS))
    joints = JointSample(t, JOINTS, zeros + t, zeros, zeros, zeros)
    base = frames.pose(np.array([1.0, 2.0, 0.0]), frames.from_yaw(np.pi / 2))
    return RobotSample(
        actor,
        joints,
        base,
        np.zeros(6),
        REST,
        np.zeros(6),
        np.zeros((2, 3, 3)),
        FRAMES,
        np.tile(REST, (len(FRAMES), 1)),
        contacts,
    )


def camera_frame(t: float, width: int = 640, height: int = 480, name: str = "head_front_camera") -> CameraFrame:
    info = CameraInfo(width, height, width, width, width / 2, height / 2, f"{name}_optical")
    rgb = np.full((height, width, 3), 7, np.uint8)
    depth = np.full((height, width), 1.5, np.float32)
    return CameraFrame(t, name, info, REST, rgb, depth, np.ones((height, width), np.int32), bunches=())


def lidar_scan(t: float, count: int) -> LidarScan:
    zeros = np.zeros(count, np.float32)
    return LidarScan(
        t,
        "lidar",
        "lidar",
        REST,
        np.ones((count, 3), np.float32),
        zeros,
        zeros.astype(np.uint16),
        zeros,
        zeros.astype(int),
        LevelLaser(0, 1, 0.0, 0.1, 0.0, 0.1, 100.0),
    )


@contextlib.contextmanager
def topic_monitor(*topics: str, queue: int = 10) -> Iterator[Callable[[], dict]]:
    """A peer in a second process; call what is yielded to have its report."""
    asked = [word for topic in topics for word in ("--topic", topic)]
    process = subprocess.Popen(
        [sys.executable, "-m", "vinesim.ros.tools.topic_monitor", "--queue", str(queue), *asked],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )

    def report() -> dict:
        out, _ = process.communicate(timeout=TIMEOUT)
        assert process.returncode == 0
        return json.loads(out)

    try:
        yield report
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


@pytest.mark.long
def test_large_messages_reach_another_process():
    """The gate: at 100 Hz ticks, 30 Hz RGB and depth and 10 Hz clouds of 100k points, 95 % arrive."""
    small = ("/clock", "/joint_states", "/tf")
    large = ("/head_front_camera/rgb/image_raw", "/head_front_camera/depth/image_raw", "/lidar/points")
    latched = ("/robot_description", "/tf_static")
    static = [("base_footprint", "base_link", REST)]
    with (
        RobotNode("vinebot", URDF, static_transforms=static) as robot,
        SensorNode("vinebot_sensors", sensors={"head_front_camera": "camera", "lidar": "lidar"}) as sensors,
        # a second of messages may wait: on a busy machine the other process gets its turn late
        topic_monitor(*small, *large, *latched, queue=100) as report,
    ):
        own = [name if name == "/clock" else name[1:] for name in (*small, *latched)]
        wait_until(lambda: all(robot.has_subscribers(name) for name in own))
        wait_until(lambda: all(sensors.has_subscribers(name[1:]) for name in large))
        ticks = 400
        offered = dict.fromkeys((*small, *large), 0)
        due = time.monotonic()
        for tick in range(ticks):
            # A late tick delays the next ones: a busy machine makes no bursts.
            due = max(due + 0.01, time.monotonic())
            time.sleep(max(due - time.monotonic(), 0.0))
            t = tick / 100
            robot.publish_clock(t)
            robot.publish_sound(t, bytes(640))
            robot.publish_robot_state(robot_sample(t))
            for name in small:
                offered[name] += 1
            if tick * 3 % 10 < 3:
                sensors.publish(camera_frame(t))
                offered[large[0]] += 1
                offered[large[1]] += 1
            if tick % 10 == 0:
                sensors.publish(lidar_scan(t, 100_000))
                offered[large[2]] += 1
        wait_until(lambda: not sensors.has_pending)
        received = report()
    assert offered[large[0]] == 120
    for name, count in offered.items():
        assert received[name]["count"] >= 0.95 * count, (name, received[name])
        assert received[name]["stamps_rise"], name
    assert received["/lidar/points"]["bytes"] >= 0.95 * 40 * 100_000 * 24
    for name in latched:  # published before the peer was born
        assert received[name]["count"] == 1, name


def test_every_topic_is_heard_with_its_official_type():
    contact = Contact("vinebot", "vinebot/arm_left_7_link", 5, np.ones(3), np.ones(3), 0.0)
    names = ("bunch_00001", "bunch_00002")
    poses = np.tile(REST, (2, 1))
    with (
        RobotNode("vinebot", URDF) as robot,
        SensorNode("vinebot_sensors", sensors={"head_front_camera": "camera", "lidar": "lidar"}) as sensors,
        topic_monitor() as report,
    ):
        robot.publish_environment_static(("pole_0",), poses[:1])
        robot.publish_intentions(())
        robot.publish_gestures(0.0, ())
        robot.publish_lights(None)
        ticks = iter(range(10**6))

        def tick() -> None:
            t = next(ticks) / 100
            robot.publish_clock(t)
            robot.publish_robot_state(robot_sample(t, contacts=(contact,)))
            robot.publish_sound(t, bytes(640))
            sensors.publish(camera_frame(t, 32, 24))
            sensors.publish(lidar_scan(t, 10))
            robot.publish_environment(t, names, poses)
            robot.publish_events(t, [{"event": "blade", "outcome": "missed"}])
            robot.publish_diagnostics(t, [ComponentStatus("simulation")])

        def sent() -> dict[str, int]:
            return robot.sent | sensors.sent

        # only the monitor subscribes, so what is sent is for it
        wait_until(lambda: all(count >= 20 or name in LATCHED for name, count in sent().items()), tick)
        with StockNode() as peer:
            asked = {(topic, qos) for topic in TYPES if topic[1:] not in LATCHED for qos in ("default", "sensor")}
            received_by: set[tuple[str, str]] = set()
            for topic, qos in asked:
                peer.node.create_subscription(
                    message_class(TYPES[topic]),
                    topic,
                    lambda _, key=(topic, qos): received_by.add(key),
                    10 if qos == "default" else rclpy.qos.qos_profile_sensor_data,
                    raw=True,
                )

            def tick_and_hear() -> None:
                tick()
                for _ in range(20):
                    peer.spin(0.0)

            wait_until(lambda: received_by == asked, tick_and_hear)
        received = report()
    assert {name: heard["type"] for name, heard in received.items()} == TYPES
    assert all(heard["count"] for heard in received.values()), received
    assert received["/tf"]["type_hash"] == "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"


def test_ten_seconds_of_every_step_wait_for_a_subscriber_and_five_pictures_or_clouds():
    """As docs/ros.md says: keep last, 1,000 messages of every step."""
    steps = (
        "joint_states",
        "tf",
        "mobile_base_controller/odom",
        "vine/contacts",
        "vine/events",
        "base_imu",
        "wrist/wrench",
        "see/k/state",
    )
    elastic = ControllerSpec("see", ControllerKind.SERIES_ELASTIC, ("k",))
    with (
        RobotNode("vinebot", URDF, imus=["base_imu"], wrenches=["wrist"], controllers=[elastic]) as robot,
        SensorNode("vinebot_sensors", sensors={"camera": "camera", "lidar": "lidar"}) as sensors,
    ):
        depths = {name: topic.publisher.qos_profile.depth for name, topic in robot._topics.items()}
        assert {name: depths[name] for name in steps} == dict.fromkeys(steps, 1000)
        pictures = [topic for name, topic in sensors._topics.items() if name != "camera/label_info"]
        assert {topic.publisher.qos_profile.depth for topic in pictures} == {5}


LATCHED = (
    "robot_description",
    "head_front_camera/label_info",
    "tf_static",
    "tf_environment_static",
    "human_intention",
    "human_gesture",
    "audio_info",
    "indicator_lights/markers",
)
TYPES = {
    "/clock": "rosgraph_msgs/msg/Clock",
    "/robot_description": "std_msgs/msg/String",
    "/joint_states": "sensor_msgs/msg/JointState",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/human_intention": "std_msgs/msg/String",
    "/human_gesture": "std_msgs/msg/String",
    "/indicator_lights/markers": "visualization_msgs/msg/MarkerArray",
    "/audio": "audio_common_msgs/msg/AudioData",
    "/audio_stamped": "audio_common_msgs/msg/AudioDataStamped",
    "/audio_info": "audio_common_msgs/msg/AudioInfo",
    "/tf_environment": "tf2_msgs/msg/TFMessage",
    "/tf_environment_static": "tf2_msgs/msg/TFMessage",
    "/mobile_base_controller/odom": "nav_msgs/msg/Odometry",
    "/vine/contacts": "sensor_msgs/msg/PointCloud2",
    "/vine/events": "std_msgs/msg/String",
    "/vine/markers": "visualization_msgs/msg/MarkerArray",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/lidar/points": "sensor_msgs/msg/PointCloud2",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/head_front_camera/depth/image_raw/compressedDepth": "sensor_msgs/msg/CompressedImage",
    "/head_front_camera/rgb/image_raw": "sensor_msgs/msg/Image",
    "/head_front_camera/rgb/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    "/head_front_camera/rgb/camera_info": "sensor_msgs/msg/CameraInfo",
    "/head_front_camera/depth/image_raw": "sensor_msgs/msg/Image",
    "/head_front_camera/depth/camera_info": "sensor_msgs/msg/CameraInfo",
    "/head_front_camera/depth/points": "sensor_msgs/msg/PointCloud2",
    "/head_front_camera/labels": "sensor_msgs/msg/Image",
    "/head_front_camera/label_info": "vision_msgs/msg/LabelInfo",
    "/head_front_camera/detections": "vision_msgs/msg/Detection2DArray",
    "/head_front_camera/detections_3d": "vision_msgs/msg/Detection3DArray",
    "/head_front_camera/bunches": "sensor_msgs/msg/PointCloud2",
}


def test_no_message_is_built_without_a_subscriber(monkeypatch):
    with (
        RobotNode("vinebot", URDF) as robot,
        SensorNode("vinebot_sensors", sensors={"head_front_camera": "camera", "lidar": "lidar"}) as sensors,
        StockNode() as peer,
    ):
        heard: list[JointState] = []
        peer.node.create_subscription(JointState, "/joint_states", heard.append, 10)
        wait_until(lambda: robot.has_subscribers("joint_states"))
        assert not sensors.has_subscribers("head_front_camera")
        assert not sensors.has_subscribers("lidar")

        def tick() -> None:
            robot.publish_robot_state(robot_sample(1.0))
            sensors.publish(camera_frame(1.0, 32, 24))
            sensors.publish(lidar_scan(1.0, 10))
            peer.spin()

        wait_until(lambda: len(heard) >= 20, tick)
        sent = {name for name, count in (robot.sent | sensors.sent).items() if count and name not in LATCHED}
        assert sent == {"joint_states"}
        assert not any((robot.dropped | sensors.dropped).values())


def test_the_area_of_interest_is_a_circle_around_the_base_and_there_is_none_without_a_server():
    heard: dict[str, list[MarkerArray]] = {"shared": [], "alone": []}
    with (
        RobotNode("one", URDF, namespace="shared", interest_radius=3.5) as shared,
        RobotNode("two", URDF, namespace="alone", clock=False) as alone,
        StockNode() as peer,
    ):
        for name, messages in heard.items():
            peer.node.create_subscription(MarkerArray, f"/{name}/vine/markers", messages.append, 10)

        def tick() -> None:
            for node in (shared, alone):
                node.publish_robot_state(robot_sample(1.0))
            peer.spin(0.01)

        wait_until(lambda: all(heard.values()), tick, "markers")
    assert [one.action for one in heard["alone"][-1].markers] == [Marker.DELETEALL]
    clear, circle = heard["shared"][-1].markers
    assert (clear.action, circle.action, circle.type) == (Marker.DELETEALL, Marker.ADD, Marker.LINE_STRIP)
    assert (circle.ns, circle.header.frame_id) == ("interest", "map")
    assert (circle.pose.position.x, circle.pose.position.y, circle.pose.position.z) == (1.0, 2.0, 0.0)
    points = np.array([[point.x, point.y, point.z] for point in circle.points])
    np.testing.assert_allclose(np.hypot(points[:, 0], points[:, 1]), 3.5, rtol=1e-12)
    np.testing.assert_allclose(points[0], points[-1], atol=1e-12)
    assert not points[:, 2].any()


def test_subscribers_are_counted_by_family_and_knows_its_topics():
    with SensorNode("vinebot_sensors", sensors={"left": "camera", "left_arm": "camera"}) as node, StockNode() as peer:
        subscription = peer.node.create_subscription(
            Image, "/left_arm/depth/image_raw", lambda _: None, rclpy.qos.qos_profile_sensor_data
        )
        wait_until(lambda: node.has_subscribers("left_arm/depth/image_raw"))
        assert node.has_subscribers("left_arm")
        assert node.has_subscribers("left_arm/depth")
        assert not node.has_subscribers("left_arm/rgb")
        assert not node.has_subscribers("left")  # a name that the other begins with
        peer.node.destroy_subscription(subscription)
        wait_until(lambda: not node.has_subscribers("left_arm"))
        with pytest.raises(ValueError, match=r"no topic 'right'; there are: left/bunches, left/depth/camera_info"):
            node.has_subscribers("right")


CONTROLLERS = (
    ControllerSpec("arm_left_controller", ControllerKind.JOINT_TRAJECTORY, JOINTS),
    ControllerSpec("forward_position_controller", ControllerKind.FORWARD_POSITION, JOINTS[:2]),
)


def test_commands_come_back():
    with RobotNode("vinebot", URDF, controllers=CONTROLLERS) as node, StockNode() as peer:
        velocity = peer.node.create_publisher(TwistStamped, "/mobile_base_controller/cmd_vel", 10)
        forward = peer.node.create_publisher(Float64MultiArray, "/forward_position_controller/commands", 10)
        arm = peer.node.create_publisher(JointTrajectory, "/arm_left_controller/joint_trajectory", 10)
        wait_until(lambda: all(p.get_subscription_count() for p in (velocity, forward, arm)))

        twist = TwistStamped()
        twist.twist.linear.x = 0.25
        velocity.publish(twist)
        forward.publish(Float64MultiArray(data=[0.1, 0.2]))
        for seconds in (1, 2):
            point = JointTrajectoryPoint(positions=[1.0])
            point.time_from_start.sec = seconds
            arm.publish(JointTrajectory(joint_names=["arm_left_1_joint"], points=[point]))
        commands = []
        wait_until(lambda: commands.extend(node.commands()) or len(commands) >= 4)
        assert [c.linear.tolist() for c in commands if isinstance(c, BaseVelocity)] == [[0.25, 0.0, 0.0]]
        assert [c.values.tolist() for c in commands if isinstance(c, ForwardCommand)] == [[0.1, 0.2]]
        trajectories = [c for c in commands if isinstance(c, Trajectory)]
        assert [(c.controller, c.joints, c.times.tolist()) for c in trajectories] == [
            ("arm_left_controller", ("arm_left_1_joint",), [1.0]),
            ("arm_left_controller", ("arm_left_1_joint",), [2.0]),
        ]
        assert node.commands() == []


def test_a_set_point_replaces_the_older_and_nonsense_is_refused():
    with RobotNode("vinebot", URDF) as node, StockNode() as peer:
        velocity = peer.node.create_publisher(TwistStamped, "/mobile_base_controller/cmd_vel", 100)
        wait_until(velocity.get_subscription_count)
        twist = TwistStamped()
        for speed in (*np.linspace(0.0, 1.0, 21), float("nan")):
            twist.twist.linear.x = float(speed)
            velocity.publish(twist)
        wait_until(lambda: node._commands.rejected)  # the last one: all others have come before it
        commands = node.commands()
        assert [c.linear[0] for c in commands if isinstance(c, BaseVelocity)] == [1.0]


def test_a_command_of_another_type_is_told_of_once_with_the_remedy(caplog):
    """As teleop_twist_keyboard and Nav2 publish it by default; DDS delivers nothing of it and says nothing."""
    diagnostics: list[DiagnosticArray] = []
    with RobotNode("vinebot", URDF, namespace="north", controllers=CONTROLLERS) as node, StockNode() as peer:
        peer.node.create_subscription(DiagnosticArray, "/diagnostics", diagnostics.append, 10)

        def level(part: str = "/north/vinebot: ros") -> bytes | None:
            node.publish_diagnostics(0.0, [])
            peer.spin()
            return next((one.level for array in diagnostics[-1:] for one in array.status if one.name == part), None)

        wait_until(lambda: level() == DiagnosticStatus.OK)
        wrong = peer.node.create_publisher(Twist, "/north/mobile_base_controller/cmd_vel", 10)
        wait_until(lambda: level() == DiagnosticStatus.WARN)
        assert diagnostics[-1].status[0].message == (
            "/north/mobile_base_controller/cmd_vel is published as geometry_msgs/msg/Twist"
        )
        peer.node.destroy_publisher(wrong)
        wait_until(lambda: level() == DiagnosticStatus.OK)
        other = peer.node.create_publisher(String, "/north/forward_position_controller/commands", 10)
        wait_until(lambda: level() == DiagnosticStatus.WARN)
        peer.node.destroy_publisher(other)
    assert [record.getMessage() for record in caplog.records] == [
        "/north/mobile_base_controller/cmd_vel is published as geometry_msgs/msg/Twist, which this robot cannot "
        "receive; publish geometry_msgs/msg/TwistStamped "
        "(teleop_twist_keyboard: -p stamped:=true; Nav2: enable_stamped_cmd_vel: true)",
        "/north/forward_position_controller/commands is published as std_msgs/msg/String, which this robot cannot "
        "receive; publish std_msgs/msg/Float64MultiArray",
    ]


def test_commands_that_nobody_takes_are_counted():
    queue = CommandQueue()
    for number in range(MAX_QUEUED + 3):
        queue.put(CancelGoal(number.to_bytes(16, "big")))
    assert queue.rejected == 3
    assert queue.drain()[0] == CancelGoal((3).to_bytes(16, "big"))
    assert queue.drain() == []


def test_a_stream_of_bad_commands_does_not_fill_the_log(caplog):
    queue = CommandQueue()
    for number in range(3 * MAX_LOGGED):
        queue.refuse(CommandError("always the same"))
        queue.refuse(CommandError(f"with the value {number}"))
    assert queue.rejected == 6 * MAX_LOGGED
    assert len(caplog.records) == MAX_LOGGED
    assert len({record.getMessage() for record in caplog.records}) == MAX_LOGGED


@pytest.mark.long
def test_two_robots_in_one_process_under_namespaces():
    with (
        RobotNode("one", "<robot name='one'/>", namespace="robot_1") as one,
        RobotNode("two", "<robot name='two'/>", namespace="robot_2", clock=False) as two,
        StockNode() as peer,
    ):
        states: dict[str, list[float]] = {"robot_1": [], "robot_2": []}
        urdfs: dict[str, str] = {}
        late = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for name in states:
            peer.node.create_subscription(
                JointState, f"/{name}/joint_states", lambda m, name=name: states[name].append(m.position[0]), 10
            )
            peer.node.create_subscription(
                String, f"/{name}/robot_description", lambda m, name=name: urdfs.update({name: m.data}), late
            )

        def tick() -> None:
            one.publish_robot_state(robot_sample(1.0))
            two.publish_robot_state(robot_sample(2.0))
            peer.spin()

        wait_until(lambda: all(states.values()) and len(urdfs) == 2, tick)
        assert set(states["robot_1"]) == {1.0}
        assert set(states["robot_2"]) == {2.0}
        assert urdfs == {"robot_1": "<robot name='one'/>", "robot_2": "<robot name='two'/>"}
        wait_until(lambda: peer.node.get_publishers_info_by_topic("/clock"), tick, "the clock")
        topics = {name for name, _ in peer.node.get_topic_names_and_types()}
        assert {"/robot_1/tf", "/robot_2/tf", "/clock"} <= topics
        assert "/tf" not in topics
        assert len(peer.node.get_publishers_info_by_topic("/clock")) == 1


def test_frames_lead_from_the_map_to_the_fingers():
    from vinesim.ros.messages import message_packages

    message_packages.ensure_importable(["tf2_msgs"])
    from tf2_msgs.msg import TFMessage

    with RobotNode("vinebot", URDF) as node, StockNode() as peer:
        heard: list[TFMessage] = []
        peer.node.create_subscription(TFMessage, "/tf", heard.append, 100)
        wait_until(lambda: heard, lambda: (node.publish_robot_state(robot_sample(3.21)), peer.spin()))
        tree = {t.child_frame_id: t for t in heard[0].transforms}
        assert [tree[child].header.frame_id for child in ("odom", "base_footprint", "arm_left_1_link")] == [
            "map",
            "odom",
            "torso_link",
        ]
        assert {(t.header.stamp.sec, t.header.stamp.nanosec) for t in tree.values()} == {(3, 210_000_000)}
        drift = tree["odom"].transform
        odom = tree["base_footprint"].transform
        chain = [
            np.array(
                [
                    v.translation.x,
                    v.translation.y,
                    v.translation.z,
                    v.rotation.x,
                    v.rotation.y,
                    v.rotation.z,
                    v.rotation.w,
                ]
            )
            for v in (drift, odom)
        ]
        assert frames.compose(*chain) == pytest.approx(robot_sample(0.0).base_q)


def test_contacts_are_one_cloud_a_step():
    """Each contact as a point with its force on the robot, the plant's body, its bunch, and the number of the link."""
    contact = Contact("vinebot", "vinebot/tip", 5, np.array([1.0, 3.0, 0.0]), np.array([0.0, 0.0, 5.0]), 0.0)
    nowhere = Contact("vinebot", "vinebot/unknown", 2, np.array([1.0, 0.0, 0.0]), np.array([0.0, 4.0, 0.0]), 0.0)
    urdf = "<robot name='vinebot'><link name='base_footprint'/><link name='tip'/></robot>"
    bunch_of_body = np.array([-1, -1, -1, 0, 0, 1], np.int32)
    with RobotNode("vinebot", urdf, bunch_of_body=bunch_of_body) as node, StockNode() as peer:
        heard: list[PointCloud2] = []
        peer.node.create_subscription(PointCloud2, "/vine/contacts", heard.append, 10)
        sample = robot_sample(1.0, contacts=(contact, nowhere))
        wait_until(lambda: heard, lambda: (node.publish_robot_state(sample), peer.spin()))
        assert heard[0].header.frame_id == "map"
        kinds = {PointField.FLOAT32: "f4", PointField.INT32: "i4"}
        point = np.dtype([(field.name, kinds[field.datatype]) for field in heard[0].fields])
        assert [point.fields[field.name][1] for field in heard[0].fields] == [field.offset for field in heard[0].fields]
        first, second = np.frombuffer(bytes(heard[0].data), point)
        assert first.tolist() == (1.0, 3.0, 0.0, 0.0, 0.0, 5.0, 5, 1, 1)
        assert second.tolist() == (1.0, 0.0, 0.0, 0.0, 4.0, 0.0, 2, -1, -1)
        heard.clear()
        without = robot_sample(1.01)
        wait_until(lambda: heard and heard[-1].width == 0, lambda: (node.publish_robot_state(without), peer.spin()))


def test_the_newest_replaces_what_waits_and_is_counted():
    with SensorNode("vinebot", sensors={"left": "camera"}) as node:
        topic = node._topics["left/rgb/image_raw"]
        busy = threading.Event()
        go = threading.Event()

        def slow() -> Image:
            busy.set()
            go.wait(TIMEOUT)
            return Image()

        node._enqueue([(topic, slow)], always=True)
        assert busy.wait(TIMEOUT)
        built = []
        kept = 1
        count = 5
        for i in range(count):  # the simulation does not wait while the first is being built
            node._enqueue([(topic, lambda i=i: built.append(i) or Image())], always=True)
        go.set()
        wait_until(lambda: not node.has_pending and len(built) == kept)
        assert built == list(range(4, count))
        assert topic.dropped == 4


def test_a_message_that_cannot_be_built_is_counted_and_the_rest_goes_on(caplog):
    with SensorNode("vinebot", sensors={"left": "camera"}) as node:
        topic = node._topics["left/rgb/image_raw"]
        for _ in range(3):
            before = topic.dropped
            node._enqueue([(topic, lambda: 1 / 0)], always=True)
            wait_until(lambda before=before: topic.dropped == before + 1)
        node._enqueue([(topic, Image)], always=True)
        wait_until(lambda: topic.sent == 1)
    assert [r.message for r in caplog.records if "could not publish" in r.message] == [
        "could not publish left/rgb/image_raw; further failures are only counted"
    ]


def test_closing_leaves_nothing_behind():
    handler = signal.getsignal(signal.SIGINT)
    threads = set(threading.enumerate())
    for _ in range(3):
        for node in (
            RobotNode("vinebot", URDF),
            SensorNode("vinebot_sensors", sensors={"head_front_camera": "camera"}),
        ):
            assert signal.getsignal(signal.SIGINT) is handler
            node.close()
            node.close()
    assert set(threading.enumerate()) == threads
    assert signal.getsignal(signal.SIGINT) is handler


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"name": "vine bot"}, "vine bot"),
        ({"name": "vinebot", "namespace": "robot-1"}, "robot-1"),
        ({"name": "vinebot", "controllers": [ControllerSpec("left arm", ControllerKind.GRIPPER, ())]}, "left arm"),
    ],
)
def test_names_that_ros_refuses_are_said_in_one_line(arguments, words):
    threads = set(threading.enumerate())
    with pytest.raises(ValueError, match=words) as caught:
        RobotNode(urdf=URDF, **arguments)
    assert "\n" not in str(caught.value)
    assert set(threading.enumerate()) == threads


def test_unknown_camera_is_named():
    with (
        SensorNode("vinebot", sensors={"left": "camera"}) as node,
        pytest.raises(ValueError, match=r"no sensor 'right'.*: left"),
    ):
        node.publish(camera_frame(0.0, 32, 24, name="right"))


def test_the_monitor_counts_gaps_and_stamps_that_go_back():
    from rclpy.serialization import serialize_message
    from rosgraph_msgs.msg import Clock

    from vinesim.ros.messages import convert

    ear = TopicStats("rosgraph_msgs/msg/Clock", "RIHS01_", Clock, publishers=1)
    for sequence, t in ((4, 1.0), (5, 1.01), (8, 1.04)):
        info = {"source_timestamp": time.time_ns() - 5_000_000, "publication_sequence_number": sequence}
        ear.add(serialize_message(convert.clock(t)), info)
    report = ear.report()
    assert (report["count"], report["lost"], report["stamps_rise"], report["bytes"]) == (3, 2, True, 36)
    assert report["latency_ms"] >= 5.0
    ear.add(serialize_message(convert.clock(0.5)), info)
    assert not ear.report()["stamps_rise"]


def test_the_monitor_counts_by_second_and_from_a_restart_on(monkeypatch):
    from rclpy.serialization import serialize_message
    from rosgraph_msgs.msg import Clock

    from vinesim.ros.messages import convert

    stats = TopicStats("rosgraph_msgs/msg/Clock", "RIHS01_", Clock, publishers=1)
    now = 1000.0
    monkeypatch.setattr("vinesim.ros.tools.topic_monitor.time.time_ns", lambda: round(now * 1e9))

    def receive(at: float, sequence: int) -> None:
        nonlocal now
        now = at
        info = {"source_timestamp": round(at * 1e9), "publication_sequence_number": sequence}
        stats.add(serialize_message(convert.clock(at - 990.0)), info)

    receive(1000.0, 1)
    stats.restart(1001.0)
    for i, at in enumerate((1001.1, 1001.2, 1001.3, 1002.5, 1003.1, 1003.2)):
        receive(at, 2 + i + (i > 3))
    report = stats.report(1004.0)
    assert (report["count"], report["hz"], report["slowest_second"], report["lost"]) == (6, 2.0, 1, 1)
    assert report["first"] == pytest.approx(1000.0)
    assert stats.report(1005.5)["slowest_second"] == 0


@pytest.mark.parametrize("factor", [1.0, 0.4])
def test_the_age_of_a_message_is_simulated_time_since_its_stamp(monkeypatch, factor):
    """In a world that is slower than real time, too."""
    from rclpy.serialization import serialize_message
    from rosgraph_msgs.msg import Clock

    from vinesim.ros.messages import convert

    clock = SimulationClock()
    ticks, pictures = (TopicStats("rosgraph_msgs/msg/Clock", "", Clock, 1, clock) for _ in range(2))
    ticks.is_clock = True
    now = 1000.0
    monkeypatch.setattr("vinesim.ros.tools.topic_monitor.time.time_ns", lambda: round(now * 1e9))

    def receive(stats: TopicStats, stamp: float) -> None:
        info = {"source_timestamp": round(now * 1e9), "publication_sequence_number": None}
        stats.add(serialize_message(convert.clock(stamp)), info)

    receive(pictures, 4.0)
    assert pictures.report()["age_ms"] is None
    for i in range(50):
        now = 1000.0 + 0.01 / factor * i + (0.003 if i % 2 else 0.0)  # every other one is late
        receive(ticks, 5.0 + 0.01 * i)
    now = 1000.0 + 0.5 / factor
    receive(pictures, 5.45)
    assert pictures.report()["age_ms"]["p50"] == pytest.approx(50.0, abs=0.3)
