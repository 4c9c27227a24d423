"""Values to ROS messages and back, exactly."""

# ruff: noqa: E402 (messages are imported only where ROS is installed)
from __future__ import annotations

import dataclasses
import math
import struct

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vinesim.core import frames
from vinesim.ros import middleware

pytestmark = pytest.mark.ros
if middleware.unavailable_reason() is not None:
    pytest.skip(str(middleware.unavailable_reason()), allow_module_level=True)

from geometry_msgs.msg import TransformStamped, TwistStamped
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image, JointState, PointCloud2, PointField
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from vinesim.ros.commands import convert as commands
from vinesim.ros.messages import convert, message_packages
from vinesim.ros.messages import convert as serialized
from vinesim.ros.messages.convert import SerializedTransforms, split_time
from vinesim.scene.values import (
    CameraFrame,
    CameraInfo,
    ComponentStatus,
    Imu,
    JointSample,
    LevelLaser,
    LidarScan,
    RobotSample,
    Wrench,
)

INFO = CameraInfo(64, 48, 50.0, 51.0, 31.5, 23.5, "head_front_camera_optical")


def camera_frame(seed: int = 0) -> CameraFrame:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.2, 5.0, (48, 64)).astype(np.float32)
    depth[0, 0], depth[0, 1], depth[0, 2] = np.nan, np.inf, -np.inf
    rgb = rng.integers(0, 256, (48, 64, 3), np.uint8)
    labels = rng.integers(0, 2**31 - 1, (48, 64), np.int32)
    return CameraFrame(12.34, "head_front_camera", INFO, frames.pose(np.zeros(3)), rgb, depth, labels)


def lidar_scan(count: int) -> LidarScan:
    rng = np.random.default_rng(1)
    xyz = rng.normal(size=(count, 3)).astype(np.float32)
    intensity = rng.uniform(0, 255, count).astype(np.float32)
    ring = rng.integers(0, 65536, count).astype(np.uint16)
    offset = np.linspace(0.0, 0.1, count, dtype=np.float32)
    labels = np.zeros(count, np.int32)
    return LidarScan(2.0, "lidar", "lidar_link", frames.pose(np.zeros(3)), xyz, intensity, ring, offset, labels)


def over_the_wire(message):
    """What a peer gets: the message through its serialised form."""
    return deserialize_message(serialize_message(message), type(message))


