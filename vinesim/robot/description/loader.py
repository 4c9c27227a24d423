"""Loads a robot description: a robot file, and a TOML file of the same name with data that a URDF cannot contain.

    robot = load_description("vinebot")
    rigid.add_robot(robot.to_spec("robot_1", index=0, pose=frames.pose([2.0, 0.0, 0.0])))

A robot file of another format is converted to URDF first (:mod:`vinesim.robot.description.source`). ROS receives the
user's own URDF. Physics receives a changed one: meshes have absolute paths and formats that it reads; wheels and
casters are fixed, because the base is driven as one body; a root link ``world`` is renamed and bolts the robot
down; a robot that reaches below its root link is lifted to the ground; missing or invalid values are repaired. A robot
that stands on legs, and whose file says that it moves freely, gets a free base.
:attr:`RobotDescription.notes` lists each change. One warning for each robot lists what was assumed.
"""

from __future__ import annotations

import collections
import copy
import dataclasses
import logging
import pathlib
from collections.abc import Container, Mapping, Sequence
from typing import get_args

import msgspec
import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.core import frames
from vinesim.rigid.robot_body import lowest_point
from vinesim.robot.description.controllers import command_interfaces, make_controllers, with_original_names
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.drive_parameters import home_positions, make_drives
from vinesim.robot.description.extent import bounds, feet, link_boxes, size_warning
from vinesim.robot.description.gazebo_sensors import read_sensors
from vinesim.robot.description.grippers import Fingers, guess_fingers, warn_of_unlisted_fingers
from vinesim.robot.description.inferred_defaults import SENSOR_GUESSES, guess_groups, guess_imus
from vinesim.robot.description.kinematics import joint_origin, link_anchors, moving_joints
from vinesim.robot.description.meshes import replace_unopened_meshes, resolve_meshes
from vinesim.robot.description.names import make_names_valid, rename_in_sidecar
from vinesim.robot.description.packages import ros_address
from vinesim.robot.description.repairs import (
    MOUNT,
    add_missing_masses,
    free_the_base,
    lift_to_ground,
    rename_world,
    repair_inertias,
    repair_joints,
    some_names,
)
from vinesim.robot.description.sidecar import BaseKind, JointGroup, Sidecar, check_sidecar, read_sidecar
from vinesim.robot.description.source import RobotSource, read_source
from vinesim.robot.description.srdf import (
    find_srdf,
    merge_disabled_collisions,
    read_srdf,
    srdf_floats,
    srdf_groups,
    srdf_hands,
)
from vinesim.robot.description.urdf import (
    MOVABLE_JOINT_TYPES,
    DescriptionError,
    Joint,
    check_friction,
    check_joints,
    check_masses,
    check_numbers,
    check_tree,
    description_error,
    fix_wheels,
    joint_limits,
    parse_robot,
    parse_xml,
    read_xml,
    set_friction,
)
from vinesim.robot.description.xacro_files import parse_arguments
from vinesim.scene.robot_limits import counts_objection
from vinesim.scene.values import SENSOR_KINDS, RenderedMount, SensorPacing

log = logging.getLogger(__name__)

BOLTED_EFFORT = (1e6, 1e6)
"""Largest force [N] and moment [N m] that hold the base of a robot that is bolted down. Forces of the robot move the
base by micrometres."""
LEAST_LIFT = 0.005
"""[m] Depth below the root link from which on a robot is lifted to the ground."""


