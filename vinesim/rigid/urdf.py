"""URDFs of robots: checks, the URDF that MuJoCo compiles, friction, materials and visible shapes."""

from __future__ import annotations

import dataclasses
import functools
import xml.etree.ElementTree as ElementTree

import numpy as np

from vinesim.core import frames
from vinesim.scene.appearance import SURFACES, received_surface
from vinesim.scene.materials import Material
from vinesim.scene.triangles import TrianglesError
from vinesim.scene.values import Mesh, RobotSpec, Shape


class RobotError(ValueError):
    """Error: a robot cannot be added or commanded. The message contains the robot's name, the fault and a remedy."""


def check(spec: RobotSpec) -> None:
    """Raise :class:`RobotError` for faults that MuJoCo does not detect or reports less clearly."""
    count = len(spec.drives)
    if np.shape(spec.home) != (count,):
        raise RobotError(f"robot {spec.name!r} has {count} drives and a home position of shape {np.shape(spec.home)}")
    try:
        root = ElementTree.fromstring(spec.urdf)
    except ElementTree.ParseError as error:
        raise RobotError(f"robot {spec.name!r}: its URDF is not XML: {error}") from error
    links = {link.get("name", "") for link in root.findall("link")}
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    roots = links - {child.get("link", "") for joint in joints.values() for child in joint.findall("child")}
    if roots != {spec.base}:
        raise RobotError(
            f"robot {spec.name!r}: base {spec.base!r} must be the root of its URDF, which is {sorted(roots)}"
        )
    for drive in spec.drives:
        if drive.joint not in joints:
            raise RobotError(
                f"robot {spec.name!r} drives {drive.joint!r}, which its URDF lacks; the URDF has {sorted(joints)}"
            )
        if joints[drive.joint].get("type") not in ("revolute", "continuous", "prismatic"):
            kind = joints[drive.joint].get("type")
            raise RobotError(f"robot {spec.name!r} drives {drive.joint!r}, a {kind} joint; only axes can be driven")
        if min(drive.stiffness, drive.damping) < 0.0 or drive.effort <= 0.0:
            raise RobotError(f"robot {spec.name!r}: {drive} must have gains of 0 or more and an effort above 0")


@functools.lru_cache(16)  # shared by robots of one kind
def collision_urdf(urdf: str, driven: frozenset[str]) -> str:
    """Returns the URDF for MuJoCo: without visual shapes, and with all joints fixed except ``driven`` and mimic
    joints."""
    root = ElementTree.fromstring(urdf)
    for link in root.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    for joint in root.findall("joint"):
        if joint.get("type") != "fixed" and joint.get("name") not in driven and joint.find("mimic") is None:
            joint.set("type", "fixed")
    for mesh in root.iter("mesh"):
        mesh.set("filename", mesh.get("filename", "").removeprefix("file://"))
    for old in root.findall("mujoco"):
        root.remove(old)
    options = {"fusestatic": "false", "strippath": "false", "balanceinertia": "true", "discardvisual": "true"}
    ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", options)
    return ElementTree.tostring(root, encoding="unicode")


@functools.lru_cache(16)
def link_friction(urdf: str) -> dict[str, float]:
    """Returns the Coulomb friction coefficient [1] by link, where the URDF gives one: Gazebo's ``mu1`` or Bullet's
    ``lateral_friction``."""
    root = ElementTree.fromstring(urdf)
    found = {}
    for link in root.findall("link"):
        for element in link.findall("contact/lateral_friction"):
            found[link.get("name", "")] = float(element.get("value", ""))
    for gazebo in root.findall("gazebo"):
        for element in gazebo.findall("mu1"):
            found[gazebo.get("reference", "")] = float(element.get("value") or element.text or "")
    return found


_MATERIALS = {"rubber": Material.RUBBER, "plastic": Material.PLASTIC, "metal": Material.STEEL}
"""Contact material of a shape, by the name of its visible surface."""


@functools.lru_cache(16)
def collision_materials(urdf: str) -> dict[str, tuple[Material, ...]]:
    """Returns the materials of the collision shapes of each link, in the order of the URDF.

    A URDF gives materials only for visual shapes. A collision shape has the material of the visual shape of equal pose
    and size, or else the material that all visual shapes of its link share.
    """
    root = ElementTree.fromstring(urdf)
    paints = {m.get("name"): m for m in root.findall("material")}
    found = {}
    for link in root.findall("link"):
        seen = [shape for shape in (_shape(element, paints) for element in link.findall("visual")) if shape]
        surfaces = {shape.surface for shape in seen}
        common = surfaces.pop() if len(surfaces) == 1 else ""
        materials = []
        for element in link.findall("collision"):
            shape = _shape(element, paints)
            same = (one.surface for one in seen if shape and _is_same_solid(one, shape))
            materials.append(_MATERIALS.get(next(same, common), Material.UNKNOWN))
        found[link.get("name", "")] = tuple(materials)
    return found