def points(cloud: PointCloud2) -> np.ndarray:
    """A cloud read as a stranger would: by its own fields."""
    formats = {PointField.FLOAT32: "f4", PointField.UINT16: "u2", PointField.UINT8: "u1"}
    dtype = np.dtype(
        {
            "names": [f.name for f in cloud.fields],
            "formats": [formats[f.datatype] for f in cloud.fields],
            "offsets": [f.offset for f in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    assert cloud.row_step == cloud.point_step * cloud.width
    assert len(cloud.data) == cloud.row_step * cloud.height
    return np.frombuffer(cloud.data, dtype).reshape(cloud.height, cloud.width)


@given(st.integers(0, 2**31 * 10**6 - 1))
def test_stamp_keeps_every_microsecond(microseconds):
    seconds, nanoseconds = split_time(microseconds * 1e-6)
    assert 0 <= nanoseconds < 10**9
    assert abs(seconds * 10**9 + nanoseconds - microseconds * 1000) <= 300  # half a float64 spacing at 2^31 s


def test_stamp_of_ticks_is_exact():
    for tick in range(0, 400_000, 37):
        seconds, nanoseconds = split_time(tick / 100)
        assert seconds * 100 + nanoseconds // 10_000_000 == tick
        assert nanoseconds % 10_000_000 == 0


@pytest.mark.parametrize(
    ("convert_image", "field", "encoding", "dtype", "channels"),
    [
        (convert.rgb_image, "rgb", "rgb8", np.uint8, 3),
        (convert.depth_image, "depth", "32FC1", np.float32, 1),
        (convert.label_image, "labels", "32SC1", np.int32, 1),
    ],
)
def test_image_round_trip_is_bitwise(convert_image, field, encoding, dtype, channels):
    frame = camera_frame()
    image = over_the_wire(convert_image(frame))
    assert (image.encoding, image.height, image.width) == (encoding, 48, 64)
    assert image.step == 64 * channels * np.dtype(dtype).itemsize
    assert (image.header.frame_id, image.header.stamp.sec, image.header.stamp.nanosec) == (
        INFO.frame_id,
        12,
        340_000_000,
    )
    assert bytes(image.data) == getattr(frame, field).tobytes()


def test_image_of_a_strided_array_is_the_same():
    frame = camera_frame()
    mirrored = CameraFrame(
        frame.time, frame.name, INFO, frame.pose, frame.rgb[:, ::-1], frame.depth[:, ::-1], frame.labels[:, ::-1]
    )
    assert bytes(convert.rgb_image(mirrored).data) == frame.rgb[:, ::-1].tobytes()


def test_image_of_wrong_size_says_so():
    frame = camera_frame()
    small = CameraFrame(frame.time, "left", INFO, frame.pose, frame.rgb[:10], frame.depth, frame.labels)
    with pytest.raises(ValueError, match="camera left: rgb8 picture is 64x10, its camera info is 64x48"):
        convert.rgb_image(small)


def test_depth_image_keeps_what_has_no_return():
    depth = np.frombuffer(over_the_wire(convert.depth_image(camera_frame())).data, np.float32)
    assert math.isnan(depth[0])
    assert depth[1] == math.inf
    assert depth[2] == -math.inf


def test_depth_in_millimetres():
    frame = camera_frame()
    image = convert.depth_image_millimetres(frame)
    assert image.encoding == "16UC1"
    millimetres = np.frombuffer(image.data, np.uint16).reshape(48, 64)
    assert millimetres[0, :3].tolist() == [0, 0, 0]
    assert np.abs(millimetres[1:] - 1000.0 * frame.depth[1:]).max() <= 0.5001


def test_depth_beyond_sixteen_bits_counts_as_not_measured():
    depth = camera_frame().depth.copy()
    depth[5, :3] = 65.535, 65.536, 70.0
    frame = dataclasses.replace(camera_frame(), depth=depth)
    millimetres = np.frombuffer(convert.depth_image_millimetres(frame).data, np.uint16).reshape(48, 64)
    assert millimetres[5, :3].tolist() == [65535, 0, 0]


def test_compressed_image_shows_the_same_colours():
    cv2 = pytest.importorskip("cv2")
    frame = camera_frame()
    plain = CameraFrame(
        0.0, "c", INFO, frame.pose, np.full((48, 64, 3), (200, 100, 30), np.uint8), frame.depth, frame.labels
    )
    message = convert.compressed_image(plain)
    assert "jpeg" in message.format
    decoded = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(decoded.astype(int) - plain.rgb).max() <= 4


def test_camera_info_projects_like_the_camera():
    message = over_the_wire(convert.camera_info(INFO, 3.0))
    projection = np.array(message.p).reshape(3, 4)
    u, v, w = projection @ [0.3, -0.2, 2.0, 1.0]
    assert u / w == pytest.approx(50.0 * 0.15 + 31.5)
    assert v / w == pytest.approx(51.0 * -0.1 + 23.5)
    assert np.array_equal(np.array(message.k).reshape(3, 3), projection[:, :3])
    assert message.distortion_model == "plumb_bob"
    assert list(message.d) == [0.0] * 5


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("plumb_bob", (-0.28, 0.09, 0.0011, -0.0008, -0.012)),
        ("rational_polynomial", (0.42, -0.11, 0.0003, -0.0002, 0.004, 0.75, -0.06, 0.002)),
    ],
)
def test_a_camera_with_distortion_says_so_and_its_cloud_projects_onto_its_pixels(model, distortion):
    frame = camera_frame()
    frame = dataclasses.replace(frame, info=dataclasses.replace(INFO, distortion=distortion))
    message = over_the_wire(convert.camera_info(frame.info, 3.0))
    assert (message.distortion_model, tuple(message.d)) == (model, distortion)
    cloud = points(over_the_wire(convert.depth_cloud(frame)))
    seen = np.isfinite(cloud["z"])
    xyz = np.stack([cloud[axis][seen] for axis in "xyz"], -1).astype(float)
    matrix = np.array(message.k).reshape(3, 3)
    pixels = cv2.projectPoints(xyz, np.zeros(3), np.zeros(3), matrix, np.array(message.d))[0].reshape(-1, 2)
    v, u = np.nonzero(seen)
    assert np.abs(pixels - np.stack([u, v], -1)).max() < 1e-3


def test_depth_cloud_projects_back_onto_its_pixels():
    frame = camera_frame()
    message = over_the_wire(convert.depth_cloud(frame))
    assert [(f.name, f.offset, f.datatype) for f in message.fields] == [
        (name, 4 * i, PointField.FLOAT32) for i, name in enumerate(("x", "y", "z", "rgb"))
    ]
    cloud = points(message)
    assert np.isnan(cloud["x"][0, :3]).all()
    assert np.isnan(cloud["z"][0, :3]).all()
    assert not message.is_dense
    seen = np.isfinite(cloud["z"])
    v, u = np.nonzero(seen)
    assert np.abs(INFO.fx * cloud["x"][seen] / cloud["z"][seen] + INFO.cx - u).max() < 1e-4
    assert np.abs(INFO.fy * cloud["y"][seen] / cloud["z"][seen] + INFO.cy - v).max() < 1e-4
    assert np.array_equal(cloud["z"][seen], frame.depth[seen])
    packed = np.ascontiguousarray(cloud["rgb"]).view(np.uint32)
    assert np.array_equal(np.stack([packed >> 16, packed >> 8 & 255, packed & 255], -1), frame.rgb)


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_lidar_cloud_round_trip_is_exact(count):
    scan = lidar_scan(count)
    message = over_the_wire(convert.lidar_cloud(scan))
    assert [f.name for f in message.fields] == ["x", "y", "z", "intensity", "ring", "time"]
    assert (message.height, message.width, message.header.frame_id) == (1, count, "lidar_link")
    if count:
        cloud = points(message)[0]
        assert np.array_equal(np.stack([cloud["x"], cloud["y"], cloud["z"]], -1), scan.xyz)
        assert np.array_equal(cloud["intensity"], scan.intensity)
        assert np.array_equal(cloud["ring"], scan.ring)
        assert np.array_equal(cloud["time"], scan.offset)


def test_a_lidar_with_two_returns_says_which_is_which():
    """One more field in what was padding: readers of x y z intensity ring time find them where they were."""
    scan = lidar_scan(6)
    dual = dataclasses.replace(scan, returned=np.array([1, 1, 2, 1, 2, 1], np.uint8))
    message, plain = (over_the_wire(convert.lidar_cloud(s)) for s in (dual, scan))
    assert [f.name for f in message.fields] == ["x", "y", "z", "intensity", "ring", "return_type", "time"]
    assert message.point_step == plain.point_step
    assert points(message)[0]["return_type"].tolist() == [1, 1, 2, 1, 2, 1]
    where = {f.name: f.offset for f in message.fields}
    assert {f.name: f.offset for f in plain.fields} == {k: v for k, v in where.items() if k != "return_type"}


def joint_sample() -> JointSample:
    position = np.array([0.1, -0.2])
    return JointSample(7.25, ("a_joint", "b_joint"), position, 2 * position, 3 * position, 4 * position)


def test_joint_state_round_trip_is_exact():
    message = over_the_wire(convert.joint_state(joint_sample()))
    assert message.name == ["a_joint", "b_joint"]
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (7, 250_000_000)
    assert list(message.position) == [0.1, -0.2]
    assert list(message.velocity) == [0.2, -0.4]
    assert list(message.effort) == (3 * np.array([0.1, -0.2])).tolist()


def test_odometry_is_what_was_measured_with_its_covariances():
    at, measured = (frames.pose(np.array([x, 2.0, 0.0]), frames.from_yaw(math.pi / 2)) for x in (1.0, 3.0))
    actual = np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.3])
    odom_qd = np.array([0.6, 0.0, 0.0, 0.0, 0.0, 0.4])
    covariance = np.arange(18.0).reshape(2, 3, 3)
    sample = RobotSample(
        "r",
        joint_sample(),
        at,
        actual,
        measured,
        odom_qd,
        covariance,
        (),
        np.zeros((0, 7)),
    )
    message = over_the_wire(convert.odometry(sample, "base_footprint", "odom"))
    assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_footprint")
    assert message.pose.pose.position.x == 3.0
    twist = message.twist.twist
    assert (twist.linear.x, twist.linear.y, twist.angular.z) == (0.6, 0.0, 0.4)
    for part, expected in zip((message.pose, message.twist), covariance, strict=True):
        found = np.reshape(part.covariance, (6, 6))
        assert np.array_equal(found[np.ix_((0, 1, 5), (0, 1, 5))], expected)
        assert found[2:5, 2:5].tolist() == np.diag([convert.UNMEASURED] * 3).tolist()
    on_legs = convert.odometry(dataclasses.replace(sample, odom_is_spatial=True), "base_footprint", "odom")
    for part, expected in zip((on_legs.pose, on_legs.twist), covariance, strict=True):
        found = np.reshape(part.covariance, (6, 6))
        assert found[2:5, 2:5].tolist() == np.diag([expected[0, 0]] * 3).tolist()