def load_description(
    name: str | pathlib.Path,
    *,
    is_remote: bool = False,
    sidecar: Sidecar | None = None,
    received: Mapping[str, np.ndarray] | None = None,
    srdf: str | pathlib.Path | None = None,
    xacro_args: Sequence[str] = (),
    base: str = "auto",
) -> RobotDescription:
    """Load a robot description. ``name``: path of a URDF, xacro, SDF or MJCF file, a pipe, ``-`` for the standard
    input, name of a URDF in ``data/robots``, or ``tiago_pro`` (needs the extra ``tiago``).

    ``is_remote``: whether the URDF was received over the network. Then no file that it names is opened, and its meshes
    are taken from ``received`` (digest -> corners [face, 3, 3] m); other meshes become boxes. ``sidecar``: replaces the
    TOML file. ``srdf``: path of the SRDF, instead of the one beside the file. ``xacro_args``: arguments of a xacro
    file, each ``NAME:=VALUE``. ``base``: how the base moves; "auto": as the TOML file says
    (:attr:`BaseLimits.kind`). Raises :class:`DescriptionError`, with one line of text, if the robot cannot be
    simulated.
    """
    try:
        kind = msgspec.convert(base, BaseKind)
    except msgspec.ValidationError:
        raise DescriptionError(f"{name}: the base is {base!r}; give {', '.join(get_args(BaseKind))}") from None
    if is_remote:
        file = pathlib.Path(name)
        source = RobotSource(_read_remote(file), file, None, {})
    else:
        source = read_source(str(name), parse_arguments(xacro_args))
    loading = _Loading(source, is_remote=is_remote, received=received)
    description = loading.describe(sidecar, None if srdf is None else pathlib.Path(srdf), kind)
    for note in loading.notes:
        log.info("%s: %s", source.file.name, note)
    if loading.assumed:
        log.warning("%s: assumed: %s", source.file.name, "; ".join(loading.assumed))
    return description


def _read_remote(file: pathlib.Path) -> etree._Element:
    """Returns the XML of a URDF that was received over the network. Its text was searched on arrival, by
    :func:`vinesim.scene.robot_limits.urdf_objection`. Here its elements are counted as the parser sees them."""
    root = read_xml(file)
    if objection := counts_objection(collections.Counter(element.tag for element in root.iter(etree.Element))):
        raise description_error(file, objection, "give a smaller robot")
    return root


