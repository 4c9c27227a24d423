"""A peer of another DDS vendor, Eclipse Cyclone, with types of its own: it hears the robot and commands it."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import contextlib
import json
import math
import os
import pathlib
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from tests.support.stock_node import wait_until
from vinesim.client.programs import Program, program_group
from vinesim.robot.description.loader import load_description
from vinesim.ros.commands.types import JointTrajectory
from vinesim.ros.messages.definitions import message_definition
from vinesim.ros.robot_node import RobotNode
from vinesim.scene.values import ControllerKind, ControllerSpec, JointSample, RobotSample

PROGRAM = pathlib.Path(__file__).parents[1] / "support" / "cyclone_peer.py"
CYCLONE = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex><Peers><Peer Address="127.0.0.1"/></Peers></Discovery>'
    "</Domain></CycloneDDS>"
)
"""Loopback only, without multicast: as the tests' own ROS nodes."""
ROS_OWN = ("/rosout", "/parameter_events")
"""Topics of every node, and below ``/_action/`` of every action, which are not the robot's."""


class CyclonePeer:
    """The program of the peer, as the test speaks with it."""

    def __init__(self, process: Program) -> None:
        self.process = process
        self.topics: dict[str, str] = {}
        """Types of the topics that are published, as the peer has found them."""
        self.heard: dict[tuple[str, str], dict[str, Any]] = {}
        """The newest message by topic and QoS."""

    def ask(self, **command: Any) -> None:
        """Send a command; a type goes with its definition."""
        if "type" in command:
            command["definition"] = message_definition(command["type"])
        self.process.write_line(json.dumps(command))

    def command(self, topic: str, joints: list[str], positions: list[float], seconds: float) -> None:
        """Send a trajectory of one point."""
        point: dict[str, Any] = {name: [] for name in ("velocities", "accelerations", "effort")}
        since_start = {"sec": int(seconds), "nanosec": round(seconds % 1.0 * 1e9)}
        point |= {"positions": positions, "time_from_start": since_start}
        header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
        message = {"header": header, "joint_names": joints, "points": [point]}
        self.ask(write=topic, type="trajectory_msgs/msg/JointTrajectory", message=message)

    def collect(self) -> None:
        """Take its answers."""
        for line in map(json.loads, self.process.new_lines()):
            if "topics" in line:
                self.topics = line["topics"]
            else:
                self.heard[line["heard"], line["qos"]] = line["message"]


@pytest.fixture(scope="module")
def domain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    own = str(1 + os.getpid() % 100)
    variables = {
        "ROS_DOMAIN_ID": own,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(tmp_path_factory.mktemp("log")),
        "CYCLONEDDS_URI": CYCLONE,
    }
    with pytest.MonkeyPatch.context() as monkeypatch:
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        yield own


def test_a_peer_of_another_vendor_hears_and_commands(domain: str) -> None:
    """Fields of /joint_states as sent, to a reader that knows neither vinesim nor ROS; and its trajectory back."""
    names = ("head_1_joint", "head_2_joint")
    rest = np.array([0, 0, 0, 0, 0, 0, 1.0])
    joints = JointSample(7.25, names, np.array([0.1, -0.2]), np.zeros(2), np.zeros(2), np.zeros(2))
    zeros = np.zeros((2, 3, 3))
    sample = RobotSample("robot", joints, rest, np.zeros(6), rest, np.zeros(6), zeros, (), np.zeros((0, 7)))
    spec = ControllerSpec("head_controller", ControllerKind.JOINT_TRAJECTORY, names)
    with program_group() as group, RobotNode("robot", "<robot name='small'/>", controllers=[spec]) as node:
        peer = CyclonePeer(group.start("peer", str(PROGRAM), domain))
        peer.ask(read="/joint_states", type="sensor_msgs/msg/JointState", qos="default")
        received: list[JointTrajectory] = []

        def step() -> None:
            node.publish_robot_state(sample)
            received.extend(c for c in node.commands() if isinstance(c, JointTrajectory))
            peer.collect()
            time.sleep(0.01)

        def step_and_command() -> None:  # the first may come before its reader is found
            peer.command("/head_controller/joint_trajectory", list(names), [0.35, -0.1], 1.5)
            step()

        wait_until(lambda: peer.heard, step, "joint states at the other vendor's peer")
        wait_until(lambda: received, step_and_command, "a trajectory of the other vendor's peer")
    assert (received[0].controller, received[0].joints) == ("head_controller", names)
    assert received[0].positions.tolist() == [[0.35, -0.1]]
    assert received[0].times.tolist() == [1.5]
    assert peer.heard["/joint_states", "default"] == {
        "header": {"stamp": {"sec": 7, "nanosec": 250_000_000}, "frame_id": ""},
        "name": list(names),
        "position": [0.1, -0.2],
        "velocity": [0.0, 0.0],
        "effort": [0.0, 0.0],
    }


