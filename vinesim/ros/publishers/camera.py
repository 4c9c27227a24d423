"""Topics of one RGB-D camera. Its frames are optical: z forward, x right, y down (REP-103)."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from functools import partial
from typing import ClassVar

from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from vinesim.ros.messages import convert
from vinesim.ros.parameters import Parameters
from vinesim.ros.topic import SENSOR_DATA, TRANSIENT_LOCAL, Advertise, PendingMessage, Topic
from vinesim.scene.values import CameraFrame, CameraOutput

RGB = CameraOutput.RGB
DEPTH = CameraOutput.DEPTH
LABELS = CameraOutput.LABELS


class CameraPublisher:
    """Publishes ``<name>/{rgb,depth}/{image_raw,camera_info}``, ``rgb/image_raw/compressed``,
    ``depth/image_raw/compressedDepth`` and ``depth/points``; and as ground truth ``labels``, ``label_info`` (latched),
    ``detections``, ``detections_3d`` and ``bunches``.

    Its parameters are ``<name>.exact_depth``, ``<name>.depth_encoding_16uc1`` and ``<name>.jpeg_quality``.
    """

    packages: ClassVar = ("vision_msgs",)

    def __init__(
        self, advertise: Advertise, name: str, parameters: Parameters, *, number: int, channels: Sequence[str]
    ) -> None:
        # vision_msgs can be imported only after the node has made it importable
        from vision_msgs.msg import Detection2DArray, Detection3DArray, LabelInfo

        from vinesim.ros.messages import bunches

        self._name = name
        self._parameters = parameters
        advertise(LabelInfo, f"{name}/label_info", TRANSIENT_LOCAL).send(bunches.label_info())
        declare = parameters.declare
        declare(f"{name}.exact_depth", False, "Exact depth instead of depth with the errors of the sensor.")
        declare(f"{name}.depth_encoding_16uc1", False, "Depth images in millimetres (16UC1) instead of metres (32FC1).")
        declare(f"{name}.jpeg_quality", 85, "JPEG quality of rgb/image_raw/compressed.", (1, 100))
        self._infos = [advertise(CameraInfo, f"{name}/{kind}/camera_info", SENSOR_DATA) for kind in ("rgb", "depth")]
        self._rgb = advertise(Image, f"{name}/rgb/image_raw", SENSOR_DATA)
        self._depth = advertise(Image, f"{name}/depth/image_raw", SENSOR_DATA)
        self._labels = advertise(Image, f"{name}/labels", SENSOR_DATA)
        self._jpeg = advertise(CompressedImage, f"{name}/rgb/image_raw/compressed", SENSOR_DATA)
        self._png = advertise(CompressedImage, f"{name}/depth/image_raw/compressedDepth", SENSOR_DATA)
        self._points = advertise(PointCloud2, f"{name}/depth/points", SENSOR_DATA)
        self._bunches = {
            advertise(Detection2DArray, f"{name}/detections", SENSOR_DATA): bunches.detections_2d,
            advertise(Detection3DArray, f"{name}/detections_3d", SENSOR_DATA): bunches.detections_3d,
            advertise(PointCloud2, f"{name}/bunches", SENSOR_DATA): bunches.bunch_cloud,
        }
        self._needs = {
            self._rgb: RGB,
            self._depth: DEPTH,
            self._labels: LABELS,
            self._jpeg: RGB,
            self._png: DEPTH,
            self._points: RGB | DEPTH,
            **dict.fromkeys(self._bunches, CameraOutput.BUNCHES),
        }

    @property
    def truth(self) -> tuple[Topic, ...]:
        """Topics with ground truth: labels and detections."""
        return self._labels, *self._bunches

    def wanted(self) -> CameraOutput:
        """Returns the camera outputs that the present subscribers need. If only camera_info has subscribers, this is
        the colour picture."""
        outputs = CameraOutput.NONE
        for topic, needs in self._needs.items():
            if topic.subscription_count:
                outputs |= needs
        if not outputs and any(topic.subscription_count for topic in self._infos):
            return RGB
        if DEPTH in outputs and self._parameters[f"{self._name}.exact_depth"]:
            outputs = outputs & ~DEPTH | CameraOutput.EXACT_DEPTH
        return outputs

    def pending(self, frame: CameraFrame) -> Iterator[PendingMessage]:
        """Yield all messages that can be made from the outputs in ``frame``, cheap ones first."""
        if self._parameters[f"{self._name}.exact_depth"] and CameraOutput.EXACT_DEPTH in frame.outputs:
            assert frame.exact_depth is not None
            frame = dataclasses.replace(frame, depth=frame.exact_depth)
        is_millimetres = self._parameters[f"{self._name}.depth_encoding_16uc1"]
        quality = self._parameters[f"{self._name}.jpeg_quality"]
        builds = {
            self._rgb: partial(convert.rgb_image, frame),
            self._depth: partial(convert.depth_image_millimetres if is_millimetres else convert.depth_image, frame),
            self._labels: partial(convert.label_image, frame),
            self._jpeg: partial(convert.compressed_image, frame, quality),
            self._png: partial(convert.compressed_depth, frame, is_millimetres=is_millimetres),
            self._points: partial(convert.depth_cloud, frame),
        } | {topic: partial(build, frame) for topic, build in self._bunches.items()}
        made = frame.outputs
        for topic in self._infos:
            yield topic, partial(convert.camera_info, frame.info, frame.time)
        for topic, needs in self._needs.items():
            if needs in made:
                yield topic, builds[topic]


PUBLISHER = CameraPublisher
