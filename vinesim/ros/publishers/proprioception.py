"""Topics of what a robot's body measures: inertial measurement units and force-torque sensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import Imu

from vinesim.ros.messages.serialized import imu_writer, wrench_writer
from vinesim.ros.topic import EVERY_STEP, Advertise, PendingMessage
from vinesim.scene.values import RobotSample


class ProprioceptionPublisher:
    """``<imu>`` and ``<sensor>/wrench`` after every step, of the sensors that are named."""

    def __init__(self, advertise: Advertise, imus: Sequence[str], wrenches: Sequence[str]) -> None:
        self._imus = {name: advertise(Imu, name, EVERY_STEP) for name in imus}
        self._wrenches = {name: advertise(WrenchStamped, f"{name}/wrench", EVERY_STEP) for name in wrenches}
        self._writers: dict[str, Callable[[Any], bytes]] = {}
        """By sensor, once it has been read."""

    def pending(self, sample: RobotSample) -> Iterator[PendingMessage]:
        """All messages of one step."""
        for imu in sample.imus:
            if imu.name in self._imus:
                yield self._imus[imu.name], partial(self._write, imu_writer, imu)
        for wrench in sample.wrenches:
            if wrench.name in self._wrenches:
                yield self._wrenches[wrench.name], partial(self._write, wrench_writer, wrench)

    def _write(self, writer: Callable[[Any], Callable[[Any], bytes]], reading: Any) -> bytes:
        if reading.name not in self._writers:
            self._writers[reading.name] = writer(reading)
        return self._writers[reading.name](reading)
