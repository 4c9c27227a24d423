"""Parameters of the nodes, set at run time by a stock node as ``ros2 param set`` does."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from vinesim.core import frames
from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import String

from tests.support import sensor_scenes
from tests.support.stock_node import StockNode, wait_until
from vinesim.core.errors import UsageError
from vinesim.ros.messages import message_packages
from vinesim.ros.names import ros_name, ros_namespace
from vinesim.ros.robot_node import RobotNode
from vinesim.ros.sensor_node import SensorNode
from vinesim.scene.values import CameraFrame, CameraInfo, CameraOutput, ComponentStatus, JointSample, RobotSample
from vinesim.sensors.lidar.lidar import Lidar, LidarSpec
from vinesim.sensors.scheduler import ScheduledSensor, SensorScheduler

REST = frames.pose(np.zeros(3))
NONE = np.zeros(0)


@pytest.fixture(autouse=True)
def own_domain(monkeypatch, tmp_path_factory):
    """No other ROS on this machine or network hears these tests."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("log")))


class Setter:
    """Sets parameters of one node from another one."""

    def __init__(self, peer: StockNode, node: str, tick: Callable[[], None]) -> None:
        self._client = peer.node.create_client(SetParameters, f"{node}/set_parameters")
        self._tick = tick
        wait_until(self._client.service_is_ready, tick, "the service")

    def __call__(self, name: str, value: Any) -> str:
        """The reason why the value was refused; empty if it was set."""
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        future = self._client.call_async(request)
        wait_until(future.done, self._tick, f"{name} = {value}")
        response = future.result()
        assert response is not None
        (result,) = response.results
        assert result.successful == (not result.reason)
        return result.reason


def test_a_robot_without_truth_and_bad_values():
    message_packages.ensure_importable(["tf2_msgs"])
    from tf2_msgs.msg import TFMessage

    base = frames.pose([1.0, 2.0, 0.0])
    drifted = frames.pose([1.5, 2.0, 0.0])
    joints = JointSample(1.0, (), NONE, NONE, NONE, NONE)
    sample = RobotSample(
        "r", joints, base, np.zeros(6), drifted, np.zeros(6), np.zeros((2, 3, 3)), (), np.zeros((0, 7))
    )
    heard: dict[str, list] = {"tf": [], "truth": [], "contacts": [], "poles": [], "diagnostics": []}
    heard["odometry"] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    with RobotNode("r", "<robot name='r'/>", namespace="space") as node, StockNode() as peer:
        node.publish_environment_static(("pole_0",), REST[None])
        for message, topic, name, qos in (
            (TFMessage, "space/tf", "tf", 10),
            (TFMessage, "space/tf_environment", "truth", 10),
            (PointCloud2, "space/vine/contacts", "contacts", 10),
            (TFMessage, "space/tf_environment_static", "poles", latched),
            (DiagnosticArray, "/diagnostics", "diagnostics", 10),
            (Odometry, "space/mobile_base_controller/odom", "odometry", 10),
        ):
            peer.node.create_subscription(message, topic, heard[name].append, qos)

        def tick() -> None:
            node.publish_robot_state(sample)
            node.publish_environment(1.0, ("bunch",), REST[None])
            node.publish_diagnostics(1.0, [ComponentStatus("simulation")])
            peer.spin(0.01)

        def parents() -> list[str]:
            return [t.header.frame_id for t in heard["tf"][-1].transforms]

        wait_until(lambda: all(heard.values()), tick, "all topics")
        assert parents() == ["map", "odom"]
        (status, *_) = heard["diagnostics"][-1].status
        assert (status.name, status.hardware_id) == ("/space/r: simulation", "/space/r")

        put = Setter(peer, "/space/r", tick)
        assert put("publish_map_to_odom", False) == ""
        assert put("publish_truth", False) == ""
        wait_until(lambda: parents() == ["odom"], tick, "tf without the map")
        wait_until(lambda: not heard["poles"][-1].transforms, tick, "no poles")
        assert not node.has_subscribers("tf_environment")
        assert not node.has_subscribers("vine")
        seen = {name: len(heard[name]) for name in heard}
        wait_until(lambda: len(heard["tf"]) > seen["tf"] + 30, tick, "more of tf")
        (only,) = heard["tf"][-1].transforms
        assert (only.child_frame_id, only.transform.translation.x) == ("base_footprint", 1.5)
        late: list = []
        peer.node.create_subscription(TFMessage, "space/tf_environment_static", late.append, latched)
        wait_until(lambda: late, tick, "the latched message")
        assert not late[0].transforms
        assert len(heard["contacts"]) - seen["contacts"] <= 10  # what was under way

        assert put("publish_truth", True) == ""
        wait_until(lambda: len(heard["truth"]) > seen["truth"] + 20 and heard["poles"][-1].transforms, tick, "truth")

        assert put("odom_frame_id", "anna/odom") == ""
        wait_until(lambda: parents() == ["anna/odom"], tick, "tf with another frame of odometry")
        wait_until(lambda: heard["odometry"][-1].header.frame_id == "anna/odom", tick, "odometry in that frame")

        assert put("environment_rate", 20.0) == ""
        for name, value in (
            ("environment_rate", 0.0),
            ("environment_rate", 1e9),
            ("environment_rate", float("nan")),
            ("environment_rate", "fast"),
            ("publish_truth", 3),
            ("odom_frame_id", ""),
            ("odom_frame_id", "/odom"),
            ("odom_frame_id", 3),
        ):
            reason = put(name, value)
            assert reason, (name, value)
            assert "\n" not in reason
        assert node.environment_rate == 20.0
        kept = node.set_parameters
    assert kept == {
        "publish_map_to_odom": False,
        "publish_truth": True,
        "environment_rate": 20.0,
        "odom_frame_id": "anna/odom",
    }
    kept |= {"publish_truth": False}
    for one in heard.values():
        one.clear()
    with RobotNode("r", "<robot name='r'/>", namespace="space", parameters=kept) as node, StockNode() as peer:
        node.publish_environment_static(("pole_0",), REST[None])
        peer.node.create_subscription(TFMessage, "space/tf", heard["tf"].append, 10)
        peer.node.create_subscription(TFMessage, "space/tf_environment_static", heard["poles"].append, latched)
        wait_until(lambda: heard["tf"] and heard["poles"], tick, "topics of a node that was started again")
        assert (parents(), len(heard["poles"][-1].transforms), node.environment_rate) == (["anna/odom"], 0, 20.0)


