"""The topic of a GNSS receiver, heard by a node of its own."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vinesim.ros import middleware

if reason := middleware.unavailable_reason():
    pytest.skip(reason, allow_module_level=True)

from sensor_msgs.msg import NavSatFix, NavSatStatus

from tests.support.stock_node import StockNode, wait_until
from vinesim.ros.sensor_node import SensorNode
from vinesim.scene.values import CameraOutput, FixKind, GnssFix

pytestmark = pytest.mark.ros


def test_fixes_are_published_with_status_and_covariance():
    heard: list[NavSatFix] = []
    with SensorNode("s", sensors={"gnss": "gnss"}) as node, StockNode() as peer:
        assert node.outputs_wanted("gnss") == CameraOutput.NONE
        peer.node.create_subscription(NavSatFix, "gnss/fix", heard.append, 10)

        def hear(fix: GnssFix) -> NavSatFix:
            heard.clear()

            def tick() -> None:
                node.publish(fix)
                peer.spin(0.01)

            wait_until(lambda: heard and heard[-1].status.status == expected[fix.kind], tick, "a fix")
            return heard[-1]

        expected = {
            FixKind.FIXED: NavSatStatus.STATUS_GBAS_FIX,
            FixKind.SINGLE: NavSatStatus.STATUS_FIX,
            FixKind.NONE: NavSatStatus.STATUS_NO_FIX,
        }
        variance = np.array([1e-4, 1e-4, 4e-4])
        fixed = hear(GnssFix(1.5, "gnss", "antenna", FixKind.FIXED, 41.6, 12.65, 80.0, variance))
        assert node.outputs_wanted("gnss") == CameraOutput.RGB
        assert (fixed.header.frame_id, fixed.header.stamp.sec, fixed.header.stamp.nanosec) == (
            "antenna",
            1,
            500_000_000,
        )
        assert (fixed.latitude, fixed.longitude, fixed.altitude) == (41.6, 12.65, 80.0)
        assert fixed.position_covariance.tolist() == [1e-4, 0, 0, 0, 1e-4, 0, 0, 0, 4e-4]
        assert fixed.position_covariance_type == NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN
        hear(GnssFix(1.6, "gnss", "antenna", FixKind.SINGLE, 41.6, 12.65, 80.0, variance))
        lost = hear(GnssFix(1.7, "gnss", "antenna", FixKind.NONE, math.nan, math.nan, math.nan, np.zeros(3)))
        assert math.isnan(lost.latitude)
        assert lost.position_covariance_type == NavSatFix.COVARIANCE_TYPE_UNKNOWN
