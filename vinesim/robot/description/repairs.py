"""Repairs of common faults in URDFs: missing or invalid values are replaced, and each replacement is reported.

All functions change the XML of a URDF whose numbers were checked. They add what they assumed to ``assumed``, one line
per kind of repair. A repaired URDF needs no further repair.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.robot.description.kinematics import link_anchors
from vinesim.robot.description.urdf import MOVABLE_JOINT_TYPES, Joint, Robot, fix_joint, parse_inertial

MOUNT = "world_mount"
"""New name of a root link ``world``. A robot whose root link has this name is bolted down."""
RANGE = ("lower", "upper")
"""Attributes of a ``<limit>`` with the range of a joint. If both are 0 or missing for a revolute joint, its range is
assumed to be unknown."""
DEFAULT_EFFORT = {"revolute": 10.0, "continuous": 10.0, "prismatic": 100.0}
"""[N m or N] Effort limit of a joint whose limit is 0 or missing. The weight that the joint carries is added later.
GUESSED"""
DEFAULT_VELOCITY = {"revolute": 1.0, "continuous": 1.0, "prismatic": 0.1}
"""[rad/s or m/s] Velocity limit of a joint whose limit is 0 or missing. GUESSED"""
DEFAULT_MASS = 1e-3
"""[kg] Mass of a moving link whose mass is missing. GUESSED"""
GYRATION_RADIUS = 0.05
"""[m] Radius of gyration of a moving link whose inertia is missing. GUESSED"""
NEGLIGIBLE_MOMENT = 1e-6
"""[kg m2] Magnitude up to which a negative principal moment counts as a rounding error. GUESSED"""
LEAST_MOMENT = 1e-12
"""[kg m2] Magnitude up to which a principal moment counts as 0."""
LEAST_MOMENT_SHARE = 1e-3
"""Share of the largest principal moment to which principal moments with a rounding error are raised."""


def free_the_base(root: etree._Element, assumed: list[str]) -> str:
    """Remove the floating or planar joint at the root of a robot, and the link above it (``world``). Floating and
    planar joints elsewhere become fixed, which is added to ``assumed``. Returns the type of the joint at the root;
    empty if there is none."""
    children = {joint.find("child").get("link") for joint in root.iterfind("joint") if joint.find("child") is not None}
    fixed = []
    found = ""
    for joint in root.findall("joint"):
        if joint.get("type") not in ("floating", "planar"):
            continue
        parent = joint.find("parent")
        above = parent.get("link") if parent is not None else None
        links = [link for link in root.iterfind("link") if link.get("name") == above]
        beside = [other for other in root.iterfind("joint/parent") if other.get("link") == above]
        is_bare = bool(links) and not any(links[0].find(tag) is not None for tag in ("visual", "collision", "inertial"))
        if above not in children and len(beside) == 1 and (is_bare or above == "world"):
            root.remove(joint)
            root.remove(links[0])
            found = joint.get("type")
        else:
            fix_joint(joint)
            fixed.append(joint.get("name", ""))
    if fixed:
        assumed.append(f"{some_names(fixed)} is floating or planar, but not at the root: fixed")
    return found


def lift_to_ground(root: etree._Element, base: str, height: float, notes: list[str]) -> None:
    """Add a root link on the ground, ``height`` [m] below the root link ``base``. Adds this to ``notes``."""
    links = {link.get("name") for link in root.iterfind("link")}
    name = next(one for one in ("base_footprint", "footprint", "ground_footprint") if one not in links)
    etree.SubElement(root, "link", name=name)
    joint = etree.SubElement(root, "joint", name=f"{name}_joint", type="fixed")
    etree.SubElement(joint, "origin", xyz=f"0 0 {height:.6g}", rpy="0 0 0")
    etree.SubElement(joint, "parent", link=name)
    etree.SubElement(joint, "child", link=base)
    notes.append(f"it stands on the ground, {height:.3g} m below {base!r}, by a new root link {name!r}")


def rename_world(root: etree._Element, notes: list[str]) -> None:
    """Rename a root link ``world``, which is also the name of the world frame, to :data:`MOUNT`. Adds this to
    ``notes``."""
    links = [link for link in root.iterfind("link") if link.get("name") == "world"]
    if not links or root.find("joint/child[@link='world']") is not None:
        return
    links[0].set("name", MOUNT)
    for parent in root.iterfind("joint/parent[@link='world']"):
        parent.set("link", MOUNT)
    if links[0].find("inertial") is None:
        _set_inertial(links[0], DEFAULT_MASS, np.identity(3) * DEFAULT_MASS * GYRATION_RADIUS**2)
    notes.append(f"it is bolted down by its root link 'world', here called {MOUNT!r}")


def repair_joints(root: etree._Element, assumed: list[str]) -> None:
    """Give every moving joint a range, and limits of effort and velocity above 0. A joint that mimics a joint that
    does not move becomes a driven joint."""
    joints = {joint.get("name"): joint for joint in root.iterfind("joint")}
    moving = {name: joint for name, joint in joints.items() if joint.get("type") in MOVABLE_JOINT_TYPES}
    freed = []
    filled = []
    unbounded = []
    for name, joint in moving.items():
        for more in joint.findall("mimic")[1:]:
            joint.remove(more)
        mimic = joint.find("mimic")
        if mimic is not None and mimic.get("joint") not in moving:
            joint.remove(mimic)
            freed.append(name)
    _compose_mimics(moving)
    for name, joint in moving.items():
        if joint.find("mimic") is not None:
            continue
        limit = joint.find("limit")
        if limit is None:
            limit = etree.SubElement(joint, "limit")
        for key, defaults in (("effort", DEFAULT_EFFORT), ("velocity", DEFAULT_VELOCITY)):
            if float(limit.get(key, 0.0)) == 0.0:
                limit.set(key, f"{defaults[joint.get('type')]:g}")
                filled.append(name)
        if joint.get("type") == "revolute" and not any(float(limit.get(key, 0.0)) for key in RANGE):
            limit.set("lower", f"{-math.pi:.9g}")
            limit.set("upper", f"{math.pi:.9g}")
            unbounded.append(name)
    filled = list(dict.fromkeys(filled))
    if freed:
        assumed.append(f"{some_names(freed)} mimics a joint that does not move: it has its own drive")
    if filled:
        assumed.append(
            f"{some_names(filled)} has no effort or no velocity above 0: "
            f"{DEFAULT_EFFORT['revolute']:g} N m or {DEFAULT_EFFORT['prismatic']:g} N, "
            f"{DEFAULT_VELOCITY['revolute']:g} rad/s or {DEFAULT_VELOCITY['prismatic']:g} m/s"
        )
    if unbounded:
        assumed.append(f"{some_names(unbounded)} turns without lower and upper limits: half a turn to either side")


def _compose_mimics(joints: Mapping[str, etree._Element]) -> None:
    """Change joints that mimic a mimicking joint so that they mimic the driven joint at the end of the chain. Cycles
    are kept here, and are rejected by a later check.

    With q1 = m1 q2 + o1 and q2 = m2 q3 + o2: q1 = m1 m2 q3 + (m1 o2 + o1).
    """
    for joint in joints.values():
        mimic = joint.find("mimic")
        passed = set()
        while mimic is not None and mimic.get("joint") not in passed:
            passed.add(mimic.get("joint"))
            source = joints[mimic.get("joint")].find("mimic")
            if source is None:
                break
            multiplier = float(mimic.get("multiplier", 1.0))
            mimic.set("joint", source.get("joint", ""))
            mimic.set("offset", repr(multiplier * float(source.get("offset", 0.0)) + float(mimic.get("offset", 0.0))))
            mimic.set("multiplier", repr(multiplier * float(source.get("multiplier", 1.0))))


def repair_inertias(root: etree._Element, assumed: list[str]) -> None:
    """Increase principal moments of inertia that are 0, or negative by a rounding error, to a small positive value. Add
    an inertia where there is only a mass."""
    repaired = []
    lacking = []
    for link in root.iterfind("link"):
        given = link.find("inertial")
        if given is not None and given.find("mass") is None:
            link.remove(given)
        elif given is not None and given.find("inertia") is None:
            mass = float(given.find("mass").get("value", 0.0))
            _set_inertial(link, mass, np.identity(3) * max(mass, 0.0) * GYRATION_RADIUS**2)
            lacking.append(link.get("name"))
        inertial = parse_inertial(link.find("inertial"))
        if inertial is None or inertial.inertia is None or not inertial.inertia.any():
            continue
        moments, axes = np.linalg.eigh(inertial.inertia)
        if moments[0] > LEAST_MOMENT or moments[0] < -NEGLIGIBLE_MOMENT:
            continue
        raised = np.maximum(moments, LEAST_MOMENT_SHARE * moments[2]) if moments[2] > LEAST_MOMENT else np.zeros(3)
        _set_inertial(link, inertial.mass or 0.0, axes * raised @ axes.T)
        repaired.append(link.get("name"))
    if lacking:
        assumed.append(f"{some_names(lacking)} has no inertia: radius of gyration {1e3 * GYRATION_RADIUS:g} mm")
    if repaired:
        assumed.append(f"inertia of {some_names(repaired)} is not positive definite: its smallest moments are raised")


def add_missing_masses(root: etree._Element, robot: Robot, base: str, order: list[Joint], assumed: list[str]) -> None:
    """Give a mass and an inertia to each moving body of ``robot`` without them. A body is a moving link with all links
    that are fixed to it.

    ``root``: XML of the robot. ``base``: its root link. ``order``: its joints from the root outwards.
    """
    anchors = link_anchors(base, order)
    mass = dict.fromkeys((base, *(joint.child for joint in order if joint.type != "fixed")), 0.0)
    inertia = dict(mass)
    heaviest: dict[str, tuple[float, str]] = {}
    for link in robot.links:
        if link.inertial is not None:
            anchor = anchors[link.name][0]
            mass[anchor] += link.inertial.mass or 0.0
            heaviest[anchor] = max(heaviest.get(anchor, (0.0, link.name)), (link.inertial.mass or 0.0, link.name))
            inertia[anchor] += 0.0 if link.inertial.inertia is None else float(np.abs(link.inertial.inertia).max())
    lacking = [link for link in mass if mass[link] == 0.0 or inertia[link] == 0.0]
    elements = {link.get("name"): link for link in root.iterfind("link")}
    for link in lacking:
        own = mass[link] or DEFAULT_MASS
        holder = heaviest[link][1] if mass[link] else link
        existing = parse_inertial(elements[holder].find("inertial"))
        kept = existing.mass if existing is not None and existing.mass else DEFAULT_MASS
        _set_inertial(elements[holder], kept, np.identity(3) * own * GYRATION_RADIUS**2)
    if lacking:
        assumed.append(
            f"{some_names(lacking)} moves without mass or inertia: {1e3 * DEFAULT_MASS:g} g, "
            f"radius of gyration {1e3 * GYRATION_RADIUS:g} mm"
        )


def some_names(names: list[str]) -> str:
    """Returns the first name as text, with the number of further names."""
    return repr(names[0]) + (f" (and {len(names) - 1} more)" if len(names) > 1 else "")


def _set_inertial(link: etree._Element, mass: float, inertia: np.ndarray) -> None:
    """Set the mass [kg] and inertia [3, 3] kg m2 of a link. Its centre of mass stays the same."""
    inertial = link.find("inertial")
    if inertial is None:
        inertial = etree.SubElement(link, "inertial")
    for tag in ("mass", "inertia"):
        for element in inertial.findall(tag):
            inertial.remove(element)
    etree.SubElement(inertial, "mass", value=f"{mass:.9g}")
    keys = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    etree.SubElement(inertial, "inertia", {key: f"{inertia[at]:.9g}" for key, at in keys.items()})