# ---------------------------------------------------------------- every topic of a whole client

VINEBOT = load_description("vinebot")
CAMERA = "/head_front_camera"
OPTICAL = "head_front_camera_rgb_optical_frame"
ARMS = [f"arm_{side}_{i}_joint" for side in ("left", "right") for i in range(1, 8)]
BODY_SENSORS = ("base_imu", "wrist_left_ft", "wrist_right_ft")


def is_stamped(message: dict[str, Any], frame: str) -> None:
    stamp = message["header"]["stamp"]
    # a client without a server counts from 0; the first sound at a microphone began a little before
    assert -0.2 < stamp["sec"] + 1e-9 * stamp["nanosec"] < 3600.0
    assert stamp["nanosec"] < 10**9
    assert message["header"]["frame_id"] == frame


def is_unit(rotation: dict[str, float]) -> None:
    assert math.hypot(*(rotation[axis] for axis in "xyzw")) == pytest.approx(1.0, abs=1e-5)


def norm(vector: dict[str, float]) -> float:
    return math.hypot(*(vector[axis] for axis in "xyz"))


def check_clock(message: dict[str, Any]) -> None:
    assert 0 <= message["clock"]["sec"] < 3600
    assert message["clock"]["nanosec"] % 10**7 == 0  # of a step


def check_description(message: dict[str, Any]) -> None:
    assert ElementTree.fromstring(message["data"]).get("name") == ElementTree.fromstring(VINEBOT.urdf).get("name")


def check_joints(message: dict[str, Any]) -> None:
    is_stamped(message, "")
    assert message["name"] == list(VINEBOT.joints)
    values = np.array([message["position"], message["velocity"], message["effort"]])
    assert values.shape == (3, len(VINEBOT.joints))
    assert np.isfinite(values).all()
    assert values[0, VINEBOT.joints.index("arm_left_4_joint")] == pytest.approx(2.05, abs=0.1)  # at home


def check_frames(message: dict[str, Any], *, parents: set[str], among: set[str]) -> None:
    found = {one["child_frame_id"]: one["header"]["frame_id"] for one in message["transforms"]}
    assert len(found) == len(message["transforms"])
    assert among <= found.keys()
    assert parents <= set(found.values())
    for one in message["transforms"]:
        is_unit(one["transform"]["rotation"])
        assert norm(one["transform"]["translation"]) < 1000.0


def check_truth(message: dict[str, Any], *, child: str) -> None:
    check_frames(message, parents={"map"}, among=set())
    assert any(one["child_frame_id"].startswith(child) for one in message["transforms"])
    assert {one["header"]["frame_id"] for one in message["transforms"]} == {"map"}


def check_intentions(message: dict[str, Any]) -> None:
    assert json.loads(message["data"]) == {"people": []}


def check_gestures(message: dict[str, Any]) -> None:
    assert json.loads(message["data"]).keys() == {"time", "people"}
    assert json.loads(message["data"])["people"] == []


def check_no_markers(message: dict[str, Any]) -> None:
    delete_all = 3  # visualization_msgs/Marker
    assert [one["action"] for one in message["markers"]] == [delete_all]


def check_sound(message: dict[str, Any]) -> None:
    assert len(message["data"]) == 640  # 20 ms of 16 kHz


def check_stamped_sound(message: dict[str, Any]) -> None:
    is_stamped(message, "")
    check_sound(message["audio"])


def check_sound_format(message: dict[str, Any]) -> None:
    assert (message["channels"], message["sample_rate"], message["sample_format"]) == (1, 16_000, "S16LE")


