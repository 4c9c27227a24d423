"""Controllers of a robot: those in its TOML file, or controllers derived from its joint groups and named as in
ros2_control.

If the URDF has ``ros2_control`` tags, a controller commands only joints that have the command interface it needs.
"""

from __future__ import annotations

import dataclasses
import math
import pathlib
from collections.abc import Container, Mapping, Sequence

from lxml import etree  # pyright: ignore[reportAttributeAccessIssue] lxml has no type stubs

from vinesim.robot.description.description import RobotDescription
from vinesim.robot.description.grippers import GRIPPER_KINDS
from vinesim.robot.description.sidecar import Controller, Sidecar
from vinesim.robot.description.urdf import description_error
from vinesim.scene.values import FORWARD_KINDS, ControllerKind, ControllerSpec, HardwareTopics

INTERFACE_OF_KIND = {
    ControllerKind.JOINT_TRAJECTORY: "position",
    ControllerKind.GRIPPER: "position",
    ControllerKind.FORWARD_POSITION: "position",
    ControllerKind.FORWARD_VELOCITY: "velocity",
    ControllerKind.FORWARD_EFFORT: "effort",
    ControllerKind.IMPEDANCE: "effort",
}
"""Command interface of ros2_control that a joint must have for each kind of controller."""
HARDWARE_KEYS = ("commands", "states", "timeout")
"""Keys that only a controller of the kind ``topic_based`` has in a TOML file."""
FINGERS_CONTROLLER = "gripper"
"""Alternative to ``fingers`` as the ``kind`` of a controller in a TOML file."""
MIN_ARM_JOINTS = 4
"""Number of joints from which on a joint group counts as an arm, which gets an impedance controller. A group with a
tool always counts as an arm."""


def command_interfaces(urdf: str) -> dict[str, set[str]]:
    """Returns the command interfaces of each joint in the ``ros2_control`` tags of a URDF, by joint; empty without
    such tags."""
    found: dict[str, set[str]] = {}
    for joint in etree.fromstring(urdf.encode()).iterfind("ros2_control/joint"):
        names = {interface.get("name", "") for interface in joint.iterfind("command_interface")}
        found.setdefault(joint.get("name", ""), set()).update(names)
    return found


def make_controllers(
    sidecar: Sidecar, driven: Sequence[str], interfaces: Mapping[str, set[str]], file: pathlib.Path
) -> tuple[ControllerSpec, ...]:
    """Returns the controllers of a robot, sorted by name. ``driven``: names of its driven joints.

    ``interfaces``: command interfaces of each joint; if empty, all joints have all interfaces. Raises
    :class:`DescriptionError` if a controller in the ``sidecar`` names a joint, group or gripper that does not exist.
    """
    if sidecar.controllers is not None:
        specs = [_checked(name, one, sidecar, driven, file) for name, one in sidecar.controllers.items()]
    else:
        specs = _derived(sidecar, driven)
    limited = [_limited(spec, interfaces) for spec in specs]
    return tuple(sorted((one for one in limited if one is not None), key=lambda spec: spec.name))


def _derived(sidecar: Sidecar, driven: Sequence[str]) -> list[ControllerSpec]:
    """Returns controllers for the joint groups and grippers of a robot whose TOML file lists no controllers."""
    of_name = {gripper.controller: gripper for gripper in sidecar.all_grippers}
    specs = [_of_gripper(name, gripper.kind, gripper.group, sidecar) for name, gripper in of_name.items()]
    moved_by_grippers = {gripper.group for gripper in sidecar.all_grippers if gripper.moves_joints}
    arms = []
    for name, group in sidecar.groups.items():
        if name in moved_by_grippers:
            continue
        specs.append(ControllerSpec(f"{name}_controller", ControllerKind.JOINT_TRAJECTORY, group.joints, name))
        if group.tool or len(group.joints) >= MIN_ARM_JOINTS:
            arms += group.joints
            specs.append(ControllerSpec(f"{name}_impedance_controller", ControllerKind.IMPEDANCE, group.joints, name))
    specs += [ControllerSpec(f"{kind}_controller", kind, tuple(driven)) for kind in FORWARD_KINDS]
    if arms:
        specs.append(ControllerSpec("see", ControllerKind.SERIES_ELASTIC, tuple(arms)))
    return specs


