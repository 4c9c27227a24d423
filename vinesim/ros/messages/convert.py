"""Conversion of plain values to ROS messages, by pure functions.

Arrays are put into messages as ``array.array``, which rosidl takes without conversion (0.03 ms for a 0.9 MB picture; a
list of numbers takes a thousand times as long). Header stamps are the simulated time of the sample. Frames follow
REP-103, and missing returns REP-117 and REP-118.
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

LIDAR_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["f4", "f4", "f4", "f4", "u2", "f4"],
        "offsets": [0, 4, 8, 12, 16, 20],
        "itemsize": 24,
    }
)
"""One point of a lidar cloud. ``time`` [s] counts from the header stamp."""

DUAL_LIDAR_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "return_type", "time"],
        "formats": ["f4", "f4", "f4", "f4", "u2", "u1", "f4"],
        "offsets": [0, 4, 8, 12, 16, 18, 20],
        "itemsize": 24,
    }
)
"""One point of the cloud of a lidar that reports two returns per shot: a :data:`LIDAR_POINT` with ``return_type``,
which is 1 for the strongest return and 2 for the other."""

_FIELD_TYPES = {
    "f4": PointField.FLOAT32,
    "i4": PointField.INT32,
    "u1": PointField.UINT8,
    "u2": PointField.UINT16,
    "u4": PointField.FLOAT32,  # rgb as 0x00RRGGBB, which PointCloud2 carries as a float32, as PCL does
}
"""Datatype of a PointField by numpy type."""


def stamp(time: float) -> Time:
    """Convert simulation time [s] to a Time message."""
    seconds, nanoseconds = split_time(time)
    return Time(sec=seconds, nanosec=nanoseconds)


def seconds(time: Time) -> float:
    """Convert a Time message to seconds."""
    return time.sec + 1e-9 * time.nanosec


def header(time: float, frame: str) -> Header:
    """Returns a header with the stamp ``time`` [s] and a frame id."""
    return Header(stamp=stamp(time), frame_id=frame)


def clock(time: float) -> Clock:
    """Returns the /clock message for simulation time ``time`` [s]."""
    return Clock(clock=stamp(time))


def joint_state(sample: JointSample) -> JointState:
    """Returns positions, velocities and efforts of joints. The effort is what the drive transmits, contacts
    included."""
    return JointState(
        header=header(sample.time, ""),
        name=list(sample.names),
        position=_doubles(sample.position),
        velocity=_doubles(sample.velocity),
        effort=_doubles(sample.effort),
    )


_PLANAR = (0, 1, 5)
"""Rows of x, y and yaw in a covariance [6, 6]."""
UNMEASURED = 1e6
"""Variance of z [m2], roll and pitch [rad2] in odometry, which tracks do not measure."""


def odometry(sample: RobotSample, base: str, odom: str) -> Odometry:
    """Returns the measured odometry of the base, with covariances: its pose in the frame ``odom`` and its velocity
    in the axes of the frame ``base``."""
    message = Odometry(header=header(sample.joints.time, odom), child_frame_id=base)
    pose = message.pose.pose
    set_vector(pose.position, sample.odom_q[:3])
    set_quaternion(pose.orientation, sample.odom_q[3:])
    set_vector(message.twist.twist.linear, sample.odom_qd[:3])
    set_vector(message.twist.twist.angular, sample.odom_qd[3:])
    for target, planar in zip((message.pose, message.twist), sample.odom_covariance, strict=True):
        rest = planar[0, 0] if sample.odom_is_spatial else UNMEASURED
        covariance = np.diag([0.0, 0.0, rest, rest, rest, 0.0])
        covariance[np.ix_(_PLANAR, _PLANAR)] = planar
        target.covariance = covariance.ravel()
    return message


def wrench(sample: Wrench) -> WrenchStamped:
    """Returns the reading of a force-torque sensor, in the sensor's frame."""
    message = WrenchStamped(header=header(sample.time, sample.frame))
    set_vector(message.wrench.force, sample.force)
    set_vector(message.wrench.torque, sample.torque)
    return message


def imu(sample: Imu) -> ImuMessage:
    """Returns the reading of an inertial measurement unit. It is exact, so all covariances are 0."""
    message = ImuMessage(header=header(sample.time, sample.frame))
    set_quaternion(message.orientation, sample.orientation)
    set_vector(message.angular_velocity, sample.angular_velocity)
    set_vector(message.linear_acceleration, sample.linear_acceleration)
    return message