def check_odometry(message: dict[str, Any]) -> None:
    is_stamped(message, "odom")
    assert message["child_frame_id"] == "base_footprint"
    is_unit(message["pose"]["pose"]["orientation"])
    covariance = np.reshape(message["pose"]["covariance"], (6, 6))
    assert np.array_equal(covariance, covariance.T)
    assert covariance[2, 2] == 1e6  # what tracks do not measure
    assert norm(message["twist"]["twist"]["linear"]) < 0.1  # it stands


def check_diagnostics(message: dict[str, Any]) -> None:
    is_stamped(message, "")
    assert {one["hardware_id"] for one in message["status"]} == {"/vinebot"}
    assert all(one["name"].startswith("/vinebot: ") for one in message["status"])
    assert all(one["level"] in (0, 1, 2) and one["values"] for one in message["status"])


def check_imu(message: dict[str, Any]) -> None:
    is_stamped(message, "base_imu_link")
    is_unit(message["orientation"])
    assert norm(message["linear_acceleration"]) == pytest.approx(9.81, abs=0.5)
    assert len(message["angular_velocity_covariance"]) == 9


def check_wrench(message: dict[str, Any], *, frame: str) -> None:
    is_stamped(message, frame)
    assert 1.0 < norm(message["wrench"]["force"]) < 100.0  # the weight of the hand [N]


def check_controller(message: dict[str, Any], *, joints: tuple[str, ...]) -> None:
    is_stamped(message, "")
    assert message["joint_names"] == list(joints)
    reference, feedback, error = (np.array(message[part]["positions"]) for part in ("reference", "feedback", "error"))
    np.testing.assert_allclose(error, reference - feedback, atol=1e-9)
    assert error.shape == (len(joints),)


def check_element(message: dict[str, Any], *, joint: str) -> None:
    is_stamped(message, "")
    assert message["name"] == [joint]
    assert len(message["position"]) == len(message["effort"]) == 1
    assert abs(message["effort"][0]) < 200.0


def check_cloud(message: dict[str, Any], *, frame: str, fields: str, least: int) -> None:
    is_stamped(message, frame)
    assert [field["name"] for field in message["fields"]] == fields.split()
    assert message["row_step"] == message["point_step"] * message["width"]
    assert len(message["data"]) == message["row_step"] * message["height"]
    assert message["width"] * message["height"] >= least


def check_scan(message: dict[str, Any]) -> None:
    is_stamped(message, "base_lidar_link")
    assert len(message["ranges"]) == len(message["intensities"]) > 100
    hits = [one for one in message["ranges"] if math.isfinite(one)]
    assert hits
    assert message["range_min"] <= min(hits) <= max(hits) <= message["range_max"]


def check_camera(message: dict[str, Any]) -> None:
    is_stamped(message, OPTICAL)
    assert (message["width"], message["height"], message["distortion_model"]) == (640, 480, "plumb_bob")
    assert message["k"] == [617.0, 0.0, message["k"][2], 0.0, 617.0, message["k"][5], 0.0, 0.0, 1.0]
    assert message["p"][0] == message["k"][0]


def pixels(message: dict[str, Any], encoding: str, kind: type) -> np.ndarray:
    is_stamped(message, OPTICAL)
    assert (message["width"], message["height"], message["encoding"]) == (640, 480, encoding)
    assert len(message["data"]) == message["step"] * 480
    return np.frombuffer(bytes(message["data"]), kind)


def check_colours(message: dict[str, Any]) -> None:
    assert pixels(message, "rgb8", np.uint8).std() > 5.0


def check_depth(message: dict[str, Any]) -> None:
    depth = pixels(message, "32FC1", np.float32)
    assert 0.1 < np.median(depth[np.isfinite(depth)]) < 10.0  # m


def check_labels(message: dict[str, Any]) -> None:
    assert len(np.unique(pixels(message, "32SC1", np.int32))) > 3


def check_compressed(message: dict[str, Any], *, form: str, start: int, magic: bytes) -> None:
    is_stamped(message, OPTICAL)
    assert form in message["format"]
    assert bytes(message["data"][start : start + len(magic)]) == magic


def check_label_names(message: dict[str, Any]) -> None:
    assert {one["class_id"]: one["class_name"] for one in message["class_map"]}[9] == "bunch"


