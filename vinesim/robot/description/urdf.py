"""A URDF: reads, edits and checks its XML, and converts its links and joints to Python objects.

The usual URDF libraries are not used because they import trimesh and scipy, which takes most of a second at every
start. Meshes are handled in :mod:`vinesim.robot.description.meshes`.
"""

from __future__ import annotations

import collections
import dataclasses
import math
import pathlib
import re
from collections.abc import Mapping

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.core.errors import one_line

MOVABLE_JOINT_TYPES = ("revolute", "continuous", "prismatic")
"""Types of URDF joints that move about or along one axis."""

SOLIDS = ("box", "sphere", "cylinder", "capsule", "mesh")
"""Elements that may be in a ``<geometry>``."""
NUMBER_COUNTS = {
    ("origin", "xyz"): 3,
    ("origin", "rpy"): 3,
    ("axis", "xyz"): 3,
    ("mass", "value"): 1,
    **{("inertia", key): 1 for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")},
    **{("limit", key): 1 for key in ("lower", "upper", "effort", "velocity")},
    ("mimic", "multiplier"): 1,
    ("mimic", "offset"): 1,
    ("box", "size"): 3,
    ("sphere", "radius"): 1,
    **{(solid, key): 1 for solid in ("cylinder", "capsule") for key in ("radius", "length")},
    ("mesh", "scale"): 3,
    ("mesh", "bounds"): 6,
    ("mesh", "faces"): 1,
}
"""Number of numbers in each attribute, by element and attribute."""

MAX_NUMBER = 1e6
"""Largest number in a URDF [m, kg, kg m2, rad]. Larger numbers would make the state of everything that touches the
robot inexact."""
MAX_LIMIT = 1e17
"""Largest value of a joint limit. It is large because some files use 1e16 for a joint without a limit."""
_SHAPE_ATTRIBUTES = {
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
    "mesh": ("filename",),
}
"""Attributes that each geometry must have, by element."""


class DescriptionError(ValueError):
    """A robot description that cannot be simulated. The message is one line with the file, the problem, and the
    remedy."""


def description_error(file: pathlib.Path, problem: str, remedy: str) -> DescriptionError:
    """Returns an error to raise, with a message in one line."""
    return DescriptionError(one_line(" ".join(f"{file}: {problem}; {remedy}".split())))


# ------------------------------------------------------------------ the file as XML


def read_xml(file: pathlib.Path, tag: str = "robot") -> etree._Element:
    """Returns the root element of a URDF or SRDF. Raises :class:`DescriptionError` if the file is not XML or its root
    is not ``tag``."""
    root = parse_xml(file.read_bytes(), file)
    if root.tag != tag:
        raise description_error(file, f"its root is <{root.tag}>, not <{tag}>", f"give a file that begins with <{tag}>")
    return root


def parse_xml(content: bytes, file: pathlib.Path) -> etree._Element:
    """Returns the root element of the ``content`` of an XML file, without comments and without XML namespaces, except
    that of xacro. Raises :class:`DescriptionError` if it is not XML, or declares a document type.

    A text in another encoding than its declaration says is read as Windows-1252, a superset of Latin-1. Prefixes of
    namespaces need not be declared.
    """
    content = content.strip() if b"\0" not in content[:64] else content  # not of UTF-16
    try:
        root = _parse(content)
    except etree.XMLSyntaxError as error:
        says = str(error).lower()
        try:
            if error.code == etree.ErrorTypes.ERR_UNKNOWN_VERSION:
                root = _parse(re.sub(rb"<\?xml[^>]*\?>", b"", content, count=1))
            elif "encoding" in says or "utf-8" in says:
                root = _parse(content, encoding="cp1252")
            elif error.code == etree.ErrorTypes.NS_ERR_UNDEFINED_NAMESPACE:
                root = _parse(content, recover=True)
            else:
                raise error
        except etree.XMLSyntaxError as worse:
            raise description_error(file, f"not well-formed XML: {worse.msg}", "correct this line") from worse
    if root.getroottree().docinfo.internalDTD is not None:
        raise description_error(file, "it declares a document type (DTD)", "remove <!DOCTYPE ...>: it is not needed")
    for element in root.iter(etree.Element):
        if _has_unknown_prefix(element.tag):
            element.tag = element.tag.replace(":", "_")
        for key in filter(_has_unknown_prefix, list(element.attrib)):
            element.set(key.replace(":", "_"), element.attrib.pop(key))
        name = etree.QName(element)
        if name.namespace and not is_of_xacro(name.namespace):
            element.tag = name.localname
    etree.cleanup_namespaces(root)
    return root


def is_of_xacro(namespace: str) -> bool:
    """Returns whether an XML namespace is that of xacro, such as ``http://www.ros.org/wiki/xacro``."""
    return namespace.rstrip("/").endswith("xacro")


def _has_unknown_prefix(name: str) -> bool:
    """Returns whether the name of an element or attribute has a prefix of a namespace that is not declared."""
    return ":" in name and not name.startswith("{")


def _parse(content: bytes, *, encoding: str | None = None, recover: bool = False) -> etree._Element:
    parser = etree.XMLParser(
        remove_comments=True, remove_pis=True, resolve_entities=False, encoding=encoding, recover=recover
    )
    return etree.fromstring(content, parser)


def check_friction(root: etree._Element, file: pathlib.Path) -> None:
    """Raise :class:`DescriptionError` unless all friction coefficients of links are finite numbers of at least 0."""
    given = [
        (element, element.get("value") if element.get("value") is not None else element.text)
        for element in (*root.iterfind("gazebo/mu1"), *root.iterfind("link/contact/lateral_friction"))
    ]
    for element, text in given:
        try:
            fits = 0.0 <= float(text or "") < math.inf
        except ValueError:
            fits = False
        if not fits:
            owner = next(up for up in element.iterancestors() if up.tag in ("gazebo", "link"))
            where = f"{element.tag} of {owner.get('reference') or owner.get('name')!r}"
            raise description_error(file, f"{where} is {text!r}", "give a friction coefficient of 0 or more")


def set_friction(root: etree._Element, friction: Mapping[str, float], file: pathlib.Path) -> None:
    """Write the friction coefficients of a TOML ``file`` (link -> coefficient) into the URDF as Gazebo's ``mu1``,
    instead of the URDF's own coefficients."""
    links = {link.get("name") for link in root.iterfind("link")}
    for name, coefficient in friction.items():
        if name not in links:
            raise description_error(file, f"friction is given for {name!r}", "name a link of the URDF")
        for old in root.xpath("gazebo[@reference=$name]/mu1", name=name):
            old.getparent().remove(old)
        gazebo = etree.SubElement(root, "gazebo", reference=name)
        etree.SubElement(gazebo, "mu1").text = repr(float(coefficient))


def check_numbers(root: etree._Element, file: pathlib.Path) -> None:
    """Raise :class:`DescriptionError` unless all numbers are complete and within bounds, and all sizes are above 0."""
    for element in root.iter(*{tag for tag, _ in NUMBER_COUNTS}):
        for (tag, key), count in NUMBER_COUNTS.items():
            text = element.get(key) if element.tag == tag else None
            if text is None:
                continue
            owner = next((up for up in element.iterancestors() if up.get("name")), root)
            where = f'<{tag} {key}="{text}"> of {owner.tag} {owner.get("name")!r}'
            try:
                numbers = [float(word) for word in text.split()]
            except ValueError as error:
                raise description_error(file, f"{where} is no number", "write decimal numbers") from error
            if len(numbers) != count:
                raise description_error(file, f"{where} has {len(numbers)} of {count} numbers", "give all of them")
            if not all(map(math.isfinite, numbers)):
                raise description_error(file, f"{where} is not finite", "give a number")
            largest = MAX_LIMIT if tag == "limit" else MAX_NUMBER
            if max(map(abs, numbers)) > largest:
                raise description_error(file, f"{where} is beyond {largest:g}", "give a smaller number")
            if tag in SOLIDS and key != "bounds" and min(map(abs, numbers) if tag == "mesh" else numbers) <= 0.0:
                raise description_error(file, f"{where} is not a size", "give numbers above 0")


def fix_wheels(root: etree._Element, notes: list[str]) -> bool:
    """Make the joints of wheels and casters fixed, because the base is driven as one body. Adds this to ``notes``.
    Returns whether there are any."""
    wheels = [
        joint
        for joint in root.iterfind("joint")
        if joint.get("type") in MOVABLE_JOINT_TYPES and re.search(r"wheel|caster", joint.get("name", ""))
    ]
    for joint in wheels:
        fix_joint(joint)
    if wheels:
        notes.append(f"{len(wheels)} wheel and caster joints are fixed: the base is driven as a whole")
    return bool(wheels)


def fix_joint(joint: etree._Element) -> None:
    """Make a joint fixed."""
    joint.set("type", "fixed")
    for tag in ("axis", "limit", "mimic", "dynamics", "safety_controller"):
        for element in joint.findall(tag):
            joint.remove(element)


# ------------------------------------------------------------------ links and joints


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """Mass of a link, with its centre and its inertia."""

    origin: np.ndarray | None
    """[4, 4] Frame of the inertia in the link, with the centre of mass as its origin [m]."""
    mass: float | None
    """Mass [kg]."""
    inertia: np.ndarray | None
    """[3, 3] Inertia about the centre of mass, in the axes of ``origin`` [kg m2]."""


@dataclasses.dataclass(frozen=True, slots=True)
class Link:
    """A rigid body of the robot."""

    name: str
    inertial: Inertial | None


@dataclasses.dataclass(frozen=True, slots=True)
class Limit:
    """Joint limits as given in the file [rad or m, N m or N, rad/s or m/s]."""

    effort: float | None
    velocity: float | None
    lower: float | None
    upper: float | None


@dataclasses.dataclass(frozen=True, slots=True)
class Mimic:
    """Coupling of a mimicking joint: position = multiplier x position of another joint + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """A joint between two links."""

    name: str
    type: str | None
    parent: str
    child: str
    origin: np.ndarray | None
    """[4, 4] Transform of the child in the parent at joint position 0 [m]."""
    axis: np.ndarray
    """[3] Axis of the joint in the child's frame."""
    limit: Limit | None
    mimic: Mimic | None


@dataclasses.dataclass(frozen=True, slots=True)
class Robot:
    """Links and joints of a URDF, in the order of the file."""

    name: str
    links: list[Link]
    joints: list[Joint]


def parse_robot(root: etree._Element) -> Robot:
    """Convert a ``<robot>`` element. Raises :class:`ValueError` if something that URDF requires is missing."""
    return Robot(
        _required(root, "name"),
        [_parse_link(element) for element in root.iterfind("link")],
        [_parse_joint(element) for element in root.iterfind("joint")],
    )


def parse_origin(element: etree._Element | None) -> np.ndarray | None:
    """Returns the homogeneous transform [4, 4] of an ``<origin>``: a translation, and a rotation about fixed x, then
    y, then z. None if there is no such element."""
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
    """Convert an ``<inertial>`` element; None if there is none."""
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
    """Returns an attribute that URDF requires. Raises :class:`ValueError` if it is missing."""
    value = element.get(attribute)
    if value is None:
        raise ValueError(f"a <{element.tag}> has no {attribute}")
    return value


def _number(element: etree._Element, attribute: str, default: float | None = None) -> float | None:
    value = element.get(attribute)
    return default if value is None else float(value)


def _numbers(text: str) -> np.ndarray:
    """Convert a text to three numbers [3]. Raises :class:`ValueError` if it is not three numbers."""
    values = np.array([float(word) for word in text.split()])
    if len(values) != 3:
        raise ValueError(f"{text!r} is not three numbers")
    return values


@dataclasses.dataclass(frozen=True, slots=True)
class JointLimits:
    """Limits of one driven joint. The position limits of a continuous joint are infinite."""

    lower: float
    """Lower position limit [rad or m]."""
    upper: float
    """Upper position limit [rad or m]."""
    effort: float
    """Largest effort [N m or N]."""
    velocity: float
    """Largest velocity [rad/s or m/s]."""


def joint_limits(joint: Joint) -> JointLimits:
    """Returns the limits of a driven joint. Raises ValueError if a limit that its type requires is missing."""
    limit = joint.limit
    if limit is None or limit.effort is None or limit.velocity is None:
        raise ValueError(f"joint {joint.name!r} has no limits of effort and velocity")
    if joint.type == "continuous":
        return JointLimits(-math.inf, math.inf, limit.effort, limit.velocity)
    if limit.lower is None or limit.upper is None:
        raise ValueError(f"joint {joint.name!r} has no limits of position")
    return JointLimits(limit.lower, limit.upper, limit.effort, limit.velocity)


# ------------------------------------------------------------------ checks


def check_tree(robot: Robot, file: pathlib.Path) -> tuple[str, list[Joint]]:
    """Returns the root link, and the joints from the root outwards. Raises :class:`DescriptionError` if links and
    joints are not one tree."""
    links = {link.name for link in robot.links}
    for kind, elements in (("link", robot.links), ("joint", robot.joints)):
        counts = collections.Counter(element.name for element in elements)
        twice = sorted(name for name, count in counts.items() if count > 1)
        if twice:
            raise description_error(file, f"{kind} {twice[0]!r} appears twice", "rename one")
    if "world" in links:
        raise description_error(
            file,
            "a link called 'world' is not the root",
            "rename it, or make it the root to bolt the robot down",
        )
    if not robot.links:
        raise description_error(file, "no links", "give a robot with at least one link")
    parent_of: dict[str, Joint] = {}
    children: dict[str, list[Joint]] = {}
    for joint in robot.joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise description_error(
                    file, f"joint {joint.name!r} names a link {link!r} that does not exist", "add it or rename"
                )
        if joint.child in parent_of:
            other = parent_of[joint.child].name
            raise description_error(
                file,
                f"link {joint.child!r} has two parents (joints {other!r} and {joint.name!r})",
                "URDF is a tree: open the loop by removing one joint",
            )
        parent_of[joint.child] = joint
        children.setdefault(joint.parent, []).append(joint)
    roots = [link.name for link in robot.links if link.name not in parent_of]
    if len(roots) > 1:
        raise description_error(
            file, f"links {roots[0]!r} and {roots[1]!r} both have no parent", "join them with a fixed joint"
        )
    order: list[Joint] = []
    waiting = collections.deque(children.get(roots[0], []) if roots else [])
    while waiting:
        joint = waiting.popleft()
        order.append(joint)
        waiting.extend(children.get(joint.child, []))
    if not roots or len(order) < len(robot.joints):
        reached = {joint.name for joint in order}
        lost = next(joint.name for joint in robot.joints if joint.name not in reached)
        raise description_error(
            file, f"joint {lost!r} is part of a kinematic loop", "URDF is a tree: remove one joint of the loop"
        )
    return roots[0], order


def check_joints(robot: Robot, file: pathlib.Path) -> None:
    """Raise :class:`DescriptionError` unless types, axes, limits and mimics of all joints can be simulated."""
    names = {joint.name: joint for joint in robot.joints}
    for joint in robot.joints:
        where = f"joint {joint.name!r}"
        if joint.type not in (*MOVABLE_JOINT_TYPES, "fixed"):
            raise description_error(
                file, f"{where} has the type {joint.type!r}", f"use one of fixed, {', '.join(MOVABLE_JOINT_TYPES)}"
            )
        if joint.type == "fixed":
            continue
        if not np.linalg.norm(joint.axis) > 1e-9:
            raise description_error(file, f"{where} has a zero axis", "give a direction")
        if joint.mimic is not None:
            source = names.get(joint.mimic.joint)
            if source is None or source.type not in MOVABLE_JOINT_TYPES or source.mimic is not None:
                raise description_error(file, f"{where} mimics {joint.mimic.joint!r}", "make it mimic a driven joint")
            continue
        limit = joint.limit
        needed = ("effort", "velocity") + (() if joint.type == "continuous" else ("lower", "upper"))
        missing = [key for key in needed if limit is None or getattr(limit, key) is None]
        if missing:
            raise description_error(file, f"{where} moves without limits", f"give <limit> with {', '.join(missing)}")
        limits = joint_limits(joint)
        if limits.effort <= 0.0 or limits.velocity <= 0.0:
            raise description_error(
                file, f"{where} has effort {limits.effort:g} and velocity {limits.velocity:g}", "give both above 0"
            )
        if joint.type != "continuous" and not limits.lower < limits.upper:
            raise description_error(
                file, f"{where} has limits {limits.lower:g} to {limits.upper:g}", "give lower below upper"
            )


def check_masses(robot: Robot, file: pathlib.Path, notes: list[str]) -> None:
    """Raise :class:`DescriptionError` unless masses are not negative and every inertia is positive definite.

    Inertias that violate the triangle inequality are reported in ``notes``.
    """
    lopsided = []
    for link in robot.links:
        inertial = link.inertial
        if inertial is None or inertial.mass is None:
            continue
        mass = inertial.mass
        inertia = inertial.inertia
        if mass < 0.0 or not math.isfinite(mass):
            raise description_error(file, f"link {link.name!r} has a mass of {mass:g} kg", "give 0 or more")
        if inertia is not None and mass > 0.0:
            moments = np.linalg.eigvalsh(inertia)
            if moments[0] <= 0.0 and moments[2] > 0.0:
                raise description_error(
                    file,
                    f"link {link.name!r} has principal moments {', '.join(f'{m:.2g}' for m in moments)} kg m2",
                    "give an inertia that is positive definite",
                )
            if moments[0] + moments[1] < moments[2] * (1.0 - 1e-6):
                lopsided.append(link.name)
    if lopsided:
        notes.append(f"{len(lopsided)} inertias violate the triangle inequality, first {lopsided[0]!r}")