def _checked(
    name: str, given: Controller, sidecar: Sidecar, driven: Container[str], file: pathlib.Path
) -> ControllerSpec:
    """Returns a controller that is listed in the TOML file. Raises :class:`DescriptionError` if it is invalid."""
    if given.group and given.group not in {*sidecar.groups, *(gripper.group for gripper in sidecar.all_grippers)}:
        raise description_error(file, f"controller {name!r} belongs to {given.group!r}", "name a group")
    gripper = {FINGERS_CONTROLLER: "fingers"}.get(given.kind, given.kind)
    if gripper not in GRIPPER_KINDS and given.kind not in tuple(ControllerKind):
        known = ", ".join(sorted({*ControllerKind, *GRIPPER_KINDS}))
        raise description_error(file, f"controller {name!r} has the kind {given.kind!r}", f"give one of {known}")
    if gripper in GRIPPER_KINDS and not GRIPPER_KINDS[gripper].moves_joints:
        if all((one.kind, one.group) != (gripper, given.group) for one in sidecar.all_grippers):
            raise description_error(file, f"controller {name!r}: no {gripper} at {given.group!r}", "name its group")
        return _of_gripper(name, gripper, given.group, sidecar)
    if gripper in GRIPPER_KINDS and not given.group:
        raise description_error(file, f"controller {name!r} of a gripper has no group", "name one")
    joints = given.joints or (sidecar.groups[given.group].joints if given.group else ())
    for joint in joints:
        if joint not in driven:
            raise description_error(file, f"controller {name!r} moves {joint!r}", "name driven joints only")
    if not joints or len(set(joints)) < len(joints):
        raise description_error(file, f"controller {name!r} moves {list(joints)}", "name joints, each once")
    if gripper in GRIPPER_KINDS:
        return ControllerSpec(name, ControllerKind.GRIPPER, joints, given.group, gripper)
    hardware = _hardware(name, given, file)
    return ControllerSpec(name, ControllerKind(given.kind), joints, given.group, hardware=hardware)


def _hardware(name: str, given: Controller, file: pathlib.Path) -> HardwareTopics | None:
    """Returns the topics of a controller of the kind ``topic_based``; None for other kinds. Raises
    :class:`DescriptionError` for an invalid timeout, or topics that the controller's kind does not have."""
    keys = {key: value for key in HARDWARE_KEYS if (value := getattr(given, key)) is not None}
    if given.kind != ControllerKind.TOPIC_BASED:
        if keys:
            found = f"controller {name!r} of the kind {given.kind!r} has {', '.join(keys)}"
            raise description_error(file, found, f"these keys belong to the kind {ControllerKind.TOPIC_BASED}")
        return None
    if not 0.0 < keys.get("timeout", 1.0) < math.inf:
        raise description_error(file, f"controller {name!r} has the timeout {given.timeout}", "give more than 0 s")
    return HardwareTopics(**keys)


def with_original_names(
    controllers: Sequence[ControllerSpec], originals: Mapping[str, str]
) -> tuple[ControllerSpec, ...]:
    """Returns controllers that also know their joints by the names in the robot file. ``originals``: see
    :attr:`RobotDescription.original_names`."""
    return tuple(
        dataclasses.replace(spec, renamed={originals[joint]: joint for joint in spec.joints if joint in originals})
        for spec in controllers
    )


def only_hardware(description: RobotDescription) -> RobotDescription:
    """Returns the robot without controllers of joints: another controller manager commands its joints.

    Controllers of the kind ``topic_based`` stay. If there is none, one is made for all driven joints. Grippers without
    joints, such as cutters, stay, because no joint would operate them.
    """
    kept = [spec for spec in description.controllers if spec.hardware is not None or not spec.joints]
    if all(spec.hardware is None for spec in kept):
        joints = tuple(drive.joint for drive in description.drives)
        kept.append(ControllerSpec("hardware", ControllerKind.TOPIC_BASED, joints, hardware=HardwareTopics()))
    kept.sort(key=lambda spec: spec.name)
    return dataclasses.replace(description, controllers=with_original_names(kept, description.original_names))


def _of_gripper(name: str, kind: str, group: str, sidecar: Sidecar) -> ControllerSpec:
    """Returns the controller ``name`` for the grippers of a ``kind`` that belong to the joint group ``group``."""
    joints = sidecar.groups[group].joints if GRIPPER_KINDS[kind].moves_joints else ()
    return ControllerSpec(name, ControllerKind.GRIPPER, joints, group, kind)


def _limited(spec: ControllerSpec, interfaces: Mapping[str, set[str]]) -> ControllerSpec | None:
    """Returns the controller restricted to joints that have the command interface it needs; None if there are none."""
    needed = INTERFACE_OF_KIND.get(spec.kind)
    if not interfaces or needed is None or not spec.joints:
        return spec
    joints = tuple(joint for joint in spec.joints if needed in interfaces.get(joint, ()))
    if spec.kind is ControllerKind.GRIPPER and joints != spec.joints:
        return None
    return dataclasses.replace(spec, joints=joints) if joints else None