class _Loading:
    """The steps in which one robot is loaded. :attr:`root` is the XML of its URDF, which the steps change."""

    def __init__(
        self, source: RobotSource, *, is_remote: bool, received: Mapping[str, np.ndarray] | None = None
    ) -> None:
        self.file = source.file
        self.root = source.root
        self.is_remote = is_remote
        self.floats = source.floats
        self.notes = list(source.notes)
        self.assumed: list[str] = []
        check_numbers(self.root, self.file)
        self.originals = make_names_valid(self.root, self.assumed)
        renamed = {old: new for new, old in self.originals.items()}
        if renamed:
            self.notes.append("replaced names: " + ", ".join(f"{old!r} by {new!r}" for old, new in renamed.items()))
        self.home = {renamed.get(joint, joint): position for joint, position in source.home.items()}
        self.meshes: dict[str, np.ndarray] = {}
        self.ros_urdf = ""
        if is_remote:
            self.meshes = replace_unopened_meshes(self.root, self.assumed, received)
        else:
            for_ros = copy.deepcopy(self.root)
            found = resolve_meshes(self.root, self.file, self.assumed)
            self.ros_urdf = ros_text(for_ros, found, None if self.originals else source.text)

    def describe(self, sidecar: Sidecar | None, srdf: pathlib.Path | None, kind: BaseKind) -> RobotDescription:
        """Repair and check the robot, and return its description."""
        root, file, notes, assumed = self.root, self.file, self.notes, self.assumed
        root_joint = free_the_base(root, assumed)
        self.floats |= root_joint == "floating"
        has_wheels = fix_wheels(root, notes)
        rename_world(root, notes)
        repair_joints(root, assumed)
        repair_inertias(root, assumed)
        toml = file.with_suffix(".toml")
        if file.name.endswith(".urdf.xacro"):
            toml = file.with_name(file.name.removesuffix(".urdf.xacro") + ".toml")
        if sidecar is None:
            sidecar = rename_in_sidecar(read_sidecar(toml), self.originals)
        sidecar, sensors = self._with_sensors(sidecar)
        set_friction(root, sidecar.friction, toml)
        check_friction(root, file)
        groups = self._read_srdf(sidecar, srdf)
        self.floats |= groups is not None and srdf_floats(groups)
        try:
            parsed = parse_robot(root)
        except ValueError as error:
            raise description_error(
                file, f"not a URDF: {error}", "add what URDF requires to every link, joint and shape"
            ) from error
        base, order = check_tree(parsed, file)
        check_joints(parsed, file)
        check_masses(parsed, file, notes)
        add_missing_masses(root, parsed, base, order, assumed)
        assembly = _Assembly(file, toml, sidecar, sensors, groups, self.home, is_remote=self.is_remote)
        made = assembly.description(root)
        boxes = {} if self.is_remote else link_boxes(made[0], root)
        standing = feet(made[0], boxes) if root.find("link/collision") is not None else {}
        kind = self._base_kind(sidecar.base.kind if kind == "auto" else kind, made[0].base, standing, has_wheels)
        if root_joint and kind != "free":
            notes.append(f"its base moves on a {root_joint} joint: {'bolted down' if kind == 'fixed' else 'driven'}")
        assembly = assembly.with_base(kind, standing)
        made = assembly.description(root)
        box = bounds(boxes)
        if box is None and not self.is_remote:
            notes.append("it has no shapes: it is invisible, and touches nothing")
        if box is not None:
            warning = size_warning(box)
            if warning is not None:
                assumed.append(warning)
            lift = -float(box[0, 2]) if base not in (MOUNT, "base_footprint") and box[0, 2] < -LEAST_LIFT else 0.0
            if kind == "free":
                lift = self._height_on_feet(made[0])
            if lift and warning is None:
                lift_to_ground(root, base, lift, notes)
                made = assembly.description(root)
        description, more_notes, more_assumed = made
        notes += more_notes
        assumed += more_assumed
        return dataclasses.replace(
            description,
            notes=(*notes, *assumed),
            meshes=self.meshes,
            is_remote=self.is_remote,
            ros_urdf=self.ros_urdf,
            original_names=self.originals,
            controllers=with_original_names(description.controllers, self.originals),
        )

    def _base_kind(self, wanted: BaseKind, base: str, standing: Mapping[str, np.ndarray], has_wheels: bool) -> BaseKind:
        """Returns how the base moves: as ``wanted``, else as the file says. ``base``: the root link. ``standing``: see
        :func:`feet`."""
        if base == MOUNT:
            if wanted in ("planar", "free"):
                found = f"a fixed joint bolts it down to 'world', so its base cannot be {wanted}"
                raise description_error(self.file, found, "remove the link 'world', or choose the base 'fixed'")
            return "fixed"
        if wanted == "free" and has_wheels:
            self.assumed.append("its wheels do not turn: it stands on them and cannot drive")
        if wanted != "auto":
            return wanted
        if standing and self.floats and not has_wheels:
            self.notes.append(f"its base is free: it stands on {some_names(list(standing))}")
            return "free"
        if standing and not has_wheels:
            self.assumed.append(
                f"its base is driven in the plane, although it stands on legs, {some_names(list(standing))}: "
                "with --base free, or kind = 'free' in [base] of its TOML file, the legs carry it"
            )
        return "planar"

    def _height_on_feet(self, described: RobotDescription) -> float:
        """Returns the height [m] of the root link of a robot that stands at home. Raises :class:`DescriptionError` if
        it would fall through the ground."""
        lowest = lowest_point(described.to_spec("robot"))
        if lowest is None:
            found = "nothing of it collides, so that a free base would fall through the ground"
            raise description_error(self.file, found, "give its links <collision> shapes, or choose the base 'planar'")
        return -lowest

    def _with_sensors(self, sidecar: Sidecar) -> tuple[Sidecar, tuple[RenderedMount, ...]]:
        """Returns the TOML file's content with the robot's IMUs, and the robot's rendered sensors.

        The TOML file comes first for each kind of sensor, then Gazebo's tags in the URDF. Other sensors are guessed
        from the names of links. The copy of a remote robot has no sensors.
        """
        if self.is_remote:
            return msgspec.structs.replace(sidecar, imus=sidecar.imus or ()), ()
        tagged, imus, wrenches = read_sensors(self.root, self.notes, self.assumed)
        found: list[RenderedMount] = []
        for kind in SENSOR_KINDS:
            given = sidecar.mounts(kind)
            if given is None:
                given = tuple(one for one in tagged if one.kind == kind)
                if not given and kind in SENSOR_GUESSES:
                    given = SENSOR_GUESSES[kind](self.root, self.notes)
            found += given
        if sidecar.imus is None:
            sidecar = msgspec.structs.replace(sidecar, imus=tuple(imus) or guess_imus(self.root, self.notes))
        if not sidecar.wrenches:
            sidecar = msgspec.structs.replace(sidecar, wrenches=tuple(wrenches))
        return sidecar, tuple(found)

    def _read_srdf(self, sidecar: Sidecar, given: pathlib.Path | None) -> etree._Element | None:
        """Returns the SRDF of the robot, whose pairs of links that never collide are copied into the URDF; None without
        one."""
        if self.is_remote:
            return None
        if given is None and sidecar.srdf:
            given = self.file.parent / sidecar.srdf
        if given is None:
            given = find_srdf(self.file, self.root.get("name"))
        if given is None:
            return None
        srdf = read_srdf(given, self.originals)
        merge_disabled_collisions(self.root, srdf, given.name, self.notes)
        return srdf


