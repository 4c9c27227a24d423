"""Conversion of values to ROS messages and back: pure functions.

Arrays go into a message through ``array.array``, which rosidl takes as it is (0.03 ms for a 0.9 MB picture; a list of
numbers takes a thousand times as long). Stamps are the simulation time of the sample (REP-117/118 for what has no
return, REP-103 for frames).
"""

from __future__ import annotations

import array
import functools
import json
import sys
from collections.abc import Iterable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TwistStamped, WrenchStamped
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo as CameraInfoMessage
from sensor_msgs.msg import CompressedImage, Image, JointState, PointCloud2, PointField
from std_msgs.msg import Float64MultiArray, Header, String
from trajectory_msgs.msg import JointTrajectory as JointTrajectoryMessage

from vinesim import frames
from vinesim.ros.commands.types import BaseVelocity, JointPositions, JointTrajectory
from vinesim.ros.messages.transforms import split_time
from vinesim.scene.camera_geometry import (
    DISTORTION,
    DISTORTION_MODEL,
    POINT_DTYPE,
    depth_millimetres,
    intrinsic_matrix,
    write_points,
)
from vinesim.scene.ids import LABEL_STRIDE, Organ
from vinesim.scene.values import CameraFrame, CameraInfo, ComponentStatus, Contact, JointSample, LidarScan, RobotSample

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

_FIELD_TYPES = {"f4": PointField.FLOAT32, "u1": PointField.UINT8, "u2": PointField.UINT16, "u4": PointField.FLOAT32}


class CommandError(ValueError):
    """A command message contradicts itself; the text says how."""


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


def odometry(sample: RobotSample, base: str) -> Odometry:
    """Odometry of the base: pose in ``odom``, velocity in its own axes."""
    message = Odometry(header=header(sample.joints.time, "odom"), child_frame_id=base)
    pose = message.pose.pose
    _set_vector(pose.position, sample.odom_q[:3])
    _set_quaternion(pose.orientation, sample.odom_q[3:])
    into_base = frames.conjugate(np.asarray(sample.base_q, float)[3:])
    _set_vector(message.twist.twist.linear, frames.rotate(into_base, sample.base_qd[:3]))
    _set_vector(message.twist.twist.angular, frames.rotate(into_base, sample.base_qd[3:]))
    return message


def wrench(contact: Contact, time: float, frame: str, frame_q: np.ndarray) -> WrenchStamped:
    """One contact as the wrench that it exerts on the robot: axes and moment origin of ``frame``, at ``frame_q``."""
    frame_q = np.asarray(frame_q, float)
    into_frame = frames.conjugate(frame_q[3:])
    force = frames.rotate(into_frame, np.asarray(contact.force, float))
    arm = frames.rotate(into_frame, np.asarray(contact.position, float) - frame_q[:3])
    message = WrenchStamped(header=header(time, frame))
    _set_vector(message.wrench.force, force)
    _set_vector(message.wrench.torque, np.cross(arm, force))
    return message


def rgb_image(frame: CameraFrame) -> Image:
    """The picture, rgb8."""
    return _image(frame, frame.rgb, "rgb8", np.uint8)


def depth_image(frame: CameraFrame) -> Image:
    """Depth along z [m], 32FC1; NaN no return, -Inf too near, +Inf too far (REP-118)."""
    return _image(frame, frame.depth, "32FC1", np.float32)


def depth_image_millimetres(frame: CameraFrame) -> Image:
    """Depth along z [mm], 16UC1; 0 where there is none or it is beyond 65.535 m (REP-118)."""
    return _image(frame, depth_millimetres(frame.depth), "16UC1", np.uint16)


def label_image(frame: CameraFrame) -> Image:
    """Label of every pixel (:func:`vinesim.scene.ids.label`), 32SC1."""
    return _image(frame, frame.labels, "32SC1", np.int32)