def test_wrench_and_imu_keep_their_frames():
    read = Wrench(1.5, "wrist", "wrist_link", np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3]))
    message = over_the_wire(convert.wrench(read))
    assert (message.header.frame_id, message.header.stamp.nanosec) == ("wrist_link", 500_000_000)
    assert (message.wrench.force.z, message.wrench.torque.x) == (3.0, 0.1)
    unit = Imu(
        2.0, "imu", "imu_link", np.array([0.0, 0.0, 0.6, 0.8]), np.array([0.0, 0.0, 0.5]), np.array([0, 0, 9.81])
    )
    message = over_the_wire(convert.imu(unit))
    assert (message.orientation.z, message.orientation.w, message.angular_velocity.z) == (0.6, 0.8, 0.5)
    assert message.linear_acceleration.z == 9.81


def test_messages_of_a_step_are_written_as_stock_serialisation_does():
    """Numbers and stamps of any value, whatever the texts' lengths; other numbers than those of the first message."""
    random = np.random.default_rng(3)

    def joints(names: tuple[str, ...], time: float) -> JointSample:
        position, velocity, effort = random.normal(size=(3, len(names)))
        return JointSample(time, names, position, velocity, effort, effort)

    def robot(time: float) -> RobotSample:
        numbers = [random.normal(size=n) for n in (7, 6, 7, 6)]
        return RobotSample("r", joints(("a",), time), *numbers, random.normal(size=(2, 3, 3)), (), np.zeros((0, 7)))

    def wrench(time: float) -> Wrench:
        return Wrench(time, "wrist", "wrist_link", *random.normal(size=(2, 3)))

    def imu(time: float) -> Imu:
        return Imu(time, "imu", "link", random.normal(size=4), *random.normal(size=(2, 3)))

    def check(written: bytes, message) -> None:
        assert len(written) == len(serialize_message(message))  # the padding may have any bytes
        assert deserialize_message(written, type(message)) == message

    for names in ((), ("a",), ("b_joint", "another_joint", "c")):
        write = serialized.joint_state_writer(joints(names, 0.0))
        for one in (joints(names, 3.25), joints(names, 1234567.000000001)):
            check(write(one), convert.joint_state(one))
    write_odometry = serialized.odometry_writer(robot(0.0), "base_footprint", "odom")
    write_wrench = serialized.wrench_writer(wrench(0.0))
    write_imu = serialized.imu_writer(imu(0.0))
    write_clock = serialized.stamp_writer(convert.clock)
    for time in (0.0, 7.75, 98765.4321):
        check(write_odometry(base := robot(time)), convert.odometry(base, "base_footprint", "odom"))
        check(write_wrench(read := wrench(time)), convert.wrench(read))
        check(write_imu(unit := imu(time)), convert.imu(unit))
        check(write_clock(time), convert.clock(time))
    with pytest.raises(ValueError, match="6 numbers, expected 9"):
        write(joints(("a", "b"), 0.0))
    with pytest.raises(ValueError, match="0 of 1 numbers and 0 stamps found"):
        serialized.SerializedMessage(lambda *_: convert.clock(0.0), 1)