def test_odometry_without_the_slip_of_the_tracks():
    """It goes on from where it was by the true motion, odom stays in the map; then it is what is measured again."""
    message_packages.ensure_importable(["tf2_msgs"])
    from tf2_msgs.msg import TFMessage

    turn = frames.from_yaw(0.5 * np.pi)
    times = itertools.count(1)
    odometry: list[Odometry] = []
    transforms: list[TFMessage] = []

    def sample() -> RobotSample:
        """Of a robot that looks along y, in which it drives; the tracks measure a quarter more."""
        way = 0.01 * next(times)
        joints = JointSample(way, (), NONE, NONE, NONE, NONE)
        true = np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
        measured = np.array([1.25, 0.0, 0.0, 0.0, 0.0, 0.0])
        base = frames.pose([3.0, way, 0.0], turn)
        odom = frames.pose([1.25 * way, 0.0, 0.0])
        covariance = np.full((2, 3, 3), 0.04)
        return RobotSample("r", joints, base, true, odom, measured, covariance, (), np.zeros((0, 7)))

    def last() -> tuple[float, float, float]:
        """Of the newest odometry: how far it is along x, how fast, and the variance of x."""
        pose = odometry[-1].pose
        twist = odometry[-1].twist
        return pose.pose.position.x, twist.twist.linear.x, pose.covariance[0]

    def odom_in_map() -> tuple[float, float]:
        (found,) = [t.transform.translation for t in transforms[-1].transforms if t.child_frame_id == "odom"]
        return found.x, found.y

    def time() -> float:
        stamp = odometry[-1].header.stamp
        return stamp.sec + 1e-9 * stamp.nanosec

    with RobotNode("r", "<robot name='r'/>") as node, StockNode() as peer:
        peer.node.create_subscription(Odometry, "mobile_base_controller/odom", odometry.append, 10)
        peer.node.create_subscription(TFMessage, "tf", transforms.append, 10)

        def tick() -> None:
            node.publish_robot_state(sample())
            for _ in range(4):
                peer.spin(0.005)

        wait_until(lambda: odometry and transforms, tick, "odometry")
        assert last() == pytest.approx((1.25 * time(), 1.25, 0.04))
        put = Setter(peer, "/r", tick)
        assert put("exact_odometry", True) == ""
        wait_until(lambda: last()[1:] == pytest.approx((1.0, 1e-6)), tick, "exact odometry")
        begin = time()
        at = last()[0]
        assert begin < at < 1.25 * begin + 1e-9
        wait_until(lambda: time() > begin + 0.5, tick, "a way")
        assert last()[0] - at == pytest.approx(time() - begin)
        there = odom_in_map()
        seen = len(transforms)
        wait_until(lambda: len(transforms) > seen + 20, tick, "more of tf")
        assert odom_in_map() == pytest.approx(there)
        assert put("exact_odometry", False) == ""
        wait_until(lambda: last() == pytest.approx((1.25 * time(), 1.25, 0.04)), tick, "what the tracks measure")


