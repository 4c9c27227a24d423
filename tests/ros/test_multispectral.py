"""Topics of a multispectral camera, heard by a node of their own."""

from __future__ import annotations

import numpy as np
import pytest

from vinesim.ros import middleware

if reason := middleware.unavailable_reason():
    pytest.skip(reason, allow_module_level=True)

from sensor_msgs.msg import CameraInfo as CameraInfoMessage
from sensor_msgs.msg import Image

from tests.support.stock_node import StockNode, wait_until
from vinesim.core import frames
from vinesim.ros.sensor_node import SensorNode
from vinesim.scene.values import Band, CameraInfo, CameraOutput, MultispectralFrame

pytestmark = pytest.mark.ros

BANDS = tuple(Band(name, centre, 20.0, 1.0) for name, centre in (("red", 668.0), ("nir", 842.0)))
INFO = CameraInfo(4, 3, 8.0, 8.0, 1.5, 1.0, "optical")


def frame() -> MultispectralFrame:
    reflectance = np.stack([np.full((3, 4), 0.1, np.float32), np.full((3, 4), 0.3, np.float32)])
    pose = frames.pose([0.0, 0.0, 1.0])
    return MultispectralFrame(1.5, "bands", INFO, pose, BANDS, reflectance, np.ones((3, 4), np.int32))


def test_each_band_and_the_ndvi_are_published_where_somebody_listens():
    images: dict[str, Image] = {}
    infos: list[CameraInfoMessage] = []
    with (
        SensorNode("s", sensors={"bands": "multispectral"}, channels={"bands": ("red", "nir")}) as node,
        StockNode() as peer,
    ):
        assert node.outputs_wanted("bands") == CameraOutput.NONE
        for name in ("red", "nir", "ndvi"):
            topic = f"bands/{name}/image_raw"
            peer.node.create_subscription(Image, topic, lambda m, name=name: images.update({name: m}), 10)
        peer.node.create_subscription(CameraInfoMessage, "bands/nir/camera_info", infos.append, 10)

        def tick() -> None:
            node.publish(frame())
            peer.spin(0.01)

        wait_until(lambda: len(images) == 3 and infos, tick, "three images and an info")
        assert node.outputs_wanted("bands") == CameraOutput.RGB
        for name, value in (("red", 0.1), ("nir", 0.3), ("ndvi", 0.5)):
            message = images[name]
            assert (message.encoding, message.width, message.height) == ("32FC1", 4, 3)
            assert message.header.frame_id == "optical"
            np.testing.assert_allclose(np.frombuffer(message.data, np.float32), value, rtol=1e-6)
        assert infos[0].k[0] == 8.0
        assert "bands/labels" in node.sent