def test_transforms_equal_stock_serialisation_field_for_field():
    message_packages.ensure_importable(["tf2_msgs"])
    from tf2_msgs.msg import TFMessage

    pairs = [("map", "odom"), ("odom", "b"), ("b", "arm_left_1_link"), ("", "xyz"), ("é", "four")]
    rng = np.random.default_rng(2)
    buffer = SerializedTransforms(pairs)
    for time in (1.5, 2.25):  # the same buffer again: nothing of the first remains
        poses = rng.normal(size=(len(pairs), 7))
        stock = TFMessage()
        for (parent, child), q in zip(pairs, poses, strict=True):
            transform = TransformStamped(header=convert.header(time, parent), child_frame_id=child)
            v = transform.transform.translation
            r = transform.transform.rotation
            v.x, v.y, v.z = map(float, q[:3])
            r.x, r.y, r.z, r.w = map(float, q[3:])  # xyzw, as everywhere
            stock.transforms.append(transform)
        ours = buffer.message(time, poses)
        assert deserialize_message(ours, TFMessage) == stock
        assert len(ours) == len(serialize_message(stock))  # only the padding may differ: stock leaves it as it was
    assert deserialize_message(SerializedTransforms([]).message(0.0, np.zeros((0, 7))), TFMessage) == TFMessage()


