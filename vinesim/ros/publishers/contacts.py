"""Topics of contacts between a robot and plants: a point cloud for programs, and markers for RViz (arrows, area of
interest)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from geometry_msgs.msg import Point, Pose, Vector3
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from vinesim.ros.messages import convert
from vinesim.ros.messages.convert import stamp_writer
from vinesim.ros.publishers.robot import MAP_FRAME
from vinesim.ros.topic import EVERY_STEP, RELIABLE, Advertise, PendingMessage
from vinesim.scene.values import Contact, RobotSample

MARKER_PERIOD = 10
"""Number of steps between two arrays of markers: 10 Hz."""
ARROW_SCALE = 0.01
"""[m/N] Length of an arrow per newton of contact force."""
CIRCLE_CORNERS = 64
"""Number of corners of the polygon that shows the edge of the area of interest."""


class ContactPublisher:
    """Publishes ``vine/contacts`` after every step, also without contacts, and ``vine/markers`` at 10 Hz."""

    def __init__(
        self,
        advertise: Advertise,
        bunch_of_body: np.ndarray,
        links: dict[str, int] | None = None,
        interest_radius: float | None = None,
    ) -> None:
        """``bunch_of_body`` [body]: index of the bunch that each plant body belongs to, -1 for wood. ``links``:
        indices of the robot's links, by name. ``interest_radius`` [m]: radius of the area of interest around the
        robot; None if there is none, since no other client is in the world."""
        self._contacts = advertise(PointCloud2, "vine/contacts", EVERY_STEP)
        self._markers = advertise(MarkerArray, "vine/markers", RELIABLE)
        self._bunch_of_body = bunch_of_body
        self._links = links or {}
        self._edge = None if interest_radius is None else _circle(interest_radius)
        self._steps = 0
        self._write_none: Callable[[float], bytes] | None = None

    def mute(self, is_muted: bool) -> None:
        """Stop sending if ``is_muted``, otherwise resume."""
        for topic in (self._contacts, self._markers):
            topic.mute(is_muted)

    def pending(self, sample: RobotSample) -> Iterator[PendingMessage]:
        """Yield the messages of one step."""
        yield self._contacts, partial(self._cloud, sample)
        self._steps += 1
        if self._steps % MARKER_PERIOD == 0:
            yield self._markers, partial(self._all_markers, sample)

    def _all_markers(self, sample: RobotSample) -> MarkerArray:
        """Returns arrows and the area of interest. The first marker deletes those of the previous message."""
        markers = _arrows(sample)
        if self._edge is not None:
            markers.append(_interest(self._edge, sample))
        return MarkerArray(markers=markers)

    def _cloud(self, sample: RobotSample) -> PointCloud2 | bytes:
        """Returns the contacts as a cloud. A cloud without contacts is serialised, with only its stamp replaced in
        each step."""
        if not sample.contacts:
            if self._write_none is None:
                self._write_none = stamp_writer(partial(self._no_contacts, sample))
            return self._write_none(sample.joints.time)
        return convert.contact_cloud(sample, self._links, self._bunch_of_body, MAP_FRAME)

    def _no_contacts(self, sample: RobotSample, time: float) -> PointCloud2:
        at_time = dataclasses.replace(sample, joints=dataclasses.replace(sample.joints, time=time))
        return convert.contact_cloud(at_time, self._links, self._bunch_of_body, MAP_FRAME)


def _arrows(sample: RobotSample) -> list[Marker]:
    """Returns one arrow for each contact, along the force on the robot, after a marker that deletes the previous
    arrows."""
    markers = [Marker(header=convert.header(sample.joints.time, MAP_FRAME), ns="contacts", action=Marker.DELETEALL)]
    return markers + [_arrow(i, contact, sample.joints.time) for i, contact in enumerate(sample.contacts)]


def _arrow(number: int, contact: Contact, time: float) -> Marker:
    start = np.asarray(contact.position, float)
    end = start + ARROW_SCALE * np.asarray(contact.force, float)
    points = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in (start, end)]
    return Marker(
        header=convert.header(time, MAP_FRAME),
        ns="contacts",
        id=number,
        type=Marker.ARROW,
        action=Marker.ADD,
        points=points,
        scale=Vector3(x=0.01, y=0.02, z=0.0),
        color=ColorRGBA(r=1.0, g=0.3, b=0.0, a=1.0),
    )


def _circle(radius: float) -> list[Point]:
    """Returns the corners [:data:`CIRCLE_CORNERS` + 1] of a circle of ``radius`` [m] about the origin, in the ground
    plane."""
    angles = np.linspace(0.0, 2.0 * np.pi, CIRCLE_CORNERS + 1)
    return [Point(x=float(radius * np.cos(angle)), y=float(radius * np.sin(angle))) for angle in angles]


def _interest(edge: list[Point], sample: RobotSample) -> Marker:
    """Returns the edge of the area of interest as a marker, centred at the robot's base."""
    x, y, z = map(float, sample.base_q[:3])
    return Marker(
        header=convert.header(sample.joints.time, MAP_FRAME),
        ns="interest",
        type=Marker.LINE_STRIP,
        action=Marker.ADD,
        pose=Pose(position=Point(x=x, y=y, z=z)),
        points=edge,
        scale=Vector3(x=0.03),
        color=ColorRGBA(r=0.24, g=0.55, b=1.0, a=1.0),
    )
