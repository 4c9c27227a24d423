"""Topics of one RGB-D camera. Frames are optical: z forward, x right, y down (REP-103)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from vinesim.ros.messages import convert
from vinesim.ros.topic import SENSOR_DATA, Advertise, PendingMessage
from vinesim.scene.values import CameraFrame


class CameraPublisher:
    """``<name>/{rgb,depth}/{image_raw,camera_info}``, ``rgb/image_raw/compressed``, ``depth/points``, ``labels``."""

    def __init__(self, advertise: Advertise, name: str) -> None:
        self._infos = [advertise(CameraInfo, f"{name}/{kind}/camera_info", SENSOR_DATA) for kind in ("rgb", "depth")]
        self._built = (
            (advertise(Image, f"{name}/rgb/image_raw", SENSOR_DATA), convert.rgb_image),
            (advertise(Image, f"{name}/depth/image_raw", SENSOR_DATA), convert.depth_image),
            (advertise(Image, f"{name}/labels", SENSOR_DATA), convert.label_image),
            (advertise(CompressedImage, f"{name}/rgb/image_raw/compressed", SENSOR_DATA), convert.compressed_image),
            (advertise(PointCloud2, f"{name}/depth/points", SENSOR_DATA), convert.depth_cloud),
        )

    def pending(self, frame: CameraFrame) -> Iterator[PendingMessage]:
        """All messages of one picture, the cheap ones first."""
        for topic in self._infos:
            yield topic, partial(convert.camera_info, frame.info, frame.time)
        for topic, build in self._built:
            yield topic, partial(build, frame)