def intentions(known: Iterable[Intention]) -> String:
    """Returns the intentions that people indicate, as JSON. Times are those of the world [s]."""
    people = [{"person": one.person, "intention": one.what, "start": one.start, "end": one.end} for one in known]
    return String(data=json.dumps({"people": people}))


def gestures(time: float, shown: Iterable[HandGestures]) -> String:
    """Returns the gestures that the hands of people show since ``time`` of the world [s], as JSON."""
    people = [{"person": one.person, "left": one.left, "right": one.right} for one in shown]
    return String(data=json.dumps({"time": time, "people": people}))


def event(time: float, what: Mapping[str, Any]) -> String:
    """Returns an event of the vineyard, which ended at ``time`` of the world [s], as JSON."""
    return String(data=json.dumps({"time": time, **what}))


def elastic_state(sample: ElasticSample, joint: int) -> JointState:
    """Returns the state of one series elastic element: position of the motor, and torque of the spring."""
    return JointState(
        header=header(sample.time, ""),
        name=[sample.names[joint]],
        position=[float(sample.motor[joint])],
        effort=[float(sample.torque[joint])],
    )


def reference_points(sample: RobotSample, joints: np.ndarray) -> dict[str, JointTrajectoryPoint]:
    """Returns the desired and the actual state of ``joints`` [k] (indices), and their difference, under the names of
    control_msgs."""
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
"""A contact as a point of a cloud: position [m], force on the robot [N], index of the plant body, index of its bunch
or -1, and index of the robot's link in the URDF or -1."""


def contact_cloud(sample: RobotSample, links: Mapping[str, int], bunch_of_body: np.ndarray, frame: str) -> PointCloud2:
    """Returns all contacts of one step, in the world's ``frame``. ``links``: indices of the robot's links, by name.
    ``bunch_of_body`` [body]: index of the bunch of each plant body, -1 for none."""
    message, points = cloud(sample.joints.time, frame, CONTACT_POINT, 1, len(sample.contacts))
    for row, contact in zip(points[0], sample.contacts, strict=True):
        row["x"], row["y"], row["z"] = contact.position
        row["force_x"], row["force_y"], row["force_z"] = contact.force
        row["body"], row["link"] = contact.body, links.get(contact.link.removeprefix(f"{sample.actor}/"), -1)
        row["bunch"] = bunch_of_body[contact.body] if 0 <= contact.body < len(bunch_of_body) else -1
    message.is_dense = True
    return message


def rgb_image(frame: CameraFrame) -> Image:
    """Returns the colour picture, encoding rgb8."""
    return image(frame, frame.rgb, "rgb8", np.uint8)


def depth_image(frame: CameraFrame) -> Image:
    """Returns depth along z [m], encoding 32FC1: NaN for no return, -Inf for too near, +Inf for too far (REP-118)."""
    return image(frame, frame.depth, "32FC1", np.float32)


def depth_image_millimetres(frame: CameraFrame) -> Image:
    """Returns depth along z [mm], encoding 16UC1: 0 where depth is unknown or beyond 65.535 m (REP-118)."""
    return image(frame, depth_millimetres(frame.depth), "16UC1", np.uint16)


QUANTIZATION = 100.0
"""Quantization of inverse depth in compressed depth [1]: the default of compressed_depth_image_transport."""
MAX_COMPRESSED_DEPTH = 10.0
"""Largest depth in compressed depth [m]: the default of compressed_depth_image_transport."""


def compressed_depth(frame: CameraFrame, *, is_millimetres: bool = False) -> CompressedImage:
    """Returns depth as compressed_depth_image_transport encodes it: a header of 12 bytes, then a PNG of 16 bits per
    pixel.

    The pixels are millimetres if ``is_millimetres``. Otherwise they are inverse depth, q = a / depth + b, where a and b
    are in the header. q is 0 where depth is unknown or at least 10 m. It is also 0 for depths below 0.152 m, for which
    q exceeds 16 bits.
    """
    import cv2  # not at the top: a process that publishes no pictures should not load it

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
    """Returns the label of every pixel (:func:`vinesim.scene.ids.label`), encoding 32SC1."""
    return image(frame, frame.labels, "32SC1", np.int32)