def check_detections(message: dict[str, Any], *, size: Callable[[dict[str, Any]], float]) -> None:
    is_stamped(message, OPTICAL)
    assert message["detections"]
    for one in message["detections"]:
        (result,) = one["results"]
        assert one["id"].isdigit()
        assert result["hypothesis"]["class_id"] == "9"
        assert 0.0 < result["hypothesis"]["score"] <= 1.0
        is_unit(result["pose"]["pose"]["orientation"])
        assert size(one["bbox"]) > 0.0


def cloud(**facts: Any) -> Callable[[dict[str, Any]], None]:
    return partial(check_cloud, **facts)


TF = "tf2_msgs/msg/TFMessage"
ROBOT_FRAMES = {"base_footprint", "arm_left_1_link", "arm_right_7_link"}
TABLE: dict[str, tuple[str, Callable[[dict[str, Any]], None]]] = {
    "/clock": ("rosgraph_msgs/msg/Clock", check_clock),
    "/robot_description": ("std_msgs/msg/String", check_description),
    "/joint_states": ("sensor_msgs/msg/JointState", check_joints),
    "/tf": (TF, partial(check_frames, parents={"map", "odom"}, among=ROBOT_FRAMES | {"odom"})),
    "/tf_static": (TF, partial(check_frames, parents={"base_link"}, among={OPTICAL, "base_lidar_link"})),
    "/tf_environment": (TF, partial(check_truth, child="bunch_")),
    "/tf_environment_static": (TF, partial(check_truth, child="pole_")),
    "/mobile_base_controller/odom": ("nav_msgs/msg/Odometry", check_odometry),
    "/human_intention": ("std_msgs/msg/String", check_intentions),
    "/human_gesture": ("std_msgs/msg/String", check_gestures),
    "/indicator_lights/markers": ("visualization_msgs/msg/MarkerArray", check_no_markers),
    "/audio": ("audio_common_msgs/msg/AudioData", check_sound),
    "/audio_stamped": ("audio_common_msgs/msg/AudioDataStamped", check_stamped_sound),
    "/audio_info": ("audio_common_msgs/msg/AudioInfo", check_sound_format),
    "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", check_diagnostics),
    "/vine/contacts": (
        "sensor_msgs/msg/PointCloud2",
        cloud(frame="map", fields="x y z force_x force_y force_z body bunch link", least=0),
    ),
    "/vine/events": ("std_msgs/msg/String", check_no_markers),
    "/vine/markers": ("visualization_msgs/msg/MarkerArray", check_no_markers),
    "/base_imu": ("sensor_msgs/msg/Imu", check_imu),
    **{
        f"/wrist_{side}_ft/wrench": (
            "geometry_msgs/msg/WrenchStamped",
            partial(check_wrench, frame=f"wrist_{side}_ft_link"),
        )
        for side in ("left", "right")
    },
    **{
        f"/{spec.name}/controller_state": (
            "control_msgs/msg/JointTrajectoryControllerState",
            partial(check_controller, joints=spec.joints),
        )
        for spec in VINEBOT.controllers
        if spec.kind is ControllerKind.JOINT_TRAJECTORY
    },
    **{f"/see/{joint}/state": ("sensor_msgs/msg/JointState", partial(check_element, joint=joint)) for joint in ARMS},
    "/lidar/points": (
        "sensor_msgs/msg/PointCloud2",
        cloud(frame="base_lidar_link", fields="x y z intensity ring time", least=1000),
    ),
    "/scan": ("sensor_msgs/msg/LaserScan", check_scan),
    f"{CAMERA}/rgb/image_raw": ("sensor_msgs/msg/Image", check_colours),
    f"{CAMERA}/rgb/camera_info": ("sensor_msgs/msg/CameraInfo", check_camera),
    f"{CAMERA}/rgb/image_raw/compressed": (
        "sensor_msgs/msg/CompressedImage",
        partial(check_compressed, form="jpeg", start=0, magic=b"\xff\xd8"),
    ),
    f"{CAMERA}/depth/image_raw": ("sensor_msgs/msg/Image", check_depth),
    f"{CAMERA}/depth/camera_info": ("sensor_msgs/msg/CameraInfo", check_camera),
    f"{CAMERA}/depth/image_raw/compressedDepth": (
        "sensor_msgs/msg/CompressedImage",
        partial(check_compressed, form="compressedDepth", start=12, magic=b"\x89PNG"),
    ),
    f"{CAMERA}/depth/points": (
        "sensor_msgs/msg/PointCloud2",
        cloud(frame=OPTICAL, fields="x y z rgb", least=640 * 480),
    ),
    f"{CAMERA}/labels": ("sensor_msgs/msg/Image", check_labels),
    f"{CAMERA}/label_info": ("vision_msgs/msg/LabelInfo", check_label_names),
    f"{CAMERA}/detections": (
        "vision_msgs/msg/Detection2DArray",
        partial(check_detections, size=lambda box: min(box["size_x"], box["size_y"])),
    ),
    f"{CAMERA}/detections_3d": (
        "vision_msgs/msg/Detection3DArray",
        partial(check_detections, size=lambda box: min(box["size"].values())),
    ),
    f"{CAMERA}/bunches": (
        "sensor_msgs/msg/PointCloud2",
        cloud(frame=OPTICAL, fields="x y z u v seen bunch berries berries_seen pixels amodal_pixels", least=1),
    ),
}
"""Type and check of every topic that a client with one vinebot publishes."""
LATCHED = {
    "/robot_description",
    "/tf_static",
    "/tf_environment_static",
    "/human_intention",
    "/human_gesture",
    "/audio_info",
    "/indicator_lights/markers",
    f"{CAMERA}/label_info",
}
SILENT = {"/vine/events"}
"""Topics on which nothing is sent here, because nothing happens to the plants."""
ROWS = [
    (topic, qos)
    for topic in TABLE
    if topic not in SILENT
    for qos in (("latched",) if topic in LATCHED else ("default", "sensor"))
]


