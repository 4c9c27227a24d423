"""Robot descriptions: a URDF, and beside it a TOML with what a URDF cannot say.

    robot = load_description("vinebot")
    rigid.add_robot(robot.to_spec("robot_1", index=0, pose=frames.pose([2.0, 0.0, 0.0])))

The URDF is read by yourdfpy. The text that physics and ROS receive differs from the file in three ways: meshes are
named by absolute path, wheels and casters are fixed (the base is driven as a whole), and shapes whose mesh format
physics cannot read are replaced; :attr:`RobotDescription.notes` lists each change.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import io
import logging
import math
import pathlib
import re
import sys
from collections.abc import Container

import msgspec
import numpy as np
import yourdfpy
from lxml import etree

from vinesim import frames
from vinesim.scene import data_files
from vinesim.scene.values import Drive, RobotSpec

log = logging.getLogger(__name__)

MESH_FORMATS = (".stl", ".obj", ".msh")
"""What MuJoCo reads; other meshes are replaced (Collada cannot be read by it)."""

MOVING = ("revolute", "continuous", "prismatic")


class DescriptionError(ValueError):
    """A robot description that cannot be simulated: one line with the file, what is wrong, and the remedy."""


class BaseLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the base may be driven."""

    linear: float = 0.5
    """Largest speed [m/s]."""
    angular: float = 0.8
    """Largest rate of turn [rad/s]."""
    linear_acceleration: float = 1.0
    """[m/s2]"""
    angular_acceleration: float = 2.0
    """[rad/s2]"""
    effort: tuple[float, float] = (800.0, 400.0)
    """Largest force [N] and moment [N m]."""
    timeout: float = 0.5
    """Time without a command after which it stops [s]."""
    slip: tuple[float, float] = (0.0, 0.0)
    """Share of the tracks' travel that is lost on the ground, ahead and in turns; odometry counts the travel."""