def compressed_image(frame: CameraFrame, quality: int = 85) -> CompressedImage:
    """Returns the colour picture as JPEG of a ``quality`` from 1 to 100."""
    import cv2  # not at the top: a process that publishes no pictures should not load it

    encoded, data = cv2.imencode(".jpg", frame.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not encoded:
        raise ValueError(f"camera {frame.name}: could not encode a picture of shape {frame.rgb.shape}")
    message = CompressedImage(header=header(frame.time, frame.info.frame_id), format="rgb8; jpeg compressed bgr8")
    message.data = _bytes(data)
    return message


def camera_info(info: CameraInfo, time: float) -> CameraInfoMessage:
    """Returns intrinsics and distortion of a camera. Rectification is the identity, and a rectified picture has the
    same camera matrix."""
    message = CameraInfoMessage(header=header(time, info.frame_id), width=info.width, height=info.height)
    message.distortion_model, coefficients = distortion_model(info)
    message.d = array.array("d", coefficients)
    message.k = intrinsic_matrix(info)
    message.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    message.p = [info.fx, 0.0, info.cx, 0.0, 0.0, info.fy, info.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return message


def depth_cloud(frame: CameraFrame) -> PointCloud2:
    """Returns depth and colour as an organised cloud in the optical frame. Points without depth are NaN."""
    message, points = cloud(frame.time, frame.info.frame_id, POINT_DTYPE, frame.info.height, frame.info.width)
    write_points(frame, points)
    message.is_dense = False
    return message


def lidar_cloud(scan: LidarScan) -> PointCloud2:
    """Returns the points of one revolution as an unorganised cloud, in which every point is valid.

    The points are raw, as drivers publish them: each point is in the frame that the lidar had at the point's ``time``.
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
    """Returns the shots of the laser nearest to the horizontal: the range of the nearest return of each shot, +Inf for
    none.

    Angles increase, as most programs expect, although the lidar turns clockwise. So the first ray is the last one
    fired, the header stamp is the time of this ray, and ``time_increment`` is negative.
    """
    level = scan.level
    if level is None:
        raise ValueError(f"lidar {scan.name}: the scan names no horizontal laser; give LidarScan.level")
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
    far_first = np.argsort(-found, kind="stable")  # the nearer of two returns is written last, and so kept
    rays = level.count - 1 - shot[far_first]
    ranges[rays] = found[far_first]
    intensities[rays] = scan.intensity[points][far_first]
    message.ranges = _floats(ranges)
    message.intensities = _floats(intensities)
    return message


_LEVELS = {"ok": DiagnosticStatus.OK, "warning": DiagnosticStatus.WARN, "error": DiagnosticStatus.ERROR}


def diagnostics(time: float, prefix: str, components: Iterable[ComponentStatus]) -> DiagnosticArray:
    """Returns the states of the components of a client. ``prefix`` is put before their names, and is their
    hardware_id."""
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
    """Convert the ``pixels`` [height, width, ...] of a picture to an Image message."""
    pixels = np.ascontiguousarray(pixels, dtype)
    if pixels.shape[:2] != (frame.info.height, frame.info.width):
        raise ValueError(
            f"camera {frame.name}: {encoding} picture is {pixels.shape[1]}x{pixels.shape[0]}, "
            f"its camera info is {frame.info.width}x{frame.info.height}"
        )
    message = Image(header=header(frame.time, frame.info.frame_id), encoding=encoding)
    message.height, message.width = pixels.shape[:2]
    message.step = pixels.strides[0]
    message.is_bigendian = int(sys.byteorder == "big")
    message.data = _bytes(pixels)
    return message


def cloud(time: float, frame: str, point: np.dtype, height: int, width: int) -> tuple[PointCloud2, np.ndarray]:
    """Returns an empty PointCloud2 message, and an array of its points [height, width] to be filled."""
    message = PointCloud2(header=header(time, frame), height=height, width=width)
    message.fields = list(_fields(point))
    message.point_step = point.itemsize
    message.row_step = point.itemsize * width
    message.is_bigendian = sys.byteorder == "big"
    message.data = array.array("B", bytes(point.itemsize * width * height))
    return message, np.frombuffer(message.data, point).reshape(height, width)


@functools.cache
def _fields(point: np.dtype) -> tuple[PointField, ...]:
    """Returns the fields of a PointCloud2 whose points have the numpy type ``point``."""
    assert point.fields is not None
    described = ((name, kind.str[1:], offset) for name, (kind, offset, *_) in point.fields.items())
    return tuple(
        PointField(name=name, offset=offset, datatype=_FIELD_TYPES[kind], count=1) for name, kind, offset in described
    )


def _bytes(values: np.ndarray) -> array.array:
    """Convert an array to ``array.array`` of bytes."""
    data = array.array("B")
    data.frombytes(values.reshape(-1).view(np.uint8).data)
    return data


def _doubles(values: np.ndarray) -> array.array:
    """Convert an array to ``array.array`` of float64."""
    data = array.array("d")
    data.frombytes(np.ascontiguousarray(values, np.float64).view(np.uint8).data)
    return data


def _floats(values: np.ndarray) -> array.array:
    """Convert an array to ``array.array`` of float32."""
    data = array.array("f")
    data.frombytes(np.ascontiguousarray(values, np.float32).view(np.uint8).data)
    return data


def set_vector(target: Any, values: np.ndarray) -> None:
    """Write ``values`` [3] into the fields x, y and z of a message."""
    target.x, target.y, target.z = map(float, values)


def set_quaternion(target: Any, values: np.ndarray) -> None:
    """Write ``values`` [4] into the fields x, y, z and w of a message."""
    target.x, target.y, target.z, target.w = map(float, values)


# tf2_msgs/TFMessage with fixed frames and changing poses, which are written into the serialised message.
#
# A thousand new message objects take 14 ms; a thousand poses written into the bytes take 0.01 ms. The layout is OMG CDR
# (XCDR1, little endian). Numbers are aligned to their size, counted from the end of the four-byte header. A string is
# its length with the closing zero, then its characters. Every transform ends with seven doubles, so the length of the
# body is a multiple of eight bytes, and the body can be viewed as an array of doubles or of 32-bit words.


HEADER = b"\x00\x01\x00\x00"
"""Header of a serialised message: CDR, little endian."""


class SerializedTransforms:
    """A serialised TFMessage whose stamps and poses can be replaced. ``frames``: (parent, child) of each transform."""

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
        # The header is padded to eight bytes here, so that both views are aligned; message() removes the padding.
        inner = self._bytes[8:]
        self._words = inner.view("<u4")
        self._doubles = inner.view("<f8")
        self._stamps = np.array(stamps, np.intp)
        self._poses = np.array(poses, np.intp)[:, None] + np.arange(7)
        self._length = 4 if not frames else len(body)

    def message(self, time: float, poses: np.ndarray) -> bytes:
        """Returns the serialised TFMessage with ``poses`` [transform, 7] m, 1, all stamped ``time`` [s]."""
        poses = np.asarray(poses, float)
        if poses.shape != (len(self._poses), 7):
            raise ValueError(f"poses have shape {poses.shape}, expected {(len(self._poses), 7)}: one per frame")
        seconds, nanoseconds = split_time(time)
        self._words[self._stamps] = seconds
        self._words[self._stamps + 1] = nanoseconds
        self._doubles[self._poses] = poses
        return HEADER + self._bytes[8 : 8 + self._length].tobytes()


def split_time(time: float) -> tuple[int, int]:
    """Split a time [s] into seconds and nanoseconds, rounded to the nearest nanosecond."""
    return divmod(round(time * 1e9), 1_000_000_000)


def _append_string(body: bytearray, text: str) -> None:
    """Append a serialised string to a message body."""
    encoded = text.encode() + b"\0"
    _align(body, 4)
    body += struct.pack("<I", len(encoded)) + encoded


def _align(body: bytearray, size: int) -> None:
    """Pad a message body to a multiple of ``size`` bytes."""
    body += bytes(-len(body) % size)


# Messages of every step with fixed texts and changing numbers, which are written into the serialised message.
#
# An rclpy object with a few dozen numbers takes 0.03 to 0.12 ms to build, and as long to serialise. Writing its numbers
# into the bytes takes 0.01 ms. Their positions are found once, in a serialised message with unmistakable numbers.


_MARK_TIME = 1_589_640_193.708529245
"""[s] Unmistakable stamp by which the positions of stamps in a serialised message are found."""
_FIRST_MARK = 1.2345e200
"""First of the unmistakable numbers by which the positions of numbers in a serialised message are found. Further ones
are multiples of this number."""
_NONE = np.zeros(0)


class SerializedMessage:
    """A serialised message whose stamp and ``count`` doubles can be replaced.

    ``build(time, numbers)`` creates the message from a time [s] and numbers [count]. Every number must appear unchanged
    in the message, and everything else must always be the same. Raises ValueError if a number or the stamp is not
    found.
    """

    def __init__(self, build: Callable[[float, np.ndarray], Any], count: int) -> None:
        marks = _FIRST_MARK * np.arange(1.0, count + 1.0)
        data = serialize_message(build(_MARK_TIME, marks))
        self._length = len(data)
        # Numbers are aligned to their size, counted from the end of the four-byte header (OMG CDR, XCDR1). So the
        # header is padded to eight bytes here, and the length to a multiple of eight.
        self._bytes = np.frombuffer(bytes(4) + data + bytes(-(len(data) + 4) % 8), np.uint8).copy()
        self._words, self._doubles = self._bytes.view("<i4"), self._bytes.view("<f8")
        self._places, self._numbers = np.nonzero(self._doubles[:, None] == marks)
        stamp = np.frombuffer(struct.pack("<iI", *split_time(_MARK_TIME)), "<i4")
        self._stamps = np.flatnonzero((self._words[:-1] == stamp[0]) & (self._words[1:] == stamp[1]))
        if len(np.unique(self._numbers)) < count or not len(self._stamps):
            raise ValueError(f"{len(np.unique(self._numbers))} of {count} numbers and {len(self._stamps)} stamps found")
        self.count = count

    def message(self, time: float, numbers: np.ndarray) -> bytes:
        """Returns the serialised message with the stamp ``time`` [s] and ``numbers`` [count]."""
        if len(numbers) != self.count:
            raise ValueError(f"{len(numbers)} numbers, expected {self.count}")
        seconds, nanoseconds = split_time(time)
        self._words[self._stamps], self._words[self._stamps + 1] = seconds, nanoseconds
        self._doubles[self._places] = numbers[self._numbers]
        return self._bytes[4 : 4 + self._length].tobytes()


def stamp_writer(build: Callable[[float], Any]) -> Callable[[float], bytes]:
    """Returns a function that serialises a message in which only the stamp [s] changes."""
    template = SerializedMessage(lambda time, _: build(time), 0)
    return lambda time: template.message(time, _NONE)


def joint_state_writer(first: JointSample) -> Callable[[JointSample], bytes]:
    """Returns a function that serialises samples with the same joints as ``first`` to sensor_msgs/JointState."""
    count = len(first.names)

    def build(time: float, numbers: np.ndarray) -> Any:
        position, velocity, effort = numbers.reshape(3, count)
        return joint_state(dataclasses.replace(first, time=time, position=position, velocity=velocity, effort=effort))

    template = SerializedMessage(build, 3 * count)
    return lambda one: template.message(one.time, np.concatenate([one.position, one.velocity, one.effort]))


def odometry_writer(first: RobotSample, base: str, odom: str) -> Callable[[RobotSample], bytes]:
    """Returns a function that serialises samples of one robot to nav_msgs/Odometry, in the frame ``odom``."""

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
    """Returns a function that serialises readings of one IMU to sensor_msgs/Imu."""

    def build(time: float, n: np.ndarray) -> Any:
        return imu(
            dataclasses.replace(first, time=time, orientation=n[:4], angular_velocity=n[4:7], linear_acceleration=n[7:])
        )

    template = SerializedMessage(build, 10)
    return lambda one: template.message(
        one.time, np.concatenate([one.orientation, one.angular_velocity, one.linear_acceleration])
    )


def wrench_writer(first: Wrench) -> Callable[[Wrench], bytes]:
    """Returns a function that serialises readings of one force-torque sensor to geometry_msgs/WrenchStamped."""
    template = SerializedMessage(
        lambda time, n: wrench(dataclasses.replace(first, time=time, force=n[:3], torque=n[3:])), 6
    )
    return lambda one: template.message(one.time, np.concatenate([one.force, one.torque]))
