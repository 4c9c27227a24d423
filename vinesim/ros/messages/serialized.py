"""Messages of every step with fixed texts and changing numbers, patched into their serialised bytes.

An rclpy object of a few dozen numbers takes 0.03 to 0.12 ms to build and as long to convert when it is sent; writing
its numbers into the bytes takes 0.01 ms. Where they stand is found once, in a message whose numbers are marks.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from rclpy.serialization import serialize_message

from vinesim.ros.messages import convert
from vinesim.ros.messages.transforms import split_time
from vinesim.scene.values import Imu, JointSample, RobotSample, Wrench

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
        return convert.joint_state(
            dataclasses.replace(first, time=time, position=position, velocity=velocity, effort=effort)
        )

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
        return convert.odometry(sample, base, odom)

    template = SerializedMessage(build, 31)
    return lambda one: template.message(
        one.joints.time, np.concatenate([one.odom_q, one.odom_qd, np.ravel(one.odom_covariance)])
    )


def imu_writer(first: Imu) -> Callable[[Imu], bytes]:
    """Writes sensor_msgs/Imu of readings of one sensor."""

    def build(time: float, n: np.ndarray) -> Any:
        return convert.imu(
            dataclasses.replace(first, time=time, orientation=n[:4], angular_velocity=n[4:7], linear_acceleration=n[7:])
        )

    template = SerializedMessage(build, 10)
    return lambda one: template.message(
        one.time, np.concatenate([one.orientation, one.angular_velocity, one.linear_acceleration])
    )


def wrench_writer(first: Wrench) -> Callable[[Wrench], bytes]:
    """Writes geometry_msgs/WrenchStamped of readings of one sensor."""
    template = SerializedMessage(
        lambda time, n: convert.wrench(dataclasses.replace(first, time=time, force=n[:3], torque=n[3:])), 6
    )
    return lambda one: template.message(one.time, np.concatenate([one.force, one.torque]))
