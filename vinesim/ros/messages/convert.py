"""Conversion of values to ROS messages: pure functions.

Arrays go into a message through ``array.array``, which rosidl takes as it is (0.03 ms for a 0.9 MB picture; a list of
numbers takes a thousand times as long). Stamps are the simulation time of the sample (REP-117/118 for what has no
return, REP-103 for frames).
"""

from __future__ import annotations

import array
import dataclasses
import functools
import json
import struct
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo as CameraInfoMessage
from sensor_msgs.msg import CompressedImage, Image, JointState, LaserScan, PointCloud2, PointField
from sensor_msgs.msg import Imu as ImuMessage
from std_msgs.msg import Header, String
from trajectory_msgs.msg import JointTrajectoryPoint

from vinesim.scene.camera_geometry import (
    POINT_DTYPE,
    depth_millimetres,
    distortion_model,
    intrinsic_matrix,
    write_points,
)
from vinesim.scene.values import (
    CameraFrame,
    CameraInfo,
    ComponentStatus,
    ElasticSample,
    HandGestures,
    Imu,
    Intention,
    JointSample,
    LidarScan,
    MultispectralFrame,
    RobotSample,
    Wrench,
)

"""One point of a depth camera's cloud; rgb is 0x00RRGGBB, which PointCloud2 carries as a float32 (PCL's way)."""

LIDAR_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["f4", "f4", "f4", "f4", "u2", "f4"],
        "offsets": [0, 4, 8, 12, 16, 20],
        "itemsize": 24,
    }
)
"""One point of a lidar; time [s] counts from the stamp."""

DUAL_LIDAR_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "return_type", "time"],
        "formats": ["f4", "f4", "f4", "f4", "u2", "u1", "f4"],
        "offsets": [0, 4, 8, 12, 16, 18, 20],
        "itemsize": 24,
    }
)
"""The same of a lidar that reports two returns of a shot; return_type: 1 the strongest, 2 the other."""

_FIELD_TYPES = {
    "f4": PointField.FLOAT32,
    "i4": PointField.INT32,
    "u1": PointField.UINT8,
    "u2": PointField.UINT16,
    "u4": PointField.FLOAT32,
}


def stamp(time: float) -> Time:
    """Simulation time [s] as a message."""
    seconds, nanoseconds = split_time(time)
    return Time(sec=seconds, nanosec=nanoseconds)


def seconds(time: Time) -> float:
    """Time [s] of a message."""
    return time.sec + 1e-9 * time.nanosec


def header(time: float, frame: str) -> Header:
    """Stamp and frame."""
    return Header(stamp=stamp(time), frame_id=frame)


def clock(time: float) -> Clock:
    """Simulation time [s] for nodes with use_sim_time."""
    return Clock(clock=stamp(time))


def joint_state(sample: JointSample) -> JointState:
    """Positions, velocities and efforts (what the drive transmits, contacts included)."""
    return JointState(
        header=header(sample.time, ""),
        name=list(sample.names),
        position=_doubles(sample.position),
        velocity=_doubles(sample.velocity),
        effort=_doubles(sample.effort),
    )


_PLANAR = (0, 1, 5)
"""x, y and yaw in a covariance of 6 rows."""
UNMEASURED = 1e6
"""Variance of z, roll and pitch in odometry, which tracks do not measure."""


def odometry(sample: RobotSample, base: str, odom: str) -> Odometry:
    """Odometry of the base: pose in the frame ``odom``, velocity in its own axes, both as measured, and their
    covariances."""
    message = Odometry(header=header(sample.joints.time, odom), child_frame_id=base)
    pose = message.pose.pose
    set_vector(pose.position, sample.odom_q[:3])
    set_quaternion(pose.orientation, sample.odom_q[3:])
    set_vector(message.twist.twist.linear, sample.odom_qd[:3])
    set_vector(message.twist.twist.angular, sample.odom_qd[3:])
    for target, planar in zip((message.pose, message.twist), sample.odom_covariance, strict=True):
        covariance = np.diag([0.0, 0.0, UNMEASURED, UNMEASURED, UNMEASURED, 0.0])
        covariance[np.ix_(_PLANAR, _PLANAR)] = planar
        target.covariance = covariance.ravel()
    return message