def test_transforms_want_one_pose_per_frame():
    with pytest.raises(ValueError, match=r"shape \(2, 7\), expected \(1, 7\)"):
        SerializedTransforms([("a", "b")]).message(0.0, np.zeros((2, 7)))


def test_base_velocity_comes_back():
    message = TwistStamped(header=convert.header(3.5, "base_footprint"))
    message.twist.linear.x = 0.4
    message.twist.angular.z = -0.2
    velocity = commands.base_velocity(over_the_wire(message))
    assert velocity.time == 3.5
    assert velocity.linear.tolist() == [0.4, 0.0, 0.0]
    assert velocity.angular.tolist() == [0.0, 0.0, -0.2]
    message.twist.linear.y = math.nan
    with pytest.raises(commands.CommandError, match="not finite"):
        commands.base_velocity(message)


def test_forward_commands_come_back():
    """One value for each joint; NaN leaves a joint alone, infinity and a wrong number of values are refused."""
    command = commands.forward_command(over_the_wire(Float64MultiArray(data=[1.0, -2.5])), "forward", ("a", "b"))
    assert command.values.tolist() == [1.0, -2.5]
    assert math.isnan(commands.forward_command(Float64MultiArray(data=[math.nan]), "f", ("a",)).values[0])
    with pytest.raises(commands.CommandError, match="not finite"):
        commands.forward_command(Float64MultiArray(data=[math.inf]), "forward", ("a",))
    with pytest.raises(commands.CommandError, match="forward: 1 values; give one for each of a, b"):
        commands.forward_command(Float64MultiArray(data=[1.0]), "forward", ("a", "b"))


