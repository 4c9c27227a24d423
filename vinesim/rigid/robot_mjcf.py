"""A robot as elements of a MJCF document, for programs that read MuJoCo's files.

The elements are those of the robot in the simulation: its base, joints, masses, shapes that collide, and servos, whose
controls are target positions [rad or m]. MuJoCo writes numbers with six digits; masses and inertias get all of theirs.
"""

from __future__ import annotations

import copy
import dataclasses
import pathlib
import xml.etree.ElementTree as ElementTree

import mujoco
import numpy as np

from vinesim.rigid import recompile
from vinesim.rigid.robot_body import RobotBody
from vinesim.rigid.static_world import GROUND, ROBOT_CODES
from vinesim.rigid.urdf import RobotError
from vinesim.scene.physics_parameters import PhysicsParameters
from vinesim.scene.terrain import Terrain
from vinesim.scene.values import RobotSpec

_Element = ElementTree.Element
_GEOM = {"friction": "1 0.005 0.0001"}
"""MuJoCo's defaults of geoms that documents of vineyards change."""
_COPIED = ("default", "asset", "worldbody", "contact", "equality", "actuator")
"""Sections of a document whose elements are added to those of another document."""
_ON_GROUND = 1
_ABOVE_GROUND = 2
"""Collision bits of shapes that touch the ground, and of those of a driven base, which do not."""


@dataclasses.dataclass(frozen=True)
class RobotDocument:
    """A robot for a MJCF document."""

    root: _Element
    """The MJCF of the robot alone."""
    qpos: np.ndarray
    """[k] Positions of all its joints at the start, as MuJoCo orders them."""
    ctrl: np.ndarray
    """[k] Targets of its servos, with which it rests at the start."""

    def add_to(self, root: _Element) -> None:
        """Add the robot to a MJCF document with the geom ``ground``, behind all its bodies."""
        for tag in _COPIED:
            found = self.root.find(tag)
            if found is None:
                continue
            section = root.find(tag)
            if section is None:
                section = ElementTree.SubElement(root, tag)
            section.extend(copy.deepcopy(list(found)))
            if tag == "worldbody":
                for ground in section.findall("geom[@name='ground']"):
                    ground.set("contype", "0")  # else a driven base would touch it, too


def robot_document(
    spec: RobotSpec, parameters: PhysicsParameters = PhysicsParameters(), terrain: Terrain | None = None
) -> RobotDocument:
    """Returns a robot at ``spec.pose`` and in its home pose. ``terrain``: uneven ground.

    Raises :class:`RobotError`, also for a driven base on uneven ground, because no servo of a file follows the ground.
    """
    robot = RobotBody(spec, ROBOT_CODES[0], parameters, terrain)
    if robot.follower is not None:
        raise RobotError(
            f"robot {spec.name!r} drives on uneven ground, which a MJCF file cannot tell; export it on level ground"
        )
    world = mujoco.MjSpec()
    robot.add_to(world)
    for geom in world.geoms:
        touches = robot.free_base is not None or bool(geom.conaffinity & GROUND)
        geom.contype, geom.conaffinity = (_ON_GROUND if touches else _ABOVE_GROUND), 1
        geom.userdata = []
    for mesh in world.meshes:
        _use_hull(mesh)
    for actuator in world.actuators:
        actuator.gainprm[0] = -actuator.biasprm[1]
    if robot.free_base is not None:
        for body in world.bodies:
            body.gravcomp = 0.0  # MuJoCo would carry the base, too
    m = recompile.compile_without_contacts(world)
    d = mujoco.MjData(m)
    names = recompile.WorldNames.of(m)
    robot.find_indices(m, names)
    robot.place(m, d, robot.start_pose, np.asarray(spec.home, float))
    ctrl = np.zeros(m.nu)
    ctrl[robot.actuator] = robot.target + _weight_effort(m, d, robot) / np.maximum(robot.stiffness, 1e-9)
    ctrl[robot.base_actuator] = robot.base_target[: len(robot.base_actuator)]
    root = ElementTree.fromstring(world.to_xml())
    _add_class(root, spec.name)
    _restore_digits(root, m, names)
    return RobotDocument(root, d.qpos.copy(), ctrl)


def _add_class(root: _Element, name: str) -> None:
    """Give the bodies of the robot ``name`` MuJoCo's own defaults, which another document may change."""
    defaults = root.find("default")
    assert defaults is not None, "a robot is attached with its defaults"
    ElementTree.SubElement(ElementTree.SubElement(defaults, "default", {"class": f"{name}/robot"}), "geom", _GEOM)
    for body in root.findall("worldbody/body"):
        body.set("childclass", f"{name}/robot")


def _weight_effort(m: mujoco.MjModel, d: mujoco.MjData, robot: RobotBody) -> np.ndarray:
    """Returns the effort [joint] N m or N by which the drives of a robot on legs carry the links beyond them; 0 for
    other robots, of which MuJoCo's ``gravcomp`` carries the links."""
    if robot.free_base is None:
        return np.zeros(len(robot.q))
    m.body_gravcomp[1:] = 1.0
    mujoco.mj_forward(m, d)
    m.body_gravcomp[1:] = 0.0
    return d.qfrc_gravcomp[robot.v].copy()


def _use_hull(mesh: mujoco.MjsMesh) -> None:
    """Replace the file of a mesh by its convex hull, which is what collides, so that the document needs no files."""
    import trimesh

    hull = trimesh.load(pathlib.Path(mesh.file), force="mesh").convex_hull  # pyright: ignore[reportAttributeAccessIssue]
    mesh.uservert = np.asarray(hull.vertices, np.float32).ravel()
    mesh.userface = np.asarray(hull.faces, np.int32).ravel()
    mesh.file = ""


def _restore_digits(root: _Element, m: mujoco.MjModel, names: recompile.WorldNames) -> None:
    """Write masses, inertias and their places with all digits."""

    def text(values: np.ndarray) -> str:
        return " ".join(f"{float(value):.12g}" for value in values)

    for element in root.iter("body"):
        inertial = element.find("inertial")
        if inertial is None:
            continue
        body = names.body[element.get("name", "")]
        inertial.attrib.clear()
        inertial.set("pos", text(m.body_ipos[body]))
        inertial.set("quat", text(m.body_iquat[body]))
        inertial.set("mass", text(m.body_mass[body : body + 1]))
        inertial.set("diaginertia", text(m.body_inertia[body]))