class JointGroup(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Joints that one controller moves."""

    joints: tuple[str, ...]
    stiffness: tuple[float, ...] | None = None
    """Position gains [N m/rad or N/m]."""
    damping: tuple[float, ...] | None = None
    """Velocity gains [N m s/rad or N s/m]."""
    rotor: tuple[float, ...] | None = None
    """Inertias of motor and gear seen from the joint [kg m2 or kg]."""
    elastic: tuple[float, ...] | None = None
    """Stiffnesses of the springs between gear and joint [N m/rad or N/m]; without them the position gains count."""
    elastic_damping: tuple[float, ...] | None = None
    """Their damping [N m s/rad or N s/m]."""
    home: tuple[float, ...] | None = None
    """[rad or m]"""
    tool: str = ""
    """Frame whose x axis points out of the hand, if the group is an arm."""


class SensorMount(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sensor: its name in topics, the frame it sits in, and the file in ``data/cameras`` or ``data/lidars``."""

    name: str
    frame: str
    type: str = ""


class Cutter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The mouth of a blade: x along the blades, y from one to the other, z across their plane."""

    group: str
    """The gripper it belongs to."""
    frame: str
    """The link that carries it."""
    half: tuple[float, float, float]
    """Half edges of the mouth [m]; the second is how far to either side wood is caught."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Middle of the mouth in ``frame`` [m]."""


class Sidecar(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The TOML beside a URDF."""

    base: BaseLimits = BaseLimits()
    groups: dict[str, JointGroup] = {}
    cameras: tuple[SensorMount, ...] | None = None
    lidars: tuple[SensorMount, ...] | None = None
    imus: tuple[SensorMount, ...] = ()
    wrenches: tuple[SensorMount, ...] = ()
    cutters: tuple[Cutter, ...] = ()


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MovingJoints:
    """Every joint that moves, driven or mimicking, laid out so that all poses follow from a few array operations."""

    names: tuple[str, ...]
    frames: tuple[tuple[str, str], ...]
    """(parent frame, child frame) of each."""
    drive_index: np.ndarray
    """[joint] index of the drive that moves it."""
    multiplier: np.ndarray
    """[joint] 1"""
    offset: np.ndarray
    """[joint] rad or m"""
    origin: np.ndarray
    """[joint, 7] child in parent at position 0."""
    translation: np.ndarray
    """[joint, 3] way of the child per metre, zero for a turning joint, in the parent."""
    rotation: np.ndarray
    """[joint, 4] origin's quaternion times (axis, 0), zero for a sliding joint."""

    def poses(self, position: np.ndarray) -> np.ndarray:
        """Child in parent [joint, 7] for drive positions [drive] rad or m."""
        q = self.multiplier * position[self.drive_index] + self.offset
        half = 0.5 * q[:, None] * self.rotation.any(axis=1, keepdims=True)
        poses = np.empty((len(q), 7))
        poses[:, :3] = self.origin[:, :3] + self.translation * q[:, None]
        poses[:, 3:] = self.origin[:, 3:] * np.cos(half) + self.rotation * np.sin(half)
        return poses


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RobotDescription:
    """A robot as every room needs it; constant."""

    name: str
    """The robot's name in the URDF."""
    file: pathlib.Path
    urdf: str
    """Text for physics and ``/robot_description``, meshes by absolute path."""
    base: str
    """Root link: base_footprint, if the URDF has it."""
    drives: tuple[Drive, ...]
    """In the URDF's order; mimicking joints have none."""
    home: np.ndarray
    """[joint] rad or m"""
    groups: dict[str, JointGroup]
    moving_joints: MovingJoints
    fixed_frames: tuple[tuple[str, str], ...]
    """(parent frame, child frame) of every fixed joint: ``/tf_static``."""
    fixed_poses: np.ndarray
    """[fixed, 7] child in parent."""
    link_anchors: dict[str, tuple[str, np.ndarray]]
    """Of every link: the moving link (or the root) it is fixed to, and its pose [7] there."""
    cameras: tuple[SensorMount, ...]
    lidars: tuple[SensorMount, ...]
    imus: tuple[SensorMount, ...]
    wrenches: tuple[SensorMount, ...]
    cutters: tuple[Cutter, ...]
    base_limits: BaseLimits
    mass: float
    """[kg]"""
    notes: tuple[str, ...]
    """What was changed or guessed, one line each."""

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the driven joints, in the order of joint arrays everywhere."""
        return tuple(drive.joint for drive in self.drives)

    def joint_indices(self, group: str) -> np.ndarray:
        """Positions of a group's joints in joint arrays."""
        order = {name: i for i, name in enumerate(self.joints)}
        return np.array([order[name] for name in self.groups[group].joints], int)

    def link_poses(self, position: np.ndarray) -> dict[str, np.ndarray]:
        """Pose [7] of every link in the root for drive positions; walks the tree, so not for the tick."""
        parents = dict(
            zip([child for _, child in self.moving_joints.frames], range(len(self.moving_joints.frames)), strict=True)
        )
        local = self.moving_joints.poses(np.asarray(position, float))
        found = {self.base: frames.pose([0.0, 0.0, 0.0])}

        def place(link: str) -> np.ndarray:
            if link not in found:
                anchor, offset = self.link_anchors[link]
                if anchor != link:
                    found[link] = frames.compose(place(anchor), offset)
                else:
                    joint = parents[link]
                    found[link] = frames.compose(place(self.moving_joints.frames[joint][0]), local[joint])
            return found[link]

        for link in self.link_anchors:
            place(link)
        return found

    def to_spec(self, name: str, index: int = 0, pose: np.ndarray | None = None) -> RobotSpec:
        """The robot as physics needs it: called ``name``, standing at ``pose`` [7]."""
        pose = frames.pose([0.0, 0.0, 0.0]) if pose is None else np.asarray(pose, float)
        return RobotSpec(
            name, index, self.urdf, self.base, pose, self.drives, self.home.copy(), self.base_limits.effort
        )


def load_description(name: str | pathlib.Path) -> RobotDescription:
    """Read a robot: a path to a URDF, the name of one in ``data/robots``, or ``tiago_pro`` (extra ``tiago``).

    Raises :class:`DescriptionError` in one line if it cannot be simulated as it is.
    """
    file = _locate(str(name))
    root = _read(file)
    _check_numbers(root, file)
    notes: list[str] = []
    _resolve_meshes(root, file, notes)
    _fix_wheels(root, notes)
    sidecar = _read_sidecar(file.with_suffix(".toml"))
    cameras = sidecar.cameras if sidecar.cameras is not None else _guess_cameras(root, notes)
    lidars = sidecar.lidars if sidecar.lidars is not None else _guess_lidars(root, notes)
    sidecar = msgspec.structs.replace(sidecar, cameras=cameras, lidars=lidars)
    urdf = etree.tostring(root, encoding="unicode")
    try:
        parsed = yourdfpy.URDF.load(
            io.BytesIO(urdf.encode()), build_scene_graph=False, load_meshes=False, filename_handler=lambda fname: fname
        ).robot
    except (KeyError, AttributeError, ValueError, IndexError, TypeError) as error:
        raise _error(
            file, f"not a URDF: {type(error).__name__} {error}", "give every link, joint and shape what URDF requires"
        ) from error
    order = _check_tree(parsed, file)
    _check_joints(parsed, file)
    _check_masses(parsed, order, file, notes)
    description = _assemble(parsed, order, file, urdf, sidecar, notes)
    for note in description.notes:
        log.info("%s: %s", file.name, note)
    return description


def _error(file: pathlib.Path, what: str, remedy: str) -> DescriptionError:
    return DescriptionError(" ".join(f"{file}: {what}; {remedy}".split()))


def _locate(name: str) -> pathlib.Path:
    if name == "tiago_pro":
        found = _resource("example-robot-data/robots/tiago_pro_description/robots/tiago_pro.urdf")
        if found is None:
            raise DescriptionError("tiago_pro: its files are not installed; pip install vinesim[tiago]")
        return found
    try:
        return data_files.find_data_file("robots", name, ".urdf").resolve()
    except data_files.DataFileNotFound as error:
        raise DescriptionError(f"{name}: {error}") from error


def _resource(path: str) -> pathlib.Path | None:
    """A file that a wheel of cmeel (example-robot-data and others) installed below ``share``."""
    roots = [pathlib.Path(sys.prefix) / "share"]
    cmeel = importlib.util.find_spec("cmeel")
    if cmeel is not None and cmeel.origin:
        roots.append(pathlib.Path(cmeel.origin).parent.parent / "cmeel.prefix" / "share")
    roots += [pathlib.Path(entry) / "cmeel.prefix" / "share" for entry in sys.path if entry]
    return next((root / path for root in roots if (root / path).is_file()), None)


def _read(file: pathlib.Path) -> etree._Element:
    try:
        root = etree.fromstring(file.read_bytes(), etree.XMLParser(remove_comments=True, resolve_entities=False))
    except etree.XMLSyntaxError as error:
        raise _error(file, f"not well-formed XML: {error.msg}", "mend that line (is it a xacro? expand it)") from error
    if root.tag != "robot":
        raise _error(file, f"its root is <{root.tag}>, not <robot>", "give a URDF (MJCF and SDF are not read)")
    return root


def _check_numbers(root: etree._Element, file: pathlib.Path) -> None:
    """Every number is one, finite, as many as there must be, and every size is above zero."""
    for element in root.iter(*{tag for tag, _ in _NUMBERS}):
        for (tag, key), count in _NUMBERS.items():
            text = element.get(key) if element.tag == tag else None
            if text is None:
                continue
            owner = next((up for up in element.iterancestors() if up.get("name")), root)
            where = f'<{tag} {key}="{text}"> of {owner.tag} {owner.get("name")!r}'
            try:
                numbers = [float(word) for word in text.split()]
            except ValueError as error:
                raise _error(
                    file, f"{where} is no number", "write decimal numbers (is it a xacro? expand it)"
                ) from error
            if len(numbers) != count:
                raise _error(file, f"{where} has {len(numbers)} of {count} numbers", "give all of them")
            if not all(map(math.isfinite, numbers)):
                raise _error(file, f"{where} is not finite", "give a number")
            if tag in _SOLIDS and min(map(abs, numbers) if tag == "mesh" else numbers) <= 0.0:
                raise _error(file, f"{where} is no size", "give numbers above 0")


_SOLIDS = ("box", "sphere", "cylinder", "capsule", "mesh")
_NUMBERS = {
    ("origin", "xyz"): 3, ("origin", "rpy"): 3, ("axis", "xyz"): 3, ("mass", "value"): 1,
    **{("inertia", key): 1 for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")},
    **{("limit", key): 1 for key in ("lower", "upper", "effort", "velocity")},
    ("mimic", "multiplier"): 1, ("mimic", "offset"): 1, ("box", "size"): 3, ("sphere", "radius"): 1,
    **{(solid, key): 1 for solid in ("cylinder", "capsule") for key in ("radius", "length")}, ("mesh", "scale"): 3,
}  # fmt: skip
"""How many numbers an attribute has."""


def _mesh_file(uri: str, file: pathlib.Path) -> pathlib.Path | None:
    """The file a mesh URI means: beside the URDF, in a folder above it that has the package's name, or in a wheel."""
    path = uri.removeprefix("file://")
    if not path.startswith("package://"):
        found = file.parent / path
        return found.resolve() if found.is_file() else None
    path = path.removeprefix("package://")
    inside = path.split("/", 1)[-1]
    for above in file.parents:
        for candidate in (above / path, above / inside):
            if candidate.is_file():
                return candidate.resolve()
    return _resource(path)


def _resolve_meshes(root: etree._Element, file: pathlib.Path, notes: list[str]) -> None:
    """Name meshes by absolute path; give shapes of unreadable format the link's touchable shapes instead."""
    for mesh in root.iterfind("link//geometry/mesh"):
        uri = mesh.get("filename", "")
        found = _mesh_file(uri, file)
        if found is None:
            raise _error(file, f"mesh {uri!r} is missing", "put it there, beside the URDF, or install its package")
        mesh.set("filename", str(found))
    unread: set[str] = set()

    def readable(shape: etree._Element) -> bool:
        mesh = shape.find("geometry/mesh")
        suffix = pathlib.Path(mesh.get("filename")).suffix.lower() if mesh is not None else ".stl"
        if suffix not in MESH_FORMATS:
            unread.add(suffix)
        return suffix in MESH_FORMATS

    for link in root.iterfind("link"):
        for shape in [shape for shape in link.iterfind("collision") if not readable(shape)]:
            _box_instead(shape, file)
        for shape in [shape for shape in link.iterfind("visual") if not readable(shape)]:
            material = shape.find("material")
            for solid in link.findall("collision"):
                visual = etree.SubElement(link, "visual")
                visual.extend(etree.fromstring(etree.tostring(part)) for part in solid)
                if material is not None:
                    visual.append(etree.fromstring(etree.tostring(material)))
            link.remove(shape)
    if unread:
        formats = ", ".join(sorted(unread))
        notes.append(f"meshes of format {formats} cannot be read: seen as collision shapes, touched as boxes")


def _box_instead(shape: etree._Element, file: pathlib.Path) -> None:
    """Replace the mesh of a shape by its bounding box."""
    import trimesh

    mesh = shape.find("geometry/mesh")
    scale = np.array([float(value) for value in (mesh.get("scale") or "1 1 1").split()])
    try:
        lower, upper = trimesh.load(mesh.get("filename"), force="mesh").bounds * scale
    except Exception as error:  # each format has errors of its own
        raise _error(
            file, f"mesh {mesh.get('filename')!r} cannot be read ({error})", "convert it to STL or OBJ"
        ) from error
    origin = shape.find("origin")
    values = dict(origin.attrib) if origin is not None else {}
    turn = yourdfpy.URDF._parse_origin(etree.Element("origin", values))
    centre = turn[:3, :3] @ (0.5 * (lower + upper)) + turn[:3, 3]
    if origin is None:
        origin = etree.SubElement(shape, "origin")
    origin.set("xyz", " ".join(f"{value:.9g}" for value in centre))
    geometry = shape.find("geometry")
    geometry.remove(mesh)
    etree.SubElement(geometry, "box", size=" ".join(f"{value:.9g}" for value in np.abs(upper - lower)))


def _fix_wheels(root: etree._Element, notes: list[str]) -> None:
    """Make wheels and casters fixed: the base is driven as one body."""
    wheels = [
        joint
        for joint in root.iterfind("joint")
        if joint.get("type") in MOVING and re.search(r"wheel|caster", joint.get("name", ""))
    ]
    for joint in wheels:
        joint.set("type", "fixed")
        for tag in ("axis", "limit", "mimic", "dynamics", "safety_controller"):
            for element in joint.findall(tag):
                joint.remove(element)
    if wheels:
        notes.append(f"{len(wheels)} wheel and caster joints are fixed: the base is driven as a whole")


def _check_tree(robot: yourdfpy.Robot, file: pathlib.Path) -> list[yourdfpy.Joint]:
    """The joints from the root outwards, or an error if they are not one tree."""
    links = {link.name for link in robot.links}
    for kind, things in (("link", robot.links), ("joint", robot.joints)):
        names = [thing.name for thing in things]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise _error(file, f"{kind} {twice[0]!r} is there twice", "rename one")
    if "world" in links:
        raise _error(file, "a link is called 'world', which is the name of everybody's world", "rename it")
    if not robot.joints:
        raise _error(file, "no joints", "give a robot with at least one joint that moves")
    parent_of: dict[str, yourdfpy.Joint] = {}
    children: dict[str, list[yourdfpy.Joint]] = {}
    for joint in robot.joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise _error(file, f"joint {joint.name!r} names a link {link!r} that is not there", "add it or rename")
        if joint.child in parent_of:
            other = parent_of[joint.child].name
            raise _error(
                file,
                f"link {joint.child!r} has two parents (joints {other!r} and {joint.name!r})",
                "URDF is a tree: open the loop by removing one joint",
            )
        parent_of[joint.child] = joint
        children.setdefault(joint.parent, []).append(joint)
    roots = [link.name for link in robot.links if link.name not in parent_of]
    if len(roots) > 1:
        raise _error(file, f"links {roots[0]!r} and {roots[1]!r} both have no parent", "join them with a fixed joint")
    order: list[yourdfpy.Joint] = []
    waiting = list(children.get(roots[0], [])) if roots else []
    while waiting:
        joint = waiting.pop(0)
        order.append(joint)
        waiting.extend(children.get(joint.child, []))
    if len(order) < len(robot.joints):
        reached = {joint.name for joint in order}
        lost = next(joint.name for joint in robot.joints if joint.name not in reached)
        raise _error(
            file, f"joint {lost!r} is part of a kinematic loop", "URDF is a tree: remove one joint of the loop"
        )
    return order


def _check_joints(robot: yourdfpy.Robot, file: pathlib.Path) -> None:
    names = {joint.name: joint for joint in robot.joints}
    for joint in robot.joints:
        where = f"joint {joint.name!r}"
        if joint.type not in (*MOVING, "fixed"):
            raise _error(file, f"{where} has the type {joint.type!r}", f"use one of fixed, {', '.join(MOVING)}")
        if joint.type == "fixed":
            continue
        if not np.linalg.norm(joint.axis) > 1e-9:
            raise _error(file, f"{where} has a zero axis", "give a direction")
        if joint.mimic is not None:
            source = names.get(joint.mimic.joint)
            if source is None or source.type not in MOVING or source.mimic is not None:
                raise _error(
                    file, f"{where} mimics {joint.mimic.joint!r}", "let it mimic a joint that is driven itself"
                )
            continue
        limit = joint.limit
        needed = ("effort", "velocity") + (() if joint.type == "continuous" else ("lower", "upper"))
        missing = [key for key in needed if limit is None or getattr(limit, key) is None]
        if missing:
            raise _error(file, f"{where} moves without limits", f"give <limit> with {', '.join(missing)}")
        if limit.effort <= 0.0 or limit.velocity <= 0.0:
            raise _error(
                file, f"{where} has effort {limit.effort:g} and velocity {limit.velocity:g}", "give both above 0"
            )
        if joint.type != "continuous" and not limit.lower < limit.upper:
            raise _error(file, f"{where} has limits {limit.lower:g} to {limit.upper:g}", "give lower below upper")
    if not any(joint.type in MOVING and joint.mimic is None for joint in robot.joints):
        raise _error(file, "no joint moves", "give a robot with at least one joint that moves")


def _anchors(base: str, order: list[yourdfpy.Joint]) -> dict[str, tuple[str, np.ndarray]]:
    """Of every link the moving link that carries it, and its pose there."""
    anchors = {base: (base, frames.pose([0.0, 0.0, 0.0]))}
    for joint in order:
        if joint.type == "fixed":
            anchor, offset = anchors[joint.parent]
            anchors[joint.child] = (anchor, frames.compose(offset, _origin(joint)))
        else:
            anchors[joint.child] = (joint.child, frames.pose([0.0, 0.0, 0.0]))
    return anchors


def _origin(joint: yourdfpy.Joint) -> np.ndarray:
    if joint.origin is None:
        return frames.pose([0.0, 0.0, 0.0])
    return frames.pose(joint.origin[:3, 3], frames.from_matrix(joint.origin[:3, :3]))


def _check_masses(robot: yourdfpy.Robot, order: list[yourdfpy.Joint], file: pathlib.Path, notes: list[str]) -> None:
    """Whatever moves has a mass, and no inertia contradicts itself."""
    carried: dict[str, float] = {}
    turning: dict[str, float] = {}
    anchors = _anchors(order[0].parent, order)
    lopsided = []
    for link in robot.links:
        inertial = link.inertial
        if inertial is None or inertial.mass is None:
            continue
        mass, inertia = inertial.mass, inertial.inertia
        if mass < 0.0 or not math.isfinite(mass):
            raise _error(file, f"link {link.name!r} has a mass of {mass:g} kg", "give it its mass")
        carried[anchors[link.name][0]] = carried.get(anchors[link.name][0], 0.0) + mass
        own = float(np.abs(inertia).max()) if inertia is not None else 0.0
        turning[anchors[link.name][0]] = turning.get(anchors[link.name][0], 0.0) + own
        if inertia is not None and mass > 0.0:
            moments = np.linalg.eigvalsh(inertia)
            if moments[0] <= 0.0 and moments[2] > 0.0:
                raise _error(
                    file,
                    f"link {link.name!r} has principal moments {', '.join(f'{m:.2g}' for m in moments)} kg m2",
                    "give an inertia that is positive definite",
                )
            if moments[0] + moments[1] < moments[2] * (1.0 - 1e-6):
                lopsided.append(link.name)
    for link in [order[0].parent, *(joint.child for joint in order if joint.type != "fixed")]:
        if carried.get(link, 0.0) <= 0.0:
            raise _error(file, f"link {link!r} moves but has no mass", "give it an <inertial> with a mass above 0")
        if turning[link] <= 0.0:
            raise _error(file, f"link {link!r} moves but has no inertia", "give it an <inertia> that is not all 0")
    if lopsided:
        notes.append(f"{len(lopsided)} inertias no real body has (triangle inequality), first {lopsided[0]!r}")


def _read_sidecar(file: pathlib.Path) -> Sidecar:
    if not file.is_file():
        return Sidecar()
    try:
        return msgspec.toml.decode(file.read_bytes(), type=Sidecar)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise _error(file, str(error), "see data/robots/vinebot.toml for what may be said") from error


def _assemble(
    robot: yourdfpy.Robot,
    order: list[yourdfpy.Joint],
    file: pathlib.Path,
    urdf: str,
    sidecar: Sidecar,
    notes: list[str],
) -> RobotDescription:
    base = order[0].parent
    driven = [joint for joint in robot.joints if joint.type in MOVING and joint.mimic is None]
    moving = _moving(robot, [joint.name for joint in driven])
    anchors = _anchors(base, order)
    fixed = [joint for joint in robot.joints if joint.type == "fixed"]
    home = np.array([_resting(joint) for joint in driven])
    description = RobotDescription(
        name=robot.name,
        file=file,
        urdf=urdf,
        base=base,
        drives=(),
        home=home,
        groups=sidecar.groups or _guess_groups([joint.name for joint in driven], anchors),
        moving_joints=moving,
        fixed_frames=tuple((joint.parent, joint.child) for joint in fixed),
        fixed_poses=np.array([_origin(joint) for joint in fixed]).reshape(-1, 7),
        link_anchors=anchors,
        cameras=sidecar.cameras or (),
        lidars=sidecar.lidars or (),
        imus=sidecar.imus,
        wrenches=sidecar.wrenches,
        cutters=sidecar.cutters,
        base_limits=sidecar.base,
        mass=sum(link.inertial.mass or 0.0 for link in robot.links if link.inertial is not None),
        notes=(),
    )
    _check_sidecar(description, {joint.name for joint in driven}, file.with_suffix(".toml"))
    gains, rotors, springs = {}, {}, {}
    for group in description.groups.values():
        for i, joint in enumerate(group.joints):
            if group.home is not None:
                home[[drive.name for drive in driven].index(joint)] = group.home[i]
            if group.stiffness is not None and group.damping is not None:
                gains[joint] = group.stiffness[i], group.damping[i]
            if group.rotor is not None:
                rotors[joint] = group.rotor[i]
            if group.elastic is not None and group.elastic_damping is not None:
                springs[joint] = group.elastic[i], group.elastic_damping[i]
    inertia = _carried_inertia(robot, description)
    guessed = [joint.name for joint in driven if joint.name not in gains]
    if guessed:
        notes.append(f"servo gains of {len(guessed)} joints are derived from effort limits and inertia")
    drives = tuple(
        _drive(joint, gains.get(joint.name), rotors.get(joint.name), springs.get(joint.name), inertia[joint.name])
        for joint in driven
    )
    return dataclasses.replace(description, drives=drives, notes=tuple(notes))


def _moving(robot: yourdfpy.Robot, driven: list[str]) -> MovingJoints:
    joints = [joint for joint in robot.joints if joint.type in MOVING]
    origin = np.array([_origin(joint) for joint in joints])
    axis = np.array([joint.axis / np.linalg.norm(joint.axis) for joint in joints])
    sliding = np.array([[joint.type == "prismatic"] for joint in joints])
    turn = np.concatenate([axis, np.zeros((len(joints), 1))], axis=1)
    return MovingJoints(
        names=tuple(joint.name for joint in joints),
        frames=tuple((joint.parent, joint.child) for joint in joints),
        drive_index=np.array([driven.index(joint.mimic.joint if joint.mimic else joint.name) for joint in joints]),
        multiplier=np.array([joint.mimic.multiplier if joint.mimic else 1.0 for joint in joints]),
        offset=np.array([joint.mimic.offset if joint.mimic else 0.0 for joint in joints]),
        origin=origin,
        translation=np.where(sliding, frames.rotate(origin[:, 3:], axis), 0.0),
        rotation=np.where(sliding, 0.0, frames.multiply(origin[:, 3:], turn)),
    )


def _resting(joint: yourdfpy.Joint) -> float:
    """Middle of the range: away from limits, and elbows bent the way they bend. Zero if that is near or endless."""
    if joint.type == "continuous":
        return 0.0
    lower, upper = joint.limit.lower, joint.limit.upper
    middle = 0.5 * (lower + upper)
    return middle if abs(middle) > 0.1 * (upper - lower) else 0.0


def _guess_groups(joints: list[str], links: Container[str]) -> dict[str, JointGroup]:
    """Groups from names in PAL style: ``arm_left_3_joint`` is of ``arm_left``, ``gripper_left_...`` of its gripper."""

    def tool(group: str) -> str:
        names = (group.replace("arm", "gripper") + "_grasping_link", group + "_tool_link")
        return next((name for name in names if name in links), "")

    groups: dict[str, list[str]] = {}
    for joint in joints:
        hand = re.match(r"(gripper|hand)_(left|right)", joint)
        stem = hand.group() if hand else re.sub(r"(_lift)?(_?\d+)?(_joint)?$", "", joint)
        groups.setdefault(stem or joint, []).append(joint)
    return {name: JointGroup(joints=tuple(members), tool=tool(name)) for name, members in groups.items()}


def _guess_cameras(root: etree._Element, notes: list[str]) -> tuple[SensorMount, ...]:
    """A D435 in the first optical frame (colour before others), else in front of the first link called a camera."""
    links = [link.get("name", "") for link in root.iterfind("link")]
    optical = [link for link in links if link.endswith("optical_frame")]
    colour = [link for link in optical if re.search(r"rgb|color|colour", link)]
    found = next(
        iter(colour or optical or [link for link in links if re.search(r"camera.*_link$|camera$", link)]), None
    )
    if found is None:
        notes.append("no camera: no link is called camera or optical")
        return ()
    name = re.sub(r"(_(rgb|color|colour|depth))?(_optical_frame|_link|_frame)$", "", found)
    notes.append(f"a d435 is taken to sit in {found!r}")
    if not optical:
        found, link = f"{name}_optical_frame", found
        etree.SubElement(root, "link", name=found)
        joint = etree.SubElement(root, "joint", name=f"{name}_optical_joint", type="fixed")
        etree.SubElement(joint, "parent", link=link)
        etree.SubElement(joint, "child", link=found)
        etree.SubElement(joint, "origin", xyz="0 0 0", rpy=f"{-math.pi / 2} 0 {-math.pi / 2}")
    return (SensorMount(name, found, "d435"),)


def _guess_lidars(root: etree._Element, notes: list[str]) -> tuple[SensorMount, ...]:
    """A VLP-16 in the first link called a lidar or laser, one in front before others."""
    links = [link.get("name", "") for link in root.iterfind("link")]
    found = sorted((link for link in links if re.search(r"lidar|laser|velodyne", link)), key=lambda n: "front" not in n)
    if not found:
        return ()
    notes.append(f"a vlp16 is taken to sit in {found[0]!r}")
    return (SensorMount("lidar", found[0], "vlp16"),)


def _check_sidecar(description: RobotDescription, driven: set[str], file: pathlib.Path) -> None:
    for name, group in description.groups.items():
        for joint in group.joints:
            if joint not in driven:
                raise _error(file, f"group {name!r} names {joint!r}, which no drive moves", "name driven joints only")
        for key in ("stiffness", "damping", "rotor", "elastic", "elastic_damping", "home"):
            values = getattr(group, key)
            if values is not None and len(values) != len(group.joints):
                raise _error(
                    file, f"group {name!r} has {len(values)} of {key} for {len(group.joints)} joints", "give one each"
                )
        if (group.elastic is None) != (group.elastic_damping is None):
            raise _error(file, f"group {name!r} gives only half of its springs", "give elastic and elastic_damping")
        if min((*(group.elastic or ()), *(group.elastic_damping or ()), 0.0)) < 0.0:
            raise _error(file, f"group {name!r} has a spring below zero", "give 0 or more")
        if group.tool and group.tool not in description.link_anchors:
            raise _error(file, f"group {name!r} has the tool {group.tool!r}", "name a link of the URDF")
    for cutter in description.cutters:
        if cutter.group not in description.groups:
            raise _error(file, f"a cutter belongs to {cutter.group!r}", "name a group")
        if cutter.frame not in description.link_anchors:
            raise _error(file, f"the cutter of {cutter.group!r} sits in {cutter.frame!r}", "name a link of the URDF")
        if min(cutter.half) <= 0.0:
            raise _error(
                file, f"the cutter of {cutter.group!r} has a mouth of {cutter.half}", "give half edges above 0"
            )
    if not all(0.0 <= slip < 1.0 for slip in description.base_limits.slip):
        raise _error(file, f"slip of {description.base_limits.slip}", "give shares from 0 to below 1")
    for mount in (*description.cameras, *description.lidars, *description.imus, *description.wrenches):
        if mount.frame not in description.link_anchors:
            raise _error(file, f"{mount.name!r} sits in {mount.frame!r}", "name a link of the URDF")


def _carried_inertia(robot: yourdfpy.Robot, description: RobotDescription) -> dict[str, float]:
    """What each moving joint carries with the robot at home: mass [kg], or inertia about its origin [kg m2].

    The inertia is the one about the worst axis through the joint, since arms bend: gains must suit any posture.
    """
    poses = description.link_poses(description.home)
    above = {child: description.link_anchors[parent][0] for parent, child in description.moving_joints.frames}
    heavy = [link for link in robot.links if link.inertial is not None and link.inertial.mass]
    mass = np.array([link.inertial.mass for link in heavy])
    centre = np.empty((len(heavy), 3))
    own = np.zeros(len(heavy))
    for i, link in enumerate(heavy):
        offset = link.inertial.origin[:3, 3] if link.inertial.origin is not None else np.zeros(3)
        centre[i] = frames.compose(poses[link.name], frames.pose(offset))[:3]
        own[i] = np.linalg.norm(link.inertial.inertia, 2) if link.inertial.inertia is not None else 0.0
    kinds = {joint.name: joint.type for joint in robot.joints}
    carried = {}
    for name, (_, child) in zip(description.moving_joints.names, description.moving_joints.frames, strict=True):
        beyond = np.array([_is_beyond(description.link_anchors[link.name][0], child, above) for link in heavy])
        if kinds[name] == "prismatic":
            carried[name] = float(mass[beyond].sum())
        else:
            lever = centre[beyond] - poses[child][:3]
            carried[name] = float(mass[beyond] @ (lever**2).sum(axis=1) + own[beyond].sum())
    return carried


def _is_beyond(link: str, joint_child: str, above: dict[str, str]) -> bool:
    while link != joint_child and link in above:
        link = above[link]
    return link == joint_child


def _drive(
    joint: yourdfpy.Joint,
    gains: tuple[float, float] | None,
    rotor: float | None,
    spring: tuple[float, float] | None,
    inertia: float,
) -> Drive:
    limit = joint.limit
    endless = joint.type == "continuous"
    if rotor is None:
        # full effort brings the bare drive to full speed in 20 ms
        rotor = 0.02 * limit.effort / limit.velocity
    if gains is None:
        # full effort at 0.05 rad or 5 mm off, and critical damping
        stiffness = limit.effort / (0.005 if joint.type == "prismatic" else 0.05)
        gains = stiffness, 2.0 * math.sqrt(stiffness * (inertia + rotor))
    return Drive(
        joint=joint.name,
        stiffness=gains[0],
        damping=gains[1],
        effort=limit.effort,
        velocity=limit.velocity,
        lower=-math.inf if endless else limit.lower,
        upper=math.inf if endless else limit.upper,
        armature=rotor,
        series_stiffness=spring[0] if spring else 0.0,
        series_damping=spring[1] if spring else 0.0,
    )