def trajectory(*points: tuple[float, list[float], list[float]]) -> JointTrajectory:
    message = JointTrajectory(joint_names=["a", "b"])
    for time, positions, velocities in points:
        point = JointTrajectoryPoint(positions=positions, velocities=velocities)
        point.time_from_start.sec = math.floor(time)
        point.time_from_start.nanosec = round(time % 1 * 1e9)
        message.points.append(point)
    return message


def test_joint_trajectory_comes_back():
    message = trajectory((0.5, [1.0, 2.0], [0.1, 0.2]), (1.25, [3.0, 4.0], [0.0, 0.0]))
    value = commands.joint_trajectory(over_the_wire(message), "arm_left_controller", ("a", "b"))
    assert value.joints == ("a", "b")
    assert value.times.tolist() == [0.5, 1.25]
    assert value.positions.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert value.velocities is not None
    assert value.velocities.tolist() == [[0.1, 0.2], [0.0, 0.0]]
    assert commands.joint_trajectory(trajectory((1.0, [1.0, 2.0], [])), "c", ("a", "b")).velocities is None
    assert commands.joint_trajectory(trajectory(), "c", ("a", "b")).positions.shape == (0, 2)


def test_commands_may_use_the_names_of_joints_in_the_robot_file():
    renamed = {"Joint 1": "a", "Плечо": "b"}
    message = trajectory((1.0, [1.0, 2.0], []))
    message.joint_names = ["Плечо", "a"]
    assert commands.joint_trajectory(message, "c", ("a", "b"), renamed=renamed).joints == ("b", "a")
    message.joint_names = ["Joint 1", "a"]  # one joint by both of its names
    with pytest.raises(commands.CommandError, match="each at most once"):
        commands.joint_trajectory(message, "c", ("a", "b"), renamed=renamed)
    states = JointState(name=["Joint 1", "b"], position=[0.1, 0.2])
    assert commands.hardware_command(states, "c", ("a", "b"), (), renamed).joints == ("a", "b")


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (trajectory((0.5, [1.0], [])), "point 0 has 1 positions and 0 velocities for 2 joints"),
        (trajectory((0.5, [1.0, 2.0], [1.0])), "point 0 has 2 positions and 1 velocities"),
        (trajectory((0.5, [1.0, 2.0], []), (0.5, [1.0, 2.0], [])), "does not increase"),
        (trajectory((0.5, [1.0, math.nan], [])), "not finite"),
        (trajectory((-0.5, [1.0, 2.0], [])), "does not increase from 0"),
        (JointTrajectory(joint_names=["a", "c"]), "a trajectory for a, c; name joints among a, b, each at most once"),
    ],
)
def test_bad_trajectories_are_refused_in_words(message, words):
    with pytest.raises(commands.CommandError, match=words):
        commands.joint_trajectory(message, "arm_left_controller", ("a", "b"))


