"""Topics of what a robot's body measures: inertial measurement units and force-torque sensors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import Imu

from vinesim.ros.messages import convert
from vinesim.ros.topic import SENSOR_DATA, Advertise, PendingMessage
from vinesim.scene.values import RobotSample


class ProprioceptionPublisher:
    """``<imu>`` and ``<sensor>/wrench`` after every step, of the sensors that are named."""

    def __init__(self, advertise: Advertise, imus: Sequence[str], wrenches: Sequence[str]) -> None:
        self._imus = {name: advertise(Imu, name, SENSOR_DATA) for name in imus}
        self._wrenches = {name: advertise(WrenchStamped, f"{name}/wrench", SENSOR_DATA) for name in wrenches}

    def pending(self, sample: RobotSample) -> Iterator[PendingMessage]:
        """All messages of one step."""
        for imu in sample.imus:
            if imu.name in self._imus:
                yield self._imus[imu.name], partial(convert.imu, imu)
        for wrench in sample.wrenches:
            if wrench.name in self._wrenches:
                yield self._wrenches[wrench.name], partial(convert.wrench, wrench)