@pytest.fixture(scope="module")
def whole(domain: str) -> Iterator[CyclonePeer]:
    """A whole client, and the peer after it has heard all that it will hear."""
    with program_group(10.0) as group:
        client = group.start(
            "client",
            "-m",
            "vinesim",
            "client",
            "--role",
            "robot",
            "--name",
            "vinebot",
            "--status",
            "none",
            "--sensor-hz",
            "5",
        )
        peer = CyclonePeer(group.start("peer", str(PROGRAM), domain))

        def look() -> None:
            client.new_lines()
            peer.collect()
            time.sleep(0.05)

        def find() -> None:
            peer.ask(list=True)
            look()

        with contextlib.suppress(AssertionError):  # the tests say what is missing
            wait_until(lambda: TABLE.keys() <= peer.topics.keys(), find)
            for topic, qos in ROWS:
                peer.ask(read=topic, type=TABLE[topic][0], qos=qos)
            wait_until(lambda: len(peer.heard) == len(ROWS), look)
        yield peer


@pytest.mark.slow
def test_the_table_has_every_topic_with_its_type(whole: CyclonePeer) -> None:
    published = {
        topic: kind for topic, kind in whole.topics.items() if topic not in ROS_OWN and "/_action/" not in topic
    }
    assert published == {topic: kind for topic, (kind, _) in TABLE.items()}


@pytest.mark.slow
@pytest.mark.parametrize(("topic", "qos"), ROWS)
def test_a_peer_of_another_vendor_hears_every_topic(whole: CyclonePeer, topic: str, qos: str) -> None:
    """Reliable and best effort; of what is latched the last message, as late subscribers receive it."""
    assert (topic, qos) in whole.heard, "nothing was heard"
    TABLE[topic][1](whole.heard[topic, qos])


@pytest.mark.slow
def test_a_peer_of_another_vendor_moves_the_arm(whole: CyclonePeer) -> None:
    """The peer publishes a trajectory for a joint of the arm and reads /joint_states until the joint is at its goal."""
    joint = "arm_left_4_joint"
    goal = 1.85
    place = VINEBOT.joints.index(joint)
    key = "/joint_states", "default"

    def command_and_hear() -> None:
        whole.command("/arm_left_controller/joint_trajectory", [joint], [goal], 0.5)
        whole.heard.pop(key, None)
        whole.ask(read=key[0], type="sensor_msgs/msg/JointState", qos=key[1])
        wait_until(lambda: key in whole.heard, lambda: (whole.collect(), time.sleep(0.05)), "a joint state")

    wait_until(lambda: key in whole.heard and abs(whole.heard[key]["position"][place] - goal) < 0.02, command_and_hear)