def wrench(sample: Wrench) -> WrenchStamped:
    """What a force-torque sensor reads, in its frame."""
    message = WrenchStamped(header=header(sample.time, sample.frame))
    set_vector(message.wrench.force, sample.force)
    set_vector(message.wrench.torque, sample.torque)
    return message


def imu(sample: Imu) -> ImuMessage:
    """What an inertial measurement unit reads; exact, so all covariances are 0."""
    message = ImuMessage(header=header(sample.time, sample.frame))
    set_quaternion(message.orientation, sample.orientation)
    set_vector(message.angular_velocity, sample.angular_velocity)
    set_vector(message.linear_acceleration, sample.linear_acceleration)
    return message


def intentions(known: Iterable[Intention]) -> String:
    """What people indicate to do, as JSON; times are those of the world [s]."""
    people = [{"person": one.person, "intention": one.what, "start": one.start, "end": one.end} for one in known]
    return String(data=json.dumps({"people": people}))


def gestures(time: float, shown: Iterable[HandGestures]) -> String:
    """What the hands of people show since a ``time`` of the world [s], as JSON."""
    people = [{"person": one.person, "left": one.left, "right": one.right} for one in shown]
    return String(data=json.dumps({"time": time, "people": people}))


def elastic_state(sample: ElasticSample, joint: int) -> JointState:
    """One series elastic element: position of the motor, and the torque that its spring carries."""
    return JointState(
        header=header(sample.time, ""),
        name=[sample.names[joint]],
        position=[float(sample.motor[joint])],
        effort=[float(sample.torque[joint])],
    )


def reference_points(sample: RobotSample, joints: np.ndarray) -> dict[str, JointTrajectoryPoint]:
    """Desired and actual state of ``joints`` [k], and the difference, as control_msgs have them."""
    assert sample.reference is not None
    wanted = np.stack([sample.reference.position[joints], sample.reference.velocity[joints]])
    found = np.stack([sample.joints.position[joints], sample.joints.velocity[joints]])
    states = {"desired": wanted, "actual": found, "error": wanted - found}
    return {
        name: JointTrajectoryPoint(positions=position.tolist(), velocities=velocity.tolist())
        for name, (position, velocity) in states.items()
    }


CONTACT_POINT = np.dtype(
    [
        ("x", "f4"),
        ("y", "f4"),
        ("z", "f4"),
        ("force_x", "f4"),
        ("force_y", "f4"),
        ("force_z", "f4"),
        ("body", "i4"),
        ("bunch", "i4"),
        ("link", "i4"),
    ]
)
"""A contact as a point of a cloud: where, the force on the robot [N], the plant's body, its bunch or -1, and the
robot's link by its number in the URDF or -1."""


def contact_cloud(sample: RobotSample, links: Mapping[str, int], bunch_of_body: np.ndarray, frame: str) -> PointCloud2:
    """All contacts of one step, in the world's ``frame``; ``links``: numbers by name, ``bunch_of_body`` [body]."""
    message, points = cloud(sample.joints.time, frame, CONTACT_POINT, 1, len(sample.contacts))
    for row, contact in zip(points[0], sample.contacts, strict=True):
        row["x"], row["y"], row["z"] = contact.position
        row["force_x"], row["force_y"], row["force_z"] = contact.force
        row["body"], row["link"] = contact.body, links.get(contact.link.removeprefix(f"{sample.actor}/"), -1)
        row["bunch"] = bunch_of_body[contact.body] if 0 <= contact.body < len(bunch_of_body) else -1
    message.is_dense = True
    return message


def rgb_image(frame: CameraFrame) -> Image:
    """The picture, rgb8."""
    return image(frame, frame.rgb, "rgb8", np.uint8)


def depth_image(frame: CameraFrame) -> Image:
    """Depth along z [m], 32FC1; NaN no return, -Inf too near, +Inf too far (REP-118)."""
    return image(frame, frame.depth, "32FC1", np.float32)


def depth_image_millimetres(frame: CameraFrame) -> Image:
    """Depth along z [mm], 16UC1; 0 where there is none or it is beyond 65.535 m (REP-118)."""
    return image(frame, depth_millimetres(frame.depth), "16UC1", np.uint16)