def test_a_parameter_file_counts_from_the_start(tmp_path):
    message_packages.ensure_importable(["tf2_msgs"])
    from tf2_msgs.msg import TFMessage

    file = tmp_path / "parameters.yaml"
    values = "{publish_map_to_odom: false, publish_truth: false, environment_rate: 2.0, cam.jpeg_quality: 50}"
    file.write_text(f"/**: {{ros__parameters: {values}}}\n")
    joints = JointSample(1.0, (), NONE, NONE, NONE, NONE)
    sample = RobotSample("r", joints, REST, np.zeros(6), REST, np.zeros(6), np.zeros((2, 3, 3)), (), np.zeros((0, 7)))
    heard = []
    poles = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    with (
        RobotNode("r", "<robot name='r'/>", params_file=file) as node,
        SensorNode("s", sensors={"cam": "camera"}, params_file=file) as sensors,
        StockNode() as peer,
    ):
        node.publish_environment_static(("pole_0",), REST[None])
        peer.node.create_subscription(TFMessage, "tf", heard.append, 10)
        peer.node.create_subscription(TFMessage, "tf_environment_static", poles.append, latched)
        wait_until(lambda: heard and poles, lambda: (node.publish_robot_state(sample), peer.spin(0.01)), "tf")
        assert [t.header.frame_id for t in heard[-1].transforms] == ["odom"]
        assert not poles[-1].transforms
        assert node.environment_rate == 2.0
        assert sensors._parameters["cam.jpeg_quality"] == 50
    file.write_text("/**: {ros__parameters: {publish_truth: 3}}\n")
    with pytest.raises(ValueError, match=r"publish_truth.*expecting type"):
        RobotNode("r", "<robot name='r'/>", params_file=file)
    file.write_text("here: there: nowhere\n")
    with pytest.raises(ValueError, match=r"parameters\.yaml is no ROS 2 parameter file") as refused:
        RobotNode("r", "<robot name='r'/>", params_file=file)
    assert "\n" not in str(refused.value)


def test_a_node_that_is_refused_leaves_the_graph(tmp_path):
    """Nobody hears the description of a robot that did not start, while its error is kept."""
    message_packages.ensure_importable(["tf2_msgs"])
    file = tmp_path / "parameters.yaml"
    file.write_text("/**: {ros__parameters: {publish_truth: 3}}\n")
    heard: list[str] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    with StockNode() as peer:
        with pytest.raises(ValueError, match="publish_truth") as kept:
            RobotNode("r", "<robot name='refused'/>", params_file=file)
        peer.node.create_subscription(String, "robot_description", lambda m: heard.append(m.data), latched)
        with RobotNode("s", "<robot name='started'/>"):
            wait_until(lambda: "<robot name='started'/>" in heard, peer.spin, "a description")
    assert heard == ["<robot name='started'/>"], kept


def test_depth_labels_and_rates_of_sensors():
    info = CameraInfo(8, 6, 8.0, 8.0, 3.5, 2.5, "optical")
    depth = np.full((6, 8), 1.5, np.float32)
    exact = np.full((6, 8), 1.25, np.float32)
    labels = np.ones((6, 8), np.int32)
    frame = CameraFrame(1.0, "camera", info, REST, np.zeros((6, 8, 3), np.uint8), depth, labels, exact)
    images: list[Image] = []
    with SensorNode("r_sensors", sensors={"camera": "camera"}, rates={"camera": 30.0}) as node, StockNode() as peer:
        peer.node.create_subscription(Image, "camera/depth/image_raw", images.append, 10)
        peer.node.create_subscription(Image, "camera/labels", lambda _: None, 10)

        def tick() -> None:
            node.publish(frame)
            peer.spin(0.01)

        def last() -> tuple[str, float]:
            kind = np.float32 if images[-1].encoding == "32FC1" else np.uint16
            return images[-1].encoding, float(np.frombuffer(images[-1].data, kind)[0])

        wait_until(lambda: images and last() == ("32FC1", 1.5), tick, "depth")
        assert node.outputs_wanted("camera") == CameraOutput.DEPTH | CameraOutput.LABELS
        put = Setter(peer, "/r_sensors", tick)
        for name, value in (
            ("camera.exact_depth", True),
            ("camera.depth_encoding_16uc1", True),
            ("publish_truth", False),
            ("camera.rate", 5.0),
            ("camera.jpeg_quality", 40),
        ):
            assert put(name, value) == ""
        wait_until(lambda: last() == ("16UC1", 1250.0), tick, "exact depth in millimetres")
        assert node.outputs_wanted("camera") == CameraOutput.EXACT_DEPTH
        assert node.rate("camera") == 5.0
        for name, value in (("camera.rate", 0.0), ("camera.jpeg_quality", 101), ("camera.exact_depth", "yes")):
            assert put(name, value), name


