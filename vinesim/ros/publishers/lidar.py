"""Topics of one lidar."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import ClassVar

from sensor_msgs.msg import LaserScan, PointCloud2

from vinesim.ros.messages import convert
from vinesim.ros.parameters import Parameters
from vinesim.ros.topic import SENSOR_DATA, Advertise, PendingMessage
from vinesim.scene.values import CameraOutput, LidarScan


class LidarPublisher:
    """Publishes ``<name>/points`` with the fields x, y, z, intensity, ring and time (and return_type, if the lidar
    reports two returns per shot). The first lidar also publishes ``scan``, another one ``<name>/scan``: the laser
    nearest to the horizontal, as Nav2 expects it.

    Its parameter is ``<name>.exact_ranges``.
    """

    packages: ClassVar = ()
    truth: ClassVar = ()

    def __init__(
        self, advertise: Advertise, name: str, parameters: Parameters, *, number: int, channels: Sequence[str]
    ) -> None:
        self._parameters = parameters
        self._exact = f"{name}.exact_ranges"
        parameters.declare(
            self._exact, False, "Exact range along the middle of each beam, instead of what the sensor measures."
        )
        self._points = advertise(PointCloud2, f"{name}/points", SENSOR_DATA)
        self._scan = advertise(LaserScan, f"{name}/scan" if number else "scan", SENSOR_DATA)

    def wanted(self) -> CameraOutput:
        """Returns whether ranges with the errors of the lidar or exact ranges are needed, or ``NONE`` without
        subscribers."""
        if not (self._points.subscription_count or self._scan.subscription_count):
            return CameraOutput.NONE
        return CameraOutput.EXACT_DEPTH if self._parameters[self._exact] else CameraOutput.DEPTH

    def pending(self, scan: LidarScan) -> Iterator[PendingMessage]:
        """Yield the messages of one revolution."""
        yield self._points, partial(convert.lidar_cloud, scan)
        if scan.level is not None:
            yield self._scan, partial(convert.laser_scan, scan)


PUBLISHER = LidarPublisher
