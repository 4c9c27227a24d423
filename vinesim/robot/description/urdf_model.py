"""Links and joints of a URDF as Python objects, without the meshes: what checks, kinematics and drives need.

A reader of our own because the libraries for it load trimesh and scipy, most of a second, at every start.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

_SHAPE_ATTRIBUTES = {
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
    "mesh": ("filename",),
}
"""Attributes that a geometry must have."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """Mass of a link and how it is distributed."""

    origin: np.ndarray | None
    """[4, 4] m, centre of mass and principal axes in the link."""
    mass: float | None
    """[kg]"""
    inertia: np.ndarray | None
    """[3, 3] kg m2"""


@dataclasses.dataclass(frozen=True, slots=True)
class Link:
    """A rigid body of the robot."""

    name: str
    inertial: Inertial | None


@dataclasses.dataclass(frozen=True, slots=True)
class Limit:
    """Limits as the file gives them [rad or m, N m or N, rad/s or m/s]."""

    effort: float | None
    velocity: float | None
    lower: float | None
    upper: float | None


@dataclasses.dataclass(frozen=True, slots=True)
class Mimic:
    """Position = multiplier x that of another joint + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """What joins two links."""

    name: str
    type: str | None
    parent: str
    child: str
    origin: np.ndarray | None
    """[4, 4] m, child in parent at position 0."""
    axis: np.ndarray
    """[3], in the child."""
    limit: Limit | None
    mimic: Mimic | None


@dataclasses.dataclass(frozen=True, slots=True)
class Robot:
    """Links and joints in the order of the file."""

    name: str
    links: list[Link]
    joints: list[Joint]


def parse_robot(root: etree._Element) -> Robot:
    """The robot of a ``<robot>`` element; :class:`ValueError` if something that URDF requires is missing."""
    return Robot(
        _required(root, "name"),
        [_parse_link(element) for element in root.iterfind("link")],
        [_parse_joint(element) for element in root.iterfind("joint")],
    )


def parse_origin(element: etree._Element | None) -> np.ndarray | None:
    """Homogeneous transform [4, 4] of an ``<origin>``: translation, and rotation about fixed x, then y, then z."""
    if element is None:
        return None
    place = np.identity(4)
    place[:3, 3] = _numbers(element.get("xyz", "0 0 0"))
    roll, pitch, yaw = _numbers(element.get("rpy", "0 0 0"))
    si = np.sin(roll)
    sj = np.sin(pitch)
    sk = np.sin(yaw)
    ci = np.cos(roll)
    cj = np.cos(pitch)
    ck = np.cos(yaw)
    cc = ci * ck
    cs = ci * sk
    sc = si * ck
    ss = si * sk
    turn = np.identity(4)
    turn[:3, :3] = [
        [cj * ck, sj * sc - cs, sj * cc + ss],
        [cj * sk, sj * ss + cc, sj * cs - sc],
        [-sj, cj * si, cj * ci],
    ]
    return np.dot(place, turn)


def _parse_link(element: etree._Element) -> Link:
    name = _required(element, "name")
    for shape in (*element.iterfind("visual"), *element.iterfind("collision")):
        solids = shape.findall("geometry/*")
        if not solids:
            raise ValueError(f"a {shape.tag} of link {name!r} has no <geometry>")
        if solids[0].tag not in _SHAPE_ATTRIBUTES:
            raise ValueError(f"a {shape.tag} of link {name!r} is a <{solids[0].tag}>")
        for attribute in _SHAPE_ATTRIBUTES[solids[0].tag]:
            _required(solids[0], attribute)
    return Link(name, parse_inertial(element.find("inertial")))


def parse_inertial(element: etree._Element | None) -> Inertial | None:
    """The content of an ``<inertial>``; None if there is none."""
    if element is None:
        return None
    mass = element.find("mass")
    inertia = element.find("inertia")
    tensor = None
    if inertia is not None:
        keys = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
        tensor = np.array([[float(inertia.get(key, key[1] == key[2])) for key in row] for row in keys])
    return Inertial(parse_origin(element.find("origin")), None if mass is None else _number(mass, "value", 0.0), tensor)


def _parse_joint(element: etree._Element) -> Joint:
    name = _required(element, "name")
    ends = []
    for tag in ("parent", "child"):
        end = element.find(tag)
        if end is None:
            raise ValueError(f"joint {name!r} has no <{tag}>")
        ends.append(_required(end, "link"))
    axis, limit, mimic = (element.find(tag) for tag in ("axis", "limit", "mimic"))
    return Joint(
        name,
        element.get("type"),
        *ends,
        origin=parse_origin(element.find("origin")),
        axis=_numbers("1 0 0" if axis is None else axis.get("xyz", "1 0 0")),
        limit=None if limit is None else Limit(*(_number(limit, k) for k in ("effort", "velocity", "lower", "upper"))),
        mimic=None
        if mimic is None
        else Mimic(mimic.get("joint", ""), float(mimic.get("multiplier", 1.0)), float(mimic.get("offset", 0.0))),
    )


def _required(element: etree._Element, attribute: str) -> str:
    """An attribute that URDF requires; :class:`ValueError` if it is not there."""
    value = element.get(attribute)
    if value is None:
        raise ValueError(f"a <{element.tag}> has no {attribute}")
    return value


def _number(element: etree._Element, attribute: str, default: float | None = None) -> float | None:
    value = element.get(attribute)
    return default if value is None else float(value)


def _numbers(text: str) -> np.ndarray:
    """Three numbers [3]."""
    values = np.array([float(word) for word in text.split()])
    if len(values) != 3:
        raise ValueError(f"{text!r} is not three numbers")
    return values