def test_ranges_of_a_lidar_without_its_errors():
    """Of the ground below a real lidar: scattered by centimetres, and exact with the parameter."""
    clouds: list[PointCloud2] = []
    above = frames.pose(np.array([0.0, 0.0, 1.2]))
    (plane, view) = sensor_scenes.world()
    times = itertools.count()
    with SensorNode("r_sensors", sensors={"lidar": "lidar"}) as node, StockNode() as peer:
        peer.node.create_subscription(PointCloud2, "lidar/points", clouds.append, 10)
        lidar = Lidar(LidarSpec.load("vlp16"), "lidar")
        wanted = lambda: node.outputs_wanted("lidar")  # noqa: E731
        sensor = ScheduledSensor(lidar, node.publish, wanted)
        scheduler = SensorScheduler(sensor_scenes.empty(), [sensor], primitives=plane)

        def tick() -> None:
            scheduler.advance(dataclasses.replace(view, time=0.1 * next(times)), {"lidar": above})
            peer.spin(0.01)

        def error() -> float:
            """Greatest distance of a point of the newest cloud from the ground [m]."""
            cloud = clouds[-1]
            (place,) = [field.offset for field in cloud.fields if field.name == "z"]
            heights = np.ndarray(cloud.width * cloud.height, "<f4", bytes(cloud.data), place, (cloud.point_step,))
            return float(np.abs(heights + 1.2).max())

        wait_until(lambda: clouds, tick, "a cloud")
        assert node.outputs_wanted("lidar") == CameraOutput.DEPTH
        assert error() > 0.005
        put = Setter(peer, "/r_sensors", tick)
        assert put("lidar.exact_ranges", True) == ""
        wait_until(lambda: error() < 1e-4, tick, "exact ranges")
        assert put("lidar.exact_ranges", 1)
        assert put("lidar.exact_ranges", False) == ""
        wait_until(lambda: error() > 0.005, tick, "ranges with errors")


@pytest.mark.parametrize(
    ("actor", "name"), [("picker", "picker"), ("my-robot 2", "my_robot_2"), ("7", "_7"), ("Zoë", "Zo_"), ("", "_")]
)
def test_names_of_actors_become_names_of_nodes(actor: str, name: str):
    from rclpy.validate_node_name import validate_node_name

    assert ros_name(actor) == name
    assert validate_node_name(name)


@pytest.mark.parametrize(
    ("text", "namespace"),
    [("", ""), ("/", ""), ("//", ""), ("north", "north"), ("/north/", "north"), ("a//b/", "a/b"), ("_1/B2", "_1/B2")],
)
def test_slashes_around_a_namespace_do_not_matter(text: str, namespace: str):
    from rclpy.validate_namespace import validate_namespace

    assert ros_namespace(text) == namespace
    assert validate_namespace(f"/{namespace}")


@pytest.mark.parametrize(
    "text", ["1", "a b", "a-b", "n\N{LATIN SMALL LETTER O WITH DIAERESIS}rd", "/a/~", "a/{x}", "a" * 300]
)
def test_what_ros_refuses_as_a_namespace_is_refused_in_one_line(text: str):
    from rclpy.exceptions import InvalidNamespaceException
    from rclpy.validate_namespace import validate_namespace

    with pytest.raises(InvalidNamespaceException):
        validate_namespace("/" + text.strip("/"))
    with pytest.raises(UsageError, match="is no ROS namespace") as refused:
        ros_namespace(text)
    assert "\n" not in str(refused.value)
