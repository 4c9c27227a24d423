"""Topics of one RGB-D camera. Frames are optical: z forward, x right, y down (REP-103)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from vinesim.ros.messages import convert
from vinesim.ros.topic import SENSOR_DATA, TRANSIENT_LOCAL, Advertise, PendingMessage
from vinesim.scene.values import CameraFrame, CameraOutput


class CameraPublisher:
    """``<name>/{rgb,depth}/{image_raw,camera_info}``, ``rgb/image_raw/compressed``, ``depth/points``; and the truth:
    ``labels``, ``label_info`` (latched), ``detections``, ``detections_3d``, ``bunches``."""

    def __init__(self, advertise: Advertise, name: str) -> None:
        # vision_msgs can be imported once the node has seen to it
        from vision_msgs.msg import Detection2DArray, Detection3DArray, LabelInfo

        from vinesim.ros.messages import bunches

        advertise(LabelInfo, f"{name}/label_info", TRANSIENT_LOCAL).send(bunches.label_info())
        self._infos = [advertise(CameraInfo, f"{name}/{kind}/camera_info", SENSOR_DATA) for kind in ("rgb", "depth")]
        rgb, depth, labels = CameraOutput.RGB, CameraOutput.DEPTH, CameraOutput.LABELS
        truth = CameraOutput.BUNCHES
        self._built = (
            (advertise(Image, f"{name}/rgb/image_raw", SENSOR_DATA), rgb, convert.rgb_image),
            (advertise(Image, f"{name}/depth/image_raw", SENSOR_DATA), depth, convert.depth_image),
            (advertise(Image, f"{name}/labels", SENSOR_DATA), labels, convert.label_image),
            (advertise(Detection2DArray, f"{name}/detections", SENSOR_DATA), truth, bunches.detections_2d),
            (advertise(Detection3DArray, f"{name}/detections_3d", SENSOR_DATA), truth, bunches.detections_3d),
            (advertise(PointCloud2, f"{name}/bunches", SENSOR_DATA), truth, bunches.bunch_cloud),
            (
                advertise(CompressedImage, f"{name}/rgb/image_raw/compressed", SENSOR_DATA), rgb,
                convert.compressed_image,
            ),
            (advertise(PointCloud2, f"{name}/depth/points", SENSOR_DATA), rgb | depth, convert.depth_cloud),
        )  # fmt: skip

    def wanted(self) -> CameraOutput:
        """The outputs that the present subscribers need; a picture if there are none but of camera_info."""
        outputs = CameraOutput.NONE
        for topic, needs, _ in self._built:
            if topic.subscription_count:
                outputs |= needs
        if not outputs and any(topic.subscription_count for topic in self._infos):
            return CameraOutput.RGB
        return outputs

    def pending(self, frame: CameraFrame) -> Iterator[PendingMessage]:
        """All messages that can be made of one picture, the cheap ones first."""
        made = frame.outputs
        for topic in self._infos:
            yield topic, partial(convert.camera_info, frame.info, frame.time)
        for topic, needs, build in self._built:
            if needs in made:
                yield topic, partial(build, frame)
