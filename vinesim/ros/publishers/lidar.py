"""Topics of one lidar."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from sensor_msgs.msg import LaserScan, PointCloud2

from vinesim.ros.messages import convert
from vinesim.ros.topic import SENSOR_DATA, Advertise, PendingMessage
from vinesim.scene.values import LidarScan


class LidarPublisher:
    """``<name>/points``: x y z intensity ring time; return_type too if the lidar reports two returns of a shot. And
    ``scan_topic``: its laser nearest to the horizontal."""

    def __init__(self, advertise: Advertise, name: str, scan_topic: str) -> None:
        self._points = advertise(PointCloud2, f"{name}/points", SENSOR_DATA)
        self._scan = advertise(LaserScan, scan_topic, SENSOR_DATA)

    def wanted(self) -> bool:
        """Whether there are subscribers."""
        return bool(self._points.subscription_count or self._scan.subscription_count)

    def pending(self, scan: LidarScan) -> Iterator[PendingMessage]:
        """The messages of one revolution."""
        yield self._points, partial(convert.lidar_cloud, scan)
        if scan.level is not None:
            yield self._scan, partial(convert.laser_scan, scan)