@pytest.mark.parametrize("dual", [False, True])
def test_a_scan_equals_the_cloud_of_the_same_revolution(dual):
    """Each point of the level laser, at its bearing and its time as laser_geometry computes them; +Inf elsewhere."""
    count = 720
    period = 1e-4
    delay = 2e-5
    level = LevelLaser(7, count, delay, period, -0.02, 0.5, 100.0)
    rng = np.random.default_rng(3)
    shot = np.sort(rng.choice(count, 500, replace=dual))
    ring = np.where(rng.uniform(size=500) < 0.7, 7, 3).astype(np.uint16)
    bearing = level.azimuth - 2.0 * np.pi * shot / count
    reach = rng.uniform(0.5, 90.0, 500)
    xyz = np.stack([reach * np.cos(bearing), reach * np.sin(bearing), 0.02 * reach], 1).astype(np.float32)
    offset = (delay + period * shot).astype(np.float32)
    scan = LidarScan(
        2.0,
        "lidar",
        "lidar_link",
        frames.pose(np.zeros(3)),
        xyz,
        reach.astype(np.float32),
        ring,
        offset,
        np.zeros(500, np.int32),
        level,
    )
    cloud = points(over_the_wire(convert.lidar_cloud(scan))).ravel()
    message = over_the_wire(convert.laser_scan(scan))
    assert message.header.frame_id == "lidar_link"
    assert len(message.ranges) == len(message.intensities) == count
    assert message.angle_increment > 0.0
    assert message.angle_max == pytest.approx(message.angle_min + (count - 1) * message.angle_increment, abs=1e-5)
    assert (message.range_min, message.range_max) == (0.5, 100.0)
    assert message.scan_time == pytest.approx(count * period)
    expected = np.full(count, np.inf)
    start = convert.seconds(message.header.stamp)
    for point in cloud[cloud["ring"] == 7]:
        angle = np.arctan2(point["y"], point["x"])
        ray = round((angle - message.angle_min) % (2.0 * np.pi) / message.angle_increment) % count
        expected[ray] = min(expected[ray], np.hypot(point["x"], point["y"]))
        assert start + ray * message.time_increment == pytest.approx(2.0 + point["time"], abs=1e-6)
    np.testing.assert_allclose(message.ranges, expected, rtol=1e-6)
    known = np.isfinite(expected)
    np.testing.assert_allclose(np.array(message.intensities)[known], expected[known], rtol=1e-5)
    assert not np.array(message.intensities)[~known].any()
    with pytest.raises(ValueError, match="level"):
        convert.laser_scan(dataclasses.replace(scan, level=None))


def test_compressed_depth_is_decoded_as_its_transport_does():
    """By the parameters in the header: format 0, then depth = a / (q - b), NaN for q = 0."""
    frame = camera_frame()
    frame.depth[1, :3] = 0.05, 9.99, 20.0
    message = over_the_wire(convert.compressed_depth(frame))
    assert message.format == "32FC1; compressedDepth png"
    kind, a, b = struct.unpack_from("<iff", bytes(message.data))
    pixels = cv2.imdecode(np.frombuffer(message.data, np.uint8)[12:], cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    assert (kind, pixels.dtype, pixels.shape) == (0, np.uint16, frame.depth.shape)
    found = np.where(pixels > 0, a / (np.maximum(pixels, 1) - np.float32(b)), np.nan)
    known = np.isfinite(frame.depth) & (frame.depth < 10.0) & (frame.depth > 0.16)
    assert np.isnan(found[~known]).all()
    step = frame.depth[known] ** 2 / a  # of the inverse, in depth
    assert (np.abs(found[known] - frame.depth[known]) <= 1.05 * step + 1e-6).all()

    message = over_the_wire(convert.compressed_depth(frame, is_millimetres=True))
    assert message.format == "16UC1; compressedDepth png"
    assert bytes(message.data[:12]) == bytes(12)
    pixels = cv2.imdecode(np.frombuffer(message.data, np.uint8)[12:], cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    raw = np.frombuffer(convert.depth_image_millimetres(frame).data, np.uint16).reshape(pixels.shape)
    assert np.array_equal(pixels, np.where(raw > 10_000, 0, raw))


def test_diagnostics_carry_the_figures():
    loop = ComponentStatus("simulation", "warning", "behind", {"real_time_factor": 0.5, "dropped": 3})
    status, other = over_the_wire(
        convert.diagnostics(1.0, "/robot", [loop, ComponentStatus("sensors", "error")])
    ).status
    assert (status.name, status.message, other.level) == ("/robot: simulation", "behind", b"\x02")
    assert {value.key: value.value for value in status.values} == {"real_time_factor": "0.5", "dropped": "3"}
    assert status.level == b"\x01"


def test_filling_copies_so_that_the_value_stays_its_owners():
    frame = camera_frame()
    image = convert.rgb_image(frame)
    before = bytes(image.data)
    frame.rgb[...] = 0
    assert isinstance(image, Image)
    assert bytes(image.data) == before