def label_map() -> String:
    """The meaning of labels as JSON: ``label // stride`` is an organ, ``label % stride`` which one of them."""
    organs = {str(int(organ)): organ.name.lower() for organ in Organ}
    return String(data=json.dumps({"stride": LABEL_STRIDE, "organs": organs}))


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
    """Intrinsics: plumb_bob without distortion, rectification is the identity."""
    message = CameraInfoMessage(header=header(time, info.frame_id), width=info.width, height=info.height)
    message.distortion_model = DISTORTION_MODEL
    message.d = array.array("d", DISTORTION)
    message.k = intrinsic_matrix(info)
    message.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    message.p = [info.fx, 0.0, info.cx, 0.0, 0.0, info.fy, info.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return message


def depth_cloud(frame: CameraFrame) -> PointCloud2:
    """Depth and colour as an organised cloud in the optical frame; NaN where there is no depth."""
    message, points = _cloud(frame.time, frame.info.frame_id, POINT_DTYPE, frame.info.height, frame.info.width)
    write_points(frame, points)
    message.is_dense = False
    return message


def lidar_cloud(scan: LidarScan) -> PointCloud2:
    """One revolution: x y z intensity ring time (and return_type), unorganised, every point valid.

    Raw, as drivers publish it: each point in the frame that the lidar had at that point's time.
    """
    point = LIDAR_POINT if scan.returned is None else DUAL_LIDAR_POINT
    message, points = _cloud(scan.time, scan.frame_id, point, 1, len(scan.xyz))
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


_LEVELS = {"ok": DiagnosticStatus.OK, "warning": DiagnosticStatus.WARN, "error": DiagnosticStatus.ERROR}


def diagnostics(time: float, prefix: str, components: Iterable[ComponentStatus]) -> DiagnosticArray:
    """States of the components of a client; their names get the ``prefix``."""
    statuses = []
    for one in components:
        values = [KeyValue(key=key, value=str(value)) for key, value in one.values.items()]
        statuses.append(
            DiagnosticStatus(name=f"{prefix}: {one.name}", level=_LEVELS[one.level], message=one.message, values=values)
        )
    return DiagnosticArray(header=header(time, ""), status=statuses)


def base_velocity(message: TwistStamped) -> BaseVelocity:
    """A commanded velocity of the base; :class:`CommandError` if it is not finite."""
    linear, angular = message.twist.linear, message.twist.angular
    velocity = np.array([linear.x, linear.y, linear.z, angular.x, angular.y, angular.z])
    if not np.isfinite(velocity).all():
        raise CommandError(f"cmd_vel is not finite: {velocity.tolist()}")
    return BaseVelocity(seconds(message.header.stamp), velocity[:3], velocity[3:])


def joint_positions(message: Float64MultiArray, controller: str) -> JointPositions:
    """Commanded positions of a forward controller; :class:`CommandError` if they are not finite."""
    positions = np.array(message.data, float)
    if not np.isfinite(positions).all():
        raise CommandError(f"{controller}: commanded positions are not finite: {positions.tolist()}")
    return JointPositions(controller, positions)


def joint_trajectory(message: JointTrajectoryMessage, controller: str) -> JointTrajectory:
    """A trajectory; :class:`CommandError` if its points do not fit its joints or its times do not rise."""
    joints = tuple(message.joint_names)
    for i, point in enumerate(message.points):
        if len(point.positions) != len(joints) or len(point.velocities) not in (0, len(joints)):
            raise CommandError(
                f"{controller}: point {i} has {len(point.positions)} positions and {len(point.velocities)} velocities "
                f"for {len(joints)} joints; give one of each per joint, or no velocities"
            )
    start = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points]
    times = np.array(start, float)
    if (np.diff(times) <= 0.0).any():
        raise CommandError(f"{controller}: time_from_start does not rise: {start}")
    positions = np.array([p.positions for p in message.points], float).reshape(len(times), len(joints))
    with_velocity = len(times) > 0 and all(len(p.velocities) for p in message.points) and len(joints) > 0
    velocities = np.array([p.velocities for p in message.points], float) if with_velocity else None
    if not np.isfinite(positions).all() or (velocities is not None and not np.isfinite(velocities).all()):
        raise CommandError(f"{controller}: the trajectory is not finite")
    return JointTrajectory(controller, seconds(message.header.stamp), joints, times, positions, velocities)


def _image(frame: CameraFrame, pixels: np.ndarray, encoding: str, dtype: type) -> Image:
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


def _cloud(time: float, frame: str, point: np.dtype, height: int, width: int) -> tuple[PointCloud2, np.ndarray]:
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


def _set_vector(target: Any, values: np.ndarray) -> None:
    target.x, target.y, target.z = map(float, values)


def _set_quaternion(target: Any, values: np.ndarray) -> None:
    target.x, target.y, target.z, target.w = map(float, values)
