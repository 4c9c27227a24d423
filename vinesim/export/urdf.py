"""The vineyard as URDF: one robot ``vineyard`` whose root link ``world`` has the wood, the wires and the ground.

A URDF has no springs. Gazebo's elements ``springStiffness`` and ``springReference`` state them.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree

import numpy as np

from vinesim.core import frames
from vinesim.export.articulation import COLORS, HINGES, Capsule, Link, Vineyard
from vinesim.export.xml_text import add, text
from vinesim.scene.ids import Organ

INNER_SHARE = 1e-7
"""Share of a body's mass that each of the two links between its three hinges has. DERIVED: programs refuse a moving
link without mass; with this share the masses of body and links together, and of the body, stay the same within 1e-6."""
INNER_INERTIA = 1e-12
"""[kg m^2] Inertia of each of these links. DERIVED: half a percent of the smallest inertia in the shipped scenes, and
above the 1e-15 that MuJoCo takes for 0."""
GROUND_SIZE = (200.0, 200.0, 0.2)
"""[m] Box in place of a plane, which a URDF lacks."""
NO_LIMIT = 1e6
"""[N m, rad/s] Effort and velocity limit of the hinges, which the format demands."""

_NOTE = (
    " The zero of all joints is the drawn shape, in equilibrium with the springs of the gazebo elements; "
    "without these springs the plants fall. Ties to wires are left out. "
)

_Element = ElementTree.Element


def urdf(vineyard: Vineyard) -> _Element:
    """Returns the root of the URDF document."""
    root = _Element("robot", name=vineyard.name)
    root.append(ElementTree.Comment(_NOTE))
    for organ, color in COLORS.items():
        add(add(root, "material", name=organ.name.lower()), "color", rgba=text(*color))
    world = add(root, "link", name="world")
    place = {"xyz": text(0.0, 0.0, -0.5 * GROUND_SIZE[2]), "rpy": text(0.0, 0.0, 0.0)}
    _add_shape(world, Organ.GROUND, place, "box", size=text(*GROUND_SIZE))
    for piece in vineyard.fixed:
        _add_capsule(world, piece.organ, piece.capsule)
    for crate in vineyard.crates:
        link = add(root, "link", name=crate.name)
        center = np.sum([mass * pose[:3] for pose, _, mass in crate.walls], 0) / crate.mass
        tensor = np.zeros((3, 3))
        for pose, half, mass in crate.walls:
            arm = pose[:3] - center
            tensor += mass * (np.diag(half @ half - half * half) / 3.0 + arm @ arm * np.eye(3) - np.outer(arm, arm))
        _add_inertial(link, crate.mass, center, tensor)
        for pose, half, _ in crate.walls:
            _add_shape(link, Organ.BOX, _origin(pose), "box", size=text(*(2.0 * half)))
        _add_joint(root, crate.name, "floating", "world", crate.name, crate.pose)
    for link in vineyard.links:
        _add_plant_link(root, link, vineyard.links[link.parent].name if link.parent >= 0 else "world")
    return root


def _add_plant_link(root: _Element, link: Link, parent: str) -> None:
    """Add a link and its three hinges. The first hinge has the link's pose, the others lie in the same place."""
    share = 1.0 - 2.0 * INNER_SHARE
    pose = link.pose
    last = root
    for number, hinge in enumerate(HINGES):
        is_last = number == len(HINGES) - 1
        name = link.name if is_last else f"{link.name}_{hinge}_link"
        last = add(root, "link", name=name)
        if is_last:
            _add_inertial(last, share * link.mass, link.com, link.inertia)
        else:
            _add_inertial(last, INNER_SHARE * link.mass, np.zeros(3), INNER_INERTIA * np.eye(3))
        joint = _add_joint(root, f"{link.name}_{hinge}", "revolute", parent, name, pose)
        add(joint, "axis", xyz=text(*link.axes[number]))
        limits = {"lower": text(-math.pi), "upper": text(math.pi)}
        add(joint, "limit", **limits, effort=text(NO_LIMIT), velocity=text(NO_LIMIT))
        add(joint, "dynamics", damping=text(link.damping[number]), friction=text(0.0))
        spring = add(root, "gazebo", reference=f"{link.name}_{hinge}")
        add(spring, "springStiffness").text = text(link.stiffness[number])
        add(spring, "springReference").text = text(link.rest[number])
        parent = name
        pose = frames.pose(np.zeros(3))
    for capsule in link.capsules:
        _add_capsule(last, link.organ, capsule)
    for leaf in link.leaves:
        _add_shape(last, Organ.LEAF, _origin(leaf.pose), "box", collides=False, size=text(*(2.0 * leaf.size)))
    for name, place in link.buds:
        add(root, "link", name=name)
        _add_joint(root, f"{name}_joint", "fixed", link.name, name, place)


def _add_joint(root: _Element, name: str, kind: str, parent: str, child: str, pose: np.ndarray) -> _Element:
    joint = add(root, "joint", name=name, type=kind)
    add(joint, "origin", **_origin(pose))
    add(joint, "parent", link=parent)
    add(joint, "child", link=child)
    return joint


def _add_inertial(link: _Element, mass: float, com: np.ndarray, tensor: np.ndarray) -> None:
    inertial = add(link, "inertial")
    add(inertial, "origin", xyz=text(*com), rpy=text(0.0, 0.0, 0.0))
    add(inertial, "mass", value=text(mass))
    entries = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    add(inertial, "inertia", **{name: text(tensor[place]) for name, place in entries.items()})


def _origin(pose: np.ndarray) -> dict[str, str]:
    """Returns the attributes of a pose: position, and roll, pitch and yaw about fixed axes."""
    r = frames.to_matrix(pose[3:])
    pitch = math.asin(min(max(-r[2, 0], -1.0), 1.0))
    if abs(r[2, 0]) < 1.0 - 1e-12:
        roll, yaw = math.atan2(r[2, 1], r[2, 2]), math.atan2(r[1, 0], r[0, 0])
    else:  # roll and yaw turn about the same axis
        roll, yaw = 0.0, math.atan2(-r[0, 1], r[1, 1])
    return {"xyz": text(*pose[:3]), "rpy": text(roll, pitch, yaw)}


def _add_capsule(link: _Element, organ: Organ, capsule: Capsule) -> None:
    """Add a sphere, or a cylinder of the capsule's length: a URDF has no capsules."""
    middle = 0.5 * (capsule.start + capsule.end)
    if capsule.is_sphere:
        _add_shape(link, organ, _origin(frames.pose(middle)), "sphere", radius=text(capsule.radius))
        return
    way = capsule.end - capsule.start
    length = float(np.linalg.norm(way))
    turn = frames.multiply(frames.from_x_axis(way / length), frames.exp(np.array([0.0, 0.5 * np.pi, 0.0])))
    origin = _origin(frames.pose(middle, turn))
    _add_shape(link, organ, origin, "cylinder", radius=text(capsule.radius), length=text(length))


def _add_shape(
    link: _Element, organ: Organ, origin: dict[str, str], kind: str, *, collides: bool = True, **size: str
) -> None:
    for use in ("visual", "collision") if collides else ("visual",):
        shape = add(link, use)
        add(shape, "origin", **origin)
        add(add(shape, "geometry"), kind, **size)
        if use == "visual":
            add(shape, "material", name=organ.name.lower())
