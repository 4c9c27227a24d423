"""A robot's indicator lights as markers. RViz and Foxglove draw them over the lamps of the robot's model."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from xml.etree import ElementTree

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from vinesim.core import frames
from vinesim.ros.topic import TRANSIENT_LOCAL, Advertise, PendingMessage
from vinesim.scene.values.signals import UNLIT, Color

GROWTH = 1.05
"""Size of a marker relative to the lamp that it covers."""
UNLIT_GREY = 0.15
"""Grey value of lamps between two flashes, 0 to 1."""


class LightsPublisher:
    """Publishes the latched topic ``indicator_lights/markers`` when the colour of the lamps changes. While the
    lights are off, there are no markers."""

    def __init__(self, advertise: Advertise, urdf: str) -> None:
        self._topic = advertise(MarkerArray, "indicator_lights/markers", TRANSIENT_LOCAL)
        self._lamps = lamp_markers(urdf)

    def pending(self, color: Color | None) -> Iterator[PendingMessage]:
        """Yield the message for a colour. :data:`UNLIT`: between flashes. None: the lights are off, so the lamps
        look as in the robot's model."""
        yield self._topic, partial(self._markers, color)

    def _markers(self, color: Color | None) -> MarkerArray:
        if color is None:
            return MarkerArray(markers=[Marker(ns="indicator_lights", action=Marker.DELETEALL)])
        red, green, blue = (UNLIT_GREY,) * 3 if color == UNLIT else (part / 255.0 for part in color)
        for lamp in self._lamps:
            lamp.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
        return MarkerArray(markers=self._lamps)


def lamp_markers(urdf: str) -> list[Marker]:
    """Returns a marker for each visual of a URDF whose material name has the word ``indicator``. Meshes are left out.

    Each marker is locked to the frame of its link. Its stamp is 0, so viewers use the link's latest pose.
    """
    markers = []
    for link in ElementTree.fromstring(urdf).iterfind("link"):
        for visual in link.iterfind("visual"):
            material = visual.find("material")
            geometry = visual.find("geometry")
            words = "" if material is None else material.get("name", "")
            form = None if geometry is None else next(iter(geometry), None)
            if "indicator" not in words.lower().split("_") or form is None or form.tag not in _FORMS:
                continue
            kind = _FORMS[form.tag]
            size = _size(form)
            markers.append(
                Marker(
                    ns="indicator_lights",
                    id=len(markers),
                    type=kind,
                    action=Marker.ADD,
                    frame_locked=True,
                    pose=_pose(visual.find("origin")),
                    scale=Vector3(**dict(zip("xyz", GROWTH * size, strict=True))),
                )
            )
            markers[-1].header.frame_id = link.get("name", "")
    return markers


_FORMS = {"box": Marker.CUBE, "cylinder": Marker.CYLINDER, "sphere": Marker.SPHERE}


def _size(form: ElementTree.Element) -> np.ndarray:
    """Returns the edges [3] m of the bounding box of a box, cylinder or sphere."""
    if form.tag == "box":
        return _numbers(form.get("size", "0 0 0"))
    across = 2.0 * float(form.get("radius", "0"))
    return np.array([across, across, float(form.get("length", "0")) if form.tag == "cylinder" else across])


def _pose(origin: ElementTree.Element | None) -> Pose:
    """Returns the pose of a visual in its link's frame."""
    place, turns = (
        _numbers("0 0 0" if origin is None else origin.get(name, "0 0 0")).tolist() for name in ("xyz", "rpy")
    )
    turn = frames.IDENTITY
    for angle, axis in zip(reversed(turns), np.eye(3)[::-1], strict=True):  # about z, then y, then x
        turn = frames.multiply(turn, frames.exp(angle * axis))
    x, y, z, w = (float(part) for part in turn)
    return Pose(position=Point(x=place[0], y=place[1], z=place[2]), orientation=Quaternion(x=x, y=y, z=z, w=w))


def _numbers(text: str) -> np.ndarray:
    return np.array([float(word) for word in text.split()])
