"""Loads a robot description: a URDF, and a TOML file of the same name with data that a URDF cannot contain.

    robot = load_description("vinebot")
    rigid.add_robot(robot.to_spec("robot_1", index=0, pose=frames.pose([2.0, 0.0, 0.0])))

Physics and ROS receive a changed text of the URDF. Meshes have absolute paths. Wheels and casters are fixed, because
the base is driven as one body. A root link ``world`` is renamed and bolts the robot down. Shapes whose mesh format
physics cannot read are replaced, and missing or invalid values are repaired. :attr:`RobotDescription.notes` lists each
change. One warning for each robot lists what was assumed.
"""

from __future__ import annotations

import dataclasses
import logging
import pathlib
from collections.abc import Mapping

import msgspec
import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.core import data_files
from vinesim.robot.description.controllers import command_interfaces, make_controllers
from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.drive_parameters import home_positions, make_drives
from vinesim.robot.description.grippers import guess_fingers, warn_of_unlisted_fingers
from vinesim.robot.description.inferred_defaults import SENSOR_GUESSES, guess_groups
from vinesim.robot.description.kinematics import joint_origin, link_anchors, moving_joints
from vinesim.robot.description.meshes import find_installed, replace_unopened_meshes, resolve_meshes
from vinesim.robot.description.repairs import (
    MOUNT,
    add_missing_masses,
    rename_world,
    repair_inertias,
    repair_joints,
)
from vinesim.robot.description.sidecar import Sidecar, check_sidecar, read_sidecar
from vinesim.robot.description.urdf import (
    MOVABLE_JOINT_TYPES,
    DescriptionError,
    Joint,
    Robot,
    check_friction,
    check_joints,
    check_masses,
    check_numbers,
    check_tree,
    description_error,
    fix_wheels,
    merge_disabled_collisions,
    parse_robot,
    read_xml,
    set_friction,
)
from vinesim.scene.values import SENSOR_KINDS, RenderedMount, SensorPacing

log = logging.getLogger(__name__)

BOLTED_EFFORT = (1e6, 1e6)
"""Largest force [N] and moment [N m] that hold the base of a robot that is bolted down. Forces of the robot move the
base by micrometres."""


def load_description(
    name: str | pathlib.Path,
    *,
    is_remote: bool = False,
    sidecar: Sidecar | None = None,
    received: Mapping[str, np.ndarray] | None = None,
) -> RobotDescription:
    """Load a robot description. ``name``: path of a URDF, name of a URDF in ``data/robots``, or ``tiago_pro`` (needs
    the extra ``tiago``).

    ``is_remote``: whether the URDF was received over the network. Then no file that it names is opened, and its meshes
    are taken from ``received`` (digest -> corners [face, 3, 3] m); other meshes become boxes. ``sidecar``: replaces the
    TOML file. Raises :class:`DescriptionError`, with one line of text, if the robot cannot be simulated.
    """
    file = _locate(str(name))
    root = read_xml(file)
    check_numbers(root, file)
    notes: list[str] = []
    assumed: list[str] = []
    meshes: dict[str, np.ndarray] = {}
    if is_remote:
        meshes = replace_unopened_meshes(root, assumed, received)
    else:
        resolve_meshes(root, file, notes)
    fix_wheels(root, notes)
    rename_world(root, notes)
    repair_joints(root, assumed)
    repair_inertias(root, assumed)
    sidecar = read_sidecar(file.with_suffix(".toml")) if sidecar is None else sidecar
    sensors = _sensors(sidecar, root, notes)
    set_friction(root, sidecar.friction, file.with_suffix(".toml"))
    check_friction(root, file)
    srdf = file.parent / sidecar.srdf if sidecar.srdf else file.with_suffix(".srdf")
    if not is_remote and (sidecar.srdf or srdf.is_file()):
        merge_disabled_collisions(root, srdf, notes)
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
    urdf = etree.tostring(root, encoding="unicode")
    description = _assemble(
        parse_robot(root), base, order, file, urdf, sidecar, sensors, notes, assumed, is_remote=is_remote
    )
    description = dataclasses.replace(description, meshes=meshes, is_remote=is_remote)
    for note in notes:
        log.info("%s: %s", file.name, note)
    if assumed:
        log.warning("%s: assumed: %s", file.name, "; ".join(assumed))
    return description


