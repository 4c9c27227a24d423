"""What is true around a robot as a stock node sees it: bunches in pictures; bunches, boxes and people in the map."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import dataclasses
import itertools
import os
import pathlib
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from vinesim.ros.messages import message_packages

message_packages.ensure_importable(["tf2_msgs", "vision_msgs"])

from geometry_msgs.msg import Pose, Transform, TwistStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo as CameraInfoMessage
from sensor_msgs.msg import Image, PointCloud2
from tf2_msgs.msg import TFMessage
from vision_msgs.msg import Detection2DArray, Detection3DArray, LabelInfo

from tests.support import sensor_scenes
from tests.support.contact_scenes import cane
from tests.support.stock_node import StockNode, wait_until
from vinesim.client.client import Client
from vinesim.client.processes.robot_processes import RobotProcesses
from vinesim.client.processes.ros_process import RosProcess
from vinesim.client.rate_loop import RateLoop
from vinesim.client.tasks.start_poses import spawn_pose
from vinesim.core import frames
from vinesim.net.transport.memory_bus import MemoryHub
from vinesim.rigid.human_posture import standing_pose
from vinesim.robot.description.loader import load_description
from vinesim.ros.messages.bunches import BUNCH_POINT
from vinesim.ros.sensor_node import SensorNode
from vinesim.scene.builder import assemble
from vinesim.scene.camera_geometry import project_points
from vinesim.scene.ids import LABEL_STRIDE, Organ, label
from vinesim.scene.spec import load_scene
from vinesim.scene.values import CameraInfo, CameraOutput, HumanSpec
from vinesim.sensors.camera.camera import Camera, CameraSpec
from vinesim.sensors.export.images import look_at
from vinesim.sensors.primitives.scene_primitives import Primitives, rest_snapshot

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
CAMERA = "/head_front_camera"


@pytest.fixture
def peer(monkeypatch, tmp_path) -> Iterator[StockNode]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    with StockNode() as node:
        yield node


def stamp_of(header) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def pose_of(message: Pose | Transform) -> np.ndarray:
    at = message.position if isinstance(message, Pose) else message.translation
    turn = message.orientation if isinstance(message, Pose) else message.rotation
    return np.array([at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w])


def poses_of(message: TFMessage) -> dict[str, np.ndarray]:
    return {one.child_frame_id: pose_of(one.transform) for one in message.transforms}


def test_people_boxes_and_bunches_stand_in_tf_environment_where_they_are(peer):
    """A bunch leaves its frame when it is picked, and has another from then on; people come and go with all bones."""
    scene = load_scene("demo")
    vinebot = load_description("vinebot")
    box = {"box_pose": [[3.0, 5.0, 0.1, 0, 0, 0, 1]], "box_size": [[0.3, 0.2, 0.1]], "box_mass": [1.0]}
    model = assemble([cane((50.0, 5.0, 1.4), bunch=0.5), cane((52.0, 5.0, 1.4), bunch=0.5)], **box)
    hub = MemoryHub()
    with RosProcess("robot", model, vinebot) as process:
        client = Client(scene, model, vinebot, hub.bus("robot"), name="robot", pose=spawn_pose(scene, 0))
        process.attach(client)
        physics = client.physics
        true = {}
        heard = []

        def keep(_: Client) -> None:
            shown = zip(physics.visuals(), physics.visual_q(), strict=True)
            poses = {one.name: q for one, q in shown if one.organ in (Organ.BOX, Organ.HUMAN, Organ.BUNCH)}
            for bunch in np.flatnonzero(physics.state.bunch_attached):
                poses[f"hangs {bunch}"] = physics.state.body_q[model.bunch_body[bunch]].copy()
            true[round(physics.time * 100)] = poses

        client.post_step.append(keep)
        peer.node.create_subscription(TFMessage, "/tf_environment", heard.append, 100)
        loop = RateLoop(physics.dt)

        def step() -> None:
            loop.begin()
            client.tick()
            loop.end()
            peer.spin(0.0)

        def newest() -> set[str]:
            return set(poses_of(heard[-1])) if heard else set()

        plain = {"box_0", "bunch_00000", "bunch_00001"}
        wait_until(lambda: newest() == plain, step)
        root = frames.pose(np.array([1.0, 1.0, 0.0]))
        client.add_human(HumanSpec("anna", 7, standing_pose(root)), None, hub.bus("anna"))
        aside = frames.pose(np.array([1.0, 6.0, 0.0]))
        physics.add_human(HumanSpec("bob", 8, standing_pose(aside)), is_remote=True)
        bones = {f"{who}/{bone}" for who in ("anna", "bob") for bone in ("head", "hips", "left_forearm", "right_foot")}
        wait_until(lambda: newest() >= plain | bones, step)
        assert len(newest()) == 3 + 2 * 46
        physics.pick(1)
        wait_until(lambda: "picked_bunch_00001" in newest(), step)
        assert "bunch_00001" not in newest()
        physics.remove_human("bob")
        wait_until(lambda: not any(name.startswith("bob/") for name in newest()), step)
        assert newest() >= {"anna/head", "bunch_00000", "picked_bunch_00001"}
    for message in heard:
        assert {one.header.frame_id for one in message.transforms} == {"map"}
        expected = true[round(stamp_of(message.transforms[0].header) / 10**7)]
        for name, pose in poses_of(message).items():
            key = name.replace("picked_bunch_0000", "bunch/").replace("box_", "box/").replace("bunch_0000", "hangs ")
            np.testing.assert_array_equal(pose, expected[key], err_msg=name)


class Chain:
    """Transforms by time, as tf2 would look them up; poses at the very times that are asked for."""

    def __init__(self, peer: StockNode) -> None:
        self.static: dict[str, tuple[str, np.ndarray]] = {}
        self.moving: dict[int, dict[str, tuple[str, np.ndarray]]] = {}
        peer.node.create_subscription(TFMessage, "/tf_static", lambda m: self.static.update(self._read(m)), LATCHED)
        peer.node.create_subscription(TFMessage, "/tf", self._take, 1000)

    @staticmethod
    def _read(message: TFMessage) -> dict[str, tuple[str, np.ndarray]]:
        return {t.child_frame_id: (t.header.frame_id, pose_of(t.transform)) for t in message.transforms}

    def _take(self, message: TFMessage) -> None:
        self.moving.setdefault(stamp_of(message.transforms[0].header), {}).update(self._read(message))

    def pose(self, frame: str, at: int) -> np.ndarray:
        """Of a frame in the map at a time [ns]."""
        pose = frames.pose(np.zeros(3))
        known = self.static | self.moving[at]
        while frame != "map":
            frame, step = known[frame]
            pose = frames.compose(step, pose)
        return pose


@pytest.mark.long
def test_detections_and_label_pixels_agree_while_the_robot_drives_and_turns(peer):
    """Of a real client: boxes are those of the label pixels. Bunches that are known project onto their label pixels
    within 1 px through tf and camera_info; poses and cut points agree with them."""
    scene = load_scene("demo")
    vinebot = load_description("vinebot")
    model = sensor_scenes.demo()
    processes = RobotProcesses("robot", scene, model, vinebot, sensor_hz=5.0)
    client = Client(scene, model, vinebot, MemoryHub().bus("robot"), name="robot", pose=spawn_pose(scene, 0))
    with processes:
        processes.attach(client)
        types = {
            "labels": Image,
            "rgb/camera_info": CameraInfoMessage,
            "detections": Detection2DArray,
            "detections_3d": Detection3DArray,
            "bunches": PointCloud2,
        }
        heard: dict[str, dict[int, object]] = {topic: {} for topic in types}
        for topic, kind in types.items():
            take = heard[topic]
            keep = lambda m, t=take: t.update({stamp_of(m.header): m})  # noqa: E731
            peer.node.create_subscription(kind, f"{CAMERA}/{topic}", keep, 10)
        infos: list[LabelInfo] = []
        peer.node.create_subscription(LabelInfo, f"{CAMERA}/label_info", infos.append, LATCHED)
        environment: list[TFMessage] = []
        peer.node.create_subscription(TFMessage, "/tf_environment", environment.append, 10)
        drive = peer.node.create_publisher(TwistStamped, "/mobile_base_controller/cmd_vel", 1)
        twist = TwistStamped()
        twist.twist.linear.x = 0.15
        twist.twist.angular.z = 0.25
        chain = Chain(peer)
        loop = RateLoop(client.physics.dt)

        def step() -> None:
            loop.begin()
            client.tick()
            loop.end()
            if loop.ticks % 10 == 0:
                drive.publish(twist)
            for _ in range(8):
                peer.spin(0.0)

        def whole() -> list[int]:
            return sorted(set.intersection(*map(set, heard.values())) & set(chain.moving))

        def has_moved() -> bool:
            times = whole()
            first, last = (chain.pose("base_footprint", now) for now in (times[0], times[-1]))
            turned = abs(frames.to_yaw(frames.multiply(frames.conjugate(first[3:]), last[3:])))
            return turned > 0.1 and float(np.linalg.norm(last[:2] - first[:2])) > 0.05

        wait_until(lambda: len(whole()) >= 8 and environment and infos and has_moved(), step)
    names = {one.class_id: one.class_name for one in infos[0].class_map}
    hanging = poses_of(environment[-1])
    primitives = Primitives(model)
    primitives.update(rest_snapshot(model))
    for i, body in enumerate(model.bunch_body):  # they hang as generated: these bunches are known
        np.testing.assert_allclose(hanging[f"bunch_{i:05d}"], rest_snapshot(model).body_q[body], atol=2e-4)
    seen = 0
    times = whole()
    for now in times:
        labels = np.frombuffer(heard["labels"][now].data, np.int32)
        message = heard["rgb/camera_info"][now]
        k = np.reshape(message.k, (3, 3))
        info = CameraInfo(message.width, message.height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], message.header.frame_id)
        labels = labels.reshape(info.height, info.width)
        pose = chain.pose(info.frame_id, now)
        known = known_labels(primitives, pose, info) if now in times[:: len(times) // 2] else None
        flat = heard["detections"][now].detections
        solid = heard["detections_3d"][now].detections
        rows = np.frombuffer(heard["bunches"][now].data, BUNCH_POINT)
        shown = np.unique(labels[labels // LABEL_STRIDE == int(Organ.BUNCH)]) % LABEL_STRIDE
        assert [one.id for one in flat] == [one.id for one in solid] == [str(i) for i in shown]
        assert rows["bunch"].tolist() == shown.tolist()
        for two, three, row in zip(flat, solid, rows, strict=True):
            mine = labels == label(Organ.BUNCH, int(two.id))
            assert box_of(two.bbox) == extent(mine)
            (result,) = two.results
            assert names[int(result.hypothesis.class_id)] == "bunch"
            assert three.results[0].pose == result.pose
            assert mine.sum() == row["pixels"]
            assert result.hypothesis.score == pytest.approx(row["pixels"] / row["amodal_pixels"])
            assert 0 <= row["berries_seen"] <= row["berries"] == model.bunch_berries[int(two.id)]
            # the pose of the box, by tf in the map, is in the bunch: its ends are at the box's
            middle = frames.compose(pose, pose_of(three.bbox.center))
            in_bunch = frames.compose(frames.inverse(hanging[f"bunch_{int(two.id):05d}"]), middle)
            assert abs(in_bunch[0] - 0.5 * model.bunch_length[int(two.id)]) < 0.06
            cut = np.array([row["x"], row["y"], row["z"]], float)
            if cut[2] > 0.0:
                np.testing.assert_allclose(project_points(cut, info), [row["u"], row["v"]], atol=0.05)
            if row["seen"]:
                column, line = np.rint([row["u"], row["v"]]).astype(int)
                assert labels[line, column] == label(Organ.PEDUNCLE, int(two.id))
            if known is not None and mine.sum() > 50:
                assert lies_within_one_pixel(mine, known == label(Organ.BUNCH, int(two.id)))
                seen += 1
    assert seen >= 5


def known_labels(primitives: Primitives, pose: np.ndarray, info: CameraInfo) -> np.ndarray:
    """Labels [height, width] that rays meet, from a pose [7]; 0 for what is no primitive."""
    met = sensor_scenes.oracle(primitives, pose, info)[1]
    return np.where(met >= 0, primitives.label[np.maximum(met, 0)], 0)


def lies_within_one_pixel(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether masks [height, width] differ by a border of 1 px; but for a few pixels between leaves."""
    border = np.ones((3, 3), np.uint8)
    outside = (one & ~cv2.dilate(other.astype(np.uint8), border).astype(bool)).sum()
    outside += (other & ~cv2.dilate(one.astype(np.uint8), border).astype(bool)).sum()
    return outside <= 0.01 * one.sum()


