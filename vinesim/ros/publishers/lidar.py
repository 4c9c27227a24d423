"""Topics of one lidar."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from sensor_msgs.msg import PointCloud2

from vinesim.ros.messages import convert
from vinesim.ros.topic import SENSOR_DATA, Advertise, PendingMessage
from vinesim.scene.values import LidarScan


class LidarPublisher:
    """``<name>/points``: x y z intensity ring time; return_type too if the lidar reports two returns of a shot."""

    def __init__(self, advertise: Advertise, name: str) -> None:
        self._points = advertise(PointCloud2, f"{name}/points", SENSOR_DATA)

    def pending(self, scan: LidarScan) -> Iterator[PendingMessage]:
        """The message of one revolution."""
        yield self._points, partial(convert.lidar_cloud, scan)