def ros_text(root: etree._Element, meshes: Mapping[str, pathlib.Path], text: str | None) -> str:
    """Returns the URDF for ``/robot_description``: that of the user, in which only addresses of meshes are replaced at
    which other programs would not find them.

    ``root``: XML of the URDF. ``meshes``: file of each mesh, by its name in the URDF. ``text``: the URDF as the user
    wrote it; None: ``root`` is written instead.
    """
    addresses = {uri: ros_address(uri, found) for uri, found in meshes.items()}
    changed = {uri: address for uri, address in addresses.items() if uri != address}
    for mesh in root.iterfind("link//geometry/mesh"):
        mesh.set("filename", addresses[mesh.get("filename", "")])
    if text is not None:
        for uri, address in changed.items():
            for quote in "\"'":
                text = text.replace(f"{quote}{uri}{quote}", f"{quote}{address}{quote}")
        written = parse_xml(text.encode(), pathlib.Path("robot_description"))
        named = [[mesh.get("filename") for mesh in one.iterfind("link//geometry/mesh")] for one in (written, root)]
        if named[0] == named[1]:
            return text
    return etree.tostring(root, encoding="unicode")


@dataclasses.dataclass(frozen=True)
class _Assembly:
    """What a description is made of, besides the XML of the robot."""

    file: pathlib.Path
    toml: pathlib.Path
    sidecar: Sidecar
    sensors: tuple[RenderedMount, ...]
    srdf: etree._Element | None
    home: Mapping[str, float]
    """Home positions [rad or m] that the robot file gives, by joint."""
    is_remote: bool
    feet: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Where the feet touch the ground [3] m, by moving link; empty unless the base is free."""

    def with_base(self, kind: BaseKind, feet: Mapping[str, np.ndarray]) -> _Assembly:
        """Returns the same with another kind of base. ``feet``: on which the robot stands if its base is free."""
        base = msgspec.structs.replace(self.sidecar.base, kind=kind)
        if kind == "fixed":
            base = msgspec.structs.replace(base, linear=0.0, angular=0.0, effort=BOLTED_EFFORT)
        sidecar = msgspec.structs.replace(self.sidecar, base=base)
        return dataclasses.replace(self, sidecar=sidecar, feet=feet if kind == "free" else {})

    def description(self, root: etree._Element) -> tuple[RobotDescription, list[str], list[str]]:
        """Returns the description of the robot in ``root``, which was checked, with notes and warnings."""
        notes: list[str] = []
        assumed: list[str] = []
        robot = parse_robot(root)
        base, order = check_tree(robot, self.file)
        driven = [joint for joint in robot.joints if joint.type in MOVABLE_JOINT_TYPES and joint.mimic is None]
        names = [joint.name for joint in driven]
        anchors = link_anchors(base, order)
        sidecar = self._grouped(names, anchors, order)
        sidecar = msgspec.structs.replace(sidecar, groups=self._with_home(sidecar.groups, driven))
        if sidecar.grippers is None:
            fingers = self._fingers(sidecar)
            if not self.is_remote:  # the list of controllers is not sent to other clients
                driven_by_group = {name: group.joints for name, group in sidecar.groups.items()}
                warn_of_unlisted_fingers(driven_by_group, fingers, robot.joints, assumed)
            sidecar = msgspec.structs.replace(sidecar, grippers=fingers)
        check_sidecar(sidecar, self.sensors, set(names), anchors, self.toml)
        fixed = [joint for joint in robot.joints if joint.type == "fixed"]
        frames_of_fixed = [(joint.parent, joint.child) for joint in fixed]
        poses_of_fixed = [joint_origin(joint) for joint in fixed]
        if base == MOUNT and not self.is_remote:  # /robot_description has the link by the user's name
            frames_of_fixed.append((MOUNT, "world"))
            poses_of_fixed.append(frames.pose([0.0, 0.0, 0.0]))
        urdf = etree.tostring(root, encoding="unicode")
        description = RobotDescription(
            name=robot.name,
            file=self.file,
            urdf=urdf,
            base=base,
            drives=(),
            home=home_positions(driven, sidecar.groups),
            groups=sidecar.groups,
            moving_joints=moving_joints(robot, names),
            fixed_frames=tuple(frames_of_fixed),
            fixed_poses=np.array(poses_of_fixed).reshape(-1, 7),
            link_anchors=anchors,
            sensors=self.sensors,
            sensor_pacing=SensorPacing(sidecar.sensors.mode, sidecar.sensors.least_rate),
            imus=sidecar.imus or (),
            wrenches=sidecar.wrenches,
            grippers=sidecar.all_grippers,
            controllers=make_controllers(sidecar, names, command_interfaces(urdf), self.toml),
            base_limits=sidecar.base,
            mass=sum(link.inertial.mass or 0.0 for link in robot.links if link.inertial is not None),
            notes=(),
        )
        drives = make_drives(robot, driven, description, self.feet, notes, assumed)
        return dataclasses.replace(description, drives=drives), notes, assumed

    def _grouped(self, names: list[str], anchors: Container[str], order: list[Joint]) -> Sidecar:
        """Returns the sidecar with joint groups: its own, else those of the SRDF, else guessed ones."""
        if self.sidecar.groups:
            return self.sidecar
        groups = {} if self.srdf is None else srdf_groups(self.srdf, order, names)
        grouped = {joint for group in groups.values() for joint in group.joints}
        rest = guess_groups([name for name in names if name not in grouped], anchors, order)
        for name, group in rest.items():
            groups[name if name not in groups else f"{name}_rest"] = group
        return msgspec.structs.replace(self.sidecar, groups=groups)

    def _fingers(self, sidecar: Sidecar) -> tuple[Fingers, ...]:
        """Returns the grippers with fingers of a robot whose TOML file lists no grippers."""
        guessed = guess_fingers(sidecar.groups, sidecar.cutters)
        if self.srdf is None or self.sidecar.groups:
            return guessed
        hands = {one.group for one in guessed} | set(srdf_hands(self.srdf))
        return tuple(Fingers(name) for name in sidecar.groups if name in hands)

    def _with_home(self, groups: Mapping[str, JointGroup], driven: list[Joint]) -> dict[str, JointGroup]:
        """Returns the groups with the home positions that robot file and SRDF give, within the limits."""
        limits = {joint.name: joint_limits(joint) for joint in driven}
        found = {}
        for name, group in groups.items():
            home = group.home
            if home is None and self.home and all(joint in self.home for joint in group.joints):
                home = tuple(self.home[joint] for joint in group.joints)
            if home is not None and not self.sidecar.groups and all(joint in limits for joint in group.joints):
                home = tuple(
                    min(max(position, limits[joint].lower), limits[joint].upper)
                    for joint, position in zip(group.joints, home, strict=True)
                )
            found[name] = msgspec.structs.replace(group, home=home)
        return found