def extent(mask: np.ndarray) -> tuple[int, int, int, int]:
    rows, columns = np.nonzero(mask)
    return columns.min(), rows.min(), columns.max(), rows.max()


def box_of(box) -> tuple[float, float, float, float]:
    """First column and row, last column and row of the pixels in a vision_msgs box."""
    x = box.center.position.x
    y = box.center.position.y
    wide = box.size_x
    high = box.size_y
    return x - 0.5 * (wide - 1), y - 0.5 * (high - 1), x + 0.5 * (wide - 1), y + 0.5 * (high - 1)


def test_the_example_of_a_perception_node_finds_bunches_in_colour_and_depth(peer):
    """What it prints lies at a bunch, within half a bunch's length, and the nearest bunch is found within 5 cm."""
    file = pathlib.Path(__file__).parents[2] / "examples" / "ros" / "find_bunches.py"
    assert len(file.read_text().splitlines()) < 100
    model = sensor_scenes.demo()
    view = rest_snapshot(model)
    primitives = Primitives(model)
    primitives.update(view)
    middles = view.body_q[model.bunch_body].astype(float)
    middles = frames.compose(middles, frames.pose(np.outer(0.5 * model.bunch_length, [1.0, 0.0, 0.0])))[:, :3]
    spec = CameraSpec.load("d435")
    camera = Camera(spec, spec.info("optical"), "head_front_camera", quality="fast")
    pose = look_at(view.body_q[model.bunch_body[0], :3] + [0.1, -0.9, 0.1], view.body_q[model.bunch_body[0], :3])
    picture = camera.render(primitives, pose)
    found: list[np.ndarray] = []

    def listen(stream) -> None:
        for line in stream:
            words = line.split()
            if words[0] in ("waiting", "picture"):
                continue
            assert words[0] == "optical:"
            found.append(np.array([words[4], words[6], words[8]], float))

    with (
        SensorNode("sensors", sensors={"head_front_camera": "camera"}) as node,
        subprocess.Popen([sys.executable, str(file)], stdout=subprocess.PIPE, text=True) as finder,
    ):
        reader = threading.Thread(target=listen, args=(finder.stdout,))
        reader.start()
        wait_until(lambda: node.outputs_wanted("head_front_camera") & CameraOutput.DEPTH)
        ticks = itertools.count(1)

        def send() -> None:
            node.publish(dataclasses.replace(picture, time=0.1 * next(ticks)))
            time.sleep(0.1)

        wait_until(lambda: len(found) >= 6, send)
        finder.kill()
        reader.join()
    true = frames.rotate(frames.conjugate(picture.pose[3:]), middles - picture.pose[:3])
    away = np.linalg.norm(np.array(found)[:, None] - true, axis=2).min(1)
    assert away.max() < 0.12
    nearest = true[np.argmin(np.where(true[:, 2] > 0.3, np.linalg.norm(true - [0, 0, 0.9], axis=1), np.inf))]
    assert np.linalg.norm(np.array(found) - nearest, axis=1).min() < 0.05
