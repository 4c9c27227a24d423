"""Writes the URDF of a robot whose links, joints and shapes are given in one common frame.

Formats other than URDF place the frame of a link anywhere; in a URDF its origin is on the axis of its joint. So each
link's frame is moved to the anchor of its joint, with its axes unchanged.
"""

from __future__ import annotations

import dataclasses
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

import numpy as np

from vinesim.core import frames


@dataclasses.dataclass(frozen=True, slots=True)
class Solid:
    """A visible or colliding shape."""

    kind: str
    """``box`` (size: edges), ``sphere`` (radius), ``cylinder`` (radius, length along z) or ``mesh`` (scale)."""
    size: tuple[float, ...]
    pose: np.ndarray
    """[7] pose in the common frame."""
    is_visible: bool
    collides: bool
    rgba: tuple[float, ...] | None = None
    """Colour (sRGB) and opacity, 0 to 1; None: that of the mesh file, or grey."""
    file: str = ""
    """Name of the mesh file."""
    material: str = ""


@dataclasses.dataclass(slots=True)
class Part:
    """A link, with the joint that connects it to its parent."""

    name: str
    pose: np.ndarray
    """[7] pose of the link's frame in the common frame, with all joints at their zero."""
    parent: str | None = None
    """Name of the parent link; None for the root."""
    joint: str = ""
    kind: str = "fixed"
    """Type of the joint in URDF."""
    anchor: np.ndarray | None = None
    """[3] point on the joint's axis, in the common frame; None: the origin of the link."""
    axis: np.ndarray | None = None
    """[3] axis of the joint, in the common frame."""
    limit: dict[str, float] = dataclasses.field(default_factory=dict)
    """Attributes of the ``<limit>``."""
    mimic: tuple[str, float, float] | None = None
    """Joint that this joint mimics, multiplier and offset."""
    mass: float = 0.0
    centre: np.ndarray | None = None
    """[7] pose of the centre of mass, in the common frame, with the axes of ``inertia``."""
    inertia: np.ndarray | None = None
    """[3, 3] inertia about the centre of mass [kg m2]."""
    solids: list[Solid] = dataclasses.field(default_factory=list)


def write_urdf(name: str, parts: Sequence[Part], extras: Sequence[ElementTree.Element] = ()) -> str:
    """Returns the text of a URDF with the links and joints of ``parts``. ``extras``: further elements of the robot."""
    root = ElementTree.Element("robot", name=name)
    place = {part.name: link_frame(part) for part in parts}
    for part in parts:
        into = frames.inverse(place[part.name])
        link = ElementTree.SubElement(root, "link", name=part.name)
        if part.mass > 0.0 and part.centre is not None:
            inertial = ElementTree.SubElement(link, "inertial")
            _add_origin(inertial, frames.compose(into, part.centre))
            ElementTree.SubElement(inertial, "mass", value=f"{part.mass:.9g}")
            inertia = np.zeros((3, 3)) if part.inertia is None else part.inertia
            keys = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
            ElementTree.SubElement(inertial, "inertia", {key: f"{inertia[at]:.9g}" for key, at in keys.items()})
        for solid in part.solids:
            for tag, wanted in (("visual", solid.is_visible), ("collision", solid.collides)):
                if wanted:
                    _add_solid(ElementTree.SubElement(link, tag), solid, into)
        if part.parent is not None:
            _add_joint(root, part, frames.compose(frames.inverse(place[part.parent]), place[part.name]))
    root.extend(extras)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def link_frame(part: Part) -> np.ndarray:
    """Returns the frame [7] of a link in its URDF, in the common frame."""
    if part.anchor is None or part.parent is None:
        return part.pose
    return frames.pose(part.anchor, part.pose[3:])


def roll_pitch_yaw(quaternion: np.ndarray) -> tuple[float, float, float]:
    """Returns the angles [rad] of a rotation about fixed x, then y, then z."""
    turn = frames.to_matrix(quaternion)
    level = math.hypot(turn[0, 0], turn[1, 0])
    if level < 1e-9:  # looking straight up or down: roll and yaw turn about one axis
        return math.atan2(-turn[1, 2], turn[1, 1]), math.atan2(-turn[2, 0], level), 0.0
    return (
        math.atan2(turn[2, 1], turn[2, 2]),
        math.atan2(-turn[2, 0], level),
        math.atan2(turn[1, 0], turn[0, 0]),
    )


def capsule(radius: float, length: float, pose: np.ndarray, **common: object) -> list[Solid]:
    """Returns a capsule of ``length`` [m] without its ends, as a cylinder and two spheres, since many programs read no
    capsules in a URDF."""
    ends = [frames.compose(pose, frames.pose([0.0, 0.0, side * 0.5 * length])) for side in (-1.0, 1.0)]
    return [
        Solid("cylinder", (radius, length), pose, **common),  # pyright: ignore[reportArgumentType]
        *(Solid("sphere", (radius,), end, **common) for end in ends),  # pyright: ignore[reportArgumentType]
    ]


def _add_solid(element: ElementTree.Element, solid: Solid, into: np.ndarray) -> None:
    _add_origin(element, frames.compose(into, solid.pose))
    geometry = ElementTree.SubElement(element, "geometry")
    if solid.kind == "box":
        ElementTree.SubElement(geometry, "box", size=_text(solid.size))
    elif solid.kind == "sphere":
        ElementTree.SubElement(geometry, "sphere", radius=_text(solid.size[:1]))
    elif solid.kind == "cylinder":
        ElementTree.SubElement(geometry, "cylinder", radius=_text(solid.size[:1]), length=_text(solid.size[1:2]))
    else:
        ElementTree.SubElement(geometry, "mesh", filename=solid.file, scale=_text(solid.size))
    if element.tag == "visual" and solid.rgba is not None:
        material = ElementTree.SubElement(element, "material", name=solid.material)
        ElementTree.SubElement(material, "color", rgba=_text(solid.rgba))


def _add_joint(root: ElementTree.Element, part: Part, origin: np.ndarray) -> None:
    joint = ElementTree.SubElement(root, "joint", name=part.joint or f"{part.name}_joint", type=part.kind)
    _add_origin(joint, origin)
    ElementTree.SubElement(joint, "parent", link=part.parent or "")
    ElementTree.SubElement(joint, "child", link=part.name)
    if part.axis is not None:
        local = frames.rotate(frames.conjugate(part.pose[3:]), np.asarray(part.axis, float))
        ElementTree.SubElement(joint, "axis", xyz=_text(local))
    if part.limit:
        ElementTree.SubElement(joint, "limit", {key: f"{value:.9g}" for key, value in part.limit.items()})
    if part.mimic is not None:
        source, multiplier, offset = part.mimic
        ElementTree.SubElement(joint, "mimic", joint=source, multiplier=f"{multiplier:.9g}", offset=f"{offset:.9g}")


def _add_origin(element: ElementTree.Element, pose: np.ndarray) -> None:
    ElementTree.SubElement(element, "origin", xyz=_text(pose[:3]), rpy=_text(roll_pitch_yaw(pose[3:])))


def _text(numbers: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{float(number):.9g}" for number in numbers)