QUANTIZATION = 100.0
MAX_COMPRESSED_DEPTH = 10.0
"""Of compressed depth, [1] and [m]: the defaults of compressed_depth_image_transport."""


def compressed_depth(frame: CameraFrame, *, is_millimetres: bool = False) -> CompressedImage:
    """Depth as compressed_depth_image_transport encodes it: a header of 12 bytes, then a PNG of 16 bits.

    Millimetres, or the inverse of depth: q = a / depth + b, 0 where there is none and from 10 m on; a and b stand in
    the header. Nearer than 0.152 m 16 bits cannot hold q, which then is 0.
    """
    import cv2  # here, as a process that sends no pictures should not load it

    scale = offset = 0.0
    if is_millimetres:
        encoding = "16UC1"
        pixels = depth_millimetres(frame.depth)
        pixels[pixels > 1000.0 * MAX_COMPRESSED_DEPTH] = 0
    else:
        encoding = "32FC1"
        scale = QUANTIZATION * (QUANTIZATION + 1.0)
        offset = 1.0 - scale / MAX_COMPRESSED_DEPTH
        is_known = np.isfinite(frame.depth) & (frame.depth < MAX_COMPRESSED_DEPTH) & (frame.depth > 0.0)
        inverse = scale / np.where(is_known, frame.depth, np.float32(MAX_COMPRESSED_DEPTH)) + offset
        pixels = np.where(is_known & (inverse <= np.iinfo(np.uint16).max), inverse, 0.0).astype(np.uint16)
    encoded, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not encoded:
        raise ValueError(f"camera {frame.name}: could not encode depth of shape {frame.depth.shape}")
    message = CompressedImage(header=header(frame.time, frame.info.frame_id), format=f"{encoding}; compressedDepth png")
    message.data = _bytes(np.frombuffer(struct.pack("<iff", 0, scale, offset) + data.tobytes(), np.uint8))
    return message


def label_image(frame: CameraFrame) -> Image:
    """Label of every pixel (:func:`vinesim.scene.ids.label`), 32SC1."""
    return image(frame, frame.labels, "32SC1", np.int32)