def _locate(name: str) -> pathlib.Path:
    """Returns the path of the URDF called ``name``. Raises :class:`DescriptionError` if there is none."""
    if name == "tiago_pro":
        found = find_installed("example-robot-data/robots/tiago_pro_description/robots/tiago_pro.urdf")
        if found is None:
            raise DescriptionError("tiago_pro: its files are not installed; type: pip install 'vinesim[tiago]'")
        return found
    try:
        return data_files.find_data_file("robots", name, ".urdf").resolve()
    except data_files.DataFileNotFound as error:
        raise DescriptionError(f"{name}: {error}") from error


def _sensors(sidecar: Sidecar, root: etree._Element, notes: list[str]) -> tuple[RenderedMount, ...]:
    """Returns the sensors listed in the TOML file. Sensors of kinds that it does not have are guessed from the URDF,
    which is added to ``notes``."""
    found: list[RenderedMount] = []
    for kind in SENSOR_KINDS:
        given = sidecar.mounts(kind)
        if given is None and kind in SENSOR_GUESSES:
            given = SENSOR_GUESSES[kind](root, notes)
        found += given or ()
    return tuple(found)


def _assemble(
    robot: Robot,
    base: str,
    order: list[Joint],
    file: pathlib.Path,
    urdf: str,
    sidecar: Sidecar,
    sensors: tuple[RenderedMount, ...],
    notes: list[str],
    assumed: list[str],
    *,
    is_remote: bool,
) -> RobotDescription:
    """Returns the description of a checked ``robot``. ``base``: its root link. ``order``: its joints from the root
    outwards."""
    driven = [joint for joint in robot.joints if joint.type in MOVABLE_JOINT_TYPES and joint.mimic is None]
    names = [joint.name for joint in driven]
    anchors = link_anchors(base, order)
    if not sidecar.groups:
        sidecar = msgspec.structs.replace(sidecar, groups=guess_groups(names, anchors))
    if sidecar.grippers is None:
        fingers = guess_fingers(sidecar.groups, sidecar.cutters)
        if not is_remote:  # the list of controllers is not sent to other clients
            driven_by_group = {name: group.joints for name, group in sidecar.groups.items()}
            warn_of_unlisted_fingers(driven_by_group, fingers, robot.joints, assumed)
        sidecar = msgspec.structs.replace(sidecar, grippers=fingers)
    check_sidecar(sidecar, sensors, set(names), anchors, file.with_suffix(".toml"))
    fixed = [joint for joint in robot.joints if joint.type == "fixed"]
    description = RobotDescription(
        name=robot.name,
        file=file,
        urdf=urdf,
        base=base,
        drives=(),
        home=home_positions(driven, sidecar.groups),
        groups=sidecar.groups,
        moving_joints=moving_joints(robot, names),
        fixed_frames=tuple((joint.parent, joint.child) for joint in fixed),
        fixed_poses=np.array([joint_origin(joint) for joint in fixed]).reshape(-1, 7),
        link_anchors=anchors,
        sensors=sensors,
        sensor_pacing=SensorPacing(sidecar.sensors.mode, sidecar.sensors.least_rate),
        imus=sidecar.imus,
        wrenches=sidecar.wrenches,
        grippers=sidecar.all_grippers,
        controllers=make_controllers(sidecar, names, command_interfaces(urdf), file.with_suffix(".toml")),
        base_limits=msgspec.structs.replace(sidecar.base, linear=0.0, angular=0.0, effort=BOLTED_EFFORT)
        if base == MOUNT
        else sidecar.base,
        mass=sum(link.inertial.mass or 0.0 for link in robot.links if link.inertial is not None),
        notes=(),
    )
    drives = make_drives(robot, driven, description, notes, assumed)
    return dataclasses.replace(description, drives=drives, notes=(*notes, *assumed))