def _is_same_solid(one: Shape, other: Shape) -> bool:
    return (
        (one.kind, one.file) == (other.kind, other.file)
        and np.allclose(one.size, other.size)
        and np.allclose(one.pose, other.pose)
    )


@functools.lru_cache(16)
def shapes_of(urdf: str) -> dict[str, tuple[Shape, ...]]:
    """Returns the shapes of each link of a URDF for sensors: its visual shapes, or its collision shapes if it has
    none."""
    root = ElementTree.fromstring(urdf)
    paints = {m.get("name"): m for m in root.findall("material")}
    shapes = {}
    for link in root.findall("link"):
        seen = link.findall("visual") or link.findall("collision")
        shapes[link.get("name", "")] = tuple(filter(None, (_shape(element, paints) for element in seen)))
    return shapes


def shapes_of_robot(spec: RobotSpec) -> dict[str, tuple[Shape, ...]]:
    """Returns the visible shapes of each link of a robot, as :func:`shapes_of` does.

    Meshes may also be given as triangles in ``spec``, received over the network. Raises :class:`RobotError` for a mesh
    that cannot be shown.
    """
    shapes = shapes_of(spec.urdf)
    if not spec.meshes:
        return shapes
    surfaces: dict[tuple[str, tuple[float, ...]], Mesh] = {}

    def with_mesh(shape: Shape) -> Shape:
        if shape.file not in spec.meshes:
            return shape
        key = (shape.file, shape.size)
        if key not in surfaces:
            try:
                surfaces[key] = received_surface(spec.meshes[shape.file], shape.size)
            except TrianglesError as error:
                raise RobotError(f"robot {spec.name!r}: mesh {shape.file} cannot be shown: {error}") from error
        return dataclasses.replace(shape, mesh=surfaces[key])

    return {link: tuple(map(with_mesh, pieces)) for link, pieces in shapes.items()}


_SURFACES = {name: name for name in SURFACES} | {"steel": "metal", "aluminium": "metal", "lens": "glass"}
"""Visible surface of a shape, by a word in the name of its URDF material (``rubber``, ``dark_rubber``, ``lamp_green``).
"""


def _numbers(element: ElementTree.Element | None, key: str, default: str) -> np.ndarray:
    return np.array(((element.get(key) if element is not None else None) or default).split(), float)


def _shape(element: ElementTree.Element, paints: dict) -> Shape | None:
    origin = element.find("origin")
    roll, pitch, yaw = _numbers(origin, "rpy", "0 0 0")
    turn = frames.exp(np.array([0.0, 0.0, yaw]))
    for angle in ((0.0, pitch, 0.0), (roll, 0.0, 0.0)):
        turn = frames.multiply(turn, frames.exp(np.array(angle)))
    material = element.find("material")
    if material is not None and material.find("color") is None:
        material = paints.get(material.get("name"), material)
    rgba = tuple(_numbers(None if material is None else material.find("color"), "rgba", "0.6 0.6 0.6 1"))
    words = ("" if material is None else material.get("name") or "").lower().split("_")
    is_indicator = "indicator" in words
    surface = next((_SURFACES[word] for word in words if word in _SURFACES), "")
    geometry = element.find("geometry")
    form = None if geometry is None else next(iter(geometry), None)
    if form is None:
        return None
    file = ""
    if form.tag == "box":
        size = tuple(_numbers(form, "size", "0 0 0") / 2)
    elif form.tag in ("cylinder", "capsule"):
        size = (float(form.get("radius", 0)), float(form.get("length", 0)) / 2)
    elif form.tag == "sphere":
        size = (float(form.get("radius", 0)),)
    elif form.tag == "mesh":
        size = tuple(_numbers(form, "scale", "1 1 1"))
        file = form.get("filename", "").removeprefix("file://")
    else:
        return None
    return Shape(
        form.tag, size, frames.pose(_numbers(origin, "xyz", "0 0 0"), turn), rgba, file, surface, None, is_indicator
    )