def compressed_image(frame: CameraFrame, quality: int = 85) -> CompressedImage:
    """The picture as JPEG."""
    import cv2  # here, as a process that sends no pictures should not load it

    encoded, data = cv2.imencode(".jpg", frame.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not encoded:
        raise ValueError(f"camera {frame.name}: could not encode a picture of shape {frame.rgb.shape}")
    message = CompressedImage(header=header(frame.time, frame.info.frame_id), format="rgb8; jpeg compressed bgr8")
    message.data = _bytes(data)
    return message


def camera_info(info: CameraInfo, time: float) -> CameraInfoMessage:
    """Intrinsics and distortion; rectification is the identity, and a rectified picture has the same matrix."""
    message = CameraInfoMessage(header=header(time, info.frame_id), width=info.width, height=info.height)
    message.distortion_model, coefficients = distortion_model(info)
    message.d = array.array("d", coefficients)
    message.k = intrinsic_matrix(info)
    message.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    message.p = [info.fx, 0.0, info.cx, 0.0, 0.0, info.fy, info.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return message


def depth_cloud(frame: CameraFrame) -> PointCloud2:
    """Depth and colour as an organised cloud in the optical frame; NaN where there is no depth."""
    message, points = cloud(frame.time, frame.info.frame_id, POINT_DTYPE, frame.info.height, frame.info.width)
    write_points(frame, points)
    message.is_dense = False
    return message


def lidar_cloud(scan: LidarScan) -> PointCloud2:
    """One revolution: x y z intensity ring time (and return_type), unorganised, every point valid.

    Raw, as drivers publish it: each point in the frame that the lidar had at that point's time.
    """
    point = LIDAR_POINT if scan.returned is None else DUAL_LIDAR_POINT
    message, points = cloud(scan.time, scan.frame_id, point, 1, len(scan.xyz))
    points = points[0]
    for axis, name in enumerate("xyz"):
        points[name] = scan.xyz[:, axis]
    points["intensity"] = scan.intensity
    points["ring"] = scan.ring
    points["time"] = scan.offset
    if scan.returned is not None:
        points["return_type"] = scan.returned
    message.is_dense = True
    return message


def laser_scan(scan: LidarScan) -> LaserScan:
    """The laser nearest to the horizontal as a scan in its plane: the nearest return of each shot, +Inf for none.

    Angles rise, as most programs expect, while the head turns clockwise: the first ray is the last that was fired,
    which the stamp is of, and ``time_increment`` is negative.
    """
    level = scan.level
    if level is None:
        raise ValueError(f"lidar {scan.name}: no laser is named that looks level; give LidarScan.level")
    message = LaserScan(header=header(scan.time + level.delay + (level.count - 1) * level.period, scan.frame_id))
    step = 2.0 * np.pi / level.count
    message.angle_min = level.azimuth + step
    message.angle_increment = step
    message.angle_max = level.azimuth + 2.0 * np.pi
    message.time_increment = -level.period
    message.scan_time = level.count * level.period
    message.range_min = level.nearest
    message.range_max = level.farthest
    ranges = np.full(level.count, np.inf, np.float32)
    intensities = np.zeros(level.count, np.float32)
    points = np.flatnonzero(scan.ring == level.ring)
    shot = np.rint((scan.offset[points] - level.delay) / level.period).astype(int)
    found = np.hypot(scan.xyz[points, 0], scan.xyz[points, 1])
    far_first = np.argsort(-found, kind="stable")  # of two returns the nearer is written last
    rays = level.count - 1 - shot[far_first]
    ranges[rays] = found[far_first]
    intensities[rays] = scan.intensity[points][far_first]
    message.ranges = _floats(ranges)
    message.intensities = _floats(intensities)
    return message


_LEVELS = {"ok": DiagnosticStatus.OK, "warning": DiagnosticStatus.WARN, "error": DiagnosticStatus.ERROR}


def diagnostics(time: float, prefix: str, components: Iterable[ComponentStatus]) -> DiagnosticArray:
    """States of the components of a client; their names get the ``prefix``, which names the hardware, too."""
    statuses = []
    for one in components:
        values = [KeyValue(key=key, value=str(value)) for key, value in one.values.items()]
        statuses.append(
            DiagnosticStatus(
                name=f"{prefix}: {one.name}",
                hardware_id=prefix,
                level=_LEVELS[one.level],
                message=one.message,
                values=values,
            )
        )
    return DiagnosticArray(header=header(time, ""), status=statuses)


def image(frame: CameraFrame | MultispectralFrame, pixels: np.ndarray, encoding: str, dtype: type) -> Image:
    """``pixels`` [height, width, ...] of a picture as an image of this encoding."""
    pixels = np.ascontiguousarray(pixels, dtype)
    if pixels.shape[:2] != (frame.info.height, frame.info.width):
        raise ValueError(
            f"camera {frame.name}: {encoding} picture is {pixels.shape[1]}x{pixels.shape[0]}, "
            f"its info says {frame.info.width}x{frame.info.height}"
        )
    message = Image(header=header(frame.time, frame.info.frame_id), encoding=encoding)
    message.height, message.width = pixels.shape[:2]
    message.step = pixels.strides[0]
    message.is_bigendian = int(sys.byteorder == "big")
    message.data = _bytes(pixels)
    return message


def cloud(time: float, frame: str, point: np.dtype, height: int, width: int) -> tuple[PointCloud2, np.ndarray]:
    """A cloud without values, and its points [height, width] to write them into."""
    message = PointCloud2(header=header(time, frame), height=height, width=width)
    message.fields = list(_fields(point))
    message.point_step = point.itemsize
    message.row_step = point.itemsize * width
    message.is_bigendian = sys.byteorder == "big"
    message.data = array.array("B", bytes(point.itemsize * width * height))
    return message, np.frombuffer(message.data, point).reshape(height, width)


@functools.cache
def _fields(point: np.dtype) -> tuple[PointField, ...]:
    assert point.fields is not None
    described = ((name, kind.str[1:], offset) for name, (kind, offset, *_) in point.fields.items())
    return tuple(
        PointField(name=name, offset=offset, datatype=_FIELD_TYPES[kind], count=1) for name, kind, offset in described
    )


def _bytes(values: np.ndarray) -> array.array:
    data = array.array("B")
    data.frombytes(values.reshape(-1).view(np.uint8).data)
    return data


def _doubles(values: np.ndarray) -> array.array:
    data = array.array("d")
    data.frombytes(np.ascontiguousarray(values, np.float64).view(np.uint8).data)
    return data


def _floats(values: np.ndarray) -> array.array:
    data = array.array("f")
    data.frombytes(np.ascontiguousarray(values, np.float32).view(np.uint8).data)
    return data


def set_vector(target: Any, values: np.ndarray) -> None:
    """Write [3] into the fields x, y and z of a message."""
    target.x, target.y, target.z = map(float, values)


def set_quaternion(target: Any, values: np.ndarray) -> None:
    """Write [4] into the fields x, y, z and w of a message."""
    target.x, target.y, target.z, target.w = map(float, values)


# tf2_msgs/TFMessage with fixed frames and changing poses, patched into its serialised bytes.
#
# A thousand fresh message objects take 14 ms, a thousand poses written into the bytes 0.01 ms. The layout is that of
# OMG CDR (XCDR1, little endian): numbers are aligned to their size, counted from the end of the four-byte header,
# strings are their length with the closing zero, then the characters. Every transform ends with seven doubles, so the
# body is a multiple of eight bytes and can be seen as an array of doubles or of 32-bit words.


HEADER = b"\x00\x01\x00\x00"
"""CDR, little endian."""


class SerializedTransforms:
    """The poses of ``frames``, pairs of (parent, child), ready to be published again and again."""

    def __init__(self, frames: Sequence[tuple[str, str]]) -> None:
        body = bytearray(struct.pack("<I", len(frames)))
        stamps = []
        poses = []
        for parent, child in frames:
            _align(body, 4)
            stamps.append(len(body) // 4)
            body += bytes(8)
            _append_string(body, parent)
            _append_string(body, child)
            _align(body, 8)
            poses.append(len(body) // 8)
            body += bytes(56)
        _align(body, 8)
        self._bytes = np.frombuffer(HEADER + bytes(4) + body, np.uint8).copy()
        # The header is padded to eight bytes here, so that both views are aligned; message() leaves the padding out.
        inner = self._bytes[8:]
        self._words = inner.view("<u4")
        self._doubles = inner.view("<f8")
        self._stamps = np.array(stamps, np.intp)
        self._poses = np.array(poses, np.intp)[:, None] + np.arange(7)
        self._length = 4 if not frames else len(body)

    def message(self, time: float, poses: np.ndarray) -> bytes:
        """The serialised TFMessage of ``poses`` [transform, 7], all stamped ``time`` [s]."""
        poses = np.asarray(poses, float)
        if poses.shape != (len(self._poses), 7):
            raise ValueError(f"poses have shape {poses.shape}, expected {(len(self._poses), 7)}: one per frame")
        seconds, nanoseconds = split_time(time)
        self._words[self._stamps] = seconds
        self._words[self._stamps + 1] = nanoseconds
        self._doubles[self._poses] = poses
        return HEADER + self._bytes[8 : 8 + self._length].tobytes()


def split_time(time: float) -> tuple[int, int]:
    """Seconds and nanoseconds of a time [s], rounded to the nearest nanosecond."""
    return divmod(round(time * 1e9), 1_000_000_000)


def _append_string(body: bytearray, text: str) -> None:
    encoded = text.encode() + b"\0"
    _align(body, 4)
    body += struct.pack("<I", len(encoded)) + encoded


def _align(body: bytearray, size: int) -> None:
    body += bytes(-len(body) % size)


# Messages of every step with fixed texts and changing numbers, patched into their serialised bytes.
#
# An rclpy object of a few dozen numbers takes 0.03 to 0.12 ms to build and as long to convert when it is sent; writing
# its numbers into the bytes takes 0.01 ms. Where they stand is found once, in a message whose numbers are marks.


_MARK_TIME = 1_589_640_193.708529245
"""[s] Stamp of the message in which numbers are looked for."""
_FIRST_MARK = 1.2345e200
"""The first number in it; the others are this times 2, 3, ..."""
_NONE = np.zeros(0)


class SerializedMessage:
    """A message with a stamp and ``count`` doubles, ready to be published again and again.

    ``build(time, numbers)`` makes it of a time [s] and numbers [count]; every number stands in it as it is, and all
    else is the same each time. ValueError if a number or the stamp is not found.
    """

    def __init__(self, build: Callable[[float, np.ndarray], Any], count: int) -> None:
        marks = _FIRST_MARK * np.arange(1.0, count + 1.0)
        data = serialize_message(build(_MARK_TIME, marks))
        self._length = len(data)
        # Numbers are aligned to their size, counted from the end of the four-byte header (OMG CDR, XCDR1): so the
        # header is padded to eight bytes here, and the end to a multiple of eight.
        self._bytes = np.frombuffer(bytes(4) + data + bytes(-(len(data) + 4) % 8), np.uint8).copy()
        self._words, self._doubles = self._bytes.view("<i4"), self._bytes.view("<f8")
        self._places, self._numbers = np.nonzero(self._doubles[:, None] == marks)
        stamp = np.frombuffer(struct.pack("<iI", *split_time(_MARK_TIME)), "<i4")
        self._stamps = np.flatnonzero((self._words[:-1] == stamp[0]) & (self._words[1:] == stamp[1]))
        if len(np.unique(self._numbers)) < count or not len(self._stamps):
            raise ValueError(f"{len(np.unique(self._numbers))} of {count} numbers and {len(self._stamps)} stamps found")
        self.count = count

    def message(self, time: float, numbers: np.ndarray) -> bytes:
        """The serialised message at a ``time`` [s] with ``numbers`` [count]."""
        if len(numbers) != self.count:
            raise ValueError(f"{len(numbers)} numbers, expected {self.count}")
        seconds, nanoseconds = split_time(time)
        self._words[self._stamps], self._words[self._stamps + 1] = seconds, nanoseconds
        self._doubles[self._places] = numbers[self._numbers]
        return self._bytes[4 : 4 + self._length].tobytes()


def stamp_writer(build: Callable[[float], Any]) -> Callable[[float], bytes]:
    """Writes a message of which only the stamp [s] changes."""
    template = SerializedMessage(lambda time, _: build(time), 0)
    return lambda time: template.message(time, _NONE)


def joint_state_writer(first: JointSample) -> Callable[[JointSample], bytes]:
    """Writes sensor_msgs/JointState of samples with the joints of the ``first``."""
    count = len(first.names)

    def build(time: float, numbers: np.ndarray) -> Any:
        position, velocity, effort = numbers.reshape(3, count)
        return joint_state(dataclasses.replace(first, time=time, position=position, velocity=velocity, effort=effort))

    template = SerializedMessage(build, 3 * count)
    return lambda one: template.message(one.time, np.concatenate([one.position, one.velocity, one.effort]))


def odometry_writer(first: RobotSample, base: str, odom: str) -> Callable[[RobotSample], bytes]:
    """Writes nav_msgs/Odometry of samples of one robot, in the frame ``odom``."""

    def build(time: float, numbers: np.ndarray) -> Any:
        sample = dataclasses.replace(
            first,
            joints=dataclasses.replace(first.joints, time=time),
            odom_q=numbers[:7],
            odom_qd=numbers[7:13],
            odom_covariance=numbers[13:].reshape(2, 3, 3),
        )
        return odometry(sample, base, odom)

    template = SerializedMessage(build, 31)
    return lambda one: template.message(
        one.joints.time, np.concatenate([one.odom_q, one.odom_qd, np.ravel(one.odom_covariance)])
    )


def imu_writer(first: Imu) -> Callable[[Imu], bytes]:
    """Writes sensor_msgs/Imu of readings of one sensor."""

    def build(time: float, n: np.ndarray) -> Any:
        return imu(
            dataclasses.replace(first, time=time, orientation=n[:4], angular_velocity=n[4:7], linear_acceleration=n[7:])
        )

    template = SerializedMessage(build, 10)
    return lambda one: template.message(
        one.time, np.concatenate([one.orientation, one.angular_velocity, one.linear_acceleration])
    )


def wrench_writer(first: Wrench) -> Callable[[Wrench], bytes]:
    """Writes geometry_msgs/WrenchStamped of readings of one sensor."""
    template = SerializedMessage(
        lambda time, n: wrench(dataclasses.replace(first, time=time, force=n[:3], torque=n[3:])), 6
    )
    return lambda one: template.message(one.time, np.concatenate([one.force, one.torque]))
