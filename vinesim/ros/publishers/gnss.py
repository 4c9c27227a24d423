"""The topic of one GNSS receiver."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import ClassVar

import numpy as np
from sensor_msgs.msg import NavSatFix, NavSatStatus

from vinesim.ros.messages import convert
from vinesim.ros.parameters import Parameters
from vinesim.ros.topic import SENSOR_DATA, Advertise, PendingMessage
from vinesim.scene.values import CameraOutput, FixKind, GnssFix

_STATUS = {
    FixKind.NONE: NavSatStatus.STATUS_NO_FIX,
    FixKind.SINGLE: NavSatStatus.STATUS_FIX,
    FixKind.FLOAT: NavSatStatus.STATUS_GBAS_FIX,
    FixKind.FIXED: NavSatStatus.STATUS_GBAS_FIX,
}
"""Status of each kind of fix. Drivers of RTK receivers call corrections of a base station GBAS."""
_SERVICES = (
    NavSatStatus.SERVICE_GPS
    | NavSatStatus.SERVICE_GLONASS
    | NavSatStatus.SERVICE_COMPASS
    | NavSatStatus.SERVICE_GALILEO
)


class GnssPublisher:
    """Publishes ``<name>/fix``. Its parameter is ``<name>.exact_position``."""

    packages: ClassVar = ()
    truth: ClassVar = ()

    def __init__(
        self, advertise: Advertise, name: str, parameters: Parameters, *, number: int, channels: Sequence[str]
    ) -> None:
        self._parameters = parameters
        self._exact = f"{name}.exact_position"
        parameters.declare(self._exact, False, "Exact position without outages, instead of what the receiver measures.")
        self._fix = advertise(NavSatFix, f"{name}/fix", SENSOR_DATA)

    def wanted(self) -> CameraOutput:
        """Returns ``RGB`` for a position with errors, ``EXACT_DEPTH`` for an exact one, or ``NONE`` without
        subscribers."""
        if not self._fix.subscription_count:
            return CameraOutput.NONE
        return CameraOutput.EXACT_DEPTH if self._parameters[self._exact] else CameraOutput.RGB

    def pending(self, fix: GnssFix) -> Iterator[PendingMessage]:
        """Yield the message of one fix."""
        yield self._fix, partial(message, fix)


def message(fix: GnssFix) -> NavSatFix:
    """Returns a fix as a message: position, status, and the variances of east, north and up."""
    told = NavSatFix(header=convert.header(fix.time, fix.frame_id))
    told.status.status = _STATUS[fix.kind]
    told.status.service = _SERVICES
    told.latitude = fix.latitude
    told.longitude = fix.longitude
    told.altitude = fix.altitude
    if fix.kind is not FixKind.NONE:
        told.position_covariance = np.diag(fix.variance).ravel()
        told.position_covariance_type = NavSatFix.COVARIANCE_TYPE_DIAGONAL_KNOWN
    return told


PUBLISHER = GnssPublisher
