"""Topics of one multispectral camera. Its frames are optical: z forward, x right, y down (REP-103)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import ClassVar

import numpy as np
from sensor_msgs.msg import CameraInfo, Image

from vinesim.ros.messages import convert
from vinesim.ros.parameters import Parameters
from vinesim.ros.topic import SENSOR_DATA, Advertise, PendingMessage, Topic
from vinesim.scene.values import CameraOutput, MultispectralFrame

NDVI = "ndvi"


class MultispectralPublisher:
    """Publishes ``<name>/<band>/{image_raw,camera_info}``: reflectance (32FC1);
    ``<name>/ndvi/{image_raw,camera_info}``: NDVI (32FC1); and as ground truth ``<name>/labels``. ``channels``: names
    of the bands."""

    packages: ClassVar = ()

    def __init__(
        self, advertise: Advertise, name: str, _parameters: Parameters, *, number: int, channels: Sequence[str]
    ) -> None:
        images = (*channels, NDVI)
        self._infos = [advertise(CameraInfo, f"{name}/{one}/camera_info", SENSOR_DATA) for one in images]
        self._bands = {one: advertise(Image, f"{name}/{one}/image_raw", SENSOR_DATA) for one in channels}
        self._ndvi = advertise(Image, f"{name}/{NDVI}/image_raw", SENSOR_DATA)
        self._labels = advertise(Image, f"{name}/labels", SENSOR_DATA)

    @property
    def truth(self) -> tuple[Topic, ...]:
        """Topic with ground truth: labels."""
        return (self._labels,)

    def wanted(self) -> CameraOutput:
        """Returns ``RGB``, which stands for all bands, if any topic has subscribers. All bands are rendered at once."""
        topics = (*self._infos, *self._bands.values(), self._ndvi, self._labels)
        return CameraOutput.RGB if any(topic.subscription_count for topic in topics) else CameraOutput.NONE

    def pending(self, frame: MultispectralFrame) -> Iterator[PendingMessage]:
        """Yield all messages of one picture, cheap ones first."""
        for topic in self._infos:
            yield topic, partial(convert.camera_info, frame.info, frame.time)
        for name, topic in self._bands.items():
            yield topic, partial(convert.image, frame, frame.band(name), "32FC1", np.float32)
        yield self._labels, partial(convert.image, frame, frame.labels, "32SC1", np.int32)
        yield self._ndvi, lambda: convert.image(frame, frame.ndvi, "32FC1", np.float32)


PUBLISHER = MultispectralPublisher
